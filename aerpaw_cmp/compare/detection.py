"""A level that a receiver detects or loses: the probability of either, and the level with a floor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..common.units import BoolArray, FloatArray
from .forecast import brier_losses, constant_forecast, log_losses
from .offset import OffsetFit, offset_grid
from .receiver import out_of_group

SEGMENTS = 10
"""Held-out segments of a flight, equally long."""

_PENALTY = 1.0
_FEWEST = 50
"""Samples of either kind that a score needs."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectionScore:
    """Score of a log whose receiver loses its lock, or ends at a floor.

    Parameters
    ----------
    floor_db : float
        Lower levels count as this one [unit of the measurement].
    n, n_detected : int
    brier, constant_brier, log_score, constant_log_score : float
        Of P(detected) from the predicted level, in held-out segments; constant: the share in the other segments.
        Brier counts one of the two outcomes: 0 to 1. Log score in nat.
    offset_db, rmse_db : float
        All samples, both sides no lower than the floor; the offset is added to the measurement.
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
    detected_rmse_db: float
    reliability: tuple[tuple[float, float, int], ...]


def score_detection(
    time_s: FloatArray,
    measured_db: FloatArray,
    simulated_db: FloatArray,
    detected: BoolArray,
    *,
    floor_db: float,
    span_db: tuple[float, float],
    step_db: float,
) -> DetectionScore | None:
    """Score of a log in two parts; None where either outcome is rare.

    Parameters
    ----------
    time_s : (n,)
    measured_db, simulated_db : (n,)
        Measured NaN: below the floor. Samples without a simulated level take no part.
    detected : (n,) bool
    floor_db, span_db, step_db : float
        Floor of the measurement; grid of the offset.

    Returns
    -------
    DetectionScore or None
    """
    known = np.isfinite(simulated_db) & np.isfinite(time_s)
    time, simulated, detected = time_s[known], simulated_db[known], detected[known]
    measured = np.maximum(np.nan_to_num(measured_db[known], nan=floor_db), floor_db)
    if min(int(detected.sum()), int((~detected).sum())) < _FEWEST:
        return None
    segment = np.minimum((time - time.min()) / max(np.ptp(time), 1e-9) * SEGMENTS, SEGMENTS - 1).astype(np.int64)
    outcome = detected.astype(np.int64) + 1
    said = out_of_group(simulated[:, None], outcome, segment, _PENALTY)[:, :2]
    said = said / said.sum(axis=1, keepdims=True)  # two outcomes of the four that a receiver of ranks knows
    constant = np.zeros_like(said)
    for one in np.unique(segment):
        constant[segment == one] = constant_forecast(outcome[segment != one], 2)
    fit = floored_offset(measured, simulated, floor_db=floor_db, span_db=span_db, step_db=step_db)
    residual = measured - np.maximum(simulated - fit.offset_db, floor_db)
    return DetectionScore(
        floor_db=floor_db,
        n=len(time),
        n_detected=int(detected.sum()),
        brier=float(brier_losses(said, outcome).mean()) / 2.0,
        constant_brier=float(brier_losses(constant, outcome).mean()) / 2.0,
        log_score=float(log_losses(said, outcome).mean()),
        constant_log_score=float(log_losses(constant, outcome).mean()),
        offset_db=fit.offset_db,
        rmse_db=fit.rmse_db,
        detected_rmse_db=float(np.sqrt(np.mean(residual[detected] ** 2))),
        reliability=_reliability(said[:, 1], detected),
    )


def floored_offset(
    measured_db: FloatArray,
    simulated_db: FloatArray,
    *,
    floor_db: float,
    span_db: tuple[float, float],
    step_db: float,
) -> OffsetFit:
    """Offset of least RMSE where both sides count as no lower than the floor.

    Parameters
    ----------
    measured_db, simulated_db : (n,)
        Finite pairs [dB]; the measurement no lower than the floor.
    floor_db, span_db, step_db : float

    Returns
    -------
    OffsetFit
        The offset is added to the measurement.
    """
    grid = offset_grid(step_db, span_db)
    order = np.argsort(simulated_db)
    simulated, measured = simulated_db[order], measured_db[order]
    # below the floor a prediction counts as the floor: the first k of the order, the others move with the offset
    low = np.concatenate([[0.0], np.cumsum((measured - floor_db) ** 2)])
    difference = simulated - measured
    first, second = (np.concatenate([[0.0], np.cumsum(difference**power)]) for power in (1, 2))
    k = np.searchsorted(simulated, grid + floor_db, side="right")
    n = len(measured)
    above = (second[n] - second[k]) - 2.0 * grid * (first[n] - first[k]) + (n - k) * grid**2
    mse = np.maximum(low[k] + above, 0.0) / n
    best = int(mse.argmin())
    return OffsetFit(float(grid[best]), float(np.sqrt(mse[best])), n, best in (0, len(grid) - 1))


def _reliability(said: FloatArray, detected: BoolArray) -> tuple[tuple[float, float, int], ...]:
    fifth = np.minimum((said * 5.0).astype(np.int64), 4)
    groups = [fifth == i for i in range(5)]
    return tuple((float(said[g].mean()), float(detected[g].mean()), int(g.sum())) for g in groups if g.any())


BASE_S = 0.032768
"""Between two values of AERPAW's sounder [s]: 4095 chips and the rest of its correlation."""

_BETTER = 0.1
"""Correlation that the sounder's own time base must add before it is taken."""


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
    own = np.arange(len(time_s)) * BASE_S + time_s[0]
    moved = np.interp(time_s, own, quality_db, right=np.nan)
    shift = float(np.abs(own - time_s).max())
    known = np.isfinite(moved) & np.isfinite(power_db) & np.isfinite(quality_db)
    if shift < 2.0 or known.sum() < _FEWEST:
        return quality_db, 0.0
    paired, based = (float(np.corrcoef(power_db[known], q[known])[0, 1]) for q in (quality_db, moved))
    return (moved, shift) if based > paired + _BETTER else (quality_db, 0.0)
