"""The ``explain`` job: list every path of one link at one time."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

import numpy as np

from ..common.errors import UsageError
from ..common.jsonable import fields_of, json_object
from ..common.stages import Progress, logged
from ..common.units import FloatArray
from ..flight.data import FlightData, RankSeries, RssSeries, Times, load_data
from ..flight.gains import load_with_learned, path_losses
from ..flight.replay import estimate_clocks, rank_poses, replay_poses, telemetry_time, valid_poses
from ..propagation.check.explain import (
    ExplainedPath,
    explain_paths,
    further_path_lines,
    power_sum_dbm,
    simple_paths,
    why_not,
)
from ..propagation.drivers import site_with_tower_at
from ..propagation.geometry import Link, Poses
from ..propagation.options import Engine
from ..propagation.replay import Replay
from ..report.texts import iso_time


@dataclass(frozen=True, slots=True, kw_only=True)
class Explanation:
    """The paths and levels of one link at one time.

    Parameters
    ----------
    level_dbm : float
        Coherent level of the replay: ``simulated_dbm`` of rss.csv with ``rss.field: coherent``. NaN out of coverage.
    power_sum_dbm : float
        Sum of the paths' powers.
    absent : tuple of (str, str)
        Direct path or ground reflections that are missing, with the reason.
    """

    flight: str
    tower: str
    channel: str
    time_utc: str
    time_s: float
    position_m: tuple[float, float, float]
    transmit_power_dbm: float
    carrier_hz: float
    engine: str
    paths: tuple[ExplainedPath, ...]
    level_dbm: float
    power_sum_dbm: float
    measured_db: float | None
    unit: str
    absent: tuple[tuple[str, str], ...]
    notes: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return plain values for JSON. NaN and infinity become None."""
        absent = [{"path": path, "reason": reason} for path, reason in self.absent]
        return json_object(**(fields_of(self) | {"paths": [path.as_dict() for path in self.paths], "absent": absent}))


def run_explain(
    flight: Path,
    *,
    time: str,
    tower: str,
    channel: str | None = None,
    engine: Engine | None = None,
    logs_root: Path | None = None,
    progress: Progress = logged,
) -> Explanation:
    """Explain the link to a tower at the sample nearest to a time.

    Parameters
    ----------
    flight : Path
    time : str
        Seconds after the first sample of the tower, or ISO 8601 (in the time zone of the flight if the text has no UTC
        offset).
    tower : str
        A tower of the site. If the flight has no log of this tower, the link is explained at the times of the
        telemetry.
    channel : str, optional
        Channel of the RSS logs, or "rank" for the rank log. Default: the first series of the tower. For a tower without
        a log: a key of ``link.channels``, or by default ``link.rss``.
    engine : {"image", "sionna"}, optional
        Engine that finds the paths. Default: ``rt.engine``.
    logs_root : Path, optional
    progress : Progress

    Returns
    -------
    Explanation
        The paths of the link with their losses [dB], and missing paths with the reason.

    Raises
    ------
    UsageError
        If tower or channel is unknown, the time is malformed or outside the logs, or no pose is known at that time.
    """
    settings = load_with_learned(flight)
    data = load_data(settings, flight.parent, logs_root)
    series = _series(data, tower, channel)
    at, seconds = _sample(series, time, settings.timezone)
    link, pose, notes, instant = _pose(data, series, at, progress)
    if tower in data.nodes:  # a mobile node: use its position at that time
        place, known = data.tower_at(tower, instant)
        _check_pose(known, series, at)
        data = dataclasses.replace(data, site=site_with_tower_at(data.site, tower, place[0]))
    rt = settings.rt.model_copy(update={"engine": "sionna"}) if engine == "sionna" else settings.rt
    replayed = replay_poses(data.site, rt, link, pose, engine=engine or rt.engine, progress=progress)
    source = data.site.towers[tower].position_m
    if tower in data.nodes:
        notes.append(f"{tower} moves: it was at {source[0]:.1f} m east, {source[1]:.1f} m north, {source[2]:.1f} m up")
    losses = path_losses(data.site, rt, link.carrier_hz)
    further = {name: loss(replayed.paths, source[None], pose.position_m) for name, loss in losses.items()}
    if replayed.paths.terrain_db.any():
        further["terrain"] = replayed.paths.terrain_db
    paths = explain_paths(replayed.paths, replayed.faces, source, pose, link, further)
    if isinstance(series, RssSeries) and settings.rss.field != "coherent":
        notes.append(f"rss.csv has rss.field: {settings.rss.field}; the level here is the coherent sum")
    if paths and np.isnan(replayed.rss_dbm[0, 0]):
        notes.append(f"out of coverage: the coherent sum is below the noise floor of {link.noise_floor_dbm:.1f} dBm")
    notes += further_path_lines(replayed, np.asarray(source), pose, link)
    measured = float(series.measured_db[at]) if isinstance(series, RssSeries) and len(series.log) else None
    return Explanation(
        flight=settings.flight.name,
        tower=tower,
        channel=series.channel,
        time_utc=str(iso_time(series.time[at])),
        time_s=seconds,
        position_m=tuple(float(x) for x in pose.position_m[0]),  # type: ignore[arg-type]
        transmit_power_dbm=link.transmit_power_dbm,
        carrier_hz=link.carrier_hz,
        engine=replayed.engine,
        paths=paths,
        level_dbm=float(replayed.rss_dbm[0, 0]),
        power_sum_dbm=power_sum_dbm(paths) if paths else float("nan"),
        measured_db=measured,
        unit=series.unit if isinstance(series, RssSeries) else "",
        absent=tuple(_absent(replayed, source, pose.position_m[0])),
        notes=(*data.cautions, *notes, *(f"not modelled: {what}" for what in replayed.left_out)),
    )


