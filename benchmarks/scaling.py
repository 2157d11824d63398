"""Measure cost against size for large campaigns and cities, with each size in a separate process.

poses     replay of 5 towers, 4 x 4 elements, 12 buildings, depth 2
towers    replay of 10 000 poses, 12 buildings, depth 2
faces     paths of 100 poses of one tower, depth 2, with more and more buildings (five faces each, and the ground)
samples   comparison of one channel with its intervals (1000 bootstrap replicates), no replay
report    report of a flight of two channels without audit, by its samples; --large --seconds 3600: ten hours
flights   campaign of more and more flights of 130 s, one tower, two channels, two settings, one worker
workers   the campaign of the most flights with one and with two workers

    python benchmarks/scaling.py [--axes poses faces ...] [--large]

Times are processor seconds without imports, and also wall seconds if several processes share the work. MiB are the peak
of the process. A power is fitted between the two largest sizes. If a size is refused, the reason is printed.
"""

import argparse
import itertools
import json
import math
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from aerpaw_cmp.propagation.options import Search

ROOT = Path(__file__).resolve().parents[1]
# Short and large sizes of each axis; ``report`` in hours.
SIZES: dict[str, tuple[list[float], list[float]]] = {
    "poses": ([10_000, 30_000, 100_000], [10_000, 100_000, 1_000_000]),
    "towers": ([1, 3, 10], [1, 3, 10, 30, 100]),
    "faces": ([501, 1_501, 5_001], [501, 1_501, 5_001, 15_001]),
    "samples": ([10_000, 100_000, 1_000_000], [10_000, 100_000, 1_000_000, 3_000_000]),
    "report": ([0.1, 0.3, 1.0], [0.1, 1.0, 10.0]),
    "flights": ([2, 4, 8], [2, 8, 32]),
    "workers": ([1, 2], [1, 2]),
}


def spent() -> float:
    """Processor seconds of this process and of those it waited for."""
    both = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in both)


def timed(action: Callable[[], Any]) -> dict[str, float]:
    """Seconds of an action, and the peak of the process."""
    wall, cpu = time.perf_counter(), spent()
    action()
    peak = max(resource.getrusage(w).ru_maxrss for w in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)) / 1024
    return {"cpu_s": spent() - cpu, "wall_s": time.perf_counter() - wall, "peak_mib": peak}


def warm_timed(action: Callable[[], Any]) -> dict[str, float]:
    """Time an action like :func:`timed`, after one run that compiles its kernels."""
    action()
    return timed(action)


def replay_of(poses: int, towers: int = 1, buildings: int = 12) -> dict[str, float]:
    """Paths and fields of a random scene."""
    from aerpaw_cmp.jobs.bench import random_scene
    from aerpaw_cmp.propagation.replay import replay

    site, link, some = random_scene(poses, towers=towers, buildings=buildings)
    return warm_timed(lambda: replay(site, link, some, Search(max_depth=2)))


def faces(count: int) -> dict[str, float]:
    """Return a field that grows with its buildings, so that they are as dense as the 12 of the bench scene."""
    from dataclasses import replace as change

    from shapely import affinity
    from shapely.geometry import box

    from aerpaw_cmp.jobs.bench import random_scene
    from aerpaw_cmp.propagation.geometry import Poses
    from aerpaw_cmp.propagation.replay import replay
    from aerpaw_cmp.site.site import Building

    site, link, some = random_scene(100, buildings=0)
    wanted = (count - 1) // 5
    side, generator = 600.0 * math.sqrt(wanted / 12.0), np.random.default_rng(1)
    cells = math.ceil(math.sqrt(wanted + 1))
    built = []
    for number in range(cells * cells):
        place = (np.array(divmod(number, cells)) + 0.5) * side / cells - side / 2
        half = generator.uniform((5, 5), (14, 12)) * min(1.0, side / cells / 60.0)
        angle, height = generator.uniform(0, 180), generator.uniform(4, 12)
        if np.hypot(*place) > 25 and len(built) < wanted:
            shape = affinity.rotate(box(*(place - half), *(place + half)), angle)
            built.append(Building(f"building {number}", shape, float(height)))
    position = some.position_m * [side / 600.0, side / 600.0, 1.0]
    scene = change(site, buildings=tuple(built))
    cost = warm_timed(lambda: replay(scene, link, Poses(position, some.rotation), Search(max_depth=2)))
    return {**cost, "faces": 1 + 5 * len(built)}


