"""Position solutions of RTKLIB (``.pos``): latitude, longitude and height.

A comment line (``%``) names the columns. The first name is the time scale: GPST, UTC or JST. Times are a date with a
clock, or a GPS week with its second. The fix has MAVLink's numbers: 3 single, 4 differential, 5 and 6 RTK, 8 PPP.
"""

from __future__ import annotations

import re

import numpy as np

from aerpaw_cmp.readers import InputError, Reader, ReadOptions, ReadResult, split

from . import _pose

_HEADER = re.compile(rb"(?m)^%\s{0,8}(GPST|UTC|JST)[\s,]{1,40}((?:latitude|x-ecef|e-baseline)\([^)\n]{1,9}\))")
_N = r"[\s,]+(-?\d{1,9}\.\d{1,12})"
# Day or GPS week, clock or second of the week, latitude, longitude, height, quality, satellites.
_CLOCK = r"[\s,]+(\d\d:\d\d:\d\d(?:\.\d{1,9})?|\d{1,6}\.?\d{0,9})"
_ROW = re.compile(r"\s*(\d{4}(?:/\d\d/\d\d)?)" + _CLOCK + 3 * _N + r"[\s,]+(\d)[\s,]+(\d{1,3})\b.*")
_FIX = dict(zip("0123456", "0653438", strict=True))


def sniff(head: bytes) -> bool:
    """Check whether a comment names the columns of a solution."""
    return head.startswith(b"%") and _HEADER.search(head) is not None


def read(data: bytes, options: ReadOptions) -> ReadResult:
    """Return the telemetry ``vehicle``.

    Raises
    ------
    InputError
        If the solution has no latitude in degrees.
    """
    lines, rejected, readings, header = split(data), [], [], _HEADER.search(data)
    if header is not None and header[2] != b"latitude(deg)":
        raise InputError(
            f"an RTKLIB solution of {ascii(header[2])[2:-1]}", expected="latitude and longitude in degrees",
            cause="another out-solformat: solve again with 'llh' and out-degform 'deg'",
        )  # fmt: skip
    scale = header[1].decode() if header is not None else "UTC"
    above_sea = header is not None and b"geodetic" in data[: header.start()]  # else above the ellipsoid
    names = ("latitude", "longitude", "altitude msl" if above_sea else "height hae", "fix", "satellites")
    for i in np.flatnonzero(~lines.blank).tolist():
        found = _ROW.fullmatch(lines.text(i))
        if found is not None:
            times = {f"time ({scale})": f"{found[1]} {found[2]}"}
            times = times if "/" in found[1] else {"gps week": found[1], "gps seconds": found[2]}
            cells = (*found.group(3, 4, 5), _FIX.get(found[6], ""), found[7])
            readings.append((i, times | dict(zip(names, cells, strict=True))))
        elif not lines.raw(i).startswith(b"%"):
            rejected.append(lines.reject(i, "not 'date time latitude longitude height Q ns' (truncated?)"))
    return _pose.of_readings(lines, readings, rejected, options, reader=READER.name)


READER = Reader(
    name="rtklib_pos", title="RTKLIB position solution (.pos)", kinds=("telemetry",),
    sample="2025/06/10 14:00:18.000   35.728000000  -78.696000000   110.0000   1  12", sniff=sniff, read=read,
)  # fmt: skip
