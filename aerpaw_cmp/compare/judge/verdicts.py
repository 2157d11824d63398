"""Decisions that the first sentences of a page are chosen from: effect, 95 % interval and likely cause.

The report's own causes are those of :mod:`.causes`. A cause is named only where its interval excludes "no effect";
where several could be named, chance names any of them in at most :data:`_FALSE_ALARMS` of the cases.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ...common.units import BoolArray, FloatArray
from ..statistics.intervals import (
    NO_INTERVAL,
    Interval,
    mean_interval,
    paired_verdict,
    spread_interval,
)
from ..statistics.memory import FEWEST
from .season import mean_of_flights

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


def stated_errors(error_db: FloatArray, sd_db: FloatArray, common_db: FloatArray | float = 0.0) -> Verdict:
    """Check whether errors are as large as was stated for them.

    Parameters
    ----------
    error_db, sd_db : (n,)
        Measured minus predicted, and the standard deviation stated for it, in time order [dB].
    common_db : float or (n,)
        Part of that standard deviation that a whole flight may share (an offset) [dB].

    Returns
    -------
    Verdict
        ``narrow`` or ``wide`` (effect: errors over stated, as a ratio), ``biased`` (effect: mean error [dB]), else
        ``none`` with the ratio and its interval; ``no interval`` of fewer than 20 samples.
    """
    good = np.isfinite(error_db) & np.isfinite(sd_db) & (sd_db > 0.0)
    error, sd = error_db[good], sd_db[good]
    if len(error) < FEWEST:
        return Verdict(cause="no interval")
    share = float(np.mean(np.square(np.broadcast_to(common_db, good.shape)[good])))
    mean, ends = float(error.mean()), mean_interval(error)
    reach = math.hypot(0.5 * (ends[1] - ends[0]), 1.96 * math.sqrt(share))
    bias = Verdict(cause="biased", effect=mean, interval=(mean - reach, mean + reach))
    ratio = error / sd
    low, high = spread_interval(ratio)
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
