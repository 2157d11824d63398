"""Routes of an aircraft, read from a plan, a map, a table of waypoints, or the log of an earlier flight.

=====================  ============================================================================================
file                   source of heights above take-off
=====================  ============================================================================================
QGroundControl `.plan`  the frame of each item: relative, or sea level minus that of the planned home position
`QGC WPL 110` text      the frame of each line: relative, or sea level minus that of line 0, the home
KML                     ``relativeToGround``; ``absolute`` minus that of the first point, with a remark
CSV                     the column: above take-off (a column of heights above sea level is refused); feet become metres
a log with positions    the reader of the log
=====================  ============================================================================================
"""

from __future__ import annotations

import csv
import io
import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import numpy as np

from ..common import kml
from ..common.errors import InputError, parsing
from ..common.kml import named, outermost, plain_tag, xml_root
from ..common.text import counted
from ..logs import dictionary
from ..logs.ingest import as_utf8, read_bytes, read_file, sniffers_of
from ..logs.readers import HEAD_BYTES, ReadOptions, claims
from ..site.mapfiles import main_kml

if TYPE_CHECKING:
    import pandas as pd

# Columns of a route: altitude above take-off, yaw clockwise from north, time since the first point (NaN for a plan).
COLUMNS = ("latitude_deg", "longitude_deg", "altitude_m", "yaw_deg", "time_s")

_SEA_LEVEL_FRAMES, _RELATIVE_FRAMES, _TERRAIN_FRAMES = (0, 5), (3, 6), (10, 11)
_WAYPOINTS = (16, 17, 18, 19, 31, 82)
_TAKEOFFS, _LANDINGS, _TURN, _RETURN = (22, 84), (21, 85), 115, 20
_ARDUPILOT = 3


# Largest number of points of a route or table, and largest size of its file. A larger file is a log or a mistake, and
# is refused before all of it is in memory.
MOST_POINTS = 2_000_000
MOST_BYTES = 256 << 20


def too_many_points(path: str | Path | None = None) -> InputError:
    """Return the error for a file of more than :data:`MOST_POINTS` points."""
    return InputError(
        f"more than {MOST_POINTS} points",
        expected=f"at most {MOST_POINTS} points",
        cause="too fine a grid, or a point for each sample of a receiver; thin it out",
        path=path,
    )


def read_route(path: str | Path, *, height_m: float | None = None) -> pd.DataFrame:
    """Return the points of a route, one row each, in the order of flight.

    Parameters
    ----------
    path : str or Path
        A QGroundControl plan, ``QGC WPL`` waypoints, a KML with a line or points, a CSV with named columns, or any
        log with positions.
    height_m : float, optional
        Height above take-off for points that have no height.

    Returns
    -------
    pandas.DataFrame
        :data:`COLUMNS`, with NaN for an unknown yaw. ``attrs["remarks"]`` is a list of sentences for the user.

    Raises
    ------
    InputError
        If the file is not a route, or points have no height and ``height_m`` is not given.
    """
    with parsing(path, _EXPECTED):
        place = Path(path)
        if place.is_file() and place.stat().st_size > MOST_BYTES:
            # log readers read a large file in pieces
            if not sniffers_of(place):
                raise InputError(
                    f"the file has {place.stat().st_size} bytes",
                    expected=f"at most {MOST_POINTS} points and {MOST_BYTES} bytes",
                    cause="not a route, or a point for each sample of a receiver; thin it out",
                )
            return _table(_log(path), height_m)
        return _table(_route(as_utf8(read_bytes(path)[0]), path), height_m)


@dataclass(slots=True)
class _Route:
    """The points of a route: latitude, longitude, height, yaw and seconds, NaN if unknown."""

    points: list[tuple[float, float, float, float, float]] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)

    def add(self, latitude: float, longitude: float, height: float = math.nan, yaw: float = math.nan) -> None:
        if len(self.points) >= MOST_POINTS:
            raise too_many_points()
        self.points.append((latitude, longitude, height, yaw, math.nan))

    def remark(self, text: str) -> None:
        if text not in self.remarks:
            self.remarks.append(text)


def _route(data: bytes, path: str | Path) -> _Route:
    head = data[:HEAD_BYTES]
    # try a plan before the log readers, because a log reader might accept its JSON
    if re.match(rb"\s*\{", head) and b'"fileType"' in data[: 1 << 20]:
        return _plan(data, path)
    if re.match(rb"\s*QGC WPL \d+", head):
        return _waypoint_text(data.decode("utf-8", "replace"))
    if any(reader.kinds for reader in claims(data)):
        return _log(path)
    if data.startswith(b"PK\x03\x04"):
        data = main_kml(data, path)
    if kml.is_kml(data):
        return _kml(data)
    if b"\0" in head:
        raise InputError("binary content that is not a route", expected=_EXPECTED)
    return _sheet(data)


