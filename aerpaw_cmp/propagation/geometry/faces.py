"""The planar faces of a site: one ground plane per ground height, walls and flat roofs of the buildings.

Walls reach below the ground so that no crack stays at their foot; buildings have no bottom. Collinear edges of a
footprint are one wall, however many vertices the map gave it.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import shapely
from shapely.geometry import Polygon
from shapely.geometry.polygon import orient

from ...common.units import BoolArray, FloatArray, IntArray
from ...site.site import Building, Site
from .paths import Faces

# Walls start this far below the lower of their base and the site ground.
_WALL_FOOT_M = 0.5

# Sine of the angle between two edges below which they are one wall.
# A nanometre off over a metre; maps are drawn to the millimetre.
_COLLINEAR = 1e-9

_UP = np.array([0.0, 0.0, 1.0])


class _Face(NamedTuple):
    """One row of :class:`~aerpaw_cmp.propagation.geometry.paths.Faces`."""

    normal: FloatArray
    along: FloatArray
    across: FloatArray
    offset_m: float
    lower: tuple[float, float]
    upper: tuple[float, float]
    material: str
    label: str
    polygon: Polygon | None = None
    solid: int = -1


def site_faces(site: Site, towers: Sequence[str] = ()) -> Faces:
    """Faces of a site.

    Parameters
    ----------
    site : Site
    towers : sequence of str, optional
        Towers whose ground heights need a plane (default: all of the site, at least ``up = 0``).

    Returns
    -------
    Faces
        Ground planes first (``solid`` is -1), then walls and roof of each building.
    """
    # sorted and each once: the numbers of faces must not depend on the order of towers
    grounds = sorted({site.towers[name].ground_m for name in (towers or site.towers)}) or [0.0]
    return _faces(tuple(grounds), site.ground_material, site.buildings)


@lru_cache(maxsize=4)
def _faces(grounds: tuple[float, ...], ground_material: str, buildings: tuple[Building, ...]) -> Faces:
    """Faces of ground planes and buildings; kept, for a replay in parts asks again with each part."""
    faces = [*(_ground(height, ground_material, len(grounds) > 1) for height in grounds), *_solids(buildings)]
    columns: dict[str, Any] = dict(zip(_Face._fields, zip(*faces, strict=True), strict=True))
    numbers = {name: np.array(columns[name]) for name in _Face._fields if name not in ("material", "label", "polygon")}
    return Faces(**(columns | numbers))


@lru_cache(maxsize=1)
def _solids(buildings: tuple[Building, ...]) -> list[_Face]:
    """Walls and roofs; each tower's ground asks for the same."""
    parts = [(building, part, at) for at, building in enumerate(buildings) for part in _parts(building.footprint)]
    return [face for part in parts for face in (*_walls(*part), _roof(*part))]


def _ground(height_m: float, material: str, several: bool) -> _Face:
    label = f"ground at {height_m:g} m" if several else "ground"
    return _Face(
        normal=_UP,
        along=np.array([1.0, 0, 0]),
        across=np.array([0, 1.0, 0]),
        offset_m=height_m,
        lower=(-np.inf, -np.inf),
        upper=(np.inf, np.inf),
        material=material,
        label=label,
    )


def _parts(footprint: Polygon) -> list[Polygon]:
    """Valid, counter-clockwise polygons (holes clockwise) without collinear vertices."""
    # a ring that crosses itself becomes several, and perhaps lines, which are no walls
    valid = footprint if footprint.is_valid else shapely.make_valid(footprint)
    polygons = [part for part in shapely.get_parts(valid) if part.geom_type == "Polygon" and part.area > 0.0]
    # counter-clockwise, so that every edge has the building on its left
    return [
        orient(Polygon(_corners(part.exterior), [_corners(hole) for hole in part.interiors]), 1.0) for part in polygons
    ]


