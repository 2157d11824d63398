"""Figures of a report: finished arrays in, matplotlib figures out.

No pyplot and no global state: every figure is a :class:`matplotlib.figure.Figure` of its own, drawn inside
:func:`style`. Colours are told apart in grey as well, by lightness, line style, marker or hatch. Clouds of points
are rasterised and long lines thinned (extremes kept), so that an SVG stays small however long the flight.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..common.units import AnyArray, BoolArray, FloatArray
from ..logs.records import has_wall_clock
from ..site.site import Site, Trees
from .data import GEOMETRY, RANKS, ChannelPair, Histogram, RankAtK, RankPanel, ReportData, RssPanel, SpeedRow, Track
from .export import k_key, safe_name, write_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

# Okabe & Ito's palette (jfly.uni-koeln.de/color), chosen here for distinct lightness too
MEASURED = "#56B4E9"
SIMULATED = "#111111"
BASELINE = {"free_space": ("#D55E00", (0, (5, 2))), "two_ray": ("#009E73", (0, (1, 1.5)))}
OTHER_BASELINES = (("#CC79A7", (0, (6, 2, 1, 2))), ("#0072B2", (0, (8, 3))))
OUT_OF_COVERAGE = "#BBBBBB"
TOWER = "#C1121F"
BUILDING = "#8A8A8A"
FOREST = "#B9D8B0"
WAYPOINT = "#555555"

BASELINE_TITLE = {"free_space": "free space", "two_ray": "two-ray ground"}
RANK_MARKER = {0: "x", 1: "o", 2: "s", 3: "^", 4: "D"}
RANK_HATCH = {1: "", 2: "///", 3: "xx", 4: ".."}

POINTS_PER_LINE = 3000
RASTER_DPI = 130
WIDE = (9.2, 4.2)


@dataclass(frozen=True, slots=True, kw_only=True)
class Plate:
    """A figure that can be drawn, with the words that go with it."""

    name: str
    section: str
    title: str
    caption: str
    alt: str
    draw: Callable[[], Figure]


@dataclass(frozen=True, slots=True, kw_only=True)
class Picture:
    """A drawn plate."""

    name: str
    section: str
    title: str
    caption: str
    alt: str
    svg: bytes
    png: bytes


@contextmanager
def style() -> Iterator[None]:
    """The look of every figure, without touching the user's settings."""
    import matplotlib

    settings = {
        "font.family": "sans-serif",
        "font.sans-serif": ["DejaVu Sans"],
        "font.size": 9.0,
        "axes.titlesize": 10.0,
        "axes.titleweight": "bold",
        "axes.titlelocation": "left",
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.axisbelow": True,
        "axes.grid": True,
        "grid.color": "#E2E2E2",
        "grid.linewidth": 0.6,
        "legend.frameon": True,
        "legend.framealpha": 0.9,
        "legend.edgecolor": "#DDDDDD",
        "legend.fontsize": 8.0,
        "hatch.linewidth": 0.5,
        "figure.dpi": 100.0,
        "savefig.dpi": RASTER_DPI,
        "svg.fonttype": "path",  # the page must look the same where the font is missing
        "svg.hashsalt": "aerpaw-cmp",  # same numbers, same bytes
        "path.simplify": True,
        "figure.autolayout": False,  # the layout is set here, and is switched off again when it is done
        "figure.constrained_layout.use": False,
    }
    with matplotlib.rc_context(settings):
        yield


def figure(size: tuple[float, float] = WIDE) -> Figure:
    """An empty figure [inch] whose parts do not overlap."""
    from matplotlib.figure import Figure

    return Figure(figsize=size, layout="constrained")


def save(fig: Figure) -> tuple[bytes, bytes]:
    """The figure as SVG and PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    # the canvases themselves: Figure.savefig draws everything once more, unseen, before each file
    svg, png = io.BytesIO(), io.BytesIO()
    fig.set_dpi(RASTER_DPI)
    FigureCanvasAgg(fig).print_png(png, pil_kwargs={"compress_level": 2})
    fig.set_layout_engine("none")  # the parts have their places now; a second layout would cost as much as a drawing
    FigureCanvasSVG(fig).print_svg(svg, metadata={"Date": None})
    return svg.getvalue(), png.getvalue()


def render(plate: Plate) -> Picture:
    """Draw a plate and forget the figure."""
    with style():
        svg, png = save(plate.draw())
    return Picture(
        name=plate.name,
        section=plate.section,
        title=plate.title,
        caption=plate.caption,
        alt=plate.alt,
        svg=svg,
        png=png,
    )


def write_plates(plates: Sequence[Plate], folder: Path) -> tuple[list[Picture], list[Path]]:
    """Draw plates one after the other and write each as SVG and PNG; gives the pictures and the files."""
    drawn, written = [], []
    for plate in plates:
        picture = render(plate)
        drawn.append(picture)
        written.append(write_file(folder / f"{picture.name}.svg", picture.svg))
        written.append(write_file(folder / f"{picture.name}.png", picture.png))
    return drawn, written


# --- parts --------------------------------------------------------------------------------------


def seconds_since(time: AnyArray, start: np.datetime64) -> FloatArray:
    """Instants as seconds after ``start``."""
    return np.asarray((np.asarray(time) - start) / np.timedelta64(1, "s"), dtype=np.float64)


def start_of(data: ReportData) -> np.datetime64:
    """The instant that is zero on every time axis: the first of the track, or of any panel."""
    times = [] if data.track is None or not len(data.track.time) else [data.track.time[0]]
    panels: list[RssPanel | RankPanel] = [*data.rss, *data.rank]
    times += [panel.time[0] for panel in panels if len(panel.time)]
    if not times:
        return np.datetime64(0, "ns")
    return times[0] if data.track is not None and len(data.track.time) else min(times)


def time_label(start: np.datetime64) -> str:
    """Label of a time axis.

    Examples
    --------
    >>> time_label(np.datetime64("2025-06-01T14:00:00.25")), time_label(np.datetime64("1970-01-01T00:02:29"))
    ('Time after 2025-06-01 14:00:00 UTC [s]', 'Time after the first sample [s]')
    """
    if not has_wall_clock(start):
        return "Time after the first sample [s]"
    return f"Time after {str(start)[:19].replace('T', ' ')} UTC [s]"


def count(n: int) -> str:
    """A number of samples, thousands set apart.

    Examples
    --------
    >>> count(3172) == "3\N{NARROW NO-BREAK SPACE}172", count(40)
    (True, '40')
    """
    return f"{n:,}".replace(",", "\N{NARROW NO-BREAK SPACE}")


def plain_ticks(axis: Axis) -> None:
    """Decades of a logarithmic axis as plain numbers (0.01, 1, 1000): read at a glance, and drawn faster."""
    from matplotlib.ticker import FuncFormatter, NullFormatter

    axis.set_major_formatter(FuncFormatter(lambda value, _at: f"{value:.10g}".replace("-", "\N{MINUS SIGN}")))
    axis.set_minor_formatter(NullFormatter())


def thinned(east: FloatArray, north: FloatArray, limit: int = POINTS_PER_LINE) -> tuple[FloatArray, FloatArray]:
    """A line with at most about ``limit`` points that looks the same: both extremes of each stretch are kept.

    Parameters
    ----------
    east, north : (n,)
        Abscissa and ordinate; NaN in the ordinate breaks the line and is kept as a break.

    Examples
    --------
    >>> a, b = thinned(np.arange(100000.0), np.sin(np.arange(100000.0)))
    >>> len(a) <= 3002, bool(b.max() > 0.999999)
    (True, True)
    """
    n = len(east)
    if n <= limit:
        return east, north
    per = -(-2 * n // limit)
    buckets = -(-n // per)
    padded = np.full(buckets * per, np.nan)
    padded[:n] = north
    table = padded.reshape(buckets, per)
    gone = np.isnan(table)
    low = np.where(gone, np.inf, table).argmin(axis=1)
    high = np.where(gone, -np.inf, table).argmax(axis=1)
    base = np.arange(buckets) * per
    index = np.minimum(np.sort(np.stack([base + low, base + high], axis=1), axis=1).ravel(), n - 1)
    return east[index], north[index]


def spread_out(count: int, most: int) -> AnyArray:
    """At most ``most`` indices of ``count``, evenly spread, both ends included.

    Examples
    --------
    >>> spread_out(9, 3).tolist(), spread_out(2, 5).tolist(), spread_out(0, 3).tolist()
    ([0, 4, 8], [0, 1], [])
    """
    return np.linspace(0, count - 1, min(count, most)).round().astype(np.int64) if count else np.zeros(0, np.int64)


def runs(mask: BoolArray) -> list[tuple[int, int]]:
    """Stretches of True as (first, last) indices, both inside.

    Examples
    --------
    >>> runs(np.array([True, False, True, True]))
    [(0, 0), (2, 3)]
    """
    edges = np.diff(np.concatenate([[0], np.asarray(mask, dtype=np.int8), [0]]))
    return list(zip(np.flatnonzero(edges == 1).tolist(), (np.flatnonzero(edges == -1) - 1).tolist(), strict=True))


def lonely(level: FloatArray) -> BoolArray:
    """Finite samples whose neighbours are both missing.

    Examples
    --------
    >>> lonely(np.array([1.0, np.nan, 2.0, 3.0, np.nan])).tolist()
    [True, False, False, False, False]
    """
    good = np.isfinite(level)
    beside = np.zeros(len(good), dtype=bool)
    beside[1:] |= good[:-1]
    beside[:-1] |= good[1:]
    return np.asarray(good & ~beside)


def draw_out_of_coverage(
    ax: Axes, seconds: FloatArray, mask: BoolArray, label: str, *, height: float = 1.0, hatch: str = "////"
) -> None:
    """Hatched spans, marked Z where there is room, over a share of the height of the axes."""
    if not mask.any():
        return
    step = float(np.median(np.diff(seconds))) if len(seconds) > 1 else 1.0
    spans = [(seconds[a] - step / 2, seconds[b] - seconds[a] + step) for a, b in runs(mask)]
    bars = ax.broken_barh(
        spans, (0.0, height), transform=ax.get_xaxis_transform(), facecolor="#EEEEEE", edgecolor="#888888",
        hatch=hatch, linewidth=0.0, label=label, zorder=0.5 if height == 1.0 else 4.0,
    )  # fmt: skip
    bars.set_rasterized(len(spans) > 300)
    whole = max(float(seconds[-1] - seconds[0]), step)
    for left, width in spans:
        if width > 0.015 * whole and height == 1.0:
            ax.text(
                left + width / 2, 0.93, "Z", transform=ax.get_xaxis_transform(), ha="center", va="center", zorder=6,
                fontweight="bold", bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.0},
            )  # fmt: skip


def draw_waypoints(ax: Axes, data: ReportData, start: np.datetime64, *, names: bool = True) -> None:
    """Vertical lines at the named moments of the flight."""
    for number, waypoint in enumerate(data.waypoints):
        at = float((waypoint.time - start) / np.timedelta64(1, "s"))
        ax.axvline(at, color=WAYPOINT, linewidth=0.8, linestyle=(0, (2, 2)), label="waypoint" if number == 0 else None)
        if names:
            ax.annotate(
                waypoint.label, (at, 1.0), xycoords=ax.get_xaxis_transform(), xytext=(0, 2),
                textcoords="offset points", ha="center", va="bottom", fontsize=8, color=WAYPOINT,
            )  # fmt: skip


def legend_below(ax: Axes, columns: int = 4) -> None:
    """A legend under the axes, where it hides no data."""
    handles, labels = ax.get_legend_handles_labels()
    if handles:
        ax.legend(handles, labels, loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=columns, borderaxespad=0.0)


def pretty(name: str) -> str:
    """A baseline's name in words."""
    return BASELINE_TITLE.get(name, name.replace("_", " "))


