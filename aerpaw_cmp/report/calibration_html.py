"""calibration.html with metrics.json and figures: antennas over the sphere, where flights looked, scores left out."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ..common.jsonable import json_safe
from ..common.provenance import KEY
from ..compare.calibration import BASELINES
from . import canvas
from .calibration_data import AntennaMap, CalibrationData
from .canvas import FigureSpec, Picture
from .export import write_file
from .html import by_section, environment, policy
from .names import safe_name

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
    safe: dict[str, Any] = json_safe(
        {
            "calibration": data.name,
            "generated": data.generated,
            "versions": dict(sorted(data.versions.items())),
            "flights": list(data.flights),
            KEY: list(data.trained_on),
            "scores": {k: list(v) for k, v in data.scores.items()},
            "controls": {k: list(v) for k, v in data.controls.items()},
            "mounts": data.mounts,
            "strengths": data.strengths,
            "ground": data.ground,
            "learning_curve": {"points": list(data.curve), "one_more_rmse_db": data.one_more_rmse_db},
            "antennas": [
                {"name": a.name, "share_of_sphere_seen": share_seen(a), "n_bins": len(a.seen)} for a in data.antennas
            ],
            "words": list(data.words),
            "warnings": list(data.warnings),
            "rank": data.rank or {},
            "stages": {f"{name}_s": seconds for name, seconds in data.stages_s.items()},
        }
    )
    return safe


def share_seen(antenna: AntennaMap, within_deg: float = 10.0) -> float:
    """Share of the sphere within some degrees of a direction that a flight looked in."""
    t, p = np.radians(antenna.theta_deg)[:, None], np.radians(antenna.azimuth_deg)[None, :]
    grid = np.stack(np.broadcast_arrays(np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)), axis=-1)
    near = np.zeros(grid.shape[:2], bool)
    for part in np.array_split(antenna.seen, max(1, len(antenna.seen) // 500)):
        near |= (grid @ part.T > np.cos(np.radians(within_deg))).any(axis=-1)
    weight = np.sin(t) * np.ones_like(near)
    return float((near * weight).sum() / weight.sum())


def draw_antenna(antenna: AntennaMap) -> Figure:
    """Gain and its standard deviation over azimuth and elevation, with the directions flown."""
    fig = canvas.figure((9.2, 6.4))
    axes = fig.subplots(2, 1, sharex=True)
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
                             cmap="viridis" if ax is axes[0] else "magma", rasterized=True)  # fmt: skip
        fig.colorbar(mesh, ax=ax, label=label, pad=0.01)
        ax.set_ylabel("elevation [deg]")
        ax.set_yticks([-90, -45, 0, 45, 90])
    at = np.degrees(np.arctan2(antenna.seen[:, 1], antenna.seen[:, 0])) % 360.0
    up = np.degrees(np.arcsin(np.clip(antenna.seen[:, 2], -1, 1)))
    for ax, colour in zip(axes, ("black", "white"), strict=True):
        ax.plot(at, up, ".", markersize=1.5, color=colour, alpha=0.6, label="flown")
    axes[1].set_xlabel("azimuth, counter-clockwise from forward or east [deg]")
    axes[1].set_xticks(range(0, 361, 45))
    axes[0].set_title(antenna.name)
    return fig


def draw_scores(data: CalibrationData) -> Figure:
    """Mean RMSE of every split and control beside free space."""
    left_out = data.scores["flight_left_out"]
    rows = [(title, _mean(left_out, key)) for key, title in BASELINES.items()]
    rows += [(SPLIT_TITLE.get(k, k), _mean(v)) for k, v in data.scores.items()]
    rows += [(f"control: {k}", _mean(v)) for k, v in data.controls.items()]
    rows = [(name, value) for name, value in rows if np.isfinite(value)]
    fig = canvas.figure((9.2, 0.4 * len(rows) + 1.0))
    ax = fig.subplots()
    names, values = [r[0] for r in rows][::-1], [r[1] for r in rows][::-1]
    beside = [n in BASELINES.values() or "control" in n for n in names]
    colours = [canvas.OUT_OF_COVERAGE if pale else canvas.SIMULATED for pale in beside]
    ax.barh(names, values, color=colours)
    for y, value in enumerate(values):
        ax.text(value, y, f" {value:.2f}", va="center", fontsize=8)
    ax.set_xlabel("mean RMSE over flights and channels [dB]")
    return fig


def draw_curve(data: CalibrationData) -> Figure:
    """Error on flights left out against the number of flights learned from, and what one more would bring."""
    fig = canvas.figure((7.0, 3.8))
    ax = fig.subplots()
    flights = [p["flights"] for p in data.curve]
    for key, label, colour in (
        ("rmse_db", "as logged", canvas.SIMULATED),
        ("rmse_4s_db", "4 s means", canvas.MEASURED),
    ):
        ax.plot(flights, [p[key] for p in data.curve], "o-", color=colour, label=label)
    ax.plot(
        [flights[-1], flights[-1] + 1], [data.curve[-1]["rmse_db"], data.one_more_rmse_db], "o--", fillstyle="none",
        color=canvas.SIMULATED, label="one flight more (extrapolated)",
    )  # fmt: skip
    ax.set_xticks([*flights, flights[-1] + 1])
    ax.set_xlabel("flights learned from")
    ax.set_ylabel("RMSE on a flight left out [dB]")
    ax.legend()
    return fig


def draw_place(place: Mapping[str, Any], name: str) -> Figure:
    """The field over places that the fit with one has, along the flights."""
    fig = canvas.figure((7.0, 6.0))
    ax = fig.subplots()
    points = ax.scatter(place["east_m"], place["north_m"], c=place["gain_db"], s=4, cmap="coolwarm", rasterized=True)
    fig.colorbar(points, ax=ax, label="field over places [dB]")
    ax.set_aspect("equal")
    ax.set_xlabel("east [m]")
    ax.set_ylabel("north [m]")
    ax.set_title(name)
    return fig


def _mean(rows: Sequence[Mapping[str, Any]], key: str = "rmse_db") -> float:
    return float(np.mean([r[key] for r in rows])) if rows else float("nan")


def figure_specs(data: CalibrationData) -> list[FigureSpec]:
    """All figures."""
    out = []
    if data.scores.get("flight_left_out"):
        out.append(
            FigureSpec(
                name="scores",
                section="scores",
                title="What carries over",
                caption="Mean RMSE after one offset per flight and channel. Nothing is scored where it was learned.",
                alt="Bars of RMSE for every left-out split and control",
                draw=partial(draw_scores, data),
                page=True,
            )
        )
    if len(data.curve) > 1:
        out.append(
            FigureSpec(
                name="learning_curve",
                section="scores",
                title="What another flight would bring",
                caption=f"Mean RMSE over {data.curve[0]['series']} series, each predicted by subsets of the other "
                "flights. The last point is extrapolated: the squared error as a constant and a part that falls with "
                "the number of flights.",
                alt="RMSE on flights left out against the number of flights learned from",
                draw=partial(draw_curve, data),
                page=True,
            )
        )
    for a in data.antennas:
        out.append(
            FigureSpec(
                name=f"antenna_{safe_name(a.name)}",
                section="antennas",
                title=a.name,
                caption=f"Flights looked within 10 degrees of {100 * share_seen(a):.0f} % of the sphere (dots). "
                "Elsewhere the gain is a guess, and its standard deviation says so. The level is normalised to a mean "
                "of 0 dBi over the sphere: it is not identified beside the offsets.",
                alt=f"Gain of {a.name} over azimuth and elevation with flown directions",
                draw=partial(draw_antenna, a),
                page=True,
            )
        )
    if data.place is not None:
        out.append(
            FigureSpec(
                name="place",
                section="place",
                title="Field over places",
                caption="What the fit with a place field puts into places instead of antennas. No antenna file has it.",
                alt="Map of the place field along the flights",
                draw=partial(draw_place, data.place, "field over places"),
                page=True,
            )
        )
    return out


def write_calibration(data: CalibrationData, folder: Path) -> list[Path]:
    """Write ``calibration.html``, ``metrics.json`` and ``figures/``."""
    written = [write_file(folder / "metrics.json", json.dumps(calibration_metrics(data), indent=2) + "\n")]
    drawn, files = canvas.write_figures(figure_specs(data), folder / "figures")
    page = write_file(folder / "calibration.html", _page(data, drawn))
    return [page, *written, *files]


def _page(data: CalibrationData, pictures: Sequence[Picture]) -> str:
    text: str = environment().get_template("calibration.html.jinja").render(
        data=data,
        sections=by_section(pictures),
        split_title=SPLIT_TITLE,
        baselines=BASELINES,
        means={k: ([_mean(v, key) for key in ("rmse_db", "rmse_4s_db", *BASELINES)], len(v))
               for k, v in {**data.scores, **{f"control: {k}": v for k, v in data.controls.items()}}.items()},
        content_policy=policy(),
    )  # fmt: skip
    return text