def samples(count: int) -> dict[str, float]:
    """Return one channel at ten samples per second whose residual has a correlation time of 1.5 s."""
    from scipy.signal import lfilter

    from aerpaw_cmp.compare.level import compare_rss

    generator = np.random.default_rng(1)
    decay = math.exp(-0.1 / 1.5)
    noise = lfilter([math.sqrt(1 - decay**2)], [1, -decay], generator.normal(0, 3, count))
    level = -70 + 10 * np.sin(np.arange(count) / 200.0)
    compare_rss(np.arange(100) / 10, level[:100], level[:100] + noise[:100])  # warm
    return timed(lambda: compare_rss(np.arange(count) / 10, level + noise, level, baselines={"flat": 0 * level - 70}))


def flight_on_laps(hours: float) -> dict[str, Any]:
    """flight.yaml of two channels of one tower, on laps of the sample flight's route until the hours are over."""
    content = yaml.safe_load((ROOT / "sample_logs" / "flight.yaml").read_text(encoding="utf-8"))
    plan, route = content["flight"]["plan"], content["flight"]["plan"]["waypoints"]
    first, laps, last = route[:2], route[2:-2], route[-2:]
    lap_s = _seconds(laps + laps[:1], plan)
    points = [*first]
    for number in range(max(1, round((hours * 3600.0 - 60.0) / lap_s))):
        points += [{**p, "label": p["label"] if number == 0 else ""} for p in laps]
    intervals = {"rss_interval_s": 0.036, "telemetry_interval_s": 0.1, "clock_shift_s": {}}
    plan |= {**intervals, "offsets_db": {"LW1": plan["offsets_db"]["LW1"]}, "waypoints": [*points, *last]}
    logs = [log for log in content["logs"] if log.get("node", "LW1") == "LW1" and "ri" not in log["path"]]
    return {**content, "logs": logs, "rt": {**content["rt"], "audit_links": 0}}


def _seconds(points: list[dict[str, Any]], plan: dict[str, Any]) -> float:
    """Return the duration of a planned route [s]."""
    total = sum(p.get("hold_s", 0.0) for p in points[:-1])
    for a, b in itertools.pairwise(points):
        far = np.hypot(b["east_m"] - a["east_m"], b["north_m"] - a["north_m"])
        total += max(far / plan["speed_mps"], abs(b["height_m"] - a["height_m"]) / plan["climb_mps"])
    return float(total)


def report(hours: float) -> dict[str, float]:
    """Measure a report as a process with its imports, from simulated logs.

    Ten hours are 1 000 000 samples of a channel.
    """
    sys.path.insert(0, str(ROOT / "benchmarks"))
    from report import run as run_process

    program = [sys.executable, "-m", "aerpaw_cmp"]
    with tempfile.TemporaryDirectory() as name:
        plan, flight, out = (str(Path(name) / part) for part in ("plan.yaml", "flown", "out"))
        Path(plan).write_text(yaml.safe_dump(flight_on_laps(hours), sort_keys=False), encoding="utf-8")
        run_process([*program, "simulate", plan, "-o", flight])
        spent = run_process([*program, "report", f"{flight}/flight.yaml", "-o", out, "--audit", "none"])
        metrics = json.loads(Path(out, "metrics.json").read_text(encoding="utf-8"))
    return {**spent, "samples": sum(m["n"] for tower in metrics["rss"].values() for m in tower.values())}


