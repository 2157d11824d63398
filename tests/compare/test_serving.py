"""Serving cells: hits, confusion, and what a planted fault does to them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from aerpaw_cmp.compare.level import at_times, compare_serving


def test_a_perfect_prediction_hits_always_and_an_exchanged_one_never() -> None:
    rng = np.random.default_rng(1)
    level = rng.normal(-80, 8, (500, 3))
    served = level.argmax(axis=1)
    assert compare_serving(served, level, "abc").hit_share == 1.0
    assert compare_serving(served, -level, "abc").hit_share == 0.0
    assert compare_serving(served, level + 30.0, "abc").hit_share == 1.0, "a common offset changes nothing"
    turned = compare_serving(served, level[:, [1, 2, 0]], "abc")
    assert turned.hit_share < 0.6, "towers exchanged"


@given(st.lists(st.integers(-1, 2), min_size=1, max_size=60), st.randoms(use_true_random=False))
def test_rows_of_the_confusion_count_the_served(served: list[int], random: object) -> None:
    rng = np.random.default_rng(random.randint(0, 2**31))  # type: ignore[attr-defined]
    level = rng.normal(size=(len(served), 3))
    level[rng.random(level.shape) < 0.3] = np.nan
    comparison = compare_serving(served, level, ["a", "b", "c"])
    assert comparison.confusion.sum(axis=1).tolist() == [served.count(i) for i in range(3)]
    assert comparison.n == sum(tower >= 0 for tower in served)
    brute = sum(
        tower >= 0 and not np.isnan(row).all() and int(np.nanargmax(row)) == tower
        for tower, row in zip(served, level, strict=True)
    )
    assert comparison.n == 0 or comparison.hit_share == pytest.approx(brute / comparison.n)


def test_no_prediction_is_a_column_of_its_own() -> None:
    comparison = compare_serving([0, 1], [[np.nan, np.nan], [-70, -80]], ["a", "b"])
    assert comparison.confusion.tolist() == [[0, 0, 1], [1, 0, 0]]
    assert comparison.as_dict()["confusion"]["a"] == {"a": 0, "b": 0, "none": 1}


def test_the_value_nearest_in_time_is_that_of_a_search_through_all():
    rng = np.random.default_rng(8)
    for count in (1, 2, 3, 9):
        known, value = np.sort(rng.uniform(0.0, 10.0, count)), rng.normal(size=count)
        wanted = np.concatenate([rng.uniform(-2.0, 12.0, 40), known])
        away = np.abs(wanted[:, None] - known)
        expected = np.where(away.min(axis=1) <= 0.7, value[away.argmin(axis=1)], np.nan)
        np.testing.assert_array_equal(at_times(wanted, known, value, within_s=0.7), expected)
    assert np.isnan(at_times([1.0], [], [], within_s=0.7)).all()
