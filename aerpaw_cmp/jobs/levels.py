"""One RSS series at its samples: measured and simulated level, and which samples are compared."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from ..common.units import BoolArray, FloatArray
from ..compare import rss
from ..compare.spread import NO_SPREAD, Spread, StatedSpread
from ..flight.data import RssSeries
from ..flight.replay import Replayed
from ..flight.settings import RssSettings
from ..site.site import Site
from ..site.sphere_pattern import SpherePattern


@dataclass(frozen=True, slots=True, kw_only=True)
class Levels:
    """Measured and simulated levels (n,) [dB].

    ``posed`` are the samples with a known pose above the lowest height; ``measured_db`` is NaN elsewhere.
    """

    measured_db: FloatArray
    simulated_db: FloatArray
    posed: BoolArray


def levels_of(series: RssSeries, replayed: Replayed, settings: RssSettings) -> Levels:
    """What is compared of a series, as ``rss`` of the flight file asks."""
    measured = series.measured_db
    if settings.window_s > 0:
        measured = rss.local_mean_db(series.time, measured, settings.window_s)
    posed = replayed.valid.copy()
    if settings.minimum_height_m is not None:
        posed[posed] = replayed.poses.position_m[:, 2] >= settings.minimum_height_m
    level_dbm = replayed.replay.rss_power_dbm if settings.field == "power" else replayed.replay.rss_dbm
    return Levels(
        measured_db=np.where(posed, measured, np.nan),
        simulated_db=at_samples(series, replayed, level_dbm[:, 0], settings),
        posed=posed,
    )


def at_samples(series: RssSeries, replayed: Replayed, level_db: FloatArray, settings: RssSettings) -> FloatArray:
    """A simulated level of the replayed poses at the samples (n,), averaged as ``rss.field: local_mean`` asks.

    Parameters
    ----------
    series : RssSeries
        For its times.
    replayed : Replayed
        Says at which samples a pose was known.
    level_db : (poses,)
        At the replayed poses [dB].
    settings : RssSettings
        ``field`` and ``window_s``.

    Returns
    -------
    (n,)
        [dB]; NaN where no pose is known.
    """
    level = replayed.spread(level_db)
    return rss.local_mean_db(series.time, level, settings.window_s) if settings.field == "local_mean" else level


def stated_spread(site: Site, tower: str, replayed: Replayed, window_s: float = 0.0) -> StatedSpread | None:
    """Error bars of the simulated level that learned antennas state, along the direct line; None where none does.

    The gains of both ends count as independent; they are learned from the same levels, so the true standard deviation
    is rather smaller. Files of 0.3 state that of the gain alone.

    Parameters
    ----------
    site : Site
    tower : str
    replayed : Replayed
    window_s : float
        Time over which the measurement is averaged: as long as the mean that was learned from, it has no fading.

    Returns
    -------
    StatedSpread or None
    """
    link, poses = replayed.link, replayed.poses
    ray = poses.position_m - replayed.source_m(site)
    at_uav = np.einsum("nji,nj->ni", poses.rotation, -ray)
    square, spread, stated = np.zeros(len(ray)), NO_SPREAD, False
    for array, direction in ((link.uav_array, at_uav), (link.tower_arrays[tower], ray)):
        pattern = array.patterns[0]
        if not isinstance(pattern, SpherePattern):
            continue
        stated, own = True, direction @ array.mount
        theta = np.arctan2(np.hypot(own[:, 0], own[:, 1]), own[:, 2])
        square += pattern.gain_sd_db(theta, np.arctan2(own[:, 1], own[:, 0])) ** 2
        spread = Spread.from_text(pattern.notes) or spread
    if not stated:
        return None
    if window_s >= spread.bin_s:
        spread = dataclasses.replace(spread, fading_sd_db=0.0)
    return StatedSpread(gain_sd_db=replayed.spread(np.sqrt(square)), spread=spread)
