"""The sample flight as files of one's own, from a checkout and from a wheel."""

import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.jobs import sample

ROOT = Path(__file__).parents[2]


def test_the_copy_is_the_sample(tmp_path: Path) -> None:
    flight = sample.write_sample(tmp_path / "mine")
    for path in sorted((ROOT / "sample_logs").rglob("*")):
        if path.is_file() and path.name != "SHA256SUMS":
            assert (tmp_path / "mine" / path.relative_to(ROOT / "sample_logs")).read_bytes() == path.read_bytes()
    from aerpaw_cmp.flight.settings import load_flight

    assert load_flight(flight).flight.synthetic


def test_a_folder_of_others_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(UsageError):
        sample.write_sample(tmp_path)
    assert (tmp_path / "notes.txt").read_text() == "mine"


def test_a_wheel_holds_the_samples(tmp_path: Path) -> None:
    pytest.importorskip("hatchling", reason="hatchling is not installed")
    code = "import sys; from hatchling.build import build_wheel; print(build_wheel(sys.argv[1]))"
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path)], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    names = zipfile.ZipFile(next(tmp_path.glob("*.whl"))).namelist()
    assert "aerpaw_cmp/sample_logs/flight.yaml" in names
    assert any(name.startswith("aerpaw_cmp/sample_logs/UAV/") for name in names)
    assert "aerpaw_cmp/report/templates/explorer.js" in names
    assert "aerpaw_parsers/__init__.py" in names


def test_without_samples_the_message_says_where_they_were_looked_for(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(sample, "PACKAGED", tmp_path / "a")
    monkeypatch.setattr(sample, "CHECKOUT", tmp_path / "b")
    with pytest.raises(UsageError, match="is missing"):
        sample.sample_folder()
