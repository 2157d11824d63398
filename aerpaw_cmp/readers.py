"""Names that a reader of a log format needs, in this repository or in a separate package: docs/adding_a_reader.md.

A format of lines is a regular expression and the streams of its columns (:func:`text_reader`); any other is a pair of
functions ``sniff(head)`` and ``read(data, options)`` in a :class:`Reader`. A reader lists itself under the entry-point
group ``aerpaw_cmp.readers``.
"""

from __future__ import annotations

from .common.errors import InputError, UsageError
from .logs import dictionary
from .logs.readers import ENTRY_POINT_GROUP, Reader, ReadOptions
from .logs.records import COLUMNS, Kind, ReadResult, RejectedLine, RejectedReason, Stream
from .logs.rows import Rows, built, matched, of_ues
from .logs.rows import reader as text_reader
from .logs.text import NUMBER, TIME, ZONE, Lines, add_flag, first_lines, mostly, split

__all__ = [
    "COLUMNS",
    "ENTRY_POINT_GROUP",
    "NUMBER",
    "TIME",
    "ZONE",
    "InputError",
    "Kind",
    "Lines",
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
    "dictionary",
    "first_lines",
    "matched",
    "mostly",
    "of_ues",
    "split",
    "text_reader",
]
