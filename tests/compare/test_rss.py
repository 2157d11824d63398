"""Comparison of levels: hard cases, the same footing, residuals and spans."""

import json

import numpy as np
import pytest

from aerpaw_cmp.common.jsonable import json_safe
from aerpaw_cmp.compare.level import (
    channel_difference,
    compare_rss,
    error_spans,
    link_geometry,
    local_mean_db,
    outliers,
    seconds,
)
from aerpaw_cmp.compare.statistics import error_intervals

NAN = float("nan")


def flight(n=600, seed=0, sigma=3.0):
    rng = np.random.default_rng(seed)
    time = np.arange(n) * 0.1
    simulated = -80 + 10 * np.sin(time / 5)
    return time, simulated + 30.0 + rng.normal(0, sigma, n), simulated


def test_a_planted_offset_comes_back():
    time, measured, simulated = flight(sigma=0.0)
    fit = compare_rss(time, measured, simulated)
    assert fit.offset_db == -30.0
    assert fit.rmse_db == pytest.approx(0.0, abs=1e-9)
    assert fit.correlation == pytest.approx(1.0)
    np.testing.assert_allclose(fit.residual_db, 0.0, atol=1e-9)
    time, measured, simulated = flight()
    fit = compare_rss(time, measured, simulated)
    assert fit.intervals.offset_db[0] < -30.0 < fit.intervals.offset_db[1]
    assert fit.rmse_ci95_db[0] < 3.0 < fit.rmse_ci95_db[1]


@pytest.mark.parametrize("away_db", [30.04, 80.0])
def test_an_interval_is_of_the_error_that_is_stated(away_db):
    """The offset differs from the mean by the rounding, and by the limit of the search range of 30 dB."""
    time, measured, simulated = flight(60, sigma=0.0)
    noise = np.random.default_rng(1).normal(0, 0.01, 60)
    fit = compare_rss(time, measured + noise + away_db - 30.0, simulated, baselines={"free_space": simulated})
    for low, high in (fit.rmse_ci95_db, fit.baseline_intervals["free_space"]):
        assert low < fit.rmse_db < high
    away = np.nanmean(fit.residual_db)
    spread = error_intervals(measured + noise, simulated).rmse_db
    assert fit.rmse_ci95_db == pytest.approx(np.hypot(spread, away), rel=1e-6)
    assert abs(away) == pytest.approx(away_db % 0.1 if away_db < 50.0 else away_db - 50.0, abs=0.01)


def numbers(comparison):
    """Everything of a comparison but the residual, which has the order of the samples."""
    return {name: value for name, value in json_safe(comparison).items() if name != "residual_db"}


def test_baselines_have_offsets_of_their_own():
    time, measured, simulated = flight()
    fit = compare_rss(time, measured, simulated, baselines={"free_space": simulated + 1, "two_ray": 0 * simulated})
    assert set(fit.baselines) == {"free_space", "two_ray"}
    assert fit.baselines["free_space"].offset_db == pytest.approx(fit.offset_db + 1)
    assert fit.baselines["two_ray"].rmse_db > fit.rmse_db
    assert np.isnan(fit.lag_s)
    assert fit.fitted_on_scored == ("offset_db",)
    json.dumps(json_safe(fit), allow_nan=False)


LEVEL = np.full(20, -60.0)


@pytest.mark.parametrize(
    ("measured", "simulated", "counts", "offset_db", "rmse_db"),
    [
        ([], [], (0, 0, 0), NAN, NAN),
        ([-60.0], [-80.0], (1, 0, 0), -20.0, NAN),
        ([-60.0, -70.0], [-80.0, -91.0], (2, 0, 0), -20.5, NAN),
        (LEVEL, np.full(20, NAN), (0, 20, 0), NAN, NAN),
        (np.full(20, NAN), LEVEL, (0, 0, 20), NAN, NAN),
        (LEVEL, LEVEL - 15.0, (20, 0, 0), -15.0, 0.0),
        (LEVEL, np.linspace(-90, -70, 20), (20, 0, 0), -20.0, np.std(np.linspace(-90, -70, 20))),
        (LEVEL + 10.0, LEVEL - 60.0, (20, 0, 0), -50.0, 20.0),
    ],
)
def test_a_series_without_variation_has_its_counts_and_no_correlation(measured, simulated, counts, offset_db, rmse_db):
    """No sample, a single one, one side out of coverage, constants, an offset beyond the span of the search."""
    fit = compare_rss(np.arange(float(len(measured))), measured, simulated, baselines={"free_space": simulated})
    assert (fit.n, fit.n_simulated_out, fit.n_measured_out) == counts
    assert (fit.offset_db, fit.rmse_db) == pytest.approx((offset_db, rmse_db), nan_ok=True)
    assert np.isnan(fit.correlation)
    assert fit.at_edge == (offset_db == -50.0)
    if fit.n < 20:
        assert json_safe(fit.rmse_ci95_db) == [None, None]
    json.dumps(json_safe(fit), allow_nan=False)


