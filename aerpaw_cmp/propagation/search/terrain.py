"""Reflections off the ground of an elevation model.

At a specular point the length of the path over the ground is stationary. Along the profile between the ends, the ground
is a polyline. Specular points on its pieces have a closed form, and the length can also be stationary at a crease
between two pieces. Across the profile, the point is found by iteration on the bilinear surface. Points whose path
lengths differ by less than half a wavelength lie in one Fresnel zone. They count as one mirror, at the point of the
shortest path. The plane of the mirror is tangent to the surface. On a crease, the plane lies between both sides and
mirrors one end into the other. Where curved ground leaves the Fresnel zone of that plane, the reflection is reduced to
the part of the zone that remains along the profile. The reflection is never focused, and the crest of a ridge does not
reflect. Level ground at the height of the tower's ground is the same plane as without an elevation model.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...common.units import BoolArray, FloatArray, IntArray
from ...site.relief import Dem
from ..geometry import Faces, Links, PathSet, joined, legs
from .mirror import MINIMUM_LENGTH_M, RELATIVE_TOLERANCE, Occlusion, retraced, searched_links

# Value of ``solid`` for tangent planes of the terrain. The level ground of a tower has the value -1.
TERRAIN = -2

# A mirror is ignored if the ground fills a smaller part of its Fresnel zone than this.
# With this part, the reflection is 20 dB weaker than that of a complete mirror.
_SMALLEST_PART = 0.1

# Number of iterations. A point that still moves afterwards is treated like a crease.
_STEPS = 8
_STILL_M = 1e-6


def on_terrain(
    dem: Dem, faces: Faces, links: Links, paths: PathSet, wavelength_m: float
) -> tuple[PathSet, PathSet, Faces, int]:
    """Return the paths of an engine after replacing level ground by the ground of an elevation model.

    Parameters
    ----------
    dem : Dem
    faces : Faces
    links : Links
    paths : PathSet
        Paths over level ground, at most ``paths.faces.shape[1]`` reflections. A path over the ground and a wall is only
        searched for if it also exists on level ground.
    wavelength_m : float

    Returns
    -------
    level : PathSet
        Paths of the engine without a ground reflection, or over ground that is level or unknown.
    shaped : PathSet
        Paths over tangent planes. Buildings and terrain are not yet considered.
    faces : Faces
        Faces of the scene, followed by the tangent planes.
    unknown : int
        Number of links over ground outside the elevation model.
    """
    ground = np.append(faces.solid < 0, False)
    once = ground[paths.faces].any(axis=1)  # at most one ground reflection, because no face of a prism faces down
    pose, tower = np.nonzero(searched_links(links).T)
    unknown = np.zeros((len(links.targets_m), len(links.sources_m)), dtype=np.bool_)
    for some, _, height in dem.profiles(links.sources_m[tower], links.targets_m[pose]):
        unknown[pose[some], tower[some]] = np.isnan(height).any(axis=0)
    off_model = unknown[paths.pose, paths.tower]
    stays = ~once | off_model
    # one candidate for each link, and one for each path of the engine with the ground and something else
    several = np.flatnonzero(once & (paths.depth > 1) & ~off_model)
    bare = np.flatnonzero(~unknown[pose, tower])
    sequence = np.full((len(bare) + len(several), paths.faces.shape[1]), -1, dtype=np.int64)
    plane = np.full(len(links.sources_m), -1, dtype=np.int64)
    usable = np.ones((len(plane), len(faces)), np.bool_) if links.usable is None else links.usable
    at, face = np.nonzero(usable & ground[:-1])
    plane[at] = face
    sequence[: len(bare), 0], sequence[len(bare) :] = plane[tower[bare]], paths.faces[several]
    row_of = np.full(unknown.shape, -1, dtype=np.int64)
    alone = np.flatnonzero(once & (paths.depth == 1))
    row_of[paths.pose[alone], paths.tower[alone]] = alone
    candidates = _Candidates(
        pose=np.append(pose[bare], paths.pose[several]),
        tower=np.append(tower[bare], paths.tower[several]),
        sequence=sequence,
        row=np.append(row_of[pose[bare], tower[bare]], several),
        plane=plane,
    )
    same, shaped, more = candidates.followed(dem, faces, links, wavelength_m)
    stays[same[_clear(dem, faces, links, paths.select(same), wavelength_m)]] = True
    return paths.select(stays), shaped, more, int(unknown.sum())


@dataclass(frozen=True, slots=True)
class _Candidates:
    """Sequences (n, depth) of faces that contain the tower's ground once, and the row of the engine's path or -1."""

    pose: IntArray
    tower: IntArray
    sequence: IntArray
    row: IntArray
    plane: IntArray

    def followed(self, dem: Dem, faces: Faces, links: Links, wavelength_m: float) -> tuple[IntArray, PathSet, Faces]:
        """Return the rows of the engine's paths that remain valid, the paths over tangent planes, and all faces."""
        source, target = links.sources_m[self.tower], links.targets_m[self.pose]
        slot = (self.sequence == self.plane[self.tower][:, None]).argmax(axis=1)
        where, place, normal, part = specular_points(
            dem, *_ends_seen_from(faces, self.sequence, slot, source.copy(), target.copy()), wavelength_m
        )
        offset = (normal * place).sum(axis=1)
        mine = self.plane[self.tower[where]]
        level = (normal[:, 2] == 1.0) & (offset == faces.offset_m[mine]) & (part == 1.0)
        rows = self.row[where[level]]
        where, normal, offset, mine = where[~level], normal[~level], offset[~level], mine[~level]
        plain = Faces(
            normal=normal,
            offset_m=offset,
            material=tuple(faces.material[f] for f in mine.tolist()),
            label=("terrain",) * len(where),
        )
        # the record is frozen, but its array is not shared, so the array can be changed in place
        plain.solid[:] = TERRAIN
        every = joined(faces, plain)
        sequence = self.sequence[where].copy()
        sequence[np.arange(len(where)), slot[where]] = len(faces) + np.arange(len(where))
        paths = self._traced(every, where, sequence, links, -20.0 * np.log10(part[~level]))
        # use the faces without the tangent planes, which do not block
        hiding = Occlusion(faces, RELATIVE_TOLERANCE * 1e4)
        cut = hiding.any_segment(links.sources_m[paths.tower], paths.vertices_m, links.targets_m[paths.pose])
        paths = paths.select(~cut)
        return rows[rows >= 0], paths.select(_clear(dem, every, links, paths, wavelength_m)), every

    def _traced(self, faces: Faces, where: IntArray, sequence: IntArray, links: Links, loss_db: FloatArray) -> PathSet:
        """Return paths over the planes, sorted by pose and tower. Obstacles are not tested."""
        pose, tower = self.pose[where], self.tower[where]
        tolerance = RELATIVE_TOLERANCE * max(float(np.abs(links.sources_m).max(initial=1.0)), 1.0)
        vertices, good = retraced(faces, sequence, links.sources_m[tower], links.targets_m[pose], tolerance)
        depth = (sequence >= 0).sum(axis=1)
        paths = PathSet(pose, tower, depth, sequence, vertices, terrain_db=loss_db).select(good)
        return paths.select(np.lexsort((paths.tower, paths.pose)))


