"""Series of a flight from its logs."""

from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest

from aerpaw_cmp.__main__ import main
from aerpaw_cmp.common.errors import InputError, UsageError
from aerpaw_cmp.flight import data
from aerpaw_cmp.flight.data import FlightData, choose_site, gather, load_data, read_logs
from aerpaw_cmp.flight.rows import frozen
from aerpaw_cmp.flight.settings import FlightFile, load_flight
from aerpaw_cmp.flight.simulate import FlightSimulator
from aerpaw_cmp.site.siteyaml import load_site, site_model

pytestmark = pytest.mark.usefixtures("blank_pictures")

SAMPLE = Path(__file__).parents[2] / "sample_logs"
PACKAGED = Path(__file__).parents[2] / "aerpaw_cmp" / "site" / "data"


def _flight(folder: Path, *logs: str) -> FlightData:
    (folder / "flight.yaml").write_text(
        "flight: f\ntimezone: America/New_York\nlogs:\n"
        f"  - {{path: {next(SAMPLE.glob('UAV/*vehicleOut.txt'))}}}\n" + "".join(f"  - {{{log}}}\n" for log in logs)
    )
    return load_data(load_flight(folder / "flight.yaml"), folder)


def _halves(folder: Path, log: str) -> list[str]:
    lines = (SAMPLE / log).read_text().splitlines(keepends=True)
    head = [lines[0]] if log.endswith(".csv") else []
    (folder / "a.txt").write_text("".join(lines[:300]))
    (folder / "b.txt").write_text("".join(head + lines[300:]))
    return ["b.txt", "a.txt"]  # the later half first


def test_a_radio_started_anew_is_one_record(tmp_path: Path) -> None:
    log = "LW1/USRP1_power_log.txt"
    (uncut,) = _flight(tmp_path, f"path: {SAMPLE / log}, node: LW1, channel: USRP1").rss
    parts = _flight(tmp_path, *(f"path: {p}, node: LW1, channel: USRP1" for p in _halves(tmp_path, log)))
    (joined,) = parts.rss
    np.testing.assert_array_equal(joined.time, uncut.time)
    np.testing.assert_array_equal(joined.measured_db, uncut.measured_db)
    assert len(parts.files) == 3


def test_parts_of_which_one_says_no_serving_cell_are_one_record(tmp_path: Path) -> None:
    """A phone changed its log. If one part does not name the serving cell, it is unknown, in either order."""
    halves = _halves(tmp_path, "LW1/USRP1_power_log.txt")
    uncut = _flight(tmp_path, *(f"path: {p}, node: LW1, channel: USRP1" for p in halves))
    settings = load_flight(tmp_path / "flight.yaml")
    for spoken in range(2):
        files = read_logs(settings, tmp_path)
        levels = [stream for file in files for stream in file.result.streams if stream.kind == "rss"]
        levels[spoken].frame["serving"] = 1.0
        (joined,) = gather(settings, tmp_path, files).rss
        assert joined.serving is not None
        assert len(joined.serving) == len(joined.time) == len(uncut.rss[0].time)
        assert np.nansum(joined.serving) == np.isfinite(joined.serving).sum() > 100
        assert np.isnan(joined.serving).sum() > 100


@pytest.mark.parametrize(("digits", "frozen"), [(6, 139), (0, 0)])
def test_a_level_frozen_to_all_digits_in_flight_is_not_scored(digits: int, frozen: int, tmp_path: Path) -> None:
    """A level is constant for 70 s. A level that is rounded to 1 dB often repeats."""
    written = (SAMPLE / "LW1/USRP1_power_log.txt").read_text().splitlines()
    lines = [line for line in written if len(line.split()) == 4]
    assert len(lines) > 600
    noisy = [f"{float(line.split()[-1]):.{digits}f}" for line in lines]
    noisy[300:440] = noisy[300:301] * 140
    text = "".join(f"{line[:37]} {level}\n" for line, level in zip(lines, noisy, strict=True))
    (tmp_path / "a.txt").write_text(text)
    flight = _flight(tmp_path, "path: a.txt, node: LW1, channel: USRP1")
    (series,) = flight.rss
    assert series.flagged.get("level_frozen", 0) == frozen
    assert len(series.time) == len(lines) - frozen
    assert any("repeat one level" in text for text in flight.warnings) is bool(frozen)


