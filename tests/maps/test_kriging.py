"""Kriging target by target from its definition, PyKrige, fifty digits, closed forms, and where textbooks break."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.maps import kriging
from aerpaw_cmp.maps.grid import Grid
from aerpaw_cmp.maps.kriging import OrdinaryKriging
from aerpaw_cmp.maps.variogram import PAPER_BIEXPONENTIAL as PAPER


def exponential(d):
    return np.exp(-d / 120.0)


def scattered(n, seed, extent=600.0, dims=2):
    return np.random.default_rng(seed).uniform(0, extent, (n, dims))


def textbook(points, values, target, correlation, v2=1.0):
    """The paper's system (section VI-B) for one target, as written."""
    n = len(points)
    gamma = v2 * (1 - correlation(np.linalg.norm(points[:, None] - points[None], axis=-1)))
    np.fill_diagonal(gamma, 0.0)
    system = np.block([[gamma, np.ones((n, 1))], [np.ones((1, n)), np.zeros((1, 1))]])
    apart = np.linalg.norm(points - target, axis=-1)
    right = np.append(np.where(apart == 0, 0.0, v2 * (1 - correlation(apart))), 1.0)
    solution = np.linalg.solve(system, right)
    return solution[:n] @ values, solution @ right


def of_variance_one(values):
    """Scaled, so that the Kriging variance has the sill of the textbook."""
    return values / values.std(ddof=1)


def test_equals_pykrige_on_untied_data():
    """Moving neighbourhood of 20, an external implementation, 1e-9."""
    ok = pytest.importorskip("pykrige.ok")
    points, targets = scattered(300, 4, 1000.0), scattered(100, 5, 1000.0)
    values = of_variance_one(np.random.default_rng(6).normal(size=300))
    peer = ok.OrdinaryKriging(
        *points.T,
        values,
        variogram_model="custom",
        variogram_parameters=[0.0],
        variogram_function=lambda _, d: 1 - PAPER(d),
    )
    expected, expected_variance = peer.execute("points", *targets.T, backend="loop", n_closest_points=20)
    estimate, variance = OrdinaryKriging(PAPER, 20, np.inf).fit(points, values).predict(targets)
    np.testing.assert_allclose(estimate, np.asarray(expected), atol=1e-9, rtol=0)
    np.testing.assert_allclose(variance, np.asarray(expected_variance), atol=1e-9, rtol=0)


def test_shared_weights_on_a_grid_equal_the_textbook():
    grid = Grid.over_area((0.0, 300.0, 0.0, 360.0))
    points = grid.points_m
    values = of_variance_one(np.random.default_rng(16).integers(1, 4, len(grid)).astype(float))
    estimate, variance = OrdinaryKriging(PAPER, 12, 100.0).fit(points, values).leave_one_out()
    for i in range(len(grid)):
        offset = points - points[i]
        far = np.hypot(*offset.T)
        near = [
            j for j in np.lexsort((offset[:, 0], offset[:, 1], np.round(far, 6))) if far[j] <= 100.0 + 1e-6 and j != i
        ][:12]
        expected, expected_variance = textbook(points[near], values[near], points[i], PAPER)
        assert estimate[i] == pytest.approx(expected, abs=1e-11)
        assert variance[i] == pytest.approx(expected_variance, abs=1e-11)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 25), st.floats(-1e3, 1e3), st.floats(0.1, 50.0))
def test_properties(seed, m, shift, factor):
    """Weights sum to 1, and estimates are affine in the values.

    Neither moving the site nor the order of samples changes the estimates.
    """
    rng = np.random.default_rng(seed)
    points, targets, values = rng.uniform(0, 400, (40, 2)), rng.uniform(0, 400, (6, 2)), rng.normal(size=40)
    model = OrdinaryKriging(PAPER, m, 500.0).fit(points, values)
    rule = model.weights(targets)
    np.testing.assert_allclose(rule.weight.sum(axis=1), 1.0, atol=1e-12)
    assert (rule.variance >= 0).all()
    estimate, variance = model.predict(targets)
    other, other_variance = OrdinaryKriging(PAPER, m, 500.0).fit(points, shift + factor * values).predict(targets)
    np.testing.assert_allclose(other, shift + factor * estimate, atol=1e-9 * (abs(shift) + factor))
    np.testing.assert_allclose(other_variance, factor**2 * variance, rtol=1e-8)
    order = rng.permutation(40)
    moved = OrdinaryKriging(PAPER, m, 500.0).fit(points[order] + shift, values[order]).predict(targets + shift)
    np.testing.assert_allclose(moved[0], estimate, atol=1e-8)


