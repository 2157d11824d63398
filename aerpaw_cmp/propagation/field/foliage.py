"""Loss in trees along traced paths, in closed form.

Crowns are not in the traced scene. The polyline of each path (source, reflection points, target) is intersected with
every crown near the path. The chords add up to the path's depth in foliage, and a model converts depth into loss. If a
parameter changes, rays need not be traced again. Foliage does not change the phase.

Where crowns overlap, both chords are added. Trunks are used only for :class:`Opaque`, because the shadow of a trunk is
centimetres wide, and the Fresnel zone at a crown is metres wide.

A forest can also be modelled as a medium. Its loss combines the components through, over and around the canopy.

A forest stand is a forest with a height: crowns from ``crown_base_m`` up to ``height_m`` over its area, trunks below.
The field behind a stand has three components whose powers add up (ITU-R P.833-10 section 3.2): through the canopy, over
the top, and around either side. The loss through the canopy depends on the length inside the canopy. The path over the
top has two knife edges, where the ray enters and leaves the stand. Near the top, part of the Fresnel zone is in the
canopy. The component through the canopy is then computed for a ray that is lowered until its Fresnel zone is below the
top. The components over and around the canopy only add the missing power. The level therefore has no step where a ray
leaves the canopy.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Literal, NamedTuple

import numpy as np
import shapely

from ...common.errors import UsageError
from ...common.units import AnyArray, BoolArray, FloatArray, IntArray
from ...site.site import Forest, Site, Trees
from ..geometry import legs

# Form of a crown between its base and the top of the tree. The paper uses the cone.
Shape = Literal["cone", "cylinder"]

# ITU-R P.833: near 1 GHz, trees in leaf attenuate about 20 % more (dB/m) than leafless trees.
LEAFLESS_FACTOR = 1 / 1.2

# Length of the pieces of a path that are looked up in the grid [m].
_PIECE_M = 8.0
# Side of a cell [m]: about the radius of a crown, so that a cell lists few crowns.
_CELL_M = 4.0
_MAX_CELLS = 4_000_000
# Number of pairs of a piece and a crown that are computed together: about 150 MB of temporary arrays.
_PAIRS_AT_ONCE = 1_500_000


# ---------------------------------------------------------------- models: depth in foliage to loss


@dataclass(frozen=True, slots=True)
class Opaque:
    """A model in which any contact with a crown or a trunk blocks the path (loss inf), as in arXiv 2502.10324."""

    def loss_db(self, depth_m: FloatArray) -> FloatArray:
        """Return inf where the depth is above 0, else 0. NaN stays NaN."""
        depth = np.asarray(depth_m, dtype=np.float64)
        return np.where(np.isnan(depth), np.nan, np.where(depth > 0, np.inf, 0.0))


# Table of P.833 (woodland, one terminal inside): frequency [MHz], gamma [dB/m], A_m [dB].
P833_TABLE: tuple[tuple[float, float, float], ...] = (
    (105.9, 0.04, 9.4),
    (466.475, 0.12, 18.0),
    (949.0, 0.17, 26.5),
    (1852.2, 0.30, 29.0),
    (2117.5, 0.34, 34.1),
)
# Exponents of the frequency beyond the table: the slope of a log-log fit to it, and P.833's fit of A_m for Mulhouse.
_GAMMA_EXPONENT = 0.70
_MAXIMUM_EXPONENT = 0.43


@dataclass(frozen=True, slots=True)
class P833:
    """ITU-R P.833 woodland: ``A = A_m (1 - exp(-gamma d / A_m))``.

    Parameters
    ----------
    gamma_db_per_m : float
        Specific attenuation of short depths; 0.5 at 3.4 GHz (0.45 to 0.7 is plausible).
    maximum_db : float
        A_m, the limit of the loss for large depths; 38 dB at 3.4 GHz.

    Examples
    --------
    >>> P833(0.48, 38.0).loss_db(np.array([0.0, 10.0, 50.0])).round(1).tolist()
    [0.0, 4.5, 17.8]
    """

    gamma_db_per_m: float = 0.5
    maximum_db: float = 38.0

    def __post_init__(self) -> None:
        if not (0 <= self.gamma_db_per_m < math.inf and 0 < self.maximum_db < math.inf):
            raise UsageError(
                f"gamma is {self.gamma_db_per_m} dB/m and A_m {self.maximum_db} dB", expected="gamma >= 0 and A_m > 0"
            )

    @classmethod
    def at(cls, frequency_hz: float, *, in_leaf: bool = True) -> P833:
        """Return parameters from P.833's table, interpolated log-log.

        Beyond the ends of the table (106 MHz, 2.1 GHz), the nearest entry is extrapolated with f^0.70 (gamma) and
        f^0.43 (A_m). At 3.4 GHz in leaf, this results in 0.47 dB/m and 42 dB. For leafless trees, gamma is multiplied
        by ``LEAFLESS_FACTOR``.

        Raises
        ------
        UsageError
            If the frequency is outside 30 MHz to 100 GHz, the scope of P.833.
        """
        if not 30e6 <= frequency_hz <= 100e9:
            raise UsageError(f"P.833 at {frequency_hz / 1e6:g} MHz", expected="30 MHz to 100 GHz")
        table = np.log(np.array(P833_TABLE))
        mhz = math.log(frequency_hz / 1e6)
        inside = float(np.clip(mhz, table[0, 0], table[-1, 0]))
        gamma = np.interp(inside, table[:, 0], table[:, 1]) + _GAMMA_EXPONENT * (mhz - inside)
        maximum = np.interp(inside, table[:, 0], table[:, 2]) + _MAXIMUM_EXPONENT * (mhz - inside)
        return cls(math.exp(gamma) * (1.0 if in_leaf else LEAFLESS_FACTOR), math.exp(maximum))

    def loss_db(self, depth_m: FloatArray) -> FloatArray:
        """Return the loss [dB] of a depth in foliage [m]."""
        depth = np.asarray(depth_m, dtype=np.float64)
        return np.asarray(-self.maximum_db * np.expm1(-self.gamma_db_per_m * depth / self.maximum_db))


# A model that converts depth in foliage (...) [m] into loss (...) [dB], which is 0 at depth 0.
FoliageModel = Opaque | P833


def foliage_model(
    name: str,
    frequency_hz: float,
    *,
    in_leaf: bool = True,
    gamma_db_per_m: float | None = None,
    maximum_db: float | None = None,
) -> FoliageModel:
    """Return a model by its name in flight.yaml.

    Parameters
    ----------
    name : {"opaque", "attenuating"}
    frequency_hz : float
    in_leaf : bool
        Whether the trees are in leaf.
    gamma_db_per_m, maximum_db : float, optional
        Specific attenuation [dB/m] and largest loss [dB] instead of P.833's table. The model ``opaque`` does not use
        them.

    Returns
    -------
    FoliageModel
    """
    if name == "opaque":
        return Opaque()
    table = P833.at(frequency_hz, in_leaf=in_leaf)
    return P833(
        table.gamma_db_per_m if gamma_db_per_m is None else gamma_db_per_m,
        table.maximum_db if maximum_db is None else maximum_db,
    )


# ---------------------------------------------------------------- paths through trees


def foliage_loss_db(
    source_m: FloatArray, vertices_m: FloatArray, target_m: FloatArray, trees: Trees | CrownIndex, model: FoliageModel
) -> FloatArray:
    """Return the loss of each path in foliage [dB].

    Parameters
    ----------
    source_m, target_m : (paths, 3)
        Ends of the paths, east-north-up [m].
    vertices_m : (paths, depth, 3)
        Reflection points in order; NaN where unused. ``depth`` may be 0.
    trees : Trees or CrownIndex
        Trees, or their index if there are many batches of paths.
    model : FoliageModel
        Model that converts depth into loss.

    Returns
    -------
    ndarray, (paths,)
        Loss at the total depth of each path; NaN if an end is not finite.
    """
    index = trees if isinstance(trees, CrownIndex) else crown_index(trees)
    depth = foliage_depth_m(source_m, vertices_m, target_m, index)
    if isinstance(model, Opaque):
        depth = depth + foliage_depth_m(source_m, vertices_m, target_m, index.trunks)
    return model.loss_db(depth)


def foliage_depth_m(
    source_m: FloatArray, vertices_m: FloatArray, target_m: FloatArray, trees: Trees | CrownIndex
) -> FloatArray:
    """Return the length of each path inside crowns (paths,) [m].

    Parameters
    ----------
    source_m, target_m : (paths, 3)
        Ends [m].
    vertices_m : (paths, depth, 3)
        Points of reflection [m]; NaN where a path has fewer points.
    trees : Trees or CrownIndex

    Returns
    -------
    (paths,)
        Length [m]; NaN if an end is not finite.
    """
    source, target = np.asarray(source_m, dtype=np.float64), np.asarray(target_m, dtype=np.float64)
    vertices = np.asarray(vertices_m, dtype=np.float64)
    index = trees if isinstance(trees, CrownIndex) else crown_index(trees)
    depth = np.zeros(len(source))
    # always add the legs from target to source, because another order would change the last digit
    for start, end in reversed([*legs(source, vertices, target)]):
        moved = (start != end).any(axis=1)
        depth[moved] += index.chords_m(start[moved], end[moved])
    # legs() treats a missing corner as unused, but a missing end means that there is no path
    depth[~(np.isfinite(source).all(axis=1) & np.isfinite(target).all(axis=1))] = np.nan
    return depth


@lru_cache(maxsize=2)
def crown_index(trees: Trees) -> CrownIndex:
    """Return the spatial index of the cones of these trees. The indices of the last two sets of trees are cached."""
    return CrownIndex(trees)


class CrownIndex:
    """Crowns sorted into a grid, for many segments.

    Parameters
    ----------
    trees : Trees
        Trees to index. May be empty.
    shape : {"cone", "cylinder"}
        Form of all bodies.
    """

    def __init__(self, trees: Trees, shape: Shape = "cone") -> None:
        self.trees = trees
        self.shape: Shape = shape
        base = trees.ground_m + trees.crown_base_m
        top = trees.ground_m + trees.height_m
        radius = trees.crown_diameter_m / 2
        solid = (radius > 0) & (top > base)
        #: columns: east, north, base, top, radius
        self._bodies = np.stack([trees.east_m, trees.north_m, base, top, radius], axis=-1)[solid]
        if not np.isfinite(self._bodies).all():
            raise UsageError("a tree has a position or size that is not a number")
        if len(self._bodies):
            self._build_grid()

    @cached_property
    def trunks(self) -> CrownIndex:
        """The trunks of the same trees, as cylinders from the ground to the crown."""
        of = self.trees
        none = np.zeros(len(of))
        stems = replace(of, height_m=of.crown_base_m, crown_base_m=none, crown_diameter_m=of.trunk_diameter_m)
        return CrownIndex(stems, "cylinder")

    def _build_grid(self) -> None:
        """List, for each cell of a grid, the bodies that a ray through the cell may meet (as compressed rows)."""
        centre, widest = self._bodies[:, :2], float(self._bodies[:, 4].max())
        # pieces are looked up by their middle, so extend the reach by half a piece
        reach = widest + _PIECE_M / 2
        low = centre.min(axis=0) - reach
        span = centre.max(axis=0) + reach - low
        # limit the number of cells, to limit the memory for woods of square kilometres
        self._cell_m = max(_CELL_M, math.sqrt(float(span.prod()) / _MAX_CELLS))
        self._low, self._shape2 = low, (span / self._cell_m).astype(np.int64) + 1
        home = ((centre - low) / self._cell_m).astype(np.int64)
        steps = math.ceil(reach / self._cell_m)
        around = np.arange(-steps, steps + 1)
        offset = np.stack(np.meshgrid(around, around, indexing="ij"), axis=-1).reshape(-1, 2)
        body, cell = [], []
        # loop over the cells around a crown, for all crowns at once
        for shift in offset:
            at = home + shift
            corner = low + at * self._cell_m
            gap = np.maximum(np.maximum(corner - centre, centre - corner - self._cell_m), 0.0)
            near = (
                (np.hypot(gap[:, 0], gap[:, 1]) <= self._bodies[:, 4] + _PIECE_M / 2 + 1e-9)
                & (at >= 0).all(axis=1)
                & (at < self._shape2).all(axis=1)
            )
            body.append(np.flatnonzero(near))
            cell.append(at[near, 0] * self._shape2[1] + at[near, 1])
        cells, bodies = np.concatenate(cell), np.concatenate(body)
        order = np.argsort(cells, kind="stable")
        self._members = bodies[order]
        # members of cell k lie from row[k] to row[k + 1]
        self._row = np.zeros(int(self._shape2.prod()) + 1, dtype=np.int64)
        np.cumsum(np.bincount(cells, minlength=len(self._row) - 1), out=self._row[1:])

    def chords_m(self, start_m: FloatArray, end_m: FloatArray) -> FloatArray:
        """Return the length inside bodies of each segment (n,) [m] between the ends (n, 3)."""
        total = np.zeros(len(start_m))
        if not len(self._bodies) or not len(start_m):
            return total
        # skip parts above all trees, because most of a flight is above them
        low, high = self._bodies[:, 2].min(), self._bodies[:, 3].max()
        first, last = slab(start_m[:, 2], end_m[:, 2] - start_m[:, 2], low, high)
        along = np.hypot(end_m[:, 0] - start_m[:, 0], end_m[:, 1] - start_m[:, 1])
        live = np.flatnonzero(last >= first)  # NaN compares false
        pieces = np.ceil((last - first)[live] * along[live] / _PIECE_M).clip(1).astype(np.int64)
        ends = np.cumsum(pieces)
        # choose the size of a batch by the fullest cell, to limit the memory
        at_once = max(_PAIRS_AT_ONCE // max(int(np.diff(self._row).max()), 1), 1)
        begin = 0
        while begin < len(live):
            used = ends[begin - 1] if begin else 0
            stop = max(begin + 1, int(np.searchsorted(ends, used + at_once, side="right")))
            some = live[begin:stop]
            total[some] = self._sum(start_m[some], end_m[some], first[some], last[some], pieces[begin:stop])
            begin = stop
        return total

    def _sum(
        self, start: FloatArray, end: FloatArray, first: FloatArray, last: FloatArray, pieces: IntArray
    ) -> FloatArray:
        """Return the chords of a batch, looked up piece by piece. Each body is counted in the piece nearest to it."""
        move = end - start
        segment = np.repeat(np.arange(len(start)), pieces)
        number = np.arange(len(segment)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
        width = (last - first) / pieces
        piece, body = self._candidates(start, move, first[segment] + (number + 0.5) * width[segment], segment)

        # the chord of the complete segment is added by the one piece that contains the point nearest to the body's axis
        owner = segment[piece]
        low, wide = first[owner], width[owner]
        step_east, step_north = move[owner, 0], move[owner, 1]
        east = self._bodies[body, 0] - start[owner, 0]
        north = self._bodies[body, 1] - start[owner, 1]
        square = step_east * step_east + step_north * step_north
        nearest = np.divide(east * step_east + north * step_north, square, out=low.copy(), where=square > 0)
        np.clip(nearest, low, last[owner], out=nearest)
        # find the piece that contains this point: other pieces also meet the crown, and would count it twice
        turn = np.divide(nearest - low, wide, out=np.zeros_like(low), where=wide > 0).astype(np.int64)
        east -= nearest * step_east
        north -= nearest * step_north
        close = east * east + north * north < self._bodies[body, 4] ** 2
        hit = np.flatnonzero(close & (np.minimum(turn, pieces[owner] - 1) == number[piece]))
        owner, body = owner[hit], body[hit]
        share = _chord_share(start[owner], move[owner], self._bodies[body], self.shape)
        length = np.sqrt((move**2).sum(axis=1))
        return np.bincount(owner, weights=share * length[owner], minlength=len(start)).astype(np.float64)

    def _candidates(
        self, start: FloatArray, move: FloatArray, middle: FloatArray, segment: IntArray
    ) -> tuple[IntArray, IntArray]:
        """Return pairs (piece, body) of pieces, given by the middle of each, and the bodies listed in its cell."""
        i = np.floor((start[segment, 0] + middle * move[segment, 0] - self._low[0]) / self._cell_m).astype(np.int64)
        j = np.floor((start[segment, 1] + middle * move[segment, 1] - self._low[1]) / self._cell_m).astype(np.int64)
        rows, columns = self._shape2
        inside = np.flatnonzero((i >= 0) & (i < rows) & (j >= 0) & (j < columns))
        cell = i[inside] * columns + j[inside]
        count = self._row[cell + 1] - self._row[cell]
        piece = np.repeat(inside, count)
        slot = np.arange(len(piece)) + np.repeat(self._row[cell] - (np.cumsum(count) - count), count)
        return piece, self._members[slot]


def slab(
    at: FloatArray, step: FloatArray, low: AnyArray | float, high: AnyArray | float
) -> tuple[FloatArray, FloatArray]:
    """Return the interval of t in [0, 1] with ``low <= at + t step <= high``.

    Parameters
    ----------
    at, step : (n,)
    low, high : (n,) or float

    Returns
    -------
    first, last : (n,)
        ``first > last`` if there is no such interval.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        at_low, at_high = (low - at) / step, (high - at) / step
    level = step == 0
    inside = (at >= low) & (at <= high)
    first = np.where(level, np.where(inside, 0.0, 1.0), np.maximum(np.minimum(at_low, at_high), 0.0))
    last = np.where(level, np.where(inside, 1.0, 0.0), np.minimum(np.maximum(at_low, at_high), 1.0))
    return first, last


