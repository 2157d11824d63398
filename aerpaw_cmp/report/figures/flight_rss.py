"""Figures of the track and of received signal strength."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from ...common.units import FloatArray
from ...compare.result import PairResult, RankResult, RssResult
from ..content.flight import ReportData, Track, start_of, used_towers
from ..kit.canvas import (
    BASELINE,
    MEASURED,
    POINTS_PER_LINE,
    SECOND,
    SIMULATED,
    TOWER,
    WAYPOINT,
    colour_bar,
    dots,
    draw_out_of_coverage,
    draw_site,
    draw_waypoints,
    frame_around,
    legend_below,
    legend_of,
    lonely,
    robust_limits,
    seconds_since,
    subplots,
    thinned,
    thinned_plan,
    time_axis,
)
from ..words.flight import count, instants, pretty, signed

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def _draw_node(ax: Axes, panel: RssResult | RankResult) -> None:
    """The way of a tower that moves; its mark stands in the middle of it."""
    if panel.tower_m is not None:
        ax.plot(*thinned_plan(*panel.tower_m[:, :2].T), color=TOWER, linewidth=1.2, linestyle=(0, (4, 2)), zorder=4.5,
                label=f"way of {panel.tower}")  # fmt: skip


def trajectory(data: ReportData, track: Track) -> Figure:
    """The flight on the plan of the whole site, and closer, coloured by height."""
    fig, (site_plan, close) = subplots((9.2, 5.4), 1, 2, width_ratios=(1.0, 1.35))
    draw_site(site_plan, data.site)
    draw_site(close, data.site)
    nodes = {item.tower: item for item in data.series}.values()
    for panel in nodes:
        _draw_node(site_plan, panel)
        _draw_node(close, panel)
    site_plan.plot(*thinned_plan(track.east_m, track.north_m), color="#0072B2", linewidth=1.0, label="flight", zorder=4)
    points = close.scatter(
        track.east_m, track.north_m, c=track.up_m, cmap="cividis", s=5, linewidths=0, rasterized=True, zorder=3,
        label="flight (colour: height)",
    )  # fmt: skip
    towers = list(data.site.towers.values())
    whole_east = np.concatenate([[t.east_m for t in towers], track.east_m[np.isfinite(track.east_m)]])
    whole_north = np.concatenate([[t.north_m for t in towers], track.north_m[np.isfinite(track.north_m)]])
    frame_around(site_plan, whole_east, whole_north, least_m=200.0, shape=0.75)
    near = [data.site.towers[name] for name in used_towers(data)]
    extent = float(np.nanmax([np.ptp(track.east_m), np.ptp(track.north_m), 100.0])) if len(track.east_m) else 100.0
    centre = np.array([np.nanmean(track.east_m), np.nanmean(track.north_m)])
    ways = [node.tower_m for node in nodes if node.tower_m is not None]
    near = [t for t in near if np.hypot(t.east_m - centre[0], t.north_m - centre[1]) < extent]
    frame_around(
        close,
        np.concatenate([track.east_m, [t.east_m for t in near], *(way[:, 0] for way in ways)]),
        np.concatenate([track.north_m, [t.north_m for t in near], *(way[:, 1] for way in ways)]),
    )
    for waypoint in data.waypoints:
        close.annotate(
            waypoint.label, (waypoint.east_m, waypoint.north_m), fontsize=8, ha="center", va="center", zorder=7,
            bbox={"boxstyle": "circle,pad=0.15", "facecolor": "white", "edgecolor": WAYPOINT},
        )  # fmt: skip
    colour_bar(fig, points, close, "Height above ground [m]")
    site_plan.set_title("Whole site")
    close.set_title("The flight")
    site_plan.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=2)
    close.legend(
        *legend_of(close, lambda label: label.startswith("flight")), loc="upper center", bbox_to_anchor=(0.5, -0.12)
    )
    return fig


def altitude(data: ReportData, track: Track) -> Figure:
    """Height over time, with waypoints and the ground speed below."""
    start = start_of(data)
    seconds = seconds_since(track.time, start)
    fig, ax = subplots((9.2, 2.9))
    ax.plot(*thinned(seconds, track.up_m), color=SIMULATED, linewidth=1.2, label="height of the UAV")
    draw_waypoints(ax, data.moments, start)
    time_axis(ax, start)
    ax.set_ylabel("Height above ground [m]")
    ax.set_ylim(bottom=min(0.0, float(np.nanmin(track.up_m, initial=0.0))))
    fig.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return fig


# --- RSS ----------------------------------------------------------------------------------------


def rss_over_time(data: ReportData, panel: RssResult) -> Figure:
    """Measurement as logged, simulation and baselines less their offsets over time, and the residual under them."""
    start, score = start_of(data), panel.score
    seconds = seconds_since(panel.time, start)
    fig, (ax, below) = subplots((9.2, 5.6), 2, 1, sharex=True, height_ratios=(2.6, 1.0))
    draw_out_of_coverage(ax, seconds, panel.simulated_out_of_coverage, "Z: no path in the simulation")
    draw_out_of_coverage(
        ax, seconds, panel.measured_out_of_coverage, "no signal in the measurement", height=0.05, hatch="xxxxx"
    )
    measured, residual = panel.measured_db, panel.residual_db
    simulated = _moved(panel.simulated_dbm, score.offset_db)
    label = f"measured, as logged ({count(score.n)} scored)"
    dots(ax, seconds, measured, 2.5, color=MEASURED, label=label, zorder=3.5)
    for name, baseline in panel.baselines.items():
        colour, dashes = BASELINE[name]
        ax.plot(
            *thinned(seconds, _moved(baseline.level_dbm, baseline.offset_db)), color=colour, linestyle=dashes,
            linewidth=1.2, zorder=2.5 if name == "two_ray" else 3.7,  # its dense fringes would hide the rest
            label=f"{pretty(name)} (own offset)",
        )  # fmt: skip
    label = f"ray tracing, {_offset(score.offset_db)}"
    ax.plot(*thinned(seconds, simulated), color=SIMULATED, linewidth=1.0, label=label, zorder=3)
    if panel.stated is not None:
        some = slice(None, None, max(1, len(seconds) // POINTS_PER_LINE))
        band = panel.stated.columns(simulated)
        low, high = (band[f"simulated_{end}_dbm"][some] for end in ("low", "high"))
        ax.fill_between(seconds[some], low, high, color=SIMULATED, alpha=0.15, linewidth=0, label="90 % band", zorder=1)
    alone = lonely(simulated)  # a line shows no single point between two gaps
    ax.plot(seconds[alone], simulated[alone], linestyle="none", marker=".", markersize=4, color=SIMULATED)
    draw_waypoints(ax, data.moments, start)
    robust_limits(ax, [measured, simulated])
    ax.set_ylabel(f"RSS [{panel.unit}]")
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.03), ncols=3, markerscale=3)
    dots(below, seconds, residual, color="#0072B2", label="measured − simulated")
    below.axhline(0.0, color=SIMULATED, linewidth=0.8)
    if np.isfinite(score.rmse_db):
        for sign in (-1, 1):
            below.axhline(
                sign * score.rmse_db, color=SIMULATED, linewidth=0.8, linestyle=(0, (4, 3)),
                label=f"RMSE {score.rmse_db:.1f} dB" if sign == 1 else None,
            )  # fmt: skip
    draw_waypoints(below, data.moments, start, names=False)
    robust_limits(below, [residual], around=0.0)
    below.set_ylabel("Residual [dB]")
    time_axis(below, start)
    shown = legend_of(below, lambda label: label.startswith(("measured", "RMSE")))
    below.legend(
        *shown, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, markerscale=4, borderaxespad=0.1
    )  # fmt: skip
    return fig


def _offset(offset_db: float) -> str:
    return f"less its offset of {signed(offset_db)} dB" if np.isfinite(offset_db) else "no offset"


def _moved(level_dbm: FloatArray, offset_db: float) -> FloatArray:
    """A simulated level among the levels of the log."""
    return level_dbm - offset_db if np.isfinite(offset_db) else level_dbm


def channels_over_time(data: ReportData, pair: PairResult, panels: Sequence[RssResult]) -> Figure:
    """Both channels of a tower and the ray tracing over time, spans in which they part shaded (the paper's Fig. 15)."""
    start, (first, second) = start_of(data), panels
    fig, ax = subplots((9.2, 3.6))
    for span in pair.score.spans:
        ax.axvspan(*seconds_since(np.array(instants(pair.time, span)), start), color="0.88", linewidth=0, zorder=0)
    moved = second.score.offset_db - first.score.offset_db
    shown = ((first, 0.0, MEASURED, "as logged"), (second, moved, SECOND, f"moved by {signed(moved)} dB"))
    for panel, by, colour, words in shown:
        seconds = seconds_since(panel.time, start)
        dots(ax, seconds, panel.measured_db + by, 2.5, color=colour, label=f"{panel.channel}, {words}")
    seconds, simulated = seconds_since(first.time, start), _moved(first.simulated_dbm, first.score.offset_db)
    draw_out_of_coverage(ax, seconds, first.simulated_out_of_coverage, "Z: no path in the simulation")
    ax.plot(*thinned(seconds, simulated), color=SIMULATED, linewidth=1.0, label="ray tracing")
    draw_waypoints(ax, data.moments, start)
    time_axis(ax, start)
    ax.set_ylabel(f"RSS [{first.unit}]")
    robust_limits(ax, [first.measured_db, second.measured_db + moved, simulated])
    legend_below(ax, 3)
    return fig
