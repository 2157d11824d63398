"""Paths by the compiled test of face sequences: what :mod:`aerpaw_cmp.propagation.image` knows, as columns for it."""

from __future__ import annotations

from collections.abc import Sequence
from threading import get_ident
from types import ModuleType
from typing import Any

import numpy as np

from ..common.units import BoolArray, FloatArray, IntArray
from .compiled import column, in_threads
from .faces import inside
from .paths import Faces, PathSet
from .solids import Occlusion

POSES_PER_CHUNK = 512
"""Poses of a call of the kernel: some milliseconds of work for a thread."""

Level = tuple[IntArray, FloatArray]
"""Face sequences (sequences, depth) of one length, and their images (sequences, depth, 3)."""


def find(
    kernels: ModuleType,
    faces: Faces,
    levels: Sequence[Sequence[Level]],
    sources_m: FloatArray,
    targets_m: FloatArray,
    alive: BoolArray,
    max_depth: int,
    hiding: Occlusion,
    threads: int | None,
) -> list[PathSet]:
    """Path sets of runs of poses, in order; coplanar faces are not looked at.

    Parameters
    ----------
    kernels : module
        :mod:`aerpaw_cmp.propagation.search_kernels`.
    faces : Faces
    levels : sequence of sequence of Level, length towers
        The sequences to try.
    sources_m, targets_m : (towers, 3), (poses, 3)
    alive : (towers, poses) bool
        Links that are searched.
    max_depth : int
    hiding : Occlusion
    threads : int, optional

    Returns
    -------
    list of PathSet
        One per run of :data:`POSES_PER_CHUNK` poses.
    """
    known: dict[str, Any] = {
        "targets_m": column(targets_m),
        "sources_m": column(sources_m),
        "alive": column(alive, np.bool_),
        **_sequences(levels, max_depth),
        "normal": column(faces.normal).reshape(-1, 3),
        "offset_m": column(faces.offset_m),
        "along": column(faces.along).reshape(-1, 3),
        "across": column(faces.across).reshape(-1, 3),
        "lower": column(faces.lower).reshape(-1, 2),
        "upper": column(faces.upper).reshape(-1, 2),
        "polygonal": np.array([polygon is not None for polygon in faces.polygon], dtype=np.bool_),
        **_solids(hiding),
        "tolerance_m": float(hiding.tolerance_m),
    }

    rooms: dict[int, _Room] = {}  # of the threads

    def run(first: int) -> PathSet:
        last = min(first + POSES_PER_CHUNK, len(targets_m))
        room = rooms.setdefault(get_ident(), _Room(max_depth))
        lines = room.fill(kernels, known, first, last)
        return _decided(kernels, lines, faces, known, hiding)

    return in_threads(run, range(0, len(targets_m), POSES_PER_CHUNK), threads)


class _Room:
    """Where the kernel writes what it finds: kept for the next run, as fresh memory is dear where threads share it.

    Parameters
    ----------
    max_depth : int
    """

    def __init__(self, max_depth: int) -> None:
        self.max_depth = max_depth
        self._make(0)

    def _make(self, paths: int) -> None:
        self.numbers = np.empty((paths, 4), dtype=np.int64)
        self.faces = np.full((paths, self.max_depth), -1, dtype=np.int64)
        self.points = np.full((paths, self.max_depth, 3), np.nan)

    def fill(self, kernels: ModuleType, known: dict[str, Any], first: int, last: int) -> tuple[Any, ...]:
        """Numbers (paths, 4), faces and points of poses ``first`` to ``last``, as arrays of their own."""
        least = 4 * (last - first) * len(known["sources_m"])
        if least > len(self.numbers):
            self._make(least)
        while True:
            own = {"numbers": self.numbers, "faces": self.faces, "points": self.points}
            values = {"first_pose": first, "last_pose": last, **own, **known}
            count = int(kernels.search(*(values[name] for name in kernels.SEARCH_ARGUMENTS)))
            if count <= len(self.numbers):
                break
            self._make(count)
        taken = tuple(array[:count].copy() for array in own.values())
        self.faces[:count], self.points[:count] = -1, np.nan
        return taken


def _decided(
    kernels: ModuleType, lines: tuple[Any, ...], faces: Faces, known: dict[str, Any], hiding: Occlusion
) -> PathSet:
    """The paths of a run, after polygons and seams had their say."""
    numbers, sequence, points = lines
    flags = numbers[:, 3]
    pose, tower, depth_ = (np.ascontiguousarray(numbers[:, i]) for i in range(3))
    if not flags.any():
        return PathSet(pose, tower, depth_, sequence, points)
    good = np.ones(len(numbers), dtype=np.bool_)
    rows, steps = np.nonzero((sequence >= 0) & (flags & kernels.POLYGON > 0)[:, None])
    if len(rows):
        on_face = inside(faces, sequence[rows, steps], points[rows, steps], hiding.tolerance_m)
        good[rows[~on_face]] = False
    for depth in range(sequence.shape[1] + 1):
        rows = np.flatnonzero(good & (flags & kernels.SEAM > 0) & (numbers[:, 2] == depth))
        if len(rows):
            source, target = known["sources_m"][numbers[rows, 1]], known["targets_m"][numbers[rows, 0]]
            good[rows] = ~hiding.any_segment(source, points[rows, :depth], target)
    return PathSet(pose[good], tower[good], depth_[good], sequence[good], points[good])


def _sequences(levels: Sequence[Sequence[Level]], max_depth: int) -> dict[str, Any]:
    """Sequences of all towers by length, then by faces: the order of a path set."""
    starts, sequences, depths, images = [0], [], [], []
    for tower in levels:
        for faces, places in tower:
            count, depth = faces.shape
            order = np.lexsort(faces.T[::-1]) if depth else np.arange(count)
            padded = np.full((count, max_depth), -1, dtype=np.int64)
            padded[:, :depth] = faces[order]
            spots = np.zeros((count, max_depth, 3))
            spots[:, :depth] = places[order]
            sequences.append(padded)
            depths.append(np.full(count, depth, dtype=np.int64))
            images.append(spots)
        starts.append(starts[-1] + sum(len(level[0]) for level in tower))
    none = (np.zeros((0, max_depth), np.int64), np.zeros(0, np.int64), np.zeros((0, max_depth, 3)))
    return {
        "starts": np.array(starts, dtype=np.int64),
        "sequences": np.concatenate([none[0], *sequences]),
        "depths": np.concatenate([none[1], *depths]),
        "images_m": np.concatenate([none[2], *images]),
    }


def _solids(hiding: Occlusion) -> dict[str, Any]:
    """Boxes and convex pieces of the solids, one after another."""
    flat = [planes for pieces in hiding.pieces for planes in pieces]
    touching = [touch for pieces in hiding.abutting for touch in pieces]
    return {
        "low_m": column(hiding.low).reshape(-1, 3),
        "high_m": column(hiding.high).reshape(-1, 3),
        "pieces": np.cumsum([0, *map(len, hiding.pieces)]),
        "planes": np.cumsum([0, *(len(offset) for _, offset in flat)]),
        "plane_normal": column(np.concatenate([np.zeros((0, 3)), *(normal for normal, _ in flat)])),
        "plane_offset_m": column(np.concatenate([np.zeros(0), *(offset for _, offset in flat)])),
        "abutting": np.array(touching, dtype=np.bool_),
    }
