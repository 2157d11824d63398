"""Clocks that are off by whole hours."""

import numpy as np
import pytest

from aerpaw_cmp.flight.clock import clock_trap

HOUR = 3600.0


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
    assert "is the wrong zone" in clock_trap(late, winter, "America/New_York").explanation  # EST is five hours
    hour = tuple(s + np.timedelta64(1, "h") for s in span)
    assert "daylight saving" in clock_trap(hour, span, "America/New_York").explanation
    assert clock_trap(span, span, "America/New_York") is None
    assert clock_trap(tuple(s + np.timedelta64(20, "m") for s in span), span) is None  # no multiple of half hours
    assert clock_trap(tuple(s + np.timedelta64(3, "D") for s in span), span) is None
    assert clock_trap(tuple(s - np.timedelta64(330, "m") for s in span), span).hours == 5.5


def test_a_short_log_of_one_side_is_brought_into_a_long_one_of_the_other():
    """The overlap wanted is half of the shorter log, whichever it is."""
    hours_4, minutes_10 = (0.0, 4 * 3600.0), (5 * 3600.0, 5 * 3600.0 + 600.0)
    assert clock_trap(hours_4, minutes_10).hours > 0
    assert clock_trap(minutes_10, hours_4).hours < 0
    assert clock_trap((0.0, 3600.0), (1600.0, 6000.0)) is None, "more than half is shared"


@pytest.mark.parametrize(
    ("radio", "telemetry", "hours"),
    [
        ((0.0, 600.0), (14 * HOUR, 14 * HOUR + 600.0), 14.0),
        ((0.0, 600.0), (14.5 * HOUR, 14.5 * HOUR + 600.0), None),
        ((0.0, 600.0), (-14 * HOUR, -14 * HOUR + 600.0), -14.0),
        ((0.0, 600.0), (5.5 * HOUR, 5.5 * HOUR + 600.0), 5.5),
        ((0.0, 600.0), (HOUR + 301.0, HOUR + 1000.0), None),  # less than half of the shorter is shared
        ((0.0, 600.0), (HOUR + 299.0, HOUR + 1000.0), 1.0),
        ((0.0, 600.0), (301.0, 1000.0), None),  # half is not shared, and no shift is better
        ((0.0, 600.0), (299.0, 1000.0), None),
        ((0.0, 2.25 * HOUR), (2 * HOUR, 4.25 * HOUR), 2.0),  # 0.25 h are shared as they are
        ((0.0, 10 * HOUR), (10.75 * HOUR, 12.25 * HOUR), 3.0),  # 2.5 h bring as much: whole hours go first
        ((0.0, 10 * HOUR), (10.0 * HOUR, 10.4 * HOUR), 1.0),  # 0.5 h would do, too
        ((0.0, 0.0), (HOUR, HOUR), None),
        ((0.0, 1.0), (HOUR + 0.4, HOUR + 5.0), 1.0),  # a log of a second
        ((0.0, 1.0), (HOUR + 0.6, HOUR + 5.0), None),
    ],
)
def test_a_shift_of_hours_is_the_nearest_whole_one_that_brings_most_together(radio, telemetry, hours):
    trap = clock_trap(radio, telemetry)
    assert (None if trap is None else trap.hours) == hours
    if trap is not None:
        moved = [t + trap.hours * HOUR for t in radio]
        shorter = min(radio[1] - radio[0], telemetry[1] - telemetry[0])
        assert min(moved[1], telemetry[1]) - max(moved[0], telemetry[0]) >= 0.5 * shorter
        assert max(0.0, min(radio[1], telemetry[1]) - max(radio[0], telemetry[0])) < 0.5 * shorter


def test_the_offset_of_the_zone_on_that_day_names_the_mistake():
    noon = 1_721_060_000.0  # 15 July 2024, 16:13 UTC: EDT is four hours
    span = (noon, noon + 600.0)
    early, late = ((noon + k * 4 * HOUR, noon + k * 4 * HOUR + 600.0) for k in (-1, 1))
    assert "radio times are local time (America/New_York)" in clock_trap(early, span, "America/New_York").explanation
    assert "telemetry times are local time" in clock_trap(late, span, "America/New_York").explanation
    hour = (noon + HOUR, noon + HOUR + 600.0)
    assert "daylight saving" in clock_trap(hour, span, "America/New_York").explanation
    assert (
        clock_trap(hour, span).explanation
        == "the clocks differ by -1 h: a time zone was taken into account in one log only"
    )


def test_a_zone_without_an_offset_is_no_reason_for_hours():
    noon = 1_721_060_000.0
    span = (noon, noon + 600.0)
    for zone in ("UTC", "Africa/Abidjan"):
        for late in (-HOUR, HOUR):
            trap = clock_trap((noon + late, noon + late + 600.0), span, zone)
            assert "radio times are" not in trap.explanation
            assert trap.explanation.endswith("or daylight saving was taken into account in one log only")


@pytest.mark.parametrize(("named", "offset_h", "saving"), [("America/Chicago", -5, True), ("Europe/Berlin", 2, False)])
def test_a_wrong_zone_is_named_with_the_zone_that_fits(named, offset_h, saving):
    """The radio log has local times of New York in summer (UTC-4), the telemetry has UTC."""
    noon = 1_721_060_000.0
    read = noon + (-4 - offset_h) * HOUR
    trap = clock_trap((read, read + 600.0), (noon, noon + 600.0), named)
    assert f"{named} (UTC{offset_h:+d}) is the wrong zone (UTC-4 fits the radio times" in trap.explanation
    assert ("daylight saving" in trap.explanation) == saving
    assert "timezone: ZONE" in trap.advice()
