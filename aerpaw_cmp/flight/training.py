"""Series whose own logs the antennas, the receiver or the settings of a flight were learned from.

Fingerprints of logs: they recognise a changed copy of a log, and not a second flight of the same route.

A fingerprint ``<start>f<digits>f<runs>`` has three parts:

- ``start``: half seconds since 1970, empty if the log has no wall clock.
- ``digits``: the change of a level or a rank every half second, one digit each: mean over 1 s minus mean over 10 s, in
  steps of 0.4 robust standard deviations. Powers in watts count by their logarithm.
- ``runs``: the smallest hashes of short runs of raw readings (a bottom-k sketch, Broder 1997), 8 hex digits each.

Two fingerprints are of one log if they share runs, or if their clocks agree and their digits correlate at some lag. The
digits of a part and of a thinned, resampled, rounded or scaled copy do. Repeated flights of one route share the
ripple of the ground reflection, so their digits correlate, too: only the clock or the raw readings distinguish them.
"""

from __future__ import annotations

import dataclasses
import gzip
import zlib
from collections.abc import Iterable, Sequence
from contextlib import suppress
from functools import lru_cache
from pathlib import Path

import numpy as np

from ..common.content import union
from ..common.errors import InputError
from ..common.units import AnyArray, FloatArray
from ..logs.records import has_wall_clock
from ..propagation.geometry import Link
from ..site.antennas import MeasuredPattern
from ..site.learned import LEARNED, SpherePattern, folder_of, read_sphere_csv
from .data import FlightData, RankSeries, RssSeries
from .settings import FlightFile

_STEP_S, _MEAN_S, _TREND_S = 0.5, 1.0, 10.0
_LONGEST_S = 4 * 3600.0  # of a longer log the beginning is marked

# Digits of a change: 7 is none; half seconds without readings are dots.
_DIGITS, _MIDDLE, _PER_SD, _GAP = "0123456789abcde", 7, 2.5, "."

_BEGIN = "f"

# Clocks of one log differ by at most a minute, or that and whole hours of a wrong time zone [half seconds].
_SLACK, _HOUR = 120, 7200

# Half seconds that two marks share; correlation, and Fisher's z over its standard deviation, from which they are of one
# log. Largest z of two logs of the field: 7.3, the next 5.7; of a changed copy of most of a log the least is 8.6.
_FEWEST, _LEAST_R, _LEAST_Z = 80, 0.5, 7.5

# Readings of a run, changes in it (a constant level repeats in every log), and every how many-th reading is taken: a
# copy with half or a quarter of the rows has the same runs.
_RUN, _LEAST_CHANGES, _STRIDES = 24, 8, (1, 2, 4)

# A series with fewer different values has no runs: ranks along one route change in the same way on every flight.
_FEWEST_VALUES = 6

# Runs in a mark, and shared ones from which two marks are of one log: of 64, a tenth of a log shares about 6.
_RUNS, _LEAST_SHARED = 64, 3

# Multiplier of the hashes: 2^64 over the golden ratio, odd, so that it has an inverse.
_ODD = 0x9E3779B97F4A7C15

# Readings that are all positive, and below one or over so many decades, are powers.
_POWER_RATIO = 1e3

# Standard deviation of the changes below which a mark tells of the route alone; of real logs the least is 0.26.
_LEAST_SD = 0.2


def mark_of(time: AnyArray, readings: FloatArray) -> str:
    """Mark of the readings (n,) of a series at instants (n,); empty for what tells too little or repeats itself."""
    known = np.flatnonzero(np.isfinite(readings) & ~np.isnat(time))
    # the order of equal times stays: a mark must not depend on the sort
    known = known[np.argsort(time[known], kind="stable")]
    if not len(known):
        return ""
    seconds, values = (time[known] - time[known[0]]) / np.timedelta64(1, "s"), readings[known]
    if values.min() > 0.0 and (values.max() < 1.0 or values.max() > _POWER_RATIO * values.min()):
        values = 10.0 * np.log10(values)
    # about the mean: sums of levels near -90 dB over hours would lose the digits of a change
    total = np.concatenate([[0.0], np.cumsum(values - values.mean())])
    at = np.arange(0.0, min(float(seconds[-1]), _LONGEST_S), _STEP_S)

    def mean(width_s: float) -> tuple[FloatArray, AnyArray]:
        begin, end = (np.searchsorted(seconds, at + side * width_s / 2) for side in (-1, 1))
        return (total[end] - total[begin]) / np.maximum(end - begin, 1), end - begin

    (level, near), (trend, around) = mean(_MEAN_S), mean(_TREND_S)
    told = (near > 0) & (around > 1)
    change = (level - trend)[told]
    if len(change) < _FEWEST or not change.std() > _LEAST_SD:
        return ""
    spread = 1.4826 * float(np.median(np.abs(change)))
    # ranks hardly change: the median of their changes is 0
    spread = spread if spread > 0.05 * change.std() else float(change.std())
    digits = np.clip(np.rint(change / spread * _PER_SD) + _MIDDLE, 0, len(_DIGITS) - 1).astype(np.int64)
    text = np.full(len(at), _GAP)
    text[told] = np.array(list(_DIGITS))[digits]
    digits, apart = "".join(text), int(_TREND_S / _STEP_S)
    # a series that is like itself at another time (a test tone) would be like any other of its kind
    if (_evidence(digits, digits) >= _LEAST_Z)[apart:-apart].any():
        return ""
    # half seconds, so that it counts in steps of the mark
    first = time[known[0]]
    start = round((first - np.datetime64(0, "ns")) / np.timedelta64(500, "ms")) if has_wall_clock(first) else ""
    return f"{start}{_BEGIN}{digits}{_BEGIN}{_runs(values)}"


