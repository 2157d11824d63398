"""The map job: RSS and rank of every tower at every position and altitude, alone and jointly.

The replay engine is handed in as a function, so that nothing here knows an engine::

    evaluate(position_m (n, 3), tower_names) -> Evaluation

It is called for one altitude and at most ``chunk`` positions at a time; what grows with the number of altitudes is
the result alone: per tower and position 24 bytes of levels, 16 bytes of singular-value ratios, 1 byte of rank per K.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..common.errors import UsageError
from ..common.units import BoolArray, FloatArray, IntArray, db_from_power, unmasked
from ..compare.rank import rank_from_singular_values
from .grid import (
    Border,
    Grid,
    Layer,
    class_names,
    serving_tower,
    voronoi_borders,
)

# Section VII: ranks at 3 m as well, to highlight what blocks there; levels at three of the other heights.
PAPER_RSS_ALTITUDES_M = (30.0, 70.0, 110.0)
PAPER_RANK_ALTITUDES_M = (3.0, *(float(h) for h in range(30, 111, 10)))
PAPER_KS = (10.0, 100.0, 1000.0)
# Positions of one call: H of five towers with 4 x 4 elements takes 2.6 MB of them.
CHUNK = 2048
# Four elements at each end of the paper's maps: no matrix of theirs has more.
HIGHEST_RANK = 4
# Largest ratio of singular values that is drawn and exported: values below 1e-9 of the largest are rounding.
RATIO_LIMIT_DB = 180.0

Antennas = Literal["siso", "mimo"]


@dataclass(frozen=True, slots=True)
class Evaluation:
    """Result of the engine at n positions and t towers; NaN (singular values: NaN or 0) where there is no path.

    Parameters
    ----------
    rss_siso_dbm, rss_mimo_dbm : (n, t)
        Received power with one element at both ends, and with the arrays.
    level_sd_db : (n, t)
        Standard deviation of the level over the element pairs of the arrays.
    singular_values : (n, t, r)
        Of the channel matrix, descending.
    """

    rss_siso_dbm: FloatArray
    rss_mimo_dbm: FloatArray
    level_sd_db: FloatArray
    singular_values: FloatArray

    @property
    def levels(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Values of each RSS altitude in a map."""
        return self.rss_siso_dbm, self.rss_mimo_dbm, self.level_sd_db


Evaluate = Callable[[FloatArray, tuple[str, ...]], Evaluation]


@dataclass(frozen=True, slots=True)
class MapResult:
    """Maps of one foliage mode. Axes: altitude, (K,) tower, position; positions in the grid's index order.

    Parameters
    ----------
    grid : Grid
        The positions.
    tower_names : tuple of str
        In drawing order.
    towers_m : (towers, 3)
        East, north, up [m].
    rss_altitudes_m, rank_altitudes_m, ks : tuple of float
        The axes.
    rss_siso_dbm, rss_mimo_dbm, level_sd_db : (RSS altitudes, towers, n)
        NaN out of coverage.
    rank : (rank altitudes, K, towers, n) int8
        0 out of coverage.
    spread_db, condition_db : (rank altitudes, towers, n)
        20 log10 of sigma_1 / sigma_2 and sigma_1 / sigma_last; NaN out of coverage, infinite for a zero value.
    serving : (n,) int
        Nearest tower.
    borders : tuple of Border
        Between the serving areas.
    """

    grid: Grid
    tower_names: tuple[str, ...]
    towers_m: FloatArray
    rss_altitudes_m: tuple[float, ...]
    rank_altitudes_m: tuple[float, ...]
    ks: tuple[float, ...]
    rss_siso_dbm: FloatArray
    rss_mimo_dbm: FloatArray
    level_sd_db: FloatArray
    rank: NDArray[np.int8]
    spread_db: FloatArray
    condition_db: FloatArray
    serving: IntArray
    borders: tuple[Border, ...]

    def rss(self, antennas: Antennas = "mimo", tower: str | None = None) -> FloatArray:
        """RSS (altitudes, n) of one tower, or jointly: of the serving tower of each position."""
        return self._of(self.rss_siso_dbm if antennas == "siso" else self.rss_mimo_dbm, tower)

    def ranks(self, tower: str | None = None) -> NDArray[np.int8]:
        """Rank (altitudes, K, n) of one tower, or jointly."""
        return np.asarray(self._of(self.rank, tower), dtype=np.int8)

    def rank_shares(self, tower: str | None = None) -> FloatArray:
        """Shares (altitudes, K, 1 + highest rank) of the classes Z, 1, 2, ... (the paper's rank distributions)."""
        rank = self.ranks(tower)
        return np.stack([(rank == number).mean(axis=-1) for number in range(HIGHEST_RANK + 1)], axis=-1)

    def coverage(self, antennas: Antennas = "mimo", tower: str | None = None) -> FloatArray:
        """Probability of coverage per RSS altitude: share of positions with a path."""
        return np.asarray(np.isfinite(self.rss(antennas, tower)).mean(axis=1))

    def _of(self, values: NDArray[np.generic], tower: str | None) -> FloatArray:
        if tower is not None:
            if tower not in self.tower_names:
                raise UsageError(f"unknown tower {tower!r}", expected=f"one of {', '.join(self.tower_names)}")
            return np.asarray(values[..., self.tower_names.index(tower), :])
        # both indices are arrays of positions: each takes the value of its own serving tower
        return np.asarray(values[..., self.serving, np.arange(len(self.grid))])


