"""Weights of many small Kriging systems as compiled loops along the systems; imported only where numba is there."""

from __future__ import annotations

import numpy as np

from ..common.units import BoolArray, FloatArray
from ..propagation.native.numba_options import kernel
from .kriging import SOUND_CONDITION


def try_out() -> None:
    """Compile, and see that the nearer of two samples weighs what the textbook says."""
    weight, variance, _ = solve_schur(np.full((1, 1), 0.5), np.array([[0.25], [0.5]]))
    if not abs(weight[0, 0] - 0.75) + abs(variance[0] - 0.4375) < 1e-12:
        raise ArithmeticError(f"weights {weight[:, 0]}")


def solve_schur(gamma: FloatArray, to_target: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
    """As :func:`aerpaw_cmp.maps.kriging.solve_schur`."""
    weight, (variance, trace) = np.empty_like(to_target), np.empty((2, to_target.shape[1]))
    _solve(gamma, to_target, weight, variance, trace)
    return weight, variance, len(weight) * trace < SOUND_CONDITION


@kernel
def _add_products(total: FloatArray, rows: FloatArray, i: int, j: int, columns: tuple[int, int]) -> None:
    """Sum of ``rows[i] * rows[j]`` over the columns, added to the total."""
    for k in range(columns[0], columns[1]):
        for s in range(len(total)):
            total[s] += rows[i, k, s] * rows[j, k, s]


@kernel
def _solve(  # type: ignore[no-untyped-def]
    gamma, to_target, weight, variance, trace
) -> None:
    """Two rows below ``L`` are ``L^-1 c`` and ``L^-1 1``; ``-L^-1`` lies across, where ``L`` leaves room."""
    m, t = to_target.shape
    rows, total, pivot = np.empty((m + 2, m, t)), np.empty(t), np.empty(t)
    trace[:] = 0.0
    pair = 0
    for j in range(m):
        for i in range(j, m + 2):
            total[:] = 0.0
            _add_products(total, rows, i, j, (0, j))
            if i == m:
                total += to_target[j]
            elif j < i < m:
                total += gamma[pair]
                pair += 1
            for s in range(t):
                pivot[s] = 1.0 / np.sqrt(1.0 - total[s]) if i == j else pivot[s]
                rows[i, j, s] = (1.0 - total[s]) * pivot[s]
        for s in range(t):
            rows[j, j, s] = -pivot[s]
            trace[s] += pivot[s] ** 2
        for i in range(j):
            total[:] = 0.0
            _add_products(total, rows, j, i, (i, j))
            for s in range(t):
                rows[i, j, s] = -total[s] * pivot[s]
                trace[s] += rows[i, j, s] ** 2
    total[:] = 0.0
    pivot[:] = 0.0
    _add_products(total, rows, m, m + 1, (0, m))
    _add_products(pivot, rows, m + 1, m + 1, (0, m))
    for s in range(t):
        variance[s] = (1.0 - total[s]) / pivot[s]
        for k in range(m):
            rows[m, k, s] += variance[s] * rows[m + 1, k, s]
    total[:] = 0.0
    for i in range(m):
        weight[i] = 0.0
        _add_products(weight[i], rows, i, m, (i, m))
        for s in range(t):
            total[s] += weight[i, s]
    for i in range(m):
        for s in range(t):
            weight[i, s] /= total[s]
            variance[s] += weight[i, s] * to_target[i, s]
