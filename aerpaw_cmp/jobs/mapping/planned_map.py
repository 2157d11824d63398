"""Stages of a map, and about how long they would take, for ``--dry-run``: a coarse grid of it, computed now."""

from __future__ import annotations

import dataclasses
import time
from typing import Any

from ...common.counting import counted
from ...common.stages import PlannedStage, Stages
from ...common.units import spread_out
from ...maps.grid import Grid
from ...maps.tiles import Tiling
from ...site.site import Site
from .coverage_map import MapSettings, SiteChannels, TileOrder, make_maps

# Tiles that a time is extrapolated from.
_TRIED_TILES = 4


def _cpu_seconds(work: Any) -> float:
    start = time.process_time()
    work()
    return time.process_time() - start


def _tiles(site: Site, settings: MapSettings, tiling: Tiling) -> PlannedStage:
    """The tiles of a map, from some that are spread over it; workers share their time."""
    channels = SiteChannels(site, settings)
    some = spread_out(len(tiling), _TRIED_TILES).tolist()
    orders = [TileOrder(site="", settings=settings, cells=tiling.cells, number=number) for number in some]
    seconds = _cpu_seconds(lambda: [channels.tile(order) for order in orders]) * len(tiling) / len(some)
    return PlannedStage(
        "maps in tiles", f"{counted(len(tiling), 'tile')} of {tiling.cells} x {tiling.cells} positions", seconds
    )


def map_stages(place: Site, settings: MapSettings, n_flights: int = 0) -> list[PlannedStage]:
    """Links and time [s] of a map with :class:`MapSettings`; a coarse grid is computed for the estimate."""
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
