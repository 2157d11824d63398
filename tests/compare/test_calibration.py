"""Splits of a calibration: nothing is scored where it was learned, many flights in groups, offsets shared or own."""

import dataclasses

import numpy as np
import pytest

from aerpaw_cmp.compare import calibration
from aerpaw_cmp.compare.calibration import (
    Observed,
    Parts,
    Recipe,
    flight_left_out,
    flights_of,
    groups_of,
    spread_flights,
)
from aerpaw_cmp.compare.gains import GainModel, LinkSamples, StatedSpread, Term, fading_of, inside_shares
from aerpaw_cmp.compare.ladder import log_distance_level_db
from aerpaw_cmp.compare.level import floored_fit, local_mean_db
from aerpaw_cmp.propagation.geometry import rotation_from_yaw_pitch_roll

MODEL = GainModel(terms=(Term("mast", "antenna", 0.5, 3.0),), bin_s=4.0)
RECIPE = Recipe(MODEL)


def observed(flight: str, offset_db: float = 0.0, seed: int = 0) -> Observed:
    """A circle about the mast whose antenna has 4 dB of cosine gain over azimuth."""
    time = np.arange(0.0, 400.0, 2.0)
    azimuth = 2 * np.pi * time / 400.0 + seed
    line = np.stack([np.cos(azimuth), np.sin(azimuth), np.full(len(time), 0.3)], axis=1)
    unit = line / np.linalg.norm(line, axis=1, keepdims=True)
    noise = np.random.default_rng(seed).normal(0.0, 0.5, len(time))
    samples = LinkSamples(
        flight=flight, tower="LW1", channel="USRP1", time_s=time, position_m=200.0 * line, at_uav=-unit, at_tower=unit,
        residual_db=4.0 * np.cos(azimuth) + noise + offset_db,
    )  # fmt: skip
    return Observed(samples, np.full(len(time), -60.0), np.zeros(len(time)))


def test_an_offset_of_one_flight_shows_only_where_offsets_are_shared() -> None:
    flights = [observed("a", seed=1), observed("b", seed=2), observed("c", offset_db=6.0, seed=3)]
    learned: dict[str, calibration.Learned] = {}
    scores = {s.flight: s for s in flight_left_out(flights, RECIPE, learned)}
    assert all(s.rmse_db < 1.0 < 2.0 < s.free_space_rmse_db for s in scores.values())
    assert scores["c"].rmse_shared_offset_db == pytest.approx(np.hypot(scores["c"].rmse_db, 6.0), abs=0.3)
    assert scores["a"].rmse_shared_offset_db == pytest.approx(np.hypot(scores["a"].rmse_db, 3.0), abs=0.3)
    assert all(s.constant_rmse_db == pytest.approx(s.free_space_rmse_db) for s in scores.values())  # one distance
    assert all(np.isfinite([s.inside_50, s.inside_95]).all() for s in scores.values())
    unasked = ("inside_50", "inside_95", "rmse_shared_offset_db")  # values that are not needed are not computed
    assert all(np.isnan([getattr(s, name) for name in unasked]).all() for s in flight_left_out(flights, RECIPE))
    series = [o.samples for o in flights]
    assert (
        calibration.learn(series, RECIPE, MODEL).model == MODEL
    )  # strengths that are given are not scaled to the data
    assert calibration.learn(series, RECIPE).model != MODEL
    level = [dataclasses.replace(o, samples=dataclasses.replace(o.samples)) for o in flights[:2]]
    assert all(s.rmse_shared_offset_db < s.rmse_db + 0.1 for s in flight_left_out(level, RECIPE, {}))


def test_many_flights_are_left_out_in_groups_and_none_is_learned_from_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    flights = [observed(f"f{k:02d}", seed=k) for k in range(14)]
    learned_from: list[set[str]] = []
    really = calibration.learn

    def spied(series, *rest):
        learned_from.append({s.flight for s in series})
        return really(series, *rest)

    monkeypatch.setattr(calibration, "learn", spied)
    by_flight: dict[str, calibration.Learned] = {}
    scores = flight_left_out(flights, RECIPE, by_flight)
    assert {s.flight for s in scores} == set(by_flight) == set(flights_of(flights))
    assert len(learned_from) == 6
    groups = groups_of(flights_of(flights))
    for group, used in zip(groups, learned_from, strict=True):
        assert used == set(flights_of(flights)) - set(group)
    assert sorted(name for group in groups for name in group) == flights_of(flights)


