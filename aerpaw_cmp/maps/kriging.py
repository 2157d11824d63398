"""Ordinary Kriging in moving neighbourhoods, in the plane or in space.

The semivariogram of the paper is ``gamma = v^2 (1 - Phi)`` (arXiv 2502.10324, section VI-B). The weights do not
depend on ``v^2``, and ``v^2 = 0`` would make the textbook system singular. The system is therefore solved for
``1 - Phi``, and ``v^2`` only scales the variance::

    [ 1 - Phi  1 ] [ w ]   [ 1 - Phi_0 ]
    [    1     0 ] [ L ] = [     1     ]        variance = v^2 (w . (1 - Phi_0) + L)

Rules, each with a test:

nugget
    ``1 - Phi(0+)``, a jump of the semivariogram at distance 0. The semivariance of a sample with itself is still 0, so
    a target at the position of a sample takes its value with variance 0.
positions
    Samples at the same position (to a micrometre) become one sample, their mean. Leave-one-out holds out the position.
near-singular systems
    A system that may be near-singular is solved by an eigenvalue decomposition in the space of weights that sum to 1.
    Directions with less than 1e-10 of the largest variance are dropped. If the correlation is not a valid covariance,
    directions with less than the most negative variance are dropped, too. Along dropped directions, the weights stay
    equal.
out of coverage
    NaN values are ignored in each field.
too few samples
    If fewer than M samples are within the radius, all of them are used. If there is a single sample, its value is the
    estimate. If there is no sample, the estimate and its variance are NaN, or (``outside="nearest"``) the M nearest
    samples are used regardless of their distance.

An interpolator may use the M nearest samples within a radius, or M random samples within the radius.

Ties are resolved by a rule. Distances that agree to a micrometre are tied. Tied samples are ordered by their offset
from the target: lower first, then southern, then western. On a regular grid every inner target therefore has the same
pattern of neighbours, regardless of the order of the samples.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator
from dataclasses import KW_ONLY, dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from ..common.errors import UsageError, from_python
from ..common.grouping import lists_by_key
from ..common.units import BoolArray, FloatArray, IntArray, unmasked

# Number of targets per query. The number limits the memory that is used.
QUERY_CHUNK = 4096

# Number of targets per query of all samples within a radius. The number limits the memory, and does not affect random
# draws.
AT_ONCE = 256

# Distances that differ by less than this are tied, and a sample closer than this to a target is at the position of the
# target.
TIE_M = 1e-6


@dataclass(frozen=True, slots=True)
class Neighbours:
    """The chosen samples of each target, in the order of the tie rule. Random samples are in the order of their draw.

    Parameters
    ----------
    index : (targets, M) int
        Numbers of the samples; -1 after the last sample.
    distance_m : (targets, M)
        Distances of the samples [m]; infinite after the last sample.
    """

    index: IntArray
    distance_m: FloatArray

    @property
    def count(self) -> IntArray:
        """The number of samples of each target (targets,)."""
        return np.asarray((self.index >= 0).sum(axis=1), dtype=np.int64)


def nearest(
    samples_m: FloatArray, targets_m: FloatArray, m: int, radius_m: float, skip: IntArray | None = None
) -> Neighbours:
    """Return the M nearest samples within the radius (inclusive, to the micrometre), ordered by the tie rule.

    Parameters
    ----------
    samples_m : (samples, dims)
        Distinct positions in a frame in metres (anisotropy already applied).
    targets_m : (targets, dims)
        Positions in the same frame.
    m : int
        Largest number of samples per target.
    radius_m : float
        Search radius, may be infinite.
    skip : (targets,) int, optional
        The sample that each target must not use (leave-one-out); -1 if the target may use all samples.

    Returns
    -------
    Neighbours
    """
    from scipy.spatial import cKDTree

    chosen = Neighbours(np.full((len(targets_m), m), -1, dtype=np.int64), np.full((len(targets_m), m), np.inf))
    if len(samples_m) == 0 or len(targets_m) == 0:
        return chosen
    tree = cKDTree(samples_m)
    for start in range(0, len(targets_m), QUERY_CHUNK):
        # query more samples than required, to see whether a tie continues. On the paper's grid, up to 12 cells are
        # equally distant.
        todo, candidates = np.arange(start, min(start + QUERY_CHUNK, len(targets_m))), m + 13
        while len(todo):
            todo = _fill_nearest(tree, targets_m, todo, radius_m, skip, candidates, chosen)
            candidates *= 2
    return chosen


@dataclass(eq=False, kw_only=True)
class Sampling:
    """The samples that a target uses, as in :class:`OrdinaryKriging`."""

    neighbours: int = 20
    radius_m: float = 150.0
    selection: Literal["nearest", "random"] = "nearest"
    seed: int = 0


def by_rule(
    rule: Sampling | OrdinaryKriging, samples_m: FloatArray, targets_m: FloatArray, skip: IntArray | None = None
) -> Neighbours:
    """Return the samples that a predictor uses for each target: the nearest samples, or random samples.

    Parameters
    ----------
    rule : Sampling or OrdinaryKriging
    samples_m, targets_m, skip
        The same as in :func:`nearest`.

    Returns
    -------
    Neighbours
    """
    if rule.selection == "random":
        return _random_within(rule, samples_m, targets_m, skip)
    return nearest(samples_m, targets_m, rule.neighbours, rule.radius_m, skip)


def renumbered(taken: BoolArray) -> IntArray:
    """Return the number of each sample among the samples of a mask (samples,), -1 outside the mask."""
    return np.where(taken, np.cumsum(taken) - 1, -1)


def _fill_nearest(
    tree: Any,
    targets_m: FloatArray,
    todo: IntArray,
    radius_m: float,
    skip: IntArray | None,
    candidates: int,
    chosen: Neighbours,
) -> IntArray:
    """Fill the rows ``todo`` from ``candidates`` per target. Return the rows that need more candidates."""
    samples_m, m = tree.data, chosen.index.shape[1]
    candidates = min(candidates, len(samples_m))
    # pass a list of ranks, because a plain 1 would drop an axis. Add a micrometre, because the tree excludes the bound
    # itself.
    distance, who = tree.query(targets_m[todo], k=np.arange(1, candidates + 1), distance_upper_bound=radius_m + TIE_M)
    last = _in_micrometres(distance[:, -1])
    exhausted = (candidates == len(samples_m)) | ~np.isfinite(last)
    if skip is not None:
        # remove it after the query, because a tree without this sample would have to be built for every target
        distance[who == skip[todo, None]] = np.inf
    ring = _in_micrometres(distance)
    rows = np.flatnonzero(((ring[:, 1:] <= ring[:, :-1]) & np.isfinite(ring[:, 1:])).any(axis=1))
    if len(rows):
        # for a missing neighbour the tree returns the number of samples, which is not a valid row
        numbers = np.where(np.isfinite(distance[rows]), who[rows], 0)
        order = _tie_order(distance[rows], numbers, samples_m, targets_m[todo[rows]])
        distance[rows], who[rows] = (np.take_along_axis(a[rows], order, axis=1) for a in (distance, who))
    complete = exhausted | (_in_micrometres(distance[:, m - 1]) < last) if candidates >= m else exhausted
    width = min(m, candidates)
    filled = todo[complete]
    chosen.index[filled, :width] = np.where(np.isfinite(distance[:, :width]), who[:, :width], -1)[complete]
    chosen.distance_m[filled, :width] = distance[complete, :width]
    return todo[~complete]


def _in_micrometres(distance_m: FloatArray) -> FloatArray:
    return np.round(distance_m / TIE_M)


def _tie_order(distance: FloatArray, who: IntArray, samples_m: FloatArray, targets_m: FloatArray) -> IntArray:
    """Return the order of candidates by distance, then offset (up, north, east), then number."""
    offset = _in_micrometres(samples_m[who] - targets_m[:, None, :])
    keys = [offset[:, :, axis] for axis in range(offset.shape[2])]
    return np.lexsort((who, *keys, _in_micrometres(distance)), axis=-1)


def _random_within(
    rule: Sampling | OrdinaryKriging, samples_m: FloatArray, targets_m: FloatArray, skip: IntArray | None
) -> Neighbours:
    """Return M samples drawn without replacement within the radius: a possible interpretation of the paper's Step 1."""
    from scipy.spatial import cKDTree

    m, radius_m = rule.neighbours, rule.radius_m
    index = np.full((len(targets_m), m), -1, dtype=np.int64)
    distance = np.full((len(targets_m), m), np.inf)
    if len(samples_m) == 0:
        return Neighbours(index, distance)
    generator = np.random.default_rng(rule.seed)
    tree = cKDTree(samples_m)
    for start in range(0, len(targets_m), AT_ONCE):
        part = slice(start, start + AT_ONCE)
        pairs = cKDTree(targets_m[part]).sparse_distance_matrix(tree, radius_m + TIE_M, output_type="ndarray")
        # sort the pairs: their order may change with the version of the tree, but a draw must not
        pairs = pairs[np.lexsort((pairs["j"], pairs["i"]))]
        target, sample, far = pairs["i"], pairs["j"], pairs["v"]
        # draw one number per pair in a fixed order, so that the draw does not depend on the size of the parts
        draw = generator.random(len(pairs))
        if skip is not None:
            keep = sample != skip[part][target]
            target, sample, far, draw = target[keep], sample[keep], far[keep], draw[keep]
        order = np.lexsort((draw, target))
        target, sample, far = target[order], sample[order], far[order]
        # number the pairs of each target
        rank = np.arange(len(target)) - np.searchsorted(target, target)
        drawn = rank < m
        index[start + target[drawn], rank[drawn]] = sample[drawn]
        distance[start + target[drawn], rank[drawn]] = far[drawn]
    return Neighbours(index, distance)


