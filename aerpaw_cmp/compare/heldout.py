"""Parameters fitted on some flights and scored on others.

A number that was fitted on the data it is scored on proves little. The result of this fit therefore names the
flights it was fitted on and keeps the scores of the others apart.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from ..common.units import BoolArray, FloatArray
from .statistics import plain

Objective = Callable[[Mapping[str, float], str], FloatArray]
"""``objective(parameters, flight)`` gives that flight's residuals [dB], its own offset already removed."""

CIRCLE_DEG = 360.0


@dataclass(frozen=True, slots=True)
class HeldOutFit:
    """Parameters and what they are worth.

    Parameters
    ----------
    parameters : mapping of str to float
        The fit.
    fitted_on, applied_to : tuple of str
        Flights.
    train_rmse_db, test_rmse_db : mapping of str to float
        Per flight, with the fitted parameters.
    start_rmse_db : mapping of str to float
        Per flight of both kinds, with the starting parameters.
    at_bounds : tuple of str
        Parameters that ended at a bound: look at them.
    evaluations : int
        Calls of the objective.
    """

    parameters: Mapping[str, float]
    fitted_on: tuple[str, ...]
    applied_to: tuple[str, ...]
    train_rmse_db: Mapping[str, float]
    test_rmse_db: Mapping[str, float]
    start_rmse_db: Mapping[str, float]
    at_bounds: tuple[str, ...]
    evaluations: int

    def as_dict(self) -> dict[str, Any]:
        """For metrics.json."""
        return dict(plain({name: getattr(self, name) for name in self.__slots__}))


def rmse(residual_db: FloatArray) -> float:
    """Root mean square without NaN; NaN if nothing is left."""
    values = np.asarray(residual_db, dtype=np.float64)
    values = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")


def fit_held_out(
    objective: Objective,
    parameters: Mapping[str, Sequence[float]],
    train: Sequence[str],
    test: Sequence[str] = (),
    *,
    start: Mapping[str, float] | None = None,
    refine: bool = True,
    tolerance: float = 1e-3,
    largest_grid: int = 20_000,
    circular: Collection[str] = (),
) -> HeldOutFit:
    """Fit parameters on the flights ``train`` and apply them to the flights ``test``.

    Parameters
    ----------
    objective : callable
        ``objective(parameters, flight) -> residual_db`` (samples,); NaN does not count.
    parameters : mapping of str to sequence of float
        Values to try for each parameter, increasing; the first and last are its bounds. All combinations are tried.
    train, test : sequence of str
        Names of flights, given to the objective. A flight cannot be in both.
    start : mapping of str to float, optional
        Parameters without a fit, for comparison; by default the middle value of each.
    refine : bool
        Search between the grid values with Nelder and Mead's simplex, within the bounds.
    tolerance : float
        Of the refinement, as a share of each parameter's span.
    largest_grid : int
        More combinations are refused.
    circular : collection of str
        Angles [deg] that go round: their values cover the circle (see :func:`goes_round`), so they have no bounds.

    Returns
    -------
    HeldOutFit
        The criterion is the mean over flights of the mean square residual: a long flight does not outvote a short
        one.

    Raises
    ------
    ValueError
        If train is empty, a flight is in both, the grid is too large or no combination has a residual.
    """
    both = sorted(set(train) & set(test))
    if not train or both:
        raise ValueError(f"flights to fit on: {list(train)}; in both lists: {both}; expected two separate lists")
    names = list(parameters)
    values = [np.asarray(parameters[name], dtype=np.float64) for name in names]
    if any(len(v) == 0 or np.any(np.diff(v) <= 0) for v in values):
        raise ValueError("each parameter needs increasing values")
    if np.prod([len(v) for v in values], dtype=np.float64) > largest_grid:
        raise ValueError(f"{[len(v) for v in values]} values make more than {largest_grid} combinations")
    calls = 0

    def score(point: Sequence[float] | FloatArray) -> float:
        nonlocal calls
        calls += len(train)
        given = {name: float(value) for name, value in zip(names, point, strict=True)}
        squares = [rmse(objective(given, flight)) ** 2 for flight in train]
        mean = float(np.mean(squares))
        return mean if np.isfinite(mean) else np.inf

    best = min(product(*values), key=score)
    least = score(best)
    if not np.isfinite(least):
        raise ValueError("no combination of parameters gave a residual on every flight to fit on")
    optimum = np.asarray(best, dtype=np.float64)
    if refine and any(len(v) > 1 for v in values):
        round_ = np.array([name in circular for name in names])
        optimum = _simplex(score, optimum, least, values, tolerance, round_)
    fitted = {name: float(value) for name, value in zip(names, optimum, strict=True)}
    first = dict(start) if start else {n: float(v[len(v) // 2]) for n, v in zip(names, values, strict=True)}
    flights = (*train, *test)
    calls += 2 * len(flights)
    after = {flight: rmse(objective(fitted, flight)) for flight in flights}
    edge = [
        n
        for n, x, v in zip(names, optimum, values, strict=True)
        if len(v) > 1 and n not in circular and _at_bound(x, v)
    ]
    return HeldOutFit(
        parameters=fitted,
        fitted_on=tuple(train),
        applied_to=tuple(test),
        train_rmse_db={f: after[f] for f in train},
        test_rmse_db={f: after[f] for f in test},
        start_rmse_db={flight: rmse(objective(first, flight)) for flight in flights},
        at_bounds=tuple(edge),
        evaluations=calls,
    )


def goes_round(values: Sequence[float] | FloatArray) -> bool:
    """Whether increasing angles [deg] cover the circle: the gap from the last to the first is no wider than another."""
    angles = np.asarray(values, dtype=np.float64)
    if len(angles) < 3:
        return False
    gap = CIRCLE_DEG - (angles[-1] - angles[0])
    return bool(0.0 <= gap <= np.diff(angles).max() * (1.0 + 1e-9))


def _at_bound(value: float, values: FloatArray) -> bool:
    span = float(values[-1] - values[0])
    return bool(min(value - values[0], values[-1] - value) <= 1e-3 * span)


def _simplex(
    score: Callable[[FloatArray], float],
    start: FloatArray,
    least: float,
    values: list[FloatArray],
    tolerance: float,
    circular: BoolArray,
) -> FloatArray:
    """Nelder-Mead in units of each parameter's span (a turn for angles that go round), from the best grid point."""
    from scipy.optimize import minimize

    low = np.array([v[0] for v in values])
    span = np.where(circular, CIRCLE_DEG, [max(float(v[-1] - v[0]), 0.0) for v in values])
    free = span > 0
    step = np.array([1.0 / max(1, len(v) - 1) for v in values])[free] * 0.5
    around = circular[free]

    def point(unit: FloatArray) -> FloatArray:
        full = start.copy()
        full[free] = low[free] + span[free] * np.where(around, unit % 1.0, unit)
        return np.asarray(full, dtype=np.float64)

    origin = (start[free] - low[free]) / span[free]
    corners = origin + np.vstack([np.zeros(len(step)), np.diag(np.where(origin < 0.5, step, -step))])
    corners = np.where(around, corners, np.clip(corners, 0.0, 1.0))
    result = minimize(
        lambda unit: score(point(unit)),
        origin,
        method="Nelder-Mead",
        bounds=[(-1.0, 2.0) if turns else (0.0, 1.0) for turns in around],
        options={"initial_simplex": corners, "xatol": tolerance, "fatol": 1e-6, "maxfev": 200 * len(step)},
    )
    return point(np.asarray(result.x)) if result.fun < least else start
