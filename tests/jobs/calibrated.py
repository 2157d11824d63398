"""Flights past a sector antenna that their files do not know, and a calibration as the command makes it."""

from pathlib import Path
from typing import Any

from aerpaw_cmp.jobs.calibrate import Calibration, calibrate, load_calibration, read_flights
from tests.simulated import planned, simulate, write_yaml

ROUTES = {
    "first": [(-60, 10, 30), (-250, 60, 30), (-100, 260, 40), (160, 160, 40), (200, -150, 30), (-180, -160, 30)],
    "second": [(60, 30, 45), (-200, 160, 45), (-220, -90, 35), (20, -220, 35), (240, 20, 45), (60, 240, 45)],
    "aside": [(-90, -60, 38), (-240, 20, 38), (-120, 200, 42), (100, 240, 42), (230, -60, 38), (-60, -230, 38)],
}
OFFSET_DB = {"first": 12.0, "second": 9.0, "aside": 4.0}
YAW_DEG = 110.0


def settings(
    name: str, antenna: dict[str, str], yaw_deg: float = 0.0, *, channel: str = "USRP1", **rest: Any
) -> dict[str, Any]:
    plan = {"seed": len(name), "speed_mps": 8.0, "rss_interval_s": 0.5, "fading_db": 1.0, "fading_correlation_s": 0.5}
    keys: dict[str, Any] = {
        "link": {"rss": {"carrier_hz": 3.3e9, "tower": {"antenna": antenna, "yaw_deg": yaw_deg}}},
        "rt": {"max_depth": 0, "attitude": "logged", "audit_links": 0},
        "rss": {"lag": "off", "minimum_height_m": 20},
    }
    return planned(name, ROUTES[name], {"LW1": {channel: OFFSET_DB[name]}}, plan=plan, **(keys | rest))


def past_sector_antenna(place: Path) -> Path:
    """Three simulated flights whose files say that the antenna is isotropic, and a calibration of two of them."""
    for name in ROUTES:
        simulate(write_yaml(place / f"{name}.yaml", settings(name, {"model": "tr38901"}, YAW_DEG)))
        write_yaml(place / f"{name}.yaml", settings(name, {"model": "iso"}))
    write_yaml(place / "calibration.yaml", {"calibration": "planted", "flights": ["first.yaml", "second.yaml"]})
    return place


def calibrated(path: Path) -> tuple[Calibration, list[str]]:
    """Return what was learned, and the warnings about copied logs."""
    settings = load_calibration(path)
    flights, said, _ = read_flights(settings, path.parent, None)
    return calibrate(settings, flights, path.parent), said
