"""Whether the radio clock and the telemetry clock agree, and by how much they do not.

One sign everywhere: ``radio_minus_telemetry_s`` is how much later the radio's clock shows than the telemetry's; radio
times are corrected by subtracting it.

A search (:mod:`aerpaw_cmp.flight.lag`) finds a best lag in any two curves, also where the model is wrong.
:func:`judge_clock` therefore says "ok" only after every check that a wrong model fails.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from ..common.units import AnyArray, BoolArray, FloatArray
from ..compare.result import APPLIED, ESTIMATED, NOT_APPLIED, ClockResult
from ..compare.statistics import PairedDifference, paired_difference, plain
from .lag import (
    DRIFT_FROM_S,
    DRIFT_LIMIT,
    FEWEST,
    LAG_LIMIT_S,
    LAG_WINDOW_S,
    LagFit,
    Sampled,
    best_of,
    combine_lags,
    fit_lag,
    no_lag,
    sample,
    symmetric,
)
from .track import NO_TIME, nanoseconds

EXPLAINED = 0.5
"""Share of the level's variance (means over one second) that a model must explain before its lag is believed."""

AGREE_S = 0.5
"""Halves of the flight, channels and free patterns may differ from the pooled lag by this [s]."""

_CHECK_WITH = 2000
"""Samples per channel for the check on blocks kept out."""

_FREE_WITH, _FREE_STEP_S = 1000, 0.25
"""Samples per channel, and spacing of lags [s], for the check with free patterns."""

Verdict = Literal["ok", "agree", "ambiguous", "failed"]


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockChannel:
    """One channel of a receiver, and what should be measured at instants of the telemetry clock.

    Parameters
    ----------
    name : str
        Of the channel.
    times : (n,)
        Instants by the radio's clock, datetime64 (UTC) or seconds.
    measured_db : (n,)
        Levels [dB]; NaN does not count.
    predictor : callable
        ``predictor(times) -> level_db`` (n,); NaN where there is no pose or no path.
    terms : callable, optional
        ``terms(times) -> (n, q)``, such as :func:`direction_terms`: what unknown antennas could add.
    resolution_s : float
        Spacing at which the predictor is sampled [s].
    """

    name: str
    times: AnyArray
    measured_db: FloatArray
    predictor: Callable[[AnyArray], ArrayLike]
    terms: Callable[[AnyArray], ArrayLike] | None = None
    resolution_s: float = 0.05


