"""The way from the bytes of the logs to positions, attitude and levels, walked a second time at some samples.

What is compared with is made by :mod:`tests.raw_bytes` and
:mod:`aerpaw_cmp.propagation.check.reference`, which share no code with readers, track, geodesy, antennas and replay.
Taken from this package are the settings and, per sample, which paths there are: those have an audit of their own.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from aerpaw_cmp.common.units import FloatArray, IntArray, spread_out
from aerpaw_cmp.compare.result import APPLIED, GIVEN
from aerpaw_cmp.flight.data import FlightData, RankSeries, RssSeries
from aerpaw_cmp.flight.replay import Replayed, attitude_rotation
from aerpaw_cmp.flight.settings import LogSettings
from aerpaw_cmp.logs.ingest import IngestedFile
from aerpaw_cmp.propagation.check.audit import Expected
from aerpaw_cmp.propagation.check.reference import Mirror, Reference
from aerpaw_cmp.site.site import Tower
from tests.raw_bytes import LOWEST_M, Log, Matrix, Pose, RawPath, Reading, east_north_m, level, read_log

# Of all RSS series together, at least three of each; and moments of the track between its rows.
SAMPLES = 48

# Largest differences by kind, with the unit. Coherent levels have more in fades, as much as 0.01 rad does there.
_TOLERANCES = {
    "time": (1e-3, "s"), "position": (0.005, "m"), "rotation": (1e-5, "rad"), "measured level": (1e-3, "dB"),
    "simulated level": (0.01, "dB"), "tower": (0.005, "m"), "rank": (0.5, ""),
}  # fmt: skip


@dataclass(slots=True)
class Account:
    """Worst difference by kind with its place, how many were compared, and how many failed."""

    count: dict[str, int] = field(default_factory=dict)
    worst: dict[str, tuple[float, str]] = field(default_factory=dict)
    failed: dict[str, int] = field(default_factory=dict)
    broken: list[str] = field(default_factory=list)

    def add(self, kind: str, difference: float, where: str, spare: float = 0.0) -> None:
        """Add one comparison, where NaN is a failure. ``spare`` is added to the tolerance."""
        off = difference if math.isfinite(difference) else math.inf
        self.count[kind] = self.count.get(kind, 0) + 1
        self.failed[kind] = self.failed.get(kind, 0) + (off > _TOLERANCES[kind][0] + spare)
        if off > self.worst.get(kind, (-1.0, ""))[0]:
            self.worst[kind] = (off, where)

    def most(self, kind: str) -> float:
        """Largest difference of a kind."""
        return self.worst.get(kind, (0.0, ""))[0]

    @property
    def failures(self) -> list[str]:
        """Return what is out of tolerance, with the worst position of each kind."""
        lines = [
            f"{kind} differs by {self.worst[kind][0]:.3g} {_TOLERANCES[kind][1]} at {self.worst[kind][1]} ({count} differ)"
            for kind, count in self.failed.items()
            if count
        ]
        return [*lines, *self.broken]


def raw_checked(data: FlightData, replays: Sequence[Replayed], expected: Sequence[Expected]) -> Account:
    """Positions, datum, attitude, readings and levels of some samples, from the bytes of the logs.

    Parameters
    ----------
    data : FlightData
    replays : sequence of Replayed
        Of its RSS series, then of its ranks.
    expected : sequence of Expected
        The settings of each replay, read a second time.

    Returns
    -------
    Account
        The numbers, and what is out of tolerance.
    """
    account = Account()
    logs = [_log(data, *pair) for pair in zip(data.settings.logs, data.files, strict=True)]
    towers = _towers_checked(data, account)
    path = _path(data, logs)
    if path is not None:
        _track_checked(data, path, account)
    each = max(3, SAMPLES // max(len(data.rss), 1))
    for series, replayed, expectation in zip(data.rss, replays, expected, strict=False):
        rows = _spread(replayed, path, series, each)
        reference = _reference(data, replayed, expectation, towers, series.tower)
        check = _Series(data=data, series=series, replayed=replayed, path=path, reference=reference, account=account)
        check.readings(logs, rows)
        check.poses_and_levels(rows)
    for rank in data.rank:
        _rank_checked(data, rank, logs, path, account)
    return account


# ---------------------------------------------------------------- bytes


def _log(data: FlightData, settings: LogSettings, file: IngestedFile) -> Log | None:
    """Read a log of the flight a second time. Return None if the flight file specifies its times or columns."""
    zone = "UTC" if settings.clock == "utc" else settings.timezone or data.settings.timezone
    content = (data.folder / settings.path).read_bytes()
    assert hashlib.sha256(content).hexdigest() == file.sha256, "the report names its inputs by their hash"
    stated = zone is None or settings.time_origin or settings.columns
    return None if stated else read_log(content, zone)


def _path(data: FlightData, logs: Sequence[Log | None]) -> RawPath | None:
    """The flight between the rows of the first telemetry log."""
    for settings, file, log in zip(data.settings.logs, data.files, logs, strict=True):
        if not any(s.kind == "telemetry" and s.name not in settings.skip for s in file.result.streams):
            continue
        if log is None or not log.rows or settings.height_m is not None:
            return None
        origin = data.site.frame.latitude_deg, data.site.frame.longitude_deg
        jumped = _flagged_us(file, "position_jump")
        rows = [row for row in log.rows if row.time_us not in jumped]
        takeoff_m = float(_site_file(data)["origin"].get("takeoff_ground_m", 0.0))
        path = RawPath(rows, origin, takeoff_m, lambda *at: float(data.site.ground_under_m(*np.array(at)[:, None])[0]))
        assert path.rows
        assert not path.out_of_order
        return path
    return None


def _flagged_us(file: IngestedFile, flag: str) -> set[int]:
    """Times [us] of rows that carry a flag."""
    frames = [stream.frame for stream in file.result.streams]
    marked = [frame["time"][frame["flag"].str.contains(flag)] for frame in frames]
    return {int(at) for times in marked for at in times.to_numpy("datetime64[us]").astype(np.int64)}


# ---------------------------------------------------------------- site


def _site_file(data: FlightData) -> Mapping[str, Any]:
    """The site's file, as YAML and no more."""
    import yaml

    name = data.settings.site.file
    path = data.folder / name
    if not path.is_file():
        path = Path(str(resources.files("aerpaw_cmp.site"))) / "data" / f"{name}.yaml"
    return dict(yaml.safe_load(path.read_bytes()))