def map_job(
    grid: Grid,
    towers: Mapping[str, ArrayLike],
    evaluate: Evaluate,
    *,
    rss_altitudes_m: Sequence[float] = PAPER_RSS_ALTITUDES_M,
    rank_altitudes_m: Sequence[float] = PAPER_RANK_ALTITUDES_M,
    ks: Sequence[float] = PAPER_KS,
    chunk: int = CHUNK,
    progress: Callable[[float], None] | None = None,
) -> MapResult:
    """Evaluate the grid at all altitudes.

    Parameters
    ----------
    grid : Grid
        Positions.
    towers : mapping of str to (3,)
        Array centres [m], in drawing order.
    evaluate : callable
        The engine, see the module text.
    rss_altitudes_m, rank_altitudes_m : sequence of float
        Heights above ground [m]; one that is in both is evaluated once.
    ks : sequence of float
        Singular-value ratios.
    chunk : int
        Positions per call of ``evaluate``.
    progress : callable, optional
        Called with the share done after each chunk.

    Returns
    -------
    MapResult
    """
    if not towers:
        raise UsageError("the site has no tower", expected="at least one tower to map")
    names = tuple(towers)
    places = np.array([np.asarray(towers[name], dtype=np.float64) for name in names])
    at = {"rss": tuple(map(float, rss_altitudes_m)), "rank": tuple(map(float, rank_altitudes_m))}
    t, n = len(names), len(grid)
    rss = np.full((3, len(at["rss"]), t, n), np.nan)
    # zero is out of coverage, so what no engine fills in has no channel
    rank = np.zeros((len(at["rank"]), len(ks), t, n), dtype=np.int8)
    ratio = np.full((2, len(at["rank"]), t, n), np.nan)
    heights = sorted({*at["rss"], *at["rank"]})
    for step, height in enumerate(heights):
        # height by height: the engine's memory is that of one, however many there are
        positions = grid.positions_m(height)
        for start in range(0, n, chunk):
            part = slice(start, min(start + chunk, n))
            evaluated = evaluate(positions[part], names)
            if height in at["rss"]:
                row = at["rss"].index(height)
                rss[:, row, :, part] = np.stack(evaluated.levels).swapaxes(1, 2)
            if height in at["rank"]:
                row = at["rank"].index(height)
                # from (position, tower, K) to (K, tower, position)
                rank[row, :, :, part] = np.moveaxis(
                    rank_of_singular_values(evaluated.singular_values, ks), (0, 1, 2), (2, 1, 0)
                )
                ratio[:, row, :, part] = np.moveaxis(_ratios_db(evaluated.singular_values), (1, 2), (2, 1))
            if progress is not None:
                progress((step * n + part.stop) / (len(heights) * n))
    return MapResult(
        grid=grid,
        tower_names=names,
        towers_m=places,
        rss_altitudes_m=at["rss"],
        rank_altitudes_m=at["rank"],
        ks=tuple(map(float, ks)),
        rss_siso_dbm=rss[0],
        rss_mimo_dbm=rss[1],
        level_sd_db=rss[2],
        rank=rank,
        spread_db=ratio[0],
        condition_db=ratio[1],
        serving=serving_tower(grid.points_m, places),
        borders=voronoi_borders(places, grid.area_m),
    )


def rank_of_singular_values(singular_values: ArrayLike, ks: Sequence[float]) -> IntArray:
    """Channel rank (..., K): how many of ``sigma`` (..., r), descending, exceed ``sigma_1 / k``; 0 for no channel."""
    sigma = unmasked(singular_values)
    return np.stack([rank_from_singular_values(sigma, k) for k in ks], axis=-1)


