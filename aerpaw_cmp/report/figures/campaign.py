"""Figures of a campaign: the season."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from ..content.campaign import CampaignData
from ..kit.canvas import TOWER, FigureSpec, beyond, colour_bar, frame_around, plan_axes, subplots
from .charts import COLOURS
from .maps import grouped

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_MARKERS = "os^Dv<>P"


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
            np.array(at), [r.offset_db for r in good], linestyle="none", marker=_MARKERS[number % len(_MARKERS)],
            markersize=3.5, color=COLOURS[number % len(COLOURS)], alpha=0.7,
            label=link + slopes.get(link, ""),
        )  # fmt: skip
    ax.set_xlabel("Start of the flight (UTC)" if dated else "Number of the flight in the campaign")
    ax.set_ylabel("Offset [dB]")
    ax.tick_params(axis="x", labelsize=8, rotation=20 if dated else 0)
    fig.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return fig


def season_places(data: CampaignData) -> Figure:
    """Mean residual of each cell of the plan over flights, all towers and channels."""
    shown = data.season.places
    assert shown is not None
    cells = shown.cells
    reach = max(float(np.percentile(np.abs(shown.mean_db), 98)), 0.1)
    first, last = cells.min(axis=0), cells.max(axis=0) + 1
    image = np.full(tuple(last - first)[::-1], np.nan)
    image[cells[:, 1] - first[1], cells[:, 0] - first[0]] = shown.mean_db
    extent = np.array([first[0], last[0], first[1], last[1]]) * data.cell_m
    fig, ax = subplots((7.0, 5.0))
    ax.set_facecolor("#F4F4F4")
    mesh = ax.imshow(
        image, origin="lower", extent=tuple(extent), cmap="RdBu_r", vmin=-reach, vmax=reach, interpolation="none",
        zorder=2,
    )  # fmt: skip
    known = {} if data.site is None else data.site.towers
    names = dict.fromkeys(row.tower for row in data.reference_rows if row.tower in known)
    for tower in names:
        ax.plot(
            known[tower].east_m, known[tower].north_m, marker="^", markersize=9, color=TOWER, markeredgecolor="white",
            linestyle="none", zorder=5,
        )  # fmt: skip
    plan_axes(ax)
    at = [known[name].position_m[None, :2] for name in names]
    frame_around(ax, *np.concatenate([(cells + 0.5) * data.cell_m, *at]).T)
    colour_bar(fig, mesh, [ax], "Mean of measured − simulated [dB]", beyond(shown.mean_db, -reach, reach))
    return fig


def figure_specs(data: CampaignData) -> Iterator[FigureSpec]:
    """Figures of the season, where the campaign has numbers for them."""
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
