"""Figures of a campaign: flights laid over each other, settings side by side, the season."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from ...common.counting import counted
from ...common.units import FloatArray, IntArray
from ...site.site import Site
from ..content.campaign import CampaignData, RssRow, place_means
from ..kit.canvas import (
    TOWER,
    FigureSpec,
    beyond,
    colour_bar,
    draw_site,
    frame_around,
    plan_axes,
    plan_shape,
    subplots,
    thinned,
    thinned_plan,
)
from ..names import safe_name
from ..words.flight import count
from .maps import COLOURS, MARKERS, curve_style, grouped

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


_DISTANCE_BINS = 30

# Samples that a bin needs: no line is drawn over what was not flown.
_FEWEST_PER_BIN = 8

_MAPS_PER_ROW = 3

# Flights that are told apart by colour, or have a map each.
MOST_FLIGHTS = 12


def against_distance(rows: Sequence[RssRow], numbers: dict[str, int]) -> Figure:
    """RSS after the offset against distance, and its difference to the simulation below, all flights on one axis."""
    fig, (top, low) = subplots((9.2, 6.4), 2, 1, sharex=True, height_ratios=(1.5, 1.0))
    edges = np.linspace(0.0, max(float(np.nanmax(row.distance_m)) for row in rows), _DISTANCE_BINS + 1)
    for row in rows:
        name, style = row.flight, curve_style(numbers[row.flight])
        for ax, values in ((top, row.measured_db + row.offset_db), (low, row.residual_db)):
            at, less, median, more = _binned(row.distance_m, values, edges)
            ax.fill_between(at, less, more, color=style["color"], alpha=0.15, linewidth=0)
            ax.plot(at, median, linewidth=1.8, label=f"{name}, measured + offset ({count(row.n)})", **style)
        simulated = np.where(np.isfinite(row.measured_db), row.simulated_dbm, np.nan)
        at, _, median, _ = _binned(row.distance_m, simulated, edges)
        top.plot(
            at, median, linestyle="none", marker=MARKERS[numbers[name] % len(MARKERS)], markersize=4.5,
            markerfacecolor="white", color=style["color"], label=f"{name}, ray tracing",
        )  # fmt: skip
    low.axhline(0.0, color="black", linewidth=0.8)
    top.set_ylabel("RSS [dBm]")
    low.set(ylabel="Measured − simulated [dB]", xlabel="Distance tower to UAV [m]")
    fig.legend(*top.get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return fig


def _binned(at: FloatArray, values: FloatArray, edges: FloatArray) -> list[Any]:
    """Mean place and the 10, 50 and 90 % points of the values, by bin; a bin with few samples is left out."""
    import pandas as pd

    known = pd.DataFrame({"at": at, "values": values}).dropna()
    bins = known.groupby(np.digitize(known["at"], edges[1:-1]))
    levels = [bins["at"].mean(), *(bins["values"].quantile(q) for q in (0.1, 0.5, 0.9))]
    return [level[bins.size() >= _FEWEST_PER_BIN] for level in levels]


def tracks(data: CampaignData, site: Site, numbers: dict[str, int]) -> Figure:
    """All flights on the plan, and their heights over time."""
    firsts = data.tracks
    towers = dict.fromkeys([*(row.tower for row in data.rss), *(row.tower for row in data.rank)])
    fig, (plan, height) = subplots((9.2, 4.9), 1, 2, width_ratios=(1.15, 1.0))
    draw_site(plan, site)
    for row in firsts:
        number = numbers[row.flight]
        east, north = thinned_plan(row.position_m[:, 0], row.position_m[:, 1])
        width = 1.2 + 2.4 * (len(firsts) - 1 - number % len(firsts)) / max(len(firsts) - 1, 1)
        plan.plot(east, north, linewidth=width, label=row.flight, zorder=4, **curve_style(number))
        height.plot(*thinned(row.time_s, row.position_m[:, 2]), linewidth=1.4, label=row.flight, **curve_style(number))
    east = np.concatenate([row.position_m[:, 0] for row in firsts])
    north = np.concatenate([row.position_m[:, 1] for row in firsts])
    used = [site.towers[name] for name in towers if name in site.towers]
    east = np.concatenate([east, [t.east_m for t in used]])
    north = np.concatenate([north, [t.north_m for t in used]])
    frame_around(plan, east, north)
    plan.set_title("Plan")
    height.set(title="Height", xlabel="Time after the first radio sample of each flight [s]")
    height.set_ylabel("Height above ground [m]")
    handles, labels = plan.get_legend_handles_labels()
    if len(firsts) <= MOST_FLIGHTS:
        fig.legend(handles, labels, loc="outside lower center", ncols=4)
    return fig


def season_drift(data: CampaignData) -> Figure:
    """Own offset of every flight over its date, the first setting, a colour and marker per tower and channel."""
    fig, ax = subplots((9.2, 3.6))
    dated = len(data.season.started) >= len(data.flights) / 2 and len(data.season.started) > 1
    numbers = {name: number for number, name in enumerate(data.flights)}
    slopes = {
        f"{d.tower} {d.channel}".strip(): f", {d.slope_db_per_30_days:+.1f} dB per 30 days"
        for d in data.season.drift
        if d.setting == data.reference and np.isfinite(d.slope_db_per_30_days)
    }
    for number, (link, rows) in enumerate(grouped(data.reference_rows, lambda r: r.link).items()):
        good = [r for r in rows if np.isfinite(r.offset_db) and (not dated or r.flight in data.season.started)]
        at = [np.datetime64(data.season.started[r.flight][:-1]) if dated else numbers[r.flight] + 1 for r in good]
        ax.plot(
            np.array(at), [r.offset_db for r in good], linestyle="none", marker=MARKERS[number % len(MARKERS)],
            markersize=3.5, color=COLOURS[number % len(COLOURS)], alpha=0.7,
            label=link + slopes.get(link, ""),
        )  # fmt: skip
    ax.set_xlabel("Start of the flight (UTC)" if dated else "Number of the flight in the campaign")
    ax.set_ylabel("Offset [dB]")
    ax.tick_params(axis="x", labelsize=8, rotation=20 if dated else 0)
    fig.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return fig


def _cells(
    ax: Axes, data: CampaignData, cells: IntArray, means_db: FloatArray, reach_db: float, towers: Iterable[str]
) -> Any:
    """Mean residual of square cells of the plan, with towers.

    Parameters
    ----------
    ax : Axes
    data : CampaignData
    cells : (n, 2)
        Column and row of each, in multiples of ``data.cell_m`` from the origin.
    means_db : (n,)
    reach_db : float
        End of the colour scale.
    towers : iterable of str

    Returns
    -------
    matplotlib.image.AxesImage
    """
    first, last = cells.min(axis=0), cells.max(axis=0) + 1
    image = np.full(tuple(last - first)[::-1], np.nan)
    image[cells[:, 1] - first[1], cells[:, 0] - first[0]] = means_db
    extent = np.array([first[0], last[0], first[1], last[1]]) * data.cell_m
    ax.set_facecolor("#F4F4F4")
    mesh = ax.imshow(
        image, origin="lower", extent=tuple(extent), cmap="RdBu_r", vmin=-reach_db, vmax=reach_db,
        interpolation="none", zorder=2,
    )  # fmt: skip
    for tower in towers:
        at = None if data.site is None else data.site.towers.get(tower)
        if at is not None:
            ax.plot(
                at.east_m, at.north_m, marker="^", markersize=9, color=TOWER, markeredgecolor="white",
                linestyle="none", zorder=5, label=f"tower {tower}",
            )  # fmt: skip
    plan_axes(ax)
    return mesh


def _frame(ax: Axes, data: CampaignData, cells: IntArray, towers: Iterable[str], shape: float = 1.0) -> None:
    """Limits of a plan around cells and towers."""
    known = {} if data.site is None else data.site.towers
    at = [known[name].position_m[:2] for name in towers if name in known]
    frame_around(ax, *np.concatenate([(cells + 0.5) * data.cell_m, *(place[None] for place in at)]).T, shape=shape)


def season_places(data: CampaignData) -> Figure:
    """Mean residual of each cell of the plan over flights, all towers and channels."""
    shown = data.season.places
    assert shown is not None
    cells = shown.cells
    reach = max(float(np.percentile(np.abs(shown.mean_db), 98)), 0.1)
    towers = list(dict.fromkeys(row.tower for row in data.reference_rows))
    fig, ax = subplots((7.0, 5.0))
    mesh = _cells(ax, data, cells, shown.mean_db, reach, towers)
    _frame(ax, data, cells, towers)
    colour_bar(fig, mesh, [ax], "Mean of measured − simulated [dB]", beyond(shown.mean_db, -reach, reach))
    return fig


def places(data: CampaignData, rows: Sequence[RssRow]) -> Figure:
    """Mean residual per cell of the plan, flights side by side on one scale."""
    means = [place_means(row, data.cell_m) for row in rows]
    cells = np.array([cell for cell_mean in means for cell in cell_mean]).reshape(-1, 2)
    values = np.array([mean for cell_mean in means for mean, _ in cell_mean.values()])
    reach = float(np.percentile(np.abs(values), 98)) if len(values) else 1.0
    columns = min(len(rows), _MAPS_PER_ROW)
    lines = -(-len(rows) // columns)
    shape = plan_shape(*(cells.T + 0.5) * data.cell_m)
    width = (7.2 - 0.2 * columns) / columns  # what labels and the colour bar leave
    size = 9.2, 1.0 + lines * min(width / shape + 0.45, 6.0)
    fig, axes = subplots(size, lines, columns, squeeze=False, sharex=True, sharey=True)
    mesh: Any = None
    for ax in axes.ravel()[len(rows) :]:
        ax.set_visible(False)
    for ax, row, cell_mean in zip(axes.ravel(), rows, means, strict=False):
        if cell_mean:
            residual = np.array([mean for mean, _ in cell_mean.values()])
            mesh = _cells(ax, data, np.array(list(cell_mean)), residual, reach, [row.tower])
        ax.set_title(f"{row.flight} ({counted(row.n, 'sample')})")
        ax.label_outer()
    _frame(axes[0][0], data, cells, [rows[0].tower], shape)
    if mesh is not None:
        colour_bar(fig, mesh, axes.ravel().tolist(), "Mean of measured − simulated [dB]", beyond(values, -reach, reach))
    fig.legend(*axes[0][0].get_legend_handles_labels(), loc="outside lower center")
    return fig


def figure_specs(data: CampaignData) -> list[FigureSpec]:
    """Every figure that the campaign has numbers for."""
    return [*_season_specs(data), *_flight_specs(data)]


def _season_specs(data: CampaignData) -> Iterator[FigureSpec]:
    """Figures of the season."""
    if not data.season.over_all():
        return
    yield FigureSpec(
        "season_drift", "season", "Offsets over the season",
        f"Each flight's own offset under “{data.reference}”, by tower and channel.",
        partial(season_drift, data),
    )  # fmt: skip
    if data.season.places is not None:
        yield FigureSpec(
            "season_places", "season", "Where the simulation errs, over all flights",
            f"Mean over flights of the mean residual in cells of {data.cell_m:g} m, “{data.reference}”, all towers and "
            "channels.",
            partial(season_places, data),
        )  # fmt: skip


def _flight_specs(data: CampaignData) -> Iterator[FigureSpec]:
    numbers = {track.flight: number for number, track in enumerate(data.tracks)}
    if numbers and data.site is not None:
        yield FigureSpec(
            "tracks", "overlay", "The flights laid over each other", "Where the radio was sampled.",
            partial(tracks, data, data.site, numbers),
        )  # fmt: skip
    for link, rows in grouped(data.reference_rows, lambda r: r.link).items():
        scored = [row for row in rows if row.n > 0]
        if scored and len(scored) <= MOST_FLIGHTS:
            yield FigureSpec(
                f"distance_{safe_name(link)}", "overlay", f"{link}: RSS against distance, all flights",
                f"Setting: {data.reference}. Lines: medians of {_DISTANCE_BINS} bins of distance; bands: 10 % to 90 %. "
                "Open markers: medians of the simulation at the same samples. Each flight has its own offset.",
                partial(against_distance, scored, numbers),
            )  # fmt: skip
            yield FigureSpec(
                f"places_{safe_name(link)}", "overlay", f"{link}: where the simulation errs, flight by flight",
                f"Mean residual in cells of {data.cell_m:g} m, all heights together, one colour scale. A pattern that "
                "comes back on another flight is an error of the model; one that does not is of that flight.",
                partial(places, data, scored),
            )  # fmt: skip