def baseline_style(name: str, number: int) -> tuple[str, Any]:
    """Colour and line style of a baseline."""
    return BASELINE.get(name, OTHER_BASELINES[number % len(OTHER_BASELINES)])


def rank_colour(rank: int) -> Any:
    """Colour of rank 1 to 4, from dark to light in even steps; black for the crosses of 0."""
    from matplotlib import colormaps

    return "black" if rank == 0 else colormaps["viridis"]((0.02, 0.38, 0.70, 1.0)[rank - 1])


# --- site ---------------------------------------------------------------------------------------


def draw_site(ax: Axes, site: Site, *, towers: Sequence[str] | None = None, names: bool = True) -> None:
    """Forests, trees, buildings, geofences and towers on a plan (east, north) [m]."""
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path as Outline

    def patch(polygon: Any, **options: Any) -> None:
        rings = [polygon.exterior, *polygon.interiors]
        outline = Outline.make_compound_path(*(Outline(np.asarray(r.coords)[:, :2], closed=True) for r in rings))
        ax.add_patch(PathPatch(outline, **options))

    invented = " (illustrative)" if site.illustrative else ""
    for number, forest in enumerate(site.forests):
        patch(
            forest.area, facecolor=FOREST, edgecolor="#7FA873", hatch="..", linewidth=0.6, alpha=0.7, zorder=0.3,
            label=f"forest{invented}" if number == 0 else None,
        )  # fmt: skip
    if len(site.trees):
        _draw_crowns(ax, site.trees, f"tree{invented}")
    for number, building in enumerate(site.buildings):
        patch(
            building.footprint, facecolor=BUILDING, edgecolor="black", linewidth=0.7, zorder=0.6,
            label=f"building{invented}" if number == 0 else None,
        )  # fmt: skip
    for number, fence in enumerate(site.geofences):
        patch(
            fence.area, facecolor="none", edgecolor="#333333", linestyle=(0, (4, 3)), linewidth=0.9, zorder=0.6,
            label="geofence" if number == 0 else None,
        )  # fmt: skip
    chosen = [t for name, t in site.towers.items() if towers is None or name in towers]
    for number, tower in enumerate(chosen):
        ax.plot(
            tower.east_m, tower.north_m, marker="^", markersize=9, color=TOWER, markeredgecolor="black",
            linestyle="none", zorder=5, label="tower" if number == 0 else None,
        )  # fmt: skip
        if names:
            ax.annotate(
                tower.name, (tower.east_m, tower.north_m), xytext=(6, 4), textcoords="offset points", zorder=6,
                fontsize=8, fontweight="bold", annotation_clip=True,
                bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.75, "pad": 0.8},
            )  # fmt: skip
    plan_axes(ax)


def _draw_crowns(ax: Axes, trees: Trees, label: str) -> None:
    """Crowns to scale, each with a dot where the trunk stands."""
    from matplotlib.collections import EllipseCollection

    wide, places = trees.crown_diameter_m, np.column_stack([trees.east_m, trees.north_m])
    crowns = EllipseCollection(
        wide, wide, np.zeros(len(trees)), units="xy", offsets=places, offset_transform=ax.transData,
        facecolor="#5E8C4F", alpha=0.45, linewidth=0, zorder=0.4,
    )  # fmt: skip
    crowns.set_rasterized(True)
    ax.add_collection(crowns, autolim=False)
    ax.scatter(trees.east_m, trees.north_m, s=1.5, color="#2F5A25", linewidths=0, rasterized=True, zorder=0.45)
    ax.plot([], [], marker="o", markersize=6, color="#5E8C4F", alpha=0.6, linestyle="none", label=label)


def plan_axes(ax: Axes) -> None:
    """Labels and equal scale of a plan."""
    ax.set_aspect("equal", adjustable="box")
    ax.set_xlabel("East of the site origin [m]")
    ax.set_ylabel("North of the site origin [m]")


