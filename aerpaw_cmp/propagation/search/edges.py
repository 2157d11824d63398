"""Paths over edges of buildings.

A path runs from the source, or its image in the ground, to the point of the edge where both legs make the same angle
with it (Keller's cone), and on to the target or its image in the ground. It exists when that point lies on the edge,
both legs are free, and the point is on no other building's wall or inside one. Over two edges of one plane face it runs
along that face between them, where it is straight once both legs are turned into the plane of the face.

Small jobs over single edges run in NumPy here, all others in :mod:`aerpaw_cmp.propagation.search.edge_kernels`.
"""

from __future__ import annotations

import itertools
from types import ModuleType
from typing import Any

import numpy as np
import shapely

from ...common.jsonable import named
from ...common.units import BoolArray, FloatArray, IntArray
from .. import compiled
from ..edges import NEAREST_M, EdgePaths, Edges
from ..faces import inside
from ..paths import Faces, legs
from ..surfaces import Surfaces
from .mirror import scene_tolerance_m
from .occlusion import Occlusion

# How far beside an edge point the air on both of its faces is looked for.
PROBE_M = 1e-3

# Place of boxes that no segment meets.
FAR_M = 1e7

# Pairs of edge and pose that are looked at together.
LINKS_AT_ONCE = 200_000

# Poses whose compiled search one thread takes at once.
POSES_PER_PART = 256


def find_edge_paths(
    edges: Edges,
    faces: Faces,
    ends: tuple[FloatArray, FloatArray],
    usable: BoolArray,
    excluded: BoolArray,
    *,
    surfaces: Surfaces | None = None,
    every: bool = False,
    threads: int | None = None,
) -> EdgePaths:
    """Paths over edges, with at most one ground reflection on either side.

    Parameters
    ----------
    edges : Edges
    faces : Faces
    ends : (towers, 3), (poses, 3)
        Sources and targets [m].
    usable : (towers, faces) bool
        Faces that may reflect for each tower; its ground planes are meant.
    excluded : (towers, poses) bool
        Links without any path.
    surfaces : Surfaces, optional
        Of a scene of triangles: its ground is the face below each end.
    every : bool
        Also with one wall or roof before or after the edge, and over two edges of one face.
    threads : int, optional
        Of compiled code.

    Returns
    -------
    EdgePaths

    Raises
    ------
    UsageError
        If compiled code is asked for that does not run.
    """
    sources, targets = ends
    candidates = len(edges) * excluded.size * (len(faces) if every else 4)
    kernels = compiled.edges_for(candidates, needed=every or surfaces is not None) if len(edges) else None
    if kernels is not None:
        return _compiled(kernels, edges, faces, ends, (usable, excluded), surfaces, every, threads)
    known = targets[np.isfinite(targets).all(axis=1)]
    hiding = Occlusion(faces, scene_tolerance_m(faces, sources, known))
    exposed = _Exposed(faces, edges, hiding)
    pieces = [EdgePaths.of(np.zeros((0, 8), np.int64), np.zeros((0, 4, 3)))]
    for tower, source in enumerate(sources):
        grounds = [-1, *np.flatnonzero(usable[tower] & (faces.solid < 0)).tolist()]
        for mirrors in itertools.product(grounds, grounds) if len(edges) else ():
            pieces += _over_edges(faces, edges, source, targets, ~excluded[tower], mirrors, exposed, tower)
    return _sorted(pieces)


def _sorted(pieces: list[EdgePaths]) -> EdgePaths:
    """Pieces as one, by pose, tower, edges and mirrors."""
    paths = EdgePaths.one_after_another(pieces)
    before, after = paths.ground.T
    last, first = paths.edge.T[::-1]
    return paths.select(np.lexsort((after, before, first, last, paths.tower, paths.pose)))


