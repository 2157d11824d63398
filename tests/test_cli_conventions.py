"""One convention for all commands: ``-o`` says what it takes and its default, a missing input is exit code 3."""

import dataclasses
import json
import re
from pathlib import Path
from typing import Any

import pytest
import typer

from aerpaw_cmp.__main__ import main
from aerpaw_cmp.cli.app import app
from aerpaw_cmp.common.text import COMMANDS
from aerpaw_cmp.live.ports import TapSummary
from tests import json_page
from tests.json_page import listed

PROGRAM: Any = typer.main.get_command(app)
VERBS = {name: command for name, command in PROGRAM.commands.items() if not hasattr(command, "commands")}
GROUPS = {name: group for name, group in PROGRAM.commands.items() if hasattr(group, "commands")}
VERBS |= {f"{group} {name}": verb for group, verbs in GROUPS.items() for name, verb in verbs.commands.items()}


OUTPUTS = {name: option for name, verb in VERBS.items() for option in verb.params if "-o" in option.opts}


def test_what_writes_has_an_output_option() -> None:
    assert set(OUTPUTS) >= {"report", "ingest", "calibrate", "campaign", "map", "simulate", "site import"}


@pytest.mark.parametrize("name", OUTPUTS)
def test_the_output_option_says_what_it_takes_and_its_default(name: str) -> None:
    option = OUTPUTS[name]
    assert "--out" in option.opts
    assert option.metavar in ("DIR", "FILE")
    assert option.required or option.default is not None or "[default: " in option.help


WITHOUT_INPUT = {"bench", "doctor", "formats", "sample", "site", "tap", "modem-sim"}
MISSING = [
    "ingest nope", "report nope.yaml", "report nope.yaml --dry-run", "calibrate nope.yaml", "campaign nope.yaml",
    "explain nope.yaml --time 1 --tower LW1", "diff nope other",
    "tap nope --flight nope.yaml", "map nope.yaml",
    "predict nope.kml --with nope.yaml", "plan nope.kml --site lake_wheeler", "plan sphere --with nope.yaml",
    "channel nope.yaml", "locate nope.yaml", "antenna export nope.txt -o out.py",
    "plan sphere --site lake_wheeler --geofence nope.kml", "simulate nope.yaml", "site show nope.yaml",
    "site export nope.yaml -o scene", "site import nope.osm -o site.yaml",
]  # fmt: skip


def test_every_command_that_reads_is_tried() -> None:
    assert {line.split()[0] for line in MISSING} >= set(COMMANDS) - WITHOUT_INPUT


@pytest.mark.parametrize("line", MISSING)
def test_a_missing_input_is_exit_code_3(
    line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(line.split()) == 3
    said = capsys.readouterr().err
    assert re.search(r"nope", said)
    assert "Traceback" not in said
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("line", MISSING)
def test_a_name_that_no_file_system_takes_is_no_internal_fault(
    line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main([word.replace("nope", "n" * 300) for word in line.split()]) in (2, 3)
    said = capsys.readouterr().err
    assert "nnnn" in said
    assert "internal error" not in said


ROOT = Path(__file__).parents[1]
PAGE = json_page.PAGE.read_text(encoding="utf-8")
QUICK = {
    "doctor": "doctor",
    "formats": "formats",
    "sample": "sample -o sample",
    "ingest": f"ingest {ROOT}/sample_logs/UAV --timezone America/New_York",
    "report --dry-run": f"report {ROOT}/sample_logs/flight.yaml --dry-run",
    "site export": "site export lake_wheeler -o scene",
}


@pytest.mark.parametrize("name", QUICK)
def test_the_page_lists_what_json_prints(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    code = main([*QUICK[name].split(), "--json"])
    printed = json.loads(capsys.readouterr().out)
    assert code == any(check["status"] == "fail" for check in printed.get("checks", ()))
    assert ["schema", *listed(name)] == list(printed)
    assert f"`schema` is {printed['schema']}" in PAGE


def test_the_page_lists_what_a_tap_prints() -> None:
    """Its records become the object as they are."""
    assert listed("tap") == [*(field.name for field in dataclasses.fields(TapSummary)), "modems"]


def test_the_page_has_every_command() -> None:
    assert set(re.findall(r"^\| `([\w -]+)`", PAGE, re.MULTILINE)) >= set(VERBS)
