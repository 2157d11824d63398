"""Ranks, their distances and statistics against plain loops, and the rules that might explain a modem."""

from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import norm, wasserstein_distance

from aerpaw_cmp.compare import rank as ranks
from aerpaw_cmp.compare.rank import (
    agreement,
    channel_rank,
    cohen_kappa,
    commonest_rank,
    compare_rank,
    compare_ranks,
    confusion_matrix,
    histogram,
    k_curve,
    k_grid,
    rank_from_singular_values,
    repeat_rank,
    singular_values,
    stale_reports,
    total_variation,
    wasserstein,
)
from aerpaw_cmp.compare.statistics import NO_INTERVAL, Visit

NAN = float("nan")


def unitary(rng, n, count=None):
    shape = (n, n) if count is None else (count, n, n)
    return np.linalg.qr(rng.normal(size=shape) + 1j * rng.normal(size=shape))[0]


def with_profile(profile, seed=0):
    """Channels (n, 4, 4) with given singular values (n, 4) and random directions."""
    return between_frames(np.random.default_rng(seed), np.atleast_2d(np.asarray(profile, dtype=float)), 4, 4)


def between_frames(rng, sigma, n_rx, n_tx):
    """Channels (t, n_rx, n_tx) with the given singular values (t, m) between random unitary frames."""
    t, m = sigma.shape
    left, right = unitary(rng, n_rx, t)[:, :, :m], unitary(rng, n_tx, t)[:, :, :m]
    return (left * sigma[:, None]) @ right.conj().transpose(0, 2, 1)


@pytest.mark.parametrize("scale", [1e-300, 1e-150, 1e-9, 1.0, 1e150, 1e300])
def test_rank_does_not_depend_on_scale(scale):
    h = with_profile([[1, 0.5, 0.05, 0.005], [1, 0.09, 0.009, 0.0009]])
    for k, expected in ((10, [2, 1]), (100, [3, 2]), (1000, [4, 3]), (10_000, [4, 4])):
        assert channel_rank(h * scale, k).tolist() == expected


def test_the_count_is_strict_where_a_singular_value_ties():
    assert channel_rank(np.diag([1.0, 0.1]), 10) == 1
    assert channel_rank(np.diag([3.0, 0.3]), 10) == 1
    assert channel_rank(np.diag([1.0, 0.1 * (1 + 1e-9)]), 10) == 2
    # a tie that rounding of the decomposition must not decide
    rng = np.random.default_rng(0)
    for _ in range(50):
        u, v = unitary(rng, 2), unitary(rng, 2)
        assert channel_rank(u @ np.diag([1.0, 0.01]) @ v, 100) == 1
    assert channel_rank(np.eye(4), 1.0) == 0  # nothing exceeds sigma_1


def test_no_channel_is_rank_zero():
    h = with_profile(np.ones((4, 4)))
    h[1] = 0.0
    h[2, 0, 0] = NAN
    h[3, 1, 1] = np.inf
    assert channel_rank(h, 10).tolist() == [4, 0, 0, 0]
    assert np.isnan(singular_values(h)[2]).all()


def test_shapes():
    assert channel_rank(np.ones((3, 5, 2, 4)), 10).shape == (3, 5)
    assert channel_rank(np.ones((2, 3)), 10).shape == ()
    assert channel_rank(np.zeros((0, 2, 2)), 10).shape == (0,)
    assert channel_rank(np.ones((7, 1, 4)), 10).tolist() == [1] * 7
    with pytest.raises(ValueError, match="n_rx, n_tx"):
        channel_rank(np.ones(4), 10)
    with pytest.raises(ValueError, match="K is a ratio"):
        channel_rank(np.eye(2), 0.5)


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(1.01, 1e5), st.floats(1.01, 1e5))
def test_rank_grows_with_k(seed, k1, k2):
    rng = np.random.default_rng(seed)
    h = rng.normal(size=(20, 4, 4)) * np.logspace(0, -3, 4) + 0j
    low, high = channel_rank(h, min(k1, k2)), channel_rank(h, max(k1, k2))
    assert (low <= high).all()
    assert (low >= 1).all()


