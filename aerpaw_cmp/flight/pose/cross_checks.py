"""Questions about logs: what names, files beside them, clocks or the ground contradict; what is assumed."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from datetime import datetime, timedelta, tzinfo
from datetime import timezone as zones
from pathlib import Path, PurePosixPath
from zoneinfo import ZoneInfo

import numpy as np

from ...common.errors import InputError
from ...common.units import AnyArray
from ...logs.files import archives
from ...logs.ingest import IngestedFile, read_bytes
from ...logs.jumps import PLACE, jumps_of
from ...logs.records import Stream, has_wall_clock
from ...site.site import Site
from .grouping import stream_span
from .track import Track

_IN_NAME = re.compile(
    r"(?<!\d)(20\d\d)[-_]?([01]\d)[-_]?([0-3]\d)(?:[T_ -]([0-2]\d)[-_:]?([0-5]\d)(?:[-_:]?([0-5]\d))?)?(?!\d)"
)
_NEMO_START = re.compile(r"^Measurement start;(\d{4} \w{3} \d\d \d\d:\d\d)", re.MULTILINE)

# A name with a date alone may be local or UTC, and of the start or the end.
_OF_THE_DAY = timedelta(hours=36)

# A program is started before its radio is.
_OF_THE_MINUTE = timedelta(minutes=15)

# A track whose lowest height [m] is farther from 0 does not begin at its take-off.
_GROUND_M = 5.0


def questions(file: IngestedFile, streams: Sequence[Stream], timezone: str | None) -> list[str]:
    """Questions of a draft about the streams of a log that it keeps, each with both values.

    Parameters
    ----------
    file : IngestedFile
    streams : sequence of Stream
    timezone : str or None
        Of clocks without a zone.
    """
    texts = []
    start = _start(streams)
    if start is not None:
        zone = ZoneInfo(timezone) if timezone else None
        starts = _name_starts(file.path)
        # names of a flight file are those of the machine that made it
        if not file.holder:  # else a path that the flight file names, of another machine
            starts += _summary_starts(Path(file.path))
        texts += [
            f"{where} says {time:{form}}, the log begins at {start:%Y-%m-%d %H:%M} UTC: which is right?"
            for where, time, form, slack in starts
            if _apart(time, start, zone, exact=slack == _OF_THE_MINUTE) > slack
        ]
        if any(s.attributes.get("clock_from") == "assumed" for s in streams):
            texts.append(f"the times are read as {_source(streams, 'clock') or 'local wall time'}: right?")
    if any(s.attributes.get("height_from") == "assumed" for s in streams):
        texts.append(f"the heights are read as {_source(streams, 'height') or 'above take-off'}: right?")
    for stream in streams:
        sentence = "" if (jumps := jumps_of(stream))[0].any() else jumps[1]
        # a draft is checked by its lines that end in a question mark
        texts += [f"{sentence.rstrip('?')}?"] if sentence else []
        if stream.kind == "telemetry" and (low := _lowest_m(stream)) is not None and abs(low) > _GROUND_M:
            texts.append(f"the lowest height is {low:.0f} m, expected 0 m: does the track begin in the air?")
    return list(dict.fromkeys(texts))


# Nothing flown here goes higher; a lowest height above it is one of another datum [m].
_TOO_HIGH_M = 150.0

# Radios are started within this of the telemetry; a whole number of hours apart, a zone is wrong.
_TOGETHER_S = 90.0

_MANY_WITHOUT_POSE = 0.1


def doubts(
    track: Track, telemetry: Stream, series: Sequence[tuple[str, AnyArray]], undated: Sequence[str] = ()
) -> tuple[str, ...]:
    """Clauses on clocks and heights that the first words of a report repeat.

    Parameters
    ----------
    track : Track
    telemetry : Stream
        That it was made from.
    series : sequence of (str, (n,) datetime64)
        Names and times of what is compared on the track.
    undated : sequence of str
        Logs with positions whose times the flight file dates, beside telemetry with a clock.

    Returns
    -------
    tuple of str
    """
    apart: dict[int, list[str]] = {}
    poseless: dict[str, float] = {}
    for name, time in ((name, time) for name, time in series if len(time)):
        late_s = float((time.min() - np.datetime64(track.start_ns, "ns")) / np.timedelta64(1, "s"))
        hours = round(late_s / 3600.0)
        if hours and abs(late_s - 3600.0 * hours) < _TOGETHER_S:
            apart.setdefault(hours, []).append(name)
        if (without := float(np.mean(~track.pose_at(time).valid))) > _MANY_WITHOUT_POSE:
            poseless[name] = without
    texts = [
        f"{_listed(names)} begins {hours:+d} h from the telemetry, as with a wrong time zone"
        for hours, names in apart.items()
    ]
    if poseless:
        texts.append(f"{max(poseless.values()):.0%} of the samples of {_listed(list(poseless))} have no position")
    if undated:
        texts.append(f"{_listed(undated)} has no clock: by its positions it may be of another flight on this route")
    low_m, assumed = _lowest_m(telemetry), telemetry.attributes.get("height_from") == "assumed"
    if low_m is not None and (low_m > _TOO_HIGH_M or (assumed and abs(low_m) > _GROUND_M)):
        texts.append(f"the lowest height above take-off is {low_m:.0f} m, probably above another datum")
    return tuple(texts)


# A flight has samples below this height above its take-off [m]; else its heights count from the sea.
_FLOWN_M = 300.0

# Heights that begin within this of the site's ground above the sea probably count from the sea [m].
_NEAR_GROUND_M = 50.0

# A UAV at rest: for this long it does not move by more than this [s, m], and then it climbs [m].
_REST_S, _REST_M, _CLIMB_M = 5.0, 0.5, 5.0


def check_heights(site: Site, path: str, telemetry: Stream) -> tuple[str, ...]:
    """Check that the heights of a flight count from its take-off, and not from the sea.

    Parameters
    ----------
    site : Site
    path : str
        Path of the log, for the message.
    telemetry : Stream

    Returns
    -------
    tuple of str
        A clause for the first words of a report if the lowest height is about that of the site's ground above the sea.

    Raises
    ------
    InputError
        If no sample is below :data:`_FLOWN_M`, or if the UAV rests and takes off at about the height of the site's
        ground above the sea.
    """
    low_m, sea_m = _lowest_m(telemetry), site.ground_above_sea_m
    if low_m is None or "takeoff_from" in telemetry.attributes:
        return ()
    low_m += site.takeoff_ground_m
    near = sea_m is not None and low_m > _GROUND_M and abs(low_m - sea_m) < _NEAR_GROUND_M
    if low_m > _FLOWN_M or (near and _takes_off(telemetry)):
        ground = "the ground of the take-off above the sea [m]" if sea_m is None else f"the ground is {sea_m:g} m up"
        raise InputError(
            f"the lowest height above take-off is {low_m:.0f} m",
            expected=f"samples below {_FLOWN_M:.0f} m, or a log that begins on the ground",
            cause="heights above sea level that are read as above take-off: "
            f"write 'takeoff_ground_m: {-(low_m if sea_m is None else sea_m):.0f}' under 'origin:' of the site "
            f"file (minus {ground}), or add the rows of the take-off to the log",
            path=path,
        )
    if near:
        return (
            f"the lowest height above take-off is {low_m:.0f} m, about the ground of the site above the sea "
            f"({sea_m:.0f} m): if the heights count from the sea, write 'takeoff_ground_m: {-(sea_m or 0.0):.0f}' "
            "under 'origin:' of the site file",
        )
    return ()


def _takes_off(telemetry: Stream) -> bool:
    """Check whether a track begins with a UAV at rest that then climbs."""
    frame = telemetry.frame.dropna(subset=["time", *PLACE])
    if len(frame) < 2:
        return False
    latitude, longitude, height = (frame[name].to_numpy(np.float64) for name in PLACE)
    seconds = (frame["time"].to_numpy() - frame["time"].to_numpy()[0]) / np.timedelta64(1, "s")
    first = seconds <= _REST_S
    moved = np.hypot(latitude - latitude[0], (longitude - longitude[0]) * np.cos(np.radians(latitude[0]))) * 111_000.0
    still = np.maximum(moved, np.abs(height - height[0]))[first].max() <= _REST_M and first.sum() > 2
    return bool(still and height.max() > height[0] + _CLIMB_M and height.min() > height[0] - _CLIMB_M)


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{names[0]} (and {len(names) - 1} more)"


def _start(streams: Sequence[Stream]) -> datetime | None:
    """First time (UTC) of some streams; None without a wall clock."""
    first = min((span[0] for stream in streams if (span := stream_span(stream)) is not None), default=None)
    if first is None or not has_wall_clock(first):
        return None
    start: datetime = first.astype("datetime64[us]").item().replace(tzinfo=zones.utc)
    return start


def _name_starts(path: str) -> list[tuple[str, datetime, str, timedelta]]:
    """Date, or date and time, in the name of a file."""
    starts = []
    for match in _IN_NAME.finditer(Path(path).name):
        parts = [int(part) for part in match.groups() if part is not None]
        try:
            time = datetime(*parts, tzinfo=zones.utc)  # type: ignore[misc, arg-type]
        except ValueError:
            continue
        form, slack = ("%Y-%m-%d %H:%M", _OF_THE_MINUTE) if len(parts) > 3 else ("%Y-%m-%d", _OF_THE_DAY)
        starts.append(("the file's name", time, form, slack))
    return starts


def _summary_starts(path: Path) -> list[tuple[str, datetime, str, timedelta]]:
    """Start of the measurement in a Nemo summary beside a log."""
    starts = []
    stem = path.name.split(".")[0]
    for name, head in _tables_beside(path):
        # a folder may hold the summaries of several measurements
        if name.startswith(stem) and (match := _NEMO_START.search(head)) is not None:
            time = datetime.strptime(match[1], "%Y %b %d %H:%M").replace(tzinfo=zones.utc)
            starts.append((f"Measurement start in {name}", time, "%Y-%m-%d %H:%M", _OF_THE_MINUTE))
    return starts


def _tables_beside(path: Path) -> Iterator[tuple[str, str]]:
    """Names and beginnings of the CSVs in a log's folder, or in the folder of the archive that holds it."""
    if path.parent.is_dir():
        for table in (table for table in sorted(path.parent.glob("*.csv")) if table != path and table.is_file()):
            with table.open("rb") as stream:
                yield table.name, stream.read(_HEAD_BYTES).decode("utf-8", "replace")
        return
    if (part := archives.inside(path)) is not None:
        place, inner = part
        for name, member in archives.members(read_bytes(place)[0], place).items():
            if name != inner and name.endswith(".csv") and PurePosixPath(name).parent == PurePosixPath(inner).parent:
                yield PurePosixPath(name).name, member.read(_HEAD_BYTES).decode("utf-8", "replace")


