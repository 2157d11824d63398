"""Clocks that are off by whole hours: logs that overlap only after such a shift."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ...common.units import FloatArray
from .track import nanoseconds


@dataclass(frozen=True, slots=True)
class ClockTrap:
    """Two logs of one flight that only overlap after a shift of whole (or half) hours.

    Parameters
    ----------
    hours : float
        To be added to radio times.
    explanation : str
        What this looks like.
    """

    hours: float
    explanation: str
    is_utc: bool = False
    """UTC read as local time explains it."""

    def advice(self) -> str:
        """Cause and remedy, in words."""
        return f"{self.explanation}; try 'clock: local_as_utc', 'clock: local' or 'clock: utc' beside the log"


def clock_trap(
    radio_span: tuple[Any, Any], telemetry_span: tuple[Any, Any], timezone: str | None = None
) -> ClockTrap | None:
    """Recognise a clock that is off by whole hours, such as local time stored as if it were UTC.

    Parameters
    ----------
    radio_span, telemetry_span : (first, last)
        datetime64 (UTC) or epoch seconds.
    timezone : str, optional
        IANA zone of the site: a shift that equals its offset from UTC on that day is named so.

    Returns
    -------
    ClockTrap or None
        None if the logs overlap as they are, or if no shift of up to 14 h (in half hours) brings them together.

    Examples
    --------
    >>> trap = clock_trap((0.0, 600.0), (4 * 3600.0, 4 * 3600.0 + 620.0), "America/New_York")
    >>> trap.hours
    4.0
    """
    radio = nanoseconds(np.asarray(radio_span)) * 1e-9
    telemetry = nanoseconds(np.asarray(telemetry_span)) * 1e-9

    def overlap(hours: FloatArray) -> FloatArray:
        start = np.maximum(radio[0] + 3600.0 * hours, telemetry[0])
        return np.asarray(np.maximum(0.0, np.minimum(radio[1] + 3600.0 * hours, telemetry[1]) - start))

    # UTC-12 to UTC+14, and by halves for India and Newfoundland
    shifts = np.asarray(np.arange(-28, 29) * 0.5, dtype=np.float64)
    shared = overlap(shifts)
    now = float(overlap(np.zeros(1))[0])
    # whole hours before half hours, near ones before far ones
    order = [(-round(float(shared[i])), shifts[i] % 1 != 0, abs(float(shifts[i])), i) for i in range(len(shifts))]
    best = min(order)[-1]
    shorter = min(radio[1] - radio[0], telemetry[1] - telemetry[0])
    # the logs share most of their time as they are: their clocks agree
    if now >= 0.5 * shorter or shared[best] < max(0.5 * shorter, 1e-9):
        return None
    hours = float(shifts[best])
    explanation, is_utc = _explain_hours(hours, float(telemetry[0]), timezone)
    return ClockTrap(hours, explanation, is_utc)


def _explain_hours(hours: float, instant: float, timezone: str | None) -> tuple[str, bool]:
    if timezone is not None:
        from datetime import datetime
        from datetime import timezone as utc
        from zoneinfo import ZoneInfo

        moment = datetime.fromtimestamp(instant, utc.utc).astimezone(ZoneInfo(timezone))
        offset = moment.utcoffset()
        east = offset.total_seconds() / 3600.0 if offset else 0.0
        # hours are added to the radio: local time is behind UTC where the zone is west
        if east and hours == -east:
            return f"radio times are local time ({timezone}) stored as if they were UTC", False
        if east and hours == east:
            stored = "telemetry times are local time stored as if they were UTC"
            return f"radio times are UTC read as {timezone}, or {stored}", True
        if abs(hours) == 1.0:
            return "one hour: daylight saving taken into account in one log only", False
    return f"the clocks differ by {hours:+g} h: a time zone was taken into account in one log only", False
