"""A second, independent replay of single links: slow, one element pair at a time, for the audit.

This implementation follows the recommendations directly, and shares no code with the rest of the package. Each rotation
is computed as three rotations about single axes, and arrays come from their published layout. The constants of ITU-R
P.2040-4 and P.833 are typed in a second time. Reflections use components across and along the plane of incidence. Paths
are found by trying every sequence of faces against the footprints, and chords in crowns by bisection. The inputs are
the site, the settings and the poses. Only the antenna patterns are shared with the replay: Sionna's patterns check the
formulas, and tests check the tables.
"""

from __future__ import annotations

import cmath
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import shapely
from shapely.geometry import LineString, Point, Polygon

from ...common.units import BoolArray, ComplexArray, FloatArray, IntArray
from ...site.site import Site, Tower, Trees

Vector = tuple[float, float, float]
Matrix = tuple[Vector, Vector, Vector]
_Wave = tuple[complex, complex, complex]
# ``(theta_rad, phi_rad) -> (E_theta, E_phi)`` in the device frame.
Pattern = Callable[[float, float], tuple[complex, complex]]

C_MPS = 299_792_458.0
# CODATA 2018. All constants of this file are typed a second time.
_EPS0 = 8.8541878128e-12

# Paths that appear or disappear if the geometry changes by this distance are not judged [m].
MARGIN_M = 1e-6

# ITU-R P.2040-4, table 3: lowest and highest frequency [GHz], a, b, c, d. Then the thickness of a wall [m], or None for
# a half-space.
_P2040: dict[str, tuple[float, float, float, float, float, float, float | None]] = {
    "vacuum": (0.001, 100, 1.0, 0.0, 0.0, 0.0, None),
    "concrete": (1, 100, 5.24, 0.0, 0.0462, 0.7822, 0.3),
    "brick": (1, 40, 3.91, 0.0, 0.0238, 0.16, 0.2),
    "plasterboard": (1, 100, 2.73, 0.0, 0.0085, 0.9395, 0.025),
    "wood": (0.001, 100, 1.99, 0.0, 0.0047, 1.0718, 0.15),
    "glass": (0.1, 100, 6.31, 0.0, 0.0036, 1.3394, 0.006),
    "ceiling_board": (1, 100, 1.48, 0.0, 0.0011, 1.0750, 0.02),
    "chipboard": (1, 100, 2.58, 0.0, 0.0217, 0.7800, 0.02),
    "plywood": (1, 40, 2.71, 0.0, 0.33, 0.0, 0.02),
    "marble": (1, 60, 7.074, 0.0, 0.0055, 0.9262, 0.03),
    "floorboard": (50, 100, 3.66, 0.0, 0.0044, 1.3515, 0.02),
    "asphalt_concrete": (1, 40, 4.83, 0.0, 0.0108, 1.3969, None),
    "metal": (1, 100, 1.0, 0.0, 1e7, 0.0, 0.005),
    "very_dry_ground": (1, 10, 3.0, 0.0, 0.00015, 2.52, None),
    "medium_dry_ground": (1, 10, 15.0, -0.1, 0.035, 1.63, None),
    "wet_ground": (1, 10, 30.0, -0.4, 0.15, 1.30, None),
}

# ---------------------------------------------------------------- what is expected


@dataclass(frozen=True, slots=True)
class ExpectedArray:
    """The elements of one device according to the settings.

    Parameters
    ----------
    positions_m : tuple of (x, y, z)
    slants_deg : tuple of float
    patterns : tuple of Pattern
        Pattern of each element.
    mount : Matrix
        Rotation from the device frame to the frame of the site or aircraft that carries the device.
    """

    positions_m: tuple[Vector, ...]
    slants_deg: tuple[float, ...]
    patterns: tuple[Pattern, ...]
    mount: Matrix


@dataclass(frozen=True, slots=True)
class ExpectedLink:
    """The radio settings of a link, as configured."""

    carrier_hz: float
    transmit_power_dbm: float
    uav_transmits: bool
    towers: dict[str, ExpectedArray]
    uav: ExpectedArray
    noise_floor_dbm: float


