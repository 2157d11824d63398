"""Reason why open surfaces make no path: for explanations, one path at a time, every triangle tested in NumPy.

The same rules as the search in :mod:`aerpaw_cmp.propagation.search.beams`, by other code.
"""

from __future__ import annotations

import numpy as np

from ...common.units import FloatArray, IntArray
from ..geometry.paths import Surfaces

# A surface closer to an antenna than this hides nothing.
_NEAR_END_M = 1e-3


def why_not_there(surfaces: Surfaces, source_m: FloatArray, target_m: FloatArray, sequence: IntArray) -> str:
    """Give the reason why faces (depth,) make no path between two points; "" where they make one.

    Parameters
    ----------
    surfaces : Surfaces
    source_m, target_m : (3,)
        The two points [m].
    sequence : (depth,) int
        Faces from the source on; -1 is none.

    Returns
    -------
    str
        The first reason that was met.
    """
    from ..search.beams import EDGE_M, reflection_points  # compiled: loaded where there is a scene

    sequence = sequence[sequence >= 0]
    points = np.zeros((0, 3))
    if len(sequence):
        ends = source_m[None], target_m[None]
        _, _, ahead = reflection_points(surfaces, sequence[None], *ends, edge_m=1e9)
        if not ahead[0]:
            return "the ends of a reflection lie on two sides of its face"
        _, vertices, good = reflection_points(surfaces, sequence[None], *ends, edge_m=EDGE_M)
        if not good[0]:
            return f"a reflection point lies outside {surfaces.faces.label[int(sequence[0])]} or a later face"
        points = vertices[0]
    obstacle = _first_obstacle(surfaces, np.concatenate([source_m[None], points, target_m[None]]), sequence)
    return "" if obstacle is None else f"occluded by {surfaces.faces.label[obstacle]}"


def _first_obstacle(surfaces: Surfaces, corners_m: FloatArray, sequence: IntArray) -> int | None:
    """Face that cuts a path (corners, 3) over the faces ``sequence`` first, from the source; None where none does."""
    normal, offset = surfaces.faces.normal, surfaces.faces.offset_m
    for step in range(len(corners_m) - 1):
        a, b = corners_m[step], corners_m[step + 1]
        length = float(np.linalg.norm(b - a))
        face, share = _hits(surfaces, a, b)
        at = a + share[:, None] * (b - a)
        keep = np.ones(len(face), dtype=np.bool_)
        for end, mirror in ((a, step - 1), (b, step)):
            if 0 <= mirror < len(sequence):
                keep &= np.abs(at @ normal[sequence[mirror]] - offset[sequence[mirror]]) > 2.0 * surfaces.merge_m
            else:
                keep &= np.linalg.norm(at - end, axis=1) > _NEAR_END_M
        if length > 0.0 and keep.any():
            return int(face[keep][np.argmin(share[keep])])
    return None


def _hits(surfaces: Surfaces, a: FloatArray, b: FloatArray) -> tuple[IntArray, FloatArray]:
    """Faces whose triangles a segment meets, and where along it: Moeller and Trumbore (1997)."""
    corner = surfaces.corners_m
    edge, other_edge = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    across = np.cross(b - a, other_edge)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1.0 / np.einsum("ti,ti->t", edge, across)
        offset = a - corner[:, 0]
        u = np.einsum("ti,ti->t", offset, across) * inverse
        cross = np.cross(offset, edge)
        v = np.einsum("i,ti->t", b - a, cross) * inverse
        share = np.einsum("ti,ti->t", other_edge, cross) * inverse
        hit = (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1.0 + 1e-9) & (share > 0.0) & (share < 1.0)
    rows = np.flatnonzero(hit)
    return surfaces.face[rows], share[rows]
