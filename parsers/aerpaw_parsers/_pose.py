"""Telemetry of tables with named columns: AERPAW's and others' autopilots, DJI, phones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from aerpaw_cmp.common.units import AnyArray, FloatArray
from aerpaw_cmp.logs.records import ReadResult, Stream

from . import _decided, _rows, _sheet

LATITUDE = (r"(osd |gps )?(lat|latitude)( deg| degrees)?", r".* (lat|latitude)")
LONGITUDE = (r"(osd |gps )?(lon|lng|long|longitude)( deg| degrees)?", r".* (lon|lng|longitude)")
ABOVE_TAKEOFF = (
    r"height above takeoff( feet| m| ft)?", r"osd height( ft| m)?", r"(rel|relative) (alt|altitude|height)( m)?",
    r"relalt", r"height( m)?", r"alt m",
)  # fmt: skip
ALTITUDE = (
    r"(gps )?(alt|altitude|ele|elevation)( m| ft| meters)?",
    r"osd altitude( ft| m)?",
    r"altitude above ?sea ?level.*",
)
ANGLES = {
    "roll_deg": (r"(osd |gimbal )?roll( deg| degrees| rad)?",),
    "pitch_deg": (r"(osd )?pitch( deg| degrees| rad)?",),
    "yaw_deg": (r"(osd )?yaw( deg| degrees| rad)?", r"compass heading( degrees)?", r"heading( deg)?", r"bearing"),
}
VELOCITIES = {
    "velocity_north_mps": (r"velocity ?(north|x)( mps)?", r"vn", r"(osd )?x ?speed.*", r"speed ?x"),
    "velocity_east_mps": (r"velocity ?(east|y)( mps)?", r"ve", r"(osd )?y ?speed.*", r"speed ?y"),
    "velocity_down_mps": (r"velocity ?(down|z)( mps)?", r"vd", r"vz", r"(osd )?z ?speed.*", r"speed ?z"),
}
COUNTS = {
    "fix": (r"(gps )?fix( type)?", r"gpsfix"),
    "satellites": (r"(number of satellites?|satellites|num ?sat|osd gpsnum|nsats|numberofsatellites)",),
}


_MOST = 1e9
"""No count is so large."""


def has_position(names: list[str]) -> bool:
    """Whether plain names hold a latitude and a longitude."""
    return all(any(_sheet.matches(name, form[:1]) for name in names) for form in (LATITUDE, LONGITUDE))


def from_sheet(
    rows: _rows.Rows, sheet: _sheet.Sheet, decided: _decided.Decided, *, name: str, source: str
) -> Stream | None:
    """The telemetry stream of a table, or of a block of it, as written; None where it has no position.

    What the whole table says, :func:`settled` does.

    Parameters
    ----------
    rows : Rows
    sheet : Sheet
    decided : Decided
        Told what the table has.
    name, source : str
        Of the stream, and where its pose comes from.
    """
    latitude, longitude = sheet.find(*LATITUDE), sheet.find(*LONGITUDE)
    if latitude is None or longitude is None:
        return None
    values: dict[str, AnyArray] = {"latitude_deg": sheet.numbers(latitude), "longitude_deg": sheet.numbers(longitude)}
    clean(rows, values)
    values["altitude_m"] = _altitude(rows, sheet, decided)
    values |= _angles(sheet, decided)
    for key, form in VELOCITIES.items():
        if (column := sheet.find(*form)) is not None:
            values[key] = sheet.numbers(column)
    for key, form in COUNTS.items():
        if (column := sheet.find(*form)) is not None:
            count = sheet.numbers(column)
            values[key] = np.where(np.abs(count) < _MOST, count, -1).astype(np.int64)
    return rows.stream("telemetry", name, values, source=source)


def settled(stream: Stream, decided: _decided.Decided) -> tuple[Stream, list[str]]:
    """A table's telemetry with what only all of it says, and the warnings of that.

    Rows without a position are left out unless all are; altitudes above sea level are brought to height above the
    first position; angles are degrees unless the column names radians or no yaw of the log is beyond 2 pi.
    """
    frame = stream.frame
    warnings: list[str] = []
    lost = np.isnan(frame["latitude_deg"].to_numpy())
    if not lost.all():
        frame = _decided.without(frame, lost)
    altitude = frame["altitude_m"].to_numpy()
    known = np.flatnonzero(np.isfinite(altitude) & ~np.isnan(frame["latitude_deg"].to_numpy()))
    zero = float(altitude[known[0]]) if len(known) else 0.0
    # take-off is where a flight's log begins: what begins within a few metres of zero is relative to it
    if "above sea level" in decided.marks and abs(zero) >= 10.0:
        frame["altitude_m"] = altitude - zero
        warnings.append(_TAKEN_OFF.format(zero))
    if "a yaw" in decided.marks and "beyond 2 pi" not in decided.marks:
        for name in ANGLES:
            frame[name] = np.degrees(frame[name].to_numpy())
        warnings.append("no yaw is beyond 2 pi: the angles were read as radians")
    return replace(stream, frame=frame), warnings


def clean(rows: _rows.Rows, values: dict[str, AnyArray]) -> AnyArray:
    """Put NaN for positions that cannot be (or 0, 0) into a dictionary of columns; their mask."""
    latitude, longitude = values["latitude_deg"], values["longitude_deg"]
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


def from_takeoff(result: ReadResult) -> ReadResult:
    """A result whose track holds altitudes above sea level, with heights above its first position instead."""
    track = next((stream for stream in result.streams if stream.kind == "telemetry"), None)
    altitude = None if track is None else track.frame["altitude_m"].to_numpy()
    if track is None or altitude is None or not np.isfinite(altitude).any():
        return result
    zero = float(altitude[np.isfinite(altitude)][0])
    track.frame["altitude_m"] = altitude - zero
    return replace(result, warnings=(*result.warnings, _TAKEN_OFF.format(zero)))


_TAKEN_OFF = "altitudes are above sea level: {:.1f} m, that of the first position, was taken off"


def _altitude(rows: _rows.Rows, sheet: _sheet.Sheet, decided: _decided.Decided) -> FloatArray:
    column = sheet.find(*ABOVE_TAKEOFF)
    if column is not None:
        return sheet.numbers(column)
    column = sheet.find(*ALTITUDE)
    if column is None:
        rows.warnings.append("the log has no altitude: give the track another log, or heights are unknown")
        return np.full(len(rows), np.nan)
    decided.marks.add("above sea level")
    return sheet.numbers(column)


def _angles(sheet: _sheet.Sheet, decided: _decided.Decided) -> dict[str, FloatArray]:
    columns = {key: column for key, form in ANGLES.items() if (column := sheet.find(*form)) is not None}
    values = {key: sheet.numbers(column) for key, column in columns.items()}
    named = any(sheet.unit(c) or sheet.plain[c].endswith((" deg", " degrees", " rad")) for c in columns.values())
    if named or "yaw_deg" not in values:
        return values
    yaw = np.abs(values["yaw_deg"])
    decided.marks |= {
        text for text, known in (("a yaw", np.isfinite(yaw)), ("beyond 2 pi", yaw > 2 * np.pi)) if known.any()
    }
    return values
