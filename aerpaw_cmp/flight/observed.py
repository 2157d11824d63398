"""Levels of a flight against a model without antennas, in the directions at both ends."""

from __future__ import annotations

import dataclasses

import numpy as np

from ..common.errors import InputError
from ..common.units import FloatArray
from ..compare.gains.direction_gain import LinkSamples, link_directions
from ..compare.learning.calibration import Observed
from ..propagation.field.baselines import free_space_dbm
from ..propagation.geometry.arrays import Poses
from .data import FlightData, RssSeries
from .replay import replay_poses
from .rows.lock import LOCK_FLOOR_DB
from .settings import ArraySettings


def observed_series(data: FlightData, series: RssSeries) -> tuple[Observed, float, float]:
    """Return the samples of one series at known poses, against free space through the woods that the flight has.

    Parameters
    ----------
    data : FlightData
    series : RssSeries

    Returns
    -------
    Observed
    float
        Share of the attitudes that are not logged: heading from the track, level flight.
    float
        Share of the levels without a position.

    Raises
    ------
    InputError
        A flight without telemetry.
    """
    if data.track is None:
        raise InputError(f"flight {data.settings.flight.name} has no telemetry", expected="positions and attitude")
    place, known = data.tower_at(series.tower, series.time)
    pose = data.track.pose_at(series.time).where(known)
    low = data.settings.rss.minimum_height_m
    with np.errstate(invalid="ignore"):
        keep = pose.valid if low is None else pose.valid & (pose.position_m[:, 2] >= low)
    position = pose.position_m[keep]
    moving = series.tower in data.nodes
    place = place[keep] if moving else place
    at_uav, at_tower = link_directions(place, position, pose.rotation[keep])
    ends = place[:, None, :] if moving else place
    free = free_space_dbm(ends, position, series.link.carrier_hz, series.link.transmit_power_dbm)[:, 0]
    if data.settings.rt.foliage != "none" and data.site.wooded and not moving:
        free = _through_woods(data, series, Poses(position, pose.rotation[keep]))
    time = series.time[keep]
    seconds = (time - time.min()) / np.timedelta64(1, "s") if len(time) else np.zeros(0)
    order = np.argsort(seconds, kind="stable")
    samples = LinkSamples(
        flight=data.settings.flight.name,
        tower=series.tower,
        channel=series.channel,
        time_s=np.asarray(seconds, dtype=np.float64),
        position_m=position,
        at_uav=at_uav,
        at_tower=at_tower,
        residual_db=series.measured_db[keep] - free,
        floor_db=None if series.locked is None else LOCK_FLOOR_DB - free,
    )
    guessed = float(np.mean(~pose.attitude_known[keep])) if keep.any() else 0.0
    observed = Observed(
        samples,
        free,
        pose.heading_deg[keep],
        place if moving else None,
        time.min() if len(time) else None,
        locked=None if series.locked is None else series.locked[keep],
        sent_dbm=series.link.transmit_power_dbm,
    )
    return observed.part(order), guessed, 1.0 - float(np.mean(pose.valid))


def _through_woods(data: FlightData, series: RssSeries, poses: Poses) -> FloatArray:
    """Return the level (n,) of the direct path with the loss of woods, without buildings and antennas [dBm]."""
    plain = {"uav": ArraySettings(), "tower": ArraySettings(), "towers": {}}
    link = series.link.model_copy(update=plain).build([series.tower], data.folder)
    rt = data.settings.rt.model_copy(update={"max_depth": 0, "diffraction": "none"})
    site = dataclasses.replace(data.site, buildings=())
    return np.asarray(replay_poses(site, rt, link, poses).level_dbm("power")[:, 0])
