"""Reports of ever longer flights: seconds (wall, processor) and peak memory of each stage, with fitted powers.

The flight circles one tower on laps of the sample flight's route: two channels, telemetry at 10 Hz, planted offsets
and fading, with ``--rank`` a rank twice a second; logs of the real formats made by ``aerpaw-cmp simulate``. At
``--hours 10`` a channel has 1 000 000 samples and the track 360 000 poses. A size is one process; a stage's peak is
that of the process while the stage ran (VmHWM of Linux, reset at its begin), so it holds what earlier stages keep.

    python benchmarks/long_flight.py [--hours 10] [--shares 0.0333 0.1 0.3333 1] [--rank] [--json]

Without audit and speed table, whose cost does not depend on the length.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import resource
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
import yaml

from aerpaw_cmp.common.stages import begin_peak, peak_mib

ROOT = Path(__file__).resolve().parents[1]
RSS_INTERVAL_S = 0.036
TELEMETRY_INTERVAL_S = 0.1
RANK_INTERVAL_S = 0.5
STAGES = ("read", "clocks", "replay", "compare", "audit", "ladder", "report")


def flight_file(hours: float, *, rank: bool) -> dict:
    """flight.yaml of a flight on laps until the hours are over."""
    content = yaml.safe_load((ROOT / "sample_logs" / "flight.yaml").read_text(encoding="utf-8"))
    plan, route = content["flight"]["plan"], content["flight"]["plan"]["waypoints"]
    first, laps, last = route[:2], route[2:-2], route[-2:]
    lap_s = _seconds(laps + laps[:1], plan)
    points = [*first]
    for number in range(max(1, round((hours * 3600.0 - 60.0) / lap_s))):
        points += [{**p, "label": p["label"] if number == 0 else ""} for p in laps]
    plan |= {
        "rss_interval_s": RSS_INTERVAL_S, "telemetry_interval_s": TELEMETRY_INTERVAL_S,
        "rank_interval_s": RANK_INTERVAL_S, "clock_shift_s": {}, "waypoints": [*points, *last],
    }  # fmt: skip
    wanted = ("LW1", None) if rank else ("LW1",)
    logs = [g for g in content["logs"] if g.get("node", "") in (*wanted, "") and (rank or "ri" not in g["path"])]
    return {**content, "logs": logs, "rt": {**content["rt"], "audit_links": 0}}


def _seconds(points: list[dict], plan: dict) -> float:
    """How long a planned route takes [s]."""
    total = sum(p.get("hold_s", 0.0) for p in points[:-1])
    for a, b in itertools.pairwise(points):
        far = np.hypot(b["east_m"] - a["east_m"], b["north_m"] - a["north_m"])
        total += max(far / plan["speed_mps"], abs(b["height_m"] - a["height_m"]) / plan["climb_mps"])
    return float(total)


def make_flight(folder: Path, hours: float, *, rank: bool) -> Path:
    """A flight file with its simulated logs."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "flight.yaml"
    path.write_text(yaml.safe_dump(flight_file(hours, rank=rank), sort_keys=False), encoding="utf-8")
    command = [sys.executable, "-m", "aerpaw_cmp", "simulate", str(path), "-o", str(folder / "flown")]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return folder / "flown" / "flight.yaml"


class Meter:
    """Takes the progress of a job and notes seconds and peak memory [MiB] of each stage."""

    def __init__(self) -> None:
        self.rows: dict[str, dict[str, float]] = {}
        self._name, self._wall, self._cpu = "imports", time.perf_counter(), 0.0
        self._again = threading.Lock()

    def __call__(self, text: str, _fraction: float | None = None, /) -> None:
        """A text that is the name of a stage begins it."""
        if text in STAGES and text != self._name:
            self.close()
            self._name = text

    def close(self) -> None:
        """End the stage that runs."""
        with self._again:
            wall, cpu = time.perf_counter(), time.process_time()
            row = self.rows.setdefault(self._name, {"wall_s": 0.0, "cpu_s": 0.0, "peak_mib": 0.0})
            row["wall_s"] += wall - self._wall
            row["cpu_s"] += cpu - self._cpu
            row["peak_mib"] = max(row["peak_mib"], peak_anew())
            self._wall, self._cpu = wall, cpu
        print(f"{self._name}: {row['cpu_s']:.1f} s, {row['peak_mib']:.0f} MiB", file=sys.stderr, flush=True)


