"""Scores of rank forecasts."""

import numpy as np
import pytest

from aerpaw_cmp.compare.rank import one_hot
from aerpaw_cmp.compare.receiver import brier_losses, constant_forecast, log_losses, score_forecast
from aerpaw_cmp.compare.statistics import mean_draws


def ranks(n=400, seed=1):
    return np.repeat(np.random.default_rng(seed).choice([1, 2, 3, 4], n // 4, p=[0.1, 0.5, 0.3, 0.1]), 4)


def test_both_scores_are_proper():
    """No forecast scores better than the probabilities from which the ranks were drawn."""
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
    assert score.total_variation_expected == pytest.approx(np.abs(one_hot(rank).mean(axis=0) - constant).sum() / 2)


def test_samples_without_report_or_forecast_take_no_part():
    rank = np.array([1.0, 2.0, np.nan, 2.0, 3.0] * 10)
    p = np.tile([0.25] * 4, (50, 1))
    p[3::5] = np.nan
    score = score_forecast(rank, p, np.where(np.isnan(p[:, 0]), 0, 2), np.full(4, 0.25))
    assert score.n == 30
    # the reports that count are 1, 2 and 3, a third each: rank 4 is expected with a quarter and never reported
    assert score.total_variation_expected == pytest.approx(1 / 4)
    assert np.isnan(score_forecast(rank, np.full((50, 4), np.nan), np.zeros(50), np.full(4, 0.25)).kappa)


def test_every_interval_is_that_of_the_influence_of_the_samples():
    """The influence of a sample is the change without it, and the mean influence has the interval of the score."""
    rng, rank = np.random.default_rng(5), ranks(600, 4)
    p = rng.dirichlet([2, 5, 3, 1], 600)
    p[::2] = p[1::2]
    choice, constant = np.where(rng.random(600) < 0.4, rank, p.argmax(axis=1) + 1), np.array([0.1, 0.4, 0.3, 0.2])
    score = score_forecast(rank, p, choice, constant)
    row = np.arange(600)
    log, flat = -np.log(p[row, rank - 1]), -np.log(constant[rank - 1])
    right = (rank == choice).astype(float)

    def kappa(some):
        luck = one_hot(rank)[some].mean(axis=0) @ one_hot(choice)[some].mean(axis=0)
        return (right[some].mean() - luck) / (1.0 - luck)

    numbers = {
        "kappa": kappa,
        "log_score": lambda some: log[some].mean(),
        "total_variation_expected": lambda some: 0.5 * np.abs((one_hot(rank) - p)[some].mean(axis=0)).sum(),
        "log_score_difference": lambda some: (log - flat)[some].mean(),
    }
    for name, number in numbers.items():
        value = number(row)
        influence = np.array([599.0 * (value - number(row != left)) for left in row])
        ends = getattr(score, f"{name.replace('_expected', '')}_ci95")
        assert ends == pytest.approx(
            np.quantile(value + mean_draws(influence, "influence"), [0.025, 0.975]), rel=5e-3
        ), name
        assert getattr(score, name, value) == pytest.approx(value), name
    gain = (log - flat).mean()
    assert score.log_score_gain == pytest.approx(-gain / flat.mean())
    assert score.constant_log_score == pytest.approx(flat.mean())
    assert (score.majority_agreement, score.agreement) == pytest.approx(
        (one_hot(rank).mean(axis=0).max(), right.mean())
    )
    assert log_losses(np.array([[0.0, 1.0]]), np.array([1]))[0] == pytest.approx(-np.log(1e-6))
    assert constant_forecast([1.0, np.nan, 0.0, 3.0, 3.0]) == pytest.approx(np.array([2, 1, 3, 1]) / 7)