def _compiled(
    kernels: ModuleType,
    edges: Edges,
    faces: Faces,
    ends: tuple[FloatArray, FloatArray],
    rules: tuple[BoolArray, BoolArray],
    surfaces: Surfaces | None,
    every: bool,
    threads: int | None,
) -> EdgePaths:
    (usable, excluded), (sources, targets) = rules, (np.ascontiguousarray(end) for end in ends)
    poses = np.flatnonzero(np.isfinite(targets).all(axis=1))
    hiding = Occlusion(faces, scene_tolerance_m(faces, sources, targets[poses])) if surfaces is None else None
    bends = _bends(kernels, edges, faces, ends, usable, surfaces, every)
    mirrors = _mirrors(kernels, faces, surfaces)
    solids = _solids(kernels, hiding, surfaces)
    parts = [poses[k : k + POSES_PER_PART] for k in range(0, len(poses), POSES_PER_PART)]
    rows = compiled.in_threads(
        lambda part: kernels.search(bends, mirrors, solids, sources, targets, excluded, part), parts, threads
    )
    none = np.zeros((0, 8), np.int64), np.zeros((0, 4, 3))
    index, vertices = (np.concatenate([n, *(row[i] for row in rows)]) for i, n in enumerate(none))
    paths = EdgePaths.of(index, vertices)
    if hiding is None:
        return paths
    good = _beyond_bounds(edges, faces, ends, hiding, paths)
    return paths if good.all() else paths.select(good)


def _beyond_bounds(
    edges: Edges, faces: Faces, ends: tuple[FloatArray, FloatArray], hiding: Occlusion, paths: EdgePaths
) -> BoolArray:
    """Paths (paths,) that hold by what compiled code does not ask: outlines of faces, seams and touching solids."""
    exposed, good = _Exposed(faces, edges, hiding), np.ones(len(paths), dtype=np.bool_)
    outlined = np.append([polygon is not None for polygon in faces.polygon], False)
    for side, corner in ((0, 0), (1, 3)):
        rows = np.flatnonzero(good & outlined[paths.ground[:, side]])
        good[rows] = inside(faces, paths.ground[rows, side], paths.vertices_m[rows, corner], 0.0)
    common = np.where(paths.edge[:, 1] >= 0, edges.face[paths.edge[:, 0], paths.shared[:, 0]], -1)
    for row in np.flatnonzero(good & outlined[common]):
        line = paths.vertices_m[row, 1:3]
        flat = np.column_stack([line @ faces.along[common[row]], line @ faces.across[common[row]]])
        good[row] = faces.polygon[common[row]].buffer(hiding.tolerance_m).covers(shapely.LineString(flat))  # type: ignore[union-attr]
    good[good] &= exposed.at(paths.edge[good, 0], paths.vertices_m[good, 1])
    rows = np.flatnonzero(good & (paths.edge[:, 1] >= 0))
    good[rows] &= exposed.at(paths.edge[rows, 1], paths.vertices_m[rows, 2])
    if any(any(pieces) for pieces in hiding.abutting):
        rows = np.flatnonzero(good)
        sources, targets = ends
        for start, end in legs(sources[paths.tower[rows]], paths.vertices_m[rows], targets[paths.pose[rows]]):
            good[rows] &= ~hiding.segments(start, end)
    return good


def _bends(
    kernels: ModuleType,
    edges: Edges,
    faces: Faces,
    ends: tuple[FloatArray, FloatArray],
    usable: BoolArray,
    surfaces: Surfaces | None,
    every: bool,
) -> Any:
    """Edges, pairs and mirrors as compiled code takes them."""
    if surfaces is None:
        wall = faces.solid >= 0
        plane = usable & ~wall[None, :]
        ground_t = np.where(plane.any(axis=1), plane.argmax(axis=1), -1)
        ground_p = np.full(len(ends[1]), -2, dtype=np.int64)
    else:
        ground_t, ground_p = (_below(surfaces, points) for points in ends)
        wall = np.ones(len(faces), dtype=np.bool_)
        wall[[*ground_t[ground_t >= 0], *ground_p[ground_p >= 0]]] = False
    grounds = np.unique(np.append(ground_t, ground_p))
    options = np.append(-1, np.arange(len(faces)) if every else grounds[grounds >= 0])
    pair, shared = edges.pairs() if every else (np.zeros((0, 2), np.int64),) * 2
    inward = np.stack([edges.face_axis, np.cross(edges.along, edges.normal_n)], axis=1)
    (e, g), (side, far) = pair.T, shared.T
    apart, in_e, in_g = edges.start_m[g] - edges.start_m[e], inward[e, side], inward[g, far]
    turn = [(v * axis).sum(axis=1) for axis in (edges.along[e], in_e) for v in (apart, edges.along[g], -in_g)]
    return kernels.Bends(
        start=edges.start_m,
        along=edges.along,
        axis=edges.face_axis,
        out=edges.normal,
        out_n=edges.normal_n,
        length=edges.length_m,
        exterior=edges.exterior,
        face=np.ascontiguousarray(edges.face),
        options=options,
        ways=np.argwhere(~((options[:, None] >= 0) & (options >= 0) & (wall[options][:, None] | wall[options]))),
        ground_t=ground_t,
        ground_p=ground_p,
        wall=wall,
        pair=np.ascontiguousarray(pair),
        shared=np.ascontiguousarray(shared),
        turn=np.column_stack(turn),
    )


