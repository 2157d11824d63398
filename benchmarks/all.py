"""Run every benchmark that has a short size and prints JSON, and append the numbers to a history.

    make bench-all                                    # or: python benchmarks/all.py && python benchmarks/performance.py
    python benchmarks/all.py [--only scaling ingest] [--history FILE] [--no-history]
    make bench-check                                  # or: python benchmarks/all.py --check [NAME ...]

The run takes about ten minutes on two idle cores. The conditions (machine, load, versions) are stored with the numbers.
If a benchmark fails, or its peer is not installed, this is reported, and the others continue. One line of JSON is
appended to ``benchmarks/history.jsonl``, from which ``benchmarks/performance.py`` makes docs/performance.md.

``--check`` runs every file of this folder at its smallest size, and reports the files that do not finish. Numbers of
such sizes are not meaningful and are not stored. Benchmarks that need the field data are skipped if
AERPAW_CMP_FIELD_DATA is not set. The check takes about twenty minutes.
"""

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
HISTORY = ROOT / "benchmarks" / "history.jsonl"
# What is run, each in a process of its own; ``scaling`` an axis at a time.
COMMANDS: dict[str, list[str]] = {
    "scaling": ["benchmarks/scaling.py", "--axes"],
    "peers": ["benchmarks/peers.py"],
    "report": ["benchmarks/report.py", "--quick", "--json"],
    "waits": ["benchmarks/waits.py", "--json"],
    "replay": ["benchmarks/replay.py", "--quick", "--no-sionna"],
    "kriging": ["benchmarks/kriging.py", "--pairs", "60"],
    "town": ["benchmarks/scenes.py", "--scenes", "munich", "--depths", "2,3", "--sionna", "1e5,1e6", "--json", "-"],
    "country": ["benchmarks/country.py", "--receivers", "1e5,1e6", "--json"],
    "pages": ["benchmarks/pages.py", "--only", "long,campaign", "--repeats", "1", "--json"],
}

# What runs before all of them and is not counted: it compiles the kernels that replays and maps keep on disk.
WARM = ["-c", "from aerpaw_cmp.propagation.compiled import why_missing\nwhy_missing()"]

# How each file of this folder is run by ``--check``; ``{folder}`` is one that is removed afterwards.
SMALLEST: dict[str, list[str]] = {
    "all": ["--only", "kriging", "--no-history"],
    "clock_power": ["sample_logs/UAV", "--quiet"],
    "country": ["--receivers", "1e3", "--workers", "1"],
    "coverage_of_intervals": ["--quick"],
    "diffraction": ["sample_logs/flight.yaml"],
    "drafts": ["sample_logs"],
    "fabricated": [],
    "first_flight_prediction": [],
    "freeze": ["record", "{folder}/record.npz", "--quick"],
    "injected_causes": ["--only", "flat", "--simulated", "1"],
    "ingest": ["--scale", "2000", "--format", "sounder_log"],
    "interval_weights": ["mean", "--sequences", "4"],
    "kriging": ["--quick", "--pairs", "60"],
    "located_nodes": ["--flights", "2", "--only", "circle"],
    "learned_map": ["--quick", "--only", "flights", "lte"],
    "left_out_reports": ["--only", "lte50"],
    "outside_causes": [],
    "pages": ["--only", "long", "--repeats", "1"],
    "peers": ["--quick"],
    "performance": ["--docs", "{folder}/performance.md"],
    "planted_causes": ["--flights", "16"],
    "published": ["tasks", "--data", "sample_logs"],
    "real_ground": ["--only", "aadm", "--no-fit"],
    "predicted_triples": ["--triples", "1"],
    "replay": ["--quick"],
    "report": ["--quick"],
    "scaling": ["--axes", "poses"],
    "scenes": ["--scenes", "canyon", "--depths", "1", "--receivers", "10"],
    "simulated_modem": [],
    "tr36777": ["--ues", "50"],
    "waits": ["--only", "report of the sample"],
    "wheels": ["--pythons", sys.executable],
}

ON_FIELD_DATA = ("first_flight_prediction", "injected_causes", "learned_map", "left_out_reports", "real_ground")

AXES = ("poses", "towers", "faces", "samples", "report", "flights", "workers")

LIMIT_S, LONG_S = 900.0, 3600.0


def machine() -> dict[str, Any]:
    """Return the conditions that the numbers depend on."""
    from aerpaw_cmp.common.versions import versions

    model = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        model = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), model)
        pages = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError):
        pages = 0
    known = versions()
    return {
        "processor": model,
        "cpus": os.cpu_count(),
        "memory_gib": round(pages / 2**30, 1),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "versions": {name: known[name] for name in sorted(known)},
    }


def version() -> str:
    """Return the commit of this tree."""
    from aerpaw_cmp.common.versions import tool_version

    return tool_version()


