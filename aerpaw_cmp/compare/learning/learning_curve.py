"""Error on flights left out against the number of flights that were learned from, and for one more."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .calibration import Observed, Recipe, flights_of, learn, score

# Of each number of flights; where there are more subsets, those of neighbouring flights are taken.
_MOST_FITS = 6

# Numbers of flights that are tried.
_MOST_SIZES = 6


@dataclass(frozen=True, slots=True, kw_only=True)
class CurvePoint:
    """Mean error over the same series [dB], each predicted by every subset of other flights of one size.

    Parameters
    ----------
    flights : int
        That were learned from.
    rmse_db, rmse_4s_db : float
        As logged and over 4 s, after one offset.
    fits : int
        Subsets.
    series : int
        Flights and channels that the mean is over.
    """

    flights: int
    rmse_db: float
    rmse_4s_db: float
    fits: int
    series: int


def learning_curve(observed: Sequence[Observed], recipe: Recipe) -> tuple[CurvePoint, ...]:
    """Error against number of flights, by subsets of the named ones; nothing with fewer than three flights.

    Parameters
    ----------
    observed : sequence of Observed
        Of all flights.
    recipe : Recipe
        Its strengths are chosen within each subset.

    Returns
    -------
    tuple of CurvePoint
        By number of flights, the largest being all but the one that is predicted.
    """
    flights = flights_of(observed)
    if len(flights) < 3:
        return ()
    sizes = np.unique(np.linspace(1, len(flights) - 1, min(len(flights) - 1, _MOST_SIZES)).round().astype(int))
    errors: dict[int, dict[tuple[str, str], list[tuple[float, float]]]] = {}
    fits: dict[int, int] = {}
    for size in map(int, sizes):
        subsets = _subsets(flights, size)
        fits[size], errors[size] = len(subsets), {}
        for subset in subsets:
            learned = learn([o.samples for o in observed if o.samples.flight in subset], recipe)
            known = {o.samples.antenna for o in observed if o.samples.flight in subset}
            targets = [o for o in observed if o.samples.flight not in subset and o.samples.antenna in known]
            for scored in filter(None, (score(o, learned.mean(o.samples)) for o in targets)):
                key = scored.flight, f"{scored.tower}.{scored.channel}"
                errors[size].setdefault(key, []).append((scored.rmse_db, scored.rmse_4s_db))
    # the same series at every number: else a curve may fall because a hard flight left it
    common = set.intersection(*(set(each) for each in errors.values()))
    if not common:
        return ()
    points = []
    for size, each in errors.items():
        rmse, rmse_4s = np.mean([np.mean(each[key], axis=0) for key in sorted(common)], axis=0)
        points.append(
            CurvePoint(
                flights=size, rmse_db=float(rmse), rmse_4s_db=float(rmse_4s), fits=fits[size], series=len(common)
            )
        )
    return tuple(points)


def _subsets(flights: Sequence[str], size: int) -> list[set[str]]:
    """All subsets of a size, or runs of neighbours round the list, evenly begun."""
    if math.comb(len(flights), size) <= _MOST_FITS:
        return [set(subset) for subset in itertools.combinations(flights, size)]
    twice = [*flights, *flights]
    begins = np.unique(np.linspace(0, len(flights), min(len(flights), _MOST_FITS), endpoint=False).round().astype(int))
    return [set(twice[begin : begin + size]) for begin in begins]


def with_one_more(points: Sequence[CurvePoint], name: str = "rmse_db") -> float:
    """Error to expect with one flight more than the largest subset and the one predicted [dB]; NaN with one point.

    Notes
    -----
    The square of the error is fitted as ``a + b / flights`` with b >= 0; ``b / flights`` is what averages out. The last
    three sizes count: with the first flights an error may fall slowly, until they share directions.

    Examples
    --------
    >>> points = [CurvePoint(flights=n, rmse_db=(9 + 7 / n) ** 0.5, rmse_4s_db=3.0, fits=1, series=1) for n in (1, 2)]
    >>> round(with_one_more(points) ** 2, 6) == round(9 + 7 / 3, 6)
    True
    """
    if len(points) < 2:
        return math.nan
    x = np.array([1.0 / p.flights for p in points[-3:]])
    square = np.array([getattr(p, name) ** 2 for p in points[-3:]])
    slope = max(float(np.polyfit(x, square, 1)[0]), 0.0)
    last = points[-1].flights
    return math.sqrt(max(float(square[-1]) - slope * (1.0 / last - 1.0 / (last + 1)), 0.0))
