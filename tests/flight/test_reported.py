"""Flights of public bug reports, and their cousins: heights, headings and clocks with values known in closed form."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import aerpaw_cmp
from aerpaw_cmp.__main__ import main
from aerpaw_cmp.flight.cross_checks import doubts, questions
from aerpaw_cmp.flight.data import FlightData, load_data
from aerpaw_cmp.flight.drafting.draft import DraftOptions, _entry, draft
from aerpaw_cmp.flight.replay import estimate_clocks
from aerpaw_cmp.flight.settings import load_flight
from aerpaw_cmp.logs.ingest import ingest
from aerpaw_cmp.logs.readers import ReadOptions
from aerpaw_cmp.site.siteyaml import load_site

REPORTED = Path(__file__).parents[1] / "reported"


@pytest.fixture
def case(tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    """A copy of a reported flight."""
    folder = tmp_path / request.param
    shutil.copytree(REPORTED / request.param, folder)
    return folder


def reported(name: str) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("case", [name], indirect=True)


def loaded(folder: Path) -> FlightData:
    return load_data(load_flight(folder / "flight.yaml"), folder)


def rewrite(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


@reported("below_takeoff")
def test_a_descent_below_the_take_off_keeps_its_heights(case: Path) -> None:
    data = loaded(case)
    up = data.poses_at(data.rss[0].time).position_m[:, 2]
    assert (up.min(), up.max()) == pytest.approx((10.0, 30.0))
    (row,) = aerpaw_cmp.open_flight(case / "flight.yaml").compare().to_frame().itertuples()
    assert (row.n, row.rmse_db) == (60, pytest.approx(0.0, abs=0.005))


@reported("below_takeoff")
def test_a_drift_below_flat_ground_is_raised(case: Path) -> None:
    """A descent after a landing is plausible. Lower positions are not."""
    rewrite(case / "site.yaml", "takeoff_ground_m: 30", "takeoff_ground_m: 0")
    data = loaded(case)
    pose = data.poses_at(data.rss[0].time)
    assert pose.position_m[pose.valid, 2] == pytest.approx(0.5)
    assert set(pose.reason[~pose.valid]) == {"below the site's ground plane"}
    (telemetry,) = (stream.frame for stream in data.files[0].result.streams)
    buried = telemetry["altitude_m"] < -5.0
    assert data.track is not None
    assert data.track.account.below_ground == int(buried.sum()) > 30


@reported("above_ground_plane")
def test_poses_below_the_ground_plane_are_counted_with_that_reason(case: Path) -> None:
    data = loaded(case)
    pose = data.poses_at(data.rss[0].time)
    up = pose.position_m[pose.valid, 2]
    assert set(pose.reason[~pose.valid]) == {"below the site's ground plane"}
    assert int((~pose.valid).sum()) == 25
    assert up.max() == pytest.approx(20.0)
    assert any("25 telemetry rows below the site's ground" in text for text in data.warnings)


@reported("above_ground_plane")
def test_a_tower_on_the_same_low_ground_compares_all(case: Path) -> None:
    rewrite(case / "site.yaml", "antenna_height_m: 10", "antenna_height_m: 10, ground_offset_m: -20")
    (case / "site.yaml").write_text("tower_ground: offsets\n" + (case / "site.yaml").read_text())
    data = loaded(case)
    assert data.poses_at(data.rss[0].time).valid.all()


@reported("heading_only")
@pytest.mark.parametrize("attitude", ["logged", "level"])
def test_a_heading_alone_turns_the_nose(case: Path, attitude: str) -> None:
    rewrite(case / "flight.yaml", "attitude: logged", f"attitude: {attitude}")
    data = loaded(case)
    assert data.poses_at(data.rss[0].time).heading_deg == pytest.approx(90.0)  # the track runs north
    assert any("with only a heading" in text for text in data.warnings)
    (row,) = aerpaw_cmp.open_flight(case / "flight.yaml").compare().to_frame().itertuples()
    assert row.rmse_db == pytest.approx(0.0, abs=0.05)


@reported("heading_only")
def test_a_heading_of_zero_throughout_is_none(case: Path) -> None:
    rewrite(case / "hdg90.csv", ",90\n", ",0\n")
    data = loaded(case)
    assert not data.poses_at(data.rss[0].time).attitude_known.any()


@reported("clock_glitch")
def test_a_jump_of_the_receiver_moves_no_clock(case: Path) -> None:
    data = loaded(case)
    assert any("1 row is flagged position_jump; the first: 506 m/s" in text for text in data.warnings)
    assert data.poses_at(data.rss[0].time).valid.all()
    (clock,) = estimate_clocks(data)
    assert clock is not None
    assert clock.result.verdict != "shifted"


@reported("rtc1970")
def test_samples_before_the_clock_was_set_are_named(case: Path) -> None:
    data = loaded(case)
    (series,) = data.rss
    assert len(series.time) == 140
    assert series.flagged == {"time_out_of_range": 60}
    assert series.time.min() > np.datetime64("2025-01-01")
    assert any("60 rows are flagged time_out_of_range" in text and "clock was set" in text for text in data.warnings)


@reported("rtc1970")
def test_clauses_on_clocks_reach_the_first_words(case: Path) -> None:
    rewrite(case / "T1_power_log.txt", "1970-01-01", "2025-06-01")  # 60 samples hours before the telemetry
    data = loaded(case)
    assert any("RSS of T1 U: 30 % of the samples have no position" in text for text in data.doubts)
    assert set(data.doubts) <= {text.rstrip(".") for text in data.warnings}


@reported("clock_glitch")
@pytest.mark.parametrize(("late_s", "asked"), [(3600, True), (2 * 3600 - 20, True), (1800, False), (0, False)])
def test_logs_that_begin_whole_hours_apart_are_doubted(case: Path, late_s: int, asked: bool) -> None:
    data = loaded(case)
    assert data.track is not None
    telemetry = next(s for file in data.files for s in file.result.streams if s.kind == "telemetry")
    start = np.datetime64(data.track.start_ns, "ns") + np.timedelta64(late_s, "s")
    time = start + np.arange(100).astype("timedelta64[s]")
    clauses = doubts(data.track, telemetry, [("RSS of T1 U", time)])
    assert any("begins" in text and "wrong time zone" in text for text in clauses) == asked


@reported("below_takeoff")
@pytest.mark.parametrize(("up_m", "asked"), [(0.0, False), (24.0, False), (1690.0, True)])
def test_a_height_of_another_datum_is_doubted(case: Path, up_m: float, asked: bool) -> None:
    data = loaded(case)
    assert data.track is not None
    telemetry = next(s for file in data.files for s in file.result.streams if s.kind == "telemetry")
    frame = telemetry.frame.assign(altitude_m=telemetry.frame["altitude_m"].abs() + up_m)
    clauses = doubts(data.track, replace(telemetry, frame=frame), [])
    assert any("probably above another datum" in text for text in clauses) == asked


def test_a_draft_takes_the_one_tower_of_the_users_site(tmp_path: Path) -> None:
    shutil.copytree(REPORTED / "draft_own_site", tmp_path / "c")
    files = ingest([tmp_path / "c/own"], options=ReadOptions(timezone="America/New_York"))
    options = DraftOptions(timezone="America/New_York", site="site.yaml")
    text, remarks = draft(files, tmp_path / "c", options)
    assert "node: T1}\n" in text
    assert remarks[0] == "60 samples can be compared"
    assert not any("which tower" in remark for remark in remarks)


@pytest.mark.parametrize(
    ("folder", "node"),
    [("north mast", "North_Mast"), ("T-2", "T2"), ("t2rx", "T2"), ("T21", "North_Mast"), ("x", "North_Mast")],
)
def test_a_folder_names_a_tower_of_the_users_site(tmp_path: Path, folder: str, node: str) -> None:
    shutil.copytree(REPORTED / "draft_own_site", tmp_path / "c")
    (tmp_path / "c/own/T1").rename(tmp_path / "c/own" / folder)
    site = tmp_path / "c/site.yaml"
    place = "{latitude_deg: 35.7275, longitude_deg: -78.6970, antenna_height_m: 10}"
    site.write_text(site.read_text().split("towers:")[0] + f"towers:\n  North_Mast: {place}\n  T2: {place}\n")
    (log,) = (f for f in ingest([tmp_path / "c/own"], options=ReadOptions(timezone="UTC")) if "power" in f.path)
    assert _entry(log, log.path, ("North_Mast", "T2"), tmp_path)[0]["node"] == node
    assert load_site(site).towers.keys() == {"North_Mast", "T2"}


def test_a_track_with_its_times_in_another_unit_is_asked_about(tmp_path: Path) -> None:
    rows = "".join(f"{n / 1000:.3f},{35.7275 + n * 5e-5:.6f},-78.696,30\n" for n in range(200))
    (tmp_path / "pose.csv").write_text("t,lat,lon,alt\n" + rows)
    named = {"time": "t", "latitude_deg": "lat", "longitude_deg": "lon", "altitude_m": "alt"}
    options = ReadOptions(time_origin="2025-06-01T14:00:00Z", kind="telemetry", columns=named)
    (file,) = ingest([tmp_path / "pose.csv"], reader="generic_csv", options=options)
    assert any("times in another unit" in text for text in file.result.warnings)
    asked = questions(file, file.result.streams, None)
    assert any("m/s throughout: are its times in another unit" in text and text.endswith("?") for text in asked)


def test_heights_above_the_sea_and_a_level_that_is_always_empty(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A UAV does not fly 1.7 km above ground. A phone writes -1 for a network that it does not receive."""
    (tmp_path / "site.yaml").write_text(
        "name: s\norigin: {latitude_deg: 35.7275, longitude_deg: -78.696}\n"
        "towers: {T1: {latitude_deg: 35.7275, longitude_deg: -78.697, antenna_height_m: 10.0}}\n"
    )
    for up_m, code in ((30.0, 0), (1690.0, 3)):
        rows = [
            f"{1749564000000 + 1000 * i};426;{-78 - i % 7}.1;-9;5230;-1;-78.69628;{35.7253 + 4e-5 * i:.6f};{up_m}"
            for i in range(60)
        ]
        head = "Timestamp;PCI;RSRP;RSRQ;ARFCN;SS_RSRP;Longitude;Latitude;height_above_takeoff_m"
        (tmp_path / "phone.csv").write_text("\n".join([head, *rows]) + "\n")
        (tmp_path / "f.yaml").write_text(
            "flight: f\nsite: site.yaml\nlogs: [{path: phone.csv, node: T1, cells: {426: T1}}]\n"
        )
        assert (
            main(["report", str(tmp_path / "f.yaml"), "--audit", "none", "-o", str(tmp_path / "out"), "--force"])
            == code
        )
        said = capsys.readouterr().err
        assert ("takeoff_ground_m: -1690" if code else "it is ignored") in said