@dataclass(frozen=True, slots=True)
class ExpectedLoss:
    """The foliage and reflection loss, as configured.

    Parameters
    ----------
    model : {"none", "attenuating", "opaque"}
    gamma_db_per_m, maximum_db : float or None
        Values that replace those of P.833.
    in_leaf : bool
    reflection_db : float
        Loss per reflection [dB].
    """

    model: str = "none"
    gamma_db_per_m: float | None = None
    maximum_db: float | None = None
    in_leaf: bool = True
    reflection_db: float = 0.0


def layout_positions(
    layout: str, wavelength: float, elements: int = 4, positions_m: Sequence[Sequence[float]] | None = None
) -> tuple[Vector, ...]:
    """Return element positions of a layout of flight.yaml, in the device frame (x forward, y left, z up) [m].

    Parameters
    ----------
    layout : str
        ``single``, ``linear``, ``tower_comparison``, ``uav_comparison``, ``custom``.
    wavelength : float
        Wavelength [m].
    elements : int
        Number of elements, for ``linear``.
    positions_m : sequence of (3,), optional
        Element positions [m], for ``custom``.

    Returns
    -------
    tuple of (3,)
    """
    # the positions are already in the order of the ports
    if layout == "custom":
        return tuple((float(p[0]), float(p[1]), float(p[2])) for p in positions_m or ())
    if layout == "tower_comparison":  # arXiv 2502.10324 VII-D: 60 mm, 1.68 m, 60 mm, the first port leftmost
        return ((0.0, 0.9, 0.0), (0.0, 0.84, 0.0), (0.0, -0.84, 0.0), (0.0, -0.9, 0.0))
    q = wavelength / 4
    if layout == "uav_comparison":  # 2 x 2, column by column from the left, with the upper element first
        return ((0.0, q, q), (0.0, q, -q), (0.0, -q, q), (0.0, -q, -q))
    # the first port is leftmost, which is +y when looking along x
    n = 1 if layout == "single" else elements
    return tuple((0.0, wavelength / 2 * ((n - 1) / 2 - k), 0.0) for k in range(n))


def permittivity(name: str, carrier_hz: float) -> tuple[complex, float | None] | None:
    """Return a material's complex relative permittivity and thickness. None if it is not in the table."""
    key = name.lower().replace("-", "_").replace(" ", "_")
    key = key[4:] if key.startswith("itu_") else key
    ghz = carrier_hz / 1e9
    if key not in _P2040 or not _P2040[key][0] <= ghz <= _P2040[key][1]:
        return None
    _, _, a, b, c, d, thickness = _P2040[key]
    return a * ghz**b - 1j * c * ghz**d / (2 * math.pi * carrier_hz * _EPS0), thickness


# ---------------------------------------------------------------- vectors


def _dot(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Vector, b: Vector) -> Vector:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def _plus(a: Vector, b: Vector, scale: float = 1.0) -> Vector:
    return (a[0] + scale * b[0], a[1] + scale * b[1], a[2] + scale * b[2])


def _unit(a: Vector) -> Vector:
    size = math.sqrt(_dot(a, a))
    return (a[0] / size, a[1] / size, a[2] / size)


def _times(m: Matrix, v: Vector) -> Vector:
    return (_dot(m[0], v), _dot(m[1], v), _dot(m[2], v))


def product(a: Matrix, b: Matrix) -> Matrix:
    """Return the matrix product."""
    columns = [(b[0][k], b[1][k], b[2][k]) for k in range(3)]
    rows = [tuple(_dot(row, column) for column in columns) for row in a]
    return tuple(rows)  # type: ignore[return-value]


def turned(yaw_deg: float, pitch_deg: float, roll_deg: float) -> Matrix:
    """Return the rotation of TR 38.901 (7.1-4): roll about x, pitch about y, yaw about z, all right-handed."""
    a, b, c = (math.radians(x) for x in (yaw_deg, pitch_deg, roll_deg))
    about_z: Matrix = ((math.cos(a), -math.sin(a), 0.0), (math.sin(a), math.cos(a), 0.0), (0.0, 0.0, 1.0))
    about_y: Matrix = ((math.cos(b), 0.0, math.sin(b)), (0.0, 1.0, 0.0), (-math.sin(b), 0.0, math.cos(b)))
    about_x: Matrix = ((1.0, 0.0, 0.0), (0.0, math.cos(c), -math.sin(c)), (0.0, math.sin(c), math.cos(c)))
    return product(about_z, product(about_y, about_x))


