"""Telemetry of tables with named columns: AERPAW's and others' autopilots, DJI, phones."""

from __future__ import annotations

import re

import numpy as np

from aerpaw_cmp.common.units import AnyArray, BoolArray, FloatArray
from aerpaw_cmp.logs import rows as _rows
from aerpaw_cmp.logs.records import Stream

from . import _sheet

LATITUDE = (r"(osd |gps )?(lat|latitude)( deg| degrees)?", r".* (lat|latitude)")
_LONGITUDE = (r"(osd |gps )?(lon|lng|long|longitude)( deg| degrees)?", r".* (lon|lng|longitude)")
_LENGTH = r"( m| meters| metres| ft| feet)?"
ABOVE_TAKEOFF = (
    rf"height above takeoff{_LENGTH}", rf"osd height{_LENGTH}", rf"(rel|relative) (alt|altitude|height){_LENGTH}",
    rf"(altitude ?relative|relalt){_LENGTH}", rf"height{_LENGTH}", rf"ascent{_LENGTH}", r"alt m",
)  # fmt: skip
_ALTITUDE = (
    rf"(gps )?(alt|altitude|ele|elevation){_LENGTH}",
    rf"osd altitude{_LENGTH}",
    r"altitude above ?sea ?level.*",
    rf"(altitude|alt|height|elevation) ?(amsl|msl|asl){_LENGTH}|(amsl|msl)( altitude| alt)?{_LENGTH}",
)
_SEA_LEVEL = re.compile(r"sea ?level|(\b|altitude)(amsl|msl|asl)\b|\b(ele|elevation)\b|^gps |^osd ")
_OF_AERPAW = {
    "gpsfix",
    "numberofsatellites",
    "number of satellite",
    "number of satellites",
    "batteryvolts",
    "volt",
    "voltage",
}
_OF_RECEIVERS = (
    {"gcrs", "spd"},
    {"networktech"},
    {"networkmode"},
    {"cellname"},
    {"psc or pci"},
    {"timestamp sample", "eph"},
    {"time utc usec"},
)
_OF_PHONES = {"networktech", "networkmode"}
# PX4's receiver: positions in 1e-7 degrees, altitudes in mm, where they are whole numbers.
_PX4_GPS = "time utc usec"
_REST_S, _REST_M, _REST_RISE_M = 5.0, 2.0, 0.3
_ANGLES = {
    "roll_deg": (r"(osd |gimbal )?roll( deg| degrees| rad)?",),
    "pitch_deg": (r"(osd )?pitch( deg| degrees| rad)?",),
    "yaw_deg": (r"(osd )?yaw( deg| degrees| rad)?", r"compass heading( degrees)?", r"heading( deg)?", r"bearing"),
}
_VELOCITIES = {
    "velocity_north_mps": (r"velocity ?(north|x)( mps)?", r"vn", r"vel n m s", r"(osd )?x ?speed.*", r"speed ?x"),
    "velocity_east_mps": (r"velocity ?(east|y)( mps)?", r"ve", r"vel e m s", r"(osd )?y ?speed.*", r"speed ?y"),
    "velocity_down_mps": (r"velocity ?(down|z)( mps)?", r"vd", r"vz", r"vel d m s", r"(osd )?z ?speed.*", r"speed ?z"),
}
_COUNTS = {
    "fix": (r"(gps )?fix( type)?", r"gpsfix", r"gps lock"),
    "satellites": (
        r"(number of satellites?|satellites( used)?|num ?sat|osd gpsnum|nsats|numberofsatellites|gps count)",
    ),
}


# No count is so large.
_MOST = 1e9


def has_position(names: list[str]) -> bool:
    """Check whether plain names hold a latitude and a longitude."""
    return all(any(_sheet.matches(name, form[:1]) for name in names) for form in (LATITUDE, _LONGITUDE))


def from_sheet(rows: _rows.Rows, sheet: _sheet.Sheet, *, name: str, source: str) -> Stream | None:
    """The telemetry stream of a table; None where it has no position.

    Rows without a position are left out unless all are.

    Parameters
    ----------
    rows : Rows
    sheet : Sheet
    name, source : str
        Of the stream, and where its pose comes from.
    """
    latitude, longitude = sheet.find(*LATITUDE), sheet.find(*_LONGITUDE)
    if latitude is None or longitude is None:
        return None
    scale = 1e-7 if _is_px4_gps(sheet, latitude) else 1.0
    values: dict[str, AnyArray] = {
        "latitude_deg": scale * _signed(sheet, latitude, "NS"),
        "longitude_deg": scale * _signed(sheet, longitude, "EW"),
    }
    lost = clean(rows, values)
    values["altitude_m"] = _altitude(rows, sheet, lost)
    values |= _angles(rows, sheet)
    for key, form in _VELOCITIES.items():
        if (column := sheet.find(*form)) is not None:
            values[key] = sheet.numbers(column)
    for key, form in _COUNTS.items():
        if (column := sheet.find(*form)) is not None:
            count = sheet.numbers(column)
            values[key] = np.where(np.abs(count) < _MOST, count, -1).astype(np.int64)
    where = None if lost.all() else ~lost
    return rows.stream("telemetry", name, values, where=where, source=source, height_from=rows.height_from)


