"""The site as triangles, one mesh per material, and scenes of triangles in the site frame.

Walls begin below the ground and prisms have no bottom face, because two faces in the same plane would disturb ray
tracers. All outward normals follow the right-hand rule. Meshes are for ray tracers, pictures and other programs. The
image engine of the replay uses the faces of the site instead.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import shapely
from shapely.geometry import Polygon

from ..common.errors import UsageError
from ..common.text import counted
from ..common.units import FloatArray
from .materials import CROWN, material
from .mitsuba import Mesh, TriangleScene, joined, read_scene
from .site import Building, Forest, Site

# Depth of walls below the base of a building.
WALL_DEPTH_M = 0.5

# Margin of the ground around the area, so that no reflection misses it.
_GROUND_MARGIN_M = 3000.0


def building_mesh(building: Building) -> Mesh:
    """Return walls and roof of a building as vertices (n, 3) [m] and triangles (m, 3)."""
    low, high = building.base_m - WALL_DEPTH_M, building.base_m + building.height_m
    footprint = shapely.orient_polygons(building.footprint)  # the outer ring is counter-clockwise, holes are clockwise
    vertices, triangles, count = [], [], 0
    for ring in (footprint.exterior, *footprint.interiors):
        line = np.asarray(ring.coords)[:-1, :2]
        n = len(line)
        vertices.append(np.column_stack([np.tile(line, (2, 1)), np.repeat([low, high], n)]))
        a = np.arange(n)
        b = (a + 1) % n
        # the outer ring is counter-clockwise, so these corners are counter-clockwise from outside
        walls = np.concatenate([np.stack([a, b, b + n], axis=1), np.stack([a, b + n, a + n], axis=1)])
        triangles.append(walls + count)
        count += 2 * n
    parts = shapely.get_parts(shapely.constrained_delaunay_triangles(footprint))
    roof = np.stack([np.asarray(part.exterior.coords)[:3, :2] for part in parts])
    flat = roof.reshape(-1, 2)
    edge, other_edge = roof[:, 1] - roof[:, 0], roof[:, 2] - roof[:, 0]
    # the triangulation may have either direction, but the normal of a roof must point up
    turn = edge[:, 0] * other_edge[:, 1] < edge[:, 1] * other_edge[:, 0]
    order = np.arange(len(flat)).reshape(-1, 3)
    order[turn] = order[turn][:, ::-1]
    vertices.append(np.column_stack([flat, np.full(len(flat), high)]))
    triangles.append(order + count)
    return np.concatenate(vertices), np.concatenate(triangles).astype(np.int64)


def rectangle(west_m: float, east_m: float, south_m: float, north_m: float, up_m: float) -> Mesh:
    """Return a horizontal rectangle whose normal points up.

    Parameters
    ----------
    west_m, east_m, south_m, north_m, up_m : float
        Sides and height of the rectangle [m].

    Returns
    -------
    Mesh
        The rectangle as two triangles.
    """
    corners = [(west_m, south_m, up_m), (east_m, south_m, up_m), (east_m, north_m, up_m), (west_m, north_m, up_m)]
    return np.array(corners), np.array([[0, 1, 2], [0, 2, 3]])


def site_meshes(site: Site) -> dict[str, Mesh]:
    """Return meshes of the buildings by material, and of the ground if the site has no scene.

    Parameters
    ----------
    site : Site
        The site.

    Returns
    -------
    dict of str to Mesh
        Meshes by material of ITU-R P.2040.
    """
    pieces: dict[str, list[Mesh]] = {}
    if site.scene is None:
        (west, east, south, north), beyond = site.area_m, _GROUND_MARGIN_M
        ground = rectangle(west - beyond, east + beyond, south - beyond, north + beyond, 0.0)
        pieces[material(site.ground_material).name] = [ground]
    for building in site.buildings:
        pieces.setdefault(material(building.material).name, []).append(building_mesh(building))
    return {name: joined(parts) for name, parts in pieces.items()}


# Distance by which an added ground plane extends beyond the scene, as a multiple of the size of the scene.
_PLANE_MARGIN = 10.0

# A scene has no ground if its horizontal surfaces cover a smaller share of its plan than this.
GROUND_SHARE = 0.5

# Vertical part of the normal above which a surface can be ground.
LEVEL = 0.7


def placed_scene(
    path: Path,
    *,
    materials: Mapping[str, str] | None = None,
    sha256: str | None = None,
    offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
    turn_deg: float = 0.0,
    ground_plane: str | None = None,
) -> TriangleScene:
    """Return a Mitsuba scene, rotated and moved into the site frame.

    Parameters
    ----------
    path : Path
        XML file.
    materials : mapping of str to str, optional
        As in :func:`aerpaw_cmp.site.mitsuba.read_scene`.
    sha256 : str, optional
        Required digest of the files of the scene.
    offset_m : (east, north, up)
        Position of its origin [m].
    turn_deg : float
        Rotation about its origin, counter-clockwise from above.
    ground_plane : str, optional
        Material of a plane that is added at the lowest point of the scene.

    Returns
    -------
    TriangleScene
        Scene in the site frame [m].

    Raises
    ------
    UsageError
        If the digest of the files is not ``sha256``.
    """
    scene = read_scene(path, materials)
    if sha256 is not None and sha256 != scene.sha256:
        raise UsageError(
            f"the scene's files have SHA-256 {scene.sha256[:16]}...",
            expected=f"{sha256[:16]}...",
            cause="they changed since the site was made: import them again, or leave out scene.sha256",
            path=path,
        )
    cosine, sine = math.cos(math.radians(turn_deg)), math.sin(math.radians(turn_deg))
    turn = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    vertices = scene.vertices_m if turn_deg == 0.0 else scene.vertices_m @ turn.T
    scene = replace(scene, vertices_m=vertices + np.array(offset_m))
    return scene if ground_plane is None else with_ground(scene, ground_plane)


def with_ground(scene: TriangleScene, name: str) -> TriangleScene:
    """Add a horizontal rectangle at the lowest point of the scene, which extends far beyond the scene."""
    low, high = bounds(scene)
    # extend it so far that no reflection between points of the scene misses it
    reach = _PLANE_MARGIN * float(max(*(high - low)[:2], 100.0))
    mesh = rectangle(low[0] - reach, high[0] + reach, low[1] - reach, high[1] + reach, low[2])
    return added(scene, *mesh, "ground plane", material(name).name)


def added(
    scene: TriangleScene, vertices_m: np.ndarray, triangles: np.ndarray, name: str, of_material: str
) -> TriangleScene:
    """Return the scene with one more shape.

    Parameters
    ----------
    scene : TriangleScene
    vertices_m : (v, 3)
        Corners of the shape [m].
    triangles : (t, 3) int
        Rows of ``vertices_m``.
    name, of_material : str
        Name and material of the shape.

    Returns
    -------
    TriangleScene
    """
    vertices, triangles = joined([(scene.vertices_m, scene.triangles), (vertices_m, triangles)])
    return replace(
        scene,
        vertices_m=vertices,
        triangles=triangles,
        shape=np.append(scene.shape, np.full(len(triangles) - len(scene), len(scene.shapes))),
        shapes=(*scene.shapes, name),
        materials=(*scene.materials, of_material),
    )


def bounds(scene: TriangleScene) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and highest coordinates of all triangles, shape (3,) [m]."""
    used = scene.vertices_m[np.unique(scene.triangles)]
    return used.min(axis=0), used.max(axis=0)


