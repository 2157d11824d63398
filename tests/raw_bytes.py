"""A second, independent way from the bytes of logs to poses, for :mod:`tests.raw_checks`.

It imports none of the package's readers, track and geodesy. Lines are read by the csv module and regular expressions, and
local times by zoneinfo row by row. Positions are converted through earth-centred coordinates, and attitude through
quaternions. A log that it cannot read is left to the caller.
"""

from __future__ import annotations

import bisect
import csv
import io
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta, timezone
from typing import Any
from zoneinfo import ZoneInfo

import numpy as np
from numpy.typing import NDArray

Vector = tuple[float, float, float]
_Quaternion = tuple[float, float, float, float]
Matrix = tuple[Vector, Vector, Vector]
Grid = NDArray[np.float64]

_EQUATOR_M, _FLATTENING = 6_378_137.0, 1 / 298.257_223_563
# Poses below this height above the take-off ground are raised to it (arXiv 2502.10324).
LOWEST_M = 0.5

_STAMP = re.compile(r"\d{4}-\d\d-\d\d[ T]\d\d:\d\d:\d\d(?:\.\d{1,6})?(?:[+-]\d\d:?\d\d|Z)?")
_EPOCH = datetime(1970, 1, 1, tzinfo=timezone.utc)


def utc_us(text: str, zone: str) -> int:
    """Return the microseconds since 1970 of a written time. A time without an offset is local to ``zone``.

    Examples
    --------
    >>> utc_us("2025-06-01 10:00:00.5", "America/New_York") - utc_us("2025-06-01T14:00:00+00:00", "UTC")
    500000
    """
    head, _, fraction = text.replace("Z", "+00:00").replace("T", " ").partition(".")
    digits = re.match(r"\d*", fraction)[0] if fraction else ""  # type: ignore[index]
    moment = datetime.fromisoformat(head + fraction[len(digits) :])
    moment = moment.replace(tzinfo=ZoneInfo(zone)) if moment.tzinfo is None else moment
    return (moment - _EPOCH) // timedelta(microseconds=1) + int((digits + "000000")[:6])


# ---------------------------------------------------------------- logs


@dataclass(frozen=True, slots=True)
class Row:
    """A row of telemetry: UTC [us], degrees, metres above take-off. Roll, pitch and yaw [deg] if they are written."""

    time_us: int
    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    angles_deg: Vector | None


@dataclass(frozen=True, slots=True)
class Reading:
    """A line of a radio log: UTC [us] and its values by name."""

    time_us: int
    values: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class Log:
    """Telemetry rows in the order of the file, and readings by line, counted from 1."""

    rows: Sequence[Row]
    readings: Mapping[int, Reading]


def read_log(data: bytes, zone: str) -> Log | None:
    """Read telemetry and levels of a vehicleOut, a power log, a table with a title line or a merged .mat.

    Return None for other logs.

    Parameters
    ----------
    data : bytes
    zone : str
        IANA name of the zone of times that have no offset.

    Returns
    -------
    Log or None
    """
    if data[:6] == b"MATLAB":
        return _of_mat(data, zone)
    text = data.decode("utf-8", errors="replace")
    first = text.partition("\n")[0]
    if re.match(r"\[\d{4}-", first):
        return Log((), _od_lines(text, zone))
    if re.match(r"\d+,-?\d", first) and _STAMP.search(first):
        return Log(tuple(_vehicle_rows(text, zone)), {})
    if re.match(r"[A-Za-z_ ]+,", first):
        return _table(text, zone)
    return None


def _od_lines(text: str, zone: str) -> dict[int, Reading]:
    """Read the lines ``[stamp] octal value`` of od through ts.

    A line ``*`` has no value and means repeated samples.
    """
    out = {}
    for number, line in enumerate(text.split("\n"), start=1):
        match = re.match(r"\[([^\]]+)\] (?:\*|[0-7]+ +(\S+))\s*$", line)
        if match and _STAMP.fullmatch(match[1]):
            try:
                out[number] = Reading(utc_us(match[1], zone), {"": float(match[2])} if match[2] else {})
            except ValueError:
                continue
    return out


def _vehicle_rows(text: str, zone: str) -> Iterable[Row]:
    """``number, lon, lat, alt, [attitude, velocity,] ..., stamp, fix, satellites``."""
    for cells in csv.reader(io.StringIO(text)):
        stamp = next((cell.strip() for cell in cells if _STAMP.fullmatch(cell.strip())), None)
        if stamp is None or len(cells) not in (8, 9, 10):
            continue
        try:
            longitude, latitude, altitude = (float(cell) for cell in cells[1:4])
            angles = None
            if len(cells) == 10:
                pitch, yaw, roll = (math.degrees(float(part)) for part in cells[4].strip("()").split(","))
                angles = (roll, pitch, yaw)
            yield Row(utc_us(stamp, zone), latitude, longitude, altitude, angles)
        except ValueError:
            continue


