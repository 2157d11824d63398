"""Outlines, single trees and tree rows of map files: GeoJSON, OSM XML, Overpass JSON, KML, KMZ.

Elements are returned unchanged, and :mod:`.footprints` cleans them. An element that cannot be used is skipped and
listed by its number, id or name. Only a file that is not a map file is an error.

This module also reads the tags of OpenStreetMap (kind of an object, height, material). For OSM XML and Overpass JSON,
it converts nodes, ways and relations to outlines.
"""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from math import isfinite
from pathlib import Path
from typing import Any, Literal
from xml.etree import ElementTree

import numpy as np
import shapely
from shapely.geometry import Polygon

from ..common import kml
from ..common.errors import InputError, parsed
from ..common.files import read_input
from ..common.kml import named, outermost, plain_tag, xml_root
from ..common.text import counted
from ..common.units import FOOT_M
from ..logs import files
from .materials import MATERIALS

# The licence of OpenStreetMap requires this text.
OSM_CREDIT = "(c) OpenStreetMap contributors, ODbL"

# Latitude and longitude [deg].
Position = tuple[float, float]

# Exceptions raised by an element that cannot be read. The element is skipped and listed, and all others are used.
BROKEN_ELEMENT = (InputError, TypeError, KeyError, AttributeError, IndexError, ValueError, OverflowError)


@dataclass(slots=True)
class Outline:
    """One area of a map file.

    Parameters
    ----------
    name : str
        Name of the area, or file and id.
    source : str
        File name and id.
    tags : mapping of str to str
        Tags of the file.
    parts : list of (outer ring, hole rings)
        Positions in degrees, unchanged.
    broken : list of str
        Errors in the area.
    """

    name: str
    source: str
    tags: Mapping[str, str]
    parts: list[tuple[list[Position], list[list[Position]]]] = field(default_factory=list)
    broken: list[str] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class TreeLine:
    """A single tree (one position) or a tree row (the corners of its line), with its tags."""

    source: str
    tags: Mapping[str, str]
    positions: tuple[Position, ...]


