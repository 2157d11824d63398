"""Health of a receiver: usual errors on held-out flights, and tests of a later flight for a changed level.

Means of the error over 4 s consist of an offset, a correlated part and a white part. The sizes of both parts come from
held-out flights. Sizes that were fitted to a faulty flight would include its fault.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..common.units import FloatArray
from ..site.learned import LearnedHealth, LearnedSeries
from .evidence import ages
from .level import floored_fit

# Averaging time [s], and largest number of means. Longer flights are averaged over longer times.
BIN_S, _MOST_BINS = 4.0, 1000
# Largest time and distance between two means from which the correlation is estimated.
_LONGEST_S, _LONGEST_M = 100.0, 150.0
# Prior standard deviations over flights: of the RMSE as a share of the RMSE, and of the difference of two channels
# [dB]. Each prior counts as two flights. In one campaign, the RMSE of six held-out series varies by 8 %, and the
# difference of channels by 0.3 dB.
_RMSE_SHARE, _DIFFERENCE_SD_DB = 0.08, 1.0
_LEAST_SD_DB = 0.3


@dataclass(frozen=True, slots=True, kw_only=True)
class HeldOut:
    """The measured levels of one flight on one channel, and the levels that were predicted without this flight.

    Parameters
    ----------
    time_s, place_m : (n,), (n, 3)
        Ascending times [s], and positions of the UAV [m].
    measured_db, predicted_db : (n,)
        Levels before any offset; NaN if missing.
    floor_db : float
        Floor to which both levels are raised [dB]; minus infinity without a floor.
    locked : (n,), optional
        Receiver lock: 1 in lock, 0 without lock, NaN unknown.
    """

    time_s: FloatArray
    place_m: FloatArray
    measured_db: FloatArray
    predicted_db: FloatArray
    floor_db: float = -math.inf
    locked: FloatArray | None = None

    @property
    def error_db(self) -> FloatArray:
        """Error (n,) after raising both levels to the floor [dB]."""
        if self.floor_db == -math.inf:
            return self.measured_db - self.predicted_db
        offset_db = floored_fit(self.measured_db, self.predicted_db, self.floor_db).offset_db
        predicted_db = np.maximum(self.predicted_db - offset_db, self.floor_db)
        return np.asarray(np.maximum(self.measured_db, self.floor_db) - predicted_db)

    @property
    def longest_run_s(self) -> float:
        """Longest time over which the measured level did not change [s]."""
        known = np.isfinite(self.measured_db)
        return float(ages(self.time_s[known], self.measured_db[known]).max(initial=0.0))


def learned_health(flights: Sequence[HeldOut], differences_db: dict[str, list[float]]) -> LearnedHealth:
    """Return the usual errors of one channel, from held-out flights.

    Parameters
    ----------
    flights : sequence of HeldOut
        One or more flights.
    differences_db : dict of str to list of float
        For each other channel of the tower: the offset of this channel minus the offset of the other channel, per
        flight.
    """
    errors_db = [f.error_db for f in flights]
    series = [binned(f.time_s, error_db) for f, error_db in zip(flights, errors_db, strict=True)]
    seconds = [float(binned(f.time_s, e, 1.0)[1].std()) for f, e in zip(flights, errors_db, strict=True)]
    numbers = _noise(series)
    paths = zip(flights, series, strict=True)
    places = [np.column_stack([np.interp(at, f.time_s, axis) for axis in f.place_m.T]) for f, (at, _) in paths]
    apart = [np.linalg.norm(p[:, None] - p[None], axis=2) for p in places]
    locked = [f.locked for f in flights if f.locked is not None and np.isfinite(f.locked).any()]
    judged = [step_chi2(*each, noise=_noise([s for s in series if s is not each] or [each])) for each in series]
    steps = [chi2[np.isfinite(at)].max(initial=0.0) for at, chi2, _ in judged]
    values = {
        "rmse_db": float(np.mean(seconds)),
        "rmse_sd_db": _sd(seconds, _RMSE_SHARE * float(np.mean(seconds))),
        "slow_sd_db": numbers.slow_sd_db,
        "correlation_s": numbers.correlation_s,
        "correlation_m": _decay(apart, [error for _, error in series], _LONGEST_M)[1],
        "white_sd_db": numbers.white_sd_db,
        "step_chi2": float(max(steps)),
        "run_s": float(np.median([f.longest_run_s for f in flights])),
    }
    return LearnedHealth(
        **{name: round(value, 3) for name, value in values.items()},
        below_lock_share=round(float(np.mean([np.nanmean(each == 0.0) for each in locked])), 3) if locked else None,
        channel_difference_sd_db={
            other: round(_sd(each, _DIFFERENCE_SD_DB), 3) for other, each in differences_db.items() if each
        },
        flights=len(flights),
    )


def _sd(values: Sequence[float], prior: float) -> float:
    """Return the standard deviation of values, with a prior that counts as two values."""
    spread = float(np.square(np.array(values) - np.mean(values)).sum())
    return math.sqrt((2.0 * prior**2 + spread) / (len(values) + 1.0))


@dataclass(frozen=True, slots=True, kw_only=True)
class Noise:
    """The noise of means over 4 s: SD and correlation time of the correlated part, and SD of the white part."""

    slow_sd_db: float
    correlation_s: float
    white_sd_db: float

    def whiten(self, time_s: FloatArray, columns: FloatArray) -> FloatArray:
        """Return columns (n, k), transformed so that the noise at times (n,) is white with unit variance."""
        apart_s = np.abs(time_s[:, None] - time_s[None])
        covariance = self.slow_sd_db**2 * np.exp(-apart_s / self.correlation_s)
        covariance[np.diag_indices(len(time_s))] += max(self.white_sd_db, _LEAST_SD_DB) ** 2
        return np.asarray(np.linalg.solve(np.linalg.cholesky(covariance), columns))

    def square(self, time_s: FloatArray, error_db: FloatArray) -> float:
        """Return the sum of squares of whitened errors (n,) after the best offset."""
        white = self.whiten(time_s, np.column_stack([np.ones(len(time_s)), error_db]))
        unit = white[:, 0] / max(float(np.linalg.norm(white[:, 0])), 1e-12)
        return float(np.square(white[:, 1] - unit * (unit @ white[:, 1])).sum())


def binned(time_s: FloatArray, error_db: FloatArray, width_s: float = BIN_S) -> tuple[FloatArray, FloatArray]:
    """Return times (m,) and means (m,) of the error over bins of time, minus their mean."""
    known = np.isfinite(error_db)
    time_s, error_db = time_s[known], error_db[known]
    if not len(time_s):
        return time_s, error_db
    width_s = max(width_s, float(np.ptp(time_s)) / _MOST_BINS)
    _, place = np.unique(np.floor(time_s / width_s), return_inverse=True)
    count = np.bincount(place)
    mean_db = np.bincount(place, error_db) / count
    return np.bincount(place, time_s) / count, mean_db - mean_db.mean()


def _noise(series: Sequence[tuple[FloatArray, FloatArray]]) -> Noise:
    """Return the noise that fits several flights. Each flight consists of its times and its errors."""
    apart = [np.abs(time_s[:, None] - time_s[None]) for time_s, _ in series]
    errors = [error for _, error in series]
    variance, correlation_s = _decay(apart, errors, _LONGEST_S)
    total = float(np.mean([error.var() for error in errors]))
    variance = min(variance, total)
    return Noise(
        slow_sd_db=math.sqrt(variance), correlation_s=correlation_s, white_sd_db=math.sqrt(max(total - variance, 0.0))
    )


def _decay(apart: Sequence[FloatArray], errors: Sequence[FloatArray], longest: float) -> tuple[float, float]:
    """Fit an exponential covariance to products of pairs of errors, and return its variance and correlation length."""
    pairs = [np.triu(at < longest, 1) for at in apart]
    separation = np.concatenate([at[near] for at, near in zip(apart, pairs, strict=True)])
    product = np.concatenate([np.outer(e, e)[near] for e, near in zip(errors, pairs, strict=True)])
    fits = []
    for length in np.geomspace(0.04 * longest, longest, 30).tolist():
        shape = np.exp(-separation / length)
        variance = max(float(shape @ product) / max(float(shape @ shape), 1e-12), 0.0)
        fits.append((float(np.square(product - variance * shape).sum()), variance, length))
    return min(fits)[1:]


# --- a later flight -------------------------------------------------------------------------------------------------

# Smallest chi-squared of a step on two channels, and the amount added per further channel. One in a thousand healthy
# flights exceeds this limit. In simulated healthy flights of 830 s, 95 % are below 14 to 15, and 99 % below 17 to 20.
_STEP_CHI2, _FURTHER_CHI2 = 25.0, 4.0
# Chi-squared of a step must exceed that of a slower change by the first number. A slower change takes one of these
# times [s] or the whole flight.
_BEFORE_SLOWER, _SLOW_S = 5.0, (100.0, 200.0)
# A step must reduce the variance of the errors by at least this share of its own variance.
_LEAST_TAKEN = 0.5
# Largest mean square of the whitened error after a step. For healthy flights at LW1, this mean square is at most 1.2.
_MOST_SQUARE = 1.6
# Smallest number of means before and after a step (one minute).
_LEAST_EACH_SIDE = 15
# Largest chi-squared of another step in the residual. 99 % of simulated healthy flights are below this limit.
_MOST_LEFT_CHI2 = 18.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Judged:
    """The error of one channel of a later flight, measured minus predicted, with the learned antenna of the prediction.

    ``start_s`` is the time at which ``time_s`` is 0, on a time scale that is common to all channels of the flight.
    """

    name: str
    time_s: FloatArray
    error_db: FloatArray
    learned: LearnedSeries
    unit: str
    transmit_power_dbm: float
    start_s: float = 0.0

    @property
    def health(self) -> LearnedHealth:
        """Usual errors of the channel. The learned antenna must contain these errors."""
        assert self.learned.health is not None
        return self.learned.health

    @property
    def noise(self) -> Noise:
        """Usual noise of the channel."""
        h = self.health
        return Noise(slow_sd_db=h.slow_sd_db, correlation_s=h.correlation_s, white_sd_db=h.white_sd_db)

    def square(self, error_db: FloatArray) -> float:
        """Return the sum of squares of the whitened means of errors (n,), after the best offset."""
        return self.noise.square(*binned(self.time_s, error_db))


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """A step of the level: time [s], chi-squared over all channels, and size by channel [dB]."""

    at_s: float
    chi2: float
    sizes_db: dict[str, float]


def step_chi2(time_s: FloatArray, error_db: FloatArray, *, noise: Noise) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return times (m,), chi-squared (m,) and sizes (m,) [dB] of possible steps, by generalised least squares.

    The last elements are slower changes, over 100 and 200 s around each time, and over the whole flight. The time of a
    slower change is NaN.

    Notes
    -----
    For the errors e with covariance C and a column x that is orthogonal to the offset under C, the size is
    x'C^-1 e / x'C^-1 x, and chi-squared is size^2 x'C^-1 x.
    """
    at = time_s[_LEAST_EACH_SIDE : len(time_s) - _LEAST_EACH_SIDE]
    if not len(at):
        return at, at, at
    steps = (time_s[:, None] >= at[None]).astype(np.float64)
    since = time_s[:, None] - at[None]
    slow = [np.clip(0.5 + since / width_s, 0.0, 1.0) for width_s in _SLOW_S]
    creep = (time_s - time_s[0]) / max(float(np.ptp(time_s)), 1e-9)
    white = noise.whiten(time_s, np.column_stack([np.ones(len(time_s)), error_db, steps, *slow, creep]))
    unit = white[:, 0] / np.linalg.norm(white[:, 0])
    rest = white[:, 1:] - np.outer(unit, unit @ white[:, 1:])
    power = np.maximum(np.square(rest[:, 1:]).sum(axis=0), 1e-12)
    size = rest[:, 0] @ rest[:, 1:] / power
    return np.append(at, np.full(len(size) - len(at), math.nan)), size**2 * power, size


