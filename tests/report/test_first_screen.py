"""The verdict of the first screen, and its numbers, against records whose answer is known."""

import dataclasses
import itertools

import numpy as np
import pytest

from aerpaw_cmp.compare.causes import MOST_CAUSE_WORDS
from aerpaw_cmp.compare.ladder import ModelRow
from aerpaw_cmp.compare.level import DetectionScore, FieldAudit, floored_fit
from aerpaw_cmp.compare.receiver import score_forecast
from aerpaw_cmp.compare.result import Cause, FlightVerdict
from aerpaw_cmp.compare.statistics import paired_difference
from aerpaw_cmp.compare.verdict import (
    baseline_errors,
    flight_verdict,
    pooled_db,
    with_corrected_verdicts,
    without_copies,
)
from aerpaw_cmp.report.flight import metrics
from aerpaw_cmp.report.flight_words import (
    AS_SET,
    FEW_SAMPLES,
    NO_CAUSE,
    OFFSETS,
    ONE_PLACE,
    TWO_LEVELS,
    cautions,
    expected_sentence,
    first_sentence,
    headlines,
    models_verdict,
    offset_sentences,
    paragraph,
    pretty,
    ranking_sentence,
    rss_verdict,
)
from benchmarks.fabricated import with_numbers
from tests.report.shown import MOST_WORDS


def test_pooled_error_is_that_of_all_samples_together():
    rng = np.random.default_rng(2)
    long_error, short_error = rng.normal(0, 3, 400), rng.normal(0, 7, 100)
    parts = [np.sqrt((part**2).mean()) for part in (long_error, short_error)]
    together = np.sqrt((np.concatenate([long_error, short_error]) ** 2).mean())
    assert pooled_db(parts, [400, 100]) == pytest.approx(together)


def with_errors(data, rmse_db, baseline_db):
    """The report with these errors in every channel."""
    panels = tuple(
        with_numbers(
            panel,
            rmse_db=rmse_db,
            rmse_without_outliers_db=rmse_db,
            baselines={
                name: dataclasses.replace(b, rmse_db=baseline_db + i)
                for i, (name, b) in enumerate(panel.baselines.items())
            },
        )
        for panel in data.rss
    )
    return dataclasses.replace(data, rss=panels)


def judged_as(data, difference_db, low, high, rmse_db=8.4, baseline_db=7.9):
    """The report whose interval over all channels is this one."""
    best, n = next(iter(data.rss[0].baselines)), len(data.rss)
    pooled = FlightVerdict(against=best, rmse_db=rmse_db, baseline_rmse_db=baseline_db, difference_db=difference_db,
                           ci95_db=(low, high), channels=n)  # fmt: skip
    return dataclasses.replace(with_errors(data, rmse_db, baseline_db), verdict=pooled)


def test_the_first_sentence_follows_from_the_interval_over_all_channels(report_data):
    best, n = pretty(next(iter(report_data.rss[0].baselines))), len(report_data.rss)
    assert n > 2
    lost = judged_as(report_data, 0.5, 0.2, 0.8)
    assert paragraph(lost).startswith(
        f"Ray tracing (RMSE 8.4 dB) is 0.50 dB worse than {best} [0.20, 0.80] over {n} channels (95 %)."
    )
    card = next(card for card in headlines(lost) if card.label == f"Against {best}, same samples")
    assert (card.value, card.interval) == ("+0.50 dB", "95 %: +0.20 to +0.80 dB")
    same = paragraph(judged_as(report_data, 0.5, -0.2, 1.2))
    assert f"The difference [−0.20, +1.20] over {n} channels is not significant (95 %)." in same
    assert "better" not in same
    assert "worse" not in same
    won = paragraph(judged_as(report_data, -4.9, -6.0, -3.9, 3.0))
    assert won.startswith(f"Ray tracing (RMSE 3.0 dB) is 4.90 dB better than {best} [3.90, 6.00] over")
    equal = paragraph(judged_as(report_data, 0.0, -0.001, 0.002))
    assert equal.startswith(
        f"Ray tracing (RMSE 8.4 dB) and {best} differ by less than 0.01 dB over {n} channels (95 %)."
    )
    few = paragraph(judged_as(report_data, 0.5, np.nan, np.nan))
    assert f"{best}: 7.9 dB. The flight is too short to distinguish them." in few
    none = paragraph(dataclasses.replace(lost, verdict=None))
    assert none.startswith("Ray tracing: RMSE 8.4 dB. No baseline could be scored.")


