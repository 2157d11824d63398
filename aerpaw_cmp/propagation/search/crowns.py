"""Opaque crowns as mirrors: every path with exactly one bounce off a crown, in float64.

Woods have too many facets for the main search to follow all sequences, so crowns stay out of the traced scene. What is
found here are all paths that meet one facet of one crown, directly or with a reflection at the tower's ground before
it, after it, or (three reflections) both. Mirrored in that ground, the source or the target turns each of these into a
single bounce. Sequences of a crown with a building or with a second crown are left out.

Crowns are the polygonal cones of :func:`aerpaw_cmp.site.meshes.site_meshes`: triangular sides and a flat bottom. They
lie inside the round cones that block, and are convex: a crown never hides its own bounce.

Facets and poses are thinned by beams, the pyramids from the image of the source through the facets: only poses inside
the rectangle, east and north, that a beam lights between the lowest and the highest pose are looked at.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import shapely

from ...common.units import BoolArray, FloatArray, IntArray
from ...site.dem import Dem
from ...site.materials import CROWN
from ...site.meshes import CROWN_SIDES, crown_corners_m
from ...site.site import Trees
from ..field.foliage import crown_index
from ..paths import Faces, Links, PathSet, joined
from .mirror import CELLS_PER_CHUNK, RELATIVE_TOLERANCE, merge, searched_links
from .occlusion import Occlusion

# Sides, then the bottom.
FACES_PER_CROWN = CROWN_SIDES + 1

# Margin of the beams, which only thin out: far above their rounding; the reflection point decides.
SLACK_M = 1e-3

# Poses are looked up in layers of about this height: beams light little of each.
LAYER_M, MOST_LAYERS = 10.0, 12

# Beams whose rectangle is larger than this share of the poses', both ways, are tried against every pose at once.
WIDE_SHARE = 0.2

# Sources whose beams are kept; 10 MB each for 10 000 trees.
KEPT_BEAMS = 12

# Each of them holds less than a fifth of the poses both ways.
RECTANGLES_AT_ONCE = 2_000


@dataclass(frozen=True, slots=True)
class _Facets:
    """Facets with the same number of corners.

    ``corners_m`` (facets, corners, 3) counter-clockwise seen from outside, ``normal`` (facets, 3), ``offset_m``
    (facets,), ``number`` (facets,): tree times :data:`FACES_PER_CROWN` plus side. ``inward`` (facets, corners, 3) are
    unit normals of the edges in the facet, ``edge_m`` (facets, corners) how far along them the edges lie.
    """

    corners_m: FloatArray
    normal: FloatArray
    offset_m: FloatArray
    number: IntArray
    inward: FloatArray
    edge_m: FloatArray

    @classmethod
    def of(cls, corners_m: FloatArray, number: IntArray) -> _Facets:
        edge, other_edge = corners_m[:, 1] - corners_m[:, 0], corners_m[:, 2] - corners_m[:, 0]
        normal = np.cross(edge, other_edge)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        offset = np.einsum("fi,fi->f", normal, corners_m[:, 0])
        inward = np.cross(normal[:, None], np.roll(corners_m, -1, axis=1) - corners_m)
        inward /= np.linalg.norm(inward, axis=2, keepdims=True)
        return cls(
            corners_m=corners_m,
            normal=normal,
            offset_m=offset,
            number=number,
            inward=inward,
            edge_m=np.einsum("fki,fki->fk", inward, corners_m),
        )

    def contain(self, rows: IntArray, point_m: FloatArray, tolerance_m: float) -> BoolArray:
        """Check whether points (n, 3) in the planes of the facets ``rows`` (n,) lie inside them."""
        depth = np.einsum("nki,ni->nk", self.inward[rows], point_m) - self.edge_m[rows]
        return np.asarray((depth >= -tolerance_m).all(axis=1))


class Crowns:
    """The crowns of trees as mirrors; built once for many replays.

    Parameters
    ----------
    trees : Trees
        Any number; trees without a crown reflect nothing.
    """

    def __init__(self, trees: Trees) -> None:
        self.trees = trees
        self.index = crown_index(trees)
        solid = np.flatnonzero((trees.crown_diameter_m > 0) & (trees.height_m > trees.crown_base_m))
        rim, tip = crown_corners_m(trees)
        rim, tip = rim[solid], tip[solid]
        tips = np.broadcast_to(tip[:, None], rim.shape)
        sides = np.stack([rim, np.roll(rim, -1, axis=1), tips], axis=2).reshape(-1, 3, 3)
        first = solid * FACES_PER_CROWN
        self._families: tuple[_Facets, ...] = ()
        self._beams: dict[bytes, tuple[_Beams, ...]] = {}
        if len(solid):
            self._families = (
                _Facets.of(sides, (first[:, None] + np.arange(CROWN_SIDES)).reshape(-1)),
                _Facets.of(rim[:, ::-1], first + CROWN_SIDES),
            )

    def bounces(
        self,
        faces: Faces,
        links: Links,
        *,
        max_depth: int = 2,
        dem: Dem | None = None,
    ) -> tuple[PathSet, Faces]:
        """All paths with one bounce off a crown that neither buildings nor trees nor terrain stop.

        Parameters
        ----------
        faces : Faces
            The traced scene: ground planes and buildings.
        links : Links
            Of the usable faces, ground planes count here.
        max_depth : int
            Largest number of reflections; without one there is nothing to find.
        dem : Dem, optional
            Terrain that may stop the way to the crown and from it.

        Returns
        -------
        paths : PathSet
            Sorted by pose, tower, depth, faces.
        faces : Faces
            ``faces`` and, after them, the facets that the paths meet.
        """
        alive = searched_links(links)
        tolerance_m = self._tolerance_m(links.sources_m, links.targets_m)
        hiding = Occlusion(faces, tolerance_m)
        sources_m, targets_m, usable = links.sources_m, links.targets_m, links.usable
        ground = faces.solid[None] < 0 if usable is None else usable & (faces.solid < 0)
        ground = np.broadcast_to(ground, (len(sources_m), len(faces)))
        pieces: list[PathSet] = []
        for tower, source in enumerate(sources_m):
            poses = np.flatnonzero(alive[tower])
            for before, after, plane in _sequences(np.flatnonzero(ground[tower]), max_depth):
                search = _Search(
                    crowns=self, faces=faces, hiding=hiding, ground=plane, before=before, after=after, dem=dem
                )
                pieces.append(search(source, targets_m, poses, tower, max_depth))
        paths = merge(pieces, max_depth, None)
        return self._with_facets(paths, faces, max_depth)

    def beams(self, source_m: FloatArray) -> tuple[_Beams, ...]:
        """Beams of each family of facets; those of the last sources are kept, for replays of few poses each."""
        key = source_m.tobytes()
        if key not in self._beams:
            if len(self._beams) >= KEPT_BEAMS:
                self._beams.pop(next(iter(self._beams)))
            tolerance_m = self._tolerance_m(source_m)
            self._beams[key] = tuple(_Beams.of(facets, source_m, tolerance_m) for facets in self._families)
        return self._beams[key]

    def _tolerance_m(self, *points_m: FloatArray) -> float:
        """As :func:`aerpaw_cmp.propagation.search.mirror.scene_tolerance_m`, with the crowns in the scene."""
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
        extended = joined(faces, self._faces(used, int(faces.solid.max(initial=-1)) + 1))
        return merge([replace(paths, faces=sequence)], max_depth, extended), extended

    def _faces(self, number: IntArray, solids: int) -> Faces:
        """Columns of the facets ``number``; their solids count on from ``solids`` by tree."""
        tree, side = np.divmod(number, FACES_PER_CROWN)
        normal, along, across = (np.zeros((len(number), 3)) for _ in range(3))
        lower, upper = np.zeros((len(number), 2)), np.zeros((len(number), 2))
        polygon, offset = np.empty(len(number), dtype=object), np.zeros(len(number))
        for facets in self._families:
            rows = np.flatnonzero(np.isin(number, facets.number))
            at = np.searchsorted(facets.number, number[rows])
            corners = facets.corners_m[at]
            edge = corners[:, 1] - corners[:, 0]
            normal[rows], offset[rows] = facets.normal[at], facets.offset_m[at]
            along[rows] = edge / np.linalg.norm(edge, axis=1, keepdims=True)
            across[rows] = np.cross(normal[rows], along[rows])
            flat = np.einsum("fki,afi->fka", corners, np.stack([along[rows], across[rows]]))
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
        start = self.faces.mirrored(self.ground, source_m[None])[0] if self.before else source_m
        target = self.faces.mirrored(self.ground, targets_m[poses]) if self.after else targets_m[poses]
        pieces: list[PathSet] = []
        for facets, beams in zip(self.crowns._families, self.crowns.beams(start), strict=True):
            facet, pose, point = _single_bounces(facets, beams, target, tolerance_m)
            pose, number = poses[pose], facets.number[facet]
            vertices, good = self._unfolded(source_m, point, targets_m[pose])
            pose, number, vertices = pose[good], number[good], vertices[good]
            free = self._free(source_m, vertices, targets_m[pose], number // FACES_PER_CROWN)
            pose, number, vertices = pose[free], number[free], vertices[free]
            sequence, tree = np.full((len(pose), depth), self.ground), np.full((len(pose), max_depth), -1)
            sequence[:, int(self.before)] = number
            tree[:, int(self.before)] = number // FACES_PER_CROWN
            pieces.append(replace(PathSet.from_tower(tower, pose, sequence, vertices, max_depth), tree=tree))
        return merge(pieces, max_depth, None)

    def _height(self, point_m: FloatArray) -> FloatArray:
        """Heights (n,) above the ground plane."""
        return self.faces.height_m(self.ground, point_m)

    def _unfolded(
        self, source_m: FloatArray, point_m: FloatArray, target_m: FloatArray
    ) -> tuple[FloatArray, BoolArray]:
        """All reflection points (paths, depth, 3) from those on the crowns, and whether these are above the ground."""
        points, good = [point_m], np.ones(len(point_m), dtype=np.bool_)
        if self.ground >= 0:
            good = self._height(point_m) > self.hiding.tolerance_m
        for mirrored, place, end in ((self.before, 0, source_m), (self.after, len(points) + 1, target_m)):
            if mirrored:
                end = np.broadcast_to(end, point_m.shape)
                below, above = self._height(end), self._height(point_m)
                with np.errstate(divide="ignore", invalid="ignore"):
                    share = (below / (below + above))[:, None]
                points.insert(place, end + share * (self.faces.mirrored(self.ground, point_m) - end))
        return np.stack(points, axis=1), good

    def _free(self, source_m: FloatArray, vertices_m: FloatArray, target_m: FloatArray, tree: IntArray) -> BoolArray:
        """Check whether paths are free: no tree, building or terrain stops them."""
        source = np.broadcast_to(source_m, target_m.shape)
        crown = int(self.before)
        points = [source, *np.moveaxis(vertices_m, 1, 0), target_m]
        # an end in the narrow space between the facet and the round crown is inside the crown
        free = ~(self._inside(source, tree) | self._inside(target_m, tree))
        for step, (start, end) in enumerate(pairwise(points)):
            rows = np.flatnonzero(free)
            bouncing = tree[rows] if step in (crown, crown + 1) else None
            free[rows] = self.crowns.index.chords_m(start[rows], end[rows], bouncing) == 0.0
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
        """Check whether points (n, 3) lie in the round crowns of trees (n,)."""
        t = self.crowns.trees
        top, base = (t.ground_m + t.height_m)[tree], (t.ground_m + t.crown_base_m)[tree]
        width = t.crown_diameter_m[tree] / 2 * (top - point_m[:, 2]) / (top - base)
        distance = np.hypot(point_m[:, 0] - t.east_m[tree], point_m[:, 1] - t.north_m[tree])
        return np.asarray((point_m[:, 2] > base) & (distance < width))


@dataclass(frozen=True, slots=True)
class _Beams:
    """Regions that a source lights by way of facets: pyramids from its images through them.

    ``facet`` (beams,) of the family; ``height_m`` (beams,) of the source above its plane; ``image_m`` (3, beams);
    ``ray_m`` (corners, 3, beams) from the image to the corners. Nothing is lit below ``floor_m`` (beams,) and above
    ``ceiling_m`` (beams,).
    """

    facet: IntArray
    height_m: FloatArray
    image_m: FloatArray
    ray_m: FloatArray
    floor_m: FloatArray
    ceiling_m: FloatArray

    @classmethod
    def of(cls, facets: _Facets, source_m: FloatArray, tolerance_m: float) -> _Beams:
        height = facets.normal @ source_m - facets.offset_m
        lit = np.flatnonzero(height > tolerance_m)
        image = (source_m - 2.0 * height[lit, None] * facets.normal[lit]).T.copy()
        corners = np.ascontiguousarray(np.moveaxis(facets.corners_m[lit], 0, -1))
        ray = corners - image
        falls, rises = (ray[:, 2] <= 0).any(axis=0), (ray[:, 2] >= 0).any(axis=0)
        floor = np.where(falls, -np.inf, corners[:, 2].min(axis=0))
        return cls(
            facet=lit,
            height_m=height[lit],
            image_m=image,
            ray_m=ray,
            floor_m=floor,
            ceiling_m=np.where(rises, np.inf, corners[:, 2].max(axis=0)),
        )


def _single_bounces(
    facets: _Facets, beams: _Beams, targets_m: FloatArray, tolerance_m: float
) -> tuple[IntArray, IntArray, FloatArray]:
    """All specular points of facets between a source and targets, whatever lies between.

    Returns
    -------
    facet, target : (points,) int
    point_m : (points, 3)
    """
    none = np.zeros(0, dtype=np.int64)
    pieces: list[tuple[IntArray, IntArray, FloatArray]] = [(none, none, np.zeros((0, 3)))]
    for beam, target in _candidates(beams, targets_m):
        facet, behind = beams.facet[beam], beams.height_m[beam]
        ahead = np.einsum("ni,ni->n", facets.normal[facet], targets_m[target]) - facets.offset_m[facet]
        good = np.flatnonzero(ahead > tolerance_m)
        facet, target, share = facet[good], target[good], (behind / (behind + ahead))[good]
        image = beams.image_m[:, beam[good]].T
        point = image + share[:, None] * (targets_m[target] - image)
        good = np.flatnonzero(facets.contain(facet, point, tolerance_m))
        pieces.append((facet[good], target[good], point[good]))
    facet, target, point = (np.concatenate(x) for x in zip(*pieces, strict=True))
    return facet, target, point


def _candidates(beams: _Beams, targets_m: FloatArray) -> Iterator[tuple[IntArray, IntArray]]:
    """Pairs (beam, target) that could belong to each other, layer by layer of the targets' heights."""
    if not len(targets_m):
        return
    order = np.argsort(targets_m[:, 2], kind="stable")
    height = targets_m[order, 2]
    layers = 1 + int(min(height[-1] - height[0], LAYER_M * MOST_LAYERS) / LAYER_M)
    edges = np.linspace(height[0], height[-1], layers + 1)[1:-1]
    for members in np.split(order, np.searchsorted(height, edges)):
        if not len(members):
            continue
        some = targets_m[members]
        bottom, top = float(some[:, 2].min()) - SLACK_M, float(some[:, 2].max()) + SLACK_M
        rows = np.flatnonzero((beams.floor_m <= top) & (beams.ceiling_m >= bottom))
        low, high = _shadows(beams, rows, bottom, top)
        first, last = some[:, :2].min(axis=0)[:, None], some[:, :2].max(axis=0)[:, None]
        size = np.minimum(high, last) - np.maximum(low, first)
        wide = (size > WIDE_SHARE * (last - first)).all(axis=0)
        narrow = np.flatnonzero(~wide & (size >= 0.0).all(axis=0))
        for beam, target in _within(low[:, narrow], high[:, narrow], some):
            yield rows[narrow[beam]], members[target]
        for beam, target in _lit(beams, rows[wide], some):
            yield beam, members[target]