# Correlation as a function of an array of distances [m].
Correlation = Callable[[FloatArray], FloatArray]

# With this condition number, a solution has six of the sixteen digits of float64.
CONDITION_LIMIT = 1e10
# Sum of magnitudes of weights above which a warning is given. With correlations that decrease steadily, the sum is
# below 3.
LARGEST_WEIGHTS = 100.0
# Targets share one set of weights if the offsets of their neighbours agree to this distance [m].
_SHARE_M = 1e-9
# Below this condition number a Cholesky solution has at least 9 digits, so no second solution is needed.
SOUND_CONDITION = 1e6
# If the bound by the pivots is below this, the condition number is not computed, because that takes as long as the
# solution. Among 40 000 systems of six correlations, including samples in lines and clusters, such systems stayed below
# 1e5.
PLAINLY_SOUND = 3e3
# Number of targets that may share weights and whose systems are factored together. The number is smaller for systems
# with many neighbours, so that a factor has at most the second number of elements.
CHUNK, FACTOR_NUMBERS = 2048, 2**20


@dataclass(frozen=True, slots=True)
class Weights:
    """The weights of the samples of each target: an estimate is the sum of weight times sample.

    Parameters
    ----------
    index : (targets, M) int
        Numbers of the positions that are used; -1 after the last position.
    weight : (targets, M)
        Weights; 0 after the last sample. The weights of a target with samples sum to 1.
    variance : (targets,)
        Kriging variance for ``v^2 = 1``; NaN if there is no sample.
    regularised : (targets,) bool
        True if directions were dropped from a near-singular system.
    """

    index: IntArray
    weight: FloatArray
    variance: FloatArray
    regularised: BoolArray


