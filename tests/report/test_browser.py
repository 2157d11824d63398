"""The page in a real browser: numbers, links between the views, keyboard, accessibility, widths, no network."""

import dataclasses
import re
from xml.etree import ElementTree

import numpy as np
import pytest

from aerpaw_cmp.compare.offset import grid_offset
from aerpaw_cmp.report import flight as write
from benchmarks.fabricated import with_numbers
from tests.report.browsing import (
    PageLaws,
    choose,
    frame,
    needs_browser,
    open_page,
    saved,
    set_scheme,
    set_width,
    start,
    usual_width,
)

pytest.importorskip("selenium", reason="selenium is not installed")
pytestmark = needs_browser

SVG = "{http://www.w3.org/2000/svg}"


@pytest.fixture(scope="module")
def page(small_report, tmp_path_factory):
    folder = tmp_path_factory.mktemp("page")
    return write.write_report(small_report, folder)[0][0]


@pytest.fixture(scope="module")
def driver(page):
    browser = start("--window-size=1440,1200")
    open_page(browser, page, "window.explorer")
    yield browser
    browser.quit()


@pytest.fixture(autouse=True)
def whole_flight(request):
    if "driver" in request.fixturenames:
        request.getfixturevalue("driver").execute_script("explorer.span(null)")


def test_numbers_of_the_whole_flight_are_those_of_the_report(driver, small_report):
    for panel in small_report.rss:
        choose(driver, "choose-series", panel.name)
        choose(driver, "choose-model", "ray tracing")
        shown = driver.execute_script("return explorer.statistics()")
        fit = grid_offset(panel.measured_db, panel.simulated_dbm)
        assert (shown["n"], round(shown["offset"], 6)) == (fit.n, fit.offset_db)
        assert shown["rmse"] == pytest.approx(fit.rmse_db, abs=1e-4)


