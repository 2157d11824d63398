"""Passes over the same places: what two differ by, and every pair of a season at once.

Of 200 flights with ten links there are 199 000 pairs, so each flight's places are put into one k-d tree, pairs of
flights whose boxes lie apart are not searched, links that were sampled together share one search, and intervals come
in closed form.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache
from itertools import combinations, product
from typing import Any

import numpy as np

from ...common.units import BoolArray, FloatArray, IntArray, wrap_degrees
from .intervals import Interval, correlation, spread_interval

# Samples of two passes nearer than this were taken at the same place.
SAME_PLACE_M = 2.0

# Largest difference of the headings of such samples, where headings count.
_HEADING_WITHIN_DEG = 20.0


@dataclass(frozen=True, slots=True)
class Visit:
    """One pass by itself: places (n, 3) [m], values (n,), NaN where there is none, headings (n,) where they count."""

    position_m: FloatArray
    value: FloatArray
    heading_deg: FloatArray | None = None

    @property
    def places(self) -> _Places:
        """Of the samples that have a place and a value."""
        known = np.isfinite(self.position_m).all(axis=1) & np.isfinite(self.value)
        return _Places(self.position_m, self.heading_deg, np.flatnonzero(known))


def same_places(first: Visit, second: Visit, radius_m: float = SAME_PLACE_M) -> tuple[IntArray, IntArray]:
    """Indices into both passes: samples with a value, and the nearest ones of the other pass within a radius [m]."""
    return first.places.partners(second.places, radius_m, _HEADING_WITHIN_DEG)


@dataclass(frozen=True, slots=True, kw_only=True)
class Pass:
    """One flight on one link.

    Parameters
    ----------
    flight, link : str
        Passes of one link and of two flights are compared.
    position_m : ndarray, (n, 3)
        East, north, up; rows with NaN pair with nothing.
    level_db, residual_db : ndarray, (n,)
        Measurement, and measurement minus simulation; NaN where there is none.
    heading_deg : ndarray, (n,), optional
        Clockwise from north.
    """

    flight: str
    link: str
    position_m: FloatArray = field(repr=False)
    level_db: FloatArray = field(repr=False)
    residual_db: FloatArray = field(repr=False)
    heading_deg: FloatArray | None = field(repr=False, default=None)


@dataclass(frozen=True, slots=True, kw_only=True)
class PassPair:
    """Two passes of one link; ``first`` and ``second`` count the passes as they were given.

    Parameters
    ----------
    n : int
        Samples of the first pass that have a partner.
    rmse_db, offset_db : float
        Standard deviation and mean of second minus first; NaN without a pair.
    rmse_ci95_db : (low, high)
        Of the RMSE (:func:`spread_interval`).
    residual_rmse_db : float
        The same of the residuals.
    place_rmse_db, place_correlation, height_difference_m : float
        Of the mean residuals, and the median difference of the mean heights, over the cells that both have.
    cells : int
        Those cells.
    """

    first: int
    second: int
    n: int
    rmse_db: float
    offset_db: float
    rmse_ci95_db: Interval
    residual_rmse_db: float
    place_rmse_db: float
    place_correlation: float
    cells: int
    height_difference_m: float


# --- every pair -----------------------------------------------------------------------------------------------------


class _Places:
    """Samples that have a place and a value, their tree and their box; ``where`` are their numbers in the pass."""

    def __init__(self, position_m: FloatArray, heading_deg: FloatArray | None, where: IntArray) -> None:
        self.where = where
        self.position_m = np.ascontiguousarray(position_m[where])
        self.heading_deg = None if heading_deg is None else heading_deg[where]
        empty = not len(where)
        self.low = np.full(3, np.inf) if empty else self.position_m.min(axis=0)
        self.high = np.full(3, -np.inf) if empty else self.position_m.max(axis=0)
        self._tree: Any = None

    @property
    def tree(self) -> Any:
        if self._tree is None:
            from scipy.spatial import cKDTree

            self._tree = cKDTree(self.position_m)
        return self._tree

    def partners(self, other: _Places, radius_m: float, within_deg: float | None) -> tuple[IntArray, IntArray]:
        """Numbers, in both passes, of samples and the nearest ones of the other pass; headings agree."""
        # only what lies in the other's box can pair: most flights of a season end here
        near = np.flatnonzero(
            ((self.position_m >= other.low - radius_m) & (self.position_m <= other.high + radius_m)).all(axis=1)
        )
        if not len(near):
            return near, near
        distance, nearest = other.tree.query(self.position_m[near], distance_upper_bound=radius_m)
        # the tree answers infinity where nothing is near enough
        paired = np.isfinite(distance)
        rows, nearest_rows = near[paired], nearest[paired]
        if within_deg is not None and self.heading_deg is not None and other.heading_deg is not None:
            turn = wrap_degrees(other.heading_deg[nearest_rows] - self.heading_deg[rows])
            same = np.abs(turn) <= within_deg
            rows, nearest_rows = rows[same], nearest_rows[same]
        return self.where[rows], other.where[nearest_rows]


@dataclass(slots=True)
class _Prepared:
    """A pass ready to be paired: places of levels and of residuals (by key), and means by cell."""

    number: int
    flown: Pass
    level: bytes
    residual: bytes
    cells: IntArray
    means: FloatArray
    heights: FloatArray


class PassTable:
    """Passes ready to be paired.

    Parameters
    ----------
    passes : sequence of Pass
    cell_m : float
        Edge of the cells of the plan.
    """

    def __init__(self, passes: Sequence[Pass], cell_m: float) -> None:
        self._places: dict[bytes, _Places] = {}
        # by flight, then by link
        self._flights: dict[str, dict[str, list[_Prepared]]] = {}
        for number, flown in enumerate(passes):
            links = self._flights.setdefault(flown.flight, {})
            links.setdefault(flown.link, []).append(_prepare(number, flown, cell_m, self._places))

    def pairs(self, *, radius_m: float, heading_within_deg: float | None) -> Iterator[PassPair]:
        """Every pair of two flights' passes on one link, by first flight, second flight and link.

        Parameters
        ----------
        radius_m : float
            A sample of the first pass pairs with the nearest one of the second within this distance.
        heading_within_deg : float, optional
            Headings of a pair agree within this, where both passes have headings; None: any heading.

        Yields
        ------
        PassPair
        """
        for first, second in combinations(self._flights.values(), 2):

            @cache  # the searches of a pair of flights are shared by its links, and forgotten after it
            def met(mine: bytes, theirs: bytes) -> tuple[IntArray, IntArray]:
                return self._places[mine].partners(self._places[theirs], radius_m, heading_within_deg)

            shared: dict[tuple[bytes, bytes], tuple[IntArray, IntArray, float]] = {}
            for link, passes in first.items():
                for mine, theirs in product(passes, second.get(link, ())):
                    yield _pair(mine, theirs, met, shared)


def _prepare(number: int, flown: Pass, cell_m: float, places: dict[bytes, _Places]) -> _Prepared:
    placed = np.isfinite(flown.position_m).all(axis=1)
    scored = placed & np.isfinite(flown.residual_db)
    cells, means, heights = cell_means(flown.position_m, flown.residual_db, scored, cell_m)
    return _Prepared(
        number=number,
        flown=flown,
        level=_entered(flown, placed & np.isfinite(flown.level_db), places),
        residual=_entered(flown, scored, places),
        cells=cells,
        means=means,
        heights=heights,
    )


def _entered(flown: Pass, good: BoolArray, places: dict[bytes, _Places]) -> bytes:
    """Key of the places of some samples: links that were sampled together have one."""
    digest = hashlib.blake2b(good.tobytes(), digest_size=16)
    digest.update(np.ascontiguousarray(flown.position_m).tobytes())
    if flown.heading_deg is not None:
        digest.update(np.ascontiguousarray(flown.heading_deg).tobytes())
    # by content: links that were sampled together have equal places in arrays of their own
    key = digest.digest()
    if key not in places:
        places[key] = _Places(flown.position_m, flown.heading_deg, np.flatnonzero(good))
    return key


def cell_means(
    position_m: FloatArray, residual_db: FloatArray, good: BoolArray, cell_m: float
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Squares of the plan that have a sample: (c, 2) numbers east and north in order, mean residual, mean height.

    Parameters
    ----------
    position_m : (n, 3)
    residual_db : (n,)
    good : (n,) bool
        Samples that count.
    cell_m : float
        Side of a square [m].

    Returns
    -------
    cells : (c, 2) int
        Numbers of the squares, east and north, ascending.
    residual_db, height_m : (c,)
        Means over the samples of each square.
    """
    # in the plan: two passes at other heights share their squares
    cells = np.floor(position_m[good, :2] / cell_m).astype(np.int64)
    cell, which = np.unique(cells, axis=0, return_inverse=True)
    # NumPy 2.0 gives it two dimensions
    which = which.reshape(-1)
    count = np.maximum(np.bincount(which, minlength=len(cell)), 1)
    residual = np.bincount(which, weights=residual_db[good], minlength=len(cell)) / count
    height = np.bincount(which, weights=position_m[good, 2], minlength=len(cell)) / count
    return cell, residual, height