@dataclass(frozen=True, slots=True, kw_only=True)
class HeldOutBlocks:
    """Error of blocks of a flight, with a lag estimated on the other blocks, against no correction.

    Parameters
    ----------
    blocks, improved : int
        How many there are, and in how many the error is lower.
    paired : PairedDifference
        Corrected against uncorrected, over seconds.
    """

    blocks: int
    improved: int
    paired: PairedDifference

    @property
    def better(self) -> bool:
        """The error is lower in all, and in more blocks than chance would have it (sign test at 10 %)."""
        from math import comb

        chance = sum(comb(self.blocks, k) for k in range(self.improved, self.blocks + 1)) / 2.0**self.blocks
        return self.paired.difference_db < 0 and (self.paired.verdict == "better" or chance < 0.1)

    def as_dict(self) -> dict[str, Any]:
        """For metrics.json."""
        return {"blocks": self.blocks, "improved": self.improved, **self.paired.as_dict()}


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockEstimate:
    """The clock of one receiver on one flight: a pooled estimate, and what was checked before it is believed.

    Parameters
    ----------
    radio_minus_telemetry_s : float
        How much later the radio's clock shows [s], at ``reference_s``; NaN if failed. Corrected by subtracting.
    ci95_s : (low, high)
        Its 95 % interval; the whole window where the data say nothing.
    drift_s_per_s : float
        Its growth; 0 where it was not fitted.
    drift_ci95_s_per_s : (low, high)
        NaN where it was not fitted.
    reference_s, start_ns : float, int
        Instant of the estimate [s after ``start_ns``]; the receiver's first sample [ns since 1970].
    verdict : {"ok", "agree", "ambiguous", "failed"}
        "ok": a difference is shown, and correcting it lowers the error of blocks kept out of the estimate. "agree":
        every other check holds and the difference is none that matters. Only "ok" may be applied.
    reason : str
        Why not ok.
    model : str
        The prediction that was used.
    explained : float
        Share of the variance of means over one second that it explains at this lag.
    halves_s : tuple of float
        Estimates of the first and of the second half; empty where not checked.
    channels_s : mapping of str to float
        Estimates of the channels alone.
    free_patterns_s : float
        Estimate with the antennas' patterns free; NaN where not checked.
    held_out : HeldOutBlocks or None
        Error of blocks kept out, corrected against uncorrected; None where not checked.
    n, window_s : int, float
        Samples; lags searched on either side [s].
    """

    radio_minus_telemetry_s: float
    ci95_s: tuple[float, float]
    drift_s_per_s: float
    drift_ci95_s_per_s: tuple[float, float]
    reference_s: float
    start_ns: int
    verdict: Verdict
    reason: str
    model: str
    explained: float
    halves_s: tuple[float, ...]
    channels_s: Mapping[str, float]
    free_patterns_s: float
    held_out: HeldOutBlocks | None
    n: int
    window_s: float

    def correction_s(self, times: ArrayLike) -> FloatArray:
        """What is to be subtracted from radio times (n,) [s]."""
        since = (nanoseconds(times) - self.start_ns) * 1e-9
        return np.asarray(self.radio_minus_telemetry_s + self.drift_s_per_s * (since - self.reference_s))

    def result(self, receiver: str, *, apply: bool) -> ClockResult:
        """The estimate as a number of the flight; only a verdict "ok" is applied, where ``apply`` asks for it."""
        asked = NOT_APPLIED if apply and self.verdict != "agree" else ESTIMATED
        return ClockResult(
            receiver=receiver,
            radio_minus_telemetry_s=self.radio_minus_telemetry_s,
            ci95_s=self.ci95_s,
            drift_s_per_s=self.drift_s_per_s,
            verdict=self.verdict,
            reason=f"by the {self.model}" + (f": {self.reason}" if self.reason else ""),
            applied=APPLIED if apply and self.verdict == "ok" else asked,
            checks=self.as_dict(),
        )

    def as_dict(self) -> dict[str, Any]:
        """For metrics.json; NaN becomes None."""
        names = {name: getattr(self, name) for name in self.__slots__ if name not in ("start_ns", "held_out")}
        names["drift_ms_per_min"] = 60e3 * names.pop("drift_s_per_s")
        names["drift_ci95_ms_per_min"] = [60e3 * v for v in names.pop("drift_ci95_s_per_s")]
        names["held_out"] = None if self.held_out is None else self.held_out.as_dict()
        return dict(plain(names))


