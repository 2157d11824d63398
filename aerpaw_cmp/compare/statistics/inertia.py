"""Ranks of many small channel matrices at once, by counting eigenvalues of their Gram matrices.

The number of eigenvalues of ``G = H^H H`` above ``lambda_1 / K^2`` is the number of positive pivots of
``G - lambda_1 / K^2`` (Sylvester's law of inertia): fifty multiplications for a 4 x 4 matrix, where its singular values
take LAPACK some four microseconds. A count is certain when it is the same on both sides of the threshold, further
apart than all that ``lambda_1`` and the pivots may be off. The others are left to singular values.
"""

from __future__ import annotations

import numpy as np

from ...common.units import BoolArray, ComplexArray, FloatArray, IntArray

# Rows or columns, whichever are fewer: the power sums below make a characteristic polynomial up to this order.
LARGEST = 4
# Matrices at once; they fit into a processor's cache.
LANES = 4096
# Half width of the zone around the threshold, as a share of lambda_1 / K^2, in which singular values decide.
_GUARD = 1e-3
_ITERATIONS = 8


def certain_rank(h: ComplexArray, k: float) -> tuple[IntArray, BoolArray]:
    """Ranks (t,) of channel matrices (t, n_rx, n_tx) at a ratio ``k``, and where they are beyond doubt.

    Matrices without a channel, with an entry that is not finite, or of an extreme scale are never certain.
    """
    # along the shorter side: the Gram matrix is smaller, and its other eigenvalues are zeros
    x = np.moveaxis(h, 0, 2) if h.shape[2] <= h.shape[1] else np.transpose(h, (2, 1, 0))
    # matrices along the last axis: each step is one pass over memory
    x = np.ascontiguousarray(x)
    with np.errstate(all="ignore"):  # what is not finite is not certain
        gram = np.einsum("kit,kjt->ijt", x.conj(), x)
        trace = np.einsum("iit->t", gram).real
        gram /= trace
        largest, step = _largest_eigenvalue(gram)
        threshold = largest / k**2
        above, growth = _positive_pivots(gram.copy(), threshold * (1.0 + _GUARD))
        rank, other_growth = _positive_pivots(gram, threshold * (1.0 - _GUARD))
        certain = (above == rank) & (trace > 1e-200) & (trace < 1e200) & (np.abs(step) < _GUARD * largest)
        certain &= 16.0 * np.finfo(np.float64).eps * np.maximum(growth, other_growth) < _GUARD * threshold
    # the largest singular value counts by definition
    return np.maximum(rank, 1), certain


def _largest_eigenvalue(gram: ComplexArray) -> tuple[FloatArray, FloatArray]:
    """Largest eigenvalue (t,) of Gram matrices (n, n, t) of trace 1, and the last step of Laguerre's iteration.

    The iteration starts above all roots and comes down, threefold nearer per step or better, also to multiple ones.
    There rounding of the polynomial moves the root by up to the fourth root of an ulp: within the guard.
    """
    square = np.einsum("ikt,kjt->ijt", gram, gram)
    p2 = np.einsum("iit->t", square).real
    p3, p4 = (
        np.einsum("ijt,ijt->t", a.real, square.real) + np.einsum("ijt,ijt->t", a.imag, square.imag)
        for a in (gram, square)
    )
    # Newton's identities, with a power sum p1 of 1
    e2 = (1.0 - p2) / 2.0
    e3 = (e2 - p2 + p3) / 3.0
    e4 = (e3 - e2 * p2 + p3 - p4) / 4.0
    root = np.ones(gram.shape[2])
    step = root
    for _ in range(_ITERATIONS):
        value = (((root - 1.0) * root + e2) * root - e3) * root + e4
        slope = ((4.0 * root - 3.0) * root + 2.0 * e2) * root - e3
        bend = (12.0 * root - 6.0) * root + 2.0 * e2
        step = 4.0 * value / (slope + np.sqrt(np.maximum(9.0 * slope**2 - 12.0 * value * bend, 0.0)))
        root = root - step
        if np.abs(step).max() < 0.1 * _GUARD:
            break
    return root, step


def _positive_pivots(matrix: ComplexArray, shift: FloatArray) -> tuple[IntArray, FloatArray]:
    """Positive pivots (t,) of Hermitian ``matrix - shift`` (n, n, t), and how far elimination may magnify rounding.

    The part on and below the diagonal of ``matrix`` is overwritten.
    """
    n, t = len(matrix), matrix.shape[2]
    count, growth = np.zeros(t, dtype=np.int64), np.ones(t)
    for j in range(n):
        pivot = matrix[j, j].real - shift
        count += pivot > 0
        if j < n - 1:
            below = matrix[j + 1 :, j]
            share = below / pivot
            growth *= (1.0 + np.abs(share).max(axis=0)) ** 2
            matrix[j + 1 :, j + 1 :] -= share[:, None] * below.conj()
    return count, growth
