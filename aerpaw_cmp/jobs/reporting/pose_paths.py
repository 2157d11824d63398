"""Propagation paths of a spread of poses, for the drawing of a report."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ...common.units import FloatArray
from ...flight.data import FlightData
from ...flight.replay import FlightReplay, Replayed
from ...report.content.flight import FURTHER, PosePaths

# Poses per tower whose paths are drawn.
POSES = 300

# Paths of each further kind that are drawn of a pose.
SHORTEST = 8


def pose_paths(data: FlightData, replays: FlightReplay) -> tuple[PosePaths, ...]:
    """Paths of each tower's first series at about :data:`POSES` of its poses, spread over the flight."""
    by_tower: dict[str, PosePaths] = {}
    for (_, series), replayed in zip(data.series, replays.all, strict=True):
        if series.tower not in by_tower and replayed.valid.any():
            poses = np.unique(np.linspace(0, len(replayed.poses) - 1, POSES).astype(np.int64))
            time = series.time[replayed.valid][poses]
            tower_m = np.broadcast_to(replayed.source_m(data.site), replayed.poses.position_m.shape)
            lines = tuple(tuple(_lines(replayed, pose, tower_m[pose])) for pose in poses)
            by_tower[series.tower] = PosePaths(tower=series.tower, time=time, lines=lines)
    return tuple(by_tower.values())


def _lines(replayed: Replayed, pose: int, tower_m: FloatArray) -> Iterator[tuple[FloatArray, int]]:
    """Polylines of a pose with their kind: number of reflections, or FURTHER."""
    replay, target_m = replayed.replay, replayed.poses.position_m[pose]
    for number, some in enumerate(replay.contributions):
        paths, kind = some.lines(), FURTHER if number else None
        start, stop = np.searchsorted(paths.pose, [pose, pose + 1])
        lines = [
            np.concatenate([tower_m[None], paths.vertices_m[row, : paths.depth[row]], target_m[None]])
            for row in range(start, stop)
        ]
        if kind is not None:
            lines = sorted(lines, key=lambda line: float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum()))[
                :SHORTEST
            ]
        for line in lines:
            yield line, len(line) - 2 if kind is None else kind
