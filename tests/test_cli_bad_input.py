"""Check that every bad input ends the command line with one clear message and exit code 2 or 3.

There is never a traceback.
"""

import re
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from aerpaw_cmp.__main__ import main
from tests.parsers.autopilots import dataflash

pytestmark = pytest.mark.usefixtures("blank_pictures")

GOOD_TELEMETRY = "".join(
    f'{i},{-78.6963 + i * 1e-5:.7f},35.7274,{10 + i * 0.1:.3f},"(0.01,1.57,0.0)","(0.0,0.9,0.0)",48.2,'
    f"2025-06-01 10:00:{i:02d}.000000,3,15\r\n"
    for i in range(1, 40)
)
GOOD_POWER = "".join(
    f"[2025-06-01 10:00:{i:02d}.500000] {4 * (i - 1):07o}      {-30 - i * 0.1:.6f}\n" for i in range(1, 39)
)
FLIGHT = """\
flight: bad
site: lake_wheeler
timezone: America/New_York
logs:
  - {path: vehicleOut.txt, reader: vehicle_out}
  - {path: power_log.txt, reader: sounder_log, node: LW1, channel: USRP1}
rt: {audit_links: 0}
rss: {lag: "off"}
"""

Run = Callable[..., tuple[int, str]]


@pytest.fixture
def run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Run:
    """Write the files of a flight (changed as asked) and run ``report`` on it."""

    def go(flight: str = FLIGHT, **files: bytes | str | None) -> tuple[int, str]:
        contents: dict[str, bytes | str | None] = {"vehicleOut": GOOD_TELEMETRY, "power_log": GOOD_POWER, **files}
        for name, content in contents.items():
            if content is not None:
                data = content.encode() if isinstance(content, str) else content
                (tmp_path / f"{name}.txt").write_bytes(data)
        (tmp_path / "flight.yaml").write_text(flight)
        code = main(["report", str(tmp_path / "flight.yaml"), "-o", str(tmp_path / "out")])
        captured = capsys.readouterr()
        assert "Traceback" not in captured.err + captured.out
        return code, captured.err

    return go


def test_the_unchanged_flight_passes(run: Run, tmp_path: Path) -> None:
    code, err = run()
    assert code == 0, err
    assert (tmp_path / "out" / "report.html").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("name", "files", "code", "words"),
    [
        ("missing", {"power_log": None}, 3, "no such log"),
        ("empty", {"power_log": b""}, 3, "empty"),
        ("rubbish", {"power_log": bytes(range(256)) * 8}, 3, "power_log.txt"),
        ("lfs", {"power_log": "version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 5\n"}, 3, "Git-LFS"),
        ("other_kind", {"power_log": GOOD_TELEMETRY}, 3, "vehicle_out"),
        ("no_overlap", {"power_log": GOOD_POWER.replace("2025-06-01", "2025-06-03")}, 3, "no overlap"),
        ("hours_off", {"power_log": GOOD_POWER.replace(" 10:", " 14:")}, 3, "stored as if they were UTC"),
        ("misnamed", {"power_log": None, "power_logs": GOOD_POWER}, 3, "replace power_log.txt by power_logs.txt in"),
        ("minus_999", {"vehicleOut": GOOD_TELEMETRY.replace("35.7274,", "-999,").replace("-78.69", "-999.69")}, 3, ""),
    ],
)
def test_bad_logs(run: Run, name: str, files: dict[str, bytes | str | None], code: int, words: str) -> None:
    exit_code, err = run(**files)
    assert exit_code == code, err
    assert words in err


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("site: lake_wheeler", "sit: lake_wheeler"), "'site'"),
        (("site: lake_wheeler", "site: lake_wheeler\nsite: lake_wheeler"), "duplicate key"),
        (("site: lake_wheeler", "site: lake_weeler"), "lake_wheeler"),
        (("node: LW1", "node: LW9"), "LW9"),
        (("timezone: America/New_York\n", ""), "timezone"),
        (("America/New_York", "America/New_Pork"), "America/New_Pork"),
        (("reader: sounder_log", "reader: sounder_lug"), "sounder_log"),
        (("channel: USRP1", "chanel: USRP1"), "'channel'"),
        (("audit_links: 0", "audit_links: many"), "audit_links"),
        (("  - {path: power_log.txt, reader: sounder_log, node: LW1, channel: USRP1}\n", ""), "RSS or rank"),
        (("  - {path: vehicleOut.txt, reader: vehicle_out}\n", ""), "no telemetry"),
        (("rt: {audit_links: 0}", "rt: {audit_links: 0, max_depth: 9}"), "max_depth"),
        (('rss: {lag: "off"}', "rss: {advanced: {lag_window_s: 0.01}}"), "lag_window_s"),
        (
            ("rt:", "  - {path: power_log.txt, node: LW1, channel: USRP1}\nrt:"),
            "Likely cause: a log that is listed twice",
        ),
        (('lag: "off"', "lag: 1e15"), "rss.lag: found 1000000000000000.0; expected less than or equal to 86400"),
        (
            ("rt:", "link: {rss: {carrier_hz: 3e9, transmit_power_dbm: 1e300}}\nrt:"),
            "expected less than or equal to 100",
        ),
        (("America/New_York", "EST"), "or Etc/GMT+5 (without). Next: fix flight.yaml and run the same command"),
        (("rt:", "link: {rss: {carrier_hz: 60e9}}\nrt:"), "Next: fix flight.yaml and run the same command"),
    ],
)
def test_bad_flight_files(run: Run, change: tuple[str, str], words: str) -> None:
    assert change[0] in FLIGHT
    code, err = run(FLIGHT.replace(*change))
    assert code == 2, err
    assert words in err


