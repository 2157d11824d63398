"""The files rss.nc and rank.nc of a report: the samples of rss.csv and rank.csv with units and the names of links.

Dimensions are the names of :data:`_AXES` and ``obs``, the number of a sample in its series. Shorter series are filled
with NaN up to the length of the longest. The variables are the columns of :mod:`.columns`, and a missing number is NaN.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..common.cf import DB, DBM, Dataset, file_attributes, flags, netcdf_bytes, wgs84
from ..common.units import AnyArray, FloatArray
from ..logs.records import has_wall_clock
from .columns import DECIMALS, RANK, RSS, Column, tables
from .flight_data import ReportData

# Columns of text: labels that select a series, and its unit.
_AXES = ("tower", "channel")
_TEXTS = (*_AXES, "unit")
_TITLES = {"rss": "Received level, measured and replayed", "rank": "Channel rank, reported and replayed"}
_RANKS = flags(("no path", "rank 1", "rank 2", "rank 3", "rank 4"))


def write_netcdf(data: ReportData, folder: Path) -> list[Path]:
    """Write ``rss.nc`` if the flight has levels and ``rank.nc`` if it has ranks, and return their paths.

    Raises
    ------
    UsageError
        If netCDF4 is not installed.
    """
    files = {"rss": (RSS, data.rss), "rank": (RANK, data.rank)}
    written = []
    for kind, (columns, series) in files.items():
        if series:
            path = folder / f"{kind}.nc"
            path.write_bytes(netcdf_bytes(_dataset(data, kind, columns, series)))
            written.append(path)
    return written


def _dataset(data: ReportData, kind: str, columns: Sequence[Column], series: Sequence[Any]) -> Dataset:
    """Return the samples of all series as variables with the dimensions :data:`_AXES` and ``obs``."""
    members, rows = tables(columns, series)
    texts = {column: [str(row[column.name]) for _, row in rows] for column in members if column.name in _TEXTS}
    labels = {column: list(dict.fromkeys(names)) for column, names in texts.items() if column.name in _AXES}
    counts = [len(names) for names in labels.values()]
    cells = np.ravel_multi_index([[labels[c].index(n) for n in texts[c]] for c in labels], counts)
    lengths = np.array([len(time) for time, _ in rows])
    places = np.concatenate([cell * lengths.max() + np.arange(n) for cell, n in zip(cells, lengths, strict=True)])
    axes = tuple(column.name for column in labels)

    def placed(values: FloatArray) -> tuple[tuple[str, ...], FloatArray]:
        """Return dimensions and values of a variable, from the values of all series one after another."""
        whole = np.full((*counts, lengths.max()), np.nan)
        whole.flat[places] = values
        return (*axes, "obs"), whole

    variables: dict[str, Any] = {c.name: (c.name, names, {"long_name": c.meaning}) for c, names in labels.items()}
    for column in texts.keys() - labels.keys():
        units = np.full(counts, "", dtype=object)
        units.flat[cells] = texts[column]
        variables[column.name] = (axes, units, {"long_name": column.meaning})
    seconds, about = _seconds(np.concatenate([time for time, _ in rows]))
    variables |= {"time": (*placed(seconds), about), "crs": ((), np.int32(0), wgs84())}
    samples = {c.name: np.concatenate([_numbers(row[c.name]) for _, row in rows]) for c in members if c not in texts}
    degrees = (("latitude", "degrees_north"), ("longitude", "degrees_east"))
    for (name, unit), values in zip(degrees, _degrees(data, samples), strict=True):
        variables[name] = (*placed(values), {"standard_name": name, "long_name": f"WGS84 {name}", "units": unit})
    for column in members:
        if column not in texts:
            variables[column.name.replace(".", "p")] = (*placed(samples[column.name]), _attributes(column))
    source = "synthetic logs, replayed by ray tracing" if data.synthetic else "field logs, replayed by ray tracing"
    comment = "Heights (up_m) are metres above the ground at the site origin. A missing number is NaN."
    attributes = file_attributes(title=f"{_TITLES[kind]}: {data.title}", source=source, comment=comment)
    return Dataset(variables, attributes)


def _numbers(values: Any) -> FloatArray:
    """Return a column (n,) with the decimals of the CSV file, and NaN for missing numbers."""
    import pandas as pd

    return np.asarray(np.round(pd.array(values).to_numpy(dtype=np.float64, na_value=np.nan), DECIMALS))


def _degrees(data: ReportData, samples: dict[str, FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Return latitude and longitude (n,) of the samples [deg], rounded to 1 mm; NaN for unknown positions."""
    east, north = samples["east_m"], samples["north_m"]
    known = np.isfinite(east) & np.isfinite(north)
    latitude, longitude = data.site.frame.to_geographic(np.where(known, east, 0.0), np.where(known, north, 0.0))
    return np.where(known, np.round(latitude, 8), np.nan), np.where(known, np.round(longitude, 8), np.nan)


def _seconds(time: AnyArray) -> tuple[FloatArray, dict[str, str]]:
    """Return seconds (n,) after the first whole second, and their attributes."""
    known = time[~np.isnat(time)]
    clock = bool(len(known)) and has_wall_clock(known.min())
    start = known.min().astype("datetime64[s]") if clock else np.datetime64("1970-01-01", "s")
    attributes = {"standard_name": "time", "long_name": "time of the sample", "axis": "T", "calendar": "standard"}
    attributes |= {"units": f"seconds since {str(start).replace('T', ' ')} UTC", "units_metadata": "leap_seconds: none"}
    if not clock:
        attributes["comment"] = "the logs have relative times and no origin: the date is not real"
    return np.where(np.isnat(time), np.nan, (time - start) / np.timedelta64(1, "s")), attributes


def _attributes(column: Column) -> dict[str, Any]:
    """Return the attributes of a quantity. UDUNITS has no dB, so its definition is written instead."""
    shared: dict[str, Any] = {"long_name": column.meaning}
    if column.name.startswith(("measured_rank", "simulated_rank")):
        shared |= {"flag_values": _RANKS["flag_values"].astype(np.float64), "flag_meanings": _RANKS["flag_meanings"]}
    elif column.name != "measured_db":  # the unit of measured_db differs between links and has its own variable
        shared["units"] = {"dBm": DBM, "dB": DB, "": "1"}.get(column.unit, column.unit)
    return shared | {"coordinates": "time latitude longitude up_m", "grid_mapping": "crs"}