def _run(command: list[str], limit_s: float = LIMIT_S) -> tuple[str, str | None]:
    """Return the output of a benchmark, and its last lines if it failed."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "parsers")])}
    environment |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    try:
        done = subprocess.run(
            [sys.executable, *command], cwd=ROOT, env=environment, capture_output=True, text=True, check=False,
            timeout=limit_s,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return "", f"not done in {limit_s:g} s"
    if done.returncode == 0:
        return done.stdout, None
    said = done.stderr.strip() or done.stdout.strip() or "no message"
    return done.stdout, said.splitlines()[-1][:300]


def run_one(name: str, command: list[str]) -> dict[str, Any]:
    """Return the JSON of one benchmark, its seconds and the load before it. If it fails, return its last words."""
    load, start = os.getloadavg()[0], time.perf_counter()
    print(f"{name} ...", file=sys.stderr, flush=True)
    text, why = _run(command, LONG_S if name == "country" else LIMIT_S)
    seconds = round(time.perf_counter() - start, 1)
    row: dict[str, Any] = {"seconds": seconds, "load_before": round(load, 2)}
    try:
        return {**row, "failed": why} if why else {**row, "result": json.loads(text[text.index("{") :])}
    except ValueError:
        return {**row, "failed": "no JSON on standard output"}


def run_axes(command: list[str], axes: Sequence[str] = AXES) -> dict[str, Any]:
    """The scaling, one axis after the other: one that is not done in time costs no other."""
    parts = {axis: run_one(f"scaling of {axis}", [*command, axis]) for axis in axes}
    row: dict[str, Any] = {
        "seconds": round(sum(part["seconds"] for part in parts.values()), 1),
        "load_before": parts[axes[0]]["load_before"],
        "result": {axis: part["result"][axis] for axis, part in parts.items() if "result" in part},
    }
    if missing := [f"{axis}: {part['failed']}" for axis, part in parts.items() if "failed" in part]:
        row["failed"] = "; ".join(missing)
    return row


def check(names: Sequence[str]) -> int:
    """Run each benchmark at its smallest size, and return 1 if one of them does not finish."""
    without = () if os.environ.get("AERPAW_CMP_FIELD_DATA") else ON_FIELD_DATA
    failed = 0
    for name in names or list(SMALLEST):
        if name in without:
            print(f"{name:<22} left out: AERPAW_CMP_FIELD_DATA is not set", flush=True)
            continue
        start = time.perf_counter()
        with tempfile.TemporaryDirectory() as folder:
            options = [word.replace("{folder}", folder) for word in SMALLEST[name]]
            script = ["-m", "benchmarks.published"] if name == "published" else [f"benchmarks/{name}.py"]
            why = _run([*script, *options])[1]
        failed += why is not None
        print(f"{name:<22} {time.perf_counter() - start:6.1f} s  {why or 'done'}", flush=True)
    return int(failed > 0)


def main() -> int:
    """Run, tell, remember."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=list(COMMANDS), default=list(COMMANDS))
    parser.add_argument("--axes", nargs="+", choices=AXES, default=AXES, help="of the scaling")
    parser.add_argument("--history", type=Path, default=HISTORY)
    parser.add_argument("--no-history", action="store_true", help="print only")
    parser.add_argument("--check", nargs="*", choices=list(SMALLEST), help="all, or these, at the smallest size")
    arguments = parser.parse_args()
    if arguments.check is not None:
        return check(arguments.check)
    sys.path[:0] = [str(ROOT), str(ROOT / "parsers")]
    start, load = time.perf_counter(), round(os.getloadavg()[0], 2)
    _run(WARM)
    entry: dict[str, Any] = {
        "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "version": version(),
        "machine": machine(),
        "load_before": load,
        "benchmarks": {
            name: run_axes(command, arguments.axes) if name == "scaling" else run_one(name, command)
            for name, command in COMMANDS.items()
            if name in arguments.only
        },
    }
    entry |= {"seconds": round(time.perf_counter() - start, 1), "load_after": round(os.getloadavg()[0], 2)}
    failed = {name: row["failed"] for name, row in entry["benchmarks"].items() if "failed" in row}
    for name, row in entry["benchmarks"].items():
        print(f"{name:<12} {row['seconds']:6.1f} s  load before {row['load_before']:.1f}  {row.get('failed', 'done')}")
    print(f"load {entry['load_before']} at the start, {entry['load_after']} at the end (this run alone makes 1 to 2)")
    print(f"{'all':<12} {entry['seconds']:6.1f} s on {entry['machine']['processor']}, {entry['machine']['cpus']} cpus")
    if not arguments.no_history:
        with arguments.history.open("a", encoding="utf-8") as file:
            file.write(json.dumps(entry, separators=(",", ":")) + "\n")
        print(f"appended to {arguments.history}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
