"""ArduPilot dataflash log (``.bin``, or ``.log`` as Mission Planner writes it): the aircraft's own pose and velocity.

The format describes itself: every message begins with A3 95 and its number, and ``FMT`` messages contain the length and
columns of each. In text, each message is a line, ``NAME, value, value``. The messages ``POS`` (else ``GPS``), ``ATT``,
``XKF1`` or ``NKF1`` (velocity), ``GPS`` (UTC, fix), ``BAT`` and ``RAD`` (levels of the telemetry radio) are read.
Heights are above home at take-off (``RelHomeAlt``). If home is unknown, they are above the ground at rest or the first
position. Source: ArduPilot ``libraries/AP_Logger/LogStructure.h``.
"""

from __future__ import annotations

import re
import struct

import numpy as np

from aerpaw_cmp.readers import Reader, ReadOptions, ReadResult, RejectedLine, dictionary

from . import _autopilot

_MARK = b"\xa3\x95"
_FMT = 128
# Letters of a layout: code of struct, and the factor that converts a value to SI units or degrees (c, C, e, E 0.01; L
# 1e-7 deg).
_TYPES = {
    "b": ("b", 1.0), "B": ("B", 1.0), "h": ("h", 1.0), "H": ("H", 1.0), "i": ("i", 1.0), "I": ("I", 1.0),
    "f": ("f", 1.0), "d": ("d", 1.0), "c": ("h", 0.01), "C": ("H", 0.01), "e": ("i", 0.01), "E": ("I", 0.01),
    "L": ("i", 1e-7), "M": ("B", 1.0), "q": ("q", 1.0), "Q": ("Q", 1.0), "g": ("e", 1.0),
    "n": ("4s", 0.0), "N": ("16s", 0.0), "Z": ("64s", 0.0), "a": ("64s", 0.0),
}  # fmt: skip
_FIX_2D, _FIX_3D = 2, 3
_WANTED = ("POS", "GPS", "ATT", "XKF1", "NKF1", "EKF1", "BAT", "RAD")


_TEXT = re.compile(rb"FMT, ?128, ?89, ?FMT,")


def sniff(head: bytes) -> bool:
    """Check whether a log begins with the message that describes ``FMT`` messages."""
    return head[:3] == _MARK + bytes([_FMT]) or _TEXT.match(head) is not None


class _Form:
    """The layout of one kind of message."""

    def __init__(self, length: int, name: str, form: str, columns: list[str]) -> None:
        self.length, self.name, self.columns = length, name, columns
        known = [_TYPES.get(letter, ("", 0.0)) for letter in form]
        self.scales = [scale for _, scale in known]
        self.layout = struct.Struct("<" + "".join(code for code, _ in known))
        self.sound = self.layout.size == length - 3 and len(columns) == len(known) and all(code for code, _ in known)


def _form(body: bytes) -> tuple[int, _Form]:
    kind, length = body[0], body[1]
    texts = [part.split(b"\0")[0].decode("ascii", "replace") for part in (body[2:6], body[6:22], body[22:86])]
    return kind, _Form(length, texts[0], texts[1], texts[2].split(","))


# Number and values of each message, by its name and columns: a log may describe the same name several times.
_Rows = dict[str, dict[tuple[str, ...], list[tuple[int, tuple[float, ...]]]]]


def _messages(data: bytes) -> tuple[_Rows, int, list[RejectedLine]]:
    """Return the values of the wanted messages, the number of intact messages, and damaged segments."""
    forms: dict[int, _Form] = {_FMT: _Form(89, "FMT", "BBnNZ", ["Type", "Length", "Name", "Format", "Columns"])}
    by_name: _Rows = {name: {} for name in _WANTED}
    damaged: list[RejectedLine] = []
    count, at, end = 0, 0, len(data)
    while at < end:
        form = forms.get(data[at + 2]) if data[at : at + 2] == _MARK and at + 3 <= end else None
        if form is None or form.length < 3 or at + form.length > end:
            next_mark = data.find(_MARK, at + 1)
            next_mark = end if next_mark < 0 else next_mark
            reason = f"{next_mark - at} bytes at {at} that are not a message"
            damaged.append(RejectedLine(count + len(damaged) + 1, reason, ""))
            at = next_mark
            continue
        body = data[at + 3 : at + form.length]
        if data[at + 2] == _FMT:
            kind, described = _form(body)
            if kind != _FMT:
                forms[kind] = described
        elif form.name in by_name and form.sound:
            raw = form.layout.unpack(body)
            values = tuple(v * s if s else float("nan") for v, s in zip(raw, form.scales, strict=True))
            by_name[form.name].setdefault(tuple(form.columns), []).append((count + len(damaged), values))
        count += 1
        at += form.length
    return by_name, count, damaged


