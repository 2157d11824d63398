"""The map page in a real browser: layers, values under the pointer, difference, profile, numbers against the record."""

import dataclasses

import numpy as np
import pytest
from matplotlib import colormaps

from aerpaw_cmp.report import maps as maps_html
from aerpaw_cmp.report.maps import JOINT
from tests.report.browsing import PageLaws, choose, frame, needs_browser, open_page, papers, set_scheme, start

pytest.importorskip("selenium", reason="selenium is not installed")
pytestmark = needs_browser

READY = "window.mapExplorer && mapExplorer.ready"
SHOWN = "const v = mapExplorer.shown(); return v && Array.from(v, x => Number.isFinite(x) ? x : null)"


@pytest.fixture(scope="module")
def data(maps_data):
    """The made-up maps with leaves (opaque) and without: the wood takes nothing there, and the levels are lopsided."""
    east, north = np.meshgrid(maps_data.east_m, maps_data.north_m)
    tilt = east / 500 + north / 900
    without = [
        dataclasses.replace(m, foliage="none", values=np.where(np.isfinite(m.values), m.values, -70.0) + tilt)
        for m in maps_data.rss
    ]
    return dataclasses.replace(maps_data, rss=(*maps_data.rss, *without))


@pytest.fixture(scope="module")
def driver(data, tmp_path_factory):
    path = tmp_path_factory.mktemp("map") / "map.html"
    path.write_text(maps_html.maps_page(data, ["metrics.json"]), encoding="utf-8")
    browser = start("--window-size=1440,1300")
    open_page(browser, path, READY)
    yield browser
    browser.quit()


@pytest.fixture(autouse=True)
def level_map(request):
    if "driver" not in request.fixturenames:
        return
    driver = request.getfixturevalue("driver")
    driver.execute_script(
        "mapExplorer.setQuantity(0); mapExplorer.setDifference(false); mapExplorer.line(null); "
        "mapExplorer.state.a = [0, 0, 0, 0]; mapExplorer.setQuantity(0); mapExplorer.everything()"
    )
    frame(driver)


def shown(driver, data):
    values = driver.execute_script(SHOWN)
    return np.array([np.nan if v is None else v for v in values]).reshape(len(data.north_m), len(data.east_m))


def pick(driver, letter="a", **axes):
    for axis, value in axes.items():
        choose(driver, f"{letter}-{axis}", value)
    frame(driver)


def of(data, tower, antennas, foliage, height):
    return next(
        m for m in data.rss if (m.tower, m.antennas, m.foliage, m.height_m) == (tower, antennas, foliage, height)
    )


@pytest.mark.parametrize(
    ("tower", "antennas", "foliage", "height"),
    [(JOINT, "SISO", "opaque", 30.0), ("LW3", "MIMO", "none", 110.0), ("LW5", "SISO", "opaque", 70.0)],
)
def test_switches_show_the_layer_and_its_numbers(driver, data, tower, antennas, foliage, height):
    pick(
        driver,
        tower="nearest tower" if tower == JOINT else tower,
        antennas=antennas,
        foliage=foliage,
        height=f"{height:g} m",
    )
    layer = of(data, tower, antennas, foliage, height)
    assert shown(driver, data) == pytest.approx(layer.values, abs=0.0051, nan_ok=True)
    numbers = driver.execute_script("return mapExplorer.statistics()")
    entry = next(
        n
        for n in maps_html.maps_metrics(data)["layers"]
        if (n["quantity"], n.get("tower"), n.get("antennas"), n.get("foliage"), n["height"])
        == ("RSS", tower, antennas, foliage, f"{height:g} m")
    )
    for name in ("covered", "median", "mean", "p10", "p90", "min", "max"):
        assert numbers[name] == pytest.approx(entry[name], abs=0.0051)
    text = driver.find_element("id", "numbers").text
    median = float(text.split("Median\n")[1].split(" dBm")[0].replace("−", "-"))
    assert median == pytest.approx(entry["median"], abs=0.0101)
    assert f"{100 * entry['covered']:.1f} %" in text


