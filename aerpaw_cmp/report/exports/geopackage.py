"""Points and lines as one OGC GeoPackage 1.3: an SQLite file with the tables that the standard names.

Layers ``towers``, ``track``, ``rss`` and ``rank`` in WGS 84 (EPSG:4326), longitude first, the third coordinate the
height above the ground at the site origin. Units and meanings stand in the schema extension.
"""

from __future__ import annotations

import errno
import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from ...common.units import AnyArray, FloatArray
from .geojson import plain
from .samples import Column, Export, SampleSet, iso_text, latitude_longitude, pieces

_APPLICATION_ID, _VERSION = 0x47504B47, 10300  # "GPKG", 1.3.0
_WGS84 = (
    'GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563,AUTHORITY["EPSG","7030"]],'
    'AUTHORITY["EPSG","6326"]],PRIMEM["Greenwich",0,AUTHORITY["EPSG","8901"]],UNIT["degree",0.0174532925199433,'
    'AUTHORITY["EPSG","9122"]],AXIS["Latitude",NORTH],AXIS["Longitude",EAST],AUTHORITY["EPSG","4326"]]'
)
_TABLES = """
CREATE TABLE gpkg_spatial_ref_sys (srs_name TEXT NOT NULL, srs_id INTEGER NOT NULL PRIMARY KEY,
  organization TEXT NOT NULL, organization_coordsys_id INTEGER NOT NULL, definition TEXT NOT NULL, description TEXT);
CREATE TABLE gpkg_contents (table_name TEXT NOT NULL PRIMARY KEY, data_type TEXT NOT NULL, identifier TEXT UNIQUE,
  description TEXT DEFAULT '', last_change DATETIME NOT NULL DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ','now')),
  min_x DOUBLE, min_y DOUBLE, max_x DOUBLE, max_y DOUBLE, srs_id INTEGER,
  CONSTRAINT fk_gc_r_srs_id FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys(srs_id));
CREATE TABLE gpkg_geometry_columns (table_name TEXT NOT NULL, column_name TEXT NOT NULL,
  geometry_type_name TEXT NOT NULL, srs_id INTEGER NOT NULL, z TINYINT NOT NULL, m TINYINT NOT NULL,
  CONSTRAINT pk_geom_cols PRIMARY KEY (table_name, column_name), CONSTRAINT uk_gc_table_name UNIQUE (table_name),
  CONSTRAINT fk_gc_tn FOREIGN KEY (table_name) REFERENCES gpkg_contents(table_name),
  CONSTRAINT fk_gc_srs FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys (srs_id));
CREATE TABLE gpkg_extensions (table_name TEXT, column_name TEXT, extension_name TEXT NOT NULL,
  definition TEXT NOT NULL, scope TEXT NOT NULL,
  CONSTRAINT ge_tce UNIQUE (table_name, column_name, extension_name));
CREATE TABLE gpkg_data_columns (table_name TEXT NOT NULL, column_name TEXT NOT NULL, name TEXT, title TEXT,
  description TEXT, mime_type TEXT, constraint_name TEXT,
  CONSTRAINT pk_gdc PRIMARY KEY (table_name, column_name), CONSTRAINT gdc_tn UNIQUE (table_name, name));
CREATE TABLE gpkg_data_column_constraints (constraint_name TEXT NOT NULL, constraint_type TEXT NOT NULL, value TEXT,
  min NUMERIC, min_is_inclusive BOOLEAN, max NUMERIC, max_is_inclusive BOOLEAN, description TEXT,
  CONSTRAINT gdcc_ntv UNIQUE (constraint_name, constraint_type, value));
"""
_SCHEMA = "http://www.geopackage.org/spec121/#extension_schema"


def write_geopackage(export: Export, folder: Path) -> list[Path]:
    """``samples.gpkg``; an OSError where the disk does not take it."""
    path = folder / "samples.gpkg"
    path.unlink(missing_ok=True)  # SQLite would add to it
    try:
        with closing(sqlite3.connect(path, isolation_level=None)) as book:
            # the folder becomes whole or does not appear: no journal is needed
            for line in ("journal_mode=OFF", "synchronous=OFF", f"application_id={_APPLICATION_ID}",
                         f"user_version={_VERSION}"):  # fmt: skip
                book.execute(f"PRAGMA {line}")
            book.execute("BEGIN")
            _fill(book, export)
            book.execute("COMMIT")
    except sqlite3.Error as error:
        full = "full" in str(error)
        raise OSError(errno.ENOSPC if full else errno.EIO, str(error), str(path)) from error
    return [path]


