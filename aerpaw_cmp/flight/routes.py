"""Planned routes: patterns within an area, and files for ground stations.

Routes are lawnmowers and crosses. The nose of the UAV points along the track, stays fixed, or turns from leg to leg.
Routes are written as a QGroundControl plan and as a table of waypoints.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Literal

import numpy as np
import shapely
import shapely.affinity
from shapely.ops import substring

from ..common.errors import UsageError
from ..common.geodesy import SiteFrame, bearing_deg
from ..common.units import FloatArray, spread_out
from .track import interpolated

Nose = Literal["along", "fixed", "four headings"]
# Directions of the nose: along the track, turned by 90 degrees per leg, or north.
NOSES: tuple[Nose, ...] = ("along", "four headings", "fixed")

# Smallest distance of routes from the border of the area [m].
MARGIN_M = 3.0

# Shorter legs are skipped [m].
_LEAST_LEG_M = 40.0

# Smallest spacing of legs [m].
_CLOSEST_M = 15.0

_TURN_STEPS = 8
# Time at each of the eight headings of a slow rotation [s].
_TURN_HOLD_S = 8.0

_TURN_POINTS = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class Waypoint:
    """A waypoint. The UAV keeps its yaw [deg from north] for ``hold_s`` and on the way to the next waypoint."""

    east_m: float
    north_m: float
    height_m: float
    yaw_deg: float
    hold_s: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Route:
    """A candidate flight, sampled once per second.

    Parameters
    ----------
    name : str
    waypoints : tuple of Waypoint
    position_m : (n, 3)
    yaw_deg, time_s : (n,)
    """

    name: str
    waypoints: tuple[Waypoint, ...]
    position_m: FloatArray
    yaw_deg: FloatArray
    time_s: FloatArray

    @property
    def length_m(self) -> float:
        """Length along the track [m]."""
        return float(np.linalg.norm(np.diff(self.position_m, axis=0), axis=1).sum())

    @property
    def duration_s(self) -> float:
        """Time from the first to the last point [s]."""
        return float(self.time_s[-1] - self.time_s[0])


def flown(name: str, waypoints: Sequence[Waypoint], speed_mps: float) -> Route:
    """Return the route along waypoints at constant speed.

    Parameters
    ----------
    name : str
    waypoints : sequence of Waypoint
        Two waypoints or more.
    speed_mps : float

    Returns
    -------
    Route
        Route, sampled once per second.
    """
    place = np.array([(w.east_m, w.north_m, w.height_m) for w in waypoints])
    spans = np.zeros(2 * len(place))  # durations of the way to each waypoint, and of the stay there
    spans[1::2] = [w.hold_s for w in waypoints]
    spans[2::2] = [float(np.linalg.norm(step)) / speed_mps for step in np.diff(place, axis=0)]
    time, yaw = np.cumsum(spans), np.repeat([w.yaw_deg for w in waypoints], 2)
    # slightly longer, so that the last sample is included if the duration is a whole number of seconds
    seconds = np.arange(0.0, time[-1] + 1e-9, 1.0)
    # a yaw is kept from its waypoint to the next, so each time has the yaw of the waypoint before it
    before = np.maximum(np.searchsorted(time, np.minimum(seconds, time[-1])) - 1, 0)
    position = interpolated(seconds, time, np.repeat(place, 2, axis=0))
    return Route(
        name=name, waypoints=tuple(waypoints), position_m=position, yaw_deg=yaw[before] % 360.0, time_s=seconds
    )


def allowed_area(fence: Any, avoid: Sequence[Any], towers_m: FloatArray, distance_m: float) -> Any:
    """Return the largest connected area within a fence, outside areas to avoid and circles around towers.

    Parameters
    ----------
    fence : shapely Polygon
    avoid : sequence of shapely Polygon
    towers_m : (t, 2)
    distance_m : float
        Smallest horizontal distance to a tower [m].

    Returns
    -------
    shapely Polygon

    Raises
    ------
    UsageError
        If no area remains.
    """
    circles = [shapely.Point(*place).buffer(distance_m) for place in towers_m[:, :2]] if distance_m > 0 else []
    # a buffer of 0 repairs outlines that cross themselves
    remaining = fence.buffer(0).difference(shapely.union_all([*avoid, *circles])).buffer(-MARGIN_M)
    parts = [p for p in getattr(remaining, "geoms", [remaining]) if p.area > 0]
    if not parts:
        raise UsageError(
            "no route fits: no area remains inside the geofence",
            expected="a geofence with enough area outside no-fly areas and circles around towers",
            cause="a no-fly area that covers it, or too large a distance to towers",
        )
    return max(parts, key=lambda p: p.area)


def lawnmower(area: Any, azimuth_deg: float, spacing_m: float) -> list[FloatArray]:
    """Return legs (2, 2) back and forth across an area at a course clockwise from north. Short legs are omitted."""
    centre = area.centroid
    turned = shapely.affinity.rotate(area, azimuth_deg, origin=centre)  # legs now run north
    west, south, east, north = turned.bounds
    # divide the width evenly, because otherwise the last leg could be at any distance from the border
    count = max(int((east - west) // spacing_m), 1)
    at = west + (np.arange(count) + 0.5) * (east - west) / count
    legs, up = [], True
    for x in at:
        cut = turned.intersection(shapely.LineString([(x, south - 1.0), (x, north + 1.0)]))
        # a leg across a hole consists of several pieces, and a leg that touches a corner is a point
        pieces = [p for p in getattr(cut, "geoms", [cut]) if p.length >= _LEAST_LEG_M]
        pieces.sort(key=lambda p: p.bounds[1], reverse=not up)
        for piece in pieces:
            back = shapely.affinity.rotate(piece, -azimuth_deg, origin=centre)
            ends = np.array(back.coords)[[0, -1]]
            low_first = piece.coords[0][1] <= piece.coords[-1][1]
            legs.append(ends if low_first == up else ends[::-1])
        up = not up
    return legs


def path_within(area: Any, begin: FloatArray, end: FloatArray) -> list[FloatArray]:
    """Return the corners of a path between two points that stays inside an area, if necessary along its border."""
    line = shapely.LineString([begin, end])
    # add a small buffer, because legs end on the border and may be outside due to rounding
    if area.buffer(0.1).covers(line):
        return []
    corners: list[FloatArray] = []
    for ring in (area.exterior, *area.interiors):
        ends = [p for p in (begin, end) if ring.distance(shapely.Point(*p)) < 0.5]  # legs end on the border
        met = np.array([*shapely.get_coordinates(ring.intersection(line)), *ends]).reshape(-1, 2)
        if len(met) < 2:
            continue
        met = met[np.argsort(np.linalg.norm(met - begin, axis=1))]
        begin_m, end_m = (ring.project(shapely.Point(*p)) for p in (met[0], met[-1]))
        forth = substring(ring, begin_m, end_m)
        first, last = min(begin_m, end_m), max(begin_m, end_m)
        back = shapely.LineString([*substring(ring, last, ring.length).coords, *substring(ring, 0.0, first).coords])
        back = back if begin_m > end_m else back.reverse()
        # omit corners that deviate from a straight line by less than a metre
        arc = min((forth, back), key=lambda a: a.length).simplify(1.0)
        corners += [np.array(c) for c in arc.coords]
    return sorted(corners, key=lambda c: float(np.linalg.norm(c - begin))) if len(area.interiors) > 1 else corners


def waypoints_of(legs: Sequence[FloatArray], area: Any, height_m: float, nose: Nose) -> list[Waypoint]:
    """Return the waypoints of consecutive legs, joined within the area.

    Parameters
    ----------
    legs : sequence of (2, 2)
    area : shapely Polygon
    height_m : float
    nose : {"along", "fixed", "four headings"}

    Returns
    -------
    list of Waypoint
    """
    corners: list[tuple[FloatArray, int]] = []
    for number, leg in enumerate(legs):
        if corners:
            corners += [(c, number) for c in path_within(area, corners[-1][0], leg[0])]
        corners += [(leg[0], number), (leg[1], number)]
    out: list[Waypoint] = []
    for (place, number), (following, _) in pairwise([*corners, corners[-1]]):
        step = following - place
        course = float(bearing_deg(step))
        yaw = {"along": course, "fixed": 0.0, "four headings": course + 90.0 * (number % 4)}[nose]
        if not step.any() and out:
            yaw = out[-1].yaw_deg
        out.append(Waypoint(east_m=float(place[0]), north_m=float(place[1]), height_m=height_m, yaw_deg=yaw % 360.0))
    return out


def with_turns(waypoints: Sequence[Waypoint]) -> list[Waypoint]:
    """Return waypoints with slow rotations through all headings at some points of the route."""
    at = set(spread_out(len(waypoints), _TURN_POINTS).tolist())
    out: list[Waypoint] = []
    for i, w in enumerate(waypoints):
        if i in at:
            turns = [(w.yaw_deg + 360.0 / _TURN_STEPS * k) % 360.0 for k in range(_TURN_STEPS)]
            out += [replace(w, yaw_deg=yaw, hold_s=_TURN_HOLD_S) for yaw in turns]
        out.append(w)
    return out


@dataclass(frozen=True, slots=True, kw_only=True)
class Pattern:
    """The parameters of a lawnmower: course of its legs, height, nose and slow rotations."""

    azimuth_deg: float
    height_m: float
    nose: Nose
    turns: bool = False

    @property
    def name(self) -> str:
        """Name for tables and files."""
        nose = {
            "along": "nose along the track",
            "fixed": "nose to the north",
            "four headings": "nose turned by 90 deg per leg",
        }
        turns = f", slow turn at {_TURN_POINTS} points" if self.turns else ""
        return f"lawnmower with legs at {self.azimuth_deg:g} deg, {self.height_m:g} m, {nose[self.nose]}{turns}"


def route_of(pattern: Pattern, area: Any, speed_mps: float, most_s: float) -> Route:
    """Return the densest lawnmower of a pattern that can be flown within the battery time.

    Parameters
    ----------
    pattern : Pattern
    area : shapely Polygon
        Area of :func:`allowed_area`.
    speed_mps : float
    most_s : float
        Longest flight [s].

    Returns
    -------
    Route

    Raises
    ------
    UsageError
        If the area is too small for a leg.
    """
    west, south, east, north = area.bounds
    widest = math.hypot(east - west, north - south)

    def made(spacing_m: float) -> Route:
        legs = lawnmower(area, pattern.azimuth_deg, spacing_m)
        if not legs:
            raise UsageError(
                f"no route fits: no leg of {_LEAST_LEG_M:g} m is within the geofence",
                expected="an area of some hundred metres outside no-fly areas and circles around towers",
            )
        points = waypoints_of(legs, area, pattern.height_m, pattern.nose)
        return flown(pattern.name, with_turns(points) if pattern.turns else points, speed_mps)

    low, high = _CLOSEST_M, widest
    for _ in range(14):
        # geometric bisection: 14 steps suffice from hundreds of metres
        middle = math.sqrt(low * high)
        longer = made(middle).duration_s > most_s
        low, high = (middle, high) if longer else (low, middle)
    return cut(made(high), most_s, speed_mps)


def cut(route: Route, most_s: float, speed_mps: float) -> Route:
    """Return the part of a route, both waypoints and samples, that can be flown within the battery time."""
    if route.duration_s <= most_s:
        return route
    within: list[Waypoint] = []
    clock = 0.0
    for w, after in zip(route.waypoints, [*route.waypoints[1:], route.waypoints[-1]], strict=True):
        within.append(w)
        clock += w.hold_s
        step = np.array([after.east_m - w.east_m, after.north_m - w.north_m, after.height_m - w.height_m])
        needed = float(np.linalg.norm(step)) / speed_mps
        if clock + needed > most_s:
            end = np.array([w.east_m, w.north_m, w.height_m]) + max(most_s - clock, 0.0) / max(needed, 1e-9) * step
            east, north, up = end.tolist()
            within.append(replace(w, east_m=east, north_m=north, height_m=up, hold_s=0.0))
            break
        clock += needed
    return flown(route.name, within, speed_mps)


# MAV_FRAME_GLOBAL_RELATIVE_ALT, and NAV_WAYPOINT, CONDITION_YAW, DO_CHANGE_SPEED of MAVLink
_FRAME_ABOVE_HOME, _WAYPOINT, _YAW, _SPEED = 3, 16, 115, 178
# MAV_AUTOPILOT and MAV_TYPE (quadrotor)
_ARDUPILOT, _COPTER = 3, 2


def _places(waypoints: Sequence[Waypoint], frame: SiteFrame) -> list[tuple[float, float, Waypoint]]:
    latitude, longitude = frame.to_geographic([w.east_m for w in waypoints], [w.north_m for w in waypoints])
    return [(round(float(a), 7), round(float(b), 7), w) for a, b, w in zip(latitude, longitude, waypoints, strict=True)]


def plan_text(waypoints: Sequence[Waypoint], frame: SiteFrame, speed_mps: float) -> str:
    """Return a QGroundControl plan for ArduPilot. Each waypoint is followed by the yaw until the next waypoint.

    Parameters
    ----------
    waypoints : sequence of Waypoint
        Waypoints with heights above take-off.
    frame : SiteFrame
    speed_mps : float

    Returns
    -------
    str
        JSON text. The pilot adds take-off, landing, and the ways to and from the route.
    """
    # 1 is ground speed, and -1 keeps the throttle
    items: list[dict[str, Any]] = [_item(_SPEED, [1, speed_mps, -1, 0, 0, 0, 0], frame=2)]
    for latitude, longitude, w in _places(waypoints, frame):
        items.append(_item(_WAYPOINT, [w.hold_s, 0, 0, None, latitude, longitude, w.height_m]))
        # set the yaw by a separate command, because ArduPilot ignores the yaw of a waypoint
        items.append(_item(_YAW, [w.yaw_deg, 0, 0, 0, 0, 0, 0], frame=2))
    for number, item in enumerate(items, start=1):
        item["doJumpId"] = number
    latitude, longitude, _ = _places(waypoints[:1], frame)[0]
    mission = {
        "cruiseSpeed": speed_mps, "firmwareType": _ARDUPILOT, "hoverSpeed": speed_mps, "items": items,
        "plannedHomePosition": [latitude, longitude, 0], "vehicleType": _COPTER, "version": 2,
    }  # fmt: skip
    plan = {
        "fileType": "Plan", "geoFence": {"circles": [], "polygons": [], "version": 2},
        "groundStation": "QGroundControl", "mission": mission,
        "rallyPoints": {"points": [], "version": 2}, "version": 1,
    }  # fmt: skip
    return json.dumps(plan, indent=1) + "\n"


def _item(command: int, params: list[float | None], frame: int = _FRAME_ABOVE_HOME) -> dict[str, Any]:
    return {"autoContinue": True, "command": command, "frame": frame, "params": params, "type": "SimpleItem"}


def waypoints_csv(waypoints: Sequence[Waypoint], frame: SiteFrame) -> str:
    """Return waypoints as a CSV table: position, height above take-off, yaw until the next waypoint, hold time."""
    rows = [f"{a:.7f},{b:.7f},{w.height_m:g},{w.yaw_deg:.1f},{w.hold_s:g}" for a, b, w in _places(waypoints, frame)]
    return "\n".join(["latitude_deg,longitude_deg,altitude_m,yaw_deg,hold_s", *rows]) + "\n"
