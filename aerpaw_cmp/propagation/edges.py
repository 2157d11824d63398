"""Edges of buildings that diffract, and the record of paths over one of them.

An edge is where two faces of a building meet at an exterior angle above 180 degrees: the rim of a flat roof and its
upright corners.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from ..common.units import AnyArray, FloatArray, IntArray
from .paths import Faces, PathSet

SHARPEST = 1e-6
"""Exterior angles nearer than this to 180 degrees [rad] are a plane."""


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

    def coordinates(self, points_m: FloatArray, edge: IntArray) -> FloatArray:
        """Points (n, points, 3) in the frames of edges (n,): along, in face 0 away from the edge, out of face 0."""
        frame = np.stack([self.along[edge], self.face_axis[edge], self.normal[edge]], axis=1)
        return np.asarray(np.einsum("nij,npj->npi", frame, points_m - self.start_m[edge][:, None]))


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
        if np.cross(faces.along[wall], faces.along[following])[2] > np.sin(SHARPEST):
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
class EdgePaths:
    """Paths over one edge, sorted by pose and tower.

    Parameters
    ----------
    pose, tower, edge : (paths,) int
    ground : (paths, 2) int
        Faces that reflect before and after the edge, the ground as a rule; -1 where none does.
    vertices_m : (paths, 3, 3)
        Reflection, edge, reflection point for array centres; NaN where unused.
    """

    pose: IntArray
    tower: IntArray
    edge: IntArray
    ground: IntArray
    vertices_m: FloatArray

    def __len__(self) -> int:
        return len(self.pose)

    def as_path_set(self) -> PathSet:
        """The same polylines without faces: what terrain and foliage ask for."""
        used = np.isfinite(self.vertices_m).all(axis=2)
        first = np.argsort(~used, axis=1, kind="stable")
        vertices = np.take_along_axis(self.vertices_m, first[..., None], axis=1)
        nothing = np.full(self.vertices_m.shape[:2], -1, dtype=np.int64)
        return PathSet(self.pose, self.tower, used.sum(axis=1), nothing, vertices)

    def select(self, rows: AnyArray) -> EdgePaths:
        """The paths of a mask or of indices."""
        return EdgePaths(**{f.name: getattr(self, f.name)[rows] for f in fields(self)})
