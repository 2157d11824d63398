"""calibration.html with metrics.json: antennas over the sphere, where flights looked, scores left out."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...common.jsonable import json_object, named
from ...common.units import FloatArray
from ...compare.learning.calibration import BASELINES
from ..content.calibration import AntennaMap, CalibrationData
from ..content.made import about
from ..kit.page import write_page
from .places import BODY, COMPASS, Places, payload

SPLIT_TITLE = {
    "flight_left_out": "each flight left out",
    "altitude_left_out": "and its cruising height",
    "heading_left_out": "and an eighth of the compass of headings",
    "sector_left_out": "and a sector of 60 degrees at the tower",
    "route_left_out": "a segment of the flight's own route",
    "other_flights": "flights that had no part (--score)",
}


def calibration_metrics(data: CalibrationData) -> dict[str, Any]:
    """The numbers of the page under stable names."""
    return json_object(
        calibration=data.name,
        **named(data, "flights trained_on marks scores controls mounts strengths ground words warnings"),
        learning_curve={"points": data.curve, "one_more_rmse_db": data.one_more_rmse_db},
        antennas=[
            {"name": a.name, "share_of_sphere_seen": _share_seen(a), "n_bins": len(a.flown)} for a in data.antennas
        ],
        rank=data.rank or {},
        **about(data),
    )


def _directions(antenna: AntennaMap) -> FloatArray:
    """Unit vectors (t, p, 3) of the grid."""
    t, p = np.radians(antenna.theta_deg)[:, None], np.radians(antenna.azimuth_deg)[None, :]
    return np.stack(np.broadcast_arrays(np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)), axis=-1)


def _share_seen(antenna: AntennaMap, within_deg: float = 10.0) -> float:
    """Share of the sphere within some degrees of a direction that a flight looked in."""
    grid = _directions(antenna)
    near = np.zeros(grid.shape[:2], bool)
    for part in np.array_split(antenna.flown, max(1, len(antenna.flown) // 500)):
        near |= (grid @ part.T > np.cos(np.radians(within_deg))).any(axis=-1)
    weight = np.sin(np.radians(antenna.theta_deg))[:, None] * np.ones_like(near)
    return float((near * weight).sum() / weight.sum())


def _mean(rows: Sequence[Mapping[str, Any]], key: str = "rmse_db") -> float:
    return float(np.mean([r[key] for r in rows])) if rows else float("nan")


def _groups(data: CalibrationData) -> Iterator[Places]:
    """Each antenna over the sphere."""
    for a in data.antennas:
        yield Places(
            name=a.name,
            at=_directions(a).reshape(-1, 3),
            values={"gain [dBi]": a.gain_dbi.ravel(), "standard deviation [dB]": a.sd_db.ravel()},
            around=BODY if a.name.endswith(" uav") else COMPASS,
            dots=a.flown,
        )


def write_calibration(data: CalibrationData, folder: Path) -> list[Path]:
    """Write ``calibration.html`` and ``metrics.json``."""
    numbers = calibration_metrics(data)
    rows = {**data.scores, **{f"control: {name}": scores for name, scores in data.controls.items()}}
    columns = ("rmse_db", "rmse_4s_db", *BASELINES)
    return write_page(
        folder, "calibration", numbers, payload(list(_groups(data))) if data.antennas else {},
        data=data,
        metrics=numbers,
        split_title=SPLIT_TITLE,
        baselines=BASELINES,
        means={name: ([_mean(scores, key) for key in columns], len(scores)) for name, scores in rows.items()},
    )  # fmt: skip
