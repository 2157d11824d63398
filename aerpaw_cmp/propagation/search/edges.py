"""Paths over one edge of a building.

A path runs from the source, or its image in the ground, to the point of the edge where both legs make the same angle
with it (Keller's cone), and on to the target or its image in the ground. It exists when that point lies on the edge,
both legs are free, and the point is on no other building's wall or inside one.
"""

from __future__ import annotations

import itertools
from dataclasses import fields

import numpy as np

from ...common.units import BoolArray, FloatArray, IntArray
from ..edges import EdgePaths, Edges
from ..faces import inside
from ..paths import Faces
from .mirror import scene_tolerance_m
from .occlusion import Occlusion

PROBE_M = 1e-3
"""How far beside an edge point the air on both of its faces is looked for."""

NEAREST_M = 0.01
"""An end nearer than this to an edge has no path over it: there is no far field."""

LINKS_AT_ONCE = 200_000
"""Pairs of edge and pose that are looked at together."""


def find_edge_paths(
    faces: Faces,
    edges: Edges,
    sources_m: FloatArray,
    targets_m: FloatArray,
    usable: BoolArray,
    excluded: BoolArray,
    walls: bool = False,
) -> EdgePaths:
    """All paths over one edge, with at most one ground reflection on either side of it.

    Parameters
    ----------
    faces : Faces
    edges : Edges
    sources_m, targets_m : (towers, 3), (poses, 3)
    usable : (towers, faces) bool
        Faces that may reflect for each tower; its ground planes are meant.
    excluded : (towers, poses) bool
        Links without any path.
    walls : bool
        Also with one wall or roof, before or after the edge.

    Returns
    -------
    EdgePaths
    """
    known = targets_m[np.isfinite(targets_m).all(axis=1)]
    hiding = Occlusion(faces, scene_tolerance_m(faces, sources_m, known))
    exposed = _Exposed(faces, edges, hiding)
    solid = np.flatnonzero(faces.solid >= 0).tolist() if walls else []
    pieces = []
    for tower, source in enumerate(sources_m):
        grounds = [-1, *np.flatnonzero(usable[tower] & (faces.solid < 0)).tolist()]
        sides = [*itertools.product(grounds, grounds), *((w, -1) for w in solid), *((-1, w) for w in solid)]
        for mirrors in sides if len(edges) else ():
            pieces += _over_edges(faces, edges, source, targets_m, ~excluded[tower], mirrors, hiding, exposed, tower)
    if not pieces:
        none = np.zeros(0, dtype=np.int64)
        return EdgePaths(none, none, none, np.zeros((0, 2), np.int64), np.zeros((0, 3, 3)))
    columns = {f.name: np.concatenate([getattr(p, f.name) for p in pieces]) for f in fields(EdgePaths)}
    before, after = columns["ground"].T
    order = np.lexsort((after, before, columns["edge"], columns["tower"], columns["pose"]))
    return EdgePaths(**{name: column[order] for name, column in columns.items()})


class _Exposed:
    """Whether both faces of an edge are in the air at a point: another building may touch one of them."""

    def __init__(self, faces: Faces, edges: Edges, hiding: Occlusion) -> None:
        own = np.unique(faces.solid[faces.solid >= 0])
        solid = np.searchsorted(own, faces.solid[edges.face[:, 0]])
        low = np.minimum(edges.start_m, edges.end_m) - 2.0 * PROBE_M
        high = np.maximum(edges.start_m, edges.end_m) + 2.0 * PROBE_M
        touch = (hiding.low[None] <= high[:, None]) & (hiding.high[None] >= low[:, None])
        near = np.asarray(touch.all(axis=2))
        near[np.arange(len(edges)), solid] = False
        self.doubtful = np.asarray(near.any(axis=1))
        axis_n = np.cross(edges.along, edges.normal_n)
        self.beside = np.stack([edges.face_axis + 0.1 * edges.normal, axis_n + 0.1 * edges.normal_n], axis=1)
        self.hiding = hiding

    def at(self, edge: IntArray, points_m: FloatArray) -> BoolArray:
        """Which points (paths, 3) of edges (paths,) have air beside both faces."""
        good = np.ones(len(edge), dtype=np.bool_)
        rows = np.flatnonzero(self.doubtful[edge])
        for side in (0, 1):
            step = PROBE_M * self.beside[edge[rows], side]
            good[rows] &= ~self.hiding.segments(points_m[rows] + 0.5 * step, points_m[rows] + step)
        return good


