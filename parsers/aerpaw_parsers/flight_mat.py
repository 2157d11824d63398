"""Merged MATLAB flights: telemetry and level of each channel in one table, as their authors publish them.

Dataset 12 has ``mpower1 mpower2`` (channels USRP1, USRP2), and AFAR's exp-288 files ``mpower mquality``. Both kinds of
files have ``mX mY mZ`` (longitude, latitude, height above take-off) and ``mRoll mPitch mYaw`` in degrees. Their two
clocks are ``timestamp_power_for_csv`` (text, local) and ``timestamp_power``, which is **local time stored as if it were
UTC**.

The LTE flights have ``RSRP RSRP2 RSRQ RSSI`` and ``mX mY mZ``, with ``timestamp_for_csv`` (text, local) and
``timestamp_meas``, which **is UTC** and is used. No cell was decoded where ``succes`` is 0: ``RSRP2`` is then -60, and
the other levels are -inf. Levels are dB re full scale (the authors subtract 98 dB for dBm).

Processed files (``lat_s lon_s height_s RSRP_s ori_s``; ``lat_all lon_all h_all power_all ori_all``) have no clock.
Their times begin at 1970 and have the sample rate of the raw logs. The lines of the account are rows.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

import numpy as np

from aerpaw_cmp.common.errors import InputError
from aerpaw_cmp.common.units import AnyArray, BoolArray, FloatArray
from aerpaw_cmp.logs import text as _text
from aerpaw_cmp.logs.matfile import MAGIC, MAGIC_73, names_of, read_arrays
from aerpaw_cmp.readers import Reader, ReadOptions, ReadResult, RejectedLine, Rows, Stream, counted, dictionary

from . import _pose

_TELEMETRY = (
    *("mX", "mY", "mZ", "mRoll", "mPitch", "mYaw", "mSpeedX", "mSpeedY", "mSpeedZ", "mVz"),
    *("lat_s", "lon_s", "height_s", "ori_s"),
    *("lat_all", "lon_all", "h_all", "ori_all", "roll_all", "pitch_all"),
)
_LEVELS = ("mpower1", "mpower2", "mpower", "mquality", "RSRP", "RSRP2", "RSSI", "RSRP_s", "power_all", "RSRQ")
_TEXTS = ("timestamp_power_for_csv", "timestamp_for_csv")
_EPOCHS = ("timestamp_power", "timestamp_meas")
_UTC, _DECODED = "timestamp_meas", "succes"
# Level variables of files without a clock, and the time between rows of the raw flights [s].
_PROCESSED = {"RSRP_s": 0.1, "power_all": 0.03276}
_NAMES = {*_TELEMETRY, *_LEVELS, *_TEXTS, *_EPOCHS, "mSpeed"}
# Names that occur only in files of flights.
_SURE = {*_LEVELS, *_TEXTS, *_EPOCHS, "mX", "mY", "mZ"}
# Raw positions, with which files of LTE flights begin; they identify the format, but only interpolated positions are
# read.
_GPS = re.compile(r"GPS[xyz]")
_TEXT = re.compile(_text.TIME)


def sniff(head: bytes) -> bool:
    """Check whether a file is a MATLAB file that begins with the variables of a merged flight.

    In a file of version 7.3, names may be anywhere. Only names in the sniffed bytes are tested.
    """
    if head.startswith(MAGIC_73):
        return any(re.search(rb"\b%s\b" % name.encode(), head) for name in _SURE)
    return head.startswith(MAGIC) and any(name in _NAMES or _GPS.fullmatch(name) for name in names_of(head))


def _numeric(values: AnyArray, name: str) -> FloatArray:
    if values.dtype.kind not in "fiu":
        raise InputError(f"the variable {name!r} is not numeric", expected="a column of numbers")
    return values.astype(np.float64)


def _wall(table: dict[str, AnyArray]) -> tuple[AnyArray, BoolArray, str]:
    """Return the clock in ns, which rows have it, and its column: UTC, else text, else epoch, else the row number."""
    for name in (_UTC, *_TEXTS, *_EPOCHS):
        if name not in table:
            continue
        if name in _TEXTS:
            text = np.array([str(cell).strip() for cell in table[name]], dtype=np.str_)
            column = np.char.encode(text, "ascii", "replace")
            right = np.array([_TEXT.fullmatch(cell) is not None for cell in column.tolist()], dtype=bool)
            wall, valid, _, _ = _text.parse_texts(column)
            valid = valid & right
        else:
            epoch = _numeric(table[name], name)
            # numbers below 1e8 are day numbers of MATLAB, or seconds of a clock that was never set
            valid = np.isfinite(epoch) & (epoch > 1e8) & (epoch < 9.2e9)
            # double precision resolves 2.4e-7 s here, so round to microseconds
            wall = np.round(np.where(valid, epoch, 0) * 1e6).astype(np.int64) * 1000
        if valid.any() or name in _EPOCHS:
            return wall, valid, name
    for name, step_s in _PROCESSED.items():
        if name in table:
            count = np.arange(len(table[name]))
            return np.round(count * step_s * 1e9).astype(np.int64), count >= 0, _COUNTED
    clocks = ", ".join((*_TEXTS, *_EPOCHS))
    raise InputError("the MATLAB file has no clock", expected=f"a variable {clocks}", cause="not a flight")


# Name of the clock if a file has no clock and its rows are counted.
_COUNTED = "row number"


def _instants(
    table: dict[str, AnyArray], wall: AnyArray, clock: str, options: ReadOptions
) -> tuple[_text.Instants, list[str]]:
    """Return UTC of each row: text and epoch are both local wall clock unless ``clock: utc`` is set."""
    warnings: list[str] = []
    none = np.zeros(len(wall), dtype=bool)
    if clock == _COUNTED:
        origin = _text.origin_ns(options, needed_by="flight_mat")
        text = "the file has no clock: its rows are timed at the sample rate of the raw log"
        warnings.append(text if origin is not None else text + ", from 1970-01-01T00:00")
        return _text.Instants((wall + (origin or 0)).astype("datetime64[ns]"), none, none.copy()), warnings
    if clock == _UTC and options.clock not in ("local", "local_as_utc"):
        return _text.Instants(wall.astype("datetime64[ns]"), none, none.copy()), warnings
    if clock == _EPOCHS[0] and options.clock is None:
        warnings.append("timestamp_power is read as local wall clock stored as UTC, as AERPAW's authors write it")
    elif clock == _TEXTS[0] and _EPOCHS[0] in table:
        shift_s = np.round(_numeric(table[_EPOCHS[0]], _EPOCHS[0]) - wall / 1e9)
        if len(shift_s) and np.abs(shift_s).max() > 1:
            warnings.append(f"timestamp_power and its text differ by {shift_s[0]:.0f} s (true UTC?): the text was used")
    return _text.wall_to_utc(wall, options, needed_by="flight_mat"), warnings


def read(data: bytes, options: ReadOptions) -> ReadResult:
    """Return the telemetry ``vehicle`` and one level stream per channel.

    Raises
    ------
    InputError
        If the file is damaged, has no clock, or its columns differ in length.
    UsageError
        If no time zone is given.
    """
    # flat arrays, in the file's order of rows
    table = {name: np.asarray(values).ravel() for name, values in read_arrays(data, {*_NAMES, _DECODED}).items()}
    if not any(name in table for name in (*_LEVELS, *_TELEMETRY)):
        raise InputError("the MATLAB file contains no flight", expected=f"variables: {', '.join(sorted(_NAMES)[:5])}")
    sizes = sorted({len(column) for column in table.values()})
    if len(sizes) > 1:  # the rows cannot be matched
        names = [", ".join([name for name in table if len(table[name]) == size][:4]) for size in sizes]
        shown = "; ".join(f"{counted(size, 'row')}: {listed}" for size, listed in zip(sizes, names, strict=True))
        raise InputError(f"the columns differ in length ({shown})", expected="one row per sample in each")
    (count,) = sizes
    wall, valid, clock = _wall(table)
    keep = np.flatnonzero(valid)
    timed = {name: column[keep] for name, column in table.items()}
    instants, warnings = _instants(timed, wall[keep], clock, options)
    rows = Rows(
        reader="flight_mat", options=options, lines=count, row=keep, time=instants.time, flag=_text.no_flags(len(keep)),
        rejected=[RejectedLine(int(i) + 1, "the row has no time", "") for i in np.flatnonzero(~valid)],
        warnings=[*warnings, *instants.warnings], relative=clock == _COUNTED and options.time_origin is None,
    )  # fmt: skip
    instants.flag(rows.flag)
    return rows.result([_track(rows, timed, clock), *_measured(rows, timed)])


def _track(rows: Rows, table: dict[str, AnyArray], clock: str) -> Stream | None:
    fields = {name: _numeric(table[name], name) for name in _TELEMETRY if name in table}
    if not fields:
        return None
    values = dictionary.record_columns(fields)
    if (height := values.pop("above_home_m", None)) is not None:
        values["altitude_m"] = height
    if _pose.are_radians({name: values[name] for name in _pose.ANGLES if name in values}):
        rows.warnings.append(_pose.small_angles(_pose.ANGLES))
    flag, lost = rows.flag.copy(), np.zeros(len(rows), dtype=bool)
    place = [name for name in ("latitude_deg", "longitude_deg", "altitude_m") if name in values]
    for i, name in enumerate(place):
        lost |= ~(np.abs(values[name]) < 900) if i < 2 else ~np.isfinite(values[name])
    _text.add_flag(flag, lost, "no_fix")
    values |= {name: np.where(lost, np.nan, values[name]) for name in place}
    return rows.stream("telemetry", "vehicle", values, flag=flag, source=clock)


def _measured(rows: Rows, table: dict[str, AnyArray]) -> Iterator[Stream | None]:
    silent = _numeric(table[_DECODED], _DECODED) == 0 if _DECODED in table else np.zeros(len(rows), dtype=bool)
    for name in _LEVELS:
        if name not in table:
            continue
        values = _numeric(table[name], name)
        ((what, unit, _),) = dictionary.described([name], known=dictionary.AERPAW_MAT)[1]
        assert what is not None
        row, unit = what.quantity, unit or what.quantity.unit
        if row.role == "kpi":
            yield rows.stream("kpi", name, {"value": values}, quantity=row.name, unit=unit)
            continue
        number = re.fullmatch(r"mpower(\d)", name)
        channel = f"USRP{number[1]}" if number else name if name == "RSRP2" else row.name
        level, flag = rows.level(np.where(silent, -np.inf, values))
        unit = unit if row.name == "quality" else rows.options.unit or unit
        quantity = row.name if row.unit == "dBm" else None
        about = {"channel": channel, "unit": unit, "quantity": quantity}
        yield rows.stream("rss", channel, {"rss_db": level}, flag=flag, about=about)


READER = Reader(
    name="flight_mat",
    title="merged MATLAB flight (Dataset 12, AFAR, LTE at 3.51 GHz, and their processed files)",
    kinds=("telemetry", "rss", "kpi"),
    sample="mX mY mZ mRoll mPitch mYaw mpower1 mpower2 timestamp_power timestamp_power_for_csv", sniff=sniff, read=read,
)  # fmt: skip