def test_tied_neighbours_follow_the_rule_whatever_the_order():
    """Four samples at 30 m, two allowed: the southern, then the western one."""
    points = np.array([[0.0, 30.0], [30.0, 0.0], [-30.0, 0.0], [0.0, -30.0]])
    values = np.array([1.0, 2.0, 4.0, 8.0])
    for order in (np.arange(4), np.arange(4)[::-1], np.array([2, 0, 3, 1])):
        estimate, _ = OrdinaryKriging(exponential, 2).fit(points[order], values[order]).predict([[0.0, 0.0]])
        assert estimate[0] == pytest.approx(6.0, abs=1e-12)


def test_ties_survive_coordinates_that_are_not_exact():
    """Steps of 0.1 m are not binary numbers. Inner targets must still have one pattern."""
    grid = Grid.over_area((0.1, 3.1, 0.7, 3.7), 0.1)
    model = OrdinaryKriging(lambda d: np.exp(-d), 20, 1.0).fit(grid.points_m, np.arange(len(grid)))
    chosen = model._neighbours(grid.points_m, grid.points_m, np.arange(len(grid)))
    offset = np.round((grid.points_m[chosen.index] - grid.points_m[:, None]) * 10).astype(int)
    inner = grid.raster(np.arange(len(grid)))[6:-6, 6:-6].ravel()
    assert len(np.unique(offset[inner].reshape(len(inner), -1), axis=0)) == 1


def test_rings_larger_than_the_first_query_are_complete():
    """200 samples on one circle: the 3 taken are the 3 southernmost."""
    angle = np.linspace(0, 2 * np.pi, 200, endpoint=False) + 0.01
    points = 50.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    rule = OrdinaryKriging(exponential, 3).fit(points, np.zeros(200)).weights([[0.0, 0.0]])
    assert set(rule.index[0]) == set(np.argsort(points[:, 1])[:3])


@pytest.mark.parametrize("correlation", [PAPER, exponential], ids=["nugget", "no nugget"])
def test_coincident_samples_are_one_place_with_their_mean(correlation):
    points = scattered(12, 17, 200.0)
    values = np.arange(12.0)
    doubled = np.vstack([points, points[:3]])
    more = np.append(values, values[:3] + 2.0)
    merged = values.copy()
    merged[:3] += 1.0
    targets = scattered(9, 18, 200.0)
    model = OrdinaryKriging(correlation, 6, 400.0)
    expected = model.fit(points, merged).predict(targets)
    predicted = model.fit(doubled, more).predict(targets)
    np.testing.assert_array_equal(predicted[0], expected[0])
    np.testing.assert_array_equal(predicted[1], expected[1])
    left_out, _ = model.leave_one_out()
    assert len(left_out) == 15
    assert left_out[0] == left_out[12], "leaving one out leaves out the place"
    assert left_out[0] != more[0]


def test_nearly_coincident_samples_do_not_blow_up():
    points = np.array([[0.0, 0.0], [0.0, 2e-6], [100.0, 0.0], [0.0, 90.0]])
    model = OrdinaryKriging(exponential, 4, 400.0).fit(points, [1.0, 1.5, 0.0, 0.0])
    estimate, variance = model.predict([[20.0, 20.0]])
    assert 0.0 < estimate[0] < 1.5
    assert np.isfinite(variance[0])
    assert np.abs(model.weights([[20.0, 20.0]]).weight).max() < 2.0


