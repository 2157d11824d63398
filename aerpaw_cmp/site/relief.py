"""Ground heights: digital elevation models, and a smooth surface through points.

A digital elevation model provides ground heights and profiles below straight lines, and shows which lines the ground
blocks.

Reflections from this ground are in :mod:`aerpaw_cmp.propagation.search.terrain`.

The smooth surface is a Gaussian process through points of known height, with a standard deviation and random draws.

The covariance of two positions is a Matern function of order 3/2 of their distance (slopes are continuous, curvature
is not). The variance and the length of the covariance maximise the likelihood of the points.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from ..common.errors import InputError, UsageError, parsing
from ..common.files import read_input
from ..common.gaussian import Factor
from ..common.geodesy import SiteFrame, in_shape
from ..common.text import counted
from ..common.units import BoolArray, FloatArray, IntArray, unmasked

EARTH_RADIUS_M = 6_371_000.0
# Range of ground heights on Earth. Values outside it are undeclared gaps or have other units.
LOWEST_M, HIGHEST_M = -500.0, 9000.0

MAX_BYTES = 512 * 1024 * 1024
_SAMPLES_AT_ONCE = 1_000_000


@dataclass(frozen=True, slots=True, kw_only=True)
class FilledPatch:
    """Neighbouring cells of equal height with a cliff around them, probably a gap that was filled with a number.

    Parameters
    ----------
    height_m : float
        Height of the cells [m].
    cells : int
        Number of cells.
    jump_m : float
        Median difference from the cells around the patch [m].
    """

    height_m: float
    cells: int
    jump_m: float


# Smallest number of cells of a suspicious patch of equal height. At exactly 0 m, a single cell is suspicious.
_FILLED_CELLS = 4
# Smallest difference between a suspicious patch and the ground around it [m]. On a slope with heights rounded to whole
# metres, patches of equal height differ less.
_FILLED_JUMP_M = 20.0
# Number of cells on each side of a position in which a patch is searched.
_WINDOW_CELLS = 300


@dataclass(frozen=True, slots=True)
class Dem:
    """Heights on a regular grid, queried in the site frame.

    Parameters
    ----------
    height_m : (rows, columns)
        Heights at cell centres, southernmost row first, NaN if unknown.
    west, south : float
        Centre of the first cell, in the units of ``crs``.
    step_x, step_y : float
        Cell size in the units of ``crs``, both positive.
    crs : str
        A name that pyproj knows, such as ``EPSG:4326`` (degrees), or ``local`` for metres of the site frame.
    frame : SiteFrame
        Frame of the site.
    """

    height_m: FloatArray
    west: float
    south: float
    step_x: float
    step_y: float
    crs: str
    frame: SiteFrame
    _to_grid: Any = field(init=False, repr=False, compare=False, default=None)
    _origin_m: float = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if self.crs.lower() != "local":
            from pyproj import Transformer
            from pyproj.exceptions import CRSError

            try:
                # without always_xy, a crs in degrees would have latitude first
                transformer = Transformer.from_crs("EPSG:4326", self.crs, always_xy=True)
            except CRSError:
                raise UsageError(f"unknown crs '{self.crs}'", expected="such as EPSG:4326 or EPSG:26917") from None
            object.__setattr__(self, "_to_grid", transformer)
            end = self.west + self.step_x * self.height_m.shape[1], self.south + self.step_y * self.height_m.shape[0]
            # allow a little more than 360 and 90, because the outer cells of a global grid extend beyond
            if transformer.target_crs.is_geographic and (max(abs(self.west), abs(end[0])) > 361 or abs(end[1]) > 91):
                raise InputError(
                    f"the grid runs to {end[0]:g}, {end[1]:g} degrees",
                    expected=f"coordinates of {self.crs}",
                    cause="they are metres or feet: another crs",
                )
        # up is measured from the ground at the origin, so it does not depend on the datum of the grid
        object.__setattr__(self, "_origin_m", float(self.absolute_m(0.0, 0.0)))
        if np.isnan(self._origin_m):
            column, row = self._cell(0.0, 0.0)
            rows, columns = self.height_m.shape
            gap = bool(0 <= column <= columns - 1 and 0 <= row <= rows - 1)
            raise InputError(
                "the elevation model has no height at the site's origin",
                expected="a grid that covers the site",
                cause="its cells there are gaps (nodata)"
                if gap
                else "another place, another crs, or latitude and longitude swapped",
            )

    def _cell(self, east_m: ArrayLike, north_m: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return column and row of positions, with fractions."""
        x, y = unmasked(east_m), unmasked(north_m)
        if self._to_grid is not None:
            latitude, longitude = self.frame.to_geographic(x, y)
            x, y = in_shape(self._to_grid.transform, longitude, latitude)
        return (x - self.west) / self.step_x, (y - self.south) / self.step_y

    def absolute_m(self, east_m: ArrayLike, north_m: ArrayLike) -> FloatArray:
        """Return the height of the ground in the reference of the grid [m]: bilinear, NaN outside."""
        rows, columns = self.height_m.shape
        column, row = self._cell(east_m, north_m)
        inside = (column >= 0) & (column <= columns - 1) & (row >= 0) & (row <= rows - 1)
        column, row = np.where(inside, column, 0.0), np.where(inside, row, 0.0)
        # the last row has no next neighbour, so use it as the far side of the cell before it
        i = np.minimum(row.astype(np.int64), max(rows - 2, 0))
        j = np.minimum(column.astype(np.int64), max(columns - 2, 0))
        u, v = row - i, column - j
        h = self.height_m
        # with differences, level ground is level to the last digit
        south = h[i, j] + v * (h[i, j + 1] - h[i, j])
        north = h[i + 1, j] + v * (h[i + 1, j + 1] - h[i + 1, j])
        return np.where(inside, south + u * (north - south), np.nan)

    def ground_m(self, east_m: ArrayLike, north_m: ArrayLike) -> FloatArray:
        """Return the height of the ground in the site frame [m]: 0 at the origin, NaN outside the grid."""
        return self.absolute_m(east_m, north_m) - self._origin_m

    def filled_patch(self, east_m: float, north_m: float) -> FilledPatch | None:
        """Return the patch of cells around a position if it is probably a filled gap, otherwise None."""
        from scipy.ndimage import binary_dilation, label

        column, row = (int(np.rint(value)) for value in self._cell(east_m, north_m))
        rows, columns = self.height_m.shape
        if not (0 <= row < rows and 0 <= column < columns):
            return None
        height = float(self.height_m[row, column])
        # search a window first to save time on large grids; only a patch that fills it needs the complete grid
        for reach in (_WINDOW_CELLS, max(rows, columns)):
            top, left = max(row - reach, 0), max(column - reach, 0)
            window = self.height_m[top : row + reach + 1, left : column + reach + 1]
            labels, _ = label(window == height)
            patch = labels == labels[row - top, column - left]
            if not patch.all():
                break
        cells = int(patch.sum())
        if cells < _FILLED_CELLS and height != 0.0:
            return None
        around = window[binary_dilation(patch) & ~patch]
        around = around[np.isfinite(around)]
        jump = float(np.median(np.abs(around - height))) if len(around) else 0.0
        return FilledPatch(height_m=height, cells=cells, jump_m=jump) if jump > _FILLED_JUMP_M else None

    def slope(self, east_m: FloatArray, north_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the slope of the ground to the east and to the north, from points 1/64 of a cell apart."""
        # the surface is bilinear within a cell, so a short step has its exact slope
        step = self.cell_m / 128
        return (
            (self.ground_m(east_m + step, north_m) - self.ground_m(east_m - step, north_m)) / (2 * step),
            (self.ground_m(east_m, north_m + step) - self.ground_m(east_m, north_m - step)) / (2 * step),
        )

    def profiles(self, source_m: FloatArray, target_m: FloatArray) -> Iterator[tuple[IntArray, FloatArray, FloatArray]]:
        """Yield the ground below straight lines, at two samples per cell.

        Parameters
        ----------
        source_m, target_m : (lines, 3)
            East, north, up [m].

        Yields
        ------
        some : (k,) int
            Indices of lines of similar length.
        share : (samples, k)
            Share of the way from source to target, including 0 and 1. Shorter lines repeat their last sample.
        ground_m : (samples, k)
            Height of the ground; NaN if it is unknown.
        """
        way = (target_m - source_m)[:, :2]
        count = np.maximum(np.ceil(np.hypot(*way.T) / (self.cell_m / 2)).astype(np.int64), 2)
        # group lines of similar length, because a batch is as long as its longest line
        order = np.argsort(count)
        begin = 0
        while begin < len(order):
            stop = begin + 1
            while stop < len(order) and count[order[stop]] * (stop + 1 - begin) <= _SAMPLES_AT_ONCE:
                stop += 1
            some = order[begin:stop]
            # the samples of a line must not depend on its batch
            share = np.minimum(np.arange(count[some].max() + 1)[:, None], count[some]) / count[some]
            place = source_m[some, :2] + share[..., None] * way[some]
            yield some, share, self.ground_m(place[..., 0], place[..., 1])
            begin = stop

    def clear(self, source_m: FloatArray, target_m: FloatArray, *, tolerance_m: float | FloatArray = 0.0) -> BoolArray:
        """Check whether straight lines stay above the ground.

        Parameters
        ----------
        source_m, target_m : (links, 3)
            East, north, up [m].
        tolerance_m : float or (links,)
            Ground that is higher than a line by at most this does not block it. The ground directly below the two ends
            never blocks.

        Returns
        -------
        ndarray of bool, (links,)
            True if no sample of the line (two per cell) is lower than the ground. Unknown ground does not block. The
            curvature of the Earth (0.08 m half-way along 2 km) is included, but refraction is not.
        """
        source, target = np.asarray(source_m, dtype=np.float64), np.asarray(target_m, dtype=np.float64)
        tolerance, free = np.broadcast_to(tolerance_m, len(source)), np.ones(len(source), dtype=bool)
        for some, share, ground in self.profiles(source, target):
            start, way = source[some], target[some] - source[some]
            # add the height of the curved Earth above the chord, because up is measured from a plane
            bulge = share * (1 - share) * np.hypot(*way[:, :2].T) ** 2 / (2 * EARTH_RADIUS_M)
            intrusion = ground + bulge - (start[:, 2] + share * way[:, 2])
            # ignore both ends: the height of a cell is a mean, and may be above the foot of an antenna in the cell
            free[some] = ~((intrusion > tolerance[some]) & (share > 0.0) & (share < 1.0)).any(axis=0)
        return free

    @property
    def cell_m(self) -> float:
        """Shorter side of a cell at the origin [m]."""
        if self.crs.lower() == "local":
            return min(self.step_x, self.step_y)
        x, y = self._to_grid.transform(self.frame.longitude_deg, self.frame.latitude_deg)
        longitude, latitude = self._to_grid.transform([x + self.step_x, x], [y, y + self.step_y], direction="INVERSE")
        east, north = self.frame.to_local(latitude, longitude)
        return float(np.hypot(east, north).min())


def read_dem(path: str | Path, frame: SiteFrame, *, crs: str | None = None) -> Dem:
    """Read an elevation model: ESRI ASCII grid (``.asc``), or GeoTIFF with the extra ``aerpaw-cmp[geo]``.

    Parameters
    ----------
    path : str or Path
        Grid with heights in metres.
    frame : SiteFrame
        Frame of the site.
    crs : str, optional
        Coordinate system, which ASCII grids do not contain. ``local`` means metres of the site frame.

    Returns
    -------
    Dem

    Raises
    ------
    InputError
        If the file has another format, or does not contain the site.
    UsageError
        If ``crs`` is missing for an ASCII grid, or rasterio for a GeoTIFF.
    """
    path = Path(path)
    data = read_input(path, MAX_BYTES, "an elevation model")
    with parsing(path, "an elevation model"):
        if data[:2] in (b"II", b"MM"):
            return _read_geotiff(data, frame)
        if crs is None:
            where = "crs in site.yaml, or --dem-crs of 'site import', such as EPSG:4326"
            raise UsageError("an ASCII grid names no coordinate system", expected=where)
        return _read_ascii(data, frame, crs)


def _read_ascii(data: bytes, frame: SiteFrame, crs: str) -> Dem:
    lines = data.decode("utf-8-sig").splitlines()
    header, begin = _ascii_header(lines)
    rows, columns, step = int(header["nrows"]), int(header["ncols"]), header["cellsize"]
    # default of ESRI
    gap = header.get("nodata_value", -9999.0)
    values: list[FloatArray] = []
    for number, line in enumerate(lines[begin:], start=begin + 1):
        if line.strip():
            values.append(_ascii_cells(line, gap, number))
    flat = np.concatenate(values) if values else np.zeros(0)
    if flat.size != rows * columns:
        raise InputError(
            f"{flat.size} cells",
            expected=f"{rows} x {columns}",
            cause="the file was cut off" if flat.size < rows * columns else "nrows or ncols is wrong",
            line=len(lines),
        )
    # heights are at cell centres, half a cell from the corner
    west = header.get("xllcenter", header.get("xllcorner", 0.0) + step / 2)
    south = header.get("yllcenter", header.get("yllcorner", 0.0) + step / 2)
    return Dem(
        height_m=flat.reshape(rows, columns)[::-1], west=west, south=south, step_x=step, step_y=step, crs=crs,
        frame=frame,
    )  # fmt: skip


def _ascii_header(lines: list[str]) -> tuple[dict[str, float], int]:
    """Return the values of the header, and its number of lines."""
    header: dict[str, float] = {}
    begin = 0
    while begin < len(lines) and (word := lines[begin].split()) and word[0][0].isalpha() and word[0].lower() != "nan":
        begin += 1
        try:
            header[word[0].lower()] = float(word[1])
        except (IndexError, ValueError):
            raise InputError(f"header '{lines[begin - 1][:40]}'", expected="a name and a number", line=begin) from None
    missing = {"ncols", "nrows", "cellsize"} - set(header)
    if missing or not ({"xllcorner", "xllcenter"} & set(header) and {"yllcorner", "yllcenter"} & set(header)):
        raise InputError("not an ESRI ASCII grid", expected="ncols, nrows, xllcorner, yllcorner, cellsize", line=1)
    for name in ("ncols", "nrows"):
        if not (2 <= header[name] <= 1e6 and header[name] == int(header[name])):
            raise InputError(f"{name} is {header[name]:g}", expected="a whole number from 2 on")
    if not (0 < header["cellsize"] < np.inf):
        raise InputError(f"cellsize is {header['cellsize']:g}", expected="a positive number")
    return header, begin


def _ascii_cells(line: str, gap: float, number: int) -> FloatArray:
    try:
        row = np.array(line.split(), dtype=np.float64)
    except ValueError:
        cause = "decimal commas in place of points" if "," in line else None
        raise InputError("a cell is not a number", cause=cause, line=number) from None
    return _plausible(np.where(row == gap, np.nan, row), number)


def _plausible(height_m: FloatArray, line: int | None = None) -> FloatArray:
    """Return the heights. Raise InputError if a height, other than a gap, cannot occur on Earth."""
    wrong = height_m[(height_m < LOWEST_M) | (height_m > HIGHEST_M)]
    if wrong.size:
        raise InputError(
            f"a height of {wrong[0]:g} m",
            expected=f"{LOWEST_M:g} to {HIGHEST_M:g} m",
            cause="a gap that the file's NODATA value does not declare, or feet or centimetres",
            line=line,
        )
    return height_m


def _read_geotiff(data: bytes, frame: SiteFrame) -> Dem:
    from ..common.native import read

    if importlib.util.find_spec("rasterio") is None:
        raise UsageError("a GeoTIFF needs rasterio", expected="pip install 'aerpaw-cmp[geo]', or an ASCII grid (.asc)")
    arrays, notes = read("geotiff", data)
    band, unit = arrays["band"], notes["unit"]
    step_east, shear_east, west, shear_north, step_north, north = notes["transform"]
    # a raster with north up has a negative step to the north, because rows run south
    if notes["crs"] is None or shear_east or shear_north or step_east <= 0 or step_north >= 0:
        raise InputError("the GeoTIFF is not georeferenced north-up", cause="gdalwarp can convert it")
    # units foot, feet and ft
    if unit.startswith(("f", "us survey f")):
        raise InputError(f"heights in '{unit}'", expected="metres", cause="gdal_calc or gdal_translate converts it")
    band = _plausible(band)
    west += step_east / 2
    south = north + step_north * (band.shape[0] - 0.5)
    return Dem(
        height_m=band[::-1], west=west, south=south, step_x=step_east, step_y=-step_north, crs=notes["crs"],
        frame=frame,
    )  # fmt: skip


# Cell size of an elevation model computed from a surface [m], and its largest number of cells.
_CELL_M, _MOST_CELLS = 25.0, 40_000

# Candidate lengths and standard deviations [m].
_LENGTHS_M = np.geomspace(30.0, 2000.0, 9)
# Both sequences have steps of about 65 %.
_DEVIATIONS_M = np.geomspace(1.0, 50.0, 9)

# Heights at positions within this distance [m] count as heights of one position. Such heights contradict each other if
# they differ by more than this number of standard deviations.
_SAME_PLACE_M, _CONTRADICTION = 1.0, 4.0

# Number of waves in a random surface.
_WAVES = 500


@dataclass(frozen=True, slots=True)
class Surface:
    """The ground through points.

    Parameters
    ----------
    place_m : (n, 2)
        East, north of the points [m].
    height_m, error_m : (n,)
        Their heights in one reference, and the standard deviations of the heights [m].
    deviation_m, length_m : float
        Standard deviation and length of the process.
    level_m : float
        Mean of the process [m].
    frame : SiteFrame
        Frame of the site.
    reach_m : (east_min, east_max, north_min, north_max)
        Area of the elevation model [m].
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
        """Return the most likely surface as an elevation model, or a random surface from its distribution."""
        return next(self.dems([drawn]))

    def dems(self, draws: Iterable[np.random.Generator | None]) -> Iterator[Dem]:
        """Yield :meth:`dem` for each draw, with the covariance of cells and points computed once."""
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
            # correct a draw of the process at the points, which avoids a factorisation of the complete grid
            if drawn is not None:
                waves = self._waves(drawn)
                prior = waves.on_grid(across, along).ravel()
                # the heights of points have errors, so draw errors for each surface
                off = off + drawn.normal(0.0, self.error_m) - waves(self.place_m)
            height = self.level_m + prior + near @ factor.solve(off)
            yield Dem(
                height_m=height.reshape(rows, columns), west=west, south=south, step_x=cell, step_y=cell, crs="local",
                frame=self.frame,
            )  # fmt: skip

    def sd_m(self, east_m: FloatArray, north_m: FloatArray) -> FloatArray:
        """Return the standard deviation of the surface, shape (places,) [m]."""
        near = self._between(np.column_stack([east_m, north_m]))
        known = (self._factor().whiten(near.T) ** 2).sum(axis=0)
        # at a point, rounding errors can make the variance negative
        return np.asarray(np.sqrt(np.maximum(self.deviation_m**2 - known, 0.0)))

    def _between(self, place_m: FloatArray) -> FloatArray:
        return self.deviation_m**2 * _matern(cdist(place_m, self.place_m), self.length_m)

    def _factor(self) -> Factor:
        return Factor.of(self._between(self.place_m) + np.diag(self.error_m**2))

    def _waves(self, random: np.random.Generator) -> _Waves:
        """Return a random surface with the covariance of the process. The surface does not pass through the points.

        The surface is a sum of waves, whose wave vectors are drawn from the spectrum of the process.
        """
        # the spectrum of order 3/2 is Student's t with 3 degrees of freedom: a normal divided by sqrt(chi-squared / 3)
        vector = random.standard_normal((2, _WAVES)) / (self.length_m * np.sqrt(random.chisquare(3, _WAVES) / 3.0))
        height = self.deviation_m * np.sqrt(2.0 / _WAVES)
        return _Waves(vector, random.uniform(0.0, 2.0 * np.pi, _WAVES), height)


@dataclass(frozen=True, slots=True)
class _Waves:
    """A sum of cosines of equal amplitude [m] with wave vectors (2, waves) [rad/m] and phases (waves,)."""

    vector: FloatArray
    phase: FloatArray
    height_m: float

    def __call__(self, place_m: FloatArray) -> FloatArray:
        return np.asarray(self.height_m * np.cos(place_m @ self.vector + self.phase).sum(axis=1))

    def on_grid(self, east_m: FloatArray, north_m: FloatArray) -> FloatArray:
        """Return the sum on a grid (north, east), computed from rows and columns by the formula for cos(a + b)."""
        east, north = east_m[:, None] * self.vector[0], north_m[:, None] * self.vector[1] + self.phase
        return np.asarray(self.height_m * (np.cos(north) @ np.cos(east).T - np.sin(north) @ np.sin(east).T))


def _matern(distance_m: FloatArray, length_m: float) -> FloatArray:
    scaled = np.sqrt(3.0) * distance_m / length_m
    return np.asarray((1.0 + scaled) * np.exp(-scaled))


def surface_through(points_m: FloatArray, frame: SiteFrame, reach_m: tuple[float, float, float, float]) -> Surface:
    """Return the surface through points of east, north, height and standard deviation, shape (n, 4) [m].

    Parameters
    ----------
    points_m : (n, 4)
        Three points or more.
    frame : SiteFrame
    reach_m : (east_min, east_max, north_min, north_max)
        Area of the elevation model [m].

    Returns
    -------
    Surface

    Raises
    ------
    UsageError
        If there are too few points, or two contradict each other.
    """
    if len(points_m) < 3:
        raise UsageError(f"ground_points has {counted(len(points_m), 'point')}", expected="3 or more")
    place, height, error = points_m[:, :2], points_m[:, 2], points_m[:, 3]
    for i, j in sorted(cKDTree(place).query_pairs(_SAME_PLACE_M)):
        if abs(height[i] - height[j]) > _CONTRADICTION * np.hypot(error[i], error[j]):
            raise UsageError(
                f"ground_points {i + 1} and {j + 1} disagree: {height[i]:g} and {height[j]:g} m at one place "
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
    """Return length, deviation and mean of the process through points [m], cached for all stages of a report."""
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
    """Return the log likelihood of the points under a process, and its most likely mean [m]."""
    factor = Factor.of(covariance + np.diag(error_m**2))
    # use generalised least squares, in which several close points together have the weight of one point
    level = float(np.average(height_m, weights=factor.solve(np.ones(len(height_m)))))
    return factor.log_likelihood(height_m - level), level