def judge_clock(
    channels: Sequence[ClockChannel],
    *,
    model: str = "",
    window_s: float = LAG_WINDOW_S,
    limit_s: float = LAG_LIMIT_S,
    drift: bool | None = None,
) -> ClockEstimate:
    """One estimate for the channels of a receiver, which share a clock, and whether it can be believed.

    Parameters
    ----------
    channels : sequence of ClockChannel
        Of one receiver and flight.
    model : str
        Name of the prediction, for reports.
    window_s, limit_s, drift
        As in :func:`estimate_lag`.

    Returns
    -------
    ClockEstimate
        Nothing is applied here.

    Raises
    ------
    ValueError
        Without a channel.

    Notes
    -----
    Checked in this order, the first failure gives the reason: the pooled likelihood has one optimum inside the search
    (lag and drift); the model explains :data:`EXPLAINED` of the variance; each channel alone, both halves of the
    flight, and a fit with free antenna patterns come within :data:`AGREE_S` or their own interval of the pooled lag; a
    correction estimated on the other blocks of the flight lowers the error of each block in turn
    (:func:`~aerpaw_cmp.compare.statistics.paired_difference`).
    """
    if not channels:
        raise ValueError("a clock needs at least one channel")
    start = min(
        (int(stamp.min()) for c in channels if len(stamp := _timed(c.times))),
        default=0,
    )
    lags = symmetric(window_s, 0.1)
    sampled_channels: dict[str, Sampled] = {}
    reasons = []
    for channel in channels:
        sampled = sample(
            channel.times, channel.measured_db, channel.predictor,
            window_s=window_s, resolution_s=channel.resolution_s, origin_ns=start,
        )  # fmt: skip
        if isinstance(sampled, str):
            reasons.append(sampled)
        else:
            sampled_channels[channel.name] = sampled
    if not sampled_channels:
        return _estimate(no_lag(reasons[0], 0, window_s, lags), start, model)
    span = max(s.t[-1] for s in sampled_channels.values()) - min(s.t[0] for s in sampled_channels.values())
    drifting = span >= DRIFT_FROM_S if drift is None else drift
    own = {
        name: fit_lag(s.t, s.measured_db, s.prediction, lags, limit_s, drifting) for name, s in sampled_channels.items()
    }
    pooled = combine_lags(list(own.values()), limit_s=limit_s)
    estimate = _estimate(pooled, start, model, {name: fit.radio_minus_telemetry_s for name, fit in own.items()})
    if pooled.verdict == "failed":
        return estimate
    estimate = replace(estimate, explained=_explained_share(list(sampled_channels.values()), estimate))
    if pooled.verdict == "ambiguous":
        return estimate
    return _checked(estimate, channels, sampled_channels, own, lags, limit_s)


def _timed(times: ArrayLike) -> AnyArray:
    stamp = nanoseconds(times)
    return np.asarray(stamp[stamp != NO_TIME])


def _estimate(fit: LagFit, start: int, model: str, channels: Mapping[str, float] | None = None) -> ClockEstimate:
    """A pooled fit before its checks; refining the best lag between two tried ones never leaves interval and window."""
    low, high = np.clip(fit.ci95_s, -fit.window_s, fit.window_s)
    return ClockEstimate(
        radio_minus_telemetry_s=float(np.clip(fit.radio_minus_telemetry_s, low, high)),
        ci95_s=fit.ci95_s,
        drift_s_per_s=fit.drift_s_per_s,
        drift_ci95_s_per_s=fit.drift_interval_s_per_s,
        reference_s=fit.reference,
        start_ns=start,
        verdict=fit.verdict,
        reason=fit.reason,
        model=model,
        explained=float("nan"),
        halves_s=(),
        channels_s=channels or {},
        free_patterns_s=float("nan"),
        held_out=None,
        n=fit.n,
        window_s=fit.window_s,
    )