def test_constant_field_is_exact_with_variance_zero():
    points, targets = scattered(100, 22), scattered(50, 23)
    for constant in (0.1, 1 / 3, -97.7, 3.0):
        values = np.full((100, 2), constant)
        values[::5, 1] = np.nan
        model = OrdinaryKriging(PAPER).fit(points, values)
        for estimate, variance in (model.predict(targets), model.leave_one_out()):
            assert (estimate[np.isfinite(estimate)] == constant).all()
            assert np.isfinite(estimate).any()
            assert (variance[np.isfinite(variance)] == 0).all()


def test_no_sample_at_all():
    model = OrdinaryKriging(PAPER).fit(np.zeros((0, 2)), np.zeros(0))
    assert np.isnan(model.predict([[0.0, 0.0]])[0]).all()
    assert OrdinaryKriging(PAPER).fit([[0.0, 0.0]], np.zeros((1, 0))).predict([[0.0, 0.0]])[0].shape == (1, 0)


@pytest.mark.parametrize(("neighbours", "count"), [(20, 30_000), (59, 3_000)])
def test_memory_of_a_prediction_is_bounded(neighbours, count):
    """Only neighbours and weights grow with the targets (some hundred bytes each), not the systems (7 kB and more)."""
    import tracemalloc

    model = OrdinaryKriging(PAPER, neighbours, np.inf).fit(scattered(60, 40), np.zeros(60))
    targets = scattered(count, 41)
    tracemalloc.start()
    model.predict(targets)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 50 * count * neighbours + 60e6


def test_radius_is_inclusive():
    """150 m / 30 m: the fifth cell counts, although 5 * 30.000000000000001 might not."""
    model = OrdinaryKriging(exponential, 1, 0.3).fit([[0.1 * 3, 0.0]], [5.0])
    assert model.predict([[0.0, 0.0]])[0][0] == 5.0


def test_collinear_samples():
    points = np.column_stack([np.arange(0, 300, 10.0), np.zeros(30)])
    values = np.sin(points[:, 0] / 50)
    estimate, variance = (
        OrdinaryKriging(exponential, 10, 100.0).fit(points, values).predict([[145.0, 0.0], [145.0, 40.0]])
    )
    # an exponential correlation on a line is Markov: between two samples only these two count
    expected, expected_variance = textbook(points[14:16], values[14:16], np.array([145.0, 0.0]), exponential)
    assert estimate[0] == pytest.approx(expected, abs=1e-3)
    assert variance[0] <= expected_variance + 1e-12
    assert np.isfinite(estimate[1])
    assert variance[1] > variance[0]


@pytest.mark.parametrize("range_m", [300.0, 3000.0])
def test_gaussian_correlation_without_nugget_is_regularised(range_m):
    """Condition number beyond 1e16: estimates must follow a smooth field, weights stay bounded."""
    grid = Grid.over_area((0.0, 300.0, 0.0, 300.0))
    field = np.sin(grid.points_m[:, 0] / 200) + np.cos(grid.points_m[:, 1] / 300)
    model = OrdinaryKriging(lambda d: np.exp(-((d / range_m) ** 2)), 20, 200.0).fit(grid.points_m, field)
    targets = np.random.default_rng(24).uniform(60, 240, (40, 2))
    rule = model.weights(targets)
    assert rule.regularised.all()
    np.testing.assert_allclose(rule.weight.sum(axis=1), 1.0, atol=1e-9)
    assert np.abs(rule.weight).max() < 30
    assert (rule.variance >= 0).all()
    estimate, _ = model.predict(targets)
    truth = np.sin(targets[:, 0] / 200) + np.cos(targets[:, 1] / 300)
    assert np.abs(estimate - truth).max() < 5e-3


def test_well_conditioned_systems_are_left_alone():
    model = OrdinaryKriging(PAPER).fit(scattered(200, 25), np.zeros(200))
    assert not model.weights(scattered(100, 26)).regularised.any()


def test_correlation_that_turns_negative():
    def damped(d):
        return np.exp(-d / 150.0) * np.cos(d / 70.0)

    points, targets = scattered(80, 27), scattered(30, 28)
    values = of_variance_one(np.random.default_rng(29).normal(size=80))
    estimate, variance = OrdinaryKriging(damped, 15, 400.0).fit(points, values).predict(targets)
    for t in range(30):
        near = np.argsort(np.linalg.norm(points - targets[t], axis=1))[:15]
        expected, expected_variance = textbook(points[near], values[near], targets[t], damped)
        assert estimate[t] == pytest.approx(expected, abs=1e-8)
        assert variance[t] == pytest.approx(expected_variance, abs=1e-8)