def aircraft(roll_deg: float, pitch_deg: float, yaw_deg: float) -> Matrix:
    """Return the rotation from forward-left-up to east-north-up, via the forward-right-down axes of textbooks."""
    # heading, nose up and right wing down are right-handed rotations about down, right and forward
    to_ned = turned(yaw_deg, pitch_deg, roll_deg)
    enu_of_ned: Matrix = ((0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, -1.0))
    frd_of_flu: Matrix = ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0))
    return product(enu_of_ned, product(to_ned, frd_of_flu))


def matrix_of(values: FloatArray) -> Matrix:
    """Return a (3, 3) array as a Matrix."""
    return tuple(tuple(float(x) for x in row) for row in values)  # type: ignore[return-value]


# ---------------------------------------------------------------- geometry


@dataclass(frozen=True, slots=True)
class Mirror:
    """One reflecting plane: a wall, a roof, the ground, or a given facet.

    Parameters
    ----------
    normal : Vector
    offset_m : float
    material : str
    start, along, length_m, low_m, high_m
        For a wall: plan position of one end, horizontal direction and length, foot and top.
    roof : Polygon, optional
    solid : int
        Number of the building, -1 for the ground.
    """

    normal: Vector
    offset_m: float
    material: str
    start: tuple[float, float] = (0.0, 0.0)
    along: tuple[float, float] = (0.0, 0.0)
    length_m: float = 0.0
    low_m: float = 0.0
    high_m: float = 0.0
    roof: Polygon | None = None
    solid: int = -1

    def height(self, p: Vector) -> float:
        """Return the distance in front of the plane."""
        return _dot(self.normal, p) - self.offset_m

    def mirrored(self, p: Vector) -> Vector:
        """Return the image of a point."""
        return _plus(p, self.normal, -2.0 * self.height(p))

    def box(self) -> tuple[Vector, Vector]:
        """Return the minimum and maximum coordinates of the face. The coordinates are infinite for the ground."""
        if self.roof is not None:
            west, south, east, north = self.roof.bounds
            return (west, south, self.offset_m), (east, north, self.offset_m)
        if self.solid < 0:
            return (-math.inf,) * 3, (math.inf,) * 3
        (west, east), (south, north) = (
            sorted((x, x + self.length_m * way)) for x, way in zip(self.start, self.along, strict=True)
        )
        return (west, south, self.low_m), (east, north, self.high_m)

    def margin(self, p: Vector) -> float:
        """Return the distance of a point of the plane from the face's edges [m], positive inside, negative outside."""
        if self.roof is not None:
            spot = Point(p[0], p[1])
            # the boundary includes the edges of holes
            edge = float(self.roof.boundary.distance(spot))
            return edge if self.roof.covers(spot) else -edge
        if self.solid < 0:
            return math.inf
        s = (p[0] - self.start[0]) * self.along[0] + (p[1] - self.start[1]) * self.along[1]
        return min(s, self.length_m - s, p[2] - self.low_m, self.high_m - p[2])


def _edges(part: shapely.Polygon) -> Iterator[tuple[tuple[float, ...], tuple[float, ...]]]:
    """Yield the edges of a footprint, in the direction that has the building on the left."""
    for hole, ring in enumerate((part.exterior, *part.interiors)):
        points = list(ring.coords)
        for a, b in itertools.pairwise(points if ring.is_ccw is (hole == 0) else points[::-1]):
            # skip edges without length, because a map may repeat a corner
            if a[:2] != b[:2]:
                yield a, b


def _mirrors_of(site: Site, tower: Tower) -> tuple[Mirror, ...]:
    """Return the ground of the tower, then walls and roof of each building."""
    mirrors = [Mirror((0.0, 0.0, 1.0), tower.ground_m, site.ground_material)]
    for number, building in enumerate(site.buildings):
        # use the same heights as the replay, so that planes and edges can be compared
        foot, top = min(building.base_m, 0.0) - 0.5, building.base_m + building.height_m
        footprint = building.footprint if building.footprint.is_valid else shapely.make_valid(building.footprint)
        # skip lines and points, which the repair of a ring that crosses itself may leave
        for part in shapely.get_parts(footprint):
            if part.geom_type != "Polygon" or part.area <= 0:
                continue
            for a, b in _edges(part):
                length = math.hypot(b[0] - a[0], b[1] - a[1])
                along = ((b[0] - a[0]) / length, (b[1] - a[1]) / length)
                normal = (along[1], -along[0], 0.0)
                offset = normal[0] * a[0] + normal[1] * a[1]
                mirrors.append(
                    Mirror(
                        normal, offset, building.material, start=(a[0], a[1]), along=along, length_m=length,
                        low_m=foot, high_m=top, solid=number,
                    )
                )  # fmt: skip
            mirrors.append(Mirror((0.0, 0.0, 1.0), top, building.material, roof=part, solid=number))
    return tuple(mirrors)