def test_a_sample_without_a_pose_is_not_out_of_coverage():
    time, measured, simulated = flight(10)
    simulated[:3] = NAN
    measured[5] = NAN
    posed = np.arange(10) >= 2
    fit = compare_rss(time, measured, simulated, posed=posed)
    assert (fit.n, fit.n_no_pose, fit.n_out_of_coverage) == (6, 2, 2)
    assert (fit.n_simulated_out, fit.n_measured_out) == (1, 1)


def test_order_of_samples_does_not_matter():
    time, measured, simulated = flight()
    mixed = np.random.default_rng(1).permutation(len(time))
    in_order = compare_rss(time, measured, simulated)
    shuffled = compare_rss(time[mixed], measured[mixed], simulated[mixed])
    assert numbers(in_order) == numbers(shuffled)
    np.testing.assert_array_equal(in_order.residual_db[mixed], shuffled.residual_db)
    stamps = np.datetime64("2024-07-15T12:00") + (time * 1e9).astype("timedelta64[ns]")
    assert numbers(compare_rss(stamps, measured, simulated)) == numbers(in_order)


def test_seconds():
    assert seconds(np.array(["2024-01-01T00:00:01", "2024-01-01T00:00:00"], dtype="datetime64[ms]")).tolist() == [1, 0]
    assert np.isnan(seconds(np.array(["NaT"], dtype="datetime64[ns]"))).all()


# --- the same footing ---


def test_local_mean_averages_power():
    level = 10 * np.log10(np.array([1.0, 3.0, 5.0, 7.0]))
    np.testing.assert_allclose(10 ** (local_mean_db([0, 1, 2, 3], level, 2.2) / 10), [2, 3, 5, 6])
    np.testing.assert_allclose(local_mean_db([0, 1, 2, 3], level, 0.0), level)
    assert np.isnan(local_mean_db([0, 1], [NAN, NAN], 1.0)).all()
    gap = local_mean_db([0, 1, 2], [0.0, NAN, 0.0], 4.0)
    assert np.isnan(gap[1])
    np.testing.assert_allclose(gap[[0, 2]], 0.0, atol=1e-12)


def test_local_mean_keeps_weak_stretches_beside_strong_ones():
    rng = np.random.default_rng(2)
    time = np.sort(rng.uniform(0, 100, 3000))
    level = np.where(time < 50, 0.0, -180.0) + rng.normal(0, 3, 3000)
    got = local_mean_db(time, level, 1.0)
    for i in rng.integers(0, 3000, 50):
        near = np.abs(time - time[i]) <= 0.5
        assert got[i] == pytest.approx(10 * np.log10(np.mean(10 ** (level[near] / 10))), abs=1e-6)


def test_fading_averages_out_on_the_same_footing():
    rng = np.random.default_rng(3)
    time = np.arange(0, 200, 0.1)
    mean = -70 + 8 * np.sin(time / 20)
    rayleigh = 10 * np.log10(rng.exponential(size=len(time)))
    errors = [local_mean_db(time, mean + rayleigh, w) - local_mean_db(time, mean, w) for w in (0.0, 4.0)]
    assert errors[0].std() == pytest.approx(5.57, abs=0.4)  # standard deviation of Rayleigh in dB
    assert errors[1].std() < 1.0


def test_link_geometry_in_the_antenna_frames():
    from aerpaw_cmp.propagation.geometry import rotation_from_aircraft, rotation_from_yaw_pitch_roll

    tower = np.array([10.0, -5.0, 10.0])
    rng = np.random.default_rng(9)
    position = tower + rng.normal(0, 100, (50, 3))
    rotation = rotation_from_aircraft(*rng.uniform(-30, 30, (3, 50)))
    mount = rotation_from_yaw_pitch_roll(np.radians(45.0), 0.0, 0.0)
    uav_mount = rotation_from_yaw_pitch_roll(np.radians(315.0), 0.0, np.radians(90.0))
    angles = link_geometry(tower, position, rotation, tower_mount=mount, uav_mount=uav_mount)
    # boresight 45 deg counter-clockwise from east is the bearing 45 deg: an azimuth of 0 in the antenna frame
    bearing = (45.0 - angles["azimuth_deg"] + 180) % 360 - 180
    np.testing.assert_allclose(angles["tower_azimuth_deg"], bearing, atol=1e-9)
    np.testing.assert_allclose(angles["tower_elevation_deg"], angles["elevation_deg"], atol=1e-9)
    for i in range(50):  # one by one, from the definition v_site = R_body R_mount v_device
        device = (rotation[i] @ uav_mount).T @ (tower - position[i])
        assert angles["uav_azimuth_deg"][i] == pytest.approx(np.degrees(np.arctan2(device[1], device[0])))
        assert angles["uav_elevation_deg"][i] == pytest.approx(
            np.degrees(np.arcsin(device[2] / np.linalg.norm(device)))
        )
    level = link_geometry(tower, position, rotation_from_aircraft(np.zeros(50), np.zeros(50), np.full(50, 30.0)))
    np.testing.assert_allclose(level["heading_deg"], 30.0)


