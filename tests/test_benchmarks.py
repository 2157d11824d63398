"""Benchmarks are run rarely: that each still comes to its end is asked by ``make bench-check``, which must know all."""

import runpy
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


@pytest.fixture(scope="module")
def every() -> dict:
    return runpy.run_path(str(BENCHMARKS / "all.py"))


def test_the_check_runs_every_benchmark(every: dict) -> None:
    assert set(every["SMALLEST"]) == {path.stem for path in BENCHMARKS.glob("*.py")}
    assert set(every["ON_FIELD_DATA"]) <= set(every["SMALLEST"])


def test_a_benchmark_that_fails_is_told_and_does_not_stop_the_others(
    every: dict, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(every["SMALLEST"], "kriging", ["--no-such-option"])
    assert every["check"](["kriging", "tap_common"]) == 1
    said = capsys.readouterr().out.splitlines()
    assert "unrecognized arguments: --no-such-option" in said[0]
    assert said[1].endswith("done")


def test_what_needs_the_field_data_is_left_out_without(
    every: dict, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("AERPAW_CMP_FIELD_DATA", raising=False)
    assert every["check"](["learned_map"]) == 0
    assert "left out: AERPAW_CMP_FIELD_DATA is not set" in capsys.readouterr().out
