"""The verdict of the first screen, and its numbers, against records whose answer is known."""

import dataclasses

import numpy as np
import pytest

from aerpaw_cmp.compare.flight_verdict import baseline_errors, flight_verdict, pooled_db
from aerpaw_cmp.compare.judge.causes import Cause
from aerpaw_cmp.compare.level.detection import DetectionScore
from aerpaw_cmp.compare.level.field_difference import FieldAudit
from aerpaw_cmp.compare.level.rss import ErrorSpan
from aerpaw_cmp.compare.ranks.forecast import score_forecast
from aerpaw_cmp.compare.result import ESTIMATED, ClockResult, FlightVerdict
from aerpaw_cmp.report.exports.tables import metrics
from aerpaw_cmp.report.pages.diff import DIFFERENCE
from aerpaw_cmp.report.words.flight import CAUSES, Judged, first_sentence, pretty, ranking_sentence, rss_verdict
from aerpaw_cmp.report.words.flight_verdict import headlines, verdict
from benchmarks.fabricated import with_numbers


def test_pooled_error_is_that_of_all_samples_together():
    rng = np.random.default_rng(2)
    long_error, short_error = rng.normal(0, 3, 400), rng.normal(0, 7, 100)
    parts = [np.sqrt((part**2).mean()) for part in (long_error, short_error)]
    assert pooled_db(parts, [400, 100]) == pytest.approx(
        np.sqrt((np.concatenate([long_error, short_error]) ** 2).mean())
    )


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
    pooled = FlightVerdict(against=best, difference_db=difference_db, ci95_db=(low, high), channels=n)
    return dataclasses.replace(with_errors(data, rmse_db, baseline_db), verdict=pooled)


def test_the_first_sentence_follows_from_the_interval_over_all_channels(report_data):
    best, n = pretty(next(iter(report_data.rss[0].baselines))), len(report_data.rss)
    assert n > 2
    lost = judged_as(report_data, 0.5, 0.2, 0.8)
    assert verdict(lost)[0] == (
        f"Ray tracing (RMSE 8.4 dB) is 0.50 dB worse than {best} [0.20, 0.80] over {n} channels (95 %)."
    )
    card = next(card for card in headlines(lost) if card.label == f"Against {best}, same samples")
    assert (card.value, card.interval) == ("+0.50 dB", "95 %: +0.20 to +0.80 dB")
    same = verdict(judged_as(report_data, 0.5, -0.2, 1.2))[0]
    assert f"The difference of +0.50 dB [−0.20, +1.20] over {n} channels is not significant (95 %)." in same
    assert "better" not in same
    assert "worse" not in same
    won = verdict(judged_as(report_data, -4.9, -6.0, -3.9, 3.0))[0]
    assert won.startswith(f"Ray tracing (RMSE 3.0 dB) is 4.90 dB better than {best} [3.90, 6.00] over")
    few = verdict(judged_as(report_data, 0.5, np.nan, np.nan))[0]
    assert few.endswith(f"{best}: 7.9 dB. Too few samples for an interval of the difference.")
    none = verdict(dataclasses.replace(lost, verdict=None))[0]
    assert none == "Ray tracing: RMSE 8.4 dB. No baseline could be scored."


def test_a_bound_is_given_with_its_reason(report_data):
    reason = "the flight is too short for its memory of 40 s"
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
    facts = Judged(
        ray_db=6.0, channels=channels, name="constant", other_db=5.0, judged=channels, better=better, worse=worse
    )
    said = first_sentence(facts)
    assert ("better" in said) == (better > 0)
    assert ("worse" in said) == (worse > 0)
    assert ("not significant" in said) == (better + worse == 0)
    assert said.count("(95 %)") == 1


