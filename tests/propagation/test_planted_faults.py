"""``benchmarks/planted_faults.py`` plants by text: each of its faults is still in the code."""

import subprocess
import sys
from pathlib import Path


def test_no_planted_fault_is_stale():
    script = Path(__file__).parents[2] / "benchmarks" / "planted_faults.py"
    said = subprocess.run([sys.executable, str(script), "--stale"], capture_output=True, text=True, timeout=120)
    assert said.returncode == 0, said.stderr
