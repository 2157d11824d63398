"""Kriging of measured RSS and rank: blocks of real flights held out, and one flight predicted from another.

Samples are averaged over places of a few metres. A block is a stretch of the flight as it was flown, left out whole;
with it goes whatever other part of the flight lies within ``--gap`` of it, so that no neighbour gives it away. The
correlation is fitted to the remaining places of each fold. RSS is interpolated as measured, and as what the replay
leaves (measured minus replayed, with the replay added back).

    AERPAW_CMP_FIELD_DATA=... python benchmarks/kriging_field.py [--quick] [--json]
"""

from __future__ import annotations

import argparse
import json
import os
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from aerpaw_cmp.common.units import FloatArray, IntArray
from aerpaw_cmp.flight.data import gather, rank_positions, read_logs
from aerpaw_cmp.flight.replay import replay_rss
from aerpaw_cmp.flight.settings import load_flight
from aerpaw_cmp.maps.evaluate import interval_coverage
from aerpaw_cmp.maps.interpolate import InverseDistance, Nearest
from aerpaw_cmp.maps.kriging import OrdinaryKriging
from aerpaw_cmp.maps.variogram import field_correlation, fit_biexponential

PLACE_M = 5.0
BIN_M = 10.0


@dataclass(frozen=True)
class Places:
    """Means over places in flight order: ``points_m`` (n, 2), ``along_m`` (n,), ``value`` and ``trend`` (n,)."""

    name: str
    points_m: FloatArray
    along_m: FloatArray
    value: FloatArray
    trend: FloatArray


def places(name: str, position_m: FloatArray, value: FloatArray, trend: FloatArray) -> Places:
    good = np.isfinite(position_m).all(axis=1) & np.isfinite(value) & np.isfinite(trend) & (position_m[:, 2] > 10.0)
    at, value, trend = position_m[good, :2], value[good], trend[good]
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(at, axis=0).T))])
    _, place = np.unique(np.floor(along / PLACE_M), return_inverse=True)

    def mean(x: FloatArray) -> FloatArray:
        return np.bincount(place, x) / np.bincount(place)

    return Places(name, np.column_stack([mean(at[:, 0]), mean(at[:, 1])]), mean(along), mean(value), mean(trend))


def flights(data: Path, names: list[str]) -> list[Places]:
    """RSS channels and rank logs of flight files; the trend of RSS is its replay, of rank nothing."""
    found = []
    for name in names:
        path = Path(__file__).parents[1] / "tests" / "field" / f"{name}.yaml"
        settings = load_flight(path)
        flight = gather(settings, path.parent, read_logs(settings, path.parent, data), data)
        if flight.rss:
            for series, replayed in zip(flight.rss, replay_rss(flight), strict=True):
                position = flight.track.pose_at(series.time).position_m
                trend = replayed.spread(replayed.replay.rss_power_dbm[:, 0])
                found.append(places(f"{name} RSS {series.channel} [dB]", position, series.measured_db, trend))
        for reported in flight.rank:
            position, _ = rank_positions(reported, flight.track)
            found.append(places(f"{name} rank", position, reported.rank, np.zeros(len(position))))
    return found


def fitted(points_m: FloatArray, value: FloatArray):
    binned = field_correlation(points_m, value[:, None], width_m=BIN_M, maximum_m=300.0)
    some = np.isfinite(binned.correlation)
    return fit_biexponential(binned.distance_m[some], binned.correlation[some])


def models(points_m: FloatArray, value: FloatArray) -> dict:
    curve = fitted(points_m, value)
    return {
        # measured levels are noisy: the nugget is noise, not a jump of the field
        "Kriging": OrdinaryKriging(curve, 20, 150.0, exact=False, outside="nearest"),
        "nearest": Nearest(np.inf),
        "inverse distance": InverseDistance(20, np.inf),
    }


def blocks(one: Places, length_m: float) -> IntArray:
    return np.floor(one.along_m / length_m).astype(np.int64)


def predict(train: Places, some: np.ndarray, targets_m: FloatArray, target_trend: FloatArray) -> dict:
    """Estimates (and the Kriging variance) at targets from some places, plain and on what the trend leaves."""
    out = {"mean": np.full(len(targets_m), train.value[some].mean())}
    points = train.points_m[some]
    for name, model in models(points, train.value[some]).items():
        out[name], variance = model.fit(points, train.value[some]).predict(targets_m)
        if name == "Kriging":
            out["variance"] = variance
    if train.trend.any():
        rest = train.value[some] - train.trend[some]
        out["replay + mean"] = target_trend + rest.mean()
        model = models(points, rest)["Kriging"]
        out["replay + Kriging"] = target_trend + model.fit(points, rest).predict(targets_m)[0]
    return out


def held_out(one: Places, length_m: float, gap_m: float, every: int = 1) -> dict:
    """Errors of each method over all blocks of a flight, or over every so manieth."""
    block = blocks(one, length_m)
    found: dict[str, FloatArray] = {}
    for number in np.unique(block)[::every]:
        test = block == number
        reach = np.hypot(*(one.points_m[:, None] - one.points_m[None, test]).transpose(2, 0, 1)).min(axis=1)
        some = reach > gap_m
        if some.sum() < 50:
            continue
        for name, values in predict(one, some, one.points_m[test], one.trend[test]).items():
            found.setdefault(name, np.full(len(block), np.nan))[test] = values
    return scores(one.value, found)


def scores(value: FloatArray, found: dict[str, FloatArray]) -> dict:
    variance = found.pop("variance")
    inside = interval_coverage(value, found["Kriging"], variance, (0.9,))
    result = {"n": int(np.isfinite(found["Kriging"]).sum()), "inside_90": float(inside.observed[0])}
    for name, estimate in found.items():
        error = (estimate - value)[np.isfinite(estimate)]
        result[name] = {"mae": float(np.abs(error).mean()), "rmse": float(np.sqrt((error**2).mean()))}
    return result


def study(data: Path, quick: bool) -> dict:
    names = ["dataset12_70m", "nr_rank_flight1", "nr_rank_flight3"]
    names += [] if quick else ["dataset12_40m"]
    every = flights(data, names)
    rows = {}
    for one in every:
        for length in (100.0,) if quick else (50.0, 100.0, 200.0):
            rows[f"{one.name}, blocks of {length:g} m"] = held_out(one, length, length / 4)
    by_name = {one.name: one for one in every}
    for train, test in (("nr_rank_flight1", "nr_rank_flight3"), ("nr_rank_flight3", "nr_rank_flight1")):
        a, b = by_name[f"{train} rank"], by_name[f"{test} rank"]
        found = predict(a, np.ones(len(a.value), bool), b.points_m, b.trend)
        rows[f"{test} rank, from {train}"] = scores(b.value, found)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    folder = os.environ.get("AERPAW_CMP_FIELD_DATA")
    if not folder:
        raise SystemExit("AERPAW_CMP_FIELD_DATA does not name the folder of the real logs")
    begin = time.perf_counter()
    rows = study(Path(folder), arguments.quick)
    if arguments.json:
        print(json.dumps({"rows": rows, "seconds": time.perf_counter() - begin}, indent=1))
        return
    for name, row in rows.items():
        print(f"{name}: {row['n']} places, 90 % interval holds {100 * row['inside_90']:.0f} %")
        for method, score in row.items():
            if isinstance(score, dict):
                print(f"    {method:18s} MAE {score['mae']:6.3f}  RMSE {score['rmse']:6.3f}")
    print(f"{time.perf_counter() - begin:.1f} s on {os.cpu_count()} cores")


if __name__ == "__main__":
    main()