class Blocks:
    """The buildings as obstacles, enlarged or shrunk by a margin."""

    def __init__(self, site: Site) -> None:
        self._site = site
        self._shapes: dict[float, list[Polygon]] = {}

    def cut(self, a: Vector, b: Vector, grow_m: float, spared: tuple[int, ...] = ()) -> bool:
        """Check whether a segment crosses a building.

        The buildings ``spared``, on which the segment ends, are made smaller.

        Parameters
        ----------
        a, b : (3,)
            Ends [m].
        grow_m : float
            Enlarge every other building by this much on all sides [m].
        spared : tuple of int
            Numbers of the buildings on which the segment ends.

        Returns
        -------
        bool
        """
        shadow = LineString([a[:2], b[:2]])
        for number, building in enumerate(self._site.buildings):
            # a segment ends on a wall of this building, so the enlarged building would always cut it
            grown = -MARGIN_M / 10 if number in spared else grow_m
            top = building.base_m + building.height_m + grown
            # a segment above the roof is free, regardless of the footprint below
            if min(a[2], b[2]) >= top or not self._near(number, a, b):
                continue
            shape = self._shape(number, grown)
            # on the map, a vertical segment is a point, for which an intersection has no length
            if shadow.length < 1e-9:
                if shape.contains(Point(a[:2])):
                    return True
                continue
            for piece in shapely.get_parts(shape.intersection(shadow)):
                if piece.geom_type != "LineString" or piece.length < 1e-9:
                    continue
                shares = [shadow.project(Point(c)) / shadow.length for c in piece.coords]
                if min(a[2] + s * (b[2] - a[2]) for s in shares) < top:
                    return True
        return False

    def _near(self, number: int, a: Vector, b: Vector) -> bool:
        west, south, east, north = self._site.buildings[number].footprint.bounds
        return not (
            max(a[0], b[0]) < west - 1
            or min(a[0], b[0]) > east + 1
            or max(a[1], b[1]) < south - 1
            or min(a[1], b[1]) > north + 1
        )

    def _shape(self, number: int, grow_m: float) -> Polygon:
        shapes = self._shapes.setdefault(grow_m, [None] * len(self._site.buildings))
        if shapes[number] is None:
            shapes[number] = self._site.buildings[number].footprint.buffer(grow_m, join_style="mitre")
        return shapes[number]


# ---------------------------------------------------------------- one link

# Mirrors (sequences, depth) by number, and images (sequences, depth + 1, 3) of the source.
_Chains = tuple[IntArray, FloatArray]

# Rounding shifts a reflection point by less than this [m] if image and target are at least MARGIN_M apart along the
# normal of the plane.
_SLACK_M = 0.1


class _Planes(NamedTuple):
    """Mirrors as arrays: normals and boxes (mirrors, 3), offsets (mirrors,)."""

    normal: FloatArray
    offset_m: FloatArray
    low_m: FloatArray
    high_m: FloatArray

    @classmethod
    def of(cls, mirrors: Sequence[Mirror]) -> _Planes:
        boxes = np.array([m.box() for m in mirrors])
        planes = np.array([(*m.normal, m.offset_m) for m in mirrors])
        return cls(planes[:, :3], planes[:, 3], boxes[:, 0], boxes[:, 1])


