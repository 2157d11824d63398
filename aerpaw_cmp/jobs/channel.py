"""The ``channel`` job: paths, channel matrices and calibrated levels along a flight or a route, as files."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..common.content import union
from ..common.errors import InputError, UsageError
from ..common.geodesy import bearing_deg
from ..common.outputs import OutputFolder
from ..common.stages import Stages
from ..common.text import counted
from ..common.units import FloatArray
from ..flight.data import FlightData, load_data, unread
from ..flight.gains import load_with_learned
from ..flight.replay import replay_poses, valid_poses
from ..flight.settings import FlightFile, LinkSettings
from ..flight.track import interpolated, velocities_mps
from ..flight.training import is_training_data
from ..propagation.geometry import Link, Poses, rotation_from_aircraft
from ..propagation.options import extent_of
from ..propagation.replay import check_band, subcarriers_hz
from ..report.channel import STREAMED, Along, Channel, chosen_formats, write_channel
from ..site.learned import BAND
from .options import DEFAULT, JobOutcome, RunOptions
from .sources import Source, TargetOptions, find_targets, stored_model, target_files
from .tasks import inputs_of_flight

_MOST_POSES = 10_000_000

# Size of gains and frequency responses per part, and largest size in memory [bytes]. Estimates: number of paths per
# link, and bytes per path in addition to its gains.
_PART_BYTES, MOST_BYTES, _PATHS, _PATH_BYTES = 16 << 20, 2 << 30, 4, 512


@dataclass(frozen=True, slots=True, kw_only=True)
class ChannelOptions:
    """Options of a channel.

    Parameters
    ----------
    route : Path, optional
        Route that replaces the flight's track or plan.
    link : str, optional
        ``rss``, ``rank`` or a channel of the flight file. Default: the first channel of the flight file, else ``rss``.
    towers : sequence of str
        Default: the towers of the logs, else all towers of the site.
    step_s : float
        Time between poses [s].
    formats : sequence of str
        Names in :data:`aerpaw_cmp.report.channel.FORMATS`.
    bandwidth_hz : float, optional
        Bandwidth of the subcarriers at which H is computed.
    subcarriers : int, optional
        Number of subcarriers. Default: 1024.
    """

    route: Path | None = None
    link: str | None = None
    towers: Sequence[str] = ()
    step_s: float = 1.0
    formats: Sequence[str] = ("netcdf",)
    bandwidth_hz: float | None = None
    subcarriers: int | None = None


def channel_parts(
    data: FlightData, chosen: ChannelOptions, stages: Stages | None = None, room: int | None = None
) -> Iterator[Channel]:
    """Yield the channel along a flight in consecutive parts.

    Parameters
    ----------
    data : FlightData
        A flight with logs, or with a plan only.
    chosen : ChannelOptions
    stages : Stages, optional
        Receives the times of the stages "replay" and "paths".
    room : int, optional
        Largest size of all parts together [bytes]. None means a single part in memory.

    Yields
    ------
    Channel

    Raises
    ------
    UsageError, InputError
        If a tower or link is unknown, the band is wider than the model allows, the route cannot be read, or the channel
        is too large.
    """
    stages, remarks = stages or Stages(), list[str]()
    name, link_settings = _chosen_link(data.settings, chosen)
    if name != "rank":
        rt = data.settings.rt.model_copy(update={"attitude": data.settings.rss_attitude})
        data = replace(data, settings=data.settings.changed({"rt": rt}))
    towers = _chosen_towers(data, chosen, remarks)
    offsets = _offsets_hz(chosen, link_settings.carrier_hz)
    link = link_settings.build(towers, data.folder)
    along = _moving(data, chosen, towers, remarks)
    levels = _levels_of(data, link, name, remarks)
    along = replace(along, remarks=(*remarks, *along.remarks))
    count = len(along.poses)
    at_once, further = _poses_at_once(count, link, offsets, data.settings.rt.engine, room)
    extent_m = None if at_once >= count else extent_of(along.poses.position_m)
    progress = stages.progress if extent_m is None else lambda *_: None  # do not report progress of single parts
    names = {"": 0}  # the line of sight
    for start in range(0, count, at_once):
        part = along.part(slice(start, start + at_once))
        run: dict[str, Any] = {"towers_m": part.towers_m, "progress": progress, "extent_m": extent_m}
        with stages("replay"):
            replayed = replay_poses(data.site, data.settings.rt, link, part.poses, **run)
        with stages("paths"):
            table = replayed.path_table(names)
        size = _size(replayed.h.size, table.most, offsets)
        what = f"{counted(len(part.poses), 'pose')}, {counted(table.most, 'path')} of a link"
        _refuse(size, what, MOST_BYTES, further)
        stages.progress("channel", min(1.0, (start + at_once) / count))
        yield Channel(
            along=part,
            link=name,
            replay=replayed,
            table=table,
            summed=data.settings.rss.field,
            offsets_hz=offsets,
            **levels(part.poses),
        )


def _offsets_hz(chosen: ChannelOptions, carrier_hz: float) -> FloatArray | None:
    """Return the offsets of the subcarriers from the carrier, or None without a band."""
    if chosen.subcarriers is not None and chosen.bandwidth_hz is None:
        raise UsageError("--subcarriers without a band", expected="--bandwidth HZ as well")
    check_band(chosen.bandwidth_hz or 0.0, carrier_hz)
    return None if chosen.bandwidth_hz is None else subcarriers_hz(chosen.bandwidth_hz, chosen.subcarriers or 1024)


def _moving(data: FlightData, chosen: ChannelOptions, towers: Sequence[str], remarks: list[str]) -> Along:
    """Return the poses of the track or route, and the velocities of both ends if they are known."""
    along = _flown(data, chosen, towers) if chosen.route is None else _planned(data, chosen.route, chosen.step_s)
    # a speed over less than one second is mostly noise of the positions
    spans = max(1.0, chosen.step_s), max(3.0, 1.5 * chosen.step_s)  # a step is not a gap
    velocity = velocities_mps(along.time_s, along.poses.position_m, *spans)
    if not np.isfinite(velocity).any():
        remarks.append("No Doppler shift: no point has a neighbour in time, so the velocity of the UAV is unknown.")
        return along
    other = None if along.towers_m is None else velocities_mps(along.time_s, along.towers_m, *spans)
    return replace(along, velocity_mps=velocity, tower_mps=other)


def _poses_at_once(
    count: int, link: Link, offsets_hz: FloatArray | None, engine: str, room: int | None
) -> tuple[int, str]:
    """Return the number of poses of a part, and the advice for a channel that is refused because it is too large.

    ``count`` is the number of all poses, and ``room`` [bytes] the largest size of all parts (None: a single part).
    """
    links = count * len(link.tower_arrays)
    size = _size(links * len(link.uav_array) * len(next(iter(link.tower_arrays.values()))), _PATHS, offsets_hz)
    # use a power of two, like the chunks of the file: a part that ends within a chunk would compress the chunk twice
    at_once, further = 1 << max(0, (_PART_BYTES * count // size).bit_length() - 1), " of disk space"
    if engine != "image" or room is None:  # Sionna draws its rays for all poses at once
        at_once, room, size = count, MOST_BYTES, size + _PATH_BYTES * links * _PATHS
        further = ", or only netcdf and csv" + (" with rt.engine: image" if engine != "image" else "")
    _refuse(size, f"{counted(count, 'pose')}, {counted(len(link.tower_arrays), 'tower')}", room, further)
    return at_once, further


def _size(pairs: int, paths: int, offsets_hz: FloatArray | None) -> int:
    """Return the size of gains and frequency responses of element pairs [bytes]."""
    return 16 * pairs * (paths + (0 if offsets_hz is None else len(offsets_hz)))


def _refuse(size: int, what: str, room: int, further: str) -> None:
    """Raise UsageError if a channel needs more than the available bytes, in memory or on the disk."""
    if size > room:
        raise UsageError(
            f"{size / 2**30:.0f} GiB of paths and gains: {what}",
            expected=f"at most {room / 2**30:.0f} GiB{further}",
            cause="too short a --step, or too many --subcarriers",
        )


def _chosen_link(settings: FlightFile, chosen: ChannelOptions) -> tuple[str, LinkSettings]:
    links: dict[str, LinkSettings] = {**settings.link.channels, "rss": settings.link.rss, "rank": settings.link.rank}
    name = chosen.link or next(iter(links))
    if name not in links:
        raise UsageError(f"the flight has no link {name!r}", expected="one of " + ", ".join(links))
    return name, links[name]


def _chosen_towers(data: FlightData, chosen: ChannelOptions, remarks: list[str]) -> list[str]:
    """Return the names of the towers. A moving tower is exported alone, along the track, because its scene changes."""
    if unknown := [name for name in chosen.towers if name not in data.site.towers]:
        raise UsageError(f"the site has no tower {unknown[0]!r}", expected="one of " + ", ".join(data.site.towers))
    logs = [str(log.node) for log in data.settings.logs if log.node in data.site.towers]
    towers = list(dict.fromkeys(chosen.towers or [s.tower for _, s in data.series] or logs or data.site.towers))
    fixed = [tower for tower in towers if tower not in data.nodes]
    if len(fixed) == len(towers) or (len(towers) == 1 and chosen.route is None):
        return towers
    if chosen.towers or not fixed:
        raise UsageError("a moving tower with other towers or along a route", expected="that tower alone, on its track")
    remarks.append("Moving towers are not exported: --tower NAME exports one of them.")
    return fixed


def _steps_s(length_s: float, step_s: float) -> FloatArray:
    """Return times from 0 to ``length_s`` at equal steps [s]."""
    if length_s > _MOST_POSES * step_s:
        raise UsageError(
            f"{length_s / step_s:.3g} poses", expected=f"at most {_MOST_POSES}", cause="a --step that is not in seconds"
        )
    # include the end, even if rounding makes the last step slightly larger
    return np.arange(0.0, length_s + 1e-9, step_s)


def _flown(data: FlightData, chosen: ChannelOptions, towers: Sequence[str]) -> Along:
    """Return the known poses of the track, and the positions of a moving tower."""
    if data.track is None:
        raise UsageError("a flight without telemetry", expected="a telemetry log, flight.plan or --route FILE")
    start, length_s = data.track.start_ns, 1e-9 * (data.track.end_ns - data.track.start_ns)
    steps = _steps_s(length_s, chosen.step_s)
    time = (start + np.round(1e9 * steps).astype(np.int64)).astype("datetime64[ns]")
    place, known = data.tower_at(towers[0], time)
    track = data.poses_at(time).where(known)
    if not track.valid.any():
        raise UsageError("the flight has no known position", expected="positions", cause=data.track.why_not(track))
    left = int((~track.valid).sum())
    return Along(
        name=data.settings.flight.name,
        poses=valid_poses(track, data.settings.rt.attitude),
        time_s=steps[track.valid],
        start=time[0],
        towers_m=place[track.valid] if towers[0] in data.nodes else None,
        remarks=(f"{left} of {counted(len(time), 'instant')} omitted: no pose (telemetry gaps).",) if left else (),
    )


def _planned(data: FlightData, route: Path, step_s: float) -> Along:
    """Return poses of level flight along a route or plan. The heading comes from the route, or else the course."""
    targets = find_targets(route, data.site, TargetOptions())
    if targets.kind == "grid":
        found = "a site, not a route" if route.exists() else "no such file"
        raise InputError(found, expected="a .plan, KML, CSV or log, or a flight.yaml with a plan", path=route)
    time, yaw, remarks = targets.time_s, targets.yaw_deg, targets.remarks
    position = np.where(targets.known[:, None], targets.position_m, np.nan)
    if len(time) > 1 and (np.diff(time) > 0.0).all():
        time = time - time[0]  # the times of a table may have any origin
        wanted = _steps_s(time[-1], step_s)
        yaw = yaw[np.searchsorted(time, wanted, side="right") - 1]
        time, position = wanted, interpolated(wanted, time, position)
    known = np.isfinite(position).all(axis=1)
    if not known.any():
        raise InputError("no step of the route has a position", expected="neighbouring rows with positions", path=route)
    time, position, yaw = time[known], position[known], yaw[known]
    if not np.isfinite(yaw).all():
        course = bearing_deg(np.gradient(position, axis=0)) if len(position) > 1 else np.zeros(1)
        yaw = np.where(np.isfinite(yaw), yaw, course)
        remarks = (*remarks, "The route has no heading: the nose points along the course.")
    level = np.zeros(len(yaw))
    rotation = rotation_from_aircraft(level, level, level + 90.0 if data.settings.rt.attitude == "ignored" else yaw)
    number = np.arange(float(len(time))) if len(time) > 1 and not time.any() else None
    poses = Poses(position, rotation)
    return Along(name=targets.name, poses=poses, time_s=time, number=number, remarks=remarks)


def _levels_of(data: FlightData, link: Link, name: str, remarks: list[str]) -> Callable[[Poses], dict[str, Any]]:
    """Return a function for the calibrated levels at poses, with the learned antennas of the site if there are any."""
    towers, sources = tuple(link.tower_arrays), dict[str, Source]()
    stored = stored_model(data.site_place, data.site)
    if stored is None:
        remarks.append("No calibrated level: no antennas were learned for this site (aerpaw-cmp calibrate).")
        return lambda _: {}
    # try the antennas of the link's channel first (False sorts before True), then antennas of other channels
    for source in sorted(stored.sources().values(), key=lambda s: s.channel != name):
        near = abs(source.link.carrier_hz / link.carrier_hz - 1.0) <= BAND
        if source.tower in towers and near and source.tower not in data.nodes:
            sources.setdefault(source.tower, source)
    if not sources:
        remarks.append("No calibrated level: the site has no learned antennas of these towers near this carrier.")
        return lambda _: {}
    known = [stored.known[source.antenna] for source in sources.values()]
    trained_on = union(*(antenna.entry.trained_on for antenna in known))
    if is_training_data(data, trained_on, union(*(end.marks for of in known for end in (of.tower, of.uav)))):
        remarks.append("The calibrated level was also learned from this flight's logs, so it is not a prediction.")
    units = ", ".join(dict.fromkeys(source.unit for source in sources.values()))

    def levels(poses: Poses) -> dict[str, Any]:
        """Return level and standard deviation, each (poses, towers)."""
        level, sd = np.full((2, len(poses), len(towers)), np.nan)
        heading, up = bearing_deg(poses.rotation[:, :, 0]), poses.rotation[:, :, 2]
        for tower, source in sources.items():
            gain, slow, _ = stored.levels([source.targets(poses.position_m, heading, up)])
            level[:, towers.index(tower)] = gain + source.free_space_db(poses.position_m)
            sd[:, towers.index(tower)] = stored.fading(source.antenna).total_db(slow)
        return {"level_db": level, "level_sd_db": sd, "level_unit": units, "trained_on": trained_on}

    return levels


def run_channel(flight: Path, chosen: ChannelOptions, options: RunOptions = DEFAULT) -> JobOutcome:
    """Write the channel along a flight in each requested format.

    Parameters
    ----------
    flight : Path
        flight.yaml with logs, with a plan, or with a route in ``chosen``.
    chosen : ChannelOptions
    options : RunOptions
        ``out`` is ``reports/channel-NAME`` by default.

    Returns
    -------
    JobOutcome
    """
    formats = chosen_formats(chosen.formats)
    settings, stages = load_with_learned(flight), Stages(options.progress)
    root, route = options.logs_root or flight.parent, chosen.route
    if route is None and settings.flight.plan and not all((root / log.path).exists() for log in settings.logs):
        route = flight  # without logs, the route is the plan of the flight
    inputs = [*inputs_of_flight(settings, flight, root), *([] if route is None else target_files(route, None, root))]
    folder = options.out or Path("reports") / f"channel-{settings.flight.name}"
    with OutputFolder(folder, job="channel", inputs=inputs, force=options.force) as output:
        with stages("read"):
            data = (load_data if route is None else unread)(settings, flight.parent, options.logs_root)
        with output.filling() as place:
            # formats that are written part by part are limited by the disk, all others by memory
            room = shutil.disk_usage(place).free if STREAMED.issuperset(formats) else None
            parts = channel_parts(data, replace(chosen, route=route), stages, room)
            written, metrics = write_channel(parts, place, formats, stages)
        files = output.placed(written)
        # a route does not use the track, so omit warnings about the track
        read = data.warnings if route is None else [f"{text}." for text in data.site.cautions()]
        warnings = [*read, *metrics.pop("warnings")]
        metrics |= {"files": [*map(str, files)], "warnings": warnings, "stages": stages.seconds}
        return JobOutcome(folder=folder, metrics=metrics, files=files)