def test_ranks_have_the_shares_of_the_tables(driver, data):
    choose(driver, "quantity", "Rank")
    pick(driver, k="100", height="70 m")
    entry = next(m for m in data.rank if (m.k, m.height_m) == (100.0, 70.0))
    share = driver.execute_script("return mapExplorer.statistics().share")
    assert share == pytest.approx(entry.share.tolist())
    assert f"{100 * entry.share[2]:.1f} %" in driver.find_element("id", "numbers").text
    choose(driver, "quantity", "RSS")
    assert driver.execute_script("return document.getElementById('a-height').selectedOptions[0].text") == "70 m"


def hover(driver, data, row, column):
    """Point at the middle of a cell. Return the text that the page shows."""
    from selenium.webdriver import ActionChains

    canvas = driver.find_element("id", "map")
    driver.execute_script("arguments[0].scrollIntoView({block: 'center', behavior: 'instant'})", canvas)
    east, north = float(data.east_m[column]), float(data.north_m[row])
    x, y = driver.execute_script(
        "const p = mapExplorer.project(), c = document.getElementById('map'); "
        "return [p.x(arguments[0]) - c.clientWidth / 2, p.y(arguments[1]) - c.clientHeight / 2]", east, north,
    )  # fmt: skip
    ActionChains(driver).move_to_element_with_offset(canvas, round(x), round(y)).perform()
    frame(driver)
    return driver.find_element("id", "here").text


def test_the_pointer_reads_value_and_position(driver, data):
    pick(driver, tower="LW3", antennas="MIMO", foliage="none", height="30 m")
    row, column = 12, 29  # far south-east: a flipped or transposed map reads something else
    text = hover(driver, data, row, column)
    assert driver.execute_script("return mapExplorer.state.cell") == [row, column]
    value = of(data, "LW3", "MIMO", "none", 30.0).values[row, column]
    east, north = data.east_m[column], data.north_m[row]
    lat, lon = data.site.frame.to_geographic(east, north)
    assert f"{value:.2f} dBm".replace("-", "−") in text
    assert f"{east:.1f}, {north:.1f} m".replace("-", "−") in text
    assert f"{lat:.6f}°, {lon:.6f}°".replace("-", "−") in text
    at = of(data, "LW3", "MIMO", "none", 110.0).values[row, column]
    assert f"110 m: {at:.1f} dBm".replace("-", "−") in text


@pytest.mark.parametrize(("scheme", "begun"), [("dark", 0.25), ("light", 0.0)])
def test_the_picture_lies_where_the_values_do(driver, data, scheme, begun):
    """The colour at the centre of a cell is that of its value, with north up and east right.

    In the dark scheme the scale begins brighter, so that no cell disappears.
    """
    set_scheme(driver, scheme)
    pick(driver, tower="LW4", antennas="SISO", foliage="none", height="30 m")
    colours = driver.execute_script(
        "const p = mapExplorer.project(), c = document.getElementById('map'), pen = c.getContext('2d'), k = c.width / c.clientWidth; "
        "return arguments[0].map(([e, n]) => Array.from(pen.getImageData(Math.round(p.x(e) * k), Math.round(p.y(n) * k), 1, 1).data).slice(0, 3))",
        [[-405.0, -630.0], [405.0, -630.0], [-405.0, 630.0], [405.0, 930.0]],
    )
    set_scheme(driver)
    ends = driver.execute_script("return mapExplorer.limits()")
    layer = of(data, "LW4", "SISO", "none", 30.0)
    for (east, north), colour in zip([(-405, -630), (405, -630), (-405, 630), (405, 930)], colours, strict=True):
        value = layer.values[np.abs(data.north_m - north).argmin(), np.abs(data.east_m - east).argmin()]
        share = begun + (1.0 - begun) * np.clip((value - ends[0]) / (ends[1] - ends[0]), 0, 0.9999)
        place = int(share * 128)
        expected = 255 * np.array(colormaps["viridis"](place / 127)[:3])
        assert np.abs(np.array(colour) - expected).max() <= 8


