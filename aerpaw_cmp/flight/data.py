"""From a checked flight file to the data of one flight: site, logs, track, RSS and rank series."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from ..common.errors import InputError, UsageError
from ..common.units import MINIMUM_HEIGHT_M, BoolArray, FloatArray
from ..logs.ingest import IngestedFile, ingest, read_bytes
from ..logs.readers import HEAD_BYTES, Reader, by_name, catalogue
from ..logs.records import Stream
from ..site.site import Site
from ..site.siteyaml import load_site
from .clock import clock_trap
from .settings import FlightFile, LinkSettings, LogSettings, SiteChoice
from .track import Track

Times = NDArray[np.datetime64]


@dataclass(frozen=True, slots=True)
class RssSeries:
    """Measured RSS of one tower and channel: ``time`` (n,) UTC, ``measured_db`` (n,), NaN = out of coverage."""

    tower: str
    channel: str
    unit: str
    time: Times
    measured_db: FloatArray
    link: LinkSettings
    settings_key: str
    """Equal for series whose link settings are equal: they share a replay."""


@dataclass(frozen=True, slots=True)
class RankSeries:
    """Reported rank at a tower: ``rank`` (n,) with NaN for no CSI, ``position_m`` (n, 3) or None (then the track)."""

    tower: str
    time: Times
    rank: FloatArray
    sinr_db: FloatArray
    position_m: FloatArray | None


@dataclass(frozen=True, slots=True)
class FlightData:
    """Everything the comparison needs, nothing replayed yet."""

    settings: FlightFile
    folder: Path
    """Where logs and antenna files resolve: ``--logs-root``, else the folder of the flight file."""
    site: Site
    files: tuple[IngestedFile, ...]
    track: Track | None
    rss: tuple[RssSeries, ...]
    rank: tuple[RankSeries, ...]
    warnings: tuple[str, ...]


def choose_site(choice: SiteChoice, folder: Path) -> Site:
    """The site of a flight, with the flight's own changes."""
    name = choice.file
    path = folder / name
    site = load_site(path if path.is_file() else name, coordinates=choice.coordinates)
    if choice.antenna_height_m is not None:
        towers = {
            key: dataclasses.replace(tower, antenna_height_m=choice.antenna_height_m)
            for key, tower in site.towers.items()
        }
        site = dataclasses.replace(site, towers=towers)
    if choice.without_buildings:
        note = "this flight is replayed without the buildings of the site (site.without_buildings)"
        site = dataclasses.replace(site, buildings=(), notes=(*site.notes, note))
    return site


def read_logs(settings: FlightFile, folder: Path, logs_root: Path | None = None) -> tuple[IngestedFile, ...]:
    """Every log of the flight file, in its order.

    Raises
    ------
    InputError
        A missing file, a log of another kind than the flight file says, a log without any record.
    """
    files = []
    for log in settings.logs:
        path = (logs_root or folder) / log.path
        if not path.exists():
            root = logs_root or folder
            raise InputError(
                "there is no such log",
                expected=f"the file below {root}",
                cause="a wrong path, or --logs-root",
                path=path,
            )
        reader = None if log.reader is None else by_name(log.reader)
        if reader is not None:
            _refuse_other_kind(path, reader)
        (file,) = ingest([path], options=log.options(settings.timezone), reader=log.reader)
        if not file.result.streams:
            raise InputError(
                "no record could be read",
                expected=f"records of reader {file.result.reader!r}",
                cause=file.result.rejected[0].reason if file.result.rejected else "an aborted run",
                path=path,
            )
        files.append(file)
    return tuple(files)


def _refuse_other_kind(path: Path, reader: Reader) -> None:
    """A log whose content another reader recognises, and the named one does not, is the wrong file."""
    head = read_bytes(path)[0][:HEAD_BYTES]
    others = [r.name for r in catalogue() if r.sniff(head)]
    if not others or reader.name in others:
        return
    raise InputError(
        f"the content is that of {' or '.join(others)}",
        expected=f"a log of reader {reader.name!r}, as flight.yaml says",
        cause="the wrong file, or the wrong 'reader:'",
        path=path,
    )


RATIOS = ("quality", "snr")
"""Streams or channels of kind rss that are no levels, as sounder and controller name them."""


