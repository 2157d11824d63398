"""Merged MATLAB flights: telemetry and level of each channel in one table, as their authors publish them.

Dataset 12 holds ``mpower1 mpower2`` (channels USRP1, USRP2), AFAR's exp-288 files ``mpower mquality``; both have
``mX mY mZ`` (longitude, latitude, height above take-off), ``mRoll mPitch mYaw`` in degrees and two clocks:
``timestamp_power_for_csv`` (text, local) and ``timestamp_power``, **local wall clock stored as if it were UTC**.
The lines of the account are rows.
"""

from __future__ import annotations

import re
import struct
import zlib

import numpy as np

from aerpaw_cmp.common.errors import InputError
from aerpaw_cmp.common.units import AnyArray, BoolArray, FloatArray
from aerpaw_cmp.logs.matfile import MAGIC as _MAGIC
from aerpaw_cmp.logs.matfile import read_arrays
from aerpaw_cmp.logs.readers import Reader, ReadOptions
from aerpaw_cmp.logs.records import ReadResult, RejectedLine, Stream

from . import _frames, _lines, _time

TELEMETRY = {
    "mX": "longitude_deg",
    "mY": "latitude_deg",
    "mZ": "altitude_m",
    "mRoll": "roll_deg",
    "mPitch": "pitch_deg",
    "mYaw": "yaw_deg",
    "mSpeedX": "velocity_north_mps",
    "mSpeedY": "velocity_east_mps",
    "mSpeedZ": "velocity_down_mps",
    "mVz": "velocity_down_mps",
}
LEVELS = {"mpower1": "USRP1", "mpower2": "USRP2", "mpower": "power", "mquality": "quality"}
_CLOCKS = ("timestamp_power_for_csv", "timestamp_power")
_NAMES = {*TELEMETRY, *LEVELS, *_CLOCKS, "mSpeed"}
_COMPRESSED, _MATRIX = 15, 14


def _names(head: bytes) -> list[str]:
    """Variable names of a level-5 file that lie inside ``head`` (MAT-File Format, MathWorks, chapter 1)."""
    names: list[str] = []
    order = "<" if head[126:128] == b"IM" else ">"
    at = 128
    while at + 8 <= len(head) and len(names) < 64:
        kind, size = struct.unpack_from(order + "II", head, at)
        body = head[at + 8 : at + 8 + size]
        if kind == _COMPRESSED:
            try:
                inner = zlib.decompressobj().decompress(body, 256)
            except zlib.error:
                break
            body, kind = inner[8:], struct.unpack_from(order + "I", inner)[0] if len(inner) >= 8 else 0
        if kind != _MATRIX:
            break
        found = _name(body, order)
        if found:
            names.append(found)
        at += 8 + size
    return names