_EXPECTED = "a QGroundControl .plan, QGC WPL waypoints, a KML or KMZ with a line, a CSV with lat, lon, alt, or a log"


def _table(route: _Route, height_m: float | None) -> pd.DataFrame:
    import pandas as pd

    if not route.points:
        raise InputError("the route has no point", expected=_EXPECTED)
    table: pd.DataFrame = pd.DataFrame(np.array(route.points, dtype=np.float64), columns=list(COLUMNS))
    bad = ~(table["latitude_deg"].between(-90, 90) & table["longitude_deg"].between(-180, 180))
    if bad.any():
        first = int(np.flatnonzero(bad)[0])
        place = f"point {first + 1} lies at {table['latitude_deg'][first]:g}, {table['longitude_deg'][first]:g}"
        raise InputError(place, expected="latitude and longitude in degrees", cause="swapped columns, or radians")
    silent = table["altitude_m"].isna()
    if silent.any():
        if height_m is None:
            place = f"{int(silent.sum())} of {counted(len(table), 'point')} without a height"
            raise InputError(place, expected="heights above take-off in the file, or one height for all points")
        table["altitude_m"] = table["altitude_m"].fillna(height_m)
        route.remark(f"{int(silent.sum())} of {counted(len(table), 'point')} without a height: {height_m:g} m is used.")
    # some programs write headings from -180 to 180, others from 0 to 360
    table["yaw_deg"] = table["yaw_deg"] % 360.0
    table.attrs["remarks"] = list(route.remarks)
    return table


def _log(path: str | Path) -> _Route:
    """Return the track of a log."""
    # pass an arbitrary zone and origin, because a route has no date
    file = read_file(path, options=ReadOptions(timezone="UTC", time_origin="2000-01-01T00:00:00"))
    tracks = [stream for stream in file.result.streams if "latitude_deg" in stream.frame.columns]
    if not tracks:
        raise InputError(f"a log of {file.result.reader!r} without positions", expected=_EXPECTED)
    # prefer telemetry to positions in a radio log
    track = max(tracks, key=lambda stream: (stream.kind == "telemetry", len(stream.frame)))
    frame = track.frame[track.frame["latitude_deg"].notna()]
    route = _Route(remarks=[str(text) for text in file.result.warnings])
    seconds = (frame["time"] - frame["time"].iloc[:1].min()).dt.total_seconds()
    columns = [frame[name] if name in frame.columns else [math.nan] * len(frame) for name in COLUMNS[:4]]
    route.points = list(zip(*columns, seconds, strict=True))
    return route


# --- QGroundControl and Mission Planner --------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Item:
    """A mission item: MAVLink command and frame, its four parameters, latitude, longitude, altitude."""

    command: int
    frame: int
    numbers: tuple[float, ...]


def _plan(data: bytes, path: str | Path) -> _Route:
    with parsing(path, "a mission with items", "a damaged QGroundControl plan", any_shape=True):
        mission = json.loads(data)["mission"]
        home = _numbers(mission.get("plannedHomePosition") or ())
        items = list(_items(mission["items"]))
    route = _Route()
    _fly(route, items, home, named_yaw=mission.get("firmwareType") != _ARDUPILOT)
    return route


def _items(listed: Sequence[Any]) -> Iterator[_Item]:
    """Yield simple items in the order of flight, including those of surveys."""
    for entry in listed:
        if entry.get("type") == "ComplexItem":
            inner = entry.get("TransectStyleComplexItem", entry).get("Items", ())
            if not inner:
                kind = entry.get("complexItemType", "complex item")
                raise InputError(f"a {kind} without its items", expected="a plan saved by QGroundControl 3.4 or later")
            yield from _items(inner)
        else:
            yield _Item(int(entry["command"]), int(entry.get("frame", 3)), _numbers(entry["params"], 7))


def _numbers(values: Sequence[Any], count: int = 0) -> tuple[float, ...]:
    """Return numbers, with NaN for null."""
    numbers = tuple(math.nan if value is None else float(value) for value in values)
    return numbers + (math.nan,) * (count - len(numbers))


def _waypoint_text(text: str) -> _Route:
    route, items = _Route(), []
    home: tuple[float, ...] = ()
    for number, line in enumerate(text.splitlines()[1:], start=2):
        cells = line.split()
        if not cells or line.startswith("#"):
            continue
        try:
            index, command, frame = int(cells[0]), int(cells[3]), int(cells[2])
            values = _numbers(cells[4:11], 7)
        except (ValueError, IndexError) as error:
            raise InputError(f"no waypoint: {line[:60]!r}", expected="12 fields", line=number) from error
        # line 0 of a waypoint file is home, with any command
        if index == 0:
            home = values[4:7]
        else:
            items.append(_Item(command, frame, values))
    _fly(route, items, home, named_yaw=False)
    return route


