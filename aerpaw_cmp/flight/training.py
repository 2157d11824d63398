"""Recognition of series whose logs were training data of antennas, receivers or settings, by fingerprints.

A fingerprint matches a changed copy of a log, but not a second flight on the same route.

A fingerprint ``<start>f<digits>f<runs>`` has three parts:

- ``start``: half seconds since 1970, empty if the log has no wall clock.
- ``digits``: one digit every half second for the change of a level or a rank. It is the mean over 1 s minus the mean
  over 10 s, in steps of 0.4 robust standard deviations. Powers in watts count by their logarithm.
- ``runs``: the smallest hashes of short runs of changes between values, in steps of half a decibel (a bottom-k
  sketch, Broder 1997), 8 hex digits each. A quarter of the hashes do not change if levels are rounded to 0.1 dB. The
  hashes of another flight are different.

Two fingerprints belong to one log if they share runs, or if their clocks agree and their digits correlate at some lag.
The digits of a log correlate with the digits of a part of it, and of a thinned, resampled, rounded or scaled copy. The
digits of repeated flights on one route also correlate, because of the ripple of the ground reflection. Only the clock
and the runs distinguish such flights.

If one series of a flight is recognised, the whole flight is a training flight.
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
_LONGEST_S = 4 * 3600.0  # only the beginning of longer logs is used

# Digits for the size of a change. 7 means no change, and a dot means half a second without values.
_DIGITS, _MIDDLE, _PER_SD, _GAP = "0123456789abcde", 7, 2.5, "."

_BEGIN = "f"

# The clocks of two copies differ by at most a minute, plus full hours for a wrong time zone [half seconds].
_SLACK, _HOUR = 120, 7200

# Two fingerprints belong to one log if common half seconds, correlation and Fisher's z reach these values. In the field
# data, the largest z values of two different logs are 7.3 and 5.7, and the smallest of a changed copy is 8.6.
_FEWEST, _LEAST_R, _LEAST_Z = 80, 0.5, 7.5

# Number of consecutive changes in a run, smallest number of them that must differ from 0 (because constant levels occur
# in every log), and strides. Runs are also formed from every second to every fifth row, so that a copy with fewer rows
# has the same runs.
_RUN, _LEAST_CHANGES, _STRIDES = 16, 8, (1, 2, 3, 4, 5)

# Steps in which changes are counted [dB]. The second step is for logs without changes as large as the first step. The
# first step is not a multiple of 0.1, because changes at the boundary of two steps would depend on rounding errors.
# After rounding to 0.1 dB, a quarter of the runs remain. Of ten simulated repeats of a flight whose levels differ by
# 0.2 dB at equal positions, none shares two runs.
_CHANGES_DB = (0.51, 0.001)

# A series with fewer different values has no runs, because ranks along one route change similarly on every flight.
_FEWEST_VALUES = 6

# Number of runs in a fingerprint, and smallest number of common runs of copies of one log. A tenth of a log has about
# 12 of 128 runs in common with the log.
_RUNS, _LEAST_SHARED = 128, 3

# Multiplier of the hashes: 2^64 divided by the golden ratio, odd, so that it has an inverse.
_ODD = 0x9E3779B97F4A7C15

# Positive levels are linear powers if all are below 1, or if the ratio of the largest to the smallest exceeds this.
_POWER_RATIO = 1e3

# Smallest standard deviation of the changes. With a smaller value, a fingerprint would describe only the route. Real
# logs have 0.26 or more.
_LEAST_SD = 0.2


def mark_of(time: AnyArray, readings: FloatArray) -> str:
    """Return the fingerprint of the values (n,) of a series at times (n,).

    The fingerprint is empty for values with too few changes and for periodic values.
    """
    known = np.flatnonzero(np.isfinite(readings) & ~np.isnat(time))
    # use a stable sort, because otherwise the order of equal times, and with it the fingerprint, would vary
    known = known[np.argsort(time[known], kind="stable")]
    if not len(known):
        return ""
    seconds, values = (time[known] - time[known[0]]) / np.timedelta64(1, "s"), readings[known]
    if values.min() > 0.0 and (values.max() < 1.0 or values.max() > _POWER_RATIO * values.min()):
        values = 10.0 * np.log10(values)
    # subtract the mean, because sums of levels near -90 dB over hours would lose precision
    total = np.concatenate([[0.0], np.cumsum(values - values.mean())])
    at = np.arange(0.0, min(float(seconds[-1]), _LONGEST_S), _STEP_S)

    def mean(width_s: float) -> tuple[FloatArray, AnyArray]:
        begin, end = (np.searchsorted(seconds, at + side * width_s / 2) for side in (-1, 1))
        return (total[end] - total[begin]) / np.maximum(end - begin, 1), end - begin

    (level, near), (trend, around) = mean(_MEAN_S), mean(_TREND_S)
    covered = (near > 0) & (around > 1)
    change = (level - trend)[covered]
    if len(change) < _FEWEST or not change.std() > _LEAST_SD:
        return ""
    spread = 1.4826 * float(np.median(np.abs(change)))
    # use the standard deviation if the robust estimate is about 0, as for ranks
    spread = spread if spread > 0.05 * change.std() else float(change.std())
    digits = np.clip(np.rint(change / spread * _PER_SD) + _MIDDLE, 0, len(_DIGITS) - 1).astype(np.int64)
    text = np.full(len(at), _GAP)
    text[covered] = np.array(list(_DIGITS))[digits]
    digits, apart = "".join(text), int(_TREND_S / _STEP_S)
    # a periodic series (a test tone) correlates with itself at other lags, and would match all similar series
    if (_evidence(digits, digits) >= _LEAST_Z)[apart:-apart].any():
        return ""
    # in half seconds, the step of the fingerprint
    first = time[known[0]]
    start = round((first - np.datetime64(0, "ns")) / np.timedelta64(500, "ms")) if has_wall_clock(first) else ""
    return f"{start}{_BEGIN}{digits}{_BEGIN}{_runs(values)}"


def _runs(values: FloatArray) -> str:
    """Return the smallest hashes of runs of changes. A constant gain does not alter changes."""
    if len(np.unique(values)) < _FEWEST_VALUES:
        return ""
    thinned = [values[phase::stride] for stride in _STRIDES for phase in range(stride)]
    every = (np.concatenate([_hashes(some, step_db) for some in thinned]) for step_db in _CHANGES_DB)
    found = next(filter(len, every), np.zeros(0, dtype=np.uint64))
    # sort only the smallest, because sorting millions of hashes would take a second
    least = np.partition(found, 10 * _RUNS)[: 10 * _RUNS] if len(found) > 10 * _RUNS else found
    return "".join(f"{code:08x}" for code in np.unique(least)[:_RUNS].tolist())


def _hashes(values: FloatArray, step_db: float) -> AnyArray:
    """Return the hash of each run of values with enough changes: a rolling polynomial modulo 2^64."""
    steps = np.rint(np.diff(values) / step_db).astype(np.int64).view(np.uint64)
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
    """Return cumulative sums, starting with 0: the sum of the values before each position, and of all values."""
    total = np.cumsum(values)
    return np.concatenate([np.zeros(1, dtype=total.dtype), total])


def among(mark: str, marks: Iterable[str]) -> bool:
    """Check whether any of the fingerprints ``marks`` belongs to the same log as ``mark``."""
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
    """Return the start of a fingerprint [half seconds since 1970] (None if relative), its digits and its runs."""
    begin, digits, runs = [*mark.split(_BEGIN, 2), "", ""][:3]
    start = int(begin) if begin.isdecimal() and len(begin) < 12 else None
    return start, digits, frozenset(runs[i : i + 8] for i in range(0, len(runs) - 7, 8))


def _evidence(first: str, second: str) -> FloatArray:
    """Return Fisher's z relative to its SD at each circular lag, or 0 if pairs are few or weakly correlated."""
    # pad with zeros, so that all lags in both directions fit
    size = 1 << (len(first) + len(second) - 1).bit_length()
    left, right = _spectra(first, size), _spectra(second, size)

    def at_lags(i: int, j: int) -> FloatArray:
        return np.asarray(np.fft.irfft(np.conj(left[i]) * right[j], size))

    count = np.maximum(np.rint(at_lags(0, 0)), 1.0)
    ours, theirs = at_lags(1, 0), at_lags(0, 1)
    variances = (at_lags(2, 0) - ours**2 / count) * (at_lags(0, 2) - theirs**2 / count)
    covariance = np.abs(at_lags(1, 1) - ours * theirs / count)
    # limit r below 1, because arctanh would be infinite for identical logs
    r = np.minimum(covariance / np.sqrt(np.maximum(variances, (0.01 * count) ** 2)), 0.9999)
    z = np.arctanh(r) * np.sqrt(np.maximum(count / _memory(left[1], right[1], size) - 3.0, 0.0))
    return np.where((count >= _FEWEST) & (r >= _LEAST_R), z, 0.0)