def _checked(
    estimate: ClockEstimate,
    channels: Sequence[ClockChannel],
    sampled_channels: Mapping[str, Sampled],
    own: Mapping[str, LagFit],
    lags: FloatArray,
    limit_s: float,
) -> ClockEstimate:
    """The estimate after every check; the first that fails gives the verdict."""

    def doubt(reason: str, **more: Any) -> ClockEstimate:
        return replace(estimate, verdict="ambiguous", reason=reason, **more)

    if estimate.explained < EXPLAINED:
        return doubt(
            f"the model explains {100 * max(estimate.explained, 0.0):.0f} % of the level's variance; "
            f"{100 * EXPLAINED:.0f} % are wanted before its lag is believed"
        )
    if abs(estimate.drift_s_per_s) > 0.95 * DRIFT_LIMIT:
        return doubt("the best drift lies at the edge of the search")
    lag = estimate.radio_minus_telemetry_s
    for name, fit in own.items():
        if not _near(fit, lag):
            return doubt(f"channel {name} alone gives {fit.radio_minus_telemetry_s:+.1f} s")
    halves = _halves(list(sampled_channels.values()), estimate, lags, limit_s)
    estimate = replace(estimate, halves_s=tuple(half.radio_minus_telemetry_s for half in halves))
    for name, half in zip(("first", "second"), halves, strict=True):
        if not _near(half, lag):
            return doubt(f"the {name} half of the flight alone gives {half.radio_minus_telemetry_s:+.1f} s")
    free = _with_free_patterns(channels, sampled_channels, estimate, limit_s)
    if free is not None:
        estimate = replace(estimate, free_patterns_s=free.radio_minus_telemetry_s)
        if not _near(free, lag):
            return doubt(f"with the antennas' patterns free it is {free.radio_minus_telemetry_s:+.1f} s")
    held_out = _held_out(list(sampled_channels.values()), estimate, lags)
    estimate = replace(estimate, held_out=held_out)
    low, high = estimate.ci95_s
    none = low <= 0.0 <= high or abs(lag) <= _NOT_RESOLVED_S
    if held_out.better and not none:
        return estimate
    if none or abs(lag) <= _NO_MATTER_S:
        return replace(estimate, verdict="agree", reason="no difference that matters: nothing to correct")
    return doubt(
        f"correcting it lowers the error of {held_out.improved} of {held_out.blocks} blocks kept out, by "
        f"{-held_out.paired.difference_db:.2f} dB in all"
    )


_NOT_RESOLVED_S = 0.05
"""A difference that no telemetry of one row a second resolves [s]."""

_NO_MATTER_S = 0.2
"""A smaller difference moves a UAV at 10 m/s by less than the error of its position [s]."""


def _near(fit: LagFit, lag: float) -> bool:
    """Whether a fit to part of the evidence comes near the pooled lag, or cannot tell it from its own optimum."""
    if not np.isfinite(fit.radio_minus_telemetry_s):
        return False
    at = int(np.argmin(np.abs(fit.curve_lag_s - lag)))
    possible = bool(fit.evidence[max(at - 1, 0) : at + 2].min() <= 3.84)
    return abs(fit.radio_minus_telemetry_s - lag) <= AGREE_S or (possible and fit.verdict != "ok")


def _halves(
    sampled_channels: Sequence[Sampled], estimate: ClockEstimate, lags: FloatArray, limit_s: float
) -> tuple[LagFit, LagFit]:
    """Pooled fits to the first and the second half, without a drift of their own."""
    middle = 0.5 * (min(s.t[0] for s in sampled_channels) + max(s.t[-1] for s in sampled_channels))

    def fit(side: Callable[[FloatArray], BoolArray]) -> LagFit:
        fits = []
        for s in sampled_channels:
            part = side(s.t)
            if part.sum() >= FEWEST:
                t = s.t[part]
                moved = t - estimate.drift_s_per_s * (t - estimate.reference_s)
                fits.append(fit_lag(moved, s.measured_db[part], s.prediction, lags, limit_s, False))
        nothing = no_lag("too few samples", 0, float(lags[-1]), lags)
        return combine_lags(fits, limit_s=limit_s) if fits else nothing

    return fit(lambda t: np.asarray(t <= middle)), fit(lambda t: np.asarray(t > middle))