def step_of(channels: Sequence[Judged]) -> Step | None:
    """Return the common step of all channels of a flight, or None if there is none.

    A step must be larger than steps in healthy flights and likelier than a slower change. After it is subtracted, the
    error must be as small as in a healthy flight.
    """
    series = [binned(c.time_s, c.error_db) for c in channels]
    least = _STEP_CHI2 + _FURTHER_CHI2 * max(len(channels) - 2, 0)
    least = max(least, sum(c.health.step_chi2 for c in channels))
    best, slower = _likeliest(channels, series)
    if best is None or best.chi2 < max(least, slower + _BEFORE_SLOWER):
        return None
    left, taken, own = [], 0.0, 0.0
    for channel, (time_s, error_db), size_db in zip(channels, series, best.sizes_db.values(), strict=True):
        step_db = size_db * (time_s + channel.start_s >= best.at_s)
        without = error_db - step_db
        taken, own = taken + float(error_db.var() - without.var()), own + float(step_db.var())
        if channel.noise.square(time_s, without) > _MOST_SQUARE * len(time_s):
            return None
        left.append((time_s, without))
    if taken < _LEAST_TAKEN * own:
        return None
    further, _ = _likeliest(channels, left)
    return best if further is None or further.chi2 < _MOST_LEFT_CHI2 else None