def flights(count: int, workers: int = 1) -> dict[str, float]:
    """Measure a campaign whose flights were simulated before."""
    from aerpaw_cmp.jobs.options import RunOptions
    from aerpaw_cmp.jobs.run import run_campaign, run_simulate

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for number in range(count):
            place = folder / f"f{number}"
            place.mkdir()
            (place / "flight.yaml").write_text(yaml.safe_dump(short_flight(number)), encoding="utf-8")
            run_simulate(place / "flight.yaml", RunOptions(out=place / "flown"))
        content = {
            "campaign": "scaling",
            "flights": [f"f{n}/flown/flight.yaml" for n in range(count)],
            "settings": {"as written": {}, "line of sight": {"rt.max_depth": 0}},
        }
        (folder / "campaign.yaml").write_text(yaml.safe_dump(content), encoding="utf-8")
        return timed(lambda: run_campaign(folder / "campaign.yaml", RunOptions(out=folder / "out", workers=workers)))


def short_flight(number: int) -> dict[str, Any]:
    """flight.yaml of 130 s around LW1."""
    content = yaml.safe_load((ROOT / "sample_logs" / "flight.yaml").read_text(encoding="utf-8"))
    plan = content["flight"]["plan"]
    content["flight"]["name"] = f"flight_{number}"
    content["flight"]["plan"] = plan | {"seed": number, "waypoints": plan["waypoints"][:5], "bad_lines": 0}
    content["logs"] = content["logs"][:3]
    return {**content, "rt": {"engine": "image", "max_depth": 1, "audit_links": 0}}


MEASURES: dict[str, Callable[[float], dict[str, float]]] = {
    "poses": lambda n: replay_of(int(n), towers=5),
    "towers": lambda n: replay_of(10_000, towers=int(n)),
    "faces": lambda n: faces(int(n)),
    "samples": lambda n: samples(int(n)),
    "report": report,
    "flights": lambda n: flights(int(n)),
    "workers": lambda n: flights(int(SIZES["flights"][0][-1]), workers=int(n)),
}


def measure(axis: str, size: float, seconds: float) -> dict[str, Any]:
    """Measure one size in a separate process. If this is not possible, return the reason."""
    command = [sys.executable, __file__, "--one", axis, str(size)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "parsers")])}
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=seconds, env=environment, check=False)
    except subprocess.TimeoutExpired:
        return {"size": size, "refused": f"not done in {seconds:g} s"}
    if done.returncode:
        return {"size": size, "refused": (done.stderr.strip().splitlines() or ["no message"])[-1][:200]}
    return {"size": size, **json.loads(done.stdout.splitlines()[-1])}


def power(rows: list[dict[str, Any]], key: str = "cpu_s") -> float | None:
    """Exponent of cost against size between the two largest sizes that were measured."""
    good = [(r.get("samples", r.get("faces", r["size"])), r[key]) for r in rows if key in r]
    if len(good) < 2 or min(good[-1][1], good[-2][1]) <= 0:
        return None
    (a, cost_a), (b, cost_b) = good[-2:]
    return math.log(cost_b / cost_a) / math.log(b / a)


def run(axes: list[str], *, large: bool = False, seconds: float = 240.0) -> dict[str, Any]:
    """All sizes of the axes asked for."""
    by_axis = {}
    for axis in axes:
        rows = [measure(axis, size, seconds) for size in SIZES[axis][1 if large else 0]]
        by_axis[axis] = {"rows": rows, "power_cpu": power(rows), "power_memory": power(rows, "peak_mib")}
    return by_axis


def main() -> None:
    """Print JSON, of which benchmarks/performance.py makes tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--axes", nargs="+", choices=list(SIZES), default=list(SIZES))
    parser.add_argument("--large", action="store_true", help="the sizes of a season and of a city")
    parser.add_argument("--seconds", type=float, default=240.0, help="limit of one size")
    parser.add_argument("--one", nargs=2, metavar=("AXIS", "SIZE"), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.one:
        axis, size = arguments.one
        print(json.dumps(MEASURES[axis](float(size))))
        return
    print(f"{os.cpu_count()} processors, load {os.getloadavg()[0]:.1f}", file=sys.stderr)
    by_axis = run(arguments.axes, large=arguments.large, seconds=arguments.seconds)
    print(json.dumps(by_axis, indent=1))


if __name__ == "__main__":
    main()
