"""``vehicleOut``: the autopilot's telemetry, one line a second, in all its generations.

====== =================================================================================================
fields layout
====== =================================================================================================
10     ``n,lon,lat,alt,"(pitch,yaw,roll)","(north,east,down)",volt,time,fix,satellites`` (2023 and later)
11     ``n,lon,lat,alt,pitch,yaw,roll,volt,time,fix,satellites``
9      ``n,lon,lat,alt,volt,battery,time,fix,satellites`` (2022)
8      ``n,lon,lat,alt,volt,time,fix,satellites`` (2021)
====== =================================================================================================

Further fields behind these are left out. Radians; altitude above take-off; naive local time, or (2026 scripts) UTC
with an offset.
Writers: AERPAW/aerpawlib ``examples/v1/{gps_logger,preplanned_trajectory,guided_mission_ping_iperf}.py``.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from functools import partial

import numpy as np

from aerpaw_cmp.common.units import AnyArray, BoolArray, FloatArray, IntArray
from aerpaw_cmp.logs import blocks
from aerpaw_cmp.logs.readers import Reader, ReadOptions
from aerpaw_cmp.logs.records import ReadResult, Stream

from . import _frames, _lines, _table, _time

_N = rb'"?(' + _lines.NUMBER + rb'|nan|NaN|None)"?'
_TRIPLE = rb'"?[(\[]' + _N + rb", ?" + _N + rb", ?" + _N + rb'[)\]]"?'
_UNUSED = rb'"?(' + _lines.NUMBER + rb'|nan|NaN|None|)"?'  # voltage and charge: a row without them is one
_SEP = rb", ?"
_BODY = (
    _SEP.join((_TRIPLE, _TRIPLE, _UNUSED)),  # 10 fields
    _SEP.join((_N, _N, _N, _UNUSED)),  # 11 fields
    _UNUSED + rb"(?:" + _SEP + _UNUSED + rb")?",  # 8 and 9 fields
)
_FIELDS = _SEP.join(
    (
        rb'^ ?"?(\d{1,12})"?',
        _N,
        _N,
        _N,
        rb"(?:" + rb"|".join(_BODY) + rb")",
        rb'"?(' + _time.TIME + _time.ZONE + rb')"?',
        rb'"?(-?\d{1,3})"?',
        rb'"?(-?\d{1,3})"?',
    )
)
_END = rb"[ ,\t]{0,8}\r?$"
_MORE = rb"(?:,[^,\n]{0,80})"
_ROW = re.compile(_FIELDS + _END, re.MULTILINE)
_LONGER = re.compile(_FIELDS + _MORE + rb"{1,6}" + _END, re.MULTILINE)
"""A logger that writes further fields behind these: only where most first rows have them: glued rows look so too."""
_EITHER = re.compile(_FIELDS + _MORE + rb"{0,6}" + _END, re.MULTILINE)
_HEAD_BYTES = 16_384
"""What :func:`_lines.mostly` looks at."""
_TENS = 10.0 ** np.arange(1, 13)
_GROUPS = 20
_NO_SIGN = bytes(set(range(256)) - set(b' "()'))
_INVALID_POSITION = -900.0  # the logger writes -999 for each coordinate while there is no fix


def sniff(head: bytes) -> bool:
    """Whether most of the first lines are telemetry rows."""
    return _lines.mostly(head, _ROW) or _lines.mostly(head, _LONGER)


def _form(head: bytes) -> re.Pattern[bytes]:
    """What a row of the log looks like: its beginning says so for all of it."""
    return _EITHER if _lines.mostly(head, _LONGER) and not _lines.mostly(head, _ROW) else _ROW


_TITLE = re.compile(rb"(?i)(?:\xef\xbb\xbf)?\s*[\"']?(?:num|number|line_?num|index|id|no\.?)[\"']?\s*,.*lon.*")


def _reason(line: bytes) -> str | None:
    if _TITLE.match(line):
        return None  # the title line of converted logs
    if b"\0" in line:
        return "NUL bytes in the line (the file system was not synced when power went)"
    fields = len(re.sub(rb"\([^()]*\)", b"", line).split(b","))
    if fields not in (8, 9, 10, 11):
        return f"{fields} fields where 8, 9, 10 or 11 were expected (torn line?)"
    if not re.search(_time.TIME, line):
        return "no time stamp (torn line?)"
    return "a field is not of the form that vehicleOut has there"


@dataclass
class _Rows:
    """Rows of any layout: 0-based lines; eleven numbers each, see ``_NUMBERS``; wall clock and its offset."""

    line: IntArray
    number: FloatArray
    wall: IntArray
    valid: BoolArray
    offset_s: IntArray
    zoned: BoolArray

    def join(self, other: _Rows) -> _Rows:
        """Rows of both, in file order."""
        if not len(other.line):
            return self
        order = np.argsort(np.concatenate((self.line, other.line)), kind="stable")
        return _Rows(
            *(
                np.concatenate((getattr(self, part.name), getattr(other, part.name)), axis=-1)[..., order]
                for part in fields(self)
            )
        )


_NUMBERS = ("index", "lon", "lat", "alt", "pitch", "yaw", "roll", "north", "east", "down", "fix", "satellites")


def _by_pattern(lines: _lines.Lines, form: re.Pattern[bytes], done: IntArray) -> _Rows:
    """Rows of every layout, one by one and strictly: what the fast way left."""
    rows, groups = _lines.match_rest(lines, form, done)
    column = _lines.columns(groups, _GROUPS)
    value = {i: _lines.numbers(column[i]) for i in (*range(10), 11, 12, 13, 18, 19)}
    # groups 4-6 hold the angles of the 10-field layout, 11-13 those of the 11-field one
    angles = [np.fmax(value[4 + i], value[11 + i]) for i in range(3)]
    number = np.stack(
        [value[0], value[1], value[2], value[3], *angles, value[7], value[8], value[9], value[18], value[19]]
    )
    return _Rows(rows, number, *_time.parse_texts(column[17]))


def _at_once(lines: _lines.Lines) -> _Rows:
    """Rows of the two common layouts, plain numbers and times of 26 characters, without a loop over lines."""
    none = np.zeros(0, dtype=np.int64)
    nothing = _Rows(
        line=none, number=np.empty((len(_NUMBERS), 0)), wall=none, valid=none > 0, offset_s=none, zoned=none > 0
    )
    for count, time in ((14, 11), (8, 5), (9, 6)):
        found = _table.fields(lines, count)
        mine = found.width(time) == 26
        if 2 * mine.sum() <= len(lines):
            continue
        found = found.take(mine)
        spaces = int(np.count_nonzero(lines.buffer[found.start(time) + 10] == 32))
        signs = _table.bytes_of(lines, found.rows).translate(None, _NO_SIGN)
        if signs.count(b" ") != spaces:  # a space elsewhere than in the times
            return nothing
        if count == 14 and not _tuples_in_place(lines, found, signs):
            return nothing
        wanted = [i for i in range(count) if i != time]
        marks = b'"()' if count == 14 else b""
        value = _table.numbers(lines, found.rows, count, wanted, strip=marks, also=b" :T/")
        if value is None:
            return nothing
        unknown = np.full(len(found.rows), np.nan)
        middle = value[4:10] if count == 14 else [unknown] * 6
        number = np.stack([*value[:4], *middle, *value[-2:]])
        wall, keep = _time.parse_digits(_table.cells_at(lines, found.start(time), 26), 6)
        for column, whole, most in ((0, number[0], 1e12), (-2, number[10], 1000.0), (-1, number[11], 1000.0)):
            keep &= (whole == np.floor(whole)) & (np.abs(whole) < most) & _digits_only(lines, found, column, whole)
        keep &= (number[0] >= 0) & ~np.isnan(number[1:10] if count == 14 else number[1:4]).any(axis=0)
        rows = found.rows
        if not keep.all():
            rows, number, wall = rows[keep], number[:, keep], wall[keep]
        zero = np.zeros(len(rows), dtype=np.int64)
        return _Rows(line=rows, number=number, wall=wall, valid=zero == 0, offset_s=zero, zoned=zero > 0)
    return nothing


def _digits_only(lines: _lines.Lines, found: _table.Fields, column: int, whole: FloatArray) -> BoolArray:
    """Cells that are digits behind at most a sign: as many as the whole number has, and no exponent among them."""
    column %= found.ends.shape[1]
    end, at = found.ends[:, column], lines.buffer
    digits = 1 + np.searchsorted(_TENS, np.abs(whole), side="right") + (whole < 0)
    exponent = np.zeros(len(end), dtype=bool)
    for place in (2, 3):  # 1e2 is as wide as 100; with an exponent of two digits 1.2345678e11
        exponent |= (at[end - place] | 32) == 101
    return np.asarray((found.width(column) == digits) & ~exponent)


def _tuples_in_place(lines: _lines.Lines, found: _table.Fields, signs: bytes) -> bool:
    """Whether each row has its quotes and brackets where the two tuples are; ``signs`` are those of all rows."""
    at = lines.buffer
    right = np.ones(len(found.rows), dtype=bool)
    for first, last in ((4, 6), (7, 9)):
        opening, closing = found.start(first), found.ends[:, last]
        right &= (found.ends[:, first] - opening > 2) & (closing - found.start(last) > 2)
        right &= (at[opening] == 34) & (at[opening + 1] == 40) & (at[closing - 1] == 34) & (at[closing - 2] == 41)
    return bool(right.all()) and [signs.count(sign) for sign in b'"()'] == [n * len(right) for n in (4, 2, 2)]


def read(data: bytes, options: ReadOptions) -> ReadResult:
    """Telemetry of one vehicle.

    Raises
    ------
    UsageError
        If the times carry no offset and no time zone is given.
    """
    return _settled(_read(_form(data), data, options))


def _in_blocks(chunks: Iterator[bytes], options: ReadOptions) -> ReadResult:
    begin, chunks = blocks.beginning(chunks, _HEAD_BYTES)
    form = _form(begin)
    apart = re.compile(form.pattern.replace(_time.TIME, _time.CERTAIN), re.MULTILINE)  # a row that is read for certain
    return blocks.by_lines(partial(_read, form), apart=apart, settle=_settled)(chunks, options)


def _read(form: re.Pattern[bytes], data: bytes, options: ReadOptions) -> ReadResult:
    """What each row says by itself."""
    lines = _lines.split(data)
    fast = _at_once(lines)
    rows = fast.join(_by_pattern(lines, form, fast.line))
    instants = _time.parsed_to_utc(rows.wall, rows.valid, rows.offset_s, rows.zoned, options, needed_by="vehicleOut")
    keep = np.flatnonzero(rows.valid)
    blank, rejected = _lines.remainder(lines, rows.line, _reason)
    rejected += lines.reject_all(rows.line[~rows.valid], "the time stamp is no date of the calendar")
    flag = _lines.flags(len(rows.line))
    instants.flag(flag)
    values = _values(rows.number, flag)
    if lines.unterminated and len(rows.line):
        _lines.add_flag(flag, rows.line == len(lines) - 1, _lines.UNTERMINATED)
    frame = _frames.frame("telemetry", instants.time, rows.line + 1, flag, values)
    if len(keep) < len(frame):
        frame = frame.iloc[keep].reset_index(drop=True)
    jumps = int((np.diff(rows.number[0, keep]) != 1).sum())
    warnings = [f"the row index jumps at {jumps} places: rows are missing or files were joined"] if jumps else []
    warnings = [*instants.warnings, *warnings, *_frames.steps_back(frame)]
    stream = Stream("telemetry", "vehicle", frame, _frames.attributes(options, source="vehicleOut"))
    return ReadResult(
        reader="vehicle_out",
        streams=(stream,) if len(frame) else (),
        lines=len(lines),
        accepted=len(frame),
        blank=blank,
        rejected=tuple(sorted(rejected, key=lambda line: line.number)),
        warnings=tuple(warnings),
    )


def _values(number: FloatArray, flag: AnyArray) -> dict[str, AnyArray]:
    """Columns of the record model; positions without a fix become NaN."""
    longitude, latitude, altitude = number[1:4]
    angles, velocity = number[4:7], number[7:10]
    fix, satellites = number[10].astype(np.int64), number[11].astype(np.int64)
    no_fix = (fix < 2) | (longitude < _INVALID_POSITION) | (latitude < _INVALID_POSITION) | (altitude < -998.5)
    _lines.add_flag(flag, no_fix, "no_fix")
    outside = ~no_fix & ~((np.abs(latitude) <= 90) & (np.abs(longitude) <= 180) & (np.abs(altitude) < 1e5))
    _lines.add_flag(flag, outside, "position_out_of_range")
    for part in (longitude, latitude, altitude):
        part[no_fix | outside] = np.nan
    zero = (angles[0] == 0) & (angles[1] == 0) & (angles[2] == 0)
    _lines.add_flag(flag, zero, "zero_attitude")
    pitch, yaw, roll = (np.degrees(angle) for angle in angles)
    names = ("velocity_north_mps", "velocity_east_mps", "velocity_down_mps")
    return {
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


_MOTION = ("roll_deg", "pitch_deg", "yaw_deg", "velocity_north_mps", "velocity_east_mps", "velocity_down_mps")


def _settled(result: ReadResult) -> ReadResult:
    """What a log as a whole shows: attitudes that are unknown throughout, a run of the digital twin."""
    if not result.streams:
        return result
    frame = result.streams[0].frame
    flag = frame["flag"].to_numpy(dtype=object)
    odd = [text for text in flag.tolist() if text]  # few: the flags are looked at one by one
    zero, no_fix = (sum(name in text.split(";") for text in odd) for name in ("zero_attitude", "no_fix"))
    warnings = []
    if zero:
        text = f"{zero} rows have attitude (0,0,0), which AERPAW's converter writes for 'unknown'; flagged"
        if zero == len(frame):  # level flight due north in every row: no aircraft does that
            text += " zero_attitude and read as unknown, because no row has another attitude"
            for name in _MOTION:
                frame[name] = np.nan
        warnings.append(text)
    if no_fix:
        warnings.append(f"{no_fix} rows have no position fix; their positions are NaN, flagged no_fix")
    warnings += result.warnings
    if len(frame) > 10 and (frame["fix"] == 6).all() and (frame["satellites"] == 10).all():
        warnings.append("fix 6 with 10 satellites throughout: a digital-twin run looks like this, not a flight")
    return replace(result, warnings=tuple(warnings))


READER = Reader(
    name="vehicle_out",
    title="AERPAW vehicleOut telemetry (8, 9, 10 or 11 fields)",
    kinds=("telemetry",),
    sample='7,-78.6960001,35.7280002,30.1,"(0.01,1.57,-0.02)","(0.0,5.0,0.1)",48.1,2025-01-01 12:00:07.000000,4,18',
    sniff=sniff,
    read=read,
    in_blocks=_in_blocks,
)
