"""Record what the replay and the commands compute before a change, and compare it after the change.

python benchmarks/freeze.py record FILE.npz [--quick] [--flights FOLDER_OR_YAML ...] [--logs FOLDER]
python benchmarks/freeze.py compare BEFORE.npz AFTER.npz

A record contains ten random scenes of 2 000 links each (half of them with buildings that touch on whole metres, in
NumPy and compiled), one street scene of triangles, the sample flight and each file of ``--flights``. It also contains
the tables that the commands write about the sample and about the flights and campaigns of ``--flights``, and the
account that ``ingest --json`` prints of ``--logs``, the folder against which the paths of the flights resolve.
``--quick`` takes two scenes in NumPy, and all tables.

Two records agree if path sets, ranks and all lines of the tables are equal, levels lie within 1e-9 dB and H within 1e-9
of the largest entry of its link. The worst difference of each is printed, and the first line that differs in each
table; the exit code is 1 if a bound is broken.
"""

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from importlib.util import find_spec
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from shapely.geometry import box

import aerpaw_cmp
from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.compare.rank import channel_rank
from aerpaw_cmp.jobs.bench import random_scene
from aerpaw_cmp.propagation import engines
from aerpaw_cmp.propagation.geometry import Poses, single_element
from aerpaw_cmp.propagation.replay import replay
from aerpaw_cmp.site.site import Building

POSES, TOWERS, SCENES = 400, 5, 10
RANK_K = (10.0, 100.0, 1000.0)
LEVEL_DB, RELATIVE_H = 1e-9, 1e-9
SAMPLE = Path(__file__).parents[1] / "sample_logs" / "flight.yaml"
# Arguments of each command, and the tables compared; without a table, what the command prints.
COMMANDS: dict[str, tuple[list[str], tuple[str, ...]]] = {
    "report": (["report", str(SAMPLE), "--audit", "none"], ("rss.csv", "rank.csv")),
    "channel npz": (["channel", str(SAMPLE), "--format", "npz"], ("channel.npz",)),
    "channel csv": (["channel", str(SAMPLE), "--format", "csv"], ("channel.csv",)),
    "predict": (["predict", str(SAMPLE)], ("prediction.csv",)),
    "map": (["map", "--quick"], ("layers.csv",)),
    "plan": (["plan", "sphere", "--site", "lake_wheeler", "--tower", "LW1", "--minutes", "2"], ("route.csv",)),
    "campaign": (["campaign", "two_settings.yaml", "--fresh"], ("campaign.csv",)),
    "ingest": (["ingest", str(SAMPLE.parent), "--json", "--timezone", "America/New_York"], ()),
}  # fmt: skip
TWO_SETTINGS = (
    f"campaign: sample\nflights: ['{SAMPLE}']\nsettings: {{as written: {{}}, line of sight: {{rt.max_depth: 0}}}}\n"
)


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
    from aerpaw_cmp.site.mitsuba import read_scene

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


def is_campaign(file: Path) -> bool:
    return "campaign" in yaml.safe_load(file.read_text(encoding="utf-8"))


def commands(flights: list[Path], logs: Path | None) -> dict[str, tuple[list[str], tuple[str, ...]]]:
    """The commands whose tables are recorded: those of the sample, then one per flight, campaign and folder of logs."""
    listed, root = dict(COMMANDS), [] if logs is None else ["--logs-root", str(logs.absolute())]
    for flight in flights:
        if is_campaign(flight):
            verb, tables = ["campaign", "--fresh"], ("campaign.csv",)
        else:
            verb, tables = ["report", "--audit", "none"], ("rss.csv", "rank.csv")
        listed[flight.stem] = [*verb, str(flight.absolute()), *root], tables
    if logs is not None:
        listed["ingest of logs"] = ["ingest", str(logs.absolute()), "--json", "--timezone", "America/New_York"], ()
    return listed


def tables(listed: dict[str, tuple[list[str], tuple[str, ...]]]) -> dict[str, Any]:
    """The lines of every table of these commands, and the arrays of those written by NumPy."""
    held: dict[str, Any] = {}
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}  # the code that was imported here
    for name, (arguments, files) in listed.items():
        with tempfile.TemporaryDirectory() as folder:
            Path(folder, "two_settings.yaml").write_text(TWO_SETTINGS, encoding="utf-8")
            out = ["-o", "out"] if files else []
            command = [sys.executable, "-m", "aerpaw_cmp", *arguments, *out]
            done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
            if done.returncode:
                held[f"{name}|lines"] = np.array([f"exit {done.returncode}", *done.stderr.splitlines()])
            elif not files:
                held[f"{name}|lines"] = np.array(done.stdout.replace(arguments[1], "LOGS").splitlines())
            for file in files if not done.returncode else ():
                path = Path(folder, "out", file)
                if path.suffix == ".npz":
                    held |= {f"{name}, {key}|table": array for key, array in np.load(path).items()}
                elif path.exists():  # a flight without ranks has no rank.csv
                    held[f"{name}, {file}|lines"] = np.array(path.read_text(encoding="utf-8").splitlines())
        print(name, f"exit {done.returncode}" if done.returncode else "", flush=True)
    return held


