"""Time and peak memory of the paper's map job, and whether memory grows with the number of heights.

Each run is a process of its own, so that its peak is its own. The whole job is ``aerpaw-cmp map lake_wheeler``: five
towers, three foliage modes, SISO and 4 x 4, RSS at 3 heights, rank at 10, three K, study, page and exports.

    python benchmarks/map_job.py [--quick] [--json]
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import resource
import tempfile
import time
from pathlib import Path


def whole(quick: bool) -> dict:
    """The command's job; seconds per stage from its own metrics."""
    from aerpaw_cmp.jobs.run import run_map

    with tempfile.TemporaryDirectory() as folder:
        metrics = run_map("lake_wheeler", out=Path(folder), quick=quick).metrics
        written = sum(path.stat().st_size for path in Path(folder).rglob("*") if path.is_file())
    return {"stages": metrics["stages"], "paths": metrics["paths"], "mib_written": written / 2**20}


def maps_only(heights: int, spacing_m: float) -> dict:
    """The maps alone at some number of heights."""
    from aerpaw_cmp.common.stages import Stages
    from aerpaw_cmp.jobs import coverage_map as mapping
    from aerpaw_cmp.site.siteyaml import load_site

    levels = tuple(30.0 + 5.0 * i for i in range(heights))
    settings = mapping.MapSettings(spacing_m=spacing_m, rank_altitudes_m=levels, rss_altitudes_m=(30.0,))
    return {"paths": mapping.make_maps(load_site("lake_wheeler"), settings, Stages()).paths}


def _child(pipe, job, arguments) -> None:
    begin = time.perf_counter()
    result = job(*arguments)
    used = resource.getrusage(resource.RUSAGE_SELF)
    result |= {"seconds": time.perf_counter() - begin, "cpu_s": used.ru_utime, "peak_mib": used.ru_maxrss / 1024}
    pipe.send(result)


def measured(job, *arguments) -> dict:
    """Run a job in a fresh process."""
    context = multiprocessing.get_context("spawn")
    mine, theirs = context.Pipe()
    process = context.Process(target=_child, args=(theirs, job, arguments))
    process.start()
    result = mine.recv()
    process.join()
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    spacing = 120.0 if arguments.quick else 30.0
    job = measured(whole, arguments.quick)
    few, many = measured(maps_only, 3, spacing), measured(maps_only, 17, spacing)
    result = {
        "conditions": {"cpus": os.cpu_count(), "load": os.getloadavg()[0], "spacing_m": spacing},
        "job": job,
        "heights": {"3": few, "17": many},
        "ratios": {
            "five_minutes_over_job": 300.0 / job["seconds"],
            "two_gib_over_peak": 2048.0 / job["peak_mib"],
            "peak_17_over_3_heights": many["peak_mib"] / few["peak_mib"],
        },
    }
    if arguments.json:
        print(json.dumps(result, indent=1))
        return
    print(f"{result['conditions']}")
    print(f"whole job: {job['seconds']:.1f} s ({job['cpu_s']:.1f} s CPU), peak {job['peak_mib']:.0f} MiB")
    print(f"    {job['paths']} paths, {job['mib_written']:.1f} MiB written; {job['stages']}")
    for heights, row in result["heights"].items():
        print(
            f"maps at {heights} heights: {row['seconds']:.1f} s, peak {row['peak_mib']:.0f} MiB, {row['paths']} paths"
        )
    for name, ratio in result["ratios"].items():
        print(f"{name}: {ratio:.2f}")


if __name__ == "__main__":
    main()
