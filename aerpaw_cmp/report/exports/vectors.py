"""Samples as points and lines for maps: GeoJSON (RFC 7946) and OGC GeoPackage 1.3, both in WGS84."""

from __future__ import annotations

import errno
import itertools
import json
import sqlite3
from collections.abc import Iterable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np

from .points import LABELS, UP, Column, Export, Line, latitude_longitude
from .scales import Scale, scales_of

_FIXED = (
    Column(name="time", meaning="instant, UTC"),
    *(Column(name=name, meaning=meaning) for name, meaning in LABELS.items()),
    UP,
)
"""Columns of a row of points before its values."""

# --- GeoJSON --------------------------------------------------------------------------------------------------------

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


# --- GeoPackage -----------------------------------------------------------------------------------------------------

_WGS84 = (
    'GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563,AUTHORITY["EPSG","7030"]],'
    'AUTHORITY["EPSG","6326"]],PRIMEM["Greenwich",0,AUTHORITY["EPSG","8901"]],UNIT["degree",0.0174532925199433,'
    'AUTHORITY["EPSG","9122"]],AXIS["Latitude",NORTH],AXIS["Longitude",EAST],AUTHORITY["EPSG","4326"]]'
)
_TABLES = """
PRAGMA application_id=0x47504B47;
PRAGMA user_version=10300;
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
CREATE TABLE layer_styles (id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, f_table_catalog TEXT, f_table_schema TEXT,
  f_table_name TEXT, f_geometry_column TEXT, styleName TEXT, styleQML TEXT, styleSLD TEXT, useAsDefault BOOLEAN,
  description TEXT, owner TEXT, ui TEXT, update_time DATETIME DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ','now')));
INSERT INTO gpkg_extensions VALUES ('gpkg_data_columns',NULL,'gpkg_schema',
  'http://www.geopackage.org/spec121/#extension_schema','read-write');
INSERT INTO gpkg_extensions VALUES ('gpkg_data_column_constraints',NULL,'gpkg_schema',
  'http://www.geopackage.org/spec121/#extension_schema','read-write');
"""
_TYPES = {"time": "DATETIME", "name": "TEXT", **dict.fromkeys(LABELS, "TEXT")}
_HEAD = b"GP\x00\x01" + np.array([4326], dtype="<i4").tobytes()
"""Before a geometry: version 1, little endian, no envelope, its reference system."""


def write_geopackage(export: Export, folder: Path) -> list[Path]:
    """``samples.gpkg``: layers ``towers``, ``track`` and one per kind, with units and styles for QGIS.

    Longitude comes first, the third coordinate is the height above the ground at the site origin. Units and meanings
    stand in the schema extension.

    Raises
    ------
    OSError
        If the disk does not take it.
    """
    path = folder / "samples.gpkg"
    path.unlink(missing_ok=True)  # SQLite would add to it
    try:
        with closing(sqlite3.connect(path, isolation_level=None)) as book:
            # the folder becomes whole or does not appear: no journal is needed
            book.execute("PRAGMA journal_mode=OFF")
            book.execute("PRAGMA synchronous=OFF")
            book.execute("BEGIN")
            _fill(book, export)
            book.execute("COMMIT")
    except sqlite3.Error as error:
        full = "full" in str(error)
        raise OSError(errno.ENOSPC if full else errno.EIO, str(error), str(path)) from error
    return [path]


def _fill(book: sqlite3.Connection, export: Export) -> None:
    import pandas as pd

    for statement in _TABLES.split(";\n"):
        book.execute(statement)
    frames = [
        ("WGS 84", 4326, "EPSG", 4326, _WGS84, "longitude, latitude"),
        ("Undefined Cartesian", -1, "NONE", -1, "undefined", None),
        ("Undefined geographic", 0, "NONE", 0, "undefined", None),
    ]
    book.executemany("INSERT INTO gpkg_spatial_ref_sys VALUES (?,?,?,?,?,?)", frames)
    towers = pd.DataFrame(export.towers(), columns=["name", "latitude_deg", "longitude_deg", "up_m"])
    named = [Column(name="name", meaning="name of the tower"), UP]
    rows = zip(_shapes(towers), towers["name"], towers["up_m"], strict=True)
    _layer(book, export, "towers", "POINT", named, rows)
    _extent(book, "towers", towers)
    flown = [Column(name="flight", meaning="name of the flight")]
    tracks = [_track(export, line) for line in export.lines if line.known.sum() > 1]
    _layer(book, export, "track", "LINESTRING", flown, ((shape, flight) for shape, flight, _ in tracks))
    if tracks:
        _extent(book, "track", pd.concat([places for *_, places in tracks]))
    scales = scales_of(export)
    for points in export.sets:
        samples = ((shape, *row) for shape, row in zip(_shapes(points.table), points.rows(), strict=True))
        _layer(book, export, points.kind, "POINT", [*_FIXED, *points.columns], samples)
        _extent(book, points.kind, points.table)
        for name, scale in scales[points.kind].items():
            _style(book, points.kind, name, scale)


