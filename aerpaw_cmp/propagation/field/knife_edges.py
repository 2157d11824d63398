"""Loss of knife edges across a straight line: the detours over and around a wood."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...common.units import FloatArray


class Profile(NamedTuple):
    """Edges under straight lines, a column of samples each.

    ``length_m`` (links,) is that of the lines, ``share`` (samples, links) the part of the way to each sample,
    ``intrusion_m`` the height of the edge above the line there, NaN where it is unknown.
    """

    length_m: FloatArray
    share: FloatArray
    intrusion_m: FloatArray


def knife_edge_db(nu: FloatArray) -> FloatArray:
    """Loss of one knife edge [dB] by its parameter nu; 0 below -0.78.

    Source: ITU-R P.526-15 eq. 31.
    """
    # far below -0.78 the root of x squared loses all digits beside x
    x = np.maximum(nu, -0.78) - 0.1
    return np.where(nu > -0.78, np.maximum(6.9 + 20.0 * np.log10(np.sqrt(x * x + 1.0) + x), 0.0), 0.0)


def _parameter(height_m: FloatArray, before_m: FloatArray, after_m: FloatArray, wavelength_m: float) -> FloatArray:
    """Parameter nu of edges; -inf at the ends of a line and where the height is unknown."""
    # an edge at an end has no distance to it, and nu would be infinite
    inner = (before_m > 0.0) & (after_m > 0.0) & np.isfinite(height_m)
    product = np.where(inner, before_m * after_m, 1.0)
    nu = np.where(inner, height_m, 0.0) * np.sqrt(2.0 * np.abs(before_m + after_m) / (wavelength_m * product))
    return np.where(inner, nu, -np.inf)


def deygout_db(profile: Profile, wavelength_m: float) -> FloatArray:
    """Loss (links,) [dB] of up to three edges by Deygout's construction with Causebrook's correction.

    Sources: Deygout, IEEE Trans. Antennas Propag. 14 (1966) 480, doi 10.1109/TAP.1966.1138719; Causebrook and Davis,
    BBC Research Department report 1971/43, eq. 13 to 15.

    Notes
    -----
    ``A + (A_1 - C_1) + (A_2 - C_2)``: the main edge and the main one of each side on the way to it, less
    ``C = (6 - A + A_e) cos(alpha)``, with A_e the loss of the side's edge alone on the direct line and
    ``cos(alpha)^2 = d_1 d_34 / (d_12 d_234)``; neither term is negative.
    """
    length_m, share, intrusion_m = profile
    nu = _parameter(intrusion_m, share * length_m, (1.0 - share) * length_m, wavelength_m)
    main, link = nu.argmax(axis=0), np.arange(len(length_m))
    total = first = knife_edge_db(nu[main, link])
    known = np.isfinite(nu[main, link])
    # without an edge any place does: its loss is zero
    at, top = np.where(known, share[main, link], 0.5), np.where(known, intrusion_m[main, link], 0.0)
    for way, place in ((share, at), (1.0 - share, 1.0 - at)):
        # above the line from the end to the top of the main edge
        height = intrusion_m - top * way / place
        side = _parameter(height, way * length_m, (place - way) * length_m, wavelength_m)
        edge = side.argmax(axis=0)
        s = np.clip(way[edge, link], 0.0, place)
        cosine = np.sqrt(s * (1.0 - place) / (place * (1.0 - s)))
        correction = np.maximum(6.0 - first + knife_edge_db(nu[edge, link]), 0.0) * cosine
        total = total + np.maximum(knife_edge_db(side[edge, link]) - correction, 0.0)
    return np.asarray(total)
