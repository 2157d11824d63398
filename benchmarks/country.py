"""A map of a country: a synthetic region of 3 towers and 3 000 buildings in tiles, by number of receivers.

    python benchmarks/country.py                      1e5 and 1e6 receivers, two workers
    python benchmarks/country.py --receivers 1e7      that number too

Each map is the command ``aerpaw-cmp map`` in a process of its own, its store on disk, without pages of other programs.
Seconds are wall clock with imports; the peak is the largest resident size of one worker.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import shapely
import yaml

from aerpaw_cmp.common.geodesy import SiteFrame

SIDE_M, VILLAGES, BUILDINGS, HEIGHT_M = 32_000.0, 60, 3_000, 3.0
TOWERS = {"north": (-2_000.0, 9_000.0), "south": (3_000.0, -8_000.0), "west": (-11_000.0, -1_500.0)}


def region(folder: Path, seed: int = 1) -> Path:
    """site.yaml of villages whose houses stand in all directions, with masts of 30 m between them."""
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
    content = {
        "name": "a synthetic region", "origin": {"latitude_deg": frame.latitude_deg, "longitude_deg": frame.longitude_deg},
        "towers": towers, "area_m": [-half, half, -half, half], "buildings": buildings,
    }  # fmt: skip
    path = folder / "region.yaml"
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    return path