def _corners(ring: shapely.LinearRing) -> FloatArray:
    """Vertices (corners, 2) of a ring at which it turns."""
    # a ring repeats its first corner; a third coordinate of the map is no height of ours
    points = np.asarray(ring.coords, dtype=np.float64)[:-1, :2]
    # a triangle stays one, however flat
    while len(points) > 3:
        before = points - np.roll(points, 1, axis=0)
        after = np.roll(points, -1, axis=0) - points
        length = np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1)
        turn = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
        flat = np.abs(turn) <= _COLLINEAR * length
        if not flat.any():
            break
        points = np.delete(points, np.flatnonzero(flat)[0], axis=0)  # one at a time: neighbours change
    return points


def _walls(building: Building, footprint: Polygon, solid: int) -> list[_Face]:
    foot = min(building.base_m, 0.0) - _WALL_FOOT_M
    top = building.base_m + building.height_m
    faces: list[_Face] = []
    for ring in (footprint.exterior, *footprint.interiors):
        points = np.asarray(ring.coords, dtype=np.float64)
        for start, end in pairwise(points):
            edge = end - start
            length = float(np.hypot(*edge))
            # the solid lies left of every edge, so the outward normal is to the right
            along = np.array([edge[0], edge[1], 0.0]) / length
            normal = np.array([along[1], -along[0], 0.0])
            # in-plane coordinates count from the site's origin, not from the wall's corner
            first = float(along[:2] @ start)
            faces.append(
                # along x up = (along_north, -along_east, 0): the outward normal
                _Face(
                    normal=normal,
                    along=along,
                    across=_UP,
                    offset_m=float(normal[:2] @ start),
                    lower=(first, foot),
                    upper=(first + length, top),
                    material=building.material,
                    label=f"{building.name} wall {len(faces) + 1}",
                    solid=solid,
                )
            )
    return faces


def _roof(building: Building, footprint: Polygon, solid: int) -> _Face:
    """Roof; its axes follow the longest edge, so that a rectangular roof fills its bounds."""
    points = np.asarray(footprint.exterior.coords, dtype=np.float64)
    edges = np.diff(points, axis=0)
    longest = edges[np.argmax(np.hypot(edges[:, 0], edges[:, 1]))]
    along = np.array([longest[0], longest[1], 0.0]) / np.hypot(*longest)
    across = np.array([-along[1], along[0], 0.0])
    turned = shapely.transform(footprint, lambda p: p @ np.column_stack([along[:2], across[:2]]))
    # a rectangle that is turned fills its bounds only along its own axes
    low_a, low_b, high_a, high_b = turned.bounds
    # most roofs: bounds alone then say what is inside, which costs no polygon
    fills = np.isclose(turned.area, (high_a - low_a) * (high_b - low_b), rtol=1e-12, atol=0.0)
    polygon = None if fills else turned
    if polygon is not None:
        shapely.prepare(polygon)
    return _Face(
        normal=_UP,
        along=along,
        across=across,
        offset_m=building.base_m + building.height_m,
        lower=(low_a, low_b),
        upper=(high_a, high_b),
        polygon=polygon,
        material=building.material,
        label=f"{building.name} roof",
        solid=solid,
    )


