"""The verdicts on a flight, a campaign, a calibration, a prediction and a map.

A verdict consists of an effect with a 95 % interval, and a cause. The verdict determines the first sentences of a page.
Causes of the error of a flight are in :mod:`.causes`. A cause is named only if its interval excludes "no effect". If
several causes are tested, a false one is named in at most :data:`_FALSE_ALARMS` of the cases.

The module also compares ray tracing with the best baseline over all channels of a flight. It computes offsets from the
other flights of a campaign, and finds the nights on which the offset of a node changes suddenly.

Two reports of one flight are compared sample by sample, because they have the same measurement and mostly the same
model. Differences are second minus first report, so a negative difference of an error means that the second is better.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from ..common.grouping import lists_by_key
from ..common.units import BoolArray, FloatArray, unmasked
from . import statistics
from .level import DetectionScore, floored_fit
from .offset import SPAN_DB, nearest_offset, offset_grid
from .rank import MAX_RANK, agreement, cohen_kappa, kappa_influence
from .result import FlightVerdict, RssResult


def with_corrected_verdicts(panels: Sequence[RssResult]) -> list[RssResult]:
    """Correct the verdicts of the channels against each baseline for the number of channels."""
    rows = [dict(panel.further.compared_with) for panel in panels]
    for name in dict.fromkeys(name for row in rows for name in row):
        members = [i for i, row in enumerate(rows) if name in row]
        # count copies of a log on several channels once
        measured = [panels[i].measured_db.tobytes() for i in members]
        for i, pair in zip(members, statistics.corrected([rows[i][name] for i in members], measured), strict=True):
            rows[i][name] = pair
    return [
        replace(panel, further=replace(panel.further, compared_with=row))
        for panel, row in zip(panels, rows, strict=True)
    ]


def scored(panels: Iterable[RssResult]) -> list[RssResult]:
    """Return the channels without copies that have enough samples and an offset inside the search range.

    If any of these channels has a signal, channels without a signal are omitted.
    """
    some = [p for p in without_copies(panels) if not p.score.at_edge]
    enough = [p for p in some if p.score.n >= statistics.FEWEST and math.isfinite(p.score.rmse_db)]
    return [panel for panel in enough if not is_dead(panel)] or enough


def without_copies(panels: Iterable[RssResult]) -> list[RssResult]:
    """Return the channels without copies: only the first of several channels with the same levels."""
    return list({panel.measured_db.tobytes(): panel for panel in reversed(list(panels))}.values())[::-1]


# Because of fading, the level of a received signal varies by more than this [dB], even at one position.
_DEAD_DB = 1.0


def is_dead(panel: RssResult) -> bool:
    """Check whether a channel has no signal: 80 % of its levels are within 1 dB, although the predictions vary."""
    known = panel.posed & np.isfinite(panel.measured_db) & np.isfinite(panel.simulated_dbm)
    if not known.any():
        return False
    measured_db = panel.measured_db[known]
    return statistics.middle_span(measured_db) < _DEAD_DB and statistics.is_flat(
        measured_db, [panel.simulated_dbm[known]]
    )


def is_one_place(panels: Iterable[RssResult]) -> bool:
    """Check whether no model predicts a change of 1 dB, as in a hover. All models then fit like a constant."""
    every = [[panel.simulated_dbm, *(b.level_dbm for b in panel.baselines.values())] for panel in scored(panels)]
    levels = [level[np.isfinite(level)] for models in every for level in models if np.isfinite(level).any()]
    return bool(levels) and max(map(statistics.middle_span, levels)) < _DEAD_DB


def baseline_errors(panels: Sequence[RssResult]) -> dict[str, float]:
    """Return the pooled RMSE [dB] of each baseline that was computed for all of these channels."""
    errors = {}
    for name in panels[0].baselines if panels else ():
        known = [panel.baselines[name].rmse_db for panel in panels if name in panel.baselines]
        if len(known) == len(panels) and all(map(math.isfinite, known)):
            errors[name] = pooled_db(known, [panel.score.n for panel in panels])
    return errors


def pooled_db(rmse_db: Sequence[float], n: Sequence[int]) -> float:
    """Return the RMSE over all samples of several channels, each after subtraction of its own offset [dB]."""
    weight = np.asarray(n, dtype=np.float64)
    return float(np.sqrt((weight * np.asarray(rmse_db) ** 2).sum() / weight.sum()))


def lock_lost(panel: RssResult) -> DetectionScore | None:
    """Return the detection score of a receiver that lost its lock according to the log, or None for other receivers."""
    score = panel.further.detection
    return score if score is not None and score.locks else None


def flight_verdict(panels: Sequence[RssResult]) -> FlightVerdict | None:
    """Compare ray tracing with the baseline that has the smallest error, over all scored channels at once.

    For a receiver that lost its lock, all samples are used, and levels below its floor are raised to the floor.
    """
    panels = scored(panels)
    residuals = [_residuals(panel) for panel in panels]
    errors = {name: _rms([of[name] for of in residuals]) for name in set.intersection(*map(set, residuals or [{}]))}
    best = min((name for name in errors if name != _RAY), key=lambda name: errors[name], default="")
    if not best:
        return None
    channels = [(panel.time, of[_RAY], of[best]) for panel, of in zip(panels, residuals, strict=True)]
    places = [panel.position_m for panel in panels]
    pair = statistics.pooled_difference(channels, free_offset=not any(map(lock_lost, panels)), place_m=places)
    return FlightVerdict(
        against=best, rmse_db=errors[_RAY], baseline_rmse_db=errors[best], difference_db=pair.difference_db,
        ci95_db=pair.difference_ci95_db, channels=len(panels),
    )  # fmt: skip


_RAY = "ray tracing"


def _residuals(panel: RssResult) -> dict[str, FloatArray]:
    """Return the residuals (n,) of ray tracing and each baseline after its own offset, NaN without a path [dB]."""
    models = {_RAY: (panel.simulated_dbm, panel.score.offset_db)}
    models |= {name: (model.level_dbm, model.offset_db) for name, model in panel.baselines.items()}
    known, score = panel.posed & np.isfinite(panel.simulated_dbm), lock_lost(panel)
    if score is None:
        every = {name: panel.measured_db + offset - level for name, (level, offset) in models.items()}
    else:
        floor = score.floor_db
        measured = np.where(known, np.fmax(panel.measured_db, floor), np.nan)
        every = {
            name: measured - np.maximum(level - floored_fit(measured, level, floor).offset_db, floor)
            for name, (level, _) in models.items()
        }
    return {name: np.where(known, of, np.nan) for name, of in every.items() if np.isfinite(of).any()}


def _rms(values: Sequence[FloatArray]) -> float:
    return float(np.sqrt(np.nanmean(np.concatenate(values) ** 2)))


# Smallest number of flights for which a mean over flights has an interval.
FEWEST_FLIGHTS = 3

# Smallest number of flights for which the correlation of consecutive flights is estimated.
_MANY_FLIGHTS = 20

RankingVerdict = Literal["first", "worse", "not significant", "no interval"]


def left_out_offsets(n: ArrayLike, mean_db: ArrayLike, *, span_db: tuple[float, float] = SPAN_DB) -> FloatArray:
    """Compute the offset [dB] of each flight from the samples of all other flights.

    Parameters
    ----------
    n : (f,)
        Number of samples of each flight.
    mean_db : (f,)
        Mean of simulated minus measured [dB], NaN if n = 0.
    span_db : (low, high)
        Search range of the offsets.

    Returns
    -------
    (f,)
        NaN if no other flight has samples.

    Notes
    -----
    The offset with the lowest RMSE on the other flights is ``sum_{j != i} n_j m_j / sum_{j != i} n_j``, rounded to the
    grid (arXiv 2502.10324, section V).

    Examples
    --------
    >>> left_out_offsets([3, 1, 0], [2.0, 6.0, np.nan]).tolist()
    [6.0, 2.0, 3.0]
    """
    count, mean = unmasked(n), unmasked(mean_db)
    total = np.where(count > 0, count * np.nan_to_num(mean), 0.0)
    other_samples = count.sum() - count
    grid = offset_grid(span_db=span_db)
    result = np.full(len(count), np.nan)
    for i in np.flatnonzero(other_samples > 0):
        # sum over the other flights, because a difference of two large sums would be inaccurate for a short flight
        mean_of_others = np.delete(total, i).sum() / other_samples[i]
        result[i] = grid[nearest_offset(grid, float(mean_of_others))]
    return result


def error_at_offset(
    offset_db: ArrayLike, rmse_db: ArrayLike, own_offset_db: ArrayLike, mean_db: ArrayLike
) -> FloatArray:
    """Compute the RMSE [dB] at an offset other than the fitted offset.

    Parameters
    ----------
    offset_db : array_like
        The other offset.
    rmse_db, own_offset_db : array_like
        RMSE and offset of the fit.
    mean_db : array_like
        Mean of simulated minus measured.

    Returns
    -------
    ndarray
        RMSE [dB], in the broadcast shape.

    Notes
    -----
    RMSE^2(o) = variance + (o - mean)^2. The variance follows from the known RMSE at the known offset.

    Examples
    --------
    >>> float(error_at_offset(3.0, 1.0, 0.0, 0.0).round(6))
    3.162278
    """
    mean = unmasked(mean_db)
    variance = np.maximum(unmasked(rmse_db) ** 2 - (unmasked(own_offset_db) - mean) ** 2, 0.0)
    return np.asarray(np.sqrt(variance + (unmasked(offset_db) - mean) ** 2))


@dataclass(frozen=True, slots=True, kw_only=True)
class MeanOfFlights:
    """A mean over ``n`` flights with a 95 % interval, NaN if there are too few flights."""

    n: int
    mean: float
    low: float
    high: float


def mean_of_flights(values: ArrayLike) -> MeanOfFlights:
    """Return mean and 95 % interval over flights, one value per flight in the order of the dates, NaN ignored.

    Notes
    -----
    The interval uses Student's t for n flights. From :data:`_MANY_FLIGHTS` flights on, n is replaced by the number of
    independent flights n (1 - r) / (1 + r), because consecutive flights can correlate. Here r is the correlation of
    consecutive flights, corrected for its bias of -(1 + 3 r) / n (Kendall 1954, doi:10.2307/2332720); a negative r
    counts as 0.
    """
    from scipy.special import stdtrit  # importing scipy.stats would take 0.2 s for one quantile

    array = unmasked(values)
    array = array[np.isfinite(array)]
    n = len(array)
    if not n:
        return MeanOfFlights(n=0, mean=np.nan, low=np.nan, high=np.nan)
    mean = float(array.mean())
    if n < FEWEST_FLIGHTS:
        return MeanOfFlights(n=n, mean=mean, low=np.nan, high=np.nan)
    independent, change = float(n), array - mean
    if n >= _MANY_FLIGHTS and change.any():
        r = float(change[1:] @ change[:-1] / (change @ change))
        r = float(np.clip(r + (1.0 + 3.0 * r) / n, 0.0, 1.0))
        # at least the number that an interval requires, because Student's t needs degrees of freedom
        independent = max(n * (1.0 - r) / (1.0 + r), FEWEST_FLIGHTS)
    reach = float(stdtrit(independent - 1.0, 0.975)) * float(array.std(ddof=1)) / independent**0.5
    return MeanOfFlights(n=n, mean=mean, low=mean - reach, high=mean + reach)


def verdict_of(difference: MeanOfFlights) -> RankingVerdict:
    """Return the verdict on whether a setting is significantly worse than the first setting."""
    if not np.isfinite(difference.low):
        return "no interval"
    return "worse" if difference.low > 0 else "not significant"


# Nominal share of campaigns without a fault for which a cause is named.
_FALSE_ALARMS = 0.02

# Smallest number of flights of a campaign in which one flight can be reported as different.
_FEWEST_TO_COMPARE = 5

# Smaller differences of an offset [dB] are not reported, even if they are significant.
LEAST_DB = 2.0

NONE = "none"


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """A verdict, as the first sentences of a page state it.

    Parameters
    ----------
    cause : str
        Key of the sentence and of the next step, ``none`` if no cause is significant.
    effect : float
        Effect in the unit of the cause (dB, a ratio, a share), NaN if there is no effect.
    interval : (low, high)
        95 % interval of the effect, NaN if there is no interval.
    where : str
        Flight, link, baseline or time that the sentence names.
    """

    cause: str = NONE
    effect: float = math.nan
    interval: statistics.Interval = statistics.NO_INTERVAL
    where: str = ""


# --- campaign -------------------------------------------------------------------------------------------------------


# A candidate for an irregularity of a campaign: its p-value, and its verdict.
_Shift = tuple[float, Verdict]


def campaign_verdict(
    errors_db: Mapping[str, float], offsets_db: Mapping[str, Mapping[str, float]], order: Sequence[str]
) -> Verdict:
    """Find the most significant irregularity of a campaign: a flight's error or offset, or a step in a link's offset.

    Parameters
    ----------
    errors_db : mapping of str to float
        Mean error of each flight [dB].
    offsets_db : mapping of str to mapping of str to float
        Mean of simulated minus measured of each flight, by link [dB].
    order : sequence of str
        Flights by date.

    Returns
    -------
    Verdict
        ``outlying error`` (effect: ratio to the other flights), ``outlying offset`` (dB), ``gain step`` (dB, with
        link and first flight after it) or ``none``.

    Notes
    -----
    Each candidate splits the flights in two, and is tested by a two-sample t test with pooled variance. If one side has
    a single flight, this is the test of the externally Studentised residual. The smallest p-value is multiplied by the
    number of candidates (Bonferroni).
    """
    shifts = [shift for shift in _shifts(errors_db, offsets_db, order) if math.isfinite(shift[0])]
    chance, best = min(shifts, key=lambda shift: shift[0], default=(1.0, Verdict()))
    small = best.cause != "outlying error" and abs(best.effect) < LEAST_DB
    return Verdict() if small or chance * len(shifts) >= _FALSE_ALARMS else best


def _shifts(
    errors_db: Mapping[str, float], offsets_db: Mapping[str, Mapping[str, float]], order: Sequence[str]
) -> Iterator[_Shift]:
    names = [name for name in order if errors_db.get(name, math.nan) > 0.0]
    for i, chance, effect, ends in _each_alone(np.log([errors_db[name] for name in names])):
        low, high = np.exp(ends)
        ratio = Verdict(cause="outlying error", effect=math.exp(effect), interval=(low, high), where=names[i])
        # ignore flights with a smaller error than all other flights
        yield (chance if effect > 0.0 else math.nan), ratio
    about: dict[str, list[float]] = {}
    for link, of in offsets_db.items():
        flown_here = [name for name in order if math.isfinite(of.get(name, math.nan))]
        values = np.array([of[name] for name in flown_here])
        for name, value in zip(flown_here, values - values.mean() if len(flown_here) else values, strict=True):
            about.setdefault(name, []).append(float(value))
        # require two flights on either side, because a single flight is an outlier and not a step
        for k in range(2, len(flown_here) - 1):
            chance, effect, ends = _split(values, np.arange(len(flown_here)) >= k)
            where = f"{link} from {flown_here[k]}"
            yield chance, Verdict(cause="gain step", effect=effect, interval=ends, where=where)
    flown = [name for name in order if name in about]
    for i, chance, effect, ends in _each_alone(np.array([np.mean(about[name]) for name in flown])):
        yield chance, Verdict(cause="outlying offset", effect=effect, interval=ends, where=flown[i])


def _each_alone(values: FloatArray) -> Iterator[tuple[int, float, float, statistics.Interval]]:
    """Compare each value with all other values."""
    for i in range(len(values)):
        yield i, *_split(values, np.arange(len(values)) == i)


def _split(values: FloatArray, inside: BoolArray) -> tuple[float, float, statistics.Interval]:
    """Return p-value, difference of means (inside minus outside) and its 95 % interval, with pooled variance."""
    from scipy.special import stdtr, stdtrit  # importing scipy.stats would take 0.2 s for two functions

    freedom, n = len(values) - 2, int(inside.sum())
    if len(values) < _FEWEST_TO_COMPARE or not 0 < n < len(values):
        return math.nan, math.nan, statistics.NO_INTERVAL
    within, without = values[inside], values[~inside]
    effect = float(within.mean() - without.mean())
    square = float(((within - within.mean()) ** 2).sum() + ((without - without.mean()) ** 2).sum()) / freedom
    # a lower limit, because flights can be exactly equal, for example copies
    error = math.sqrt(max(square, 1e-12) * (1.0 / n + 1.0 / (len(values) - n)))
    reach = float(stdtrit(freedom, 0.975)) * error
    return 2.0 * float(stdtr(freedom, -abs(effect) / error)), effect, (effect - reach, effect + reach)


# --- calibration ----------------------------------------------------------------------------------------------------


def by_flight(
    errors_db: Iterable[tuple[str, float]], other_db: Iterable[tuple[str, float]], where: str = ""
) -> Verdict:
    """Compare two models on the same flights, one value per flight.

    Parameters
    ----------
    errors_db, other_db : iterable of (flight, error)
        Errors [dB]. Several errors of a flight (channels) count as their mean.
    where : str
        Name of the other model.

    Returns
    -------
    Verdict
        ``better``, ``worse``, ``not significant`` or ``no interval`` for the first model. Effect: mean over flights of
        the first minus the second [dB], with an interval if there are at least :data:`FEWEST_FLIGHTS` flights.
    """
    first, second = _means(errors_db), _means(other_db)
    mean = mean_of_flights([first[name] - second[name] for name in first if name in second])
    return Verdict(
        cause=statistics.paired_verdict(mean.low, mean.high),
        effect=mean.mean,
        interval=(mean.low, mean.high),
        where=where,
    )


def _means(errors_db: Iterable[tuple[str, float]]) -> dict[str, float]:
    each = lists_by_key((flight, error) for flight, error in errors_db if math.isfinite(error))
    return {flight: float(np.mean(values)) for flight, values in each.items()}


def antenna_or_place(against: Sequence[Verdict]) -> Verdict:
    """Check whether the learned gain rotates with the aircraft, by comparing the body frame with wrong frames.

    Parameters
    ----------
    against : sequence of Verdict
        Verdict of the body frame against each wrong frame, from :func:`by_flight`.

    Returns
    -------
    Verdict
        ``antenna`` if each wrong frame is significantly worse, ``place`` if one is significantly better, ``no
        interval`` for too few flights, else ``not separable``. Effect and interval belong to the wrong frame with
        the most similar error.
    """
    known = [item for item in against if math.isfinite(item.effect)]
    if not known:
        return Verdict()
    causes = {item.cause for item in known}
    nearest = max(
        (item for item in known if item.cause == "worse" or "worse" not in causes), key=lambda verdict: verdict.effect
    )
    if "worse" in causes:
        cause = "place"
    else:
        cause = {"better": "antenna", "no interval": "no interval"}.get("".join(causes), "not separable")
    return Verdict(cause=cause, effect=nearest.effect, interval=nearest.interval, where=nearest.where)


# --- prediction -----------------------------------------------------------------------------------------------------

# Ratio of the 99 % to the 95 % interval of a normal distribution. Bias and standard deviation are two tests, so the
# wider interval is used for the bias.
_TWO_TRIED = 1.3

# Errors agree with their stated standard deviation if the ratio of actual errors to this standard deviation is between
# 1 / this number and this number.
_LEAST_RATIO = 1.15


def stated_errors(
    error_db: FloatArray,
    sd_db: FloatArray,
    common_db: FloatArray | float = 0.0,
    place_m: FloatArray | None = None,
) -> Verdict:
    """Check whether errors agree with the standard deviations that were stated for them.

    Parameters
    ----------
    error_db, sd_db : (n,)
        Measured minus predicted level, and its stated standard deviation, in time order [dB].
    common_db : float or (n,)
        Part of that standard deviation that is common to a flight (an offset) [dB].
    place_m : (n, 3), optional
        The same as in :func:`~aerpaw_cmp.compare.statistics.mean_draws`.

    Returns
    -------
    Verdict
        ``narrow`` or ``wide`` (effect: ratio of actual to stated errors), ``biased`` (effect: mean error [dB]), else
        ``none`` with the ratio and its interval. ``no interval`` for fewer than 20 samples.
    """
    good = np.isfinite(error_db) & np.isfinite(sd_db) & (sd_db > 0.0)
    error, sd, place = error_db[good], sd_db[good], None if place_m is None else place_m[good]
    if len(error) < statistics.FEWEST:
        return Verdict(cause="no interval")
    share = float(np.mean(np.square(np.broadcast_to(common_db, good.shape)[good])))
    mean, ends = float(error.mean()), statistics.mean_interval(error, place)
    reach = math.hypot(0.5 * (ends[1] - ends[0]), 1.96 * math.sqrt(share))
    bias = Verdict(cause="biased", effect=mean, interval=(mean - reach, mean + reach))
    ratio = error / sd
    low, high = statistics.spread_interval(ratio, place)
    # An error that is common to the whole flight does not contribute to the standard deviation within the flight. Such
    # an error can hide that an interval is too narrow. It must not make an interval look too wide, so its variance is
    # added to the upper end below.
    allowed = share / float(np.mean(sd**2))
    effect, within = float(np.sqrt(np.mean(ratio**2))), float(ratio.std())
    spread = Verdict(effect=effect, interval=(low, max(effect, math.sqrt(high**2 + allowed))))
    if abs(mean) > _TWO_TRIED * reach and mean**2 > (within**2 - 1.0) * float(np.mean(sd**2)):
        return bias
    if low > 1.0 and within > _LEAST_RATIO:
        return Verdict(cause="narrow", effect=within, interval=(low, high))
    if spread.interval[1] < 1.0 and spread.effect < 1.0 / _LEAST_RATIO:
        return Verdict(cause="wide", effect=spread.effect, interval=spread.interval)
    return spread


# --- map ------------------------------------------------------------------------------------------------------------

# If the share of positions in coverage is smaller than this, a sentence explains the gaps of the map.
_COVERED = 0.95


@dataclass(frozen=True, slots=True, kw_only=True)
class Coverage:
    """The coverage of a map at one height, as shares of its positions.

    ``covered`` is the share with the trees of the site, ``clear`` the share without trees (NaN if not computed).
    ``reached`` is the share with a path of any level, and ``outside`` the share farther from every flight than a
    correction reaches.
    """

    height_m: float
    covered: float
    clear: float = math.nan
    reached: float = math.nan
    outside: float = 0.0


def coverage_verdict(heights: Sequence[Coverage]) -> Verdict:
    """Return the covered share at the worst height, and the cause of the gaps.

    Parameters
    ----------
    heights : sequence of Coverage

    Returns
    -------
    Verdict
        Effect: the smallest covered share of all heights. Causes: ``extrapolated`` (most positions are outside the
        flights), ``no path`` (no coverage), ``trees``, ``weak`` (paths below the threshold) or ``blocked`` (the cause
        of most gaps), ``none`` (at least :data:`_COVERED`). A computed share has no interval.
    """
    if not heights:
        return Verdict()
    worst = min(heights, key=lambda height: height.covered)
    gaps, by_trees = 1.0 - worst.covered, max(float(np.nan_to_num(worst.clear - worst.covered)), 0.0)
    if worst.outside > 0.5:
        cause = "extrapolated"
    elif worst.covered == 0.0 and not worst.reached > 0.0:
        cause = "no path"
    elif worst.covered >= _COVERED:
        cause = NONE
    else:
        weak = worst.reached - worst.covered > gaps / 2.0
        cause = "trees" if by_trees >= gaps / 2.0 else "weak" if weak else "blocked"
    return Verdict(cause=cause, effect=worst.covered, where=f"{worst.height_m:g} m")


# For each number of latest nights that are tested for a step, the nominal probability of a false step per night over
# all nodes. A mean over seven nights shows smaller steps than one night. The true probability is 1 % per night, even if
# consecutive nights correlate by 0.7, and half of that if they correlate by 0.5 (``python -m tests.compare.test_steps
# 500``). It exceeds the nominal probability, because a robust fit with missing links has longer tails than Student's t.
_CHANCES = {1: 0.0025, 7: 0.0005}

# Smallest number of nights that determine the standard deviation well enough to test for a step.
_FEWEST_NIGHTS = 10

# Number of robust standard deviations above which a residual has less weight (Huber), such as that of a link blocked by
# a car.
_HUBER = 1.5


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """A step of an offset: first night, last night that was needed to find it, and size with a 95 % interval.

    ``back`` is the night at which the old level returned, if it did so after one or two nights, else empty.
    """

    night: str
    shown: str
    step_db: float
    step_ci95_db: statistics.Interval
    back: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class NodeOffset:
    """The offset of one transmitter or receiver over the nights of a campaign [dB], relative to its median.

    ``sd_db`` is the standard deviation between steps, and ``smallest_db`` is the smallest step that is detected, with
    90 % probability, in the night in which it occurs. Both numbers are NaN if there are too few nights.
    """

    node: str
    night: tuple[str, ...]
    offset_db: tuple[float, ...]
    sd_db: float
    smallest_db: float
    steps: tuple[Step, ...] = ()


@dataclass(frozen=True, slots=True)
class NightOffsets:
    """The offsets (nights,) of one transmitter or receiver [dB], NaN if unknown, and its number of links per night.

    The variance of an offset is inversely proportional to its number of links.
    """

    offset_db: FloatArray
    links: FloatArray


def node_offsets(offset_db: ArrayLike, links: Sequence[tuple[str, str]]) -> dict[str, NightOffsets]:
    """Compute the offset of every transmitter and receiver from the offsets of the links between them.

    Parameters
    ----------
    offset_db : (nights, links)
        Offset of each link, NaN if not measured [dB].
    links : sequence of (transmitter, receiver)

    Returns
    -------
    dict of str to NightOffsets
        NaN if no link of a node was measured. If there is a single transmitter, only the receivers have an offset.

    Notes
    -----
    ``offset(night, link) = link + transmitter(night) + receiver(night)`` by least squares with Huber's weights. The
    constant of a link is the median of its residuals, fitted iteratively. The plain median of the link's offsets would
    depend on missing nights before or after a step. The common part of all transmitters or receivers (such as weather)
    is the median of the other nodes. It is subtracted if there are four or more nodes.

    Examples
    --------
    >>> offsets = node_offsets([[1.0, 5.0], [1.0, 5.0], [1.0, 7.0]], [("UAV", "LW1"), ("UAV", "LW2")])
    >>> offsets["LW2 receives"].offset_db.round(6).tolist()
    [0.0, 0.0, 2.0]
    """
    change = unmasked(offset_db)
    known = np.isfinite(change)
    raw, base = change, _median(change, 0)
    ends = [sorted({link[end] for link in links}) for end in (0, 1)]
    ends[0] = ends[0] if len(ends[0]) > 1 else []
    columns = [(end, name) for end in (0, 1) for name in ends[end]]
    design = np.array([[float(link[end] == name) for end, name in columns] for link in links])
    weight = known.astype(float)
    for _ in range(8):
        change = np.where(known, raw - base, 0.0)
        # a node without a link in a night has an empty row, and no offset below
        normal = np.einsum("tl,li,lj->tij", weight, design, design) + 1e-9 * np.eye(len(columns))
        fitted = np.linalg.solve(normal, ((weight * change) @ design)[..., None])[..., 0]
        residual = np.abs(change - fitted @ design.T)
        scale = 1.4826 * _median(np.where(known, residual, np.nan), 1)
        # with a scale of 0 (all links agree), every link has full weight
        weight = known * np.minimum(1.0, _HUBER * scale / np.maximum(residual, 1e-12) + (scale <= 0.0))
        base = _median(raw - fitted @ design.T, 0)
    number = known.astype(float) @ design
    fitted = np.where(number > 0.0, fitted, np.nan)
    alone = fitted.copy()
    for i, (end, _) in enumerate(columns):
        others = [j for j, of in enumerate(columns) if of[0] == end and j != i]
        if len(others) > 2:  # with fewer nodes, a step of one node would appear in the others
            fitted[:, i] -= _median(alone[:, others], 1)[:, 0]
    return {
        f"{name} {('transmits', 'receives')[end]}": NightOffsets(fitted[:, i], number[:, i])
        for i, (end, name) in enumerate(columns)
    }


def _median(values: FloatArray, axis: int) -> FloatArray:
    """Return the median of the known values along an axis, whose length becomes 1. NaN without known values."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # all values of a link or of a night may be NaN
        return np.asarray(np.nanmedian(values, axis=axis, keepdims=True))


