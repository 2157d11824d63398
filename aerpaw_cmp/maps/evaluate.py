"""Quality of an interpolator: the paper's leave-one-out, and tests in which neighbours do not give the answer away.

Errors are in the unit of the field (rank, dB). Rank is not rounded: the paper's MAE (section VII-C) compares the
interpolated number. A position without a value (NaN, out of coverage) or without an estimate is not scored.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from ..common.errors import UsageError
from ..common.units import FloatArray, IntArray, unmasked


class Predictor(Protocol):
    """Interface that :class:`~aerpaw_cmp.maps.kriging.OrdinaryKriging` and the baselines have in common."""

    def fit(self, points_m: ArrayLike, values: ArrayLike) -> Any:
        """Store samples; returns itself."""

    def predict(self, targets_m: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Estimate and variance at targets."""
        ...

    def leave_one_out(self) -> tuple[FloatArray, FloatArray]:
        """Estimate and variance at each sample from the others."""
        ...


@dataclass(frozen=True, slots=True)
class Score:
    """Errors of each field; every array has the shape of the fields, such as (altitudes, K).

    Parameters
    ----------
    mae, rmse : ndarray
        Mean absolute and root mean square error; NaN where nothing was scored.
    n : ndarray of int
        Scored positions.
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
    known = np.isfinite(truth)
    scored = known & np.isfinite(guess)
    # NaN times zero is NaN: what does not count must leave the sums before they are made
    error = np.where(scored, guess - np.where(known, truth, 0.0), 0.0)
    n = scored.sum(axis=0)

    def mean(x: FloatArray) -> FloatArray:
        return np.asarray(np.where(n > 0, x.sum(axis=0) / np.maximum(n, 1), np.nan))

    return Score(
        mean(np.abs(error)),
        np.sqrt(mean(error**2)),
        np.asarray(n, dtype=np.int64),
    )


def leave_one_out(model: Predictor, points_m: ArrayLike, values: ArrayLike) -> Score:
    """The paper's evaluation: each position from all others; values (n, altitudes, K) give MAE (altitudes, K)."""
    data = unmasked(values)
    estimate, _ = model.fit(points_m, data.reshape(len(data), -1)).leave_one_out()
    return score(data, estimate.reshape(data.shape))


def blocked(model: Predictor, points_m: ArrayLike, values: ArrayLike, block_m: float = 300.0) -> Score:
    """Leave out one square block of the area at a time.

    Near neighbours of a left-out position are left out with it, so that the score says how the interpolator
    bridges gaps of about ``block_m``. Blocks start at the south-western position.

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

    Raises
    ------
    UsageError
        If the side is not positive.

    Notes
    -----
    Spatially blocked cross-validation (Roberts et al. 2017, doi:10.1111/ecog.02881).
    """
    if not block_m > 0:
        raise UsageError(f"blocks of {block_m} m", expected="a positive length")
    points = unmasked(points_m)
    # a position on a seam must not change its block by rounding
    cell = np.floor((points[:, :2] - points[:, :2].min(axis=0)) / block_m + 1e-9).astype(np.int64)
    _, block = np.unique(cell, axis=0, return_inverse=True)
    data = unmasked(values)
    flat = data.reshape(len(data), -1)
    estimate = np.full_like(flat, np.nan)
    for number in np.unique(block):
        test = block.ravel() == number
        # one block that holds everything leaves nothing to learn from: it stays unscored
        if not test.all():
            estimate[test], _ = model.fit(points[~test], flat[~test]).predict(points[test])
    return score(data, estimate.reshape(data.shape))
