import base64
import dataclasses
import hashlib
import json
import re
from html import unescape
from html.parser import HTMLParser

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aerpaw_cmp.compare.rank import CommonestRank, RankRepeat
from aerpaw_cmp.compare.result import ESTIMATED, ClockResult, EngineResult
from aerpaw_cmp.compare.statistics import paired_difference
from aerpaw_cmp.logs.records import RejectedLine
from aerpaw_cmp.report import flight as html
from aerpaw_cmp.report import flight_data as build
from aerpaw_cmp.report import flight_words as words
from aerpaw_cmp.report.flight_data import InputFile, ReportData
from benchmarks.fabricated import with_numbers

VOID = {"meta", "img", "br", "link", "input", "hr"}
HOSTILE = "<script>alert(1)</script><img src=x onerror=alert(2)>\"'&{{ 7*7 }}"


class Page(HTMLParser):
    """Checks the nesting and gathers what a browser would load, and the text."""

    def __init__(self) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.loads: list[str] = []
        self.links: list[str] = []
        self.ids: list[str] = []
        self.tags: list[str] = []
        self.alts: list[str] = []
        self.text = ""
        self.scripts: list[str] = []

    def handle_starttag(self, tag, attrs):
        values = dict(attrs)
        self.tags.append(tag)
        if tag not in VOID:
            self.open.append(tag)
        self.ids += [values["id"]] if "id" in values else []
        self.loads += [values[k] for k in ("src", "srcset", "data", "poster") if k in values]
        if tag == "link":
            self.loads.append(values.get("href", ""))
        if tag == "a":
            self.links.append(values["href"])
        if tag == "img":
            self.alts.append(values.get("alt", ""))
        assert not any(k.startswith("on") for k in values), f"event handler in <{tag}>"

    def handle_endtag(self, tag):
        assert self.open[-1:] == [tag], f"</{tag}> closes {self.open[-3:]}"
        self.open.pop()

    def handle_data(self, data):
        if self.open[-1:] == ["script"]:
            self.scripts.append(data)
        elif self.open[-1:] != ["style"]:
            self.text += data


def parse(text: str) -> Page:
    page = Page()
    page.feed(text)
    page.close()
    assert page.open == []
    return page


def render(data: ReportData) -> Page:
    return parse(html.page(data, ["metrics.json"]))