@dataclass(frozen=True, slots=True)
class Reference:
    """Links of one tower, computed path by path with slow independent formulas.

    Parameters
    ----------
    site : Site
    tower : str
    link : ExpectedLink
    loss : ExpectedLoss
    """

    site: Site
    tower: str
    link: ExpectedLink
    loss: ExpectedLoss = field(default_factory=ExpectedLoss)
    mirrors: tuple[Mirror, ...] = field(init=False)
    blocks: Blocks = field(init=False)
    _planes: _Planes = field(init=False)
    _chains: dict[tuple[int, int], list[_Chains] | None] = field(init=False, default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "mirrors", _mirrors_of(self.site, self.site.towers[self.tower]))
        object.__setattr__(self, "_planes", _Planes.of(self.mirrors))
        object.__setattr__(self, "blocks", Blocks(self.site))

    @property
    def source(self) -> Vector:
        """Centre of the tower's array."""
        tower = self.site.towers[self.tower]
        return (tower.east_m, tower.north_m, tower.ground_m + tower.antenna_height_m)

    def sequences(self, target: Vector, max_depth: int, budget: int = 20_000) -> list[tuple[Mirror, ...]] | None:
        """Return all sequences of mirrors that may lead to a target. None if there are more than ``budget``.

        The images of these sequences are on the correct sides, and the reflection points are in the boxes of the faces.
        """
        if (max_depth, budget) not in self._chains:
            self._chains[max_depth, budget] = self._from_source(max_depth, budget)
        levels = self._chains[max_depth, budget]
        if levels is None:
            return None
        near = (rows[self._in_boxes(rows, images, target)] for rows, images in levels)
        return [tuple(self.mirrors[k] for k in row) for rows in near for row in rows.tolist()]

    def _from_source(self, max_depth: int, budget: int) -> list[_Chains] | None:
        """Return mirrors and images, by depth, of the sequences that can start at the tower, for any target."""
        rows, images = np.zeros((1, 0), dtype=np.int64), np.array(self.source)[None, None]
        levels = [(rows, images)]
        for depth in range(max_depth):
            height = images[:, -1] @ self._planes.normal.T - self._planes.offset_m
            # the source may lie on a face, but an image may not
            facing = height > (0.0 if depth else -MARGIN_M)
            # exclude the same face twice in a row, because a ray cannot return to the face that it comes from
            if depth:
                facing[np.arange(len(rows)), rows[:, -1]] = False
            past, mirror = np.nonzero(facing)
            if len(past) > budget:
                return None
            image = images[past, -1] - 2.0 * height[past, mirror, None] * self._planes.normal[mirror]
            rows, images = np.column_stack([rows[past], mirror]), np.concatenate([images[past], image[:, None]], axis=1)
            levels.append((rows, images))
        return levels

    def _in_boxes(self, rows: IntArray, images: FloatArray, target: Vector) -> BoolArray:
        """Check whether points of reflection lie within the boxes of their faces, grown by ``_SLACK_M``."""
        planes, at, good = self._planes, np.tile(target, (len(rows), 1)), np.ones(len(rows), dtype=np.bool_)
        for step in reversed(range(rows.shape[1])):
            face, image = rows[:, step], images[:, step + 1]
            ahead, behind = ((p * planes.normal[face]).sum(axis=1) - planes.offset_m[face] for p in (at, image))
            through = ahead - behind
            with np.errstate(divide="ignore", invalid="ignore"):
                at = image - (behind / through)[:, None] * (at - image)
            inside = (at >= planes.low_m[face] - _SLACK_M) & (at <= planes.high_m[face] + _SLACK_M)
            # if the target is nearly in the plane, the reflection point is undefined, so leave the decision to
            # verdict()
            good &= (np.abs(through) < MARGIN_M) | (inside.all(axis=1) & (through > 0.0))
        return good

    def verdict(self, sequence: Sequence[Mirror], target: Vector, margin_m: float = MARGIN_M) -> bool | None:
        """Check whether a path over the mirrors exists. None if a shift by ``margin_m`` could change the result."""
        points = _bounces(sequence, self.source, target)
        if points is None:
            return False
        worst, last = math.inf, len(sequence) - 1
        for step, mirror in enumerate(sequence):
            before, after = mirror.height(points[step]), mirror.height(points[step + 2])
            worst = min(worst, before + margin_m * (step == 0), after + margin_m * (step == last))
        if worst >= -margin_m:  # compute the distance from edges last, because it takes longer
            worst = min([worst, *(m.margin(p) for m, p in zip(sequence, points[1:-1], strict=True))])
        if worst < -margin_m:
            return False
        strict = loose = False
        for step, (a, b) in enumerate(itertools.pairwise(points)):
            # mirrors at both ends of this segment
            spared = tuple(m.solid for m in sequence[max(0, step - 1) : step + 1])
            loose = loose or self.blocks.cut(a, b, -margin_m, spared)
            if loose:
                return False
            strict = strict or self.blocks.cut(a, b, margin_m, spared)
        return None if strict or worst < margin_m else True

    def pair(self, sequence: Sequence[Mirror], tx: int, rx: int, target: Vector, turn: Matrix) -> complex:
        """Return the amplitude of one path between tower element ``tx`` and UAV element ``rx``, without foliage.

        Parameters
        ----------
        sequence : sequence of Mirror
            Faces at which the path is reflected, from the tower to the UAV.
        tx, rx : int
            Elements of tower and UAV.
        target : (3,)
            Centre of the UAV's array [m].
        turn : (3, 3)
            Rotation from body to site axes.

        Returns
        -------
        complex
            Coefficient whose squared magnitude is the ratio of received to sent power. 0 if the path does not exist.
        """
        tower, uav = self.link.towers[self.tower], self.link.uav
        start = _plus(self.source, _times(tower.mount, tower.positions_m[tx]))
        uav_turn = product(turn, uav.mount)
        end = _plus(target, _times(uav_turn, uav.positions_m[rx]))
        image = start
        for mirror in sequence:
            image = mirror.mirrored(image)
        way = _plus(end, image, -1.0)
        length = math.sqrt(_dot(way, way))
        # no direction is defined between two elements at the same position
        if length == 0:
            return 0j
        rays = [_unit(way)]
        for mirror in reversed(sequence):
            # trace back from the UAV: the last ray is known, and each earlier ray is its mirror image
            rays.insert(0, _plus(rays[0], mirror.normal, -2.0 * _dot(mirror.normal, rays[0])))
        wave = element_wave(tower, tx, tower.mount, rays[0])
        for mirror, ray, onward in zip(sequence, rays[:-1], rays[1:], strict=True):
            wave = self._reflected(mirror, wave, ray, onward)
        received = element_wave(uav, rx, uav_turn, (-rays[-1][0], -rays[-1][1], -rays[-1][2]))
        wavelength = C_MPS / self.link.carrier_hz
        coupling = sum(a * b for a, b in zip(received, wave, strict=True))
        # limit to the transmitted power: the free-space formula is not valid in the near field
        spreading = min(1.0, wavelength / (4 * math.pi * length))
        # subtract full cycles before the exponential: at 3.4 GHz, 1 km is 11 000 cycles
        return coupling * spreading * cmath.exp(-2j * math.pi * math.fmod(length / wavelength, 1.0))

    def _reflected(self, mirror: Mirror, wave: _Wave, ray: Vector, onward: Vector) -> _Wave:
        cosine = min(1.0, abs(_dot(mirror.normal, ray)))
        across = _cross(ray, mirror.normal)
        if math.sqrt(_dot(across, across)) < 1e-12:  # normal incidence: any direction is valid
            across = _cross(mirror.normal, (1.0, 0.0, 0.0) if abs(mirror.normal[0]) < 0.9 else (0.0, 1.0, 0.0))
        s = _unit(across)
        p_in, p_out = _cross(s, ray), _cross(s, onward)
        constants = permittivity(mirror.material, self.link.carrier_hz)
        if constants is None:
            raise LookupError(mirror.material)
        te, tm = fresnel(cosine, *constants, C_MPS / self.link.carrier_hz)
        e_s = sum(a * b for a, b in zip(s, wave, strict=True))
        e_p = sum(a * b for a, b in zip(p_in, wave, strict=True))
        e = [te * e_s * s[k] + tm * e_p * p_out[k] for k in range(3)]
        return e[0], e[1], e[2]

    def loss_db(self, sequence: Sequence[Mirror], target: Vector) -> float | None:
        """Return the foliage and reflection loss of a path [dB]. None if the path only just touches an opaque tree."""
        total = self.loss.reflection_db * len(sequence)
        if self.loss.model == "none" or not len(self.site.trees):
            return total
        points = _bounces(sequence, self.source, target)
        if points is None:
            return None
        depth = trunks = 0.0
        for a, b in itertools.pairwise(points):
            depth += crown_depth_m(self.site.trees, a, b)
            if self.loss.model == "opaque":
                trunks += crown_depth_m(self.site.trees, a, b, trunks=True)
        if self.loss.model == "opaque":
            touched = depth + trunks
            # rounding decides whether a chord of a micrometre exists, so do not judge it
            return None if 0 < touched < 1e-6 else (math.inf if touched else total)
        return total + foliage_db(self.loss, depth, self.link.carrier_hz)

    def matrix(
        self, paths: Sequence[tuple[Sequence[Mirror], float]], target: Vector, turn: Matrix
    ) -> tuple[ComplexArray, float]:
        """Return H (uav elements, tower elements) of paths with losses [dB], and the sum of their mean powers."""
        uav, tower = len(self.link.uav.positions_m), len(self.link.towers[self.tower].positions_m)
        h = np.zeros((uav, tower), dtype=np.complex128)
        power = 0.0
        for sequence, loss in paths:
            # the factor applies to the amplitude, so the exponent is half of that for a power
            factor = 0.0 if math.isinf(loss) else 10 ** (-loss / 20)
            amplitudes = np.array(
                [[factor * self.pair(sequence, t, u, target, turn) for t in range(tower)] for u in range(uav)]
            )
            h += amplitudes
            power += float((np.abs(amplitudes) ** 2).mean())
        return h, power


