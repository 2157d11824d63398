"""The test of face sequences pose by pose as compiled code; imported only where numba is there.

The decisions are those of :mod:`aerpaw_cmp.propagation.image` and :mod:`aerpaw_cmp.propagation.solids`, with the same
formulas and tolerances, in the same order. Two are left to them: a reflection point on a face that is no rectangle, and
a segment along several pieces of buildings that touch (:data:`POLYGON`, :data:`SEAM`).
"""

from __future__ import annotations

import inspect

import numpy as np
from numba import njit

from ..common.units import AnyArray, BoolArray, FloatArray, IntArray
from .numba_options import OPTIONS

POLYGON, SEAM = 1, 2
"""Flags of a path that is to be decided elsewhere: whether its points lie on their faces; whether a seam hides it."""


@njit(**OPTIONS)
def through_box(start: FloatArray, end: FloatArray, low: FloatArray, high: FloatArray) -> bool:
    """Whether a segment meets a box (slab test).

    Parameters
    ----------
    start, end : (3,)
        The segment [m].
    low, high : (3,)
        Corners of the box [m].

    Returns
    -------
    bool
    """
    enter, leave = 0.0, 1.0
    for step in range(3):
        axis = 2 - step  # most segments pass above the roofs
        move = end[axis] - start[axis]
        inverse = 1.0 / (move if move != 0.0 else 1e-300)
        at_low, at_high = (low[axis] - start[axis]) * inverse, (high[axis] - start[axis]) * inverse
        enter = max(enter, min(at_low, at_high))
        leave = min(leave, max(at_low, at_high))
        if enter > leave:
            return False
    return True


@njit(**OPTIONS)
def runs_inside(
    start: FloatArray, end: FloatArray, normal: FloatArray, offset_m: FloatArray, first: int, last: int, level: float
) -> bool:
    """Whether a part of a segment lies below ``level`` over all planes ``first`` to ``last`` (Cyrus and Beck, 1978).

    Parameters
    ----------
    start, end : (3,)
        The segment [m].
    normal, offset_m : (planes, 3), (planes,)
        Planes of all solids, normals outwards.
    first, last : int
        Those that count: from ``first`` to before ``last``.
    level : float
        Height over the planes [m]: below 0 the segment has to run deeper than the surface.

    Returns
    -------
    bool
    """
    enter, leave = 0.0, 1.0
    for plane in range(first, last):
        n0, n1, n2 = normal[plane, 0], normal[plane, 1], normal[plane, 2]
        before = n0 * start[0] + n1 * start[1] + n2 * start[2] - offset_m[plane]
        after = n0 * end[0] + n1 * end[1] + n2 * end[2] - offset_m[plane]
        if before >= level and after >= level:
            return False
        slope = after - before
        if slope < 0.0:
            enter = max(enter, (level - before) / slope)
        elif slope > 0.0:
            leave = min(leave, (level - before) / slope)
        if enter >= leave:
            return False
    return True


@njit(**OPTIONS)
def hides(
    start: FloatArray,
    end: FloatArray,
    low_m: FloatArray,
    high_m: FloatArray,
    pieces: IntArray,
    planes: IntArray,
    normal: FloatArray,
    offset_m: FloatArray,
    abutting: BoolArray,
    tolerance_m: float,
) -> int:
    """1 where a solid cuts the segment, ``SEAM`` where it runs along several pieces that touch, else 0.

    Parameters
    ----------
    start, end : (3,)
        The segment [m].
    low_m, high_m : (solids, 3)
        Their boxes [m].
    pieces : (solids + 1,) int
        Which convex pieces are whose.
    planes : (pieces + 1,) int
        Which planes are whose.
    normal, offset_m : (planes, 3), (planes,)
        Planes of the pieces, normals outwards [m].
    abutting : (pieces,) bool
        Pieces that touch another one.
    tolerance_m : float
        A segment this deep in a solid is still on its surface [m].

    Returns
    -------
    int
    """
    touches = 0
    for solid in range(len(low_m)):
        if not through_box(start, end, low_m[solid], high_m[solid]):
            continue
        for piece in range(pieces[solid], pieces[solid + 1]):
            if runs_inside(start, end, normal, offset_m, planes[piece], planes[piece + 1], -tolerance_m):
                return 1
            if abutting[piece] and runs_inside(
                start, end, normal, offset_m, planes[piece], planes[piece + 1], tolerance_m
            ):
                touches += 1
    return SEAM if touches > 1 else 0


