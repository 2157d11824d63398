"""Choice of the samples that an interpolator may use: the M nearest within a radius, or M at random within it.

The tie rule. Distances that agree to a micrometre are tied. Tied samples are taken by their offset from the
target: lower first, then southern first, then western first. On a regular grid the rule gives every inner
target the same pattern of neighbours, and it does not depend on the order in which samples were given (only samples
at the same place are taken in that order).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np

from ..common.units import BoolArray, FloatArray, IntArray

# Targets per query; bounds the memory.
CHUNK = 4096

# Targets per query of all samples within a radius; bounds the memory and does not change a random draw.
AT_ONCE = 256

# Distances closer than this are tied; a sample closer than this to a target is at its place.
TIE_M = 1e-6


@dataclass(frozen=True, slots=True)
class Neighbours:
    """Chosen samples of each target, in the order of the tie rule (random choice: by index).

    Parameters
    ----------
    index : (targets, M) int
        Sample numbers, -1 past the last one.
    distance_m : (targets, M)
        Infinite past the last one.
    """

    index: IntArray
    distance_m: FloatArray

    @property
    def count(self) -> IntArray:
        """Number of samples of each target (targets,)."""
        return np.asarray((self.index >= 0).sum(axis=1), dtype=np.int64)


def nearest(
    samples_m: FloatArray, targets_m: FloatArray, m: int, radius_m: float, skip: IntArray | None = None
) -> Neighbours:
    """The M nearest samples within the radius (inclusive, to the micrometre), ties by the rule above.

    Parameters
    ----------
    samples_m : (samples, dims)
        At distinct places, in a metric frame (anisotropy already applied).
    targets_m : (targets, dims)
        The same frame.
    m : int
        Largest number of samples per target.
    radius_m : float
        May be infinite.
    skip : (targets,) int, optional
        One sample per target that does not count (leave-one-out); -1 for none.

    Returns
    -------
    Neighbours
    """
    from scipy.spatial import cKDTree

    chosen = Neighbours(np.full((len(targets_m), m), -1, dtype=np.int64), np.full((len(targets_m), m), np.inf))
    if len(samples_m) == 0 or len(targets_m) == 0:
        return chosen
    tree = cKDTree(samples_m)
    # one more than wanted: only its distance tells whether a tie goes on beyond the last
    least = m + 1 + (skip is not None)
    candidates = least
    order = in_strips(targets_m, CHUNK)
    for start in range(0, len(targets_m), CHUNK):
        part = order[start : start + CHUNK]
        todo = _fill_nearest(tree, targets_m, part, radius_m, skip, candidates, chosen)
        # scattered samples have no ties; on the paper's grid a ring of equal distance holds up to 12 cells
        candidates = m + 13 if len(todo) > len(part) // 4 else least
        ask = m + 13
        while len(todo):
            todo = _fill_nearest(tree, targets_m, todo, radius_m, skip, ask, chosen)
            ask *= 2
    return chosen


class Rule(Protocol):
    """Settings of a predictor that decide which samples a target has."""

    neighbours: int
    radius_m: float
    selection: Literal["nearest", "random"]
    seed: int


def by_rule(rule: Rule, samples_m: FloatArray, targets_m: FloatArray, skip: IntArray | None = None) -> Neighbours:
    """The samples of each target that a predictor uses: its nearest ones, or some at random.

    Parameters
    ----------
    rule : Rule
    samples_m, targets_m, skip
        As for :func:`nearest`.

    Returns
    -------
    Neighbours
    """
    if rule.selection == "random":
        return _random_within(rule, samples_m, targets_m, skip)
    return nearest(samples_m, targets_m, rule.neighbours, rule.radius_m, skip)


def renumbered(taken: BoolArray) -> IntArray:
    """Number of each sample among those of a mask (samples,); -1 of the others."""
    return np.where(taken, np.cumsum(taken) - 1, -1)


def in_strips(places_m: FloatArray, together: int) -> IntArray:
    """Order of places in which ``together`` of them in a row fill a square: strips from south to north."""
    if not len(places_m):
        return np.empty(0, dtype=np.int64)
    east, north = (places_m - places_m.min(axis=0)).T[:2]
    width = max(float(np.sqrt(east.max() * north.max() * together / len(places_m))), TIE_M)
    return np.argsort(np.floor(north / width) * (east.max() + TIE_M) + east)


def _fill_nearest(
    tree: Any,
    targets_m: FloatArray,
    todo: IntArray,
    radius_m: float,
    skip: IntArray | None,
    candidates: int,
    chosen: Neighbours,
) -> IntArray:
    """Fill the rows ``todo`` from so many ``candidates``; the rows for which a tie reaches the last candidate."""
    samples_m, m = tree.data, chosen.index.shape[1]
    candidates = min(candidates, len(samples_m))
    # a list of ranks, for a plain 1 would drop an axis; the bound itself would be left out by the tree
    distance, who = tree.query(targets_m[todo], k=np.arange(1, candidates + 1), distance_upper_bound=radius_m + TIE_M)
    last = _in_micrometres(distance[:, -1])
    exhausted = (candidates == len(samples_m)) | ~np.isfinite(last)
    if skip is not None:
        # asked for and taken out, for a tree without it would have to be built for every target
        excluded = who == skip[todo, None]
        distance[excluded] = np.inf
        # the sample left out goes to the end, the order of the others stays
        order = np.argsort(excluded, axis=1, kind="stable")
        distance, who = np.take_along_axis(distance, order, axis=1), np.take_along_axis(who, order, axis=1)
    ring = _in_micrometres(distance)
    tied = (ring[:, 1:] == ring[:, :-1]) & np.isfinite(ring[:, 1:])
    rows = np.flatnonzero(tied.any(axis=1))
    if len(rows):
        # where there is no further neighbour the tree answers with the number of samples, which is no row
        numbers = np.where(np.isfinite(distance[rows]), who[rows], 0)
        order = _tie_order(distance[rows], numbers, samples_m, targets_m[todo[rows]])
        distance[rows], who[rows] = (np.take_along_axis(a[rows], order, axis=1) for a in (distance, who))
    complete = exhausted | (_in_micrometres(distance[:, m - 1]) < last) if candidates >= m else exhausted
    width = min(m, candidates)
    filled = todo[complete]
    chosen.index[filled, :width] = np.where(np.isfinite(distance[:, :width]), who[:, :width], -1)[complete]
    chosen.distance_m[filled, :width] = distance[complete, :width]
    return todo[~complete]


def _in_micrometres(distance_m: FloatArray) -> FloatArray:
    return np.round(distance_m / TIE_M)


def _tie_order(distance: FloatArray, who: IntArray, samples_m: FloatArray, targets_m: FloatArray) -> IntArray:
    """Order of candidates by distance, then offset (up, north, east), then number."""
    offset = _in_micrometres(samples_m[who] - targets_m[:, None, :])
    keys = [offset[:, :, axis] for axis in range(offset.shape[2])]
    return np.lexsort((who, *keys, _in_micrometres(distance)), axis=-1)


def _random_within(rule: Rule, samples_m: FloatArray, targets_m: FloatArray, skip: IntArray | None) -> Neighbours:
    """M samples drawn without replacement among those within the radius, as the paper's Step 1 may be read."""
    from scipy.spatial import cKDTree

    m, radius_m = rule.neighbours, rule.radius_m
    index = np.full((len(targets_m), m), -1, dtype=np.int64)
    distance = np.full((len(targets_m), m), np.inf)
    if len(samples_m) == 0:
        return Neighbours(index, distance)
    generator = np.random.default_rng(rule.seed)
    tree = cKDTree(samples_m)
    for start in range(0, len(targets_m), AT_ONCE):
        part = slice(start, start + AT_ONCE)
        pairs = cKDTree(targets_m[part]).sparse_distance_matrix(tree, radius_m + TIE_M, output_type="ndarray")
        # the tree's own order may change with its version, and a draw must not
        pairs = pairs[np.lexsort((pairs["j"], pairs["i"]))]
        target, sample, far = pairs["i"], pairs["j"], pairs["v"]
        # one number per pair in a fixed order: the stream does not depend on the chunk
        draw = generator.random(len(pairs))
        if skip is not None:
            keep = sample != skip[part][target]
            target, sample, far, draw = target[keep], sample[keep], far[keep], draw[keep]
        order = np.lexsort((draw, target))
        target, sample, far = target[order], sample[order], far[order]
        # the place of each pair in the run of its target
        rank = np.arange(len(target)) - np.searchsorted(target, target)
        drawn = rank < m
        index[start + target[drawn], rank[drawn]] = sample[drawn]
        distance[start + target[drawn], rank[drawn]] = far[drawn]
    return Neighbours(index, distance)
