"""Matplotlib figures of a report, drawn from finished arrays.

Every figure is a separate :class:`matplotlib.figure.Figure`, drawn inside :func:`style` without pyplot and global
state. Data sets differ in lightness, line style, marker or hatch as well as in colour, and can therefore be
distinguished in grey. Dots are rasterised. Long lines are thinned, but retain their extremes. The SVG of a long flight
is therefore small.
"""

from __future__ import annotations

import io
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ..common.units import AnyArray, BoolArray, FloatArray, IntArray
from ..logs.records import has_wall_clock
from ..site.scenes import drawn_buildings
from ..site.site import Site, Tower, Trees

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


TOWER = "#C1121F"
_BUILDING = "#8A8A8A"
_FOREST = "#B9D8B0"

# Colours and line styles of a chart. The styles distinguish curves in grey.
COLOURS = ("#111111", "#D55E00", "#0072B2", "#009E73", "#CC79A7", "#56B4E9")
_LINES = ("-", (0, (5, 2)), (0, (1, 1.3)), (0, (6, 2, 1, 2)), (0, (8, 3)), (0, (3, 1, 1, 1, 1, 1)))

POINTS_PER_LINE = 3000


@dataclass(frozen=True, slots=True)
class FigureSpec:
    """A figure to draw: its file name, and the function that draws it."""

    name: str
    draw: Callable[[], Figure]


FORMATS = ("png", "svg", "pdf")


@contextmanager
def style() -> Iterator[None]:
    """Apply the look of every figure without changing the settings of the user."""
    from matplotlib.style import context

    settings = {
        "font.family": "sans-serif",
        "font.sans-serif": ["DejaVu Sans"],
        "font.size": 9.0,
        "text.parse_math": False,  # names of waypoints may contain $
        "axes.titlesize": 10.0,
        "axes.titleweight": "bold",
        "axes.titlelocation": "left",
        "axes.titley": 1.0,  # without this, matplotlib measures every axis to place its title
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.axisbelow": True,
        "axes.grid": True,
        "grid.color": "#E2E2E2",
        "grid.linewidth": 0.6,
        "legend.framealpha": 0.9,
        "legend.edgecolor": "#DDDDDD",
        "legend.fontsize": 8.0,
        "hatch.linewidth": 0.5,
        "savefig.dpi": 130.0,
        "svg.fonttype": "path",  # the page must look the same if the font is missing
        "pdf.fonttype": 42,  # publishers require embedded fonts
        "svg.hashsalt": "aerpaw-cmp",  # the same numbers produce the same bytes
    }
    # begin with the defaults, because a third-party matplotlibrc in the working folder could run LaTeX
    with context(["default", settings]):
        yield


def subplots(size: tuple[float, float], *shape: int, **options: Any) -> tuple[Figure, Any]:
    """Return a figure with automatic layout, and its axes. ``size`` is width and height in inches."""
    from matplotlib.figure import Figure

    fig = Figure(figsize=size, layout="constrained")
    return fig, fig.subplots(*shape, **options)


# Metadata that would differ between two pictures of the same numbers.
_DATES = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}


def save_as(fig: Figure, formats: Sequence[str]) -> dict[str, bytes]:
    """Return the figure by format."""
    images = {}
    for form in formats:
        file = io.BytesIO()
        fig.savefig(file, format=form, metadata=_DATES.get(form))
        images[form] = file.getvalue()
    return images


def render(spec: FigureSpec, formats: Sequence[str] = ("png",)) -> dict[str, bytes]:
    """Draw a figure and return it by format."""
    with style():
        return save_as(spec.draw(), formats)


# --- parts --------------------------------------------------------------------------------------


def seconds_since(time: AnyArray, start: np.datetime64) -> FloatArray:
    """Return times as seconds after ``start``."""
    return np.asarray((np.asarray(time) - start) / np.timedelta64(1, "s"), dtype=np.float64)


# Steps between ticks of a time of day [s], and the largest number of ticks.
_CLOCK_STEPS_S = (1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 10800, 21600, 43200, 86400)
_MOST_TICKS = 9


def time_axis(ax: Axes, start: np.datetime64) -> None:
    """Set label and ticks of an axis in seconds after ``start``. If the logs have UTC, ticks are round times of day."""
    if not has_wall_clock(start):
        ax.set_xlabel("Time after the first sample [s]")
        return
    ax.set_xlabel(f"Time of day, {str(start)[:10]} (UTC)")
    low, high = ax.get_xlim()
    step = next((s for s in _CLOCK_STEPS_S if (high - low) / s <= _MOST_TICKS), _CLOCK_STEPS_S[-1])
    day = start.astype("datetime64[D]").astype("datetime64[s]")
    begun = float((start - day) / np.timedelta64(1, "s"))
    seconds = np.arange(np.ceil((low + begun) / step), np.floor((high + begun) / step) + 1) * step
    pattern = slice(11, 19 if step < 60 else 16)
    ax.set_xticks(seconds - begun, [str(day + np.timedelta64(int(tick), "s"))[pattern] for tick in seconds])
    ax.set_xlim(low, high)


