"""Paths over one edge a second time: plain loops, each path by minimising its length, formulas as printed.

As :mod:`aerpaw_cmp.propagation.check.reference` it shares no code with the search and the field. Edges come from the
footprints, the transition function from Fresnel integrals and its asymptotic series, cotangents with the integers of
Kouyoumjian and Pathak (Proc. IEEE 62 (1974) 1448).
"""

from __future__ import annotations

import cmath
import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import fresnel as fresnel_integrals

from ...common.units import ComplexArray, FloatArray
from .reference import C_MPS, MARGIN_M, Matrix, Reference, Vector, element_wave, fresnel, permittivity, product

# Share of an edge's length beside its ends where nothing is judged.
_NEAR_EDGE = 1e-6


@dataclass(frozen=True, slots=True)
class Corner:
    """An edge of a building: its ends, outward normals of both faces, direction into face 0, exterior angle over pi."""

    start: FloatArray
    end: FloatArray
    out: FloatArray
    out_n: FloatArray
    into: FloatArray
    exterior: float
    material: str
    solid: int


def _corners_of(reference: Reference) -> Iterator[Corner]:
    """Rims and convex upright corners of the site's buildings without holes."""
    ground = reference.site.towers[reference.tower].ground_m
    for number, building in enumerate(reference.site.buildings):
        ring = list(building.footprint.normalize().exterior.coords)[:-1]
        ring = ring if building.footprint.normalize().exterior.is_ccw else ring[::-1]
        top = building.base_m + building.height_m
        if top - max(ground, min(building.base_m, 0.0) - 0.5) <= C_MPS / reference.link.carrier_hz / 2:
            continue
        for i, corner in enumerate(ring):
            a, b, before = (np.array(p[:2]) for p in (corner, ring[(i + 1) % len(ring)], ring[i - 1]))
            wall, last = (b - a) / np.linalg.norm(b - a), (a - before) / np.linalg.norm(a - before)
            out, out_last = np.array([wall[1], -wall[0], 0.0]), np.array([last[1], -last[0], 0.0])
            up = np.array([0.0, 0.0, 1.0])
            rim = Corner(
                start=np.append(a, top), end=np.append(b, top), out=out, out_n=up, into=-up, exterior=1.5,
                material=building.material, solid=number,
            )  # fmt: skip
            yield rim
            turn = math.atan2(last[0] * wall[1] - last[1] * wall[0], float(last @ wall))
            if turn > 1e-6:
                foot = np.append(a, max(ground, min(building.base_m, 0.0) - 0.5))
                into, exterior = np.append(-last, 0.0), 1 + turn / math.pi
                yield replace(rim, start=foot, end=rim.start, out=out_last, out_n=out, into=into, exterior=exterior)


def bent_matrix(reference: Reference, target: Vector, turn: Matrix) -> tuple[int, ComplexArray, float] | None:
    """Paths over one edge with at most one ground reflection a side: how many, what they add to H, and their power.

    Parameters
    ----------
    reference : Reference
    target, turn
        As of :meth:`Reference.pair`.

    Returns
    -------
    count : int
    h : (uav elements, tower elements) complex
    power : float
        Mean power of each path, summed.

    None where a change of the geometry by some micrometres would decide.
    """
    tower = reference.link.towers[reference.tower]
    h = np.zeros((len(reference.link.uav.positions_m), len(tower.positions_m)), dtype=np.complex128)
    count, power = 0, 0.0
    for corner in _corners_of(reference):
        for below in ((False, False), (False, True), (True, False), (True, True)):
            bend = _Bend(reference, corner, below, np.array(target), turn)
            verdict = bend.verdict()
            if verdict is None:
                return None
            if verdict:
                field = bend.field()
                count, power = count + 1, power + float((np.abs(field) ** 2).mean())
                h += field
    return count, h, power