def test_histogram_leaves_out_what_does_not_exist():
    assert histogram([1, 1, 2, 4, 0, NAN]).tolist() == [0.5, 0.25, 0.0, 0.25]
    assert np.isnan(histogram([0, NAN])).all()
    with pytest.raises(ValueError, match="whole numbers"):
        histogram([5])
    with pytest.raises(ValueError, match="whole numbers"):
        histogram([1.5])


bars = st.lists(st.integers(0, 20), min_size=4, max_size=4).filter(any).map(lambda v: np.array(v) / sum(v))


@settings(max_examples=100, deadline=None)
@given(bars, bars, bars)
def test_distances_are_metrics_and_agree_with_scipy(p, q, r):
    ranks = np.arange(1, 5)
    assert wasserstein(p, q) == pytest.approx(wasserstein_distance(ranks, ranks, p, q), abs=1e-9)
    for distance in (total_variation, wasserstein):
        assert distance(p, p) == 0
        assert distance(p, q) == pytest.approx(distance(q, p))
        assert distance(p, r) <= distance(p, q) + distance(q, r) + 1e-12
    assert total_variation(p, q) <= wasserstein(p, q) + 1e-12 <= 3 * total_variation(p, q) + 1e-9
    # total variation is the largest difference in the probability of any event
    events = [sum(p[i] - q[i] for i in range(4) if e >> i & 1) for e in range(16)]
    assert total_variation(p, q) == pytest.approx(max(events), abs=1e-12)


def test_confusion_agreement_and_kappa():
    measured, simulated = [1, 2, 2, 3, NAN, 2], [1, 2, 3, 3, 1, 0]
    table = confusion_matrix(measured, simulated)
    assert table.sum() == 6
    assert table[2, 3] == 1
    assert table[0, 1] == 1
    assert table[2, 0] == 1
    assert agreement(measured, simulated) == 0.75
    # kappa by hand: observed 3/4; chance = (1*1 + 2*1 + 1*2) / 16
    assert cohen_kappa(measured, simulated) == pytest.approx((0.75 - 5 / 16) / (1 - 5 / 16))
    assert np.isnan(agreement([NAN], [1]))
    assert np.isnan(cohen_kappa([NAN], [1]))


def test_ri_only_ever_two():
    n = 200
    h = with_profile(np.tile([1, 0.5, 0.01, 0.001], (n, 1)))
    result = compare_rank(np.full(n, 2.0), h)
    assert result.histogram.tolist() == [0, 1, 0, 0]
    fit = result.simulated[10.0]
    assert fit.agreement == 1.0
    assert fit.total_variation == 0.0
    assert np.isnan(fit.kappa)  # two constants agree, but that says nothing
    assert result.staleness.verdict == "constant"
    # the wall of the interval is not at 1: 200 samples do not prove certainty
    low, high = result.histogram_ci95[1]
    assert 0.95 < low < 1.0
    assert high == pytest.approx(1.0)


def test_everything_out_of_coverage():
    result = compare_rank([2.0, NAN, 1.0, 3.0], np.zeros((4, 4, 4)))
    fit = result.simulated[10.0]
    assert (fit.out_of_coverage, result.n, result.n_no_csi) == (4, 3, 1)
    assert np.isnan(fit.histogram).all()
    assert np.isnan(fit.agreement)
    assert np.isnan(result.curve.best_k)
    assert np.isnan(result.simulated[1000.0].total_variation)


def test_one_sample():
    result = compare_rank([2.0], with_profile([[1, 0.5, 0.01, 0.001]]))
    assert result.simulated[10.0].agreement == 1.0
    assert np.isnan(result.simulated[10.0].agreement_ci95).all()
    assert result.n == 1


def test_measured_rank_zero_is_refused():
    with pytest.raises(ValueError, match="no CSI"):
        compare_rank([0.0, 1.0], np.ones((2, 4, 4)))
    with pytest.raises(ValueError, match="shape"):
        compare_rank([1.0, 1.0], np.ones((3, 4, 4)))


def walk(n, seed, low=1, high=4, stay=0.9):
    """Ranks that remember."""
    rng = np.random.default_rng(seed)
    out, now = [], int(rng.integers(low, high + 1))
    for _ in range(n):
        if rng.random() > stay:
            now = int(rng.integers(low, high + 1))
        out.append(now)
    return np.array(out)


