"""Compiled code that merges triangles into planar faces.

Triangles of one shape that share an edge and lie within a given tolerance of one plane form one face. Faces of
different shapes that touch or overlap in one plane share that plane, so that a reflection there is counted once.

The module also contains a compiled tree of boxes over triangles, faces or points, and its queries. Every query is
conservative: the final tests are computed for the items themselves, in float64.
"""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import shapely

from ...common.errors import InputError
from ...common.text import counted
from ...common.units import FloatArray, IntArray
from ...site.mitsuba import TriangleScene
from ..compiled import kernel, part
from ..geometry import BoxTree, Faces, Surfaces

# Size of the stack of a tree search. The size is twice the depth of a tree with 4e9 items.
DEEPEST = 64


# Largest number of items in a leaf of a tree.
_LEAF = 4


def box_tree(lower: FloatArray, upper: FloatArray) -> BoxTree:
    """Build a tree over boxes (n, 3). Each node is split at the median of the box centres along its longest side."""
    lower, upper = np.ascontiguousarray(lower, np.float64), np.ascontiguousarray(upper, np.float64)
    return BoxTree(*_build(lower, upper, _LEAF))


@kernel
def _build(lower, upper, leaf):  # type: ignore[no-untyped-def]
    n = len(lower)
    # a binary tree of n leaves has 2 n - 1 nodes
    most = max(1, 2 * n)
    low, high = np.empty((most, 3)), np.empty((most, 3))
    child = np.full(most, -1, np.int64)
    start, count = np.zeros(most, np.int64), np.zeros(most, np.int64)
    items = np.arange(n)
    middle = 0.5 * (lower + upper)
    nodes = 1
    start[0], count[0] = 0, n
    todo = np.empty(DEEPEST, np.int64)
    todo[0] = 0
    waiting = 1
    while waiting > 0:
        waiting -= 1
        node = todo[waiting]
        first, many = start[node], count[node]
        for axis in range(3):
            low[node, axis], high[node, axis] = np.inf, -np.inf
            for k in range(first, first + many):
                low[node, axis] = min(low[node, axis], lower[items[k], axis])
                high[node, axis] = max(high[node, axis], upper[items[k], axis])
        # stop splitting, because testing a few items does not take longer than testing their boxes
        if many <= leaf:
            continue
        longest, widest = 0, -1.0
        for axis in range(3):
            least, most_ = np.inf, -np.inf
            for k in range(first, first + many):
                value = middle[items[k], axis]
                least, most_ = min(least, value), max(most_, value)
            if most_ - least > widest:
                longest, widest = axis, most_ - least
        mine = items[first : first + many].copy()
        # sort completely, because numba does not support a partition of indices
        order = np.argsort(middle[mine, longest])
        items[first : first + many] = mine[order]
        half = many // 2
        # the second child follows the first
        child[node] = nodes
        start[nodes], count[nodes] = first, half
        start[nodes + 1], count[nodes + 1] = first + half, many - half
        todo[waiting], todo[waiting + 1] = nodes, nodes + 1
        waiting += 2
        nodes += 2
    return (
        low[:nodes].copy(),
        high[:nodes].copy(),
        child[:nodes].copy(),
        start[:nodes].copy(),
        count[:nodes].copy(),
        items,
    )


@kernel
def box_outside(lower, upper, node, planes, many):  # type: ignore[no-untyped-def]
    """Check whether a box is completely outside one of the planes.

    Parameters
    ----------
    lower, upper : (nodes, 3)
        Corners of the boxes of a tree [m].
    node : int
        Index of the box.
    planes : (most, 4)
        Inwards normals and offsets [m] of the planes: ``a x + b y + c z + d >= 0`` inside.
    many : int
        Number of rows that are used.

    Returns
    -------
    bool
        False is also returned for a box that only the combination of several planes excludes.
    """
    for p in range(many):
        a, b, c = planes[p, 0], planes[p, 1], planes[p, 2]
        best = planes[p, 3]
        # use the corner farthest along the normal: if it is outside, the complete box is outside
        best += a * (upper[node, 0] if a > 0.0 else lower[node, 0])
        best += b * (upper[node, 1] if b > 0.0 else lower[node, 1])
        best += c * (upper[node, 2] if c > 0.0 else lower[node, 2])
        if best < 0.0:
            return True
    return False


