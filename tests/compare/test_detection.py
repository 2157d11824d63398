"""A level that is detected or lost: probabilities that are calibrated, and offsets with a floor."""

import numpy as np
import pytest
from scipy.special import expit

from aerpaw_cmp.common.units import BoolArray, FloatArray
from aerpaw_cmp.compare.level import (
    BASE_S,
    DetectionForecast,
    aligned_quality,
    floored_fit,
    learn_detection,
    score_detection,
)
from aerpaw_cmp.compare.receiver import out_of_group

FLOOR = -15.0


def _flight(offset_db: float = -40.0, n: int = 6000) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
    """Times, measured and simulated levels, and detections by a logistic threshold at the floor."""
    random = np.random.default_rng(3)
    time = np.arange(n) / 10.0
    simulated = -60.0 + 15.0 * np.sin(time / 17.0) + random.normal(0.0, 2.0, n)
    measured = simulated - offset_db + random.normal(0.0, 4.0, n)
    detected = random.random(n) < expit((simulated - offset_db - FLOOR) / 3.0)
    return time, measured, simulated, detected


def test_the_probability_is_calibrated_and_beats_the_constant() -> None:
    time, measured, simulated, detected = _flight()
    score = score_detection(time, measured, simulated, detected, floor_db=FLOOR, free_space_db=simulated)
    assert score is not None
    truth = expit((simulated + 40.0 - FLOOR) / 3.0)
    best = float(np.mean((truth - detected) ** 2))
    assert best < score.brier < 1.03 * best + 0.005
    share = detected.mean()
    assert score.constant_brier == pytest.approx(share * (1 - share))
    assert score.brier < 0.75 * score.constant_brier
    assert score.log_score < score.constant_log_score
    assert (score.n, score.n_detected) == (6000, int(detected.sum()))
    for said, seen, count in score.reliability:
        assert abs(said - seen) < 4.0 * np.sqrt(0.25 / count) + 0.02
    assert score.offset_db == pytest.approx(-40.0, abs=0.5)
    assert score.rmse_ci95_db[0] < score.rmse_db < score.rmse_ci95_db[1]


def test_a_level_that_says_nothing_gains_nothing() -> None:
    time, measured, simulated, detected = _flight()
    shuffled = np.random.default_rng(1).permutation(simulated)
    score = score_detection(time, measured, shuffled, detected, floor_db=FLOOR, free_space_db=shuffled)
    assert score is not None
    assert score.brier > 0.98 * score.constant_brier


@pytest.mark.parametrize("offset_db", [-40.0, 12.3])
def test_the_floored_offset_is_that_of_a_search_by_hand(offset_db: float) -> None:
    random = np.random.default_rng(4)
    simulated = random.normal(-50.0, 15.0, 400)
    measured = np.maximum(simulated - offset_db + random.normal(0.0, 3.0, 400), FLOOR)
    fit = floored_fit(measured, simulated, FLOOR)
    grid = np.arange(-600, 401) / 10.0
    by_hand = [np.sqrt(np.mean((measured - np.maximum(simulated - o, FLOOR)) ** 2)) for o in grid]
    assert fit.rmse_db == pytest.approx(min(by_hand), abs=1e-9)
    assert fit.offset_db == pytest.approx(grid[int(np.argmin(by_hand))])
    assert fit.at_edge is False
    free = floored_fit(measured, simulated, -500.0)
    assert free.offset_db == pytest.approx(np.mean(simulated - measured), abs=0.051)
    assert free.rmse_db == pytest.approx(np.sqrt(np.mean((simulated - measured - free.offset_db) ** 2)))


def _lock(seed: int, middle_db: float, n: int) -> tuple[FloatArray, BoolArray]:
    """Predicted levels of a flight about a middle, and when a receiver of 25 dB re -40, 3 dB a unit of odds, locks."""
    random = np.random.default_rng(seed)
    level = random.normal(middle_db, 8.0, n)
    return level, random.random(n) < expit((level + 65.0) / 3.0)


def test_other_flights_teach_when_the_receiver_locks() -> None:
    flights = [_lock(seed, middle, n) for seed, middle, n in ((1, -60.0, 4000), (2, -70.0, 1500), (3, -50.0, 9000))]
    forecast = learn_detection(flights)
    assert forecast is not None
    assert forecast.level_db == pytest.approx(-65.0, abs=0.5)
    assert forecast.per_db == pytest.approx(1.0 / 3.0, rel=0.06)
    assert forecast.share == pytest.approx(np.mean([seen.mean() for _, seen in flights]))
    level, detected = _lock(9, -68.0, 5000)
    truth = expit((level + 65.0) / 3.0)
    time, measured = np.arange(5000.0), np.where(detected, level, -30.0)
    for shift_db, least, most in ((0.0, 0.0, 0.003), (10.0, 0.05, 1.0)):  # nothing is fitted on this flight
        moved = DetectionForecast(level_db=forecast.level_db + shift_db, per_db=forecast.per_db, share=forecast.share)
        score = score_detection(time, measured, level, detected, floor_db=-65.0, free_space_db=level, forecast=moved)
        assert score is not None
        assert score.learned_on == "other flights"
        assert least < score.brier - float(np.mean((truth - detected) ** 2)) < most
        assert score.constant_brier == pytest.approx(detected.mean() * (1 - detected.mean()))