def _shadows(beams: _Beams, rows: IntArray, low_m: float, high_m: float) -> tuple[FloatArray, FloatArray]:
    """Bounds (2, rows), east and north [m], of what some beams light between two heights.

    It is bounded by the rays through the corners, beyond the facet. Where all of them rise, or all fall, they leave
    the heights in between within a finite distance; else the bounds are infinite.
    """
    # taken, not indexed: an index on the last axis would put the beams first in memory, and the bounds are taken over
    # the others
    image, ray = beams.image_m.take(rows, axis=1), beams.ray_m.take(rows, axis=2)
    rise = ray[:, 2]
    endless = np.isinf(beams.floor_m[rows]) & np.isinf(beams.ceiling_m[rows])
    with np.errstate(divide="ignore", invalid="ignore"):
        at_low, at_high = (low_m - image[2]) / rise, (high_m - image[2]) / rise
    first, last = np.minimum(at_low, at_high), np.maximum(at_low, at_high)  # 1 is the facet
    across = (first < 1.0).any(axis=0)  # the facet itself may take part in the bounds
    share = np.stack([np.maximum(first, 1.0), np.maximum(last, 1.0), np.where(across, 1.0, first)])
    share[..., endless] = 1.0
    place = image[:2] + share[:, :, None] * ray[:, :2]  # (3, corners, 2, rows)
    low, high = place.min(axis=(0, 1)) - SLACK_M, place.max(axis=(0, 1)) + SLACK_M
    low[:, endless], high[:, endless] = -np.inf, np.inf
    return low, high