def _over_edges(
    faces: Faces,
    edges: Edges,
    source_m: FloatArray,
    targets_m: FloatArray,
    alive: BoolArray,
    ground: tuple[int, int],
    hiding: Occlusion,
    exposed: _Exposed,
    tower: int,
) -> list[EdgePaths]:
    """Paths of one tower with the given ground reflections before and after the edge."""
    poses = np.flatnonzero(alive & np.isfinite(targets_m).all(axis=1))
    source = _mirrored(faces, ground[0], source_m)
    ends = _mirrored(faces, ground[1], targets_m[poses])
    here = edges.coordinates(np.broadcast_to(source, (len(edges), 1, 3)), np.arange(len(edges)))[:, 0]
    radius = np.hypot(here[:, 1], here[:, 2])
    lit = np.flatnonzero((radius >= NEAREST_M) & _in_air(edges, source[None], here[:, 2]))
    pieces = []
    step = max(1, LINKS_AT_ONCE // max(1, len(lit)))
    for first in range(0, len(poses), step):
        some = ends[first : first + step]
        there = edges.coordinates(np.broadcast_to(some, (len(lit), *some.shape)), lit).swapaxes(0, 1)
        reach = np.hypot(there[..., 1], there[..., 2])
        at = here[lit, 0] + (there[..., 0] - here[lit, 0]) * (radius[lit] / (radius[lit] + reach))
        good = (at >= 0.0) & (at <= edges.length_m[lit]) & (reach >= NEAREST_M)
        good &= _in_air(edges, some[:, None], there[..., 2], lit)
        row, column = np.nonzero(good)
        edge, pose = lit[column], poses[first + row]
        point = edges.start_m[edge] + at[row, column][:, None] * edges.along[edge]
        bounce = [_on_ground(faces, index, end, point) for index, end in zip(ground, (source, some[row]), strict=True)]
        vertices = np.stack([bounce[0], point, bounce[1]], axis=1)
        good = np.ones(len(pose), np.bool_)
        for index, spot, end in zip(ground, bounce, (source_m, targets_m[pose]), strict=True):
            if index >= 0:
                normal, offset = faces.normal[index], faces.offset_m[index]
                good &= (point @ normal - offset > NEAREST_M) & (end @ normal - offset > 0.0)
                rows = np.flatnonzero(good)
                good[rows] = inside(faces, np.full(len(rows), index), spot[rows], 0.0)
        good[good] &= exposed.at(edge[good], point[good])
        for leg in _legs(source_m, vertices, targets_m[pose]):
            good[good] &= ~hiding.segments(leg[0][good], leg[1][good])
        count = int(good.sum())
        pieces.append(
            EdgePaths(
                pose[good], np.full(count, tower), edge[good], np.tile(np.array(ground), (count, 1)), vertices[good]
            )
        )
    return pieces


def _legs(source_m: FloatArray, vertices_m: FloatArray, targets_m: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
    """Straight pieces of the paths; where no ground point is, its leg is from the edge point to itself."""
    before, point, after = (vertices_m[:, i] for i in range(3))
    has_before, has_after = np.isfinite(before[:, :1]), np.isfinite(after[:, :1])
    start = np.broadcast_to(source_m, point.shape)
    return [
        (np.where(has_before, before, start), point),
        (np.where(has_before, start, point), np.where(has_before, before, point)),
        (point, np.where(has_after, after, targets_m)),
        (np.where(has_after, after, point), np.where(has_after, targets_m, point)),
    ]


def _in_air(
    edges: Edges, points_m: FloatArray, height_m: FloatArray, some: IntArray | slice = slice(None)
) -> BoolArray:
    """Points outside the wedge: before face 0 (``height_m``) or before face n."""
    over_n = ((points_m - edges.start_m[some]) * edges.normal_n[some]).sum(axis=-1)
    return np.asarray((height_m >= 0.0) | (over_n >= 0.0))


def _mirrored(faces: Faces, ground: int, points_m: FloatArray) -> FloatArray:
    """Points (..., 3) mirrored in a ground plane; as they are for -1."""
    if ground < 0:
        return points_m
    normal = faces.normal[ground]
    return np.asarray(points_m - 2.0 * (points_m @ normal - faces.offset_m[ground])[..., None] * normal)


def _on_ground(faces: Faces, ground: int, image_m: FloatArray, points_m: FloatArray) -> FloatArray:
    """Where the lines from images to points (paths, 3) pass a ground plane; NaN for -1."""
    if ground < 0:
        return np.full_like(points_m, np.nan)
    normal, offset = faces.normal[ground], faces.offset_m[ground]
    below, above = image_m @ normal - offset, points_m @ normal - offset
    with np.errstate(divide="ignore", invalid="ignore"):
        share = below / (below - above)
    return np.asarray(image_m + np.asarray(share)[..., None] * (points_m - image_m))