def test_best_k_is_found_within_its_interval():
    rng = np.random.default_rng(13)
    n, truth = 1500, 30.0
    profile = np.sort(10 ** rng.uniform(-3.0, 0, (n, 4)), axis=1)[:, ::-1]
    profile /= profile[:, :1]
    h = with_profile(profile)
    measured = channel_rank(h, truth).astype(float)
    lost = rng.random(n) < 0.2  # the modem is not perfect
    measured[lost] = rng.integers(1, 5, lost.sum())
    curve = k_curve(measured, singular_values(h))
    low, high = curve.best_k_ci95
    assert curve.best_k == pytest.approx(truth, rel=0.15)
    assert truth / 10 < low <= truth <= high < 10 * truth
    at = np.flatnonzero(curve.k == 100.0)[0]
    assert curve.agreement[at] == pytest.approx(agreement(measured, channel_rank(h, 100)))


def test_the_grid_of_k_holds_the_papers_values():
    assert {10.0, 100.0, 1000.0} <= set(k_grid().tolist())
    np.testing.assert_allclose(np.diff(np.log10(k_grid())), 1 / 24)
    assert k_grid()[[0, -1]] == pytest.approx([1.3335, 1e5], rel=1e-4)


@pytest.mark.parametrize(("repeated", "verdict"), [(11, "fresh"), (12, "held")])
def test_a_report_is_held_where_fewer_than_nine_tenths_of_the_rows_are_new(repeated, verdict):
    """A row is new if the rank or a number of the same row changes, or if the row has no such number."""
    other = np.cumsum(np.arange(100) % 100 >= repeated).astype(float)  # the first rows repeat each other
    numbers = {"sinr_db": other, "cqi": np.full(100, 7.0)}
    reports = stale_reports(np.arange(100) * 0.5, np.where(np.arange(100) < 60, 2.0, 3.0), numbers)
    assert (reports.verdict, reports.n_reports) == (verdict, 101 - repeated)
    assert reports.fresh.tolist() == [k == 0 or k >= repeated for k in range(100)]
    assert reports.hold_s == pytest.approx(0.5)
    gaps = stale_reports(np.arange(100), np.full(100, 2.0), {"sinr_db": np.where(np.arange(100) < 40, np.nan, other)})
    assert gaps.fresh[:40].all()
    late = stale_reports([0.0, 3.0, 10.0, 11.0], [2.0, np.nan, 3.0, 3.0], {"sinr_db": [1.0, 2.0, 2.0, 2.0]})
    assert (late.fresh.tolist(), late.hold_s, late.n_reports) == ([True, False, True, False], 10.0, 2)


def test_fewer_than_eight_changes_tell_no_period():
    rank, time = np.repeat(np.arange(9) % 2 + 1.0, 10), np.arange(90) * 1.0
    held = stale_reports(time, rank)  # eight changes, each ten rows after the last
    assert (held.verdict, held.hold_s, held.n_reports) == ("held", 10.0, 9)
    few = stale_reports(time[:80], rank[:80])
    assert (few.verdict, few.n_reports) == ("fresh", 80)
    for alone, verdict in ((2.0, "constant"), (NAN, "no rank")):
        assert stale_reports(time, np.full(90, alone)).verdict == verdict


def test_the_commonest_rank_is_the_forecast_that_needs_no_model():
    forecast = commonest_rank([2.0] * 70 + [1.0] * 20 + [3.0] * 10 + [np.nan] * 5)
    assert (forecast.rank, forecast.agreement) == (2, 0.7)
    assert commonest_rank([np.nan]).rank == 0