def test_a_local_error_is_a_stretch_and_names_the_clock(report_data):
    clock = ClockResult(
        receiver="LW1", radio_minus_telemetry_s=0.1, ci95_s=(-9, 9), verdict="cannot tell", reason="", applied=ESTIMATED
    )
    panel = with_numbers(report_data.rss[0], clock=clock)
    time = panel.time - panel.time[0] + np.datetime64("2025-06-01T14:00:00", "ns")
    spans = [
        ErrorSpan(start_s=0, end_s=s, n=9, mean_db=e, worst_db=e, position_m=(0, 0, 0), cause="a null")
        for s, e in ((1, 20.0), (8, -6.5))
    ]
    data = dataclasses.replace(report_data, rss=(dataclasses.replace(panel, time=time, spans=tuple(spans)),))
    said = verdict(data)[1]
    assert "measured 6.5 dB below predicted" in said
    assert "14:00:00-14:00:08 UTC" in said
    assert "the radio clock could not be confirmed" in said
    assert "Likely cause" not in said  # none was tested and found
    assert "20.0" not in said


@pytest.mark.parametrize(
    ("name", "estimate", "ci95", "where", "said", "action"),
    [
        ("clock", -3.0, (-3.5, -2.5), "", "3.0 s behind the telemetry clock (95 %: −3.5 to −2.5 s)", "lag: apply"),
        ("heading", 40.0, (30.0, 50.0), "", "turned clockwise by 40 (95 %: 30 to 50) degrees", "mount"),
        ("tower", np.nan, (np.nan, np.nan), "LW3", "the log is that of LW3", "node:"),
        ("pattern", np.nan, (np.nan, np.nan), "", "antenna pattern", "calibrate"),
        ("blocked", 12.2, (10.0, 14.4), "30 to 75", "a loss of 12 dB (95 %: 10 to 14 dB) at 30 to 75 degrees", "site"),
        ("floor", -88.4, (-89.0, -88.0), "", "no level below −88", "floor_db: -88"),
        ("gain step", -6.0, (-7.0, -5.0), "90", "steps by −6.0 dB (95 %: −7.0 to −5.0 dB) at 14:01:30 UTC", "gain"),
    ],
)
def test_a_cause_is_said_with_effect_interval_and_action(report_data, name, estimate, ci95, where, said, action):
    first, *others = report_data.rss
    cause = Cause(
        name=name, estimate=estimate, ci95=ci95, where=where, rmse_db=6.0, rmse_with_db=2.5, gain=40.0
    )  # fmt: skip
    time = np.datetime64("2025-06-01T14:00:00") + np.arange(len(first.time)) * np.timedelta64(1, "s")
    panel = with_numbers(first, time=time.astype("datetime64[ns]"), likely_cause=cause)
    text = verdict(dataclasses.replace(report_data, rss=(panel, *others)))[1]
    assert f"Likely cause at {panel.name}: " in text
    assert said in text
    assert "With it the RMSE is 2.5 instead of 6.0 dB" in text
    assert action in text.partition("Next: ")[2]
    assert not any(word in text for word in ("significant", "better", "worse"))
    assert set(CAUSES) == {"clock", "heading", "tower", "pattern", "blocked", "floor", "gain step"}


def test_one_wild_sample_that_moves_the_error_is_said(report_data):
    panel = with_numbers(report_data.rss[0], rmse_db=12.5, n_outliers=1, rmse_without_outliers_db=1.8)
    said = verdict(dataclasses.replace(report_data, rss=(panel,)))[1]
    assert f"1 outlying sample raises at {panel.name} its RMSE from 1.8 to 12.5 dB" in said
    calm = with_numbers(panel, rmse_db=1.9)
    assert "outlying" not in verdict(dataclasses.replace(report_data, rss=(calm,)))[1]


def test_a_single_sample_is_no_result(report_data):
    panels = tuple(with_numbers(panel, n=1, rmse_db=0.01) for panel in report_data.rss)
    first, _ = verdict(dataclasses.replace(report_data, rss=panels, rank=()))
    assert first.startswith("Nothing could be compared")
    assert "at most 1" in first
    assert "0.01" not in first


def test_at_most_four_numbers_each_with_something_beside_it(report_data):
    cards = headlines(report_data)
    assert 2 <= len(cards) <= 4
    assert all(card.value and card.reference for card in cards)


def test_doubts_are_said(report_data):
    engine = report_data.engine
    broken = dataclasses.replace(engine.audit, fields=FieldAudit(failures=("power of a path",)))
    data = dataclasses.replace(report_data, synthetic=False, engine=dataclasses.replace(engine, audit=broken))
    assert "the audit of the field failed 1 times" in verdict(data)[1]
    assert any(card.value == "1 failed" for card in headlines(data))
    none = dataclasses.replace(report_data, engine=dataclasses.replace(engine, audit=None))
    assert "no audit" in verdict(none)[1]


