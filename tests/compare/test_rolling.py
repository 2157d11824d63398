"""The rest of a route, predicted as records come: the trend that the levels have, intervals that hold, NaN left out."""

import numpy as np
import pytest

from aerpaw_cmp.compare.field_gp import KEEP, NONE, RouteAhead
from aerpaw_cmp.compare.level import crps_normal


def route():
    """A lawnmower of 1.6 km at 8 m/s, a point every 2 s."""
    t = np.arange(0.0, 200.0, 2.0)
    leg = (t // 40).astype(int)
    east = np.where(leg % 2 == 0, t % 40, 40 - t % 40) * 8.0
    return t, np.column_stack([east, 40.0 * leg, np.full(len(t), 30.0)])


def flown(trend, seed, until_s=120.0):
    """Simulate levels along a route as a trend, a smooth field and noise. Return the prediction at the given time."""
    rng = np.random.default_rng(seed)
    t, place = route()
    free = -20.0 * np.log10(np.linalg.norm(place - [400.0, 300.0, 10.0], axis=1))
    away = np.linalg.norm(place[:, None] - place[None], axis=2)
    smooth = np.linalg.cholesky(4.0 * np.exp(-away / 60.0) + 1e-9 * np.eye(len(t))) @ rng.normal(size=len(t))
    truth = (3.0 * free if trend else 0.0) + smooth
    ahead, last = RouteAhead(place, {"free space": 3.0 * free}), None
    for now in np.arange(0.0, until_s, 0.1):
        here = np.array([np.interp(now, t, place[:, i]) for i in range(3)])
        level = np.interp(now, t, truth) + rng.normal(0.0, 1.0)
        last = ahead.add(now, here, level, {"free space": np.interp(now, t, 3.0 * free)}) or last
    return ahead, last, truth


@pytest.mark.parametrize(("trend", "name"), [(True, "free space"), (False, NONE)])
def test_the_trend_is_that_of_the_levels(trend, name):
    chosen = [flown(trend, seed)[1].trend for seed in range(4)]
    assert chosen.count(name) >= 3


def test_the_rest_begins_where_the_uav_is_and_its_intervals_hold():
    inside = []
    for seed in range(4):
        _, last, truth = flown(True, seed)
        assert 58 <= last.index[0] <= 61  # 120 s of 200 s flown, a point every 2 s
        assert last.index[-1] == 99
        low, high = last.interval_db
        sample = truth[last.index] + np.random.default_rng(seed).normal(0.0, 1.0, len(last.index))
        inside.append(np.mean((sample > low) & (sample < high)))
    assert np.mean(inside) > 0.7


def test_levels_that_are_no_numbers_and_old_ones_take_no_part():
    ahead, last, _ = flown(False, 1)
    before = len(ahead._bins)
    assert ahead.add(200.0, np.array([0.0, 0.0, np.nan]), -80.0, {"free space": 0.0}) is None
    assert ahead.add(200.0, np.array([0.0, 0.0, 30.0]), np.nan, {"free space": 0.0}) is None
    assert len(ahead._bins) == before <= KEEP
    assert last is not None


def test_a_route_may_be_entered_in_its_middle():
    """The first prediction looks ahead over fifty points, not from the take-off on."""
    t, place = route()
    ahead, first = RouteAhead(place, {}), None
    for now in np.arange(60.0, 100.0, 0.1):
        here = np.array([np.interp(now, t, place[:, i]) for i in range(3)])
        first = first or ahead.add(now, here, -80.0 + np.sin(now), {})
    assert first is not None
    assert abs(t[first.index[0]] - (60.0 + 2.0 * 8)) <= 4.0


def by_hand(length, place, time, value, here, later):
    """Mean and standard deviation of a Gaussian process about the mean of what is known, its scale estimated."""

    def k(a, b, t, u):
        across = np.hypot(*(a[:, None] - b)[..., :2].transpose(2, 0, 1))
        up = np.abs(a[:, None, 2] - b[:, 2])
        return 100.0**2 + 9.0 * np.exp(-(across + up) / length) + np.exp(-np.abs(t[:, None] - u) / 20.0)

    matrix = k(place, place, time, time) + 1.5**2 * np.eye(len(time))
    away, across = value - value.mean(), k(here, place, later, time)
    inside = np.linalg.solve(matrix, across.T)
    left = k(here[:1], here[:1], later[:1], later[:1])[0, 0] - (across * inside.T).sum(axis=1) + 1.5**2
    scale = away @ np.linalg.solve(matrix, away) / len(away)
    return value.mean() + inside.T @ away, np.sqrt(max(scale, 0.01) * left)


@pytest.mark.parametrize("ripple_db", [4.0, 0.05])
def test_each_prediction_is_that_of_the_bins_by_hand(ripple_db):
    """Bins have two seconds and four samples.

    The trend is the one with the lowest discounted score for levels 20 s ahead of the known ones.
    """
    rng = np.random.default_rng(3)
    line = np.column_stack([np.arange(200) * 4.0, np.full(200, 3.0), 30.0 + 0.01 * np.arange(200)])
    trends = {"up": 0.05 * line[:, 0], "down": -0.03 * line[:, 0]}
    ahead, bins, rows, squares, scores = RouteAhead(line, trends), [], [], [], {}
    for number in range(4 * 26 + 1):
        now, here = 0.5 * number, np.array([4.0 * number / 2, 3.0, 30.0])
        level = -70.0 + 0.05 * here[0] + ripple_db * np.sin(now / 3.0) + rng.normal(0.0, 0.5 * ripple_db)
        trend_db = {"up": 0.05 * here[0], "down": -0.03 * here[0]}
        prediction = ahead.add(now, here, level, trend_db)
        if number % 4 == 0 and number:
            of = np.array(rows[-4:]).mean(axis=0)
            squares.append(((np.array(rows[-4:])[:, 4] - of[4]) ** 2).sum() / 3.0)
            known = [b for b in bins if b[0] < of[0] - 20.0]
            if len(known) >= 8:
                past = np.array(known)
                for column, name in ((5, "up"), (6, "down"), (7, NONE)):
                    for length in (30.0, 120.0):
                        mean, sd = by_hand(length, past[:, 1:4], past[:, 0], past[:, 4] - past[:, column],
                                           of[None, 1:4], of[:1])  # fmt: skip
                        score = crps_normal(of[4] - of[column] - mean, sd)[0]
                        scores.setdefault((name, length), []).append(score)
            bins.append(of)
            assert (prediction is None) == (len(bins) < 8)
            if prediction is not None:
                weight = 0.98 ** np.arange(100)
                means = {
                    key: np.average(history[::-1], weights=weight[: len(history)]) for key, history in scores.items()
                }
                trend, length = min(means, key=means.__getitem__, default=(NONE, 120.0))
                assert prediction.trend == trend
                assert prediction.index[0] == np.abs(line[:, 0] - here[0]).argmin()
                past, rest = np.array(bins), line[prediction.index]
                later = (
                    past[-1, 0]
                    + np.cumsum([np.linalg.norm(rest[0] - here), *np.linalg.norm(np.diff(rest, axis=0), axis=1)]) / 8.0
                )
                own = {"up": 0.05 * rest[:, 0], "down": -0.03 * rest[:, 0], NONE: np.zeros(len(rest))}[trend]
                column = {"up": 5, "down": 6, NONE: 7}[trend]
                mean, sd = by_hand(length, past[:, 1:4], past[:, 0], past[:, 4] - past[:, column], rest, later)
                np.testing.assert_allclose(prediction.level_db, own + mean, atol=1e-6)
                np.testing.assert_allclose(prediction.sd_db, np.sqrt(sd**2 + np.mean(squares)), rtol=1e-6)
                np.testing.assert_allclose(np.diff(prediction.interval_db, axis=0)[0], 2 * 1.645 * prediction.sd_db)
        else:
            assert prediction is None
        rows.append((now, *here, level, trend_db["up"], trend_db["down"], 0.0))
    assert len(scores[NONE, 30.0]) == 8
