"""The map grid in the paper's order, the tower that serves each position, and coverage as a class of its own.

Positions are numbered from the south-west corner, east first, then one row north (arXiv 2502.10324,
section VI-A), so that position ``i`` of ``columns`` lies in row ``i // columns`` and column ``i % columns``.
Each position is the centre of its cell: 1080 m x 2130 m at 30 m gives 36 x 71 = 2556 positions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..common.errors import UsageError
from ..common.units import AnyArray, FloatArray, IntArray, unmasked

# Horizontal interval d_rx of the UAV positions.
PAPER_SPACING_M = 30.0

# A digit too few in the spacing would ask for 1e8 positions and days of replays.
_MAXIMUM_CELLS_A_SIDE = 10_000

# How plots and tables name a position without any path.
OUT_OF_COVERAGE = "Z"


@dataclass(frozen=True, slots=True)
class Grid:
    """Regular horizontal grid of UAV positions.

    Parameters
    ----------
    east_m : (columns,)
        Ascending, evenly spaced [m].
    north_m : (rows,)
        Ascending, evenly spaced [m].
    spacing_m : float
        Cell size, the paper's d_rx [m].

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

    def __post_init__(self) -> None:
        if not (np.isfinite(self.spacing_m) and self.spacing_m > 0):
            raise ValueError(f"grid spacing is {self.spacing_m} m; expected a positive length")
        for name, axis in (("east_m", self.east_m), ("north_m", self.north_m)):
            if axis.ndim != 1 or len(axis) == 0 or not np.allclose(np.diff(axis), self.spacing_m, rtol=1e-9):
                raise ValueError(f"{name} is no ascending axis with a step of {self.spacing_m} m")

    @classmethod
    def over_area(cls, area_m: tuple[float, float, float, float], spacing_m: float = PAPER_SPACING_M) -> Grid:
        """Cells of ``spacing_m`` centred in ``(east_min, east_max, north_min, north_max)``; a remainder is left out.

        Raises
        ------
        UsageError
            If not one cell fits into the area.
        """
        east_min, east_max, north_min, north_max = area_m
        axes = []
        for low, high in ((east_min, east_max), (north_min, north_max)):
            # 1080 / 30 must not become 35.999 cells
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
            # what is left over is shared by both sides: the grid stays in the middle of the area
            axes.append((low + high) / 2 + spacing_m * (np.arange(cells) - (cells - 1) / 2))
        return cls(np.asarray(axes[0], dtype=np.float64), np.asarray(axes[1], dtype=np.float64), float(spacing_m))

    @property
    def area_m(self) -> tuple[float, float, float, float]:
        """Extent of the cells ``(east_min, east_max, north_min, north_max)``."""
        half = self.spacing_m / 2
        return (
            float(self.east_m[0] - half), float(self.east_m[-1] + half),
            float(self.north_m[0] - half), float(self.north_m[-1] + half),
        )  # fmt: skip

    def __len__(self) -> int:
        return len(self.east_m) * len(self.north_m)

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns): south to north, west to east."""
        return len(self.north_m), len(self.east_m)

    @property
    def points_m(self) -> FloatArray:
        """Positions (n, 2), east and north [m], in index order."""
        # north is the slow axis: the paper counts along a row from west to east, then goes north
        north, east = np.meshgrid(self.north_m, self.east_m, indexing="ij")
        return np.column_stack([east.ravel(), north.ravel()])

    def positions_m(self, altitude_m: float) -> FloatArray:
        """Positions (n, 3) at one height above ground [m]."""
        return np.column_stack([self.points_m, np.full(len(self), float(altitude_m))])

    def raster(self, values: ArrayLike) -> AnyArray:
        """Values ``(n, ...)`` in index order as ``(rows, columns, ...)``; row 0 is the south."""
        array = unmasked(values) if isinstance(values, np.ma.MaskedArray) else np.asarray(values)
        return array.reshape(*self.shape, *array.shape[1:])

    def index_of(self, points_m: ArrayLike) -> IntArray:
        """Position index of the cell that holds each point (n, 2+); -1 outside the grid."""
        points = unmasked(points_m)
        rows, columns = self.shape
        # a point on the border of two cells belongs to the eastern or northern one
        column = np.floor((points[..., 0] - self.east_m[0]) / self.spacing_m + 0.5)
        row = np.floor((points[..., 1] - self.north_m[0]) / self.spacing_m + 0.5)
        inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        # outside, row and column may be NaN, which no integer is
        return np.where(inside, np.where(inside, row, 0) * columns + np.where(inside, column, 0), -1).astype(np.int64)


def serving_tower(points_m: ArrayLike, towers_m: ArrayLike) -> IntArray:
    """Index of the nearest tower (horizontal distance) of each point; a tie goes to the first in drawing order.

    Parameters
    ----------
    points_m : (n, 2) or (n, 3)
        East, north (, up) [m].
    towers_m : (towers, 2) or (towers, 3)
        The same for towers; heights do not count.

    Returns
    -------
    ndarray of int, (n,)
    """
    points = unmasked(points_m)[:, :2]
    towers = unmasked(towers_m)[:, :2]
    if len(towers) == 0:
        raise UsageError("the site has no tower", expected="at least one tower to serve the map")
    squared = ((points[:, None, :] - towers[None, :, :]) ** 2).sum(axis=-1)
    # tied to the micrometre squared scale, so that the rule and not rounding decides
    return np.asarray(np.argmin(np.round(squared, 6), axis=1), dtype=np.int64)


@dataclass(frozen=True, slots=True)
class Border:
    """The line between the areas that two towers serve: two end points (2, 2), east and north [m]."""

    towers: tuple[int, int]
    line_m: FloatArray


def voronoi_borders(towers_m: ArrayLike, area_m: tuple[float, float, float, float]) -> tuple[Border, ...]:
    """Borders of the serving areas, clipped to the map.

    The border of towers a and b is the part of their perpendicular bisector that is inside the area and no
    nearer to any third tower. Along the bisector each of these conditions is linear, so the part is one segment.

    Parameters
    ----------
    towers_m : (towers, 2) or (towers, 3)
        East, north [m]. Towers at the same place have no border.
    area_m : (east_min, east_max, north_min, north_max)
        Extent of the map [m].

    Returns
    -------
    tuple of Border
        Pairs that share no border are left out.
    """
    towers = unmasked(towers_m)[:, :2]
    borders = []
    for a in range(len(towers)):
        for b in range(a + 1, len(towers)):
            line = _bisector_segment(a, b, towers, area_m)
            if line is not None:
                borders.append(Border((a, b), line))
    return tuple(borders)


def _bisector_segment(
    a: int, b: int, towers: FloatArray, area_m: tuple[float, float, float, float]
) -> FloatArray | None:
    """Part (2, 2) of the bisector of towers a and b that is their border, or None."""
    between = towers[b] - towers[a]
    length = float(np.hypot(*between))
    # two towers on one mast have no bisector
    if length < 1e-6:
        return None
    middle = (towers[a] + towers[b]) / 2
    along = np.array([-between[1], between[0]]) / length
    # conditions slope * t <= bound on the point middle + t * along
    slopes = [-along[0], along[0], -along[1], along[1]]
    bounds = [middle[0] - area_m[0], area_m[1] - middle[0], middle[1] - area_m[2], area_m[3] - middle[1]]
    for c in range(len(towers)):
        if c not in (a, b):
            # |p - a|^2 <= |p - c|^2
            slopes.append(float(2 * along @ (towers[c] - towers[a])))
            bounds.append(float(towers[c] @ towers[c] - towers[a] @ towers[a] - 2 * middle @ (towers[c] - towers[a])))
    low, high = -np.inf, np.inf
    for slope, bound in zip(slopes, bounds, strict=True):
        # the bisector runs along this bound: all of it is inside, or none
        if abs(slope) < 1e-12:
            if bound < 0:
                return None
        elif slope > 0:
            high = min(high, bound / slope)
        else:
            low = max(low, bound / slope)
    # three areas that meet in a point: a corner, no border
    if high - low < 1e-9:
        return None
    return np.stack([middle + low * along, middle + high * along])


def class_names(highest: int = 4) -> tuple[str, ...]:
    """Names of the rank classes: ``Z``, ``1``, ..."""
    return (OUT_OF_COVERAGE, *(str(rank) for rank in range(1, highest + 1)))


@dataclass(frozen=True, slots=True)
class Layer:
    """One map to draw or to export.

    Parameters
    ----------
    name : str
        Identifier such as ``"rank_k10_h030m_joint"``: letters, digits, underscores.
    values : (n,)
        In index order; NaN (classes: 0) is out of coverage.
    unit : str
        Such as ``"dBm"``; ``"1"`` for classes and ratios.
    title : str
        For legends.
    classes : tuple of str
        Names of the values 0, 1, ... when the layer holds classes.
    """

    name: str
    values: AnyArray
    unit: str
    title: str
    classes: tuple[str, ...] = ()
