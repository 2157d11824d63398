"""The grid of a map, its values for each tower and jointly, and the link budget.

Positions are numbered from the south-west corner, east first, then one row north (arXiv 2502.10324,
section VI-A). Position ``i`` of ``columns`` is therefore in row ``i // columns`` and column ``i % columns``.
Each position is the centre of its cell: 1080 m x 2130 m at 30 m contains 36 x 71 = 2556 positions.

The replay engine is passed as a function, so that this module does not depend on an engine::

    evaluate(position_m (n, 3)) -> Evaluation

The function is called for one altitude and at most ``chunk`` positions at a time, so only the result grows with the
number of altitudes. For each tower, altitude and position, the result has 24 bytes of levels, 16 bytes of
singular-value ratios, and 1 byte of rank per K.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, Literal

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray

from ..common.errors import UsageError
from ..common.jsonable import number_key
from ..common.units import AnyArray, FloatArray, IntArray, Printed, db_from_power, noise_floor_dbm, unmasked
from ..compare.rank import rank_from_singular_values
from ..site.site import NEAREST

# Horizontal interval d_rx of the UAV positions in the paper [m].
PAPER_SPACING_M = 30.0

# Limit of positions per side. The limit detects a mistyped spacing, because a map of 1e8 positions would take days.
_MAXIMUM_CELLS_A_SIDE = 10_000

# The arrays of the paper have four elements at each end, so no channel matrix has a higher rank.
HIGHEST_RANK = 4

# Names of the ranks 0 to 4 as classes. The first class is that of a position without any path.
RANK_CLASSES = ("Z", "1", "2", "3", "4")


@dataclass(frozen=True, slots=True)
class Grid:
    """A regular horizontal grid of UAV positions.

    Parameters
    ----------
    east_m : (columns,)
        Centres of the cells, ascending and evenly spaced [m].
    north_m : (rows,)
        Centres of the cells, ascending and evenly spaced [m].
    spacing_m : float
        Side of a cell, the paper's d_rx [m].

    Examples
    --------
    >>> grid = Grid.over_area((-540.0, 540.0, -1065.0, 1065.0))
    >>> len(grid), grid.shape
    (2556, (71, 36))
    >>> grid.points_m[0].tolist(), grid.points_m[1].tolist(), grid.points_m[36].tolist()
    ([-525.0, -1050.0], [-495.0, -1050.0], [-525.0, -1020.0])
    """

    east_m: FloatArray
    north_m: FloatArray
    spacing_m: float

    @classmethod
    def over_area(cls, area_m: tuple[float, float, float, float], spacing_m: float = PAPER_SPACING_M) -> Grid:
        """Return the complete cells of ``spacing_m`` that fit into an area, centred in it.

        The area is ``(east_min, east_max, north_min, north_max)`` [m].

        Raises
        ------
        UsageError
            If the area is smaller than one cell.
        """
        east_min, east_max, north_min, north_max = area_m
        axes = []
        for low, high in ((east_min, east_max), (north_min, north_max)):
            # add a margin: 1080 / 30 must not become 35.999 cells
            cells = int(np.floor(min((high - low) / spacing_m, 1e9) + 1e-9)) if spacing_m > 0 else 0
            if cells < 1:
                raise UsageError(
                    f"a map of {high - low:g} m with a spacing of {spacing_m:g} m has no cell",
                    expected="a positive spacing smaller than the area",
                )
            if cells > _MAXIMUM_CELLS_A_SIDE:
                raise UsageError(
                    f"a map of {high - low:g} m in steps of {spacing_m:g} m has too many cells",
                    expected=f"at most {_MAXIMUM_CELLS_A_SIDE}",
                    cause="a spacing with too few digits",
                )
            # divide the remainder between both sides, so that the grid is centred in the area
            axes.append((low + high) / 2 + spacing_m * (np.arange(cells) - (cells - 1) / 2))
        return cls(np.asarray(axes[0], dtype=np.float64), np.asarray(axes[1], dtype=np.float64), float(spacing_m))

    @property
    def area_m(self) -> tuple[float, float, float, float]:
        """The extent of the cells ``(east_min, east_max, north_min, north_max)``."""
        half = self.spacing_m / 2
        return (
            float(self.east_m[0] - half),
            float(self.east_m[-1] + half),
            float(self.north_m[0] - half),
            float(self.north_m[-1] + half),
        )

    def __len__(self) -> int:
        return len(self.east_m) * len(self.north_m)

    @property
    def shape(self) -> tuple[int, int]:
        """The numbers of rows (south to north) and columns (west to east)."""
        return len(self.north_m), len(self.east_m)

    @property
    def points_m(self) -> FloatArray:
        """The positions (n, 2), east and north [m], in index order."""
        # north changes last: the paper counts along a row from west to east, then goes north
        north, east = np.meshgrid(self.north_m, self.east_m, indexing="ij")
        return np.column_stack([east.ravel(), north.ravel()])

    def positions_m(self, altitude_m: float) -> FloatArray:
        """Return positions (n, 3) at one height above ground [m]."""
        return np.column_stack([self.points_m, np.full(len(self), float(altitude_m))])

    def raster(self, values: ArrayLike) -> AnyArray:
        """Return values ``(n, ...)`` in index order as ``(rows, columns, ...)``. Row 0 is the south."""
        array = unmasked(values) if isinstance(values, np.ma.MaskedArray) else np.asarray(values)
        return array.reshape(*self.shape, *array.shape[1:])

    def index_of(self, points_m: ArrayLike) -> IntArray:
        """Return the position index of the cell that contains each point (n, 2+). -1 outside the grid."""
        points = unmasked(points_m)
        rows, columns = self.shape
        # a point on the border of two cells belongs to the eastern or northern cell
        column = np.floor((points[..., 0] - self.east_m[0]) / self.spacing_m + 0.5)
        row = np.floor((points[..., 1] - self.north_m[0]) / self.spacing_m + 0.5)
        inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        # outside the grid, row and column may be NaN, which cannot be converted to an integer
        return np.where(inside, np.where(inside, row, 0) * columns + np.where(inside, column, 0), -1).astype(np.int64)


def serving_tower(points_m: ArrayLike, towers_m: ArrayLike) -> IntArray:
    """Return the index of the nearest tower (horizontal distance) for each point. The first tower wins a tie.

    Parameters
    ----------
    points_m : (n, 2) or (n, 3)
        East, north (, up) [m].
    towers_m : (towers, 2) or (towers, 3)
        East, north (, up) of the towers [m]. Heights are ignored.

    Returns
    -------
    ndarray of int, (n,)
    """
    points = unmasked(points_m)[:, :2]
    towers = unmasked(towers_m)[:, :2]
    if len(towers) == 0:
        raise UsageError("the site has no tower", expected="at least one tower to serve the map")
    squared = ((points[:, None, :] - towers[None, :, :]) ** 2).sum(axis=-1)
    # round, so that ties are resolved by the rule and not by rounding errors
    return np.asarray(np.argmin(np.round(squared, 6), axis=1), dtype=np.int64)


@dataclass(frozen=True, slots=True)
class Border:
    """The line between the areas that two towers serve: two end points (2, 2), east and north [m]."""

    towers: tuple[int, int]
    line_m: FloatArray


def voronoi_borders(towers_m: ArrayLike, area_m: tuple[float, float, float, float]) -> tuple[Border, ...]:
    """Return borders of the serving areas, clipped to the map: the edges of a Voronoi diagram.

    Parameters
    ----------
    towers_m : (towers, 2) or (towers, 3)
        East, north [m]. Towers at the same position have no border.
    area_m : (east_min, east_max, north_min, north_max)
        Extent of the map [m].

    Returns
    -------
    tuple of Border
        Borders of all pairs of towers with a common border.
    """
    towers = unmasked(towers_m)[:, :2]
    # use the first of several towers at one position, as serving_tower does
    first = np.sort(np.unique(towers, axis=0, return_index=True)[1])
    west, east, south, north = area_m
    area, places = shapely.box(west, south, east, north), towers[first]
    edges = shapely.voronoi_polygons(shapely.multipoints(places), extend_to=area, only_edges=True)
    borders = []
    for line in shapely.get_coordinates(shapely.get_parts(edges.intersection(area))).reshape(-1, 2, 2):
        # both towers are equally near to each point of their border, and no other tower is nearer
        near = np.argsort(np.hypot(*(places - line.mean(axis=0)).T))[:2]
        a, b = np.sort(first[near]).tolist()
        borders.append(Border((a, b), line))
    return tuple(sorted(borders, key=lambda border: border.towers))


# Name of the joint map, in which the nearest tower serves each position.
JOINT = NEAREST


@dataclass(frozen=True, slots=True, kw_only=True)
class Layer:
    """A map layer of one quantity, on the page and in files.

    Parameters
    ----------
    quantity, unit : str
        Quantity and unit. On the page, layers of the same quantity share a colour scale and can be subtracted.
    values : (rows, columns)
        Values, starting in the south-west; NaN out of coverage.
    name : str
        Short name in files, such as ``"rss_mimo"``. Empty for a layer that is only on the page.
    classes : tuple of str
        Names of the values 0, 1, ..., for a layer of classes. The name "Z" of the value 0 means out of coverage.
    version, link, tower, antennas, foliage : str
        Properties that distinguish layers of a quantity, empty if they do not apply. The tower :data:`JOINT` means the
        nearest tower.
    k : float, optional
        Singular-value ratio of a rank.
    height_m : float
        Height above ground [m]; NaN for a layer without a height.
    """

    quantity: str
    unit: str
    values: FloatArray = field(repr=False, compare=False)
    name: str = ""
    classes: tuple[str, ...] = ()
    version: str = ""
    link: str = ""
    tower: str = ""
    antennas: str = ""
    k: float | None = None
    foliage: str = ""
    height_m: float = math.nan

    @property
    def axes(self) -> dict[str, str]:
        """The properties of this layer as texts, by the label of the menu on the page."""
        k = "" if self.k is None else number_key(self.k)
        height = "" if math.isnan(self.height_m) else f"{self.height_m:g} m"
        axes = {"Version": self.version, "Link": self.link, "Tower": self.tower, "Antennas": self.antennas, "K": k,
                "Foliage": self.foliage, "Height": height}  # fmt: skip
        return {name: value for name, value in axes.items() if value}

    def place(self, axis: str) -> float:
        """Return a number for sorting the choices of an axis: the joint map first, then rising K and heights."""
        return {"Tower": float(self.tower != JOINT), "K": self.k, "Height": self.height_m}.get(axis) or 0.0

    @property
    def column(self) -> str:
        """The name in files: letters, digits and underscores, such as ``rank_k10_h030m_joint_opaque``."""
        # pad with zeros, so that layers sorted by name are also sorted by height
        height = "" if math.isnan(self.height_m) else f"h{in_name(self.height_m, 3)}m"
        parts = self.name, height, re.sub(r"\W", "_", self.tower or self.link), self.foliage
        return "_".join(part for part in parts if part)

    @property
    def title(self) -> str:
        """The text of a legend: quantity and properties."""
        known = {"Tower": "nearest tower"} if self.tower == JOINT else {}
        shown = {**self.axes, **known}
        return ", ".join([self.quantity, *(f"K = {v}" if n == "K" else v for n, v in shown.items())])

    @property
    def cells(self) -> AnyArray:
        """The values of files in index order (n,), rounded to 0.01. Classes are integers, with 0 for NaN."""
        flat = self.values.ravel()
        # 0.01 dB is finer than the data of the site allow, and needs a third of the bytes
        return np.nan_to_num(flat).astype(np.int8) if self.classes else np.round(flat, 2)


def in_name(number: float, digits: int = 0) -> str:
    """Return a height or K as a part of a layer's name: 030 for 30 with three digits, 12p5 for 12.5."""
    return f"{number:0{digits}.0f}" if float(number).is_integer() else f"{number:g}".replace(".", "p").replace("+", "")