def test_spans_are_runs_of_smoothed_errors_of_one_sign():
    """Smooth with a plain loop, and cut where the sign changes or a gap is longer than the window."""
    rng = np.random.default_rng(15)
    time = np.round(np.cumsum(rng.choice([0.25, 0.5], 400)), 2)
    time[200:] += 2.25
    residual = 4.0 * np.sin(time / 6.0) + rng.normal(size=400)
    place = np.column_stack([time, -time, 0 * time])
    smooth = np.array([residual[np.abs(time - t) <= 1.0].mean() for t in time])
    sign = np.sign(smooth) * (np.abs(smooth) > 2.0)
    runs = [[0]]
    for i in range(1, 400):
        if sign[i] != sign[i - 1] or time[i] - time[i - 1] > 2.0:
            runs.append([])
        runs[-1].append(i)
    expected = [run for run in runs if sign[run[0]]]
    expected.sort(key=lambda run: -abs(residual[run].mean()) * np.sqrt(time[run[-1]] - time[run[0]] + 1e-3))
    mixed, around = rng.permutation(400), {"x": time, "foliage_m": 9.0 * (time % 40.0 > 20.0)}
    spans = error_spans(
        time[mixed],
        residual[mixed],
        position_m=place[mixed],
        context={name: values[mixed] for name, values in around.items()},
        threshold_db=2.0,
        largest=5,
    )
    assert len(expected) > 5
    for span, run in zip(spans, expected[:5], strict=True):
        assert (span.start_s, span.end_s, span.n) == (time[run[0]], time[run[-1]], len(run))
        assert span.mean_db == pytest.approx(residual[run].mean())
        assert span.position_m == pytest.approx(place[run].mean(axis=0))
        assert span.geometry["x"] == pytest.approx(np.median(time[run]))
    json.dumps(json_safe(spans), allow_nan=False)
    assert error_spans(time, np.full(len(time), NAN)) == []
    assert len(error_spans(np.arange(600.0), np.tile(np.repeat([9.0, -9.0], 10), 30), threshold_db=1.0)) == 10
    first, second = -60.0 + 12.0 * np.sin(time / 6.0), np.full(400, -62.0)
    parted, apart = channel_difference(time, first, second), first - first.mean()
    assert parted.spans == error_spans(time, apart, window_s=1.0, threshold_db=10.0)
    assert (parted.n, parted.mean_db, parted.std_db) == pytest.approx((400, (first - second).mean(), apart.std()))
    assert channel_difference(time, first, np.full(400, NAN)).n == 0


@pytest.mark.parametrize(("spread_db", "reach_db"), [(10.0, 40.0), (1.0, 20.0)])
def test_outliers_lie_four_spreads_beyond_the_quartiles_and_twenty_decibels_at_least(spread_db, reach_db):
    end = spread_db / 2
    level = np.concatenate([np.repeat([-end, end], 50), [-end - reach_db + 0.1, end + reach_db - 0.1]])
    assert not outliers(level).any()
    assert np.flatnonzero(outliers(level + 0.2 * (np.arange(102) == 101))).tolist() == [101]
    assert np.flatnonzero(outliers(level - 0.2 * (np.arange(102) == 100))).tolist() == [100]
    assert not outliers([NAN, NAN]).any()


@pytest.mark.parametrize(("level", "spans"), [(1.35, 0), (1.65, 2)])
def test_a_span_is_large_from_one_and_a_half_times_the_rms_error(level, spans):
    """Two plateaus whose height over the RMS of all is planted, no noise."""
    time = np.arange(0.0, 400.0)
    residual = np.zeros(400)
    residual[50:100], residual[250:300] = 1.0, -1.0
    rms = 1.0 / level  # of the whole: the rest makes it so
    rest = np.sqrt((400 * rms**2 - 100) / 300)
    quiet = residual == 0
    residual[quiet] = rest * np.where(np.arange(quiet.sum()) % 2, 1.0, -1.0)
    runs = error_spans(time, residual, window_s=10.0)
    assert len(runs) == spans
    assert sorted(round(span.mean_db, 1) for span in runs) == ([-1.0, 1.0] if spans else [])
    assert len(error_spans(time, residual, window_s=10.0, threshold_db=0.9)) == 2