def test_a_model_and_a_span_change_the_numbers(driver, small_report):
    panel = small_report.rss[0]
    choose(driver, "choose-series", panel.name)
    choose(driver, "choose-model", "free space")
    seconds = (panel.time - panel.time[0]) / np.timedelta64(1, "s")
    first, last = seconds[len(seconds) // 4], seconds[len(seconds) // 2]
    start_s = driver.execute_script("const s = explorer.data.rss[0]; return explorer.series(s.time)[0]")
    driver.execute_script("explorer.span([arguments[0], arguments[1]])", start_s + first - 1e-6, start_s + last + 1e-6)
    inside = (seconds >= first) & (seconds <= last)
    baseline = panel.baselines["free_space"]
    fit = grid_offset(panel.measured_db[inside], baseline.level_dbm[inside])
    shown = driver.execute_script("return explorer.statistics()")
    assert shown["n"] == fit.n
    assert shown["offset"] == pytest.approx(fit.offset_db, abs=1e-6)
    assert shown["rmse"] == pytest.approx(fit.rmse_db, abs=1e-4)
    frame(driver)
    assert f"{fit.rmse_db:.1f} dB" in driver.find_element("id", "span").text


def test_pointing_at_a_chart_marks_the_pose_in_all_views(driver):
    from selenium.webdriver import ActionChains

    choose(driver, "choose-model", "ray tracing")
    over = driver.find_elements("css selector", ".u-over")
    assert len(over) >= 3
    ActionChains(driver).move_to_element(over[0]).perform()
    frame(driver)
    pose = driver.execute_script("return explorer.state.pose")
    assert pose is not None
    facts = driver.find_element("id", "pose").text
    assert "Residual" in facts
    assert "East, north, up" in facts
    ActionChains(driver).move_to_element_with_offset(over[1], 40, 0).perform()
    frame(driver)
    assert driver.execute_script("return explorer.state.pose") > pose
    assert driver.find_element("id", "pose").text != facts


def test_dragging_over_a_chart_chooses_a_span_and_escape_takes_it_back(driver):
    from selenium.webdriver import ActionChains, Keys

    over = driver.find_elements("css selector", ".u-over")[0]
    count = driver.execute_script("return explorer.statistics().n")
    ActionChains(driver).move_to_element_with_offset(over, -80, 0).click_and_hold().move_by_offset(
        120, 0
    ).release().perform()
    frame(driver)
    assert 0 < driver.execute_script("return explorer.statistics().n") < count
    driver.find_element("id", "map").send_keys(Keys.ESCAPE)
    assert driver.execute_script("return explorer.statistics().n") == count


def test_the_keyboard_steps_through_the_poses(driver):
    from selenium.webdriver import Keys

    canvas = driver.find_element("id", "map")
    canvas.send_keys(Keys.ARROW_RIGHT)
    first = driver.execute_script("return explorer.state.pose")
    canvas.send_keys(Keys.ARROW_RIGHT)
    assert driver.execute_script("return explorer.state.pose") > first
    canvas.send_keys("[")
    span = driver.execute_script("return explorer.state.span")
    assert span[0] == driver.execute_script("return explorer.state.pose")


def test_the_map_shows_the_flight_from_above_and_in_three_dimensions(driver):
    ink = "const c = document.getElementById('map'), d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data; const s = new Set(); for (let i = 0; i < d.length; i += 40) s.add(d[i] << 16 | d[i+1] << 8 | d[i+2]); return s.size;"
    driver.find_element("id", "view-plan").click()
    frame(driver)
    assert driver.execute_script(ink) > 8
    driver.find_element("id", "view-solid").click()
    frame(driver)
    assert driver.execute_script(ink) > 8
    assert driver.execute_script("return explorer.state.tilt") < 1


def test_times_on_the_axes_are_round_and_say_utc(driver):
    shown = driver.execute_script("return explorer.times()")
    assert len(shown) >= 3
    for texts in shown:
        assert texts[0].endswith(" UTC")
        times = [np.datetime64(f"1970-01-01T{text[:8]}", "s").astype(int) for text in texts]
        steps = set(np.diff(times).tolist())
        assert len(steps) == 1
        step = steps.pop()
        assert 3600 % step == 0
        assert all(time % step == 0 for time in times)


def test_the_readouts_stay_inside_a_small_window(driver):
    set_width(driver, 1440, 900)
    try:
        for place in ("#charts", "#map"):
            driver.execute_script(
                "document.querySelector(arguments[0]).scrollIntoView(); explorer.choose(explorer.series(explorer.data.rss[0].time)[5])",
                place,
            )
            frame(driver)
            bottoms = driver.execute_script(
                "return ['pose', 'span'].map(id => document.getElementById(id).getBoundingClientRect().bottom)"
            )
            assert max(bottoms) <= 900
    finally:
        usual_width(driver)


def test_readouts_lie_over_no_chart_until_a_pose_is_marked(driver, page):
    open_page(driver, page, "window.explorer")
    set_width(driver, 1440, 900)
    try:
        edges = driver.execute_script(
            "return [document.querySelector('#charts').getBoundingClientRect().bottom,"
            " document.querySelector('#span').getBoundingClientRect().top, document.body.classList.contains('pointed')]"
        )
        assert edges[2] is False
        assert edges[1] >= edges[0] - 1
        driver.execute_script("explorer.choose(explorer.series(explorer.data.rss[0].time)[5])")
        frame(driver)
        assert driver.execute_script("return document.body.classList.contains('pointed')")
    finally:
        usual_width(driver)


def test_on_a_telephone_no_readout_lies_over_a_chart(driver):
    set_width(driver, 390, 844)
    try:
        edges = driver.execute_script(
            "document.querySelector('#charts').scrollIntoView();"
            "return [document.querySelector('#charts'), document.querySelector('#span')].map(e => {"
            "  const r = e.getBoundingClientRect(); return [r.top, r.bottom]; })"
        )
        assert edges[1][0] >= edges[0][1] - 1
    finally:
        usual_width(driver)


def test_no_two_elements_share_an_identifier(driver):
    identifiers = driver.execute_script("return Array.from(document.querySelectorAll('[id]'), e => e.id)")
    assert len(identifiers) > 10
    assert sorted({identifier for identifier in identifiers if identifiers.count(identifier) > 1}) == []


class TestPage(PageLaws):
    ready, views, static = "window.explorer", ".u-wrap", ("#result table", ".numbers")

    def papers(self, driver):
        seen = []
        for scheme in ("light", "dark"):
            set_scheme(driver, scheme)
            colour = driver.execute_script("return getComputedStyle(document.body).backgroundColor")
            seen.append([int(part) for part in re.findall(r"\d+", colour)])
        set_scheme(driver)
        return seen


def test_only_rank(small_report, tmp_path, driver, page):
    bare = dataclasses.replace(small_report, rss=(), pairs=())
    path = write.write_report(bare, tmp_path)[0][0]
    open_page(driver, path, "window.explorer")
    try:
        assert driver.execute_script("return explorer.rankStatistics().n") == np.isfinite(bare.rank[0].measured).sum()
        assert [e for e in driver.get_log("browser") if e["level"] == "SEVERE"] == []
    finally:
        open_page(driver, page, "window.explorer")


@pytest.mark.parametrize("width", [1440, 390])
def test_names_of_towers_stay_clear_of_the_key_of_the_edges_and_of_each_other(driver, width):
    """Towers put all over the map, some of them side by side: below the lowest of them begins the key."""
    set_width(driver, width, 1200)
    try:
        towers = driver.execute_script(
            "const site = explorer.data.site, kept = site.towers, at = kept[0].at;"
            "site.towers = [kept[0], { ...kept[0], name: 'beside', at: [at[0] + 4, at[1], at[2]] }, ...kept.slice(1)];"
            "for (let k = 0; k < 40; k++) site.towers.push({ name: 'Tower ' + k, top: at[2] + 10,"
            "  at: [at[0] + 150 * (k % 7 - 3), at[1] + 150 * (Math.floor(k / 7) - 3), at[2]] });"
            "explorer.span(null); return kept;"
        )
        frame(driver)
        labels, key, wide = driver.execute_script(
            "return [explorer.labels(), explorer.keyTop(), document.getElementById('map').clientWidth]"
        )
        assert len(labels) > 8
        assert all(left >= 0 and right <= wide and top >= 0 and bottom <= key for left, top, right, bottom, _ in labels)
        near = [label for label in labels if label[4] in ("beside", towers[0]["name"])]
        assert len(near) == 2
        (a, b, c, d, _), (e, f, g, h, _) = near
        assert min(c, g) <= max(a, e) or min(d, h) <= max(b, f)
        driver.execute_script("explorer.data.site.towers = arguments[0]; explorer.span(null)", towers)
    finally:
        usual_width(driver)


def test_no_error_of_a_model_is_shown_on_the_flight_it_was_learned_from(small_report, tmp_path):
    first, *rest = small_report.rss
    learned = with_numbers(first, trained_on=("0" * 64,))
    page = write.write_report(dataclasses.replace(small_report, rss=(learned, *rest)), tmp_path)[0][0]
    browser = start("--window-size=1440,1200")
    try:
        open_page(browser, page, "window.explorer")
        choose(browser, "choose-series", learned.name)
        choose(browser, "choose-model", "ray tracing")
        shown = browser.execute_script("return document.getElementById('span').textContent")
        assert "not scored: antennas learned from this flight" in shown
        assert "RMSE with" not in shown
        choose(browser, "choose-model", "free space")
        assert "RMSE with" in browser.execute_script("return document.getElementById('span').textContent")
    finally:
        browser.quit()


def test_every_chart_is_saved_as_it_is_shown(driver):
    """The menu of a chart: the same marks and words as SVG, the picture, and a row for each of its points."""
    driver.execute_script("document.querySelectorAll('details').forEach(d => { d.open = true; })")
    frame(driver)
    files = saved(driver, ".key select")
    assert files["Residuals.svg"].count("<rect") == 31  # the paper and the bars
    assert "Samples</text>" in files["Residuals.svg"]
    shown = driver.execute_script("return explorer.series(explorer.data.rss[0].time).length")
    drawn = {name[:-4]: ElementTree.fromstring(text) for name, text in files.items() if name.endswith(".svg")}
    over_time = [name for name in drawn if re.match(r"Level|Residual \[|Height", name)]
    assert len(over_time) == 3
    for name in over_time:  # a library draws these, with paths of its own and later than it is asked to
        assert name in [text.text for text in drawn[name].iter(f"{SVG}text")]
        assert max(path.get("d").count(" ") for path in drawn[name].iter(f"{SVG}path")) > 1000
    rows = files["Residuals.csv"].splitlines()
    assert sum(int(row.split(",")[1]) for row in rows[1:]) == driver.execute_script("return explorer.statistics().n")
    assert len(files["Residual [dB].csv"].splitlines()) == shown + 1
    assert all(text for text in files.values())