def test_few_flights_are_left_out_one_by_one_and_many_are_sampled_over_the_season() -> None:
    assert groups_of(["a", "b", "c"]) == [["a"], ["b"], ["c"]]
    assert spread_flights(["a", "b"]) == ["a", "b"]
    names = [f"{k}" for k in range(20)]
    some = spread_flights(names)
    assert len(some) == len(set(some)) == 6
    assert (some[0], some[-1]) == ("0", "19")


def test_the_mean_alone_is_that_of_the_prediction() -> None:
    arc = np.arange(70)  # the mean over it is not that over the circle
    learned = calibration.learn([observed(name, seed=1).samples.part(arc) for name in "ab"], RECIPE)
    other = observed("c", seed=3).samples
    lost = dataclasses.replace(other, at_uav=np.where(np.arange(len(other))[:, None] < 5, np.nan, other.at_uav))
    np.testing.assert_allclose(learned.mean(lost), learned.predict(lost)[0], rtol=0, atol=1e-9)
    assert learned.mean_error(lost) == pytest.approx(np.nanmean(lost.residual_db - learned.mean(lost)), abs=1e-9)
    assert np.isnan(learned.mean(lost)).sum() == 5


def test_levels_below_the_floor_of_a_receiver_teach_no_gain() -> None:
    """A receiver without lock writes noise. Used as levels, this noise would flatten the antenna's null."""

    def lost(o: Observed, floor_db: float | None) -> Observed:
        faded = o.samples.residual_db + np.random.default_rng(4).normal(0.0, 3.0, len(o.samples))
        written = np.where(faded < -1.0, -21.0, faded)
        floor = None if floor_db is None else np.full(len(written), floor_db)
        return dataclasses.replace(o, samples=dataclasses.replace(o.samples, residual_db=written, floor_db=floor))

    truth = observed("c", seed=3).samples
    flights = [observed("a", seed=1), observed("b", seed=2)]
    error = {}
    for floor_db in (None, -1.0):
        learned = calibration.learn([lost(o, floor_db).samples for o in flights], RECIPE)
        error[floor_db] = floored_fit(truth.residual_db, learned.mean(truth), -1.0).rmse_db
    assert error[-1.0] < 0.8 * error[None]


@pytest.mark.parametrize("floor_db", [None, -90.0])
def test_pattern_and_learned_gain_together_are_the_planted_gain(floor_db: float | None) -> None:
    """The gain is added to the mounted pattern, even if the pattern explains only a part of the levels."""

    def pattern(direction: np.ndarray) -> np.ndarray:
        return 6.0 * direction[:, 0] ** 2 + 2.0 * direction[:, 1]

    def flown(flight: str, seed: int) -> LinkSamples:
        s = observed(flight, seed=seed).samples
        floor = None if floor_db is None else np.full(len(s), floor_db)
        level = s.residual_db + pattern(s.at_tower @ rotation_from_yaw_pitch_roll(np.radians(70.0), 0.0, 0.0))
        return dataclasses.replace(s, residual_db=level, floor_db=floor)

    recipe = Recipe(MODEL, {"LW1.USRP1": pattern})
    learned = calibration.learn([flown("a", 1), flown("b", 2)], recipe)
    assert set(learned.mounts) == {"LW1.USRP1"}
    other = flown("c", 3)
    error = other.residual_db - learned.mean(other)
    assert error.std() < 0.8 < 2.0 < other.residual_db.std()
    assert learned.mean_error(other) == pytest.approx(error.mean(), abs=1e-9)


def test_part_and_bins_keep_or_drop_what_belongs_to_samples() -> None:
    o = observed("a")
    samples = dataclasses.replace(o.samples, floor_db=np.arange(200.0))
    flown = dataclasses.replace(o, samples=samples, locked=np.arange(200.0) % 2, sent_dbm=30.0)
    some = flown.part(np.arange(0, 200, 3))
    assert some.samples.floor_db is not None
    assert some.locked is not None
    np.testing.assert_array_equal(some.samples.floor_db, np.arange(0.0, 200.0, 3.0))
    np.testing.assert_array_equal(some.locked, np.arange(0, 200, 3) % 2)
    assert some.sent_dbm == 30.0
    assert flown.samples.binned(4.0).floor_db is None


