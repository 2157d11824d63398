"""Plan of what a command would do and about how long it would take: ``report --dry-run`` and ``map --dry-run``.

The replay is timed: a few poses of the job itself, on this machine, now. Stages that cannot be tried in a second are
:data:`MEASURED` CPU seconds per unit of work on the sample flight and site, times what this machine needs for a small
replay of that site. ``python benchmarks/estimate.py`` measures both again and compares plans with runs.
"""

from __future__ import annotations

import dataclasses
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..common.stages import Stages
from ..flight.data import FlightData
from ..flight.settings import FlightFile, RtSettings
from ..propagation.arrays import Link, Poses, single_element
from ..propagation.engines import estimate_search
from ..propagation.options import Search
from ..propagation.replay import replay
from ..site.site import Site
from ..site.siteyaml import load_site

MEASURED = {
    "imports": 2.5,
    "clocks, per receiver": 0.5,
    "compare, per RSS sample": 0.06e-3,
    "compare, per rank sample": 0.15e-3,
    "ladder, replays of the RSS": 8.0,
    "audit": 2.8,
    "audit, per tower and array": 0.2,
    "page": 0.6,
    "figures": 1.0,
    "figures, per channel": 0.3,
    "study, per position": 5.8e-3,
    "export, per layer and position": 0.02e-3,
    "map pages": 4.0,
}
"""CPU seconds, measured on the sample flight and the packaged site by ``benchmarks/estimate.py``."""

PROBE_S = 0.006
"""CPU seconds of :func:`probe` on that machine."""

MEASURED_ON = "2026-11-23, one core of an AMD EPYC, Python 3.11"
TRIED_POSES = (32, 160)
"""Of the two replays that a time is extrapolated from."""


@dataclass(frozen=True, slots=True)
class PlannedStage:
    """A stage: what it works on, and CPU seconds, None where they cannot be told beforehand."""

    name: str
    work: str
    seconds: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """Plan of what a command would do.

    Parameters
    ----------
    job : str
    inputs : tuple of Path
        Files that would be read.
    output : Path
        What would be written; it was looked at and would be taken.
    stages : tuple of PlannedStage
    measured : str
        Where the seconds come from.
    """

    job: str
    inputs: tuple[Path, ...]
    output: Path
    stages: tuple[PlannedStage, ...]
    measured: str

    @property
    def seconds(self) -> float:
        """CPU seconds of all stages that can be told."""
        return sum(stage.seconds or 0.0 for stage in self.stages)

    def as_dict(self) -> dict[str, Any]:
        """The plan as JSON can hold it."""
        return {
            "job": self.job,
            "inputs": [str(path) for path in self.inputs],
            "output": str(self.output),
            "stages": [dataclasses.asdict(stage) for stage in self.stages],
            "seconds": self.seconds,
            "not_estimated": [stage.name for stage in self.stages if stage.seconds is None],
            "measured": self.measured,
        }


def probe() -> float:
    """CPU seconds of a small replay of the packaged site: how fast this machine is."""
    site = load_site("lake_wheeler")
    link = Link(3.3e9, {"LW1": single_element()}, single_element())
    line = np.linspace(50.0, 400.0, 200)
    poses = Poses(np.column_stack([line, 0.3 * line, np.full(200, 40.0)]), np.tile(np.eye(3), (200, 1, 1)))
    return min(_cpu_seconds(lambda: replay(site, link, poses, Search(max_depth=2))) for _ in range(5))


def _cpu_seconds(work: Any) -> float:
    start = time.process_time()
    work()
    return time.process_time() - start


def _measured_text(factor: float) -> str:
    return (
        f"CPU seconds: the replay tried on a few poses now, the rest as measured {MEASURED_ON}, times {factor:.2g} "
        "for this machine; a loaded machine takes longer"
    )


def report_plan(
    settings: FlightFile, folder: Path, logs_root: Path | None, *, inputs: list[Path], out: Path, figures: str = "page"
) -> Plan:
    """Stages, links, poses and time of a report; reads the logs and writes nothing.

    Parameters
    ----------
    settings : FlightFile
        With what the command line says instead.
    folder : Path
        Of the flight file.
    logs_root : Path, optional
    inputs : list of Path
        Files that the flight names.
    out : Path
        Folder of the results.
    figures : str
        As for the report.

    Returns
    -------
    Plan
        Stages with their work and time [s].

    Raises
    ------
    UsageError, InputError
        What the report itself would raise of its settings and logs.
    """
    from ..flight.data import load_data

    start = time.process_time()
    data = load_data(settings, folder, logs_root)
    reading = time.process_time() - start
    factor = probe() / PROBE_S
    cost = {name: seconds * factor for name, seconds in MEASURED.items()}
    n_rss, n_rank = (sum(len(item.time) for item in series) for series in (data.rss, data.rank))
    rss, rank = _tried_replays(data)
    rt = settings.rt
    stages = [
        PlannedStage("imports", "libraries", cost["imports"]),
        PlannedStage("read", f"{len(inputs)} files", reading),
    ]
    if n_rss and settings.rss.lag in ("estimate", "apply"):
        towers = len({series.tower for series in data.rss})
        seconds = towers * cost["clocks, per receiver"]
        stages.append(PlannedStage("clocks", f"{towers} receivers", seconds))
    stages += [*rss, *rank]
    seconds = n_rss * cost["compare, per RSS sample"] + n_rank * cost["compare, per rank sample"]
    stages.append(PlannedStage("compare", f"{n_rss} RSS and {n_rank} rank samples", seconds))
    if rt.audit_links > 0:
        links = min(rt.audit_links, n_rss + n_rank)
        seconds = cost["audit"] + len(rss + rank) * cost["audit, per tower and array"]
        stages.append(PlannedStage("audit", f"{links} links by the other engine", seconds))
    if n_rss and rt.engine == "image":
        known_s = [stage.seconds for stage in rss if stage.seconds is not None]
        seconds = MEASURED["ladder, replays of the RSS"] * sum(known_s)
        stages.append(PlannedStage("ladder", "simpler and richer models", seconds))
    drawn = 0 if figures == "none" else len(data.rss) + len(data.rank)
    drawing = (cost["figures"] + drawn * cost["figures, per channel"]) * (3.0 if figures == "all" else 1.0)
    seconds = cost["page"] + (drawing if drawn else 0.0)
    stages.append(PlannedStage("report", f"page, figures of {drawn} channels", seconds))
    return Plan(job="report", inputs=tuple(inputs), output=out, stages=tuple(stages), measured=_measured_text(factor))


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
        rss.append(_tried(site, rt, name, members[0].link.build([tower], data.folder), poses))
    for item in data.rank:
        position, valid = rank_positions(item, data.track)
        rotation = np.tile(np.eye(3), (int(valid.sum()), 1, 1))
        link = data.settings.link.rank.build([item.tower], data.folder)
        rank.append(_tried(site, rt, f"replay rank {item.tower}", link, Poses(position[valid], rotation)))
    return rss, rank


