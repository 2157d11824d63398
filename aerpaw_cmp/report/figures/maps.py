"""Figures and charts of the `map` job: RSS and rank over the grid, distributions, correlation, errors."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from ...common.kml import CLASS_COLOURS
from ...common.units import FloatArray, spread_out
from ...site.scenes import drawn_buildings
from ...site.site import Site
from ..content.flight import RANKS
from ..content.maps import JOINT, Correlation, MapError, MapsData, RankMap, RssMap
from ..kit.canvas import TOWER, FigureSpec, beyond, colour_bar, draw_credit, draw_tower, placed
from ..names import k_key, safe_name
from .charts import Chart, drawn
from .flight import channel_specs

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

T = TypeVar("T")
MISSING: dict[str, Any] = {"facecolor": "#F2F2F2", "edgecolor": "#888888", "hatch": "//////", "linewidth": 0.0}
# Maps side by side, at most.
COLUMNS = 6


def grouped(items: Iterable[T], key: Callable[[T], Any]) -> dict[Any, list[T]]:
    """Items under their keys, in the order of first appearance."""
    result: dict[Any, list[T]] = {}
    for item in items:
        result.setdefault(key(item), []).append(item)
    return result


# --- one map ------------------------------------------------------------------------------------


def half_width(at_m: FloatArray) -> float:
    """Half of the spacing of cell centres [m]; 15 where there is one cell only."""
    return float(at_m[1] - at_m[0]) / 2 if len(at_m) > 1 else 15.0


def extent_m(data: MapsData) -> tuple[float, float, float, float]:
    """Outer edges of the grid: west, east, south, north [m]."""
    (west, east), (south, north) = (
        (float(at[0]) - half_width(at), float(at[-1]) + half_width(at)) for at in (data.east_m, data.north_m)
    )
    return west, east, south, north


def draw_map(ax: Axes, data: MapsData, values: FloatArray, *, highlight: str | None = None, **options: Any) -> Any:
    """One map: cells as an image, hatched where NaN, with what stands there and the borders of the towers.

    Parameters
    ----------
    ax : Axes
    data : MapsData
        Site, axes of the grid and borders.
    values : (rows, columns)
        Of the cells, from south to north; NaN out of coverage.
    highlight : str, optional
        The only tower that counts: no borders are drawn then.
    options
        Of :meth:`matplotlib.axes.Axes.imshow`.

    Returns
    -------
    matplotlib.image.AxesImage
        For a colour bar.
    """
    ax.patch.set(**MISSING)  # cells without a value are transparent, so the hatched ground shows
    image = ax.imshow(values, origin="lower", extent=extent_m(data), interpolation="none", zorder=1, **options)
    _draw_overlay(ax, data.site, highlight)
    for line in data.borders_m if highlight is None else ():
        ax.plot(line[:, 0], line[:, 1], color="white", linewidth=1.8, zorder=3)
        ax.plot(line[:, 0], line[:, 1], color="black", linewidth=0.9, linestyle=(0, (4, 2)), zorder=3.1)
    west, east, south, north = extent_m(data)
    ax.set(xlim=(west, east), ylim=(south, north))
    ax.set_aspect("equal", adjustable="box")
    ax.grid(visible=False)
    ax.tick_params(labelsize=7)
    ax.locator_params(axis="x", nbins=4)
    return image


def _draw_overlay(ax: Axes, site: Site, highlight: str | None) -> None:
    """Outlines of buildings and forests, and the towers; only the named tower when one is named."""
    from matplotlib.collections import PolyCollection

    draw_credit(ax, site)
    for forest in site.forests:
        outline = np.asarray(forest.area.exterior.coords)
        ax.plot(outline[:, 0], outline[:, 1], color="white", linewidth=1.4, zorder=2)
        ax.plot(outline[:, 0], outline[:, 1], color="#2F5D28", linewidth=0.8, linestyle=(0, (2, 1)), zorder=2.1)
    outlines = [np.asarray(building.footprint.exterior.coords)[:, :2] for building in drawn_buildings(site)]
    ax.add_collection(PolyCollection(outlines, facecolor="white", edgecolor="black", linewidth=0.7, zorder=2.2))
    for name, tower in site.towers.items():
        if highlight is None or name == highlight:
            draw_tower(ax, tower, markersize=7)


def overlay_legend(data: MapsData, *, borders: bool) -> list[Any]:
    """Legend entries of what :func:`draw_map` draws."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    entries: list[Any] = [Patch(**MISSING, label="Z: out of coverage")]
    entries.append(Line2D([], [], marker="^", color=TOWER, markeredgecolor="white", linestyle="none", label="tower"))
    if drawn_buildings(data.site):
        entries.append(Patch(facecolor="white", edgecolor="black", label="building"))
    if data.site.forests:
        entries.append(Line2D([], [], color="#2F5D28", linestyle=(0, (2, 1)), label="forest"))
    if borders and data.borders_m:
        entries.append(Line2D([], [], color="black", linestyle=(0, (4, 2)), label="border of the towers' areas"))
    return entries


