"""Where a node stands, by levels: the evidence a second way, and regions over simulated flights."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm

from aerpaw_cmp.common.units import FloatArray
from aerpaw_cmp.compare import locate as locating
from aerpaw_cmp.compare.locate import LevelTrack, fit_places, level_track, locate


def _lawnmower(n: int) -> tuple[FloatArray, FloatArray]:
    """Times and positions (n, 3) of a flight of 300 m by 300 m at 30 m."""
    along = np.linspace(0.0, 5.0, n)
    leg, part = np.divmod(along, 1.0)
    east = np.where(leg % 2 == 0, part, 1.0 - part) * 300.0 - 150.0
    return along * 60.0, np.column_stack([east, np.minimum(leg, 5.0) * 60.0 - 150.0, np.full(n, 30.0)])


def _covariance(time_s: FloatArray) -> FloatArray:
    """Of shadowing and scatter, from the module's constants and none of its code."""
    lag = np.abs(np.subtract.outer(time_s, time_s))
    shadow = locating.SHADOW_SD_DB**2 * np.exp(-lag / locating.SHADOW_S)
    return np.asarray(shadow + locating.SCATTER_SD_DB**2 * np.eye(len(time_s)))


def _prior(track: LevelTrack, place: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean and covariance of the levels of a node at a place, term by term."""
    mean, cover = [], _covariance(track.time_s)
    rows = []
    middle = (track.level_db.max() + track.level_db.min()) / 2
    for here in track.position_m:
        away = float(np.sqrt(((here - place) ** 2).sum()))
        up = np.arcsin((here[2] - place[2]) / away)
        mean.append(middle - 10 * locating.SLOPE * np.log10(away / 100))
        rows.append(
            [100.0, -10 * locating.SLOPE_SD * np.log10(away / 100), locating.ELEVATION_SD_DB * np.sin(up) ** 2,
             locating.ELEVATION_SD_DB / 2 * np.cos(4 * up)]
        )  # fmt: skip
    return np.array(mean), cover + np.array(rows) @ np.array(rows).T


PLACES = np.array([[0.0, 0.0, 1.5], [80.0, -40.0, 1.5], [-300.0, 200.0, 10.0]])


def test_the_evidence_is_that_of_a_normal_vector() -> None:
    time, position = _lawnmower(20)  # fewer bins than terms of the shadowing: nothing is left to scatter
    track = LevelTrack(time, position, np.random.default_rng(1).normal(-60.0, 8.0, 20))
    expected = [multivariate_normal.logpdf(track.level_db, *_prior(track, place)) for place in PLACES]
    assert fit_places(track, PLACES).evidence == pytest.approx(expected, abs=1e-6)


def test_a_level_below_the_floor_counts_as_the_probability_to_be_below() -> None:
    time, position = _lawnmower(12)
    level = np.maximum(np.random.default_rng(2).normal(-60.0, 8.0, 12), -69.0)
    level[5] = -70.0
    track = LevelTrack(time, position, level, floor_db=-70.0)
    others = np.flatnonzero(~track.below)
    expected = []
    for place in PLACES:
        mean, cover = _prior(track, place)
        low = np.flatnonzero(track.below)
        known = multivariate_normal.logpdf(level[others], mean[others], cover[np.ix_(others, others)])
        gain = np.linalg.solve(cover[np.ix_(others, others)], cover[np.ix_(others, low)]).T
        at = mean[low] + gain @ (level[others] - mean[others])
        rest = cover[np.ix_(low, low)] - gain @ cover[np.ix_(others, low)]
        assert len(low) == 1
        expected.append(known + norm.logcdf(-70.0, at[0], np.sqrt(rest[0, 0])))
    assert fit_places(track, PLACES).evidence == pytest.approx(expected, abs=0.05)  # Laplace


def test_a_median_is_below_the_floor_where_most_samples_are() -> None:
    time = np.arange(8) / 2.0
    track = level_track(time, np.zeros((8, 3)), [-90.0, -80.0, -20.0, -85.0, -99.0, np.nan, -30.0, -70.0], floor_db=-60)
    assert track.level_db.tolist() == [-60.0]
    assert track.below.all()
    assert len(level_track([], np.zeros((0, 3)), []).level_db) == 0


def _flights(count: int, floor_db: float) -> Iterator[tuple[LevelTrack, FloatArray]]:
    """Flights drawn from the model, and where the node truly stood: away from where the levels say, as in the field."""
    random = np.random.default_rng(5)
    time, position = _lawnmower(75)
    for _ in range(count):
        seen = np.array([*random.uniform(-200.0, 200.0, 2), 1.5])
        blank = LevelTrack(time, position, np.array([-60.0, -60.0]).repeat([1, 74]))
        mean, cover = _prior(blank, seen)
        cover = cover - 100.0**2 + 10.0**2  # the level at 100 m is free: 10 dB are enough
        level = np.maximum(random.multivariate_normal(mean, cover), floor_db)
        truth = seen[:2] + random.normal(0.0, locating.SYSTEMATIC_M, 2)
        yield LevelTrack(time, position, level, floor_db), truth


@pytest.mark.parametrize("floor_db", [-np.inf, -62.0])
def test_the_region_holds_the_node_nine_times_of_ten(floor_db: float) -> None:
    inside = 0
    for track, truth in _flights(25, floor_db):
        estimate = locate(track)
        away = np.hypot(*(estimate.place_m[:2] - truth))
        inside += truth in estimate
        assert (truth in estimate) == (away <= estimate.radius90_m)
    assert inside >= 20  # of 25 at 90 %: fewer once in 30 such tests


def test_a_flight_without_shadowing_finds_its_node() -> None:
    time, position = _lawnmower(75)
    node = np.array([40.0, -70.0, 1.5])
    level = -30.0 * np.log10(np.linalg.norm(position - node, axis=1))
    estimate = locate(LevelTrack(time, position, level))
    assert np.hypot(*(estimate.place_m - node)[:2]) < 15.0
    assert estimate.slope == pytest.approx(3.0, abs=2.0 * estimate.slope_sd)


def test_the_gain_of_the_airframe_keeps_the_node_from_moving_to_where_the_nose_points() -> None:
    """Twelve dB more ahead than behind on a flight that looks north: without it the level says the node is south."""
    time, position = _lawnmower(75)
    node = np.array([40.0, -70.0, 1.5])
    away = node - position
    distance = np.linalg.norm(away, axis=1)

    def ahead(towards: FloatArray) -> FloatArray:
        return 6.0 * towards[..., 1]

    level = -30.0 * np.log10(distance) + ahead(away / distance[:, None])
    plain, known = locate(LevelTrack(time, position, level)), locate(LevelTrack(time, position, level, -np.inf, ahead))
    assert np.hypot(*(plain.place_m - node)[:2]) > 40.0
    assert np.hypot(*(known.place_m - node)[:2]) < 15.0


def test_odds_tell_the_right_place_from_wrong_ones() -> None:
    wrong = np.array([[600.0, 0.0, 10.0], [0.0, -700.0, 10.0]])
    odds = [locate(track, [[*truth, 1.5], *wrong]).log_odds for track, truth in _flights(8, -np.inf)]
    assert np.median([o[0] for o in odds]) > 2.0
    assert all(o[0] > o[1:].max() + 1.0 for o in odds)


def test_a_node_far_away_is_said_to_be_at_the_edge_or_anywhere() -> None:
    time, position = _lawnmower(75)
    away = np.hypot(*(position - [4000.0, 0.0, 0.0]).T[:2])
    estimate = locate(LevelTrack(time, position, -30.0 * np.log10(away)))
    assert estimate.at_edge or estimate.radius90_m > 300.0


def test_too_few_levels_are_refused() -> None:
    time, position = _lawnmower(10)
    with pytest.raises(ValueError, match="10 levels"):
        locate(LevelTrack(time, position, np.zeros(10)))
