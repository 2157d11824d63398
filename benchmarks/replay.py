"""Measure accuracy, time and memory of the replay on this machine, in one run.

1. singular values against 50-digit arithmetic on random links, 20 m to 3 km;
2. time and memory of 10 000 poses x 5 towers x 4 x 4;
3. a second replay by the sionna engine, whose paths are kept.

Run: python benchmarks/replay.py [--quick] [--no-sionna]
``aerpaw-cmp bench`` prints speed against error and the ratio to PathSolver.
"""

import argparse
import json
import platform
import resource
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from aerpaw_cmp.jobs.bench import random_scene
from aerpaw_cmp.propagation.geometry import Link, Poses
from aerpaw_cmp.propagation.options import Run, Search
from aerpaw_cmp.propagation.replay import replay

sys.path.insert(0, str(Path(__file__).parents[1]))


def digits(links: int) -> dict[str, object]:
    """Singular values against 50 digits: random attitudes, two walls and ground below 60 m, open field beyond."""
    import mpmath as mp

    from aerpaw_cmp.compare.rank import channel_rank
    from aerpaw_cmp.site.materials import material
    from tests.propagation import reference

    mp.mp.dps = reference.DIGITS
    site, link, poses = _digits_case(links)
    result = replay(site, link, poses)
    tower = next(iter(link.tower_arrays.values()))
    lam = mp.mpf(299792458) / mp.mpf(link.carrier_hz)
    source = next(iter(site.towers.values())).position_m
    worst, wrong = 0.0, dict.fromkeys((10, 100, 1000), 0)
    eta = {name: mp.mpc(material(name).relative_permittivity(link.carrier_hz)) for name in set(result.faces.material)}

    def face(f: int) -> tuple[Any, ...]:
        name = result.faces.material[f]
        offset = mp.mpf(float(result.faces.offset_m[f]))
        return reference.vec(result.faces.normal[f]), offset, eta[name], material(name).thickness_m

    for pose in range(links):
        paths = [[face(f) for f in row[row >= 0]] for row in result.paths.faces[result.paths.pose == pose]]
        turn = poses.rotation[pose] @ link.uav_array.mount
        h = reference.channel(
            [reference.vec(p) for p in source + tower.positions_m @ tower.mount.T],
            [reference.vec(p) for p in poses.position_m[pose] + link.uav_array.positions_m @ turn.T],
            reference.matrix(tower.mount),
            reference.matrix(turn),
            [mp.mpf(float(s)) for s in tower.slant_rad],
            [mp.mpf(float(s)) for s in link.uav_array.slant_rad],
            paths,
            lam,
            lambda theta, phi: (mp.mpf(1), mp.mpf(0)),  # noqa: ARG005
        )
        sigma = reference.singular_values(h)
        exact = np.array([float(s / sigma[0]) for s in sigma])
        ours = np.linalg.svd(result.h[pose, 0], compute_uv=False)
        worst = max(worst, float(np.abs(ours / ours[0] - exact).max()))
        for k in wrong:
            wrong[k] += int(channel_rank(result.h[pose, 0], k) != sum(s > sigma[0] / k for s in sigma))
    depth = np.bincount(result.paths.depth, minlength=3).tolist()
    return {"links": links, "paths_by_depth": depth, "worst_ratio_error": worst, "wrong_ranks": wrong}


def _digits_case(links: int):
    from dataclasses import replace as change

    from shapely.geometry import box

    from aerpaw_cmp.site.site import Building

    site, link, poses = random_scene(links, buildings=0, seed=5)
    walls = (
        Building("south", box(-3100, -90, 3100, -80), 140.0),
        Building("north", box(-3100, 80, 3100, 90), 140.0, material="metal"),
    )
    rng = np.random.default_rng(6)
    distance = np.exp(rng.uniform(np.log(20), np.log(3000), links))
    north = rng.uniform(-70, 70, links) * np.minimum(1.0, distance / 80)
    east = np.sqrt(np.maximum(distance**2 - north**2, 1.0)) * rng.choice([-1, 1], links)
    position = np.column_stack([east, north, rng.uniform(5, 120, links)])
    return change(site, buildings=walls), link, Poses(position, poses.rotation)


def size(poses: int, towers: int) -> dict[str, object]:
    """Seconds per pose count and peak memory, in a process of its own."""
    site, link, some = random_scene(poses, towers=towers)
    seconds = {}
    for share in (0.25, 0.5, 1.0):
        count = int(poses * share)
        part = Poses(some.position_m[:count], some.rotation[:count])
        seconds[count] = replay(site, Link(link.carrier_hz, link.tower_arrays, link.uav_array), part).seconds
    counts, times = np.array(list(seconds)), np.array(list(seconds.values()))
    slope, start = np.polyfit(counts, times, 1)
    return {
        "towers": towers,
        "seconds": {str(k): v for k, v in seconds.items()},
        "microseconds_per_link": 1e6 * slope / towers,
        "start_s": start,
        "linear_fit_worst_residual": float(np.abs(times - start - slope * counts).max() / times[-1]),
        "peak_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }


def cached(poses: int, folder: str) -> dict[str, float]:
    """A second replay by the sionna engine reads the paths."""
    site, link, some = random_scene(poses)
    first = replay(site, link, some, Search("sionna", samples=100_000), run=Run(cache_dir=folder))
    second = replay(site, link, some, Search("sionna", samples=100_000), run=Run(cache_dir=folder))
    return {"first_s": first.seconds, "second_s": second.seconds, "ratio": first.seconds / second.seconds}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="small sizes")
    parser.add_argument("--no-sionna", action="store_true")
    parser.add_argument("--only-size", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.only_size:
        print(json.dumps(size(options.only_size, 5)))
        return
    quick = options.quick
    result: dict[str, Any] = {
        "machine": platform.processor() or platform.machine(),
        "python": platform.python_version(),
    }
    command = [sys.executable, __file__, "--only-size", "500" if quick else "10000"]
    result["size"] = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    result["digits"] = digits(20 if quick else 1000)
    if not options.no_sionna:
        import tempfile

        with tempfile.TemporaryDirectory() as folder:
            result["cache"] = cached(50 if quick else 500, folder)
    print(json.dumps(result))


if __name__ == "__main__":
    main()
