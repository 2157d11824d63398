"""A site as pictures: plan view, 3-D picture, and a page that turns it under the mouse.

The page is one file with its script inside; it draws on a canvas and loads nothing.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..common.units import FloatArray
from ..site.scenes import drawn_buildings
from ..site.site import Building, Site, Trees
from . import canvas
from .data import Track
from .export import write_file
from .html import environment
from .names import safe_name
from .shapes import at_height, listed, outline, walls

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TREES_IN_PAGE = 5000
TREES_IN_PICTURE = 1000
FLIGHT_POINTS = 2000

PATH_COLOURS = ("#111111", "#D55E00", "#009E73", "#CC79A7")
"""By number of reflections: none, one, two, more."""
UAV_MARK: dict[str, Any] = {
    "marker": "o", "markersize": 7, "color": "#F0C000", "markeredgecolor": "black", "linestyle": "none", "zorder": 8,
}  # fmt: skip
PATH_DASHES = ("-", (0, (5, 2)), (0, (1, 1.5)), (0, (6, 2, 1, 2)))


@dataclass(frozen=True, slots=True, kw_only=True)
class PathLine:
    """One propagation path to draw: ``points_m`` (n, 3) from tower to UAV, and its words."""

    points_m: FloatArray
    label: str

    @property
    def reflections(self) -> int:
        """Number of inner vertices."""
        return len(self.points_m) - 2


def view_limits(site: Site, track: Track | None, paths: Sequence[PathLine] = ()) -> FloatArray:
    """(3, 2) lowest and highest east, north, up of everything that stands or flies, with a margin [m]."""
    points = [tower.position_m for tower in site.towers.values()]
    for building in drawn_buildings(site):
        for corner in np.asarray(building.footprint.exterior.coords)[:, :2]:
            points.append(np.array([*corner, building.base_m + building.height_m]))
    for forest in site.forests:
        points += list(at_height(np.asarray(forest.area.exterior.coords)[:, :2], 0.0))
    for fence in site.geofences:
        points += list(at_height(np.asarray(fence.area.exterior.coords)[:, :2], 0.0))
    if len(trees := site.trees):
        points += list(np.column_stack([trees.east_m, trees.north_m, trees.ground_m + trees.height_m]))
    if track is not None and len(track.time):
        points += list(np.stack([track.east_m, track.north_m, track.up_m], axis=1)[:: max(1, len(track.time) // 500)])
    points += [vertex for path in paths for vertex in path.points_m]
    if not points:
        return np.array([[-100.0, 100.0], [-100.0, 100.0], [0.0, 50.0]])
    cloud = np.array(points)
    cloud = cloud[np.isfinite(cloud).all(axis=1)]
    low, high = cloud.min(axis=0), cloud.max(axis=0)
    margin = 0.05 * max(high[0] - low[0], high[1] - low[1], 100.0)
    ground = min(0.0, float(low[2]))
    return np.array(
        [[low[0] - margin, high[0] + margin], [low[1] - margin, high[1] + margin], [ground, max(high[2] * 1.1, 30.0)]]
    )


def uav_of(paths: Sequence[PathLine]) -> FloatArray | None:
    """Where the paths of one pose end (3,), or None without paths."""
    return np.asarray(paths[0].points_m[-1], dtype=np.float64) if paths else None


def plan(site: Site, track: Track | None = None, paths: Sequence[PathLine] = ()) -> Figure:
    """Plan view with everything on it, to scale."""
    limits = view_limits(site, track, paths)
    width, height = np.ptp(limits[:2], axis=1)
    shape = float(np.clip(width / height, 0.45, 2.2))
    fig = canvas.figure((7.0 * min(shape, 1.0) + 2.4, 7.0 / max(shape, 1.0) + 0.6))
    ax = fig.subplots()
    canvas.draw_site(ax, site)
    if track is not None and len(track.time):
        ax.plot(
            *canvas.thinned_plan(track.east_m, track.north_m), color="#0072B2", linewidth=1.3, label="flight", zorder=4
        )
    seen: set[int] = set()
    for path in paths:
        kind = min(path.reflections, len(PATH_COLOURS) - 1)
        ax.plot(
            path.points_m[:, 0], path.points_m[:, 1], color=PATH_COLOURS[kind], linestyle=PATH_DASHES[kind],
            linewidth=1.2, zorder=4.5, label=None if kind in seen else reflections_label(kind),
        )  # fmt: skip
        seen.add(kind)
    if (uav := uav_of(paths)) is not None:
        ax.plot(*uav[:2], **UAV_MARK, label=f"UAV, {uav[2]:.0f} m up")
    ax.set_axisbelow(True)
    ax.set_xlim(*limits[0])
    ax.set_ylim(*limits[1])
    ax.set_title(site.name, wrap=True)
    if ax.get_legend_handles_labels()[0]:
        ax.legend(loc="center left", bbox_to_anchor=(1.01, 0.5))
    return fig


def reflections_label(kind: int) -> str:
    """Legend entry of a path."""
    return ("line of sight", "one reflection", "two reflections", "more reflections")[kind]


def solid(site: Site, track: Track | None = None, paths: Sequence[PathLine] = ()) -> Figure:
    """Perspective picture; heights are stretched where the site is wide, and the axis says by how much."""
    from matplotlib import patheffects
    from mpl_toolkits.mplot3d import Axes3D  # noqa: F401 - registers the projection

    limits = view_limits(site, track, paths)
    width, height, up = np.ptp(limits, axis=1)
    stretch = float(np.clip(round(0.12 * max(width, height) / up), 1, 8))
    fig = canvas.figure((9.2, 6.2))
    ax: Any = fig.add_subplot(projection="3d", computed_zorder=False)
    invented = " (illustrative)" if site.illustrative else ""
    _solid_ground(ax, site, invented)
    _solid_buildings(ax, drawn_buildings(site), invented)
    _solid_trees(ax, site.trees, invented)
    for number, tower in enumerate(site.towers.values()):
        ax.plot(
            [tower.east_m] * 2, [tower.north_m] * 2, [tower.ground_m, tower.position_m[2]], color=canvas.TOWER,
            linewidth=2.2, zorder=5, label="tower" if number == 0 else None,
        )  # fmt: skip
        halo = [patheffects.withStroke(linewidth=2.5, foreground="white")]
        ax.text(
            *tower.position_m, f" {tower.name}", fontsize=8, fontweight="bold", zorder=8, path_effects=halo,
            verticalalignment="bottom",
        )  # fmt: skip
    if track is not None and len(track.time):
        step = max(1, len(track.time) // FLIGHT_POINTS)
        ax.plot(
            track.east_m[::step], track.north_m[::step], track.up_m[::step], color="#0072B2", linewidth=1.4, zorder=6,
            label="flight",
        )  # fmt: skip
    seen: set[int] = set()
    for path in paths:
        kind = min(path.reflections, len(PATH_COLOURS) - 1)
        ax.plot(
            *path.points_m.T, color=PATH_COLOURS[kind], linestyle=PATH_DASHES[kind], linewidth=1.2, zorder=7,
            label=None if kind in seen else reflections_label(kind),
        )  # fmt: skip
        seen.add(kind)
    if (uav := uav_of(paths)) is not None:
        ax.plot(*[[value] for value in uav], **UAV_MARK, label=f"UAV, {uav[2]:.0f} m up")
    ax.set_title(site.name, wrap=True)
    ax.set(xlim=limits[0], ylim=limits[1], zlim=limits[2])
    ax.set_box_aspect((width, height, up * stretch), zoom=1.2)
    ax.view_init(elev=32, azim=-62)
    ax.set_xlabel("East [m]")
    ax.set_ylabel("North [m]")
    ax.set_zlabel(f"Up [m]{'' if stretch == 1 else f', drawn {stretch:.0f} times taller'}")
    ax.locator_params(axis="z", nbins=4)
    for axis in (ax.xaxis, ax.yaxis, ax.zaxis):
        axis.pane.set_facecolor("white")
    if ax.get_legend_handles_labels()[0]:
        ax.legend(loc="upper left", bbox_to_anchor=(0.0, 1.0))
    return fig


def _solid_ground(ax: Any, site: Site, invented: str) -> None:
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    flat = [at_height(outline(forest.area), 0.0) for forest in site.forests]
    if flat:
        areas = Poly3DCollection(
            flat, facecolor=canvas.FOREST, edgecolor="#7FA873", alpha=0.5, label=f"forest{invented}", zorder=1
        )
        # matplotlib 3.11 would scale by corners that polygons of unlike length do not have; the limits are set anyway
        ax.add_collection3d(areas, autolim=False)
    for number, fence in enumerate(site.geofences):
        line = np.asarray(fence.area.exterior.coords)[:, :2]
        ax.plot(
            *at_height(line, 0.0).T, color="#333333", linestyle=(0, (4, 3)), linewidth=0.9, zorder=2,
            label="geofence" if number == 0 else None,
        )  # fmt: skip


def _solid_buildings(ax: Any, buildings: Sequence[Building], invented: str) -> None:
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    faces = [face for building in buildings for face in walls(building)]
    if not faces:
        return
    prisms = Poly3DCollection(
        faces, facecolor="#B5B5B5", edgecolor="black", linewidth=0.4, label=f"building{invented}", zorder=4
    )
    prisms.set_rasterized(len(faces) > 300)
    ax.add_collection3d(prisms, autolim=False)


def _solid_trees(ax: Any, trees: Trees, invented: str) -> None:
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    if not len(trees):
        return
    pick = canvas.spread_out(len(trees), TREES_IN_PICTURE)
    east, north, ground = trees.east_m[pick], trees.north_m[pick], trees.ground_m[pick]
    top, base, half = ground + trees.height_m[pick], ground + trees.crown_base_m[pick], trees.crown_diameter_m[pick] / 2
    corners = [(east - half, north, base), (east + half, north, base), (east, north, top)]
    crowns = np.stack([np.column_stack(corner) for corner in corners], axis=1)  # (trees, 3 corners, 3)
    part = "" if len(pick) == len(trees) else f", {len(pick)} of {len(trees)} drawn"
    cones = Poly3DCollection(
        crowns, facecolor="#7FAE6E", edgecolor="#3F6136", linewidth=0.25, label=f"tree{invented}{part}", zorder=3
    )
    cones.set_rasterized(True)
    ax.add_collection3d(cones, autolim=False)


def scene(site: Site, track: Track | None = None, paths: Sequence[PathLine] = ()) -> dict[str, Any]:
    """The site as plain lists for the page, rounded to 0.1 m."""
    trees, pick = site.trees, canvas.spread_out(len(site.trees), TREES_IN_PAGE)
    flight: list[Any] = []
    if track is not None and len(track.time):
        line = np.stack([track.east_m, track.north_m, track.up_m], axis=1)[:: max(1, len(track.time) // FLIGHT_POINTS)]
        flight = listed(line[np.isfinite(line).all(axis=1)])
    columns = ("east_m", "north_m", "ground_m", "height_m", "crown_diameter_m", "crown_base_m")
    return {
        "limits": listed(view_limits(site, track, paths)),
        "buildings": [
            {"name": b.name, "height": b.height_m, "faces": [listed(face) for face in walls(b)]}
            for b in drawn_buildings(site)
        ],
        "forests": [listed(outline(f.area)) for f in site.forests],
        "fences": [listed(g.area.exterior.coords) for g in site.geofences],
        "trees": listed(np.column_stack([getattr(trees, c)[pick] for c in columns])) if len(pick) else [],
        "towers": [{"name": t.name, "at": listed([t.east_m, t.north_m, t.ground_m]), "top": float(t.position_m[2])}
                   for t in site.towers.values()],
        "flight": flight,
        "paths": [{"label": p.label, "kind": min(p.reflections, 3), "points": listed(p.points_m)} for p in paths],
    }  # fmt: skip


def viewer(site: Site, track: Track | None = None, paths: Sequence[PathLine] = ()) -> str:
    """The page that shows the site in 3-D."""
    content = scene(site, track, paths)
    # '<' is written as an escape, so that no name can close the script element
    data = json.dumps(content, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    shown = len(content["trees"])
    text: str = environment().get_template("site_view.html.jinja").render(
        site=site, scene=data, trees_shown=shown, paths=paths, has_flight=bool(content["flight"])
    )  # fmt: skip
    return text


def write_site_view(
    site: Site, folder: str | Path, *, track: Track | None = None, paths: Sequence[PathLine] = ()
) -> list[Path]:
    """Write ``<site>_plan.svg|png``, ``<site>_3d.svg|png`` and ``<site>.html``.

    Parameters
    ----------
    site : Site
    folder : path
        Made when missing.
    track : Track, optional
        A flight to draw.
    paths : sequence of PathLine
        The propagation paths of one pose.

    Returns
    -------
    list of Path
        The page first.
    """
    folder, stem = Path(folder), safe_name(site.name)
    written = [write_file(folder / f"{stem}.html", viewer(site, track, paths))]
    for name, draw in (("plan", plan), ("3d", solid)):
        with canvas.style():
            svg, png = canvas.save(draw(site, track, paths))
        written += [write_file(folder / f"{stem}_{name}.svg", svg), write_file(folder / f"{stem}_{name}.png", png)]
    return written
