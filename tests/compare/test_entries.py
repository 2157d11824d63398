"""Scores of an entry of the benchmark: every number by hand."""

import dataclasses

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from aerpaw_cmp.compare.level import crps_normal
from benchmarks.published.score import LevelSeries, level_scores

RNG = np.random.default_rng(2)
LONG = LevelSeries(
    name="long", time_s=np.arange(60) * 2.0, measured_db=RNG.normal(-70, 6, 60), level_db=RNG.normal(-72, 3, 60),
    sd_db=RNG.uniform(2.0, 9.0, 60),
)  # fmt: skip
SHORT = LevelSeries(
    name="short", time_s=np.arange(25) * 1.5, measured_db=RNG.normal(-60, 4, 25), level_db=np.full(25, -61.0)
)


@pytest.mark.parametrize("error", [-3.0, 0.0, 0.7, 9.0])
def test_the_crps_is_the_area_between_the_forecast_and_the_step(error: float) -> None:
    below = quad(lambda x: norm.cdf(x, 0, 2.5) ** 2, -60, error)[0]
    above = quad(lambda x: norm.sf(x, 0, 2.5) ** 2, error, 60)[0]
    assert crps_normal(np.array([error]), np.array([2.5]))[0] == pytest.approx(below + above, abs=1e-6)


@pytest.mark.parametrize("own", [True, False])
def test_scores_are_those_by_hand(own: bool) -> None:
    series = dataclasses.replace(LONG, own_offset=own)
    scores, sd = level_scores([series]), LONG.sd_db
    assert sd is not None
    plain = LONG.measured_db - LONG.level_db
    error = plain - plain.mean() if own else plain
    assert scores["rmse_db"] == pytest.approx(np.sqrt(np.mean(error**2)))
    assert scores["bias_db"] == pytest.approx(abs(plain.mean()))
    assert scores["crps_db"] == pytest.approx(np.mean(crps_normal(error, sd)))
    assert scores["log_score"] == pytest.approx(-np.mean(norm.logpdf(error, 0.0, sd)))
    assert scores["coverage_90"] == pytest.approx(np.mean(np.abs(error) <= 1.644854 * sd))
    assert scores["n"] == 60.0
    both = level_scores([series, SHORT])
    assert both["rmse_db"] == pytest.approx((scores["rmse_db"] + SHORT.error_db.std()) / 2)
    assert both["n"] == 85.0
    assert np.isnan(both["crps_db"])
    fast = np.tile([3.0, -3.0], 400)  # a tenth of a second disappears in a mean over four seconds
    ripple = LevelSeries(name="r", time_s=np.arange(800) / 10.0, measured_db=fast, level_db=np.zeros(800))
    assert level_scores([ripple])["rmse_4s_db"] < 0.1
    assert level_scores([ripple])["rmse_db"] == pytest.approx(3.0)
    step = dataclasses.replace(ripple, measured_db=np.repeat([2.0, 6.0], 400), own_offset=own)
    assert level_scores([step])["rmse_4s_db"] == pytest.approx(2.0 if own else np.sqrt(20.0), abs=0.1)