def keep_extremes(values: Sequence[FloatArray], limit: int) -> IntArray:
    """Return indices of about ``limit`` samples, with the smallest and largest value of each array in each segment.

    Parameters
    ----------
    values : sequence of (n,)
        Arrays whose extremes are retained; NaN is ignored.
    limit : int
        Number of samples.

    Returns
    -------
    (m,) int
        Indices in rising order, all of them if n <= limit.

    Examples
    --------
    >>> keep_extremes([np.array([0.0, 5.0, 1.0, 0.0, -7.0, 0.0])], 3).tolist()
    [0, 1, 4, 5]
    """
    n = len(values[0])
    if n <= limit:
        return np.arange(n)
    # each segment yields two samples per array, its smallest and its largest
    per = -(-n // max(1, limit // (2 * len(values))))
    starts = np.arange(0, n, per)
    # retain the first and last sample, so that the thinned line covers the whole flight
    rows = [np.array([0, n - 1])]
    for array in values:
        table = np.pad(np.asarray(array, dtype=np.float64), (0, -n % per), constant_values=np.nan).reshape(-1, per)
        missing = np.isnan(table)
        rows += [starts + np.where(missing, np.inf, table).argmin(axis=1)]
        rows += [starts + np.where(missing, -np.inf, table).argmax(axis=1)]
    return np.unique(np.minimum(np.concatenate(rows), n - 1))


def thinned(at: FloatArray, values: FloatArray, limit: int = POINTS_PER_LINE) -> tuple[FloatArray, FloatArray]:
    """Return a thinned line with about ``limit`` points that looks like the original (n,).

    The extremes of each segment and its gaps (NaN) are retained.

    Examples
    --------
    >>> a, b = thinned(np.arange(100000.0), np.sin(np.arange(100000.0)))
    >>> len(a) <= 3002, bool(b.max() > 0.999999)
    (True, True)
    """
    rows = keep_extremes([values], limit)
    return at[rows], values[rows]


def mark(kind: str, name: str, x: AnyArray, y: AnyArray | None = None, **more: Any) -> dict[str, Any]:
    """Return a mark of a chart: ``line`` or ``dots`` (x, y), ``band`` (x, low, high), or ``spans`` (x, ends).

    Parameters
    ----------
    kind, name : str
        Kind, and name in the legend.
    x, y : (n,)
    more
        Further coordinates (n,), such as ``low`` and ``high``, and the look, as in :func:`draw_marks`.

    Returns
    -------
    dict
    """
    return {"kind": kind, "name": name, "x": x, **({} if y is None else {"y": y}), **more}


def draw_marks(ax: Axes, marks: Sequence[Mapping[str, Any]]) -> None:
    """Draw the marks of a chart (:mod:`~aerpaw_cmp.report.charts`), the first at the bottom.

    Parameters
    ----------
    ax : Axes
    marks : sequence of mapping
        Marks of :func:`mark`. The look of a mark may have ``colour``, ``dash`` (line style), ``alpha``, ``marker``,
        ``size`` and ``hatch``. A mark of kind ``spans`` fills the background between ``x`` and ``ends``, up to the
        share ``height`` of the axes. The script of a page does not draw this kind.
    """
    for number, item in enumerate(marks):
        kind, x = item["kind"], item["x"]
        colour = item.get("colour", COLOURS[number % len(COLOURS)])
        look: dict[str, Any] = {"color": colour, "label": item["name"], "zorder": 2.0 + number / 100}
        if kind == "band":
            ax.fill_between(x, item["low"], item["high"], linewidth=0, alpha=item.get("alpha", 1.0), **look)
        elif kind == "line":
            dash = item.get("dash", _LINES[number % len(_LINES)])
            x, y = thinned(x, item["y"])
            # a point between two gaps is not part of a line, so mark it with a dot
            gap = np.pad(np.isnan(y), 1, constant_values=True)
            alone = ~gap[1:-1] & gap[:-2] & gap[2:]
            look |= {"marker": "o", "markersize": 1.3, "markevery": alone} if alone.any() else {}
            ax.plot(x, y, linestyle=dash, linewidth=1.2, **look)
        elif kind == "dots":
            size, marker = item.get("size", 4.0 if len(x) <= 200 else 1.3), item.get("marker", "o")
            # draw a picture inside the SVG, because a day of samples as vectors would need many megabytes
            ax.plot(x, item["y"], linestyle="none", marker=marker, markersize=size, rasterized=True, **look)
        elif len(x):
            bars = ax.broken_barh(
                list(zip(x, item["ends"] - x, strict=True)), (0.0, item.get("height", 1.0)), label=item["name"],
                transform=ax.get_xaxis_transform(), facecolor=colour, edgecolor="#888888", linewidth=0.0,
                hatch=item.get("hatch"), zorder=0.5,
            )  # fmt: skip
            bars.set_rasterized(len(x) > 300)


def runs(mask: BoolArray) -> tuple[IntArray, IntArray]:
    """Return the first and the last index of each segment of True, both included.

    Examples
    --------
    >>> [ends.tolist() for ends in runs(np.array([True, False, True, True]))]
    [[0, 2], [0, 3]]
    """
    # add zeros at both ends, so that every segment has two edges
    edges = np.diff(np.concatenate([[0], np.asarray(mask, dtype=np.int8), [0]]))
    return np.flatnonzero(edges == 1), np.flatnonzero(edges == -1) - 1


# --- site ---------------------------------------------------------------------------------------


def draw_credit(ax: Axes, site: Site) -> None:
    """Write the source of the map in a corner, in several lines, because panels may be narrow."""
    if site.credit:
        ax.text(
            0.995, 0.005, textwrap.fill(site.credit, 20), transform=ax.transAxes, ha="right", va="bottom", fontsize=5,
            color="#444444", zorder=7, gid="credit",
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.6, "pad": 0.6},
        )  # fmt: skip


