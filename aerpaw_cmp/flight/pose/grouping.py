"""Logs of several flights told apart by time and place."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ...logs.ingest import IngestedFile
from ...logs.records import Stream, has_wall_clock
from .time_origin import Origin, origin_of

# Logs that end and begin within this are of one flight: radios are started before the take-off.
SLACK = np.timedelta64(5, "m")
# Tracks at one time, but some 5 km apart, are of two aircraft.
APART_DEG = 0.05

Span = tuple[np.datetime64, np.datetime64]


@dataclass
class Flight:
    """Files of one flight, and when it was (None: nothing has a wall clock)."""

    files: list[IngestedFile] = field(default_factory=list)
    span: Span | None = None
    place: tuple[float, float] | None = None
    unsure: dict[str, str] = field(default_factory=dict)
    """Questions about files that may be of another flight, by path."""

    @property
    def measured(self) -> list[Stream]:
        """Streams that can be compared."""
        return [stream for file in self.files for stream in file.result.streams if stream.kind in ("rss", "rank")]

    @property
    def complete(self) -> bool:
        """True if it holds something to compare, and positions to compare it at."""
        measured = self.measured
        tracked = any(_tracks(file) for file in self.files)
        return bool(measured) and (tracked or any("latitude_deg" in stream.frame for stream in measured))


def flights(files: Sequence[IngestedFile]) -> list[Flight]:
    """Flights in the order of time.

    Telemetry begins a flight; a radio log belongs to the flight that it shares most time with. Logs with relative
    times go to the flight on whose track their positions lie, else to that whose files lie in their folder; where
    that says nothing, to the only flight, or to one of their own. Of several that hold both levels and positions, and
    no clock beside them, each is a flight.

    Parameters
    ----------
    files : sequence of IngestedFile
    """
    timed = [(file, span) for file in files if (span := _span_of(file)) is not None]
    groups: list[Flight] = []
    # tracks first, in the order of time: radio logs then find their flight
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
            # a radio that was left on does not stretch a flight that has a track
            flight.span = (min(flight.span[0], span[0]), max(flight.span[1], span[1]))
            flight.place = flight.place or place
    for file in files:
        if _span_of(file) is None:
            _home(file, groups).files.append(file)
    for flight in groups:
        tracks = [file for file in flight.files if _tracks(file)]
        for file in flight.files if tracks else ():
            if file.path not in flight.unsure and (text := _otherwise(file, tracks[0])):
                flight.unsure[file.path] = text
    return sorted(groups, key=lambda group: (group.span is None, (group.span or ())[:1]))


# A number of a flight, and a date, in the name of a log or of its folder.
_FLIGHT_NUMBER = re.compile(r"(?<![a-z])(flight|flt|sortie|mission)[ _.-]?0*(\d{1,3})(?!\d)", re.IGNORECASE)
_DATE = re.compile(r"(?<!\d)(20\d\d)[-_.]?(\d\d)[-_.]?(\d\d)(?!\d)")


def _otherwise(file: IngestedFile, track: IngestedFile) -> str:
    """Return the question about a log whose name has another flight or date than the track's; empty if it has none."""
    names = ["/".join(Path(item.path).parts[-2:]) for item in (file, track)]
    first, second = ({(word.lower(), number) for word, number in _FLIGHT_NUMBER.findall(name)} for name in names)
    if first and second and not first & second:
        (shown, other) = (" ".join(min(found)) for found in (first, second))
        return f"its name has {shown}, that of the track {other}: which flight?"
    # a clock of its own says more than a name: an evening's flight has the next day in UTC
    if _span_of(file) is not None:
        return ""
    dates = [{"-".join(parts) for parts in _DATE.findall(name)} for name in names]
    flown = _span_of(track)
    if flown is not None:
        dates[1] |= {str(flown[0].astype("datetime64[D]") + day) for day in (-1, 0, 1)}
    if dates[0] and dates[1] and not dates[0] & dates[1]:
        return f"its name has {min(dates[0])}, the track is of {max(dates[1])}: which flight?"
    return ""


def _span_of(file: IngestedFile) -> Span | None:
    """First and last time of a file's streams; None where it has no wall clock."""
    spans = [span for stream in file.result.streams if (span := stream_span(stream)) is not None]
    first = min((begin for begin, _ in spans), default=None)
    return None if first is None or not has_wall_clock(first) else (first, max(end for _, end in spans))


def stream_span(stream: Stream) -> Span | None:
    """First and last time of a stream; None where it has none."""
    time = stream.frame["time"].to_numpy("datetime64[ns]")
    time = time[~np.isnat(time)]
    return (time.min(), time.max()) if len(time) else None


def meet(first: Span, second: Span) -> bool:
    """Check whether two spans share an instant."""
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
    # the margin before and after is for radios: two tracks must share time
    return meet(flight.span, span) and max(abs(place[0] - flight.place[0]), abs(place[1] - flight.place[1])) < APART_DEG


def _shared(first: Span | None, second: Span) -> np.timedelta64:
    """Time that two spans share; negative where they do not."""
    assert first is not None
    return min(first[1], second[1]) - max(first[0], second[0])


def _origin(file: IngestedFile, flight: Flight) -> Origin | None:
    """Origin under which a log with positions lies on the track of a flight."""
    track = next((track for member in flight.files for track in _tracks(member)), None)
    # the fullest: a log of a hundred cells has the places of one receiver a hundred times
    placed = [stream for stream in file.result.streams if "latitude_deg" in stream.frame]
    fullest = max(placed, key=lambda stream: stream.frame["latitude_deg"].count(), default=None)
    return None if track is None or fullest is None else origin_of(fullest, track)


# Two tracks that a log lies on about as well: it may be of either flight.
_ALIKE, _ALIKE_M = 2.0, 5.0


def _called(flight: Flight) -> str:
    if flight.span is None:
        return f"of {Path(flight.files[0].path).name}"
    return f"at {str(flight.span[0].astype('datetime64[m]')).replace('T', ' ')} UTC"


def _home(file: IngestedFile, groups: list[Flight]) -> Flight:
    """The flight of a file without a wall clock; a new one is added to ``groups``."""
    # what holds both levels and positions is a flight by itself: with another in its own time it shares none
    alone = Flight([file]).complete
    known = [flight for flight in groups if flight.span is not None] if alone else groups
    by_track = [
        (origin.distance_m, i) for i, flight in enumerate(known) if (origin := _origin(file, flight)) is not None
    ]
    if by_track:
        # nearest track first
        (near_m, best), *others = sorted(by_track)
        rivals = [i for away_m, i in others if away_m < max(_ALIKE * near_m, _ALIKE_M)]
        if rivals:
            called = " and ".join(_called(known[i]) for i in rivals)
            text = f"its positions lie on the track of the flight {called} too: which flight?"
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