def is_ratio(stream: Stream) -> bool:
    """Whether a stream of kind rss is a ratio to the noise."""
    names = (stream.name, _text(stream, "channel"), _text(stream, "quantity"))
    return stream.kind == "rss" and any(name is not None and name.lower() in RATIOS for name in names)


def gather(
    settings: FlightFile, folder: Path, files: Sequence[IngestedFile], logs_root: Path | None = None
) -> FlightData:
    """Sort the streams into track, RSS and rank, and check that they belong together."""
    site = choose_site(settings.site, folder)
    warnings: list[str] = []
    telemetry: list[tuple[str, Stream]] = []
    rss: list[tuple[str, RssSeries]] = []
    rank: list[tuple[str, RankSeries]] = []
    for log, file in zip(settings.logs, files, strict=True):
        warnings += [f"{log.path}: {text}" for text in file.result.warnings]
        for stream in file.result.streams:
            if stream.name in log.skip:
                continue
            if stream.kind == "telemetry":
                telemetry.append((log.path, stream))
            elif stream.kind == "rss":
                rss.append((log.path, _rss_series(settings, log, stream, site)))
            elif stream.kind == "rank":
                rank.append((log.path, _rank_series(settings, log, stream, site)))
        names = [s.name for s in file.result.streams]
        if unknown := [name for name in log.skip if name not in names]:
            warnings.append(
                f"{log.path}: nothing is skipped by {', '.join(unknown)}: its streams are {', '.join(names)}"
            )
        if ratios := [s.name for s in file.result.streams if is_ratio(s) and s.name not in log.skip]:
            shown = ", ".join(map(repr, ratios)) + (" is a ratio" if len(ratios) == 1 else " are ratios")
            warnings.append(
                f"{log.path}: {shown} to the noise, no level: compared as RSS as if the noise were constant "
                f"('skip: [{', '.join(ratios)}]' beside the path leaves it out)"
            )
    if idle := set(settings.link.channels) - {series.channel for _, series in rss}:
        warnings.append(f"link.channels names {', '.join(sorted(idle))}: no log is of such a channel")
    if len(telemetry) > 1:
        warnings.append(f"{len(telemetry)} telemetry logs; the track is that of {telemetry[0][0]}")
    track = (
        Track(
            telemetry[0][1].frame,
            site.frame,
            maximum_gap_s=settings.rt.maximum_gap_s,
            ground_m=site.datum.takeoff_ground_m,
        )
        if telemetry
        else None
    )
    data = FlightData(
        settings=settings,
        folder=logs_root or folder,
        site=site,
        files=tuple(files),
        track=track,
        rss=_records(rss, lambda s: f"RSS of {s.tower} {s.channel}"),
        rank=_records(rank, lambda s: f"rank of {s.tower}"),
        warnings=tuple(warnings),
    )
    _check_overlap(data)
    return data


def _known_tower(name: str | None, log: LogSettings, site: Site) -> str:
    if name is None:
        raise UsageError(
            f"log {log.path!r} does not say which tower it belongs to",
            expected="'node: LW1', say, beside its path in flight.yaml",
        )
    if name not in site.towers:
        raise UsageError(
            f"log {log.path!r} names tower {name!r}, which site {site.name!r} does not have",
            expected="one of " + ", ".join(site.towers),
        )
    return name


def _rss_series(settings: FlightFile, log: LogSettings, stream: Stream, site: Site) -> RssSeries:
    tower = _known_tower(log.node or _text(stream, "node"), log, site)
    channel = log.channel or _text(stream, "channel") or stream.name
    link = settings.link.channels.get(channel, settings.link.rss)
    return RssSeries(
        tower=tower,
        channel=channel,
        unit=str(stream.attributes.get("unit", "dB re full scale")),
        time=stream.frame["time"].to_numpy("datetime64[ns]"),
        measured_db=stream.frame["rss_db"].to_numpy(np.float64),
        link=link,
        settings_key=link.model_dump_json(),
    )


def _rank_series(settings: FlightFile, log: LogSettings, stream: Stream, site: Site) -> RankSeries:
    tower = _known_tower(log.node or settings.rank.tower, log, site)
    frame = stream.frame
    position = None
    if {"latitude_deg", "longitude_deg", "altitude_m"} <= set(frame.columns) and frame["latitude_deg"].notna().any():
        east, north = site.frame.to_local(frame["latitude_deg"], frame["longitude_deg"])
        up = np.fmax(frame["altitude_m"].to_numpy(np.float64), MINIMUM_HEIGHT_M)
        position = np.stack([east, north, up], axis=-1)
    sinr = frame["sinr_db"].to_numpy(np.float64) if "sinr_db" in frame else np.full(len(frame), np.nan)
    return RankSeries(
        tower, frame["time"].to_numpy("datetime64[ns]"), frame["rank"].to_numpy(np.float64), sinr, position
    )