def test_a_bound_is_given_with_its_reason(report_data):
    reason = "the flight is too short: its errors are correlated over 40 s"
    panel = with_numbers(report_data.rss[0], rmse_bound=reason)
    intervals = dataclasses.replace(panel.score.intervals, rmse_db=(5.46, np.inf))
    panel = dataclasses.replace(panel, score=dataclasses.replace(panel.score, intervals=intervals))
    assert f"dB (95 %: at least 5.5 dB; {reason}) after an offset" in rss_verdict(panel)
    data = dataclasses.replace(report_data, rss=(panel,))
    assert headlines(data)[0].interval == "95 %: at least 5.5 dB"
    (tower,) = metrics(data)["rss"].values()
    assert (tower[panel.channel]["rmse_ci95_db"], tower[panel.channel]["rmse_bound"]) == ([5.46, None], reason)


def test_the_verdict_is_against_the_best_baseline_over_the_scored_channels(report_data):
    """A channel that is too short for a sentence takes no part."""
    pooled = flight_verdict(report_data.rss)
    errors = baseline_errors(report_data.rss)
    assert pooled.against == min(errors, key=errors.get)
    total = pooled_db([p.score.rmse_db for p in report_data.rss], [p.score.n for p in report_data.rss])
    assert pooled.difference_db == pytest.approx(total - errors[pooled.against], abs=0.05)  # offsets in steps of 0.1 dB
    short = with_numbers(report_data.rss[0], n=19)
    assert flight_verdict([short, *report_data.rss[1:]]).channels == len(report_data.rss) - 1
    assert flight_verdict([short]) is None


@pytest.mark.parametrize("better", range(4))
@pytest.mark.parametrize("worse", range(4))
@pytest.mark.parametrize("channels", [1, 2, 3])
def test_no_sentence_contradicts_its_numbers(better, worse, channels):
    """Every combination of counts: "better" and "worse" stand only where an interval says so."""
    if better + worse > channels:
        return
    verdicts = ["better"] * better + ["worse"] * worse + ["not significant"] * (channels - better - worse)
    said = first_sentence([(6.0, 9)] * channels, {"constant": 5.0}, [{"constant": verdict} for verdict in verdicts])
    assert ("better" in said) == (better > 0)
    assert ("worse" in said) == (worse > 0)
    assert ("not significant" in said) == (better + worse == 0)
    assert said.count("(95 %)") == 1
    assert (f" of {channels} channels" in said) == (channels > 1)


# As long as any: tests of the causes hold each to these words.
CAUSE = Cause(
    name="made",
    sentence=f"Likely cause at LW1 USRP1:{' long' * 9}; RMSE 2.5 dB with it.",
    next_step="a step that has no more words than nine",
)


def with_cause(data):
    return dataclasses.replace(data, likely_cause=CAUSE, next_step=CAUSE.next_step)


def test_the_cause_of_the_flight_and_its_next_step_are_said_as_they_are(report_data):
    text = paragraph(with_cause(report_data))
    assert f" {CAUSE.sentence} Next: {CAUSE.next_step}." in text
    assert len(f"{CAUSE.sentence} {CAUSE.next_step}".split()) == MOST_CAUSE_WORDS
    numbers = metrics(with_cause(report_data))
    assert (numbers["likely_cause"]["name"], numbers["next_step"]) == ("made", CAUSE.next_step)
    silent = paragraph(dataclasses.replace(report_data, likely_cause=None, next_step=None))
    assert not any(word in silent for word in ("Likely cause at", "Next:"))


LOCK = DetectionScore(
    brier=0.137, constant_brier=0.197, log_score=0.42, constant_log_score=0.59, n=1000, n_detected=700,
    floor_db=-15.0, offset_db=40.0, rmse_db=8.04, free_space_rmse_db=10.3, detected_rmse_db=7.0, reliability=(),
    learned_on="other flights", locks=True,
)  # fmt: skip
DIGEST = ("ab" * 32,)


