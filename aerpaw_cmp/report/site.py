"""Drawings of a site: a plan, and a page that shows it in 3-D.

The page contains its script and loads no other file.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import shapely

from ..common.units import FloatArray
from ..site.scenes import drawn_buildings
from ..site.site import Site
from . import canvas
from .packed import at_height, listed, scene
from .page import embedded, rendered, write_file
from .texts import safe_name

if TYPE_CHECKING:
    from matplotlib.figure import Figure


TREES_IN_PAGE = 5000


def view_limits(site: Site) -> FloatArray:
    """Return the limits (3, 2) of all objects in east, north and up, with a margin [m]."""
    areas = [(b.footprint, b.base_m + b.height_m) for b in drawn_buildings(site)]
    areas += [(forest.area, 0.0) for forest in site.forests] + [(fence.area, 0.0) for fence in site.geofences]
    trees, towers = site.trees, np.array([tower.position_m for tower in site.towers.values()]).reshape(-1, 3)
    tops = np.column_stack([trees.east_m, trees.north_m, trees.ground_m + trees.height_m])
    cloud = np.concatenate([towers, tops, *(at_height(shapely.get_coordinates(a), top_m) for a, top_m in areas)])
    cloud = cloud[np.isfinite(cloud).all(axis=1)]
    if not len(cloud):
        return np.array([[-100.0, 100.0], [-100.0, 100.0], [0.0, 50.0]])
    low, high = cloud.min(axis=0), cloud.max(axis=0)
    margin = 0.05 * max(high[0] - low[0], high[1] - low[1], 100.0)
    # include objects below the origin
    ground = min(0.0, float(low[2]))
    return np.array(
        [[low[0] - margin, high[0] + margin], [low[1] - margin, high[1] + margin], [ground, max(high[2] * 1.1, 30.0)]]
    )


def plan(site: Site) -> Figure:
    """Return the plan of all objects, with equal scales."""
    limits = view_limits(site)
    width, height = np.ptp(limits[:2], axis=1)
    shape = float(np.clip(width / height, 0.45, 2.2))
    fig, ax = canvas.subplots((7.0 * min(shape, 1.0) + 2.4, 7.0 / max(shape, 1.0) + 0.6))
    canvas.draw_site(ax, site)
    ax.set(xlim=limits[0], ylim=limits[1])
    ax.set_title(site.name, wrap=True)
    if ax.get_legend_handles_labels()[0]:
        ax.legend(loc="center left", bbox_to_anchor=(1.01, 0.5))
    return fig


def viewer(site: Site) -> str:
    """Return the page that shows the site in 3-D."""
    content = scene(site, TREES_IN_PAGE)
    walled = zip(drawn_buildings(site), content["buildings"], strict=True)
    content |= {
        "buildings": [{"name": b.name, "height": b.height_m, "faces": faces} for b, faces in walled],
        "limits": listed(view_limits(site)),
        "fences": [listed(g.area.exterior.coords) for g in site.geofences],
    }
    shown = {"site": site, "scene": embedded(content), "trees_shown": len(content["trees"])}
    return rendered("site_view", ("common.js", "site_view.js"), **shown)


def write_site_view(site: Site, folder: str | Path) -> list[Path]:
    """Write ``<site>.html`` and ``<site>_plan.svg|png``.

    Parameters
    ----------
    site : Site
    folder : path
        Folder, which is created if it does not exist.

    Returns
    -------
    list of Path
        The page is the first.
    """
    folder, stem = Path(folder), safe_name(site.name)
    written = [write_file(folder / f"{stem}.html", viewer(site))]
    with canvas.style():
        drawn = canvas.save_as(plan(site), ("svg", "png"))
    return [*written, *(write_file(folder / f"{stem}_plan.{form}", picture) for form, picture in drawn.items())]