class _Bend:
    """One path over an edge, with the ground below the source's leg, the target's, or neither."""

    def __init__(
        self, reference: Reference, corner: Corner, below: tuple[bool, bool], target: FloatArray, turn: Matrix
    ) -> None:
        self.reference, self.corner, self.turn = reference, corner, turn
        self.ground = reference.site.towers[reference.tower].ground_m
        self.below, self.real = below, (np.array(reference.source), target)
        self.ends = tuple(self._image(p) if low else p for p, low in zip(self.real, below, strict=True))

    def _image(self, point: FloatArray) -> FloatArray:
        return np.array([point[0], point[1], 2.0 * self.ground - point[2]])

    def verdict(self) -> bool | None:
        """Check whether the path exists; None where that is a matter of rounding."""
        from scipy.optimize import minimize_scalar  # few audits have edges

        c = self.corner
        sides = [max((p - c.start) @ c.out, (p - c.start) @ c.out_n) for p in self.ends]
        if min(sides) < -MARGIN_M:
            return False

        def length(x: float) -> float:
            return sum(float(np.linalg.norm(c.start + x * (c.end - c.start) - p)) for p in self.ends)

        best = minimize_scalar(length, bounds=(-0.01, 1.01), method="bounded", options={"xatol": 1e-13}).x
        if not -_NEAR_EDGE < best < 1 + _NEAR_EDGE:
            return False
        self.point = c.start + best * (c.end - c.start)
        if any(self.below) and self.point[2] - self.ground < 0.01:
            return False
        if min(abs(best), abs(1 - best)) <= _NEAR_EDGE or min(sides) < MARGIN_M:
            return None
        loose = strict = False
        for a, b, spared in self._legs():
            loose = loose or self.reference.blocks.cut(a, b, -MARGIN_M, spared)
            strict = strict or self.reference.blocks.cut(a, b, MARGIN_M, spared)
        return False if loose else None if strict else True

    def _legs(self) -> Iterator[tuple[Vector, Vector, tuple[int, ...]]]:
        for image, real, low in zip(self.ends, self.real, self.below, strict=True):
            spots = [real, self.point]
            if low:
                share = (image[2] - self.ground) / (image[2] - self.point[2])
                spots.insert(1, image + share * (self.point - image))
            for step, (a, b) in enumerate(itertools.pairwise(spots)):
                first, second = (tuple(p.tolist()) for p in (a, b))
                yield first, second, (self.corner.solid,) if step == len(spots) - 2 else ()  # type: ignore[misc]

    def field(self) -> ComplexArray:
        """Amplitudes (uav elements, tower elements): the dyad of the centres, the length of each pair."""
        c, link = self.corner, self.reference.link
        tower, uav, uav_turn = link.towers[self.reference.tower], link.uav, product(self.turn, link.uav.mount)
        wavelength = C_MPS / link.carrier_hz
        edge = np.cross(c.into, c.out)
        legs = self.point - self.ends[0], self.ends[1] - self.point
        near, far = (float(np.linalg.norm(leg)) for leg in legs)
        before, after = legs[0] / near, legs[1] / far
        cosine = float(before @ edge)
        matrix = self._wedge(near, far, before, after, cosine, wavelength)
        bases = [np.array([edge - cosine * s, np.cross(edge, s)]) / math.sqrt(1 - cosine**2) for s in (before, after)]
        sent = [self._wave(tower, i, tower.mount, before, 0) for i in range(len(tower.positions_m))]
        received = [self._wave(uav, i, uav_turn, -after, 1) for i in range(len(uav.positions_m))]
        places = [self._places(a, t, side) for side, (a, t) in enumerate(((tower, tower.mount), (uav, uav_turn)))]
        amplitude = wavelength / (4 * math.pi) / math.sqrt(near * far)
        h = np.zeros((len(received), len(sent)), dtype=np.complex128)
        for (u, s), (t, w) in itertools.product(enumerate(received), enumerate(sent)):
            (x, r), (y, q) = places[1][u], places[0][t]
            total = math.hypot(r + q, x - y)
            coupling = complex((bases[1] @ s) @ (matrix @ (bases[0] @ w)))
            carrier = cmath.exp(-2j * math.pi * math.fmod(total / wavelength, 1.0))
            h[u, t] = coupling * amplitude / math.sqrt(total) * carrier
        return h

    def _wave(self, array: object, number: int, turn: Matrix, ray: FloatArray, side: int) -> ComplexArray:
        """Field that an element radiates along its leg, as it is at the edge's end of it."""
        mirror = np.array([1.0, 1.0, -1.0]) if self.below[side] else np.ones(3)
        wave: ComplexArray = np.array(element_wave(array, number, turn, tuple((ray * mirror).tolist())))  # type: ignore[arg-type]
        if not self.below[side]:
            return wave
        constants = permittivity(self.reference.site.ground_material, self.reference.link.carrier_hz)
        if constants is None:
            raise LookupError(self.reference.site.ground_material)
        leaving = ray * mirror
        te, tm = fresnel(abs(float(leaving[2])), *constants, C_MPS / self.reference.link.carrier_hz)
        across = np.cross(leaving, [0.0, 0.0, 1.0])
        across /= np.linalg.norm(across)
        upright = np.cross(across, leaving)
        return np.asarray(te * (across @ wave) * across - tm * (upright @ wave) * (upright * mirror))

    def _places(self, array: object, turn: Matrix, side: int) -> list[tuple[float, float]]:
        """Place along the edge and distance from it of each element, mirrored with its leg."""
        c, places = self.corner, []
        way = (c.end - c.start) / np.linalg.norm(c.end - c.start)
        for position in array.positions_m:  # type: ignore[attr-defined]
            spot = self.real[side] + np.array(turn) @ np.array(position)
            apart = (self._image(spot) if self.below[side] else spot) - c.start
            along = float(apart @ way)
            sign = 1.0 if way @ np.cross(c.into, c.out) > 0 else -1.0
            places.append((sign * along, float(np.linalg.norm(apart - along * way))))
        return places

    def _wedge(
        self, near: float, far: float, before: FloatArray, after: FloatArray, cosine: float, wavelength: float
    ) -> ComplexArray:
        """Matrix of the wedge over (after, before) and (beta, phi)."""
        c, k = self.corner, 2 * math.pi / wavelength
        n, sine = c.exterior, math.sqrt(1 - cosine**2)
        first, last = (math.atan2(v @ c.out, v @ c.into) % (2 * math.pi) for v in (-before, after))
        kl = k * near * far * sine**2 / (near + far)
        less, more = last - first, last + first
        shadow = _cotangent(less, 1, n, kl) + _cotangent(less, -1, n, kl)
        faces = _cotangent(more, 1, n, kl) + _cotangent(more, -1, n, kl)
        half = (math.pi - less) / 2
        flat = math.sin(first / n) * math.sin(last / n) * abs(math.sin(half))
        flat = min(flat / abs(math.sin(half / n) * math.sin((math.pi + less) / (2 * n))), 1.0)
        constants = permittivity(c.material, self.reference.link.carrier_hz)
        if constants is None:
            raise LookupError(c.material)
        te, tm = fresnel(flat * sine, *constants, wavelength)
        size = math.hypot(cosine * flat, math.cos(half))
        a, b = math.cos(half) / size, cosine * flat / size
        face = np.array([[te * a * a - tm * b * b, (te + tm) * a * b], [-(te + tm) * a * b, tm * a * a - te * b * b]])
        scale = -cmath.exp(-0.25j * math.pi) / (2 * n * math.sqrt(2 * math.pi * k) * sine)
        return np.asarray(scale * (shadow * np.eye(2) + faces * face))


def _transition(x: float) -> complex:
    """F by Fresnel integrals; its series where they cancel."""
    if x > 40.0:
        return 1 + 1j / (2 * x) - 3 / (4 * x**2) - 15j / (8 * x**3) + 75 / (16 * x**4)
    sine, cosine = fresnel_integrals(math.sqrt(2 * x / math.pi))
    tail = complex(0.5 - float(cosine), float(sine) - 0.5)
    return 2j * math.sqrt(x) * cmath.exp(1j * x) * math.sqrt(math.pi / 2) * tail


def _cotangent(angle: float, sign: int, n: float, kl: float) -> complex:
    """``cot((pi + sign angle) / 2n) F(k L a)`` with the integer N of Kouyoumjian and Pathak."""
    integer = min((-1, 0, 1), key=lambda m: abs(2 * math.pi * n * m - angle - sign * math.pi))
    a = 2 * math.cos((2 * n * math.pi * integer - angle) / 2) ** 2
    return _transition(kl * a) / math.tan((math.pi + sign * angle) / (2 * n))