def _fly(route: _Route, items: Sequence[_Item], home: tuple[float, ...], *, named_yaw: bool) -> None:
    """Add the points of a mission.

    Parameters
    ----------
    route : _Route
    items : sequence of _Item
    home : tuple of float
        Latitude, longitude and altitude above sea level of the planned take-off. The tuple may be empty.
    named_yaw : bool
        True if the fourth parameter of a waypoint is its yaw; ArduPilot ignores it.
    """
    # a take-off without coordinates happens at home
    place = home[:2] if len(home) > 1 else (math.nan, math.nan)
    for item in items:
        latitude, longitude, height = item.numbers[4:7]
        if item.command == _TURN and route.points:
            _turn(route, item)
        if item.command == _RETURN:
            route.remark("The return to the take-off at the end is ignored.")
        if not (latitude or longitude) or math.isnan(latitude):  # 0, 0 or null: the current position
            latitude, longitude = place
        if item.command not in (*_WAYPOINTS, *_TAKEOFFS, *_LANDINGS) or math.isnan(latitude):
            continue
        place = latitude, longitude
        yaw = item.numbers[3] if named_yaw else math.nan
        route.add(latitude, longitude, _height(route, item, height, home), yaw)


def _turn(route: _Route, item: _Item) -> None:
    """Set the yaw of the last point by CONDITION_YAW."""
    degrees, direction, relative = item.numbers[0], item.numbers[2], item.numbers[3]
    if relative == 1:
        route.remark("Turns relative to the course are ignored.")
    # valid directions are -1, 0 and 1; other values are a parameter of another program
    elif math.isfinite(degrees) and abs(direction) <= 1:
        route.points[-1] = (*route.points[-1][:3], degrees, math.nan)


def _height(route: _Route, item: _Item, height: float, home: tuple[float, ...]) -> float:
    # a landing ends on the ground, regardless of the altitude in its item
    if item.command in _LANDINGS:
        return 0.0
    if item.frame in _SEA_LEVEL_FRAMES:
        if len(home) < 3 or math.isnan(home[2]) or home[2] == 0.0:  # 0 means that the value was not set
            raise InputError(
                f"a waypoint {height:g} m above sea level, and a home position without an altitude",
                expected="heights above take-off, or the ground's height at the planned home position",
                cause="the home position was not set: set it in the planning program and save again",
            )
        return height - home[2]
    if item.frame in _TERRAIN_FRAMES:
        route.remark("Heights above the ground below each point are used as heights above take-off.")
    elif item.frame not in _RELATIVE_FRAMES:
        raise InputError(f"a waypoint in MAVLink frame {item.frame}", expected="frames 0, 3, 5, 6, 10 or 11")
    return height


# --- KML ---------------------------------------------------------------------------------------------

# A line begins on the ground if its first point is at least this far below its highest point [m].
_CLIMB_M = 5.0

_HEADING = re.compile(r"\s*(-?\d+(?:\.\d*)?)")


def _root(data: bytes) -> ElementTree.Element:
    """Return the root of a document in UTF-8. An encoding that the document declares is ignored."""
    return xml_root(re.sub(rb"\A\s*<\?xml.*?\?>", b"", data, flags=re.DOTALL), None, "a plain KML")


def _kml(data: bytes) -> _Route:
    """Return the lines and tracks of a map, or its points in the order of the file if it has no line."""
    root = _root(data)
    shapes = list(outermost(root, {"LineString", "Point", "Track"}))
    lines = [shape for shape in shapes if plain_tag(shape.tag) != "Point"]
    if not lines and len(shapes) < 2:
        what = "a geofence, which has only areas" if any(named(root, "Polygon")) else "a map without a line"
        raise InputError(f"not a route: {what}", expected="a KML with a line (LineString, gx:Track) or points")
    route, sea_level = _Route(), False
    if len(lines) > 1:
        route.remark(f"{len(lines)} lines are flown one after the other.")
    for shape in lines or shapes:
        modes = kml.modes_of(shape)
        sea_level |= "absolute" in modes
        # KML clamps to the ground by default: a 0 in drawn lines is then not a height
        clamped = not modes or any(mode.startswith("clamp") for mode in modes)
        headings = [float(m[1]) for angles in named(shape, "angles") if (m := _HEADING.match(str(angles.text or "")))]
        for index, place in enumerate(kml.places_of(shape)):
            yaw = headings[index] if index < len(headings) else math.nan
            height = math.nan if len(place) < 3 or (clamped and place[2] == 0.0) else place[2]
            route.add(place[1], place[0], height, yaw)
    if sea_level:
        zero, highest = route.points[0][2], max(point[2] for point in route.points)
        if highest - zero < _CLIMB_M:
            raise InputError(
                f"heights of {zero:g} to {highest:g} m above sea level, and the height of the take-off is unknown",
                expected="altitudeMode relativeToGround, or a first point on the ground",
                cause="a line drawn at one height",
            )
        route.points = [(*point[:2], point[2] - zero, *point[3:]) for point in route.points]
        route.remark(f"Heights are above sea level: the height of the first point, {zero:.1f} m, is taken as zero.")
    return route


