"""The choice of a base and its correction: folds, scores and standard deviations a second way, by plain NumPy."""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import pytest
from scipy.stats import norm, t

from aerpaw_cmp.common.errors import InputError
from aerpaw_cmp.common.units import FloatArray
from aerpaw_cmp.compare import calibration
from aerpaw_cmp.compare.calibration import OFF, Base, Channel, by_degree, choose, fixed_base
from aerpaw_cmp.compare.field_gp import PARTS, FieldFit, FieldModel, Rows
from aerpaw_cmp.compare.gains import LinkSamples
from aerpaw_cmp.compare.level import crps_normal


def samples(name: str, residual: FloatArray, place: FloatArray, channel: str = "A") -> LinkSamples:
    """One sample in 4 s, so that bins change nothing."""
    n = len(residual)
    ahead = np.tile([1.0, 0.0, 0.0], (n, 1))
    return LinkSamples(name, "T", channel, 4.0 * np.arange(n) + 0.5, place, ahead, -ahead, residual)


def lawnmower(n: int, height: float = 40.0) -> FloatArray:
    leg, part = np.divmod(np.linspace(0.0, 4.0, n, endpoint=False), 1.0)
    return np.column_stack([np.where(leg % 2 == 0, part, 1 - part) * 280.0, leg * 60.0, np.full(n, height)])


def flight(name: str, seed: int, channel: str = "A", field_db: float = 0.0) -> LinkSamples:
    """Planted: a wave over the places that every flight meets, an offset of the flight, noise of 1 dB."""
    generator, place = np.random.default_rng(seed), lawnmower(80)
    wave = field_db * np.sin(place[:, 0] / 40.0) * np.cos(place[:, 1] / 50.0)
    return samples(name, wave + generator.normal(0, 3) + generator.normal(0.0, 1.0, 80), place, channel)


def gain(series: LinkSamples) -> FloatArray:
    """A base that is wrong by a slope over the east."""
    return np.asarray(0.02 * series.position_m[:, 0])


FEW = {OFF: calibration._STARTS[OFF], "field": FieldModel(place_sd_db=2.5, length_m=50.0, height_m=40.0, turn=math.inf)}


