"""The paper's correlation curve (arXiv 2502.10324, section VI-A) and its fit by variable projection."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..common.counting import counted
from ..common.errors import UsageError
from ..common.units import FloatArray, unmasked

# Below any sum of squares that data give: where all vanishes, a quotient is 0 and not NaN.
TINY = 1e-300


@dataclass(frozen=True, slots=True)
class BiExponential:
    """``c1 exp(c2 d) + c3 exp(c4 d)``, d in metres; the faster decay first.

    Source: arXiv 2502.10324 eq. 14.

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
        d = unmasked(distance_m)
        return np.asarray(self.c1 * np.exp(self.c2 * d) + self.c3 * np.exp(self.c4 * d))

    @property
    def nugget(self) -> float:
        """1 - Phi(0+)."""
        return 1.0 - self.c1 - self.c3


# The paper's fit (section VII-C).
PAPER_BIEXPONENTIAL = BiExponential(0.2932, -0.0508, 0.7057, -0.001, 0.0153)


# Trust-region searches of a fit.
STARTS = 6


def fit_biexponential(distance_m: ArrayLike, correlation: ArrayLike) -> BiExponential:
    """Least-squares bi-exponential by variable projection, with c1 and c3 of at least 0 and c1 + c3 of at most 1.

    Source: arXiv 2502.10324 eq. 14.

    For given rates the best amplitudes are a bounded linear problem of two unknowns with a closed form, so only the
    logarithms of the two rates are searched: a grid over the bounds, then a trust-region search from its
    :data:`STARTS` best cells.

    Parameters
    ----------
    distance_m, correlation : (n,)
        The points; NaN pairs do not count.

    Returns
    -------
    BiExponential
        ``degenerate`` tells when one exponential does as well, an amplitude vanishes, the rates coincide or one
        of them lies at a bound.

    Raises
    ------
    UsageError
        With fewer than two usable points.

    Notes
    -----
    Amplitudes of at least 0 keep the curve a valid covariance in any dimension. A correlation is at most 1: data that
    begin beyond distance 0 would let a free fast exponential shoot up between 0 and the first point.

    References
    ----------
    .. [1] Golub and Pereyra, Inverse Problems 19 (2003) R1, doi:10.1088/0266-5611/19/2/201
    """
    problem = _Projection.of(distance_m, correlation)
    if len(problem.d) < 4:
        single = problem.single()
        return problem.result(single, f"{counted(len(problem.d), 'point')} for four coefficients")
    best = problem.double()
    return problem.judge(best)


