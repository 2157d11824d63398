"""A run of ``aerpaw-cmp predict`` from many simulated flights at many points: seconds of each stage, peak memory.

Twenty lawnmowers at two heights around LW1 have two channels at 2 Hz. ``aerpaw-cmp simulate`` writes their logs in the
real formats. A field of 3 dB over about 60 m, which all flights share, is added to the logged levels, so that the
residual field lowers the error. The points are drawn over the area of the flights and beyond it.

    python benchmarks/predict_scale.py [--points 100000] [--heading 90] [--no-field] [--keep DIR] [--json]
"""

import argparse
import json
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import yaml

from aerpaw_cmp.flight.settings import load_flight
from aerpaw_cmp.flight.simulate import plan_trajectory

ROOT = Path(__file__).resolve().parents[1]
SD_DB, LENGTH_M = 3.0, 60.0
START = datetime(2025, 6, 1, 10)


def flight_file(number: int) -> dict:
    """flight.yaml of a lawnmower with legs of 500 m, its place, height and direction by its number."""
    content = yaml.safe_load((ROOT / "sample_logs" / "flight.yaml").read_text(encoding="utf-8"))
    plan, height = content["flight"]["plan"], 40.0 + 20.0 * (number % 2)
    legs = [(-250.0 + 100.0 * leg + 5.0 * number, -250.0 if leg % 2 == 0 else 250.0) for leg in range(6)]
    corners = [(a, b) for a, start in legs for b in (start, -start)]
    corners = corners if number % 4 < 2 else [(b, a) for a, b in corners]
    plan |= {
        "start": START + timedelta(hours=number), "seed": number, "bad_lines": 0, "clock_shift_s": {},
        "offsets_db": {"LW1": plan["offsets_db"]["LW1"]},
        "waypoints": [{"label": "", "east_m": a, "north_m": b, "height_m": height} for a, b in corners],
    }  # fmt: skip
    content["flight"]["name"] = f"simulated{number}"
    logs = [log for log in content["logs"] if log["path"].startswith("LW1/")]
    stamp = f"{plan['start']:%Y-%m-%d_%H_%M_%S}"
    return {**content, "logs": [{"path": f"UAV/{stamp}_vehicleOut.txt", "reader": "vehicle_out"}, *logs]}


def add_field(path: Path, folder: Path) -> None:
    """Add a field over places, the same for all flights, to the levels that a flight logged."""
    rng = np.random.default_rng(0)
    waves, phase = rng.normal(0.0, 1.0 / LENGTH_M, (200, 2)), rng.uniform(0.0, 2 * np.pi, 200)
    plan = load_flight(path).flight.plan
    trajectory, begin = plan_trajectory(plan), plan.start.replace(tzinfo=None)
    for log in sorted((folder / "LW1").glob("*_power_log.txt")):
        lines = log.read_text(encoding="utf-8").splitlines()
        instants = [datetime.fromisoformat(re.match(r"\[(.*?)\]", line)[1]) for line in lines]
        place = trajectory.position_at(np.array([(t - begin).total_seconds() for t in instants]))[:, :2]
        more = SD_DB * np.sqrt(2.0 / 200) * np.cos(place @ waves.T + phase).sum(axis=1)
        moved = [re.sub(r"\S+$", lambda m, d=d: f"{float(m[0]) + d:.6f}", line)
                 for line, d in zip(lines, more, strict=True)]  # fmt: skip
        log.write_text("\n".join(moved) + "\n", encoding="utf-8")


def make(folder: Path, flights: int, points: int, *, field: bool) -> None:
    """Flights with their logs, and points.csv."""
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(flights):
        place = folder / f"flight{number}"
        if place.is_dir():
            continue
        path = folder / f"plan{number}.yaml"
        path.write_text(yaml.safe_dump(flight_file(number), sort_keys=False), encoding="utf-8")
        command = [sys.executable, "-m", "aerpaw_cmp", "simulate", str(path), "-o", str(place)]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        if field:
            add_field(path, place)
    rng = np.random.default_rng(1)
    place = np.column_stack([*rng.uniform(-320.0, 320.0, (2, points)), rng.uniform(35.0, 65.0, points)])
    np.savetxt(folder / "points.csv", place, "%.2f", ",", header="east_m,north_m,height_m", comments="")


def measured(folder: Path, flights: int, heading: float | None) -> dict:
    """Seconds and peak memory of the command."""
    if heading is not None:
        text = (folder / "points.csv").read_text(encoding="utf-8").replace("\n", f",{heading:g}\n")
        (folder / "points.csv").write_text(
            text.replace(f"height_m,{heading:g}", "height_m,yaw_deg", 1), encoding="utf-8"
        )
    named = [part for number in range(flights) for part in ("--with", str(folder / f"flight{number}" / "flight.yaml"))]
    command = ["predict", str(folder / "points.csv"), *named, "-o", str(folder / "prediction"), "--force", "--json"]
    begin = time.perf_counter()
    done = subprocess.run([sys.executable, "-m", "aerpaw_cmp", *command], check=True, capture_output=True, text=True)
    wall, used = time.perf_counter() - begin, resource.getrusage(resource.RUSAGE_CHILDREN)
    metrics = json.loads(done.stdout)
    return {
        "points": sum(series["points"] for series in metrics["series"].values()),
        "flights": flights,
        "wall_s": wall,
        "cpu_s": used.ru_utime + used.ru_stime,
        "peak_mib": used.ru_maxrss / 1024.0,
        "stages_s": metrics["stages"],
        "chosen": metrics["chosen"]["title"],
        "file_mib": {
            p.name: p.stat().st_size / 2**20 for p in sorted((folder / "prediction").iterdir()) if p.is_file()
        },
    }


def main() -> None:
    """Simulate, predict, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, default=100_000, help="each for both channels")
    parser.add_argument("--flights", type=int, default=20)
    parser.add_argument("--heading", type=float, help="of the nose [deg]; without it eight headings count alike")
    parser.add_argument("--no-field", action="store_true", help="nothing but fading beside the replay")
    parser.add_argument("--keep", type=Path, help="folder of the simulated flights: made once, used again")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = args.keep or Path(scratch)
        make(folder, args.flights, args.points, field=not args.no_field)
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        result = measured(folder, args.flights, args.heading)
        result["cpu_s"] -= before.ru_utime + before.ru_stime
    if args.json:
        print(json.dumps(result))
        return
    print(
        f"{result['points']} levels from {result['flights']} flights ({result['chosen']}), {os.cpu_count()} processors"
    )
    print(f"  {result['wall_s']:.1f} s, {result['cpu_s']:.1f} CPU s, peak {result['peak_mib']:.0f} MiB")
    print("  stages [s]: " + ", ".join(f"{name} {seconds:.1f}" for name, seconds in result["stages_s"].items()))
    print("  files [MiB]: " + ", ".join(f"{name} {size:.0f}" for name, size in result["file_mib"].items()))


if __name__ == "__main__":
    main()