def _mirrors(kernels: ModuleType, faces: Faces, surfaces: Surfaces | None) -> Any:
    none = np.zeros(0, np.int64), np.zeros((0, 3, 2))
    first, flat = none if surfaces is None else (surfaces.first, surfaces.flat_m)
    return kernels.Mirrors(
        offset=faces.offset_m, first=first, flat=flat, **named(faces, "normal along across lower upper")
    )


def _solids(kernels: ModuleType, hiding: Occlusion | None, surfaces: Surfaces | None) -> Any:
    from .beams import Rules  # compiled
    from .boxtree import box_tree

    rules = Rules(1, 0.0 if surfaces is None else 2.0 * surfaces.merge_m)
    if surfaces is not None:
        return kernels.Solids(
            normal=np.zeros((0, 3)),
            offset=np.zeros(0),
            first=np.zeros(1, np.int64),
            tolerance=0.0,
            boxes=np.zeros((0, 6, kernels.LEAF)),
            block=np.zeros(0, np.int64),
            corners=surfaces.corners_m,
            tree=surfaces.tree,
            rules=rules,
            triangles=True,
        )
    assert hiding is not None
    planes = [piece for pieces in hiding.pieces for piece in pieces]
    solid = np.repeat(np.arange(len(hiding.pieces)), [len(pieces) for pieces in hiding.pieces])
    tree = box_tree(hiding.low[solid], hiding.high[solid], kernels.LEAF)
    solid, planes = solid[tree.items], [planes[k] for k in tree.items]
    leaves = np.flatnonzero(tree.child < 0)
    block, boxes = np.cumsum(tree.child < 0) - 1, np.full((len(leaves), 6, kernels.LEAF), FAR_M)
    for row, first, many in zip(boxes, tree.start[leaves], tree.many[leaves], strict=True):
        part = solid[first : first + many]
        row[:, :many] = np.hstack([hiding.low[part], hiding.high[part]]).T
    return kernels.Solids(
        normal=np.concatenate([normal for normal, _ in planes]),
        offset=np.concatenate([offset for _, offset in planes]),
        first=np.cumsum([0, *(len(offset) for _, offset in planes)]),
        tolerance=hiding.tolerance_m,
        boxes=boxes,
        block=block,
        corners=np.zeros((0, 3, 3)),
        tree=tree._replace(items=np.arange(len(planes))),
        rules=rules,
        triangles=False,
    )


def _below(surfaces: Surfaces, points_m: FloatArray) -> IntArray:
    """Face of the first triangle below each point; -1 where there is none."""
    corners, ground = surfaces.corners_m, np.full(len(points_m), -1, dtype=np.int64)
    side, last = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = side[:, 0] * last[:, 1] - side[:, 1] * last[:, 0]
    rows = np.flatnonzero(np.abs(area) > 1e-9)
    side, last, area, corner, face = side[rows], last[rows], area[rows], corners[rows, 0], surfaces.face[rows]
    for number, point in enumerate(points_m):
        if not np.isfinite(point).all():
            continue
        x, y = point[0] - corner[:, 0], point[1] - corner[:, 1]
        u, v = (x * last[:, 1] - y * last[:, 0]) / area, (side[:, 0] * y - side[:, 1] * x) / area
        height = corner[:, 2] + u * side[:, 2] + v * last[:, 2]
        under = (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1.0 + 1e-9) & (height < point[2])
        if under.any():
            ground[number] = face[np.flatnonzero(under)[height[under].argmax()]]
    return ground