def _ends_seen_from(
    faces: Faces, sequence: IntArray, slot: IntArray, source: FloatArray, target: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return both ends mirrored at the faces between them and the ground at ``slot``."""
    # mirror the tower at the faces before the ground, and the UAV at the faces after it
    steps = range(sequence.shape[1])
    for end, order, side in ((source, steps, -1), (target, reversed(steps), 1)):
        for step in order:
            rows = np.flatnonzero(((step - slot) * side > 0) & (sequence[:, step] >= 0))
            normal, offset = faces.normal[sequence[rows, step]], faces.offset_m[sequence[rows, step]]
            end[rows] -= 2.0 * ((end[rows] * normal).sum(axis=1) - offset)[:, None] * normal
    return source, target


def _clear(dem: Dem, faces: Faces, links: Links, paths: PathSet, wavelength_m: float) -> BoolArray:
    """Check which paths with one ground reflection have no leg that the terrain blocks.

    Ground that rises only slightly into a leg counts as roughness and does not block the leg. The rise must be less
    than the height of Rayleigh's criterion at the reflection, and less than the radius of the Fresnel zone.
    """
    source, target = links.sources_m[paths.tower], links.targets_m[paths.pose]
    points, row = paths.vertices_m, np.arange(len(paths))
    slot = (np.append(faces.solid, 0)[paths.faces] < 0).argmax(axis=1)
    bounce, before = points[row, slot], np.where((slot > 0)[:, None], points[row, slot - 1], source)
    ray = bounce - before
    length = np.linalg.norm(ray, axis=1)
    sine = np.abs((ray * faces.normal[paths.faces[row, slot]]).sum(axis=1)) / np.maximum(length, MINIMUM_LENGTH_M)
    way = np.linalg.norm(bounce - target, axis=1) + length
    tolerance = np.minimum(wavelength_m / (8.0 * np.maximum(sine, 1e-9)), np.sqrt(wavelength_m * way) / 2.0)
    free = np.ones(len(paths), dtype=np.bool_)
    for start, end in legs(source, points, target):
        rows = np.flatnonzero(free & (start != end).any(axis=1))
        free[rows] = dem.clear(start[rows], end[rows], tolerance_m=tolerance[rows])
    return free


def specular_points(
    dem: Dem, source_m: FloatArray, target_m: FloatArray, wavelength_m: float
) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
    """Find the specular points of the ground between pairs of ends.

    Parameters
    ----------
    dem : Dem
    source_m, target_m : (pairs, 3)
        Both ends of each link [m].
    wavelength_m : float

    Returns
    -------
    pair : (points,) int
    place_m : (points, 3)
    normal : (points, 3)
        Normal of the tangent plane, upward.
    part : (points,)
        Share of the Fresnel zone of the plane that the ground fills along the profile, at most 1.
    """
    none = np.zeros(0)
    pieces: list[tuple[IntArray, FloatArray, BoolArray, FloatArray]] = [(none.astype(int), none, none > 0.0, none)]
    for some, share, ground in dem.profiles(source_m, target_m):
        row, along, crease, part = _stationary(source_m[some], target_m[some], share, ground, wavelength_m)
        pieces.append((some[row], along, crease, part))
    pair, along, crease, part = (np.concatenate(x) for x in zip(*pieces, strict=True))
    place, normal, good = _settled(dem, source_m[pair], target_m[pair], along, crease)
    return pair[good], place[good], normal[good], part[good]


def _stationary(
    source: FloatArray, target: FloatArray, share: FloatArray, ground: FloatArray, wavelength_m: float
) -> tuple[IntArray, FloatArray, BoolArray, FloatArray]:
    """Return pair, position along the profile [m], crease flag, and part of the Fresnel zone, for each mirror."""
    length = np.hypot(*(target - source)[:, :2].T)
    along = share * length
    up = source[:, 2], target[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = np.diff(ground, axis=0) / np.diff(along, axis=0)  # NaN where a shorter profile repeats its last point

        def growth(d: FloatArray, z: FloatArray) -> FloatArray:
            """Return the derivative of the path length over the ground along the profile."""
            from_source, from_target = np.hypot(d, z - up[0]), np.hypot(d - length, z - up[1])
            before = (d + slope * (z - up[0])) / np.maximum(from_source, 1e-12)
            after = (d - length + slope * (z - up[1])) / np.maximum(from_target, 1e-12)
            return np.asarray(before + after)

        # evaluate the derivative at both ends of each piece of the profile. The sign of the derivative changes at most
        # once in a piece.
        ends = [growth(along[:-1], ground[:-1]), growth(along[1:], ground[1:])]
    turns = np.stack(ends, axis=1).reshape(-1, len(source))
    # a change of sign within a piece means a mirror on the piece; between two pieces, it means a mirror on the crease
    falls, known = turns < 0.0, np.isfinite(turns)
    column, entry = np.nonzero(((falls[1:] != falls[:-1]) & known[1:] & known[:-1]).T)
    piece, crease = entry // 2, entry % 2 == 1
    m, d0, z0 = slope[piece, column], along[piece, column], ground[piece, column]
    d, total = along[piece + 1, column], length[column]
    over = [up[0][column] - z0 + m * d0, up[1][column] - z0 - m * (total - d0)]
    foot = [over[0] * m / (1.0 + m * m), total + over[1] * m / (1.0 + m * m)]
    height_sum = over[0] + over[1]
    inner = foot[0] + (foot[1] - foot[0]) * over[0] / np.where(height_sum > 0.0, height_sum, 1.0)
    d = np.where(crease, d, inner)
    z = np.where(crease, ground[piece + 1, column], z0 + m * (d - d0))
    way = np.hypot(d, z - up[0][column]) + np.hypot(d - total, z - up[1][column])
    # both ends must be above the tangent plane
    good = crease | ((over[0] > 0.0) & (over[1] > 0.0))
    column, d, z, crease, way = column[good], d[good], z[good], crease[good], way[good]
    zone = np.cumsum((np.diff(column, prepend=-1) != 0) | (np.abs(np.diff(way, prepend=0.0)) >= wavelength_m / 2.0))
    # within a Fresnel zone, keep the shortest path, which comes first in this order (Fermat)
    order = np.lexsort((way, zone))
    first = order[np.flatnonzero(np.diff(zone[order], prepend=-1))]
    column, d, z, crease, way = column[first], d[first], z[first], crease[first], way[first]
    at, heights = along[:, column], (source[column, 2], target[column, 2])
    total = length[column]
    # slope at which the path is stationary: the slope of the piece, or a slope between those of both sides of a crease
    to_source, to_target = np.hypot(d, z - heights[0]), np.hypot(d - total, z - heights[1])
    steep = (z - heights[0]) / np.maximum(to_source, 1e-12) + (z - heights[1]) / np.maximum(to_target, 1e-12)
    lean = -(d / np.maximum(to_source, 1e-12) + (d - total) / np.maximum(to_target, 1e-12)) / np.where(
        steep < 0.0, steep, -1e-12
    )
    widths = [
        _zone_m(
            at, d, np.abs(np.hypot(at, up - heights[0]) + np.hypot(at - total, up - heights[1]) - way), wavelength_m
        )
        for up in (ground[:, column], z + lean * (at - d))
    ]
    part = np.minimum(widths[0] / np.maximum(widths[1], 1e-12), 1.0)
    # the value for level ground must be exactly 1, so that its original plane is kept
    part = np.where(part > 1.0 - 1e-9, 1.0, part)
    good = part >= _SMALLEST_PART
    return column[good], d[good], crease[good], part[good]


def _zone_m(along: FloatArray, at: FloatArray, excess_m: FloatArray, wavelength_m: float) -> FloatArray:
    """Return the length around ``at`` in which profiles (samples, points) lengthen a path by less than half a wave."""
    number, point = np.arange(len(along))[:, None], np.arange(len(at))
    half, width = wavelength_m / 2.0, np.zeros(len(at))
    beyond = ~(excess_m < half)
    for side in (-1, 1):
        outside = beyond & ((along - at) * side > 0.0)
        edge = np.where(outside, number, -1).max(axis=0)
        if side > 0:
            edge = np.where(outside, number, len(along)).min(axis=0)
        open_ = (edge < 0) | (edge >= len(along))
        edge = np.clip(edge, 0, len(along) - 1)
        inner = np.clip(edge - side, 0, len(along) - 1)
        near = (along[inner, point] - at) * side > 0.0
        begin, low = np.where(near, along[inner, point], at), np.where(near, excess_m[inner, point], 0.0)
        with np.errstate(invalid="ignore", divide="ignore"):
            share = np.clip((half - low) / (excess_m[edge, point] - low), 0.0, 1.0)
        reach = np.abs(begin - at) + np.nan_to_num(share) * np.abs(along[edge, point] - begin)
        width += np.where(open_, np.abs(along[0 if side < 0 else -1, point] - at), reach)
    return width


def _settled(
    dem: Dem, source: FloatArray, target: FloatArray, along: FloatArray, crease: BoolArray
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Move reflection points from the profile to the ground. Return points and normals, and which points are valid.

    A point is valid if both ends of the link are above its tangent plane.
    """
    way = target[:, :2] - source[:, :2]
    way = way / np.maximum(np.hypot(*way.T), 1e-12)[:, None]
    begin = source[:, :2] + along[:, None] * way
    spot, moved = begin, np.zeros_like(begin)
    for _ in range(_STEPS):
        slope = np.stack(dem.slope(*spot.T), axis=1)
        up = dem.ground_m(*spot.T)
        over = [end[:, 2] - up - (slope * (end[:, :2] - spot)).sum(axis=1) for end in (source, target)]
        turn = slope / (1.0 + (slope**2).sum(axis=1))[:, None]
        feet = [end[:, :2] + h[:, None] * turn for end, h in zip((source, target), over, strict=True)]
        height_sum = np.where(over[0] + over[1] > 0.0, over[0] + over[1], np.inf)
        moved = feet[0] + (feet[1] - feet[0]) * (over[0] / height_sum)[:, None] - spot
        moved = np.where(crease[:, None], moved - (moved * way).sum(axis=1)[:, None] * way, moved)
        # limit a step to one cell, because the surface of another cell is different
        spot = begin + np.clip(spot + moved - begin, -dem.cell_m, dem.cell_m)
    place = np.column_stack([spot, dem.ground_m(*spot.T)])
    slope = np.stack(dem.slope(*spot.T), axis=1)
    tangent = np.column_stack([-slope, np.ones(len(spot))])
    rays = [end - place for end in (source, target)]
    between = sum(r / np.maximum(np.linalg.norm(r, axis=1, keepdims=True), 1e-12) for r in rays)
    smooth = ~crease & (np.abs(moved).max(axis=1, initial=0.0) < _STILL_M)
    # a crease has no tangent plane: use the plane that reflects one end to the other
    normal = np.where(smooth[:, None], tangent, between)
    normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    above = [(r * normal).sum(axis=1) > 0.0 for r in rays]
    good = np.isfinite(place).all(axis=1) & np.isfinite(normal).all(axis=1) & above[0] & above[1]
    return place, normal, good & (normal[:, 2] > 0.0)