def ground_share(scene: TriangleScene) -> float:
    """Return the share of the plan that has a horizontal surface at any height."""
    corners = scene.vertices_m[scene.triangles]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = np.linalg.norm(across, axis=1)
    # accept both signs, because either side of a triangle in a file may be up
    level = corners[np.abs(across[:, 2]) > LEVEL * np.maximum(size, 1e-300)]
    low, high = bounds(scene)
    return float(shapely.union_all(shapely.polygons(level[:, :, :2])).area / (high - low)[:2].prod())


# A mesh that is narrower than the first length in plan, and closer than the second to an antenna, is its mast, bracket
# or housing.
_MAST_M, _TOUCHES_M = 4.0, 0.5


def usable_scene(
    scene: TriangleScene, antennas_m: Mapping[str, FloatArray]
) -> tuple[TriangleScene, tuple[Forest, ...], list[str]]:
    """Remove meshes of vegetation, and meshes that would enclose an antenna.

    Parameters
    ----------
    scene : TriangleScene
    antennas_m : mapping of str to (3,)
        Antennas by tower [m].

    Returns
    -------
    TriangleScene
        Scene without vegetation, and without meshes around or below an antenna.
    tuple of Forest
        One medium per connected part of a vegetation mesh, without trunks. A medium has the outline of the part from
        above, extends from the lowest to the highest corner, and is filled according to the volume.
    list of str
        List of actions.
    """
    notes: list[str] = []
    out = np.zeros(len(scene.shapes), dtype=np.bool_)
    for number in np.unique(scene.shape).tolist():
        corners = scene.vertices_m[scene.triangles[scene.shape == number]]
        low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
        for tower, place in antennas_m.items():
            # test the box first, because most meshes are far from all antennas
            if np.any(place < low - _TOUCHES_M) or np.any(place > high + _TOUCHES_M):
                continue
            inside = _encloses(corners, place)
            if inside or (high - low)[:2].max() <= _MAST_M:
                out[number] = True
                where = "inside" if inside else "at"
                notes.append(
                    f"the antenna of {tower} is {where} mesh {scene.shapes[number]}, which therefore does not block or "
                    "reflect"
                )
    green = np.array([name == CROWN for name in scene.materials])
    # omit trunks, because they shade only centimetres, but their convex outline would be a wood
    trunk = green & np.array(["trunk" in name.lower() for name in scene.shapes])
    woods = [wood for number in np.flatnonzero(green & ~trunk).tolist() for wood in _media(scene, number)]
    if green.any():
        notes.append(
            f"vegetation is a medium, not a mirror: {counted(int((green & ~trunk).sum()), 'mesh', 'meshes')}; "
            f"{counted(int(trunk.sum()), 'mesh', 'meshes')} of trunks omitted"
        )
    remaining = ~(out | green)[scene.shape]
    return replace(scene, triangles=scene.triangles[remaining], shape=scene.shape[remaining]), tuple(woods), notes


