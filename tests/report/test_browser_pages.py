"""Pages in a real browser: the first words of each above the fold; a model that is chosen marked in every task."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from aerpaw_cmp.report.benchmark_html import benchmark_page, task_table
from tests.report.browsing import choose, complaints, needs_browser, open_page, serious_findings, start
from tests.report.shown import PAGES

pytestmark = needs_browser


@pytest.fixture(scope="module")
def driver() -> Iterator[Any]:
    browser = start("--window-size=1440,900")
    yield browser
    browser.quit()


def test_a_model_is_marked_in_every_task(driver: Any, tmp_path: Path) -> None:
    about = {"title": "Level", "rule": "Known: nothing.", "kind": "level", "flights": ["a"], "skipped": []}
    scores = {
        name: {"rmse_db": 3.0 + i, "rmse_ci95_db": (2.0, 5.0 + i)} for i, name in enumerate(("learned", "free_space"))
    }
    page = tmp_path / "benchmark.html"
    page.write_text(
        benchmark_page([task_table("one", about, scores), task_table("two", about, scores)], [], "now", "0")
    )
    open_page(driver, page, "document.getElementById('entrant')")
    choose(driver, "entrant", "free space")
    marked = driver.execute_script("return [...document.querySelectorAll('.chosen')].map(e => e.dataset.entrant)")
    assert marked == ["free space"] * 6  # in each task the name, its whisker and its row
    driver.execute_script("document.querySelector('#two tr[data-entrant=\"learned antennas\"]').click()")
    assert driver.execute_script("return document.getElementById('entrant').value") == "learned antennas"
    assert complaints(driver) == []
    assert serious_findings(driver) == {}


@pytest.mark.parametrize("page", PAGES)
def test_the_first_words_need_no_scrolling(
    page: str, driver: Any, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    path = tmp_path / f"{page}.html"
    path.write_text(PAGES[page](request.getfixturevalue), encoding="utf-8")
    for width, height in ((1440, 900), (390, 844)):
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
        assert "Next: " in text
        assert "`" not in text
