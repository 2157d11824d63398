"""Position solutions of RTKLIB (``.pos``): latitude, longitude and height, or earth-centred coordinates.

The last comment line (``%``) names the columns; its first name is the time scale, GPST, UTC or JST, and times are a
date with a clock, or GPS weeks with seconds. The fix is that of MAVLink: 3 single, 4 differential, 5 and 6 RTK, 8 PPP.
"""

from __future__ import annotations

import re

import numpy as np

from aerpaw_cmp.common.errors import InputError
from aerpaw_cmp.logs.readers import Reader, ReadOptions
from aerpaw_cmp.logs.records import ReadResult
from aerpaw_cmp.logs.text import lines as _lines

from . import _pose, _sheet, _stamps

_HEADER = re.compile(rb"(?m)^%\s{0,8}(GPST|UTC|JST)[\s,]{1,40}((?:latitude|x-ecef|e-baseline)\(.{0,400})")
_SCALE_S = {"GPST": _stamps.LEAP_S, "UTC": 0, "JST": 9 * 3600}
_FIX = {"1": "6", "2": "5", "3": "3", "4": "4", "5": "3", "6": "8"}


def sniff(head: bytes) -> bool:
    """Check whether a comment names the columns of a solution."""
    return _HEADER.search(head) is not None


def _utc(day: str, clock: str, scale_s: int) -> str:
    """Return a date and a clock, or a GPS week and its second, as UTC; an empty text if they are neither."""
    if not re.fullmatch(r"\d{4}(?:/\d\d/\d\d)? [\d:.]{1,16}", f"{day} {clock}"):
        return ""
    try:
        if "/" in day:
            time = np.datetime64(f"{day.replace('/', '-')}T{clock}", "us")
        else:
            time = np.datetime64("1980-01-06", "us") + round((int(day) * 604_800 + float(clock)) * 1e6)
        return f"{time - np.timedelta64(scale_s, 's')}Z"
    except ValueError:
        return ""


def read(data: bytes, options: ReadOptions) -> ReadResult:
    """Return the telemetry ``vehicle``.

    Raises
    ------
    InputError
        If the solution is earth-centred or a baseline from a base station.
    """
    lines, rejected, readings = _lines.split(data), [], []
    header = _HEADER.search(data)
    if header is None:
        return _sheet.nothing(data, READER.name, "no comment that names the columns of a solution")
    if not header[2].startswith(b"latitude"):
        raise InputError(
            f"an RTKLIB solution with {header[2].split()[0].decode()} in place of latitude",
            expected="latitude, longitude and height",
            cause="the option out-solformat: solve again with 'llh'",
        )
    scale_s, wide = _SCALE_S[header[1].decode()], 3 if b"d'" in header[2] else 1
    height = "height ellipsoid" if b"ellipsoid" in data[: header.start()] else "altitude msl"
    for i in np.flatnonzero(~lines.blank).tolist():
        line = lines.raw(i)
        if line.startswith(b"%"):
            continue
        fields = line.replace(b",", b" ").decode("ascii", "replace").split()
        time = _utc(*fields[:2], scale_s) if len(fields) > 4 + 2 * wide else ""
        if not time:
            rejected.append(lines.reject(i, "not 'date time latitude longitude height Q ns' (cut?)"))
            continue
        place = [" ".join(fields[at : at + wide]) for at in (2, 2 + wide)]
        above, quality, satellites = fields[2 + 2 * wide : 5 + 2 * wide]
        cells = {"latitude": place[0], "longitude": place[1], height: above, "satellites": satellites}
        readings.append((i, {"time": time, **cells, "fix": _FIX.get(quality, "")}))
    return _pose.of_readings(lines, readings, rejected, options, reader=READER.name)


READER = Reader(
    name="rtklib_pos", title="RTKLIB position solution (.pos)", kinds=("telemetry",),
    sample="2025/06/10 14:00:18.000   35.728000000  -78.696000000   110.0000   1  12", sniff=sniff, read=read,
)  # fmt: skip
