"""One path record for every engine, as columns.

A path is an ordered list of reflecting faces between the source (tower) and the target (UAV). Lengths, phases
and fields are not stored: :mod:`aerpaw_cmp.replay.field` evaluates them in float64 from the faces.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..units import FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class Faces:
    """Planar reflecting faces of a scene.

    Parameters
    ----------
    normal : (faces, 3)
        Outward unit normal.
    offset_m : (faces,)
        ``normal . x = offset_m`` on the face.
    material : tuple of str, length faces
        Names in ``site.materials``.
    label : tuple of str, length faces
        For reports, e.g. ``"ground"``, ``"barn wall 3"``.
    """

    normal: FloatArray
    offset_m: FloatArray
    material: tuple[str, ...]
    label: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class PathSet:
    """All paths of a replay, sorted by pose, tower, depth, faces.

    Parameters
    ----------
    pose, tower : (paths,) int
        Index of pose and tower.
    depth : (paths,) int
        Number of reflections; 0 is the line of sight.
    faces : (paths, max_depth) int
        Face indices from tower to UAV, -1 where unused.
    vertices_m : (paths, max_depth, 3)
        Reflection points for array centres, NaN where unused.
    """

    pose: IntArray
    tower: IntArray
    depth: IntArray
    faces: IntArray
    vertices_m: FloatArray

    def __len__(self) -> int:
        return len(self.pose)

    @classmethod
    def empty(cls, max_depth: int) -> PathSet:
        """No path at all."""
        zero = np.zeros(0, dtype=np.int64)
        return cls(zero, zero, zero, np.zeros((0, max_depth), dtype=np.int64), np.zeros((0, max_depth, 3)))