def _memory(left: AnyArray, right: AnyArray, size: int) -> float:
    """Return the number of digits per independent pair (Bartlett 1935), which is larger for ranks than for levels."""
    ours, theirs = (np.fft.irfft(np.abs(x) ** 2, size)[: round(_TREND_S / _STEP_S)] for x in (left, right))
    return 2.0 * float((ours * theirs).sum() / max(ours[0] * theirs[0], 1.0)) - 1.0


@lru_cache(maxsize=32)
def _spectra(mark: str, size: int) -> AnyArray:
    """Return the spectra of three sequences of a fingerprint: mask of known digits, changes, and squared changes."""
    code = np.frombuffer(mark.encode("ascii", "replace"), dtype=np.uint8)
    digit = np.full(256, np.nan)
    digit[list(_DIGITS.encode())] = np.arange(len(_DIGITS)) - _MIDDLE
    change = digit[code]
    known = np.isfinite(change)
    change = np.nan_to_num(change)
    return np.asarray(np.fft.rfft(np.stack([known.astype(np.float64), change, change**2]), size))


def logs_of(data: FlightData, series: RssSeries | RankSeries) -> tuple[str, ...]:
    """Return the SHA-256 of the logs that contain a series."""
    return tuple(data.files[number].sha256 for number in np.unique(series.log))


