"""Console of the AADM controller (stdout through ``ts``): blocks ``[Controller-->UAV] SNR:`` then ``n:value`` lines.

Value lines under ``Download:`` have the same shape and are no levels. All other lines are the console's talk and
count as comments.
"""

from __future__ import annotations

import re

import numpy as np

from aerpaw_cmp.logs.readers import Reader, ReadOptions
from aerpaw_cmp.logs.records import ReadResult

from . import _lines, _time, aadm_snr

_STAMP = rb"^\[(" + _time.TIME + rb")\] "
_VALUE = re.compile(_STAMP + rb"(\d{1,2}):(" + _lines.NUMBER + rb"|nan|-?inf)[ \t]*\r?$", re.MULTILINE)
_BLOCK = re.compile(
    rb"^\[" + _time.TIME + rb"\] [^\n]{0,40}?\[Controller-->UAV\] (SNR|Download):[ \t]*\r?$", re.MULTILINE
)
_TORN = re.compile(_STAMP + rb"\d{1,2}:")


def sniff(head: bytes) -> bool:
    """Whether it is a console with the controller's marks."""
    return head.startswith(b"[") and (b"[Controller-->UAV]" in head or b"[UAV-->Controller]" in head)


def _reason(line: bytes) -> str | None:
    return "an incomplete 'tower:value' line (torn line?)" if _TORN.match(line) else None


def read(data: bytes, options: ReadOptions) -> ReadResult:
    """One SNR stream per tower number, named ``LW<n>``.

    Raises
    ------
    UsageError
        If no time zone is given.
    """
    lines = _lines.split(data)
    heads, kinds = _lines.match(lines, _BLOCK)
    rows, groups = _lines.match(lines, _VALUE)
    column = _lines.columns(groups, 3)
    # the block that a value line stands in: the last head before it
    before = np.searchsorted(heads, rows) - 1
    levels = np.array([kind[0] == b"SNR" for kind in kinds] + [False], dtype=bool)[before] & (before >= 0)
    instants, valid = _time.texts_to_utc(column[0], options, needed_by="controller_log")
    comments = rows[(before >= 0) & ~levels]
    stray = rows[before < 0]
    blank, rejected = _lines.remainder(lines, rows, _reason)
    rejected += lines.reject_all(stray, "a 'tower:value' line outside any block")
    rejected += lines.reject_all(rows[levels & ~valid], "the time stamp is no date of the calendar")
    take = levels & valid
    flag = _lines.flags(len(rows))
    instants.flag(flag)
    if lines.unterminated:
        _lines.add_flag(flag, rows == len(lines) - 1, _lines.UNTERMINATED)
    tower, value = _lines.numbers(column[1]), _lines.numbers(column[2])
    streams = []
    for number in np.unique(tower[take]).astype(int).tolist():
        mine = take & (tower == number)
        streams.append(
            aadm_snr.level_stream(f"LW{number}", instants.time[mine], rows[mine] + 1, flag[mine], value[mine], options)
        )
    return ReadResult(
        "controller_log",
        tuple(streams),
        len(lines),
        int(take.sum()),
        blank + len(comments),
        tuple(sorted(rejected, key=lambda line: line.number)),
        instants.warnings,
    )


READER = Reader(
    name="controller_log",
    title="AADM controller console: SNR of each tower",
    kinds=("rss",),
    sample="[2025-01-01 12:00:07.000002] 1:-1.250000",
    sniff=sniff,
    read=read,
)
