"""Check the correlation against a plain double loop and scikit-gstat, and the curve against the paper's numbers."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.maps import variogram
from aerpaw_cmp.maps.grid import Grid
from aerpaw_cmp.maps.variogram import PAPER_BIEXPONENTIAL, field_correlation, fit_biexponential, vector_correlation

RNG = np.random.default_rng(3)


def double_loop(points, vectors, width, maximum, least=3):
    """The paper's Steps 1 to 4, pair by pair."""
    sums, counts = {}, {}
    for i in range(len(points)):
        for j in range(i, len(points)):
            d = np.hypot(*(points[i] - points[j]))
            if d > maximum:
                continue
            both = np.isfinite(vectors[i]) & np.isfinite(vectors[j])
            if both.sum() < least or np.ptp(vectors[i][both]) == 0 or np.ptp(vectors[j][both]) == 0:
                continue
            n = int(np.floor(d / width + 0.5))
            sums[n] = sums.get(n, 0.0) + np.corrcoef(vectors[i][both], vectors[j][both])[0, 1]
            counts[n] = counts.get(n, 0) + 1
    return sums, counts


@pytest.fixture
def small_blocks(monkeypatch):
    monkeypatch.setattr(variogram, "BLOCK", 7)


def compare(bins, sums, counts):
    for n in range(len(bins.pairs)):
        assert bins.pairs[n] == counts.get(n, 0)
        if n in sums:
            assert bins.correlation[n] == pytest.approx(sums[n] / counts[n], abs=1e-12)
        else:
            assert np.isnan(bins.correlation[n])


def test_vectors_equal_the_double_loop(small_blocks):
    grid = Grid.over_area((0.0, 210.0, 0.0, 240.0))
    vectors = RNG.integers(1, 4, (len(grid), 3, 4)).astype(float)
    vectors[5] = 2.0
    vectors[9] = 0.1  # 12 x 0.1: its mean is not 0.1 to the last bit
    bins = vector_correlation(grid.points_m, vectors, maximum_m=150.0)
    assert bins.excluded_constant == 2
    assert bins.positions == len(grid) - 2
    assert bins.distance_m.tolist() == [0, 30, 60, 90, 120, 150]
    assert bins.correlation[0] == pytest.approx(1.0, abs=1e-15)
    compare(bins, *double_loop(grid.points_m, vectors.reshape(len(grid), -1), 30.0, 150.0))


def test_missing_components_count_pairwise(small_blocks):
    points = RNG.uniform(0, 300, (40, 2))
    vectors = RNG.normal(size=(40, 8)) + 1e6  # a large mean must not eat the digits
    vectors[RNG.random((40, 8)) < 0.3] = np.nan
    vectors[0] = np.nan
    pairwise = vector_correlation(points, vectors, maximum_m=300.0)
    sums, counts = double_loop(points, vectors, 30.0, 300.0)
    for n in range(len(pairwise.pairs)):
        assert pairwise.pairs[n] == counts.get(n, 0)
        if counts.get(n):
            assert pairwise.correlation[n] == pytest.approx(sums[n] / counts[n], abs=1e-7)


def test_bins_do_not_depend_on_rounding():
    """Distances of 15 m go up to the 30 m bin, on any origin."""
    for origin in (0.0, 1.4, 500.3):  # from the last one 15 m are 14.99999999999994 m
        points = np.array([[origin, 0.0], [origin + 15.0, 0.0]])
        assert vector_correlation(points, RNG.normal(size=(2, 5)), maximum_m=60.0).pairs.tolist() == [2, 1, 0]


def test_all_constant_gives_no_correlation_and_no_warning():
    bins = vector_correlation(RNG.uniform(0, 90, (5, 2)), np.ones((5, 6)))
    assert bins.excluded_constant == 5
    assert bins.positions == 0
    assert np.isnan(bins.correlation).all()


def test_memory_is_bounded_by_the_block():
    import tracemalloc

    points = RNG.uniform(0, 1000, (6000, 2))
    vectors = RNG.normal(size=(6000, 4))
    tracemalloc.start()
    vector_correlation(points, vectors, maximum_m=60.0)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 6000 * 6000 * 8 / 4, "an N x N matrix was built"


