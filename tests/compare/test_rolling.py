"""The rest of a route, predicted as records come: the trend that the levels have, intervals that hold, NaN left out."""

import numpy as np
import pytest

from aerpaw_cmp.compare.rolling import KEEP, NONE, RouteAhead


def route():
    """A lawnmower of 1.6 km at 8 m/s, a point every 2 s."""
    t = np.arange(0.0, 200.0, 2.0)
    leg = (t // 40).astype(int)
    east = np.where(leg % 2 == 0, t % 40, 40 - t % 40) * 8.0
    return t, np.column_stack([east, 40.0 * leg, np.full(len(t), 30.0)])


def flown(trend, seed, until_s=120.0):
    """Levels of a route whose truth is a trend, a smooth field and noise; the prediction at the time given."""
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


def test_far_ahead_the_trend_and_the_mean_of_what_it_leaves_are_said():
    """Levels that follow the trend 15 dB above it, but for half a decibel of ripple, go on 15 dB above it."""
    t, place = route()
    free = -60.0 * np.log10(np.linalg.norm(place - [400.0, 300.0, 10.0], axis=1))
    ahead, last = RouteAhead(place, {"free space": free}), None
    for now in np.arange(0.0, 120.0, 0.1):
        here = np.array([np.interp(now, t, place[:, i]) for i in range(3)])
        level = np.interp(now, t, free)
        last = ahead.add(now, here, level + 15.0 + 0.5 * np.sin(now), {"free space": level}) or last
    assert last.trend == "free space"
    np.testing.assert_allclose(last.level_db, free[last.index] + 15.0, atol=0.6)


def test_levels_that_are_no_numbers_and_old_ones_take_no_part():
    ahead, last, _ = flown(False, 1)
    before = len(ahead._bins.level)
    assert ahead.add(200.0, np.array([0.0, 0.0, np.nan]), -80.0, {"free space": 0.0}) is None
    assert ahead.add(200.0, np.array([0.0, 0.0, 30.0]), np.nan, {"free space": 0.0}) is None
    assert len(ahead._bins.level) == before <= KEEP
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