@pytest.mark.parametrize(("stops", "expected"), [(None, 0), (30, 69), (130, 69)])
def test_a_smooth_level_is_frozen_only_if_it_leaps_or_stops_within_its_range(stops: int | None, expected: int) -> None:
    """A phone in tenths of a dB that passes a tower at 60 m at 4 m/s, and whose scale ends at -58 dBm."""
    time = (np.arange(200) * 1_000_000_000).astype("datetime64[ns]")
    position_m = np.column_stack([np.full(200, 60.0), -400.0 + 4.0 * np.arange(200), np.full(200, 30.0)])
    level = np.minimum(np.round(-20.0 - 20.0 * np.log10(np.linalg.norm(position_m, axis=1)), 1), -58.0)
    assert (level == -58.0).sum() > 15
    if stops is not None:
        level[stops : stops + 70] = level[stops]
    assert frozen(time, level, position_m).sum() == expected


def test_a_receiver_whose_week_number_rolled_over_is_named_and_shifted(tmp_path: Path) -> None:
    """1024 weeks before 1 June 2025 is 16 October 2005."""
    track = next(SAMPLE.glob("UAV/*vehicleOut.txt")).read_text().replace("2025-06-01", "2005-10-16")
    (tmp_path / "v_vehicleOut.txt").write_text(track)
    lines = "flight: f\ntimezone: America/New_York\nlogs:\n  - {path: v_vehicleOut.txt}\n"
    level = f"  - {{path: {SAMPLE / 'LW1/USRP1_power_log.txt'}, node: LW1, channel: USRP1}}\n"
    (tmp_path / "flight.yaml").write_text(lines + level)
    with pytest.raises(InputError, match=r"telemetry is 7168 days \(1024 weeks\) early; write 'gps_rollovers: 1'"):
        load_data(load_flight(tmp_path / "flight.yaml"), tmp_path)
    (tmp_path / "flight.yaml").write_text(lines.replace("Out.txt}", "Out.txt, gps_rollovers: 1}") + level)
    shifted = load_data(load_flight(tmp_path / "flight.yaml"), tmp_path)
    right = _flight(tmp_path, level.strip(" -{}\n")).track
    assert shifted.track is not None
    assert right is not None
    assert (shifted.track.start_ns, shifted.track.end_ns) == (right.start_ns, right.end_ns)


def test_one_of_two_cells_that_only_a_number_distinguishes_is_chosen_by_its_stream(tmp_path: Path) -> None:
    begin = 1_748_786_400  # 2025-06-01 14:00:00 UTC, in the sample flight
    rows = (f"{begin + 60 + i},Op,310,{51200001 + i // 20 % 2 * 513},{-80 - 20 * (i // 20 % 2)}" for i in range(120))
    (tmp_path / "phone.csv").write_text("\n".join(["timestamp,operator,mcc,cell_id,rsrp", *rows, ""]))
    with pytest.raises(UsageError, match=r"two streams of one log contain RSS of LW1 P .*'cells: \{STREAM: TOWER\}'"):
        _flight(tmp_path, "path: phone.csv, node: LW1, channel: P")
    (series,) = _flight(tmp_path, "path: phone.csv, channel: P, cells: {rsrp_cell51200001: LW1}").rss
    assert set(series.measured_db) == {-80.0}


def test_a_rank_log_in_two_parts_is_one_record(tmp_path: Path) -> None:
    log = "UAV/modem_ri.csv"
    (uncut,) = _flight(tmp_path, f"path: {SAMPLE / log}").rank
    (joined,) = _flight(tmp_path, *(f"path: {p}" for p in _halves(tmp_path, log))).rank
    np.testing.assert_array_equal(joined.rank, uncut.rank)
    np.testing.assert_array_equal(joined.position_m, uncut.position_m)


def test_two_records_of_one_channel_are_refused(tmp_path: Path) -> None:
    logs = [f"path: {SAMPLE / 'LW1' / f'USRP{i}_power_log.txt'}, node: LW1" for i in (1, 2)]
    with pytest.raises(UsageError, match=r"two logs contain RSS of LW1 power .*USRP1.*USRP2.*'channel'"):
        _flight(tmp_path, *logs)
    assert len(_flight(tmp_path, logs[0], f"{logs[1]}, channel: second").rss) == 2
    with pytest.raises(UsageError, match="rank of LW1"):
        _flight(tmp_path, *[f"path: {SAMPLE / 'UAV/modem_ri.csv'}"] * 2)


