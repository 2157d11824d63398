"""The constant offset between a measurement and a simulation, and its uncertainty.

The offset is **added to the measurement**. Offsets on the grid are integers divided by ``1 / step``, so that rounding
errors do not accumulate. Of two equally good offsets, the smaller magnitude is used. An optimum at the edge of the
search range is flagged, because it indicates an error and is not a result.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..common.units import FloatArray, unmasked

# Search range of arXiv 2502.10324, section V [dB].
SPAN_DB = (-50.0, 50.0)

# Search step of arXiv 2502.10324, section V [dB].
STEP_DB = 0.1

# Largest number of offsets. A longer grid is the result of a wrong step or range, and would not fit in memory.
MAXIMUM_OFFSETS = 10_000_000

# Largest magnitude of a level that is used [dB]. Larger levels are clipped to this magnitude.
_LARGEST_DB = 1e150

# Distances that differ by less than this share of a step count as equal (0.15 is exactly between 0.1 and 0.2).
_TIE = 1e-9


@dataclass(frozen=True, slots=True)
class OffsetFit:
    """The best constant offset.

    Parameters
    ----------
    offset_db : float
        Offset to add to the measurement [dB]. NaN if there are no pairs.
    rmse_db : float
        Root mean square of ``measured + offset - simulated`` [dB]. NaN if there are no pairs.
    n : int
        Number of pairs with both sides finite.
    at_edge : bool
        True if the optimum is the first or last offset of the range, so that the true offset may be outside.
    """

    offset_db: float
    rmse_db: float
    n: int
    at_edge: bool


_NO_FIT = OffsetFit(float("nan"), float("nan"), 0, False)


def offset_grid(step_db: float = STEP_DB, span_db: tuple[float, float] = SPAN_DB) -> FloatArray:
    """Return the offsets to try [dB]: all multiples of ``step_db`` within ``span_db``, correctly rounded.

    Raises
    ------
    ValueError
        If the step is not positive, or no multiple is within the span.

    Examples
    --------
    >>> offset_grid()[[0, 499, 503, 1000]].tolist()
    [-50.0, -0.1, 0.3, 50.0]
    """
    low, high = span_db
    if not (step_db > 0 and np.isfinite([step_db, low, high]).all()):
        raise ValueError(f"offset step and span must be finite and the step positive, found {step_db}, {span_db}")
    if (high - low) / step_db > MAXIMUM_OFFSETS:
        raise ValueError(f"{(high - low) / step_db:.0e} offsets to try, at most {MAXIMUM_OFFSETS}")
    first = int(np.ceil(low / step_db - _TIE))
    last = int(np.floor(high / step_db + _TIE))
    if last < first:
        raise ValueError(f"no multiple of {step_db} dB lies between {low} and {high} dB")
    count = np.arange(first, last + 1, dtype=np.float64)
    per_db = 1.0 / step_db
    # divide, because 3 / 10 is exactly 0.3, and 3 * 0.1 is not
    integral = abs(per_db - round(per_db)) < 1e-9 * per_db and round(per_db) >= 1
    return count / round(per_db) if integral else count * step_db


def nearest_offset(grid_db: FloatArray, target_db: float, step_db: float = STEP_DB) -> int:
    """Return the index of the offset nearest to ``target_db``. Of equally near offsets, use the smaller magnitude."""
    # clip the target to the grid, because in float64 all offsets are equally far from 1e30
    distance = np.abs(grid_db - np.clip(target_db, grid_db[0], grid_db[-1]))
    near = np.flatnonzero(distance <= distance.min() + _TIE * step_db)
    return int(near[np.argmin(np.abs(grid_db[near]))])


@dataclass(frozen=True, slots=True, kw_only=True)
class Moments:
    """The number of pairs of a sequence, with mean [dB] and variance [dB^2] of simulated minus measured."""

    n: int
    mean_db: float
    variance_db2: float

    def rmse_db(self, offset_db: FloatArray) -> FloatArray:
        """Return the RMSE for each offset [dB]: RMSE^2(o) = variance + (mean - o)^2."""
        # hypot, because squaring a difference of 1e200 would overflow
        return np.asarray(np.hypot(np.sqrt(self.variance_db2), self.mean_db - offset_db))


def difference_moments(measured_db: ArrayLike, simulated_db: ArrayLike) -> Moments:
    """Return the moments of the pairs in which both levels are finite, NaN if there are no such pairs.

    Examples
    --------
    >>> difference_moments([-60.0, -70.0, float("nan")], [-57.0, -66.0, -1.0])
    Moments(n=2, mean_db=3.5, variance_db2=0.25)
    """
    measured, simulated = unmasked(measured_db), unmasked(simulated_db)
    if measured.shape != simulated.shape:
        raise ValueError(f"measured has shape {measured.shape}, simulated {simulated.shape}; expected the same")
    finite = np.isfinite(measured) & np.isfinite(simulated)
    if not finite.any():
        return Moments(n=0, mean_db=float("nan"), variance_db2=float("nan"))
    # clip, because sums and squares of +-1e308 would overflow; no real level is that large
    first, second = (np.clip(side[finite], -_LARGEST_DB, _LARGEST_DB) for side in (measured, simulated))
    values = second - first
    return Moments(n=len(values), mean_db=float(values.mean()), variance_db2=float(values.var()))


def grid_offset(
    measured_db: ArrayLike,
    simulated_db: ArrayLike,
    *,
    step_db: float = STEP_DB,
    span_db: tuple[float, float] = SPAN_DB,
) -> OffsetFit:
    """Find the offset with the lowest RMSE by grid search.

    Parameters
    ----------
    measured_db, simulated_db : array_like, same shape
        Levels [dB]. Pairs with a NaN or an infinity (no power) on either side are ignored.
    step_db : float
        Grid step [dB]. Offsets are integers divided by ``1 / step_db``.
    span_db : (low, high)
        First and last offset [dB].

    Returns
    -------
    OffsetFit
        The best offset, to be added to the measurement. Of two equally good offsets, the one with the smaller magnitude
        is used.

    Raises
    ------
    ValueError
        If the shapes differ or the grid is empty.

    Notes
    -----
    The best offset is the mean difference, rounded to the grid (:meth:`Moments.rmse_db`). Sums of squares of shifted
    levels would not be accurate enough to decide between two equally good offsets. Source: arXiv 2502.10324, section V.

    Examples
    --------
    >>> grid_offset([-60.0, -70.0, float("nan")], [-57.0, -66.9, -1.0])
    OffsetFit(offset_db=3.0, rmse_db=0.0707..., n=2, at_edge=False)
    """
    grid, moments = offset_grid(step_db, span_db), difference_moments(measured_db, simulated_db)
    if not moments.n:
        return _NO_FIT
    best = nearest_offset(grid, moments.mean_db, step_db)
    return OffsetFit(float(grid[best]), float(moments.rmse_db(grid[best])), moments.n, best in (0, len(grid) - 1))