def _text_messages(data: bytes) -> tuple[_Rows, int, list[RejectedLine]]:
    """Return the same as :func:`_messages` for a log in text, in which each line is a message with scaled values."""
    columns: dict[str, tuple[str, ...]] = {}
    by_name: _Rows = {name: {} for name in _WANTED}
    damaged: list[RejectedLine] = []
    lines = data.decode("utf-8", "replace").splitlines()
    for number, line in enumerate(lines):
        name, *cells = (cell.strip() for cell in line.split(","))
        if name == "FMT" and len(cells) > 4:
            columns[cells[2]] = tuple(cells[4:])
        if name not in by_name:
            continue
        if len(cells) == len(columns.get(name, ())):
            by_name[name].setdefault(columns[name], []).append((number, tuple(map(_number, cells))))
        else:
            damaged.append(RejectedLine(number + 1, "a message without the fields of its FMT line", line[:500]))
    return by_name, len(lines) - len(damaged), damaged


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return float("nan")


def _series(by_name: _Rows, name: str) -> _autopilot.Series:
    """Return the messages of one name that have its most frequent layout and its first instance (filter).

    For several GPS receivers, return the messages of the receiver with the most fixes, because the first may never have
    had a fix.
    """
    timed = {names: rows for names, rows in by_name[name].items() if "TimeUS" in names}
    if not timed:
        return _autopilot.NONE
    names, rows = max(timed.items(), key=lambda item: len(item[1]))
    table = np.array([values for _, values in rows], dtype=np.float64)
    columns = {column: table[:, i] for i, column in enumerate(names)}
    number = np.array([i for i, _ in rows], dtype=np.int64)
    for instance in ("I", "C", "Inst", "Instance"):
        if instance in columns:
            fixed = columns.get("Status", np.zeros(len(table))) >= _FIX_3D
            of_fix = {number: int(fixed[columns[instance] == number].sum()) for number in np.unique(columns[instance])}
            most = max(of_fix.values())
            best = columns[instance][0] if not most else next(key for key, count in of_fix.items() if count == most)
            keep = columns[instance] == best
            columns, number = {key: column[keep] for key, column in columns.items()}, number[keep]
            break
    return _autopilot.Series(columns["TimeUS"] / 1e6, number, columns)


def read(data: bytes, options: ReadOptions) -> ReadResult:
    """Return the telemetry ``vehicle``."""
    by_name, count, damaged = _text_messages(data) if _TEXT.match(data) else _messages(data)
    series = {name: _series(by_name, name) for name in _WANTED}
    gps = series["GPS"]
    if "Status" in gps.columns:
        for name in {"Lat", "Lng"} & set(gps.columns):  # status 0 and 1 mean no fix; positions at 0, 0 are flagged
            gps.columns[name] = np.where(gps.columns["Status"] < _FIX_2D, 0.0, gps.columns[name])
    place = series["POS"] if len(series["POS"].time_s) else gps
    if "Lat" not in place.columns or "Lng" not in place.columns:
        place = _autopilot.Series(gps.time_s[:0], gps.number[:0], {"Lat": gps.time_s[:0], "Lng": gps.time_s[:0]})
    names = ("Lat", "Lng", "Alt", "RelHomeAlt")  # without Yaw: one antenna does not measure it
    position = _named(place, *(name for name in names if name in place.columns))
    position.columns.setdefault("altitude_m", np.full(len(place.time_s), np.nan))
    filters = next((series[name] for name in ("XKF1", "NKF1", "EKF1") if len(series[name].time_s)), _autopilot.NONE)
    flight = _autopilot.Flight(
        position=position, attitude=_named(series["ATT"]), velocity=_named(filters), fix=_named(gps),
        utc_minus_clock_s=_offset(gps), source="ArduPilot dataflash log", battery=_named(series["BAT"]),
    )  # fmt: skip
    return _autopilot.result("ardupilot_bin", options, [flight], count, damaged, series["RAD"])


def _named(series: _autopilot.Series, *names: str) -> _autopilot.Series:
    """Return messages with the columns of the record model, from all columns or from the named columns."""
    fields = {name: series.columns[name] for name in names or series.columns}
    return _autopilot.Series(series.time_s, series.number, dictionary.record_columns(fields, of=("TimeUS",)))


def _offset(gps: _autopilot.Series) -> float | None:
    if "GWk" not in gps.columns or "GMS" not in gps.columns:
        return None
    # week 1000 is March 1999; a receiver without time writes 0, or weeks modulo 1024
    known = gps.columns["GWk"] > 1000
    utc_s = _autopilot.gps_utc_s(gps.columns["GWk"][known], gps.columns["GMS"][known])
    return _autopilot.offset_s(utc_s, gps.time_s[known])


READER = Reader(
    name="ardupilot_bin", title="ArduPilot dataflash log (.bin, or .log in text)", kinds=("telemetry", "rss", "kpi"),
    sample="binary: POS, GPS, ATT, XKF1", sniff=sniff, read=read,
)  # fmt: skip
