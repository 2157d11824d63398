"""Channels of many antenna geometries at once, on line of sight and ground reflection.

Which way a modem's antennas point and how its ports are slanted is hardly ever written down. Trying thousands of
geometries takes no thousand replays: the field of an element slanted by ``s`` is ``cos s`` times that of a vertical
plus ``sin s`` times that of a horizontal one at the same place, so one evaluation with both at every port
(:func:`aerpaw_cmp.propagation.field.sum.of_one_depth`, float64, every pair of elements) serves all slants, and the
ground reflection is one ray that is added at any strength.

The rank that a modem reports is for its whole band. Over 100 MHz the ground ray turns against the direct one by about a
cycle where the two differ by 3 m, so beside the coherent sum at the carrier there is the power sum
``L L^H + g^2 G G^H`` over the receiving ports, whose eigenvalues are the squares of the singular values in the mean.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby, product
from typing import Literal

import numpy as np

from ...common.units import ComplexArray, FloatArray, wavelength_m
from ..field.fresnel import FaceMaterials
from ..field.geometry import Elements, geometry
from ..field.sum import PAIRS_PER_CHUNK, of_one_depth, pattern_ends
from ..geometry.arrays import Array, Link, Poses, rotation_from_yaw_pitch_roll
from ..geometry.paths import Faces, PathSet

# How the ground ray is added to the direct one.
Ground = Literal["coherent", "power_sum"]

# The default ground of a site; its strength is what the search fits.
_GROUND_MATERIAL = "itu_medium_dry_ground"


@dataclass(frozen=True, slots=True, kw_only=True)
class Geometry:
    """One way the antennas may hang.

    Parameters
    ----------
    uav_yaw_deg, uav_pitch_deg, uav_roll_deg : float
        Mount of the UAV's array in its carrier: body, or site axes where no attitude is known.
    tower_slant_deg, uav_slant_deg : tuple of float
        Per port; 0 vertical.
    ground : float
        Amplitude factor on the ground reflection: 1 that of a smooth half-space, 0 none.
    sum : {"coherent", "power_sum"}
    """

    uav_yaw_deg: float
    uav_pitch_deg: float
    uav_roll_deg: float
    tower_slant_deg: tuple[float, ...]
    uav_slant_deg: tuple[float, ...]
    ground: float
    sum: Ground = "power_sum"

    @property
    def mount_deg(self) -> tuple[float, float, float]:
        """Yaw, pitch and roll."""
        return self.uav_yaw_deg, self.uav_pitch_deg, self.uav_roll_deg

    def in_words(self) -> str:
        """For tables."""
        slants = "/".join(f"{s:g}" for s in self.uav_slant_deg)
        tower = "/".join(f"{s:g}" for s in self.tower_slant_deg)
        turn = f"yaw {self.uav_yaw_deg:g}, pitch {self.uav_pitch_deg:g}, roll {self.uav_roll_deg:g} deg"
        return f"{turn}; slants UAV {slants}, tower {tower}; ground x {self.ground:g} ({self.sum.replace('_', ' ')})"


def every_geometry(
    mounts_deg: Sequence[tuple[float, float, float]],
    tower_slants_deg: Sequence[tuple[float, ...]],
    uav_slants_deg: Sequence[tuple[float, ...]],
    grounds: Sequence[float],
    sums: Sequence[Ground] = ("power_sum",),
) -> tuple[Geometry, ...]:
    """All combinations; mounts are (yaw, pitch, roll). Geometries of one mount follow each other.

    Parameters
    ----------
    mounts_deg : sequence of (yaw, pitch, roll)
        Of the UAV's array [deg].
    tower_slants_deg, uav_slants_deg : sequence of tuple of float
        Polarisation of each port from vertical [deg].
    grounds : sequence of float
        Strength of the ground reflection against Fresnel's.
    sums : sequence of {"power_sum", "coherent", ...}
        How the two rays add up.

    Returns
    -------
    tuple of Geometry
    """
    return tuple(
        Geometry(
            uav_yaw_deg=yaw, uav_pitch_deg=pitch, uav_roll_deg=roll, tower_slant_deg=tower, uav_slant_deg=uav,
            ground=ground, sum=how,
        )
        for (yaw, pitch, roll), tower, uav, how, ground in product(
            mounts_deg, tower_slants_deg, uav_slants_deg, sums, grounds
        )
    )  # fmt: skip


def singular_values_of(
    geometries: Sequence[Geometry],
    tower: Array,
    tower_m: FloatArray,
    uav: Array,
    poses: Poses,
    carrier_hz: float,
) -> Iterator[FloatArray]:
    """Singular values (n, ports) of each geometry, absolute, descending.

    Parameters
    ----------
    geometries : sequence of Geometry
        In runs of one mount: each run costs one evaluation of the field, two with the ground.
    tower : Array
        Positions, pattern and mount; its slants are those of the geometry.
    tower_m : (3,)
        Array centre, east, north, up over flat ground at 0 [m].
    uav : Array
        Positions and pattern; slants and mount are those of the geometry.
    poses : Poses
    carrier_hz : float

    Yields
    ------
    (n, ports)
        Of the next geometry.

    Notes
    -----
    Over receiving ports at the UAV. With the power sum they are the roots of the eigenvalues of ``L L^H + g^2 G G^H``:
    the mean of ``H H^H`` over a band in which the ground ray takes all phases against the direct one.
    """
    runs = [(mount, list(run)) for mount, run in groupby(geometries, lambda g: g.mount_deg)]
    for mount, run in runs:
        turned = dataclasses.replace(uav, mount=np.asarray(rotation_from_yaw_pitch_roll(*map(np.radians, mount))))
        fields = basis_fields(tower, tower_m, turned, poses, carrier_hz, any(g.ground for g in run))
        for g in run:
            los, ground = (slanted(field, g.uav_slant_deg, g.tower_slant_deg) for field in fields)
            ground *= g.ground
            coherent = g.sum == "coherent"
            yield np.asarray(np.linalg.svd(los + ground, compute_uv=False)) if coherent else _of_power_sum(los, ground)


def _of_power_sum(los: ComplexArray, ground: ComplexArray) -> FloatArray:
    covariance = sum(field @ field.conj().swapaxes(-1, -2) for field in (los, ground))
    # the eigenvalues of a Hermitian matrix come ascending; rounding leaves the zero ones slightly negative
    return np.asarray(np.sqrt(np.maximum(np.linalg.eigvalsh(covariance)[..., ::-1], 0.0)))


def basis_fields(
    tower: Array, tower_m: FloatArray, uav: Array, poses: Poses, carrier_hz: float, with_ground: bool = True
) -> tuple[ComplexArray, ComplexArray]:
    """Channel matrices of line of sight and of the ground reflection alone, ports vertical and horizontal.

    Parameters
    ----------
    tower, uav : Array
        Slants do not count.
    tower_m : (3,)
        [m].
    poses : Poses
    carrier_hz : float
    with_ground : bool
        Otherwise the second is all zeros.

    Returns
    -------
    direct, bounced : (2, 2, n, uav ports, tower ports) complex
        Vertical, then horizontal, at the UAV and at the tower: :func:`slanted` combines them.
    """
    link, wavelength = Link(carrier_hz, {"tower": tower}, uav, uav_transmits=False), wavelength_m(carrier_hz)
    faces = Faces(np.array([[0.0, 0.0, 1.0]]), np.zeros(1), (_GROUND_MATERIAL,), ("ground",))
    table, elements = FaceMaterials.of(faces, carrier_hz).table(wavelength), Elements.of(link)
    n, ports = len(poses), (len(uav), len(tower))
    index, zero, step = np.arange(n), np.zeros(n, dtype=np.int64), max(1, PAIRS_PER_CHUNK // (len(uav) * len(tower)))
    # cosine and sine of the two slants, against (tower's slant, paths, pairs) and (UAV's, tower's, paths, pairs)
    upright, level = np.array([1.0, 0.0]), np.array([0.0, 1.0])
    slants = [(upright.reshape(shape), level.reshape(shape)) for shape in ((2, 1, 1), (2, 1, 1, 1))]
    fields = np.zeros((2, 2, 2, n, *ports), dtype=np.complex128)
    for depth in (0, 1) if with_ground else (0,):
        # the reflection point is NaN: the field asks for images alone, never for points
        path = PathSet(index, zero, zero + depth, np.full((n, 1), depth - 1), np.full((n, 1, 3), np.nan))
        columns = geometry(path, faces, table, np.asarray(tower_m)[None, :], poses, link)
        for start in range(0, n, step):
            some = columns.some(slice(start, start + step))
            parts = of_one_depth(some, elements, pattern_ends(some, elements, link), (slants[0], slants[1]), wavelength)
            fields[depth, :, :, start : start + step] = parts.view(np.complex128).reshape(2, 2, -1, *ports)
    return fields[0], fields[1]


def slanted(field: ComplexArray, uav_slant_deg: Sequence[float], tower_slant_deg: Sequence[float]) -> ComplexArray:
    """Channel matrices (n, uav ports, tower ports) of :func:`basis_fields` for slants of the ports [deg]."""
    at_uav, at_tower = (np.radians(slant) for slant in (uav_slant_deg, tower_slant_deg))
    upright, level = field[:, 0] * np.cos(at_tower) + field[:, 1] * np.sin(at_tower)
    return np.asarray(np.cos(at_uav)[:, None] * upright + np.sin(at_uav)[:, None] * level)
