"""Logs of planned flights, as if they had been flown."""

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from aerpaw_cmp.cli import main

NO_LOGS = shutil.ignore_patterns("flight.yaml", "SHA256SUMS")


def simulate(flight: Path, folder: Path | None = None) -> None:
    """Write the logs of a flight file, and the truth next to it or into a folder with others."""
    out = flight.parent / f"{flight.stem}_simulated"
    assert main(["simulate", str(flight), "-o", str(out), "--quiet"]) == 0
    shutil.copytree(out, folder or flight.parent, dirs_exist_ok=True, ignore=NO_LOGS)
    shutil.rmtree(out)


def planned(
    name: str, corners: Sequence[Sequence[float]], offsets_db: Mapping[str, Mapping[str, float]],
    *, plan: Mapping[str, Any] | None = None, ranks: bool = False, **keys: Any,
) -> dict[str, Any]:  # fmt: skip
    """A flight file at Lake Wheeler without its buildings: a track, and a power log of each channel with an offset.

    Parameters
    ----------
    name : str
        Of the flight, and of the folder of its logs.
    corners : sequence of (east, north, height)
        Waypoints [m].
    offsets_db : mapping of tower to channel to float
    plan : mapping
        Further keys of the plan.
    ranks : bool
        A log of ranks of LW1, too.
    keys
        Further keys of the flight file.

    Returns
    -------
    dict
    """
    logs = [{"path": f"{name}/vehicle.txt", "reader": "vehicle_out"}]
    for tower, channels in offsets_db.items():
        logs += [
            {"path": f"{name}/{tower}_{channel}.txt", "reader": "sounder_log", "node": tower, "channel": channel}
            for channel in channels
        ]
    if ranks:
        logs.append({"path": f"{name}/ri.csv", "reader": "quectel_ri", "node": "LW1"})
    waypoints = [{"east_m": east, "north_m": north, "height_m": height} for east, north, height in corners]
    made = {"start": "2025-06-01T10:00:00", "seed": 4, "speed_mps": 10.0, "fading_db": 0.0, "waypoints": waypoints}
    return {
        "flight": {
            "name": name, "synthetic": True,
            "plan": {**made, "offsets_db": {k: dict(v) for k, v in offsets_db.items()}, **(plan or {})},
        },
        "site": {"file": "lake_wheeler", "without_buildings": True}, "timezone": "America/New_York", "logs": logs,
        "rss": {"lag": "off"},
        **keys,
    }  # fmt: skip


def write_yaml(path: Path, content: Mapping[str, Any]) -> Path:
    """The file, with its keys in their order."""
    path.write_text(yaml.safe_dump(dict(content), sort_keys=False), encoding="utf-8")
    return path
