"""The ``channel`` job: paths, channel matrices and calibrated levels along a flight or a route, as files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..common.errors import UsageError
from ..common.geodesy import bearing_deg
from ..common.outputs import OutputFolder
from ..common.provenance import KEY, union
from ..common.stages import Stages
from ..common.units import FloatArray
from ..flight.data import FlightData, choose_site, load_data, site_place
from ..flight.gains.memory import load_with_learned
from ..flight.pose.track import interpolated
from ..flight.replay import replay_poses, valid_poses
from ..flight.settings import FlightFile, LinkSettings
from ..flight.training import flight_logs
from ..propagation.geometry.arrays import Link, Poses, rotation_from_aircraft
from ..propagation.path_table import check_band, subcarriers_hz, velocities_mps
from ..report.exports.channel import FORMATS, Channel
from ..report.exports.formats import chosen_formats
from ..site.antenna.learned import BAND
from .options import DEFAULT, JobOutcome, RunOptions
from .prediction.sources import memory_of
from .prediction.where import TargetOptions, find_targets, target_files
from .tasks.manifest import inputs_of_flight


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


def flight_channel(
    data: FlightData, chosen: ChannelOptions = ChannelOptions(), stages: Stages | None = None
) -> Channel:
    """The channel along a flight.

    Parameters
    ----------
    data : FlightData
        With logs read, or of a plan without any.
    chosen : ChannelOptions
    stages : Stages, optional
        Times "replay" and "paths".

    Returns
    -------
    Channel

    Raises
    ------
    UsageError, InputError
        An unknown tower or link, a band wider than the model's, a route that is none.
    """
    stages = stages or Stages()
    settings, remarks = data.settings, list[str]()
    name, link_settings = _chosen_link(settings, chosen)
    towers = _chosen_towers(data, chosen.towers, remarks)
    check_band(chosen.bandwidth_hz or 0.0, link_settings.carrier_hz)
    link = link_settings.build(towers, data.folder)
    along = _flown(data, chosen, towers) if chosen.route is None else _planned(data, chosen.route, chosen.step_s)
    with stages("replay"):
        run: dict[str, Any] = {"towers_m": along.towers_m, "progress": stages.progress}
        replayed = replay_poses(data.site, settings.rt, link, along.poses, **run)
    with stages("paths"):
        table = replayed.path_table()
    spans = max(1.0, chosen.step_s), max(3.0, 1.5 * chosen.step_s)  # steps of many seconds are no gaps
    velocity = velocities_mps(along.time_s, along.poses.position_m, *spans)
    moves = bool(np.isfinite(velocity).any())
    if not moves:
        remarks.append("No Doppler shift: the points have no times, so the UAV has no velocity.")
    level, sd, unit, trained_on = _levels(data, link, name, along.poses, remarks)
    return Channel(
        name=along.name,
        link=name,
        replay=replayed,
        table=table,
        time_s=along.time_s,
        start=along.start,
        velocity_mps=velocity if moves else None,
        tower_mps=0.0 if along.towers_m is None else velocities_mps(along.time_s, along.towers_m, *spans),
        summed=settings.rss.field,
        level_db=level,
        level_sd_db=sd,
        level_unit=unit,
        trained_on=trained_on,
        offsets_hz=None if chosen.bandwidth_hz is None else subcarriers_hz(chosen.bandwidth_hz, chosen.subcarriers),
        remarks=(*remarks, *along.remarks, *replayed.left_out),
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
        remarks=(f"{left} of {len(time)} instants have no pose (telemetry gaps) and are left out.",) if left else (),
    )


def _planned(data: FlightData, route: Path, step_s: float) -> _Along:
    """Poses of a level aircraft along a route or a plan, nose as the route says, else along the course."""
    targets = find_targets(route, data.site, TargetOptions())
    time, position, yaw, remarks = targets.time_s, targets.position_m, targets.yaw_deg, targets.remarks
    if len(time) > 1 and (np.diff(time) > 0.0).all():
        wanted = np.arange(0.0, time[-1] + 1e-9, step_s)
        yaw = yaw[np.searchsorted(time, wanted, side="right") - 1]
        time, position = wanted, interpolated(wanted, time, position)
    known = np.isfinite(position).all(axis=1)
    time, position, yaw = time[known], position[known], yaw[known]
    if not np.isfinite(yaw).all():
        course = bearing_deg(np.gradient(position, axis=0)) if len(position) > 1 else np.zeros(1)
        yaw = np.where(np.isfinite(yaw), yaw, course)
        remarks = (*remarks, "The route gives no heading: the nose points along the course.")
    level = np.zeros(len(yaw))
    rotation = rotation_from_aircraft(level, level, level + 90.0 if data.settings.rt.attitude == "ignored" else yaw)
    return _Along(name=targets.name, poses=Poses(position, rotation), time_s=time, remarks=remarks)


def _levels(
    data: FlightData, link: Link, name: str, poses: Poses, remarks: list[str]
) -> tuple[FloatArray | None, FloatArray | None, str, tuple[str, ...]]:
    """Level and standard deviation (poses, towers) by remembered antennas, the log's unit, logs that taught them."""
    towers = tuple(link.tower_arrays)
    try:
        memory = memory_of(site_place(data.settings.site.file, data.folder), data.site)
    except UsageError:
        remarks.append("No calibrated level: no flight taught the site its antennas (aerpaw-cmp calibrate).")
        return None, None, "", ()
    level, sd = np.full((2, len(poses), len(towers)), np.nan)
    heading, units, guesses = bearing_deg(poses.rotation[:, :, 0]), dict[str, str](), 0
    trained_on: tuple[str, ...] = ()
    for source in sorted(memory.sources().values(), key=lambda s: s.channel != name):
        near = abs(source.link.carrier_hz / link.carrier_hz - 1.0) <= BAND
        if source.tower not in towers or source.tower in units or not near or source.tower in data.nodes:
            continue
        column, units[source.tower] = towers.index(source.tower), source.unit
        samples = source.targets(poses.position_m, heading)
        gain, slow, guess = memory.levels([samples], len(poses))
        level[:, column] = gain + source.free_space_db(poses.position_m)
        sd[:, column] = memory.fading(source.antenna).total_db(slow)
        guesses += int(guess.sum())
        trained_on = union(trained_on, memory.known[source.antenna].entry.trained_on)
    if not units:
        remarks.append("No calibrated level: the site remembers no antenna of these towers near this carrier.")
        return None, None, "", ()
    if guesses:
        remarks.append(f"{guesses} levels lie where no flight taught the antennas: their standard deviation says so.")
    if set(trained_on) & set(flight_logs(data)):
        remarks.append("The calibrated level was learned from this flight's own logs, too: it is no prediction of it.")
    return level, sd, ", ".join(dict.fromkeys(units.values())), trained_on


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
                data = FlightData(settings=settings, folder=root, site=site, track=None, **nothing)
        channel = flight_channel(data, chosen, stages)
        with stages("write"), output.filling() as place:
            written = [FORMATS[name](channel, place) for name in dict.fromkeys(chosen.formats)]
        metrics = {
            "flight": channel.name,
            "link": channel.link,
            "carrier_hz": channel.carrier_hz,
            "towers": list(channel.replay.towers),
            "poses": len(channel.time_s),
            "paths": len(channel.table.pose),
            "has_doppler": channel.velocity_mps is not None,
            "has_level": channel.level_db is not None,
            KEY: list(channel.trained_on),
            "files": [str(path) for path in output.placed(written)],
            "warnings": [*data.warnings, *channel.remarks],
            "stages": stages.seconds,
        }
        return JobOutcome(folder=folder, metrics=metrics, files=output.placed(written))