def map_axes(data: MapsData, count: int, right_in: float = 0.15) -> tuple[Figure, list[Axes]]:
    """A figure with room for ``count`` maps, a legend and a margin on the right [inch], outer axes labelled."""
    west, east, south, north = extent_m(data)
    columns = min(count, COLUMNS)
    rows = -(-count // columns)
    columns = -(-count // rows)
    width = min((7.4 - 0.15 * columns) / columns, 3.2)  # what a colour bar and the labels leave
    height = float(np.clip(width * (north - south) / (east - west), 0.8, 6.5))
    fig, grid = placed(
        (9.2, rows * (height + 0.35) + 1.0),
        rows,
        columns,
        gap_in=(0.3, 0.4),
        right_in=right_in,
        sharex=True,
        sharey=True,
    )
    axes: list[Axes] = list(grid.ravel())
    for ax in axes[count:]:
        ax.set_visible(False)
    for row in grid:
        row[0].set_ylabel("North [m]")
    for number in range(count):
        if number + columns >= count:
            axes[number].set_xlabel("East [m]")
            axes[number].tick_params(labelbottom=True)
    return fig, axes[:count]


# --- figures ------------------------------------------------------------------------------------


def rss_maps(data: MapsData, maps: Sequence[RssMap], limits: tuple[float, float]) -> Figure:
    """Each tower alone and all jointly, for one antenna choice and height, on one colour scale [dBm]."""
    fig, axes = map_axes(data, len(maps), 1.0)
    image = None
    for ax, shown in zip(axes, maps, strict=True):
        alone = None if shown.tower == JOINT else shown.tower
        image = draw_map(ax, data, shown.rss_dbm, highlight=alone, cmap="viridis", vmin=limits[0], vmax=limits[1])
        ax.set_title(f"{shown.tower}: {100 * shown.coverage:.0f} %", fontsize=9)
    levels = np.concatenate([entry.rss_dbm.ravel() for entry in maps])
    low, high = axes[-1].get_position().y0, axes[0].get_position().y1
    bar = fig.add_axes((0.91, low + 0.1 * (high - low), 0.016, 0.8 * (high - low)))
    colour_bar(fig, image, axes, "RSS [dBm]", beyond(levels, *limits), bar)
    entries = overlay_legend(data, borders=any(entry.tower == JOINT for entry in maps))
    fig.legend(handles=entries, loc="lower center", ncols=3)
    return fig


def rank_grid(data: MapsData, maps: Sequence[RankMap]) -> Figure:
    """Rank at every height for one K."""
    from matplotlib.colors import BoundaryNorm, ListedColormap
    from matplotlib.patches import Patch

    fig, axes = map_axes(data, len(maps))
    colours = ListedColormap([CLASS_COLOURS[r] for r in RANKS])
    norm = BoundaryNorm([0.5, 1.5, 2.5, 3.5, 4.5], 4)
    for ax, shown in zip(axes, maps, strict=True):
        draw_map(ax, data, np.where(shown.rank > 0, shown.rank, np.nan), cmap=colours, norm=norm)
        ax.set_title(f"{shown.altitude_m:g} m", fontsize=9)
    entries = [Patch(facecolor=CLASS_COLOURS[r], edgecolor="black", label=f"rank {r}") for r in RANKS]
    fig.legend(handles=[*entries, *overlay_legend(data, borders=True)], loc="lower center", ncols=5)
    return fig


def distribution(members: Sequence[RssMap]) -> dict[str, Any]:
    """Distribution of RSS of each tower and jointly at one height, positions out of coverage counted as below."""
    marks = []
    for shown in members:
        level = np.sort(shown.rss_dbm[np.isfinite(shown.rss_dbm)])
        share = (shown.rss_dbm.size - len(level) + np.arange(1, len(level) + 1)) / shown.rss_dbm.size
        some = spread_out(len(level), 400)  # steps of a four-hundredth cannot be seen
        marks.append({"kind": "line", "name": shown.tower, "x": level[some], "y": 100.0 * share[some]})
    return {"x": {"label": "RSS [dBm]"}, "y": {"label": "Positions below [%]", "ends": [0, 100]}, "marks": marks}


def rank_shares(members: Sequence[RankMap]) -> dict[str, Any]:
    """Shares of Z and rank 1 to 4 about each height, one upon the other."""
    members = sorted(members, key=lambda member: member.altitude_m)
    at = np.array([member.altitude_m for member in members])
    half = np.diff(at) / 2.0 if len(at) > 1 else np.array([5.0])
    sides = np.repeat([max(at[0] - half[0], 0.0), *(at[:-1] + half[: len(at) - 1]), at[-1] + half[-1]], 2)[1:-1]
    share = 100.0 * np.array([member.share for member in members])
    edges = np.repeat(np.column_stack([np.zeros(len(at)), share.cumsum(axis=1)]), 2, axis=0)
    marks = [
        {"kind": "band", "name": f"rank {rank}" if rank else "Z: out of coverage", "x": sides, "low": edges[:, rank],
         "high": edges[:, rank + 1], "colour": CLASS_COLOURS[rank]}
        for rank in (0, *RANKS)
    ]  # fmt: skip
    return {"x": {"label": "Height [m]"}, "y": {"label": "Positions [%]", "ends": [0, 100]}, "marks": marks}


def correlation(curve: Correlation) -> dict[str, Any]:
    """Correlation against distance and its model."""
    marks: list[Any] = [{"kind": "dots", "name": "data", "x": curve.distance_m, "y": curve.correlation}]
    if curve.fit is not None:
        name = curve.fit_label or "model"
        marks.append({"kind": "line", "name": name, "x": curve.fit_distance_m, "y": curve.fit})
    return {"x": {"label": "Distance [m]"}, "y": {"label": "Correlation"}, "marks": marks}


def error_curves(members: Sequence[MapError], worst: float) -> dict[str, Any]:
    """MAE against height for every method; ``worst`` of all panels sets the scale."""
    marks = []
    for method, rows in grouped(sorted(members, key=lambda e: e.altitude_m), lambda e: e.method).items():
        at, mae = np.array([[row.altitude_m, row.mae] for row in rows]).T
        marks.append({"kind": "line", "name": method, "x": at, "y": mae})
    y = {"label": "MAE of the rank", "ends": [0.0, 1.08 * worst if worst > 0 else 1.0]}
    return {"x": {"label": "Height [m]"}, "y": y, "marks": marks}


@dataclass(frozen=True, slots=True, kw_only=True)
class Plate:
    """Panels of one kind: a figure as a file, and a chart of the page each; ``panels`` by their titles."""

    name: str
    section: str
    title: str
    caption: str
    panels: Mapping[str, Mapping[str, Any]]

    @property
    def spec(self) -> FigureSpec:
        """The figure."""
        return FigureSpec(self.name, partial(drawn, self.panels))

    @property
    def charts(self) -> list[Chart]:
        """Charts of the page."""
        return [
            Chart(
                section=self.section, title=f"{self.title}: {name}", caption="" if i else self.caption, content=content
            )
            for i, (name, content) in enumerate(self.panels.items())
        ]


def plates(data: MapsData) -> Iterator[Plate]:
    """Distributions, shares, correlation and errors: all that is no map."""
    for words, maps in grouped((*data.rss, *data.corrected), lambda m: f"{m.antennas}{_under(m.foliage)}").items():
        yield Plate(
            name=f"rss_cdf_{safe_name(words)}", section="rss", title=f"Distribution of RSS, {words}",
            caption="Share of positions with an RSS below the value; a curve starts at its share of Z.",
            panels={f"{at:g} m": distribution(some) for at, some in grouped(maps, lambda m: m.altitude_m).items()},
        )  # fmt: skip
    for words, ranks in grouped(data.rank, lambda m: _under(m.foliage)).items():
        yield Plate(
            name="_".join(["rank_share", *([safe_name(words)] if words else [])]), section="rank",
            title=f"Rank against height{words}", caption="Share of positions with each rank; Z is out of coverage.",
            panels={source: rank_shares(some) for source, some in grouped(ranks, lambda m: m.source).items()},
        )  # fmt: skip
    for tower, ranks in grouped(data.corrected_rank, lambda m: m.tower).items():
        yield Plate(
            name=f"rank_share_learned_{safe_name(tower)}", section="rank",
            title=f"Rank of {tower} against height, raw and corrected",
            caption="Raw: share of positions with each rank of the traced channel, by K; Z is out of coverage. Learned "
            "receiver: mean probability of each rank.",
            panels={source: rank_shares(some) for source, some in grouped(ranks, lambda m: m.source).items()},
        )  # fmt: skip
    if data.correlation:
        yield Plate(
            name="correlation", section="kriging", title="Spatial correlation",
            caption="Pearson correlation between positions against their distance, and the fitted model. "
            + " ".join(f"{c.title}: {c.excluded} constant positions left out." for c in data.correlation),
            panels={curve.title: correlation(curve) for curve in data.correlation},
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
    """One colour scale for all maps [dBm]: the 1 to 99.5 % range, to whole 5 dB."""
    parts = [entry.rss_dbm[np.isfinite(entry.rss_dbm)] for entry in maps]
    finite = np.concatenate(parts) if parts else np.zeros(0)
    if not len(finite):
        return -100.0, -50.0
    # a few cells beside a tower are far above all others and would take most colours
    low, high = np.percentile(finite, [1.0, 99.5])
    return float(5 * np.floor(low / 5)), float(max(5 * np.ceil(high / 5), 5 * np.floor(low / 5) + 5))


def figure_specs(data: MapsData) -> list[FigureSpec]:
    """Every figure that the data allow, in reading order."""
    flown = [
        replace(spec, name=f"{spec.name}_{safe_name(flight.flight)}")
        for flight in data.flights for spec in channel_specs(flight)
    ]  # fmt: skip
    return [*_rss_specs(data), *flown, *_rank_specs(data), *(plate.spec for plate in plates(data))]


def _under(foliage: str) -> str:
    return f", foliage {foliage}" if foliage else ""


def _rss_specs(data: MapsData) -> Iterator[FigureSpec]:
    levels = (*data.rss, *data.corrected)
    limits = _level_limits(levels)
    by_height = grouped(levels, lambda m: (f"{m.antennas}{_under(m.foliage)}", m.altitude_m))
    for (antennas, height), maps in by_height.items():
        name = f"rss_map_{safe_name(f'{antennas}, {height:g} m')}"
        yield FigureSpec(name, partial(rss_maps, data, maps, limits))


def _rank_specs(data: MapsData) -> Iterator[FigureSpec]:
    for words, maps in grouped(data.rank, lambda m: f"{m.source}{_under(m.foliage)}").items():
        yield FigureSpec(f"rank_map_{safe_name(words)}", partial(rank_grid, data, maps))
    for tower, maps in grouped(data.corrected_rank, lambda m: m.tower).items():
        learned = [m for m in maps if m.k is None]
        yield FigureSpec(f"rank_map_learned_{safe_name(tower)}", partial(rank_grid, data, learned))