Series = TypeVar("Series", "RssSeries", "RankSeries")


def _records(found: Sequence[tuple[str, Series]], name: Callable[[Series], str]) -> tuple[Series, ...]:
    """One series per name: logs that follow each other (a radio started anew) are one record.

    Raises
    ------
    UsageError
        If two logs hold the same at the same time: only one of them could be compared.
    """
    groups: dict[str, list[tuple[str, Series]]] = {}
    for path, series in found:
        groups.setdefault(name(series), []).append((path, series))
    return tuple(_record(what, group) for what, group in groups.items())


def _record(what: str, group: Sequence[tuple[str, Series]]) -> Series:
    if len(group) == 1:
        return group[0][1]
    parts = sorted((p for p in group if len(p[1].time)), key=lambda p: p[1].time.min()) or [group[0]]
    for (path, before), (other, after) in itertools.pairwise(parts):
        if after.time.min() < before.time.max() or _form(before) != _form(after):
            where = "two logs" if path != other else "two streams of a log"
            raise UsageError(
                f"{where} hold {what} at the same time or in another form: {path!r} and {other!r}",
                expected="one record of each channel and of each tower's rank",
                cause="a copy: leave one out, by its path or by 'skip'; another radio: give it its own 'channel'",
            )
    first = parts[0][1]
    arrays: dict[str, Any] = {
        field.name: np.concatenate([getattr(series, field.name) for _, series in parts])
        for field in dataclasses.fields(first)
        if isinstance(getattr(first, field.name), np.ndarray)
    }
    return dataclasses.replace(first, **arrays)


def _form(series: RssSeries | RankSeries) -> object:
    """What two parts of one record must share."""
    return series.unit if isinstance(series, RssSeries) else series.position_m is None


def _text(stream: Stream, key: str) -> str | None:
    value = stream.attributes.get(key)
    return None if value is None else str(value)


def _check_overlap(data: FlightData) -> None:
    if not data.rss and not data.rank:
        raise UsageError(
            "none of the logs holds RSS or rank",
            expected="at least one radio log under 'logs'",
            cause="'skip', or a log left out",
        )
    needs_track = [("RSS", s.tower, s.time) for s in data.rss] + [
        ("rank", s.tower, s.time) for s in data.rank if s.position_m is None
    ]
    if needs_track and data.track is None:
        raise UsageError(
            f"{needs_track[0][0]} of {needs_track[0][1]} has no positions of its own and there is no telemetry log",
            expected="a telemetry log (vehicle_out, say) under 'logs'",
        )
    for kind, tower, time in needs_track:
        assert data.track is not None
        start, end = np.datetime64(data.track.start_ns, "ns"), np.datetime64(data.track.end_ns, "ns")
        if len(time) == 0 or time.min() > end or time.max() < start:
            shown = f"{pd.Timestamp(time.min())} .. {pd.Timestamp(time.max())}" if len(time) else "no samples"
            flown = f"{pd.Timestamp(start)} .. {pd.Timestamp(end)}"
            raise InputError(
                f"no overlap in time: {kind} of {tower} spans {shown}, telemetry {flown} (UTC)",
                expected="logs of the same flight",
                cause=_clock_cause(data, time, start, end),
            )


def _clock_cause(data: FlightData, time: Times, start: np.datetime64, end: np.datetime64) -> str:
    trap = None
    if len(time):
        trap = clock_trap((time.min(), time.max()), (start, end), data.settings.timezone)
    if trap is None:
        return "logs of different flights, or a wrong 'timezone' or 'clock'"
    return f"{trap.explanation}; try 'clock: local_as_utc', 'clock: local' or 'clock: utc' beside the log"


def rank_positions(series: RankSeries, track: Track | None) -> tuple[FloatArray, BoolArray]:
    """Positions (n, 3) [m] and which of them are known."""
    if series.position_m is not None:
        return series.position_m, np.asarray(np.isfinite(series.position_m).all(axis=1))
    assert track is not None
    pose = track.pose_at(series.time)
    return pose.position_m, pose.valid
