"""A report without its audit says so, and ``audit`` fills it in from the same inputs, whole or not at all."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
import yaml

from aerpaw_cmp.cli import main
from aerpaw_cmp.common.errors import InputError, UsageError
from aerpaw_cmp.jobs import run
from aerpaw_cmp.jobs.options import RunOptions
from aerpaw_cmp.jobs.reporting import audit_flight
from aerpaw_cmp.jobs.reporting.later_audit import earlier_report

SAMPLE = Path(__file__).parents[2] / "sample_logs"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with a short flight of one tower and channel, and its report without an audit."""
    folder = tmp_path_factory.mktemp("later")
    content = yaml.safe_load((SAMPLE / "flight.yaml").read_text(encoding="utf-8"))
    content["logs"] = content["logs"][:2]
    content["link"].pop("channels")
    content |= {"rss": {"lag": "off"}, "report": {"audit": "later"}}
    content["rt"] = {"engine": "image", "max_depth": 1, "audit_links": 5}
    content["site"] = {"file": "lake_wheeler", "without_buildings": True}
    (folder / "flight.yaml").write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    for log in content["logs"]:
        (folder / log["path"]).parent.mkdir(exist_ok=True)
        shutil.copy(SAMPLE / log["path"], folder / log["path"])
    run.run_report(folder / "flight.yaml", run.ReportOptions(figures="none"), RunOptions(out=folder / "first"))
    return folder


@pytest.fixture
def report(made: Path, tmp_path: Path) -> Path:
    """A copy of all of it to change; gives the report's folder."""
    shutil.copytree(made, tmp_path / "copy")
    return tmp_path / "copy" / "first"


@pytest.fixture(autouse=True)
def no_other_engine(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The audit without Sionna: how often it was asked for, with how many links."""
    asked: list[int] = []

    def audit(data: Any, _replays: Any, _results: Any, _progress: Any) -> None:
        asked.append(data.settings.rt.audit_links)

    monkeypatch.setattr(audit_flight, "_audit", audit)
    return asked


def test_the_page_says_that_it_is_not_audited_yet_and_strict_fails(
    made: Path, no_other_engine: list[int], capsys: pytest.CaptureFixture[str]
) -> None:
    metrics = json.loads((made / "first" / "metrics.json").read_text(encoding="utf-8"))
    page = (made / "first" / "report.html").read_text(encoding="utf-8")
    assert metrics["rt"]["audit"] is None
    assert metrics["rt"]["links"] > 100
    assert metrics["audit_command"].startswith("aerpaw-cmp audit ")
    assert "Not audited yet" in page
    assert "audit pending" in page
    assert main(["report", str(made / "flight.yaml"), "-o", str(made / "strict"), "--figures", "none", "--strict"]) == 1
    said = capsys.readouterr()
    assert "note: audit pending; run" in said.err
    assert f"next: aerpaw-cmp audit {made / 'strict'}" in said.out
    assert no_other_engine == [], "nothing of the audit runs before it is asked for"


def test_audit_fills_it_in_and_keeps_the_numbers(report: Path, no_other_engine: list[int]) -> None:
    before = json.loads((report / "metrics.json").read_text(encoding="utf-8"))
    assert main(["audit", str(report), "--strict"]) == 0
    after = json.loads((report / "metrics.json").read_text(encoding="utf-8"))
    assert no_other_engine == [5]
    assert after["audit_command"] == ""
    for key in ("rss", "rank", "inputs", "flight", "ladder", "clock"):
        a, b = ({**m[key]} if isinstance(m[key], dict) else m[key] for m in (before, after))
        if key == "ladder":
            a, b = ([{k: v for k, v in row.items() if k != "seconds"} for row in rows] for rows in (a, b))
        assert a == b, key
    assert "Not audited yet" not in (report / "report.html").read_text(encoding="utf-8")
    assert sorted(p.name for p in report.iterdir()) == [
        "SHA256SUMS",
        "metrics.json",
        "rank.csv",
        "report.html",
        "rss.csv",
    ]


def test_audit_of_a_flight_file_finds_its_report(report: Path, no_other_engine: list[int]) -> None:
    run.run_audit(report.parent / "flight.yaml", RunOptions(out=report), links="7")
    assert no_other_engine == [7]


@pytest.mark.parametrize("name", ["LW1/USRP1_power_log.txt", "flight.yaml"])
def test_a_changed_input_is_refused_and_the_report_stays(report: Path, name: str) -> None:
    path, before = report.parent / name, (report / "metrics.json").read_bytes()
    path.write_bytes(path.read_bytes() + b"\n")
    with pytest.raises(InputError, match="changed since the report was made"):
        run.run_audit(report)
    assert (report / "metrics.json").read_bytes() == before


def test_what_is_no_report_is_named(report: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no report there"):
        run.run_audit(tmp_path)
    with pytest.raises(UsageError, match="links"):
        run.run_audit(report, links="none")
    with pytest.raises(UsageError, match="-o beside the folder"):
        run.run_audit(report, RunOptions(out=tmp_path))
    (report.parent / "flight.yaml").rename(tmp_path / "elsewhere.yaml")
    with pytest.raises(InputError, match="there is no such flight file"):
        run.run_audit(report)
    for content in ("{}", "[1]", "{", '{"made_from": {"flight": "x"}, "inputs": []}'):
        (report / "metrics.json").write_text(content, encoding="utf-8")
        with pytest.raises(InputError, match="does not say what it was made from"):
            earlier_report(report)
