"""Scores of levels that were predicted: after a flight, and of entries of benchmarks/published."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr, ndtri  # every report loads this module: scipy.stats would take it 0.4 s more

from ...common.units import FloatArray
from ..level.rss import local_mean_db

# Averaging window of the second error [s].
WINDOW_S = 4.0

# Nominal share of the interval whose coverage is told.
COVERAGE = 0.9


@dataclass(frozen=True, slots=True, kw_only=True)
class LevelSeries:
    """Measured and predicted levels of one flight, tower and channel, in time order.

    Parameters
    ----------
    name : str
        ``flight tower.channel``.
    time_s : (n,)
    measured_db, level_db : (n,)
        Measured and predicted median [dB].
    sd_db : (n,), optional
        Standard deviation of the prediction [dB]; without it nothing of a distribution is scored.
    own_offset : bool
        Score after the mean error of the series is removed.
    """

    name: str
    time_s: FloatArray
    measured_db: FloatArray
    level_db: FloatArray
    sd_db: FloatArray | None = None
    own_offset: bool = True

    @property
    def bias_db(self) -> float:
        """Mean of measured minus predicted [dB]."""
        return float(np.mean(self.measured_db - self.level_db))

    @property
    def error_db(self) -> FloatArray:
        """Measured minus predicted (n,), less the bias where the series has an offset of its own [dB]."""
        error = self.measured_db - self.level_db
        return np.asarray(error - error.mean() if self.own_offset else error)


def crps_normal(error_db: FloatArray, sd_db: FloatArray) -> FloatArray:
    """Continuous ranked probability score (n,) of normal forecasts [dB].

    Source: Gneiting and Raftery (2007), doi:10.1198/016214506000001437, eq. 21.

    Examples
    --------
    >>> crps_normal(np.array([0.0]), np.array([1.0])).round(4).tolist()
    [0.2337]
    """
    z = error_db / sd_db
    density = np.exp(-0.5 * z**2) / np.sqrt(2.0 * np.pi)
    return np.asarray(sd_db * (z * (2.0 * ndtr(z) - 1.0) + 2.0 * density - 1.0 / np.sqrt(np.pi)))


def level_scores(series: Sequence[LevelSeries]) -> dict[str, float]:
    """Scores of one task: the mean over its series, so that a long flight counts no more than a short one.

    Parameters
    ----------
    series : sequence of LevelSeries
        At least one.

    Returns
    -------
    dict of str to float
        ``rmse_db, rmse_4s_db, bias_db`` (mean size of the offsets), ``crps_db, log_score, coverage_90`` (NaN without
        ``sd_db``), ``n``.
    """
    rows = [_series_scores(item) for item in series]
    return {key: float(np.mean([row[key] for row in rows])) for key in rows[0] if key != "n"} | {
        "n": float(sum(row["n"] for row in rows))
    }


def _series_scores(s: LevelSeries) -> dict[str, float]:
    error = s.error_db
    slow = local_mean_db(s.time_s, s.measured_db, WINDOW_S) - local_mean_db(s.time_s, s.level_db, WINDOW_S)
    # the mean of local means is not that of the samples: it has an offset of its own
    slow = slow - slow.mean() if s.own_offset else slow
    scores = {
        "rmse_db": float(np.sqrt(np.mean(error**2))),
        "rmse_4s_db": float(np.sqrt(np.mean(slow**2))),
        "bias_db": abs(s.bias_db),
        "crps_db": np.nan,
        "log_score": np.nan,
        "coverage_90": np.nan,
        "n": float(len(error)),
    }
    if s.sd_db is not None:
        scores["crps_db"] = float(crps_normal(error, s.sd_db).mean())
        scores["log_score"] = float(np.mean(0.5 * (error / s.sd_db) ** 2 + np.log(np.sqrt(2.0 * np.pi) * s.sd_db)))
        scores["coverage_90"] = float(np.mean(np.abs(error) <= ndtri(0.5 + COVERAGE / 2) * s.sd_db))
    return scores
