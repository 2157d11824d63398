"""Data of the maps and spheres of predict, plan, locate, calibrate and campaign: values at positions or directions."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..common.grouping import lists_by_key
from ..common.kml import CLASS_COLOURS
from ..common.units import FloatArray, spread_out
from ..site.site import Site
from .charts import Chart
from .flight_data import RANKS
from .packed import PackedArrays, ends_of_scale, listed, packed, plan_of, step_for

# Largest number of values on a page. Larger groups are thinned.
MOST_VALUES = 1_500_000

# Name of a layer of ranks, and names of the layers of the ends of an interval.
LIKELIEST = "likeliest rank"
BAND = ("low", "high")

# First word of a layer whose colours are centred on zero.
RESIDUAL = "residual"

# Names of azimuths 0, 90, 180 and 270 degrees, counter-clockwise.
COMPASS = ("E", "N", "W", "S")
BODY = ("forward", "left", "aft", "right")


@dataclass(frozen=True, slots=True, kw_only=True)
class Places:
    """A group of values at positions or directions. The reader of a page can choose a group.

    Parameters
    ----------
    name : str
    at : (n, 3)
        East, north, up [m]; unit vectors if ``around`` is given.
    values : mapping of str to (n,)
        Values by name with unit. :data:`BAND` names the ends of the interval of the first values, drawn over time.
    around : tuple of str
        Names of the azimuths 0, 90, 180 and 270 degrees, for values on a sphere; empty for positions.
    cell_m : float
        Side of the cells of a grid [m].
    time_s : (n,), optional
        Times of points along a route [s].
    dots : (m, 3)
        Unit vectors to mark on the sphere.
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
    charts: Sequence[Chart] = (),
    note: str = "",
) -> dict[str, Any]:
    """Return all data of the script as plain values.

    Parameters
    ----------
    groups : sequence of Places
    site : Site, optional
    lines : iterable of (k, 2 or more)
        East, north of flown or proposed routes [m].
    rings : iterable of (k, 2)
        Outlines of the area in which a route may run [m].
    charts : sequence of Chart
    note : str
        Sentence below the map that explains its lines.

    Returns
    -------
    dict
        Values that JSON can store; arrays are in ``packed``.
    """
    arrays, total = PackedArrays(), sum(group.at.shape[0] * len(group.values) for group in groups)
    alike = lists_by_key(
        (_scale(group.name, name), np.asarray(column, dtype=np.float64))
        for group in groups
        for name, column in group.values.items()
    )
    every = {key: np.concatenate(columns) for key, columns in alike.items()}
    ranges = {key: _range(key[1], values[np.isfinite(values)]) for key, values in every.items()}
    return {
        "site": None if site is None else plan_of(site),
        "lines": [listed(np.asarray(line)[spread_out(len(line), 2000), :2]) for line in lines],
        "rings": [listed(ring[:, :2]) for ring in rings],
        "groups": [_group(group, arrays, total, ranges) for group in groups],
        "ranks": {str(rank): CLASS_COLOURS[rank] for rank in RANKS},
        "note": note,
        "plots": [packed(chart.content, arrays) for chart in charts],
        "packed": arrays.content(),
    }


def _scale(group: str, layer: str) -> tuple[str, str]:
    """Return the key of a colour scale. All heights share one scale, and so do values before and after a flight."""
    return group.partition(", ")[0], layer.partition(" ")[0]


def _range(layer: str, values: FloatArray) -> list[float]:
    """Return the colour scale of a quantity, symmetric for residuals."""
    low, high = ends_of_scale(values, 99.0)
    reach = max(-low, high)
    return [-reach, reach] if layer == RESIDUAL else [low, high]


def _group(
    group: Places, arrays: PackedArrays, total: int, ranges: Mapping[tuple[str, str], list[float]]
) -> dict[str, Any]:
    n = len(group.at)
    pick = spread_out(n, n if total <= MOST_VALUES else max(200, n * MOST_VALUES // total))
    dots = np.zeros((0, 3)) if group.dots is None else group.dots[spread_out(len(group.dots), 2000)]
    layers = []
    for name, column in group.values.items():
        values = np.asarray(column, dtype=np.float64)[pick]
        # use finer steps for probabilities, because steps of 0.01 would be visible
        step = step_for(values, 1e-4 if "probability" in name else 0.01)
        scale = {"range": ranges[_scale(group.name, name)], "step": step}
        layers.append({"name": name, **scale, "values": arrays.add_steps(values, step)})
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
