"""The example of docs/adding_a_reader.md as a separate package, found by its entry point."""

import json
import os
import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

GUIDE = Path(__file__).parents[2] / "docs" / "adding_a_reader.md"


def block(language: str) -> str:
    match = re.search(rf"```{language}\n(.*?)```", GUIDE.read_text(), re.DOTALL)
    assert match
    return match[1]


@pytest.fixture
def installed(tmp_path: Path) -> Path:
    """A folder as pip leaves it: the module and the metadata with its entry point."""
    (tmp_path / "my_monitor.py").write_text(block("python") + "\nREADERS = (READER,)\n")
    info = tmp_path / "my_monitor-0.1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: my-monitor\nVersion: 0.1\n")
    group, point = re.findall(
        r"^(?:\[project\.entry-points\.\"(.*)\"\]|(monitor = \".*\").*)$", block("toml"), re.MULTILINE
    )
    (info / "entry_points.txt").write_text(f"[{group[0]}]\n{point[1].replace(chr(34), '')}\n")
    return tmp_path


def ask(installed: Path, *words: str) -> subprocess.CompletedProcess[str]:
    paths = [str(installed), *[path for path in sys.path if path]]
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
    return subprocess.run(
        [sys.executable, "-m", "aerpaw_cmp", *words], capture_output=True, text=True, env=env, check=False
    )


def test_a_reader_of_another_package_reads_its_sample(installed: Path) -> None:
    sample = installed / "monitor.txt"
    sample.write_text(block("text"))
    answer = ask(installed, "ingest", "--json", "--timezone", "America/New_York", str(sample))
    assert answer.returncode == 0, answer.stderr
    (file,) = json.loads(answer.stdout)["files"]
    assert file["reader"] == "monitor"
    assert (file["lines"], file["accepted"], file["rejected"], file["blank"]) == (4, 2, 1, 1)
    assert file["streams"][0]["start"].startswith("2025-03-02T15:00:00.25")


def test_a_reader_of_lines_states_where_its_clock_and_its_heights_come_from(installed: Path) -> None:
    reader = runpy.run_path(str(installed / "my_monitor.py"))["READER"]
    assert reader.clock_from == "program: spectrum monitor"
    assert reader.height_from == "assumed: above take-off"


def test_a_reader_with_a_known_name_is_refused(installed: Path) -> None:
    module = installed / "my_monitor.py"
    module.write_text(module.read_text().replace('name="monitor"', 'name="sounder_log"'))
    answer = ask(installed, "formats")
    assert answer.returncode == 2
    assert "two installed readers share the name 'sounder_log'" in answer.stderr


@pytest.mark.parametrize(
    ("old", "new", "code"),
    [
        ("yield rows.stream(", "raise KeyError('level')\n    yield rows.stream(", 3),
        ('"""Spectrum monitor', 'raise RuntimeError("no")\n"""Spectrum monitor', 2),
        ("READERS = (READER,)", "from dataclasses import replace\nREADERS = (replace(READER, sniff=lambda head: head['x']),)", 2),
    ],
    ids=["read", "import", "sniff"],
)  # fmt: skip
def test_an_exception_of_a_plug_in_names_the_plug_in(installed: Path, old: str, new: str, code: int) -> None:
    module = installed / "my_monitor.py"
    module.write_text(module.read_text().replace(old, new, 1))
    (installed / "monitor.txt").write_text(block("text"))
    answer = ask(installed, "ingest", "--timezone", "America/New_York", str(installed / "monitor.txt"))
    assert answer.returncode == code, answer.stderr
    assert "the plug-in 'monitor' failed" in answer.stderr
    assert "fault of the program" not in answer.stderr


def test_the_guide_keeps_its_promise_of_length() -> None:
    code = [line for line in block("python").splitlines() if line.strip()]
    assert len(code) <= 40
