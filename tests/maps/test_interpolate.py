"""Baselines: scipy as second route, MATLAB's conventions for few points, order, ends and gaps."""

import numpy as np
import pytest
from scipy.interpolate import Akima1DInterpolator, CubicSpline

from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.maps.evaluate import IndexInterpolation, InverseDistance, ServingTowerMean, makima, spline
from aerpaw_cmp.maps.grid import Grid

RNG = np.random.default_rng(5)


def scipy_makima(x, y, at):
    if len(x) == 2:  # a line; SciPy up to 1.15 gives something else
        return y[0] + (y[1] - y[0]) * (at - x[0]) / (x[1] - x[0])
    return Akima1DInterpolator(x, y, method="makima", extrapolate=True)(at)


def scipy_spline(x, y, at):
    return CubicSpline(x, y, bc_type="not-a-knot", extrapolate=True)(at)


CURVES = pytest.mark.parametrize(
    ("ours", "theirs"), [(makima, scipy_makima), (spline, scipy_spline)], ids=["makima", "spline"]
)


@CURVES
@pytest.mark.parametrize("m", [2, 3, 4, 5, 20])
@pytest.mark.parametrize("where", ["inside", "before", "after", "knot"])
def test_curves_equal_scipy_everywhere(ours, theirs, m, where):
    x = np.cumsum(RNG.integers(1, 40, m)).astype(float)
    y = RNG.normal(size=(m, 3))
    at = {"inside": x.mean() + 0.3, "before": x[0] - 5.0, "after": x[-1] + 5.0, "knot": x[m // 2]}[where]
    np.testing.assert_allclose(ours(x[None], y[None], np.array([at]))[0], theirs(x, y, at), rtol=1e-9, atol=1e-9)


@CURVES
def test_order_of_samples_does_not_matter(ours, theirs):
    x = np.array([1.0, 4.0, 6.0, 7.0, 11.0, 30.0])
    y = RNG.normal(size=(6, 2))
    at = np.array([9.0])
    for order in (np.arange(6)[::-1], RNG.permutation(6)):
        np.testing.assert_array_equal(ours(x[None, order], y[None, order], at), ours(x[None], y[None], at))
    np.testing.assert_allclose(ours(x[None, ::-1], y[None, ::-1], at)[0], theirs(x, y, 9.0), rtol=1e-12)


def test_makima_does_not_overshoot_a_step_of_ranks():
    """MATLAB's reason for the modification: flat data stay flat next to a jump."""
    x = np.arange(8.0)
    y = np.array([1.0, 1, 1, 1, 2, 2, 2, 2])
    for at in np.linspace(0, 3, 13):
        assert makima(x[None], y[None, :, None], np.array([at]))[0, 0] == pytest.approx(1.0, abs=1e-12)
    assert abs(spline(x[None], y[None, :, None], np.array([2.5]))[0, 0] - 1.0) > 0.01


@CURVES
def test_one_sample_gives_its_value(ours, theirs):
    assert ours([[7.0]], [[[3.0]]], np.array([9.0])).tolist() == [[3.0]]


@CURVES
def test_equal_index_is_refused(ours, theirs):
    with pytest.raises(UsageError, match="same position index"):
        ours([[1.0, 1.0, 2.0]], np.zeros((1, 3, 1)), np.array([1.5]))


@pytest.mark.parametrize("kind", ["spline", "makima"])
def test_leave_one_out_on_a_grid_equals_a_plain_loop(kind):
    grid = Grid.over_area((0.0, 240.0, 0.0, 270.0))
    values = RNG.normal(size=(len(grid), 2))
    values[5, 0] = np.nan
    model = IndexInterpolation(kind, grid, neighbours=9, radius_m=70.0).fit(grid.points_m, values)
    estimate, variance = model.leave_one_out()
    assert np.isnan(variance).all()
    theirs = {"spline": scipy_spline, "makima": scipy_makima}[kind]
    points = grid.points_m
    for target in range(len(grid)):
        for field in range(2):
            offset = points - points[target]
            far = np.hypot(*offset.T)
            order = np.lexsort((offset[:, 0], offset[:, 1], np.round(far, 6)))
            near = [i for i in order if far[i] <= 70.0 and i != target and np.isfinite(values[i, field])][:9]
            x = np.sort(near)
            expected = theirs(x.astype(float), values[x, field], float(target))
            assert estimate[target, field] == pytest.approx(float(expected), rel=1e-9, abs=1e-9)


def test_nearest_follows_the_tie_rule():
    model = InverseDistance(neighbours=1).fit(
        [[30.0, 0.0], [-30.0, 0.0], [0.0, 30.0], [0.0, -30.0]], [1.0, 2.0, 3.0, 4.0]
    )
    assert model.predict([[0.0, 0.0]])[0].tolist() == [4.0]  # the southern one
    assert np.isnan(model.predict([[0.0, 500.0]])[0]).all()


def test_inverse_distance_closed_form_and_exactness():
    model = InverseDistance().fit([[10.0, 0.0], [-20.0, 0.0]], [1.0, 6.0])
    estimate, _ = model.predict([[0.0, 0.0], [10.0, 0.0]])
    assert estimate[0] == pytest.approx((1 / 100 * 1 + 1 / 400 * 6) / (1 / 100 + 1 / 400), rel=1e-14)
    assert estimate[1] == 1.0
    constant = InverseDistance().fit(RNG.uniform(0, 99, (30, 2)), np.full(30, 0.1))
    assert (constant.predict(RNG.uniform(0, 99, (50, 2)))[0] == 0.1).all()


def test_serving_tower_mean_leaves_the_sample_out():
    towers = [[0.0, 0.0, 10.0], [100.0, 0.0, 10.0]]
    points = np.array([[1.0, 0], [2.0, 0], [3.0, 0], [99.0, 0]])
    model = ServingTowerMean(towers).fit(points, [1.0, 2.0, np.nan, 9.0])
    assert model.predict([[10.0, 5.0], [90.0, 5.0]])[0].tolist() == [1.5, 9.0]
    left_out = model.leave_one_out()[0]
    assert left_out[:3].tolist() == [2.0, 1.0, 1.5]
    assert np.isnan(left_out[3])
