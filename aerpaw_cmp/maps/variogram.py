"""Similarity of the channel at two positions: correlation against distance.

Three correlations, all averaged over pairs of positions in bins of distance:

- :func:`vector_correlation`: the paper's (arXiv 2502.10324, section VI-A). Each position carries the vector of its
  ranks over all altitudes and K; Pearson correlation of two vectors. It mixes horizontal and vertical.
- :func:`field_correlation`: horizontal only. Each field (one altitude, one K) is standardised over the positions,
  and the mean product of two positions is taken.
- :func:`vertical_correlation`: vertical only. Pearson correlation over the positions of two altitudes' maps.

All three serve RSS as well as rank. NaN is out of coverage; whether a rank of 0 is a number or NaN is the caller's
choice.

The curve through it, :func:`fit_biexponential`, lives in :mod:`~aerpaw_cmp.maps.biexponential`.

Bins follow the paper: bin ``n`` holds the pairs whose distance is nearest to ``n`` times the width (half-way goes
up); bin 0 holds each position with itself, where the correlation is 1 by definition.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..common.errors import UsageError, from_python
from ..common.units import BoolArray, FloatArray, IntArray, unmasked
from .biexponential import PAPER_BIEXPONENTIAL as PAPER_BIEXPONENTIAL
from .biexponential import BiExponential as BiExponential
from .biexponential import fit_biexponential as fit_biexponential

# Positions per block of the pair products; bounds the memory to BLOCK x positions.
BLOCK = 256

# Bins as wide as d_rx (section VI-A), and distances up to 500 m (section VII-C).
_PAPER_WIDTH_M = 30.0
_PAPER_MAXIMUM_M = 500.0
# The paper's step between altitudes.
_HEIGHT_BIN_M = 10.0
# Fewest components that a pair of positions must share where some are missing.
# Of two any pair correlates by plus or minus 1.
_MINIMUM_COMMON = 3


@dataclass(frozen=True, slots=True)
class BinnedCorrelation:
    """Correlation (or semivariance) against distance.

    Source: arXiv 2502.10324 eq. 11; arXiv 2502.10324 eq. 12; arXiv 2502.10324 eq. 13.

    Parameters
    ----------
    distance_m : (bins,)
        Nominal distance of each bin: whole multiples of the width.
    mean_distance_m : (bins,)
        Mean distance of its pairs.
    correlation : (bins,)
        Mean over the pairs; NaN in a bin without any.
    pairs : (bins,) int
        Number of pairs; a position with itself counts once.
    positions : int
        Positions that took part.
    excluded_constant : int
        Positions (or fields) left out because all their values are equal: their correlation is undefined.
    """

    distance_m: FloatArray
    mean_distance_m: FloatArray
    correlation: FloatArray
    pairs: IntArray
    positions: int
    excluded_constant: int


def vector_correlation(
    points_m: ArrayLike,
    vectors: ArrayLike,
    *,
    width_m: float = _PAPER_WIDTH_M,
    maximum_m: float = _PAPER_MAXIMUM_M,
) -> BinnedCorrelation:
    """Pearson correlation of the positions' vectors, binned by horizontal distance (the paper's Steps 1 to 4).

    Source: arXiv 2502.10324 eq. 9; arXiv 2502.10324 eq. 10.

    Parameters
    ----------
    points_m : (n, 2+)
        East, north [m].
    vectors : (n, ...)
        Rank or RSS over altitudes and K, flattened per position; of NaN a pair uses the components that both have.
    width_m, maximum_m : float
        Bin width (the paper's d_rx) and the largest distance [m].

    Returns
    -------
    BinnedCorrelation
    """
    points, data = _points_and_vectors(points_m, vectors)
    present = np.isfinite(data)
    lacking = present.sum(axis=1) < _MINIMUM_COMMON
    constant = ~lacking & _is_constant(data, present)
    varying = ~(lacking | constant)
    if present[varying].all():
        # without gaps one product of unit vectors gives all correlations of a block
        unit = data[varying] - data[varying].mean(axis=1, keepdims=True)
        unit /= np.sqrt((unit**2).sum(axis=1, keepdims=True))
        bins = _bin_pairs(
            points[varying], lambda rows, columns: np.clip(unit[rows] @ unit[columns].T, -1.0, 1.0), width_m, maximum_m
        )
    else:
        bins = _bin_pairs(points[varying], _PairwisePearson(data[varying], _MINIMUM_COMMON), width_m, maximum_m)
    return BinnedCorrelation(*bins, int(varying.sum()), int(constant.sum()))


def field_correlation(
    points_m: ArrayLike, fields: ArrayLike, *, width_m: float = _PAPER_WIDTH_M, maximum_m: float = _PAPER_MAXIMUM_M
) -> BinnedCorrelation:
    """Horizontal correlation of fields (n, ...), each standardised over the positions; mean over pairs and fields.

    NaN values take no part; a pair counts once, with the mean over the fields that both positions have. Fields that
    are constant or have fewer than two values are left out and counted.

    Parameters
    ----------
    points_m : array_like, (n, 2) or (n, 3)
        Distances are horizontal.
    fields : array_like, (n, ...)
        Values at the positions, NaN unknown.
    width_m, maximum_m : float
        Width of the bins of distance, and the largest distance.

    Returns
    -------
    BinnedCorrelation
    """
    points, data = _points_and_vectors(points_m, fields)
    present = np.isfinite(data)
    lacking = present.sum(axis=0) < 2
    constant = ~lacking & _is_constant(data.T, present.T)
    varying = ~(lacking | constant)
    data, present = data[:, varying], present[:, varying]
    count = present.sum(axis=0)
    filled = np.where(present, data, 0.0)
    centred = np.where(present, data - filled.sum(axis=0) / np.maximum(count, 1), 0.0)
    scaled = centred / np.sqrt((centred**2).sum(axis=0) / np.maximum(count, 1))
    bins = _bin_pairs(points, _mean_product(scaled, present), width_m, maximum_m)
    return BinnedCorrelation(*bins, int(present.any(axis=1).sum()), int(constant.sum()))


def vertical_correlation(altitudes_m: ArrayLike, maps: ArrayLike) -> BinnedCorrelation:
    """Correlation of the maps of two altitudes, binned by their difference in height.

    Parameters
    ----------
    altitudes_m : (altitudes,)
        Heights [m].
    maps : (altitudes, n) or (altitudes, fields, n)
        Rank or RSS at the same positions; a field is one K. The Pearson correlation of a pair of altitudes is taken
        over the positions that both have, per field, and averaged over the fields.

    Returns
    -------
    BinnedCorrelation
        ``positions`` counts altitudes, ``pairs`` pairs of altitudes and fields; constant maps are left out, counted.
    """
    altitudes = unmasked(altitudes_m)
    data = unmasked(maps)
    if data.ndim == 2:
        data = data[:, None, :]
    if data.ndim != 3 or len(data) != len(altitudes):
        raise UsageError(f"maps of shape {data.shape} for {len(altitudes)} altitudes")
    levels, fields, _ = data.shape
    first, second = np.triu_indices(levels)
    gap = np.abs(altitudes[first] - altitudes[second])
    value = np.empty((len(first), fields))
    excluded = 0
    for field in range(fields):
        rows = data[:, field]
        present = np.isfinite(rows)
        usable = (present.sum(axis=1) >= 2) & ~_is_constant(rows, present)
        excluded += int((~usable).sum())
        table = _PairwisePearson(np.where(usable[:, None], rows, np.nan), 2)(np.arange(levels), np.arange(levels))
        value[:, field] = table[first, second]
    # half-way goes up, as in every bin
    n = int(np.floor(gap.max(initial=0.0) / _HEIGHT_BIN_M + 0.5)) + 1
    sums = _Sums(n, _HEIGHT_BIN_M)
    sums.add(np.repeat(gap, fields), value.ravel())
    return BinnedCorrelation(*sums.means(), levels, excluded)


# --- pairs ----------------------------------------------------------------------------------------------------------

# Value of each pair of two sets of positions: (rows,), (columns,) -> (rows, columns); NaN where undefined.
Block = Callable[[IntArray, IntArray], FloatArray]


@from_python
class Variogram:
    """Correlation of a field against horizontal distance, binned and fitted.

    Parameters
    ----------
    width_m, maximum_m : float
        Bins of the distance.

    Attributes
    ----------
    binned_ : BinnedCorrelation
        What :func:`field_correlation` gives for the samples.
    model_ : BiExponential
        The curve through it; callable on distances.

    Notes
    -----
    ``gamma(d) = v^2 (1 - Phi(d))`` with ``Phi(d) = c1 exp(c2 d) + c3 exp(c4 d)`` (arXiv 2502.10324, section VI).
    :class:`~aerpaw_cmp.maps.kriging.OrdinaryKriging` takes a fitted one as its correlation.

    Examples
    --------
    >>> points = np.stack(np.meshgrid(np.arange(20.0), np.arange(20.0)), axis=-1).reshape(-1, 2) * 30.0
    >>> variogram = Variogram().fit(points, np.sin(points[:, 0] / 200.0))
    >>> bool(1.0 >= variogram(0.0) > variogram(60.0) > variogram(300.0) >= 0.0)
    True
    """

    def __init__(self, width_m: float = _PAPER_WIDTH_M, maximum_m: float = _PAPER_MAXIMUM_M) -> None:
        self.width_m = width_m
        self.maximum_m = maximum_m

    def fit(self, points_m: ArrayLike, values: ArrayLike) -> Variogram:
        """Bin and fit samples (n,) or (n, fields) at points (n, 2) [m].

        Raises
        ------
        UsageError
            Fewer than the samples or bins that a fit needs.
        """
        self.binned_ = field_correlation(points_m, values, width_m=self.width_m, maximum_m=self.maximum_m)
        pairs = np.isfinite(self.binned_.correlation)
        # at the mean distance of a bin's pairs: on a grid it lies up to a fifth of the width beyond the bin's middle
        self.model_ = fit_biexponential(self.binned_.mean_distance_m[pairs], self.binned_.correlation[pairs])
        return self

    def __call__(self, distance_m: ArrayLike) -> FloatArray:
        """Fitted correlation at distances [m]."""
        return self.model_(distance_m)


class _PairwisePearson:
    """Pearson correlation over the components that both vectors have, by matrix products of masked vectors."""

    def __init__(self, data: FloatArray, minimum_common: int) -> None:
        self.present = np.isfinite(data).astype(np.float64)
        count = self.present.sum(axis=1, keepdims=True)
        filled = np.where(self.present > 0, data, 0.0)
        # centred on each vector's own mean first: the sums below must not cancel
        mean = filled.sum(axis=1, keepdims=True) / np.maximum(count, 1)
        self.value = np.where(self.present > 0, data - mean, 0.0)
        self.square = self.value**2
        self.minimum_common = minimum_common

    def __call__(self, rows: IntArray, columns: IntArray) -> FloatArray:
        mine, theirs = self.present[rows], self.present[columns].T
        x, y = self.value[rows], self.value[columns].T
        n = mine @ theirs
        safe = np.maximum(n, 1.0)
        sum_x, sum_y = x @ theirs, mine @ y
        square_x, square_y = self.square[rows] @ theirs, mine @ self.square[columns].T
        vary_x = square_x - sum_x**2 / safe
        vary_y = square_y - sum_y**2 / safe
        covary = x @ y - sum_x * sum_y / safe
        # a variance this small beside the squares it is a difference of is their rounding
        good = (n >= self.minimum_common) & (vary_x > 1e-12 * square_x) & (vary_y > 1e-12 * square_y)
        scale = np.sqrt(np.where(good, vary_x * vary_y, 1.0))
        # rounding takes equal vectors beyond 1
        return np.where(good, np.clip(covary / scale, -1.0, 1.0), np.nan)


def _mean_product(scaled: FloatArray, present: BoolArray) -> Block:
    """Mean product of standardised fields that both positions have."""
    known, complete = present.astype(np.float64), bool(present.all())

    def of(rows: IntArray, columns: IntArray) -> FloatArray:
        product = scaled[rows] @ scaled[columns].T
        if complete and scaled.shape[1]:
            return np.asarray(product / scaled.shape[1])
        common = known[rows] @ known[columns].T
        return np.where(common > 0, product / np.maximum(common, 1.0), np.nan)

    return of


class _Sums:
    """Sums per bin that grow block by block."""

    def __init__(self, bins: int, width_m: float) -> None:
        self.width_m = width_m
        self.value, self.distance = np.zeros(bins), np.zeros(bins)
        self.pairs = np.zeros(bins, dtype=np.int64)

    def add(self, distance_m: FloatArray, value: FloatArray) -> None:
        # a grid distance such as sqrt(2) * 30 must not change its bin by rounding
        number = np.floor(np.round(distance_m / self.width_m, 9) + 0.5).astype(np.int64)
        good = (number < len(self.pairs)) & np.isfinite(value)
        number, distance_m, value = number[good], distance_m[good], value[good]
        self.value += np.bincount(number, value, len(self.pairs))
        self.distance += np.bincount(number, distance_m, len(self.pairs))
        self.pairs += np.bincount(number, minlength=len(self.pairs))

    def means(self) -> tuple[FloatArray, FloatArray, FloatArray, IntArray]:
        some = np.maximum(self.pairs, 1)
        empty = self.pairs == 0
        nominal = self.width_m * np.arange(len(self.pairs))
        return (
            np.asarray(nominal, dtype=np.float64),
            np.asarray(np.where(empty, np.nan, self.distance / some)),
            np.asarray(np.where(empty, np.nan, self.value / some)),
            self.pairs,
        )


def _bin_pairs(
    points: FloatArray, value_of: Block, width_m: float, maximum_m: float
) -> tuple[FloatArray, FloatArray, FloatArray, IntArray]:
    """Bin means over all pairs i <= j up to ``maximum_m``, in blocks."""
    if not (width_m > 0 and maximum_m >= width_m and np.isfinite(maximum_m)):
        raise UsageError(f"bins of {width_m} m up to {maximum_m} m", expected="0 < width <= maximum, both finite")
    sums = _Sums(int(np.floor(maximum_m / width_m + 1e-9)) + 1, width_m)
    # half a bin beyond the last one's middle; the micrometre lets in pairs at exactly that distance
    reach = min(maximum_m, width_m * (len(sums.pairs) - 0.5)) + 1e-6
    for rows, columns in _blocks_within(points, reach):
        distance = np.hypot(
            points[rows, None, 0] - points[None, columns, 0], points[rows, None, 1] - points[None, columns, 1]
        )
        # each pair once; a position with itself once
        once = (columns[None, :] >= rows[:, None]) & (distance <= maximum_m + 1e-6)
        sums.add(distance[once], value_of(rows, columns)[once])
    return sums.means()


def _blocks_within(points: FloatArray, reach_m: float) -> Iterator[tuple[IntArray, IntArray]]:
    """Blocks of rows with the columns that may be within reach; both sorted by north, so that far ones drop out."""
    order = np.argsort(points[:, 1], kind="stable")
    north = points[order, 1]
    for start in range(0, len(order), BLOCK):
        rows = order[start : start + BLOCK]
        # rows of a block lie side by side in north, so their columns are one run
        low = np.searchsorted(north, points[rows, 1].min() - reach_m)
        high = np.searchsorted(north, points[rows, 1].max() + reach_m, side="right")
        yield rows, order[low:high]


def _is_constant(data: FloatArray, present: BoolArray) -> BoolArray:
    """Rows whose present values are all equal (to 1e-12 of their size)."""
    high = np.where(present, data, -np.inf).max(axis=1)
    low = np.where(present, data, np.inf).min(axis=1)
    size = np.maximum(np.abs(high), np.abs(low))
    some = present.any(axis=1)
    with np.errstate(invalid="ignore"):  # inf - inf in rows without a value
        return np.asarray(~some | (high - low <= 1e-12 * size))


def _points_and_vectors(points_m: ArrayLike, vectors: ArrayLike) -> tuple[FloatArray, FloatArray]:
    points = unmasked(points_m)
    data = unmasked(vectors)
    if points.ndim != 2 or points.shape[1] < 2 or len(data) != len(points):
        raise UsageError(
            f"points of shape {points.shape}, values of shape {data.shape}", expected="(n, 2+) and (n, ...)"
        )
    return points[:, :2], data.reshape(len(data), -1)
