"""MAVLink telemetry log of a ground station (``.tlog``): eight bytes of UTC in us, then one packet, and so on.

The messages GLOBAL_POSITION_INT (33: position, height above home, velocity, heading), ATTITUDE (30), GPS_RAW_INT
(24: fix) and SYS_STATUS (1: battery) are read. Only the component that sends the positions of a vehicle is read,
because a gimbal also sends its attitude. Checksums are checked. Source: MAVLink guide, "Packet
Serialization".
"""

from __future__ import annotations

import binascii
import struct

import numpy as np

from aerpaw_cmp.readers import Reader, ReadOptions, ReadResult, RejectedLine, dictionary

from . import _autopilot

_POSITION, _ATTITUDE, _GPS, _STATUS = 33, 30, 24, 1
# MAVLink's CRC_EXTRA: a hash of the fields. With it, a message of another layout fails the checksum.
_EXTRA = {_POSITION: 104, _ATTITUDE: 39, _GPS: 24, _STATUS: 124}
_LAYOUT = {
    _POSITION: struct.Struct("<IiiiihhhH"), _ATTITUDE: struct.Struct("<Iffffff"), _GPS: struct.Struct("<QiiiHHHHBB"),
    _STATUS: struct.Struct("<14xH15x"),
}  # fmt: skip
# Names of the fields in MAVLink's description of common messages.
_FIELDS = {
    _POSITION: ["time_boot_ms", "lat", "lon", "alt", "relative_alt", "vx", "vy", "vz", "hdg"],
    _ATTITUDE: ["time_boot_ms", "roll", "pitch", "yaw", "rollspeed", "pitchspeed", "yawspeed"],
    _GPS: ["time_usec", "lat", "lon", "alt", "eph", "epv", "vel", "cog", "fix_type", "satellites_visible"],
    _STATUS: ["voltage_battery"],
}
_EARLIEST_US, _LATEST_US = 946_684_800_000_000, 9_200_000_000_000_000


# Each byte with its bits in reverse order.
_REVERSED = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))


def _crc(data: bytes) -> int:
    """Return the X.25 checksum of MAVLink: the CRC-CCITT of the standard library, with reversed bits."""
    return int(f"{binascii.crc_hqx(data.translate(_REVERSED), 0xFFFF):016b}"[::-1], 2)


def _packet(data: bytes, at: int) -> tuple[int, int, tuple[int, int], bytes] | None:
    """Return the length (with its time), message number, source and payload of a packet, or None if there is none."""
    if at + 16 > len(data):
        return None
    stamp = int.from_bytes(data[at : at + 8], "big")
    if not _EARLIEST_US <= stamp <= _LATEST_US:
        return None
    mark, size = data[at + 8], data[at + 9]
    if mark == 0xFE:
        # version 1: length, sequence, system, component, message; checksum
        head, kind, source, tail = 6, data[at + 13], (data[at + 11], data[at + 12]), 2
    elif mark == 0xFD:
        if at + 18 > len(data):
            return None
        head, source = 10, (data[at + 13], data[at + 14])
        # if the first flag is set, a signature of 13 bytes follows the checksum
        kind, tail = int.from_bytes(data[at + 15 : at + 18], "little"), 15 if data[at + 10] & 1 else 2
    else:
        return None
    length = 8 + head + size + tail
    if at + length > len(data):
        return None
    begin = at + 8 + head
    if kind in _EXTRA:
        written = int.from_bytes(data[begin + size : begin + size + 2], "little")
        if _crc(data[at + 9 : begin + size] + bytes([_EXTRA[kind]])) != written:
            return None
    return length, kind, source, data[begin : begin + size]


# Number, system and component, time [s], and values of a message.
_Message = tuple[int, tuple[int, int], float, tuple[float, ...]]


def sniff(head: bytes) -> bool:
    """Check whether the first three packets follow each other without a gap."""
    at = 0
    for _ in range(3):
        packet = _packet(head, at)
        if packet is None:
            return False
        at += packet[0]
        if at == len(head):
            break
    return at > 0


def read(data: bytes, options: ReadOptions) -> ReadResult:
    """Return the telemetry ``vehicle``, or one stream per vehicle."""
    messages: dict[int, list[_Message]] = {kind: [] for kind in _EXTRA}
    damaged: list[RejectedLine] = []
    count, at = 0, 0
    while at < len(data):
        packet = _packet(data, at)
        if packet is None:
            begin = at
            while at < len(data) and _packet(data, at) is None:
                at = _next_mark(data, at)
            reason = f"{at - begin} bytes at {begin} that are not a packet"
            damaged.append(RejectedLine(count + len(damaged) + 1, reason, ""))
            continue
        length, kind, source, payload = packet
        if kind in _EXTRA:
            layout = _LAYOUT[kind]
            values = layout.unpack(payload[: layout.size].ljust(layout.size, b"\0"))  # trailing zeros are not sent
            time_s = int.from_bytes(data[at : at + 8], "big") / 1e6
            messages[kind].append((count + len(damaged), source, time_s, values))
        count += 1
        at += length
    systems = sorted({item[1][0] for item in messages[_POSITION]})
    flights = [_flight(messages, system, f"vehicle_{system}" if len(systems) > 1 else "vehicle") for system in systems]
    return _autopilot.result("mavlink_tlog", options, flights or [_flight(messages, 0, "vehicle")], count, damaged)


def _next_mark(data: bytes, at: int) -> int:
    """Return the next position at which a packet can begin, eight bytes before a start mark."""
    places = [place for mark in (b"\xfe", b"\xfd") if (place := data.find(mark, at + 9)) >= 0]
    return min(places) - 8 if places else len(data)


def _flight(messages: dict[int, list[_Message]], system: int, name: str) -> _autopilot.Flight:
    """Return the messages of a vehicle, from the component that sends its positions if possible."""
    sources = [item[1] for item in messages[_POSITION] if item[1][0] == system]
    autopilot = max(set(sources), key=sources.count) if sources else (system, 1)
    series: dict[int, _autopilot.Series] = {}
    for kind in _EXTRA:
        rows = [item for item in messages[kind] if item[1] == autopilot]
        rows = rows or [item for item in messages[kind] if item[1][0] == system and item[1][1] not in _NO_AUTOPILOT]
        table = np.array([row[3] for row in rows], dtype=np.float64).reshape(len(rows), len(_FIELDS[kind]))
        fields = dict(zip(_FIELDS[kind], table.T, strict=True))
        columns = dictionary.record_columns(fields, integers=fields, of=("time_boot_ms",))
        series[kind] = _autopilot.Series(
            np.array([row[2] for row in rows]), np.array([row[0] for row in rows], dtype=np.int64), columns
        )
    position = series[_POSITION]
    return _autopilot.Flight(
        position=position, attitude=series[_ATTITUDE], velocity=position, fix=series[_GPS], utc_minus_clock_s=0.0,
        source="MAVLink telemetry log", name=name, system=system, battery=series[_STATUS],
    )  # fmt: skip


# MAV_COMPONENT: cameras, gimbals and other components with their own axes.
_NO_AUTOPILOT = {*range(100, 106), 154, *range(171, 176)}


READER = Reader(
    name="mavlink_tlog", title="MAVLink telemetry log of a ground station (.tlog)", kinds=("telemetry",),
    sample="binary: GLOBAL_POSITION_INT, ATTITUDE, GPS_RAW_INT", sniff=sniff, read=read,
)  # fmt: skip
