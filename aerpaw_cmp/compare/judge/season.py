"""Results of a season of flights: offsets from other flights, differences between settings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from ...common.units import FloatArray, unmasked
from ..offset import SPAN_DB, nearest_offset, offset_grid
from ..statistics.intervals import autocorrelation

# Fewer flights than this give no interval of a mean over flights.
FEWEST_FLIGHTS = 3

# From so many flights on, how alike neighbouring flights are is estimated and counted.
_MANY_FLIGHTS = 20

Verdict = Literal["first", "worse", "not significant", "no interval"]


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
    :func:`~aerpaw_cmp.compare.statistics.intervals.autocorrelation`, so that a season that drifts has no narrower
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


def verdict_of(difference: MeanOfFlights) -> Verdict:
    """Check whether a setting is shown to be worse than the first."""
    if not np.isfinite(difference.low):
        return "no interval"
    return "worse" if difference.low > 0 else "not significant"
