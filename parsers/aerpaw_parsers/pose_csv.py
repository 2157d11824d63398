"""Positions and attitude as CSV with named columns: converted vehicleOut, ArduPilot exports, DJI and AirData records.

Columns come in any order; units in brackets (``[ft]``, ``[MPH]``) are converted; altitudes above sea level are
brought to heights above the first position. Times without a zone are local unless the column's name says UTC or GPS.
"""

from __future__ import annotations

import re

from aerpaw_cmp.logs.readers import Reader, ReadOptions
from aerpaw_cmp.logs.records import ReadResult

from . import _nemo, _pose, _quantities, _sheet, quectel_ri, vehicle_out

_LIKE_A_LEVEL = re.compile(
    r"^(?!.*(batt|volt|throttle|gps)).*(\b(rx|received?) ?power|signal|\bdbm\b|\brss\b|strength)"
)


def is_header(names: list[str]) -> bool:
    """Check whether names hold a position and a time, and no quantity of a radio."""
    return (
        _pose.has_position(names)
        and _has_time(names)
        and not any(has_radio(name) for name in _quantities.in_common_words(names))
    )


def has_radio(name: str) -> bool:
    """Check whether a plain name is that of a level or rank."""
    meaning = _quantities.quantity(name)
    return meaning is not None and (meaning.kind in ("rss", "rank") or meaning.name in ("SINR", "RSRQ"))


def _has_time(names: list[str]) -> bool:
    return any(_sheet.matches(name, _sheet.TIME_NAMES) for name in names)


def sniff(head: bytes) -> bool:
    """Check whether a header with position and time stands in front, and it is not AERPAW's own layout."""
    narrower = (vehicle_out.READER.sniff, _nemo.sniff, quectel_ri.READER.sniff)
    return _sheet.starts(head, is_header) and not any(known(head) for known in narrower)


def read(data: bytes, options: ReadOptions) -> ReadResult:
    """Telemetry ``vehicle``; UsageError if the clock has no zone and none is given."""
    sheet = _sheet.read(data, is_header)
    rows = None if sheet is None else _sheet.rows(sheet, options, reader="pose_csv")
    if sheet is None or rows is None:
        return _sheet.nothing(data, "pose_csv", "no header with a time, a latitude and a longitude")
    unread = [name for name, text in zip(sheet.names, sheet.plain, strict=True) if _LIKE_A_LEVEL.search(text)]
    if unread:
        rows.warnings.append(f"columns that are not read: {', '.join(unread[:5])}; '--map' reads a level")
    track = _pose.from_sheet(rows, sheet, name="vehicle", source="table of positions")
    rows.warnings += sheet.unread()
    return rows.result([track])


READER = Reader(
    name="pose_csv",
    title="positions and attitude, CSV with named columns (converted vehicleOut, ArduPilot export, DJI, AirData)",
    kinds=("telemetry",),
    sample="timestamp,Lat,Lng,Alt,Roll,Pitch,Yaw",
    sniff=sniff,
    read=read,
)