def _table(text: str, zone: str) -> Log:
    """Read a table with a title line that names its columns, and angles in radians."""
    rows, readings = [], {}
    lines = list(csv.reader(io.StringIO(text)))
    names = [cell.strip().lower() for cell in lines[0]]
    for number, cells in enumerate(lines[1:], start=2):
        stamp = next((cell.strip() for cell in cells if _STAMP.fullmatch(cell.strip())), None)
        if stamp is None or len(cells) != len(names):
            continue
        time = utc_us(stamp, zone)
        values = {name: _float(cell) for name, cell in zip(names, cells, strict=True)}
        readings[number] = Reading(time, {name: value for name, value in values.items() if value is not None})
        place = [values.get(name) for name in ("latitude", "longitude", "altitude")]
        turn = [values.get(name) for name in ("roll", "pitch", "yaw")]
        if None not in place:
            angles = None if None in turn else tuple(math.degrees(x) for x in turn)  # type: ignore[arg-type]
            rows.append(Row(time, place[0], place[1], place[2], angles))  # type: ignore[arg-type]
    return Log(tuple(rows), readings)


def _float(cell: str) -> float | None:
    try:
        return float(cell)
    except ValueError:
        return None


def _of_mat(data: bytes, zone: str) -> Log | None:
    """Flights merged by their authors: local times as text, degrees, one row per reading."""
    from scipy.io import loadmat

    book: dict[str, Any] = loadmat(io.BytesIO(data))
    stamps = next((book[name] for name in ("timestamp_power_for_csv", "timestamp_for_csv") if name in book), None)
    if stamps is None or not {"mX", "mY", "mZ"} <= set(book):
        return None
    times = [utc_us(str(stamp).strip(), zone) for stamp in stamps.ravel()]
    columns = {name: value.ravel() for name, value in book.items() if getattr(value, "size", 0) == len(times)}
    turned = {"mRoll", "mPitch", "mYaw"} <= set(columns)
    rows, readings = [], {}
    for at, time in enumerate(times):
        angles = tuple(float(columns[name][at]) for name in ("mRoll", "mPitch", "mYaw")) if turned else None
        place = (float(columns["mY"][at]), float(columns["mX"][at]), float(columns["mZ"][at]))
        rows.append(Row(time, *place, angles))  # type: ignore[arg-type]
    levels = {name: column for name, column in columns.items() if column.dtype.kind == "f"}
    for at, time in enumerate(times):
        readings[at + 1] = Reading(time, {name: float(column[at]) for name, column in levels.items()})
    return Log(tuple(rows), readings)


# ---------------------------------------------------------------- place


def east_north_m(latitude_deg: float, longitude_deg: float, origin_deg: tuple[float, float]) -> tuple[float, float]:
    """East and north [m] of a place on the ellipsoid, by way of earth-centred coordinates.

    Parameters
    ----------
    latitude_deg, longitude_deg : float
    origin_deg : (2,)
        Latitude and longitude.

    Returns
    -------
    east, north : float
        On the tangent plane; within 5 km the geodesic is longer by less than a millimetre.
    """
    x, y, z = (
        a - b for a, b in zip(_earth_centred(latitude_deg, longitude_deg), _earth_centred(*origin_deg), strict=True)
    )
    latitude, longitude = (math.radians(angle) for angle in origin_deg)
    outward = math.cos(longitude) * x + math.sin(longitude) * y
    east = -math.sin(longitude) * x + math.cos(longitude) * y
    return east, math.cos(latitude) * z - math.sin(latitude) * outward


def _earth_centred(latitude_deg: float, longitude_deg: float) -> Vector:
    latitude, longitude = math.radians(latitude_deg), math.radians(longitude_deg)
    squeezed = _FLATTENING * (2 - _FLATTENING)
    normal = _EQUATOR_M / math.sqrt(1 - squeezed * math.sin(latitude) ** 2)
    flat = normal * math.cos(latitude)
    return flat * math.cos(longitude), flat * math.sin(longitude), normal * (1 - squeezed) * math.sin(latitude)


# ---------------------------------------------------------------- attitude


def _times(p: _Quaternion, q: _Quaternion) -> _Quaternion:
    return (
        p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3],
        p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2],
        p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1],
        p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0],
    )


