"""plan.html with metrics.json, the chosen route as files, the map of expected standard deviations, and figures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from ...common.cells import guarded
from ...common.jsonable import json_object, named
from ...common.units import FloatArray
from ..content.made import Made, about
from ..kit import canvas
from ..kit.canvas import FigureSpec
from ..kit.files import write_file
from ..kit.page import write_page


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanPage(Made):
    """Content of the page of ``plan``.

    ``candidates`` and ``curve`` hold rows of metrics.json; ``outline_m`` (k, 2) and ``holes_m`` bound where a route may
    run; ``track_m`` (n, 3); ``place_m`` (m, 3) with ``before_db`` and ``after_db`` (m,); ``towers`` by name (3,).
    """

    target: str
    sentence: str
    antennas: Sequence[str]
    flights: Sequence[str]
    candidates: Sequence[Mapping[str, Any]]
    curve: Sequence[Mapping[str, float]]
    outline_m: FloatArray
    holes_m: Sequence[FloatArray]
    track_m: FloatArray
    place_m: FloatArray
    before_db: FloatArray
    after_db: FloatArray
    towers: Mapping[str, FloatArray]
    files: Mapping[str, str]
    warnings: Sequence[str]


def plan_metrics(data: PlanPage) -> dict[str, Any]:
    """The numbers of the page under stable names."""
    return json_object(
        **named(data, "target sentence antennas flights candidates warnings"),
        sd_now_db=float(np.sqrt(np.mean(data.before_db**2))),
        length=data.curve,
        **about(data),
    )


def write_plan(data: PlanPage, folder: Path) -> list[Path]:
    """Write the page and all files beside it; the page first."""
    numbers = plan_metrics(data)
    written = write_page(folder, "plan", numbers, _figures(data), data=data, metrics=numbers)
    written += [write_file(folder / name, text) for name, text in data.files.items()]
    columns = dict(zip(("east_m", "north_m", "height_m"), data.place_m.T, strict=True))
    table: pd.DataFrame = pd.DataFrame({**columns, "sd_before_db": data.before_db, "sd_after_db": data.after_db})
    guarded(table.round(3)).to_csv(folder / "sd_map.csv", index=False, lineterminator="\n")
    return [*written, folder / "sd_map.csv"]


def _figures(data: PlanPage) -> Iterator[FigureSpec]:
    yield FigureSpec(
        "map", "maps", "Standard deviation before and after the proposed flight",
        "Root mean square over antennas and headings at each point of the target, dB. Line: the proposed route. Grey: "
        "where a route may run.",
        partial(_draw_map, data),
    )  # fmt: skip


def _draw_map(data: PlanPage) -> Figure:
    fig, axes = canvas.subplots((9.2, 4.8), 1, 2, sharex=True, sharey=True)
    _, first, member = np.unique(data.place_m[:, :2].round(1), axis=0, return_index=True, return_inverse=True)
    count = np.bincount(member.ravel())
    spreads = [np.sqrt(np.bincount(member.ravel(), v**2) / count) for v in (data.before_db, data.after_db)]
    low, high = float(min(v.min() for v in spreads)), float(max(v.max() for v in spreads))
    for ax, values, title in zip(axes, spreads, ("now", "after the flight"), strict=True):
        for ring in (data.outline_m, *data.holes_m):
            ax.plot(ring[:, 0], ring[:, 1], color="0.75", linewidth=0.8)
        place = data.place_m[first]
        shown = ax.scatter(place[:, 0], place[:, 1], c=values, s=9, vmin=low, vmax=high, cmap="plasma", rasterized=True)
        fig.colorbar(shown, ax=ax, label="standard deviation [dB]", pad=0.02, shrink=0.85)
        for name, at in data.towers.items():
            ax.plot(at[0], at[1], "^", color="black", markersize=5)
            ax.annotate(name, at[:2], xytext=(3, 3), textcoords="offset points", fontsize=7, annotation_clip=True)
        canvas.plan_axes(ax)
        ax.set_title(title)
        ax.label_outer()
    extent = np.concatenate([data.place_m[:, :2], data.outline_m, data.track_m[:, :2]])
    canvas.frame_around(axes[0], *extent.T, shape=canvas.plan_shape(*extent.T))
    axes[1].plot(data.track_m[:, 0], data.track_m[:, 1], color=canvas.MEASURED, linewidth=1.0)
    return fig