# Section VII of the paper has levels at three heights. The section also has ranks at 3 m, to show blockage.
PAPER_RSS_ALTITUDES_M = (30.0, 70.0, 110.0)
PAPER_RANK_ALTITUDES_M = (3.0, *(float(h) for h in range(30, 111, 10)))
PAPER_KS = (10.0, 100.0, 1000.0)
# Number of positions per call. H of five towers with 4 x 4 elements then takes 2.6 MB.
CHUNK = 2048
# Largest ratio of singular values that is drawn and exported. Values below 1e-9 of the largest are rounding errors.
RATIO_LIMIT_DB = 180.0

Antennas = Literal["siso", "mimo"]
ANTENNAS: tuple[Antennas, ...] = ("mimo", "siso")


@dataclass(frozen=True, slots=True)
class Evaluation:
    """The result of the engine at n positions and t towers. Levels are NaN if there is no path.

    Parameters
    ----------
    rss_siso_dbm, rss_mimo_dbm : (n, t)
        Received power with one element at both ends, and with the arrays.
    level_sd_db : (n, t)
        Standard deviation of the level over the element pairs of the arrays.
    singular_values : (n, t, r)
        Singular values of the channel matrix, descending. NaN or 0 if there is no path.
    """

    rss_siso_dbm: FloatArray
    rss_mimo_dbm: FloatArray
    level_sd_db: FloatArray
    singular_values: FloatArray

    @property
    def levels(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The levels of a map at one altitude, and their standard deviation."""
        return self.rss_siso_dbm, self.rss_mimo_dbm, self.level_sd_db


Evaluate = Callable[[FloatArray], Evaluation]


@dataclass(frozen=True, slots=True)
class MapResult:
    """The maps of one foliage mode, with the axes altitude, (K,) tower, position. Positions are in index order.

    Parameters
    ----------
    grid : Grid
        The positions.
    tower_names : tuple of str
        Names of the towers in drawing order.
    towers_m : (towers, 3)
        East, north, up [m].
    rss_altitudes_m, rank_altitudes_m, ks : tuple of float
        Altitudes [m] and singular-value ratios of the axes.
    rss_siso_dbm, rss_mimo_dbm, level_sd_db : (RSS altitudes, towers, n)
        Levels and their standard deviations; NaN out of coverage.
    rank : (rank altitudes, K, towers, n) int8
        Ranks; 0 out of coverage.
    spread_db, condition_db : (rank altitudes, towers, n)
        20 log10 of sigma_1 / sigma_2 and sigma_1 / sigma_last; NaN out of coverage, infinite for a zero value.
    serving : (n,) int
        Number of the nearest tower.
    borders : tuple of Border
        Borders between the serving areas.
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
        """Return RSS (altitudes, n) of one tower, or of the serving tower of each position."""
        return self.of_tower(self.rss_siso_dbm if antennas == "siso" else self.rss_mimo_dbm, tower)

    def ranks(self, tower: str | None = None) -> NDArray[np.int8]:
        """Return rank (altitudes, K, n) of one tower, or of the serving tower of each position."""
        return np.asarray(self.of_tower(self.rank, tower), dtype=np.int8)

    def rank_shares(self, tower: str | None = None) -> FloatArray:
        """Return the shares (altitudes, K, 1 + highest rank) of positions out of coverage and with rank 1, 2, ..."""
        rank = self.ranks(tower)
        return np.stack([(rank == number).mean(axis=-1) for number in range(HIGHEST_RANK + 1)], axis=-1)

    def coverage(self, antennas: Antennas = "mimo", tower: str | None = None) -> FloatArray:
        """Return the probability of coverage per RSS altitude: share of positions with a path."""
        return np.asarray(np.isfinite(self.rss(antennas, tower)).mean(axis=1))

    def of_tower(self, values: NDArray[np.generic], tower: str | None = None) -> FloatArray:
        """Return values (..., towers, n) of one tower, or of the serving tower of each position, as (..., n)."""
        if tower is not None:
            if tower not in self.tower_names:
                raise UsageError(f"unknown tower {tower!r}", expected=f"one of {', '.join(self.tower_names)}")
            return np.asarray(values[..., self.tower_names.index(tower), :])
        # with two index arrays each position takes the value of its serving tower
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
) -> MapResult:
    """Evaluate the grid at all altitudes.

    Parameters
    ----------
    grid : Grid
        Positions.
    towers : mapping of str to (3,)
        Array centres [m], in drawing order.
    evaluate : callable
        The engine, as described at the top of this module.
    rss_altitudes_m, rank_altitudes_m : sequence of float
        Heights above ground [m]. A height in both is evaluated once.
    ks : sequence of float
        Singular-value ratios.
    chunk : int
        Positions per call of ``evaluate``.

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
    # start from 0, out of coverage, which remains where the engine finds no path
    rank = np.zeros((len(at["rank"]), len(ks), t, n), dtype=np.int8)
    ratio = np.full((2, len(at["rank"]), t, n), np.nan)
    for height in sorted({*at["rss"], *at["rank"]}):
        # evaluate one height at a time, so that the memory does not depend on the number of heights
        positions = grid.positions_m(height)
        for start in range(0, n, chunk):
            part = slice(start, min(start + chunk, n))
            evaluated = evaluate(positions[part])
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
    """Return the rank (..., K): the number of ``sigma`` (..., r) above ``sigma_1 / k``, 0 if there is no channel."""
    sigma = unmasked(singular_values)
    return np.stack([rank_from_singular_values(sigma, k) for k in ks], axis=-1)


def _ratios_db(singular_values: FloatArray) -> FloatArray:
    """Return sigma_1 / sigma_2 and sigma_1 / sigma_last (2, n, t) [dB]."""
    sigma = np.nan_to_num(singular_values)
    covered = sigma[..., 0] > 0
    # with a single element at one end, there is a single singular value, and its ratio to itself is 1
    if sigma.shape[-1] < 2:
        return np.where(covered, 0.0, np.full((2, *covered.shape), np.nan))
    # a singular value of zero has an infinite ratio, which figures and files limit to RATIO_LIMIT_DB
    strongest = db_from_power(np.where(covered, sigma[..., 0], 1.0) ** 2)
    return np.stack([np.where(covered, strongest - db_from_power(sigma[..., i] ** 2), np.nan) for i in (1, -1)])


def _within(low: float, high: float, unit: str, name: str, cause: str, default: float | None = None) -> Any:
    """Return a dataclass field with its range, and the likely cause of a value outside this range."""
    return field(default=default, metadata={"range": (low, high, unit, name, cause)})


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkBudget:
    """The receiver and the threshold of a coverage map.

    Without a threshold, a position is covered if there is a path, which is the paper's definition.

    Parameters
    ----------
    tx_power_dbm : float
        Transmit power of a tower. The paper's 10 W are 40 dBm.
    bandwidth_mhz : float, optional
        Receiver bandwidth B. Required for an SNR.
    noise_figure_db : float
        Noise figure F of the receiver.
    threshold_dbm, threshold_snr_db : float, optional
        Lowest level, or lowest SNR, at which a position is covered. Only one of the two thresholds can be given.

    Raises
    ------
    UsageError
        If both thresholds are given, a threshold of the SNR has no bandwidth, or the threshold is below the noise
        floor.

    Notes
    -----
    Noise floor [dBm] = -174 + 10 log10(B / Hz) + F, at a temperature of 290 K.

    Examples
    --------
    >>> budget = LinkBudget(bandwidth_mhz=20, noise_figure_db=7, threshold_snr_db=0)
    >>> round(budget.level_dbm, 1)
    -94.0
    """

    tx_power_dbm: float = _within(-60.0, 100.0, "dBm", "transmit power", "watts instead of dBm", default=40.0)
    bandwidth_mhz: float | None = _within(1e-6, 1e5, "MHz", "bandwidth", "Hz instead of MHz")
    noise_figure_db: float = _within(0.0, 60.0, "dB", "noise figure", "a noise factor instead of dB", default=0.0)
    threshold_dbm: float | None = _within(-200.0, 60.0, "dBm", "threshold", "another unit than dBm")
    threshold_snr_db: float | None = _within(-60.0, 100.0, "dB", "SNR threshold", "a level instead of an SNR")

    def __post_init__(self) -> None:
        for item in fields(self):
            value, (low, high, unit, name, cause) = getattr(self, item.name), item.metadata["range"]
            if value is not None and not low <= value <= high:
                raise UsageError(f"a {name} of {value:g} {unit}", expected=f"{low:g} to {high:g} {unit}", cause=cause)
        if self.threshold_dbm is not None and self.threshold_snr_db is not None:
            raise UsageError("threshold_dbm and threshold_snr_db", expected="one of the two")
        if self.bandwidth_mhz is None and (self.noise_figure_db or self.threshold_snr_db is not None):
            raise UsageError(
                "a noise figure or threshold_snr_db without a bandwidth",
                expected="bandwidth_mhz (--bandwidth-mhz), from which the noise floor follows",
            )
        level_dbm, noise_dbm = self.threshold_dbm, self.noise_dbm
        if level_dbm is not None and noise_dbm is not None and level_dbm < round(noise_dbm, 1):
            raise UsageError(
                f"a threshold of {level_dbm:g} dBm, below the noise floor of {noise_dbm:.1f} dBm",
                expected="a level above the noise, or threshold_snr_db (--threshold-snr-db) with a negative SNR",
                cause="a threshold that is valid for a narrower band",
            )

    @property
    def noise_dbm(self) -> float | None:
        """The noise floor of the receiver [dBm]. None without a bandwidth."""
        return self.bandwidth_mhz and noise_floor_dbm(1e6 * self.bandwidth_mhz, self.noise_figure_db)

    @property
    def level_dbm(self) -> float | None:
        """The lowest covered level [dBm]. None if every path counts."""
        if self.threshold_snr_db is not None and self.noise_dbm is not None:
            return self.noise_dbm + self.threshold_snr_db
        return self.threshold_dbm

    def covered(self, level_dbm: FloatArray) -> FloatArray:
        """Return 1 for covered and 0 for other positions, in the shape of the levels [dBm]. NaN is not covered."""
        lowest = -math.inf if self.level_dbm is None else self.level_dbm
        return (level_dbm >= lowest).astype(float)

    def sentence(self) -> str:
        """Return power, noise floor and threshold in one sentence."""
        noise, threshold = "noise floor not known (no bandwidth)", "covered where any path arrives"
        if self.noise_dbm is not None:
            receiver = f"({self.bandwidth_mhz:g} MHz, noise figure {self.noise_figure_db:g} dB)"
            noise = f"noise floor {Printed(self.noise_dbm):.1f} dBm {receiver}"
        if self.level_dbm is not None:
            threshold = f"covered from {Printed(self.level_dbm):.1f} dBm"
        if self.threshold_snr_db is not None:
            threshold += f" (SNR {self.threshold_snr_db:g} dB)"
        return f"Transmit power {self.tx_power_dbm:g} dBm; {noise}; {threshold}."


# The link budget of the paper: 10 W, and every path counts.
PAPER_BUDGET = LinkBudget()
