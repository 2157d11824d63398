"""The verdict on a flight or a campaign, and the statistics that it rests on.

Decisions that the first sentences of a page are chosen from: effect, 95 % interval and likely cause.

The report's own causes are those of :mod:`.causes`. A cause is named only where its interval excludes "no effect";
where several could be named, chance names any of them in at most :data:`_FALSE_ALARMS` of the cases.

Ray tracing against the best baseline over all channels of a flight at once.

Results of a season of flights: offsets from other flights, differences between settings.

Offsets of nodes night by night, and the nights at which they step.

Two reports of one flight on the samples that both have: what moved, and how well a change of error is known.

Everywhere the first report is subtracted from the second: a negative difference of an error says that the second is
better. Errors of both share the measurement and most of the model, so they are compared in pairs.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from ..common.units import BoolArray, FloatArray, IntArray, unmasked
from . import statistics
from .level import DetectionScore, floored_fit
from .offset import SPAN_DB, nearest_offset, offset_grid
from .rank import MAX_RANK, agreement, cohen_kappa, kappa_influence
from .result import FlightVerdict, RssResult
from .statistics import (
    FEWEST,
    NO_INTERVAL,
    Interval,
    autocorrelation,
    corrected,
    is_flat,
    mean_interval,
    middle_span,
    paired_verdict,
    pooled_difference,
    spread_interval,
)


def with_corrected_verdicts(panels: Sequence[RssResult]) -> list[RssResult]:
    """Channels whose verdicts against each baseline are corrected for the number of channels."""
    rows = [dict(panel.further.compared_with) for panel in panels]
    for name in dict.fromkeys(name for row in rows for name in row):
        members = [i for i, row in enumerate(rows) if name in row]
        # a log that was copied to another channel counts once
        measured = [panels[i].measured_db.tobytes() for i in members]
        for i, pair in zip(members, corrected([rows[i][name] for i in members], measured), strict=True):
            rows[i][name] = pair
    return [
        replace(panel, further=replace(panel.further, compared_with=row))
        for panel, row in zip(panels, rows, strict=True)
    ]


def scored(panels: Iterable[RssResult]) -> list[RssResult]:
    """Channels with an offset and enough samples for a sentence, without copies and, where one lives, the dead."""
    some = [p for p in without_copies(panels) if not p.score.at_edge]
    enough = [p for p in some if p.score.n >= FEWEST and math.isfinite(p.score.rmse_db)]
    return [panel for panel in enough if not is_dead(panel)] or enough


def without_copies(panels: Iterable[RssResult]) -> list[RssResult]:
    """Channels, and of some with the same levels the first."""
    return list({panel.measured_db.tobytes(): panel for panel in reversed(list(panels))}.values())[::-1]


# Fading alone makes a received level vary by more [dB], also where no model does.
_DEAD_DB = 1.0


def is_dead(panel: RssResult) -> bool:
    """True of a level whose middle 80 % span less than a decibel, and little of what is predicted: a dead input."""
    known = panel.posed & np.isfinite(panel.measured_db) & np.isfinite(panel.simulated_dbm)
    if not known.any():
        return False
    measured_db = panel.measured_db[known]
    return middle_span(measured_db) < _DEAD_DB and is_flat(measured_db, [panel.simulated_dbm[known]])


def is_one_place(panels: Iterable[RssResult]) -> bool:
    """True of levels that no model lets vary by a decibel, as where a UAV hovers: each fits as a constant does."""
    every = [[panel.simulated_dbm, *(b.level_dbm for b in panel.baselines.values())] for panel in scored(panels)]
    levels = [level[np.isfinite(level)] for models in every for level in models if np.isfinite(level).any()]
    return bool(levels) and max(map(middle_span, levels)) < _DEAD_DB


def baseline_errors(panels: Sequence[RssResult]) -> dict[str, float]:
    """Pooled RMSE [dB] of each baseline that all of these channels have."""
    errors = {}
    for name in panels[0].baselines if panels else ():
        known = [panel.baselines[name].rmse_db for panel in panels if name in panel.baselines]
        if len(known) == len(panels) and all(map(math.isfinite, known)):
            errors[name] = pooled_db(known, [panel.score.n for panel in panels])
    return errors


def pooled_db(rmse_db: Sequence[float], n: Sequence[int]) -> float:
    """Root of the mean square error over all samples of several series, each after its own offset [dB]."""
    weight = np.asarray(n, dtype=np.float64)
    return float(np.sqrt((weight * np.asarray(rmse_db) ** 2).sum() / weight.sum()))


def lock_lost(panel: RssResult) -> DetectionScore | None:
    """The score of a receiver whose log says when it was in lock; None of others, and of one that never lost it."""
    score = panel.further.detection
    return score if score is not None and score.locks else None


def flight_verdict(panels: Sequence[RssResult]) -> FlightVerdict | None:
    """Ray tracing against the baseline with the smallest error, over all scored channels at once.

    A receiver that lost its lock is judged on all its samples, lower levels counted as its floor.
    """
    panels = scored(panels)
    residuals = [_residuals(panel) for panel in panels]
    errors = {name: _rms([of[name] for of in residuals]) for name in set.intersection(*map(set, residuals or [{}]))}
    best = min((name for name in errors if name != _RAY), key=lambda name: errors[name], default="")
    if not best:
        return None
    channels = [(panel.time, of[_RAY], of[best]) for panel, of in zip(panels, residuals, strict=True)]
    places = [panel.position_m for panel in panels]
    pair = pooled_difference(channels, free_offset=not any(map(lock_lost, panels)), place_m=places)
    return FlightVerdict(
        against=best, rmse_db=errors[_RAY], baseline_rmse_db=errors[best], difference_db=pair.difference_db,
        ci95_db=pair.difference_ci95_db, channels=len(panels),
    )  # fmt: skip


_RAY = "ray tracing"


def _residuals(panel: RssResult) -> dict[str, FloatArray]:
    """Residuals (n,) of ray tracing and of each baseline after its own offset, where a path is simulated [dB]."""
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


# Fewer flights than this give no interval of a mean over flights.
FEWEST_FLIGHTS = 3

# From so many flights on, how alike neighbouring flights are is estimated and counted.
_MANY_FLIGHTS = 20

RankingVerdict = Literal["first", "worse", "not significant", "no interval"]


def left_out_offsets(n: ArrayLike, mean_db: ArrayLike, *, span_db: tuple[float, float] = SPAN_DB) -> FloatArray:
    """Offset [dB] of each flight from the samples of all others.

    Parameters
    ----------
    n : (f,)
        Samples of each flight.
    mean_db : (f,)
        Mean of simulated minus measured [dB]; NaN where n = 0.
    span_db : (low, high)
        Of the offsets.

    Returns
    -------
    (f,)
        NaN where no other flight has samples.

    Notes
    -----
    The offset of least RMSE over the other flights' samples is the mean of their differences,
    sum_{j != i} n_j m_j / sum_{j != i} n_j, taken to the grid (arXiv 2502.10324, section V).

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
        # summed anew: the difference of two large sums would lose what one short flight says
        mean_of_others = np.delete(total, i).sum() / other_samples[i]
        result[i] = grid[nearest_offset(grid, float(mean_of_others))]
    return result


