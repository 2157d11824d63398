"""Ordinary Kriging target by target, from its definition: neighbours by sorting, one linear system, NaN fields, sills, defaults."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.maps import kriging
from aerpaw_cmp.maps.kriging import OrdinaryKriging


def exponential(d):
    return 0.9 * np.exp(-np.asarray(d) / 70.0)  # a tenth is nugget


def vertical(d):
    return np.exp(-np.asarray(d) / 30.0)


def by_hand(
    points,
    values,
    target,
    *,
    neighbours,
    radius,
    correlation,
    sill,
    exact=True,
    scale=1.0,
    vertical=None,
    outside="nan",
):
    """Estimate and variance at one target."""
    points = np.asarray(points, dtype=float)
    known = np.isfinite(values)
    points, values = points[known], np.asarray(values)[known]

    def apart(a, b):
        d = a - b
        if len(d) == 3:
            d = d * [1.0, 1.0, scale]
        return float(np.sqrt(np.sum(d * d)))

    def phi(a, b):
        if vertical is None:
            return float(correlation(apart(a, b)))
        return float(correlation(np.hypot(*(a - b)[:2])) * vertical(abs(a[2] - b[2])))

    order = sorted(range(len(points)), key=lambda i: apart(points[i], target))
    chosen = [i for i in order if apart(points[i], target) <= radius][:neighbours]
    if not chosen and outside == "nearest":
        chosen = order[:neighbours]
    if not chosen:
        return np.nan, np.nan
    m = len(chosen)
    system, right = np.ones((m + 1, m + 1)), np.ones(m + 1)
    system[m, m] = 0.0
    for a, b in itertools.product(range(m), repeat=2):
        system[a, b] = 0.0 if a == b else max(0.0, 1.0 - phi(points[chosen[a]], points[chosen[b]]))
    for a in range(m):
        here = apart(points[chosen[a]], target) == 0.0
        right[a] = 0.0 if here and exact else max(0.0, 1.0 - phi(points[chosen[a]], target))
    solved = np.linalg.solve(system, right)
    return float(solved[:m] @ values[chosen]), float(max(solved @ right, 0.0) * sill)


CASES = [
    {"dims": 2, "neighbours": 6, "radius": 60.0},
    {"dims": 2, "neighbours": 20, "radius": 90.0, "exact": False},
    {"dims": 2, "neighbours": 4, "radius": 15.0, "outside": "nearest"},
    {"dims": 2, "neighbours": 1, "radius": 40.0},
    {"dims": 3, "neighbours": 8, "radius": 80.0, "scale": 2.5},
    {"dims": 3, "neighbours": 8, "radius": 60.0, "vertical": vertical},
    {
        "dims": 3,
        "neighbours": 5,
        "radius": 70.0,
        "vertical": vertical,
        "scale": 3.0,
        "exact": False,
        "outside": "nearest",
    },
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
    options = {
        "exact": case.get("exact", True), "vertical_scale": case.get("scale", 1.0),
        "vertical_correlation": case.get("vertical"), "outside": case.get("outside", "nan"),
    }  # fmt: skip
    model = OrdinaryKriging(exponential, case["neighbours"], case["radius"], **options).fit(points, values)
    estimate, variance = model.predict(targets)
    sill = [
        np.var(column[np.isfinite(column)], ddof=1) if np.isfinite(column).sum() > 1 else 0.0 for column in values.T
    ]
    np.testing.assert_allclose(model.sill_, sill, rtol=1e-12)
    rules = {key: case[key] for key in ("neighbours", "radius", "exact", "scale", "vertical", "outside") if key in case}
    for field in range(3):
        expected = [
            by_hand(points, values[:, field], t, correlation=exponential, sill=sill[field], **rules) for t in targets
        ]
        np.testing.assert_allclose(
            np.stack([estimate[:, field], variance[:, field]], axis=1), expected, rtol=1e-8, atol=1e-9
        )
    # leaving one out is a model of the others
    left, spread = model.leave_one_out()
    for i in (0, 7, 40):
        others = np.delete(np.arange(45), i)
        for field in range(2):
            one = by_hand(
                points[others], values[others, field], points[i], correlation=exponential, sill=sill[field], **rules
            )
            assert (left[i, field], spread[i, field]) == pytest.approx(one, rel=1e-8, abs=1e-9, nan_ok=True)


def test_what_is_not_said_is_twenty_neighbours_within_150_m_the_nearest_and_exact():
    rng = np.random.default_rng(3)
    points, values = rng.uniform(0, 300, (80, 2)), rng.normal(size=80)
    targets = np.concatenate([rng.uniform(0, 300, (10, 2)), points[:2], [[900.0, 0.0]]])
    said = OrdinaryKriging(
        exponential, 20, 150.0, selection="nearest", seed=0, sill=None, exact=True, vertical_scale=1.0,
        vertical_correlation=None, outside="nan",
    )  # fmt: skip
    usual = OrdinaryKriging(exponential)
    for a, b in zip(usual.fit(points, values).predict(targets), said.fit(points, values).predict(targets), strict=True):
        np.testing.assert_array_equal(a, b)
    assert a.shape == (13,)
    assert np.isnan(a[-1])
    drawn = [
        OrdinaryKriging(exponential, 5, selection="random", **s).fit(points, values).predict(targets)[0]
        for s in ({}, {"seed": 0}, {"seed": 1})
    ]
    np.testing.assert_array_equal(drawn[0], drawn[1])
    assert (drawn[1] != drawn[2]).any()


def test_a_sill_that_is_given_scales_the_variance_of_its_field():
    rng = np.random.default_rng(4)
    points, values = rng.uniform(0, 100, (12, 2)), rng.normal(size=(12, 2))
    one = OrdinaryKriging(exponential, sill=1.0).fit(points, values).predict([[50.0, 50.0]])[1]
    two = OrdinaryKriging(exponential, sill=[2.0, 0.0]).fit(points, values).predict([[50.0, 50.0]])[1]
    np.testing.assert_allclose(two, one * [[2.0, 0.0]])
    with pytest.raises(UsageError, match=r"a sill of -1\.0"):
        OrdinaryKriging(exponential, sill=[1.0, -1.0]).fit(points, values)


@pytest.mark.parametrize(
    "points", [np.zeros((4, 4)), np.zeros((4, 1)), np.zeros(4), np.zeros((4, 2, 2)), np.zeros((2, 2, 2))]
)
def test_points_have_two_or_three_coordinates(points):
    with pytest.raises(UsageError, match="points of shape"):
        OrdinaryKriging(exponential).fit(points, np.zeros(len(points)))


def test_places_that_coincide_are_one_with_the_mean_of_what_is_known():
    points = [[0.0, 0.0], [10.0, 0.0], [0.0, 0.0], [20.0, 0.0], [10.0, 0.0]]
    values = [[1.0, np.nan], [5.0, 7.0], [4.0, np.nan], [9.0, 2.0], [np.nan, 1.0]]
    model = OrdinaryKriging(exponential).fit(points, values)
    assert model.points_m_.tolist() == [[0.0, 0.0], [10.0, 0.0], [20.0, 0.0]]
    assert model.place_.tolist() == [0, 1, 0, 2, 1]
    np.testing.assert_array_equal(model.values_, [[2.5, np.nan], [5.0, 4.0], [9.0, 2.0]])
    left, _ = model.leave_one_out()
    assert left.shape == (5, 2)
    np.testing.assert_array_equal(left[0], left[2])


def test_systems_that_are_almost_singular_are_solved_where_they_carry_variance():
    """Two samples a hair apart: the least variance, by SciPy's minimiser over weights that sum to one."""
    from scipy.optimize import minimize

    gamma = np.array([[0, 1e-13, 0.5, 0.7], [1e-13, 0, 0.5, 0.7], [0.5, 0.5, 0, 0.6], [0.7, 0.7, 0.6, 0]])
    to_target = np.array([0.3, 0.3, 0.4, 0.5])

    def variance(free):
        w = np.append(free, 1 - free.sum())
        return 2 * w @ to_target - w @ gamma @ w

    least = minimize(variance, np.full(3, 0.25), tol=1e-14).fun
    weight = kriging._solve_reduced(gamma[None], to_target[None])
    assert weight.sum() == pytest.approx(1.0)
    assert variance(weight[0, :3]) == pytest.approx(least, abs=1e-8)
    assert kriging._variance_of(weight, gamma[None], to_target[None])[0] == pytest.approx(least, abs=1e-8)
    assert weight[0, 0] == pytest.approx(weight[0, 1], abs=1e-6)
    assert kriging._solve_reduced(np.zeros((3, 1, 1)), np.ones((3, 1))).tolist() == [[1.0]] * 3


