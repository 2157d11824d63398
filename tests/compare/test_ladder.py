"""Model comparison on simulated truths."""

import dataclasses

import numpy as np
import pytest

from aerpaw_cmp.compare.ladder import (
    CandidateModel,
    compare_models,
    held_out_error_db,
    held_out_lines,
    log_distance_level_db,
    model_rows,
    places_of,
)


def ladder_rows(ladder, names):
    """The rows of every series."""
    return model_rows(ladder, names)[1]


def wave(n, seed, sd=1.0):
    """Return noise with a correlation time of about 10 samples."""
    white = np.random.default_rng(seed).normal(size=n + 50)
    kernel = np.exp(-np.arange(50) / 10.0)
    return sd * np.convolve(white, kernel / np.sqrt((kernel**2).sum()), "valid")[:n]


def along(count):
    """Return positions along a line, so that areas of the plan are segments in time."""
    return np.column_stack([np.arange(float(count)), np.zeros((count, 2))])


def planted(n=2000):
    truth = wave(n, 1, 6.0) - 80.0
    measured = truth + 12.0 + wave(n, 2, 2.0)
    return truth, measured


def candidate(name, level):
    return CandidateModel(model=name, level_db=(level,), seconds=1.0)


def test_truth_is_best_and_recommended_over_what_adds_nothing():
    truth, measured = planted()
    flat = np.full(len(truth), -80.0)
    useless = truth + wave(len(truth), 8, 0.3)
    ladder = compare_models([measured], [np.arange(2000.0)], [candidate("flat", flat), candidate("truth", truth), candidate("more", useless)],
                   [along(2000)])  # fmt: skip
    assert ladder.candidates[ladder.recommended].model == "truth"
    assert ladder.rmse_db[1] == pytest.approx(2.0, abs=0.3)
    rows = ladder_rows(ladder, [("LW1", "A")])
    assert [r.recommended for r in rows] == [False, True, False]
    low, high = rows[0].difference_to_best_ci95_db
    assert 0.0 < low < rows[0].difference_to_best_db < high


def test_a_worse_model_is_never_recommended_for_being_simple():
    truth, measured = planted()
    worse = truth + wave(len(truth), 5, 3.0)
    ladder = compare_models(
        [measured], [np.arange(2000.0)], [candidate("worse", worse), candidate("truth", truth)], [along(2000)]
    )
    assert ladder.recommended == ladder.best == 1


def test_offset_of_a_stretch_comes_from_the_others_only():
    measured, level = np.arange(80.0), np.zeros(80)
    keep, place = np.ones(80, dtype=bool), np.repeat(np.arange(8), 10)
    error = held_out_error_db(measured, level, keep, place)
    changed = measured.copy()
    changed[:10] += 100.0  # the first stretch
    again = held_out_error_db(changed, level, keep, place)
    np.testing.assert_allclose(again[:10] - error[:10], 100.0)
    assert places_of(along(80)).tolist() == place.tolist()
    assert held_out_error_db(measured, level + 33.0, keep, place) == pytest.approx(error)


def test_models_are_scored_on_the_samples_that_all_have():
    truth, measured = planted()
    holes = truth.copy()
    holes[100:200] = np.nan
    deaf = np.full(len(truth), np.nan)
    deaf[:50] = -80.0
    ladder = compare_models([measured], [np.arange(2000.0)], [candidate("truth", truth), candidate("holes", holes), candidate("deaf", deaf)],
                   [along(2000)])  # fmt: skip
    rows = ladder_rows(ladder, [("LW1", "A")])
    assert [r.n for r in rows] == [1900, 1900, 0]  # a model without levels does not take the samples of the others
    assert not np.isfinite(rows[2].rmse_heldout_db)
    assert ladder.best == 0


def test_two_channels_share_one_recommendation():
    truth, measured = planted()
    levels = {"flat": np.full(len(truth), -80.0), "truth": truth}
    candidates = [CandidateModel(model=name, level_db=(level, level), seconds=1.0) for name, level in levels.items()]
    ladder = compare_models([measured, measured - 20.0], [np.arange(2000.0)] * 2, candidates, [along(2000)] * 2)
    rows = ladder_rows(ladder, [("LW1", "A"), ("LW1", "B")])
    assert [(r.channel, r.model) for r in rows if r.recommended] == [("A", "truth"), ("B", "truth")]