def every_outcome(data):
    """Reports of many kinds: verdict, expectation, cause, lock, training flight, recommended model, rank alone."""
    verdicts = [(0.5, 0.2, 0.8), (-12.5, -13.25, -11.75), (0.5, -10.25, 11.25), (0.5, np.nan, np.nan), None]
    for difference, known, cause, lock, learned, step in itertools.product(
        verdicts, (False, True), (False, True), (None, LOCK), (0, 1, 3), (None, "`aerpaw-cmp calibrate`")
    ):
        judged = judged_as(data, *difference, 18.4, 17.9) if difference else dataclasses.replace(data, verdict=None)
        if difference:
            judged = dataclasses.replace(judged, verdict=dataclasses.replace(judged.verdict, against="log_distance"))
        panels = []
        for number, panel in enumerate(judged.rss):
            elsewhere = {"rmse_db": 13.5, "floor_rmse_db": 18.2} if known else None
            numbers = {"elsewhere": elsewhere, "detection": lock, "unit": "dB re full scale"}
            changed = with_numbers(panel, **numbers)
            if number < learned:
                changed = with_numbers(changed, trained_on=DIGEST, rmse_db=np.nan)
            panels.append(changed)
        judged = dataclasses.replace(judged, rss=tuple(panels))
        judged = with_cause(judged) if cause else judged
        yield dataclasses.replace(judged, next_step=step) if learned or not cause else judged


def test_the_expected_error_is_that_of_flights_of_one_kind(report_data):
    """For a receiver with a floor, the expected error is that of all held-out flights."""
    kind = "in directions that were not flown"
    for floor, words in (({}, f"3.5 dB {kind}"), ({"floor_rmse_db": 7.7}, "7.7 dB on another flight")):
        panels = [with_numbers(p, elsewhere={"rmse_db": 3.5, "kind": kind, **floor}) for p in report_data.rss]
        assert expected_sentence(panels) == f"Expect {words}."


def test_no_first_paragraph_has_more_than_sixty_words_and_all_have_one_order(report_data):
    order = ("Training flight: ", "Ray tracing", "Expect ", "Likely cause at ", "Next: ")
    paragraphs = {paragraph(data) for data in every_outcome(report_data)}
    assert len(paragraphs) > 60
    for text in paragraphs:
        assert len(text.split()) <= MOST_WORDS == 60, text
        places = [text.find(part) for part in order if part in text]
        assert places == sorted(places), text
        assert places[0] == 0
        assert all(text.count(part) <= 1 for part in order[2:]), text
        assert "Caution" not in text
        assert "nan" not in text
    for part in order:
        assert any(part in text for text in paragraphs), part


def test_a_training_flight_explains_its_dashes(report_data):
    panels = tuple(with_numbers(p, trained_on=DIGEST, rmse_db=np.nan) for p in report_data.rss)
    step = "`rss: {span_db: [-50, 70]}`"
    assert paragraph(dataclasses.replace(report_data, rss=panels, next_step=step)).endswith(f" Next: {step}.")
    text = paragraph(dataclasses.replace(report_data, rss=panels))
    assert text.startswith("Training flight: the antennas of 3 channels were learned from this flight's own log")
    assert "the tables show “–” instead of an error. For comparison, " in text
    assert DIGEST[0][:12] in rss_verdict(panels[0])
    ranks = tuple(with_numbers(p, trained_on=DIGEST) for p in report_data.rank)
    assert paragraph(dataclasses.replace(report_data, rank=ranks)) == paragraph(report_data), "the level has an error"
    alone = paragraph(dataclasses.replace(report_data, rss=(), rank=ranks, next_step=step))
    assert alone.startswith("Training flight: the receiver of LW1 was learned from this flight's own log")
    assert alone.endswith(f" instead of an error. Next: {step}.")


@pytest.mark.parametrize(("offset_db", "unit", "said"), [
    (-57.2, "dB re full scale", "Offset −57.2 dB: the log is relative to full scale"),
    (3.1, "dB re full scale", None), (-88.0, "dB", "Offset −88.0 dB: the log is a signal-to-noise ratio"),
    (31.0, "dBm", "Offset +31.0 dB: the transmit power"), (np.nan, "dBm", None),
])  # fmt: skip
def test_a_negative_or_large_offset_is_explained(report_data, offset_db, unit, said):
    panels = [with_numbers(panel, offset_db=offset_db, unit=unit) for panel in report_data.rss]
    sentences = offset_sentences(panels)
    assert len(sentences) == (said is not None)
    assert all(text.startswith(said) for text in sentences)
    assert unit in OFFSETS


def test_page_terminal_and_metrics_have_the_same_words(report_data):
    numbers = metrics(report_data)
    assert numbers["sentence"] == paragraph(report_data)
    assert numbers["warnings"] == cautions(report_data)
    assert len(set(numbers["warnings"])) == len(numbers["warnings"])


