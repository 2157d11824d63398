"""locate.html with metrics.json: the regions of a ground node's place on the site."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ...common.jsonable import json_object, named
from ...common.units import FloatArray
from ...compare.learning.locate import Regions
from ..content.made import Made, about
from ..kit import canvas
from ..kit.canvas import FigureSpec
from ..kit.page import write_page


@dataclass(frozen=True, slots=True, kw_only=True)
class LocatePage(Made):
    """Content of the page of ``locate``.

    ``modes`` are rows of metrics.json, the likeliest first; ``track_m`` (n, 2 or more); ``towers`` by name (3,).
    """

    flight: str
    channel: str
    sentence: str
    position: Mapping[str, float]
    region50_m: float
    region90_m: float
    modes: Sequence[Mapping[str, float]]
    assumed: Sequence[str]
    warnings: Sequence[str]
    regions: Regions
    track_m: FloatArray
    towers: Mapping[str, FloatArray]


def locate_metrics(data: LocatePage) -> dict[str, Any]:
    """The numbers of the page under stable names."""
    names = "flight channel sentence position region50_m region90_m modes assumed warnings"
    return json_object(**named(data, names), **about(data))


def write_locate(data: LocatePage, folder: Path) -> list[Path]:
    """Write the page and all files beside it; the page first."""
    return write_page(folder, "locate", locate_metrics(data), _figures(data), data=data)


def _figures(data: LocatePage) -> Iterator[FigureSpec]:
    caption = "Dark: 50 % region, light: 90 % region. Line: the flight. Triangles: towers of the site."
    yield FigureSpec("map", "map", "Where the levels place the node", caption, partial(_draw, data))


def _draw(data: LocatePage) -> Figure:
    fig, ax = canvas.subplots((7.2, 5.6))
    part = data.regions.holding(0.9).astype(float) + data.regions.holding(0.5)
    ax.contourf(
        data.regions.east_m, data.regions.north_m, part.T, levels=[0.5, 1.5, 2.5], colors=["#f6c28b", "#d9642c"]
    )
    ax.plot(*data.track_m.T[:2], color="0.5", linewidth=0.8)
    for name, at in data.towers.items():
        ax.plot(at[0], at[1], "^", color="black", markersize=5)
        ax.annotate(name, at[:2], xytext=(3, 3), textcoords="offset points", fontsize=7, annotation_clip=True)
    for mode in data.modes:
        ax.plot(mode["east_m"], mode["north_m"], "+", color="black", markersize=10)
    canvas.plan_axes(ax)
    columns, rows = np.nonzero(part)
    east, north = data.regions.east_m[columns], data.regions.north_m[rows]
    canvas.frame_around(ax, np.append(east, data.track_m[:, 0]), np.append(north, data.track_m[:, 1]))
    return fig
