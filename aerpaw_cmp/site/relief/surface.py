"""A smooth ground through points of known height: a Gaussian process, its standard deviation, and draws of it.

The covariance of two places falls with their distance as a Matern function of order 3/2 (slopes are continuous,
curvature is not); its variance and length are those under which the points are most likely.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from ...common.counting import counted
from ...common.errors import UsageError
from ...common.gaussian import Factor
from ...common.geodesy import SiteFrame
from ...common.units import FloatArray
from .dem import Dem

# Cells of the surface as an elevation model, and how many at most.
_CELL_M, _MOST_CELLS = 25.0, 40_000

# Lengths and standard deviations [m] that are tried.
_LENGTHS_M = np.geomspace(30.0, 2000.0, 9)
# Both in steps of some 65 %.
_DEVIATIONS_M = np.geomspace(1.0, 50.0, 9)

# Heights at places this near are of one place; they contradict where they differ by so many standard deviations.
_SAME_PLACE_M, _CONTRADICTION = 1.0, 4.0

# Waves of which a drawn surface is the sum.
_WAVES = 500


@dataclass(frozen=True, slots=True)
class Surface:
    """Ground through points.

    Parameters
    ----------
    place_m : (n, 2)
        East, north of the points [m].
    height_m, error_m : (n,)
        Their heights in any one reference, and the standard deviations of these [m].
    deviation_m, length_m : float
        Of the process.
    level_m : float
        Its mean.
    frame : SiteFrame
        Of the site.
    reach_m : (east_min, east_max, north_min, north_max)
        What the elevation model covers.
    """

    place_m: FloatArray
    height_m: FloatArray
    error_m: FloatArray
    deviation_m: float
    length_m: float
    level_m: float
    frame: SiteFrame
    reach_m: tuple[float, float, float, float]

    def dem(self, drawn: np.random.Generator | None = None) -> Dem:
        """The most likely surface as an elevation model, or one drawn from those that the points allow."""
        return next(self.dems([drawn]))

    def dems(self, draws: Iterable[np.random.Generator | None]) -> Iterator[Dem]:
        """:meth:`dem` of each, the covariance of cells and points computed once."""
        west, east, south, north = self.reach_m
        cell = max(_CELL_M, float(np.sqrt((east - west) * (north - south) / _MOST_CELLS)))
        columns, rows = (int(np.ceil(span / cell)) + 1 for span in (east - west, north - south))
        across, along = (
            west + cell * np.arange(columns, dtype=np.float64),
            south + cell * np.arange(rows, dtype=np.float64),
        )
        place = np.stack(np.meshgrid(across, along), axis=-1).reshape(-1, 2)
        near, factor = self._between(place), self._factor()
        for drawn in draws:
            off = self.height_m - self.level_m
            prior = np.zeros(len(place))
            # a draw of the process, moved by what the points say of it: one solve, no factor of the whole grid
            if drawn is not None:
                waves = self._waves(drawn)
                prior = waves.on_grid(across, along).ravel()
                # heights of points have errors of their own, which each draw throws anew
                off = off + drawn.normal(0.0, self.error_m) - waves(self.place_m)
            height = self.level_m + prior + near @ factor.solve(off)
            yield Dem(
                height_m=height.reshape(rows, columns), west=west, south=south, step_x=cell, step_y=cell, crs="local",
                frame=self.frame,
            )  # fmt: skip

    def sd_m(self, east_m: FloatArray, north_m: FloatArray) -> FloatArray:
        """Standard deviation (places,) of the surface [m]."""
        near = self._between(np.column_stack([east_m, north_m]))
        known = (self._factor().whiten(near.T) ** 2).sum(axis=0)
        # rounding at a point itself
        return np.asarray(np.sqrt(np.maximum(self.deviation_m**2 - known, 0.0)))

    def _between(self, place_m: FloatArray) -> FloatArray:
        return self.deviation_m**2 * _matern(cdist(place_m, self.place_m), self.length_m)

    def _factor(self) -> Factor:
        return Factor.of(self._between(self.place_m) + np.diag(self.error_m**2))

    def _waves(self, random: np.random.Generator) -> _Waves:
        """A draw before any point is known: waves whose vectors have the process' spectrum, Student's t of 3."""
        # of order 3/2 in the plane: a normal over the root of chi-squared of 3 by 3
        vector = random.standard_normal((2, _WAVES)) / (self.length_m * np.sqrt(random.chisquare(3, _WAVES) / 3.0))
        height = self.deviation_m * np.sqrt(2.0 / _WAVES)
        return _Waves(vector, random.uniform(0.0, 2.0 * np.pi, _WAVES), height)


@dataclass(frozen=True, slots=True)
class _Waves:
    """Sum of cosines of one height [m] with wave vectors (2, waves) [rad/m] and phases (waves,)."""

    vector: FloatArray
    phase: FloatArray
    height_m: float

    def __call__(self, place_m: FloatArray) -> FloatArray:
        return np.asarray(self.height_m * np.cos(place_m @ self.vector + self.phase).sum(axis=1))

    def on_grid(self, east_m: FloatArray, north_m: FloatArray) -> FloatArray:
        """The same (north, east) where lines of a grid cross: cosines of the lines alone, by cos(a + b)."""
        east, north = east_m[:, None] * self.vector[0], north_m[:, None] * self.vector[1] + self.phase
        return np.asarray(self.height_m * (np.cos(north) @ np.cos(east).T - np.sin(north) @ np.sin(east).T))


def _matern(distance_m: FloatArray, length_m: float) -> FloatArray:
    scaled = np.sqrt(3.0) * distance_m / length_m
    return np.asarray((1.0 + scaled) * np.exp(-scaled))


def surface_through(points_m: FloatArray, frame: SiteFrame, reach_m: tuple[float, float, float, float]) -> Surface:
    """The surface through points (n, 4) of east, north, height, standard deviation [m].

    Parameters
    ----------
    points_m : (n, 4)
        At least three.
    frame : SiteFrame
    reach_m : (east_min, east_max, north_min, north_max)
        What the elevation model is to cover.

    Returns
    -------
    Surface

    Raises
    ------
    UsageError
        Too few points, or two that contradict.
    """
    if len(points_m) < 3:
        raise UsageError(f"ground_points has {counted(len(points_m), 'point')}", expected="3 or more")
    place, height, error = points_m[:, :2], points_m[:, 2], points_m[:, 3]
    for i, j in sorted(cKDTree(place).query_pairs(_SAME_PLACE_M)):
        if abs(height[i] - height[j]) > _CONTRADICTION * np.hypot(error[i], error[j]):
            raise UsageError(
                f"ground_points {i + 1} and {j + 1} contradict: {height[i]:g} and {height[j]:g} m at one place "
                f"({place[i, 0]:g} m east, {place[i, 1]:g} m north)",
                expected=f"heights at one place within {_CONTRADICTION:g} standard deviations",
                cause="another vertical datum, or an error that is too small",
            )
    length, deviation, level = _likeliest(np.ascontiguousarray(points_m).tobytes())
    return Surface(
        place_m=place, height_m=height, error_m=error, deviation_m=deviation, length_m=length, level_m=level,
        frame=frame, reach_m=reach_m,
    )  # fmt: skip


@lru_cache(maxsize=8)
def _likeliest(points: bytes) -> tuple[float, float, float]:
    """Length, deviation and mean [m] of the process of points; kept, for each stage of a report asks."""
    rows = np.frombuffer(points).reshape(-1, 4)
    place, height, error = rows[:, :2], rows[:, 2], rows[:, 3]
    apart = cdist(place, place)
    tried = [
        (*_likelihood(shape * deviation**2, height, error), float(length), float(deviation))
        for length, shape in ((length, _matern(apart, length)) for length in _LENGTHS_M)
        for deviation in _DEVIATIONS_M
    ]
    _, level, length, deviation = max(tried, key=lambda fit: fit[0])
    return length, deviation, level


def _likelihood(covariance: FloatArray, height_m: FloatArray, error_m: FloatArray) -> tuple[float, float]:
    """Log likelihood of the points under a process, and its most likely mean [m]."""
    factor = Factor.of(covariance + np.diag(error_m**2))
    # generalised least squares: near points count as one
    level = float(np.average(height_m, weights=factor.solve(np.ones(len(height_m)))))
    return factor.log_likelihood(height_m - level), level