def fresnel(cosine: float, eta: complex, thickness_m: float | None, wavelength: float) -> tuple[complex, complex]:
    """Return the reflection coefficients (TE, TM) of ITU-R P.2040-4: a half-space (31) or a slab (43), (44).

    Parameters
    ----------
    cosine : float
        Cosine of the angle of incidence from the normal.
    eta : complex
        Relative permittivity.
    thickness_m : float or None
        Thickness of the slab [m]. None means a half-space.
    wavelength : float
        Wavelength in vacuum [m].

    Returns
    -------
    te, tm : complex
    """
    refracted = cmath.sqrt(eta - (1 - cosine * cosine))
    te, tm = (cosine - refracted) / (cosine + refracted), (eta * cosine - refracted) / (eta * cosine + refracted)
    if thickness_m is None:
        return te, tm
    q = 2 * math.pi * thickness_m / wavelength * refracted
    echo = cmath.exp(-2j * q)
    return te * (1 - echo) / (1 - te * te * echo), tm * (1 - echo) / (1 - tm * tm * echo)


def element_wave(array: ExpectedArray, number: int, turn: Matrix, ray: Vector) -> _Wave:
    """Return the field of an element along ``ray`` in site axes, by TR 38.901 7.3.2, model 2.

    Parameters
    ----------
    array : ExpectedArray
    number : int
        Number of the element.
    turn : (3, 3)
        Rotation from device to site axes.
    ray : (3,)
        Unit vector away from the device.

    Returns
    -------
    (3,) complex
    """
    back: Matrix = tuple(zip(*turn, strict=True))  # type: ignore[assignment]
    x, y, z = _times(back, ray)
    # use atan2, because acos(z) loses half of the digits near the poles
    theta, phi = math.atan2(math.hypot(x, y), z), math.atan2(y, x)
    e_theta, e_phi = array.patterns[number](theta, phi)
    slant = math.radians(array.slants_deg[number])
    f_theta = math.cos(slant) * e_theta - math.sin(slant) * e_phi
    f_phi = math.sin(slant) * e_theta + math.cos(slant) * e_phi
    theta_hat = _times(turn, (math.cos(theta) * math.cos(phi), math.cos(theta) * math.sin(phi), -math.sin(theta)))
    phi_hat = _times(turn, (-math.sin(phi), math.cos(phi), 0.0))
    e = [f_theta * theta_hat[k] + f_phi * phi_hat[k] for k in range(3)]
    return e[0], e[1], e[2]