def _series(data: FlightData, tower: str, channel: str | None) -> RssSeries | RankSeries:
    every = [series for _, series in data.series]
    towers = list(dict.fromkeys(series.tower for series in every))
    mine = {series.channel: series for series in reversed(every) if series.tower == tower}
    if not mine and tower in data.site.towers and data.track is not None:
        return _unlogged(data, tower, channel)
    if not mine:
        known = dict.fromkeys(towers if data.track is None else [*towers, *data.site.towers])
        raise UsageError(f"no log of tower {tower!r}", expected="one of " + ", ".join(known), cause="a typing error")
    if channel is None:
        return mine[list(mine)[-1]]
    if channel not in mine:
        raise UsageError(f"no channel {channel!r} at {tower}", expected="one of " + ", ".join(reversed(mine)))
    return mine[channel]


def _unlogged(data: FlightData, tower: str, channel: str | None) -> RssSeries:
    """Return a series without levels, one sample per second of telemetry, for a tower without a log in the flight."""
    assert data.track is not None
    links = {"rss": data.settings.link.rss, **data.settings.link.channels}
    name = channel or "rss"
    if name not in links:
        raise UsageError(f"no link {name!r}, and no log of {tower}", expected="one of " + ", ".join(links))
    time = np.arange(data.track.start_ns, data.track.end_ns + 1, 1_000_000_000).astype("datetime64[ns]")
    none = np.zeros(0, dtype=np.int64)
    return RssSeries(
        tower=tower, channel=name, unit="dBm", time=time, measured_db=np.full(len(time), np.nan), link=links[name],
        settings_key=name, log=none, line=none,
    )  # fmt: skip


