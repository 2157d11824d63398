"""The search of paths over edges as compiled loops over poses, towers and edges; imported only where numba is there.

The place of each pose round each edge is computed once and serves all towers; a candidate is then a comparison of two
sums, made for all edges at once. What is left is decided by the rules of reflections: prisms as in
:mod:`aerpaw_cmp.propagation.search.occlusion`, triangles as in :mod:`aerpaw_cmp.propagation.search.beams`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ...common.units import BoolArray, FloatArray, IntArray
from ..edges import NEAREST_M
from ..numba_options import kernel, part
from .beams import in_face, segment_cut
from .boxtree import DEEPEST, box_missed, overlapping

# Radius round a point of an edge within which the air from face to face must be empty [m].
PROBE_M = 0.01

# Most convex pieces of a leaf of the tree, whose boxes are compared at once.
LEAF = 16

# Fewest paths for which there is room at first.
ROWS = 16384


class Solids(NamedTuple):
    """Obstacles: convex pieces of prisms, or triangles where ``rules`` has the clearances of beams.

    ``normal``, ``offset`` (planes, ...) are those of the pieces, one piece after another from ``first`` (pieces + 1,)
    on, in the order of the leaves of ``tree``, which is over pieces or over triangles. ``boxes`` (leaves, 6, LEAF) are
    those of pieces, low corners first, ``block`` (nodes,) numbers the leaves; ``corners`` (triangles, 3, 3).
    """

    normal: FloatArray
    offset: FloatArray
    first: IntArray
    tolerance: float
    boxes: FloatArray
    block: IntArray
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

    ``options`` lists faces (-1 first), ``ways`` (ways, 2) which of them may bend the legs before and after an edge
    together; ``ground_t`` (towers,) and ``ground_p`` (poses,) are the grounds of the ends, -2
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
    ways: IntArray
    ground_t: IntArray
    ground_p: IntArray
    wall: BoolArray
    pair: IntArray
    shared: IntArray
    turn: FloatArray


@part
def _height(m, f, p):  # type: ignore[no-untyped-def]
    return m.normal[f, 0] * p[0] + m.normal[f, 1] * p[1] + m.normal[f, 2] * p[2] - m.offset[f]


@part
def _mirrored(m, f, p):  # type: ignore[no-untyped-def]
    if f < 0:
        return p
    twice = 2.0 * _height(m, f, p)
    return p[0] - twice * m.normal[f, 0], p[1] - twice * m.normal[f, 1], p[2] - twice * m.normal[f, 2]


@part
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
def _in_triangles(m, f, p):  # type: ignore[no-untyped-def]
    return in_face(m.first, m.flat, m.along, m.across, f, np.array(p), 0.0)


@part
def _bounce(m, f, image, end, corner):  # type: ignore[no-untyped-def]
    """Find where a face bends a leg from an image to an edge, and whether inside its bounds; the end without one."""
    if f < 0:
        return True, end
    above, below = _height(m, f, corner), _height(m, f, image)
    if above <= NEAREST_M or _height(m, f, end) <= 0.0:
        return False, end
    share = below / (below - above)
    x = image[0] + share * (corner[0] - image[0])
    y = image[1] + share * (corner[1] - image[1])
    z = image[2] + share * (corner[2] - image[2])
    if len(m.first):
        return _in_triangles(m, f, (x, y, z)), (x, y, z)
    u = m.along[f, 0] * x + m.along[f, 1] * y + m.along[f, 2] * z
    v = m.across[f, 0] * x + m.across[f, 1] * y + m.across[f, 2] * z
    return m.lower[f, 0] <= u <= m.upper[f, 0] and m.lower[f, 1] <= v <= m.upper[f, 1], (x, y, z)


@part
def _pieces_cut(s, work, a, b, wedge):  # type: ignore[no-untyped-def]
    """Check whether the segment runs inside a convex piece but ``wedge``, deeper than the tolerance."""
    lower, upper, child, start, _, _ = s.tree
    inverse = (
        1.0 / (b[0] - a[0]) if b[0] != a[0] else 1e300,
        1.0 / (b[1] - a[1]) if b[1] != a[1] else 1e300,
        1.0 / (b[2] - a[2]) if b[2] != a[2] else 1e300,
    )
    work[0] = 0
    waiting = 1
    while waiting > 0:
        waiting -= 1
        node = work[waiting]
        if child[node] >= 0:
            if not box_missed(lower, upper, node, (a, inverse)):
                work[waiting], work[waiting + 1] = child[node], child[node] + 1
                waiting += 2
            continue
        met = 0  # a bit per piece: sixteen boxes are compared without a branch
        for k in range(LEAF):
            met += _box_met(s.boxes, s.block[node], k, a, inverse) << k
        piece = start[node]
        if piece <= wedge < piece + LEAF:
            met &= ~(1 << (wedge - piece))
        while met > 0:
            if met & 1 and _piece_cut(s, piece, a, b):
                return True
            met, piece = met >> 1, piece + 1
    return False


@part
def _least(a, b):  # type: ignore[no-untyped-def]
    return a if a < b else b


@part
def _most(a, b):  # type: ignore[no-untyped-def]
    return a if a > b else b


@part
def _box_met(boxes, n, k, a, inverse):  # type: ignore[no-untyped-def]
    """1 where a segment meets the box of a piece, else 0; as :func:`.boxtree.box_missed`, without branches."""
    x, x2 = (boxes[n, 0, k] - a[0]) * inverse[0], (boxes[n, 3, k] - a[0]) * inverse[0]
    y, y2 = (boxes[n, 1, k] - a[1]) * inverse[1], (boxes[n, 4, k] - a[1]) * inverse[1]
    z, z2 = (boxes[n, 2, k] - a[2]) * inverse[2], (boxes[n, 5, k] - a[2]) * inverse[2]
    enter = _most(_most(_least(x, x2), _least(y, y2)), _most(_least(z, z2), 0.0))
    leave = _least(_least(_most(x, x2), _most(y, y2)), _least(_most(z, z2), 1.0))
    return 1 if enter <= leave + 1e-12 * (abs(enter) + abs(leave)) else 0


@part
def _piece_cut(s, piece, a, b):  # type: ignore[no-untyped-def]
    """Check whether the segment runs inside a convex piece (Cyrus and Beck, 1978)."""
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
def _wedge_pieces(s, b, pieces):  # type: ignore[no-untyped-def]
    """A piece that both faces of each edge bound, or -1, into ``pieces``: no leg from outside the wedge enters it."""
    pieces[:] = -1
    if s.triangles:
        return
    hits = np.empty(len(s.first), np.int64)
    for e in range(len(pieces)):
        middle = b.start[e] + 0.5 * b.length[e] * b.along[e]
        for k in range(overlapping(s.tree, middle, middle, hits)):
            bounds = 0
            for p in range(s.first[hits[k]], s.first[hits[k] + 1]):
                n = s.normal[p]
                if abs(n[0] * middle[0] + n[1] * middle[1] + n[2] * middle[2] - s.offset[p]) < 0.5 * s.tolerance:
                    for face, out in ((1, b.out[e]), (2, b.out_n[e])):
                        bounds |= face if n[0] * out[0] + n[1] * out[1] + n[2] * out[2] > 1.0 - 1e-12 else 0
            if bounds == 3:
                pieces[e] = hits[k]


@kernel
def _triangles_cut(s, m, a, b, f, g):  # type: ignore[no-untyped-def]
    none = np.zeros(3)
    before, after = (m.normal[f] if f >= 0 else none, m.offset[f]), (m.normal[g] if g >= 0 else none, m.offset[g])
    return segment_cut(s.corners, s.tree, np.array(a), np.array(b), before, after, s.rules)


@part
def _cut(s, m, work, a, b, f, g, wedge):  # type: ignore[no-untyped-def]
    """Check whether a segment is cut; ``f`` and ``g`` are the mirrors at its ends or -1."""
    if s.triangles:
        return _triangles_cut(s, m, a, b, f, g)
    return _pieces_cut(s, work, a, b, wedge)


@kernel
def _covered(s, m, b, e, corner):  # type: ignore[no-untyped-def]
    """Check whether a triangle lies in the air round a point of an edge."""
    last = corner
    for k in range(4):
        turn = np.pi * b.exterior[e] * (0.06 + 0.88 * k / 3.0)
        x, y = PROBE_M * np.cos(turn), PROBE_M * np.sin(turn)
        point = (
            corner[0] + x * b.axis[e, 0] + y * b.out[e, 0], corner[1] + x * b.axis[e, 1] + y * b.out[e, 1],
            corner[2] + x * b.axis[e, 2] + y * b.out[e, 2],
        )  # fmt: skip
        if k and _triangles_cut(s, m, last, point, -1, -1):
            return True
        last = point
    return False


@part
def _allowed(b, before, after, tower, pose):  # type: ignore[no-untyped-def]
    """Check whether two faces are walls, or the grounds of the ends of a link."""
    if before >= 0 and not b.wall[before] and before != b.ground_t[tower]:
        return False
    ground = b.ground_t[tower] if b.ground_p[pose] == -2 else b.ground_p[pose]
    return not (after >= 0 and not b.wall[after] and after != ground)


@part
def _over_pair(b, k, a_s, r_s, a_t, r_t):  # type: ignore[no-untyped-def]
    """Places on a pair of edges where a path over them is straight in the plane of the face between them."""
    t = b.turn[k]
    u_t, v_t = t[0] + t[1] * a_t + t[2] * r_t, t[3] + t[4] * a_t + t[5] * r_t
    first = r_s / (v_t + r_s)
    # the source in the frame of the second edge, whose axes in that of the first are t[1], t[4] and -t[2], -t[5]
    x, y = a_s - t[0], -r_s - t[3]
    ahead = -(x * t[2] + y * t[5])
    second = ahead / (ahead + r_t)
    along = x * t[1] + y * t[4]
    u, w = a_s + first * (u_t - a_s), along + second * (a_t - along)
    on = 0.0 <= u <= b.length[b.pair[k, 0]] and 0.0 <= w <= b.length[b.pair[k, 1]]
    return v_t > 0.0 and ahead > 0.0 and second > first and on, u, w


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
    ends, edges, towers, options = (sources, targets, excluded), len(b.start), len(sources), len(b.options)
    a_s, r_s = np.empty((towers, options, edges)), np.empty((towers, options, edges))
    a_t, r_t = np.empty((options, edges)), np.empty((options, edges))
    for tower in range(towers):
        for i in range(options):
            _round(b, _mirrored(m, b.options[i], _vector(sources, tower)), a_s[tower, i], r_s[tower, i])
    wedges, crossed, work = np.empty(edges, np.int64), np.empty(edges, np.bool_), np.empty(DEEPEST, np.int64)
    _wedge_pieces(s, b, wedges)
    room, total = max(ROWS, 2 * (edges + len(b.pair))), 0
    index, vertices = np.empty((room, 8), np.int64), np.empty((room, 4, 3))
    for pose in poses:
        for j in range(options):
            _round(b, _mirrored(m, b.options[j], _vector(targets, pose)), a_t[j], r_t[j])
        link = 0
        while link < towers * len(b.ways):
            if len(index) - total < edges + len(b.pair):
                index, vertices = _doubled(index, vertices)
            link, total = _links(
                (b, m, s), ends, (a_s, r_s, a_t, r_t), (wedges, crossed, work), (index, vertices, total), pose, link
            )
    return index[:total], vertices[:total]


@part
def _links(scene, ends, places, space, rows, pose, first):  # type: ignore[no-untyped-def]
    """Paths of the links of a pose from ``first`` on while there is room; the next link, and the rows in use."""
    (b, m, _), (sources, targets, excluded), (a_s, r_s, a_t, r_t) = scene, ends, places
    (wedges, crossed, _), (index, vertices, total) = space, rows
    edges, ways, target = len(wedges), len(b.ways), _vector(targets, pose)
    for link in range(first, len(sources) * ways):
        if len(index) - total < edges + len(b.pair):
            return link, total
        tower, i, j = link // ways, b.ways[link % ways, 0], b.ways[link % ways, 1]
        f, g, source = b.options[i], b.options[j], _vector(sources, tower)
        if excluded[tower, pose] or not _allowed(b, f, g, tower, pose):
            continue
        bent = (source, _mirrored(m, f, source), f), (target, _mirrored(m, g, target), g)
        at = a_s[tower, i], r_s[tower, i], a_t[j], r_t[j]
        _on_edges(b.length, at, crossed)
        walled = (f >= 0 and b.wall[f]) or (g >= 0 and b.wall[g])
        for k in range(edges if walled else edges + len(b.pair)):
            if (k >= edges or crossed[k]) and _free(scene, space, bent, k, at, vertices[total]):
                _write(b, k, index[total], (pose, tower, f, g))
                total += 1
    return len(sources) * ways, total


@part
def _vector(points, k):  # type: ignore[no-untyped-def]
    return points[k, 0], points[k, 1], points[k, 2]


@part
def _on_edges(length, places, crossed):  # type: ignore[no-untyped-def]
    """Edges whose diffraction point lies on them, into ``crossed``."""
    a_s, r_s, a_t, r_t = places
    for e in range(len(crossed)):
        close, far = r_s[e], r_t[e]
        share = a_s[e] * far + a_t[e] * close
        crossed[e] = (close >= 0.0) & (far >= 0.0) & (share >= 0.0) & (share <= length[e] * (close + far))


@part
def _point(b, e, at):  # type: ignore[no-untyped-def]
    return b.start[e, 0] + at * b.along[e, 0], b.start[e, 1] + at * b.along[e, 1], b.start[e, 2] + at * b.along[e, 2]


@part
def _free(scene, space, ends, k, places, vertices):  # type: ignore[no-untyped-def]
    """Check whether a candidate meets its edges and mirrors and its legs are free; its points into ``vertices``."""
    (b, m, s), (wedges, _, work), (a_s, r_s, a_t, r_t) = scene, space, places
    pair = k - len(wedges)
    first, last = (k, k) if pair < 0 else (b.pair[pair, 0], b.pair[pair, 1])
    vertices[:] = np.nan
    if pair < 0:
        u = w = (a_s[k] * r_t[k] + a_t[k] * r_s[k]) / (r_s[k] + r_t[k])
    else:
        on, u, w = _over_pair(b, pair, a_s[first], r_s[first], a_t[last], r_t[last])
        if r_s[first] < 0.0 or r_t[last] < 0.0 or not on:
            return False
    corners = _point(b, first, u), _point(b, last, w)
    for side in range(2):
        end, image, f = ends[side]
        e, corner = last if side else first, corners[side]
        met, bounce = _bounce(m, f, image, end, corner)
        if not met or _cut(s, m, work, bounce, corner, f, -1, wedges[e]):
            return False
        if f >= 0:
            if _cut(s, m, work, end, bounce, -1, f, -1):
                return False
            vertices[3 * side, 0], vertices[3 * side, 1], vertices[3 * side, 2] = bounce
        if side == 0 or pair >= 0:
            vertices[1 + side, 0], vertices[1 + side, 1], vertices[1 + side, 2] = corner
            if s.triangles and _covered(s, m, b, e, corner):
                return False
    if pair < 0:
        return True
    (x, y, z), (x2, y2, z2), common = corners[0], corners[1], b.face[first, b.shared[pair, 0]]
    apart = (x2 - x) ** 2 + (y2 - y) ** 2 + (z2 - z) ** 2 > NEAREST_M**2
    return apart and not _cut(s, m, work, corners[0], corners[1], common, common, -1)


@kernel
def _doubled(index, vertices):  # type: ignore[no-untyped-def]
    """Rows with room for as many more."""
    more = np.empty((2 * len(index), 8), np.int64), np.empty((2 * len(index), 4, 3))
    more[0][: len(index)], more[1][: len(index)] = index, vertices
    return more


@part
def _write(b, k, row, link):  # type: ignore[no-untyped-def]
    """Write pose, tower, edges, shared faces and mirrors of a path into its row."""
    pair = k - len(b.start)
    row[0], row[1], row[6], row[7] = link
    row[2], row[3], row[4], row[5] = k, -1, 0, 0
    if pair >= 0:
        row[2], row[3], row[4], row[5] = b.pair[pair, 0], b.pair[pair, 1], b.shared[pair, 0], b.shared[pair, 1]


def try_out() -> None:
    """Compile, or read what was compiled before; the first search does it."""
