"""Pages in a real browser: the summary is visible without scrolling, no page is wider than the window, dark scheme."""

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib.image
import numpy as np
import pytest

from aerpaw_cmp.report.site import viewer
from tests.report.browsing import (
    complaints,
    needs_browser,
    open_page,
    saves_every_chart,
    serious_findings,
    set_scheme,
    set_width,
    start,
)
from tests.report.shown import PAGES

pytestmark = needs_browser


@pytest.fixture(scope="module")
def driver() -> Iterator[Any]:
    browser = start("--window-size=1440,900")
    yield browser
    browser.quit()


@pytest.fixture
def path(page: str, tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    """Return the written file of a page."""
    path = tmp_path / f"{page}.html"
    path.write_text(PAGES[page](request.getfixturevalue), encoding="utf-8")
    return path


@pytest.mark.parametrize("page", PAGES)
def test_the_first_words_need_no_scrolling(page: str, path: Path, driver: Any) -> None:
    for width, height in ((1440, 900), (1024, 800), (390, 844)):
        set_width(driver, width, height, mobile=width < 500)
        driver.get(path.as_uri())
        text, bottom, wide = driver.execute_script(
            "const v = document.querySelector('.verdict');"
            "return [v.textContent, v.getBoundingClientRect().bottom, document.documentElement.scrollWidth]"
        )
        assert bottom < 0.75 * height  # the first picture or table begins above the fold, too
        assert wide <= width
        assert any(unit in text for unit in (" dB", " %"))
        assert "Next: " in text or page == "report"  # one next step or none
        assert "`" not in text


@pytest.mark.parametrize("page", PAGES)
def test_no_page_has_a_serious_finding_of_accessibility(page: str, path: Path, driver: Any) -> None:
    driver.get(path.as_uri())
    assert serious_findings(driver) == {}


@pytest.mark.parametrize("page", PAGES)
def test_no_page_is_wider_than_its_window_or_light_in_the_dark(page: str, path: Path, driver: Any) -> None:
    """Every fold open: what is wide scrolls in its own box, and a drawn figure is dark on a dark page."""
    if page == "report":  # the charts of its folds are drawn by a script
        open_page(driver, path, "window.explorer")
    else:
        driver.get(path.as_uri())
    driver.execute_script("document.querySelectorAll('details').forEach(d => { d.open = true; })")
    for scheme in ("light", "dark"):
        set_scheme(driver, scheme)
        for width in (390, 1024, 1440):
            set_width(driver, width)
            assert driver.execute_script("return document.documentElement.scrollWidth") <= width
        figures = driver.find_elements("css selector", "figure img")[:2]
        for shown in [driver.find_element("css selector", ".kicker"), *figures]:
            pixels = matplotlib.image.imread(io.BytesIO(shown.screenshot_as_png))[..., :3]
            assert (np.median(pixels) < 0.2) == (scheme == "dark")
    set_scheme(driver)


def test_the_view_of_a_site_can_be_saved(driver: Any, tmp_path: Path, report_data: Any) -> None:
    """The table contains the corners of all objects, also of round tree crowns."""
    path = tmp_path / "site.html"
    path.write_text(viewer(report_data.site), encoding="utf-8")
    open_page(driver, path, "shape")
    files = saves_every_chart(driver)
    (picture,) = (text for name, text in files.items() if name.endswith(".svg"))
    assert picture.count(" A ") >= 2 * (len(report_data.site.trees) + len(report_data.site.towers))
    (table,) = (text.splitlines() for name, text in files.items() if name.endswith(".csv"))
    assert {row.split(",")[0] for row in table[1:]} == {"tower", "building", "tree", "forest", "geofence"}
    for scheme in ("light", "dark"):
        set_scheme(driver, scheme)
        drawn = matplotlib.image.imread(io.BytesIO(driver.find_element("id", "view").screenshot_as_png))[..., :3]
        assert (np.median(drawn) < 0.2) == (scheme == "dark")
    set_scheme(driver)
    assert complaints(driver) == []