@from_python
@dataclass(eq=False)
class OrdinaryKriging:
    """Ordinary Kriging of one or many fields sampled at the same points.

    Source: arXiv 2502.10324 eq. 15; arXiv 2502.10324 eq. 17; arXiv 2502.10324 eq. 18.

    Parameters
    ----------
    correlation : callable
        Phi(distance [m]), such as a fitted :class:`~aerpaw_cmp.maps.variogram.BiExponential`. Values above 1
        count as 1.
    neighbours : int
        M, the largest number of samples per target.
    radius_m : float
        r0, the search radius [m]. Infinity is allowed.
    selection : {"nearest", "random"}
        The M nearest samples (ties by the rule of :mod:`~aerpaw_cmp.maps.kriging`), or M random samples within the
        radius.
    seed : int
        Seed of the random selection.
    outside : {"nan", "nearest"}
        Result if no sample is within the radius.
    bounds : (low, high), optional
        Limits of the estimates, such as (1, 4) for ranks.

    Attributes
    ----------
    points_m_ : (places, dims)
        Distinct sample positions.
    values_ : (places, fields)
        Values at these positions.
    place_ : (samples,) int
        Index into ``points_m_`` of each sample.
    sill_ : (fields,)
        Sample variance of each field, v^2.

    Notes
    -----
    Weights can be negative, so an estimate can lie outside the range of its samples. The effect is largest for a
    correlation that is smooth at 0: with a Gaussian correlation, estimates from ranks 1 and 4 were -6.9 to 11.3.
    ``bounds`` limits the estimates.

    Examples
    --------
    >>> model = OrdinaryKriging(lambda d: np.exp(-d / 100.0)).fit([[0.0, 0.0], [60.0, 0.0]], [1.0, 3.0])
    >>> estimate, variance = model.predict([[30.0, 0.0], [0.0, 0.0]])
    >>> estimate.round(12).tolist(), bool(variance[0] > 0), float(variance[1])
    ([2.0, 1.0], True, 0.0)
    """

    correlation: Correlation
    neighbours: int = 20
    radius_m: float = 150.0
    _: KW_ONLY
    selection: Literal["nearest", "random"] = "nearest"
    seed: int = 0
    outside: Literal["nan", "nearest"] = "nan"
    bounds: tuple[float, float] | None = None

    def fit(self, points_m: ArrayLike, values: ArrayLike) -> OrdinaryKriging:
        """Store the samples.

        Parameters
        ----------
        points_m : (n, 2) or (n, 3)
            East, north (, up) [m].
        values : (n, ...)
            Values of one or more fields; NaN out of coverage.

        Raises
        ------
        UsageError
            If a setting or a shape is not valid.
        """
        self._check_settings()
        points = _as_points(points_m)
        fields = unmasked(values)
        if fields.shape[:1] != points.shape[:1]:
            raise UsageError(f"values of shape {fields.shape} for {len(points)} points", expected="one value per point")
        if np.isinf(fields).any():
            raise UsageError("an infinite sample value", expected="finite values, NaN where out of coverage")
        # estimates are returned in the shape of the values
        self._shape = fields.shape[1:]
        self.points_m_, self.values_, self.place_ = _merge_places(points, as_table(fields))
        # subtract a value of the field, so that a constant field has a variance of exactly 0
        centred = np.ma.masked_invalid(self.values_ - _reference(self.values_))
        self.sill_ = np.ma.filled(centred.var(axis=0, ddof=1), 0.0)
        return self

    def predict(self, targets_m: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return estimate and Kriging variance at targets (t, dims), both (t,) or (t, fields) as for the values."""
        targets = _as_points(targets_m)
        if targets.shape[1] != self.points_m_.shape[1]:
            raise UsageError(f"targets with {targets.shape[1]} coordinates, samples with {self.points_m_.shape[1]}")
        return self._shaped(*self._estimate(targets, None))

    def leave_one_out(self) -> tuple[FloatArray, FloatArray]:
        """Return estimate and variance at every sample from the other samples, in the shape of the fitted values."""
        place = np.arange(len(self.points_m_))
        estimate, variance = self._estimate(self.points_m_, place)
        return self._shaped(estimate[self.place_], variance[self.place_])

    def weights(self, targets_m: ArrayLike) -> Weights:
        """Return the weights at targets for a field with a value at every position."""
        return self._weights(self.points_m_, _as_points(targets_m), None)

    # --- settings and shapes -------------------------------------------------------------------------------------

    def _check_settings(self) -> None:
        checks = {
            "neighbours": (int(self.neighbours) == self.neighbours >= 1, "a whole number of at least 1"),
            "radius_m": (self.radius_m > 0, "a positive length"),
            "selection": (self.selection in ("nearest", "random"), "'nearest' or 'random'"),
            "outside": (self.outside in ("nan", "nearest"), "'nan' or 'nearest'"),
        }
        wrong = [
            f"{k} = {getattr(self, k)!r}: expected {expected}" for k, (fine, expected) in checks.items() if not fine
        ]
        if wrong:
            raise UsageError("; ".join(wrong))

    def _shaped(self, estimate: FloatArray, variance: FloatArray) -> tuple[FloatArray, FloatArray]:
        estimate = estimate if self.bounds is None else np.clip(estimate, *self.bounds)
        shape = len(estimate), *self._shape
        return estimate.reshape(shape), variance.reshape(shape)

    # --- estimation ----------------------------------------------------------------------------------------------

    def _estimate(self, targets: FloatArray, place: IntArray | None) -> tuple[FloatArray, FloatArray]:
        """Return estimate and variance (targets, fields). ``place`` is the position that each target must not use."""
        estimate = np.full((len(targets), self.values_.shape[1]), np.nan)
        variance = np.full_like(estimate, np.nan)
        # use one set of weights for all fields with values at the same positions, such as the 27 ranks of a map
        for covered, columns in coverage_patterns(self.values_):
            skip = None if place is None else renumbered(covered)[place]
            rule = self._weights(self.points_m_[covered], targets, skip)
            if (largest := np.abs(rule.weight).sum(axis=1).max(initial=0.0)) > LARGEST_WEIGHTS:
                warnings.warn(
                    f"weights of samples add up to {largest:.0e}: estimates may exceed the samples by that factor. "
                    "Likely cause: a correlation that is flat at 0 (Gaussian) without a nugget",
                    RuntimeWarning,
                    stacklevel=3,
                )
            estimate[:, columns] = _apply(rule, self.values_[np.ix_(covered, columns)])
            variance[:, columns] = rule.variance[:, None] * self.sill_[columns]
        return estimate, variance

    def _weights(self, samples: FloatArray, targets: FloatArray, skip: IntArray | None) -> Weights:
        chosen = self._neighbours(samples, targets, skip)
        count = chosen.count
        weight = np.zeros(chosen.index.shape)
        variance = np.full(len(targets), np.nan)
        regularised = np.zeros(len(targets), dtype=bool)
        coordinates = np.ascontiguousarray(samples.T)
        for m in np.unique(count[count > 0]):
            same = np.flatnonzero(count == m)
            step = min(CHUNK, max(1, FACTOR_NUMBERS // int(m) ** 2))
            for start in range(0, len(same), step):
                rows = same[start : start + step]
                # put targets on the last axis, so that each operation runs over many systems at once
                near = np.ascontiguousarray(chosen.index[rows, :m].T)
                offset = coordinates[:, near]
                offset -= targets[rows].T[:, None]
                example, group = _same_geometry(offset)
                w, v, r = self._solve(offset[:, :, example], samples, near[:, example])
                weight[rows, :m], variance[rows], regularised[rows] = w.T[group], v[group], r[group]
        return Weights(chosen.index, weight, variance, regularised)

    def _neighbours(self, samples: FloatArray, targets: FloatArray, skip: IntArray | None) -> Neighbours:
        chosen = by_rule(self, samples, targets, skip)
        if self.outside == "nearest":
            empty = np.flatnonzero(chosen.count == 0)
            wider = nearest(samples, targets[empty], self.neighbours, np.inf, None if skip is None else skip[empty])
            chosen.index[empty], chosen.distance_m[empty] = wider.index, wider.distance_m
        return chosen

    def _semivariance(self, offset_m: FloatArray) -> FloatArray:
        """Return 1 - Phi at offsets (dims, ...) between different positions.

        Source: arXiv 2502.10324 eq. 17; ``v^2`` scales the variance later.
        """
        square = offset_m[0] ** 2 + offset_m[1] ** 2
        for more in offset_m[2:]:
            square += more**2
        gamma = 1.0 - np.asarray(self.correlation(np.sqrt(square)), dtype=np.float64)
        if not np.isfinite(gamma).all():
            raise UsageError("the correlation is not finite at some distance", expected="a number at every distance")
        # a correlation may exceed 1, by rounding or in a function of the user
        return np.asarray(np.maximum(gamma, 0.0))

    def _solve(
        self, offset_m: FloatArray, samples: FloatArray, near: IntArray
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Return weights (m, t), normalised variance (t,) and near-singular flag (t,) for offsets (dims, m, t)."""
        m, t = offset_m.shape[1:]
        to_target = self._semivariance(offset_m)
        here = np.einsum("dmt,dmt->mt", offset_m, offset_m) < TIE_M**2
        to_target[here] = 0.0
        # semivariances (pairs, t) of the neighbours, as a lower triangle by columns
        first, second = np.triu_indices(m, 1)
        between = self._semivariance(samples.T[:, near[second]] - samples.T[:, near[first]])
        regularised = np.zeros(t, dtype=bool)
        weight, variance, sound = solve_schur(between, to_target)
        if len(hard := np.flatnonzero(~sound)):
            w, variance[hard], regularised[hard] = _solve_doubtful(_square(between[:, hard], m), to_target.T[hard])
            weight[:, hard] = w.T
        # next to a sample the variance is nearly 0, and rounding can make it negative
        variance = np.maximum(variance, 0.0)
        at = here.any(axis=0)  # the exact solution at a sample is known
        weight[:, at], variance[at] = here[:, at], 0.0
        return weight, variance, regularised


def _square(pairs: FloatArray, m: int) -> FloatArray:
    """Return symmetric matrices (t, m, m) with zero diagonals from the pairs of a lower triangle by columns."""
    first, second = np.triu_indices(m, 1)
    gamma = np.zeros((pairs.shape[1], m, m))
    gamma[:, first, second] = gamma[:, second, first] = pairs.T
    return gamma


def solve_schur(gamma: FloatArray, to_target: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return weights (m, t), variance (t,) and whether the solution is reliable, for the covariance ``1 - gamma``.

    Parameters
    ----------
    gamma : (m (m - 1) / 2, t)
        Semivariances between samples 1 and 0, 2 and 0, ..., 2 and 1, ...
    to_target : (m, t)
        Semivariances between samples and target.

    Notes
    -----
    With ``C = 1 - gamma = L L'`` and ``c = 1 - gamma_0`` the bordered system is ``C w = c + mu 1``. A Cholesky factor
    solves it, with the Lagrange multiplier ``mu`` from the Schur complement ``1' C^-1 1``. The trace of ``C^-1`` bounds
    the condition number of C by ``m trace``. The trace is computed only if the pivots do not exclude a large bound.
    """
    m, t = to_target.shape
    # store by columns, so that each step adds contiguous planes of memory. The two additional rows are L^-1 c and L^-1
    # 1.
    factor, weight, inverse_pivot = np.empty((m, m + 2, t)), np.empty((m, t)), np.empty((m, t))
    # a slice of ``gamma`` is one column of the lower triangle of the matrix
    end = 0
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):  # NaN if C is not a covariance
        for j in range(m):
            start, end = end, end + m - 1 - j
            column = factor[j, j:]
            # C has ones on its diagonal; the last row is the right-hand side of ones
            column[0] = column[-1] = 1.0
            np.subtract(1.0, gamma[start:end], out=column[1:-2])
            np.subtract(1.0, to_target[j], out=column[-2])
            column -= np.einsum("kit,kt->it", factor[:j, j:], factor[:j, j])
            inverse_pivot[j] = 1.0 / np.sqrt(column[0])
            column *= inverse_pivot[j]
        of_target, of_ones = factor[:, m], factor[:, m + 1]
        multiplier = (1.0 - np.einsum("kt,kt->t", of_target, of_ones)) / np.einsum("kt,kt->t", of_ones, of_ones)
        known = of_target + multiplier * of_ones
        for j in reversed(range(m)):
            weight[j] = known[j] - np.einsum("it,it->t", factor[j, j + 1 : m], weight[j + 1 :])
            weight[j] *= inverse_pivot[j]
        # weights sum to 1 by construction, so remove rounding errors
        weight /= weight.sum(axis=0)
        sound = m * (inverse_pivot**2).sum(axis=0) < PLAINLY_SOUND
        if len(unclear := np.flatnonzero(~sound)):
            sound[unclear] = m * _trace_of_inverse(factor[..., unclear], inverse_pivot[:, unclear]) < SOUND_CONDITION
    return weight, (weight * to_target).sum(axis=0) + multiplier, sound


def _trace_of_inverse(factor: FloatArray, inverse_pivot: FloatArray) -> FloatArray:
    """Return the trace (t,) of ``C^-1``, the sum of squares in ``L^-1``. ``L`` is in columns (m, m or more, t)."""
    inverse = np.zeros((len(factor), *inverse_pivot.shape))
    for j, pivot in enumerate(inverse_pivot):
        np.multiply(np.einsum("kt,kit->it", factor[:j, j], inverse[:j, :j]), -pivot, out=inverse[j, :j])
        inverse[j, j] = pivot
    return np.asarray(np.einsum("kit,kit->t", inverse, inverse))


def _solve_doubtful(gamma: FloatArray, to_target: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return weights (t, m), normalised variance (t,) and near-singular flag (t,) of systems that may be singular.

    Source: arXiv 2502.10324 eq. 16, without its Lagrange multiplier: weights that sum to 1 are equal weights plus a
    sum of orthonormal contrasts, and the variance over the contrasts is minimised without a constraint.
    """
    from scipy.linalg import helmert

    t, m = to_target.shape
    if m == 1:
        return np.ones((t, 1)), 2.0 * to_target[:, 0], np.zeros(t, dtype=bool)
    basis = helmert(m)  # (m - 1, m): orthonormal, each row sums to 0
    covariance = -basis @ gamma @ basis.T
    right = basis @ (gamma.mean(axis=2) - to_target)[:, :, None]
    level, direction = np.linalg.eigh((covariance + covariance.transpose(0, 2, 1)) / 2)
    # a negative eigenvalue is an impossible variance: directions with smaller positive eigenvalues may be only rounding
    # errors
    strong = level > np.maximum(np.maximum(level[:, -1:], 1e-300) / CONDITION_LIMIT, -level[:, :1])
    along = (direction.transpose(0, 2, 1) @ right)[:, :, 0]
    along = np.where(strong, along / np.where(strong, level, 1.0), 0.0)
    weight = 1.0 / m + (direction @ along[:, :, None])[:, :, 0] @ basis
    variance = 2.0 * (weight * to_target).sum(axis=1) - np.einsum("ti,tij,tj->t", weight, gamma, weight)
    return weight, variance, ~strong.all(axis=1)


def _apply(rule: Weights, values: FloatArray) -> FloatArray:
    """Return estimates (targets, fields) of values (places, fields)."""
    from scipy.sparse import csr_array

    used = rule.index >= 0
    start = np.concatenate([[0], np.cumsum(used.sum(axis=1))])
    # use a sparse matrix, because each target uses about 20 of thousands of samples
    matrix = csr_array((rule.weight[used], rule.index[used], start), shape=(len(used), len(values)))
    # add differences from one value of the field, so that a constant field is exact although weights sum to 1 within
    # 1e-16
    reference = _reference(values)
    estimate = reference + matrix @ (values - reference)
    target, column = np.nonzero(rule.weight == 1.0)
    # at a sample, or with a single sample, return its exact value
    estimate[target] = values[rule.index[target, column]]
    estimate[~used.any(axis=1)] = np.nan
    return np.asarray(estimate)


def _reference(values: FloatArray) -> FloatArray:
    """Return the first finite value of each field (fields,), 0 for a field without finite values."""
    finite = np.isfinite(values)
    if not len(values):
        return np.zeros(values.shape[1])
    first = values[finite.argmax(axis=0), np.arange(values.shape[1])]
    return np.asarray(np.where(finite.any(axis=0), first, 0.0))


def as_table(values: FloatArray) -> FloatArray:
    """Return values (n, ...) as (n, fields)."""
    return values.reshape(len(values), math.prod(values.shape[1:]))


def coverage_patterns(values: FloatArray) -> Iterator[tuple[BoolArray, IntArray]]:
    """Yield groups of fields with values at the same positions: mask of the positions, and numbers of the fields."""
    finite = np.isfinite(values.T) if values.size else ()
    # np.unique along an axis takes ten times as long
    patterns = lists_by_key((covered.tobytes(), number) for number, covered in enumerate(finite))
    for key, numbers in sorted(patterns.items()):
        yield np.frombuffer(key, dtype=np.bool_), np.array(numbers)


def _merge_places(points: FloatArray, fields: FloatArray) -> tuple[FloatArray, FloatArray, IntArray]:
    """Return distinct positions in order of appearance, the mean of their values, and the position of each sample."""
    _, first, place = np.unique(np.round(points / TIE_M), axis=0, return_index=True, return_inverse=True)
    # restore the order of the samples, because np.unique sorts by coordinate
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    place = rank[place.ravel()]
    if len(first) == len(points):
        return points, fields, place
    # sum differences from one sample of the position, so that the mean of equal values is exact
    base = fields[first[order]]
    base = np.where(np.isfinite(base), base, 0.0)
    finite = np.isfinite(fields)
    total, count = np.zeros_like(base), np.zeros_like(base)
    np.add.at(total, place, np.where(finite, fields - base[place], 0.0))
    np.add.at(count, place, finite)
    mean = np.where(count > 0, base + total / np.maximum(count, 1), np.nan)
    return points[first[order]], mean, place


def _same_geometry(offset_m: FloatArray) -> tuple[IntArray | slice, IntArray | slice]:
    """Return one target of each group with equal offsets (dims, m, t) of neighbours, and the group of each target."""
    t = offset_m.shape[2]
    alone = slice(None), slice(None)
    if len(np.unique(np.round(offset_m[:, 0].sum(axis=0) / TIE_M))) == t:
        return alone  # no two targets share offsets; this test is ten times faster than the comparison below
    # compare integers of a nanometre, which is more than the rounding error of coordinates of kilometres
    offset = np.round(offset_m.reshape(-1, t) / _SHARE_M).astype(np.int64)
    # the sum of the offsets with random odd factors, modulo 2^64, identifies a target
    factors = np.random.default_rng(0).integers(1, 2**62, len(offset), dtype=np.int64) | 1
    _, example, group = np.unique(factors @ offset, return_index=True, return_inverse=True)
    if not (offset[:, example[group]] == offset).all():
        return alone  # a hash collision: share nothing
    return example, group


def _as_points(points_m: ArrayLike) -> FloatArray:
    points = unmasked(points_m)
    if points.ndim != 2 or points.shape[1] not in (2, 3):
        raise UsageError(f"points of shape {points.shape}", expected="(n, 2) or (n, 3): east, north (, up) in metres")
    if not np.isfinite(points).all():
        raise UsageError("a point without finite coordinates", expected="finite east, north (, up) in metres")
    return points


# Smallest number of samples with which a factor of the trend can be distinguished from a constant.
_FEWEST_FOR_TREND = 3


@from_python
@dataclass(eq=False)
class TrendKriging:
    """Universal Kriging with a known field as trend, such as a replayed level or rank (external drift).

    Source: Wackernagel, Multivariate Geostatistics (2003), doi:10.1007/978-3-662-05294-5, chapter 37.

    Parameters
    ----------
    correlation : callable
        Phi(distance [m]) of the residual.
    neighbours, radius_m : int, float
        The same as in :class:`OrdinaryKriging`. With fewer than three samples within the radius, the nearest samples
        are used.
    bounds : (low, high), optional
        Limits of the estimates, such as (1, 4) for ranks.

    Notes
    -----
    The estimate is ``w . z``. The weights solve the system of :class:`OrdinaryKriging` with one more condition: they
    reproduce the trend f, ``w . f = f_0``. The condition is omitted if the trend is nearly constant among the
    neighbours, or if there are fewer than three neighbours.

    Examples
    --------
    >>> places = [[0.0, 0.0], [60.0, 0.0], [0.0, 60.0], [60.0, 60.0]]
    >>> model = TrendKriging(lambda d: np.exp(-d / 50.0)).fit(places, [1.0, 3.0, 5.0, 7.0], [0.0, 1.0, 2.0, 3.0])
    >>> model.predict([[200.0, 0.0]], [10.0])[0].round(9).tolist()  # 2 times the trend, plus 1
    [21.0]
    """

    correlation: Correlation
    neighbours: int = 20
    radius_m: float = 150.0
    _: KW_ONLY
    bounds: tuple[float, float] | None = None

    def fit(self, points_m: ArrayLike, values: ArrayLike, trend: ArrayLike) -> TrendKriging:
        """Store samples (n, dims) with a value (n,) and a trend (n,). Samples with a NaN in either are ignored.

        Raises
        ------
        UsageError
            If the shapes differ, or no sample has both values.
        """
        points, value, known = _as_points(points_m), unmasked(values), unmasked(trend)
        if not value.shape == known.shape == (len(points),):
            raise UsageError(
                f"values of shape {value.shape}, trend {known.shape} for {len(points)} points", expected="(n,) each"
            )
        both = np.isfinite(value) & np.isfinite(known)
        if not both.any():
            raise UsageError("no sample with a value and a trend", expected="one or more")
        self.points_m_, merged, _ = _merge_places(points[both], np.column_stack([value, known])[both])
        self.values_, self.trend_ = merged.T
        centred = self.values_ - np.polyval(
            np.polyfit(self.trend_, self.values_, int(np.ptp(self.trend_) > 0)), self.trend_
        )
        self.sill_ = float(centred @ centred / max(len(centred) - 2, 1))
        return self

    def predict(self, targets_m: ArrayLike, trend: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return estimate and Kriging variance (t,) at targets (t, dims) with a trend (t,). NaN if the trend is NaN."""
        targets, wanted = _as_points(targets_m), unmasked(trend)
        if wanted.shape != (len(targets),):
            raise UsageError(f"trend of shape {wanted.shape} for {len(targets)} targets", expected="(t,)")
        estimate, variance = np.full((2, len(targets)), np.nan)
        chosen = nearest(self.points_m_, targets, self.neighbours, np.inf)
        within = np.where(chosen.distance_m <= self.radius_m + TIE_M, chosen.index, -1)
        index = np.where(((within >= 0).sum(axis=1) >= _FEWEST_FOR_TREND)[:, None], within, chosen.index)
        for row in np.flatnonzero(np.isfinite(wanted)):
            used = index[row][index[row] >= 0]
            estimate[row], variance[row] = self._one(used, targets[row], float(wanted[row]))
        return (estimate if self.bounds is None else np.clip(estimate, *self.bounds)), variance

    def _one(self, used: IntArray, target_m: FloatArray, trend: float) -> tuple[float, float]:
        """Return estimate and variance at one target from the samples ``used``."""
        points, f = self.points_m_[used], self.trend_[used]
        conditions, aim = [np.ones(len(used))], [1.0]
        if len(used) >= _FEWEST_FOR_TREND and np.ptp(f) > 1e-6 * max(float(np.abs(f).max()), 1.0):
            # scale the trend, because values of -100 dBm next to ones would make the system ill-conditioned
            scale = float(np.ptp(f))
            conditions, aim = [*conditions, (f - f.mean()) / scale], [*aim, (trend - float(f.mean())) / scale]
        n, extra = len(used), len(conditions)
        between = np.linalg.norm(points[:, None] - points[None], axis=-1)
        system = np.zeros((n + extra, n + extra))
        system[:n, :n] = np.where(between > TIE_M, 1.0 - np.minimum(self.correlation(between), 1.0), 0.0)
        system[n:, :n] = conditions
        system[:n, n:] = system[n:, :n].T
        away = np.linalg.norm(points - target_m, axis=1)
        right = np.where(away > TIE_M, 1.0 - np.minimum(self.correlation(away), 1.0), 0.0)
        solution = np.linalg.lstsq(system, np.concatenate([right, aim]), rcond=1e-12)[0]
        variance = self.sill_ * float(solution @ np.concatenate([right, aim]))
        return float(solution[:n] @ self.values_[used]), max(variance, 0.0)