def error_at_offset(
    offset_db: ArrayLike, rmse_db: ArrayLike, own_offset_db: ArrayLike, mean_db: ArrayLike
) -> FloatArray:
    """RMSE [dB] at another offset than the own one.

    Parameters
    ----------
    offset_db : array_like
        The offset asked for.
    rmse_db, own_offset_db : array_like
        RMSE at the own offset, and that offset.
    mean_db : array_like
        Mean of simulated minus measured.

    Returns
    -------
    ndarray
        RMSE [dB], of the broadcast shape.

    Notes
    -----
    RMSE^2(o) = variance + (o - mean)^2, with the variance from the known point.

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
    """Mean over ``n`` flights with a 95 % interval, NaN where there are too few."""

    n: int
    mean: float
    low: float
    high: float


def mean_of_flights(values: ArrayLike) -> MeanOfFlights:
    """Mean and 95 % interval over flights, one value each, in the order of the dates; NaN does not count.

    Notes
    -----
    Student's t over n flights; from :data:`_MANY_FLIGHTS` on over the effective number of
    :func:`~aerpaw_cmp.compare.statistics.autocorrelation`, so that a season that drifts has no narrower
    interval than its flights bear.
    """
    from scipy.special import stdtrit  # scipy.stats would load for 0.2 s what one quantile needs

    array = unmasked(values)
    array = array[np.isfinite(array)]
    n = len(array)
    if not n:
        return MeanOfFlights(n=0, mean=np.nan, low=np.nan, high=np.nan)
    mean = float(array.mean())
    if n < FEWEST_FLIGHTS:
        return MeanOfFlights(n=n, mean=mean, low=np.nan, high=np.nan)
    independent = float(n)
    if n >= _MANY_FLIGHTS and np.ptp(array) > 0:
        known = autocorrelation(array).n_effective
        # no fewer than an interval asks for: with one, Student's t has no degree of freedom
        independent = float(np.clip(known, FEWEST_FLIGHTS, n)) if np.isfinite(known) else independent
    reach = float(stdtrit(independent - 1.0, 0.975)) * float(array.std(ddof=1)) / independent**0.5
    return MeanOfFlights(n=n, mean=mean, low=mean - reach, high=mean + reach)


def verdict_of(difference: MeanOfFlights) -> RankingVerdict:
    """Check whether a setting is shown to be worse than the first."""
    if not np.isfinite(difference.low):
        return "no interval"
    return "worse" if difference.low > 0 else "not significant"


# Share of sound campaigns in which a cause is named, over all that are tried together.
_FALSE_ALARMS = 0.02

# Flights below which none of a campaign is called unlike the others.
_FEWEST_TO_COMPARE = 5

# An offset that differs by less [dB] costs no decision, whatever its interval.
LEAST_DB = 2.0

NONE = "none"


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """A decision.

    Parameters
    ----------
    cause : str
        What sentence and action are chosen by; ``none`` where nothing is shown.
    effect : float
        In the unit that the cause implies (dB, a ratio, a share); NaN where there is none.
    interval : (low, high)
        95 % interval of the effect; NaN where none can be given.
    where : str
        Flight, link, baseline or instant that the sentence names.
    """

    cause: str = NONE
    effect: float = math.nan
    interval: Interval = NO_INTERVAL
    where: str = ""


# --- campaign -------------------------------------------------------------------------------------------------------


# The chance of a shift that is no larger by accident, and what is said of it.
_Shift = tuple[float, Verdict]


def campaign_verdict(
    errors_db: Mapping[str, float], offsets_db: Mapping[str, Mapping[str, float]], order: Sequence[str]
) -> Verdict:
    """The one trouble of a season that stands out: a flight's error or offset, or a step in a link's offset.

    Parameters
    ----------
    errors_db : mapping of str to float
        Mean error of each flight [dB].
    offsets_db : mapping of str to mapping of str to float
        Simulated minus measured, mean of each flight, by link [dB].
    order : sequence of str
        Flights by date.

    Returns
    -------
    Verdict
        ``outlying error`` (effect: ratio to the other flights), ``outlying offset`` (dB), ``gain step`` (dB, with
        link and first flight after it) or ``none``.

    Notes
    -----
    Each candidate splits the flights in two; its two-sample t test with pooled variance is that of the externally
    Studentised residual for one flight. The smallest chance counts times the number of candidates (Bonferroni).
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
        # a flight that errs less than the others is no trouble
        yield (chance if effect > 0.0 else math.nan), ratio
    about: dict[str, list[float]] = {}
    for link, of in offsets_db.items():
        flown_here = [name for name in order if math.isfinite(of.get(name, math.nan))]
        values = np.array([of[name] for name in flown_here])
        for name, value in zip(flown_here, values - values.mean() if len(flown_here) else values, strict=True):
            about.setdefault(name, []).append(float(value))
        # two flights on either side at least: one alone is an outlying flight, not a step
        for k in range(2, len(flown_here) - 1):
            chance, effect, ends = _split(values, np.arange(len(flown_here)) >= k)
            where = f"{link} from {flown_here[k]}"
            yield chance, Verdict(cause="gain step", effect=effect, interval=ends, where=where)
    flown = [name for name in order if name in about]
    for i, chance, effect, ends in _each_alone(np.array([np.mean(about[name]) for name in flown])):
        yield chance, Verdict(cause="outlying offset", effect=effect, interval=ends, where=flown[i])