def _layer(
    book: sqlite3.Connection, export: Export, name: str, geometry: str, columns: Sequence[Column],
    rows: Iterable[Sequence[Any]],
) -> None:  # fmt: skip
    """One table of features: geometry, then the columns in their order."""
    quoted = ['"' + c.name.replace('"', '""') + '"' for c in columns]
    kinds = [_TYPES.get(c.name) or ("INTEGER" if c.flags else "REAL") for c in columns]
    definitions = ", ".join(map(" ".join, zip(quoted, kinds, strict=True)))
    book.execute(
        f"CREATE TABLE {name} (fid INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, geom {geometry}, {definitions})"
    )
    book.execute(
        "INSERT INTO gpkg_contents (table_name, data_type, identifier, description, srs_id) VALUES (?,?,?,?,4326)",
        (name, "features", name, f"{export.title}. {' '.join(export.remarks)}"),
    )
    book.execute("INSERT INTO gpkg_geometry_columns VALUES (?,'geom',?,4326,1,0)", (name, geometry))
    for c in columns:
        title = f"{c.name} [{c.shown_unit}]" if c.shown_unit else c.name
        codes = "; codes: " + ", ".join(f"{i} {flag}" for i, flag in enumerate(c.flags)) if c.flags else ""
        about = (name, c.name, c.name, title, c.meaning + codes)
        book.execute("INSERT INTO gpkg_data_columns VALUES (?,?,?,?,?,NULL,NULL)", about)
    marks = ",".join("?" * (len(columns) + 1))
    book.executemany(f"INSERT INTO {name} (geom,{','.join(quoted)}) VALUES ({marks})", rows)


def _extent(book: sqlite3.Connection, name: str, places: Any) -> None:
    """The box of a layer, which programs zoom to."""
    known = places[["longitude_deg", "latitude_deg"]].dropna()
    if len(known):
        box = (*map(float, known.min()), *map(float, known.max()), name)
        book.execute("UPDATE gpkg_contents SET min_x=?, min_y=?, max_x=?, max_y=? WHERE table_name=?", box)


def _shapes(rows: Any) -> list[bytes | None]:
    """Places as geometries, None where unknown; an unknown height is 0."""
    import shapely

    places = rows[["longitude_deg", "latitude_deg"]].to_numpy()
    at = shapely.points(np.column_stack([places, np.nan_to_num(rows["up_m"].to_numpy())]))
    known = np.isfinite(places).all(axis=1)
    shapes = shapely.to_wkb(np.where(known, at, None), byte_order=1, flavor="iso")
    return [None if shape is None else _HEAD + shape for shape in shapes]


def _track(export: Export, line: Line) -> tuple[bytes, str, Any]:
    """The flown line as a geometry, its flight, and its places."""
    import pandas as pd
    import shapely

    latitude, longitude = latitude_longitude(export.site.frame, line.east_m[line.known], line.north_m[line.known])
    at = shapely.LineString(np.column_stack([longitude, latitude, np.nan_to_num(line.up_m[line.known])]))
    shape = _HEAD + shapely.to_wkb(at, byte_order=1, flavor="iso")
    return shape, line.flight, pd.DataFrame({"longitude_deg": longitude, "latitude_deg": latitude})


def _style(book: sqlite3.Connection, layer: str, name: str, scale: Scale) -> None:
    """A style of QGIS that colours the points by one column; the first style of a layer is its default."""
    if scale.edges is None:
        kind, tag = "categorizedSymbol", "category"
        rules = [f'value="{i}"' for i in range(1, len(scale.colours))]
    else:
        kind, tag = "graduatedSymbol", "range"
        edges = [-1e9, *scale.edges[1:-1].tolist(), 1e9]
        rules = [f'lower="{low}" upper="{high}"' for low, high in itertools.pairwise(edges)]
    entries = "".join(
        f'<{tag} {rule} symbol="{i}" label={quoteattr(label)} render="true"/>'
        for i, (rule, label) in enumerate(zip(rules, scale.labels, strict=False))
    )
    symbols = "".join(
        f'<symbol type="marker" name="{i}"><layer class="SimpleMarker"><prop k="name" v="circle"/>'
        f'<prop k="color" v="{",".join(str(int(c[at : at + 2], 16)) for at in (1, 3, 5))},255"/>'
        '<prop k="outline_style" v="no"/><prop k="size" v="1.8"/></layer></symbol>'
        for i, c in enumerate(scale.colours[: len(rules)])
    )
    groups = {"category": "categories", "range": "ranges"}[tag]
    qml = (
        '<!DOCTYPE qgis PUBLIC "http://mrcc.com/qgis.dtd" "SYSTEM">\n<qgis version="3.16" styleCategories="Symbology">'
        f'<renderer-v2 type="{kind}" attr={quoteattr(name)}><{groups}>{entries}</{groups}><symbols>{symbols}</symbols>'
        "</renderer-v2></qgis>"
    )
    default = not book.execute("SELECT count(*) FROM layer_styles WHERE f_table_name=?", (layer,)).fetchone()[0]
    book.execute(
        "INSERT INTO layer_styles (f_table_catalog, f_table_schema, f_table_name, f_geometry_column, styleName,"
        " styleQML, useAsDefault, description) VALUES ('','',?,'geom',?,?,?,?)",
        (layer, name, qml, default, scale.title),
    )
