"""Which segments the buildings cut: the open segment against the open solid.

A building is a prism: its footprint, cut into convex pieces, from its foot to its roof. A segment is cut when a part of
it runs inside a piece, deeper than a tolerance that only takes up rounding; so a touch of a wall, an edge, a corner or
a roof cuts nothing, wherever it lies and whether or not the segment ends there. The inside of two buildings that touch
is one: a segment that runs in the seam between them, outside both, is cut too.
"""

from __future__ import annotations

import numpy as np
import shapely
from shapely.geometry import Polygon
from shapely.geometry.polygon import orient

from ..common.units import BoolArray, FloatArray, IntArray
from .faces import corners
from .paths import Faces

CELLS_PER_CHUNK = 1_000_000
"""Segment-solid pairs looked at at once."""

NEIGHBOURHOOD = 1e4
"""Radius, in tolerances, within which a point of a seam must be surrounded by buildings; shorter seams hide nothing."""

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

    Raises
    ------
    ValueError
        If a solid has no roof.
    """

    def __init__(self, faces: Faces, tolerance_m: float) -> None:
        self.tolerance_m = tolerance_m
        solids = [np.flatnonzero(faces.solid == solid) for solid in np.unique(faces.solid[faces.solid >= 0])]
        box = corners(faces, 0.0) if not solids else corners(faces, 1e9)
        self.low = np.array([box[m].min(axis=(0, 1)) for m in solids]).reshape(-1, 3) - tolerance_m
        self.high = np.array([box[m].max(axis=(0, 1)) for m in solids]).reshape(-1, 3) + tolerance_m
        prisms = [_prisms(faces, members) for members in solids]
        self.pieces = [[_planes(*piece) for piece in pieces] for pieces in prisms]
        """Per solid and convex piece: outward normals (planes, 3) and offsets (planes,); top and bottom come first."""
        self.abutting = _abutting([[piece[0] for piece in pieces] for pieces in prisms], tolerance_m)
        """Per solid and convex piece: whether another piece, of any solid, touches it."""

    def any_segment(self, sources_m: FloatArray, vertices_m: FloatArray, targets_m: FloatArray) -> BoolArray:
        """Which polylines source - vertices (paths, depth, 3) - target are cut (paths,)."""
        cut = np.zeros(len(sources_m), dtype=np.bool_)
        start = sources_m
        for step in range(vertices_m.shape[1] + 1):
            end = vertices_m[:, step] if step < vertices_m.shape[1] else targets_m
            rows = np.flatnonzero(~cut)
            cut[rows] = self.segments(start[rows], end[rows])
            start = end
        return cut

    def segments(self, start: FloatArray, end: FloatArray) -> BoolArray:
        """Which segments (n, 3) - (n, 3) are cut."""
        cut = np.zeros(len(start), dtype=np.bool_)
        if not self.pieces:
            return cut
        step = max(1, CELLS_PER_CHUNK // len(self.pieces))
        for first in range(0, len(start), step):
            part = slice(first, first + step)
            cut[part] = self._cut(start[part], end[part])
        return cut

    def _cut(self, start: FloatArray, end: FloatArray) -> BoolArray:
        near = self._boxes(start, end)
        result = np.zeros(len(start), dtype=np.bool_)
        seams: list[tuple[IntArray, FloatArray, FloatArray, int, int]] = []
        for solid, pieces in enumerate(self.pieces):
            rows = np.flatnonzero(near[:, solid] & ~result)
            for number, planes in enumerate(pieces):
                if not len(rows):
                    break
                before, after = _heights(planes, start[rows], end[rows])
                enter, leave = _within(before, after, -self.tolerance_m)
                hit = enter < leave
                result[rows[hit]] = True
                if self.abutting[solid][number]:
                    enter, leave = _within(before[~hit], after[~hit], self.tolerance_m)
                    along = enter < leave
                    seams.append((rows[~hit][along], enter[along], leave[along], solid, number))
                rows = rows[~hit]
        if len(seams) > 1:
            self._seams(result, start, end, seams)
        return result

    def _boxes(self, start: FloatArray, end: FloatArray) -> BoolArray:
        """Which segments meet which bounding boxes: slab test, (segments, solids)."""
        direction = end - start
        direction = np.where(direction == 0.0, 1e-300, direction)
        enter = np.zeros((len(start), len(self.pieces)))
        leave = np.ones_like(enter)
        with np.errstate(over="ignore"):
            for axis in range(3):
                inverse = 1.0 / direction[:, axis, None]
                one = (self.low[:, axis] - start[:, axis, None]) * inverse
                two = (self.high[:, axis] - start[:, axis, None]) * inverse
                np.maximum(enter, np.minimum(one, two), out=enter)
                np.minimum(leave, np.maximum(one, two), out=leave)
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
        row = np.concatenate([t[0] for t in touches])
        several = np.bincount(row, minlength=len(result)) > 1
        for index in np.flatnonzero(several & ~result):
            mine = [
                (enter[at], leave[at], self.pieces[solid][number])
                for rows, enter, leave, solid, number in touches
                for at in np.flatnonzero(rows == index)
            ]
            result[index] = self._surrounded(start[index], end[index], mine)

    def _surrounded(
        self, start: FloatArray, end: FloatArray, runs: list[tuple[float, float, tuple[FloatArray, FloatArray]]]
    ) -> bool:
        """Whether the pieces along which one segment runs fill the whole neighbourhood of one of its points."""
        radius_m = NEIGHBOURHOOD * self.tolerance_m
        length_m = float(np.linalg.norm(end - start))
        breaks = np.unique([share for enter, leave, _ in runs for share in (enter, leave)])
        long = np.flatnonzero(np.diff(breaks) * length_m > 10.0 * radius_m)
        for share in (breaks[long] + breaks[long + 1]) / 2:
            point = start + share * (end - start)
            ring = point + radius_m * _AROUND
            covered = np.zeros(len(ring), dtype=np.bool_)
            for enter, leave, (normal, offset) in runs:
                height = ring @ normal.T - offset
                if enter < share < leave and (height[:, :2] < -self.tolerance_m).all():
                    covered |= (height[:, 2:] <= self.tolerance_m).all(axis=1)
            if covered.all():
                return True
        return False


def _heights(
    planes: tuple[FloatArray, FloatArray], start: FloatArray, end: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Heights (segments, planes) of the ends over the planes of a piece."""
    normal, offset = planes
    return start @ normal.T - offset, end @ normal.T - offset


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