def test_a_ratio_is_known_by_its_channel_and_the_report_warns(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "snr.csv").write_text(
        "time,snr_lw1,snr_lw2\n" + "".join(f"2025-06-01T10:01:{s:02d},{20 + s % 3},{10 + s % 2}\n" for s in range(40))
    )
    (warning,) = _flight(tmp_path, "path: snr.csv, reader: aadm_snr").warnings
    assert "'LW1', 'LW2' are ratios to the noise" in warning
    assert "skip: [LW1, LW2]" in warning
    assert main(["report", str(tmp_path / "flight.yaml"), "--audit", "none", "-o", str(tmp_path / "out")]) == 0
    assert f"warning: {warning}" in capsys.readouterr().err


def test_levels_of_another_carrier_than_that_of_their_replay_are_told(tmp_path: Path) -> None:
    rows = "".join(f"2025-06-01T10:01:{s:02d},{2100 + 1200 * (s % 2)},{-80 - s % 3}\n" for s in range(40))
    (tmp_path / "l.csv").write_text("time,freq_mhz,p\n" + rows)
    columns = "columns: {time: time, rss_db: p}, reader: generic_csv, kind: rss, unit: dBm, node: LW1"
    texts = _flight(tmp_path, f"path: l.csv, {columns}").warnings
    assert [text for text in texts if "measured at" in text] == [
        "l.csv: 'rss_freq2100' was measured at 2100 MHz and is replayed at carrier_hz 3300 MHz"
    ]


def test_a_table_is_listed_once_per_column_of_levels(tmp_path: Path) -> None:
    """The content of the table would choose another reader, which reads positions only."""
    rows = (f"2025-06-01T10:00:{s:02}Z,{35.7275 + 1e-5 * s:.5f},-78.696,{4 * s},{-70 - s},{-80 - s}" for s in range(60))
    (tmp_path / "t.csv").write_text("\n".join(["Zeit,Lat,Lon,Alt,Power A [dBm],Power B [dBm]", *rows]))
    pose = (
        "{path: t.csv, kind: telemetry, columns: {time: Zeit, latitude_deg: Lat, longitude_deg: Lon, altitude_m: Alt}}"
    )
    levels = (
        f"{{path: t.csv, kind: rss, columns: {{time: Zeit, rss_db: 'Power {column} [dBm]'}}, unit: dBm, node: {node}}}"
        for column, node in (("A", "LW1"), ("B", "LW2"))
    )
    text = f"flight: f\nsite: lake_wheeler\ntimezone: UTC\nlogs: [{', '.join([pose, *levels])}]\n"
    (tmp_path / "flight.yaml").write_text(text)
    flight = load_data(load_flight(tmp_path / "flight.yaml"), tmp_path)
    assert {series.tower: series.measured_db[0] for series in flight.rss} == {"LW1": -70.0, "LW2": -80.0}
    assert not any("not read" in text for text in flight.warnings)


def test_the_site_lies_by_the_flight_file_and_the_logs_elsewhere(tmp_path: Path) -> None:
    """Its grounds and antennas are read from there again: --logs-root does not move them."""
    track = next(SAMPLE.glob("UAV/*vehicleOut.txt")).relative_to(SAMPLE)
    (tmp_path / "flight.yaml").write_text(
        "flight: f\nsite: site.yaml\ntimezone: America/New_York\nlogs:\n"
        f"  - {{path: {track}}}\n  - {{path: LW1/USRP1_power_log.txt, node: LW1}}\n"
    )
    (tmp_path / "site.yaml").write_bytes((PACKAGED / "lake_wheeler.yaml").read_bytes())
    flight = load_data(load_flight(tmp_path / "flight.yaml"), tmp_path, SAMPLE)
    assert flight.folder == SAMPLE
    assert site_model(flight.site_place) == site_model("lake_wheeler")