@njit(**OPTIONS)
def trace(
    target: FloatArray,
    row: int,
    depth: int,
    sequences: IntArray,
    images_m: FloatArray,
    planes: FloatArray,
    tolerance_m: float,
    vertices: FloatArray,
) -> bool:
    """Reflection points of a sequence, from the target back to the source; whether sides and bounds allow them.

    ``planes`` (faces, 14) holds normal, offset, along, across, and the bounds with their tolerance.

    Parameters
    ----------
    target : (3,)
        [m]
    row, depth : int
        Which sequence, and its length.
    sequences : (sequences, most) int
        Faces, -1 beyond the depth.
    images_m : (sequences, most, 3)
        Image of the source behind each face [m].
    planes : (faces, 14)
        See above.
    tolerance_m : float
        A point this far behind a face still counts as before it [m].
    vertices : (most, 3)
        Gets the points [m].

    Returns
    -------
    bool
    """
    x, y, z = target[0], target[1], target[2]
    for back in range(depth):
        step = depth - 1 - back
        f = np.uint64(sequences[row, step])
        n0, n1, n2, offset = planes[f, 0], planes[f, 1], planes[f, 2], planes[f, 3]
        i0, i1, i2 = images_m[row, step, 0], images_m[row, step, 1], images_m[row, step, 2]
        ahead = n0 * x + n1 * y + n2 * z - offset
        behind = offset - (n0 * i0 + n1 * i1 + n2 * i2)
        # an end may lie on its face, the other reflection points lie before it
        if not (ahead >= -tolerance_m if back == 0 else ahead > tolerance_m):
            return False
        if not (behind >= -tolerance_m if step == 0 else behind > 0.0) or not ahead + behind > tolerance_m:
            return False
        share = behind / (behind + ahead)
        x, y, z = i0 + share * (x - i0), i1 + share * (y - i1), i2 + share * (z - i2)
        a = planes[f, 4] * x + planes[f, 5] * y + planes[f, 6] * z
        b = planes[f, 7] * x + planes[f, 8] * y + planes[f, 9] * z
        if not (planes[f, 10] <= a <= planes[f, 11] and planes[f, 12] <= b <= planes[f, 13]):
            return False
        vertices[step, 0], vertices[step, 1], vertices[step, 2] = x, y, z
    return True


# columns of what the first test of a sequence needs: height of the last image under the last face, its in-plane
# coordinates, and the bounds of the face
_BELOW, _ALONG, _ACROSS, _LOW_A, _HIGH_A, _LOW_B, _HIGH_B = range(7)


@njit(**OPTIONS)
def last_tests(
    sequences: IntArray,
    depths: IntArray,
    images_m: FloatArray,
    normal: FloatArray,
    offset_m: FloatArray,
    along: FloatArray,
    across: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
    tolerance_m: float,
    last: AnyArray,
    tests: FloatArray,
) -> None:
    """Last face of each sequence, and ``tests`` (7, sequences); a line of sight has passed before.

    Parameters
    ----------
    sequences : (sequences, most) int
        Faces, -1 beyond the depth.
    depths : (sequences,) int
    images_m : (sequences, most, 3)
        Image of the source behind each face [m].
    normal, offset_m, along, across : (faces, 3), (faces,), (faces, 3), (faces, 3)
        Planes of the faces and their axes [m].
    lower, upper : (faces, 2)
        Bounds along these axes [m].
    tolerance_m : float
        By which the bounds are widened [m].
    last : (sequences,) uint64
        Gets the last face.
    tests : (7, sequences)
        Gets what :func:`meeting` compares [m].
    """
    for s in range(len(sequences)):
        last[s] = np.uint64(0)
        tests[_BELOW, s], tests[_ALONG, s], tests[_ACROSS, s] = -1.0, 0.0, 0.0
        tests[_LOW_A, s], tests[_HIGH_A, s], tests[_LOW_B, s], tests[_HIGH_B, s] = -np.inf, np.inf, -np.inf, np.inf
        if depths[s]:
            face, image = sequences[s, depths[s] - 1], images_m[s, depths[s] - 1]
            last[s] = np.uint64(face)
            tests[_BELOW, s] = (
                normal[face, 0] * image[0] + normal[face, 1] * image[1] + normal[face, 2] * image[2] - offset_m[face]
            )
            tests[_ALONG, s] = along[face, 0] * image[0] + along[face, 1] * image[1] + along[face, 2] * image[2]
            tests[_ACROSS, s] = across[face, 0] * image[0] + across[face, 1] * image[1] + across[face, 2] * image[2]
            tests[_LOW_A, s], tests[_HIGH_A, s] = lower[face, 0] - tolerance_m, upper[face, 0] + tolerance_m
            tests[_LOW_B, s], tests[_HIGH_B, s] = lower[face, 1] - tolerance_m, upper[face, 1] + tolerance_m


