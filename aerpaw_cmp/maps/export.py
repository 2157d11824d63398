"""Maps as files for other programs: CSV, KMZ, and a dataset according to CF-1.11 for NetCDF and Zarr.

``write_csv`` and ``write_kmz`` write :class:`MapLayers`: a grid, the frame of the site, and layers such as a level, its
standard deviation or classes. A position out of coverage is an empty cell of the CSV, or the class 0 ("Z"). Samples
along a flight are written by :mod:`aerpaw_cmp.report.kmz`.

    level = Layer(name="level_db", quantity="Level", unit="dBm", values=grid.raster(level_dbm))
    maps = MapLayers(grid=grid, frame=site.frame, layers=(level,))
    write_csv(folder / "level.csv", maps)

Each function replaces an existing file and returns its path.

:func:`maps_dataset` returns arrays over foliage, tower, K, height, y and x, rounded to 0.01 dB, which is finer than the
accuracy of the site's data. Maps in which the nearest tower serves each position are separate variables
(``..._joint``). The joint variables contain the values that ``serving_tower`` selects from the maps of each tower.
NetCDF requires ``pip install aerpaw-cmp[geo]``.
"""

from __future__ import annotations

import io
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..common import kml
from ..common.cf import DB, DBM, Dataset, flags, site_crs
from ..common.geodesy import SiteFrame
from ..common.kml import CLASS_COLOURS
from ..common.text import guarded
from ..common.units import AnyArray, FloatArray, IntArray, unmasked
from .grid import HIGHEST_RANK, RATIO_LIMIT_DB, Border, Grid, Layer, MapResult

PIXELS_PER_CELL = 8


@dataclass(frozen=True, slots=True, kw_only=True)
class MapLayers:
    """The layers over one grid.

    Parameters
    ----------
    grid : Grid
    frame : SiteFrame
        Frame that converts local metres to latitude and longitude.
    layers : sequence of Layer
        Layers with different names.
    towers_m : mapping of str to (3,)
        Positions of the towers, east, north, up.
    borders : sequence of Border
        Lines between the areas that two towers serve.
    credit : str
        Attribution of the map from which the site was made. The licence of the map requires it in derived works. Empty
        if there is no attribution. The CSV does not contain the attribution.
    """

    grid: Grid
    frame: SiteFrame
    layers: Sequence[Layer]
    towers_m: Mapping[str, Sequence[float]] = field(default_factory=dict)
    borders: Sequence[Border] = ()
    credit: str = ""

    def __post_init__(self) -> None:
        shape, names = self.grid.shape, [layer.column for layer in self.layers]
        wrong = [f"{layer.column} {layer.values.shape}" for layer in self.layers if layer.values.shape != shape]
        twice = sorted({name for name in names if names.count(name) > 1})
        if wrong or twice:
            raise ValueError(f"layers of the wrong shape: {wrong}, with the same name: {twice}; the grid is {shape}")

    def lonlat(self, points_m: Any) -> FloatArray:
        """Return longitude and latitude (n, 2) [deg] of points east and north, to 1 cm."""
        points = np.asarray(points_m, dtype=np.float64)
        latitude, longitude = self.frame.to_geographic(points[:, 0], points[:, 1])
        # 1e-7 degrees are 11 mm of latitude
        return np.asarray(np.round(np.column_stack([longitude, latitude]), 7), dtype=np.float64)


def write_csv(path: str | Path, maps: MapLayers) -> Path:
    """Write a CSV with a row per position in index order: number, position, and the layers."""
    import pandas as pd

    points, (rows, columns) = maps.grid.points_m, maps.grid.shape
    latitude, longitude = maps.frame.to_geographic(points[:, 0], points[:, 1])
    table = {
        "index": np.arange(1, len(maps.grid) + 1),  # the paper counts from 1
        "row": np.repeat(np.arange(rows), columns), "column": np.tile(np.arange(columns), rows),
        "east_m": points[:, 0], "north_m": points[:, 1],
        "latitude_deg": np.round(latitude, 9), "longitude_deg": np.round(longitude, 9),
        **{layer.column: layer.cells for layer in maps.layers},
    }  # fmt: skip
    # guard texts, because names of towers may come from a third party, and a spreadsheet executes a cell that begins
    # with =
    target = Path(path)
    guarded(pd.DataFrame(table)).to_csv(target, index=False, lineterminator="\n")
    return target


