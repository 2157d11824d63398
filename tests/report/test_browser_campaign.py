"""The campaign page in a real browser: switches, sorting, linked flights and places against the record and its CSV."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest

from aerpaw_cmp.report import campaign_html
from benchmarks import fabricated
from tests.report.browsing import (
    asked_outside,
    choose,
    complaints,
    extents,
    frame,
    needs_browser,
    open_page,
    papers,
    reload_page,
    serious_findings,
    start,
)

pytest.importorskip("selenium", reason="selenium is not installed")
pytestmark = needs_browser

READY = "window.campaignExplorer && campaignExplorer.ready"
HALF_STEP = 0.0051


@pytest.fixture(scope="module")
def data():
    return fabricated.season(9, 4, 2, 2)


@pytest.fixture(scope="module")
def table(data):
    """campaign.csv as a reader of it sees it."""
    frame = campaign_html.campaign_frame(data)
    return frame[frame["kind"] == "rss"]


@pytest.fixture(scope="module")
def driver(data, tmp_path_factory):
    path = tmp_path_factory.mktemp("campaign") / "campaign.html"
    path.write_text(campaign_html.campaign_page(data, [], ["campaign.csv"]), encoding="utf-8")
    found = start("--window-size=1440,1300")
    open_page(found, path, READY)
    yield found
    found.quit()


@pytest.fixture(autouse=True)
def first_choice(request):
    if "driver" not in request.fixturenames:
        return
    driver = request.getfixturevalue("driver")
    driver.execute_script(
        "const c = campaignExplorer; Object.assign(c.state, { setting: c.data.first, tower: 'all', channel: 'all', "
        "measure: 'held', kept: false }); c.mark(null); c.controls(); c.everything()"
    )
    frame(driver)


def column(driver, table, number):
    """Texts of a column; what is scrolled out of sight counts, too."""
    return driver.execute_script(
        "return [...document.getElementById(arguments[0]).tBodies[0].rows].map(r => r.cells[arguments[1]].textContent)",
        table, number,
    )  # fmt: skip


def numbers(texts):
    return [float(text.replace("−", "-")) if text != "–" else np.nan for text in texts]


def expected_errors(table, setting, name="held_out_rmse_db", **where):
    rows = table[table["setting"] == setting]
    for key, value in where.items():
        rows = rows[rows[key] == value]
    return rows.groupby("flight")[name].mean()


def test_nothing_is_said_on_the_console_and_nothing_leaves_the_page(driver):
    assert complaints(driver) == []
    assert asked_outside(driver) == []


def test_the_ranking_is_that_of_the_record(driver, data):
    shown = column(driver, "ranking", 1)
    entries = json.loads(json.dumps(campaign_html.campaign_metrics(data)))["season"]["ranking"]
    entries = [entry for entry in entries if not entry["link"]]
    assert shown == [entry["setting"] for entry in entries]
    assert numbers(column(driver, "ranking", 3)) == pytest.approx([e["mean_db"] for e in entries], abs=HALF_STEP)
    assert numbers(column(driver, "ranking", 6)) == pytest.approx([e["difference_db"] for e in entries], abs=HALF_STEP)
    low, high = entries[-1]["difference_ci95_db"]
    assert column(driver, "ranking", 7)[-1] == f"[{low:.2f}, {high:.2f}]"
    assert column(driver, "ranking", 8) == [entry["verdict"] for entry in entries]


def test_flights_have_the_errors_of_the_csv(driver, data, table):
    choose(driver, "setting", "setting 01")
    frame(driver)
    wanted = expected_errors(table, "setting 01")
    found = dict(zip(column(driver, "flights", 0), numbers(column(driver, "flights", 2)), strict=True))
    assert {name: found[name] for name in wanted.index} == pytest.approx(wanted.to_dict(), abs=2 * HALF_STEP)
    # the worst stands first
    assert found[column(driver, "flights", 0)[0]] == max(v for v in found.values() if np.isfinite(v))
    first = expected_errors(table, "setting 02")
    to_first = dict(zip(column(driver, "flights", 0), numbers(column(driver, "flights", 3)), strict=True))
    common = wanted.index.intersection(first.index)
    assert [to_first[f] for f in common] == pytest.approx((wanted - first)[common].tolist(), abs=3 * HALF_STEP)


def test_tower_channel_and_error_are_filters(driver, data, table):
    choose(driver, "tower", "LW2")
    choose(driver, "channel", "USRP1")
    frame(driver)
    wanted = expected_errors(table, "setting 02", tower="LW2", channel="USRP1")
    found = dict(zip(column(driver, "flights", 0), numbers(column(driver, "flights", 2)), strict=True))
    assert {f: found[f] for f in wanted.index} == pytest.approx(wanted.to_dict(), abs=HALF_STEP)
    entry = next(r for r in data.season.ranking if r.link == "LW2 USRP1")
    assert column(driver, "ranking", 1)[0] == entry.setting
    assert numbers(column(driver, "ranking", 3))[0] == pytest.approx(entry.mean_db, abs=HALF_STEP)
    choose(driver, "channel", "all")
    choose(driver, "measure", "offset of the flight's own samples")
    frame(driver)
    wanted = expected_errors(table, "setting 02", "rmse_db", tower="LW2")
    found = dict(zip(column(driver, "flights", 0), numbers(column(driver, "flights", 2)), strict=True))
    assert {f: found[f] for f in wanted.index} == pytest.approx(wanted.to_dict(), abs=2 * HALF_STEP)
    assert numbers(column(driver, "ranking", 3))[0] == pytest.approx(wanted.mean(), abs=2 * HALF_STEP)


def test_heads_sort_both_ways_and_what_is_missing_stands_last(driver):
    head = driver.find_elements("css selector", "#flights thead button")[4]
    driver.execute_script("arguments[0].scrollIntoView({block: 'center', behavior: 'instant'})", head)
    head.click()
    up = numbers(column(driver, "flights", 4))
    known = [v for v in up if np.isfinite(v)]
    assert known == sorted(known)
    assert known == up[: len(known)]
    head.click()
    assert numbers(column(driver, "flights", 4))[: len(known)] == known[::-1]
    assert (
        driver.execute_script("return document.querySelector('#flights th[aria-sort]').getAttribute('aria-sort')")
        == "descending"
    )
    # a new choice keeps the order that was asked for
    choose(driver, "setting", "setting 03")
    again = numbers(column(driver, "flights", 4))
    finite = [v for v in again if np.isfinite(v)]
    assert finite == sorted(finite, reverse=True)
    assert np.isfinite(again[: len(finite)]).all()
    driver.execute_script("document.querySelector('#flights th[aria-sort]').removeAttribute('aria-sort')")


def test_pointing_at_a_flight_marks_it_everywhere(driver, data):
    from selenium.webdriver import ActionChains

    rows = driver.find_elements("css selector", "#flights tbody tr")
    driver.execute_script("arguments[0].scrollIntoView({block: 'center', behavior: 'instant'})", rows[2])
    name = rows[2].find_element("tag name", "th").text
    number = data.flights.index(name)
    for _ in range(100):  # the pointer crosses other rows, and the page moves under it as they are marked
        ActionChains(driver).move_to_element(rows[2]).perform()
        frame(driver)
        if driver.execute_script("return campaignExplorer.state.flight") == number:
            break
    assert driver.execute_script("return campaignExplorer.state.flight") == number
    assert name in driver.find_element("id", "marked").text
    yellow = (
        "const c = document.getElementById(arguments[0]), d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data; "
        "let n = 0; for (let i = 0; i < d.length; i += 4) if (d[i] === 240 && d[i + 1] === 192 && d[i + 2] === 0) n++; return n"
    )
    for view in ("distribution", "drift", "map"):
        assert driver.execute_script(yellow, view) > 10, view
    assert driver.execute_script("return document.querySelectorAll('#flights tr.chosen').length") == 1
    track = driver.execute_script("const t = campaignExplorer.trackOf(arguments[0]); return [t[0][0], t[1][0]]", number)
    assert track == pytest.approx(data.tracks[number].position_m[0, :2], abs=0.051)
    spot = driver.execute_script("return campaignExplorer.spots.drift.find(s => s[2] === 5)")
    canvas = driver.find_element("id", "drift")
    driver.execute_script("arguments[0].scrollIntoView({block: 'center', behavior: 'instant'})", canvas)
    box = driver.execute_script("const c = document.getElementById('drift'); return [c.clientWidth, c.clientHeight]")
    ActionChains(driver).move_to_element_with_offset(
        canvas, round(spot[0] - box[0] / 2), round(spot[1] - box[1] / 2)
    ).perform()
    frame(driver)
    assert driver.execute_script("return campaignExplorer.state.flight") == 5
    assert driver.execute_script("return +document.querySelector('#flights tr.chosen').dataset.flight") == 5


def test_a_flight_with_a_report_is_linked_to_it(driver, data):
    links = driver.execute_script(
        "return [...document.querySelectorAll('#flights a')].map(a => a.getAttribute('href')).sort()"
    )
    assert links == [f"../{name}/report.html" for name in data.flights[:3]]


def test_offsets_lie_on_their_dates(driver, data, table):
    spots = driver.execute_script("return campaignExplorer.spots.drift.map(s => [s[0], s[1], s[2]])")
    rows = table[table["setting"] == "setting 02"]
    assert len(spots) == len(rows)
    by = pd.DataFrame(spots, columns=["x", "y", "flight"]).groupby("flight")
    order = by["x"].mean()
    assert (np.diff(order) > 0).all()  # flights are a day apart
    offsets = rows.assign(flight=[data.flights.index(f) for f in rows["flight"]]).groupby("flight")["offset_db"].mean()
    assert np.corrcoef(by["y"].mean(), offsets)[0, 1] < -0.999  # up is more


def test_places_have_the_means_of_the_record(driver, data):
    found = driver.execute_script(
        "const p = campaignExplorer.places(); return [p.link, Array.from(p.e), Array.from(p.n), Array.from(p.mean), Array.from(p.count)]"
    )
    everything = next(p for p in data.season.places if not p.tower)
    assert found[0] == -1
    assert [(e + 0.5) * data.cell_m for e in found[1]] == pytest.approx(everything.east_m.tolist())
    assert [(n + 0.5) * data.cell_m for n in found[2]] == pytest.approx(everything.north_m.tolist())
    assert found[3] == pytest.approx(everything.mean_db.tolist(), abs=HALF_STEP)
    assert found[4] == everything.n.tolist()


def test_a_cell_under_the_pointer_is_told(driver, data):
    from selenium.webdriver import ActionChains

    everything = next(p for p in data.season.places if not p.tower)
    k = int(everything.east_m.argmax())
    canvas = driver.find_element("id", "map")
    driver.execute_script("arguments[0].scrollIntoView({block: 'center', behavior: 'instant'})", canvas)
    x, y = driver.execute_script(
        "const p = campaignExplorer.project(), c = document.getElementById('map'); return [p.x(arguments[0]) - c.clientWidth / 2, p.y(arguments[1]) - c.clientHeight / 2]",
        float(everything.east_m[k]), float(everything.north_m[k]),
    )  # fmt: skip
    ActionChains(driver).move_to_element_with_offset(canvas, round(x), round(y)).perform()
    frame(driver)
    text = driver.find_element("id", "place").text.replace("−", "-")
    assert f"East {everything.east_m[k]:.0f} m, north {everything.north_m[k]:.0f} m" in text
    assert float(text.split("mean ")[1].split(" dB")[0]) == pytest.approx(everything.mean_db[k], abs=2 * HALF_STEP)


def test_the_keyboard_steps_through_the_flights(driver):
    from selenium.webdriver import Keys

    canvas = driver.find_element("id", "distribution")
    canvas.send_keys(Keys.ARROW_DOWN)
    first = driver.execute_script("return campaignExplorer.state.flight")
    assert first is not None
    canvas.send_keys(Keys.ARROW_DOWN)
    assert driver.execute_script("return campaignExplorer.state.flight") != first
    canvas.send_keys(Keys.ESCAPE)
    assert driver.execute_script("return campaignExplorer.state.flight") is None


def test_failures_stand_with_their_reason(driver, data):
    rows = driver.find_elements("css selector", "#failures-table tbody tr")
    assert len(rows) == len(data.failures) > 0
    assert data.failures[0].message in rows[0].text
    driver.execute_script("document.getElementById('failures-filter').click()")
    shown = [row.get_attribute("data-setting") for row in rows if row.is_displayed()]
    assert set(shown) <= {"setting 02"}
    driver.execute_script("document.getElementById('failures-filter').click()")


def test_no_serious_finding_of_accessibility(driver):
    assert serious_findings(driver) == {}


@pytest.mark.parametrize("width", [1440, 768, 390])
def test_nothing_overflows(driver, width):
    page, rights = extents(driver, width, "#explorer canvas, #explorer select")
    assert page <= width
    assert max(rights) <= width


def test_dark_and_light(driver):
    assert papers(driver, "legend") == [[255, 255, 255, 255], [23, 23, 23, 255]]


def test_with_scripts_off_the_tables_stand(driver):
    driver.execute_cdp_cmd("Emulation.setScriptExecutionDisabled", {"value": True})
    try:
        driver.refresh()
        assert not driver.find_element("id", "explorer").is_displayed()
        assert "setting 02" in driver.find_element("css selector", "#result table").text
        assert driver.find_element("id", "failures-table").is_displayed()
    finally:
        driver.execute_cdp_cmd("Emulation.setScriptExecutionDisabled", {"value": False})
        reload_page(driver, READY)
