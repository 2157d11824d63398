"""Statistics of ranks against plain loops: intervals from the bootstrap, influence as a slope, shifts, blocks, stale reports."""

from __future__ import annotations

import numpy as np
import pytest

from aerpaw_cmp.compare import rank as ranks
from aerpaw_cmp.compare.rank import MAX_RANK, k_curve, k_grid, rank_from_singular_values
from aerpaw_cmp.compare.statistics import NO_INTERVAL, autocorrelation, bootstrap_means, interval, share_interval


def walk(n, seed, low=1, high=4, stay=0.9):
    """Ranks that remember."""
    rng = np.random.default_rng(seed)
    out, now = [], int(rng.integers(low, high + 1))
    for _ in range(n):
        if rng.random() > stay:
            now = int(rng.integers(low, high + 1))
        out.append(now)
    return np.array(out)


@pytest.fixture(scope="module")
def pair():
    measured = walk(900, 1)
    rng = np.random.default_rng(2)
    simulated = np.where(rng.random(900) < 0.6, measured, walk(900, 3, 2, 4))
    return measured, simulated


def statistics_by_hand(a, b):
    """Agreement, kappa, total variation and Wasserstein distance of two sequences, by counting."""
    n = len(a)
    p, q = (np.array([np.sum(x == r) / n for r in range(1, MAX_RANK + 1)]) for x in (a, b))
    agree = np.sum(a == b) / n
    chance = sum(x * y for x, y in zip(p, q, strict=True))
    move = sum(abs(sum(p[:r]) - sum(q[:r])) for r in range(1, MAX_RANK))
    return agree, (agree - chance) / (1 - chance), sum(abs(p - q)) / 2, move


def test_the_statistics_of_means_are_those_of_the_sequences(pair):
    a, b = pair
    equal, first, second = (a == b).astype(float), ranks._indicators(a), ranks._indicators(b)
    rows = ranks._pair_statistics(equal, first, second)
    columns = np.column_stack([equal, first, second])
    for (_, statistic, _), expected in zip(rows, statistics_by_hand(a, b), strict=True):
        assert statistic(columns.mean(axis=0)[None])[0] == pytest.approx(expected, rel=1e-12)
    assert [bounds for _, _, bounds in rows] == [(0.0, 1.0), (-1.0, 1.0), (0.0, 1.0), (0.0, MAX_RANK - 1.0)]


def test_the_influence_of_a_pose_is_the_slope_of_the_statistic_towards_it(pair):
    a, b = pair
    equal, first, second = (a == b).astype(float), ranks._indicators(a), ranks._indicators(b)
    columns = np.column_stack([equal, first, second])
    mean = columns.mean(axis=0)
    for (influence, statistic, _), scale in zip(
        ranks._pair_statistics(equal, first, second), (1, 1, 0.5, 1), strict=True
    ):
        toward = mean + 1e-6 * (columns - mean)
        slope = (statistic(toward) - statistic(mean[None])) / 1e-6
        np.testing.assert_allclose(scale * (influence - influence.mean()), slope, atol=2e-5)
    parts = ranks.kappa_parts(a, b)
    np.testing.assert_array_equal(parts.columns, columns)
    assert parts.kappa(mean[None])[0] == pytest.approx(statistics_by_hand(a, b)[1])
    np.testing.assert_array_equal(parts.influence, ranks._pair_statistics(equal, first, second)[1][0])


def test_sequences_that_agree_by_chance_alone_have_no_kappa_to_resample():
    ones = np.ones(50, dtype=int)
    equal, first = np.ones(50), ranks._indicators(ones)
    influence, kappa, _ = ranks._pair_statistics(equal, first, first)[1]
    assert np.isfinite(influence).all()
    assert np.isnan(kappa(np.column_stack([equal, first, first]).mean(axis=0)[None])).all()


