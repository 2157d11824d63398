"""Conversion of records to the bytes of real AERPAW log formats for ``simulate``.

The writers are the inverse of the readers.

All functions are pure functions of arrays and do not open files. Layouts are exactly those of the tools that write the
real logs: CR LF line ends from Python's ``csv``, octal offsets and ``*`` runs from ``od``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from ..common.units import unmasked

if TYPE_CHECKING:
    import pandas as pd

# 20 log10 of the smallest normal float32: the level of the sounder without a signal.
_FLT_MIN_DB = -758.5956
# Default gain that the sounder subtracts from its levels.
_RX_GAIN_DB = 30.0


def local_text(times: ArrayLike, timezone: str, *, digits: int = 6) -> list[str]:
    """Return UTC times as naive local text ``YYYY-mm-dd HH:MM:SS.ffffff``.

    Parameters
    ----------
    times : array of datetime64
        Times in UTC.
    timezone : str
        IANA zone of the simulated clock.
    digits : int
        Number of digits of the fraction, 1 to 6. Further digits are truncated, as in ``strftime``.

    Raises
    ------
    UsageError
        If the zone is unknown.

    Examples
    --------
    >>> local_text(["2024-07-02T15:33:52.312016"], "America/New_York")
    ['2024-07-02 11:33:52.312016']
    """
    import pandas as pd

    from .text import zone

    index = pd.DatetimeIndex(np.asarray(times, dtype="datetime64[ns]"), tz="UTC")
    local = index.tz_convert(zone(timezone, needed_by="the simulated logs")).tz_localize(None).to_numpy()
    texts = np.datetime_as_string(local.astype("datetime64[us]"), unit="us")
    return [str(text)[: 20 + digits].replace("T", " ") for text in texts]


def format_vehicle_out(frame: pd.DataFrame, timezone: str) -> bytes:
    """Return telemetry as ``vehicleOut`` with 10 fields, radians in the order pitch, yaw, roll, and CR LF.

    Parameters
    ----------
    frame : pandas.DataFrame
        Telemetry records. A row without a position is written with -999 and fix 0, as the logger does.
    timezone : str
        Zone of the vehicle's clock.
    """
    nowhere = frame[["latitude_deg", "longitude_deg", "altitude_m"]].isna().any(axis=1).to_numpy()
    longitude, latitude, altitude = (
        np.where(nowhere, -999.0, frame[name].to_numpy()) for name in ("longitude_deg", "latitude_deg", "altitude_m")
    )
    angles = np.radians(frame[["pitch_deg", "yaw_deg", "roll_deg"]].fillna(0.0).to_numpy())
    angles = (angles + np.pi) % (2 * np.pi) - np.pi  # the autopilot writes yaw in -pi..pi
    # add 0.0, because -0.0 would be written with its sign
    speed = frame[["velocity_north_mps", "velocity_east_mps", "velocity_down_mps"]].fillna(0.0).to_numpy() + 0.0
    fix = np.where(nowhere, 0, np.where(frame["fix"] < 0, 3, frame["fix"]))
    # replace -1 ("unknown" in a record), because the logger always writes a number
    satellites = np.where(frame["satellites"] < 0, 12, frame["satellites"])
    columns = [column.tolist() for column in (longitude, latitude, altitude, angles, speed, fix, satellites)]
    stamps = local_text(frame["time"].to_numpy(), timezone)
    lines = [
        f'{i},{_short(lon, 7)},{_short(lat, 7)},{_short(alt, 3)},"({_tuple(angle, 17)})","({_tuple(v, 2)})",'
        f"48,{time},{f},{s}\r\n"
        for i, (time, lon, lat, alt, angle, v, f, s) in enumerate(zip(stamps, *columns, strict=True), start=1)
    ]
    return "".join(lines).encode("ascii")


def _short(value: float, places: int) -> str:
    """Return a number as DroneKit rounds it and Python prints it, with -999 as an integer."""
    return "-999" if value == -999.0 else repr(round(value, places) + 0.0)


def _tuple(values: list[float], places: int) -> str:
    return ",".join(repr(round(value, places) + 0.0) for value in values)


def format_power_log(times: ArrayLike, rss_db: ArrayLike, timezone: str) -> bytes:
    """Return levels as the sounder's ``power_log``: ``od -f -w4`` through ``ts``.

    Parameters
    ----------
    times : array of datetime64, shape (n,)
        UTC arrival times.
    rss_db : array, shape (n,)
        Levels [dB re full scale], written as float32; NaN (out of coverage) becomes the no-signal floor.
    timezone : str
        Zone of the tower's clock.

    Returns
    -------
    bytes
        The file.

    Notes
    -----
    Repeated samples are replaced by one ``*``, as ``od`` does without ``-v``.

    If the log ends inside such a run, the closing offset of od is written, because otherwise the length of the run
    would be lost.
    """
    level = unmasked(rss_db)
    # use float32 like the sounder, so that equal samples have equal digits
    level = np.where(np.isnan(level), _FLT_MIN_DB - _RX_GAIN_DB, level).astype(np.float32)
    stamps = local_text(times, timezone)
    same = np.concatenate(([False], level[1:] == level[:-1])) if len(level) else np.zeros(0, dtype=bool)
    lines = []
    for i, (stamp, value) in enumerate(zip(stamps, level, strict=True)):
        if not same[i]:
            lines.append(f"[{stamp}] {4 * i:07o}{str(value).removesuffix('.0'):>16}\n")
        elif not same[i - 1]:
            lines.append(f"[{stamp}] *\n")
    if len(level) and same[-1]:
        lines.append(f"[{stamps[-1]}] {4 * len(level):07o}\n")
    return "".join(lines).encode("ascii")


def format_ri_csv(frame: pd.DataFrame, timezone: str) -> bytes:
    """Return rank records with positions as the published six-column table ``ID,Time and date,...,NR RI``.

    Parameters
    ----------
    frame : pandas.DataFrame
        Rank records with ``latitude_deg longitude_deg altitude_m``; NaN rank is written as 0.
    timezone : str
        Zone of the logger's clock.
    """
    rank = unmasked(frame["rank"].to_numpy())
    columns = (
        local_text(frame["time"].to_numpy(), timezone, digits=3),
        *(frame[name].tolist() for name in ("longitude_deg", "latitude_deg", "altitude_m")),
        np.where(np.isnan(rank), 0, rank).astype(np.int64).tolist(),
    )
    lines = [
        f"{i + 1},{time},{_cell(lon, 7)},{_cell(lat, 7)},{_cell(alt, 3)},{ri}\r\n"
        for i, (time, lon, lat, alt, ri) in enumerate(zip(*columns, strict=True))
    ]
    return ("ID,Time and date,Longitude,Latitude,Altitude,NR RI\r\n" + "".join(lines)).encode("ascii")


def _cell(value: float, places: int) -> str:
    return "" if np.isnan(value) else repr(round(value, places))