@dataclass(slots=True)
class MapFile:
    """The outlines and trees of a file, sentences about skipped elements, and the data source if it is known.

    Parameters
    ----------
    ground : list of (Position, float)
        Positions with an elevation above sea level [m] (tag ``ele``).
    """

    kind: str
    credit: str = ""
    outlines: list[Outline] = field(default_factory=list)
    trees: list[TreeLine] = field(default_factory=list)
    ground: list[tuple[Position, float]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def take(self, other: MapFile) -> None:
        """Add the contents of a part of the file."""
        self.outlines += other.outlines
        self.trees += other.trees
        self.ground += other.ground
        self.notes += other.notes

    def note_no_areas(self, name: str, lines: Counter[str]) -> None:
        """Add a note about elements of a file ``name`` that do not enclose an area, counted by kind."""
        if lines:
            listed = ", ".join(f"{count} {what}" for what, count in lines.most_common())
            self.notes.append(f"{name}: skipped, because they are not areas: {listed}")


# A ring with more self-intersections than this is not repaired, because the repair could take unlimited time.
MAX_CROSSINGS = 1000


def is_tangled(ring: Polygon) -> bool:
    """Check whether a ring has more than :data:`MAX_CROSSINGS` self-intersections. The count stops there."""
    line = np.asarray(ring.exterior.coords)[:, :2]
    segments = shapely.linestrings(np.stack([line[:-1], line[1:]], axis=1))
    # a short ring has fewer pairs of segments than the allowed number of intersections
    if len(segments) * (len(segments) - 1) // 2 <= MAX_CROSSINGS:
        return False
    tree, crossings = shapely.STRtree(segments), 0
    for start in range(0, len(segments), 64):
        crossings += tree.query(segments[start : start + 64], predicate="crosses").shape[1]
        if crossings > 2 * MAX_CROSSINGS:  # every intersection is found from both sides
            return True
    return False


def lonlat(point: Any, where: str) -> Position:
    """Return a position that is written longitude first. Raise InputError if it is not valid."""
    try:
        longitude, latitude = float(point[0]), float(point[1])
    except (TypeError, ValueError, IndexError, KeyError, OverflowError):
        raise InputError(f"{where}: the position {str(point)[:40]} is not longitude, latitude") from None
    if not (math.isfinite(latitude) and math.isfinite(longitude)):
        raise InputError(f"{where}: a coordinate is not a number")
    return latitude, longitude


@contextmanager
def noting_damage(notes: list[str], path: Path, what: str) -> Iterator[None]:
    """Turn the error of a damaged element into a note that the element is omitted."""
    try:
        yield
    except BROKEN_ELEMENT as error:
        why = "it is not valid" + (f": no {error}" if isinstance(error, KeyError) else "")
        if isinstance(error, InputError):
            why = error.found.removeprefix(f"{path.name}: ").removeprefix(f"{what}: ")
        notes.append(f"warning: {path.name}: {what} was left out: {why}")


Kind = Literal["building", "forest", "geofence"]

_FOREST_TAGS = (("landuse", "forest"), ("natural", "wood"), ("landcover", "trees"))
_NOT = ("no", "", "none", "false", "0")
_UNITS_M = {"m": 1.0, "cm": 0.01, "km": 1000.0, "ft": FOOT_M}
_UNIT_WORDS = {"metre": "m", "meter": "m", "foot": "ft", "feet": "ft"}
# Values of OpenStreetMap for materials that have another name in P.2040.
_MATERIAL_WORDS = {
    "steel": "metal",
    "aluminium": "metal",
    "sheet": "metal",
    "stone": "marble",
    "timber_framing": "wood",
}


def kind_of(tags: Mapping[str, str]) -> Kind | None:
    """Return the kind of an area, or None if its tags do not state a kind.

    Examples
    --------
    >>> kind_of({"building": "barn"}), kind_of({"landuse": "forest"}), kind_of({"building": "no"})
    ('building', 'forest', None)
    """
    tags = {key.lower(): value.lower() for key, value in tags.items()}
    if is_part(tags) or tags.get("building", "no") not in _NOT:
        return "building"
    if any(tags.get(key) == value for key, value in _FOREST_TAGS):
        return "forest"
    # this program's exports and manually written GeoJSON use these keys
    word = tags.get("kind", tags.get("type", ""))
    for kind in ("building", "forest", "geofence"):
        if word == kind or (kind == "geofence" and kind in tags):
            return kind  # type: ignore[return-value]
    return None


def is_part(tags: Mapping[str, str]) -> bool:
    """Check whether an area is a part of a building that has its own outline."""
    return tags.get("building:part", "no").lower() not in _NOT


def below_ground(tags: Mapping[str, str]) -> bool:
    """Check whether a building is completely below the ground.

    Examples
    --------
    >>> below_ground({"building": "yes", "location": "underground"})
    True
    >>> below_ground({"building": "yes", "building:levels": "0", "building:levels:underground": "3"})
    True
    >>> below_ground({"type": "building", "is_underground": "True"})  # Overture
    True
    """
    if "underground" in (tags.get("location", "").lower(), tags.get("parking", "").lower()):
        return True
    # objects in a negative layer are below the ground
    layer = _number(tags.get("layer", ""))
    tunnel = any(tags.get(key, "no").lower() not in _NOT for key in ("tunnel", "is_underground"))
    if tunnel or (layer is not None and layer < 0):
        return True
    levels, cellars = (_number(tags.get(f"building:levels{what}", "")) for what in ("", ":underground"))
    return levels is not None and levels <= 0 and bool(cellars) and not tags.get("height")


def main_tag(tags: Mapping[str, str]) -> str:
    """Return the most informative tag of an area of unknown kind, or ``untagged``.

    Examples
    --------
    >>> main_tag({"natural": "scrub"}), main_tag({"demolished:building": "yes"}), main_tag({"name": "A"})
    ('natural=scrub', 'demolished:building=yes', 'untagged')
    """
    described = [key for key in _MAIN_KEYS if key in tags] + [key for key in tags if key.endswith(":building")]
    described += ["building"] if tags.get("building", "").lower() == "no" else []
    return f"{described[0]}={tags[described[0]]}" if described else "untagged"


_MAIN_KEYS = ("highway", "landuse", "natural", "waterway", "leisure", "amenity", "barrier", "boundary", "man_made",
            "power", "aeroway")  # fmt: skip


def material_of(tags: Mapping[str, str]) -> str:
    """Return the material of the walls, by name in ``materials``."""
    word = tags.get("building:material", "").lower()
    return _MATERIAL_WORDS.get(word, word if word in MATERIALS else "concrete")


def metres(text: str) -> float | None:
    r"""Return the length of a tag [m], or None: ``12``, ``12 m``, ``350 cm``, ``40 ft``, ``40'``, ``39'4"``, ``12,5``.

    ``1,200`` is None, because its comma can be a decimal comma or a separator of thousands.

    Examples
    --------
    >>> metres("12 m"), round(metres("12'6\""), 2), metres("tall")
    (12.0, 3.81, None)
    """
    text = text.strip().lower()
    for typed, plain in (("\u2019", "'"), ("\u2032", "'"), ("\u201d", '"'), ("\u2033", '"'), ("''", '"')):
        text = text.replace(typed, plain)
    if re.search(r"\d,\d{3}(?!\d)", text):
        return None
    # the comma is a decimal comma, because ambiguous numbers were refused above
    text = text.replace(",", ".")
    if match := re.fullmatch(r"(-?\d+(?:\.\d+)?)\s*(m|cm|km|ft|metre|meter|foot|feet)?s?\.?", text):
        unit = match.group(2) or "m"
        return float(match.group(1)) * _UNITS_M[_UNIT_WORDS.get(unit, unit)]
    if match := re.fullmatch(r"(\d+(?:\.\d+)?)\s*(?:'|ft)\s*(?:(\d+(?:\.\d+)?)\s*(?:\"|in))?", text):
        return (float(match.group(1)) + float(match.group(2) or 0) / 12) * FOOT_M
    return None


def positive_metres(tags: Mapping[str, str], keys: tuple[str, ...], notes: list[str]) -> float | None:
    """Return the first valid length among some tags. An invalid value adds a sentence to ``notes``.

    The largest of several values (``8;12``) is used; ``~12`` is 12.
    """
    for key in keys:
        written = tags.get(key, "").strip()
        if not written:
            continue
        # OpenStreetMap joins several values by semicolons
        parts = [metres(part.strip().lstrip("~")) for part in written.split(";")]
        lengths = [value for value in parts if value is not None]
        if len(lengths) < len(parts):
            notes.append(f"the {key} '{written}' is not a length")
            continue
        # exports of databases write 0 or -1 for unknown values
        if max(lengths) <= 0:
            notes.append(f"the {key} '{written}' is not above 0, so it is unknown")
            continue
        if len(lengths) > 1 or written.startswith("~"):
            notes.append(f"the {key} '{written}' is taken as {max(lengths):g} m")
        return max(lengths)
    return None


# ``roof:height`` of OpenStreetMap is the height of the roof alone.
_OTHER_HEIGHTS = re.compile(
    "roof:|min|base|ground|eave|ceil|level|floor|stor|sourc|method|accura|confid|varian|std|tree|canopy|veg|antenna|unit|elev"
)
_UNIT_AT_END = re.compile(
    r"(?:[^a-z]|(?<=height)|(?<=hgt)|(?<=hght)|(?<=ht))(ft|feet|foot|cm|m|met(?:er|re)s?)[^a-z]*$"
)
_FEET = re.compile(r"feet|foot|[^a-z]ft([^a-z]|$)")
_STOREYS = re.compile(r"(building)?levels|(n|num|no|noof|numberof)?(floors|stor(ey|ie|y)s)|(floor|stor(ey|y))(count|s)")


def height_of(tags: Mapping[str, str], notes: list[str]) -> float | None:
    """Return the height of a building, converted to metres, from any of the tags that programs use.

    The unit is read from the value, from the name of the tag, or from a tag ``NAME_unit``.

    Examples
    --------
    >>> [height_of({name: "40"}, []) for name in ("height", "HEIGHT_FT", "Bldg Hgt (m)", "ground_height")]
    [40.0, 12.192, 40.0, None]
    """
    names = [name for name in tags if re.search("height|hgt|hght", name.lower())]
    names = [name for name in names if not _OTHER_HEIGHTS.search(name.lower())]
    first = ("height", "building:height", "height_m", "est_height")
    # use the key of OpenStreetMap first, and then other columns in the order of the file
    for name in sorted(names, key=lambda n: first.index(n) if n in first else len(first)):
        named = _UNIT_AT_END.search(name.lower())
        unit = named[1] if named else "ft" if _FEET.search(name.lower()) else tags.get(f"{name}_unit", "")
        value = tags[name].strip()
        if unit and re.fullmatch(r"-?\d+(?:[.,]\d+)?", value):
            value = f"{value} {unit.lower()}"
        if (height := positive_metres({name: value}, (name,), notes)) is not None:
            return height
    return None


def levels_of(tags: Mapping[str, str], notes: list[str]) -> float | None:
    """Return the number of levels. The largest of several values (``2;3``) is used."""
    named = (value.strip() for name, value in tags.items() if _STOREYS.fullmatch(re.sub(r"[^a-z]", "", name.lower())))
    written = next(filter(None, named), "")
    if not written:
        return None
    parts = [_number(part) for part in written.split(";")]
    numbers = [value for value in parts if value is not None]
    if len(numbers) < len(parts) or max(numbers) <= 0:
        if written != "0":  # some mappers do not count the ground floor
            notes.append(f"the number of levels '{written}' is not a positive number")
        return None
    if len(numbers) > 1:
        notes.append(f"the largest of the levels '{written}' is used")
    return max(numbers)


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None


Element = dict[str, Any]


@dataclass(slots=True)
class _Data:
    """Elements by id, as text."""

    path: Path
    nodes: dict[str, Position] = field(default_factory=dict)
    trees: dict[str, dict[str, str]] = field(default_factory=dict)
    ground: dict[str, float] = field(default_factory=dict)
    ways: dict[str, Element] = field(default_factory=dict)
    relations: dict[str, Element] = field(default_factory=dict)


def read_elements(kind: str, elements: Iterable[Element], path: Path) -> MapFile:
    """Return outlines and trees of OpenStreetMap elements in the form of Overpass.

    Parameters
    ----------
    kind : str
        Kind of the file, for messages.
    elements : iterable of dict
        ``type``, ``id``, ``tags``, and ``lat lon``, ``nodes`` or ``geometry``, ``members``.
    path : Path
        File, for messages.

    Returns
    -------
    MapFile
        Outlines, trees, and a note for each skipped element.
    """
    result, data = MapFile(kind, OSM_CREDIT), _Data(path)
    for number, element in enumerate(elements, start=1):
        with noting_damage(result.notes, path, f"element {number}"):
            _sort(element, number, data)
    for identity, tags in data.trees.items():
        result.trees.append(TreeLine(f"{path.name}: node {identity}", tags, (data.nodes[identity],)))
    result.ground += [(data.nodes[identity], height_m) for identity, height_m in data.ground.items()]
    lines: Counter[str] = Counter()
    used_ways = _relations(data, result, lines)
    for identity, way in data.ways.items():
        # a way without tags is part of a relation, or not used
        if way.get("tags") and identity not in used_ways:
            with noting_damage(result.notes, path, f"way {identity}"):
                _way_outline(identity, way, data, result, lines)
    result.note_no_areas(path.name, lines)
    return result


def _sort(element: Element, number: int, data: _Data) -> None:
    """Store an element under its id. If an element occurs twice, both are merged."""
    if element.get("visible") == "false" or element.get("action") == "delete":
        return
    identity = str(element.get("id", f"without id, element {number}"))
    if element["type"] == "node":
        if element.get("lat") is None and element.get("lon") is None:
            return  # "out ids" and "out tags" contain no positions
        # ids are text in OSM XML and numbers in Overpass
        data.nodes[identity] = lonlat((element.get("lon"), element.get("lat")), f"node {identity}")
        tags = element.get("tags") or {}
        if tags.get("natural") == "tree":
            data.trees[identity] = _words(element.get("tags"))
        if (height_m := metres(str(tags.get("ele", "")))) is not None:
            data.ground[identity] = height_m
    elif element["type"] in ("way", "relation"):
        store = data.ways if element["type"] == "way" else data.relations
        given = {key: value for key, value in element.items() if value is not None and value != {}}
        # "out body; >; out skel;" contains a way with tags, and again without tags
        store[identity] = {**store.get(identity, {}), **given}


def _outline(tags: dict[str, str], identity: str, path: Path) -> Outline:
    return Outline(tags.get("name") or identity, f"{path.name}: {identity}", tags)


# ---------------------------------------------------------------- ways


def _way_outline(identity: str, way: Element, data: _Data, result: MapFile, lines: Counter[str]) -> None:
    outline = _outline(_words(way.get("tags")), f"way {identity}", data.path)
    ring = _points(way, data, outline)
    if outline.tags.get("natural") == "tree_row":
        result.trees.append(TreeLine(outline.source, outline.tags, tuple(ring)))
        result.notes += [f"{outline.source}: {fault}" for fault in outline.broken]
        return
    # "out geom" contains positions but no ids, so compare positions to close a ring
    references = way.get("nodes") or ring
    if not references or references[0] != references[-1]:
        if kind_of(outline.tags) is None:
            lines["lines"] += 1
            return
        if ring:
            outline.broken.append("its line is not closed; the ends were joined by a straight line")
    outline.parts.append((ring, []))
    result.outlines.append(outline)


def _points(way: Element, data: _Data, outline: Outline) -> list[Position]:
    """Return the known positions of a way. Missing positions are reported in ``outline.broken``."""
    if isinstance(way.get("geometry"), list):
        points = [point for point in way["geometry"] if point]
        if len(points) < len(way["geometry"]):
            lost = len(way["geometry"]) - len(points)
            outline.broken.append(
                f"{lost} of {counted(len(way['geometry']), 'point')} unknown: cut off at the query's box"
            )
        return [lonlat((point.get("lon"), point.get("lat")), outline.source) for point in points]
    references = [str(reference) for reference in way.get("nodes") or []]
    known = [data.nodes[reference] for reference in references if reference in data.nodes]
    if not known:
        outline.broken.append("it has no outline in the file; end the Overpass query with 'out geom;'")
    elif len(known) < len(references):
        outline.broken.append(f"{len(references) - len(known)} of {counted(len(references), 'node')} not in the file")
    return known


# ---------------------------------------------------------------- relations


def _relations(data: _Data, result: MapFile, lines: Counter[str]) -> set[str]:
    """Add multipolygons. Return the ways that belong to them and must not be added separately."""
    used_ways: set[str] = set()
    for identity, relation in data.relations.items():
        tags = _words(relation.get("tags"))
        # other relations, such as sites and routes, are not areas
        if tags.get("type") not in ("multipolygon", "boundary"):
            if kind_of({k: v for k, v in tags.items() if k != "type"}):
                lines[f"relations of type '{tags.get('type', '')}'"] += 1
            continue
        # in old relations, the role of an outer way is empty
        outer = [str(m.get("ref")) for m in relation.get("members") or [] if m.get("role") in ("outer", "", None)]
        own = {ref: words for ref in outer if (words := _words((data.ways.get(ref) or {}).get("tags")))}
        kind = kind_of({k: v for k, v in tags.items() if k != "type"})
        if kind is None:  # multipolygons from before 2017 have their tags on the outer way
            kinds = {kind_of(words) for words in own.values()} - {None}
            if len(kinds) != 1 or tags.get("type") == "boundary":
                lines[f"relations of type '{tags['type']}' without tags of a building or forest"] += 1
                continue
            kind = kinds.pop()
            tags = {**next(words for words in own.values() if kind_of(words) == kind), **tags}
        outline = _outline(tags, f"relation {identity}", data.path)
        with noting_damage(result.notes, data.path, f"relation {identity}"):
            _multipolygon(relation, data, outline)
            if outline.parts:
                used_ways |= {ref for ref, words in own.items() if kind_of(words) == kind}
            result.outlines.append(outline)
    return used_ways


def _multipolygon(relation: Element, data: _Data, outline: Outline) -> None:
    lines: dict[str, list[list[Position]]] = {"outer": [], "inner": [], "": []}
    for member in relation.get("members") or []:
        if member.get("type") != "way":
            if member.get("type") == "relation":
                outline.broken.append(f"its member relation {member.get('ref')} was left out")
            continue
        # in Overpass the relation contains the line of each member, but XML contains only the id of the line
        way = member if isinstance(member.get("geometry"), list) else data.ways.get(str(member.get("ref")))
        if way is None:
            outline.broken.append(f"way {member.get('ref')} is not in the file")
            continue
        role = member.get("role")
        lines[role if role in ("outer", "inner") else ""].append(_points(way, data, outline))
    if lines[""] and not lines["outer"] and not lines["inner"]:
        outer, inner = _by_nesting(_join_rings(lines[""], outline))
        if inner:
            outline.broken.append("its members have no roles; rings inside another are treated as holes")
    else:
        outer, inner = _join_rings(lines["outer"] + lines[""], outline), _join_rings(lines["inner"], outline)
    if not outer and not outline.broken:
        outline.broken.append("it has no outline in the file; end the Overpass query with 'out geom;'")
    # a hole belongs to all rings except those inside it, such as an island of trees in a clearing
    outline.parts += [(ring, [hole for hole in inner if not _inside(ring, hole)]) for ring in outer]


def _inside(ring: list[Position], shell: list[Position]) -> bool:
    if len(set(ring)) < 3 or len(set(shell)) < 3:
        return False
    shapes = [Polygon(line) for line in (ring, shell)]
    if any(not shape.is_valid and is_tangled(shape) for shape in shapes):
        return False
    # a ring that crosses itself must be repaired before its area can be used
    inner, outer = (shapely.make_valid(shape) for shape in shapes)
    return bool(inner.area < outer.area and shapely.covers(outer, inner))


def _by_nesting(rings: list[list[Position]]) -> tuple[list[list[Position]], list[list[Position]]]:
    """Split rings into outer rings and holes. A ring inside an odd number of other rings is a hole."""
    depth = [sum(_inside(ring, other) for other in rings if other is not ring) for ring in rings]
    return (
        [ring for ring, around in zip(rings, depth, strict=True) if around % 2 == 0],
        [ring for ring, around in zip(rings, depth, strict=True) if around % 2 == 1],
    )


def _join_rings(lines: list[list[Position]], outline: Outline) -> list[list[Position]]:
    """Return closed rings from pieces that share end points."""
    rings, open_ = [], [list(line) for line in lines if len(line) > 1]
    while open_:
        ring = open_.pop()
        # the pieces of a ring may have any order and direction
        while ring[0] != ring[-1] and (index := _next_piece(ring, open_)) is not None:
            piece = open_.pop(index)
            if ring[-1] in (piece[0], piece[-1]):
                ring += (piece if ring[-1] == piece[0] else piece[::-1])[1:]
            else:
                ring = (piece if ring[0] == piece[-1] else piece[::-1])[:-1] + ring
        if ring[0] != ring[-1]:
            outline.broken.append("a ring is not closed; its ends were joined by a straight line")
            ring.append(ring[0])
        rings.append(ring)
    return rings


def _next_piece(ring: list[Position], pieces: list[list[Position]]) -> int | None:
    """Return the index of the first piece that begins or ends at an end of the ring."""
    ends = {ring[0], ring[-1]}
    return next((i for i, piece in enumerate(pieces) if ends & {piece[0], piece[-1]}), None)


# Largest size of a map file. Even a map of a county is smaller, and a site needs only a few kilometres.
MAX_BYTES = 256 * 1024 * 1024

# Largest number of begin and end tags of an XML map file, because each becomes an object in memory.
MAX_TAGS = 1_500_000

FORMATS = "GeoJSON, OSM XML, Overpass JSON, KML or KMZ"

# Text by which GeoJSON or KML from OpenStreetMap is recognised: the name or the form of the ids.
_OF_OSM = re.compile(rb'openstreetmap|"osm_(way_)?id"|"(way|relation|node)/[0-9]+"', re.IGNORECASE)

_OTHER_KINDS: tuple[tuple[bytes, str, str], ...] = (
    (b"\x1f\x8b", "gzip-compressed data", "unpack it with gunzip"),
    (b"BZh", "bzip2-compressed data", "unpack it with bunzip2"),
    (b"\xff\xfe", "UTF-16 text", "save it as UTF-8"),
    (b"\xfe\xff", "UTF-16 text", "save it as UTF-8"),
    (b"\x00\x00\x27\x0a", "a shapefile", "ogr2ogr -f GeoJSON -t_srs EPSG:4326 converts it to GeoJSON"),
    (b"SQLite format 3", "a GeoPackage or another SQLite file", "ogr2ogr -f GeoJSON -t_srs EPSG:4326 makes GeoJSON"),
)


@parsed(FORMATS)
def read_map_file(path: str | Path) -> MapFile:
    """Return the outlines of a map file, whose format is recognised by its content.

    Raises
    ------
    InputError
        If there is no such file, its format is unknown, or it is not in WGS84.
    """
    path = Path(path)
    data = read_input(path, MAX_BYTES, "a map file")
    # browsers save a KMZ as .zip or .kml, so look at the content
    if data.startswith(b"PK\x03\x04"):
        data = main_kml(data, path)
    # skip a byte-order mark and blank lines
    start = data[:4096].lstrip(b"\xef\xbb\xbf \t\r\n")
    if not data.strip():
        raise InputError("the file is empty", expected=FORMATS)
    if start.startswith(b"version https://git-lfs"):
        raise InputError("a Git-LFS pointer in place of the data", cause="'git lfs pull' was not run")
    if start[:1] in (b"{", b"[", b"<"):
        content = _from_xml(data, path) if start[:1] == b"<" else _from_json(data, path)
        if _OF_OSM.search(data):
            content.credit = OSM_CREDIT
        return content
    for magic, what, remedy in _OTHER_KINDS:
        if data.startswith(magic):
            raise InputError(f"{what}, not a map file of text", expected=FORMATS, cause=remedy)
    if b"OSMHeader" in data[:64]:
        raise InputError("OSM data in PBF", expected=FORMATS, cause="'osmium cat in.pbf -o out.osm' unpacks it")
    raise InputError("not a map file", expected=FORMATS)


def main_kml(data: bytes, path: str | Path) -> bytes:
    """Return the main KML file of a KMZ archive."""
    try:
        members = files.archive_members(data, path)
    except InputError as error:
        raise InputError(f"not a KMZ archive ({error.found})", cause="the file was cut off") from None
    maps = {name.lower(): member for name, member in members.items() if name.lower().endswith(".kml")}
    if not maps:
        raise InputError("an archive without a .kml file", expected="KMZ")
    # Google Earth opens doc.kml, or otherwise the first file
    main = maps.get("doc.kml") or next(iter(maps.values()))
    if main.size > MAX_BYTES:
        raise InputError(f"{main.name} has {main.size} bytes", expected=f"at most {MAX_BYTES}")
    return main.read(MAX_BYTES)


def _from_json(data: bytes, path: Path) -> MapFile:
    try:
        text = data.decode("utf-8-sig")
        content = json.loads(text)
    except json.JSONDecodeError as error:
        # an error at the end means that the text is truncated
        cause = "the file was cut off" if error.pos >= len(text.rstrip()) - 1 else None
        if error.msg == "Extra data":
            cause = "one feature per line; 'ogr2ogr -f GeoJSON map.geojson FILE' makes GeoJSON of it"
        raise InputError(f"not JSON: {error.msg}", cause=cause, line=error.lineno) from None
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise InputError("not JSON text: a byte that is not UTF-8", cause="save it as UTF-8", line=line) from None
    if isinstance(content, dict) and isinstance(content.get("elements"), list):
        result = read_elements("Overpass JSON", content["elements"], path)
        # after a timeout, Overpass answers with status 200 and a remark
        if remark := content.get("remark"):
            result.notes.append(f"warning: {path.name}: the Overpass server reports: {str(remark)[:200]}")
        return result
    if isinstance(content, dict) and "type" in content:
        return _geojson(content, path)
    raise InputError("JSON, but neither GeoJSON nor Overpass", expected="a 'type' or 'elements' member")


# ---------------------------------------------------------------- GeoJSON (RFC 7946)

_GEOMETRIES = (
    "Point", "MultiPoint", "LineString", "MultiLineString", "Polygon", "MultiPolygon", "GeometryCollection",
)  # fmt: skip


def _geojson(content: dict[str, Any], path: Path) -> MapFile:
    _check_crs(content.get("crs"))
    result, lines = MapFile("GeoJSON"), Counter[str]()
    kind = content["type"]
    if kind not in (*_GEOMETRIES, "Feature", "FeatureCollection"):
        raise InputError(f"JSON of type '{kind}'", expected="GeoJSON: a FeatureCollection of areas")
    features = content.get("features") if kind == "FeatureCollection" else [content]
    if not isinstance(features, list):
        raise InputError("a FeatureCollection without a list of features", expected="'features': [...]")
    for number, feature in enumerate(features, start=1):
        with noting_damage(result.notes, path, f"feature {number}"):
            part = MapFile("GeoJSON")
            _feature(feature, number, part, lines, path)
            result.take(part)
    result.note_no_areas(path.name, lines)
    return result


def _check_crs(crs: Any) -> None:
    """Refuse coordinate systems other than WGS84, which GeoJSON from before RFC 7946 may name."""
    named = crs.get("properties") if isinstance(crs, dict) else crs
    name = str(named.get("name", "CRS84") if isinstance(named, dict) else named or "CRS84")
    # EPSG:4979 is WGS84 with heights
    if not any(code in name for code in ("CRS84", "4326", "4979")):
        raise InputError(
            f"coordinates in {name}",
            expected="WGS84 longitude and latitude (RFC 7946)",
            cause="exported in projected coordinates; ogr2ogr -t_srs EPSG:4326 converts them",
        )


def _feature(feature: Any, number: int, result: MapFile, lines: Counter[str], path: Path) -> None:
    is_feature = feature.get("type") == "Feature"
    properties = (feature.get("properties") or {}) if is_feature else {}
    tags = _words(properties)
    # some exporters, such as osmtogeojson, store the tags of OpenStreetMap in a nested object
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


def _words(properties: dict[str, Any] | None) -> dict[str, str]:
    return {str(key): str(value) for key, value in (properties or {}).items() if value is not None}


def _geometry(geometry: dict[str, Any], outline: Outline, result: MapFile, lines: Counter[str], path: Path) -> None:
    kind, natural = str(geometry.get("type")), outline.tags.get("natural")
    if kind == "GeometryCollection":
        for part in geometry["geometries"]:
            _geometry(part, outline, result, lines, path)
        return
    if kind not in _GEOMETRIES:
        raise InputError(f"it is not valid: a geometry of type {geometry.get('type')!r}")
    several = geometry["coordinates"] if kind.startswith("Multi") else [geometry["coordinates"]]
    single = kind.removeprefix("Multi")
    if single == "Polygon":
        for rings in several:
            _polygon(rings, outline)
    # points and lines are trees only if their tags say so
    elif (single, natural) in (("Point", "tree"), ("LineString", "tree_row")):
        rows = [[points] if single == "Point" else points for points in several]
        source = outline.source
        result.trees += [TreeLine(source, outline.tags, tuple(lonlat(p, source) for p in row)) for row in rows]
    elif single == "Point" and (height_m := metres(outline.tags.get("ele", ""))) is not None:
        result.ground += [(lonlat(point, outline.source), height_m) for point in several]
    else:
        lines[kind] += 1


def _polygon(rings: list[Any], outline: Outline) -> None:
    outer, *holes = [[lonlat(point, outline.source) for point in ring] for ring in rings] or [[]]
    if any(ring and ring[0] != ring[-1] for ring in (outer, *holes)):
        outline.broken.append("a ring is not closed; its ends were joined by a straight line")
    outline.parts.append((outer, holes))


# ---------------------------------------------------------------- XML


def _from_xml(data: bytes, path: Path) -> MapFile:
    if b"<html" in data[:4096].lower():
        raise InputError("a web page", expected=FORMATS, cause="the server's message was saved, not the map")
    # count before parsing, because a parser would fill the memory
    if (tags := data.count(b"<")) > MAX_TAGS:
        raise InputError(
            f"the XML has {tags} tags",
            expected=f"at most {MAX_TAGS}",
            cause="a map of a whole country: cut out the site ('osmium extract')",
        )
    root = xml_root(data, path, "plain OSM or KML")
    tag = plain_tag(root.tag)
    if tag == "kml":
        return _kml(root, path)
    if tag == "osm":
        return read_elements("OSM XML", _osm_elements(root), path)
    raise InputError(f"XML of '{tag}'", expected="OSM ('osm') or KML ('kml')")


def _osm_elements(root: ElementTree.Element) -> Iterator[dict[str, Any]]:
    """Yield OSM XML as Overpass elements."""
    for item in root:
        element: dict[str, Any] = {
            "type": plain_tag(item.tag),
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


def _kml(root: ElementTree.Element, path: Path) -> MapFile:
    result, lines = MapFile("KML"), Counter[str]()
    for number, placemark in enumerate(outermost(root, {"Placemark"}), start=1):
        name = next((str(n.text or "").strip() for n in placemark if plain_tag(n.tag) == "name"), "")
        identity = name or f"placemark {number}"
        parts = list(outermost(placemark, _PLACEMARK_PARTS)) if len(placemark) else []
        outline = Outline(identity, f"{path.name}: {identity}", kml.data_of(iter(parts)))
        with noting_damage(result.notes, path, f"placemark '{identity}'"):
            polygons = [part for part in parts if plain_tag(part.tag) == "Polygon"]
            _kml_height(polygons, outline)
            for polygon in polygons:
                bounds = list(outermost(polygon, {"outerBoundaryIs", "innerBoundaryIs"}))
                outer = [_kml_ring(b, outline) for b in bounds if plain_tag(b.tag) == "outerBoundaryIs"]
                holes = [_kml_ring(b, outline) for b in bounds if plain_tag(b.tag) == "innerBoundaryIs"]
                outline.parts += [(ring, holes) for ring in outer]
            if outline.parts:
                result.outlines.append(outline)
            else:
                lines.update(tag for tag in (plain_tag(part.tag) for part in parts) if tag in _NO_AREAS)
    result.note_no_areas(path.name, lines)
    return result


_NO_AREAS = ("LineString", "Point", "LinearRing", "Model", "Track")
_PLACEMARK_PARTS = {*_NO_AREAS, "Polygon", "Data", "SimpleData"}


def _kml_height(polygons: list[ElementTree.Element], outline: Outline) -> None:
    """Set the height from polygons drawn above the ground, if the data of the placemark contain no height."""
    modes = {mode for polygon in polygons for mode in kml.modes_of(polygon)}
    heights = (place[2] for polygon in polygons for place in kml.places_of(polygon) if place[2:])
    highest = max(filter(isfinite, heights), default=0.0)
    # heights above sea level are not heights of a building
    if modes == {"relativeToGround"} and highest > 0.0:
        outline.tags = {"height": f"{highest:g}", **outline.tags}


def _kml_ring(boundary: ElementTree.Element, outline: Outline) -> list[Position]:
    return [lonlat(place, outline.source) for place in kml.places_of(boundary)]
