"""The published rank-indicator table (Dryad wh70rxx06): ``ID,Time and date,Longitude,Latitude,Altitude,NR RI``.

RI counts data layers from 1, as the modem wrote it; 0 means no CSI. Times are local wall time.
"""

from __future__ import annotations

import re

import numpy as np

from aerpaw_cmp.logs.readers import Reader, ReadOptions
from aerpaw_cmp.logs.records import ReadResult

from . import _lines, _rows, _time

_HEADER = re.compile(
    rb'(?:\xef\xbb\xbf)?"?ID"?, ?"?Time and date"?, ?"?Longitude"?, ?"?Latitude"?, ?"?Altitude"?, ?"?NR RI"?\s*',
    re.IGNORECASE,
)
_CELL = rb', ?"?(?P<%s>' + _lines.NUMBER + rb'|nan|NaN|)"?'
_ROW = re.compile(
    rb'^"?\d{1,12}(?:\.0)?"?,"?(?P<time>' + _time.TIME + _time.ZONE + rb')"?'
    + _CELL % b"longitude" + _CELL % b"latitude" + _CELL % b"altitude" + _CELL % b"ri" + rb"\r?$",
    re.MULTILINE,
)  # fmt: skip


def sniff(head: bytes) -> bool:
    """Whether the first line is the header."""
    return _HEADER.fullmatch(head[:200].split(b"\n", 1)[0]) is not None


def _reason(line: bytes) -> str | None:
    if _HEADER.fullmatch(line):
        return None
    fields = line.count(b",") + 1
    return (
        f"{fields} fields where 6 were expected (torn line?)"
        if fields != 6
        else "the time or a number is of another form"
    )


def read(data: bytes, options: ReadOptions) -> ReadResult:
    """Rank stream ``nr5g_csi`` with the table's own positions; UsageError if no time zone is given."""
    rows = _rows.matched(data, _ROW, options, reader="quectel_ri", reason=_reason)
    ri = rows.number("ri")
    values = rows.rank(ri, none=ri == 0)
    position = {
        f"{name}_{unit}": rows.number(name)
        for name, unit in (("latitude", "deg"), ("longitude", "deg"), ("altitude", "m"))
    }
    lost = ~((np.abs(position["latitude_deg"]) <= 90) & (np.abs(position["longitude_deg"]) <= 180))
    rows.mark(lost, "no_fix")
    values |= {name: np.where(lost, np.nan, column) for name, column in position.items()}
    name = options.channel or "nr5g_csi"
    return rows.result([rows.stream("rank", name, values, channel=name, ri_base="one", source="CSI report")])


READER = Reader(
    name="quectel_ri",
    title="published Quectel NR rank table (six columns)",
    kinds=("rank",),
    sample="8,2025-01-01 12:00:07.250,-78.6960001,35.7280001,30.1,2",
    sniff=sniff,
    read=read,
)
