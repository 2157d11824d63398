"""The data of the live canvas of predict, plan, locate and calibrate: values at places, or over a sphere."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..common.kml import CLASS_COLOURS
from ..common.units import FloatArray, spread_out
from ..site.site import Site
from .flight_data import RANKS
from .packed import PackedArrays, ends_of_scale, listed, plan_of, step_for

# Values that a page holds; beyond them each group is thinned.
MOST_VALUES = 1_500_000

# Name of a layer of ranks, and of what is drawn about it.
LIKELIEST = "likeliest rank"
BAND = ("low", "high")

# What an azimuth is counted from, counter-clockwise.
COMPASS = ("E", "N", "W", "S")
BODY = ("forward", "left", "aft", "right")


@dataclass(frozen=True, slots=True, kw_only=True)
class Places:
    """Values at points, one group of them to choose.

    Parameters
    ----------
    name : str
    at : (n, 3)
        East, north, up [m]; unit vectors where ``around`` is given.
    values : mapping of str to (n,)
        By name with unit. :data:`BAND` is drawn about the first over time, not listed.
    around : tuple of str
        Names of the directions 0, 90, 180, 270 degrees of a sphere.
    cell_m : float
        Side of the cells of a grid.
    time_s : (n,), optional
        Of points along a route.
    dots : (m, 3)
        Unit vectors that are marked on the sphere.
    """

    name: str
    at: FloatArray
    values: Mapping[str, ArrayLike]
    around: tuple[str, ...] = ()
    cell_m: float = 0.0
    time_s: FloatArray | None = None
    dots: FloatArray | None = None


def payload(
    groups: Sequence[Places],
    site: Site | None = None,
    lines: Iterable[FloatArray] = (),
    rings: Iterable[FloatArray] = (),
) -> dict[str, Any]:
    """Everything the script needs, as plain values.

    Parameters
    ----------
    groups : sequence of Places
    site : Site, optional
    lines : iterable of (k, 2 or more)
        Routes, flown or proposed [m].
    rings : iterable of (k, 2)
        Outlines of where a route may run [m].

    Returns
    -------
    dict
        As JSON can hold it; arrays stand packed in ``packed``.
    """
    arrays, total = PackedArrays(), sum(group.at.shape[0] * len(group.values) for group in groups)
    alike: dict[tuple[str, str], list[FloatArray]] = {}
    for group in groups:
        for name, column in group.values.items():
            alike.setdefault(_scale(group.name, name), []).append(np.asarray(column, dtype=np.float64))
    every = {key: np.concatenate(columns) for key, columns in alike.items()}
    ranges = {key: ends_of_scale(values[np.isfinite(values)], 99.0) for key, values in every.items()}
    return {
        "site": None if site is None else plan_of(site),
        "lines": [listed(np.round(np.asarray(line)[spread_out(len(line), 2000), :2], 1)) for line in lines],
        "rings": [listed(np.round(ring[:, :2], 1)) for ring in rings],
        "groups": [_group(group, arrays, total, ranges) for group in groups],
        "ranks": {str(rank): CLASS_COLOURS[rank] for rank in RANKS},
        "packed": arrays.content(),
    }


def _scale(group: str, layer: str) -> tuple[str, str]:
    """Key of a colour scale: a quantity shares it at all heights, a deviation before and after a flight."""
    return group.partition(", ")[0], layer.partition(" ")[0]


def _group(
    group: Places, arrays: PackedArrays, total: int, ranges: Mapping[tuple[str, str], list[float]]
) -> dict[str, Any]:
    n = len(group.at)
    pick = spread_out(n, n if total <= MOST_VALUES else max(200, n * MOST_VALUES // total))
    dots = np.zeros((0, 3)) if group.dots is None else group.dots[spread_out(len(group.dots), 2000)]
    layers = []
    for name, column in group.values.items():
        values = np.asarray(column, dtype=np.float64)[pick]
        # probabilities lie between 0 and 1, where steps of a hundredth can be seen
        step = step_for(values, 1e-4 if "probability" in name else 0.01)
        packed = {"step": step, "values": arrays.add_steps(values, step)}
        layers.append({"name": name, "range": ranges[_scale(group.name, name)], **packed})
    return {
        "name": group.name,
        "of": n,
        "around": group.around,
        "cell": group.cell_m,
        "at": [arrays.add(axis) for axis in group.at[pick].T],
        "time": None if group.time_s is None else arrays.add(group.time_s[pick], "f8"),
        "dots": [arrays.add(axis) for axis in dots.T],
        "layers": [layer for layer in layers if layer["name"] not in BAND],
        "band": [layer for layer in layers if layer["name"] in BAND],
    }
