"""A first flight.yaml from logs alone."""

import os
import shlex
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest

from aerpaw_cmp import open_flight
from aerpaw_cmp.__main__ import main
from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.common.yamlfile import parse_yaml
from aerpaw_cmp.flight.data import load_data, read_logs
from aerpaw_cmp.flight.drafting import draft as drafting
from aerpaw_cmp.flight.drafting.draft import DraftOptions, draft, receiver_floor_db
from aerpaw_cmp.flight.settings import FlightFile, load_flight
from aerpaw_cmp.logs import ingest as ingest_module
from aerpaw_cmp.logs.flight_file import read_flight
from aerpaw_cmp.logs.ingest import ingest
from aerpaw_cmp.logs.readers import ReadOptions
from aerpaw_cmp.site.siteyaml import load_site
from tests.log_texts import nemo_csv

SAMPLE = Path(__file__).parents[2] / "sample_logs"
ZONE = "America/New_York"
OPTIONS = ReadOptions(timezone=ZONE)


@pytest.fixture
def logs(tmp_path: Path) -> Path:
    """The sample logs without their flight.yaml."""
    shutil.copytree(SAMPLE, tmp_path / "logs", ignore=shutil.ignore_patterns("*.yaml", "*.json"))
    return tmp_path / "logs"


def _lengthen(path: Path) -> None:
    """Other bytes, the same records."""
    path.write_bytes(path.read_bytes() + b"\n")


def test_the_draft_of_the_sample_logs_is_a_flight(logs: Path) -> None:
    target = logs.parent / "plans" / "flight.yaml"
    target.parent.mkdir()
    text, remarks = draft(ingest(logs, options=OPTIONS), target.parent, DraftOptions(timezone=ZONE))
    target.write_text(text, encoding="utf-8")
    settings, given = load_flight(target), load_flight(SAMPLE / "flight.yaml")
    named = {(Path(log.path).name, log.reader, log.node, log.channel) for log in settings.logs}
    assert named == {(Path(log.path).name, log.reader, log.node, log.channel) for log in given.logs}
    assert Path(settings.logs[0].path).name.endswith("vehicleOut.txt")
    assert settings.timezone == ZONE
    assert (settings.rss.field, settings.link.rss.bandwidth_hz) == ("power", 20e6)  # and not 1 Hz of thermal noise
    assert settings.rt.audit_links == 24  # the first report is audited, quickly
    assert any("bandwidth" in remark for remark in remarks if remark.startswith("check: "))
    asked = [remark for remark in remarks if "which tower?" in remark]
    assert len(asked) == 1  # the modem on the UAV cannot know
    assert "modem_ri.csv" in asked[0]
    data = load_data(settings, target.parent)
    assert (len(data.rss), len(data.rank)) == (10, 1)


def test_another_day_a_ratio_and_relative_times_are_left_out(logs: Path) -> None:
    power = next(logs.glob("LW1/USRP1*"))
    (logs / "LW1/x_quality_log.txt").write_bytes(power.read_bytes() + b"\n")
    (logs / "LW2/USRP2_power_log.txt").write_text(
        (logs / "LW2/USRP2_power_log.txt").read_text().replace("2025-06-01", "2025-06-02")
    )
    telemetry = next(logs.glob("UAV/*vehicleOut.txt"))
    long = telemetry.read_text().replace("2025-06-01", "2025-05-01")
    (logs / "UAV/old_vehicleOut.txt").write_text(long + long.replace("2025-05-01", "2025-05-02"))
    text, remarks = draft(ingest(logs, options=OPTIONS), logs, DraftOptions(timezone=ZONE))
    left = {remark.split(": ")[1]: remark for remark in remarks if remark.startswith("left out: ")}
    assert set(left) == {"LW1/x_quality_log.txt", "LW2/USRP2_power_log.txt", "UAV/old_vehicleOut.txt"}
    assert "ratio" in left["LW1/x_quality_log.txt"]
    assert "outside the time" in left["UAV/old_vehicleOut.txt"]  # longer, but no level goes with it
    assert "flight: flight_2025-06-01_" in text


