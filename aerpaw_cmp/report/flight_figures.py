"""Figures of a flight as files. ``map --with`` also writes the figures that compare two channels."""

from __future__ import annotations

import textwrap
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from ..common.kml import CLASS_COLOURS
from ..common.text import counted
from ..common.units import BoolArray, FloatArray, spread_out
from ..compare.result import PairResult, RankResult, RssResult
from . import canvas
from .canvas import FigureSpec, mark
from .flight_data import RANKS, DrawnTrack, ReportData, start_of, used_towers
from .flight_words import count, instants, pretty, signed
from .texts import k_key, number, safe_name

if TYPE_CHECKING:
    from matplotlib.figure import Figure


# Colours of Okabe and Ito (jfly.uni-koeln.de/color) that differ in lightness.
MEASURED = "#56B4E9"
SECOND = "#7A3FA0"
SIMULATED = "#111111"
BASELINE = {
    "free_space": ("#D55E00", (0, (5, 2))),
    "two_ray": ("#009E73", (0, (1, 1.5))),
    "log_distance": ("#CC79A7", (0, (6, 2, 1, 2))),
    "constant": ("#0072B2", (0, (8, 3))),
}
WAYPOINT = "#555555"

RANK_MARKER = {0: "x", 1: "o", 2: "s", 3: "^", 4: "D"}


def figure_specs(data: ReportData) -> list[FigureSpec]:
    """Return all figures that the data allow. Equal file names get a number."""
    specs = []
    if data.track is not None and len(data.track.time):
        specs += [FigureSpec(draw.__name__, partial(draw, data, data.track)) for draw in (trajectory, altitude)]
    for panel in (panel for panel in data.rss if len(panel.time)):
        name = f"rss_{safe_name(panel.tower)}_{safe_name(panel.channel)}"
        specs.append(FigureSpec(name, partial(rss_over_time, data, panel)))
    specs += channel_specs(data)
    for rank in (rank for rank in data.rank if len(rank.time)):
        stem = safe_name(rank.tower)
        specs.append(FigureSpec(f"rank_histogram_{stem}", partial(rank_histograms, rank)))
        specs.append(FigureSpec(f"rank_map_{stem}", partial(rank_maps, data, rank)))
        specs.append(FigureSpec(f"rank_time_{stem}", partial(rank_over_time, data, rank)))
    used = Counter[str]()
    for i, spec in enumerate(specs):
        used[spec.name] += 1
        if used[spec.name] > 1:
            specs[i] = replace(spec, name=f"{spec.name}_{used[spec.name]}")
    return specs


def channel_specs(data: ReportData) -> Iterator[FigureSpec]:
    """Yield figures with both channels of a tower in one panel (the paper's Fig. 15)."""
    panels = {(panel.tower, panel.channel): panel for panel in data.rss if panel.score.n}
    for pair in data.pairs:
        both = [panels[pair.tower, name] for name in (pair.first, pair.second) if (pair.tower, name) in panels]
        if len(both) == 2:
            name = "_".join(map(safe_name, ("rss_channels", pair.tower, pair.first, pair.second)))
            yield FigureSpec(name, partial(channels_over_time, data, pair, both))


# --- track --------------------------------------------------------------------------------------


def trajectory(data: ReportData, track: DrawnTrack) -> Figure:
    """Draw the flight on the plan of the site, with its height as colour."""
    fig, ax = canvas.subplots((9.2, 7.6))
    canvas.draw_site(ax, data.site)
    # draw tracks of towers that move, because a symbol shows only the middle of the track
    ways = {item.tower: item.tower_m[:, :2] for item in data.series if item.tower_m is not None}
    for name, way in ways.items():
        look = {"color": canvas.TOWER, "linewidth": 1.2, "linestyle": (0, (4, 2)), "zorder": 4.5}
        ax.plot(*way[spread_out(len(way), canvas.POINTS_PER_LINE)].T, label=f"track of {name}", **look)
    points = ax.scatter(
        *track.position_m.T[:2], c=track.position_m[:, 2], cmap="cividis", s=5, linewidths=0, rasterized=True, zorder=3,
        label="flight (colour: height)",
    )  # fmt: skip
    flown = track.position_m[:, :2]
    extent, centre = np.nanmax([*np.ptp(flown, axis=0), 100.0]), np.nanmean(flown, axis=0)
    places = (data.site.towers[name].position_m[None, :2] for name in used_towers(data))
    # omit distant towers, because the flight would shrink to a dot
    near = [place for place in places if np.linalg.norm(place - centre) < extent]
    canvas.frame_around(ax, *np.concatenate([flown, *near, *ways.values()]).T)
    for waypoint in data.waypoints:
        ax.annotate(
            waypoint.label, (waypoint.east_m, waypoint.north_m), fontsize=8, ha="center", va="center", zorder=7,
            bbox={"boxstyle": "circle,pad=0.15", "facecolor": "white", "edgecolor": WAYPOINT},
        )  # fmt: skip
    canvas.colour_bar(fig, points, ax, "Height above ground [m]")
    fig.legend(loc="outside lower center", ncols=6)
    return fig


