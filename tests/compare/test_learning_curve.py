"""Learning curve: errors by explicit fits, same targets at every size, and the law of one more flight."""

import itertools

import numpy as np
import pytest

from aerpaw_cmp.compare.calibration import CurvePoint, Observed, Recipe, learn, learning_curve, with_one_more
from aerpaw_cmp.compare.gains import GainModel, Term
from tests.compare.test_direction_gain import GAINS, planted

RECIPE = Recipe(GainModel((Term("body", "all", 0.5, 2.5), Term("mast", "antenna", 0.4, 3.0))))


def observed(flights: int) -> list[Observed]:
    series = [s for k in range(flights) for s in planted(f"f{k}", 60 + k, GAINS, n=120)]
    return [Observed(s, np.zeros(len(s)), np.zeros(len(s))) for s in series]


def test_points_are_means_of_explicit_fits_over_all_subsets():
    series = observed(4)
    points = learning_curve(series, RECIPE)
    assert [p.flights for p in points] == [1, 2, 3]
    assert [p.fits for p in points] == [4, 6, 4]
    assert {p.series for p in points} == {8}
    names = [f"f{k}" for k in range(4)]
    for point in points:
        errors = []
        for scored in series:
            others = [n for n in names if n != scored.samples.flight]
            each = []
            for subset in itertools.combinations(others, point.flights):
                learned = learn([o.samples for o in series if o.samples.flight in subset], RECIPE)
                each.append((scored.samples.residual_db - learned.mean(scored.samples)).std())
            errors.append(np.mean(each))
        assert point.rmse_db == pytest.approx(np.mean(errors), rel=1e-6)
    assert points[0].rmse_db > points[2].rmse_db + 0.2


def test_many_flights_take_few_fits_and_every_flight_is_predicted():
    points = learning_curve(observed(9), RECIPE)
    assert points[0].flights == 1
    assert points[-1].flights == 8
    assert max(p.fits for p in points) <= 6
    assert min(p.series for p in points) >= 10


def test_one_more_flight_follows_what_averages_out():
    points = [
        CurvePoint(flights=n, rmse_db=(9 + 4 / n) ** 0.5, rmse_4s_db=(4 + 4 / n) ** 0.5, fits=1, series=2)
        for n in (1, 2, 3)
    ]
    assert with_one_more(points) == pytest.approx((9 + 4 / 4) ** 0.5)
    assert with_one_more(points, "rmse_4s_db") == pytest.approx((4 + 4 / 4) ** 0.5)
    slow = [CurvePoint(flights=n, rmse_db=9.0, rmse_4s_db=9.0, fits=1, series=2) for n in (1, 2)]
    late = [CurvePoint(flights=n, rmse_db=(9 + 90 / n) ** 0.5, rmse_4s_db=9.0, fits=1, series=2) for n in (3, 4, 5)]
    assert with_one_more([*slow, *late]) == pytest.approx((9 + 90 / 6) ** 0.5)  # the first sizes have no part
    flat = [CurvePoint(flights=n, rmse_db=3.0 + 0.1 * n, rmse_4s_db=3.0, fits=1, series=2) for n in (1, 2)]
    assert with_one_more(flat) == pytest.approx(3.2)  # a curve that rises promises nothing
    assert np.isnan(with_one_more(points[:1]))


def test_two_flights_have_no_curve():
    assert learning_curve(observed(2), RECIPE) == ()
