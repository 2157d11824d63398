"""PX4 log (``.ulg``): position, attitude, velocity and GPS of the aircraft's own log.

The format describes itself: ``F`` messages contain the fields of each topic, ``A`` messages its number, and ``D``
messages its data. The topics ``vehicle_global_position``, ``vehicle_attitude`` (quaternion) and
``vehicle_local_position`` (velocity) are read, and ``vehicle_gps_position`` or ``sensor_gps`` for UTC and fix, and for
the position if there is no other source. Instance 0 of each topic is read. If there are several receivers, the receiver
with the most fixes is read. Heights are above ``home_position`` at take-off, else above the ground at rest or the first
position. Source: PX4 guide, "ULog File Format".
"""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping, Sequence

import numpy as np

from aerpaw_cmp.readers import AnyArray, FloatArray, Reader, ReadOptions, ReadResult, RejectedLine, counted, dictionary

from . import _autopilot

_MAGIC = b"ULog\x01\x12\x35"
_TYPES = {
    "int8_t": "i1", "uint8_t": "u1", "bool": "u1", "char": "S1", "int16_t": "<i2", "uint16_t": "<u2", "int32_t": "<i4",
    "uint32_t": "<u4", "int64_t": "<i8", "uint64_t": "<u8", "float": "<f4", "double": "<f8",
}  # fmt: skip
_WANTED = (
    "vehicle_global_position", "vehicle_attitude", "vehicle_local_position", "vehicle_gps_position", "sensor_gps",
    "home_position",
)  # fmt: skip
_FIELD = re.compile(r"(\w+)(?:\[(\d{1,4})\])? (\w+)")
# Kinds of message of the format, by their letters.
_KINDS = frozenset(b"BFIMPQADLCSORT")


def _layout(text: str) -> np.dtype[np.void] | None:  # type: ignore[type-var]
    """Return the layout of a topic, or None if it contains another topic. The topics that are read here do not."""
    fields: list[tuple[str, str] | tuple[str, str, tuple[int]]] = []
    for part in text.split(";"):
        if not part:
            continue
        member = _FIELD.fullmatch(part.strip())
        if member is None or member[1] not in _TYPES:
            return None
        kind = _TYPES[member[1]]
        fields.append((member[3], kind, (int(member[2]),)) if member[2] else (member[3], kind))
    try:
        return np.dtype(fields)
    except (ValueError, TypeError):
        return None


# The messages of a topic: their numbers, and their content.
_Topic = tuple[list[int], AnyArray]


def _topics(data: bytes) -> tuple[dict[str, _Topic], int, list[RejectedLine]]:
    """Return the wanted topics, the number of intact messages, and damaged segments."""
    forms: dict[str, str] = {}
    names: dict[int, tuple[str, int]] = {}
    bodies: dict[tuple[str, int], list[tuple[int, bytes]]] = {}
    damaged: list[RejectedLine] = []
    count, at = 0, 16  # after the magic bytes, the version and the start time
    while at + 3 <= len(data):
        size, kind = struct.unpack_from("<HB", data, at)
        if kind not in _KINDS or at + 3 + size > len(data):
            reason = f"{counted(len(data) - at, 'byte')} without a message at {at}: the rest is not read"
            damaged.append(RejectedLine(count + 1, reason, ""))
            break
        body = data[at + 3 : at + 3 + size]
        if kind == ord("F"):
            name, _, text = body.decode("ascii", "replace").partition(":")
            forms[name] = text
        if kind == ord("A") and size > 3:
            names[struct.unpack_from("<H", body, 1)[0]] = (body[3:].decode("ascii", "replace"), body[0])
        topic = names.get(struct.unpack_from("<H", body)[0]) if kind == ord("D") and size > 2 else None
        if topic is not None and topic[0] in _WANTED and (topic[1] == 0 or topic[0] in _RECEIVERS):
            bodies.setdefault(topic, []).append((count, body[2:]))
        count += 1
        at += 3 + size
    topics: dict[str, _Topic] = {}
    for (name, _), messages in sorted(bodies.items()):
        numbers, content = zip(*messages, strict=True)
        table = _table(content, forms.get(name, ""))
        # use the receiver with the most fixes
        if name not in topics or _fixes(table) > _fixes(topics[name][1]):
            topics[name] = [*numbers], table
    return {name: topics.get(name, ([], _table((), ""))) for name in _WANTED}, count, damaged


def _fixes(table: AnyArray) -> int:
    fix = _column(table, "fix_type")
    return 0 if fix is None else int((fix >= _FIX_3D).sum())