def frame_around(
    ax: Axes, east: FloatArray, north: FloatArray, *, margin: float = 0.08, least_m: float = 60.0, shape: float = 1.0
) -> None:
    """Limits of a plan around points, with a margin and a least extent [m]; ``shape`` is width over height."""
    good = np.isfinite(east) & np.isfinite(north)
    if not good.any():
        return
    east, north = east[good], north[good]
    width = max(float(np.ptp(east)) * (1 + 2 * margin), least_m)
    height = max(float(np.ptp(north)) * (1 + 2 * margin), least_m)
    width, height = max(width, height * shape), max(height, width / shape)
    middle_east, middle_north = (east.min() + east.max()) / 2, (north.min() + north.max()) / 2
    ax.set_xlim(middle_east - width / 2, middle_east + width / 2)
    ax.set_ylim(middle_north - height / 2, middle_north + height / 2)


def plan_shape(east: FloatArray, north: FloatArray) -> float:
    """Width over height of the area that points cover, kept between 0.8 and 2."""
    good = np.isfinite(east) & np.isfinite(north)
    if not good.any():
        return 1.0
    return float(np.clip((np.ptp(east[good]) + 60.0) / (np.ptp(north[good]) + 60.0), 0.8, 2.0))


def beyond(values: FloatArray, low: float, high: float) -> str:
    """Ends of a colour scale from ``low`` to ``high`` that values pass: its colours mean "or more" there.

    Examples
    --------
    >>> beyond(np.array([1.0, 9.0]), 0.0, 5.0), beyond(np.array([1.0, np.nan]), 0.0, 5.0)
    ('max', 'neither')
    """
    under, over = bool(np.nanmin(values, initial=np.inf) < low), bool(np.nanmax(values, initial=-np.inf) > high)
    return {(True, True): "both", (True, False): "min", (False, True): "max"}.get((under, over), "neither")


def colour_bar(fig: Figure, mappable: Any, ax: Any, label: str, extend: str = "neither") -> Any:
    """A colour bar that an SVG holds as one picture, without seams; with arrows where values lie beyond."""
    bar = fig.colorbar(mappable, ax=ax, label=label, shrink=0.85, extend=extend, extendfrac=0.03)
    if bar.solids is not None:
        bar.solids.set_rasterized(True)
        bar.solids.set_edgecolor("face")
    return bar


def used_towers(data: ReportData) -> list[str]:
    """Towers that a panel of the report names, or all."""
    panels: list[RssPanel | RankPanel] = [*data.rss, *data.rank]
    used = dict.fromkeys(panel.tower for panel in panels)
    return [name for name in used if name in data.site.towers] or list(data.site.towers)


def trajectory(data: ReportData, track: Track) -> Figure:
    """The flight on the plan of the whole site, and closer, coloured by height."""
    fig = figure((9.2, 5.4))
    whole, close = fig.subplots(1, 2, width_ratios=(1.0, 1.35))
    draw_site(whole, data.site)
    draw_site(close, data.site)
    whole.plot(*thinned_plan(track.east_m, track.north_m), color="#0072B2", linewidth=1.0, label="flight", zorder=4)
    points = close.scatter(
        track.east_m, track.north_m, c=track.up_m, cmap="cividis", s=5, linewidths=0, rasterized=True, zorder=3,
        label="flight (colour: height)",
    )  # fmt: skip
    towers = list(data.site.towers.values())
    whole_east = np.concatenate([[t.east_m for t in towers], track.east_m[np.isfinite(track.east_m)]])
    whole_north = np.concatenate([[t.north_m for t in towers], track.north_m[np.isfinite(track.north_m)]])
    frame_around(whole, whole_east, whole_north, least_m=200.0, shape=0.75)
    near = [data.site.towers[name] for name in used_towers(data)]
    extent = float(np.nanmax([np.ptp(track.east_m), np.ptp(track.north_m), 100.0])) if len(track.east_m) else 100.0
    centre = np.array([np.nanmean(track.east_m), np.nanmean(track.north_m)])
    near = [t for t in near if np.hypot(t.east_m - centre[0], t.north_m - centre[1]) < extent]
    frame_around(
        close,
        np.concatenate([track.east_m, [t.east_m for t in near]]),
        np.concatenate([track.north_m, [t.north_m for t in near]]),
    )
    for waypoint in data.waypoints:
        close.annotate(
            waypoint.label, (waypoint.east_m, waypoint.north_m), fontsize=8, ha="center", va="center", zorder=7,
            bbox={"boxstyle": "circle,pad=0.15", "facecolor": "white", "edgecolor": WAYPOINT},
        )  # fmt: skip
    colour_bar(fig, points, close, "Height above ground [m]")
    whole.set_title("Whole site")
    close.set_title("The flight")
    whole.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=2)
    close.legend(*only(close, ("flight (colour: height)",)), loc="upper center", bbox_to_anchor=(0.5, -0.12))
    return fig


def thinned_plan(east: FloatArray, north: FloatArray, limit: int = POINTS_PER_LINE) -> tuple[FloatArray, FloatArray]:
    """Every so many points of a plan line: shape matters there, not extremes."""
    step = max(1, -(-len(east) // limit))
    return east[::step], north[::step]


def only(ax: Axes, labels: Sequence[str]) -> tuple[list[Any], list[str]]:
    """Handles and labels of the named legend entries."""
    pairs = [(h, t) for h, t in zip(*ax.get_legend_handles_labels(), strict=True) if t in labels]
    return [h for h, _ in pairs], [t for _, t in pairs]


def altitude(data: ReportData, track: Track) -> Figure:
    """Height over time, with waypoints and the ground speed below."""
    start = start_of(data)
    seconds = seconds_since(track.time, start)
    fig = figure((9.2, 2.9))
    ax = fig.subplots()
    ax.plot(*thinned(seconds, track.up_m), color=SIMULATED, linewidth=1.2, label="height of the UAV")
    draw_waypoints(ax, data, start)
    ax.set_xlabel(time_label(start))
    ax.set_ylabel("Height above ground [m]")
    ax.set_ylim(bottom=min(0.0, float(np.nanmin(track.up_m, initial=0.0))))
    fig.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return fig


# --- RSS ----------------------------------------------------------------------------------------


def rss_over_time(data: ReportData, panel: RssPanel) -> Figure:
    """Calibrated measurement, simulation and baselines over time, and the residual under them."""
    start = start_of(data)
    seconds = seconds_since(panel.time, start)
    fig = figure((9.2, 5.6))
    ax, below = fig.subplots(2, 1, sharex=True, height_ratios=(2.6, 1.0))
    draw_out_of_coverage(ax, seconds, panel.simulated_out_of_coverage, "Z: no path in the simulation")
    draw_out_of_coverage(
        ax, seconds, panel.measured_out_of_coverage, "no signal in the measurement", height=0.05, hatch="xxxxx"
    )
    ax.plot(
        seconds, panel.calibrated_db, linestyle="none", marker=".", markersize=2.5, color=MEASURED, rasterized=True,
        label=f"measured {signed(panel.offset_db)} dB ({count(panel.n)} scored)", zorder=3.5,
    )  # fmt: skip
    for number, baseline in enumerate(panel.baselines):
        colour, dashes = baseline_style(baseline.name, number)
        # each model is drawn where its own best offset puts it against the same calibrated points
        level = baseline.level_dbm + (panel.offset_db - baseline.offset_db)
        ax.plot(
            *thinned(seconds, level), color=colour, linestyle=dashes, linewidth=1.2,
            zorder=2.5 if baseline.name == "two_ray" else 3.7,  # its dense fringes would hide the rest
            label=f"{pretty(baseline.name)} (own offset)",
        )  # fmt: skip
    ax.plot(*thinned(seconds, panel.simulated_dbm), color=SIMULATED, linewidth=1.0, label="ray tracing", zorder=3)
    alone = lonely(panel.simulated_dbm)  # a line shows no single point between two gaps
    ax.plot(seconds[alone], panel.simulated_dbm[alone], linestyle="none", marker=".", markersize=4, color=SIMULATED)
    draw_waypoints(ax, data, start)
    robust_limits(ax, [panel.calibrated_db, panel.simulated_dbm])
    ax.set_ylabel("RSS [dBm]")
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.03), ncols=3, markerscale=3)
    below.plot(
        seconds, panel.residual_db, linestyle="none", marker=".", markersize=2, color="#0072B2", rasterized=True,
        label="measured − simulated",
    )  # fmt: skip
    below.axhline(0.0, color=SIMULATED, linewidth=0.8)
    if np.isfinite(panel.rmse_db):
        for sign in (-1, 1):
            below.axhline(
                sign * panel.rmse_db, color=SIMULATED, linewidth=0.8, linestyle=(0, (4, 3)),
                label=f"RMSE {panel.rmse_db:.1f} dB" if sign == 1 else None,
            )  # fmt: skip
    draw_waypoints(below, data, start, names=False)
    robust_limits(below, [panel.residual_db], around=0.0)
    below.set_ylabel("Residual [dB]")
    below.set_xlabel(time_label(start))
    handles, labels = only(below, ("measured − simulated", f"RMSE {panel.rmse_db:.1f} dB"))
    below.legend(
        handles, labels, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, markerscale=4, borderaxespad=0.1
    )  # fmt: skip
    return fig


