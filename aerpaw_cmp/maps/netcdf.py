"""Maps as one dataset after CF-1.11, in memory and as NetCDF: arrays over foliage, tower, K, height, y and x.

Values are rounded to 0.01 dB, more than the site's data hold. The maps in which the nearest tower serves are
variables of their own (``..._joint``): what ``serving_tower`` picks from the maps by tower.

Both need ``pip install aerpaw-cmp[geo]``.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from ..common.cf import DB, DBM, Dataset, site_crs
from ..common.geodesy import SiteFrame
from ..common.units import AnyArray, FloatArray
from .grid import Layer
from .job import HIGHEST_RANK, RATIO_LIMIT_DB, MapResult

_PLANE = ("y", "x")
_LABELS = "foliage_mode latitude longitude"
_Variable = tuple[tuple[str, ...], AnyArray, dict[str, Any]]


def maps_dataset(
    maps: Mapping[str, MapResult], frame: SiteFrame, about: Mapping[str, str], further: Sequence[Layer] = ()
) -> Dataset:
    """Maps as variables with dimensions foliage, tower, k, height, y, x.

    Parameters
    ----------
    maps : mapping of str to MapResult
        By foliage mode; all of one grid, one list of towers, heights and K.
    frame : SiteFrame
        From local metres to latitude and longitude.
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
    variables["foliage_mode"] = _text("foliage", maps, "how trees act")
    for layer in further:
        plane = first.grid.raster(np.asarray(layer.values))
        if layer.classes:
            # rank_1, not 1: beside flag_values a bare number would be taken for a value
            codes = tuple(f"rank_{c}" if c.isdigit() else c for c in layer.classes)
            variables[layer.name] = _PLANE, plane.astype(np.int8), _codes(codes, layer.title)
        else:
            unit = {"dBm": DBM, "dB": DB}.get(layer.unit, layer.unit)
            attributes = {
                "long_name": layer.title,
                "units": unit,
                "comment": f"unit: {layer.unit}",
                "grid_mapping": "crs",
            }
            variables[layer.name] = (
                _PLANE,
                plane.astype(np.float32),
                {**attributes, "coordinates": "latitude longitude"},
            )
    return Dataset(variables, about)


def _text(dimension: str, names: Mapping[str, Any] | Sequence[str], meaning: str) -> _Variable:
    # objects become strings of variable length; an array of characters would need an axis of its own
    return (dimension,), np.array(list(names), dtype=object), {"long_name": meaning}


def _places(maps: MapResult, frame: SiteFrame) -> dict[str, _Variable]:
    """Axes, towers, latitude and longitude, the tower that serves, the reference system."""
    variables: dict[str, _Variable] = {
        "k": (("k",), np.array(maps.ks), {"long_name": "singular-value ratio K of the rank", "units": "1"}),
        "tower_name": _text("tower", maps.tower_names, "name of the tower"),
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
    """Levels and ratios of singular values, by tower and of the nearest tower."""
    limit = f"at most {RATIO_LIMIT_DB:g} dB"
    kinds: dict[str, tuple[str, str, str, str, Callable[[MapResult], FloatArray]]] = {
        "rss_siso": ("received level, one element at both ends", "height", DBM, "dBm", lambda m: m.rss_siso_dbm),
        "rss_mimo": ("received level, arrays at both ends", "height", DBM, "dBm", lambda m: m.rss_mimo_dbm),
        "rss_sd": ("standard deviation of the level over the element pairs", "height", DB, "dB",
                   lambda m: m.level_sd_db),
        "spread": (f"largest over second singular value, {limit}", "height_of_rank", DB, "dB",
                   lambda m: np.minimum(m.spread_db, RATIO_LIMIT_DB)),
        "condition": (f"largest over last singular value, {limit}", "height_of_rank", DB, "dB",
                      lambda m: np.minimum(m.condition_db, RATIO_LIMIT_DB)),
    }  # fmt: skip
    variables = {}
    for name, (meaning, height, unit, shown, values_of) in kinds.items():
        by_tower = [np.moveaxis(values_of(item), 1, 0) for item in maps.values()]  # tower, height, n
        joint = [
            values[result.serving, :, np.arange(len(result.grid))].T
            for result, values in zip(maps.values(), by_tower, strict=True)
        ]
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
    """Values of every mode, (..., n) each, as a variable over foliage, ``between`` and the plane.

    Parameters
    ----------
    maps : mapping of str to MapResult
    values : sequence of ndarray
        One array a mode.
    between : tuple of str
        Dimensions of the values but the last; without ``"tower"`` they are those of the nearest tower.
    attributes : mapping

    Returns
    -------
    tuple
        Dimensions, values, attributes.
    """
    joint = "tower" not in between
    # the last axis, positions in index order, as y and x
    planes = np.stack([v.reshape(*v.shape[:-1], *m.grid.shape) for m, v in zip(maps.values(), values, strict=True)])
    # levels as float32 hold 0.01 dB exactly enough and halve the file
    numbers = planes.astype(np.int8) if "flag_values" in attributes else np.round(planes, 2).astype(np.float32)
    described = {
        **attributes,
        "long_name": str(attributes["long_name"]) + (", nearest tower" if joint else ""),
        "coordinates": _LABELS if joint else f"{_LABELS} tower_name",
        "grid_mapping": "crs",
    }
    return ("foliage", *between, *_PLANE), numbers, described


def _codes(meanings: Sequence[str], long_name: str) -> dict[str, Any]:
    """Attributes of a variable of classes 0, 1, ..."""
    return {
        "long_name": long_name,
        "flag_values": np.arange(len(meanings), dtype=np.int8),
        # all that CF allows in a meaning
        "flag_meanings": " ".join(re.sub(r"[^A-Za-z0-9_.+@-]", "_", item) or "_" for item in meanings),
        "grid_mapping": "crs",
    }
