"""Lines of a file as byte ranges, without making one Python object per line.

The accounting law starts here: a line ends with LF (a CR before it belongs to the line end); a last text
without LF is a line too; a file that ends with LF has no further, empty line.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ...common.units import AnyArray, BoolArray, IntArray
from ..records import KEPT_REJECTED, RejectedLine, RejectedReason, by_reason

# Characters of a rejected line that are kept.
TEXT_LIMIT = 500

# Flag of a record in a last line without line end: its last field may be cut short.
UNTERMINATED = "unterminated_line"


# First bytes of a file of tags: no console or table.
MARKUP = (b"<?xml", b"<kml", b"<gpx")

# A decimal number of bounded length (bytes pattern, no group): what pandas' parser takes, see ``_table``.
NUMBER = rb"[-+]?\d{1,400}(?:\.\d{0,400})?(?:[eE][-+]?\d{1,400})?"


@dataclass(frozen=True)
class Lines:
    """The lines of ``data``: line ``i`` (0-based) is ``data[starts[i]:ends[i]]``, its line end left out."""

    data: bytes
    starts: IntArray
    ends: IntArray

    def __len__(self) -> int:
        """Count the lines."""
        return len(self.starts)

    @cached_property
    def buffer(self) -> AnyArray:
        """The bytes as a uint8 array."""
        return np.frombuffer(self.data, dtype=np.uint8)

    @property
    def unterminated(self) -> bool:
        """True if the last line lacks its line end."""
        return bool(self.data) and not self.data.endswith(b"\n")

    @cached_property
    def blank(self) -> BoolArray:
        """Mask of lines that hold white space only."""
        empty = self.ends <= self.starts
        # only short lines or those that begin with white space can be blank: few are looked at one by one
        first = self.buffer[np.minimum(self.starts, max(len(self.data) - 1, 0))] if len(self) else np.empty(0, np.uint8)
        for i in np.flatnonzero(
            ~empty & ((first == 32) | (first == 9) | (first == 13) | (first == 11) | (first == 12))
        ):
            empty[i] = not self.data[self.starts[i] : self.ends[i]].strip()
        return empty

    def raw(self, i: int) -> bytes:
        """Bytes of line ``i``."""
        return self.data[self.starts[i] : self.ends[i]]

    def number_at(self, offsets: Iterable[int]) -> IntArray:
        """0-based lines in which bytes of the file lie."""
        return np.searchsorted(self.starts, np.array([*offsets], dtype=np.int64), side="right") - 1

    def text(self, i: int) -> str:
        """Line ``i`` as text for people: at most ``TEXT_LIMIT`` characters, broken bytes replaced."""
        piece = self.data[self.starts[i] : min(self.ends[i], self.starts[i] + 4 * TEXT_LIMIT)]
        return piece.decode("utf-8", errors="replace")[:TEXT_LIMIT]

    def reject(self, i: int, reason: str) -> RejectedLine:
        """Line ``i`` as a rejected line."""
        return RejectedLine(int(i) + 1, reason, self.text(i))

    def reject_all(self, numbers: IntArray, reason: str) -> list[RejectedLine]:
        """Several lines rejected for one reason."""
        return [self.reject(int(i), reason) for i in numbers]

    def fixed(self, numbers: IntArray, width: int) -> AnyArray:
        """Bytes of equally long lines as a ``(len(numbers), width)`` uint8 array."""
        if len(numbers) == 0:
            return np.empty((0, width), dtype=np.uint8)
        starts = self.starts[numbers]
        stride = int(starts[1] - starts[0]) if len(numbers) > 1 else width
        if (np.diff(starts) == stride).all():  # one block of equal lines: no gather, a view is enough
            return np.lib.stride_tricks.as_strided(
                self.buffer[starts[0] :], (len(numbers), width), (stride, 1), writeable=False
            )
        return np.asarray(self.buffer[starts[:, None] + np.arange(width)])


# Bytes that a look at each byte takes at a time: they stay in the processor's cache.
_SLICE = 1 << 17


def _places(buffer: AnyArray, byte: int) -> IntArray:
    """Places where a byte stands, shape (n,)."""
    starts = range(0, len(buffer), _SLICE)
    # slice by slice: a mask of a GiB would be a GiB
    parts = [np.flatnonzero(buffer[first : first + _SLICE] == byte) + first for first in starts]
    return np.concatenate([np.zeros(0, dtype=np.int64), *parts])


def split(data: bytes) -> Lines:
    r"""Cut a file into lines.

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
        # an empty first line has nothing before it
        before = buffer[np.maximum(ends - 1, 0)]
        ends = np.where((ends > starts) & (before == 13), ends - 1, ends)
    return Lines(data, starts, ends)