@njit(**OPTIONS)
def meeting(last: AnyArray, tests: FloatArray, place: FloatArray, tolerance_m: float, mark: FloatArray) -> None:
    """Mark the sequences whose line from the last image meets the bounds of the last face before the target.

    Parameters
    ----------
    last, tests
        As :func:`last_tests` fills them.
    place : (3, faces)
        Height of the target over each face, and its coordinates along the face's axes [m].
    tolerance_m : float
        A target this far behind a face still counts as before it [m].
    mark : (sequences,)
        Gets 1 where the line meets the face, else 0.
    """
    for s in range(len(last)):
        face = last[s]
        height = place[0, face]
        below = tests[_BELOW, s]
        share = below / (below - height)
        a0, b0 = tests[_ALONG, s], tests[_ACROSS, s]
        a, b = (place[1, face] - a0) * share + a0, (place[2, face] - b0) * share + b0
        good = (
            (height >= -tolerance_m)
            & (a >= tests[_LOW_A, s])
            & (a <= tests[_HIGH_A, s])
            & (b >= tests[_LOW_B, s])
            & (b <= tests[_HIGH_B, s])
        )
        mark[s] = 1.0 if good else 0.0


@njit(**OPTIONS)
def search(
    first_pose: int,
    last_pose: int,
    targets_m: FloatArray,
    sources_m: FloatArray,
    alive: BoolArray,
    starts: IntArray,
    sequences: IntArray,
    depths: IntArray,
    images_m: FloatArray,
    normal: FloatArray,
    offset_m: FloatArray,
    along: FloatArray,
    across: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
    polygonal: BoolArray,
    low_m: FloatArray,
    high_m: FloatArray,
    pieces: IntArray,
    planes: IntArray,
    plane_normal: FloatArray,
    plane_offset_m: FloatArray,
    abutting: BoolArray,
    tolerance_m: float,
    numbers: IntArray,
    faces: IntArray,
    points: FloatArray,
) -> int:
    """Paths of some poses, in the order of a path set; the number found, of which only as many as fit are written.

    ``starts`` (towers + 1,) says which sequences are whose; ``alive`` is (towers, poses). ``numbers`` (room, 4) takes
    pose, tower, depth and flags, ``faces`` (room, max_depth) and ``points`` (room, max_depth, 3) come filled with -1
    and NaN.

    Parameters
    ----------
    first_pose, last_pose : int
        Which poses: from the first to before the last.
    targets_m, sources_m : (poses, 3), (towers, 3)
        Ends [m].
    alive : (towers, poses) bool
        Links that are searched.
    starts : (towers + 1,) int
        Which sequences are whose.
    sequences, depths : (sequences, most) int, (sequences,) int
        Faces, -1 beyond the depth.
    images_m : (sequences, most, 3)
        Image of the source behind each face [m].
    normal, offset_m, along, across : (faces, 3), (faces,), (faces, 3), (faces, 3)
        Planes of the faces and their axes [m].
    lower, upper : (faces, 2)
        Bounds along these axes [m].
    polygonal : (faces,) bool
        Faces that do not fill their bounds.
    low_m, high_m, pieces, planes, plane_normal, plane_offset_m, abutting
        The solids, as :func:`hides` takes them.
    tolerance_m : float
        [m]
    numbers, faces, points
        Get the paths; see above.

    Returns
    -------
    int
        Number of paths found.
    """
    written, room = 0, len(numbers)
    count = len(normal)
    last, tests, mark = np.empty(len(sequences), np.uint64), np.empty((7, len(sequences))), np.empty(len(sequences))
    last_tests(sequences, depths, images_m, normal, offset_m, along, across, lower, upper, tolerance_m, last, tests)
    bounded = np.empty((count, 14))
    for face in range(count):
        bounded[face, 3] = offset_m[face]
        for i in range(3):
            bounded[face, i] = normal[face, i]
            bounded[face, 4 + i] = along[face, i]
            bounded[face, 7 + i] = across[face, i]
        for i in range(2):
            bounded[face, 10 + 2 * i] = lower[face, i] - tolerance_m
            bounded[face, 11 + 2 * i] = upper[face, i] + tolerance_m
    place = np.empty((3, max(count, 1)))
    place[:, 0] = 0.0
    vertices = np.empty((max(sequences.shape[1], 1), 3))
    for pose in range(first_pose, last_pose):
        target = targets_m[pose]
        x, y, z = target[0], target[1], target[2]
        for face in range(count):
            place[0, face] = normal[face, 0] * x + normal[face, 1] * y + normal[face, 2] * z - offset_m[face]
            place[1, face] = along[face, 0] * x + along[face, 1] * y + along[face, 2] * z
            place[2, face] = across[face, 0] * x + across[face, 1] * y + across[face, 2] * z
        meeting(last, tests, place, tolerance_m, mark)
        for tower in range(len(sources_m)):
            if not alive[tower, pose]:
                continue
            for s in range(starts[tower], starts[tower + 1]):
                depth = depths[s]
                flags = 0
                if depth:
                    if mark[s] == 0.0 or not trace(
                        target, s, depth, sequences, images_m, bounded, tolerance_m, vertices
                    ):
                        continue
                    for step in range(depth):
                        if polygonal[sequences[s, step]]:
                            flags |= POLYGON
                cut = 0
                for step in range(depth + 1):
                    start = sources_m[tower] if step == 0 else vertices[step - 1]
                    end = target if step == depth else vertices[step]
                    cut = hides(start, end, low_m, high_m, pieces, planes, plane_normal, plane_offset_m, abutting,
                                tolerance_m)  # fmt: skip
                    if cut == 1:
                        break
                    flags |= cut
                if cut == 1:
                    continue
                if written < room:
                    numbers[written, 0], numbers[written, 1], numbers[written, 2], numbers[written, 3] = (
                        pose,
                        tower,
                        depth,
                        flags,
                    )
                    for step in range(depth):
                        faces[written, step] = sequences[s, step]
                        for i in range(3):
                            points[written, step, i] = vertices[step, i]
                written += 1
    return written


