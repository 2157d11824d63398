"""Compare engines on scenes at each depth: seconds (wall and CPU), memory, paths, missing and extra paths.

python benchmarks/scenes.py [--scenes munich,etoile,florence] [--depths 1,2] [--receivers 200]
    [--prisms 1000,5000] [--sionna 100000,1000000] [--limits 1000000,10000000] [--slots 24,26]
    [--json FILE]

The scenes are those of the installed Sionna RT. Each row runs in a separate process, whose memory is measured. Compiled
code must exist before (the first row states how long the compilation took). Receivers are within 200 m of one
transmitter, half of them at street level and half 30 to 60 m above.

--sionna    PathSolver with this number of rays on the same triangles, at the first of the depths. Its paths that ours
            does not have are "missing", and ours that it does not have are "extra". Each of them is checked in Sionna's
            own scene by a ray test of every segment, shortened by 2 cm
--limits, --slots   its max_num_paths_per_src and its table of candidates (2 to this power), in all combinations
"""

import argparse
import itertools
import json
import os
import platform
import resource
import subprocess
import sys
import time
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from shapely.geometry import box

from aerpaw_cmp.propagation.geometry import Links
from aerpaw_cmp.propagation.options import Search
from aerpaw_cmp.propagation.search.beams import grow_paths
from aerpaw_cmp.propagation.search.merging import merged
from aerpaw_cmp.site.mitsuba import read_scene

SOURCES = {
    "munich": (8.5, 21.0, 27.0),
    "etoile": (0.0, 0.0, 30.0),
    "florence": (0.0, 0.0, 30.0),
    "san_francisco": (0.0, 0.0, 120.0),
    "simple_street_canyon": (-20.0, 0.0, 20.0),
}
RAISED_M = {"san_francisco": 60.0}  # its streets lie on hills
CARRIER_HZ = 3.5e9


def shipped(name: str) -> Path:
    folder = find_spec("sionna").submodule_search_locations[0]  # type: ignore[union-attr, index]
    return Path(folder) / "rt" / "scenes" / name / f"{name}.xml"