def _pair(
    mine: _Prepared,
    theirs: _Prepared,
    met: Callable[[bytes, bytes], tuple[IntArray, IntArray]],
    shared: dict[tuple[bytes, bytes], tuple[IntArray, IntArray, float]],
) -> PassPair:
    """Two passes of a link; ``met`` gives the partners of their places by key, ``shared`` keeps their common cells."""
    i, j = met(mine.level, theirs.level)
    level = theirs.flown.level_db[j] - mine.flown.level_db[i]
    i, j = met(mine.residual, theirs.residual)
    residual = theirs.flown.residual_db[j] - mine.flown.residual_db[i]
    cells = mine.residual, theirs.residual  # the same places, so the same cells and heights
    if cells not in shared:
        i, j = _common(mine.cells, theirs.cells)
        height = float(np.median(theirs.heights[j] - mine.heights[i])) if len(i) else float("nan")
        shared[cells] = i, j, height
    i, j, height = shared[cells]
    change, nan = theirs.means[j] - mine.means[i], float("nan")
    return PassPair(
        first=mine.number,
        second=theirs.number,
        n=len(level),
        rmse_db=float(level.std()) if len(level) else nan,
        offset_db=float(level.mean()) if len(level) else nan,
        rmse_ci95_db=spread_interval(level),
        residual_rmse_db=float(residual.std()) if len(residual) else nan,
        place_rmse_db=float(change.std()) if len(i) else nan,
        place_correlation=correlation(mine.means[i], theirs.means[j]),
        cells=len(i),
        height_difference_m=height,
    )


def _common(first: IntArray, second: IntArray) -> tuple[IntArray, IntArray]:
    """Rows of both that name the same cell, in the order of the cells (both are sorted and have each cell once)."""
    # one integer per cell: numpy intersects rows of two columns by sorting records, ten times slower
    a, b = ((cells[:, 0] << 32) + cells[:, 1] for cells in (first, second))
    _, i, j = np.intersect1d(a, b, assume_unique=True, return_indices=True)
    return i, j
