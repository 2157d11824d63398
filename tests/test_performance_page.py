"""docs/performance.md is what the history of benchmark runs says, and nothing else."""

import copy
import json
from pathlib import Path
from typing import Any

import pytest

from benchmarks import performance

ROOT = Path(__file__).parents[1]
pytestmark = pytest.mark.skipif(
    not (ROOT / "benchmarks" / "history.jsonl").is_file(), reason="no history yet: make bench-all makes it"
)


def test_the_page_is_made_from_the_history() -> None:
    history = performance.runs(performance.HISTORY)
    assert (ROOT / "docs" / "performance.md").read_text(encoding="utf-8") == performance.page(history)


def test_every_axis_has_a_title_and_what_was_not_measured_is_said() -> None:
    run = performance.last_whole(performance.runs(performance.HISTORY))
    scaling = run["benchmarks"]["scaling"]["result"]
    assert set(scaling) <= set(performance.AXES)
    text = performance.page([run])
    for axis, result in scaling.items():
        assert f"### {performance.AXES[axis][0]}" in text
        for row in result["rows"]:
            assert row.get("refused", "|") in text


def test_the_page_says_what_failed_and_how_far_it_extrapolates(tmp_path: Path) -> None:
    run: dict[str, Any] = copy.deepcopy(performance.last_whole(performance.runs(performance.HISTORY)))
    rows = [{"size": s, "faces": s, "cpu_s": s**1.5 / 1000, "wall_s": 1.0, "peak_mib": 100.0} for s in (100, 1000)]
    run["benchmarks"]["scaling"]["result"]["faces"] = {"rows": rows, "power_cpu": 1.5, "power_memory": 0.0}
    run["benchmarks"]["map"] = {"seconds": 1.0, "load_before": 0.0, "failed": "no disk"}
    history = tmp_path / "history.jsonl"
    history.write_text(json.dumps(run) + "\n", encoding="utf-8")
    text = performance.page(performance.runs(history))
    assert "Not measured: map: no disk." in text
    assert "50 times beyond the largest scene" in text
    assert performance.number(50_000**1.5 / 1000) + " s of processor" in text
    with pytest.raises(SystemExit, match="no run"):
        performance.last_whole([])
