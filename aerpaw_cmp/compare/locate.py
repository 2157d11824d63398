"""Position estimate of a radio on the ground from the levels of one flight.

In the model, the level falls with the logarithm of the distance, by an unknown slope. Both antennas add gains that
depend on elevation, azimuth and the directions of the airframe. Shadowing is correlated over position or time. A level
below the floor of the receiver has no value: it is only known to be below the floor. Several strengths and correlation
lengths of the shadowing are tried, and weighted by their evidence.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import ArrayLike

from ..common.errors import InputError
from ..common.geodesy import elevation_rad
from ..common.text import counted
from ..common.units import BoolArray, FloatArray, spread_out, unmasked


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """One set of assumptions about the variation of levels around their mean over distance.

    Parameters
    ----------
    shadow_db, length_m, time_s : float
        Standard deviation of the shadowing [dB], and the distance and time over which its correlation falls by a factor
        e.
    scatter_db : float
        Standard deviation of medians over a few seconds, without shadowing [dB].
    azimuth_db, airframe_db : float
        Standard deviation of the node's gain over azimuth, and of the airframe's gain over its directions [dB].
    learned : bool
        True if the learned gain of the airframe is used. ``airframe_db`` is then a factor of the learned standard
        deviation.
    log_weight : float
        Logarithm of the prior weight.
    """

    shadow_db: float
    scatter_db: float
    length_m: float = np.inf
    time_s: float = np.inf
    azimuth_db: float = 0.0
    airframe_db: float = 0.0
    learned: bool = False
    log_weight: float = 0.0

    @property
    def shadow(self) -> tuple[float, ...]:
        """The parameters of shadowing and scatter."""
        return self.shadow_db, self.scatter_db, self.length_m, self.time_s

    def with_gains(self, azimuth_db: float, airframe_db: float, weight: float = 1.0) -> Case:
        """Return the case with unknown gains over direction, with standard deviations [dB], and with a prior weight."""
        return replace(self, azimuth_db=azimuth_db, airframe_db=airframe_db, log_weight=float(np.log(weight)))

    def with_airframe(self) -> Case:
        """Return the case with the learned gain of the airframe, uncertain by its standard deviation."""
        return replace(self, airframe_db=_LEARNED_SD, learned=True, log_weight=self.log_weight + _KNOWN_ODDS)


@dataclass(frozen=True, slots=True, kw_only=True)
class LevelModel:
    """The prior of a level around its mean over distance.

    Parameters
    ----------
    slope, slope_sd : float
        Path-loss exponent: prior mean and standard deviation.
    elevation_sd_db : float
        Standard deviation of the gain over elevation, from both antennas and the ground.
    cases : tuple of Case
        Cases over which the evidence is averaged, by their weights.
    """

    slope: float = 3.0
    slope_sd: float = 1.0
    elevation_sd_db: float = 5.0
    cases: tuple[Case, ...] = ()


# Standard deviation of a learned gain for each degree of its harmonics, as a factor of the standard deviation in its
# table.
_LEARNED_SD = 0.25

# Prior log odds of a learned gain against an unknown gain.
_KNOWN_ODDS = 3.0

# Standard deviations of the gain over azimuth at the node and over direction at the airframe [dB]. If the attitude is
# unknown, the airframe's axes are taken as those of the site, and larger standard deviations are also tried, with the
# prior weights below. If the attitude is known, larger standard deviations are not tried, because they raised the error
# of one of six real flights from 41 to 67 m.
_GAINS = (0.8, 1.5)
_STRONG_GAINS = {_GAINS: 0.55, (3.0, 3.0): 0.28, (6.0, 6.0): 0.17}

# Shadowing is correlated either over half a minute, which matters in a hover, or over position. Strong shadowing over a
# short length with little scatter is not tried, because it is hard to distinguish from strong scatter.
_LENGTHS_M = (15.0, 45.0, 100.0)
_SHADOWS = (
    Case(shadow_db=8.0, scatter_db=4.0, time_s=30.0),
    *(
        Case(shadow_db=sd, scatter_db=2.0, length_m=length)
        for sd, lengths in ((2.5, _LENGTHS_M), (4.5, _LENGTHS_M[1:]), (8.0, _LENGTHS_M[2:]), (12.0, _LENGTHS_M[2:]))
        for length in lengths
    ),
    *(Case(shadow_db=sd, scatter_db=4.0, length_m=length) for sd, length in product((4.5, 8.0, 12.0), _LENGTHS_M)),
)

# The model of a node about which nothing is known.
UNKNOWN = LevelModel(cases=tuple(case.with_gains(*_GAINS) for case in _SHADOWS))


def known_cases(shadow_db: float, scatter_db: float) -> tuple[Case, ...]:
    """Return the cases for a link between two learned antennas, with the shadowing of their training flights."""
    own = [Case(shadow_db=shadow_db, scatter_db=scatter_db, length_m=length) for length in _LENGTHS_M]
    own.append(Case(shadow_db=shadow_db, scatter_db=scatter_db, time_s=30.0))
    return tuple(replace(case, airframe_db=_LEARNED_SD, learned=True) for case in (*own, *_SHADOWS))


# The cases of an unknown node if the attitude of the UAV is not known.
_UNTURNED = tuple(case.with_gains(*gains, weight) for case, (gains, weight) in product(_SHADOWS, _STRONG_GAINS.items()))

# Standard deviation per axis of effects that are not modelled (a tilted antenna, a wall). It was chosen on six flights
# with a surveyed rover (docs/formats.md).
SYSTEMATIC_M = 20.0

# The posterior is blurred by this standard deviation [m] before its maximum is taken as the estimate, because the
# maximum of a rough posterior is at a random position.
_SMOOTH_M = 45.0

# Shortest window of a median [s], and largest number of medians.
WINDOW_S, _MOST_BINS = 4.0, 120

# Heights of the antenna that are tried [m], with their prior probability: a rover, and a tower.
_HEIGHTS_M = {1.5: 0.7, 10.0: 0.3}

# Smallest number of bins for a search.
FEWEST = 20

# Distance beyond the track up to which positions are tried, and their spacing. Around likely positions, a third of the
# spacing is used.
_REACH_M, _SPACING_M = 400.0, 40.0

# Largest number of positions of the first grid, and largest number after its positions are divided. The first grid has
# 1, 2, 4, 8 ... times the spacing. The likeliest positions are then divided until the spacing is reached.
_MOST_GRID, _MOST_DIVIDED = 500, 500

# The level of a node this far away hardly changes along a flight. Levels that fit such a distant node as well as the
# best position do not determine a position. Log odds of the best position: 4 to 76 on six real flights with a rover in
# reach, at most 0.3 for constant levels and hovers.
_AFAR_M, _PLACED_ODDS = 30_000.0, 0.5

# Positions are ignored if their log evidence is lower than the maximum by more than this.
_POSSIBLE = 8.0

# Number of the likeliest positions around which the spacing is divided by three to the east and to the north.
_MOST_REFINED = 100

# Prior standard deviation of the level at 100 m, which is unknown.
_FREE_DB = 100.0

# Largest number of Newton steps of the Laplace approximation, and change [dB] at which they end.
_STEPS, _SETTLED_DB = 12, 0.03

# Number of positions whose matrices are in memory at the same time.
_AT_ONCE = 128

# Largest number of cases of a search, and largest difference in log likelihood from the best case [nat]. The third
# number is the number of positions at which the cases are compared.
_MOST_CASES, _LIKELY, _JUDGED = 8, 4.0, 60

# Largest number of levels below the floor that are used, because the time grows with its cube.
_MOST_BELOW = 20
_USUAL = Case(shadow_db=8.0, scatter_db=4.0, length_m=45.0, azimuth_db=_GAINS[0], airframe_db=_GAINS[1])


@dataclass(frozen=True, slots=True)
class LevelTrack:
    """The levels along a track, thinned for a search.

    Parameters
    ----------
    time_s : (n,)
    position_m : (n, 3)
        East, north, up.
    level_db : (n,)
        Medians of levels, raised to at least the floor.
    floor_db : float
        Level below which the receiver measures nothing, or -inf.
    airframe_db : callable, optional
        Function that returns the learned gain (m, n) and its standard deviation (m, n) for two unit vectors (m, n, 3).
        The first is the direction at the UAV in the aircraft frame, the second the direction at the node in the site
        frame. None if no antenna is known.
    rotation : (n, 3, 3), optional
        Rotation from the aircraft frame to the site frame.
    """

    time_s: FloatArray
    position_m: FloatArray
    level_db: FloatArray
    floor_db: float = -np.inf
    airframe_db: Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]] | None = None
    rotation: FloatArray | None = None

    @property
    def below(self) -> BoolArray:
        """True (n,) for levels that are known to be below the floor."""
        return np.asarray(self.level_db <= self.floor_db)


def level_track(
    time_s: ArrayLike, position_m: ArrayLike, level_db: ArrayLike, *, floor_db: float = -np.inf
) -> LevelTrack:
    """Return medians of levels over windows of :data:`WINDOW_S` or longer.

    A median is below the floor if more than half of the samples in its window are below the floor.

    Parameters
    ----------
    time_s : (n,)
    position_m : (n, 3)
        Positions of the UAV [m]; NaN if unknown.
    level_db : (n,)
        Levels [dB]. NaN is ignored.
    floor_db : float

    Returns
    -------
    LevelTrack
        At most :data:`_MOST_BINS` levels.
    """
    time, place, level = (np.asarray(v, dtype=np.float64) for v in (time_s, position_m, level_db))
    finite = np.isfinite(level) & np.isfinite(place).all(axis=1) & np.isfinite(time)
    time, place, level = time[finite], place[finite], np.maximum(level[finite], floor_db)
    if not len(time):
        return LevelTrack(time, place, level, floor_db)
    # slightly longer, because otherwise the last sample would be alone in a bin
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
    """The log evidence (m,) of positions, with slope and its standard deviation (m,) for a node at each position."""

    evidence: FloatArray
    slope: FloatArray
    slope_sd: FloatArray


def fit_places(track: LevelTrack, places_m: ArrayLike, model: LevelModel = UNKNOWN) -> Fits:
    """Return the log evidence of the levels for each candidate position of the node.

    Parameters
    ----------
    track : LevelTrack
    places_m : (m, 3)
        East, north, up.
    model : LevelModel
        Prior of slope, gains and shadowing.

    Notes
    -----
    The level is mean + F c + shadowing + scatter, c ~ N(0, 1). F has a term for the level at 100 m, one for the slope,
    two for the elevation, four for the azimuth at the node, and eight for the direction at the airframe. Levels above
    the floor have a normal distribution. The probability of levels below the floor, given all others, is computed by
    Laplace's approximation at the maximum of the posterior (Rasmussen and Williams, 2006, section 3.4).
    """
    places = unmasked(places_m).reshape(-1, 3)
    shadows = {case.shadow: _Shadowing.of(track, case) for case in model.cases}
    parts = [_fit(track, places[i : i + _AT_ONCE], model, shadows) for i in range(0, len(places), _AT_ONCE)]
    return Fits(*np.concatenate(parts, axis=1))


@dataclass(frozen=True, slots=True)
class _Shadowing:
    """Shadowing and scatter of the levels of a track.

    ``root`` (k, k) is the inverse lower root of the covariance of the k levels above the floor. ``across`` (j, k) times
    their whitened values predicts the shadowing of the j levels below the floor. The covariance of the prediction error
    is ``left`` (j, j).
    """

    root: FloatArray
    across: FloatArray
    left: FloatArray

    @classmethod
    def of(cls, track: LevelTrack, case: Case) -> _Shadowing:
        apart = np.linalg.norm(track.position_m[:, None] - track.position_m, axis=-1) / case.length_m
        lag = np.abs(track.time_s[:, None] - track.time_s) / case.time_s
        shadow, seen = case.shadow_db**2 * np.exp(-apart - lag), ~track.below
        root = np.linalg.inv(np.linalg.cholesky(shadow[seen][:, seen] + case.scatter_db**2 * np.eye(seen.sum())))
        across = shadow[~seen][:, seen] @ root.T
        return cls(root, across, shadow[~seen][:, ~seen] - across @ across.T)


def _features(track: LevelTrack, places: FloatArray, model: LevelModel, learned: bool) -> FloatArray:
    """Return the effects of unit-variance coefficients on a level, then the level minus its mean (n, m, terms + 1)."""
    ray = track.position_m[None] - places[:, None]
    across = np.hypot(ray[..., 0], ray[..., 1])
    # relative to 100 m, and at least 1 m, because the model is not valid at shorter distances
    decades = np.log10(np.maximum(np.hypot(across, ray[..., 2]), 1.0) / 100.0)
    elevation, towards = elevation_rad(ray), ray / np.maximum(np.linalg.norm(ray, axis=-1, keepdims=True), 1e-9)
    east, north, _ = np.moveaxis(towards, -1, 0)
    columns = [
        np.full(across.shape, _FREE_DB),
        -10.0 * model.slope_sd * decades,
        model.elevation_sd_db * np.sin(elevation) ** 2,
        0.5 * model.elevation_sd_db * np.cos(4.0 * elevation),
        *(east, north, 0.7 * (east**2 - north**2), 1.4 * east * north),
    ]
    at_uav = -towards if track.rotation is None else np.einsum("nji,mnj->mni", track.rotation, -towards)
    x, y, z = np.moveaxis(at_uav, -1, 0)
    second = [1.7 * x * y, 1.7 * x * z, 1.7 * y * z, 0.9 * (x**2 - y**2), 0.6 * (3.0 * z**2 - 1.0)]
    gain_db, sd_db = (0.0, 1.0) if track.airframe_db is None or not learned else track.airframe_db(at_uav, towards)
    columns += [sd_db * term for term in (x, y, z, *second)]
    middle = 0.5 * float(track.level_db.max() + track.level_db.min())
    columns.append(track.level_db - (middle - 10.0 * model.slope * decades + gain_db))
    return np.ascontiguousarray(np.stack(columns, axis=-1).swapaxes(0, 1))


# Number of terms of level, slope and elevation, then of azimuth, then of the airframe.
_TERMS = (4, 4, 8)


def _fit(
    track: LevelTrack, places: FloatArray, model: LevelModel, shadows: dict[tuple[float, ...], _Shadowing]
) -> FloatArray:
    """Return log evidence, slope and its standard deviation (3, m), over all cases."""
    from scipy.special import logsumexp

    features = {learned: _features(track, places, model, learned) for learned in {c.learned for c in model.cases}}
    evidence, slope, variance = fits = np.empty((3, len(model.cases), len(places)))
    whitened: dict[tuple[object, ...], tuple[FloatArray, FloatArray]] = {}
    for number, case in enumerate(model.cases):
        key = (case.shadow, case.learned)
        if key not in whitened:
            whitened = {key: _whitened(features[case.learned], ~track.below, shadows[case.shadow])}
        fits[:, number] = _fit_case(case, *whitened[key], shadows[case.shadow])
    evidence += np.array([[case.log_weight] for case in model.cases])
    total = logsumexp(evidence, axis=0)
    share = np.exp(evidence - total)
    mean = (share * slope).sum(axis=0)
    spread = np.sqrt((share * (variance + (slope - mean) ** 2)).sum(axis=0))
    return np.array([total, model.slope + model.slope_sd * mean, model.slope_sd * spread])


def _whitened(features: FloatArray, seen: BoolArray, shadow: _Shadowing) -> tuple[FloatArray, FloatArray]:
    """Return features of k levels above the floor, whitened, and of j levels below it, given those above."""
    flat = features.reshape(len(features), -1)
    above = shadow.root @ flat[seen]
    below = flat[~seen] - shadow.across @ above
    apart = [part.reshape(len(part), *features.shape[1:]).swapaxes(0, 1) for part in (above, below)]
    return apart[0], apart[1]


def _fit_case(case: Case, above: FloatArray, below: FloatArray, shadow: _Shadowing) -> tuple[FloatArray, ...]:
    """Return log evidence, standardised slope and its variance (m,) for one case."""
    scale = np.repeat([1.0, case.azimuth_db, case.airframe_db], _TERMS)
    gram = above.swapaxes(1, 2) @ above
    root = np.linalg.cholesky(np.eye(len(scale)) + scale[:, None] * gram[:, :-1, :-1] * scale)
    inverse = np.linalg.inv(root)
    pull = (inverse @ (scale * gram[:, :-1, -1])[:, :, None])[:, :, 0]
    size = np.log(np.diag(shadow.root)).sum() - above.shape[1] * _LOG_ROOT_TAU
    size -= np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1)
    evidence = 0.5 * ((pull**2).sum(axis=1) - gram[:, -1, -1]) + size
    if below.shape[1]:
        terms = (scale * below[:, :, :-1]) @ inverse.swapaxes(1, 2)
        mean = (terms @ pull[:, :, None])[:, :, 0] - below[:, :, -1]
        held, force = _below_floor(mean, shadow.left + terms @ terms.swapaxes(1, 2), case.scatter_db)
        evidence, pull = evidence + held, pull + (terms.swapaxes(1, 2) @ force[:, :, None])[:, :, 0]
    # use the variance given the levels above the floor, because the levels below the floor hardly reduce it
    return evidence, (inverse[:, :, 1] * pull).sum(axis=1), (inverse[:, :, 1] ** 2).sum(axis=1)


_LOG_ROOT_TAU = 0.5 * float(np.log(2.0 * np.pi))


def _below_floor(mean: FloatArray, covariance: FloatArray, scatter_db: float) -> tuple[FloatArray, FloatArray]:
    """Return the log probability (m,) that levels are below the floor, and its gradient (m, j) [1 / dB].

    Parameters
    ----------
    mean, covariance : (m, j) and (m, j, j)
        Moments of the levels relative to the floor, given the levels above the floor, without scatter [dB, dB^2].
    scatter_db : float
    """
    eye, latent = np.eye(mean.shape[1]), np.minimum(mean, 0.0)
    for _ in range(_STEPS):
        _, gradient, weight = _likelihood(latent, scatter_db)
        root = np.sqrt(weight)
        matrix = eye + root[:, :, None] * covariance * root[:, None, :]
        target = weight * (latent - mean) + gradient
        moved = root * (covariance @ target[:, :, None])[:, :, 0]
        force = target - root * np.linalg.solve(matrix, moved[:, :, None])[:, :, 0]
        before, latent = latent, mean + (covariance @ force[:, :, None])[:, :, 0]
        if np.abs(latent - before).max() < _SETTLED_DB:
            break
    value, _, weight = _likelihood(latent, scatter_db)
    root = np.sqrt(weight)
    size = np.linalg.slogdet(eye + root[:, :, None] * covariance * root[:, None, :])[1]
    return value.sum(axis=1) - 0.5 * (force * (latent - mean)).sum(axis=1) - 0.5 * size, force


def _likelihood(latent: FloatArray, scatter_db: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the log probability that levels with scatter are below 0, its gradient, and minus its curvature (m, j)."""
    from scipy.special import log_ndtr

    z = -latent / scatter_db
    value = log_ndtr(z)
    hazard = np.exp(-0.5 * z * z - _LOG_ROOT_TAU - value)
    return value, -hazard / scatter_db, np.clip(hazard * (hazard + z), 1e-12, 1.0) / scatter_db**2


