"""The notebooks of docs/examples run as they stand, and hold the outputs of a run."""

import json
import os
import re
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from aerpaw_cmp.__main__ import main

FOLDER = Path(__file__).parents[1] / "docs" / "examples"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
SIONNA = FOLDER / "score_sionna.ipynb"


def cells(path: Path) -> list[dict[str, object]]:
    return [cell for cell in json.loads(path.read_text())["cells"] if cell["cell_type"] == "code"]


def source_of(cell: dict[str, object]) -> str:
    """Return the code of a cell, with each command line as a call of ``run_command``."""
    lines: list[str] = [line for line in cell["source"] if not line.startswith("%")]  # type: ignore[attr-defined]
    return "".join(re.sub(r"^!aerpaw-cmp (.*)$", r"run_command(f'\1')", line) for line in lines)


def run_command(line: str) -> None:
    """Run a command in this process, because each start of Python would import all packages again."""
    assert main(shlex.split(line)) == 0


def test_there_are_seven() -> None:
    assert len(NOTEBOOKS) == 7


@pytest.mark.parametrize("path", [p for p in NOTEBOOKS if p != SIONNA], ids=lambda path: path.stem)
def test_a_notebook_runs(path: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "a folder").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "a folder"))
    monkeypatch.chdir(FOLDER)
    monkeypatch.setenv("MPLBACKEND", "Agg")
    scope: dict[str, object] = {"__name__": "notebook", "run_command": run_command}
    for cell in cells(path):
        exec(compile(source_of(cell), str(path), "exec"), scope)


@pytest.mark.sionna
def test_the_notebook_with_sionna_runs(sionna: object, tmp_path: Path) -> None:
    """Trace every twelfth pose. The cells run in another process, because scenes would stay in memory."""
    source = "\n".join(["from tests.test_examples import run_command", *map(source_of, cells(SIONNA))])
    thinned = source.replace("track = flight.track\n", "track = flight.track[::12]\n")
    assert thinned != source
    check = "assert len(card['levels']) == 5 and gain.shape[1] == 5 and (gain > 0).mean() > 0.95"
    lines = [sys.executable, "-c", f"{thinned}\n{check}"]
    (tmp_path / "a folder").mkdir()
    environment = {**os.environ, "MPLBACKEND": "Agg", "TMPDIR": str(tmp_path / "a folder")}
    subprocess.run(lines, cwd=FOLDER, env=environment, check=True)


def test_the_code_of_the_python_page_runs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "sample_logs").symlink_to(FOLDER.parents[1] / "sample_logs")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "Agg")
    parts = re.findall(r"^```python\n(.*?)^```", (FOLDER.parent / "api.md").read_text(), re.MULTILINE | re.DOTALL)
    assert len(parts) == 3
    scope: dict[str, object] = {"__name__": "page"}
    for part in parts:
        exec(compile(part, "docs/api.md", "exec"), scope)
    assert (tmp_path / "level.png").stat().st_size > 10_000


def test_notebooks_import_public_names_only() -> None:
    lines = "".join(source_of(cell) for path in NOTEBOOKS for cell in cells(path)).splitlines()
    internal = {line.split("  #")[0] for line in lines if re.match(r"(from|import) aerpaw_cmp\.", line)}
    # a machine with several LLVM versions needs this one before Sionna RT is imported
    assert internal == {"from aerpaw_cmp.propagation.search.sionna import load_variant"}


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_holds_its_outputs(path: Path) -> None:
    outputs = [output for cell in cells(path) for output in cell["outputs"]]  # type: ignore[attr-defined]
    assert any("image/png" in output.get("data", {}) for output in outputs)
    assert not any(output["output_type"] == "error" for output in outputs)
    assert path.stat().st_size < 300_000
