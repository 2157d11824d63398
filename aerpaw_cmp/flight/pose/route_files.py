"""A planned route as files that ground stations read: QGroundControl plan, table of waypoints."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

from ...common.geodesy import SiteFrame
from .patterns import Waypoint

# MAV_FRAME_GLOBAL_RELATIVE_ALT; NAV_WAYPOINT, CONDITION_YAW, DO_CHANGE_SPEED of MAVLink
_FRAME_ABOVE_HOME, _WAYPOINT, _YAW, _SPEED = 3, 16, 115, 178
# MAV_AUTOPILOT and MAV_TYPE (quadrotor)
_ARDUPILOT, _COPTER = 3, 2


def _places(waypoints: Sequence[Waypoint], frame: SiteFrame) -> list[tuple[float, float, Waypoint]]:
    latitude, longitude = frame.to_geographic([w.east_m for w in waypoints], [w.north_m for w in waypoints])
    return [(round(float(a), 7), round(float(b), 7), w) for a, b, w in zip(latitude, longitude, waypoints, strict=True)]


def plan_text(waypoints: Sequence[Waypoint], frame: SiteFrame, speed_mps: float) -> str:
    """A QGroundControl plan for ArduPilot: each waypoint, then the yaw that holds until the next one.

    Parameters
    ----------
    waypoints : sequence of Waypoint
        Heights above take-off.
    frame : SiteFrame
    speed_mps : float

    Returns
    -------
    str
        JSON. Take-off, landing and the way there are left to the pilot.
    """
    # 1: ground speed; -1: the throttle stays
    items: list[dict[str, Any]] = [_item(_SPEED, [1, speed_mps, -1, 0, 0, 0, 0], frame=2)]
    for latitude, longitude, w in _places(waypoints, frame):
        items.append(_item(_WAYPOINT, [w.hold_s, 0, 0, None, latitude, longitude, w.height_m]))
        # a command of its own: ArduPilot ignores the yaw of a waypoint
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
    """Waypoints as a table: place, height above take-off, yaw until the next one, time to stay."""
    rows = [f"{a:.7f},{b:.7f},{w.height_m:g},{w.yaw_deg:.1f},{w.hold_s:g}" for a, b, w in _places(waypoints, frame)]
    return "\n".join(["latitude_deg,longitude_deg,altitude_m,yaw_deg,hold_s", *rows]) + "\n"