def test_rank_intervals_hold_the_truth_of_a_known_process():
    rng = np.random.default_rng(31)
    hits = np.zeros(3)
    runs = 60
    for _ in range(runs):
        from scipy.ndimage import gaussian_filter1d

        x = gaussian_filter1d(rng.normal(size=1500), 5, mode="wrap")
        x /= np.sqrt(1 / (2 * np.sqrt(np.pi) * 5))  # unit variance of the process, not of the sample
        measured = np.searchsorted([-1.0, 0.5, 2.0], x) + 1.0
        simulated = np.searchsorted([-0.5, 0.5, 2.0], x) + 1.0
        fit = compare_ranks(measured, simulated)
        from scipy.stats import norm

        moved = norm.cdf(-0.5) - norm.cdf(-1.0)  # the share whose rank drops from 2 to 1
        hits += [
            fit.agreement_ci95[0] <= 1 - moved <= fit.agreement_ci95[1],
            fit.total_variation_ci95[0] <= moved <= fit.total_variation_ci95[1],
            fit.histogram_ci95[0][0] <= norm.cdf(-0.5) <= fit.histogram_ci95[0][1],
        ]
    assert (hits >= 0.85 * runs).all()


def test_rank_intervals_cover_the_truth_of_a_process_over_place():
    """Random waypoints over shadowing of 50 m: blocks of time covered 84 to 93 % of those given, and gave 94 % of them."""
    rng, n, flights = np.random.default_rng(4), 400, 60
    corners = rng.uniform(0.0, 500.0, (n, 2))
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    place = np.column_stack([*(np.interp(10.0 * np.arange(n), along, axis) for axis in corners.T), np.zeros(n)])
    root = np.linalg.cholesky(np.exp(-np.linalg.norm(place[:, None] - place, axis=2) / 50.0) + 0.16 * np.eye(n))
    cuts, hits = np.array([-0.8, 0.5, 1.6]), np.zeros(3)
    for _ in range(flights):
        first, other = rng.normal(size=(2, n)) @ root.T / np.sqrt(1.16)
        measured = np.searchsorted(cuts, first) + 1.0
        simulated = np.searchsorted(cuts, 0.8 * first + 0.6 * other) + 1.0
        fit = compare_ranks(measured, simulated, place)
        ends = np.array([fit.agreement_ci95, fit.kappa_ci95, fit.histogram_ci95[0]])
        # agreement and kappa of thresholds on two normals that correlate by 0.8, by integration
        truth = np.array([0.6272, 0.4331, norm.cdf(-0.8)])
        hits += (ends[:, 0] <= truth) & (truth <= ends[:, 1])
    assert (hits >= 0.86 * flights).all(), hits


def test_influences_are_what_leaving_a_pose_out_changes():
    a, b = walk(300, 1), walk(300, 2)
    influences = ranks._influences((a == b).astype(float), ranks.one_hot(a), ranks.one_hot(b))
    numbers = [
        ranks.agreement,
        ranks.cohen_kappa,
        lambda a, b: ranks.total_variation(ranks.histogram(a), ranks.histogram(b)),
        lambda a, b: ranks.wasserstein(ranks.histogram(a), ranks.histogram(b)),
    ]
    for influence, number in zip(influences, numbers, strict=True):
        change = 299.0 * np.array([number(a, b) - number(np.delete(a, at), np.delete(b, at)) for at in range(300)])
        np.testing.assert_allclose(influence - influence.mean(), change - change.mean(), atol=0.02)


def test_repeat_kappa_of_two_passes():
    rng = np.random.default_rng(3)
    here = np.column_stack([np.linspace(0, 900, 900), np.zeros((900, 2))])
    rank = rng.integers(1, 5, 900).astype(float)
    there = here[::-1] + rng.normal(0, 0.1, here.shape)
    same = repeat_rank(Visit(here, rank), Visit(there, rank[::-1]))
    assert same.n == pytest.approx(900, abs=20)
    assert same.kappa > 0.99
    assert repeat_rank(Visit(here, rank), Visit(there, rng.permutation(rank))).kappa == pytest.approx(0.0, abs=0.1)
    half = np.where(rng.random(900) < 0.5, rank[::-1], rng.permutation(rank))
    repeated = repeat_rank(Visit(here, rank), Visit(there, half))
    assert repeated.kappa_ci95[0] < 0.5 < repeated.kappa_ci95[1]
    nowhere = repeat_rank(Visit(here, rank), Visit(there + 50.0, rank))
    assert nowhere.n == 0
    assert np.isnan(nowhere.kappa)
    north, south = np.zeros(900), np.full(900, 180.0)
    assert repeat_rank(Visit(here, rank, north), Visit(there, rank, south)).n == 0