def test_a_site_is_searched_in_the_folder_of_the_flight_file_only(run: Run, tmp_path: Path, monkeypatch: Any) -> None:
    (work := tmp_path / "work").mkdir()
    (work / "site.yaml").touch()
    monkeypatch.chdir(work)
    code, err = run(FLIGHT.replace("lake_wheeler", "site.yaml"))
    assert code == 3
    assert f"{tmp_path / 'site.yaml'}: no such file" in err


@pytest.mark.parametrize("command", ["report", "map"])
def test_a_file_of_the_site_is_not_sent_to_ingest(run: Run, tmp_path: Path, command: str, capsys: Any) -> None:
    """Neither 'ingest' nor another argument helps if the site names a damaged elevation model."""
    place = "latitude_deg: 35.7, longitude_deg: -78.7"
    (site := tmp_path / "site.yaml").write_text(
        f"name: s\norigin: {{{place}, ground: {{height_m: 79, reference: orthometric}}}}\n"
        f"dem: {{path: dem.asc, crs: EPSG:4326}}\ntowers: {{LW1: {{{place}}}}}\n"
    )
    (tmp_path / "dem.asc").write_text("hello\n")
    code, err = run(FLIGHT.replace("lake_wheeler", "site.yaml"))
    if command == "map":
        code, err = main(["map", str(site), "-o", str(tmp_path / "out")]), capsys.readouterr().err
    assert code == 3
    assert "dem.asc, line 1: header 'hello'; expected a name and a number. " in err
    assert "Next: correct dem.asc or name another file, and run the same command" in err


def test_ranks_above_four_are_not_compared(run: Run) -> None:
    array = "{layout: linear, elements: 8}"
    link = f"link: {{rank: {{carrier_hz: 3.4e9, tower: {array}, uav: {array}}}}}"
    rows = (f"{i},2025-06-01 10:00:{i:02d}.000,-78.6960,35.7274,20,{8 if i == 5 else 3}\n" for i in range(1, 39))
    ranks = "ID,Time and date,Longitude,Latitude,Altitude,NR RI\n" + "".join(rows)
    ranked = FLIGHT.replace("rt:", "  - {path: ri.txt, reader: quectel_ri, node: LW1}\nrt:")
    code, err = run(ranked, ri=ranks)
    assert code == 0, err
    assert "rank 8 in line 6, but ranks are compared for at most 4 ports" in err
    code, err = run(ranked.replace("rt:", f"{link}\nrt:"), ri=ranks)
    assert code == 2, err
    assert "link.rank of LW1 has more than 4 elements at both ends" in err


