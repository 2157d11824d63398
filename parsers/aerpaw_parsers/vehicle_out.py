"""``vehicleOut``: the autopilot's telemetry, one line a second, in all generations of its format.

====== =================================================================================================
fields layout
====== =================================================================================================
10     ``n,lon,lat,alt,"(pitch,yaw,roll)","(north,east,down)",volt,time,fix,satellites`` (2023 and later)
11     ``n,lon,lat,alt,pitch,yaw,roll,volt,time,fix,satellites``
9      ``n,lon,lat,alt,volt,battery,time,fix,satellites`` (2022)
8      ``n,lon,lat,alt,volt,time,fix,satellites`` (2021)
====== =================================================================================================

Further fields after these are ignored. Angles are in radians, altitude is above take-off, and time is naive local time,
or UTC with an offset (scripts of 2026).
Writers: AERPAW/aerpawlib ``examples/v1/{gps_logger,preplanned_trajectory,guided_mission_ping_iperf}.py``.
"""

from __future__ import annotations

import re

import numpy as np

from aerpaw_cmp.common.units import AnyArray, FloatArray
from aerpaw_cmp.readers import BOM, NUMBER, TIME, ZONE, Reader, ReadOptions, ReadResult, Rows, counted, matched, mostly

_NUMBERS = (
    "index", "longitude", "latitude", "altitude", "pitch", "yaw", "roll", "north", "east", "down", "volt", "fix",
    "satellites",
)  # fmt: skip
_CELL = rb'"?(?P<%s>' + NUMBER + rb'|nan|NaN|None)"?'
_CHARGE = rb'"?(?P<volt>' + NUMBER + rb'|nan|NaN|None|)"?'  # voltage and charge may be empty
_SEP = rb", ?"


def _cells(*names: bytes) -> bytes:
    return _SEP.join(_CELL % name for name in names)


_FIELDS = _SEP.join(
    (
        rb'^ ?"?(?P<index>\d{1,12})"?',
        _cells(b"longitude", b"latitude", b"altitude"),
        # angles and velocities in brackets (10 fields), angles without brackets (11), or neither (8 and 9)
        rb'(?:(?P<open>"?[(\[]"?)?' + _cells(b"pitch", b"yaw", b"roll")
        + rb'(?(open)"?[)\]]"?, ?"?[(\[]' + _cells(b"north", b"east", b"down") + rb'[)\]]"?)' + _SEP + rb")?"
        + _CHARGE + rb"(?(pitch)|(?:" + _SEP + _CHARGE.replace(b"P<volt>", b":") + rb")?)",
        rb'"?(?P<time>' + TIME + ZONE + rb')"?',
        rb'"?(?P<fix>-?\d{1,3})"?',
        rb'"?(?P<satellites>-?\d{1,3})"?',
    )
)  # fmt: skip
_END = rb"[ ,\t]{0,8}\r?$"
_MORE = rb"(?:,[^,\n]{0,80})"
_ROW = re.compile(_FIELDS + _END, re.MULTILINE)
# A logger may write further fields. Most of the first rows must have them, because two joined rows also look like this.
_LONGER = re.compile(_FIELDS + _MORE + rb"{1,6}" + _END, re.MULTILINE)
_EITHER = re.compile(_FIELDS + _MORE + rb"{0,6}" + _END, re.MULTILINE)
_INVALID_POSITION = -900.0  # the logger writes -999 for each coordinate while there is no fix


def sniff(head: bytes) -> bool:
    """Check whether most of the first lines are telemetry rows, and no header names other columns."""
    return (mostly(head, _ROW) or mostly(head, _LONGER)) and (not _WORDS.match(head) or _TITLE.match(head) is not None)


# A header: at least eight names.
_WORDS = re.compile(BOM + rb"(?:\s*[\"']?[A-Za-z_][^,\n]*,){7}")
_TITLE = re.compile(rb"(?i)(?:\xef\xbb\xbf)?\s*[\"']?(?:num|number|line_?num|index|id|no\.?)[\"']?\s*,.*lon.*")


def _reason(line: bytes) -> str | None:
    if _TITLE.match(line):
        return None  # title line of converted logs
    fields = len(re.sub(rb"\([^()]*\)", b"", line).split(b","))
    if fields not in (8, 9, 10, 11):
        return f"{fields} fields where 8, 9, 10 or 11 were expected (truncated line?)"
    if not re.search(TIME, line):
        return "no time stamp (truncated line?)"
    return "a field does not have the form that vehicleOut specifies for it"


def read(data: bytes, options: ReadOptions) -> ReadResult:
    """Return the telemetry of one vehicle.

    Raises
    ------
    UsageError
        If the times have no offset and no time zone is given.
    """
    pattern = _EITHER if mostly(data, _LONGER) and not mostly(data, _ROW) else _ROW
    rows = matched(data, pattern, options, reader="vehicle_out", reason=_reason)
    number = {name: rows.number(name) for name in _NUMBERS}
    jumps = int((np.diff(number["index"]) != 1).sum())
    if jumps:
        rows.warnings.append(f"the row index jumps at {counted(jumps, 'place')}: rows are missing or files were joined")
    values = _values(rows, number)
    return rows.result([rows.stream("telemetry", "vehicle", values, source="vehicleOut")])


def _values(rows: Rows, number: dict[str, FloatArray]) -> dict[str, AnyArray]:
    """Return columns of the record model, NaN for positions without a fix and for attitudes of 0 in all rows."""
    place = {f"{name}_deg": number[name] for name in ("latitude", "longitude")} | {"altitude_m": number["altitude"]}
    latitude, longitude, altitude = place.values()
    no_fix = (number["fix"] < 2) | (np.fmin(longitude, latitude) < _INVALID_POSITION) | (altitude < -998.5)
    no_fix |= (latitude == 0) & (longitude == 0)
    rows.mark(no_fix, "no_fix")
    zero = (number["pitch"] == 0) & (number["yaw"] == 0) & (number["roll"] == 0)
    rows.mark(zero, "zero_attitude")
    motion = {f"{name}_deg": np.degrees(number[name]) for name in ("roll", "pitch", "yaw")}
    motion |= {f"velocity_{way}_mps": number[way] for way in ("north", "east", "down")}
    if zero.any():
        rows_of = counted(int(zero.sum()), "row has", "rows have")
        text = f"{rows_of} attitude (0,0,0), which AERPAW's converter writes for 'unknown'; flagged"
        if zero.all():  # level and due north in every row is not a real attitude
            text += " zero_attitude and read as unknown, because no row has another attitude"
            motion = {name: np.full(len(rows), np.nan) for name in motion}
        rows.warnings.append(text)
    if no_fix.any():
        lines = counted(int(no_fix.sum()), "row")
        rows.warnings.append(f"{lines} without a position fix: position NaN, flagged no_fix")
    if len(rows) > 10 and (number["fix"] == 6).all() and (number["satellites"] == 10).all():
        rows.warnings.append("fix 6 with 10 satellites throughout: probably a run of the digital twin, not a flight")
    counts = {name: number[name].astype(np.int64) for name in ("fix", "satellites")} | {"battery_v": number["volt"]}
    return {name: np.where(no_fix, np.nan, part) for name, part in place.items()} | motion | counts


READER = Reader(
    name="vehicle_out", title="AERPAW vehicleOut telemetry (8, 9, 10 or 11 fields)", kinds=("telemetry",),
    sample='7,-78.6960001,35.7280002,30.1,"(0.01,1.57,-0.02)","(0.0,5.0,0.1)",48.1,2025-01-01 12:00:07.000000,4,18',
    sniff=sniff, read=read,
)  # fmt: skip
