"""Maps as files that other programs open: one function per format, ``write_X(path, maps)`` (NetCDF: ``netcdf.py``).

A :class:`MapLayers` holds what is written: a grid, the site's frame and any layers (a level, its standard deviation, a
corrected level, classes). Out of coverage is an empty cell (CSV), and in layers of classes the class 0, "Z". Samples
along a flight are written by :mod:`aerpaw_cmp.report.exports`.

    maps = MapLayers(grid=grid, frame=site.frame, layers=(Layer("level_db", level, "dBm", "Level"),))
    write_csv(folder / "level.csv", maps)

A file that exists is replaced; each function returns its path.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..common import kml
from ..common.cells import guarded
from ..common.geodesy import SiteFrame
from ..common.kml import CLASS_COLOURS
from ..common.units import AnyArray, FloatArray
from .grid import Border, Grid, Layer

PIXELS_PER_CELL = 8


@dataclass(frozen=True, slots=True, kw_only=True)
class MapLayers:
    """Layers over one grid.

    Parameters
    ----------
    grid : Grid
    frame : SiteFrame
        From local metres to latitude and longitude.
    layers : sequence of Layer
        Values in index order, (positions,), NaN out of coverage.
    towers_m : mapping of str to (3,)
        Positions of the towers, east, north, up.
    borders : sequence of Border
        Lines between the areas that two towers serve.
    credit : str
        Of the map that the site was made of, "" for none: its licence asks for it in what is made of it. A CSV table
        has no place for it.
    """

    grid: Grid
    frame: SiteFrame
    layers: Sequence[Layer]
    towers_m: Mapping[str, Sequence[float]] = field(default_factory=dict)
    borders: Sequence[Border] = ()
    credit: str = ""

    def __post_init__(self) -> None:
        n, names = len(self.grid), [layer.name for layer in self.layers]
        wrong = [f"{layer.name} {np.shape(layer.values)}" for layer in self.layers if np.shape(layer.values) != (n,)]
        twice = sorted({name for name in names if names.count(name) > 1})
        if wrong or twice:
            raise ValueError(f"layers of the wrong shape: {wrong}, with the same name: {twice}; the grid has {n} cells")

    def lonlat(self, points_m: Any) -> FloatArray:
        """Longitude and latitude (n, 2) [deg] of points east and north, to 1 cm."""
        points = np.asarray(points_m, dtype=np.float64)
        latitude, longitude = self.frame.to_geographic(points[:, 0], points[:, 1])
        # 1e-7 degrees are 11 mm of latitude
        return np.asarray(np.round(np.column_stack([longitude, latitude]), 7), dtype=np.float64)

    def towers_of(self, border: Border) -> list[str]:
        """Names of the towers between which a border lies."""
        names = list(self.towers_m)
        return [names[i] if i < len(names) else str(i) for i in border.towers]


def write_csv(path: str | Path, maps: MapLayers) -> Path:
    """One row per position in index order: index, row, column, east, north, latitude, longitude, then the layers."""
    import pandas as pd

    points, (rows, columns) = maps.grid.points_m, maps.grid.shape
    latitude, longitude = maps.frame.to_geographic(points[:, 0], points[:, 1])
    table = {
        "index": np.arange(1, len(maps.grid) + 1),  # the paper counts from 1
        "row": np.repeat(np.arange(rows), columns),
        "column": np.tile(np.arange(columns), rows),
        "east_m": points[:, 0],
        "north_m": points[:, 1],
        "latitude_deg": np.round(latitude, 9),
        "longitude_deg": np.round(longitude, 9),
        **{layer.name: layer.values for layer in maps.layers},
    }
    # names of towers may be a stranger's, and a spreadsheet runs a cell that begins with =
    target = Path(path)
    guarded(pd.DataFrame(table)).to_csv(target, index=False, lineterminator="\n")
    return target


# --- Google Earth ---------------------------------------------------------------------------------------------------


def write_kmz(path: str | Path, maps: MapLayers, *, title: str = "Coverage and rank") -> Path:
    """Ground overlays with one legend each (only the first is switched on), towers and serving borders."""
    north, south, east, west = _bounding_box(maps)
    box = f"<north>{north:.9f}</north><south>{south:.9f}</south><east>{east:.9f}</east><west>{west:.9f}</west>"
    parts = [
        kml.folder(
            layer.title,
            f"legends/{layer.name}.png",
            # KML writes alpha, blue, green, red: c0 lets a quarter of the imagery through
            f"<GroundOverlay><name>map</name><visibility>{int(number == 0)}</visibility><color>c0ffffff</color>"
            f"<Icon><href>maps/{layer.name}.png</href></Icon><LatLonBox>{box}</LatLonBox></GroundOverlay>",
            visible=number == 0,
        )
        for number, layer in enumerate(maps.layers)
    ]
    parts += [kml.mark(name, kml.coordinates(*maps.lonlat([place]).T)[0]) for name, place in maps.towers_m.items()]
    for border in maps.borders:
        at, name = kml.coordinates(*maps.lonlat(border.line_m).T), " / ".join(maps.towers_of(border))
        parts.append(kml.line(name, at, "<tessellate>1</tessellate>", style=kml.line_style("ffffffff", 2)))
    pictures = {}
    for layer in maps.layers:
        low, high = _range(layer)
        pictures[f"maps/{layer.name}.png"] = _picture(maps.grid, layer, low, high)
        pictures[f"legends/{layer.name}.png"] = _legend(layer, low, high)
    return kml.write_archive(Path(path), title, maps.credit, "".join(parts), pictures)


def _bounding_box(maps: MapLayers) -> tuple[float, float, float, float]:
    """North, south, east, west [deg] of the grid's edge.

    A KML box follows meridians and parallels, the grid the site's east and north; over 2 km the corners agree
    within 0.3 m, so the middles of the four edges are used.
    """
    half = maps.grid.spacing_m / 2
    east, north = maps.grid.east_m, maps.grid.north_m
    middle_east, middle_north = (east[0] + east[-1]) / 2, (north[0] + north[-1]) / 2
    latitude, longitude = maps.frame.to_geographic(
        np.array([middle_east, middle_east, east[-1] + half, east[0] - half]),
        np.array([north[-1] + half, north[0] - half, middle_north, middle_north]),
    )
    return float(latitude[0]), float(latitude[1]), float(longitude[2]), float(longitude[3])


def _range(layer: Layer) -> tuple[float, float]:
    """Colour range: 2nd to 98th percentile, so that one position beside a tower does not flatten the map."""
    finite = np.asarray(layer.values, dtype=np.float64)
    finite = finite[np.isfinite(finite)]
    if not finite.size:
        return 0.0, 1.0
    low, high = np.percentile(finite, [2, 98])
    return (float(low), float(high)) if high > low else (float(low) - 0.5, float(low) + 0.5)


def _colours(layer: Layer, low: float, high: float) -> AnyArray:
    """Colours (n, 4) between 0 and 1; out of coverage is the grey of Z, half transparent."""
    from matplotlib import colormaps
    from matplotlib.colors import to_rgba_array

    grey = to_rgba_array(CLASS_COLOURS[0])[0] * np.array([1, 1, 1, 0.5])
    if layer.classes:
        number = np.clip(np.asarray(layer.values, dtype=np.int64), 0, len(layer.classes) - 1)
        colours = to_rgba_array(_class_palette(layer))
        return np.where((number == 0)[:, None] & (layer.classes[0] == "Z"), grey, colours[number])
    values = np.asarray(layer.values, dtype=np.float64)
    # a ratio to a singular value of zero is infinite: the top of the scale, not a hole in the map
    share = np.clip((np.nan_to_num(values, nan=low, posinf=high, neginf=low) - low) / (high - low), 0, 1)
    return np.where(np.isnan(values)[:, None], grey, colormaps["viridis"](share))


def _class_palette(layer: Layer) -> list[str]:
    # the first colour is the grey of Z: no class with a channel may have it
    start = 0 if layer.classes[0] == "Z" else 1
    return [CLASS_COLOURS[start + i % (len(CLASS_COLOURS) - start)] for i in range(len(layer.classes))]


def _picture(grid: Grid, layer: Layer, low: float, high: float) -> bytes:
    """PNG with a block of pixels per cell: viewers that smooth must not mix classes."""
    from PIL import Image

    colours = (255 * _colours(layer, low, high)).round().astype(np.uint8)
    cells = Image.fromarray(np.ascontiguousarray(grid.raster(colours)[::-1]))  # pictures begin in the north
    picture = cells.resize((PIXELS_PER_CELL * cells.width, PIXELS_PER_CELL * cells.height), Image.Resampling.NEAREST)
    buffer = io.BytesIO()
    picture.save(buffer, "PNG")
    return buffer.getvalue()


def _legend(layer: Layer, low: float, high: float) -> bytes:
    if layer.classes:
        names = ["Z (out of coverage)" if name == "Z" else name for name in layer.classes]
        return kml.list_legend(layer.title, dict(zip(names, _class_palette(layer), strict=True)), 4.2)
    return kml.bar_legend(layer.title, f"{layer.unit}; grey: out of coverage", (low, high))
