"""Pages in a real browser: the first words of each above the fold; a model that is chosen marked in every task."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.report.browsing import needs_browser, start
from tests.report.shown import PAGES

pytestmark = needs_browser


@pytest.fixture(scope="module")
def driver() -> Iterator[Any]:
    browser = start("--window-size=1440,900")
    yield browser
    browser.quit()


@pytest.mark.parametrize("page", PAGES)
def test_the_first_words_need_no_scrolling(
    page: str, driver: Any, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    path = tmp_path / f"{page}.html"
    path.write_text(PAGES[page](request.getfixturevalue), encoding="utf-8")
    for width, height in ((1440, 900), (1024, 800), (390, 844)):
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 500}
        driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        driver.get(path.as_uri())
        text, bottom, wide = driver.execute_script(
            "const v = document.querySelector('.verdict');"
            "return [v.textContent, v.getBoundingClientRect().bottom, document.documentElement.scrollWidth]"
        )
        assert bottom < 0.75 * height  # the first picture or table begins above the fold, too
        assert wide <= width
        assert any(unit in text for unit in (" dB", " %"))
        assert "Next: " in text or page == "report"  # a flight has one next step or none
        assert "`" not in text