def _name(body: bytes, order: str) -> str | None:
    """Name of an array element: flags (16 bytes), dimensions, then the name."""
    try:
        _, dimensions = struct.unpack_from(order + "II", body, 16)
        at = 24 + -(-dimensions // 8) * 8
        kind, size = struct.unpack_from(order + "II", body, at)
        if kind >> 16:  # small element: size and type share a word, the name follows
            return body[at + 4 : at + 4 + (kind >> 16)].decode("ascii")
        return body[at + 8 : at + 8 + min(size, 64)].decode("ascii")
    except (struct.error, UnicodeDecodeError):
        return None


def sniff(head: bytes) -> bool:
    """Whether it is a MATLAB file whose first variables are those of a merged flight."""
    return head.startswith(_MAGIC) and any(name in _NAMES for name in _names(head))


def _load(data: bytes) -> dict[str, AnyArray]:
    """Variables of a flight as flat arrays, in the file's order of rows."""
    return {name: np.asarray(values).ravel() for name, values in read_arrays(data, _NAMES).items()}


def _numeric(values: AnyArray, name: str) -> FloatArray:
    if values.dtype.kind not in "fiu":
        raise InputError(f"the variable {name!r} is not numeric", expected="a column of numbers")
    return values.astype(np.float64)


def _wall(table: dict[str, AnyArray]) -> tuple[AnyArray, BoolArray, str]:
    """Wall clock in ns, which rows have one, and the column it came from."""
    if _CLOCKS[0] in table:
        text = np.array([str(cell).strip() for cell in table[_CLOCKS[0]]], dtype=np.str_)
        column = np.char.encode(text, "ascii", "replace")
        right = np.array([re.fullmatch(_time.TIME, cell) is not None for cell in column.tolist()], dtype=bool)
        wall, valid, _, _ = _time.parse_texts(column)
        if (valid & right).any():
            return wall, valid & right, _CLOCKS[0]
    if _CLOCKS[1] in table:
        epoch = _numeric(table[_CLOCKS[1]], _CLOCKS[1])
        valid = np.isfinite(epoch) & (epoch > 0) & (epoch < 9.2e9)
        # double precision resolves 2.4e-7 s here: microseconds are what the file can hold
        return np.round(np.where(valid, epoch, 0) * 1e6).astype(np.int64) * 1000, valid, _CLOCKS[1]
    raise InputError(
        "the MATLAB file has no clock",
        expected="a variable timestamp_power_for_csv or timestamp_power",
        cause="not a flight",
    )


def _instants(
    table: dict[str, AnyArray], wall: AnyArray, clock: str, options: ReadOptions
) -> tuple[_time.Instants, list[str]]:
    """UTC of each row: text and epoch both hold local wall clock unless ``clock: utc`` says otherwise."""
    warnings: list[str] = []
    if clock == _CLOCKS[1] and options.clock is None:
        warnings.append("timestamp_power is read as local wall clock stored as UTC, as AERPAW's authors write it")
    elif clock == _CLOCKS[0] and _CLOCKS[1] in table:
        shift_s = np.round(_numeric(table[_CLOCKS[1]], _CLOCKS[1]) - wall / 1e9)
        if len(shift_s) and np.abs(shift_s).max() > 1:
            warnings.append(f"timestamp_power and its text differ by {shift_s[0]:.0f} s (true UTC?): the text was used")
    return _time.wall_to_utc(wall, options, needed_by="flight_mat"), warnings


def read(data: bytes, options: ReadOptions) -> ReadResult:
    """Telemetry ``vehicle`` and one level stream per channel.

    Raises
    ------
    InputError
        If the file is damaged, has no clock, or its columns differ in length.
    UsageError
        If no time zone is given.
    """
    table = _load(data)
    if not any(name in table for name in (*LEVELS, *TELEMETRY)):
        raise InputError(
            "the MATLAB file holds no flight", expected=f"variables such as {', '.join(sorted(_NAMES)[:5])}"
        )
    lengths = {len(column) for column in table.values()}
    if len(lengths) != 1:
        raise InputError(f"the columns differ in length: {sorted(lengths)}", expected="one row per sample in each")
    count = lengths.pop()
    wall, valid, clock = _wall(table)
    keep = np.flatnonzero(valid)
    kept = {name: column[keep] for name, column in table.items()}
    instants, warnings = _instants(kept, wall[keep], clock, options)
    rejected = tuple(RejectedLine(int(i) + 1, "the row has no time", "") for i in np.flatnonzero(~valid))
    warnings += instants.warnings
    streams = _streams(kept, keep, instants, options, clock)
    return ReadResult("flight_mat", streams, count, len(keep), 0, rejected, tuple(warnings))


def _streams(
    table: dict[str, AnyArray], keep: AnyArray, instants: _time.Instants, options: ReadOptions, clock: str
) -> tuple[Stream, ...]:
    streams: list[Stream] = []
    values = {column: _numeric(table[name], name) for name, column in TELEMETRY.items() if name in table}
    if values:
        flag = _lines.flags(len(keep))
        instants.flag(flag)
        position = [values[c] for c in ("latitude_deg", "longitude_deg", "altitude_m") if c in values]
        lost = np.any(
            [~(np.abs(column) < 900) if i < 2 else ~np.isfinite(column) for i, column in enumerate(position)], axis=0
        )
        if position and lost.any():
            _lines.add_flag(flag, lost, "no_fix")
            for column in position:
                column[lost] = np.nan
        frame = _frames.frame("telemetry", instants.time, keep + 1, flag, values)
        streams.append(Stream("telemetry", "vehicle", frame, _frames.attributes(options, source=clock)))
    for name, channel in LEVELS.items():
        if name not in table:
            continue
        level = _numeric(table[name], name)
        flag = _lines.flags(len(keep))
        instants.flag(flag)
        silent = ~(level > options.floor_db)
        _lines.add_flag(flag, silent, "out_of_coverage")
        level[silent] = np.nan
        frame = _frames.frame("rss", instants.time, keep + 1, flag, {"rss_db": level})
        unit = "dB" if name == "mquality" else options.unit or "dB re full scale"
        streams.append(Stream("rss", channel, frame, _frames.attributes(options, channel=channel, unit=unit)))
    return tuple(streams)


READER = Reader(
    name="flight_mat",
    title="merged MATLAB flight (Dataset 12, AFAR exp-288)",
    kinds=("telemetry", "rss"),
    sample="mX mY mZ mRoll mPitch mYaw mpower1 mpower2 timestamp_power timestamp_power_for_csv",
    sniff=sniff,
    read=read,
)
