"""Flights whose logs are small tables with known columns."""

from pathlib import Path
from typing import Any

import numpy as np

ORIGIN = "2025-06-01T14:00:00Z"
LW1 = (35.72750947, -78.69595819)
POSITIONS = {"time": "t", "latitude_deg": "lat", "longitude_deg": "lon", "altitude_m": "alt"}
ATTITUDE = {"roll_deg": "roll", "pitch_deg": "pitch", "yaw_deg": "yaw"}


def write_csv(path: Path, names: str, *columns: Any) -> None:
    """Write a table of numbers, with an empty cell for a number that is not finite."""
    rows = "\n".join(",".join(f"{v:.11g}" if np.isfinite(v) else "" for v in row) for row in zip(*columns, strict=True))
    path.write_text(f"{names}\n{rows}\n", encoding="utf-8")


def table_log(path: str, kind: str, columns: dict[str, str], origin: str = ORIGIN, **more: str) -> dict[str, Any]:
    """The entry of a table under ``logs`` of a flight file."""
    return {"path": path, "reader": "generic_csv", "kind": kind, "time_origin": origin, "columns": columns, **more}


def rss_log(folder: Path, channel: str, at: Any, level: Any, node: str = "LW1") -> dict[str, Any]:
    """The entry of a channel whose seconds and levels are written."""
    write_csv(folder / f"{channel}.csv", "t,level", np.asarray(at, float), np.asarray(level, float))
    return table_log(f"{channel}.csv", "rss", {"time": "t", "rss_db": "level"}, node=node, channel=channel)


def rank_log(folder: Path, at: Any, ri: Any, node: str = "LW1") -> dict[str, Any]:
    """The entry of a log whose seconds and ranks are written."""
    write_csv(folder / "ri.csv", "t,ri", np.asarray(at, float), np.asarray(ri, float))
    return table_log("ri.csv", "rank", {"time": "t", "ri_raw": "ri"}, node=node, ri_base="one")


def eastwards(folder: Path, t: Any, east_m: Any, yaw_deg: float | None = None) -> dict[str, Any]:
    """Write a track 55 m north of LW1 at 40 m, and return its entry.

    If a heading is given, the attitude is that of a level flight.
    """
    t, still = np.asarray(t, float), np.zeros(len(t))
    places = (still + LW1[0] + 5e-4, LW1[1] + np.asarray(east_m) / 90_314.0, still + 40.0)
    turns = () if yaw_deg is None else (still, still, still + yaw_deg)
    write_csv(folder / "track.csv", "t,lat,lon,alt" + ",roll,pitch,yaw" * bool(turns), t, *places, *turns)
    return table_log("track.csv", "telemetry", POSITIONS | (ATTITUDE if turns else {}))
