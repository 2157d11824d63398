"""Questions about logs: contradictions with file names, clocks or ground heights, and unclear assumptions.

The module also assigns the logs of several flights to their flights, by time and position.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta, tzinfo
from datetime import timezone as zones
from pathlib import Path
from zoneinfo import ZoneInfo

import numpy as np

from ..common.errors import InputError
from ..common.units import AnyArray
from ..logs.ingest import IngestedFile
from ..logs.limits import PLACE, jumps_of
from ..logs.records import Stream, has_wall_clock
from ..site.site import Site
from .clock import Origin, origin_of
from .track import Track

# Largest pause between logs of one flight. Radios are started before take-off.
SLACK = np.timedelta64(5, "m")
# Two tracks at the same time belong to two flights if they are farther apart than this [deg] (about 5 km).
APART_DEG = 0.05

Span = tuple[np.datetime64, np.datetime64]


@dataclass
class Flight:
    """The files of one flight, and its time span (None without absolute times).

    Parameters
    ----------
    unsure : mapping of str to str
        Questions about files that may belong to another flight, by path.
    """

    files: list[IngestedFile] = field(default_factory=list)
    span: Span | None = None
    place: tuple[float, float] | None = None
    unsure: dict[str, str] = field(default_factory=dict)

    @property
    def measured(self) -> list[Stream]:
        """The streams that can be compared: levels and ranks."""
        return [stream for file in self.files for stream in file.result.streams if stream.kind in ("rss", "rank")]

    @property
    def complete(self) -> bool:
        """True if the flight has measurements and also positions, so that they can be compared."""
        measured = self.measured
        tracked = any(_tracks(file) for file in self.files)
        return bool(measured) and (tracked or any("latitude_deg" in stream.frame for stream in measured))


def flights(files: Sequence[IngestedFile]) -> list[Flight]:
    """Return the flights of a set of logs in order of time.

    Each telemetry log begins a flight. A radio log belongs to the flight with which it shares most time. A log with
    relative times belongs to the flight whose track contains its positions, or else to the flight in its folder. If
    neither is found, it belongs to the only flight, or is a separate flight if there are several. If several logs have
    both levels and positions but no absolute time, each of them is a flight.

    Parameters
    ----------
    files : sequence of IngestedFile
    """
    timed = [(file, span) for file in files if (span := _span_of(file)) is not None]
    groups: list[Flight] = []
    # sort tracks by time before radio logs, so that every radio log finds its flight
    for file, span in sorted(timed, key=lambda entry: (not _tracks(entry[0]), entry[1][0])):
        place = _place(file)
        near = [flight for flight in groups if _meet(flight, span, place)]
        flight = max(near, key=lambda group: _shared(group.span, span), default=None)
        if flight is None:
            flight = Flight(span=span, place=place)
            groups.append(flight)
        flight.files.append(file)
        if _tracks(file) or not any(_tracks(member) for member in flight.files):
            assert flight.span is not None
            # a radio may have been left on after the flight, so only a track determines the span
            flight.span = (min(flight.span[0], span[0]), max(flight.span[1], span[1]))
            flight.place = flight.place or place
    for file in files:
        if _span_of(file) is None:
            _flight_without_time(file, groups).files.append(file)
    for flight in groups:
        tracks = [file for file in flight.files if _tracks(file)]
        for file in flight.files if tracks else ():
            if file.path not in flight.unsure and (text := _name_question(file, tracks[0])):
                flight.unsure[file.path] = text
    return sorted(groups, key=lambda group: (group.span is None, (group.span or ())[:1]))


# Flight number in the name of a log or of its folder.
_FLIGHT_NUMBER = re.compile(r"(?<![a-z])(flight|flt|sortie|mission)[ _.-]?0*(\d{1,3})(?!\d)", re.IGNORECASE)
_DATE = re.compile(r"(?<!\d)(20\d\d)[-_.]?(\d\d)[-_.]?(\d\d)(?!\d)")


def _name_question(file: IngestedFile, track: IngestedFile) -> str:
    """Return a question if a log's name has another flight number or date than the track, otherwise an empty text."""
    names = ["/".join(Path(item.path).parts[-2:]) for item in (file, track)]
    first, second = ({(word.lower(), number) for word, number in _FLIGHT_NUMBER.findall(name)} for name in names)
    if first and second and not first & second:
        (shown, other) = (" ".join(min(found)) for found in (first, second))
        return f"its name has {shown}, the name of the track has {other}: the same flight?"
    # trust absolute times more than a name, because an evening flight has the date of the next day in UTC
    if _span_of(file) is not None:
        return ""
    dates = [{"-".join(parts) for parts in _DATE.findall(name)} for name in names]
    flown = _span_of(track)
    if flown is not None:
        dates[1] |= {str(flown[0].astype("datetime64[D]") + day) for day in (-1, 0, 1)}
    if dates[0] and dates[1] and not dates[0] & dates[1]:
        return f"its name has {min(dates[0])}, the date of the track is {max(dates[1])}: the same flight?"
    return ""


