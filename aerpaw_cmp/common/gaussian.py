"""The Gaussian kernel, and the points that determine a process with some kernel."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from .units import FloatArray, IntArray


def gaussian_kernel(first: FloatArray, second: FloatArray, length: float) -> FloatArray:
    """Gaussian kernel of unit variance between points (n, d) and (m, d): (n, m).

    Examples
    --------
    >>> gaussian_kernel(np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]), 1.0).round(4).tolist()
    [[0.6065]]
    """
    from scipy.spatial.distance import cdist

    return np.asarray(np.exp(-cdist(first, second, "sqeuclidean") / (2.0 * length**2)))


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
    remaining, rows, chosen = np.ones(len(points)), np.empty((min(most, len(points)), len(points))), list[int]()
    while len(chosen) < len(rows) and remaining.max() > share:
        at, known = int(remaining.argmax()), rows[: len(chosen)]
        rows[len(chosen)] = (kernel(points[at : at + 1], points)[0] - known[:, at] @ known) / math.sqrt(remaining[at])
        remaining = np.maximum(remaining - rows[len(chosen)] ** 2, 0.0)
        remaining[at] = 0.0
        chosen.append(at)
    return np.array(chosen, dtype=np.int64)
