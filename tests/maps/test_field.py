"""Kriging of measured rank and RSS: real flights, when the logs are there."""

import numpy as np
import pandas as pd
import pytest

from aerpaw_cmp.common.geodesy import SiteFrame
from aerpaw_cmp.maps import evaluate
from aerpaw_cmp.maps.kriging import OrdinaryKriging
from aerpaw_cmp.maps.variogram import field_correlation, fit_biexponential
from tests.real_logs import REAL, dataset12

pytestmark = pytest.mark.field
FRAME = SiteFrame(35.72750947, -78.69595819)


def rank_flight(number):
    """Positions (n, 3) and measured rank above 10 m."""
    table = pd.read_csv(REAL / f"nr_rank/july2_2024_flight{number}_nemo_nr.csv")
    table = table[(table["alt_m"] > 10) & table["pdsch_rank"].notna()]
    east, north = FRAME.to_local(table["lat"], table["lon"])
    return np.column_stack([east, north, table["alt_m"]]), table["pdsch_rank"].to_numpy()


def rss_flight():
    """Positions (n, 3), power of both channels [dB re full scale] and seconds, above 10 m."""
    column = dataset12("40m_fs10MHz")
    east, north = FRAME.to_local(column["latitude"], column["longitude"])
    high = column["mZ"] > 10
    power = np.column_stack([column["mpower1"], column["mpower2"]])
    return np.column_stack([east, north, column["mZ"]])[high], power[high]


def fitted(points, values):
    """Fit a curve through bins of 30 m.

    Samples closer than half a bin share the same fading and would hide the nugget.
    """
    bins = field_correlation(points, values, maximum_m=300.0)
    return fit_biexponential(bins.mean_distance_m[1:], bins.correlation[1:])


@pytest.mark.parametrize(("first", "second"), [(1, 3), (3, 1)])
def test_measured_rank_of_one_flight_predicts_another(first, second):
    """Trained on one flight, scored on the other: better than the best constant, worse than its own neighbours.

    The 20 nearest samples of a flight lie on one spot of its track; 20 drawn within 150 m see several passes.
    """
    train, train_rank = rank_flight(first)
    test, test_rank = rank_flight(second)
    fit = fitted(train, train_rank)
    assert fit.nugget > 0.1, "most of the variation repeats neither in space nor between flights"
    model = OrdinaryKriging(fit, 20, 150.0, selection="random", outside="nearest").fit(train[:, :2], train_rank)
    error = evaluate.score(test_rank, model.predict(test[:, :2])[0])
    own = evaluate.leave_one_out(OrdinaryKriging(fit, 20, 150.0), test[:, :2], test_rank)
    assert error.n == len(test_rank)
    assert error.rmse < np.sqrt(np.mean((test_rank - train_rank.mean()) ** 2))
    assert error.mae < np.abs(test_rank - train_rank.mean()).mean()
    assert own.rmse < error.rmse


def test_measured_rss_neighbours_give_it_away():
    """Leave-one-out on a flight log is optimistic: the next sample is a metre away. Blocks tell the truth."""
    points, power = rss_flight()
    model = OrdinaryKriging(fitted(points, power), 20, 150.0, outside="nearest")
    near = evaluate.leave_one_out(model, points[:, :2], power)
    blocked = evaluate.blocked(model, points[:, :2], power, 100.0)
    spread = power.std(axis=0)
    assert (near.rmse < 3.0).all(), "dB"
    assert (near.rmse < 0.5 * blocked.rmse).all()
    assert (blocked.rmse < spread).all()
    assert (blocked.n == len(points)).all()
