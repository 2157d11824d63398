"""Scores of rank forecasts."""

import numpy as np
import pytest

from aerpaw_cmp.compare.rank import one_hot
from aerpaw_cmp.compare.receiver import brier_losses, constant_forecast, log_losses, score_forecast
from aerpaw_cmp.compare.statistics import autocorrelation, bootstrap_means, interval


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


def test_every_interval_is_that_of_blocks_of_the_longest_memory():
    """By hand: the draws of each number, of one bootstrap whose blocks remember as long as any of the three sequences."""
    rng, rank = np.random.default_rng(5), ranks(600, 4)
    p = rng.dirichlet([2, 5, 3, 1], 600)
    p[::2] = p[1::2]
    choice, constant = np.where(rng.random(600) < 0.4, rank, p.argmax(axis=1) + 1), np.array([0.1, 0.4, 0.3, 0.2])
    score = score_forecast(rank, p, choice, constant, replicates=200)
    row = np.arange(600)
    log, flat = -np.log(p[row, rank - 1]), -np.log(constant[rank - 1])
    right = (rank == choice).astype(float)
    longest = max((autocorrelation(c) for c in (right, log, log - flat)), key=lambda memory: memory.block_length)
    assert longest.block_length > 1

    def means(*columns):
        return bootstrap_means(np.column_stack(columns), longest.block_length, replicates=200)

    share, expected = one_hot(rank).mean(axis=0), p.mean(axis=0)
    drawn_share, drawn_choice, drawn_p = means(one_hot(rank)), means(one_hot(choice)), means(p)
    luck = (drawn_share * drawn_choice).sum(axis=1)
    kappa = (means(right)[:, 0] - luck) / (1.0 - luck)
    chance = share @ one_hot(choice).mean(axis=0)
    values = {
        "kappa": ((right.mean() - chance) / (1 - chance), kappa, (-1.0, 1.0), score.kappa_ci95),
        "log_score": (log.mean(), means(log)[:, 0], (0.0, np.inf), score.log_score_ci95),
        "total_variation_expected": (
            np.abs(share - expected).sum() / 2, np.abs(drawn_share - drawn_p).sum(axis=1) / 2, (0.0, 1.0),
            score.total_variation_ci95,
        ),
    }  # fmt: skip
    for name, (value, drawn, bounds, ends) in values.items():
        assert getattr(score, name) == pytest.approx(value), name
        assert ends == pytest.approx(interval(value, drawn, longest, bounds=bounds)), name
    gain = (log - flat).mean()
    assert score.log_score_difference_ci95 == pytest.approx(interval(gain, means(log - flat)[:, 0], longest))
    assert score.log_score_gain == pytest.approx(-gain / flat.mean())
    assert score.constant_log_score == pytest.approx(flat.mean())
    assert (score.majority_agreement, score.agreement) == pytest.approx((share.max(), right.mean()))
    assert log_losses(np.array([[0.0, 1.0]]), np.array([1]))[0] == pytest.approx(-np.log(1e-6))
    assert constant_forecast([1.0, np.nan, 0.0, 3.0, 3.0]) == pytest.approx(np.array([2, 1, 3, 1]) / 7)
