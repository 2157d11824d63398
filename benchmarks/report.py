"""Whole reports as processes, the first and the next: time as a ratio to a peer of the same run, and peak memory.

A two-channel flight of 3304 samples, image engine (the real one where AERPAW_CMP_FIELD_DATA is set, else a simulated),
as it comes and with ``--audit none``: every cache of the program, of Dr.Jit and of matplotlib is empty before the
first, whose time holds the trial of an LLVM. Bytecode is compiled before. Ratios are to importing what it is made of
(``import sionna.rt, matplotlib.pyplot, pandas``), and to the imports without Sionna, which a report without audit does
not load: the median of all that the run measured, one before and one after each report. waits.py has later reports.

    python benchmarks/report.py [--quick] [--json]
"""

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
# What every report with its audit has to load, as a program.
IMPORTS = (
    "from aerpaw_cmp.propagation.llvm import let_sionna_load; let_sionna_load(); "
    "import sionna.rt, matplotlib.pyplot, pandas"
)
LIGHT = "import matplotlib.pyplot, pandas"


def run(command: list[str], **environment: str) -> dict[str, float]:
    """Seconds (with its children) and peak memory [MiB] of one process, the largest of it and its children."""
    path = f"{ROOT}{os.pathsep}{ROOT / 'parsers'}"
    inherited = {key: value for key, value in os.environ.items() if key != "PYTHONDONTWRITEBYTECODE"}
    with tempfile.TemporaryFile() as said:
        started = time.perf_counter()
        process = subprocess.Popen(
            command, stdout=said, stderr=said, env={**inherited, "PYTHONPATH": path, **environment}
        )
        _, status, used = os.wait4(process.pid, 0)  # RUSAGE_CHILDREN has the peak of all processes before it
        process.returncode = os.waitstatus_to_exitcode(status)
        wall = time.perf_counter() - started
        if process.returncode:
            said.seek(0)
            raise SystemExit(f"{' '.join(command)}\n{said.read().decode(errors='replace')}")
    return {"wall_s": wall, "cpu_s": used.ru_utime + used.ru_stime, "peak_mib": used.ru_maxrss / 1024}


class Imports:
    """Processor seconds of the imports, with Sionna and without, as they were measured in this run."""

    def __init__(self) -> None:
        self.seconds: dict[str, list[float]] = {IMPORTS: [], LIGHT: []}

    def take(self) -> None:
        """Measure both once more."""
        for text, taken in self.seconds.items():
            taken.append(run([sys.executable, "-c", text])["cpu_s"])

    def ratios(self, row: dict[str, float]) -> dict[str, float]:
        """A report with its ratios to the medians of the imports."""
        full, light = (row["cpu_s"] / statistics.median(taken) for taken in self.seconds.values())
        return {**row, "ratio": full, "ratio_light": light}


IMPORTED = Imports()


def report(flight: Path, out: Path, *options: str) -> list[str]:
    """The command line of a report."""
    return [sys.executable, "-m", "aerpaw_cmp", "report", str(flight), "-o", str(out), *options]


def two_channels(folder: Path) -> tuple[Path, list[str], str]:
    """The flight, its options, and where it comes from."""
    field = os.environ.get("AERPAW_CMP_FIELD_DATA")
    if field:
        return ROOT / "tests" / "field" / "dataset12_40m.yaml", ["--logs-root", field], "dataset12 40 m"
    content = yaml.safe_load((ROOT / "sample_logs" / "flight.yaml").read_text())
    content["flight"]["plan"] |= {"rss_interval_s": 0.1, "offsets_db": {}, "clock_shift_s": {}, "bad_lines": 0}
    content["logs"] = [log for log in content["logs"] if log.get("node") in (None, "LW1") and "ri" not in log["path"]]
    flight = folder / "flight.yaml"
    flight.write_text(yaml.safe_dump(content))
    run([sys.executable, "-m", "aerpaw_cmp", "simulate", str(flight), "-o", str(folder / "flown")])
    return folder / "flown" / "flight.yaml", [], "simulated, one tower, two channels"


def cold_and_warm(flight: Path, options: list[str], folder: Path, repeats: int) -> dict[str, dict[str, float]]:
    """Measure the first (cold) and the next (warm) reports, as medians.

    Measure the imports before and after each of them.
    """
    by_state: dict[str, list[dict[str, float]]] = {"cold": [], "warm": []}
    for number in range(repeats):
        caches = folder / f"kept{number}"
        empty = {key: str(caches / key) for key in ("HOME", "XDG_CACHE_HOME", "MPLCONFIGDIR", "AERPAW_CMP_CACHE")}
        caches.mkdir(parents=True)  # Dr.Jit keeps its kernels in the home folder
        for name, rows in by_state.items():
            IMPORTED.take()
            rows.append(run(report(flight, folder / f"{name}{number}", *options), **empty))
            IMPORTED.take()
    return {
        name: {key: statistics.median(row[key] for row in rows) for key in rows[0]} for name, rows in by_state.items()
    }


def main() -> None:
    """Print the first and the next report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="one run of each")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    repeats = 1 if arguments.quick else 3
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        flight, options, source = two_channels(folder)
        for text in (IMPORTS, LIGHT):  # not counted: bytecode and what the machine has not read from its disk yet
            run([sys.executable, "-c", text])
        run(report(flight, folder / "unmeasured", *options))
        now = cold_and_warm(flight, options, folder / "now", repeats)
        later = cold_and_warm(flight, [*options, "--audit", "none"], folder / "later", repeats)
    now, later = ({name: IMPORTED.ratios(row) for name, row in rows.items()} for rows in (now, later))
    result = {
        "two_channels": {
            "flight": source,
            "imports_cpu_s": IMPORTED.seconds[IMPORTS],
            "imports_light_cpu_s": IMPORTED.seconds[LIGHT],
        },
        "now": now, "later": later,
    }  # fmt: skip
    if arguments.json:
        print(json.dumps(result, indent=1))
        return
    taken = IMPORTED.seconds[IMPORTS]
    print(f"{source}, imports: {statistics.median(taken):.2f} s of processor time ({len(taken)} times)")
    for name, row in {**now, **{f"{key}, --audit none": row for key, row in later.items()}}.items():
        print(f"{name}: {row['cpu_s']:.1f} s of processor ({row['wall_s']:.1f} s), {row['ratio']:.2f} x "
              f"the imports, {row['ratio_light']:.2f} x the imports without Sionna")  # fmt: skip


if __name__ == "__main__":
    main()