def test_nothing_to_score(report_data):
    panels = tuple(with_numbers(panel, n=0, rmse_db=np.nan) for panel in report_data.rss)
    first, _ = verdict(dataclasses.replace(report_data, rss=panels, rank=()))
    assert first.startswith("Nothing could be compared")


def test_a_rank_forecast_is_the_headline_where_there_is_one(report_data):
    rng = np.random.default_rng(3)
    measured = rng.integers(1, 5, 200).astype(float)
    score = dataclasses.replace(
        score_forecast(measured, np.full((200, 4), 0.25), measured, np.full(4, 0.25)),
        kappa=0.37, kappa_ci95=(0.17, 0.61), log_score_gain=0.19, agreement=0.71, majority_agreement=0.66,
    )  # fmt: skip
    panel = with_numbers(report_data.rank[0], receiver=score)
    data = dataclasses.replace(report_data, rss=(), rank=(panel,))
    first = verdict(data)[0]
    assert first.startswith(f"Rank forecast at {panel.tower} by the receiver learned on other flights: kappa 0.37")
    assert "log score 19 % below the constant forecast" in first
    assert "agrees in 71 % of samples; always guessing the commonest agrees in 66 %" in first
    (card,) = [line for line in headlines(data) if line.label.startswith("Rank")]
    assert (card.value, card.interval) == ("kappa 0.37", "95 %: 0.17 to 0.61")
    unscored = with_numbers(panel, receiver=dataclasses.replace(score, kappa=np.nan))
    assert "Rank forecast" not in verdict(dataclasses.replace(data, rank=(unscored,)))[0]


def test_sentence_and_card_of_a_rank_show_the_same_digits(report_data):
    data = dataclasses.replace(report_data, rss=())
    sentence, *_ = verdict(data)
    card = next(headline for headline in headlines(data) if headline.label.startswith("Rank"))
    best = min(data.rank[0].score.simulated.values(), key=lambda at: at.total_variation)
    shown = f"{100 * best.total_variation:.0f} percentage points"
    assert shown in sentence
    assert card.value == shown


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


@pytest.mark.parametrize("word", ["better", "worse", "not significant", "no interval"])
def test_a_difference_of_reports_says_what_its_interval_does(word):
    said = DIFFERENCE[word].format(difference=0.31, interval="[+0.10, +0.52]")
    assert [w for w in ("better", "worse") if w in said] == ([word] if word in ("better", "worse") else [])
    assert "+0.31 dB" in said


def test_a_receiver_that_lost_its_lock_is_scored_in_two_parts_first(report_data):
    score = DetectionScore(
        brier=0.137, constant_brier=0.197, log_score=0.42, constant_log_score=0.59, n=1000, n_detected=700,
        floor_db=-15.0, offset_db=40.0, rmse_db=8.04, free_space_rmse_db=10.3, detected_rmse_db=7.0, reliability=(),
        learned_on="other flights", locks=True,
    )  # fmt: skip
    elsewhere = {"floor_rmse_db": 8.2, "free_space_floor_rmse_db": 10.4}

    def said(score, elsewhere):
        first = with_numbers(report_data.rss[0], detection=score, elsewhere=elsewhere)
        return verdict(dataclasses.replace(report_data, rss=(first,)))[0]

    text = said(score, elsewhere)
    assert text.startswith(f"{report_data.rss[0].name} lost its lock in 30 % of the samples.")
    assert "RMSE 8.0 dB; free space: 10.3 dB. Expect 8.2 dB on another flight (free space 10.4 dB)." in text
    assert "P(locked), learned on other flights: Brier score 0.14; a constant: 0.20." in text
    here = said(dataclasses.replace(score, learned_on="held-out segments"), None)
    assert "P(locked), learned in other segments of this flight" in here
    assert "Expect" not in here
    assert "lock" not in said(dataclasses.replace(score, locks=False), None)  # a floor is no lock
