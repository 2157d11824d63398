"""What the replay gives, written down before a change and compared after it: H, path sets, levels and ranks.

python benchmarks/freeze.py record FILE.npz [--flights FOLDER_OR_YAML ...] [--logs-root FOLDER]
python benchmarks/freeze.py compare BEFORE.npz AFTER.npz

A record holds ten random scenes of 2 000 links each, half of them with buildings that touch on whole metres, in NumPy
and compiled, one street scene of triangles, the sample flight and every flight file named. Two records agree where path
sets and ranks are equal, levels lie within 1e-9 dB and H within 1e-9 of the largest entry of its link; the worst
difference of each is printed, and the exit code is 1 where a bound is broken.
"""

import argparse
import os
import sys
from collections.abc import Iterator
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from shapely.geometry import box

import aerpaw_cmp
from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.compare.rank import channel_rank
from aerpaw_cmp.jobs.bench import random_scene
from aerpaw_cmp.propagation.geometry.arrays import Poses, single_element
from aerpaw_cmp.propagation.native import compiled
from aerpaw_cmp.propagation.replay import replay
from aerpaw_cmp.site.site import Building

POSES, TOWERS, SCENES = 400, 5, 10
RANK_K = (10.0, 100.0, 1000.0)
LEVEL_DB, RELATIVE_H = 1e-9, 1e-9
SAMPLE = Path(__file__).parents[1] / "sample_logs" / "flight.yaml"


def scenes() -> Iterator[tuple[str, tuple[Any, Any, Any]]]:
    """Ten scenes of towers, buildings and random poses."""
    for seed in range(SCENES):
        rng = np.random.default_rng(seed)
        site, link, poses = random_scene(POSES, buildings=6 + 3 * seed, towers=TOWERS, seed=seed)
        spread = rng.uniform([-300, -300, 1], [300, 300, 80], (POSES, 3))
        if seed % 2:  # whole metres: walls, roofs and ends coincide, buildings touch
            spread = np.round(spread)
            corners = rng.integers(-20, 20, (12, 2)) * 10
            blocks = [box(e, n, e + 10 * (1 + i % 3), n + 10) for i, (e, n) in enumerate(corners.tolist())]
            apart = [b for i, b in enumerate(blocks) if not any(b.intersection(o).area > 0 for o in blocks[:i])]
            made = tuple(Building(f"b{i}", b, float(4 + 2 * (i % 4))) for i, b in enumerate(apart))
            site = replace(site, buildings=made)
        yield f"scene {seed}", (site, link, Poses(spread, poses.rotation))


def street() -> tuple[Any, Any, Any] | None:
    """The street canyon that the installed Sionna RT ships."""
    spec = find_spec("sionna")
    if spec is None or find_spec("numba") is None:
        return None
    from aerpaw_cmp.site.mesh_scenes.mitsuba import read_scene

    folder = Path(next(iter(spec.submodule_search_locations or []))) / "rt" / "scenes" / "simple_street_canyon"
    site, link, poses = random_scene(200, buildings=0)
    at = np.random.default_rng(3).uniform([-60, -15, 1.5], [60, 15, 40], (200, 3))
    tower = replace(site.towers["LW1"], east_m=-20.0, north_m=0.0, antenna_height_m=20.0)
    place = replace(site, towers={"LW1": tower}, scene=read_scene(folder / "simple_street_canyon.xml"))
    link = replace(link, tower_arrays={"LW1": single_element()}, uav_array=single_element())
    return place, link, Poses(at, poses.rotation)


def columns(name: str, replayed: Any) -> dict[str, Any]:
    """The arrays of one replay."""
    paths = replayed.paths
    held = {f"{name}|{key}": getattr(paths, key) for key in ("pose", "tower", "depth", "faces", "vertices_m")}
    held |= {f"{name}|{key}": getattr(replayed, key) for key in ("h", "rss_dbm", "rss_power_dbm")}
    ranks = np.stack([channel_rank(replayed.h, k) for k in RANK_K])
    return {**held, f"{name}|ranks": ranks}


def record(flights: list[Path], logs_root: Path | None) -> dict[str, Any]:
    """Every case, in NumPy and where there is numba compiled."""
    held: dict[str, Any] = {}
    for mode in ("never", "always") if find_spec("numba") else ("never",):
        os.environ[compiled.SWITCH] = mode
        for name, case in scenes():
            held |= columns(f"{name}, {mode}", replay(*case))
            print(name, mode, flush=True)
    del os.environ[compiled.SWITCH]
    case = street()
    if case is not None:
        held |= columns("street", replay(*case))
    for place in [SAMPLE, *flights]:
        try:
            opened = aerpaw_cmp.open_flight(place, logs_root=None if place == SAMPLE else logs_root).replay()
        except UsageError as error:
            print(f"{place.stem} is left out: {error}", flush=True)
            continue
        for number, series in enumerate(opened.replays.all):
            held |= columns(f"{place.stem} {number}", series.replay)
        print(place.stem, flush=True)
    return held


def differences(before: Any, after: Any) -> dict[str, float]:
    """The worst differences of two records; infinite where shapes, paths or cases differ."""
    worst = {"paths": 0.0, "vertices_m": 0.0, "level_db": 0.0, "h_relative": 0.0, "ranks": 0.0, "bits": 0.0}
    if set(before.files) != set(after.files):
        print("cases differ:", sorted(set(before.files) ^ set(after.files)))
        worst["paths"] = np.inf
    for name in sorted(set(before.files) & set(after.files)):
        old, new, key = before[name], after[name], name.rpartition("|")[2]
        if old.shape != new.shape:
            print(f"{name}: shape {old.shape} before, {new.shape} after")
            worst["paths"] = np.inf
            continue
        if key in ("pose", "tower", "depth", "faces", "ranks"):
            count = float((old != new).sum())
            worst["ranks" if key == "ranks" else "paths"] += count
        elif key == "h":
            size = np.abs(old).max(axis=(-2, -1), keepdims=True, initial=1e-300)
            worst["h_relative"] = max(worst["h_relative"], float((np.abs(old - new) / size).max(initial=0.0)))
            worst["bits"] += float((old != new).sum())
        else:
            apart = np.where(np.isnan(old) & np.isnan(new), 0.0, np.abs(old - new))
            kind = "vertices_m" if key == "vertices_m" else "level_db"
            worst[kind] = max(worst[kind], float(np.nan_to_num(apart, nan=np.inf).max(initial=0.0)))
    return worst


def flight_files(places: list[Path]) -> list[Path]:
    return [file for place in places for file in (sorted(place.glob("*.yaml")) if place.is_dir() else [place])]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    verbs = parser.add_subparsers(dest="verb", required=True)
    writer = verbs.add_parser("record")
    writer.add_argument("file", type=Path)
    writer.add_argument("--flights", type=Path, nargs="*", default=[])
    writer.add_argument("--logs-root", type=Path)
    reader = verbs.add_parser("compare")
    reader.add_argument("before", type=Path)
    reader.add_argument("after", type=Path)
    arguments = parser.parse_args()
    if arguments.verb == "record":
        np.savez_compressed(arguments.file, **record(flight_files(arguments.flights), arguments.logs_root))
        return 0
    worst = differences(np.load(arguments.before), np.load(arguments.after))
    for name, value in worst.items():
        print(f"{name:12} {value:g}")
    broken = worst["paths"] or worst["ranks"] or worst["level_db"] > LEVEL_DB or worst["h_relative"] > RELATIVE_H
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main())
