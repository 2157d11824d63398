"""Antenna arrays, poses and the link between a tower and the UAV.

Device frame of every array: x forward (boresight), y left, z up. A pattern is given in that frame by zenith
angle theta and azimuth phi (from x towards y). Rotations are (3, 3) matrices that turn device coordinates into
site coordinates (east, north, up): ``v_site = R @ v_device``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from ...common.units import THERMAL_NOISE_DBM_HZ, ComplexArray, FloatArray, unmasked
from ...site.antenna.antennas import Isotropic as Isotropic


class Pattern(Protocol):
    """An element's far field.

    ``field(theta_rad, phi_rad)`` gives complex ``(E_theta, E_phi)`` of the broadcast shape, scaled so that
    ``|E_theta|^2 + |E_phi|^2`` is the gain (linear, over isotropic).
    """

    @property
    def name(self) -> str:
        """For reports."""
        ...

    def field(self, theta_rad: FloatArray, phi_rad: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        """Complex field components (theta, phi)."""
        ...


@dataclass(frozen=True, slots=True)
class Array:
    """Elements (ports) of one device.

    Parameters
    ----------
    positions_m : (elements, 3)
        In the device frame.
    slant_rad : (elements,)
        Slant of each element: 0 vertical, pi/2 horizontal.
    patterns : tuple of Pattern
        One per element, or one shared by all.
    mount : (3, 3)
        Rotation of the device frame in its carrier (tower: site axes; UAV: aircraft body, forward-left-up).
    """

    positions_m: FloatArray
    slant_rad: FloatArray
    patterns: tuple[Pattern, ...] = (Isotropic(),)
    mount: FloatArray = field(default_factory=lambda: np.eye(3))

    def __len__(self) -> int:
        return len(self.positions_m)

    @property
    def slant_parts(self) -> FloatArray:
        """Cosines and sines (2, elements) of the slants: the vertical and the horizontal part of each element."""
        # model 2 of TR 38.901: a slanted element is this sum of a vertical and a horizontal one
        return np.stack([np.cos(self.slant_rad), np.sin(self.slant_rad)])


@dataclass(frozen=True, slots=True)
class Poses:
    """Positions and attitudes of the UAV.

    Parameters
    ----------
    position_m : (poses, 3)
        Array centre, east-north-up [m].
    rotation : (poses, 3, 3)
        Aircraft body (forward-left-up) to site frame.
    """

    position_m: FloatArray
    rotation: FloatArray

    def __len__(self) -> int:
        return len(self.position_m)

    def __getitem__(self, rows: Any) -> Poses:
        return Poses(self.position_m[rows], self.rotation[rows])


@dataclass(frozen=True, slots=True)
class Link:
    """Radio settings of a replay.

    ``tower_arrays`` maps tower names to arrays, in replay order. The channel matrix is always
    ``(n_rx, n_tx)``; ``uav_transmits`` decides which end is which. A link received below ``noise_floor_dbm`` is out of
    coverage; by default that is the thermal noise of 1 Hz, which no receiver hears beneath.
    """

    carrier_hz: float
    tower_arrays: Mapping[str, Array]
    uav_array: Array
    transmit_power_dbm: float = 40.0
    uav_transmits: bool = True
    noise_floor_dbm: float = THERMAL_NOISE_DBM_HZ


def rotation_from_yaw_pitch_roll(yaw_rad: FloatArray, pitch_rad: FloatArray, roll_rad: FloatArray) -> FloatArray:
    """Device-to-site rotation of 3GPP TR 38.901 eq. (7.1-4): ``Rz(yaw) Ry(pitch) Rx(roll)``.

    Source: 3GPP TR 38.901 eq. 7.1-4.

    Parameters
    ----------
    yaw_rad, pitch_rad, roll_rad : array_like, broadcastable to (...)
        Counter-clockwise yaw from east; positive pitch turns the boresight **down**; roll about the boresight.

    Returns
    -------
    ndarray, (..., 3, 3)

    Examples
    --------
    >>> r = rotation_from_yaw_pitch_roll(np.pi / 2, 0.0, 0.0)  # boresight to the north
    >>> (r @ [1, 0, 0]).round(12).tolist()
    [0.0, 1.0, 0.0]
    """
    yaw, pitch, roll = np.broadcast_arrays(
        unmasked(yaw_rad),
        unmasked(pitch_rad),
        unmasked(roll_rad),
    )
    # written out: one pass over a whole flight, where a product of three turns makes three
    ca, sa = np.cos(yaw), np.sin(yaw)
    cb, sb = np.cos(pitch), np.sin(pitch)
    cg, sg = np.cos(roll), np.sin(roll)
    return np.stack(
        [
            np.stack([ca * cb, ca * sb * sg - sa * cg, ca * sb * cg + sa * sg], axis=-1),
            np.stack([sa * cb, sa * sb * sg + ca * cg, sa * sb * cg - ca * sg], axis=-1),
            np.stack([-sb, cb * sg, cb * cg], axis=-1),
        ],
        axis=-2,
    )


def rotation_from_aircraft(roll_deg: FloatArray, pitch_deg: FloatArray, yaw_deg: FloatArray) -> FloatArray:
    """Body-to-site rotation of an aircraft attitude.

    Parameters
    ----------
    roll_deg, pitch_deg, yaw_deg : array_like
        Right wing down +, nose up +, heading clockwise from north (aerospace convention).

    Returns
    -------
    ndarray, (..., 3, 3)
        Body axes forward-left-up to east-north-up.

    Examples
    --------
    >>> r = rotation_from_aircraft(0.0, 0.0, 90.0)  # heading east
    >>> (r @ [1, 0, 0]).round(12).tolist()
    [1.0, 0.0, 0.0]
    """
    # nose up + turns the boresight up, TR 38.901 pitch turns it down; right wing down is a positive roll in both
    return rotation_from_yaw_pitch_roll(np.pi / 2 - np.radians(yaw_deg), -np.radians(pitch_deg), np.radians(roll_deg))


def rotation_from_axes(yaw_deg: FloatArray, up: FloatArray) -> FloatArray:
    """Body-to-site rotation (n, 3, 3) of noses that head ``yaw_deg`` (n,) and upward axes ``up``, (3,) or (n, 3).

    Examples
    --------
    >>> roll, pitch, yaw = np.array([[5.0], [-9.0], [70.0]])
    >>> leaning = rotation_from_aircraft(roll, pitch, yaw)
    >>> np.allclose(rotation_from_axes(yaw, leaning[:, :, 2]), leaning)
    True
    """
    yaw, up = np.radians(yaw_deg), np.broadcast_to(up, (len(yaw_deg), 3))
    nose = np.stack([np.sin(yaw), np.cos(yaw), 0.0 * yaw], axis=1)
    # level, then down along the vertical until it is square to the upward axis: its bearing stays
    nose[:, 2] = -(nose * up).sum(axis=1) / up[:, 2]
    nose /= np.linalg.norm(nose, axis=1, keepdims=True)
    return np.stack([nose, np.cross(up, nose), up], axis=2)


# Ports of the measurement comparison in arXiv 2502.10324, section VII-D
# Positions along the tower array: spacings 60 mm, 1.68 m, 60 mm.
_TOWER_PORTS_M = (0.0, 0.060, 1.740, 1.800)


def _centred_line(along_m: FloatArray) -> FloatArray:
    # across the boresight, which is x
    positions = np.zeros((len(along_m), 3))
    positions[:, 1] = along_m.mean() - along_m  # first port leftmost (+y)
    return positions


def _mounted(
    positions_m: FloatArray,
    slant_deg: tuple[float, ...],
    pattern: Pattern | None,
    yaw_deg: float,
    roll_deg: float = 0.0,
) -> Array:
    """Elements of one pattern in a device that is turned and rolled."""
    # no pitch: the arrays of the paper and of maps look level
    mount = rotation_from_yaw_pitch_roll(*np.radians([yaw_deg, 0.0, roll_deg]))
    return Array(positions_m, np.radians(np.array(slant_deg)), (pattern or Isotropic(),), mount)


def tower_comparison_array(
    yaw_deg: float = 45.0, slant_deg: tuple[float, ...] = (45.0, -45.0, 45.0, -45.0), pattern: Pattern | None = None
) -> Array:
    """Tower array of the comparison: 4 ports, 60 mm / 1.68 m / 60 mm, horizontal, ports slanted alternately."""
    return _mounted(_centred_line(np.array(_TOWER_PORTS_M)), slant_deg, pattern, yaw_deg)


def uav_comparison_array(
    wavelength_m: float,
    yaw_deg: float = 315.0,
    roll_deg: float = 90.0,
    slant_deg: tuple[float, ...] = (45.0, -45.0, -45.0, 45.0),
    pattern: Pattern | None = None,
) -> Array:
    """UAV array of the comparison: 2 x 2 at half a wavelength, rolled by 90 degrees, numbered column first.

    Slants alternate between neighbours in both directions. Which mounting the modem had is not published: with the
    tower at 12 m this one leaves a total variation of 0.06 and 0.09 to the measured ranks of two flights at K = 10,
    alternating along the numbering 0.07 and 0.11.

    Parameters
    ----------
    wavelength_m : float
        Elements are half of it apart [m].
    yaw_deg, roll_deg : float
        Mount: counter-clockwise from the nose (or east), about the boresight [deg].
    slant_deg : tuple of 4 float
        Polarisation of each port from vertical [deg].
    pattern : Pattern, optional
        Of every element; isotropic by default.

    Returns
    -------
    Array
        Of four ports.
    """
    half = wavelength_m / 4
    # the left column first, its upper port before its lower one
    positions = np.array([[0, half, half], [0, half, -half], [0, -half, half], [0, -half, -half]])
    return _mounted(positions, slant_deg, pattern, yaw_deg, roll_deg)


def linear_array(elements: int, spacing_m: float, yaw_deg: float = 90.0, pattern: Pattern | None = None) -> Array:
    """Horizontal line of vertical elements; the paper's maps use 4 at half a wavelength along the y axis.

    Parameters
    ----------
    elements : int
    spacing_m : float
        Between neighbours [m].
    yaw_deg : float
        Of the boresight, counter-clockwise from east; the line is across it [deg].
    pattern : Pattern, optional
        Of every element; isotropic by default.

    Returns
    -------
    Array
        Centred on its position, boresight horizontal.
    """
    along = np.arange(elements, dtype=np.float64) * spacing_m
    return _mounted(_centred_line(along), (0.0,) * elements, pattern, yaw_deg)


def single_element(pattern: Pattern | None = None, mount: FloatArray | None = None) -> Array:
    """One vertical element at the device centre."""
    return Array(np.zeros((1, 3)), np.zeros(1), (pattern or Isotropic(),), np.eye(3) if mount is None else mount)