def leaving(parts: Parts, flights: list[Observed]) -> tuple[calibration.Score, ...]:
    """Scores of a split by parts, each flight predicted from the other."""
    learned: dict[str, calibration.Learned] = {}
    flight_left_out(flights, RECIPE, learned)
    return calibration.parts_left_out(flights, RECIPE, learned, parts)


def planted(o: Observed, part: np.ndarray, fault_db: float) -> Observed:
    """The samples of a part shifted: only whoever learns from them, or fits an offset there, can know."""
    level = o.samples.residual_db + np.where(part, fault_db, 0.0)
    return dataclasses.replace(o, samples=dataclasses.replace(o.samples, residual_db=level))


def circled(flight: str, seed: int) -> Observed:
    """Two heights and all headings along four circles: whole parts can be left out."""
    once = observed(flight, seed=seed)
    o = once.part(np.tile(np.arange(len(once.samples)), 4))
    count = len(o.samples)
    position = o.samples.position_m.copy()
    position[:, 2] = np.where(np.arange(count) % 5 == 0, 40.0, 90.0 + np.arange(count))
    heading = np.degrees(np.arctan2(o.samples.at_tower[:, 0], o.samples.at_tower[:, 1])) % 360.0
    samples = dataclasses.replace(o.samples, position_m=position)
    return Observed(samples, o.free_space_db + np.linspace(0.0, 6.0, count), heading)


def test_an_antenna_that_no_other_flight_has_is_not_scored() -> None:
    """Nor is a flight without others."""
    flights = [circled("a", 1), circled("b", 2)]
    alone = dataclasses.replace(flights[0], samples=dataclasses.replace(flights[0].samples, channel="USRP2"))
    split = calibration.heading_parts
    assert [(s.flight, s.channel) for s in leaving(split, [*flights, alone])] == [("a", "USRP1"), ("b", "USRP1")]
    learned = {"a": calibration.learn([flights[1].samples], RECIPE)}
    assert calibration.parts_left_out(flights[:1], RECIPE, learned, split) == ()


@pytest.mark.parametrize("split", ["altitude", "heading", "sector"])
def test_nothing_of_a_part_left_out_is_learned_or_fitted(split: str) -> None:
    """A fault of 20 dB planted into one part of every flight: whoever learned or fitted any of it would know."""
    every = getattr(calibration, f"{split}_parts")

    def first(scored: Observed, other: Observed) -> list[tuple[np.ndarray, np.ndarray]]:
        return every(scored, other)[:1]

    flights = [circled("a", 1), circled("b", 2)]
    unseen = [~first(flights[0], o)[0][1] for o in flights]
    assert all(50 <= mask.sum() < 400 for mask in unseen)
    faulty = [planted(o, mask, 20.0) for o, mask in zip(flights, unseen, strict=True)]
    scores = [{s.flight: s for s in leaving(first, some)} for some in (flights, faulty)]
    before, after = (some["a"] for some in scores)
    assert before.n == after.n >= 50
    assert after.offset_db - before.offset_db == pytest.approx(20.0, abs=1e-6)
    for name in ("rmse_db", "free_space_rmse_db", "constant_rmse_db", "log_distance_rmse_db"):
        assert getattr(after, name) == pytest.approx(getattr(before, name), abs=1e-6)


@pytest.mark.parametrize("split", ["sector", "heading"])
def test_baselines_of_a_part_take_their_offset_from_outside_it_too(split: str) -> None:
    """Like for like: by hand, free space with the mean of the samples outside each part."""
    flights = [circled("a", 1), circled("b", 2)]
    scores = leaving(getattr(calibration, f"{split}_parts"), flights)
    assert [s.flight for s in scores] == ["a", "b"]
    for o, score in zip(flights, scores, strict=True):
        error = np.full(len(o.samples), np.nan)
        constant = error.copy()
        for inside, outside in getattr(calibration, f"{split}_parts")(o, o):
            level = o.samples.residual_db + o.free_space_db
            error[inside] = o.samples.residual_db[inside] - o.samples.residual_db[outside].mean()
            constant[inside] = level[inside] - level[outside].mean()
        assert np.isfinite(error).all()
        assert score.free_space_rmse_db == pytest.approx(error.std(), abs=1e-9)
        assert score.constant_rmse_db == pytest.approx(constant.std(), abs=1e-9)
        assert score.free_space_rmse_db > o.samples.residual_db.std()  # the flight's own offset flatters


