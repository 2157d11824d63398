"""Edges of buildings that diffract, and the record of paths over one of them.

An edge is where two faces of a building meet at an exterior angle above 180 degrees: the rim of a flat roof and its
upright corners.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..common.units import FloatArray, IntArray
from .paths import Faces, PathSet, Rows
from .surfaces import Surfaces

# An end nearer than this to an edge has no path over it: there is no far field.
NEAREST_M = 0.01

# Faces of triangles that meet at less than this make no edge: they are facets of a bowed surface.
_BEND_RAD = np.radians(2.0)

# Corners of triangles nearer than this are one [m].
WELD_M = 1e-4

# Exterior angles nearer than this to 180 degrees [rad] are a plane.
_SHARPEST = 1e-6


@dataclass(frozen=True, slots=True)
class Edges:
    """Convex edges of a scene.

    Parameters
    ----------
    start_m, end_m : (edges, 3)
    along : (edges, 3)
        Unit vector from start to end; ``face_axis x normal = along``.
    face_axis : (edges, 3)
        Unit vector in face 0, away from the edge.
    normal : (edges, 3)
        Outward normal of face 0.
    normal_n : (edges, 3)
        Outward normal of face n.
    exterior : (edges,)
        Exterior angle over pi, above 1.
    face : (edges, 2) int
        Faces 0 and n.
    """

    start_m: FloatArray
    end_m: FloatArray
    along: FloatArray
    face_axis: FloatArray
    normal: FloatArray
    normal_n: FloatArray
    exterior: FloatArray
    face: IntArray

    def __len__(self) -> int:
        return len(self.start_m)

    @property
    def length_m(self) -> FloatArray:
        """Lengths (edges,)."""
        return np.asarray(np.linalg.norm(self.end_m - self.start_m, axis=1))

    @classmethod
    def of(cls, faces: Faces, ground_m: float = -np.inf) -> Edges:
        """Edges of the solids of a scene.

        Parameters
        ----------
        faces : Faces
            Walls and roofs of prisms (``solid >= 0``).
        ground_m : float
            Upright corners begin here where their wall begins lower.

        Returns
        -------
        Edges
        """
        rows = [row for solid in np.unique(faces.solid[faces.solid >= 0]) for row in _of_solid(faces, solid, ground_m)]
        starts, ends = (np.array([row[i] for row in rows]).reshape(-1, 3) for i in (0, 1))
        pairs = np.array([row[2] for row in rows], dtype=np.int64).reshape(-1, 2)
        normal, normal_n = faces.normal[pairs[:, 0]], faces.normal[pairs[:, 1]]
        along = ends - starts
        along = along / np.linalg.norm(along, axis=1, keepdims=True)
        turn = np.arctan2(np.linalg.norm(np.cross(normal_n, normal), axis=1), (normal * normal_n).sum(axis=1))
        return cls(
            start_m=starts,
            end_m=ends,
            along=along,
            face_axis=np.cross(normal, along),
            normal=normal,
            normal_n=normal_n,
            exterior=1.0 + turn / np.pi,
            face=pairs,
        )

    @classmethod
    def of_surfaces(cls, surfaces: Surfaces) -> Edges:
        """Edges of a scene of triangles: where faces meet at an angle, and borders that no other face touches.

        The air is taken to be on the side of the larger angle: in an inner corner, which diffracts nothing that
        reaches it, that is the inside of the building. Which way a triangle is turned does not matter.

        Parameters
        ----------
        surfaces : Surfaces

        Returns
        -------
        Edges
            One per side of triangles; a border has the exterior angle 2 and one face twice. The outer border of level
            ground is none.
        """
        corners, face = surfaces.corners_m, surfaces.face
        _, corner = np.unique(np.round(corners.reshape(-1, 3) / WELD_M).astype(np.int64), axis=0, return_inverse=True)
        corner = corner.reshape(-1, 3)
        ends = np.sort(np.stack([corner, np.roll(corner, -1, axis=1)], axis=2), axis=2).reshape(-1, 2)
        sides = np.stack([corners, np.roll(corners, -1, axis=1)], axis=2).reshape(-1, 2, 3)
        opposite = np.roll(corners, -2, axis=1).reshape(-1, 3)
        swap = corner.reshape(-1) != ends[:, 0]
        sides[swap] = sides[swap][:, ::-1]
        _, edge = np.unique(ends, axis=0, return_inverse=True)
        owner = np.repeat(face, 3)
        edge = edge.reshape(-1)
        along = sides[:, 1] - sides[:, 0]
        size = np.linalg.norm(along, axis=1)
        good = (ends[:, 0] != ends[:, 1]) & (size > NEAREST_M)
        along = along / np.where(good, size, 1.0)[:, None]
        inward = opposite - sides[:, 0]
        inward = inward - (inward * along).sum(axis=1)[:, None] * along
        width = np.linalg.norm(inward, axis=1)
        good &= width > 1e-9
        inward = inward / np.where(good, width, 1.0)[:, None]
        order = np.flatnonzero(good)[np.argsort(edge[good], kind="stable")]
        level = np.abs(surfaces.faces.normal[owner, 2]) > 0.99
        outer = np.array([corners.min(axis=(0, 1)), corners.max(axis=(0, 1))])[:, :2]
        rim = (np.abs(sides[:, None, :, :2] - outer[None, :, None]) < WELD_M).all(axis=2).any(axis=(1, 2)) & level
        runs = np.split(order, np.flatnonzero(np.diff(edge[order])) + 1) if len(order) else []
        rows = [
            row
            for run in runs
            if not (len(run) == 1 and rim[run[0]]) and (row := _widest(run, along[run[0]], inward, owner)) is not None
        ]
        first = np.array([row[0] for row in rows], dtype=np.int64)
        last = np.array([row[1] for row in rows], dtype=np.int64)
        angle = np.array([row[2] for row in rows])
        axis = inward[first]
        # out of face 0, into the air: across the edge, turned by a quarter from the axis towards the widest gap
        out = np.cross(along[first], axis)
        axis_n = np.where((angle < 2.0 * np.pi)[:, None], inward[last], axis)
        return cls(
            start_m=sides[first, 0],
            end_m=sides[first, 1],
            along=along[first],
            face_axis=axis,
            normal=out,
            normal_n=np.cross(axis_n, along[first]),
            exterior=angle / np.pi,
            face=np.stack([owner[first], owner[last]], axis=1),
        )

    def pairs(self) -> tuple[IntArray, IntArray]:
        """Pairs (pairs, 2) of edges of one plane face, and which of their faces (0 or 1) that is."""
        face, side = self.face.reshape(-1), np.tile([0, 1], len(self))
        edge = np.repeat(np.arange(len(self)), 2)
        order = np.argsort(face, kind="stable")
        pieces: list[IntArray] = [np.zeros((0, 4), np.int64)]
        for run in np.split(order, np.flatnonzero(np.diff(face[order])) + 1) if len(order) else []:
            first, second = (part.reshape(-1) for part in np.meshgrid(run, run, indexing="ij"))
            apart = edge[first] != edge[second]
            pieces.append(np.column_stack([edge[first], edge[second], side[first], side[second]])[apart])
        rows = np.concatenate(pieces)
        return rows[:, :2], rows[:, 2:]


def _widest(run: IntArray, along: FloatArray, inward: FloatArray, owner: IntArray) -> tuple[int, int, float] | None:
    """Sides of triangles on both ends of the widest gap round an edge, and its angle; None where no air bends there."""
    axis = inward[run[0]]
    across = np.cross(along, axis)
    angle = np.mod(np.arctan2(inward[run] @ across, inward[run] @ axis), 2.0 * np.pi)
    order = np.argsort(angle, kind="stable")
    gap = np.diff(angle[order], append=angle[order[0]] + 2.0 * np.pi)
    widest = int(np.argmax(gap))
    first, last = run[order[widest]], run[order[(widest + 1) % len(run)]]
    if gap[widest] < np.pi + _BEND_RAD or (len(run) > 1 and owner[first] == owner[last]):
        return None
    return int(first), int(last), float(gap[widest])


def _of_solid(faces: Faces, solid: int, ground_m: float) -> list[tuple[FloatArray, FloatArray, tuple[int, int]]]:
    """Start, end and faces of each edge, so that the outward normal of face 0 and the direction are as in Edges."""
    members = np.flatnonzero(faces.solid == solid)
    walls = [int(i) for i in members if faces.normal[i, 2] == 0.0]
    roofs = {float(faces.offset_m[i]): int(i) for i in members if faces.normal[i, 2] == 1.0}
    rows: list[tuple[FloatArray, FloatArray, tuple[int, int]]] = []
    first = {_corner(faces, wall, 0): wall for wall in walls}
    for wall in walls:
        top = faces.upper[wall, 1]
        near, far = (_point(faces, wall, end, top) for end in (0, 1))
        if top in roofs and top > ground_m:
            # t lies in the wall, pointing down: t x normal points along the wall
            rows.append((far, near, (wall, roofs[top])))
        following = first.get(_corner(faces, wall, 1))
        low = max(float(faces.lower[wall, 1]), ground_m)
        if following is None or top <= low:
            continue
        if np.cross(faces.along[wall], faces.along[following])[2] > np.sin(_SHARPEST):
            # t lies in the wall, away from the corner
            rows.append((_point(faces, wall, 1, low), _point(faces, wall, 1, top), (wall, following)))
    return rows


def _point(faces: Faces, wall: int, end: int, height_m: float) -> FloatArray:
    """Point of a wall's first or last upright at a height."""
    at = (faces.lower, faces.upper)[end][wall, 0]
    return np.asarray(faces.normal[wall] * faces.offset_m[wall] + at * faces.along[wall] + [0.0, 0.0, height_m])