def _runs(values: FloatArray) -> str:
    """Return the smallest hashes of runs of changes [1/1000]; changes, because a gain shifts a copy."""
    if len(np.unique(values)) < _FEWEST_VALUES:
        return ""
    found = np.concatenate([_hashes(values[phase::stride]) for stride in _STRIDES for phase in range(stride)])
    # a few of them alone are sorted: millions would take a second
    least = np.partition(found, 10 * _RUNS)[: 10 * _RUNS] if len(found) > 10 * _RUNS else found
    return "".join(f"{code:08x}" for code in np.unique(least)[:_RUNS].tolist())


def _hashes(values: FloatArray) -> AnyArray:
    """Return the hash of each run of readings that changes often enough: a rolling polynomial modulo 2^64."""
    steps = np.rint(np.diff(values) * 1e3).astype(np.int64).view(np.uint64)
    if len(steps) < _RUN:
        return np.zeros(0, dtype=np.uint64)
    mixed = steps * np.uint64(_ODD)
    mixed ^= mixed >> np.uint64(29)
    total = _before(mixed * np.cumprod(np.full(len(steps), _ODD, dtype=np.uint64)))
    run = total[_RUN:] - total[:-_RUN]
    run *= np.cumprod(np.full(len(run), pow(_ODD, -1, 1 << 64), dtype=np.uint64))
    run ^= run >> np.uint64(31)
    changes = _before(steps != 0)
    return np.asarray((run * np.uint64(_ODD) >> np.uint64(32))[changes[_RUN:] - changes[:-_RUN] >= _LEAST_CHANGES])


def _before(values: AnyArray) -> AnyArray:
    """Return the sums of the values before each place, and of all."""
    total = np.cumsum(values)
    return np.concatenate([np.zeros(1, dtype=total.dtype), total])


def among(mark: str, marks: Iterable[str]) -> bool:
    """Check whether one of some marks, which a learned file may hold, is of the log of this one."""
    return bool(mark) and any(_same(other, mark) for other in marks)


@lru_cache(maxsize=4096)
def _same(first: str, second: str) -> bool:
    begin, own, runs = _parts(first)
    other, digits, others = _parts(second)
    if len(runs & others) >= _LEAST_SHARED:
        return True
    if min(len(own), len(digits)) < _FEWEST:
        return False
    z, near = _evidence(own, digits), np.True_
    if begin is not None and other is not None:
        lags = np.arange(len(z))
        apart = np.abs(np.where(lags < len(digits), lags, lags - len(z)) + other - begin) + _SLACK
        near = (apart % _HOUR <= 2 * _SLACK) & (apart <= 14 * _HOUR + 2 * _SLACK)
    return bool(((z >= _LEAST_Z) & near).any())


def _parts(mark: str) -> tuple[int | None, str, frozenset[str]]:
    """Return the start of a mark in half seconds since 1970 (None without a wall clock), its digits and its runs."""
    begin, digits, runs = [*mark.split(_BEGIN, 2), "", ""][:3]
    start = int(begin) if begin.isdecimal() and len(begin) < 12 else None
    return start, digits, frozenset(runs[i : i + 8] for i in range(0, len(runs) - 7, 8))


def _evidence(first: str, second: str) -> FloatArray:
    """Fisher's z over its spread at each circular lag, 0 of few or loose pairs; of level and path loss signs differ."""
    # room for every lag, forwards and backwards
    size = 1 << (len(first) + len(second) - 1).bit_length()
    left, right = _spectra(first, size), _spectra(second, size)

    def at_lags(i: int, j: int) -> FloatArray:
        return np.asarray(np.fft.irfft(np.conj(left[i]) * right[j], size))

    count = np.maximum(np.rint(at_lags(0, 0)), 1.0)
    ours, theirs = at_lags(1, 0), at_lags(0, 1)
    variances = (at_lags(2, 0) - ours**2 / count) * (at_lags(0, 2) - theirs**2 / count)
    covariance = np.abs(at_lags(1, 1) - ours * theirs / count)
    # below 1: arctanh of a log with itself would be infinite
    r = np.minimum(covariance / np.sqrt(np.maximum(variances, (0.01 * count) ** 2)), 0.9999)
    z = np.arctanh(r) * np.sqrt(np.maximum(count / _memory(left[1], right[1], size) - 3.0, 0.0))
    return np.where((count >= _FEWEST) & (r >= _LEAST_R), z, 0.0)


def _memory(left: AnyArray, right: AnyArray, size: int) -> float:
    """Digits to one independent pair (Bartlett 1935): changes of a rank last longer than those of a level."""
    ours, theirs = (np.fft.irfft(np.abs(x) ** 2, size)[: round(_TREND_S / _STEP_S)] for x in (left, right))
    return 2.0 * float((ours * theirs).sum() / max(ours[0] * theirs[0], 1.0)) - 1.0


@lru_cache(maxsize=32)
def _spectra(mark: str, size: int) -> AnyArray:
    """Spectra of what is known of a mark, its changes and their squares; strange characters are gaps."""
    code = np.frombuffer(mark.encode("ascii", "replace"), dtype=np.uint8)
    digit = np.full(256, np.nan)
    digit[list(_DIGITS.encode())] = np.arange(len(_DIGITS)) - _MIDDLE
    change = digit[code]
    known = np.isfinite(change)
    change = np.nan_to_num(change)
    return np.asarray(np.fft.rfft(np.stack([known.astype(np.float64), change, change**2]), size))


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
