"""Paths of the image engine among integer boxes against rational arithmetic (tests/propagation/exact.py).

Walls that touch, ends on faces, segments through edges and corners and along walls: where a tolerance shows.

Run: python benchmarks/aligned_paths.py [--links N] [--seed S] [--json]     (20 000 links take some minutes)
"""

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np
from shapely.geometry import box

from aerpaw_cmp.common.geodesy import SiteFrame
from aerpaw_cmp.propagation.geometry import Links, inside_solids, site_faces
from aerpaw_cmp.propagation.search.mirror import find_paths
from aerpaw_cmp.site.site import Building, Site, Tower

sys.path.insert(0, str(Path(__file__).parents[1]))
from tests.propagation import exact


def wrong(rng: np.random.Generator, boxes: int) -> tuple[int, int, int, int, float]:
    """Links, paths, phantom paths, missing paths of one scene, and the seconds of the reference."""
    solids, source, poses = exact.random_scene(rng, boxes)
    buildings = tuple(Building(f"b{k}", box(w, s, e, n), float(top)) for k, (w, e, s, n, top) in enumerate(solids))
    tower = Tower("LW1", 35.7, -78.7, 0.0, 0.0, 10.0)
    site = Site("integers", SiteFrame(35.7275, -78.696), {"LW1": tower}, buildings)
    faces = site_faces(site)
    targets = np.array(poses, dtype=float)
    paths = find_paths(
        faces, Links(np.array([source], dtype=float), targets, excluded=inside_solids(site, targets)[None])
    )
    counts = np.zeros(4, dtype=int)
    started = time.perf_counter()
    for pose, target in enumerate(poses):
        expected = exact.paths(solids, source, target)
        ours = exact.planes_found(paths, faces, pose)
        counts += [1, len(expected), len(ours - expected), len(expected - ours)]
    return (*counts.tolist(), time.perf_counter() - started)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--links", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    rng = np.random.default_rng(options.seed)
    total = np.zeros(4, dtype=int)
    while total[0] < options.links:
        total += wrong(rng, int(rng.integers(1, 5)))[:4]
    result = dict(zip(("links", "paths", "phantom", "missing"), total.tolist(), strict=True))
    print(json.dumps(result) if options.json else result)


if __name__ == "__main__":
    main()
