"""Outlines from map files, as they are: GeoJSON, OSM XML, Overpass JSON, KML, KMZ. Cleaning is :mod:`.footprints`' job.

An element that cannot be used is left out and listed, with its line; only a file that is no map file is an error.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Callable, Iterator
from functools import cache
from math import isfinite
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.parsers import expat

from ...common import kml
from ...common.errors import InputError, parsed
from ...common.files import read_input
from ...common.xmlfiles import named, outermost, plain, xml_root
from ...logs.files import archives
from .osmfiles import read_elements
from .outlines import BROKEN_ELEMENT, OSM_CREDIT, MapFile, Outline, Position, TreeLine, left_out, lonlat

# A map of a whole county is smaller; a site needs a few kilometres.
MAX_BYTES = 256 * 1024 * 1024

# Tags of an XML map file, begin and end: each becomes an object in memory.
MAX_TAGS = 1_500_000

FORMATS = "GeoJSON, OSM XML, Overpass JSON, KML or KMZ"

# How GeoJSON and KML made of OpenStreetMap give themselves away: its name, its ids, its tags of ids.
_OF_OSM = re.compile(rb'openstreetmap|"osm_(way_)?id"|"(way|relation|node)/[0-9]+"', re.IGNORECASE)

_OTHER_KINDS: tuple[tuple[bytes, str, str], ...] = (
    (b"\x1f\x8b", "gzip-compressed data", "unpack it with gunzip"),
    (b"BZh", "bzip2-compressed data", "unpack it with bunzip2"),
    (b"\xff\xfe", "UTF-16 text", "save it as UTF-8"),
    (b"\xfe\xff", "UTF-16 text", "save it as UTF-8"),
    (b"\x00\x00\x27\x0a", "a shapefile", "ogr2ogr -f GeoJSON -t_srs EPSG:4326 makes GeoJSON of it"),
    (b"SQLite format 3", "a GeoPackage or another SQLite file", "ogr2ogr -f GeoJSON -t_srs EPSG:4326 makes GeoJSON"),
)


@parsed(FORMATS)
def read_map_file(path: str | Path) -> MapFile:
    """Outlines of a map file; its kind is told by content.

    Raises
    ------
    InputError
        No such file, none of the formats, or not WGS84.
    """
    path = Path(path)
    data = read_input(path, MAX_BYTES, "a map file")
    # by content: browsers save a KMZ as .zip or .kml
    if data.startswith(b"PK\x03\x04"):
        data = _unzipped(data, path)
    # a byte-order mark and blank lines may stand before the first sign
    start = data[:4096].lstrip(b"\xef\xbb\xbf \t\r\n")
    if not data.strip():
        raise InputError("the file is empty", expected=FORMATS, path=path)
    if start.startswith(b"version https://git-lfs"):
        raise InputError("a Git-LFS pointer in place of the data", cause="'git lfs pull' was not run", path=path)
    if start[:1] in (b"{", b"[", b"<"):
        content = _from_xml(data, path) if start[:1] == b"<" else _from_json(data, path)
        if _OF_OSM.search(data):
            content.credit = OSM_CREDIT
        return content
    for magic, what, remedy in _OTHER_KINDS:
        if data.startswith(magic):
            raise InputError(f"{what}, not a map file of text", expected=FORMATS, cause=remedy, path=path)
    if b"OSMHeader" in data[:64]:
        raise InputError(
            "OSM data in PBF", expected=FORMATS, cause="'osmium cat in.pbf -o out.osm' unpacks it", path=path
        )
    raise InputError("not a map file", expected=FORMATS, path=path)


def _unzipped(data: bytes, path: Path) -> bytes:
    """The main KML file of a KMZ archive."""
    try:
        members = archives.members(data, path)
    except InputError as error:
        raise InputError(f"not a KMZ archive ({error.found})", cause="the file was cut off", path=path) from None
    maps = {name.lower(): member for name, member in members.items() if name.lower().endswith(".kml")}
    if not maps:
        raise InputError("an archive without a .kml file", expected="KMZ", path=path)
    # what Google Earth opens: doc.kml, else the first
    main = maps.get("doc.kml") or next(iter(maps.values()))
    if main.size > MAX_BYTES:
        raise InputError(f"{main.name} has {main.size} bytes", expected=f"at most {MAX_BYTES}", path=path)
    return main.read(MAX_BYTES)


def _from_json(data: bytes, path: Path) -> MapFile:
    try:
        text = data.decode("utf-8-sig")
        content = json.loads(text)
    except json.JSONDecodeError as error:
        # an error at the very end is a text that ends too early
        cause = "the file was cut off" if error.pos >= len(text.rstrip()) - 1 else None
        raise InputError(f"not JSON: {error.msg}", cause=cause, path=path, line=error.lineno) from None
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise InputError(
            "not JSON text: a byte that is not UTF-8", cause="save it as UTF-8", path=path, line=line
        ) from None
    if isinstance(content, dict) and isinstance(content.get("elements"), list):
        result = read_elements("Overpass JSON", content["elements"], path, _lines_of(text, "elements"))
        # Overpass answers with status 200 and a remark when it ran out of time
        if remark := content.get("remark"):
            result.notes.append(f"warning: {path.name}: the Overpass server says: {str(remark)[:200]}")
        return result
    if isinstance(content, dict) and "type" in content:
        return _geojson(content, path, _lines_of(text, "features"))
    raise InputError("JSON, but neither GeoJSON nor Overpass", expected="a 'type' or 'elements' member", path=path)


def _lines_of(text: str, member: str) -> Callable[[int], int | None]:
    """Line of the n-th element of a list in a JSON text; the text is read again, once, when the first is asked for."""
    decoder, gap = json.JSONDecoder(), re.compile(r"[\s,]*")

    @cache
    def lines() -> list[int]:
        start = re.search(rf'"{member}"\s*:\s*\[', text)
        numbers: list[int] = []
        at, counted, number = (start.end() if start else len(text)), 0, 1
        while True:
            at = gap.match(text, at).end()  # type: ignore[union-attr]
            number += text.count("\n", counted, at)
            counted = at
            try:
                _, at = decoder.raw_decode(text, at)
            except (json.JSONDecodeError, RecursionError):
                return numbers
            numbers.append(number)

    return lambda index: lines()[index] if index < len(lines()) else None


# ---------------------------------------------------------------- GeoJSON (RFC 7946)

_GEOMETRIES = (
    "Point", "MultiPoint", "LineString", "MultiLineString", "Polygon", "MultiPolygon", "GeometryCollection",
)  # fmt: skip


def _geojson(content: dict[str, Any], path: Path, line_of: Callable[[int], int | None]) -> MapFile:
    _check_crs(content.get("crs"), path)
    result, lines = MapFile("GeoJSON"), Counter[str]()
    kind = content["type"]
    if kind not in (*_GEOMETRIES, "Feature", "FeatureCollection"):
        raise InputError(f"JSON of type '{kind}'", expected="GeoJSON: a FeatureCollection of areas", path=path)
    features = content.get("features") if kind == "FeatureCollection" else [content]
    if not isinstance(features, list):
        raise InputError("a FeatureCollection without a list of features", expected="'features': [...]", path=path)
    for number, feature in enumerate(features, start=1):
        part = MapFile("GeoJSON")
        try:
            _feature(feature, number, part, lines, path)
        except BROKEN_ELEMENT as error:
            result.notes.append(left_out(path, line_of(number - 1), f"feature {number}", error))
        else:
            result.take(part)
    result.note_no_areas(path.name, lines)
    return result


def _check_crs(crs: Any, path: Path) -> None:
    """GeoJSON of before RFC 7946 may name a coordinate system; only WGS84 can be used."""
    named = crs.get("properties") if isinstance(crs, dict) else crs
    name = str(named.get("name", "CRS84") if isinstance(named, dict) else named or "CRS84")
    # 4979 is WGS84 with heights
    if not any(code in name for code in ("CRS84", "4326", "4979")):
        raise InputError(
            f"coordinates in {name}",
            expected="WGS84 longitude and latitude (RFC 7946)",
            cause="exported in projected coordinates; ogr2ogr -t_srs EPSG:4326 converts them",
            path=path,
        )


def _feature(feature: Any, number: int, result: MapFile, lines: Counter[str], path: Path) -> None:
    is_feature = feature.get("type") == "Feature"
    properties = (feature.get("properties") or {}) if is_feature else {}
    tags = _words(properties)
    # some exporters, osmtogeojson among them, keep OSM's tags in an object of their own
    if isinstance(nested := properties.get("tags"), dict):
        tags.update(_words(nested))
    identity = str(feature.get("id", tags.get("@id", number)))
    identity = f"feature {identity}" if identity.isdigit() else identity
    outline = Outline(tags.get("name") or f"{identity}", f"{path.name}: {identity}", tags)
    geometry = feature.get("geometry") if is_feature else feature
    if geometry is None:
        lines["without geometry"] += 1
        return
    _geometry(geometry, outline, result, lines, path)
    if outline.parts or outline.broken:
        result.outlines.append(outline)


def _words(properties: dict[str, Any]) -> dict[str, str]:
    return {str(key): str(value) for key, value in properties.items() if value is not None}


def _geometry(geometry: dict[str, Any], outline: Outline, result: MapFile, lines: Counter[str], path: Path) -> None:
    kind, natural = str(geometry.get("type")), outline.tags.get("natural")
    if kind == "GeometryCollection":
        for part in geometry["geometries"]:
            _geometry(part, outline, result, lines, path)
        return
    if kind not in _GEOMETRIES:
        raise InputError(f"it is not as it should be: a geometry of type {geometry.get('type')!r}", path=path)
    several = geometry["coordinates"] if kind.startswith("Multi") else [geometry["coordinates"]]
    single = kind.removeprefix("Multi")
    if single == "Polygon":
        for rings in several:
            _polygon(rings, outline, path)
    # points and lines are trees only where they say so
    elif (single, natural) in (("Point", "tree"), ("LineString", "tree_row")):
        rows = [[points] if single == "Point" else points for points in several]
        source = outline.source
        result.trees += [TreeLine(source, outline.tags, tuple(lonlat(p, source, path) for p in row)) for row in rows]
    else:
        lines[kind] += 1


def _polygon(rings: list[Any], outline: Outline, path: Path) -> None:
    outer, *holes = [[lonlat(point, outline.source, path) for point in ring] for ring in rings] or [[]]
    if any(ring and ring[0] != ring[-1] for ring in (outer, *holes)):
        outline.broken.append("a ring is not closed; its ends were joined by a straight line")
    outline.parts.append((outer, holes))


# ---------------------------------------------------------------- XML


def _from_xml(data: bytes, path: Path) -> MapFile:
    if b"<html" in data[:4096].lower():
        raise InputError("a web page", expected=FORMATS, cause="the server's message was saved, not the map", path=path)
    # counted before parsing: a parser would have filled the memory by then
    if (tags := data.count(b"<")) > MAX_TAGS:
        raise InputError(
            f"the XML has {tags} tags",
            expected=f"at most {MAX_TAGS}",
            cause="a map of a whole country: cut out the site ('osmium extract')",
            path=path,
        )
    root = xml_root(data, path, "plain OSM or KML")
    tag = plain(root.tag)
    if tag == "kml":
        return _kml(root, path, data)
    if tag == "osm":
        return read_elements("OSM XML", _osm_elements(root), path, _xml_lines(data, None))
    raise InputError(f"XML of '{tag}'", expected="OSM ('osm') or KML ('kml')", path=path)


def _xml_lines(data: bytes, name: str | None) -> Callable[[int], int | None]:
    """Line of the n-th outermost element of a name, or child of the root; read again, once, when one is asked for."""

    @cache
    def lines() -> list[int]:
        numbers: list[int] = []
        inside: list[bool] = []
        parser = expat.ParserCreate()

        def start(tag: str, _: Any) -> None:
            wanted = len(inside) == 1 if name is None else tag.rpartition(":")[2] == name and not any(inside[-1:])
            if wanted:
                numbers.append(parser.CurrentLineNumber)
            inside.append(name is not None and (wanted or any(inside[-1:])))

        parser.StartElementHandler, parser.EndElementHandler = start, lambda _: inside.pop()
        parser.Parse(data, True)
        return numbers

    return lambda index: lines()[index] if index < len(lines()) else None


def _osm_elements(root: ElementTree.Element) -> Iterator[dict[str, Any]]:
    """OSM XML as Overpass elements."""
    for item in root:
        element: dict[str, Any] = {
            "type": plain(item.tag),
            **{key: item.get(key) for key in _ATTRIBUTES if key in item.attrib},
        }
        element["tags"] = {tag.get("k", ""): tag.get("v", "") for tag in named(item, "tag")}
        if element["type"] == "way":
            element["nodes"] = [reference.get("ref") for reference in named(item, "nd")]
        elif element["type"] == "relation":
            element["members"] = [dict(member.attrib) for member in named(item, "member")]
        yield element


_ATTRIBUTES = {"id", "lat", "lon", "visible", "action"}


# ---------------------------------------------------------------- KML


def _kml(root: ElementTree.Element, path: Path, data: bytes) -> MapFile:
    result, lines, line_of = MapFile("KML"), Counter[str](), _xml_lines(data, "Placemark")
    for number, placemark in enumerate(outermost(root, {"Placemark"}), start=1):
        name = next((str(n.text or "").strip() for n in placemark if plain(n.tag) == "name"), "")
        identity = name or f"placemark {number}"
        parts = list(outermost(placemark, _PLACEMARK_PARTS)) if len(placemark) else []
        outline = Outline(identity, f"{path.name}: {identity}", kml.data_of(iter(parts)))
        try:
            polygons = [part for part in parts if plain(part.tag) == "Polygon"]
            _kml_height(polygons, outline)
            for polygon in polygons:
                bounds = list(outermost(polygon, {"outerBoundaryIs", "innerBoundaryIs"}))
                outer = [_kml_ring(b, outline, path) for b in bounds if plain(b.tag) == "outerBoundaryIs"]
                holes = [_kml_ring(b, outline, path) for b in bounds if plain(b.tag) == "innerBoundaryIs"]
                outline.parts += [(ring, holes) for ring in outer]
        except BROKEN_ELEMENT as error:
            result.notes.append(left_out(path, line_of(number - 1), f"placemark '{identity}'", error))
            continue
        if outline.parts:
            result.outlines.append(outline)
            continue
        lines.update(tag for tag in (plain(part.tag) for part in parts) if tag in _NO_AREAS)
    result.note_no_areas(path.name, lines)
    return result


_NO_AREAS = ("LineString", "Point", "LinearRing", "Model", "Track")
_PLACEMARK_PARTS = {*_NO_AREAS, "Polygon", "Data", "SimpleData"}


def _kml_height(polygons: list[ElementTree.Element], outline: Outline) -> None:
    """Height tag of polygons drawn above the ground, extruded or not, where the placemark's data name none."""
    modes = {mode for polygon in polygons for mode in kml.modes_of(polygon)}
    heights = (place[2] for polygon in polygons for place in kml.places_of(polygon) if place[2:])
    highest = max(filter(isfinite, heights), default=0.0)
    # heights above sea level say nothing of a building
    if modes == {"relativeToGround"} and highest > 0.0:
        outline.tags = {"height": f"{highest:g}", **outline.tags}


def _kml_ring(boundary: ElementTree.Element, outline: Outline, path: Path) -> list[Position]:
    return [lonlat(place, outline.source, path) for place in kml.places_of(boundary)]