_RECEIVERS, _FIX_2D, _FIX_3D = ("vehicle_gps_position", "sensor_gps"), 2, 3


def _table(bodies: Sequence[bytes], text: str) -> AnyArray:
    layout = _layout(text)
    if layout is None or not bodies or "timestamp" not in (layout.names or ()):
        return np.zeros(0, dtype=[("timestamp", "<u8")])
    size = layout.itemsize
    # messages omit the padding at the end of a topic
    return np.frombuffer(b"".join(body[:size].ljust(size, b"\0") for body in bodies), dtype=layout)


def _column(table: AnyArray, *names: str) -> FloatArray | None:
    return next((table[name].astype(np.float64) for name in names if name in (table.dtype.names or ())), None)


def _series(topic: _Topic, columns: Mapping[str, FloatArray | None]) -> _autopilot.Series:
    numbers, table = topic
    if not len(table) or not columns:
        return _autopilot.NONE
    present = {name: values for name, values in columns.items() if values is not None}
    return _autopilot.Series(table["timestamp"].astype(np.float64) / 1e6, np.array(numbers, dtype=np.int64), present)


def read(data: bytes, options: ReadOptions) -> ReadResult:
    """Return the telemetry ``vehicle``."""
    topics, count, damaged = _topics(data)
    gps_name = "vehicle_gps_position" if len(topics["vehicle_gps_position"][1]) else "sensor_gps"
    gps, attitude, local = topics[gps_name], topics["vehicle_attitude"], topics["vehicle_local_position"]
    place, source = topics["vehicle_global_position"], "PX4 ULog"
    if not (position := _position(place[1])):
        place, source, position = gps, f"PX4 ULog, {gps_name}", _position(gps[1])
    utc = _column(gps[1], "time_utc_usec")
    offset = None if utc is None else _autopilot.offset_s(utc / 1e6, gps[1]["timestamp"].astype(np.float64) / 1e6)
    flight = _autopilot.Flight(
        position=_series(place, position), attitude=_series(attitude, _angles(attitude[1])),
        velocity=_series(local, _columns(local[1])), fix=_series(gps, _columns(gps[1])), utc_minus_clock_s=offset,
        home=_series(topics["home_position"], _home(topics["home_position"][1])), source=source,
    )  # fmt: skip
    return _autopilot.result("px4_ulog", options, [flight], count, damaged)


def _columns(table: AnyArray) -> dict[str, FloatArray]:
    """Return columns of the record model, from integers of receivers until PX4 1.14, or from doubles."""
    names = [name for name in table.dtype.names or () if table[name].ndim == 1 and table.dtype[name].kind in "iuf"]
    fields = {name: table[name].astype(np.float64) for name in names}
    return dictionary.record_columns(fields, integers=[name for name in names if table.dtype[name].kind != "f"])


def _position(table: AnyArray) -> dict[str, FloatArray]:
    """Return position and altitude of the messages of the estimator or the receiver, if there are any."""
    columns = _columns(table)
    if not len(table) or not {"latitude_deg", "longitude_deg"} <= set(columns):
        return {}
    if "fix" in columns:  # the receiver's own position; positions at 0, 0 are flagged
        columns |= {
            name: np.where(columns["fix"] < _FIX_2D, 0.0, columns[name]) for name in ("latitude_deg", "longitude_deg")
        }
    unknown = np.full(len(table), np.nan)
    return {name: columns.get(name, unknown) for name in ("latitude_deg", "longitude_deg", "altitude_m")}


def _home(table: AnyArray) -> dict[str, FloatArray | None]:
    """Return the altitude of home each time that it was set, NaN if the autopilot marks it as not valid."""
    altitude, valid = _column(table, "alt"), _column(table, "valid_alt")
    if altitude is not None and valid is not None:
        altitude = np.where(valid != 0, altitude, np.nan)
    return {"altitude_m": altitude}


def _angles(table: AnyArray) -> dict[str, FloatArray | None]:
    """Return roll, pitch and yaw of quaternions (w, x, y, z) from front, right, down to north, east, down."""
    q = _column(table, "q")
    if q is None or q.ndim != 2 or q.shape[1] != 4:
        return {}
    w, x, y, z = q.T
    return {
        "roll_deg": np.degrees(np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))),
        "pitch_deg": np.degrees(np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))),
        "yaw_deg": np.degrees(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))),
    }


READER = Reader(
    name="px4_ulog", title="PX4 log (.ulg)", kinds=("telemetry",), sniff=lambda head: head.startswith(_MAGIC),
    sample="binary: vehicle_global_position, vehicle_attitude, vehicle_local_position", read=read,
)  # fmt: skip