def _span_of(file: IngestedFile) -> Span | None:
    """Return the first and last time of the streams of a file, or None without absolute times."""
    spans = [span for stream in file.result.streams if (span := stream_span(stream)) is not None]
    first = min((begin for begin, _ in spans), default=None)
    return None if first is None or not has_wall_clock(first) else (first, max(end for _, end in spans))


def stream_span(stream: Stream) -> Span | None:
    """Return the first and last time of a stream, or None without times."""
    time = stream.frame["time"].to_numpy("datetime64[ns]")
    time = time[~np.isnat(time)]
    return (time.min(), time.max()) if len(time) else None


def meet(first: Span, second: Span) -> bool:
    """Check whether two spans overlap."""
    return bool(first[0] <= second[1] and second[0] <= first[1])


def _tracks(file: IngestedFile) -> list[Stream]:
    return [stream for stream in file.result.streams if stream.kind == "telemetry"]


def _place(file: IngestedFile) -> tuple[float, float] | None:
    for stream in _tracks(file):
        known = stream.frame[["latitude_deg", "longitude_deg"]].dropna()
        if len(known):
            return float(known["latitude_deg"].median()), float(known["longitude_deg"].median())
    return None


def _meet(flight: Flight, span: Span, place: tuple[float, float] | None) -> bool:
    if flight.span is None or not meet((flight.span[0] - SLACK, flight.span[1] + SLACK), span):
        return False
    if place is None or flight.place is None:
        return True
    # the margin is for radios, which start before take-off; two tracks must overlap without it
    return meet(flight.span, span) and max(abs(place[0] - flight.place[0]), abs(place[1] - flight.place[1])) < APART_DEG


def _shared(first: Span | None, second: Span) -> np.timedelta64:
    """Return the time that two spans share, which is negative if they do not overlap."""
    assert first is not None
    return min(first[1], second[1]) - max(first[0], second[0])


def _origin(file: IngestedFile, flight: Flight) -> Origin | None:
    """Return the start of a log with relative times, at which its positions lie on the track of a flight, or None."""
    track = next((track for member in flight.files for track in _tracks(member)), None)
    # use the longest stream, because a log of a hundred cells has the positions of one receiver a hundred times
    placed = [stream for stream in file.result.streams if "latitude_deg" in stream.frame]
    fullest = max(placed, key=lambda stream: stream.frame["latitude_deg"].count(), default=None)
    return None if track is None or fullest is None else origin_of(fullest, track)


# A log may also belong to another track if its distance is below this factor or this value [m].
_SIMILAR, _SIMILAR_M = 2.0, 5.0


def _called(flight: Flight) -> str:
    if flight.span is None:
        return f"of {Path(flight.files[0].path).name}"
    return f"at {str(flight.span[0].astype('datetime64[m]')).replace('T', ' ')} UTC"


def _flight_without_time(file: IngestedFile, groups: list[Flight]) -> Flight:
    """Return the flight of a file without absolute times, and add it to ``groups`` if it is new."""
    # a log with levels and positions is complete, and its relative times are not related to those of other logs
    alone = Flight([file]).complete
    known = [flight for flight in groups if flight.span is not None] if alone else groups
    by_track = [
        (origin.distance_m, i) for i, flight in enumerate(known) if (origin := _origin(file, flight)) is not None
    ]
    if by_track:
        # nearest track first
        (near_m, best), *others = sorted(by_track)
        rivals = [i for away_m, i in others if away_m < max(_SIMILAR * near_m, _SIMILAR_M)]
        if rivals:
            called = " and ".join(_called(known[i]) for i in rivals)
            text = f"its positions are also on the track of the flight {called}: the same flight?"
            known[best].unsure[file.path] = text
        return known[best]
    folder = Path(file.path).parent
    near = [flight for flight in known if any(Path(member.path).parent == folder for member in flight.files)]
    if len(near) != 1:
        near = known if len(known) == 1 else []
    if not near:
        groups.append(Flight())
        near = groups[-1:]
    return near[0]


_IN_NAME = re.compile(
    r"(?<!\d)(20\d\d)[-_]?([01]\d)[-_]?([0-3]\d)(?:[T_ -]([0-2]\d)[-_:]?([0-5]\d)(?:[-_:]?([0-5]\d))?)?(?!\d)"
)

