"""The site as triangles, one mesh per material.

Walls begin below the ground and nothing has a bottom face, so no two triangles lie in one plane by accident. All
outward normals follow the right-hand rule. The replay's image engine takes its faces from the site itself; meshes are
for ray tracers, pictures and other programs.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import shapely

from ..common.units import FloatArray, IntArray
from .materials import CROWN, material
from .site import Building, Site, Trees

# Walls reach this far below the base of a building.
WALL_DEPTH_M = 0.5

# The ground reaches this far beyond the area: reflections must not fall off its edge.
_GROUND_MARGIN_M = 3000.0

CROWN_SIDES = 8
_TRUNK_SIDES = 6


@dataclass(frozen=True, slots=True)
class Mesh:
    """Triangles of one material.

    Parameters
    ----------
    vertices_m : (vertices, 3)
        East, north, up.
    triangles : (triangles, 3) int
        Indices of vertices, counter-clockwise seen from outside.
    owner : (triangles,) int
        Index into ``labels``.
    labels : tuple of str
        What the triangles belong to: ``ground``, a building's name, ``trunks``, ``crowns``.
    """

    vertices_m: FloatArray
    triangles: IntArray
    owner: IntArray
    labels: tuple[str, ...]


def building_mesh(building: Building) -> tuple[FloatArray, IntArray]:
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
        walls = np.concatenate([np.stack([a, b, b + n], axis=1), np.stack([a, b + n, a + n], axis=1)])
        triangles.append(walls + count)
        count += 2 * n
    parts = shapely.get_parts(shapely.constrained_delaunay_triangles(footprint))
    roof = np.stack([np.asarray(part.exterior.coords)[:3, :2] for part in parts])
    flat = roof.reshape(-1, 2)
    edge, other_edge = roof[:, 1] - roof[:, 0], roof[:, 2] - roof[:, 0]
    turn = edge[:, 0] * other_edge[:, 1] < edge[:, 1] * other_edge[:, 0]
    order = np.arange(len(flat)).reshape(-1, 3)
    order[turn] = order[turn][:, ::-1]
    vertices.append(np.column_stack([flat, np.full(len(flat), high)]))
    triangles.append(order + count)
    return np.concatenate(vertices), np.concatenate(triangles).astype(np.int64)


def _bodies(
    centre_m: FloatArray, low_m: FloatArray, high_m: FloatArray, radius_m: FloatArray, sides: int, *, pointed: bool
) -> tuple[FloatArray, IntArray]:
    """Upright prisms without caps, or pyramids with a bottom (their base hangs in the air); many at once."""
    count = len(centre_m)
    angle = np.arange(sides) * (2 * np.pi / sides)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    rim = centre_m[:, None] + radius_m[:, None, None] * circle
    bottom = np.concatenate([rim, np.broadcast_to(low_m[:, None, None], (count, sides, 1))], axis=2)
    a = np.arange(sides)
    b = (a + 1) % sides
    if pointed:
        tips = np.concatenate([centre_m, high_m[:, None]], axis=1)[:, None]
        feet = np.concatenate([centre_m, low_m[:, None]], axis=1)[:, None]
        vertices = np.concatenate([bottom, tips, feet], axis=1)
        faces = np.concatenate(
            [np.stack([a, b, np.full(sides, sides)], axis=1), np.stack([b, a, np.full(sides, sides + 1)], axis=1)]
        )
    else:
        top = bottom.copy()
        top[..., 2] = high_m[:, None]
        vertices = np.concatenate([bottom, top], axis=1)
        faces = np.concatenate([np.stack([a, b, b + sides], axis=1), np.stack([a, b + sides, a + sides], axis=1)])
    per = vertices.shape[1]
    triangles = faces + (np.arange(count) * per)[:, None, None]
    return vertices.reshape(-1, 3), triangles.reshape(-1, 3).astype(np.int64)


def _crowns(trees: Trees) -> tuple[FloatArray, IntArray]:
    """Crowns as pyramids with a bottom, inside the round cones."""
    centre = np.column_stack([trees.east_m, trees.north_m])
    base, top = trees.ground_m + trees.crown_base_m, trees.ground_m + trees.height_m
    return _bodies(centre, base, top, trees.crown_diameter_m / 2, CROWN_SIDES, pointed=True)


def _ground_mesh(site: Site) -> tuple[FloatArray, IntArray]:
    """The flat ground, up = 0: two triangles that face upwards."""
    west, east, south, north = site.area_m
    corners = [(west, south), (east, south), (east, north), (west, north)]
    out = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * _GROUND_MARGIN_M
    vertices = np.column_stack([np.array(corners) + out, np.zeros(4)])
    return vertices, np.array([[0, 1, 2], [0, 2, 3]])


def site_meshes(site: Site, *, trees: bool = True) -> Mapping[str, Mesh]:
    """Meshes of a site by material.

    Parameters
    ----------
    site : Site
        Any.
    trees : bool
        Crowns (material ``vegetation``) and trunks (wood) too, as polygonal cones and cylinders inside the round ones.

    Returns
    -------
    mapping of str to Mesh
        Materials of ITU-R P.2040, and ``vegetation``.
    """
    pieces: dict[str, list[tuple[str, FloatArray, IntArray]]] = {}
    pieces[material(site.ground_material).name] = [("ground", *_ground_mesh(site))]
    for building in site.buildings:
        name = material(building.material).name
        pieces.setdefault(name, []).append((building.name, *building_mesh(building)))
    if trees and len(site.trees):
        t = site.trees
        centre = np.column_stack([t.east_m, t.north_m])
        base = t.ground_m + t.crown_base_m
        trunk = t.crown_base_m > 0
        if trunk.any():
            foot = t.ground_m[trunk] - WALL_DEPTH_M
            body = _bodies(centre[trunk], foot, base[trunk], t.trunk_diameter_m[trunk] / 2, _TRUNK_SIDES, pointed=False)
            pieces.setdefault("wood", []).append(("trunks", *body))
        pieces[CROWN] = [("crowns", *_crowns(t))]
    return {name: _joined(parts) for name, parts in pieces.items()}


def _joined(parts: list[tuple[str, FloatArray, IntArray]]) -> Mesh:
    starts = np.cumsum([0] + [len(vertices) for _, vertices, _ in parts])
    return Mesh(
        np.concatenate([vertices for _, vertices, _ in parts]),
        np.concatenate([faces + start for (_, _, faces), start in zip(parts, starts[:-1], strict=True)]),
        np.repeat(np.arange(len(parts)), [len(faces) for _, _, faces in parts]),
        tuple(name for name, _, _ in parts),
    )
