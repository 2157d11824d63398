"""Rank as a receiver decides it: fitted on one real NR flight, scored on the other, both ways (needs the field logs).

Geometry of the UAV's antennas (mount, slants, strength of the ground ray), timing (how much later the positions, over
how long the channel is averaged), penalty and decision are chosen by the log score on sectors of directions left out
within the training flight; nothing of the scored flight takes part. Beside it:
one threshold per stream, an ordered regression, the same with directions left out (fitted and scored in different
sectors of one flight), the coherent ground, distance and elevation alone, the rate of a Type I codebook, cross-polar
discrimination, the hysteresis of the report, always the commonest rank, and what another flight's reports at the same
places are worth.

    AERPAW_CMP_FIELD_DATA=DIR python benchmarks/rank_receiver.py [--step DEG] [--json]
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from aerpaw_cmp.common.geodesy import SiteFrame
from aerpaw_cmp.common.units import FloatArray, IntArray, wavelength_m
from aerpaw_cmp.compare.codebook import codebook_rank, codebook_rates
from aerpaw_cmp.compare.forecast import constant_forecast, one_hot, repeat_ceiling, score_forecast
from aerpaw_cmp.compare.rank import cohen_kappa
from aerpaw_cmp.compare.receiver import (
    PENALTIES,
    fit_ordered,
    fit_receiver,
    fit_thresholds,
    out_of_group,
    rank_by_thresholds,
    sector_groups,
)
from aerpaw_cmp.jobs.calibrate_rank import RankFitSettings, RankSamples, Timing, Tried, features_of
from aerpaw_cmp.propagation.arrays import (
    Link,
    Poses,
    rotation_from_yaw_pitch_roll,
    tower_comparison_array,
    uav_comparison_array,
)
from aerpaw_cmp.propagation.drivers.geometries import Geometry, basis_fields, slant_basis

LW1 = (35.72750947, -78.69595819)
ANTENNA_M = np.array([0.0, 0.0, 12.0])
CARRIER_HZ = 3.4e9
LOWEST_M = 10.0
FLIGHTS = ("1", "3")
TOWER_SLANTS = (45.0, -45.0, 45.0, -45.0)
"""Two dual-port sector antennas at +-45 deg; the second the other way round changes nothing that the data can tell."""
HEADLINE = "multinomial, mean of tied geometries"


@dataclass(frozen=True, slots=True)
class Flight:
    """Samples above 10 m."""

    position_m: FloatArray
    rank: IntArray
    sinr_db: FloatArray
    time_s: FloatArray

    def samples(self, name: str) -> RankSamples:
        """As ``calibrate`` takes them, the handset level in axes of the site."""
        tower = dataclasses.replace(tower_comparison_array(), slant_rad=np.radians(TOWER_SLANTS))
        link = Link(CARRIER_HZ, {"LW1": tower}, uav_comparison_array(wavelength_m(CARRIER_HZ)), uav_transmits=False)
        return RankSamples(
            flight=name,
            tower="LW1",
            tower_m=ANTENNA_M,
            poses=Poses(self.position_m, np.tile(np.eye(3), (len(self.rank), 1, 1))),
            rank=self.rank.astype(np.float64),
            link=link,
            time_s=self.time_s,
        )


def read_flight(root: Path, name: str) -> Flight:
    log = pd.read_csv(root / "nr_rank" / f"july2_2024_flight{name}_nemo_nr.csv")
    log = log[(log.alt_m > LOWEST_M) & log.pdsch_rank.notna()]
    east, north = SiteFrame(*LW1).to_local(log.lat.to_numpy(), log.lon.to_numpy())
    position = np.column_stack([east, north, log.alt_m.to_numpy()])
    return Flight(position, log.pdsch_rank.to_numpy().astype(np.int64), log.nr_sinr_db.to_numpy(),
                  log.rel_time_ms.to_numpy() / 1e3)  # fmt: skip


def channel_of(geometry: Geometry, flight: Flight) -> Any:
    """Coherent channel matrices of one geometry."""
    turn = np.radians([geometry.uav_yaw_deg, geometry.uav_pitch_deg, geometry.uav_roll_deg])
    uav = dataclasses.replace(uav_comparison_array(wavelength_m(CARRIER_HZ)), mount=rotation_from_yaw_pitch_roll(*turn))
    poses = Poses(flight.position_m, np.broadcast_to(np.eye(3), (len(flight.rank), 3, 3)))
    los, ground = basis_fields(tower_comparison_array(), ANTENNA_M, uav, poses, CARRIER_HZ)
    return (
        slant_basis(geometry.uav_slant_deg) @ (los + geometry.ground * ground) @ slant_basis(geometry.tower_slant_deg).T
    )


def one_way(train: Flight, test: Flight, step_deg: float, how: str, replicates: int) -> dict[str, Any]:
    """Everything fitted on ``train`` and scored on ``test``."""
    settings = RankFitSettings(yaw_step_deg=step_deg, sum=how)  # type: ignore[arg-type]
    tried, other = Tried.of([train.samples("train")], settings), test.samples("test")
    fitted = tried.fit([0])
    plain = dataclasses.replace(tried, settings=settings.model_copy(update={"shift_s": [0.0], "average_s": [0.0]}))
    mixture, best = fitted.mixture, fitted.geometries[0]
    here, there = (features_of((best,), one, fitted.timing)[0] for one in (tried.samples[0], other))
    groups = sector_groups(train.position_m, ANTENNA_M)
    receiver = fit_receiver(here, train.rank, groups)
    constant = constant_forecast(train.rank)
    p = receiver.probabilities(there)
    mixed, said = fitted.forecast(other)
    rows: dict[str, Any] = {
        HEADLINE: (mixed, said),
        "the same, most probable rank": (mixed, mixed.argmax(axis=1) + 1),
        "the same, no shift, no average": plain.fit([0]).forecast(other),
        "multinomial regression, best geometry": (p, receiver.decide(p)),
    }
    ordered = fit_ordered(here, train.rank).probabilities(there)
    rows["ordered regression"] = (ordered, ordered.argmax(axis=1) + 1)
    limits = fit_thresholds(here[:, :3], train.rank)
    rows["one threshold per stream"] = (None, rank_by_thresholds(there[:, :3], limits))
    rows["distance and elevation alone"] = place_alone(train, test)
    rates = codebook_rates(channel_of(best, train), train.sinr_db)
    cap, penalty = max(
        ((c, b) for c in (4.0, 5.5, 7.4, np.inf) for b in np.arange(0.0, 6.1, 0.5)),
        key=lambda at: np.nan_to_num(cohen_kappa(train.rank, codebook_rank(rates, cap_bits=at[0], penalty_bits=at[1]))),
    )
    said = codebook_rank(codebook_rates(channel_of(best, test), test.sinr_db), cap_bits=cap, penalty_bits=penalty)
    rows["Type I codebook at the logged SINR"] = (None, said)
    commonest = int(np.bincount(train.rank).argmax())
    rows["always the commonest rank"] = (np.tile(constant, (len(test.rank), 1)), np.full(len(test.rank), commonest))
    return {
        "geometry": best.in_words(),
        "tied": fitted.tied,
        "alike": [one.in_words() for one in fitted.geometries],
        "candidates": len(tried.geometries),
        "timing": dataclasses.asdict(fitted.timing),
        "penalty": mixture.members[0].penalty,
        "decision_weight": mixture.decision_weight.tolist(),
        "thresholds_db": limits,
        "rows": {name: scored(test.rank, p, said, constant, replicates) for name, (p, said) in rows.items()},
        "cross_polar": cross_polar(best, tried.samples[0], other, fitted.timing),
        "sector_left_out": sectors(here, train, receiver.penalty, constant, replicates),
    }


def cross_polar(geometry: Geometry, train: RankSamples, test: RankSamples, timing: Timing) -> dict[str, float]:
    """Kappa with ports of finite cross-polar discrimination: each port slanted off by atan(10^(-XPD/20))."""
    found = {}
    for xpd_db in (30.0, 20.0, 15.0, 10.0):
        off = float(np.degrees(np.arctan(10.0 ** (-xpd_db / 20.0))))
        leaky = dataclasses.replace(
            geometry,
            uav_slant_deg=tuple(s - np.copysign(off, s) for s in geometry.uav_slant_deg),
            tower_slant_deg=tuple(s - np.copysign(off, s) for s in geometry.tower_slant_deg),
        )
        groups = sector_groups(train.poses.position_m, ANTENNA_M)
        receiver = fit_receiver(features_of((leaky,), train, timing)[0], train.rank, groups)
        p = receiver.probabilities(features_of((leaky,), test, timing)[0])
        found[f"{xpd_db:g} dB"] = cohen_kappa(test.rank, receiver.decide(p))
    return found


def scored(rank: IntArray, p: FloatArray | None, said: IntArray, constant: FloatArray, replicates: int) -> Any:
    """A rule without probabilities has no proper score: its decided ranks stand for its histogram."""
    score = score_forecast(rank, one_hot(said) if p is None else p, said, constant, replicates=replicates).as_dict()
    if p is None:
        score |= dict.fromkeys(("log_score", "log_score_gain", "brier_score"))
    return score


def sectors(features: FloatArray, flight: Flight, penalty: float, constant: FloatArray, replicates: int) -> Any:
    """Within one flight: each eighth of the directions forecast from the others."""
    p = out_of_group(features, flight.rank, sector_groups(flight.position_m, ANTENNA_M), penalty)
    return score_forecast(flight.rank, p, p.argmax(axis=1) + 1, constant, replicates=replicates).as_dict()


def place_alone(train: Flight, test: Flight) -> tuple[FloatArray, IntArray]:
    """No antennas at all: log distance, elevation and their squares."""

    def columns(flight: Flight) -> FloatArray:
        away = flight.position_m - ANTENNA_M
        flat = np.hypot(away[:, 0], away[:, 1])
        far, up = np.log(np.hypot(flat, away[:, 2])), np.arctan2(away[:, 2], flat)
        return np.column_stack([far, up, far**2, up**2])

    receiver = fit_receiver(columns(train), train.rank, sector_groups(train.position_m, ANTENNA_M))
    p = receiver.probabilities(columns(test))
    return p, receiver.decide(p)


def held_reports(flight: Flight, seconds: float = 8.0) -> float:
    """Kappa of the modem's own report ``seconds`` ago: what hysteresis alone says."""
    before = np.searchsorted(flight.time_s, flight.time_s - seconds)
    good = np.abs(flight.time_s[before] - (flight.time_s - seconds)) < 1.0
    return cohen_kappa(flight.rank[good], flight.rank[before[good]])