def test_samples_in_the_near_field_are_a_caution(report_data):
    panel = report_data.rss[0]
    distance = np.linspace(0.5, 100.0, len(panel.time))
    panel = dataclasses.replace(panel, geometry={**panel.geometry, "distance_m": distance})
    compared = panel.posed & np.isfinite(panel.measured_db)
    near = f"{panel.name}: {int((compared & (distance < 10.0)).sum())} of "
    (said,) = (text for text in cautions(dataclasses.replace(report_data, rss=(panel,))) if "near field" in text)
    assert said.startswith(near)
    assert not any("near field" in text for text in cautions(report_data))


def test_one_wild_sample_that_moves_the_error_is_said(report_data):
    panel = with_numbers(report_data.rss[0], rmse_db=12.5, n_outliers=1, rmse_without_outliers_db=1.8)
    said = cautions(dataclasses.replace(report_data, rss=(panel,)))
    assert f"{panel.name}: RMSE 1.8 dB without 1 outlier." in said
    calm = with_numbers(panel, rmse_db=1.9)
    assert "outlier" not in " ".join(cautions(dataclasses.replace(report_data, rss=(calm,))))


def test_a_single_sample_is_no_result(report_data):
    panels = tuple(with_numbers(panel, n=1, rmse_db=0.01) for panel in report_data.rss)
    data = dataclasses.replace(report_data, rss=panels, rank=())
    first = paragraph(data)
    assert first.startswith("Nothing could be compared")
    assert paragraph(with_cause(data)) == f"{first} {CAUSE.sentence} Next: {CAUSE.next_step}."
    assert "at most 1" in first
    assert "0.01" not in first


def test_an_offset_beyond_the_span_is_no_error_and_its_dead_neighbour_has_no_offset(report_data):
    step = "`rss: {span_db: [-120, 50]}`"
    panels = tuple(with_numbers(panel, at_edge=True, offset_db=-50.0) for panel in report_data.rss)
    data = dataclasses.replace(report_data, rss=panels, rank=(), next_step=step)
    assert paragraph(data) == f"There is no error to report: the best offset is outside its search range. Next: {step}."
    assert offset_sentences(panels) == []
    text = paragraph(with_cause(dataclasses.replace(report_data, rss=(panels[0], *report_data.rss[1:]))))
    assert f" The best offset of {panels[0].name} is outside its search range. Next: " in text
    assert CAUSE.sentence not in text


def test_a_flight_at_one_place_tells_no_models_apart(report_data):
    still = [dataclasses.replace(p, simulated_dbm=0.0 * p.simulated_dbm, baselines={}) for p in report_data.rss]
    for panels, said in ((still, True), (report_data.rss, False)):
        text = paragraph(dataclasses.replace(report_data, rss=tuple(panels), likely_cause=None))
        assert (ONE_PLACE in text) == said


def test_a_good_result_says_nothing_about_causes(report_data):
    """An error of 2 dB, or one below the best baseline, has no cause. Few samples and two levels have a reason."""
    verdict, panel = report_data.verdict, report_data.rss[0]
    few = dataclasses.replace(panel, score=dataclasses.replace(panel.score, n=60))
    two = dataclasses.replace(
        panel, measured_db=np.where(panel.measured_db > np.nanmedian(panel.measured_db), -60.0, -70.0)
    )
    stuck = dataclasses.replace(panel, measured_db=0.0 * panel.measured_db - 60.0)
    for rmse_db, low, high, one, said in (
        (2.0, -0.1, 0.4, panel, ""),
        (0.5, -0.1, 0.4, stuck, TWO_LEVELS),
        (2.0, -0.1, 0.4, two, TWO_LEVELS),
        (7.0, -1.0, -0.2, panel, ""),
        (7.0, -0.1, 0.4, panel, NO_CAUSE),
        (7.0, -0.1, 0.4, few, FEW_SAMPLES.format(n=100)),
        (7.0, -0.1, 0.4, two, TWO_LEVELS),
    ):
        judged = dataclasses.replace(verdict, rmse_db=rmse_db, ci95_db=(low, high))
        text = paragraph(
            dataclasses.replace(report_data, rss=(one,), verdict=judged, likely_cause=None, next_step=None)
        )
        assert [word for word in (NO_CAUSE, FEW_SAMPLES.format(n=100), TWO_LEVELS) if word in text] == [said] * bool(
            said
        )