def test_a_curve_that_is_no_covariance_does_not_blow_up():
    """Found on a real flight log: 1 up to 8 m and then a jump. Textbook weights exceed 1e4, most with a variance > 0."""

    def shelf(d):
        return np.where(d < 8.0, 1.0, 0.55 * np.exp(-d / 75))

    rng = np.random.default_rng(0)
    along = np.linspace(0, 600, 150)
    points = np.column_stack([along, 30 * np.sin(along / 60)]) + rng.normal(0, 1, (150, 2))
    targets = points[rng.integers(0, 150, 3000)] + rng.normal(0, 8, (3000, 2))
    rule = OrdinaryKriging(shelf, 20, outside="nearest").fit(points, np.zeros(150)).weights(targets)
    assert np.abs(rule.weight).max() < 2
    np.testing.assert_allclose(rule.weight.sum(axis=1), 1.0, atol=1e-9)
    assert (rule.variance >= 0).all()


def test_a_correlation_above_one_counts_as_one():
    points = scattered(60, 38)
    values = np.random.default_rng(39).normal(size=60)
    high = OrdinaryKriging(lambda d: 2.2 * np.exp(-d / 55), 10, outside="nearest").fit(points, values)
    clipped = OrdinaryKriging(lambda d: np.minimum(2.2 * np.exp(-d / 55), 1.0), 10, outside="nearest").fit(
        points, values
    )
    np.testing.assert_array_equal(high.leave_one_out()[0], clipped.leave_one_out()[0])
    assert np.abs(high.leave_one_out()[0]).max() < 2 * np.abs(values).max()


def test_nugget_is_a_jump_unless_it_is_noise():
    points, values = scattered(40, 33, 200.0), of_variance_one(np.random.default_rng(34).normal(size=40))

    def noisy(d):
        return 0.6 * np.exp(-d / 100.0)

    at_sample, variance = OrdinaryKriging(noisy).fit(points, values).predict(points)
    np.testing.assert_array_equal(at_sample, values)
    assert (variance == 0).all()
    near, variance = OrdinaryKriging(noisy).fit(points, values).predict(points + 1e-3)
    assert (np.abs(near - values) > 1e-3).mean() > 0.9
    assert (variance > 0.4).all()


def test_estimates_that_a_smooth_correlation_throws_far_outside_are_said():
    def gaussian(d):
        return np.exp(-((d / 100.0) ** 2))

    points, targets = np.random.default_rng(3).uniform(0.0, 300.0, (2, 200, 2))
    model = OrdinaryKriging(gaussian, radius_m=np.inf).fit(points, np.random.default_rng(4).uniform(-1.0, 1.0, 200))
    with pytest.warns(RuntimeWarning, match="weights of samples add up to"):
        estimate, _ = model.predict(targets)
    assert np.abs(estimate).max() > 10.0


def test_cells_without_coverage_take_no_part():
    grid = Grid.over_area((0.0, 300.0, 0.0, 300.0))
    values = np.random.default_rng(35).integers(1, 5, (100, 3)).astype(float)
    values[np.random.default_rng(36).random((100, 3)) < 0.4] = np.nan
    values[:, 2] = np.nan
    estimate, _ = OrdinaryKriging(PAPER, 6, 80.0).fit(grid.points_m, values).leave_one_out()
    assert np.isnan(estimate[:, 2]).all()
    for field in (0, 1):
        covered = np.isfinite(values[:, field])
        alone = OrdinaryKriging(PAPER, 6, 80.0).fit(grid.points_m[covered], values[covered, field])
        np.testing.assert_allclose(estimate[covered, field], alone.leave_one_out()[0], atol=1e-12)
        np.testing.assert_allclose(estimate[~covered, field], alone.predict(grid.points_m[~covered])[0], atol=1e-12)


