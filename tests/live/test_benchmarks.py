"""The benchmarks of the tap run, small; what they measure is theirs to say."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).resolve().parents[2] / "benchmarks"


def run(name, *arguments):
    command = [sys.executable, FOLDER / name, *arguments, "--json"]
    done = subprocess.run(command, text=True, capture_output=True, check=False, timeout=120)
    assert not done.stderr, done.stderr
    return done.returncode, json.loads(done.stdout)


@pytest.mark.parametrize("web", [False, True])
def test_sigkill(web):
    code, result = run("tap_sigkill.py", "--kills", "3", "--parallel", "3", *(["--web"] if web else []))
    assert code == 0
    assert result["kills"] == 3
    assert (result["lost"], result["corrupt"], result["out_of_order"]) == (0, 0, 0)
    assert (result["answers_shown"] > 0) == web


def test_the_page_while_the_tap_runs():
    _, result = run("tap_web_soak.py", "--simulated-s", "60", "--pace-s", "1", "--requests", "40")
    faults = ("web_lost", "web_out_of_order", "web_bad_lines", "web_holes", "other_content", "fuzz_lost")
    assert {key: result[key] for key in faults} == dict.fromkeys(faults, 0)
    assert min(result["web_rows_shown"]) > 0


def test_replug():
    code, result = run("tap_replug.py", "--cycles", "2")
    assert code == 0
    assert (result["lost"], result["cycles_in_a_gap_record"], result["gap_records"]) == (0, 2, 2)
    assert result["line_bytes_given"] == result["line_bytes_recorded"] > 0
    assert result["received_bytes"] == result["received_bytes_by_the_tap"]
