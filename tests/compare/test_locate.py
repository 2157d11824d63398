"""The place of a node by its levels: the evidence computed in a second way, and regions over simulated flights."""

import dataclasses
import tracemalloc
from collections.abc import Iterator
from time import process_time

import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm

from aerpaw_cmp.common.errors import InputError
from aerpaw_cmp.common.units import FloatArray
from aerpaw_cmp.compare import locate as locating
from aerpaw_cmp.compare.locate import Case, LevelModel, LevelTrack, fit_places, level_track, locate


def _lawnmower(n: int) -> tuple[FloatArray, FloatArray]:
    """Times and positions (n, 3) of a flight of 300 m by 300 m at 30 m."""
    along = np.linspace(0.0, 5.0, n)
    leg, part = np.divmod(along, 1.0)
    east = np.where(leg % 2 == 0, part, 1.0 - part) * 300.0 - 150.0
    return along * 60.0, np.column_stack([east, np.minimum(leg, 5.0) * 60.0 - 150.0, np.full(n, 30.0)])


def _covariance(time_s: FloatArray) -> FloatArray:
    """Return the covariance of shadowing (8 dB over 30 s) and scatter (4 dB)."""
    lag = np.abs(np.subtract.outer(time_s, time_s))
    shadow = 8.0**2 * np.exp(-lag / 30.0)
    return np.asarray(shadow + 4.0**2 * np.eye(len(time_s)))


