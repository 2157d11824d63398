"""Outlines and walls of a site as points, for every view of it."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import shapely
from shapely import Polygon

from ...common.units import FloatArray
from ...site.site import Building


def outline(area: Polygon) -> FloatArray:
    """Corners (n, 2) of an area as one line that also runs round its holes, so that filling it leaves them empty."""
    area = shapely.orient_polygons(area)
    outer = np.asarray(area.exterior.coords)[:, :2]
    holes = [part for ring in area.interiors for part in (np.asarray(ring.coords)[:, :2], outer[:1])]
    return np.concatenate([outer, *holes])


def walls(building: Building) -> list[FloatArray]:
    """Wall rectangles and roof of a prism as polygons (n, 3)."""
    base, top = building.base_m, building.base_m + building.height_m
    result = []
    for ring in (building.footprint.exterior, *building.footprint.interiors):
        corners = np.asarray(ring.coords)[:, :2]
        for (e0, n0), (e1, n1) in pairwise(corners):
            result.append(np.array([[e0, n0, base], [e1, n1, base], [e1, n1, top], [e0, n0, top]]))
    result.append(at_height(outline(building.footprint), top))
    return result


def listed(points: Any) -> Any:
    """Points as nested lists, rounded to 0.1 m."""
    return np.round(np.asarray(points, dtype=np.float64), 1).tolist()


def at_height(line_m: FloatArray, up_m: float) -> FloatArray:
    """A line (n, 2) in the plane at a height, (n, 3)."""
    return np.column_stack([line_m, np.full(len(line_m), up_m)])
