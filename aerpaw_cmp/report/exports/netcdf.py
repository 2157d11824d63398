"""Samples as NetCDF after CF-1.11: trajectories as a contiguous ragged array, one per link."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ...common.cf import CONVENTIONS, WGS84, write_text
from ...common.units import AnyArray
from .samples import Column, Export, SampleSet, Series, latitude_longitude

NO_CODE = -1
"""Stands for a missing code; attribute ``_FillValue``."""


def write_netcdf(export: Export, folder: Path) -> list[Path]:
    """``rss.nc`` and ``rank.nc``."""
    paths = []
    for samples in export.sets:
        path = folder / f"{samples.kind}.nc"
        path.write_bytes(_bytes(export, samples))
        paths.append(path)
    return paths


def _bytes(export: Export, samples: SampleSet) -> Any:
    """The whole file, made in memory: HDF5 ends the process where a disk is full."""
    import netCDF4

    book = netCDF4.Dataset(samples.kind, "w", memory=1 << 20)
    _attributes(book, export, samples)
    book.createDimension("trajectory", len(samples.series))
    book.createDimension("obs", len(samples))
    _labels(book, samples)
    _write_times(book, export, samples)
    _write_places(book, export, samples)
    for column in samples.columns:
        _write_column(book, column, samples)
    return book.close()


def _attributes(book: Any, export: Export, samples: SampleSet) -> None:
    generated, version = export.attributes.get("generated", ""), export.attributes.get("version", "")
    what = {"rss": "Received level, measured and replayed", "rank": "Channel rank, reported and replayed"}
    book.setncatts(
        {
            "Conventions": CONVENTIONS,
            "featureType": "trajectory",
            "title": f"{what[samples.kind]}: {export.title}",
            "source": f"aerpaw-cmp {version}: field logs, replayed by ray tracing",
            "history": f"{generated} written by aerpaw-cmp {version}",
            "institution": "not stated",
            "references": "https://arxiv.org/abs/2502.10324",
            "comment": " ".join(export.remarks),
        }
    )


def _labels(book: Any, samples: SampleSet) -> None:
    """The name of each trajectory, what it is made of, and how many samples it has."""
    texts = {
        "link": ("flight, tower and channel", [f"{s.flight} {s.name}" for s in samples.series]),
        "flight": ("name of the flight", [s.flight for s in samples.series]),
        "tower": ("name of the tower", [s.tower for s in samples.series]),
        "channel": ("name of the channel", [s.channel for s in samples.series]),
        "unit_of_measured": ("unit of the level as logged", [s.unit for s in samples.series]),
    }
    for name, (meaning, values) in texts.items():
        write_text(book, name, ("trajectory",), np.array(values, dtype=object), meaning)
    book["link"].cf_role = "trajectory_id"
    rows = book.createVariable("row_size", "i4", ("trajectory",))
    rows.setncatts({"long_name": "number of samples of this link", "sample_dimension": "obs"})
    rows[:] = [len(s) for s in samples.series]


def _joined(samples: SampleSet, part: Any) -> AnyArray:
    return np.concatenate([np.asarray(part(series)) for series in samples.series])


def _write_times(book: Any, export: Export, samples: SampleSet) -> None:
    times = _joined(samples, lambda s: s.time)
    known = times[~np.isnat(times)]
    start = known.min().astype("datetime64[s]") if len(known) and export.clock else np.datetime64("1970-01-01", "s")
    seconds = np.where(np.isnat(times), np.nan, (times - start) / np.timedelta64(1, "s"))
    variable = _number(book, "time", seconds)
    text = str(start).replace("T", " ")
    variable.setncatts(
        {
            "standard_name": "time",
            "long_name": "instant of the sample",
            "units": f"seconds since {text} UTC" if " " in text else f"seconds since {text} 00:00:00 UTC",
            "calendar": "standard",
            "units_metadata": "leap_seconds: none",
            "axis": "T",
        }
    )
    if not export.clock:
        variable.comment = "the logs have relative times and no origin: the date is none"


def _write_places(book: Any, export: Export, samples: SampleSet) -> None:
    places = [latitude_longitude(export.site.frame, s.east_m, s.north_m) for s in samples.series]
    rows = {
        "latitude": ([p[0] for p in places], "degrees_north", "WGS84 latitude", "Y"),
        "longitude": ([p[1] for p in places], "degrees_east", "WGS84 longitude", "X"),
        "up": ([s.up_m for s in samples.series], "m", "height above the ground at the site origin", "Z"),
        "east": ([s.east_m for s in samples.series], "m", "east of the site origin", ""),
        "north": ([s.north_m for s in samples.series], "m", "north of the site origin", ""),
    }
    for name, (parts, unit, meaning, axis) in rows.items():
        variable = _number(book, name, np.concatenate(parts))
        variable.setncatts({"long_name": meaning, "units": unit})
        if name in ("latitude", "longitude"):
            variable.standard_name = name
        if name == "up":
            variable.standard_name, variable.positive = "height", "up"
        if axis:
            variable.axis = axis
    crs = book.createVariable("crs", "i4")
    crs.setncatts(WGS84)
    crs[...] = 0


def _number(book: Any, name: str, values: AnyArray) -> Any:
    """A variable (obs,) of doubles; coordinates have no missing value declared unless they have one."""
    missing = bool(np.isnan(values).any())
    variable = book.createVariable(
        name, "f8", ("obs",), zlib=True, complevel=4, shuffle=True, fill_value=np.nan if missing else False
    )
    variable[:] = values
    return variable


def _write_column(book: Any, column: Column, samples: SampleSet) -> None:
    def of(series: Series) -> AnyArray:
        known = series.values.get(column.name)
        return np.full(len(series), np.nan) if known is None else known

    values = _joined(samples, of)
    name = column.name.replace(".", "p")
    shared = {"long_name": column.meaning, "coordinates": "time latitude longitude up", "grid_mapping": "crs"}
    if column.flags:
        variable = book.createVariable(name, "i1", ("obs",), zlib=True, complevel=4, fill_value=np.int8(NO_CODE))
        variable.setncatts(
            {
                **shared,
                "flag_values": np.arange(len(column.flags), dtype=np.int8),
                "flag_meanings": " ".join(column.flags),
            }
        )
        variable[:] = np.where(np.isfinite(values), values, NO_CODE).astype(np.int8)
        return
    variable = book.createVariable(name, "f8", ("obs",), zlib=True, complevel=4, shuffle=True, fill_value=np.nan)
    variable.setncatts({**shared, "units": column.unit})
    if column.shown_unit not in ("", column.unit):
        variable.comment = f"unit: {column.shown_unit}"
    variable[:] = values