def altitude(data: ReportData, track: DrawnTrack) -> Figure:
    """Draw height over time."""
    height = mark("line", "height of the UAV", canvas.seconds_since(track.time, start_of(data)), track.position_m[:, 2])
    return over_time(data, [({"label": "Height above ground [m]"}, [height])], [2.2])


# --- over time ----------------------------------------------------------------------------------


def over_time(
    data: ReportData, panels: Sequence[tuple[Mapping[str, Any], Sequence[Any]]], high_in: Sequence[float]
) -> Figure:
    """Draw charts one below the other over the time of a flight, with its waypoints.

    Parameters
    ----------
    data : ReportData
    panels : sequence of (mapping, sequence of mapping)
        For each chart: the vertical axis (``label``, and optionally ``ends`` and ``ticks``), and the marks over the
        seconds since the first time of the report.
    high_in : sequence of float
        Height of each chart [inch].

    Returns
    -------
    Figure
    """
    start = start_of(data)
    points = [(point.label, float((point.time - start) / np.timedelta64(1, "s"))) for point in data.waypoints]
    fig, grid = canvas.subplots(
        (9.2, 0.7 + sum(high_in)), len(panels), 1, sharex=True, height_ratios=high_in, squeeze=False
    )
    for row, (ax, (ordinate, marks)) in enumerate(zip(grid[:, 0], panels, strict=True)):
        canvas.draw_marks(ax, marks)
        for label, at in points:
            name = "waypoint" if row == 0 and label == points[0][0] else None
            ax.axvline(at, color=WAYPOINT, linewidth=0.8, linestyle=(0, (2, 2)), label=name)
            if row == 0:
                ax.annotate(label, (at, 1.01), xycoords=ax.get_xaxis_transform(), ha="center", fontsize=8)
        if "ticks" in ordinate:
            ax.set_yticks(ordinate["ticks"])
        ax.set(ylabel=ordinate["label"], ylim=ordinate.get("ends") or _limits(marks))
        handles, labels = ax.get_legend_handles_labels()
        names = [textwrap.fill(label, 26) for label in labels]
        legend = ax.legend(handles, names, loc="center left", bbox_to_anchor=(1.0, 0.5))
        for handle in legend.get_lines():  # in a legend, dots of the chart's size are too small
            handle.set_markersize(5.0 if handle.get_linestyle() == "None" else 0.0)
    canvas.time_axis(grid[-1, 0], start)
    return fig


def _limits(marks: Sequence[Mapping[str, Any]]) -> tuple[float, float]:
    """Return the 0.2 to 99.8 % range of lines and dots with a margin, so that a few deep nulls do not extend it."""
    values = np.concatenate([item["y"][np.isfinite(item["y"])] for item in marks if "y" in item])
    low, high = np.percentile(values, [0.2, 99.8]) if len(values) else (-1.0, 1.0)
    margin = max(0.08 * (high - low), 0.5)
    return low - margin, high + margin


def _spans(seconds: FloatArray, mask: BoolArray, name: str, **look: Any) -> dict[str, Any]:
    """Return the mark of the segments in which the samples at these times (n,) are True."""
    # extend each segment by half a step on each side, so that a single sample is visible
    half = float(np.median(np.diff(seconds))) / 2 if len(seconds) > 1 else 0.5
    first, last = canvas.runs(mask)
    # join segments closer than a pixel
    apart = seconds[first[1:]] - seconds[last[:-1]] >= (seconds[-1] - seconds[0]) / _MOST_SPANS
    first, last = first[np.append(True, apart)[: len(first)]], last[np.append(apart, True)[: len(last)]]
    look = {"colour": "#EEEEEE", "hatch": "////", **look}
    return mark("spans", name, seconds[first] - half, ends=seconds[last] + half, **look)