def flight_logs(data: FlightData) -> tuple[str, ...]:
    """Return the SHA-256 of every log of a flight with RSS or rank."""
    return union(*(logs_of(data, s) for s in data.rss), *(logs_of(data, s) for s in data.rank))


def learned_patterns(link: Link, folder: Path, site: str | Path) -> list[MeasuredPattern]:
    """Return the antennas of a link that were learned from flights, recognised by their files or their gains.

    Parameters
    ----------
    link : Link
    folder : Path
        Folder of the antenna files and of calibrations.
    site : str or Path
        Site with learned tables. If the file of an antenna does not name its training logs, a table with the same gains
        is searched for there.

    Returns
    -------
    list of MeasuredPattern
    """
    arrays = [*link.tower_arrays.values(), link.uav_array]
    patterns = [p for array in arrays for p in array.patterns if isinstance(p, MeasuredPattern)]
    known = (p if p.trained_on else _original(p, folder, folder_of(site)) for p in patterns)
    return [pattern for pattern in known if pattern is not None]


def learned_here(data: FlightData, series: RssSeries, link: Link) -> tuple[str, ...]:
    """Return the logs of a series from which its antennas or the settings of its flight file were learned."""
    logs, settings = logs_of(data, series), data.settings
    patterns = learned_patterns(link, data.folder, data.site_place)
    if is_training_data(data, (), union(settings.marks, *(p.marks for p in patterns))):
        return logs
    return common(logs, [settings.trained_on, *(p.trained_on for p in patterns)])


def knows(data: FlightData, learned: Sequence[MeasuredPattern | FlightFile]) -> bool:
    """Check whether antennas or settings were learned from a log of a flight."""
    return is_training_data(data, union(*(i.trained_on for i in learned)), union(*(i.marks for i in learned)))


def is_training_data(data: FlightData, trained_on: Sequence[str], marks: Sequence[str]) -> bool:
    """Check whether a log of a flight is one of the training logs, by its SHA-256 or fingerprint."""
    return bool(common(flight_logs(data), [trained_on])) or any(among(mark, marks) for mark in marks_of([data]))


def series_mark(series: RssSeries | RankSeries) -> str:
    """Return the fingerprint of the levels or ranks of a series."""
    return mark_of(series.time, series.measured_db if isinstance(series, RssSeries) else series.rank)


