"""Folders of several flights: one draft each, and origins of relative times from tracks."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from aerpaw_cmp.__main__ import main
from aerpaw_cmp.flight.clock import origin_of
from aerpaw_cmp.flight.cross_checks import flights
from aerpaw_cmp.flight.data import load_data
from aerpaw_cmp.flight.drafting.draft import DraftOptions, drafts
from aerpaw_cmp.flight.settings import load_flight
from aerpaw_cmp.logs.ingest import ingest
from aerpaw_cmp.logs.readers import ReadOptions
from aerpaw_cmp.logs.records import COLUMNS, Stream
from aerpaw_cmp.logs.writers import format_power_log, format_vehicle_out
from tests.log_texts import nemo_csv

ZONE = "America/New_York"
OPTIONS = ReadOptions(timezone=ZONE)


def track(start: str, *, seconds: int = 300, turn: float = 1.0, east_deg: float = -78.7) -> pd.DataFrame:
    """A curved flight with a place of its own at each time."""
    t = np.arange(seconds)
    content = {name: np.zeros(seconds) for name in COLUMNS["telemetry"]}
    content["latitude_deg"] = 35.73 + 2e-3 * np.sin(turn * t / 40) + 1e-5 * t
    content["longitude_deg"] = east_deg + 2e-3 * np.cos(turn * t / 25)
    content["altitude_m"] = np.minimum(t, 30.0)
    frame = pd.DataFrame(content).assign(yaw_deg=10.0, fix=4, satellites=14, line=t + 1, flag="")
    return frame.assign(time=np.datetime64(start, "ns") + t * np.timedelta64(1, "s"))


def write_flight(folder: Path, start: str, **how: float) -> pd.DataFrame:
    folder.mkdir(parents=True)
    frame = track(start, **how)  # type: ignore[arg-type]
    (folder / "x_vehicleOut.txt").write_bytes(format_vehicle_out(frame, ZONE))
    times = frame["time"].to_numpy()[20:280]
    (folder / "LW1_power_log.txt").write_bytes(format_power_log(times, np.linspace(-40, -60, len(times)), ZONE))
    return frame


def nemo_of(frame: pd.DataFrame, origin: str) -> bytes:
    ranks = frame.iloc[30:250].assign(rank=2.0, ri_raw=2.0, rsrp_dbm=-80.0, sinr_db=20.0, cqi=10.0)
    return nemo_csv(ranks, origin)


def test_two_flights_in_a_folder_give_two_drafts(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    logs = tmp_path / "logs"
    write_flight(logs / "morning", "2025-03-02T15:00:00")
    write_flight(logs / "noon", "2025-03-02T17:00:00", turn=0.5)
    target = tmp_path / "flight.yaml"
    assert main(["ingest", str(logs), "--timezone", ZONE, "--draft", str(target)]) == 0
    said = capsys.readouterr().out
    assert "flight_2.yaml" in said
    first, second = load_flight(target), load_flight(tmp_path / "flight_2.yaml")
    assert {log.path for log in first.logs} == {"logs/morning/x_vehicleOut.txt", "logs/morning/LW1_power_log.txt"}
    assert {log.path for log in second.logs} == {"logs/noon/x_vehicleOut.txt", "logs/noon/LW1_power_log.txt"}
    assert first.flight != second.flight


def test_two_aircraft_at_one_time_are_two_flights(tmp_path: Path) -> None:
    write_flight(tmp_path / "here", "2025-03-02T15:00:00")
    write_flight(tmp_path / "there", "2025-03-02T15:00:10", east_deg=-78.5)
    grouped = flights(ingest(tmp_path, options=OPTIONS))
    assert len(grouped) == 2
    assert sorted(len(flight.files) for flight in grouped) in ([2, 2], [1, 3])


def test_relative_logs_find_the_flight_on_whose_track_they_lie(tmp_path: Path) -> None:
    write_flight(tmp_path / "logs" / "a", "2025-03-02T15:00:00")
    noon = write_flight(tmp_path / "logs" / "b", "2025-03-02T17:00:00", turn=0.5)
    (tmp_path / "logs" / "phone.csv").write_bytes(nemo_of(noon, "2025-03-02T17:00:07.300Z"))
    target = tmp_path / "flight.yaml"
    assert main(["ingest", str(tmp_path / "logs"), "--timezone", ZONE, "--draft", str(target)]) == 0
    text = (tmp_path / "flight_2.yaml").read_text()
    assert "phone.csv" in text
    assert "2025-03-02T17:00:07.3" in text
    assert "the same flight?" in text
    assert "phone.csv" not in target.read_text()


def test_a_log_on_the_route_of_two_flights_is_asked_about(tmp_path: Path) -> None:
    """The same route 90 minutes later: the log's times are relative, and its positions fit both."""
    write_flight(tmp_path / "logs" / "a", "2025-03-02T15:00:00")
    later = write_flight(tmp_path / "logs" / "b", "2025-03-02T16:30:00")
    (tmp_path / "logs" / "phone.csv").write_bytes(nemo_of(later, "2025-03-02T16:30:07.300Z"))
    target = tmp_path / "flight.yaml"
    assert main(["ingest", str(tmp_path / "logs"), "--timezone", ZONE, "--draft", str(target)]) == 0
    texts = [target.read_text(), (tmp_path / "flight_2.yaml").read_text()]
    (asked,) = (
        line for text in texts for line in text.splitlines() if "phone.csv" in line and "the same flight?" in line
    )
    assert "its positions are also on the track of the flight at 2025-03-02 1" in asked


