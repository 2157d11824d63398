"""Samples as tables of numbers: NetCDF after CF-1.11."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ...common.cf import WGS84, Dataset, file_attributes, netcdf_bytes
from .points import LINK, PLACES, Column, Export, Points

# Stands for a missing code in NetCDF; attribute ``_FillValue``.
_NO_CODE = -1


_TITLES = {"rss": "Received level, measured and replayed", "rank": "Channel rank, reported and replayed"}


def write_netcdf(export: Export, folder: Path) -> list[Path]:
    """``<kind>.nc``: trajectories as a contiguous ragged array, one per link."""
    paths = []
    for points in export.sets:
        path = folder / f"{points.kind}.nc"
        path.write_bytes(netcdf_bytes(_points_dataset(export, points)))
        paths.append(path)
    return paths


def _points_dataset(export: Export, points: Points) -> Dataset:
    """The samples of one kind as variables with dimensions trajectory (links) and obs."""
    links = list(points.links())
    texts = {
        "link": ("flight, tower and channel", [f"{f} {f'{t} {c}'.strip()}" for f, t, c, _ in links]),
        **{name: (f"name of the {name}", [link[i] for link in links]) for i, name in enumerate(LINK)},
        "unit_of_measured": ("unit of the level as logged", [str(rows["unit"].iloc[0]) for *_, rows in links]),
    }
    variables: dict[str, Any] = {
        name: ("trajectory", np.array(values, dtype=object), {"long_name": meaning})
        for name, (meaning, values) in texts.items()
    }
    variables["link"][2]["cf_role"] = "trajectory_id"
    size = {"long_name": "number of samples of this link", "sample_dimension": "obs"}
    variables["row_size"] = ("trajectory", np.array([len(rows) for *_, rows in links], dtype=np.int32), size)
    variables["time"] = ("obs", *_seconds(export, points.table["time"].to_numpy()))
    axes = {"latitude_deg": "Y", "longitude_deg": "X", "up_m": "Z"}
    for name, (unit, meaning) in PLACES.items():
        short = name.rpartition("_")[0]
        attributes = {"long_name": meaning, "units": unit}
        if name in axes:
            attributes |= {"standard_name": "height" if short == "up" else short, "axis": axes[name]}
        if short == "up":
            attributes["positive"] = "up"
        variables[short] = ("obs", points.table[name].to_numpy(), attributes)
    variables["crs"] = ((), np.int32(0), WGS84)
    for item in points.columns:
        variables[item.name.replace(".", "p")] = ("obs", *_values(item, points.table[item.name].to_numpy()))
    about = file_attributes(
        title=f"{_TITLES.get(points.kind, points.kind)}: {export.title}",
        source="field logs, replayed by ray tracing",
        comment=" ".join(export.remarks),
    )
    return Dataset(variables, {**about, "featureType": "trajectory"})


def _seconds(export: Export, times: Any) -> tuple[Any, dict[str, str]]:
    """Seconds after the first whole second, and their attributes."""
    known = times[~np.isnat(times)]
    start = known.min().astype("datetime64[s]") if len(known) and export.clock else np.datetime64("1970-01-01", "s")
    attributes = {
        "standard_name": "time",
        "long_name": "instant of the sample",
        "units": f"seconds since {str(start).replace('T', ' ')} UTC",
        "calendar": "standard",
        "units_metadata": "leap_seconds: none",
        "axis": "T",
    }
    if not export.clock:
        attributes["comment"] = "the logs have relative times and no origin: the date is none"
    return np.where(np.isnat(times), np.nan, (times - start) / np.timedelta64(1, "s")), attributes


def _values(column: Column, values: Any) -> tuple[Any, ...]:
    """Values, attributes and encoding of a quantity or of codes."""
    shared = {"long_name": column.meaning, "coordinates": "time latitude longitude up", "grid_mapping": "crs"}
    if column.flags:
        codes = np.where(np.isfinite(values), values, _NO_CODE).astype(np.int8)
        flags = {"flag_values": np.arange(len(column.flags), dtype=np.int8), "flag_meanings": " ".join(column.flags)}
        return codes, shared | flags, {"_FillValue": np.int8(_NO_CODE)}
    comment = {} if column.shown_unit in ("", column.unit) else {"comment": f"unit: {column.shown_unit}"}
    return values, {**shared, "units": column.unit, **comment}, {"_FillValue": np.nan}