@part
def box_missed(lower, upper, node, segment):  # type: ignore[no-untyped-def]
    """Check whether a segment misses a box.

    Parameters
    ----------
    lower, upper, node
        The same as in :func:`box_outside`.
    segment : ((3,), (3,))
        Start [m], and the reciprocal of each component of its vector [1/m], which is 1e300 for a component of 0.

    Returns
    -------
    bool
    """
    a, inverse = segment
    # limit the interval to 0 and 1, so that boxes behind the start or beyond the end are not hit
    enter, leave = 0.0, 1.0
    for axis in range(3):
        at_lower = (lower[node, axis] - a[axis]) * inverse[axis]
        at_upper = (upper[node, axis] - a[axis]) * inverse[axis]
        if at_lower > at_upper:
            at_lower, at_upper = at_upper, at_lower
        # widen the interval, so that rounding does not lose a box that is only just hit
        enter = max(enter, at_lower - 1e-12 * abs(at_lower))
        leave = min(leave, at_upper + 1e-12 * abs(at_upper))
    return enter > leave


@part
def next_leaf(lower, upper, child, todo, waiting, segment):  # type: ignore[no-untyped-def]
    """Find the next leaf whose box is hit by a segment.

    Parameters
    ----------
    lower, upper, child
        Columns of a :class:`BoxTree`. The columns are passed separately, because compiled code would count references
        to a tuple at every leaf.
    todo : (DEEPEST,) int
        Stack of nodes to visit. At the start it contains only the root, 0.
    waiting : int
        Number of nodes in ``todo``.
    segment : ((3,), (3,))
        The same as in :func:`box_missed`.

    Returns
    -------
    node, waiting : int
        The leaf, or -1 after the last leaf, and the number of nodes in ``todo``.
    """
    while waiting > 0:
        waiting -= 1
        node = todo[waiting]
        if box_missed(lower, upper, node, segment):
            continue
        if child[node] < 0:
            return node, waiting
        todo[waiting], todo[waiting + 1] = child[node], child[node] + 1
        waiting += 2
    return -1, waiting


@kernel
def within_planes(tree, planes, many, todo, hits):  # type: ignore[no-untyped-def]
    """Write items into ``hits`` if their leaf is partly inside each of the first ``many`` planes. Return their number.

    Parameters
    ----------
    tree : BoxTree
    planes, many
        The same as in :func:`box_outside`.
    todo : (DEEPEST,) int
        Array for the nodes to visit.
    hits : (items,) int
        Receives the items. The length of the array is the number of items in the tree.

    Returns
    -------
    int
    """
    lower, upper, child, start, count, items = tree
    total, todo[0], waiting = 0, 0, 1
    while waiting > 0:
        waiting -= 1
        node = todo[waiting]
        if box_outside(lower, upper, node, planes, many):
            continue
        if child[node] >= 0:
            todo[waiting], todo[waiting + 1] = child[node], child[node] + 1
            waiting += 2
            continue
        for k in range(start[node], start[node] + count[node]):
            hits[total] = items[k]
            total += 1
    return total


# Triangles form one face if their corners are within this distance of one plane [m]. Coordinates in files are float32,
# with steps of 0.1 mm at 1 km.
_MERGE_M = 1e-3

# Corners of one shape that are closer than this are one corner [m].
WELD_M = 1e-4

# Largest number of corners of the convex outline of a face in the search. Larger outlines are replaced by a rectangle.
WINDOW = 8

# Triangles with a smaller area than this are removed, because their plane is undefined.
_SMALLEST_M2 = 1e-10