def signed(value: float) -> str:
    """A number with its sign set off: ``+ 52.1``.

    Examples
    --------
    >>> signed(52.13), signed(-4.0)
    ('+ 52.1', '− 4.0')
    """
    if not np.isfinite(value):
        return "(no offset) 0"
    return f"{'−' if value < 0 else '+'} {abs(value):.1f}"


def robust_limits(ax: Axes, levels: Sequence[FloatArray], around: float | None = None) -> None:
    """Ordinate limits that a few two-ray nulls cannot stretch: the 0.2 to 99.8 % range and a margin."""
    values = np.concatenate([level[np.isfinite(level)] for level in levels])
    if not len(values):
        ax.set_ylim(-1.0, 1.0)
        return
    low, high = np.percentile(values, [0.2, 99.8])
    if around is not None:
        reach = max(abs(low - around), abs(high - around), 1.0)
        low, high = around - reach, around + reach
    margin = max(0.08 * (high - low), 0.5)
    ax.set_ylim(low - margin, high + margin)


def rss_diagnostics(panel: RssPanel) -> Figure:
    """Measured against simulated, histogram of the residual, RMSE against offset, residual against distance."""
    fig = figure((9.2, 3.1))
    curve = panel.offset_curve is not None
    axes = fig.subplots(1, 3 if curve else 2)
    scatter_levels(axes[0], panel)
    residual_histogram(axes[1], panel)
    if panel.offset_curve is not None:
        offset_curve(axes[2], panel)
    return fig


def scatter_levels(ax: Axes, panel: RssPanel) -> None:
    """Calibrated measurement against simulation, with the line of equality."""
    ax.plot(
        panel.simulated_dbm, panel.calibrated_db, linestyle="none", marker=".", markersize=2, alpha=0.5,
        color="#0072B2", rasterized=True, label=f"sample ({count(panel.n)})",
    )  # fmt: skip
    both = np.isfinite(panel.simulated_dbm) & np.isfinite(panel.calibrated_db)
    if both.any():
        values = np.concatenate([panel.simulated_dbm[both], panel.calibrated_db[both]])
        low, high = np.percentile(values, [0.2, 99.8])
        low, high = low - 2.0, high + 2.0
        ax.plot([low, high], [low, high], color=SIMULATED, linewidth=1.0, label="equal")
        ax.set_xlim(low, high)
        ax.set_ylim(low, high)
    ax.set_aspect("equal", adjustable="box")
    ax.set_xlabel("Simulated RSS [dBm]")
    ax.set_ylabel("Measured RSS after offset [dBm]")
    ax.set_title("Sample by sample")
    ax.legend(loc="upper left", markerscale=4)


def residual_histogram(ax: Axes, panel: RssPanel) -> None:
    """Histogram of the residual beside the normal curve of the same RMSE."""
    residual = panel.residual_db[np.isfinite(panel.residual_db)]
    if len(residual):
        reach = max(float(np.percentile(np.abs(residual), 99.8)), 1.0)
        bins = np.linspace(-reach, reach, 41)
        ax.hist(
            np.clip(residual, -reach, reach), bins.tolist(), density=True, color=MEASURED, edgecolor="white",
            linewidth=0.3, label=f"residual ({count(len(residual))})",
        )  # fmt: skip
        if np.isfinite(panel.rmse_db) and panel.rmse_db > 0:
            at = np.linspace(-reach, reach, 200)
            height = np.exp(-0.5 * (at / panel.rmse_db) ** 2) / (panel.rmse_db * np.sqrt(2 * np.pi))
            ax.plot(at, height, color=SIMULATED, linewidth=1.0, linestyle=(0, (4, 2)), label="normal, same RMSE")
        ax.set_ylim(top=1.35 * ax.get_ylim()[1])  # room for the legend above the bars
        ax.legend(loc="upper left", fontsize=7)
    ax.set_xlabel("Measured − simulated [dB]")
    ax.set_ylabel("Density [1/dB]")
    ax.set_title("Residual")


def offset_curve(ax: Axes, panel: RssPanel) -> None:
    """RMSE against the candidate offset, with the chosen one and those of the baselines."""
    curve = panel.offset_curve
    if curve is None:
        return
    ax.plot(*thinned(curve.offset_db, curve.rmse_db), color=SIMULATED, linewidth=1.2, label="ray tracing")
    span = (float(np.min(curve.offset_db)), float(np.max(curve.offset_db)))
    if np.isfinite(panel.offset_db):
        edge = " (edge of the search!)" if panel.at_search_edge else ""
        ax.plot(
            panel.offset_db, panel.rmse_db, marker="o", color=TOWER, linestyle="none",
            label=f"chosen: {signed(panel.offset_db).replace(' ', '')} dB{edge}",
        )  # fmt: skip
    for number, baseline in enumerate(panel.baselines):
        colour, dashes = baseline_style(baseline.name, number)
        if np.isfinite(baseline.offset_db):
            ax.axvline(baseline.offset_db, color=colour, linestyle=dashes, linewidth=1.0, label=pretty(baseline.name))
    centres = [panel.offset_db, *(b.offset_db for b in panel.baselines)]
    near = [c for c in centres if np.isfinite(c)]
    if near:
        # the shape near the minimum decides; the rest of the span is a straight line
        low, high = min(near) - 10.0, max(near) + 10.0
        shown = (curve.offset_db >= low) & (curve.offset_db <= high) & np.isfinite(curve.rmse_db)
        ax.set_xlim(low, high)
        ax.set_ylim(0.0, 1.5 * float(np.max(curve.rmse_db[shown], initial=1.0)))
        for a, b in ((low, span[0]), (span[1], high)):
            if a < b:
                ax.axvspan(a, b, color="#DDDDDD", hatch="///", linewidth=0, label="not searched")
    ax.set_xlabel(f"Offset added [dB]\n(searched {span[0]:.0f} to {span[1]:.0f})".replace("-", "−"))
    ax.set_ylabel("RMSE [dB]")
    ax.set_title("Is the offset well defined?")
    ax.legend(loc="upper center", fontsize=7)