def marks_of(flights: Iterable[FlightData]) -> tuple[str, ...]:
    """Return the fingerprints of all series of some flights."""
    every: list[str] = []
    for data in flights:
        if not data.kept_marks:
            data.kept_marks.extend(series_mark(series) for _, series in data.series)
        every += filter(None, data.kept_marks)
    return tuple(every)


@lru_cache(maxsize=64)
def _original(pattern: MeasuredPattern, folder: Path, memory: Path) -> SpherePattern | None:
    """Return the learned table with the same gains as an antenna whose file does not name its logs, or None.

    The table is searched for among the learned tables of the site and of packaged sites, and the calibrations in the
    folder.
    """
    packaged = folder_of("lake_wheeler").parent.glob("*.learned/*.csv.gz")
    # search the site's learned tables first, because most antennas are found there
    places = dict.fromkeys([*memory.glob("*.csv.gz"), *packaged, *folder.glob("*.csv"), *folder.glob("*/*.csv")])
    tables = (table for place in places if (table := _learned_table(place)) is not None)
    return next((table for table in tables if _same_numbers(pattern, table)), None)


@lru_cache(maxsize=64)
def _learned_table(place: Path) -> SpherePattern | None:
    """Return the learned table in a file, or None if the file is not a learned table."""
    with suppress(InputError, OSError, EOFError, zlib.error):
        with gzip.open(place) if place.suffix == ".gz" else place.open("rb") as book:
            learned = book.read(len(LEARNED)) == LEARNED.encode()
        return read_sphere_csv(place) if learned else None
    return None


def _same_numbers(pattern: MeasuredPattern, table: SpherePattern) -> bool:
    """Check whether two antennas agree on both principal cuts within 0.1 dB, apart from a constant level.

    Only every third degree is compared, because splines interpolate files of cuts in between.
    """
    angle = np.radians(np.arange(3.0, 358.0, 3.0))
    theta = np.concatenate([np.full(len(angle), np.pi / 2), np.where(angle < np.pi, angle, 2 * np.pi - angle)])
    phi = np.concatenate([angle, np.where(angle < np.pi, 0.0, np.pi)])
    gain, other = pattern.gain_dbi(theta, phi), table.gain_dbi(theta, phi)
    # ignore a constant level, because programs normalise patterns to their maximum
    apart = np.abs(gain - other - np.median(gain - other))
    # reject flat patterns, because they would agree with many others
    return bool(np.ptp(other) > 1.0 and np.mean(apart < 0.06) > 0.95)


def common(logs: Sequence[str], learned: Iterable[Iterable[str]]) -> tuple[str, ...]:
    """Return the logs that are training logs in any of ``learned``."""
    known = set(union(*learned))
    return tuple(digest for digest in logs if digest in known)


def counted_once(flights: Sequence[FlightData]) -> tuple[list[FlightData], list[str]]:
    """Return flights without the series whose log is also in an earlier flight, and remarks about these series.

    If a log occurred twice (renamed, copied or packed), it would be predicted from itself.
    """
    home: dict[str, str] = {}
    counted: list[FlightData] = []
    remarks: list[str] = []
    known: list[tuple[str, str]] = []
    for data in flights:
        name = data.settings.flight.name
        again = {digest: home[digest] for digest in flight_logs(data) if digest in home}
        for digest, first in again.items():
            remarks.append(f"{name} contains the same log as {first} (SHA-256 {digest[:12]}...): it is counted once")
        marked = [(logs_of(data, s), series_mark(s)) for _, s in data.series]
        for logs, ours in marked:
            earlier = [] if set(logs) & set(again) else [flight for flight, mark in known if among(ours, [mark])]
            if earlier:
                remarks.append(f"{name} contains readings of {earlier[0]} in another log: they are counted once")
                again |= dict.fromkeys(flight_logs(data), earlier[0])
        known += [(name, ours) for _, ours in marked]
        rss = tuple(s for s in data.rss if not set(logs_of(data, s)) & set(again))
        rank = tuple(s for s in data.rank if not set(logs_of(data, s)) & set(again))
        if not again:
            counted.append(data)
        elif rss or rank:
            counted.append(dataclasses.replace(data, rss=rss, rank=rank))
        home |= {digest: name for digest in flight_logs(data) if digest not in home}
    return counted, list(dict.fromkeys(remarks))