def _tried(site: Site, rt: RtSettings, name: str, link: Link, poses: Poses) -> PlannedStage:
    """The stage of one replay; a Sionna replay is not tried, since it compiles first."""
    from ..flight.replay import replay_poses

    work, n = f"{len(poses)} poses, engine {rt.engine}", len(poses)
    if rt.engine != "image" or n == 0:
        return PlannedStage(name, work, None if n else 0.0)
    search = Search(max_depth=rt.max_depth)
    if (searched := _searched(site, link, poses, search)) is not None:
        setup, estimate = searched
        return PlannedStage(name, f"{work}; path search {estimate}", setup + estimate.seconds)

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


def _searched(site: Site, link: Link, poses: Poses, search: Search) -> tuple[float, Any] | None:
    """CPU seconds to prepare a search among thousands of faces, which are spent once, and its estimate; None among few.

    The estimate is extrapolated from the first faces.
    """
    start = time.process_time()
    estimate = estimate_search(site, link, poses, search, threads=1)
    return None if estimate is None else (time.process_time() - start, estimate)


def _map_searched(site: Site, settings: Any, heights: int) -> PlannedStage | None:
    """The path search of a map among thousands of faces, from that of one piece of it; None among few."""
    from ..maps.grid import Grid
    from ..maps.job import CHUNK
    from .mapping.coverage_map import SiteChannels

    spots = Grid.over_area(site.area_m, settings.spacing_m).positions_m(max(settings.rss_altitudes_m))
    piece = spots[:: max(1, len(spots) // CHUNK)][:CHUNK]
    poses = Poses(piece, np.tile(np.eye(3), (len(piece), 1, 1)))
    searched = _searched(site, SiteChannels(site, settings).siso, poses, Search(max_depth=settings.max_depth))
    if searched is None:
        return None
    pieces = heights * -(-len(spots) // CHUNK)
    work = f"path search in {pieces} pieces, each {searched[1]}"
    return PlannedStage("path search", work, searched[0] + pieces * searched[1].seconds)


def map_plan(site: str, settings: Any, *, inputs: list[Path], out: Path) -> Plan:
    """Stages, links and time of a map; a coarse grid is computed for the estimate, and nothing is written.

    Parameters
    ----------
    site : str
        site.yaml, or the name of a packaged site.
    settings : MapSettings
    inputs : list of Path
    out : Path
        Folder of the results.

    Returns
    -------
    Plan
        Stages with their work and time [s].
    """
    from ..maps.grid import Grid
    from .mapping.coverage_map import make_maps

    place = load_site(site)
    positions = len(Grid.over_area(place.area_m, settings.spacing_m))
    heights = len(set(settings.rss_altitudes_m) | set(settings.rank_altitudes_m))
    links = positions * heights * len(place.towers)
    factor = probe() / PROBE_S
    cost = {name: seconds * factor for name, seconds in MEASURED.items()}
    stages = [PlannedStage("imports", "libraries", cost["imports"])]
    searched = _map_searched(place, settings, heights) if settings.engine == "image" else None
    for mode in settings.foliage:
        work = f"{links} links: {positions} positions, {heights} heights, {len(place.towers)} towers"
        seconds: float | None = None
        if searched is not None:  # the modes share the paths
            seconds = searched.seconds if mode == settings.foliage[0] else 0.0
            work += f"; {searched.work}"
        elif settings.engine == "image":
            coarse = dataclasses.replace(
                settings, foliage=(mode,), spacing_m=settings.spacing_m * max(1.0, (positions / 80) ** 0.5)
            )
            tried = len(Grid.over_area(place.area_m, coarse.spacing_m))
            seconds = _cpu_seconds(lambda one=coarse: make_maps(place, one, Stages())) * positions / tried
        stages.append(PlannedStage(f"maps, foliage {mode}", work, seconds))
    if settings.study:
        seconds = positions * cost["study, per position"]
        stages.append(PlannedStage("study", "correlation and interpolation", seconds))
    layers = heights * len(place.towers) * len(settings.foliage) * (1 + len(settings.ks))
    seconds = cost["map pages"] + positions * layers * cost["export, per layer and position"]
    stages.append(PlannedStage("export, page", f"some {layers} layers", seconds))
    return Plan(job="map", inputs=tuple(inputs), output=out, stages=tuple(stages), measured=_measured_text(factor))
