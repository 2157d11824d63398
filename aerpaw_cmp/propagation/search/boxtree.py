"""A tree of boxes over triangles, faces or points, compiled; and what a search asks of it.

Nodes are columns: bounds, the first of two children (or -1), and for leaves the items they hold. Every answer of the
tree is conservative; what decides is computed on the items themselves, in float64.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ...common.units import FloatArray, IntArray
from ..geometry.paths import BoxTree
from ..native.numba_options import kernel, law, part

# Nodes that wait while a tree is walked: twice its depth for 4e9 items.
DEEPEST = 64


def box_tree(lower: FloatArray, upper: FloatArray, leaf: int = 4) -> BoxTree:
    """Tree over boxes (n, 3), halved at the median of their middles along the longest side.

    Parameters
    ----------
    lower, upper : (n, 3)
    leaf : int
        Most items of a leaf.
    """
    lower, upper = np.ascontiguousarray(lower, np.float64), np.ascontiguousarray(upper, np.float64)
    return BoxTree(*_build(lower, upper, leaf))


@kernel
def _build(lower, upper, leaf):  # type: ignore[no-untyped-def]
    n = len(lower)
    # a binary tree of n leaves has 2 n - 1 nodes
    most = max(1, 2 * n)
    low, high = np.empty((most, 3)), np.empty((most, 3))
    child = np.full(most, -1, np.int64)
    start, count = np.zeros(most, np.int64), np.zeros(most, np.int64)
    items = np.arange(n)
    middle = 0.5 * (lower + upper)
    nodes = 1
    start[0], count[0] = 0, n
    todo = np.empty(DEEPEST, np.int64)
    todo[0] = 0
    waiting = 1
    while waiting > 0:
        waiting -= 1
        node = todo[waiting]
        first, many = start[node], count[node]
        for axis in range(3):
            low[node, axis], high[node, axis] = np.inf, -np.inf
            for k in range(first, first + many):
                low[node, axis] = min(low[node, axis], lower[items[k], axis])
                high[node, axis] = max(high[node, axis], upper[items[k], axis])
        # a few items are tested as fast as their boxes
        if many <= leaf:
            continue
        longest, widest = 0, -1.0
        for axis in range(3):
            least, most_ = np.inf, -np.inf
            for k in range(first, first + many):
                value = middle[items[k], axis]
                least, most_ = min(least, value), max(most_, value)
            if most_ - least > widest:
                longest, widest = axis, most_ - least
        mine = items[first : first + many].copy()
        # a full sort, since numba has no partition of indices
        order = np.argsort(middle[mine, longest])
        items[first : first + many] = mine[order]
        half = many // 2
        # the second child stands behind the first
        child[node] = nodes
        start[nodes], count[nodes] = first, half
        start[nodes + 1], count[nodes + 1] = first + half, many - half
        todo[waiting], todo[waiting + 1] = nodes, nodes + 1
        waiting += 2
        nodes += 2
    return (
        low[:nodes].copy(),
        high[:nodes].copy(),
        child[:nodes].copy(),
        start[:nodes].copy(),
        count[:nodes].copy(),
        items,
    )


def next_leaf(
    lower: FloatArray, upper: FloatArray, child: IntArray, todo: IntArray, waiting: int, missed: Any, region: Any
) -> tuple[int, int]:
    """Walk on to the next leaf whose box a region meets.

    Parameters
    ----------
    lower, upper, child
        As of a :class:`BoxTree`; a tuple of all its columns would be counted in and out at every leaf.
    todo : (DEEPEST,) int
        Nodes that wait; at the beginning the root, 0.
    waiting : int
        How many they are.
    missed : function
        ``missed(lower, upper, node, region)``: :func:`box_missed`, or another of this file.
    region : tuple
        As that takes it.

    Returns
    -------
    node, waiting : int
        The leaf, -1 after the last; how many nodes still wait.
    """
    while waiting > 0:
        waiting -= 1
        node = todo[waiting]
        if missed(lower, upper, node, region):
            continue
        if child[node] < 0:
            return node, waiting
        todo[waiting], todo[waiting + 1] = child[node], child[node] + 1
        waiting += 2
    return -1, waiting


law(next_leaf)


def _collected(tree: BoxTree, missed: Any, region: Any, todo: IntArray, hits: IntArray) -> int:
    """Items of the leaves whose box a region meets, into ``hits``; how many."""
    lower, upper, child, start, many, items = tree
    total, todo[0] = 0, 0
    node, waiting = next_leaf(lower, upper, child, todo, 1, missed, region)
    while node >= 0:
        for k in range(start[node], start[node] + many[node]):
            hits[total] = items[k]
            total += 1
        node, waiting = next_leaf(lower, upper, child, todo, waiting, missed, region)
    return total


law(_collected)


@kernel
def overlapping(tree, low, high, hits):  # type: ignore[no-untyped-def]
    """Items whose leaf meets the box ``low``, ``high`` (3,), into ``hits``; how many.

    Parameters
    ----------
    tree : BoxTree
    low, high : (3,)
        Corners of the box [m].
    hits : (items,) int
        Gets the items; has room for all of the tree.

    Returns
    -------
    int
        How many there are.
    """
    return _collected(tree, _apart, (low, high), np.empty(DEEPEST, np.int64), hits)


@kernel
def within_planes(tree, planes, many, todo, hits):  # type: ignore[no-untyped-def]
    """Items whose leaf has a part on the inner side of each of the first ``many`` planes, into ``hits``; how many.

    A plane (4,) is ``a x + b y + c z + d >= 0`` inside.

    Parameters
    ----------
    tree : BoxTree
    planes : (most, 4)
        Normals pointing inwards, and offsets [m].
    many : int
        How many of them count.
    todo : (DEEPEST,) int
        Room for nodes that wait.
    hits
        As of :func:`overlapping`.

    Returns
    -------
    int
    """
    return _collected(tree, _outside, (planes, many), todo, hits)


@part
def _apart(lower, upper, node, box):  # type: ignore[no-untyped-def]
    """Check whether a box of the tree lies apart from another, given by its corners (3,)."""
    # touching counts as overlap: the tree only leaves out
    low, high = box
    for axis in range(3):  # noqa: SIM110 - compiled
        if lower[node, axis] > high[axis] or upper[node, axis] < low[axis]:
            return True
    return False


@kernel
def box_outside(lower, upper, node, planes, many):  # type: ignore[no-untyped-def]
    """Check whether a box lies wholly outside one of the planes.

    Parameters
    ----------
    lower, upper : (nodes, 3)
        Corners of the boxes of a tree [m].
    node : int
        Which box.
    planes : (most, 4)
        Normals pointing inwards, and offsets [m].
    many : int
        How many of them count.

    Returns
    -------
    bool
        False may also be said of a box that only the planes together leave outside.
    """
    for p in range(many):
        a, b, c = planes[p, 0], planes[p, 1], planes[p, 2]
        best = planes[p, 3]
        # the corner farthest along the normal: is even that outside, all of the box is
        best += a * (upper[node, 0] if a > 0.0 else lower[node, 0])
        best += b * (upper[node, 1] if b > 0.0 else lower[node, 1])
        best += c * (upper[node, 2] if c > 0.0 else lower[node, 2])
        if best < 0.0:
            return True
    return False


@part
def _outside(lower, upper, node, within):  # type: ignore[no-untyped-def]
    return box_outside(lower, upper, node, within[0], within[1])


@part
def box_missed(lower, upper, node, segment):  # type: ignore[no-untyped-def]
    """Check whether a segment misses a box.

    Parameters
    ----------
    lower, upper, node
        As for :func:`box_outside`.
    segment : ((3,), (3,))
        Start [m], and one over each component of its vector [1/m]; 1e300 where that is 0.

    Returns
    -------
    bool
    """
    a, inverse = segment
    # shares of the way, so nothing behind the start or beyond the end is met
    enter, leave = 0.0, 1.0
    for axis in range(3):
        at_lower = (lower[node, axis] - a[axis]) * inverse[axis]
        at_upper = (upper[node, axis] - a[axis]) * inverse[axis]
        if at_lower > at_upper:
            at_lower, at_upper = at_upper, at_lower
        # rounding must not lose a box that is only just met
        enter = max(enter, at_lower - 1e-12 * abs(at_lower))
        leave = min(leave, at_upper + 1e-12 * abs(at_upper))
    return enter > leave