def test_field_correlation_of_a_known_field():
    """White noise smoothed by a box of L cells has the triangular correlation 1 - h / L."""
    rng = np.random.default_rng(11)
    length, n = 8, 20_000
    noise = rng.normal(size=(n + length, 2))
    fields = np.apply_along_axis(lambda c: np.convolve(c, np.ones(length), "valid"), 0, noise)[:n]
    points = np.column_stack([np.zeros(n), 30.0 * np.arange(n)])
    bins = field_correlation(points, fields, maximum_m=300.0)
    np.testing.assert_allclose(bins.correlation, np.maximum(1 - np.arange(11) / length, 0), atol=0.06)
    assert bins.correlation[0] == pytest.approx(1.0, abs=1e-12)


def test_field_correlation_by_fourier_transform():
    """A second route on a grid: autocorrelation of the standardised field (Wiener-Khinchin)."""
    grid = Grid.over_area((0.0, 360.0, 0.0, 450.0))
    fields = RNG.normal(size=(len(grid), 2))
    bins = field_correlation(grid.points_m, fields, maximum_m=40.0)
    rows, columns = grid.shape
    z = grid.raster((fields - fields.mean(axis=0)) / fields.std(axis=0))
    padded = (2 * rows, 2 * columns)
    product = sum(np.fft.irfft2(np.abs(np.fft.rfft2(z[..., k], padded)) ** 2, padded) for k in range(2)) / 2
    # 40 m leaves the diagonals (42 m) out of the bin of 30 m
    expected = (product[0, 1] + product[1, 0]) / (rows * (columns - 1) + (rows - 1) * columns)
    assert bins.correlation[1] == pytest.approx(expected, abs=1e-12)


def test_field_correlation_leaves_missing_values_out():
    points = np.array([[0.0, 0.0], [30.0, 0.0], [60.0, 0.0]])
    fields = np.array([[1.0, 2.0], [3.0, np.nan], [2.0, 6.0]])
    bins = field_correlation(points, fields, maximum_m=60.0)
    z = (fields - np.nanmean(fields, axis=0)) / np.nanstd(fields, axis=0)
    assert bins.correlation[1] == pytest.approx((z[0, 0] * z[1, 0] + z[1, 0] * z[2, 0]) / 2)
    assert bins.correlation[2] == pytest.approx((z[0] * z[2]).mean())


# --- the curve ------------------------------------------------------------------------------------------------------

DISTANCE = np.arange(0.0, 501.0, 30.0)


@pytest.mark.parametrize("seed", range(5))
def test_paper_coefficients_with_the_paper_residual(seed):
    """With noise of the paper's RMSE, the curve is determined, but not each coefficient."""
    noisy = PAPER_BIEXPONENTIAL(DISTANCE) + np.random.default_rng(seed).normal(0, 0.0153, DISTANCE.size)
    fit = fit_biexponential(DISTANCE, noisy)
    assert fit.rmse <= np.sqrt(np.mean((noisy - PAPER_BIEXPONENTIAL(DISTANCE)) ** 2)) + 1e-12
    assert np.abs(fit(DISTANCE) - PAPER_BIEXPONENTIAL(DISTANCE)).max() < 0.05


@settings(max_examples=15, deadline=None)
@example(0.2932, 0.0508, 0.7057, 0.001)  # the paper's
@given(st.floats(0.1, 0.5), st.floats(0.01, 0.06), st.floats(0.1, 0.5), st.floats(0.0005, 0.002))
def test_any_well_parted_curve_comes_back(c1, fast, c3, slow):
    truth = variogram.BiExponential(c1, -fast, c3, -slow, 0.0)
    fit = fit_biexponential(DISTANCE, truth(DISTANCE))
    assert fit.rmse < 1e-8
    assert not fit.message
    np.testing.assert_allclose([fit.c1, fit.c2, fit.c3, fit.c4], [c1, -fast, c3, -slow], rtol=1e-3)


