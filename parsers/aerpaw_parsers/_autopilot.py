"""One pose from the messages of any autopilot.

Positions stand at their own times; attitude and velocity are those of the nearest message.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from aerpaw_cmp.common.units import AnyArray, FloatArray, IntArray
from aerpaw_cmp.logs import clocks as _time
from aerpaw_cmp.logs import lines as _lines
from aerpaw_cmp.logs import rows as _rows
from aerpaw_cmp.logs.readers import ReadOptions
from aerpaw_cmp.logs.records import ReadResult, RejectedLine

# An attitude farther in time than this from a position is not that of the position.
_NEAR_S = 0.5
# GPS week 0 as UTC seconds of 1970, leap seconds since 2017 taken off.
_GPS_EPOCH_S = 315_964_800 - 18


@dataclass
class Series:
    """Messages of one kind: ``time_s`` of the autopilot (n,), their 0-based numbers, and columns (n,)."""

    time_s: FloatArray
    number: IntArray
    columns: dict[str, FloatArray] = field(default_factory=dict)

    def near(self, name: str, time_s: FloatArray) -> FloatArray:
        """A column at other times: that of the nearest message, NaN where none is near."""
        if not len(self.time_s) or name not in self.columns:
            return np.full(len(time_s), np.nan)
        after = np.clip(np.searchsorted(self.time_s, time_s), 0, len(self.time_s) - 1)
        before = np.maximum(after - 1, 0)
        before_is_nearer = np.abs(self.time_s[before] - time_s) <= np.abs(self.time_s[after] - time_s)
        best = np.where(before_is_nearer, before, after)
        return np.where(np.abs(self.time_s[best] - time_s) <= _NEAR_S, self.columns[name][best], np.nan)


# Autopilots count seconds since 1970 or since they were switched on; more is damage, and no room for it in ns.
_MOST_S = 4e9

NONE = Series(np.zeros(0), np.zeros(0, dtype=np.int64))


def gps_utc_s(week: FloatArray, milliseconds: FloatArray) -> FloatArray:
    """GPS week and milliseconds of the week as seconds of UTC."""
    return np.asarray(_GPS_EPOCH_S + week * 604_800.0 + milliseconds / 1e3)


def offset_s(utc_s: FloatArray, time_s: FloatArray) -> float | None:
    """UTC minus the autopilot's clock; None where no message carries both."""
    known = (utc_s > 1e9) & (utc_s < _MOST_S) & (np.abs(time_s) < _MOST_S)
    return float(np.median(utc_s[known] - time_s[known])) if known.any() else None


@dataclass
class Flight:
    """Content of a log of an autopilot.

    Parameters
    ----------
    position : Series
        Columns ``latitude_deg longitude_deg altitude_m``, or none at all.
    attitude : Series
        ``roll_deg pitch_deg yaw_deg``.
    velocity : Series
        ``velocity_north_mps`` and so on.
    fix : Series
        ``fix satellites``.
    utc_minus_clock_s : float or None
        See :func:`offset_s`.
    messages : int
        Sound messages; each of ``damaged`` comes on top.
    damaged : list of RejectedLine
    source : str
        The program, for people.
    """

    position: Series
    attitude: Series
    velocity: Series
    fix: Series
    utc_minus_clock_s: float | None
    messages: int
    damaged: list[RejectedLine]
    source: str


def result(reader: str, options: ReadOptions, flight: Flight) -> ReadResult:
    """Telemetry stream ``vehicle``; the lines of the account are messages, all but positions count as comments."""
    zero_ns, offset = _time.origin_ns(options, needed_by=reader), flight.utc_minus_clock_s
    if offset is not None:
        zero_ns = round(offset * 1e6) * 1000  # autopilots count microseconds
    time_s, number = flight.position.time_s, flight.position.number
    timed = np.abs(time_s) < _MOST_S
    rejected = [*flight.damaged, *(RejectedLine(int(i) + 1, _rows.NO_TIME, "") for i in number[~timed])]
    time_s, number = time_s[timed], number[timed]
    lines = flight.messages + len(flight.damaged)
    rows = _rows.Rows(
        reader=reader,
        options=options,
        lines=lines,
        row=number,
        time=(np.round(time_s * 1e6).astype(np.int64) * 1000 + (zero_ns or 0)).astype("datetime64[ns]"),
        flag=_lines.flags(len(number)),
        blank=lines - len(number) - len(rejected),
        rejected=rejected,
        relative=zero_ns is None,
    )
    if not len(rows):
        return rows.result([])
    rows.warnings += ["no message carries UTC: " + _rows.RELATIVE] if rows.relative else []
    values: dict[str, AnyArray] = {name: column[timed] for name, column in flight.position.columns.items()}
    lost = (np.abs(values["latitude_deg"]) < 1e-6) & (np.abs(values["longitude_deg"]) < 1e-6)
    rows.mark(lost, "no_fix")
    for name in ("latitude_deg", "longitude_deg", "altitude_m"):
        values[name] = np.where(lost, np.nan, values[name])
    for name in ("roll_deg", "pitch_deg", "yaw_deg"):
        values[name] = flight.attitude.near(name, time_s)
    for name in ("velocity_north_mps", "velocity_east_mps", "velocity_down_mps"):
        values[name] = flight.velocity.near(name, time_s)
    for name in ("fix", "satellites"):
        values[name] = np.nan_to_num(flight.fix.near(name, time_s), nan=-1).clip(-1, 255).astype(np.int64)
    return rows.result([rows.stream("telemetry", "vehicle", values, source=flight.source)])
