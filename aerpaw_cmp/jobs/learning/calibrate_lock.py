"""The lock's part of ``calibrate``: when a receiver is in lock, from the level that other flights predict."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np

from ...compare.learning.calibration import (
    Learned,
    Observed,
    Recipe,
    flights_of,
    groups_of,
    learn,
)
from ...compare.level.detection import DetectionScore, learn_detection, score_detection
from ...flight.rows.lock import LOCK_FLOOR_DB
from ...site.antenna.learned import LearnedLock


def learned_locks(observed: Sequence[Observed], recipe: Recipe, fits: Mapping[str, Learned]) -> dict[str, LearnedLock]:
    """P(lock) by antenna, of levels that were predicted without the flight at hand, and its scores on flights left out.

    Parameters
    ----------
    observed : sequence of Observed
        Of all flights.
    recipe : Recipe
    fits : mapping of str to Learned
        What was learned without each flight.

    Returns
    -------
    dict of str to LearnedLock
        Nothing for receivers that keep their lock, or with fewer than three flights: none could be scored.
    """
    able = [o for o in observed if o.locked is not None and np.isfinite(o.locked).any()]
    if len(flights_of(able)) < 3:
        return {}
    pairs = _without_pairs(observed, recipe)
    out = {}
    for antenna in dict.fromkeys(o.samples.antenna for o in able):
        lock = _learned([o for o in able if o.samples.antenna == antenna], fits, pairs)
        if lock is not None:
            out[antenna] = lock
    return out


def _without_pairs(observed: Sequence[Observed], recipe: Recipe) -> dict[tuple[str, str], Learned]:
    """Gains learned without two flights: the levels of the one, in a forecast for the other, know of neither."""
    out: dict[tuple[str, str], Learned] = {}
    for one, other in combinations(groups_of(flights_of(observed)), 2):
        learned = learn([o.samples for o in observed if o.samples.flight not in (*one, *other)], recipe)
        out |= {pair: learned for a in one for b in other for pair in ((a, b), (b, a))}
    return out


class _Levels:
    """Predicted path gain of one series and what was received [dB], where the lock is known."""

    def __init__(self, o: Observed, learned: Learned) -> None:
        assert o.locked is not None
        level = o.free_space_db - o.sent_dbm + learned.mean(o.samples)
        at = np.isfinite(level) & np.isfinite(o.locked)
        self.time_s, self.level_db = o.samples.time_s[at], level[at]
        self.free_db = o.free_space_db[at]
        self.measured_db = o.samples.residual_db[at] + self.free_db
        self.detected = o.locked[at] == 1.0


def _learned(
    series: Sequence[Observed], fits: Mapping[str, Learned], pairs: Mapping[tuple[str, str], Learned]
) -> LearnedLock | None:
    """From all flights, scored flight by flight by what the others teach."""
    flights = [_Levels(o, fits[o.samples.flight]) for o in series]
    every = learn_detection([(f.level_db, f.detected) for f in flights])
    scores: list[DetectionScore] = []
    for o, item in zip(series, flights, strict=True):
        known = [(other, pairs.get((o.samples.flight, other.samples.flight))) for other in series]
        others = [_Levels(other, learned) for other, learned in known if learned is not None]
        from_others = learn_detection([(f.level_db, f.detected) for f in others])
        score = None if from_others is None else score_detection(
            item.time_s, item.measured_db, item.level_db, item.detected, floor_db=LOCK_FLOOR_DB,
            free_space_db=item.free_db, forecast=from_others,
        )  # fmt: skip
        if score is not None:
            scores.append(score)
    if every is None or not scores:
        return None

    names = ("brier", "constant_brier", "log_score", "constant_log_score", "rmse_db", "free_space_rmse_db")
    mean = {name: round(float(np.mean([getattr(score, name) for score in scores])), 4) for name in names}
    return LearnedLock(
        gain_db=round(every.level_db, 2),
        per_db=round(every.per_db, 4),
        share=round(every.share, 3),
        **_two_parts(flights, every.level_db),
        flights=len(scores),
        floor_db=LOCK_FLOOR_DB,
        floor_rmse_db=mean.pop("rmse_db"),
        free_space_floor_rmse_db=mean.pop("free_space_rmse_db"),
        **mean,
    )


# Of a receiver that always writes the same level without lock.
_LEAST_SD_DB = 0.5

# Width of the central 90 % of a normal distribution, over its standard deviation.
_CENTRAL = 3.29


def _two_parts(flights: Sequence[_Levels], gain_db: float) -> dict[str, float]:
    """Lines of the level over path gain in lock and without, and the spread about each."""
    numbers: dict[str, float] = {}
    for name, in_lock in (("locked", True), ("lost", False)):
        parts = [f.detected == in_lock for f in flights]
        each = [(f.level_db[at] - gain_db, f.measured_db[at]) for f, at in zip(flights, parts, strict=True) if at.any()]
        gain, level = (np.concatenate(values) for values in zip(*each, strict=True))
        alike = np.concatenate([np.full(len(g), len(g) ** -0.5) for g, _ in each])  # each flight of the same weight
        slope, middle = np.polyfit(gain, level, 1, w=alike)
        # in lock fades are rare and deep: the spread of the central 90 %, or the band of 90 % holds more
        central = np.mean([np.ptp(np.quantile(m - slope * g, (0.05, 0.95))) for g, m in each]) / _CENTRAL
        sd = central if in_lock else (level - middle - slope * gain).std()
        numbers |= {f"{name}_db": middle, f"{name}_per_db": slope, f"{name}_sd_db": max(sd, _LEAST_SD_DB)}
    return {name: round(float(value), 3) for name, value in numbers.items()}


def lock_words(lock: LearnedLock) -> str:
    """Sentences on P(lock), and on the level with a floor, from flights left out."""
    return (
        f"The predicted level gives the probability of lock with a Brier score of {lock.brier:.3f} on flights left out "
        f"(constant share of each flight: {lock.constant_brier:.3f}), log score {lock.log_score:.3f} "
        f"({lock.constant_log_score:.3f}). Where levels below {lock.floor_db:g} dB re full scale count as "
        f"{lock.floor_db:g}, the RMSE is {lock.floor_rmse_db:.1f} dB; free space: "
        f"{lock.free_space_floor_rmse_db:.1f} dB."
    )