def residual_against_geometry(panel: RssPanel) -> Figure:
    """Residual against distance, angles, height, foliage, split by line of sight where known."""
    names = [name for name in GEOMETRY if name in panel.geometry]
    columns = -(-len(names) // 2) if len(names) > 3 else len(names)
    rows = -(-len(names) // columns)
    fig = figure((9.2, 2.6 * rows + 0.5))
    grid = fig.add_gridspec(rows, columns)
    axes: list[Axes] = []
    for number, name in enumerate(names):
        row, column = divmod(number, columns)
        ax = fig.add_subplot(grid[row, column], sharey=axes[0] if axes else None)
        axes.append(ax)
        residual_cloud(ax, panel.geometry[name], panel)
        ax.locator_params(axis="x", nbins=5)
        ax.set_xlabel(GEOMETRY[name].replace(" in the frame of the tower antenna", ",\ntower antenna frame")
                      .replace(" seen from the tower", "").replace(" above ground", "")
                      .replace("deg clockwise from north", "deg from north"))  # fmt: skip
        if column:
            ax.tick_params(labelleft=False)
        else:
            ax.set_ylabel("Measured − simulated [dB]")
    robust_limits(axes[0], [panel.residual_db], around=0.0)
    legend = fig.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=5, markerscale=4)
    handles: list[Any] = legend.legend_handles
    for handle in handles:
        if handle.get_linestyle() not in ("None", ""):  # markers on a line are not enlarged
            handle.set_markersize(1.6)
    return fig


def residual_cloud(ax: Axes, quantity: FloatArray, panel: RssPanel) -> None:
    """Residual against one quantity, with its running median and middle 80 %."""
    residual = panel.residual_db
    sight = panel.line_of_sight
    groups = (
        [("sample", np.isfinite(residual), "#56B4E9", ".")]
        if sight is None
        else [
            ("line of sight", sight & np.isfinite(residual), "#56B4E9", "."),
            ("no line of sight", ~sight & np.isfinite(residual), "#D55E00", "x"),
        ]
    )
    for label, chosen, colour, marker in groups:
        if chosen.any():
            ax.plot(
                quantity[chosen], residual[chosen], linestyle="none", marker=marker, markersize=2, alpha=0.5,
                color=colour, rasterized=True, label=f"{label} ({count(int(chosen.sum()))})",
            )  # fmt: skip
    ax.axhline(0.0, color=SIMULATED, linewidth=0.8)
    good = np.isfinite(quantity) & np.isfinite(residual)
    if good.sum() < 40 or np.ptp(quantity[good]) == 0:
        return
    bins = int(np.clip(good.sum() // 40, 8, 20))
    middle, low, median, high = running_levels(quantity[good], residual[good], bins).T
    ax.plot(middle, median, color=SIMULATED, linewidth=1.3, marker="o", markersize=1.6, label="median")
    ax.plot(middle, low, color=SIMULATED, linewidth=0.8, linestyle=(0, (3, 2)), label="10 % and 90 %")
    ax.plot(middle, high, color=SIMULATED, linewidth=0.8, linestyle=(0, (3, 2)))


def running_levels(quantity: FloatArray, values: FloatArray, bins: int = 20, fewest: int = 8) -> FloatArray:
    """Mean quantity and 10, 50, 90 % points of the values in bins of equal width (bins, 4).

    NaN where a bin has fewer than ``fewest`` samples: no line is drawn over what was not flown.

    Examples
    --------
    >>> at = np.concatenate([np.arange(40.0), 360.0 + np.arange(41.0)])
    >>> levels = running_levels(at, at)
    >>> np.flatnonzero(np.isfinite(levels[:, 2])).tolist(), levels[0].round(3).tolist()
    ([0, 1, 18, 19], [9.5, 1.9, 9.5, 17.1])
    """
    edges = np.linspace(quantity.min(), quantity.max(), bins + 1)
    which = np.clip(np.searchsorted(edges, quantity, side="right") - 1, 0, bins - 1)
    levels = np.full((bins, 4), np.nan)
    for number in range(bins):
        inside = which == number
        if inside.sum() >= fewest:
            levels[number] = quantity[inside].mean(), *np.percentile(values[inside], [10, 50, 90])
    return levels


def seen_from_antennas(panel: RssPanel) -> Figure:
    """Where the tower's antenna sees the UAV and the UAV's sees the tower, each in its own frame; colour: residual."""
    seen = panel.geometry
    views = [("UAV, tower antenna frame", seen["azimuth_deg"], seen.get("tower_elevation_deg", seen["elevation_deg"]))]
    if {"uav_azimuth_deg", "uav_elevation_deg"} <= set(seen):
        views.append(("tower, UAV antenna frame", seen["uav_azimuth_deg"], seen["uav_elevation_deg"]))
    residual = panel.residual_db
    known = residual[np.isfinite(residual)]
    reach = float(np.percentile(np.abs(known), 98)) if known.size else 1.0
    fig = figure((9.2, 3.6))
    axes = fig.subplots(1, len(views), squeeze=False)[0]
    for ax, (words, azimuth, elevation) in zip(axes, views, strict=True):
        good = np.isfinite(residual) & np.isfinite(azimuth) & np.isfinite(elevation)
        if (~good).any():
            ax.plot(
                azimuth[~good], elevation[~good], linestyle="none", marker="x", markersize=3, color="#888888",
                rasterized=True, label=f"not scored ({count(int((~good).sum()))})",
            )  # fmt: skip
        points = ax.scatter(
            azimuth[good], elevation[good], c=residual[good], s=6, cmap="cividis", vmin=-reach, vmax=reach,
            linewidths=0, rasterized=True, label=f"sample ({count(int(good.sum()))}; colour: residual)",
        )  # fmt: skip
        ax.axvline(0.0, color=SIMULATED, linewidth=0.8, linestyle=(0, (4, 2)), label="boresight")
        ax.set_facecolor("#F4F4F4")
        ax.set_xlim(-180, 180)
        ax.set_xticks(range(-180, 181, 90))
        ax.set_xlabel(f"Azimuth of the {words} [deg]")
        ax.set_ylabel("Elevation in that frame [deg]")
    colour_bar(fig, points, list(axes), "Measured − simulated [dB]", beyond(known, -reach, reach))
    fig.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, markerscale=2)
    return fig


def channel_difference(data: ReportData, pair: ChannelPair) -> Figure:
    """First minus second channel over time, measured and simulated, with the limit beyond which they part."""
    start = start_of(data)
    seconds = seconds_since(pair.time, start)
    fig = figure((9.2, 3.2))
    ax = fig.subplots()
    ax.plot(
        seconds, pair.difference_db, linestyle="none", marker=".", markersize=2.5, color=MEASURED, rasterized=True,
        label=f"measured ({count(int(np.isfinite(pair.difference_db).sum()))})", zorder=3,
    )  # fmt: skip
    levels = [pair.difference_db]
    if pair.simulated_difference_db is not None:
        ax.plot(*thinned(seconds, pair.simulated_difference_db), color=SIMULATED, linewidth=0.9, label="ray tracing")
        levels.append(pair.simulated_difference_db)
    for sign in (-1, 1):
        ax.axhline(
            sign * pair.limit_db, color=TOWER, linewidth=0.9, linestyle=(0, (5, 2)),
            label=f"{pair.limit_db:g} dB apart" if sign == 1 else None,
        )  # fmt: skip
    draw_waypoints(ax, data, start)
    robust_limits(ax, levels, around=0.0)
    reach = max(ax.get_ylim()[1], 1.1 * pair.limit_db)  # the limit is drawn, so it is seen
    ax.set_ylim(-reach, reach)
    ax.set_xlabel(time_label(start))
    ax.set_ylabel(f"{pair.first} − {pair.second} [dB]")
    fig.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=4, markerscale=3)
    return fig


# --- rank ---------------------------------------------------------------------------------------


def rank_map(ax: Axes, site: Site, east: FloatArray, north: FloatArray, rank: FloatArray, title: str) -> None:
    """Ranks at their positions: colour and marker differ; 0 is Z, NaN is left out."""
    draw_site(ax, site)
    for value in (0, *RANKS):
        at = rank == value
        number = int(at.sum())
        if not number:
            continue
        look: dict[str, Any] = {"color": "black", "linewidths": 0.8}
        if value:
            look = {"facecolor": rank_colour(value), "edgecolors": "#222222", "linewidths": 0.25}
        ax.scatter(
            east[at], north[at], s=14, marker=RANK_MARKER[value], rasterized=True, **look,
            label=f"{'Z: no path' if value == 0 else f'rank {value}'} ({count(number)})",
            zorder=3.0 + 1.0 / number,  # the rarer a rank, the higher it lies: a few points must not vanish under many
        )  # fmt: skip
    ax.set_title(title)
    pairs = [(h, t) for h, t in zip(*ax.get_legend_handles_labels(), strict=True) if t.startswith(("rank", "Z"))]
    if pairs:
        handles, labels = zip(*pairs, strict=True)
        ax.legend(
            handles, labels, loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=3, markerscale=1.6,
            columnspacing=1.0,
        )  # fmt: skip


def rank_maps(data: ReportData, panel: RankPanel) -> Figure:
    """Measured rank and the rank of every K along the flight."""
    maps = [("Measured (reported RI)", panel.measured)]
    maps += [(f"Ray tracing, K = {k_key(at.k)}", at.rank.astype(float)) for at in panel.simulated]
    columns = 2 if len(maps) > 1 else 1
    rows = -(-len(maps) // columns)
    shape = plan_shape(panel.east_m, panel.north_m)
    fig = figure((9.2, rows * (3.9 / shape + 1.1)))
    axes = fig.subplots(rows, columns, squeeze=False)
    for ax, (title, rank) in zip(axes.ravel(), maps, strict=False):
        rank_map(ax, data.site, panel.east_m, panel.north_m, rank, title)
        frame_around(ax, panel.east_m, panel.north_m, shape=shape)
    for ax in axes.ravel()[len(maps) :]:
        ax.set_visible(False)
    return fig


def rank_histograms(panel: RankPanel) -> Figure:
    """Shares of rank 1 to 4, measured beside every K, with intervals where known."""
    fig = figure((9.2, 3.4))
    ax = fig.subplots()
    reported = int(np.isfinite(panel.measured).sum())
    series: list[tuple[str, Histogram]] = [(f"measured ({count(reported)} samples)", panel.histogram)]
    series += [(at_label(at), at.histogram) for at in panel.simulated]
    width = 0.8 / len(series)
    from matplotlib import colormaps

    for number, (label, histogram) in enumerate(series):
        at = np.array(RANKS) + (number - (len(series) - 1) / 2) * width
        shade = SIMULATED if number == 0 else colormaps["cividis"](0.25 + 0.75 * number / max(len(series) - 1, 1))
        share = np.nan_to_num(histogram.share)
        ax.bar(
            at, 100 * share, width * 0.92, color=shade, edgecolor="black", linewidth=0.6, label=label,
            hatch=("", "///", "xxx", "...", "---", "\\\\\\")[number % 6],
        )  # fmt: skip
        if histogram.low is not None and histogram.high is not None:
            spread = 100 * np.stack([share - histogram.low, histogram.high - share]).clip(min=0)
            ax.errorbar(at, 100 * share, spread, fmt="none", ecolor="#D55E00", elinewidth=1.3, capsize=2.5)
    ax.set_xticks(RANKS, [f"{r}" for r in RANKS])
    ax.set_xlabel("Channel rank")
    ax.set_ylabel("Share of the samples in coverage [%]")
    ax.grid(axis="x", visible=False)
    legend_below(ax)
    return fig


def at_label(at: RankAtK) -> str:
    """Legend entry of one K."""
    distance = "" if not np.isfinite(at.total_variation) else f" (total variation {at.total_variation:.2f})"
    return f"K = {k_key(at.k)}{distance}"


def rank_over_time(data: ReportData, panel: RankPanel) -> Figure:
    """Measured rank and the rank of every K over time, one row each; SINR and singular values under them."""
    start = start_of(data)
    seconds = seconds_since(panel.time, start)
    rows = 1 + len(panel.simulated)
    below = [1.3] * (panel.sinr_db is not None) + [2.2] * (panel.singular_ratio_db is not None)
    ratios = [1.0] * rows + below
    fig = figure((9.2, 1.1 * sum(ratios) + 0.5))
    axes = fig.subplots(len(ratios), 1, sharex=True, height_ratios=ratios, squeeze=False)[:, 0]
    draw_measured_rank(axes[0], seconds, panel)
    for ax, at in zip(axes[1:], panel.simulated, strict=False):
        rank = np.where(at.rank == 0, np.nan, at.rank)
        ax.plot(
            seconds, rank, linestyle="none", marker="|", markersize=7, rasterized=True, color=SIMULATED,
            label=f"K = {k_key(at.k)}",
        )  # fmt: skip
        draw_out_of_coverage(ax, seconds, at.rank == 0, "Z: no path")
    for number, ax in enumerate(axes[:rows]):
        draw_waypoints(ax, data, start, names=number == 0)
        ax.set_yticks(RANKS)
        ax.set_ylim(0.5, 4.5)
        ax.set_ylabel("Rank")
        ax.legend(*first_labels(ax, 2), loc="center left", bbox_to_anchor=(1.0, 0.5))
    if panel.sinr_db is not None:
        axes[rows].plot(
            seconds, panel.sinr_db, linestyle="none", marker=".", markersize=2, color="#0072B2", rasterized=True,
            label="SINR",
        )  # fmt: skip
        axes[rows].set_ylabel("SINR [dB]")
        axes[rows].legend(loc="center left", bbox_to_anchor=(1.0, 0.5), markerscale=4)
    if panel.singular_ratio_db is not None:
        draw_singular_values(axes[-1], seconds, panel.singular_ratio_db, panel)
    axes[-1].set_xlabel(time_label(start))
    return fig


def draw_measured_rank(ax: Axes, seconds: FloatArray, panel: RankPanel) -> None:
    """Reported ranks as ticks; those held over from an earlier report are smaller and grey."""
    held = np.zeros(len(seconds), dtype=bool) if panel.stale is None else panel.stale
    for mask, label, colour, size in (
        (~held, "measured", "#0072B2", 7),
        (held, "measured, held over", "#9A9A9A", 4),
    ):
        if mask.any():
            ax.plot(
                seconds[mask], panel.measured[mask], linestyle="none", marker="|", markersize=size, color=colour,
                rasterized=True, label=label,
            )  # fmt: skip


def first_labels(ax: Axes, count: int) -> tuple[list[Any], list[str]]:
    """Legend entries but the waypoints."""
    pairs = [(h, t) for h, t in zip(*ax.get_legend_handles_labels(), strict=True) if t != "waypoint"][:count]
    return [h for h, _ in pairs], [t for _, t in pairs]


def draw_singular_values(ax: Axes, seconds: FloatArray, values: FloatArray, panel: RankPanel) -> None:
    """Singular values relative to the largest, with every threshold K."""
    for column, (colour, marker) in enumerate((("#111111", "."), ("#0072B2", "."), ("#9AD0F0", "."))):
        ax.plot(
            seconds, values[:, column], linestyle="none", marker=marker, markersize=2, color=colour, rasterized=True,
            label=rf"$\sigma_{column + 2}/\sigma_1$",
        )  # fmt: skip
    for number, at in enumerate(panel.simulated):
        level = -20 * np.log10(at.k)
        ax.axhline(
            level, color=TOWER, linewidth=0.9, linestyle=(0, (5, 2)), label="thresholds 1/K" if not number else None
        )
        ax.annotate(
            f"K = {k_key(at.k)}",
            (0.004, level),
            xycoords=ax.get_yaxis_transform(),
            fontsize=7,
            va="bottom",
            color=TOWER,
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 0.6},
            zorder=6,
        )
    lowest = [-20 * np.log10(at.k) for at in panel.simulated] + values[np.isfinite(values)].tolist()
    ax.set_ylim(max(min(lowest, default=-20.0) - 6.0, -110.0), 2.0)  # below -110 dB lies nothing but rounding
    ax.set_ylabel("Singular value\nover largest [dB]")
    ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), markerscale=4)


