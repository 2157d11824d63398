"""An exhaustive search for specular paths by the image method, in float64 and vectorised over poses.

For a sequence of faces ``f1 .. fd`` the source is mirrored face by face. A path exists if

1. each image lies in front of the next face, and the target in front of the last face (decided per sequence);
2. going back from the target, each line to the current image intersects its face inside the polygon;
3. no segment is cut by a solid.

A sequence is extended only to faces that the beam from the image through its last face can reach. The
tolerance of side tests is relative to the size of the scene, far above the rounding error of a reflection point. A
solid blocks only segments through its interior, so a path along a wall exists, and there is no gap between two walls.
An end that lies on a face reflects there like an end just in front of it, so the level does not jump when a UAV lands.

Segments are occluded by buildings if the open segment meets the open solid.

A building is a prism: its footprint, cut into convex pieces, from its foot to its roof. A segment is cut if a part of
it is inside a piece, deeper than a tolerance for rounding. A segment that only touches a wall, an edge, a corner or a
roof is not cut, regardless of where it ends. Two buildings that touch are one solid: a segment that runs in the seam
between them, outside both, is cut too.

Triangles have a separate rule (:func:`.beams.segment_cut`), because an open sheet has no inside. On a grid of 3 984
segments around two touching boxes, the rule for sheets has a different result for 198 segments, which run along walls
or in the seam.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np
import shapely
from shapely.geometry import Polygon

from ...common.errors import UsageError
from ...common.text import counted
from ...common.units import AnyArray, BoolArray, FloatArray, IntArray
from ..geometry import Faces, Links, PathSet, corners, inside, legs
from ..options import Progress

# Number of pairs of a segment and a solid that are tested together.
PAIRS_PER_CHUNK = 1_000_000

# Radius, in tolerances, within which a point of a seam must be surrounded by buildings. Shorter seams do not block. At
# 1 km, the radius is about ten micrometres, far above rounding errors and far below any gap on a map.
_NEIGHBOURHOOD = 1e4

# Share of its area by which a convex footprint may be smaller than its hull.
_ROUNDING = 1e-13

_ROUND = np.pi / 8 * (np.arange(16) + 0.37)  # no direction coincides with a map axis
_AROUND = np.column_stack([np.cos(_ROUND), np.sin(_ROUND), np.zeros(16)])


class Occlusion:
    """A test of whether the solids of a scene cut segments.

    Parameters
    ----------
    faces : Faces
        Faces with ``solid >= 0`` are roofs and walls of prisms. The ground does not block, because all paths are above
        it.
    tolerance_m : float
        A segment is cut if a part of it is deeper than this inside a solid.
    """

    def __init__(self, faces: Faces, tolerance_m: float) -> None:
        self.tolerance_m = tolerance_m
        rows, starts = _by_solid(faces)
        box = corners(faces, 1e9 if len(rows) else 0.0)[rows]
        self.low, self.high = np.zeros((0, 3)), np.zeros((0, 3))
        if len(rows):
            self.low = np.minimum.reduceat(box.min(axis=1), starts) - tolerance_m
            self.high = np.maximum.reduceat(box.max(axis=1), starts) + tolerance_m
        # ``pieces`` contains the outward normals (planes, 3) and offsets (planes,) of each convex piece, top and bottom
        # first
        solid, footprint, self.pieces = _prisms(faces, rows, starts)
        # pieces of each solid
        self.parts = [range(*ends) for ends in pairwise(np.searchsorted(solid, np.arange(len(starts) + 1)).tolist())]
        # True for each piece that touches another piece, of any solid
        self.abutting = _touching(footprint, tolerance_m)

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
        step = max(1, PAIRS_PER_CHUNK // len(self.parts))
        for first in range(0, len(start), step):
            part = slice(first, first + step)
            cut[part] = self._cut(start[part], end[part])
        return cut

    def _cut(self, start: FloatArray, end: FloatArray) -> BoolArray:
        # test from coarse to fine: the box of all segments, then each segment and box, then the planes of a piece
        ends = np.concatenate([start, end])
        near_all = (self.high >= np.fmin.reduce(ends)) & (self.low <= np.fmax.reduce(ends))
        solids = np.flatnonzero(near_all.all(axis=1))
        near = self._boxes(start, end, solids)
        result = np.zeros(len(start), dtype=np.bool_)
        # examine seams after all pieces, because most segments do not touch a solid
        seams: list[tuple[IntArray, FloatArray, FloatArray, IntArray]] = []
        for column, solid in enumerate(solids.tolist()):
            # skip segments that another piece already cuts
            rows = np.flatnonzero(near[:, column] & ~result)
            for piece in self.parts[solid]:
                if not len(rows):
                    break
                normal, offset = self.pieces[piece]
                before, after = start[rows] @ normal.T - offset, end[rows] @ normal.T - offset
                enter, leave = _within(before, after, -self.tolerance_m)
                hit = enter < leave
                result[rows[hit]] = True
                if self.abutting[piece]:
                    # enlarge the piece by the tolerance, to find segments that run along it without entering it
                    enter, leave = _within(before[~hit], after[~hit], self.tolerance_m)
                    along = enter < leave
                    touching = rows[~hit][along]
                    seams.append((touching, enter[along], leave[along], np.full(len(touching), piece)))
                rows = rows[~hit]
        # a seam needs at least two pieces
        if len(seams) > 1:
            row, enter, leave, pieces = (np.concatenate(column) for column in zip(*seams, strict=True))
            order = np.argsort(row, kind="stable")
            first = np.searchsorted(row[order], np.arange(len(result) + 1))
            for index in np.flatnonzero((np.diff(first) > 1) & ~result):
                mine = order[first[index] : first[index + 1]]
                result[index] = self._surrounded(start[index], end[index], enter[mine], leave[mine], pieces[mine])
        return result

    def _boxes(self, start: FloatArray, end: FloatArray, solids: IntArray) -> BoolArray:
        """Check whether segments hit bounding boxes (segments, solids), by the slab test."""
        direction = end - start
        # replace 0 by a tiny number: the quotients become huge with the correct sign, whereas 0 / 0 would be NaN
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

    def _surrounded(
        self, start: FloatArray, end: FloatArray, enter: FloatArray, leave: FloatArray, pieces: IntArray
    ) -> bool:
        """Check whether a segment is blocked: the pieces along which it runs surround one of its points completely.

        The segment runs along each of the ``pieces`` (n,) from the share ``enter`` to the share ``leave`` of the
        segment.
        """
        radius_m = _NEIGHBOURHOOD * self.tolerance_m
        length_m = float(np.linalg.norm(end - start))
        breaks = np.unique([enter, leave])
        long = np.flatnonzero(np.diff(breaks) * length_m > 10.0 * radius_m)
        # between two breaks, the segment runs along the same pieces, so one point is sufficient
        for share in (breaks[long] + breaks[long + 1]) / 2:
            point = start + share * (end - start)
            ring = point + radius_m * _AROUND
            covered = np.zeros(len(ring), dtype=np.bool_)
            for piece in pieces[(enter < share) & (share < leave)]:
                normal, offset = self.pieces[piece]
                height = ring @ normal.T - offset
                # require a point between foot and roof, because a point above a roof is not surrounded
                if (height[:, :2] < -self.tolerance_m).all():
                    covered |= (height[:, 2:] <= self.tolerance_m).all(axis=1)
            if covered.all():
                return True
        return False


def _within(before: FloatArray, after: FloatArray, level: float) -> tuple[FloatArray, FloatArray]:
    """Return shares (enter, leave) between which a segment is below ``level`` of all planes. Empty if enter >= leave.

    Cyrus and Beck (1978): the segment enters at planes that it crosses inwards and leaves at the other planes.
    """
    slope = after - before
    with np.errstate(divide="ignore", invalid="ignore"):
        at = (level - before) / slope
    enter = np.where(slope < 0.0, at, np.where((slope == 0.0) & (before >= level), np.inf, 0.0)).max(axis=1)
    leave = np.where(slope > 0.0, at, 1.0).min(axis=1)
    return np.maximum(enter, 0.0), np.minimum(leave, 1.0)


def _by_solid(faces: Faces) -> tuple[IntArray, IntArray]:
    """Return the faces of solids, one solid after another, and the index of the first face of each solid."""
    order = np.argsort(faces.solid, kind="stable")
    rows = order[faces.solid[order] >= 0]
    solid = faces.solid[rows]
    return rows, np.flatnonzero(np.diff(solid, prepend=-1))


def _prisms(
    faces: Faces, rows: IntArray, starts: IntArray
) -> tuple[IntArray, list[Polygon], list[tuple[FloatArray, FloatArray]]]:
    """Return the convex pieces of all solids: number of the solid, footprint and planes of each.

    ``rows`` are the faces of the solids, one solid after another. ``starts`` are the indices of the first face of each.
    """
    if not len(rows):
        return np.zeros(0, np.int64), [], []
    number = np.repeat(np.arange(len(starts)), np.diff(starts, append=len(rows)))
    # compare exactly, because roofs are created with this normal
    level = faces.normal[rows, 2] == 1.0
    # ignore roofs, because the foot of a building is the lower end of its lowest wall
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
    """Return the roofs (roofs,) seen from above, as polygons in site coordinates."""
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
    """Split a footprint that is not convex into convex polygons without additional corners.

    Triangles are joined as long as the result is convex (Hertel and Mehlhorn, 1983). The pieces are cached, because
    every replay needs them.
    """
    pieces = list(shapely.get_parts(shapely.constrained_delaunay_triangles(footprint)))
    first = 0
    while first < len(pieces):
        for second in range(first + 1, len(pieces)):
            # try each join, because the convexity of the result depends on the angles at both ends
            union = shapely.union(pieces[first], pieces[second])
            if union.geom_type == "Polygon" and _is_convex(union):
                pieces[first] = union
                del pieces[second]
                break
        else:
            first += 1
    return tuple(pieces)


def _is_convex(polygons: Polygon | AnyArray) -> BoolArray:
    """Check whether a polygon, or each polygon of an array, is convex."""
    hull = shapely.area(shapely.convex_hull(polygons))
    full = hull - shapely.area(polygons) <= _ROUNDING * hull
    return np.asarray(full & (shapely.get_num_interior_rings(polygons) == 0))


def _planes(footprints: list[Polygon], foot: FloatArray, top: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
    """Return the outward normals and offsets of each convex prism: top, bottom, sides."""
    # the outside is on the right of each edge of a counter-clockwise ring
    ring = shapely.get_exterior_ring(shapely.orient_polygons(np.array(footprints, dtype=object)))
    point, owner = shapely.get_coordinates(ring, return_index=True)
    edge, start, side_of = np.diff(point, axis=0), point[:-1], owner[:-1]
    # exclude sides from the end of one ring to the start of the next, and sides without length
    real = (owner[1:] == side_of) & (edge != 0.0).any(axis=1)
    edge, start, side_of = edge[real], start[real], side_of[real]
    outward = np.column_stack([edge[:, 1], -edge[:, 0], np.zeros(len(edge))])
    outward /= np.hypot(edge[:, 0], edge[:, 1])[:, None]
    offset = (outward[:, :2] * start).sum(axis=1)
    level = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    ends = pairwise(np.searchsorted(side_of, np.arange(len(ring) + 1)).tolist())
    return [
        (np.concatenate([level, outward[first:last]]), np.concatenate([[roof, -base], offset[first:last]]))
        for (first, last), roof, base in zip(ends, top.tolist(), foot.tolist(), strict=True)
    ]


def _touching(footprints: list[Polygon], tolerance_m: float) -> BoolArray:
    """Check for each piece whether another piece is within the tolerance."""
    touched = np.zeros(len(footprints), dtype=np.bool_)
    if len(footprints) > 1:
        first, second = shapely.STRtree(footprints).query(footprints, predicate="dwithin", distance=tolerance_m)
        touched[first[first != second]] = True
    return touched


# Tolerance relative to the largest coordinate: about a thousand times the rounding error of a plane equation.
RELATIVE_TOLERANCE = 1e-12

# A link shorter than this has no path [m]: its ends are not in the far field, and a length of zero has no direction.
MINIMUM_LENGTH_M = 0.01

# Largest number of face sequences per tower of the ``image`` engine.
_SEQUENCE_BUDGET = 200_000

# Largest number of entries of an array over pairs (sequences and faces, or poses and sequences) that is computed at
# once. It limits the memory to 8 MB per array.
CELLS_PER_CHUNK = 1_000_000

# Number of targets whose heights over all faces are cached.
TARGETS_AT_ONCE = 1024

# Margin for selecting mirrors before the search [m], far above the tolerance of any search.
REACH_SLACK_M = 1e-3


def find_paths(
    faces: Faces,
    links: Links,
    *,
    max_depth: int = 2,
    budget: int = _SEQUENCE_BUDGET,
    extent_m: FloatArray | None = None,
    progress: Progress | None = None,
) -> PathSet:
    """Find all paths with at most ``max_depth`` reflections.

    Parameters
    ----------
    faces : Faces
        Closed solids and ground planes.
    links : Links
    max_depth : int
        Largest number of reflections, 0 to 3.
    budget : int
        Largest number of sequences per tower.
    extent_m : (points, 3), optional
        Points that determine the tolerance instead of the targets, if the targets are a part of a job.
    progress : callable, optional
        Called with the completed share.

    Returns
    -------
    PathSet
        Paths, sorted by pose, tower, depth and faces.

    Raises
    ------
    UsageError
        If the scene has more sequences than the budget.
    """
    if not 0 <= max_depth <= 3:
        raise UsageError(f"max_depth {max_depth}", expected="0, 1, 2 or 3 reflections")
    sources_m, targets_m, usable = links.sources_m, links.targets_m, links.usable
    # use the extent of the complete flight, so that a part of it is searched with the same tolerance
    known = targets_m[np.isfinite(targets_m).all(axis=1)] if extent_m is None else extent_m
    tolerance_m = scene_tolerance_m(faces, sources_m, known)
    hiding = Occlusion(faces, tolerance_m)
    growth = Growth.of(faces, np.concatenate([known, sources_m]), tolerance_m, max_depth, budget)
    alive = searched_links(links)
    pieces: list[PathSet] = []
    for tower, source in enumerate(sources_m):
        poses = np.flatnonzero(alive[tower])
        reflecting = np.ones(len(faces), np.bool_) if usable is None else usable[tower]
        levels = growth.sequences(source, reflecting, targets_m[poses]) if len(poses) else []
        for level in levels:
            pieces.append(_paths_of_level(faces, level, source, targets_m, poses, tower, max_depth, hiding))
        if progress:
            progress((tower + 1) / len(sources_m))
    return merge(pieces, max_depth, faces)


def searched_links(links: Links) -> BoolArray:
    """Return links (towers, poses) that may have paths: they have a pose, are long enough and are not excluded."""
    alive = np.empty((len(links.sources_m), len(links.targets_m)), dtype=np.bool_)
    with np.errstate(invalid="ignore"):
        # loop over towers, because the coordinates of all pairs would be the largest array of the search
        for tower, source in enumerate(links.sources_m.reshape(-1, 3)):
            apart = links.targets_m - source
            gap2 = np.einsum("ij,ij->i", apart, apart)
            alive[tower] = (gap2 >= MINIMUM_LENGTH_M**2) & (gap2 < np.inf)
    return np.asarray(alive if links.excluded is None else alive & ~links.excluded)


def scene_tolerance_m(faces: Faces, *points_m: FloatArray) -> float:
    """Return the absolute tolerance [m] of side tests in this scene."""
    sizes = [np.abs(p).max(initial=0.0, where=np.isfinite(p)) for p in (*points_m, faces.lower, faces.upper)]
    return RELATIVE_TOLERANCE * max(1.0, *(float(s) for s in sizes))


@dataclass(frozen=True, slots=True)
class _Bounds:
    """The in-plane bounds of the faces.

    Parameters
    ----------
    corners_m : (faces, 4, 3)
        Corners in order around the face. Infinite faces are cut off far away.
    centre_m : (faces, 3)
    reach_m : (faces, 2, 3)
        Half of each side [m].
    """

    corners_m: FloatArray
    centre_m: FloatArray
    reach_m: FloatArray


@dataclass(frozen=True, slots=True)
class Sequences:
    """The face sequences of one length, with their images.

    Parameters
    ----------
    faces : (sequences, depth) int
    images_m : (sequences, depth, 3)
        Images of the source after the first, second, ... face [m].
    """

    faces: IntArray
    images_m: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Growth:
    """The extension of face sequences, face by face, for any position of the tower.

    Parameters
    ----------
    faces : Faces
    bounds : _Bounds
        Bounds of the faces.
    facing : (faces, faces) bool
        Faces that can follow each other.
    tolerance_m : float
        A point up to this far behind a face still counts as in front of it [m].
    max_depth, budget : int
        Largest numbers of reflections and of sequences per tower.
    """

    faces: Faces
    bounds: _Bounds
    facing: BoolArray
    tolerance_m: float
    max_depth: int
    budget: int

    @classmethod
    def of(cls, faces: Faces, points_m: FloatArray, tolerance_m: float, max_depth: int, budget: int) -> Growth:
        """Return the object for a scene and for ends within the span of points.

        Parameters
        ----------
        faces : Faces
        points_m : (n, 3)
            Points that span sources and targets [m].
        tolerance_m, max_depth, budget
            The same as in :class:`Growth`.

        Returns
        -------
        Growth
        """
        # cut infinite faces off at ten times the farthest point, far beyond any reflection between two points of the
        # scene
        box = corners(faces, 10.0 * float(max(1.0, np.abs(points_m).max(initial=0.0))))
        first, second, third, fourth = box.transpose(1, 0, 2)
        bounds = _Bounds(box, (first + third) / 2, np.stack([second - first, fourth - first], axis=1) / 2)
        # pairs of faces are needed only for two or more reflections
        facing = _facing(faces, bounds, tolerance_m) if max_depth > 1 else np.zeros((0, len(faces)), np.bool_)
        return cls(
            faces=faces, bounds=bounds, facing=facing, tolerance_m=tolerance_m, max_depth=max_depth, budget=budget
        )

    def sequences(self, source: FloatArray, usable: BoolArray, targets_m: FloatArray) -> list[Sequences]:
        """Return the sequences that may lead to a target, by length, beginning with the line of sight."""
        level = Sequences(np.zeros((1, 0), np.int64), np.zeros((1, 0, 3)))
        levels, left = [level], self.budget - 1
        for _ in range(self.max_depth):
            level = self._one_face_longer(level, source, usable, left)
            left -= len(level.faces)
            if not len(level.faces):
                break
            levels.append(level)
        normal, starts = self.faces.normal, range(0, len(targets_m), TARGETS_AT_ONCE)
        highest = [(normal @ targets_m[start : start + TARGETS_AT_ONCE].T).max(axis=1) for start in starts]
        lit = np.max(highest, axis=0) - self.faces.offset_m >= -self.tolerance_m
        low, high = targets_m.min(axis=0), targets_m.max(axis=0)
        # use the box around all poses: a beam that misses the box misses every pose
        hull = (low + high)[None] / 2, np.diag(high - low)[None] / 2
        return [levels[0], *(self._reaching(level, lit, hull) for level in levels[1:])]

    def mirrors(self, source_m: FloatArray, box_m: FloatArray) -> IntArray:
        """Return the faces that may reflect from a source (3,) into a box (lowest and highest corner, 3)."""
        points = np.array(np.meshgrid(*box_m.T)).reshape(3, -1).T
        levels = self.sequences(source_m, np.ones(len(self.faces), np.bool_), points)
        return levels[1].faces[:, 0] if len(levels) > 1 else np.zeros(0, np.int64)

    def _one_face_longer(self, level: Sequences, source: FloatArray, usable: BoolArray, left: int) -> Sequences:
        """Return the sequences that are longer by one face. At most ``left`` of them are allowed."""
        faces, box, depth = self.faces, self.bounds, level.faces.shape[1]
        grown: list[IntArray] = []
        images: list[FloatArray] = []
        # divide by 8, because eight arrays of this size exist at the same time
        step = max(1, CELLS_PER_CHUNK // (8 * len(faces)))
        for start in range(0, len(level.faces), step):
            now, past = level.faces[start : start + step], level.images_m[start : start + step]
            last_image = past[:, -1] if depth else np.broadcast_to(source, (len(now), 3))
            height = last_image @ faces.normal.T - faces.offset_m
            # the source may lie on the face, but an image may not: its reflection would be at the edge between two
            # faces
            good = usable & (height > self.tolerance_m if depth else height >= -self.tolerance_m)
            hit = good & self.facing[now[:, -1]] if depth else good
            row, face = np.divmod(np.flatnonzero(hit), len(faces))
            if depth:
                before = now[row, -1]
                beam = last_image[row], box.corners_m[before], box.centre_m[face], box.reach_m[face]
                keep = _beam_meets(*beam, self.tolerance_m)
                # always keep the ground: every downward beam hits it, and its corners are only those at which it was
                # cut off
                keep |= ~np.isfinite(faces.lower[face, 0]) | ~np.isfinite(faces.lower[before, 0])
                row, face = row[keep], face[keep]
            # compute the image once per sequence, because it is the same for every target
            mirrored = last_image[row] - 2.0 * height[row, face][:, None] * faces.normal[face]
            grown.append(np.concatenate([now[row], face[:, None]], axis=1))
            images.append(np.concatenate([past[row], mirrored[:, None]], axis=1))
            left -= len(row)
            if left < 0:
                raise UsageError(
                    f"the scene has more than {self.budget} face sequences of up to {depth + 1} reflections "
                    f"({counted(len(faces), 'face')})",
                    expected="a rural scene with few faces",
                    cause="many buildings: engine 'sionna', a smaller max_depth, or pip install 'aerpaw-cmp[fast]'",
                )
        return Sequences(np.concatenate(grown), np.concatenate(images))

    def _reaching(self, level: Sequences, lit: BoolArray, hull_m: tuple[FloatArray, FloatArray]) -> Sequences:
        """Return the sequences whose last face is ``lit`` by a target, and whose beam reaches the box of the targets.

        ``hull_m`` (1, 3), (1, 3, 3) contains the centre of that box, and half of each side.
        """
        last = level.faces[:, -1]
        keep = lit[last]
        row = np.flatnonzero(keep & np.isfinite(self.faces.lower[last, 0]))
        for part in np.array_split(row, max(1, len(row) // 20_000)):
            window = self.bounds.corners_m[last[part]]
            keep[part] = _beam_meets(level.images_m[part, -1], window, *hull_m, self.tolerance_m)
        return Sequences(level.faces[keep], level.images_m[keep])


def _facing(faces: Faces, box: _Bounds, tolerance_m: float) -> BoolArray:
    """Return a mask of pairs (first, second) of faces that each have a point in front of the other face."""
    highest = faces.normal @ box.centre_m.T - faces.offset_m[:, None]
    for half in box.reach_m.transpose(1, 2, 0):
        highest += np.abs(faces.normal @ half)
    ahead = highest > tolerance_m
    return np.asarray(ahead & ahead.T)


def _beam_meets(
    apex: FloatArray, window: FloatArray, centre: FloatArray, reach: FloatArray, tolerance_m: float
) -> BoolArray:
    """Check whether the beam from ``apex`` through the quadrilateral ``window`` may hit a parallelogram or a box.

    ``apex`` (n, 3), ``window`` (n, 4, 3), ``centre`` (n or 1, 3), and ``reach`` (n or 1, axes, 3), which is half of
    each side. The test is conservative: the result is False only if the target is completely outside one side plane of
    the beam.
    """
    # put components first, then corners, so that each step is a pass over contiguous rows of sequences
    ray = np.ascontiguousarray((window - apex[:, None, :]).transpose(2, 1, 0))
    following = ray[:, _NEXT_CORNER]
    side = ray[_SECOND] * following[_THIRD] - ray[_THIRD] * following[_SECOND]
    # the orientation of the window determines the direction of the side planes
    sense = np.sign((side.sum(axis=1) * ray.sum(axis=1)).sum(axis=0))
    ahead = (side * (centre - apex).T[:, None]).sum(axis=0) * sense
    ahead += np.abs((side * reach.transpose(1, 2, 0)[:, :, None]).sum(axis=1)).sum(axis=0)
    # the normals of side planes are not unit vectors, so multiply the tolerance by their length
    size = np.sqrt((side * side).sum(axis=0))
    return np.asarray((ahead >= -tolerance_m * size).all(axis=0))


_NEXT_CORNER, _SECOND, _THIRD = [1, 2, 3, 0], [1, 2, 0], [2, 0, 1]


def _paths_of_level(
    faces: Faces,
    level: Sequences,
    source: FloatArray,
    targets: FloatArray,
    poses: IntArray,
    tower: int,
    max_depth: int,
    hiding: Occlusion,
) -> PathSet:
    """Return paths of all sequences of one length."""
    depth = level.faces.shape[1]
    pieces: list[PathSet] = []
    pose_step = min(len(poses), 4096)
    sequence_step = max(1, CELLS_PER_CHUNK // pose_step)
    for first in range(0, len(poses), pose_step):
        some = poses[first : first + pose_step]
        for start in range(0, len(level.faces), sequence_step):
            part = slice(start, start + sequence_step)
            if depth:
                row, column = _meets_last_face(
                    faces, level.faces[part], level.images_m[part, -1], targets[some], hiding.tolerance_m
                )
            else:
                row, column = np.zeros(len(some), np.int64), np.arange(len(some))
            # use take: for rows of three numbers, it needs a quarter of the time of indexing with brackets
            sequence, images, pose = level.faces[part].take(row, 0), level.images_m[part].take(row, 0), some[column]
            # trace only the few pairs that passed the fast test of the last face
            vertices, good = trace_back(faces, sequence, images, targets.take(pose, 0), hiding.tolerance_m)
            sequence, pose, vertices = sequence[good], pose[good], vertices[good]
            # test for obstacles last, because this is the slowest test
            free = ~hiding.any_segment(np.broadcast_to(source, (len(pose), 3)), vertices, targets[pose])
            pieces.append(PathSet.from_tower(tower, pose[free], sequence[free], vertices[free], max_depth))
    return merge(pieces, max_depth, None)


def _meets_last_face(
    faces: Faces, sequence: IntArray, image: FloatArray, targets: FloatArray, tolerance_m: float
) -> tuple[IntArray, IntArray]:
    """Return the pairs (sequence, target) whose line from the last image is within the bounds of the last face.

    The coordinates of the intersection in the plane of the face are linear in the coordinates of the target, and the
    latter are the same for all sequences that end on the face.

    Parameters
    ----------
    faces : Faces
    sequence : (s, depth)
    image : (s, 3)
        Image of the source in all faces of the sequence [m].
    targets : (n, 3)
        Positions of the targets [m].
    tolerance_m : float
        Distance by which the bounds are enlarged [m].

    Returns
    -------
    sequence, target : (m,)
        Indices of the pairs.
    """
    last = sequence[:, -1]
    used, position = np.unique(last, return_inverse=True)
    height = (faces.normal[used] @ targets.T - faces.offset_m[used, None])[position]
    below = np.einsum("ij,ij->i", faces.normal[last], image) - faces.offset_m[last]
    with np.errstate(divide="ignore", invalid="ignore"):
        share = below[:, None] / (below[:, None] - height)
    good = height >= -tolerance_m
    # for a target behind the face, the intersection has no meaning
    share[~good] = 0.0
    for axis, which in ((faces.along, 0), (faces.across, 1)):
        start = np.einsum("ij,ij->i", axis[last], image)[:, None]
        point = (axis[used] @ targets.T)[position]
        point -= start
        point *= share
        point += start
        good &= point >= faces.lower[last, which, None] - tolerance_m
        good &= point <= faces.upper[last, which, None] + tolerance_m
    if sequence.shape[1] > 1:
        # if the last face is the ground, nearly every line hits it, and tracing all lines back would take most of the
        # search
        often = np.flatnonzero(good.sum(axis=1) > _OFTEN * len(targets))
        good[often] &= _passes_first_faces(faces, sequence[often], image[often], targets)
    row, column = np.divmod(np.flatnonzero(good), len(targets))
    return row, column


# If the share of targets that pass the test of the last face exceeds this, the first faces of the sequence are tested
# for all targets at once.
_OFTEN = 0.1

# If the heights of both ends over a plane differ by less than this [m], the reflection point is uncertain.
_SURE_M = 1e-4


def _passes_first_faces(faces: Faces, sequence: IntArray, image: FloatArray, targets: FloatArray) -> BoolArray:
    """Check, with a margin, whether lines (sequences, targets) from the last images may hit all faces except the last.

    Each face is mirrored at the faces after it, so that the path is a straight line.
    """
    good = np.ones((len(sequence), len(targets)), dtype=np.bool_)
    for step in range(sequence.shape[1] - 1):
        face = sequence[:, step]
        axes = np.stack([faces.normal[face], faces.along[face], faces.across[face]])
        shift = np.stack([-faces.offset_m[face], *np.zeros((2, len(face)))])
        for later in sequence[:, step + 1 :].T:
            across = np.einsum("ksi,si->ks", axes, faces.normal[later])
            axes -= 2.0 * across[..., None] * faces.normal[later]
            shift += 2.0 * across * faces.offset_m[later]
        height, *ends = axes @ targets.T + shift[..., None]
        below, *starts = (np.einsum("ksi,si->ks", axes, image) + shift)[..., None]
        with np.errstate(divide="ignore", invalid="ignore"):
            share = below / (below - height)
            meets = abs(below - height) >= _SURE_M
            for which, (start, end) in enumerate(zip(starts, ends, strict=True)):
                place = start + share * (end - start)
                meets &= place >= faces.lower[face, which, None] - REACH_SLACK_M
                meets &= place <= faces.upper[face, which, None] + REACH_SLACK_M
        # keep the pair if the reflection point is uncertain, because it is traced exactly later
        good &= meets | (abs(below - height) < _SURE_M)
    return good


def trace_back(
    faces: Faces,
    sequence: IntArray,
    images_m: FloatArray,
    targets_m: FloatArray,
    tolerance_m: float,
    edge_m: float | None = None,
) -> tuple[FloatArray, BoolArray]:
    """Return the reflection points of sequences, computed from the target back to the source.

    Source: arXiv 2502.10324 eq. 4.

    Parameters
    ----------
    faces : Faces
    sequence : (paths, depth) int
    images_m : (paths, depth, 3)
    targets_m : (paths, 3)
    tolerance_m : float
        Tolerance of side tests [m].
    edge_m : float, optional
        Distance outside its face up to which a reflection point is still accepted [m]. Default: ``tolerance_m``.

    Returns
    -------
    vertices_m : (paths, depth, 3)
    good : (paths,) bool
        True if each reflection point is inside its face and each path stays on the reflecting side.
    """
    count, depth = sequence.shape
    vertices = np.zeros((count, depth, 3))
    good = np.ones(count, dtype=np.bool_)
    point = targets_m
    for step in range(depth - 1, -1, -1):
        face, image = sequence[:, step], images_m[:, step]
        normal, offset = faces.normal.take(face, 0), faces.offset_m[face]
        ahead = np.einsum("ij,ij->i", normal, point) - offset
        behind = offset - np.einsum("ij,ij->i", normal, image)
        # an end may lie on its face; all other points must lie in front of it
        good &= ahead >= -tolerance_m if step == depth - 1 else ahead > tolerance_m
        good &= (behind >= -tolerance_m if step == 0 else behind > 0.0) & (ahead + behind > tolerance_m)
        with np.errstate(divide="ignore", invalid="ignore"):
            share = behind / (behind + ahead)
        share = np.where(good, share, 0.0)
        point = image + share[:, None] * (point - image)
        vertices[:, step] = point
        good &= inside(faces, face, point, tolerance_m if edge_m is None else edge_m)
    return vertices, good


def retraced(
    faces: Faces,
    sequence: IntArray,
    sources_m: FloatArray,
    targets_m: FloatArray,
    tolerance_m: float,
    edge_m: float | None = None,
) -> tuple[FloatArray, BoolArray]:
    """Return the reflection points of sequences of any length, and which sequences are paths if obstacles are ignored.

    Parameters
    ----------
    faces : Faces
    sequence : (paths, most) int
        Faces in order from the source, -1 where unused.
    sources_m, targets_m : (paths, 3)
        Ends [m].
    tolerance_m, edge_m : float
        The same as in :func:`trace_back`.

    Returns
    -------
    vertices_m : (paths, most, 3)
        Reflection points [m], NaN where unused.
    good : (paths,) bool
    """
    depth, vertices = (sequence >= 0).sum(axis=1), np.full((*sequence.shape, 3), np.nan)
    good = np.zeros(len(sequence), dtype=np.bool_)
    for length in np.unique(depth):
        some = np.flatnonzero(depth == length)
        mirrors = sequence[some, :length]
        images = images_of(faces, mirrors, sources_m[some])
        vertices[some, :length], good[some] = trace_back(faces, mirrors, images, targets_m[some], tolerance_m, edge_m)
    return vertices, good


def images_of(faces: Faces, sequence: IntArray, sources_m: FloatArray) -> FloatArray:
    """Return images (paths, depth, 3) of the sources (paths, 3) at the faces of ``sequence`` (paths, depth)."""
    images = np.zeros((*sequence.shape, 3))
    point = sources_m
    for step in range(sequence.shape[1]):
        normal = faces.normal[sequence[:, step]]
        height = np.einsum("ij,ij->i", normal, point) - faces.offset_m[sequence[:, step]]
        point = point - 2.0 * height[:, None] * normal
        images[:, step] = point
    return images


def merge(pieces: list[PathSet], max_depth: int, faces: Faces | None) -> PathSet:
    """Join sets of paths into one sorted set.

    Parameters
    ----------
    pieces : list of PathSet
    max_depth : int
        Depth of the result if there is no path at all.
    faces : Faces or None
        If given, keep only one of several paths over coplanar faces that overlap.

    Returns
    -------
    PathSet
        Paths, sorted by pose, tower, depth and faces.
    """
    pieces = [piece for piece in pieces if len(piece)]
    if not pieces:
        return PathSet.empty(max_depth)
    paths = PathSet.one_after_another(pieces)
    order = _order(paths)
    if faces is not None:
        order = order[~_repeated(paths, order, faces)[order]]
    same = len(order) == len(paths) and bool((np.diff(order) == 1).all())
    return paths if same else paths.select(order)


def _order(paths: PathSet) -> IntArray:
    """Return the order of rows by pose, tower, depth, faces. Sorting is skipped if they are already sorted."""
    keys = [paths.pose, paths.tower, paths.depth, *paths.faces.T]
    sorted_, tied = np.ones(max(len(paths) - 1, 0), np.bool_), np.ones(max(len(paths) - 1, 0), np.bool_)
    for key in keys:
        step = np.diff(key)
        sorted_ &= ~tied | (step >= 0)
        tied &= step == 0
    return np.arange(len(paths)) if sorted_.all() else np.lexsort(keys[::-1])


def _repeated(paths: PathSet, order: IntArray, faces: Faces) -> BoolArray:
    """Return a mask (paths,) of paths that have the same ends and planes as an earlier path in ``order``."""
    plane = planes_of(faces)
    # a path can repeat only if two faces lie in one plane, which is not the case in most scenes
    shared = np.append(np.bincount(plane)[plane] > 1, False)
    repeated = np.zeros(len(paths), dtype=np.bool_)
    rows = order[shared[paths.faces[order]].any(axis=1)] if shared.any() else order[:0]
    if len(rows):
        same = np.append(plane, -1)[paths.faces[rows]]
        key = np.column_stack([paths.pose[rows], paths.tower[rows], same])
        # do not mark the first of equal rows, which unique returns
        repeated[rows] = True
        repeated[rows[np.unique(key, axis=0, return_index=True)[1]]] = False
    return repeated


def planes_of(faces: Faces) -> IntArray:
    """Return the plane number (faces,) of each face. Coplanar faces with the same orientation have the same number."""
    # faces are coplanar within the rounding errors of a map: a tilt of 1e-9 and an offset of a micrometre
    key = np.column_stack([faces.normal / 1e-9, faces.offset_m / 1e-6]).round() + 0.0
    return np.unique(key, axis=0, return_inverse=True)[1].reshape(-1)


def plane_keys(paths: PathSet, planes: IntArray) -> list[tuple[int, ...]]:
    """Return a key (pose, tower, planes) of each path, which is equal for equal paths. ``planes`` has shape (faces,).

    Keys do not contain unused entries, because two sets may have different depths.
    """
    rows = np.column_stack([paths.pose, paths.tower, np.append(planes, -1)[paths.faces]])
    # use tuples, which can be members of sets
    return [tuple(number for number in row if number >= 0) for row in rows.tolist()]
