"""Every benchmark that has a short size and prints JSON, with its peers, in one run; the numbers join a history.

    make bench-all                                    # or: python benchmarks/all.py && python benchmarks/performance.py
    python benchmarks/all.py [--only scaling ingest] [--history FILE] [--no-history]

The run takes about ten minutes on two idle cores; conditions (machine, load, versions) stand beside the numbers. A
benchmark that fails or whose peer is not installed is told and does not stop the others. One line of JSON is appended
to ``benchmarks/history.jsonl``, from which ``benchmarks/performance.py`` makes docs/performance.md.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
HISTORY = ROOT / "benchmarks" / "history.jsonl"
PEERS = """
import json
from aerpaw_cmp.jobs import peer_ratios as p
search = p.path_search_ratios(samples=(1_000, 10_000, 100_000))
found = {
    "path search, image engine / PathSolver at equal error": search["equal_error"]["ratio"],
    "path search, image engine / PathSolver with 1e5 samples": search["at"]["1e+05"]["ratio"],
    "ingest / pandas (C engine), 1 000 000 lines": p.ingest_vs_pandas(1_000_000, 1)["ratio"],
}
kriging, pairs = p.kriging_shared_weights(), p.kriging_vs_pykrige(60)
if kriging is not None and pairs is not None:
    found |= {
        "Kriging / PyKrige's C back end, one field": kriging["ratio_one_field"],
        "Kriging / PyKrige's C back end, 27 fields": kriging["ratio"],
        "Kriging, leave one out / PyKrige": pairs["ratio"],
    }
print(json.dumps(found))
"""
"""How many times faster than its peer each part is, both sides in one process, by processor time."""

COMMANDS: dict[str, list[str]] = {
    "scaling": ["benchmarks/scaling.py", "--json", "--axes"],
    "peers": ["-c", PEERS],
    "report": ["benchmarks/report.py", "--quick", "--json"],
    "startup": ["benchmarks/startup.py", "--quick", "--json"],
    "replay": ["benchmarks/replay.py", "--quick", "--no-sionna", "--json"],
    "ingest": ["benchmarks/ingest.py", "--quick", "--json"],
    "kriging": ["benchmarks/kriging.py", "--quick", "--pairs", "60", "--json"],
    "comparison": ["benchmarks/compare.py", "--quick", "--json"],
    "site": ["benchmarks/site.py", "--quick", "--json"],
    "map": ["benchmarks/map_job.py", "--quick", "--json"],
    "pages": ["benchmarks/pages.py", "--only", "long,campaign", "--repeats", "1", "--json"],
}
"""What is run, each in a process of its own; ``scaling`` an axis at a time."""

AXES = ("poses", "towers", "faces", "samples", "report", "flights", "workers")

LIMIT_S = 600.0


def machine() -> dict[str, Any]:
    """What the numbers depend on."""
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
    """Of this tree: the package's, and the commit where there is one."""
    from aerpaw_cmp import __version__

    command = ["git", "describe", "--always", "--dirty"]
    try:
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    except OSError:
        return __version__
    return f"{__version__} ({done.stdout.strip()})" if done.returncode == 0 else __version__


def run_one(name: str, command: list[str]) -> dict[str, Any]:
    """The JSON of one benchmark, its seconds and the load before it; its last words where it fails."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "parsers")])}
    environment |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    load, start = os.getloadavg()[0], time.perf_counter()
    print(f"{name} ...", file=sys.stderr, flush=True)
    try:
        done = subprocess.run(
            [sys.executable, *command], cwd=ROOT, env=environment, capture_output=True, text=True, check=False,
            timeout=LIMIT_S,
        )  # fmt: skip
        text, failed = done.stdout, done.returncode != 0
        why = (done.stderr.strip().splitlines() or ["no message"])[-1][:300]
    except subprocess.TimeoutExpired:
        text, failed, why = "", True, f"not done in {LIMIT_S:g} s"
    seconds = round(time.perf_counter() - start, 1)
    found: dict[str, Any] = {"seconds": seconds, "load_before": round(load, 2)}
    try:
        return {**found, "failed": why} if failed else {**found, "result": json.loads(text[text.index("{") :])}
    except ValueError:
        return {**found, "failed": "no JSON on standard output"}


def run_axes(command: list[str], axes: Sequence[str] = AXES) -> dict[str, Any]:
    """The scaling, one axis after the other: one that is not done in time costs no other."""
    parts = {axis: run_one(f"scaling of {axis}", [*command, axis]) for axis in axes}
    found: dict[str, Any] = {
        "seconds": round(sum(one["seconds"] for one in parts.values()), 1),
        "load_before": parts[axes[0]]["load_before"],
        "result": {axis: one["result"][axis] for axis, one in parts.items() if "result" in one},
    }
    if missing := [f"{axis}: {one['failed']}" for axis, one in parts.items() if "failed" in one]:
        found["failed"] = "; ".join(missing)
    return found


def main() -> int:
    """Run, tell, remember."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=list(COMMANDS), default=list(COMMANDS))
    parser.add_argument("--axes", nargs="+", choices=AXES, default=AXES, help="of the scaling")
    parser.add_argument("--history", type=Path, default=HISTORY)
    parser.add_argument("--no-history", action="store_true", help="print only")
    arguments = parser.parse_args()
    sys.path[:0] = [str(ROOT), str(ROOT / "parsers")]
    start = time.perf_counter()
    entry: dict[str, Any] = {
        "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "version": version(),
        "machine": machine(),
        "load_before": round(os.getloadavg()[0], 2),
        "benchmarks": {
            name: run_axes(command, arguments.axes) if name == "scaling" else run_one(name, command)
            for name, command in COMMANDS.items()
            if name in arguments.only
        },
    }
    entry["seconds"] = round(time.perf_counter() - start, 1)
    failed = {name: one["failed"] for name, one in entry["benchmarks"].items() if "failed" in one}
    for name, one in entry["benchmarks"].items():
        print(f"{name:<12} {one['seconds']:6.1f} s  load before {one['load_before']:.1f}  {one.get('failed', 'done')}")
    print(f"{'all':<12} {entry['seconds']:6.1f} s on {entry['machine']['processor']}, {entry['machine']['cpus']} cpus")
    for name, ratio in entry["benchmarks"].get("peers", {}).get("result", {}).items():
        print(f"{ratio:10.2f} x  {name}")
    if not arguments.no_history:
        with arguments.history.open("a", encoding="utf-8") as file:
            file.write(json.dumps(entry, separators=(",", ":")) + "\n")
        print(f"appended to {arguments.history}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