# --- Google Earth ---------------------------------------------------------------------------------------------------


def write_kmz(path: str | Path, maps: MapLayers, *, title: str = "Coverage and rank") -> Path:
    """Write a KMZ with towers, borders, and an overlay and a legend per layer. Only the first layer is visible."""
    north, south, east, west = _bounding_box(maps)
    box = f"<north>{north:.9f}</north><south>{south:.9f}</south><east>{east:.9f}</east><west>{west:.9f}</west>"
    parts = [
        kml.folder(
            layer.title,
            f"legends/{layer.column}.png",
            # KML writes alpha, blue, green, red; with c0 a quarter of the imagery below is visible
            f"<GroundOverlay><name>map</name><visibility>{int(number == 0)}</visibility><color>c0ffffff</color>"
            f"<Icon><href>maps/{layer.column}.png</href></Icon><LatLonBox>{box}</LatLonBox></GroundOverlay>",
            visible=number == 0,
        )
        for number, layer in enumerate(maps.layers)
    ]
    parts += [kml.mark(name, kml.coordinates(*maps.lonlat([place]).T)[0]) for name, place in maps.towers_m.items()]
    towers = list(maps.towers_m)
    for border in maps.borders:
        at, name = kml.coordinates(*maps.lonlat(border.line_m).T), " / ".join(towers[i] for i in border.towers)
        parts.append(kml.line(name, at, "<tessellate>1</tessellate>", style=kml.line_style("ffffffff", 2)))
    pictures = {}
    for layer in maps.layers:
        scale = scale_of(layer)
        pictures[f"maps/{layer.column}.png"] = _picture(maps.grid, layer, scale)
        pictures |= scale.legend(4.2)
    return kml.write_archive(Path(path), title, maps.credit, "".join(parts), pictures)


def _bounding_box(maps: MapLayers) -> tuple[float, float, float, float]:
    """Return north, south, east and west [deg] of the grid's edge.

    A KML box is along meridians and parallels, and the grid is along east and north of the site. Over 2 km their
    corners agree within 0.3 m, so the middles of the four edges are used.
    """
    half = maps.grid.spacing_m / 2
    east, north = maps.grid.east_m, maps.grid.north_m
    middle = (east[0] + east[-1]) / 2, (north[0] + north[-1]) / 2
    (top, low), _ = maps.frame.to_geographic(np.full(2, middle[0]), np.array([north[-1] + half, north[0] - half]))
    _, (right, left) = maps.frame.to_geographic(np.array([east[-1] + half, east[0] - half]), np.full(2, middle[1]))
    return float(top), float(low), float(right), float(left)


# Number of colours of a scale of numbers.
LEVELS = 10


@dataclass(frozen=True, slots=True, kw_only=True)
class Scale:
    """The colours of one quantity, with the name of each colour. The last colour means out of coverage.

    ``key`` is the name of the styles and pictures. ``edges`` are the limits between the other colours. Values below
    ``lowest`` count as out of coverage.
    """

    key: str
    title: str
    colours: tuple[str, ...]
    labels: tuple[str, ...]
    edges: AnyArray
    lowest: float = -np.inf

    def bin_of(self, values: ArrayLike) -> IntArray:
        """Return the index of the colour of each value (n,)."""
        array = unmasked(values)
        missing = np.isnan(array) | (array < self.lowest)
        return np.where(missing, len(self.colours) - 1, np.searchsorted(self.edges, array, side="right"))

    def legend(self, width_in: float = 2.6) -> dict[str, bytes]:
        """Return the legend as PNG, by its name in a KMZ."""
        picture = kml.list_legend(self.title, dict(zip(self.labels, self.colours, strict=True)), width_in)
        return {f"legends/{self.key}.png": picture}


