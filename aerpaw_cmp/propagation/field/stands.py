"""Loss at forests that are a medium: through the canopy, over it and around it.

A stand is a forest with a height: crowns from ``crown_base_m`` up to ``height_m`` over its area, trunks below. What a
segment of a path loses there is that of three components whose powers add up (ITU-R P.833-10 section 3.2): through, by
the length in the canopy; over the top, two knife edges where the ray enters and leaves; around either side. Near the
top part of the Fresnel zone is in the canopy: what goes through is that of a ray lowered until the zone is below the
top, and detours pass what it lacks, so that the level has no step where a ray leaves the canopy.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import shapely

from ...common.units import BoolArray, FloatArray, IntArray
from ...site.site import Forest, Site
from ..geometry.paths import legs
from .foliage import FoliageModel, NoFoliage, Opaque, slab

# Loss per metre between trunks over that in crowns: assumed.
TRUNKS = 0.3
# First Fresnel radii by which a ray clears a knife edge without loss.
# At 0.55 of the first Fresnel radius nu is -0.78, where the knife edge's loss begins.
_CLEAR = 0.55

# Seen from above an upright segment is a point, which crosses no area; shifted by so much it does.
_UPRIGHT_M = 1e-6
# Of a segment and a side of a stand; about 100 MB of temporary arrays.
_PAIRS_AT_ONCE = 1_000_000


def stand_loss_db(
    site: Site,
    source_m: FloatArray,
    vertices_m: FloatArray,
    target_m: FloatArray,
    model: FoliageModel,
    wavelength_m: float,
    in_leaf: FoliageModel | None = None,
) -> FloatArray:
    """Loss of paths at the stands of a site.

    Source: ITU-R P.833-10 section 3.2.

    Parameters
    ----------
    site : Site
    source_m, target_m : (paths, 3)
        Ends [m].
    vertices_m : (paths, depth, 3)
        Points of reflection [m]; NaN where unused.
    model : FoliageModel
        Depth in crowns to loss. Nothing gets through, over or around where it is opaque.
    wavelength_m : float
    in_leaf : FoliageModel, optional
        Of the evergreen share of a stand; by default ``model``.

    Returns
    -------
    (paths,)
        [dB]
    """
    loss = np.zeros(len(source_m))
    if isinstance(model, NoFoliage):
        return loss
    for start, end in legs(source_m, vertices_m, target_m):
        for crossing in _crossings(site, start, end):
            loss[crossing.segment] += _loss_db(crossing, model, in_leaf or model, wavelength_m)
    return loss


def over_stands(site: Site, source_m: FloatArray, vertices_m: FloatArray, target_m: FloatArray) -> BoolArray:
    """Find the paths that run over the area of a stand, at any height.

    Parameters
    ----------
    site, source_m, vertices_m, target_m
        As for :func:`stand_loss_db`.

    Returns
    -------
    (paths,) bool
    """
    mask = np.zeros(len(source_m), dtype=np.bool_)
    for start, end in legs(source_m, vertices_m, target_m):
        for crossing in _crossings(site, start, end):
            mask[crossing.segment] = True
    return mask


def stand_depth_m(site: Site, source_m: FloatArray, target_m: FloatArray) -> FloatArray:
    """Length (lines,) [m] in the stands of a site of straight lines between points (lines, 3)."""
    depth = np.zeros(len(source_m))
    for crossing in _crossings(site, source_m, target_m):
        depth[crossing.segment] += crossing.depth_m(np.zeros(len(crossing.segment)))
    return depth


@dataclass(frozen=True, slots=True)
class _Crossing:
    """Segments over the area of one stand.

    Parameters
    ----------
    stand : Forest
    segment : (k,) int
        Of the segments that were asked about.
    start, end : (k, 3)
        Their ends [m].
    piece : (n,) int
        Which of the ``k`` each piece within the area belongs to.
    share : (n, 2)
        Where it begins and ends, as shares of the way.
    ground_m : (n,)
        Up of the ground below it.
    """

    stand: Forest
    segment: IntArray
    start: FloatArray
    end: FloatArray
    piece: IntArray
    share: FloatArray
    ground_m: FloatArray

    @property
    def height_m(self) -> float:
        """Height of the canopy above the ground."""
        assert self.stand.height_m is not None
        return self.stand.height_m

    def depth_m(self, lowered_m: FloatArray) -> FloatArray:
        """Length (k,) in the canopy, what runs between trunks in part, of segments lowered by (k,) [m]."""
        way = self.end - self.start
        up, rise = (self.start[:, 2] - lowered_m)[self.piece] - self.ground_m, way[self.piece, 2]
        base = self.height_m * self.stand.crown_base_fraction
        depth = _between(self.share, up, rise, base, self.height_m) + TRUNKS * _between(self.share, up, rise, 0.0, base)
        in_all = np.bincount(self.piece, depth, len(self.segment)).astype(np.float64)
        return np.asarray(self.stand.filled * in_all * np.linalg.norm(way, axis=1))


def _crossings(site: Site, start_m: FloatArray, end_m: FloatArray) -> Iterator[_Crossing]:
    """Segments between points (segments, 3) [m] over each stand of a site; those without a length cross none."""
    stands = [forest for forest in site.forests if forest.height_m is not None]
    if not stands:
        return
    # bounding boxes alone: what crosses is decided below, exactly
    tree = shapely.STRtree([stand.area for stand in stands])
    moved = np.flatnonzero(
        np.isfinite(start_m).all(axis=1) & np.isfinite(end_m).all(axis=1) & (start_m != end_m).any(axis=1)
    )
    flat = end_m[moved, :2].copy()
    flat[np.hypot(*(flat - start_m[moved, :2]).T) < _UPRIGHT_M, 0] += _UPRIGHT_M  # a line has a length
    near, stand = tree.query(shapely.linestrings(np.stack([start_m[moved, :2], flat], axis=1)))
    for number in np.unique(stand):
        mine, (corner, last) = near[stand == number], _corners(stands[number])
        step = max(1, _PAIRS_AT_ONCE // len(corner))
        for some in (mine[first : first + step] for first in range(0, len(mine), step)):
            row, share = _pieces(start_m[moved[some], :2], flat[some], corner, last)
            crossing, piece = np.unique(row, return_inverse=True)
            if not len(crossing):
                continue
            rows = moved[some[crossing]]
            start, end = start_m[rows], end_m[rows]
            # under the middle of each piece, since a canopy follows the ground
            ground = np.full(len(piece), stands[number].base_m)
            if site.dem is not None:
                middle = start[piece, :2] + share.mean(axis=1, keepdims=True) * (end - start)[piece, :2]
                ground = np.nan_to_num(site.dem.ground_m(*middle.T))
            yield _Crossing(
                stand=stands[number], segment=rows, start=start, end=end, piece=piece, share=share, ground_m=ground
            )


def _corners(stand: Forest) -> tuple[FloatArray, IntArray]:
    """Corners (n, 2) of the rings of a stand, each closed, and the last corners of all rings but the last."""
    rings = [shapely.get_coordinates(ring) for ring in (stand.area.exterior, *stand.area.interiors)]
    return np.concatenate(rings), np.cumsum([len(ring) for ring in rings[:-1]], dtype=np.int64) - 1


def _pieces(start: FloatArray, end: FloatArray, corner: FloatArray, last: IntArray) -> tuple[IntArray, FloatArray]:
    """Pieces of lines (k, 2) inside rings of corners: their lines (n,), and where they begin and end (n, 2)."""
    way = end - start
    # on which side of each line a corner lies
    left = way[:, :1] * (corner[:, 1] - start[:, 1:]) - way[:, 1:] * (corner[:, 0] - start[:, :1]) > 0
    crosses = left[:, 1:] != left[:, :-1]  # a corner belongs to one of its sides alone
    # from one ring to the next there is no side
    crosses[:, last] = False
    line, edge = np.divmod(np.flatnonzero(crosses), crosses.shape[1])  # nonzero of a table takes five times as long
    (east, north), (side_east, side_north) = (corner[edge] - start[line]).T, (corner[edge + 1] - corner[edge]).T
    way_east, way_north = way[line].T
    share = (east * side_north - north * side_east) / (way_east * side_north - way_north * side_east)
    # an odd number of sides behind the start: it begins inside
    inside = np.bincount(line[share <= 0.0], minlength=len(way)) % 2 == 1
    line, share = line[between := (share > 0.0) & (share < 1.0)], share[between]
    order, count = np.lexsort([share, line]), np.bincount(line, minlength=len(way))
    bounds = np.ones((len(way), count.max(initial=0) + 2))
    bounds[:, 0] = 0.0
    bounds[line[order], 1 + np.arange(len(line)) - np.repeat(np.cumsum(count) - count, count)] = share[order]
    odd = np.arange(bounds.shape[1] - 1) % 2 == 1
    line, at = np.nonzero((inside[:, None] != odd) & (bounds[:, 1:] > bounds[:, :-1]))
    return line, np.stack([bounds[line, at], bounds[line, at + 1]], axis=1)


def _loss_db(crossing: _Crossing, model: FoliageModel, in_leaf: FoliageModel, wavelength_m: float) -> FloatArray:
    """Loss (k,) of segments that cross a stand [dB]."""
    source, target, stand, count = crossing.start, crossing.end, crossing.stand, len(crossing.segment)
    if isinstance(model, Opaque):
        return model.loss_db(crossing.depth_m(np.zeros(count)))
    enter, leave, top = np.full(count, np.inf), np.full(count, -np.inf), np.full(count, -np.inf)
    np.minimum.at(enter, crossing.piece, crossing.share[:, 0])
    np.maximum.at(leave, crossing.piece, crossing.share[:, 1])
    np.maximum.at(top, crossing.piece, crossing.height_m + crossing.ground_m)
    # neither end in the canopy: only then are there ways over and around it
    outside = ((enter > 1e-9) | (source[:, 2] > top)) & ((leave < 1.0 - 1e-9) | (target[:, 2] > top))
    length, share = np.linalg.norm(target - source, axis=1), np.stack([enter, leave])
    intrusion = top - source[:, 2] - share * (target - source)[:, 2]
    zone = _CLEAR * np.sqrt(wavelength_m * length * share * (1.0 - share))
    depth_m = crossing.depth_m(np.where(outside, np.maximum((zone - intrusion).min(axis=0), 0.0), 0.0))
    through = model.loss_db(depth_m)
    if stand.evergreen_share:
        # a mean of decibels, not of powers: the share is one of trees along each way, not of ways
        through = through + stand.evergreen_share * (in_leaf.loss_db(depth_m) - through)
    passed, some = np.zeros(count), np.flatnonzero(outside & (through > 0.0))  # what loses nothing needs no detour
    over = Profile(length[some], share[:, some], intrusion[:, some])
    for way in (over, *_around(stand, source[some], target[some])):
        # as powers: nobody knows the edge of a canopy to a wavelength
        passed[some] += 10.0 ** (-deygout_db(way, wavelength_m) / 10.0)
    # as shares that are lacking: so a detour of full power leaves no loss, and none leaves all
    blocked = (1.0 - 10.0 ** (-through / 10.0)) * (1.0 - np.minimum(passed, 1.0))
    return np.asarray(-10.0 * np.log10(1.0 - blocked))


def _between(share: FloatArray, up: FloatArray, rise: FloatArray, low: float, high: float) -> FloatArray:
    """Part of the way (pieces,) that runs between two heights."""
    first, last = slab(up, rise, low, high)
    return np.asarray(np.maximum(np.minimum(share[:, 1], last) - np.maximum(share[:, 0], first), 0.0))


def _around(stand: Forest, start: FloatArray, end: FloatArray) -> Iterator[Profile]:
    """Profiles of the ways around both sides of a stand."""
    length = np.linalg.norm(end - start, axis=1)
    corner = shapely.get_coordinates(stand.area.convex_hull)[:, None]
    way = (end - start)[:, :2]
    flat = np.maximum(np.hypot(*way.T), _UPRIGHT_M)
    off = corner - start[:, :2]
    along = (off * way).sum(axis=2) / flat**2
    across = (way[:, 0] * off[..., 1] - way[:, 1] * off[..., 0]) / flat
    for side in (1.0, -1.0):
        yield Profile(length, along, side * across)


# --- knife edges across a straight line: the detours over and around a wood ----------------------------------------


class Profile(NamedTuple):
    """Edges under straight lines, a column of samples each.

    ``length_m`` (links,) is that of the lines, ``share`` (samples, links) the part of the way to each sample,
    ``intrusion_m`` the height of the edge above the line there, NaN where it is unknown.
    """

    length_m: FloatArray
    share: FloatArray
    intrusion_m: FloatArray


def knife_edge_db(nu: FloatArray) -> FloatArray:
    """Loss of one knife edge [dB] by its parameter nu; 0 below -0.78.

    Source: ITU-R P.526-15 eq. 31.
    """
    # far below -0.78 the root of x squared loses all digits beside x
    x = np.maximum(nu, -0.78) - 0.1
    return np.where(nu > -0.78, np.maximum(6.9 + 20.0 * np.log10(np.sqrt(x * x + 1.0) + x), 0.0), 0.0)


def _parameter(height_m: FloatArray, before_m: FloatArray, after_m: FloatArray, wavelength_m: float) -> FloatArray:
    """Parameter nu of edges; -inf at the ends of a line and where the height is unknown."""
    # an edge at an end has no distance to it, and nu would be infinite
    inner = (before_m > 0.0) & (after_m > 0.0) & np.isfinite(height_m)
    product = np.where(inner, before_m * after_m, 1.0)
    nu = np.where(inner, height_m, 0.0) * np.sqrt(2.0 * np.abs(before_m + after_m) / (wavelength_m * product))
    return np.where(inner, nu, -np.inf)


def deygout_db(profile: Profile, wavelength_m: float) -> FloatArray:
    """Loss (links,) [dB] of up to three edges by Deygout's construction with Causebrook's correction.

    Sources: Deygout, IEEE Trans. Antennas Propag. 14 (1966) 480, doi 10.1109/TAP.1966.1138719; Causebrook and Davis,
    BBC Research Department report 1971/43, eq. 13 to 15.

    Notes
    -----
    ``A + (A_1 - C_1) + (A_2 - C_2)``: the main edge and the main one of each side on the way to it, less
    ``C = (6 - A + A_e) cos(alpha)``, with A_e the loss of the side's edge alone on the direct line and
    ``cos(alpha)^2 = d_1 d_34 / (d_12 d_234)``; neither term is negative.
    """
    length_m, share, intrusion_m = profile
    nu = _parameter(intrusion_m, share * length_m, (1.0 - share) * length_m, wavelength_m)
    main, link = nu.argmax(axis=0), np.arange(len(length_m))
    total = first = knife_edge_db(nu[main, link])
    known = np.isfinite(nu[main, link])
    # without an edge any place does: its loss is zero
    at, top = np.where(known, share[main, link], 0.5), np.where(known, intrusion_m[main, link], 0.0)
    for way, place in ((share, at), (1.0 - share, 1.0 - at)):
        # above the line from the end to the top of the main edge
        height = intrusion_m - top * way / place
        side = _parameter(height, way * length_m, (place - way) * length_m, wavelength_m)
        edge = side.argmax(axis=0)
        s = np.clip(way[edge, link], 0.0, place)
        cosine = np.sqrt(s * (1.0 - place) / (place * (1.0 - s)))
        correction = np.maximum(6.0 - first + knife_edge_db(nu[edge, link]), 0.0) * cosine
        total = total + np.maximum(knife_edge_db(side[edge, link]) - correction, 0.0)
    return np.asarray(total)
