"""Correlation of the channel at two positions against their distance, and the paper's curve that is fitted to it.

Two correlations are averaged over pairs of positions in bins of distance:

- :func:`vector_correlation` is the correlation of the paper (arXiv 2502.10324, section VI-A): the Pearson correlation
  of the vectors of two positions, which contain the ranks of all altitudes and K. This correlation mixes horizontal and
  vertical changes.
- :func:`field_correlation` is horizontal: each field (one altitude, one K) is standardised over the positions, and the
  values of two positions are multiplied.

Both correlations can be used for RSS and rank. NaN means out of coverage. The caller decides whether a rank of 0 is
used as a number or is NaN.

Bins follow the paper. Bin ``n`` contains the pairs whose distance is nearest to ``n`` times the width; half-way values
are rounded up. Bin 0 contains each position with itself, where the correlation is 1 by definition.

:func:`fit_biexponential` fits the paper's curve by variable projection.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..common.errors import UsageError, from_python
from ..common.text import counted
from ..common.units import BoolArray, FloatArray, IntArray, unmasked

# Smaller than any sum of squares of data, so that a quotient of zeros is 0 and not NaN.
TINY = 1e-300


@dataclass(frozen=True, slots=True)
class BiExponential:
    """The curve ``c1 exp(c2 d) + c3 exp(c4 d)``, d in metres, with the faster decay first.

    Source: arXiv 2502.10324 eq. 14.

    Parameters
    ----------
    c1, c2, c3, c4 : float
        Amplitudes c1, c3 and rates c2 <= c4 <= 0 [1/m].
    rmse : float
        Root mean square residual of the fit.
    degenerate : bool
        True if the data do not determine two exponentials. The curve still has the smallest error, but its coefficients
        are not reliable.
    message : str
        Reasons why the curve is ``degenerate``, otherwise empty.

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
        """Return the correlation at distances [m]."""
        d = unmasked(distance_m)
        return np.asarray(self.c1 * np.exp(self.c2 * d) + self.c3 * np.exp(self.c4 * d))

    @property
    def nugget(self) -> float:
        """The nugget, 1 - Phi(0+)."""
        return 1.0 - self.c1 - self.c3


# The paper's fit (section VII-C).
PAPER_BIEXPONENTIAL = BiExponential(0.2932, -0.0508, 0.7057, -0.001, 0.0153)


# Number of starting points of the search.
STARTS = 6


def fit_biexponential(distance_m: ArrayLike, correlation: ArrayLike) -> BiExponential:
    """Fit a bi-exponential by least squares, with c1 and c3 of at least 0 and c1 + c3 of at most 1.

    Source: arXiv 2502.10324 eq. 14.

    For given rates the best amplitudes have a closed form (variable projection). Only the logarithms of the two rates
    are searched: on a grid, then by a trust-region search from its :data:`STARTS` best cells.

    Parameters
    ----------
    distance_m, correlation : (n,)
        The points of the curve. NaN values are ignored.

    Returns
    -------
    BiExponential
        ``degenerate`` is True if one exponential fits as well, an amplitude is 0, the rates are equal, or a rate is at
        a bound.

    Raises
    ------
    UsageError
        If there are fewer than two usable points.

    Notes
    -----
    With amplitudes of at least 0 the curve is a valid covariance in any dimension. Without the upper limit, an
    exponential with a fast rate could exceed a correlation of 1 between distance 0 and the first point.

    References
    ----------
    .. [1] Golub and Pereyra, Inverse Problems 19 (2003) R1, doi:10.1088/0266-5611/19/2/201
    """
    problem = _Projection.of(distance_m, correlation)
    if len(problem.d) < 4:
        reason = f"{counted(len(problem.d), 'point')} cannot determine four coefficients"
        return problem.curve(problem.single_rates(), [reason])
    return problem.double()