def _prior(track: LevelTrack, place: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return mean and covariance of the levels of a node at a place, term by term."""
    mean, cover = [], _covariance(track.time_s)
    rows = []
    middle = (track.level_db.max() + track.level_db.min()) / 2
    for here in track.position_m:
        away = float(np.sqrt(((here - place) ** 2).sum()))
        up = np.arcsin((here[2] - place[2]) / away)
        mean.append(middle - 30.0 * np.log10(away / 100))
        rows.append([100.0, -10.0 * np.log10(away / 100), 5.0 * np.sin(up) ** 2, 2.5 * np.cos(4 * up)])
    return np.array(mean), cover + np.array(rows) @ np.array(rows).T


OVER_TIME = LevelModel(cases=(Case(shadow_db=8.0, scatter_db=4.0, time_s=30.0),))
PLACES = np.array([[0.0, 0.0, 1.5], [80.0, -40.0, 1.5], [-300.0, 200.0, 10.0]])


def test_the_evidence_is_that_of_a_normal_vector() -> None:
    time, position = _lawnmower(20)
    track = LevelTrack(time, position, np.random.default_rng(1).normal(-60.0, 8.0, 20))
    expected = [multivariate_normal.logpdf(track.level_db, *_prior(track, place)) for place in PLACES]
    assert fit_places(track, PLACES, OVER_TIME).evidence == pytest.approx(expected, abs=1e-6)


def test_the_evidence_is_the_mean_over_shadowing_and_gains_of_both_ends() -> None:
    """Covariances of everything that is unknown, level by level. Weights of cases multiply their likelihoods."""
    rng = np.random.default_rng(3)
    (time, position), turn = _lawnmower(12), np.linalg.qr(rng.normal(size=(12, 3, 3)))[0]
    track = LevelTrack(time, position, rng.normal(-60.0, 8.0, 12), rotation=turn)
    tried, apart = ((2.5, 15.0, 0.7), (4.5, 45.0, 0.3)), np.linalg.norm(position[:, None] - position, axis=2)
    cases = [
        Case(shadow_db=sd, length_m=length, scatter_db=1.5).with_gains(0.8, 1.5, weight) for sd, length, weight in tried
    ]
    found = fit_places(track, PLACES, LevelModel(cases=tuple(cases))).evidence
    for place, evidence in zip(PLACES, found, strict=True):
        mean, cover = _prior(track, place)
        e, n, _ = unit = ((position - place) / np.linalg.norm(position - place, axis=1)[:, None]).T
        x, y, z = np.einsum("nji,jn->in", turn, -unit)
        node = 0.8 * np.array([e, n, 0.7 * (e**2 - n**2), 1.4 * e * n])
        frame = [x, y, z, 1.7 * x * y, 1.7 * x * z, 1.7 * y * z, 0.9 * (x**2 - y**2), 0.6 * (3 * z**2 - 1)]
        terms = np.vstack([node, 1.5 * np.array(frame)])
        fixed = cover - _covariance(time) + terms.T @ terms + 1.5**2 * np.eye(12)
        logs = [
            np.log(weight) + multivariate_normal.logpdf(track.level_db, mean, fixed + sd**2 * np.exp(-apart / length))
            for sd, length, weight in tried
        ]
        assert evidence == pytest.approx(np.logaddexp(*logs), abs=1e-6)


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
    assert fit_places(track, PLACES, OVER_TIME).evidence == pytest.approx(expected, abs=0.05)  # Laplace


def test_a_median_is_below_the_floor_where_most_samples_are() -> None:
    time = np.arange(8) / 2.0
    track = level_track(time, np.zeros((8, 3)), [-90.0, -80.0, -20.0, -85.0, -99.0, np.nan, -30.0, -70.0], floor_db=-60)
    assert track.level_db.tolist() == [-60.0]
    assert track.below.all()
    assert len(level_track([], np.zeros((0, 3)), []).level_db) == 0


def _flights(count: int, floor_db: float, bins: int = 75) -> Iterator[tuple[LevelTrack, FloatArray]]:
    """Return flights drawn from the model, and the true position of the node, away from the estimate."""
    random = np.random.default_rng(5)
    time, position = _lawnmower(bins)
    for _ in range(count):
        seen = np.array([*random.uniform(-200.0, 200.0, 2), 1.5])
        blank = LevelTrack(time, position, np.array([-60.0, -60.0]).repeat([1, bins - 1]))
        mean, cover = _prior(blank, seen)
        cover = cover - 100.0**2 + 10.0**2  # the level at 100 m is free: 10 dB are enough
        level = np.maximum(random.multivariate_normal(mean, cover), floor_db)
        truth = seen[:2] + random.normal(0.0, 20.0, 2)
        yield LevelTrack(time, position, level, floor_db), truth


@pytest.mark.parametrize(("floor_db", "count"), [(-np.inf, 8), (-62.0, 4)])
def test_the_region_holds_the_node_nine_times_of_ten(floor_db: float, count: int) -> None:
    inside = 0
    for track, truth in _flights(count, floor_db, bins=28):
        estimate = locate(track)
        away = np.hypot(*(estimate.place_m[:2] - truth))
        inside += away <= estimate.radius90_m
    assert inside >= 0.75 * count


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

    def ahead(at_uav: FloatArray, at_node: FloatArray) -> tuple[FloatArray, FloatArray]:
        np.testing.assert_allclose(at_node, -at_uav)  # the axes of the site, if there is no attitude
        return 6.0 * at_uav[..., 1], np.full(at_uav.shape[:-1], 0.5)

    level = -30.0 * np.log10(distance) + 6.0 * (away / distance[:, None])[:, 1]
    plain, known = locate(LevelTrack(time, position, level)), locate(LevelTrack(time, position, level, -np.inf, ahead))
    assert np.hypot(*(plain.place_m - node)[:2]) > 20.0
    assert np.hypot(*(known.place_m - node)[:2]) < 15.0


def test_odds_tell_the_right_place_from_wrong_ones() -> None:
    wrong = np.array([[600.0, 0.0, 10.0], [0.0, -700.0, 10.0]])
    odds = [locating.place_odds(track, [[*truth, 1.5], *wrong]) for track, truth in _flights(6, -np.inf)]
    assert sum(o[0] > o[1:].max() + 1.0 for o in odds) >= 5  # they are shadowed more than the odds take for possible


def test_a_node_far_away_is_said_to_be_at_the_edge_or_anywhere() -> None:
    time, position = _lawnmower(75)
    away = np.hypot(*(position - [4000.0, 0.0, 0.0]).T[:2])
    estimate = locate(LevelTrack(time, position, -30.0 * np.log10(away)))
    assert estimate.at_edge or estimate.radius90_m > 300.0


def test_too_few_levels_are_refused() -> None:
    time, position = _lawnmower(20)
    with pytest.raises(InputError, match="19 bins"):
        locate(LevelTrack(time[:19], position[:19], np.zeros(19)))
    assert locate(LevelTrack(time, position, np.zeros(20))).radius90_m > 300.0  # levels that say nothing


@pytest.mark.parametrize(("length_s", "window_s"), [(100.0, 4.0), (470.0, 4.0), (1200.0, 1199.5 / 120 * 1.001)])
def test_levels_are_medians_of_four_seconds_and_at_most_120(length_s: float, window_s: float) -> None:
    time = np.arange(50.0, 50.0 + length_s, 0.5)
    level, place = np.sin(time), np.column_stack([time, -time, 0 * time])
    shuffled = np.random.default_rng(6).permutation(len(time))
    track = level_track(time[shuffled], place[shuffled], level[shuffled])
    groups = [(time >= a) & (time < a + window_s) for a in np.arange(50.0, 50.0 + length_s, window_s)]
    assert track.level_db == pytest.approx([np.median(level[some]) for some in groups])
    assert track.time_s == pytest.approx([time[some].mean() for some in groups])
    np.testing.assert_allclose(track.position_m[:, 1], -track.time_s)
    assert len(groups) <= 120


def test_the_grid_reaches_400_m_beyond_the_flight_and_the_region_a_tenth_of_the_tail(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(locating, "_MOST_GRID", 600)
    track = LevelTrack(np.zeros(2), np.array([[0.0, 100.0, 30.0], [200.0, 130.0, 30.0]]), np.zeros(2))
    grid, spacing = locating._grid(track)
    assert spacing == 40.0
    assert (grid.min(axis=0).tolist(), grid.max(axis=0).tolist()) == ([-400.0, -300.0], [600.0, 540.0])
    assert set(np.diff(np.unique(grid[:, 0]))) == set(np.diff(np.unique(grid[:, 1]))) == {40.0}
    assert len(grid) == 26 * 22
    edges = {(-361.0, 0.0): 1, (-360.0, 0.0): 0, (561.0, 0.0): 1, (560.0, 0.0): 0, (0.0, 501.0): 1, (0.0, -261.0): 1}
    for place, edge in edges.items():
        assert locating._on_edge(np.array([[*place, 1.5]]), grid, spacing).tolist() == [bool(edge)]
    far = np.array([[0.0, 0.0], [500.0, 0.0]])
    # all here; five percent far away: 18 in 19 of the others are within; twenty percent: half of those far away
    for shares, radius in (((1, 0), 20 * np.sqrt(-2 * np.log(0.1))), ((0.95, 0.05), 20 * np.sqrt(-2 * np.log(1 / 19))),
                           ((0.8, 0.2), 500.0)):  # fmt: skip
        assert locating.Regions.of(far, np.array(shares)).radius_m(far[0], 0.9) == pytest.approx(radius, abs=1.5)
    moved = locating._divided(np.array([[0.0, 0.0, 1.5], [100.0, 40.0, 10.0]]), (-40 / 3, 0.0, 40 / 3))
    steps = {(e, n, 1.5) for e in (-1, 0, 1) for n in (-1, 0, 1)}
    assert {tuple(row) for row in np.round(moved[:9] / [40 / 3, 40 / 3, 1], 9).tolist()} == steps
    assert moved[9:].mean(axis=0) == pytest.approx([100.0, 40.0, 10.0])
    assert locating._log_height(np.array([[0, 0, 1.5], [0, 0, 10.0]])) == pytest.approx(np.log([0.7, 0.3]))


def test_slope_and_bend_of_the_likelihood_by_differences() -> None:
    latent = np.array([[17.0, 2.0, -15.0, 0.0]])
    value, slope, bend = locating._likelihood(latent, 5.0)
    np.testing.assert_allclose(value, norm.logcdf(-latent / 5.0))
    for k in range(4):
        here, up, down = (locating._likelihood(latent + e * np.eye(4)[k], 5.0)[0].sum() for e in (0, 1e-3, -1e-3))
        assert slope[0, k] == pytest.approx((up - down) / 2e-3, rel=1e-5)
        assert bend[0, k] == pytest.approx(-(up - 2 * here + down) / 1e-6, rel=1e-3, abs=1e-6)


def test_a_straight_flight_leaves_two_places_and_both_are_regions() -> None:
    """Levels along a line are the same for a node and for its mirror image: each holds half."""
    time = np.arange(0.0, 240.0, 2.0)
    position = np.column_stack([np.zeros(120), 4.0 * time - 480.0, np.full(120, 30.0)])
    node = np.array([180.0, 40.0, 1.5])
    away = np.linalg.norm(position - node, axis=1)
    level = -30.0 * np.log10(away) + np.random.default_rng(3).normal(0.0, 1.0, 120)
    known = LevelModel(slope_sd=0.1, elevation_sd_db=0.1, cases=(Case(shadow_db=0.5, scatter_db=1.0, time_s=30.0),))
    estimate = locate(level_track(time, position, level), model=known)
    modes = estimate.regions.modes()
    assert len(modes) == 2
    assert modes[0].place_m[0] == pytest.approx(-modes[1].place_m[0], abs=20.0)
    assert [mode.share for mode in modes] == pytest.approx([0.45, 0.45], abs=0.1)
    for place, inside in ((node[:2], True), ((-180.0, 40.0), True), ((0.0, 40.0), False)):
        assert any(np.hypot(*(mode.place_m - place)) <= mode.radius_m for mode in modes) is inside


def test_levels_that_do_not_fall_with_the_distance_place_no_node() -> None:
    time, position = _lawnmower(75)
    noise = np.random.default_rng(4).normal(0.0, 3.0, 75)
    near, far = (-30.0 * np.log10(np.linalg.norm(position - [east, 40.0, 1.5], axis=1)) for east in (80.0, 9000.0))
    for way, level, placed in (
        (position, near + noise, True), (position, far + noise, False), (position, np.full(75, -60.0), False),
        (4.0 * position, np.full(75, -60.0), False), (0.0 * position + 30.0, noise, False),
    ):  # fmt: skip
        assert locate(level_track(2.0 * time, way, level)).placed == placed


def test_a_hover_that_turns_places_no_node() -> None:
    """The level does not change with the heading, so the model prefers a node directly below."""
    time = 4.0 * np.arange(80)
    level = np.random.default_rng(4).normal(-80.0, 1.0, 80)
    cos, sin = np.cos(time / 40.0), np.sin(time / 40.0)
    turned = np.moveaxis(np.array([[cos, -sin, 0 * cos], [sin, cos, 0 * cos], [0 * cos, 0 * cos, 1 + 0 * cos]]), -1, 0)
    for moved_m, placed in ((1.0, False), (30.0, True)):
        way = np.column_stack([np.linspace(0.0, moved_m, 80), np.zeros(80), np.full(80, 30.0)])
        assert locate(dataclasses.replace(level_track(time, way, level), rotation=turned)).placed == placed


def test_regions_of_one_place_are_the_disks_of_a_normal_distribution() -> None:
    """Blurred by 20 m an axis, 90 % lie within 20 sqrt(2 ln 10) m and 50 % within 20 sqrt(2 ln 2) m."""
    regions = locating.Regions.of(np.array([[10.0, -30.0]]), np.ones(1))
    for part, radius_m in ((0.9, 20.0 * np.sqrt(2.0 * np.log(10.0))), (0.5, 20.0 * np.sqrt(2.0 * np.log(2.0)))):
        (mode,) = regions.modes(part)
        assert regions.radius_m(mode.place_m, part) == pytest.approx(radius_m, abs=4.0)
        assert mode.radius_m < radius_m
        assert mode.share == pytest.approx(part, abs=0.01)
        area_m2 = (regions.likelier() < part).sum() * np.diff(regions.east_m)[0] * np.diff(regions.north_m)[0]
        assert area_m2 == pytest.approx(np.pi * radius_m**2, rel=0.03)


def test_a_part_that_holds_almost_nothing_is_no_place_of_its_own() -> None:
    places = np.array([[0.0, 0.0], [500.0, 0.0], [-400.0, 300.0]])
    regions = locating.Regions.of(places, np.array([0.6, 0.38, 0.02]))
    assert [mode.place_m.round(-1).tolist() for mode in regions.modes(0.995)] == [[0.0, 0.0], [500.0, 0.0]]


def test_the_least_part_of_likelier_cells_is_that_of_the_likeliest_cell() -> None:
    """Cells of 0.5, 0.3 and 0.2: 0, 0.5 and 0.8 of the posterior are in likelier cells."""
    regions = locating.Regions(np.arange(3.0), np.zeros(1), np.array([[0.2], [0.5], [0.3]]))
    assert regions.likelier().ravel() == pytest.approx([0.8, 0.0, 0.5])


@pytest.mark.parametrize(("length_m", "across_m", "noise_db"), [(7e3, 2e3, 3.0), (15e3, 15e3, 3.0), (15e3, 0.0, 1.0)])
def test_a_track_of_15_km_finds_its_node_in_little_memory(length_m: float, across_m: float, noise_db: float) -> None:
    """The memory grew with the square of the places: 200 GiB at 15 km."""
    time, rng = np.arange(0.0, 1800.0), np.random.default_rng(1)
    east, north = np.linspace(-0.5, 0.5, 1800) * length_m, 0.5 * across_m * np.sin(2 * np.pi * time / 450.0)
    position = np.column_stack([east, north, np.full(1800, 60.0)])
    node = np.array([0.2 * length_m, 150.0, 1.5])
    level = -30.0 * np.log10(np.linalg.norm(position - node, axis=1)) + rng.normal(0.0, noise_db, 1800)
    tracemalloc.start()
    before = process_time()
    estimate = locate(level_track(time, position, level))
    modes = estimate.regions.modes()
    spent_s, peak = process_time() - before, tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert any(np.hypot(*(mode.place_m - node[:2])) <= mode.radius_m for mode in modes)
    assert peak < 400 * 2**20
    assert spent_s < 5.0


def test_levels_that_say_nothing_leave_a_long_track_undivided() -> None:
    """Every place is possible: the region stays as wide as the search, and in few parts."""
    time, rng = np.arange(0.0, 1800.0), np.random.default_rng(1)
    position = np.column_stack([10.0 * time, 3000.0 * np.sin(time / 70.0), np.full(1800, 60.0)])
    estimate = locate(level_track(time, position, rng.normal(-60.0, 3.0, 1800)))
    assert estimate.radius90_m > 5000.0
    assert len(estimate.regions.modes()) <= 5


@pytest.mark.parametrize(("turn_deg", "learned"), [(0.0, True), (180.0, False)])
def test_a_learned_airframe_counts_only_if_the_levels_support_it(turn_deg: float, learned: bool) -> None:
    """The gain of a flight that turns at each leg, and the same gain mounted the wrong way round."""
    (time, position), node = _lawnmower(75), np.array([40.0, -70.0, 1.5])
    heading = np.where(np.arange(75) // 15 % 2 == 0, 0.0, np.pi)
    c, s, o = np.cos(heading), np.sin(heading), np.zeros(75)
    rotation = np.moveaxis(np.array([[c, -s, o], [s, c, o], [o, o, o + 1.0]]), -1, 0)
    away = node - position
    distance = np.linalg.norm(away, axis=1)
    ahead = np.einsum("nji,nj->ni", rotation, away / distance[:, None])[:, 0]
    level = -30.0 * np.log10(distance) + 8.0 * ahead + np.random.default_rng(2).normal(0.0, 1.0, 75)
    sign = np.cos(np.deg2rad(turn_deg))

    def gain(at_uav: FloatArray, _: FloatArray) -> tuple[FloatArray, FloatArray]:
        return 8.0 * sign * at_uav[..., 0], np.full(at_uav.shape[:-1], 0.5)

    track = LevelTrack(time, position, level, airframe_db=gain, rotation=rotation)
    both = locating.UNKNOWN.cases + tuple(case.with_airframe() for case in locating.UNKNOWN.cases)
    likely = locating._likely_cases(track, locating._grid(track)[0], LevelModel(cases=both))
    assert {case.learned for case in likely.cases} == {learned}
    if learned:
        assert np.hypot(*(locate(track).place_m - node)[:2]) < 20.0


def test_levels_choose_between_shadowing_over_place_and_over_time() -> None:
    """A lawnmower that passes each place twice: the shadowing returns, or it does not."""
    time, way = np.arange(120) * 4.0, _lawnmower(60)[1]
    position = np.concatenate([way, way[::-1]])
    apart, lag = np.linalg.norm(position[:, None] - position, axis=2), np.abs(time[:, None] - time)
    level = -30.0 * np.log10(np.linalg.norm(position - [30.0, 20.0, 1.5], axis=1))
    for covariance, over_place in ((np.exp(-apart / 60.0), True), (np.exp(-lag / 30.0), False)):
        root = np.linalg.cholesky(covariance + 1e-6 * np.eye(120))
        track = LevelTrack(time, position, level + 8.0 * root @ np.random.default_rng(9).normal(size=120))
        likely = locating._likely_cases(track, locating._grid(track)[0], locating.UNKNOWN).cases
        assert all(np.isfinite(case.length_m) == over_place for case in likely)


def test_few_levels_below_the_floor_stand_for_many() -> None:
    time, position = _lawnmower(75)
    level = np.where(np.arange(75) % 2 == 0, -80.0, -60.0)
    track = locating._thinned(LevelTrack(time, position, level, floor_db=-80.0, rotation=np.zeros((75, 3, 3))))
    assert (track.below.sum(), (~track.below).sum()) == (locating._MOST_BELOW, 37)
    assert track.rotation is not None
    assert len(track.rotation) == len(track.time_s) == len(track.position_m) == 37 + locating._MOST_BELOW
