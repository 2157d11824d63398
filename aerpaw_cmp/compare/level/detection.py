"""A level that a receiver detects or loses: the probability of either, and the level with a floor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...common.units import BoolArray, FloatArray, IntArray
from ..offset import OffsetFit, offset_grid
from ..ranks.forecast import brier_losses, log_losses
from ..ranks.receiver import out_of_group
from ..statistics.intervals import NO_INTERVAL, Interval, rmse_interval

# Held-out segments of a flight, equally long.
_SEGMENTS = 10

_PENALTY = 1.0
_SPAN_DB = 60.0
# Samples of either kind that a score needs.
_FEWEST = 50


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectionForecast:
    """P(detected) of a predicted level, learned on flights: logistic in the level.

    Parameters
    ----------
    level_db : float
        Predicted level at which half of the samples are detected.
    per_db : float
        Slope of the log odds.
    share : float
        Of detected samples, mean over the flights: the forecast of who knows no level.
    """

    level_db: float
    per_db: float
    share: float

    def probability(self, level_db: FloatArray) -> FloatArray:
        """P(detected) (n,) at predicted levels (n,) [dB]."""
        from scipy.special import expit

        return np.asarray(expit(self.per_db * (level_db - self.level_db)))


def learn_detection(flights: Sequence[tuple[FloatArray, BoolArray]]) -> DetectionForecast | None:
    """P(detected) of predicted levels, each flight of the same weight; None where either outcome is rare.

    Parameters
    ----------
    flights : sequence of ((n,), (n,))
        Predicted levels [dB], finite, and which samples were detected.

    Returns
    -------
    DetectionForecast or None
        None, too, where the detected samples do not have the higher levels.
    """
    from scipy.optimize import minimize

    flights = [flight for flight in flights if len(flight[0])]
    detected = np.concatenate([np.zeros(0, dtype=np.bool_), *(locked for _, locked in flights)])
    if min(int(detected.sum()), int((~detected).sum())) < _FEWEST:
        return None
    level = np.concatenate([each for each, _ in flights])
    weight = np.concatenate([np.full(len(each), 1.0 / len(each)) for each, _ in flights])
    centre, scale = float(level.mean()), max(float(level.std()), 1e-9)
    unit = (level - centre) / scale

    def loss(c: FloatArray) -> tuple[float, FloatArray]:
        odds = c[0] + c[1] * unit
        over = DetectionForecast(level_db=0.0, per_db=1.0, share=0.0).probability(odds) - detected
        # a small ridge: where a level parts the outcomes exactly, no slope is steep enough
        value = (weight * (np.logaddexp(0.0, odds) - detected * odds)).sum() + 1e-3 * c[1] ** 2
        return float(value), np.array([(weight * over).sum(), (weight * over * unit).sum() + 2e-3 * c[1]])

    constant, slope = minimize(loss, np.zeros(2), jac=True).x
    if slope <= 0.0:
        return None
    share = float(np.mean([locked.mean() for _, locked in flights]))
    return DetectionForecast(
        level_db=centre - scale * float(constant / slope), per_db=float(slope) / scale, share=share
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectionScore:
    """Score of a log whose receiver loses its lock, or ends at a floor.

    Parameters
    ----------
    floor_db : float
        Lower levels count as this one [unit of the measurement].
    n, n_detected : int
    brier, constant_brier, log_score, constant_log_score : float
        Of P(detected) from the predicted level; constant: this flight's own share, the best that knows no level. Brier
        counts one of the two outcomes: 0 to 1. Log score in nat.
    learned_on : str
        ``other flights``, or ``held-out segments``: each segment of this flight from the others.
    offset_db, rmse_db : float
        All samples, both sides no lower than the floor; the offset is added to the measurement.
    rmse_ci95_db : (low, high)
        Of ``rmse_db``, as other levels have it.
    free_space_rmse_db : float
        The same of free space.
    detected_rmse_db : float
        Of the detected samples alone, at that offset. They are selected by their level: never to be given alone.
    reliability : tuple of (float, float, int)
        Mean probability, share detected and samples, in fifths of the probability.
    """

    floor_db: float
    n: int
    n_detected: int
    brier: float
    constant_brier: float
    log_score: float
    constant_log_score: float
    offset_db: float
    rmse_db: float
    free_space_rmse_db: float
    detected_rmse_db: float
    reliability: tuple[tuple[float, float, int], ...]
    learned_on: str
    rmse_ci95_db: Interval = NO_INTERVAL
    locks: bool = False
    """The log itself says when the receiver was in lock; else a sample without a level was not detected."""


def score_detection(
    time_s: FloatArray,
    measured_db: FloatArray,
    simulated_db: FloatArray,
    detected: BoolArray,
    *,
    floor_db: float,
    free_space_db: FloatArray,
    forecast: DetectionForecast | None = None,
) -> DetectionScore | None:
    """Score of a log in two parts; None where either outcome is rare.

    Parameters
    ----------
    time_s : (n,)
    measured_db, simulated_db : (n,)
        Measured NaN: below the floor. Samples without a simulated level take no part.
    detected : (n,) bool
    floor_db : float
        Floor of the measurement.
    free_space_db : (n,)
        Level of free space, for comparison.
    forecast : DetectionForecast, optional
        Learned on other flights, of ``simulated_db``; without, each segment is forecast from the others.

    Returns
    -------
    DetectionScore or None
    """
    finite = np.isfinite(simulated_db) & np.isfinite(time_s)
    time, simulated, detected = time_s[finite], simulated_db[finite], detected[finite]
    measured = np.maximum(np.nan_to_num(measured_db[finite], nan=floor_db), floor_db)
    if min(int(detected.sum()), int((~detected).sum())) < _FEWEST:
        return None
    # as ranks 1 and 2: the regression of ranks serves here, too
    outcome = detected.astype(np.int64) + 1
    if forecast is None:
        stated = _held_out(time, simulated, outcome)
    else:
        stated = np.stack([1.0 - (p := forecast.probability(simulated)), p], axis=1)
    constant = np.tile([1.0 - detected.mean(), detected.mean()], (len(time), 1))
    fit = floored_fit(measured, simulated, floor_db)
    residual = measured - np.maximum(simulated - fit.offset_db, floor_db)
    return DetectionScore(
        floor_db=floor_db,
        n=len(time),
        n_detected=int(detected.sum()),
        brier=float(brier_losses(stated, outcome).mean()) / 2.0,
        constant_brier=float(brier_losses(constant, outcome).mean()) / 2.0,
        log_score=float(log_losses(stated, outcome).mean()),
        constant_log_score=float(log_losses(constant, outcome).mean()),
        offset_db=fit.offset_db,
        rmse_db=fit.rmse_db,
        rmse_ci95_db=rmse_interval(residual[np.argsort(time, kind="stable")], fit.rmse_db),
        free_space_rmse_db=floored_fit(measured, free_space_db[finite], floor_db).rmse_db,
        detected_rmse_db=float(np.sqrt(np.mean(residual[detected] ** 2))),
        reliability=_reliability(stated[:, 1], detected),
        learned_on="held-out segments" if forecast is None else "other flights",
    )


def _held_out(time_s: FloatArray, level_db: FloatArray, outcome: IntArray) -> FloatArray:
    """Probabilities (n, 2) of each segment by the level, learned in the others."""
    segment = np.minimum((time_s - time_s.min()) / max(np.ptp(time_s), 1e-9) * _SEGMENTS, _SEGMENTS - 1).astype(
        np.int64
    )
    stated = out_of_group(level_db[:, None], outcome, segment, _PENALTY)[:, :2]
    # two outcomes of the four that a receiver of ranks knows
    return np.asarray(stated / stated.sum(axis=1, keepdims=True))


def floored_fit(measured_db: FloatArray, simulated_db: FloatArray, floor_db: float) -> OffsetFit:
    """Offset of least RMSE where both sides count as no lower than the floor; pairs (n,) with a NaN do not count.

    It is added to the measurement, and lies within 60 dB of the median above the floor.
    """
    finite = np.isfinite(measured_db) & np.isfinite(simulated_db)
    order = np.flatnonzero(finite)[np.argsort(simulated_db[finite])]
    measured, simulated = np.maximum(measured_db[order], floor_db), simulated_db[order]
    above = measured > floor_db
    middle = float(np.median((simulated - measured)[above])) if above.any() else 0.0
    grid = offset_grid(span_db=(middle - _SPAN_DB, middle + _SPAN_DB))
    # below the floor a prediction counts as the floor: the first k of the order, the others move with the offset
    low = np.concatenate([[0.0], np.cumsum((measured - floor_db) ** 2)])
    difference = simulated - measured
    first, second = (np.concatenate([[0.0], np.cumsum(difference**power)]) for power in (1, 2))
    k = np.searchsorted(simulated, grid + floor_db, side="right")
    n = len(measured)
    moved = (second[n] - second[k]) - 2.0 * grid * (first[n] - first[k]) + (n - k) * grid**2
    # differences of large sums may fall a little below 0
    mse = np.maximum(low[k] + moved, 0.0) / n
    best = int(mse.argmin())
    return OffsetFit(float(grid[best]), float(np.sqrt(mse[best])), n, best in (0, len(grid) - 1))


def _reliability(stated: FloatArray, detected: BoolArray) -> tuple[tuple[float, float, int], ...]:
    fifth = np.minimum((stated * 5.0).astype(np.int64), 4)
    groups = [fifth == i for i in range(5)]
    return tuple((float(stated[g].mean()), float(detected[g].mean()), int(g.sum())) for g in groups if g.any())


# Between two values of AERPAW's sounder [s]: 4095 chips and the rest of its correlation.
BASE_S = 0.032768

# Correlation that the sounder's own time base must add before it is taken.
_BETTER = 0.1


def aligned_quality(time_s: FloatArray, power_db: FloatArray, quality_db: FloatArray) -> tuple[FloatArray, float]:
    """Quality at the times of the power where a merged table paired them by row.

    Rows were dropped from the power when it was merged with the telemetry, not from the quality: row i then holds the
    quality of :data:`BASE_S` * i after the first.

    Parameters
    ----------
    time_s, power_db, quality_db : (n,)
        Of one table.

    Returns
    -------
    (n,), float
        Quality, NaN where none is left, and the largest shift [s]; 0 where the rows are paired in time.
    """
    base_s = np.arange(len(time_s)) * BASE_S + time_s[0]
    moved = np.interp(time_s, base_s, quality_db, right=np.nan)
    shift = float(np.abs(base_s - time_s).max())
    finite = np.isfinite(moved) & np.isfinite(power_db) & np.isfinite(quality_db)
    if shift < 2.0 or finite.sum() < _FEWEST:
        return quality_db, 0.0
    paired, based = (float(np.corrcoef(power_db[finite], q[finite])[0, 1]) for q in (quality_db, moved))
    return (moved, shift) if based > paired + _BETTER else (quality_db, 0.0)