def _encloses(corners_m: FloatArray, place_m: FloatArray) -> bool:
    """Check whether a point is inside a mesh (n, 3, 3): upward lines from it then cross an odd number of triangles."""
    across = np.cross(corners_m[:, 1] - corners_m[:, 0], corners_m[:, 2] - corners_m[:, 0])
    # only the area vectors of a closed mesh add up to zero
    if np.linalg.norm(across.sum(axis=0)) > 1e-3 * np.linalg.norm(across, axis=1).sum():
        return False  # an open mesh, such as terrain
    votes = 0
    # use three lines and the majority, because a single line may meet an edge
    for shift in ((1e-4, 2e-4), (-3e-4, 1e-4), (2e-4, -3e-4)):
        a, b, c = (corners_m[:, k] - place_m - np.array([*shift, 0.0]) for k in range(3))
        turns = np.stack([p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0] for p, q in ((b, c), (c, a), (a, b))])
        over = (turns > 0).all(axis=0) | (turns < 0).all(axis=0)
        heights = np.stack([a[:, 2], b[:, 2], c[:, 2]])[:, over]
        votes += int(((turns[:, over] * heights).sum(axis=0) / turns[:, over].sum(axis=0) > 0).sum()) % 2
    return votes >= 2


def _media(scene: TriangleScene, number: int) -> Iterator[Forest]:
    """Yield the connected parts of a mesh of vegetation as media."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    corners = scene.vertices_m[scene.triangles[scene.shape == number]]
    point = np.unique(corners.reshape(-1, 3).round(4), axis=0, return_inverse=True)[1].reshape(-1, 3)
    size = int(point.max()) + 1
    links = coo_array((np.ones(2 * len(point)), (point[:, :2].ravel(), point[:, 1:].ravel())), shape=(size, size))
    part = connected_components(links, directed=False)[1][point[:, 0]]
    for index in range(int(part.max()) + 1):
        mine = corners[part == index]
        outline = shapely.convex_hull(shapely.multipoints(mine.reshape(-1, 3)[:, :2]))
        low, high = float(mine[..., 2].min()), float(mine[..., 2].max())
        if outline.geom_type != "Polygon" or not high > low:
            continue
        # by the divergence theorem the volume is one sixth of the sum of determinants, about any point
        volume = abs(float(np.linalg.det(mine - mine.mean(axis=(0, 1))).sum())) / 6.0
        yield Forest(
            name=scene.shapes[number] if index == 0 else f"{scene.shapes[number]} ({index + 1})", area=outline,
            height_m=high - low, crown_base_fraction=0.0, base_m=low,
            filled=min(volume / (outline.area * (high - low)), 1.0),
        )  # fmt: skip


_DRAWN_SIMPLER_M = 0.5
_DRAWN_M2 = 10.0
_DRAWN_TALLER_M = 1.0
# Largest number of prisms that represent a scene in pictures.
_DRAWN_MOST = 3000

# A part of a shape is treated as ground (terrain and hills) if it covers at least this share of the rectangle around
# the scene in plan view.
_GROUND_PART = 0.25


def drawn_buildings(site: Site) -> tuple[Building, ...]:
    """Return buildings for pictures: the buildings of the site, and prisms for the shapes of a scene of triangles.

    Each prism extends from the lowest corner of the scene below its part to the highest corner of the part. Prisms that
    would be at most 1 m high are not drawn. Parts that cover a quarter or more of the rectangle around the scene are
    treated as ground and not drawn. Only pictures use these prisms.
    """
    return site.buildings if site.scene is None else (*site.buildings, *_outlines(site.scene))


@lru_cache(maxsize=2)
def _outlines(scene: TriangleScene) -> tuple[Building, ...]:
    corners = scene.vertices_m[scene.triangles]
    plan = shapely.polygons(corners[:, :, :2])
    area = shapely.area(plan)
    low, high = bounds(scene)
    ground_m2 = float((high[0] - low[0]) * (high[1] - low[1]))
    outlines: list[tuple[str, Polygon, float]] = []
    from_above = area > 1e-3  # walls have no area from above
    for shape in np.unique(scene.shape[from_above]).tolist():
        rows = np.flatnonzero(from_above & (scene.shape == shape))
        parts = shapely.get_parts(shapely.union_all(shapely.buffer(plan[rows], 0.01, join_style="mitre")))
        part, row = shapely.STRtree(shapely.centroid(plan[rows])).query(parts, predicate="contains")
        for number, outline in enumerate(parts):
            mine = corners[rows[row[part == number]]][:, :, 2]
            simple = outline.simplify(_DRAWN_SIMPLER_M)
            if mine.size and simple.geom_type == "Polygon" and _DRAWN_M2 < simple.area < _GROUND_PART * ground_m2:
                outlines.append((scene.shapes[shape], simple, float(mine.max())))
    # keep only the largest outlines, because a browser cannot draw 100 000 prisms
    outlines = sorted(outlines, key=lambda drawn: -drawn[1].area)[:_DRAWN_MOST]
    # extend each prism down to the lowest corner below it, because roofs are often separate shapes
    feet = np.array([top for *_, top in outlines])
    boxes = shapely.buffer([outline for _, outline, _ in outlines], 0.5)
    box, corner = shapely.STRtree(shapely.points(scene.vertices_m[:, :2])).query(boxes, predicate="contains")
    np.minimum.at(feet, box, scene.vertices_m[corner, 2])
    tall = [
        (drawn, float(foot)) for drawn, foot in zip(outlines, feet, strict=True) if drawn[2] - foot > _DRAWN_TALLER_M
    ]
    return tuple(Building(name, outline, top - foot, foot) for (name, outline, top), foot in tall)
