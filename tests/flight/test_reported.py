"""Flights of public bug reports, and their cousins: heights, headings and clocks with values known in closed form."""

import shutil
from pathlib import Path

import numpy as np
import pytest

import aerpaw_cmp
from aerpaw_cmp.flight.data import FlightData, load_data
from aerpaw_cmp.flight.replay import estimate_clocks
from aerpaw_cmp.flight.settings import load_flight

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
    """As after a landing; farther down nothing can have flown."""
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
    assert any("25 telemetry row(s) lie below the site's ground plane" in text for text in data.warnings)


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
    assert any("hold a heading alone" in text for text in data.warnings)
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