def test_a_line_over_distance_is_the_one_that_least_squares_finds_outside() -> None:
    """Slope and level come from the outside samples only.

    The reference of free space does not matter, and the slope is limited to 0 to ``STEEPEST``.
    """
    rng = np.random.default_rng(12)
    base = observed("a", seed=4)
    outside = np.arange(len(base.samples)) < 120
    free = rng.uniform(-80.0, -60.0, len(outside))
    for true_slope, expected in ((1.4, 1.4), (-2.0, 0.0), (9.0, 3.0)):
        measured = 7.0 + true_slope * free
        for shift_db in (0.0, 100.0):
            samples = dataclasses.replace(base.samples, residual_db=measured - free - shift_db)
            shown = dataclasses.replace(base, samples=samples, free_space_db=free + shift_db)
            simple = calibration.Simple(*np.full((3, len(free)), np.nan))
            simple.predict(shown, ~outside, outside)
            level = measured[outside].mean()
            line = level + expected * (free[~outside] - free[outside].mean())
            assert simple.line_db[~outside] == pytest.approx(line)
            assert simple.constant_db[~outside] == pytest.approx(level)
            assert simple.free_db[~outside] + shown.free_space_db[~outside] == pytest.approx(
                free[~outside] + (measured - free)[outside].mean()
            )
            assert np.isnan(simple.line_db[outside]).all()


def test_controls_turn_the_uav_as_an_aircraft_of_the_opposite_heading_or_none_sees_the_tower() -> None:
    heading = np.radians(np.random.default_rng(1).uniform(-180.0, 180.0, 200))

    def seen(turn: np.ndarray, world: np.ndarray) -> np.ndarray:
        c, s, z = np.cos(turn), np.sin(turn), np.zeros(len(turn))
        back = np.stack([np.stack([c, s, z], -1), np.stack([-s, c, z], -1), np.stack([z, z, z + 1.0], -1)], axis=1)
        return np.einsum("nij,nj->ni", back, world)

    plain = observed("a")
    world = -plain.samples.at_tower
    flown = calibration._with_uav(plain, seen(heading, world))
    (wrong,), (none,) = calibration.wrong_way([flown]), calibration.world_frame([flown])
    np.testing.assert_allclose(wrong.samples.at_uav, seen(-heading, world), atol=1e-12)
    np.testing.assert_allclose(none.samples.at_uav, world, atol=1e-12)
    assert np.array_equal(wrong.samples.at_tower, plain.samples.at_tower)


def test_a_score_is_that_by_hand_and_wants_fifty_samples() -> None:
    o, rng = circled("a", 1), np.random.default_rng(6)
    gain = 3.0 * o.samples.at_tower[:, 0] + rng.normal(size=len(o.samples))
    gain[:7], o.samples.residual_db[9] = np.nan, np.nan
    score, good = calibration.score(o, gain), np.isfinite(gain) & np.isfinite(o.samples.residual_db)
    assert score is not None
    left, measured = (o.samples.residual_db - gain)[good], (o.samples.residual_db + o.free_space_db)[good]
    line = log_distance_level_db(measured, 10.0 ** (-o.free_space_db[good] / 20.0), o.samples.position_m[good])
    time = o.samples.time_s[good]
    slow = local_mean_db(time, measured, 4.0) - local_mean_db(time, (gain + o.free_space_db)[good], 4.0)
    expected = {
        "rmse_db": left.std(), "offset_db": left.mean(), "free_space_rmse_db": o.samples.residual_db[good].std(),
        "constant_rmse_db": measured.std(), "log_distance_rmse_db": (measured - line).std(), "rmse_4s_db": slow.std(),
    }  # fmt: skip
    for name, value in expected.items():
        assert getattr(score, name) == pytest.approx(value), name
    assert score.n == good.sum()
    few = np.where(np.cumsum(good) <= 50, gain, np.nan)
    assert calibration.score(o, few) is not None
    assert calibration.score(o, np.where(np.cumsum(good) <= 49, gain, np.nan)) is None