def test_at_most_four_numbers_each_with_something_beside_it(report_data):
    cards = headlines(report_data)
    assert 2 <= len(cards) <= 4
    assert all(card.value and card.reference for card in cards)


def test_doubts_are_said(report_data):
    engine = report_data.engine
    broken = dataclasses.replace(engine.audit, fields=FieldAudit(failures=("power of a path",)))
    data = dataclasses.replace(report_data, synthetic=False, engine=dataclasses.replace(engine, audit=broken))
    assert cautions(data)[0].startswith("The audit of the field failed")
    assert any(card.value == "1 failed" for card in headlines(data))
    none = dataclasses.replace(report_data, engine=dataclasses.replace(engine, audit=None))
    assert any("was not audited" in text for text in cautions(none))


def test_a_rank_forecast_is_the_headline_where_there_is_one(report_data):
    rng = np.random.default_rng(3)
    measured = rng.integers(1, 5, 200).astype(float)
    score = dataclasses.replace(
        score_forecast(measured, np.full((200, 4), 0.25), measured, np.full(4, 0.25)),
        kappa=0.37, kappa_ci95=(0.17, 0.61), log_score_gain=0.19, agreement=0.71, majority_agreement=0.66,
    )  # fmt: skip
    panel = with_numbers(report_data.rank[0], receiver=score)
    data = dataclasses.replace(report_data, rss=(), rank=(panel,))
    first = paragraph(data)
    assert first.startswith(f"Rank at {panel.tower} by the receiver learned on other flights: kappa 0.37")
    assert "log score 19 % below the constant forecast" in first
    assert "agrees in 71 % of samples; always guessing the most frequent rank agrees in 66 %" in first
    assert len(first.split()) <= MOST_WORDS
    (card,) = [line for line in headlines(data) if line.label.startswith("Rank")]
    assert (card.value, card.interval) == ("kappa 0.37", "95 %: 0.17 to 0.61")
    unscored = with_numbers(panel, receiver=dataclasses.replace(score, kappa=np.nan))
    assert "receiver" not in paragraph(dataclasses.replace(data, rank=(unscored,)))


def test_sentence_and_card_of_a_rank_show_the_same_digits(report_data):
    data = dataclasses.replace(report_data, rss=())
    sentence = paragraph(data)
    assert len(sentence.split()) <= MOST_WORDS
    card = next(headline for headline in headlines(data) if headline.label.startswith("Rank"))
    best = min(data.rank[0].score.simulated.values(), key=lambda at: at.total_variation)
    assert f"shares is {best.total_variation:.2f} (0: equal, 1: disjoint)" in sentence
    assert card.value == f"{best.total_variation:.2f}"
    assert card.interval.startswith("total variation (0 to 1), 95 %: 0.")


@pytest.mark.parametrize("verdicts", [
    {"a": "worse", "b": "worse"}, {"a": "worse", "b": "not significant"}, {"a": "no interval", "b": "no interval"},
    {"a": "no interval", "b": "worse"}, {"a": "not significant"},
])  # fmt: skip
def test_a_ranking_says_worse_only_where_intervals_do(verdicts):
    said = ranking_sentence(verdicts, 3)
    assert ("significantly worse (95 %)." in said) == (set(verdicts.values()) == {"worse"})
    named = [name for name in verdicts if f" {name}" in said.partition(":")[2].replace(",", "")]
    assert named == ([n for n, v in verdicts.items() if v != "worse"] if ":" in said else [])
    assert ("Too few flights" in said) == (set(verdicts.values()) == {"no interval"})


@pytest.mark.parametrize(("fast", "named"), [("log-distance line", False), ("free space", True)])
def test_a_line_is_no_model_that_is_as_good_and_faster(fast, named):
    """A straight line traces no rays, so it is not named as a fast replay."""
    rows = [ModelRow(model=model, seconds=cost, rmse_heldout_db=11.0 + apart, difference_to_best_db=apart,
                     difference_to_best_ci95_db=(-0.5, 3.0), recommended=apart == 0.0, n=100,
                     fastest_sufficient=cost == 0.0, distinct=True)
            for model, cost, apart in ((fast, 0.0, 1.6), (AS_SET, 0.1, 0.0))]  # fmt: skip
    assert ("fastest" in models_verdict(rows)) == named