def _sample(series: RssSeries | RankSeries, time: str, zone: str | None) -> tuple[int, float]:
    """Return the index of the sample nearest to a time, and its seconds after the first sample."""
    first, last = series.time.min(), series.time.max()
    span = float((last - first) / np.timedelta64(1, "s"))
    instant = _instant(time, first, zone)
    step = span / max(len(series.time) - 1, 1)
    after_s = float((instant - first) / np.timedelta64(1, "s"))
    if not -max(step, 1.0) <= after_s <= span + max(step, 1.0):
        raise UsageError(
            f"--time {time} is {abs(after_s) if after_s < 0 else after_s - span:.1f} s "
            f"{'before the first' if after_s < 0 else 'after the last'} sample of {series.tower}",
            expected=f"0 to {span:.1f} s, or {iso_time(first)} to {iso_time(last)}",
        )
    at = int(np.argmin(np.abs(series.time - instant)))
    return at, float((series.time[at] - first) / np.timedelta64(1, "s"))


def _instant(text: str, first: Any, zone: str | None) -> Any:
    try:
        seconds = float(text)
    except ValueError:
        seconds = float("nan")
    if np.isfinite(seconds) and abs(seconds) < 1e9:
        return first + np.timedelta64(round(1e9 * seconds), "ns")
    try:
        parsed = datetime.fromisoformat(text.strip().replace("Z", "+00:00"))
    except ValueError:
        raise UsageError(
            f"--time {text!r}",
            expected="seconds after the tower's first sample (12.5), or a time such as 2025-06-01T14:00:05.5Z",
        ) from None
    if parsed.tzinfo is None:
        parsed = parsed.replace(tzinfo=ZoneInfo(zone or "UTC"))
    return np.datetime64(parsed.astimezone(timezone.utc).replace(tzinfo=None), "ns")


def _pose(
    data: FlightData, series: RssSeries | RankSeries, at: int, progress: Progress
) -> tuple[Link, Poses, list[str], Times]:
    """Return the link and pose that the report uses for a sample, notes, and the time (1,) on the telemetry clock."""
    notes: list[str] = []
    if isinstance(series, RssSeries):
        time = series.time
        if not len(series.log):
            notes.append(
                f"the flight has no log of {series.tower}: times are those of the telemetry, settings those of "
                f"link {series.channel!r}, and nothing was measured"
            )
        elif data.settings.rss.lag == "apply" or isinstance(data.settings.rss.lag, float):
            receiver = tuple(s for s in data.rss if s.tower == series.tower)  # each receiver has a separate clock
            clocks = estimate_clocks(dataclasses.replace(data, rss=receiver), progress)
            clock = clocks[[s is series for s in receiver].index(True)]
            time = telemetry_time(time, clock)
            if clock is not None and clock.applied_s:
                notes.append(f"{clock.applied_s:.3f} s are subtracted from the radio's clock")
        track = data.poses_at(time[at : at + 1])
        _check_pose(track.valid, series, at)
        return data.link_of(series), valid_poses(track, data.settings.rss_attitude), notes, time[at : at + 1]
    link = data.link_of(series)
    poses, valid, _ = rank_poses(data, series)
    _check_pose(valid[at : at + 1], series, at)
    row = int(valid[:at].sum())
    return link, poses[row : row + 1], notes, series.time[at : at + 1]


def _check_pose(valid: Any, series: RssSeries | RankSeries, at: int) -> None:
    if not valid[0]:
        raise UsageError(
            f"no pose is known at {iso_time(series.time[at])}",
            expected="a time with telemetry",
            cause="the telemetry starts later, ends earlier or has a gap (rt.advanced.maximum_gap_s)",
        )


def _absent(replayed: Replay, source: FloatArray, target: FloatArray) -> Iterator[tuple[str, str]]:
    traced = {tuple(row[row >= 0].tolist()) for row in replayed.paths.faces}
    otherwise = "possible by geometry, but blocked by terrain, or on the ground of another tower"
    if replayed.engine == "sionna":  # with too few rays, Sionna misses paths
        otherwise = f"not blocked, but not found with {replayed.samples} samples per tower"
    for words, sequence in simple_paths(replayed):
        if tuple(sequence.tolist()) not in traced:
            yield words, why_not(replayed.faces, source, target, sequence, replayed.surfaces) or otherwise
