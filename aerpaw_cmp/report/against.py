"""Record and numbers of the prediction made before a flight, beside what the flight measured."""

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
    """Samples (n,) of one tower and channel that were predicted, offset and all; levels in the unit of the log [dB]."""

    sd_db: FloatArray
    own_offset: bool = False
    low_db: FloatArray
    high_db: FloatArray
    share_near: float
    start: np.datetime64 | None = None
    """Instant of ``time_s`` 0 (UTC); None of logs with relative times."""
    common_db: FloatArray | float = 0.0
    """Part of ``sd_db`` that the whole flight may share."""

    lock: LostLock | None = None
    """In place of ``sd_db``, of a receiver that loses its lock."""

    @property
    def stated(self) -> Verdict:
        """True if the errors are as large as was stated."""
        return replace(stated_errors(self.error_db, self.sd_db, self.common_db), where=self.name)

    @property
    def scores(self) -> dict[str, float]:
        """Scores as predicted; ``own_offset_rmse_db`` about the mean of the flight."""
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
    """A prediction and the flight that followed."""

    folder: str
    sentence: str
    generated: str
    flights: tuple[str, ...]
    series: tuple[AgainstSeries, ...]
    ranks: Mapping[str, ForecastScore] = field(default_factory=dict)
    """By tower."""
    words: str
    """Sentences on what the flight says of the prediction."""

    @property
    def scores(self) -> dict[str, dict[str, float]]:
        """Scores by ``tower channel``."""
        return {series.name: series.scores for series in self.series}

    def metrics(self) -> dict[str, Any]:
        """``against`` of metrics.json."""
        return {
            "prediction": self.folder,
            "generated": self.generated,
            "flights": list(self.flights),
            "sentence": self.words,
            "scores": self.scores,
            "rank": dict(self.ranks),
        }