def _fill(book: sqlite3.Connection, export: Export) -> None:
    for statement in _TABLES.split(";\n"):
        if statement.strip():
            book.execute(statement)
    frames = [
        ("WGS 84", 4326, "EPSG", 4326, _WGS84, "longitude, latitude"),
        ("Undefined Cartesian", -1, "NONE", -1, "undefined", None),
        ("Undefined geographic", 0, "NONE", 0, "undefined", None),
    ]
    book.executemany("INSERT INTO gpkg_spatial_ref_sys VALUES (?,?,?,?,?,?)", frames)
    for table in ("gpkg_data_columns", "gpkg_data_column_constraints"):
        book.execute("INSERT INTO gpkg_extensions VALUES (?,NULL,'gpkg_schema',?,'read-write')", (table, _SCHEMA))
    named = [Column(name="name", unit="1", shown_unit="", meaning="name of the tower"), _UP]
    _layer(book, export, "towers", "POINT", named, _towers(export))
    flown = [Column(name="flight", unit="1", shown_unit="", meaning="name of the flight")]
    _layer(book, export, "track", "LINESTRING", flown, _tracks(export))
    for samples in export.sets:
        _layer(book, export, samples.kind, "POINT", [*_FIXED, _UP, *samples.columns], _samples(export, samples))


_UP = Column(name="up_m", unit="m", shown_unit="m", meaning="height above the ground at the site origin")
_FIXED = tuple(
    Column(name=name, unit="1", shown_unit="", meaning=meaning)
    for name, meaning in (
        ("time", "instant, UTC"),
        ("flight", "name of the flight"),
        ("tower", "name of the tower"),
        ("channel", "name of the channel"),
        ("unit", "unit of measured_db"),
    )
)
_TYPES = {"time": "DATETIME", "flight": "TEXT", "tower": "TEXT", "channel": "TEXT", "unit": "TEXT", "name": "TEXT"}

_Row = tuple[bytes | None, tuple[Any, ...]]


def _layer(
    book: sqlite3.Connection, export: Export, name: str, geometry: str, columns: Iterable[Column], rows: Iterable[_Row]
) -> None:
    """One table of features: geometry, then the columns in their order."""
    columns = list(columns)
    kinds = [f"{_quoted(c.name)} {_TYPES.get(c.name) or ('INTEGER' if c.flags else 'REAL')}" for c in columns]
    book.execute(
        f"CREATE TABLE {name} (fid INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, geom {geometry}, {', '.join(kinds)})"
    )
    book.execute(
        "INSERT INTO gpkg_contents (table_name, data_type, identifier, description, srs_id) VALUES (?,?,?,?,4326)",
        (name, "features", name, f"{export.title}. {' '.join(export.remarks)}"),
    )
    book.execute("INSERT INTO gpkg_geometry_columns VALUES (?,'geom',?,4326,1,0)", (name, geometry))
    for one in columns:
        title = f"{one.name} [{one.shown_unit}]" if one.shown_unit else one.name
        codes = "; codes: " + ", ".join(f"{i} {flag}" for i, flag in enumerate(one.flags)) if one.flags else ""
        book.execute(
            "INSERT INTO gpkg_data_columns VALUES (?,?,?,?,?,NULL,NULL)",
            (name, one.name, one.name, title, one.meaning + codes),
        )
    marks = ",".join("?" * (len(columns) + 1))
    names = ",".join(["geom", *(_quoted(c.name) for c in columns)])
    book.executemany(f"INSERT INTO {name} ({names}) VALUES ({marks})", ((shape, *row) for shape, row in rows))
    _extent(book, export, name)


def _quoted(name: str) -> str:
    return '"' + name.replace('"', '""') + '"'


