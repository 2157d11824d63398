"""Record and numbers of the prediction made before a flight, beside what the flight measured."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ..common.units import FloatArray
from ..compare.forecast import ForecastScore
from ..compare.verdicts import Verdict, stated_errors
from .prediction_words import after_flight, rank_after_flight


@dataclass(frozen=True, slots=True, kw_only=True)
class AgainstSeries:
    """Samples (n,) of one tower and channel that were predicted; levels in the unit of the log [dB]."""

    tower: str
    channel: str
    time_s: FloatArray
    measured_db: FloatArray
    level_db: FloatArray
    sd_db: FloatArray
    low_db: FloatArray
    high_db: FloatArray
    share_near: float
    start: np.datetime64 | None = None
    """Instant of ``time_s`` 0 (UTC); None of logs with relative times."""
    common_db: FloatArray | float = 0.0
    """Part of ``sd_db`` that the whole flight may share."""

    @property
    def stated(self) -> Verdict:
        """True if the errors are as large as was stated."""
        found = stated_errors(self.measured_db - self.level_db, self.sd_db, self.common_db)
        return replace(found, where=f"{self.tower} {self.channel}")

    def coverage(self, share: float) -> float:
        """Share of samples inside the interval that is to hold so many."""
        from scipy.special import ndtri

        half = float(ndtri(0.5 + 0.5 * share)) * self.sd_db
        return float(np.mean(np.abs(self.measured_db - self.level_db) <= half))


@dataclass(frozen=True, slots=True, kw_only=True)
class Against:
    """A prediction and the flight that followed; ``scores`` by ``tower channel``."""

    folder: str
    sentence: str
    generated: str
    flights: tuple[str, ...]
    series: tuple[AgainstSeries, ...]
    scores: Mapping[str, Mapping[str, float]]
    ranks: Mapping[str, ForecastScore] = field(default_factory=dict)
    """By tower."""

    @property
    def words(self) -> str:
        """Sentences on what the flight says of the prediction."""
        said = [after_flight(self.scores, [item.stated for item in self.series])] if self.series else []
        return " ".join([*said, *(rank_after_flight(tower, score) for tower, score in self.ranks.items())])

    def metrics(self) -> dict[str, Any]:
        """``against`` of metrics.json."""
        return {
            "prediction": self.folder,
            "generated": self.generated,
            "flights": list(self.flights),
            "sentence": self.words,
            "scores": {name: dict(row) for name, row in self.scores.items()},
            "rank": {tower: score.as_dict() for tower, score in self.ranks.items()},
        }
