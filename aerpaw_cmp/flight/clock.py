"""Clocks of a flight: radio clock against telemetry clock, steps of full hours, and relative times.

The lag between radio clock and telemetry clock is estimated from the likelihood of the residuals of a flight.

The sign convention is that ``radio_minus_telemetry_s`` is positive if the radio clock shows a later time. Radio times
are corrected by subtracting it.

A clock that is wrong by full hours is recognised because the logs overlap only after a shift of that many hours.

The start of a log with relative times follows from a companion log with absolute times.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import shapely

from ..common.gaussian import Factor, determining, gaussian_kernel
from ..common.geodesy import rough_m
from ..common.jsonable import fields_of
from ..common.units import AnyArray, BoolArray, FloatArray, Printed
from ..compare.evidence import ages
from ..compare.result import APPLIED, CANNOT_TELL, ESTIMATED, NOT_APPLIED, OK, SHIFTED, ClockResult
from ..compare.statistics import is_flat
from ..logs.records import Stream, has_wall_clock
from .track import interpolated, nanoseconds

# A lag is excluded if its log likelihood is below the maximum by more than this value [nat].
EVIDENCE_NAT = 4.0

# Lags up to this value [s] are not reported as a shift: positions, models and time stamps of real flights are not
# accurate enough.
_SAME_S = 0.5

# Clocks agree if every lag beyond this is excluded [s].
_AGREE_S = 1.0

# A channel has its own clock if its log likelihood at the common lag is below its maximum by more than this value
# [nat]. The difference is at most 1.1 for real channels, and 350 for two loggers 4 s apart.
_APART_NAT = 12.0

# Accuracy of the time stamps of autopilots and loggers [s]. The interval is widened by this value on each side.
STAMPS_S = 0.25

# First and last spacing of the lags [s], and the largest number of lags that are refined.
_STEP_S, _FINEST_S, _MOST_FINE = 0.5, 0.02, 40
# Largest number of means of the level per channel. Each mean covers one second or more.
_BINS = 900
_FEWEST = 60
# Number of times per mean at which the prediction is evaluated.
_PER_BIN = 8

# Correlation lengths of the gains of tower and UAV over direction, as chords of the unit sphere.
_CHORDS = ((0.2, 0.4, 0.8), (0.2, 0.45, 0.9))
# Largest number of features per gain, and the share of the gain's variance that the features may miss.
_FEATURES, _LEFT = 64, 0.01

# Prior standard deviation of offset and slope, relative to that of the residual. The value is so large that only the
# data matter.
_FREE = 1e3

_MEMORY_S = (2.0, 5.0, 15.0, 40.0)
_WHITE = (0.1, 0.3, 0.9)
# Candidate standard deviations for :class:`_Parts`.
_GAIN = (0.05, 0.5, 1.0, 2.0)

# The flight is divided into this number of parts. Without any two neighbouring parts, a shift must still be more likely
# than no shift by this value [nat]: a single dip, a jump of the position or a frozen track must not shift a clock.
_LEFT_OUT, _WITHOUT_NAT = 10, 2.0

# Means are limited to this number of robust standard deviations from the median of this number of neighbours.
_LONE, _NEIGHBOURS = 4.0, 9

# Number of lags that are evaluated together: more are faster, but take more memory (25 MB per correlation time).
_AT_ONCE = 31


class _Parts(NamedTuple):
    """The correlation time [s] of a residual, and SDs relative to its correlated part: white part and gains."""

    memory_s: float
    white: float
    gain: float


_START = _Parts(5.0, 0.3, 1.0)
# Parts of each channel.
_PartsOf = Sequence[Sequence[_Parts]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Along:
    """Predictors of the level of a channel at equally spaced times of the telemetry, NaN where the pose is unknown.

    Parameters
    ----------
    start_s, step_s : float
        First time and spacing [s].
    predicted_db : mapping of str to (g,)
        Levels of one or more models, by name [dB].
    distance_m : (g,)
    directions : (g, 6)
        Unit vectors from the tower to the UAV (site frame) and from the UAV to the tower (body frame).
    """

    start_s: float
    step_s: float
    predicted_db: Mapping[str, FloatArray]
    distance_m: FloatArray
    directions: FloatArray

    def features(self) -> FloatArray:
        """Return the features (g, p) of offset, slope and the gains of both ends."""
        ends = [_gain_features(self.directions[:, 3 * end : 3 * end + 3], _CHORDS[end]) for end in (0, 1)]
        # relative to 100 m, so that offset and slope are almost independent
        slope = np.log10(self.distance_m) - 2.0
        return np.column_stack([np.ones_like(slope), slope, *ends])

    @property
    def place(self) -> tuple[float, float, bytes, bytes]:
        """A key that is equal for channels with equal features."""
        return self.start_s, self.step_s, self.distance_m.tobytes(), self.directions.tobytes()


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockChannel:
    """One channel of a receiver: levels (n,) [dB] at radio times (n,) [s], and the predictors of the levels."""

    name: str
    time_s: FloatArray
    measured_db: FloatArray
    along: Along

    @property
    def flat(self) -> bool:
        """True if the levels hardly vary although every model predicts a variation."""
        at = (self.time_s - self.along.start_s) / self.along.step_s
        known = np.isfinite(self.measured_db)
        models = (np.interp(at[known], np.arange(len(p)), p) for p in self.along.predicted_db.values())
        return bool(known.any() and is_flat(self.measured_db[known], models))


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockEstimate:
    """The clock of one receiver on one flight.

    Parameters
    ----------
    radio_minus_telemetry_s : float
        Most likely lag [s]; NaN if no lag could be estimated.
    ci95_s : (low, high)
        Lags inside the window that are not excluded; the complete window if the data contain no information.
    verdict : {"ok", "shifted", "cannot tell"}
    reason : str
        Reason why the lag cannot be determined.
    window_s : float
        Largest lag that is searched on each side.
    model : str
        Prediction that explains the level best.
    channels_s : mapping of str to float
        Estimates from single channels.
    n : int
        Number of means of the level that were used.
    against_zero_nat : float
        Difference of two log likelihoods: of the best lag, and of the best lag of at most :data:`_SAME_S`.
    """

    radio_minus_telemetry_s: float
    ci95_s: tuple[float, float]
    verdict: str
    reason: str
    window_s: float
    model: str = ""
    channels_s: Mapping[str, float] = field(default_factory=dict)
    n: int = 0
    against_zero_nat: float = 0.0

    @property
    def correction_s(self) -> float:
        """The lag to subtract from radio times [s]: the estimate if it differs significantly from zero, otherwise 0."""
        low, high = self.ci95_s
        return 0.0 if self.verdict == CANNOT_TELL or low <= 0.0 <= high else self.radio_minus_telemetry_s

    def result(self, receiver: str, *, apply: bool) -> ClockResult:
        """Return the estimate as a result of the flight, applied if ``apply`` is set and the lag is significant."""
        applied = ESTIMATED
        if (apply and self.verdict != OK) or (apply and self.correction_s):
            applied = APPLIED if self.correction_s else NOT_APPLIED
        return ClockResult(
            receiver=receiver,
            radio_minus_telemetry_s=self.radio_minus_telemetry_s,
            ci95_s=self.ci95_s,
            verdict=self.verdict,
            reason=self.reason,
            applied=applied,
            checks=fields_of(self),
        )


def judge_clock(channels: Sequence[ClockChannel], *, window_s: float = 15.0) -> ClockEstimate:
    """Estimate the lag of channels whose time stamps come from one computer.

    Parameters
    ----------
    channels : sequence of ClockChannel
        One or more channels. Only models that all channels have are used.
    window_s : float
        Largest lag on each side [s].

    Returns
    -------
    ClockEstimate
        The estimate, which is not applied here.

    Notes
    -----
    Means y over a second are normal with mean offset + slope log10(d) + p(t - lag), where p is the prediction of a
    model. Three parts are random: gains over the direction at either end (Gaussian processes), a correlated residual
    (Ornstein-Uhlenbeck) and a white residual. Offset, slope and gains are integrated out, and the scale is profiled.
    The correlation time, the white share and the gains maximise the likelihood on a small grid, per channel, at lag 0
    or at the most likely lag of a model. For each lag, the model with the highest likelihood counts. A poor model
    therefore cannot exclude a lag. The best lag must be more likely than a level that does not depend on position at
    all. A shift must also be significant if any fifth of the flight is left out, so that it does not depend on a single
    dip, jump of the position or frozen track. A lag that is explained by repeated levels is not a shift.
    """
    alive = [channel for channel in channels if not channel.flat]  # a constant level contains no information about time
    named = [channel.along.predicted_db for channel in alive]
    models = [name for name in (named[0] if named else ()) if all(name in each for each in named)]
    places = {channel.along.place: channel.along for channel in alive}
    features = {place: along.features() for place, along in places.items()}
    single = (_Bins.of(channel, models, features[channel.along.place], window_s) for channel in alive)
    bins = _joined([b for b in single if b is not None])
    if not bins:
        return ClockEstimate(
            radio_minus_telemetry_s=float("nan"), ci95_s=(-window_s, window_s), verdict=CANNOT_TELL,
            reason=_NO_OVERLAP if alive else _FLAT_LEVEL, window_s=window_s,
        )  # fmt: skip
    steps = int(window_s / _STEP_S + 1e-9)
    lags = np.asarray(np.arange(-steps, steps + 1) * _STEP_S, dtype=np.float64)
    # find likely lags with an assumed correlation time, then fit the correlation time at these lags
    first = np.sum(np.concatenate([b.likelihood(lags, [[_START]] * len(b.names)) for b in bins]), axis=0)
    starts = np.unique([0.0, *lags[first.argmax(axis=1)]])  # the likeliest lag of each model, and zero
    parts = [b.fitted(starts) for b in bins]

    def likelihood(block: FloatArray) -> FloatArray:
        return np.concatenate([b.likelihood(block, each) for b, each in zip(bins, parts, strict=True)])

    tried, nats = _finer(lags, likelihood, window_s)
    estimate = _judged(tried, nats, [name for b in bins for name in b.names], window_s)
    # channels of one computer have the same lag, so their log likelihoods are added
    total = nats.sum(axis=0).max(axis=1)  # the most likely model at each lag
    estimate = replace(estimate, model=models[int(total.argmax())], n=sum(b.mean_db.size for b in bins))
    explained = total.max() - sum(b.constant() for b in bins)
    if explained < EVIDENCE_NAT + np.log(len(lags)):  # a smaller gain occurs by chance among so many lags
        return replace(estimate, verdict=CANNOT_TELL, reason=_NO_DEPENDENCE)
    lag_s, held_s = estimate.radio_minus_telemetry_s, _held_s(alive)
    held = 0.0 < lag_s <= held_s
    if estimate.verdict != SHIFTED or (not held and _shown_without(bins, parts, lag_s)):
        return estimate
    low, high = min(estimate.ci95_s[0], 0.0), max(estimate.ci95_s[1], 0.0)
    agree = low >= -_AGREE_S - STAMPS_S and high <= _AGREE_S + STAMPS_S
    verdict, reason = (OK, "") if agree else (CANNOT_TELL, _HELD.format(held_s) if held else _ONE_PLACE)
    return replace(estimate, verdict=verdict, reason=reason, ci95_s=(low, high))


def _held_s(channels: Sequence[ClockChannel]) -> float:
    """Return the 90th percentile of the age of repeated levels [s].

    A repeated level is late even if the clock is right. Levels at a limit of the receiver are not counted.
    """
    old_s = [np.zeros(1)]
    for channel in channels:
        known = np.isfinite(channel.measured_db)
        level_db = channel.measured_db[known]
        inside = (level_db > level_db.min(initial=np.inf)) & (level_db < level_db.max(initial=-np.inf))
        old_s.append(ages(channel.time_s[known], level_db)[inside])
    return float(np.quantile(np.concatenate(old_s), 0.9))


def _shown_without(bins: Sequence[_Bins], parts: Sequence[_PartsOf], lag_s: float) -> bool:
    """Check whether a lag remains more likely than zero if any two neighbouring parts of the flight are left out."""
    start, end = min(b.mean_s[0] for b in bins), max(b.mean_s[-1] for b in bins)
    lags = np.array([lag_s, 0.0, *((-_SAME_S, _SAME_S) if abs(lag_s) > _AGREE_S else ())])
    for part in range(_LEFT_OUT - 1):
        nats = []
        for b, each in zip(bins, parts, strict=True):
            away = (b.mean_s - start) / max(end - start, 1e-9) * _LEFT_OUT - part
            nats.append(b.likelihood(lags, each, (away < 0.0) | (away >= 2.0)))
        shifted, *same = np.concatenate(nats).sum(axis=0).max(axis=0)
        if shifted - max(same) < _WITHOUT_NAT:
            return False
    return True


_NO_OVERLAP = "too few samples have a level and a position of the UAV at every lag of the window"
_FLAT_LEVEL = "the level is constant although the model predicts a change"
_ONE_PLACE = "only one fifth of the flight supports a clock shift"
_HELD = "levels are repeated for up to {:.0f} s, so they are late although the clock may be right"
_NO_DEPENDENCE = "the level hardly depends on the position of the UAV"


def _finer(
    lags: FloatArray, likelihood: Callable[[FloatArray], FloatArray], window_s: float
) -> tuple[FloatArray, FloatArray]:
    """Refine the lags near the maximum, and return lags (m,) and log likelihoods (channels, models, m)."""
    nats, step = likelihood(lags), _STEP_S
    while step > _FINEST_S:
        total = nats.sum(axis=0).max(axis=0)
        # keep a margin of 2 nat, because a lag that is not excluded may lie between two excluded lags
        near = lags[total > total.max() - EVIDENCE_NAT - 2.0]
        if len(near) > _MOST_FINE:
            break
        step /= 5.0
        # round, because two coarse lags may refine to the same lag
        fine = np.unique(np.round((near[:, None] + step * np.arange(-4, 5)).ravel(), 6))
        fine = fine[(np.abs(fine) <= window_s) & ~np.isin(fine, np.round(lags, 6))]
        lags, nats = np.concatenate([lags, fine]), np.concatenate([nats, likelihood(fine)], axis=-1)
        order = np.argsort(lags)
        lags, nats = lags[order], nats[..., order]
    return lags, nats


def _judged(lags: FloatArray, nats: FloatArray, names: Sequence[str], window_s: float) -> ClockEstimate:
    """Return the estimate and verdict from log likelihoods (channels, models, lags)."""
    models = nats.sum(axis=0)
    best, total = int(models.max(axis=1).argmax()), models.max(axis=0) - models.max()
    near = np.flatnonzero(total > -EVIDENCE_NAT)
    # the interval ends at the nearest excluded lags
    first, last = lags[max(near[0] - 1, 0)], lags[min(near[-1] + 1, len(lags) - 1)]
    low, high = max(float(first) - STAMPS_S, -window_s), min(float(last) + STAMPS_S, window_s)
    against = -float(total[np.abs(lags) <= _SAME_S + 1e-9].max())
    agree = first >= -_AGREE_S and last <= _AGREE_S
    lowest, highest = Printed(low), Printed(high)
    verdict = CANNOT_TELL
    reason = f"any lag from {lowest:+.1f} to {highest:+.1f} s explains the level about equally well"
    if against > EVIDENCE_NAT and (near[0] == 0 or near[-1] == len(lags) - 1):
        reason = f"the best lag is near the edge of the window ({window_s:g} s): increase rss.advanced.lag_window_s"
    elif not low <= 0.0 <= high and (against > EVIDENCE_NAT or agree):
        verdict, reason = SHIFTED, ""
    elif agree:
        verdict, reason = OK, ""
    alone = {name: float(lags[value.argmax()]) for name, value in zip(names, nats[:, best], strict=True)}
    refused = nats[:, best].max(axis=1) - nats[:, best, total.argmax()]
    if refused.max() > _APART_NAT and np.ptp(list(alone.values())) > _AGREE_S:
        each = ", ".join(f"{name} {Printed(lag):+.1f} s" for name, lag in alone.items())
        verdict, reason = CANNOT_TELL, f"its channels have different clocks, {each}"
    return ClockEstimate(
        radio_minus_telemetry_s=float(lags[total.argmax()]),
        ci95_s=(low, high),
        verdict=verdict,
        reason=reason,
        channels_s=alone,
        window_s=window_s,
        against_zero_nat=against,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Bins:
    """Means (n, channels) of levels, times (s,) of the predictions, and index of the first prediction of each mean.

    ``features`` of directions are averaged over the same duration about each time. ``levels`` (g, channels * models)
    are the predictions.
    """

    names: Sequence[str]
    mean_db: FloatArray
    mean_s: FloatArray
    at_s: FloatArray
    first: AnyArray
    along: Along
    features: FloatArray
    levels: FloatArray

    @classmethod
    def of(cls, channel: ClockChannel, models: Sequence[str], features: FloatArray, window_s: float) -> _Bins | None:
        """Return the bins of a channel with a prediction at every lag of the window, or None if there are too few."""
        along = channel.along
        levels = np.column_stack([along.predicted_db[name] for name in models])
        t, y = np.asarray(channel.time_s), channel.measured_db
        lost = np.asarray(~(np.isfinite(features).all(axis=1) & np.isfinite(levels).all(axis=1)))
        missing = np.concatenate([[0], np.cumsum(lost)])
        with np.errstate(invalid="ignore"):
            low, high = (np.floor((t + side - along.start_s) / along.step_s) for side in (-window_s, window_s))
            ok: BoolArray = np.isfinite(y) & (low >= 0) & (high + 1 < len(lost))
        begin, end = (np.where(ok, side, 0).astype(np.int64) for side in (low, high))
        # count gaps cumulatively: the prediction must exist at all times of the window
        ok[ok] = missing[end[ok] + 2] == missing[begin[ok]]
        order = np.flatnonzero(ok)[np.argsort(t[ok], kind="stable")]
        t, y = t[order], y[order]
        if not len(t):
            return None
        # average over one second, or longer on flights of more than a quarter of an hour, because the cost grows with
        # the number of bins
        width = max(1.0, (t[-1] - t[0]) / _BINS)
        _, first, count = np.unique(np.floor(t / width), return_index=True, return_counts=True)
        if len(first) < _FEWEST:
            return None
        place = np.arange(len(t)) - np.repeat(first, count)
        few = place % np.repeat(-(-count // _PER_BIN), count) == 0
        starts = np.concatenate([[0], np.cumsum(few)])[first]
        return cls(
            names=[channel.name],
            mean_db=_calm(np.add.reduceat(y, first) / count)[:, None],
            mean_s=np.add.reduceat(t, first) / count,
            at_s=t[few],
            first=starts,
            along=along,
            features=_averaged(features, width / along.step_s),
            levels=levels,
        )

    def _between(self, at_s: FloatArray, table: FloatArray) -> FloatArray:
        place = (at_s - self.along.start_s) / self.along.step_s
        low = place.astype(np.int64)
        share = (place - low)[:, None]
        out = table.take(low, axis=0)
        out *= 1.0 - share  # in place and with take: new tables and brackets would take twice the time
        out += table.take(low + 1, axis=0) * share
        return out

    def systems(self, lags: FloatArray) -> FloatArray:
        """Return a table (n, lags, columns) of features (offset, slope, gains) and residuals per channel and model."""
        count = np.diff(np.append(self.first, len(self.at_s)))[:, None]
        features = self.features.shape[1]
        mean_db = np.repeat(self.mean_db, self.levels.shape[1] // len(self.names), axis=1)
        out = np.empty((len(mean_db), len(lags), features + self.levels.shape[1]))
        for row, lag in enumerate(lags):
            level = np.add.reduceat(self._between(self.at_s - lag, self.levels), self.first, axis=0) / count
            residual = mean_db - level
            out[:, row, :features] = self._between(self.mean_s - lag, self.features)
            # subtract the mean, which the fitted offset absorbs, because sums of numbers near 0 lose less precision
            out[:, row, features:] = residual - residual.mean(axis=0)
        return out

    def likelihood(self, lags: FloatArray, parts: _PartsOf, kept: BoolArray | None = None) -> FloatArray:
        """Return the log likelihood (channels, models, lags) of the means ``kept`` with the best of ``parts``."""
        each = list(dict.fromkeys(part for channel in parts for part in channel))
        own = [[each.index(part) for part in channel] for channel in parts]
        blocks = np.array_split(lags, -(-len(lags) // _AT_ONCE))
        tried = np.concatenate([self._tried(block, each, kept) for block in blocks], axis=1)
        best = [tried[which, :, channel].max(axis=0).T for channel, which in enumerate(own)]
        return np.asarray(np.stack(best))

    def fitted(self, lags: FloatArray) -> _PartsOf:
        """Return, for each channel, the most likely parts for each model and each of the given lags."""
        parts = [_Parts(*each) for each in product(_MEMORY_S, _WHITE, _GAIN)]
        best = self._tried(lags, parts).argmax(axis=0)
        return [[parts[at] for at in np.unique(best[:, channel])] for channel in range(len(self.names))]

    def _tried(self, lags: FloatArray, parts: Sequence[_Parts], kept: BoolArray | None = None) -> FloatArray:
        """Return the log likelihood of every combination (parts, lags, channels, models)."""
        rows = np.ones(len(self.mean_s), dtype=bool) if kept is None else kept
        nats = _likelihood(self.systems(lags)[rows], self.mean_s[rows], self.levels.shape[1], parts)
        return nats.reshape(len(parts), len(lags), len(self.names), -1)

    def constant(self) -> float:
        """Return the largest log likelihood of levels that do not depend on position, added over the channels."""
        ones = np.ones(len(self.mean_s))
        columns = np.column_stack([ones, 0.0 * ones, self.mean_db - self.mean_db.mean(axis=0)])
        parts = [_Parts(*memory, 0.0) for memory in product(_MEMORY_S, _WHITE)]
        nats = _likelihood(columns[:, None], self.mean_s, len(self.names), parts)
        return float(nats.max(axis=0).sum())


def _joined(single: Sequence[_Bins]) -> list[_Bins]:
    """Join bins of channels at the same times and place, because their features then need to be whitened only once."""
    groups: dict[object, list[_Bins]] = {}
    for b in single:
        groups.setdefault((b.along.place, b.mean_s.tobytes(), b.at_s.tobytes()), []).append(b)
    return [
        replace(
            group[0],
            names=[name for b in group for name in b.names],
            mean_db=np.hstack([b.mean_db for b in group]),
            levels=np.hstack([b.levels for b in group]),
        )
        for group in groups.values()
    ]


def _calm(mean_db: FloatArray) -> FloatArray:
    """Limit how far means (n,) deviate from their neighbours, so that a single dip has little weight."""
    from scipy.ndimage import median_filter

    middle = median_filter(mean_db, _NEIGHBOURS, mode="nearest")
    # 1.4826 converts a median of absolute deviations to the standard deviation of a normal distribution
    reach = _LONE * 1.4826 * float(np.median(np.abs(mean_db - middle)))
    return np.asarray(np.clip(mean_db, middle - reach, middle + reach))


def _averaged(table: FloatArray, width: float) -> FloatArray:
    """Return the running mean of a table (g, k) over its rows. Rows with NaN stay NaN.

    The attitude varies while a level is averaged. If it were taken at single times, the likelihood would jump by 10 nat
    between lags 0.1 s apart, and one of the jumps would look like a sharp optimum.
    """
    from scipy.ndimage import correlate1d

    finite: BoolArray = np.asarray(np.isfinite(table).all(axis=1))
    reach = int(width / 2 + 0.5)
    # use a centred window, because any other window would add a lag
    weights = np.clip(width / 2 + 0.5 - np.abs(np.arange(-reach, reach + 1)), 0.0, 1.0)
    share = correlate1d(finite.astype(np.float64), weights, mode="nearest")
    out = correlate1d(np.where(finite[:, None], table, 0.0), weights, axis=0, mode="nearest")
    return np.asarray(np.where(finite[:, None], out / np.where(finite, share, 1.0)[:, None], np.nan))


def _gain_features(direction: FloatArray, chords: Sequence[float]) -> FloatArray:
    """Return features (g, q) of directions (g, 3).

    Inner products of features are covariances of a gain of unit variance.
    """
    finite = np.isfinite(direction).all(axis=1)
    unit = direction[finite] / np.linalg.norm(direction[finite], axis=1, keepdims=True)

    def covariance(first: FloatArray, second: FloatArray) -> FloatArray:
        return np.asarray(sum(gaussian_kernel(first, second, chord) for chord in chords) / len(chords))

    # thin the directions, because neighbours in time have the same direction
    some = unit[:: max(1, len(unit) // 1500)]
    base = some[determining(some, covariance, _LEFT, _FEATURES)]
    out = np.full((len(direction), len(base)), np.nan)
    # add a small diagonal against rounding errors. The diagonal has little effect, because the points are almost
    # independent.
    known = Factor.of(covariance(base, base) + 1e-9 * np.eye(len(base)))
    out[finite] = known.whiten(covariance(unit, base).T).T
    return out


def _whitened(
    columns: FloatArray, time_s: FloatArray, memories: Sequence[tuple[float, float]]
) -> tuple[FloatArray, FloatArray]:
    """Return whitened columns (n, times, ...) per correlation time, and log determinants (times,) of the covariances.

    A residual with a correlation time and a white share has the covariance exp(-|dt| / memory), plus white^2 on the
    diagonal. A Kalman filter subtracts from each row its expectation from earlier rows.
    """
    memory, white = np.array(memories).T
    keeps = np.exp(-np.append(np.diff(time_s), 0.0)[:, None] / memory)
    variances, gains, uncertainty = np.empty_like(keeps), np.empty_like(keeps), np.ones(len(memory))
    for row, keep in enumerate(keeps):
        variances[row] = uncertainty + white**2
        gains[row] = keep * uncertainty / variances[row]
        uncertainty = keep**2 * uncertainty * white**2 / variances[row] + 1.0 - keep**2
    flat = columns.reshape(len(columns), 1, -1)
    out = np.empty((len(columns), len(memory), flat.shape[2]))  # expected rows, later residuals
    out[0], buffer = 0.0, np.empty_like(out[0])
    np.multiply(flat[:-1], gains[:-1, :, None], out=out[1:])
    for last, expected, keep in zip(out[:-1], out[1:], (keeps - gains)[..., None], strict=False):
        np.add(expected, np.multiply(last, keep, out=buffer), out=expected)
    np.subtract(flat, out, out=out)
    out /= np.sqrt(variances)[..., None]
    return out.reshape(len(columns), len(memory), *columns.shape[1:]), np.log(variances).sum(axis=0)


def _likelihood(columns: FloatArray, time_s: FloatArray, residuals: int, parts: Sequence[_Parts]) -> FloatArray:
    """Return the log likelihood (parts, lags, residuals) of systems (n, lags, p + residuals) with rows at ``time_s``.

    Offset, slope and gains are integrated out, and the scale is profiled.
    """
    # whiten once per correlation time, because gains do not change the covariance of the residual
    memories = list(dict.fromkeys((part.memory_s, part.white) for part in parts))
    white, log_det = _whitened(columns, time_s, memories)
    lags = range(columns.shape[1])
    # compute these small matrices once: with them, the likelihood for other gains does not need the rows
    gram = np.stack([[white[:, m, lag].T @ white[:, m, lag] for lag in lags] for m in range(len(memories))])
    n, p = len(columns), columns.shape[2] - residuals
    out = np.empty((len(parts), len(lags), residuals))
    for row, part in enumerate(parts):
        which = memories.index((part.memory_s, part.white))
        # the first two features are offset and slope
        spread = np.concatenate([[_FREE] * 2, np.full(p - 2, part.gain), np.ones(residuals)])
        bordered = spread[:, None] * gram[which] * spread
        square = np.diagonal(bordered, axis1=1, axis2=2)[:, p:]
        # only the first p columns of the last rows are used; adding 1 keeps the matrix positive definite
        lower = np.linalg.cholesky(bordered + np.eye(len(spread)))
        square = np.maximum(square - (lower[:, p:, :p] ** 2).sum(axis=2), np.finfo(np.float64).tiny)
        determinant = np.log(np.diagonal(lower, axis1=1, axis2=2)[:, :p]).sum(axis=1)[:, None] + 0.5 * log_det[which]
        out[row] = -0.5 * n * np.log(square / n) - determinant
    return out


@dataclass(frozen=True, slots=True)
class ClockTrap:
    """Two logs of one flight that overlap only after a shift of full or half hours.

    Parameters
    ----------
    hours : float
        Hours to add to radio times.
    explanation : str
        Cause of the shift.
    is_utc : bool
        True if UTC that was read as local time explains the shift.
    """

    hours: float
    explanation: str
    is_utc: bool = False

    def advice(self) -> str:
        """Return cause and remedy as text."""
        return f"{self.explanation}; try 'timezone: ZONE' or 'clock: local | utc | local_as_utc' next to the log"


def clock_trap(
    radio_span: tuple[Any, Any], telemetry_span: tuple[Any, Any], timezone: str | None = None
) -> ClockTrap | None:
    """Recognise a clock that is wrong by full hours, such as local time that was stored as UTC.

    Parameters
    ----------
    radio_span, telemetry_span : (first, last)
        First and last time, as datetime64 (UTC) or epoch seconds.
    timezone : str, optional
        IANA zone of the site. A shift that equals the zone's offset from UTC on that day is explained by the zone.

    Returns
    -------
    ClockTrap or None
        None if the logs overlap, or if no shift of up to 14 h (in half hours) makes them overlap.

    Examples
    --------
    >>> trap = clock_trap((0.0, 600.0), (4 * 3600.0, 4 * 3600.0 + 620.0), "America/New_York")
    >>> trap.hours
    4.0
    """
    radio = nanoseconds(np.asarray(radio_span)) * 1e-9
    telemetry = nanoseconds(np.asarray(telemetry_span)) * 1e-9

    def overlap(hours: FloatArray) -> FloatArray:
        start = np.maximum(radio[0] + 3600.0 * hours, telemetry[0])
        return np.asarray(np.maximum(0.0, np.minimum(radio[1] + 3600.0 * hours, telemetry[1]) - start))

    # shifts of up to 14 h, with half hours for India and Newfoundland
    shifts = np.asarray(np.arange(-28, 29) * 0.5, dtype=np.float64)
    shared = overlap(shifts)
    now = float(overlap(np.zeros(1))[0])
    # prefer full hours to half hours, and small shifts to large shifts
    order = [(-round(float(shared[i])), shifts[i] % 1 != 0, abs(float(shifts[i])), i) for i in range(len(shifts))]
    best = min(order)[-1]
    shorter = min(radio[1] - radio[0], telemetry[1] - telemetry[0])
    # the logs share most of their time, so their clocks agree
    if now >= 0.5 * shorter or shared[best] < max(0.5 * shorter, 1e-9):
        return None
    hours = float(shifts[best])
    explanation, is_utc = _explain_hours(hours, float(telemetry[0]), timezone)
    return ClockTrap(hours, explanation, is_utc)


def _explain_hours(hours: float, instant: float, timezone: str | None) -> tuple[str, bool]:
    if timezone is not None:
        from datetime import datetime
        from datetime import timezone as utc
        from zoneinfo import ZoneInfo

        moment = datetime.fromtimestamp(instant, utc.utc).astimezone(ZoneInfo(timezone))
        offset = moment.utcoffset()
        east = offset.total_seconds() / 3600.0 if offset else 0.0
        # west of Greenwich, local time is behind UTC, so hours are added to the radio times
        if east and hours == -east:
            return f"radio times are local time ({timezone}) stored as if they were UTC", False
        if east and hours == east:
            stored = "telemetry times are local time stored as if they were UTC"
            return f"radio times are UTC read as {timezone}, or {stored}", True
        # the times of a log are too late by ``hours`` if its clock was in a zone that many hours east of the named zone
        fits = f"UTC{east - hours:+g} fits the radio times, UTC{east + hours:+g} the telemetry"
        wrong = f"the clocks differ by {hours:+g} h: {timezone} (UTC{east:+g}) is the wrong zone ({fits})"
        saving = ", or daylight saving was taken into account in one log only"
        return wrong + (saving if abs(hours) == 1.0 else ""), False
    return f"the clocks differ by {hours:+g} h: a time zone was taken into account in one log only", False


# Largest median distance between the positions of two receivers on one aircraft [m].
_AGREE_M = 12.0
# A log is not on the track if the median distance of a few of its points exceeds this at every shift [m].
_NEAR_M = 4.0 * _AGREE_M
# The best origin is unique if the tracks are farther apart by this factor at every origin more than a minute away.
_UNIQUE = 1.8
_POINTS = 240


@dataclass(frozen=True, slots=True)
class Origin:
    """The zero of relative times.

    Parameters
    ----------
    time : datetime64[ns]
        UTC time of the zero.
    distance_m : float
        Median distance of the two tracks with this zero.
    """

    time: np.datetime64
    distance_m: float


def origin_of(log: Stream, track: Stream) -> Origin | None:
    """Return the zero of relative times that puts the positions of a log on a track.

    Return None if there is no such time, or more than one.

    The log contains positions of the aircraft at relative times t, and the track contains positions at UTC. The search
    minimises the median of ``|p_log(t) - p_track(t + s)|`` over shifts s, in steps of a second, then of 0.1 s near the
    best shift.

    Parameters
    ----------
    log : Stream
        Log with positions, and relative times that were read as times since 1970.
    track : Stream
        Telemetry with absolute times.
    """
    mine, tracked = _points(log.frame, _POINTS), _points(track.frame, None)
    if mine is None or tracked is None or has_wall_clock(mine[0][0].astype("datetime64[ns]")):
        return None
    zero_s = float(tracked[0][0].astype(np.int64)) / 1e9
    time_s = mine[0].astype(np.int64) / 1e9
    track_s = tracked[0].astype(np.int64) / 1e9 - zero_s
    log_m, track_m = _metres(mine[1], tracked[1]), _metres(tracked[1], tracked[1])
    # compare horizontal positions, because the two logs may have different zeros of height
    line = shapely.linestrings(track_m[:, :2])
    shapely.prepare(line)
    # at least a quarter of the positions must be this close to the track at any time
    if 4 * shapely.dwithin(line, shapely.points(log_m[:, :2]), _AGREE_M).sum() < len(log_m):
        return None
    length = time_s[-1] - time_s[0]
    # half of the log may be outside the track at either end
    shifts = np.arange(-time_s[0] - 0.5 * length, track_s[-1] - time_s[0] - 0.5 * length, 1.0)
    # test a few points first, because most pairs of logs in a folder do not belong together
    few = _median_distances(shifts, time_s[::8], log_m[::8], track_s, track_m)
    if not (few < _NEAR_M).any():
        return None
    misses = _median_distances(shifts, time_s, log_m, track_s, track_m)
    if not np.isfinite(misses).any():
        return None
    best = int(np.nanargmin(misses))
    apart = np.abs(shifts - shifts[best]) > 60
    fine = shifts[best] + np.arange(-15, 16) / 10
    finer = _median_distances(fine, time_s, log_m, track_s, track_m)
    distance = float(np.nanmin(finer))
    second = float(np.nanmin(misses[apart])) if np.isfinite(misses[apart]).any() else np.inf
    # compare with the other origins at full seconds, because an aircraft moves some metres within a second
    if distance > _AGREE_M or second < _UNIQUE * max(float(misses[best]), 1.0):
        return None
    origin_s = zero_s + float(fine[int(np.nanargmin(finer))])
    return Origin(np.datetime64(round(origin_s * 1000), "ms").astype("datetime64[ns]"), distance)


def _points(frame: pd.DataFrame, most: int | None) -> tuple[AnyArray, FloatArray] | None:
    """Return times and (latitude, longitude, altitude) of rows with a position, thinned to at most ``most``."""
    names = ["latitude_deg", "longitude_deg", "altitude_m"]
    if not set(names) <= set(frame.columns):
        return None
    places = np.column_stack([frame[name].to_numpy(np.float64) for name in names])
    known = np.flatnonzero(np.isfinite(places[:, :2]).all(axis=1))
    time, first = np.unique(frame["time"].to_numpy("datetime64[ns]")[known], return_index=True)
    # a log with fewer positions may match a track by chance
    if len(time) < 20:
        return None
    # take positions from the complete flight, because take-offs are similar on all flights
    at = slice(None) if most is None or len(time) <= most else np.linspace(0, len(time) - 1, most).astype(int)
    return time[at], places[known[first]][at]


def _metres(points: FloatArray, about: FloatArray) -> FloatArray:
    """Return positions in metres relative to the first of ``about``, with heights as logged, or 0 if missing."""
    return np.column_stack([rough_m(points[:, 0], points[:, 1], about[0]), np.nan_to_num(points[:, 2])])


def _median_distances(
    shifts: FloatArray, time_s: FloatArray, log_m: FloatArray, track_s: FloatArray, track_m: FloatArray
) -> FloatArray:
    """Return the median distance for each shift. NaN if less than half of the log is within the track."""
    medians = np.full(len(shifts), np.nan)
    for rows in np.array_split(np.arange(len(shifts)), -(-len(shifts) // _SHIFTS_AT_ONCE) or 1):
        time = time_s + shifts[rows][:, None]
        inside = (time >= track_s[0]) & (time <= track_s[-1])
        enough = 2 * inside.sum(axis=1) >= len(time_s)
        time, inside = time[enough], inside[enough]
        apart = log_m - interpolated(time.ravel(), track_s, track_m).reshape(*time.shape, 3)
        apart[~inside] = np.nan
        apart[..., 2] -= np.nanmedian(apart[..., 2], axis=1)[:, None]  # the logs may have different zeros of height
        medians[rows[enough]] = np.nanmedian(np.linalg.norm(apart, axis=2), axis=1)
    return medians


_SHIFTS_AT_ONCE = 500
