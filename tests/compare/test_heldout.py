"""Fitting on some flights, scoring on others."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aerpaw_cmp.compare.heldout import fit_held_out, goes_round

TRUTH = {"yaw_deg": 37.0, "gamma": 0.5}


def flights():
    rng = np.random.default_rng(0)
    made = {}
    for name, n in (("a", 300), ("b", 900), ("c", 300)):
        heading, depth = rng.uniform(0, 360, n), rng.uniform(0, 20, n)
        made[name] = (heading, depth, 6 * np.cos(np.radians(heading - 37.0)) - 0.5 * depth + rng.normal(0, 1, n))
    return made


DATA = flights()


def objective(parameters, flight):
    heading, depth, level = DATA[flight]
    model = 6 * np.cos(np.radians(heading - parameters["yaw_deg"])) - parameters["gamma"] * depth
    residual = level - model
    return residual - residual.mean()


def test_parameters_are_found_and_scored_elsewhere():
    fit = fit_held_out(objective, {"yaw_deg": np.arange(0, 91, 15), "gamma": [0.0, 0.25, 0.75, 1.0]}, ["a", "b"], ["c"])
    assert fit.parameters["yaw_deg"] == pytest.approx(37.0, abs=1.5)
    assert fit.parameters["gamma"] == pytest.approx(0.5, abs=0.03)
    assert fit.fitted_on == ("a", "b")
    assert set(fit.test_rmse_db) == {"c"}
    assert fit.test_rmse_db["c"] == pytest.approx(1.0, abs=0.15)
    assert fit.start_rmse_db["c"] > fit.test_rmse_db["c"] + 0.5
    assert fit.at_bounds == ()
    assert fit.as_dict()["applied_to"] == ["c"]


def test_the_test_flights_do_not_influence_the_fit():
    calls = []

    def watched(parameters, flight):
        calls.append((flight, dict(parameters)))
        return objective(parameters, flight)

    values = {"yaw_deg": np.arange(0, 91, 15), "gamma": [0.5]}
    fit = fit_held_out(watched, values, ["a"], ["c"])
    assert {flight for flight, _ in calls[:-4]} == {"a"}  # only the final scores touch c
    assert fit.parameters == fit_held_out(objective, values, ["a"]).parameters
    assert len(calls) == fit.evaluations


def test_a_parameter_at_its_bound_is_named():
    fit = fit_held_out(objective, {"yaw_deg": [50.0, 70.0, 90.0], "gamma": [0.5]}, ["a"])
    assert fit.at_bounds == ("yaw_deg",)
    assert fit.parameters["gamma"] == 0.5


@given(st.floats(0.0, 360.0, exclude_max=True), st.sampled_from([20.0, 30.0, 45.0]))
@settings(max_examples=25, deadline=None)
def test_an_azimuth_that_goes_round_has_no_bound(truth, step):
    across = np.radians(np.linspace(0, 340, 18))

    def around(parameters, _flight):
        return np.cos(across - np.radians(parameters["yaw_deg"])) - np.cos(across - np.radians(truth))

    grid = np.arange(0, 360, step)
    fit = fit_held_out(around, {"yaw_deg": grid}, ["a"], circular=["yaw_deg"])
    off = (fit.parameters["yaw_deg"] - truth + 180) % 360 - 180
    assert abs(off) < 0.5
    assert 0.0 <= fit.parameters["yaw_deg"] < 360.0
    assert fit.at_bounds == ()


def test_what_goes_round():
    assert goes_round(np.arange(0, 360, 10))
    assert goes_round([-180.0, -60.0, 60.0])
    assert goes_round(np.arange(0, 361, 10))
    assert not goes_round(np.arange(0, 180, 10))
    assert not goes_round([0.0, 10.0, 20.0, 350.0, 700.0])
    assert not goes_round([0.0, 180.0])


def test_without_refinement_the_grid_decides():
    fit = fit_held_out(objective, {"yaw_deg": [0.0, 30.0, 90.0], "gamma": [0.5]}, ["a"], refine=False)
    assert fit.parameters["yaw_deg"] == 30.0


def test_misuse_is_refused():
    values = {"yaw_deg": [0.0, 1.0], "gamma": [0.5]}
    with pytest.raises(ValueError, match="in both lists"):
        fit_held_out(objective, values, ["a"], ["a"])
    with pytest.raises(ValueError, match="flights to fit on"):
        fit_held_out(objective, values, [])
    with pytest.raises(ValueError, match="increasing"):
        fit_held_out(objective, {"yaw_deg": [1.0, 0.0]}, ["a"])
    with pytest.raises(ValueError, match="combinations"):
        fit_held_out(objective, values, ["a"], largest_grid=1)
    with pytest.raises(ValueError, match="no combination"):
        fit_held_out(lambda _parameters, _flight: np.full(3, np.nan), values, ["a"])
