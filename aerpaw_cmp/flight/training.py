"""Series whose own logs the antennas, the receiver or the settings of a flight were learned from."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence

import numpy as np

from ..common.provenance import union
from ..common.units import AnyArray, FloatArray
from ..propagation.arrays import Link
from ..site.antenna.sphere_pattern import SpherePattern
from .data import FlightData, RankSeries, RssSeries


def logs_of(data: FlightData, series: RssSeries | RankSeries) -> tuple[str, ...]:
    """SHA-256 of the logs that hold a series."""
    if not len(series.log):
        return union(file.sha256 for file in data.files)
    return tuple(data.files[number].sha256 for number in np.unique(series.log))


def flight_logs(data: FlightData) -> tuple[str, ...]:
    """SHA-256 of every log of a flight that holds RSS or rank."""
    return union(*(logs_of(data, s) for s in data.rss), *(logs_of(data, s) for s in data.rank))


def learned_patterns(link: Link) -> list[SpherePattern]:
    """Antennas of both ends that were learned from flights."""
    arrays = [*link.tower_arrays.values(), link.uav_array]
    return [p for array in arrays for p in array.patterns if isinstance(p, SpherePattern)]


def learned_here(data: FlightData, series: RssSeries, link: Link) -> tuple[str, ...]:
    """Logs of a series that its antennas, or the settings of its flight file, were learned from; none: it is unseen.

    Antenna files of 0.3 name flights, not logs: there the name decides.
    """
    logs, patterns = logs_of(data, series), learned_patterns(link)
    if any(not p.trained_on and data.settings.flight.name in p.learned_from for p in patterns):
        return logs
    if learned_of(series, patterns):
        return logs
    return common(logs, [data.settings.trained_on, *(p.trained_on for p in patterns)])


# Readings of a run; marks that a learned file keeps of a log; marks that two logs share if one is of the other.
_RUN, MARKS, _SHARED = 32, 32, 3

# The same of ranks: in a run, and how many of them must differ. Of 4 000 random reports no two of 8 850 pairs share a
# run; two real flights have 103 and 167 and share none, any half of one shares 8 and more of the 32 that are kept.
_HOLDS, _DIFFERING = 12, 6

# Runs that are hashed at a time: bounds the memory.
AT_ONCE = 8192

_WEIGHTS = np.array([pow(0x9E3779B97F4A7C15, j, 2**64) for j in range(1, _RUN + 1)], dtype=np.uint64)


def marks(series: RssSeries | RankSeries) -> AnyArray:
    """Hashes of all runs of readings, sorted: a part of a log has those of the log, in any format or zone.

    Readings are levels, or, of ranks, which mostly repeat, for how many reports each holds.
    """
    if isinstance(series, RssSeries):
        return _hashes(np.round(10.0 * series.measured_db), _RUN, _RUN // 4 + 1)
    rank = series.rank[np.isfinite(series.rank)]
    return _hashes(np.diff(np.flatnonzero(np.diff(rank))).astype(np.float64), _HOLDS, _DIFFERING)


def _hashes(readings: FloatArray, run: int, differing: int) -> AnyArray:
    """Of runs of finite readings of which so many differ: levels at a floor would be alike in any flight."""
    every = np.lib.stride_tricks.sliding_window_view(np.concatenate([readings, np.full(run, np.nan)]), run)
    out = []
    for start in range(0, len(every), AT_ONCE):
        runs = every[start : start + AT_ONCE]
        runs = runs[np.isfinite(runs).all(axis=1)]
        telling = (np.diff(np.sort(runs, axis=1), axis=1) != 0).sum(axis=1) >= differing - 1
        out.append((runs[telling].astype(np.int64).view(np.uint64) * _WEIGHTS[:run]).sum(axis=1, dtype=np.uint64))
    return np.unique(np.concatenate(out))


def marks_text(series: RssSeries | RankSeries, most: int | None = None) -> tuple[str, ...]:
    """Marks as learned files write them; at most some, those of the smallest hashes."""
    return tuple(f"{mark:016x}" for mark in marks(series)[:most])


def marks_note(flights: Sequence[FlightData]) -> str:
    """Comment of an antenna table: marks of the logs that it was learned from, of all channels: they share a fit."""
    return "marks: " + " ".join(mark for data in flights for s in data.rss for mark in marks_text(s, MARKS))


def learned_of(series: RssSeries, patterns: Iterable[SpherePattern]) -> bool:
    """Check whether antennas were learned from the readings of a series, whatever its log is now."""
    lines = [line for p in patterns for line in p.notes.splitlines() if line.startswith("# marks:")]
    return bool(lines) and shared((mark for line in lines for mark in line.split()[2:]), marks_text(series))


def shared(learned: Iterable[str], readings: Iterable[str]) -> bool:
    """Check whether the marks of some readings are those that something was learned from."""
    return len({*learned} & {*readings}) >= _SHARED


def common(logs: Sequence[str], learned: Iterable[Iterable[str]]) -> tuple[str, ...]:
    """Those of some logs that something was learned from."""
    known = set(union(*learned))
    return tuple(digest for digest in logs if digest in known)


def counted_once(flights: Sequence[FlightData]) -> tuple[list[FlightData], list[str]]:
    """Flights without the series whose log an earlier flight holds already, and what is to be said of that.

    A log that comes twice, renamed, copied or packed, would be predicted from itself.
    """
    home: dict[str, str] = {}
    counted: list[FlightData] = []
    remarks: list[str] = []
    known: list[tuple[str, AnyArray]] = []
    for data in flights:
        name = data.settings.flight.name
        again = {digest: home[digest] for digest in flight_logs(data) if digest in home}
        for digest, first in again.items():
            remarks.append(f"{name} holds the same log as {first} (SHA-256 {digest[:12]}...): it is counted once")
        marked = [(s, logs_of(data, s), marks(s)) for _, s in data.series]
        for _, logs, ours in marked:
            earlier = [flight for flight, earlier_marks in known if len(np.intersect1d(earlier_marks, ours)) >= _SHARED]
            if earlier and not set(logs) & set(again):
                remarks.append(f"{name} holds readings of {earlier[0]} in another log: they are counted once")
                again |= dict.fromkeys(logs, earlier[0])
        known += [(name, ours) for _, _, ours in marked]
        rss = tuple(s for s in data.rss if not set(logs_of(data, s)) & set(again))
        rank = tuple(s for s in data.rank if not set(logs_of(data, s)) & set(again))
        if not again:
            counted.append(data)
        elif rss or rank:
            counted.append(dataclasses.replace(data, rss=rss, rank=rank))
        home |= {digest: name for digest in flight_logs(data) if digest not in home}
    return counted, list(dict.fromkeys(remarks))
