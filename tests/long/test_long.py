"""Long tests: fuzzing, kills, injected faults and mutation. ``make test`` runs short parts, ``pytest -m long`` all."""

import json
import os
import runpy
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
LINUX = sys.platform.startswith("linux")

# Options with which each script finishes within minutes. {folder} is replaced by a temporary folder.
SHORT = {
    "fuzz_commands": "--calls 20",
    "fuzz_inputs": "--inputs 20",
    "interrupts": "--only formats --moments 2",
    "mutation": "record {folder}/map.json --tests tests/compare/test_offset.py",
    "output_faults": "--kills 5",
    "outside_faults": "--only 'take-off ground not added to the track' --no-tests",
    "planted_faults": "--only foliage --every 20",
    "tap_replug": "--quick",
    "tap_sigkill": "--quick",
    "tap_web_soak": "--quick",
}


def output_of(name: str, options: str, limit_s: float = 300.0) -> str:
    """Return what a script prints that finds no violation."""
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    command = [sys.executable, "-m", f"tests.long.{name}", *shlex.split(options)]
    done = subprocess.run(
        command, cwd=ROOT, env=os.environ | threads, capture_output=True, text=True, check=False, timeout=limit_s
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_every_script_has_short_options() -> None:
    scripts = {path.stem for path in HERE.glob("*.py")} - {"conftest", "tap_common", "test_long"}
    assert set(SHORT) == scripts


@pytest.mark.long
@pytest.mark.parametrize("name", SHORT)
def test_a_script_finds_no_violation(name: str, tmp_path: Path) -> None:
    output_of(name, SHORT[name].replace("{folder}", str(tmp_path)), limit_s=1800.0)


@pytest.mark.skipif(not LINUX or not shutil.which("cc"), reason="needs Linux and a C compiler")
def test_outputs_are_whole_after_kills_and_errors() -> None:
    counts = json.loads(output_of("output_faults", "--kills 6 --seed 3 --jobs 'site import'"))
    assert counts["n"] == 0
    assert counts["total"]["killed"] >= 4
    assert counts["total"]["full"] == counts["total"]["broken"] == counts["jobs"]["site import"]["calls"] > 5
    assert counts["planted_fault"]["violations"] > 0


@pytest.mark.skipif(not LINUX, reason="forks, and /dev/full")
def test_random_command_lines_end_in_a_message_and_a_code() -> None:
    said = output_of("fuzz_commands", "--calls 12 --seed 31")  # the full run has 10 000 calls
    assert said.startswith("12 command lines, 0 violations")


def test_the_files_and_tests_of_the_mutation_script_exist() -> None:
    lists = runpy.run_path(str(HERE / "mutation.py"))
    for named in lists["_BEAMS"]:
        path, _, test = named.partition("::")
        assert f"def {test.partition('[')[0]}(" in (ROOT / path).read_text(), named
    assert all((ROOT / path).is_file() for path in lists["modules"]())


@pytest.mark.parametrize("name", ["planted_faults", "outside_faults"])
def test_the_line_that_each_fault_changes_is_still_in_the_code(name: str) -> None:
    output_of(name, "--stale")


def test_the_tests_that_catch_a_fault_exist() -> None:
    faults = runpy.run_path(str(HERE / "outside_faults.py"))["FAULTS"]
    assert len(faults) == 32
    assert sum(not fault.unseen for fault in faults) >= 21
    for fault in faults:
        for named in fault.tests.split():
            file, _, test = named.partition("::")
            assert f"def {test}" in (ROOT / file).read_text(encoding="utf-8"), named
