"""The live canvas of predict, plan, locate and calibrate in a real browser: values on a map and a sphere."""

import numpy as np
import pytest

from aerpaw_cmp.common.kml import CLASS_COLOURS
from aerpaw_cmp.report.page import embedded
from aerpaw_cmp.report.places import BAND, COMPASS, LIKELIEST, Places, payload
from tests.report.browsing import PageLaws, choose, frame, needs_browser, open_page, papers, saved, start
from tests.report.shown import PAGES

pytest.importorskip("selenium", reason="selenium is not installed")
pytestmark = needs_browser

READY = "window.places && places.ready"
AZIMUTH, UP = np.radians(np.arange(0, 360, 15)), np.radians(np.arange(-85, 90, 10))
SPHERE = np.array([[np.cos(u) * np.cos(a), np.cos(u) * np.sin(a), np.sin(u)] for u in UP for a in AZIMUTH])


@pytest.fixture(scope="module")
def driver(request, tmp_path_factory):
    """The page of a prediction, with a second group on it: ranks over a sphere, 1 to the south, 4 to the north."""
    site = request.getfixturevalue("maps_data").site
    along = np.linspace(0.0, 1.0, 50)
    levels = {"level [dBm]": -60 - 20 * along, BAND[0]: -65 - 20 * along, BAND[1]: -55 - 20 * along}
    route = Places(
        name="LW1 USRP1", at=np.column_stack([400 * along, 100 * along, 0 * along]), values=levels, time_s=along
    )
    rank = np.where(SPHERE[:, 1] > 0, 4.0, 1.0)
    sphere = Places(name="ranks", at=SPHERE, values={LIKELIEST: rank, "height [m]": SPHERE[:, 2]}, around=COMPASS)
    with_sphere = str(embedded(payload([route, sphere], site)))
    page = PAGES["prediction"](request.getfixturevalue)
    start_of = page.index('id="explorer-data">') + len('id="explorer-data">')
    path = tmp_path_factory.mktemp("places") / "prediction.html"
    path.write_text(page[:start_of] + with_sphere + page[page.index("</script>", start_of) :], encoding="utf-8")
    browser = start("--window-size=1440,1300")
    open_page(browser, path, READY)
    yield browser
    browser.quit()


def point_at(driver, x, y):
    box = driver.execute_script("const r = document.getElementById('map'); return [r.clientWidth, r.clientHeight]")
    from selenium.webdriver import ActionChains

    canvas = driver.find_element("id", "map")
    ActionChains(driver).move_to_element_with_offset(canvas, round(x - box[0] / 2), round(y - box[1] / 2)).perform()
    frame(driver)
    return driver.find_element("id", "here").text


def test_the_map_names_its_towers_and_reads_the_point_under_the_pointer(driver, maps_data):
    driver.execute_script("places.choose(0)")
    frame(driver)
    assert {label[4] for label in driver.execute_script("return places.labels()")} <= set(maps_data.site.towers)
    assert driver.execute_script("return places.labels().length") >= 1
    text = point_at(driver, *driver.execute_script("return places.drawn()[49]"))
    assert "400, 100, 0.0 m" in text
    assert "−80.0 dBm" in text
    assert driver.find_element("id", "along").is_displayed()
    (menu,) = driver.find_elements("css selector", "#saves select")
    assert menu.text.split() == ["Save", "as", "SVG", "PNG", "CSV"]
    (drawn,) = (text for name, text in saved(driver, "#saves select").items() if name.endswith(".svg"))
    assert drawn.count("A 3.5 3.5") == 2 * len(driver.execute_script("return places.drawn()"))  # circles in halves


def test_the_map_of_a_short_route_shows_the_towers_around_it(driver, maps_data):
    """Levels along a route do not explain themselves if the tower is outside the map. The route is 400 m long."""
    driver.execute_script("places.choose(0)")
    frame(driver)
    near = {
        name
        for name, tower in maps_data.site.towers.items()
        if -400 < tower.east_m < 800 and -400 < tower.north_m < 500
    }
    assert len(near) >= 2
    assert near <= {label[4] for label in driver.execute_script("return places.labels()")}


def test_a_saved_table_has_no_formula_of_a_name(driver):
    """The page saves tables like those that Python writes, and numbers stay numbers."""
    driver.execute_script("""
        const rows = () => [["=1+1", "a;@b", "plain"], [-1.5, null, "+2"]], menu = common.downloads(document.createElement("canvas"), "t", rows, () => {});
        menu.id = "guarded"; document.body.append(menu);
    """)
    text = saved(driver, "#guarded")["t.csv"]
    assert text == "'=1+1,a;'@b,plain\n-1.5,,'+2\n"


def test_directions_lie_on_a_sphere_that_turns(driver):
    """Seen from above, north is up and the zenith is in the middle. Seen from the side, the south is in the middle."""
    from selenium.webdriver import Keys

    choose(driver, "group", "ranks")
    driver.find_element("id", "view-above").click()
    frame(driver)
    wide, high = driver.execute_script(
        "const c = document.getElementById('map'); return [c.clientWidth, c.clientHeight]"
    )
    assert "85°" in point_at(driver, wide / 2 + 22, high / 2)
    north, south = point_at(driver, wide / 2, 0.2 * high), point_at(driver, wide / 2, 0.8 * high)
    assert "90°" in north
    assert "\n4" in north
    assert "270°" in south
    assert "\n1" in south
    colour = (
        "const r = devicePixelRatio, pen = document.getElementById('map').getContext('2d');"
        "return Array.from(pen.getImageData(arguments[0] * r, arguments[1] * r, 1, 1).data).slice(0, 3)"
    )
    top, bottom = (driver.execute_script(colour, wide / 2 + 12, share * high) for share in (0.22, 0.78))
    assert [top, bottom] == [list(bytes.fromhex(CLASS_COLOURS[rank][1:])) for rank in (4, 1)]
    driver.find_element("id", "view-side").click()
    frame(driver)
    assert "270°" in point_at(driver, wide / 2 + 22, high / 2)
    assert not driver.find_element("id", "along").is_displayed()
    driver.find_element("id", "map").send_keys(Keys.ARROW_RIGHT)
    assert driver.execute_script("return places.state.point") is not None


class TestPage(PageLaws):
    ready, views = READY, "#explorer canvas, #explorer select"
    static = ("#series table", ".if-no-script")

    def papers(self, driver):
        driver.execute_script("places.choose(0)")
        return papers(driver, "map")
