"""Scores: closed forms, no leak from what is held out, honest intervals on simulated fields."""

import numpy as np
import pytest
from scipy.stats import norm

from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.maps import evaluate
from aerpaw_cmp.maps.evaluate import IndexInterpolation, InverseDistance, ServingTowerMean
from aerpaw_cmp.maps.grid import Grid
from aerpaw_cmp.maps.kriging import OrdinaryKriging


def exponential(d):
    return np.exp(-d / 120.0)


def simulated_field(points, seed, fields=1, noise=0.0):
    """Gaussian field with unit variance and the exponential correlation, by Cholesky."""
    far = np.linalg.norm(points[:, None] - points[None], axis=-1)
    root = np.linalg.cholesky((1 - noise) * exponential(far) + noise * np.eye(len(points)))
    return root @ np.random.default_rng(seed).normal(size=(len(points), fields))


GRID = Grid.over_area((0.0, 600.0, 0.0, 450.0))


class Spy:
    """A method that predicts the mean of its samples, and records them."""

    def __init__(self):
        self.seen = []

    def fit(self, points_m, values):
        self.points, self.values = np.asarray(points_m), np.asarray(values)
        self.seen.append(self.points)
        return self

    def predict(self, targets_m):
        mean = np.broadcast_to(self.values.mean(axis=0), (len(targets_m), self.values.shape[1])).copy()
        return mean, np.ones_like(mean)

    def leave_one_out(self):
        n = len(self.values)
        return (self.values.sum(axis=0) - self.values) / (n - 1), np.ones_like(self.values)


def test_score_closed_form():
    result = evaluate.score([[1.0, 2.0], [np.nan, 4.0], [3.0, np.nan]], [[2.0, np.nan], [9.0, 2.0], [0.0, 1.0]])
    assert result.mae.tolist() == [2.0, 2.0]
    assert result.rmse.tolist() == [np.sqrt(5.0), 2.0]
    assert result.n.tolist() == [2, 1]
    nothing = evaluate.score([np.nan], [1.0])
    assert np.isnan(nothing.mae)
    with pytest.raises(UsageError, match="shape"):
        evaluate.score([1.0], [1.0, 2.0])


def test_leave_one_out_keeps_altitude_and_k():
    values = np.random.default_rng(1).normal(size=(len(GRID), 3, 2))
    table = {
        n: evaluate.leave_one_out(m, GRID.points_m, values)
        for n, m in (("mean", Spy()), ("nearest", InverseDistance(neighbours=1)))
    }
    assert table["nearest"].mae.shape == (3, 2)
    n = len(GRID)
    expected = np.abs((values.sum(axis=0) - values) / (n - 1) - values).mean(axis=0)
    np.testing.assert_allclose(table["mean"].mae, expected, rtol=1e-12)


def test_blocks_never_train_on_themselves():
    spy = Spy()
    result = evaluate.blocked(spy, GRID.points_m, np.zeros((len(GRID), 1)), 150.0)
    assert len(spy.seen) == 4 * 3
    assert result.n.tolist() == [len(GRID)]
    corner = GRID.points_m.min(axis=0)
    blocks = {tuple(b) for b in np.floor((GRID.points_m - corner) / 150.0 + 1e-9).astype(int).tolist()}
    missing = [
        blocks - {tuple(b) for b in np.floor((seen - corner) / 150.0 + 1e-9).astype(int).tolist()} for seen in spy.seen
    ]
    assert all(len(m) == 1 for m in missing)
    assert set.union(*missing) == blocks


def test_kriging_wins_where_its_model_holds_and_its_variance_is_honest():
    """A Gaussian field with the model's correlation: best linear predictor, calibrated intervals."""
    values = simulated_field(GRID.points_m, 2, fields=40, noise=0.1)
    model = OrdinaryKriging(lambda d: 0.9 * exponential(d))
    models = {
        "kriging": model, "idw": InverseDistance(), "nearest": InverseDistance(neighbours=1), "spline": IndexInterpolation("spline", GRID),
        "makima": IndexInterpolation("makima", GRID), "tower": ServingTowerMean([[100.0, 100.0], [500.0, 400.0]]),
    }  # fmt: skip
    table = {name: evaluate.leave_one_out(predictor, GRID.points_m, values) for name, predictor in models.items()}
    rmse = {name: float(s.rmse.mean()) for name, s in table.items()}
    assert min(rmse, key=lambda name: rmse[name]) == "kriging", rmse
    estimate, variance = model.fit(GRID.points_m, values).leave_one_out()
    off = (values - estimate) / np.sqrt(variance / model.sill_)
    assert np.mean(off**2) == pytest.approx(1.0, abs=0.05)
    for share in (0.5, 0.9, 0.95):
        assert np.mean(np.abs(off) <= norm.ppf((1 + share) / 2)) == pytest.approx(share, abs=0.02)


def test_blocked_is_harder_than_leave_one_out():
    values = simulated_field(GRID.points_m, 5, fields=10)
    model = OrdinaryKriging(exponential, outside="nearest")
    near = evaluate.leave_one_out(model, GRID.points_m, values).mae.mean()
    blocked = evaluate.blocked(model, GRID.points_m, values, 200.0).mae.mean()
    assert blocked > 1.3 * near
