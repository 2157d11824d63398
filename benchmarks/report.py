"""Whole reports as processes: time as a ratio to a peer of the same run, and peak memory.

1. A two-channel flight of 3304 samples, image engine: time over that of importing what it is made of
   (``import sionna.rt, matplotlib.pyplot, pandas``). The real one where AERPAW_CMP_FIELD_DATA is set, else a simulated.
2. The sample flight: seconds and peak memory; the same without audit.
   The first and the second report of part 1, as it comes and with ``--audit none``, caches empty before the first:
   over those imports, and over the imports without Sionna, which such a report does not load.

    python benchmarks/report.py [--quick] [--json]
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import yaml

ROOT = Path(__file__).parents[1]
IMPORTS = (
    "from aerpaw_cmp.machine.llvm import let_sionna_load as let; let(); import sionna.rt, matplotlib.pyplot, pandas"
)
"""What every report with its audit has to load, as a program."""
LIGHT = "import matplotlib.pyplot, pandas"


def run(command: list[str], **environment: str) -> dict[str, float]:
    """Seconds (with its children) and peak memory [MiB] of one process, the largest of it and its children."""
    path = f"{ROOT}{os.pathsep}{ROOT / 'parsers'}"
    with tempfile.TemporaryFile() as said:
        started = time.perf_counter()
        process = subprocess.Popen(
            command, stdout=said, stderr=said, env={**os.environ, "PYTHONPATH": path, **environment}
        )
        _, status, used = os.wait4(process.pid, 0)  # RUSAGE_CHILDREN has the peak of all processes before it
        process.returncode = os.waitstatus_to_exitcode(status)
        wall = time.perf_counter() - started
        if process.returncode:
            said.seek(0)
            raise SystemExit(f"{' '.join(command)}\n{said.read().decode(errors='replace')}")
    return {"wall_s": wall, "cpu_s": used.ru_utime + used.ru_stime, "peak_mib": used.ru_maxrss / 1024}


def report(flight: Path, out: Path, *options: str) -> list[str]:
    """The command line of a report."""
    return [sys.executable, "-m", "aerpaw_cmp", "report", str(flight), "-o", str(out), *options]


def two_channels(folder: Path) -> tuple[Path, list[str], str]:
    """The flight of part 1, its options, and where it comes from."""
    field = os.environ.get("AERPAW_CMP_FIELD_DATA")
    if field:
        return ROOT / "tests" / "field" / "dataset12_40m.yaml", ["--logs-root", field], "dataset12 40 m"
    content = yaml.safe_load((ROOT / "sample_logs" / "flight.yaml").read_text())
    content["flight"]["plan"] |= {"rss_interval_s": 0.1, "offsets_db": {}, "bad_lines": 0}
    content["logs"] = [log for log in content["logs"] if log.get("node") in (None, "LW1") and "ri" not in log["path"]]
    flight = folder / "flight.yaml"
    flight.write_text(yaml.safe_dump(content))
    run([sys.executable, "-m", "aerpaw_cmp", "simulate", str(flight), "-o", str(folder / "flown")])
    return folder / "flown" / "flight.yaml", [], "simulated, one tower, two channels"


def cold_and_warm(flight: Path, options: list[str], folder: Path, repeats: int) -> dict[str, dict[str, float]]:
    """First (cold) and next (warm) report, by processor time over the imports; medians."""
    found: dict[str, list[dict[str, float]]] = {"cold": [], "warm": []}
    for number in range(repeats):
        kept = folder / f"kept{number}"
        empty = {key: str(kept / key) for key in ("HOME", "XDG_CACHE_HOME", "MPLCONFIGDIR", "AERPAW_CMP_CACHE")}
        kept.mkdir(parents=True)  # Dr.Jit keeps its kernels in the home folder
        for name, rows in found.items():
            imports, light = (run([sys.executable, "-c", text])["cpu_s"] for text in (IMPORTS, LIGHT))
            one = run(report(flight, folder / f"{name}{number}", *options), **empty)
            rows.append({**one, "ratio": one["cpu_s"] / imports, "ratio_light": one["cpu_s"] / light})
    return {name: {key: statistics.median(row[key] for row in rows) for key in rows[0]} for name, rows in found.items()}


def main() -> None:
    """Print both parts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="one run of each")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    repeats = 1 if arguments.quick else 3
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        flight, options, source = two_channels(folder)
        imports, reports = [], []
        run([sys.executable, "-c", IMPORTS])
        for number in range(repeats):  # in turns: a machine that slows down slows both
            imports.append(run([sys.executable, "-c", IMPORTS]))
            reports.append(run(report(flight, folder / f"r{number}", *options)))
        some = ROOT / "sample_logs" / "flight.yaml"
        sample = run(report(some, folder / "sample"))
        sample_later = run(report(some, folder / "sample_later", "--audit", "none"))
        now = cold_and_warm(flight, options, folder / "now", repeats)
        later = cold_and_warm(flight, [*options, "--audit", "none"], folder / "later", repeats)
    result = {
        "two_channels": {
            "flight": source,
            "imports_s": statistics.median(r["wall_s"] for r in imports),
            "report_s": statistics.median(r["wall_s"] for r in reports),
            "ratio": statistics.median(r["wall_s"] / i["wall_s"] for r, i in zip(reports, imports, strict=True)),
            "ratio_cpu": statistics.median(r["cpu_s"] / i["cpu_s"] for r, i in zip(reports, imports, strict=True)),
            "peak_mib": max(r["peak_mib"] for r in reports),
        },
        "sample": sample,
        "sample_later": sample_later,
        "now": now,
        "later": later,
    }
    if arguments.json:
        print(json.dumps(result, indent=1))
        return
    one, two = result["two_channels"], result["sample"]
    print(
        f"report of {one['flight']}: {one['report_s']:.1f} s, "
        f"{one['ratio']:.2f} x the imports of {one['imports_s']:.1f} s ({one['ratio_cpu']:.2f} x in processor time)"
    )
    print(f"sample flight: {two['wall_s']:.1f} s, peak memory {two['peak_mib']:.0f} MiB")
    print(f"sample flight without audit: {sample_later['cpu_s']:.1f} s of processor, "
          f"{sample_later['wall_s']:.1f} s, {sample_later['peak_mib']:.0f} MiB")  # fmt: skip
    for name, row in {**now, **{f"{key}, --audit none": row for key, row in later.items()}}.items():
        print(f"{name}: {row['cpu_s']:.1f} s of processor ({row['wall_s']:.1f} s), {row['ratio']:.2f} x "
              f"the imports, {row['ratio_light']:.2f} x the imports without Sionna")  # fmt: skip


if __name__ == "__main__":
    main()
