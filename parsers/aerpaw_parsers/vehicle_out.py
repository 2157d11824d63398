"""``vehicleOut``: the autopilot's telemetry, one line a second, in all its generations.

====== =================================================================================================
fields layout
====== =================================================================================================
10     ``n,lon,lat,alt,"(pitch,yaw,roll)","(north,east,down)",volt,time,fix,satellites`` (2023 and later)
11     ``n,lon,lat,alt,pitch,yaw,roll,volt,time,fix,satellites``
9      ``n,lon,lat,alt,volt,battery,time,fix,satellites`` (2022)
8      ``n,lon,lat,alt,volt,time,fix,satellites`` (2021)
====== =================================================================================================

Radians; altitude above take-off; naive local time, or (2026 scripts) UTC with an offset.
Writers: AERPAW/aerpawlib ``examples/v1/{gps_logger,preplanned_trajectory,guided_mission_ping_iperf}.py``.
"""

from __future__ import annotations

import re

import numpy as np

from aerpaw_cmp.readers import Reader, ReadOptions
from aerpaw_cmp.records import ReadResult, Stream
from aerpaw_cmp.units import AnyArray

from . import _frames, _lines, _time

_N = rb"(" + _lines.NUMBER + rb"|nan|NaN|None)"
_TRIPLE = rb'"?[(\[]' + _N + rb", ?" + _N + rb", ?" + _N + rb'[)\]]"?'
_SEP = rb", ?"
_BODY = (
    _SEP.join((_TRIPLE, _TRIPLE, _N)),  # 10 fields
    _SEP.join((_N, _N, _N, _N)),  # 11 fields
    _N + rb"(?:" + _SEP + _N + rb")?",  # 8 and 9 fields
)
_ROW = re.compile(
    _SEP.join(
        (
            rb"^ ?(\d{1,12})",
            _N,
            _N,
            _N,
            rb"(?:" + rb"|".join(_BODY) + rb")",
            rb"(" + _time.TIME + _time.ZONE + rb")",
            rb"(-?\d{1,3})",
            rb"(-?\d{1,3})\r?$",
        )
    ),
    re.MULTILINE,
)
_GROUPS = 20
_INVALID_POSITION = -900.0  # the logger writes -999 for each coordinate while there is no fix


def sniff(head: bytes) -> bool:
    """Whether most of the first lines are telemetry rows."""
    return _lines.mostly(head, _ROW)


def _reason(line: bytes) -> str:
    if b"\0" in line:
        return "NUL bytes in the line (the file system was not synced when power went)"
    fields = len(re.sub(rb"\([^()]*\)", b"", line).split(b","))
    if fields not in (8, 9, 10, 11):
        return f"{fields} fields where 8, 9, 10 or 11 were expected (torn line?)"
    if not re.search(_time.TIME, line):
        return "no time stamp (torn line?)"
    return "a field is not of the form that vehicleOut has there"


def read(data: bytes, options: ReadOptions) -> ReadResult:
    """Telemetry of one vehicle.

    Raises
    ------
    UsageError
        If the times carry no offset and no time zone is given.
    """
    lines = _lines.split(data)
    rows, groups = _lines.match(lines, _ROW)
    column = _lines.columns(groups, _GROUPS)
    instants, valid = _time.texts_to_utc(column[17], options, needed_by="vehicleOut")
    keep = np.flatnonzero(valid)
    blank, rejected = _lines.remainder(lines, rows, _reason)
    rejected += lines.reject_all(rows[~valid], "the time stamp is no date of the calendar")
    flag = _lines.flags(len(rows))
    instants.flag(flag)
    values, warnings = _values(column, flag)
    if lines.unterminated and len(rows):
        _lines.add_flag(flag, rows == len(lines) - 1, _lines.UNTERMINATED)
    frame = _frames.frame("telemetry", instants.time, rows + 1, flag, values).iloc[keep].reset_index(drop=True)
    warnings += [*instants.warnings, *_doubts(column, keep), *_frames.steps_back(frame)]
    stream = Stream("telemetry", "vehicle", frame, _frames.attributes(options, source="vehicleOut"))
    return ReadResult(
        "vehicle_out",
        (stream,) if len(frame) else (),
        len(lines),
        len(frame),
        blank,
        tuple(sorted(rejected, key=lambda line: line.number)),
        tuple(warnings),
    )


