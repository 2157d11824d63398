"""Seconds of the comparison stages of a report: 10 000 samples, 5 towers, 2 channels, rank, 1000 replicates.

A made-up flight goes through the code of ``aerpaw-cmp report``: clocks, replay, and the comparison with all its
optional parts (alternatives of measured-like antennas, paired foliage, pairs of channels). Nothing is drawn.

    python benchmarks/whole_comparison.py [--quick] [--json]
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import resource
import time
from pathlib import Path

import numpy as np

from aerpaw_cmp.common.stages import Stages
from aerpaw_cmp.flight.data import FlightData, RankSeries, RssSeries, choose_site
from aerpaw_cmp.flight.replay import replay_flight
from aerpaw_cmp.flight.settings import FlightFile
from aerpaw_cmp.flight.track import Track
from aerpaw_cmp.jobs.compare_flight import compare_rank_series, compare_rss_series, pairs_of

ANTENNA = {"model": "tr38901", "installed_db": [1.0, 0.0]}


def made_up(samples: int, towers: int) -> FlightData:
    """A round over the packaged site; levels follow free space with fading, ranks are drawn."""
    import pandas as pd

    link = {"carrier_hz": 3.3e9, "tower": {"antenna": ANTENNA}, "uav": {"antenna": {"model": "dipole"}}}
    settings = FlightFile.model_validate(
        {
            "flight": "made_up",
            "logs": [{"path": "none"}],
            "link": {"rss": link},
            "rt": {"attitude": "logged", "paired_foliage": True, "max_depth": 1},
            "rss": {"span_db": [-150, 150]},
        }
    )
    site = choose_site(settings.site, Path())
    t = np.arange(samples) * 0.1
    time_stamp = np.datetime64("2025-06-01T14:00:00", "ns") + np.round(t * 1e9).astype("timedelta64[ns]")
    east, north = 300 * np.sin(t / 90), 500 + 600 * np.sin(t / 130)
    latitude, longitude = site.frame.to_geographic(east, north)
    heading = np.degrees(np.arctan2(np.gradient(east), np.gradient(north))) % 360
    flat = np.zeros(samples)
    frame = pd.DataFrame(
        {
            "time": time_stamp, "latitude_deg": latitude, "longitude_deg": longitude, "altitude_m": flat + 50,
            "roll_deg": flat, "pitch_deg": flat, "yaw_deg": heading, "velocity_north_mps": flat,
            "velocity_east_mps": flat, "velocity_down_mps": flat, "fix": 3, "satellites": 12,
        }
    ).iloc[::10]  # fmt: skip
    rng = np.random.default_rng(0)
    names = list(site.towers)[:towers]
    place = np.column_stack([east, north, flat + 50])
    rss = []
    for name in names:
        distance = np.linalg.norm(place - site.towers[name].position_m, axis=1)
        for channel in ("USRP1", "USRP2"):
            level = -20 * np.log10(distance) - 20 + rng.normal(0, 3, samples)
            own = settings.link.rss
            rss.append(
                RssSeries(
                    tower=name, channel=channel, unit="dBm", time=time_stamp, measured_db=level, link=own,
                    settings_key=own.model_dump_json(),
                )
            )  # fmt: skip
    ri = rng.integers(1, 4, samples).astype(float)
    rank = RankSeries(tower=names[0], time=time_stamp, rank=ri, sinr_db=flat + 20, position_m=None)
    track = Track(frame, site.frame)
    return FlightData(
        settings=settings, folder=Path(), site=site, files=(), track=track, rss=tuple(rss), rank=(rank,), warnings=()
    )


def run(samples: int, towers: int, replicates: int) -> dict[str, float]:
    """Seconds per stage."""
    data = made_up(samples, towers)
    rss = data.settings.rss.model_copy(update={"bootstrap": replicates})
    rank = data.settings.rank.model_copy(update={"bootstrap": replicates})
    data = dataclasses.replace(data, settings=data.settings.model_copy(update={"rss": rss, "rank": rank}))
    stages = Stages()
    replays = replay_flight(data, stages)
    with stages("rss"):
        compared = [compare_rss_series(data, s, r) for s, r in zip(data.rss, replays.rss, strict=True)]
    with stages("rank"):
        for series, replayed in zip(data.rank, replays.rank, strict=True):
            compare_rank_series(data, series, replayed)
    with stages("pairs"):
        pairs_of(compared)
    spent = {f"{name}_s": seconds for name, seconds in stages.seconds.items()}
    spent["comparison_s"] = spent["rss_s"] + spent["rank_s"] + spent["pairs_s"]
    return spent


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="1 000 samples, 1 tower, 100 replicates")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    samples, towers, replicates = (1000, 1, 100) if arguments.quick else (10_000, 5, 1000)
    cpu = time.process_time()
    found: dict[str, float] = run(samples, towers, replicates)
    found |= {
        "cpu_s": time.process_time() - cpu,
        "peak_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "of_the_ten_seconds": found["comparison_s"] / 10.0,
    }
    conditions = {"samples": samples, "towers": towers, "channels": 2, "replicates": replicates, "cpus": os.cpu_count()}
    if arguments.json:
        print(json.dumps({**conditions, **found}))
        return
    print(", ".join(f"{value} {name}" for name, value in conditions.items()))
    for name, value in found.items():
        print(f"  {name:20s} {value:9.2f}")


if __name__ == "__main__":
    main()
