"""Synthetic logs of autopilots, written message by message from their formats' descriptions."""

import math
import struct

# 2025-03-02 15:00:00.250 UTC.
START_US = 1_740_927_600_250_000
COUNT = 5


VOLTS = (12.587, 12.193, 12.242)  # voltages of ArduPilot's simulated battery on the ground and in the air


def dataflash(count: int = COUNT, fix: int = 4, satellites: int = 14, *, radio: bool = False) -> bytes:
    """Return an ArduPilot .bin with POS, ATT, GPS, XKF1, BAT and RAD at 1 Hz. Its clock counts from power-on."""
    forms = {
        129: ("POS", "QLLfff", "TimeUS,Lat,Lng,Alt,RelHomeAlt,RelOriginAlt"),
        130: ("ATT", "QccccCC", "TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw"),
        131: ("GPS", "QBBIHBcLLeffffB", "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ,Yaw,U"),
        132: ("XKF1", "QBccCfff", "TimeUS,C,Roll,Pitch,Yaw,VN,VE,VD"),
        133: ("BAT", "QBff", "TimeUS,Inst,Volt,VoltR"),
        134: ("RAD", "QBBBBBHH", "TimeUS,RSSI,RemRSSI,TxBuf,Noise,RemNoise,RxErrors,Fixed"),
    }
    codes = {"Q": "Q", "L": "i", "f": "f", "c": "h", "C": "H", "B": "B", "I": "I", "H": "H", "e": "i"}
    out = b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", 128, 89, b"FMT", b"BBnNZ", b"Type,Length,Name,Format,Columns")
    for kind, (name, form, columns) in forms.items():
        size = 3 + struct.calcsize("<" + "".join(codes[c] for c in form))
        out += b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", kind, size, name.encode(), form.encode(), columns.encode())
    week = (START_US // 10**6 - 315_964_800 + 18) // 604_800
    for i in range(count):
        now = 30_000_000 + i * 1_000_000
        of_week_ms = (START_US // 1000 + i * 1000 - (315_964_800 - 18) * 1000) - week * 604_800_000
        lat, lng = 357_300_000 + i, -787_000_000 - i
        for kind, values in (
            (129, (now, lat, lng, 90.0 + i, float(i), 0.0)),
            (130, (now, 0, 150, 0, -250, 0, 9000)),
            (131, (now, 0, fix, of_week_ms, week, satellites, 90, lat, lng, 9000, 1.0, 2.0, 0.0, 0.0, 1)),
            (132, (now, 0, 150, -250, 9000, 1.5, 2.5, -0.5)),
            (132, (now, 1, 150, -250, 9000, 9.5, 9.5, 9.5)),
            (133, (now, 0, VOLTS[i % 3], 0.0)),
            (133, (now, 1, 5.0, 0.0)),
            *([(134, (now + 200_000, 133 - i, 255 if i == 2 else 152, 100, 38, 57, 0, 0))] if radio else []),
        ):
            out += b"\xa3\x95" + bytes([kind]) + struct.pack("<" + "".join(codes[c] for c in forms[kind][1]), *values)
    return out


def _x25(data: bytes) -> int:
    """CRC-16/MCRF4XX, bit by bit: another way than the reader's."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ 0x8408 if crc & 1 else crc >> 1
    return crc


def tlog(version: int = 2, system: int = 1, count: int = COUNT, fix: int = 4, satellites: int = 14) -> bytes:
    """MAVLink telemetry: GLOBAL_POSITION_INT, ATTITUDE, GPS_RAW_INT, SYS_STATUS of a system, heartbeat of system 255."""
    out = b""
    for i in range(count):
        boot = 30_000 + 1000 * i
        position = struct.pack(
            "<IiiiihhhH", boot, 357_300_000 + i, -787_000_000 - i, 90_000 + 1000 * i, 1000 * i, 150, 250, -50, 9000
        )
        attitude = struct.pack("<Iffffff", boot, 0.0261799388, -0.0436332313, 1.5707963268, 0.0, 0.0, 0.0)
        gps = struct.pack(
            "<QiiiHHHHBB", boot * 1000, 357_300_000, -787_000_000, 90_000, 90, 90, 100, 0, fix, satellites
        )
        status = struct.pack("<3I2Hh6Hb", 0, 0, 0, 500, round(1000 * VOLTS[i % 3]), 1500, 0, 0, 0, 0, 0, 0, 80)
        beat = struct.pack("<IBBBBB", 0, 6, 8, 0, 0, 3)
        for kind, extra, payload, sender in (
            (33, 104, position, system),
            (30, 39, attitude, system),
            (24, 24, gps, system),
            (1, 124, status, system),
            (0, 50, beat, 255),
        ):
            if version == 2:
                payload = payload.rstrip(b"\0") or b"\0"
                body = bytes([len(payload), 0, 0, i, sender, 1]) + kind.to_bytes(3, "little") + payload
            else:
                body = bytes([len(payload), i, sender, 1, kind]) + payload
            check = _x25(body + bytes([extra])).to_bytes(2, "little")
            out += (
                (START_US + 1_000_000 * i).to_bytes(8, "big") + bytes([0xFD if version == 2 else 0xFE]) + body + check
            )
    return out


def ulog(place: str = "estimator") -> bytes:
    """Return a PX4 .ulg with position, attitude, velocity, GPS and home.

    It can also have only the receiver's position, in the form before or since 1.14.
    """
    gps = b"uint64_t timestamp;uint64_t time_utc_usec;uint8_t fix_type;uint8_t satellites_used;"
    integers, doubles = b"int32_t lat;int32_t lon;int32_t alt;", b"double latitude_deg;double longitude_deg;"
    more = {"estimator": b"", "integers": integers, "doubles": doubles + b"double altitude_msl_m;"}[place]
    forms = {
        b"vehicle_global_position": b"uint64_t timestamp;double lat;double lon;float alt;",
        b"vehicle_attitude": b"uint64_t timestamp;float[4] q;",
        b"vehicle_local_position": b"uint64_t timestamp;float vx;float vy;float vz;",
        b"vehicle_gps_position": gps + more,
        b"home_position": b"uint64_t timestamp;float alt;",
    }

    def message(kind: bytes, body: bytes) -> bytes:
        return struct.pack("<H", len(body)) + kind + body

    out = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0) + message(b"B", b"\0" * 40)
    for name, form in forms.items():
        out += message(b"F", name + b":" + form)
    for i, name in enumerate(forms):
        out += message(b"A", bytes([0]) + struct.pack("<H", i) + name)
    out += message(b"D", struct.pack("<HQf", 4, 29_000_000, 90.0))
    # roll 1.5, pitch -2.5, yaw 90 degrees as a quaternion
    half = [math.radians(angle) / 2 for angle in (1.5, -2.5, 90.0)]
    (cr, cp, cy), (sr, sp, sy) = ([f(angle) for angle in half] for f in (math.cos, math.sin))
    q = (
        cr * cp * cy + sr * sp * sy, sr * cp * cy - cr * sp * sy, cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )  # fmt: skip
    for i in range(COUNT):
        now = 30_000_000 + i * 1_000_000
        if place == "estimator":
            out += message(b"D", struct.pack("<HQddf", 0, now, 35.73 + i * 1e-7, -78.7 - i * 1e-7, 90.0 + i))
        out += message(b"D", struct.pack("<HQffff", 1, now, *q))
        out += message(b"D", struct.pack("<HQfff", 2, now, 1.5, 2.5, -0.5))
        fix = {
            "estimator": b"",
            "integers": struct.pack("<iii", 357_300_000 + i, -787_000_000 - i, 90_000 + 1000 * i),
            "doubles": struct.pack("<ddd", 35.73 + i * 1e-7, -78.7 - i * 1e-7, 90.0 + i),
        }[place]
        out += message(b"D", struct.pack("<HQQBB", 3, now, START_US + i * 1_000_000, 4, 14) + fix)
    return out
