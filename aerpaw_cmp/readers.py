"""The names that a reader of a log format uses, in this repository or in a separate package (docs/adding_a_reader.md).

For a format of text lines, a reader consists of a regular expression and the streams of its columns
(:func:`text_reader`). For any other format, a reader is a :class:`Reader` with two functions, ``sniff(head)`` and
``read(data, options)``. The package of a reader declares the reader under the entry-point group ``aerpaw_cmp.readers``.
"""

from __future__ import annotations

from .common.errors import InputError, UsageError
from .common.text import counted
from .common.units import AnyArray, BoolArray, FloatArray, IntArray
from .logs import dictionary
from .logs.readers import ENTRY_POINT_GROUP, Reader, ReadOptions
from .logs.records import COLUMNS, KEPT_REJECTED, Attribute, Kind, ReadResult, RejectedLine, RejectedReason, Stream
from .logs.rows import (
    BOM,
    NO_TIME,
    RELATIVE,
    LineFormat,
    OtherLines,
    Rows,
    built,
    checked_ranks,
    instants_of,
    matched,
    mean_rank,
    of_ues,
    snr_stream,
    text_reader,
)
from .logs.text import NUMBER, TIME, ZONE, Lines, add_flag, first_lines, match, mostly, no_flags, split

__all__ = [
    "BOM",
    "COLUMNS",
    "ENTRY_POINT_GROUP",
    "KEPT_REJECTED",
    "NO_TIME",
    "NUMBER",
    "RELATIVE",
    "TIME",
    "ZONE",
    "AnyArray",
    "Attribute",
    "BoolArray",
    "FloatArray",
    "InputError",
    "IntArray",
    "Kind",
    "LineFormat",
    "Lines",
    "OtherLines",
    "ReadOptions",
    "ReadResult",
    "Reader",
    "RejectedLine",
    "RejectedReason",
    "Rows",
    "Stream",
    "UsageError",
    "add_flag",
    "built",
    "checked_ranks",
    "counted",
    "dictionary",
    "first_lines",
    "instants_of",
    "match",
    "matched",
    "mean_rank",
    "mostly",
    "no_flags",
    "of_ues",
    "snr_stream",
    "split",
    "text_reader",
]
