"""The search of paths over edges as compiled loops over poses, towers and edges; imported only where numba is there.

The place of each pose round each edge is computed once and serves all towers; a candidate is then a comparison of two
sums. What is left is decided by the rules of reflections: prisms as in :mod:`aerpaw_cmp.propagation.search.occlusion`,
triangles as in :mod:`aerpaw_cmp.propagation.search.beams`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ...common.units import BoolArray, FloatArray, IntArray
from ..edges import NEAREST_M
from ..numba_options import kernel
from .beams import in_face, segment_cut
from .boxtree import DEEPEST, box_missed

PROBE_M = 0.01
"""Radius round a point of an edge within which the air from face to face must be empty [m]."""


class Solids(NamedTuple):
    """Obstacles: convex pieces of prisms, or triangles where ``rules`` has the clearances of beams.

    ``normal``, ``offset`` (planes, ...) are those of the pieces, one piece after another from ``first`` (pieces + 1,)
    on, ``lower`` and ``upper`` (pieces, 3) their boxes; ``corners`` (triangles, 3, 3); ``tree`` is over pieces or
    triangles.
    """

    normal: FloatArray
    offset: FloatArray
    first: IntArray
    tolerance: float
    lower: FloatArray
    upper: FloatArray
    corners: FloatArray
    tree: Any
    rules: Any
    triangles: bool


class Mirrors(NamedTuple):
    """Faces that may bend a leg: planes, in-plane axes and bounds, and triangles (``first`` is empty for prisms)."""

    normal: FloatArray
    offset: FloatArray
    along: FloatArray
    across: FloatArray
    lower: FloatArray
    upper: FloatArray
    first: IntArray
    flat: FloatArray


class Bends(NamedTuple):
    """Edges, pairs of edges of one face, and which faces may bend which legs.

    ``options`` lists faces (-1 first); ``ground_t`` (towers,) and ``ground_p`` (poses,) are the grounds of the ends, -2
    for that of the tower; ``wall`` (faces,) are those that bend one leg alone. ``pair`` and ``shared`` (pairs, 2) are
    edges and which of their faces is the common one, ``turn`` (pairs, 6) as in the field.
    """

    start: FloatArray
    along: FloatArray
    axis: FloatArray
    out: FloatArray
    out_n: FloatArray
    length: FloatArray
    exterior: FloatArray
    face: IntArray
    options: IntArray
    ground_t: IntArray
    ground_p: IntArray
    wall: BoolArray
    pair: IntArray
    shared: IntArray
    turn: FloatArray


@kernel
def _height(m, f, p):  # type: ignore[no-untyped-def]
    return m.normal[f, 0] * p[0] + m.normal[f, 1] * p[1] + m.normal[f, 2] * p[2] - m.offset[f]


@kernel
def _mirrored(m, f, p, out):  # type: ignore[no-untyped-def]
    twice = 0.0
    if f >= 0:
        twice = 2.0 * _height(m, f, p)
    for axis in range(3):
        out[axis] = p[axis] - twice * m.normal[f, axis] if f >= 0 else p[axis]


@kernel
def _round(b, point, a, reach):  # type: ignore[no-untyped-def]
    """Places (edges,) of a point along edges and its distances from them; -1 inside the wedge or on the edge."""
    for e in range(len(a)):
        x, y, z = point[0] - b.start[e, 0], point[1] - b.start[e, 1], point[2] - b.start[e, 2]
        down = x * b.axis[e, 0] + y * b.axis[e, 1] + z * b.axis[e, 2]
        up = x * b.out[e, 0] + y * b.out[e, 1] + z * b.out[e, 2]
        up_n = x * b.out_n[e, 0] + y * b.out_n[e, 1] + z * b.out_n[e, 2]
        a[e] = x * b.along[e, 0] + y * b.along[e, 1] + z * b.along[e, 2]
        far = np.sqrt(down * down + up * up)
        reach[e] = far if far >= NEAREST_M and (up >= 0.0 or up_n >= 0.0) else -1.0


@kernel
def _bounce(m, f, image, end, corner, out):  # type: ignore[no-untyped-def]
    """Check whether a leg from an image to an edge is bent by a face inside its bounds, and where."""
    for axis in range(3):
        out[axis] = np.nan
    if f < 0:
        return True
    above = _height(m, f, corner)
    if above <= NEAREST_M or _height(m, f, end) <= 0.0:
        return False
    below = _height(m, f, image)
    share = below / (below - above)
    for axis in range(3):
        out[axis] = image[axis] + share * (corner[axis] - image[axis])
    if len(m.first):
        return in_face(m.first, m.flat, m.along, m.across, f, out, 0.0)
    a = m.along[f, 0] * out[0] + m.along[f, 1] * out[1] + m.along[f, 2] * out[2]
    b = m.across[f, 0] * out[0] + m.across[f, 1] * out[1] + m.across[f, 2] * out[2]
    return m.lower[f, 0] <= a <= m.upper[f, 0] and m.lower[f, 1] <= b <= m.upper[f, 1]


@kernel
def _pieces_cut(s, work, a, b):  # type: ignore[no-untyped-def]
    """Check whether the segment runs inside a convex piece, deeper than the tolerance (Cyrus and Beck, 1978)."""
    lower, upper, child, start, count, items = s.tree
    inverse, todo = work
    for axis in range(3):
        d = b[axis] - a[axis]
        inverse[axis] = 1.0 / d if d != 0.0 else 1e300
    todo[0] = 0
    waiting = 1
    while waiting > 0:
        waiting -= 1
        node = todo[waiting]
        if box_missed(lower, upper, node, a, inverse):
            continue
        if child[node] >= 0:
            todo[waiting], todo[waiting + 1] = child[node], child[node] + 1
            waiting += 2
            continue
        for k in range(start[node], start[node] + count[node]):
            if _piece_cut(s, items[k], a, b):
                return True
    return False


@kernel
def _piece_cut(s, piece, a, b):  # type: ignore[no-untyped-def]
    enter, leave, level = 0.0, 1.0, -s.tolerance
    for p in range(s.first[piece], s.first[piece + 1]):
        before = s.normal[p, 0] * a[0] + s.normal[p, 1] * a[1] + s.normal[p, 2] * a[2] - s.offset[p]
        after = s.normal[p, 0] * b[0] + s.normal[p, 1] * b[1] + s.normal[p, 2] * b[2] - s.offset[p]
        slope = after - before
        if slope < 0.0:
            enter = max(enter, (level - before) / slope)
        elif slope > 0.0:
            leave = min(leave, (level - before) / slope)
        elif before >= level:
            return False
        if enter >= leave:
            return False
    return True


@kernel
def _near(s, b, f, source, e, hits):  # type: ignore[no-untyped-def]
    """Pieces that may cut a leg from a source to an edge, into ``hits``; how many, -1 for triangles.

    Seen from above the leg lies in a triangle, whether the ground bends it or not; a wall's image is left to the tree.
    """
    if s.triangles or (f >= 0 and b.wall[f]):
        return -1
    x, y, many = np.empty(3), np.empty(3), 0
    for axis, row in ((0, x), (1, y)):
        row[0] = source[axis]
        row[1], row[2] = b.start[e, axis], b.start[e, axis] + b.length[e] * b.along[e, axis]
    top = max(source[2], b.start[e, 2], b.start[e, 2] + b.length[e] * b.along[e, 2])
    low = 0.0 if f >= 0 else min(source[2], b.start[e, 2], b.start[e, 2] + b.length[e] * b.along[e, 2])
    for k in range(len(s.first) - 1):
        lower, upper = s.lower[k], s.upper[k]
        apart = x.max() < lower[0] or x.min() > upper[0] or y.max() < lower[1] or y.min() > upper[1]
        if apart or (f < 0 and upper[2] < low) or lower[2] > top:
            continue
        for i in range(3):
            j, other = (i + 1) % 3, (i + 2) % 3
            n0, n1 = y[j] - y[i], x[i] - x[j]
            inside = n0 * (x[other] - x[i]) + n1 * (y[other] - y[i])
            if inside < 0.0:
                n0, n1 = -n0, -n1
            best = n0 * ((upper[0] if n0 > 0.0 else lower[0]) - x[i]) + n1 * (
                (upper[1] if n1 > 0.0 else lower[1]) - y[i]
            )
            if best < 0.0:
                apart = True
        if not apart:
            hits[many] = k
            many += 1
    return many


@kernel
def _any_piece_cut(s, some, a, b):  # type: ignore[no-untyped-def]
    for piece in some:  # noqa: SIM110 - compiled
        if _piece_cut(s, piece, a, b):
            return True
    return False


@kernel
def _cut(s, m, work, a, b, f, g):  # type: ignore[no-untyped-def]
    """Check whether a segment is cut; ``f`` and ``g`` are the mirrors at its ends or -1."""
    if not s.triangles:
        return _pieces_cut(s, work, a, b)
    before, after, none = m.normal[f], m.normal[g], np.zeros(3)
    return segment_cut(
        s.corners, s.tree, a, b, before if f >= 0 else none, m.offset[f], after if g >= 0 else none, m.offset[g],
        s.rules,
    )  # fmt: skip


@kernel
def _leg_cut(s, m, work, end, bounce, corner, f):  # type: ignore[no-untyped-def]
    """Check whether a leg between an end and an edge is cut."""
    if f < 0:
        return _cut(s, m, work, end, corner, -1, -1)
    return _cut(s, m, work, bounce, corner, f, -1) or _cut(s, m, work, end, bounce, -1, f)


@kernel
def _covered(s, m, work, b, e, corner):  # type: ignore[no-untyped-def]
    """Check whether a triangle lies in the air round a point of an edge."""
    if not s.triangles:
        return False
    last, point = np.empty(3), np.empty(3)
    for k in range(4):
        turn = np.pi * b.exterior[e] * (0.06 + 0.88 * k / 3.0)
        x, y = PROBE_M * np.cos(turn), PROBE_M * np.sin(turn)
        for axis in range(3):
            point[axis] = corner[axis] + x * b.axis[e, axis] + y * b.out[e, axis]
        if k and _cut(s, m, work, last, point, -1, -1):
            return True
        last[:] = point
    return False


@kernel
def _allowed(b, before, after, tower, pose):  # type: ignore[no-untyped-def]
    """Check whether two faces may bend the legs of a link."""
    if before >= 0 and after >= 0 and (b.wall[before] or b.wall[after]):
        return False
    if before >= 0 and not b.wall[before] and before != b.ground_t[tower]:
        return False
    ground = b.ground_t[tower] if b.ground_p[pose] == -2 else b.ground_p[pose]
    return not (after >= 0 and not b.wall[after] and after != ground)


@kernel
def _over_pair(b, k, a_s, r_s, a_t, r_t, points):  # type: ignore[no-untyped-def]
    """Find the points where a path over a pair of edges meets them: straight in the plane of the face between them."""
    t = b.turn[k]
    u_t, v_t = t[0] + t[1] * a_t + t[2] * r_t, t[3] + t[4] * a_t + t[5] * r_t
    if v_t <= 0.0:
        return False
    first = r_s / (v_t + r_s)
    u = a_s + first * (u_t - a_s)
    # the source in the frame of the second edge, whose axes in that of the first are t[1], t[4] and -t[2], -t[5]
    x, y = a_s - t[0], -r_s - t[3]
    ahead = -(x * t[2] + y * t[5])
    if ahead <= 0.0:
        return False
    second = ahead / (ahead + r_t)
    along = x * t[1] + y * t[4]
    w = along + second * (a_t - along)
    e, g = b.pair[k, 0], b.pair[k, 1]
    if second <= first or u < 0.0 or u > b.length[e] or w < 0.0 or w > b.length[g]:
        return False
    gap = 0.0
    for axis in range(3):
        points[1, axis] = b.start[e, axis] + u * b.along[e, axis]
        points[2, axis] = b.start[g, axis] + w * b.along[g, axis]
        gap += (points[2, axis] - points[1, axis]) ** 2
    return gap > NEAREST_M**2


@kernel
def search(b, m, s, sources, targets, excluded, poses):  # type: ignore[no-untyped-def]
    """Paths over one edge, and over the pairs of edges, of some poses.

    Parameters
    ----------
    b : Bends
    m : Mirrors
    s : Solids
    sources, targets : (towers, 3), (poses, 3)
    excluded : (towers, poses) bool
    poses : (some,) int

    Returns
    -------
    index : (paths, 8) int
        Pose, tower, edges (second -1 over one), which of their faces is shared, and the faces that bend the legs.
    vertices : (paths, 4, 3)
        Points on mirror, edge, edge, mirror; NaN where unused.
    """
    edges, towers, options = len(b.start), len(sources), len(b.options)
    a_s, r_s = np.empty((towers, options, edges)), np.empty((towers, options, edges))
    a_t, r_t = np.empty((options, edges)), np.empty((options, edges))
    pieces = 0 if s.triangles else len(s.first) - 1
    near = np.empty((towers, options, edges, pieces), np.int32)
    near_many = np.empty((towers, options, edges), np.int64)
    image_s, image_t = np.empty((towers, options, 3)), np.empty((options, 3))
    for tower in range(towers):
        for i in range(options):
            _mirrored(m, b.options[i], sources[tower], image_s[tower, i])
            _round(b, image_s[tower, i], a_s[tower, i], r_s[tower, i])
            for e in range(edges):
                f = b.options[i]
                near_many[tower, i, e] = _near(s, b, f, sources[tower], e, near[tower, i, e])
    space, total = 1024, 0
    index, vertices = np.empty((space, 8), np.int64), np.empty((space, 4, 3))
    points = np.full((4, 3), np.nan)
    work = np.empty(3), np.empty(DEEPEST, np.int64)
    for pose in poses:
        target = targets[pose]
        for j in range(options):
            _mirrored(m, b.options[j], target, image_t[j])
            _round(b, image_t[j], a_t[j], r_t[j])
        for tower in range(towers):
            if excluded[tower, pose]:
                continue
            for i in range(options):
                for j in range(options):
                    f, g = b.options[i], b.options[j]
                    if not _allowed(b, f, g, tower, pose):
                        continue
                    walled = (f >= 0 and b.wall[f]) or (g >= 0 and b.wall[g])
                    for k in range(edges if walled else edges + len(b.pair)):
                        two = k - edges
                        e, last = k, k
                        if two >= 0:
                            e, last = b.pair[two, 0], b.pair[two, 1]
                        close, far = r_s[tower, i, e], r_t[j, last]
                        if close < 0.0 or far < 0.0:
                            continue
                        here, there = a_s[tower, i, e], a_t[j, last]
                        if two < 0:
                            share = here * far + there * close
                            if share < 0.0 or share > b.length[e] * (close + far):
                                continue
                            share /= close + far
                            for axis in range(3):
                                points[1, axis] = points[2, axis] = b.start[e, axis] + share * b.along[e, axis]
                        elif not _over_pair(b, two, here, close, there, far, points):
                            continue
                        if not _bounce(m, f, image_s[tower, i], sources[tower], points[1], points[0]):
                            continue
                        if not _bounce(m, g, image_t[j], target, points[2], points[3]):
                            continue
                        some = near_many[tower, i, e]
                        if some < 0:
                            if _leg_cut(s, m, work, sources[tower], points[0], points[1], f):
                                continue
                        elif some:
                            hits = near[tower, i, e, :some]
                            if f < 0:
                                if _any_piece_cut(s, hits, sources[tower], points[1]):
                                    continue
                            elif _any_piece_cut(s, hits, points[0], points[1]) or _any_piece_cut(
                                s, hits, sources[tower], points[0]
                            ):
                                continue
                        if _leg_cut(s, m, work, target, points[3], points[2], g):
                            continue
                        if _covered(s, m, work, b, e, points[1]):
                            continue
                        if two >= 0:
                            common = b.face[e, b.shared[two, 0]]
                            if _cut(s, m, work, points[1], points[2], common, common) or _covered(
                                s, m, work, b, last, points[2]
                            ):
                                continue
                        if total == space:
                            space *= 2
                            index2, vertices2 = np.empty((space, 8), np.int64), np.empty((space, 4, 3))
                            index2[:total], vertices2[:total] = index, vertices
                            index, vertices = index2, vertices2
                        row = index[total]
                        row[0], row[1], row[2], row[3], row[6], row[7] = pose, tower, e, -1, f, g
                        row[4] = row[5] = 0
                        vertices[total] = points
                        if two >= 0:
                            row[3], row[4], row[5] = last, b.shared[two, 0], b.shared[two, 1]
                        else:
                            vertices[total, 2] = np.nan
                        total += 1
    return index[:total].copy(), vertices[:total].copy()


def try_out() -> None:
    """Compile, or read what was compiled before; the first search does it."""
