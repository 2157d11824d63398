"""Paths that pass straight through walls and roofs: those that hiding solids would stop.

A building is a shell of slabs. Each path of the image method without hiding is cut with the faces on its way; what it
crosses are steps of the path between its reflections. A slab moves no ray: only its transmission counts
(:func:`aerpaw_cmp.propagation.field.fresnel.passing`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ...common.units import AnyArray, FloatArray, IntArray
from ...site.materials import face_material
from ..faces import inside
from ..field.fresnel import THROUGH
from ..paths import Faces, Links, PathSet, joined
from . import mirror

# A path through more is left out.
MOST_WALLS = 8

# A leg that ends this near to a plane does not cross it.
NEAR_M = 1e-6

LEGS_AT_ONCE = 4_000


@dataclass(frozen=True, slots=True)
class ThroughWalls:
    """Paths through walls.

    Parameters
    ----------
    paths : PathSet
        Their steps are reflections and crossings in order; ``depth`` counts both.
    faces : Faces
        Those of the scene, then the same as slabs that a path passes.
    """

    paths: PathSet
    faces: Faces

    def reflections(self) -> PathSet:
        """The same polylines, whose depth counts reflections alone and which name no face."""
        passed = self.paths.faces >= len(self.faces) // 2
        return replace(
            self.paths,
            depth=self.paths.depth - passed.sum(axis=1),
            faces=np.full_like(self.paths.faces, -1),
        )

    def of_link(self, pose: int, tower: int) -> bool:
        """Check whether a link has such a path."""
        return bool(((self.paths.pose == pose) & (self.paths.tower == tower)).any())

    def select(self, rows: AnyArray) -> ThroughWalls:
        """The paths of a mask or of indices."""
        return replace(self, paths=self.paths.select(rows))


def paths_through(faces: Faces, links: Links, max_depth: int) -> ThroughWalls:
    """All paths of at most ``max_depth`` reflections that cross walls or roofs.

    Parameters
    ----------
    faces : Faces
        Solids and ground planes.
    links : Links
    max_depth : int
        Most reflections; crossings do not count.

    Returns
    -------
    ThroughWalls
        Without paths through half-spaces, or through more than :data:`MOST_WALLS` faces.
    """
    open_ = mirror.find_paths(faces, links, max_depth=max_depth, hidden=False)
    rows, faces_, points = _crossings(faces, links, open_)
    slabs = replace(
        faces,
        material=tuple(THROUGH + name for name in faces.material),
        label=tuple(THROUGH + name for name in faces.label),
        solid=np.full(len(faces), -1),  # they hide nothing
    )
    width = max_depth + MOST_WALLS
    sequence = np.full((len(rows), width), -1, dtype=np.int64)
    vertices = np.full((len(rows), width, 3), np.nan)
    sequence[:, : faces_.shape[1]], vertices[:, : faces_.shape[1]] = faces_, points
    paths = PathSet(open_.pose[rows], open_.tower[rows], (faces_ >= 0).sum(axis=1), sequence, vertices)
    return ThroughWalls(paths, joined(faces, slabs))


def _crossings(faces: Faces, links: Links, paths: PathSet) -> tuple[IntArray, IntArray, FloatArray]:
    """Paths that cross faces; faces (paths, steps) of their steps, crossed ones from ``len(faces)`` on; points."""
    slab = np.array([face_material(name).thickness_m is not None for name in faces.material], dtype=np.bool_)
    walls = np.flatnonzero(faces.solid >= 0)
    used = np.arange(paths.vertices_m.shape[1]) < paths.depth[:, None]
    target = links.targets_m[paths.pose]
    points = np.where(used[..., None], paths.vertices_m, target[:, None])
    corners = np.concatenate([links.sources_m[paths.tower][:, None], points, target[:, None]], axis=1)
    # a crossing is a row: path, its place along the path (leg + share), face, point
    pieces: list[tuple[IntArray, FloatArray, IntArray, FloatArray]] = []
    for leg in range(corners.shape[1] - 1):
        for first in range(0, len(paths), LEGS_AT_ONCE):
            start, end = (corners[first : first + LEGS_AT_ONCE, leg + k] for k in (0, 1))
            before = start @ faces.normal[walls].T - faces.offset_m[walls]
            after = end @ faces.normal[walls].T - faces.offset_m[walls]
            row, wall = np.nonzero((before * after < 0.0) & (np.minimum(np.abs(before), np.abs(after)) > NEAR_M))
            share = before[row, wall] / (before[row, wall] - after[row, wall])
            point = start[row] + share[:, None] * (end - start)[row]
            good = inside(faces, walls[wall], point, 0.0)
            pieces.append((first + row[good], leg + share[good], walls[wall[good]], point[good]))
    path, place, face, point = (np.concatenate(x) for x in zip(*pieces, strict=True))
    # a shell is entered as often as it is left; a ray through an edge of it is none that counts
    solids, solid = np.unique(faces.solid[face], return_inverse=True)
    times = np.zeros((len(paths), max(len(solids), 1)), dtype=np.int64)
    np.add.at(times, (path, solid), 1)
    good = (times % 2 == 0).all(axis=1) & (times.sum(axis=1) > 0) & (times.sum(axis=1) <= MOST_WALLS)
    good[path[~slab[face]]] = False
    rows = np.flatnonzero(good)
    step = np.flatnonzero(good[path])
    bounce, slot = np.nonzero(used & good[:, None])
    owner = np.concatenate([path[step], bounce])
    order = np.lexsort((np.concatenate([place[step], slot + 1.0]), owner))
    what = np.concatenate([face[step] + len(faces), paths.faces[bounce, slot]])[order]
    where = np.concatenate([point[step], paths.vertices_m[bounce, slot]])[order]
    owner = np.searchsorted(rows, owner[order])
    column = np.arange(len(owner)) - np.searchsorted(owner, owner)
    deepest = int(column.max(initial=-1)) + 1
    sequence = np.full((len(rows), deepest), -1, dtype=np.int64)
    vertices = np.full((len(rows), deepest, 3), np.nan)
    sequence[owner, column], vertices[owner, column] = what, where
    return rows, sequence, vertices
