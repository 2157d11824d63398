"""SNR of several towers as CSV: ``time,snr_lw1,snr_lw2,...`` (AADM 2025), local wall time, dB; a stream per tower."""

from __future__ import annotations

import re
from collections.abc import Iterator

from aerpaw_cmp.logs.records import Stream

from . import _lines, _rows, _text, _time

_HEADER = re.compile(_text.BOM + rb"time((?:,snr_[A-Za-z0-9]{1,12}){1,16})\s*", re.IGNORECASE)


def _row(data: bytes) -> re.Pattern[bytes]:
    """A group per tower; without a header nothing says which column is which tower."""
    header = _HEADER.match(data[:400])
    if header is None:
        return re.compile(rb"(?!)(?P<time>)")
    names = header[1].upper().split(b",SNR_")[1:]
    cells = b"".join(rb",(?P<t%d_%s>" % (i, name) + _lines.NUMBER + rb"|nan|-inf|)" for i, name in enumerate(names))
    return re.compile(rb"^(?P<time>" + _time.TIME + _time.ZONE + rb")" + cells + rb"\r?$", re.MULTILINE | re.IGNORECASE)


def _streams(rows: _rows.Rows) -> Iterator[Stream | None]:
    return (_rows.snr(rows, name.partition("_")[2], rows.number(name)) for name in rows.columns)


READER = _text.reader(
    "aadm_snr",
    "SNR of several towers, CSV (AADM)",
    kinds=("rss",),
    sample="time,snr_lw1,snr_lw2",
    header=_HEADER,
    row=_row,
    streams=_streams,
    otherwise="the number of fields, the time or a number does not fit the header (torn line?)",
)
