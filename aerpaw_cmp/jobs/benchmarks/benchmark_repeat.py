"""The repeat of a task: how well another visit to the same place, seen from the UAV in the same direction, predicts.

A model of place and direction can hardly do better than 1/sqrt(2) of it: both visits have the fading within a few
wavelengths and the noise of the receiver.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from ...common.units import FloatArray
from ...compare.rank import cohen_kappa
from .benchmark import Bench

WITHIN_M, WITHIN_DEG, APART_S = 5.0, 10.0, 20.0
"""Two samples are of two visits when neither their places nor the directions to the tower from the airframe are further
apart than this, and they are of two flights or no nearer in time."""


@dataclass(frozen=True, slots=True)
class Repeat:
    """Agreement of two visits.

    Parameters
    ----------
    rmse_db : float
        Of levels, about the mean difference of two flights; NaN for ranks.
    kappa : float
        Of ranks; NaN for levels.
    share : float
        Of the test samples that have another visit.
    """

    rmse_db: float
    kappa: float
    share: float

    @property
    def words(self) -> str:
        """The number with its condition."""
        if not self.share > 0.0:
            return "Repeat: n/a (the flights at hand visit no place twice with one heading)."
        value = f"RMSE {self.rmse_db:.1f} dB" if math.isnan(self.kappa) else f"kappa {self.kappa:.2f}"
        return (
            f"Repeat: {value} between two visits within {WITHIN_M:g} m and {WITHIN_DEG:g} degrees, at least "
            f"{APART_S:g} s apart ({100.0 * self.share:.0f} % of the test samples have another visit)."
        )


@dataclass(frozen=True, slots=True)
class _Visits:
    """Samples of one series of one flight: of the tower, places and directions to it (n, 3), times, values (n,)."""

    flight: str
    series: str
    tower_m: FloatArray
    place: FloatArray
    at_uav: FloatArray
    time_s: FloatArray
    value: FloatArray


def repeat_of(bench: Bench, task: str) -> Repeat:
    """Each test sample against the nearest sample of every other visit, over the flights of the task at hand."""
    one = bench.manifest.tasks[task]
    rank = one.kind == "rank"
    flights = [f for f in dict.fromkeys((*one.test, *one.train)) if not bench.missing(f)]
    visits = [visit for flight in flights for visit in _visits(bench, flight, rank=rank)]
    pairs, repeated, samples = [np.empty((0, 2))], 0, 0
    for asked in [visit for visit in visits if visit.flight in one.test]:
        others = [known for known in visits if known.series == asked.series]
        again = np.zeros(len(asked.value), dtype=np.bool_)
        for known in [v for v in others if np.linalg.norm(v.tower_m - asked.tower_m) <= WITHIN_M]:
            other = _other_visit(asked, known)
            met = np.isfinite(other)
            both = np.column_stack([asked.value, other])[met]
            if not rank and known.flight != asked.flight and len(both):
                both[:, 1] += float(np.mean(both[:, 0] - both[:, 1]))  # gains of two flights are not the same
            pairs.append(both)
            again |= met
        repeated, samples = repeated + int(again.sum()), samples + len(again)
    values = np.concatenate(pairs)
    if not len(values):
        return Repeat(math.nan, math.nan, 0.0)
    if rank:
        return Repeat(math.nan, cohen_kappa(values[:, 0], values[:, 1]), repeated / samples)
    return Repeat(float(np.sqrt(np.mean((values[:, 0] - values[:, 1]) ** 2))), math.nan, repeated / samples)


def _visits(bench: Bench, flight: str, *, rank: bool) -> Iterator[_Visits]:
    if rank:
        for r in bench.ranks(flight):
            away = r.tower_m - r.poses.position_m
            away /= np.linalg.norm(away, axis=1, keepdims=True)
            yield _Visits(
                flight=flight,
                series=r.tower,
                tower_m=r.tower_m,
                place=r.poses.position_m,
                at_uav=np.einsum("nij,ni->nj", r.poses.rotation, away),
                time_s=r.time_s,
                value=r.rank,
            )
        return
    for o in bench.observed(flight):
        s = o.samples
        yield _Visits(
            flight=flight,
            series=f"{s.tower} {s.channel}",
            tower_m=bench.data(flight).site.towers[s.tower].position_m,
            place=s.position_m,
            at_uav=s.at_uav,
            time_s=s.time_s,
            value=s.residual_db + o.free_space_db,
        )


def _other_visit(asked: _Visits, known: _Visits) -> FloatArray:
    """Value (n,) of the nearest sample of another visit; NaN without any."""
    value = np.full(len(asked.value), np.nan)
    near = cKDTree(known.place).query_ball_point(asked.place, WITHIN_M)
    for row, inside in enumerate(near):
        index = np.asarray(inside, dtype=np.int64)
        index = index[known.at_uav[index] @ asked.at_uav[row] >= np.cos(np.radians(WITHIN_DEG))]
        if known.flight == asked.flight:
            index = index[np.abs(known.time_s[index] - asked.time_s[row]) >= APART_S]
        if len(index):
            away = np.linalg.norm(known.place[index] - asked.place[row], axis=1)
            value[row] = known.value[index[away.argmin()]]
    return value
