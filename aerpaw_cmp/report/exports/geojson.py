"""Samples as points for maps: GeoJSON (RFC 7946), in WGS84."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from .points import LABELS, UP, Column, Export

_FIXED = (
    Column(name="time", meaning="instant, UTC"),
    *(Column(name=name, meaning=meaning) for name, meaning in LABELS.items()),
    UP,
)
"""Columns of a row of points before its values."""

CRS84 = "urn:ogc:def:crs:OGC:1.3:CRS84"
"""WGS84, longitude first: what RFC 7946 prescribes; named for programs that ask."""


def write_geojson(export: Export, folder: Path) -> list[Path]:
    """``towers.geojson`` and ``<kind>.geojson``, written feature by feature."""
    towers = ((longitude, latitude, {"name": name, "up_m": round(up, 4)})
              for name, latitude, longitude, up in export.towers())  # fmt: skip
    written = [_collection(folder / "towers.geojson", export, {}, towers)]
    for points in export.sets:
        names = [c.name for c in (*_FIXED, *points.columns)]
        places = (points.table[name].to_numpy() for name in ("longitude_deg", "latitude_deg"))
        features = (
            (longitude, latitude, dict(zip(names, row, strict=True)))
            for longitude, latitude, row in zip(*places, points.rows(), strict=True)
        )
        columns = {
            c.name: {"unit": c.shown_unit, "meaning": c.meaning, **({"codes": list(c.flags)} if c.flags else {})}
            for c in points.columns
        }
        written.append(_collection(folder / f"{points.kind}.geojson", export, {"columns": columns}, features))
    return written


def _collection(path: Path, export: Export, more: dict[str, Any], features: Iterable[tuple[Any, Any, Any]]) -> Path:
    """Features of longitude, latitude and properties, one a line."""
    head = {
        "type": "FeatureCollection",
        "name": path.stem,
        "crs": {"type": "name", "properties": {"name": CRS84}},
        "title": export.title,
        "remarks": list(export.remarks),
        **export.attributes,
        **more,
    }
    with path.open("w", encoding="utf-8", newline="\n") as stream:
        stream.write(json.dumps(head, allow_nan=False, ensure_ascii=False)[:-1] + ', "features": [')
        for number, (longitude, latitude, properties) in enumerate(features):
            point = {"type": "Point", "coordinates": [longitude, latitude]} if np.isfinite(longitude) else None
            feature = {"type": "Feature", "geometry": point, "properties": properties}
            stream.write(
                (",\n" if number else "\n")
                + json.dumps(feature, allow_nan=False, separators=(",", ":"), ensure_ascii=False)
            )
        stream.write("\n]}\n")
    return path