# Side of the cells of a region [m], largest number of cells, and smallest share of a part of a region that is shown.
_CELL_M, _MOST_CELLS, _LEAST_SHARE = 5.0, 1_000_000, 0.03


@dataclass(frozen=True, slots=True)
class Mode:
    """A connected part of the 90 % region.

    Parameters
    ----------
    place_m : (2,)
        Likeliest position in this part: east and north [m].
    share : float
        Share of the posterior in this part.
    radius_m : float
        Radius of the circle about this position that contains 90 % of this part.
    """

    place_m: FloatArray
    share: float
    radius_m: float


@dataclass(frozen=True, slots=True)
class Regions:
    """The posterior of a node's position, in cells.

    Parameters
    ----------
    east_m, north_m : (columns,), (rows,)
        Middles of the cells.
    share : (columns, rows)
        Share of the posterior in each cell. The sum is 1.
    """

    east_m: FloatArray
    north_m: FloatArray
    share: FloatArray

    @classmethod
    def of(cls, places: FloatArray, share: FloatArray, sd_m: float = SYSTEMATIC_M) -> Regions:
        """Return the regions for a posterior: shares (m,) at positions (m, 2 or more), blurred by ``sd_m`` [m]."""
        reach = 4.0 * sd_m
        area = float(np.prod(np.ptp(places[:, :2], axis=0) + 2.0 * reach))
        cell = max(_CELL_M * sd_m / SYSTEMATIC_M, float(np.sqrt(area / _MOST_CELLS)))
        axes = [np.arange(p.min() - reach, p.max() + reach + cell, cell) for p in places.T[:2]]
        density = _blurred(places, share, axes, sd_m)
        return cls(axes[0], axes[1], density / density.sum())

    def likeliest(self) -> FloatArray:
        """Return the middle (2,) of the likeliest cell."""
        # round the shares, so that floating-point errors do not decide between a position and its mirror image
        column, row = np.unravel_index(self.share.round(12).argmax(), self.share.shape)
        return np.array([self.east_m[column], self.north_m[row]])

    def likelier(self) -> FloatArray:
        """Return the share of the posterior in all cells that are likelier than each cell (columns, rows)."""
        order = np.argsort(-self.share, axis=None)
        held = np.empty(self.share.size)
        held[order] = np.cumsum(self.share.ravel()[order]) - self.share.ravel()[order]
        return held.reshape(self.share.shape)

    def modes(self, part: float = 0.9) -> tuple[Mode, ...]:
        """Return the connected parts, likeliest first, of the region with the share ``part`` of the posterior."""
        from scipy.ndimage import label

        # cells that touch at a corner are connected
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
        """Return the radius of the circle about a position that contains the share ``part`` of the posterior."""
        east, north = np.meshgrid(self.east_m - place_m[0], self.north_m - place_m[1], indexing="ij")
        return _within(np.column_stack([east.ravel(), north.ravel()]), self.share.ravel(), part)