@pytest.mark.parametrize(("samples", "scored"), [(4, False), (19, False), (20, True)])
def test_a_few_samples_score_and_recommend_no_model(samples, scored):
    """Four samples had rows of 37.7 dB and a recommendation."""
    truth, measured = (values[:: 2000 // samples][:samples] for values in planted())
    models = [candidate("flat", np.full(samples, -80.0)), candidate("truth", truth)]
    ladder = compare_models([measured], [np.arange(float(samples))], models, [along(samples)])
    assert (ladder.recommended is not None) == scored
    assert bool(model_rows(ladder)[0]) == scored


def test_nothing_measured_recommends_nothing():
    ladder = compare_models([np.full(10, np.nan)], [np.arange(10.0)], [candidate("flat", np.zeros(10))], [along(10)])
    assert ladder.recommended is None
    assert ladder_rows(ladder, [("LW1", "A")]) == ()


def test_a_place_that_is_visited_twice_is_left_out_as_a_whole():
    """Out and back along a line with a step in level at the middle: the offset of a place never has seen its level."""
    out = np.linspace(0.0, 800.0, 400)
    position = np.column_stack([np.r_[out, out[::-1]], np.zeros((800, 2))])
    place = places_of(position)
    np.testing.assert_array_equal(np.bincount(place), np.full(8, 100))
    np.testing.assert_array_equal(place[:400], place[400:][::-1])
    level = np.where((position[:, 0] > 400) & (position[:, 0] <= 500), 8.0, 0.0)  # one place alone
    everywhere = np.ones(800, bool)
    here = held_out_error_db(level, np.zeros(800), everywhere, place)[level > 0]
    assert here == pytest.approx(8.0)
    # in segments of time, the way back predicts the way out
    in_time = np.repeat(np.arange(8), 100)
    assert held_out_error_db(level, np.zeros(800), everywhere, in_time)[level > 0].mean() < 7.5
    ladder = compare_models(
        [level], [np.arange(800.0)], [CandidateModel(model="m", level_db=(np.zeros(800),), seconds=0.0)], [position]
    )
    assert ladder.error_db[0][0][level > 0] == pytest.approx(8.0)
    assert len(places_of(np.zeros((3, 2)))) == 3
    assert len(places_of(np.zeros((0, 2)))) == 0


def test_lines_without_a_block_are_those_of_polyfit() -> None:
    rng = np.random.default_rng(3)
    x, block = rng.normal(size=90) + 25.0, np.repeat(np.arange(3), 30)
    values = 4.0 - 2.0 * x + rng.normal(size=90)
    offset, slope = held_out_lines(values, x, block, 3)
    for b in range(3):
        assert (slope[b], offset[b]) == pytest.approx(np.polyfit(x[block != b], values[block != b], 1), rel=1e-9)
    assert held_out_lines(values, np.ones(90), block, 3)[1] == pytest.approx(0.0)  # one distance: no slope to learn


def test_a_log_distance_line_finds_its_slope_and_is_never_the_recommended_replay() -> None:
    """Levels that fall by 35 dB per decade: free space misses the slope, the line has it, and no replay stands for it."""
    rng = np.random.default_rng(4)
    position = np.column_stack([np.linspace(50.0, 900.0, 800), np.zeros(800), np.full(800, 40.0)])
    range_db = 10.0 * np.log10(np.hypot(position[:, 0], 40.0))
    measured = -20.0 - 3.5 * range_db + rng.normal(0.0, 1.0, 800)
    zeros = np.zeros(800)
    candidates = [
        CandidateModel(model="constant", level_db=(zeros,), seconds=0.0, regressor_db=(zeros,)),
        CandidateModel(model="line", level_db=(zeros,), seconds=0.0, regressor_db=(range_db,)),
        CandidateModel(model="free space", level_db=(-2.0 * range_db,), seconds=0.0),
    ]
    ladder = compare_models([measured], [np.arange(800.0)], candidates, [position])
    constant, line, free = ladder.rmse_db
    assert line == pytest.approx(1.0, abs=0.1)
    assert constant > free > 3.0
    assert (ladder.best, ladder.best_replay, ladder.recommended) == (1, 2, 2)
    level = log_distance_level_db(measured, 10.0 ** (range_db / 10.0), position)
    assert np.std(measured - level) == pytest.approx(1.0, abs=0.1)
    assert np.polyfit(range_db, level, 1)[0] == pytest.approx(-3.5, abs=0.05)


def test_the_slope_of_a_place_does_not_come_from_that_place() -> None:
    """A jump at one place moves the line of the other places, and not its own."""
    position = np.column_stack([np.arange(1.0, 801.0), np.zeros(800), np.zeros(800)])
    measured = -2.0 * 10.0 * np.log10(position[:, 0])
    bent = measured + np.where(position[:, 0] > 700.0, 1.0 * np.arange(800.0) - 700.0, 0.0)
    level = log_distance_level_db(bent, position[:, 0], position)
    last = position[:, 0] > 700.0
    assert np.polyfit(10.0 * np.log10(position[last, 0]), level[last], 1)[0] == pytest.approx(-2.0, abs=1e-6)


def test_a_missing_level_or_place_leaves_the_line_of_the_others() -> None:
    """Samples without a measurement get the line of all samples. Coinciding ends get no value."""
    rng = np.random.default_rng(2)
    distance = rng.uniform(50.0, 900.0, 400)
    position = np.column_stack([distance, rng.uniform(-50.0, 50.0, 400), np.zeros(400)])
    measured = -25.0 * np.log10(distance) + rng.normal(0.0, 1.0, 400)
    measured[::7], distance[3] = np.nan, 0.0
    level = log_distance_level_db(measured, distance, position)
    good = np.isfinite(measured) & (distance > 0.0)
    np.testing.assert_allclose(level[good], log_distance_level_db(measured[good], distance[good], position[good]))
    assert np.isnan(level).tolist() == (distance == 0.0).tolist()
    x = 10.0 * np.log10(distance[~good & (distance > 0.0)])
    assert np.polyfit(x, level[~good & (distance > 0.0)], 1)[0] == pytest.approx(-2.5, abs=0.1)


def test_the_fastest_sufficient_model_is_not_significantly_worse_than_the_best() -> None:
    """The order of the models decides, not their measured seconds, which differ between equal runs."""
    rng = np.random.default_rng(8)
    n = 600
    truth = [rng.normal(0.0, 1.0, n) for _ in "AB"]
    position = [np.column_stack([rng.uniform(0.0, 900.0, (n, 2)), np.full(n, 40.0)]) for _ in "AB"]
    candidates = [
        CandidateModel(model=model, level_db=tuple(each + rng.normal(0.0, sd, n) for each in truth), seconds=seconds)
        for model, sd, seconds in (("worse", 3.0, 0.0), ("first", 1.0, 0.4), ("same", 1.0, 0.3), ("slow", 1.0, 9.0))
    ]
    times = [np.arange(n, dtype=float)] * 2
    ladder = compare_models(truth, times, candidates, position)
    rows = {row.model: row for row in model_rows(ladder)[0]}
    assert [model for model, row in rows.items() if row.fastest_sufficient] == ["first"]
    assert rows["worse"].difference_to_best_ci95_db[0] > 1.0
    both = np.concatenate([ladder.error_db[0][0], ladder.error_db[0][1]])
    assert rows["worse"].rmse_heldout_db == pytest.approx(np.sqrt(np.mean(both**2)))
    assert rows["worse"].n == 2 * n
    assert rows["worse"].difference_to_best_db == pytest.approx(rows["worse"].rmse_heldout_db - min(ladder.rmse_db))
    # without samples there is nothing to compare
    assert model_rows(compare_models([each * np.nan for each in truth], times, candidates, position)) == ((), ())


def test_models_that_cannot_differ_are_one_row() -> None:
    """If several models do not differ, the first is kept, with the models of the flight file and the recommendation."""
    rng, n, nan = np.random.default_rng(5), 200, np.full(200, np.nan)
    unit = rng.choice([-1.0, 1.0], n)
    errors = {
        "ground": (3.0, 4.0), "woods": (3.001, 3.999), "half": (3.0, None), "edges": (3.0, 4.02),
        "opaque": (None, None), "none": (None, None), "relief": (3.0, 4.0), "as set": (3.0, 4.0),
    }  # fmt: skip
    flat = CandidateModel(model="flat", level_db=(unit, unit), seconds=1.0)
    of_two = compare_models([unit] * 2, [np.arange(n)] * 2, [flat, flat], [along(n)] * 2)
    ladder = dataclasses.replace(
        of_two, recommended=list(errors).index("relief"), best=0,
        candidates=tuple(CandidateModel(model=name, level_db=(nan, nan), seconds=1.0) for name in errors),
        error_db=tuple(tuple(nan if x is None else x * unit for x in pair) for pair in errors.values()),
    )  # fmt: skip
    pooled, each = model_rows(ladder, [("LW1", "USRP1"), ("LW1", "USRP2")])
    assert len(each) == 2 * len(pooled)
    for rows in (pooled, each[: len(pooled)], each[len(pooled) :]):
        assert [row.model for row in rows if not row.distinct] == ["woods"]