def test_two_channels_of_the_same_levels_are_told(report_data):
    panel = report_data.rss[0]
    twice = dataclasses.replace(report_data, rss=(panel, dataclasses.replace(panel, channel="copy")))
    said = f"{panel.name} and {panel.tower} copy have the same levels, so they count as one measurement."
    assert said in cautions(twice)
    assert not any("same levels" in text for text in cautions(report_data))
    pooled = flight_verdict(twice.rss)
    assert pooled is not None
    assert (pooled.channels, pooled.ci95_db) == (1, flight_verdict([panel]).ci95_db)
    other = dataclasses.replace(panel, measured_db=panel.measured_db + 1.0, channel="other")
    assert [p.channel for p in without_copies([*twice.rss, other])] == [panel.channel, "other"]


def test_a_dead_channel_takes_no_part_in_the_verdict_of_one_that_lives(report_data):
    panel, rng = report_data.rss[0], np.random.default_rng(8)
    silent = rng.normal(-120.0, 0.2, len(panel.measured_db))
    dead = dataclasses.replace(panel, channel="dead", measured_db=np.where(panel.posed, silent, np.nan))
    both = dataclasses.replace(report_data, rss=(panel, dead))
    assert flight_verdict(both.rss) == flight_verdict([panel])
    said = f"{dead.name} varies by less than 1 dB, so the summary does not include it."
    assert said in cautions(both)
    alone = dataclasses.replace(report_data, rss=(dead,))  # of a flight without any other it is the error
    assert flight_verdict(alone.rss) is not None
    assert said not in cautions(alone)


@pytest.mark.parametrize("shift_db", [0.0, 1.0])
def test_channels_of_the_same_levels_are_corrected_for_once(report_data, shift_db):
    """With the limit 0.02 over all channels, 0.012 passes for one measurement and not for three."""
    panel = report_data.rss[0]
    pair = dataclasses.replace(paired_difference([], []), p_value=0.012, verdict="better")
    further = dataclasses.replace(panel.further, compared_with={"free_space": pair})
    copies = [
        dataclasses.replace(panel, further=further, measured_db=panel.measured_db + k * shift_db) for k in range(3)
    ]
    words = {copy.further.compared_with["free_space"].verdict for copy in with_corrected_verdicts(copies)}
    assert words == {"not significant" if shift_db else "better"}


def test_a_receiver_that_lost_its_lock_has_one_error_that_with_the_floor(report_data):
    """Detected levels differ from ray tracing by 3 dB and from the line by 5 dB.

    Elsewhere, both sides are at the floor.
    """
    panel, rng = report_data.rss[0], np.random.default_rng(7)
    level = np.where(np.isfinite(panel.simulated_dbm), panel.simulated_dbm, -80.0)
    measured = level + rng.normal(0.0, 3.0, len(level))
    floor = float(np.quantile(measured, 0.3))
    line = dataclasses.replace(next(iter(panel.baselines.values())), level_dbm=level + rng.normal(0.0, 5.0, len(level)))
    lost = measured < floor
    panel = with_numbers(
        panel, simulated_dbm=level, measured_db=np.where(lost, np.nan, measured), baselines={"free_space": line},
        detection=dataclasses.replace(LOCK, floor_db=floor), elsewhere={"floor_rmse_db": 8.2, "rmse_db": 7.0},
        posed=np.ones(len(level), dtype=bool), n=int((~lost).sum()),
    )  # fmt: skip
    floored = np.maximum(measured, floor)
    expected = [np.sqrt(np.mean((floored - np.maximum(model - fit.offset_db, floor)) ** 2))
                for model in (level, line.level_dbm) for fit in [floored_fit(floored, model, floor)]]  # fmt: skip
    pooled = flight_verdict([panel])
    assert (pooled.rmse_db, pooled.baseline_rmse_db) == pytest.approx(tuple(expected))
    assert pooled.difference_db == pytest.approx(expected[0] - expected[1])
    data = dataclasses.replace(report_data, rss=(panel,), verdict=pooled)
    text, cards = paragraph(data), headlines(data)
    assert text.startswith(f"Ray tracing (RMSE {expected[0]:.1f} dB, floor −{abs(floor):.0f} dB) is ")
    assert text.count("RMSE") == 1
    assert "Expect 8.2 dB on another flight." in text
    assert "Brier" not in text
    assert cards[0].value == f"{expected[0]:.1f} dB"
    assert any(f"{panel.name} lost its lock in 30 % of the samples" in said for said in cautions(data))
    said = "Brier score of detection forecast from the predicted level is 0.14 (learned on other flights), and 0.20"
    assert said in rss_verdict(panel)
