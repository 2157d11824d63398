"""Rank of a channel, and how two sequences of ranks compare.

``rank`` counts singular values above ``sigma_1 / K`` (strictly); 0 means that there is no channel. Measured RI is
a float with NaN where the modem gave no CSI; it is never 0.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ..units import ComplexArray, FloatArray, IntArray

MAX_RANK = 4
"""Ranks of the histograms: 1 to 4 (RI of the AERPAW modems)."""

_CHUNK = 1 << 20
"""Matrix entries per SVD batch: bounds memory."""


def singular_values(h: ArrayLike) -> FloatArray:
    """Singular values of every channel matrix, divided by the largest magnitude of an entry.

    Parameters
    ----------
    h : array_like, complex, (..., n_rx, n_tx)
        Channel matrices. Only ratios of singular values matter to a rank, so each matrix is scaled by a power of
        two before its decomposition: entries of 1e-150 or 1e150 neither vanish nor overflow.

    Returns
    -------
    ndarray, (..., min(n_rx, n_tx))
        Descending, relative to the scale of each matrix; zeros for an all-zero matrix, NaN where an entry is not
        finite.

    Examples
    --------
    >>> singular_values([[[4e-160, 0], [0, 1e-160]]]).shape
    (1, 2)
    """
    matrix = np.asarray(h, dtype=np.complex128)
    if matrix.ndim < 2:
        raise ValueError(f"H must have shape (..., n_rx, n_tx), found {matrix.shape}")
    lead, (rows, columns) = matrix.shape[:-2], matrix.shape[-2:]
    flat = matrix.reshape(-1, rows, columns)
    result = np.full((len(flat), min(rows, columns)), np.nan)
    step = max(1, _CHUNK // max(1, rows * columns))
    for start in range(0, len(flat), step):
        part = flat[start : start + step]
        good = np.isfinite(part).all(axis=(1, 2))
        result[start : start + step][good] = np.linalg.svd(_scaled(part[good]), compute_uv=False)
    return result.reshape(*lead, -1)


def _scaled(matrix: ComplexArray) -> ComplexArray:
    """Each matrix times the power of two that brings its largest part into [0.5, 1): exact."""
    if not matrix.size:
        return matrix
    largest = np.maximum(np.abs(matrix.real), np.abs(matrix.imag)).max(axis=(1, 2))
    _, exponent = np.frexp(largest)
    shift = -exponent[:, None, None]
    return np.ldexp(matrix.real, shift) + 1j * np.ldexp(matrix.imag, shift)


def rank_from_singular_values(sigma: ArrayLike, k: float) -> IntArray:
    """Ranks of singular-value profiles (..., m), as in :func:`channel_rank`; NaN profiles give 0.

    Singular values that tie with ``sigma_1 / k`` do not count (strict). SVD noise is a few ulp of ``sigma_1``, so a
    tie is decided with a margin of ``8 eps sigma_1``: 1 and 0.1 at K = 10 is rank 1, whatever the rounding.
    """
    if not k >= 1:
        raise ValueError(f"K is a ratio of singular values and must be >= 1, found {k}")
    values = np.asarray(sigma, dtype=np.float64)
    if not values.shape[-1]:
        return np.zeros(values.shape[:-1], dtype=np.int64)
    largest = values.max(axis=-1, keepdims=True)
    margin = 8.0 * np.finfo(np.float64).eps
    above = values > largest * (1.0 / k + margin)
    # the largest one counts by definition, also at K = 1 where it ties with itself only by rounding
    alive = (largest[..., 0] > 0) & np.isfinite(largest[..., 0])
    rank = above.sum(axis=-1)
    if k > 1:
        rank = np.maximum(rank, 1)
    return np.where(alive, rank, 0).astype(np.int64)


def channel_rank(h: ArrayLike, k: float) -> IntArray:
    """Number of singular values above ``sigma_1 / k`` (strict) of every channel matrix.

    Parameters
    ----------
    h : array_like, complex, (..., n_rx, n_tx)
        Channel matrices; any scale.
    k : float
        Ratio of singular values, >= 1 (the paper's K = 10, 100, 1000; its "10, 20, 30 dB").

    Returns
    -------
    ndarray of int, (...)
        0 = no channel (all entries zero, or an entry is NaN or infinite: no path reached the receiver).

    Raises
    ------
    ValueError
        If ``h`` has fewer than two axes or ``k < 1``.

    Notes
    -----
    Source: arXiv 2502.10324, section III. At ``k = 1`` nothing exceeds ``sigma_1`` and every rank is 0.

    Examples
    --------
    >>> import numpy as np
    >>> h = np.diag([1.0, 0.2, 0.1, 0.05])
    >>> channel_rank(h, 10), channel_rank(1e-150 * h, 1000), channel_rank(0 * h, 10)
    (array(2), array(4), array(0))
    """
    return rank_from_singular_values(singular_values(h), k)


def _ranks(rank: ArrayLike) -> FloatArray:
    return np.asarray(rank, dtype=np.float64).ravel()


def histogram(rank: ArrayLike, *, max_rank: int = MAX_RANK, weights: ArrayLike | None = None) -> FloatArray:
    """Shares of rank 1 .. ``max_rank``; 0 (no channel) and NaN (no CSI) do not take part.

    Parameters
    ----------
    rank : array_like
        Ranks, any shape.
    max_rank : int
        Higher ranks are an error.
    weights : array_like, optional
        One per rank, e.g. how long it held.

    Returns
    -------
    ndarray, (max_rank,)
        Sums to one; all NaN when nothing counts.

    Examples
    --------
    >>> histogram([1, 2, 2, 0, float("nan")]).round(3).tolist()
    [0.333, 0.667, 0.0, 0.0]
    """
    values = _ranks(rank)
    weight = np.ones(len(values)) if weights is None else _ranks(weights)
    counts = np.isfinite(values) & (values >= 1)
    if np.any(values[counts] > max_rank) or np.any(values[counts] != np.round(values[counts])):
        raise ValueError(f"ranks must be whole numbers up to {max_rank}")
    bars = np.bincount(values[counts].astype(np.int64), weights=weight[counts], minlength=max_rank + 1)[1:]
    total = bars.sum()
    return np.asarray(bars / total) if total > 0 else np.full(max_rank, np.nan)


def agreement(measured: ArrayLike, simulated: ArrayLike) -> float:
    """Share of poses at which both ranks exist (not NaN, not 0) and are equal; NaN when none does.

    Examples
    --------
    >>> agreement([1, 2, 2, float("nan")], [1, 2, 3, 1])
    0.6666666666666666
    """
    one, two = _ranks(measured), _ranks(simulated)
    if one.shape != two.shape:
        raise ValueError(f"measured has {one.size} ranks, simulated {two.size}: they must be pairs")
    both = (one >= 1) & (two >= 1)
    return float(np.mean(one[both] == two[both])) if both.any() else float("nan")


def total_variation(one: ArrayLike, two: ArrayLike) -> float:
    """Total variation distance of two histograms of shares: half the sum of absolute differences, 0 to 1.

    Examples
    --------
    >>> total_variation([0.5, 0.5, 0, 0], [1, 0, 0, 0])
    0.5
    """
    return float(0.5 * np.abs(np.asarray(one, dtype=np.float64) - np.asarray(two, dtype=np.float64)).sum())


def wasserstein(one: ArrayLike, two: ArrayLike) -> float:
    """Wasserstein-1 distance of two rank histograms [ranks]: how far shares must move, in ranks.

    Examples
    --------
    >>> wasserstein([1, 0, 0, 0], [0, 0, 0, 1])
    3.0
    """
    step = np.cumsum(np.asarray(one, dtype=np.float64) - np.asarray(two, dtype=np.float64))
    return float(np.abs(step[:-1]).sum())
