"""Times of the site room on this machine, with their conditions and limits.

python benchmarks/site.py [--quick] [--json]
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from aerpaw_cmp.common.geodesy import SiteFrame
from aerpaw_cmp.propagation.arrays import Link, Poses, single_element
from aerpaw_cmp.propagation.field.foliage import CrownIndex, foliage_depth_m
from aerpaw_cmp.propagation.scene import Scene
from aerpaw_cmp.propagation.search.crowns import FACES_PER_CROWN, Crowns
from aerpaw_cmp.site.footprints import import_site, site_yaml
from aerpaw_cmp.site.meshes import site_meshes
from aerpaw_cmp.site.site import Site, Trees
from aerpaw_cmp.site.siteyaml import load_site, site_model


def timed(work: Callable[[], Any]) -> tuple[float, Any]:
    start = time.perf_counter()
    result = work()
    return time.perf_counter() - start, result


def village(path: Path, buildings: int, trees: int) -> Path:
    """GeoJSON of scattered, partly overlapping buildings and woods that ask for ``trees`` trees at 100 per hectare."""
    model = site_model("lake_wheeler")
    frame = SiteFrame(model.origin.latitude_deg, model.origin.longitude_deg)
    random = np.random.default_rng(1)
    features = []

    def add(ring: np.ndarray, tags: dict[str, str]) -> None:
        latitude, longitude = frame.to_geographic(*np.concatenate([ring, ring[:1]]).T)
        coordinates = [np.column_stack([longitude, latitude]).tolist()]
        geometry = {"type": "Polygon", "coordinates": coordinates}
        features.append({"type": "Feature", "id": len(features), "properties": tags, "geometry": geometry})

    for _ in range(buildings):
        turn, corner = random.uniform(0, np.pi), random.uniform([-560, -330], [480, 1750])
        box = np.array([(0, 0), (1, 0), (1, 1), (0.5, 1), (0.5, 0.6), (0, 0.6)]) * random.uniform(8, 30, 2)
        rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        add(corner + box @ rotation.T, {"building": "yes", "height": f"{random.uniform(4, 12):.1f}"})
    side = (1.08 * trees / 4 * 100) ** 0.5  # four square woods, 100 m2 a tree, less the buildings in them
    for corner in ((-570, -340), (-570, 700), (-30, 100), (-30, 1000)):
        add(np.array(corner) + side * np.array([(0, 0), (1, 0), (1, 1), (0, 1)]), {"natural": "wood"})
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    return path


def monte_carlo_m(start: np.ndarray, end: np.ndarray, trees: Trees, samples: int) -> float:
    """Length inside cones by stratified sampling."""
    random = np.random.default_rng(0)
    point = start + ((np.arange(samples) + random.random(samples)) / samples)[:, None] * (end - start)
    along = (end - start)[:2] / np.linalg.norm((end - start)[:2])
    aside = (trees.east_m - start[0]) * along[1] - (trees.north_m - start[1]) * along[0]
    near = np.flatnonzero(np.abs(aside) < trees.crown_diameter_m)
    inside = 0
    for i in near:
        radius = np.hypot(point[:, 0] - trees.east_m[i], point[:, 1] - trees.north_m[i])
        base, top = trees.ground_m[i] + trees.crown_base_m[i], trees.ground_m[i] + trees.height_m[i]
        limit = trees.crown_diameter_m[i] / 2 * (top - point[:, 2]) / (top - base)
        inside += np.count_nonzero((point[:, 2] >= base) & (point[:, 2] <= top) & (radius <= limit))
    return inside / samples * float(np.linalg.norm(end - start))


def bounces_of(site: Site, position: np.ndarray) -> dict[str, Any]:
    """Time of all bounces off opaque crowns at depth 2, of one tower and of all."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    build_s, crowns = timed(lambda: Crowns(site.trees))
    found: dict[str, Any] = {"crown_facets": len(site.trees) * FACES_PER_CROWN, "crown_build_s": build_s}
    level = position * [1, 1, 0] + [0, 0, 40.0]
    for name, towers, place in (
        ("one_tower", list(site.towers)[:1], position),
        ("one_tower_at_40_m", list(site.towers)[:1], level),
        ("all_towers", list(site.towers), position),
    ):
        link = Link(3.4e9, dict.fromkeys(towers, single_element()), single_element())
        poses = Poses(place, np.broadcast_to(np.eye(3), (len(place), 3, 3)))
        scene = Scene.of(site, link, poses)
        seconds, (_, paths) = timed(lambda s=scene, p=poses: s.with_bounces(site, p, crowns, 2))
        found |= {f"crown_bounces_{name}_s": seconds, f"crown_bounces_{name}": len(paths)}
    more = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    return found | {"crown_bounces_limit_s": 20.0, "crown_bounces_more_mib": more, "crown_bounces_mib_limit": 500.0}


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a tenth of the size")
    parser.add_argument("--json", action="store_true", help="one JSON object and nothing else")
    options = parser.parse_args(arguments)
    scale = 10 if options.quick else 1
    buildings, trees, poses = 500 // scale, 10_000 // scale, 10_000 // scale

    with tempfile.TemporaryDirectory() as folder:
        source = village(Path(folder) / "village.json", buildings, trees)
        import_s, (model, actions) = timed(lambda: import_site([source]))
        write_s, _ = timed(lambda: (Path(folder) / "site.yaml").write_text(site_yaml(model)))
        load_s, site = timed(lambda: load_site(Path(folder) / "site.yaml"))
        mesh_s, meshes = timed(lambda: site_meshes(site))

    random = np.random.default_rng(2)
    west, east, south, north = site.area_m
    position = np.column_stack([random.uniform((west, south), (east, north), (poses, 2)), random.uniform(3, 60, poses)])
    towers = np.array([tower.position_m for tower in site.towers.values()])
    start, end = np.tile(towers, (poses, 1)), np.repeat(position, len(towers), axis=0)
    mirror = end * [1, 1, -1]
    bounce = (start + (start[:, 2] / (start[:, 2] - mirror[:, 2]))[:, None] * (mirror - start))[:, None]
    index_s, index = timed(lambda: CrownIndex(site.trees))
    direct_s, depth = timed(lambda: foliage_depth_m(start, np.zeros((len(start), 0, 3)), end, index))
    bounce_s, _ = timed(lambda: foliage_depth_m(start, bounce, end, index))
    crowns = bounces_of(site, position)
    some = random.choice(np.flatnonzero(depth > 5), 20)
    errors = [abs(monte_carlo_m(start[i], end[i], site.trees, 400_000) - depth[i]) / depth[i] for i in some]

    result = {
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}",
        "buildings_asked": buildings,
        "buildings_built": len(site.buildings),
        "trees": len(site.trees),
        "repairs": len(actions),
        "triangles": sum(len(mesh.triangles) for mesh in meshes.values()),
        "import_s": import_s,
        "write_s": write_s,
        "load_s": load_s,
        "mesh_s": mesh_s,
        "site_s": import_s + write_s + load_s + mesh_s,
        "site_limit_s": 10.0,
        "links": len(start),
        "links_through_crowns": int(np.count_nonzero(depth)),
        "index_s": index_s,
        "chords_line_of_sight_s": index_s + direct_s,
        "chords_ground_reflection_s": bounce_s,
        "chords_limit_s": 5.0,
        "monte_carlo_worst_relative": float(max(errors)),
        "monte_carlo_limit": 1e-3,
        **crowns,
    }
    if options.json:
        print(json.dumps(result))
        return
    for name, value in result.items():
        print(f"{name:28} {value:.4g}" if isinstance(value, float) else f"{name:28} {value}")


if __name__ == "__main__":
    main()
