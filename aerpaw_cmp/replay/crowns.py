"""Opaque crowns as mirrors: every path with exactly one bounce off a crown, in float64.

Woods have too many facets for the main search to follow all sequences, so crowns stay out of the traced scene. What is
found here are all paths that meet one facet of one crown, directly or with a reflection at the tower's ground before
it, after it, or (three reflections) both. Mirrored in that ground, the source or the target turns each of these into a
single bounce. Sequences of a crown with a building or with a second crown are left out.

Crowns are the polygonal cones of :func:`aerpaw_cmp.site.meshes.site_meshes`: triangular sides and a flat bottom. They
lie inside the round cones that block, and are convex: a crown never hides its own bounce.

Facets and poses are thinned by beams: the pyramid from the image of the source through the facet against the boxes of
a few poses each, all at once as one matrix product; then the same planes against the poses of the boxes that are left.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import shapely

from ..site.dem import Dem
from ..site.materials import CROWN
from ..site.meshes import CROWN_SIDES, crown_corners_m
from ..site.site import Trees
from ..units import BoolArray, FloatArray, IntArray
from .foliage import CrownIndex
from .image import CELLS_PER_CHUNK, MINIMUM_LENGTH_M, RELATIVE_TOLERANCE, Occlusion, merge
from .paths import Faces, PathSet, joined

FACES_PER_CROWN = CROWN_SIDES + 1
"""Sides, then the bottom."""

SLACK_M = 1e-3
"""Of the beams, which only thin out: far above their rounding; the reflection point decides."""

TARGETS_PER_BOX = 32
TARGETS_AT_ONCE = 16_384


@dataclass(frozen=True, slots=True)
class _Facets:
    """Facets with the same number of corners.

    ``corners_m`` (facets, corners, 3) counter-clockwise seen from outside, ``normal`` (facets, 3), ``offset_m``
    (facets,), ``number`` (facets,): tree times :data:`FACES_PER_CROWN` plus side.
    """

    corners_m: FloatArray
    normal: FloatArray
    offset_m: FloatArray
    number: IntArray

    @classmethod
    def of(cls, corners_m: FloatArray, number: IntArray) -> _Facets:
        one, two = corners_m[:, 1] - corners_m[:, 0], corners_m[:, 2] - corners_m[:, 0]
        normal = np.cross(one, two)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        return cls(corners_m, normal, np.einsum("fi,fi->f", normal, corners_m[:, 0]), number)

    def select(self, rows: IntArray) -> _Facets:
        return _Facets(self.corners_m[rows], self.normal[rows], self.offset_m[rows], self.number[rows])

    def contain(self, rows: IntArray, point_m: FloatArray, tolerance_m: float) -> BoolArray:
        """Whether points (n, 3) in the planes of the facets ``rows`` (n,) lie inside them."""
        corners, normal = self.corners_m[rows], self.normal[rows]
        edge = np.roll(corners, -1, axis=1) - corners
        inward = np.cross(normal[:, None], edge)
        depth = np.einsum("nki,nki->nk", inward, point_m[:, None] - corners)
        return np.asarray((depth >= -tolerance_m * np.linalg.norm(edge, axis=2)).all(axis=1))


class Crowns:
    """The crowns of trees as mirrors; built once for many replays.

    Parameters
    ----------
    trees : Trees
        Any number; trees without a crown reflect nothing.
    """

    def __init__(self, trees: Trees) -> None:
        self.trees = trees
        self.index = CrownIndex(trees)
        solid = np.flatnonzero((trees.crown_diameter_m > 0) & (trees.height_m > trees.crown_base_m))
        rim, tip = crown_corners_m(trees)
        rim, tip = rim[solid], tip[solid]
        tips = np.broadcast_to(tip[:, None], rim.shape)
        sides = np.stack([rim, np.roll(rim, -1, axis=1), tips], axis=2).reshape(-1, 3, 3)
        first = solid * FACES_PER_CROWN
        self._families: tuple[_Facets, ...] = ()
        if len(solid):
            self._families = (
                _Facets.of(sides, (first[:, None] + np.arange(CROWN_SIDES)).reshape(-1)),
                _Facets.of(rim[:, ::-1], first + CROWN_SIDES),
            )

    def bounces(
        self,
        faces: Faces,
        sources_m: FloatArray,
        targets_m: FloatArray,
        *,
        max_depth: int = 2,
        usable: BoolArray | None = None,
        excluded: BoolArray | None = None,
        dem: Dem | None = None,
    ) -> tuple[PathSet, Faces]:
        """All paths with one bounce off a crown that neither buildings nor trees nor terrain stop.

        Parameters
        ----------
        faces : Faces
            The traced scene: ground planes and buildings.
        sources_m : (towers, 3)
        targets_m : (poses, 3)
            NaN positions have no path.
        max_depth : int
            Largest number of reflections; without one there is nothing to find.
        usable : (towers, faces) bool, optional
            Faces that may reflect for each tower; of these, ground planes count here.
        excluded : (towers, poses) bool, optional
            Links without any path.
        dem : Dem, optional
            Terrain that may stop the way to the crown and from it.

        Returns
        -------
        paths : PathSet
            Sorted by pose, tower, depth, faces.
        faces : Faces
            ``faces`` and, after them, the facets that the paths meet.
        """
        known = np.isfinite(targets_m).all(axis=1)
        alive = known & (np.linalg.norm(targets_m - sources_m[:, None], axis=2) >= MINIMUM_LENGTH_M)
        alive &= True if excluded is None else ~excluded
        tolerance_m = self._tolerance_m(sources_m, targets_m)
        hiding = Occlusion(faces, tolerance_m)
        ground = faces.solid[None] < 0 if usable is None else usable & (faces.solid < 0)
        ground = np.broadcast_to(ground, (len(sources_m), len(faces)))
        found: list[PathSet] = []
        for tower, source in enumerate(sources_m):
            poses = np.flatnonzero(alive[tower])
            for before, after, plane in _sequences(np.flatnonzero(ground[tower]), max_depth):
                search = _Search(self, faces, hiding, plane, before, after, dem)
                for start in range(0, len(poses), TARGETS_AT_ONCE):
                    some = poses[start : start + TARGETS_AT_ONCE]
                    found.append(search(source, targets_m, some, tower, max_depth))
        paths = merge(found, max_depth, None)
        return self._with_facets(paths, faces, max_depth)

    def _tolerance_m(self, *points_m: FloatArray) -> float:
        """As :func:`aerpaw_cmp.replay.image.scene_tolerance_m`, with the crowns in the scene."""
        sizes = [1.0, *(float(np.nanmax(np.abs(p), initial=0.0, where=np.isfinite(p))) for p in points_m)]
        sizes += [float(np.abs(facets.corners_m).max()) for facets in self._families]
        return RELATIVE_TOLERANCE * max(sizes)

    def _with_facets(self, paths: PathSet, faces: Faces, max_depth: int) -> tuple[PathSet, Faces]:
        """Facets get the numbers after the scene's faces; where coplanar ones overlap, one path is kept."""
        crown = paths.tree >= 0
        used, position = np.unique(paths.faces[crown], return_inverse=True)
        if not len(used):
            return paths, faces
        sequence = paths.faces.copy()
        sequence[crown] = len(faces) + position
        both = joined(faces, self._faces(used, int(faces.solid.max(initial=-1)) + 1))
        return merge([replace(paths, faces=sequence)], max_depth, both), both

    def _faces(self, number: IntArray, solids: int) -> Faces:
        """Columns of the facets ``number``; their solids count on from ``solids`` by tree."""
        tree, side = np.divmod(number, FACES_PER_CROWN)
        normal, along, across = (np.zeros((len(number), 3)) for _ in range(3))
        lower, upper = np.zeros((len(number), 2)), np.zeros((len(number), 2))
        polygon, offset = np.empty(len(number), dtype=object), np.zeros(len(number))
        for facets in self._families:
            rows = np.flatnonzero(np.isin(number, facets.number))
            mine = facets.select(np.searchsorted(facets.number, number[rows]))
            edge = mine.corners_m[:, 1] - mine.corners_m[:, 0]
            normal[rows], offset[rows] = mine.normal, mine.offset_m
            along[rows] = edge / np.linalg.norm(edge, axis=1, keepdims=True)
            across[rows] = np.cross(normal[rows], along[rows])
            flat = np.einsum("fki,afi->fka", mine.corners_m, np.stack([along[rows], across[rows]]))
            lower[rows], upper[rows], polygon[rows] = flat.min(axis=1), flat.max(axis=1), shapely.polygons(flat)
        names = [f"side {k + 1}" if k < CROWN_SIDES else "bottom" for k in side]
        return Faces(
            normal=normal,
            offset_m=offset,
            material=(CROWN,) * len(number),
            label=tuple(f"crown {t + 1} {name}" for t, name in zip(tree, names, strict=True)),
            along=along,
            across=across,
            lower=lower,
            upper=upper,
            polygon=tuple(polygon),
            solid=solids + tree,
        )


