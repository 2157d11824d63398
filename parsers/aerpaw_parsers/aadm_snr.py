"""SNR of several towers as CSV: ``time,snr_lw1,snr_lw2,...`` (AADM 2025) in local wall time and dB."""

from __future__ import annotations

import re
from collections.abc import Iterator

from aerpaw_cmp.readers import BOM, NUMBER, TIME, ZONE, Rows, Stream, snr_stream, text_reader

_HEADER = re.compile(BOM + rb"time((?:,snr_[A-Za-z0-9]{1,12}){1,16})\s*", re.IGNORECASE)


def _row(data: bytes) -> re.Pattern[bytes]:
    """Return a pattern with a group per tower, whose names are in the header."""
    header = _HEADER.match(data[:400].lstrip())
    if header is None:
        return re.compile(rb"(?!)(?P<time>)")
    cells = b"".join(rb",(?P<t%d>" % i + NUMBER + rb"|nan|NaN|-inf|)" for i in range(header[1].count(b",")))
    return re.compile(rb"^(?P<time>" + TIME + ZONE + rb")" + cells + rb"[ \t]*\r?$", re.MULTILINE)


def _streams(rows: Rows) -> Iterator[Stream | None]:
    header = _HEADER.match(rows.data[:400].lstrip())
    towers = [] if header is None else header[1].decode("ascii").upper().split(",SNR_")[1:]
    for i, tower in enumerate(towers):
        if tower in towers[:i]:
            rows.warnings.append(f"a second column of {tower} is not read")
        else:
            yield snr_stream(rows, tower, rows.number(f"t{i}"))


READER = text_reader(
    "aadm_snr", "SNR of several towers, CSV (AADM)", kinds=("rss",), sample="time,snr_lw1,snr_lw2", header=_HEADER,
    row=_row, streams=_streams,
    otherwise="the number of fields, the time or a number does not fit the header (torn line?)",
)  # fmt: skip
