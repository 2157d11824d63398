"""Points as GeoJSON (RFC 7946): one feature per sample, longitude before latitude, WGS84."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from .samples import Export, SampleSet, Series, iso_text, latitude_longitude, pieces

CRS84 = "urn:ogc:def:crs:OGC:1.3:CRS84"
"""WGS84, longitude first: what RFC 7946 prescribes; named for programs that ask."""


def write_geojson(export: Export, folder: Path) -> list[Path]:
    """``towers.geojson``, ``rss.geojson`` and ``rank.geojson``, written feature by feature."""
    written = [_collection(folder / "towers.geojson", "towers", export, _towers(export))]
    for samples in export.sets:
        features = _samples(export, samples)
        written.append(_collection(folder / f"{samples.kind}.geojson", samples.kind, export, features))
    return written


def _collection(path: Path, name: str, export: Export, features: Iterator[str]) -> Path:
    head: dict[str, Any] = {
        "type": "FeatureCollection",
        "name": name,
        "crs": {"type": "name", "properties": {"name": CRS84}},
        "title": export.title,
        "remarks": list(export.remarks),
        **export.attributes,
    }
    samples = export.set(name)
    if samples is not None:
        head["columns"] = {
            c.name: {"unit": c.shown_unit, "meaning": c.meaning, **({"codes": list(c.flags)} if c.flags else {})}
            for c in samples.columns
        }
    with path.open("w", encoding="utf-8", newline="\n") as stream:
        stream.write(json.dumps(head, allow_nan=False, ensure_ascii=False)[:-1] + ', "features": [\n')
        _joined(stream, features)
        stream.write("\n]}\n")
    return path


def _joined(stream: TextIO, features: Iterator[str]) -> None:
    mark = ""
    for feature in features:
        stream.write(mark + feature)
        mark = ",\n"


def _feature(longitude: float | None, latitude: float | None, properties: dict[str, Any]) -> str:
    point = None if longitude is None else {"type": "Point", "coordinates": [longitude, latitude]}
    whole = {"type": "Feature", "geometry": point, "properties": properties}
    return json.dumps(whole, allow_nan=False, separators=(",", ":"), ensure_ascii=False)


def _towers(export: Export) -> Iterator[str]:
    for tower in export.site.towers.values():
        latitude, longitude = latitude_longitude(export.site.frame, np.array([tower.east_m]), np.array([tower.north_m]))
        properties = {"name": tower.name, "up_m": round(float(tower.position_m[2]), 4)}
        yield _feature(float(longitude[0]), float(latitude[0]), properties)


def _samples(export: Export, samples: SampleSet) -> Iterator[str]:
    whole_numbers = {column.name for column in samples.columns if column.flags}
    for series in samples.series:
        for part in pieces(series):
            yield from _rows(export, series, part, whole_numbers)


def _rows(export: Export, series: Series, part: slice, whole_numbers: set[str]) -> Iterator[str]:
    latitude, longitude = latitude_longitude(export.site.frame, series.east_m[part], series.north_m[part])
    columns = {"up_m": plain(series.up_m[part])}
    for name, values in series.values.items():
        columns[name] = plain(values[part], whole=name in whole_numbers)
    names = list(columns)
    fixed = {"flight": series.flight, "tower": series.tower, "channel": series.channel, "unit": series.unit}
    rows = zip(
        plain(longitude), plain(latitude), iso_text(series.time[part]), zip(*columns.values(), strict=True), strict=True
    )
    for east, north, time, row in rows:
        yield _feature(east, north, {"time": time or None, **fixed, **dict(zip(names, row, strict=True))})


def plain(values: Any, *, whole: bool = False) -> list[Any]:
    """Numbers (n,) as Python's own; None where missing."""
    boxed = np.asarray(values, dtype=np.float64).astype(object)
    known = np.isfinite(np.asarray(values, dtype=np.float64))
    if whole:
        boxed[known] = np.asarray(values, dtype=np.float64)[known].astype(np.int64).astype(object)
    boxed[~known] = None
    listed: list[Any] = boxed.tolist()
    return listed
