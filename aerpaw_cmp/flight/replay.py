"""Replay of the series of a flight: poses from the track, foliage, and one replay per tower and link.

The module also computes the levels of a flight relative to a model without antennas, with the directions at both ends.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, TypeVar

import numpy as np

from ..common.errors import InputError, UsageError
from ..common.grouping import lists_by_key
from ..common.stages import Progress, Stages, logged
from ..common.text import counted
from ..common.units import BoolArray, FloatArray
from ..compare.calibration import Observed
from ..compare.gains import LinkSamples, link_directions
from ..compare.rank import MAX_RANK
from ..compare.result import APPLIED, GIVEN, ClockResult
from ..propagation.drivers import replay_in_parts, replay_moving
from ..propagation.edges import diffracted
from ..propagation.field.baselines import free_space_dbm
from ..propagation.field.sum import channel_matrices, mean_pair_power, rss_dbm
from ..propagation.geometry import Link, Poses, RowsT, rotation_from_aircraft
from ..propagation.options import Engine, Field, Run, Search
from ..propagation.replay import PER_LINK, Replay, replay
from ..site.site import Site
from .clock import Along, ClockChannel, ClockEstimate, judge_clock
from .data import FlightData, RankSeries, RssSeries, Times, rank_positions
from .gains import LearnedGain, learned_gain, path_loss
from .rows import LOCK_FLOOR_DB
from .settings import ArraySettings, RtSettings
from .track import TrackPoses, nanoseconds
from .training import learned_here


@dataclass(frozen=True, slots=True, kw_only=True)
class Clock:
    """The radio clock of one series: the estimate, and the lag ``applied_s`` to subtract from radio times [s]."""

    result: ClockResult
    applied_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Replayed:
    """A replayed series. ``valid`` (n,) marks samples with a known pose. All other arrays contain only these samples.

    Parameters
    ----------
    tower_m : (poses, 3), optional
        Position of a tower that moves [m]. None for a fixed tower.
    learned : LearnedGain, optional
        Contribution of learned antennas to the RSS, and its standard deviation.
    """

    link: Link
    poses: Poses
    valid: BoolArray
    replay: Replay
    track: TrackPoses | None = None
    clock: Clock | None = None
    tower_m: FloatArray | None = None
    learned: LearnedGain | None = None

    def level_dbm(self, kind: Literal["coherent", "power"]) -> FloatArray:
        """Return the level of the paths with the contribution of learned antennas, shape (poses,) [dBm]."""
        level = self.replay.level_dbm(kind)[:, 0]
        return level if self.learned is None else level + self.learned.pair_db

    def source_m(self, site: Site) -> FloatArray:
        """Return the centre of the array of the tower [m], shape (1, 3), or (poses, 3) if it moves."""
        if self.tower_m is not None:
            return self.tower_m
        (tower,) = self.link.tower_arrays
        return site.towers[tower].position_m[None, :]

    def spread(self, values: FloatArray, fill: float = np.nan) -> FloatArray:
        """Expand values per replayed pose to all samples, shape (n, ...). Samples without a pose get ``fill``."""
        return _spread(self.valid, values, fill)


def _spread(valid: BoolArray, values: FloatArray, fill: float = np.nan) -> FloatArray:
    out = np.full((len(valid), *values.shape[1:]), fill, dtype=np.result_type(values.dtype, np.float64))
    out[valid] = values
    return out


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightReplay:
    """All replayed series of a flight, in the order of the flight."""

    rss: tuple[Replayed, ...]
    rank: tuple[Replayed, ...]

    @property
    def all(self) -> tuple[Replayed, ...]:
        """All replayed series, RSS before rank."""
        return (*self.rss, *self.rank)


def replay_flight(data: FlightData, stages: Stages | None = None) -> FlightReplay:
    """Estimate the clocks and replay all series.

    Parameters
    ----------
    data : FlightData
    stages : Stages, optional
        Receives the times of "clocks" and "replay".

    Returns
    -------
    FlightReplay
        Replays of every RSS and rank series.
    """
    stages = stages or Stages()
    with stages("clocks"):
        known = estimate_clocks(data, stages.progress)
    with stages("replay"):
        return FlightReplay(
            rss=tuple(replay_rss(data, stages.progress, known)), rank=tuple(replay_rank(data, stages.progress))
        )


SeriesT = TypeVar("SeriesT", RssSeries, RankSeries)


def try_replay(data: FlightData) -> None:
    """Replay only the first known pose of every series, to find errors before a complete replay."""

    def first(series: SeriesT, known: BoolArray) -> SeriesT:
        at = np.flatnonzero(known & data.tower_at(series.tower, series.time)[1])[:1]
        every = ((field.name, getattr(series, field.name)) for field in dataclasses.fields(series))
        arrays: dict[str, Any] = {name: a[at] for name, a in every if isinstance(a, np.ndarray)}
        return dataclasses.replace(series, **arrays)

    replay_rss(dataclasses.replace(data, rss=tuple(first(s, data.poses_at(s.time).valid) for s in data.rss)))
    ranked = tuple(first(s, rank_positions(s, data.track)[1]) for s in data.rank)
    replay_rank(dataclasses.replace(data, rank=ranked))


def replay_rss(
    data: FlightData, progress: Progress = logged, clocks: Sequence[Clock | None] | None = None
) -> list[Replayed]:
    """Replay every RSS series. Series of one tower with equal links share a replay."""
    # paths are searched once for all channels that share a link
    groups = lists_by_key(((series.tower, series.settings_key), index) for index, series in enumerate(data.rss))
    shifts = clocks or [None] * len(data.rss)
    rt, out = data.settings.rt, dict[int, Replayed]()
    for members in groups.values():
        tower = data.rss[members[0]].tower
        link = data.link_of(data.rss[members[0]])
        times = [telemetry_time(data.rss[i].time, shifts[i]) for i in members]
        valid, places, tracks = _towers_and_poses(data, tower, times)
        poses = [valid_poses(track, data.settings.rss_attitude) for track in tracks]
        joined = (
            poses[0]
            if len(poses) == 1
            else Poses(np.concatenate([p.position_m for p in poses]), np.concatenate([p.rotation for p in poses]))
        )
        channels = ", ".join(data.rss[i].channel for i in members)
        progress(f"replay RSS {tower} {channels}: {counted(len(joined), 'pose')}")
        towers_m = None if tower not in data.nodes else np.concatenate(places)
        replayed = replay_poses(data.site, rt, link, joined, towers_m=towers_m, progress=progress)
        fixed_m, start = data.site.towers[tower].position_m[None, :], 0
        for index, posed, track, part, place in zip(members, valid, tracks, poses, places, strict=True):
            stop = start + len(part)
            out[index] = Replayed(
                link=link,
                poses=part,
                valid=posed,
                replay=part_of(replayed, start, stop),
                track=track,
                clock=shifts[index],
                tower_m=None if towers_m is None else place,
                learned=learned_gain(link, part, fixed_m if towers_m is None else place),
            )
            start = stop
    return [out[i] for i in range(len(data.rss))]


def _towers_and_poses(
    data: FlightData, tower: str, times: Sequence[Times]
) -> tuple[list[BoolArray], list[FloatArray], list[TrackPoses]]:
    """Return, per series, a mask of times with known tower and UAV, and the positions and poses at these times."""
    valid, places, tracks = [], [], []
    for time in times:
        place, known = data.tower_at(tower, time)
        track = data.poses_at(time).where(known)
        valid.append(track.valid)
        tracks.append(track.pick(track.valid))
        places.append(place if len(place) == 1 and tower not in data.nodes else place[track.valid])
    return valid, places, tracks


def telemetry_time(time: Times, clock: Clock | None) -> Times:
    """Return radio times, corrected to the clock of the telemetry."""
    if clock is None:
        return time
    return np.asarray(time - np.timedelta64(round(clock.applied_s * 1e9), "ns"))


def estimate_clocks(data: FlightData, progress: Progress = logged) -> list[Clock | None]:
    """Return the clock of each RSS series relative to the telemetry, as ``rss.lag`` specifies.

    Series that were logged by one computer share a clock. The predictions are levels of the image engine along the
    track, with at most one reflection.
    """
    lag = data.settings.rss.lag
    if lag == "off" or data.track is None:
        return [None] * len(data.rss)
    if isinstance(lag, float):
        return [_given_clock(series.tower, lag) for series in data.rss]
    estimated = dict[int, ClockEstimate]()
    for members in same_computer(data):
        progress(f"clock {', '.join(dict.fromkeys(data.rss[i].tower for i in members))}")
        channels = clock_channels(data, [data.rss[i] for i in members])
        estimated |= dict.fromkeys(members, judge_clock(channels, window_s=data.settings.rss.advanced.lag_window_s))
    return [_clock_of(series, estimated[i], apply=lag == "apply") for i, series in enumerate(data.rss)]


def same_computer(data: FlightData) -> list[list[int]]:
    """Return the indices of RSS series, grouped by the computer that logged them: series share a tower or a file."""
    groups: list[tuple[set[tuple[str, str]], list[int]]] = []
    for index, series in enumerate(data.rss):
        keys = {("file", str(data.settings.logs[log].path)) for log in np.unique(series.log)}
        keys.add(("tower", series.tower))
        shared = [group for group in groups if group[0] & keys]
        groups = [group for group in groups if not group[0] & keys]
        # merge all groups with which this series shares a tower or a file
        groups.append((keys.union(*(k for k, _ in shared)), [*(i for _, many in shared for i in many), index]))
    return [members for _, members in groups]


def _given_clock(receiver: str, lag_s: float) -> Clock:
    """Return the clock of a lag that the flight file specifies."""
    result = ClockResult(
        receiver=receiver, radio_minus_telemetry_s=lag_s, ci95_s=(lag_s, lag_s), verdict="given", reason="",
        applied=GIVEN,
    )  # fmt: skip
    return Clock(result=result, applied_s=lag_s)


# Number of times that are replayed together. The number limits the memory on flights of more than half an hour.
BLOCK = 100_000

# Spacing [s] and largest number of the predictions for the clock. Long flights have a larger spacing.
_CLOCK_STEP_S, _CLOCK_INSTANTS = 0.05, 40_000

# Spacing for a tower that moves. The spacing is larger, because every position of the tower is traced separately.
_MOVING_CLOCK_STEP_S = 0.25


def clock_channels(data: FlightData, channels: Sequence[RssSeries]) -> list[ClockChannel]:
    """Return the levels that one computer logged, and their predictors along the telemetry, to estimate its clock.

    Ratios (the ``quality`` of the sounder, an SNR) saturate or are lost at places where levels are not. Therefore they
    are used only if there are no levels.
    """
    assert data.track is not None
    channels = [series for series in channels if series.unit != "dB"] or channels
    start, end = data.track.start_ns, data.track.end_ns
    towers = dict.fromkeys(series.tower for series in channels)
    step = _MOVING_CLOCK_STEP_S if any(tower in data.nodes for tower in towers) else _CLOCK_STEP_S
    # limit the number of times, so that hours of flight cost no more than half an hour
    step = max(step, (end - start) * 1e-9 / _CLOCK_INSTANTS)
    span = max((end - start) * 1e-9, step)  # a telemetry of one row has one time
    instants = (start + np.round(np.arange(0.0, span, step) * 1e9).astype(np.int64)).astype("datetime64[ns]")
    along: dict[tuple[str, str], Along] = {}
    alike: dict[tuple[str, float], dict[str, RssSeries]] = {}
    for series in channels:
        same = alike.setdefault((series.tower, data.link_of(series).carrier_hz), {})
        same.setdefault(series.settings_key, series)
    for (tower, _), different in alike.items():
        every = _along(data, list(different.values()), instants, step)
        along |= {(tower, key): each for key, each in zip(different, every, strict=True)}
    return [
        ClockChannel(
            name=series.channel if len(towers) == 1 else f"{series.tower} {series.channel}",
            time_s=(nanoseconds(series.time) - start) * 1e-9,
            measured_db=_clock_levels(data, series),
            along=along[series.tower, series.settings_key],
        )
        for series in channels
    ]


def _along(data: FlightData, different: Sequence[RssSeries], instants: Times, step_s: float) -> list[Along]:
    """Return predictors of the levels of series with one tower and carrier, replayed with at most one reflection."""
    links, out = [data.link_of(series) for series in different], []
    levels = _levels_along(data, links, different[0].tower, instants)
    for series, link, columns in zip(different, links, levels, strict=True):
        distance, directions = columns.pop("distance_m"), columns.pop("directions")
        if learned_here(data, series, link):  # antennas learned from this log would reproduce its lag
            columns = {"free space": columns["free space"]}
        out.append(Along(start_s=0.0, step_s=step_s, predicted_db=columns, distance_m=distance, directions=directions))
    return out


def _levels_along(
    data: FlightData, links: Sequence[Link], tower: str, instants: Times
) -> Iterator[dict[str, FloatArray]]:
    """Yield levels of three models, distance and directions at times (n,) per link. Links differ only in antennas."""
    place, known = data.tower_at(tower, instants)
    track = data.poses_at(instants).where(known)
    poses, depth = valid_poses(track, data.settings.rss_attitude), min(data.settings.rt.max_depth, 1)
    field = Field(path_loss(data.site, data.settings.rt, links[0].carrier_hz))
    # directions at both ends, because gains over direction are fitted together with the lag
    line = track.position_m - place
    distance = np.linalg.norm(line, axis=1)
    unit = line / distance[:, None]
    body = -np.einsum("nij,ni->nj", track.rotation, unit)
    # always use the image engine, because a lag does not need paths with more reflections
    search = Search("image", max_depth=depth)
    if tower not in data.nodes:
        traced, sources = replay(data.site, links[0], poses, search), data.site.towers[tower].position_m[None, :]
        loss_db = field.loss_db(traced.paths, sources, poses.position_m)
    for link in links:
        if tower in data.nodes:
            replayed = replay_moving(data.site, link, poses, place[track.valid], search, field)
            coherent, power = replayed.rss_dbm, replayed.rss_power_dbm
        else:
            fields = channel_matrices(traced.paths, traced.faces, sources, poses, link, loss_db)
            coherent, power = (
                rss_dbm(some, link.transmit_power_dbm, link.noise_floor_dbm)
                for some in (mean_pair_power(fields.h), fields.power)
            )
        yield {
            "coherent replay": _spread(track.valid, coherent[:, 0]),
            "power sum of the replay": _spread(track.valid, power[:, 0]),
            "free space": -20.0 * np.log10(distance),
            "distance_m": distance,
            "directions": np.column_stack([unit, body]),
        }


def _clock_levels(data: FlightData, series: RssSeries) -> FloatArray:
    """Return the levels (n,) for the clock, NaN below ``rss.minimum_height_m``.

    Levels of a sounder are raised to at least the level at which it loses lock.
    """
    levels, least = series.measured_db, data.settings.rss.minimum_height_m
    if least is not None:
        with np.errstate(invalid="ignore"):
            high = data.poses_at(series.time).position_m[:, 2] >= least
        levels = np.where(high, levels, np.nan)
    return levels if series.locked is None else np.maximum(levels, LOCK_FLOOR_DB)


def _clock_of(series: RssSeries, fit: ClockEstimate, *, apply: bool) -> Clock:
    """Return the clock of a receiver for one of its series."""
    result = fit.result(series.tower, apply=apply)
    return Clock(result=result, applied_s=fit.correction_s if result.applied == APPLIED else 0.0)


def part_of(replayed: Replay, start: int, stop: int) -> Replay:
    """Return the replay of poses ``start`` to ``stop``."""
    if (start, stop) == (0, len(replayed.rss_dbm)):
        return replayed

    def cut(paths: RowsT) -> RowsT:
        rows = (paths.pose >= start) & (paths.pose < stop)
        return dataclasses.replace(paths.select(rows), pose=paths.pose[rows] - start)  # type: ignore[type-var]

    # attribute a proportional share of the computing time to the part
    share = (stop - start) / max(len(replayed.rss_dbm), 1)
    # use views instead of copies, because the paths of a long flight are large
    columns: dict[str, Any] = {name: getattr(replayed, name)[start:stop] for name in PER_LINK}
    return dataclasses.replace(
        replayed,
        **columns,
        contributions=tuple(map(cut, replayed.contributions)),
        ends=replayed.ends.part(slice(start, stop)),
        seconds=replayed.seconds * share,
        search_seconds=replayed.search_seconds * share,
    )


def replay_rank(data: FlightData, progress: Progress = logged) -> list[Replayed]:
    """Replay every rank series with the arrays of ``link.rank``."""
    out = []
    for series in data.rank:
        link = data.link_of(series)
        if min(len(link.uav_array), len(link.tower_arrays[series.tower])) > MAX_RANK:
            found = f"link.rank of {series.tower} has more than {MAX_RANK} elements at both ends"
            raise UsageError(found, expected=f"at most {MAX_RANK} at one end, because modems report no higher rank")
        poses, valid, track = rank_poses(data, series)
        towers_m = data.tower_at(series.tower, series.time)[0][valid] if series.tower in data.nodes else None
        progress(f"replay rank {series.tower}: {counted(len(poses), 'pose')}")
        # H contains reflections only, so no other paths are searched
        replayed = replay_poses(data.site, data.settings.rank_rt, link, poses, towers_m=towers_m, progress=progress)
        out.append(Replayed(link=link, poses=poses, valid=valid, replay=replayed, track=track, tower_m=towers_m))
    return out


def rank_poses(data: FlightData, series: RankSeries) -> tuple[Poses, BoolArray, TrackPoses | None]:
    """Return the poses of reports with known UAV and tower, a mask (n,) of these reports, and the track at their times.

    Positions come from the log if it has them, and otherwise from the track. The attitude comes from the track in both
    cases. If the track has no attitude, the UAV array keeps its orientation in the site.
    """
    position, valid = rank_positions(series, data.track)
    valid = valid & data.tower_at(series.tower, series.time)[1]
    track = None if data.track is None else data.poses_at(series.time).pick(valid)
    # if the track has no attitude, the array keeps its orientation in the site
    rotation = np.tile(np.eye(3), (int(valid.sum()), 1, 1))
    if track is not None:
        rotation[track.valid] = attitude_rotation(track, data.settings.rank_rt.attitude)[track.valid]
    return Poses(position[valid], rotation), valid, track


def attitude_rotation(track: TrackPoses, mode: str) -> FloatArray:
    """Return body rotations (n, 3, 3) for a value of ``rt.attitude``."""
    if mode == "ignored":
        return np.broadcast_to(np.eye(3), (len(track), 3, 3))
    if mode == "logged":
        return track.rotation
    heading = np.where(track.valid, track.heading_deg, 0.0)
    return rotation_from_aircraft(np.zeros_like(heading), np.zeros_like(heading), heading)


def valid_poses(track: TrackPoses, attitude: str) -> Poses:
    """Return the valid poses of a track. The arrays are not copied if all are valid."""
    some = track.pick(track.valid)
    return Poses(some.position_m, np.ascontiguousarray(attitude_rotation(some, attitude)))


def replay_poses(
    site: Site,
    rt: RtSettings,
    link: Link,
    poses: Poses,
    *,
    towers_m: FloatArray | None = None,
    engine: Engine | None = None,
    progress: Progress = logged,
    extent_m: FloatArray | None = None,
) -> Replay:
    """Replay poses with the settings ``rt`` and foliage.

    Parameters
    ----------
    site : Site
    rt : RtSettings
        Settings of the replay, such as depth, samples and foliage.
    link : Link
        Carrier, power and arrays. The link names towers of ``site``.
    poses : Poses
    towers_m : (poses, 3), optional
        Positions of the tower of the link if it moves [m]. The link then has only this tower.
    engine : {"image", "sionna"}, optional
    progress : Progress
        Called with the completed share of a long replay.
    extent_m : (points, 3), optional
        Points that span all poses of the job [m], if ``poses`` is only a part of them.

    Returns
    -------
    Replay
        H (poses, towers, n_rx, n_tx), levels [dBm] and paths.

    Raises
    ------
    UsageError
        For settings that cannot be replayed.
    """
    engine = engine or rt.engine
    towers = "+".join(link.tower_arrays)
    name = f"{engine} {towers}" if towers_m is None else f"replay {towers}, which moves"
    search = Search(engine, max_depth=rt.max_depth, samples=rt.advanced.samples, further=diffracted(rt.diffraction))
    # the image engine finds the paths of each pose independently, except that it numbers planes of terrain in order of
    # use
    alone = engine == "image" and site.dem is None
    long = alone and len(poses) > BLOCK
    run = Run(
        # a short run of the image engine needs no progress bar
        progress=partial(progress, name) if engine == "sionna" or long or towers_m is not None else None,
        extent_m=extent_m,
    )
    field = Field(path_loss(site, rt, link.carrier_hz))
    if towers_m is not None:
        return replay_moving(site, link, poses, towers_m, search, field, run)
    if long:
        return replay_in_parts(site, link, poses, search, field, run, size=BLOCK)
    return replay(site, link, poses, search, field, run)


def observed_series(data: FlightData, series: RssSeries) -> tuple[Observed, float, float]:
    """Return the samples of one series at known poses, relative to free space with the loss of woods.

    Parameters
    ----------
    data : FlightData
    series : RssSeries

    Returns
    -------
    Observed
    float
        Share of samples without a logged attitude, for which level flight along the course is assumed.
    float
        Share of levels without a position.

    Raises
    ------
    InputError
        If the flight has no telemetry.
    """
    if data.track is None:
        raise InputError(f"flight {data.settings.flight.name} has no telemetry", expected="positions and attitude")
    place, known = data.tower_at(series.tower, series.time)
    pose = data.track.pose_at(series.time).where(known)
    low = data.settings.rss.minimum_height_m
    with np.errstate(invalid="ignore"):
        keep = pose.valid if low is None else pose.valid & (pose.position_m[:, 2] >= low)
    position = pose.position_m[keep]
    moving = series.tower in data.nodes
    place = place[keep] if moving else place
    at_uav, at_tower = link_directions(place, position, pose.rotation[keep])
    ends = place[:, None, :] if moving else place
    free = free_space_dbm(ends, position, series.link.carrier_hz, series.link.transmit_power_dbm)[:, 0]
    if data.settings.rt.foliage != "none" and data.site.wooded and not moving:
        free = _through_woods(data, series, Poses(position, pose.rotation[keep]))
    time = series.time[keep]
    seconds = (time - time.min()) / np.timedelta64(1, "s") if len(time) else np.zeros(0)
    order = np.argsort(seconds, kind="stable")
    samples = LinkSamples(
        flight=data.settings.flight.name,
        tower=series.tower,
        channel=series.channel,
        time_s=np.asarray(seconds, dtype=np.float64),
        position_m=position,
        at_uav=at_uav,
        at_tower=at_tower,
        residual_db=series.measured_db[keep] - free,
        floor_db=None if series.locked is None else LOCK_FLOOR_DB - free,
    )
    guessed = float(np.mean(~pose.attitude_known[keep])) if keep.any() else 0.0
    observed = Observed(
        samples,
        free,
        pose.heading_deg[keep],
        place if moving else None,
        time.min() if len(time) else None,
        locked=None if series.locked is None else series.locked[keep],
        sent_dbm=series.link.transmit_power_dbm,
    )
    return observed.part(order), guessed, 1.0 - float(np.mean(pose.valid))


def _through_woods(data: FlightData, series: RssSeries, poses: Poses) -> FloatArray:
    """Return the level (n,) [dBm] of the direct path with the loss of woods, but without buildings and antennas."""
    plain = {"uav": ArraySettings(), "tower": ArraySettings(), "towers": {}}
    link = series.link.model_copy(update=plain).build([series.tower], data.folder)
    rt = data.settings.rt.model_copy(update={"max_depth": 0, "diffraction": "none"})
    site = dataclasses.replace(data.site, buildings=())
    return np.asarray(replay_poses(site, rt, link, poses).level_dbm("power")[:, 0])
