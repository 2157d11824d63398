"""Trees: seeded random placement in forests, sizes, single trees.

A tree is the paper's (arXiv 2502.10324, section V): a trunk cylinder with a cone of vegetation on it, 20 m high and
10 m across at its widest. The paper does not print the height of the crown's base; a quarter of the height is
assumed here.
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

# Of one forest.
_MAXIMUM_TREES = 2_000_000

_STALLED_ROUNDS = 12  # batches of darts in a row that add less than a thousandth: the forest is full


# Beyond the tallest, widest and thickest trees on Earth [m]: larger sizes are feet or centimetres.
TALLEST_TREE_M = 120.0
WIDEST_CROWN_M = 90.0
THICKEST_TRUNK_M = 15.0

TreeHeight = Annotated[float, Field(gt=0, le=TALLEST_TREE_M)]
CrownDiameter = Annotated[float, Field(gt=0, le=WIDEST_CROWN_M)]
TrunkDiameter = Annotated[float, Field(gt=0, le=THICKEST_TRUNK_M)]


class TreeSizes(StrictModel):
    """Sizes of trees; the crown's base lies at a share of the height."""

    height_m: TreeHeight = 20.0
    crown_diameter_m: CrownDiameter = 10.0
    trunk_diameter_m: TrunkDiameter = 0.4
    crown_base_fraction: Annotated[float, Field(ge=0, lt=1)] = 0.25


PAPER_SIZES = TreeSizes()


def trees_at(east_m: FloatArray, north_m: FloatArray, sizes: TreeSizes) -> Trees:
    """Trees of one size at given points (n,) [m].

    Parameters
    ----------
    east_m, north_m : (n,)
        Trunks [m].
    sizes : TreeSizes

    Returns
    -------
    Trees
        Of n trees.
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
    """All trees of several sets, in order."""
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
    """Trees at random places of a forest, no two closer than its minimum spacing.

    Parameters
    ----------
    forest : Forest
        ``trees_per_hectare`` times the free area is the wanted number.
    sizes : TreeSizes, optional
        The paper's tree by default.
    seed : int
        Same seed and forest, same trees; forests do not influence each other.
    keep_clear : shapely geometry, optional
        No trunk stands in it (buildings, masts).

    Returns
    -------
    Trees
        Fewer than wanted when they do not fit (see :func:`wanted_trees`).

    Notes
    -----
    Darts are thrown in batches. Of two darts that are too close the earlier stays, as if they had been thrown one
    by one (random sequential addition), but whole batches are decided at once.
    """
    area = forest.area if keep_clear is None else shapely.difference(forest.area, keep_clear)
    # of the name, not of the order: a forest that is added leaves the others' trees where they are
    random = np.random.default_rng([seed, zlib.crc32(forest.name.encode())])
    points = _scatter(area, wanted_trees(forest, keep_clear), forest.minimum_spacing_m, random)
    return trees_at(points[:, 0], points[:, 1], sizes)


def wanted_trees(forest: Forest, keep_clear: BaseGeometry | None = None) -> int:
    """Number of trees that a forest's density asks for."""
    area = forest.area if keep_clear is None else shapely.difference(forest.area, keep_clear)
    return round(forest.trees_per_hectare * float(area.area) / 10_000.0)


def _scatter(area: BaseGeometry, count: int, spacing_m: float, random: np.random.Generator) -> FloatArray:
    """Up to ``wanted`` random points (n, 2) in an area, at least ``spacing_m`` apart."""
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
    # of the bounding box: so many darts are thrown that about enough hit
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
        # random packing ends near half of the area: the last trees would take for ever
        stalled = stalled + 1 if len(added) < 1e-3 * count else 0
        placed = np.concatenate([placed, added])
    return placed


def _first_come(points: FloatArray, spacing_m: float) -> BoolArray:
    """Mask of the points (n, 2) that stay when each is refused by any earlier kept one closer than ``spacing_m``."""
    keep = np.zeros(len(points), dtype=bool)
    open_ = np.ones(len(points), dtype=bool)
    # strictly closer: two trees at exactly the spacing both stand
    pairs = cKDTree(points).query_pairs(np.nextafter(spacing_m, 0), output_type="ndarray") if len(points) else None
    if pairs is None or not len(pairs):
        return open_
    early, late = pairs.min(axis=1), pairs.max(axis=1)
    while open_.any():
        waiting = np.zeros(len(points), dtype=bool)
        live = open_[early] & open_[late]
        early, late = early[live], late[live]
        waiting[late] = True
        chosen = open_ & ~waiting  # nothing earlier is still undecided nearby
        keep |= chosen
        open_ &= ~chosen
        open_[late[chosen[early]]] = False
    return keep
