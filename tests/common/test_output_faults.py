"""A short part of benchmarks/output_faults.py: kills and disk errors under two commands, and a planted fault."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

DRIVER = Path(__file__).resolve().parents[2] / "benchmarks" / "output_faults.py"


@pytest.mark.skipif(sys.platform != "linux" or not shutil.which("cc"), reason="needs Linux and a C compiler")
def test_outputs_are_whole_after_kills_and_errors() -> None:
    command = [sys.executable, str(DRIVER), "--kills", "10", "--seed", "3", "--jobs", "site import"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    found = json.loads(done.stdout)
    assert found["n"] == 0
    assert found["total"]["killed"] >= 8
    assert found["total"]["full"] == found["total"]["broken"] == found["jobs"]["site import"]["calls"] > 5
    assert found["planted_fault"]["violations"] > 0
