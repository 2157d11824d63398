"""Autocorrelation, resampling and intervals."""

import dataclasses

import numpy as np
import pytest
from scipy.signal import lfilter

from aerpaw_cmp.compare import statistics
from aerpaw_cmp.compare.statistics import (
    Visit,
    correlation,
    error_intervals,
    independent_samples,
    paired_difference,
    same_places,
    share_interval,
)


def shadowing(rng, n, samples, sigma):
    """Return an AR(1) sequence with a correlation time in samples."""
    keep = np.exp(-1.0 / samples)
    noise = rng.normal(size=n)
    noise[0] /= np.sqrt(1 - keep**2)
    return sigma * np.sqrt(1 - keep**2) * lfilter([1], [1, -keep], noise)


@pytest.mark.parametrize(("n", "correlation", "noise", "least"), [
    (200, 0.5, 0.0, 0.7), (200, 0.95, 0.0, 0.2), (500, 0.9, 0.0, 0.4), (3000, 0.99, 0.0, 0.1), (20_000, 0.98, 0.0, 0.5), (1000, 0.95, 0.25, 0.4),
])  # fmt: skip
def test_independent_samples_of_a_known_process(n, correlation, noise, least):
    """The median over flights: at most the true number, and less for a correlation that a flight hardly determines."""
    rng = np.random.default_rng(1)
    ratio = (1 + correlation) / (1 - correlation)
    expected = n * (1 + noise) / (ratio + noise)
    sizes = []
    for _ in range(60 if n < 10_000 else 15):
        x = shadowing(rng, n, -1.0 / np.log(correlation), 1.0) + np.sqrt(noise) * rng.normal(size=n)
        sizes.append(independent_samples(x))
    assert least * expected < np.median(sizes) < 1.1 * expected


def test_degenerate_sequences():
    assert np.isnan(independent_samples(np.arange(19.0)))
    assert independent_samples(np.zeros(100)) == 100.0
    assert np.isnan(error_intervals(np.zeros(0), np.zeros(0)).rmse_db).all()
    single = error_intervals(np.array([1.0]), np.array([2.0]))
    assert np.isnan(single.offset_db).all()
    constant = error_intervals(np.full(50, -60.0), np.full(50, -70.0))
    assert constant.offset_db == pytest.approx((-10.0, -10.0))
    assert np.isnan(constant.correlation).all()
    assert constant.rmse_db == (0.0, 0.0)