def _prisms(faces: Faces, members: IntArray) -> list[tuple[Polygon, float, float]]:
    """Convex pieces of a solid: footprint, foot and top [m]."""
    level = faces.normal[members, 2] == 1.0
    roofs, walls = members[level], members[~level]
    if not len(roofs):
        raise ValueError(f"the solid of '{faces.label[members[0]]}' has no roof")
    foot = float(faces.lower[walls, 1].min()) if len(walls) else -np.inf
    found = []
    for roof in roofs:
        top = float(faces.offset_m[roof])
        found += [(piece, foot, top) for piece in convex_pieces(_footprint(faces, int(roof)))]
    return found


def _footprint(faces: Faces, roof: int) -> Polygon:
    """The roof seen from above, in site coordinates."""
    polygon = faces.polygon[roof]
    if polygon is None:
        (low_a, low_b), (high_a, high_b) = faces.lower[roof], faces.upper[roof]
        polygon = shapely.box(low_a, low_b, high_a, high_b)
    axes = np.stack([faces.along[roof, :2], faces.across[roof, :2]])
    return shapely.transform(polygon, lambda p: p @ axes)


def convex_pieces(footprint: Polygon) -> list[Polygon]:
    """Convex polygons that together are the footprint, with corners at its corners only.

    Triangles are joined as long as what they make is convex (Hertel and Mehlhorn, 1983).
    """
    if _is_convex(footprint):
        return [footprint]
    pieces = list(shapely.get_parts(shapely.constrained_delaunay_triangles(footprint)))
    first = 0
    while first < len(pieces):
        for second in range(first + 1, len(pieces)):
            union = shapely.union(pieces[first], pieces[second])
            if union.geom_type == "Polygon" and _is_convex(union):
                pieces[first] = union
                del pieces[second]
                break
        else:
            first += 1
    return pieces


def _is_convex(polygon: Polygon) -> bool:
    hull = polygon.convex_hull.area
    return not polygon.interiors and bool(hull - polygon.area <= 1e-13 * hull)


def _planes(footprint: Polygon, foot: float, top: float) -> tuple[FloatArray, FloatArray]:
    """Outward normals and offsets of a convex prism: top, bottom, sides."""
    points = np.asarray(orient(footprint, 1.0).exterior.coords, dtype=np.float64)[:, :2]
    edge = np.diff(points, axis=0)
    edge, points = edge[(edge != 0.0).any(axis=1)], points[:-1][(edge != 0.0).any(axis=1)]
    outward = np.column_stack([edge[:, 1], -edge[:, 0]]) / np.hypot(edge[:, 0], edge[:, 1])[:, None]
    normal = np.zeros((len(edge) + 2, 3))
    normal[:2, 2] = 1.0, -1.0
    normal[2:, :2] = outward
    return normal, np.concatenate([[top, -foot], (outward * points).sum(axis=1)])


def _abutting(footprints: list[list[Polygon]], tolerance_m: float) -> list[list[bool]]:
    """For each piece of each solid, whether another piece comes within the tolerance."""
    flat = [piece for pieces in footprints for piece in pieces]
    touched = np.zeros(len(flat), dtype=np.bool_)
    if len(flat) > 1:
        one, two = shapely.STRtree(flat).query(flat, predicate="dwithin", distance=tolerance_m)
        touched[one[one != two]] = True
    result, done = [], 0
    for pieces in footprints:
        result.append(touched[done : done + len(pieces)].tolist())
        done += len(pieces)
    return result
