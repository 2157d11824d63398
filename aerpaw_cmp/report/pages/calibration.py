"""calibration.html with metrics.json and figures: antennas over the sphere, where flights looked, scores left out."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ...common.geodesy import azimuth_rad, elevation_rad
from ...common.jsonable import json_object, named
from ...compare.learning.calibration import BASELINES
from ..content.calibration import AntennaMap, CalibrationData
from ..content.made import about
from ..kit import canvas
from ..kit.canvas import FigureSpec
from ..kit.page import write_page
from ..names import safe_name

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


def _share_seen(antenna: AntennaMap, within_deg: float = 10.0) -> float:
    """Share of the sphere within some degrees of a direction that a flight looked in."""
    t, p = np.radians(antenna.theta_deg)[:, None], np.radians(antenna.azimuth_deg)[None, :]
    grid = np.stack(np.broadcast_arrays(np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)), axis=-1)
    near = np.zeros(grid.shape[:2], bool)
    for part in np.array_split(antenna.flown, max(1, len(antenna.flown) // 500)):
        near |= (grid @ part.T > np.cos(np.radians(within_deg))).any(axis=-1)
    weight = np.sin(t) * np.ones_like(near)
    return float((near * weight).sum() / weight.sum())


def draw_antenna(antenna: AntennaMap) -> Figure:
    """Gain and its standard deviation over azimuth and elevation, with the directions flown."""
    fig, axes = canvas.subplots((9.2, 6.4), 2, 1, sharex=True)
    elevation = 90.0 - antenna.theta_deg
    azimuth = np.append(antenna.azimuth_deg, 360.0)

    def closed(values: Any) -> Any:
        return np.concatenate([values, values[:, :1]], axis=1)

    level = closed(antenna.gain_dbi)
    low, high = np.percentile(level, [2, 98])
    for ax, values, label, limits in (
        (axes[0], level, "gain [dBi]", (low, high)),
        (axes[1], closed(antenna.sd_db), "standard deviation [dB]", (0.0, float(antenna.sd_db.max()))),
    ):
        mesh = ax.pcolormesh(azimuth, elevation, values, shading="gouraud", vmin=limits[0], vmax=limits[1],
                             cmap="viridis" if ax is axes[0] else "plasma", rasterized=True)  # fmt: skip
        fig.colorbar(mesh, ax=ax, label=label, pad=0.01)
        ax.set_ylabel("elevation [deg]")
        ax.set_yticks([-90, -45, 0, 45, 90])
    at, up = np.degrees(azimuth_rad(antenna.flown)) % 360.0, np.degrees(elevation_rad(antenna.flown))
    for ax, colour in zip(axes, ("black", "white"), strict=True):
        ax.plot(at, up, ".", markersize=1.5, color=colour, alpha=0.6, label="flown")
    axes[1].set_xlabel("azimuth, counter-clockwise from forward or east [deg]")
    axes[1].set_xticks(range(0, 361, 45))
    axes[0].set_title(antenna.name)
    return fig


def _mean(rows: Sequence[Mapping[str, Any]], key: str = "rmse_db") -> float:
    return float(np.mean([r[key] for r in rows])) if rows else float("nan")


def figure_specs(data: CalibrationData) -> Iterator[FigureSpec]:
    """All figures."""
    for a in data.antennas:
        yield FigureSpec(
            f"antenna_{safe_name(a.name)}", "antennas", a.name,
            f"Flights saw directions within 10 degrees of {100 * _share_seen(a):.0f} % of the sphere (dots). "
            "Elsewhere the gain is a guess, and its standard deviation says so. The level is normalised to a mean of "
            "0 dBi over the sphere: it is not identified beside the offsets.",
            partial(draw_antenna, a),
        )  # fmt: skip


def write_calibration(data: CalibrationData, folder: Path) -> list[Path]:
    """Write ``calibration.html``, ``metrics.json`` and ``figures/``."""
    rows = {**data.scores, **{f"control: {name}": scores for name, scores in data.controls.items()}}
    columns = ("rmse_db", "rmse_4s_db", *BASELINES)
    return write_page(
        folder, "calibration", calibration_metrics(data), figure_specs(data),
        data=data,
        split_title=SPLIT_TITLE,
        baselines=BASELINES,
        means={name: ([_mean(scores, key) for key in columns], len(scores)) for name, scores in rows.items()},
    )  # fmt: skip
