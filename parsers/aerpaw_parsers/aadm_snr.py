"""SNR of several towers as CSV: ``time,snr_lw1,snr_lw2,...`` (AADM 2025), local wall time, dB."""

from __future__ import annotations

import re

from aerpaw_cmp.logs.readers import Reader, ReadOptions
from aerpaw_cmp.logs.records import ReadResult

from . import _lines, _rows, _time

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
    """One level stream per tower column, named after the tower; UsageError if no time zone is given."""
    header = _HEADER.match(data[:400])
    # without a header nothing says which column is which tower
    towers = [] if header is None else [part[4:].decode("ascii").upper() for part in header[1].split(b",")[1:]]
    cells = b"".join(rb",(?P<t%d>" % i + _CELL[1:] for i in range(len(towers)))
    time = rb"^(?P<time>" + _time.TIME + _time.ZONE + rb")" if towers else rb"(?!)(?P<time>)"
    rows = _rows.matched(
        data, re.compile(time + cells + rb"\r?$", re.MULTILINE), options, reader="aadm_snr", reason=_reason
    )
    return rows.result(_rows.snr(rows, tower, rows.number(f"t{i}")) for i, tower in enumerate(towers))


READER = Reader(
    name="aadm_snr",
    title="SNR of several towers, CSV (AADM)",
    kinds=("rss",),
    sample="time,snr_lw1,snr_lw2",
    sniff=sniff,
    read=read,
)
