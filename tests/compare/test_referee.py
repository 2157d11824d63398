"""The metric card against closed forms."""

import numpy as np
import pytest

from aerpaw_cmp.compare.level import detection_floor_db, nearest_points
from aerpaw_cmp.compare.referee import level_card, measured_thresholds
from aerpaw_cmp.compare.statistics import paired_difference

N = 4000
ALL = np.ones(N, dtype=bool)


def series(seed: int = 3) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    time = np.arange(N) * 10.0  # farther apart than the window of means
    level = rng.normal(-80.0, 6.0, N)
    return time, level + rng.normal(0.0, 2.0, N), level


def test_card_of_a_shifted_prediction_with_a_true_band() -> None:
    time, measured, level = series()
    card = level_card(time, measured, {"level": level - 5.0, "sd_db": np.full(N, np.hypot(2.0, 5.0))}, ALL, (-80.0,))
    error = measured - level + 5.0
    assert card["bias_db"] == pytest.approx(error.mean(), abs=1e-9)
    assert card["rmse_db"] == pytest.approx(np.sqrt(np.mean(error**2)), abs=1e-9)
    assert card["offset_db"] == pytest.approx(-error.mean(), abs=1e-9)
    assert card["rmse_offset_db"] == pytest.approx(2.0, abs=0.1)
    assert card["rmse_1s_db"] == pytest.approx(error.std(), abs=1e-9)  # one sample per window
    assert card["correlation"] == pytest.approx(6.0 / np.hypot(6.0, 2.0), abs=0.01)
    assert card["slope"] == pytest.approx(1.0, abs=0.03)
    (share,) = card["exceedance"]
    assert share["measured"] == pytest.approx(0.5, abs=0.03)
    assert share["predicted"] == pytest.approx(
        0.5 - 0.298, abs=0.03
    )  # 5 / 6 of a standard deviation: Phi(0.833) = 0.798


def test_means_over_a_second_have_their_own_offset() -> None:
    """The mean power of Rayleigh fading is 2.5 dB above its mean level: no error of the predicted means."""
    rng = np.random.default_rng(4)
    time, fading_db = np.arange(20_000) / 400.0, 10.0 * np.log10(rng.exponential(size=20_000))
    card = level_card(time, -80.0 + fading_db, {"level": np.full(20_000, -80.0)}, np.full(20_000, True))
    assert card["rmse_offset_db"] == pytest.approx(5.57, abs=0.15)
    assert card["rmse_1s_db"] < 0.4  # 400 draws: 4.34 / 20 dB


def test_crps_and_coverage_of_a_calibrated_normal_band() -> None:
    time, measured, level = series()
    card = level_card(time, measured, {"level": level, "sd_db": np.full(N, 2.0)}, ALL)
    assert card["crps_db"] == pytest.approx(
        2.0 / np.sqrt(np.pi), rel=0.03
    )  # expected CRPS of N(0, sd) is sd / sqrt(pi)
    assert card["coverage_90"] == pytest.approx(0.9, abs=0.015)
    band = {"level": level, "q05_db": level - 1.0, "q95_db": level + 1.0}
    assert level_card(time, measured, band, ALL)["coverage_90"] == pytest.approx(0.383, abs=0.02)  # half a sd


def test_a_receiver_that_loses_its_lock_is_scored_by_both_parts_of_its_distribution() -> None:
    rng = np.random.default_rng(5)
    heard = rng.random(N) < 0.7
    measured = np.where(heard, rng.normal(-80.0, 2.0, N), rng.normal(-110.0, 1.0, N))
    one, time = np.ones(N), np.arange(N) * 10.0
    stated = {"level": -81.0 * one, "sd_db": 14.0 * one}
    lock = {"p_lock": 0.7 * one, "locked_db": -80.0 * one, "lost_db": -110.0 * one}
    lock |= {"locked_sd_db": 2.0 * one, "lost_sd_db": one}
    normal, mixed = (level_card(time, measured, stated | known, ALL) for known in ({}, lock))
    # a second route to the number: CRPS = E|X - y| - E|X - X'| / 2, with draws of the forecast
    draws = np.where(rng.random((2, N)) < 0.7, rng.normal(-80.0, 2.0, (2, N)), rng.normal(-110.0, 1.0, (2, N)))
    expected = np.abs(draws[0] - measured).mean() - 0.5 * np.abs(draws[0] - draws[1]).mean()
    assert mixed["crps_db"] == pytest.approx(expected, rel=0.05)
    assert normal["crps_db"] is not None
    assert mixed["crps_db"] < normal["crps_db"] - 0.2
    assert mixed["coverage_90"] == pytest.approx(0.9, abs=0.02)


def test_relative_levels_have_no_bias_and_exceed_after_the_offset() -> None:
    time, measured, level = series()
    card = level_card(time, measured, {"level": level + 140.0}, ALL, (-80.0,), absolute=False)
    assert (card["bias_db"], card["rmse_db"], card["crps_db"], card["coverage_90"]) == (None, None, None, None)
    assert card["rmse_offset_db"] == pytest.approx(2.0, abs=0.1)
    assert card["exceedance"][0]["predicted"] == pytest.approx(0.5, abs=0.03)