# Appearance of the areas of a site on a plan.
_PLAN: Mapping[str, Mapping[str, Any]] = {
    "forest": {"facecolor": _FOREST, "edgecolor": "#7FA873", "hatch": "..", "linewidth": 0.6, "alpha": 0.7,
               "zorder": 0.3},
    "building": {"facecolor": _BUILDING, "edgecolor": "black", "linewidth": 0.7, "zorder": 0.6},
    "geofence": {"facecolor": "none", "edgecolor": "#333333", "linestyle": (0, (4, 3)), "linewidth": 0.9,
                 "zorder": 0.6},
}  # fmt: skip


def draw_areas(ax: Axes, site: Site, looks: Mapping[str, Mapping[str, Any]]) -> None:
    """Draw all areas whose kind is in ``looks``, and the source of the map."""
    from matplotlib.collections import PolyCollection
    from matplotlib.path import Path as Outline

    draw_credit(ax, site)
    areas = {
        "forest": [forest.area for forest in site.forests],
        "building": [building.footprint for building in drawn_buildings(site)],
        "geofence": [fence.area for fence in site.geofences],
    }
    for label, look in looks.items():
        # use one path for all rings of an area, because separate paths would fill the holes
        outlines: list[Any] = [
            Outline.make_compound_path(*(Outline(np.asarray(ring.coords)[:, :2], closed=True) for ring in rings))
            for rings in ((area.exterior, *area.interiors) for area in areas[label])
        ]
        if outlines:
            drawn = PolyCollection([], **look, label=label)
            drawn.set_verts_and_codes([path.vertices for path in outlines], [path.codes for path in outlines])
            ax.add_collection(drawn)


def draw_site(ax: Axes, site: Site) -> None:
    """Draw forests, trees, buildings, geofences and towers on a plan (east, north) [m].

    Parameters
    ----------
    ax : Axes
    site : Site
    """
    if not site.mapped:
        ax.text(0.5, 0.02, "no map here", transform=ax.transAxes, ha="center", color="#777777", fontsize=8, zorder=7)
    draw_areas(ax, site, _PLAN)
    if len(site.trees):
        _draw_crowns(ax, site.trees)
    for number, tower in enumerate(site.towers.values()):
        draw_tower(ax, tower, markeredgecolor="black", label="tower" if number == 0 else None)
        ax.annotate(
            tower.name, (tower.east_m, tower.north_m), xytext=(6, 4), textcoords="offset points", zorder=6,
            fontsize=8, fontweight="bold", annotation_clip=True,
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.75, "pad": 0.8},
        )  # fmt: skip
    ax.set_aspect("equal", adjustable="box")
    ax.set(xlabel="East of the site origin [m]", ylabel="North of the site origin [m]")