def test_nan_positions_are_left_out_not_fatal(run: Run) -> None:
    lines = GOOD_TELEMETRY.splitlines(keepends=True)
    lines[5] = lines[5].replace("35.7274", "nan")
    lines[7] = lines[7].replace("35.7274", "-999").replace("-78.69", "-999.69")
    code, err = run(vehicleOut="".join(lines))
    assert code == 0, err


def test_a_flight_below_the_ground_has_no_waypoints_on_its_track(run: Run) -> None:
    """A waypoint has a time only if some position of the track after the waypoint before it is known."""
    below = re.sub(r"35.7274,\d+", "35.7274,-80", GOOD_TELEMETRY)
    points = ", ".join(f"{{label: {label}, east_m: 0, north_m: 0, height_m: 30}}" for label in "AB")
    code, err = run(FLIGHT + f"report: {{waypoints: [{points}]}}\n", vehicleOut=below)
    assert code == 1, err  # nothing was compared
    assert "39 telemetry rows below the site's ground" in err


KINDS = {
    "report": FLIGHT,
    "calibrate": "calibration: a\nflights: [x.yaml]\n",
    "campaign": "campaign: a\nflights: [x.yaml]\ncalibration: tower\n",
    "map": "name: a\norigin: {}\ntowers: {}\n",
}


@pytest.mark.parametrize("command", KINDS)
def test_settings_of_another_kind_are_told_as_such(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The file is refused as a whole, and the next step names the command that reads it."""
    monkeypatch.chdir(tmp_path)  # a path with a blank would be quoted
    for reader, text in KINDS.items():
        Path("file.yaml").write_text(text)
        if reader != command and (reader, command) != ("report", "calibrate"):  # which takes flight files, too
            assert main([command, "file.yaml"]) == 2
            err = capsys.readouterr().err
            assert f"Next: 'aerpaw-cmp {reader} file.yaml'" in err
            assert "unknown key" not in err


def test_only_the_log_that_lacks_a_zone_has_no_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # the table would break a long path within the name of the file
    (tmp_path / "a.txt").write_text(GOOD_POWER)
    row = "2024-07-02T15:37:1{0}Z,-8{0},35.72,-78.69,30\n"
    (tmp_path / "b.csv").write_text("time,rsrp_dbm,latitude,longitude,altitude\n" + row.format(0) + row.format(1))
    assert main(["ingest", "."]) == 2
    out, err = capsys.readouterr()
    assert "b.csv" in out
    assert "drive_test" in out
    assert "a.txt: no time zone" in err
    assert main(["ingest", ".", "--timezone", "America/NewYork"]) == 2
    assert "a.txt" not in (err := capsys.readouterr().err)
    assert "did you mean 'America/New_York'" in err


def test_a_line_without_end_is_offered_no_columns(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "huge.csv").write_text("time,power," + "level," * 20_000)
    assert main(["ingest", str(tmp_path / "huge.csv")]) == 3
    err = capsys.readouterr().err
    assert "no line ends" in err
    assert "--map" not in err


def test_named_columns_are_those_of_tables(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A table in a folder with other logs: the options that its message names apply to the folder, too."""
    (tmp_path / "1.BIN").write_bytes(dataflash())
    (tmp_path / "walk.csv").write_text("time,lat,lon,alt\n2025-03-02T15:00:01Z,35.73,-78.7,1\n")
    (tmp_path / "levels.csv").write_text("Time (UTC),Received power (dBm)\n2025-03-02T15:00:01,-80\n")
    assert main(["ingest", str(tmp_path)]) == 0
    words = re.search(r"levels.csv: skipped: .*?(--map .*)", capsys.readouterr().err)
    assert words
    assert main(["ingest", str(tmp_path), *shlex.split(words[1]), "--draft", str(tmp_path / "f.yaml")]) == 0
    assert "pose_csv" in capsys.readouterr().out
    assert "ardupilot_bin" in (draft := (tmp_path / "f.yaml").read_text())
    assert "generic_csv" in draft
