"""The search for a lag between radio and telemetry."""

from __future__ import annotations

import json

import numpy as np
import pytest

from aerpaw_cmp.flight import lag
from aerpaw_cmp.flight.lag import combine_lags, direction_terms, estimate_lag
from tests.flight.test_track import START, at, real_flight

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
    assert fit.ci95_s[0] - 0.02 <= lag <= fit.ci95_s[1] + 0.02
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
    fit = estimate_lag(t, level(t + 4.2 - drift * (t - middle)) + noise, level)
    assert fit.verdict == "ok", fit.reason
    assert abs(fit.radio_minus_telemetry_s + 4.2) < 0.1
    assert abs(fit.drift_s_per_s - drift) * 60e3 < 0.5
    low, high = fit.drift_interval_s_per_s
    assert low - 1e-6 < drift < high + 1e-6
    assert fit.as_dict()["drift_ci95_ms_per_min"] == [60_000.0 * low, 60_000.0 * high]
    assert fit.reference == pytest.approx(middle, abs=1e-6)
    np.testing.assert_allclose(fit.apply(t), t + 4.2 - drift * (t - middle), atol=0.05)


def test_lag_with_time_stamps_and_slow_shadowing():
    from scipy.signal import lfilter

    level = two_ray_flight(300)
    t = np.arange(0, 300, 0.1)
    shadow = 4 * np.sqrt(1 - 0.99**2) * lfilter([1], [1, -0.99], np.random.default_rng(3).normal(size=len(t)))
    origin = START.astype(np.int64) * 1e-9
    fit = estimate_lag(at(t), level(t - 1.5) + shadow, lambda asked: level(asked.astype(np.int64) * 1e-9 - origin))
    assert fit.verdict == "ok"
    assert abs(fit.radio_minus_telemetry_s - 1.5) < 0.1
    assert np.abs((at(t) - fit.apply(at(t)) - np.timedelta64(1_500_000_000, "ns")).astype(int)).max() < 1e8


@pytest.mark.parametrize("seed", range(4))
def test_flat_flights_are_ambiguous(seed):
    t = np.arange(0, 600, 0.1)
    noise = np.random.default_rng(seed).normal(0, 3, len(t))
    for level in (lambda x: np.full(len(x), -60.0), lambda x: -60 + 0.05 * np.sin(x / 5)):
        fit = estimate_lag(t, level(t) + noise, level)
        assert fit.verdict == "ambiguous"
        assert "flat" in fit.reason
        assert fit.ci95_s[1] - fit.ci95_s[0] > 5.0


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
    weak = 0.3 * level(t - 1.0) + rng.normal(0, 1, len(t))  # ten decibels were predicted where three are seen
    fit = estimate_lag(t, weak, level)
    assert fit.verdict == "ambiguous"
    assert "no more than a constant" in fit.reason
    assert estimate_lag(t, weak / 0.3, level).verdict == "ok"


def test_a_lag_outside_the_window_is_not_passed_off_as_a_result():
    level = two_ray_flight(300)
    t = np.arange(0, 300, 0.1)
    noise = np.random.default_rng(6).normal(0, 3, len(t))
    fit = estimate_lag(t, level(t - 4.0) + noise, level, window_s=2.0)
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
    assert fit.ci95_s[0] <= -1.7 <= fit.ci95_s[1]
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
    assert np.ptp(both.ci95_s) <= max(np.ptp(fit.ci95_s) for fit in fits)
    assert both.ci95_s[0] <= 2.2 <= both.ci95_s[1]
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
    fit = estimate_lag(t, level(t - 1.0) + noise, level)
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
    assert both.ci95_s[1] > -1.0
    assert np.ptp(both.ci95_s) < 0.6 * np.ptp(alone.ci95_s)
    assert both.rmse_db < 3.7


@pytest.mark.parametrize("gaps", [0, 7, 400])
def test_the_search_in_blocks_gives_the_costs_of_one_lag_after_the_other(gaps):
    """Whole rows together, rows with gaps alone: to the last digit what each row costs by itself."""
    rng = np.random.default_rng(3)
    rows = rng.normal(-70, 5, (11, 800))
    rows[[0, 4, 10], :gaps] = np.nan
    rows[3] = np.nan
    one_by_one = [lag._cost(row, 0.4, 500) for row in rows]
    assert lag._costs(rows, 0.4, 500).tolist() == one_by_one
    assert np.isinf(one_by_one[3])
    assert np.isfinite(one_by_one[0]) == (gaps < 300)


def test_a_flight_searched_in_blocks_of_one_lag_gives_the_same_fit(monkeypatch):
    level = two_ray_flight(700)
    t = np.arange(0, 700, 0.1)
    measured = level(t - 1.3) + np.random.default_rng(4).normal(0, 3, len(t))
    whole = estimate_lag(t, measured, level)
    monkeypatch.setattr(lag, "_HELD", 1)
    assert estimate_lag(t, measured, level).as_dict() == whole.as_dict()
    assert abs(whole.radio_minus_telemetry_s - 1.3) < 0.1