def _signed(sheet: _sheet.Sheet, column: int, letters: str) -> FloatArray:
    """Angles, negative where a column of hemispheres behind them says S or W."""
    angle = sheet.numbers(column)
    if column + 1 == len(sheet.names):
        return angle
    side = np.array([text.upper() for text in sheet.texts(column + 1)])
    if not np.isin(side, list(letters)).any() or not np.isin(side, [*letters, ""]).all():
        return angle
    return np.where(side == letters[1], -np.abs(angle), angle)


def _is_px4_gps(sheet: _sheet.Sheet, latitude: int) -> bool:
    """Check whether positions are PX4's integers."""
    return _PX4_GPS in sheet.plain and bool((np.abs(sheet.numbers(latitude)) > 180.0).any())


def clean(rows: _rows.Rows, values: dict[str, AnyArray]) -> AnyArray:
    """Put NaN for positions that cannot be (or 0, 0) into a dictionary of columns; their mask."""
    latitude, longitude = values["latitude_deg"], values["longitude_deg"]
    # receivers write 0, 0 before their first fix
    lost: AnyArray = np.asarray(
        ~((np.abs(latitude) <= 90) & (np.abs(longitude) <= 180)) | ((latitude == 0) & (longitude == 0))
    )
    values |= {"latitude_deg": np.where(lost, np.nan, latitude), "longitude_deg": np.where(lost, np.nan, longitude)}
    rows.mark(lost, "no_fix")
    return lost


def above_takeoff(rows: _rows.Rows, altitude: FloatArray, lost: AnyArray) -> FloatArray:
    """Altitudes above sea level as heights above the first position, with a warning."""
    known = altitude[np.isfinite(altitude) & ~lost]
    if not len(known):
        return altitude
    zero = float(known[0])
    rows.warnings.append(_TAKEN_OFF.format(zero))
    return np.asarray(altitude - zero)


_TAKEN_OFF = "altitudes are above sea level: {:.1f} m, that of the first position, was taken off"


def _altitude(rows: _rows.Rows, sheet: _sheet.Sheet, lost: BoolArray) -> FloatArray:
    above, column = sheet.find(*ABOVE_TAKEOFF), sheet.find(*_ALTITUDE)
    if above is not None and not (column is not None and _OF_PHONES & set(sheet.plain)):  # there a height of the floor
        rows.height_from = "written"
        return sheet.numbers(above)
    if column is None:
        rows.warnings.append("the log has no altitude: give the track another log, or heights are unknown")
        return np.full(len(rows), np.nan)
    altitude = sheet.numbers(column)
    if _PX4_GPS in sheet.plain and sheet.plain[column] == "alt":
        altitude = altitude / 1e3
    first = altitude[np.isfinite(altitude) & ~lost][:1]
    if not len(first) or abs(first[0]) < 10.0:  # what begins within a few metres of zero is relative to take-off
        return altitude
    rows.height_from, names = "program", set(sheet.plain)
    if len(_OF_AERPAW & names) > 1:
        return altitude  # converted vehicleOut, whose altitude is above take-off also where the table begins in flight
    if _SEA_LEVEL.search(sheet.plain[column]):
        rows.height_from = "written"
    elif not any(signs <= names for signs in _OF_RECEIVERS):
        rows.height_from = "assumed"
        if not _begins_at_rest(rows, sheet, altitude, lost):
            text = f"altitude begins at {first[0]:.1f} m in flight and nothing says above what: read as above take-off"
            rows.warnings.append(text)
            return altitude
    return above_takeoff(rows, altitude, lost)


def _begins_at_rest(rows: _rows.Rows, sheet: _sheet.Sheet, altitude: FloatArray, lost: BoolArray) -> bool:
    """Check whether the first seconds of a track have one place and one height: that of the ground."""
    seconds = (rows.time - rows.time[:1]) / np.timedelta64(1, "s")
    early = np.flatnonzero(~lost & np.isfinite(altitude) & (seconds <= _REST_S))
    if len(early) < 3:
        return False
    columns = [sheet.find(*form) for form in (LATITUDE, _LONGITUDE)]
    moved = [np.ptp(sheet.numbers(i)[early]) * _DEGREE_M for i in columns if i is not None]
    return bool(max(moved) < _REST_M and np.ptp(altitude[early]) < _REST_RISE_M)


_DEGREE_M = 111_000.0


def _angles(rows: _rows.Rows, sheet: _sheet.Sheet) -> dict[str, FloatArray]:
    """Angles: degrees, unless no column names a unit and no yaw of the log is beyond 2 pi."""
    columns = {key: column for key, form in _ANGLES.items() if (column := sheet.find(*form)) is not None}
    values = {key: sheet.numbers(column) for key, column in columns.items()}
    named = any(sheet.unit(c) or sheet.plain[c].endswith((" deg", " degrees", " rad")) for c in columns.values())
    yaw = np.abs(values.get("yaw_deg", np.full(1, np.nan)))
    if named or not np.isfinite(yaw).any() or (yaw > 2 * np.pi).any():
        return values
    rows.warnings.append("no yaw is beyond 2 pi: the angles were read as radians")
    return {key: np.degrees(value) for key, value in values.items()}