def body_quaternion(roll_deg: float, pitch_deg: float, yaw_deg: float) -> _Quaternion:
    """Nose-left-up of the aircraft to east-north-up: yaw clockwise from north, nose up +, right wing down +."""

    def about(axis: int, angle_deg: float) -> _Quaternion:
        half = math.radians(angle_deg) / 2
        parts = [math.cos(half), 0.0, 0.0, 0.0]
        parts[axis + 1] = math.sin(half)
        return parts[0], parts[1], parts[2], parts[3]

    return _times(about(2, 90.0 - yaw_deg), _times(about(1, -pitch_deg), about(0, roll_deg)))


def between(first: _Quaternion, second: _Quaternion, share: float) -> _Quaternion:
    """The turn after a share of the way from one to another, at constant rate by the shorter way."""
    dot = sum(a * b for a, b in zip(first, second, strict=True))
    nearer = tuple(-b for b in second) if dot < 0 else second
    angle = math.acos(min(1.0, abs(dot)))
    if angle < 1e-9:
        return first
    weights = math.sin((1 - share) * angle) / math.sin(angle), math.sin(share * angle) / math.sin(angle)
    return tuple(weights[0] * a + weights[1] * b for a, b in zip(first, nearer, strict=True))  # type: ignore[return-value]


def matrix(q: _Quaternion) -> Matrix:
    """The rotation matrix of a unit quaternion."""
    w, x, y, z = q
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


def level(turn: Matrix) -> Matrix:
    """The turn about the vertical alone that keeps the heading of the nose."""
    size = math.hypot(turn[0][0], turn[1][0])
    east, north = turn[0][0] / size, turn[1][0] / size
    return ((east, -north, 0.0), (north, east, 0.0), (0.0, 0.0, 1.0))


@dataclass(frozen=True, slots=True)
class Pose:
    """A position [m] and a rotation at one time. There is no rotation if the rows have no attitude."""

    place_m: Vector
    turn: Matrix | None


class RawPath:
    """The flight between telemetry rows.

    Parameters
    ----------
    rows : sequence of Row
        Rows without a position, and those not later than all before them, are left out; ``out_of_order`` counts the
        earlier ones.
    origin_deg : (2,)
        Latitude and longitude of the site's origin.
    ground_m : float
        Height of the take-off point above the origin's ground.
    floor : callable, optional
        Height of the ground under an east and a north; by default that of the take-off point.
    """

    def __init__(
        self,
        rows: Sequence[Row],
        origin_deg: tuple[float, float],
        ground_m: float,
        floor: Callable[[float, float], float] | None = None,
    ) -> None:
        self.rows: list[Row] = []
        self.times_us: list[int] = []
        self.out_of_order = 0
        for row in rows:
            good = abs(row.latitude_deg) <= 90 and abs(row.longitude_deg) <= 180 and row.altitude_m > -900
            if not good or not (row.latitude_deg or row.longitude_deg):
                continue
            late = not self.rows or row.time_us > self.times_us[-1]
            self.out_of_order += not late and row.time_us < self.times_us[-1]
            if late:
                self.rows.append(row)
                self.times_us.append(row.time_us)
        self.origin_deg, self.ground_m = origin_deg, ground_m
        self.floor = floor or (lambda _east, _north: ground_m)

    def pose(self, time_us: float) -> Pose | None:
        """Interpolate at a time [us]. None before the first and after the last row."""
        times = self.times_us
        if not times or not times[0] <= time_us <= times[-1]:
            return None
        after = min(max(bisect.bisect_left(times, time_us), 1), len(times) - 1)
        earlier, later = self.rows[max(after - 1, 0)], self.rows[after]
        gap = later.time_us - earlier.time_us
        share = (time_us - earlier.time_us) / gap if gap else 0.0
        ends = [east_north_m(row.latitude_deg, row.longitude_deg, self.origin_deg) for row in (earlier, later)]
        east, north = ((1 - share) * a + share * b for a, b in zip(*ends, strict=True))
        up = self.ground_m + (1 - share) * earlier.altitude_m + share * later.altitude_m
        turn = None
        known = [row.angles_deg for row in (earlier, later) if row.angles_deg is not None and any(row.angles_deg)]
        if len(known) == 2 and all(math.isfinite(angle) for angles in known for angle in angles):
            turn = matrix(between(body_quaternion(*known[0]), body_quaternion(*known[1]), share))
        return Pose((east, north, max(up, self.floor(east, north) + LOWEST_M)), turn)
