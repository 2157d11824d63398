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
from .fresnel import echo, half_space, slab

MIDDLE = 2.0
"""Argument of the transition function that the variable of its polynomial has at 0."""


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
    sin_beta = np.sqrt(1.0 - cos_beta * cos_beta)
    less, more = phi_out - phi_in, phi_out + phi_in
    up, up_sine = edge_term(np.pi + less, exterior, distance)
    down, down_sine = edge_term(np.pi - less, exterior, distance)
    at_n, _ = edge_term(np.pi + more, exterior, distance)
    at_0, _ = edge_term(np.pi - more, exterior, distance)
    sine_in, _ = sine_cosine(phi_in / (2.0 * np.pi * exterior))
    sine_out, _ = sine_cosine(phi_out / (2.0 * np.pi * exterior))
    across, upright = sine_cosine(less / (4.0 * np.pi))
    near, far = smaller(np.abs(up_sine), np.abs(down_sine)), larger(np.abs(up_sine), np.abs(down_sine))
    upright = select(near < 1e-9, exterior, upright / larger(near, 1e-9)) * sine_in * sine_out / larger(far, 1e-9)
    upright = larger(smaller(upright, 1.0), -1.0)
    te_0, mixed_0, tm_0 = face_matrix(upright, across, cos_beta, sin_beta, face_0)
    # from face n both the angles and the edge run the other way, which leaves the matrix as it is
    te_n, mixed_n, tm_n = face_matrix(upright, across, cos_beta, sin_beta, face_n)
    scale = -np.exp(-0.25j * np.pi) / (2.0 * np.sqrt(2.0 * np.pi)) / (exterior * sin_beta)
    return (
        scale * (up + down + at_n * te_n + at_0 * te_0),
        scale * (at_n * mixed_n + at_0 * mixed_0),
        scale * (up + down + at_n * tm_n + at_0 * tm_0),
    )


def at_face(angle: Number, top: Number, rise: Number, exterior: Number, distance: Number) -> tuple[Any, Any]:
    """A wedge from an angle to one of its faces: what passes where waves add up, and how it grows where they cancel.

    Parameters
    ----------
    angle : Number
        Of the end [rad].
    top : Number
        Angle of the face: 0 or ``exterior * pi``.
    rise : Number
        A small angle from the face into the air [rad].
    exterior : Number
    distance : Number
        As for :func:`wedge`.

    Returns
    -------
    hard : complex
        ``T(pi + d) + T(pi - d)``, half of a perfectly hard wedge, faded out at the shadow boundary.
    slope : complex
        Derivative by the angle above the face of a perfectly soft wedge.
    """
    # in the plane of the face direct and reflected wave end together: all is taken on the side of the shadow
    on_plane = np.abs(np.abs(angle - top) - np.pi) < 4.0 * np.abs(rise)
    angle = select(on_plane, angle + 8.0 * rise, angle)
    scale = -np.exp(-0.25j * np.pi) / (2.0 * np.sqrt(2.0 * np.pi)) / exterior
    less = top - angle
    hard = edge_term(np.pi + less, exterior, distance)[0] + edge_term(np.pi - less, exterior, distance)[0]
    less, more = top + rise - angle, top + rise + angle
    near = edge_term(np.pi + less, exterior, distance)[0] + edge_term(np.pi - less, exterior, distance)[0]
    far = edge_term(np.pi + more, exterior, distance)[0] + edge_term(np.pi - more, exterior, distance)[0]
    half, _ = sine_cosine((np.pi - np.abs(top - angle)) / (4.0 * np.pi))
    depth = 2.0 * distance * half * half
    return scale * hard * (depth / (1.0 + depth)), scale * (near - far) / np.abs(rise)


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
    finite = np.isfinite(thickness)
    e_re, e_im = echo(select(finite, thickness, 0.0), root_re, root_im)
    back = select(finite, e_re, 0.0) + 1j * select(finite, e_im, 0.0)
    te = (root_re + 1j * root_im) * (1.0 - back) / (1.0 + back)
    return ground_wave(gap, te), ground_wave(gap, te / (eta_re + 1j * eta_im))


