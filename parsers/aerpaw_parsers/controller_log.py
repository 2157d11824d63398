"""Console of the AADM controller (stdout through ``ts``): blocks ``[Controller-->UAV] SNR:`` then ``n:value`` lines.

Value lines under ``Download:`` have the same shape and are no levels. All other lines are the console's talk and
count as comments.
"""

from __future__ import annotations

import re

import numpy as np

from aerpaw_cmp.logs.readers import Reader, ReadOptions
from aerpaw_cmp.logs.records import ReadResult

from . import _lines, _rows, _time

_STAMP = rb"^\[(?P<time>" + _time.TIME + rb")\] "
_VALUE = re.compile(_STAMP + rb"(?P<tower>\d{1,2}):(?P<snr>" + _lines.NUMBER + rb"|nan|-?inf)[ \t]*\r?$", re.MULTILINE)
_BLOCK = re.compile(_STAMP + rb"[^\n]{0,40}?\[Controller-->UAV\] (?P<what>SNR|Download):[ \t]*\r?$", re.MULTILINE)
_TORN = re.compile(_STAMP + rb"\d{1,2}:")


def sniff(head: bytes) -> bool:
    """Whether it is a console with the controller's marks."""
    return head.startswith(b"[") and (b"[Controller-->UAV]" in head or b"[UAV-->Controller]" in head)


def read(data: bytes, options: ReadOptions) -> ReadResult:
    """One SNR stream per tower number, named ``LW<n>``; UsageError if no time zone is given."""
    heads, kinds = _lines.match(_lines.split(data), _BLOCK)
    of_levels = np.array([False] + [kind[1] == b"SNR" for kind in kinds], dtype=bool)
    rows = _rows.matched(
        data, _VALUE, options, reader="controller_log",
        reason=_rows.torn(_TORN, "an incomplete 'tower:value' line (torn line?)"),
        # the block that a value line stands in is that of the last head before it
        skip=lambda row: ~of_levels[np.searchsorted(heads, row)],
    )  # fmt: skip
    tower, level = rows.number("tower"), rows.number("snr")
    numbers = np.unique(tower[np.isfinite(tower)]).astype(int).tolist()
    return rows.result(_rows.snr(rows, f"LW{number}", level, tower == number) for number in numbers)


READER = Reader(
    name="controller_log",
    title="AADM controller console: SNR of each tower",
    kinds=("rss",),
    sample="[2025-01-01 12:00:07.000002] 1:-1.250000",
    sniff=sniff,
    read=read,
)