def test_a_radio_clock_in_utc_is_asked_about_and_compared(logs: Path) -> None:
    """The telemetry is in local time. The log of LW1 was written in UTC, and that of LW2 is an hour late."""
    for name, hour in (("LW1/USRP1_power_log.txt", "2025-06-01 14:"), ("LW2/USRP1_power_log.txt", "2025-06-01 11:")):
        (logs / name).write_text((logs / name).read_text().replace("2025-06-01 10:", hour))
    text = (logs / "LW3/USRP1_power_log.txt").read_text()  # from another flight, four hours later
    (logs / "LW3/USRP1_later_power_log.txt").write_text(text.replace("2025-06-01 10:", "2025-06-01 14:") + text[-40:])
    text, remarks = draft(ingest(logs, options=OPTIONS), logs, DraftOptions(timezone=ZONE))
    (line,) = [line for line in text.splitlines() if "LW1/USRP1" in line]
    assert "clock: utc" in line
    assert line.endswith("is it UTC?")
    late, other = sorted(remark for remark in remarks if remark.startswith("left out: "))
    assert "LW2/USRP1_power_log.txt" in late
    assert "daylight saving was taken into account in one log only" in late
    assert "later_power_log.txt: LW3/USRP1_power_log.txt already has" in other
    assert any("samples can be compared" in remark for remark in remarks)
    settings = parse_yaml(text, FlightFile)
    data = load_data(settings, logs)
    utc_series, other = (next(s for s in data.rss if (s.tower, s.channel) == ("LW1", c)) for c in ("USRP1", "USRP2"))
    assert abs(utc_series.time[0] - other.time[0]) < np.timedelta64(2, "s")


def test_what_a_draft_names_is_read_whatever_it_is_called(logs: Path) -> None:
    folder = logs / "LW1"
    names = ["a b: 'c' \"d\" #e?", "\u00fc\u2603[x]", "line\nbreak\r\u2028", "back\\", "tab\t{a, b: c}", "-", "%@`"]
    content = (folder / "USRP1_power_log.txt").read_bytes()
    shutil.rmtree(folder)
    for i, name in enumerate(names):
        (logs / f"{name} LW{i % 5 + 1}").mkdir()
        (logs / f"{name} LW{i % 5 + 1}" / f"usrp{10 + i}_power_log.txt").write_bytes(content + b"\n" * i)
    (logs / "left\nout\r_quality_log.txt").write_bytes(content + b"\n" * 20)
    target = logs / "it's a flight: 1.yaml"
    text, remarks = draft(ingest(logs, options=OPTIONS), target.parent, DraftOptions(timezone=ZONE))
    target.write_text(text, encoding="utf-8")
    assert not any("\n" in remark or "\r" in remark for remark in remarks)
    data = load_data(load_flight(target), target.parent)
    assert {s.channel for s in data.rss} >= {f"USRP{10 + i}" for i in range(len(names))}


def test_a_log_may_be_called_like_a_number(logs: Path) -> None:
    names = ["1e6", "11:48:16", "~", "<<"]
    for tower, name in enumerate(names, 1):
        shutil.move(logs / f"LW{tower}/USRP1_power_log.txt", logs / f"LW{tower}" / name)
    files = ingest([*logs.glob("LW?/[!U]*"), *logs.glob("UAV/*vehicleOut.txt")], options=OPTIONS)
    for tower, name in enumerate(names, 1):
        text, _ = draft(files, logs / f"LW{tower}", DraftOptions(timezone=ZONE))
        assert name in {log.path for log in parse_yaml(text, FlightFile).logs}


