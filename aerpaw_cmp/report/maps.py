"""The page map.html of the command ``map`` and its metrics.json: maps, tables, sentences, figures and script data.

All maps of a page have the same grid, with row 0 in the south and column 0 in the west. The script computes the numbers
of a layer (share in coverage, median, shares of ranks) from rounded values, and :func:`layer_numbers` returns the same
numbers for metrics.json.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from ..common.geodesy import SiteFrame
from ..common.grouping import lists_by_key
from ..common.jsonable import json_object, json_safe
from ..common.kml import CLASS_COLOURS
from ..common.text import counted
from ..common.units import FloatArray, finite_mean, spread_out
from ..compare.verdict import Coverage, coverage_verdict
from ..maps.evaluate import TREATMENTS
from ..maps.grid import JOINT, PAPER_SPACING_M, RANK_CLASSES, Layer
from ..maps.variogram import BiExponential, BinnedCorrelation
from ..site.site import Site
from .canvas import FigureSpec, beyond, colour_bar, draw_areas, draw_tower, mark, subplots
from .cards import HEAD, RIGHT, TEXT, Card, Page, Positions, Table, paragraph, settings_card
from .charts import Chart, chart_figure
from .flight_data import RANKS
from .flight_words import sentence_of
from .packed import NONE, PackedArrays, ends_of_scale, listed, packed, plan_of, step_for
from .page import Made, about, json_text, merge, write_figures, write_file
from .texts import k_key, minute, percent, safe_name

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@dataclass(frozen=True, slots=True, kw_only=True)
class RssMap(Layer):
    """The RSS of one tower, or of the nearest tower. ``coverage`` is the share of covered positions."""

    quantity: str = "RSS"
    unit: str = "dBm"
    coverage: float


@dataclass(frozen=True, slots=True, kw_only=True)
class RankMap(Layer):
    """The rank for one K. ``share`` (5,) contains the shares of positions out of coverage and with rank 1 to 4.

    If K is None, the rank is the most probable rank of a learned receiver, and ``share`` contains mean probabilities.
    """

    quantity: str = "Rank"
    unit: str = ""
    classes: tuple[str, ...] = RANK_CLASSES
    tower: str = JOINT
    share: FloatArray

    @property
    def source(self) -> str:
        """The text of K, or "learned receiver"."""
        return "learned receiver" if self.k is None else f"K = {k_key(self.k)}"


@dataclass(frozen=True, slots=True, kw_only=True)
class MapError:
    """The mean absolute error of one method for one K and height, in one kind of evaluation."""

    evaluation: str
    method: str
    k: float
    altitude_m: float
    mae: float
    n: int


@dataclass(frozen=True, slots=True, kw_only=True)
class PaperRow:
    """A number of the paper, the same number from this run, and the figure of the paper that shows it."""

    where: str
    what: str
    paper: str
    ours: str
    figure: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class MapsData(Made):
    """The content of the page of ``map``.

    Parameters
    ----------
    title, name : str
        Headline, and short name.
    site : Site
    east_m, north_m : (columns,), (rows,)
        Centres of the cells [m].
    borders_m : tuple of (2, 2) arrays
        Lines between the areas of two towers (Voronoi), east and north [m].
    rank : tuple of RankMap
        Ranks with the nearest tower. ``rank_by_tower`` contains the ranks with each tower, for the map of the page.
    corrected : tuple of RssMap
        Levels of each link for figures, raw and corrected by flights. The field ``antennas`` distinguishes them.
    corrected_rank : tuple of RankMap
        For each tower with a learned receiver: traced ranks for every K, and the ranks of the receiver.
    flown_m : tuple of (n, 2)
        Tracks of the correcting flights, east and north [m].
    outside_flown : float
        Share of positions outside the range of the correction.
    corrected_words : str
        Summary of the prediction with which levels were corrected.
    budget : str
        Sentence with power, noise floor and threshold, if they differ from the paper.
    layers : tuple of Layer
        Layers other than RSS and rank.
    correlation : mapping of str to (BinnedCorrelation, BiExponential)
        Correlation against distance, and its fitted curve or None, by title.
    metrics : mapping
        Additional content of ``metrics.json``.
    """

    title: str
    name: str
    site: Site
    east_m: FloatArray
    north_m: FloatArray
    borders_m: tuple[FloatArray, ...] = ()
    rss: tuple[RssMap, ...] = ()
    corrected: tuple[RssMap, ...] = ()
    corrected_rank: tuple[RankMap, ...] = ()
    flown_m: tuple[FloatArray, ...] = ()
    outside_flown: float = 0.0
    corrected_words: str = ""
    budget: str = ""
    rank: tuple[RankMap, ...] = ()
    rank_by_tower: tuple[RankMap, ...] = ()
    layers: tuple[Layer, ...] = ()
    correlation: Mapping[str, tuple[BinnedCorrelation, BiExponential | None]] = field(default_factory=dict)
    errors: tuple[MapError, ...] = ()
    paper: tuple[PaperRow, ...] = ()
    warnings: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    settings: Mapping[str, Any] = field(default_factory=dict)
    metrics: Mapping[str, Any] = field(default_factory=dict)


# Meaning of the antennas of a layer, for the page and the terminal.
ANTENNAS = (
    "MIMO: an array at both ends, fed in phase at the tower, mean level over the elements at the UAV. SISO: one "
    "element at both ends."
)

LEAST = "Lowest coverage: {percent:.1f} % of the positions at {where}"

# Sentence and next step, by the cause of :func:`~aerpaw_cmp.compare.verdict.coverage_verdict`.
CAUSES: dict[str, tuple[str, str]] = {
    "none": (LEAST + ".", "`aerpaw-cmp plan` for a flight that measures it"),
    "trees": (LEAST + "; trees cause most of the gaps.", "fly higher, or {thinner}"),
    "weak": (
        LEAST + "; in most of the gaps there is a path, but its level is below the threshold.",
        "compare with one element (Antennas: SISO), because the beam of the array has nulls",
    ),
    "blocked": (LEAST + "; buildings and terrain cause most of the gaps.", "fly higher, or add a tower"),
    "no path": ("There is no path to any position at {where}.", "check the towers and the area of the site"),
    "extrapolated": (
        LEAST + ". {outside:.0f} % of the positions are outside the flown area, where the correction is extrapolated.",
        "`aerpaw-cmp plan` finds the flight that reduces the standard deviation most",
    ),
}


def first_sentences(data: MapsData) -> str:
    """Return the summary: coverage at the best and worst height, the cause of gaps, and the next step."""
    heights = coverage(data)
    if not heights:
        return ""
    worst = min(heights, key=lambda height: height.covered)
    thinned = any(item.foliage == "attenuating" for item in data.rss)
    thinner = "compare the rows with attenuating trees" if thinned else "map with `--foliage attenuating`, too"
    shares = {"percent": 100.0 * worst.covered, "outside": 100.0 * worst.outside}
    sentence = sentence_of(coverage_verdict(heights), CAUSES, thinner=thinner, **shares)
    best = max(heights, key=lambda height: height.covered)
    more = f"Best height: {best.height_m:g} m, {100 * best.covered:.1f} %. " if best.covered > worst.covered else ""
    measured = "" if data.corrected else "The map contains no measurement. "
    result, _, step = sentence.partition("Next: ")
    return f"{result}{more}{data.budget}{measured}" + (f"Next: {step}" if step else "")


def coverage(data: MapsData) -> list[Coverage]:
    """Return the coverage by the nearest tower at each height, for the first foliage mode and without foliage."""
    shown = [item for item in data.rss if item.tower == JOINT] or list(data.rss)
    if not shown:
        return []
    first = shown[0]
    same_link = [item for item in shown if (item.tower, item.antennas) == (first.tower, first.antennas)]
    clear = {item.height_m: item.coverage for item in same_link if item.foliage == "none" != first.foliage}
    outside = data.outside_flown
    return [
        Coverage(
            height_m=m.height_m,
            covered=m.coverage,
            clear=clear.get(m.height_m, np.nan),
            reached=float(np.isfinite(m.values).mean()),
            outside=outside,
        )
        for m in same_link
        if m.foliage == first.foliage
    ]


def warnings(data: MapsData) -> list[str]:
    """Return warnings about the limits of the maps."""
    out = [f"{text}." for text in data.site.cautions()]
    if data.corrected_words:
        out.append(f"Corrected: {data.corrected_words}")
    for key, fit in data.metrics.get("correlation", {}).items():
        if fit["degenerate"]:
            out.append(
                f"Correlation of ranks over distance, {TREATMENTS[key.removeprefix('z_')]}: the four coefficients of "
                f"the fitted curve are not reliable ({fit['message']}). Kriging uses the curve, not its coefficients."
            )
    spacing = data.settings.get("spacing_m", 0.0)
    if data.paper and data.correlation and spacing > PAPER_SPACING_M:
        out.append(
            f"A spacing of {spacing:g} m is coarser than the paper's {PAPER_SPACING_M:g} m: errors of interpolation "
            "and correlation are not comparable with it."
        )
    return [*out, *data.warnings]


def notes(data: MapsData) -> list[str]:
    """Return notes about the computation of the maps."""
    how = [
        f"Foliage {', '.join(data.settings['foliage'])}: opaque blocks paths that touch a crown or a trunk (the "
        "paper); attenuating applies ITU-R P.833 over the length of the path in crowns; none ignores trees.",
        ANTENNAS,
        f"Spread, condition number, correlation and interpolation are those of foliage {data.rss[0].foliage}.",
    ] if "foliage" in data.settings else []  # fmt: skip
    return [*data.site.notes, *how, *data.notes]


T = TypeVar("T")
MISSING: dict[str, Any] = {"facecolor": "#F2F2F2", "edgecolor": "#888888", "hatch": "//////", "linewidth": 0.0}
# Largest number of maps in a row.
COLUMNS = 6


def grouped(items: Iterable[T], key: Callable[[T], Any]) -> dict[Any, list[T]]:
    """Return items under their keys, in the order of first appearance."""
    return lists_by_key((key(item), item) for item in items)


# --- one map ------------------------------------------------------------------------------------


def half_width(at_m: FloatArray) -> float:
    """Return half the spacing of cell centres [m], or 15 for a single cell."""
    return float(at_m[1] - at_m[0]) / 2 if len(at_m) > 1 else 15.0


def extent_m(data: MapsData) -> tuple[float, float, float, float]:
    """Return the outer edges of the grid: west, east, south, north [m]."""
    half_east, half_north = half_width(data.east_m), half_width(data.north_m)
    west, east, south, north = map(float, (*data.east_m[[0, -1]], *data.north_m[[0, -1]]))
    return west - half_east, east + half_east, south - half_north, north + half_north


def draw_map(ax: Axes, data: MapsData, values: FloatArray, *, highlight: str | None = None, **options: Any) -> Any:
    """Draw the cells of a map as an image (hatched at NaN), with buildings, forests, towers and borders.

    Parameters
    ----------
    ax : Axes
    data : MapsData
        The site, the axes of the grid and the borders.
    values : (rows, columns)
        Values of the cells from south to north; NaN out of coverage.
    highlight : str, optional
        Draw only the tower of this name, and no borders.
    options
        Options of :meth:`matplotlib.axes.Axes.imshow`.

    Returns
    -------
    matplotlib.image.AxesImage
        The image, for a colour bar.
    """
    from matplotlib.patheffects import withStroke

    ax.patch.set(**MISSING)  # the hatched background is visible through cells without a value
    image = ax.imshow(values, origin="lower", extent=extent_m(data), interpolation="none", zorder=1, **options)
    halo = [withStroke(linewidth=2.2, foreground="white")]
    looks = {
        "forest": {"facecolor": "none", "edgecolor": "#2F5D28", "linewidth": 0.9, "linestyle": (0, (2, 1)),
                   "zorder": 2.1, "path_effects": halo},
        "building": {"facecolor": "white", "edgecolor": "black", "linewidth": 0.7, "zorder": 2.2},
    }  # fmt: skip
    draw_areas(ax, data.site, looks)
    for name, tower in data.site.towers.items():
        if highlight is None or name == highlight:
            draw_tower(ax, tower, markersize=7, label="tower")
    for line in data.borders_m if highlight is None else ():
        ax.plot(line[:, 0], line[:, 1], color="white", linewidth=1.8, zorder=3)
        dashed: dict[str, Any] = {"color": "black", "linewidth": 0.9, "linestyle": (0, (4, 2)), "zorder": 3.1}
        ax.plot(line[:, 0], line[:, 1], label="border of the towers' areas", **dashed)
    west, east, south, north = extent_m(data)
    ax.set(xlim=(west, east), ylim=(south, north))
    ax.set_aspect("equal", adjustable="box")
    ax.grid(visible=False)
    ax.tick_params(labelsize=7)
    ax.locator_params(axis="x", nbins=4)
    return image


def overlay_legend(axes: Sequence[Axes]) -> list[Any]:
    """Return legend entries of the objects on maps, and of positions out of coverage."""
    from matplotlib.patches import Patch

    drawn = {label: handle for ax in axes for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    return [Patch(**MISSING, label="out of coverage"), *drawn.values()]


def map_axes(data: MapsData, count: int) -> tuple[Figure, list[Axes]]:
    """Return a figure with axes for ``count`` maps, and labels on its outer axes."""
    west, east, south, north = extent_m(data)
    columns = min(count, COLUMNS)
    rows = -(-count // columns)
    columns = -(-count // rows)
    width = min((7.4 - 0.15 * columns) / columns, 3.2)  # the remaining width is for the colour bar and the labels
    height = float(np.clip(width * (north - south) / (east - west), 0.8, 6.5))
    size = 9.2, rows * (height + 0.35) + 1.0
    fig, grid = subplots(size, rows, columns, sharex=True, sharey=True, squeeze=False)
    axes: list[Axes] = list(grid.ravel())
    for ax in axes[count:]:
        ax.set_visible(False)
    for row in grid:
        row[0].set_ylabel("North [m]")
    for ax in axes[max(count - columns, 0) : count]:
        ax.set_xlabel("East [m]")
        ax.tick_params(labelbottom=True)
    return fig, axes[:count]


# --- figures ------------------------------------------------------------------------------------


def rss_maps(data: MapsData, maps: Sequence[RssMap], limits: tuple[float, float]) -> Figure:
    """Draw the maps of each tower and the joint map for one height and one choice of antennas, with limits [dBm]."""
    fig, axes = map_axes(data, len(maps))
    image = None
    for ax, shown in zip(axes, maps, strict=True):
        alone = None if shown.tower == JOINT else shown.tower
        image = draw_map(ax, data, shown.values, highlight=alone, cmap="viridis", vmin=limits[0], vmax=limits[1])
        ax.set_title(f"{shown.tower}: {100 * shown.coverage:.0f} %", fontsize=9)
    levels = np.concatenate([entry.values.ravel() for entry in maps])
    colour_bar(fig, image, axes, "RSS [dBm]", beyond(levels, *limits))
    fig.legend(handles=overlay_legend(axes), loc="outside lower center", ncols=3)
    return fig


def rank_grid(data: MapsData, maps: Sequence[RankMap]) -> Figure:
    """Draw the rank at every height for one K."""
    from matplotlib.colors import BoundaryNorm, ListedColormap
    from matplotlib.patches import Patch

    fig, axes = map_axes(data, len(maps))
    colours = ListedColormap([CLASS_COLOURS[r] for r in RANKS])
    norm = BoundaryNorm([0.5, 1.5, 2.5, 3.5, 4.5], 4)
    for ax, shown in zip(axes, maps, strict=True):
        draw_map(ax, data, shown.values, cmap=colours, norm=norm)
        ax.set_title(f"{shown.height_m:g} m", fontsize=9)
    entries = [Patch(facecolor=CLASS_COLOURS[r], edgecolor="black", label=f"rank {r}") for r in RANKS]
    fig.legend(handles=[*entries, *overlay_legend(axes)], loc="outside lower center", ncols=5)
    return fig


def distribution(members: Sequence[RssMap]) -> dict[str, Any]:
    """Return a chart of the distribution of RSS of each tower and of the joint map at one height.

    Positions out of coverage count as positions below all levels.
    """
    marks = []
    for shown in members:
        level = np.sort(shown.values[np.isfinite(shown.values)])
        share = (shown.values.size - len(level) + np.arange(1, len(level) + 1)) / shown.values.size
        some = spread_out(len(level), 400)  # steps of 1/400 are not visible
        marks.append(mark("line", shown.tower, level[some], 100.0 * share[some]))
    return {"x": {"label": "RSS [dBm]"}, "y": {"label": "Positions below [%]", "ends": [0, 100]}, "marks": marks}


def rank_shares(members: Sequence[RankMap]) -> dict[str, Any]:
    """Return a chart of stacked shares of ranks, and of positions out of coverage, at each height."""
    members = sorted(members, key=lambda member: member.height_m)
    at = np.array([member.height_m for member in members])
    half = np.diff(at) / 2.0 if len(at) > 1 else np.array([5.0])
    sides = np.repeat([max(at[0] - half[0], 0.0), *(at[:-1] + half[: len(at) - 1]), at[-1] + half[-1]], 2)[1:-1]
    share = 100.0 * np.array([member.share for member in members])
    edges = np.repeat(np.column_stack([np.zeros(len(at)), share.cumsum(axis=1)]), 2, axis=0)
    marks = [
        mark("band", f"rank {rank}" if rank else "out of coverage", sides, low=low, high=high, colour=colour)
        for rank, low, high, colour in zip((0, *RANKS), edges.T, edges.T[1:], CLASS_COLOURS, strict=False)
    ]
    return {"x": {"label": "Height [m]"}, "y": {"label": "Positions [%]", "ends": [0, 100]}, "marks": marks}


def correlation(binned: BinnedCorrelation, fit: BiExponential | None) -> dict[str, Any]:
    """Return a chart of the correlation against distance, with its fitted curve."""
    marks = [mark("dots", "data", binned.distance_m, binned.correlation)]
    if fit is not None:
        at = np.linspace(0.0, binned.distance_m[-1], 251)
        marks.append(mark("line", f"bi-exponential, RMSE {fit.rmse:.4f}", at, fit(at)))
    return {"x": {"label": "Distance [m]"}, "y": {"label": "Correlation"}, "marks": marks}


def error_curves(members: Sequence[MapError], worst: float) -> dict[str, Any]:
    """Return a chart of MAE against height per method. The axis of all panels ends at ``worst``, the largest error."""
    marks = []
    for method, rows in grouped(sorted(members, key=lambda e: e.altitude_m), lambda e: e.method).items():
        at, mae = np.array([[row.altitude_m, row.mae] for row in rows]).T
        marks.append(mark("line", method, at, mae))
    y = {"label": "MAE of the rank", "ends": [0.0, 1.08 * worst if worst > 0 else 1.0]}
    return {"x": {"label": "Height [m]"}, "y": y, "marks": marks}


@dataclass(frozen=True, slots=True, kw_only=True)
class Plate:
    """The panels of one kind, by title. All panels are in one figure file, and each panel is one chart of the page."""

    name: str
    section: str
    title: str
    caption: str
    panels: Mapping[str, Mapping[str, Any]]

    @property
    def spec(self) -> FigureSpec:
        """The figure."""
        return FigureSpec(self.name, partial(chart_figure, self.panels))

    @property
    def charts(self) -> list[Chart]:
        """The charts of the page."""
        return [
            Chart(
                section=self.section, title=f"{self.title}: {name}", content=content, caption="" if i else self.caption
            )
            for i, (name, content) in enumerate(self.panels.items())
        ]


def plates(data: MapsData) -> Iterator[Plate]:
    """Yield the panels of distributions, shares, correlations and errors."""
    for words, maps in grouped((*data.rss, *data.corrected), lambda m: f"{m.antennas}{_under(m.foliage)}").items():
        yield Plate(
            name=f"rss_cdf_{safe_name(words)}", section="rss", title=f"Distribution of RSS, {words}",
            caption="Share of positions with an RSS below the value. A curve starts at the share of positions out of "
            "coverage.",
            panels={f"{at:g} m": distribution(some) for at, some in grouped(maps, lambda m: m.height_m).items()},
        )  # fmt: skip
    for words, ranks in grouped(data.rank, lambda m: _under(m.foliage)).items():
        yield Plate(
            name="_".join(["rank_share", *([safe_name(words)] if words else [])]), section="rank",
            title=f"Rank against height{words}", caption="Share of positions with each rank, and out of coverage.",
            panels={source: rank_shares(some) for source, some in grouped(ranks, lambda m: m.source).items()},
        )  # fmt: skip
    for tower, ranks in grouped(data.corrected_rank, lambda m: m.tower).items():
        yield Plate(
            name=f"rank_share_learned_{safe_name(tower)}",
            section="rank",
            title=f"Rank of {tower} against height, raw and corrected",
            caption="Raw: share of positions with each rank of the traced channel, by K, and out of coverage. Learned "
            "receiver: mean probability of each rank.",
            panels={source: rank_shares(some) for source, some in grouped(ranks, lambda m: m.source).items()},
        )
    if data.correlation:
        yield Plate(
            name="correlation", section="kriging", title="Spatial correlation",
            caption="Pearson correlation between positions against their distance, and the fitted model. "
            + " ".join(f"{title}: {binned.excluded_constant} constant positions or maps excluded."
                       for title, (binned, _) in data.correlation.items()),
            panels={title: correlation(*curve) for title, curve in data.correlation.items()},
        )  # fmt: skip
    for evaluation, errors in grouped(data.errors, lambda error: error.evaluation).items():
        worst = max((error.mae for error in errors if np.isfinite(error.mae)), default=1.0)
        yield Plate(
            name=f"mae_{safe_name(evaluation)}", section="kriging", title=f"Error of interpolated rank, {evaluation}",
            caption="Mean absolute error against height; lower is better.",
            panels={f"K = {k_key(k)}": error_curves(some, worst) for k, some in grouped(errors, lambda e: e.k).items()},
        )  # fmt: skip


# --- all figures ---------------------------------------------------------------------------------


def _level_limits(maps: Sequence[RssMap]) -> tuple[float, float]:
    """Return the ends of one colour scale for all maps: the 1 to 99.5 % range, rounded to 5 dB [dBm]."""
    levels = np.concatenate([np.zeros(0), *(entry.values.ravel() for entry in maps)])
    # exclude the few cells next to a tower, because their high levels would use most of the colour scale
    low, high = ends_of_scale(levels[np.isfinite(levels)], 99.5)
    return 5.0 * math.floor(low / 5), 5.0 * max(math.ceil(high / 5), math.floor(low / 5) + 1)


def figure_specs(data: MapsData) -> list[FigureSpec]:
    """Return every figure that the data allow, in the order of the page."""
    return [*_rss_specs(data), *_rank_specs(data), *(plate.spec for plate in plates(data))]


def _under(foliage: str) -> str:
    return f", foliage {foliage}" if foliage else ""


def _rss_specs(data: MapsData) -> Iterator[FigureSpec]:
    levels = (*data.rss, *data.corrected)
    limits = _level_limits(levels)
    by_height = grouped(levels, lambda m: (f"{m.antennas}{_under(m.foliage)}", m.height_m))
    for (antennas, height), maps in by_height.items():
        name = f"rss_map_{safe_name(f'{antennas}, {height:g} m')}"
        yield FigureSpec(name, partial(rss_maps, data, maps, limits))


def _rank_specs(data: MapsData) -> Iterator[FigureSpec]:
    for words, maps in grouped(data.rank, lambda m: f"{m.source}{_under(m.foliage)}").items():
        yield FigureSpec(f"rank_map_{safe_name(words)}", partial(rank_grid, data, maps))
    for tower, maps in grouped(data.corrected_rank, lambda m: m.tower).items():
        learned = [m for m in maps if m.k is None]
        yield FigureSpec(f"rank_map_learned_{safe_name(tower)}", partial(rank_grid, data, learned))


# Largest size of the layers as base64 [bytes]. If it is exceeded, layers of single towers are omitted first, and then
# cells.
MOST_BYTES = 4_000_000

_LATTICE = 9
_DEGREE = 4
_FINEST_DB = 0.01

LEVEL, _CLASSES = "level", "classes"


# --- layers ---------------------------------------------------------------------------------------------------------


def page_layers(data: MapsData) -> list[Layer]:
    """Return all layers of the page, sorted by quantity."""
    versions = [
        replace(m, quantity="Rank, raw and corrected", version=f"{'corrected' if m.k is None else 'raw'}, {m.source}",
                k=None)
        for m in data.corrected_rank
    ]  # fmt: skip
    return [*data.rss, *data.rank, *data.rank_by_tower, *versions, *data.layers]


def layer_numbers(layer: Layer) -> dict[str, Any]:
    """Return the numbers of a layer: share in coverage, percentiles, shares of classes. Missing numbers are None."""
    finite = layer.values[np.isfinite(layer.values)]
    result: dict[str, Any] = {
        "quantity": layer.quantity,
        "unit": layer.unit,
        **{name.lower(): value for name, value in layer.axes.items()},
        "covered": len(finite) / layer.values.size,
    }
    if layer.classes:
        counts = np.bincount(finite.astype(np.int64), minlength=len(layer.classes)).astype(np.float64)
        if layer.classes[0] == RANK_CLASSES[0]:  # class 0 is "no path"
            counts[0] = layer.values.size - len(finite)
        return result | {"share": dict(zip(layer.classes, counts / layer.values.size, strict=True))}
    names = ("min", "p10", "median", "p90", "max")
    levels = np.quantile(finite, [0.0, 0.1, 0.5, 0.9, 1.0]) if len(finite) else np.full(5, np.nan)
    return result | {"mean": finite.mean() if len(finite) else np.nan, **dict(zip(names, levels, strict=True))}


# --- data of the script ---------------------------------------------------------------------------------------------


def payload(data: MapsData, charts: Sequence[Chart] = (), most_bytes: int = MOST_BYTES) -> dict[str, Any]:
    """Return all data of the script as plain values, in about ``most_bytes`` of base64.

    Parameters
    ----------
    data : MapsData
    charts : sequence of Chart
    most_bytes : int
        If all layers together are larger, first the layers of single towers except RSS are omitted, then all layers of
        single towers. After that, only every second (third, ...) cell of each row and column is included. ``left_out``
        names what is omitted.
    """
    layers = page_layers(data)
    joint = [item for item in layers if item.tower in ("", JOINT)]
    levels = [item for item in layers if item.tower in ("", JOINT) or item.quantity == "RSS"]
    single = "layers of single towers"
    tries = [("", layers, 1), (f"{single} other than RSS", levels, 1), (single, joint, 1)]
    thinned = ((f"{single}, and all but one in {n} cells of each row and column", joint, n) for n in itertools.count(2))
    return next(
        content | {"left_out": left_out, "stride": stride}
        for left_out, chosen, stride in itertools.chain(tries, thinned)
        # measure after packing, because the compressed size depends on the values
        if len((content := _packed(data, charts, chosen, stride))["packed"]["data"]) <= most_bytes
    )


def _packed(data: MapsData, charts: Sequence[Chart], layers: Sequence[Layer], stride: int) -> dict[str, Any]:
    arrays = PackedArrays()
    east, north = data.east_m[::stride], data.north_m[::stride]
    by_quantity = grouped(layers, lambda layer: layer.quantity)
    quantities = [_quantity(name, members, arrays, stride) for name, members in by_quantity.items()]
    return {
        "east": arrays.add(east, "f8"),
        "north": arrays.add(north, "f8"),
        "half": [stride * half_width(axis) for axis in (data.east_m, data.north_m)],
        "degrees": geographic(data.site.frame, data.east_m, data.north_m),
        "site": plan_of(data.site),
        "borders": [listed(line) for line in data.borders_m],
        "flown": [listed(line) for line in data.flown_m],
        "joint": JOINT,
        "quantities": quantities,
        "plots": [packed(chart.content, arrays) for chart in charts],
        "packed": arrays.content(),
    }


def _quantity(name: str, layers: Sequence[Layer], arrays: PackedArrays, stride: int) -> dict[str, Any]:
    """Return the content for one quantity: its axes, and the array number for each combination of their values."""
    places: dict[str, dict[str, float]] = {}
    for layer in layers:
        for axis, value in layer.axes.items():
            places.setdefault(axis, {})[value] = layer.place(axis)
    axes = {axis: sorted(values, key=values.__getitem__) for axis, values in places.items()}
    kind = _CLASSES if layers[0].classes else LEVEL
    every = np.concatenate([layer.values[np.isfinite(layer.values)] for layer in layers])
    step = 1.0 if kind == _CLASSES else step_for(every, _FINEST_DB)
    stored = {}
    for layer in layers:
        cells = layer.values[::stride, ::stride].ravel()
        key = ",".join(str(axes[axis].index(layer.axes[axis])) if axis in layer.axes else "0" for axis in axes)
        classes = np.nan_to_num(cells, nan=NONE["u1"])
        stored[key] = arrays.add(classes, "u1") if kind == _CLASSES else arrays.add_steps(cells, step)
    return {
        "name": name, "unit": layers[0].unit, "kind": kind, "step": step, "range": ends_of_scale(every, 99.5),
        "classes": list(layers[0].classes), "colours": _class_colours(layers[0].classes),
        "axes": [{"name": axis, "values": values} for axis, values in axes.items()],
        "layers": stored,
    }  # fmt: skip


def _class_colours(classes: Sequence[str]) -> list[str]:
    """Return one colour per class: the colours of ranks, or else colours that differ in hue and lightness."""
    if tuple(classes) == RANK_CLASSES:
        return ["", *(CLASS_COLOURS[rank] for rank in RANKS)]
    if not classes:
        return []
    hues = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#D55E00", "#56B4E9", "#F0E442", "#555555")
    return [hues[number % len(hues)] for number in range(len(classes))]


def geographic(frame: SiteFrame, east_m: FloatArray, north_m: FloatArray) -> dict[str, Any]:
    """Return polynomials of east and north for latitude and longitude over the area [deg], for the script.

    Returns
    -------
    dict
        ``middle`` and ``reach`` (2,) [m], ``powers`` (m, 2), and coefficients ``lat`` and ``lon`` (m,) [deg]. An angle
        is the sum over m of coefficient times u^p v^q, with u, v = (position - middle) / reach. ``worst_m`` is the
        largest error on the lattice of the fit.

    Notes
    -----
    Least squares on a lattice of 9 x 9 points of :meth:`aerpaw_cmp.common.geodesy.SiteFrame.to_geographic`. Over 10 km
    the error is below a millimetre.
    """
    ends = np.array([[east_m[0], east_m[-1]], [north_m[0], north_m[-1]]], dtype=np.float64)
    middle = ends.mean(axis=1)
    # at least 100 m, because the script divides by the reach, which would be 0 for one row of cells
    reach = np.maximum(np.ptp(ends, axis=1) / 2, 100.0)
    u, v = (grid.ravel() for grid in np.meshgrid(np.linspace(-1, 1, _LATTICE), np.linspace(-1, 1, _LATTICE)))
    east, north = middle[0] + u * reach[0], middle[1] + v * reach[1]
    lat, lon = frame.to_geographic(east, north)
    powers = [(p, q) for p in range(_DEGREE + 1) for q in range(_DEGREE + 1 - p)]
    matrix = np.column_stack([u**p * v**q for p, q in powers])
    by_lat, by_lon = np.linalg.lstsq(matrix, np.column_stack([lat, lon]), rcond=None)[0].T
    back = frame.to_local(matrix @ by_lat, matrix @ by_lon)
    worst = float(np.hypot(back[0] - east, back[1] - north).max())
    return {
        "middle": middle.tolist(), "reach": reach.tolist(), "powers": [list(pair) for pair in powers],
        "lat": by_lat.tolist(), "lon": by_lon.tolist(), "worst_m": worst,
    }  # fmt: skip


def maps_metrics(data: MapsData) -> dict[str, Any]:
    """Return the numbers of metrics.json. ``data.metrics`` is merged last."""
    columns, rows = len(data.east_m), len(data.north_m)
    numbers = json_object(
        name=data.name,
        title=data.title,
        site={"name": data.site.name, "credit": data.site.credit, "assumed": data.site.assumed},
        grid={"columns": columns, "rows": rows, "positions": columns * rows},
        coverage=coverage_rows(data),
        rank=[{"k": m.k, "foliage": m.foliage, "altitude_m": m.height_m,
               "share": dict(zip(RANK_CLASSES, m.share, strict=True))} for m in data.rank],
        layers=[layer_numbers(layer) for layer in page_layers(data)],
        mae=data.errors,
        paper=data.paper,
        warnings=warnings(data),
        **about(data),
    )  # fmt: skip
    merge(numbers, json_safe(data.metrics))
    return numbers


# --- cards ----------------------------------------------------------------------------------------------------------


def result_card(data: MapsData) -> Card:
    """Return the card with the shares of positions in coverage, and the corresponding numbers of the paper."""
    paper = Table(
        caption="What the paper (arXiv 2502.10324) states, and the results of this run.",
        columns={"Where": HEAD, "What": TEXT, "Paper": TEXT, "Here": TEXT, "Figure": TEXT},
        rows=[(p.where, p.what, p.paper, p.ours, p.figure) for p in data.paper],
    )
    return Card(title="Result", id="result", link="Result", tables=[coverage_table(coverage_rows(data)), paper])


def coverage_rows(data: MapsData) -> list[dict[str, Any]]:
    """Return the shares in coverage as in metrics.json."""
    return [
        {"tower": m.tower, "antennas": m.antennas, "foliage": m.foliage, "altitude_m": m.height_m,
         "coverage": m.coverage}
        for m in data.rss
    ]  # fmt: skip


def coverage_table(shares: Sequence[Mapping[str, Any]]) -> Table:
    """Return the table of shares in coverage by height. Rows with 100.0 % at all heights share one row."""
    heights = sorted({m["altitude_m"] for m in shares})
    alone = len({m["tower"] for m in shares}) == 2  # a single tower is always the nearest tower
    rows: list[Sequence[str | None]] = []
    for key, maps in grouped(shares, lambda m: (m["antennas"], m["foliage"], m["tower"])).items():
        share = {m["altitude_m"]: percent(m["coverage"], 1) for m in maps}
        if not (alone and key[2] == JOINT):
            rows.append((*key, *(share.get(height) for height in heights)))
    everywhere = [percent(1.0, 1)] * len(heights)
    partial = [row for row in rows if [*row[3:]] != everywhere]
    if (full := len(rows) - len(partial)) > 1:
        whose = f"the other {counted(full, 'row')}" if partial else "every antenna, foliage and tower"
        rows = [*partial, (whose, "", "", *everywhere)]
    columns = {"Antennas": TEXT, "Foliage": TEXT, "Tower": HEAD, **{f"{height:g} m": RIGHT for height in heights}}
    caption = f"Share of positions in coverage. {ANTENNAS} Joint: the nearest tower serves."
    return Table(caption=caption, columns=columns, rows=rows)


def levels_card(data: MapsData) -> Card:
    """Return the card of the distribution of levels."""
    title = "Distribution of received signal strength"
    return Card(title=title, id="rss", link="RSS", fold=True, grid=True, chart="rss" if data.rss else "")


def ranks_card(data: MapsData) -> Card:
    """Return the card of the rank against height."""
    chart = "rank" if data.rank else ""
    return Card(title="Channel rank against height", id="rank", link="Rank", fold=True, grid=True, chart=chart)


def interpolation_card(data: MapsData) -> Card:
    """Return the card of correlation and interpolation."""
    chart = "kriging" if data.correlation or data.errors else ""
    title, tables = "Correlation and interpolation", [error_table(data.errors)]
    return Card(title=title, id="kriging", link="Interpolation", fold=True, grid=True, tables=tables, chart=chart)


def error_table(errors: Sequence[MapError]) -> Table:
    """Return the table of mean errors over heights, with one row per evaluation and method, and one column per K."""
    ks = sorted({error.k for error in errors})
    rows = []
    for key, members in grouped(errors, lambda e: (e.evaluation, e.method)).items():
        rows.append((*key, *(finite_mean([e.mae for e in members if e.k == k]) for k in ks)))
    return Table(
        caption="Mean absolute error of the interpolated rank, mean over heights.",
        columns={"Evaluation": TEXT, "Method": HEAD, **{f"K = {k_key(k)}": 3 for k in ks}},
        rows=rows,
    )


# Cards in the order of the page. A new card is another function here.
CARDS = (result_card, levels_card, ranks_card, interpolation_card)


def maps_page(data: MapsData, files: Sequence[str]) -> str:
    """Return the page."""
    charts = [chart for plate in plates(data) for chart in plate.charts]
    linked = payload(data, charts) if data.rss or data.rank or data.layers else None
    shown = Positions(view="map_explorer", data=linked) if linked else None
    columns, rows = len(data.east_m), len(data.north_m)
    extent = [f"{columns} × {rows} = {counted(columns * rows, 'position')}"]
    extent += [counted(len(data.rss), "RSS map")] if data.rss else []
    extent += [counted(len(data.rank), "rank map")] if data.rank else []
    about = f"Predicted coverage and channel rank over {data.site.name}: {', '.join(extent)}."
    if data.corrected:
        about += " The map has levels of ray tracing, and levels corrected by flights with their standard deviation."
    beside = paragraph(
        f"Files in the same folder: {', '.join(files)}. With --figures png, svg or pdf, figures/ contains every map "
        "and chart. Method: D. Lee, O. Ozdemir, A. Ram, I. Guvenc, arXiv 2502.10324."
    )
    settings = settings_card(data, data.settings)
    remarks = Card(title="Notes", text=[notes(data), beside])
    return Page(
        kind="maps", title=data.title, verdict=first_sentences(data), cautions=warnings(data), charts=charts,
        about=[f"{about} Made {minute(data.generated)}"],
        cards=[Card(title="Map", link="Map", positions=shown), *(card(data) for card in CARDS),
               replace(settings, parts=[*settings.parts, remarks])],
    ).html()  # fmt: skip


def write_maps(data: MapsData, folder: str | Path, drawn: str = "none") -> list[Path]:
    """Write ``map.html``, ``metrics.json`` and figures in the formats ``drawn``. Return the paths, page first."""
    folder = Path(folder)
    written = [write_file(folder / "metrics.json", json_text(maps_metrics(data)))]
    files = write_figures(partial(figure_specs, data), folder / "figures", drawn)
    page = write_file(folder / "map.html", maps_page(data, ["metrics.json"]))
    return [page, *written, *files]
