"""Metrics of a predicted level, computed in the same way for this program, other programs and baselines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..common.units import BoolArray, FloatArray
from .gains import BAND, NO_SPREAD, LostLock, StatedSpread
from .level import local_mean_db
from .statistics import correlation

# Averaging window of ``rmse_1s_db`` [s].
WINDOW_S = 1.0

# Name in the cards for the model of the report with which predictions are compared.
OURS = "ray tracing (this report)"

# Numbers of a card that are averaged over channels.
AVERAGED = ("bias_db", "rmse_db", "rmse_offset_db", "rmse_1s_db", "correlation", "crps_db", "coverage_90")


# Columns of a prediction with the two parts of its distribution, for a receiver that can lose its lock.
LOCK = ("p_lock", "locked_db", "lost_db", "locked_sd_db", "lost_sd_db")


def level_card(
    time_s: FloatArray,
    measured_db: FloatArray,
    predicted: Mapping[str, FloatArray],
    scored: BoolArray,
    thresholds_db: Sequence[float] = (),
    *,
    absolute: bool = True,
) -> dict[str, Any]:
    """Return the scores of a predicted level on the samples that have a predicted and a measured level.

    Parameters
    ----------
    time_s : (n,)
        Times of the samples [s], rising. At least one sample has both levels.
    measured_db : (n,)
        Measured levels; NaN is an outage.
    predicted : mapping of str to (n,)
        ``level``: predicted median [dB], NaN where nothing is predicted. Optional, and used if they are known on all
        samples with both levels: ``sd_db`` (standard deviation of one sample; the error is normal), ``q05_db`` and
        ``q95_db`` (ends of the 90 % interval; the default is those of the distribution), and the columns :data:`LOCK`
        (two parts, instead of a normal error).
    scored : (n,) bool
        Samples that the prediction covers. There, a predicted NaN means a predicted outage.
    thresholds_db : sequence of float
        Measured levels whose exceedance is compared.
    absolute : bool
        True if the levels have the reference of the measurement, so that no offset is needed.

    Returns
    -------
    dict
        The entry of card.json.

        - ``n``: number of samples with a measured and a predicted level.
        - ``bias_db rmse_db``: mean of measured minus predicted and RMSE, without an offset. None if the levels have no
          common reference.
        - ``offset_db rmse_offset_db``: offset that is added to the measurement, and RMSE after this offset. The offset
          is fitted on the scored samples.
        - ``rmse_1s_db``: RMSE of means over 1 s, with a separate offset.
        - ``correlation slope``: Pearson correlation, and slope of measured over predicted level (least squares). NaN
          if the prediction is constant.
        - ``crps_db coverage_90``: continuous ranked probability score and share inside the 90 % band; None without a
          band.
        - ``exceedance``: for each threshold the ``predicted`` and ``measured`` share of samples at or above
          ``threshold_db``. If the levels have no common reference, the offset is applied first.
        - ``outages_missed outages_invented``: number of outages for which a level was predicted, and of levels for
          which an outage was predicted.
    """
    level = predicted["level"]
    heard, reached = np.isfinite(measured_db) & scored, np.isfinite(level) & scored
    both = heard & reached
    measured, expected = measured_db[both], level[both]
    error = measured - expected
    slow = local_mean_db(time_s[both], measured, WINDOW_S) - local_mean_db(time_s[both], expected, WINDOW_S)
    # rounding errors of a constant prediction must not produce a correlation
    r = correlation(measured, np.round(expected, 6))
    crps, inside = _distribution(measured_db, predicted, both) if absolute else (None, None)
    # an outage counts as below any threshold
    theirs = np.where(reached, level + (0.0 if absolute else error.mean()), -np.inf)[scored]
    ours = np.where(heard, measured_db, -np.inf)[scored]
    return {
        "n": int(both.sum()),
        "bias_db": float(error.mean()) if absolute else None,
        "rmse_db": float(np.sqrt(np.mean(error**2))) if absolute else None,
        "offset_db": -float(error.mean()),
        "rmse_offset_db": float(error.std()),
        "rmse_1s_db": float(slow.std()),
        "correlation": r,
        "slope": r * float(np.std(measured) / (np.std(expected) or 1.0)),
        "crps_db": crps,
        "coverage_90": inside,
        "exceedance": [
            {"threshold_db": x, "predicted": float(np.mean(theirs >= x)), "measured": float(np.mean(ours >= x))}
            for x in thresholds_db
        ],
        "outages_missed": int((reached & ~heard).sum()),
        "outages_invented": int((heard & ~reached).sum()),
    }


def _distribution(
    measured_db: FloatArray, predicted: Mapping[str, FloatArray], both: BoolArray
) -> tuple[float | None, float | None]:
    """Return CRPS and coverage of the predicted 90 % band. None if the prediction does not state them."""
    known = {name for name, numbers in predicted.items() if np.isfinite(numbers[both]).all()}
    level, crps, lock, band = predicted["level"], None, None, None
    if "sd_db" in known:
        if known.issuperset(LOCK):
            lock = LostLock(
                probability=predicted["p_lock"],
                locked_db=predicted["locked_db"] - level,
                lost_db=predicted["lost_db"] - level,
                locked_sd_db=float(np.nanmean(predicted["locked_sd_db"])),
                lost_sd_db=float(np.nanmean(predicted["lost_sd_db"])),
            )
        stated = StatedSpread(gain_sd_db=predicted["sd_db"], spread=NO_SPREAD, lock=lock)
        crps = stated.crps_db(np.where(both, measured_db - level, np.nan))
        low_db, high_db = stated.band_db(BAND)
        band = level + low_db, level + high_db
    if known.issuperset(("q05_db", "q95_db")):
        band = predicted["q05_db"], predicted["q95_db"]
    return crps, band and float(np.mean(((measured_db >= band[0]) & (measured_db <= band[1]))[both]))


def measured_thresholds(measured_db: FloatArray, *, ratio: bool) -> tuple[float, ...]:
    """Return thresholds for exceedance: 0, 10 and 20 dB of an SNR, else measured deciles 1, 5 and 9 in whole dB."""
    if ratio:
        return 0.0, 10.0, 20.0
    known = measured_db[np.isfinite(measured_db)]
    return tuple(float(np.round(q)) for q in np.quantile(known, (0.1, 0.5, 0.9))) if len(known) else ()