def number_scale(key: str, title: str, values: AnyArray, palette: str = "viridis", *, centred: bool = False) -> Scale:
    """Return a scale of numbers from the 2nd to the 98th percentile, in round steps.

    Parameters
    ----------
    key, title : str
    values : (n,)
        NaN and infinite values are ignored.
    palette : str
        Name of a palette of matplotlib.
    centred : bool
        True if 0 is in the middle of the scale.

    Returns
    -------
    Scale
    """
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    # use percentiles, because a few values next to a tower are far above all others and would take up most colours
    finite = values[np.isfinite(values)]
    low, high = np.percentile(finite, [2, 98]) if len(finite) else (0.0, 0.0)
    if centred:
        low, high = -max(-low, high), max(-low, high)
    step = _round_step((high - low) / (LEVELS - centred))
    first = -step * (LEVELS / 2 - 1) if centred else step * (np.floor(low / step) + 1)
    edges = first + step * np.arange(LEVELS - 1)
    between = [f"{below:g} to {above:g}" for below, above in itertools.pairwise(edges)]
    colours = (to_hex(colormaps[palette]((i + 0.5) / LEVELS)) for i in range(LEVELS))
    labels = (f"below {edges[0]:g}", *between, f"above {edges[-1]:g}", "out of coverage")
    return Scale(key=key, title=title, colours=(*colours, CLASS_COLOURS[0]), labels=labels, edges=edges)


def _round_step(step: float) -> float:
    """Return a step rounded up to 1, 2 or 5 times a power of ten. A step of 0 becomes 1."""
    power = 10.0 ** np.floor(np.log10(step)) if step > 0 else 1.0
    # add a margin, because a rounding error must not turn a step of 2 into 5
    return float(next(m for m in (1, 2, 5, 10) if m * power >= step * (1 - 1e-9)) * power)


def class_scale(key: str, title: str, names: Sequence[str]) -> Scale:
    """Return the colour scale of the classes 0, 1, ..., labelled with ``names``. The name "Z" means out of coverage."""
    first = int(names[0] == "Z")
    classes = range(first, len(names))
    return Scale(
        key=key, title=title, labels=(*names[first:], "out of coverage"), lowest=first,
        edges=np.array(classes[1:]) - 0.5,
        # the first colour is for positions out of coverage
        colours=(*(CLASS_COLOURS[1 + i % (len(CLASS_COLOURS) - 1)] for i in range(len(classes))), CLASS_COLOURS[0]),
    )  # fmt: skip


def scale_of(layer: Layer) -> Scale:
    """Return the colours of a layer."""
    if layer.classes:
        return class_scale(layer.column, layer.title, layer.classes)
    return number_scale(layer.column, f"{layer.title} [{layer.unit}]", layer.cells)


def _picture(grid: Grid, layer: Layer, scale: Scale) -> bytes:
    """Return a PNG with a block of pixels per cell, so that viewers do not mix classes when they smooth the picture."""
    from matplotlib.colors import to_rgba_array
    from PIL import Image

    palette = (255 * to_rgba_array(scale.colours)).round().astype(np.uint8)
    palette[-1, 3] = 128  # the ground is visible where there is no path
    # the first row of a picture is in the north
    cells = Image.fromarray(np.ascontiguousarray(grid.raster(palette[scale.bin_of(layer.cells)])[::-1]))
    picture = cells.resize((PIXELS_PER_CELL * cells.width, PIXELS_PER_CELL * cells.height), Image.Resampling.NEAREST)
    buffer = io.BytesIO()
    picture.save(buffer, "PNG")
    return buffer.getvalue()