def test_slopes_of_free_terms_are_those_of_their_gradient():
    """Read from the neighbours where they are asked for: no second table of a long flight."""
    rng = np.random.default_rng(6)
    table = rng.normal(0, 1, (50, 1 + lag.DIRECTION_TERMS))
    prediction = lag._Prediction(3.0, 0.25, table)
    at_nodes = prediction.times()[:-1]
    slopes = prediction.terms_at(at_nodes, slopes=True)
    np.testing.assert_array_equal(slopes[:, 1:], np.gradient(table[:, 1:], 0.25, axis=0)[:-1])
    assert not slopes[:, 0].any()
    assert np.isnan(prediction.terms_at(np.array([2.9, 99.0]))[:, 1:]).all()
    assert direction_terms([1.0], [2.0], [3.0]).shape == (1, lag.DIRECTION_TERMS)


def test_free_terms_of_many_lags_at_once_are_those_of_each_alone():
    """What is left is orthogonal to the whitened terms, with and without gaps, however it is multiplied out."""
    rng = np.random.default_rng(8)
    terms = np.concatenate([np.ones((5, 80, 1)), rng.normal(size=(5, 80, 4))], axis=2)
    y = rng.normal(size=(5, 80)) + terms @ np.array([3.0, 1.0, -2.0, 0.5, 0.0])
    y[1, 7] = np.nan
    terms[3, 20:30] = np.nan
    for phi in (0.0, 0.6):
        left = lag._without_terms(y, terms, phi)
        for row in range(5):
            np.testing.assert_allclose(left[row], y[row] - lag._explained(y[row], terms[row], phi), rtol=0, atol=1e-11)
        whitened = left[0, 1:] - phi * left[0, :-1]
        assert np.abs(whitened @ (terms[0, 1:] - phi * terms[0, :-1])).max() < 1e-10
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lag, "_NO_THREADS", 0)
        np.testing.assert_allclose(lag._without_terms(y, terms, 0.6), left, rtol=0, atol=1e-11)


def test_the_interval_of_a_mean_is_that_of_its_blocks():
    """One parameter: Student's t over the sums of blocks, by hand."""
    from scipy.stats import t as student

    residual = np.random.default_rng(4).normal(0, 2, 1000)
    length = round(2.0 * 1000 ** (1 / 3))
    sums = residual[: 1000 // length * length].reshape(-1, length).sum(axis=1)
    count = len(sums)
    expected = student.ppf(0.975, count - 1) * np.sqrt(count / (count - 1) * (sums**2).sum()) / 1000
    assert lag._sandwich(residual, np.ones((1, 1000))) == pytest.approx([expected], rel=1e-12)


def test_evidence_is_that_of_independent_samples():
    """Residuals that go together in runs of 20 count as a twentieth; runs that turn their sign add nothing."""
    chance = np.random.default_rng(5)
    cost = np.array([1.0, np.e, 2.0])
    white, runs = chance.normal(size=8000), np.repeat(chance.normal(size=400), 20)
    turning = np.tile([1.0, -1.0], 4000)
    assert lag._likelihood_ratios(cost, white)[1] == pytest.approx(8000, rel=0.15)
    assert lag._likelihood_ratios(cost, runs)[1] == pytest.approx(400, rel=0.5)
    assert lag._likelihood_ratios(cost, turning)[1] == pytest.approx(8000, rel=1e-9)


def test_memory_of_a_residual_does_not_depend_on_its_mean():
    from scipy.signal import lfilter

    residual = lfilter([1], [1, -0.6], np.random.default_rng(6).normal(size=20_000))
    assert lag._phi(residual + 25.0) == pytest.approx(lag._phi(residual), abs=1e-9)
    assert lag._phi(residual) == pytest.approx(0.6, abs=0.03)


def test_the_last_instant_that_every_shift_reaches():
    prediction = lag._Prediction(0.0, 0.5, np.zeros((21, 1)))  # 0 to 10 s
    assert prediction.common(np.array([0.9, 1.0, 5.0, 9.0, 9.1]), 1.0).tolist() == [False, True, True, True, False]


def test_a_sharp_channel_beside_a_stronger_one_lends_no_sharpness():
    """Its interval was taken where its lag was not."""
    lags = np.round(np.arange(-100, 101) * 0.1, 6)
    shape = {"drift_s_per_s": 0.0, "drift_interval_s_per_s": (np.nan, np.nan), "verdict": "ok", "reason": ""}
    rest = {"reference": 0.0, "n": 100, "rmse_db": 3.0, "rmse_unshifted_db": 4.0, "window_s": 10.0}

    def fit(place, half, strength):
        evidence = strength * (lags - place) ** 2
        return lag.LagFit(
            radio_minus_telemetry_s=place,
            ci95_s=(place - half, place + half),
            curve_lag_s=lags,
            curve_rmse_db=np.full(len(lags), 3.0),
            evidence=evidence,
            **shape,
            **rest,
        )

    sharp, strong = fit(2.0, 0.001, 100.0), fit(-1.0, 0.3, 1e6)
    both = combine_lags([sharp, strong])
    assert both.radio_minus_telemetry_s == pytest.approx(-1.0)
    assert both.ci95_s[1] - both.ci95_s[0] >= 0.1 - 1e-9
    agreeing = combine_lags([sharp, fit(2.0, 0.3, 1e6)])
    assert agreeing.ci95_s[1] - agreeing.ci95_s[0] < 0.1