def _towers_checked(data: FlightData, account: Account) -> dict[str, Tower]:
    """Towers of the site a second time, by name."""
    content, choice = _site_file(data), data.settings.site
    center = (content["origin"]["latitude_deg"], content["origin"]["longitude_deg"])
    out = {}
    for name, tower in content["towers"].items():
        known = tower.get("positions")
        coordinates = choice.coordinates or content.get("coordinates") or next(iter(known or {}), "")
        place = known[coordinates] if known else tower
        east, north = east_north_m(place["latitude_deg"], place["longitude_deg"], center)
        height = tower.get("antenna_height_m") or place.get("antenna_height_m") or 10.0
        height = float(choice.antenna_height_m or height)
        ours = data.site.towers[name]
        apart_m = float(np.linalg.norm(ours.position_m - np.array([east, north, height])))
        account.add("tower", apart_m, f"tower {name}", spare=1e-6 * math.hypot(east, north))
        out[name] = replace(ours, east_m=east, north_m=north, ground_m=0.0, antenna_height_m=height)
    return out


def _reference(
    data: FlightData, replayed: Replayed, expected: Expected, towers: Mapping[str, Tower], tower: str
) -> Reference:
    """The second implementation of a link, with the tower where the second way has it."""
    assert replayed.tower_m is None
    assert tower in towers
    site = replace(data.site.under(data.settings.rt.foliage), towers={tower: towers[tower]})
    return Reference(site, tower, expected.link, expected.loss)


# ---------------------------------------------------------------- track


def _track_checked(data: FlightData, path: RawPath, account: Account) -> None:
    """Poses of the track between its rows, where a turn that is held or late shows."""
    assert data.track is not None
    rows = np.unique(np.linspace(0, len(path.times_us) - 2, SAMPLES).round().astype(np.int64)).clip(0)
    steps = [(path.times_us[i], path.times_us[min(i + 1, len(path.times_us) - 1)]) for i in rows.tolist()]
    moments = [int(start + share * (end - start)) for start, end in steps for share in (0.25, 0.75)]
    times = np.array(moments, dtype="datetime64[us]").astype("datetime64[ns]")
    track = data.track.pose_at(times)
    turns = attitude_rotation(track, "logged")
    for at, moment in enumerate(moments):
        pose = path.pose(moment)
        if pose is not None and track.valid[at]:
            known = turns[at] if track.attitude_known[at] else None
            _pose_checked(pose, track.position_m[at], known, f"{times[at]} UTC", account)


