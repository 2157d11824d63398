"""Faults are planted by text: each is still in the code, and the tests named beside it are there."""

import runpy
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("name", ["planted_faults", "outside_faults"])
def test_no_planted_fault_is_stale(name: str) -> None:
    script = ROOT / "benchmarks" / f"{name}.py"
    said = subprocess.run([sys.executable, str(script), "--stale"], capture_output=True, text=True, timeout=120)
    assert said.returncode == 0, said.stderr


def test_the_tests_named_for_a_fault_from_outside_are_there() -> None:
    faults = runpy.run_path(str(ROOT / "benchmarks" / "outside_faults.py"))["FAULTS"]
    assert len(faults) == 32
    assert sum(not fault.unseen for fault in faults) >= 21
    for fault in faults:
        for named in fault.tests.split():
            file, _, test = named.partition("::")
            assert f"def {test}" in (ROOT / file).read_text(encoding="utf-8"), named