def _blurred(places: FloatArray, share: FloatArray, axes: Sequence[FloatArray], sd_m: float) -> FloatArray:
    """Return the blurred shares on a grid (columns, rows).

    Positions are on a lattice, so that each axis can be blurred separately.
    """
    (east, i), (north, j) = (np.unique(p.round(6), return_inverse=True) for p in places.T[:2])
    lattice = np.zeros((len(east), len(north)))
    np.add.at(lattice, (i, j), share)
    columns, rows = (
        np.exp(-0.5 * ((axis[:, None] - p) / sd_m) ** 2) for axis, p in zip(axes, (east, north), strict=True)
    )
    return np.asarray(columns @ lattice @ rows.T)


def _within(step_m: FloatArray, share: FloatArray, part: float) -> float:
    """Return the radius [m] within which the fraction ``part`` of the shares (n,) lies."""
    away = np.hypot(*step_m.T)
    order = np.argsort(away)
    held = np.cumsum(share[order])
    return float(away[order][np.searchsorted(held, part * held[-1])])


@dataclass(frozen=True, slots=True, kw_only=True)
class NodeEstimate:
    """The position of a node, estimated from the levels of a flight.

    Parameters
    ----------
    place_m : (3,)
        East, north and height above ground of the likeliest position.
    radius90_m : float
        Radius of the circle about this position that contains 90 % of the posterior.
    height_m : (low, high)
        Range of possible heights.
    slope, slope_sd : float
        Path-loss exponent and its standard deviation.
    anywhere : float
        Log evidence of all positions within reach together.
    placed : bool
        True if the levels fit a position within reach better than a position 30 km away, and the UAV moved.
    at_edge : bool
        True if more than a few percent of the posterior are at the edge of the search, so that the node may be farther
        away.
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
    """Estimate the position, height and slope that explain the levels of a flight best.

    Parameters
    ----------
    track : LevelTrack
        At least :data:`FEWEST` bins.
    model : LevelModel
        Prior of slope, gains and shadowing. The default is the prior of an unknown node.

    Raises
    ------
    InputError
        If there are too few levels.

    Notes
    -----
    The posterior is the evidence on a grid of positions at the heights :data:`_HEIGHTS_M`, times a prior that depends
    on the distance from the track. It is blurred by :data:`SYSTEMATIC_M`.
    """
    from scipy.special import logsumexp

    if len(track.level_db) < FEWEST:
        raise InputError(
            f"{counted(len(track.level_db), 'bin')} of 4 s with a level and a position above 5 m",
            expected=f"{FEWEST}",
            cause="a short flight, or logs of two flights",
        )
    track, (grid, spacing) = _thinned(track), _grid(track)
    if model is UNKNOWN:
        cases = model.cases if track.rotation is not None else _UNTURNED
        known = () if track.airframe_db is None else tuple(case.with_airframe() for case in UNKNOWN.cases)
        model = replace(model, cases=cases + known)
    model = _likely_cases(track, grid, model)
    places, evidence, step, anywhere = _searched(track, grid, spacing, model)
    afar = fit_places(track, track.position_m[:1] + np.array([_AFAR_M, 0.0, 0.0]), model).evidence[0]
    order = np.argsort(-evidence, kind="stable")[: np.count_nonzero(evidence > evidence.max() - _POSSIBLE)]
    fine = _divided(places[order[:_MOST_REFINED]], (-step / 3.0, 0.0, step / 3.0))
    places = np.concatenate([fine, places[order[_MOST_REFINED:]]])
    fits = fit_places(track, places, model)
    log_share = fits.evidence + _log_height(places) + _log_near(track, places)
    log_share[: len(fine)] -= np.log(9.0)
    share = np.exp(log_share - logsumexp(log_share))
    # blur widely spaced positions more, so that the region does not fall apart into spots
    regions = Regions.of(places, share, SYSTEMATIC_M * step / _SPACING_M)
    best = Regions.of(places, share, _SMOOTH_M * step / _SPACING_M).likeliest()
    nearest = int(np.hypot(*(places[:, :2] - best).T).argmin())
    heights = [h for h in _HEIGHTS_M if share[places[:, 2] == h].sum() > 0.05]
    return NodeEstimate(
        place_m=np.array([*best, places[share.argmax(), 2]]),
        radius90_m=regions.radius_m(best, 0.9),
        height_m=(min(heights), max(heights)),
        slope=float(fits.slope[nearest]),
        slope_sd=float(fits.slope_sd[nearest]),
        anywhere=anywhere,
        # the levels of a UAV that only turns on the spot depend on its airframe gain, not on the distance of the node
        placed=bool(
            fits.evidence.max() - afar > _PLACED_ODDS and np.ptp(track.position_m, axis=0).max() > SYSTEMATIC_M
        ),
        at_edge=bool(share[_on_edge(places, grid, spacing)].sum() > _LEAST_SHARE),
        regions=regions,
    )


def _thinned(track: LevelTrack) -> LevelTrack:
    """Return the track with at most :data:`_MOST_BELOW` of its levels below the floor."""
    below = np.flatnonzero(track.below)
    keep = ~track.below
    keep[below[spread_out(len(below), _MOST_BELOW)]] = True
    rotation = None if track.rotation is None else track.rotation[keep]
    time, place, level = track.time_s[keep], track.position_m[keep], track.level_db[keep]
    return replace(track, time_s=time, position_m=place, level_db=level, rotation=rotation)


def _likely_cases(track: LevelTrack, grid: FloatArray, model: LevelModel) -> LevelModel:
    """Return the model with only its likely cases, compared at positions of a grid (n, 2) that fit a usual case."""
    from scipy.special import logsumexp

    if len(model.cases) <= _MOST_CASES:
        return model
    places = _at_heights(grid)
    usual = fit_places(track, places, replace(model, cases=(_USUAL,))).evidence + _log_near(track, places)
    order = np.argsort(-usual, kind="stable")[: np.count_nonzero(usual > usual.max() - _POSSIBLE)]
    places = places[order[spread_out(len(order), _JUDGED)]]
    each = [fit_places(track, places, replace(model, cases=(case,))).evidence for case in model.cases]
    odds = logsumexp(np.array(each) + _log_near(track, places), axis=1)
    likely = [i for i in np.argsort(-odds, kind="stable")[:_MOST_CASES] if odds[i] > odds.max() - _LIKELY]
    return replace(model, cases=tuple(model.cases[i] for i in sorted(likely)))


# Prior of the position: a Cauchy distribution of the distance from the track, because flights are planned near the
# radio. The width of the distribution is this factor times the RMS distance of the track from its centre. For towers,
# the width is the second value [m].
_NEAR, _NEAR_TOWERS_M = 1.5, 150.0


def _log_near(track: LevelTrack, places: FloatArray, width_m: float | None = None) -> FloatArray:
    """Return the log prior (m,) of positions (m, 3) by their distance from the track."""
    flat = track.position_m[:, :2]
    width_m = width_m or max(_NEAR * float(np.sqrt(flat.var(axis=0).sum())), _SPACING_M)
    away = [np.hypot(*(place[:2] - flat).T).min() for place in places]
    return np.asarray(-1.5 * np.log1p((np.array(away) / width_m) ** 2))


def _log_height(places: FloatArray) -> FloatArray:
    """Return the log prior of the height of positions (m, 3)."""
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
    """Return the likeliest positions of a grid, divided until their spacing is :data:`_SPACING_M`.

    Return also the log evidence (m,) of the positions (m, 3), their spacing [m] and the log evidence of the whole grid.
    If too many positions are possible, they are not divided, because the levels do not determine the position better.
    """
    from scipy.special import logsumexp

    places, weight, others = _at_heights(grid), -float(np.log(len(grid))), list[FloatArray]()
    while True:
        evidence = fit_places(track, places, model).evidence + _log_height(places)
        possible = np.count_nonzero(evidence > evidence.max() - _POSSIBLE)
        if spacing_m <= _SPACING_M or possible > _MOST_DIVIDED:
            break
        order = np.argsort(-evidence, kind="stable")
        count = min(np.count_nonzero(evidence > evidence.max() - 2.0 * _POSSIBLE), _MOST_DIVIDED)
        others.append(evidence[order[count:]] + weight)
        places = _divided(places[order[:count]], (-spacing_m / 4.0, spacing_m / 4.0))
        spacing_m, weight = spacing_m / 2.0, weight - float(np.log(4.0))
    return places, evidence, spacing_m, float(logsumexp(np.concatenate([*others, evidence + weight])))


def _on_edge(places: FloatArray, grid: FloatArray, spacing_m: float) -> BoolArray:
    low, high = grid.min(axis=0) + spacing_m, grid.max(axis=0) - spacing_m
    return np.asarray(((places[:, :2] < low) | (places[:, :2] > high)).any(axis=1))


def _divided(places: FloatArray, steps_m: Sequence[float]) -> FloatArray:
    """Return each position (m, 3), moved by all pairs of steps to the east and north."""
    moved = np.array([(e, n, 0.0) for e in steps_m for n in steps_m])
    return np.asarray((places[:, None] + moved).reshape(-1, 3))


# Model for comparing a known position with all other positions: nearly free space, and unknown antennas. It was chosen
# on simulated flights.
_TOWERS = LevelModel(
    slope=2.1,
    slope_sd=0.3,
    elevation_sd_db=4.0,
    cases=tuple(
        Case(shadow_db=sd, length_m=length, scatter_db=1.5).with_gains(*_GAINS)
        for sd, length in product((2.5, 4.5), (15.0, 45.0))
    ),
)
_TOWER_SPACING_M = 60.0


def place_odds(track: LevelTrack, known_m: ArrayLike) -> FloatArray:
    """Return the log odds (k,) of known positions, such as towers, against any position around the track.

    The evidence is integrated over position, gain, slope and antennas, so that another position is preferred only if
    its better fit outweighs its additional freedom.

    Parameters
    ----------
    track : LevelTrack
        Track. Its antennas are treated as unknown, and levels below the floor as levels at the floor.
    known_m : (k, 3)
    """
    from scipy.special import logsumexp

    known, (grid, _) = unmasked(known_m).reshape(-1, 3), _grid(track, _TOWER_SPACING_M)
    free = _at_heights(grid)
    places = np.concatenate([known, free])
    share = fit_places(replace(track, floor_db=-np.inf), places, _TOWERS).evidence + _log_near(
        track, places, _NEAR_TOWERS_M
    )
    return np.asarray(share[: len(known)] + np.log(len(grid)) - logsumexp(share[len(known) :] + _log_height(free)))