def ground_wave(gap: Number, impedance: Any) -> Any:
    """Twice the root of ``j gap W``: see :func:`along_face`."""
    q = 0.5 * gap * impedance * impedance
    return 2.0 * np.sqrt(1j * gap / (1.0 + np.sqrt(1j * np.pi * q) + 2j * q))


def edge_term(angle: Number, exterior: Number, distance: Number) -> tuple[Any, Number]:
    """``cot(angle / 2n) F(x)``, whose pole at a shadow boundary F takes away; and the sine of ``angle / 2n``.

    Round the edge the angle repeats every 2 pi n; measured from the nearest boundary the argument of F is
    ``x = 2 distance sin^2(angle / 2)``, so the factor sin(angle / 2) cancels the pole in closed form.
    """
    turns = angle / (2.0 * np.pi * exterior)
    turns = turns - np.floor(turns + 0.5)
    above, _ = sine_cosine(0.5 * turns * exterior)
    below, cosine = sine_cosine(0.5 * turns)
    above = np.abs(above)
    # on the boundary itself the ray that grazes the edge counts as seen, so the limit is that of the lit side
    ratio = select(below == 0.0, exterior, above / select(below == 0.0, 1.0, below))
    reach = np.sqrt(2.0 * distance)
    re, im = transition(reach * above)
    return (re + 1j * im) * (cosine * ratio * reach), below


def face_matrix(sine: Number, across: Number, cos_beta: Number, sin_beta: Number, face: Any) -> tuple[Any, Any, Any]:
    """Reflection at a face in the edge-fixed basis: elements (beta, beta), (beta, phi), (phi, phi) of its matrix.

    Away from the reflection boundary no angle of incidence is given. Taken is that on the mirror through the edge
    which would send the ray to the target, half of ``pi - less``, times a factor that is 1 on both reflection
    boundaries (continuity), the same both ways (reciprocity), and 0 where source or target lies in a face: there the
    field of a face that does not conduct perfectly vanishes.

    Parameters
    ----------
    sine, across : Number
        Sine and cosine of that angle.
    cos_beta, sin_beta : Number
        Of the angle between ray and edge.
    face : tuple of 3 Number
        Permittivity and thickness in wavelengths.

    Returns
    -------
    bb, bp, pp : complex
    """
    eta_re, eta_im, thickness = face
    te, tm = face_coefficients(np.abs(sine) * sin_beta, eta_re, eta_im, thickness)
    # angle between the edge-fixed basis and the plane of incidence, whose unit normal is sigma
    askew = cos_beta * sine  # as across, times the sine of incidence: -(sigma . phi) and -(sigma . beta)
    size = across * across + askew * askew
    none = size == 0.0
    scale = 1.0 / select(none, 1.0, size)
    across2, askew2 = select(none, 1.0, across * across * scale), askew * askew * scale
    return te * across2 - tm * askew2, (te + tm) * (across * askew * scale), tm * across2 - te * askew2


def face_coefficients(cosine: Number, eta_re: Number, eta_im: Number, thickness: Number) -> tuple[Any, Any]:
    """TE and TM coefficients of a face as complex numbers; a thickness in wavelengths, infinite for a half-space.

    Parameters
    ----------
    cosine, eta_re, eta_im, thickness : Number

    Returns
    -------
    te, tm : complex
    """
    te_re, te_im, tm_re, tm_im, root_re, root_im = half_space(cosine, eta_re, eta_im)
    finite = np.isfinite(thickness)
    e_re, e_im = echo(select(finite, thickness, 0.0), root_re, root_im)
    e_re, e_im = select(finite, e_re, 0.0), select(finite, e_im, 0.0)
    te_re, te_im = slab(te_re, te_im, e_re, e_im)
    tm_re, tm_im = slab(tm_re, tm_im, e_re, e_im)
    return te_re + 1j * te_im, tm_re + 1j * tm_im
