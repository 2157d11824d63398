"""Thousands of prisms: candidates by compiled beams, decided by the exact rules of the image engine.

The beams of :mod:`aerpaw_cmp.propagation.search.beams` are cut with tolerances a thousand times wider than those that
decide, and a candidate is given up only where a segment runs through the middle of a wall or roof. What is left, hardly
more than the paths, is decided as in :mod:`aerpaw_cmp.propagation.search.mirror`, so both have the same paths.
"""

from __future__ import annotations

import numpy as np

from ...common.units import FloatArray
from ..geometry.faces import corners, triangles
from ..geometry.paths import Faces, Links, PathSet, Surfaces
from ..options import Run
from .beams import grow_paths
from .boxtree import box_tree
from .merging import WINDOW
from .mirror import images_of, merge, planes_of, scene_tolerance_m, trace_back
from .occlusion import Occlusion

# The ground is searched to this many times the largest coordinate: no reflection point lies further out.
REACH = 10.0

# Boxes of faces are this much larger [m].
OVERLAP_M = 1e-3


def find_paths(
    faces: Faces,
    links: Links,
    run: Run = Run(),
    *,
    max_depth: int = 2,
    extent_m: FloatArray | None = None,
) -> PathSet:
    """As :func:`aerpaw_cmp.propagation.search.mirror.find_paths`, for scenes with too many sequences for it.

    Parameters
    ----------
    faces, links, max_depth, extent_m
        As there.
    run : Run

    Returns
    -------
    PathSet
        Sorted by pose, tower, depth, faces.
    """
    sources_m, targets_m = links.sources_m, links.targets_m
    tolerance_m = scene_tolerance_m(faces, sources_m, targets_m if extent_m is None else extent_m)
    # candidates: too many rather than too few
    paths = grow_paths(solid_surfaces(faces, sources_m, targets_m), links, run, max_depth=max_depth, solids=True)
    hiding = Occlusion(faces, tolerance_m)
    pieces = []
    # of one depth at once: tracing back takes sequences of one length
    for depth in range(max_depth + 1):
        some = paths.select(paths.depth == depth)
        source, target = sources_m[some.tower], targets_m[some.pose]
        sequence = some.faces[:, :depth]
        vertices, good = trace_back(faces, sequence, images_of(faces, sequence, source), target, tolerance_m)
        rows = np.flatnonzero(good)
        rows = rows[~hiding.any_segment(source[rows], vertices[rows], target[rows])]
        some.vertices_m[:, :depth] = vertices
        pieces.append(some.select(rows))
    return merge(pieces, max_depth, faces)


def solid_surfaces(faces: Faces, sources_m: FloatArray, targets_m: FloatArray) -> Surfaces:
    """Faces of solids as the compiled search takes them; the ground, which hides nothing, is no obstacle."""
    known = targets_m[np.isfinite(targets_m).all(axis=1)]
    finite = [np.abs(x[np.isfinite(x)]).max(initial=0.0) for x in (faces.lower, faces.upper, faces.offset_m)]
    reach = REACH * float(max(1.0, *finite, *(np.abs(p).max(initial=0.0) for p in (known, sources_m))))
    vertices, triangle, owner = triangles(faces, reach)
    points = vertices[triangle]
    # a bounding quadrilateral, which for a roof with corners cut is larger than the roof: a cut may keep more
    outline = corners(faces, reach)
    axes = np.stack([faces.along[owner], faces.across[owner]], axis=1)
    flat = np.einsum("tki,tai->tka", points, axes)
    hides = faces.solid[owner] >= 0
    lower, upper = outline.min(axis=1) - OVERLAP_M, outline.max(axis=1) + OVERLAP_M
    obstacles = np.ascontiguousarray(points[hides])
    if not len(obstacles):
        obstacles = np.full((1, 3, 3), 1e9)  # nothing hides: one needle far below everything
    return Surfaces(
        faces=faces,
        corners_m=obstacles,
        face=owner,
        first=np.searchsorted(owner, np.arange(len(faces) + 1)),
        flat_m=np.ascontiguousarray(flat),
        window_m=np.ascontiguousarray(outline[:, np.minimum(np.arange(WINDOW), 3)]),
        # the ground hides nothing, and what has a polygon does not fill its outline
        convex=(faces.solid >= 0) & np.array([polygon is None for polygon in faces.polygon], dtype=np.bool_),
        plane=planes_of(faces),
        tree=box_tree(obstacles.min(axis=1), obstacles.max(axis=1)),
        face_tree=box_tree(lower, upper),
        merge_m=OVERLAP_M,
    )
