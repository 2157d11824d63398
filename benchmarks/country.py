"""A map of a country: a synthetic region of 3 towers and 3 000 buildings in tiles, by number of receivers.

    python benchmarks/country.py                            1e5 and 1e6 receivers, two workers
    python benchmarks/country.py --receivers 1e5,1e6,1e7    that one too
    python benchmarks/country.py --keep FOLDER              the stores stay there; a run that was ended goes on

Each map is ``aerpaw-cmp map`` at one height, 3 m, with one reflection and 4 x 4 elements, in a process of its own.
Seconds are wall-clock time with imports, store and page; MiB are the peaks of the largest worker and of the first
process.
"""

import argparse
import json
import math
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import shapely
import yaml

from aerpaw_cmp.common.geodesy import SiteFrame

SIDE_M, VILLAGES, BUILDINGS, HEIGHT_M = 32_000.0, 60, 3_000, 3.0
TOWERS = {"north": (-2_000.0, 9_000.0), "south": (3_000.0, -8_000.0), "west": (-11_000.0, -1_500.0)}


def region(folder: Path, seed: int = 1) -> Path:
    """Return a site.yaml of villages whose houses have all orientations, with masts of 30 m between them."""
    rng = np.random.default_rng(seed)
    frame = SiteFrame(35.7, -78.7)
    villages = rng.uniform(-0.48 * SIDE_M, 0.48 * SIDE_M, (VILLAGES, 2))
    spots = villages.repeat(BUILDINGS // VILLAGES, axis=0) + rng.normal(0.0, 250.0, (BUILDINGS, 2))
    buildings = []
    for number, (east, north) in enumerate(spots):
        width, depth = rng.uniform(8.0, 25.0), rng.uniform(6.0, 15.0)
        house = shapely.affinity.rotate(shapely.box(east, north, east + width, north + depth), rng.uniform(0.0, 180.0))
        corners = np.round(np.array(house.exterior.coords)[:-1], 3).tolist()
        height = round(float(rng.uniform(4.0, 12.0)), 2)
        buildings.append({"name": f"house {number}", "polygon_m": corners, "height_m": height})
    towers = {}
    for name, place in TOWERS.items():
        latitude, longitude = (round(float(x), 9) for x in frame.to_geographic(*place))
        towers[name] = {"latitude_deg": latitude, "longitude_deg": longitude, "antenna_height_m": 30.0}
    half = SIDE_M / 2
    origin = {"latitude_deg": frame.latitude_deg, "longitude_deg": frame.longitude_deg}
    content = {"name": "a synthetic region", "origin": origin, "towers": towers, "area_m": [-half, half, -half, half]}
    content["buildings"] = buildings
    path = folder / "region.yaml"
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    return path


# Runs a command and leaves processor seconds and peaks [MiB] of itself and of its workers.
MAP = """
import json, resource, sys, time
from aerpaw_cmp.__main__ import main
code = main(sys.argv[1:])
peak = {w: resource.getrusage(getattr(resource, w)) for w in ("RUSAGE_SELF", "RUSAGE_CHILDREN")}
json.dump({w: [u.ru_utime + u.ru_stime, u.ru_maxrss / 1024] for w, u in peak.items()}, open("usage.json", "w"))
sys.exit(code)
"""


def mapped(site: Path, receivers: float, workers: int, cells: int) -> dict[str, float]:
    """Seconds, peaks and size of one map."""
    folder = site.parent / f"{receivers:g}"
    folder.mkdir(exist_ok=True)
    spacing = SIDE_M / math.ceil(math.sqrt(receivers))
    words = f"--max-depth 1 --foliage none --rss-altitude {HEIGHT_M} --rank-altitude {HEIGHT_M} --json".split()
    tiles = ["--spacing", repr(spacing), "--tile-m", repr(cells * spacing), "--workers", str(workers)]
    started = time.perf_counter()
    command = [sys.executable, "-c", MAP, "map", str(site), "-o", "out", *tiles, *words]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(done.stderr)
    seconds = time.perf_counter() - started
    answer = json.loads(done.stdout)
    usage = json.loads((folder / "usage.json").read_text(encoding="utf-8"))
    files = [path.stat().st_size for path in (folder / "out" / "maps.zarr").rglob("*") if path.is_file()]
    here, there = usage["RUSAGE_SELF"], usage["RUSAGE_CHILDREN"]
    count = answer["tiles"]["positions"]
    return {
        "receivers": count, "tiles": answer["tiles"]["tiles"], "paths": answer["paths"], "wall_s": seconds,
        "maps_s": answer["stages"]["maps_s"], "cpu_s": here[0] + there[0], "first_cpu_s": here[0],
        "receivers_per_s": count / seconds, "worker_mib": there[1] if workers > 1 else here[1], "first_mib": here[1],
        "store_mib": sum(files) / 2**20, "files": len(files),
    }  # fmt: skip


def extrapolated(rows: list[dict[str, float]], receivers: float) -> dict[str, float]:
    """A larger map by the slopes between the two largest ones."""
    few, many = rows[-2:]
    slopes = {
        name: math.log(many[name] / few[name]) / math.log(many["receivers"] / few["receivers"])
        for name in ("wall_s", "first_cpu_s", "first_mib", "store_mib", "files")
    }
    times = receivers / many["receivers"]
    return {"receivers": receivers, **{name: many[name] * times**slope for name, slope in slopes.items()}}


def main() -> None:
    """Measure, print a table and what larger maps would take."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--receivers", default="1e5,1e6")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--cells", type=int, default=128, help="positions along a side of a tile")
    parser.add_argument("--keep", type=Path)
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = asked.keep or Path(scratch)
        folder.mkdir(exist_ok=True)
        site = region(folder.resolve())
        rows = []
        for receivers in map(float, asked.receivers.split(",")):
            rows.append(mapped(site, receivers, asked.workers, asked.cells))
            if not asked.json:
                print("  ".join(f"{name} {value:,.6g}" for name, value in rows[-1].items()), flush=True)
    larger = [extrapolated(rows, size) for size in (1e8, 1e9)] if len(rows) > 1 else []
    if asked.json:
        print(json.dumps({"workers": asked.workers, "cells": asked.cells, "rows": rows, "extrapolated": larger}))
    for row in () if asked.json else larger:
        print("extrapolated: " + "  ".join(f"{name} {value:,.4g}" for name, value in row.items()))


if __name__ == "__main__":
    main()
