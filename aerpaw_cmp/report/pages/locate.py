"""locate.html with metrics.json: the regions of a ground node's place on the site."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...common.jsonable import json_object, named
from ...common.units import FloatArray
from ...compare.learning.locate import Regions
from ...site.site import Site
from ..content.made import Made, about
from ..kit.page import write_page
from .places import Places, payload


@dataclass(frozen=True, slots=True, kw_only=True)
class LocatePage(Made):
    """Content of the page of ``locate``.

    ``modes`` are rows of metrics.json, the likeliest first; ``track_m`` (n, 2 or more).
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
    site: Site


def locate_metrics(data: LocatePage) -> dict[str, Any]:
    """The numbers of the page under stable names."""
    names = "flight channel sentence position region50_m region90_m modes assumed warnings"
    return json_object(**named(data, names), **about(data))


def write_locate(data: LocatePage, folder: Path) -> list[Path]:
    """Write the page and all files beside it; the page first."""
    held, (east, north) = data.regions.likelier(), np.meshgrid(data.regions.east_m, data.regions.north_m, indexing="ij")
    inside = held < 0.9
    places = Places(
        name="region of the node",
        at=np.column_stack([east[inside], north[inside], np.zeros(inside.sum())]),
        values={"in the region of [%]": 100.0 * held[inside]},
        cell_m=float(data.regions.east_m[1] - data.regions.east_m[0]),
    )
    crosses = [np.array([[m["east_m"], m["north_m"]]]) + 8.0 * arm for m in data.modes for arm in _CROSS]
    shown = payload([places], data.site, lines=[data.track_m, *crosses])
    return write_page(folder, "locate", locate_metrics(data), shown, data=data)


_CROSS = np.array([[[-1.0, 0.0], [1.0, 0.0]], [[0.0, -1.0], [0.0, 1.0]]])
