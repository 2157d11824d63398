"""Samples as Parquet: one file per kind, units in the metadata of the columns, places as GeoParquet 1.1."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from .geopackage import wkb_points
from .samples import Export, SampleSet, Series, latitude_longitude

ROWS = 100_000
"""Rows of one group: what is held at once."""

_TEXTS = {"flight": "name of the flight", "tower": "name of the tower", "channel": "name of the channel",
          "unit": "unit of measured_db"}  # fmt: skip
_PLACES = {
    "latitude_deg": ("degrees_north", "WGS84 latitude"),
    "longitude_deg": ("degrees_east", "WGS84 longitude"),
    "east_m": ("m", "east of the site origin"),
    "north_m": ("m", "north of the site origin"),
    "up_m": ("m", "height above the ground at the site origin"),
}


def write_parquet(export: Export, folder: Path) -> list[Path]:
    """``rss.parquet`` and ``rank.parquet``."""
    return [_write(export, samples, folder / f"{samples.kind}.parquet") for samples in export.sets]


def _write(export: Export, samples: SampleSet, path: Path) -> Path:
    import pyarrow as pa
    from pyarrow import parquet

    schema = _schema(pa, export, samples)
    # a stream of Python's own: the disk's errors come as OSError
    with path.open("wb") as stream, parquet.ParquetWriter(stream, schema, compression="zstd") as writer:
        for series in samples.series:
            for start in range(0, len(series), ROWS):
                part = slice(start, min(start + ROWS, len(series)))
                writer.write_table(pa.table(_columns(pa, export, samples, series, part), schema=schema))
    return path


def _schema(pa: Any, export: Export, samples: SampleSet) -> Any:
    def metadata_of(unit: str, meaning: str, flags: tuple[str, ...] = ()) -> dict[str, str]:
        codes = {"codes": json.dumps(dict(enumerate(flags)))} if flags else {}
        return {"unit": unit, "description": meaning, **codes}

    text = pa.dictionary(pa.int32(), pa.string())
    when = "instant, UTC" if export.clock else "instant after 1970-01-01: the logs have no origin of time"
    fields = [pa.field("time", pa.timestamp("ns", tz="UTC"), metadata=metadata_of("", when))]
    fields += [pa.field(name, text, metadata=metadata_of("", meaning)) for name, meaning in _TEXTS.items()]
    fields += [pa.field(name, pa.float64(), metadata=metadata_of(*said)) for name, said in _PLACES.items()]
    fields += [
        pa.field(c.name, pa.int8() if c.flags else pa.float64(), metadata=metadata_of(c.shown_unit, c.meaning, c.flags))
        for c in samples.columns
    ]
    fields.append(
        pa.field("geometry", pa.binary(), metadata=metadata_of("", "longitude, latitude [deg], up_m [m] as WKB"))
    )
    about = {"title": export.title, "name": export.name, "remarks": " ".join(export.remarks), **export.attributes}
    geo = {
        "version": "1.1.0",
        "primary_column": "geometry",
        "columns": {"geometry": {"encoding": "WKB", "geometry_types": ["Point Z"]}},
    }
    return pa.schema(fields, metadata={**about, "geo": json.dumps(geo)})


def _columns(pa: Any, export: Export, samples: SampleSet, series: Series, part: slice) -> dict[str, Any]:
    """Arrow arrays of one piece of a series; NaN becomes null."""
    rows = part.stop - part.start
    latitude, longitude = latitude_longitude(export.site.frame, series.east_m[part], series.north_m[part])
    up = series.up_m[part]
    # longitude and latitude default to WGS84 where GeoParquet names no CRS
    columns: dict[str, Any] = {"time": pa.array(series.time[part], pa.timestamp("ns", tz="UTC"))}
    for name, value in zip(_TEXTS, (series.flight, series.tower, series.channel, series.unit), strict=True):
        columns[name] = pa.DictionaryArray.from_arrays(np.zeros(rows, dtype=np.int32), [value])
    places = (latitude, longitude, series.east_m[part], series.north_m[part], up)
    columns |= {name: _numbers(pa, values) for name, values in zip(_PLACES, places, strict=True)}
    missing = np.full(rows, np.nan)
    for one in samples.columns:
        values = series.values[one.name][part] if one.name in series.values else missing
        columns[one.name] = _codes(pa, values) if one.flags else _numbers(pa, values)
    known = np.isfinite(longitude)
    shapes = iter(wkb_points(longitude[known], latitude[known], up[known]))
    columns["geometry"] = pa.array([next(shapes) if one else None for one in known.tolist()], pa.binary())
    return columns


def _numbers(pa: Any, values: Any) -> Any:
    return pa.array(values, pa.float64(), from_pandas=True)


def _codes(pa: Any, values: Any) -> Any:
    known = np.isfinite(values)
    return pa.array(np.where(known, values, 0).astype(np.int8), pa.int8(), mask=~known)