def test_a_period_is_taken_when_19_of_20_changes_fall_on_it():
    rank = np.ones(400)
    changes = [5 * k for k in range(1, 20)]
    for odd, verdict in (([97], "held"), ([97, 98], "fresh")):
        now = rank.copy()
        for at in sorted(changes + odd):
            now[at:] = 3.0 - now[at]
        assert stale_reports(np.arange(400) * 0.1, now).verdict == verdict


def test_each_interval_is_that_of_its_own_number():
    rng = np.random.default_rng(23)
    measured = rng.choice([1.0, 2.0, 3.0, 4.0], 3000, p=[0.2, 0.5, 0.2, 0.1])
    simulated = np.where(rng.random(3000) < 0.5, measured, np.clip(measured + 1, 1, 4))
    fit = compare_ranks(measured, simulated)
    values = [fit.agreement, fit.kappa, fit.total_variation, fit.wasserstein]
    spans = [fit.agreement_ci95, fit.kappa_ci95, fit.total_variation_ci95, fit.wasserstein_ci95]
    for k, value in enumerate(values):
        inside = [low <= value <= high for low, high in spans]
        assert inside[k]
        assert sum(inside) == 1, "the four lie far enough apart here"


@pytest.mark.parametrize("n", [5, 16, 31, 240])
def test_the_histogram_test_swaps_parts_of_the_flight(n):
    a, b = walk(n, 5), walk(n, 6, 1, 3)
    part = np.searchsorted(np.unique(np.arange(12) * n // 12), np.arange(n), side="right") - 1
    distances = []
    for signs in product((1, -1), repeat=part[-1] + 1):
        swap = np.array(signs)[part] < 0
        one, other = np.where(swap, b, a), np.where(swap, a, b)
        distances.append(total_variation(histogram(one), histogram(other)))
    expected = np.mean(np.array(distances) >= total_variation(histogram(a), histogram(b)) - 1e-12)
    assert ranks.histogram_test(a, b) == pytest.approx(expected, rel=1e-12)
    assert np.isnan(ranks.histogram_test([np.nan, 0], [1, 1]))


def test_the_best_k_is_the_middle_of_the_first_best_run():
    grid, profile = np.array([1.0, 10.0, 100.0, 1000.0, 1e4]), np.array([[1.0, 1.0 / 30.0, 1.0 / 3000.0]])
    for rank, best in ((1, 10.0), (2, 10**2.5), (3, 1e4)):
        curve = k_curve(np.full(40, float(rank)), np.repeat(profile, 40, axis=0), k=grid)
        assert curve.best_k == pytest.approx(best)
        # one step of the grid wider than the K with as many equal ranks
        assert curve.best_k_ci95 == {1: (1.0, 100.0), 2: (10.0, 1e4), 3: (1000.0, 1e4)}[rank]
    assert k_curve(np.full(19, 1.0), np.repeat(profile, 19, axis=0), k=grid).best_k_ci95 == NO_INTERVAL


def test_profiles_without_a_value_have_no_rank():
    assert rank_from_singular_values(np.zeros((3, 2, 0)), 10.0).tolist() == [[0, 0]] * 3
    assert rank_from_singular_values(np.zeros((4, 0)), 10.0).tolist() == [0] * 4


def test_places_of_two_passes_are_the_same_within_two_metres():
    along = np.arange(200) * 10.0
    first = np.column_stack([along, np.zeros((200, 2))])
    rank = walk(200, 9)
    for away, n in ((1.99, 200), (2.5, 0)):
        repeated = ranks.repeat_rank(Visit(first, rank), Visit(first + np.array([0.0, away, 0.0]), rank))
        assert repeated.n == n
        assert (repeated.agreement == 1.0) == bool(n)


def test_a_curve_without_a_pair_says_nothing():
    curve = k_curve([np.nan, 2.0], np.array([[1.0, 0.5], [0.0, 0.0]]), k=[10.0, 100.0])
    assert np.isnan([*curve.agreement, curve.best_k]).all()
    assert curve.best_k_ci95 == NO_INTERVAL
