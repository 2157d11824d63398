"""How alike the channel is at two positions: correlation against distance, and the curve through it.

Three correlations, all averaged over pairs of positions in bins of distance:

- :func:`vector_correlation`: the paper's (arXiv 2502.10324, section VI-A). Each position carries the vector of its
  ranks over all altitudes and K; Pearson correlation of two vectors. It mixes horizontal and vertical.
- :func:`field_correlation`: horizontal only. Each field (one altitude, one K) is standardised over the positions,
  and the mean product of two positions is taken.
- :func:`vertical_correlation`: vertical only. Pearson correlation over the positions of two altitudes' maps.

All three serve RSS as well as rank. NaN is out of coverage; whether a rank of 0 is a number or NaN is the caller's
choice (:func:`aerpaw_cmp.maps.grid.without_coverage_as_nan`).

Bins follow the paper: bin ``n`` holds the pairs whose distance is nearest to ``n`` times the width (half-way goes
up); bin 0 holds each position with itself, where the correlation is 1 by definition.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from ..errors import UsageError
from ..units import BoolArray, FloatArray, IntArray

BLOCK = 256
"""Positions per block of the pair products; bounds the memory to BLOCK x positions."""

TINY = 1e-300

PAPER_WIDTH_M = 30.0
PAPER_MAXIMUM_M = 500.0


@dataclass(frozen=True, slots=True)
class BinnedCorrelation:
    """Correlation (or semivariance) against distance.

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
    excluded_missing : int
        Positions (or fields) left out because of NaN.
    """

    distance_m: FloatArray
    mean_distance_m: FloatArray
    correlation: FloatArray
    pairs: IntArray
    positions: int
    excluded_constant: int
    excluded_missing: int


def vector_correlation(
    points_m: ArrayLike,
    vectors: ArrayLike,
    *,
    width_m: float = PAPER_WIDTH_M,
    maximum_m: float = PAPER_MAXIMUM_M,
    missing: Literal["drop", "pairwise"] = "drop",
    minimum_common: int = 3,
) -> BinnedCorrelation:
    """Pearson correlation of the positions' vectors, binned by horizontal distance (the paper's Steps 1 to 4).

    Parameters
    ----------
    points_m : (n, 2+)
        East, north [m].
    vectors : (n, ...)
        Rank or RSS over altitudes and K, flattened per position.
    width_m, maximum_m : float
        Bin width (the paper's d_rx) and the largest distance [m].
    missing : {"drop", "pairwise"}
        What NaN does: the position is left out, or each pair uses the components that both positions have.
    minimum_common : int
        With "pairwise", the least number of components that a pair must share.

    Returns
    -------
    BinnedCorrelation
    """
    points, data = _points_and_vectors(points_m, vectors)
    present = np.isfinite(data)
    lacking = ~present.all(axis=1) if missing == "drop" else present.sum(axis=1) < minimum_common
    constant = ~lacking & _is_constant(data, present)
    kept = ~(lacking | constant)
    if missing == "drop" or present[kept].all():
        unit = data[kept] - data[kept].mean(axis=1, keepdims=True)
        unit /= np.sqrt((unit**2).sum(axis=1, keepdims=True))
        product = _PairProduct(unit)
        bins = _bin_pairs(points[kept], product, width_m, maximum_m)
    else:
        bins = _bin_pairs(points[kept], _PairwisePearson(data[kept], minimum_common), width_m, maximum_m)
    return BinnedCorrelation(*bins, int(kept.sum()), int(constant.sum()), int(lacking.sum()))


def field_correlation(
    points_m: ArrayLike, fields: ArrayLike, *, width_m: float = PAPER_WIDTH_M, maximum_m: float = PAPER_MAXIMUM_M
) -> BinnedCorrelation:
    """Horizontal correlation of fields (n, ...), each standardised over the positions; mean over pairs and fields.

    NaN values take no part; a pair counts once, with the mean over the fields that both positions have. Fields that
    are constant or have fewer than two values are left out and counted.
    """
    points, data = _points_and_vectors(points_m, fields)
    present = np.isfinite(data)
    lacking = present.sum(axis=0) < 2
    constant = ~lacking & _is_constant(data.T, present.T)
    kept = ~(lacking | constant)
    data, present = data[:, kept], present[:, kept]
    count = present.sum(axis=0)
    filled = np.where(present, data, 0.0)
    centred = np.where(present, data - filled.sum(axis=0) / np.maximum(count, 1), 0.0)
    scaled = centred / np.sqrt((centred**2).sum(axis=0) / np.maximum(count, 1))
    bins = _bin_pairs(points, _MeanProduct(scaled, present), width_m, maximum_m)
    return BinnedCorrelation(*bins, int(present.any(axis=1).sum()), int(constant.sum()), int(lacking.sum()))


def semivariance(
    points_m: ArrayLike, values: ArrayLike, *, width_m: float = PAPER_WIDTH_M, maximum_m: float = PAPER_MAXIMUM_M
) -> BinnedCorrelation:
    """Matheron's semivariance of one field (n,): half the mean squared difference, in ``correlation``'s place."""
    points, data = _points_and_vectors(points_m, values)
    kept = np.isfinite(data).all(axis=1)
    bins = _bin_pairs(points[kept], _HalfSquaredDifference(data[kept]), width_m, maximum_m)
    return BinnedCorrelation(*bins, int(kept.sum()), 0, int((~kept).sum()))


def vertical_correlation(
    altitudes_m: ArrayLike, maps: ArrayLike, *, width_m: float = 10.0, maximum_m: float = np.inf
) -> BinnedCorrelation:
    """Correlation of the maps of two altitudes, binned by their difference in height.

    Parameters
    ----------
    altitudes_m : (altitudes,)
        Heights [m].
    maps : (altitudes, n) or (altitudes, fields, n)
        Rank or RSS at the same positions; a field is one K. The Pearson correlation of a pair of altitudes is taken
        over the positions that both have, per field, and averaged over the fields.
    width_m, maximum_m : float
        Bin width and largest difference in height [m].

    Returns
    -------
    BinnedCorrelation
        ``positions`` counts altitudes, ``pairs`` pairs of altitudes and fields; constant maps are left out, counted.
    """
    altitudes = np.asarray(altitudes_m, dtype=np.float64)
    data = np.asarray(maps, dtype=np.float64)
    if data.ndim == 2:
        data = data[:, None, :]
    if data.ndim != 3 or len(data) != len(altitudes):
        raise UsageError(f"maps of shape {data.shape} for {len(altitudes)} altitudes")
    levels, fields, _ = data.shape
    first, second = np.triu_indices(levels)
    gap = np.abs(altitudes[first] - altitudes[second])
    near = gap <= maximum_m
    first, second, gap = first[near], second[near], gap[near]
    value = np.empty((len(first), fields))
    excluded = 0
    for field in range(fields):
        rows = data[:, field]
        present = np.isfinite(rows)
        usable = (present.sum(axis=1) >= 2) & ~_is_constant(rows, present)
        excluded += int((~usable).sum())
        table = _PairwisePearson(np.where(usable[:, None], rows, np.nan), 2)(np.arange(levels), np.arange(levels))
        value[:, field] = table[first, second]
    n = int(np.floor(gap.max(initial=0.0) / width_m + 0.5)) + 1
    sums = _Sums(n, width_m)
    sums.add(np.repeat(gap, fields), value.ravel())
    return BinnedCorrelation(*sums.means(), levels, excluded, 0)


def fit_vertical_scale(
    correlation: Callable[[FloatArray], FloatArray],
    vertical: BinnedCorrelation,
    bounds: tuple[float, float] = (0.1, 1000.0),
) -> float:
    """How many horizontal metres one metre of height is worth: least squares of ``Phi(scale * height)``.

    Parameters
    ----------
    correlation : callable
        Horizontal Phi(distance [m]).
    vertical : BinnedCorrelation
        Of :func:`vertical_correlation`.
    bounds : (low, high)
        Of the scale.

    Returns
    -------
    float
        For ``OrdinaryKriging(vertical_scale=...)``.
    """
    from scipy.optimize import minimize_scalar

    usable = np.isfinite(vertical.correlation) & (vertical.mean_distance_m > 0)
    if not usable.any():
        raise UsageError("no two altitudes to compare", expected="maps of at least two altitudes that vary")
    height, phi = vertical.mean_distance_m[usable], vertical.correlation[usable]

    def cost(log_scale: float) -> float:
        return float(((np.asarray(correlation(np.exp(log_scale) * height)) - phi) ** 2).sum())

    axis = np.linspace(np.log(bounds[0]), np.log(bounds[1]), 200)
    best = int(np.argmin([cost(a) for a in axis]))
    bracket = (axis[max(best - 1, 0)], axis[min(best + 1, len(axis) - 1)])
    return float(np.exp(minimize_scalar(cost, bounds=bracket, method="bounded", options={"xatol": 1e-9}).x))


# --- pairs ----------------------------------------------------------------------------------------------------------

Block = Callable[[IntArray, IntArray], FloatArray]
"""Value of each pair of two sets of positions: (rows,), (columns,) -> (rows, columns); NaN where undefined."""


class _PairProduct:
    """Product of unit vectors."""

    def __init__(self, unit: FloatArray) -> None:
        self.unit = unit

    def __call__(self, rows: IntArray, columns: IntArray) -> FloatArray:
        return np.asarray(np.clip(self.unit[rows] @ self.unit[columns].T, -1.0, 1.0))


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
        good = (n >= self.minimum_common) & (vary_x > 1e-12 * square_x) & (vary_y > 1e-12 * square_y)
        scale = np.sqrt(np.where(good, vary_x * vary_y, 1.0))
        return np.where(good, np.clip(covary / scale, -1.0, 1.0), np.nan)


class _MeanProduct:
    """Mean product of standardised fields that both positions have."""

    def __init__(self, scaled: FloatArray, present: BoolArray) -> None:
        self.scaled = scaled
        self.present = present.astype(np.float64)
        self.complete = bool(present.all())

    def __call__(self, rows: IntArray, columns: IntArray) -> FloatArray:
        product = self.scaled[rows] @ self.scaled[columns].T
        if self.complete and self.scaled.shape[1]:
            return np.asarray(product / self.scaled.shape[1])
        common = self.present[rows] @ self.present[columns].T
        return np.where(common > 0, product / np.maximum(common, 1.0), np.nan)


class _HalfSquaredDifference:
    """(z_i - z_j)^2 / 2."""

    def __init__(self, data: FloatArray) -> None:
        self.data = data

    def __call__(self, rows: IntArray, columns: IntArray) -> FloatArray:
        return np.asarray(((self.data[rows, None, :] - self.data[None, columns, :]) ** 2).mean(axis=2) / 2)


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
    points = np.asarray(points_m, dtype=np.float64)
    data = np.asarray(vectors, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] < 2 or len(data) != len(points):
        raise UsageError(
            f"points of shape {points.shape}, values of shape {data.shape}", expected="(n, 2+) and (n, ...)"
        )
    return points[:, :2], data.reshape(len(data), -1)


# --- the curve ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class BiExponential:
    """``c1 exp(c2 d) + c3 exp(c4 d)``, d in metres; the faster decay first.

    Parameters
    ----------
    c1, c2, c3, c4 : float
        Amplitudes c1, c3 and rates c2 <= c4 <= 0 [1/m].
    rmse : float
        Root of the mean squared residual of the fit.
    degenerate : bool
        True when the data do not hold two exponentials; the curve is still the best found, the four numbers are
        then no property of the data.
    message : str
        Why, as a sentence; empty when not degenerate.

    Examples
    --------
    >>> paper = BiExponential(0.2932, -0.0508, 0.7057, -0.001, rmse=0.0153)
    >>> round(float(paper(0.0)), 4), round(paper.nugget, 4)
    (0.9989, 0.0011)
    """

    c1: float
    c2: float
    c3: float
    c4: float
    rmse: float
    degenerate: bool = False
    message: str = ""

    def __call__(self, distance_m: ArrayLike) -> FloatArray:
        """Correlation at distances [m]."""
        d = np.asarray(distance_m, dtype=np.float64)
        return np.asarray(self.c1 * np.exp(self.c2 * d) + self.c3 * np.exp(self.c4 * d))

    @property
    def nugget(self) -> float:
        """1 - Phi(0+)."""
        return 1.0 - self.c1 - self.c3


PAPER_BIEXPONENTIAL = BiExponential(0.2932, -0.0508, 0.7057, -0.001, 0.0153)
"""The paper's fit (section VII-C)."""


def fit_biexponential(
    distance_m: ArrayLike,
    correlation: ArrayLike,
    *,
    weights: ArrayLike | None = None,
    amplitude_bounds: tuple[float, float] = (0.0, np.inf),
    greatest_at_zero: float = 1.0,
    rate_bounds_per_m: tuple[float, float] | None = None,
    starts: int = 6,
) -> BiExponential:
    """Least-squares bi-exponential by variable projection.

    For given rates the best amplitudes are a bounded linear problem of two unknowns with a closed form, so only the
    logarithms of the two rates are searched: a grid over the bounds, then a trust-region search from its ``starts``
    best cells.

    Parameters
    ----------
    distance_m, correlation : (n,)
        The points; NaN pairs do not count.
    weights : (n,), optional
        Such as the number of pairs of each bin; the paper's fit has none. ``rmse`` is weighted likewise.
    amplitude_bounds : (low, high)
        Of c1 and c3. Amplitudes of at least 0 keep the curve a valid covariance in any dimension.
    greatest_at_zero : float
        Bound of c1 + c3. A correlation is at most 1; without the bound, data that begin beyond distance 0 let the
        fast exponential shoot up between 0 and the first point. Infinite for a free fit.
    rate_bounds_per_m : (slowest, fastest), optional
        Of -c2 and -c4 [1/m], positive. By default from 1e-6 over the largest distance (flat over the data) to 10 over
        the smallest positive one (gone at the first bin).
    starts : int
        Number of trust-region searches.

    Returns
    -------
    BiExponential
        ``degenerate`` tells when one exponential does as well, an amplitude vanishes, the rates coincide or one
        of them lies at a bound.

    Raises
    ------
    UsageError
        With fewer than two usable points, or bounds that hold nothing.

    References
    ----------
    .. [1] Golub and Pereyra, Inverse Problems 19 (2003) R1, doi:10.1088/0266-5611/19/2/201
    """
    problem = _Projection.of(distance_m, correlation, weights, (*amplitude_bounds, greatest_at_zero), rate_bounds_per_m)
    if len(problem.d) < 4:
        single = problem.single()
        return problem.result(single, f"{len(problem.d)} points cannot tell four coefficients")
    best = problem.double(starts)
    return problem.judge(best)


@dataclass(frozen=True, slots=True)
class _Projection:
    """The reduced problem: residuals as a function of the logarithms of the rates."""

    d: FloatArray
    y: FloatArray
    root_weight: FloatArray
    low: float
    high: float
    total: float
    log_rates: tuple[float, float]

    @classmethod
    def of(
        cls,
        distance_m: ArrayLike,
        correlation: ArrayLike,
        weights: ArrayLike | None,
        bounds: tuple[float, float, float],
        rate_bounds_per_m: tuple[float, float] | None,
    ) -> _Projection:
        d = np.asarray(distance_m, dtype=np.float64).ravel()
        y = np.asarray(correlation, dtype=np.float64).ravel()
        w = np.ones_like(d) if weights is None else np.asarray(weights, dtype=np.float64).ravel()
        if not (d.shape == y.shape == w.shape):
            raise UsageError(f"{d.size} distances, {y.size} correlations and {w.size} weights")
        good = np.isfinite(d) & np.isfinite(y) & (w > 0) & (d >= 0)
        d, y, w = d[good], y[good], w[good]
        if len(d) < 2 or not d.max() > 0:
            raise UsageError(f"{len(d)} usable points for a curve", expected="at least two, at different distances")
        slow, fast = rate_bounds_per_m or (1e-6 / d.max(), 10.0 / d[d > 0].min())
        low, high, total = bounds
        if not (0 < slow < fast and low < high and total > max(2 * low, low)):
            raise UsageError(f"bounds {bounds} and {rate_bounds_per_m}", expected="bounds that leave room, rates > 0")
        return cls(d, y, np.sqrt(w / w.mean()), low, high, total, (float(np.log(slow)), float(np.log(fast))))

    def amplitudes(self, log_rates: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Best bounded amplitudes (..., 2) and weighted residuals (..., n) for logarithms of rates (..., 2)."""
        basis = np.exp(-np.exp(log_rates)[..., None, :] * self.d[:, None]) * self.root_weight[:, None]
        target = self.y * self.root_weight
        candidates = _candidate_amplitudes(basis, target, self.low, self.high, self.total)
        residual = (basis[..., None, :, :] @ candidates[..., :, :, None])[..., 0] - target
        pick = np.argmin((residual**2).sum(axis=-1), axis=-1)[..., None, None]
        chosen = np.take_along_axis(candidates, pick, axis=-2)[..., 0, :]
        return chosen, np.take_along_axis(residual, pick, axis=-2)[..., 0, :]

    def double(self, starts: int) -> FloatArray:
        """Logarithms of the two best rates, the faster first."""
        axis = np.linspace(*self.log_rates, 48)
        first, second = np.triu_indices(len(axis), 1)
        grid = np.column_stack([axis[second], axis[first]])
        cost = (self.amplitudes(grid)[1] ** 2).sum(axis=1)
        found = [self._search(grid[cell]) for cell in np.argsort(cost)[:starts]]
        best = min(found, key=lambda log_rates: float((self.amplitudes(log_rates)[1] ** 2).sum()))
        return np.sort(best)[::-1]

    def _search(self, start: FloatArray) -> FloatArray:
        from scipy.optimize import least_squares

        inside = np.clip(start, self.log_rates[0] + 1e-9, self.log_rates[1] - 1e-9)
        fit = least_squares(
            lambda p: self.amplitudes(p)[1], inside, bounds=self.log_rates, xtol=1e-15, ftol=1e-15, gtol=1e-15
        )
        return np.asarray(fit.x)

    def single(self) -> float:
        """Logarithm of the rate of the best single exponential."""
        from scipy.optimize import minimize_scalar

        def cost(log_rate: float) -> float:
            return self._single_cost(log_rate)

        axis = np.linspace(*self.log_rates, 200)
        best = int(np.argmin([cost(a) for a in axis]))
        bracket = (axis[max(best - 1, 0)], axis[min(best + 1, len(axis) - 1)])
        return float(minimize_scalar(cost, bounds=bracket, method="bounded", options={"xatol": 1e-13}).x)

    def _single_amplitude(self, log_rate: float) -> float:
        basis = np.exp(-np.exp(log_rate) * self.d) * self.root_weight
        amplitude = float(basis @ (self.y * self.root_weight) / max(basis @ basis, TINY))
        return min(max(amplitude, self.low), self.high, self.total)

    def _single_cost(self, log_rate: float) -> float:
        curve = self._single_amplitude(log_rate) * np.exp(-np.exp(log_rate) * self.d)
        return float((((curve - self.y) * self.root_weight) ** 2).sum())

    def result(self, log_rate: float, message: str) -> BiExponential:
        """One exponential as a degenerate pair: c1 = 0."""
        rate = -float(np.exp(log_rate))
        rmse = float(np.sqrt(self._single_cost(log_rate) / len(self.d)))
        return BiExponential(0.0, rate, self._single_amplitude(log_rate), rate, rmse, True, message)

    def judge(self, log_rates: FloatArray) -> BiExponential:
        """The fit with a verdict on whether two exponentials are in the data."""
        amplitude, residual = self.amplitudes(log_rates)
        cost, n = float((residual**2).sum()), len(self.d)
        single = self.single()
        cost_single = self._single_cost(single)
        c1, c3 = (float(a) for a in amplitude)
        c2, c4 = (-float(rate) for rate in np.exp(log_rates))
        scale = 1e-20 * float(((self.y * self.root_weight) ** 2).sum())
        # Bayesian information criterion: two more coefficients must pay for themselves
        gain = n * np.log((cost_single + scale) / (cost + scale)) - 2 * np.log(n)
        reasons = []
        if gain <= 0:
            reasons.append("one exponential describes the data as well (BIC)")
        if min(abs(c1), abs(c3)) < 1e-3 * max(abs(c1), abs(c3), 1e-300):
            reasons.append("one of the two amplitudes vanishes")
        if log_rates[0] - log_rates[1] < 0.05:
            reasons.append("the two rates coincide")
        if log_rates[0] > self.log_rates[1] - 1e-3:
            reasons.append("the fast rate lies at its bound: the first bins hold a jump, not a decay")
        if -c4 * self.d.max() < 1e-3 or log_rates[1] < self.log_rates[0] + 1e-3:
            reasons.append("the slow rate is too small to tell from 0: the tail is flat over the data")
        rmse = float(np.sqrt(cost / n))
        return BiExponential(c1, c2, c3, c4, rmse, bool(reasons), "; ".join(reasons))


def _candidate_amplitudes(basis: FloatArray, target: FloatArray, low: float, high: float, total: float) -> FloatArray:
    """Best points (..., candidates, 2) of a two-column least-squares problem inside its bounds and on each edge.

    The bounds are ``low <= c <= high`` for both and ``c1 + c3 <= total``; the least cost among the candidates is the
    bounded optimum, because a convex cost has it inside or on an edge.
    """
    gram = np.swapaxes(basis, -1, -2) @ basis
    right = (np.swapaxes(basis, -1, -2) @ target[:, None])[..., 0]
    a, b, c = gram[..., 0, 0], gram[..., 0, 1], gram[..., 1, 1]
    p, q = right[..., 0], right[..., 1]
    edges = []
    for edge in {low, min(high, total - low)}:
        if np.isfinite(edge):
            top = min(high, total - edge)
            edges.append((np.full_like(p, edge), _clipped(q - b * edge, c, low, top)))
            edges.append((_clipped(p - b * edge, a, low, top), np.full_like(p, edge)))
    if total <= 2 * high and np.isfinite(total):
        # c3 = total - c1
        first = _clipped(p - q + (c - b) * total, a - 2 * b + c, max(low, total - high), min(high, total - low))
        edges.append((first, total - first))
    determinant = a * c - b * b
    regular = determinant > 1e-14 * a * c + TINY
    safe = np.where(regular, determinant, 1.0)
    first, second = (c * p - b * q) / safe, (a * q - b * p) / safe
    inside = regular & (np.minimum(first, second) >= low) & (np.maximum(first, second) <= high)
    inside &= first + second <= total
    fallback = edges[0] if edges else (np.zeros_like(p), _clipped(q, c, low, high))
    free = (np.where(inside, first, fallback[0]), np.where(inside, second, fallback[1]))
    return np.stack([np.stack(pair, axis=-1) for pair in (free, fallback, *edges)], axis=-2)


def _clipped(right: FloatArray, square: FloatArray, low: float, high: float) -> FloatArray:
    """Minimum over [low, high] of square * x^2 - 2 * right * x."""
    return np.asarray(np.clip(right / np.maximum(square, TINY), low, high))