def test_definite_is_what_has_a_cholesky_factor_whatever_stands_beside_it():
    good = 1.0 - np.exp(-np.abs(np.subtract.outer(np.arange(4.0), np.arange(4.0))))
    bad = good.copy()
    bad[0, 1] = bad[1, 0] = 3.0  # no variogram
    assert kriging._is_definite(np.stack([good, good])).tolist() == [True, True]
    assert kriging._is_definite(np.stack([good, bad, good])).tolist() == [True, False, True]
    assert kriging._is_definite(np.zeros((2, 1, 1))).tolist() == [True, True]
    assert kriging._is_definite(good[None, :2, :2]).tolist() == [True]
    assert kriging._is_definite(np.zeros((1, 2, 2))).tolist() == [False]


def test_targets_with_neighbours_at_equal_offsets_are_told_from_others():
    rng = np.random.default_rng(6)
    shapes = rng.uniform(-50, 50, (3, 4, 2))
    pick = rng.integers(0, 3, 40)
    example, group = kriging._same_geometry(np.moveaxis(shapes[pick], 0, 2).swapaxes(0, 1))
    assert len(example) == 3
    assert (pick[example][group] == pick).all()
    swapped = np.stack([shapes[0], shapes[0][::-1], shapes[0] + [0.0, 1e-3]])
    assert len(kriging._same_geometry(np.moveaxis(swapped, 0, 2).swapaxes(0, 1))[0]) == 3


