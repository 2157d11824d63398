"""Series whose own logs the antennas, the receiver or the settings of a flight were learned from."""

from __future__ import annotations

import dataclasses
import gzip
import zlib
from collections.abc import Iterable, Sequence
from contextlib import suppress
from functools import lru_cache
from pathlib import Path

import numpy as np

from ..common.errors import InputError
from ..common.provenance import union
from ..propagation.geometry.arrays import Link
from ..site.antenna.antennas import MeasuredPattern
from ..site.antenna.learned import LEARNED, folder_of
from ..site.antenna.sphere_pattern import SpherePattern, read_sphere_csv
from .data import FlightData, RankSeries, RssSeries
from .marks import among, mark_of
from .settings import FlightFile


def logs_of(data: FlightData, series: RssSeries | RankSeries) -> tuple[str, ...]:
    """SHA-256 of the logs that hold a series."""
    return tuple(data.files[number].sha256 for number in np.unique(series.log))


def flight_logs(data: FlightData) -> tuple[str, ...]:
    """SHA-256 of every log of a flight that holds RSS or rank."""
    return union(*(logs_of(data, s) for s in data.rss), *(logs_of(data, s) for s in data.rank))


def learned_patterns(link: Link, folder: Path, site: str | Path) -> list[MeasuredPattern]:
    """Antennas of both ends that were learned from flights, as their file or their numbers say.

    Parameters
    ----------
    link : Link
    folder : Path
        Of the antenna files, where calibrations lie too.
    site : str or Path
        Whose memory may hold the table of an antenna without a word on its logs.

    Returns
    -------
    list of MeasuredPattern
    """
    arrays = [*link.tower_arrays.values(), link.uav_array]
    patterns = [p for array in arrays for p in array.patterns if isinstance(p, MeasuredPattern)]
    known = (p if p.trained_on else _original(p, folder, folder_of(site)) for p in patterns)
    return [pattern for pattern in known if pattern is not None]


def learned_here(data: FlightData, series: RssSeries, link: Link) -> tuple[str, ...]:
    """Logs of a series that its antennas, or the settings of its flight file, were learned from; none: it is unseen."""
    logs, settings = logs_of(data, series), data.settings
    patterns = learned_patterns(link, data.folder, data.site_place)
    if among(series_mark(series), union(settings.marks, *(p.marks for p in patterns))):
        return logs
    return common(logs, [settings.trained_on, *(p.trained_on for p in patterns)])


def knows(data: FlightData, learned: Sequence[MeasuredPattern | FlightFile]) -> bool:
    """Check whether antennas or settings were learned from a log of a flight."""
    known = union(*(item.marks for item in learned))
    own = common(flight_logs(data), (item.trained_on for item in learned))
    return bool(own) or any(among(mark, known) for mark in marks_of([data]))


def series_mark(series: RssSeries | RankSeries) -> str:
    """Mark of the readings of a series."""
    return mark_of(series.time, series.measured_db if isinstance(series, RssSeries) else series.rank)


def marks_of(flights: Iterable[FlightData]) -> tuple[str, ...]:
    """Marks of every series of some flights that has one."""
    return tuple(mark for data in flights for _, series in data.series if (mark := series_mark(series)))


@lru_cache(maxsize=64)
def _original(pattern: MeasuredPattern, folder: Path, memory: Path) -> SpherePattern | None:
    """The learned table with the numbers of an antenna whose file names no log; None where none is near.

    Tables of the memory of the site and of those in the package, and of calibrations in the folder.
    """
    packaged = folder_of("lake_wheeler").parent.glob("*.learned/*.csv.gz")
    # the site's own memory first: mostly it is there
    places = dict.fromkeys([*memory.glob("*.csv.gz"), *packaged, *folder.glob("*.csv"), *folder.glob("*/*.csv")])
    tables = (table for place in places if (table := _learned_table(place)) is not None)
    return next((table for table in tables if _same_numbers(pattern, table)), None)


@lru_cache(maxsize=64)
def _learned_table(place: Path) -> SpherePattern | None:
    """The table of a calibration; None of any other file."""
    with suppress(InputError, OSError, EOFError, zlib.error):
        with gzip.open(place) if place.suffix == ".gz" else place.open("rb") as book:
            learned = book.read(len(LEARNED)) == LEARNED.encode()
        return read_sphere_csv(place) if learned else None
    return None


def _same_numbers(pattern: MeasuredPattern, table: SpherePattern) -> bool:
    """Check whether two antennas agree on both principal cuts but for a level, to a tenth of a dB.

    Every third degree: between them, files of cuts are read as splines.
    """
    angle = np.radians(np.arange(3.0, 358.0, 3.0))
    theta = np.concatenate([np.full(len(angle), np.pi / 2), np.where(angle < np.pi, angle, 2 * np.pi - angle)])
    phi = np.concatenate([angle, np.where(angle < np.pi, 0.0, np.pi)])
    gain, other = pattern.gain_dbi(theta, phi), table.gain_dbi(theta, phi)
    # but for a level: programs norm patterns to their maximum
    apart = np.abs(gain - other - np.median(gain - other))
    # what is flat is like every other
    return bool(np.ptp(other) > 1.0 and np.mean(apart < 0.06) > 0.95)


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
    known: list[tuple[str, str]] = []
    for data in flights:
        name = data.settings.flight.name
        again = {digest: home[digest] for digest in flight_logs(data) if digest in home}
        for digest, first in again.items():
            remarks.append(f"{name} holds the same log as {first} (SHA-256 {digest[:12]}...): it is counted once")
        marked = [(logs_of(data, s), series_mark(s)) for _, s in data.series]
        for logs, ours in marked:
            earlier = [] if set(logs) & set(again) else [flight for flight, mark in known if among(ours, [mark])]
            if earlier:
                remarks.append(f"{name} holds readings of {earlier[0]} in another log: they are counted once")
                again |= dict.fromkeys(logs, earlier[0])
        known += [(name, ours) for _, ours in marked]
        rss = tuple(s for s in data.rss if not set(logs_of(data, s)) & set(again))
        rank = tuple(s for s in data.rank if not set(logs_of(data, s)) & set(again))
        if not again:
            counted.append(data)
        elif rss or rank:
            counted.append(dataclasses.replace(data, rss=rss, rank=rank))
        home |= {digest: name for digest in flight_logs(data) if digest not in home}
    return counted, list(dict.fromkeys(remarks))
