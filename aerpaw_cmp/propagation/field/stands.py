"""Loss at forests that are a medium: through the canopy, over it and around it.

A stand is a forest with a height: crowns from ``crown_base_m`` up to ``height_m`` over its area, trunks below. What a
segment of a path loses there is that of three components whose powers add up (ITU-R P.833-10 section 3.2): through, by
the length in the canopy; over the top, two knife edges where the ray enters and leaves; around either side. Near the
top part of the Fresnel zone is in the canopy: what goes through is that of a ray lowered until the zone is below the
top, and detours pass what it lacks, so that the level has no step where a ray leaves the canopy.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import shapely

from ...common.units import FloatArray, IntArray
from ...site.site import Forest, Site
from ..paths import legs
from .foliage import FoliageModel, NoFoliage, Opaque
from .knife_edges import Profile, deygout_db

# Loss per metre between trunks over that in crowns: assumed.
TRUNKS = 0.3
# First Fresnel radii by which a ray clears a knife edge without loss.
_CLEAR = 0.55

_UPRIGHT_M = 1e-6
_SEGMENTS_AT_ONCE = 20_000


def stand_loss_db(
    site: Site,
    source_m: FloatArray,
    vertices_m: FloatArray,
    target_m: FloatArray,
    model: FoliageModel,
    wavelength_m: float,
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

    Returns
    -------
    (paths,)
        [dB]
    """
    stands = [forest for forest in site.forests if forest.height_m is not None]
    loss = np.zeros(len(source_m))
    if not stands or isinstance(model, NoFoliage):
        return loss
    tree = shapely.STRtree([stand.area for stand in stands])
    for start, end in legs(source_m, vertices_m, target_m):
        moved = np.flatnonzero(
            np.isfinite(start).all(axis=1) & np.isfinite(end).all(axis=1) & (start != end).any(axis=1)
        )
        for first in range(0, len(moved), _SEGMENTS_AT_ONCE):
            rows = moved[first : first + _SEGMENTS_AT_ONCE]
            for some, db in _of_segments(site, stands, tree, start[rows], end[rows], model, wavelength_m):
                loss[rows[some]] += db
    return loss


def _of_segments(
    site: Site, stands: list[Forest], tree: shapely.STRtree, start: FloatArray, end: FloatArray, model: FoliageModel,
    wavelength_m: float,
) -> Iterator[tuple[IntArray, FloatArray]]:  # fmt: skip
    """Segments that a stand shades, and their loss [dB], one stand after another."""
    flat = end[:, :2].copy()
    flat[np.hypot(*(flat - start[:, :2]).T) < _UPRIGHT_M, 0] += _UPRIGHT_M  # a line has a length
    lines = shapely.linestrings(np.stack([start[:, :2], flat], axis=1))
    segment, stand = tree.query(lines, predicate="intersects")
    for number in np.unique(stand):
        mine = segment[stand == number]
        forest = stands[number]
        parts, owner = shapely.get_parts(shapely.intersection(lines[mine], forest.area), return_index=True)
        line = shapely.get_type_id(parts) == 1
        row, parts = mine[owner[line]], parts[line]
        ends = [shapely.get_coordinates(shapely.get_point(parts, at)) for at in (0, -1)]
        way = flat[row] - start[row, :2]
        share = np.sort(
            np.stack([((e - start[row, :2]) * way).sum(axis=1) / (way**2).sum(axis=1) for e in ends], axis=1), axis=1
        )
        yield _loss(site, forest, start, end, row, share, model, wavelength_m)


def _loss(
    site: Site, stand: Forest, start: FloatArray, end: FloatArray, row: IntArray, share: FloatArray,
    model: FoliageModel, wavelength_m: float,
) -> tuple[IntArray, FloatArray]:  # fmt: skip
    """Segments that cross a stand in shares (pieces, 2) of their way, and what they lose there."""
    assert stand.height_m is not None
    ground = np.zeros(len(row))
    if site.dem is not None:
        middle = start[row, :2] + share.mean(axis=1, keepdims=True) * (end - start)[row, :2]
        ground = np.nan_to_num(site.dem.ground_m(*middle.T))
    some, place = np.unique(row, return_inverse=True)
    enter, leave, top = np.full(len(some), np.inf), np.full(len(some), -np.inf), np.full(len(some), -np.inf)
    np.minimum.at(enter, place, share[:, 0])
    np.maximum.at(leave, place, share[:, 1])
    np.maximum.at(top, place, stand.height_m + ground)
    source, target, lower = start[some], end[some], np.zeros(len(some))
    outside = ((enter > 1e-9) | (source[:, 2] > top)) & ((leave < 1.0 - 1e-9) | (target[:, 2] > top))
    ways = [] if isinstance(model, Opaque) else list(_detours(stand, source, target, enter, leave, top))
    if ways:
        top_way = ways[0]
        zone = _CLEAR * np.sqrt(wavelength_m * top_way.length_m * top_way.share * (1.0 - top_way.share))
        lower = np.where(outside, np.maximum((zone - top_way.intrusion_m).min(axis=0), 0.0), 0.0)
    up, rise = start[row, 2] - ground - lower[place], (end - start)[row, 2]
    base, way = stand.height_m * stand.crown_base_fraction, np.linalg.norm((end - start)[row], axis=1)
    depth = _between(share, up, rise, base, stand.height_m) + TRUNKS * _between(share, up, rise, 0.0, base)
    through = model.loss_db(np.bincount(place, depth * way, len(some)).astype(np.float64))
    if not ways:
        return some, through
    power = sum(10.0 ** (-deygout_db(detour, wavelength_m) / 10.0) for detour in ways)
    blocked = (1.0 - 10.0 ** (-through / 10.0)) * (1.0 - np.where(outside, np.minimum(power, 1.0), 0.0))
    return some, -10.0 * np.log10(1.0 - blocked)


def _between(share: FloatArray, up: FloatArray, rise: FloatArray, low: float, high: float) -> FloatArray:
    """Part of the way (pieces,) that runs between two heights."""
    with np.errstate(divide="ignore", invalid="ignore"):
        at = np.sort(np.stack([(low - up) / rise, (high - up) / rise], axis=1), axis=1)
    level = rise == 0.0
    inside = np.where((up > low) & (up < high), np.inf, -np.inf)
    first = np.where(level, -inside, at[:, 0])
    last = np.where(level, inside, at[:, 1])
    return np.asarray(np.maximum(np.minimum(share[:, 1], last) - np.maximum(share[:, 0], first), 0.0))


def _detours(
    stand: Forest, start: FloatArray, end: FloatArray, enter: FloatArray, leave: FloatArray, top: FloatArray
) -> Iterator[Profile]:
    """Profiles of the ways over a stand and around both sides of it."""
    length = np.linalg.norm(end - start, axis=1)
    share = np.stack([enter, leave])
    yield Profile(length, share, top - start[:, 2] - share * (end - start)[:, 2])
    corner = shapely.get_coordinates(stand.area.convex_hull)[:, None]
    way = (end - start)[:, :2]
    flat = np.maximum(np.hypot(*way.T), _UPRIGHT_M)
    off = corner - start[:, :2]
    along = (off * way).sum(axis=2) / flat**2
    across = (way[:, 0] * off[..., 1] - way[:, 1] * off[..., 0]) / flat
    for side in (1.0, -1.0):
        yield Profile(length, along, side * across)
