"""Stages of a report or a map, and about how long they would take, for ``--dry-run``.

The replay is timed: a few poses of the job itself, on this machine, now. Stages that cannot be tried in a second have
no time.
"""

from __future__ import annotations

import dataclasses
import time
from typing import Any

import numpy as np

from ..common.counting import counted
from ..common.stages import PlannedStage, Stages
from ..common.units import spread_out
from ..flight.data import FlightData
from ..flight.settings import RtSettings
from ..propagation.geometry.arrays import Link, Poses
from ..site.site import Site

# Of the two replays that a time is extrapolated from, and of the tiles of a map.
TRIED_POSES, _TRIED_TILES = (32, 160), 4


def _cpu_seconds(work: Any) -> float:
    start = time.process_time()
    work()
    return time.process_time() - start


def report_stages(data: FlightData, figures: str) -> list[PlannedStage]:
    """Links, poses and time [s] of a report of a flight that was read; ``figures`` as for the report."""
    n_rss, n_rank = (sum(len(item.time) for item in series) for series in (data.rss, data.rank))
    rss, rank = _tried_replays(data)
    settings, rt = data.settings, data.settings.rt
    stages = []
    if n_rss and settings.rss.lag in ("estimate", "apply"):
        stages.append(PlannedStage("clocks", counted(len({series.tower for series in data.rss}), "receiver")))
    stages += [
        *rss,
        *rank,
        PlannedStage("compare", f"{counted(n_rss, 'RSS sample')}, {counted(n_rank, 'rank sample')}"),
    ]
    if rt.audit_links > 0:
        stages.append(
            PlannedStage("audit", f"{counted(min(rt.audit_links, n_rss + n_rank), 'link')} by the other engine")
        )
    if n_rss and rt.engine == "image":
        stages.append(PlannedStage("ladder", "simpler and richer models"))
    drawn = 0 if figures == "none" else len(data.rss) + len(data.rank)
    return [*stages, PlannedStage("report", f"page, figures of {counted(drawn, 'channel')}")]


def _tried_replays(data: FlightData) -> tuple[list[PlannedStage], list[PlannedStage]]:
    """A stage per replayed RSS link and per rank series, timed on a few of their poses."""
    from ..flight.data import rank_positions
    from ..flight.replay import attitude_rotation

    groups: dict[tuple[str, str], list[Any]] = {}
    for series in data.rss:
        groups.setdefault((series.tower, series.settings_key), []).append(series)
    rss, rank, site, rt = [], [], data.site, data.settings.rt
    for (tower, _), members in groups.items():
        assert data.track is not None
        track = data.track.pose_at(np.concatenate([series.time for series in members]))
        poses = Poses(track.position_m[track.valid], attitude_rotation(track, rt.attitude)[track.valid])
        name = f"replay RSS {tower} {', '.join(series.channel for series in members)}"
        rss.append(_tried(site, rt, name, data.link_of(members[0]), poses))
    for item in data.rank:
        position, valid = rank_positions(item, data.track)
        rotation = np.tile(np.eye(3), (int(valid.sum()), 1, 1))
        link = data.link_of(item)
        rank.append(_tried(site, rt, f"replay rank {item.tower}", link, Poses(position[valid], rotation)))
    return rss, rank


def _tried(site: Site, rt: RtSettings, name: str, link: Link, poses: Poses) -> PlannedStage:
    """The stage of one replay; a Sionna replay is not tried, since it compiles first."""
    from ..flight.replay import replay_poses

    work, n = f"{counted(len(poses), 'pose')}, engine {rt.engine}", len(poses)
    if rt.engine != "image" or n == 0:
        return PlannedStage(name, work, None if n else 0.0)

    def tried(count: int) -> float:
        few = np.unique(np.linspace(0, n - 1, min(n, count)).astype(int))
        some = Poses(poses.position_m[few], np.ascontiguousarray(poses.rotation[few]))
        return _cpu_seconds(lambda: replay_poses(site, rt, link, some))

    few, more = TRIED_POSES
    if n <= more:
        return PlannedStage(name, work, tried(n))
    small, large = tried(few), tried(more)
    per_pose = max(large - small, 0.2 * large) / (more - few)  # a hiccup in the small one does not make poses free
    return PlannedStage(name, work, large + per_pose * (n - more))


def _tiles(site: Site, settings: Any, tiling: Any) -> PlannedStage:
    """The tiles of a map, from some that are spread over it; workers share their time."""
    from .mapping.coverage_map import SiteChannels, TileOrder

    channels = SiteChannels(site, settings)
    some = spread_out(len(tiling), _TRIED_TILES).tolist()
    orders = [TileOrder(site="", settings=settings, cells=tiling.cells, number=number) for number in some]
    seconds = _cpu_seconds(lambda: [channels.tile(order) for order in orders]) * len(tiling) / len(some)
    return PlannedStage(
        "maps in tiles", f"{counted(len(tiling), 'tile')} of {tiling.cells} x {tiling.cells} positions", seconds
    )


def map_stages(place: Site, settings: Any, n_flights: int = 0) -> list[PlannedStage]:
    """Links and time [s] of a map with :class:`MapSettings`; a coarse grid is computed for the estimate."""
    from ..maps.grid import Grid
    from ..maps.tiles import Tiling
    from .mapping.coverage_map import make_maps

    grid = Grid.over_area(place.area_m, settings.spacing_m)
    positions, cells = len(grid), settings.tile_cells(grid) if settings.engine == "image" else None
    heights = len(set(settings.rss_altitudes_m) | set(settings.rank_altitudes_m))
    links = positions * heights * len(place.towers)
    stages = [_tiles(place, settings, Tiling(grid, cells))] if cells else []
    for mode in () if cells else settings.foliage:
        sides = (positions, "position"), (heights, "height"), (len(place.towers), "tower")
        work = f"{counted(links, 'link')}: {', '.join(counted(*side) for side in sides)}"
        seconds: float | None = None
        if settings.engine == "image":
            coarse = dataclasses.replace(
                settings, foliage=(mode,), spacing_m=settings.spacing_m * max(1.0, (positions / 80) ** 0.5)
            )
            tried = len(Grid.over_area(place.area_m, coarse.spacing_m))
            seconds = _cpu_seconds(lambda chosen=coarse: make_maps(place, chosen, Stages())) * positions / tried
        stages.append(PlannedStage(f"maps, foliage {mode}", work, seconds))
    if n_flights:
        stages.append(PlannedStage("correct, compare", counted(n_flights, "flight")))
    if settings.study and not cells:
        stages.append(PlannedStage("study", "correlation and interpolation"))
    layers = heights * len(place.towers) * len(settings.foliage) * (1 + len(settings.ks))
    return [*stages, PlannedStage("export, page", f"some {layers} layers")]
