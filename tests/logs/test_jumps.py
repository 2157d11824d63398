"""Speed limits judge clocks and positions of all readers."""

import numpy as np
import pandas as pd
import pytest

from aerpaw_cmp.logs import limits
from aerpaw_cmp.logs.limits import jumps_of, stale_of
from aerpaw_cmp.logs.records import COLUMNS, ReadResult, Stream

DEGREE_M = 111_200.0


def straight(count: int = 200, step_s: float = 1.0, speed_mps: float = 5.0) -> pd.DataFrame:
    """A flight to the north."""
    seconds = step_s * np.arange(count)
    frame = pd.DataFrame(dict.fromkeys(COLUMNS["telemetry"], np.nan), index=range(count))
    frame["latitude_deg"], frame["longitude_deg"] = 35.7275 + speed_mps * seconds / DEGREE_M, -78.696
    frame["altitude_m"] = 30.0
    frame["time"] = np.datetime64("2025-06-01T14:00:00", "ns") + np.round(seconds * 1e9).astype("timedelta64[ns]")
    return frame.assign(line=np.arange(1, count + 1), flag="")


def stream(frame: pd.DataFrame) -> Stream:
    return Stream("telemetry", "vehicle", frame)


@pytest.mark.parametrize("step_s", [0.1, 1.0, 5.0])
@pytest.mark.parametrize("rows", [[50], [50, 51, 52], [0], [199], [20, 21, 90, 150]])
@pytest.mark.parametrize("column", ["latitude_deg", "longitude_deg", "altitude_m"])
def test_rows_that_cannot_be_reached_in_time_are_flagged_alone(column: str, rows: list[int], step_s: float) -> None:
    frame = straight(step_s=step_s)
    far = 1500.0 if column == "altitude_m" else 1500.0 / DEGREE_M
    frame.loc[rows, column] += far
    jumps, sentence = jumps_of(frame)
    assert np.flatnonzero(jumps).tolist() == rows
    assert f"line {rows[0] + 1}" in sentence


def test_a_flagged_position_is_missing_and_the_row_stays() -> None:
    frame = straight()
    frame.loc[50, "latitude_deg"] += 500.0 / DEGREE_M
    result = ReadResult("r", (stream(frame),), lines=200, accepted=200, blank=0)
    checked = limits.check(result)
    after = checked.streams[0].frame
    assert len(after) == 200
    assert after["flag"][50] == "position_jump"
    assert after.loc[50, ["latitude_deg", "longitude_deg", "altitude_m"]].isna().all()
    assert "1 row is flagged position_jump; the first: 50" in checked.warnings[0]  # 505 m/s, or 495


def test_the_speed_of_a_jump_is_that_out_of_a_place_where_the_log_begins() -> None:
    frame = straight()
    frame.loc[:29, "latitude_deg"] = 35.71
    assert "30 rows are flagged position_jump; the first: 2096 m/s to the position in line 1" in jumps_of(frame)[1]


@pytest.mark.parametrize("frame", [straight(), straight(speed_mps=40.0), straight(step_s=14.0, speed_mps=8.0)])
def test_a_flight_is_not_flagged(frame: pd.DataFrame) -> None:
    jumps, sentence = jumps_of(frame)
    assert (int(jumps.sum()), sentence) == (0, "")


def test_positions_held_without_a_fix_and_caught_up_are_no_jump() -> None:
    frame = straight()
    frame.loc[80:110, "latitude_deg"] = frame["latitude_deg"][80]  # then 150 m in one second
    assert not jumps_of(frame)[0].any()


def test_rows_written_in_bursts_are_no_jump() -> None:
    frame = straight(count=400, step_s=0.1)
    frame["time"] = frame["time"].dt.floor("1s") + pd.to_timedelta(np.arange(400) % 10, unit="us")
    assert not jumps_of(frame)[0].any()


@pytest.mark.parametrize("times", [1000.0, 60.0])
def test_a_track_that_is_too_fast_throughout_has_another_unit_of_time(times: float) -> None:
    frame = straight(step_s=1.0)
    start = frame["time"][0]
    frame["time"] = start + (frame["time"] - start) / times
    jumps, sentence = jumps_of(frame)
    assert not jumps.any()
    assert "times in another unit" in sentence


def test_two_vehicles_in_one_table_are_named() -> None:
    frame = straight()
    frame.loc[1::2, "longitude_deg"] += 2000.0 / DEGREE_M
    jumps, sentence = jumps_of(frame)
    assert not jumps.any()
    assert "two vehicles" in sentence


@pytest.mark.parametrize("unset", ["1970-01-01", "1980-01-06", "2000-01-01"])
@pytest.mark.parametrize("count", [1, 60, 150])
def test_rows_before_the_clock_was_set_are_flagged_however_many(unset: str, count: int) -> None:
    frame = straight()
    start = np.datetime64(unset, "ns")
    frame.loc[: count - 1, "time"] = start + (frame["time"][:count] - frame["time"][0])
    checked = limits.check(ReadResult("r", (stream(frame),), lines=200, accepted=200, blank=0))
    flags = checked.streams[0].frame["flag"].to_numpy()
    assert (flags[:count] == "time_out_of_range").all()
    assert not flags[count:].astype(bool).any()
    assert "before the clock was set" in checked.warnings[0]


@pytest.mark.parametrize("end", ["begin", "end"])
def test_a_log_that_rests_where_it_cannot_have_flown_is_flagged_there(end: str) -> None:
    """An autopilot's filter falls back to its origin at disarm: 80 m in a second, slower than the fastest aircraft."""
    frame, rows = straight(speed_mps=2.0), slice(160, 199) if end == "end" else slice(0, 39)
    frame.loc[rows, "latitude_deg"] = frame["latitude_deg"][159 if end == "end" else 40] - 80.0 / DEGREE_M
    jumps, sentence = jumps_of(frame)
    assert np.flatnonzero(jumps).tolist() == list(range(200))[rows.start : rows.stop + 1]
    assert "flagged position_jump" in sentence


@pytest.mark.parametrize(("step_s", "held"), [(0.1, 10), (0.2, 5), (1.0, 1)])
def test_a_receiver_that_reports_more_rarely_than_the_logger_writes_does_not_jump(step_s: float, held: int) -> None:
    frame = straight(count=600, step_s=step_s, speed_mps=20.0)
    frame["latitude_deg"] = frame["latitude_deg"][np.arange(600) // held * held].to_numpy()
    frame["velocity_north_mps"], frame["velocity_east_mps"] = 20.0, 0.0
    assert not jumps_of(frame)[0].any()
    assert not stale_of(frame, "")[0].any()


@pytest.mark.parametrize(("speed_mps", "flagged"), [(5.0, 99), (0.0, 0), (0.1, 0), (np.nan, 99)])
def test_positions_that_stand_still_at_speed_are_stale(speed_mps: float, flagged: int) -> None:
    """The first position is valid. Hovers and noise of the speed are not jumps. Without a speed, the track catches up."""
    frame = straight(step_s=1.0)
    frame.loc[50:149, "latitude_deg"] = frame["latitude_deg"][50]
    frame["velocity_north_mps"], frame["velocity_east_mps"] = 5.0 + 0.0 * speed_mps, 0.0
    frame.loc[50:149, "velocity_north_mps"] = speed_mps
    after = limits.check(ReadResult("r", (stream(frame),), lines=200, accepted=200, blank=0))
    shown = after.streams[0].frame
    assert (shown["flag"] == "position_stale").sum() == flagged
    assert shown["latitude_deg"].isna().sum() == flagged
    assert not flagged or "change for 99 s from line 51 on, at a speed of 5." in after.warnings[0]