_HEAD_BYTES = 2000


def _apart(time: datetime, start: datetime, zone: tzinfo | None, *, exact: bool) -> timedelta:
    """Least distance of a time from the start, read as UTC and as local; without a zone in any zone."""
    if not exact:
        # a date is its noon, give or take
        return abs(start - time - timedelta(hours=12))
    if zone is not None:
        # that of the day: a zone has two in a year
        offset = start.astimezone(zone).utcoffset() or timedelta(0)
        return min(abs(start - time), abs(start + offset - time))
    # every zone that there is, by half hours
    return min(abs(start - time + timedelta(minutes=30 * half)) for half in range(-28, 29))


def _source(streams: Sequence[Stream], what: str) -> str:
    sources = [s.attributes.get(f"{what}_source") for s in streams if s.attributes.get(f"{what}_from") == "assumed"]
    return next((str(source) for source in sources if source), "")


def _lowest_m(stream: Stream) -> float | None:
    height = stream.frame["altitude_m"].to_numpy(np.float64)
    height = height[np.isfinite(height)]
    if not len(height):
        return None
    # not the least: one row of a receiver without a fix may be far below
    low = float(np.percentile(height, 1.0))
    # a log may end in the air; a climb from its first row is no jump of a receiver that had no fix
    begins = np.abs(np.diff(height[: len(height) // 100 + 2], prepend=0.0)).max() <= _GROUND_M
    return min(low, float(height[0])) if begins else low