def _pose_checked(pose: Pose, place: FloatArray, turn: FloatArray | None, where: str, account: Account) -> None:
    spare = 1e-6 * math.hypot(*pose.place_m[:2])
    account.add("position", math.dist(pose.place_m, place.tolist()), where, spare=spare)
    if turn is not None and pose.turn is not None:
        account.add("rotation", float(np.abs(np.array(pose.turn) - turn).max()), where)


def _spread(replayed: Replayed, path: RawPath | None, series: RssSeries, count: int) -> IntArray:
    """Samples with a pose, evenly spread, of each two neighbours the one that lies further from telemetry rows."""
    rows = np.flatnonzero(replayed.valid)
    picked = rows[spread_out(len(rows), count)]
    if path is None or not len(picked):
        return np.asarray(picked)
    times = np.asarray(path.times_us, dtype=np.float64)
    stamp = series.time.astype("datetime64[us]").astype(np.int64)

    def away(row: int) -> float:
        return float(np.abs(times - stamp[row]).min())

    last = rows[-1]
    return np.array([max((r for r in (row, row + 1) if r <= last and replayed.valid[r]), key=away) for row in picked])


# ---------------------------------------------------------------- RSS


@dataclass(frozen=True, slots=True, kw_only=True)
class _Series:
    """One RSS series and its replay, against the second way."""

    data: FlightData
    series: RssSeries
    replayed: Replayed
    path: RawPath | None
    reference: Reference
    account: Account

    @property
    def name(self) -> str:
        return f"{self.series.tower} {self.series.channel}"

    def readings(self, logs: Sequence[Log | None], rows: IntArray) -> None:
        """Times and levels of samples against the lines that they name."""
        series, account = self.series, self.account
        for row in rows.tolist() if len(series.log) else ():
            number, line = int(series.log[row]), int(series.line[row])
            log, settings = logs[number], self.data.settings.logs[number]
            reading = None if log is None else log.readings.get(line)
            if log is None or not log.readings:
                continue
            where = f"{settings.path}:{line}"
            if reading is not None and not reading.values:
                continue  # a line that stands for repeated samples
            value = None if reading is None else _value(reading, series, settings)
            if reading is None or value is None:
                raise AssertionError(f"no column of {settings.path} is known to be the level of {self.name}")
            if settings.node is not None and settings.node != series.tower and not settings.cells:
                account.broken.append(f"{settings.path} is of {settings.node}, not of {series.tower}")
            stamp = int(series.time[row].astype("datetime64[us]").astype(np.int64))
            account.add("time", abs(stamp - reading.time_us) * 1e-6, where)
            measured = float(series.measured_db[row])
            if value <= settings.floor_db:
                account.add("measured level", 0.0 if math.isnan(measured) else math.inf, where)
            else:
                account.add("measured level", abs(measured - value), where, spare=1e-6 * abs(value))

    def poses_and_levels(self, rows: IntArray) -> None:
        """Poses on the telemetry's clock, and the levels that arrays and paths give there."""
        if self.path is None:
            return
        mode, place = self.data.settings.rt.attitude, np.cumsum(self.replayed.valid) - 1
        for row in rows.tolist():
            pose = self.path.pose(self._telemetry_us(row))
            if pose is None:
                continue
            at, where = int(place[row]), f"{self.name}, sample {row}"
            turn = _as_asked(pose, mode)
            ours = self.replayed.poses.rotation[at] if turn is not None else None
            _pose_checked(replace(pose, turn=turn), self.replayed.poses.position_m[at], ours, where, self.account)
            if turn is not None:
                self._level(self.reference, at, replace(pose, turn=turn), where)

    def _telemetry_us(self, row: int) -> float:
        """Instant of a sample on the telemetry's clock: the radio's clock shows later times where it is ahead."""
        stamp = float(self.series.time[row].astype("datetime64[us]").astype(np.int64))
        clock = self.replayed.clock
        if clock is None or clock.result.applied not in (APPLIED, GIVEN):
            return stamp
        return stamp - clock.result.radio_minus_telemetry_s * 1e6

    def _level(self, reference: Reference, at: int, pose: Pose, where: str) -> None:
        """Level of direct and ground path, where the replay has no others."""
        replay = self.replayed.replay
        mine = np.flatnonzero(replay.paths.pose == at)
        faces = replay.paths.faces[mine]
        grounds = np.zeros(len(mine), dtype=np.bool_)
        for n, row in enumerate(faces):
            grounds[n] = all(face < 0 or replay.faces.solid[face] < 0 for face in row.tolist())
        assert len(mine)
        assert grounds.all()
        assert (replay.paths.depth[mine] <= 1).all()
        ground = next(m for m in reference.mirrors if m.solid < 0)
        paths = []
        for depth in replay.paths.depth[mine].tolist():
            sequence: tuple[Mirror, ...] = (ground,) * depth
            loss = reference.loss_db(sequence, pose.place_m)
            assert loss is not None
            paths.append((sequence, loss))
        assert pose.turn is not None
        h, power = reference.matrix(paths, pose.place_m, pose.turn)
        link = reference.link
        coherent = float((np.abs(h) ** 2).mean())
        for ours, value in ((replay.rss_dbm, coherent), (replay.rss_power_dbm, power)):
            ours_dbm = float(ours[at, 0])
            expected = 10 * math.log10(value) + link.transmit_power_dbm if value > 0 else -math.inf
            assert expected > link.noise_floor_dbm + 0.1
            spare = 20 * math.log10(1 + 0.01 * math.sqrt(power / value)) if value < power else 0.0
            self.account.add("simulated level", abs(ours_dbm - expected), where, spare=spare)


