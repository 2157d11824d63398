"""The ``channel`` job: paths, channel matrices and calibrated levels along a flight or a route, as files."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..common.counting import counted
from ..common.errors import InputError, UsageError
from ..common.geodesy import bearing_deg
from ..common.outputs import OutputFolder
from ..common.provenance import union
from ..common.stages import Stages
from ..common.units import FloatArray
from ..flight.data import FlightData, choose_site, load_data, site_place
from ..flight.gains.memory import load_with_learned
from ..flight.pose.track import interpolated
from ..flight.replay import replay_poses, valid_poses
from ..flight.settings import FlightFile, LinkSettings
from ..flight.training import flight_logs
from ..propagation.geometry.arrays import Link, Poses, rotation_from_aircraft
from ..propagation.options import Job
from ..propagation.path_table import check_band, subcarriers_hz, velocities_mps
from ..report.exports.channel import FORMATS, MOST_BYTES, STREAMED, Channel, refuse_size, write_channel
from ..report.exports.formats import chosen_formats
from ..site.antenna.learned import BAND
from .options import DEFAULT, JobOutcome, RunOptions
from .prediction.sources import Source, memory_of
from .prediction.where import TargetOptions, find_targets, target_files
from .tasks.manifest import inputs_of_flight

# Points of a route further away are none.
_NEAR_M = 1e6

# Gains and frequency responses that are worked on at once; paths of a link that they are reckoned with.
_PART_BYTES, _PATHS = 16 << 20, 4


@dataclass(frozen=True, slots=True, kw_only=True)
class ChannelOptions:
    """Options of a channel.

    Parameters
    ----------
    route : Path, optional
        In place of the flight's own track or plan.
    link : str, optional
        ``rss``, ``rank`` or a channel of the flight file; by default the first channel it names, else ``rss``.
    towers : sequence of str
        By default those of the logs, else all of the site.
    step_s : float
        Between poses.
    formats : sequence of str
        Of :data:`aerpaw_cmp.report.exports.channel.FORMATS`.
    bandwidth_hz : float, optional
        Also H at the subcarriers of a band.
    subcarriers : int
    """

    route: Path | None = None
    link: str | None = None
    towers: Sequence[str] = ()
    step_s: float = 1.0
    formats: Sequence[str] = ("netcdf",)
    bandwidth_hz: float | None = None
    subcarriers: int = 1024


@dataclass(frozen=True, slots=True, kw_only=True)
class _Along:
    """Poses at equal steps: ``start`` is the instant of ``time_s`` 0 where it is known."""

    name: str
    poses: Poses
    time_s: FloatArray
    start: Any = None
    towers_m: FloatArray | None = None
    remarks: tuple[str, ...] = ()


def flight_channel(data: FlightData, chosen: ChannelOptions = ChannelOptions()) -> Channel:
    """The channel along a flight, in memory.

    Parameters
    ----------
    data : FlightData
        With logs read, or of a plan without any.
    chosen : ChannelOptions

    Returns
    -------
    Channel

    Raises
    ------
    UsageError, InputError
        An unknown tower or link, a band wider than the model's, a route that is none, more than fits in memory.
    """
    (channel,) = channel_parts(data, chosen, in_memory=True)
    return channel


def channel_parts(
    data: FlightData,
    chosen: ChannelOptions,
    stages: Stages | None = None,
    *,
    in_memory: bool = False,
    room: int = sys.maxsize,
) -> Iterator[Channel]:
    """The channel along a flight in parts that follow each other; arguments and errors of :func:`flight_channel`.

    Parameters
    ----------
    data, chosen
    stages : Stages, optional
        Times "replay" and "paths".
    in_memory : bool
        One part alone.
    room : int
        Bytes that the parts may have together.

    Yields
    ------
    Channel
    """
    stages, settings, remarks = stages or Stages(), data.settings, list[str]()
    name, link_settings = _chosen_link(settings, chosen)
    towers = _chosen_towers(data, chosen.towers, remarks)
    check_band(chosen.bandwidth_hz or 0.0, link_settings.carrier_hz)
    link = link_settings.build(towers, data.folder)
    along = _flown(data, chosen, towers) if chosen.route is None else _planned(data, chosen.route, chosen.step_s)
    spans = max(1.0, chosen.step_s), max(3.0, 1.5 * chosen.step_s)  # steps of many seconds are no gaps
    velocity = velocities_mps(along.time_s, along.poses.position_m, *spans)
    tower = None if along.towers_m is None else velocities_mps(along.time_s, along.towers_m, *spans)
    moves = bool(np.isfinite(velocity).any())
    if not moves:
        remarks.append("No Doppler shift: the points have no times, so the UAV has no velocity.")
    offsets = None if chosen.bandwidth_hz is None else subcarriers_hz(chosen.bandwidth_hz, chosen.subcarriers)
    levels = _Levels.of(data, link, name, remarks)
    count, links = len(along.poses), len(along.poses) * len(towers)
    pairs = links * len(link.uav_array) * len(next(iter(link.tower_arrays.values())))
    size = 16 * pairs * (_PATHS + (0 if offsets is None else len(offsets)))
    at_once = 1 << max(0, (_PART_BYTES * count // size).bit_length() - 1)
    if in_memory or settings.rt.engine != "image":  # Sionna draws its rays for all poses at once
        at_once, room = count, MOST_BYTES
    refuse_size(size, f"{count} poses, {len(towers)} towers", room)
    job = None if at_once >= count else Job.of(along.poses.position_m, links, pairs)
    names = {"": 0}  # the line of sight
    for start in range(0, count, at_once):
        rows = slice(start, start + at_once)
        poses = Poses(along.poses.position_m[rows], along.poses.rotation[rows])
        with stages("replay"):
            run: dict[str, Any] = {"towers_m": None if along.towers_m is None else along.towers_m[rows]}
            run["progress"] = stages.progress if job is None else lambda *_: None  # one of many parts is silent
            replayed = replay_poses(data.site, settings.rt, link, poses, **run, job=job)
        with stages("paths"):
            table = replayed.path_table(names)
        if job is not None:
            stages.progress("channel", min(1.0, rows.stop / count))
        yield Channel(
            name=along.name,
            link=name,
            replay=replayed,
            table=table,
            time_s=along.time_s[rows],
            start=along.start,
            velocity_mps=velocity[rows] if moves else None,
            tower_mps=0.0 if tower is None else tower[rows],
            summed=settings.rss.field,
            offsets_hz=offsets,
            remarks=(*remarks, *along.remarks),
            **levels.at(poses),
        )


def _chosen_link(settings: FlightFile, chosen: ChannelOptions) -> tuple[str, LinkSettings]:
    links: Mapping[str, LinkSettings] = {
        **settings.link.channels, "rss": settings.link.rss, "rank": settings.link.rank
    }  # fmt: skip
    name = chosen.link or next(iter(links))
    if name not in links:
        raise UsageError(f"the flight has no link {name!r}", expected="one of " + ", ".join(links))
    return name, links[name]


def _chosen_towers(data: FlightData, named: Sequence[str], remarks: list[str]) -> list[str]:
    """Towers by name; those that move stand alone, since each pose has another scene."""
    if unknown := [name for name in named if name not in data.site.towers]:
        raise UsageError(f"the site has no tower {unknown[0]!r}", expected="one of " + ", ".join(data.site.towers))
    logs = [str(log.node) for log in data.settings.logs if log.node in data.site.towers]
    towers = list(dict.fromkeys(named or [s.tower for _, s in data.series] or logs or data.site.towers))
    fixed = [tower for tower in towers if tower not in data.nodes]
    if len(towers) == 1 or len(fixed) == len(towers):
        return towers
    if named or not fixed:
        raise UsageError("a tower that moves beside others", expected=f"--tower {towers[0]} alone")
    remarks.append("Towers that move are left out: --tower NAME exports one alone.")
    return fixed


def _flown(data: FlightData, chosen: ChannelOptions, towers: Sequence[str]) -> _Along:
    """Poses of the track where it is known, and of the tower where it moves."""
    if data.track is None:
        raise UsageError("a flight without telemetry", expected="a telemetry log, flight.plan or --route FILE")
    step = np.timedelta64(round(chosen.step_s * 1e9), "ns")
    time = np.arange(data.track.start_ns, data.track.end_ns + 1, step.astype(np.int64)).astype("datetime64[ns]")
    place, known = data.tower_at(towers[0], time)
    track = data.poses_at(time).where(known)
    if not track.valid.any():
        raise UsageError("no instant of the flight has a pose", expected="positions", cause=data.track.why_not(track))
    left = int((~track.valid).sum())
    return _Along(
        name=data.settings.flight.name,
        poses=valid_poses(track, data.settings.rt.attitude),
        time_s=((time - time[0]) / np.timedelta64(1, "s"))[track.valid],
        start=time[0],
        towers_m=place[track.valid] if towers[0] in data.nodes else None,
        remarks=(f"{left} of {counted(len(time), 'instant')} left out: no pose (telemetry gaps).",) if left else (),
    )


def _planned(data: FlightData, route: Path, step_s: float) -> _Along:
    """Poses of a level aircraft along a route or a plan, nose as the route says, else along the course."""
    targets = find_targets(route, data.site, TargetOptions())
    if targets.kind == "grid":
        found = "a site, not a route" if route.exists() else "no such file"
        raise InputError(found, expected="a .plan, KML, CSV or log, or a flight.yaml with a plan", path=route)
    time, position, yaw, remarks = targets.time_s, targets.position_m, targets.yaw_deg, targets.remarks
    if len(time) > 1 and (np.diff(time) > 0.0).all():
        wanted = np.arange(0.0, time[-1] + 1e-9, step_s)
        yaw = yaw[np.searchsorted(time, wanted, side="right") - 1]
        time, position = wanted, interpolated(wanted, time, position)
    known = np.asarray((np.abs(position) < _NEAR_M).all(axis=1))
    if not known.any():
        raise InputError("no point lies near the site", expected="east, north and height in metres", path=route)
    if not known.all():
        remarks = (*remarks, f"{int((~known).sum())} of {len(known)} points have no place near the site: left out.")
    time, position, yaw = time[known], position[known], yaw[known]
    if not np.isfinite(yaw).all():
        course = bearing_deg(np.gradient(position, axis=0)) if len(position) > 1 else np.zeros(1)
        yaw = np.where(np.isfinite(yaw), yaw, course)
        remarks = (*remarks, "The route gives no heading: the nose points along the course.")
    level = np.zeros(len(yaw))
    rotation = rotation_from_aircraft(level, level, level + 90.0 if data.settings.rt.attitude == "ignored" else yaw)
    return _Along(name=targets.name, poses=Poses(position, rotation), time_s=time, remarks=remarks)


@dataclass(frozen=True, slots=True)
class _Levels:
    """Calibrated levels of towers by remembered antennas: ``sources`` by number of the tower; none without memory."""

    memory: Any
    sources: Mapping[int, Source]
    towers: int
    trained_on: tuple[str, ...] = ()

    @classmethod
    def of(cls, data: FlightData, link: Link, name: str, remarks: list[str]) -> _Levels:
        towers = tuple(link.tower_arrays)
        try:
            memory = memory_of(data.site_place, data.site)
        except UsageError:
            remarks.append("No calibrated level: no flight taught the site its antennas (aerpaw-cmp calibrate).")
            return cls(None, {}, len(towers))
        sources: dict[int, Source] = {}
        for source in sorted(memory.sources().values(), key=lambda s: s.channel != name):
            near = abs(source.link.carrier_hz / link.carrier_hz - 1.0) <= BAND
            if source.tower in towers and near and source.tower not in data.nodes:
                sources.setdefault(towers.index(source.tower), source)
        if not sources:
            remarks.append("No calibrated level: the site remembers no antenna of these towers near this carrier.")
        trained_on = union(*(memory.known[source.antenna].entry.trained_on for source in sources.values()))
        if set(trained_on) & set(flight_logs(data)):
            remarks.append("The calibrated level was learned from this flight's own logs, too: no prediction of it.")
        return cls(memory, sources, len(towers), trained_on)

    def at(self, poses: Poses) -> dict[str, Any]:
        """Level and standard deviation (poses, towers), and how many are guesses, as :class:`Channel` has them."""
        if not self.sources:
            return {}
        level, sd = np.full((2, len(poses), self.towers), np.nan)
        heading, guesses = bearing_deg(poses.rotation[:, :, 0]), 0
        for column, source in self.sources.items():
            gain, slow, guess = self.memory.levels([source.targets(poses.position_m, heading)], len(poses))
            level[:, column] = gain + source.free_space_db(poses.position_m)
            sd[:, column] = self.memory.fading(source.antenna).total_db(slow)
            guesses += int(guess.sum())
        units = ", ".join(dict.fromkeys(source.unit for source in self.sources.values()))
        return {
            "level_db": level, "level_sd_db": sd, "level_unit": units, "trained_on": self.trained_on, "guesses": guesses
        }  # fmt: skip


def run_channel(flight: Path, chosen: ChannelOptions, options: RunOptions = DEFAULT) -> JobOutcome:
    """Write the channel along a flight in each format that is asked for.

    Parameters
    ----------
    flight : Path
        flight.yaml: with its logs, with a plan, or with a route beside it.
    chosen : ChannelOptions
    options : RunOptions
        ``out`` is ``reports/channel-NAME`` by default.

    Returns
    -------
    JobOutcome
    """
    if unknown := [name for name in chosen.formats if name not in FORMATS]:
        raise UsageError(f"--format {unknown[0]!r}", expected="one of " + ", ".join(FORMATS))
    if "netcdf" in chosen.formats:
        chosen_formats("netcdf")  # told before the replay where its libraries are missing
    settings, stages = load_with_learned(flight), Stages(options.progress)
    root = options.logs_root or flight.parent
    if chosen.route is None and settings.flight.plan and not all((root / log.path).exists() for log in settings.logs):
        chosen = replace(chosen, route=flight)  # not flown yet: its plan
    flown = chosen.route is None
    inputs = inputs_of_flight(settings if flown else settings.model_copy(update={"logs": []}), flight, root)
    inputs += [] if chosen.route is None else target_files(chosen.route, None, root)
    folder = options.out or Path("reports") / f"channel-{settings.flight.name}"
    with OutputFolder(folder, job="channel", inputs=inputs, force=options.force) as output:
        with stages("read"):
            if flown:
                data = load_data(settings, flight.parent, options.logs_root)
            else:
                nothing: dict[str, Any] = dict.fromkeys(("files", "rss", "rank", "warnings"), ())
                site = choose_site(settings.site, flight.parent)
                known = site_place(settings.site.file, flight.parent)
                data = FlightData(settings=settings, folder=root, site_place=known, site=site, track=None, **nothing)
        in_memory = not STREAMED.issuperset(chosen.formats)
        with output.filling() as place:
            parts = channel_parts(data, chosen, stages, in_memory=in_memory, room=shutil.disk_usage(place).free)
            written, metrics = write_channel(parts, place, tuple(dict.fromkeys(chosen.formats)), stages)
        files = output.placed(written)
        warnings = [*data.warnings, *metrics.pop("warnings")]
        metrics |= {"files": [*map(str, files)], "warnings": warnings, "stages": stages.seconds}
        return JobOutcome(folder=folder, metrics=metrics, files=files)
