"""The data of the map page's script: every layer as integers with a step, the numbers of each, colours, the site.

What the script shows of a layer (share covered, median, shares of ranks) it computes from these integers;
:func:`layer_numbers` gives the same numbers for metrics.json from the maps themselves.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ...common.geodesy import SiteFrame
from ...common.kml import CLASS_COLOURS
from ...common.units import FloatArray
from ..content.flight import RANKS
from ..content.maps import JOINT, MapLayer, MapsData, RankMap, RssMap, at_height
from ..figures.charts import Chart
from ..figures.maps import grouped, half_width
from ..kit.packed import NONE, PackedArrays, step_for
from ..kit.shapes import listed
from ..names import k_key
from .explorer import packed, plan_of

# Base64 that the layers may take; beyond it layers of single towers are left out, then cells.
MOST_BYTES = 4_000_000

_LATTICE = 9
_DEGREE = 4
_FINEST_DB = 0.01

LEVEL, _CLASSES, DIFFERENCE = "level", "classes", "difference"
_RANK_CLASSES = ("Z", *map(str, RANKS))


# --- layers ---------------------------------------------------------------------------------------------------------


def page_layers(data: MapsData) -> list[MapLayer]:
    """Every layer that the page can show, quantities in their order."""
    rss = [
        MapLayer(
            quantity="RSS", unit="dBm", axes={"Tower": m.tower, "Antennas": m.antennas, **_foliage_height(m)},
            values=m.rss_dbm,
        )
        for m in data.rss
    ]  # fmt: skip
    traced = [
        _rank_layer(m, "Rank", {"Tower": m.tower, "K": k_key(m.k or 0.0), **_foliage_height(m)})
        for m in (*data.rank, *data.rank_by_tower)
    ]
    corrected = [
        _rank_layer(
            m, "Rank, raw and corrected",
            {"Version": f"{'corrected' if m.k is None else 'raw'}, {m.source}", "Tower": m.tower,
             **at_height(m.altitude_m)},
        )
        for m in data.corrected_rank
    ]  # fmt: skip
    return [*rss, *traced, *corrected, *data.layers]


def _rank_layer(m: RankMap, quantity: str, axes: dict[str, str]) -> MapLayer:
    values = np.where(m.rank > 0, m.rank, np.nan)
    return MapLayer(quantity=quantity, unit="", axes=axes, values=values, classes=_RANK_CLASSES)


def _foliage_height(m: RssMap | RankMap) -> dict[str, str]:
    return {**({"Foliage": m.foliage} if m.foliage else {}), **at_height(m.altitude_m)}


def layer_numbers(layer: MapLayer) -> dict[str, Any]:
    """Numbers of a layer on the page: share covered, percentiles, shares of classes (None where there is none)."""
    finite = layer.values[np.isfinite(layer.values)]
    result: dict[str, Any] = {
        "quantity": layer.quantity,
        "unit": layer.unit,
        **{name.lower(): value for name, value in layer.axes.items()},
        "covered": len(finite) / layer.values.size,
    }
    if layer.classes:
        counts = np.bincount(finite.astype(np.int64), minlength=len(layer.classes)).astype(np.float64)
        if layer.classes[0] == _RANK_CLASSES[0]:  # no path is a class of its own
            counts[0] = layer.values.size - len(finite)
        return result | {"share": dict(zip(layer.classes, counts / layer.values.size, strict=True))}
    names = ("min", "p10", "median", "p90", "max")
    levels = np.quantile(finite, [0.0, 0.1, 0.5, 0.9, 1.0]) if len(finite) else np.full(5, np.nan)
    return result | {"mean": finite.mean() if len(finite) else np.nan, **dict(zip(names, levels, strict=True))}


# --- what the script gets ---------------------------------------------------------------------------------------------


def payload(data: MapsData, charts: Sequence[Chart] = (), most_bytes: int = MOST_BYTES) -> dict[str, Any]:
    """Everything the script needs, as plain values, in at most about ``most_bytes`` of base64.

    Parameters
    ----------
    data : MapsData
    charts : sequence of Chart
    most_bytes : int
        Where all layers need more, those of single towers but RSS are left out, then all of single towers, then
        every second (third, ...) cell of each row and column is kept; ``left_out`` says which.
    """
    layers = page_layers(data)
    tries: list[tuple[str, Sequence[MapLayer], int]] = [("", layers, 1)]
    joint = [item for item in layers if _is_joint(item)]
    levels = [item for item in layers if _is_joint(item) or item.quantity == "RSS"]
    tries.append(("layers of single towers but RSS", levels, 1))
    tries.append(("layers of single towers", joint, 1))
    stride = 1
    while True:
        for words, chosen, every in tries:
            content = _packed(data, charts, chosen, every)
            # measured after packing: how far the block deflates depends on the maps
            if len(content["packed"]["data"]) <= most_bytes:
                return content | {"left_out": words, "stride": every}
        stride += 1
        words = f"layers of single towers, and all but every {stride}. cell of each row and column"
        tries = [(words, joint, stride)]


def _is_joint(layer: MapLayer) -> bool:
    return layer.axes.get("Tower", JOINT) == JOINT


def _packed(data: MapsData, charts: Sequence[Chart], layers: Sequence[MapLayer], stride: int) -> dict[str, Any]:
    arrays = PackedArrays()
    east, north = data.east_m[::stride], data.north_m[::stride]
    by_quantity = grouped(layers, lambda layer: layer.quantity)
    quantities = [_quantity(name, members, arrays, stride) for name, members in by_quantity.items()]
    return {
        "east": arrays.add(east, "f8"),
        "north": arrays.add(north, "f8"),
        "half": [stride * half_width(axis) for axis in (data.east_m, data.north_m)],
        "degrees": geographic(data.site.frame, data.east_m, data.north_m),
        "site": plan_of(data.site),
        "borders": [listed(line) for line in data.borders_m],
        "flown": [listed(np.round(line, 1)) for line in data.flown_m],
        "joint": JOINT,
        "quantities": quantities,
        "plots": [packed(chart.content, arrays) for chart in charts],
        "packed": arrays.content(),
    }


def _quantity(name: str, layers: Sequence[MapLayer], arrays: PackedArrays, stride: int) -> dict[str, Any]:
    """One quantity: its axes, and per combination of their values the number of its array."""
    axes: dict[str, list[str]] = {}
    for layer in layers:
        for axis, value in layer.axes.items():
            if value not in axes.setdefault(axis, []):
                axes[axis].append(value)
    for axis, values in axes.items():
        values.sort(key=lambda value: _place(axis, value))
    kind = _CLASSES if layers[0].classes else DIFFERENCE if layers[0].difference else LEVEL
    every = np.concatenate([layer.values[np.isfinite(layer.values)] for layer in layers])
    step = 1.0 if kind == _CLASSES else step_for(every, _FINEST_DB)
    stored = {}
    for layer in layers:
        cells = layer.values[::stride, ::stride].ravel()
        key = ",".join(str(axes[axis].index(layer.axes[axis])) if axis in layer.axes else "0" for axis in axes)
        classes = np.nan_to_num(cells, nan=NONE["u1"])
        stored[key] = arrays.add(classes, "u1") if kind == _CLASSES else arrays.add_steps(cells, step)
    return {
        "name": name,
        "unit": layers[0].unit,
        "kind": kind,
        "step": step,
        "range": _range(every, kind),
        "classes": list(layers[0].classes),
        "colours": _class_colours(layers[0].classes),
        "axes": [{"name": axis, "values": values} for axis, values in axes.items()],
        "layers": stored,
    }


def _place(axis: str, value: str) -> float:
    """Order of the values of an axis: all towers together first, heights and K rising, others as they came."""
    if axis == "Tower":
        return 0.0 if value == JOINT else 1.0
    return float(value.removesuffix(" m")) if axis in ("Height", "K") else 0.0


def _range(values: FloatArray, kind: str) -> list[float]:
    """Ends of the colour scale that all layers of a quantity share: 1 and 99.5 %, even about zero for differences."""
    if kind == DIFFERENCE and len(values):
        reach = float(np.percentile(np.abs(values), 99)) or float(np.abs(values).max()) or 1.0
        return [-reach, reach]
    return ends_of_scale(values, 99.5)


def ends_of_scale(values: FloatArray, most: float) -> list[float]:
    """Ends of a colour scale: 1 % and ``most`` % of finite values, half a unit about a constant, 0 and 1 of none."""
    low, high = (float(v) for v in np.percentile(values, [1.0, most])) if len(values) else (0.0, 1.0)
    return [low, high] if high > low else [low - 0.5, low + 0.5]


def _class_colours(classes: Sequence[str]) -> list[str]:
    """A colour per class: those of ranks, else well apart in hue and lightness."""
    if tuple(classes) == _RANK_CLASSES:
        return ["", *(CLASS_COLOURS[rank] for rank in RANKS)]
    if not classes:
        return []
    hues = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#D55E00", "#56B4E9", "#F0E442", "#555555")
    return [hues[number % len(hues)] for number in range(len(classes))]


def geographic(frame: SiteFrame, east_m: FloatArray, north_m: FloatArray) -> dict[str, Any]:
    """Latitude and longitude [deg] over the area as polynomials of east and north, for the script.

    Returns
    -------
    dict
        ``middle`` and ``reach`` (2,) [m]; ``powers`` (m, 2); ``lat``, ``lon`` (m,) [deg]: the sum over m of
        coefficient times u^p v^q with u, v = (position - middle) / reach. ``worst_m``: the largest error on the
        lattice of the fit.

    Notes
    -----
    Least squares on a lattice of 9 x 9 points. Over 10 km the error is below a millimetre; the projection's inverse
    itself is :meth:`aerpaw_cmp.common.geodesy.SiteFrame.to_geographic`.
    """
    ends = np.array([[east_m[0], east_m[-1]], [north_m[0], north_m[-1]]], dtype=np.float64)
    middle = ends.mean(axis=1)
    # of one row of cells the reach is 0, by which the script would divide
    reach = np.maximum(np.ptp(ends, axis=1) / 2, 100.0)
    u, v = (grid.ravel() for grid in np.meshgrid(np.linspace(-1, 1, _LATTICE), np.linspace(-1, 1, _LATTICE)))
    east, north = middle[0] + u * reach[0], middle[1] + v * reach[1]
    lat, lon = frame.to_geographic(east, north)
    powers = [(p, q) for p in range(_DEGREE + 1) for q in range(_DEGREE + 1 - p)]
    matrix = np.column_stack([u**p * v**q for p, q in powers])
    (by_lat, by_lon), *_ = (np.linalg.lstsq(matrix, np.column_stack([lat, lon]), rcond=None)[0].T,)
    back = frame.to_local(matrix @ by_lat, matrix @ by_lon)
    worst = float(np.hypot(back[0] - east, back[1] - north).max())
    return {
        "middle": middle.tolist(), "reach": reach.tolist(), "powers": [list(pair) for pair in powers],
        "lat": by_lat.tolist(), "lon": by_lon.tolist(), "worst_m": worst,
    }  # fmt: skip
