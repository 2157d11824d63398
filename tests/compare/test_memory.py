"""Correlations of a sequence: covariances by numerical integration, likelihoods by SciPy, posterior draws."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.signal import lfilter
from scipy.stats import multivariate_normal

from aerpaw_cmp.compare import statistics
from aerpaw_cmp.compare.statistics import (
    RATES,
    TERMS,
    WHITE_SHARES,
    cosine_terms,
    likelihoods,
    mean_draws,
    time_correlations,
)
from aerpaw_cmp.compare.verdict import stated_errors

POINTS = 2000


def integrated(rate: float, terms: int, law: Callable[[np.ndarray], np.ndarray] | None = None) -> np.ndarray:
    """Return the covariance of mean and cosine terms of exp(-rate |s - t|) or another kernel, by the midpoint rule."""
    at = (np.arange(POINTS) + 0.5) / POINTS
    basis = np.sqrt(2.0) * np.cos(np.pi * np.outer(np.arange(terms + 1), at))
    basis[0] = 1.0
    lag = np.abs(at[:, None] - at)
    return basis @ (np.exp(-rate * lag) if law is None else law(lag)) @ basis.T / POINTS**2


@pytest.mark.parametrize("rate", [0.3, 4.0, 40.0])
def test_the_covariance_of_cosine_terms_is_the_double_integral(rate: float) -> None:
    np.testing.assert_allclose(statistics._exponential(rate, 6), integrated(rate, 6), atol=2e-4 / rate)


@pytest.mark.parametrize("rate", [0.3, 4.0, 40.0])
def test_the_covariance_of_a_smooth_memory_is_that_of_matern_three_halves(rate: float) -> None:
    expected = integrated(rate, 6, lambda lag: (1.0 + rate * lag) * np.exp(-rate * lag))
    np.testing.assert_allclose(statistics._smooth(rate, 6), expected, atol=2e-4 / rate)


@pytest.mark.parametrize(("share", "rate"), [(0, 0), (0, 9), (1, 4), (2, 17)])
def test_a_memory_whitens_its_terms_and_foretells_the_mean(share: int, rate: int) -> None:
    """The index of the rate changes fastest.

    Half the rate times the covariance has power 1 at the low end of an infinite sequence.
    """
    white, known, at = WHITE_SHARES[share], time_correlations(6), share * len(RATES) + rate
    covariance = (1.0 - white) * 0.5 * RATES[rate] * statistics._exponential(RATES[rate], 6) + white * np.eye(7)
    inner, cross = covariance[1:, 1:], covariance[0, 1:]
    whiten = known.whiten[at]
    np.testing.assert_allclose(whiten @ inner @ whiten.T, np.eye(6), atol=1e-9)
    np.testing.assert_allclose(known.slope[at], np.linalg.solve(inner, cross), atol=1e-9)
    assert known.variance[at] == pytest.approx(covariance[0, 0] - cross @ np.linalg.solve(inner, cross))
    assert known.log_det[at] == pytest.approx(-0.5 * np.linalg.slogdet(inner)[1])
    assert known.power[at] == pytest.approx(np.trace(inner)), "about the mean of the sequence"


def test_the_likelihood_is_that_of_a_normal_with_its_scale_integrated_out() -> None:
    slow, known = np.random.default_rng(1).normal(size=5), time_correlations(5)
    likelihood, square = likelihoods(slow)
    scales = np.exp(np.linspace(-8.0, 8.0, 4001))
    expected = []
    for whiten in known.whiten[[0, 20, 53]]:
        inner = np.linalg.inv(whiten.T @ whiten)
        expected.append(np.sum([multivariate_normal(np.zeros(5), s**2 * inner).pdf(slow) for s in scales[::10]]))
        assert square[np.flatnonzero((known.whiten == whiten).all(axis=(1, 2)))[0]] == pytest.approx(
            slow @ np.linalg.solve(inner, slow)
        )
    np.testing.assert_allclose(likelihood[[0, 20, 53]] / likelihood[0], np.array(expected) / expected[0], rtol=1e-6)
    assert likelihood.max() == 1.0


@pytest.mark.parametrize("kind", ["mean", "power", "ratio"])
def test_before_any_sample_every_memory_is_possible_and_none_stands_out_from_its_neighbours(
    kind: statistics.Kind,
) -> None:
    drawn = statistics.weights(kind)
    assert drawn.sum() == pytest.approx(1.0)
    assert len(drawn) == len(time_correlations().power)
    assert drawn.min() > 1e-8 * drawn.max()
    bend = np.diff(np.log(drawn).reshape(-1, len(RATES)), 2, axis=1)
    assert np.abs(bend).max() < 7.0


@pytest.mark.parametrize("n", [20, 33, 400])
def test_cosine_terms_hold_the_whole_power(n: int) -> None:
    values = np.random.default_rng(n).normal(3.0, 2.0, n)
    terms = cosine_terms(values)
    assert len(terms.slow) == {20: 9, 33: 16, 400: TERMS}[n]
    assert np.square(terms.slow).sum() + terms.fast_power == pytest.approx(values.var())
    wave = np.cos(np.pi * 3 * (np.arange(n) + 0.5) / n)
    assert np.abs(np.delete(cosine_terms(5.0 + wave).slow, 2)).max() < 1e-12, "the third term alone"


def test_white_noise_has_as_many_degrees_of_freedom_as_samples() -> None:
    rng = np.random.default_rng(2)
    every = [cosine_terms(rng.normal(size=200)) for _ in range(200)]
    assert np.mean([terms.fast_freedom for terms in every]) == pytest.approx(200 - TERMS, rel=0.05)


def test_draws_are_spread_as_their_distributions() -> None:
    uniform, chi_squared, *normal = statistics._random(7)
    assert (uniform.mean(), uniform.var()) == pytest.approx((1 / 2, 1 / 12), rel=0.01)
    assert (chi_squared.mean(), chi_squared.var()) == pytest.approx((7.0, 14.0), rel=0.03)
    for unit in normal:
        assert (unit.mean(), unit.var()) == pytest.approx((0.0, 1.0), abs=0.02)
    together = np.corrcoef([uniform, chi_squared, *normal])
    assert np.abs(together - np.eye(4)).max() < 0.03


@pytest.mark.parametrize("by", [0.7, 1.0, 1.5])
def test_a_stretch_moves_the_ends_of_an_interval_and_leaves_every_draw_in_its_place(by: float) -> None:
    drawn = np.random.default_rng(4).normal(size=4096) ** 3
    stretched, tail = statistics._stretched(drawn, by), 1.0 / (1.0 + 39.0**by)  # the odds of 2.5 %, to that power
    np.testing.assert_allclose(
        np.quantile(stretched, [0.025, 0.975]), np.quantile(drawn, [tail, 1.0 - tail]), rtol=0.02
    )
    assert (np.diff(stretched[np.argsort(drawn)]) >= 0.0).all()


@pytest.mark.parametrize("n", [20, 60, 300, 3000])
def test_the_ends_of_any_interval_lie_between_the_outer_thousandth_and_tenth_of_its_draws(n: int) -> None:
    for keep in (0.0, 0.5, 0.9, 0.99, 1.0):
        for seed in (n, 22):  # after 60 steps, the second walk would be outside by its shares
            values = lfilter([1.0], [1.0, -keep], np.random.default_rng(seed).normal(size=n))
            slow = cosine_terms(values).slow
            known = [statistics.weighted_correlations(kind, len(slow)) for kind in ("mean", "power")]
            stretches = [statistics._picked(slow, each)[2] for each in known]
            assert 0.001 < 1.0 / (1.0 + 39.0 ** max(stretches)) <= 1.0 / (1.0 + 39.0 ** min(stretches)) < 0.1


def innovations_excess(values: np.ndarray) -> float:
    """Excess kurtosis of the innovations by the correlation of neighbours, the greater of both directions of time."""
    away = values - values.mean()
    keep = (away[1:] * away[:-1]).sum() / (away**2).sum()
    innovations = away[1:] - keep * away[:-1], away[:-1] - keep * away[1:]
    return float(max(np.mean(e**4) / np.mean(e**2) ** 2 for e in innovations) - 3.0)


def test_draws_follow_unit_and_zero_and_do_not_know_the_direction_of_time() -> None:
    values = np.cumsum(np.random.default_rng(3).normal(size=120))
    mean, power = mean_draws(values), statistics.power_draws(values)
    np.testing.assert_allclose(mean_draws(7.0 + 3.0 * values), 3.0 * mean, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(np.sort(mean_draws(-values)), np.sort(-mean), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(statistics.power_draws(5.0 + 3.0 * values), 9.0 * power, rtol=1e-9)
    np.testing.assert_allclose(mean_draws(values[::-1]), mean, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(statistics.power_draws(values[::-1]), power, rtol=1e-6)
    assert mean_draws(np.full(30, 2.0)).tolist() == [0.0] * len(mean)
    assert not statistics.power_draws(np.full(30, 2.0)).any()


@pytest.mark.parametrize(("share", "widened"), [(0.99, False), (1.01, True)])
def test_only_tails_beyond_chance_widen_the_power(share: float, widened: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """The excess kurtosis of n normal samples has a standard error of sqrt(24 / n): only beyond half of it the last draw counts."""
    signs = np.where(np.random.default_rng(5).random(400) < 0.5, -1.0, 1.0)

    def sequence(large: float) -> np.ndarray:
        values = signs * np.where(np.arange(400) % 40, 1.0, large)
        return values - values.mean()

    def beyond(large: float) -> float:
        return innovations_excess(sequence(large)) - share * np.sqrt(6.0 / 399)

    values = sequence(brentq(beyond, 1.0, 8.0))
    usual, drawn = statistics.power_draws(values), statistics._random(TERMS)
    monkeypatch.setattr(statistics, "_random", lambda _: (*drawn[:2], 0.0 * drawn[2], drawn[3]))
    assert np.array_equal(statistics.power_draws(values), usual) != widened


@pytest.mark.parametrize("samples", [20, 80])
def test_the_likeliest_memory_is_about_that_of_the_sequence(samples: int) -> None:
    rng, keep = np.random.default_rng(samples), np.exp(-1.0 / samples)
    shares = [statistics.memory_share(lfilter([1.0], [1.0, -keep], rng.normal(size=2000))) for _ in range(20)]
    assert np.median(shares) * 2000 == pytest.approx(samples, rel=0.6)


def lawnmower(n: int) -> np.ndarray:
    """Positions (n, 3) on legs of 400 m that lie 60 m apart, a sample every 10 m."""
    leg, along = np.divmod(np.arange(n), 40)
    return np.column_stack([np.where(leg % 2 == 0, along, 39 - along) * 10.0, 60.0 * leg, np.zeros(n)])


def shadowed(place_m: np.ndarray, length_m: float, flights: int, seed: int) -> np.ndarray:
    """Errors (flights, n) that are correlated over place, with white noise of 0.4 of their standard deviation."""
    covariance = np.exp(-np.linalg.norm(place_m[:, None] - place_m, axis=2) / length_m)
    root = np.linalg.cholesky(covariance + 1e-9 * np.eye(len(place_m)))
    rng = np.random.default_rng(seed)
    return rng.normal(size=(flights, len(root))) @ root.T + 0.4 * rng.normal(size=(flights, len(root)))


def test_a_memory_over_place_is_the_covariance_of_its_terms_along_the_track() -> None:
    place, terms = lawnmower(100), 24
    size = np.sqrt(np.square(place - place.mean(axis=0)).sum(axis=1).mean())
    basis = np.sqrt(2.0) * np.cos(np.pi * np.outer(np.arange(terms + 1), (np.arange(100) + 0.5) / 100)) / 100
    basis[0] = 0.01
    apart = np.linalg.norm(place[:, None] - place, axis=2)
    known = statistics.place_correlations(place, terms)
    assert known is not None
    for at, length in enumerate(statistics.LENGTHS * size):
        covariance = basis @ np.exp(-apart / length) @ basis.T
        inner = covariance[1:, 1:] / np.trace(covariance[1:, 1:])
        for number, white in enumerate(statistics.PLACE_WHITE):
            whiten = known.whiten[number * len(statistics.LENGTHS) + at]
            mixed = (1.0 - white) * inner + white * np.eye(terms) / terms
            np.testing.assert_allclose(whiten @ mixed @ whiten.T, np.eye(terms), atol=1e-6)
    assert len(known.power) == len(statistics.LENGTHS) * (len(statistics.PLACE_WHITE) + len(statistics.PLACE_FADING))


def test_errors_as_large_as_stated_get_no_verdict_on_a_lawnmower_over_shadowing() -> None:
    place, sd = lawnmower(400), np.full(400, np.sqrt(1.16))
    knowing, alone = (
        np.mean([stated_errors(e, sd, place_m=known).cause == "biased" for e in shadowed(place, 150.0, 60, seed=4)])
        for known in (place, None)
    )
    assert knowing <= 0.06
    assert alone >= 0.12, "by time alone the offset of a flight looks like a bias"


def test_intervals_of_a_lawnmower_over_shadowing_cover_the_truth() -> None:
    """With correlation over time alone, three of four offsets are covered, because the track returns."""
    place = lawnmower(400)
    errors = shadowed(place, 150.0, 150, seed=3)
    truth = np.sqrt(errors.var(axis=1).mean())
    held = [(low <= 0.0 <= high, least <= truth <= most) for low, high, least, most in
            ((*statistics.mean_interval(e, place), *statistics.spread_interval(e, place)) for e in errors)]  # fmt: skip
    offset, rmse = np.mean(held, axis=0)
    assert (offset > 0.9, rmse > 0.88) == (True, True), (offset, rmse)
    alone = np.mean([low <= 0.0 <= high for low, high in map(statistics.mean_interval, errors)])
    assert alone < 0.85


def test_equal_models_on_a_lawnmower_seldom_get_a_verdict() -> None:
    place, flights = lawnmower(400), 80
    own, other = (shadowed(place, 150.0, flights, seed) for seed in (5, 6))
    pairs = [(a, 0.5 * a + np.sqrt(0.75) * b) for a, b in zip(own, other, strict=True)]
    decided = [
        np.mean([statistics.paired_difference(*pair, place_m=known).verdict in ("better", "worse") for pair in pairs])
        for known in (place, None)
    ]
    assert decided[0] <= 0.1 < decided[1], decided


def test_white_errors_are_not_taken_for_shadowing() -> None:
    place, errors = lawnmower(400), np.random.default_rng(8).normal(size=(20, 400))
    widths = np.array([[np.ptp(statistics.mean_interval(e, known)) for known in (place, None)] for e in errors])
    assert np.median(widths[:, 0] / widths[:, 1]) < 1.1


@pytest.mark.parametrize(
    ("place", "reason"),
    [
        (np.random.default_rng(1).normal(0.0, 2.0, (200, 3)), "the UAV hardly moved"),
        (np.where(np.arange(200)[:, None] % 2, np.nan, lawnmower(200)), "50 % of the samples have no position"),
        (np.where(np.arange(200)[:, None] % 8 == 0, np.nan, lawnmower(200)), "12 % of the samples have no position"),
        (np.full((200, 3), np.nan), "100 % of the samples have no position"),
    ],
)
def test_a_hover_or_missing_positions_leave_correlation_over_time_and_say_so(place: np.ndarray, reason: str) -> None:
    values = np.cumsum(np.random.default_rng(2).normal(size=200))
    assert statistics.only_time(place) == reason
    assert np.array_equal(mean_draws(values, place_m=place), mean_draws(values))
    (note,) = statistics.error_intervals(np.zeros(200), values, place).notes
    assert note == f"The intervals consider correlation over time only: {reason}."


def test_positions_that_repeat_or_miss_a_few_samples_serve() -> None:
    place, values = np.repeat(lawnmower(100), 2, axis=0), np.random.default_rng(4).normal(size=200)
    some = np.where(np.arange(200)[:, None] % 20 == 0, np.nan, place)
    for known in (place, some):
        assert statistics.only_time(known) == ""
        low, high = statistics.mean_interval(values, known)
        assert -0.6 < low < values.mean() < high < 0.6
    assert np.isnan(statistics.mean_interval(values[:2], place[:2])).all(), "two samples have no interval"


@pytest.mark.parametrize("keep", [0.0, 0.9])
def test_a_loud_part_widens_the_rmse_and_is_named(keep: float) -> None:
    flights = np.array([lfilter([1.0], [1.0, -keep], e) for e in np.random.default_rng(9).normal(size=(60, 400))])
    assert all(statistics.loud_part(e) == (0.0, 1.0) for e in flights)
    steady = flights.copy()
    flights[:, 100:166] *= 5.0
    found = np.array([statistics.loud_part(e) for e in flights])
    assert found[:, 0] == pytest.approx(1.0 / 6.0, abs=0.1)
    assert (found[:, 1] > 4.0).all()
    truth = np.sqrt(flights.var(axis=1).mean())
    held = [low <= truth <= high for low, high in map(statistics.spread_interval, flights)]
    assert np.mean(held) > 0.9
    assert statistics.error_intervals(np.zeros(400), steady[0]).notes == ()
    (note,) = statistics.error_intervals(np.zeros(400), flights[0]).notes
    assert note.startswith("The error is not stationary: it is ")


def test_a_track_that_is_flown_again_adds_little_to_what_is_known_of_the_rmse() -> None:
    """Errors over place are equal on the second round, so twice as many samples do not narrow the interval by a third."""
    corners = np.random.default_rng(8).uniform(0.0, 500.0, (30, 2))
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    track = np.column_stack([*(np.interp(np.arange(0.0, along[-1], 10.0), along, axis) for axis in corners.T)])
    track = np.column_stack([track, np.full(len(track), 40.0)])
    apart = np.linalg.norm(track[:, None] - track, axis=2)
    root = np.linalg.cholesky(np.exp(-apart / 25.0) + 1e-9 * np.eye(len(track)))
    ratios = []
    for seed in range(12):
        error = 4.0 * root @ np.random.default_rng(seed).normal(size=len(track))
        once, twice = (np.ptp(statistics.spread_interval(np.tile(error, k), np.tile(track, (k, 1)))) for k in (1, 2))
        ratios.append(twice / once)
    assert 0.95 < np.median(ratios) < 1.35