def _extent(book: sqlite3.Connection, export: Export, name: str) -> None:
    """The box of a layer, which programs zoom to."""
    if name == "towers":
        places = [(t.east_m, t.north_m) for t in export.site.towers.values()]
        east, north = np.array(places, dtype=np.float64).reshape(-1, 2).T
    else:
        samples = export.set(name)
        parts: Any = export.lines if samples is None else samples.series
        east = np.concatenate([np.zeros(0), *(p.east_m for p in parts)])
        north = np.concatenate([np.zeros(0), *(p.north_m for p in parts)])
    latitude, longitude = latitude_longitude(export.site.frame, east, north)
    known = np.isfinite(latitude)
    if known.any():
        box = [longitude[known].min(), latitude[known].min(), longitude[known].max(), latitude[known].max()]
        book.execute(
            "UPDATE gpkg_contents SET min_x=?, min_y=?, max_x=?, max_y=? WHERE table_name=?", (*map(float, box), name)
        )


# --- geometries -----------------------------------------------------------------------------------------------------

_HEAD = b"GP\x00\x01" + np.array([4326], dtype="<i4").tobytes()  # version 1, little endian, no envelope


def points(longitude: FloatArray, latitude: FloatArray, up_m: FloatArray) -> list[bytes | None]:
    """Points with height as GeoPackage's binary form; None where a position is unknown."""
    known = np.isfinite(longitude) & np.isfinite(latitude)
    raw = b"".join(_HEAD + shape for shape in wkb_points(longitude[known], latitude[known], up_m[known]))
    size = len(_HEAD) + 29
    shapes = iter(range(0, len(raw), size))
    return [raw[(at := next(shapes)) : at + size] if one else None for one in known.tolist()]


def wkb_points(longitude: FloatArray, latitude: FloatArray, up_m: FloatArray) -> list[bytes]:
    """Points with height as ISO well-known binary; an unknown height is 0."""
    table = np.zeros(len(longitude), dtype=[("order", "u1"), ("kind", "<u4"), ("at", "<f8", 3)])
    table["order"], table["kind"] = 1, 1001  # little endian, POINT Z
    table["at"] = np.column_stack([longitude, latitude, np.nan_to_num(up_m)])
    raw = table.tobytes()
    return [raw[start : start + 29] for start in range(0, len(raw), 29)]


def _line(longitude: FloatArray, latitude: FloatArray, up_m: FloatArray) -> bytes:
    head = b"\x01" + np.array([1002, len(longitude)], dtype="<u4").tobytes()  # LINESTRING Z
    at: AnyArray = np.column_stack([longitude, latitude, np.nan_to_num(up_m)]).astype("<f8")
    return _HEAD + head + at.tobytes()


def _towers(export: Export) -> Iterator[_Row]:
    for tower in export.site.towers.values():
        up = np.array([tower.position_m[2]])
        latitude, longitude = latitude_longitude(export.site.frame, np.array([tower.east_m]), np.array([tower.north_m]))
        yield points(longitude, latitude, up)[0], (tower.name, float(up[0]))


def _tracks(export: Export) -> Iterator[_Row]:
    for line in export.lines:
        known = np.isfinite(line.east_m) & np.isfinite(line.north_m)
        if known.sum() > 1:
            latitude, longitude = latitude_longitude(export.site.frame, line.east_m[known], line.north_m[known])
            yield _line(longitude, latitude, line.up_m[known]), (line.flight,)


def _samples(export: Export, samples: SampleSet) -> Iterator[_Row]:
    for series in samples.series:
        fixed = (series.flight, series.tower, series.channel, series.unit)
        for part in pieces(series):
            latitude, longitude = latitude_longitude(export.site.frame, series.east_m[part], series.north_m[part])
            shapes = points(longitude, latitude, series.up_m[part])
            missing = [None] * len(shapes)
            columns = [
                plain(series.values[c.name][part], whole=bool(c.flags)) if c.name in series.values else missing
                for c in samples.columns
            ]
            rows = zip(iso_text(series.time[part]), plain(series.up_m[part]), *columns, strict=True)
            for shape, (time, up, *values) in zip(shapes, rows, strict=True):
                yield shape, (time or None, *fixed, up, *values)
