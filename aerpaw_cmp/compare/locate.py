"""Position estimate of a transmitter of unknown place, from the levels of one flight.

The model: a level falls with the logarithm of the distance, by a free slope; the airframe adds its gain where flights
taught it, both antennas one over the elevation, shadowing is remembered for half a minute, and what lies below the
receiver's floor says only that.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..common.errors import InputError
from ..common.geodesy import elevation_rad
from ..common.text import counted
from ..common.units import BoolArray, FloatArray, unmasked


@dataclass(frozen=True, slots=True, kw_only=True)
class LevelModel:
    """Standard deviations of a level about its distance law, before it was seen.

    Parameters
    ----------
    slope, slope_sd : float
        Exponent of the distance.
    elevation_sd_db : float
        Gain that two antennas and the ground add over the elevation.
    shadow_sd_db : float
        Shadowing, remembered for half a minute.
    scatter_sd_db : float
        Of medians over some seconds.
    """

    slope: float = 3.0
    slope_sd: float = 1.0
    elevation_sd_db: float = 5.0
    shadow_sd_db: float = 8.0
    scatter_sd_db: float = 4.0


# Of a node about which nothing is known: so the regions hold the surveyed rover on the six AFAR and sounder flights
# that docs/formats.md names.
UNKNOWN = LevelModel()

# How long shadowing is remembered.
_SHADOW_S = 30.0

# Standard deviation per axis of what the model cannot see (a tilted antenna, a wall), of the same flights.
SYSTEMATIC_M = 20.0

# Medians are taken over at least so many seconds, and there are at most so many.
WINDOW_S, _MOST_BINS = 4.0, 120

# Heights of the antenna that are tried, and their prior: a rover, a tower.
_HEIGHTS_M = {1.5: 0.7, 10.0: 0.3}

# Bins of a level that a search needs.
FEWEST = 20

# Places up to this far beyond the track are tried, at this spacing; likely ones again at a third of it.
_REACH_M, _SPACING_M = 400.0, 40.0

# Long tracks: the first grid has at most this many positions, at 2, 4, 8 ... times the spacing; then the likeliest
# places are divided until the spacing is reached. A place costs 0.2 ms of processor time.
_MOST_GRID, _MOST_DIVIDED = 3000, 500

# The level of a node so far away hardly changes along a flight; levels that fit it as well as the best place tell none.
# Log odds of the best place: 4 to 76 on six real flights with a rover in reach, at most 0.3 of constants and hovers.
_AFAR_M, _PLACED_ODDS = 30_000.0, 0.5

# Places whose log evidence is lower by more take no part.
_POSSIBLE = 8.0

# With more of them the region is wider than the spacing.
_MOST_REFINED = 300

# Standard deviation of a level about which nothing is known.
_FREE_DB = 100.0

# Of the shadowing; what they leave counts as scatter.
_TERMS = 28

# Newton steps of the Laplace approximation, and the change [dB] at which they end; there is one maximum.
_STEPS, _SETTLED_DB = 12, 0.01

# Places whose matrices are held at a time.
_AT_ONCE = 64


@dataclass(frozen=True, slots=True)
class LevelTrack:
    """Levels along a track, thinned for a search.

    Parameters
    ----------
    time_s : (n,)
    position_m : (n, 3)
        East, north, up.
    level_db : (n,)
        Medians; no lower than the floor.
    floor_db : float
        Level below which the receiver measures nothing; -inf where none shows.
    airframe_db : callable, optional
        Gain (m, n) of the airframe at each of the levels towards unit vectors (m, n, 3) from the UAV, where known.
    rotation : (n, 3, 3), optional
        From the aircraft's frame to that of the site.
    """

    time_s: FloatArray
    position_m: FloatArray
    level_db: FloatArray
    floor_db: float = -np.inf
    airframe_db: Callable[[FloatArray], FloatArray] | None = None
    rotation: FloatArray | None = None

    @property
    def below(self) -> BoolArray:
        """Levels (n,) of which only the floor is known."""
        return np.asarray(self.level_db <= self.floor_db)


def level_track(
    time_s: ArrayLike, position_m: ArrayLike, level_db: ArrayLike, *, floor_db: float = -np.inf
) -> LevelTrack:
    """Medians of levels over windows of :data:`WINDOW_S` or longer.

    A median commutes with the floor: it lies below it where more than half of its samples do.

    Parameters
    ----------
    time_s : (n,)
    position_m : (n, 3)
        NaN where it is not known.
    level_db : (n,)
        NaN does not count.
    floor_db : float

    Returns
    -------
    LevelTrack
        At most :data:`_MOST_BINS` of them.
    """
    time, place, level = (np.asarray(v, dtype=np.float64) for v in (time_s, position_m, level_db))
    finite = np.isfinite(level) & np.isfinite(place).all(axis=1) & np.isfinite(time)
    time, place, level = time[finite], place[finite], np.maximum(level[finite], floor_db)
    if not len(time):
        return LevelTrack(time, place, level, floor_db)
    # a little longer, or the last instant would have a bin of its own
    window = max(WINDOW_S, float(np.ptp(time)) / _MOST_BINS * 1.001)
    groups = np.unique(((time - time.min()) // window).astype(np.int64), return_inverse=True)[1]
    order = np.argsort(groups, kind="stable")
    parts = np.split(order, np.flatnonzero(np.diff(groups[order])) + 1)
    return LevelTrack(
        np.array([time[p].mean() for p in parts]),
        np.array([place[p].mean(axis=0) for p in parts]),
        np.array([np.median(level[p]) for p in parts]),
        floor_db,
    )


@dataclass(frozen=True, slots=True)
class Fits:
    """Log evidence of places (m,), and slope and its standard deviation (m,) if the node is there."""

    evidence: FloatArray
    slope: FloatArray
    slope_sd: FloatArray


def fit_places(track: LevelTrack, places_m: ArrayLike, model: LevelModel = UNKNOWN) -> Fits:
    """Log evidence of the levels if the node stood at each of some places.

    Parameters
    ----------
    track : LevelTrack
    places_m : (m, 3)
        East, north, up.
    model : LevelModel
        Narrower where antennas are known.

    Notes
    -----
    The level is mean + F c + noise, c ~ N(0, 1): level at 100 m, slope, two terms of the elevation, and the leading
    terms of the shadowing's Karhunen-Loeve expansion, whose rest is noise. A level above the floor says what it is,
    one below says P(level < floor). The evidence is Laplace's approximation at the maximum of the posterior
    (Rasmussen and Williams, 2006, section 3.4): exact where no level lies below the floor.
    """
    places = unmasked(places_m).reshape(-1, 3)
    shadow, noise = _shadowing(track, model)
    parts = [_fit(track, places[i : i + _AT_ONCE], shadow, noise, model) for i in range(0, len(places), _AT_ONCE)]
    return Fits(*(np.concatenate(values) for values in zip(*parts, strict=True)))


def _shadowing(track: LevelTrack, model: LevelModel) -> tuple[FloatArray, float]:
    """Leading terms (n, k) of the shadowing's covariance, and the standard deviation of what else scatters."""
    lag = np.abs(track.time_s[:, None] - track.time_s)
    variance, vectors = np.linalg.eigh(model.shadow_sd_db**2 * np.exp(-lag / _SHADOW_S))
    terms = vectors[:, -_TERMS:] * np.sqrt(np.maximum(variance[-_TERMS:], 0.0))
    unresolved = max(float(variance[:-_TERMS].sum()), 0.0) / len(lag)
    return terms, float(np.hypot(model.scatter_sd_db, np.sqrt(unresolved)))


