"""The site as triangles, one mesh per material.

Walls begin below the ground and nothing has a bottom face, so no two triangles lie in one plane by accident. All
outward normals follow the right-hand rule. The replay's image engine takes its faces from the site itself; meshes are
for ray tracers, pictures and other programs.
"""

from __future__ import annotations

import numpy as np
import shapely

from ..common.units import FloatArray, IntArray
from .materials import material
from .site import Building, Site

# Walls reach this far below the base of a building.
WALL_DEPTH_M = 0.5

# The ground reaches this far beyond the area: reflections must not fall off its edge.
_GROUND_MARGIN_M = 3000.0


# Vertices (n, 3) [m] and triangles (m, 3).
Mesh = tuple[FloatArray, IntArray]


def building_mesh(building: Building) -> Mesh:
    """Walls and roof of a building: vertices (n, 3) [m] and triangles (m, 3)."""
    low, high = building.base_m - WALL_DEPTH_M, building.base_m + building.height_m
    footprint = shapely.orient_polygons(building.footprint)  # outer ring counter-clockwise, holes clockwise
    vertices, triangles, count = [], [], 0
    for ring in (footprint.exterior, *footprint.interiors):
        line = np.asarray(ring.coords)[:-1, :2]
        n = len(line)
        vertices.append(np.column_stack([np.tile(line, (2, 1)), np.repeat([low, high], n)]))
        a = np.arange(n)
        b = (a + 1) % n
        # the outer ring runs counter-clockwise, so these corners do so seen from outside
        walls = np.concatenate([np.stack([a, b, b + n], axis=1), np.stack([a, b + n, a + n], axis=1)])
        triangles.append(walls + count)
        count += 2 * n
    parts = shapely.get_parts(shapely.constrained_delaunay_triangles(footprint))
    roof = np.stack([np.asarray(part.exterior.coords)[:3, :2] for part in parts])
    flat = roof.reshape(-1, 2)
    edge, other_edge = roof[:, 1] - roof[:, 0], roof[:, 2] - roof[:, 0]
    # the triangulation promises no sense, and a roof must look up
    turn = edge[:, 0] * other_edge[:, 1] < edge[:, 1] * other_edge[:, 0]
    order = np.arange(len(flat)).reshape(-1, 3)
    order[turn] = order[turn][:, ::-1]
    vertices.append(np.column_stack([flat, np.full(len(flat), high)]))
    triangles.append(order + count)
    return np.concatenate(vertices), np.concatenate(triangles).astype(np.int64)


def rectangle(west_m: float, east_m: float, south_m: float, north_m: float, up_m: float) -> Mesh:
    """A level rectangle that looks up.

    Parameters
    ----------
    west_m, east_m, south_m, north_m, up_m : float
        Its sides and its height.

    Returns
    -------
    Mesh
        Two triangles.
    """
    corners = [(west_m, south_m, up_m), (east_m, south_m, up_m), (east_m, north_m, up_m), (west_m, north_m, up_m)]
    return np.array(corners), np.array([[0, 1, 2], [0, 2, 3]])


def site_meshes(site: Site) -> dict[str, Mesh]:
    """Meshes of the buildings by material, and of the ground where no scene brings its own.

    Parameters
    ----------
    site : Site
        Any.

    Returns
    -------
    dict of str to Mesh
        Materials of ITU-R P.2040.
    """
    pieces: dict[str, list[Mesh]] = {}
    if site.scene is None:
        (west, east, south, north), beyond = site.area_m, _GROUND_MARGIN_M
        ground = rectangle(west - beyond, east + beyond, south - beyond, north + beyond, 0.0)
        pieces[material(site.ground_material).name] = [ground]
    for building in site.buildings:
        pieces.setdefault(material(building.material).name, []).append(building_mesh(building))
    return {name: _joined(parts) for name, parts in pieces.items()}


def _joined(parts: list[Mesh]) -> Mesh:
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    triangles = [faces + start for (_, faces), start in zip(parts, starts, strict=False)]
    return np.concatenate([vertices for vertices, _ in parts]), np.concatenate(triangles)
