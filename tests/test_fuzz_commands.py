"""A short part of benchmarks/fuzz_commands.py; the long one is 10 000 command lines."""

import subprocess
import sys
from pathlib import Path

import pytest

DRIVER = Path(__file__).parents[1] / "benchmarks" / "fuzz_commands.py"


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="forks, and /dev/full")
def test_random_command_lines_end_in_a_message_and_a_code() -> None:
    command = [sys.executable, str(DRIVER), "--calls", "60", "--seed", "31"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.startswith("60 command lines, 0 violations")


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="forks, and /dev/full")
def test_a_planted_fault_is_seen(tmp_path: Path) -> None:
    planted = (
        "import sys, runpy, aerpaw_cmp.logs.ingest as place\n"
        "def fails(*_): raise ValueError('planted')\n"
        "place.account_rows = fails\n"
        f"sys.argv = ['x', '--calls', '40', '--seed', '31']; runpy.run_path({str(DRIVER)!r}, run_name='__main__')\n"
    )
    done = subprocess.run([sys.executable, "-c", planted], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "ValueError: planted" in done.stdout