def read_areas(path: str | Path) -> list[list[tuple[float, float]]]:
    """Return the outlines of the areas of a KML, such as a geofence: corners as latitude and longitude [deg].

    Raises
    ------
    InputError
        If the file cannot be read, or has no area.
    """
    with parsing(path, "a KML with a Polygon: a geofence"):
        data = as_utf8(read_bytes(path)[0])
        polygons = outermost(_root(data), {"Polygon"}) if kml.is_kml(data) else ()
        rings = [ring for polygon in polygons for ring in outermost(polygon, {"outerBoundaryIs"})]
        areas = [[(place[1], place[0]) for place in kml.places_of(ring)] for ring in rings]
        areas = [area for area in areas if len(area) >= 3]
        if not areas:
            raise InputError("a map without an area", expected="a KML with a Polygon: a geofence")
        if not all(abs(latitude) <= 90 and abs(longitude) <= 180 for area in areas for latitude, longitude in area):
            raise InputError("a corner that is not a position on Earth", expected="longitude,latitude")
    return areas


# --- tables ------------------------------------------------------------------------------------------

_NUMBER = re.compile(r"\s*[-+]?(\d+([.,]\d*)?|\.\d+)([eE][-+]?\d+)?\s*")


def _sheet(data: bytes) -> _Route:
    """Return the waypoints of a table, which without a header are latitude, longitude, height and yaw."""
    # read line by line, so that a table beyond the limit is refused before all of it is in memory
    text = io.TextIOWrapper(io.BytesIO(data), encoding="utf-8", errors="replace")
    lines = (line for line in text if line.strip() and not line.lower().lstrip().startswith(("#", "sep=")))
    head = next(lines, None)
    if head is None:
        raise InputError("the file is empty", expected=_EXPECTED)
    # if there is a semicolon or tab, it separates cells, because commas may then be decimal signs
    sign = next((sign for sign in "\t;" if sign in head), ",")
    # quoted names may contain the separator
    rows: Iterator[list[str]] = csv.reader(chain([head], lines), delimiter=sign, skipinitialspace=True)
    first = next(rows)
    known = [dictionary.meaning(name) for name in first]
    above_sea = [m is not None and m.quantity.datum in ("sea level", "ellipsoid") for m in known]
    columns = {
        key: next((i for i, m in enumerate(known) if m and m.quantity.name == key and not above_sea[i]), -1)
        for key in COLUMNS[:4]
    }
    begin = 2
    if columns["latitude_deg"] < 0 or columns["longitude_deg"] < 0:
        if not all(map(_NUMBER.fullmatch, first)) or not 2 <= len(first) <= 4:
            raise InputError(f"no route: {head.rstrip()[:60]!r}", expected=_EXPECTED)
        columns = {key: index if index < len(first) else -1 for index, key in enumerate(COLUMNS[:4])}
        rows, begin = chain([first], rows), 1
    elif columns["altitude_m"] < 0 and any(above_sea):
        raise InputError("heights above sea level", expected="a column 'altitude_m' of heights above take-off")
    route = _Route()
    for number, row in enumerate(rows, start=begin):
        _add_row(route, row, columns, [m.unit if m else "" for m in known], number)
    return route


def _add_row(route: _Route, row: Sequence[str], columns: Mapping[str, int], units: Sequence[str], number: int) -> None:
    """Add a row of a table.

    Parameters
    ----------
    route : _Route
    row : sequence of str
        Cells of the row.
    columns : mapping
        Column of each quantity, -1 if it is missing.
    units : sequence of str
        Units in the names of the columns.
    number : int
        Number of the row, for messages.
    """
    try:
        cells = [row[index].strip() if 0 <= index < len(row) else "" for index in columns.values()]
        if not any("." in cell for cell in cells):  # if there is a point, a comma may separate thousands
            cells = [cell.replace(",", ".") for cell in cells]
        values = [
            float(dictionary.converted(np.array(float(cell)), units[index])) if cell else math.nan
            for cell, index in zip(cells, columns.values(), strict=True)
        ]
    except ValueError as error:
        raise InputError(
            f"row {number} has text instead of a number ({error})", expected="latitude, longitude"
        ) from error
    route.add(*values)