def test_outages_on_either_side_are_counted_and_lie_below_any_threshold() -> None:
    time, measured, level = series()
    measured[:100], level[50:300] = np.nan, np.nan
    card = level_card(time, measured, {"level": level}, ALL, (-200.0,))
    assert (card["outages_missed"], card["outages_invented"], card["n"]) == (50, 200, N - 300)
    assert card["exceedance"][0]["measured"] == pytest.approx(1.0 - 100 / N)
    assert card["exceedance"][0]["predicted"] == pytest.approx(1.0 - 250 / N)


def test_floor_is_the_lowest_level_if_it_is_repeated() -> None:
    level = np.linspace(-120.0, -60.0, 600)
    assert detection_floor_db(level) is None
    assert detection_floor_db(np.maximum(level, -110.0)) == -110.0
    dithered = np.maximum(level, np.linspace(-110.0, -109.96, 600))
    assert detection_floor_db(dithered) is None
    assert detection_floor_db(dithered, 0.05) == pytest.approx(-110.0, abs=0.01)
    assert detection_floor_db(np.full(50, -90.0)) is None
    assert detection_floor_db(np.full(3, np.nan)) is None


def test_thresholds_are_those_of_an_snr_or_measured_deciles() -> None:
    assert measured_thresholds(np.array([1.0]), ratio=True) == (0.0, 10.0, 20.0)
    assert measured_thresholds(np.linspace(-100.0, 0.0, 101), ratio=False) == (-90.0, -50.0, -10.0)
    assert measured_thresholds(np.array([np.nan]), ratio=False) == ()


def test_a_constant_prediction_has_no_correlation_and_no_slope() -> None:
    time, measured, _ = series()
    rounded = np.full(N, -80.0) + np.resize([0.0, 1.4e-14], N)
    card = level_card(time, measured, {"level": rounded}, ALL)
    assert np.isnan(card["correlation"])
    assert np.isnan(card["slope"])


def test_nearest_points_by_trying_all() -> None:
    rng = np.random.default_rng(11)
    points, samples = rng.uniform(0.0, 60.0, (80, 3)), rng.uniform(0.0, 60.0, (50, 3))
    samples[3, 1] = np.nan
    apart_m = np.linalg.norm(samples[:, None] - points, axis=2)
    index, near = nearest_points(samples, points, 8.0)
    assert near.tolist() == [bool(np.nanmin(row, initial=np.inf) <= 8.0) for row in apart_m]
    assert 5 < near.sum() < 45
    assert index[near].tolist() == np.argmin(apart_m[near], axis=1).tolist()


def test_a_point_of_another_heading_is_not_near() -> None:
    """Four headings are predicted at one position.

    A sample is compared with the heading that is within 45 degrees of its own.
    """
    points, yaw = np.zeros((4, 3)), np.array([0.0, 90.0, 180.0, 270.0])
    samples, heading = np.full((4, 3), 1.0), np.array([100.0, 350.0, 44.0, np.nan])
    index, near = nearest_points(samples, points, 15.0, (heading, yaw))
    assert index[:3].tolist() == [1, 0, 0]
    assert near.tolist() == [True, True, True, False]
    _, near = nearest_points(samples, points[:1], 15.0, (heading, yaw[:1]))
    assert near.tolist() == [False, True, True, False]
    _, near = nearest_points(np.array([[0.0, 0.0, 14.9], [0.0, 0.0, 15.1]]), points, 15.0)
    assert near.tolist() == [True, False]


def test_crps_of_single_samples_in_closed_form() -> None:
    """The CRPS of N(0, s) at its mean is s (sqrt 2 - 1) / sqrt pi.

    Far from the mean it is the distance minus s / sqrt pi.
    """
    time, level = np.zeros(1), np.zeros(1)
    for measured, crps in ((0.0, 3.0 * (np.sqrt(2.0) - 1.0) / np.sqrt(np.pi)), (90.0, 90.0 - 3.0 / np.sqrt(np.pi))):
        card = level_card(time, np.array([measured]), {"level": level, "sd_db": np.full(1, 3.0)}, ALL[:1])
        assert card["crps_db"] == pytest.approx(crps, abs=1e-9)


def test_a_paired_difference_in_closed_form() -> None:
    error = np.random.default_rng(2).normal(0.0, 3.0, 2000)
    error -= error.mean()
    pair = paired_difference(2.0 * error, error)
    assert pair.difference_db == pytest.approx(np.sqrt(np.mean(error**2)), abs=1e-9)
    assert pair.verdict == "worse"
    assert paired_difference(error, error + 4.0).difference_db == pytest.approx(0.0, abs=1e-9)  # offsets are free
    rounded = paired_difference(error, error * (1.0 + 1e-15))
    assert (rounded.difference_ci95_db, rounded.verdict) == ((0.0, 0.0), "not significant")
