"""Lines of a text log, their clocks, and the frames of their records.

Lines are byte ranges of a file, without a Python object per line. A line ends with LF, and a CR before it belongs to
the line end. Text after the last LF is also a line. A file that ends with LF has no additional empty line.

Wall clocks of all readers become UTC here. Almost all AERPAW nodes write naive America/New_York time. Some authors
stored that wall clock as if it were UTC.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta, timezone, tzinfo
from functools import cached_property
from typing import Any, NamedTuple
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

import numpy as np
import pandas as pd

from ..common.errors import UsageError
from ..common.text import counted
from ..common.units import AnyArray, BoolArray, IntArray
from .dictionary import WINTER
from .readers import ReadOptions
from .records import COLUMNS, KEPT_REJECTED, Attribute, Kind, RejectedLine, RejectedReason, by_reason

# Largest number of characters of a rejected line that are stored.
TEXT_LIMIT = 500

# Flag of a record in a last line without line end: its last field may be cut short.
UNTERMINATED = "unterminated_line"

# Reason for rejecting a line with NUL bytes.
NUL = "NUL bytes in the line (the file system was not synced when the power failed)"

# First bytes of markup files, which are neither consoles nor tables.
MARKUP = (b"<?xml", b"<kml", b"<gpx")

# A decimal number of bounded length (bytes pattern, no group), as accepted by the parser of pandas.
NUMBER = rb"[-+]?\d{1,400}(?:\.\d{0,400})?(?:[eE][-+]?\d{1,400})?"


@dataclass(frozen=True)
class Lines:
    """The lines of ``data``: line ``i`` (0-based) is ``data[starts[i]:ends[i]]``, without its line end."""

    data: bytes
    starts: IntArray
    ends: IntArray

    def __len__(self) -> int:
        """Return the number of lines."""
        return len(self.starts)

    @cached_property
    def buffer(self) -> AnyArray:
        """The bytes as a uint8 array."""
        return np.frombuffer(self.data, dtype=np.uint8)

    @property
    def unterminated(self) -> bool:
        """True if the last line has no line end."""
        return bool(self.data) and not self.data.endswith(b"\n")

    @cached_property
    def blank(self) -> BoolArray:
        """The mask of lines that contain only white space."""
        empty = self.ends <= self.starts
        # test only the few lines that begin and end with white space one by one
        some = np.flatnonzero(~empty)
        ends = self.buffer[[self.starts[some], self.ends[some] - 1]]
        for i in some[np.isin(ends, [*b" \t\r\v\f"]).all(axis=0)].tolist():
            empty[i] = not self.raw(i).strip()
        return empty

    def raw(self, i: int) -> bytes:
        """Return the bytes of line ``i``."""
        return self.data[self.starts[i] : self.ends[i]]

    def number_at(self, offsets: Iterable[int]) -> IntArray:
        """Return the 0-based lines that contain bytes of the file, by their offsets."""
        return np.searchsorted(self.starts, np.array([*offsets], dtype=np.int64), side="right") - 1

    def text(self, i: int) -> str:
        """Return line ``i`` as text of at most ``TEXT_LIMIT`` characters, with undecodable bytes replaced."""
        piece = self.data[self.starts[i] : min(self.ends[i], self.starts[i] + 4 * TEXT_LIMIT)]
        return piece.decode("utf-8", errors="replace")[:TEXT_LIMIT]

    def reject(self, i: int, reason: str) -> RejectedLine:
        """Return line ``i`` as a rejected line."""
        return RejectedLine(int(i) + 1, reason, self.text(i))

    def reject_all(self, numbers: Iterable[int], reason: str) -> list[RejectedLine]:
        """Return several lines as rejected for one reason."""
        return [self.reject(int(i), reason) for i in numbers]

    def fixed(self, numbers: IntArray, width: int) -> AnyArray:
        """Return the bytes of equally long lines as a ``(len(numbers), width)`` uint8 array."""
        if len(numbers) == 0:
            return np.empty((0, width), dtype=np.uint8)
        starts = self.starts[numbers]
        stride = int(starts[1] - starts[0]) if len(numbers) > 1 else width
        if (np.diff(starts) == stride).all():  # equally spaced lines need only a view, not a copy
            return np.lib.stride_tricks.as_strided(
                self.buffer[starts[0] :], (len(numbers), width), (stride, 1), writeable=False
            )
        return np.asarray(self.buffer[starts[:, None] + np.arange(width)])


# Number of bytes that are searched at a time. So many bytes fit in the processor's cache.
_SLICE = 1 << 17


def _places(buffer: AnyArray, byte: int) -> IntArray:
    """Return the offsets of a byte, shape (n,)."""
    starts = range(0, len(buffer), _SLICE)
    # search slice by slice, because a mask would be as large as the buffer
    parts = [np.flatnonzero(buffer[first : first + _SLICE] == byte) + first for first in starts]
    return np.concatenate([np.zeros(0, dtype=np.int64), *parts])


def split(data: bytes) -> Lines:
    r"""Split a file into lines.

    Examples
    --------
    >>> [bytes(split(b"a\r\n\nb").raw(i)) for i in range(3)]
    [b'a', b'', b'b']
    """
    buffer = np.frombuffer(data, dtype=np.uint8)
    ends = _places(buffer, 10)
    starts = np.empty(len(ends) + 1, dtype=np.int64)
    starts[0] = 0
    np.add(ends, 1, out=starts[1:])
    if len(data) and data[-1] != 10:
        ends = np.append(ends, len(data))
    else:
        starts = starts[:-1]
    if len(ends) and b"\r" in data:
        # an empty first line has no byte before it
        before = buffer[np.maximum(ends - 1, 0)]
        ends = np.where((ends > starts) & (before == 13), ends - 1, ends)
    return Lines(data, starts, ends)


def match(lines: Lines, pattern: re.Pattern[bytes]) -> tuple[IntArray, list[tuple[bytes, ...]]]:
    r"""Return the lines that match a pattern, and the groups of the pattern.

    Parameters
    ----------
    pattern : re.Pattern
        MULTILINE, from ``^`` to ``\\r?$``, unable to cross a line end, every repetition bounded.

    Returns
    -------
    numbers : int array, shape (n,)
        0-based numbers of the matching lines.
    groups : list of tuple of bytes, length n
        One tuple per line.
    """
    if b"\r\r" in lines.data:  # the pattern allows one carriage return, and raw() removes another one
        tried = ((i, pattern.match(lines.raw(i))) for i in range(len(lines)))
        hits = [(int(lines.starts[i]), hit.groups(b"")) for i, hit in tried if hit is not None]
    else:
        hits = [(hit.start(), hit.groups(b"")) for hit in pattern.finditer(lines.data)]
    return np.searchsorted(lines.starts, np.array([at for at, _ in hits], dtype=np.int64)), [row for _, row in hits]


class Rejects:
    """The rejected lines of a log that is read in pieces: the first lines verbatim, and the count per reason."""

    def __init__(self) -> None:
        self.before = 0  # number of lines in earlier pieces
        self._first_lines: list[RejectedLine] = []
        self._reasons: list[RejectedReason] = []

    def add(self, lines: Lines, numbers: Sequence[int] | IntArray, reason: str) -> None:
        """Add lines (0-based) of a piece for one reason, and store the first lines of each piece."""
        if not len(numbers):
            return
        # count line numbers from the beginning of the file
        low, high = int(min(numbers)) + self.before + 1, int(max(numbers)) + self.before + 1
        self._reasons.append(RejectedReason(reason, len(numbers), low, high))
        # store more lines than are kept, because the reasons of one piece are not added in the order of the file
        if len(self._first_lines) < 4 * KEPT_REJECTED:
            for i in sorted(numbers)[:KEPT_REJECTED]:
                self._first_lines.append(RejectedLine(int(i) + self.before + 1, reason, lines.text(int(i))))

    def add_line(self, number: int, reason: str, text: str) -> None:
        """Add a line by its number, counted from 1."""
        self._reasons.append(RejectedReason(reason, 1, number, number))
        if len(self._first_lines) < 8 * KEPT_REJECTED:
            self._first_lines.append(RejectedLine(number, reason, text))

    def result(self) -> tuple[tuple[RejectedLine, ...], tuple[RejectedReason, ...]]:
        """Return the first rejected lines in the order of the file, and the reasons."""
        ordered = sorted(self._first_lines, key=lambda line: line.number)[:KEPT_REJECTED]
        return tuple(ordered), by_reason(self._reasons)


def remainder(
    lines: Lines, accepted: IntArray, reason: Callable[[bytes], str | None], *, blank: IntArray | None = None
) -> tuple[int, list[RejectedLine]]:
    """Account for the lines without a record.

    Parameters
    ----------
    lines : Lines
    accepted : int array
        0-based numbers of the lines with records.
    reason : callable
        Function that returns why a line is rejected, or None for a header or comment.
    blank : int array, optional
        0-based numbers already known to be headers or comments.

    Returns
    -------
    blank : int
    rejected : list of RejectedLine
    """
    unaccounted = np.ones(len(lines), dtype=bool)
    unaccounted[accepted] = False
    known = lines.blank & unaccounted
    if blank is not None:
        known[blank] = True
    count = int(known.sum())
    rejected: list[RejectedLine] = []
    for i in np.flatnonzero(unaccounted & ~known):
        line = lines.raw(int(i))
        why = reason(line)
        if why is None:
            count += 1
        else:
            rejected.append(lines.reject(int(i), NUL if b"\0" in line else why))
    return count, rejected


def columns(groups: list[tuple[bytes, ...]], count: int) -> list[AnyArray]:
    """Return groups by column, as fixed-width byte arrays."""
    return [cells([group[i] for group in groups]) for i in range(count)]


def cells(texts: Sequence[bytes]) -> AnyArray:
    """Return texts as an array of bytes. An empty list becomes an empty array of bytes."""
    return np.array(texts or [b""], dtype=np.bytes_)[: len(texts)]


def numbers(column: AnyArray) -> AnyArray:
    """Convert numbers from text to float64, with NaN for empty text."""
    if column.dtype.itemsize == 0 or len(column) == 0:
        return np.full(len(column), np.nan)
    # None is NaN, too: Python programs print it for an unknown value
    return np.asarray(np.where((column == b"") | (column == b"None"), b"nan", column).astype(np.float64))


def no_flags(count: int) -> AnyArray:
    """Return an empty flag column."""
    column = np.empty(count, dtype=object)
    column.fill("")  # use one object for all rows, because np.full would create one object per row
    return column


def add_flag(column: AnyArray, mask: BoolArray, reason: str) -> None:
    """Add a reason to the flags in place where the mask is true."""
    if mask.any():
        old = column[mask]
        if (old != "").any():
            column[mask] = [f"{text};{reason}" if text else reason for text in old]
        else:
            column[mask] = reason  # one object for all rows


def first_lines(head: bytes) -> list[bytes]:
    """Return up to forty complete, non-blank lines at the start of a file, which sniffers test."""
    pieces = head[:16_384].split(b"\n")
    if len(head) > 16_384 or (len(pieces) > 1 and not head.endswith(b"\n")):
        pieces = pieces[:-1]  # a truncated line cannot confirm the format
    return [piece.rstrip(b"\r") for piece in pieces if piece.strip()][:40]


def mostly(head: bytes, pattern: re.Pattern[bytes]) -> bool:
    """Check whether more than half of the first lines match the pattern."""
    lines = first_lines(head)
    return bool(lines) and 2 * sum(pattern.match(line) is not None for line in lines) > len(lines)


_AMBIGUOUS = "ambiguous_local_time"
_NONEXISTENT = "nonexistent_local_time"
# Wall clock as AERPAW tools write it (bytes pattern, no group).
TIME = rb"\d{4}[-/]\d\d[-/]\d\d[ T]\d\d:\d\d:\d\d(?:\.\d{1,9})?"
# Optional offset after :data:`TIME`.
ZONE = rb"(?:Z|[+-]\d\d:?\d\d)?"


class Count(NamedTuple):
    """A unit of time: its name, nanoseconds, pattern in column names, and the smallest count that is a Unix time."""

    name: str
    ns: float
    word: re.Pattern[str]
    least_epoch: float


# Units in the order in which they are searched for in a name. A count of 1e9 microseconds is not a Unix time: it is a
# quarter of an hour of PX4's own clock.
COUNTS = {
    "ns": Count("nanoseconds", 1.0, re.compile(r"\bn(s|sec|anos\w*)\b"), 1e18),
    "us": Count("microseconds", 1e3, re.compile(r"(\b|time|stamp)(us|usec|micros\w*)\b"), 1e15),
    "ms": Count("milliseconds", 1e6, re.compile(r"(\b|time|stamp)ms\b|^m?sec$|millis"), 1e12),
    "s": Count("seconds", 1e9, re.compile(r" s$|^s$|\bsec(ond)?s\b"), 1e9),
    "min": Count("minutes", 6e10, re.compile(r"\bmin(ute)?s?\b"), math.inf),
    "h": Count("hours", 3.6e12, re.compile(r" h$|^h$|\bh(ou)?rs?\b"), math.inf),
}

_BUCKET_S = 900  # no zone in use changes its offset within a quarter of an hour of wall clock


@dataclass(frozen=True)
class Instants:
    """UTC times, with masks of the doubtful times.

    Parameters
    ----------
    time : datetime64[ns] array, shape (n,)
        Times in UTC, naive.
    ambiguous, nonexistent : bool array, shape (n,)
        True for a wall clock that occurs twice, or never, because of a change between winter and summer time.
    warnings : tuple of str
        Sentences for the user.
    zoned : bool
        True if all texts have an offset.
    """

    time: AnyArray
    ambiguous: BoolArray
    nonexistent: BoolArray
    warnings: tuple[str, ...] = field(default=())
    zoned: bool = False

    def flag(self, column: AnyArray) -> None:
        """Add the reasons to a flag column, in place."""
        add_flag(column, self.ambiguous, _AMBIGUOUS)
        add_flag(column, self.nonexistent, _NONEXISTENT)


def zone(name: str | None, *, needed_by: str) -> tzinfo:
    """Return the named zone. If there is no name, the UsageError names the key ``timezone:``."""
    if not name:
        raise UsageError(
            f"no time zone for the clock of {needed_by}, which has no zone",
            expected="the key 'timezone:' or --timezone, e.g. America/New_York",
            cause="the log writes local wall time without an offset",
        )
    if name.upper() == "UTC":  # available without a zone database
        return timezone.utc
    try:
        return ZoneInfo(name)
    except (ZoneInfoNotFoundError, ValueError, OSError) as error:
        from ..common.yamlfile import nearest_zone

        near = nearest_zone(name)
        raise UsageError(
            f"unknown time zone {name!r}",
            expected="an IANA name for 'timezone:' or --timezone, e.g. America/New_York",
            cause=f"did you mean '{near}'?" if near else "a misspelt name, or no zone database on this machine",
        ) from error


def _offset_s(wall_s: int, where: tzinfo, fold: int) -> int:
    try:
        moment = datetime(1970, 1, 1) + timedelta(seconds=wall_s)
        # fold 0 and 1 differ if the wall time occurs twice or never
        offset = moment.replace(tzinfo=where, fold=fold).utcoffset()
    except (OverflowError, ValueError):
        return 0
    # round, because before 1900 offsets of some zones had fractions of a minute
    return 0 if offset is None else round(offset.total_seconds())


def _offsets_s(buckets: IntArray, where: tzinfo, fold: int) -> IntArray:
    return np.array([_offset_s(bucket * _BUCKET_S, where, fold) for bucket in buckets.tolist()], dtype=np.int64)


def local_to_utc(wall_ns: IntArray, name: str | None, *, needed_by: str) -> Instants:
    """Convert the wall clock of a zone to UTC.

    A wall clock that occurs twice is read as daylight time until the log's clock steps back by half an hour or more,
    and as winter time afterwards. A wall clock that never occurs is read with the offset before the change. Times of
    both kinds are flagged.

    Parameters
    ----------
    wall_ns : int array, shape (n,)
        Wall clock as nanoseconds since 1970-01-01 00:00 of the same wall clock.
    name : str or None
        IANA zone.
    needed_by : str
        Name of the log or option that needs the zone, for the message.

    Raises
    ------
    UsageError
        If the zone is missing or unknown, or is a winter time although the times are in summer.
    """
    where = zone(name, needed_by=needed_by)
    starts, buckets, index = _runs(wall_ns)
    first, second = (_offsets_s(buckets, where, fold) for fold in (0, 1))
    hours, turned = WINTER.get(name or "", [(0.0, "")])[0]
    if turned and (first != _offsets_s(buckets, zone(turned, needed_by=needed_by), 0)).any():
        raise UsageError(
            f"{name} is a winter time, but times of {needed_by} are in summer",
            expected=f"timezone: {turned} (with summer time) or Etc/GMT{-hours:+.0f} (without)",
        )
    length = np.diff(np.append(starts, len(wall_ns)))
    ambiguous = np.repeat((first > second)[index], length)
    nonexistent = np.repeat((first < second)[index], length)
    utc = np.repeat(first[index] * 1_000_000_000, length)
    np.subtract(wall_ns, utc, out=utc)  # in place, for a log of 1 GB
    warnings = []
    if ambiguous.any():
        back = np.flatnonzero(np.diff(wall_ns // 1_000_000_000) <= -1800)
        behind = ambiguous.copy()
        behind[: back[0] + 1 if len(back) else None] = False
        # when an hour occurs a second time, its UTC is later by the change of the clock
        utc[behind] += np.repeat((first - second)[index], length)[behind] * 1_000_000_000
        warnings.append(
            f"{counted(int(ambiguous.sum()), 'time')} in the hour that occurs twice in {name}: read as daylight time "
            f"until the log's clock steps back; flagged {_AMBIGUOUS}"
        )
    if nonexistent.any():
        times = counted(int(nonexistent.sum()), "time")
        warnings.append(f"{times} in the hour that {name} skipped (wrong zone?): {_NONEXISTENT}")
    return Instants(utc.view("datetime64[ns]"), ambiguous, nonexistent, tuple(warnings))


def _runs(wall_ns: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """Divide times at quarters of an hour.

    Return the start of each run, the distinct quarters, and each run's quarter.
    """
    # look up the zone once per quarter of an hour
    bucket = wall_ns // (_BUCKET_S * 1_000_000_000)
    starts = np.flatnonzero(np.diff(bucket, prepend=bucket[:1] - 1))
    unique, index = np.unique(bucket[starts], return_inverse=True)
    return starts, unique, index


def wall_to_utc(wall_ns: IntArray, options: ReadOptions, *, needed_by: str) -> Instants:
    """Convert times without a zone to UTC. The times are local unless ``clock: utc`` is set in the options."""
    if options.clock == "utc":
        none = np.zeros(len(wall_ns), dtype=bool)
        return Instants(wall_ns.astype("datetime64[ns]"), none, none)
    return local_to_utc(wall_ns, options.timezone, needed_by=needed_by)


def parse_digits(cells: AnyArray, fraction: int) -> tuple[IntArray, BoolArray]:
    """Convert ``YYYY-mm-dd HH:MM:SS[.f...]`` of a fixed layout to wall nanoseconds.

    Parameters
    ----------
    cells : uint8 array, shape (n, 19) or (n, 20 + fraction)
        One time per row, with ``fraction`` digits after the dot.

    Returns
    -------
    wall_ns : int array, shape (n,)
        Wall clock [ns], zero if invalid.
    valid : bool array, shape (n,)
        True for a valid date and time of day.
    """
    # Times increase, so parse each date and minute once per run of equal values. Sixteen characters are compared as two
    # integers per row.
    half = np.ascontiguousarray(cells[:, :16]).view(np.uint64)
    unlike = (half[1:, 0] != half[:-1, 0]) | (half[1:, 1] != half[:-1, 1])
    starts = np.flatnonzero(np.concatenate(([True], unlike))[: len(cells)])
    length = np.diff(np.append(starts, len(cells)))
    minute, dated = _minutes(cells[starts, :16])
    valid = np.repeat(dated, length)
    second, worst = integers(cells[:, 17:19])
    # datetime64 has no leap seconds (60)
    valid &= (worst <= 9) & (second < 60) & (cells[:, 16] == 58)
    wall = np.repeat(minute, length) + second * np.int64(1_000_000_000)
    if fraction:
        part, worst = integers(cells[:, 20 : 20 + fraction])
        valid &= (worst <= 9) & (cells[:, 19] == 46)
        wall += part * np.int64(10 ** (9 - fraction))
    wall[~valid] = 0
    return wall, valid


def integers(cells: AnyArray, base: int = 10) -> tuple[IntArray, AnyArray]:
    """Return digits, uint8 of shape (n, m), as integers, and the largest digit, above 9 if one is not a digit."""
    total, worst = np.zeros(len(cells), dtype=np.int64), np.zeros(len(cells), dtype=np.uint8)
    for column in cells.T:
        # other characters wrap around to values above 9
        digit = column - np.uint8(48)
        np.maximum(worst, digit, out=worst)
        total *= base
        total += digit
    return total, worst


def _minutes(cells: AnyArray) -> tuple[IntArray, BoolArray]:
    """Convert ``YYYY-mm-dd HH:MM``, uint8 of shape (n, 16), to wall nanoseconds, and return which are valid."""
    digit = cells[:, [0, 1, 2, 3, 5, 6, 8, 9, 11, 12, 14, 15]].T.astype(np.int32) - 48
    valid = np.all((digit >= 0) & (digit <= 9), axis=0)
    for place, allowed in ((4, b"-/"), (7, b"-/"), (10, b" T"), (13, b":")):
        valid &= (cells[:, place] == allowed[0]) | (cells[:, place] == allowed[-1])
    year = digit[0] * 1000 + digit[1] * 100 + digit[2] * 10 + digit[3]
    month, day, hour, minute = (digit[i] * 10 + digit[i + 1] for i in (4, 6, 8, 10))
    inside = np.clip(month, 1, 12)
    months = (year.astype(np.int64) - 1970) * 12 + inside - 1
    first, after = ((months + i).astype("datetime64[M]").astype("datetime64[D]").astype(np.int64) for i in (0, 1))
    # datetime64[ns] spans 1678-2262; a clock outside 1970-2261 has not been set
    valid &= (year >= 1970) & (year <= 2261) & (month == inside) & (day >= 1) & (day <= after - first)
    valid &= (hour < 24) & (minute < 60)
    wall = ((first + day - 1) * 86_400 + hour * 3600 + minute * 60) * 1_000_000_000
    return np.where(valid, wall, 0), valid


def parse_texts(column: AnyArray) -> tuple[IntArray, BoolArray, IntArray, BoolArray]:
    """Parse times as byte strings of mixed length (the form of :data:`TIME` + :data:`ZONE`).

    Returns
    -------
    wall_ns, valid : arrays, shape (n,)
        The same as in :func:`parse_digits`.
    offset_s : int array, shape (n,)
        Offset in the text, else 0.
    zoned : bool array, shape (n,)
        True if the text has an offset.
    """
    count = len(column)
    wall, offset = np.zeros((2, count), dtype=np.int64)
    valid, zoned = np.zeros((2, count), dtype=bool)
    # leave space for nine digits and an offset, so that every row can be cut at the same columns
    width = max(column.dtype.itemsize, 30)
    cells = column.astype(f"S{width}").view(np.uint8).reshape(count, width)
    digits = (cells[:, 20:29] >= 48) & (cells[:, 20:29] <= 57)
    dotted = cells[:, 19] == 46
    fraction = np.where(dotted, np.cumprod(digits, axis=1).sum(axis=1), 0)
    for length in np.unique(fraction):
        rows = np.flatnonzero(fraction == length)
        end = 20 + int(length) if length else 19
        wall[rows], valid[rows] = parse_digits(cells[rows, :end], int(length))
        tail = column[rows].astype(f"S{width}").view(f"S{1}").reshape(len(rows), width)[:, end:]
        tails = np.ascontiguousarray(tail).view(f"S{width - end}").ravel()
        for text in set(tails.tolist()):  # one entry per distinct offset
            seconds = _zone_s(text)
            of_tail = rows[tails == text]
            valid[of_tail] &= seconds is not None
            offset[of_tail], zoned[of_tail] = seconds or 0, bool(text) and seconds is not None
    wall[~valid] = 0
    return wall, valid, offset, zoned


def _zone_s(text: bytes) -> int | None:
    if text in (b"", b"Z"):
        return 0
    match = re.fullmatch(rb"([+-])(\d\d):?(\d\d)", text)
    if not match:
        return None
    return int(match[1] + match[2]) * 3600 + int(match[1] + match[3]) * 60


def texts_to_utc(column: AnyArray, options: ReadOptions, *, needed_by: str) -> tuple[Instants, BoolArray]:
    """Convert times as text to UTC with the offset in the text, else as wall clock of the zone.

    Returns
    -------
    instants : Instants
    valid : bool array, shape (n,)
        False for invalid times, which are stored as 1970-01-01 in ``instants``.
    """
    wall, valid, offset, zoned = parse_texts(column)
    naive = valid & ~zoned
    if len(wall) and naive.all():
        return wall_to_utc(wall, options, needed_by=needed_by), valid
    utc = (wall - offset * 1_000_000_000).astype("datetime64[ns]")
    ambiguous, nonexistent = np.zeros((2, len(wall)), dtype=bool)
    if not naive.any():
        return Instants(utc, ambiguous, nonexistent, zoned=bool(valid.any())), valid
    zones = np.unique(offset[zoned & valid])
    alike = (wall[naive] - zones[0] * 1_000_000_000).astype("datetime64[ns]") if len(zones) == 1 else None
    if alike is not None and _are_near(alike, utc[zoned & valid]):
        # all rows were written by one program, so times without a zone have the zone of the other times
        where = f"UTC {zones[0] / 3600:+g} h"
        text = f"{counted(int(naive.sum()), 'time')} without a zone between times at {where}: read with the same zone"
        utc[naive] = alike
        return Instants(utc, ambiguous, nonexistent, (text,), zoned=True), valid
    local = wall_to_utc(wall[naive], options, needed_by=needed_by)
    utc[naive], ambiguous[naive], nonexistent[naive] = local.time, local.ambiguous, local.nonexistent
    return Instants(utc, ambiguous, nonexistent, local.warnings), valid


def _are_near(times: AnyArray, others: AnyArray) -> bool:
    """Check whether most times are within a quarter of an hour of a time in ``others``."""
    ordered = np.sort(others)
    at = np.searchsorted(ordered, times)
    apart = [np.abs(times - ordered[place.clip(0, len(ordered) - 1)]) for place in (at - 1, at)]
    return bool(np.median(np.minimum(*apart)) < np.timedelta64(_BUCKET_S, "s"))


def origin_ns(options: ReadOptions, *, needed_by: str) -> int | None:
    """Return ``time_origin`` as UTC nanoseconds, or None if the option is absent."""
    if options.time_origin is None:
        return None
    text = str(options.time_origin).strip().encode()
    instants, valid = texts_to_utc(np.array([text or b"-"]), options, needed_by=f"time_origin of {needed_by}")
    if not valid[0]:
        raise UsageError(
            f"time_origin {options.time_origin!r} is not a time",
            expected="an ISO time such as 2024-07-02T15:37:10.5Z, or local time with 'timezone:'",
        )
    return int(instants.time.astype(np.int64)[0])


_INTEGERS = ("fix", "satellites")


def frame(
    kind: Kind, time: AnyArray, line: AnyArray, flag: AnyArray, values: Mapping[str, AnyArray], *, own: bool = False
) -> pd.DataFrame:
    """Return the frame of a kind, with NaN in columns that the log does not have (``fix``, ``satellites``: -1).

    The columns are copies, because streams of one log share their times.

    Parameters
    ----------
    kind : Kind
    time : (n,)
        datetime64[ns], UTC.
    line : (n,)
        Lines of the file, from 1.
    flag : (n,)
        Reasons, empty if there is no reason.
    values : mapping of str to (n,)
        Columns of the kind that the log has.
    own : bool
        True if the arrays may be used without copies, to save memory for a log of 1 GB.

    Returns
    -------
    pandas.DataFrame
    """
    array = np.asarray if own else np.array
    count = len(time)
    content: dict[str, Any] = {
        "time": array(time, dtype="datetime64[ns]"),
        "line": array(line, dtype=np.int64),
        # use objects, not pandas' string type: they need no scan of the column and are the same in every pandas version
        "flag": pd.Series(array(flag, dtype=object), dtype=object, copy=False),
    }
    for name in COLUMNS[kind]:
        dtype, missing = (np.int64, -1) if name in _INTEGERS else (np.float64, np.nan)
        content[name] = array(values[name], dtype=dtype) if name in values else np.full(count, missing)
    # copy all other arrays, because several streams may use them
    content |= {name: np.array(column) for name, column in values.items() if name not in content}
    columns: pd.DataFrame = pd.DataFrame(content, copy=False)
    return columns


def attributes(options: ReadOptions, **extra: Attribute | None) -> dict[str, Attribute]:
    """Return the known attributes from the options and from the reader."""
    merged: dict[str, Attribute | None] = {
        "node": options.node, "channel": options.channel, "frequency_hz": options.frequency_hz,
        "timezone": options.timezone, **extra,
    }  # fmt: skip
    return {name: value for name, value in merged.items() if value is not None}


def back_in_time(records: pd.DataFrame) -> list[str]:
    """Return a warning if the clock of a log steps back anywhere."""
    time = records["time"].to_numpy()
    # comparisons with NaT are False
    places = int(np.count_nonzero(time[1:] < time[:-1]))
    return [f"time steps back at {counted(places, 'place')}"] if places else []