def _bounces(sequence: Sequence[Mirror], source: Vector, target: Vector) -> list[Vector] | None:
    """Return source, reflection points and target of a path between array centres, or None if there is no path."""
    images = [source]
    for mirror in sequence:
        images.append(mirror.mirrored(images[-1]))
    points = [target]
    for mirror, image in zip(reversed(sequence), reversed(images[1:]), strict=True):
        # the image lies behind the mirror, and the next point in front of it
        ahead, behind = mirror.height(points[0]), -mirror.height(image)
        if ahead + behind <= 0:
            return None
        share = behind / (ahead + behind)
        points.insert(0, _plus(image, _plus(points[0], image, -1.0), share))
    return [source, *points]


# ---------------------------------------------------------------- foliage


def foliage_db(loss: ExpectedLoss, depth_m: float, carrier_hz: float) -> float:
    """Return the loss in foliage [dB] by ITU-R P.833 woodland. For leafless trees, gamma is divided by 1.2."""
    gamma, largest = _p833(carrier_hz / 1e6)
    gamma = gamma / (1.0 if loss.in_leaf else 1.2) if loss.gamma_db_per_m is None else loss.gamma_db_per_m
    largest = largest if loss.maximum_db is None else loss.maximum_db
    return largest * (1 - math.exp(-gamma * depth_m / largest))


