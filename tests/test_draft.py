"""A first flight.yaml from logs alone."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from aerpaw_cmp.__main__ import main
from aerpaw_cmp.config import load_flight
from aerpaw_cmp.draft import draft, write_draft
from aerpaw_cmp.errors import UsageError
from aerpaw_cmp.flight import gather, read_logs
from aerpaw_cmp.ingest import ingest
from aerpaw_cmp.readers import ReadOptions

SAMPLE = Path(__file__).parents[1] / "sample_logs"
ZONE = "America/New_York"
OPTIONS = ReadOptions(timezone=ZONE)


@pytest.fixture
def logs(tmp_path: Path) -> Path:
    """The sample logs without their flight.yaml."""
    shutil.copytree(SAMPLE, tmp_path / "logs", ignore=shutil.ignore_patterns("*.yaml", "*.json"))
    return tmp_path / "logs"


def test_the_draft_of_the_sample_logs_is_a_flight(logs: Path) -> None:
    target = logs.parent / "plans" / "flight.yaml"
    target.parent.mkdir()
    remarks = write_draft(ingest(logs, options=OPTIONS), target, timezone=ZONE)
    settings, given = load_flight(target), load_flight(SAMPLE / "flight.yaml")
    named = {(Path(log.path).name, log.reader, log.node, log.channel) for log in settings.logs}
    assert named == {(Path(log.path).name, log.reader, log.node, log.channel) for log in given.logs}
    assert Path(settings.logs[0].path).name.endswith("vehicleOut.txt")
    assert settings.timezone == ZONE
    asked = [remark for remark in remarks if "which tower?" in remark]
    assert len(asked) == 1  # the modem on the UAV cannot know
    assert "modem_ri.csv" in asked[0]
    data = gather(settings, target.parent, read_logs(settings, target.parent))
    assert (len(data.rss), len(data.rank)) == (10, 1)


def test_another_day_a_ratio_and_relative_times_are_left_out(logs: Path) -> None:
    power = next(logs.glob("LW1/USRP1*"))
    (logs / "LW1/x_quality_log.txt").write_bytes(power.read_bytes())
    (logs / "LW2/USRP2_power_log.txt").write_text(
        (logs / "LW2/USRP2_power_log.txt").read_text().replace("2025-06-01", "2025-06-02")
    )
    telemetry = next(logs.glob("UAV/*vehicleOut.txt"))
    long = telemetry.read_text().replace("2025-06-01", "2025-05-01")
    (logs / "UAV/old_vehicleOut.txt").write_text(long + long.replace("2025-05-01", "2025-05-02"))
    text, remarks = draft(ingest(logs, options=OPTIONS), logs, timezone=ZONE)
    left = {remark.split(": ")[1]: remark for remark in remarks if remark.startswith("left out: ")}
    assert set(left) == {"LW1/x_quality_log.txt", "LW2/USRP2_power_log.txt", "UAV/old_vehicleOut.txt"}
    assert "ratio" in left["LW1/x_quality_log.txt"]
    assert "not at the time" in left["UAV/old_vehicleOut.txt"]  # longer, but no level goes with it
    assert "flight: flight_2025-06-01_" in text


def test_nothing_to_compare_is_said(logs: Path) -> None:
    with pytest.raises(UsageError, match="no log of RSS or rank"):
        draft(ingest(logs.glob("UAV/*vehicleOut.txt"), options=OPTIONS), logs)


def test_the_command_does_not_overwrite(logs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    target = logs.parent / "flight.yaml"
    call = ["ingest", str(logs), "--timezone", ZONE, "--draft", str(target)]
    assert main(call) == 0
    said = capsys.readouterr()
    assert f"wrote {target}" in said.out
    assert "check: " in said.err
    target.write_text("mine")
    assert main(call) == 2
    assert target.read_text() == "mine"
    assert "exists" in capsys.readouterr().err
