"""Scores of rank forecasts."""

import numpy as np
import pytest

from aerpaw_cmp.compare.forecast import (
    brier_losses,
    constant_forecast,
    log_losses,
    score_forecast,
)
from aerpaw_cmp.compare.rank import one_hot


def ranks(n=400, seed=1):
    return np.repeat(np.random.default_rng(seed).choice([1, 2, 3, 4], n // 4, p=[0.1, 0.5, 0.3, 0.1]), 4)


def test_both_scores_are_proper():
    """Nobody does better than with the probabilities that the ranks were drawn from."""
    truth = np.array([0.1, 0.5, 0.3, 0.1])
    rng = np.random.default_rng(3)
    for _ in range(50):
        other = rng.dirichlet(np.ones(4))
        for losses in (log_losses, brier_losses):
            expected = [truth @ [losses(p[None], np.array([r]))[0] for r in (1, 2, 3, 4)] for p in (truth, other)]
            assert expected[0] <= expected[1] + 1e-12


def test_constant_forecast_gains_nothing_and_has_no_kappa():
    rank = ranks()
    constant = constant_forecast(rank)
    score = score_forecast(rank, np.tile(constant, (len(rank), 1)), np.full(len(rank), 2), constant)
    assert score.log_score_gain == pytest.approx(0.0)
    assert score.kappa == pytest.approx(0.0)
    assert score.agreement == score.majority_agreement == pytest.approx(np.mean(rank == 2))
    assert score.total_variation_expected == pytest.approx(score.constant_total_variation)


def test_perfect_forecast():
    rank = ranks()
    score = score_forecast(rank, one_hot(rank), rank, constant_forecast(rank))
    assert score.kappa == pytest.approx(1.0)
    assert score.log_score == pytest.approx(0.0, abs=1e-9)
    assert score.brier_score == 0.0
    assert score.total_variation_expected == 0.0
    assert score.log_score_difference_ci95[1] < 0.0


def test_samples_without_report_or_forecast_take_no_part():
    rank = np.array([1.0, 2.0, np.nan, 2.0, 3.0] * 10)
    p = np.tile([0.25] * 4, (50, 1))
    p[3::5] = np.nan
    score = score_forecast(rank, p, np.where(np.isnan(p[:, 0]), 0, 2), np.full(4, 0.25))
    assert score.n == 30
    assert score.measured_histogram.tolist() == pytest.approx([1 / 3, 1 / 3, 1 / 3, 0.0])
    assert score_forecast(rank, np.full((50, 4), np.nan), np.zeros(50), np.full(4, 0.25)).as_dict()["kappa"] is None


def test_intervals_of_the_expected_histogram_hold_it():
    rank = ranks()
    p = np.random.default_rng(0).dirichlet([2, 5, 3, 1], len(rank))
    score = score_forecast(rank, p, p.argmax(axis=1) + 1, constant_forecast(rank))
    for share, (low, high) in zip(score.expected_histogram, score.expected_histogram_ci95, strict=True):
        assert low <= share <= high


def test_lengths_must_match():
    with pytest.raises(ValueError, match="not in pairs"):
        score_forecast([1, 2], np.ones((3, 4)) / 4, [1, 2, 3], np.full(4, 0.25))


def test_each_interval_is_that_of_its_own_number():
    """Losses of two forecasts that differ by a constant: the interval of the difference has no width and lies there."""
    rank = ranks()
    constant = np.full(4, 0.25)
    better = np.full((len(rank), 4), 0.2)
    better[np.arange(len(rank)), rank - 1] = 0.4
    score = score_forecast(rank, better, rank, constant)
    assert score.log_score_difference_ci95 == pytest.approx([np.log(0.25 / 0.4)] * 2)
    assert score.log_score_ci95 == pytest.approx([-np.log(0.4)] * 2)
    assert score.brier_score == pytest.approx(0.6**2 + 3 * 0.2**2)
    assert score.kappa_ci95[1] == pytest.approx(1.0)
    for low_high, share in zip(score.expected_histogram_ci95, better.mean(axis=0), strict=True):
        assert low_high[0] <= share <= low_high[1]