# Largest difference of a log from a date in its name. The date may be local or UTC, and may be the date of the start or
# of the end.
_OF_THE_DAY = timedelta(hours=36)

# Largest difference of a log from a time in its name. The program that names the log starts before its radio.
_OF_THE_MINUTE = timedelta(minutes=15)

# A track probably does not begin at take-off if its lowest height differs from 0 by more than this [m].
_GROUND_M = 5.0


def questions(file: IngestedFile, streams: Sequence[Stream], timezone: str | None) -> list[str]:
    """Return the questions of a draft about the streams of a log. Each question contains both values.

    Parameters
    ----------
    file : IngestedFile
    streams : sequence of Stream
    timezone : str or None
        Time zone of clocks that do not specify one.
    """
    texts = []
    start = _start(streams)
    if start is not None:
        zone = ZoneInfo(timezone) if timezone else None
        texts += [
            f"the file's name has {time:{form}}, the log begins at {start:%Y-%m-%d %H:%M} UTC: which is correct?"
            for time, form, slack in _name_starts(file.path)
            if _time_difference(time, start, zone, exact=slack == _OF_THE_MINUTE) > slack
        ]
        if any(s.attributes.get("clock_from") == "assumed" for s in streams):
            texts.append(f"the times are read as {_source(streams, 'clock') or 'local wall time'}: correct?")
    if any(s.attributes.get("height_from") == "assumed" for s in streams):
        texts.append(f"the heights are read as {_source(streams, 'height') or 'above take-off'}: correct?")
    for stream in streams:
        sentence = "" if (jumps := jumps_of(stream.frame, f"{stream.kind} {stream.name!r}"))[0].any() else jumps[1]
        # users check the lines of a draft that end with a question mark
        texts += [f"{sentence.rstrip('?')}?"] if sentence else []
        if stream.kind == "telemetry" and (low := _lowest_m(stream)) is not None and abs(low) > _GROUND_M:
            texts.append(f"the lowest height is {low:.0f} m, expected 0 m: does the track begin in the air?")
    return list(dict.fromkeys(texts))


# If the lowest height of a track is above this [m], its heights must have another datum, because no flight is that high
# all the time.
_TOO_HIGH_M = 150.0

# A log whose start differs from that of the telemetry by full hours, within this time [s], has a wrong time zone.
_TOGETHER_S = 90.0

_MANY_WITHOUT_POSE = 0.1