def _value(reading: Reading, series: RssSeries, log: LogSettings) -> float | None:
    """The value of a reading that is a series' level."""
    values = {name.lower(): value for name, value in reading.values.items()}
    if set(values) == {""}:
        return values[""]
    if log.channel is not None or log.columns:
        return None
    channel = series.channel.lower()
    merged = {"usrp1": "mpower1", "usrp2": "mpower2", "power": "mpower", "quality": "mquality"}
    for name in (merged.get(channel, channel), f"{channel}_{series.tower.lower()}"):
        if name in values:
            return values[name]
    return None


def _as_asked(pose: Pose, mode: str) -> Matrix | None:
    """Return the rotation according to ``rt.attitude``, or None if the log has none."""
    if mode == "ignored":
        return ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    return level(pose.turn) if mode == "level" and pose.turn is not None else pose.turn


# ---------------------------------------------------------------- rank


def _rank_checked(
    data: FlightData, series: RankSeries, logs: Sequence[Log | None], path: RawPath | None, account: Account
) -> None:
    """Rank and position of samples against the lines of a table that holds both, found by their times."""
    for number in np.unique(series.log).tolist():
        log, settings = logs[number], data.settings.logs[number]
        readings = {} if log is None else {reading.time_us: reading for reading in log.readings.values()}
        rows = np.flatnonzero(series.log == number)
        stamps = series.time[rows].astype("datetime64[us]").astype(np.int64)
        some = spread_out(len(rows), SAMPLES // 4)
        names = [name for name in ("nr ri", "lte ri", "ri", "pdsch_rank") if readings and name in _names(log)]
        if not names or settings.ri_base == "zero":
            continue
        for at in some.tolist():
            where, row = f"{settings.path}, rank sample {rows[at]}", int(rows[at])
            reading = readings.get(int(stamps[at]))
            if reading is None:
                account.add("time", math.inf, where)
                continue
            written, ours = reading.values.get(names[0], math.nan), float(series.rank[row])
            account.add("rank", 0.0 if math.isnan(ours) and not written >= 1 else abs(ours - written), where)
            if series.position_m is not None and path is not None and "latitude" in reading.values:
                place = (reading.values["latitude"], reading.values["longitude"])
                east, north = east_north_m(*place, path.origin_deg)
                up = max(path.ground_m + reading.values["altitude"], path.floor(east, north) + LOWEST_M)
                distance_m = math.dist((east, north, up), series.position_m[row].tolist())
                account.add("position", distance_m, where, spare=1e-6 * math.hypot(east, north))


def _names(log: Log | None) -> set[str]:
    """Columns of a table."""
    first = next(iter(log.readings.values()), None) if log is not None else None
    return set() if first is None else set(first.values)