def test_random_selection_is_seeded_within_the_radius_and_fair():
    grid = Grid.over_area((0.0, 600.0, 0.0, 600.0))

    def rule(seed):
        model = OrdinaryKriging(PAPER, 20, 150.0, selection="random", seed=seed).fit(grid.points_m, np.zeros(400))
        return model.weights(grid.points_m + 0.5)

    first = rule(1)
    np.testing.assert_array_equal(first.index, rule(1).index)
    assert (first.index != rule(2).index).any()
    for t in range(400):
        chosen = first.index[t][first.index[t] >= 0]
        assert len(set(chosen)) == len(chosen) == 20
        assert np.linalg.norm(grid.points_m[chosen] - grid.points_m[t] - 0.5, axis=1).max() <= 150.0
    # 78 or so candidates: the mean distance of a fair draw is 2/3 of the radius, that of the nearest 20 is half
    inner = grid.raster(np.arange(400))[6:-6, 6:-6].ravel()
    far = np.linalg.norm(grid.points_m[first.index[inner]] - grid.points_m[inner, None] - 0.5, axis=-1)
    assert far.mean() == pytest.approx(100.0, rel=0.05)


def test_random_leave_one_out_does_not_see_the_target():
    points = scattered(60, 37, 200.0)
    model = OrdinaryKriging(PAPER, 5, 400.0, selection="random").fit(points, np.eye(60))
    estimate, _ = model.leave_one_out()
    np.testing.assert_allclose(np.diag(estimate), 0.0, atol=1e-14)  # a target that is used would show its weight


@pytest.mark.parametrize(
    ("arguments", "message"),
    [({"neighbours": 0}, "neighbours = 0"), ({"radius_m": -1.0}, "radius_m"), ({"selection": "all"}, "selection")],
)
def test_wrong_settings_are_named(arguments, message):
    with pytest.raises(UsageError, match=message):
        OrdinaryKriging(PAPER, **arguments).fit([[0.0, 0.0]], [1.0])


def test_wrong_shapes_are_named():
    with pytest.raises(UsageError, match="shape"):
        OrdinaryKriging(PAPER).fit([[0.0, 0.0]], [1.0, 2.0])
    with pytest.raises(UsageError, match="2 coordinates"):
        OrdinaryKriging(PAPER).fit(scattered(4, 1, 9.0, 3), np.zeros(4)).predict([[0.0, 0.0]])
    with pytest.raises(UsageError, match="not finite"):
        OrdinaryKriging(lambda d: d * np.nan).fit(scattered(4, 1, 50.0), np.zeros(4)).predict([[0.0, 0.0]])


def with_nugget(d):
    return 0.9 * np.exp(-np.asarray(d) / 70.0)  # a tenth is nugget


def test_a_missing_repeat_of_a_sample_leaves_the_other_one():
    points, target = np.array([[0.0, 0.0], [0.0, 0.0], [40.0, 0.0], [0.0, 40.0]]), [[10.0, 5.0]]
    values = np.array([[1.0, 5.0], [np.nan, 7.0], [2.0, 2.0], [3.0, 3.0]])
    estimate, _ = OrdinaryKriging(exponential).fit(points, values).predict(target)
    kept, _ = OrdinaryKriging(exponential).fit(points[[0, 2, 3]], values[[0, 2, 3], 0]).predict(target)
    assert estimate[0, 0] == pytest.approx(kept[0], rel=1e-12)


def by_hand(points, values, target, sill, *, neighbours, radius, outside="nan"):
    """Estimate and variance at one target."""
    known = np.isfinite(values)
    points, values = points[known], values[known]
    apart = np.linalg.norm(points - target, axis=1)
    nearest = np.argsort(apart)[:neighbours]
    chosen = nearest[apart[nearest] <= radius]
    if not len(chosen) and outside == "nearest":
        chosen = nearest
    if not len(chosen):
        return np.nan, np.nan
    estimate, variance = textbook(points[chosen], values[chosen], target, with_nugget)
    return estimate, max(variance, 0.0) * sill


