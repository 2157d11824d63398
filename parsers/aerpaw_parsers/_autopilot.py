"""The pose of an aircraft from the messages of an autopilot.

Records have the times of positions. Attitude and velocity come from the message that is nearest in time. Heights are
above the home position at take-off, not above an earlier or later home.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from aerpaw_cmp.common.geodesy import rough_m
from aerpaw_cmp.common.units import AnyArray, BoolArray, FloatArray, IntArray
from aerpaw_cmp.logs import text as _text
from aerpaw_cmp.readers import NO_TIME, RELATIVE, ReadOptions, ReadResult, RejectedLine, Rows, Stream, counted

from . import _pose, _stamps

# Largest time between a position and the attitude that is used for it [s].
_NEAR_S = 0.5


@dataclass
class Series:
    """The messages of one kind: ``time_s`` of the autopilot (n,), 0-based numbers of the messages, and columns (n,)."""

    time_s: FloatArray
    number: IntArray
    columns: dict[str, FloatArray] = field(default_factory=dict)

    def near(self, name: str, time_s: FloatArray) -> FloatArray:
        """Return a column at other times, from the message nearest in time, NaN if there is no message nearby."""
        if not len(self.time_s) or name not in self.columns:
            return np.full(len(time_s), np.nan)
        after = np.clip(np.searchsorted(self.time_s, time_s), 0, len(self.time_s) - 1)
        before = np.maximum(after - 1, 0)
        before_is_nearer = np.abs(self.time_s[before] - time_s) <= np.abs(self.time_s[after] - time_s)
        best = np.where(before_is_nearer, before, after)
        return np.where(np.abs(self.time_s[best] - time_s) <= _NEAR_S, self.columns[name][best], np.nan)


# Latest valid time [s]. Autopilots count from 1970 or from power-on. A later time is damaged, and would overflow in ns.
_MOST_S = 4e9

NONE = Series(np.zeros(0), np.zeros(0, dtype=np.int64))


def gps_utc_s(week: FloatArray, milliseconds: FloatArray) -> FloatArray:
    """Return seconds of UTC from the GPS week and the milliseconds of the week."""
    return np.asarray(_stamps.GPS_S - _stamps.LEAP_S + week * 604_800.0 + milliseconds / 1e3)


def offset_s(utc_s: FloatArray, time_s: FloatArray) -> float | None:
    """Return UTC minus the autopilot's clock, or None if no message has both times."""
    known = (utc_s > 1e9) & (utc_s < _MOST_S) & (np.abs(time_s) < _MOST_S)
    return float(np.median(utc_s[known] - time_s[known])) if known.any() else None


@dataclass
class Flight:
    """The content of a log of an autopilot.

    Parameters
    ----------
    position : Series
        Columns ``latitude_deg longitude_deg altitude_m`` and perhaps ``above_home_m``, or no columns.
    attitude : Series
        ``roll_deg pitch_deg yaw_deg``.
    velocity : Series
        ``velocity_north_mps``, ``velocity_east_mps`` and ``velocity_down_mps``.
    fix : Series
        ``fix satellites``.
    utc_minus_clock_s : float or None
        See :func:`offset_s`.
    home : Series
        ``altitude_m`` of the home position above sea level, each time that the log contains it. If home is known,
        altitudes of positions are above sea level, else above home or above the first position.
    source : str
        Name of the program.
    name : str
        Name of the stream.
    system : int, optional
        Number of the vehicle, for logs with several vehicles.
    battery : Series
        ``battery_v``.
    """

    position: Series
    attitude: Series
    velocity: Series
    fix: Series
    utc_minus_clock_s: float | None
    source: str
    home: Series = field(default_factory=lambda: NONE)
    name: str = "vehicle"
    system: int | None = None
    battery: Series = field(default_factory=lambda: NONE)


def result(
    reader: str, options: ReadOptions, flights: list[Flight], messages: int, damaged: list[RejectedLine],
    radio: Series = NONE,
) -> ReadResult:  # fmt: skip
    """Return a telemetry stream per vehicle and the levels of its radio, with all other messages as comments.

    Parameters
    ----------
    reader : str
    options : ReadOptions
    flights : list of Flight
        One or more flights, one per vehicle.
    messages : int
        Number of intact messages, without ``damaged``.
    damaged : list of RejectedLine
    radio : Series
        ``RSSI`` and ``RemRSSI`` of the telemetry radio, in the radio's steps.
    """
    zero_ns, offset = _text.origin_ns(options, needed_by=reader), flights[0].utc_minus_clock_s
    if offset is not None:
        zero_ns = round(offset * 1e6) * 1000  # autopilots count microseconds
    series = [*(flight.position for flight in flights), radio]
    time_s = np.concatenate([item.time_s for item in series])
    number = np.concatenate([item.number for item in series])
    owner = np.repeat(np.arange(len(series)), [len(item.time_s) for item in series])
    timed = np.abs(time_s) < _MOST_S
    rejected = [*damaged, *(RejectedLine(int(i) + 1, NO_TIME, "") for i in np.sort(number[~timed]))]
    lines = messages + len(damaged)
    rows = Rows(
        reader=reader, options=options, lines=lines, row=number[timed], at=np.arange(int(timed.sum())),
        time=(np.round(time_s[timed] * 1e6).astype(np.int64) * 1000 + (zero_ns or 0)).astype("datetime64[ns]"),
        flag=_text.no_flags(int(timed.sum())), blank=lines - int(timed.sum()) - len(rejected), rejected=rejected,
        relative=zero_ns is None,
    )  # fmt: skip
    if not len(rows):
        return rows.result([])
    rows.warnings += ["no message contains UTC: " + RELATIVE] if rows.relative else []
    if len(flights) > 1:
        systems = ", ".join(str(flight.system) for flight in flights)
        rows.warnings.append(f"{len(flights)} vehicles (systems {systems}): each has a separate track")
    of = owner[timed]
    tracks = [_track(rows.part(of == i), flight, timed[owner == i]) for i, flight in enumerate(flights)]
    return rows.result([*tracks, *_radio(rows.part(of == len(flights)), radio, timed[owner == len(flights)])])


