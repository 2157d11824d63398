"""Baselines of Kriging, the scores of interpolators, and the comparison of the paper.

The paper has two baselines (arXiv 2502.10324, section VI-C). The samples near a target are sorted by position index,
and a curve over the index is evaluated at the index of the target. The curves follow MATLAB's ``interp1`` with
``'extrap'``:

- ``spline``: cubic with not-a-knot ends; a parabola for three samples, a line for two.
- ``makima``: modified Akima piecewise cubic Hermite; a line for two samples.

Beyond the first and last sample the end piece is extrapolated. If there is only one sample, its value is used. If there
is no sample, the value is NaN.

Three further baselines are the nearest sample, inverse distance, and the mean over the area that a tower serves. All
classes share ``fit(points_m, values)``, ``predict(targets_m)`` and ``leave_one_out()`` with
:class:`~aerpaw_cmp.maps.kriging.OrdinaryKriging`. These interpolators do not estimate their error, so the variance that
they return is NaN.

Interpolators are scored by leave-one-out, as in the paper, and by blocks, so that close neighbours are held out, too.
Errors are in the unit of the field (rank, dB). Rank is not rounded: the paper's MAE (section VII-C) compares the
interpolated number. A position without a value (NaN, out of coverage) or without an estimate is not scored.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike

from ..common.errors import UsageError
from ..common.units import FloatArray, IntArray, unmasked
from . import kriging, variogram
from .grid import Grid, MapResult, serving_tower
from .kriging import OrdinaryKriging, Sampling, as_table, coverage_patterns

if TYPE_CHECKING:
    from typing_extensions import Self


# Number of targets whose samples are stacked at a time. The number limits the memory that is used.
CHUNK = 512


# --- pure functions, batched ----------------------------------------------------------------------------------------


def makima(index: ArrayLike, values: ArrayLike, at: ArrayLike) -> FloatArray:
    """Interpolate with the modified Akima method, one curve per row.

    Parameters
    ----------
    index : (..., m)
        Distinct abscissae in any order, m >= 1.
    values : (..., m, fields)
        Ordinates.
    at : (...)
        One abscissa per row. Outside the data the end piece is extrapolated.

    Returns
    -------
    ndarray, (..., fields)

    References
    ----------
    .. [1] Akima, J. ACM 17 (1970) 589, doi:10.1145/321607.321609; modified as in MATLAB's ``makima``.

    Examples
    --------
    >>> makima([[3.0, 1.0, 2.0]], [[[9.0], [1.0], [4.0]]], [4.0]).shape
    (1, 1)
    """
    x, y, at = _sorted(index, values, at)
    m = x.shape[-1]
    if m == 1:
        return y[..., 0, :]
    slope = np.diff(y, axis=-2) / np.diff(x, axis=-1)[..., None]
    tangent = np.repeat(slope, 2, axis=-2) if m == 2 else _makima_tangents(slope)
    return _hermite(x, y, tangent, at)


def _makima_tangents(slope: FloatArray) -> FloatArray:
    """Return tangents (..., m, fields) from slopes (..., m - 1, fields), m >= 3."""
    # Akima's two additional slopes at each end are those of a parabola through the last samples
    before = 2 * slope[..., :1, :] - slope[..., 1:2, :]
    after = 2 * slope[..., -1:, :] - slope[..., -2:-1, :]
    padded = np.concatenate(
        [2 * before - slope[..., :1, :], before, slope, after, 2 * after - slope[..., -1:, :]], axis=-2
    )
    # the term with the sum is from MATLAB: with Akima's weights alone, the curve overshoots where data become constant
    weight = np.abs(np.diff(padded, axis=-2)) + np.abs(padded[..., 1:, :] + padded[..., :-1, :]) / 2
    left, right = weight[..., 2:, :], weight[..., :-2, :]
    total = left + right
    some = total > 0
    # if the data are constant on both sides, both weights are 0, and the tangent is 0
    mixed = left * padded[..., 1:-2, :] + right * padded[..., 2:-1, :]
    return np.where(some, mixed / np.where(some, total, 1.0), 0.0)


def spline(index: ArrayLike, values: ArrayLike, at: ArrayLike) -> FloatArray:
    """Interpolate with a cubic spline with not-a-knot ends, one curve per row. Shapes are as in :func:`makima`."""
    x, y, at = _sorted(index, values, at)
    m = x.shape[-1]
    if m == 1:
        return y[..., 0, :]
    step = np.diff(x, axis=-1)
    slope = np.diff(y, axis=-2) / step[..., None]
    if m == 2:
        tangent = np.repeat(slope, 2, axis=-2)
    elif m == 3:
        tangent = _parabola_tangents(step, slope)
    else:
        tangent = _not_a_knot_tangents(step, slope)
    return _hermite(x, y, tangent, at)


def _parabola_tangents(step: FloatArray, slope: FloatArray) -> FloatArray:
    first, second = step[..., :1, None], step[..., 1:, None]
    bend = (slope[..., 1:, :] - slope[..., :1, :]) / (first + second)
    start = slope[..., :1, :] - bend * first
    return np.concatenate([start, start + 2 * bend * first, start + 2 * bend * (first + second)], axis=-2)


def _not_a_knot_tangents(step: FloatArray, slope: FloatArray) -> FloatArray:
    """Return tangents of the C2 cubic whose first two pieces are one polynomial, like the last two (de Boor, IV)."""
    rows, m = step.shape[:-1], step.shape[-1] + 1
    system = np.zeros((*rows, m, m))
    inner = np.arange(1, m - 1)
    system[..., inner, inner - 1] = step[..., 1:]
    system[..., inner, inner] = 2 * (step[..., :-1] + step[..., 1:])
    system[..., inner, inner + 1] = step[..., :-1]
    right = np.empty((*rows, m, slope.shape[-1]))
    h = step[..., None]
    right[..., 1:-1, :] = 3 * (h[..., 1:, :] * slope[..., :-1, :] + h[..., :-1, :] * slope[..., 1:, :])
    for end, a, b in ((0, 0, 1), (m - 1, -1, -2)):
        near, far = step[..., a], step[..., b]
        span = near + far
        system[..., end, end] = far
        system[..., end, 1 if end == 0 else m - 2] = span
        right[..., end, :] = (
            (near + 2 * span)[..., None] * far[..., None] * slope[..., a, :] + near[..., None] ** 2 * slope[..., b, :]
        ) / span[..., None]
    # use dense matrices, because NumPy solves many small systems at once, but SciPy's banded solver only one
    return np.asarray(np.linalg.solve(system, right))


def _hermite(x: FloatArray, y: FloatArray, tangent: FloatArray, at: FloatArray) -> FloatArray:
    """Evaluate a piecewise cubic Hermite curve at one abscissa per row. The end pieces continue outside."""
    m = x.shape[-1]
    # clip the number of the piece, so that the end pieces are extrapolated
    piece = np.clip((x <= at[..., None]).sum(axis=-1) - 1, 0, m - 2)[..., None]
    left, right = np.take_along_axis(x, piece, -1), np.take_along_axis(x, piece + 1, -1)
    low, high = piece[..., None], piece[..., None] + 1
    y0, y1 = np.take_along_axis(y, low, -2)[..., 0, :], np.take_along_axis(y, high, -2)[..., 0, :]
    t0, t1 = np.take_along_axis(tangent, low, -2)[..., 0, :], np.take_along_axis(tangent, high, -2)[..., 0, :]
    h = right - left
    u = (at[..., None] - left) / h
    # use differences from the left sample, so that equal samples are reproduced exactly
    rise = y1 - y0
    return np.asarray(y0 + u * (h * t0 + u * (3 * rise - h * (2 * t0 + t1) + u * (h * (t0 + t1) - 2 * rise))))


def _sorted(index: ArrayLike, values: ArrayLike, at: ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
    x = unmasked(index)
    y = unmasked(values)
    if y.ndim != x.ndim + 1 or y.shape[:-1] != x.shape or x.shape[-1] < 1:
        raise UsageError(
            f"index of shape {x.shape}, values of shape {y.shape}", expected="(..., m) and (..., m, fields)"
        )
    order = np.argsort(x, axis=-1, kind="stable")
    x = np.take_along_axis(x, order, -1)
    if (np.diff(x, axis=-1) <= 0).any():
        raise UsageError("two samples with the same position index", expected="distinct positions")
    return x, np.take_along_axis(y, order[..., None], -2), unmasked(at)


# --- predictors -----------------------------------------------------------------------------------------------------


class _Local(Sampling):
    """The base of predictors that use near samples, which ignores NaN in each field."""

    def fit(self, points_m: ArrayLike, values: ArrayLike) -> Self:
        """Store samples (n, dims) with values (n, ...). NaN means out of coverage."""
        self.points_m_, fields = unmasked(points_m), unmasked(values)
        if len(fields) != len(self.points_m_):
            raise UsageError(f"{len(fields)} values for {len(self.points_m_)} points")
        self._shape, self.values_ = fields.shape[1:], as_table(fields)
        return self

    def predict(self, targets_m: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return the estimate (t, ...) at targets (t, dims), and NaN for the variance."""
        return self._estimate(unmasked(targets_m), leave_out=False)

    def leave_one_out(self) -> tuple[FloatArray, FloatArray]:
        """Return the estimate at each sample from all other samples, and NaN for the variance."""
        return self._estimate(self.points_m_, leave_out=True)

    def _estimate(self, targets: FloatArray, *, leave_out: bool) -> tuple[FloatArray, FloatArray]:
        estimate = np.full((len(targets), self.values_.shape[1]), np.nan)
        for covered, columns in coverage_patterns(self.values_):
            samples, values = self.points_m_[covered], self.values_[np.ix_(covered, columns)]
            skip = kriging.renumbered(covered) if leave_out else None
            estimate[:, columns] = self._one_pattern(samples, values, targets, skip)
        estimate = estimate.reshape(len(targets), *self._shape)
        return estimate, np.full_like(estimate, np.nan)

    def _one_pattern(
        self, samples: FloatArray, values: FloatArray, targets: FloatArray, skip: IntArray | None
    ) -> FloatArray:
        chosen = kriging.by_rule(self, samples, targets, skip)
        estimate = np.full((len(targets), values.shape[1]), np.nan)
        count = chosen.count
        for m in np.unique(count[count > 0]):
            same = np.flatnonzero(count == m)
            for start in range(0, len(same), CHUNK):
                rows = same[start : start + CHUNK]
                index = chosen.index[rows, :m]
                estimate[rows] = self._combine(targets[rows], samples[index], values[index])
        return estimate

    def _combine(self, targets: FloatArray, samples: FloatArray, values: FloatArray) -> FloatArray:
        """Return estimates (t, fields) at targets (t, dims) from samples (t, m, dims) and values (t, m, fields)."""
        raise NotImplementedError


