"""The offset search against its closed form, brute force and SciPy's likelihoods, and its hard cases."""

import math
from decimal import ROUND_HALF_DOWN, Decimal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aerpaw_cmp.compare.offset import difference_moments, grid_offset, nearest_offset, offset_grid

tenths = st.integers(-2000, 2000).map(lambda k: k / 100)


def closed_form(difference: np.ndarray) -> float:
    """The mean difference, rounded to tenths (halves towards zero) and clamped, in decimal arithmetic."""
    exact = sum(Decimal(repr(float(d))) for d in difference) / len(difference)
    rounded = exact.quantize(Decimal("0.1"), rounding=ROUND_HALF_DOWN)
    return float(min(max(rounded, Decimal(-50)), Decimal(50)))


@settings(max_examples=200, deadline=None)
@given(st.lists(st.tuples(tenths, tenths), min_size=1, max_size=30), st.integers(-60, 60))
def test_grid_search_equals_the_closed_form(pairs, shift):
    measured, simulated = (np.array(side) for side in zip(*pairs, strict=True))
    simulated = simulated + shift
    fit = grid_offset(measured, simulated)
    expected = closed_form(np.round(simulated - measured, 9))
    assert fit.offset_db == expected
    assert fit.at_edge == (abs(expected) == 50.0)
    assert fit.rmse_db == pytest.approx(np.sqrt(np.mean((measured + fit.offset_db - simulated) ** 2)), abs=1e-9)


@pytest.mark.parametrize(
    ("difference", "offset"), [(0.05, 0.0), (-0.05, 0.0), (0.15, 0.1), (-0.15, -0.1), (0.65, 0.6), (-7.25, -7.2)]
)
def test_a_tie_goes_to_the_offset_nearer_zero(difference, offset):
    assert grid_offset([0.0], [difference]).offset_db == offset


def test_nan_on_both_sides_and_infinities_do_not_count():
    nan, inf = float("nan"), float("inf")
    fit = grid_offset([-60, nan, -62, nan, -inf], [-50, -51, nan, nan, -50])
    assert (fit.offset_db, fit.n) == (10.0, 1)
    assert fit.rmse_db == pytest.approx(0.0, abs=1e-12)


def test_sides_of_different_length_are_refused():
    with pytest.raises(ValueError, match="expected the same"):
        grid_offset([1.0, 2.0], [1.0])
    with pytest.raises(ValueError, match="step"):
        grid_offset([1.0], [1.0], step_db=0.0)
    with pytest.raises(ValueError, match="no multiple"):
        grid_offset([1.0], [1.0], step_db=10.0, span_db=(1.0, 9.0))


@pytest.mark.parametrize("level", [1e30, -1e30, 1e18, -1e17, 1e308, -1e308, 60.0, -60.0, 50.0, 49.96])
def test_the_edge_of_the_span_is_told_for_any_input(level: float) -> None:
    fit = grid_offset([0.0, 0.0], [level, level])
    assert fit.at_edge
    assert fit.offset_db == np.sign(level) * 50.0
    mixed = grid_offset([0.0, 0.0, 0.0], [level, 1.0, 1.0])
    assert mixed.at_edge == (abs(level) / 3 > 50)


def test_a_grid_that_fits_in_no_memory_is_refused() -> None:
    with pytest.raises(ValueError, match="2e\\+16 offsets to try"):
        offset_grid(1e-7, (-1e9, 1e9))


NAN = float("nan")


@pytest.mark.parametrize("difference", [50.0, -50.0, 49.9, -49.9, 0.0])
def test_every_fit_tells_the_edge_of_its_grid(difference):
    edge = abs(difference) == 50.0
    measured, simulated = np.zeros(10), np.full(10, difference) + np.tile([-0.01, 0.01], 5)
    assert grid_offset(measured, simulated).at_edge == edge


def test_nothing_known_is_no_number_and_no_edge():
    fit = grid_offset([NAN], [1.0])
    assert np.isnan([fit.offset_db, fit.rmse_db]).all()
    assert (fit.n, fit.at_edge) == (0, False)


def test_the_rmse_at_other_offsets():
    measured, simulated = np.array([-60.0, -61.0, NAN]), np.array([-55.0, -54.0, 0.0])
    offsets = offset_grid(0.5, (0.0, 12.0))
    expected = [np.sqrt(((o - 5) ** 2 + (o - 7) ** 2) / 2) for o in offsets]
    np.testing.assert_allclose(difference_moments(measured, simulated).rmse_db(offsets), expected)


@pytest.mark.parametrize(
    ("step", "first", "last"), [(0.1, -50.0, 50.0), (0.25, -50.0, 50.0), (0.3, -49.8, 49.8), (3.0, -48.0, 48.0)]
)
def test_the_grid_is_the_multiples_of_its_step(step, first, last):
    grid = offset_grid(step)
    assert (grid[0], grid[-1]) == pytest.approx((first, last), abs=1e-12)
    assert len(grid) == round((last - first) / step) + 1
    k = np.round(grid / step)
    np.testing.assert_allclose(grid, k * step, rtol=1e-15)
    if step in (0.1, 0.25):
        assert (grid == k / round(1 / step)).all()  # each correctly rounded
    with pytest.raises(ValueError, match="no multiple"):
        offset_grid(3.0, (1.0, 2.0))
    with pytest.raises(ValueError, match="must be finite"):
        offset_grid(-0.1)
    with pytest.raises(ValueError, match="must be finite"):
        offset_grid(0.1, (-50.0, math.inf))
    assert offset_grid(0.1, (0.3, 0.3)).tolist() == [0.3]
    assert nearest_offset(np.array([-1.0, 0.0, 1.0]), 0.5, 1.0) == 1
    assert nearest_offset(np.array([-1.0, 0.0, 1.0]), -0.5, 1.0) == 1
    assert nearest_offset(np.array([-1.0, 0.0, 1.0]), 0.6, 1.0) == 2


def test_levels_at_the_end_of_float64_have_a_huge_error_and_raise_nothing() -> None:
    fit = grid_offset([1e308, -1e308], [-1e308, 1e308])
    assert fit.n == 2
    assert fit.rmse_db > 1e100
