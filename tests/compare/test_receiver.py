"""A receiver learned from ranks."""

import numpy as np
import pytest

from aerpaw_cmp.common.errors import InputError
from aerpaw_cmp.common.jsonable import json_safe
from aerpaw_cmp.compare import receiver as receiving
from aerpaw_cmp.compare.rank import cohen_kappa
from aerpaw_cmp.compare.receiver import (
    Receiver,
    choose_features,
    decide,
    decision_weights,
    fit_mixture,
    log_losses,
    mixture_loss,
    out_of_group,
    sector_groups,
    stream_features,
    time_means,
)


def planted(n=1200, seed=2):
    """Return features and ranks drawn from a known regression, in groups of equal size."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(n, 4)) * [6.0, 5.0, 4.0, 8.0] - [10.0, 20.0, 30.0, 80.0]
    z = (x - x.mean(axis=0)) / x.std(axis=0)
    score = np.stack([-1.5 - z[:, 0], 1.0 + 0 * z[:, 0], z[:, 0] + 0.8 * z[:, 1], -1.0 + 1.5 * z[:, 2]], axis=1)
    p = np.exp(score) / np.exp(score).sum(axis=1, keepdims=True)
    rank = 1 + (rng.random(n)[:, None] > np.cumsum(p, axis=1)).sum(axis=1)
    return x, rank, p, np.arange(n) * 8 // n


def fit(x, rank, groups, **how):
    """The receiver of one geometry."""
    return fit_mixture(x[None], rank, groups, **how).members[0]


def test_features_are_ratios_and_level_and_scale_only_moves_the_level():
    h = np.random.default_rng(0).normal(size=(5, 4, 4, 2)) @ [1, 1j]
    features, scaled = (stream_features(np.linalg.svd(m, compute_uv=False)) for m in (h, 10.0 * h))
    np.testing.assert_allclose(scaled - features, np.tile([0.0, 0.0, 0.0, 20.0], (5, 1)), atol=1e-9)
    assert np.isnan(stream_features([[0.0, 0.0, 0.0, 0.0], [np.inf, 1.0, 0.0, 0.0], [np.nan] * 4])).all()
    assert stream_features([5.0, 0.5, 0.05, 1e-9]) == pytest.approx([-20.0, -40.0, -40.0, 20 * np.log10(5.0)])


def test_probabilities_come_near_the_planted_ones():
    x, rank, truth, groups = planted(6000)
    p = fit(x, rank, groups, penalties=(0.1,)).probabilities(x)
    assert np.abs(p - truth).mean() < 0.02
    assert p.sum(axis=1) == pytest.approx(1.0)


@pytest.mark.parametrize(("penalty", "steep"), [(0.3, 1.0), (5.0, 1.0), (1e-3, 1.0), (0.1, 40.0)])
def test_no_step_lessens_the_penalised_loss(penalty, steep):
    """The gradient at the solution is zero, with a thousandth of the penalty for the constant.

    Features that separate the ranks completely need short steps.
    """
    x, rank, _, groups = planted(600)
    x[:, 1] = np.where(rank > 2, steep, -steep) * np.abs(x[:, 1])
    x[:, 3] = 7.0  # says nothing, has no spread
    model = fit(x, rank, groups, penalties=(penalty,))
    columns = np.column_stack([np.ones(600), (x - model.mean) / model.scale])
    slope = (model.probabilities(x) - np.eye(4)[rank - 1]).T @ columns
    slope += penalty * np.array([1e-3, 1, 1, 1, 1]) * model.coefficient
    assert np.abs(slope).max() < 1e-4
    assert (model.scale[3], model.n, model.penalty) == (1.0, 600, penalty)
    np.testing.assert_allclose(model.scale[:3], x.std(axis=0)[:3])


def test_penalty_and_loss_are_those_of_sectors_left_out(monkeypatch):
    x, rank, _, groups = planted(400)
    both, row = np.stack([x, x[:, ::-1] ** 3]), np.arange(400)
    loss = [
        -np.log(np.mean([out_of_group(features, rank, groups, p) for features in both], axis=0)[row, rank - 1]).mean()
        for p in (0.01, 3.0, 10.0, 1000.0)
    ]
    best = (0.01, 3.0, 10.0, 1000.0)[int(np.argmin(loss))]
    assert {m.penalty for m in fit_mixture(both, rank, groups, penalties=(1000.0, 0.01, 10.0, 3.0)).members} == {best}
    assert mixture_loss(both, rank, groups) == pytest.approx(loss[2], rel=1e-9)
    several = np.stack([x, x[:, ::-1], np.roll(x, 7, axis=0), 2.0 * x])
    choice = choose_features(several, rank, groups, finalists=3)
    assert (len(choice.order), choice.tied[0]) == (3, choice.order[0])
    scores = [-np.log(out_of_group(several[i], rank, groups, 10.0)[row, rank - 1]).mean() for i in choice.order]
    assert np.round(scores, 9).tolist() == sorted(np.round(scores, 9))
    monkeypatch.setattr(receiving, "_HELD", 1)
    again = choose_features(several, rank, groups, finalists=3)
    assert (again.tied, list(again.order)) == (choice.tied, list(choice.order))


def test_weights_of_the_decision_are_the_best_of_their_grid_and_the_smallest_of_equals():
    rng = np.random.default_rng(12)
    rank = rng.choice([1, 2, 3, 4], 300, p=[0.2, 0.5, 0.2, 0.1])
    p = rng.dirichlet([1, 2, 1, 0.7], 300) + 0.3 * np.eye(4)[rank - 1]
    tried = {}
    for below in range(-3, 13):
        for above in range(-3, 13):
            weight = np.exp(np.array([below, 0, above, above]) / 10)
            tried[below, above] = cohen_kappa(rank, np.argmax(p * weight, axis=1) + 1)
    best = max(tried.values())
    nearest = min((abs(b), abs(a), b, a) for (b, a), kappa in tried.items() if kappa >= best - 1e-9)
    weights = receiving._kappa_weights(p, rank)
    assert 10 * np.log(weights) == pytest.approx([nearest[2], 0, nearest[3], nearest[3]], abs=1e-9)


@pytest.mark.parametrize(("samples", "enough"), [(49, False), (50, True)])
def test_fifty_samples_in_two_sectors_are_enough(samples, enough):
    x, rank, _, groups = planted(50)
    groups = groups // 4  # two
    known = np.where(np.arange(50) < samples, rank, np.nan)
    if enough:
        assert fit(x, known, groups).n == 50
    else:
        with pytest.raises(InputError, match="49 samples"):
            fit(x, known, groups)
    with pytest.raises(InputError, match="one sector"):
        fit(x, rank, np.zeros(50, dtype=int))


def test_regression_equals_the_one_of_scikit_learn():
    linear_model = pytest.importorskip("sklearn.linear_model")
    x, rank, _, groups = planted(600)
    model = fit(x, rank, groups, penalties=(5.0,))
    z = (x - model.mean) / model.scale
    reference = linear_model.LogisticRegression(C=1.0 / 5.0, tol=1e-10, max_iter=5000).fit(z, rank)
    np.testing.assert_allclose(model.coefficient[:, 1:], reference.coef_, atol=2e-4)
    np.testing.assert_allclose(model.probabilities(x), reference.predict_proba(z), atol=2e-4)


def test_what_is_left_out_has_no_part_in_its_forecast():
    x, rank, _, groups = planted(400)
    changed = np.where(groups == 3, 5 - rank, rank)
    before, after = (out_of_group(x, r, groups, 3.0) for r in (rank, changed))
    np.testing.assert_array_equal(before[groups == 3], after[groups == 3])
    assert np.abs(before[groups != 3] - after[groups != 3]).max() > 0.01


def test_noise_is_told_as_the_constant_forecast():
    x, rank, _, groups = planted()
    shuffled = np.random.default_rng(5).permutation(rank)
    receiver = fit(x, shuffled, groups)
    p = receiver.probabilities(x)
    constant = -np.log(receiver.constant[shuffled - 1]).mean()
    assert log_losses(p, shuffled).mean() > 0.97 * constant


def test_decision_for_kappa_says_the_rare_ranks_too():
    x, rank, _, groups = planted()
    receiver = fit_mixture(x[None, ::2], rank[::2], groups[::2])
    p = receiver.probabilities(x[None, 1::2])
    assert cohen_kappa(rank[1::2], receiver.decide(p)) > cohen_kappa(rank[1::2], p.argmax(axis=1) + 1) - 0.01
    assert receiver.decide(np.full((1, 4), np.nan)).tolist() == [0]


def test_a_receiver_survives_its_file():
    x, rank, _, groups = planted(300)
    receiver = fit(x, rank, groups)
    again = Receiver.from_dict(json_safe(receiver))
    np.testing.assert_array_equal(again.probabilities(x), receiver.probabilities(x))
    with pytest.raises(ValueError, match="without penalty"):
        Receiver.from_dict({k: v for k, v in json_safe(receiver).items() if k != "penalty"})


@pytest.mark.parametrize("rank", [np.full(300, 2), np.r_[np.full(280, np.nan), np.tile([1, 2], 10)]])
def test_nothing_to_learn_from_is_one_message(rank):
    with pytest.raises(InputError, match="to fit a receiver"):
        fit(np.zeros((300, 4)), rank, np.arange(300) % 8)


def test_the_planted_geometry_is_found_and_its_double_is_told_as_tied():
    x, rank, _, groups = planted()
    rng = np.random.default_rng(9)
    worse = [rng.permutation(x) for _ in range(3)]
    choice = choose_features(np.stack([*worse, x, 2.0 * x]), rank, groups, finalists=5)
    assert choice.order[0] in (3, 4)
    assert sorted(choice.tied) == [3, 4]


def test_mixture_is_the_mean_of_its_members():
    x, rank, _, groups = planted(300)
    mixture = fit_mixture(np.stack([x, x]), rank, groups, penalties=(3.0,))
    member = fit(x, rank, groups, penalties=(3.0,))
    np.testing.assert_allclose(mixture.probabilities(np.stack([x, x])), member.probabilities(x), atol=1e-9)


def test_sectors_are_contiguous_directions_of_equal_share():
    rng = np.random.default_rng(1)
    azimuth = rng.uniform(2.5, 4.5, 800)  # across the cut of arctan2
    tower = np.array([300.0, -200.0, 10.0])
    at = tower + np.column_stack([100 * np.cos(azimuth), 100 * np.sin(azimuth), np.full(800, 30.0)])
    group = sector_groups(at, tower)
    assert np.bincount(group).tolist() == [100] * 8
    assert (np.diff(group[np.argsort(azimuth)]) != 0).sum() == 7


def test_weights_of_the_decision_must_earn_their_kappa() -> None:
    rng = np.random.default_rng(3)
    groups = np.repeat(np.arange(4), 200)
    rare = rng.random(800) < 0.25
    rank = np.where(rare, 3, 2)
    # a forecast that knows but is too timid: the rare rank is never the most probable one
    p3 = np.where(rng.random(800) < 0.9, np.where(rare, 0.4, 0.1), 0.2)
    timid = np.stack([np.full(800, 0.01), 0.98 - p3, p3, np.full(800, 0.01)], axis=1)
    weight = decision_weights(timid, rank, groups)
    assert weight[2] > weight[1]
    assert cohen_kappa(rank, decide(timid, weight)) > 0.8
    # a forecast of nothing: what suits seven groups suits the eighth no better
    p3 = rng.uniform(0.1, 0.45, 800)
    empty = np.stack([np.full(800, 0.01), 0.98 - p3, p3, np.full(800, 0.01)], axis=1)
    left = [decision_weights(empty, rng.permutation(rank), groups) for _ in range(4)]
    assert any(np.ptp(w) == 0 for w in left)


def test_means_in_time_are_those_of_a_loop() -> None:
    rng = np.random.default_rng(4)
    time = np.sort(rng.uniform(0, 60, 80))
    time[40:] += 30.0  # a gap
    order = rng.permutation(80)
    power = rng.exponential(size=(2, 80, 3))
    rows = np.arange(80) * 0.1  # both ends of a window are included, regardless of rounding
    ends = time_means(power, rows, 0.0, 0.6)[0, :, 0]
    np.testing.assert_allclose(ends, [power[0, max(i - 3, 0) : i + 4, 0].mean() for i in range(80)])
    for shift, average in ((0.0, 0.0), (3.0, 8.0), (-4.0, 5.0)):
        means = time_means(power[:, order], time[order], shift, average)
        for row, i in enumerate(order):
            near = np.abs(time - time[i] - shift) <= average / 2
            near = near if near.any() else np.arange(80) == np.abs(time - time[i] - shift).argmin()
            np.testing.assert_allclose(means[:, row], power[:, near].mean(axis=1))


def test_a_batch_of_features_equals_one_after_the_other():
    x, rank, _, groups = planted(300)
    both = np.stack([x, x[:, ::-1] * 2.0])
    together = out_of_group(both, rank, groups, 3.0)
    for i in (0, 1):
        np.testing.assert_allclose(together[i], out_of_group(both[i], rank, groups, 3.0), atol=1e-6)
