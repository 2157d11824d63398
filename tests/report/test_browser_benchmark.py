"""The page of the benchmark in a real browser: a model that is chosen is marked in every task."""

from pathlib import Path

import pytest

from aerpaw_cmp.report.benchmark_html import benchmark_page, task_table
from tests.report.browsing import choose, complaints, needs_browser, open_page, serious_findings, start

pytest.importorskip("selenium", reason="selenium is not installed")
pytestmark = needs_browser


def test_a_model_is_marked_in_every_task(tmp_path: Path) -> None:
    about = {"title": "Level", "rule": "Known: nothing.", "kind": "level", "flights": ["a"], "skipped": []}
    scores = {
        name: {"rmse_db": 3.0 + i, "rmse_ci95_db": (2.0, 5.0 + i)} for i, name in enumerate(("learned", "free_space"))
    }
    page = tmp_path / "benchmark.html"
    page.write_text(
        benchmark_page([task_table("one", about, scores), task_table("two", about, scores)], [], "now", "0")
    )
    driver = start("--window-size=1440,900")
    try:
        open_page(driver, page, "document.getElementById('entrant')")
        choose(driver, "entrant", "free space")
        marked = driver.execute_script("return [...document.querySelectorAll('.chosen')].map(e => e.dataset.entrant)")
        assert marked == ["free space"] * 6  # in each task the name, its whisker and its row
        driver.execute_script("document.querySelector('#two tr[data-entrant=\"learned antennas\"]').click()")
        assert driver.execute_script("return document.getElementById('entrant').value") == "learned antennas"
        assert complaints(driver) == []
        assert serious_findings(driver) == {}
    finally:
        driver.quit()