def inside(faces: Faces, index: IntArray, points_m: FloatArray, tolerance_m: float) -> BoolArray:
    """Check whether points, taken as lying in the plane of their face, belong to the face.

    Parameters
    ----------
    faces : Faces
    index : (points,) int
        Face of each point.
    points_m : (points, 3)
    tolerance_m : float
        How far outside an edge a point still counts; negative: how far inside it must lie.

    Returns
    -------
    (points,) bool
    """
    a = np.einsum("ij,ij->i", faces.along.take(index, 0), points_m)
    b = np.einsum("ij,ij->i", faces.across.take(index, 0), points_m)
    # take: an index in brackets is several times slower for rows of two
    low, high = (faces.lower - tolerance_m).take(index, 0), (faces.upper + tolerance_m).take(index, 0)
    good = (a >= low[:, 0]) & (a <= high[:, 0]) & (b >= low[:, 1]) & (b <= high[:, 1])
    # polygons last, and only for points within the bounds
    for face in np.flatnonzero(np.bincount(index[good])):
        polygon = faces.polygon[face]
        if polygon is None:
            continue
        rows = np.flatnonzero(good & (index == face))
        hit = shapely.intersects_xy(polygon, a[rows], b[rows])
        if tolerance_m > 0.0 and not hit.all():
            # beyond the edge by up to the tolerance still counts
            hit = hit | shapely.dwithin(polygon, shapely.points(a[rows], b[rows]), tolerance_m)
        elif tolerance_m < 0.0 and hit.any():
            hit = hit & ~shapely.dwithin(polygon.boundary, shapely.points(a[rows], b[rows]), -tolerance_m)
        good[rows] = hit
    return np.asarray(good)


def corners(faces: Faces, reach_m: float = np.inf) -> FloatArray:
    """Corners (faces, 4, 3) of the in-plane bounds, in order round the face; infinite ones cut at ``reach_m``."""
    low = np.clip(faces.lower, -reach_m, reach_m)
    high = np.clip(faces.upper, -reach_m, reach_m)
    a = np.stack([low[:, 0], high[:, 0], high[:, 0], low[:, 0]], axis=1)
    b = np.stack([low[:, 1], low[:, 1], high[:, 1], high[:, 1]], axis=1)
    return np.asarray(
        (faces.normal * faces.offset_m[:, None])[:, None, :]
        + a[..., None] * faces.along[:, None, :]
        + b[..., None] * faces.across[:, None, :]
    )


def triangles(faces: Faces, reach_m: float) -> tuple[FloatArray, IntArray, IntArray]:
    """Triangulation of all faces, for ray tracers.

    Parameters
    ----------
    faces : Faces
    reach_m : float
        Infinite faces end here.

    Returns
    -------
    vertices_m : (vertices, 3)
    triangle : (triangles, 3) int
        Vertex indices, counter-clockwise seen from the front.
    face : (triangles,) int
        Face of each triangle.
    """
    vertices: list[FloatArray] = []
    owner: list[int] = []
    box = corners(faces, reach_m)
    for index, polygon in enumerate(faces.polygon):
        if polygon is None:
            quad = box[index]
            parts = [quad[[0, 1, 2]], quad[[0, 2, 3]]]
        else:
            base = faces.normal[index] * faces.offset_m[index]
            axes = np.stack([faces.along[index], faces.across[index]])
            # constrained: triangles of a plain one would cover the hollows
            pieces = shapely.get_parts(shapely.constrained_delaunay_triangles(polygon))
            parts = [base + np.asarray(orient(piece, 1.0).exterior.coords)[:3] @ axes for piece in pieces]
        vertices.extend(parts)
        owner.extend([index] * len(parts))
    stacked = np.concatenate(vertices) if vertices else np.zeros((0, 3))
    return stacked, np.arange(len(stacked), dtype=np.int64).reshape(-1, 3), np.array(owner, dtype=np.int64)


def inside_solids(site: Site, points_m: FloatArray) -> BoolArray:
    """Points (points,) strictly inside a building."""
    result = np.zeros(len(points_m), dtype=np.bool_)
    top = np.array([building.base_m + building.height_m for building in site.buildings])
    low = np.flatnonzero(np.isfinite(points_m).all(axis=1) & (points_m[:, 2] < top.max(initial=-np.inf)))
    if len(low):
        # "within" is strict: a pose on a wall or a roof is not inside
        tree = shapely.STRtree([building.footprint for building in site.buildings])
        point, building = tree.query(shapely.points(points_m[low, :2]), predicate="within")
        result[low[point[points_m[low[point], 2] < top[building]]]] = True
    return result
