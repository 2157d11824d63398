"""A compiled search for all specular paths among thousands of faces. The search extends sequences of faces along beams.

The source is mirrored at a first face. The beam from that image through the outline of the face is intersected with the
tree of faces. The faces that it hits are candidates for the second face, and so on. At each step, the side planes of
the beam select receivers from a separate tree. Side planes come from the last face, and, mirrored, from earlier faces.
For the remaining receivers, the search computes the reflection points, and checks whether each point lies in its face,
and whether a triangle cuts a segment. All cuts are conservative, so the paths do not depend on them. Pairs of faces are
processed one after the other, so that the memory does not grow with their number.

For thousands of prisms, compiled beams find candidates, which are then checked by the exact rules of the image engine.

The tolerances of the beams are a thousand times wider than those of the image engine. A candidate is rejected only if a
segment runs through the middle of a wall or roof. Nearly all remaining candidates are paths. The candidates are tested
as in :mod:`aerpaw_cmp.propagation.search.mirror`, so both searches find the same paths.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ...common.errors import UsageError
from ...common.units import BoolArray, FloatArray, IntArray
from .. import compiled
from ..compiled import kernel, part
from ..geometry import BoxTree, Faces, Links, PathSet, Surfaces, corners, triangles
from ..options import Run
from .merging import DEEPEST, WINDOW, box_outside, box_tree, next_leaf, within_planes
from .mirror import Occlusion, merge, planes_of, retraced, scene_tolerance_m, searched_links

# A point closer to a plane than this [m] is on the plane.
SIDE_M = 1e-6

# A surface closer to an antenna than this [m] does not hide the antenna, because the antenna is mounted on it.
_END_M = 1e-3

# Outlines of beams are enlarged by this [m], so that rounding does not remove a path.
SLACK_M = 1e-5

# Distance by which a reflection point may lie outside the triangles of its face [m], because of the seams between them.
EDGE_M = 1e-6

# A segment certainly cuts a triangle if it passes inside the edges by this share of the height of the triangle.
_SOLID_MARGIN = 1e-6


class _Mirrors(NamedTuple):
    """Faces in the form that the compiled code requires."""

    normal: FloatArray
    offset: FloatArray
    along: FloatArray
    across: FloatArray
    window: FloatArray
    plane: IntArray
    usable: BoolArray
    first: IntArray
    flat: FloatArray


class _Solids(NamedTuple):
    """Surfaces that block paths: the tree of faces, triangles (n, 3, 3) and their tree."""

    face_tree: BoxTree
    corners: FloatArray
    tree: BoxTree


class Rules(NamedTuple):
    """The depth and the tolerances of a search. A ``margin`` above 0 means that the faces belong to solids."""

    depth: int
    clearance: float
    margin: float = 0.0

    @classmethod
    def of(cls, surfaces: Surfaces, depth: int, *, solids: bool = False) -> Rules:
        """Return the rules for a search among surfaces."""
        return cls(depth, 2.0 * surfaces.merge_m, _SOLID_MARGIN if solids else 0.0)


def grow_paths(
    surfaces: Surfaces, links: Links, run: Run = Run(), *, max_depth: int = 2, solids: bool = False
) -> PathSet:
    """Return all paths with at most ``max_depth`` reflections.

    Parameters
    ----------
    surfaces : Surfaces
    links : Links
    run : Run
        Run options, used for the progress.
    max_depth : int
        Largest number of reflections, 0 to 3.
    solids : bool
        True if the faces belong to closed solids. Only their fronts reflect, and a segment is cut only if that is
        certain. The result contains candidates for :func:`find_paths`, including coincident paths.

    Returns
    -------
    PathSet
        Paths, sorted by pose, tower, depth and faces. Of several coincident paths, only one is included.
    """
    if not 0 <= max_depth <= 3:
        raise UsageError(f"max_depth {max_depth}", expected="0, 1, 2 or 3 reflections")
    faces, towers, threads = surfaces.faces, len(links.sources_m), compiled.thread_count()
    rules = Rules.of(surfaces, max_depth, solids=solids)
    hiding = _Solids(surfaces.face_tree, surfaces.corners_m, surfaces.tree)
    pieces: list[PathSet] = []
    alive = searched_links(links)
    # loop over towers, because they share a scene but have different usable faces
    for tower in np.flatnonzero(alive.any(axis=1)).tolist():
        poses, source = np.flatnonzero(alive[tower]), np.ascontiguousarray(links.sources_m[tower])
        mirrors = _mirrors(surfaces, None if links.usable is None else links.usable[tower])
        targets = np.ascontiguousarray(links.targets_m[poses])
        receivers = targets, box_tree(targets, targets)
        pose = np.flatnonzero(_direct(hiding, source, targets, rules))
        levels: list[_Level] = [(pose, np.zeros((len(pose), 0), np.int64), np.zeros((len(pose), 0, 3)))]
        height = faces.normal @ source - faces.offset_m
        # a sheet reflects on both sides, unless the source is in its plane. A solid reflects only on its outside.
        first = np.flatnonzero(mirrors.usable & (height >= -SIDE_M if solids else np.abs(height) > SIDE_M))
        # shuffle the faces, so that the reported progress grows evenly
        first = np.random.default_rng(0).permutation(first) if max_depth else first[:0]
        # use chunks that are small enough to balance the threads and large enough to make the cost of a call negligible
        each = max(16, min(1024, len(first) // (8 * threads) + 1))
        chunks = [first[at : at + each] for at in range(0, len(first), each)]
        for at in range(0, len(chunks), 4 * threads):
            # kernels release the interpreter's lock. The threads end here, so that none exists when the process is
            # forked later.
            with ThreadPoolExecutor(threads) as pool:
                follow = partial(_follow, mirrors, hiding, receivers, source, rules)
                levels += pool.map(follow, chunks[at : at + 4 * threads])
            if run.progress:
                run.progress((tower + min(1.0, (at + 4 * threads) / len(chunks))) / towers)
        pieces += [PathSet.from_tower(tower, poses[pose], met, at, max_depth) for pose, met, at in levels]
        if run.progress:
            run.progress((tower + 1) / towers)
    paths = merge(pieces, max_depth, None)
    return paths if solids else without_coincident(paths, surfaces)


# Receivers (n,), faces (n, depth), reflection points (n, depth, 3). Unused entries are face -1 with any point.
_Level = tuple[IntArray, IntArray, FloatArray]


def _mirrors(surfaces: Surfaces, usable: BoolArray | None = None) -> _Mirrors:
    faces = surfaces.faces
    return _Mirrors(
        normal=np.ascontiguousarray(faces.normal),
        offset=np.ascontiguousarray(faces.offset_m),
        along=np.ascontiguousarray(faces.along),
        across=np.ascontiguousarray(faces.across),
        window=surfaces.window_m,
        plane=surfaces.plane,
        usable=np.ones(len(faces), np.bool_) if usable is None else np.ascontiguousarray(usable),
        first=surfaces.first,
        flat=surfaces.flat_m,
    )


# Paths over parallel planes whose reflection points are all closer than this [m] are one path.
_COINCIDENT_M = 5e-3


def without_coincident(paths: PathSet, surfaces: Surfaces) -> PathSet:
    """Keep only one of several paths over the same planes, or over planes that differ by a few merge tolerances."""
    if not len(paths):
        return paths
    plane = np.append(surfaces.plane, -1)[paths.faces]
    key = np.column_stack([paths.pose, paths.tower, paths.depth, plane])
    # keep the first of equal paths. Paths are sorted, so the choice does not depend on threads.
    _, first = np.unique(key, axis=0, return_index=True)
    paths = paths.select(np.sort(first))
    # compare the remaining paths of each link in pairs
    order = np.lexsort((paths.depth, paths.tower, paths.pose))
    link = np.column_stack([paths.pose, paths.tower, paths.depth])[order]
    starts = np.flatnonzero(np.append(True, (link[1:] != link[:-1]).any(axis=1)))
    repeated = np.zeros(len(paths), dtype=np.bool_)
    for rows in np.split(order, starts[1:]):
        depth = int(paths.depth[rows[0]])
        # lines of sight have no reflection points to compare
        if len(rows) < 2 or not depth:
            continue
        points = paths.vertices_m[rows, :depth]
        apart = np.abs(points[:, None] - points[None]).max(axis=(2, 3))
        normal = surfaces.faces.normal[paths.faces[rows, :depth]]
        alike = (np.abs(np.einsum("akc,bkc->abk", normal, normal)) > 0.999).all(axis=2)
        first, second = np.nonzero(np.triu((apart < _COINCIDENT_M) & alike, 1))
        for i, j in zip(first, second, strict=True):
            if not repeated[rows[i]]:
                repeated[rows[j]] = True
    return paths.select(~repeated)


def reflection_points(
    surfaces: Surfaces, sequence: IntArray, sources_m: FloatArray, targets_m: FloatArray, *, edge_m: float
) -> tuple[IntArray, FloatArray, BoolArray]:
    """Return the reflection points of paths over given faces, in float64.

    Parameters
    ----------
    surfaces : Surfaces
    sequence : (paths, depth) int
        Faces of each path. If a reflection point misses its face, another face of the same plane is used.
    sources_m, targets_m : (paths, 3)
    edge_m : float
        Largest distance of a point outside its face [m].

    Returns
    -------
    sequence : (paths, depth) int
    vertices_m : (paths, depth, 3)
    good : (paths,) bool
        True if each point is in its face, and both ends of each reflection are on the same side.
    """
    order = np.argsort(surfaces.plane, kind="stable")
    start = np.searchsorted(surfaces.plane[order], np.arange(len(surfaces) + 1))
    sequence = np.ascontiguousarray(sequence).copy()
    vertices, good = _points_of(
        _mirrors(surfaces), order, start, sequence,
        np.ascontiguousarray(sources_m), np.ascontiguousarray(targets_m), edge_m,
    )  # fmt: skip
    return sequence, vertices, good


# ---------------------------------------------------------------- compiled


@kernel
def _points_of(mirrors, order, start, sequence, sources, targets, edge):  # type: ignore[no-untyped-def]
    normal, offset = mirrors.normal, mirrors.offset
    count, depth = sequence.shape
    vertices = np.zeros((count, depth, 3))
    good = np.ones(count, np.bool_)
    images = np.zeros((depth + 1, 3))
    for row in range(count):
        images[0] = sources[row]
        for step in range(depth):
            f = sequence[row, step]
            images[step + 1] = images[step] - 2.0 * _height(normal, offset, f, images[step]) * normal[f]
        point = targets[row]
        for step in range(depth - 1, -1, -1):
            f = sequence[row, step]
            low, top = _height(normal, offset, f, images[step]), _height(normal, offset, f, point)
            # there is no reflection if the ends are on different sides of the mirror or in its plane
            if low * top < 0.0 or abs(low) + abs(top) <= SIDE_M:
                good[row] = False
                break
            share = abs(low) / (abs(low) + abs(top))
            vertices[row, step] = images[step + 1] + share * (point - images[step + 1])
            point = vertices[row, step]
            plane = mirrors.plane[f]
            face = _face_at(mirrors, f, order[start[plane] : start[plane + 1]], point, edge)
            if face < 0:
                good[row] = False
                break
            sequence[row, step] = face
    return vertices, good


@kernel
def _face_at(mirrors, f, coplanar, point, edge):  # type: ignore[no-untyped-def]
    """Return the face ``f`` if a point lies in it, else the first coplanar face that contains it, else -1."""
    along, across, first, flat = mirrors.along, mirrors.across, mirrors.first, mirrors.flat
    if in_face(first, flat, along, across, f, point, edge):
        return f
    for neighbour in coplanar:
        if in_face(first, flat, along, across, neighbour, point, edge):
            return neighbour
    return -1


@kernel
def segment_cut(corners, tree, a, b, before, after, rules):  # type: ignore[no-untyped-def]
    """Return a triangle that cuts the segment ``a`` - ``b``, or -1.

    ``before`` and ``after`` are the planes of mirrors at the ends, with a normal of zeros for an antenna. A surface
    within the clearance of the mirror's plane, or of the antenna, does not cut the segment. Edges are included.

    Parameters
    ----------
    corners : (triangles, 3, 3)
        Corners of the triangles [m].
    tree : BoxTree
        Tree over the triangles.
    a, b : (3,)
        Ends of the segment [m].
    before, after : ((3,), float)
        Unit normals and offsets [m] of the mirrors at ``a`` and ``b``.
    rules : Rules
        Clearance, reach of an antenna, and margin by which a segment must hit a triangle.

    Returns
    -------
    int
    """
    way = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    length = np.sqrt(way[0] * way[0] + way[1] * way[1] + way[2] * way[2])
    inverse = (
        1.0 / way[0] if way[0] != 0.0 else 1e300,
        1.0 / way[1] if way[1] != 0.0 else 1e300,
        1.0 / way[2] if way[2] != 0.0 else 1e300,
    )
    lower, upper, child, start, many, items = tree
    todo = np.empty(DEEPEST, np.int64)
    todo[0], waiting = 0, np.int64(1)
    while True:  # a second call of the inlined function would be compiled twice
        node, waiting = next_leaf(lower, upper, child, todo, waiting, (a, inverse))
        if node < 0:
            return -1
        for k in range(start[node], start[node] + many[node]):
            t = _share_to(corners[items[k]], a, way, length, rules.margin)
            # exclude the ends of the segment, because they lie on mirrors and antennas
            if t <= 0.0 or t >= 1.0:
                continue
            hit = a[0] + t * way[0], a[1] + t * way[1], a[2] + t * way[2]
            if not (_at_end(before, hit, t * length, rules) or _at_end(after, hit, (1.0 - t) * length, rules)):
                return items[k]


@part
def _share_to(corners, a, way, length, margin):  # type: ignore[no-untyped-def]
    """Return the share of the segment from ``a`` at which it hits a triangle, or -1.

    Moeller and Trumbore, Fast, Minimum Storage Ray/Triangle Intersection (1997), doi:10.1080/10867651.1997.10487468.
    """
    c, (d0, d1, d2) = corners, way
    # for sheets, close the seams between triangles; for solids, do not count grazing hits
    edge = margin if margin > 0.0 else -1e-9
    e0, e1, e2 = c[1, 0] - c[0, 0], c[1, 1] - c[0, 1], c[1, 2] - c[0, 2]
    g0, g1, g2 = c[2, 0] - c[0, 0], c[2, 1] - c[0, 1], c[2, 2] - c[0, 2]
    p0, p1, p2 = d1 * g2 - d2 * g1, d2 * g0 - d0 * g2, d0 * g1 - d1 * g0
    det = e0 * p0 + e1 * p1 + e2 * p2
    # a segment in the triangle's plane does not cut it
    if abs(det) <= 1e-14 * length:
        return -1.0
    if margin > 0.0:  # reject near-grazing hits, which depend on a tolerance
        m0, m1, m2 = e1 * g2 - e2 * g1, e2 * g0 - e0 * g2, e0 * g1 - e1 * g0
        if abs(det) < 1e-5 * length * np.sqrt(m0 * m0 + m1 * m1 + m2 * m2):
            return -1.0
    s0, s1, s2 = a[0] - c[0, 0], a[1] - c[0, 1], a[2] - c[0, 2]
    u = (s0 * p0 + s1 * p1 + s2 * p2) / det
    if u < edge or u > 1.0 - edge:
        return -1.0
    q0, q1, q2 = s1 * e2 - s2 * e1, s2 * e0 - s0 * e2, s0 * e1 - s1 * e0
    v = (d0 * q0 + d1 * q1 + d2 * q2) / det
    if v < edge or u + v > 1.0 - edge:
        return -1.0
    return (g0 * q0 + g1 * q1 + g2 * q2) / det


@part
def _at_end(mirror, hit, distance, rules):  # type: ignore[no-untyped-def]
    """Check whether a hit must be ignored because it is in the plane of the mirror or at the antenna of an end."""
    normal, offset = mirror
    # a normal of zeros means an antenna
    if normal[0] == 0.0 and normal[1] == 0.0 and normal[2] == 0.0:
        return distance <= _END_M
    return abs(normal[0] * hit[0] + normal[1] * hit[1] + normal[2] * hit[2] - offset) <= rules.clearance


@kernel
def _direct(solids, source, targets, rules):  # type: ignore[no-untyped-def]
    free = np.zeros(len(targets), np.bool_)
    antenna = np.zeros(3), 0.0
    for r in range(len(targets)):
        # do not use threads, because lines of sight take too little time
        free[r] = segment_cut(solids.corners, solids.tree, source, targets[r], antenna, antenna, rules) < 0
    return free


@kernel
def _height(normal, offset, f, p):  # type: ignore[no-untyped-def]
    return normal[f, 0] * p[0] + normal[f, 1] * p[1] + normal[f, 2] * p[2] - offset[f]


@kernel
def _side_planes(planes, count, apex, outline):  # type: ignore[no-untyped-def]
    """Append the side planes of the beam from ``apex`` through an outline to the first ``count``. Return the total."""
    m0 = m1 = m2 = 0.0
    for k in range(WINDOW):
        m0 += outline[k, 0] / WINDOW
        m1 += outline[k, 1] / WINDOW
        m2 += outline[k, 2] / WINDOW
    for k in range(WINDOW):
        a, b = outline[k], outline[(k + 1) % WINDOW]
        x0, x1, x2 = a[0] - apex[0], a[1] - apex[1], a[2] - apex[2]
        y0, y1, y2 = b[0] - a[0], b[1] - a[1], b[2] - a[2]
        n0, n1, n2 = x1 * y2 - x2 * y1, x2 * y0 - x0 * y2, x0 * y1 - x1 * y0
        size = np.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
        if size < 1e-9:
            continue
        n0, n1, n2 = n0 / size, n1 / size, n2 / size
        middle = n0 * (m0 - a[0]) + n1 * (m1 - a[1]) + n2 * (m2 - a[2])
        # the direction of an outline depends on the side from which it is seen
        if middle < 0.0:
            n0, n1, n2 = -n0, -n1, -n2
        # the plane contains the apex and runs slightly outside the side of the outline
        offset = n0 * apex[0] + n1 * apex[1] + n2 * apex[2]
        reach = np.sqrt(x0 * x0 + x1 * x1 + x2 * x2)
        planes[count, 0], planes[count, 1], planes[count, 2] = n0, n1, n2
        # move the plane outwards: too many candidates do no harm, but no path may be removed
        planes[count, 3] = -offset + SLACK_M * max(1.0, 1e3 / max(reach, 1e-3))
        count += 1
    return count


@kernel
def _none_within(outline, planes, many):  # type: ignore[no-untyped-def]
    """Check whether the outline is completely outside one plane."""
    for p in range(many):
        a, b, c, d = planes[p, 0], planes[p, 1], planes[p, 2], planes[p, 3]
        out = True
        for k in range(WINDOW):
            if a * outline[k, 0] + b * outline[k, 1] + c * outline[k, 2] + d >= 0.0:
                out = False
                break
        if out:
            return True
    return False


@kernel
def in_face(first, flat, along, across, f, p, edge):  # type: ignore[no-untyped-def]
    """Check whether a point of the plane of a face lies in one of its triangles.

    Parameters
    ----------
    first : (faces + 1,) int
        Index of the first triangle of each face.
    flat : (triangles, 3, 2)
        Corners in the axes of their face [m].
    along, across : (faces, 3)
        Axes of the faces.
    f : int
        Index of the face.
    p : (3,)
        Position of the point [m].
    edge : float
        Distance by which the point may lie outside a triangle [m].

    Returns
    -------
    bool
    """
    a = along[f, 0] * p[0] + along[f, 1] * p[1] + along[f, 2] * p[2]
    b = across[f, 0] * p[0] + across[f, 1] * p[1] + across[f, 2] * p[2]
    for t in range(first[f], first[f + 1]):
        c = flat[t]
        area = (c[1, 0] - c[0, 0]) * (c[2, 1] - c[0, 1]) - (c[1, 1] - c[0, 1]) * (c[2, 0] - c[0, 0])
        # in a file, the corners of a triangle may be listed in either direction
        sign = 1.0 if area > 0.0 else -1.0
        good = True
        for k in range(3):
            e0, e1 = c[(k + 1) % 3, 0] - c[k, 0], c[(k + 1) % 3, 1] - c[k, 1]
            side = sign * (e0 * (b - c[k, 1]) - e1 * (a - c[k, 0]))
            if side < -edge * np.sqrt(e0 * e0 + e1 * e1):
                good = False
                break
        if good:
            return True
    return False


@kernel
def _ahead(normal, offset, f, sign, outline):  # type: ignore[no-untyped-def]
    """Check whether a corner of an outline lies in front of a face, on its side ``sign``."""
    for k in range(WINDOW):  # noqa: SIM110 - compiled
        if sign * _height(normal, offset, f, outline[k]) > -SIDE_M:
            return True
    return False


@part
def _reflects(shapes, level, chain, signs, images, points, target, rules):  # type: ignore[no-untyped-def]
    """Check whether a path to a target is reflected at each face of the sequence. Write the points into ``points``."""
    normal, offset, along, across, first, flat = shapes
    strict, point = rules.margin == 0.0, target
    for step in range(level, -1, -1):
        g = chain[step]
        top = signs[step] * _height(normal, offset, g, point)
        low = signs[step] * _height(normal, offset, g, images[step])
        # both ends must be in front of the mirror
        if top < -SIDE_M or low < -SIDE_M or top + low <= (SIDE_M if strict else 1e-12):
            return False
        if step < level and top <= (SIDE_M if strict else -SIDE_M):
            return False
        # the image is as far behind the mirror as its source is in front of it
        share, behind = low / (low + top), images[step + 1]
        for axis in range(3):
            points[step, axis] = behind[axis] + share * (point[axis] - behind[axis])
        point = points[step]
        if not in_face(first, flat, along, across, g, point, EDGE_M):
            return False
    return True


@kernel
def _hidden(mirrors, solids, chain, source, points, target, rules):  # type: ignore[no-untyped-def]
    """Check whether a triangle cuts a segment of the path over ``points``."""
    antenna = np.zeros(3), 0.0
    start, before = source, antenna
    for step in range(len(chain)):
        mirror = mirrors.normal[chain[step]], mirrors.offset[chain[step]]
        if segment_cut(solids.corners, solids.tree, start, points[step], before, mirror, rules) >= 0:
            return True
        start, before = points[step], mirror
    return segment_cut(solids.corners, solids.tree, start, target, before, antenna, rules) >= 0


@kernel
def _doubled(pose, faces, points):  # type: ignore[no-untyped-def]
    """Return arrays with twice the number of rows."""
    many, depth = faces.shape
    # double the size: the number of paths is unknown, and a list would need the interpreter
    pose2, points2 = np.empty(2 * many, np.int64), np.zeros((2 * many, depth, 3))
    faces2 = np.full((2 * many, depth), -1, np.int64)
    pose2[:many], faces2[:many], points2[:many] = pose, faces, points
    return pose2, faces2, points2


@kernel
def _follow(mirrors, solids, receivers, source, rules, firsts):  # type: ignore[no-untyped-def]
    """Return all paths whose first face is one of ``firsts``, by a depth-first search along beams.

    This is one long function, because passing a record to another function makes numba count references to its arrays.
    """
    normal, offset, along, across, window, plane, usable, first, flat = mirrors
    shapes = normal, offset, along, across, first, flat
    targets, tree = receivers
    face_tree = solids.face_tree
    depth, solid = rules.depth, rules.margin > 0.0
    pose, faces, points = np.empty(256, np.int64), np.full((256, depth), -1, np.int64), np.zeros((256, depth, 3))
    total = 0
    next_faces = np.empty((depth + 1, max(len(normal), len(firsts))), np.int64)
    waiting, turn = np.zeros(depth + 2, np.int64), np.zeros(depth + 2, np.int64)
    chain, signs, images = np.full(depth, -1, np.int64), np.zeros(depth + 1), np.zeros((depth + 1, 3))
    planes, many = np.zeros((depth + 1, (WINDOW + 1) * (depth + 1), 4)), np.zeros(depth + 1, np.int64)
    spots, stack, reached = np.zeros((depth, 3)), np.empty(DEEPEST, np.int64), np.empty(len(targets), np.int64)
    next_faces[0, : len(firsts)] = firsts
    images[0], waiting[0] = source, len(firsts)
    level = np.int64(0)  # functions would be compiled a second time for the type of a literal
    while level >= 0:
        if turn[level] >= waiting[level]:
            level -= 1
            continue
        f = next_faces[level, turn[level]]
        turn[level] += 1
        place = images[level]
        height = _height(normal, offset, f, place)
        flatwise = abs(height) <= SIDE_M
        before = chain[level - 1]
        if level > 0:
            if plane[f] == plane[before] or not usable[f] or (height < -SIDE_M if solid else flatwise):
                continue
            if _none_within(window[f], planes[level - 1], many[level - 1]):
                continue
        sign = 1.0 if height > 0.0 or solid else -1.0
        if level > 0 and not _ahead(normal, offset, f, sign, window[before]):
            continue
        chain[level], signs[level] = f, sign
        n0, n1, n2 = normal[f, 0], normal[f, 1], normal[f, 2]
        image = images[level + 1]
        image[0] = place[0] - 2.0 * height * n0
        image[1] = place[1] - 2.0 * height * n1
        image[2] = place[2] - 2.0 * height * n2
        # planes of the beam: this face, the mirrored planes of earlier faces, and the sides of this face
        mine, number = planes[level], np.int64(1)
        mine[0, 0], mine[0, 1], mine[0, 2] = sign * n0, sign * n1, sign * n2
        mine[0, 3] = -sign * offset[f] + SIDE_M
        # skip plane 0 of the level before, which is the face itself and not a side of the beam
        for p in range(1, many[level - 1] if level > 0 else 1):
            b0, b1, b2 = planes[level - 1, p, 0], planes[level - 1, p, 1], planes[level - 1, p, 2]
            twice = 2.0 * (b0 * n0 + b1 * n1 + b2 * n2)
            mine[number, 0], mine[number, 1], mine[number, 2] = b0 - twice * n0, b1 - twice * n1, b2 - twice * n2
            mine[number, 3] = planes[level - 1, p, 3] + twice * offset[f]
            number += 1
        if not flatwise and (level + 1 < depth or not box_outside(tree.lower, tree.upper, np.int64(0), mine, number)):
            number = _side_planes(mine, number, image, window[f])
        many[level] = number
        met = within_planes(tree, mine, number, stack, reached)
        for k in range(met):
            r = reached[k]
            if not _reflects(shapes, level, chain, signs, images, spots, targets[r], rules):
                continue
            if _hidden(mirrors, solids, chain[: level + 1], source, spots, targets[r], rules):
                continue
            if total == len(pose):
                pose, faces, points = _doubled(pose, faces, points)
            pose[total] = r
            faces[total, : level + 1], points[total, : level + 1] = chain[: level + 1], spots[: level + 1]
            total += 1
        if level + 1 < depth:
            level += 1
            waiting[level] = within_planes(face_tree, mine, many[level - 1], stack, next_faces[level])
            turn[level] = 0
    return pose[:total].copy(), faces[:total].copy(), points[:total].copy()


def obstacle(surfaces: Surfaces, points_m: FloatArray, sequence: IntArray) -> int | None:
    """Return the first face, from the source, that cuts a path (depth + 2, 3) over the faces ``sequence``, or None."""
    rules, antenna = Rules.of(surfaces, len(sequence)), (np.zeros(3), 0.0)
    normal, offset = np.ascontiguousarray(surfaces.faces.normal), surfaces.faces.offset_m.tolist()
    ends = [antenna, *((normal[face], offset[face]) for face in sequence), antenna]
    for (a, b), (before, after) in zip(pairwise(points_m), pairwise(ends), strict=True):
        first = -1
        while (hit := segment_cut(surfaces.corners_m, surfaces.tree, a, b, before, after, rules)) >= 0:
            # the segment now ends at the plane of the face, and a triangle of the face may lie slightly in front of it
            if surfaces.face[hit] == first:
                break
            first = int(surfaces.face[hit])
            # end the segment at this face, to find a face in front of it
            b = a + (offset[first] - normal[first] @ a) / (normal[first] @ (b - a)) * (b - a)
            after = antenna
        if first >= 0:
            return first
    return None


def try_out() -> None:
    """Compile the search or read its compiled code, and test it with a triangle that hides one of two points.

    Raises
    ------
    RuntimeError
        If the result is wrong.
    """
    triangle = np.array([[[5.0, -9.0, -9.0], [5.0, 9.0, -9.0], [5.0, 0.0, 9.0]]])
    tree = box_tree(triangle.min(axis=1), triangle.max(axis=1))
    rules = Rules(1, 1e-3)
    free = _direct(_Solids(tree, triangle, tree), np.zeros(3), np.array([[9.0, 0.0, 0.0], [-9.0, 0.0, 0.0]]), rules)
    if free.tolist() != [False, True]:
        raise RuntimeError(f"compiled code returned {free.tolist()} for a hidden and a visible point")


# The ground extends to this multiple of the largest coordinate, beyond all reflection points.
REACH = 10.0

# The bounding boxes of faces are enlarged by this distance [m].
OVERLAP_M = 1e-3


def find_paths(
    faces: Faces, links: Links, run: Run = Run(), *, max_depth: int = 2, extent_m: FloatArray | None = None
) -> PathSet:
    """Find the same paths as :func:`.mirror.find_paths`, in scenes with too many sequences for that function.

    Parameters
    ----------
    faces, links, max_depth, extent_m
        The same as in :func:`aerpaw_cmp.propagation.search.mirror.find_paths`.
    run : Run

    Returns
    -------
    PathSet
        Paths, sorted by pose, tower, depth and faces.
    """
    sources_m, targets_m = links.sources_m, links.targets_m
    tolerance_m = scene_tolerance_m(faces, sources_m, targets_m if extent_m is None else extent_m)
    # select too many candidates rather than too few
    paths = grow_paths(solid_surfaces(faces, sources_m, targets_m), links, run, max_depth=max_depth, solids=True)
    source, target = sources_m[paths.tower], targets_m[paths.pose]
    vertices, good = retraced(faces, paths.faces, source, target, tolerance_m)
    rows = np.flatnonzero(good)
    rows = rows[~Occlusion(faces, tolerance_m).any_segment(source[rows], vertices[rows], target[rows])]
    return merge([replace(paths, vertices_m=vertices).select(rows)], max_depth, faces)


def solid_surfaces(faces: Faces, sources_m: FloatArray, targets_m: FloatArray) -> Surfaces:
    """Return the faces of solids for the compiled search. The ground is not an obstacle."""
    known = targets_m[np.isfinite(targets_m).all(axis=1)]
    finite = [np.abs(x[np.isfinite(x)]).max(initial=0.0) for x in (faces.lower, faces.upper, faces.offset_m)]
    reach = REACH * float(max(1.0, *finite, *(np.abs(p).max(initial=0.0) for p in (known, sources_m))))
    vertices, triangle, owner = triangles(faces, reach)
    points = vertices[triangle]
    # for a roof without right angles, use its bounding quadrilateral. It is larger than the roof, so the beam keeps
    # more candidates.
    outline = corners(faces, reach)
    axes = np.stack([faces.along[owner], faces.across[owner]], axis=1)
    flat = np.einsum("tki,tai->tka", points, axes)
    hides = faces.solid[owner] >= 0
    lower, upper = outline.min(axis=1) - OVERLAP_M, outline.max(axis=1) + OVERLAP_M
    obstacles = np.ascontiguousarray(points[hides])
    if not len(obstacles):
        obstacles = np.full((1, 3, 3), 1e9)  # without obstacles, use a single tiny triangle far from the scene
    return Surfaces(
        faces=faces,
        corners_m=obstacles,
        face=owner,
        first=np.searchsorted(owner, np.arange(len(faces) + 1)),
        flat_m=np.ascontiguousarray(flat),
        window_m=np.ascontiguousarray(outline[:, np.minimum(np.arange(WINDOW), 3)]),
        plane=planes_of(faces),
        tree=box_tree(obstacles.min(axis=1), obstacles.max(axis=1)),
        face_tree=box_tree(lower, upper),
        merge_m=OVERLAP_M,
    )