def _likeliest(
    channels: Sequence[Judged], series: Sequence[tuple[FloatArray, FloatArray]]
) -> tuple[Step | None, float]:
    """Return the likeliest common step of all channels, and chi-squared of the likeliest slower change."""
    each = [step_chi2(*of, noise=channel.noise) for channel, of in zip(channels, series, strict=True)]
    if not each or any(len(at) < 2 for at, _, _ in each):
        return None, 0.0
    own_s = [at[np.isfinite(at)] + channel.start_s for channel, (at, _, _) in zip(channels, each, strict=True)]
    at_s = own_s[0]

    def summed(kind: int) -> FloatArray:
        of = [c[kind * len(own) :][: len(own)] for own, (_, c, _) in zip(own_s, each, strict=True)]
        return np.asarray(sum(np.interp(at_s, own, c, 0.0, 0.0) for own, c in zip(own_s, of, strict=True)))

    chi2 = summed(0)
    slower = max(
        *(float(summed(1 + kind).max()) for kind in range(len(_SLOW_S))), sum(float(c[-1]) for _, c, _ in each)
    )
    best = float(at_s[chi2.argmax()])
    sizes = {
        channel.name: float(size_db[np.abs(own - best).argmin()])
        for channel, own, (_, _, size_db) in zip(channels, own_s, each, strict=True)
    }
    return Step(at_s=best, chi2=float(chi2.max()), sizes_db=sizes), slower


