"""Numbers of a campaign against closed forms, brute force, and the coverage of their intervals."""

import numpy as np
import pytest
from scipy.stats import t as student

from aerpaw_cmp.compare.offset import grid_offset
from aerpaw_cmp.compare.verdict import error_at_offset, left_out_offsets, mean_of_flights, verdict_of


def test_offset_of_the_others_is_the_search_over_their_samples():
    rng = np.random.default_rng(3)
    flights = [(rng.normal(-60, 5, n), rng.normal(-80, 5, n)) for n in (7, 30, 200, 1)]
    offsets = left_out_offsets([len(m) for m, _ in flights], [float((s - m).mean()) for m, s in flights])
    for i in range(len(flights)):
        rest = [f for j, f in enumerate(flights) if j != i]
        fit = grid_offset(np.concatenate([m for m, _ in rest]), np.concatenate([s for _, s in rest]))
        assert offsets[i] == fit.offset_db


def test_a_flight_alone_or_without_samples():
    assert np.isnan(left_out_offsets([5], [1.0])).all()
    assert left_out_offsets([5, 0], [1.0, np.nan])[1] == 1.0
    assert np.isnan(left_out_offsets([5, 0], [1.0, np.nan])[0])


def test_error_at_another_offset_is_the_error_of_the_samples_there():
    rng = np.random.default_rng(4)
    measured, simulated = rng.normal(-60, 5, 300), rng.normal(-80, 5, 300)
    fit, mean = grid_offset(measured, simulated), float((simulated - measured).mean())
    for offset in (-30.0, fit.offset_db, 0.0):
        expected = np.sqrt(np.mean((measured + offset - simulated) ** 2))
        assert error_at_offset(offset, fit.rmse_db, fit.offset_db, mean) == pytest.approx(expected, rel=1e-9)


def test_few_flights_and_missing_ones():
    assert mean_of_flights([]).n == 0
    pair = mean_of_flights([1.0, np.nan, 3.0])
    assert (pair.n, pair.mean) == (2, 2.0)
    assert np.isnan(pair.low)
    assert verdict_of(pair) == "no interval"
    assert verdict_of(mean_of_flights([1.0, 1.1, 0.9, 1.0])) == "worse"
    assert verdict_of(mean_of_flights([1.0, -1.0, 0.5, -0.5])) == "not significant"
    same = mean_of_flights(np.full(30, 0.25))
    assert (same.low, same.high) == (0.25, 0.25)


@pytest.mark.parametrize(("correlation", "least"), [(0.0, 0.93), (0.6, 0.87)])
def test_intervals_of_24_flights_contain_the_mean(correlation: float, least: float) -> None:
    """For independent flights, at most one interval in ten is wider than Student's t.

    For correlated flights, intervals are wider.
    """
    rng, inside, wider = np.random.default_rng(8), [], []
    for _ in range(400):
        values = rng.normal(size=64)
        for k in range(1, 64):
            values[k] += correlation * values[k - 1]
        last = values[40:]
        mean = mean_of_flights(last)
        inside.append(mean.low <= 0.0 <= mean.high)
        plain = student.ppf(0.975, 23) * last.std(ddof=1) / np.sqrt(24)
        wider.append(0.5 * (mean.high - mean.low) / plain)
    assert least < np.mean(inside) < 0.98
    assert (np.median(wider) < 1.1) == (correlation == 0.0)


@pytest.mark.parametrize("n", [3, 19, 20])
def test_intervals_are_those_of_students_t(n):
    """For twenty flights that drift, the effective number is that of independent flights."""
    values = np.arange(n) // 4 + np.sin(np.arange(n))
    mean, change = mean_of_flights(values), values - values.mean()
    r = np.sum(change[1:] * change[:-1]) / np.sum(change**2)
    r += (1.0 + 3.0 * r) / n
    independent = max(n * (1.0 - r) / (1.0 + r), 3.0) if n >= 20 else n
    reach = student.ppf(0.975, independent - 1) * values.std(ddof=1) / np.sqrt(independent)
    assert (mean.n, mean.low, mean.high) == pytest.approx((n, values.mean() - reach, values.mean() + reach))
    slow = np.cumsum(np.ones(40)) + values[0]
    drift, width = mean_of_flights(slow), student.ppf(0.975, 2.0) * slow.std(ddof=1) / np.sqrt(3.0)
    assert drift.high - drift.mean == pytest.approx(width)  # one long drift counts as three flights