def confusion(panel: RankPanel) -> Figure:
    """Measured rank against simulated rank for every K, as counts and shares of the measured rank."""
    with_table = [at for at in panel.simulated if at.confusion is not None]
    fig = figure((9.2, 3.3))
    axes = fig.subplots(1, len(with_table), sharey=True, squeeze=False)[0]
    image = None
    for ax, at in zip(axes, with_table, strict=True):
        table = np.asarray(at.confusion, dtype=float)
        total = table.sum(axis=1, keepdims=True)
        share = 100 * np.divide(table, total, out=np.zeros_like(table), where=total > 0)
        image = ax.imshow(np.where(total > 0, share, np.nan), cmap="cividis", vmin=0, vmax=100, aspect="auto")
        ax.plot(RANKS, range(len(RANKS)), "s", markersize=25, markerfacecolor="none", markeredgecolor=TOWER,
                markeredgewidth=1.2, clip_on=False, label="equal")  # fmt: skip
        for row in range(table.shape[0]):
            for column in range(table.shape[1]):
                ax.text(
                    column, row, f"{int(table[row, column])}", ha="center", va="center", fontsize=8,
                    color="white" if total[row] > 0 and share[row, column] < 55 else "black",
                )  # fmt: skip
        ax.set_xticks(range(5), ["Z", "1", "2", "3", "4"])
        ax.set_yticks(range(4), [f"{r}" for r in RANKS])
        ax.set_xlabel("Simulated rank")
        samples = count(int(table.sum()))
        equal = f": equal in {100 * at.agreement:.0f} % of {samples}" if np.isfinite(at.agreement) else ""
        ax.set_title(f"K = {k_key(at.k)}{equal}")
        ax.grid(visible=False)
    axes[0].set_ylabel("Measured rank")
    if image is not None:
        colour_bar(fig, image, list(axes), "Share of the measured rank [%]")
    return fig


