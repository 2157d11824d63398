"""campaign.html for a large campaign: its content, what only the files contain, and its size."""

import dataclasses
import re

import numpy as np
import pandas as pd
import pytest

from aerpaw_cmp.compare.statistics import NO_INTERVAL, PassPair
from aerpaw_cmp.compare.verdict import NodeOffset, Step
from aerpaw_cmp.report import campaign as campaign_html
from aerpaw_cmp.report import campaign as campaign_words
from benchmarks import fabricated


@pytest.fixture(scope="module")
def data():
    return fabricated.season(30, 6, 2, 2)


def test_the_page_stays_small_and_tells_what_it_does_not_show(data):
    text = campaign_html.campaign_page(data, ["campaign.csv"])
    assert text.count("<tr") < 1500
    assert f"the {campaign_html.ROWS_SHOWN} rows of largest error of {len(data.rss)}" in text
    assert "campaign.csv" in text
    assert not re.search(r"<(script|link|img)[^>]+(src|href)=\"(?!data:)", text)


def test_the_best_setting_is_named_in_words(data):
    words = " ".join(campaign_words.headline(data))
    assert "setting 02 has the smallest error" in words
    assert words.count("dB;") < 4  # not all settings in one sentence


def test_two_flights_show_no_difference_and_the_words_say_so():
    words = " ".join(campaign_words.headline(fabricated.season(2, 3, 1, 1)))
    assert "Too few flights" in words
    assert "Not significantly worse" not in words


def test_every_date_of_a_step_is_named_with_the_latest_first(data):
    """The terminal spoke of the last date alone: a receiver that lost 2 dB a week ago was not named."""
    nights = tuple(f"2026-06-{day:02}" for day in range(1, 25))
    sizes = {"night": nights, "offset_db": (0.0,) * 24, "sd_db": 0.3, "smallest_db": 1.2}
    old = Step(night="2026-06-13", shown="2026-06-14", step_db=1.9, step_ci95_db=(1.2, 2.6))
    rain = Step(night="2026-06-20", shown="2026-06-20", step_db=-3.0, step_ci95_db=(-4.0, -2.0), back="2026-06-21")
    nodes = (NodeOffset(node="LW3", steps=(old,), **sizes), NodeOffset(node="LW1", steps=(rain,), **sizes))
    words = campaign_words.step_words(dataclasses.replace(data, season=dataclasses.replace(data.season, nodes=nodes)))
    assert words[:-1] == [
        "On 2026-06-20 the offset of LW1 steps by −3.0 dB (95 %: −4.0 to −2.0 dB) and is back on 2026-06-21.",
        "On 2026-06-13 the offset of LW3 steps by +1.9 dB (95 %: +1.2 to +2.6 dB).",
        "No offset steps on 2026-06-24, the last date.",
    ]


def test_hostile_names_stay_text(data):
    bad = '</script><img src=x onerror="alert(1)">'
    row = dataclasses.replace(data.rss[0], flight=bad, setting=bad, tower=bad, channel=bad)
    from aerpaw_cmp.jobs.campaign import with_season

    hostile = with_season(
        dataclasses.replace(data, rss=(row,), flights=(bad,), settings={bad: {bad: bad}}, failures=()),
        {bad: "../a%22b/report.html"},
    )
    text = campaign_html.campaign_page(hostile, [])
    assert "<img" not in text
    assert "</script><img" not in text


def test_charts_of_a_season_are_few_and_show_the_intervals_of_steps(data):
    (chart,) = campaign_html.charts_of(data)
    lines = {mark["name"]: mark for mark in chart.content["marks"]}
    for node in data.season.nodes:
        assert len(lines[node.node]["x"]) == len(node.night)
        for step in node.steps:
            assert np.ptp(lines[f"step of {node.node}"]["y"]) == pytest.approx(np.ptp(step.step_ci95_db))
    assert chart.content["x"]["names"][0] == "2025-03-01 14:00"
    text = campaign_html.campaign_page(data, [])
    assert text.count("data-plot=") == 1
    assert '"name":"residual [dB]"' in text
    alone = dataclasses.replace(data, season=dataclasses.replace(data.season, nodes=(), places_db={}))
    assert "<script" not in campaign_html.campaign_page(alone, [])