CASES = [
    {"dims": 2, "neighbours": 6, "radius": 60.0},
    {"dims": 2, "neighbours": 20, "radius": 90.0},
    {"dims": 2, "neighbours": 4, "radius": 15.0, "outside": "nearest"},
    {"dims": 2, "neighbours": 1, "radius": 40.0},
    {"dims": 3, "neighbours": 8, "radius": 80.0},
    {"dims": 3, "neighbours": 5, "radius": 30.0, "outside": "nearest"},
]


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("seed", [1, 2])
def test_every_target_is_that_of_its_own_system(case, seed):
    rng = np.random.default_rng(seed)
    points = np.round(rng.uniform(0, 200, (45, case["dims"])), 3)
    points[:, 2:] *= 0.3
    values = rng.normal(3, 2, (45, 3))
    values[5:12, 1] = np.nan
    values[:, 2] = np.nan
    values[3, 2] = 1.5
    targets = np.concatenate([rng.uniform(-20, 220, (25, case["dims"])) * ([1, 1, 0.3][: case["dims"]]), points[:3]])
    outside = case.get("outside", "nan")
    model = OrdinaryKriging(with_nugget, case["neighbours"], case["radius"], outside=outside).fit(points, values)
    estimate, variance = model.predict(targets)
    sill = [
        np.var(column[np.isfinite(column)], ddof=1) if np.isfinite(column).sum() > 1 else 0.0 for column in values.T
    ]
    np.testing.assert_allclose(model.sill_, sill, rtol=1e-12)
    rules = {key: value for key, value in case.items() if key != "dims"}
    for field in range(3):
        expected = [by_hand(points, values[:, field], t, sill[field], **rules) for t in targets]
        np.testing.assert_allclose(
            np.stack([estimate[:, field], variance[:, field]], axis=1), expected, rtol=1e-8, atol=1e-9
        )
    # leaving one out is a model of the others
    left, spread = model.leave_one_out()
    for i in (0, 7, 40):
        others = np.delete(np.arange(45), i)
        for field in range(2):
            without_it = by_hand(points[others], values[others, field], points[i], sill[field], **rules)
            assert (left[i, field], spread[i, field]) == pytest.approx(without_it, rel=1e-8, abs=1e-9, nan_ok=True)


def test_what_is_not_said_is_twenty_neighbours_within_150_m_the_nearest_and_exact():
    usual, said = OrdinaryKriging(with_nugget), OrdinaryKriging(with_nugget, 20, 150.0, selection="nearest", seed=0)
    assert vars(usual) == vars(said) | {"outside": "nan"}


@pytest.mark.parametrize(
    "points", [np.zeros((4, 4)), np.zeros((4, 1)), np.zeros(4), np.zeros((4, 2, 2)), np.zeros((2, 2, 2))]
)
def test_points_have_two_or_three_coordinates(points):
    with pytest.raises(UsageError, match="points of shape"):
        OrdinaryKriging(with_nugget).fit(points, np.zeros(len(points)))


def test_systems_that_are_almost_singular_are_solved_where_they_carry_variance():
    """Two samples a hair apart: the least variance, by SciPy's minimiser over weights that sum to one."""
    from scipy.optimize import minimize

    gamma = np.array([[0, 1e-13, 0.5, 0.7], [1e-13, 0, 0.5, 0.7], [0.5, 0.5, 0, 0.6], [0.7, 0.7, 0.6, 0]])
    to_target = np.array([0.3, 0.3, 0.4, 0.5])

    def variance(free):
        w = np.append(free, 1 - free.sum())
        return 2 * w @ to_target - w @ gamma @ w

    least = minimize(variance, np.full(3, 0.25), tol=1e-14).fun
    weight, found, _ = kriging._solve_doubtful(gamma[None], to_target[None])
    assert weight.sum() == pytest.approx(1.0)
    assert variance(weight[0, :3]) == pytest.approx(least, abs=1e-8)
    assert found[0] == pytest.approx(least, abs=1e-8)
    assert weight[0, 0] == pytest.approx(weight[0, 1], abs=1e-6)
    assert kriging._solve_doubtful(np.zeros((3, 1, 1)), np.ones((3, 1)))[0].tolist() == [[1.0]] * 3