@dataclass(slots=True)
class _Segment:
    """The latest nights without a step, with sum of squares and degrees of freedom of the earlier segments.

    ``values`` has a row per night: offset [dB] and weight, which is the number of links.
    """

    values: list[tuple[float, float]]
    square: float = 0.0
    freedom: int = 0

    def level(self) -> tuple[float, float]:
        """Return the mean offset [dB] and its weight."""
        return _mean(self.values)

    def pooled(self) -> tuple[float, int]:
        """Return the weighted sum of squares about the levels of all segments, and its degrees of freedom."""
        mean, _ = self.level()
        own = sum(weight * (value - mean) ** 2 for value, weight in self.values)
        return self.square + own, self.freedom + len(self.values) - 1

    def inflation(self) -> float:
        """Return the variance of the mean over consecutive nights, divided by that over independent nights.

        The correlation is increased by its standard error, because its estimate can be too small by chance.
        """
        mean, _ = self.level()
        about = np.array([(value - mean) * weight**0.5 for value, weight in self.values])
        known = float(about[1:] @ about[:-1] / max(about @ about, 1e-12)) + len(about) ** -0.5
        correlation = float(min(max(known, 0.0), 0.9))
        return (1.0 + correlation) / (1.0 - correlation)

    def step_to(self, nights: Sequence[tuple[float, float]]) -> tuple[float, float, float]:
        """Return the step to the mean of some nights, half its 95 % interval, and the p-value of a step this large."""
        from scipy.special import stdtr, stdtrit  # importing scipy.stats would take 0.2 s for two functions

        square, freedom = self.pooled()
        if freedom < _FEWEST_NIGHTS - 1:
            return 0.0, np.inf, 1.0
        inflation = self.inflation()
        (before, weight), (after, weight_after) = self.level(), _mean(nights)
        # The level before the step is also a mean of consecutive nights. One or two nights count as independent,
        # because they are too few to show a correlation, and because a change that ends soon, such as rain, must be
        # found.
        level = (inflation if len(self.values) > 2 else 1.0) / weight
        share = (inflation if len(nights) > 1 else 1.0) / weight_after + level
        error = float(np.sqrt(max(square, 1e-12) / freedom * share))
        step = after - before
        return step, float(stdtrit(freedom, 0.975)) * error, 2.0 * float(stdtr(freedom, -abs(step) / error))

    def smallest_db(self, chance: float, weight: float) -> float:
        """Return the step that is found with a probability of 90 % in one night of the given weight."""
        from scipy.special import stdtrit

        square, freedom = self.pooled()
        if freedom < _FEWEST_NIGHTS - 1:
            return float("nan")
        reach = -float(stdtrit(freedom, chance / 2.0)) - float(stdtrit(freedom, 0.1))
        return reach * float(np.sqrt(square / freedom * (1.0 / weight + self.inflation() / self.level()[1])))