def test_names_in_the_flight_file_that_fit_nothing_are_told(tmp_path: Path) -> None:
    log = f"path: {SAMPLE / 'LW1/USRP1_power_log.txt'}, node: LW1"
    (warning,) = _flight(tmp_path, f"{log}, skip: [qualty]").warnings
    assert "no stream is named qualty: its streams are power" in warning
    text = (tmp_path / "flight.yaml").read_text().replace(", skip: [qualty]", "")
    (tmp_path / "flight.yaml").write_text(text + "link: {channels: {USRP1: {carrier_hz: 3.3e9}}}\n")
    with pytest.raises(UsageError, match="no channel 'USRP1'; expected one of power"):
        load_data(load_flight(tmp_path / "flight.yaml"), tmp_path)


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ("rss: {span_db: [-1.0e+9, 1.0e+9]}", "more than 1000000 offsets to try"),
        ("rss: {step_db: 0.5}", "unknown key 'rss.step_db'"),
        ("rss: {advanced: {lag_window_s: 1.0e+12}}", "less than or equal to 3600"),
        ("rt: {advanced: {maximum_gap_s: .nan}}", "finite number|greater than 0"),
    ],
)
def test_settings_that_no_memory_could_hold_are_refused_in_the_file(tmp_path: Path, keys: str, words: str) -> None:
    (tmp_path / "flight.yaml").write_text(f"flight: f\nlogs: [{{path: a.txt}}]\n{keys}\n")
    with pytest.raises(UsageError, match=words):
        load_flight(tmp_path / "flight.yaml")


@pytest.mark.parametrize(
    ("plan", "words"),
    [
        ("rss_interval_s: 1.0e-9", "at most 5000000 samples"),
        ("speed_mps: 1.0e-300", "at most 5000000 samples"),
        ("start: 2025-03-09T02:30:00", "the clocks changed then"),
        ("start: 2025-11-02T01:30:00", "the clocks changed then"),
        ("start: 9999-12-31T00:00:00", "a wall time"),
    ],
)
def test_plans_that_cannot_be_flown_are_refused(tmp_path: Path, plan: str, words: str) -> None:
    given = {
        "start": "2025-06-01T10:00:00",
        "waypoints": "[{east_m: 0, north_m: 0, height_m: 5}, {east_m: 9, north_m: 0, height_m: 5}]",
    }
    key, _, value = plan.partition(": ")
    body = ", ".join(f"{k}: {v}" for k, v in (given | {key: value}).items())
    (tmp_path / "flight.yaml").write_text(
        f"flight: {{name: f, plan: {{{body}}}}}\ntimezone: America/New_York\nlogs: [{{path: v.txt, reader: vehicle_out}}]\n"
    )
    settings = load_flight(tmp_path / "flight.yaml")
    with pytest.raises(UsageError, match=words):
        FlightSimulator(settings, choose_site(settings.site, tmp_path), tmp_path).run(tmp_path / "out")


def test_a_nemo_table_gives_its_levels_its_own_positions(tmp_path: Path) -> None:
    """No other telemetry is here: each row has its place."""
    rows = ["index,rel_time_ms,lat,lon,alt_m,pdsch_rank,nr_rsrp_dbm,nr_sinr_db,wb_cqi"]
    rows += [f"{i},{500 * i},35.7275,{-78.696 + 1e-5 * i},{20 + i % 3},{1 + i % 2},-80.5,20.1,11" for i in range(40)]
    (tmp_path / "nemo.csv").write_text("\n".join(rows) + "\n")
    (tmp_path / "flight.yaml").write_text(
        "flight: ranks\nsite: lake_wheeler\ntimezone: UTC\nlogs: [{path: nemo.csv, node: LW1}]\n"
    )
    data = load_data(load_flight(tmp_path / "flight.yaml"), tmp_path)
    assert [(s.tower, len(s.time)) for s in data.rank] == [("LW1", 40)]
    assert [(s.tower, len(s.time)) for s in data.rss] == [("LW1", 40)]
    assert not any("have no positions" in text for text in data.warnings)


def _stream(kind: str, name: str, frame: pd.DataFrame, **attributes: str) -> Any:
    return SimpleNamespace(kind=kind, name=name, frame=frame, attributes=attributes)