def test_intervals_come_from_one_bootstrap_each_with_its_own_memory(pair):
    a, b = pair
    values = statistics_by_hand(a, b)
    found = ranks._pair_intervals(a, b, values, 300, 7)
    equal, first, second = (a == b).astype(float), ranks._indicators(a), ranks._indicators(b)
    columns = np.column_stack([equal, first, second])
    for number, (influence, statistic, bounds) in enumerate(ranks._pair_statistics(equal, first, second)):
        known = autocorrelation(influence)
        drawn = statistic(bootstrap_means(columns, known.block_length, replicates=300, seed=7))
        if number == 0:
            assert found[0] == share_interval(values[0], float(drawn.std()), known)  # a share keeps within 0 and 1
        else:
            assert found[number] == interval(values[number], drawn, known, bounds=bounds)
    assert found[0] != interval(values[0], drawn, known, bounds=(0.0, 1.0))
    assert ranks._pair_intervals(a[:1], b[:1], values, 10, 0) == [NO_INTERVAL] * 4


def test_bars_of_a_histogram_have_wilsons_intervals(pair):
    measured = np.minimum(pair[0], 3).astype(float)
    found = ranks._histogram_intervals(measured, 200, 3)
    assert len(found) == MAX_RANK
    for r in range(1, MAX_RANK + 1):
        bar = (measured == r).astype(float)
        known = autocorrelation(bar) if 0 < bar.mean() < 1 else autocorrelation(measured)
        drawn = bootstrap_means(bar[:, None], known.block_length, replicates=200, seed=3)
        assert found[r - 1] == share_interval(float(bar.mean()), float(drawn.std()), known)
    assert found[-1][0] == 0.0 < found[-1][1]  # never seen, not impossible
    assert ranks._histogram_intervals(measured[:1], 10, 0) == [NO_INTERVAL] * MAX_RANK


def test_kappa_without_resamples_has_the_variance_of_what_each_pair_adds(pair):
    a, b = (x.astype(float) for x in pair)
    kappa = ranks.cohen_kappa(a, b)
    low, high = ranks._kappa_interval(a, b, kappa)
    influence = ranks.kappa_parts(*pair).influence
    known = autocorrelation(influence)
    drawn = bootstrap_means((influence - influence.mean())[:, None], known.block_length, replicates=20_000, seed=1)
    reach = known.half_width * float(drawn.std())
    assert (kappa - low, high - kappa) == pytest.approx((reach, reach), rel=0.03)
    assert ranks._kappa_interval(a, b, float("nan")) == NO_INTERVAL
    assert ranks._kappa_interval(a[:1], b[:1], 1.0) == NO_INTERVAL
    few, other = np.repeat([1.0, 2.0], 40), np.repeat([1.0, 2.0], [30, 50])  # one change: no independent samples
    assert ranks._kappa_interval(few, other, ranks.cohen_kappa(few, other)) == NO_INTERVAL
    high_end = ranks._kappa_interval(a, np.where(np.arange(len(a)) < 6, 5 - a, a), 0.99)
    assert high_end[1] <= 1.0
    with_resamples = ranks._pair_intervals(*pair, (0, kappa, 0, 0), 2000, 0)[1]
    assert (low, high) == pytest.approx(with_resamples, abs=0.15 * (high - low))


