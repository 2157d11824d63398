"""Repeatability of a whole season: every pair of flights on every link, on simulated tracks.

    python benchmarks/repeats.py [--flights 200] [--towers 5] [--channels 2]
        [--samples 1000] [--heights 4] [--workers 1]

Flights are lawnmower routes over one field, each a metre off and at one of ``--heights`` heights, all ten links
sampled together. ``--heights 1`` is the worst case: every flight meets every other.
"""

from __future__ import annotations

import argparse
import os
import resource
import time

import numpy as np

from aerpaw_cmp.jobs.over_flights import RepeatSettings, repeats
from aerpaw_cmp.jobs.workers import open_workers
from aerpaw_cmp.report.campaign_data import RssRow


def rows(flights: int, towers: int, channels: int, samples: int, heights: int, seed: int = 0) -> list[RssRow]:
    """Series as a campaign has them."""
    rng = np.random.default_rng(seed)
    share = np.linspace(0.0, 1.0, samples)
    leg, along = np.floor(share * 10), (share * 10) % 1
    along = np.where(leg % 2 == 0, along, 1 - along)
    out = []
    for flight in range(flights):
        place = np.column_stack([along * 400 - 200, leg * 30 - 150, np.full(samples, 30.0 + 10.0 * (flight % heights))])
        place = place + rng.normal(0.0, 0.7, 3) + rng.normal(0.0, 0.3, place.shape)
        heading = np.where(leg % 2 == 0, 90.0, 270.0) + rng.normal(0.0, 5.0, samples)
        for tower in range(towers):
            simulated = -60.0 - 20.0 * np.log10(np.linalg.norm(place - [100.0 * tower, 0.0, 10.0], axis=1) + 1.0)
            for channel in range(channels):
                out.append(
                    RssRow(
                        flight=f"f{flight}", setting="as written", tower=f"LW{tower + 1}", channel=f"USRP{channel + 1}",
                        unit="dBm", offset_db=0.0, rmse_db=2.0, correlation=1.0, n=samples, n_out_of_coverage=0,
                        at_search_edge=False, rmse_ci95_db=None, offset_ci95_db=None, correlation_ci95=None,
                        n_effective=1.0, lag_s=0.0, lag_verdict="", fitted=(), baselines={}, step_db=0.1,
                        span_db=(-50.0, 50.0), time_s=share * 1000, distance_m=np.zeros(samples), position_m=place,
                        measured_db=simulated + rng.normal(0.0, 2.0, samples), simulated_dbm=simulated,
                        heading_deg=heading,
                    )
                )  # fmt: skip
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, default in (("flights", 200), ("towers", 5), ("channels", 2), ("samples", 1000), ("heights", 4)):
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument("--workers", type=int, default=1)
    asked = parser.parse_args()
    made = rows(asked.flights, asked.towers, asked.channels, asked.samples, asked.heights)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    with open_workers(asked.workers, progress=lambda text, *_: print(text)) as crew:
        wall, cpu = time.perf_counter(), time.process_time()
        found = repeats(made, RepeatSettings(), crew)
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu += used.ru_utime + used.ru_stime
    after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    meet = sum(pair.n > 0 for pair in found)
    print(f"{vars(asked)}, load {os.getloadavg()[0]:.1f}")
    print(
        f"{len(found)} pairs, {meet} of them meet: {cpu:.1f} CPU s, {wall:.1f} s, {1e3 * cpu / len(found):.2f} ms each"
    )
    print(f"memory: {before:.0f} MiB of series before, {after:.0f} MiB at the most")


if __name__ == "__main__":
    main()
