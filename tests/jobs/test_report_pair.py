"""Two runs of ``report`` on one small flight: their exports, and their ``diff``."""

import json
from pathlib import Path

import pandas as pd
import pytest

from aerpaw_cmp.__main__ import main
from tests.simulated import planned, simulate, write_yaml

SETTINGS = planned(
    "small", [(-40, 10, 30), (-250, 60, 30), (-100, 260, 40)], {"LW1": {"USRP1": 12.3}}, ranks=True,
    plan={"rss_interval_s": 0.5, "rank_k": 10, "rank_interval_s": 1.0, "fading_db": 1.0, "fading_correlation_s": 0.5},
    rt={"max_depth": 1, "audit_links": 0}, rank={"k": [10, 100]},
)  # fmt: skip


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Write one report with a reflection and one without. The first also has samples.kmz."""
    folder = tmp_path_factory.mktemp("pair")
    path = write_yaml(folder / "flight.yaml", SETTINGS)
    simulate(path)
    out = folder / "with", folder / "without"
    words = ["--figures", "none", "--quiet"]
    assert main(["report", str(path), "-o", str(out[0]), "--kmz", *words]) == 0
    write_yaml(path, {**SETTINGS, "rt": {"max_depth": 0, "audit_links": 0}})
    assert main(["report", str(path), "-o", str(out[1]), *words]) == 0
    return out


def test_the_kmz_is_part_of_the_report(pair: tuple[Path, Path]) -> None:
    assert "samples.kmz" in (pair[0] / "SHA256SUMS").read_text(encoding="utf-8")
    assert "samples.kmz" in (pair[0] / "report.html").read_text(encoding="utf-8")
    assert not (pair[1] / "samples.kmz").exists(), "nobody asked for it"
    assert json.loads((pair[0] / "metrics.json").read_text(encoding="utf-8"))["stages"]["kmz_s"] > 0


def test_diff_of_two_runs_names_the_setting_and_the_levels(pair: tuple[Path, Path]) -> None:
    from aerpaw_cmp.jobs.diff_reports import run_diff

    difference = run_diff(*pair)
    assert [(*e.values(),) for e in difference.settings] == [("rt.max_depth", 1, 0)]
    assert [(e["role"], e["what"]) for e in difference.inputs] == [("flight file", "changed")]
    assert difference.versions == ()
    (level,) = difference.levels
    tables = [pd.read_csv(folder / "rss.csv") for folder in pair]
    moved = tables[1]["simulated_dbm"] - tables[0]["simulated_dbm"]
    assert level.simulated_max_db == pytest.approx(moved.abs().max())
    assert level.simulated_max_db > 1, "the ground ray is gone"
    assert level.samples.common == len(tables[0])
    # simulated with the ground ray: without it the replay is worse
    assert level.rmse.difference_db > 0
    assert level.rmse.other_rmse_db == pytest.approx(1.0, abs=0.3), "the fading of the plan"
    assert difference.pooled is not None
    assert difference.pooled.difference_db == pytest.approx(level.rmse.difference_db)
    assert run_diff(pair[0], pair[0]).differences == ()
