"""Gaussian processes against 50 digits, closed forms, and fits without the held-out part."""

import mpmath as mp
import numpy as np
import pytest

from aerpaw_cmp.common.errors import InputError
from aerpaw_cmp.common.gaussian import Factor, determining, gaussian_kernel


def known(count=12, seed=1):
    """A covariance with noise, covariances of five targets with it, values."""
    rng = np.random.default_rng(seed)
    places, targets = rng.uniform(0, 3, (count, 2)), rng.uniform(0, 3, (5, 2))
    matrix = 4.0 * gaussian_kernel(places, places, 0.8) + 0.01 * np.eye(count)
    return matrix, 4.0 * gaussian_kernel(targets, places, 0.8), rng.normal(0, 2, count)


def test_answers_are_those_of_fifty_digits():
    matrix, across, values = known()
    factor = Factor.of(matrix.copy())
    mean, explained = factor.condition(across, factor.whiten(values))
    with mp.workdps(50):
        inverse, y = mp.matrix(matrix.tolist()) ** -1, mp.matrix(values.tolist())
        rows = [mp.matrix(row.tolist()) for row in across]
        np.testing.assert_allclose(mean, [float((k.T * inverse * y)[0]) for k in rows], rtol=1e-11)
        np.testing.assert_allclose(explained, [float((k.T * inverse * k)[0]) for k in rows], rtol=1e-12)
        likelihood = -(y.T * inverse * y)[0] / 2 - mp.log(mp.det(mp.matrix(matrix.tolist()))) / 2
        assert factor.log_likelihood(values) == pytest.approx(float(likelihood), rel=1e-12)
        np.testing.assert_allclose(factor.inverse(), np.array(inverse.tolist(), dtype=float), rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(factor.solve(values), np.array((inverse * y).tolist(), float)[:, 0], rtol=1e-9)


def test_two_values_in_closed_form():
    """For unit variances and correlation r, the second has the mean r times the first, and the variance 1 - r^2."""
    r = 0.6
    alone = Factor.of(np.array([[1.0]]))
    mean, explained = alone.condition(np.array([[r]]), alone.whiten(np.array([2.0])))
    assert (mean[0], explained[0]) == (pytest.approx(2.0 * r), pytest.approx(r**2))


def test_several_columns_are_each_alone():
    matrix, across, values = known()
    factor, columns = Factor.of(matrix), np.column_stack([values, values[::-1]])
    mean, _ = factor.condition(across, factor.whiten(columns))
    alone, _ = factor.condition(across, factor.whiten(columns[:, 1].copy()))
    np.testing.assert_allclose(mean[:, 1], alone, rtol=1e-12)


@pytest.mark.parametrize("bad", [[[1.0, 2.0], [2.0, 1.0]], [[1.0, np.nan], [np.nan, 1.0]], [[np.inf, 0.0], [0.0, 1.0]]])
def test_no_covariance_is_refused(bad):
    with pytest.raises(InputError, match="cannot be solved"):
        Factor.of(np.array(bad))


def test_points_that_determine_a_process_leave_no_more_than_the_share():
    points = np.random.default_rng(2).uniform(-1, 1, (300, 3))

    def kernel(a, b):
        return gaussian_kernel(a, b, 0.7)

    chosen = determining(points, kernel, 0.02, 200)
    assert 10 < len(set(chosen.tolist())) == len(chosen) < 200
    base = points[chosen]
    _, explained = Factor.of(kernel(base, base)).condition(kernel(points, base), np.zeros(len(base)))
    assert 1.0 - explained.min() <= 0.02 + 1e-9
    assert len(determining(points, kernel, 0.02, 7)) == 7
