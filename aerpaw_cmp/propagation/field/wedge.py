"""The uniform theory of diffraction at one edge: how a wedge passes a wave on.

Angles are measured round the edge from face 0, through air, to face n: a wedge of exterior angle ``n pi`` fills the
rest. ``e`` is the unit vector along the edge for which ``(t, normal, e)`` is right-handed, ``t`` lying in face 0 away
from the edge and ``normal`` pointing out of it. A wave that travels along ``s`` is written in the edge-fixed basis
``beta = (e - cos_beta s) / sin_beta``, ``phi = e x s / sin_beta``, before the edge and after it. Time factor
``e^{+j omega t}``.

Sources: Kouyoumjian and Pathak, Proc. IEEE 62 (1974) 1448, doi 10.1109/PROC.1974.9651 (the coefficients and their
continuity); Luebbers, IEEE Trans. Antennas Propag. 32 (1984) 70, doi 10.1109/TAP.1984.1143189 (finite conductivity).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.special import wofz

from ...common.units import ComplexArray, FloatArray
from .fresnel import coefficients


def wedge(
    phi_in: FloatArray, phi_out: FloatArray, cos_beta: FloatArray, exterior: FloatArray, distance: FloatArray,
    face_0: Any, face_n: Any,
) -> tuple[ComplexArray, ComplexArray, ComplexArray]:  # fmt: skip
    """Diffraction matrix of a wedge in the edge-fixed basis.

    Source: Kouyoumjian and Pathak, Proc. IEEE 62 (1974), 1448-1461, doi:10.1109/PROC.1974.9651.

    Parameters
    ----------
    phi_in, phi_out : (...)
        Angles of source and target round the edge [rad], between 0 and ``exterior * pi``.
    cos_beta : (...)
        Cosine of the angle between ray and edge, the same on both sides (Keller's cone).
    exterior : (...)
        Exterior angle of the wedge over pi: 2 for a screen, 1.5 for the corner of a box.
    distance : (...)
        ``k s s' sin_beta^2 / (s + s')`` for a point source: the distance parameter times the wave number.
    face_0, face_n : tuple of 3 (...)
        Permittivity (real and imaginary part) and thickness in wavelengths of the two faces.

    Returns
    -------
    bb, bp, pp : (...) complex
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
    shadow = edge_term(np.pi + less, exterior, distance) + edge_term(np.pi - less, exterior, distance)
    at_n, at_0 = edge_term(np.pi + more, exterior, distance), edge_term(np.pi - more, exterior, distance)
    upright, across = obliquity(phi_in, phi_out, exterior)
    # of grazing incidence, which is the cosine from the normal that Fresnel's formulas take
    sine = upright * np.sqrt(1.0 - cos_beta * cos_beta)
    # from face n both the angles and the edge run the other way, which leaves the matrix as it is
    te, tm = 0.0, 0.0
    for term, face in ((at_n, face_n), (at_0, face_0)):
        te_re, te_im, tm_re, tm_im = coefficients(sine, face)
        te, tm = te + term * (te_re + 1j * te_im), tm + term * (tm_re + 1j * tm_im)
    # angle between the edge-fixed basis and the plane of incidence, whose unit normal is sigma
    askew = cos_beta * upright  # as across, times the sine of incidence: -(sigma . phi) and -(sigma . beta)
    size = across * across + askew * askew
    # along the edge itself both are zero: any plane of incidence will do
    weight = 1.0 / np.where(size == 0.0, 1.0, size)
    along, mixed, sideways = np.where(size == 0.0, 1.0, across * across * weight), across * askew * weight, askew**2
    sideways = sideways * weight
    # -e^{-j pi/4} / (2 sqrt(2 pi)) = (j - 1) / (4 sqrt(pi))
    scale = (1j - 1.0) * 0.25 / np.sqrt(np.pi) / (exterior * np.sqrt(1.0 - cos_beta * cos_beta))
    return (
        np.asarray(scale * (shadow + te * along - tm * sideways)),
        np.asarray(scale * (te + tm) * mixed),
        np.asarray(scale * (shadow + tm * along - te * sideways)),
    )


def obliquity(phi_in: FloatArray, phi_out: FloatArray, exterior: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Sine and cosine of the angle under which the faces of a wedge are taken to be hit, in the plane across the edge.

    Away from the reflection boundary no angle of incidence is given. Taken is that on the mirror through the edge
    which would send the ray to the target, half of ``pi - less``, times a factor that is 1 on both reflection
    boundaries (continuity), the same both ways (reciprocity), and 0 where source or target lies in a face: there the
    field of a face that does not conduct perfectly vanishes.

    Parameters
    ----------
    phi_in, phi_out, exterior : (...)
        As for :func:`wedge`.

    Returns
    -------
    upright, across : (...)
        The sine is never negative: cos(less / 2) alone would change its sign, and the wave that a face turns from one
        polarisation into the other with it, where the target enters the shadow.
    """
    less = phi_out - phi_in
    up, down = (np.abs(np.sin((np.pi + turn) / (2.0 * exterior))) for turn in (less, -less))
    # source and target exchange up and down: the smaller and the larger do not
    near, far = np.minimum(up, down), np.maximum(up, down)
    # at the shadow boundary both go to 0; their ratio to the exterior angle over pi
    ratio = np.where(near < 1e-9, exterior, np.abs(np.cos(less / 2.0)) / np.maximum(near, 1e-9))
    lifted = np.sin(phi_in / exterior) * np.sin(phi_out / exterior) / np.maximum(far, 1e-9)
    return np.clip(ratio * lifted, 0.0, 1.0), np.sin(less / 2.0)


def edge_term(angle: FloatArray, exterior: FloatArray, distance: FloatArray) -> ComplexArray:
    """``cot(angle / 2n) F(x)``, whose pole at a shadow boundary F takes away.

    Round the edge the angle repeats every 2 pi n; measured from the nearest boundary the argument of F is
    ``x = 2 distance sin^2(angle / 2)``, so the factor sin(angle / 2) cancels the pole in closed form.

    Parameters
    ----------
    angle, exterior, distance : (...)
        Angle [rad]; exterior angle and distance as for :func:`wedge`.

    Returns
    -------
    (...) complex
    """
    turns = angle / (2.0 * np.pi * exterior)
    # to the nearest boundary: -0.5 and 0.5 are the same angle
    turns = turns - np.floor(turns + 0.5)
    above, below = np.abs(np.sin(np.pi * turns * exterior)), np.sin(np.pi * turns)
    # on the boundary itself the ray that grazes the edge counts as seen, so the limit is that of the lit side
    ratio = np.where(below == 0.0, exterior, above / np.where(below == 0.0, 1.0, below))
    # w of a root, not F of a square: wofz keeps its digits at zero and far away
    reach = np.sqrt(2.0 * distance)
    return np.asarray(transition(reach * above) * np.cos(np.pi * turns) * reach * ratio)


def transition(root: FloatArray) -> ComplexArray:
    """Transition function of Kouyoumjian and Pathak at ``x = root^2``, over ``root``.

    Source: Abramowitz and Stegun 7.1.3 (the Faddeeva function w).
    """
    return np.asarray(np.sqrt(np.pi) * np.exp(0.25j * np.pi) * wofz(np.exp(0.75j * np.pi) * root))