def _chord_share(start: FloatArray, move: FloatArray, bodies: FloatArray, shape: Shape) -> FloatArray:
    """Return the share of each segment (n,) inside its body (n, 5: east, north, base, top, radius).

    The side of a body is a quadric, ``A t^2 + 2 B t + C <= 0`` along the segment.
    """
    base, top, radius = bodies[:, 2], bodies[:, 3], bodies[:, 4]
    first, last = slab(start[:, 2], move[:, 2], base, top)
    east, north = start[:, 0] - bodies[:, 0], start[:, 1] - bodies[:, 1]
    a = move[:, 0] ** 2 + move[:, 1] ** 2
    b = east * move[:, 0] + north * move[:, 1]
    c = east**2 + north**2
    if shape == "cone":  # r = slope (top - up)
        slope, below = radius / (top - base), start[:, 2] - top
        # the coefficient is negative if the segment is steeper than the side of the cone
        a = a - (slope * move[:, 2]) ** 2
        b = b - slope**2 * below * move[:, 2]
        c = c - (slope * below) ** 2
    else:
        c = c - radius**2
    return _quadric_share(a, b, c, first, last, move[:, 2])


def _quadric_share(
    a: FloatArray, b: FloatArray, c: FloatArray, first: FloatArray, last: FloatArray, rise: FloatArray
) -> FloatArray:
    """Return the length of {t in [first, last]: a t^2 + 2 b t + c <= 0}, for a double cone only below its apex."""
    # a quarter of the usual discriminant, since the middle term is 2 b
    root2 = b * b - a * c
    # q avoids the cancellation of -b + sqrt(...); for a = 0 (parallel to the cone's side), one root is at infinity
    q = -(b + np.copysign(np.sqrt(np.maximum(root2, 0.0)), b))
    with np.errstate(divide="ignore", invalid="ignore"):
        root, other_root = q / np.where(a == 0, 0.0, a), c / q
    nothing = q == 0  # b = 0 and a c = 0
    root, other_root = np.where(nothing, 0.0, root), np.where(nothing, 0.0, other_root)
    lower, upper = np.minimum(root, other_root), np.maximum(root, other_root)
    steep = a < 0  # steeper than the side: inside before the first root (rising) or after the second root (falling)
    lower, upper = (
        np.where(steep, np.where(rise > 0, -np.inf, upper), lower),
        np.where(steep, np.where(rise > 0, lower, np.inf), upper),
    )
    missed = (root2 < 0) & ~steep
    flat: BoolArray = (a == 0) & (b == 0)
    lower, upper = np.where(flat, -np.inf, lower), np.where(flat, np.where(c <= 0, np.inf, -np.inf), upper)
    inside = np.minimum(upper, last) - np.maximum(lower, first)
    return np.where(missed, 0.0, np.maximum(inside, 0.0))