def _phone_without_date(path: Path, hour: int, quantity: str = "RSRP") -> None:
    """Levels and positions with times of the day alone, as the urban LTE flights have them."""
    rows = [f"{hour}:00:{i:02d},{35.7275 + 1e-5 * i},{-78.696 + 2e-5 * i},{-70 - i % 5}" for i in range(40)]
    path.write_text("\n".join([f"Time,Latitude,Longitude,{quantity}", *rows]) + "\n", encoding="utf-8")


def test_a_log_of_no_level_on_two_dateless_flights_names_the_other_by_its_log(tmp_path: Path) -> None:
    for name, hour, quantity in (("a", 11, "RSRP"), ("b", 13, "RSRP"), ("c", 12, "Throughput")):
        _phone_without_date(tmp_path / f"{name}.csv", hour, quantity)
    (asked,) = (text for flight in flights(ingest(tmp_path, options=OPTIONS)) for text in flight.unsure.values())
    assert asked == "its positions are also on the track of the flight of b.csv: the same flight?"


def test_phones_that_know_no_date_are_a_flight_each(tmp_path: Path) -> None:
    """One draft named both, the second without its track."""
    (tmp_path / "logs").mkdir()
    _phone_without_date(tmp_path / "logs" / "60m.csv", 11)
    _phone_without_date(tmp_path / "logs" / "120m.csv", 13)
    target = tmp_path / "flight.yaml"
    assert main(["ingest", str(tmp_path / "logs"), "--timezone", ZONE, "--draft", str(target)]) == 0
    drafts = [target, tmp_path / "flight_2.yaml"]
    named = [[log.path for log in load_flight(draft).logs] for draft in drafts]
    assert sorted(named) == [["logs/120m.csv"], ["logs/60m.csv"]]
    for draft in drafts:
        data = load_data(load_flight(draft), tmp_path)
        assert data.track is not None
        assert len(data.rss) == 1


def test_radio_logs_of_two_days_without_any_track_are_two_drafts(tmp_path: Path) -> None:
    for name in ("a", "b"):
        day = write_flight(tmp_path / "logs" / name, f"2025-03-0{2 + (name == 'b')}T15:00:00")
        assert len(day)
        for telemetry in (tmp_path / "logs" / name).glob("*vehicleOut*"):
            telemetry.unlink()
    target = tmp_path / "flight.yaml"
    assert main(["ingest", str(tmp_path / "logs"), "--timezone", ZONE, "--draft", str(target)]) == 0
    for draft, name in ((target, "a"), (tmp_path / "flight_2.yaml", "b")):
        assert {Path(log.path).parent.name for log in load_flight(draft).logs} == {name}