def _with_free_patterns(
    channels: Sequence[ClockChannel], sampled_channels: Mapping[str, Sampled], estimate: ClockEstimate, limit_s: float
) -> LagFit | None:
    """Pooled fit with free terms of direction beside the prediction; None where no terms were given."""
    lags = symmetric(estimate.window_s, _FREE_STEP_S)
    fits = []
    for channel in channels:
        if channel.terms is None or channel.name not in sampled_channels:
            continue
        s = sampled_channels[channel.name]
        free = s.prediction.beside(channel.terms(_instants(channel.times, estimate.start_ns, s.prediction.times())))
        few = slice(None, None, -(-len(s.t) // _FREE_WITH))
        moved = s.t[few] - estimate.drift_s_per_s * (s.t[few] - estimate.reference_s)
        fits.append(fit_lag(moved, s.measured_db[few], free, lags, limit_s, False))
    return combine_lags(fits, limit_s=limit_s) if fits else None


def _instants(like: AnyArray, start_ns: int, seconds: FloatArray) -> AnyArray:
    """Seconds after the start as instants of the kind of ``like``: datetime64, or seconds since 1970."""
    stamp = np.round(seconds * 1e9).astype(np.int64) + start_ns
    return np.asarray(stamp.astype("datetime64[ns]") if np.asarray(like).dtype.kind not in "fiu" else stamp * 1e-9)


def _explained_share(sampled_channels: Sequence[Sampled], estimate: ClockEstimate) -> float:
    """Share of the variance of one-second means that the prediction explains at the estimate."""
    left = total = 0.0
    for s in sampled_channels:
        lag = estimate.radio_minus_telemetry_s + estimate.drift_s_per_s * (s.t - estimate.reference_s)
        predicted = s.prediction.at(s.t - lag)
        ok = np.isfinite(predicted)
        measured, residual = s.measured_db[ok], s.measured_db[ok] - predicted[ok]
        _, place = np.unique(np.floor(s.t[ok]), return_inverse=True)
        count = np.bincount(place)
        left += len(residual) * float(np.var(np.bincount(place, residual) / count))
        total += len(residual) * float(np.var(np.bincount(place, measured) / count))
    return 1.0 - left / total if total > 0 else float("nan")


def _held_out(sampled_channels: Sequence[Sampled], estimate: ClockEstimate, lags: FloatArray) -> HeldOutBlocks:
    """Error of blocks of the flight, with a lag and offsets estimated on the other blocks, against no lag.

    Errors are root mean squares over one second and all channels: channels of one receiver hear the same fades.
    """
    first, last = min(s.t[0] for s in sampled_channels), max(s.t[-1] for s in sampled_channels)
    blocks = int(np.clip((last - first) / _BLOCK_S, 4, 10))
    tables = [_block_table(s, estimate, lags, np.linspace(first, last, blocks + 1)[1:-1]) for s in sampled_channels]
    squares: dict[str, list[FloatArray]] = {"corrected": [], "uncorrected": []}
    improved = 0
    for block in range(blocks):
        others = [table.without(block) for table in tables]
        scale = [squared[len(lags) // 2] / n[len(lags) // 2] for n, _, squared in others]
        cost = np.sum([squared / n / unit for (n, _, squared), unit in zip(others, scale, strict=True)], axis=0)
        best, gain = best_of(cost, lags), 0.0
        for table, (_, mean, _) in zip(tables, others, strict=True):
            inside = table.block == block
            squares["corrected"].append((table.residual[best, inside] - mean[best]) ** 2)
            squares["uncorrected"].append((table.unshifted[inside] - table.unshifted[~inside].mean()) ** 2)
            gain += float(np.sum(squares["uncorrected"][-1] - squares["corrected"][-1]))
        improved += gain > 0
    second = np.concatenate([t.t[t.block == block] for block in range(blocks) for t in tables])
    with_clock, without_clock = (np.concatenate(squares[name]) for name in ("corrected", "uncorrected"))
    ok = np.isfinite(with_clock) & np.isfinite(without_clock)
    _, place = np.unique(np.floor(second[ok]), return_inverse=True)
    count = np.bincount(place)
    corrected, uncorrected = (np.sqrt(np.bincount(place, side[ok]) / count) for side in (with_clock, without_clock))
    paired = paired_difference(corrected, uncorrected, free_offset=False)
    return HeldOutBlocks(blocks=blocks, improved=improved, paired=paired)


_BLOCK_S = 60.0
"""Length of the blocks kept out [s], at least 4 and at most 10 of them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _BlockTable:
    """Residuals of one channel: (lags, n) at every lag and the drift found, (n,) without either; block per sample."""

    t: FloatArray
    block: AnyArray
    residual: FloatArray
    unshifted: FloatArray

    def without(self, block: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Samples, mean and sum of squares about it per lag (lags,), of all other blocks."""
        kept = self.residual[:, self.block != block]
        n, mean = np.isfinite(kept).sum(axis=1), np.nanmean(kept, axis=1)
        return n, mean, np.nansum((kept - mean[:, None]) ** 2, axis=1)


def _block_table(s: Sampled, estimate: ClockEstimate, lags: FloatArray, cuts: FloatArray) -> _BlockTable:
    step = -(-len(s.t) // _CHECK_WITH)
    t, m = s.t[::step], s.measured_db[::step]
    drifted = t - estimate.drift_s_per_s * (t - estimate.reference_s)
    residual = np.stack([m - s.prediction.at(drifted - lag) for lag in lags])
    unshifted = m - s.prediction.at(t)
    ok = np.isfinite(residual).all(axis=0) & np.isfinite(unshifted)
    return _BlockTable(
        t=t[ok], block=np.searchsorted(cuts, t[ok], side="right"), residual=residual[:, ok], unshifted=unshifted[ok]
    )


# --- whole hours ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class ClockTrap:
    """Two logs of one flight that only overlap after a shift of whole (or half) hours.

    Parameters
    ----------
    hours : float
        To be added to radio times.
    overlap_s, shifted_overlap_s : float
        Overlap with the telemetry before and after the shift [s].
    explanation : str
        What this looks like.
    """

    hours: float
    overlap_s: float
    shifted_overlap_s: float
    explanation: str


def clock_trap(
    radio_span: tuple[Any, Any], telemetry_span: tuple[Any, Any], timezone: str | None = None
) -> ClockTrap | None:
    """Recognise a clock that is off by whole hours, such as local time stored as if it were UTC.

    Parameters
    ----------
    radio_span, telemetry_span : (first, last)
        datetime64 (UTC) or epoch seconds.
    timezone : str, optional
        IANA zone of the site: a shift that equals its offset from UTC on that day is named so.

    Returns
    -------
    ClockTrap or None
        None if the logs overlap as they are, or if no shift of up to 14 h (in half hours) brings them together.

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

    shifts = np.asarray(np.arange(-28, 29) * 0.5, dtype=np.float64)
    shared = overlap(shifts)
    now = float(overlap(np.zeros(1))[0])
    # whole hours before half hours, near ones before far ones
    order = [(-round(float(shared[i])), shifts[i] % 1 != 0, abs(float(shifts[i])), i) for i in range(len(shifts))]
    best = min(order)[-1]
    shorter = min(radio[1] - radio[0], telemetry[1] - telemetry[0])
    if now >= 0.5 * shorter or shared[best] < max(0.5 * shorter, 1e-9):
        return None
    hours = float(shifts[best])
    return ClockTrap(hours, now, float(shared[best]), _explain_hours(hours, float(telemetry[0]), timezone))


def _explain_hours(hours: float, instant: float, timezone: str | None) -> str:
    if timezone is not None:
        from datetime import datetime
        from datetime import timezone as utc
        from zoneinfo import ZoneInfo

        moment = datetime.fromtimestamp(instant, utc.utc).astimezone(ZoneInfo(timezone))
        offset = moment.utcoffset()
        east = offset.total_seconds() / 3600.0 if offset else 0.0
        if east and hours == -east:
            return f"radio times are local time ({timezone}) stored as if they were UTC"
        if east and hours == east:
            return f"telemetry times are local time ({timezone}) stored as if they were UTC"
        if abs(hours) == 1.0:
            return "one hour: daylight saving taken into account in one log only"
    return f"the clocks differ by {hours:+g} h: a time zone was taken into account in one log only"
