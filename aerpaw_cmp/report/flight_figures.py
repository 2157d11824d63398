"""Figures of a flight as files. ``map --with`` also writes the figures that compare two channels."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from ..common.kml import CLASS_COLOURS
from ..common.text import counted
from ..common.units import FloatArray, spread_out
from ..compare.result import PairResult, RankResult, RssResult
from ..site.site import Site
from .canvas import (
    BASELINE,
    MEASURED,
    POINTS_PER_LINE,
    RANK_MARKER,
    SECOND,
    SIMULATED,
    TOWER,
    WAYPOINT,
    FigureSpec,
    colour_bar,
    dots,
    draw_out_of_coverage,
    draw_site,
    draw_waypoints,
    frame_around,
    legend_below,
    legend_of,
    plan_shape,
    robust_limits,
    seconds_since,
    subplots,
    thinned,
    time_axis,
)
from .flight_data import RANKS, ReportData, Track, start_of, used_towers
from .flight_words import count, instants, pretty, signed
from .texts import k_key, number, safe_name

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def figure_specs(data: ReportData) -> list[FigureSpec]:
    """Return all figures that the data allow. Equal file names get a number."""
    used: dict[str, int] = {}
    result = []
    for spec in (*_track_and_level(data), *channel_specs(data), *_ranks(data)):
        times = used[spec.name] = used.get(spec.name, 0) + 1
        result.append(spec if times == 1 else replace(spec, name=f"{spec.name}_{times}"))
    return result


def _track_and_level(data: ReportData) -> Iterator[FigureSpec]:
    if data.track is not None and len(data.track.time):
        yield FigureSpec("trajectory", partial(trajectory, data, data.track))
        yield FigureSpec("altitude", partial(altitude, data, data.track))
    for panel in data.rss:
        if len(panel.time):
            name = f"rss_{safe_name(panel.tower)}_{safe_name(panel.channel)}"
            yield FigureSpec(name, partial(rss_over_time, data, panel))


def _ranks(data: ReportData) -> Iterator[FigureSpec]:
    for panel in (panel for panel in data.rank if len(panel.time)):
        stem = safe_name(panel.tower)
        yield FigureSpec(f"rank_histogram_{stem}", partial(rank_histograms, panel))
        yield FigureSpec(f"rank_map_{stem}", partial(rank_maps, data, panel))
        yield FigureSpec(f"rank_time_{stem}", partial(rank_over_time, data, panel))


def channel_specs(data: ReportData) -> Iterator[FigureSpec]:
    """Yield figures with both channels of a tower in one panel (the paper's Fig. 15)."""
    panels = {(panel.tower, panel.channel): panel for panel in data.rss if panel.score.n}
    for pair in data.pairs:
        both = [panels[pair.tower, name] for name in (pair.first, pair.second) if (pair.tower, name) in panels]
        if len(both) == 2:
            name = "_".join(map(safe_name, ("rss_channels", pair.tower, pair.first, pair.second)))
            yield FigureSpec(name, partial(channels_over_time, data, pair, both))


# --- track --------------------------------------------------------------------------------------


def trajectory(data: ReportData, track: Track) -> Figure:
    """Draw the flight on the plan of the site, and enlarged with its height as colour."""
    fig, (site_plan, close) = subplots((9.2, 5.4), 1, 2, width_ratios=(1.0, 1.35))
    # draw tracks of towers that move, because a symbol shows only the middle of the track
    ways = {item.tower: item.tower_m[:, :2] for item in data.series if item.tower_m is not None}
    for ax in (site_plan, close):
        draw_site(ax, data.site)
        for name, way in ways.items():
            line = way[spread_out(len(way), POINTS_PER_LINE)].T
            ax.plot(*line, color=TOWER, linewidth=1.2, linestyle=(0, (4, 2)), zorder=4.5, label=f"track of {name}")
    flown = np.column_stack([track.east_m, track.north_m])
    some = spread_out(len(flown), POINTS_PER_LINE)  # evenly spaced points show the shape of the track
    site_plan.plot(*flown[some].T, color="#0072B2", linewidth=1.0, label="flight", zorder=4)
    points = close.scatter(
        track.east_m, track.north_m, c=track.up_m, cmap="cividis", s=5, linewidths=0, rasterized=True, zorder=3,
        label="flight (colour: height)",
    )  # fmt: skip
    places = {name: tower.position_m[None, :2] for name, tower in data.site.towers.items()}
    frame_around(site_plan, *np.concatenate([flown, *places.values()]).T, least_m=200.0, shape=0.75)
    extent, centre = np.nanmax([*np.ptp(flown, axis=0), 100.0]), np.nanmean(flown, axis=0)
    used = (places[name] for name in used_towers(data))
    # omit distant towers, because the flight would be a dot next to them
    near = [place for place in used if np.linalg.norm(place - centre) < extent]
    frame_around(close, *np.concatenate([flown, *near, *ways.values()]).T)
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
    """Draw height over time, with waypoints."""
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
    """Draw over time: the level as logged, simulation and baselines minus their offsets, and the residual."""
    start, score = start_of(data), panel.score
    seconds = seconds_since(panel.time, start)
    fig, (ax, below) = subplots((9.2, 5.6), 2, 1, sharex=True, height_ratios=(2.6, 1.0))
    draw_out_of_coverage(ax, seconds, panel.simulated_out_of_coverage, "out of coverage: no path in the simulation")
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
            linewidth=1.2, zorder=2.5 if name == "two_ray" else 3.7,  # its dense fringes would hide other lines
            label=f"{pretty(name)} (own offset)",
        )  # fmt: skip
    label = f"ray tracing, {_offset(score.offset_db)}"
    ax.plot(*thinned(seconds, simulated), color=SIMULATED, linewidth=1.0, label=label, zorder=3)
    if panel.stated is not None:
        some = slice(None, None, max(1, len(seconds) // POINTS_PER_LINE))
        band = panel.stated.columns(simulated)
        low, high = (band[f"simulated_{end}_dbm"][some] for end in ("low", "high"))
        ax.fill_between(seconds[some], low, high, color=SIMULATED, alpha=0.15, linewidth=0, label="90 % band", zorder=1)
    dots(ax, seconds, simulated, 1.5, color=SIMULATED, zorder=3)  # a line does not show a point between two gaps
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
    below.legend(*shown, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, markerscale=4, borderaxespad=0.1)
    return fig


def _offset(offset_db: float) -> str:
    return f"minus its offset of {signed(offset_db)} dB" if np.isfinite(offset_db) else "no offset"


def _moved(level_dbm: FloatArray, offset_db: float) -> FloatArray:
    """Return a simulated level on the scale of the log."""
    return level_dbm - offset_db if np.isfinite(offset_db) else level_dbm


def channels_over_time(data: ReportData, pair: PairResult, panels: Sequence[RssResult]) -> Figure:
    """Draw both channels of a tower and the ray tracing. Segments in which the channels differ are shaded (Fig. 15)."""
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
    draw_out_of_coverage(ax, seconds, first.simulated_out_of_coverage, "out of coverage: no path in the simulation")
    ax.plot(*thinned(seconds, simulated), color=SIMULATED, linewidth=1.0, label="ray tracing")
    draw_waypoints(ax, data.moments, start)
    time_axis(ax, start)
    ax.set_ylabel(f"RSS [{first.unit}]")
    robust_limits(ax, [first.measured_db, second.measured_db + moved, simulated])
    legend_below(ax, 3)
    return fig


# --- rank ---------------------------------------------------------------------------------------


def _rank_map(ax: Axes, site: Site, east: FloatArray, north: FloatArray, rank: FloatArray, title: str) -> None:
    """Draw ranks at their positions, with a colour and a marker for each. NaN is not drawn.

    Parameters
    ----------
    ax : Axes
    site : Site
    east, north : (n,)
        Positions [m].
    rank : (n,)
        Ranks 1 to 4; 0 if there is no path, NaN if unknown.
    title : str
    """
    draw_site(ax, site)
    for value, at in ((value, rank == value) for value in (0, *RANKS) if (rank == value).any()):
        style: dict[str, Any] = {"color": "black", "linewidths": 0.8}
        if value:
            style = {"facecolor": CLASS_COLOURS[value], "edgecolors": "#222222", "linewidths": 0.25}
        ax.scatter(
            east[at], north[at], s=14, marker=RANK_MARKER[value], rasterized=True, **style,
            label=f"{f'rank {value}' if value else 'no path'} ({count(int(at.sum()))})",
            zorder=3.0 + 1.0 / at.sum(),  # rare ranks on top, so that they are visible
        )  # fmt: skip
    ax.set_title(title)
    ax.legend(
        *legend_of(ax, lambda label: label.startswith(("rank", "no path"))), loc="upper center",
        bbox_to_anchor=(0.5, -0.13), ncols=3, markerscale=1.6, columnspacing=1.0,
    )  # fmt: skip


def rank_maps(data: ReportData, panel: RankResult) -> Figure:
    """Draw the measured rank and the rank of every K along the flight."""
    maps = [("Measured (reported RI)", panel.measured)]
    maps += [(f"Ray tracing, K = {k_key(k)}", rank.astype(float)) for k, rank in panel.rank.items()]
    columns = 2 if len(maps) > 1 else 1
    rows = -(-len(maps) // columns)
    east, north, _ = panel.position_m.T
    shape = plan_shape(east, north)
    # 1.6 inches are for title, axis label and a legend of two lines
    fig, axes = subplots((9.2, rows * (3.9 / shape + 1.6)), rows, columns, squeeze=False)
    for ax, (title, rank) in zip(axes.ravel(), maps, strict=False):
        _rank_map(ax, data.site, east, north, rank, title)
        frame_around(ax, east, north, shape=shape)
    for ax in axes.ravel()[len(maps) :]:
        ax.set_visible(False)
    return fig


def rank_histograms(panel: RankResult) -> Figure:
    """Draw the shares of rank 1 to 4, measured and for every K, with intervals if known."""
    from matplotlib import colormaps

    fig, ax = subplots((9.2, 3.4))
    reported = int(np.isfinite(panel.measured).sum())
    score = panel.score
    series = [(f"measured ({counted(reported, 'sample')})", score.histogram, score.histogram_ci95)]
    series += [
        (f"K = {k_key(k)} (total variation {number(fit.total_variation, 2)})", fit.histogram, fit.histogram_ci95)
        for k, fit in score.simulated.items()
    ]
    width = 0.8 / len(series)
    for i, (label, shares, intervals) in enumerate(series):
        at = np.array(RANKS) + (i - (len(series) - 1) / 2) * width
        shade = SIMULATED if i == 0 else colormaps["cividis"](0.25 + 0.75 * i / (len(series) - 1))
        share = np.nan_to_num(shares)
        ax.bar(
            at, 100 * share, width * 0.92, color=shade, edgecolor="black", linewidth=0.6, label=label,
            hatch=("", "///", "xxx", "...", "---", "\\\\\\")[i % 6],
        )  # fmt: skip
        low, high = np.array(intervals, dtype=np.float64).T
        spread = 100 * np.stack([share - low, high - share]).clip(min=0)
        if np.isfinite(spread).any():
            ax.errorbar(at, 100 * share, spread, fmt="none", ecolor="#D55E00", elinewidth=1.3, capsize=2.5)
    ax.set_xticks(RANKS, [f"{r}" for r in RANKS])
    ax.set(xlabel="Channel rank", ylabel="Share of the samples in coverage [%]")
    ax.grid(axis="x", visible=False)
    legend_below(ax)
    return fig


def rank_over_time(data: ReportData, panel: RankResult) -> Figure:
    """Draw the measured rank and the rank for every K over time, above SINR and singular values."""
    start = start_of(data)
    seconds = seconds_since(panel.time, start)
    rows = 1 + len(panel.rank)
    below = [1.3] * (panel.sinr_db is not None) + [2.2]
    ratios = [1.0] * rows + below
    fig, axes = subplots((9.2, 1.1 * sum(ratios) + 0.5), len(ratios), 1, sharex=True, height_ratios=ratios)
    _draw_measured_rank(axes[0], seconds, panel)
    for ax, (k, rank) in zip(axes[1:], panel.rank.items(), strict=False):
        ax.plot(
            seconds, np.where(rank == 0, np.nan, rank), linestyle="none", marker="|", markersize=7, rasterized=True,
            color=SIMULATED, label=f"K = {k_key(k)}",
        )  # fmt: skip
        draw_out_of_coverage(ax, seconds, rank == 0, "out of coverage: no path")
    for ax in axes[:rows]:
        draw_waypoints(ax, data.moments, start, names=ax is axes[0])
        ax.set_yticks(RANKS)
        ax.set(ylim=(0.5, 4.5), ylabel="Rank")
        ax.legend(*legend_of(ax, lambda label: label != "waypoint"), loc="center left", bbox_to_anchor=(1.0, 0.5))
    if panel.sinr_db is not None:
        dots(axes[rows], seconds, panel.sinr_db, color="#0072B2", label="SINR")
        axes[rows].set_ylabel("SINR [dB]")
        axes[rows].legend(loc="center left", bbox_to_anchor=(1.0, 0.5), markerscale=4)
    _draw_singular_values(axes[-1], seconds, panel)
    time_axis(axes[-1], start)
    return fig


def _draw_measured_rank(ax: Axes, seconds: FloatArray, panel: RankResult) -> None:
    """Draw reported ranks as ticks. Ranks that repeat an earlier report are smaller and grey."""
    held_over = ~panel.score.staleness.fresh
    for mask, label, colour, size in (
        (~held_over, "measured", "#0072B2", 7),
        (held_over, "measured, held over", "#9A9A9A", 4),
    ):
        if mask.any():
            ax.plot(
                seconds[mask], panel.measured[mask], linestyle="none", marker="|", markersize=size, color=colour,
                rasterized=True, label=label,
            )  # fmt: skip


def _draw_singular_values(ax: Axes, seconds: FloatArray, panel: RankResult) -> None:
    """Draw singular values relative to the largest, with every threshold K."""
    values = panel.singular_ratio_db
    for column, colour in enumerate(("#111111", "#0072B2", "#9AD0F0")[: values.shape[1]]):
        dots(ax, seconds, values[:, column], color=colour, label=f"σ{chr(0x2082 + column)}/σ₁")
    for k in panel.rank:
        level = -20 * np.log10(k)
        ax.axhline(level, color=TOWER, linewidth=0.9, linestyle=(0, (5, 2)), label="thresholds 1/K")
        ax.annotate(
            f"K = {k_key(k)}", (0.004, level), xycoords=ax.get_yaxis_transform(), fontsize=7, va="bottom", color=TOWER,
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 0.6}, zorder=6,
        )  # fmt: skip
    lowest = [-20 * np.log10(k) for k in panel.rank] + values[np.isfinite(values)].tolist()
    ax.set_ylim(max(min(lowest, default=-20.0) - 6.0, -110.0), 2.0)  # values below -110 dB are rounding errors
    ax.set_ylabel("Singular value\nover largest [dB]")
    # one legend entry for all thresholds
    entries = dict(zip(*ax.get_legend_handles_labels()[::-1], strict=True))
    ax.legend(entries.values(), entries.keys(), loc="center left", bbox_to_anchor=(1.0, 0.5), markerscale=4)
