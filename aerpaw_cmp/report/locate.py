"""The page locate.html with metrics.json and region.csv: a map of the regions that contain a ground node."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from ..common.units import FloatArray
from ..compare.locate import Regions
from ..site.site import Site
from .cards import HEAD, SHARE, Card, Page, Positions, Table, write_page
from .places import Places, payload
from .texts import minute


def write_locate(
    numbers: Mapping[str, Any], regions: Regions, track_m: FloatArray, site: Site, folder: Path
) -> list[Path]:
    """Write the page and its files, and return their paths, beginning with the page.

    Parameters
    ----------
    numbers : mapping
        Content of metrics.json. ``modes`` are the possible positions, sorted by probability.
    regions : Regions
    track_m : (n, 2 or more)
        East, north of the flight [m].
    site : Site
    folder : Path

    Returns
    -------
    list of Path
    """
    held, (east, north) = regions.likelier(), np.meshgrid(regions.east_m, regions.north_m, indexing="ij")
    inside = held < 0.9
    east, north, held = east[inside], north[inside], 100.0 * held[inside]
    places = Places(
        name="region of the node",
        at=np.column_stack([east, north, np.zeros(len(east))]),
        values={"smallest region with this position [%]": held},
        cell_m=float(regions.east_m[1] - regions.east_m[0]),
    )
    crosses = [np.array([[m["east_m"], m["north_m"]]]) + 8.0 * arm for m in numbers["modes"] for arm in _CROSS]
    shown = payload([places], site, lines=[track_m, *crosses])
    table = Table(
        caption="Parts of the 90 % region. Nine tenths of a part are within the stated distance of its position.",
        columns={"Position": HEAD, "East [m]": 0, "North [m]": 0, "Share": SHARE, "Within [m]": 0},
        rows=[
            (f"{m['latitude_deg']:.7f}, {m['longitude_deg']:.7f}", m["east_m"], m["north_m"], m["share"], m["radius_m"])
            for m in numbers["modes"]
        ],
    )
    page = Page(
        kind="locate", title=f"Ground node of {numbers['flight']}, {numbers['channel']}", verdict=numbers["sentence"],
        cautions=numbers["warnings"], about=[f"Made {minute(numbers['generated'])}."],
        cards=[Card(title="Map", positions=Positions(view="places", data=shown)),
               *([Card(title="Regions", id="places", tables=[table])] if len(numbers["modes"]) > 1 else []),
               Card(title="Assumptions", id="assumed", text=[numbers["assumed"]])],
    )  # fmt: skip
    latitude, longitude = site.frame.to_geographic(east, north)
    cells = {"latitude_deg": latitude, "longitude_deg": longitude, "smallest_region_percent": held}
    pd.DataFrame(cells).round(7).to_csv(folder / "region.csv", index=False, lineterminator="\n")
    return [*write_page(folder, "locate", page, numbers), folder / "region.csv"]


_CROSS = np.array([[[-1.0, 0.0], [1.0, 0.0]], [[0.0, -1.0], [0.0, 1.0]]])