def test_fit_is_at_least_as_good_as_curve_fit_from_the_truth():
    from scipy.optimize import curve_fit

    def model(d, a, b, c, e):
        return a * np.exp(b * d) + c * np.exp(e * d)

    noisy = PAPER_BIEXPONENTIAL(DISTANCE) + np.random.default_rng(8).normal(0, 0.01, DISTANCE.size)
    known, _ = curve_fit(model, DISTANCE, noisy, p0=[0.2932, -0.0508, 0.7057, -0.001])
    theirs = np.sqrt(np.mean((model(DISTANCE, *known) - noisy) ** 2))
    assert fit_biexponential(DISTANCE, noisy).rmse <= theirs + 1e-12


@pytest.mark.parametrize(
    ("curve", "reason"),
    [
        (lambda d: np.exp(-d / 100), "no amplitude|same rate"),
        (lambda d: 0.4 + 0 * d, "is not visible"),
        (lambda d: np.where(d == 0, 1.0, 0.7 * np.exp(-d / 400)), "ends before the first distance"),
        (lambda d: np.exp(-d / 100) * np.cos(d / 80), "as well"),
    ],
    ids=["one exponential", "constant", "nugget only", "turns negative"],
)
def test_degenerate_data_are_called_so(curve, reason):
    fit = fit_biexponential(DISTANCE, curve(DISTANCE))
    assert fit.degenerate
    assert any(text in fit.message for text in reason.split("|"))
    assert np.isfinite(fit(DISTANCE)).all()
    assert fit.c1 >= 0
    assert fit.c3 >= 0
    assert fit.c2 <= fit.c4 <= 0


def test_flat_data_are_fitted_although_degenerate():
    assert fit_biexponential(DISTANCE, np.full(DISTANCE.size, 0.4))(DISTANCE) == pytest.approx(0.4, abs=1e-6)


def test_no_amplitude_is_negative():
    """A curve that is not a covariance is fitted as well as non-negative amplitudes allow."""
    held = fit_biexponential(DISTANCE, 1.5 * np.exp(-DISTANCE / 60) - 0.5 * np.exp(-DISTANCE / 300))
    assert held.rmse > 0.01
    assert min(held.c1, held.c3) >= 0.0


def test_correlation_never_exceeds_one_before_the_first_point():
    """Found on real ranks: bins that begin at 10 m let a free fast exponential reach 1800 at 0 m."""
    d = np.arange(10.0, 301.0, 10.0)
    y = np.where(d == 10.0, 0.9, 0.55 * np.exp(-d / 80))
    held = fit_biexponential(d, y)
    assert held(0.0) <= 1 + 1e-12
    assert held.rmse < 0.1


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.0, 2.0))
def test_bounded_amplitudes_equal_a_quadratic_programme(seed, level):
    from scipy.optimize import minimize

    rng = np.random.default_rng(seed)
    basis, target = rng.uniform(0, 1, (9, 2)), rng.normal(level, 1, 9)
    amplitudes = variogram._candidate_amplitudes(basis, target)
    cost = ((amplitudes @ basis.T - target) ** 2).sum(axis=-1)
    assert (amplitudes >= -1e-12).all()
    assert (amplitudes.sum(axis=-1) <= 1 + 1e-12).all()
    peer = minimize(
        lambda c: ((basis @ c - target) ** 2).sum(), [0.25, 0.25], bounds=[(0, 1)] * 2, method="SLSQP",
        constraints={"type": "ineq", "fun": lambda c: 1 - c.sum()}, options={"ftol": 1e-14},
    )  # fmt: skip
    assert cost.min() <= peer.fun + 1e-7


def test_few_points():
    fit = fit_biexponential([0.0, 30.0, np.nan], [1.0, 0.5, 0.2])
    assert fit.degenerate
    assert fit.message == "2 points cannot determine four coefficients"
    assert fit([0.0, 30.0]) == pytest.approx([1.0, 0.5], abs=1e-6)
    underdetermined = fit_biexponential([0.0, 30.0, 30.0], [1.0, 0.5, 0.7])  # one curve cannot meet both
    assert underdetermined.degenerate
    assert underdetermined([0.0, 30.0]) == pytest.approx([1.0, 0.6], abs=1e-6)
    assert underdetermined.rmse == pytest.approx(0.1 * np.sqrt(2 / 3))
    with pytest.raises(UsageError, match="1 usable point for a curve"):
        fit_biexponential([0.0], [1.0])
