"""Evidence from which a likely cause is told, gathered from a replayed series."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from ...common.units import FloatArray
from ...compare.judge.causes import Cause, LevelEvidence, likely_cause
from ...compare.level import rss
from ...flight.data import RssSeries
from ...flight.replay import Replayed
from ...propagation.field.baselines import free_space_dbm
from ...site.antenna.antennas import Isotropic
from ...site.site import Site
from .levels import Levels

_ANGLES_DEG = tuple(float(angle) for angle in range(10, 360, 10))


def cause_of(site: Site, series: RssSeries, replayed: Replayed, levels: Levels, free_space: FloatArray) -> Cause | None:
    """Likely cause of the error of one tower and channel; None where no trouble shows, and for a tower that moves.

    Parameters
    ----------
    site : Site
    series : RssSeries
    replayed : Replayed
    levels : Levels
        Measured and predicted at the samples.
    free_space : (n,)
        Level of free space at the samples [dBm].

    Returns
    -------
    Cause or None
    """
    if replayed.tower_m is not None:
        return None
    time_s = rss.seconds(series.time)
    directions = _link_geometry(replayed, replayed.source_m(site), replayed.poses.rotation)
    order = np.argsort(time_s, kind="stable")
    names = ("uav_azimuth_deg", "uav_elevation_deg", "azimuth_deg")
    spread = {name: replayed.spread(directions[name])[order] for name in names}
    evidence = LevelEvidence(
        time_s=time_s[order],
        measured_db=levels.measured_db[order],
        predicted_db=levels.simulated_db[order],
        uav_azimuth_deg=spread["uav_azimuth_deg"],
        uav_elevation_deg=spread["uav_elevation_deg"],
        tower_azimuth_deg=spread["azimuth_deg"],
        turned_db={
            angle: replayed.spread(change)[order] for angle, change in _turned(site, replayed, directions).items()
        },
        other_towers_db={
            name: (levels.simulated_db - free_space + level)[order]
            for name, level in _other_towers(site, series.tower, replayed, _gain_db(replayed, directions)).items()
        },
        clock_confirmed=replayed.clock is not None and replayed.clock.result.verdict == "ok",
    )
    cause = likely_cause(evidence)
    return None if cause.name == "none" else cause


def _link_geometry(replayed: Replayed, place_m: FloatArray, rotation: FloatArray) -> dict[str, FloatArray]:
    """Directions between a place and the UAV at the poses."""
    return rss.link_geometry(place_m, replayed.poses.position_m, rotation, uav_mount=replayed.link.uav_array.mount)


def _other_towers(site: Site, tower: str, replayed: Replayed, gain_db: FloatArray) -> dict[str, FloatArray]:
    """Free space from each other tower, with the UAV's gain towards it less that towards its own, at the samples."""
    link, levels = replayed.link, {}
    for name, neighbour in site.towers.items():
        if name != tower:
            place = neighbour.position_m[None, :]
            level = free_space_dbm(place, replayed.poses.position_m, link.carrier_hz, link.transmit_power_dbm)[:, 0]
            level += _gain_db(replayed, _link_geometry(replayed, place, replayed.poses.rotation)) - gain_db
            levels[name] = replayed.spread(level)
    return levels


def _turned(site: Site, replayed: Replayed, directions: Mapping[str, FloatArray]) -> dict[float, FloatArray]:
    """Change of the direct path's gain [dB] at the poses where the heading is greater; none for isotropic antennas."""
    array = replayed.link.uav_array
    if all(isinstance(pattern, Isotropic) for pattern in array.patterns):
        return {}
    changes = {}
    for angle in _ANGLES_DEG:
        turn = math.radians(-angle)  # a heading grows clockwise
        rotation = np.array(
            [[math.cos(turn), -math.sin(turn), 0.0], [math.sin(turn), math.cos(turn), 0.0], [0.0, 0.0, 1.0]]
        )
        turned = _link_geometry(replayed, replayed.source_m(site), rotation @ replayed.poses.rotation)
        changes[angle] = _gain_db(replayed, turned) - _gain_db(replayed, directions)
    return changes


def _gain_db(replayed: Replayed, directions: Mapping[str, FloatArray]) -> FloatArray:
    """Mean gain of the UAV's elements towards the tower [dB]."""
    theta, phi = np.radians(90.0 - directions["uav_elevation_deg"]), np.radians(directions["uav_azimuth_deg"])
    power = np.zeros(len(theta))
    for pattern in replayed.link.uav_array.patterns:
        e_theta, e_phi = pattern.field(theta, phi)
        power += np.abs(e_theta) ** 2 + np.abs(e_phi) ** 2
    return np.asarray(10.0 * np.log10(np.maximum(power / len(replayed.link.uav_array.patterns), 1e-6)))
