"""Record and scores of a prediction that was made before a flight."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ..common.units import FloatArray
from ..compare.gains import NO_SPREAD, LostLock, StatedSpread, inside_shares
from ..compare.level import LevelSeries, level_scores
from ..compare.receiver import ForecastScore
from ..compare.verdict import Verdict, stated_errors


@dataclass(frozen=True, slots=True, kw_only=True)
class AgainstSeries(LevelSeries):
    """The predicted samples of one tower and channel, shape (n,). Levels are in the unit of the log [dB]."""

    sd_db: FloatArray
    position_m: FloatArray | None = None
    """East, north and up of each sample [m], shape (n, 3)."""

    own_offset: bool = False
    low_db: FloatArray
    high_db: FloatArray
    share_near: float
    start: np.datetime64 | None = None
    """Time of ``time_s`` 0 (UTC). None for logs with relative times."""
    common_db: FloatArray | float = 0.0
    """The part of ``sd_db`` that all samples of the flight may share [dB]."""

    lock: LostLock | None = None
    """The error model of a receiver that loses its lock, used instead of ``sd_db``."""

    @property
    def stated(self) -> Verdict:
        """True if the errors are as large as the stated standard deviations."""
        verdict = stated_errors(self.error_db, self.sd_db, self.common_db, self.position_m)
        return replace(verdict, where=self.name)

    @property
    def scores(self) -> dict[str, float]:
        """Scores of the prediction; ``own_offset_rmse_db`` is computed after the mean error is subtracted."""
        as_stated = StatedSpread(gain_sd_db=self.sd_db, spread=NO_SPREAD, lock=self.lock)
        scores = {
            **level_scores([self]),
            "bias_db": self.bias_db,
            "own_offset_rmse_db": float(self.error_db.std()),
            **{name.replace("inside", "coverage"): s for name, s in inside_shares(self.error_db, as_stated).items()},
            "coverage_90": float(np.mean((self.measured_db >= self.low_db) & (self.measured_db <= self.high_db))),
            "mean_sd_db": float(self.sd_db.mean()),
            "share_near": self.share_near,
        }
        if self.lock is not None:
            scores |= {"crps_db": as_stated.crps_db(self.error_db), "log_score": self.lock.log_score(self.error_db)}
        return scores


@dataclass(frozen=True, slots=True, kw_only=True)
class Against:
    """A prediction and the flight by which it is scored."""

    folder: str
    sentence: str
    generated: str
    flights: tuple[str, ...]
    series: tuple[AgainstSeries, ...]
    ranks: Mapping[str, ForecastScore] = field(default_factory=dict)
    """Scores of the rank forecasts, by tower."""
    words: str
    """Sentences that compare the prediction with the flight."""

    @property
    def scores(self) -> dict[str, dict[str, float]]:
        """Scores by ``tower channel``."""
        return {series.name: series.scores for series in self.series}

    def metrics(self) -> dict[str, Any]:
        """Return ``against`` of metrics.json."""
        return {
            "prediction": self.folder,
            "generated": self.generated,
            "flights": list(self.flights),
            "sentence": self.words,
            "scores": self.scores,
            "rank": dict(self.ranks),
        }