def _values(column: list[AnyArray], flag: AnyArray) -> tuple[dict[str, AnyArray], list[str]]:
    """Columns of the record model; positions without a fix and unknown attitudes become NaN."""
    warnings: list[str] = []
    longitude, latitude, altitude = (_lines.numbers(column[i]) for i in (1, 2, 3))
    # groups 4-9 hold the tuples of the 10-field layout, 11-13 the bare angles of the 11-field one
    angles = [np.fmax(_lines.numbers(column[4 + i]), _lines.numbers(column[11 + i])) for i in range(3)]
    velocity = [_lines.numbers(column[7 + i]) for i in range(3)]
    fix, satellites = (_lines.numbers(column[i]).astype(np.int64) for i in (18, 19))
    no_fix = (fix < 2) | (longitude < _INVALID_POSITION) | (latitude < _INVALID_POSITION) | (altitude < -998.5)
    _lines.add_flag(flag, no_fix, "no_fix")
    outside = ~no_fix & ~((np.abs(latitude) <= 90) & (np.abs(longitude) <= 180) & (np.abs(altitude) < 1e5))
    _lines.add_flag(flag, outside, "position_out_of_range")
    for part in (longitude, latitude, altitude):
        part[no_fix | outside] = np.nan
    zero = (angles[0] == 0) & (angles[1] == 0) & (angles[2] == 0)
    _lines.add_flag(flag, zero, "zero_attitude")
    if zero.any():
        text = f"{int(zero.sum())} rows have attitude (0,0,0), which AERPAW's converter writes for 'unknown'; flagged"
        if zero.all():  # level flight due north in every row: no aircraft does that
            text += " zero_attitude and read as unknown, because no row has another attitude"
            for part in (*angles, *velocity):
                part[:] = np.nan
        warnings.append(text)
    if no_fix.any():
        warnings.append(f"{int(no_fix.sum())} rows have no position fix; their positions are NaN, flagged no_fix")
    pitch, yaw, roll = (np.degrees(angle) for angle in angles)
    names = ("velocity_north_mps", "velocity_east_mps", "velocity_down_mps")
    values = {
        "latitude_deg": latitude,
        "longitude_deg": longitude,
        "altitude_m": altitude,
        "roll_deg": roll,
        "pitch_deg": pitch,
        "yaw_deg": yaw,
        **dict(zip(names, velocity, strict=True)),
        "fix": fix,
        "satellites": satellites,
    }
    return values, warnings


def _doubts(column: list[AnyArray], keep: AnyArray) -> list[str]:
    """Things that a flight as a whole may show."""
    warnings = []
    index = _lines.numbers(column[0])[keep]
    jumps = int((np.diff(index) != 1).sum())
    if jumps:
        warnings.append(f"the row index jumps at {jumps} places: rows are missing or files were joined")
    if len(keep) > 10 and (column[18][keep] == b"6").all() and (column[19][keep] == b"10").all():
        warnings.append("fix 6 with 10 satellites throughout: a digital-twin run looks like this, not a flight")
    return warnings


READER = Reader(
    name="vehicle_out",
    title="AERPAW vehicleOut telemetry (8, 9, 10 or 11 fields)",
    kinds=("telemetry",),
    sample='7,-78.6960001,35.7280002,30.1,"(0.01,1.57,-0.02)","(0.0,5.0,0.1)",48.1,2025-01-01 12:00:07.000000,4,18',
    sniff=sniff,
    read=read,
)