def _sequences(grounds: IntArray, max_depth: int) -> Iterator[tuple[bool, bool, int]]:
    """(ground before the crown, ground after it, ground plane) of at most ``max_depth`` reflections."""
    if max_depth >= 1:
        yield False, False, -1
    for plane in grounds:
        if max_depth >= 2:
            yield True, False, int(plane)
            yield False, True, int(plane)
        if max_depth >= 3:
            yield True, True, int(plane)


@dataclass(frozen=True, slots=True)
class _Search:
    """Paths of one kind: ground before or after the crown, or neither."""

    crowns: Crowns
    faces: Faces
    hiding: Occlusion
    ground: int
    before: bool
    after: bool
    dem: Dem | None

    def __call__(
        self, source_m: FloatArray, targets_m: FloatArray, poses: IntArray, tower: int, max_depth: int
    ) -> PathSet:
        """Paths from one source to some targets."""
        tolerance_m, depth = self.hiding.tolerance_m, 1 + self.before + self.after
        if self.ground >= 0:
            if self._height(source_m[None])[0] <= tolerance_m:
                return PathSet.empty(max_depth)
            poses = poses[self._height(targets_m[poses]) > tolerance_m]
        start = self._mirrored(source_m[None])[0] if self.before else source_m
        target = self._mirrored(targets_m[poses]) if self.after else targets_m[poses]
        pieces: list[PathSet] = []
        for facets in self.crowns._families:
            facet, pose, point = _single_bounces(facets, start, target, tolerance_m)
            pose, number = poses[pose], facets.number[facet]
            vertices, good = self._unfolded(source_m, point, targets_m[pose])
            pose, number, vertices = pose[good], number[good], vertices[good]
            free = self._free(source_m, vertices, targets_m[pose], number // FACES_PER_CROWN)
            pose, number, vertices = pose[free], number[free], vertices[free]
            sequence, points, tree = (
                np.full((len(pose), max_depth), -1),
                np.full((len(pose), max_depth, 3), np.nan),
                np.full((len(pose), max_depth), -1),
            )
            sequence[:, :depth] = self.ground
            sequence[:, int(self.before)] = number
            points[:, :depth] = vertices
            tree[:, int(self.before)] = number // FACES_PER_CROWN
            pieces.append(PathSet(pose, np.full(len(pose), tower), np.full(len(pose), depth), sequence, points, tree))
        return merge(pieces, max_depth, None)

    def _height(self, point_m: FloatArray) -> FloatArray:
        """Heights (n,) above the ground plane."""
        return np.asarray(point_m @ self.faces.normal[self.ground] - self.faces.offset_m[self.ground])

    def _mirrored(self, point_m: FloatArray) -> FloatArray:
        return np.asarray(point_m - 2.0 * self._height(point_m)[:, None] * self.faces.normal[self.ground])

    def _unfolded(
        self, source_m: FloatArray, point_m: FloatArray, target_m: FloatArray
    ) -> tuple[FloatArray, BoolArray]:
        """All reflection points (paths, depth, 3) from those on the crowns, and whether these are above the ground."""
        points, good = [point_m], np.ones(len(point_m), dtype=np.bool_)
        if self.ground >= 0:
            good = self._height(point_m) > self.hiding.tolerance_m
        for wanted, place, end in ((self.before, 0, source_m), (self.after, len(points) + 1, target_m)):
            if wanted:
                end = np.broadcast_to(end, point_m.shape)
                below, above = self._height(end), self._height(point_m)
                with np.errstate(divide="ignore", invalid="ignore"):
                    share = (below / (below + above))[:, None]
                points.insert(place, end + share * (self._mirrored(point_m) - end))
        return np.stack(points, axis=1), good

    def _free(self, source_m: FloatArray, vertices_m: FloatArray, target_m: FloatArray, tree: IntArray) -> BoolArray:
        """Which paths no tree, building or terrain stops."""
        source = np.broadcast_to(source_m, target_m.shape)
        crown = int(self.before)
        points = [source, *np.moveaxis(vertices_m, 1, 0), target_m]
        # an end in the narrow space between the facet and the round crown is inside the crown
        free = ~(self._inside(source, tree) | self._inside(target_m, tree))
        for step, (start, end) in enumerate(pairwise(points)):
            rows = np.flatnonzero(free)
            own = tree[rows] if step in (crown, crown + 1) else None
            free[rows] = self.crowns.index.chords_m(start[rows], end[rows], own) == 0.0
            rows = np.flatnonzero(free)
            free[rows] = self.crowns.index.trunks().chords_m(start[rows], end[rows]) == 0.0
            rows = np.flatnonzero(free)
            free[rows] = ~self.hiding.segments(start[rows], end[rows])
        if self.dem is not None:  # it is asked on the way without the ground points, whose plane is not the terrain
            bounce = points[crown + 1]
            for start, end in ((source, bounce), (bounce, target_m)):
                rows = np.flatnonzero(free)
                free[rows] = self.dem.clear(start[rows], end[rows])
        return free

    def _inside(self, point_m: FloatArray, tree: IntArray) -> BoolArray:
        """Whether points (n, 3) lie in the round crowns of trees (n,)."""
        t = self.crowns.trees
        top, base = (t.ground_m + t.height_m)[tree], (t.ground_m + t.crown_base_m)[tree]
        width = t.crown_diameter_m[tree] / 2 * (top - point_m[:, 2]) / (top - base)
        away = np.hypot(point_m[:, 0] - t.east_m[tree], point_m[:, 1] - t.north_m[tree])
        return np.asarray((point_m[:, 2] > base) & (away < width))


def _single_bounces(
    facets: _Facets, source_m: FloatArray, targets_m: FloatArray, tolerance_m: float
) -> tuple[IntArray, IntArray, FloatArray]:
    """All specular points of facets between a source and targets, whatever lies between.

    Returns
    -------
    facet, target : (points,) int
    point_m : (points, 3)
    """
    empty = np.zeros(0, dtype=np.int64)
    height = facets.normal @ source_m - facets.offset_m
    lit = np.flatnonzero(height > tolerance_m)
    if not len(lit) or not len(targets_m):
        return empty, empty, np.zeros((0, 3))
    facets, height = facets.select(lit), height[lit]
    image = source_m - 2.0 * height[:, None] * facets.normal
    facet, target = _candidates(_beams(facets, image), targets_m)
    ahead = np.einsum("ni,ni->n", facets.normal[facet], targets_m[target]) - facets.offset_m[facet]
    good = ahead > tolerance_m
    facet, target, ahead = facet[good], target[good], ahead[good]
    behind = height[facet]
    point = image[facet] + (behind / (behind + ahead))[:, None] * (targets_m[target] - image[facet])
    good = facets.contain(facet, point, tolerance_m)
    return lit[facet[good]], target[good], point[good]


def _beams(facets: _Facets, image_m: FloatArray) -> FloatArray:
    """Planes (facets, corners + 1, 4) round what the images light through their facets.

    ``plane . (x, 1)`` is the distance [m] of x inside: of the planes through the edges, then of the facet.
    """
    ray = facets.corners_m - image_m[:, None]
    side = np.cross(ray, np.roll(ray, -1, axis=1))  # inwards: the corners go counter-clockwise seen from the front
    side /= np.linalg.norm(side, axis=2, keepdims=True) + 1e-300
    planes = np.empty((len(image_m), side.shape[1] + 1, 4))
    planes[:, :-1, :3] = side
    planes[:, :-1, 3] = -np.einsum("fki,fi->fk", side, image_m)
    planes[:, -1, :3] = facets.normal
    planes[:, -1, 3] = -facets.offset_m
    return planes


def _candidates(beams: FloatArray, targets_m: FloatArray) -> tuple[IntArray, IntArray]:
    """Pairs (beam, target) of beams (n, planes, 4) and the targets inside them, but for :data:`SLACK_M`."""
    boxes = _boxes(targets_m)
    low = np.array([targets_m[box].min(axis=0) for box in boxes])
    high = np.array([targets_m[box].max(axis=0) for box in boxes])
    # the corner of a box farthest along a plane's normal m lies at m . centre + |m| . half
    size = np.concatenate([(low + high) / 2, np.ones((len(boxes), 1)), (high - low) / 2], axis=1).T
    step = max(1, CELLS_PER_CHUNK // (beams.shape[1] * len(boxes)))
    beam_of: list[IntArray] = []
    box_of: list[IntArray] = []
    for start in range(0, len(beams), step):
        some = beams[start : start + step]
        reach = np.concatenate([some, np.abs(some[..., :3])], axis=2) @ size
        beam, box = np.nonzero((reach >= -SLACK_M).all(axis=1))
        beam_of.append(beam + start)
        box_of.append(box)
    beam, box = np.concatenate(beam_of), np.concatenate(box_of)
    order = np.argsort(box, kind="stable")
    groups = np.split(beam[order], np.searchsorted(box[order], np.arange(1, len(boxes))))
    found_beam: list[IntArray] = []
    found_target: list[IntArray] = []
    for members, rows in zip(boxes, groups, strict=True):
        place = np.concatenate([targets_m[members], np.ones((len(members), 1))], axis=1).T
        one, two = np.nonzero((beams[rows] @ place >= -SLACK_M).all(axis=1))
        found_beam.append(rows[one])
        found_target.append(members[two])
    return np.concatenate(found_beam), np.concatenate(found_target)


def _boxes(points_m: FloatArray) -> list[IntArray]:
    """Indices of points in groups of neighbours, halved along the longest side until they are few."""
    done: list[IntArray] = []
    left = [np.arange(len(points_m))]
    while left:
        some = left.pop()
        if len(some) <= TARGETS_PER_BOX:
            done.append(some)
            continue
        axis = int(np.argmax(np.ptp(points_m[some], axis=0)))
        middle = len(some) // 2
        order = np.argpartition(points_m[some, axis], middle)
        left += [some[order[:middle]], some[order[middle:]]]
    return done