def peak_anew() -> float:
    """Peak memory since the last call [MiB]; since the start where the system cannot reset it."""
    peak = peak_mib()
    begin_peak()
    return peak if peak == peak else resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def measure(flight: str, out: str) -> dict:
    """One report in this process."""
    meter = Meter()
    from aerpaw_cmp.jobs.options import RunOptions
    from aerpaw_cmp.jobs.run import ReportOptions, run_report

    outcome = run_report(Path(flight), ReportOptions(audit="none"), RunOptions(out=Path(out), progress=meter))
    meter.close()
    metrics, files = outcome.metrics, sorted(p for p in Path(out).rglob("*") if p.is_file())
    channels = [m for tower in metrics["rss"].values() for m in tower.values()]
    return {
        "samples": sum(m["n"] for m in channels),
        "channels": len(channels),
        "poses": next(i["accepted"] for i in metrics["inputs"] if "vehicleOut" in i["path"]),
        "stages": meter.rows,
        "page_mib": (Path(out) / "report.html").stat().st_size / 2**20,
        "folder_mib": sum(p.stat().st_size for p in files) / 2**20,
        "rss": {f"{t} {c}": [m["offset_db"], m["rmse_db"]] for t, cs in metrics["rss"].items() for c, m in cs.items()},
    }


def power(sizes: list[float], values: list[float]) -> float:
    """Exponent of the growth between the two largest sizes; NaN where nothing can be said."""
    if len(sizes) < 2 or min(values[-2:]) <= 0.05 or sizes[-1] == sizes[-2]:
        return float("nan")
    return float(np.log(values[-1] / values[-2]) / np.log(sizes[-1] / sizes[-2]))


def run(hours: float, shares: list[float], *, rank: bool, keep: Path | None = None) -> dict:
    """All sizes, each in a process of its own."""
    rows = []
    with tempfile.TemporaryDirectory() as name:
        base = keep or Path(name)
        for share in shares:
            folder = base / f"{hours * share:.3f}h"
            flight = folder / "flown" / "flight.yaml"
            if not flight.is_file():
                flight = make_flight(folder, hours * share, rank=rank)
            command = [sys.executable, __file__, "--measure", str(flight), str(folder / "report")]
            done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
            rows.append({"hours": hours * share, **json.loads(done.stdout.splitlines()[-1])})
    names = [s for s in ("imports", *STAGES) if any(s in r["stages"] for r in rows)]
    for row in rows:
        row["total"] = {
            "wall_s": sum(v["wall_s"] for v in row["stages"].values()),
            "cpu_s": sum(v["cpu_s"] for v in row["stages"].values()),
            "peak_mib": max(v["peak_mib"] for v in row["stages"].values()),
        }
    sizes = [r["samples"] for r in rows]
    cpu = {n: power(sizes, [r["stages"].get(n, {}).get("cpu_s", 0.0) for r in rows]) for n in names}
    cpu["total"] = power(sizes, [r["total"]["cpu_s"] for r in rows])
    return {"load": os.getloadavg()[0], "cpus": os.cpu_count(), "rows": rows, "power_of_cpu": cpu}


def show(found: dict) -> None:
    """The table."""
    print(f"{found['cpus']} processors, load {found['load']:.1f}; seconds of processor (wall), peak MiB of each stage")
    rows = found["rows"]
    head = "".join(f"{r['hours']:7.2f} h {r['samples'] // r['channels']:>9} smp" for r in rows)
    print(f"{'stage':<9}{head}   power")
    for name, exponent in found["power_of_cpu"].items():
        cells = [r["total"] if name == "total" else r["stages"].get(name) for r in rows]
        text = "".join(f"{c['cpu_s']:8.1f} ({c['wall_s']:5.0f}) {c['peak_mib']:5.0f}" if c else " " * 22 for c in cells)
        print(f"{name:<9}{text}   {exponent:5.2f}" if np.isfinite(exponent) else f"{name:<9}{text}       -")
    print("page MiB " + "".join(f"{r['page_mib']:22.2f}" for r in rows))
    print(f"channels x samples: {rows[-1]['channels']} x {rows[-1]['samples'] // rows[-1]['channels']}; "
          f"poses of the track: {rows[-1]['poses']}; offset and RMSE [dB]: {rows[-1]['rss']}")  # fmt: skip


def main() -> None:
    """Print the table, or JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hours", type=float, default=10.0)
    parser.add_argument("--shares", type=float, nargs="+", default=[1 / 30, 0.1, 1 / 3, 1.0], help="of the hours")
    parser.add_argument("--rank", action="store_true", help="a rank log, too, twice a second")
    parser.add_argument("--keep", type=Path, help="folder of the flights, kept and used again")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--measure", nargs=2, metavar=("FLIGHT", "OUT"), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.measure:
        print(json.dumps(measure(*arguments.measure)))
        return
    found = run(arguments.hours, arguments.shares, rank=arguments.rank, keep=arguments.keep)
    print(json.dumps(found, indent=1)) if arguments.json else show(found)


if __name__ == "__main__":
    main()