class _Exposed:
    """Test of whether both faces of an edge are in the air at a point: another building may touch one of them."""

    def __init__(self, faces: Faces, edges: Edges, hiding: Occlusion) -> None:
        numbers = np.unique(faces.solid[faces.solid >= 0])
        solid = np.searchsorted(numbers, faces.solid[edges.face[:, 0]])
        low = np.minimum(edges.start_m, edges.end_m) - 2.0 * PROBE_M
        high = np.maximum(edges.start_m, edges.end_m) + 2.0 * PROBE_M
        touch = (hiding.low[None] <= high[:, None]) & (hiding.high[None] >= low[:, None])
        near = np.asarray(touch.all(axis=2))
        near[np.arange(len(edges)), solid] = False
        self.doubtful = np.asarray(near.any(axis=1))
        axis_n = np.cross(edges.along, edges.normal_n)
        self.sides = np.stack([edges.face_axis + 0.1 * edges.normal, axis_n + 0.1 * edges.normal_n], axis=1)
        self.hiding = hiding

    def at(self, edge: IntArray, points_m: FloatArray) -> BoolArray:
        """Check whether points (paths, 3) of edges (paths,) have air beside both faces."""
        good = np.ones(len(edge), dtype=np.bool_)
        rows = np.flatnonzero(self.doubtful[edge])
        for side in (0, 1):
            step = PROBE_M * self.sides[edge[rows], side]
            good[rows] &= ~self.hiding.segments(points_m[rows] + 0.5 * step, points_m[rows] + step)
        return good


def _over_edges(
    faces: Faces,
    edges: Edges,
    source_m: FloatArray,
    targets_m: FloatArray,
    alive: BoolArray,
    ground: tuple[int, int],
    exposed: _Exposed,
    tower: int,
) -> list[EdgePaths]:
    """Paths of one tower with the given ground reflections before and after the edge."""
    poses = np.flatnonzero(alive & np.isfinite(targets_m).all(axis=1))
    images = (source_m, targets_m[poses])
    source, ends = (p if face < 0 else faces.mirrored(face, p) for face, p in zip(ground, images, strict=True))
    at_source, near = (part[:, 0] for part in _round_edges(edges, source[None]))
    lit = np.flatnonzero(near >= 0.0)
    pieces = []
    step = max(1, LINKS_AT_ONCE // max(1, len(lit)))
    for first in range(0, len(poses), step):
        some = ends[first : first + step]
        at_target, far = (part[lit].T for part in _round_edges(edges, some))
        at = at_source[lit] + (at_target - at_source[lit]) * (near[lit] / (near[lit] + far))
        good = (at >= 0.0) & (at <= edges.length_m[lit]) & (far >= 0.0)
        row, column = np.nonzero(good)
        edge, pose = lit[column], poses[first + row]
        point = edges.start_m[edge] + at[row, column][:, None] * edges.along[edge]
        bounce = [_on_ground(faces, index, end, point) for index, end in zip(ground, (source, some[row]), strict=True)]
        vertices = np.stack([bounce[0], point, np.full_like(point, np.nan), bounce[1]], axis=1)
        good = np.ones(len(pose), np.bool_)
        for index, spot, end in zip(ground, bounce, (source_m, targets_m[pose]), strict=True):
            if index >= 0:
                good &= (faces.height_m(index, point) > NEAREST_M) & (faces.height_m(index, end) > 0.0)
                rows = np.flatnonzero(good)
                good[rows] = inside(faces, np.full(len(rows), index), spot[rows], 0.0)
        good[good] &= exposed.at(edge[good], point[good])
        for leg in legs(source_m, vertices, targets_m[pose]):
            good[good] &= ~exposed.hiding.segments(leg[0][good], leg[1][good])
        rows = np.zeros((int(good.sum()), 8), dtype=np.int64)
        rows[:, 0], rows[:, 1], rows[:, 2], rows[:, 3], rows[:, 6:] = pose[good], tower, edge[good], -1, ground
        pieces.append(EdgePaths.of(rows, vertices[good]))
    return pieces


def _round_edges(edges: Edges, points_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Places (edges, points) along edges and distances from them; -1 inside the wedge or too near."""
    axes = np.stack([edges.along, edges.face_axis, edges.normal, edges.normal_n])
    start = (axes * edges.start_m).sum(axis=2)
    along, down, up, up_n = axes @ points_m.T - start[..., None]
    far = np.hypot(down, up)
    return along, np.where((far >= NEAREST_M) & ((up >= 0.0) | (up_n >= 0.0)), far, -1.0)


def _on_ground(faces: Faces, ground: int, image_m: FloatArray, points_m: FloatArray) -> FloatArray:
    """Points where the lines from images to points (paths, 3) pass a ground plane; NaN for -1."""
    if ground < 0:
        return np.full_like(points_m, np.nan)
    below, above = faces.height_m(ground, image_m), faces.height_m(ground, points_m)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.asarray(below / (below - above))
    return np.asarray(image_m + share[..., None] * (points_m - image_m))
