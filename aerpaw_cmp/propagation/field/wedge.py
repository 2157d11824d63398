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

from collections.abc import Callable

import numpy as np
from scipy.special import wofz

from ...common.units import ComplexArray, FloatArray

Fresnel = Callable[[FloatArray], tuple[ComplexArray, ComplexArray]]
"""Reflection coefficients (TE, TM) of a face at a cosine of the angle of incidence."""


def wedge_matrix(
    phi_in: FloatArray,
    phi_out: FloatArray,
    cos_beta: FloatArray,
    exterior: FloatArray,
    distance: FloatArray,
    fresnel_0: Fresnel,
    fresnel_n: Fresnel,
) -> ComplexArray:
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
    fresnel_0, fresnel_n : callable
        Reflection coefficients of the two faces.

    Returns
    -------
    (..., 2, 2) complex
        Over (after, before) and (beta, phi), times the square root of the wave number: a wave of amplitude
        ``e^{-j k s'} / s'`` at the edge leaves ``matrix / sqrt(k) * sqrt(s' / (s (s + s'))) e^{-j k s}`` of it.

    Notes
    -----
    ``-e^{-j pi/4} / (2 n sqrt(2 pi) sin_beta) [(T(pi + d) + T(pi - d)) I + T(pi + u) R_n + T(pi - u) R_0]`` with
    ``d = phi_out - phi_in``, ``u = phi_out + phi_in`` and ``T(x) = cot(x / 2n) F(2 distance cos^2(...))`` (Kouyoumjian
    and Pathak, eq. 25). Matrices ``R`` of the faces stand in place of Luebbers' plus and minus one, so that a screen
    that conducts perfectly is theirs, and the sum with direct and reflected waves is continuous at any obliquity.
    """
    sin_beta = np.sqrt(1.0 - cos_beta**2)
    less, more = phi_out - phi_in, phi_out + phi_in
    straight = _term(np.pi + less, exterior, distance) + _term(np.pi - less, exterior, distance)
    face_0 = _face_matrix(less, cos_beta, fresnel_0)
    # from face n both the angles and the edge run the other way, which leaves the matrix as it is
    face_n = _face_matrix(less, cos_beta, fresnel_n)
    matrix = straight[..., None, None] * np.eye(2)
    matrix = matrix + _term(np.pi + more, exterior, distance)[..., None, None] * face_n
    matrix = matrix + _term(np.pi - more, exterior, distance)[..., None, None] * face_0
    scale = -np.exp(-0.25j * np.pi) / (2.0 * exterior * np.sqrt(2.0 * np.pi) * sin_beta)
    return np.asarray(scale[..., None, None] * matrix)


def _term(angle: FloatArray, exterior: FloatArray, distance: FloatArray) -> ComplexArray:
    """``cot(angle / 2n) F(x)``, whose pole at a shadow boundary the transition function F takes away.

    Round the edge the angle repeats every 2 pi n; measured from the nearest boundary the argument of F is
    ``x = 2 distance sin^2(angle / 2)``. ``F(x) = sqrt(pi x) e^{j pi/4} w(e^{j 3 pi/4} sqrt(x))`` with the Faddeeva
    function w (Abramowitz and Stegun 7.1.3), so the factor sin(angle / 2) cancels the pole in closed form.
    """
    period = 2.0 * np.pi * exterior
    nearest = angle - period * np.round(angle / period)
    sine, below = np.abs(np.sin(0.5 * nearest)), np.sin(0.5 * nearest / exterior)
    # on the boundary itself the ray that grazes the edge counts as seen, so the limit is that of the lit side
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.where(below == 0.0, exterior, sine / below)
    root = np.sqrt(2.0 * distance) * sine
    transition = np.sqrt(2.0 * np.pi * distance) * np.exp(0.25j * np.pi) * wofz(np.exp(0.75j * np.pi) * root)
    return np.asarray(np.cos(0.5 * nearest / exterior) * ratio * transition)


def _face_matrix(less: FloatArray, cos_beta: FloatArray, fresnel: Fresnel) -> ComplexArray:
    """Reflection at a face as a matrix (..., 2, 2) in the edge-fixed basis.

    Away from the reflection boundary no angle of incidence is given. Taken is that on the mirror through the edge
    which would send the ray to the target: half of ``pi - less``, ``less`` being the angle from source to target round
    the edge. It is the face's own on its boundary (continuity) and the same both ways (reciprocity).
    """
    sin_beta = np.sqrt(1.0 - cos_beta**2)
    sine, cosine = np.cos(0.5 * less), np.sin(0.5 * less)  # of the grazing angle (pi - less) / 2
    te, tm = fresnel(np.abs(sine) * sin_beta)
    # angle between the edge-fixed basis and the plane of incidence, whose unit normal is sigma
    oblique = np.hypot(cos_beta, cosine * sin_beta)  # sine of the angle of incidence
    safe = np.where(oblique > 0.0, oblique, 1.0)
    along = np.where(oblique > 0.0, cosine / safe, 1.0)  # -(sigma . beta)
    askew = np.where(oblique > 0.0, cos_beta * sine / safe, 0.0)  # -(sigma . phi) before, its negative after
    mixed = (te + tm) * along * askew
    rows = [[te * along**2 - tm * askew**2, mixed], [-mixed, tm * along**2 - te * askew**2]]
    return np.asarray(np.moveaxis(np.array(rows), (0, 1), (-2, -1)))
