"""Channels of many antenna geometries at once, on line of sight and ground reflection.

Which way a modem's antennas point and how its ports are slanted is hardly ever written down. Trying thousands of
geometries takes no thousand replays: the field of an element slanted by ``s`` is ``cos s`` times that of a vertical
plus ``sin s`` times that of a horizontal one at the same place, so one evaluation with both at every port
(:func:`aerpaw_cmp.propagation.field.sum.channel_matrices`, float64, every pair of elements) serves all slants, and the
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

from ...common.units import ComplexArray, FloatArray
from ..field.sum import channel_matrices
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
    # two rays, and both slants at either end: four pairs for one
    work = 2 * len(runs) * len(poses) * 4 * len(tower) * len(uav)
    for mount, run in runs:
        turned = dataclasses.replace(uav, mount=np.asarray(rotation_from_yaw_pitch_roll(*map(np.radians, mount))))
        fields = basis_fields(tower, tower_m, turned, poses, carrier_hz, any(g.ground for g in run), work)
        for g in run:
            at_uav, at_tower = slant_basis(g.uav_slant_deg), slant_basis(g.tower_slant_deg).T
            # two small products instead of a field for each slant
            los, ground = (at_uav @ field @ at_tower for field in fields)
            ground *= g.ground
            yield np.linalg.svd(los + ground, compute_uv=False) if g.sum == "coherent" else _of_power_sum(los, ground)


def _of_power_sum(los: ComplexArray, ground: ComplexArray) -> FloatArray:
    covariance = los @ _hermitian(los) + ground @ _hermitian(ground)
    # the eigenvalues of a Hermitian matrix come ascending; rounding leaves the zero ones slightly negative
    return np.asarray(np.sqrt(np.maximum(np.linalg.eigvalsh(covariance)[..., ::-1], 0.0)))


def _hermitian(matrix: ComplexArray) -> ComplexArray:
    return np.asarray(np.conj(np.swapaxes(matrix, -1, -2)))


def basis_fields(
    tower: Array,
    tower_m: FloatArray,
    uav: Array,
    poses: Poses,
    carrier_hz: float,
    with_ground: bool = True,
    work: int = 0,
) -> tuple[ComplexArray, ComplexArray]:
    """Channel matrices (n, 2 uav ports, 2 tower ports) of line of sight and of the ground reflection alone.

    Each port is there twice, vertical then horizontal: :func:`slant_basis` combines them.

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
    work : int
        See :func:`~aerpaw_cmp.propagation.field.sum.channel_matrices`.

    Returns
    -------
    direct, bounced : (n, 2 uav ports, 2 tower ports) complex
    """
    link = Link(carrier_hz, {"tower": _both_slants(tower)}, _both_slants(uav), uav_transmits=False)
    faces = Faces(np.array([[0.0, 0.0, 1.0]]), np.zeros(1), (_GROUND_MATERIAL,), ("ground",))
    n = len(poses)
    index, zero = np.arange(n), np.zeros(n, dtype=np.int64)
    fields = []
    for depth in (0, 1) if with_ground else (0,):
        # the reflection point is NaN: the field asks for images alone, never for points
        path = PathSet(index, zero, zero + depth, np.full((n, 1), depth - 1), np.full((n, 1, 3), np.nan))
        fields.append(channel_matrices(path, faces, np.asarray(tower_m)[None, :], poses, link, work=work).h[:, 0])
    return fields[0], fields[1] if with_ground else np.zeros_like(fields[0])


def _both_slants(array: Array) -> Array:
    return dataclasses.replace(
        array,
        # port by port, vertical before horizontal, as slant_basis reads them
        positions_m=np.repeat(array.positions_m, 2, axis=0),
        slant_rad=np.tile([0.0, np.pi / 2.0], len(array)),
        patterns=array.patterns if len(array.patterns) == 1 else tuple(p for p in array.patterns for _ in range(2)),
    )


def slant_basis(slant_deg: Sequence[float]) -> FloatArray:
    """Matrix (ports, 2 ports) from vertical and horizontal elements to slanted ones.

    Examples
    --------
    >>> slant_basis([0.0, 90.0]).round(6).tolist()
    [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
    """
    slant = np.radians(np.asarray(slant_deg, dtype=np.float64))
    result = np.zeros((len(slant), 2 * len(slant)))
    port = np.arange(len(slant))
    result[port, 2 * port], result[port, 2 * port + 1] = np.cos(slant), np.sin(slant)
    return result
