"""One RSS series at its samples: measured and simulated level, and which samples are compared."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...common.units import BoolArray, FloatArray
from ...compare.gains.spread import NO_SPREAD, Spread, StatedSpread
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
    posed = replayed.valid.copy()
    if settings.minimum_height_m is not None:
        posed[posed] = replayed.poses.position_m[:, 2] >= settings.minimum_height_m
    level_dbm = replayed.level_dbm("power" if settings.field == "power" else "coherent")
    return Levels(
        measured_db=np.where(posed, measured, np.nan),
        simulated_db=replayed.spread(level_dbm),
        posed=posed,
    )


def stated_spread(replayed: Replayed) -> StatedSpread | None:
    """Error bars of the simulated level that learned antennas state, along the direct line; None where none does.

    Where only one end is learned, or files hold no gain towards both ends at once, the gains of both ends count as
    independent; they are learned from the same levels, so the true standard deviation is rather smaller. Files of 0.3
    state that of the gain alone.

    Parameters
    ----------
    replayed : Replayed

    Returns
    -------
    StatedSpread or None
    """
    gain = replayed.learned
    if gain is None:
        return None
    spread = next((s for s in map(Spread.from_text, gain.notes) if s is not None), NO_SPREAD)
    return StatedSpread(gain_sd_db=replayed.spread(gain.sd_db), spread=spread)