# Channel names: the level at this end of the telemetry link, and at the remote end.
_ENDS = {"RSSI": "radio", "RemRSSI": "radio_remote"}


def _radio(rows: Rows, radio: Series, timed: BoolArray) -> Iterator[Stream | None]:
    """Yield the levels at both ends of a telemetry link [dBm].

    Notes
    -----
    SiK radios report steps of 1/1.9 dB from -127 dBm (ArduPilot wiki, "SiK Telemetry Radio"); 0 and 255 are unknown.
    """
    source = "MAVLink radio status, by SiK's scale"
    for name, channel in _ENDS.items():
        steps = radio.columns.get(name, np.zeros(len(timed)))[timed]
        yield rows.stream(
            "rss", channel, {"rss_db": steps / 1.9 - 127.0}, where=(steps > 0) & (steps < 255), channel=channel,
            unit="dBm", quantity="telemetry radio RSSI", source=source,
        )  # fmt: skip


def _track(rows: Rows, flight: Flight, timed: BoolArray) -> Stream | None:
    if not len(rows):
        return None
    time_s = flight.position.time_s[timed]
    values: dict[str, AnyArray] = {name: column[timed] for name, column in flight.position.columns.items()}
    logged, above = values.pop("above_home_m", None), None
    home_m = values["altitude_m"] - (0.0 if logged is None else logged)  # before rows without a fix become NaN
    lost = (np.abs(values["latitude_deg"]) < 1e-6) & (np.abs(values["longitude_deg"]) < 1e-6)
    rows.mark(lost, "no_fix")
    for name in _pose.PLACE:
        values[name] = np.where(lost, np.nan, values[name])
    rows.warnings += _position_warning(flight, time_s, values)
    if logged is not None:
        height = np.where(lost, np.nan, logged)
        above = _pose.from_logged_heights(rows, time_s, values["altitude_m"], height, home_m, one_estimate=True)
    values["altitude_m"] = _height(rows, flight, time_s, values) if above is None else above
    heading = values.pop("yaw_deg", np.full(len(rows), np.nan))
    values |= {name: flight.attitude.near(name, time_s) for name in _pose.ANGLES}
    values["yaw_deg"] = np.where(np.isnan(values["yaw_deg"]), heading, values["yaw_deg"])
    values |= {name: flight.velocity.near(name, time_s) for name in _pose.VELOCITIES}
    if len(flight.battery.time_s):
        values["battery_v"] = flight.battery.near("battery_v", time_s)
    for name in ("fix", "satellites"):
        values[name] = np.nan_to_num(flight.fix.near(name, time_s), nan=-1).clip(-1, 255).astype(np.int64)
    return rows.stream("telemetry", flight.name, values, source=flight.source, system=flight.system)


# Distance between the positions of the autopilot's filter and of its receiver above which a position is suspicious [m]
# (the filter follows the receiver within seconds), the share of suspicious positions above which a warning is given,
# and the code of a 3-D fix.
_APART_M, _APART_SHARE, _FIX_3D = 15.0, 0.05, 3


def _position_warning(flight: Flight, time_s: FloatArray, values: dict[str, AnyArray]) -> list[str]:
    """Return a warning if the positions of the autopilot are far from the positions of its receiver."""
    fixed = flight.fix.near("fix", time_s) >= _FIX_3D
    there_n, there_e = (np.where(fixed, flight.fix.near(name, time_s), np.nan) for name in _pose.PLACE[:2])
    here_n, here_e = (values[name] for name in _pose.PLACE[:2])
    if not np.isfinite(there_n + here_n).any():
        return []
    origin = float(np.nanmedian(here_n)), float(np.nanmedian(here_e))
    apart_m = np.linalg.norm(rough_m(here_n, here_e, origin) - rough_m(there_n, there_e, origin), axis=1)
    far, both = apart_m > _APART_M, np.isfinite(apart_m).sum()
    if far.sum() <= _APART_SHARE * both:
        return []
    return [
        f"{int(far.sum())} of {counted(int(both), 'position')} are {np.median(apart_m[far]):.0f} m (median) from those "
        "of the receiver in the same log. One of the two is wrong; the autopilot's positions are used."
    ]


def _height(rows: Rows, flight: Flight, time_s: FloatArray, values: dict[str, AnyArray]) -> FloatArray:
    """Return heights above home at take-off, or above the ground at rest or the first position if home is unknown."""
    altitude: FloatArray = values["altitude_m"]
    if not np.isfinite(altitude).any():
        return altitude
    columns, unknown = flight.home.columns, np.full(len(flight.home.time_s), np.nan)
    home = np.isfinite(columns.get("altitude_m", unknown))
    if not home.any():
        rows.warnings.append("no home is known: heights count from the ground at rest or the first position")
        return _pose.above_takeoff(rows, values, "sea level", np.isnan(values["latitude_deg"]))[0]
    home_m = columns["altitude_m"][home]
    return _pose.above_home(rows, time_s, altitude, flight.home.time_s[home], home_m)
