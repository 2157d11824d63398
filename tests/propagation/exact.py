"""Paths between integer points among integer boxes, in rational arithmetic: no tolerance anywhere.

A box is (east low, east high, north low, north high, top), from below the ground to its top. What is there is the inside
of the union of the closed boxes: it blocks. A path is a tuple of planes (axis, sense, value). Coordinates are
:class:`fractions.Fraction`; nothing here is used by the package.
"""

import itertools
from fractions import Fraction

import numpy as np

GROUND = (2, 1, 0)


def faces_of(boxes):
    """Return [(plane, bounds)] with bounds {other axis: (low, high)}, which are empty for the ground."""
    faces = [(GROUND, {})]
    for west, east, south, north, top in boxes:
        upright = {2: (None, top)}
        faces += [
            ((0, -1, west), {1: (south, north), **upright}),
            ((0, 1, east), {1: (south, north), **upright}),
            ((1, -1, south), {0: (west, east), **upright}),
            ((1, 1, north), {0: (west, east), **upright}),
            ((2, 1, top), {0: (west, east), 1: (south, north)}),
        ]
    return faces


def _height(plane, point):
    axis, sense, value = plane
    return sense * (point[axis] - value)


def _mirrored(plane, point):
    axis, _, value = plane
    return tuple(2 * value - x if k == axis else x for k, x in enumerate(point))


def _between(bounds, point):
    return all((low is None or low <= point[k]) and point[k] <= high for k, (low, high) in bounds.items())


def paths(boxes, source, target, max_depth=2):
    """Set of the paths between two integer points that are not the same."""
    faces = faces_of(boxes)
    sequences = set()
    if not blocked(boxes, source, target):
        sequences.add(())
    for depth in range(1, max_depth + 1):
        for sequence in itertools.product(range(len(faces)), repeat=depth):
            points = _points([faces[k] for k in sequence], source, target)
            if points and not any(blocked(boxes, a, b) for a, b in itertools.pairwise(points)):
                sequences.add(tuple(faces[k][0] for k in sequence))
    return sequences


def _points(sequence, source, target):
    """[source, reflection points, target], or None where the sequence has no path."""
    if _height(sequence[-1][0], target) < 0 or _height(sequence[0][0], source) < 0:
        return None
    images = [source]
    for step, (plane, _) in enumerate(sequence):
        if step and _height(plane, images[-1]) <= 0:
            return None
        images.append(_mirrored(plane, images[-1]))
    points = [target]
    for step in range(len(sequence) - 1, -1, -1):
        plane, bounds = sequence[step]
        image, point = images[step + 1], points[0]
        ahead, behind = _height(plane, point), -_height(plane, image)
        if ahead < 0 or (ahead == 0 and point is not target) or ahead + behind == 0:
            return None  # only an end may lie on its face
        share = Fraction(behind, ahead + behind)
        met = tuple(i + share * (p - i) for i, p in zip(image, point, strict=True))
        if not _between(bounds, met):
            return None
        points.insert(0, met)
    return [source, *points]


def blocked(boxes, start, end):
    """Check whether the open segment meets the inside of the union of the closed boxes."""
    step = [e - s for s, e in zip(start, end, strict=True)]
    if not any(step):
        return False
    near = [
        b
        for b in boxes
        if min(start[2], end[2]) < b[4]
        and all(max(start[k], end[k]) >= b[2 * k] and min(start[k], end[k]) <= b[2 * k + 1] for k in (0, 1))
    ]
    cuts = {Fraction(0), Fraction(1)}
    for b in near:
        for k, value in ((0, b[0]), (0, b[1]), (1, b[2]), (1, b[3]), (2, b[4])):
            if step[k]:
                cuts.add(Fraction(value - start[k]) / step[k])
    shares = sorted(t for t in cuts if 0 <= t <= 1)
    return any(
        _inside(near, [s + (a + b) / 2 * d for s, d in zip(start, step, strict=True)])
        for a, b in itertools.pairwise(shares)
    )


def _inside(boxes, point):
    """Check whether each of the eight octants around a point belongs to a box near the point."""
    return all(any(_octant(b, point, signs) for b in boxes) for signs in itertools.product((-1, 1), repeat=3))


def _octant(b, point, signs):
    for k, (low, high) in enumerate(((b[0], b[1]), (b[2], b[3]), (None, b[4]))):
        if low is not None and (point[k] < low or (point[k] == low and signs[k] < 0)):
            return False
        if point[k] > high or (point[k] == high and signs[k] > 0):
            return False
    return True


def strictly_inside(b, point):
    return b[0] < point[0] < b[1] and b[2] < point[1] < b[3] and point[2] < b[4]


def random_scene(rng, boxes=3, half=6, poses=12):
    """Draw boxes with integer corners, and a source and targets on the same grid.

    Walls often touch, and ends often lie on faces.
    """
    solids = []
    for _ in range(boxes):
        west, south = (2 * rng.integers(-half // 2, half // 2, 2)).tolist()
        east, north = (low + 2 * int(rng.integers(1, 4)) for low in (west, south))
        solids.append((west, east, south, north, int(rng.integers(1, 5))))
    ends = []
    while len(ends) < poses + 1:
        point = (*rng.integers(-half - 3, half + 4, 2).tolist(), int(rng.integers(0 if ends else 1, 7)))
        if point not in ends and not any(strictly_inside(b, point) for b in solids):
            ends.append(point)
    return solids, ends[0], ends[1:]


def planes_found(paths_, faces, pose):
    """The same tuples from a replay's path set."""
    keys = set()
    for row in paths_.faces[paths_.pose == pose]:
        planes = []
        for face in row[row >= 0]:
            normal = faces.normal[face]
            axis = int(np.argmax(np.abs(normal)))
            sense = int(np.sign(normal[axis]))
            planes.append((axis, sense, round(float(sense * faces.offset_m[face]))))
        keys.add(tuple(planes))
    return keys