def test_a_phone_that_knows_no_date_goes_with_the_flight_in_its_folder(tmp_path: Path) -> None:
    write_flight(tmp_path / "day", "2025-03-02T15:00:00")
    _phone_without_date(tmp_path / "day" / "60m.csv", 10)
    (flight,) = flights(ingest(tmp_path, options=OPTIONS))
    assert "60m.csv" in {Path(file.path).name for file in flight.files}


def stream_of(frame: pd.DataFrame) -> Stream:
    return Stream("telemetry", "x", frame)


@pytest.mark.parametrize("shift_s", [-120.0, 0.0, 33.3])
def test_the_origin_is_found_to_a_tenth_of_a_second(shift_s: float) -> None:
    flown = track("2025-03-02T15:00:00")
    origin = np.datetime64("2025-03-02T15:00:00", "ns") + np.timedelta64(round(shift_s * 1000), "ms")
    log = flown.iloc[40:240].assign(time=lambda f: np.datetime64(0, "ns") + (f["time"].to_numpy() - origin))
    noise = np.random.default_rng(1).normal(0, 1e-5, (2, len(log)))
    log = log.assign(latitude_deg=log["latitude_deg"] + noise[0], longitude_deg=log["longitude_deg"] + noise[1])
    estimate = origin_of(stream_of(log), stream_of(flown))
    assert estimate is not None
    assert abs(estimate.time - origin) <= np.timedelta64(150, "ms")


def test_no_origin_for_another_track_or_a_hover() -> None:
    flown = track("2025-03-02T15:00:00")
    other = track("1970-01-01T00:00:00", turn=2.3)
    assert origin_of(stream_of(other), stream_of(flown)) is None
    still = flown.assign(latitude_deg=35.73, longitude_deg=-78.7, altitude_m=30.0)
    hover = still.assign(time=np.datetime64(0, "ns") + np.arange(len(still)) * np.timedelta64(1, "s"))
    assert origin_of(stream_of(hover), stream_of(still)) is None, "every origin fits a hover"


def test_radios_meet_a_flight_up_to_the_slack_before_and_after() -> None:
    from aerpaw_cmp.flight import cross_checks

    begin, end = np.datetime64("2025-03-02T15:00:00", "ns"), np.datetime64("2025-03-02T15:05:00", "ns")
    flight, second = cross_checks.Flight(files=[], span=(begin, end)), np.timedelta64(1, "s")
    slack, long = cross_checks.SLACK, 10 * cross_checks.SLACK + (end - begin)
    assert cross_checks._meet(flight, (end + slack - second, end + long), None)
    assert not cross_checks._meet(flight, (end + slack + second, end + long), None)
    assert cross_checks._meet(flight, (begin - long, begin - slack + second), None)
    assert not cross_checks._meet(flight, (begin - long, begin - slack - second), None)
    assert not cross_checks._meet(cross_checks.Flight(files=[]), (begin, end), None)


def test_no_origin_for_a_lap_of_a_route_that_is_flown_again() -> None:
    """The log of one lap matches the track at two times.

    If the second lap is flown elsewhere, it matches at one time.
    """
    t = np.arange(440)
    flown = track("2025-03-02T15:00:00", seconds=len(t))
    lap = 2 * np.pi * t / 200.0
    flown = flown.assign(
        latitude_deg=35.73 + 2e-3 * np.sin(lap), longitude_deg=-78.7 + 3e-3 * np.cos(lap), altitude_m=30.0
    )
    log = flown.iloc[20:210]
    log = log.assign(time=np.datetime64(0, "ns") + np.arange(len(log)) * np.timedelta64(1, "s"))
    assert origin_of(stream_of(log), stream_of(flown)) is None
    once = flown.assign(longitude_deg=flown["longitude_deg"] + np.where(t < 200, 2e-5 * t, 4e-3))
    estimate = origin_of(stream_of(log.assign(longitude_deg=once["longitude_deg"].to_numpy()[20:210])), stream_of(once))
    assert estimate is not None
    assert abs(estimate.time - (np.datetime64("2025-03-02T15:00:20", "ns"))) <= np.timedelta64(150, "ms")