@dataclass(frozen=True, slots=True)
class _Projection:
    """The reduced problem: residuals as a function of the logarithms of the rates."""

    d: FloatArray
    y: FloatArray
    log_rates: tuple[float, float]

    @classmethod
    def of(cls, distance_m: ArrayLike, correlation: ArrayLike) -> _Projection:
        """Return the problem of one curve, without the points that are NaN."""
        d = unmasked(distance_m).ravel()
        y = unmasked(correlation).ravel()
        if d.shape != y.shape:
            raise UsageError(f"{d.size} distances and {y.size} correlations")
        good = np.isfinite(d) & np.isfinite(y) & (d >= 0)
        d, y = d[good], y[good]
        if len(d) < 2 or not d.max() > 0:
            raise UsageError(
                f"{counted(len(d), 'usable point')} for a curve", expected="at least two, at different distances"
            )
        # the slowest exponential is constant over the data, and the fastest is zero at the first bin
        slow, fast = 1e-6 / d.max(), 10.0 / d[d > 0].min()
        return cls(d, y, (float(np.log(slow)), float(np.log(fast))))

    def amplitudes(self, log_rates: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the best bounded amplitudes (..., 2) and the residuals (..., n) for logarithms of rates (..., 2)."""
        basis = np.exp(-np.exp(log_rates)[..., None, :] * self.d[:, None])
        candidates = _candidate_amplitudes(basis, self.y)
        residual = (basis[..., None, :, :] @ candidates[..., :, :, None])[..., 0] - self.y
        pick = np.argmin((residual**2).sum(axis=-1), axis=-1)[..., None, None]
        chosen = np.take_along_axis(candidates, pick, axis=-2)[..., 0, :]
        return chosen, np.take_along_axis(residual, pick, axis=-2)[..., 0, :]

    def cost(self, log_rates: FloatArray) -> FloatArray:
        """Return the sum of squared residuals (...) for logarithms of rates (..., 2)."""
        return np.asarray((self.amplitudes(log_rates)[1] ** 2).sum(axis=-1))

    def curve(self, log_rates: FloatArray, reasons: Sequence[str]) -> BiExponential:
        """Return the curve with these rates. ``reasons`` state why the curve is degenerate."""
        (c1, c3), (c2, c4) = self.amplitudes(log_rates)[0].tolist(), (-np.exp(log_rates)).tolist()
        rmse = float(np.sqrt(self.cost(log_rates) / len(self.d)))
        return BiExponential(
            c1=c1, c2=c2, c3=c3, c4=c4, rmse=rmse, degenerate=bool(reasons), message="; ".join(reasons)
        )

    def _search(self, start: FloatArray, tolerance: float) -> FloatArray:
        """Return the local minimum that is reached from a start."""
        from scipy.optimize import least_squares

        fit = least_squares(
            lambda log_rates: self.amplitudes(log_rates)[1],
            np.clip(start, self.log_rates[0] + 1e-9, self.log_rates[1] - 1e-9),
            jac="3-point",
            bounds=self.log_rates,
            xtol=tolerance,
            ftol=tolerance,
            gtol=1e-15,
        )
        return np.asarray(fit.x)

    def single_rates(self) -> FloatArray:
        """Return the logarithm of the rate of the best single exponential, twice. The best of 200 rates is refined."""
        from scipy.optimize import minimize_scalar

        axis = np.linspace(*self.log_rates, 200)
        best = int(np.argmin(self.cost(np.column_stack([axis, axis]))))
        bracket = (axis[max(best - 1, 0)], axis[min(best + 1, len(axis) - 1)])
        fit = minimize_scalar(
            lambda rate: float(self.cost(np.full(2, rate))), bounds=bracket, method="bounded", options={"xatol": 1e-13}
        )
        return np.full(2, fit.x)

    def double(self) -> BiExponential:
        """Return the best curve, and whether the data determine its two exponentials."""
        # with the bins of the paper, neighbouring rates differ by a factor of 1.5
        axis = np.linspace(*self.log_rates, 48)
        first, second = np.triu_indices(len(axis), 1)
        grid = np.column_stack([axis[second], axis[first]])
        # search roughly from each start, and exactly only from the best result
        refined = np.stack([self._search(grid[cell], 1e-5) for cell in np.argsort(self.cost(grid))[:STARTS]])
        log_rates = np.sort(self._search(refined[np.argmin(self.cost(refined))], 1e-15))[::-1]
        (c1, c3), n = self.amplitudes(log_rates)[0], len(self.d)
        # add a little: if both curves are exact, the ratio must be 1 and not 0 / 0
        scale = 1e-20 * float((self.y**2).sum())
        ratio = (self.cost(self.single_rates()) + scale) / (self.cost(log_rates) + scale)
        at_end = log_rates[0] > self.log_rates[1] - 1e-3
        flat = np.exp(log_rates[1]) * self.d.max() < 1e-3 or log_rates[1] < self.log_rates[0] + 1e-3
        reasons = {
            # Bayesian information criterion with a penalty for two more coefficients
            "a single exponential fits as well": n * np.log(ratio) - 2 * np.log(n) <= 0,
            "one of the two exponentials has no amplitude": min(c1, c3) <= 1e-3 * max(c1, c3),
            # two rates within 5 % are in effect a single exponential
            "both exponentials decay at the same rate": log_rates[0] - log_rates[1] < 0.05,
            "the faster decay ends before the first distance, so its rate cannot be determined": at_end,
            "the slower decay is not visible within the largest distance": flat,
        }
        return self.curve(log_rates, [text for text, applies in reasons.items() if applies])


def _candidate_amplitudes(basis: FloatArray, target: FloatArray) -> FloatArray:
    """Return the best points (..., 4, 2) of a two-column least-squares problem inside its bounds and on each edge.

    The bounds are ``c1, c3 >= 0`` and ``c1 + c3 <= 1``. The cost is convex, so the best of these candidates is the
    bounded optimum.
    """
    gram = np.swapaxes(basis, -1, -2) @ basis
    right = (np.swapaxes(basis, -1, -2) @ target[:, None])[..., 0]
    a, b, c = gram[..., 0, 0], gram[..., 0, 1], gram[..., 1, 1]
    p, q = right[..., 0], right[..., 1]
    none, slope = np.zeros_like(p), _clipped(p - q + c - b, a - 2 * b + c)
    edges = [(none, _clipped(q, c)), (_clipped(p, a), none), (slope, 1.0 - slope)]
    determinant = a * c - b * b
    # with equal rates, both columns are equal and any split of the amplitude is correct
    regular = determinant > 1e-14 * a * c + TINY
    safe = np.where(regular, determinant, 1.0)
    first, second = (c * p - b * q) / safe, (a * q - b * p) / safe
    inside = regular & (np.minimum(first, second) >= 0.0) & (first + second <= 1.0)
    free = (np.where(inside, first, 0.0), np.where(inside, second, edges[0][1]))
    return np.stack([np.stack(pair, axis=-1) for pair in (free, *edges)], axis=-2)


def _clipped(right: FloatArray, square: FloatArray) -> FloatArray:
    """Return the x in [0, 1] with the smallest square * x^2 - 2 * right * x."""
    return np.asarray(np.clip(right / np.maximum(square, TINY), 0.0, 1.0))


# Number of positions per block of pairs. The memory is proportional to BLOCK times the number of positions.
BLOCK = 256

# Bins are as wide as d_rx (section VI-A), and distances reach 500 m (section VII-C).
_PAPER_WIDTH_M = 30.0
_PAPER_MAXIMUM_M = 500.0
# Smallest number of components that both positions of a pair must have. With two components, the correlation would
# always be +1 or -1.
_MINIMUM_COMMON = 3


@dataclass(frozen=True, slots=True)
class BinnedCorrelation:
    """The correlation (or semivariance) against distance.

    Source: arXiv 2502.10324 eq. 11; arXiv 2502.10324 eq. 12; arXiv 2502.10324 eq. 13.

    Parameters
    ----------
    distance_m : (bins,)
        Nominal distance of each bin, a multiple of the width.
    mean_distance_m : (bins,)
        Mean distance of the pairs of each bin.
    correlation : (bins,)
        Mean over the pairs. NaN in a bin without pairs.
    pairs : (bins,) int
        Number of pairs, including each position with itself.
    positions : int
        Number of positions used.
    excluded_constant : int
        Number of positions or fields without variation, which have no correlation.
    """

    distance_m: FloatArray
    mean_distance_m: FloatArray
    correlation: FloatArray
    pairs: IntArray
    positions: int
    excluded_constant: int


def vector_correlation(
    points_m: ArrayLike, vectors: ArrayLike, *, width_m: float = _PAPER_WIDTH_M, maximum_m: float = _PAPER_MAXIMUM_M
) -> BinnedCorrelation:
    """Return the Pearson correlation of the vectors of two positions by distance (the paper's Steps 1 to 4).

    Source: arXiv 2502.10324 eq. 9; arXiv 2502.10324 eq. 10.

    Parameters
    ----------
    points_m : (n, 2+)
        East, north [m].
    vectors : (n, ...)
        Rank or RSS over altitudes and K at each position. A pair uses the components that both positions have.
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
    bins = _bin_pairs(points[varying], _pairwise_pearson(data[varying]), width_m, maximum_m)
    return BinnedCorrelation(*bins, int(varying.sum()), int(constant.sum()))


def field_correlation(
    points_m: ArrayLike, fields: ArrayLike, *, width_m: float = _PAPER_WIDTH_M, maximum_m: float = _PAPER_MAXIMUM_M
) -> BinnedCorrelation:
    """Return the horizontal correlation of fields (n, ...), each standardised over the positions, averaged over pairs.

    NaN values are ignored. A pair counts once, with the mean over the fields that both positions have. Fields that are
    constant or have fewer than two values are excluded and counted.

    Parameters
    ----------
    points_m : array_like, (n, 2) or (n, 3)
        Positions. Distances are horizontal.
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


# --- pairs ----------------------------------------------------------------------------------------------------------

# Function that returns the value of each pair of two sets of positions: (rows,), (columns,) -> (rows, columns). Pairs
# without a value are NaN.
Block = Callable[[IntArray, IntArray], FloatArray]


@from_python
class Variogram:
    """The correlation of a field against horizontal distance, binned and fitted.

    Parameters
    ----------
    width_m, maximum_m : float
        Width of the bins of distance, and largest distance [m].

    Attributes
    ----------
    binned_ : BinnedCorrelation
        Result of :func:`field_correlation` for the samples.
    model_ : BiExponential
        The fitted curve, callable on distances.

    Notes
    -----
    ``gamma(d) = v^2 (1 - Phi(d))`` with ``Phi(d) = c1 exp(c2 d) + c3 exp(c4 d)`` (arXiv 2502.10324, section VI).
    :class:`~aerpaw_cmp.maps.kriging.OrdinaryKriging` accepts a fitted variogram as its correlation.

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
            If there are fewer samples or bins than a fit requires.
        """
        self.binned_ = field_correlation(points_m, values, width_m=self.width_m, maximum_m=self.maximum_m)
        pairs = np.isfinite(self.binned_.correlation)
        # fit at the mean distance of the pairs, which may differ from the middle of the bin by a fifth of its width
        self.model_ = fit_biexponential(self.binned_.mean_distance_m[pairs], self.binned_.correlation[pairs])
        return self

    def __call__(self, distance_m: ArrayLike) -> FloatArray:
        """Return the fitted correlation at distances [m]."""
        return self.model_(distance_m)


def _pairwise_pearson(data: FloatArray) -> Block:
    """Return the Pearson correlation over the components that both vectors have, by products of masked vectors."""
    known = np.isfinite(data).astype(np.float64)
    filled = np.where(known > 0, data, 0.0)
    # subtract the mean of each vector first, so that the differences below do not lose digits
    mean = filled.sum(axis=1, keepdims=True) / np.maximum(known.sum(axis=1, keepdims=True), 1)
    value = np.where(known > 0, data - mean, 0.0)
    square = value**2

    def of(rows: IntArray, columns: IntArray) -> FloatArray:
        mine, theirs, x, y = known[rows], known[columns].T, value[rows], value[columns].T
        n = mine @ theirs
        safe = np.maximum(n, 1.0)
        sum_x, sum_y = x @ theirs, mine @ y
        square_x, square_y = square[rows] @ theirs, mine @ square[columns].T
        vary_x, vary_y = square_x - sum_x**2 / safe, square_y - sum_y**2 / safe
        # a smaller variance is only a rounding error of the difference
        good = (n >= _MINIMUM_COMMON) & (vary_x > 1e-12 * square_x) & (vary_y > 1e-12 * square_y)
        scale = np.sqrt(np.where(good, vary_x * vary_y, 1.0))
        # rounding can make the correlation of equal vectors exceed 1
        return np.where(good, np.clip((x @ y - sum_x * sum_y / safe) / scale, -1.0, 1.0), np.nan)

    return of


def _mean_product(scaled: FloatArray, present: BoolArray) -> Block:
    """Return the mean product of standardised fields that both positions have."""
    known = present.astype(np.float64)

    def of(rows: IntArray, columns: IntArray) -> FloatArray:
        common = known[rows] @ known[columns].T
        return np.where(common > 0, scaled[rows] @ scaled[columns].T / np.maximum(common, 1.0), np.nan)

    return of


def _sums(distance_m: FloatArray, value: FloatArray, width_m: float, bins: int) -> FloatArray:
    """Return sums of distances and values, and numbers of pairs, per bin of distance, shape (3, bins)."""
    # round first: a grid distance such as sqrt(2) * 30 must not change its bin by rounding errors
    number = np.floor(np.round(distance_m / width_m, 9) + 0.5).astype(np.int64)
    good = (number < bins) & np.isfinite(value)
    weights = distance_m[good], value[good], np.ones(int(good.sum()))
    return np.stack([np.bincount(number[good], weight, bins) for weight in weights])


def _bin_pairs(
    points: FloatArray, value_of: Block, width_m: float, maximum_m: float
) -> tuple[FloatArray, FloatArray, FloatArray, IntArray]:
    """Return nominal and mean distance, mean value and number of pairs of each bin. The means of empty bins are NaN."""
    if not (width_m > 0 and maximum_m >= width_m and np.isfinite(maximum_m)):
        raise UsageError(f"bins of {width_m} m up to {maximum_m} m", expected="0 < width <= maximum, both finite")
    sums = np.zeros((3, int(np.floor(maximum_m / width_m + 1e-9)) + 1))
    # the last bin ends half a width beyond its centre. Add a micrometre to include pairs at exactly this distance.
    reach = min(maximum_m, width_m * (sums.shape[1] - 0.5)) + 1e-6
    for rows, columns in _blocks_within(points, reach):
        distance = np.hypot(
            points[rows, None, 0] - points[None, columns, 0], points[rows, None, 1] - points[None, columns, 1]
        )
        # count each pair once
        once = (columns[None, :] >= rows[:, None]) & (distance <= maximum_m + 1e-6)
        sums += _sums(distance[once], value_of(rows, columns)[once], width_m, sums.shape[1])
    total_m, value, pairs = sums
    some = np.where(pairs > 0, pairs, np.nan)
    return width_m * np.arange(len(pairs), dtype=np.float64), total_m / some, value / some, pairs.astype(np.int64)


def _blocks_within(points: FloatArray, reach_m: float) -> Iterator[tuple[IntArray, IntArray]]:
    """Yield blocks of rows with the columns that may be within reach, both sorted by north."""
    order = np.argsort(points[:, 1], kind="stable")
    north = points[order, 1]
    for start in range(0, len(order), BLOCK):
        rows = order[start : start + BLOCK]
        # the rows of a block are sorted by north, so their columns are contiguous
        low = np.searchsorted(north, points[rows, 1].min() - reach_m)
        high = np.searchsorted(north, points[rows, 1].max() + reach_m, side="right")
        yield rows, order[low:high]


def _is_constant(data: FloatArray, present: BoolArray) -> BoolArray:
    """Check which rows have equal values (to 1e-12 of their size) or no value."""
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