def test_what_a_pair_may_add_by_chance_is_the_rest_of_regression_on_the_other_stretches():
    """By hand: each of 24 segments uses the slope of the other 23. A single segment with a difference uses half."""
    rng = np.random.default_rng(15)
    first, second = rng.normal(size=(2, 240))
    apart, expected = first - second, np.empty(240)
    for stretch in range(24):
        inside = np.arange(240) // 10 == stretch
        even = 1e-3 * (apart @ apart)
        share = (first[~inside] @ apart[~inside] + 0.5 * even) / (apart[~inside] @ apart[~inside] + even)
        expected[inside] = 2.0 * (first[inside] - share * apart[inside]) * apart[inside]
    np.testing.assert_allclose(statistics.undecided(first, second), expected)
    alone = np.where(np.arange(240) // 10 == 5, second + 1.0, first)
    np.testing.assert_allclose(statistics.undecided(first, alone), first**2 - alone**2, atol=1e-12)


def test_the_channels_of_a_flight_are_one_test():
    """Fading that ten channels share is counted once. Samples at one time are grouped over channels."""
    rng, time = np.random.default_rng(16), np.arange(600.0)
    a, b = (shadowing(rng, 600, 8, 4.0) for _ in range(2))
    alone = statistics.pooled_difference([(time, a, b)])
    assert alone.difference_ci95_db == pytest.approx(paired_difference(a, b).difference_ci95_db)
    copies = statistics.pooled_difference([(time + 1e-3 * k, a + 5.0 * k, b - 3.0 * k) for k in range(10)])
    assert copies.n == 6000
    assert copies.difference_db == pytest.approx(alone.difference_db)
    assert np.ptp(copies.difference_ci95_db) == pytest.approx(np.ptp(alone.difference_ci95_db), rel=0.2)
    apart = [(time, *(shadowing(rng, 600, 8, 4.0) for _ in range(2))) for _ in range(10)]
    assert np.ptp(statistics.pooled_difference(apart).difference_ci95_db) < 0.5 * np.ptp(alone.difference_ci95_db)
    assert statistics.pooled_difference([]).verdict == "no interval"


def width(channels, **options):
    """Return the widths of the interval over all channels, and over the same samples as a single sequence."""
    pooled = statistics.pooled_difference(channels, **options)
    order = np.argsort(np.concatenate([time for time, *_ in channels]), kind="stable")
    errors = (np.concatenate([e[at] - e[at].mean() for e in channels])[order] for at in (1, 2))
    places = options.get("place_m")
    place = None if places is None else np.concatenate(places)[order]
    single = paired_difference(*errors, free_offset=False, place_m=place)
    return np.ptp(pooled.mean_square_ci95_db2), np.ptp(single.mean_square_ci95_db2)


def test_independent_channels_show_the_correlation_of_their_sum():
    """Ten channels of 300 samples with 15 correlation times: the interval is narrower than for a single sequence."""
    rng, time = np.random.default_rng(31), np.arange(300.0)
    flights = [[(time, *(shadowing(rng, 300, 20, 4.0) for _ in range(2))) for _ in range(10)] for _ in range(12)]
    narrower = [pooled / single for pooled, single in map(width, flights)]
    assert np.median(narrower) < 0.85
    alone = [width(channels[:1]) for channels in flights]
    assert all(pooled == single for pooled, single in alone)


def test_channels_that_are_not_independent_add_nothing():
    """Copies, common fading with noise of each channel, and a channel of few samples: as for a single sequence."""
    rng, time = np.random.default_rng(32), np.arange(400.0)
    a, b = (shadowing(rng, 400, 30, 4.0) for _ in range(2))
    pooled, single = width([(time + 1e-3 * k, a, b) for k in range(5)])
    assert pooled == pytest.approx(single, rel=1e-6)
    noisy = [(time, *(e + rng.normal(0.0, 4.0, 400) for e in (a, b))) for _ in range(10)]
    pooled, single = width(noisy)
    assert pooled == pytest.approx(single, rel=0.02)
    pooled, single = width([(time, a, b), (time[::50], *rng.normal(0.0, 1.0, (2, 8)))])
    assert pooled == pytest.approx(single, rel=0.02)


def test_products_of_errors_about_their_mean_are_correlated_at_any_distance():
    """Four rounds of a circle, errors over 0.96 times its diameter: by simulation, then as terms of the products."""
    rng, angle = np.random.default_rng(33), np.linspace(0.0, 2.0 * np.pi, 60, endpoint=False)
    place = 150.0 * np.column_stack([np.cos(angle), np.sin(angle), 0.0 * angle])
    covariance = np.exp(-np.linalg.norm(place[:, None] - place, axis=2) / 288.0)
    first, second = (rng.normal(size=(40_000, 60)) @ np.linalg.cholesky(covariance).T for _ in range(2))
    products = (first - first.mean(axis=1, keepdims=True)) * (second - second.mean(axis=1, keepdims=True))
    expected = np.square(statistics._about_mean(covariance))
    np.testing.assert_allclose(np.cov(products.T), expected, atol=0.06 * expected.max())
    known = statistics.place_correlations(np.tile(place, (4, 1)), 24, centred=True)
    cosines = np.cos(np.pi * np.outer(np.arange(25), (np.arange(240) + 0.5) / 240))
    cosines[1:] *= np.sqrt(2.0)
    terms = cosines @ np.tile(expected, (4, 4)) @ cosines.T
    share = statistics.PLACE_WHITE[0]
    mixed = (1.0 - share) * terms / np.trace(terms[1:, 1:]) + share * np.eye(25) / 24
    slope = np.linalg.solve(mixed[1:, 1:], mixed[0, 1:])
    # the eighth length is 0.96 times the root mean square distance, half of the length of the errors
    assert known.variance[8] == pytest.approx(mixed[0, 0] - slope @ mixed[0, 1:])


def test_channels_of_different_length_time_and_place():
    """Channels with gaps, other rates and missing positions still have an interval, also from held-out errors."""
    rng = np.random.default_rng(34)
    channels, places = [], []
    for step, start in ((1, 0), (3, 100), (40, 0)):
        time = np.arange(start, 600, step, dtype=float)
        first, second = rng.normal(size=(2, len(time)))
        first[: len(time) // 5] = np.nan
        channels.append((time, first, second))
        place = np.column_stack([10.0 * time, 20.0 * np.sin(time), 0.0 * time])
        places.append(np.where(rng.random(len(time))[:, None] < 0.05, np.nan, place))
    for free in (True, False):
        pair = statistics.pooled_difference(channels, place_m=places, free_offset=free)
        low, high = pair.mean_square_ci95_db2
        assert low < pair.mean_square_difference_db2 < high
        assert pair.n == sum(np.isfinite(first).sum() for _, first, _ in channels)


def test_verdicts_of_channels_are_corrected_for_their_number():
    """Holm by hand at 0.02: 0.004 x 4 and 0.006 x 3 stay, 0.012 x 2 does not, nor what comes behind it."""
    pair = paired_difference(np.arange(30.0), 2.0 * np.arange(30.0))
    pairs = [dataclasses.replace(pair, p_value=p, verdict="better") for p in (0.012, 0.004, 0.013, 0.006)]
    none = dataclasses.replace(pair, p_value=1.0, verdict="no interval")
    words = [entry.verdict for entry in statistics.corrected([*pairs, none])]
    assert words == ["not significant", "better", "not significant", "better", "no interval"]
    assert [entry.verdict for entry in statistics.corrected([pairs[2], none])] == ["better", "no interval"]


def test_nineteen_samples_are_too_few_for_an_interval_and_twenty_are_not():
    values = np.random.default_rng(8).normal(size=20)
    for n, some in ((19, False), (20, True)):
        fit = error_intervals(values[:n], 0.5 * values[:n][::-1])
        pair = paired_difference(values[:n], 0.5 * values[:n][::-1])
        spans = [fit.offset_db, fit.rmse_db, fit.correlation, pair.difference_ci95_db, pair.mean_square_ci95_db2]
        spans += [statistics.mean_interval(values[:n]), statistics.spread_interval(values[:n])]
        assert (np.isfinite(spans) == some).all()
        assert np.isfinite(pair.standard_error_db) == some
        assert (pair.verdict == "no interval") != some


@pytest.mark.parametrize("neighbours", [0.0, 0.9, 0.98])
def test_a_given_interval_holds_and_one_is_given(neighbours):
    """Few hundred samples of any memory: offset, RMSE, correlation and pair. All cells: benchmarks/coverage_of_intervals.py."""
    rng = np.random.default_rng([5, round(100 * neighbours)])
    n, runs = 200, 200
    t = np.linspace(0, 2 * np.pi, n)
    simulated = -80 + 8 * np.sin(3 * t) + 4 * np.cos(11 * t)
    truth = np.array([7.3, 4.0, np.sqrt(simulated.var() / (simulated.var() + 16.0)), 0.0])
    covered = np.zeros(4)
    for _ in range(runs):
        error, other = (shadowing(rng, n, -1 / np.log(max(neighbours, 1e-9)), 4.0) for _ in range(2))
        fit = error_intervals(simulated - 7.3 + error, simulated)
        pair = paired_difference(error, 0.5 * error + np.sqrt(0.75) * other)
        bounds = np.array([fit.offset_db, fit.rmse_db, fit.correlation, pair.difference_ci95_db])
        assert np.isfinite(bounds[:3]).all()
        covered += ~((bounds[:, 0] > truth) | (truth > bounds[:, 1]))  # with few correlations, a pair may have none
    assert (covered >= 0.90 * runs).all()  # 0.3: offset 49 %, RMSE 11 % of those given at 0.98
    assert covered[[0, 1, 3]].sum() < 3 * runs - 6  # and intervals that always hold say nothing


def test_interval_of_independent_samples_is_that_of_the_textbook():
    """White noise: the widths of Student's and the chi-squared interval, within a fifth."""
    rng = np.random.default_rng(6)
    n, ends = 1000, []
    for _ in range(40):
        fit = error_intervals(rng.normal(0, 3, n), np.zeros(n))
        ends.append([np.ptp(fit.offset_db), np.ptp(fit.rmse_db)])
    offset, rmse = np.median(ends, axis=0)
    assert offset == pytest.approx(2 * 1.96 * 3 / np.sqrt(n), rel=0.2)
    assert rmse == pytest.approx(2 * 1.96 * 3 / np.sqrt(2 * n), rel=0.2)


def test_an_interval_wider_than_twice_its_value_is_a_bound(monkeypatch):
    ramp = np.arange(30.0) - 14.5
    for factor, bound in ((1.9, False), (2.1, True)):
        drawn = np.square(np.linspace(0.0, factor / 0.95 * ramp.std(), 20_001) + 0.5 * ramp.std())
        monkeypatch.setattr(statistics, "power_draws", lambda *_, drawn=drawn: drawn)
        low, high = statistics.spread_interval(ramp)
        assert low == pytest.approx((0.5 + 0.025 * factor / 0.95) * ramp.std(), rel=1e-3)
        assert np.isinf(high) == bound


def test_a_difference_whose_interval_nobody_can_use_has_none(monkeypatch):
    """An interval that contains 0 and extends beyond one of the errors (2 dB) is not reported.

    The same holds if the models are exchanged.
    """
    errors = np.tile([2.0, -2.0], 50), np.tile([2.0, 2.0, -2.0, -2.0], 25)
    for half_db2, given in ((7.9, True), (8.1, False)):
        draws = np.linspace(-half_db2 / 0.95, half_db2 / 0.95, 4097)
        monkeypatch.setattr(statistics, "mean_draws", lambda *_, draws=draws, **__: draws)
        for pair in (errors, errors[::-1]):
            known = paired_difference(*pair)
            assert np.isfinite(known.difference_ci95_db).all() == given
            assert known.verdict == ("not significant" if given else "no interval")


def test_a_significant_difference_of_a_flight_of_few_correlation_times_is_found():
    """Twice the error of another model, ten correlation times: 0.3 gave no verdict."""
    rng = np.random.default_rng(7)
    words = []
    for _ in range(60):
        first, second = (shadowing(rng, 500, 25, 4.0) for _ in range(2))
        words.append(paired_difference(2 * first, second).verdict)
    assert "better" not in words
    assert words.count("worse") > 20


def test_an_influence_interval_respects_the_bounds_of_its_statistic():
    few, many = (np.random.default_rng(0).normal(size=n) for n in (19, 20))
    assert np.isnan(statistics.influence_interval(0.02, few)).all()
    assert np.isnan(statistics.influence_interval(np.nan, many)).all()
    low, high = statistics.influence_interval(0.02, 0.1 * many, bounds=(0.0, 1.0))
    assert (low, high) == (
        0.0,
        pytest.approx(0.02 + 0.1 * np.quantile(statistics.mean_draws(many, "influence"), 0.975)),
    )


def test_share_interval_is_wilsons():
    """The shares whose own normal interval just reaches the one that was seen, with the effective number of samples."""
    assert np.isnan(share_interval(np.zeros(19))).all()
    seen = np.repeat(np.random.default_rng(1).random(100) < 0.3, 4).astype(float)
    sd = np.ptp(statistics.influence_interval(float(seen.mean()), seen)) / 2 / 1.959964
    for end in share_interval(seen):
        assert abs(end - seen.mean()) == pytest.approx(1.959964 * sd * np.sqrt(end * (1 - end) / seen.var()), rel=1e-6)
    z2 = 1.959964**2
    assert share_interval(np.zeros(40)) == (0.0, pytest.approx(z2 / (40 + z2)))
    slow = np.repeat([1.0, 2.0, 1.0, 2.0], 10)  # a rank that a slow sequence never reached
    assert share_interval(np.zeros(40), sequence=slow)[1] > 0.3


def test_correlation():
    rng = np.random.default_rng(7)
    a, b = rng.normal(size=(2, 40))
    assert correlation(a, b) == pytest.approx(np.corrcoef(a, b)[0, 1])
    assert correlation([1, 2, np.nan, 3], [2, 4, 5, 6]) == pytest.approx(1.0)
    assert np.isnan(correlation([1, 1, 1], [1, 2, 3]))
    assert np.isnan(correlation([1, 2], [5, 3]))
    assert correlation([1, 2, 3], [5, 3, 1]) == -1.0
    assert correlation([1e8, 1e8 + 1, 1e8 + 2], [1, 2, 3]) == pytest.approx(1.0)


def test_interval_of_a_correlation_whose_residual_goes_with_the_simulation():
    rng = np.random.default_rng(10)
    s = rng.normal(-80, 6, 1000)
    m = 0.4 * s + rng.normal(0, 2, 1000)
    truth = 0.4 * 6 / np.hypot(0.4 * 6, 2)
    low, high = error_intervals(m, s).correlation
    assert low < truth < high
    # Fisher's z of independent samples
    assert np.ptp(np.arctanh([low, high])) == pytest.approx(2 * 1.96 / np.sqrt(997), rel=0.3)


def test_the_interval_of_a_paired_difference_contains_the_difference(monkeypatch):
    """On a flight with one long trend, all draws can be on one side of the difference of the samples."""
    monkeypatch.setattr(statistics, "mean_draws", lambda *_: np.linspace(1.0, 2.0, 100))
    pair = paired_difference(np.tile([3.0, -3.0], 50), np.tile([2.0, -2.0], 50))
    assert pair.difference_ci95_db == pytest.approx((1.0, (5.0 + 1.975) / 5.0), abs=0.01)


def test_a_paired_difference_sees_what_two_intervals_of_their_own_hide():
    """Errors that share most of their shadowing: 4.0 and 4.2 dB, intervals that overlap widely, yet one is worse."""
    rng = np.random.default_rng(12)
    common = shadowing(rng, 4000, 15, 4.0)
    noisier, quieter = common + rng.normal(0, 1.5, 4000), common
    zeros = np.zeros(4000)
    first, second = (error_intervals(zeros, -error).rmse_db for error in (noisier, quieter))
    assert first[0] < second[1]  # their own intervals overlap
    pair = paired_difference(noisier, quieter)
    assert pair.verdict == "worse"
    truth = np.sqrt(16 + 1.5**2) - 4
    assert pair.difference_ci95_db[0] < truth < pair.difference_ci95_db[1]
    assert pair.in_words("free space").startswith("worse than free space by 0.3 dB [0.")
    back = paired_difference(quieter, noisier)
    assert back.verdict == "better"
    assert back.difference_ci95_db == pytest.approx((-pair.difference_ci95_db[1], -pair.difference_ci95_db[0]))
    assert back.in_words("b").startswith("better than b by 0.3 dB")


def test_beside_a_model_without_error_the_whole_error_of_the_other_is_the_difference():
    error = shadowing(np.random.default_rng(14), 300, 5, 4.0)
    pair, back = paired_difference(error, np.zeros(300)), paired_difference(np.zeros(300), error)
    assert (pair.verdict, back.verdict) == ("worse", "better")
    assert pair.mean_square_ci95_db2 == pytest.approx((error.var(),) * 2, rel=1e-3)
    assert back.difference_ci95_db == pytest.approx((-error.std(),) * 2, rel=1e-3)
    assert paired_difference(np.zeros(300), np.zeros(300)).difference_ci95_db == (0.0, 0.0)


def test_errors_kept_out_of_a_fit_count_with_their_offset():
    biased, centred = np.full(200, 3.0) + np.tile([1.0, -1.0], 100), np.tile([2.0, -2.0], 100)
    assert paired_difference(biased, centred).difference_db == pytest.approx(-1.0)
    kept_out = paired_difference(biased, centred, free_offset=False)
    assert kept_out.rmse_db == pytest.approx(np.sqrt(10.0))
    assert kept_out.verdict == "worse"
    assert kept_out.mean_square_difference_db2 == pytest.approx(6.0)


def test_pairs_that_cannot_be_compared():
    none = paired_difference([np.nan, 1.0], [1.0, np.nan])
    assert (none.n, none.verdict) == (0, "no interval")
    assert np.isnan(none.difference_ci95_db).all()
    assert none.in_words("two-ray") == "no sample in common with two-ray"
    same = paired_difference(np.arange(100.0), np.arange(100.0))
    assert same.verdict == "not significant"
    assert same.difference_db == 0.0


def test_same_places_pairs_the_nearest_and_wraps_headings():
    a = np.array([[0.0, 0, 0], [10, 0, 0], [np.nan, 0, 0]])
    b = np.array([[10.5, 0, 0], [0.2, 0, 0], [0.1, 0, 0]])
    here, there = same_places(Visit(a, np.zeros(3)), Visit(b, np.zeros(3)))
    assert (here.tolist(), there.tolist()) == ([0, 1], [2, 0])
    turned = Visit(a, np.zeros(3), np.array([359.0, 0, 0])), Visit(b, np.zeros(3), np.array([90.0, 0, 1]))
    here, _ = same_places(*turned)
    assert here.tolist() == [0]


def test_models_of_equal_error_are_called_different_at_most_as_often_as_stated():
    rng = np.random.default_rng(13)
    wrong, truth_held = 0, 0
    for _ in range(150):
        common = shadowing(rng, 1500, 8, 3.0)
        first, second = (common + shadowing(rng, 1500, 8, 2.0) + level for level in (5.0, -3.0))
        pair = paired_difference(first, second)
        wrong += pair.verdict in ("better", "worse")
        low, high = pair.difference_ci95_db
        truth_held += low <= 0 <= high
    assert wrong <= 15  # 5 % of 150 is 7.5
    assert truth_held + wrong == 150


def test_a_level_is_flat_below_a_fifth_of_every_prediction() -> None:
    wave_db = np.linspace(-5.0, 5.0, 101)
    for factor, flat in ((0.19, True), (0.21, False)):
        assert statistics.is_flat(factor * wave_db, [3.0 * wave_db, wave_db]) is flat
