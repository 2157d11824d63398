"""Maps as files that other programs open: CSV, GeoJSON, JSON, KMZ, GeoTIFF (NetCDF: ``netcdf.py``).

Arrays in, files out. Each function takes a :class:`~aerpaw_cmp.maps.grid.Grid`, the site's frame and layers. Out of
coverage is an empty cell (CSV), ``null`` (JSON), NaN (GeoTIFF), and in layers of classes the class 0, "Z".

GeoTIFF needs rasterio: ``pip install aerpaw-cmp[geo]``.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import numpy as np

from ..common.cells import guarded
from ..common.cf import site_crs
from ..common.errors import UsageError
from ..common.geodesy import SiteFrame
from ..common.jsonable import json_safe
from ..common.units import AnyArray, FloatArray
from .grid import Border, Grid, Layer

CLASS_COLOURS = ("#9e9e9e", "#440154", "#31688e", "#35b779", "#fde725", "#e66101", "#b2182b")
"""Z grey, then ranks 1 to 4 from dark to light (viridis), then spare ones."""
PIXELS_PER_CELL = 8
ZIP_DATE = (1980, 1, 1, 0, 0, 0)
"""Fixed, so that the same map gives the same bytes."""


# --- tables ---------------------------------------------------------------------------------------------------------


def write_csv(path: str | Path, grid: Grid, frame: SiteFrame, layers: Sequence[Layer]) -> Path:
    """One row per position in index order: index, row, column, east, north, latitude, longitude, then the layers.

    Parameters
    ----------
    path : path
        The file; replaced where it exists.
    grid : Grid
    frame : SiteFrame
        From local metres to latitude and longitude.
    layers : sequence of Layer
        Values in index order, (positions,), NaN out of coverage.

    Returns
    -------
    Path
        The file.
    """
    import pandas as pd

    _check(grid, layers)
    points, (rows, columns) = grid.points_m, grid.shape
    latitude, longitude = frame.to_geographic(points[:, 0], points[:, 1])
    table = {
        "index": np.arange(1, len(grid) + 1),  # the paper counts from 1
        "row": np.repeat(np.arange(rows), columns),
        "column": np.tile(np.arange(columns), rows),
        "east_m": points[:, 0],
        "north_m": points[:, 1],
        "latitude_deg": np.round(latitude, 9),
        "longitude_deg": np.round(longitude, 9),
        **{layer.name: layer.values for layer in layers},
    }
    target = Path(path)
    guarded(pd.DataFrame(table)).to_csv(target, index=False, lineterminator="\n")
    return target


def write_json(
    path: str | Path, grid: Grid, frame: SiteFrame, layers: Sequence[Layer], summary: Mapping[str, Any] | None = None
) -> Path:
    """Axes, layers (in index order, ``null`` out of coverage) and a free summary as one JSON object.

    Parameters
    ----------
    path : path
        The file; replaced where it exists.
    grid : Grid
    frame : SiteFrame
        From local metres to latitude and longitude.
    layers : sequence of Layer
        Values in index order, (positions,), NaN out of coverage.
    summary : mapping, optional
        Anything that JSON can hold, once NaN is null.

    Returns
    -------
    Path
        The file.
    """
    _check(grid, layers)
    content = {
        "origin": {"latitude_deg": frame.latitude_deg, "longitude_deg": frame.longitude_deg},
        "east_m": grid.east_m.tolist(),
        "north_m": grid.north_m.tolist(),
        "spacing_m": grid.spacing_m,
        "order": "from the south-west corner, east first, then north",
        "summary": json_safe(dict(summary or {})),
        "layers": {
            layer.name: {
                "title": layer.title,
                "unit": layer.unit,
                "classes": list(layer.classes) or None,
                "values": json_safe(layer.values),
            }
            for layer in layers
        },
    }
    target = Path(path)
    target.write_text(json.dumps(content, allow_nan=False) + "\n", encoding="utf-8")
    return target


def write_geojson(
    path: str | Path,
    grid: Grid,
    frame: SiteFrame,
    layers: Sequence[Layer],
    towers_m: Mapping[str, Sequence[float]] | None = None,
    borders: Sequence[Border] = (),
) -> Path:
    """Cells as polygons with the layers as properties, towers as points, serving borders as lines (RFC 7946).

    Parameters
    ----------
    path : path
        The file; replaced where it exists.
    grid : Grid
    frame : SiteFrame
        From local metres to latitude and longitude.
    layers : sequence of Layer
        Values in index order, (positions,), NaN out of coverage.
    towers_m : mapping of str to (3,), optional
        Positions of the towers, east, north, up.
    borders : sequence of Border
        Lines between the areas that two towers serve.

    Returns
    -------
    Path
        The file.
    """
    _check(grid, layers)
    rings = _cell_corners(grid, frame)
    columns = {layer.name: json_safe(layer.values) for layer in layers}
    features: list[dict[str, Any]] = [
        _feature(
            "Polygon",
            [rings[i].tolist()],
            {"kind": "cell", "index": i + 1, **{name: values[i] for name, values in columns.items()}},
        )
        for i in range(len(grid))
    ]
    names = list(towers_m or {})
    for name, place in (towers_m or {}).items():
        features.append(
            _feature(
                "Point",
                _lonlat(frame, np.asarray(place, dtype=np.float64)[None])[0].tolist(),
                {"kind": "tower", "name": name},
            )
        )
    for border in borders:
        between = [names[i] if i < len(names) else str(i) for i in border.towers]
        features.append(
            _feature("LineString", _lonlat(frame, border.line_m).tolist(), {"kind": "border", "towers": between})
        )
    target = Path(path)
    content = {"type": "FeatureCollection", "features": features}
    target.write_text(json.dumps(content, allow_nan=False, separators=(",", ":")) + "\n", encoding="utf-8")
    return target


def _feature(kind: str, coordinates: Any, properties: dict[str, Any]) -> dict[str, Any]:
    return {"type": "Feature", "geometry": {"type": kind, "coordinates": coordinates}, "properties": properties}


def _lonlat(frame: SiteFrame, points_m: FloatArray) -> FloatArray:
    latitude, longitude = frame.to_geographic(points_m[:, 0], points_m[:, 1])
    return np.asarray(np.round(np.column_stack([longitude, latitude]), 7), dtype=np.float64)  # 1 cm


def _cell_corners(grid: Grid, frame: SiteFrame) -> FloatArray:
    """Closed counter-clockwise rings (n, 5, 2) of longitude, latitude."""
    half = grid.spacing_m / 2
    step = half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])
    corners = grid.points_m[:, None, :] + step
    return _lonlat(frame, corners.reshape(-1, 2)).reshape(len(grid), 5, 2)


# --- Google Earth ---------------------------------------------------------------------------------------------------


def write_kmz(
    path: str | Path,
    grid: Grid,
    frame: SiteFrame,
    layers: Sequence[Layer],
    towers_m: Mapping[str, Sequence[float]] | None = None,
    borders: Sequence[Border] = (),
    *,
    title: str = "Coverage and rank",
) -> Path:
    """Ground overlays with one legend each (only the first is switched on), towers and serving borders.

    Parameters
    ----------
    path : path
        The file; replaced where it exists.
    grid : Grid
    frame : SiteFrame
        From local metres to latitude and longitude.
    layers : sequence of Layer
        Values in index order, (positions,), NaN out of coverage.
    towers_m : mapping of str to (3,), optional
        Positions of the towers, east, north, up.
    borders : sequence of Border
        Lines between the areas that two towers serve.
    title : str
        Name of the document.

    Returns
    -------
    Path
        The file.
    """
    _check(grid, layers)
    box = _bounding_box(grid, frame)
    parts = [_kml_overlay(layer, box, visible=number == 0) for number, layer in enumerate(layers)]
    names = list(towers_m or {})
    for name, place in (towers_m or {}).items():
        longitude, latitude = _lonlat(frame, np.asarray(place, dtype=np.float64)[None])[0]
        parts.append(
            f"<Placemark><name>{escape(name)}</name><Point><coordinates>{longitude:.7f},{latitude:.7f},0"
            "</coordinates></Point></Placemark>"
        )
    for border in borders:
        label = " / ".join(names[i] if i < len(names) else str(i) for i in border.towers)
        line = " ".join(f"{a:.7f},{b:.7f},0" for a, b in _lonlat(frame, border.line_m))
        parts.append(
            f"<Placemark><name>{escape(label)}</name><Style><LineStyle><color>ffffffff</color><width>2</width>"
            f"</LineStyle></Style><LineString><tessellate>1</tessellate><coordinates>{line}</coordinates></LineString></Placemark>"
        )
    document = (
        '<?xml version="1.0" encoding="UTF-8"?>\n<kml xmlns="http://www.opengis.net/kml/2.2"><Document>'
        f"<name>{escape(title)}</name><open>1</open>{''.join(parts)}</Document></kml>\n"
    )
    target = Path(path)
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        _add(archive, "doc.kml", document.encode())
        for layer in layers:
            low, high = _range(layer)
            _add(archive, f"maps/{layer.name}.png", _picture(grid, layer, low, high))
            _add(archive, f"legends/{layer.name}.png", _legend(layer, low, high))
    return target


def _add(archive: zipfile.ZipFile, name: str, content: bytes) -> None:
    entry = zipfile.ZipInfo(name, ZIP_DATE)
    entry.compress_type = zipfile.ZIP_DEFLATED
    archive.writestr(entry, content)


def _bounding_box(grid: Grid, frame: SiteFrame) -> tuple[float, float, float, float]:
    """North, south, east, west [deg] of the grid's edge.

    A KML box follows meridians and parallels, the grid the site's east and north; over 2 km the corners agree
    within 0.3 m, so the middles of the four edges are used.
    """
    half = grid.spacing_m / 2
    east, north = grid.east_m, grid.north_m
    middle_east, middle_north = (east[0] + east[-1]) / 2, (north[0] + north[-1]) / 2
    edges = np.array(
        [
            [middle_east, north[-1] + half],
            [middle_east, north[0] - half],
            [east[-1] + half, middle_north],
            [east[0] - half, middle_north],
        ]
    )
    latitude, longitude = frame.to_geographic(edges[:, 0], edges[:, 1])
    return float(latitude[0]), float(latitude[1]), float(longitude[2]), float(longitude[3])


def _kml_overlay(layer: Layer, box: tuple[float, float, float, float], *, visible: bool) -> str:
    north, south, east, west = box
    shown = int(visible)
    return (
        f"<Folder><name>{escape(layer.title)}</name><visibility>{shown}</visibility>"
        f"<GroundOverlay><name>map</name><visibility>{shown}</visibility><color>c0ffffff</color>"
        f"<Icon><href>maps/{layer.name}.png</href></Icon><LatLonBox><north>{north:.9f}</north><south>{south:.9f}</south>"
        f"<east>{east:.9f}</east><west>{west:.9f}</west></LatLonBox></GroundOverlay>"
        f"<ScreenOverlay><name>legend</name><visibility>{shown}</visibility><Icon><href>legends/{layer.name}.png</href></Icon>"
        '<overlayXY x="0" y="1" xunits="fraction" yunits="fraction"/>'
        '<screenXY x="0.01" y="0.97" xunits="fraction" yunits="fraction"/>'
        '<size x="0" y="0" xunits="pixels" yunits="pixels"/></ScreenOverlay></Folder>'
    )


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
    share = np.clip((np.nan_to_num(values, nan=low, posinf=high, neginf=low) - low) / (high - low), 0, 1)
    return np.where(np.isnan(values)[:, None], grey, colormaps["viridis"](share))


def _class_palette(layer: Layer) -> list[str]:
    start = 0 if layer.classes[0] == "Z" else 1
    return [CLASS_COLOURS[start + i % (len(CLASS_COLOURS) - start)] for i in range(len(layer.classes))]


def _picture(grid: Grid, layer: Layer, low: float, high: float) -> bytes:
    """PNG with a block of pixels per cell: viewers that smooth must not mix classes."""
    from matplotlib.image import imsave

    cells = grid.raster(_colours(layer, low, high))[::-1]  # pictures begin in the north
    pixels = np.repeat(np.repeat(cells, PIXELS_PER_CELL, axis=0), PIXELS_PER_CELL, axis=1)
    buffer = io.BytesIO()
    imsave(buffer, np.ascontiguousarray((255 * pixels).round().astype(np.uint8)), format="png")
    return buffer.getvalue()


def _legend(layer: Layer, low: float, high: float) -> bytes:
    """PNG of a colour bar or of the class colours, drawn without touching pyplot's state."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    figure = Figure(figsize=(4.2, 0.9 if not layer.classes else 0.35 + 0.18 * len(layer.classes)), dpi=110)
    FigureCanvasAgg(figure)
    figure.patch.set_alpha(0.9)
    figure.suptitle(layer.title, fontsize=9, y=0.98, va="top")
    if layer.classes:
        names = ["Z (out of coverage)" if name == "Z" else name for name in layer.classes]
        patches = [Patch(color=c, label=n) for c, n in zip(_class_palette(layer), names, strict=True)]
        figure.legend(handles=patches, loc="lower left", fontsize=8, frameon=False, borderaxespad=0.3, labelspacing=0.3)
    else:
        axes = figure.add_axes((0.08, 0.42, 0.84, 0.22))
        bar = figure.colorbar(
            ScalarMappable(Normalize(low, high), "viridis"), cax=axes, orientation="horizontal", extend="both"
        )
        bar.set_label(f"{layer.unit}; grey: out of coverage", fontsize=8, labelpad=1)
        bar.ax.tick_params(labelsize=8, pad=1)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": "aerpaw-cmp"})
    return buffer.getvalue()