@dataclass(eq=False)
class IndexInterpolation(_Local):
    """A baseline of the paper: spline or makima over the position index of the M samples within the radius.

    Parameters
    ----------
    kind : {"spline", "makima"}
        Kind of curve.
    grid : Grid
        Grid that determines the index of each sample and target. All samples must be in different cells.
    neighbours, radius_m, selection, seed
        The same as in :class:`~aerpaw_cmp.maps.kriging.OrdinaryKriging`.
    """

    kind: Literal["spline", "makima"]
    grid: Grid

    def _combine(self, targets: FloatArray, samples: FloatArray, values: FloatArray) -> FloatArray:
        curve: Callable[..., FloatArray] = {"spline": spline, "makima": makima}[self.kind]
        index, at = self.grid.index_of(samples), self.grid.index_of(targets)
        if (index < 0).any() or (at < 0).any():
            raise UsageError("a point outside the grid has no position index", expected="points on the grid")
        return curve(index, values, at)


class InverseDistance(_Local):
    """The mean weighted by the inverse square of distance, exact at samples.

    Source: Shepard 1968, doi:10.1145/800186.810616.
    """

    def _combine(self, targets: FloatArray, samples: FloatArray, values: FloatArray) -> FloatArray:
        far = np.linalg.norm(samples - targets[:, None], axis=-1)
        at = far < kriging.TIE_M
        # use distances relative to the distance of the nearest sample, to prevent overflow
        ratio = far[:, :1] / np.where(at, 1.0, far)
        weight = np.where(at.any(axis=1, keepdims=True), at.astype(np.float64), ratio**2)
        weight /= weight.sum(axis=1, keepdims=True)
        # average differences from one sample, so that equal values stay equal
        first = values[:, :1]
        return np.asarray(first[:, 0] + (weight[:, :, None] * (values - first)).sum(axis=1))


