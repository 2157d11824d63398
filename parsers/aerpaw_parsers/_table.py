"""Tables of plain numbers at the speed of pandas' C parser, with the lines still accounted for.

pandas alone forgives too much (short rows, stray quotes) and forgets line numbers. Here the lines are chosen first,
by their number of fields; pandas reads only these, and whatever is odd about them makes the fast way step aside.
"""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np

from aerpaw_cmp.common.units import AnyArray, FloatArray, IntArray

from ._lines import Lines

_NO_NUMBERS = (b",.", b",-.", b",+.", b"(.", b"(-.", b"(+.")
"""pandas reads '.5' as a number, the pattern of numbers does not."""
_LONGEST = 400
"""Longer lines hold numbers that the pattern of numbers does not take."""
_PLAIN = b"0123456789+-.eE,\r\n"


def cells_at(lines: Lines, starts: IntArray, width: int) -> AnyArray:
    """Bytes of equally long fields, uint8 of shape (n, width); all lie within the data."""
    return np.asarray(np.lib.stride_tricks.sliding_window_view(lines.buffer, width)[starts])


def rows_of(lines: Lines, count: int) -> IntArray:
    """0-based numbers of the lines that have exactly ``count`` fields, shape (n,)."""
    commas = np.flatnonzero(lines.buffer == 44)
    return np.flatnonzero(np.diff(np.searchsorted(commas, lines.ends), prepend=0) == count - 1)


def fields(lines: Lines, count: int) -> tuple[IntArray, IntArray, IntArray]:
    """Byte ranges of the fields of all lines that have exactly ``count`` of them.

    Returns
    -------
    rows : int array, shape (n,)
        0-based numbers of these lines.
    starts, ends : int array, shape (n, count)
        Field ``j`` of row ``i`` is ``data[starts[i, j]:ends[i, j]]``.
    """
    commas = np.flatnonzero(lines.buffer == 44)
    first = np.searchsorted(commas, lines.starts)
    found = np.searchsorted(commas, lines.ends) - first
    rows = np.flatnonzero(found == count - 1)
    places = commas[first[rows][:, None] + np.arange(count - 1)]
    starts = np.concatenate((lines.starts[rows][:, None], places + 1), axis=1)
    ends = np.concatenate((places, lines.ends[rows][:, None]), axis=1)
    return rows, starts, ends


def _bytes_of(lines: Lines, rows: IntArray) -> bytes:
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
) -> FloatArray | None:
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
    array of shape (len(wanted), n), or None where the lines hold anything but plain numbers.
    """
    import pandas as pd

    if not len(rows) or int((lines.ends[rows] - lines.starts[rows]).max()) > _LONGEST:
        return None
    data = _bytes_of(lines, rows)
    if data.translate(None, _PLAIN + strip + also):
        return None  # some other character: words, NUL
    if any(sign in data for sign in _NO_NUMBERS):
        return None
    if np.any(lines.buffer[lines.ends[rows] - 1] == 13):
        return None  # a CR that belongs to no line end would start a row of its own
    columns = list(range(count)) if wanted is None else list(wanted)
    try:
        frame = pd.read_csv(
            io.BytesIO(data.translate(None, strip) if strip else data),
            header=None,
            names=list(range(count)),
            usecols=columns,
            dtype=np.float64,
            engine="c",
            index_col=False,
            quoting=3,
        )
    except (ValueError, TypeError, OverflowError):  # pandas' parser errors are ValueErrors
        return None
    if len(frame) != len(rows):
        return None
    value: AnyArray = frame.to_numpy().T
    return np.array(value)
