"""The one constant between a measurement and a simulation, and what is known about it.

The offset is **added to the measurement**. Its grid is integers over ``1 / step`` (never accumulated floats),
a tie goes to the offset nearer zero, and an optimum at the edge of the span is flagged: it is an error to look
at, not a result.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..units import FloatArray

SPAN_DB = (-50.0, 50.0)
"""Search span of arXiv 2502.10324, section V [dB]."""

STEP_DB = 0.1
"""Search step of arXiv 2502.10324, section V [dB]."""

_TIE = 1e-9
"""Distances that differ by less than this share of a step are ties (0.15 lies between 0.1 and 0.2)."""


@dataclass(frozen=True, slots=True)
class OffsetFit:
    """Best constant offset.

    Parameters
    ----------
    offset_db : float
        To be added to the measurement [dB]; NaN without a pair.
    rmse_db : float
        Root mean square of ``measured + offset - simulated`` [dB]; NaN without a pair.
    n : int
        Pairs that count (both sides finite).
    at_edge : bool
        The optimum is the first or last offset of the span: the true one may lie outside.
    """

    offset_db: float
    rmse_db: float
    n: int
    at_edge: bool


@dataclass(frozen=True, slots=True)
class CensoredFit:
    """Offset from a Tobit likelihood, where "below" is an observation too.

    Parameters
    ----------
    offset_db, sigma_db : float
        Offset added to the measurement and standard deviation of the residual [dB].
    n, n_measured_below, n_simulated_below, n_both_below : int
        Full pairs; pairs with only the measurement, only the simulation, and both below their floors.
    at_edge : bool
        As in :class:`OffsetFit`.
    """

    offset_db: float
    sigma_db: float
    n: int
    n_measured_below: int
    n_simulated_below: int
    n_both_below: int
    at_edge: bool


def offset_grid(step_db: float = STEP_DB, span_db: tuple[float, float] = SPAN_DB) -> FloatArray:
    """Offsets to try [dB]: the multiples of ``step_db`` inside ``span_db``, each correctly rounded.

    Raises
    ------
    ValueError
        If the step is not positive or no multiple lies inside the span.

    Examples
    --------
    >>> offset_grid()[[0, 499, 503, 1000]].tolist()
    [-50.0, -0.1, 0.3, 50.0]
    """
    low, high = span_db
    if not (step_db > 0 and np.isfinite([step_db, low, high]).all()):
        raise ValueError(f"offset step and span must be finite and the step positive, found {step_db}, {span_db}")
    first = int(np.ceil(low / step_db - _TIE))
    last = int(np.floor(high / step_db + _TIE))
    if last < first:
        raise ValueError(f"no multiple of {step_db} dB lies between {low} and {high} dB")
    count = np.arange(first, last + 1, dtype=np.float64)
    per_db = 1.0 / step_db
    # 3 / 10 is 0.3; 3 * 0.1 is not
    whole = abs(per_db - round(per_db)) < 1e-9 * per_db and round(per_db) >= 1
    return count / round(per_db) if whole else count * step_db


def nearest_offset(grid_db: FloatArray, target_db: float, step_db: float = STEP_DB) -> int:
    """Index of the offset nearest to ``target_db``; a tie goes to the one nearer zero."""
    distance = np.abs(grid_db - target_db)
    near = np.flatnonzero(distance <= distance.min() + _TIE * step_db)
    return int(near[np.argmin(np.abs(grid_db[near]))])


def _difference(measured_db: ArrayLike, simulated_db: ArrayLike) -> FloatArray:
    """Simulated minus measured over the pairs that count [dB], flat."""
    measured = np.asarray(measured_db, dtype=np.float64)
    simulated = np.asarray(simulated_db, dtype=np.float64)
    if measured.shape != simulated.shape:
        raise ValueError(f"measured has shape {measured.shape}, simulated {simulated.shape}: they must be pairs")
    ok = np.isfinite(measured) & np.isfinite(simulated)
    return np.asarray(simulated[ok] - measured[ok])


def _mean_and_variance(values: FloatArray) -> tuple[float, float]:
    mean = float(values.mean())
    return mean, float(np.mean((values - mean) ** 2))


def grid_offset(
    measured_db: ArrayLike,
    simulated_db: ArrayLike,
    *,
    step_db: float = STEP_DB,
    span_db: tuple[float, float] = SPAN_DB,
) -> OffsetFit:
    """Offset of least RMSE by grid search.

    Parameters
    ----------
    measured_db, simulated_db : array_like, same shape
        Levels [dB]. Pairs with a NaN (or an infinity: no power) on either side do not count.
    step_db : float
        Grid step [dB]; the offsets are integers over ``1 / step_db``.
    span_db : (low, high)
        First and last offset [dB].

    Returns
    -------
    OffsetFit
        The offset is added to the measurement; ties go to the offset nearer zero.

    Raises
    ------
    ValueError
        If the shapes differ or the grid is empty.

    Notes
    -----
    RMSE^2(o) = variance + (mean difference - o)^2, evaluated in that form on the whole grid: sums of squares of
    offset levels would lose the digits that decide a tie. Source: arXiv 2502.10324, section V.

    Examples
    --------
    >>> grid_offset([-60.0, -70.0, float("nan")], [-57.0, -66.9, -1.0])
    OffsetFit(offset_db=3.0, rmse_db=0.0707..., n=2, at_edge=False)
    """
    grid = offset_grid(step_db, span_db)
    difference = _difference(measured_db, simulated_db)
    if not len(difference):
        return OffsetFit(float("nan"), float("nan"), 0, False)
    mean, variance = _mean_and_variance(difference)
    best = nearest_offset(grid, mean, step_db)
    rmse = float(np.sqrt(variance + (mean - grid[best]) ** 2))
    return OffsetFit(float(grid[best]), rmse, len(difference), best in (0, len(grid) - 1))