# Assumed ratio of the loss per metre between trunks to the loss per metre in crowns.
TRUNKS = 0.3
# Clearance at which a knife edge does not cause a loss, as a multiple of the first Fresnel radius. At 0.55, nu is
# -0.78, where the loss of the knife edge begins.
_CLEAR = 0.55

# Seen from above, a vertical segment is a point and does not cross an area. One of its ends is therefore shifted by
# this distance [m].
_UPRIGHT_M = 1e-6
# Number of pairs of a segment and a side of a forest stand that are computed together: about 100 MB of temporary
# arrays.
_SIDES_AT_ONCE = 1_000_000


def stand_loss_db(
    site: Site,
    source_m: FloatArray,
    vertices_m: FloatArray,
    target_m: FloatArray,
    model: FoliageModel,
    wavelength_m: float,
    in_leaf: FoliageModel | None = None,
) -> FloatArray:
    """Return the loss of paths at the stands of a site.

    Source: ITU-R P.833-10 section 3.2.

    Parameters
    ----------
    site : Site
    source_m, target_m : (paths, 3)
        Ends [m].
    vertices_m : (paths, depth, 3)
        Points of reflection [m]; NaN where unused.
    model : FoliageModel
        Model of the loss by depth in crowns. An opaque model also blocks waves over and around the trees.
    wavelength_m : float
    in_leaf : FoliageModel, optional
        Model for the evergreen share of a forest stand. Default: ``model``.

    Returns
    -------
    (paths,)
        Loss [dB].
    """
    loss = np.zeros(len(source_m))
    for start, end in legs(source_m, vertices_m, target_m):
        for crossing in _crossings(site, start, end):
            loss[crossing.segment] += _loss_db(crossing, model, in_leaf or model, wavelength_m)
    return loss


