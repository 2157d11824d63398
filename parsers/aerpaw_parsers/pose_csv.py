"""Positions and attitude as CSV with named columns: converted vehicleOut, ArduPilot exports, DJI and AirData records.

Columns come in any order. Units in brackets (``[ft]``, ``[MPH]``) are converted, and altitudes above sea level become
heights above the first position. Times without a zone are local unless the name of the column contains UTC or GPS.
"""

from __future__ import annotations

from aerpaw_cmp.readers import InputError, Reader, ReadOptions, ReadResult, dictionary

from . import _identity, _pose, _sheet, ardupilot_bin, nemo_csv, quectel_ri, rtklib_pos, vehicle_out


def is_header(names: list[str]) -> bool:
    """Check whether there is a position and a time among the names, and no quantity of a radio."""
    known = _quantities(names)
    return ({*_pose.PLACE[:2]} <= known or "grid" in known) and has_time(names) and not has_radio(names)


def has_radio(names: list[str]) -> bool:
    """Check whether there is a level, a ratio or a rank of the channel among the names."""
    return any(
        what is not None and (what.quantity.role in ("rss", "rank") or what.quantity.name in ("SINR", "RSRQ"))
        for what, *_ in dictionary.described(names)[1]
    )


def _quantities(names: list[str]) -> set[str]:
    return {meaning.quantity.name for name in names if (meaning := dictionary.meaning(name)) is not None}


def has_time(names: list[str]) -> bool:
    """Check whether a name is that of a time, a date, or GPS weeks."""
    known = _quantities(names)
    return not known.isdisjoint(("time", "date")) or {"gps_week", "gps_seconds"} <= known


def sniff(head: bytes) -> bool:
    """Check whether a file begins with a header with position and time and is not in AERPAW's own layout."""
    narrower = [module.READER.sniff for module in (vehicle_out, ardupilot_bin, nemo_csv, quectel_ri, rtklib_pos)]
    return _sheet.starts(head, is_header) and not any(known(head) for known in narrower)


def read(data: bytes, options: ReadOptions) -> ReadResult:
    """Return the telemetry ``vehicle``.

    Raises
    ------
    InputError
        If the positions are on a local grid.
    UsageError
        If the zone of the clock is unknown.
    """
    sheet = _sheet.read(data, is_header)
    if sheet is not None and sheet.find("latitude_deg") is None and (grid := sheet.find("grid")) is not None:
        raise InputError(
            f"positions on a grid, such as column {sheet.names[grid]!r} (NED, ENU, UTM)",
            expected="columns of latitude and longitude",
            cause="an export in local coordinates, whose origin the table does not contain",
        )
    rows = None if sheet is None else _sheet.rows(sheet, options, reader="pose_csv")
    if sheet is None or rows is None:
        return _sheet.nothing(data, "pose_csv", "no header with a time, a latitude and a longitude")
    rows.warnings += _sheet.way_to_level(sheet)
    tracks = [
        _pose.from_sheet(part, cells, name=f"vehicle_{label}" if label else "vehicle", source="table of positions")
        for label, part, cells in _identity.parts(rows, sheet, "device")
    ]
    rows.warnings += sheet.unread()
    return rows.result(tracks)


READER = Reader(
    name="pose_csv",
    title="positions and attitude, CSV with named columns (converted vehicleOut, ArduPilot export, DJI, AirData)",
    kinds=("telemetry",), sample="timestamp,Lat,Lng,Alt,Roll,Pitch,Yaw", sniff=sniff, read=read,
)  # fmt: skip