def merged(scene: TriangleScene, merge_m: float = _MERGE_M) -> Surfaces:
    """Return the planar faces of a scene of triangles.

    Parameters
    ----------
    scene : TriangleScene
    merge_m : float
        Largest distance of a corner from the plane of its face [m].

    Raises
    ------
    InputError
        If no triangle has an area.
    """
    corners = scene.vertices_m[scene.triangles]
    normal, offset, area = _planes(corners)
    good = area > _SMALLEST_M2
    notes = list(scene.notes)
    if not good.all():
        notes.append(f"{counted(int((~good).sum()), 'triangle was', 'triangles were')} dropped: no area")
    if not good.any():
        raise InputError("no triangle of the scene has an area", expected="surfaces in metres")
    corners, normal, offset, area = corners[good], normal[good], offset[good], area[good]
    shape = scene.shape[good]
    face, leader = _faces_of_triangles(corners, normal, offset, area, shape, merge_m)
    order = np.argsort(face, kind="stable")
    face, corners, shape = face[order], corners[order], shape[order]
    triangle_area = area[order]
    count = int(face[-1]) + 1
    first = np.searchsorted(face, np.arange(count + 1))
    normal, offset = normal[leader], offset[leader]
    face_area = np.add.reduceat(triangle_area, first[:-1])
    low = np.minimum.reduceat(corners.min(axis=1), first[:-1], axis=0)
    high = np.maximum.reduceat(corners.max(axis=1), first[:-1], axis=0)
    # enlarge by the tolerance, so that neighbours in one plane touch
    face_tree = box_tree(low - merge_m, high + merge_m)
    # test the largest faces first, so that each face is tested after all faces that it may join
    order = np.argsort(-face_area, kind="stable")
    plane = _shared_planes(face_tree, corners, first, (normal, offset), face_area, order, (low, high), merge_m)
    of_face = shape[first[:-1]]
    # number the faces within each shape
    numbers = defaultdict[int, Iterator[int]](lambda: itertools.count(1))
    labels = tuple(f"{scene.shapes[s]} face {next(numbers[s])}" for s in of_face.tolist())
    unbounded = Faces(normal[plane], offset[plane], tuple(scene.materials[s] for s in of_face), labels)
    owner_axes = np.stack([unbounded.along[face], unbounded.across[face]], axis=1)
    flat = np.einsum("tki,tai->tka", corners, owner_axes)
    return Surfaces(
        faces=replace(
            unbounded,
            lower=np.minimum.reduceat(flat.min(axis=1), first[:-1], axis=0),
            upper=np.maximum.reduceat(flat.max(axis=1), first[:-1], axis=0),
            solid=np.asarray(of_face, dtype=np.int64),
        ),
        corners_m=np.ascontiguousarray(corners),
        face=face,
        first=first,
        flat_m=np.ascontiguousarray(flat),
        window_m=_windows(flat, first, unbounded),
        plane=plane,
        tree=box_tree(corners.min(axis=1), corners.max(axis=1)),
        face_tree=face_tree,
        merge_m=merge_m,
        notes=tuple(notes),
    )