def _features(track: LevelTrack, places: FloatArray, model: LevelModel) -> tuple[FloatArray, FloatArray]:
    """Mean (m, n) of the level before one was seen, and what coefficients of unit variance add (m, n, 4)."""
    ray = track.position_m[None] - places[:, None]
    across = np.hypot(ray[..., 0], ray[..., 1])
    # of 100 m; nearer than a metre no law of the distance holds
    decades = np.log10(np.maximum(np.hypot(across, ray[..., 2]), 1.0) / 100.0)
    elevation = elevation_rad(ray)
    columns = [
        np.full(across.shape, _FREE_DB),
        -10.0 * model.slope_sd * decades,
        model.elevation_sd_db * np.sin(elevation) ** 2,
        0.5 * model.elevation_sd_db * np.cos(4.0 * elevation),
    ]
    mean = 0.5 * float(track.level_db.max() + track.level_db.min()) - 10.0 * model.slope * decades
    if track.airframe_db is not None:
        mean = mean + track.airframe_db(-ray / np.maximum(np.linalg.norm(ray, axis=-1, keepdims=True), 1e-9))
    return mean, np.stack(columns, axis=-1)


def _fit(
    track: LevelTrack, places: FloatArray, shadow: FloatArray, noise: float, model: LevelModel
) -> tuple[FloatArray, ...]:
    mean, features = _features(track, places, model)
    terms = np.concatenate([features, np.broadcast_to(shadow, (len(places), *shadow.shape))], axis=2)
    eye = np.eye(terms.shape[2])
    latent = np.broadcast_to(track.level_db, mean.shape)
    for _ in range(_STEPS):
        _, gradient, weight = _likelihood(track, latent, noise)
        precision = eye + terms.swapaxes(1, 2) @ (weight[:, :, None] * terms)
        pull = terms.swapaxes(1, 2) @ (weight * (latent - mean) + gradient)[:, :, None]
        coefficient = np.linalg.solve(precision, pull)[:, :, 0]
        before, latent = latent, mean + np.einsum("mnq,mq->mn", terms, coefficient)
        if not track.below.any() or np.abs(latent - before).max() < _SETTLED_DB:
            break
    value, _, weight = _likelihood(track, latent, noise)
    if track.below.any():  # else the weight is that of the noise wherever the levels lie
        precision = eye + terms.swapaxes(1, 2) @ (weight[:, :, None] * terms)
    evidence = value - 0.5 * (coefficient**2).sum(axis=1) - 0.5 * np.linalg.slogdet(precision)[1]
    slope_sd = model.slope_sd * np.sqrt(np.linalg.inv(precision)[:, 1, 1])
    return evidence, model.slope + model.slope_sd * coefficient[:, 1], slope_sd