def _each_alone(values: FloatArray) -> Iterator[tuple[int, float, float, Interval]]:
    """Each value against all others."""
    for i in range(len(values)):
        yield i, *_split(values, np.arange(len(values)) == i)


def _split(values: FloatArray, inside: BoolArray) -> tuple[float, float, Interval]:
    """Chance, difference of means (inside minus outside) and its 95 % interval, variance pooled."""
    from scipy.special import stdtr, stdtrit  # scipy.stats would load for 0.2 s what two functions need

    freedom, n = len(values) - 2, int(inside.sum())
    if len(values) < _FEWEST_TO_COMPARE or not 0 < n < len(values):
        return math.nan, math.nan, NO_INTERVAL
    within, without = values[inside], values[~inside]
    effect = float(within.mean() - without.mean())
    square = float(((within - within.mean()) ** 2).sum() + ((without - without.mean()) ** 2).sum()) / freedom
    # flights may be equal to the last digit, as copies are
    error = math.sqrt(max(square, 1e-12) * (1.0 / n + 1.0 / (len(values) - n)))
    reach = float(stdtrit(freedom, 0.975)) * error
    return 2.0 * float(stdtr(freedom, -abs(effect) / error)), effect, (effect - reach, effect + reach)


# --- calibration ----------------------------------------------------------------------------------------------------