def _lit(beams: _Beams, rows: IntArray, points_m: FloatArray) -> Iterator[tuple[IntArray, IntArray]]:
    """Pairs (beam, point) of some beams and the points between the planes through their edges; all are tried."""
    place = np.concatenate([points_m, np.ones((len(points_m), 1))], axis=1).T
    step = max(1, CELLS_PER_CHUNK // (len(beams.ray_m) * len(points_m)))
    for start in range(0, len(rows), step):
        part = rows[start : start + step]
        ray = np.moveaxis(beams.ray_m[:, :, part], -1, 0)
        side = np.cross(ray, np.roll(ray, -1, axis=1))  # inwards: counter-clockwise seen from the front
        side /= np.linalg.norm(side, axis=2, keepdims=True) + 1e-300
        planes = np.concatenate([side, -np.einsum("fki,if->fk", side, beams.image_m[:, part])[..., None]], axis=2)
        beam, point = np.nonzero((planes @ place >= -SLACK_M).all(axis=1))
        yield part[beam], point


def _within(low_m: FloatArray, high_m: FloatArray, points_m: FloatArray) -> Iterator[tuple[IntArray, IntArray]]:
    """Pairs (rectangle, point) of all points inside rectangles (2, n), in parts of bounded size."""
    first, last = points_m[:, :2].min(axis=0)[:, None] - 1.0, points_m[:, :2].max(axis=0)[:, None] + 1.0
    boxes = shapely.box(*np.clip(low_m, first, last), *np.clip(high_m, first, last))
    tree = shapely.STRtree(shapely.points(points_m[:, :2]))
    for start in range(0, len(boxes), RECTANGLES_AT_ONCE):
        rectangle, point = tree.query(boxes[start : start + RECTANGLES_AT_ONCE])
        yield start + rectangle, point