def ends(name: str, receivers: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(1)
    source = np.array(SOURCES.get(name, (0.0, 0.0, 30.0)))
    away, angle = 200.0 * np.sqrt(rng.uniform(size=receivers)), rng.uniform(0.0, 2.0 * np.pi, receivers)
    up = np.where(np.arange(receivers) % 2 == 0, 1.5, rng.uniform(30.0, 60.0, receivers)) + RAISED_M.get(name, 0.0)
    if name == "simple_street_canyon":
        away = away / 5.0
    targets = np.column_stack([source[0] + away * np.cos(angle), source[1] + away * np.sin(angle), up])
    return source[None, :], targets


def keys(paths: Any) -> set[tuple[int, ...]]:
    return {
        (p, t, *(f for f in faces if f >= 0))
        for p, t, faces in zip(paths.pose.tolist(), paths.tower.tolist(), paths.faces.tolist(), strict=True)
    }


def row_keys(paths: Any, plane: np.ndarray) -> list[tuple[int, ...]]:
    """Pose, tower and planes of each path."""
    numbers = np.append(plane, -1)
    rows = np.column_stack([paths.pose, paths.tower, numbers[paths.faces]])
    return [tuple(n for n in row if n >= 0) for row in rows.tolist()]


def plane_keys(paths: Any, plane: np.ndarray) -> set[tuple[int, ...]]:
    return set(row_keys(paths, plane))


class Clock:
    def __init__(self) -> None:
        self.wall, self.cpu = time.perf_counter(), time.process_time()

    def since(self) -> tuple[float, float]:
        return time.perf_counter() - self.wall, time.process_time() - self.cpu


def warm_up() -> float:
    """Compile, or load what was compiled."""
    clock = Clock()
    scene = read_scene(shipped("simple_street_canyon"))
    grow_paths(merged(scene), Links(*ends("simple_street_canyon", 4)), max_depth=2)
    return clock.since()[0]


def image_row(task: dict[str, Any]) -> dict[str, Any]:
    """One scene by the exact search."""
    compile_s = warm_up()
    clock = Clock()
    scene = read_scene(shipped(task["scene"]))
    sources, targets = ends(task["scene"], task["receivers"])
    surfaces = merged(scene)
    setup = clock.since()
    clock = Clock()
    paths = grow_paths(surfaces, Links(sources, targets), max_depth=task["depth"])
    search = clock.since()
    row = {
        **task,
        "engine": "image",
        "triangles": len(scene),
        "faces": len(surfaces),
        "compile_s": compile_s,
        "setup_s": setup,
        "search_s": search,
        "mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "paths": np.bincount(paths.depth, minlength=task["depth"] + 1).tolist(),
        "duplicates": len(paths) - len(plane_keys(paths, surfaces.plane)),
    }
    return row


def prism_row(task: dict[str, Any]) -> dict[str, Any]:
    """A town of prisms through the replay's own search."""
    from aerpaw_cmp.common.geodesy import SiteFrame
    from aerpaw_cmp.propagation.geometry import Link, Poses, single_element
    from aerpaw_cmp.propagation.scene import Scene
    from aerpaw_cmp.propagation.search import beams
    from aerpaw_cmp.site.site import Building, Site, Tower

    compile_s = warm_up()
    clock = Clock()
    rng = np.random.default_rng(2)
    count = task["prisms"]
    side = 35.0 * count**0.5  # as dense as a suburb, for any size
    spots = rng.uniform(-side / 2, side / 2, (count, 2))
    buildings = tuple(
        Building(f"b{k}", box(e, n, e + rng.uniform(8, 20), n + rng.uniform(8, 20)), float(rng.uniform(5, 15)))
        for k, (e, n) in enumerate(spots)
        if np.hypot(e, n) > 30.0
    )
    site = Site("town", SiteFrame(35.7, -78.7), {"T": Tower("T", 35.7, -78.7, 0.0, 0.0, 30.0)}, buildings)
    _, targets = ends("town", task["receivers"])
    poses = Poses(targets, np.tile(np.eye(3), (len(targets), 1, 1)))
    scene = Scene.of(site, Link(CARRIER_HZ, {"T": single_element()}, single_element()), poses)
    setup = clock.since()
    clock = Clock()
    paths = beams.find_paths(scene.faces, scene.links_to(poses), max_depth=task["depth"])
    return {
        **task,
        "scene": f"{count} prisms",
        "engine": "image",
        "faces": len(scene.faces),
        "compile_s": compile_s,
        "setup_s": setup,
        "search_s": clock.since(),
        "mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "paths": np.bincount(paths.depth, minlength=task["depth"] + 1).tolist(),
        "duplicates": len(paths) - len(keys(paths)),
    }


def sionna_row(task: dict[str, Any]) -> dict[str, Any]:
    """PathSolver on the same triangles, and what each has that the other lacks."""
    from aerpaw_cmp.propagation.search import sionna

    if task.get("limit"):
        sionna.MAXIMUM_PATHS = task["limit"]
        sionna._Finder._more_room = lambda _: False
    if task.get("slots"):
        sionna.SPECULAR_TABLE_SLOTS = 2 ** task["slots"]
    surfaces = merged(read_scene(shipped(task["scene"])))
    sources, targets = ends(task["scene"], task["receivers"])
    ours = grow_paths(surfaces, Links(sources, targets), max_depth=task["depth"])
    sionna.load_variant()
    clock = Clock()
    theirs = sionna.find_paths(
        surfaces.faces, Links(sources, targets),
        Search("sionna", max_depth=task["depth"], samples=task["samples"], batch=25),
        carrier_hz=CARRIER_HZ, surfaces=surfaces,
    )  # fmt: skip
    spent = clock.since()
    mine, other = plane_keys(ours, surfaces.plane), plane_keys(theirs, surfaces.plane)
    lacking = np.array([k not in other for k in row_keys(ours, surfaces.plane)])
    row = {
        **task,
        "engine": "sionna",
        "faces": len(surfaces),
        "search_s": spent,
        "mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "paths": np.bincount(theirs.depth, minlength=task["depth"] + 1).tolist(),
        "exact": np.bincount(ours.depth, minlength=task["depth"] + 1).tolist(),
        "missing": len(other - mine),
        "extra": len(mine - other),
        "duplicates": len(theirs) - len(other),
    }
    clear = free_in_sionna(surfaces, ours.select(lacking), sources, targets)
    return row | {"extra_confirmed": int(clear.sum()), "extra_refuted": int((~clear).sum())}


# Float32 at a kilometre, and the merge tolerance at grazing incidence.
SHORTENED_M = 0.02


def free_in_sionna(surfaces: Any, paths: Any, sources: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Check which paths (paths,) reflect on surfaces of Sionna's own scene and are not blocked there."""
    import mitsuba as mi

    from aerpaw_cmp.propagation.search import sionna

    builder = sionna._Builder(
        faces=surfaces.faces, links=Links(sources, targets), carrier_hz=CARRIER_HZ, surfaces=surfaces
    )
    scene = builder.scene(np.arange(len(surfaces))).scene.mi_scene
    clear = np.ones(len(paths), dtype=bool)
    for row in range(len(paths)):
        points = [sources[paths.tower[row]], *paths.vertices_m[row, : paths.depth[row]], targets[paths.pose[row]]]
        for a, b in itertools.pairwise(points):
            length = float(np.linalg.norm(b - a))
            if length < 3 * SHORTENED_M:
                continue
            way = (b - a) / length
            start = a + SHORTENED_M * way
            ray = mi.Ray3f(mi.Point3f(*start.tolist()), mi.Vector3f(*way.tolist()))
            ray.maxt = length - 2 * SHORTENED_M
            clear[row] &= not bool(scene.ray_test(ray).numpy()[0])
    return clear


def run(task: dict[str, Any]) -> dict[str, Any]:
    done = subprocess.run(
        [sys.executable, __file__, "--one", json.dumps(task)], capture_output=True, text=True, check=False
    )
    if done.returncode:
        return {**task, "failed": done.stderr.strip().splitlines()[-1:]}
    return json.loads(done.stdout.splitlines()[-1])  # type: ignore[no-any-return]


def table(rows: list[dict[str, Any]]) -> None:
    head = "scene", "engine", "depth", "set-up wall / CPU [s]", "search wall / CPU [s]", "MiB", "paths by depth"
    print("| " + " | ".join([*head, "missing / extra (of these free in Sionna's scene) / twice"]) + " |")
    print("| --- " * 8 + "|")
    for row in rows:
        if "failed" in row:
            print(f"| {row.get('scene', row.get('prisms'))} | {row['kind']} | {row['depth']} | {row['failed']} |")
            continue
        engine = row["engine"]
        if engine == "sionna":
            engine += f", {row['samples']:g} rays, limit {row['limit']:g}, table 2^{row['slots']}"
        setup = "{:.1f} / {:.1f}".format(*row["setup_s"]) if "setup_s" in row else ""
        compared = f"/ / {row['duplicates']}"
        if "missing" in row:
            compared = f"{row['missing']} / {row['extra']} ({row['extra_confirmed']}) / {row['duplicates']}"
        search = "{:.1f} / {:.1f}".format(*row["search_s"])
        paths = ", ".join(map(str, row["paths"]))
        cells = row["scene"], engine, str(row["depth"]), setup, search, f"{row['mib']:.0f}", paths, compared
        print("| " + " | ".join(cells) + " |")


def tasks_of(given: argparse.Namespace, names: list[str]) -> list[dict[str, Any]]:
    common = {"receivers": given.receivers}
    depths = given.depths
    tasks = []
    if not given.only_sionna:
        tasks += [{"kind": "image", "scene": n, "depth": d, **common} for n in names for d in depths]
    tasks += [{"kind": "prisms", "prisms": n, "depth": d, **common} for n in given.prisms for d in depths]
    tasks += [
        {"kind": "sionna", "scene": n, "depth": depths[0], "samples": s, "limit": m, "slots": t, **common}
        for n in names
        for s in given.sionna
        for m in given.limits
        for t in given.slots
    ]
    return tasks


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    numbers = lambda text: [int(float(n)) for n in text.split(",") if n]  # noqa: E731
    parser.add_argument("--scenes", default="munich,etoile,florence")
    parser.add_argument("--depths", type=numbers, default=[1, 2])
    parser.add_argument("--receivers", type=int, default=200)
    parser.add_argument("--prisms", type=numbers, default=[])
    parser.add_argument("--sionna", type=numbers, default=[])
    parser.add_argument("--limits", type=numbers, default=[0])
    parser.add_argument("--slots", type=numbers, default=[0])
    parser.add_argument("--only-sionna", action="store_true")
    parser.add_argument("--json", type=Path, help="- for standard output, last")
    parser.add_argument("--one", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.one:
        task = json.loads(given.one)
        print(json.dumps({"image": image_row, "prisms": prism_row, "sionna": sionna_row}[task["kind"]](task)))
        return
    names = [name for name in given.scenes.split(",") if name]
    print(
        f"{platform.machine()}, {len(os.sched_getaffinity(0))} cores, load {os.getloadavg()[0]:.1f}, Python "
        f"{platform.python_version()}; {given.receivers} receivers, 1 transmitter"
    )
    rows = [run(task) for task in tasks_of(given, names)]
    table(rows)
    if given.json:
        text = json.dumps({"rows": rows}, indent=1)
        print(text) if str(given.json) == "-" else given.json.write_text(text)


if __name__ == "__main__":
    main()
