"""Buildings, forests and geofences from map files: classified, projected, repaired, with a list of all actions.

The height of a building is its ``height`` tag, else ``building:levels`` times 3 m, else (for a part of a building) the
height of the outline that contains the part, else a default. The number of default heights is reported. Where parts
cover the outline of a building, the parts replace the outline. Overlapping buildings of equal height are joined.
If the heights differ, the overlap belongs to the higher building. Holes are retained. Slivers and duplicates are
removed. Single trees have their tagged sizes, and tree rows become trees along their line.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import shapely
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from shapely.geometry import LineString, MultiPolygon, Point, Polygon, box
from shapely.geometry.base import BaseGeometry

from ..common.errors import InputError, UsageError, about_file, one_line
from ..common.geodesy import SiteFrame
from ..common.grouping import lists_by_key
from ..common.stages import Progress, logged
from ..common.text import counted
from ..common.units import FloatArray
from ..common.yamlfile import dump_yaml
from . import mapfiles
from .site import Building, Forest, Geofence
from .siteyaml import (
    TALLEST_M,
    TALLEST_TREE_M,
    WIDEST_CROWN_M,
    SingleTreeModel,
    SiteModel,
    build_site,
    extent_m,
    misread,
    site_model,
)

# Storey height that OpenStreetMap suggests.
_LEVEL_M = 3.0
# The height of two storeys, such as a barn or a house.
_DEFAULT_HEIGHT_M = 6.0
# Smallest height of a building. Heights are rounded to centimetres, so a lower height would become zero.
_LOWEST_M = 0.01
# Outlines farther than this from the origin do not belong to the site.
FAR_M = 20_000.0

# Area of a site without a base: the part of the map within the first distance [m] of the first tower (east-west and
# north-south), and at least the second distance [m] around each tower.
_AROUND_M, _NEAR_TOWER_M = 2000.0, 500.0

# Smallest and largest number of elevations for a surface (its computing time grows with the cube of the number), and
# the standard deviation of an elevation [m].
_FEWEST_ELEVATIONS, _MOST_ELEVATIONS, _ELEVATION_SD_M = 3, 300, 1.0

# Coordinates are rounded to this grid [m].
_GRID_M = 0.001

# Areas narrower than this are drawing errors, and vertices closer than this to a straight line are removed.
_SLIVER_M = 0.3

_MINIMUM_AREA_M2 = 2.0
_SAME_HEIGHT_M = 0.25

# Height of a wood if the map does not state it: the mean LiDAR height of all forest stands at Lake Wheeler.
_DEFAULT_CANOPY_M = 20.0
# Share of evergreen trees by tag of OpenStreetMap.
_EVERGREEN = {"evergreen": 1.0, "needleleaved": 1.0, "mixed": 0.5}

# Margin of forests around the area of the site. Trees farther away do not shade any path.
_FOREST_MARGIN_M = 1000.0

# Smallest size of a tree or a wood. A smaller girth would be rounded to a trunk of 0.00 m in site.yaml.
_SMALLEST_SIZE_M = 0.05
# Largest plausible girth. The thickest known trunk has a girth of 42 m.
_WIDEST_GIRTH_M = 45.0
# Distance between the trees of a row without a tagged crown diameter. At this distance default crowns touch.
_ROW_SPACING_M = 10.0

_MAXIMUM_ROW_TREES = 10_000

# Number of outlines between two progress reports. On a slow machine, they take about a second.
_OUTLINES_PER_REPORT = 1000


@dataclass(slots=True)
class Footprints:
    """The elements of map files in the site frame, and the changes made to them.

    ``actions`` are sentences for the user; those that need a check begin with ``warning:``. ``credits`` name the
    sources of the data. ``assumed`` describes sizes that the maps do not state.

    Parameters
    ----------
    ground : list of (Position, float)
        Points of the maps with their elevation above sea level [m].
    """

    buildings: list[Building] = field(default_factory=list)
    forests: list[Forest] = field(default_factory=list)
    geofences: list[Geofence] = field(default_factory=list)
    trees: list[SingleTreeModel] = field(default_factory=list)
    ground: list[tuple[mapfiles.Position, float]] = field(default_factory=list)
    credits: list[str] = field(default_factory=list)
    assumed: str = ""
    actions: list[str] = field(default_factory=list)


@dataclass(slots=True)
class _Shape:
    """A projected outline before it becomes a record.

    Parameters
    ----------
    assumed : bool
        True if the map has neither height nor levels.
    """

    name: str
    source: str
    area: BaseGeometry
    height_m: float = 0.0
    stated: bool = False
    assumed: bool = False
    material: str = "concrete"
    part: bool = False
    evergreen: float = 0.0


def import_footprints(
    files: Sequence[str | Path],
    frame: SiteFrame,
    *,
    untagged: mapfiles.Kind | None = None,
    trees: bool = False,
    area_m: tuple[float, float, float, float] | None = None,
    progress: Progress = logged,
) -> Footprints:
    """Return the outlines of map files as records of the site.

    Parameters
    ----------
    files : sequence of paths
        GeoJSON, OSM XML, Overpass JSON, KML or KMZ, recognised by content.
    frame : SiteFrame
        Frame of the site.
    untagged : {"building", "forest", "geofence"}, optional
        Kind of areas without a known tag. By default a KML area is a geofence and other areas are skipped.
    trees : bool
        True if forests become single trees at random positions. By default they are media with a height.
    area_m : (east_min, east_max, north_min, north_max), optional
        Area of the site; forests are cut at a distance of :data:`_FOREST_MARGIN_M` around it.
    progress : Progress
        Receives the share of outlines that are read, for large maps.

    Returns
    -------
    Footprints

    Raises
    ------
    InputError
        If a file cannot be read or describes another place, coordinates are swapped, heights cannot be metres, or there
        is no area.
    UsageError
        If ``untagged`` is not a kind of area.
    """
    if untagged is not None and untagged not in get_args(mapfiles.Kind):
        raise UsageError(f"untagged areas as '{untagged}'", expected="one of " + ", ".join(get_args(mapfiles.Kind)))
    result = Footprints()
    shapes: dict[mapfiles.Kind, list[_Shape]] = {"building": [], "forest": [], "geofence": []}
    for path in files:
        content = mapfiles.read_map_file(path)
        result.actions += content.notes
        if content.credit and content.credit not in result.credits:
            result.credits.append(content.credit)
        with about_file(path):
            _check_place(content, frame)
            _sort(content, Path(path).name, frame, untagged, shapes, result.actions, progress)
        result.ground += content.ground
        for tree in content.trees:
            result.trees += _single_trees(tree, frame, result.actions)
    # inherit heights before duplicates are removed, because a part may inherit from a duplicate
    _inherit(shapes["building"], result.actions)
    _warn_of_feet(shapes["building"], result.actions)
    near = None if area_m is None else box(area_m[0], area_m[2], area_m[1], area_m[3]).buffer(_FOREST_MARGIN_M)
    shapes["forest"] = _cut_off(shapes["forest"], near, result.actions)
    canopy_m = None if trees else _DEFAULT_CANOPY_M
    _fill(result, shapes, canopy_m)
    if not (result.buildings or result.forests or result.geofences or result.trees):
        alone = f"{Path(files[0]).name}: " if len(files) == 1 else ""
        raise InputError(
            "no building, forest, geofence or tree found in " + ", ".join(Path(f).name for f in files),
            expected="areas tagged building, natural=wood or landuse=forest, or '--untagged building'",
            cause="; ".join(text.removeprefix("warning: ").removeprefix(alone) for text in result.actions[-3:])
            or "the map is empty",
        )
    return result


def _sort(
    content: mapfiles.MapFile,
    name: str,
    frame: SiteFrame,
    untagged: mapfiles.Kind | None,
    shapes: dict[mapfiles.Kind, list[_Shape]],
    actions: list[str],
    progress: Progress,
) -> None:
    """Add each outline of the file ``name`` to the shapes of its kind, and count outlines of unknown kind."""
    skipped: Counter[str] = Counter()
    for number, outline in enumerate(content.outlines, 1):
        if number % _OUTLINES_PER_REPORT == 0:
            progress(f"outlines of {name}", number / len(content.outlines))
        bare = untagged if mapfiles.main_tag(outline.tags) == "untagged" else None
        kind = mapfiles.kind_of(outline.tags) or bare or ("geofence" if content.kind == "KML" else None)
        if kind is None or (kind == "building" and mapfiles.below_ground(outline.tags)):
            skipped[mapfiles.main_tag(outline.tags) if kind is None else "building below the ground"] += 1
            continue
        actions += [f"{outline.source}: {problem}" for problem in dict.fromkeys(outline.broken)]
        if (
            kind == "geofence"
            and "height" in outline.tags
            and mapfiles.kind_of(outline.tags) is None
            and untagged is None
        ):
            text = f"an area {outline.tags['height']} m high without a tag: used as a geofence"
            actions.append(f"{outline.source}: {text}; '--untagged building' makes it a building")
        shape = _project(outline, frame, actions)
        if shape is not None:
            if kind == "building":
                _describe(shape, outline, actions)
            elif kind == "forest":
                _describe_wood(shape, outline.tags, actions)
            shapes[kind].append(shape)
    if skipped:
        listed = ", ".join(f"{count} {tag}" for tag, count in skipped.most_common(5))
        more = "" if len(skipped) <= 5 else f" and {counted(len(skipped) - 5, 'other tag')}"
        hint = "; '--untagged building' treats areas without tags as buildings" if skipped["untagged"] else ""
        actions.append(f"{name}: left out, no building or forest above the ground: {listed}{more}{hint}")


def _single_trees(tree: mapfiles.TreeLine, frame: SiteFrame, actions: list[str]) -> list[SingleTreeModel]:
    """Return a tree with its tagged sizes, or the trees of a row."""
    notes: list[str] = []
    height = _size(tree.tags, ("height", "est_height"), TALLEST_TREE_M, "a tree {:g} m high", notes)
    crown = _size(tree.tags, ("diameter_crown", "crown_diameter"), WIDEST_CROWN_M, "a crown {:g} m wide", notes)
    tags, written = dict(tree.tags), tree.tags.get("circumference", "").strip()
    # read a number without unit as centimetres if no tree reaches it in metres or feet
    if 3.3 * _WIDEST_GIRTH_M < (mapfiles.metres(f"{written} m") or 0.0) <= 100.0 * _WIDEST_GIRTH_M:
        notes.append(f"the circumference '{written}' is taken as centimetres")
        tags["circumference"] = f"{written} cm"
    girth = _size(tags, ("circumference",), _WIDEST_GIRTH_M, "a trunk {:g} m around", notes)
    points = np.stack(frame.to_local(*np.array(tree.positions, dtype=np.float64).reshape(-1, 2).T), axis=1)
    # a truncated position can project to infinity
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points) or float(np.hypot(*points.mean(axis=0))) > FAR_M:
        actions.append(f"{tree.source}: a tree is skipped, because it is not at the site")
        return []
    # a tree row is a line in the map
    if len(points) > 1:
        points = _along(points, crown or _ROW_SPACING_M)
        notes.append(f"{counted(len(points), 'tree')} placed along the row, {crown or _ROW_SPACING_M:g} m apart")
    actions += [f"{tree.source}: {note}" for note in notes]
    trunk = None if girth is None else girth / math.pi
    sizes = {"height_m": height, "crown_diameter_m": crown, "trunk_diameter_m": trunk}
    known = {name: round(size, 2) for name, size in sizes.items() if size is not None}
    return [SingleTreeModel(at_m=(round(east, 2), round(north, 2)), **known) for east, north in points.tolist()]


def _size(tags: Mapping[str, str], keys: tuple[str, ...], most_m: float, what: str, notes: list[str]) -> float | None:
    """Return a size of a tree or a wood [m]. A size that is too small or too large is noted and not used."""
    size = mapfiles.positive_metres(tags, keys, notes)
    if size is None or _SMALLEST_SIZE_M <= size <= most_m:
        return size
    notes.append(f"{what.format(size)} (feet or cm?); the site's default is used")
    return None


def _along(line_m: FloatArray, spacing_m: float) -> FloatArray:
    """Return points on a line (corners, 2) from its start to its end, about ``spacing_m`` apart, shape (n, 2)."""
    line = LineString(line_m)
    count = min(max(round(line.length / max(spacing_m, 0.5)), 1), _MAXIMUM_ROW_TREES)
    return np.asarray(shapely.get_coordinates(line.interpolate(np.linspace(0.0, 1.0, count + 1), normalized=True)))


def _cut_off(shapes: list[_Shape], near: Polygon | None, actions: list[str]) -> list[_Shape]:
    """Return forests without their parts outside ``near``, and report each larger loss in ``actions``."""
    near_shapes = []
    for shape in shapes:
        inside = shape.area if near is None else _areas_only(shape.area.intersection(near))
        # a loss of less than 0.1 % of the area is a rounding error and is not reported
        if inside.area < 0.999 * shape.area.area:
            lost = (shape.area.area - inside.area) / 1e4
            actions.append(
                f"{shape.source}: {lost:.0f} ha more than {_FOREST_MARGIN_M:g} m outside the site's area were cut away"
            )
            shape.area = inside
        if not inside.is_empty:
            near_shapes.append(shape)
    return near_shapes


def _fill(result: Footprints, shapes: dict[mapfiles.Kind, list[_Shape]], canopy_m: float | None) -> None:
    actions = result.actions
    buildings = _without_overlaps(_parts_first(_without_duplicates(shapes["building"], actions), actions), actions)
    # where woods overlap, use the first in the file, because woods have no heights to compare
    woods = _forests_without_overlaps(_without_duplicates(shapes["forest"], actions), actions)
    for name, shape, area in _parts(buildings, actions):
        result.buildings.append(
            Building(name, area, round(shape.height_m, 2), material=shape.material, source=shape.source)
        )
    for name, shape, area in _parts(woods, actions):
        wood = Forest(name, area, source=shape.source, evergreen_share=shape.evergreen)
        result.forests.append(
            # 0 means not stated
            wood if canopy_m is None else replace(wood, height_m=round(shape.height_m, 2) or canopy_m)
        )
    for name, _, area in _parts(shapes["geofence"], actions):
        result.geofences.append(Geofence(name, area))
    guesses = [_assumed_heights(buildings)]
    if canopy_m is None and result.forests:
        density = result.forests[0].trees_per_hectare
        guesses.append(f"trees assumed: {density:g} per hectare at random places in {counted(len(woods), 'wood')}")
    elif low := [shape for shape in woods if not shape.height_m]:
        guesses.append(
            f"height assumed: none in the map for {len(low)} of {counted(len(woods), 'wood')}, {canopy_m:g} m each"
        )
    result.assumed = "; ".join(filter(None, guesses))
    if result.assumed:
        actions.insert(0, result.assumed)


# ---------------------------------------------------------------- what an outline is, and where


def _check_place(content: mapfiles.MapFile, frame: SiteFrame) -> None:
    """Refuse a file whose outlines are all far away. The message reports if swapped coordinates would be near."""
    positions = [p for outline in content.outlines for outer, _ in outline.parts for p in outer]
    positions += [p for tree in content.trees for p in tree.positions]
    if not positions:
        return
    latitude, longitude = np.array(positions).T
    away = float(_distance_m(latitude, longitude, frame).min())
    # a single near outline is sufficient, because a map may extend beyond the site
    if away <= FAR_M:
        return
    spans = [abs(np.diff([p[1] for p in outer])).max(initial=0) for o in content.outlines for outer, _ in o.parts]
    found = "the positions are not latitudes and longitudes"
    if math.isfinite(away):
        found = f"the nearest position is {away / 1000:.0f} km from the site"
    causes = (
        *((_distance_m(*at, frame).min() <= FAR_M, cause) for cause, at in misread(latitude, longitude).items()),
        (max(spans, default=0) > 180, "the area crosses the antimeridian (180 deg)"),
        (not math.isfinite(away), "metres or feet instead of degrees"),
        (True, "a map of another place"),
    )
    raise InputError(
        f"{found} (latitude {latitude[0]:.5f}, longitude {longitude[0]:.5f})",
        expected=f"WGS84 degrees near the site's origin {frame.latitude_deg:.4f}, {frame.longitude_deg:.4f}, or a site "
        "where the map is: --base SITE, or --tower NAME=LATITUDE,LONGITUDE,HEIGHT of its antenna",
        cause=next(cause for holds, cause in causes if holds),
    )


def _distance_m(latitude: Any, longitude: Any, frame: SiteFrame) -> Any:
    """Return the approximate distance from the origin [m], or inf for an impossible position."""
    good = (np.abs(latitude) <= 90) & (np.abs(longitude) <= 180)
    # replace invalid values, because a damaged number may be as large as 1e306
    north = np.where(good, latitude, 0.0) - frame.latitude_deg
    # use the shorter way around the Earth
    turn = (np.where(good, longitude, 0.0) - frame.longitude_deg + 180) % 360 - 180
    east = turn * math.cos(math.radians(frame.latitude_deg))
    return np.where(good, 111_200 * np.hypot(north, east), np.inf)


def _project(outline: mapfiles.Outline, frame: SiteFrame, actions: list[str]) -> _Shape | None:
    """Return the valid outline in metres, or None and a line in ``actions`` if nothing remains."""
    areas, notes = [], []
    for outer, holes in outline.parts:
        # no outline spans half of the Earth, so a jump of more than 180 degrees means that it crosses the antimeridian
        if max(np.abs(np.diff([p[1] for p in outer])), default=0) > 180:
            notes.append("crosses the antimeridian; its parts were joined")
        ring = _ring(outer, frame)
        if ring is None:
            notes.append(_why_no_ring(outer))
            continue
        area = _repaired(ring, notes, "a self-crossing ring was repaired")
        inner = [shape for shape in (_ring(hole, frame) for hole in holes) if shape is not None]
        if len(inner) < len(holes):
            notes.append("a hole with fewer than 3 distinct points was left out")
        if inner:
            # join holes first, because overlapping holes would make the outline invalid
            without = shapely.union_all([_repaired(hole, notes, "a hole was repaired") for hole in inner])
            if not without.intersects(area):
                notes.append("a hole outside its outline was left out")
            area = area.difference(without)
            if area.is_empty:
                notes.append("its holes cover all of it")
        areas.append(area)
    actions += [f"{outline.source}: {note}" for note in dict.fromkeys(notes)]
    union = _areas_only(shapely.union_all(areas))
    if union.is_empty:
        actions.append(f"{outline.source}: left out, it has no area")
        return None
    if (away := math.hypot(union.centroid.x, union.centroid.y)) > FAR_M:
        first = np.array(outline.parts[0][0][0])
        swapped = _distance_m(first[1], first[0], frame) <= FAR_M
        hint = "; latitude and longitude are swapped" if swapped else ""
        actions.append(f"warning: {outline.source}: left out, it lies {away / 1000:.0f} km from the site{hint}")
        return None
    return _Shape(outline.name, outline.source, union, part=mapfiles.is_part(outline.tags))


def _why_no_ring(positions: Sequence[mapfiles.Position]) -> str:
    for latitude, longitude in positions:
        if abs(latitude) > 90 or abs(longitude) > 540:
            return (
                f"an outer ring with latitude {latitude:g}, longitude {longitude:g} was left out; "
                "metres or feet in place of degrees"
            )
    return "an outer ring with fewer than 3 distinct points was left out"


def _ring(positions: Sequence[mapfiles.Position], frame: SiteFrame) -> Polygon | None:
    # rings repeat their first point, and some files repeat all points
    if len(set(positions)) < 3:
        return None
    latitude, longitude = np.array(positions).T
    east, north = frame.to_local(latitude, longitude)
    points = np.column_stack([east, north])
    return Polygon(points[np.isfinite(points).all(axis=1)]) if np.isfinite(points).all(axis=1).sum() >= 3 else None


def _repaired(ring: Polygon, notes: list[str], note: str) -> BaseGeometry:
    if ring.is_valid:
        return ring
    if mapfiles.is_tangled(ring):
        notes.append(f"a ring that crosses itself at more than {mapfiles.MAX_CROSSINGS} places is skipped")
        return Polygon()
    notes.append(f"{note} ({shapely.is_valid_reason(ring).split('[')[0].lower()})")
    # "structure" retains areas that a ring encloses twice; "linework" would turn them into holes
    return _areas_only(shapely.make_valid(ring, method="structure"))


def _areas_only(shape: BaseGeometry) -> BaseGeometry:
    return MultiPolygon([part for part in shapely.get_parts(shape, return_index=False) if isinstance(part, Polygon)])


# ---------------------------------------------------------------- heights and materials


def _describe(shape: _Shape, outline: mapfiles.Outline, actions: list[str]) -> None:
    # shapefiles write the names of their columns in capitals
    tags = {key.lower(): value for key, value in outline.tags.items()}
    notes: list[str] = []
    height = mapfiles.height_of(tags, notes)
    levels = mapfiles.levels_of(tags, notes)
    if height is not None and not _LOWEST_M <= height <= TALLEST_M:
        notes.append(f"a height of {height:g} m is implausible (feet or cm?)")
        height = None
    if levels and levels * _LEVEL_M > TALLEST_M:
        notes.append(f"{levels:g} levels are more than any building has")
        levels = None
    shape.stated, shape.assumed = height is not None, height is None and not levels
    if height is None:
        height = levels * _LEVEL_M if levels else _DEFAULT_HEIGHT_M
        notes = [f"{note}; it is drawn {height:g} m high" for note in notes]
    lowest = tags.get("min_height", tags.get("building:min_level", tags.get("min_level", "0")))
    if (mapfiles.metres(lowest) or 0.0) > 0:
        notes.append("it begins above the ground (min_height, min_level), but is drawn from the ground up")
    actions += [f"{shape.source}: {note}" for note in notes]
    shape.height_m = height
    shape.material = mapfiles.material_of(tags)
    # a metre is 3.28 feet, so a height of about 3.28 times the levels is probably in feet
    if height > 2 * _LEVEL_M and levels and 2.7 <= height / (levels * _LEVEL_M) <= 4.5:
        shape.stated = False  # counted by _warn_of_feet
        actions.append(f"warning: {shape.source}: {height:g} m for {levels:g} levels; are these feet?")


def _inherit(shapes: list[_Shape], actions: list[str]) -> None:
    """Give parts without a height the height of the building whose outline contains them."""
    # use only complete buildings with a stated height
    known = [shape for shape in shapes if not (shape.part or shape.assumed)]
    tree = shapely.STRtree([shape.area for shape in known])
    for part in (shape for shape in shapes if shape.part and shape.assumed):
        around = [known[int(i)] for i in tree.query(part.area.representative_point(), predicate="within")]
        if around:
            part.height_m, part.assumed = around[0].height_m, False
            actions.append(f"{part.source}: no height; as high as {around[0].source}, {part.height_m:g} m")


def _assumed_heights(shapes: list[_Shape]) -> str:
    """Return one line about buildings whose height is not in any map."""
    assumed = [shape for shape in shapes if shape.assumed]
    if not assumed:
        return ""
    heights = " and ".join(f"{height:g} m" for height in sorted({shape.height_m for shape in assumed}))
    named = ", ".join(shape.name for shape in assumed[:5]) + ("" if len(assumed) <= 5 else ", ...")
    of = counted(len(shapes), "building")
    return f"height assumed: none in the map for {len(assumed)} of {of}, {heights} each: {named}"


def _describe_wood(shape: _Shape, tags: Mapping[str, str], actions: list[str]) -> None:
    notes: list[str] = []
    shape.height_m = _size(tags, ("height", "est_height"), TALLEST_TREE_M, "a wood {:g} m high", notes) or 0.0
    shape.evergreen = max(_EVERGREEN.get(tags.get(key, ""), 0.0) for key in ("leaf_type", "leaf_cycle"))
    actions += [f"{shape.source}: {note}" for note in notes]


def _warn_of_feet(shapes: list[_Shape], actions: list[str]) -> None:
    """Warn if the median stated height is above 20 m, because the map is then probably in feet."""
    stated = [shape.height_m for shape in shapes if shape.stated]
    if len(stated) >= 3 and float(np.median(stated)) > 20 and max(shape.area.area for shape in shapes) < 50_000:
        actions.append(
            f"warning: the median stated height of {len(stated)} buildings is {np.median(stated):.0f} m; "
            "if the file is in feet, give the heights a unit ('20 ft')"
        )


# ---------------------------------------------------------------- cleaning


def _without_duplicates(shapes: list[_Shape], actions: list[str]) -> list[_Shape]:
    """Drop outlines that cover the same ground as an earlier outline. A stated height is retained."""
    tree = shapely.STRtree([shape.area for shape in shapes])
    duplicates: set[int] = set()
    for i, shape in enumerate(shapes):
        if i in duplicates:
            continue
        for j in sorted(int(k) for k in tree.query(shape.area) if k > i and int(k) not in duplicates):
            other = shapes[j]
            # compare sizes first, because an intersection is slow
            ratio = shape.area.area / max(other.area.area, 1e-9)
            alike = shape.part == other.part and 0.98 < ratio < 1.02
            if not (alike and shape.area.intersection(other.area).area > 0.98 * shape.area.area):
                continue
            duplicates.add(j)
            actions.append(f"{other.source}: left out, it repeats {shape.source}")
            if other.stated and not shape.stated:
                shape.height_m, shape.stated, shape.assumed = other.height_m, True, False
    return [shape for i, shape in enumerate(shapes) if i not in duplicates]


def _groups(shapes: list[_Shape]) -> list[list[_Shape]]:
    """Return sets of shapes whose areas overlap, directly or through other shapes."""
    if not shapes:
        return []
    areas = np.array([shape.area for shape in shapes], dtype=object)
    first, second = shapely.STRtree(areas).query(areas, predicate="intersects")
    # ignore tiny overlaps: neighbours share a wall, with rounding errors along it
    overlap = shapely.area(shapely.intersection(areas[first], areas[second])) > 0.01
    pairs = coo_array((overlap[overlap], (first[overlap], second[overlap])), shape=(len(shapes), len(shapes)))
    groups = connected_components(pairs, directed=False)[1].tolist()
    return list(lists_by_key(zip(groups, shapes, strict=True)).values())


def _parts_first(shapes: list[_Shape], actions: list[str]) -> list[_Shape]:
    """Return outlines with their building parts cut out, because parts have more accurate heights than the outline."""
    parts = [shape for shape in shapes if shape.part]
    if not parts:
        return shapes
    tree, disjoint = shapely.STRtree([shape.area for shape in parts]), []
    for shape in shapes:
        inside = [] if shape.part else [parts[int(i)].area for i in tree.query(shape.area, predicate="intersects")]
        remainder = _areas_only(shape.area.difference(shapely.union_all(inside))) if inside else shape.area
        if remainder.area < 0.98 * shape.area.area:
            actions.append(f"{shape.source}: replaced by its mapped parts")
            shape.area = remainder
        if not remainder.is_empty:
            disjoint.append(shape)
    return disjoint


def _without_overlaps(shapes: list[_Shape], actions: list[str]) -> list[_Shape]:
    """Return disjoint shapes: join shapes of equal height and material, and cut lower shapes below higher shapes."""
    disjoint: list[_Shape] = []
    for group in _groups(shapes):
        disjoint += group if len(group) == 1 else _higher_first(group, actions)
    return disjoint


def _higher_first(group: list[_Shape], actions: list[str]) -> list[_Shape]:
    disjoint: list[_Shape] = []
    # begin with the highest shape, because parts of other shapes below it are not visible
    for shape in sorted(group, key=lambda shape: -shape.height_m):
        over = [higher for higher in disjoint if higher.area.intersects(shape.area)]
        free = _areas_only(shape.area.difference(shapely.union_all([higher.area for higher in over])))
        same = next((higher for higher in over if _same_kind(higher, shape)), None)
        if free.is_empty:
            actions.append(f"{shape.source}: left out, it lies inside buildings at least as high")
        elif same is not None:
            same.area = _areas_only(same.area.union(free))
            actions.append(f"{shape.source}: overlaps {same.source} at the same height; they were merged")
        else:
            if shape.area.area - free.area > 0.01:
                actions.append(f"{shape.source}: the part under a higher building was cut away")
            shape.area = free
            disjoint.append(shape)
    return disjoint


def _same_kind(first: _Shape, second: _Shape) -> bool:
    return abs(first.height_m - second.height_m) <= _SAME_HEIGHT_M and first.material == second.material


def _forests_without_overlaps(shapes: list[_Shape], actions: list[str]) -> list[_Shape]:
    """Return forests without overlaps, which would double the density of trees."""
    disjoint: list[_Shape] = []
    for group in _groups(shapes):
        covered: BaseGeometry = Polygon()
        for shape in group:
            free = _areas_only(shape.area.difference(covered))
            if free.area < 0.999 * shape.area.area:
                actions.append(f"{shape.source}: the part inside another forest was cut away")
            covered = covered.union(shape.area)
            if not free.is_empty:
                disjoint.append(replace(shape, area=free))
    return disjoint


def _parts(shapes: list[_Shape], actions: list[str]) -> list[tuple[str, _Shape, Polygon]]:
    """Return single polygons with unique names, without slivers and redundant vertices."""
    parts: list[tuple[str, _Shape, Polygon]] = []
    used: set[str] = set()
    for shape in shapes:
        # round to the precision of site.yaml here, because a ring whose coordinates are rounded later can cross itself
        for part in shapely.get_parts(_areas_only(shapely.set_precision(shape.area, _GRID_M))):
            plain = part.simplify(_SLIVER_M / 2)
            plain = plain if isinstance(plain, Polygon) and plain.is_valid and not plain.is_empty else part
            plain = Polygon(
                plain.exterior, [hole for hole in plain.interiors if Polygon(hole).area >= _MINIMUM_AREA_M2]
            )
            if plain.area < _MINIMUM_AREA_M2 or plain.buffer(-_SLIVER_M / 2).is_empty:
                actions.append(f"{shape.source}: a sliver of {part.area:.1f} m2 was left out")
                continue
            name, number = shape.name, 1
            while name in used:
                number += 1
                name = f"{shape.name} ({number})"
            used.add(name)
            parts.append((name, shape, shapely.normalize(plain)))
    return parts


# ---------------------------------------------------------------- site.yaml


def import_site(
    files: Sequence[str | Path],
    *,
    base: str | Path | None = None,
    towers: Sequence[str] = (),
    dem: str | Path | None = None,
    dem_crs: str | None = None,
    **options: Any,
) -> tuple[SiteModel, list[str]]:
    """Return a site whose buildings, woods and geofences come from map files.

    Parameters
    ----------
    files : sequence of paths
        Map files.
    base : str or path, optional
        Packaged site or site.yaml that provides towers and settings. Without ``towers``, the default is Lake Wheeler if
        the map is of that area.
    towers : sequence of str
        ``NAME=LATITUDE,LONGITUDE,HEIGHT``: antennas [deg, deg, m above the ground]. These towers replace the towers of
        ``base``. Without a base, the first tower is the origin. If the map has three or more elevations (tag ``ele``),
        the ground is then a smooth surface through them. Otherwise it is flat.
    dem : str or path, optional
        Elevation model of the ground, heights above sea level. This model replaces the elevation model of ``base``.
    dem_crs : str, optional
        Coordinate system of ``dem``, for ASCII grids.
    **options
        For :func:`import_footprints`.

    Returns
    -------
    SiteModel, list of str
        The settings (see :func:`site_yaml`), and the list of actions.

    Raises
    ------
    UsageError
        If no file or no tower is known, a tower is not ``NAME=LATITUDE,LONGITUDE,HEIGHT``, or elevations contradict
        each other.
    InputError
        If the map or the elevation model cannot be read, or is not at the site.
    """
    if not files:
        raise UsageError("no map file named", expected="GeoJSON, OSM XML, Overpass JSON, KML or KMZ files")
    content: dict[str, Any] = {"name": Path(files[0]).stem, "trees": {}}
    area_m = (-_AROUND_M, _AROUND_M, -_AROUND_M, _AROUND_M)
    named_towers = _named_towers(towers)
    if towers and base is None:
        first = next(iter(named_towers.values()))
        frame = SiteFrame(first["latitude_deg"], first["longitude_deg"])
        content["origin"] = {"latitude_deg": frame.latitude_deg, "longitude_deg": frame.longitude_deg}
    else:
        base = base or "lake_wheeler"
        model = site_model(base)
        frame = SiteFrame(model.origin.latitude_deg, model.origin.longitude_deg)
        content, area_m = model.model_dump(), extent_m(model, frame)
        if model.dem is not None:  # the path must be valid in another folder
            content["dem"]["path"] = str((Path(base).parent / model.dem.path).resolve())
    content |= {"towers": named_towers} if towers else {}
    if dem is not None:
        content |= {"dem": {"path": str(Path(dem).resolve()), "crs": dem_crs}, "tower_ground": None}
    imports = import_footprints(files, frame, area_m=area_m, **options)
    about = [] if base is not None else _around_towers(content, imports, frame)
    actions = _from_maps(content, imports)
    model = SiteModel.model_validate(content)
    site = build_site(model)  # raises an error if elevations or towers are elsewhere
    actions += [f"warning: {text}" for text in site.cautions()]
    return model, [*(about or [_kept_of_base(model, str(base))]), *actions]


def _around_towers(content: dict[str, Any], imports: Footprints, frame: SiteFrame) -> list[str]:
    """Set area and ground of a site without a base, and return the sentences about them."""
    first, *_ = towers = content["towers"]
    positions = [Point(*frame.to_local(tower["latitude_deg"], tower["longitude_deg"])) for tower in towers.values()]
    reach = box(-_AROUND_M, -_AROUND_M, _AROUND_M, _AROUND_M)
    shapes = [item.footprint for item in imports.buildings] + [item.area for item in imports.forests]
    mapped = shapely.intersection(shapes, reach)
    # a tower farther away is a typing error, which build_site reports
    around = [place.buffer(_NEAR_TOWER_M) for place in positions if place.distance(positions[0]) <= FAR_M]
    west, south, east, north = shapely.total_bounds([*mapped, *around])
    area = content["area_m"] = [math.floor(west), math.ceil(east), math.floor(south), math.ceil(north)]
    known = [[round(float(value), 2) for value in (*frame.to_local(*place), height_m, _ELEVATION_SD_M)]
             for place, height_m in imports.ground if reach.contains(Point(frame.to_local(*place)))]  # fmt: skip
    ground = "flat (the map has fewer than three elevations; --dem FILE names an elevation model)"
    if "dem" in content:
        ground = f"the elevation model {content['dem']['path']}, whose heights are above sea level (dem.reference)"
    elif len(known) >= _FEWEST_ELEVATIONS:
        content |= {"ground_points": known[:: 1 + len(known) // _MOST_ELEVATIONS], "tower_ground": "surface"}
        ground = f"a smooth surface through {len(content['ground_points'])} elevations of the map (tag ele)"
    material = SiteModel.model_fields["ground_material"].default
    about = (
        f"the origin is tower {first}; the ground is {ground}, of {material}; the area is {area[1] - area[0]} m x "
        f"{area[3] - area[2]} m: the map within {_AROUND_M / 1000:g} km of the origin. Change them in the file"
    )
    if shapely.area(mapped).any() or not shapes:
        return [about]
    away_km = min(shape.distance(positions[0]) for shape in shapes) / 1000
    return [about, f"warning: no building or wood within {_AROUND_M / 1000:g} km of tower {first}; the nearest is "
                   f"{away_km:.1f} km away. Is the position of the tower right?"]  # fmt: skip


def name_and_value(text: str, option: str, example: str) -> tuple[str, str]:
    """Return name and value of an option of the form ``NAME=VALUE``. UsageError if either is missing."""
    name, mark, value = text.partition("=")
    if not (mark and name.strip() and value):
        raise UsageError(f"{option} '{text}'", expected=f"{option} {example}")
    return name.strip(), value


def numbers_of(text: str, counts: tuple[int, ...], what: str, expected: str) -> list[float]:
    """Return numbers that are separated by commas.

    Parameters
    ----------
    text : str
        The value of an option.
    counts : tuple of int
        Allowed counts of numbers.
    what, expected : str
        The option, and its form, for the message.

    Returns
    -------
    list of float

    Raises
    ------
    UsageError
        If a part is not a number, or another count is given.
    """
    try:
        values = [float(word) for word in text.split(",")]
    except ValueError:
        values = []
    if len(values) not in counts:
        cause = "degrees and minutes, a unit or a decimal comma" if re.search(r"\d", text) else None
        raise UsageError(f"{what} '{text}'", expected=expected, cause=cause)
    return values


def numbers_of_towers(towers: Sequence[str], form: str) -> dict[str, list[float]]:
    """Return the three numbers of each ``NAME=A,B,C`` of ``--tower`` by name. UsageError for a repeated name."""
    by_name: dict[str, list[float]] = {}
    for text in towers:
        name, place = name_and_value(text, "--tower", form)
        if name in by_name:
            raise UsageError(f"--tower '{text}'", expected="another name", cause=f"two towers named '{name}'")
        by_name[name] = numbers_of(place, (3,), f"--tower {name}", f"--tower {form}")
    return by_name


def _named_towers(towers: Sequence[str]) -> dict[str, dict[str, float]]:
    """Return towers by name from ``NAME=LATITUDE,LONGITUDE,HEIGHT``."""
    form = "NAME=LATITUDE,LONGITUDE,HEIGHT, such as --tower roof=40.009,-105.267,25 [deg, deg, m above ground]"
    by_name: dict[str, dict[str, float]] = {}
    for name, (latitude, longitude, height) in numbers_of_towers(towers, form).items():
        cause = "longitude before latitude, or not in degrees" if abs(latitude) > 90 or abs(longitude) > 180 else None
        if not 0 < height <= TALLEST_M:
            cause = f"a height outside 0 to {TALLEST_M:g} m"
        if cause is not None:
            found = f"--tower {name} at {latitude:g}, {longitude:g}, {height:g} m"
            raise UsageError(found, expected=f"--tower {form}", cause=cause)
        by_name[name] = {"latitude_deg": latitude, "longitude_deg": longitude, "antenna_height_m": height}
    return by_name


def _from_maps(content: dict[str, Any], imports: Footprints) -> list[str]:
    """Replace the outlines and trees of the base with the contents of maps, and return the actions."""
    content |= {
        "buildings": [
            _outline_dict(b.name, b.footprint) | {"height_m": b.height_m, "material": b.material, "source": b.source}
            for b in imports.buildings
        ],
        "forests": [
            _outline_dict(f.name, f.area)
            | {"trees_per_hectare": f.trees_per_hectare, "minimum_spacing_m": f.minimum_spacing_m, "source": f.source}
            | {"height_m": f.height_m, "evergreen_share": f.evergreen_share}
            for f in imports.forests
        ],
        "geofences": [_outline_dict(g.name, g.area) for g in imports.geofences],
        "credit": "; ".join(imports.credits),
        "assumed": imports.assumed,
    }
    content["trees"] |= {"single": imports.trees}
    return imports.actions


def _kept_of_base(model: SiteModel, base: str | Path) -> str:
    """Return the sentence about data of the base that an import retains."""
    origin = f"{model.origin.latitude_deg:.6f}, {model.origin.longitude_deg:.6f}"
    ground = "flat ground" if model.dem is None else f"the elevation model {model.dem.path}"
    return (
        f"kept from the base '{base}': the name '{model.name}', the origin {origin}, the towers "
        f"{', '.join(model.towers)} with their positions and antennas, {ground} of {model.ground_material}, tree "
        "sizes. Change them in the file, or name another base with --base"
    )


def _outline_dict(name: str, area: Polygon) -> dict[str, Any]:
    """Return name and polygon in the form of site.yaml."""

    def ring(line: Any) -> list[tuple[float, float]]:
        return [(round(float(x), 3), round(float(y), 3)) for x, y in list(line.coords)[:-1]]

    return {"name": name, "polygon_m": ring(area.exterior), "holes_m": [ring(hole) for hole in area.interiors]}


def site_yaml(model: SiteModel, *, header: Sequence[str] = ()) -> str:
    """Return the text of a site.yaml that :func:`~aerpaw_cmp.site.siteyaml.load_site` reads as the same site.

    ``header`` lines become comments at the top, such as the actions of an import.
    """
    content = model.model_dump(mode="json", exclude_defaults=True)
    # YAML refuses control characters even in comments
    text = "".join(f"# {one_line(line)}\n" for entry in header for line in str(entry).splitlines())
    return text + dump_yaml(content)