def test_parts_of_a_circle_and_of_the_heights_are_those_by_hand() -> None:
    """Check six sectors of 60 degrees and eight headings of 45 degrees with a guard of 10 degrees.

    Heights within five metres of the most frequent height belong together.
    """
    scored, second = circled("a", 1), circled("b", 2)
    for parts, count, angle in (
        (
            calibration.sector_parts,
            6,
            lambda o: np.degrees(np.arctan2(o.samples.at_tower[:, 1], o.samples.at_tower[:, 0])),
        ),
        (calibration.heading_parts, 8, lambda o: o.heading_deg),
    ):
        masks = parts(scored, second)
        assert len(masks) == count
        for k, (inside, outside) in enumerate(masks):
            first, last = 360.0 / count * k, 360.0 / count * (k + 1)
            assert inside.tolist() == [first <= a % 360.0 <= last for a in angle(scored)]
            away = [min((a - last) % 360.0, (first - a) % 360.0) for a in angle(second)]
            between = [(a - first) % 360.0 <= last - first for a in angle(second)]
            assert outside.tolist() == [
                not near_part and far > 10.0 for near_part, far in zip(between, away, strict=True)
            ]
    for height, near in ((40.0, True), (44.9, True), (45.0, False), (35.0, False), (35.1, True)):
        position_m = second.samples.position_m.copy()
        position_m[:, 2] = height
        shifted = dataclasses.replace(second, samples=dataclasses.replace(second.samples, position_m=position_m))
        ((inside, outside),) = calibration.altitude_parts(scored, shifted)
        assert inside.tolist() == (scored.samples.position_m[:, 2] == 40.0).tolist()
        assert (~outside).all() == near
        assert outside.any() != near


def test_below_its_floor_a_receiver_has_what_the_fit_says_and_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    """Levels 3 dB above the gain, and a floor of -5 dB with a pattern of 2 dB, computed by hand."""
    gain, pattern_db = np.linspace(-20.0, 20.0, 200), np.full(200, 2.0)
    level_db = gain + 3.0 + pattern_db
    base = observed("a").samples
    samples = dataclasses.replace(
        base, residual_db=np.where(level_db < -5.0, -21.0, level_db), floor_db=np.full(200, -5.0)
    )
    monkeypatch.setattr(calibration, "_mean_along", lambda *_: gain)
    fit = calibration.learn([observed("a").samples, observed("b").samples], RECIPE).fit
    assert fit is not None
    residual_db = calibration._at_floor(samples, pattern_db, fit).residual_db
    np.testing.assert_allclose(
        residual_db, np.where(level_db < -5.0, np.minimum(gain + 3.0, -7.0), gain + 3.0), atol=1e-9
    )
    plain = calibration._at_floor(dataclasses.replace(samples, floor_db=None), pattern_db, fit).residual_db
    np.testing.assert_allclose(plain, samples.residual_db - 2.0)


def test_an_offset_of_others_adds_to_the_error_and_stated_spreads_are_asked() -> None:
    o = observed("a", offset_db=5.0, seed=1)
    learned = calibration.learn([observed("b", seed=2).samples, observed("c", seed=3).samples], RECIPE)
    offsets = calibration._offsets([observed(name, seed=k).samples for k, name in enumerate("bc", 2)], learned)
    (score,) = calibration.score_with(learned, [o], [observed("b", seed=2), observed("c", seed=3)])
    own_offset = learned.mean_error(o.samples)
    assert score.offset_db == pytest.approx(own_offset)
    assert score.rmse_shared_offset_db == pytest.approx(np.hypot(score.rmse_db, own_offset - offsets["LW1.USRP1"]))
    stated = StatedSpread(gain_sd_db=learned.predict(o.samples)[1], spread=learned.spread("LW1.USRP1"))
    error = o.samples.residual_db - learned.mean(o.samples) - own_offset
    assert {name: getattr(score, name) for name in ("inside_50", "inside_90", "inside_95")} == inside_shares(
        error, stated
    )
    fading = fading_of([s.samples for s in (observed("b", seed=2), observed("c", seed=3))], 4.0)
    spread = learned.spread("LW1.USRP1")
    assert (spread.fading_sd_db, spread.fading_kurtosis, spread.bin_s) == pytest.approx((*fading, 4.0))
    assert learned.spread("LW9.X").fading_sd_db == 0.0