def over_stands(site: Site, source_m: FloatArray, vertices_m: FloatArray, target_m: FloatArray) -> BoolArray:
    """Find the paths that cross the area of a stand in plan, at any height.

    Parameters
    ----------
    site, source_m, vertices_m, target_m
        The same as in :func:`stand_loss_db`.

    Returns
    -------
    (paths,) bool
    """
    mask = np.zeros(len(source_m), dtype=np.bool_)
    for start, end in legs(source_m, vertices_m, target_m):
        for crossing in _crossings(site, start, end):
            mask[crossing.segment] = True
    return mask


def stand_depth_m(site: Site, source_m: FloatArray, target_m: FloatArray) -> FloatArray:
    """Return the length (lines,) [m] of straight lines between points (lines, 3) inside the stands of a site."""
    depth = np.zeros(len(source_m))
    for crossing in _crossings(site, source_m, target_m):
        depth[crossing.segment] += crossing.depth_m(np.zeros(len(crossing.segment)))
    return depth


@dataclass(frozen=True, slots=True)
class _Crossing:
    """Segments that cross the area of one stand in plan.

    Parameters
    ----------
    stand : Forest
    segment : (k,) int
        Numbers of the segments in the caller's arrays.
    start, end : (k, 3)
        Ends of the segments [m].
    piece : (n,) int
        Index into the ``k`` segments for each piece within the area.
    share : (n, 2)
        Start and end of each piece as shares of the segment.
    ground_m : (n,)
        Height of the ground below each piece.
    """

    stand: Forest
    segment: IntArray
    start: FloatArray
    end: FloatArray
    piece: IntArray
    share: FloatArray
    ground_m: FloatArray

    @property
    def height_m(self) -> float:
        """Height of the canopy above the ground."""
        assert self.stand.height_m is not None
        return self.stand.height_m

    def depth_m(self, lowered_m: FloatArray) -> FloatArray:
        """Return the length (k,) [m] in the canopy of segments that are lowered by ``lowered_m`` (k,).

        The length between the trunks is included, multiplied by ``TRUNKS``.
        """
        way = self.end - self.start
        up, rise = (self.start[:, 2] - lowered_m)[self.piece] - self.ground_m, way[self.piece, 2]
        base = self.height_m * self.stand.crown_base_fraction
        depth = _between(self.share, up, rise, base, self.height_m) + TRUNKS * _between(self.share, up, rise, 0.0, base)
        in_all = np.bincount(self.piece, depth, len(self.segment)).astype(np.float64)
        return np.asarray(self.stand.filled * in_all * np.linalg.norm(way, axis=1))


