"""Propagation paths of a spread of poses, for the drawing of a report."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ..common.units import FloatArray
from ..flight.data import FlightData, RankSeries, RssSeries
from ..flight.replay import FlightReplay, Replayed
from ..report.data import PosePaths

POSES = 300
"""Poses per tower whose paths are drawn."""


def pose_paths(data: FlightData, replays: FlightReplay, limit: int = POSES) -> tuple[PosePaths, ...]:
    """Paths of each tower's first series at about ``limit`` of its poses, spread over the flight."""
    by_tower: dict[str, PosePaths] = {}
    every: list[RssSeries | RankSeries] = [*data.rss, *data.rank]
    for series, replayed in zip(every, replays.all, strict=True):
        if series.tower not in by_tower and replayed.valid.any():
            poses = np.unique(np.linspace(0, len(replayed.poses) - 1, limit).astype(np.int64))
            time = series.time[replayed.valid][poses]
            tower_m = np.broadcast_to(replayed.source_m(data.site), replayed.poses.position_m.shape)
            lines = tuple(tuple(_lines(replayed, pose, tower_m[pose])) for pose in poses)
            by_tower[series.tower] = PosePaths(tower=series.tower, time=time, lines=lines)
    return tuple(by_tower.values())


def _lines(replayed: Replayed, pose: int, tower_m: FloatArray) -> Iterator[tuple[FloatArray, int]]:
    paths = replayed.replay.paths
    start, stop = np.searchsorted(paths.pose, [pose, pose + 1])
    for row in range(start, stop):
        depth = int(paths.depth[row])
        points = [tower_m[None], paths.vertices_m[row, :depth], replayed.poses.position_m[pose][None]]
        yield np.concatenate(points), depth
