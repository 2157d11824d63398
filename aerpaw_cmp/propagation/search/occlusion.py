"""Occlusion of segments by buildings: the open segment against the open solid.

A building is a prism: its footprint, cut into convex pieces, from its foot to its roof. A segment is cut when a part of
it runs inside a piece, deeper than a tolerance that only takes up rounding; so a touch of a wall, an edge, a corner or
a roof cuts nothing, wherever it lies and whether or not the segment ends there. The inside of two buildings that touch
is one: a segment that runs in the seam between them, outside both, is cut too.

Triangles have a law of their own (:func:`.beams.segment_cut`): an open sheet has no inside, and a sheet's law decides
198 of 3 984 segments of a grid about two boxes that touch otherwise, where they run along walls or in the seam.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise

import numpy as np
import shapely
from shapely.geometry import Polygon

from ...common.units import AnyArray, BoolArray, FloatArray, IntArray
from ..geometry.faces import corners
from ..geometry.paths import Faces, legs

# Segment-solid pairs looked at at once.
CELLS_PER_CHUNK = 1_000_000

# Radius, in tolerances, within which a point of a seam must be surrounded by buildings; shorter seams hide nothing.
# At 1 km some ten micrometres: far above rounding, far below any gap that a map draws.
_NEIGHBOURHOOD = 1e4

# Share of its area by which a convex footprint may fall short of its hull.
_ROUNDING = 1e-13

_ROUND = np.pi / 8 * (np.arange(16) + 0.37)  # no direction of a map is favoured
_AROUND = np.column_stack([np.cos(_ROUND), np.sin(_ROUND), np.zeros(16)])


class Occlusion:
    """Answers whether segments are cut by the solids of a scene.

    Parameters
    ----------
    faces : Faces
        Faces with ``solid >= 0`` are roofs and walls of prisms; the ground does not hide: nothing that is traced lies
        below it.
    tolerance_m : float
        Deeper than this inside a solid a segment is cut.
    """

    def __init__(self, faces: Faces, tolerance_m: float) -> None:
        self.tolerance_m = tolerance_m
        rows, starts = _by_solid(faces)
        box = corners(faces, 1e9 if len(rows) else 0.0)[rows]
        self.low, self.high = np.zeros((0, 3)), np.zeros((0, 3))
        if len(rows):
            self.low = np.minimum.reduceat(box.min(axis=1), starts) - tolerance_m
            self.high = np.maximum.reduceat(box.max(axis=1), starts) + tolerance_m
        solid, footprint, planes = _prisms(faces, rows, starts)
        cuts = np.searchsorted(solid, np.arange(len(starts) + 1)).tolist()
        touched = _abutting(footprint, tolerance_m).tolist()
        # per solid and convex piece: outward normals (planes, 3) and offsets (planes,); top and bottom come first
        self.pieces = [planes[start:stop] for start, stop in pairwise(cuts)]
        # per solid and convex piece: whether another piece, of any solid, touches it
        self.abutting = [touched[start:stop] for start, stop in pairwise(cuts)]

    def any_segment(self, sources_m: FloatArray, vertices_m: FloatArray, targets_m: FloatArray) -> BoolArray:
        """Check whether polylines source - vertices (paths, depth, 3) - target are cut (paths,)."""
        cut = np.zeros(len(sources_m), dtype=np.bool_)
        for start, end in legs(sources_m, vertices_m, targets_m):
            rows = np.flatnonzero(~cut)
            cut[rows] = self.segments(start[rows], end[rows])
        return cut

    def segments(self, start: FloatArray, end: FloatArray) -> BoolArray:
        """Check whether segments (n, 3) - (n, 3) are cut."""
        cut = np.zeros(len(start), dtype=np.bool_)
        if not self.pieces:
            return cut
        step = max(1, CELLS_PER_CHUNK // len(self.pieces))
        for first in range(0, len(start), step):
            part = slice(first, first + step)
            cut[part] = self._cut(start[part], end[part])
        return cut

    def _cut(self, start: FloatArray, end: FloatArray) -> BoolArray:
        # from coarse to fine: all segments at once, then each box by itself, then the planes of a piece
        solids = self._solids_near(start, end)
        near = self._boxes(start, end, solids)
        result = np.zeros(len(start), dtype=np.bool_)
        # most segments touch nothing, so seams are looked at once all pieces were asked
        seams: list[tuple[IntArray, FloatArray, FloatArray, int, int]] = []
        for column, solid in enumerate(solids.tolist()):
            # one cut is enough
            rows = np.flatnonzero(near[:, column] & ~result)
            for number, (normal, offset) in enumerate(self.pieces[solid]):
                if not len(rows):
                    break
                before, after = start[rows] @ normal.T - offset, end[rows] @ normal.T - offset
                enter, leave = _within(before, after, -self.tolerance_m)
                hit = enter < leave
                result[rows[hit]] = True
                if self.abutting[solid][number]:
                    # now grown by the tolerance: what runs along the piece without entering it
                    enter, leave = _within(before[~hit], after[~hit], self.tolerance_m)
                    along = enter < leave
                    seams.append((rows[~hit][along], enter[along], leave[along], solid, number))
                rows = rows[~hit]
        # one piece alone has no seam
        if len(seams) > 1:
            self._seams(result, start, end, seams)
        return result

    def _solids_near(self, start: FloatArray, end: FloatArray) -> IntArray:
        """Solids whose boxes meet the box of all segments, and from above also that turned to their mean direction."""
        # links to one tower go one way: a box turned along them is thin
        east, north = np.nansum((end - start)[:, :2], axis=0)
        axes = np.array([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0], [east, north, 0], [-north, east, 0]])
        ends = np.concatenate([start, end]) @ axes.T
        middle = (self.low + self.high) / 2 @ axes.T
        reach = (self.high - self.low) / 2 @ np.abs(axes).T + 1e-6 * np.abs(axes).sum(axis=1)
        good = (middle + reach >= np.fmin.reduce(ends)) & (middle - reach <= np.fmax.reduce(ends))
        return np.flatnonzero(good.all(axis=1))

    def _boxes(self, start: FloatArray, end: FloatArray, solids: IntArray) -> BoolArray:
        """Check whether segments meet bounding boxes: slab test, (segments, solids)."""
        direction = end - start
        # the quotients of a level segment become huge with the right sign, where 0 / 0 would be no number
        direction = np.where(direction == 0.0, 1e-300, direction)
        low, high = self.low[solids], self.high[solids]
        enter = np.zeros((len(start), len(solids)))
        leave = np.ones_like(enter)
        with np.errstate(over="ignore"):
            for axis in range(3):
                inverse = 1.0 / direction[:, axis, None]
                at_low = (low[:, axis] - start[:, axis, None]) * inverse
                at_high = (high[:, axis] - start[:, axis, None]) * inverse
                np.maximum(enter, np.minimum(at_low, at_high), out=enter)
                np.minimum(leave, np.maximum(at_low, at_high), out=leave)
        return np.asarray(enter <= leave)

    def _seams(
        self,
        result: BoolArray,
        start: FloatArray,
        end: FloatArray,
        touches: list[tuple[IntArray, FloatArray, FloatArray, int, int]],
    ) -> None:
        """Mark segments that run between pieces which together surround a part of them.

        ``touches`` are, per piece, the segments that run along it and the shares of their length from and to which.
        """
        # touches of all pieces, then gathered by segment
        row, enter, leave = (np.concatenate([t[column] for t in touches]) for column in range(3))
        touch = np.repeat(np.arange(len(touches)), [len(t[0]) for t in touches])
        order = np.argsort(row, kind="stable")
        first = np.searchsorted(row[order], np.arange(len(result) + 1))
        for index in np.flatnonzero((np.diff(first) > 1) & ~result):
            mine = [
                (enter[at], leave[at], self.pieces[touches[touch[at]][3]][touches[touch[at]][4]])
                for at in order[first[index] : first[index + 1]]
            ]
            result[index] = self._surrounded(start[index], end[index], mine)

    def _surrounded(
        self, start: FloatArray, end: FloatArray, runs: list[tuple[float, float, tuple[FloatArray, FloatArray]]]
    ) -> bool:
        """Check whether the pieces along which one segment runs fill the whole neighbourhood of one of its points."""
        radius_m = _NEIGHBOURHOOD * self.tolerance_m
        length_m = float(np.linalg.norm(end - start))
        breaks = np.unique([share for enter, leave, _ in runs for share in (enter, leave)])
        long = np.flatnonzero(np.diff(breaks) * length_m > 10.0 * radius_m)
        # between two breaks the same pieces run along: one point speaks for the stretch
        for share in (breaks[long] + breaks[long + 1]) / 2:
            point = start + share * (end - start)
            ring = point + radius_m * _AROUND
            covered = np.zeros(len(ring), dtype=np.bool_)
            for enter, leave, (normal, offset) in runs:
                height = ring @ normal.T - offset
                # between roof and foot: above a roof nothing is surrounded
                if enter < share < leave and (height[:, :2] < -self.tolerance_m).all():
                    covered |= (height[:, 2:] <= self.tolerance_m).all(axis=1)
            if covered.all():
                return True
        return False


def _within(before: FloatArray, after: FloatArray, level: float) -> tuple[FloatArray, FloatArray]:
    """Shares (enter, leave) between which a segment lies below ``level`` over all planes; enter >= leave: nowhere.

    Cyrus and Beck (1978): the planes that it goes down through give where it enters, the others where it leaves.
    """
    slope = after - before
    with np.errstate(divide="ignore", invalid="ignore"):
        at = (level - before) / slope
    enter = np.where(slope < 0.0, at, np.where((slope == 0.0) & (before >= level), np.inf, 0.0)).max(axis=1)
    leave = np.where(slope > 0.0, at, 1.0).min(axis=1)
    return np.maximum(enter, 0.0), np.minimum(leave, 1.0)


def _by_solid(faces: Faces) -> tuple[IntArray, IntArray]:
    """Faces of solids, one solid after another, and where each solid starts among them."""
    order = np.argsort(faces.solid, kind="stable")
    rows = order[faces.solid[order] >= 0]
    solid = faces.solid[rows]
    return rows, np.flatnonzero(np.diff(solid, prepend=-1))


def _prisms(
    faces: Faces, rows: IntArray, starts: IntArray
) -> tuple[IntArray, list[Polygon], list[tuple[FloatArray, FloatArray]]]:
    """Convex pieces of all solids: the number of the solid, the footprint, and the planes of each.

    ``rows`` are the faces of solids, one solid after another from ``starts`` on.
    """
    if not len(rows):
        return np.zeros(0, np.int64), [], []
    number = np.repeat(np.arange(len(starts)), np.diff(starts, append=len(rows)))
    # exactly: roofs are made with this very normal
    level = faces.normal[rows, 2] == 1.0
    # the lowest wall of each building; roofs do not count
    foot = np.minimum.reduceat(np.where(level, np.inf, faces.lower[rows, 1]), starts)
    roofs = rows[level]
    footprints = _footprints(faces, roofs)
    convex = _is_convex(footprints).tolist()
    pieces = [(part,) if fills else convex_pieces(part) for part, fills in zip(footprints, convex, strict=True)]
    times = [len(some) for some in pieces]
    solid = np.repeat(number[level], times)
    flat = [piece for some in pieces for piece in some]
    return solid, flat, _planes(flat, foot[solid], np.repeat(faces.offset_m[roofs], times))


def _footprints(faces: Faces, roofs: IntArray) -> AnyArray:
    """The roofs (roofs,) seen from above, as polygons in site coordinates."""
    low, high = faces.lower[roofs], faces.upper[roofs]
    polygons = shapely.box(low[:, 0], low[:, 1], high[:, 0], high[:, 1])
    for place, roof in enumerate(roofs.tolist()):
        if faces.polygon[roof] is not None:
            polygons[place] = faces.polygon[roof]
    point, owner = shapely.get_coordinates(polygons, return_index=True)
    axes = np.stack([faces.along[roofs, :2], faces.across[roofs, :2]], axis=1)
    return np.asarray(shapely.set_coordinates(polygons, np.einsum("ni,nij->nj", point, axes[owner])))


@lru_cache(maxsize=4096)
def convex_pieces(footprint: Polygon) -> tuple[Polygon, ...]:
    """Convex polygons that together are a footprint that is not convex, with corners at its corners only.

    Triangles are joined as long as what they make is convex (Hertel and Mehlhorn, 1983); kept, for each replay asks.
    """
    pieces = list(shapely.get_parts(shapely.constrained_delaunay_triangles(footprint)))
    first = 0
    while first < len(pieces):
        for second in range(first + 1, len(pieces)):
            # tried rather than computed: which joins stay convex depends on both outer angles
            union = shapely.union(pieces[first], pieces[second])
            if union.geom_type == "Polygon" and _is_convex(union):
                pieces[first] = union
                del pieces[second]
                break
        else:
            first += 1
    return tuple(pieces)


def _is_convex(polygons: Polygon | AnyArray) -> BoolArray:
    """Check whether a polygon, or each of an array, fills its hull."""
    hull = shapely.area(shapely.convex_hull(polygons))
    full = hull - shapely.area(polygons) <= _ROUNDING * hull
    return np.asarray(full & (shapely.get_num_interior_rings(polygons) == 0))


def _planes(footprints: list[Polygon], foot: FloatArray, top: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
    """Outward normals and offsets of each convex prism: top, bottom, sides."""
    ring = shapely.get_exterior_ring(np.array(footprints, dtype=object))
    point, owner = shapely.get_coordinates(ring, return_index=True)
    count = np.bincount(owner, minlength=len(ring))
    first = np.cumsum(count) - count
    turned = np.arange(len(point))
    # outward normals need one sense round the ring
    backwards = ~shapely.is_ccw(ring)[owner]
    turned[backwards] = (2 * first + count - 1)[owner[backwards]] - turned[backwards]
    point = point[turned]
    edge, start, side_of = np.diff(point, axis=0), point[:-1], owner[:-1]
    # not from one ring's end to the next one's start, and no side without a length
    real = (owner[1:] == side_of) & (edge != 0.0).any(axis=1)
    edge, start, side_of = edge[real], start[real], side_of[real]
    outward = np.column_stack([edge[:, 1], -edge[:, 0]]) / np.hypot(edge[:, 0], edge[:, 1])[:, None]
    planes = np.bincount(side_of, minlength=len(ring)) + 2
    cuts = np.cumsum(np.append(0, planes))
    normal, offset = np.zeros((cuts[-1], 3)), np.empty(cuts[-1])
    normal[cuts[:-1], 2], normal[cuts[:-1] + 1, 2] = 1.0, -1.0
    offset[cuts[:-1]], offset[cuts[:-1] + 1] = top, -foot
    sides = np.arange(len(edge)) + 2 * (side_of + 1)
    normal[sides, :2] = outward
    offset[sides] = (outward * start).sum(axis=1)
    return [(normal[start:stop], offset[start:stop]) for start, stop in pairwise(cuts.tolist())]


def _abutting(footprints: list[Polygon], tolerance_m: float) -> BoolArray:
    """For each piece, whether another piece comes within the tolerance."""
    touched = np.zeros(len(footprints), dtype=np.bool_)
    if len(footprints) > 1:
        first, second = shapely.STRtree(footprints).query(footprints, predicate="dwithin", distance=tolerance_m)
        touched[first[first != second]] = True
    return touched