def by_flight(
    errors_db: Iterable[tuple[str, float]], other_db: Iterable[tuple[str, float]], where: str = ""
) -> Verdict:
    """Two models on the same flights, one value per flight.

    Parameters
    ----------
    errors_db, other_db : iterable of (flight, error)
        Several errors of a flight (channels) count as their mean [dB].
    where : str
        Name of the other model.

    Returns
    -------
    Verdict
        ``better``, ``worse``, ``not significant`` or ``no interval``, of the first model. Effect: mean over flights of
        the first minus the second [dB]. Interval from
        :data:`.season.FEWEST_FLIGHTS` flights on.
    """
    first, second = _means(errors_db), _means(other_db)
    mean = mean_of_flights([first[name] - second[name] for name in first if name in second])
    return Verdict(
        cause=paired_verdict(mean.low, mean.high), effect=mean.mean, interval=(mean.low, mean.high), where=where
    )


def _means(errors_db: Iterable[tuple[str, float]]) -> dict[str, float]:
    each: dict[str, list[float]] = {}
    for flight, error in errors_db:
        if math.isfinite(error):
            each.setdefault(flight, []).append(error)
    return {flight: float(np.mean(values)) for flight, values in each.items()}


def antenna_or_place(against: Sequence[Verdict]) -> Verdict:
    """Check whether what was learned turns with the aircraft: body frame versus frames that do not (:func:`by_flight`).

    Parameters
    ----------
    against : sequence of Verdict
        One per wrong frame.

    Returns
    -------
    Verdict
        ``antenna`` where each wrong frame is significantly worse, ``place`` where one is significantly better, ``no
        interval`` of too few flights, else ``not separable``; effect and interval of the nearer frame.
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

# 99 % over 95 % of a normal distribution: a bias is named beyond it, since a spread is tried beside it.
_TWO_TRIED = 1.3

# Errors that are less than this times larger or smaller than stated are as stated.
_LEAST_RATIO = 1.15


def stated_errors(
    error_db: FloatArray,
    sd_db: FloatArray,
    common_db: FloatArray | float = 0.0,
    place_m: FloatArray | None = None,
) -> Verdict:
    """Check whether errors are as large as was stated for them.

    Parameters
    ----------
    error_db, sd_db : (n,)
        Measured minus predicted, and the standard deviation stated for it, in time order [dB].
    common_db : float or (n,)
        Part of that standard deviation that a whole flight may share (an offset) [dB].
    place_m : (n, 3), optional
        As for :func:`~aerpaw_cmp.compare.statistics.mean_draws`.

    Returns
    -------
    Verdict
        ``narrow`` or ``wide`` (effect: errors over stated, as a ratio), ``biased`` (effect: mean error [dB]), else
        ``none`` with the ratio and its interval; ``no interval`` of fewer than 20 samples.
    """
    good = np.isfinite(error_db) & np.isfinite(sd_db) & (sd_db > 0.0)
    error, sd, place = error_db[good], sd_db[good], None if place_m is None else place_m[good]
    if len(error) < FEWEST:
        return Verdict(cause="no interval")
    share = float(np.mean(np.square(np.broadcast_to(common_db, good.shape)[good])))
    mean, ends = float(error.mean()), mean_interval(error, place)
    reach = math.hypot(0.5 * (ends[1] - ends[0]), 1.96 * math.sqrt(share))
    bias = Verdict(cause="biased", effect=mean, interval=(mean - reach, mean + reach))
    ratio = error / sd
    low, high = spread_interval(ratio, place)
    # what a flight shares is no spread inside of it: it can hide a narrow interval, not make a wide one
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

# A map with less than this share of its positions in coverage has gaps that a sentence explains.
_COVERED = 0.95


@dataclass(frozen=True, slots=True, kw_only=True)
class Coverage:
    """One height of a map: shares of its positions.

    ``covered`` with the trees as mapped, ``clear`` without trees (NaN where not mapped); ``outside`` lie further from
    every flight than a correction reaches.
    """

    height_m: float
    covered: float
    clear: float = math.nan
    outside: float = 0.0


def coverage_verdict(heights: Sequence[Coverage]) -> Verdict:
    """Share of the worst height that is covered, and the cause that takes the rest.

    Parameters
    ----------
    heights : sequence of Coverage

    Returns
    -------
    Verdict
        Effect: share covered at the height with the least. Causes: ``extrapolated`` (most positions lie beyond the
        flights), ``no path`` (nothing is covered), ``trees``, ``blocked`` (what takes most of the gaps), ``none`` (at
        least :data:`_COVERED`). A computed share has no interval.
    """
    if not heights:
        return Verdict()
    worst = min(heights, key=lambda height: height.covered)
    by_trees = max(float(np.nan_to_num(worst.clear - worst.covered)), 0.0)
    if worst.outside > 0.5:
        cause = "extrapolated"
    elif worst.covered == 0.0:
        cause = "no path"
    elif worst.covered >= _COVERED:
        cause = NONE
    else:
        cause = "trees" if by_trees >= 1.0 - worst.covered - by_trees else "blocked"
    return Verdict(cause=cause, effect=worst.covered, where=f"{worst.height_m:g} m")


# Nights over which a step is looked for, and its chance on a night without one, at all nodes of a season together: the
# last night, and the last seven, whose mean shows what one night cannot. Nominal: the tails of a robust fit with links
# missing are longer than Student's, and the interval of a mean knows roughly how alike nights in a row are
# (``python -m tests.compare.test_steps 500``: one false step in a hundred nights; as many where nights in a row
# correlate by .7, half at .5).
_CHANCES = {1: 0.0025, 7: 0.0005}

# Fewer nights than this tell no standard deviation that a step could be judged by.
_FEWEST_NIGHTS = 10

# Residuals beyond so many robust standard deviations count less (Huber): a link with a car in front of it.
_HUBER = 1.5


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """A change of an offset: first night with it, night at whose end it showed, size with 95 % interval.

    ``back`` is the night with the old level again, of a step of a night or two; else empty.
    """

    night: str
    shown: str
    step_db: float
    step_ci95_db: Interval
    back: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class NodeOffset:
    """Offset of one end of links over the nights of a season [dB], against its own median.

    ``sd_db`` is its standard deviation between steps, ``smallest_db`` the step that shows the same night with a chance
    of 90 %; NaN where there are too few nights.
    """

    node: str
    night: tuple[str, ...]
    offset_db: tuple[float, ...]
    sd_db: float
    smallest_db: float
    steps: tuple[Step, ...] = ()


@dataclass(frozen=True, slots=True)
class NightOffsets:
    """Offsets (nights,) of one end of links [dB], NaN if unknown, and the number of links (nights,) of each night.

    The variance of an offset is inversely proportional to its number of links.
    """

    offset_db: FloatArray
    links: FloatArray


def node_offsets(offset_db: ArrayLike, links: Sequence[tuple[str, str]]) -> dict[str, NightOffsets]:
    """Offset of every transmitter and receiver, from those of the links between them.

    Parameters
    ----------
    offset_db : (nights, links)
        NaN where a link was not measured.
    links : sequence of (transmitter, receiver)

    Returns
    -------
    dict of str to NightOffsets
        NaN where no link of a node was measured. Of one transmitter only the receivers have an offset.

    Notes
    -----
    ``offset(night, link) = link + transmitter(night) + receiver(night)`` by least squares with Huber's weights. The
    part of a link is the median of its residuals, fitted in turns: its plain median would depend on the nights that
    the link misses on either side of a step. What transmitters or receivers share (weather) is the median of the
    others, and is subtracted if there are four or more.

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
        # a scale of 0 (all links agree) lets every link count in full
        weight = known * np.minimum(1.0, _HUBER * scale / np.maximum(residual, 1e-12) + (scale <= 0.0))
        base = _median(raw - fitted @ design.T, 0)
    number = known.astype(float) @ design
    fitted = np.where(number > 0.0, fitted, np.nan)
    alone = fitted.copy()
    for i, (end, _) in enumerate(columns):
        others = [j for j, of in enumerate(columns) if of[0] == end and j != i]
        if len(others) > 2:  # of fewer one that steps would be seen in the others
            fitted[:, i] -= _median(alone[:, others], 1)[:, 0]
    return {
        f"{name} {('transmits', 'receives')[end]}": NightOffsets(fitted[:, i], number[:, i])
        for i, (end, name) in enumerate(columns)
    }


