"""Learned antenna data of a link besides the patterns that the replay takes: both ends at once, error bars."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ...common.geodesy import azimuth_rad, elevation_rad
from ...common.units import FloatArray
from ...compare.gains.direction_gain import link_directions
from ...compare.gains.spread import NO_SPREAD, Spread
from ...propagation.geometry.arrays import Link, Pattern, Poses
from ...site.antenna.learned import LearnedSpread
from ...site.antenna.sphere_pattern import SpherePattern


@dataclass(frozen=True, slots=True, kw_only=True)
class LearnedGain:
    """Along the direct line, at the poses of a replay.

    Parameters
    ----------
    pair_db : (poses,)
        Gain towards both ends at once, to be added to the level [dB]; zero where the files hold none.
    sd_db : (poses,)
        Standard deviation of all learned gain together [dB].
    spread : Spread
        Error model of the level besides ``sd_db``: that of the tower's antenna, else of the UAV's.
    """

    pair_db: FloatArray
    sd_db: FloatArray
    spread: Spread


def learned_gain(link: Link, poses: Poses, source_m: FloatArray) -> LearnedGain | None:
    """The learned gain of a link to one tower; None where neither end is learned.

    Parameters
    ----------
    link : Link
        With one tower.
    poses : Poses
    source_m : (1, 3) or (poses, 3)
        Centre of the tower's array [m].

    Returns
    -------
    LearnedGain or None
    """
    towards = dict(zip(("uav", "tower"), link_directions(source_m, poses.position_m, poses.rotation), strict=True))
    (tower_array,) = link.tower_arrays.values()
    ends: dict[str, tuple[SpherePattern, FloatArray]] = {}
    for end, array in (("uav", link.uav_array), ("tower", tower_array)):
        pattern = array.patterns[0]
        if isinstance(pattern, SpherePattern):
            ends[end] = pattern, np.asarray(towards[end] @ array.mount)
    if not ends:
        return None
    pair_db, sd_db = pair_and_sd_db(ends)
    stated = (pattern.spread for pattern, _ in reversed(ends.values()) if pattern.spread is not None)
    return LearnedGain(pair_db=pair_db, sd_db=sd_db, spread=spread_of(next(stated, None)))


def spread_of(stated: LearnedSpread | None) -> Spread:
    """Return the error model that a learned antenna states; that of the gain alone if it states none."""
    return NO_SPREAD if stated is None else Spread(**stated.model_dump())


def pair_and_sd_db(ends: Mapping[str, tuple[SpherePattern, FloatArray]]) -> tuple[FloatArray, FloatArray]:
    """Gain towards both ends at once (n,) and standard deviation (n,) of all learned gain together [dB].

    ``ends``: pattern and directions (n, 3) in its frame, of ``uav`` and ``tower``, or one of them.
    """
    square = sum(pattern.gain_sd_db(*sphere_angles(direction)) ** 2 for pattern, direction in ends.values())
    sd_db = np.sqrt(square)
    if len(ends) == 2:
        (uav, at_uav), (tower, at_tower) = ends["uav"], ends["tower"]
        # a pair's gain is what these two leave together: it means nothing beside another table
        if tower.pair is not None and uav.trained_on == tower.trained_on:  # of one and the same calibration
            return tower.pair.at(np.concatenate([at_uav, at_tower], axis=1), sd_db)
    return np.zeros(len(sd_db)), sd_db


def sphere_angles(direction: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Zenith angle and azimuth (...,) [rad] of directions (..., 3)."""
    return 0.5 * np.pi - elevation_rad(direction), azimuth_rad(direction)


def mean_gain_db(patterns: Sequence[Pattern], theta_rad: FloatArray, phi_rad: FloatArray) -> FloatArray:
    """Mean gain (n,) of the elements of an array towards directions of its frame [dBi]; no lower than -60."""
    fields = [pattern.field(theta_rad, phi_rad) for pattern in patterns]
    power = sum(np.abs(e_theta) ** 2 + np.abs(e_phi) ** 2 for e_theta, e_phi in fields)
    # a null is -60 dB: no model of a pattern is that sure
    return np.asarray(10.0 * np.log10(np.maximum(power / len(patterns), 1e-6)))


def pair_db(link: Link, poses: Poses, source_m: FloatArray) -> FloatArray | float:
    """Gain (poses,) towards both ends at once, to be added to the level [dB]; 0 where none is learned."""
    gain = learned_gain(link, poses, source_m)
    return 0.0 if gain is None else gain.pair_db