def doubts(
    track: Track,
    telemetry: Stream,
    series: Sequence[tuple[str, AnyArray]],
    undated: Sequence[str] = (),
    takeoff_ground_m: float = 0.0,
) -> tuple[str, ...]:
    """Return doubts about clocks and heights, as clauses for the summary of a report.

    Parameters
    ----------
    track : Track
    telemetry : Stream
        Telemetry of the track.
    series : sequence of (str, (n,) datetime64)
        Names and times of the series that are compared on the track.
    undated : sequence of str
        Logs with positions and relative times that the flight file dates, although the telemetry has absolute times.
    takeoff_ground_m : float
        Height of the take-off point above the ground at the site's origin. For a log with heights above sea level, it
        is minus the height of the ground at the origin above sea level.

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
        f"{_listed(names)} begins {hours:+d} h relative to the telemetry, probably due to a wrong time zone"
        for hours, names in apart.items()
    ]
    if poseless:
        texts.append(f"{_listed(list(poseless))}: {100 * max(poseless.values()):.0f} % of the samples have no position")
    if undated:
        texts.append(f"{_listed(undated)} has no clock: by its positions it may belong to another flight on this route")
    low_m, assumed = _lowest_m(telemetry), telemetry.attributes.get("height_from") == "assumed"
    low_m = None if low_m is None else low_m + takeoff_ground_m
    if low_m is not None and (low_m > _TOO_HIGH_M or (assumed and abs(low_m) > _GROUND_M)):
        texts.append(f"the lowest height above take-off is {low_m:.0f} m, probably above another datum")
    return tuple(texts)


# If no sample is below this height [m], the heights are above sea level and not above take-off.
_FLOWN_M = 300.0

# If the lowest height is within this [m] of the site's ground above sea level, heights are probably above sea level.
_NEAR_GROUND_M = 50.0

# A track starts with a take-off if the UAV moves by at most _REST_M in the first _REST_S, and then climbs by _CLIMB_M.
_REST_S, _REST_M, _CLIMB_M = 5.0, 0.5, 5.0


def check_heights(site: Site, path: str, telemetry: Stream) -> tuple[str, ...]:
    """Check that the heights of a flight are above take-off, and not above sea level.

    Parameters
    ----------
    site : Site
    path : str
        Path of the log, for the message.
    telemetry : Stream

    Returns
    -------
    tuple of str
        A clause for the summary of a report if the lowest height is close to the height of the site's ground above sea
        level.

    Raises
    ------
    InputError
        If no sample is below :data:`_FLOWN_M`, or if the UAV rests and takes off at about the height of the site's
        ground above sea level.
    """
    low_m, sea_m = _lowest_m(telemetry), site.ground_above_sea_m
    if low_m is None or "takeoff_from" in telemetry.attributes:
        return ()
    low_m += site.takeoff_ground_m
    near = sea_m is not None and low_m > _GROUND_M and abs(low_m - sea_m) < _NEAR_GROUND_M
    high = low_m > _FLOWN_M
    if high or (near and _takes_off(telemetry)):
        # a UAV at rest is on the ground, regardless of the datum of its heights
        ground_m = low_m if sea_m is None or not high else sea_m
        ground = f"the height of the ground above sea level{' [m]' if sea_m is None else f', {sea_m:g} m'}"
        line = f"'takeoff_ground_m: {site.takeoff_ground_m - ground_m:.0f}' under 'origin:' of the site file"
        raise InputError(
            f"the lowest height above take-off is {low_m:.0f} m" + ("" if high else ", at rest before a climb"),
            expected=f"samples below {_FLOWN_M:.0f} m, or a log that begins on the ground"
            if high
            else "a UAV at rest before its climb is on the ground, at 0 m",
            cause="heights above the sea or the ellipsoid that are read as above take-off: "
            f"write {line} (minus {ground if high else 'the height at rest'}); if the log begins in the air, "
            + ("add the rows of the take-off" if high else "remove its rows before the climb"),
            path=path,
        )
    if near:
        return (
            f"the lowest height above take-off is {low_m:.0f} m, about the height of the ground above sea level "
            f"({sea_m:.0f} m): if heights are above sea level, write 'takeoff_ground_m: {-(sea_m or 0.0):.0f}' "
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
    """Return the first time (UTC) of some streams, or None without absolute times."""
    first = min((span[0] for stream in streams if (span := stream_span(stream)) is not None), default=None)
    if first is None or not has_wall_clock(first):
        return None
    start: datetime = first.astype("datetime64[us]").item().replace(tzinfo=zones.utc)
    return start


def _name_starts(path: str) -> list[tuple[datetime, str, timedelta]]:
    """Return the dates in the name of a file, each with its format and the largest usual difference from the log."""
    starts = []
    for match in _IN_NAME.finditer(Path(path).name):
        parts = [int(part) for part in match.groups() if part is not None]
        try:
            time = datetime(*parts, tzinfo=zones.utc)  # type: ignore[misc, arg-type]
        except ValueError:
            continue
        form, slack = ("%Y-%m-%d %H:%M", _OF_THE_MINUTE) if len(parts) > 3 else ("%Y-%m-%d", _OF_THE_DAY)
        starts.append((time, form, slack))
    return starts


def _time_difference(time: datetime, start: datetime, zone: tzinfo | None, *, exact: bool) -> timedelta:
    """Return the difference between a time and the start of a flight.

    If the zone of the time is unknown, the zone that fits best is used.
    """
    if not exact:
        # for a date without a time, compare with noon
        return abs(start - time - timedelta(hours=12))
    if zone is not None:
        # use the offset of that day, because a zone has two offsets per year
        offset = start.astimezone(zone).utcoffset() or timedelta(0)
        return min(abs(start - time), abs(start + offset - time))
    # all zones of the world, in half hours
    return min(abs(start - time + timedelta(minutes=30 * half)) for half in range(-28, 29))


def _source(streams: Sequence[Stream], what: str) -> str:
    sources = [s.attributes.get(f"{what}_source") for s in streams if s.attributes.get(f"{what}_from") == "assumed"]
    return next((str(source) for source in sources if source), "")


def _lowest_m(stream: Stream) -> float | None:
    height = stream.frame["altitude_m"].to_numpy(np.float64)
    height = height[np.isfinite(height)]
    if not len(height):
        return None
    # use a percentile, because a row of a receiver without a fix may be far too low
    low = float(np.percentile(height, 1.0))
    # also use the first height, because a log may end in the air; but not if the heights jump, as they do without a fix
    begins = np.abs(np.diff(height[: len(height) // 100 + 2], prepend=0.0)).max() <= _GROUND_M
    return min(low, float(height[0])) if begins else low