@dataclass(frozen=True, slots=True, kw_only=True)
class OddLevel:
    """A channel whose level differs from the level on held-out flights [dB], and text that names the channels."""

    name: str
    where: str
    difference_db: float


# An offset or a difference of offsets is unusual if it exceeds both this number of standard deviations and this level
# [dB].
_ODD_SD, _ODD_DB = 3.5, 4.0


def level_of(channels: Sequence[Judged]) -> OddLevel | None:
    """Return the channel whose offset, or difference from another channel, is most unusual.

    None if no channel is unusual.

    The difference of two channels varies less than the offset of each, because offsets depend on the gain setting of
    the flight.
    """
    off = [_excess(c) for c in channels]
    odd = []
    for i, (c, mine) in enumerate(zip(channels, off, strict=True)):
        for other, its in zip(channels[i + 1 :], off[i + 1 :], strict=True):
            usual_sd_db = c.health.channel_difference_sd_db.get(other.learned.channel)
            if other.learned.tower != c.learned.tower or usual_sd_db is None or mine is None or its is None:
                continue
            difference_db, sd_db = mine[0] - its[0], math.hypot(usual_sd_db, mine[1], its[1])
            larger = abs(mine[0]) >= abs(its[0])
            first, second, sign = (c, other, 1.0) if larger else (other, c, -1.0)
            odd.append((abs(difference_db) / sd_db, OddLevel(
                name=first.name, where=f"{first.name}, against {second.name},", difference_db=sign * difference_db
            )))  # fmt: skip
        if mine is not None and c.learned.level is not None:
            sd_db = math.hypot(c.learned.level.sd_db, mine[1])
            odd.append((abs(mine[0]) / sd_db, OddLevel(name=c.name, where=c.name, difference_db=mine[0])))
    odd = [(ratio, level) for ratio, level in odd if ratio > _ODD_SD and abs(level.difference_db) > _ODD_DB]
    return max(odd, key=lambda of: of[0])[1] if odd else None


def _excess(channel: Judged) -> tuple[float, float] | None:
    """Return the offset minus the usual offset, and its standard deviation on this flight [dB]."""
    level, noise = channel.learned.level, channel.noise
    known = np.isfinite(channel.error_db)
    if level is None or level.unit != channel.unit or not known.any():
        return None
    usual_db = level.offset_db + level.transmit_power_dbm - channel.transmit_power_dbm
    length_s = max(float(np.ptp(channel.time_s[known])), noise.correlation_s)
    sd_db = noise.slow_sd_db * math.sqrt(min(2.0 * noise.correlation_s / length_s, 1.0))
    return float(channel.error_db[known].mean()) - usual_db, sd_db
