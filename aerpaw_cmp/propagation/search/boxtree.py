"""A tree of boxes over triangles, faces or points, compiled; and what a search asks of it.

Nodes are columns: bounds, the first of two children (or -1), and for leaves the items they hold. Every answer of the
tree is conservative; what decides is computed on the items themselves, in float64.
"""

from __future__ import annotations

import numpy as np

from ...common.units import FloatArray
from ..numba_options import kernel
from ..surfaces import BoxTree

DEEPEST = 64
"""Nodes that wait while a tree is walked: twice its depth for 4e9 items."""


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
        order = np.argsort(middle[mine, longest])
        items[first : first + many] = mine[order]
        half = many // 2
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


@kernel
def _opened(tree, node, todo, waiting, hits, total):  # type: ignore[no-untyped-def]
    """The children of a node join the nodes that wait, the items of a leaf those found; how many both are then."""
    _, _, child, start, count, items = tree
    if child[node] >= 0:
        todo[waiting], todo[waiting + 1] = child[node], child[node] + 1
        return waiting + 2, total
    for k in range(start[node], start[node] + count[node]):
        hits[total] = items[k]
        total += 1
    return waiting, total


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
    lower, upper = tree[0], tree[1]
    todo = np.empty(DEEPEST, np.int64)
    todo[0] = 0
    waiting, total = 1, 0
    while waiting > 0:
        waiting -= 1
        node = todo[waiting]
        out = False
        for axis in range(3):
            if lower[node, axis] > high[axis] or upper[node, axis] < low[axis]:
                out = True
        if out:
            continue
        waiting, total = _opened(tree, node, todo, waiting, hits, total)
    return total


@kernel
def within_planes(tree, planes, many, hits):  # type: ignore[no-untyped-def]
    """Items whose leaf has a part on the inner side of each of the first ``many`` planes, into ``hits``; how many.

    A plane (4,) is ``a x + b y + c z + d >= 0`` inside.

    Parameters
    ----------
    tree : BoxTree
    planes : (most, 4)
        Normals pointing inwards, and offsets [m].
    many : int
        How many of them count.
    hits : (items,) int
        Gets the items; has room for all of the tree.

    Returns
    -------
    int
        How many there are.
    """
    lower, upper = tree[0], tree[1]
    todo = np.empty(DEEPEST, np.int64)
    todo[0] = 0
    waiting, total = 1, 0
    while waiting > 0:
        waiting -= 1
        node = todo[waiting]
        if box_outside(lower, upper, node, planes, many):
            continue
        waiting, total = _opened(tree, node, todo, waiting, hits, total)
    return total


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
        best += a * (upper[node, 0] if a > 0.0 else lower[node, 0])
        best += b * (upper[node, 1] if b > 0.0 else lower[node, 1])
        best += c * (upper[node, 2] if c > 0.0 else lower[node, 2])
        if best < 0.0:
            return True
    return False


@kernel
def box_missed(lower, upper, node, a, inverse):  # type: ignore[no-untyped-def]
    """Check whether the segment from ``a`` with the component-wise ``inverse`` of its direction misses a box.

    Parameters
    ----------
    lower, upper : (nodes, 3)
        Corners of the boxes of a tree [m].
    node : int
        Which box.
    a : (3,)
        Start of the segment [m].
    inverse : (3,)
        One over each component of its vector [1/m]; 1e300 where that is 0.

    Returns
    -------
    bool
    """
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
