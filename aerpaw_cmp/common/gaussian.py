"""Gaussian processes: a kernel, the points that determine a process, and predictions from known values.

A process is described only by its covariances. ``C`` is the covariance of the known values (including their noise),
``K`` is the covariance of the targets with the known values, and ``L L' = C``. Every prediction is a product with the
white values ``L^-1 y`` of known ``y`` (Rasmussen and Williams, Gaussian Processes for Machine Learning, algorithm 2.1).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .errors import InputError
from .units import FloatArray, IntArray


def gaussian_kernel(first: FloatArray, second: FloatArray, length: float) -> FloatArray:
    """Return the Gaussian kernel of unit variance between points (n, d) and (m, d), shape (n, m).

    Examples
    --------
    >>> gaussian_kernel(np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]), 1.0).round(4).tolist()
    [[0.6065]]
    """
    from scipy.spatial.distance import cdist

    kernel = np.asarray(cdist(first, second, "sqeuclidean"))
    # compute in place, because allocating two more matrices of this size would take as long as the exponentials
    kernel /= -2.0 * length**2
    np.exp(kernel, out=kernel)
    return kernel


@dataclass(frozen=True, slots=True, eq=False)
class Factor:
    """Lower Cholesky factor (n, n) of the covariance of known values.

    Examples
    --------
    >>> known = Factor.of(np.array([[4.0, 2.0], [2.0, 2.0]]))
    >>> mean, explained = known.condition(np.array([[2.0, 0.0]]), known.whiten(np.array([1.0, 1.0])))
    >>> mean.round(9).tolist(), explained.round(9).tolist()
    ([0.0], [2.0])
    """

    lower: FloatArray

    @classmethod
    def of(cls, covariance: FloatArray) -> Factor:
        """Factor a symmetric matrix (n, n) in place.

        Raises
        ------
        InputError
            If the matrix is not positive definite, or not finite.
        """
        from scipy.linalg import LinAlgError, cholesky

        try:
            # one NaN or infinity makes the sum non-finite; a mask of the matrix would cost an eighth of its memory
            if not np.isfinite(covariance.sum()):
                raise ValueError("numbers that are not finite")
            # the transpose is the same matrix in the order that LAPACK uses
            return cls(np.asarray(cholesky(covariance.T, lower=True, overwrite_a=True, check_finite=False)))
        except (LinAlgError, ValueError) as error:
            raise InputError(
                f"the equations of the fit cannot be solved ({error})",
                expected="levels that are finite and vary",
                cause="a channel that never changes, or values that are not levels",
            ) from None

    def whiten(self, values: FloatArray) -> FloatArray:
        """Return ``L^-1 y`` of values (n,) or (n, k), which are uncorrelated with unit variance."""
        from scipy.linalg import solve_triangular

        return np.asarray(solve_triangular(self.lower, values, lower=True, check_finite=False))

    def solve(self, values: FloatArray) -> FloatArray:
        """Return ``C^-1 y`` of values (n,) or (n, k)."""
        from scipy.linalg import cho_solve

        return np.asarray(cho_solve((self.lower, True), values, check_finite=False))

    def condition(self, across: FloatArray, white: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return mean and explained variance at targets, given the known values.

        Parameters
        ----------
        across : (m, n)
            Covariance of the targets with the known values.
        white : (n,) or (n, k)
            The known values after :meth:`whiten`.

        Returns
        -------
        mean : (m,) or (m, k)
            ``K C^-1 y``.
        explained : (m,)
            ``diag(K C^-1 K')``: the amount by which the known values reduce the variance of each target.
        """
        half = self.whiten(across.T)
        return half.T @ white, np.einsum("nm,nm->m", half, half)

    def log_likelihood(self, values: FloatArray) -> float:
        """Return the log likelihood of values (n,) up to a constant: ``-y' C^-1 y / 2 - log det(C) / 2``."""
        white = self.whiten(values)
        return -0.5 * float(white @ white) - float(np.log(np.diag(self.lower)).sum())

    def inverse(self) -> FloatArray:
        """Return ``C^-1``, in a third of the time that solving for the identity matrix takes."""
        from scipy.linalg.lapack import dpotri

        # LAPACK fills one triangle and does not clear the other
        triangle = np.tril(dpotri(self.lower, lower=True)[0])
        return np.asarray(triangle + np.tril(triangle, -1).T)


def determining(
    points: FloatArray, kernel: Callable[[FloatArray, FloatArray], FloatArray], share: float, most: int
) -> IntArray:
    """Return the indices of points whose values determine a process of unit variance at all points.

    Parameters
    ----------
    points : (n, d)
    kernel : callable
        Covariance (k, m) of points (k, d) and (m, d).
    share : float
        Largest share of the variance that remains at any point.
    most : int
        Largest number of points. If this number is reached first, more than ``share`` of the variance remains at some
        points.

    Returns
    -------
    (k,) int
        Indices in order of selection.

    Notes
    -----
    Pivoted Cholesky decomposition of the kernel: the point with the largest remaining variance is selected next
    (Harbrecht, Peters and Schneider, Appl. Numer. Math. 62 (2012), doi:10.1016/j.apnum.2011.10.001).
    """
    remaining, rows, chosen = np.ones(len(points)), np.empty((min(most, len(points)), len(points))), list[int]()
    while len(chosen) < len(rows) and remaining.max() > share:
        at, known = int(remaining.argmax()), rows[: len(chosen)]
        rows[len(chosen)] = (kernel(points[at : at + 1], points)[0] - known[:, at] @ known) / math.sqrt(remaining[at])
        remaining = np.maximum(remaining - rows[len(chosen)] ** 2, 0.0)
        # set the remaining variance of this point to exactly 0: with a rounding error, the point could be selected
        # again
        remaining[at] = 0.0
        chosen.append(at)
    return np.array(chosen, dtype=np.int64)