def agreement_curve(panel: RankPanel) -> Figure:
    """Agreement and total variation against continuous K."""
    curve = panel.curve
    fig = figure((9.2, 3.4))
    ax = fig.subplots()
    if curve is not None:
        ax.semilogx(
            curve.k, curve.agreement, color=SIMULATED, linewidth=1.3, label="agreement by pose (higher is better)"
        )
        ax.semilogx(
            curve.k, curve.total_variation, color="#D55E00", linestyle=(0, (5, 2)), linewidth=1.3,
            label="total variation of the histograms (lower is better)",
        )  # fmt: skip
    if panel.best_k_ci95 is not None:
        ax.axvspan(*panel.best_k_ci95, color="#DDDDDD", hatch="///", alpha=0.6, label="95 % interval of the best K")
    if np.isfinite(panel.best_k):
        ax.axvline(panel.best_k, color=TOWER, linewidth=1.2, label=f"best K = {panel.best_k:.3g}")
    for number, at in enumerate(panel.simulated):
        ax.axvline(at.k, color=WAYPOINT, linestyle=":", linewidth=0.9, label="K of the report" if number == 0 else None)
    ax.set_ylim(0.0, 1.02)
    plain_ticks(ax.xaxis)
    ax.set_xlabel("K (ratio of singular values)")
    ax.set_ylabel("Agreement, total variation")
    fig.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return fig


# --- speed against error ------------------------------------------------------------------------


def rank_changes(speed: Sequence[SpeedRow]) -> bool:
    """Whether any setting gives any link another rank; with one antenna at each end none can."""
    return any(share > 0 for row in speed for share in row.rank_disagreement.values())


def pareto(speed: Sequence[SpeedRow]) -> Figure:
    """Seconds against the largest RSS error and against rank disagreement, with the front of the best."""
    ks = sorted({k for row in speed for k in row.rank_disagreement}) if rank_changes(speed) else []
    fig = figure((9.2, 4.6))
    axes = fig.subplots(1, 2 if ks else 1, squeeze=False)[0]
    pareto_axes(axes[0], speed, [row.rss_max_error_db for row in speed], "Largest RSS error [dB]")
    axes[0].set_yscale("symlog", linthresh=0.01)  # an error of exactly zero has its place
    plain_ticks(axes[0].yaxis)
    errors = [row.rss_max_error_db for row in speed if np.isfinite(row.rss_max_error_db)]
    axes[0].set_ylim(-0.0015, 3.0 * max([0.01, *errors]))
    if ks:
        values = [100 * row.rank_disagreement.get(ks[-1], float("nan")) for row in speed]
        pareto_axes(axes[1], speed, values, f"Links with another rank at K = {k_key(ks[-1])} [%]")
        top = 1.1 * max([1.0, *(value for value in values if np.isfinite(value))])
        axes[1].set_ylim(-0.05 * top, top)
    handles, labels = axes[0].get_legend_handles_labels()
    keys = pareto_keys(speed)
    fig.legend([*handles, *keys], [*labels, *(key.get_label() for key in keys)], loc="outside lower center", ncols=3)
    return fig


def pareto_keys(speed: Sequence[SpeedRow]) -> list[Any]:
    """Legend entries for what the size of a marker says, and for the ring around the reference."""
    from matplotlib.lines import Line2D

    sizes = {row.samples: row.samples_label for row in speed if row.samples is not None}
    keys = [
        Line2D([], [], marker="o", linestyle="none", markersize=marker_size(n), markerfacecolor="none",
               markeredgecolor="black", label=f"{sizes[n]} samples per source")
        for n in sorted(sizes)
    ]  # fmt: skip
    if any(row.reference for row in speed):
        keys.append(Line2D([], [], label="reference", **REFERENCE_RING))
    return keys


REFERENCE_RING: dict[str, Any] = {
    "marker": "o", "markersize": 14, "markerfacecolor": "none", "markeredgecolor": "black", "markeredgewidth": 1.0,
    "linestyle": "none",
}  # fmt: skip


def marker_size(samples: int | None) -> float:
    """Size of a marker [point], growing with the logarithm of the samples.

    Examples
    --------
    >>> marker_size(None), marker_size(1000), marker_size(1_000_000)
    (8.0, 5.0, 11.0)
    """
    return 8.0 if samples is None else float(np.clip(5.0 + 2.0 * (np.log10(max(samples, 1)) - 3.0), 3.0, 13.0))


def pareto_axes(ax: Axes, rows: Sequence[SpeedRow], error: Sequence[float], label: str) -> None:
    """One plane of seconds against error: a line per setting, markers that grow with the number of samples."""
    markers, colours = "osD^v<>P", ("#111111", "#56B4E9", "#D55E00", "#009E73", "#CC79A7", "#0072B2")
    families: dict[str, list[int]] = {}
    for index, row in enumerate(rows):
        families.setdefault(row.family, []).append(index)
    for number, (family, members) in enumerate(families.items()):
        look: dict[str, Any] = {"color": colours[number % len(colours)], "marker": markers[number % len(markers)]}
        members = sorted(members, key=lambda i: rows[i].samples or 0)
        ax.plot(
            [rows[i].seconds for i in members], [error[i] for i in members], linewidth=0.8, markersize=7,
            markeredgecolor="black", markevery=[], label=family, zorder=3, **look,
        )  # fmt: skip
        for i in members:  # a large marker below a small one, so that both are seen where they fall together
            ax.plot(
                rows[i].seconds, error[i], markersize=marker_size(rows[i].samples), markeredgecolor="black",
                markeredgewidth=0.7, alpha=0.85, zorder=4.0 - 0.05 * marker_size(rows[i].samples), **look,
            )  # fmt: skip
            if rows[i].reference:
                ax.plot(rows[i].seconds, error[i], zorder=4.5, **REFERENCE_RING)
    front = pareto_front([row.seconds for row in rows], error)
    if len(front) > 1:
        ax.plot(
            [rows[i].seconds for i in front], [error[i] for i in front], color=TOWER, linestyle=(0, (3, 2)),
            linewidth=1.6, label="not beaten in both", zorder=2,
        )  # fmt: skip
    ax.set_xscale("log")
    plain_ticks(ax.xaxis)
    ax.margins(x=0.08)
    ax.set_xlabel("Time for the same links [s]")
    ax.set_ylabel(label)


