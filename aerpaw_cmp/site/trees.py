"""Trees: random placement in forests with a seed, sizes, and single trees.

Trees are those of the paper (arXiv 2502.10324, section V): a trunk cylinder below a cone of vegetation, 20 m high and
10 m wide. The paper does not print the height of the base of the crown, which is assumed to be a quarter of the height.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import fields
from typing import Annotated

import numpy as np
import shapely
from pydantic import Field
from scipy.spatial import cKDTree
from shapely.geometry.base import BaseGeometry

from ..common.errors import UsageError
from ..common.units import BoolArray, FloatArray
from ..common.yamlfile import StrictModel
from .site import Forest, Trees

# Largest number of trees of a forest.
_MAXIMUM_TREES = 2_000_000

_STALLED_ROUNDS = 12  # consecutive batches that add less than a thousandth, after which the forest is full


# Larger than the tallest, widest and thickest trees on Earth [m], so larger sizes are feet or centimetres.
TALLEST_TREE_M = 120.0
WIDEST_CROWN_M = 90.0
THICKEST_TRUNK_M = 15.0

TreeHeight = Annotated[float, Field(gt=0, le=TALLEST_TREE_M)]
CrownDiameter = Annotated[float, Field(gt=0, le=WIDEST_CROWN_M)]
TrunkDiameter = Annotated[float, Field(gt=0, le=THICKEST_TRUNK_M)]


class TreeSizes(StrictModel):
    """The sizes of trees. The base of the crown is at a share of the height."""

    height_m: TreeHeight = 20.0
    crown_diameter_m: CrownDiameter = 10.0
    trunk_diameter_m: TrunkDiameter = 0.4
    crown_base_fraction: Annotated[float, Field(ge=0, lt=1)] = 0.25


PAPER_SIZES = TreeSizes()


def trees_at(east_m: FloatArray, north_m: FloatArray, sizes: TreeSizes) -> Trees:
    """Return trees of one size at given points (n,) [m].

    Parameters
    ----------
    east_m, north_m : (n,)
        Positions of the trunks [m].
    sizes : TreeSizes

    Returns
    -------
    Trees
        The n trees.
    """
    count = len(east_m)
    return Trees(
        east_m=east_m,
        north_m=north_m,
        ground_m=np.zeros(count),
        height_m=np.full(count, sizes.height_m),
        crown_diameter_m=np.full(count, sizes.crown_diameter_m),
        crown_base_m=np.full(count, sizes.height_m * sizes.crown_base_fraction),
        trunk_diameter_m=np.full(count, sizes.trunk_diameter_m),
    )


def join_trees(parts: Sequence[Trees]) -> Trees:
    """Return all trees of several sets, in order."""
    if not parts:
        return Trees.none()
    return Trees(**{f.name: np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(Trees)})


def place_trees(
    forest: Forest,
    sizes: TreeSizes = PAPER_SIZES,
    *,
    seed: int = 0,
    keep_clear: BaseGeometry | None = None,
) -> Trees:
    """Return trees at random positions in a forest, with at least its minimum spacing.

    Parameters
    ----------
    forest : Forest
        The number of trees is ``trees_per_hectare`` times the free area.
    sizes : TreeSizes, optional
        Sizes of the trees; those of the paper by default.
    seed : int
        The same seed and forest have the same trees. Forests do not affect each other.
    keep_clear : shapely geometry, optional
        Area without trunks (buildings, masts).

    Returns
    -------
    Trees
        The trees, which are fewer if they do not fit (see :func:`wanted_trees`).

    Notes
    -----
    Random positions are drawn in batches. Of two positions that are too close the earlier one is used, as in random
    sequential addition, but complete batches are decided at once.
    """
    area = forest.area if keep_clear is None else shapely.difference(forest.area, keep_clear)
    # the seed uses the name, not the order, so that an added forest does not move the trees of others
    random = np.random.default_rng([seed, zlib.crc32(forest.name.encode())])
    points = _scatter(area, wanted_trees(forest, keep_clear), forest.minimum_spacing_m, random)
    return trees_at(points[:, 0], points[:, 1], sizes)


def wanted_trees(forest: Forest, keep_clear: BaseGeometry | None = None) -> int:
    """Return the number of trees for the density of a forest."""
    area = forest.area if keep_clear is None else shapely.difference(forest.area, keep_clear)
    return round(forest.trees_per_hectare * float(area.area) / 10_000.0)


def _scatter(area: BaseGeometry, count: int, spacing_m: float, random: np.random.Generator) -> FloatArray:
    """Return at most ``count`` random points in an area, at least ``spacing_m`` apart, shape (n, 2)."""
    placed = np.zeros((0, 2))
    if count <= 0 or area.is_empty:
        return placed
    if count > _MAXIMUM_TREES:
        raise UsageError(
            f"a forest of {area.area / 1e4:.0f} ha asks for {count} trees",
            expected=f"at most {_MAXIMUM_TREES}",
            cause="trees_per_hectare is too high, or the outline reaches far outside the site",
        )
    shapely.prepare(area)
    east_min, north_min, east_max, north_max = area.bounds
    low, span = np.array([east_min, north_min]), np.array([east_max - east_min, north_max - north_min])
    # draw enough positions in the bounding box that about the required number is in the area
    share = area.area / max(float(span.prod()), 1e-300)
    stalled = 0
    while len(placed) < count and stalled < _STALLED_ROUNDS:
        missing = count - len(placed)
        darts = low + span * random.random((min(int(1.5 * missing / share) + 16, 2_000_000), 2))
        darts = darts[shapely.contains_xy(area, darts[:, 0], darts[:, 1])]
        if spacing_m > 0:
            if len(placed):
                darts = darts[cKDTree(placed).query(darts, distance_upper_bound=spacing_m)[0] >= spacing_m]
            darts = darts[_first_come(darts, spacing_m)]
        added = darts[:missing]
        # random packing ends near half of the area, so the last trees would take very long
        stalled = stalled + 1 if len(added) < 1e-3 * count else 0
        placed = np.concatenate([placed, added])
    return placed


def _first_come(points: FloatArray, spacing_m: float) -> BoolArray:
    """Return a mask of points (n, 2) that have no earlier selected point closer than ``spacing_m``."""
    keep = np.zeros(len(points), dtype=bool)
    open_ = np.ones(len(points), dtype=bool)
    # strictly closer, because two trees at exactly the spacing are allowed
    pairs = cKDTree(points).query_pairs(np.nextafter(spacing_m, 0), output_type="ndarray") if len(points) else None
    if pairs is None or not len(pairs):
        return open_
    early, late = pairs.min(axis=1), pairs.max(axis=1)
    while open_.any():
        waiting = np.zeros(len(points), dtype=bool)
        live = open_[early] & open_[late]
        early, late = early[live], late[live]
        waiting[late] = True
        chosen = open_ & ~waiting  # no earlier point nearby is undecided
        keep |= chosen
        open_ &= ~chosen
        open_[late[chosen[early]]] = False
    return keep
