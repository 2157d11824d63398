"""Open, two-sided surfaces of a scene made of triangles: planar faces, and the trees that a search walks.

Nothing is assumed about solids: a face reflects on both sides and hides from both. What hides are the triangles
themselves, which may lie a merge tolerance off the plane of their face.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..common.units import BoolArray, FloatArray, IntArray
from .paths import Faces


class BoxTree(NamedTuple):
    """A tree of boxes as columns.

    ``lower``, ``upper`` (nodes, 3) are bounds, ``child`` (nodes,) the first of two children or -1; leaves hold
    ``many`` of the ``items`` from ``start`` on.
    """

    lower: FloatArray
    upper: FloatArray
    child: IntArray
    start: IntArray
    many: IntArray
    items: IntArray


@dataclass(frozen=True, slots=True)
class Surfaces:
    """Faces of a triangle scene.

    Parameters
    ----------
    faces : Faces
        Planes, materials and labels; ``solid`` is the shape. Their polygons are the triangles below.
    corners_m : (triangles, 3, 3)
        Corners of every triangle as the file has it.
    face : (triangles,) int
        Face of each triangle; triangles of a face follow each other.
    first : (faces + 1,) int
        Where the triangles of each face begin.
    flat_m : (triangles, 3, 2)
        Corners in the axes of their face.
    window_m : (faces, 8, 3)
        Convex outline of each face, in its plane; the last corner is repeated.
    convex : (faces,) bool
        Faces that fill their outline.
    area_m2 : (faces,)
    plane : (faces,) int
        Faces of one number lie in one plane.
    tree, face_tree : BoxTree
        Over triangles and over faces.
    notes : tuple of str
        What was repaired.
    """

    faces: Faces
    corners_m: FloatArray
    face: IntArray
    first: IntArray
    flat_m: FloatArray
    window_m: FloatArray
    convex: BoolArray
    area_m2: FloatArray
    plane: IntArray
    tree: BoxTree
    face_tree: BoxTree
    merge_m: float
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.faces)

    def mesh(self) -> tuple[FloatArray, IntArray, IntArray]:
        """Vertices (n, 3), triangles (m, 3) and the face of each triangle, as the file has them."""
        count = len(self.corners_m)
        return self.corners_m.reshape(-1, 3), np.arange(3 * count, dtype=np.int64).reshape(-1, 3), self.face