def test_a_log_that_goes_with_no_flight_is_said_once_beside_the_first(tmp_path: Path) -> None:
    write_flight(tmp_path / "morning", "2025-03-02T15:00:00")
    write_flight(tmp_path / "noon", "2025-03-02T17:00:00", turn=0.5)
    times = np.datetime64("2025-03-09T15:00:00", "ns") + np.arange(50) * np.timedelta64(1, "s")
    (tmp_path / "LW2_power_log.txt").write_bytes(format_power_log(times, np.linspace(-40, -60, 50), ZONE))
    made = drafts(ingest(tmp_path, options=OPTIONS), tmp_path, DraftOptions(timezone=ZONE))
    assert len({draft.name for draft in made}) == len(made) == 2
    said = [[text for text in draft.remarks if "it does not belong to any flight here" in text] for draft in made]
    assert said == [["left out: LW2_power_log.txt: it does not belong to any flight here"], []]


@pytest.mark.parametrize(("aside_m", "agrees"), [(0.0, True), (13.2, True), (13.5, False)])
def test_a_log_may_lie_twelve_metres_beside_the_track(aside_m: float, agrees: bool) -> None:
    """An offset to the east moves the nearest time of a curved track by a tenth."""
    flown = track("2025-03-02T15:00:00")
    log = flown.iloc[40:240].assign(time=lambda f: np.datetime64(0, "ns") + (f["time"] - f["time"].iloc[0]).to_numpy())
    east = np.degrees(aside_m / (6378137.0 * np.cos(np.radians(flown["latitude_deg"].iloc[0]))))
    log = log.assign(longitude_deg=log["longitude_deg"] + east, altitude_m=log["altitude_m"] + 200.0)
    estimate = origin_of(stream_of(log), stream_of(flown))
    assert (estimate is not None) == agrees
    if estimate is not None:
        assert abs(estimate.time - flown["time"].iloc[40]) <= np.timedelta64(2500, "ms")
        assert estimate.distance_m == pytest.approx(0.9 * aside_m, abs=0.3)
    assert origin_of(stream_of(log.iloc[:19]), stream_of(flown)) is None
    assert origin_of(stream_of(flown.iloc[40:240]), stream_of(flown)) is None, "its times are times of a day"


@pytest.mark.parametrize(
    ("radio", "asked"),
    [
        ("flight2_LW1_power_log.txt", "its name has flight 2, the name of the track has flight 1: the same flight?"),
        ("flight01_LW1_power_log.txt", ""),
        ("LW1_power_log.txt", ""),
    ],
)
def test_names_of_two_flights_are_not_paired_without_a_question(radio: str, asked: str, tmp_path: Path) -> None:
    write_flight(tmp_path / "logs", "2025-03-02T15:00:00")
    (tmp_path / "logs/x_vehicleOut.txt").rename(tmp_path / "logs/flight1_vehicleOut.txt")
    (tmp_path / "logs/LW1_power_log.txt").rename(tmp_path / "logs" / radio)
    (flight,) = flights(ingest(tmp_path / "logs", options=OPTIONS))
    assert flight.unsure == ({str(tmp_path / "logs" / radio): asked} if asked else {})


@pytest.mark.parametrize(("date", "asked"), [("2025-03-05", True), ("2025-03-02", False), ("2025-03-01", False)])
def test_a_log_without_a_clock_whose_name_has_another_date_is_asked_about(
    date: str, asked: bool, tmp_path: Path
) -> None:
    write_flight(tmp_path / "logs", "2025-03-02T15:00:00")
    (tmp_path / "logs/LW1_power_log.txt").unlink()
    rows = "".join(f"{i},11,-90\n" for i in range(20))
    (tmp_path / "logs" / f"{date}_phone.csv").write_text(f"elapsed,pci,rsrp\n{rows}")
    (flight,) = flights(ingest(tmp_path / "logs", options=OPTIONS))
    assert bool(flight.unsure) is asked
