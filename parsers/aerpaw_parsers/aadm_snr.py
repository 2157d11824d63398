"""SNR of several towers as CSV: ``time,snr_lw1,snr_lw2,...`` (AADM 2025), local wall time, dB."""

from __future__ import annotations

import re

import numpy as np

from aerpaw_cmp.common.units import AnyArray
from aerpaw_cmp.logs.readers import Reader, ReadOptions
from aerpaw_cmp.logs.records import ReadResult, Stream

from . import _frames, _lines, _time

_HEADER = re.compile(rb"(?:\xef\xbb\xbf)?time((?:,snr_[A-Za-z0-9]{1,12}){1,16})\s*", re.IGNORECASE)
_CELL = rb"(" + _lines.NUMBER + rb"|nan|NaN|-inf|)"


def sniff(head: bytes) -> bool:
    """Whether the first line is the header."""
    return _HEADER.fullmatch(head[:400].split(b"\n", 1)[0]) is not None


def _reason(line: bytes) -> str | None:
    if _HEADER.fullmatch(line):
        return None
    return "the number of fields, the time or a number does not fit the header (torn line?)"


def read(data: bytes, options: ReadOptions) -> ReadResult:
    """One level stream per tower column, named after the tower.

    Raises
    ------
    UsageError
        If no time zone is given.
    """
    lines = _lines.split(data)
    header = _HEADER.match(data[:400])
    towers = [] if header is None else [part[4:].decode("ascii").upper() for part in header[1].split(b",")[1:]]
    pattern = re.compile(
        rb"^(" + _time.TIME + _time.ZONE + rb")" + (rb"," + _CELL) * len(towers) + rb"\r?$", re.MULTILINE
    )
    # without a header nothing says which column is which tower
    rows, groups = _lines.match(lines, pattern) if towers else (np.zeros(0, dtype=np.int64), [])
    column = _lines.columns(groups, 1 + len(towers))
    instants, valid = _time.texts_to_utc(column[0], options, needed_by="aadm_snr")
    blank, rejected = _lines.remainder(lines, rows, _reason)
    rejected += lines.reject_all(rows[~valid], "the time stamp is no date of the calendar")
    base = _lines.flags(len(rows))
    instants.flag(base)
    if lines.unterminated:
        _lines.add_flag(base, rows == len(lines) - 1, _lines.UNTERMINATED)
    streams = [
        level_stream(tower, instants.time[valid], rows[valid] + 1, base[valid], _lines.numbers(cells)[valid], options)
        for tower, cells in zip(towers, column[1:], strict=True)
        if valid.any()
    ]
    return ReadResult(
        "aadm_snr",
        tuple(streams),
        len(lines),
        int(valid.sum()),
        blank,
        tuple(sorted(rejected, key=lambda line: line.number)),
        instants.warnings,
    )


def level_stream(
    tower: str, time: AnyArray, line: AnyArray, flag: AnyArray, level: AnyArray, options: ReadOptions
) -> Stream:
    """SNR stream of one tower; levels at or below the floor are out of coverage."""
    flag, level = flag.copy(), level.copy()
    silent = ~(level > options.floor_db) | ~np.isfinite(level)
    _lines.add_flag(flag, silent, "out_of_coverage")
    level[silent] = np.nan
    frame = _frames.frame("rss", time, line, flag, {"rss_db": level})
    attributes = _frames.attributes(options, node=tower, channel="snr", unit="dB", quantity="SNR")
    return Stream("rss", tower, frame, attributes)


READER = Reader(
    name="aadm_snr",
    title="SNR of several towers, CSV (AADM)",
    kinds=("rss",),
    sample="time,snr_lw1,snr_lw2",
    sniff=sniff,
    read=read,
)
