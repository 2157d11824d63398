"""The Gaussian kernel, and the points that determine a process with some kernel."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from .units import FloatArray, IntArray


def gaussian_kernel(one: FloatArray, other: FloatArray, length: float) -> FloatArray:
    """Gaussian kernel of unit variance between points (n, d) and (m, d): (n, m).

    Examples
    --------
    >>> gaussian_kernel(np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]), 1.0).round(4).tolist()
    [[0.6065]]
    """
    from scipy.spatial.distance import cdist

    return np.asarray(np.exp(-cdist(one, other, "sqeuclidean") / (2.0 * length**2)))


def determining(
    points: FloatArray, kernel: Callable[[FloatArray, FloatArray], FloatArray], share: float, most: int
) -> IntArray:
    """Numbers of those points that determine a process of unit variance at all of them.

    Parameters
    ----------
    points : (n, d)
    kernel : callable
        Covariance (k, m) of points (k, d) and (m, d).
    share : float
        Share of the variance that may be left at any point.
    most : int
        Largest number of points taken; where they do not suffice, more than the share is left.

    Returns
    -------
    (k,) int
        In the order in which they were taken.

    Notes
    -----
    Pivoted Cholesky decomposition of the kernel: the point of largest variance left is taken next (Harbrecht, Peters
    and Schneider, Appl. Numer. Math. 62 (2012), doi:10.1016/j.apnum.2011.10.001).
    """
    left, rows, taken = np.ones(len(points)), np.empty((min(most, len(points)), len(points))), list[int]()
    while len(taken) < len(rows) and left.max() > share:
        at, known = int(left.argmax()), rows[: len(taken)]
        rows[len(taken)] = (kernel(points[at : at + 1], points)[0] - known[:, at] @ known) / math.sqrt(left[at])
        left = np.maximum(left - rows[len(taken)] ** 2, 0.0)
        left[at] = 0.0
        taken.append(at)
    return np.array(taken, dtype=np.int64)