_PLANE = ("y", "x")
_ON_PLANE = {"coordinates": "latitude longitude", "grid_mapping": "crs"}
_Variable = tuple[tuple[str, ...], AnyArray, dict[str, Any]]


def maps_dataset(
    maps: Mapping[str, MapResult], frame: SiteFrame, about: Mapping[str, str], further: Sequence[Layer] = ()
) -> Dataset:
    """Return maps as variables with the dimensions foliage, tower, k, height, y, x.

    Parameters
    ----------
    maps : mapping of str to MapResult
        Results by foliage mode, with the same grid, towers, heights and K.
    frame : SiteFrame
        Frame that converts local metres to latitude and longitude.
    about : mapping of str to str
        Attributes of the file (:func:`~aerpaw_cmp.common.cf.file_attributes`).
    further : sequence of Layer
        Further variables over y and x, by their names.

    Returns
    -------
    Dataset
    """
    first = next(iter(maps.values()))
    variables = {**_places(first, frame), **_levels(maps), **_ranks(maps)}
    variables["foliage"] = _text("foliage", maps, "how trees act")
    for layer in further:
        plane = first.grid.raster(layer.cells)
        if layer.classes:
            # write rank_1 instead of 1, because a number next to flag_values could be mistaken for a value
            codes = tuple(f"rank_{c}" if c.isdigit() else c for c in layer.classes)
            variables[layer.column] = _PLANE, plane, _codes(codes, layer.title)
        else:
            unit = {"dBm": DBM, "dB": DB}.get(layer.unit, layer.unit)
            about_layer = {"long_name": layer.title, "units": unit, "comment": f"unit: {layer.unit}"}
            variables[layer.column] = _PLANE, plane.astype(np.float32), about_layer | _ON_PLANE
    return Dataset(variables, about)


def _text(dimension: str, names: Mapping[str, Any] | Sequence[str], meaning: str) -> _Variable:
    # use objects, which become strings of variable length: an array of characters would need an additional axis
    return (dimension,), np.array(list(names), dtype=object), {"long_name": meaning}


def _places(maps: MapResult, frame: SiteFrame) -> dict[str, _Variable]:
    """Return axes, towers, latitude and longitude, the serving tower, and the reference system."""
    variables: dict[str, _Variable] = {
        "k": (("k",), np.array(maps.ks), {"long_name": "singular-value ratio K of the rank", "units": "1"}),
        "tower": _text("tower", maps.tower_names, "name of the tower"),
    }
    height = {"standard_name": "height", "units": "m", "positive": "up", "axis": "Z"}
    for name, heights, what in (
        ("height", maps.rss_altitudes_m, "levels"),
        ("height_of_rank", maps.rank_altitudes_m, "ranks"),
    ):
        variables[name] = (name,), np.array(heights), {**height, "long_name": f"height above ground of the {what}"}
    for name, axis, what in (("y", maps.grid.north_m, "north"), ("x", maps.grid.east_m, "east")):
        along = {"standard_name": f"projection_{name}_coordinate", "long_name": f"{what} of the site origin"}
        variables[name] = (name,), axis, {**along, "units": "m", "axis": name.upper()}
    for i, (name, what) in enumerate((("tower_x", "east"), ("tower_y", "north"), ("tower_height", "above the ground"))):
        meaning = f"array centre of the tower, {what} at the site origin"
        variables[name] = ("tower",), maps.towers_m[:, i], {"long_name": meaning, "units": "m"}
    latitude, longitude = frame.to_geographic(*maps.grid.points_m.T)
    for name, degrees, unit in (("latitude", latitude, "degrees_north"), ("longitude", longitude, "degrees_east")):
        attributes = {"standard_name": name, "long_name": f"WGS84 {name}", "units": unit}
        variables[name] = _PLANE, maps.grid.raster(degrees), attributes
    # an attribute of NetCDF cannot be null
    crs = {name: value for name, value in site_crs(frame).to_cf().items() if value is not None}
    variables["crs"] = (), np.array(0, dtype=np.int32), {**crs, "long_name": "site frame"}
    serving = _codes(maps.tower_names, "nearest tower, which serves here")
    variables["serving_tower"] = _PLANE, maps.grid.raster(maps.serving).astype(np.int8), serving
    return variables