def _corner(faces: Faces, wall: int, end: int) -> tuple[float, float]:
    """Corner of the footprint, to the tenth of a millimetre, as a key."""
    point = _point(faces, wall, end, 0.0)
    return round(float(point[0]), 4), round(float(point[1]), 4)


@dataclass(frozen=True, slots=True)
class EdgePaths(Rows):
    """Paths over one or two edges, sorted by pose and tower.

    Parameters
    ----------
    pose, tower : (paths,) int
    edge : (paths, 2) int
        The second is -1 over one edge.
    shared : (paths, 2) int
        Which face of each of two edges the path runs along between them: 0, or 1 for face n.
    ground : (paths, 2) int
        Faces that reflect before and after the edges, the ground as a rule; -1 where none does.
    vertices_m : (paths, 4, 3)
        Reflection, edge, edge, reflection point for array centres; NaN where unused.
    """

    pose: IntArray
    tower: IntArray
    edge: IntArray
    shared: IntArray
    ground: IntArray
    vertices_m: FloatArray

    def __len__(self) -> int:
        return len(self.pose)

    @classmethod
    def of(cls, index: IntArray, vertices_m: FloatArray) -> EdgePaths:
        """Paths of rows (paths, 8): pose, tower, edges, shared faces, mirrors."""
        return cls(
            pose=index[:, 0],
            tower=index[:, 1],
            edge=index[:, 2:4],
            shared=index[:, 4:6],
            ground=index[:, 6:8],
            vertices_m=vertices_m,
        )

    def as_path_set(self) -> PathSet:
        """The same polylines without faces: what terrain and foliage ask for."""
        used = np.isfinite(self.vertices_m).all(axis=2)
        first = np.argsort(~used, axis=1, kind="stable")
        vertices = np.take_along_axis(self.vertices_m, first[..., None], axis=1)
        nothing = np.full(self.vertices_m.shape[:2], -1, dtype=np.int64)
        return PathSet(self.pose, self.tower, used.sum(axis=1), nothing, vertices)