class ServingTowerMean:
    """The mean of all samples in the area of the serving tower.

    Parameters
    ----------
    towers_m : (towers, 2+)
        East, north [m].
    """

    def __init__(self, towers_m: ArrayLike) -> None:
        self.towers_m = towers_m

    def fit(self, points_m: ArrayLike, values: ArrayLike) -> Self:
        """Sum the samples (n, dims) with values (n, ...) by tower. NaN is ignored."""
        self.values_ = unmasked(values)
        self.tower_ = serving_tower(points_m, self.towers_m)
        finite = np.isfinite(self.values_)
        self.total_ = np.zeros((len(np.asarray(self.towers_m)), *self.values_.shape[1:]))
        self.count_ = np.zeros_like(self.total_)
        # do not use +=, which adds only one of several values with the same index
        np.add.at(self.total_, self.tower_, np.where(finite, self.values_, 0.0))
        np.add.at(self.count_, self.tower_, finite)
        return self

    def predict(self, targets_m: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return the mean of each target's tower, NaN for a tower without samples, and NaN for the variance."""
        tower = serving_tower(targets_m, self.towers_m)
        return self._mean(self.total_[tower], self.count_[tower])

    def leave_one_out(self) -> tuple[FloatArray, FloatArray]:
        """Return the mean of each sample's tower without the sample, and NaN for the variance."""
        finite = np.isfinite(self.values_)
        total = self.total_[self.tower_] - np.where(finite, self.values_, 0.0)
        return self._mean(total, self.count_[self.tower_] - finite)

    def _mean(self, total: FloatArray, count: FloatArray) -> tuple[FloatArray, FloatArray]:
        mean = np.where(count > 0, total / np.maximum(count, 1.0), np.nan)
        return mean, np.full_like(mean, np.nan)


# The classes that share ``fit``, ``predict`` and ``leave_one_out``.
Predictor = OrdinaryKriging | _Local | ServingTowerMean


@dataclass(frozen=True, slots=True)
class Score:
    """The errors of each field. Every array has the shape of the fields, such as (altitudes, K).

    Parameters
    ----------
    mae, rmse : ndarray
        Mean absolute and root mean square error. NaN if no position was scored.
    n : ndarray of int
        Number of scored positions.
    """

    mae: FloatArray
    rmse: FloatArray
    n: IntArray


def score(values: ArrayLike, estimate: ArrayLike) -> Score:
    """Score estimates (n, ...) against values (n, ...).

    Source: arXiv 2502.10324 eq. 19.
    """
    truth, guess = unmasked(values), unmasked(estimate)
    if truth.shape != guess.shape:
        raise UsageError(f"values of shape {truth.shape}, estimates of shape {guess.shape}")
    error = np.ma.masked_invalid(guess - truth)
    mae, square = (np.ma.filled(part.mean(axis=0), np.nan) for part in (np.abs(error), error**2))
    return Score(mae, np.sqrt(square), np.asarray(error.count(axis=0), dtype=np.int64))


def leave_one_out(model: Predictor, points_m: ArrayLike, values: ArrayLike) -> Score:
    """Score the estimate of each position from all other positions, as in the paper, for values (n, altitudes, K)."""
    data = unmasked(values)
    return score(data, model.fit(points_m, data).leave_one_out()[0])


def blocked(model: Predictor, points_m: ArrayLike, values: ArrayLike, block_m: float = 300.0) -> Score:
    """Hold out one square block of the area at a time.

    Near neighbours of a position are held out with it, so the score shows how well the interpolator bridges gaps of
    about ``block_m``. Blocks start at the south-western position.

    Parameters
    ----------
    model : Predictor
    points_m : array_like, (n, 2) or (n, 3)
    values : array_like, (n, ...)
    block_m : float
        Side of a block.

    Returns
    -------
    Score

    Notes
    -----
    Spatially blocked cross-validation (Roberts et al. 2017, doi:10.1111/ecog.02881).
    """
    points = unmasked(points_m)
    # a position on the border of blocks must not change its block by rounding
    cell = np.floor((points[:, :2] - points[:, :2].min(axis=0)) / block_m + 1e-9).astype(np.int64)
    _, block = np.unique(cell, axis=0, return_inverse=True)
    data = unmasked(values)
    estimate = np.full_like(data, np.nan)
    for number in np.unique(block):
        test = block.ravel() == number
        # skip a block that contains all samples, because there are no training samples
        if not test.all():
            estimate[test], _ = model.fit(points[~test], data[~test]).predict(points[test])
    return score(data, estimate)


# Lowest altitude of the interpolation in the paper [m]. The paper uses 3 m only to show blockage.
LOWEST_M = 30.0


@dataclass(frozen=True, slots=True)
class Study:
    """The study of the paper's section VII-C: correlation, curve, and leave-one-out errors of each interpolator.

    Parameters
    ----------
    correlation : BinnedCorrelation
        Correlation of the vectors of two positions against distance.
    fit : BiExponential
        Curve fitted to the correlation.
    scores : mapping of str to Score
        "Kriging", "makima", "spline" (the paper's), "nearest", "inverse distance", "serving-tower mean"; arrays of
        shape (altitudes, K).
    """

    correlation: variogram.BinnedCorrelation
    fit: variogram.BiExponential
    scores: Mapping[str, Score]


# Treatments of positions out of coverage, as in :func:`rank_fields`.
TREATMENTS = {"zero": "out of coverage as rank 0", "missing": "out of coverage excluded"}


def rank_fields(
    result: MapResult, out_of_coverage: Literal["missing", "zero"] = "missing"
) -> tuple[tuple[float, ...], FloatArray]:
    """Return altitudes from ``LOWEST_M`` on, as in the paper, and the joint ranks (n, altitudes, K) to interpolate.

    ``out_of_coverage`` determines whether a rank of 0 becomes NaN (no sample) or stays the number 0.

    Source: arXiv 2502.10324 eq. 7; arXiv 2502.10324 eq. 8.
    """
    rows = [i for i, height in enumerate(result.rank_altitudes_m) if height >= LOWEST_M]
    rank = np.moveaxis(result.ranks()[rows], -1, 0).astype(np.float64)
    heights = tuple(result.rank_altitudes_m[i] for i in rows)
    return heights, np.where(rank > 0, rank, np.nan) if out_of_coverage == "missing" else rank


def interpolation_study(grid: Grid, values: FloatArray, towers_m: FloatArray, sampling: Sampling) -> Study:
    """Compute the correlation of maps and the leave-one-out errors of all interpolators.

    Parameters
    ----------
    grid : Grid
        Positions.
    values : (n, altitudes, K)
        Rank or RSS; NaN out of coverage. For RSS the last axis may be towers.
    towers_m : (towers, 2+)
        Positions of the towers, for the mean per serving tower.
    sampling : Sampling
        Samples that every local interpolator uses.

    Returns
    -------
    Study
        Correlation, fitted curve, and scores of every interpolator.
    """
    points, m, radius_m = grid.points_m, sampling.neighbours, sampling.radius_m
    # bins as wide as the step of the grid, as in the paper, because narrower bins would be empty
    correlation = variogram.vector_correlation(points, values, width_m=grid.spacing_m)
    fit = _curve(correlation)
    models: dict[str, Predictor] = {
        # with a single neighbour, its weight is 1 at any distance
        "nearest": InverseDistance(neighbours=1, radius_m=radius_m),
        "inverse distance": InverseDistance(neighbours=m, radius_m=radius_m),
        "serving-tower mean": ServingTowerMean(towers_m),
    }
    scores = {name: leave_one_out(model, points, values) for name, model in models.items()}
    return Study(correlation, fit, paper_scores(grid, values, fit, sampling) | scores)


def paper_scores(grid: Grid, values: FloatArray, fit: variogram.BiExponential, sampling: Sampling) -> dict[str, Score]:
    """Return the leave-one-out errors of the paper's interpolators, "Kriging", "makima" and "spline".

    Parameters
    ----------
    grid : Grid
        Positions.
    values : (n, altitudes, K)
        Values; NaN out of coverage.
    fit : BiExponential
        Correlation that Kriging uses.
    sampling : Sampling
        Samples that each interpolator uses.

    Returns
    -------
    dict of str to Score
    """
    models: dict[str, Predictor] = {
        "Kriging": OrdinaryKriging(fit, **vars(sampling)),
        "makima": IndexInterpolation("makima", grid, **vars(sampling)),
        "spline": IndexInterpolation("spline", grid, **vars(sampling)),
    }
    return {name: leave_one_out(model, grid.points_m, values) for name, model in models.items()}


def kriging_wins(scores: Mapping[str, Score]) -> int:
    """Count the fields (heights and K) for which Kriging has a smaller MAE than the paper's other interpolators."""
    kriging, makima, spline = (scores[name].mae for name in ("Kriging", "makima", "spline"))
    return int(((kriging <= makima) & (kriging <= spline)).sum())


def _curve(correlation: variogram.BinnedCorrelation) -> variogram.BiExponential:
    if np.isfinite(correlation.correlation[1:]).any():
        return variogram.fit_biexponential(correlation.distance_m, correlation.correlation)
    # Kriging requires a curve, so use the curve of the paper, and report that it was not fitted to these data
    reason = "no two positions have varying rank vectors: the paper's curve is used"
    return replace(variogram.PAPER_BIEXPONENTIAL, rmse=float("nan"), degenerate=True, message=reason)