@pytest.mark.parametrize(("away", "near"), [(29.9, True), (30.1, False), (-29.9, True), (-30.1, False)])
def test_places_are_near_a_tower_up_to_thirty_kilometres(away: float, near: bool) -> None:
    """On a map whose degrees are kilometres, the nearest of positions and towers is used."""
    frame: Any = SimpleNamespace(to_local=lambda latitude, longitude: (1000.0 * longitude, 1000.0 * latitude))
    towers = {
        "A": SimpleNamespace(position_m=[500.0, 700.0, 9.0]),
        "B": SimpleNamespace(position_m=[500.0, -700.0, 9.0]),
    }
    site: Any = SimpleNamespace(frame=frame, towers=towers, name="s")
    places = np.array([[0.7 + 3.0, 0.5 + away], [0.7, 0.5 + away], [91.0, 0.5], [np.nan, 0.5], [0.7, -181.0]])
    assert data.nearest_m(site, places[:, 0], places[:, 1]) == pytest.approx(1000.0 * abs(away))
    with nullcontext() if near else pytest.raises(InputError, match="a route within 30 km of a tower"):
        data.check_place(site, "a", pd.DataFrame(places, columns=["latitude_deg", "longitude_deg"]), "route")
    assert np.isnan(data.nearest_m(site, np.array([91.0, np.nan]), np.array([0.0, 1.0])))
    assert np.isfinite(data.nearest_m(site, np.array([90.0]), np.array([-180.0])))


@pytest.mark.parametrize(
    ("turned", "cause"),
    [(lambda a, o: (o, a), "swapped"), (lambda a, o: (a, -o), "west"), (lambda a, o: (-a, o), "south"),
     (lambda a, o: (-o, a), "swapped and a sign")],
)  # fmt: skip
def test_angles_that_are_turned_are_told_from_their_place(turned: Any, cause: str) -> None:
    site = load_site("lake_wheeler")
    latitude, longitude = turned(np.array([35.7275, np.nan]), np.array([-78.696, np.nan]))
    frame = pd.DataFrame({"latitude_deg": latitude, "longitude_deg": longitude})
    with pytest.raises(InputError) as raised:
        data.check_place(site, "a", frame)
    assert cause in str(raised.value)


def test_ranks_lie_at_their_own_places_and_on_the_track_where_they_have_none() -> None:
    position = np.array([[1.0, 2.0, 3.0], [np.nan] * 3, [np.nan] * 3, [4.0, np.nan, 6.0]])
    there = np.arange(12.0).reshape(4, 3)
    pose = SimpleNamespace(position_m=there, valid=np.array([True, True, False, True]))
    track: Any = SimpleNamespace(pose_at=lambda _: pose)
    own: Any = SimpleNamespace(position_m=position, time=np.zeros(4))
    without: Any = SimpleNamespace(position_m=None, time=np.zeros(4))
    place, known = data.rank_positions(own, track)
    assert known.tolist() == [True, True, False, True]
    np.testing.assert_array_equal(place[[0, 1, 3]], [position[0], there[1], there[3]])
    place, known = data.rank_positions(own, None)
    assert known.tolist() == [True, False, False, False]
    place, known = data.rank_positions(without, track)
    np.testing.assert_array_equal(place, there)
    assert known.tolist() == pose.valid.tolist()


@pytest.mark.parametrize(
    ("given", "noise"), [({}, None), ({"bandwidth_hz": 20e6, "noise_figure_db": 5.0}, -174.0 + 73.01 + 5.0)]
)
def test_a_ratio_becomes_a_level_where_its_noise_is_known(given: dict[str, float], noise: float | None) -> None:
    link = FlightFile.model_validate(
        {"flight": "f", "logs": [{"path": "a"}], "link": {"rss": {"carrier_hz": 3e9} | given}}
    ).link.rss
    frame = pd.DataFrame({"rss_db": [1.0]})
    noise_dbm, left = data._noise(_stream("rss", "snr", frame), link)
    assert noise_dbm == (None if noise is None else pytest.approx(noise, abs=0.1))
    if noise is not None:
        assert left.bandwidth_hz is None
    assert data._noise(_stream("rss", "quality", frame), link) == (None, link)
    for stream, ratio in (
        (_stream("rss", "Quality", frame), True), (_stream("rss", "x", frame, channel="SNR"), True),
        (_stream("rss", "x", frame, quantity="snr"), True), (_stream("rss", "power", frame), False),
        (_stream("rank", "snr", frame), False),
    ):  # fmt: skip
        assert data.is_ratio(stream) is ratio


def test_a_missing_log_is_reported_before_the_others_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "large.txt").write_text("x")
    logs = [{"path": "large.txt"}, {"path": "missing.txt"}]
    settings = FlightFile.model_validate({"flight": "f", "site": "lake_wheeler", "logs": logs})
    monkeypatch.setattr(data, "read_log", lambda *_, **__: pytest.fail("a log was read"))
    with pytest.raises(InputError, match=r"missing\.txt: there is no such log"):
        read_logs(settings, tmp_path)