@pytest.fixture(autouse=True)
def few_titles(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two in place of five, whose scales are as given: a fit of the nuisances takes seconds."""
    monkeypatch.setattr(calibration, "_STARTS", FEW)
    monkeypatch.setattr(calibration, "fit_field", lambda *given: given[1])


def test_blocks_spread_by_their_means() -> None:
    place = np.array([[10.0, 10, 5], [290, 290, 5], [310, 10, 5], [-10, 10, 5], [-20, 10, 5]])
    rows = Rows.of(samples("a", np.zeros(5), place), 0)
    channel = Channel(rows=rows, left_db=np.array([1.0, 3.0, 5.0, -2.0, -4.0]), base_sd_db=np.zeros(5))
    assert calibration.between_blocks_db(channel) == pytest.approx(np.std([2.0, 5.0, -3.0], ddof=1))
    single = Channel(rows=rows.part(slice(0, 2)), left_db=channel.left_db[:2], base_sd_db=np.zeros(2))
    assert calibration.between_blocks_db(single) == 0.0


def by_hand(series: Sequence[LinkSamples], base: Base, model: FieldModel) -> tuple[FloatArray, FloatArray]:
    """Errors of every flight from a fit to the others about its own mean, and the standard deviations."""
    errors, sds = [], []
    for name in dict.fromkeys(s.flight for s in series):
        known, asked = [s for s in series if s.flight != name], [s for s in series if s.flight == name]
        predictor = base(known)
        for scored in asked:
            same = [s for s in known if s.antenna == scored.antenna]
            if not same:
                errors.append(np.full(len(scored), np.nan))
                sds.append(np.ones(len(scored)))
                continue
            names = list(dict.fromkeys(s.flight for s in known))
            rows = Rows.joined([Rows.of(s, names.index(s.flight)) for s in same])
            left = np.concatenate([s.residual_db - predictor(s)[0] for s in same])
            mean, sd = FieldFit(model, rows, left).predict(Rows.of(scored, -1), ("place", "drift"))
            level, level_sd = predictor(scored)
            error = scored.residual_db - level - mean
            errors.append(error - error.mean())
            sds.append(np.sqrt(sd**2 + level_sd**2 + model.noise_sd_db**2))
    return np.concatenate(errors), np.concatenate(sds)


def ratio_by_hand(error: FloatArray, sd: FloatArray) -> float:
    """The geometric mean over flights of 80 samples: one that errs twice and one that errs half as stated are as stated."""
    squares = [np.nanmean(part**2) for part in np.split(error / sd, len(error) // 80) if np.isfinite(part).any()]
    return float(np.clip(np.prod(squares) ** (0.5 / len(squares)), 0.8, 1.6))


def unsure(known: Sequence[LinkSamples]) -> object:
    del known
    return lambda series: (gain(series), np.full(len(series), 1.5))


@pytest.mark.parametrize("base", [fixed_base(gain), unsure])
def test_what_is_left_out_is_scored_as_by_hand(base: Base) -> None:
    """Two flights share antenna A, and only the third has B, so no flight can score B."""
    series = [flight("a", 1), flight("b", 2), flight("c", 3, "B")]
    choice = choose(series, {"made": base})
    for title, model in FEW.items():
        assert model is not None
        error, bare = by_hand(series, base, model)
        held_error, stated = choice.held_out["made", title]
        np.testing.assert_allclose(held_error, error, atol=1e-9)
        sd = bare * ratio_by_hand(error, bare)
        np.testing.assert_allclose(stated, sd, rtol=1e-9)
        good = np.isfinite(error)
        assert good.sum() == 160
        assert choice.rmse_db["made", title] == pytest.approx(np.sqrt(np.mean(error[good] ** 2)))
        z = error[good] / sd[good]
        crps = sd[good] * (z * (2 * norm.cdf(z) - 1) + 2 * norm.pdf(z) - 1 / np.sqrt(np.pi))
        assert choice.crps_db["made", title] == pytest.approx(crps.mean())
    error, sd = by_hand(series, base, FEW[choice.title])  # type: ignore[arg-type]
    assert choice.sd_factor == pytest.approx(ratio_by_hand(error, sd))


def test_a_field_is_added_where_one_was_planted_and_the_nearer_base_wins() -> None:
    bases = {"wrong": fixed_base(gain), "none": fixed_base(lambda series: np.zeros(len(series)))}
    plain = choose([flight(name, k) for k, name in enumerate("abc")], bases)
    waves = choose([flight(name, k, field_db=4.0) for k, name in enumerate("abc")], bases)
    assert (plain.base, plain.title, plain.on) == ("none", OFF, False)
    assert (waves.title, waves.on) == ("field", True)
    assert waves.rmse_db["none", "field"] < 0.7 * waves.rmse_db["none", OFF]
    asked = flight("b", 9, field_db=4.0)
    level, sd = waves.predict(asked)
    assert np.corrcoef(level, asked.residual_db)[0, 1] > 0.8
    channel = waves.channels["T.A"]
    assert len(channel.left_db) == 240
    # the offset of a known flight is known; that of a new flight is not, unless samples are about their own mean
    new, own = waves.predict(asked, "b")[1], waves.predict(asked, own_mean=True)[1]
    assert (new < sd).all()
    assert (own < sd).all()
    fit = FieldFit(waves.model, channel.rows, channel.left_db).predict(Rows.of(asked, -1))
    expected = waves.sd_factor * np.sqrt(fit[1] ** 2 + waves.model.noise_sd_db**2)
    np.testing.assert_allclose(sd, expected, rtol=1e-6)
    np.testing.assert_allclose(level, fit[0] + waves.predictor(asked)[0], atol=1e-6)
    with pytest.raises(InputError, match=r"no flight has T\.Z"):
        waves.predict(dataclasses.replace(asked, channel="Z"))


def test_a_field_that_helps_by_chance_stays_off() -> None:
    """Weak waves: the difference by block means of 16 samples, whose interval is that of Student."""
    nothing, lower = fixed_base(lambda series: np.zeros(len(series))), []
    for seed in (0, 1, 3):
        choice = choose([flight(name, seed + k, field_db=1.5) for k, name in enumerate("abc")], {"made": nothing})
        field, bare = (crps_normal(*choice.held_out["made", title]) for title in ("field", OFF))
        means = (field - bare).reshape(-1, 16).mean(axis=1)
        reach = t.ppf(0.975, len(means) - 1) * means.std(ddof=1) / np.sqrt(len(means))
        assert means.mean() + 0.6 * reach < 0.0 if choice.on else means.mean() + 1.6 * reach > 0.0
        lower.append((bool(means.mean() < 0.0), choice.on))
    assert set(lower) == {(True, True), (True, False)}


def test_headings_that_count_alike_add_their_spread() -> None:
    choice = choose([flight(name, k) for k, name in enumerate("ab")], {"made": fixed_base(gain)})
    assert choice.held_out_parts == (("a", 80), ("b", 80))
    here = flight("n", 5)
    turned = dataclasses.replace(
        here, position_m=here.position_m + np.array([100.0, 0.0, 0.0])
    )  # a gain that is 2 dB higher
    level, sd = choice.over_headings([here, turned])
    here_db, here_sd = choice.predict(here)
    np.testing.assert_allclose(level, here_db + 1.0, atol=1e-9)
    np.testing.assert_allclose((sd / choice.sd_factor) ** 2, (here_sd / choice.sd_factor) ** 2 + 1.0, rtol=1e-9)


def test_nothing_to_learn_from_is_one_message() -> None:
    with pytest.raises(InputError, match="no sample has a level and a pose"):
        choose([samples("a", np.full(9, np.nan), np.zeros((9, 3)))], {"made": fixed_base(gain)})


def test_a_single_flight_is_scored_block_by_block_with_its_own_offset() -> None:
    place = np.random.default_rng(1).uniform([0, 0, 30], [580, 280, 50], (120, 3))
    alone = samples("a", np.random.default_rng(2).normal(5.0, 2.0, 120), place)
    choice = choose([alone], {"made": fixed_base(gain)})
    west = place[:, 0] < 300.0
    fuller = west if west.sum() >= 60 else ~west
    for title, model in FEW.items():
        assert model is not None
        errors = []
        for inside in (fuller, ~fuller):
            rows, left = Rows.of(alone, 0), alone.residual_db - gain(alone)
            mean, sd = FieldFit(model, rows.part(~inside), left[~inside]).predict(rows.part(inside), PARTS)
            errors.append((left[inside] - mean, np.hypot(sd, model.noise_sd_db)))
        error, sd = (np.concatenate(parts) for parts in zip(*errors, strict=True))
        np.testing.assert_allclose(choice.held_out["made", title][0], error, atol=1e-9)
        np.testing.assert_allclose(choice.held_out["made", title][1], choice.sd_factor * sd, rtol=1e-9)


def test_a_flight_inside_one_block_is_scored_in_smaller_ones() -> None:
    place = np.random.default_rng(1).uniform([10, 10, 30], [90, 90, 50], (120, 3))
    alone = samples("a", np.random.default_rng(2).normal(5.0, 2.0, 120), place)
    choice = choose([alone], {"made": fixed_base(gain)})
    assert np.isfinite(choice.held_out["made", choice.title][0]).sum() == 120
    with pytest.raises(InputError, match="all samples are at one position"):
        choose([samples("a", np.ones(120), np.full((120, 3), 40.0))], {"made": fixed_base(gain)})


def test_of_many_flights_three_groups_of_six_are_scored_and_scales_are_learned_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    fits: list[int] = []
    monkeypatch.setattr(calibration, "fit_field", lambda *given: fits.append(1) or given[1])
    for count, scored, learned in ((6, 6, 7), (7, 4, 2), (12, 6, 2)):
        fits.clear()
        choice = choose([flight(str(k), k) for k in range(count)], {"made": fixed_base(gain)})
        assert len(choice.held_out["made", OFF][0]) == 80 * scored
        assert sum(fits) == (learned - 1) * len(FEW) + 1


def test_gains_of_many_directions_are_asked_once_a_degree() -> None:
    calls: list[int] = []

    def predictor(series: LinkSamples) -> tuple[FloatArray, FloatArray]:
        calls.append(len(series))
        return 5.0 * series.at_uav[:, 1] + 7.0 * series.at_tower[:, 2] + len(series.channel), 2.0 + series.at_tower[
            :, 0
        ]

    generator = np.random.default_rng(4)
    ray = generator.normal(size=(40, 3)).repeat(126, axis=0) + 1e-4 * generator.normal(size=(5040, 3))
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    other = np.roll(ray, 126, axis=0)
    many = dataclasses.replace(
        samples("a", np.zeros(5040), np.zeros((5040, 3))), at_uav=ray, at_tower=other
    )  # forty pairs of directions, by a hair
    coarse, (level, sd) = by_degree(predictor), predictor(many)
    for again in range(2):
        calls.clear()
        level_by_degree, sd_by_degree = coarse(many)
        np.testing.assert_allclose(level_by_degree, level, atol=0.25)
        np.testing.assert_allclose(sd_by_degree, sd, atol=0.05)
        assert sum(calls) <= (700, 0)[again]  # a direction on the border of a degree counts as up to four
    longer = dataclasses.replace(many, channel="AAA")
    np.testing.assert_allclose(coarse(longer)[0], level + 2.0, atol=0.25)
    turned = dataclasses.replace(many, at_uav=np.roll(ray, 252, axis=0))
    np.testing.assert_allclose(coarse(turned)[0], predictor(turned)[0], atol=0.25)
    few = many.part(np.arange(5000))
    np.testing.assert_array_equal(coarse(few), predictor(few))
    azimuth = generator.uniform(-np.pi, np.pi, 5040)
    around = np.column_stack([np.cos(azimuth), np.sin(azimuth), np.full(5040, 0.2)]) / np.hypot(1.0, 0.2)
    every = dataclasses.replace(many, at_uav=-around, at_tower=around)  # half a degree at most from what is asked
    np.testing.assert_allclose(coarse(every)[0], predictor(every)[0], atol=0.2)
