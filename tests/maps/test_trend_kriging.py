"""Kriging with a known trend: exact trends, samples, ordinary Kriging as the limit, and bounds."""

import numpy as np
import pytest

from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.maps.kriging import OrdinaryKriging, TrendKriging

RNG = np.random.default_rng(11)
PLACES = RNG.uniform(0, 400, (80, 2))
TREND = np.sin(PLACES[:, 0] / 70.0) * 8.0
TARGETS = RNG.uniform(0, 400, (40, 2))
TARGET_TREND = np.sin(TARGETS[:, 0] / 70.0) * 8.0


def correlation(distance):
    return np.exp(-np.asarray(distance) / 60.0)


def test_a_linear_function_of_the_trend_is_reproduced_everywhere() -> None:
    model = TrendKriging(correlation).fit(PLACES, 3.0 - 1.7 * TREND, TREND)
    estimate, variance = model.predict(TARGETS, TARGET_TREND)
    np.testing.assert_allclose(estimate, 3.0 - 1.7 * TARGET_TREND, atol=1e-8)
    np.testing.assert_allclose(variance, 0.0, atol=1e-12)


def test_samples_are_met_with_variance_zero_and_the_variance_grows_away_from_them() -> None:
    values = TREND + RNG.normal(0, 2, len(PLACES))
    model = TrendKriging(correlation).fit(PLACES, values, TREND)
    estimate, variance = model.predict(PLACES[:5], TREND[:5])
    np.testing.assert_allclose(estimate, values[:5], atol=1e-8)
    np.testing.assert_allclose(variance, 0.0, atol=1e-8)
    assert (model.predict(TARGETS, TARGET_TREND)[1] > 0.0).all()


def test_without_a_trend_it_is_ordinary_kriging() -> None:
    values = RNG.normal(0, 2, len(PLACES))
    ours = TrendKriging(correlation, radius_m=1e4).fit(PLACES, values, np.full(len(PLACES), 5.0))
    ordinary = OrdinaryKriging(correlation, radius_m=1e4).fit(PLACES, values)
    np.testing.assert_allclose(
        ours.predict(TARGETS, np.full(len(TARGETS), 5.0))[0], ordinary.predict(TARGETS)[0], atol=1e-9
    )


def test_a_trend_that_explains_the_field_beats_none_between_distant_samples() -> None:
    some = slice(0, 25)
    values = 2.0 * TREND + RNG.normal(0, 0.3, len(PLACES))
    with_trend = TrendKriging(correlation).fit(PLACES[some], values[some], TREND[some])
    without = OrdinaryKriging(correlation, outside="nearest").fit(PLACES[some], values[some])
    errors = [
        np.sqrt(np.mean((estimate - 2.0 * TARGET_TREND) ** 2))
        for estimate in (with_trend.predict(TARGETS, TARGET_TREND)[0], without.predict(TARGETS)[0])
    ]
    assert errors[0] < 0.25 * errors[1]


@pytest.mark.parametrize("kind", ["ordinary", "trend"])
def test_ranks_stay_within_their_bounds(kind: str) -> None:
    """A step of ranks with a Gaussian correlation exceeds 1 .. 4 without bounds."""
    rank = np.where(PLACES[:, 0] < 200, 1.0, 4.0)

    def smooth(distance):
        return np.exp(-((np.asarray(distance) / 80.0) ** 2))

    def estimates(bounds: tuple[float, float] | None) -> np.ndarray:
        if kind == "ordinary":
            return OrdinaryKriging(smooth, outside="nearest", bounds=bounds).fit(PLACES, rank).predict(TARGETS)[0]
        return TrendKriging(smooth, bounds=bounds).fit(PLACES, rank, TREND).predict(TARGETS, TARGET_TREND)[0]

    assert np.ptp(estimates(None)) > 3.0
    bounded = estimates((1.0, 4.0))
    assert bounded.min() >= 1.0
    assert bounded.max() <= 4.0


def test_what_cannot_be_fitted_or_predicted_is_named() -> None:
    with pytest.raises(UsageError, match="no sample with a value and a trend"):
        TrendKriging(correlation).fit([[0.0, 0.0]], [np.nan], [1.0])
    with pytest.raises(UsageError, match="expected"):
        TrendKriging(correlation).fit(PLACES, TREND[:3], TREND)
    model = TrendKriging(correlation).fit(PLACES, TREND, TREND)
    with pytest.raises(UsageError, match="trend of shape"):
        model.predict(TARGETS, [1.0])
    assert np.isnan(model.predict(TARGETS[:1], [np.nan])[0][0])