def _p833(mhz: float) -> tuple[float, float]:
    """Return the specific attenuation and the largest loss, interpolated between the entries of P.833 in logarithms."""
    table = [
        (105.9, 0.04, 9.4), (466.475, 0.12, 18.0), (949.0, 0.17, 26.5), (1852.2, 0.30, 29.0), (2117.5, 0.34, 34.1),
    ]  # fmt: skip
    if mhz <= table[0][0] or mhz >= table[-1][0]:
        f, gamma, largest = table[0] if mhz <= table[0][0] else table[-1]
        return gamma * (mhz / f) ** 0.70, largest * (mhz / f) ** 0.43
    for low, high in itertools.pairwise(table):
        if mhz <= high[0]:
            share = math.log(mhz / low[0]) / math.log(high[0] / low[0])
            return low[1] * (high[1] / low[1]) ** share, low[2] * (high[2] / low[2]) ** share
    raise AssertionError(mhz)


def crown_depth_m(trees: Trees, a: Vector, b: Vector, *, trunks: bool = False) -> float:
    """Return the length of a segment inside crowns (cones) or trunks (cylinders).

    The largest of the signed distances from base, top and side is a convex function along the segment. Golden section
    finds the minimum of this function, and bisection the two ends of the chord.

    Parameters
    ----------
    trees : Trees
    a, b : (3,)
        Ends of the segment [m].
    trunks : bool
        If true, use the trunks (cylinders below the cones) instead of the crowns.

    Returns
    -------
    float
        Length [m].
    """
    start, step = np.array(a), np.array(b) - np.array(a)
    length = float(np.sqrt((step**2).sum()))
    base = trees.ground_m if trunks else trees.ground_m + trees.crown_base_m
    top = trees.ground_m + (trees.crown_base_m if trunks else trees.height_m)
    radius = (trees.trunk_diameter_m if trunks else trees.crown_diameter_m) / 2
    flat = step[0] ** 2 + step[1] ** 2
    east, north = trees.east_m - start[0], trees.north_m - start[1]
    # compare in plan first, because most trees are far from the segment
    near = np.clip((east * step[0] + north * step[1]) / flat, 0, 1) if flat > 0 else np.zeros(len(trees))
    close = np.hypot(east - near * step[0], north - near * step[1]) < radius
    close &= (min(a[2], b[2]) < top) & (max(a[2], b[2]) > base) & (radius > 0) & (top > base)
    rows = np.flatnonzero(close)
    if not len(rows) or length == 0:
        return 0.0
    east, north, low, high, wide = east[rows], north[rows], base[rows], top[rows], radius[rows]

    def outside(t: FloatArray) -> FloatArray:
        up = start[2] + t * step[2]
        side = np.hypot(t * step[0] - east, t * step[1] - north)
        reach = wide if trunks else wide * (high - up) / (high - low)
        return np.asarray(np.maximum(np.maximum(low - up, up - high), side - reach))

    left, right, ratio = np.zeros(len(rows)), np.ones(len(rows)), (math.sqrt(5) - 1) / 2
    # 70 steps are enough: 0.618 to the power of 70 is 2e-15, about the rounding error
    for _ in range(70):
        near_left, near_right = right - ratio * (right - left), left + ratio * (right - left)
        lower = outside(near_left) < outside(near_right)
        left, right = np.where(lower, left, near_left), np.where(lower, near_right, right)
    middle = (left + right) / 2
    inside = outside(middle) < 0
    ends = []
    # bisect from the minimum, which is inside, to both ends of the segment
    for edge in (0.0, 1.0):
        within, beyond = middle, np.full(len(rows), edge)
        for _ in range(50):
            half = (within + beyond) / 2
            good = outside(half) < 0
            within, beyond = np.where(good, half, within), np.where(good, beyond, half)
        ends.append(np.where(outside(np.full(len(rows), edge)) < 0, edge, within))
    return float(((ends[1] - ends[0]) * inside).sum() * length)
