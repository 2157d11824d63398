"""Settings that a user writes are used, refused or reported."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml

import aerpaw_cmp
from aerpaw_cmp.__main__ import main
from aerpaw_cmp.compare import causes
from aerpaw_cmp.flight.data import load_data
from aerpaw_cmp.flight.gains import load_with_learned
from aerpaw_cmp.flight.replay import replay_flight
from aerpaw_cmp.jobs import likely_cause
from aerpaw_cmp.jobs.compare_flight import compare_flight

SAMPLE = Path(__file__).parents[2] / "sample_logs"


def write_flight(folder: Path, **changes: object) -> Path:
    """Write a flight over LW1 and LW2 in free space, with further keys."""
    content = {
        "flight": "used", "site": "lake_wheeler", "timezone": "America/New_York",
        "logs": [
            {"path": str(SAMPLE / "UAV/2025-06-01_10_00_00_vehicleOut.txt")},
            {"path": str(SAMPLE / "LW1/USRP1_power_log.txt"), "node": "LW1", "channel": "A"},
            {"path": str(SAMPLE / "LW2/USRP2_power_log.txt"), "node": "LW2", "channel": "B"},
        ],
        "link": {"rss": {"carrier_hz": 3.3e9}},
        "rt": {"max_depth": 0, "audit_links": 0},
        "rss": {"lag": "off"},
    }  # fmt: skip
    path = folder / "flight.yaml"
    path.write_text(yaml.safe_dump(content | changes), encoding="utf-8")
    return path


def report(path: Path, name: str, *options: str) -> tuple[pd.DataFrame, dict]:
    """Report a flight, and return rss.csv and metrics.json."""
    out = path.parent / name
    assert main(["report", str(path), "-o", str(out), "-q", *options]) == 0
    return pd.read_csv(out / "rss.csv"), json.loads((out / "metrics.json").read_text())


def changed_channels(before: pd.DataFrame, after: pd.DataFrame) -> set[str]:
    differ = (before["simulated_dbm"] - after["simulated_dbm"]).abs() > 0.1
    return set(before.loc[differ, "channel"])


def test_the_airframe_changes_the_levels_of_every_channel(tmp_path: Path) -> None:
    plain, _ = report(write_flight(tmp_path), "plain")
    path = write_flight(tmp_path, antennas={"uav": "lake_wheeler/dataset12_uav"})
    with_airframe, metrics = report(path, "airframe")
    assert changed_channels(plain, with_airframe) == {"A", "B"}
    assert metrics["antennas"] == ["Antennas: isotropic at the tower, dataset12.LW1.USRP1.uav at the UAV."]


def test_a_learned_airframe_turns_with_the_aircraft_if_the_file_states_no_attitude(tmp_path: Path) -> None:
    rt = {"max_depth": 0, "audit_links": 0}
    (default, _), (logged, _), (ignored, _) = (
        report(write_flight(tmp_path, antennas={"uav": "lake_wheeler/dataset12_uav"}, rt=rt | keys), name)
        for name, keys in (("default", {}), ("logged", {"attitude": "logged"}), ("ignored", {"attitude": "ignored"}))
    )
    assert changed_channels(default, logged) == set()
    assert changed_channels(default, ignored) == {"A", "B"}


def test_calibrated_antennas_come_before_those_of_the_flight(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    antennas = {"LW1.A": "lake_wheeler/dataset12_LW1.USRP1", "uav": "lake_wheeler/dataset12_uav"}
    path = write_flight(tmp_path, antennas=antennas)
    dipole = {"antenna": {"model": "dipole"}}
    learned = tmp_path / "learned.yaml"
    learned.write_text(yaml.safe_dump({"link": {"channels": {"A": {"tower": dipole, "uav": dipole}}}}))
    own, _ = report(path, "own")
    taken, _ = report(path, "with", "--with", str(learned))
    assert changed_channels(own, taken) == {"A"}
    assert "Antennas of LW1 A: dipole at the tower, dipole at the UAV." in capsys.readouterr().out
    learned.write_text(yaml.safe_dump({"link": {"channels": {"C": {"uav": dipole}}}}))
    same, metrics = report(path, "idle", "--with", str(learned))
    assert changed_channels(own, same) == set()
    assert "link.channels names C, which no log of this flight has" in metrics["warnings"][0]
    learned.write_text(yaml.safe_dump({"link": {"channels": {"A": {"carrier_hz": 2.4e9, "uav": dipole}}}}))
    assert main(["report", str(path), "--with", str(learned), "-o", str(tmp_path / "band")]) == 2
    assert "antennas of A learned at 2.4 GHz, used at 3.3 GHz" in capsys.readouterr().err


def test_a_calibration_changes_the_replay_of_levels_and_not_of_ranks(tmp_path: Path) -> None:
    """Antennas are learned with the direct path. The image engine and the audit take the depth of each series."""
    (tmp_path / "learned.yaml").write_text(yaml.safe_dump({"rt": {"max_depth": 0, "attitude": "logged"}}))
    paths = [{"path": str(SAMPLE / "UAV/2025-06-01_10_00_00_vehicleOut.txt")}]
    paths += [{"path": str(SAMPLE / log), "node": "LW1"} for log in ("UAV/modem_ri.csv", "LW1/USRP1_power_log.txt")]
    path = write_flight(tmp_path, logs=paths, rt={"max_depth": 1, "audit_links": 5, "attitude": "level"})
    levels, ranks = [], []
    for name, words in (("own", ()), ("with", ("--with", str(tmp_path / "learned.yaml")))):
        table, metrics = report(path, name, *words)
        levels.append(table)
        ranks.append((path.parent / name / "rank.csv").read_text())
        audit = metrics["rt"]["audit"]
        assert (audit["missing_paths"], audit["extra_paths"]) == (0, 0)
    assert changed_channels(*levels) != set()
    assert ranks[0] == ranks[1]


def test_a_receiver_that_the_site_has_not_learned_is_a_caution(tmp_path: Path) -> None:
    path = write_flight(tmp_path)
    content = yaml.safe_load(path.read_text())
    content["logs"][-1]["receiver"] = "dataset13"
    path.write_text(yaml.safe_dump(content))
    _, metrics = report(path, "unknown")
    assert metrics["warnings"][0].startswith("logs: receiver dataset13 is not a learned receiver (aadm, ")


def test_an_antenna_of_another_band_is_the_first_caution(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    link = {"rss": {"carrier_hz": 2.4e9}}
    path = write_flight(tmp_path, antennas={"uav": "lake_wheeler/dataset12_uav"}, link=link)
    _, metrics = report(path, "band")
    assert "learned at 3.3 GHz, used at 2.4 GHz" in metrics["warnings"][0]
    assert "learned at 3.3 GHz, used at 2.4 GHz" in capsys.readouterr().err.splitlines()[0]
    assert metrics["likely_cause"] is None
    assert "first caution" in metrics["next_step"]


@pytest.mark.parametrize(
    ("changes", "found", "expected"),
    [
        ({"antennas": {"LW9.A": "lake_wheeler/dataset12_LW1.USRP1"}}, "no tower 'LW9'", "uav, LW1.A, LW2.B"),
        ({"antennas": {"LW1.B": "lake_wheeler/dataset12_LW1.USRP1"}}, "no channel 'LW1.B'", "uav, LW1.A, LW2.B"),
        ({"antennas": {"uav": "lake_wheeler/dataset13_uav"}}, "no learned model is called", "lake_wheeler/dataset12_uav"),
        ({"link": {"channels": {"USRP1": {"carrier_hz": 3.3e9}}}}, "no channel 'USRP1'", "one of A, B"),
        ({"link": {"rss": {"carrier_hz": 3.3e9, "towers": {"LW9": {}}}}}, "no tower 'LW9'", "LW1, LW2, LW3"),
        ({"rank": {"tower": "LW9"}}, "no tower 'LW9'", "LW1, LW2, LW3"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("dry", [(), ("--dry-run",)])
def test_a_name_that_can_never_apply_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture, changes: dict, found: str, expected: str, dry: tuple[str, ...]
) -> None:
    path = write_flight(tmp_path, **changes)
    assert main(["report", str(path), "-o", str(tmp_path / "out"), *dry]) == 2
    message = capsys.readouterr().err
    assert found in message
    assert expected in message
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("changes", "code", "found"),
    [
        ({"link": {"rss": {"carrier_hz": 3.3}}}, 2, "line 2: link.rss.carrier_hz: 3.3 Hz is not the frequency"),
        ({"link": {"rss": {"carrier_hz": 15e9}}}, 2, "no values for 'medium_dry_ground' (ground_material) at 15 GHz"),
        ({"link": {"rss": {"carrier_hz": 3.3e9, "uav": {"antenna": {"model": "file", "file": "no.txt"}}}}}, 3, "no.txt"),
        ({"link": {"rss": {"carrier_hz": 3.3e9, "uav": {"slant_deg": [1.0, 2.0]}}}}, 2, "2 slants for 1 elements"),
    ],
)  # fmt: skip
def test_a_dry_run_refuses_what_the_report_refuses(
    tmp_path: Path, capsys: pytest.CaptureFixture, changes: dict, code: int, found: str
) -> None:
    path = write_flight(tmp_path, **changes)
    messages = []
    for dry in ((), ("--dry-run",)):
        assert main(["report", str(path), "-o", str(tmp_path / "out"), "-q", *dry]) == code
        messages.append(capsys.readouterr().err)
    assert messages[0] == messages[1]
    assert found.replace("line 2: ", "") in messages[0]


def test_a_dry_run_reads_the_receiver_and_the_recommendation(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    logs = [{"path": str(SAMPLE / "UAV/modem_ri.csv"), "node": "LW1"}]
    path = write_flight(tmp_path, logs=logs, rank={"receiver": "none.json"})
    assert main(["report", str(path), "--dry-run"]) == 3
    assert "none.json" in capsys.readouterr().err
    path = write_flight(tmp_path, logs=logs)
    assert main(["report", str(path), "--dry-run", "--recommend", str(tmp_path / "rec.yaml")]) == 2
    assert "no model can be recommended" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "found"),
    [
        (("--carrier-ghz", "3400"), "3.4e+12 Hz is not the frequency"),
        (("--carrier-ghz", "34"), "no values for 'medium_dry_ground' (ground_material) at 34 GHz"),
        (("--rank-altitude", "40"), "1 rank height at or above 30 m"),
    ],
)
def test_a_dry_run_refuses_what_the_map_refuses(
    tmp_path: Path, capsys: pytest.CaptureFixture, options: tuple[str, ...], found: str
) -> None:
    arguments = ["map", "lake_wheeler", "-o", str(tmp_path / "out"), "--spacing", "300", *options]
    for dry in ((), ("--dry-run",)):
        assert main([*arguments, *dry]) == 2
        assert found in capsys.readouterr().err


def test_a_recommended_file_keeps_line_ends_and_says_that_it_is_a_copy(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    path = write_flight(tmp_path)
    path.write_bytes(path.read_bytes().replace(b"\n", b"\r\n"))
    # free space is worse than the ground reflection of these logs, so lines change
    assert (
        main(["report", str(path), "-o", str(tmp_path / "out"), "-q", "--recommend", str(tmp_path / "rec.yaml")]) == 0
    )
    assert "The recommended file has the settings of the model '" in capsys.readouterr().out
    _, *lines = (tmp_path / "rec.yaml").read_bytes().splitlines(keepends=True)
    assert all(line.endswith(b"\r\n") for line in lines)
    unchanged = set(path.read_bytes().splitlines(keepends=True)) & set(lines)
    assert len(unchanged) > 10
    (tmp_path / "rec.yaml").write_bytes(b"".join(lines))
    again = ["report", str(tmp_path / "rec.yaml"), "-o", str(tmp_path / "again"), "-q"]
    assert main([*again, "--recommend", str(tmp_path / "copy.yaml")]) == 0
    assert "No model is significantly better than rec.yaml: the recommended file is a copy" in capsys.readouterr().out
    assert (tmp_path / "copy.yaml").read_bytes().partition(b"\n")[2] == b"".join(lines)


def test_a_quiet_draft_shows_the_lines_to_check_and_takes_the_bandwidth_from_names(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    logs = tmp_path / "40m_fs5MHz"
    shutil.copytree(SAMPLE / "LW1", logs / "LW1")
    shutil.copytree(SAMPLE / "UAV", logs / "UAV")
    command = ["ingest", str(logs), "--timezone", "America/New_York", "--draft", str(tmp_path / "f.yaml"), "-q"]
    assert main(command) == 0
    message = capsys.readouterr().err
    assert "check: rss: {carrier_hz: 3.3e9" in message
    assert "can be compared" not in message
    assert yaml.safe_load((tmp_path / "f.yaml").read_text())["link"]["rss"]["bandwidth_hz"] == "5e6"


@pytest.mark.parametrize(
    ("command", "found"),
    [
        (["ingest", "{flight}", "--site", "lake_wheeler"], "--site without --draft"),
        (["campaign", "{campaign}", "--fresh", "--keep", "kept"], "--fresh and --keep"),
        (["campaign", "{zoned}"], "'timezone' without 'soundings'"),
        (["predict", "{route}", "--site", "lake_wheeler", "--spacing", "10"], "--spacing along a route"),
        (["channel", "{flight}", "--subcarriers", "8"], "--subcarriers without a band"),
        (["calibrate", "{calibration}"], "patterns.towers.LW9.A: the flights have no such tower and channel"),
        (["tap", "--telemetry", "vehicle.txt"], "--telemetry without --flight"),
    ],
)
def test_an_option_that_cannot_act_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch, command: list[str], found: str
) -> None:
    monkeypatch.chdir(tmp_path)
    write_flight(tmp_path)
    texts = {
        "campaign": "campaign: c\nflights: [flight.yaml]\n",
        "zoned": "campaign: c\nflights: [flight.yaml]\ntimezone: UTC\n",
        "calibration": "calibration: c\nflights: [flight.yaml]\npatterns: {towers: {LW9.A: {model: dipole}}}\n",
    }
    for name, text in texts.items():
        (tmp_path / f"{name}.yaml").write_text(text)
    (tmp_path / "route.csv").write_text("latitude_deg,longitude_deg,height_m\n35.7275,-78.696,30\n35.7285,-78.697,30\n")
    places = {name: f"{name}.yaml" for name in ("flight", *texts)} | {"route": "route.csv"}
    assert main([word.format(**places) for word in command]) == 2
    assert found in capsys.readouterr().err


def test_a_calibration_is_not_recommended_to_a_report_that_uses_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The antennas of ``report --with`` are not among the named antennas of the flight file."""
    monkeypatch.setattr(likely_cause, "flight_cause", lambda _: None)
    monkeypatch.setattr(likely_cause, "gains_by_direction", lambda _: True)
    path = write_flight(tmp_path)
    packaged = Path(aerpaw_cmp.__file__).parent / "site/data/lake_wheeler.learned/dataset12.LW1.USRP1.uav.csv.gz"
    antenna = Path(shutil.copy(packaged, tmp_path)).name
    learned = tmp_path / "learned.yaml"
    uav = {"uav": {"antenna": {"model": "sphere", "file": antenna}}}
    learned.write_text(yaml.safe_dump({"link": {"channels": {"A": uav, "B": uav}}}))
    steps = []
    for calibrated in (None, learned):
        data = load_data(load_with_learned(path, calibrated), tmp_path)
        result = compare_flight(data, replay_flight(data))
        steps.append(result.next_step or "")
    assert ["calibrate" in step for step in steps] == [True, False]
    assert "calibrate" not in causes._PATTERN["learned"][1]


def test_an_unknown_gain_of_the_uav_turns_with_it_although_its_attitude_is_ignored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A calibration learns gains in the frame of the aircraft, whatever the flight file does with the attitude."""
    seen = []
    monkeypatch.setattr(likely_cause, "flight_cause", seen.append)
    monkeypatch.setattr(likely_cause, "_GOOD_DB", 0.0)
    for attitude in ("ignored", "logged"):
        data = load_data(load_with_learned(write_flight(tmp_path, rt={"max_depth": 0, "attitude": attitude})), tmp_path)
        compare_flight(data, replay_flight(data))
    ignored, logged = seen
    turned = np.ptp(logged[0].uav_azimuth_deg - logged[0].tower_azimuth_deg)
    assert turned > 90.0
    np.testing.assert_allclose(ignored[0].uav_azimuth_deg, logged[0].uav_azimuth_deg)
