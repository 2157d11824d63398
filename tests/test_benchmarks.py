"""Benchmarks are run rarely: ``make bench-check`` must know all; short parts of those that look for faults run here."""

import json
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks import freeze, kriging

ROOT = Path(__file__).parents[1]
BENCHMARKS = ROOT / "benchmarks"
LINUX = sys.platform.startswith("linux")


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


def said_by(name: str, *options: str) -> str:
    """What a benchmark says that finds no fault."""
    command = [sys.executable, str(BENCHMARKS / f"{name}.py"), *options]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_both_sides_of_kriging_agree(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("pykrige")
    monkeypatch.setattr(sys, "argv", ["kriging.py", "--quick"])
    kriging.main()
    report = json.loads(capsys.readouterr().out)
    assert report["leave_one_out"]["largest_difference"] < 1e-9
    assert report["leave_one_out"]["systems"] == 100 * 27
    assert report["moving_window"]["largest_difference_C"] < 1e-9


@pytest.mark.skipif(not LINUX or not shutil.which("cc"), reason="needs Linux and a C compiler")
def test_outputs_are_whole_after_kills_and_errors() -> None:
    counts = json.loads(said_by("output_faults", "--kills", "6", "--seed", "3", "--jobs", "site import"))
    assert counts["n"] == 0
    assert counts["total"]["killed"] >= 4
    assert counts["total"]["full"] == counts["total"]["broken"] == counts["jobs"]["site import"]["calls"] > 5
    assert counts["planted_fault"]["violations"] > 0


@pytest.mark.skipif(not LINUX, reason="forks, and /dev/full")
def test_random_command_lines_end_in_a_message_and_a_code() -> None:
    said = said_by("fuzz_commands", "--calls", "12", "--seed", "31")  # the long run is of 10 000
    assert said.startswith("12 command lines, 0 violations")


@pytest.mark.parametrize("name", ["planted_faults", "outside_faults"])
def test_no_planted_fault_is_stale(name: str) -> None:
    """Faults are planted by text, which must still be in the code."""
    said_by(name, "--stale")


def test_the_tests_named_for_a_fault_from_outside_are_there() -> None:
    faults = runpy.run_path(str(BENCHMARKS / "outside_faults.py"))["FAULTS"]
    assert len(faults) == 32
    assert sum(not fault.unseen for fault in faults) >= 21
    for fault in faults:
        for named in fault.tests.split():
            file, _, test = named.partition("::")
            assert f"def {test}" in (ROOT / file).read_text(encoding="utf-8"), named


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
