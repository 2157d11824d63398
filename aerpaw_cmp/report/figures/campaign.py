"""Figures of a campaign: the season."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from ..content.campaign import CampaignData
from ..kit.canvas import FigureSpec, beyond, colour_bar, draw_tower, frame_around, plan_axes, subplots
from .charts import COLOURS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Nodes of a figure: those that step first, then those that vary most.
_NODES_SHOWN = 12


def season_nodes(data: CampaignData) -> Figure:
    """Offset of nodes over the dates, less what all share; steps as bars of their intervals."""
    fig, ax = subplots((9.2, 3.6))
    order = sorted(data.season.nodes, key=lambda node: (not node.steps, -np.ptp(node.offset_db or (0.0,))))
    dates = sorted({night for node in data.season.nodes for night in node.night})
    for number, node in enumerate(order[:_NODES_SHOWN]):
        colour = COLOURS[number % len(COLOURS)]
        at = [dates.index(night) for night in node.night]
        ax.plot(at, node.offset_db, marker=".", linewidth=0.6, color=colour, alpha=0.7, label=node.node)
        for step in node.steps:
            middle, where = node.offset_db[node.night.index(step.shown)], dates.index(step.shown)
            reach = (step.step_ci95_db[1] - step.step_ci95_db[0]) / 2.0
            ax.errorbar(where, middle, yerr=reach, color=colour, capsize=4, linewidth=1.6)
    shown = np.unique(np.linspace(0, len(dates) - 1, 8).round().astype(int))
    ax.set_xticks(shown, [dates[i] for i in shown], rotation=20)
    ax.tick_params(axis="x", labelsize=8)
    ax.set_ylabel("Offset against its median [dB]")
    fig.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return fig


def season_places(data: CampaignData) -> Figure:
    """Mean residual of each cell of the plan over flights, all towers and channels."""
    shown = data.season.places
    assert shown is not None
    cells = shown.cells
    # a few outlying cells would leave one colour to all others
    reach = max(float(np.percentile(np.abs(shown.mean_db), 98)), 0.1)
    first, last = cells.min(axis=0), cells.max(axis=0) + 1
    image = np.full(tuple(last - first)[::-1], np.nan)
    image[cells[:, 1] - first[1], cells[:, 0] - first[0]] = shown.mean_db
    extent = np.array([first[0], last[0], first[1], last[1]]) * data.cell_m
    fig, ax = subplots((7.0, 5.0))
    ax.set_facecolor("#F4F4F4")
    # no grey in it: a grey middle would turn dark on a dark page, between two light neighbours
    mesh = ax.imshow(
        image, origin="lower", extent=tuple(extent), cmap="Spectral_r", vmin=-reach, vmax=reach, interpolation="none",
        zorder=2,
    )  # fmt: skip
    known = {} if data.site is None else data.site.towers
    names = dict.fromkeys(row.tower for row in data.reference_rows if row.tower in known)
    for tower in names:
        draw_tower(ax, known[tower])
    plan_axes(ax)
    at = [known[name].position_m[None, :2] for name in names]
    frame_around(ax, *np.concatenate([(cells + 0.5) * data.cell_m, *at]).T)
    colour_bar(fig, mesh, [ax], "Mean of measured − simulated [dB]", beyond(shown.mean_db, -reach, reach))
    return fig


def figure_specs(data: CampaignData) -> Iterator[FigureSpec]:
    """Figures of the season, where the campaign has numbers for them."""
    if any(len(node.night) > 1 for node in data.season.nodes):
        yield FigureSpec(
            "season_nodes", partial(season_nodes, data), "Offsets over the season",
            "Offset of each node over the dates, less what all nodes share (weather, a transmitter). A bar: the 95 % "
            f"interval of a step. Of more than {_NODES_SHOWN} nodes those that step, then those that vary most.",
        )  # fmt: skip
    if data.season.places is not None:
        yield FigureSpec(
            "season_places", partial(season_places, data), "Where the simulation errs, over all flights",
            f"Mean over flights of the mean residual in cells of {data.cell_m:g} m, “{data.reference}”, all towers and "
            "channels.",
        )  # fmt: skip