@dataclass(frozen=True, slots=True)
class _Projection:
    """The reduced problem: residuals as a function of the logarithms of the rates."""

    d: FloatArray
    y: FloatArray
    log_rates: tuple[float, float]

    @classmethod
    def of(cls, distance_m: ArrayLike, correlation: ArrayLike) -> _Projection:
        """The problem of one curve: pairs without a number take no part."""
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
        slow, fast = 1e-6 / d.max(), 10.0 / d[d > 0].min()  # flat over the data; gone at the first bin
        return cls(d, y, (float(np.log(slow)), float(np.log(fast))))

    def amplitudes(self, log_rates: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Best bounded amplitudes (..., 2) and residuals (..., n) for logarithms of rates (..., 2)."""
        basis = np.exp(-np.exp(log_rates)[..., None, :] * self.d[:, None])
        candidates = _candidate_amplitudes(basis, self.y)
        residual = (basis[..., None, :, :] @ candidates[..., :, :, None])[..., 0] - self.y
        pick = np.argmin((residual**2).sum(axis=-1), axis=-1)[..., None, None]
        chosen = np.take_along_axis(candidates, pick, axis=-2)[..., 0, :]
        return chosen, np.take_along_axis(residual, pick, axis=-2)[..., 0, :]

    def double(self) -> FloatArray:
        """Logarithms of the two best rates, the faster first."""
        # on the paper's bins neighbouring rates differ by a factor of 1.5
        axis = np.linspace(*self.log_rates, 48)
        first, second = np.triu_indices(len(axis), 1)
        grid = np.column_stack([axis[second], axis[first]])
        cost = (self.amplitudes(grid)[1] ** 2).sum(axis=1)
        # roughly from each start, to the last digit from the best alone
        refined = np.stack([self._search(grid[cell], 1e-5) for cell in np.argsort(cost)[:STARTS]])
        valley = refined[np.argmin((self.amplitudes(refined)[1] ** 2).sum(axis=1))]
        return np.sort(self._search(valley, 1e-15))[::-1]

    def _search(self, start: FloatArray, tolerance: float) -> FloatArray:
        """Bottom of the valley that a start lies in."""
        from scipy.optimize import least_squares

        fit = least_squares(
            lambda log_rates: self.amplitudes(log_rates)[1],
            np.clip(start, self.log_rates[0] + 1e-9, self.log_rates[1] - 1e-9),
            jac=self._slopes,
            bounds=self.log_rates,
            xtol=tolerance,
            ftol=tolerance,
            gtol=1e-15,
        )
        return np.asarray(fit.x)

    def _slopes(self, log_rates: FloatArray) -> FloatArray:
        """Central differences (n, 2) of the residuals over the logarithms of the rates, all at once."""
        # about the cube root of float64's precision: the step of least error of a central difference
        steps = 1e-5 * np.eye(2)
        ahead, behind = self.amplitudes(log_rates + np.stack([steps, -steps]))[1]
        return np.asarray((ahead - behind).T / 2e-5)

    def single(self) -> float:
        """Logarithm of the rate of the best single exponential: the best of 200, refined between its neighbours."""
        from scipy.optimize import minimize_scalar

        axis = np.linspace(*self.log_rates, 200)
        best = int(np.argmin([self._single_cost(a) for a in axis]))
        bracket = (axis[max(best - 1, 0)], axis[min(best + 1, len(axis) - 1)])
        fit = minimize_scalar(self._single_cost, bounds=bracket, method="bounded", options={"xatol": 1e-13})
        return float(fit.x)

    def _single_amplitude(self, log_rate: float) -> float:
        basis = np.exp(-np.exp(log_rate) * self.d)
        amplitude = float(basis @ self.y / max(basis @ basis, TINY))
        return min(max(amplitude, 0.0), 1.0)

    def _single_cost(self, log_rate: float) -> float:
        curve = self._single_amplitude(log_rate) * np.exp(-np.exp(log_rate) * self.d)
        return float(((curve - self.y) ** 2).sum())

    def result(self, log_rate: float, message: str) -> BiExponential:
        """One exponential as a degenerate pair: c1 = 0."""
        # with c1 = 0 any c2 gives the same curve; this one keeps c2 <= c4
        rate = -float(np.exp(log_rate))
        rmse = float(np.sqrt(self._single_cost(log_rate) / len(self.d)))
        return BiExponential(
            c1=0.0, c2=rate, c3=self._single_amplitude(log_rate), c4=rate, rmse=rmse, degenerate=True, message=message
        )

    def judge(self, log_rates: FloatArray) -> BiExponential:
        """The fit with a verdict on whether two exponentials are in the data."""
        amplitude, residual = self.amplitudes(log_rates)
        cost, n = float((residual**2).sum()), len(self.d)
        single = self.single()
        cost_single = self._single_cost(single)
        c1, c3 = (float(a) for a in amplitude)
        c2, c4 = (-float(rate) for rate in np.exp(log_rates))
        # where both curves meet every point the ratio must be 1, not 0 by 0
        scale = 1e-20 * float((self.y**2).sum())
        # Bayesian information criterion: two more coefficients must pay for themselves
        gain = n * np.log((cost_single + scale) / (cost + scale)) - 2 * np.log(n)
        reasons = []
        if gain <= 0:
            reasons.append("one exponential describes the data as well (BIC)")
        if min(abs(c1), abs(c3)) < 1e-3 * max(abs(c1), abs(c3), 1e-300):
            reasons.append("one of the two amplitudes vanishes")
        # rates within 5 %: one exponential in two parts
        if log_rates[0] - log_rates[1] < 0.05:
            reasons.append("the two rates coincide")
        if log_rates[0] > self.log_rates[1] - 1e-3:
            reasons.append("the fast rate lies at its bound: the first bins hold a jump, not a decay")
        if -c4 * self.d.max() < 1e-3 or log_rates[1] < self.log_rates[0] + 1e-3:
            reasons.append("the slow rate is too small to tell from 0: the tail is flat over the data")
        rmse = float(np.sqrt(cost / n))
        return BiExponential(
            c1=c1, c2=c2, c3=c3, c4=c4, rmse=rmse, degenerate=bool(reasons), message="; ".join(reasons)
        )


def _candidate_amplitudes(basis: FloatArray, target: FloatArray) -> FloatArray:
    """Best points (..., 4, 2) of a two-column least-squares problem inside its bounds and on each edge.

    The bounds are ``c1, c3 >= 0`` and ``c1 + c3 <= 1``; the least cost among the candidates is the bounded optimum,
    because a convex cost has it inside or on an edge.
    """
    gram = np.swapaxes(basis, -1, -2) @ basis
    right = (np.swapaxes(basis, -1, -2) @ target[:, None])[..., 0]
    a, b, c = gram[..., 0, 0], gram[..., 0, 1], gram[..., 1, 1]
    p, q = right[..., 0], right[..., 1]
    none, slope = np.zeros_like(p), _clipped(p - q + c - b, a - 2 * b + c)
    edges = [(none, _clipped(q, c)), (_clipped(p, a), none), (slope, 1.0 - slope)]
    determinant = a * c - b * b
    # equal rates make both columns one: any split of the amplitude is as good
    regular = determinant > 1e-14 * a * c + TINY
    safe = np.where(regular, determinant, 1.0)
    first, second = (c * p - b * q) / safe, (a * q - b * p) / safe
    inside = regular & (np.minimum(first, second) >= 0.0) & (first + second <= 1.0)
    free = (np.where(inside, first, 0.0), np.where(inside, second, edges[0][1]))
    return np.stack([np.stack(pair, axis=-1) for pair in (free, *edges)], axis=-2)


def _clipped(right: FloatArray, square: FloatArray) -> FloatArray:
    """Minimum over [0, 1] of square * x^2 - 2 * right * x."""
    return np.asarray(np.clip(right / np.maximum(square, TINY), 0.0, 1.0))
