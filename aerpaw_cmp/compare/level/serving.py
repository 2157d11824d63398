"""Serving cell: the one that the prediction says is strongest, against the one that the phone was on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ...common.units import FloatArray, IntArray, unmasked


@dataclass(frozen=True, slots=True, kw_only=True)
class ServingComparison:
    """Serving cells, logged against predicted.

    Parameters
    ----------
    cells : tuple of str
    confusion : (cells, cells + 1) int
        Samples by the cell that served (row) and the one predicted strongest (column); the last column counts samples
        at which no cell is predicted at all.
    n : int
        Samples with a serving cell among ``cells``.
    """

    cells: tuple[str, ...]
    confusion: IntArray
    n: int

    @property
    def hit_share(self) -> float:
        """Share of the samples whose serving cell is the one predicted strongest; NaN without samples."""
        return float(np.trace(self.confusion) / self.n) if self.n else float("nan")

    @property
    def majority_share(self) -> float:
        """Share that always naming the cell that served most would hit: what a prediction has to beat."""
        return float(self.confusion.sum(axis=1).max() / self.n) if self.n else float("nan")

    def as_dict(self) -> dict[str, Any]:
        """For metrics.json."""
        names = (*self.cells, "none")
        return {
            "cells": list(self.cells),
            "n": self.n,
            "hit_share": self.hit_share,
            "majority_share": self.majority_share,
            "confusion": {
                cell: dict(zip(names, map(int, row), strict=True))
                for cell, row in zip(self.cells, self.confusion, strict=True)
            },
        }


def compare_serving(served: ArrayLike, predicted_dbm: ArrayLike, cells: Sequence[str]) -> ServingComparison:
    """Serving-cell hits and the confusion matrix.

    Parameters
    ----------
    served : array_like, int, (n,)
        Index of the serving cell; negative where it is not known or none of ``cells``: left out.
    predicted_dbm : array_like, (n, cells)
        NaN where no path is predicted. Of equal levels the first cell counts as strongest.
    cells : sequence of str

    Examples
    --------
    >>> compare_serving([0, 1, 1, -1], [[-70, -80], [-75, -71], [-60, -90], [-60, -90]], ["a", "b"]).confusion.tolist()
    [[1, 0, 0], [1, 1, 0]]
    """
    # unknown is no cell: -1 would be the last one as an index
    index = np.nan_to_num(unmasked(served), nan=-1.0).astype(np.int64)
    level: FloatArray = unmasked(predicted_dbm)
    known = index >= 0
    filled = np.where(np.isnan(level), -np.inf, level)
    strongest = np.where(np.isnan(level).all(axis=1), len(cells), filled.argmax(axis=1) if len(cells) else 0)
    confusion = np.zeros((len(cells), len(cells) + 1), dtype=np.int64)
    # add.at counts a pair as often as it comes; += would count it once
    np.add.at(confusion, (index[known], strongest[known]), 1)
    return ServingComparison(cells=tuple(cells), confusion=confusion, n=int(known.sum()))


def at_times(time_s: ArrayLike, of_s: ArrayLike, values: ArrayLike, *, within_s: float) -> FloatArray:
    """Values of one clock at the times of another: those of the nearest sample, NaN where none is near.

    Parameters
    ----------
    time_s : array_like, (n,)
        Times asked for [s].
    of_s : array_like, (m,)
        Times of the values, ascending [s].
    values : array_like, (m,)
    within_s : float
        Farther samples do not count [s].

    Returns
    -------
    (n,)
        In the unit of ``values``.
    """
    instants, sampled_s = unmasked(time_s), unmasked(of_s)
    column = unmasked(values)
    if not len(sampled_s):
        return np.full(len(instants), np.nan)
    after = np.clip(np.searchsorted(sampled_s, instants), 0, len(sampled_s) - 1)
    before = np.maximum(after - 1, 0)
    near = np.where(np.abs(sampled_s[before] - instants) <= np.abs(sampled_s[after] - instants), before, after)
    return np.where(np.abs(sampled_s[near] - instants) <= within_s, column[near], np.nan)