@pytest.mark.parametrize(("n", "given"), [(8, None), (9, None), (41, None), (120, 5), (120, 31), (12, 4)])
def test_the_shift_test_counts_every_shift_that_is_apart(n, given):
    """Shifts nearer than a block (at most a quarter of the flight) on either side do not count."""
    a, b = walk(n, n, 1, 3, 0.5), walk(n, n + 1, 1, 3, 0.5)
    near = given or max(autocorrelation(a).block_length, autocorrelation(b).block_length)
    near = min(max(near, 1), n // 4)
    real = np.sum(a == b)
    apart = [np.sum(a == np.roll(b, shift)) for shift in range(near, n - near + 1)]
    expected = (1 + sum(count >= real for count in apart)) / (1 + len(apart))
    assert ranks.shift_test(a, b, minimum_shift=given) == pytest.approx(expected, rel=1e-12)
    assert np.isnan(ranks.shift_test(a[:7], b[:7]))
    assert np.isnan(ranks.shift_test(np.ones(20), walk(20, 1)))


@pytest.mark.parametrize("n", [23, 240])
def test_the_histogram_test_swaps_whole_blocks(n):
    a, b = walk(n, 5), walk(n, 6, 1, 3)
    length = max(autocorrelation(a).block_length, autocorrelation(b).block_length, 1)
    signs = np.random.default_rng(4).integers(0, 2, (150, -(-n // length))) * 2 - 1
    counts = []
    for row in [np.ones(-(-n // length), dtype=int), *signs]:
        bars = np.zeros(MAX_RANK)
        for i in range(n):
            bars[a[i] - 1] += row[i // length]
            bars[b[i] - 1] -= row[i // length]
        counts.append(np.abs(bars).sum())
    expected = (1 + sum(c >= counts[0] - 1e-9 for c in counts[1:])) / 151
    assert ranks.histogram_test(a, b, replicates=150, seed=4) == pytest.approx(expected, rel=1e-12)
    assert np.isnan(ranks.histogram_test([np.nan, 0], [1, 1]))


def test_the_curve_over_k_is_that_of_each_k_alone(pair, monkeypatch):
    measured, rng = pair[0][:400].astype(float), np.random.default_rng(8)
    sigma = -np.sort(-np.exp(rng.normal(0, 1.5, (400, 4))) * np.array([1, 0.3, 0.1, 0.03]), axis=1)
    measured = np.where(rng.random(400) < 0.7, rank_from_singular_values(sigma, 30.0), measured)
    measured[5], sigma[9] = np.nan, 0.0
    grid = k_grid(2.0, 500.0, 8)
    curve = k_curve(measured, sigma, k=grid, replicates=60, seed=2)
    both = np.isfinite(measured) & (sigma[:, 0] > 0)
    ri, table = measured[both], np.array([rank_from_singular_values(sigma[both], k) for k in grid])
    agree = (table == ri).mean(axis=1)
    vary = [statistics_by_hand(ri, row)[2] for row in table]
    np.testing.assert_allclose(curve.agreement, agree, atol=1e-12)
    np.testing.assert_allclose(curve.total_variation, vary, atol=1e-12)
    # the intervals: each replicate draws the same blocks of poses for every K
    known = autocorrelation((table == ri).mean(axis=0))
    some = np.array(
        [
            bootstrap_means((row == ri)[:, None].astype(float), known.block_length, replicates=60, seed=2)[:, 0]
            for row in table
        ]
    ).T
    best = [grid[int(np.argmax(row))] for row in some]
    apart = np.zeros((60, len(grid)))
    for r in range(1, MAX_RANK + 1):
        for column, row in enumerate(table):
            difference = (row == r).astype(float) - (ri == r)
            drawn = bootstrap_means(difference[:, None], known.block_length, replicates=60, seed=2)[:, 0]
            apart[:, column] += 0.5 * np.abs(drawn)
    nearest = [grid[int(np.argmin(row))] for row in apart]
    for (low, high), of, middle in (
        (curve.best_k_interval, best, curve.best_k_agreement),
        (curve.best_k_total_variation_interval, nearest, curve.best_k_total_variation),
    ):
        step = 10 ** (1 / 8)
        assert low <= np.quantile(of, 0.05)
        assert low >= np.quantile(of, 0.02) / step**3
        assert high >= np.quantile(of, 0.95)
        assert high <= np.quantile(of, 0.98) * step**3
        assert low <= middle <= high
    monkeypatch.setattr(ranks, "_CELLS_AT_ONCE", 1)
    again = k_curve(measured, sigma, k=grid, replicates=60, seed=2)
    assert str(again) == str(curve)
    assert not curve.at_edge
    assert k_curve(np.ones(400), sigma, k=grid, replicates=2).at_edge  # the lowest K makes fewest layers
    assert k_curve(np.full(400, 4.0), sigma, k=grid, replicates=2).at_edge


def test_the_middle_of_the_first_best_run():
    k = np.array([1.0, 10.0, 100.0, 1000.0, 1e4])
    curves = np.array(
        [[0, 1, 1, 0, 1], [1, 0, 1, 1, 1], [0, 0, 0, 1, 1], [1, 1, 1, 1, 1], [0, 1, 1 - 1e-13, 0, 0]], dtype=float
    )
    assert ranks._middle_of_best(curves, k) == pytest.approx([10**1.5, 1.0, 10**3.5, 100.0, 10**1.5])


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [(10.0, 100.0, (1.0, 1000.0)), (1.0, 1e4, (1.0, 1e4)), (30.0, 300.0, (1.0, 1e4)), (100.0, 100.0, (10.0, 1000.0))],
)
def test_an_interval_of_k_reaches_one_step_further(low, high, expected):
    """A value of the grid gets the next one; one between two of them the one after: nothing finer was tried."""
    k = np.array([1.0, 10.0, 100.0, 1000.0, 1e4])
    assert ranks._central(np.array([low, high] * 50), k) == expected
    assert ranks._central(np.full(10, 0.5), k)[0] == 0.5  # never inside of what was drawn
    assert ranks._central(np.full(10, 2e4), k)[1] == 2e4


def test_capacity_counts_bits_of_layers_with_equal_power():
    rng = np.random.default_rng(3)
    h = rng.normal(size=(40, 4, 2)) + 1j * rng.normal(size=(40, 4, 2))
    h[3] = 0.0
    sinr = rng.uniform(-10, 30, 40)
    sinr[7] = np.nan
    for penalty in (0.0, 1.5):
        expected = []
        for matrix, level in zip(h, sinr, strict=True):
            power = np.abs(matrix) ** 2
            if np.isnan(level) or not power.sum():
                expected.append(0)
                continue
            gains = np.linalg.eigvalsh(matrix.conj().T @ matrix)[::-1] * power.size / power.sum()
            snr = 10 ** (level / 10)
            best, rate = 1, np.log2(1 + snr * gains[0])
            for layers in range(2, len(gains) + 1):
                more = sum(np.log2(1 + snr * g / layers) for g in gains[:layers])
                if more - rate > penalty * (layers - best) + 1e-9:
                    best, rate = layers, more
            expected.append(best)
        assert ranks.capacity_rank(h, sinr, penalty_bits=penalty).tolist() == expected
    assert set(expected) >= {0, 1, 2}


def test_the_condition_number_is_put_on_every_singular_value():
    limit = 10 ** (17 / 20)
    sigma = np.array([[1.0, 1.01 / limit, 0.99 / limit, 0.0], [1.0, 0.9 / limit, 0, 0], [0, 0, 0, 0]])
    assert ranks.condition_number_rank(sigma).tolist() == [2, 1, 0]
    assert ranks.condition_number_rank([1.0, 0.5], limit_db=6.0) == 1
    assert ranks.condition_number_rank([1.0, 0.5], limit_db=6.1) == 2


def test_an_interval_of_k_on_a_fine_grid_is_one_step_wider():
    k = 1.25 ** np.arange(12)
    low, high = ranks._central(np.array([k[4], k[8]] * 50), k)
    assert (low, high) == (k[3], k[9])
    between = ranks._central(np.full(9, k[5] * 1.1), k)
    assert between == (k[4], k[7])


def test_profiles_without_a_value_have_no_rank():
    assert rank_from_singular_values(np.zeros((3, 2, 0)), 10.0).tolist() == [[0, 0]] * 3
    assert rank_from_singular_values(np.zeros((4, 0)), 10.0).tolist() == [0] * 4


def test_places_of_two_passes_are_the_same_within_two_metres():
    along = np.arange(200) * 10.0
    first = np.column_stack([along, np.zeros((200, 2))])
    rank = walk(200, 9)
    for away, n in ((1.99, 200), (2.5, 0)):
        found = ranks.repeat_rank(first, rank, first + np.array([0.0, away, 0.0]), rank, replicates=20)
        assert found.n == n
        assert (found.agreement == 1.0) == bool(n)


def test_a_curve_without_a_pair_says_nothing():
    curve = k_curve([np.nan, 2.0], np.array([[1.0, 0.5], [0.0, 0.0]]), k=[10.0, 100.0])
    assert np.isnan(
        [*curve.agreement, *curve.total_variation, curve.best_k_agreement, curve.best_k_total_variation]
    ).all()
    assert curve.best_k_interval == curve.best_k_total_variation_interval == NO_INTERVAL
    assert not curve.at_edge