def _ratios_db(singular_values: FloatArray) -> FloatArray:
    """sigma_1 / sigma_2 and sigma_1 / sigma_last (2, n, t) [dB]."""
    sigma = np.nan_to_num(singular_values)
    covered = sigma[..., 0] > 0
    # one element at an end: there is no second value, and the ratio of the first to itself is 1
    if sigma.shape[-1] < 2:
        return np.where(covered, 0.0, np.full((2, *covered.shape), np.nan))
    # a later value of zero stays: its ratio is infinite, which plots and files cut at RATIO_LIMIT_DB
    strongest = db_from_power(np.where(covered, sigma[..., 0], 1.0) ** 2)
    return np.stack([np.where(covered, strongest - db_from_power(sigma[..., i] ** 2), np.nan) for i in (1, -1)])


@dataclass(frozen=True, slots=True)
class FoliageDifference:
    """Effect of foliage on the joint maps.

    Parameters
    ----------
    rss_loss_db : (RSS altitudes, n)
        RSS without minus with foliage (arrays); NaN where either is out of coverage.
    lost : (RSS altitudes, n) bool
        Positions that foliage takes out of coverage.
    rank_change : (rank altitudes, K, n) int
        Rank with minus without foliage; 0 where either is out of coverage.
    """

    rss_loss_db: FloatArray
    lost: BoolArray
    rank_change: IntArray


def foliage_difference(without: MapResult, foliage: MapResult) -> FoliageDifference:
    """Compare two runs over the same grid, altitudes and K."""
    clear, shaded = without.rss(), foliage.rss()
    before, after = without.ranks().astype(np.int64), foliage.ranks().astype(np.int64)
    return FoliageDifference(
        clear - shaded,
        np.isfinite(clear) & ~np.isfinite(shaded),
        # a link that foliage takes away is counted in ``lost``: as a fall to rank 0 it would count twice
        np.where((before > 0) & (after > 0), after - before, 0),
    )


def layers_of(result: MapResult, *, towers_too: bool = False) -> list[Layer]:
    """Maps of a result as layers: joint ones, and with ``towers_too`` those of each tower alone."""
    layers = [Layer("serving_tower", result.serving, "1", "Serving tower", result.tower_names)]
    for tower in (None, *(result.tower_names if towers_too else ())):
        layers += _rss_layers(result, tower)
        layers += _rank_layers(result, tower)
    return layers


def _rss_layers(result: MapResult, tower: str | None) -> list[Layer]:
    who, of = _label(tower)
    layers = []
    kinds: tuple[Antennas, ...] = ("siso", "mimo")
    for antennas in kinds:
        for height, values in zip(result.rss_altitudes_m, result.rss(antennas, tower), strict=True):
            name = f"rss_{antennas}_h{in_name(height)}m_{who}"
            layers.append(Layer(name, values, "dBm", f"RSS {antennas.upper()}, {height:g} m{of}"))
    return layers


def _rank_layers(result: MapResult, tower: str | None) -> list[Layer]:
    who, of = _label(tower)
    ratios = (
        ("spread", "Singular-value spread s1/s2", result._of(result.spread_db, tower)),
        ("condition", "Condition number s1/s4", result._of(result.condition_db, tower)),
    )
    ranks, layers = result.ranks(tower), []
    for row, height in enumerate(result.rank_altitudes_m):
        at = f"h{in_name(height)}m_{who}"
        for column, k in enumerate(result.ks):
            title = f"Rank, K = {k:g}, {height:g} m{of}"
            layers.append(
                Layer(f"rank_k{in_name(k, 0)}_{at}", ranks[row, column], "1", title, class_names(HIGHEST_RANK))
            )
        for name, title, values in ratios:
            layers.append(Layer(f"{name}_{at}", values[row], "dB", f"{title}, {height:g} m{of}"))
    return layers


def _label(tower: str | None) -> tuple[str, str]:
    """Give the parts of a layer's name and title that speak of a tower."""
    # names of layers become columns, files in the KMZ and variables of NetCDF
    return (re.sub(r"\W", "_", tower), f", {tower}") if tower else ("joint", ", nearest tower")


def in_name(number: float, digits: int = 3) -> str:
    """Return a height or K as part of a layer's name: 030 for 30, 12p5 for 12.5."""
    # padded with zeros, so that layers sorted by name are sorted by height
    return f"{number:0{digits}.0f}" if float(number).is_integer() else f"{number:g}".replace(".", "p").replace("+", "")
