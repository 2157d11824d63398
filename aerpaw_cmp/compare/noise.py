"""Noise with two correlation times along a flight, and least-squares fits under this noise.

The residual of a level is the sum of a slowly and a quickly fading first-order autoregressive sequence.

References: MacKay, Neural Computation 4 (1992) 415, doi 10.1162/neco.1992.4.3.415, on marginal likelihoods; Granger and
Morris, J. R. Stat. Soc. A 139 (1976) 246, doi 10.2307/2345178, on sums of autoregressive sequences.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import NamedTuple

import numpy as np

from ..common.units import FloatArray


class NoiseParameters(NamedTuple):
    """The parameters of the noise, as indices into :data:`_SLOW`, :data:`_FAST` and :data:`_SLOW_SHARE`."""

    slow: int
    fast: int
    share: int

    @property
    def near(self) -> list[NoiseParameters]:
        """These parameters, and all parameters with one index that is one step higher or lower."""
        sizes = len(_SLOW), len(_FAST), len(_SLOW_SHARE)
        steps = [(0, 0), *((i, step) for i in range(3) for step in (-1, 1))]
        moved = [tuple(p + step * (k == i) for k, p in enumerate(self)) for i, step in steps]
        return [NoiseParameters(*m) for m in moved if all(0 <= p < size for p, size in zip(m, sizes, strict=True))]

    @property
    def log_prior(self) -> float:
        """Log prior density of the parameters: log-normal in unusually long slow correlation times, else constant.

        Without this prior, fading that lasts minutes could explain every error.
        """
        times = -1.0 / math.log(_SLOW[self.slow]) / _FADES_S
        return -0.5 * (math.log(max(times, 1.0)) / _FADES_FACTOR) ** 2 if _SLOW_SHARE[self.share] else 0.0


_SLOW = (0.8, 0.87, 0.92, 0.95, 0.97, 0.985, 0.995)
_FAST = (0.0, 0.3, 0.5, 0.7, 0.8)
_SLOW_SHARE = (0.0, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 1.0)
# The correlation length of shadowing in open land is 37 m (3GPP TR 38.901, table 7.5-6): 7 s at 5 m/s. In the prior, a
# factor of three is one standard deviation.
_FADES_S, _FADES_FACTOR = 7.0, math.log(3.0)
START = NoiseParameters(4, 2, 3)
# The search for the likeliest parameters starts at the middle of the grid and at white noise.
_STARTS = (START, NoiseParameters(0, 0, 0))


@dataclass(frozen=True, slots=True)
class NoiseFit:
    """The result of a fit: log likelihood, residual (n,) [dB] and parameters of the noise."""

    log_likelihood: float
    residual_db: FloatArray
    parameters: NoiseParameters


@cache
def _whitening(parameters: NoiseParameters) -> tuple[tuple[float, float, float], float, float]:
    """Return the whitening filter (3 coefficients of the input, 1 of the output), and output SD over input SD.

    The sum of two first-order autoregressive sequences is an ARMA(2, 1) sequence (Granger and Morris).
    """
    share = _SLOW_SHARE[parameters.share]
    # set the correlation of a part with a share of 0 to 0, so that parameters of the same noise have exactly equal
    # likelihoods
    slow, fast = _SLOW[parameters.slow] * (share > 0.0), _FAST[parameters.fast] * (share < 1.0)
    shocks = share * (1.0 - slow**2), (1.0 - share) * (1.0 - fast**2)
    power = shocks[0] * (1.0 + fast**2) + shocks[1] * (1.0 + slow**2)
    neighbour = shocks[0] * fast + shocks[1] * slow
    half = 0.5 * power / neighbour if neighbour > 1e-12 else math.inf
    theta = half - math.sqrt(half**2 - 1.0) if math.isfinite(half) else 0.0
    innovation = neighbour / theta if theta else power
    return (1.0, -slow - fast, slow * fast), theta, math.sqrt(innovation)


@dataclass(frozen=True, slots=True)
class Columns:
    """One or more columns (n, k) of a design matrix, whitened only once per set of noise parameters for many fits."""

    values: FloatArray
    _white: dict[NoiseParameters, FloatArray] = field(default_factory=dict, init=False, repr=False, compare=False)

    def white(self, parameters: NoiseParameters) -> FloatArray:
        """Return the columns (n, k) after the filter that whitens noise with the given parameters."""
        if parameters not in self._white:
            self._white[parameters] = _whitened(self.values, parameters)
        return self._white[parameters]


def _whitened(columns: FloatArray, parameters: NoiseParameters) -> FloatArray:
    from scipy.linalg.lapack import dtbtrs  # scipy.signal takes 0.4 s to load

    ahead, back, root = _whitening(parameters)
    # assume that values before the first row equal the first row. Use Fortran order, because LAPACK solves by column.
    before = np.empty((len(columns) + 2, columns.shape[1]), order="F")
    before[:2], before[2:] = columns[:1], columns
    moved = ahead[0] * before[2:] + ahead[1] * before[1:-1] + ahead[2] * before[:-2]
    moved[0] /= 1.0 - back
    filter_ = np.ones((2, len(columns)), order="F")
    filter_[1] = -back
    white = dtbtrs(filter_, moved, uplo="L", overwrite_b=True)[0]
    white[0] = root * columns[0]
    return np.asarray(white)


def fit_under_noise(residual: FloatArray, designs: Sequence[Columns], at: NoiseParameters, search: bool) -> NoiseFit:
    """Fit the coefficients of some designs (n, k) to a residual (n,) under noise with the given parameters.

    Coefficients have a unit normal prior. The likelihood is integrated over the coefficients, and the residual uses
    their posterior means. The noise has its most likely standard deviation.

    Parameters
    ----------
    residual : ndarray, (n,)
        Errors of consecutive means [dB].
    designs : sequence of Columns
        Effect of each fitted coefficient on the residual.
    at : NoiseParameters
        Parameters of the noise, or the start of the search.
    search : bool
        True to search for the most likely parameters, starting from ``at`` and from fixed starts.

    Returns
    -------
    NoiseFit
        Log likelihood, residual and parameters of the noise.
    """
    tried = dict[NoiseParameters, tuple[float, FloatArray]]()
    best, further = at, [*{at, *_STARTS}] if search else [at]
    while further:
        tried |= {parameters: _fits(residual[:, None], designs, parameters)[0] for parameters in further}
        best = max(tried, key=lambda parameters: tried[parameters][0])
        further = [parameters for parameters in best.near if search and parameters not in tried]
    likelihood, coefficients = tried[best]
    return NoiseFit(likelihood, residual - np.column_stack([of.values for of in designs]) @ coefficients, best)


def log_likelihoods(residuals: FloatArray, designs: Sequence[Columns], at: NoiseParameters) -> FloatArray:
    """Return the log likelihood (m,) of each of m residuals (n, m) under the same noise and with the same designs."""
    return np.array([likelihood for likelihood, _ in _fits(residuals, designs, at)])


def _fits(residuals: FloatArray, designs: Sequence[Columns], at: NoiseParameters) -> list[tuple[float, FloatArray]]:
    """Return the log likelihood and the coefficients (k,) of each residual (n, m) with some designs."""
    from scipy.linalg.lapack import dsyevd

    n, targets = len(residuals), _whitened(residuals, at)
    constant = math.log(_whitening(at)[2]) + at.log_prior
    design = [columns.white(at) for columns in designs]
    fits = []
    for i in range(targets.shape[1]):
        white = np.column_stack([targets[:, i : i + 1], *design])
        gram = white.T @ white
        power, axes, _ = dsyevd(gram[1:, 1:])
        power, along = np.maximum(power, 0.0), axes.T @ gram[1:, 0]
        # ignore combinations of coefficients that the samples do not determine
        fixed = power > 1e-9 * power[-1]
        left = max(float(gram[0, 0] - (along[fixed] ** 2 / power[fixed]).sum()), n * LEAST_VARIANCE)
        # a coefficient that is fully determined uses one degree of freedom
        variance = left / max(n - float((power / (power + left / n)).sum()), 1.0)
        mean = along / (power + variance)
        square = float(gram[0, 0] - along @ mean) / variance
        size = (n - len(power)) * math.log(variance) + float(np.log(variance + power).sum())
        fits.append((-0.5 * (size + square) + constant, axes @ mean))
    return fits


LEAST_VARIANCE = 1e-12


def shifts_in_masks(
    residual: FloatArray, masks: FloatArray, phis: Sequence[float]
) -> list[tuple[FloatArray, FloatArray, FloatArray]]:
    """Return the level shift in each mask (m, n), its standard error and its gain in log likelihood.

    The list has one entry for each lag-one autocorrelation in ``phis``.
    """
    before, after = masks[:, :-1], masks[:, 1:]
    sums = after.sum(axis=1), before.sum(axis=1)
    squares = [np.einsum("ij,ij->i", *of) for of in ((after, after), (after, before), (before, before))]
    shifts = []
    for phi in phis:
        # subtract the prediction from the previous sample, so that slow fading is not mistaken for a shift
        y = residual[1:] - phi * residual[:-1]
        y = y - y.mean()
        # sums over the masks after the same subtraction
        along = after @ y - phi * (before @ y)
        power = squares[0] - 2.0 * phi * squares[1] + phi**2 * squares[2] - (sums[0] - phi * sums[1]) ** 2 / len(y)
        shift = np.divide(along, power, out=np.zeros(len(power)), where=power > 1e-9)
        left = np.maximum(y @ y - shift**2 * power, 1e-12)
        error = np.sqrt(np.divide(left, len(y) * power, out=np.zeros(len(power)), where=power > 1e-9))
        shifts.append((shift, error, -0.5 * len(y) * np.log(left / max(float(y @ y), 1e-12))))
    return shifts


def squares_of_halves(error: FloatArray, columns: FloatArray, memory: float) -> tuple[float, float]:
    """Return the sums of squares of an error (n,), without and with a fit of columns (n, k).

    Each half of the flight is tested with coefficients that were fitted to the other half.

    ``memory`` is the number of consecutive samples that count as one independent sample of the error.
    """
    before = after = 0.0
    first = np.arange(len(error)) < len(error) // 2
    for fitted, other in ((first, ~first), (~first, first)):
        x, y = columns[fitted] - columns[fitted].mean(axis=0), error[fitted] - error[fitted].mean()
        noise = memory * max(float(y.var()), LEAST_VARIANCE) * np.eye(columns.shape[1])
        left = error - columns @ np.linalg.solve(x.T @ x + noise, x.T @ y)
        before += len(error) * float(error[other].var())
        after += len(error) * float(left[other].var())
    return before, after
