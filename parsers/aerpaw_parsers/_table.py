"""Tables of plain numbers at the speed of pandas' C parser, with the lines still accounted for.

pandas alone forgives too much (short rows, stray quotes) and forgets line numbers. Here the lines are chosen first,
by their number of fields; pandas reads only these, and whatever is odd about them makes the fast way step aside.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from aerpaw_cmp.common.units import AnyArray, FloatArray, IntArray

from . import _lines
from ._lines import Lines

_LONGEST = 400
"""Longer lines hold numbers that the pattern of numbers does not take."""
_PLAIN = b"0123456789+-.eE,\r\n"


def cells_at(lines: Lines, starts: IntArray, width: int) -> AnyArray:
    """Bytes of equally long fields, uint8 of shape (n, width); all lie within the data."""
    return np.asarray(np.lib.stride_tricks.sliding_window_view(lines.buffer, width)[starts])


def texts(lines: Lines, starts: IntArray, ends: IntArray) -> AnyArray:
    """Fields of any length as byte strings, shape (n,); they hold no NUL."""
    size = ends - starts
    width = int(size.max()) if len(size) else 0
    if width == 0:
        return np.zeros(len(size), dtype="S1")
    if int(size.min()) == width:
        return np.ascontiguousarray(cells_at(lines, starts, width)).view(f"S{width}").ravel()
    room = min(width, len(lines.data))
    begin = np.minimum(starts, len(lines.data) - room)  # a window at the end of the data begins before its field
    cells = np.zeros((len(size), 2 * width), dtype=np.uint8)
    cells[:, :room] = cells_at(lines, begin, room)
    late = np.flatnonzero(begin < starts)
    for i in late.tolist():
        cells[i, : size[i]] = lines.buffer[starts[i] : ends[i]]
    cells = cells[:, :width]
    cells[np.arange(width) >= size[:, None]] = 0
    return np.ascontiguousarray(cells).view(f"S{width}").ravel()


@dataclass(frozen=True)
class Fields:
    """Where the fields of those lines are that have exactly so many.

    Parameters
    ----------
    rows : int array, shape (n,)
        0-based numbers of these lines.
    begin : int array, shape (n,)
        Place of their first byte.
    ends : int array, shape (n, count)
        Place behind each field.
    """

    rows: IntArray
    begin: IntArray
    ends: IntArray

    def start(self, column: int) -> IntArray:
        """Place of the first byte of a field, shape (n,)."""
        return self.begin if column == 0 else self.ends[:, column - 1] + 1

    def width(self, column: int) -> IntArray:
        """Bytes of a field, shape (n,)."""
        return np.asarray(self.ends[:, column] - self.start(column))

    def take(self, mask: AnyArray) -> Fields:
        """The lines of a mask."""
        count, first = int(np.count_nonzero(mask)), int(np.argmax(mask)) if len(mask) else 0
        run = slice(first, first + count)  # as a rule all but a header
        pick: Any = run if mask[run].all() else mask
        return Fields(self.rows[pick], self.begin[pick], self.ends[pick])


def fields(lines: Lines, count: int, separator: int = 44) -> Fields:
    """Fields of all lines that have exactly ``count`` of them; quotes mean nothing here."""
    buffer = lines.buffer
    places = _lines.places(buffer, separator, 10)
    stop = np.append(lines.starts[1:], len(buffer) + lines.unterminated) - 1  # line ends, CRs not looked at
    if lines.unterminated:
        places = np.append(places, len(buffer))
    if len(places) == count * len(lines) and np.array_equal(places[count - 1 :: count], stop):
        rows, ends = np.arange(len(lines)), places.reshape(len(lines), count)
    else:
        last = np.searchsorted(places, stop)
        rows = np.flatnonzero(np.diff(last, prepend=-1) == count)
        ends = places[last[rows][:, None] + np.arange(1 - count, 1)]
    ends[:, -1] = lines.ends[rows]
    return Fields(rows, lines.starts[rows], ends)


def rows_of(lines: Lines, count: int) -> IntArray:
    """0-based numbers of the lines that have exactly ``count`` fields, shape (n,)."""
    return fields(lines, count).rows


def bytes_of(lines: Lines, rows: IntArray) -> bytes:
    """The chosen lines with their line ends; runs of neighbours are taken as one piece."""
    if len(rows) == len(lines):
        return lines.data
    cut = np.flatnonzero(np.diff(rows) != 1)
    first = rows[np.concatenate(([0], cut + 1))]
    last = rows[np.concatenate((cut, [len(rows) - 1]))]
    bounds = np.append(lines.starts, len(lines.data))
    return b"".join(lines.data[a:b] for a, b in zip(bounds[first].tolist(), bounds[last + 1].tolist(), strict=True))


def numbers(
    lines: Lines,
    rows: IntArray,
    count: int,
    wanted: Sequence[int] | None = None,
    *,
    strip: bytes = b"",
    also: bytes = b"",
    separator: str = ",",
) -> list[FloatArray] | None:
    """Columns of the chosen lines as float64, by the parser of pandas; an empty field is NaN.

    Parameters
    ----------
    rows : int array, shape (n,)
        0-based lines of ``count`` fields each, see :func:`fields`.
    wanted : sequence of int, optional
        Columns to read, ascending; all by default.
    strip : bytes
        Characters taken out before reading; the caller has checked where they stand.
    also : bytes
        Characters that other columns than the wanted may hold.

    Returns
    -------
    list of arrays of shape (n,), or None where the lines hold anything but plain numbers.
    """
    import pandas as pd

    if not len(rows) or int((lines.ends[rows] - lines.starts[rows]).max()) > _LONGEST:
        return None
    data = bytes_of(lines, rows)
    if strip:
        data = data.translate(None, strip)
    if data.translate(None, _PLAIN + also):
        return None  # some other character: words, NUL
    if _bare_point(data):
        return None
    if b"\r" in data and np.any(lines.buffer[lines.ends[rows] - 1] == 13):
        return None  # a CR that belongs to no line end would start a row of its own
    columns = list(range(count)) if wanted is None else list(wanted)
    try:
        frame = pd.read_csv(
            io.BytesIO(data),
            header=None,
            names=list(range(count)),
            usecols=columns,
            dtype=np.float64,
            engine="c",
            index_col=False,
            quoting=3,
            sep=separator,
        )
    except (ValueError, TypeError, OverflowError):  # pandas' parser errors are ValueErrors
        return None
    if len(frame) != len(rows):
        return None
    return [frame[column].to_numpy() for column in columns]


def _bare_point(data: bytes) -> bool:
    """Whether a point stands behind anything but a digit: pandas reads '.5', the pattern of numbers does not."""
    if data.startswith(b"."):
        return True
    buffer = np.frombuffer(data, dtype=np.uint8)
    for first in range(0, len(buffer) - 1, _lines.SLICE):
        piece = buffer[first : first + _lines.SLICE + 1]
        point = piece[1:] == 46
        point &= (piece[:-1] - np.uint8(48)) > 9
        if point.any():
            return True
    return False