def _split_nights(segment: _Segment, window: int) -> tuple[_Segment, list[tuple[float, float]]]:
    """Split a segment before its last ``window`` nights, and return both parts."""
    return replace(segment, values=segment.values[:-window]), segment.values[-window:]


def _between(segment: _Segment, window: int) -> float:
    """Return the sum of squares that is explained by a step before the last ``window`` nights."""
    earlier, nights = _split_nights(segment, window)
    (before, weight), (after, weight_after) = earlier.level(), _mean(nights)
    return (after - before) ** 2 * weight * weight_after / (weight + weight_after)


def _mean(nights: Sequence[tuple[float, float]]) -> tuple[float, float]:
    total = sum(weight for _, weight in nights)
    return sum(value * weight for value, weight in nights) / total, total


def stepped(node: str, night: Sequence[str], offsets: NightOffsets, nodes: int) -> NodeOffset:
    """Find the steps of one node's offset, night by night, without using nights after the tested night.

    Parameters
    ----------
    node : str
    night : sequence of str
    offsets : NightOffsets
    nodes : int
        Number of nodes that are tested together. On average, there is one false step in a hundred nights over all nodes
        together.

    Returns
    -------
    NodeOffset
    """
    known = np.flatnonzero(np.isfinite(offsets.offset_db)).tolist()
    values = list(zip(offsets.offset_db[known].tolist(), offsets.links[known].tolist(), strict=True))
    steps: list[Step] = []
    here, before = _Segment([]), None
    for last, value in enumerate(values):
        here.values.append(value)
        for window, chance in _CHANCES.items():
            if len(here.values) <= window:
                continue
            if _split_nights(here, window)[0].step_to(here.values[-window:])[2] >= chance / nodes:
                continue
            # Find the first night of the step by least squares, because a window with earlier nights would make the
            # step look too small.
            window = max(range(1, min(max(_CHANCES), len(here.values) - 1) + 1), key=lambda n: _between(here, n))
            earlier, nights = _split_nights(here, window)
            step, reach, _ = earlier.step_to(nights)
            # a return to the old level after one or two nights is one event, not two steps
            if before is not None and len(earlier.values) < 3 and before.step_to([value])[2] >= chance / nodes:
                steps[-1] = replace(steps[-1], back=night[known[last]])
                here, before = replace(before, values=[*before.values, value]), None
            else:
                at = (night[known[last + 1 - window]], night[known[last]])
                steps.append(Step(night=at[0], shown=at[1], step_db=step, step_ci95_db=(step - reach, step + reach)))
                here, before = _Segment(nights, *earlier.pooled()), earlier
            break
    square, freedom = here.pooled() if values else (0.0, 0)
    # weight of a night with the usual number of links
    usual = float(np.median([weight for _, weight in values])) if values else 1.0
    return NodeOffset(
        node=node, night=tuple(night[i] for i in known), offset_db=tuple(value for value, _ in values),
        steps=tuple(steps), sd_db=float(np.sqrt(square / freedom / usual)) if freedom else float("nan"),
        smallest_db=here.smallest_db(_CHANCES[1] / nodes, usual) if values else float("nan"),
    )  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Changed:
    """A number that both reports contain. ``difference`` is second minus first, with its 95 % interval, or NaN."""

    first: float
    second: float
    difference: float
    ci95: statistics.Interval = statistics.NO_INTERVAL


