"""A page is a list of cards: a card without content is not shown, and a new card is one function."""

import dataclasses
import inspect
import re
from types import SimpleNamespace

import pytest
from markupsafe import Markup

from aerpaw_cmp.report import calibration, campaign, flight, maps
from aerpaw_cmp.report.cards import HEAD, RIGHT, SHARE, TEXT, Card, Page, Table, settings_card
from aerpaw_cmp.report.flight_data import ReportData
from aerpaw_cmp.report.maps import MapsData
from aerpaw_cmp.report.page import environment

TABLE = Table(caption="c", columns={"name": HEAD, "text": TEXT, "dB": 2, "share": SHARE, "made": RIGHT}, rows=[])


def shown(*cards: Card) -> str:
    return Page(kind="report", title="t", cards=cards).html()


def test_cells_have_the_form_of_their_column() -> None:
    rows = [("a<b", None, 1.234, 0.5, Markup("<b>x</b>")), ("b", "t", (1.0, 2.0), None, "y")]
    html = shown(Card(title="T", id="t", tables=[dataclasses.replace(TABLE, rows=rows)]))
    assert '<th scope="row">a&lt;b</th><td>–</td><td class="n">1.23</td>' in html.replace("\n", "")
    assert '<td class="n">50\N{NARROW NO-BREAK SPACE}%</td><td class="n"><b>x</b></td>' in html.replace("\n", "")
    assert '<td class="n">[1.00, 2.00]</td>' in html


def test_a_long_setting_is_cut_and_a_short_one_is_complete() -> None:
    made = SimpleNamespace(versions={"python": "3.11"}, stages_s={"read": 1.0})
    html = shown(settings_card(made, {"marks": ["ab" * 2000], "rt": {"max_depth": 1}}))
    assert "<td>1</td>" in html
    (text,) = re.findall(r"<td>((?:ab)+a?…)</td>", html)
    assert len(text) == 300


@pytest.mark.parametrize("card", [Card(), Card(title="T", id="t", link="L", tables=[TABLE], parts=[Card(text=[[]])])])
def test_a_card_without_content_is_not_shown(card: Card) -> None:
    html = shown(card)
    assert "<section" not in html
    assert "<nav" not in html
    assert "<table" not in html


def test_a_part_without_content_leaves_the_others() -> None:
    html = shown(Card(title="T", id="t", text=["one `two`"], parts=[Card(title="empty", tables=[TABLE], fold=True)]))
    assert "<p>one <code>two</code></p>" in html
    assert "empty" not in html


def test_every_card_function_of_a_page_stands_on_it() -> None:
    for module in (flight, maps, campaign, calibration):
        made = {name for name, of in inspect.getmembers(module, inspect.isfunction) if name.endswith("_card")}
        mine = {name for name in made if getattr(module, name).__module__ == module.__name__}
        source = inspect.getsource(module)
        assert mine
        assert all(source.count(name) > 1 for name in mine)  # defined, and in CARDS or the page


def test_a_new_card_is_one_function(report_data: ReportData, monkeypatch: pytest.MonkeyPatch) -> None:
    """A new card needs the function and its name in CARDS, as CONTRIBUTING describes."""

    def samples_card(data: ReportData) -> Card:
        table = Table(
            caption="Samples.", columns={"Channel": HEAD, "n": 0}, rows=[(p.name, p.score.n) for p in data.rss]
        )
        return Card(title="Samples by channel", id="samples", link="Samples", tables=[table])

    monkeypatch.setattr(flight, "CARDS", (*flight.CARDS, samples_card))
    html = flight.page(report_data, [])
    assert '<a href="#samples">Samples</a>' in html
    card = html.partition('<section id="samples">')[2].partition("</section>")[0]
    assert card.count("<tr>") == 1 + len(report_data.rss)


def test_no_page_changes_the_template_environment(report_data: ReportData, maps_data: MapsData) -> None:
    known = dict(environment().filters), dict(environment().globals), dict(environment().tests)
    flight.page(report_data, [])
    maps.maps_page(maps_data, [])
    assert (environment().filters, environment().globals, environment().tests) == known
