"""The uniform theory of diffraction at one edge: how a wedge passes a wave on.

Angles are measured round the edge from face 0, through air, to face n: a wedge of exterior angle ``n pi`` fills the
rest. ``e`` is the unit vector along the edge for which ``(t, normal, e)`` is right-handed, ``t`` lying in face 0 away
from the edge and ``normal`` pointing out of it. A wave that travels along ``s`` is written in the edge-fixed basis
``beta = (e - cos_beta s) / sin_beta``, ``phi = e x s / sin_beta``, before the edge and after it. Time factor
``e^{+j omega t}``. The laws take numbers or arrays, as those of :mod:`aerpaw_cmp.propagation.field.dyads` do.

Sources: Kouyoumjian and Pathak, Proc. IEEE 62 (1974) 1448, doi 10.1109/PROC.1974.9651 (the coefficients and their
continuity); Luebbers, IEEE Trans. Antennas Propag. 32 (1984) 70, doi 10.1109/TAP.1984.1143189 (finite conductivity).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.special import wofz

from ...common.units import FloatArray
from .dyads import Number, larger, select, sine_cosine, smaller
from .fresnel import coefficients, half_space, reflection, returned

# Argument of the transition function that the variable of its polynomial has at 0.
MIDDLE = 2.0


def _fitted(terms: int = 24) -> FloatArray:
    """Coefficients (terms, 2) of ``(r + MIDDLE) sqrt(pi) e^{j pi/4} w(e^{j 3 pi/4} r)`` in (r - MIDDLE) / (r + MIDDLE).

    w is the Faddeeva function (Abramowitz and Stegun 7.1.3), smooth on this ray up to infinity: the largest relative
    error of 24 terms is 2e-9.
    """
    nodes = np.cos(np.pi * (np.arange(terms) + 0.5) / terms)
    root = MIDDLE * (1.0 + nodes) / (1.0 - nodes)
    value = (root + MIDDLE) * np.sqrt(np.pi) * np.exp(0.25j * np.pi) * wofz(np.exp(0.75j * np.pi) * root)
    chebyshev = np.polynomial.chebyshev
    powers = chebyshev.cheb2poly(chebyshev.chebfit(nodes, value, terms - 1))
    return np.column_stack([powers.real, powers.imag])


_POWERS = _fitted()


def _fitted_sector(terms: int = 26, shares: int = 11) -> FloatArray:
    """Coefficients (terms, shares, 2) of the integral of :func:`sector` times ``(along + MIDDLE)^2``.

    Powers of ``(along - MIDDLE) / (along + MIDDLE)`` and of ``2 (off / along)^2 - 1``; largest relative error 1.2e-8.
    """
    nodes, low = (np.cos(np.pi * (np.arange(many) + 0.5) / many)[:, None] for many in (terms, shares))
    root = MIDDLE * (1.0 + nodes) / (1.0 - nodes)
    # turned by 45 degrees the integrand falls as a Gaussian does; exp(u - exp(-u)) makes steps of a sum exact
    u = np.linspace(-3.6, 3.0, 100)
    way = np.exp(u - np.exp(-u) - 0.25j * np.pi) / (root * (1.0 + root))
    fall = (u[1] - u[0]) * way * (1.0 + np.exp(-u)) * np.exp(-1j * root**2 * way * (2.0 + way))
    value = np.stack([(fall / ((1.0 + way) ** 2 + 0.5 + 0.5 * share)).sum(axis=1) for share in low])
    chebyshev = np.polynomial.chebyshev
    fit = chebyshev.chebfit(low[:, 0], value * (root[:, 0] + MIDDLE) ** 2, shares - 1)
    fit = chebyshev.chebfit(nodes[:, 0], fit.T, terms - 1).T
    powers = np.apply_along_axis(chebyshev.cheb2poly, 0, np.apply_along_axis(chebyshev.cheb2poly, 1, fit))
    return np.ascontiguousarray(np.stack([powers.real.T, powers.imag.T], axis=2))  # or numba cannot cache its code


_SECTORS = _fitted_sector()


def transition(root: Number) -> tuple[Number, Number]:
    """Transition function of Kouyoumjian and Pathak at ``x = root^2``, over ``root``: real and imaginary part."""
    variable = (root - MIDDLE) / (root + MIDDLE)
    re = variable * 0.0
    im = re
    for k in range(len(_POWERS) - 1, -1, -1):
        re = re * variable + _POWERS[k, 0]
        im = im * variable + _POWERS[k, 1]
    scale = 1.0 / (root + MIDDLE)
    return re * scale, im * scale


def sector(along: Number, off: Number, passed: Any) -> Any:
    """Generalized Fresnel integral times pi: ``off / 2 e^{j along^2} int_along^inf e^{-j t^2} / (t^2 + off^2) dt``.

    Source: Capolino and Maci, Microw. Opt. Technol. Lett. 9 (1995) 32, doi 10.1002/mop.4650090113.

    Parameters
    ----------
    along : Number
        Positive.
    off : Number
    passed : complex
        :func:`transition` at ``along``.

    Returns
    -------
    complex
    """
    size = np.abs(off)
    high, low = larger(along, size), smaller(along, size)
    share, variable, scale = low / high, (high - MIDDLE) / (high + MIDDLE), 1.0 / (high + MIDDLE)
    square = 2.0 * share * share - 1.0
    re = im = 0.0 * variable
    for k in range(len(_SECTORS) - 1, -1, -1):
        a = b = 0.0 * square  # short sums inside: a processor takes some at once
        for i in range(_SECTORS.shape[1] - 1, -1, -1):
            a = a * square + _SECTORS[k, i, 0]
            b = b * square + _SECTORS[k, i, 1]
        re, im = re * variable + a, im * variable + b
    value = 0.5 * share * scale * scale * (re + 1j * im)
    other_re, other_im = transition(size)
    # both sectors of a right angle are the product of two transition functions
    value = select(size > along, -0.25j * passed * (other_re + 1j * other_im) - value, value)
    return select(off < 0.0, -value, value)


def quadrant(a: Number, b: Number, coupling: Number, passed: Any) -> Any:
    """Integral of ``e^{-j (u^2 + v^2 - 2 coupling u v + 2 a u + 2 b v)}`` over positive u and v: two edges in a row.

    Parameters
    ----------
    a, b : Number
        Roots of the arguments of the transition functions of both edges; positive.
    coupling : Number
    passed : tuple of 2 complex
        :func:`transition` at a and b.

    Returns
    -------
    complex
    """
    slant = np.sqrt(1.0 - coupling * coupling)
    first, second = sector(a, (b + coupling * a) / slant, passed[0]), sector(b, (a + coupling * b) / slant, passed[1])
    return -1j / slant * (first + second)


def wedge(
    phi_in: Number, phi_out: Number, cos_beta: Number, exterior: Number, distance: Number, face_0: Any, face_n: Any
) -> tuple[Any, Any, Any]:
    """Diffraction matrix of a wedge in the edge-fixed basis.

    Source: Kouyoumjian and Pathak, Proc. IEEE 62 (1974), 1448-1461, doi:10.1109/PROC.1974.9651.

    Parameters
    ----------
    phi_in, phi_out : Number
        Angles of source and target round the edge [rad], between 0 and ``exterior * pi``.
    cos_beta : Number
        Cosine of the angle between ray and edge, the same on both sides (Keller's cone).
    exterior : Number
        Exterior angle of the wedge over pi: 2 for a screen, 1.5 for the corner of a box.
    distance : Number
        ``k s s' sin_beta^2 / (s + s')`` for a point source: the distance parameter times the wave number.
    face_0, face_n : tuple of 3 Number
        Permittivity (real and imaginary part) and thickness in wavelengths of the two faces.

    Returns
    -------
    bb, bp, pp : complex
        Elements (after, before) of the matrix over (beta, phi), times the square root of the wave number; that of (phi,
        beta) is ``-bp``. A wave of amplitude ``e^{-j k s'} / s'`` at the edge leaves
        ``matrix / sqrt(k) * sqrt(s' / (s (s + s'))) e^{-j k s}`` of it.

    Notes
    -----
    ``-e^{-j pi/4} / (2 n sqrt(2 pi) sin_beta) [(T(pi + d) + T(pi - d)) I + T(pi + u) R_n + T(pi - u) R_0]`` with
    ``d = phi_out - phi_in``, ``u = phi_out + phi_in`` and ``T(x) = cot(x / 2n) F(2 distance cos^2(...))`` (Kouyoumjian
    and Pathak, eq. 25). Matrices ``R`` of the faces stand in place of Luebbers' plus and minus one, so that a screen
    that conducts perfectly is theirs, and the sum with direct and reflected waves is continuous at any obliquity.
    """
    less, more = phi_out - phi_in, phi_out + phi_in
    terms = tuple(edge_term(np.pi + turn, exterior, distance) for turn in (less, -less, more, -more))
    upright, across = obliquity(phi_in, phi_out, exterior, terms[0][2], terms[1][2])
    sine = np.abs(upright) * np.sqrt(1.0 - cos_beta * cos_beta)
    bb_re, bb_im, bp_re, bp_im, pp_re, pp_im = matrix(
        tuple(part for term in terms for part in term[:2]), (upright, across, cos_beta, exterior),
        coefficients(sine, face_0), coefficients(sine, face_n),
    )  # fmt: skip
    return bb_re + 1j * bb_im, bp_re + 1j * bp_im, pp_re + 1j * pp_im


def obliquity(phi_in: Number, phi_out: Number, exterior: Number, up: Number, down: Number) -> tuple[Number, Number]:
    """Sine and cosine of the angle under which the faces of a wedge are taken to be hit, in the plane across the edge.

    Away from the reflection boundary no angle of incidence is given. Taken is that on the mirror through the edge
    which would send the ray to the target, half of ``pi - less``, times a factor that is 1 on both reflection
    boundaries (continuity), the same both ways (reciprocity), and 0 where source or target lies in a face: there the
    field of a face that does not conduct perfectly vanishes.

    Parameters
    ----------
    phi_in, phi_out, exterior : Number
        As for :func:`wedge`.
    up, down : Number
        Sines of ``(pi + less) / 2n`` and ``(pi - less) / 2n``, ``less = phi_out - phi_in``.

    Returns
    -------
    upright, across : Number
    """
    sine_in, _ = sine_cosine(phi_in / (2.0 * np.pi * exterior))
    sine_out, _ = sine_cosine(phi_out / (2.0 * np.pi * exterior))
    across, upright = sine_cosine((phi_out - phi_in) / (4.0 * np.pi))
    near, far = smaller(np.abs(up), np.abs(down)), larger(np.abs(up), np.abs(down))
    upright = select(near < 1e-9, exterior, upright / larger(near, 1e-9)) * sine_in * sine_out / larger(far, 1e-9)
    return larger(smaller(upright, 1.0), -1.0), across


def matrix(terms: Any, angles: Any, face_0: Any, face_n: Any) -> Any:
    """Diffraction matrix of :func:`wedge` from its parts: (beta, beta), (beta, phi), (phi, phi) as six real numbers.

    Parameters
    ----------
    terms : tuple of 8 Number
        Real and imaginary parts of ``T(pi + d), T(pi - d), T(pi + u), T(pi - u)``.
    angles : tuple of 4 Number
        What :func:`obliquity` returns, cosine of the angle between ray and edge, exterior angle over pi.
    face_0, face_n : tuple of 4 Number
        Coefficients TE and TM of the faces, real and imaginary parts.

    Returns
    -------
    tuple of 6 Number
    """
    upright, across, cos_beta, exterior = angles
    up_re, up_im, down_re, down_im, n_re, n_im, o_re, o_im = terms
    # angle between the edge-fixed basis and the plane of incidence, whose unit normal is sigma
    askew = cos_beta * upright  # as across, times the sine of incidence: -(sigma . phi) and -(sigma . beta)
    size = across * across + askew * askew
    weight = 1.0 / select(size == 0.0, 1.0, size)
    along, mixed = select(size == 0.0, 1.0, across * across * weight), across * askew * weight
    # from face n both the angles and the edge run the other way, which leaves the matrix as it is
    te_re = n_re * face_n[0] - n_im * face_n[1] + o_re * face_0[0] - o_im * face_0[1]
    te_im = n_re * face_n[1] + n_im * face_n[0] + o_re * face_0[1] + o_im * face_0[0]
    tm_re = n_re * face_n[2] - n_im * face_n[3] + o_re * face_0[2] - o_im * face_0[3]
    tm_im = n_re * face_n[3] + n_im * face_n[2] + o_re * face_0[3] + o_im * face_0[2]
    both_re, both_im, sideways = up_re + down_re, up_im + down_im, askew * askew * weight
    bb_re, bb_im = both_re + te_re * along - tm_re * sideways, both_im + te_im * along - tm_im * sideways
    pp_re, pp_im = both_re + tm_re * along - te_re * sideways, both_im + tm_im * along - te_im * sideways
    bp_re, bp_im = (te_re + tm_re) * mixed, (te_im + tm_im) * mixed
    # -e^{-j pi/4} / (2 sqrt(2 pi)) = (j - 1) / (4 sqrt(pi))
    scale = 0.25 / np.sqrt(np.pi) / (exterior * np.sqrt(1.0 - cos_beta * cos_beta))
    return (
        -scale * (bb_re + bb_im), scale * (bb_re - bb_im), -scale * (bp_re + bp_im), scale * (bp_re - bp_im),
        -scale * (pp_re + pp_im), scale * (pp_re - pp_im),
    )  # fmt: skip


def at_face(angle: Number, exterior: Number, distance: Number, sine: Number, nearer: Number, face: Any) -> Any:
    """A wedge from an end to one of its faces: what passes where waves add up, and how it grows where they cancel.

    Each is the sum of a far part and of a near part, which jumps where the end comes into the plane of the face.

    Parameters
    ----------
    angle : Number
        Angle between end and face [rad].
    exterior : Number
    distance : Number
        As for :func:`wedge`.
    sine : Number
        Of the angle between ray and edge.
    nearer : Number
        Distance of the end from this edge over that from the other edge of the face.
    face : tuple of 3 Number
        Permittivity and thickness in wavelengths.

    Returns
    -------
    root, passed : Number, complex
        Of the argument of the near part's transition function, and :func:`transition` there.
    far : complex
        Far part of half of a perfectly hard wedge.
    slope, far_slope : complex
        Parts of the derivative by the angle above the face of a perfectly soft wedge; the near one over ``1 - root
        passed``.
    te, tm : complex
        Near part of half of a perfectly hard wedge, over ``passed``. Above the face the end sees the other edge too;
        what comes from there holds the wave along the face by the face's reflection, so that is a factor here.
    """
    scale = -np.exp(-0.25j * np.pi) / (2.0 * np.sqrt(2.0 * np.pi)) / exterior
    root, sharp, cosine, _ = pole(np.pi - angle, exterior, distance)
    far_root, far_sharp, far_cosine, _ = pole(np.pi + angle, exterior, distance)
    (re, im), (far_re, far_im) = transition(root), transition(far_root)
    passed = far_re + 1j * far_im
    far, bent = scale * far_cosine * far_sharp * passed, 2j * scale / (exterior * sine)
    far_slope, slope = bent * far_sharp * far_sharp * (1.0 - far_root * passed), -bent * sharp * sharp
    lit, hard = angle <= np.pi, scale * cosine * sharp
    te_re, te_im, tm_re, tm_im = reflection(select(lit, nearer * sine * np.sin(angle), 0.0), face)
    te, tm = select(lit, te_re + 1j * te_im, 1.0 + 0j), select(lit, tm_re + 1j * tm_im, 1.0 + 0j)
    return root, re + 1j * im, far, slope, far_slope, hard * te, hard * tm


def coupled(wedge_1: Any, wedge_2: Any, coupling: Number) -> Any:
    """Products of two parts that :func:`at_face` returns, where the transition of one edge reaches the other.

    The near parts stand under one integral (:func:`quadrant`) for a face where waves add up (hard), where they cancel
    (soft), and for either in turn. The face's image of a source couples with the opposite sign.

    Parameters
    ----------
    wedge_1, wedge_2 : tuple
    coupling : Number

    Returns
    -------
    soft : complex
        Slope times slope where edges are far apart.
    te, tm : tuple of 2 complex
        Slope times hard and hard times slope; hard times hard.
    """
    a, b = larger(wedge_1[0], 1e-9), larger(wedge_2[0], 1e-9)  # at 0 alone their ratio is lost
    passed, opposite = (wedge_1[1], wedge_2[1]), 1.0 / (1.0 - coupling * coupling)
    plus, minus = quadrant(a, b, coupling, passed), quadrant(a, b, -coupling, passed)
    near_1, near_2 = wedge_1[3] * (1.0 - a * wedge_1[1]), wedge_2[3] * (1.0 - b * wedge_2[1])
    soft = (
        wedge_1[4] * (wedge_2[4] + near_2)
        + near_1 * wedge_2[4]
        + 1j * wedge_1[3] * wedge_2[3] * (plus - minus) / coupling
    )
    rise_1 = wedge_1[3] * opposite * (wedge_2[1] - coupling * wedge_1[1] + 4.0 * (a - coupling * b) * minus)
    rise_2 = wedge_2[3] * opposite * (wedge_1[1] - coupling * wedge_2[1] + 4.0 * (b - coupling * a) * minus)
    common = near_1, near_2, rise_1, rise_2, plus + minus
    return (
        soft,
        of_wave(wedge_1, wedge_2, wedge_1[5], wedge_2[5], common),
        of_wave(wedge_1, wedge_2, wedge_1[6], wedge_2[6], common),
    )


def of_wave(wedge_1: Any, wedge_2: Any, hard_1: Any, hard_2: Any, common: Any) -> tuple[Any, Any]:
    """The products of :func:`coupled` that depend on the polarisation.

    Parameters
    ----------
    wedge_1, wedge_2 : tuple
    hard_1, hard_2 : complex
        Near hard parts of both edges.
    common : tuple of 5 complex
        Near slopes of both edges, the same times the other's near hard part under one integral, and the sum of
        quadrants of both signs.

    Returns
    -------
    mixed, hard : complex
    """
    near_1, near_2, rise_1, rise_2, added = common
    sum_1, sum_2 = wedge_1[2] + hard_1 * wedge_1[1], wedge_2[2] + hard_2 * wedge_2[1]
    mixed = (
        wedge_1[4] * sum_2
        + near_1 * wedge_2[2]
        + rise_1 * hard_2
        + sum_1 * wedge_2[4]
        + wedge_1[2] * near_2
        + rise_2 * hard_1
    )
    return mixed, wedge_1[2] * sum_2 + hard_1 * wedge_1[1] * wedge_2[2] - 2.0 * hard_1 * hard_2 * added


def along_face(gap: Number, face: Any) -> tuple[Any, Any]:
    """Propagation of waves of both polarisations along a face: twice the root of ``2j k s W`` for TE and TM.

    W is the attenuation of Sommerfeld's ground wave, ``1 / (1 + e^{j pi/4} sqrt(pi q) + 2 j q)`` with the numerical
    distance ``q = k s z^2 / 2`` and the impedance z of the face at grazing incidence: 1 on a conductor, ``1 / 2jq`` far
    out, where the reflection is -1.

    Parameters
    ----------
    gap : Number
        Length of the way along the face times the wave number.
    face : tuple of 3 Number
        Permittivity and thickness in wavelengths.

    Returns
    -------
    te, tm : complex
    """
    eta_re, eta_im, thickness = face
    _, _, _, _, root_re, root_im = half_space(0.0 * gap, eta_re, eta_im)
    e_re, e_im = returned(thickness, root_re, root_im)
    back = e_re + 1j * e_im
    te = (root_re + 1j * root_im) * (1.0 - back) / (1.0 + back)
    return ground_wave(gap, te), ground_wave(gap, te / (eta_re + 1j * eta_im))


def ground_wave(gap: Number, impedance: Any) -> Any:
    """Twice the root of ``j gap W``: see :func:`along_face`."""
    q = 0.5 * gap * impedance * impedance
    return 2.0 * np.sqrt(1j * gap / (1.0 + np.sqrt(1j * np.pi * q) + 2j * q))


def edge_term(angle: Number, exterior: Number, distance: Number) -> tuple[Number, Number, Number]:
    """``cot(angle / 2n) F(x)``, whose pole at a shadow boundary F takes away; and the sine of ``angle / 2n``.

    Parameters
    ----------
    angle, exterior, distance : Number
        Angle [rad]; exterior angle and distance as for :func:`wedge`.

    Returns
    -------
    re, im, sine : Number
    """
    root, sharp, cosine, sine = pole(angle, exterior, distance)
    re, im = transition(root)
    scale = cosine * sharp
    return re * scale, im * scale, sine


def pole(angle: Number, exterior: Number, distance: Number) -> tuple[Number, Number, Number, Number]:
    """Root of the argument of F at an angle, its ratio to the sine of ``angle / 2n``, and that angle's cosine and sine.

    Round the edge the angle repeats every 2 pi n; measured from the nearest boundary the argument of F is
    ``x = 2 distance sin^2(angle / 2)``, so the factor sin(angle / 2) cancels the pole in closed form.

    Parameters
    ----------
    angle, exterior, distance : Number
        As for :func:`edge_term`.

    Returns
    -------
    root, sharp, cosine, sine : Number
    """
    turns = angle / (2.0 * np.pi * exterior)
    turns = turns - np.floor(turns + 0.5)
    above, _ = sine_cosine(0.5 * turns * exterior)
    below, cosine = sine_cosine(0.5 * turns)
    above = np.abs(above)
    # on the boundary itself the ray that grazes the edge counts as seen, so the limit is that of the lit side
    ratio = select(below == 0.0, exterior, above / select(below == 0.0, 1.0, below))
    reach = np.sqrt(2.0 * distance)
    return reach * above, reach * ratio, cosine, below
