"""The metric card of a predicted level: the same numbers for this program, for others and for the baselines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..common.units import BoolArray, FloatArray
from .gains import BAND
from .level import crps_normal, local_mean_db
from .offset import grid_offset

# Averaging window of the second error [s].
WINDOW_S = 1.0

# Search range of the one offset [dB]: wide enough for logs in dB re full scale against a path loss.
_RANGE_DB = (-400.0, 400.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Exceedance:
    """The share of samples at or above a threshold [dB], predicted and measured."""

    threshold_db: float
    predicted: float
    measured: float


@dataclass(frozen=True, slots=True, kw_only=True)
class LevelCard:
    """Scores of one predicted level over the samples that prediction and measurement share.

    Parameters
    ----------
    n : int
        Samples with a measured and a predicted level.
    bias_db, rmse_db : float, optional
        Mean of measured minus predicted, and the RMSE, as predicted; None if the two have no common reference.
    offset_db, rmse_offset_db : float
        The offset that is added to the measurement (on the 0.1 dB grid), and the RMSE after it. Both are fitted on the
        scored samples.
    rmse_1s_db : float
        The same of means over 1 s.
    correlation, slope : float
        Pearson; decibels of the measurement per predicted decibel (least squares). NaN if the prediction is constant.
    crps_db, coverage_90 : float, optional
        Continuous ranked probability score and share inside the 90 % band; None without a band.
    exceedance : tuple of Exceedance
        Share of samples above thresholds, as predicted where levels have a common reference, else after the offset.
    outages_missed, outages_invented : int
        Measured outages where a level was predicted; measured levels where none was predicted.
    fitted_here : tuple of str
        Names of the numbers that were fitted on the scored samples.
    """

    n: int
    bias_db: float | None
    rmse_db: float | None
    offset_db: float
    rmse_offset_db: float
    rmse_1s_db: float
    correlation: float
    slope: float
    crps_db: float | None
    coverage_90: float | None
    exceedance: tuple[Exceedance, ...]
    outages_missed: int
    outages_invented: int
    fitted_here: tuple[str, ...] = ("offset_db",)


@dataclass(frozen=True, slots=True, kw_only=True)
class PredictedLevel:
    """Levels (n,) of one prediction at the samples of a series; NaN where nothing is predicted [dB].

    Parameters
    ----------
    level_db : (n,)
        The predicted median.
    sd_db : (n,), optional
        Standard deviation of one sample.
    low_db, high_db : (n,), optional
        Ends of the 90 % interval; by default those of the normal distribution of ``sd_db``.
    absolute : bool
        The levels have the reference of the measurement: no offset is needed.
    asked : (n,) bool, optional
        Samples that the prediction is about; by default those with a level.
    """

    level_db: FloatArray
    sd_db: FloatArray | None = None
    low_db: FloatArray | None = None
    high_db: FloatArray | None = None
    absolute: bool = True
    asked: FloatArray | None = None


def level_card(
    time_s: FloatArray, measured_db: FloatArray, predicted: PredictedLevel, thresholds_db: Sequence[float]
) -> LevelCard:
    """Return the card of a predicted level.

    Parameters
    ----------
    time_s : (n,)
        Times of the samples [s], rising.
    measured_db : (n,)
        Measured levels; NaN is an outage.
    predicted : PredictedLevel
    thresholds_db : sequence of float
        Measured levels whose exceedance is compared.

    Returns
    -------
    LevelCard

    Raises
    ------
    UsageError
        If no sample has both levels.
    """
    level = predicted.level_db
    asked = np.isfinite(level) if predicted.asked is None else predicted.asked.astype(bool)
    heard = np.isfinite(measured_db)
    both = heard & np.isfinite(level) & asked
    time, measured, expected = time_s[both], measured_db[both], level[both]
    fit = grid_offset(measured, expected, span_db=_RANGE_DB)
    error = measured - expected
    slow = local_mean_db(time, measured + fit.offset_db, WINDOW_S) - local_mean_db(time, expected, WINDOW_S)
    spread, varied = float(np.std(expected)), float(np.std(measured))
    covariance = float(np.mean((expected - expected.mean()) * (measured - measured.mean())))
    shift = 0.0 if predicted.absolute else fit.offset_db
    absolute = predicted.absolute
    crps, inside = _distribution(error, predicted, both) if absolute else (None, None)
    return LevelCard(
        n=int(both.sum()),
        bias_db=float(error.mean()) if absolute else None,
        rmse_db=float(np.sqrt(np.mean(error**2))) if absolute else None,
        offset_db=fit.offset_db,
        rmse_offset_db=fit.rmse_db,
        rmse_1s_db=float(np.sqrt(np.mean(slow**2))),
        correlation=covariance / (spread * varied) if spread and varied else float("nan"),
        slope=covariance / spread**2 if spread else float("nan"),
        crps_db=crps,
        coverage_90=inside,
        exceedance=tuple(_exceedance(x, measured_db[asked], level[asked] - shift) for x in thresholds_db),
        outages_missed=int((asked & ~heard & np.isfinite(level)).sum()),
        outages_invented=int((asked & heard & ~np.isfinite(level)).sum()),
    )


def _distribution(
    error_db: FloatArray, predicted: PredictedLevel, both: BoolArray
) -> tuple[float | None, float | None]:
    """Return CRPS and coverage of the 90 % band as predicted; None for what is not stated."""
    from scipy.special import ndtri

    crps: float | None = None
    half = None
    if predicted.sd_db is not None and np.isfinite(predicted.sd_db[both]).all():
        crps = float(np.mean(crps_normal(error_db, predicted.sd_db[both])))
        half = float(ndtri(0.5 + 0.5 * BAND)) * predicted.sd_db[both]
    if predicted.low_db is not None and predicted.high_db is not None:
        measured = error_db + predicted.level_db[both]
        inside = (measured >= predicted.low_db[both]) & (measured <= predicted.high_db[both])
        return crps, float(np.mean(inside))
    return crps, None if half is None else float(np.mean(np.abs(error_db) <= half))


def _exceedance(threshold_db: float, measured_db: FloatArray, level_db: FloatArray) -> Exceedance:
    """Return the shares of samples at or above a threshold; an outage on either side is below it."""
    return Exceedance(
        threshold_db=threshold_db,
        predicted=float(np.mean(np.nan_to_num(level_db, nan=-np.inf) >= threshold_db)),
        measured=float(np.mean(np.nan_to_num(measured_db, nan=-np.inf) >= threshold_db)),
    )


# Share of the samples, and their least number, that mark the lowest level as a detection floor.
_FLOOR_SHARE, _FLOOR_COUNT = 0.01, 10


def detection_floor_db(level_db: FloatArray) -> float | None:
    """Return the lowest level if a receiver repeats it, which marks its detection floor; else None [dB]."""
    known = level_db[np.isfinite(level_db)]
    if not len(known) or np.ptp(known) == 0.0:
        return None
    lowest = float(known.min())
    repeated = int((known <= lowest + 0.05).sum())
    return lowest if repeated >= max(_FLOOR_COUNT, _FLOOR_SHARE * len(known)) else None


def measured_thresholds(measured_db: FloatArray, *, ratio: bool) -> tuple[float, ...]:
    """Return thresholds for exceedance: 0, 10 and 20 dB of an SNR, else measured deciles 1, 5 and 9 in whole dB."""
    if ratio:
        return 0.0, 10.0, 20.0
    known = measured_db[np.isfinite(measured_db)]
    return tuple(float(np.round(q)) for q in np.quantile(known, (0.1, 0.5, 0.9))) if len(known) else ()
