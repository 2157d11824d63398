"""The published rank-indicator table (Dryad wh70rxx06): ``ID,Time and date,Longitude,Latitude,Altitude,NR RI``.

RI counts data layers from 1, as the modem wrote it; 0 means no CSI. Times are local wall time.
"""

from __future__ import annotations

import re

import numpy as np

from aerpaw_cmp.logs.readers import Reader, ReadOptions
from aerpaw_cmp.logs.records import ReadResult, Stream

from . import _frames, _lines, _time

_HEADER = re.compile(
    rb'(?:\xef\xbb\xbf)?"?ID"?, ?"?Time and date"?, ?"?Longitude"?, ?"?Latitude"?, ?"?Altitude"?, ?"?NR RI"?\s*',
    re.IGNORECASE,
)
_CELL = rb'"?(' + _lines.NUMBER + rb'|nan|NaN|)"?'
_ROW = re.compile(
    rb'^"?\d{1,12}(?:\.0)?"?,"?(' + _time.TIME + _time.ZONE + rb')"?' + (rb", ?" + _CELL) * 4 + rb"\r?$", re.MULTILINE
)


def sniff(head: bytes) -> bool:
    """Whether the first line is the header."""
    return _HEADER.fullmatch(head[:200].split(b"\n", 1)[0]) is not None


def _reason(line: bytes) -> str | None:
    if _HEADER.fullmatch(line):
        return None
    fields = line.count(b",") + 1
    if fields != 6:
        return f"{fields} fields where 6 were expected (torn line?)"
    return "the time or a number is of another form"


def read(data: bytes, options: ReadOptions) -> ReadResult:
    """Rank stream ``nr5g_csi`` with the table's own positions.

    Raises
    ------
    UsageError
        If no time zone is given.
    """
    lines = _lines.split(data)
    rows, groups = _lines.match(lines, _ROW)
    column = _lines.columns(groups, 5)
    instants, valid = _time.texts_to_utc(column[0], options, needed_by="quectel_ri")
    blank, rejected = _lines.remainder(lines, rows, _reason)
    rejected += lines.reject_all(rows[~valid], "the time stamp is no date of the calendar")
    longitude, latitude, altitude, ri = (_lines.numbers(cells) for cells in column[1:])
    flag = _lines.flags(len(rows))
    instants.flag(flag)
    good = (ri >= 1) & (ri <= 8) & (ri == np.round(ri))
    none = (ri == 0) | np.isnan(ri)
    _lines.add_flag(flag, none, "no_csi")
    _lines.add_flag(flag, ~good & ~none, "ri_out_of_range")
    lost = ~((np.abs(latitude) <= 90) & (np.abs(longitude) <= 180))
    _lines.add_flag(flag, lost, "no_fix")
    if lines.unterminated:
        _lines.add_flag(flag, rows == len(lines) - 1, _lines.UNTERMINATED)
    values = {
        "rank": np.where(good, ri, np.nan),
        "ri_raw": ri,
        "latitude_deg": np.where(lost, np.nan, latitude),
        "longitude_deg": np.where(lost, np.nan, longitude),
        "altitude_m": np.where(lost, np.nan, altitude),
    }
    frame = _frames.frame("rank", instants.time, rows + 1, flag, values)[valid].reset_index(drop=True)
    name = options.channel or "nr5g_csi"
    stream = Stream("rank", name, frame, _frames.attributes(options, channel=name, ri_base="one", source="CSI report"))
    return ReadResult(
        "quectel_ri",
        (stream,) if len(frame) else (),
        len(lines),
        len(frame),
        blank,
        tuple(sorted(rejected, key=lambda line: line.number)),
        (*instants.warnings, *_frames.steps_back(frame)),
    )


READER = Reader(
    name="quectel_ri",
    title="published Quectel NR rank table (six columns)",
    kinds=("rank",),
    sample="8,2025-01-01 12:00:07.250,-78.6960001,35.7280001,30.1,2",
    sniff=sniff,
    read=read,
)
