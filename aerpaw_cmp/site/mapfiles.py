"""Outlines from map files, as they are: GeoJSON, OSM XML, Overpass JSON, KML. Cleaning is :mod:`.footprints`' job."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from ..errors import InputError

Position = tuple[float, float]
"""Latitude, longitude [deg]."""

MAX_BYTES = 512 * 1024 * 1024


@dataclass(slots=True)
class Outline:
    """One area of a map file.

    Parameters
    ----------
    name : str
        Its name, or file and id.
    source : str
        File name and id.
    tags : mapping of str to str
        As in the file.
    parts : list of (outer ring, hole rings)
        Positions in degrees, as written.
    broken : list of str
        What was wrong while reading it.
    """

    name: str
    source: str
    tags: Mapping[str, str]
    parts: list[tuple[list[Position], list[list[Position]]]] = field(default_factory=list)
    broken: list[str] = field(default_factory=list)


@dataclass(slots=True)
class MapFile:
    """All outlines of a file, and the single trees."""

    kind: str
    outlines: list[Outline] = field(default_factory=list)
    trees: list[Position] = field(default_factory=list)


def read_map_file(path: str | Path) -> MapFile:
    """Outlines of a map file; its kind is told by content.

    Raises
    ------
    InputError
        No such file, none of the four formats, not WGS84, coordinates that are no numbers.
    """
    path = Path(path)
    try:
        if path.stat().st_size > MAX_BYTES:
            raise InputError(f"the file has {path.stat().st_size} bytes", expected=f"at most {MAX_BYTES}", path=path)
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", path=path) from None
    start = data[:4096].lstrip(b"\xef\xbb\xbf \t\r\n")
    if not data.strip():
        raise InputError("the file is empty", expected="GeoJSON, OSM XML, Overpass JSON or KML", path=path)
    if start.startswith(b"version https://git-lfs"):
        raise InputError("a Git-LFS pointer in place of the data", cause="'git lfs pull' was not run", path=path)
    if start[:1] in (b"{", b"["):
        return _from_json(data, path)
    if start[:1] == b"<":
        return _from_xml(data, path)
    raise InputError("not a map file", expected="GeoJSON, OSM XML, Overpass JSON or KML", path=path)


def _from_json(data: bytes, path: Path) -> MapFile:
    try:
        content = json.loads(data.decode("utf-8-sig"))
    except json.JSONDecodeError as error:
        raise InputError(f"not JSON: {error.msg}", path=path, line=error.lineno) from None
    except (UnicodeDecodeError, RecursionError):
        raise InputError("not JSON text", path=path) from None
    try:
        if isinstance(content, dict) and isinstance(content.get("elements"), list):
            return _osm("Overpass JSON", content["elements"], path)
        if isinstance(content, dict) and "type" in content:
            return _geojson(content, path)
    except (TypeError, KeyError, AttributeError, IndexError) as error:
        raise InputError(f"an element is not as it should be ({error!r})", path=path) from None
    raise InputError("JSON, but neither GeoJSON nor Overpass", expected="a 'type' or 'elements' member", path=path)


# ---------------------------------------------------------------- GeoJSON (RFC 7946)


def _geojson(content: dict[str, Any], path: Path) -> MapFile:
    crs = str((content.get("crs") or {}).get("properties", {}).get("name", "CRS84"))
    if not any(code in crs for code in ("CRS84", "4326", "4979")):
        raise InputError(f"coordinates in {crs}", expected="WGS84 longitude and latitude (RFC 7946)", path=path)
    result = MapFile("GeoJSON")
    kind = content["type"]
    features = content["features"] if kind == "FeatureCollection" else [content]
    for number, feature in enumerate(features, start=1):
        is_feature = feature.get("type") == "Feature"
        tags = {str(k): str(v) for k, v in ((feature.get("properties") or {}) if is_feature else {}).items()}
        nested = feature.get("properties", {}).get("tags") if is_feature and feature.get("properties") else None
        if isinstance(nested, dict):
            tags.update({str(k): str(v) for k, v in nested.items()})
        identity = str(feature.get("id", tags.get("@id", number)))
        identity = f"feature {identity}" if identity.isdigit() else identity
        outline = Outline(tags.get("name") or f"{identity}", f"{path.name}: {identity}", tags)
        _geometry(feature.get("geometry") if is_feature else feature, outline, result, path)
        if outline.parts or outline.broken:
            result.outlines.append(outline)
    return result


def _geometry(geometry: dict[str, Any] | None, outline: Outline, result: MapFile, path: Path) -> None:
    kind = (geometry or {}).get("type")
    if geometry is None or kind is None:
        return
    if kind == "GeometryCollection":
        for part in geometry["geometries"]:
            _geometry(part, outline, result, path)
    elif kind in ("Polygon", "MultiPolygon"):
        polygons = [geometry["coordinates"]] if kind == "Polygon" else geometry["coordinates"]
        for rings in polygons:
            where = outline.source
            outer, *holes = [[_lonlat(point, where, path) for point in ring] for ring in rings] or [[]]
            outline.parts.append((outer, holes))
    elif kind in ("Point", "MultiPoint") and outline.tags.get("natural") == "tree":
        points = [geometry["coordinates"]] if kind == "Point" else geometry["coordinates"]
        result.trees += [_lonlat(point, outline.source, path) for point in points]


def _lonlat(point: Any, where: str, path: Path) -> Position:
    try:
        longitude, latitude = float(point[0]), float(point[1])
    except (TypeError, ValueError, IndexError):
        raise InputError(f"{where}: the position {str(point)[:40]} is not longitude, latitude", path=path) from None
    if not (math.isfinite(latitude) and math.isfinite(longitude)):
        raise InputError(f"{where}: a coordinate is not a number", path=path)
    return latitude, longitude


# ---------------------------------------------------------------- OpenStreetMap, XML or Overpass JSON


def _from_xml(data: bytes, path: Path) -> MapFile:
    if b"<!DOCTYPE" in data[:65536] or b"<!ENTITY" in data[:65536]:
        raise InputError("the XML declares entities", expected="plain OSM or KML", path=path)
    try:
        root = ElementTree.fromstring(data)
    except ElementTree.ParseError as error:
        line = error.position[0]
        raise InputError(f"not XML: {error.msg}", cause="the file was cut off?", path=path, line=line) from None
    tag = root.tag.rpartition("}")[2]
    if tag == "kml":
        return _kml(root, path)
    if tag == "osm":
        return _osm("OSM XML", _osm_elements(root), path)
    raise InputError(f"XML of '{tag}'", expected="OSM ('osm') or KML ('kml')", path=path)


def _osm_elements(root: ElementTree.Element) -> Iterator[dict[str, Any]]:
    """OSM XML as Overpass elements."""
    for item in root:
        element: dict[str, Any] = {"type": item.tag, "id": item.get("id")}
        element["tags"] = {tag.get("k", ""): tag.get("v", "") for tag in item.iter("tag")}
        if item.tag == "node":
            element |= {"lat": item.get("lat"), "lon": item.get("lon")}
        elif item.tag == "way":
            element["nodes"] = [reference.get("ref") for reference in item.iter("nd")]
        elif item.tag == "relation":
            element["members"] = [dict(member.attrib) for member in item.iter("member")]
        yield element


def _osm(kind: str, elements: Iterable[dict[str, Any]], path: Path) -> MapFile:
    nodes: dict[str, Position] = {}
    ways: dict[str, dict[str, Any]] = {}
    relations: list[dict[str, Any]] = []
    result = MapFile(kind)
    for element in elements:
        if element["type"] == "node" and element.get("lat") is not None:
            position = _lonlat((element["lon"], element["lat"]), f"node {element['id']}", path)
            nodes[str(element["id"])] = position
            if (element.get("tags") or {}).get("natural") == "tree":
                result.trees.append(position)
        elif element["type"] == "way":
            ways[str(element["id"])] = element
        elif element["type"] == "relation":
            relations.append(element)
    for number, way in ways.items():
        if way.get("tags"):
            outline = _outline(way, f"way {number}", path)
            ring = _way(way, nodes, outline, path)
            if ring and ring[0] != ring[-1]:
                continue  # a line: a road, a fence
            outline.parts.append((ring, []))
            result.outlines.append(outline)
    for relation in relations:
        if (relation.get("tags") or {}).get("type") == "multipolygon":
            outline = _outline(relation, f"relation {relation['id']}", path)
            _multipolygon(relation, ways, nodes, outline, path)
            result.outlines.append(outline)
    return result


def _outline(element: dict[str, Any], identity: str, path: Path) -> Outline:
    tags = {str(k): str(v) for k, v in (element.get("tags") or {}).items()}
    return Outline(tags.get("name") or identity, f"{path.name}: {identity}", tags)


def _way(way: dict[str, Any], nodes: dict[str, Position], outline: Outline, path: Path) -> list[Position]:
    if isinstance(way.get("geometry"), list):
        points = [point for point in way["geometry"] if point]
        return [_lonlat((point["lon"], point["lat"]), outline.source, path) for point in points]
    references = [str(reference) for reference in way.get("nodes") or []]
    lost = [reference for reference in references if reference not in nodes]
    if lost:
        outline.broken.append(f"{len(lost)} of {len(references)} nodes are not in the file")
    return [nodes[reference] for reference in references if reference in nodes]


def _multipolygon(
    relation: dict[str, Any],
    ways: dict[str, dict[str, Any]],
    nodes: dict[str, Position],
    outline: Outline,
    path: Path,
) -> None:
    lines: dict[str, list[list[Position]]] = {"outer": [], "inner": []}
    for member in relation.get("members") or []:
        way = member if isinstance(member.get("geometry"), list) else ways.get(str(member.get("ref")))
        if member.get("type") != "way":
            continue
        if way is None:
            outline.broken.append(f"way {member.get('ref')} is not in the file")
            continue
        lines["inner" if member.get("role") == "inner" else "outer"].append(_way(way, nodes, outline, path))
    outer, inner = (_join_rings(lines[role], outline) for role in ("outer", "inner"))
    # which hole belongs to which outer ring is found when the rings are cleaned: holes go with all of them
    outline.parts += [(ring, inner) for ring in outer]


def _join_rings(lines: list[list[Position]], outline: Outline) -> list[list[Position]]:
    """Closed rings from pieces that share end points."""
    rings, open_ = [], [list(line) for line in lines if len(line) > 1]
    while open_:
        ring = open_.pop()
        grown = True
        while ring[0] != ring[-1] and grown:
            grown = False
            for index, piece in enumerate(open_):
                if ring[-1] in (piece[0], piece[-1]):
                    ring += (piece if ring[-1] == piece[0] else piece[::-1])[1:]
                    del open_[index]
                    grown = True
                    break
        if ring[0] != ring[-1]:
            outline.broken.append("a ring is not closed; its ends were joined by a straight line")
            ring.append(ring[0])
        rings.append(ring)
    return rings


# ---------------------------------------------------------------- KML


def _kml(root: ElementTree.Element, path: Path) -> MapFile:
    result = MapFile("KML")
    for number, placemark in enumerate(_named(root, "Placemark"), start=1):
        tags = {}
        for data in _named(placemark, "Data"):
            tags[data.get("name", "")] = next((str(v.text or "") for v in _named(data, "value")), "")
        for data in _named(placemark, "SimpleData"):
            tags[data.get("name", "")] = str(data.text or "")
        name = next((str(n.text or "").strip() for n in placemark if n.tag.rpartition("}")[2] == "name"), "")
        identity = name or f"placemark {number}"
        outline = Outline(identity, f"{path.name}: {identity}", tags)
        for polygon in _named(placemark, "Polygon"):
            outer = [_kml_ring(b, outline, path) for b in _named(polygon, "outerBoundaryIs")]
            holes = [_kml_ring(b, outline, path) for b in _named(polygon, "innerBoundaryIs")]
            outline.parts += [(ring, holes) for ring in outer]
        if outline.parts:
            result.outlines.append(outline)
    return result


def _named(root: ElementTree.Element, name: str) -> Iterator[ElementTree.Element]:
    return (element for element in root.iter() if element.tag.rpartition("}")[2] == name)


def _kml_ring(boundary: ElementTree.Element, outline: Outline, path: Path) -> list[Position]:
    text = " ".join(str(c.text or "") for c in _named(boundary, "coordinates"))
    return [_lonlat(point.split(","), outline.source, path) for point in text.split()]
