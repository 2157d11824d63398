"""OpenStreetMap's model - nodes, ways, relations - as outlines, whether it came as OSM XML or as Overpass JSON."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import shapely
from shapely.geometry import Polygon

from ...common.counting import counted
from .outlines import BROKEN_ELEMENT, OSM_CREDIT, MapFile, Outline, Position, TreeLine, is_tangled, left_out, lonlat
from .tags import kind_of

Element = dict[str, Any]
LineOf = Callable[[int], "int | None"]


@dataclass(slots=True)
class _Data:
    """Elements by id, as text."""

    path: Path
    nodes: dict[str, Position] = field(default_factory=dict)
    trees: dict[str, dict[str, str]] = field(default_factory=dict)
    ways: dict[str, Element] = field(default_factory=dict)
    relations: dict[str, Element] = field(default_factory=dict)


def read_elements(kind: str, elements: Iterable[Element], path: Path, line_of: LineOf) -> MapFile:
    """Outlines and trees of OSM elements in Overpass's shape.

    Parameters
    ----------
    kind : str
        Of the file, for messages.
    elements : iterable of dict
        ``type``, ``id``, ``tags``, and ``lat lon``, ``nodes`` or ``geometry``, ``members``.
    path : Path
        For messages.
    line_of : callable
        Line of the element of an index, asked for those that cannot be used.

    Returns
    -------
    MapFile
        Outlines, trees, and a note per thing that was left out.
    """
    result, data = MapFile(kind, OSM_CREDIT), _Data(path)
    for index, element in enumerate(elements):
        try:
            _sort(element, index, data)
        except BROKEN_ELEMENT as error:
            result.notes.append(left_out(path, line_of(index), f"element {index + 1}", error))
    for identity, tags in data.trees.items():
        result.trees.append(TreeLine(f"{path.name}: node {identity}", tags, (data.nodes[identity],)))
    lines: Counter[str] = Counter()
    used_ways = _relations(data, result, lines, line_of)
    for identity, way in data.ways.items():
        # a way without tags is part of a relation, or nothing
        if way.get("tags") and identity not in used_ways:
            try:
                _way_outline(identity, way, data, result, lines)
            except BROKEN_ELEMENT as error:
                result.notes.append(left_out(path, line_of(way["index"]), f"way {identity}", error))
    result.note_no_areas(path.name, lines)
    return result


def _sort(element: Element, index: int, data: _Data) -> None:
    """Puts an element under its id. One that comes twice keeps the tags and points of both."""
    if element.get("visible") == "false" or element.get("action") == "delete":
        return
    identity = str(element.get("id", f"without id, element {index + 1}"))
    if element["type"] == "node":
        if element.get("lat") is None and element.get("lon") is None:
            return  # out ids, out tags: no position was asked for
        # ids as text: OSM XML has them so, Overpass as numbers
        data.nodes[identity] = lonlat((element.get("lon"), element.get("lat")), f"node {identity}", data.path)
        if (element.get("tags") or {}).get("natural") == "tree":
            data.trees[identity] = _words(element)
    elif element["type"] in ("way", "relation"):
        store = data.ways if element["type"] == "way" else data.relations
        given = {key: value for key, value in {**element, "index": index}.items() if value is not None and value != {}}
        # "out body; >; out skel;" gives a way with tags, then once more without
        store[identity] = {**store.get(identity, {}), **given}


def _words(element: Element) -> dict[str, str]:
    return {str(key): str(value) for key, value in (element.get("tags") or {}).items()}


def _outline(tags: dict[str, str], identity: str, path: Path) -> Outline:
    return Outline(tags.get("name") or identity, f"{path.name}: {identity}", tags)


# ---------------------------------------------------------------- ways


def _way_outline(identity: str, way: Element, data: _Data, result: MapFile, lines: Counter[str]) -> None:
    outline = _outline(_words(way), f"way {identity}", data.path)
    ring = _points(way, data, outline)
    if outline.tags.get("natural") == "tree_row":
        result.trees.append(TreeLine(outline.source, outline.tags, tuple(ring)))
        result.notes += [f"{outline.source}: {fault}" for fault in outline.broken]
        return
    # with "out geom" there are positions and no ids: a ring closes by place
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
    """Positions of a way that are known; what is missing goes to ``outline.broken``."""
    if isinstance(way.get("geometry"), list):
        points = [point for point in way["geometry"] if point]
        if len(points) < len(way["geometry"]):
            lost = len(way["geometry"]) - len(points)
            outline.broken.append(
                f"{lost} of {counted(len(way['geometry']), 'point')} unknown: cut off at the query's box"
            )
        return [lonlat((point.get("lon"), point.get("lat")), outline.source, data.path) for point in points]
    references = [str(reference) for reference in way.get("nodes") or []]
    known = [data.nodes[reference] for reference in references if reference in data.nodes]
    if not known:
        outline.broken.append("it has no outline in the file; end the Overpass query with 'out geom;'")
    elif len(known) < len(references):
        outline.broken.append(f"{len(references) - len(known)} of {counted(len(references), 'node')} not in the file")
    return known


# ---------------------------------------------------------------- relations


def _relations(data: _Data, result: MapFile, lines: Counter[str], line_of: LineOf) -> set[str]:
    """Adds multipolygons; gives the ways that are part of them and must not come again, with their holes filled."""
    used_ways: set[str] = set()
    for identity, relation in data.relations.items():
        tags = _words(relation)
        # sites, routes and the like collect things and bound no area
        if tags.get("type") not in ("multipolygon", "boundary"):
            if kind_of({k: v for k, v in tags.items() if k != "type"}):
                lines[f"relations of type '{tags.get('type', '')}'"] += 1
            continue
        # old relations leave the role of an outer way empty
        outer = [str(m.get("ref")) for m in relation.get("members") or [] if m.get("role") in ("outer", "", None)]
        own = [ref for ref in outer if (data.ways.get(ref) or {}).get("tags")]
        kind = kind_of({k: v for k, v in tags.items() if k != "type"})
        if kind is None:  # multipolygons of before 2017 have their tags on the outer way
            kinds = {kind_of(_words(data.ways[ref])) for ref in own} - {None}
            if len(kinds) != 1 or tags.get("type") == "boundary":
                lines[f"relations of type '{tags['type']}' without tags of a building or forest"] += 1
                continue
            kind = kinds.pop()
            tags = {**_words(next(data.ways[ref] for ref in own if kind_of(_words(data.ways[ref])) == kind)), **tags}
        outline = _outline(tags, f"relation {identity}", data.path)
        try:
            _multipolygon(relation, data, outline)
        except BROKEN_ELEMENT as error:
            result.notes.append(left_out(data.path, line_of(relation["index"]), f"relation {identity}", error))
            continue
        if outline.parts:
            used_ways |= {ref for ref in own if kind_of(_words(data.ways[ref])) == kind}
        result.outlines.append(outline)
    return used_ways


def _multipolygon(relation: Element, data: _Data, outline: Outline) -> None:
    lines: dict[str, list[list[Position]]] = {"outer": [], "inner": [], "": []}
    for member in relation.get("members") or []:
        if member.get("type") != "way":
            if member.get("type") == "relation":
                outline.broken.append(f"its member relation {member.get('ref')} was left out")
            continue
        # Overpass gives a member's line with the relation, XML by its id
        way = member if isinstance(member.get("geometry"), list) else data.ways.get(str(member.get("ref")))
        if way is None:
            outline.broken.append(f"way {member.get('ref')} is not in the file")
            continue
        role = member.get("role")
        lines[role if role in ("outer", "inner") else ""].append(_points(way, data, outline))
    if lines[""] and not lines["outer"] and not lines["inner"]:
        outer, inner = _by_nesting(_join_rings(lines[""], outline))
        if inner:
            outline.broken.append("its members have no roles; rings inside another are taken for holes")
    else:
        outer, inner = _join_rings(lines["outer"] + lines[""], outline), _join_rings(lines["inner"], outline)
    if not outer and not outline.broken:
        outline.broken.append("it has no outline in the file; end the Overpass query with 'out geom;'")
    # a hole belongs to all rings but those that stand in it, such as an island of trees in a clearing
    outline.parts += [(ring, [hole for hole in inner if not _inside(ring, hole)]) for ring in outer]


def _inside(ring: list[Position], shell: list[Position]) -> bool:
    if len(set(ring)) < 3 or len(set(shell)) < 3:
        return False
    shapes = [Polygon(line) for line in (ring, shell)]
    if any(not shape.is_valid and is_tangled(shape) for shape in shapes):
        return False
    # a ring that crosses itself covers nothing until it is repaired
    inner, outer = (shapely.make_valid(shape) for shape in shapes)
    return bool(inner.area < outer.area and shapely.covers(outer, inner))


def _by_nesting(rings: list[list[Position]]) -> tuple[list[list[Position]], list[list[Position]]]:
    """Outer rings and holes: a ring inside an odd number of others is a hole."""
    depth = [sum(_inside(ring, other) for other in rings if other is not ring) for ring in rings]
    return (
        [ring for ring, around in zip(rings, depth, strict=True) if around % 2 == 0],
        [ring for ring, around in zip(rings, depth, strict=True) if around % 2 == 1],
    )


def _join_rings(lines: list[list[Position]], outline: Outline) -> list[list[Position]]:
    """Closed rings from pieces that share end points."""
    rings, open_ = [], [list(line) for line in lines if len(line) > 1]
    while open_:
        ring = open_.pop()
        # pieces come in any order and direction
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
    """Number of the first piece that begins or ends where the ring does."""
    ends = {ring[0], ring[-1]}
    return next((i for i, piece in enumerate(pieces) if ends & {piece[0], piece[-1]}), None)
