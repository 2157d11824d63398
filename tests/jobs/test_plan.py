"""``--dry-run``: what would run is what runs, nothing is written."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from aerpaw_cmp.__main__ import main

SAMPLE = Path(__file__).parents[2] / "sample_logs"


def planned(capsys: pytest.CaptureFixture[str], *line: object) -> dict[str, Any]:
    capsys.readouterr()
    assert main([*map(str, line), "--dry-run", "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def short_flight(folder: Path, receivers: int) -> Path:
    """The sample flight with the logs of some receivers, all of them without what costs time."""
    text = (SAMPLE / "flight.yaml").read_text()
    logs = [line for line in text.splitlines() if "path: LW" in line and int(line.split("LW")[1][0]) > receivers]
    for line in logs:
        text = text.replace(line + "\n", "")
    file = folder / f"{receivers}.yaml"
    file.write_text(text.replace("name: sample", f"name: sample{receivers}"))
    return file


def test_a_planned_report_names_its_links_and_poses_and_writes_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    file = short_flight(tmp_path, 1)
    there = sorted(tmp_path.rglob("*"))
    plan = planned(capsys, "report", file, "--logs-root", SAMPLE, "--audit", "none")
    assert sorted(tmp_path.rglob("*")) == there
    work = {stage["name"]: stage["work"] for stage in plan["stages"]}
    assert work["replay"] == "1\N{NARROW NO-BREAK SPACE}310 RSS samples, 655 rank samples, engine image"
    assert list(work) == ["read", "clocks", "replay", "compare", "models", "report"]
    assert plan["output"] == "reports/sample1"
    assert [stage["name"] for stage in plan["stages"] if stage["seconds"] is None] == list(work)[1:]
    audited = planned(capsys, "report", file, "--logs-root", SAMPLE, "--audit", "50", "--figures", "none")
    assert "audit" in {stage["name"] for stage in audited["stages"]}
    assert "figures of 0 channels" in audited["stages"][-1]["work"]
    assert main(["report", str(file), "--logs-root", str(SAMPLE), "--audit", "none", "--dry-run"]) == 0
    assert "report, not run" in capsys.readouterr().out


COMMANDS = {
    "report": "report FLIGHT --audit none",
    "map": "map --quick --foliage none --with FLIGHT",
    "predict": "predict lake_wheeler --with FLIGHT --spacing 120",
    "plan": "plan lake_wheeler --with FLIGHT",
    "calibrate": "calibrate CALIBRATION --score FLIGHT",
    "simulate": "simulate FLIGHT",
    "campaign": "campaign CAMPAIGN",
}
WRONG = {
    "report": "--recommend FLIGHT|--against nope|report LOST",
    "map": "--with nope.yaml|--with LOST",
    "predict": "--with nope.yaml|--with LOST|--site nowhere",
    "plan": "--route nope.kml|--geofence nope.kml|--minutes 1 --tower-distance 5000|--with LOST",
    "calibrate": "--score LOST|--into-site nowhere|-o learned.txt|calibrate LOST",
    "simulate": "--nonsense|simulate LOST",
    "campaign": "--keep s3://nope",
}


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder with a flight and what names it, one without its logs, and places that no output can take."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(SAMPLE, tmp_path / "logs")
    (tmp_path / "calibration.yaml").write_text("calibration: mine\nflights: [logs/flight.yaml]\n")
    (tmp_path / "campaign.yaml").write_text("campaign: mine\nflights: [logs/flight.yaml]\n")
    (tmp_path / "lost.yaml").write_text((SAMPLE / "flight.yaml").read_text().replace("node: LW3", "node: LW9"))
    (tmp_path / "taken").write_text("x")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("x")
    return tmp_path


def words(line: str) -> list[str]:
    files = {
        "FLIGHT": "logs/flight.yaml",
        "CALIBRATION": "calibration.yaml",
        "CAMPAIGN": "campaign.yaml",
        "LOST": "lost.yaml",
    }
    return [files.get(word, word) for word in line.split()]


def everything(folder: Path) -> dict[Path, bytes | None]:
    return {path: path.read_bytes() if path.is_file() else None for path in folder.rglob("*")}


@pytest.mark.parametrize("name", COMMANDS)
def test_a_dry_run_says_what_it_would_do_and_writes_nothing(
    name: str, place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = everything(place)
    plan = planned(capsys, *words(COMMANDS[name]), "-o", "out.yaml")
    assert everything(place) == before
    assert (plan["job"], plan["output"]) == (name, "out.yaml")
    assert plan["inputs"]
    assert [stage["name"] for stage in plan["stages"] if stage["name"] not in ("read", "candidates")]


@pytest.mark.parametrize("name", COMMANDS)
def test_a_dry_run_ends_as_the_run_does_on_wrong_input(
    name: str, place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = everything(place)
    every = ("-o taken/out.yaml", "-o mine", f"{name} nope.yaml", *WRONG[name].split("|"))
    for line in (wrong if wrong.startswith(name) else f"{COMMANDS[name]} {wrong}" for wrong in every):
        said = []
        for option in ([], ["--dry-run"]):
            code = main([*words(line), *option])
            said.append((code, capsys.readouterr().err.splitlines()[-1]))
        assert said[0][0] in (2, 3), line
        assert said[0] == said[1], line
    assert everything(place) == before


def test_a_planned_map_counts_its_links(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    quick = ["map", "--quick", "--foliage", "none", "-o", tmp_path / "m"]
    maps, study, last = planned(capsys, *quick)["stages"]
    assert maps["work"] == "2\N{NARROW NO-BREAK SPACE}295 links: 153 positions, 3 heights, 5 towers"
    assert (study["name"], last["seconds"]) == ("study", None)
    tiled = planned(capsys, *quick, "--tile-m", "600", "--no-study")["stages"]
    assert [stage["name"] for stage in tiled] == ["maps", "export, page"]
    assert tiled[0]["work"].endswith("5 towers, in tiles of 5 x 5 positions")
    assert not (tmp_path / "m").exists()


def test_what_was_planned_is_what_runs_and_no_line_comes_twice(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = short_flight(tmp_path, 1)
    line = ["report", file, "--logs-root", SAMPLE, "--audit", "none", "--figures", "none", "-o", tmp_path / "out"]
    plan = planned(capsys, *line)
    assert main(list(map(str, line))) == 0
    said = capsys.readouterr().err.splitlines()
    assert len(said) == len(set(said)), said
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    ran = {name.removesuffix("_s") for name, seconds in metrics["stages"].items() if seconds > 0.01}
    assert {stage["name"].split()[0] for stage in plan["stages"]} == ran


def test_a_planned_report_reads_what_it_is_given_with(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """``--with`` counts in the plan: its settings are those of the report, and a damaged file is refused before it."""
    file = short_flight(tmp_path, 1)
    learned = tmp_path / "learned.yaml"
    learned.write_text("link: {channels: {}}\nrt: {max_depth: 0}\n", encoding="utf-8")
    line = ["report", file, "--logs-root", SAMPLE, "--audit", "none", "-o", tmp_path / "out"]
    with_it, without = planned(capsys, *line, "--with", learned), planned(capsys, *line)
    assert json.dumps(with_it) != json.dumps(without)
    learned.write_text("rt: {max_depth: [", encoding="utf-8")
    assert main([*map(str, [*line, "--with", learned]), "--dry-run"]) == 2
    capsys.readouterr()