def test_well_formed_and_loads_nothing_from_elsewhere(report_data):
    text = html.page(report_data, ["metrics.json"])
    page = parse(text)
    assert text.lstrip().startswith("<!DOCTYPE html>")
    assert page.loads == []
    assert not {"iframe", "object", "embed", "form"} & set(page.tags)
    assert not re.search(r'@import|url\((?!"data:|#)', text)
    # the data block, which no browser runs, and the one script that the policy names by its digest
    assert page.tags.count("script") == len(page.scripts) == 2
    digest = base64.b64encode(hashlib.sha256(page.scripts[1].encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}'" in unescape(text)
    assert not re.search(
        r"fetch\(|XMLHttpRequest|WebSocket|import\(|https?://(?!github.com/leeoniya|www.w3.org/2000/svg)",
        page.scripts[1],
    )
    assert "default-src 'none'" in unescape(text)
    assert len(page.ids) == len(set(page.ids))
    assert all(link[0] == "#" and link[1:] in page.ids for link in page.links)
    assert all(page.alts)
    assert page.tags.count("table") == page.tags.count("caption")


def test_first_screen_says_what_and_how_well(report_data):
    text = render(report_data).text
    head = text[: text.index("Received signal strength")]
    panel = report_data.rss[0]
    errors = (panel.score.rmse_db, *(panel.baselines[name].rmse_db for name in ("free_space", "two_ray")))
    for piece in (f"{panel.score.offset_db:.1f}", *(f"{error:.1f}" for error in errors), "synthetic"):
        assert piece in head


def test_not_called_synthetic_when_it_is_not(report_data):
    text = render(dataclasses.replace(report_data, synthetic=False, rss=(), rank=())).text
    assert "synthetic" not in text


def hostile_report(data: ReportData, text: str) -> ReportData:
    site = dataclasses.replace(data.site, name=text, notes=(text,))
    clock = ClockResult(
        receiver=text, radio_minus_telemetry_s=0.0, ci95_s=(0, 0), verdict=text, reason=text, applied=ESTIMATED
    )
    panel = with_numbers(
        data.rss[0], tower=text, channel=text, unit=text, clock=clock, fitted_on_scored=(text,),
    )  # fmt: skip
    bad_input = InputFile(
        path=text, sha256=text, reader=text, lines=1, accepted=0, rejected=1, blank=0, role=text, warnings=(text,),
        rejected_lines=(RejectedLine(1, text, text),),
    )  # fmt: skip
    engine = dataclasses.replace(data.engine, engine=text, left_out=(text,), settings={text: text})
    return dataclasses.replace(
        data, title=text, flight=text, site=site, generated=text, versions={text: text}, inputs=(bad_input,),
        rss=(panel,), rank=(dataclasses.replace(data.rank[0], tower=text),), engine=engine, warnings=(text,),
        notes=(text,), settings={text: {text: [text]}}, stages_s={text: 1.0},
    )  # fmt: skip


def test_hostile_text_is_only_text(report_data):
    page = render(hostile_report(report_data, HOSTILE))
    assert len(page.scripts) == 2
    assert HOSTILE not in page.scripts[0]
    assert json.loads(page.scripts[0])["rss"][0]["tower"] == HOSTILE
    assert "alert" not in page.scripts[1]
    assert page.tags.count("img") == len(page.alts) == len(page.loads)
    assert HOSTILE in page.text


@settings(max_examples=8, deadline=None)
@given(text=st.text(min_size=1, max_size=90))
def test_any_text_keeps_the_page_well_formed(report_data, text):
    page = render(hostile_report(report_data, text))
    assert all(load.startswith("data:") for load in page.loads)


@pytest.mark.parametrize(
    "missing", ["track", "waypoints", "rss", "rank", "pairs", "engine", "inputs", "settings", "versions", "stages_s"]
)
def test_a_part_may_be_missing(report_data, missing):
    empty = {"track": None, "engine": None, "settings": {}, "versions": {}, "stages_s": {}}.get(missing, ())
    render(dataclasses.replace(report_data, **{missing: empty}))


def test_all_parts_missing(report_data):
    page = render(ReportData(title="t", flight="f", site=report_data.site, generated="now"))
    assert "Nothing could be compared" in page.text


def test_panels_are_said_in_their_own_section(report_data):
    text = html.page(report_data, [])
    for panel in report_data.rss:
        section = text[text.index(f"<h3>{panel.name}</h3>") :]
        assert words.rss_verdict(panel) in section[: section.index("</p>")]
    assert text.count(words.rss_verdict(report_data.rss[0])) == 1


class TestWords:
    def test_the_words_follow_from_the_paired_interval(self, report_data):
        panel = report_data.rss[0]
        best = min(panel.baselines, key=lambda name: panel.baselines[name].rmse_db)

        def said(error_db, other_db):
            paired = paired_difference(error_db, other_db, free_offset=False)
            return words.rss_verdict(with_numbers(panel, compared_with={best: paired}))

        rng = np.random.default_rng(1)
        small, large = rng.normal(0, 3.0, 500), rng.normal(0, 4.0, 500)
        assert "worse than two-ray ground by 1.5 dB [1." in said(large, small)
        assert "better than two-ray ground by 1.5 dB [1." in said(small, large)
        assert "no significant difference from two-ray ground" in said(small, rng.permutation(small))
        assert "the flight is too short for an interval" in said(small[:5], large[:5])
        several = dataclasses.replace(paired_difference(large, small), verdict="not significant")
        assert several.in_words("free space").endswith("; corrected for the number of channels)")

    def test_without_a_pair_nothing_is_judged(self, report_data):
        text = words.rss_verdict(report_data.rss[0])
        assert "worse" not in text
        assert "better" not in text

    def test_edge_of_the_search(self, report_data):
        at_edge = with_numbers(report_data.rss[0], at_edge=True)
        assert any("end of its search range" in w for w in build.rss_warnings(at_edge))
        assert build.rss_warnings(report_data.rss[0]) == ()

    def test_nothing_to_score(self, report_data):
        panel = with_numbers(report_data.rss[0], n=0, rmse_db=np.nan, offset_db=np.nan)
        assert "nothing to score" in words.rss_verdict(panel)
        text = render(dataclasses.replace(report_data, rss=(panel,))).text
        assert words.rss_verdict(panel) in text
        assert "Fitted on the scored samples" not in text
        assert "Fitted on the scored samples: offset" in render(report_data).text

    def test_kappa_has_its_neighbours(self, report_data):
        panel = with_numbers(
            report_data.rank[0],
            commonest=CommonestRank(rank=2, agreement=0.71, agreement_ci95=(0.6, 0.8)),
            repeat={"any_heading": RankRepeat(n=90, kappa=0.42, kappa_ci95=(0.3, 0.5), agreement=0.7)},
        )
        text = words.rank_references(panel)
        assert "always guessing 2 agrees in 71 %" in text
        assert "repeated visits of the modem at the same positions have kappa 0.42" in text
        assert text in render(dataclasses.replace(report_data, rank=(panel,))).text


def test_a_note_of_site_and_flight_is_said_once(report_data):
    note = "this flight is replayed without the buildings of the site"
    site = dataclasses.replace(report_data.site, notes=(note,))
    text = html.page(dataclasses.replace(report_data, site=site, notes=(note, "of the flight alone")), [])
    assert text.count(note) == 1
    assert text.count("of the flight alone") == 1


def test_thousands_and_signs_are_written_alike_everywhere(report_data):
    text = render(report_data).text
    assert not re.search(r"\d,\d{3}\b", text)
    assert not re.search(r"offset of -\d", text)


def test_agreement_of_ranks_bears_the_error_bar_of_the_ground(small_report):
    rank = small_report.rank[0]
    k = next(iter(rank.score.simulated))
    assert not re.search(r"\d\s%\s\[.*?\]\s±\d", render(small_report).text)
    further = dataclasses.replace(rank.further, agreement_sd_by_ground={f"{k:g}": 0.0714})
    page = render(dataclasses.replace(small_report, rank=(dataclasses.replace(rank, further=further),)))
    assert len(re.findall(r"\d\s%\s\[[^]]*\]\s±7", page.text)) == 1


def test_a_flight_with_few_samples_says_why_no_models_are_compared(small_report):
    first = small_report.rss[0]
    few = with_numbers(first, n=4)
    assert words.NO_MODELS in render(dataclasses.replace(small_report, rss=(few,), models=(), ladder=())).text
    assert words.NO_MODELS not in render(dataclasses.replace(small_report, rss=(), models=(), ladder=())).text
    # 20 samples can be scored and fewer can have a level in every model
    assert words.NO_MODELS in render(dataclasses.replace(small_report, rss=(first,), models=(), ladder=())).text
    # rays of another engine are not compared with simpler models
    other = dataclasses.replace(
        small_report, models=(), ladder=(), engine=EngineResult(engine="sionna", links=1, seconds=1.0)
    )
    assert words.NO_MODELS not in render(other).text