# Largest number of segments on a time axis. The number exceeds the pixels of the axis.
_MOST_SPANS = 2000
NO_PATH, SHADE = "out of coverage: no path in the simulation", "#DDDDDD"


def rss_over_time(data: ReportData, panel: RssResult) -> Figure:
    """Draw over time the logged level, simulation and baselines minus their offsets, and the residual."""
    seconds, score = canvas.seconds_since(panel.time, start_of(data)), panel.score
    simulated = _moved(panel.simulated_dbm, score.offset_db)
    silent = panel.measured_out_of_coverage
    marks = [
        _spans(seconds, panel.simulated_out_of_coverage, NO_PATH),
        _spans(seconds, silent, "no signal in the measurement", height=0.05, hatch="xxxxx"),
    ]
    if panel.stated is not None:
        band = panel.stated.columns(simulated)
        low, high = band["simulated_low_dbm"], band["simulated_high_dbm"]
        marks.append(mark("band", "90 % band", seconds, low=low, high=high, colour=SIMULATED, alpha=0.15))
    lines = {}
    for name, baseline in panel.baselines.items():
        (colour, dash), level = BASELINE[name], _moved(baseline.level_dbm, baseline.offset_db)
        lines[name] = mark("line", f"{pretty(name)} (own offset)", seconds, level, colour=colour, dash=dash)
    # the dense fringes of two-ray ground would hide other lines
    marks += [lines.pop("two_ray")] if "two_ray" in lines else []
    offset = f"minus its offset of {signed(score.offset_db)} dB" if np.isfinite(score.offset_db) else "no offset"
    marks += [
        mark("line", f"ray tracing, {offset}", seconds, simulated, colour=SIMULATED, dash="-"),
        mark("dots", f"measured, as logged ({count(score.n)} scored)", seconds, panel.measured_db, colour=MEASURED),
        *lines.values(),
    ]
    rmse = np.full(2, score.rmse_db)
    residual = [
        mark("band", f"±RMSE, {number(score.rmse_db, 1, 'dB')}", seconds[[0, -1]], low=-rmse, high=rmse, colour=SHADE),
        mark("dots", "measured − simulated", seconds, panel.residual_db, colour="#0072B2"),
    ]
    levels = {"label": f"RSS [{panel.unit}]"}
    return over_time(data, [(levels, marks), ({"label": "Residual [dB]"}, residual)], [3.6, 1.5])


def _moved(level_dbm: FloatArray, offset_db: float) -> FloatArray:
    """Return a simulated level on the scale of the log."""
    return level_dbm - offset_db if np.isfinite(offset_db) else level_dbm


def channels_over_time(data: ReportData, pair: PairResult, panels: Sequence[RssResult]) -> Figure:
    """Draw both channels of a tower and the ray tracing. Segments in which the channels differ are shaded (Fig. 15)."""
    start, (first, second) = start_of(data), panels
    ends = [canvas.seconds_since(np.array(instants(pair.time, span)), start) for span in pair.score.spans]
    parted = np.array(ends).reshape(-1, 2).T
    moved = second.score.offset_db - first.score.offset_db
    shown = ((first, 0.0, MEASURED, "as logged"), (second, moved, SECOND, f"moved by {signed(moved)} dB"))
    seconds, simulated = canvas.seconds_since(first.time, start), _moved(first.simulated_dbm, first.score.offset_db)
    marks = [
        mark("spans", "channels differ", parted[0], ends=parted[1], colour=SHADE),
        _spans(seconds, first.simulated_out_of_coverage, NO_PATH),
        mark("line", "ray tracing", seconds, simulated, colour=SIMULATED, dash="-"),
    ]
    marks += [
        mark("dots", f"{p.channel}, {words}", canvas.seconds_since(p.time, start), p.measured_db + by, colour=colour)
        for p, by, colour, words in shown
    ]
    return over_time(data, [({"label": f"RSS [{first.unit}]"}, marks)], [2.9])


# --- rank ---------------------------------------------------------------------------------------


