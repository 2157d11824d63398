"""Measure seconds, bytes and peak memory of each export of a long flight, each in a separate process.

    python benchmarks/exports.py [--samples 1000000] [--formats kmz,netcdf]

The flight is invented: one link with positions, four levels and a residual, all random with a seed. Only the writing is
measured, in CPU time. The peak is that of the process. For comparison, another process makes the samples and no file.
"""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np


def flight(samples: int):
    """An export of one link."""
    from aerpaw_cmp.report.columns import Column
    from aerpaw_cmp.report.exports import Export, points_table
    from aerpaw_cmp.report.flight_data import ReportData
    from aerpaw_cmp.site.siteyaml import load_site

    rng = np.random.default_rng(1)
    s = np.linspace(0, 1, samples)
    names = ("measured_db", "calibrated_db", "simulated_dbm", "residual_db", "free_space_dbm", "two_ray_dbm")
    time_utc = np.datetime64("2024-07-15T17:02:11", "ns") + np.round(s * samples * 1e8).astype("timedelta64[ns]")
    columns = {
        **{"tower": "LW1", "channel": "USRP1", "unit": "dBm"},
        **{"east_m": 500 * np.cos(50 * s), "north_m": 900 * np.sin(41 * s), "up_m": 40 + 30 * s},
        **{name: rng.normal(-80, 8, samples) for name in names},
    }
    data = ReportData(
        flight="long", title="A long flight", synthetic=True, site=load_site("lake_wheeler"), generated="",
    )  # fmt: skip
    rss = points_table("rss", data, [Column(name, "dBm", name) for name in names], [(time_utc, columns)])
    return Export(data=data, sets=(rss,), clock=True)


def write_one(name: str, samples: int) -> None:
    """Write one format and print its numbers."""
    from aerpaw_cmp.report.exports import write_exports

    export = flight(samples)
    with tempfile.TemporaryDirectory() as folder:
        start = time.process_time()
        files = write_exports(export, Path(folder), [] if name == "none" else [name])
        numbers = {"cpu_s": time.process_time() - start, "bytes": sum(path.stat().st_size for path in files)}
    numbers["peak_mib"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(json.dumps(numbers))


def main() -> None:
    from aerpaw_cmp.report.exports import FORMATS

    parser = argparse.ArgumentParser()
    parser.add_argument("--samples", type=int, default=100_000)
    parser.add_argument("--formats", default=",".join(FORMATS))
    parser.add_argument("--one")
    given = parser.parse_args()
    if given.one:
        write_one(given.one, given.samples)
        return
    print(
        f"{given.samples} samples of one link, six numbers each; Python {sys.version.split()[0]}, "
        f"NumPy {np.__version__}"
    )
    base = None
    for name in ["none", *given.formats.split(",")]:
        command = [sys.executable, __file__, "--one", name, "--samples", str(given.samples)]
        numbers = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
        base = base or numbers["peak_mib"]
        size, peak = numbers["bytes"] / 2**20, numbers["peak_mib"]
        print(f"{name:11s} {numbers['cpu_s']:7.1f} s CPU {size:8.1f} MiB, peak {peak:6.0f} MiB ({peak - base:+.0f})")
    print("in brackets: beyond a process that makes the samples and no file")


if __name__ == "__main__":
    main()