def match(lines: Lines, pattern: re.Pattern[bytes]) -> tuple[IntArray, list[tuple[bytes, ...]]]:
    r"""Lines that the pattern describes, and its groups.

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
    if b"\r\r" in lines.data:  # the pattern has room for one carriage return, a line's own is left out
        tried = ((i, pattern.match(lines.raw(i))) for i in range(len(lines)))
        hits = [(int(lines.starts[i]), hit.groups(b"")) for i, hit in tried if hit is not None]
    else:
        hits = [(hit.start(), hit.groups(b"")) for hit in pattern.finditer(lines.data)]
    return np.searchsorted(lines.starts, np.array([at for at, _ in hits], dtype=np.int64)), [row for _, row in hits]


class Rejects:
    """Rejected lines of a log that is read in pieces: the first of them verbatim, all counted by reason."""

    def __init__(self) -> None:
        self.before = 0  # lines of the pieces in front of this one
        self._first_lines: list[RejectedLine] = []
        self._reasons: list[RejectedReason] = []

    def add(self, lines: Lines, numbers: Sequence[int] | IntArray, reason: str) -> None:
        """Lines (0-based) of a piece, for one reason; of each reason and piece the first are kept."""
        if not len(numbers):
            return
        # numbers count from the first piece of the file
        low, high = int(min(numbers)) + self.before + 1, int(max(numbers)) + self.before + 1
        self._reasons.append(RejectedReason(reason, len(numbers), low, high))
        # more come in the order of the file, but for the reasons of a piece
        if len(self._first_lines) < 4 * KEPT_REJECTED:
            for i in sorted(numbers)[:KEPT_REJECTED]:
                self._first_lines.append(RejectedLine(int(i) + self.before + 1, reason, lines.text(int(i))))

    def add_line(self, number: int, reason: str, text: str) -> None:
        """A line by its number from 1."""
        self._reasons.append(RejectedReason(reason, 1, number, number))
        if len(self._first_lines) < 8 * KEPT_REJECTED:
            self._first_lines.append(RejectedLine(number, reason, text))

    def result(self) -> tuple[tuple[RejectedLine, ...], tuple[RejectedReason, ...]]:
        """The first of them in the order of the file, and the reasons."""
        ordered = sorted(self._first_lines, key=lambda line: line.number)[:KEPT_REJECTED]
        return tuple(ordered), by_reason(self._reasons)


def remainder(
    lines: Lines, accepted: IntArray, reason: Callable[[bytes], str | None], *, blank: IntArray | None = None
) -> tuple[int, list[RejectedLine]]:
    """Account for the lines that gave no record.

    Parameters
    ----------
    lines : Lines
    accepted : int array
        0-based numbers of the lines that gave records.
    reason : callable
        Reason why a line is rejected, or None for a header or comment.
    blank : int array, optional
        0-based numbers already known to be headers or comments.

    Returns
    -------
    blank : int
    rejected : list of RejectedLine
    """
    unaccounted = np.ones(len(lines), dtype=bool)
    unaccounted[accepted] = False
    if not unaccounted.any() and blank is None:
        return 0, []
    known = lines.blank & unaccounted
    if blank is not None:
        known[blank] = True
    count = int(known.sum())
    rejected: list[RejectedLine] = []
    for i in np.flatnonzero(unaccounted & ~known):
        why = reason(lines.raw(int(i)))
        if why is None:
            count += 1
        else:
            rejected.append(lines.reject(int(i), why))
    return count, rejected


def columns(groups: list[tuple[bytes, ...]], count: int) -> list[AnyArray]:
    """Groups by column, as fixed-width byte arrays."""
    return [cells([group[i] for group in groups]) for i in range(count)]


def cells(texts: Sequence[bytes]) -> AnyArray:
    """Texts as an array of bytes; NumPy makes none of an empty list."""
    return np.array(texts or [b""], dtype=np.bytes_)[: len(texts)]


def numbers(column: AnyArray) -> AnyArray:
    """Text of numbers to float64; empty text is NaN."""
    if column.dtype.itemsize == 0 or len(column) == 0:
        return np.full(len(column), np.nan)
    # Python programs print None for what they do not know
    return np.asarray(np.where((column == b"") | (column == b"None"), b"nan", column).astype(np.float64))


def flags(count: int) -> AnyArray:
    """Empty flag column."""
    column = np.empty(count, dtype=object)
    column.fill("")  # one object; np.full would make one per row
    return column


def add_flag(column: AnyArray, mask: BoolArray, reason: str) -> None:
    """Add a reason where the mask holds, in place."""
    if mask.any():
        old = column[mask]
        if (old != "").any():
            column[mask] = [f"{text};{reason}" if text else reason for text in old]
        else:
            column[mask] = reason  # one object for all rows


def first_lines(head: bytes, count: int = 40) -> list[bytes]:
    """Complete, non-blank lines at the start of a file: what sniffers judge by."""
    # enough for any forty lines of a log
    pieces = head[:16_384].split(b"\n")
    if len(head) > 16_384 or (len(pieces) > 1 and not head.endswith(b"\n")):
        pieces = pieces[:-1]  # a cut line proves nothing
    return [piece.rstrip(b"\r") for piece in pieces if piece.strip()][:count]


def mostly(head: bytes, pattern: re.Pattern[bytes], *, skip: int = 0) -> bool:
    """Check whether the pattern describes more than half of the first lines."""
    lines = first_lines(head)[skip:]
    return bool(lines) and 2 * sum(pattern.match(line) is not None for line in lines) > len(lines)