@dataclass(frozen=True, slots=True, kw_only=True)
class Overlap:
    """The number of samples of the first report, of the second report, and of both reports in common."""

    first: int
    second: int
    common: int

    def __str__(self) -> str:
        return f"{self.common} of {self.first}, {self.second}"

    @property
    def only_first(self) -> int:
        """The number of samples that only the first report has."""
        return self.first - self.common

    @property
    def only_second(self) -> int:
        """The number of samples that only the second report has."""
        return self.second - self.common


@dataclass(frozen=True, slots=True, kw_only=True)
class LevelDifference:
    """The difference in the RSS of one tower and channel.

    Parameters
    ----------
    tower, channel : str
    samples : Overlap
        All samples.
    scored : Overlap
        Samples with a residual.
    measured_max_db, simulated_max_db, simulated_rms_db : float
        Largest and root mean square difference of the levels on common samples [dB]. NaN if there are none.
    offset_db : Changed
        Fitted offset, as in the reports.
    rmse : PairedDifference
        Difference on common scored samples, after the best offset of each report for these samples. ``rmse_db`` belongs
        to the second report, ``other_rmse_db`` to the first.
    """

    tower: str
    channel: str
    samples: Overlap
    scored: Overlap
    measured_max_db: float
    simulated_max_db: float
    simulated_rms_db: float
    offset_db: Changed
    rmse: statistics.PairedDifference