def draw_tower(ax: Axes, tower: Tower, **look: Any) -> None:
    """Draw the symbol of a tower on a plan."""
    look = {"marker": "^", "markersize": 9, "color": TOWER, "markeredgecolor": "white", "zorder": 5, **look}
    ax.plot(tower.east_m, tower.north_m, linestyle="none", **look)


def _draw_crowns(ax: Axes, trees: Trees) -> None:
    """Draw crowns to scale, each with a dot at the trunk."""
    from matplotlib.collections import EllipseCollection

    wide, places = trees.crown_diameter_m, np.column_stack([trees.east_m, trees.north_m])
    crowns = EllipseCollection(
        wide, wide, np.zeros(len(trees)), units="xy", offsets=places, offset_transform=ax.transData,
        facecolor="#5E8C4F", alpha=0.45, linewidth=0, zorder=0.4,
    )  # fmt: skip
    crowns.set_rasterized(True)
    ax.add_collection(crowns, autolim=False)
    ax.scatter(trees.east_m, trees.north_m, s=1.5, color="#2F5A25", linewidths=0, rasterized=True, zorder=0.45)
    ax.plot([], [], marker="o", markersize=6, color="#5E8C4F", alpha=0.6, linestyle="none", label="tree")


def frame_around(ax: Axes, east: FloatArray, north: FloatArray, *, margin: float = 0.08, shape: float = 1.0) -> None:
    """Set the limits of a plan around points, with a margin and an extent of at least 60 m.

    Parameters
    ----------
    ax : Axes
    east, north : (n,)
        Points [m]; NaN is ignored.
    margin : float
        Share of the extent on each side.
    shape : float
        Ratio of width to height of the plan.
    """
    from matplotlib.text import Annotation

    good = np.isfinite(east) & np.isfinite(north)
    if not good.any():
        return
    east, north = east[good], north[good]
    width = max(float(np.ptp(east)) * (1 + 2 * margin), 60.0)
    height = max(float(np.ptp(north)) * (1 + 2 * margin), 60.0)
    # extend the limits to the shape of the plan, because both scales are equal
    width, height = max(width, height * shape), max(height, width / shape)
    middle_east, middle_north = (east.min() + east.max()) / 2, (north.min() + north.max()) / 2
    ax.set_xlim(middle_east - width / 2, middle_east + width / 2)
    ax.set_ylim(middle_north - height / 2, middle_north + height / 2)
    for name in (text for text in ax.texts if isinstance(text, Annotation)):
        # a name is to the right of its tower and above it; move names that would cross the right or upper edge
        if name.xy[0] > middle_east + width / 4:
            name.set(x=-6, ha="right")
        if name.xy[1] > middle_north + 0.4 * height:
            name.set(y=-4, va="top")
        if name.xy[0] > middle_east and name.xy[1] < middle_north - 0.4 * height:
            # the attribution of the map is in that corner
            for credit in (text for text in ax.texts if text.get_gid() == "credit"):
                credit.set(x=0.005, ha="left")


def plan_shape(east: FloatArray, north: FloatArray) -> float:
    """Return the ratio of width to height of the area of points, limited to 0.8 to 2."""
    good = np.isfinite(east) & np.isfinite(north)
    if not good.any():
        return 1.0
    return float(np.clip((np.ptp(east[good]) + 60.0) / (np.ptp(north[good]) + 60.0), 0.8, 2.0))


def beyond(values: FloatArray, low: float, high: float) -> str:
    """Return which ends of a colour scale the values exceed, for the option ``extend`` of a colour bar.

    Examples
    --------
    >>> beyond(np.array([1.0, 9.0]), 0.0, 5.0), beyond(np.array([1.0, np.nan]), 0.0, 5.0)
    ('max', 'neither')
    """
    under, over = np.nanmin(values, initial=np.inf) < low, np.nanmax(values, initial=-np.inf) > high
    return ("both" if over else "min") if under else ("max" if over else "neither")


def colour_bar(fig: Figure, mappable: Any, ax: Any, label: str, extend: str = "neither") -> None:
    """Draw a colour bar next to axes. An arrow marks each end that values exceed. An SVG contains the bar as a picture.

    Parameters
    ----------
    fig : Figure
    mappable : ScalarMappable
        Object whose colours the bar explains.
    ax : Axes or sequence of Axes
        The bar is drawn next to these axes.
    label : str
    extend : {"neither", "min", "max", "both"}
        Ends that values exceed.
    """
    bar = fig.colorbar(mappable, ax=ax, label=label, shrink=0.85, extend=extend, extendfrac=0.03)
    if bar.solids is not None:
        bar.solids.set_rasterized(True)
        bar.solids.set_edgecolor("face")
