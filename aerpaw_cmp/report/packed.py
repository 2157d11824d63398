"""Data for the scripts of pages: packed arrays, and the objects of a site as points."""

from __future__ import annotations

import base64
import zlib
from itertools import pairwise
from typing import Any

import numpy as np
import shapely
from shapely import Polygon

from ..common.units import AnyArray, FloatArray, spread_out
from ..site.scenes import drawn_buildings
from ..site.site import Building, Site

# Value that represents NaN in an array of each integer kind.
NONE = {"u1": 255, "u2": 65_535, "i2": -32_768}

# Largest magnitude in 16 bits. The range is symmetric, because the most negative number represents NaN.
LARGEST = 32_767


# Largest number of trees that a page draws.
_TREES = 1500


class PackedArrays:
    """The arrays of a page in one block. Equal arrays are stored once. Each array starts at a multiple of eight bytes.

    Examples
    --------
    >>> arrays = PackedArrays()
    >>> arrays.add(np.array([1.5, 2.5]), "f4"), arrays.add(np.array([7]), "u1"), arrays.add(np.array([1.5, 2.5]), "f4")
    (0, 1, 0)
    >>> arrays.content()["arrays"]
    [['f4', 0, 2], ['u1', 8, 1]]
    """

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._table: list[tuple[str, int, int]] = []
        self._known: dict[tuple[str, bytes], int] = {}
        self._size = 0

    def add(self, values: AnyArray, kind: str = "f4") -> int:
        """Store an array in little-endian form and return its number. Equal arrays share a number."""
        raw = np.ascontiguousarray(values, dtype=f"<{kind}").tobytes()
        key = (kind, raw)
        if key not in self._known:
            self._known[key] = len(self._table)
            self._table.append((kind, self._size, np.size(values)))
            # a typed array of JavaScript must begin at a multiple of the size of its elements
            padded = raw + bytes(-len(raw) % 8)
            self._parts.append(padded)
            self._size += len(padded)
        return self._known[key]

    def add_steps(self, values: FloatArray, step: float) -> int:
        """Store an array as 16-bit multiples of ``step`` and return its number. NaN and infinities count as missing."""
        return self.add(_steps_of(values, step), "i2")

    def content(self) -> dict[str, Any]:
        """Return ``{"data": base64 of the deflated block, "arrays": [[kind, offset, length], ...]}``."""
        block = zlib.compress(b"".join(self._parts), 9)
        return {"data": base64.b64encode(block).decode("ascii"), "arrays": [list(entry) for entry in self._table]}


def _steps_of(values: FloatArray, step: float) -> AnyArray:
    """Return values as multiples of ``step``, clipped to 16 bits. NaN and infinities count as missing.

    Examples
    --------
    >>> _steps_of(np.array([0.014, -1.0, np.nan]), 0.01).tolist()
    [1, -100, -32768]
    """
    array = np.asarray(values, dtype=np.float64)
    finite = np.isfinite(array)
    with np.errstate(over="ignore"):
        scaled = np.rint(np.where(finite, array, 0.0) / step)
    return np.where(finite, np.clip(scaled, -LARGEST, LARGEST), NONE["i2"]).astype(np.int16)


def step_for(values: FloatArray, finest: float) -> float:
    """Return the smallest step that stores all values in 16 bits: ``finest`` times a power of ten.

    Examples
    --------
    >>> step_for(np.array([-140.0, 30.0]), 0.01), step_for(np.array([0.0, 5000.0]), 0.01)
    (0.01, 1.0)
    """
    array = np.asarray(values, dtype=np.float64)
    reach = float(np.abs(array[np.isfinite(array)]).max(initial=0.0))
    # allow for rounding of the logarithm, which would give a value at the limit a larger step
    tens = int(np.ceil(np.log10(max(reach / (LARGEST * finest), 1.0)) - 1e-12))
    return float(finest * 10.0**tens)


def outline(area: Polygon) -> FloatArray:
    """Return the corners (n, 2) of an area as one line that includes its holes, so that holes are not filled."""
    area = shapely.orient_polygons(area)
    outer = np.asarray(area.exterior.coords)[:, :2]
    holes = [part for ring in area.interiors for part in (np.asarray(ring.coords)[:, :2], outer[:1])]
    return np.concatenate([outer, *holes])


def walls(building: Building) -> list[FloatArray]:
    """Return wall rectangles and roof of a prism as polygons (n, 3)."""
    base, top = building.base_m, building.base_m + building.height_m
    result = []
    for ring in (building.footprint.exterior, *building.footprint.interiors):
        corners = np.asarray(ring.coords)[:, :2]
        for (e0, n0), (e1, n1) in pairwise(corners):
            result.append(np.array([[e0, n0, base], [e1, n1, base], [e1, n1, top], [e0, n0, top]]))
    result.append(at_height(outline(building.footprint), top))
    return result


def listed(points: Any) -> Any:
    """Return points as nested lists, rounded to 0.1 m."""
    return np.round(np.asarray(points, dtype=np.float64), 1).tolist()


def at_height(line_m: FloatArray, up_m: float) -> FloatArray:
    """Return a line (n, 2) as a line (n, 3) at a height."""
    return np.column_stack([line_m, np.full(len(line_m), up_m)])


def ends_of_scale(values: FloatArray, most: float) -> list[float]:
    """Return the ends of a colour scale: the 1 % and ``most`` % quantiles of finite values.

    If all values are equal, the ends are half a unit below and above. If there are no values, they are 0 and 1.
    """
    low, high = (float(v) for v in np.percentile(values, [1.0, most])) if len(values) else (0.0, 1.0)
    return [low, high] if high > low else [low - 0.5, low + 0.5]


def packed(value: Any, arrays: PackedArrays) -> Any:
    """Return a chart with its arrays stored in ``arrays`` and replaced by their numbers."""
    if isinstance(value, np.ndarray):
        # 32-bit floats have seven digits, so times beyond 1e5 s would lose hundredths of a second
        return arrays.add(value, "f8" if value.max(initial=0.0) > 1e5 else "f4")
    if isinstance(value, dict):
        return {key: packed(each, arrays) for key, each in value.items()}
    return [packed(each, arrays) for each in value] if isinstance(value, list) else value


def scene(site: Site, most_trees: int = _TREES) -> dict[str, Any]:
    """Return towers, buildings, trees and forests as plain lists, rounded to 0.1 m."""
    trees, pick = site.trees, spread_out(len(site.trees), most_trees)
    columns = ("east_m", "north_m", "ground_m", "height_m", "crown_diameter_m", "crown_base_m")
    return {
        "name": site.name,
        "credit": site.credit if site.mapped else "no map here",
        "towers": [
            {"name": t.name, "at": listed([t.east_m, t.north_m, t.ground_m]), "top": round(float(t.position_m[2]), 2)}
            for t in site.towers.values()
        ],
        "buildings": [[listed(face) for face in walls(b)] for b in drawn_buildings(site)],
        "forests": [listed(outline(f.area)) for f in site.forests],
        "trees": listed(np.column_stack([getattr(trees, c)[pick] for c in columns])) if len(pick) else [],
    }


def plan_of(site: Site) -> dict[str, Any]:
    """Return :func:`scene` for a plan, with roofs of buildings, but without trees."""
    solid = scene(site)
    return {**solid, "trees": [], "buildings": [faces[-1:] for faces in solid["buildings"]]}