def test_estimates_do_not_depend_on_how_many_are_made_at_once(monkeypatch):
    rng = np.random.default_rng(7)
    points, values, targets = rng.uniform(0, 100, (30, 2)), rng.normal(size=30), rng.uniform(0, 100, (50, 2))
    at_once = OrdinaryKriging(with_nugget, 6).fit(points, values).predict(targets)
    monkeypatch.setattr(kriging, "CHUNK", 7)
    for a, b in zip(at_once, OrdinaryKriging(with_nugget, 6).fit(points, values).predict(targets), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12)


def smooth(d):
    return np.exp(-((np.asarray(d) / 110.0) ** 2))


@pytest.mark.parametrize("m", [1, 2, 7])
def test_many_targets_among_few_samples_equal_the_textbook(monkeypatch, m):
    """Each distance between samples is taken once, and never that of a sample to itself."""
    monkeypatch.setattr(kriging, "CHUNK", 128)
    points, targets = scattered(25, 51, 200.0), scattered(2 * kriging.CHUNK + 3, 52, 200.0)
    values = of_variance_one(np.random.default_rng(53).normal(size=25))

    def correlation(d):
        assert (d > 0).all()
        return exponential(d)

    estimate, variance = OrdinaryKriging(correlation, m, np.inf).fit(points, values).predict(targets)
    for t, target in enumerate(targets):
        near = np.argsort(np.linalg.norm(points - target, axis=1))[:m]
        expected = textbook(points[near], values[near], target, exponential)
        np.testing.assert_allclose((estimate[t], variance[t]), expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize(("correlation", "doubted"), [(with_nugget, (0, 0)), (smooth, (1, 39))])
def test_weights_are_those_of_fifty_digits(correlation, doubted):
    """Random neighbourhoods, from well conditioned to nearly singular: each is solved again with mpmath."""
    import mpmath

    rng = np.random.default_rng(11)
    points, targets = rng.uniform(0, 150, (60, 2)), rng.uniform(0, 150, (40, 2))
    model = OrdinaryKriging(correlation, 9, np.inf).fit(points, np.zeros(60))
    rule = model.weights(targets)
    offset = points[rule.index] - targets[:, None]
    between = 1.0 - correlation(np.linalg.norm(offset[:, :, None] - offset[:, None], axis=-1))
    to_target = 1.0 - correlation(np.linalg.norm(offset, axis=-1))
    first, second = np.triu_indices(9, 1)
    *_, sound = kriging.solve_schur(between[:, second, first].T, to_target.T)
    assert doubted[0] <= (~sound).sum() <= doubted[1], "the case is not as hard as it should be"
    for t in range(40):
        with mpmath.workdps(50):
            system = mpmath.ones(10, 10)
            for i, j in itertools.product(range(9), repeat=2):
                system[i, j] = 0 if i == j else mpmath.mpf(float(between[t, i, j]))
            system[9, 9] = 0
            right = mpmath.matrix([*map(float, to_target[t]), 1.0])
            exact = mpmath.lu_solve(system, right)
            variance = sum(exact[i] * right[i] for i in range(10))
        np.testing.assert_allclose(rule.weight[t], [float(w) for w in exact[:9]], rtol=0, atol=1e-8)
        assert rule.variance[t] == pytest.approx(float(variance), abs=1e-9)


@pytest.mark.parametrize("scale", [1e-15, 1e15])
def test_weights_do_not_depend_on_the_unit_of_the_variance(scale):
    rng = np.random.default_rng(9)
    points = rng.uniform(0, 100, (6, 2))
    gamma = 1.0 - with_nugget(np.hypot(*(points[:, None] - points[None]).transpose(2, 0, 1)))
    np.fill_diagonal(gamma, 0.0)
    to_target = 1.0 - with_nugget(np.hypot(*(points - 50.0).T))
    usual, _, flagged = kriging._solve_doubtful(gamma[None], to_target[None])
    scaled, *_ = kriging._solve_doubtful(scale * gamma[None], scale * to_target[None])
    np.testing.assert_allclose(scaled, usual, rtol=1e-9)
    first, second = np.triu_indices(6, 1)
    factored, *_ = kriging.solve_schur(gamma[second, first][:, None], to_target[:, None])
    np.testing.assert_allclose(usual[0], factored[:, 0], rtol=1e-9, atol=1e-12)
    assert not flagged.any()