def _crossings(site: Site, start_m: FloatArray, end_m: FloatArray) -> Iterator[_Crossing]:
    """Yield segments between points (segments, 3) [m] that cross each stand of a site, if longer than zero."""
    stands = [forest for forest in site.forests if forest.height_m is not None]
    if not stands:
        return
    # the tree compares only bounding boxes. The exact test follows.
    tree = shapely.STRtree([stand.area for stand in stands])
    moved = np.flatnonzero(
        np.isfinite(start_m).all(axis=1) & np.isfinite(end_m).all(axis=1) & (start_m != end_m).any(axis=1)
    )
    flat = end_m[moved, :2].copy()
    flat[np.hypot(*(flat - start_m[moved, :2]).T) < _UPRIGHT_M, 0] += _UPRIGHT_M  # a line must have a length
    near, stand = tree.query(shapely.linestrings(np.stack([start_m[moved, :2], flat], axis=1)))
    for number in np.unique(stand):
        mine, (corner, last) = near[stand == number], _corners(stands[number])
        step = max(1, _SIDES_AT_ONCE // len(corner))
        for some in (mine[first : first + step] for first in range(0, len(mine), step)):
            row, share = _pieces(start_m[moved[some], :2], flat[some], corner, last)
            crossing, piece = np.unique(row, return_inverse=True)
            if not len(crossing):
                continue
            rows = moved[some[crossing]]
            start, end = start_m[rows], end_m[rows]
            # use the ground under the middle of each piece, because a canopy follows the ground
            ground = np.full(len(piece), stands[number].base_m)
            if site.dem is not None:
                middle = start[piece, :2] + share.mean(axis=1, keepdims=True) * (end - start)[piece, :2]
                ground = np.nan_to_num(site.dem.ground_m(*middle.T))
            yield _Crossing(
                stand=stands[number], segment=rows, start=start, end=end, piece=piece, share=share, ground_m=ground
            )


def _corners(stand: Forest) -> tuple[FloatArray, IntArray]:
    """Return corners (n, 2) of the closed rings of a stand, and the last corner of each ring except the last ring."""
    rings = [shapely.get_coordinates(ring) for ring in (stand.area.exterior, *stand.area.interiors)]
    return np.concatenate(rings), np.cumsum([len(ring) for ring in rings[:-1]], dtype=np.int64) - 1


def _pieces(start: FloatArray, end: FloatArray, corner: FloatArray, last: IntArray) -> tuple[IntArray, FloatArray]:
    """Return pieces of lines (k, 2) inside rings of corners: the line of each piece (n,), and its ends (n, 2)."""
    way = end - start
    # test on which side of each line a corner lies
    left = way[:, :1] * (corner[:, 1] - start[:, 1:]) - way[:, 1:] * (corner[:, 0] - start[:, :1]) > 0
    crosses = left[:, 1:] != left[:, :-1]  # count a corner on the line only once
    # there is no side from the last corner of one ring to the first corner of the next
    crosses[:, last] = False
    line, edge = np.divmod(np.flatnonzero(crosses), crosses.shape[1])  # nonzero of a table takes five times as long
    (east, north), (side_east, side_north) = (corner[edge] - start[line]).T, (corner[edge + 1] - corner[edge]).T
    way_east, way_north = way[line].T
    share = (east * side_north - north * side_east) / (way_east * side_north - way_north * side_east)
    # if the line crosses an odd number of sides before its start, the start is inside
    inside = np.bincount(line[share <= 0.0], minlength=len(way)) % 2 == 1
    line, share = line[between := (share > 0.0) & (share < 1.0)], share[between]
    order, count = np.lexsort([share, line]), np.bincount(line, minlength=len(way))
    bounds = np.ones((len(way), count.max(initial=0) + 2))
    bounds[:, 0] = 0.0
    bounds[line[order], 1 + np.arange(len(line)) - np.repeat(np.cumsum(count) - count, count)] = share[order]
    odd = np.arange(bounds.shape[1] - 1) % 2 == 1
    line, at = np.nonzero((inside[:, None] != odd) & (bounds[:, 1:] > bounds[:, :-1]))
    return line, np.stack([bounds[line, at], bounds[line, at + 1]], axis=1)


def _loss_db(crossing: _Crossing, model: FoliageModel, in_leaf: FoliageModel, wavelength_m: float) -> FloatArray:
    """Return the loss (k,) of segments that cross a stand [dB]."""
    source, target, stand, count = crossing.start, crossing.end, crossing.stand, len(crossing.segment)
    if isinstance(model, Opaque):
        return model.loss_db(crossing.depth_m(np.zeros(count)))
    enter, leave, top = np.full(count, np.inf), np.full(count, -np.inf), np.full(count, -np.inf)
    np.minimum.at(enter, crossing.piece, crossing.share[:, 0])
    np.maximum.at(leave, crossing.piece, crossing.share[:, 1])
    np.maximum.at(top, crossing.piece, crossing.height_m + crossing.ground_m)
    # there are paths over and around the stand only if neither end is in the canopy
    outside = ((enter > 1e-9) | (source[:, 2] > top)) & ((leave < 1.0 - 1e-9) | (target[:, 2] > top))
    length, share = np.linalg.norm(target - source, axis=1), np.stack([enter, leave])
    intrusion = top - source[:, 2] - share * (target - source)[:, 2]
    zone = _CLEAR * np.sqrt(wavelength_m * length * share * (1.0 - share))
    depth_m = crossing.depth_m(np.where(outside, np.maximum((zone - intrusion).min(axis=0), 0.0), 0.0))
    through = model.loss_db(depth_m)
    if stand.evergreen_share:
        # average decibels, not powers, because the evergreen share applies to the trees along each path, not to paths
        through = through + stand.evergreen_share * (in_leaf.loss_db(depth_m) - through)
    # a path without loss does not need a detour
    passed, some = np.zeros(count), np.flatnonzero(outside & (through > 0.0))
    over = Profile(length[some], share[:, some], intrusion[:, some])
    for way in (over, *_around(stand, source[some], target[some])):
        # add powers, because the edge of a canopy is not known to within a wavelength
        passed[some] += 10.0 ** (-deygout_db(way, wavelength_m) / 10.0)
    # multiply the missing shares of power: a detour with full power then removes the loss, and without detours the loss
    # is unchanged
    blocked = (1.0 - 10.0 ** (-through / 10.0)) * (1.0 - np.minimum(passed, 1.0))
    return np.asarray(-10.0 * np.log10(1.0 - blocked))


def _between(share: FloatArray, up: FloatArray, rise: FloatArray, low: float, high: float) -> FloatArray:
    """Return the share (pieces,) of each segment that is between two heights."""
    first, last = slab(up, rise, low, high)
    return np.asarray(np.maximum(np.minimum(share[:, 1], last) - np.maximum(share[:, 0], first), 0.0))


def _around(stand: Forest, start: FloatArray, end: FloatArray) -> Iterator[Profile]:
    """Yield the profiles of the paths around both sides of a stand."""
    length = np.linalg.norm(end - start, axis=1)
    corner = shapely.get_coordinates(stand.area.convex_hull)[:, None]
    way = (end - start)[:, :2]
    flat = np.maximum(np.hypot(*way.T), _UPRIGHT_M)
    off = corner - start[:, :2]
    along = (off * way).sum(axis=2) / flat**2
    across = (way[:, 0] * off[..., 1] - way[:, 1] * off[..., 0]) / flat
    for side in (1.0, -1.0):
        yield Profile(length, along, side * across)


# --- knife edges across a straight line: the detours over and around a wood ----------------------------------------


class Profile(NamedTuple):
    """Edges under straight lines, one column of samples per line.

    ``length_m`` (links,) is the length of the lines, ``share`` (samples, links) the part of the line up to each sample,
    and ``intrusion_m`` the height of the edge above the line at that sample, NaN if unknown.
    """

    length_m: FloatArray
    share: FloatArray
    intrusion_m: FloatArray


def knife_edge_db(nu: FloatArray) -> FloatArray:
    """Return the loss of one knife edge [dB] from its parameter nu. The loss is 0 below -0.78.

    Source: ITU-R P.526-15 eq. 31.
    """
    # limit nu, because far below -0.78 the sum of x and the root of its square loses all digits
    x = np.maximum(nu, -0.78) - 0.1
    return np.where(nu > -0.78, np.maximum(6.9 + 20.0 * np.log10(np.sqrt(x * x + 1.0) + x), 0.0), 0.0)


def _parameter(height_m: FloatArray, before_m: FloatArray, after_m: FloatArray, wavelength_m: float) -> FloatArray:
    """Return the parameter nu of edges. The parameter is -inf at the ends of a line and where the height is unknown."""
    # an edge at an end has distance zero, and nu would be infinite
    inner = (before_m > 0.0) & (after_m > 0.0) & np.isfinite(height_m)
    product = np.where(inner, before_m * after_m, 1.0)
    nu = np.where(inner, height_m, 0.0) * np.sqrt(2.0 * np.abs(before_m + after_m) / (wavelength_m * product))
    return np.where(inner, nu, -np.inf)


def deygout_db(profile: Profile, wavelength_m: float) -> FloatArray:
    """Return the loss (links,) [dB] of up to three edges by Deygout's construction with Causebrook's correction.

    Sources: Deygout, IEEE Trans. Antennas Propag. 14 (1966) 480, doi 10.1109/TAP.1966.1138719; Causebrook and Davis,
    BBC Research Department report 1971/43, eq. 13 to 15.

    Notes
    -----
    The loss is ``A + (A_1 - C_1) + (A_2 - C_2)``: the loss of the main edge, and of the main edge on each side of it,
    minus ``C = (6 - A + A_e) cos(alpha)``. A_e is the loss of the edge of that side alone on the direct line, and
    ``cos(alpha)^2 = d_1 d_34 / (d_12 d_234)``. Neither term is negative.
    """
    length_m, share, intrusion_m = profile
    nu = _parameter(intrusion_m, share * length_m, (1.0 - share) * length_m, wavelength_m)
    main, link = nu.argmax(axis=0), np.arange(len(length_m))
    total = first = knife_edge_db(nu[main, link])
    known = np.isfinite(nu[main, link])
    # if there is no edge, use any position, because its loss is zero
    at, top = np.where(known, share[main, link], 0.5), np.where(known, intrusion_m[main, link], 0.0)
    for way, place in ((share, at), (1.0 - share, 1.0 - at)):
        # heights above the line from the end to the top of the main edge
        height = intrusion_m - top * way / place
        side = _parameter(height, way * length_m, (place - way) * length_m, wavelength_m)
        edge = side.argmax(axis=0)
        s = np.clip(way[edge, link], 0.0, place)
        cosine = np.sqrt(s * (1.0 - place) / (place * (1.0 - s)))
        correction = np.maximum(6.0 - first + knife_edge_db(nu[edge, link]), 0.0) * cosine
        total = total + np.maximum(knife_edge_db(side[edge, link]) - correction, 0.0)
    return np.asarray(total)
