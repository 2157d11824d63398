"""A flight held against what was predicted before it: ``report flight.yaml --against prediction/``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from ...common.errors import UsageError, parsing
from ...common.files import LARGEST_TABLE, read_bounded
from ...common.geodesy import bearing_deg
from ...common.provenance import KEY, MARKS
from ...common.units import FloatArray, IntArray
from ...compare.gains.spread import LostLock
from ...compare.learning.calibration import Observed
from ...compare.ranks.forecast import ForecastScore, score_forecast
from ...flight.data import FlightData
from ...flight.marks import among
from ...flight.training import common, flight_logs, marks_of
from ...report.against import Against, AgainstSeries
from ...report.prediction import against_words
from ..learning.calibrate import observe
from ..learning.calibrate_rank import RankSamples, rank_samples
from .predict import P_LOCK, RANKS

# A sample is scored by the nearest predicted point within these distances whose nose differs by less.
NEAR_M, _NEAR_UP_M, _TURNED_DEG = 30.0, 15.0, 45.0

FEWEST = 20


def score_against(data: FlightData, folder: Path) -> Against:
    """Score a flight with the prediction of an earlier run of ``predict``.

    Raises
    ------
    UsageError
        The flight's own log was learned from; no sample was predicted.
    InputError
        The folder holds no prediction.
    """
    with parsing(folder, "the output folder of 'aerpaw-cmp predict'", any_shape=True):
        about = json.loads(read_bounded(folder / "metrics.json", LARGEST_TABLE))
        table = pd.read_csv(folder / "prediction.csv", low_memory=False)
        learned, marked, sentence = list(about[KEY]), tuple(map(str, about.get(MARKS, ()))), str(about["sentence"])
        groups = dict(iter(table[table["level_db"].notna()].groupby(["tower", "channel"])))
        forecasts = dict(iter(table[table["channel"] == "rank"].groupby("tower")))
    own = common(flight_logs(data), [learned])
    if own or any(among(mark, marked) for mark in marks_of([data])):
        raise UsageError(
            f"the prediction learned from this flight's own {f'log (SHA-256 {own[0][:12]}...)' if own else 'readings'}",
            expected="a prediction made before the flight, or from other flights",
            path=folder,
        )
    series = [
        scored
        for o in (observe([data])[0] if data.rss else ())
        if (part := groups.get((o.samples.tower, o.samples.channel))) is not None
        and (scored := _matched(o, part)) is not None
    ]
    ranks = {
        s.tower: score
        for s in data.rank
        if s.tower in forecasts and (score := _rank_score(rank_samples(data, s), forecasts[s.tower])) is not None
    }
    if not series and not ranks:
        raise UsageError(
            f"no tower and channel of the flight has {FEWEST} samples within {NEAR_M:g} m of predicted points",
            expected="a prediction of this route: " + ", ".join(" ".join(map(str, key)) for key in groups),
            path=folder,
        )
    return Against(
        folder=folder.name,
        sentence=sentence,
        generated=str(about.get("generated", "")),
        flights=tuple(map(str, about.get("flights", ()))),
        series=tuple(series),
        ranks=ranks,
        words=against_words(series, ranks),
    )


def _matched(o: Observed, part: pd.DataFrame) -> AgainstSeries | None:
    """Samples near predicted points, each with the level that was predicted there."""
    good = np.isfinite(o.samples.residual_db)
    finite = o.part(good)
    index, near = _nearest(finite.samples.position_m, finite.heading_deg, part)
    if near.sum() < FEWEST:
        return None
    predicted, s = part.iloc[index[near]], finite.samples.part(near)

    def column(name: str) -> FloatArray:
        return np.asarray(predicted[name], dtype=np.float64)

    level_db, lock = column("level_db"), None
    if P_LOCK in predicted and predicted[P_LOCK].notna().all():
        lock = LostLock(
            probability=column(P_LOCK),
            locked_db=column("locked_db") - level_db,
            lost_db=column("lost_db") - level_db,
            locked_sd_db=float(column("locked_sd_db")[0]),
            lost_sd_db=float(column("lost_sd_db")[0]),
        )
    return AgainstSeries(
        name=f"{s.tower} {s.channel}",
        time_s=s.time_s,
        measured_db=s.residual_db + finite.free_space_db[near],
        level_db=level_db,
        lock=lock,
        sd_db=column("sd_db"),
        low_db=column("q05_db"),
        high_db=column("q95_db"),
        share_near=float(near.mean()),
        common_db=column("slow_sd_db") if "slow_sd_db" in predicted else 0.0,
        start=finite.start,
    )


def _rank_score(samples: RankSamples, part: pd.DataFrame) -> ForecastScore | None:
    """Score of predicted probabilities; the constant forecast beside it is their mean over the predicted points."""
    heading_deg = bearing_deg(samples.poses.rotation[:, :, 0])
    index, near = _nearest(samples.poses.position_m, heading_deg, part)
    if near.sum() < FEWEST:
        return None
    every = part[list(RANKS)].to_numpy(np.float64)
    forecast = every[index[near]]
    return score_forecast(samples.rank[near], forecast, forecast.argmax(axis=1) + 1, every.mean(axis=0))


def _nearest(position_m: FloatArray, heading_deg: FloatArray, part: pd.DataFrame) -> tuple[IntArray, Any]:
    """Predicted point (n,) of each sample, and which of them are near."""
    from scipy.spatial import cKDTree

    scale = np.array([NEAR_M, NEAR_M, _NEAR_UP_M, 1.0, 1.0])
    turn = 2.0 * np.sin(np.radians(_TURNED_DEG) / 2.0)

    def coordinates(place: FloatArray, yaw_deg: FloatArray) -> FloatArray:
        yaw = np.radians(yaw_deg)
        nose = np.column_stack([np.sin(yaw), np.cos(yaw)]) / turn
        return np.asarray(np.column_stack([place, np.nan_to_num(nose)]) / scale)

    points = coordinates(part[["east_m", "north_m", "height_m"]].to_numpy(), part["yaw_deg"].to_numpy())
    heading = heading_deg if part["yaw_deg"].notna().all() else np.full(len(heading_deg), np.nan)
    distance, index = cKDTree(points).query(coordinates(position_m, heading))
    return np.asarray(index), distance <= np.sqrt(2.0)
