"""Benchmarks are run rarely: ``make bench-check`` must list all of them."""

import json
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks import freeze, kriging

ROOT = Path(__file__).parents[1]
BENCHMARKS = ROOT / "benchmarks"


@pytest.fixture(scope="module")
def every() -> dict:
    return runpy.run_path(str(BENCHMARKS / "all.py"))


def test_the_check_runs_every_benchmark(every: dict) -> None:
    assert set(every["SMALLEST"]) == {path.stem for path in BENCHMARKS.glob("*.py")} | {"published"}
    assert set(every["ON_FIELD_DATA"]) <= set(every["SMALLEST"])


def test_a_benchmark_that_fails_is_told_and_does_not_stop_the_others(
    every: dict, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(every["SMALLEST"], "kriging", ["--no-such-option"])
    assert every["check"](["kriging", "simulated_modem"]) == 1
    said = capsys.readouterr().out.splitlines()
    assert "unrecognized arguments: --no-such-option" in said[0]
    assert said[1].endswith("done")


def test_what_needs_the_field_data_is_left_out_without(
    every: dict, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("AERPAW_CMP_FIELD_DATA", raising=False)
    assert every["check"](["learned_map"]) == 0
    assert "left out: AERPAW_CMP_FIELD_DATA is not set" in capsys.readouterr().out


def test_both_sides_of_kriging_agree(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("pykrige")
    monkeypatch.setattr(sys, "argv", ["kriging.py", "--quick"])
    kriging.main()
    report = json.loads(capsys.readouterr().out)
    assert report["leave_one_out"]["largest_difference"] < 1e-9
    assert report["leave_one_out"]["systems"] == 100 * 27
    assert report["moving_window"]["largest_difference_C"] < 1e-9


@pytest.mark.parametrize(
    ("after", "status"),
    [
        ({}, 0),
        ({"report, rss.csv|lines": np.array(["level", "-48"])}, 1),
        ({"channel, h|table": np.array([1.0, 3.0])}, 1),
    ],
)
def test_records_of_tables_differ_by_a_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], after: dict, status: int
) -> None:
    before = {"report, rss.csv|lines": np.array(["level", "-47"]), "channel, h|table": np.array([np.nan, 2.0])}
    np.savez(tmp_path / "before.npz", **before)
    np.savez(tmp_path / "after.npz", **before | after)
    monkeypatch.setattr(
        sys, "argv", ["freeze.py", "compare", *map(str, (tmp_path / "before.npz", tmp_path / "after.npz"))]
    )
    assert freeze.main() == status
    assert all(name in capsys.readouterr().out for name in after)
