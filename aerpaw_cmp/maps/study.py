"""Correlation and interpolation of maps: the paper's comparison (section VII-C)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from ..common.units import FloatArray
from . import evaluate, variogram
from .grid import Grid
from .interpolate import IndexInterpolation, InverseDistance, ServingTowerMean
from .job import MapResult
from .kriging import OrdinaryKriging

# The paper's nine altitudes of interpolation begin here; its 3 m are for blockage alone.
LOWEST_M = 30.0


@dataclass(frozen=True, slots=True)
class Study:
    """The paper's section VII-C on maps: correlation, curve, and leave-one-out errors of each interpolator.

    Parameters
    ----------
    correlation : BinnedCorrelation
        Of the positions' vectors.
    fit : BiExponential
        The curve through it.
    scores : mapping of str to Score
        "Kriging", "makima", "spline" (the paper's), "nearest", "inverse distance", "serving-tower mean"; arrays of
        shape (altitudes, K).
    """

    correlation: variogram.BinnedCorrelation
    fit: variogram.BiExponential
    scores: Mapping[str, evaluate.Score]


def rank_fields(
    result: MapResult, out_of_coverage: Literal["missing", "zero"] = "missing"
) -> tuple[tuple[float, ...], FloatArray]:
    """Altitudes and joint ranks (n, altitudes, K) to interpolate, from 30 m on: the paper leaves 3 m out.

    ``out_of_coverage``: a rank of 0 becomes NaN (no sample), or stays the number 0.

    Source: arXiv 2502.10324 eq. 7; arXiv 2502.10324 eq. 8.
    """
    rows = [i for i, height in enumerate(result.rank_altitudes_m) if height >= LOWEST_M]
    rank = np.moveaxis(result.ranks()[rows], -1, 0).astype(np.float64)
    heights = tuple(result.rank_altitudes_m[i] for i in rows)
    return heights, np.where(rank > 0, rank, np.nan) if out_of_coverage == "missing" else rank


def interpolation_study(
    grid: Grid,
    values: FloatArray,
    towers_m: FloatArray,
    *,
    neighbours: int = 20,
    radius_m: float = 150.0,
    selection: Literal["nearest", "random"] = "nearest",
    seed: int = 0,
) -> Study:
    """Correlation and leave-one-out interpolation of maps.

    Parameters
    ----------
    grid : Grid
        Positions.
    values : (n, altitudes, K)
        Rank or RSS; NaN out of coverage. For RSS the last axis may hold towers.
    towers_m : (towers, 2+)
        For the serving-tower mean.
    neighbours, radius_m, selection, seed
        M, r0 and the choice of samples, the same for every local interpolator.

    Returns
    -------
    Study
        The correlation and its fit, scores of every interpolator.
    """
    points = grid.points_m
    # bins as wide as the grid's step, as the paper's are: narrower ones would be empty
    correlation = variogram.vector_correlation(points, values, width_m=grid.spacing_m)
    fit = _curve(correlation)
    rule: dict[str, Any] = {"neighbours": neighbours, "radius_m": radius_m, "selection": selection, "seed": seed}
    models: dict[str, evaluate.Predictor] = {
        "Kriging": OrdinaryKriging(fit, **rule),
        "makima": IndexInterpolation("makima", grid, **rule),
        "spline": IndexInterpolation("spline", grid, **rule),
        # of one sample the weight is 1 at any distance
        "nearest": InverseDistance(neighbours=1, radius_m=radius_m),
        "inverse distance": InverseDistance(neighbours=neighbours, radius_m=radius_m),
        "serving-tower mean": ServingTowerMean(towers_m),
    }
    scores = {name: evaluate.leave_one_out(model, points, values) for name, model in models.items()}
    return Study(correlation, fit, scores)


def _curve(correlation: variogram.BinnedCorrelation) -> variogram.BiExponential:
    if np.isfinite(correlation.correlation[1:]).any():
        return variogram.fit_biexponential(correlation.distance_m, correlation.correlation)
    # Kriging needs some curve, and says that it is not one of these data
    reason = "no two positions have varying rank vectors: the paper's curve stands in"
    return replace(variogram.PAPER_BIEXPONENTIAL, rmse=float("nan"), degenerate=True, message=reason)