def _median(values: FloatArray, axis: int) -> FloatArray:
    """Median of what is known along an axis, which stays; NaN where nothing is."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a link without a night, a night without a link
        return np.asarray(np.nanmedian(values, axis=axis, keepdims=True))


@dataclass(slots=True)
class _Stretch:
    """Nights in a row without a step; ``square`` and ``freedom`` are of the stretches before it.

    ``values`` has a row per night: offset [dB] and weight, the number of links.
    """

    values: list[tuple[float, float]]
    square: float = 0.0
    freedom: int = 0

    def level(self) -> tuple[float, float]:
        """Return the mean offset [dB] and its weight."""
        return _mean(self.values)

    def pooled(self) -> tuple[float, int]:
        """Return the weighted sum of squares about the levels of all stretches, and its degrees of freedom."""
        mean, _ = self.level()
        own = sum(weight * (value - mean) ** 2 for value, weight in self.values)
        return self.square + own, self.freedom + len(self.values) - 1

    def alike(self) -> float:
        """Return the variance of a mean of nights in a row over that of independent nights.

        The correlation is one standard error higher: independent nights must not look better than they are.
        """
        mean, _ = self.level()
        about = np.array([(value - mean) * weight**0.5 for value, weight in self.values])
        known = float(about[1:] @ about[:-1] / max(about @ about, 1e-12)) + len(about) ** -0.5
        correlation = float(min(max(known, 0.0), 0.9))
        return (1.0 + correlation) / (1.0 - correlation)

    def step_to(self, nights: Sequence[tuple[float, float]]) -> tuple[float, float, float]:
        """Return the step to the mean of some nights, half its 95 % interval, and the chance of one as large."""
        from scipy.special import stdtr, stdtrit  # scipy.stats would load for 0.2 s what two functions need

        square, freedom = self.pooled()
        if freedom < _FEWEST_NIGHTS - 1:
            return 0.0, np.inf, 1.0
        alike = self.alike()
        (before, weight), (after, weight_after) = self.level(), _mean(nights)
        # the level before is a mean of nights in a row, too; one or two do not show a correlation, and rain must be
        # able to end
        level = (alike if len(self.values) > 2 else 1.0) / weight
        share = (alike if len(nights) > 1 else 1.0) / weight_after + level
        error = float(np.sqrt(max(square, 1e-12) / freedom * share))
        step = after - before
        return step, float(stdtrit(freedom, 0.975)) * error, 2.0 * float(stdtr(freedom, -abs(step) / error))

    def smallest_db(self, chance: float, weight: float) -> float:
        """Return the step of one night of a weight that is shown with a chance of 90 %."""
        from scipy.special import stdtrit

        square, freedom = self.pooled()
        if freedom < _FEWEST_NIGHTS - 1:
            return float("nan")
        reach = -float(stdtrit(freedom, chance / 2.0)) - float(stdtrit(freedom, 0.1))
        return reach * float(np.sqrt(square / freedom * (1.0 / weight + self.alike() / self.level()[1])))


def _split_nights(stretch: _Stretch, window: int) -> tuple[_Stretch, list[tuple[float, float]]]:
    """Return the nights before the last ``window`` ones as a stretch, and those."""
    return replace(stretch, values=stretch.values[:-window]), stretch.values[-window:]


def _between(stretch: _Stretch, window: int) -> float:
    """Return the sum of squares that a step before the last ``window`` nights explains."""
    earlier, nights = _split_nights(stretch, window)
    (before, weight), (after, weight_after) = earlier.level(), _mean(nights)
    return (after - before) ** 2 * weight * weight_after / (weight + weight_after)


def _mean(nights: Sequence[tuple[float, float]]) -> tuple[float, float]:
    total = sum(weight for _, weight in nights)
    return sum(value * weight for value, weight in nights) / total, total


def stepped(node: str, night: Sequence[str], offsets: NightOffsets, nodes: int) -> NodeOffset:
    """Steps of one node's offset, night after night, each judged by the nights before it alone.

    Parameters
    ----------
    node : str
    night : sequence of str
    offsets : NightOffsets
    nodes : int
        How many are looked at together: their false steps are one in a hundred nights.

    Returns
    -------
    NodeOffset
    """
    known = np.flatnonzero(np.isfinite(offsets.offset_db)).tolist()
    values = list(zip(offsets.offset_db[known].tolist(), offsets.links[known].tolist(), strict=True))
    steps: list[Step] = []
    here, before = _Stretch([]), None
    for last, value in enumerate(values):
        here.values.append(value)
        for window, chance in _CHANCES.items():
            if len(here.values) <= window:
                continue
            if _split_nights(here, window)[0].step_to(here.values[-window:])[2] >= chance / nodes:
                continue
            # the window shows that there is a step, least squares when: old nights in its mean would make it too small
            window = max(range(1, min(max(_CHANCES), len(here.values) - 1) + 1), key=lambda n: _between(here, n))
            earlier, nights = _split_nights(here, window)
            step, reach, _ = earlier.step_to(nights)
            # back at the old level after a night or two: one event, not two steps
            if before is not None and len(earlier.values) < 3 and before.step_to([value])[2] >= chance / nodes:
                steps[-1] = replace(steps[-1], back=night[known[last]])
                here, before = replace(before, values=[*before.values, value]), None
            else:
                at = (night[known[last + 1 - window]], night[known[last]])
                steps.append(Step(night=at[0], shown=at[1], step_db=step, step_ci95_db=(step - reach, step + reach)))
                here, before = _Stretch(nights, *earlier.pooled()), earlier
            break
    square, freedom = here.pooled() if values else (0.0, 0)
    # of a night with the usual number of links
    usual = float(np.median([weight for _, weight in values])) if values else 1.0
    return NodeOffset(
        node=node, night=tuple(night[i] for i in known), offset_db=tuple(value for value, _ in values),
        steps=tuple(steps), sd_db=float(np.sqrt(square / freedom / usual)) if freedom else float("nan"),
        smallest_db=here.smallest_db(_CHANCES[1] / nodes, usual) if values else float("nan"),
    )  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Changed:
    """A number before and after: ``difference`` is second minus first; its 95 % interval is NaN where none is given."""

    first: float
    second: float
    difference: float
    ci95: statistics.Interval = statistics.NO_INTERVAL


@dataclass(frozen=True, slots=True, kw_only=True)
class Overlap:
    """Samples of the first report, of the second, in both, and in one only."""

    first: int
    second: int
    common: int

    def __str__(self) -> str:
        return f"{self.common} of {self.first}, {self.second}"

    @property
    def only_first(self) -> int:
        """Samples that the second report has not."""
        return self.first - self.common

    @property
    def only_second(self) -> int:
        """Samples that the first report has not."""
        return self.second - self.common


@dataclass(frozen=True, slots=True, kw_only=True)
class LevelDifference:
    """RSS of one tower and channel.

    Parameters
    ----------
    tower, channel : str
    samples : Overlap
    scored : Overlap
        Of them those with a residual.
    measured_max_db, simulated_max_db, simulated_rms_db : float
        Largest and root mean square difference of the levels on common samples [dB]; NaN without one.
    offset_db : Changed
        Fitted offset as reported.
    rmse : PairedDifference
        On common scored samples, each report with its own best offset on them; first minus second of that record is
        second minus first report.
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
    """Rank of one tower and K: ``n_changed`` simulated and ``n_reported_changed`` reported ranks on common samples."""

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
    """Compare one link.

    Parameters
    ----------
    tower, channel : str
    samples : Overlap
    first, second : tuple of three (n,)
        Level measured (without offset), replayed, and residual of each report on the common samples in time order [dB].
    scored : (int, int)
        Samples with a residual in each whole report.
    offsets_db : (float, float)
        Fitted offset of each [dB].
    place_m : (n, 3), optional
        Positions of the common samples, NaN if unknown [m]: the interval then considers correlation over place, too.

    Returns
    -------
    LevelDifference
        How far levels, offset and RMSE moved, with an interval.
    """
    moved = _apart(first[1], second[1])
    scored_in_both = np.isfinite(first[2]) & np.isfinite(second[2])
    first_error, second_error = first[2][scored_in_both], second[2][scored_in_both]
    return LevelDifference(
        tower=tower,
        channel=channel,
        samples=samples,
        scored=Overlap(first=scored[0], second=scored[1], common=int(scored_in_both.sum())),
        measured_max_db=_largest(_apart(first[0], second[0])),
        simulated_max_db=_largest(moved),
        simulated_rms_db=float(np.sqrt(np.mean(moved**2))) if len(moved) else float("nan"),
        offset_db=_changed(*offsets_db),
        rmse=statistics.paired_difference(
            second_error, first_error, place_m=None if place_m is None else place_m[scored_in_both]
        ),
    )