def test_a_name_that_is_no_text_is_left_out(logs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bad = os.fsencode(logs / "LW1") + b"/\xff_power_log.txt"
    try:
        Path(os.fsdecode(bad)).write_bytes((logs / "LW1/USRP1_power_log.txt").read_bytes() + b"\n")
    except OSError:
        pytest.skip("this file system takes UTF-8 names only")
    target = logs / "flight.yaml"
    assert main(["ingest", str(logs), "--timezone", ZONE, "--draft", str(target)]) == 0
    assert "rename the file" in capsys.readouterr().err
    load_flight(target)


def test_one_record_of_each_channel_and_rank(logs: Path) -> None:
    for name in ("copy_of_USRP1_power_log.txt", "USRP1_again_power_log.txt"):
        shutil.copy(logs / "LW1/USRP1_power_log.txt", logs / "LW1" / name)
    _lengthen(logs / "LW1/USRP1_again_power_log.txt")
    shutil.copy(next(logs.glob("UAV/*vehicleOut.txt")), logs / "UAV/z_vehicleOut.txt")
    _lengthen(logs / "UAV/z_vehicleOut.txt")
    text, remarks = draft(ingest(logs, options=OPTIONS), logs, DraftOptions(timezone=ZONE))
    left = [remark for remark in remarks if remark.startswith("left out: ")]
    assert len(left) == 3
    assert any("the same bytes as LW1/USRP1_power_log.txt" in r or "the same bytes as LW1/copy" in r for r in left)
    assert any("already has USRP1 of that tower at that time" in r for r in left)
    assert any("z_vehicleOut.txt: the track comes from other telemetry" in r for r in left)
    (logs / "flight.yaml").write_text(text)
    data = load_data(load_flight(logs / "flight.yaml"), logs)
    assert (len(data.rss), len(data.rank)) == (10, 1)


def test_of_two_logs_of_a_channel_the_fuller_one_is_taken(logs: Path) -> None:
    full = logs / "LW1/USRP1_power_log.txt"
    part = logs / "LW1/USRP1_a_power_log.txt"
    part.write_text("".join(full.read_text().splitlines(keepends=True)[100:200]))
    text, remarks = draft(ingest(logs, options=OPTIONS), logs, DraftOptions(timezone=ZONE))
    assert "LW1/USRP1_power_log.txt, reader" in text
    left = "left out: LW1/USRP1_a_power_log.txt: LW1/USRP1_power_log.txt already has USRP1 of that tower at that time"
    assert left in remarks
    assert text.index("path: LW1/") < text.index("path: LW2/")


def test_relative_ranks_with_positions_need_no_origin(logs: Path) -> None:
    nemo = logs / "nemo.csv"
    (rank,) = ingest(logs / "UAV/modem_ri.csv", options=OPTIONS)
    frame = rank.result.streams[0].frame.assign(rsrp_dbm=-80.0, cqi=9.0)
    nemo.write_bytes(nemo_csv(frame, "2025-06-01T14:00:00Z"))
    text, _ = draft(ingest(nemo), logs)
    assert "time_origin" not in text
    assert "no telemetry here" not in text  # its positions are its own
    origin = "2025-06-01T14:00:00Z"
    text, _ = draft(ingest(nemo, options=ReadOptions(time_origin=origin)), logs, DraftOptions(time_origin=origin))
    (logs / "flight.yaml").write_text(text)
    settings = load_flight(logs / "flight.yaml")
    (again,) = read_logs(settings, logs)
    assert again.result.streams[0].frame["time"].min() == frame["time"].min()  # read as it was drafted


def test_levels_without_telemetry_are_asked_about(logs: Path) -> None:
    _, remarks = draft(ingest(logs / "LW1", options=OPTIONS), logs, DraftOptions(timezone=ZONE))
    assert [r for r in remarks if "no telemetry here" in r]


def test_the_tower_is_told_by_the_folder_of_the_log(logs: Path) -> None:
    far = logs / "LW4_campaign" / "first" / "run"
    far.mkdir(parents=True)
    shutil.move(logs / "LW2/USRP1_power_log.txt", far / "power_log.txt")
    text, _ = draft(ingest([logs / "LW3", far], options=OPTIONS), logs / "LW3", DraftOptions(timezone=ZONE))
    assert "{path: USRP1_power_log.txt, reader: sounder_log, node: LW3, channel: USRP1}\n" in text
    assert "power_log.txt, reader: sounder_log, node: LW4}\n" in text
    text, _ = draft(ingest(far, options=OPTIONS), logs / "LW3", DraftOptions(timezone=ZONE))
    assert "node: LW4}  # which tower?" in text  # a guess: without other logs, this folder may be any folder above them


def test_a_folder_between_the_tower_and_its_log_does_not_hide_the_tower(logs: Path) -> None:
    between = logs / "LW2" / "Results"
    between.mkdir()
    shutil.move(logs / "LW2/USRP1_power_log.txt", between / "USRP1_power_log.txt")
    text, _ = draft(ingest(logs, options=OPTIONS), logs, DraftOptions(timezone=ZONE))
    assert "{path: LW2/Results/USRP1_power_log.txt, reader: sounder_log, node: LW2, channel: USRP1}\n" in text
    elsewhere = logs.parent / "drafts"
    elsewhere.mkdir()
    text, _ = draft(ingest(logs, options=OPTIONS), elsewhere, DraftOptions(timezone=ZONE))
    assert "LW2/Results/USRP1_power_log.txt, reader: sounder_log, node: LW2, channel: USRP1}\n" in text


def test_a_ratio_is_kept_where_nothing_else_is(logs: Path) -> None:
    shutil.move(logs / "LW1/USRP1_power_log.txt", logs / "LW1/x_quality_log.txt")
    files = ingest([logs / "LW1/x_quality_log.txt", *logs.glob("UAV/*vehicleOut.txt")], options=OPTIONS)
    text, remarks = draft(files, logs, DraftOptions(timezone=ZONE))
    assert "LW1/x_quality_log.txt" in text
    assert any(r.endswith("use a signal-to-noise ratio as a level?") for r in remarks)


def test_sparse_telemetry_is_named_as_the_reason_why_nothing_is_compared(
    logs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    telemetry = next(logs.glob("UAV/*vehicleOut.txt"))
    rows = telemetry.read_text().splitlines(keepends=True)
    step_s = 14
    per_s = round((len(rows) - 1) / float(np.ptp([_seconds(row) for row in (rows[1], rows[-2])])))
    # no sample is at a fix, and a longitude that jumps leaves no straight leg
    sparse = [row.replace(".000000,", ".313000,") for row in rows[:: step_s * per_s]]
    sparse[2::2] = [row.replace(",-78.", ",-77.") for row in sparse[2::2]]
    telemetry.write_text("".join(sparse))
    target = logs.parent / "flight.yaml"
    call = ["ingest", str(telemetry), str(logs / "LW1"), "--timezone", ZONE, "--draft", str(target)]
    assert main(call) == 0
    message = capsys.readouterr().err
    assert "no sample of this draft can be compared" in message
    assert " samples within the telemetry: it has a fix every 14 s" in message
    assert "time_origin" not in message
    assert "No sample of this draft can be compared" in target.read_text()


def _seconds(row: str) -> float:
    hours, minutes, seconds = (float(part) for part in row.split(",")[-3].split(" ")[-1].split(":"))
    return 3600.0 * hours + 60.0 * minutes + seconds


def test_a_draft_says_how_many_samples_it_compares(logs: Path) -> None:
    text, remarks = draft(ingest(logs, options=OPTIONS), logs, DraftOptions(timezone=ZONE))
    (counted,) = (remark for remark in remarks if remark.endswith("can be compared"))
    settings = parse_yaml(text, FlightFile)
    data = load_data(settings, logs)
    low = settings.rss.minimum_height_m or 0.0
    by_hand = 0
    for series in [*data.rss, *data.rank]:
        pose = data.poses_at(series.time)
        value = series.measured_db if hasattr(series, "measured_db") else series.rank
        by_hand += sum(
            bool(ok and height >= low and np.isfinite(v))
            for ok, height, v in zip(pose.valid, pose.position_m[:, 2], value, strict=True)
        )
    assert by_hand > 5000
    assert counted.replace("\N{NARROW NO-BREAK SPACE}", "") == f"{by_hand} samples can be compared"


def test_levels_without_positions_do_not_spoil_ranks_that_have_them(logs: Path) -> None:
    files = [*ingest(logs / "UAV/modem_ri.csv", options=OPTIONS), *ingest(logs / "LW1", options=OPTIONS)]
    text, remarks = draft(files, logs, DraftOptions(timezone=ZONE))
    assert [log.path for log in parse_yaml(text, FlightFile).logs] == ["UAV/modem_ri.csv"]
    assert any(remark.endswith("samples can be compared") and not remark.startswith("0") for remark in remarks)
    assert any("USRP1_power_log.txt: it has no positions, and there is no telemetry" in remark for remark in remarks), (
        remarks
    )


def test_nothing_to_compare_is_said_with_options_to_paste(logs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(UsageError, match="no log of RSS or rank"):
        draft(ingest(logs.glob("UAV/*vehicleOut.txt"), options=OPTIONS), logs)
    with pytest.raises(UsageError, match="no log of RSS or rank"):
        draft([], logs)
    tracks = [logs / "today.csv", logs / "tomorrow.csv"]
    for day, track in enumerate(tracks, 1):
        rows = (f"2025-06-0{day}T10:00:{s:02d}Z,35.73,{-78.7 + s * 1e-4},30\n" for s in range(60))
        track.write_text("time,lat,lon,alt\n" + "".join(rows))
    with pytest.raises(
        UsageError, match=r"no log of RSS or rank for a flight(?!.*at the time)"
    ):  # the other track is no reason
        draft(ingest(tracks, options=OPTIONS), logs)
    table = logs / "table.csv"
    table.write_text("by hand\nDate,Time,lat,lon,alt,rx's power\n2025-06-01,10:00:00,35.73,-78.7,30,-60\n")
    with pytest.raises(UsageError, match="may be a level") as refused:
        draft(ingest(table, options=OPTIONS), logs)
    options = shlex.split(str(refused.value).partition("read as one: ")[2].partition(";")[0])
    assert main(["ingest", str(table), *options, "--timezone", ZONE, "--draft", str(logs / "flight.yaml")]) == 0
    assert "1 sample can be compared" in capsys.readouterr().err


def test_the_place_is_looked_at_before_the_logs(logs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["ingest", str(logs), "--draft", str(logs / "nowhere" / "flight.yaml")]) == 2  # and not: timezone
    assert "no such folder" in capsys.readouterr().err
    assert main(["ingest", str(logs), "--draft", str(logs)]) == 2
    assert "not a regular file" in capsys.readouterr().err


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


def _telemetry(folder: Path, *, attitude: bool) -> None:
    turned = ",0.01,-0.02,1.5" if attitude else ",,,"
    rows = [f"{t},35.7275,-78.696,{min(2.0 * t, 40.0)}{turned}" for t in range(60)]
    (folder / "pose.csv").write_text("t,lat,lon,alt,roll,pitch,yaw\n" + "\n".join(rows) + "\n", encoding="utf-8")


def _levels(folder: Path, floor: float | None) -> None:
    level = [-60.0 - 0.1 * t for t in range(590)]
    rows = [f"{t / 10},{max(v, floor) if floor is not None else v}" for t, v in enumerate(level)]
    (folder / "levels_LW1.csv").write_text("t,rss_dbm\n" + "\n".join(rows) + "\n", encoding="utf-8")


@pytest.mark.parametrize("attitude", [True, False])
def test_attitude_height_and_floor_are_proposed(tmp_path: Path, attitude: bool) -> None:
    _telemetry(tmp_path, attitude=attitude)
    _levels(tmp_path, -100.0)
    origin = "2025-06-01T14:00:00Z"
    named = {"time": "t", "latitude_deg": "lat", "longitude_deg": "lon", "altitude_m": "alt", "roll_deg": "roll",
             "pitch_deg": "pitch", "yaw_deg": "yaw"}  # fmt: skip
    files = [
        *ingest([tmp_path / "pose.csv"], reader="generic_csv",
                options=ReadOptions(time_origin=origin, kind="telemetry", columns=named)),
        *ingest([tmp_path / "levels_LW1.csv"], reader="generic_csv",
                options=ReadOptions(time_origin=origin, kind="rss", columns={"time": "t", "rss_db": "rss_dbm"})),
    ]  # fmt: skip
    text, remarks = draft(files, tmp_path, DraftOptions(time_origin=origin))
    settings = parse_yaml(text, FlightFile)
    assert settings.rt.attitude == ("logged" if attitude else "level")
    assert any("no attitude" in remark for remark in remarks) is not attitude
    assert settings.rss.minimum_height_m == 5.0
    assert settings.logs[1].floor_db == pytest.approx(-99.99)
    assert any("-100.0 dB?" in remark for remark in remarks)


def test_a_draft_of_a_flight_file_names_logs_in_it_that_came_from_above(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The logs were named relative to a parent folder. The flight file is read once for all of them."""
    (tmp_path / "work").mkdir()
    (tmp_path / "logs").symlink_to(SAMPLE)
    monkeypatch.chdir(tmp_path / "work")
    logs = ["../logs/UAV", "../logs/LW1"]
    assert main(["ingest", *logs, "--timezone", ZONE, "-o", "flight.h5", "-q"]) == 0
    assert main(["ingest", "flight.h5", "--draft", "draft.yaml", "-q"]) == 0
    settings = load_flight(Path("draft.yaml"))
    assert len(settings.logs) == 4
    assert all(log.path.startswith("flight.h5/") for log in settings.logs)
    calls: list[Path] = []
    monkeypatch.setattr(ingest_module, "read_flight", lambda path: calls.append(path) or read_flight(path))
    files = read_logs(settings, Path())
    assert len(calls) == 1
    assert sorted(Path(file.path).name for file in files) == sorted(Path(log.path).name for log in settings.logs)


@pytest.mark.parametrize(("top_m", "low_m"), [(40.0, 5.0), (12.0, None)])
def test_a_rank_log_with_positions_of_its_own_is_compared_in_flight(logs: Path, top_m: float, low_m: float) -> None:
    """On the ground, grass and airframe determine the rank. This took half of a gain in log score."""
    (rank,) = ingest(logs / "UAV/modem_ri.csv", options=OPTIONS)
    frame = rank.result.streams[0].frame.assign(rsrp_dbm=-80.0, cqi=9.0)
    frame["altitude_m"] = np.minimum(np.arange(len(frame)), top_m)
    (logs / "nemo.csv").write_bytes(nemo_csv(frame, "2025-06-01T14:00:00Z"))
    text, _ = draft(ingest(logs / "nemo.csv"), logs)
    assert parse_yaml(text, FlightFile).rank.minimum_height_m == low_m


def stream(kind: str, level: list[float] | np.ndarray, **attributes: object) -> Any:
    time = np.datetime64("2025-06-01T14:00:00", "ns") + np.arange(len(level)) * np.timedelta64(1, "s")
    frame = pd.DataFrame({"time": time, "line": 1, "flag": "", "rank" if kind == "rank" else "rss_db": level})
    return SimpleNamespace(kind=kind, name=str(attributes.pop("name", kind)), frame=frame, attributes=attributes)


@pytest.mark.parametrize(
    ("held", "n", "floor"), [(9, 500, None), (10, 500, -90.0), (14, 1500, None), (15, 1500, -90.0), (500, 500, None)]
)
def test_a_floor_is_a_least_level_that_returns(held: int, n: int, floor: float | None) -> None:
    """The floor occurs ten times, and in one of a hundred samples. The highest floor of several streams is used."""
    level = np.where(np.arange(n) < held, -90.0, -80.0 + 1e-3 * np.arange(n))
    level = np.append(level, np.nan)
    assert receiver_floor_db([stream("rss", level)]) == floor
    assert receiver_floor_db([stream("rss", level), stream("rss", level + 7.0)]) == (None if floor is None else -83.0)


def test_cells_of_a_scanner_are_the_six_fullest_that_are_no_strays() -> None:
    sizes = {1: 100, 2: 5, 3: 4, 7: 30, 8: 31, 9: 32, 10: 33, 11: 34}
    streams = [stream("rss", np.zeros(n), pci=str(pci)) for pci, n in sizes.items()]
    assert drafting._cells(streams) == [1, 7, 8, 9, 10, 11]
    assert drafting._cells(streams[:4]) == [1, 2, 7]
    assert drafting._cells([stream("rss", [1.0])]) == []


@pytest.mark.parametrize(
    ("offsets", "span"),
    [
        ([], None),
        ([30.0], None),
        ([30.1], [10, 60]),
        ([-30.0, 30.0], None),
        ([-30.1], [-60, -10]),
        ([-41.0, 36.0], [-70, 60]),
    ],
)
def test_a_span_of_offsets_reaches_twenty_decibels_beyond_whole_tens(
    offsets: list[float], span: list[int] | None
) -> None:
    assert drafting._span_of_offsets(offsets) == ({} if span is None else {"span_db": span})


def test_of_quantities_of_one_cell_the_power_of_its_signal_leads() -> None:
    cell = {"node": "LW1", "rat": "lte", "pci": 3, "arfcn": 7}
    rsrp, rsrq, rssi, other = (
        stream("rss", [1.0], name=name, quantity=quantity, **(cell | {"pci": pci}))
        for name, quantity, pci in (("a", "RSRP", 3), ("b", "RSRQ", 3), ("c", "RSSI", 3), ("d", "RSSI", 4))
    )
    assert drafting._leading([rssi, rsrq, other, rsrp]) == {"c": "a", "b": "a"}
    assert drafting._leading([rssi, other, stream("rank", [1.0])]) == {}
    second = stream("rss", [1.0], name="e", quantity="RSRP", part="sim2", **cell)  # another receiver of that cell
    assert drafting._leading([rsrp, second]) == {}


@pytest.mark.parametrize(("share", "known"), [(0.5, False), (0.51, True)])
def test_an_attitude_is_there_where_most_rows_hold_it(share: float, known: bool) -> None:
    frame = pd.DataFrame(dict.fromkeys(("roll_deg", "pitch_deg"), np.zeros(100)))
    frame["yaw_deg"] = np.where(np.arange(100) < 100 * share, 1.0, np.nan)
    assert drafting._has_attitude(frame) is known
    assert not drafting._has_attitude(frame[["roll_deg", "pitch_deg"]])


def test_a_flight_file_keeps_and_names_five_flights(logs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    days = [f"2025-06-0{day}" for day in range(1, 6)]
    for day in days:
        for path in (next(logs.glob("UAV/*vehicleOut.txt")), logs / "LW1/USRP1_power_log.txt"):
            target = logs.parent / "five" / day / path.parent.name / path.name
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_text(path.read_text().replace(days[0], day))
    book = logs.parent / "all.h5"
    assert main(["ingest", str(logs.parent / "five"), "--timezone", ZONE, "-o", str(book)]) == 0
    names = [f"flight_{day}_1400" for day in days]
    assert f"5 flights, {', '.join(names)}" in capsys.readouterr().out
    assert len(read_flight(book)) == 10
    with pytest.raises(UsageError, match=", ".join(names)):
        open_flight(book)
    with pytest.raises(UsageError, match=f"no flight 'x'.*{names[0]}"):
        open_flight(book, flight="x")
    flight = open_flight(book, flight=names[2])
    assert flight.settings.flight.name == names[2]
    assert str(flight.track["time"].iloc[0]).startswith(days[2])


def test_a_ratio_to_the_noise_gets_a_span_from_its_levels(logs: Path) -> None:
    """The SNR of LW1 stands for its level: an offset of -80 dB lies outside the usual span."""
    lines = [line.rsplit(" ", 1) for line in (logs / "LW1/USRP1_power_log.txt").read_text().splitlines()]
    shifted = [f"{head} {float(level) + 60.0:.3f}" for head, level in lines if level.startswith("-")]
    assert len(shifted) > 50
    (logs / "LW1/snr_log.txt").write_text("\n".join(shifted) + "\n")
    for name in ("USRP1", "USRP2"):
        (logs / f"LW1/{name}_power_log.txt").unlink()
    files = ingest([logs / "LW1", *logs.glob("UAV/*vehicleOut.txt")], options=OPTIONS)
    text, _ = draft(files, logs, DraftOptions(timezone=ZONE))
    settings = parse_yaml(text, FlightFile)
    (series,) = load_data(settings, logs).rss
    placed = drafting.NodeFinder(load_site("lake_wheeler"), next(f for f in files if "UAV" in f.path).result.streams[0])
    level = next(s for f in files if "snr" in f.path for s in f.result.streams)
    expected = placed.offset_db(placed.levels(level), "LW1")
    assert series.channel
    assert expected is not None
    low, high = settings.rss.span_db
    assert low + 10.0 < expected < high - 10.0
    assert (low, high) != (-50.0, 50.0)


def test_what_a_phone_reports_is_drafted_as_downlink(logs: Path) -> None:
    rows = [
        f"2025-06-01 14:0{n // 60}:{n % 60:02d},{35.7275 + n * 1e-5:.6f},-78.696,{20 + n % 9},{-80 - n % 7}"
        for n in range(120)
    ]
    phone = logs / "phone.csv"
    phone.write_text("t,lat,lon,alt,p\n" + "\n".join(rows) + "\n")
    named = {"time": "t", "rss_db": "p"}
    of_level = ReadOptions(timezone="UTC", kind="rss", columns=named, unit="dBm")
    (file,) = ingest([phone], reader="generic_csv", options=of_level)
    (stream,) = file.result.streams
    modem = replace(stream, attributes={**stream.attributes, "quantity": "RSRP"})
    files = [
        replace(file, result=replace(file.result, streams=(modem,))),
        *ingest(logs.glob("UAV/*vehicleOut.txt"), options=OPTIONS),
    ]
    entries = drafting.draft(
        files, logs, DraftOptions(timezone=ZONE, mapping={"columns": named, "kind": "rss", "unit": "dBm"})
    )
    assert "uav_transmits: false" in entries[0]
    assert "the unknown power is part of the offset" in entries[0]
    assert parse_yaml(entries[0], FlightFile).link.rss.uav_transmits is False


@pytest.mark.parametrize("form", ["csv", "kml"])
def test_the_rank_receiver_goes_with_the_quantity_in_any_format(logs: Path, form: str) -> None:
    frame = pd.DataFrame({"rank": [1.0, 2.0] * 150, "n": range(300)})
    lat, lon = 35.7275 + frame["n"] * 1e-6, np.full(300, -78.696)
    if form == "csv":
        head = "index,rel_time_ms,lat,lon,alt_m,pdsch_rank,nr_rsrp_dbm,nr_sinr_db,wb_cqi\n"
        text = head + "".join(
            f"{n},{500 * n},{a},{o},30,{r:g},-90,20,12\n"
            for n, a, o, r in zip(frame["n"], lat, lon, frame["rank"], strict=True)
        )
    else:
        marks = "".join(
            f"<Placemark><description><p>rel_time = {500.0 * n} ms</p><p>PDSCH rank (NR) = {r} </p><p>(lat, lon) = ({a},{o})"
            f"</p><p> altitude = 30.0 m</p></description></Placemark>\n"
            for n, a, o, r in zip(frame["n"], lat, lon, frame["rank"], strict=True)
        )
        text = (
            f'<?xml version="1.0"?>\n<kml xmlns="http://www.opengis.net/kml/2.2"><Document>\n{marks}</Document></kml>\n'
        )
    (logs / f"LW1/nemo.{form}").write_text(text)
    origin = "2025-06-01T14:00:00Z"
    options = ReadOptions(timezone=ZONE, time_origin=origin)
    files = [
        *ingest([logs / f"LW1/nemo.{form}"], options=options),
        *ingest(logs.glob("UAV/*vehicleOut.txt"), options=options),
    ]
    text, _ = draft(files, logs, DraftOptions(timezone=ZONE, time_origin=origin))
    assert "receiver: lake_wheeler/nr_rank" in text
