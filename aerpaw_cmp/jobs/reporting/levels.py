"""One RSS series at its samples: measured and simulated level, and which samples are compared."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from ...common.units import BoolArray, FloatArray
from ...compare.gains.spread import NO_SPREAD, Spread, StatedSpread
from ...compare.level import rss
from ...flight.data import RssSeries
from ...flight.replay import Replayed
from ...flight.settings import RssSettings


@dataclass(frozen=True, slots=True, kw_only=True)
class Levels:
    """Measured and simulated levels (n,) [dB].

    ``posed`` are the samples with a known pose above the lowest height; ``measured_db`` is NaN elsewhere.
    """

    measured_db: FloatArray
    simulated_db: FloatArray
    posed: BoolArray


def levels_of(series: RssSeries, replayed: Replayed, settings: RssSettings) -> Levels:
    """Levels of a series that are compared, as ``rss`` of the flight file asks."""
    measured = series.measured_db
    if settings.window_s > 0:
        measured = rss.local_mean_db(series.time, measured, settings.window_s)
    posed = replayed.valid.copy()
    if settings.minimum_height_m is not None:
        posed[posed] = replayed.poses.position_m[:, 2] >= settings.minimum_height_m
    level_dbm = replayed.level_dbm("power" if settings.field == "power" else "coherent")
    return Levels(
        measured_db=np.where(posed, measured, np.nan),
        simulated_db=at_samples(series, replayed, level_dbm, settings),
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


def stated_spread(replayed: Replayed, window_s: float = 0.0) -> StatedSpread | None:
    """Error bars of the simulated level that learned antennas state, along the direct line; None where none does.

    Where only one end is learned, or files hold no gain towards both ends at once, the gains of both ends count as
    independent; they are learned from the same levels, so the true standard deviation is rather smaller. Files of 0.3
    state that of the gain alone.

    Parameters
    ----------
    replayed : Replayed
    window_s : float
        Time over which the measurement is averaged: as long as the mean that was learned from, it has no fading.

    Returns
    -------
    StatedSpread or None
    """
    gain = replayed.learned
    if gain is None:
        return None
    spread = next((s for s in map(Spread.from_text, gain.notes) if s is not None), NO_SPREAD)
    if window_s >= spread.bin_s:
        spread = dataclasses.replace(spread, fading_sd_db=0.0)
    return StatedSpread(gain_sd_db=replayed.spread(gain.sd_db), spread=spread)
