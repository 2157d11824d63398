"""Faces of a scene, and one path record for every engine, as columns.

A path is an ordered list of reflecting faces between the source (tower) and the target (UAV). Lengths, phases
and fields are not stored: :mod:`aerpaw_cmp.propagation.field.sum` evaluates them in float64 from the faces.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields
from itertools import pairwise
from typing import Any, NamedTuple, TypeVar

import numpy as np
from shapely.geometry import Polygon

from ...common.units import AnyArray, BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class Links:
    """Ends of the links whose paths are searched.

    Parameters
    ----------
    sources_m : (towers, 3)
    targets_m : (poses, 3)
        NaN positions have no path.
    usable : (towers, faces) bool, optional
        Faces that may reflect for each tower (default: all). All faces hide.
    excluded : (towers, poses) bool, optional
        Links without any path, e.g. poses inside buildings.
    """

    sources_m: FloatArray
    targets_m: FloatArray
    usable: BoolArray | None = None
    excluded: BoolArray | None = None


_ARRAYS = ("normal", "offset_m", "along", "across", "lower", "upper", "solid")
# Columns of faces: arrays, and tuples.
_WORDS = ("material", "label", "polygon")


@dataclass(frozen=True, slots=True)
class Faces:
    """Planar reflecting faces of a scene.

    A point ``x`` on a face has the in-plane coordinates ``(along . x, across . x)`` [m]. Only the first four
    columns decide fields; the others decide which points belong to a face. Left out, faces are whole planes.

    Parameters
    ----------
    normal : (faces, 3)
        Outward unit normal.
    offset_m : (faces,)
        ``normal . x = offset_m`` on the face.
    material : tuple of str, length faces
        Names that :func:`aerpaw_cmp.site.materials.material` knows.
    label : tuple of str, length faces
        For reports, e.g. ``"ground"``, ``"barn wall 3"``.
    along, across : (faces, 3)
        In-plane unit axes, ``along x across = normal``.
    lower, upper : (faces, 2)
        Bounds of the in-plane coordinates; infinite for the ground.
    polygon : tuple of Polygon or None, length faces
        The face in its plane, where it does not fill its bounds.
    solid : (faces,) int
        Index of the building, -1 for the ground, which never hides anything.
    """

    normal: FloatArray
    offset_m: FloatArray
    material: tuple[str, ...]
    label: tuple[str, ...]
    along: FloatArray = field(default_factory=lambda: np.zeros(0))
    across: FloatArray = field(default_factory=lambda: np.zeros(0))
    lower: FloatArray = field(default_factory=lambda: np.zeros(0))
    upper: FloatArray = field(default_factory=lambda: np.zeros(0))
    polygon: tuple[Polygon | None, ...] = ()
    solid: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    def __post_init__(self) -> None:
        count = len(self.normal)
        if self.along.shape == (count, 3):
            return
        # any axis that is not the normal will do for a whole plane
        # the axis least along the normal: a product with one nearly along it would lose digits
        helper = np.eye(3)[np.argmin(np.abs(self.normal), axis=1)] if count else np.zeros((0, 3))
        along = np.cross(helper, self.normal)
        along = along / np.linalg.norm(along, axis=1, keepdims=True)
        object.__setattr__(self, "along", along)
        object.__setattr__(self, "across", np.cross(self.normal, along))
        object.__setattr__(self, "lower", np.full((count, 2), -np.inf))
        object.__setattr__(self, "upper", np.full((count, 2), np.inf))
        object.__setattr__(self, "polygon", (None,) * count)
        object.__setattr__(self, "solid", np.full(count, -1, dtype=np.int64))

    def __len__(self) -> int:
        return len(self.normal)

    def height_m(self, face: int, points_m: FloatArray) -> FloatArray:
        """Heights (...) of points (..., 3) in front of the plane of one face."""
        return np.asarray(points_m @ self.normal[face] - self.offset_m[face])

    def mirrored(self, face: int, points_m: FloatArray) -> FloatArray:
        """Images of points (..., 3) in the plane of one face."""
        return np.asarray(points_m - 2.0 * self.height_m(face, points_m)[..., None] * self.normal[face])

    def select(self, rows: IntArray) -> Faces:
        """Some of the faces."""
        columns: dict[str, Any] = {name: tuple(getattr(self, name)[row] for row in rows) for name in _WORDS}
        columns |= {name: getattr(self, name)[rows] for name in _ARRAYS}
        return Faces(**columns)


def joined(first: Faces, second: Faces) -> Faces:
    """The faces of both, the first keeping their numbers."""
    columns: dict[str, Any] = {name: getattr(first, name) + getattr(second, name) for name in _WORDS}
    columns |= {name: np.concatenate([getattr(first, name), getattr(second, name)]) for name in _ARRAYS}
    return Faces(**columns)


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


RowsT = TypeVar("RowsT", bound="Rows")


class Rows:
    """Columns of one length: the base of records that hold a path, or a path over edges, a row."""

    __slots__ = ()
    pose: IntArray
    tower: IntArray

    def select(self: RowsT, rows: AnyArray | slice) -> RowsT:
        """The paths of a mask, of indices or of a slice."""
        return type(self)(**{column.name: getattr(self, column.name)[rows] for column in fields(self)})  # type: ignore[arg-type]

    @classmethod
    def one_after_another(cls: type[RowsT], pieces: Sequence[RowsT]) -> RowsT:
        """The paths of all pieces, one at least, as they come; nothing is sorted."""
        names = [column.name for column in fields(cls)]  # type: ignore[arg-type]
        return cls(**{name: np.concatenate([getattr(piece, name) for piece in pieces]) for name in names})


@dataclass(frozen=True, slots=True)
class PathSet(Rows):
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
    terrain_db : (paths,)
        Loss at ground that is curved within the Fresnel zone; left out, none.
    """

    pose: IntArray
    tower: IntArray
    depth: IntArray
    faces: IntArray
    vertices_m: FloatArray
    terrain_db: FloatArray = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        # frozen, so the default of the right length is set behind its back
        if len(self.terrain_db) != len(self.pose):
            object.__setattr__(self, "terrain_db", np.zeros(len(self.pose)))

    def __len__(self) -> int:
        return len(self.pose)

    def lines(self) -> PathSet:
        """The paths as polylines: themselves."""
        return self

    @property
    def touched(self) -> IntArray:
        """Faces (paths, max_depth) from tower to UAV, -1 where unused."""
        return self.faces

    @property
    def turns(self) -> IntArray:
        """A digit 1 for each reflection (paths,)."""
        # 1, 11, 111
        return np.asarray((10**self.depth - 1) // 9)

    @classmethod
    def from_tower(cls, tower: int, pose: IntArray, faces: IntArray, vertices_m: FloatArray, max_depth: int) -> PathSet:
        """Paths of one tower over sequences (paths, depth), padded to ``max_depth``; -1 is no face.

        Parameters
        ----------
        tower : int
        pose : (paths,) int
        faces : (paths, depth) int
            From tower to UAV.
        vertices_m : (paths, depth, 3)
            Reflection points [m]; those without a face do not count.
        max_depth : int

        Returns
        -------
        PathSet
            In the order given.
        """
        sequence = np.full((len(pose), max_depth), -1, dtype=np.int64)
        points = np.full((len(pose), max_depth, 3), np.nan)
        depth = faces.shape[1]
        sequence[:, :depth] = faces
        # a sequence may end early: what stands behind its last face is no point
        points[:, :depth] = np.where((faces >= 0)[..., None], vertices_m, np.nan)
        return cls(pose, np.full(len(pose), tower), (sequence >= 0).sum(axis=1), sequence, points)

    @classmethod
    def empty(cls, max_depth: int) -> PathSet:
        """No path at all."""
        zero = np.zeros(0, dtype=np.int64)
        return cls(zero, zero, zero, np.zeros((0, max_depth), dtype=np.int64), np.zeros((0, max_depth, 3)))


def sources_of(paths: Rows, sources_m: FloatArray) -> FloatArray:
    """Sources (paths, 3) of paths, of places (towers, 3), or (poses, towers, 3) of towers that move."""
    return np.asarray(sources_m[paths.tower] if sources_m.ndim == 2 else sources_m[paths.pose, paths.tower])


def legs(source_m: FloatArray, vertices_m: FloatArray, target_m: FloatArray) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Starts and ends (paths, 3) of the legs of polylines, leg by leg.

    A vertex (paths, vertices, 3) that is not used (NaN) is the point after it: a leg that begins there has no length.
    """
    # backwards: a corner that is not used takes the place of the one after it
    points = [target_m]
    for step in reversed(range(vertices_m.shape[1])):
        vertex = vertices_m[:, step]
        points.append(np.where(np.isfinite(vertex), vertex, points[-1]))
    return pairwise([np.broadcast_to(source_m, target_m.shape), *reversed(points)])


def path_lengths(paths: PathSet, sources_m: FloatArray, targets_m: FloatArray) -> FloatArray:
    """Length of each path along its reflection points.

    Parameters
    ----------
    paths : PathSet
    sources_m, targets_m : (towers, 3), (poses, 3)

    Returns
    -------
    (paths,) [m]
    """
    total = np.zeros(len(paths))
    for start, end in legs(sources_m[paths.tower], paths.vertices_m, targets_m[paths.pose]):
        total += np.linalg.norm(end - start, axis=1)
    return total
