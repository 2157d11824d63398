"""Samples as points for maps: GeoJSON (RFC 7946), in WGS84."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ..names import iso_time
from .points import LABELS, UP, Export, Points

# WGS84, longitude first: what RFC 7946 prescribes; named for programs that ask.
CRS84 = "urn:ogc:def:crs:OGC:1.3:CRS84"

# Samples that are text at once.
ROWS = 20_000


def write_geojson(export: Export, folder: Path) -> list[Path]:
    """``towers.geojson`` and ``<kind>.geojson``, written piece by piece."""
    import pandas as pd

    towers = pd.DataFrame(export.towers(), columns=["name", "latitude_deg", "longitude_deg", "up_m"])
    written = [_collection(folder / "towers.geojson", export, {}, _features(towers, ["name", "up_m"]))]
    for points in export.sets:
        columns = {
            c.name: {"unit": c.shown_unit, "meaning": c.meaning, **({"codes": list(c.flags)} if c.flags else {})}
            for c in points.columns
        }
        written.append(_collection(folder / f"{points.kind}.geojson", export, {"columns": columns}, _samples(points)))
    return written


def _samples(points: Points) -> Iterator[str]:
    names = ["time", *LABELS, UP.name, *(c.name for c in points.columns)]
    codes = {c.name: "Int64" for c in points.columns if c.flags}
    for start in range(0, len(points), ROWS):
        part = points.table.iloc[start : start + ROWS]
        instants = iso_time(part["time"].to_numpy()).astype(object)
        yield from _features(part.assign(time=np.where(instants == "", None, instants)).astype(codes), names)


def _features(table: Any, names: list[str]) -> Iterator[str]:
    """Rows of a table as features; one without a position has no geometry, a missing number is null."""
    properties = table[names].to_json(orient="records", lines=True, double_precision=4, force_ascii=False)
    places = table[["longitude_deg", "latitude_deg"]].to_numpy().tolist()
    for (longitude, latitude), text in zip(places, properties.rstrip("\n").split("\n"), strict=False):
        point = f'{{"type":"Point","coordinates":[{longitude},{latitude}]}}' if longitude == longitude else "null"
        yield f'{{"type":"Feature","geometry":{point},"properties":{text}}}'


def _collection(path: Path, export: Export, more: dict[str, Any], features: Iterator[str]) -> Path:
    """Features, one a line."""
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
        for number, feature in enumerate(features):
            stream.write((",\n" if number else "\n") + feature)
        stream.write("\n]}\n")
    return path
