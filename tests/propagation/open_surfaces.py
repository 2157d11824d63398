"""Specular paths among open triangles by plain enumeration, independent of the engine, for small scenes.

Each triangle is a separate mirror in its own plane. Every sequence of triangles is tried, and every triangle is tested
for whether it cuts a segment. Paths are distinguished by their reflection points.
"""

import itertools
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from aerpaw_cmp.site.mitsuba import TriangleScene

CLEARANCE_M = 2e-3


def shipped(name: str) -> Path:
    """Return the path of a scene that the installed Sionna RT contains, without importing Sionna RT."""
    folder = find_spec("sionna").submodule_search_locations[0]
    path = Path(folder) / "rt" / "scenes" / name / f"{name}.xml"
    if not path.exists():
        pytest.skip("this Sionna RT ships no scenes")
    return path


def paths(corners, sources, targets, depth):
    """Sorted list of (tower, pose, points) with points a tuple of reflection points rounded to 5 mm cells."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    good = np.linalg.norm(normal, axis=1) > 2e-10
    corners, normal = corners[good], normal[good]
    normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    offset = (normal * corners[:, 0]).sum(axis=1)
    polylines = []
    for t, source in enumerate(sources):
        for length in range(depth + 1):
            for points, pose in _candidates(corners, normal, offset, source, targets, length):
                if not _cut(corners, normal, offset, source, points, targets[pose]):
                    polylines.append((t, pose, [p for p, _ in points]))
    return _distinct(polylines)


def _candidates(corners, normal, offset, source, targets, length):
    if length == 0:
        yield from (([], pose) for pose in range(len(targets)))
        return
    for head in itertools.product(range(len(normal)), repeat=length - 1):
        # all last mirrors and all targets at once
        image = source
        images = [source]
        for m in head:
            height = normal[m] @ image - offset[m]
            image = image - 2 * height * normal[m]
            images.append(image)
        height = normal @ image - offset
        last = image - 2 * height[:, None] * normal
        ahead = targets @ normal.T - offset  # (targets, mirrors)
        same = (ahead * height > 0) & (np.abs(height) > 1e-6) & (np.abs(ahead) > 1e-6)
        with np.errstate(divide="ignore", invalid="ignore"):
            share = height / (height + ahead)
        point = last + share[..., None] * (targets[:, None] - last)
        ok = same & _inside(corners, normal, point)
        for pose, m in np.argwhere(ok):
            chain = _back(corners, normal, offset, images, [*head, m], point[pose, m])
            if chain is not None:
                yield chain, int(pose)


def _back(corners, normal, offset, images, sequence, end):
    points = [(end, sequence[-1])]
    for step in range(len(sequence) - 2, -1, -1):
        m, point = sequence[step], points[0][0]
        low, top = normal[m] @ images[step] - offset[m], normal[m] @ point - offset[m]
        if low * top <= 0 or abs(low) < 1e-6 or abs(top) < 1e-6:
            return None
        new = images[step + 1] + low / (low + top) * (point - images[step + 1])
        if not _inside(corners[m : m + 1], normal[m : m + 1], new[None, None])[0, 0]:
            return None
        points.insert(0, (new, m))
    return points


def _inside(corners, normal, points):
    """(..., mirrors) whether points (..., mirrors, 3) lie in the triangles."""
    result = np.ones(points.shape[:-1], dtype=bool)
    for inward, least in _edges(corners.tobytes(), normal.tobytes()):
        result &= (points * inward).sum(axis=-1) >= least
    return result


@lru_cache(maxsize=4096)
def _edges(corners, normal):
    """Return, for each side, the inward unit vectors (mirrors, 3) and their smallest component at an inner point."""
    corners, normal = np.frombuffer(corners).reshape(-1, 3, 3), np.frombuffer(normal).reshape(-1, 3)
    sides = []
    for k in range(3):
        edge = corners[:, (k + 1) % 3] - corners[:, k]
        inward = np.cross(normal, edge) / np.linalg.norm(edge, axis=1, keepdims=True)
        sides.append((inward, (corners[:, k] * inward).sum(axis=-1) - 1e-6))
    return sides


def _cut(corners, normal, offset, source, points, target):
    ends = [(source, None), *points, (target, None)]
    for (a, first), (b, second) in itertools.pairwise(ends):
        before, after = normal @ a - offset, normal @ b - offset
        with np.errstate(divide="ignore", invalid="ignore"):
            share = before / (before - after)
        hit = (share > 0) & (share < 1) & np.isfinite(share)
        rows = np.flatnonzero(hit)
        at = a + share[rows, None] * (b - a)
        rows, at = (x[_inside(corners[rows], normal[rows], at)] for x in (rows, at))
        for end, mirror in ((a, first), (b, second)):
            near = (
                np.abs(at @ normal[mirror] - offset[mirror]) if mirror is not None else np.linalg.norm(at - end, axis=1)
            )
            at = at[near > (CLEARANCE_M if mirror is not None else 1e-3)]
        if len(at):
            return True
    return False


def _distinct(polylines):
    """One of paths whose points coincide within 5 mm."""
    distinct = {}
    for tower, pose, points in polylines:
        mine = distinct.setdefault((tower, pose, len(points)), [])
        if not any(all(np.abs(p - q).max() < 5e-3 for p, q in zip(points, other, strict=True)) for other in mine):
            mine.append(points)
    return distinct


def compare(ours, theirs):
    """(missing, extra) of a PathSet against what :func:`paths` found."""
    left = {key: list(value) for key, value in theirs.items()}
    extra = 0
    for row in range(len(ours)):
        depth = int(ours.depth[row])
        mine = ours.vertices_m[row, :depth]
        others = left.get((int(ours.tower[row]), int(ours.pose[row]), depth), [])
        for k, other in enumerate(others):
            if depth == 0 or np.abs(mine - np.array(other)).max() < 5e-3:
                del others[k]
                break
        else:
            extra += 1
    return sum(len(v) for v in left.values()), extra


def scene_of(corners, materials="concrete", shapes=None):
    """Triangles (n, 3, 3) as a scene, all of one shape or of the shapes given."""
    corners = np.asarray(corners, dtype=float)
    shapes = np.zeros(len(corners), np.int64) if shapes is None else np.asarray(shapes)
    count = int(shapes.max()) + 1
    return TriangleScene(
        corners.reshape(-1, 3),
        np.arange(3 * len(corners)).reshape(-1, 3),
        shapes,
        tuple(f"shape{k}" for k in range(count)),
        (materials,) * count,
    )