def pareto_front(seconds: Sequence[float], error: Sequence[float]) -> list[int]:
    """Indices of rows that no other row beats in both, by rising seconds.

    Examples
    --------
    >>> pareto_front([1.0, 2.0, 3.0], [5.0, 6.0, 1.0])
    [0, 2]
    """
    best, front = float("inf"), []
    for index in sorted(range(len(seconds)), key=lambda i: (seconds[i], error[i])):
        if np.isfinite(error[index]) and error[index] < best:
            best = error[index]
            front.append(index)
    return front


# --- all plates of a report ---------------------------------------------------------------------


def plates(data: ReportData) -> list[Plate]:
    """Every figure that the data allow, in reading order."""
    result: list[Plate] = []
    if data.track is not None and len(data.track.time):
        result += _track_plates(data, data.track)
    for panel in data.rss:
        if len(panel.time):
            result += _rss_plates(data, panel)
    for pair in data.pairs:
        result.append(_pair_plate(data, pair))
    for rank in data.rank:
        if len(rank.time):
            result += _rank_plates(data, rank)
    if data.speed:
        result.append(
            Plate(
                name="speed_against_error",
                section="speed",
                title="Speed against error",
                caption="Down and left is better. The dashed line joins the settings that no other setting beats in "
                "both seconds and error. Markers grow with the samples per source; an error of 0 has its place at the "
                "foot of the scale." + ("" if rank_changes(data.speed) else " No setting changes the rank of a link."),
                alt="Scatter plot of seconds against error for each engine setting.",
                draw=lambda: pareto(data.speed),
            )
        )
    return _with_own_names(result)


def _with_own_names(found: list[Plate]) -> list[Plate]:
    """The same plates, a number added where two names became one file name."""
    seen: dict[str, int] = {}
    result = []
    for plate in found:
        count = seen[plate.name] = seen.get(plate.name, 0) + 1
        result.append(plate if count == 1 else replace(plate, name=f"{plate.name}_{count}"))
    return result


def _track_plates(data: ReportData, track: Track) -> list[Plate]:
    there = [word for word, some in (("buildings", data.site.buildings), ("forests", data.site.forests)) if some]
    invented = (
        f" {' and '.join(there).capitalize()} are illustrative: they were invented to show the method."
        if data.site.illustrative and there
        else ""
    )
    return [
        Plate(
            name="trajectory",
            section="flight",
            title="Where the UAV flew",
            caption=f"Left: the whole site with its towers. Right: the flight, coloured by height.{invented}",
            alt=f"Plan of {data.site.name} with {len(data.site.towers)} towers and the flown line.",
            draw=lambda: trajectory(data, track),
        ),
        Plate(
            name="altitude",
            section="flight",
            title="Height over time",
            caption="Height of the UAV above the ground at the site origin."
            + (" Dotted lines are waypoints." if data.waypoints else ""),
            alt=f"Line plot of height over time; highest point {np.nanmax(track.up_m, initial=-np.inf):.0f} m.",
            draw=lambda: altitude(data, track),
        ),
    ]


def _rss_plates(data: ReportData, panel: RssPanel) -> list[Plate]:
    stem = f"{safe_name(panel.tower)}_{safe_name(panel.channel)}"
    section = f"rss/{panel.tower}/{panel.channel}"
    result = [
        Plate(
            name=f"rss_{stem}",
            section=section,
            title=f"{panel.name}: RSS over time",
            caption="Top: the measurement after its offset, the ray tracing, and the baselines, each baseline moved to "
            "its own best fit. "
            + (
                "Hatched spans marked Z have no path in the simulation and are not scored. "
                if panel.simulated_out_of_coverage.any()
                else ""
            )
            + "Bottom: residual; dashed lines are plus and minus one RMSE.",
            alt=f"RSS of {panel.name} over time, measured against simulated; RMSE {panel.rmse_db:.1f} dB over "
            f"{panel.n} samples.",
            draw=lambda: rss_over_time(data, panel),
        ),
        Plate(
            name=f"rss_check_{stem}",
            section=section,
            title=f"{panel.name}: can the number be trusted?",
            caption="Sample against sample; the distribution of the residual; and the RMSE that every candidate offset "
            "would leave: a sharp minimum inside the searched span means that the offset is well defined.",
            alt=f"Scatter plot, residual histogram and offset curve of {panel.name}.",
            draw=lambda: rss_diagnostics(panel),
        ),
    ]
    if any(name in GEOMETRY for name in panel.geometry):
        result.append(
            Plate(
                name=f"rss_residual_{stem}",
                section=section,
                title=f"{panel.name}: where it fails",
                caption="Residual against the geometry of the link. Lines: running median, and the 10 and 90 % points.",
                alt=f"Residual of {panel.name} against distance, angles and height.",
                draw=lambda: residual_against_geometry(panel),
            )
        )
    if {"azimuth_deg", "elevation_deg"} <= set(panel.geometry):
        result.append(
            Plate(
                name=f"rss_angles_{stem}",
                section=section,
                title=f"{panel.name}: from where the antennas see each other",
                caption="Azimuth (from the boresight towards its left) and elevation of the UAV in the frame of the "
                "tower antenna, and of the tower in the frame of the UAV antenna, which turns with the aircraft where "
                "rt.attitude says so. Patches of one colour point to an antenna pattern or its mounting.",
                alt=f"Azimuth and elevation at which the antennas of {panel.name} see each other, by residual.",
                draw=lambda: seen_from_antennas(panel),
            )
        )
    return result


def _pair_plate(data: ReportData, pair: ChannelPair) -> Plate:
    words = f"{pair.first} against {pair.second}"
    return Plate(
        name=f"pair_{safe_name(pair.tower)}_{safe_name(pair.first)}_{safe_name(pair.second)}",
        section=f"pair/{pair.tower}/{pair.first}/{pair.second}",
        title=f"{pair.tower}: {words}",
        caption="Difference of two channels of one tower, recorded at the same instants. What one place and one path "
        "cannot explain, antennas and their mounting must.",
        alt=f"Difference of {words} at {pair.tower} over time.",
        draw=lambda: channel_difference(data, pair),
    )


def _rank_plates(data: ReportData, panel: RankPanel) -> list[Plate]:
    stem, section = safe_name(panel.tower), f"rank/{panel.tower}"

    def plate(name: str, title: str, caption: str, alt: str, draw: Callable[[], Figure]) -> Plate:
        return Plate(
            name=f"{name}_{stem}", section=section, title=f"{panel.tower}: {title}", caption=caption, alt=alt, draw=draw
        )

    result = [
        plate(
            "rank_histogram",
            "how often each rank",
            "Shares of rank 1 to 4 among samples in coverage, measured beside every K. Whiskers: 95 % intervals.",
            f"Bar chart of rank shares for {panel.tower}, measured and simulated.",
            lambda: rank_histograms(panel),
        ),
        plate(
            "rank_map",
            "rank along the flight",
            "Rank at every sample. Colour and marker give the rank; crosses marked Z had no path in the simulation.",
            f"Maps of measured and simulated rank around {panel.tower}.",
            lambda: rank_maps(data, panel),
        ),
        plate(
            "rank_time",
            "rank over time",
            "Each row is one source. The lowest plot, where present, shows the singular values that decide the rank.",
            f"Rank of {panel.tower} over time, measured and simulated.",
            lambda: rank_over_time(data, panel),
        ),
    ]
    if any(at.confusion is not None for at in panel.simulated):
        result.append(
            plate(
                "rank_confusion",
                "which ranks are mistaken for which",
                "Counts; colour is the share of each measured rank (rows). Frames: equal ranks. "
                "Z: no path in the simulation.",
                f"Confusion matrices of {panel.tower} for every K.",
                lambda: confusion(panel),
            )
        )
    if panel.curve is not None:
        result.append(
            plate(
                "rank_k",
                "which K explains the modem",
                "Agreement by pose and distance between the histograms as the threshold K varies. "
                "The best K is the one of the highest agreement.",
                f"Agreement and total variation against K for {panel.tower}.",
                lambda: agreement_curve(panel),
            )
        )
    return result