def _levels(maps: Mapping[str, MapResult]) -> dict[str, _Variable]:
    """Return levels and ratios of singular values, of each tower and of the nearest tower."""
    limit = f"at most {RATIO_LIMIT_DB:g} dB"
    kinds = {
        "rss_siso": ("rss_siso_dbm", "received level, one element at both ends", DBM, "dBm"),
        "rss_mimo": ("rss_mimo_dbm", "received level, arrays at both ends", DBM, "dBm"),
        "rss_sd": ("level_sd_db", "standard deviation of the level over the element pairs", DB, "dB"),
        "spread": ("spread_db", f"largest over second singular value, {limit}", DB, "dB"),
        "condition": ("condition_db", f"largest over last singular value, {limit}", DB, "dB"),
    }
    variables = {}
    for name, (plane, meaning, unit, shown) in kinds.items():
        height = "height" if name.startswith("rss") else "height_of_rank"
        # the limit is meant for the ratios; no level is near it
        values = {mode: np.minimum(getattr(item, plane), RATIO_LIMIT_DB) for mode, item in maps.items()}
        by_tower = [np.moveaxis(item, 1, 0) for item in values.values()]  # tower, height, n
        joint = [item.of_tower(values[mode]) for mode, item in maps.items()]
        attributes = {"long_name": meaning, "units": unit, "comment": f"unit: {shown}"}
        variables[name] = _stacked(maps, by_tower, ("tower", height), attributes)
        variables[f"{name}_joint"] = _stacked(maps, joint, (height,), attributes)
    return variables


def _ranks(maps: Mapping[str, MapResult]) -> dict[str, _Variable]:
    attributes = _codes(("out_of_coverage", *(f"rank_{i}" for i in range(1, HIGHEST_RANK + 1))), "channel rank")
    # (height, K, tower, n) to (tower, K, height, n)
    by_tower = [np.moveaxis(item.rank, (2, 1, 0), (0, 1, 2)) for item in maps.values()]
    joint = [np.moveaxis(item.ranks(), 1, 0) for item in maps.values()]
    return {
        "rank": _stacked(maps, by_tower, ("tower", "k", "height_of_rank"), attributes),
        "rank_joint": _stacked(maps, joint, ("k", "height_of_rank"), attributes),
    }


def _stacked(
    maps: Mapping[str, MapResult], values: Sequence[AnyArray], between: tuple[str, ...], attributes: Mapping[str, Any]
) -> _Variable:
    """Return values (..., n) of every mode as a variable over foliage, ``between`` and the plane.

    Parameters
    ----------
    maps : mapping of str to MapResult
    values : sequence of ndarray
        One array per mode.
    between : tuple of str
        Dimensions of the values except the last. If they do not include ``"tower"``, the values of the nearest tower
        are written.
    attributes : mapping

    Returns
    -------
    tuple
        Dimensions, values, attributes.
    """
    joint = "tower" not in between
    # the last axis contains the positions in index order and becomes y and x
    planes = np.stack([v.reshape(*v.shape[:-1], *m.grid.shape) for m, v in zip(maps.values(), values, strict=True)])
    # float32 resolves 0.01 dB and halves the file
    numbers = planes.astype(np.int8) if "flag_values" in attributes else np.round(planes, 2).astype(np.float32)
    meaning = str(attributes["long_name"]) + (", nearest tower" if joint else "")
    return ("foliage", *between, *_PLANE), numbers, {**attributes, "long_name": meaning, **_ON_PLANE}


def _codes(meanings: Sequence[str], long_name: str) -> dict[str, Any]:
    """Return attributes of a variable of classes 0, 1, ..."""
    return {"long_name": long_name, **flags(meanings), "grid_mapping": "crs"}
