"""How long the whole comparison of one flight takes, bootstrap included.

A simulated flight of 10 000 samples, 5 towers and 2 channels: levels with intervals and two baselines, residual
tables, error spans, the channel difference, and rank (measured RI against 4 x 4 channels) for each tower.

    python benchmarks/compare.py [--quick] [--json]
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import time

import numpy as np
from scipy.ndimage import gaussian_filter1d

from aerpaw_cmp.compare.offset import grid_offset
from aerpaw_cmp.compare.rank import channel_rank, compare_rank
from aerpaw_cmp.compare.rss import channel_difference, compare_rss, error_spans, residual_tables


def flight(samples: int) -> dict[str, np.ndarray]:
    t = np.arange(samples) * 0.1
    position = np.column_stack([300 * np.sin(t / 90), 300 * np.cos(t / 130), 40 + 5 * np.sin(t / 40)])
    return {"time": t, "position": position, "heading": np.degrees(t / 90) % 360}


def levels(route: dict[str, np.ndarray], tower: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    distance = np.linalg.norm(route["position"] - tower, axis=1)
    simulated = -20 * np.log10(distance) - 43
    shadow = gaussian_filter1d(rng.normal(size=len(distance)), 20)
    measured = simulated + 31 + 4 * shadow / shadow.std() + rng.normal(0, 2, len(distance))
    return measured, simulated


def channels(samples: int, rng: np.random.Generator) -> np.ndarray:
    h = rng.normal(size=(samples, 4, 4)) + 1j * rng.normal(size=(samples, 4, 4))
    return gaussian_filter1d(h, 15, axis=0) * np.array([1, 0.3, 0.05, 0.01])


def run(samples: int, towers: int, replicates: int) -> dict[str, float]:
    rng = np.random.default_rng(0)
    route = flight(samples)
    spent = {"rss_s": 0.0, "residuals_s": 0.0, "rank_s": 0.0, "offset_s": 0.0}
    for number in range(towers):
        tower = np.array([200.0 * number, -150.0 * number, 10.0])
        heard = []
        for _ in range(2):
            measured, simulated = levels(route, tower, rng)
            baselines = {"free_space": simulated + 1, "two_ray": simulated + rng.normal(size=samples)}
            begin = time.perf_counter()
            found = compare_rss(route["time"], measured, simulated, baselines=baselines)
            spent["rss_s"] += time.perf_counter() - begin
            begin = time.perf_counter()
            grid_offset(measured, simulated)
            spent["offset_s"] += time.perf_counter() - begin
            begin = time.perf_counter()
            context = {"heading_deg": route["heading"], "height_m": route["position"][:, 2]}
            residual_tables(found.residual_db, {**context, "time_s": route["time"]})
            error_spans(route["time"], found.residual_db, position_m=route["position"], context=context)
            spent["residuals_s"] += time.perf_counter() - begin
            heard.append(measured)
        begin = time.perf_counter()
        channel_difference(route["time"], heard[0], heard[1], position_m=route["position"], context=context)
        spent["residuals_s"] += time.perf_counter() - begin
        h = channels(samples, rng)
        ri = channel_rank(h + 0.02 * rng.normal(size=h.shape), 12.0).astype(float)
        begin = time.perf_counter()
        compare_rank(ri, h, sinr_db=rng.normal(15, 4, samples), replicates=replicates)
        spent["rank_s"] += time.perf_counter() - begin
    spent["total_s"] = spent["rss_s"] + spent["residuals_s"] + spent["rank_s"]
    return spent


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="1 000 samples, 1 tower, 100 replicates")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    samples, towers, replicates = (1000, 1, 100) if arguments.quick else (10_000, 5, 1000)
    cpu = time.process_time()
    spent = run(samples, towers, replicates)
    spent["cpu_s"] = time.process_time() - cpu  # with making the flight; on a busy machine the fairer number
    conditions = {
        "samples": samples,
        "towers": towers,
        "channels": 2,
        "replicates": replicates,
        "cores": os.cpu_count(),
        "peak_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "of_the_ten_seconds": spent["total_s"] / 10.0,
    }
    if arguments.json:
        print(json.dumps({**conditions, **spent}))
        return
    print(f"{samples} samples, {towers} towers, 2 channels, {replicates} replicates, {os.cpu_count()} cores")
    for name, seconds in spent.items():
        print(f"  {name:12s} {seconds:8.3f}")
    print(f"  share of the 10 s that the comparison may take: {conditions['of_the_ten_seconds']:.2f}")
    print(f"  peak memory {conditions['peak_mib']:.0f} MiB")


if __name__ == "__main__":
    main()
