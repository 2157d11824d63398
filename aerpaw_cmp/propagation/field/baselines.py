"""Closed-form baselines for comparison with ray tracing: free space and two-ray ground reflection."""

from __future__ import annotations

import numpy as np

from ...common.units import FloatArray, db_from_amplitude, wavelength_m
from ...site.materials import material
from .fresnel import reflection_coefficients


def free_space_dbm(
    sources_m: FloatArray, targets_m: FloatArray, carrier_hz: float, transmit_power_dbm: float = 0.0
) -> FloatArray:
    """Return the received power between isotropic antennas in empty space (Friis) [dBm].

    Source: ITU-R P.525 eq. 4.

    Parameters
    ----------
    sources_m : (towers, 3) or (poses, towers, 3)
        Array centres of the towers [m]. The second shape is for towers that move.
    targets_m : (poses, 3)
    carrier_hz, transmit_power_dbm : float

    Returns
    -------
    (poses, towers)
        NaN at the position of the tower's antenna.
    """
    distance = np.linalg.norm(targets_m[:, None, :] - sources_m, axis=2)
    distance[distance == 0.0] = np.nan
    return np.asarray(transmit_power_dbm + db_from_amplitude(wavelength_m(carrier_hz) / (4.0 * np.pi * distance)))


def two_ray_dbm(
    sources_m: FloatArray,
    targets_m: FloatArray,
    carrier_hz: float,
    transmit_power_dbm: float = 0.0,
    *,
    ground_material: str = "medium_dry_ground",
    ground_m: FloatArray | float = 0.0,
    polarisation: str = "vertical",
) -> FloatArray:
    """Return the power of line of sight plus one reflection off flat ground, for isotropic antennas [dBm].

    Source: ITU-R P.2040-3 eq. 37.

    Parameters
    ----------
    sources_m, targets_m, carrier_hz, transmit_power_dbm
        The same as in :func:`free_space_dbm`.
    ground_material : str
        Material of the half-space below ``ground_m``.
    ground_m : float or (towers,)
        Height of the ground at each tower.
    polarisation : {"vertical", "horizontal"}
        Determines the Fresnel coefficient: TM for vertical, TE for horizontal. Vertical antennas with the same gain in
        all directions have a field along theta, which stays along theta after the reflection.

    Returns
    -------
    (poses, towers)
        NaN for poses below the ground and at the position of the antenna.
    """
    wavelength = wavelength_m(carrier_hz)
    across = np.linalg.norm(targets_m[:, None, :2] - sources_m[..., :2], axis=2)
    ground = np.broadcast_to(np.asarray(ground_m, dtype=np.float64), (sources_m.shape[-2],))
    # heights above the ground of each tower, because each tower has a separate ground plane
    low = np.atleast_2d(sources_m[..., 2]) - ground
    high = targets_m[:, None, 2] - ground[None, :]
    direct = np.hypot(across, high - low)
    bounced = np.hypot(across, high + low)
    eta = np.asarray(material(ground_material).relative_permittivity(carrier_hz))
    with np.errstate(divide="ignore", invalid="ignore"):
        te, tm = reflection_coefficients(np.abs(high + low) / bounced, eta, np.asarray(np.inf), wavelength)
        gamma = tm if polarisation == "vertical" else te
        # difference of the two lengths, in a form without cancellation
        extra = 4.0 * high * low / (bounced + direct)
        field = 1.0 / direct + gamma / bounced * np.exp(-2j * np.pi * extra / wavelength)
        level = transmit_power_dbm + db_from_amplitude(wavelength / (4.0 * np.pi) * np.abs(field))
    return np.asarray(np.where((high >= 0.0) & (direct > 0.0), level, np.nan))