def _apart(first: FloatArray, second: FloatArray) -> FloatArray:
    """Differences where both sides have a value."""
    finite = np.isfinite(first) & np.isfinite(second)
    return np.asarray(second[finite] - first[finite], dtype=np.float64)


def _largest(values: FloatArray) -> float:
    return float(np.abs(values).max()) if len(values) else float("nan")


def _changed(first: float, second: float) -> Changed:
    return Changed(first=first, second=second, difference=second - first)


def rank_difference(
    tower: str,
    k: str,
    samples: Overlap,
    first: tuple[FloatArray, FloatArray],
    second: tuple[FloatArray, FloatArray],
    place_m: FloatArray | None = None,
) -> RankDifference:
    """Compare the rank of one tower at one K.

    Parameters
    ----------
    tower, k : str
    samples : Overlap
    first, second : tuple of two (n,)
        Reported and simulated rank of each report on the common samples in time order; NaN: none, 0: no path.
    place_m : (n, 3), optional
        As for :func:`level_difference`.

    Returns
    -------
    RankDifference
        Samples whose rank changed, and the change of agreement and kappa with intervals.
    """
    # no report and no path are both 0 here, and a change to or from it counts
    pairs = [np.nan_to_num(np.column_stack(pair)) for pair in (first, second)]
    usable = np.column_stack([*pairs])
    ranked = (usable >= 1).all(axis=1) & (usable <= MAX_RANK).all(axis=1)
    first_rank, second_rank = (pair[ranked].astype(np.int64) for pair in pairs)
    agree, kappa = _agreement_change(first_rank, second_rank, None if place_m is None else place_m[ranked])
    return RankDifference(
        tower=tower,
        k=k,
        samples=samples,
        n_changed=int((pairs[0][:, 1] != pairs[1][:, 1]).sum()),
        n_reported_changed=int((pairs[0][:, 0] != pairs[1][:, 0]).sum()),
        agreement=agree,
        kappa=kappa,
    )


def _agreement_change(first: IntArray, second: IntArray, place_m: FloatArray | None) -> tuple[Changed, Changed]:
    """Agreement and kappa of two reports on the same poses, each (n, 2): measured and simulated rank."""
    # one sequence for both reports: what they share cancels in the difference
    equal = [(pairs[:, 0] == pairs[:, 1]).astype(np.float64) for pairs in (first, second)]
    kappas = [kappa_influence(*pairs.T) for pairs in (first, second)] if len(first) else equal
    out = []
    for statistic, (before, after) in ((agreement, equal), (cohen_kappa, kappas)):
        changed = _changed(*(statistic(*pairs.T) for pairs in (first, second)))
        ends = statistics.influence_interval(changed.difference, after - before, place_m)
        out.append(replace(changed, ci95=ends))
    return out[0], out[1]