def test_estimates_do_not_depend_on_how_many_are_made_at_once(monkeypatch):
    rng = np.random.default_rng(7)
    points, values, targets = rng.uniform(0, 100, (30, 2)), rng.normal(size=30), rng.uniform(0, 100, (50, 2))
    whole = OrdinaryKriging(exponential, 6).fit(points, values).predict(targets)
    monkeypatch.setattr(kriging, "CHUNK", 7)
    for a, b in zip(whole, OrdinaryKriging(exponential, 6).fit(points, values).predict(targets), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12)


def test_one_step_of_refinement_gives_back_digits_that_the_inverse_lost():
    """A smooth correlation without nugget on a dense line: against 40 digits."""
    import mpmath

    points = np.column_stack([np.arange(7) * 9.0, np.zeros(7)])
    gamma = 1.0 - np.exp(-((np.subtract.outer(points[:, 0], points[:, 0]) / 40.0) ** 2))
    to_target = 1.0 - np.exp(-(((points[:, 0] - 24.3) / 40.0) ** 2))
    weight, lagrange, fine = kriging._solve_bordered(gamma[None], to_target[None])
    assert fine.all()
    with mpmath.workdps(40):
        system = mpmath.ones(8, 8)
        for i, j in itertools.product(range(7), repeat=2):
            system[i, j] = mpmath.mpf(float(gamma[i, j]))
        system[7, 7] = 0
        exact = mpmath.lu_solve(system, mpmath.matrix([*map(float, to_target), 1.0]))
        error = max(abs(float(exact[i] - mpmath.mpf(float(weight[0, i])))) for i in range(7))
        inverse = np.linalg.inv(np.array(system.tolist(), dtype=float)) @ np.append(to_target, 1.0)
        plain = max(abs(float(exact[i] - mpmath.mpf(float(inverse[i])))) for i in range(7))
    assert error < 0.5 * plain
    assert float(exact[7]) == pytest.approx(lagrange[0], abs=1e-9)


def smooth(d):
    return np.exp(-((np.asarray(d) / 110.0) ** 2))


@pytest.mark.parametrize(("correlation", "doubted"), [(exponential, (0, 0)), (smooth, (1, 39))])
def test_weights_are_those_of_fifty_digits(correlation, doubted):
    """Random neighbourhoods, from well conditioned to nearly singular: each is solved again with mpmath."""
    import mpmath

    rng = np.random.default_rng(11)
    points, targets = rng.uniform(0, 150, (60, 2)), rng.uniform(0, 150, (40, 2))
    model = OrdinaryKriging(correlation, 9, np.inf, sill=1.0).fit(points, np.zeros(60))
    rule = model.weights(targets)
    offset = points[rule.index] - targets[:, None]
    between = 1.0 - correlation(np.linalg.norm(offset[:, :, None] - offset[:, None], axis=-1))
    to_target = 1.0 - correlation(np.linalg.norm(offset, axis=-1))
    first, second = np.triu_indices(9, 1)
    *_, sound = kriging._solve_schur(between[:, second, first].T, to_target.T)
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
        np.testing.assert_allclose(rule.weight[t], [float(w) for w in exact[:9]], rtol=0, atol=1e-9)
        assert rule.variance[t] == pytest.approx(float(variance), abs=1e-9)


@pytest.mark.parametrize("scale", [1e-15, 1e15])
def test_weights_do_not_depend_on_the_unit_of_the_variance(scale):
    rng = np.random.default_rng(9)
    points = rng.uniform(0, 100, (6, 2))
    gamma = 1.0 - exponential(np.hypot(*(points[:, None] - points[None]).transpose(2, 0, 1)))
    np.fill_diagonal(gamma, 0.0)
    to_target = 1.0 - exponential(np.hypot(*(points - 50.0).T))
    usual = kriging._solve_reduced(gamma[None], to_target[None])
    np.testing.assert_allclose(kriging._solve_reduced(scale * gamma[None], scale * to_target[None]), usual, rtol=1e-9)
    np.testing.assert_allclose(usual, kriging._solve_bordered(gamma[None], to_target[None])[0], rtol=1e-9, atol=1e-12)