@dataclass(frozen=True, slots=True, kw_only=True)
class RankDifference:
    """The difference in the rank of one tower at one K.

    On common samples, ``n_changed`` simulated and ``n_reported_changed`` reported ranks differ between the reports.
    """

    tower: str
    k: str
    samples: Overlap
    n_changed: int
    n_reported_changed: int
    agreement: Changed
    kappa: Changed


def level_difference(
    tower: str,
    channel: str,
    samples: Overlap,
    first: tuple[FloatArray, FloatArray, FloatArray],
    second: tuple[FloatArray, FloatArray, FloatArray],
    *,
    scored: tuple[int, int],
    offsets_db: tuple[float, float],
    place_m: FloatArray | None = None,
) -> LevelDifference:
    """Compare the levels of one link in two reports.

    Parameters
    ----------
    tower, channel : str
    samples : Overlap
    first, second : tuple of three (n,)
        Measured level (without offset), simulated level and residual in each report, for the common samples in time
        order [dB].
    scored : (int, int)
        Number of samples with a residual in each complete report.
    offsets_db : (float, float)
        Fitted offset in each report [dB].
    place_m : (n, 3), optional
        Positions of the common samples [m], NaN if unknown. With positions, the interval also allows for correlation
        over position.

    Returns
    -------
    LevelDifference
        Change of levels, offset and RMSE, with an interval.
    """
    moved = _common_differences(first[1], second[1])
    scored_in_both = np.isfinite(first[2]) & np.isfinite(second[2])
    first_error, second_error = first[2][scored_in_both], second[2][scored_in_both]
    return LevelDifference(
        tower=tower,
        channel=channel,
        samples=samples,
        scored=Overlap(first=scored[0], second=scored[1], common=int(scored_in_both.sum())),
        measured_max_db=_largest(_common_differences(first[0], second[0])),
        simulated_max_db=_largest(moved),
        simulated_rms_db=float(np.sqrt(np.mean(moved**2))) if len(moved) else float("nan"),
        offset_db=_changed(*offsets_db),
        rmse=statistics.paired_difference(
            second_error, first_error, place_m=None if place_m is None else place_m[scored_in_both]
        ),
    )