def rank_maps(data: ReportData, panel: RankResult) -> Figure:
    """Draw the measured rank and the rank predicted for every K along the flight, with a colour and marker per rank."""
    maps = [("Measured (reported RI)", panel.measured)]
    maps += [(f"Ray tracing, K = {k_key(k)}", rank.astype(float)) for k, rank in panel.rank.items()]
    columns = 2 if len(maps) > 1 else 1
    rows = -(-len(maps) // columns)
    east, north, _ = panel.position_m.T
    shape = canvas.plan_shape(east, north)
    # 1.6 inches are for title, axis label and a legend of two lines
    fig, axes = canvas.subplots((9.2, rows * (3.9 / shape + 1.6)), rows, columns, squeeze=False)
    for ax, (title, rank) in zip(axes.ravel(), maps, strict=False):
        canvas.draw_site(ax, data.site)
        entries = []
        for value in (value for value in (0, *RANKS) if (rank == value).any()):
            at, look = rank == value, {"color": "black", "linewidths": 0.8}
            if value:
                look = {"facecolor": CLASS_COLOURS[value], "edgecolors": "#222222", "linewidths": 0.25}
            entries.append(ax.scatter(
                east[at], north[at], s=14, marker=RANK_MARKER[value], rasterized=True, **look,
                label=f"{f'rank {value}' if value else 'no path'} ({count(int(at.sum()))})",
                zorder=3.0 + 1.0 / at.sum(),  # rare ranks on top, so that they are visible
            ))  # fmt: skip
        ax.set_title(title)
        ax.legend(handles=entries, loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=3, markerscale=1.6)
        canvas.frame_around(ax, east, north, shape=shape)
    for ax in axes.ravel()[len(maps) :]:
        ax.set_visible(False)
    return fig


def rank_histograms(panel: RankResult) -> Figure:
    """Draw the shares of rank 1 to 4, measured and for every K, with intervals if known."""
    from matplotlib import colormaps

    fig, ax = canvas.subplots((9.2, 3.4))
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
    ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return fig


def rank_over_time(data: ReportData, panel: RankResult) -> Figure:
    """Draw the measured rank and the rank for every K over time, above SINR and singular values."""
    seconds = canvas.seconds_since(panel.time, start_of(data))
    fresh, tick = panel.score.staleness.fresh, {"marker": "|", "size": 7}
    held_over, reported = (np.where(at, panel.measured, np.nan) for at in (~fresh, fresh))
    measured = [mark("dots", "measured", seconds, reported, colour="#0072B2", **tick)]
    if not fresh.all():
        grey = {"marker": "|", "size": 4, "colour": "#9A9A9A"}
        measured.insert(0, mark("dots", "measured, held over", seconds, held_over, **grey))
    ranks = {"label": "Rank", "ends": (0.5, 4.5), "ticks": RANKS}
    panels: list[Any] = [(ranks, measured)]
    for k, rank in panel.rank.items():
        simulated = np.where(rank == 0, np.nan, rank)
        level = mark("dots", f"K = {k_key(k)}", seconds, simulated, colour=SIMULATED, **tick)
        panels.append((ranks, [_spans(seconds, rank == 0, "out of coverage: no path"), level]))
    if panel.sinr_db is not None:
        panels.append(({"label": "SINR [dB]"}, [mark("dots", "SINR", seconds, panel.sinr_db, colour="#0072B2")]))
    ratios = [
        mark("dots", f"σ{chr(0x2082 + i)}/σ₁", seconds, values, colour=colour)
        for i, (values, colour) in enumerate(zip(panel.singular_ratio_db.T, _SINGULAR, strict=False))
    ]
    ratios += [
        mark("line", f"1/K, K = {k_key(k)}", seconds[[0, -1]], np.full(2, -20 * np.log10(k))) for k in panel.rank
    ]
    # values below -110 dB are rounding errors
    lowest = max(min(float(np.nanmin(item["y"], initial=-20.0)) for item in ratios) - 6.0, -110.0)
    panels.append(({"label": "Singular value\nover largest [dB]", "ends": (lowest, 2.0)}, ratios))
    return over_time(data, panels, [1.1] * (len(panels) - 1) + [2.2])


# Colours of the singular values after the first.
_SINGULAR = ("#111111", "#0072B2", "#9AD0F0")