def _planes(corners: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return unit normals, offsets and areas of triangles (n, 3, 3)."""
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = np.linalg.norm(across, axis=1)
    normal = across / np.where(size > 0.0, size, 1.0)[:, None]
    return normal, np.einsum("ti,ti->t", normal, corners.mean(axis=1)), 0.5 * size


def _faces_of_triangles(
    corners: FloatArray, normal: FloatArray, offset: FloatArray, area: FloatArray, shape: IntArray, merge_m: float
) -> tuple[IntArray, IntArray]:
    """Return the face of each triangle, and the largest triangle of each face, which defines its plane."""
    # treat corners within 0.1 mm as equal, because files repeat corners for each triangle in float32
    grid = np.round(corners.reshape(-1, 3) / WELD_M).astype(np.int64)
    # compare corners only within one shape, because touching walls of two houses are two faces
    key = np.column_stack([np.repeat(shape, 3), grid])
    order = np.lexsort(key.T)
    new = np.ones(len(order), dtype=np.int64)
    new[1:] = (key[order[1:]] != key[order[:-1]]).any(axis=1)
    corner = np.empty(len(order), dtype=np.int64)
    corner[order] = np.cumsum(new) - 1
    sides = corner.reshape(-1, 3)
    pairs = np.sort(np.stack([sides, np.roll(sides, -1, axis=1)], axis=2), axis=2).reshape(-1, 2)
    edge_key = pairs[:, 0] * (int(corner.max()) + 1) + pairs[:, 1]
    _, edge = np.unique(edge_key, return_inverse=True)
    edge = edge.reshape(-1)
    by_edge = np.argsort(edge, kind="stable")
    start = np.searchsorted(edge[by_edge], np.arange(int(edge.max()) + 2))
    neighbours = edge.reshape(-1, 3), by_edge // 3, start
    # start with the largest triangle, because its plane is the most accurate
    face, leader = _merge_neighbours(np.argsort(-area, kind="stable"), corners, normal, offset, neighbours, merge_m)
    return face, leader


@kernel
def _merge_neighbours(order, corners, normal, offset, neighbours, merge_m):  # type: ignore[no-untyped-def]
    face = np.full(len(corners), -1, np.int64)
    leader = np.empty(len(corners), np.int64)
    todo = np.empty(len(corners), np.int64)
    count = 0
    for seed in order:
        if face[seed] >= 0:
            continue
        leader[count], face[seed], todo[0] = seed, count, seed
        plane, waiting = (normal[seed], offset[seed]), 1
        while waiting > 0:
            waiting -= 1
            waiting += _joining(todo[waiting], count, face, todo[waiting:], corners, plane, neighbours, merge_m)
        count += 1
    return face, leader[:count].copy()


@kernel
def _joining(triangle, number, face, todo, corners, plane, neighbours, merge_m):  # type: ignore[no-untyped-def]
    """Add neighbours of a triangle that are in the plane of its face to the face and to ``todo``. Return the count."""
    edges, triangle_of, start = neighbours
    many = 0
    for edge in edges[triangle]:
        for neighbour in triangle_of[start[edge] : start[edge + 1]]:
            if face[neighbour] < 0 and _lie_in(corners, neighbour, neighbour + 1, plane, merge_m):
                face[neighbour], todo[many] = number, neighbour
                many += 1
    return many


@kernel
def _lie_in(corners, first, after, plane, merge_m):  # type: ignore[no-untyped-def]
    """Check whether the triangles from ``first`` up to ``after`` lie in a plane."""
    normal, offset = plane
    for p in corners[first:after].reshape(-1, 3):
        if abs(normal[0] * p[0] + normal[1] * p[1] + normal[2] * p[2] - offset) > merge_m:
            return False
    return True


@kernel
def _shared_planes(tree, corners, first, planes, area, order, bounds, merge_m):  # type: ignore[no-untyped-def]
    """Return, for each face, the face whose plane it uses.

    The result is a larger face that the face touches and in whose plane it lies, or else the face itself.
    """
    (normal, offset), (low, high) = planes, bounds
    plane = np.arange(len(normal))
    near, todo = np.empty(len(normal), np.int64), np.empty(DEEPEST, np.int64)
    # sides of the box of a face
    sides = np.zeros((6, 4))
    for f in order:
        for axis in range(3):
            sides[axis, axis], sides[axis, 3] = 1.0, merge_m - low[f, axis]
            sides[3 + axis, axis], sides[3 + axis, 3] = -1.0, high[f, axis] + merge_m
        many = within_planes(tree, sides, np.int64(6), todo, near)  # a literal 6 would have another type
        best = -1
        for neighbour in near[:many]:
            if area[neighbour] < area[f] or (area[neighbour] == area[f] and neighbour >= f):
                continue
            lead = plane[neighbour]
            # skip planes with another direction, because a tiny face is within a millimetre of many planes
            if abs(np.dot(normal[lead], normal[f])) < 0.7:
                continue
            if not _lie_in(corners, first[f], first[f + 1], (normal[lead], offset[lead]), merge_m):
                continue
            if best < 0 or area[lead] > area[best]:
                best = lead
        if best >= 0:
            plane[f] = best
    return plane


def _windows(flat: FloatArray, first: IntArray, faces: Faces) -> FloatArray:
    """Return convex outlines (faces, 8, 3), counter-clockwise around the normal."""
    owner = np.repeat(np.arange(len(faces)), 3 * np.diff(first))
    # remove corners that deviate by a tenth of a micrometre: they are rounding errors, and would use up the eight
    # corners
    hull = shapely.simplify(shapely.convex_hull(shapely.multipoints(flat.reshape(-1, 2), indices=owner)), 1e-7)
    corners = shapely.get_num_coordinates(hull) - 1
    hull[corners > WINDOW] = shapely.oriented_envelope(hull[corners > WINDOW])
    point, face = shapely.get_coordinates(shapely.orient_polygons(hull), return_index=True)
    start = np.searchsorted(face, np.arange(len(faces) + 1))
    # omit the repeated first corner of a ring, which the window does not need. A sliver may have become a line.
    last = start[1:] - np.where(shapely.get_type_id(hull) == shapely.GeometryType.POLYGON, 2, 1)
    outline = point[np.minimum(start[:-1, None] + np.arange(WINDOW), last[:, None])]
    base = faces.normal * faces.offset_m[:, None]
    window = base[:, None] + outline[..., :1] * faces.along[:, None] + outline[..., 1:] * faces.across[:, None]
    return np.ascontiguousarray(window)