def _common_differences(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return second minus first at the samples for which both values are finite."""
    finite = np.isfinite(first) & np.isfinite(second)
    return np.asarray(second[finite] - first[finite], dtype=np.float64)


def _largest(values: FloatArray) -> float:
    return float(np.abs(values).max()) if len(values) else float("nan")


def _changed(
    first: float, second: float, *, added: FloatArray | None = None, place_m: FloatArray | None = None
) -> Changed:
    """Return the change of a statistic. ``added`` (n,) contains the contribution of each sample, for the interval."""
    change = second - first
    ends = statistics.NO_INTERVAL if added is None else statistics.influence_interval(change, added, place_m)
    return Changed(first=first, second=second, difference=change, ci95=ends)


def rank_difference(
    tower: str,
    k: str,
    samples: Overlap,
    first: tuple[FloatArray, FloatArray],
    second: tuple[FloatArray, FloatArray],
    place_m: FloatArray | None = None,
) -> RankDifference:
    """Compare the rank of one tower at one K in two reports.

    Parameters
    ----------
    tower, k : str
    samples : Overlap
    first, second : tuple of two (n,)
        Reported and simulated rank of each report on the common samples in time order. NaN if missing, 0 if no path.
    place_m : (n, 3), optional
        The same as in :func:`level_difference`.

    Returns
    -------
    RankDifference
        Number of samples whose rank changed, and the change of agreement and kappa with intervals.
    """
    # missing reports and missing paths are both 0, and a change to or from 0 counts
    pairs = np.nan_to_num(np.array([np.column_stack(first), np.column_stack(second)]))
    ranked = ((pairs >= 1) & (pairs <= MAX_RANK)).all(axis=(0, 2))
    both = pairs[:, ranked].astype(np.int64)
    place = None if place_m is None else place_m[ranked]
    changed = (pairs[0] != pairs[1]).sum(axis=0)
    # use the sequence of differences, in which the common part of both reports cancels
    equal = (both[..., 0] == both[..., 1]).astype(np.float64)
    kappas = np.array([kappa_influence(*ranks.T) for ranks in both]) if ranked.any() else equal
    agree, kappa = (
        _changed(*(statistic(*ranks.T) for ranks in both), added=added[1] - added[0], place_m=place)
        for statistic, added in ((agreement, equal), (cohen_kappa, kappas))
    )
    return RankDifference(
        tower=tower, k=k, samples=samples, n_changed=int(changed[1]), n_reported_changed=int(changed[0]),
        agreement=agree, kappa=kappa,
    )  # fmt: skip
