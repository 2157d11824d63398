"""Poses at any instant."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from aerpaw_cmp.common.geodesy import SiteFrame
from aerpaw_cmp.flight.track import Track, body_rotation, clock_trap, combine_lags, direction_terms, estimate_lag
from aerpaw_cmp.propagation.arrays import rotation_from_aircraft

FRAME = SiteFrame(35.7275, -78.6960)
START = np.datetime64("2024-07-15T15:48:16", "ns")


def telemetry(seconds, east, north, up, **columns) -> pd.DataFrame:
    seconds = np.asarray(seconds, dtype=float)
    latitude, longitude = FRAME.to_geographic(
        np.broadcast_to(east, seconds.shape), np.broadcast_to(north, seconds.shape)
    )
    data = {
        "time": START + (seconds * 1e9).astype("timedelta64[ns]"),
        "line": np.arange(len(seconds)) + 1,
        "flag": "",
        "latitude_deg": latitude,
        "longitude_deg": longitude,
        "altitude_m": np.broadcast_to(up, seconds.shape).astype(float),
        "fix": 3,
        "satellites": 12,
    }
    for name in ("roll_deg", "pitch_deg", "yaw_deg", "velocity_north_mps", "velocity_east_mps", "velocity_down_mps"):
        data[name] = np.broadcast_to(np.asarray(columns.get(name, np.nan), dtype=float), seconds.shape)
    return pd.DataFrame(data)


def at(seconds) -> np.ndarray:
    return START + (np.asarray(seconds, dtype=float) * 1e9).astype("timedelta64[ns]")


def test_straight_flight_is_interpolated_exactly():
    t = np.arange(0.0, 20.0, 1.0)
    track = Track(telemetry(t, 5 * t, -3 * t, 10 + t, roll_deg=0, pitch_deg=0, yaw_deg=30.0), FRAME)
    asked = np.array([0.0, 0.25, 7.77, 19.0])
    poses = track.pose_at(at(asked))
    assert poses.valid.all()
    np.testing.assert_allclose(poses.position_m, np.column_stack([5 * asked, -3 * asked, 10 + asked]), atol=1e-4)
    np.testing.assert_allclose(poses.velocity_mps, [[5, -3, 1]] * 4, atol=1e-4)


def test_body_rotation_is_the_replay_convention():
    roll, pitch, yaw = np.random.default_rng(5).uniform(-180, 180, (3, 200))
    np.testing.assert_allclose(body_rotation(roll, pitch, yaw), rotation_from_aircraft(roll, pitch, yaw), atol=1e-14)


def test_attitude_goes_the_short_way_round_north():
    track = Track(telemetry([0, 1], 0, 0, 10, roll_deg=2.0, pitch_deg=-1.0, yaw_deg=[350.0, 10.0]), FRAME)
    np.testing.assert_allclose(track.pose_at(at([0.5])).heading_deg % 360, [0.0], atol=0.05)
    # and at the stamps it is the logged attitude
    np.testing.assert_allclose(
        track.pose_at(at([0, 1])).rotation, rotation_from_aircraft([2, 2], [-1, -1], [350, 10]), atol=1e-12
    )


def test_gaps_are_not_bridged():
    track = Track(telemetry([0, 1, 2, 9, 10], 0, 0, 10, roll_deg=1, pitch_deg=0, yaw_deg=0), FRAME, maximum_gap_s=3)
    poses = track.pose_at(at([-0.1, 0, 2, 2.01, 8.99, 9, 10, 10.5]))
    assert poses.valid.tolist() == [False, True, True, False, False, True, True, False]
    assert poses.reason.tolist() == [
        "before telemetry",
        "",
        "",
        "telemetry gap",
        "telemetry gap",
        "",
        "",
        "after telemetry",
    ]
    assert np.isnan(poses.position_m[3]).all()
    assert np.isnan(poses.rotation[3]).all()
    assert track.account.gaps == 1
    assert track.account.longest_gap_s == 7.0


def test_low_poses_are_raised_to_half_a_metre():
    track = Track(telemetry([0, 1, 2], 0, 0, [-3.9, 0.2, 0.8], roll_deg=1, pitch_deg=0, yaw_deg=0), FRAME)
    poses = track.pose_at(at([0, 1, 1.9]))
    np.testing.assert_allclose(poses.position_m[:, 2], [0.5, 0.5, 0.74])
    assert poses.raised.tolist() == [True, True, False]


# --- rows that lie ---


def test_bad_positions_are_left_out_and_counted():
    frame = telemetry(np.arange(8.0), 3.0 * np.arange(8), 0, 10, roll_deg=1, pitch_deg=0, yaw_deg=0)
    frame.loc[1, ["latitude_deg", "longitude_deg", "altitude_m"]] = -999.0
    frame.loc[2, "latitude_deg"] = np.nan
    frame.loc[3, ["latitude_deg", "longitude_deg"]] = 0.0
    frame.loc[6, "longitude_deg"] = -999.0
    track = Track(frame, FRAME, maximum_gap_s=5.0)
    assert track.account.bad_position == 4
    poses = track.pose_at(at([0.5, 2, 6]))
    np.testing.assert_allclose(poses.position_m[:, 0], [1.5, 6, 18], atol=1e-4)
    # with the usual limit, the hole is not bridged
    assert Track(frame, FRAME).pose_at(at([2])).reason.tolist() == ["telemetry gap"]
    assert any("without a position" in text for text in track.account.warnings)


def test_duplicate_and_backward_stamps():
    seconds = np.array([0, 1, 1, 2, 1.5, 3, 4])
    track = Track(telemetry(seconds, seconds, 0, 10, roll_deg=1, pitch_deg=0, yaw_deg=0), FRAME)
    assert len(track) == 5
    assert (track.account.duplicate_time, track.account.backward_time) == (1, 1)
    np.testing.assert_allclose(track.pose_at(at([2.5])).position_m[:, 0], [2.5], atol=1e-4)
    # one wild stamp in the future condemns itself, not the rows after it
    seconds = np.array([0, 1, 900, 2, 3, 4.0])
    track = Track(telemetry(seconds, [0, 1, 2, 2, 3, 4], 0, 10, roll_deg=1, pitch_deg=0, yaw_deg=0), FRAME)
    assert len(track) == 5
    assert track.account.backward_time == 1
    assert track.end_ns - track.start_ns == 4_000_000_000


def test_a_daylight_saving_change_in_flight_is_named():
    local = np.arange(0, 600.0)
    fell_back = np.where(local >= 200, local - 3600.0, local)  # clocks go back an hour in flight
    track = Track(telemetry(fell_back, local, 0, 10, roll_deg=1, pitch_deg=0, yaw_deg=0), FRAME)
    assert track.account.hour_steps == 1
    assert len(track) == 400  # the longer part is kept, nothing is mixed up
    assert any("daylight-saving" in text for text in track.account.warnings)
    sprang_forward = np.where(local >= 200, local + 3600.0, local)
    track = Track(telemetry(sprang_forward, local, 0, 10, roll_deg=1, pitch_deg=0, yaw_deg=0), FRAME)
    assert track.account.hour_steps == 1
    assert track.pose_at(at([1000.0])).reason.tolist() == ["telemetry gap"]
    assert Track(telemetry(local, local, 0, 10), FRAME).account.hour_steps == 0


def test_missing_times():
    frame = telemetry(np.arange(5.0), 0, 0, 10)
    frame.loc[2, "time"] = pd.NaT
    track = Track(frame, FRAME)
    assert track.account.no_time == 1
    poses = track.pose_at(np.array(["NaT", "2024-07-15T15:48:17"], dtype="datetime64[ns]"))
    assert poses.reason.tolist() == ["no time", ""]


def test_no_row_at_all_and_a_single_one():
    empty = Track(telemetry([], 0, 0, 10), FRAME)
    poses = empty.pose_at(at([0, 1]))
    assert poses.reason.tolist() == ["no telemetry"] * 2
    assert not poses.valid.any()
    single = Track(telemetry([5.0], 1.0, 2.0, 30.0, roll_deg=1, pitch_deg=0, yaw_deg=90), FRAME)
    poses = single.pose_at(at([4.9, 5.0, 5.1]))
    assert poses.valid.tolist() == [False, True, False]
    np.testing.assert_allclose(poses.position_m[1], [1, 2, 30], atol=1e-4)
    assert poses.heading_deg[1] == pytest.approx(90)
    assert len(single.pose_at(at([]))) == 0


def test_asked_instants_come_in_any_order_and_kind():
    t = np.arange(0.0, 10.0)
    track = Track(telemetry(t, 2 * t, 0, 10, roll_deg=1, pitch_deg=0, yaw_deg=0), FRAME)
    stamps = at([7.5, 0.5, 3.25])
    expected = [15, 1, 6.5]
    for asked in (stamps, stamps.astype("datetime64[ms]"), pd.Series(stamps), stamps.astype(np.int64) * 1e-9,
                  np.array([pd.Timestamp(s, tz="UTC") for s in stamps], dtype=object)):  # fmt: skip
        np.testing.assert_allclose(track.pose_at(asked).position_m[:, 0], expected, atol=1e-3)


# --- attitude ---


def test_slerp_turns_at_constant_rate():
    track = Track(telemetry([0, 2], 0, 0, 10, roll_deg=[0, 40.0], pitch_deg=0, yaw_deg=[20.0, 20.0]), FRAME)
    rotation = track.pose_at(at([0.5])).rotation[0]
    np.testing.assert_allclose(rotation, rotation_from_aircraft(10.0, 0.0, 20.0), atol=1e-12)
    # any attitude: halfway is the same turn from both ends
    rng = np.random.default_rng(0)
    roll, pitch, yaw = rng.uniform(-60, 60, (3, 2))
    track = Track(telemetry([0, 1], 0, 0, 10, roll_deg=roll, pitch_deg=pitch, yaw_deg=yaw), FRAME)
    first, half, last = track.pose_at(at([0, 0.5, 1])).rotation
    np.testing.assert_allclose(first.T @ half, half.T @ last, atol=1e-12)
    np.testing.assert_allclose(half @ half.T, np.eye(3), atol=1e-12)


@pytest.mark.parametrize("attitude", [np.nan, 0.0])
def test_unknown_attitude_is_level_flight_along_the_course(attitude):
    t = np.arange(0.0, 30.0)
    frame = telemetry(t, 4 * t, 3 * t, 10, roll_deg=attitude, pitch_deg=attitude, yaw_deg=attitude)
    track = Track(frame, FRAME)
    poses = track.pose_at(at([10.5]))
    assert not poses.attitude_known.any()
    np.testing.assert_allclose(poses.rotation[0], rotation_from_aircraft(0, 0, np.degrees(np.arctan2(4, 3))), atol=1e-4)
    assert track.account.unknown_attitude == 30
    # hovering says nothing about the heading: the last course holds
    hover = telemetry(t, np.minimum(4 * t, 40), 0, 10)
    assert Track(hover, FRAME).pose_at(at([25])).heading_deg[0] == pytest.approx(90, abs=0.1)


def test_logged_velocity_is_used_where_it_exists():
    t = np.arange(0.0, 10.0)
    speed = {"velocity_north_mps": 0.0, "velocity_east_mps": -5.0, "velocity_down_mps": 1.0}
    poses = Track(telemetry(t, 0, 0, 10, **speed), FRAME).pose_at(at([4.2]))
    np.testing.assert_allclose(poses.velocity_mps, [[-5, 0, -1]])
    assert poses.heading_deg[0] == pytest.approx(270)


def test_attitude_known_in_part():
    t = np.arange(0.0, 20.0)
    yaw = np.where(t < 10, 30.0, np.nan)
    poses = Track(telemetry(t, 0, 5 * t, 10, roll_deg=1, pitch_deg=0, yaw_deg=yaw), FRAME).pose_at(at([5, 15]))
    assert poses.attitude_known.tolist() == [True, False]
    np.testing.assert_allclose(poses.heading_deg, [30, 0], atol=0.1)


def test_pchip_does_not_overshoot():
    up = np.array([0, 0, 30, 30, 30.0])
    frame = telemetry(np.arange(5.0), 0, 0, up, roll_deg=1, pitch_deg=0, yaw_deg=0)
    asked = np.linspace(0, 4, 101)
    height = Track(frame, FRAME, method="pchip").pose_at(at(asked)).position_m[:, 2]
    assert height.min() == 0.5
    assert height.max() <= 30 + 1e-9
    linear = Track(frame, FRAME).pose_at(at(asked)).position_m[:, 2]
    assert np.abs(height - linear).max() > 0.5


def test_ground_height_shifts_everything():
    frame = telemetry([0, 1], 0, 0, [0.0, 20.0], roll_deg=1, pitch_deg=0, yaw_deg=0)
    up = Track(frame, FRAME, ground_m=7.0).pose_at(at([0, 1])).position_m[:, 2]
    np.testing.assert_allclose(up, [7.5, 27.0])


def test_a_gap_limit_must_be_positive():
    with pytest.raises(ValueError, match="positive"):
        Track(telemetry([0.0], 0, 0, 1), FRAME, maximum_gap_s=0)


# --- clocks ---

WAVELENGTH_M = 299_792_458.0 / 3.3e9


def two_ray_flight(duration_s):
    """A route around the tower; level as a function of true time, NaN more than 15 s off the flight."""

    def level(t):
        t = np.asarray(t, dtype=float)
        angle = 2 * np.pi * t / 300.0
        radius = 120 + 60 * np.sin(2 * np.pi * t / 97.0)
        east, north = 60 + radius * np.cos(angle), radius * np.sin(angle)
        up = 40 + 8 * np.sin(2 * np.pi * t / 61.0)
        direct = np.sqrt(east**2 + north**2 + (up - 10) ** 2)
        ground = np.sqrt(east**2 + north**2 + (up + 10) ** 2)
        field = np.exp(-2j * np.pi * direct / WAVELENGTH_M) / direct
        field = field - 0.5 * np.exp(-2j * np.pi * ground / WAVELENGTH_M) / ground
        db = 20 * np.log10(np.abs(field) * WAVELENGTH_M / (4 * np.pi))
        return np.where((t < -15) | (t > duration_s + 15), np.nan, db)

    return level


@pytest.mark.parametrize("lag", [-10.0, -3.37, 0.0, 0.61, 10.0])
def test_a_planted_lag_comes_back_within_a_tenth_of_a_second(lag):
    level = two_ray_flight(300)
    t = np.arange(0, 300, 0.1)
    noise = np.random.default_rng(1).normal(0, 3, len(t))
    fit = estimate_lag(t, level(t - lag) - 47 + noise, level)
    assert fit.verdict == "ok", fit.reason
    assert abs(fit.radio_minus_telemetry_s - lag) < 0.1
    assert fit.interval_s[0] - 0.02 <= lag <= fit.interval_s[1] + 0.02
    assert fit.rmse_db == pytest.approx(3.0, abs=0.2)
    np.testing.assert_allclose(fit.apply(t), t - lag, atol=0.1)
    assert json.loads(json.dumps(fit.as_dict(), allow_nan=False))["drift_ci95_ms_per_min"] == [None, None]


@pytest.mark.parametrize("drift_ms_per_min", [-5.0, 2.0, 5.0])
def test_a_planted_drift_comes_back_within_half_a_millisecond_per_minute(drift_ms_per_min):
    level = two_ray_flight(1800)
    t = np.arange(0, 1800, 0.1)
    drift = drift_ms_per_min * 1e-3 / 60
    middle = t[-1] / 2
    noise = np.random.default_rng(2).normal(0, 3, len(t))
    fit = estimate_lag(t, level(t - 4.2 - drift * (t - middle)) + noise, level)
    assert fit.verdict == "ok", fit.reason
    assert abs(fit.radio_minus_telemetry_s - 4.2) < 0.1
    assert abs(fit.drift_s_per_s - drift) * 60e3 < 0.5
    low, high = fit.drift_interval_s_per_s
    assert low - 1e-6 < drift < high + 1e-6
    np.testing.assert_allclose(fit.apply(t), t - 4.2 - drift * (t - middle), atol=0.05)


def test_lag_with_time_stamps_and_slow_shadowing():
    from scipy.signal import lfilter

    level = two_ray_flight(300)
    t = np.arange(0, 300, 0.1)
    shadow = 4 * np.sqrt(1 - 0.99**2) * lfilter([1], [1, -0.99], np.random.default_rng(3).normal(size=len(t)))
    origin = START.astype(np.int64) * 1e-9
    fit = estimate_lag(at(t), level(t - 1.5) + shadow, lambda asked: level(asked.astype(np.int64) * 1e-9 - origin))
    assert fit.verdict == "ok"
    assert abs(fit.radio_minus_telemetry_s - 1.5) < 0.1
    assert (fit.apply(at(t)) - at(t) - np.timedelta64(1_500_000_000, "ns")).astype(int).max() < 1e8


@pytest.mark.parametrize("seed", range(4))
def test_flat_flights_are_ambiguous(seed):
    t = np.arange(0, 600, 0.1)
    noise = np.random.default_rng(seed).normal(0, 3, len(t))
    for level in (lambda x: np.full(len(x), -60.0), lambda x: -60 + 0.05 * np.sin(x / 5)):
        fit = estimate_lag(t, level(t) + noise, level)
        assert fit.verdict == "ambiguous"
        assert "flat" in fit.reason
        assert fit.interval_s[1] - fit.interval_s[0] > 5.0


def test_a_periodic_flight_has_rivals():
    t = np.arange(0, 300, 0.1)
    noise = np.random.default_rng(5).normal(0, 1, len(t))
    fit = estimate_lag(t, 5 * np.sin(2 * np.pi * t / 8.0) + noise, lambda x: 5 * np.sin(2 * np.pi * x / 8.0))
    assert fit.verdict == "ambiguous"
    assert "other lags" in fit.reason


def test_a_prediction_that_explains_nothing_is_not_trusted():
    rng = np.random.default_rng(8)
    knots = np.cumsum(rng.normal(0, 1, 700))
    knots -= np.interp(np.arange(700), [0, 699], [knots[0], knots[-1]])

    def level(x):
        return np.interp(x, np.arange(-200, 500), knots * 3)

    t = np.arange(0, 300, 0.1)
    weak = 0.3 * level(t + 1.0) + rng.normal(0, 1, len(t))  # ten decibels were predicted where three are seen
    fit = estimate_lag(t, weak, level)
    assert fit.verdict == "ambiguous"
    assert "no more than a constant" in fit.reason
    assert estimate_lag(t, weak / 0.3, level).verdict == "ok"


def test_a_lag_outside_the_window_is_not_passed_off_as_a_result():
    level = two_ray_flight(300)
    t = np.arange(0, 300, 0.1)
    noise = np.random.default_rng(6).normal(0, 3, len(t))
    fit = estimate_lag(t, level(t + 4.0) + noise, level, window_s=2.0)
    assert fit.verdict != "ok"


def test_too_little_data_fails():
    level = two_ray_flight(300)
    assert estimate_lag(np.arange(5.0), np.zeros(5), level).verdict == "failed"
    t = np.arange(0, 300, 0.1)
    fit = estimate_lag(t + 5000, level(t), level)
    assert fit.verdict == "failed"
    assert "overlap" in fit.reason
    assert np.isnan(fit.radio_minus_telemetry_s)
    assert estimate_lag(t, np.full(len(t), np.nan), level).verdict == "failed"
    with pytest.raises(ValueError, match="times and"):
        estimate_lag(t, np.zeros(3), level)
    with pytest.raises(ValueError, match="predictor gave"):
        estimate_lag(t, level(t), lambda x: x[:5])


def patterned_flight(seed, pattern_db=6.0):
    """A flight with sharp turns and a UAV pattern that the prediction does not know: (level, terms) of true time."""
    knots = np.arange(-50.0, 700.0, 25.0)
    heading = np.random.default_rng(seed).uniform(0, 360, len(knots))

    def route(x):
        leg = np.clip(np.searchsorted(knots, x, side="right") - 1, 0, len(knots) - 1)
        turned = np.clip((x - knots[leg]) / 2.0, 0, 1)  # two seconds for a turn
        before = heading[np.maximum(leg - 1, 0)]
        yaw = before + turned * ((heading[leg] - before + 180) % 360 - 180)
        angle = x / 120.0
        east, north = 150 * np.cos(angle) + 30, 150 * np.sin(2 * angle)
        azimuth = np.degrees(np.arctan2(east, north))
        distance = np.sqrt(east**2 + north**2 + 30**2)
        return -20 * np.log10(distance), azimuth, np.degrees(np.arcsin(30 / distance)), azimuth + 180 - yaw

    def level(x):
        free_space, _, _, relative = route(x)
        return free_space + pattern_db * np.cos(np.radians(relative - 40))

    def predictor(x):
        free_space, azimuth, elevation, relative = route(x)
        return np.column_stack([free_space, direction_terms(azimuth, elevation, relative)])

    return level, predictor, lambda x: route(x)[0]


def test_unknown_patterns_are_fitted_while_the_lag_is_found():
    level, predictor, free_space = patterned_flight(1)
    t = np.arange(0, 600, 0.25)
    measured = level(t + 1.7) - 30 + np.random.default_rng(2).normal(0, 3, len(t))
    fit = estimate_lag(t, measured, predictor)
    assert fit.verdict == "ok", fit.reason
    assert abs(fit.radio_minus_telemetry_s + 1.7) < 0.1
    assert fit.interval_s[0] <= -1.7 <= fit.interval_s[1]
    assert fit.rmse_db == pytest.approx(3.0, abs=0.2)
    # without the terms, the pattern that turns with the UAV hides the lag
    assert estimate_lag(t, measured, free_space).verdict != "ok"


def test_channels_that_share_a_clock_add_their_evidence():
    t = np.arange(0, 300, 0.25)
    fits = []
    for seed in (3, 4):
        level, predictor, _ = patterned_flight(1, pattern_db=1.2)
        measured = level(t - 2.2) + np.random.default_rng(seed).normal(0, 3, len(t))
        fits.append(estimate_lag(t, measured, predictor))
    both = combine_lags(fits)
    assert abs(both.radio_minus_telemetry_s - 2.2) < 0.5
    assert both.n == sum(fit.n for fit in fits)
    assert np.ptp(both.interval_s) <= max(np.ptp(fit.interval_s) for fit in fits)
    assert both.interval_s[0] <= 2.2 <= both.interval_s[1]
    assert combine_lags(fits[:1]) is fits[0]
    failed = estimate_lag(t[:5], t[:5], predictor)
    assert combine_lags([failed, fits[0]]) is fits[0]
    assert combine_lags([failed, failed]) is failed
    with pytest.raises(ValueError, match="same window"):
        combine_lags([fits[0], estimate_lag(t, t, predictor, window_s=5.0)])
    with pytest.raises(ValueError, match="at least one"):
        combine_lags([])


def test_no_drift_where_none_shows():
    level = two_ray_flight(900)
    t = np.arange(0, 900, 0.25)
    noise = np.random.default_rng(9).normal(0, 3, len(t))
    fit = estimate_lag(t, level(t + 1.0) + noise, level)
    low, high = fit.drift_interval_s_per_s
    assert low <= 0 <= high
    flat = estimate_lag(t, noise, lambda x: np.zeros(len(x)))
    assert flat.drift_s_per_s == 0.0


def test_predictor_gaps_and_missing_levels_do_not_matter():
    level = two_ray_flight(300)
    t = np.arange(0, 300, 0.1)
    measured = level(t - 2.0) + np.random.default_rng(7).normal(0, 3, len(t))
    measured[::3] = np.nan
    fit = estimate_lag(t, measured, lambda x: np.where((x > 100) & (x < 110), np.nan, level(x)))
    assert fit.verdict == "ok"
    assert abs(fit.radio_minus_telemetry_s - 2.0) < 0.1


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


def real_flight(name):
    """Track, epoch seconds and channels of a real flight, or skip."""
    folder = os.environ.get("AERPAW_CMP_FIELD_DATA")
    if not folder:
        pytest.skip("AERPAW_CMP_FIELD_DATA is not set")
    from scipy.io import loadmat

    found = loadmat(Path(folder) / "dataset12" / f"{name}.mat")
    data = {k: np.ravel(v).astype(float) for k, v in found.items() if k[0] == "m" or k == "timestamp_power"}
    epoch = data["timestamp_power"]
    frame = telemetry(np.zeros(len(epoch)), 0, 0, 0)
    frame["time"] = pd.to_datetime(epoch, unit="s")
    # the authors' x and y are not the same axis in all their files: longitudes of Lake Wheeler are the negative ones
    east, north = ("mX", "mY") if data["mX"].mean() < 0 else ("mY", "mX")
    columns = {"longitude_deg": east, "latitude_deg": north, "altitude_m": "mZ"}
    columns |= {"roll_deg": "mRoll", "pitch_deg": "mPitch", "yaw_deg": "mYaw"}
    for ours, theirs in columns.items():
        frame[ours] = data[theirs]
    return Track(frame, SiteFrame(35.72750947, -78.69595819)), epoch, [data["mpower1"], data["mpower2"]]


@pytest.mark.field
@pytest.mark.parametrize(("name", "height"), [("40m_fs10MHz", 40), ("70m_fs20MHz", 70)])
def test_track_of_a_real_flight(name, height):
    track, epoch, _ = real_flight(name)
    poses = track.pose_at(epoch)
    assert poses.valid.mean() > 0.99
    assert np.nanmax(poses.position_m[:, 2]) == pytest.approx(height, abs=3)
    speed = np.linalg.norm(poses.velocity_mps[:, :2], axis=1)
    assert 3 < np.nanmax(speed) < 25
    assert poses.attitude_known.mean() > 0.99


@pytest.mark.field
@pytest.mark.parametrize("name", ["40m_fs10MHz", "70m_fs20MHz"])
def test_real_clocks_agree_as_far_as_the_data_can_tell(name):
    """Free space alone says nothing about the lag; with direction terms the interval shrinks to a few seconds."""
    track, epoch, channels = real_flight(name)

    def predictor(times):
        poses = track.pose_at(times)
        line = poses.position_m - np.array([0.0, 0.0, 10.0])
        distance = np.linalg.norm(line, axis=1)
        azimuth = np.degrees(np.arctan2(line[:, 0], line[:, 1]))
        level = np.where(poses.position_m[:, 2] > 15, -20 * np.log10(distance), np.nan)
        elevation = np.degrees(np.arcsin(line[:, 2] / distance))
        return np.column_stack([level, direction_terms(azimuth, elevation, azimuth + 180 - poses.heading_deg)])

    alone = estimate_lag(epoch, channels[0], lambda times: predictor(times)[:, 0], resolution_s=0.1)
    assert alone.verdict == "ambiguous"
    both = combine_lags([estimate_lag(epoch, level, predictor, resolution_s=0.1) for level in channels])
    assert both.verdict != "failed"
    assert abs(both.radio_minus_telemetry_s) < 1.5
    assert both.interval_s[0] < 1.0
    assert np.ptp(both.interval_s) < 0.6 * np.ptp(alone.interval_s)
    assert both.rmse_db < 3.7
