"""docs/performance.md is what the history of benchmark runs says, and nothing else."""

from pathlib import Path

import pytest

from benchmarks import performance

ROOT = Path(__file__).parents[1]
pytestmark = pytest.mark.skipif(
    not (ROOT / "benchmarks" / "history.jsonl").is_file(), reason="no history yet: make bench-all makes it"
)


def test_the_page_is_made_from_the_history() -> None:
    history = performance.runs(performance.HISTORY)
    assert (ROOT / "docs" / "performance.md").read_text(encoding="utf-8") == performance.page(history)