_LOG_ROOT_TAU = 0.5 * float(np.log(2.0 * np.pi))


def _likelihood(track: LevelTrack, latent: FloatArray, noise: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Log likelihood (m,) of the levels, its gradient (m, n), and minus its second derivative (m, n)."""
    from scipy.special import log_ndtr

    z = (track.level_db - latent) / noise  # a level below the floor stands at it
    log_below = log_ndtr(z)
    hazard = np.exp(-0.5 * z * z - _LOG_ROOT_TAU - log_below)
    value = np.where(track.below, log_below, -0.5 * z * z - _LOG_ROOT_TAU - np.log(noise))
    gradient = np.where(track.below, -hazard, z) / noise
    weight = np.where(track.below, np.clip(hazard * (hazard + z), 1e-12, 1.0), 1.0) / noise**2
    return value.sum(axis=1), gradient, weight


# Cells of the regions [m] and their largest number; parts of a region that hold less are none.
_CELL_M, _MOST_CELLS, _LEAST_SHARE = 5.0, 1_000_000, 0.03


@dataclass(frozen=True, slots=True)
class Mode:
    """A connected part of the 90 % region.

    Parameters
    ----------
    place_m : (2,)
        Its likeliest place, east and north.
    share : float
        Of the posterior that it holds.
    radius_m : float
        About the place, that holds nine tenths of it.
    """

    place_m: FloatArray
    share: float
    radius_m: float


@dataclass(frozen=True, slots=True)
class Regions:
    """Posterior of a node's place in cells.

    Parameters
    ----------
    east_m, north_m : (columns,), (rows,)
        Middles of the cells.
    share : (columns, rows)
        Of the posterior in each cell; 1 in all.
    """

    east_m: FloatArray
    north_m: FloatArray
    share: FloatArray

    @classmethod
    def of(cls, places: FloatArray, share: FloatArray, sd_m: float = SYSTEMATIC_M) -> Regions:
        """Blur the shares (m,) of places (m, 2 or more) by a standard deviation per axis [m]."""
        reach = 4.0 * sd_m
        area = float(np.prod(np.ptp(places[:, :2], axis=0) + 2.0 * reach))
        cell = max(_CELL_M * sd_m / SYSTEMATIC_M, float(np.sqrt(area / _MOST_CELLS)))
        axes = [np.arange(p.min() - reach, p.max() + reach + cell, cell) for p in places.T[:2]]
        density = _blurred(places, share, axes, sd_m)
        return cls(axes[0], axes[1], density / density.sum())

    def likelier(self) -> FloatArray:
        """Part of the posterior in all cells that are likelier than each (columns, rows)."""
        order = np.argsort(-self.share, axis=None)
        held = np.empty(self.share.size)
        held[order] = np.cumsum(self.share.ravel()[order]) - self.share.ravel()[order]
        return held.reshape(self.share.shape)

    def modes(self, part: float = 0.9) -> tuple[Mode, ...]:
        """Connected parts of the region that holds a part of the posterior, the likeliest first."""
        from scipy.ndimage import label

        # cells that touch at a corner are of one region
        marks, count = label(self.likelier() < part, structure=np.ones((3, 3)))
        out = []
        for number in range(1, count + 1):
            cells = np.argwhere(marks == number)
            at = np.column_stack([self.east_m[cells[:, 0]], self.north_m[cells[:, 1]]])
            share = self.share[tuple(cells.T)]
            best = at[share.argmax()]
            out.append(Mode(place_m=best, share=float(share.sum()), radius_m=_within(at - best, share, 0.9)))
        return tuple(sorted((mode for mode in out if mode.share >= _LEAST_SHARE), key=lambda mode: -mode.share))

    def radius_m(self, place_m: FloatArray, part: float) -> float:
        """Radius of the circle about a place that holds a part of the posterior."""
        east, north = np.meshgrid(self.east_m - place_m[0], self.north_m - place_m[1], indexing="ij")
        return _within(np.column_stack([east.ravel(), north.ravel()]), self.share.ravel(), part)


def _blurred(places: FloatArray, share: FloatArray, axes: Sequence[FloatArray], sd_m: float) -> FloatArray:
    """Return the blurred shares on a grid (columns, rows); places lie on a lattice, so each axis is blurred alone."""
    (east, i), (north, j) = (np.unique(p.round(6), return_inverse=True) for p in places.T[:2])
    lattice = np.zeros((len(east), len(north)))
    np.add.at(lattice, (i, j), share)
    columns, rows = (
        np.exp(-0.5 * ((axis[:, None] - p) / sd_m) ** 2) for axis, p in zip(axes, (east, north), strict=True)
    )
    return np.asarray(columns @ lattice @ rows.T)


def _within(step_m: FloatArray, share: FloatArray, part: float) -> float:
    """Length of steps (n, 2) within which lies a part of their shares (n,)."""
    away = np.hypot(*step_m.T)
    order = np.argsort(away)
    held = np.cumsum(share[order])
    return float(away[order][np.searchsorted(held, part * held[-1])])


@dataclass(frozen=True, slots=True, kw_only=True)
class NodeEstimate:
    """Place of a node by the levels of a flight.

    Parameters
    ----------
    place_m : (3,)
        East, north and height above ground of the likeliest place.
    radius90_m : float
        Circle about it that holds 90 % of the posterior.
    height_m : (low, high)
        Heights that are not shown to be wrong.
    slope, slope_sd : float
        Exponent of the distance and its standard deviation.
    anywhere : float
        Log evidence of any place within reach.
    placed : bool
        The levels fit a place within reach better than one so far away that they would not change.
    at_edge : bool
        More than a few percent lie at the edge of the search: the node may stand farther away.
    regions : Regions
    """

    place_m: FloatArray
    radius90_m: float
    height_m: tuple[float, float]
    slope: float
    slope_sd: float
    anywhere: float
    placed: bool
    at_edge: bool
    regions: Regions


def locate(track: LevelTrack, model: LevelModel = UNKNOWN) -> NodeEstimate:
    """Place, height and slope that explain the levels of a flight best.

    Parameters
    ----------
    track : LevelTrack
        At least :data:`FEWEST` bins.
    model : LevelModel
        Narrower where antennas are known.

    Raises
    ------
    InputError
        Too few levels.

    Notes
    -----
    Evidence over a grid of places at :data:`_HEIGHTS_M`; the posterior is blurred by :data:`SYSTEMATIC_M`.
    """
    from scipy.special import logsumexp

    if len(track.level_db) < FEWEST:
        raise InputError(
            f"{counted(len(track.level_db), 'bin')} of 4 s with a level and a position above 5 m",
            expected=f"{FEWEST}",
            cause="a short flight, or logs of two flights",
        )
    grid, spacing = _grid(track)
    places, evidence, step, anywhere = _searched(track, grid, spacing, model)
    afar = fit_places(track, track.position_m[:1] + np.array([_AFAR_M, 0.0, 0.0]), model).evidence[0]
    places = places[evidence > evidence.max() - _POSSIBLE]
    if len(places) <= _MOST_REFINED:
        places = _divided(places, (-step / 3.0, 0.0, step / 3.0))
    fits = fit_places(track, places, model)
    log_share = fits.evidence + _log_prior(places)
    share = np.exp(log_share - logsumexp(log_share))
    # places that are far apart are blurred more: the region must not fall into spots
    sd_m = SYSTEMATIC_M * step / _SPACING_M
    (east, i), (north, j) = (np.unique(p.round(6), return_inverse=True) for p in places.T[:2])
    density = _blurred(places, share, (east, north), sd_m)[i, j]
    # rounded: a place and its mirror image differ in the last digit alone
    best = int(np.lexsort((-share, -density.round(12)))[0])
    regions = Regions.of(places, share, sd_m)
    heights = [h for h in _HEIGHTS_M if share[places[:, 2] == h].sum() > 0.05]
    return NodeEstimate(
        place_m=places[best],
        radius90_m=regions.radius_m(places[best], 0.9),
        height_m=(min(heights), max(heights)),
        slope=float(fits.slope[best]),
        slope_sd=float(fits.slope_sd[best]),
        anywhere=anywhere,
        placed=bool(fits.evidence.max() - afar > _PLACED_ODDS),
        at_edge=bool(share[_on_edge(places, grid, spacing)].sum() > _LEAST_SHARE),
        regions=regions,
    )


def _log_prior(places: FloatArray) -> FloatArray:
    """Of the height of places (m, 3)."""
    return np.log([_HEIGHTS_M[height] for height in places[:, 2].tolist()])


def _grid(track: LevelTrack, spacing_m: float = _SPACING_M) -> tuple[FloatArray, float]:
    """Return positions (m, 2) at equal spacing, up to :data:`_REACH_M` beyond the track, and the spacing [m].

    The spacing is doubled until there are at most :data:`_MOST_GRID` positions.
    """
    low, high = track.position_m[:, :2].min(axis=0) - _REACH_M, track.position_m[:, :2].max(axis=0) + _REACH_M
    while np.prod((high - low) / spacing_m + 1.0) > _MOST_GRID:
        spacing_m *= 2.0
    axes = [np.arange(a, b + spacing_m, spacing_m) for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2), spacing_m


def _at_heights(grid: FloatArray) -> FloatArray:
    return np.concatenate([np.column_stack([grid, np.full(len(grid), height)]) for height in _HEIGHTS_M])


def _searched(
    track: LevelTrack, grid: FloatArray, spacing_m: float, model: LevelModel
) -> tuple[FloatArray, FloatArray, float, float]:
    """Divide the likeliest places of a grid until their spacing is :data:`_SPACING_M`.

    Returns places (m, 3), their log evidence (m,), their spacing [m] and the log evidence of any place of the grid. If
    too many places are possible, the spacing stays: the levels do not determine the place better.
    """
    from scipy.special import logsumexp

    places, weight, others = _at_heights(grid), -float(np.log(len(grid))), list[FloatArray]()
    while True:
        evidence = fit_places(track, places, model).evidence + _log_prior(places)
        possible = np.count_nonzero(evidence > evidence.max() - _POSSIBLE)
        if spacing_m <= _SPACING_M or possible > _MOST_DIVIDED:
            break
        order = np.argsort(-evidence, kind="stable")
        others.append(evidence[order[_MOST_DIVIDED:]] + weight)
        places = _divided(places[order[:_MOST_DIVIDED]], (-spacing_m / 4.0, spacing_m / 4.0))
        spacing_m, weight = spacing_m / 2.0, weight - float(np.log(4.0))
    return places, evidence, spacing_m, float(logsumexp(np.concatenate([*others, evidence + weight])))


def _on_edge(places: FloatArray, grid: FloatArray, spacing_m: float) -> BoolArray:
    low, high = grid.min(axis=0) + spacing_m, grid.max(axis=0) - spacing_m
    return np.asarray(((places[:, :2] < low) | (places[:, :2] > high)).any(axis=1))


def _divided(places: FloatArray, steps_m: Sequence[float]) -> FloatArray:
    """Return each place (m, 3) moved by all pairs of steps to the east and to the north."""
    moved = np.array([(e, n, 0.0) for e in steps_m for n in steps_m])
    return np.asarray((places[:, None] + moved).reshape(-1, 3))


# Of a known place against any: nearly free space, with antennas of which nothing is known; chosen on made flights.
_RIVAL = LevelModel(slope=2.1, slope_sd=0.3, elevation_sd_db=4.0, scatter_sd_db=1.5)
# What azimuth adds at the node, and the directions of an airframe at the UAV (spherical harmonics of degrees 1 and 2).
_AZIMUTH_SD_DB, _AIRFRAME_SD_DB = 0.8, 1.5
# Shadowing [dB] and its length [m] that are tried: the levels weigh them.
_SHADOWS = ((2.5, 15.0), (2.5, 45.0), (4.5, 15.0), (4.5, 45.0))
# A radio stands near the track that was flown for it: a Cauchy distribution in the plane, of this width.
_NEAR_M = 150.0
_RIVAL_SPACING_M = 60.0


def place_odds(track: LevelTrack, known_m: ArrayLike) -> FloatArray:
    """Log odds (k,) of known places, such as towers, against any place about the track, where no antenna is known.

    Place, gain, slope and antennas are integrated over: a place wins only by more than its freedom gives.

    Parameters
    ----------
    track : LevelTrack
        Levels below the floor count as at it.
    known_m : (k, 3)
    """
    from scipy.special import logsumexp

    known, (grid, _) = unmasked(known_m).reshape(-1, 3), _grid(track, _RIVAL_SPACING_M)
    free = _at_heights(grid)
    places = np.concatenate([known, free])
    away = np.hypot(*(places[:, None, :2] - track.position_m[:, :2]).transpose(2, 0, 1)).min(axis=1)
    shadows = [_inverse_root(track, *shadow) for shadow in _SHADOWS]
    parts = [_rival_evidence(track, places[i : i + _AT_ONCE], shadows) for i in range(0, len(places), _AT_ONCE)]
    share = np.concatenate(parts) - 1.5 * np.log1p((away / _NEAR_M) ** 2)
    return np.asarray(share[: len(known)] + np.log(len(grid)) - logsumexp(share[len(known) :] + _log_prior(free)))


def _inverse_root(track: LevelTrack, sd_db: float, length_m: float) -> FloatArray:
    """Inverse (n, n) of the lower root of the covariance of shadowing and scatter."""
    apart = np.linalg.norm(track.position_m[:, None] - track.position_m, axis=-1)
    covariance = sd_db**2 * np.exp(-apart / length_m) + _RIVAL.scatter_sd_db**2 * np.eye(len(apart))
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))


def _rival_evidence(track: LevelTrack, places: FloatArray, shadows: Sequence[FloatArray]) -> FloatArray:
    """Log evidence (m,) of the levels at places, over the shadows that are tried."""
    from scipy.special import logsumexp

    mean, features = _features(track, places, _RIVAL)
    ray = track.position_m[None] - places[:, None]
    towards = ray / np.maximum(np.linalg.norm(ray, axis=-1, keepdims=True), 1e-9)
    east, north, _ = np.moveaxis(towards, -1, 0)
    more = _AZIMUTH_SD_DB * np.stack([east, north, 0.7 * (east**2 - north**2), 1.4 * east * north], axis=-1)
    terms = [features, more]
    if track.rotation is not None:
        x, y, z = np.moveaxis(np.einsum("nji,mnj->mni", track.rotation, -towards), -1, 0)
        second = [1.7 * x * y, 1.7 * x * z, 1.7 * y * z, 0.9 * (x**2 - y**2), 0.6 * (3.0 * z**2 - 1.0)]
        terms.append(_AIRFRAME_SD_DB * np.stack([x, y, z, *second], axis=-1))
    columns = np.concatenate(terms, axis=-1)
    evidence = []
    for root in shadows:
        left, white = (track.level_db - mean) @ root.T, root @ columns
        precision = np.eye(white.shape[2]) + white.swapaxes(1, 2) @ white
        pull = (white.swapaxes(1, 2) @ left[:, :, None])[:, :, 0]
        gain = (pull * np.linalg.solve(precision, pull[:, :, None])[:, :, 0]).sum(axis=1)
        size = np.log(np.diag(root)).sum() - 0.5 * np.linalg.slogdet(precision)[1]
        evidence.append(0.5 * (gain - (left**2).sum(axis=1)) + size)
    return np.asarray(logsumexp(evidence, axis=0))