def table(root: Path, step_deg: float, replicates: int, sums: tuple[str, ...]) -> dict[str, Any]:
    flights = {name: read_flight(root, name) for name in FLIGHTS}
    one, three = (flights[name] for name in FLIGHTS)
    return {
        "ways": {
            how: {
                f"{a} -> {b}": one_way(flights[a], flights[b], step_deg, how, replicates)
                for a, b in (FLIGHTS, FLIGHTS[::-1])
            }
            for how in sums
        },
        "repeat": repeat_ceiling(one.position_m, one.rank, three.position_m, three.rank).as_dict(),
        "report_8_s_ago": {name: held_reports(flight) for name, flight in flights.items()},
        "penalties": PENALTIES,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--step", type=float, default=30.0, help="yaw step of the geometries [deg]")
    parser.add_argument("--replicates", type=int, default=1000)
    parser.add_argument("--coherent", action="store_true", help="also with the ground ray added coherently")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--logs-root", type=Path, default=os.environ.get("AERPAW_CMP_FIELD_DATA") or None)
    arguments = parser.parse_args()
    if arguments.logs_root is None or not Path(arguments.logs_root).is_dir():
        print("rank_receiver: AERPAW_CMP_FIELD_DATA names no folder of real logs; nothing measured", file=sys.stderr)
        return
    begin = time.process_time()
    sums = ("power_sum", "coherent") if arguments.coherent else ("power_sum",)
    found = table(arguments.logs_root, arguments.step, arguments.replicates, sums)
    found["cpu_s"] = time.process_time() - begin
    if arguments.json:
        print(json.dumps(found, default=float))
        return
    show(found)


def show(found: dict[str, Any]) -> None:
    heads = ("kappa", "95 %", "agree", "commonest", "log", "gain", "Brier", "TV", "95 %")
    for how, ways in found["ways"].items():
        for way, row in ways.items():
            print(f"\nflight {way}, ground {how.replace('_', ' ')}: {row['geometry']}")
            timing = row["timing"]
            print(f"  positions {timing['shift_s']:g} s later, channel averaged over {timing['average_s']:g} s")
            print(f"  of {row['candidates']} geometries, {row['tied']} cannot be told apart from it, among them")
            for words in row["alike"][1:4]:
                print(f"    {words}")
            print(f"  {'':38s}" + " ".join(f"{h:>13s}" for h in heads))
            for name, s in [*row["rows"].items(), ("fitted flight, sectors left out", row["sector_left_out"])]:
                cells = [
                    s["kappa"], s["kappa_ci95"], s["agreement"], s["majority_agreement"], s["log_score"],
                    s["log_score_gain"], s["brier_score"], s["total_variation_expected"], s["total_variation_ci95"],
                ]  # fmt: skip
                print(f"  {name:38s}" + " ".join(f"{cell(c):>13s}" for c in cells))
            leaky = ", ".join(f"{k} {v:.3f}" for k, v in row["cross_polar"].items())
            print(f"  best geometry, cross-polar discrimination of both ends: kappa {leaky}")
        means = {
            key: np.mean([ways[w]["rows"][HEADLINE][key] for w in ways])
            for key in ("kappa", "log_score_gain", "total_variation_expected")
        }
        print(
            f"\nmean of both ways, ground {how.replace('_', ' ')}: "
            + ", ".join(f"{k} {v:.3f}" for k, v in means.items())
        )
    again = found["repeat"]
    print(f"same place on the other flight, within {again['within_m']:g} m: kappa {again['kappa']:.3f}, n {again['n']}")
    print("the modem's own report 8 s ago: kappa " + ", ".join(f"{v:.3f}" for v in found["report_8_s_ago"].values()))
    print(f"{found['cpu_s']:.1f} s of processor time")


def cell(value: Any) -> str:
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join("-" if v is None else f"{v:.2f}" for v in value) + "]"
    return "-" if value is None else f"{value:.3f}"


if __name__ == "__main__":
    main()