def record(flights: list[Path], logs: Path | None, quick: bool) -> dict[str, Any]:
    """Every case, in NumPy and, if numba is installed, compiled, and the tables of the commands."""
    held: dict[str, Any] = {}
    many = engines.MANY_FACES
    for mode in ("never", "always") if find_spec("numba") and not quick else ("never",):
        engines.MANY_FACES = 0 if mode == "always" else many
        for name, case in islice(scenes(), 2 if quick else SCENES):
            held |= columns(f"{name}, {mode}", replay(*case))
            print(name, mode, flush=True)
    engines.MANY_FACES = many
    case = None if quick else street()
    if case is not None:
        held |= columns("street", replay(*case))
    for place in [SAMPLE, *(flight for flight in flights if not is_campaign(flight))]:
        try:
            opened = aerpaw_cmp.open_flight(place, logs_root=None if place == SAMPLE else logs).replay()
        except UsageError as error:
            print(f"{place.stem} is left out: {error}", flush=True)
            continue
        for number, series in enumerate(opened.replays.all):
            held |= columns(f"{place.stem} {number}", series.replay)
        print(place.stem, flush=True)
    return held | tables(commands(flights, logs))


def differences(before: Any, after: Any) -> dict[str, float]:
    """Return the largest differences of two records. They are infinite if shapes, paths or cases differ."""
    worst = {
        "paths": 0.0,
        "vertices_m": 0.0,
        "level_db": 0.0,
        "h_relative": 0.0,
        "ranks": 0.0,
        "bits": 0.0,
        "lines": 0.0,
    }
    if set(before.files) != set(after.files):
        print("cases differ:", sorted(set(before.files) ^ set(after.files)))
        worst["paths"] = np.inf
    for name in sorted(set(before.files) & set(after.files)):
        old, new, key = before[name], after[name], name.rpartition("|")[2]
        if key in ("lines", "table") and not same_table(name, old, new):
            worst["lines"] += 1
        if key in ("lines", "table"):
            continue
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


def same_table(name: str, old: Any, new: Any) -> bool:
    """Check whether two tables are equal, and print the first line that differs."""
    if old.shape == new.shape and old.dtype.kind == new.dtype.kind:
        differ = old != new if old.dtype.kind in "US" else ~((old == new) | (np.isnan(old) & np.isnan(new)))
        if not differ.any():
            return True
        first = np.argwhere(np.atleast_1d(differ))[0]
        index = tuple(first) if old.ndim else ()
        print(f"{name}: {differ.sum()} of {differ.size} differ, first at {first}:\n  {old[index]}\n  {new[index]}")
    else:
        print(f"{name}: {old.shape} {old.dtype} before, {new.shape} {new.dtype} after")
    return False


def flight_files(places: list[Path]) -> list[Path]:
    return [file for place in places for file in (sorted(place.glob("*.yaml")) if place.is_dir() else [place])]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    verbs = parser.add_subparsers(dest="verb", required=True)
    writer = verbs.add_parser("record")
    writer.add_argument("file", type=Path)
    writer.add_argument("--flights", type=Path, nargs="*", default=[])
    writer.add_argument("--logs", type=Path)
    writer.add_argument("--quick", action="store_true")
    reader = verbs.add_parser("compare")
    reader.add_argument("before", type=Path)
    reader.add_argument("after", type=Path)
    arguments = parser.parse_args()
    if arguments.verb == "record":
        flights = flight_files(arguments.flights)
        np.savez_compressed(arguments.file, **record(flights, arguments.logs, arguments.quick))
        return 0
    worst = differences(np.load(arguments.before), np.load(arguments.after))
    for name, value in worst.items():
        print(f"{name:12} {value:g}")
    broken = (
        worst["paths"]
        or worst["ranks"]
        or worst["lines"]
        or worst["level_db"] > LEVEL_DB
        or worst["h_relative"] > RELATIVE_H
    )
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main())
