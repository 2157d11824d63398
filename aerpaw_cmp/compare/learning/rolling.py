"""The rest of a flight, predicted anew as its levels come in: a trend and a Gaussian process on what it leaves.

The trend is chosen by the CRPS of predictions some way ahead, and may be none at all. Means over :data:`BIN_S` are
kept, the latest :data:`KEEP` of them, so that an update costs the same at any time of the flight.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from ...common.gaussian import Factor
from ...common.units import FloatArray, IntArray
from ..judge.entries import crps_normal
from .field_gp import FieldModel, Rows, covariance

BIN_S = 2.0
KEEP = 150
LEAST = 8
# A trend is judged by what it says of levels so much later [s].
AHEAD_S = 20.0

# Weight of an older error against that of the next bin.
_FORGET = 0.98

LENGTHS_M = (30.0, 120.0)
SPEED_MPS = 8.0
NONE = "none"

_MODELS = {
    length: FieldModel(
        place_sd_db=3.0,
        length_m=length,
        height_m=length,
        turn=math.inf,
        offset_sd_db=0.0,
        drift_sd_db=1.0,
        drift_s=20.0,
        noise_sd_db=1.5,
    )
    for length in LENGTHS_M
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Ahead:
    """Levels of the rest of the route: index of its points (m,), median, standard deviation of a sample, trend."""

    index: IntArray
    level_db: FloatArray
    sd_db: FloatArray
    trend: str

    @property
    def interval_db(self) -> tuple[FloatArray, FloatArray]:
        """90 % interval of one sample (m,) each."""
        # 1.645: the 95 % point of the normal distribution
        return self.level_db - 1.645 * self.sd_db, self.level_db + 1.645 * self.sd_db


@dataclass(slots=True)
class _Bins:
    """Closed bins, oldest first: place (n, 3), time (n,), level (n,), each trend (n,)."""

    place: list[FloatArray] = field(default_factory=list)
    time_s: list[float] = field(default_factory=list)
    level: list[float] = field(default_factory=list)
    trends: dict[str, list[float]] = field(default_factory=dict)

    def cut(self) -> None:
        for values in (self.place, self.time_s, self.level, *self.trends.values()):
            del values[:-KEEP]  # type: ignore[attr-defined]


class RouteAhead:
    """Prediction of a route's rest that learns from every record.

    Parameters
    ----------
    route_m : (m, 3)
        Points of the route in the order of flight [m].
    trends : mapping of str to (m,)
        Models of the level at these points [dB], up to a constant; "none" is added.
    """

    def __init__(self, route_m: FloatArray, trends: Mapping[str, FloatArray]) -> None:
        self.route_m = np.asarray(route_m, dtype=np.float64)
        self._trends = {**{k: np.asarray(v, dtype=np.float64) for k, v in trends.items()},
                        NONE: np.zeros(len(self.route_m))}  # fmt: skip
        self._scores: dict[tuple[str, float], tuple[float, float]] = {}
        self._bins, self._open = _Bins(trends={name: [] for name in self._trends}), list[tuple[float, ...]]()
        self._start, self._reached = math.nan, 0
        self.squares, self.samples = 0.0, 0

    def add(self, time_s: float, place_m: FloatArray, level_db: float, trends: Mapping[str, float]) -> Ahead | None:
        """Take a record in; the rest of the route anew where a bin closed, else None.

        Parameters
        ----------
        time_s : float
            Not before that of the record before.
        place_m : (3,)
        level_db : float
            Measured.
        trends : mapping of str to float
            Of every model, here.

        Returns
        -------
        Ahead or None
        """
        values = (time_s, *map(float, place_m), level_db, *(trends.get(name, 0.0) for name in self._trends))
        if not np.isfinite(values).all():
            return None
        closes = bool(self._open) and time_s - self._start >= BIN_S
        if closes:
            self._close()
        if not self._open:
            self._start = time_s
        self._open.append(values)
        return self._predict(np.asarray(place_m, dtype=np.float64)) if closes else None

    def _close(self) -> None:
        rows = np.array(self._open)
        time, east, north, up, level, *trends = rows.mean(axis=0)
        self.squares += float(((rows[:, 4] - level) ** 2).sum())
        self.samples += len(rows) - 1
        place = np.array([east, north, up])
        self._judge(time, place, level, dict(zip(self._trends, trends, strict=True)))
        bins = self._bins
        bins.place.append(place)
        bins.time_s.append(time)
        bins.level.append(level)
        for name, value in zip(self._trends, trends, strict=True):
            bins.trends[name].append(value)
        bins.cut()
        self._open.clear()

    def _judge(self, time: float, place: FloatArray, level: float, trends: Mapping[str, float]) -> None:
        """Score every trend on a bin by what it said :data:`AHEAD_S` before."""
        # only what was known so long before: else a trend is judged by levels beside it
        known = int(np.searchsorted(self._bins.time_s, time - AHEAD_S))
        if known < LEAST:
            return
        for length, model in _MODELS.items():
            moments = self._moments(model, known, place[None], np.array([time]), list(self._trends))
            for name, (mean, sd) in zip(self._trends, moments, strict=True):
                score = float(crps_normal(level - trends[name] - mean, sd)[0])
                total, weight = self._scores.get((name, length), (0.0, 0.0))
                self._scores[name, length] = (_FORGET * total + score, _FORGET * weight + 1.0)

    def _moments(
        self, model: FieldModel, known: int, place: FloatArray, time_s: FloatArray, names: Sequence[str]
    ) -> list[tuple[FloatArray, FloatArray]]:
        """Mean of each trend's residual and standard deviation of a bin (m,), from the first ``known`` bins.

        One factor serves all trends. The strengths are scaled to the data: ``s^2 = y' inv(K) y / n``.
        """
        rows = _rows(np.array(self._bins.place[:known]), np.array(self._bins.time_s[:known]))
        level = np.array(self._bins.level[:known])
        value = np.stack([level - np.array(self._bins.trends[name][:known]) for name in names], axis=1)
        matrix = covariance(model, rows, rows)
        matrix[np.diag_indices(known)] += model.noise_sd_db**2
        factor = Factor.of(matrix)
        middle = value.mean(axis=0)
        white = factor.whiten(value - middle)
        # a level that has not changed yet would make every interval a point
        scale = np.maximum((white**2).sum(axis=0) / known, 1e-2)
        targets = _rows(place, time_s)
        mean, explained = factor.condition(covariance(model, targets, rows), white)
        prior = float(covariance(model, targets.part([0]), targets.part([0]))[0, 0])
        variance = np.maximum(prior - explained, 0.0) + model.noise_sd_db**2
        return [(middle[k] + mean[:, k], np.sqrt(scale[k] * variance)) for k in range(len(names))]

    def _predict(self, place: FloatArray) -> Ahead | None:
        """The rest of the route from where the UAV is."""
        if len(self._bins.level) < LEAST:
            return None
        # onwards and not far: where a route crosses itself, the nearest point may be of its other leg
        window = slice(self._reached, self._reached + max(50, len(self.route_m) // 10))
        self._reached += int(np.linalg.norm(self.route_m[window] - place, axis=1).argmin())
        index = np.arange(self._reached, len(self.route_m))
        known = {key: total / weight for key, (total, weight) in self._scores.items()}
        # before anything was judged: no trend, and the longer memory
        trend, length = min(known, key=lambda key: known[key], default=(NONE, LENGTHS_M[-1]))
        now = self._bins.time_s[-1]
        steps = np.linalg.norm(np.diff(self.route_m[index], axis=0, prepend=place[None]), axis=1)
        count, later = len(self._bins.level), now + np.cumsum(steps) / SPEED_MPS
        mean, sd = self._moments(_MODELS[length], count, self.route_m[index], later, [trend])[0]
        within = math.sqrt(self.squares / self.samples) if self.samples else 0.0
        level = self._trends[trend][index] + mean
        return Ahead(index=index, level_db=level, sd_db=np.hypot(sd, within), trend=trend)


def _rows(place: FloatArray, time_s: FloatArray) -> Rows:
    n = len(place)
    return Rows(position_m=place, direction=np.zeros((n, 3)), time_s=time_s, flight=np.zeros(n, dtype=np.int64))