SEARCH_ARGUMENTS = tuple(inspect.signature(search.py_func).parameters)


def try_out() -> None:
    """Compile, or read what was compiled before, and find a line of sight and one that a box hides.

    Raises
    ------
    RuntimeError
        If it finds anything else.
    """
    none, nothing = np.zeros((0, 3)), np.zeros(0)
    box = np.concatenate([np.eye(3), -np.eye(3)])
    numbers = np.zeros((2, 4), np.int64)
    count = search(
        0, 2, np.array([[10.0, 0.0, 0.0], [0.0, 10.0, 0.0]]), np.zeros((1, 3)), np.ones((1, 2), np.bool_),
        np.array([0, 1]), np.zeros((1, 0), np.int64), np.zeros(1, np.int64), np.zeros((1, 0, 3)), none, nothing, none,
        none, np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, np.bool_), np.array([[4.0, -1.0, -1.0]]),
        np.array([[6.0, 1.0, 1.0]]), np.array([0, 1]), np.array([0, 6]), box,
        np.array([6.0, 1.0, 1.0, -4.0, 1.0, 1.0]), np.zeros(1, np.bool_), 1e-12, numbers, np.zeros((2, 0), np.int64),
        np.zeros((2, 0, 3)),
    )  # fmt: skip
    if count != 1 or numbers[0, 0] != 1:
        raise RuntimeError(f"compiled code finds {count} of 1 line of sight")