def test_difference_is_a_minus_b(driver, data):
    pick(driver, tower="LW2", antennas="MIMO", foliage="none", height="30 m")
    driver.find_element("id", "difference").click()
    pick(driver, "b", tower="LW2", antennas="MIMO", foliage="opaque", height="30 m")
    expected = of(data, "LW2", "MIMO", "none", 30.0).values - of(data, "LW2", "MIMO", "opaque", 30.0).values
    assert shown(driver, data) == pytest.approx(expected, abs=0.0101, nan_ok=True)
    numbers = driver.execute_script("return mapExplorer.statistics()")
    finite = expected[np.isfinite(expected)]
    assert numbers["mean"] == pytest.approx(finite.mean(), abs=0.0101)
    assert numbers["rms"] == pytest.approx(np.sqrt((finite**2).mean()), abs=0.0101)
    assert numbers["onlyA"] == pytest.approx(np.isnan(expected).mean())
    assert numbers["onlyB"] == 0.0
    assert numbers["covered"] == pytest.approx(np.isfinite(expected).mean())
    low, high = driver.execute_script("return mapExplorer.limits()")
    assert low == -high
    assert "A minus B" in driver.find_element("id", "title").text
    driver.find_element("id", "swap").click()
    frame(driver)
    assert shown(driver, data) == pytest.approx(-expected, abs=0.0101, nan_ok=True)
    text = hover(driver, data, 3, 4)
    assert "A − B" in text
    driver.find_element("id", "difference").click()


def test_the_scale_is_shared_or_own(driver, data):
    levels = np.concatenate([m.values[np.isfinite(m.values)] for m in data.rss])
    assert driver.execute_script("return mapExplorer.limits()") == pytest.approx(np.percentile(levels, [1, 99.5]))
    choose(driver, "scale", "of this layer")
    pick(driver, tower="LW1", antennas="SISO", foliage="none", height="70 m")
    own = of(data, "LW1", "SISO", "none", 70.0).values
    assert driver.execute_script("return mapExplorer.limits()") == pytest.approx([own.min(), own.max()], abs=0.01)
    choose(driver, "scale", "one scale for all layers")


def test_a_line_is_dragged_and_its_profile_runs_along_it(driver, data):
    from selenium.webdriver import ActionChains, Keys

    pick(driver, tower="LW1", antennas="SISO", foliage="none", height="30 m")
    hover(driver, data, 20, 10)
    ActionChains(driver).click_and_hold().move_by_offset(30, -200).release().perform()
    frame(driver)
    (e0, n0), (e1, n1) = driver.execute_script("return mapExplorer.state.line")
    assert n1 > n0  # dragged upwards: to the north
    assert e1 > e0
    profile = driver.execute_script("return mapExplorer.profile()")
    assert profile[-1][0] == pytest.approx(np.hypot(e1 - e0, n1 - n0))
    level_dbm = of(data, "LW1", "SISO", "none", 30.0).values
    for share in (0.0, 0.5, 1.0):
        distance, value = profile[round(share * (len(profile) - 1))]
        t = distance / profile[-1][0]
        column, row = (
            np.abs(data.east_m - (e0 + t * (e1 - e0))).argmin(),
            np.abs(data.north_m - (n0 + t * (n1 - n0))).argmin(),
        )
        assert value == pytest.approx(level_dbm[row, column], abs=0.0051)
    driver.find_element("id", "map").send_keys(Keys.ESCAPE)
    assert driver.execute_script("return mapExplorer.state.line") is None


def test_the_keyboard_steps_over_the_cells(driver):
    from selenium.webdriver import Keys

    driver.execute_script("mapExplorer.point([10, 10])")
    canvas = driver.find_element("id", "map")
    canvas.send_keys(Keys.ARROW_UP)
    assert driver.execute_script("return mapExplorer.state.cell") == [11, 10]
    canvas.send_keys("[")
    canvas.send_keys(Keys.ARROW_RIGHT, Keys.ARROW_RIGHT, "]")
    (e0, n0), (e1, n1) = driver.execute_script("return mapExplorer.state.line")
    assert (e1 - e0, n1 - n0) == (60.0, 0.0)


class TestPage(PageLaws):
    ready, views = READY, "#explorer canvas, #explorer select"
    static = ("#result table", "#rss summary")

    def papers(self, driver):
        return papers(driver, "histogram")

    def test_no_serious_finding_of_accessibility(self, driver):
        driver.execute_script("mapExplorer.setDifference(true); mapExplorer.everything()")
        super().test_no_serious_finding_of_accessibility(driver)