def many_pairs(count):
    """Pairs of flights of which number i meets at i places (every third nowhere) and differs by (i * 7919) % 101 dB."""
    nothing = {"share": 0.5, "offset_db": 0.0, "single_db": 1.0, "residual_rmse_db": 1.0, "place_rmse_db": 1.0,
               "place_correlation": 0.5, "cells": 3, "height_difference_m": 0.0}  # fmt: skip
    for i in range(count):
        meets = i % 3 > 0
        yield PassPair(
            tower=f"LW{i % 2 + 1}", channel="USRP1", first=f"flight {i}", second="other", n=i if meets else 0,
            rmse_db=float(i * 7919 % 101) if meets else float("nan"), rmse_ci95_db=(1.0, 2.0) if meets else NO_INTERVAL, **nothing,
        )  # fmt: skip


def test_a_file_has_all_pairs_and_campaign_json_names_it(data, tmp_path):
    season = dataclasses.replace(data, repeats=tuple(many_pairs(30_000)))
    repeatability = campaign_html.campaign_metrics(season)["repeatability"]
    assert set(repeatability) == {"radius_m", "heading_within_deg", "cell_m", "table"}
    assert repeatability["table"] == "pairs.csv"
    campaign_html.write_campaign(season, tmp_path)
    table = pd.read_csv(tmp_path / "pairs.csv")
    assert table["n"].tolist() == [pair.n for pair in season.repeats]
    assert table["rmse_low_db"].notna().sum() == 20_000


def test_the_page_opens_with_a_verdict_against_the_baselines_and_explains_its_means(data):
    """Free space is best in every row: the summary and every row say so, and both means are labelled."""
    first = next(iter(data.settings))
    rows = tuple(
        dataclasses.replace(
            row, rmse_db=7.0, held_out_rmse_db=7.9, baselines={"free_space": 6.0, "constant": 9.0},
            verdicts={"free_space": "worse", "constant": "better"},
        )
        for row in data.rss
    )  # fmt: skip
    shown = dataclasses.replace(data, rss=rows)
    n = sum(row.setting == first for row in rows)
    said, means, stands_out = campaign_words.verdict(shown)
    assert said == (
        "Ray tracing: RMSE 7.0 dB; free space: 6.0 dB. "
        f"Ray tracing is significantly worse on {n} of {n} channels of the flights (95 %)."
    )
    assert "7.0 dB with each flight's own offset, 7.9 dB with the offset of the other flights" in means
    assert "Expect 7.9 dB on a new flight" in means
    assert stands_out.startswith("No flight or link stands out. Largest error: ")
    assert "Next: `aerpaw-cmp report FLIGHT` with " in stands_out
    text = campaign_html.campaign_page(shown, [])
    assert text.index("significantly worse") < text.index("<main>")
    assert "<td>worse than free space; better than constant level</td>" in text


def test_a_flight_with_another_gain_is_named_with_its_interval_and_what_to_do(data):
    """Add 9 dB to all links of one flight of the first setting. The other flights keep their scatter."""
    odd = data.reference_rows[len(data.reference_rows) // 2].flight
    rows = tuple(
        dataclasses.replace(row, difference=dataclasses.replace(row.moments, mean_db=row.moments.mean_db + 9.0))
        if row.flight == odd
        else row
        for row in data.rss
    )
    shown = dataclasses.replace(data, rss=rows)
    cause = campaign_words.cause(shown)
    assert (cause.cause, cause.where) == ("outlying offset", odd)
    assert cause.interval[0] < 9.0 < cause.interval[1]
    assert f"Next: check transmit power, receiver gain and cables of {odd}." in campaign_words.verdict(shown)[2]


def test_a_campaign_of_training_flights_has_a_first_sentence(data):
    """The page of three drafts of dataset 12 began with cautions."""
    first = {"fitted": (campaign_html.LEARNED_HERE,), "rmse_db": np.nan}
    rows = tuple(dataclasses.replace(row, **first) if row.setting == data.reference else row for row in data.rss)
    shown = dataclasses.replace(data, rss=rows)
    (said,) = campaign_words.verdict(shown)
    assert said.startswith(f"“{data.reference}” has no error to report")
    assert "Next: `aerpaw-cmp calibrate FLIGHT FLIGHT` holds out each flight in turn." in said
    cautions = [text for text in campaign_words.warnings(shown) if "learned from this log" in text]
    assert len(cautions) == len({row.flight for row in rows if row.setting == data.reference})
    assert all("(LW1 USRP1, LW1 USRP2, " in text for text in cautions)
