"""Whether two clocks agree, and when that is believed."""

from __future__ import annotations

import numpy as np

from aerpaw_cmp.flight.clock import clock_trap


def test_whole_hours_are_recognised():
    start = np.datetime64("2024-07-15T15:48:16", "ns")
    span = (start, start + np.timedelta64(900, "s"))
    earlier = tuple(s - np.timedelta64(4, "h") for s in span)
    trap = clock_trap(earlier, span, "America/New_York")  # EDT
    assert trap.hours == 4.0
    assert "radio times are local time" in trap.explanation
    assert clock_trap(span, earlier, "America/New_York").hours == -4.0
    assert "telemetry times are local time" in clock_trap(span, earlier, "America/New_York").explanation
    winter = tuple(s + np.timedelta64(180, "D") for s in span)
    late = tuple(s - np.timedelta64(4, "h") for s in winter)
    assert "time zone" in clock_trap(late, winter, "America/New_York").explanation  # EST is five hours
    hour = tuple(s + np.timedelta64(1, "h") for s in span)
    assert "daylight saving" in clock_trap(hour, span, "America/New_York").explanation
    assert clock_trap(span, span, "America/New_York") is None
    assert clock_trap(tuple(s + np.timedelta64(20, "m") for s in span), span) is None  # no multiple of half hours
    assert clock_trap(tuple(s + np.timedelta64(3, "D") for s in span), span) is None
    assert clock_trap(tuple(s - np.timedelta64(330, "m") for s in span), span).hours == 5.5
