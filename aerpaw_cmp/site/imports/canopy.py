"""Stands and single trees from a canopy-height raster; heights of buildings from a surface model."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from scipy import ndimage
from shapely.geometry import Polygon

from ...common.errors import InputError, about_file
from ...common.geodesy import SiteFrame
from ...common.units import FloatArray
from ..relief.dem import Dem, read_dem
from ..site import Forest
from ..siteyaml import SiteModel
from .footprints import SingleTree, only_trees, outline_dict

# Lower vegetation is none; nothing grows higher.
LOWEST_M, HIGHEST_M = 3.0, 120.0

# Smaller areas are single trees; smaller still, nothing.
_SMALLEST_STAND_M2, _SMALLEST_CROWN_M2 = 200.0, 2.0

# Distances from a wall between which a surface model shows the ground.
_RING_M = (2.0, 12.0)


def with_canopy(model: SiteModel, path: Path) -> tuple[SiteModel, list[str]]:
    """A site with the stands and trees of a canopy-height model in place of all others, and what was done.

    Raises
    ------
    InputError
        Unreadable file, heights below the ground or above any tree.
    """
    content = model.model_dump()
    with about_file(path):
        forests, trees, actions = canopy_of(read_dem(path, _frame(model), anchored=False))
    content["forests"] = [{**outline_dict(f.name, f.area), "height_m": f.height_m} for f in forests]
    content["trees"] |= only_trees(trees)
    return SiteModel.model_validate(content), actions


def with_heights(model: SiteModel, path: Path) -> tuple[SiteModel, list[str]]:
    """A site with heights of buildings from a surface model, and what was done.

    A building that the model does not raise by a metre keeps its height.
    """
    content, frame = model.model_dump(), _frame(model)
    surface = read_dem(path, frame, anchored=False)
    heights = building_heights(surface, [building.polygon(frame) for building in model.buildings])
    for building, height in zip(content["buildings"], heights.tolist(), strict=True):
        building["height_m"] = round(height, 1) if height >= 1.0 else building["height_m"]
    flat = [b.name for b, height in zip(model.buildings, heights.tolist(), strict=True) if not height >= 1.0]
    actions = [f"surface model: heights of {len(heights) - len(flat)} of {len(heights)} buildings"]
    if flat:
        actions.append(f"warning: the surface model shows no roof on {', '.join(flat)}: the heights of the map stay")
    return SiteModel.model_validate(content), actions


def _frame(model: SiteModel) -> SiteFrame:
    return SiteFrame(model.origin.latitude_deg, model.origin.longitude_deg)


def canopy_of(chm: Dem) -> tuple[list[Forest], list[SingleTree], list[str]]:
    """Stands and trees of a canopy-height raster.

    Parameters
    ----------
    chm : Dem
        Heights above the ground [m].

    Returns
    -------
    forests : list of Forest
        Connected canopy from 3 m up, with its mean height.
    trees : list of SingleTree
        Areas below 200 m^2, with their largest height.
    actions : list of str

    Raises
    ------
    InputError
        Heights below the ground or above any tree.
    """
    _check(chm.height_m)
    label, count = ndimage.label(chm.height_m >= LOWEST_M)
    forests: list[Forest] = []
    trees: list[SingleTree] = []
    for number, part in enumerate(ndimage.find_objects(label), start=1):
        mine, height = label[part] == number, chm.height_m[part]
        corner = np.array([part[1].start, part[0].start])
        polygons = _outlines(chm, mine, corner)
        area = sum(polygon.area for polygon in polygons)
        if area >= _SMALLEST_STAND_M2:
            tall = round(float(height[mine].mean()), 1)
            forests += [Forest(f"stand {len(forests) + k + 1}", p, height_m=tall) for k, p in enumerate(polygons)]
        elif area >= _SMALLEST_CROWN_M2:
            row, column = (at.mean() for at in np.nonzero(mine))
            east, north = chm.place(column + corner[0], row + corner[1])
            width = 2.0 * float(np.sqrt(area / np.pi))
            trees.append(SingleTree(float(east), float(north), float(height[mine].max()), width))
    what = f"{len(forests)} stands and {len(trees)} single trees of {count} areas from {LOWEST_M:g} m up"
    return forests, trees, [f"canopy: {what}"]


def _check(height_m: FloatArray) -> None:
    low, high = np.nanmin(height_m), np.nanmax(height_m)
    if low < -0.5:
        raise InputError(
            f"a canopy height of {low:.1f} m",
            expected="0 m or more",
            cause="a canopy below the ground: a surface model less another terrain, or an undeclared NODATA value",
        )
    if high > HIGHEST_M:
        raise InputError(
            f"a canopy height of {high:.1f} m",
            expected=f"at most {HIGHEST_M:g} m",
            cause="heights above the sea: a surface model, not a canopy-height model",
        )


def _outlines(chm: Dem, mine: Any, corner: FloatArray) -> list[Polygon]:
    """Outlines in the site frame of connected cells (rows, columns), simplified to three quarters of a cell."""
    step = np.diff(np.pad(mine, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    row, start = np.nonzero(step == 1)
    stop = np.nonzero(step == -1)[1]
    cells = shapely.union_all(shapely.box(start - 0.5, row - 0.5, stop - 0.5, row + 0.5))

    def placed(points: FloatArray) -> FloatArray:
        return np.stack(chm.place(*(points + corner).T), axis=1)

    parts = shapely.get_parts(shapely.transform(shapely.simplify(cells, 0.75), placed))
    return [part for part in parts if part.geom_type == "Polygon" and part.area > 0.0]


def building_heights(surface: Dem, footprints: Sequence[Polygon]) -> FloatArray:
    """Heights of buildings (footprints,) above the ground around them [m].

    Parameters
    ----------
    surface : Dem
        Heights of roofs and ground, in any reference.
    footprints : sequence of Polygon
        In the site frame [m].

    Returns
    -------
    (footprints,)
        Median over the roof less the 10th percentile around it; NaN where the model does not reach.
    """
    measured = shapely.union_all(list(footprints))
    heights = np.full(len(footprints), np.nan)
    for number, footprint in enumerate(footprints):
        ring = footprint.buffer(_RING_M[1]).difference(footprint.buffer(_RING_M[0])).difference(measured)
        roof, ground = (_sampled(surface, shape) for shape in (footprint, ring))
        if len(roof) and len(ground):
            heights[number] = np.median(roof) - np.percentile(ground, 10)
    return heights


def _sampled(surface: Dem, shape: Polygon) -> FloatArray:
    """Known heights within a shape, one per half cell."""
    low_e, low_n, high_e, high_n = shape.bounds
    step = surface.cell_m / 2
    east, north = np.meshgrid(np.arange(low_e, high_e, step), np.arange(low_n, high_n, step))
    inside = shapely.contains_xy(shape, east, north)
    height = surface.absolute_m(east[inside], north[inside])
    return np.asarray(height[np.isfinite(height)])