def test_nothing_is_learned_of_a_receiver_that_keeps_its_lock_or_locks_at_low_levels() -> None:
    level, detected = _lock(1, -60.0, 4000)
    assert learn_detection([(level, np.ones(4000, dtype=bool))]) is None
    assert learn_detection([(-level, detected)]) is None
    assert learn_detection([]) is None


@pytest.mark.parametrize("learned", [True, False])
def test_every_score_is_that_by_hand(learned: bool) -> None:
    time, measured, simulated, detected = _flight(n=400)
    time, free = time + 5.0, simulated + np.cos(time)
    simulated[7], time[9], measured[11] = np.nan, np.nan, np.nan
    forecast = DetectionForecast(level_db=-56.0, per_db=0.25, share=0.4) if learned else None
    score = score_detection(time, measured, simulated, detected, floor_db=FLOOR, free_space_db=free, forecast=forecast)
    assert score is not None
    ok = np.isfinite(simulated) & np.isfinite(time)
    seen, level = detected[ok], simulated[ok]
    if learned:
        forecast_p = 1.0 / (1.0 + np.exp(-0.25 * (level + 56.0)))
    else:  # tenths of the time, each predicted by the others
        tenth = np.minimum((time[ok] - 5.0) / 39.9 * 10.0, 9.0).astype(int)
        p = out_of_group(level[:, None], seen.astype(int) + 1, tenth, 1.0)
        forecast_p = p[:, 1] / (p[:, 0] + p[:, 1])
    constant = np.full(398, seen.mean())
    for p, brier, log in (
        (forecast_p, score.brier, score.log_score), (constant, score.constant_brier, score.constant_log_score)
    ):  # fmt: skip
        assert brier == pytest.approx(np.mean((p - seen) ** 2))
        assert log == pytest.approx(-np.mean(np.log(np.where(seen, p, 1.0 - p))))
    floored_db = np.maximum(np.nan_to_num(measured[ok], nan=FLOOR), FLOOR)
    error = floored_db - np.maximum(level - score.offset_db, FLOOR)
    assert (score.rmse_db, score.detected_rmse_db) == pytest.approx(
        (np.sqrt(np.mean(error**2)), np.sqrt(np.mean(error[seen] ** 2)))
    )
    assert score.free_space_rmse_db == pytest.approx(floored_fit(floored_db, free[ok], FLOOR).rmse_db)
    fifths = [(forecast_p >= k / 5) & (forecast_p < (k + 1) / 5) for k in range(5)]
    assert score.reliability == pytest.approx(
        [pytest.approx((forecast_p[g].mean(), seen[g].mean(), g.sum())) for g in fifths if g.any()]
    )


@pytest.mark.parametrize("rare", [49, 50])
def test_fifty_of_either_outcome_are_enough(rare: int) -> None:
    level, few = np.linspace(-90.0, -40.0, 300), np.arange(300) >= 300 - rare
    for detected in (few, ~few):
        scored = score_detection(np.arange(300.0), level, level, detected, floor_db=-80.0, free_space_db=level)
        assert (scored is not None) == (rare == 50)
    learned = learn_detection([(level, few), (level[:0], few[:0])])
    assert (learned is not None) == (rare == 50)
    if learned is not None:  # everything is separable: only the penalty of a thousandth keeps the slope finite
        slope, unit = learned.per_db * level.std(), (level - level.mean()) / level.std()
        over = learned.probability(level) - few
        assert over.mean() == pytest.approx(0.0, abs=1e-4)
        assert (over * unit).mean() + 2e-3 * slope == pytest.approx(0.0, abs=1e-4)


@pytest.mark.parametrize(("slow", "by_row"), [(1.4, False), (1.4, True), (1.1, False)])
def test_a_quality_ahead_of_its_power_is_taken_at_its_own_times(slow: float, by_row: bool) -> None:
    own = 7.0 + BASE_S * np.arange(300)
    time = 7.0 + slow * (own - 7.0)
    power, quality = np.sin(time), np.sin(time if by_row else own)
    aligned, shift = aligned_quality(time, power, quality)
    if by_row or slow == 1.1:  # rows agree, or are a second apart at most
        assert shift == 0.0
        assert aligned is quality
    else:
        assert shift == pytest.approx(0.4 * 0.032768 * 299)
        np.testing.assert_allclose(aligned[time <= own[-1]], power[time <= own[-1]], atol=1e-3)
        assert np.isnan(aligned[time > own[-1]]).all()
