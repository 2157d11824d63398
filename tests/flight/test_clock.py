"""Whether two clocks agree, and when that is believed."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from aerpaw_cmp.flight import replay as flight_replay
from aerpaw_cmp.flight.clock import AGREE_S, ClockChannel, HeldOutBlocks, _estimate, _near, clock_trap, judge_clock
from aerpaw_cmp.flight.lag import DRIFT_LIMIT, direction_terms, no_lag
from tests.flight.test_lag import two_ray_flight

T = np.arange(0, 400, 0.25)
LEVEL = two_ray_flight(400)


def channel(
    lag_s=0.0, *, seed=1, name="one", level=LEVEL, measured=None, terms=None, noise_db=3.0, t=T
) -> ClockChannel:
    """A channel whose radio clock shows ``lag_s`` more: the instant t was logged as t + lag."""
    heard = (LEVEL(t) if measured is None else measured) + np.random.default_rng(seed).normal(0, noise_db, len(t))
    return ClockChannel(name=name, times=t + lag_s, measured_db=heard, predictor=level, terms=terms)


@pytest.mark.parametrize("lag_s", [-7.0, -0.5, 0.5, 3.3])
def test_a_clock_that_is_off_is_found_by_both_channels_together(lag_s):
    found = judge_clock([channel(lag_s), channel(lag_s, seed=2, name="two")])
    assert found.verdict == "ok", found.reason
    assert abs(found.radio_minus_telemetry_s - lag_s) < 0.1
    assert found.ci95_s[0] - 0.05 <= lag_s <= found.ci95_s[1] + 0.05
    assert found.held_out.paired.verdict == "better" or found.held_out.improved == found.held_out.blocks
    np.testing.assert_allclose(found.correction_s(T + lag_s), lag_s, atol=0.1)  # corrected by subtracting it
    assert set(found.channels_s) == {"one", "two"}
    assert found.as_dict()["held_out"]["blocks"] == found.held_out.blocks


def test_clocks_that_agree_are_said_to_agree():
    found = judge_clock([channel(0.0), channel(0.0, seed=2, name="two")])
    assert found.verdict == "agree"
    assert abs(found.radio_minus_telemetry_s) < 0.1


def test_a_drift_is_part_of_the_correction():
    drift, t, level = 3e-3 / 60, np.arange(0, 1200, 0.5), two_ray_flight(1200)
    late = 2.0 + drift * (t - 600)
    heard = level(t) + np.random.default_rng(1).normal(0, 2, len(t))
    found = judge_clock([ClockChannel(name="a", times=t + late, measured_db=heard, predictor=level)])
    assert found.verdict == "ok", found.reason
    np.testing.assert_allclose(found.correction_s(t + late), late, atol=0.05)


class TestWhatAWrongModelFails:
    """Each check, on the fault that it is there for."""

    def test_little_is_explained(self):
        found = judge_clock([channel(2.0, noise_db=0.0, measured=LEVEL(T) + wander(T, 12.0))])
        assert found.verdict == "ambiguous"
        assert found.explained < 0.5
        assert "of the level's variance" in found.reason or "lag" in found.reason

    def test_channels_disagree(self):
        found = judge_clock([channel(0.5, noise_db=1.0), channel(3.0, seed=2, name="two", noise_db=1.0)])
        assert found.verdict == "ambiguous"
        assert "channel" in found.reason

    def test_halves_disagree(self):
        """A level that follows the model two seconds late in the first half and at once in the second."""
        heard = np.where(T < 200, LEVEL(T - 2.0), LEVEL(T))
        found = judge_clock([channel(0.0, measured=heard, noise_db=1.0)], drift=False)
        assert found.verdict == "ambiguous"
        assert "half" in found.reason

    def test_a_pattern_that_turns_with_the_uav(self):
        """Stronger when flying towards the tower than away: free space alone takes that for a late clock."""

        def distance(t):
            return 220.0 + 120.0 * np.cos(2 * np.pi * np.asarray(t) / 60.0)

        def level(t):
            return -40 * np.log10(distance(t))

        def approaching(t):
            return np.sign(np.gradient(distance(t), t))

        def terms(t):
            toward = np.where(approaching(t) < 0, 0.0, 180.0)
            return direction_terms(np.zeros(len(t)), np.zeros(len(t)), toward)[:, 6:7]

        heard = level(T) - 1.2 * approaching(T)
        alone = judge_clock([channel(measured=heard, level=level, noise_db=0.5)])
        assert abs(alone.radio_minus_telemetry_s) > AGREE_S
        checked = judge_clock([channel(measured=heard, level=level, noise_db=0.5, terms=terms)])
        assert checked.verdict == "ambiguous"
        assert "patterns" in checked.reason
        assert abs(checked.free_patterns_s) < 0.3

    def test_a_drift_at_the_edge(self):
        t, level = np.arange(0, 1200, 0.5), two_ray_flight(1200)
        late = 1.5 * DRIFT_LIMIT * (t - 600)
        heard = level(t) + np.random.default_rng(1).normal(0, 1, len(t))
        found = judge_clock([ClockChannel(name="a", times=t + late, measured_db=heard, predictor=level)])
        assert found.verdict != "ok"


def wander(t, sigma_db):
    """What no model knows, slowly changing."""
    rng = np.random.default_rng(3)
    waves = rng.uniform(0.02, 0.2, 40), rng.uniform(0, 2 * np.pi, 40)
    return sigma_db * np.sqrt(2 / 40) * np.cos(np.outer(t, waves[0]) + waves[1]).sum(axis=1)


def test_the_error_of_blocks_kept_out_must_fall():
    from aerpaw_cmp.compare.statistics import paired_difference

    rng = np.random.default_rng(0)
    small, large = rng.normal(0, 1, 600), rng.normal(0, 2, 600)
    fallen, risen = paired_difference(small, large), paired_difference(large, small)
    assert HeldOutBlocks(blocks=10, improved=9, paired=fallen).better
    assert not HeldOutBlocks(blocks=10, improved=9, paired=risen).better
    unsure = paired_difference([1.0, -1.0, 1.0], [1.1, -1.1, 1.1])
    assert HeldOutBlocks(blocks=10, improved=8, paired=unsure).better
    assert not HeldOutBlocks(blocks=10, improved=7, paired=unsure).better


def test_no_overlap_and_no_channel():
    found = judge_clock([channel(5000.0)])
    assert found.verdict == "failed"
    assert "overlap" in found.reason
    assert np.isnan(found.radio_minus_telemetry_s)
    assert found.as_dict()["radio_minus_telemetry_s"] is None
    with pytest.raises(ValueError, match="at least one"):
        judge_clock([])


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


def test_a_short_log_of_one_side_is_brought_into_a_long_one_of_the_other():
    """The overlap wanted is half of the shorter log, whichever it is."""
    hours_4, minutes_10 = (0.0, 4 * 3600.0), (5 * 3600.0, 5 * 3600.0 + 600.0)
    assert clock_trap(hours_4, minutes_10).hours > 0
    assert clock_trap(minutes_10, hours_4).hours < 0
    assert clock_trap((0.0, 3600.0), (1600.0, 6000.0)) is None, "more than half is shared"


def test_blocks_kept_out_last_a_minute_and_are_four_to_ten():
    for seconds, blocks in ((400.0, 6), (150.0, 4), (900.0, 10)):
        t, level = np.arange(0, seconds, 0.5), two_ray_flight(seconds)
        found = judge_clock([channel(2.0, level=level, measured=level(t), t=t, noise_db=1.0)])
        assert found.held_out.blocks == blocks
        assert 0 <= found.held_out.improved <= blocks


def test_the_numbers_of_the_report_are_those_of_the_estimate():
    found = judge_clock([channel(2.0), channel(2.0, seed=2, name="two")])
    shown = found.as_dict()
    assert shown["drift_ms_per_min"] == pytest.approx(found.drift_s_per_s * 1e3 * 60)
    drifts = replace(found, drift_s_per_s=1e-5, drift_ci95_s_per_s=(-2e-5, 4e-5)).as_dict()
    assert drifts["drift_ms_per_min"] == pytest.approx(0.6)
    assert drifts["drift_ci95_ms_per_min"] == pytest.approx([-1.2, 2.4])


@pytest.mark.parametrize(
    ("own_s", "verdict", "evidence_there", "near"),
    [
        (2.3, "ok", 50.0, True),  # within half a second
        (4.0, "ok", 0.0, False),  # a sharp optimum elsewhere
        (4.0, "ambiguous", 0.0, True),  # it cannot tell the two apart
        (4.0, "ambiguous", 50.0, False),  # it can
        (float("nan"), "failed", 0.0, False),
    ],
)
def test_part_of_the_evidence_agrees_where_it_is_near_or_cannot_tell(own_s, verdict, evidence_there, near):
    lags = np.arange(-6.0, 6.01, 0.25)
    evidence = np.full(len(lags), 50.0)
    evidence[np.argmin(np.abs(lags - 2.0))] = evidence_there
    part = replace(
        no_lag("made for this test", 100, 6.0, lags),
        radio_minus_telemetry_s=own_s, verdict=verdict, curve_lag_s=lags, evidence=evidence,
    )  # fmt: skip
    assert _near(part, 2.0) == near
    beside = replace(part, evidence=np.roll(evidence, 1))
    assert _near(beside, 2.0) == near, "a lag of the curve on either side counts"
    assert _near(replace(part, evidence=np.roll(evidence, -1)), 2.0) == near
    two_away = replace(part, evidence=np.roll(evidence, 2))
    assert _near(two_away, 2.0) == (own_s == 2.3)


def test_a_refined_lag_stays_inside_its_interval_and_the_window():
    """A parabola through the last tried lags peaks beyond them: 15.04 s of a window of 15 s was reported."""
    fit = no_lag("none", 0, 15.0, np.linspace(-15.0, 15.0, 31))
    beyond = replace(fit, radio_minus_telemetry_s=15.04, ci95_s=(11.6, 15.0), window_s=15.0)
    assert _estimate(beyond, 0, "model").radio_minus_telemetry_s == 15.0


def test_ratios_do_not_vote_on_the_clock_where_levels_do(monkeypatch):
    """The sounder's quality saturates: pooled with the level, it said +14.8 s for a planted lag of 5 s."""
    seen = []
    monkeypatch.setattr(
        flight_replay,
        "judge_clock",
        lambda channels, **_: seen.append([c.name for c in channels]) or SimpleNamespace(explained=0.0),
    )
    time = np.zeros(3, "datetime64[ns]")
    data = SimpleNamespace(settings=SimpleNamespace(rss=SimpleNamespace(minimum_height_m=None, lag_window_s=15.0)))
    series = [
        SimpleNamespace(tower="LW1", channel=c, unit=u, time=time, measured_db=np.zeros(3))
        for c, u in (("power", "dB re full scale"), ("quality", "dB"))
    ]
    flight_replay._estimated_clock(data, series, None)
    flight_replay._estimated_clock(data, series[1:], None)
    assert seen == [["power"], ["power"], ["quality"], ["quality"]]
