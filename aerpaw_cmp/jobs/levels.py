"""One RSS series at its samples: measured and simulated level, and which samples are compared."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..common.units import BoolArray, FloatArray
from ..compare import rss
from ..flight.data import RssSeries
from ..flight.replay import Replayed
from ..flight.settings import RssSettings
from ..site.site import Site


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


def gain_sd_db(site: Site, tower: str, replayed: Replayed) -> FloatArray | None:
    """Standard deviation (n,) [dB] of the simulated level that learned antennas state, along the direct line.

    The two ends count as independent; they are learned from the same levels, so the true one is rather smaller.
    None where neither antenna states one.
    """
    link, poses = replayed.link, replayed.poses
    ray = poses.position_m - replayed.source_m(site)
    at_uav = np.einsum("nji,nj->ni", poses.rotation, -ray)
    square = np.zeros(len(ray))
    stated = False
    for array, direction in ((link.tower_arrays[tower], ray), (link.uav_array, at_uav)):
        own = direction @ array.mount
        sd = getattr(array.patterns[0], "gain_sd_db", None)
        if sd is not None:
            stated = True
            theta = np.arctan2(np.hypot(own[:, 0], own[:, 1]), own[:, 2])
            square += sd(theta, np.arctan2(own[:, 1], own[:, 0])) ** 2
    return replayed.spread(np.sqrt(square)) if stated else None