# --- optional extras ------------------------------------------------------------------------------------------------


def write_geotiff(path: str | Path, grid: Grid, frame: SiteFrame, layers: Sequence[Layer]) -> Path:
    """Cloud-optimised GeoTIFF, one float32 band per layer with name, unit, title and classes; north up.

    NaN is out of coverage. A band of classes has no missing value: its 0 is the class "Z", which its tag ``classes``
    names.

    Parameters
    ----------
    path : path
        The file; replaced where it exists.
    grid : Grid
    frame : SiteFrame
        From local metres to latitude and longitude.
    layers : sequence of Layer
        Values in index order, (positions,), NaN out of coverage.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    UsageError
        If rasterio is not installed.
    """
    _check(grid, layers)
    try:
        import rasterio
        from rasterio.io import MemoryFile
        from rasterio.shutil import copy
    except ImportError as missing:
        raise UsageError(
            f"GeoTIFF needs {missing.name}, which is not installed",
            expected="pip install 'aerpaw-cmp[geo]', or another format",
        ) from None
    half, step = grid.spacing_m / 2, grid.spacing_m
    corner = rasterio.Affine(step, 0.0, grid.east_m[0] - half, 0.0, -step, grid.north_m[-1] + half)
    rows, columns = grid.shape
    target = Path(path)
    # GDAL says nothing of what a full disk did not take: made in memory, the layout by a copy
    with MemoryFile() as memory, MemoryFile(ext=".tif") as ordered:
        with memory.open(
            driver="GTiff", width=columns, height=rows, count=len(layers), dtype="float32",
            crs=site_crs(frame).to_wkt("WKT2_2019"), transform=corner, nodata=np.nan,
        ) as file:  # fmt: skip
            for band, layer in enumerate(layers, start=1):
                values = np.asarray(layer.values, dtype=np.float32)
                file.write(grid.raster(values)[::-1], band)
                file.set_band_description(band, layer.name)
                file.set_band_unit(band, layer.unit)
                file.update_tags(band, title=layer.title, unit=layer.unit, classes=" ".join(layer.classes))
        with memory.open() as file:
            copy(file, ordered.name, driver="COG", compress="deflate", overview_resampling="nearest")
        target.write_bytes(ordered.read())
    return target


# --- shared ---------------------------------------------------------------------------------------------------------


def _check(grid: Grid, layers: Sequence[Layer]) -> None:
    wrong = [f"{layer.name} {np.shape(layer.values)}" for layer in layers if np.shape(layer.values) != (len(grid),)]
    names = [layer.name for layer in layers]
    twice = sorted({name for name in names if names.count(name) > 1})
    if wrong or twice:
        raise ValueError(
            f"layers of the wrong shape: {wrong}, with the same name: {twice}; the grid has {len(grid)} cells"
        )
