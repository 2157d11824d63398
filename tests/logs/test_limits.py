"""Impossible values of all readers are flagged in one place and never scored."""

import numpy as np
import pandas as pd
import pytest

from aerpaw_cmp.flight.rows import unscored
from aerpaw_cmp.logs.limits import UNSCORED, check
from aerpaw_cmp.logs.readers import ReadOptions, by_name
from aerpaw_cmp.logs.records import COLUMNS, ReadResult, Stream


def frame_of(kind: str, rows: int = 5, **columns: object) -> pd.DataFrame:
    fill = {name: np.full(rows, -1 if name in ("fix", "satellites") else 1.0) for name in COLUMNS[kind]}
    start = np.datetime64("2025-06-01T12:00:00", "ns")
    time = start + np.arange(rows) * np.timedelta64(1, "s")
    base = {"time": time, "line": np.arange(1, rows + 1), "flag": pd.Series([""] * rows, dtype=object)}
    return pd.DataFrame({**base, **fill, **columns})


def checked(kind: str, attributes: dict[str, object] | None = None, rows: int = 5, **columns: object) -> ReadResult:
    stream = Stream(kind, "s", frame_of(kind, rows, **columns), attributes or {})
    return check(ReadResult("r", (stream,), rows, rows, 0))


@pytest.mark.parametrize("value", [np.inf, 1e30, 500.0, -1e30, -np.inf, 1e308])
@pytest.mark.parametrize("unit", ["dBm", "dB", "dB re full scale"])
def test_absurd_levels_are_flagged_and_void(value: float, unit: str) -> None:
    result = checked("rss", {"unit": unit}, rss_db=np.array([-80.0, value, -81.0, -82.0, np.nan]))
    frame = result.streams[0].frame
    assert frame["flag"].tolist() == ["", "level_out_of_range", "", "", ""]
    assert np.isnan(frame["rss_db"][1])
    assert unscored(frame).tolist() == [False, True, False, False, False]
    assert "1 row is flagged level_out_of_range" in result.warnings[0]
    assert "line 2" in result.warnings[0]


def test_what_can_be_is_left_alone_object_and_all() -> None:
    stream = Stream("rss", "s", frame_of("rss", rss_db=np.array([-200.0, 30.0, np.nan, -1.0, -0.0])), {"unit": "dBm"})
    result = ReadResult("r", (stream,), 5, 5, 0)
    assert check(result) is result


@pytest.mark.parametrize(
    ("column", "value", "flag", "void"),
    [
        ("latitude_deg", 90.5, "position_out_of_range", COLUMNS["telemetry"][:3]),
        ("longitude_deg", -1e30, "position_out_of_range", COLUMNS["telemetry"][:3]),
        ("altitude_m", np.inf, "position_out_of_range", COLUMNS["telemetry"][:3]),
        ("yaw_deg", 361.0, "attitude_out_of_range", COLUMNS["telemetry"][3:6]),
        ("roll_deg", 1e300, "attitude_out_of_range", COLUMNS["telemetry"][3:6]),
        ("velocity_down_mps", -201.0, "velocity_out_of_range", COLUMNS["telemetry"][6:9]),
    ],
)
def test_one_component_voids_its_quantity_and_no_other(column: str, value: float, flag: str, void: tuple) -> None:
    values = np.ones(5)
    values[3] = value
    frame = checked("telemetry", **{column: values}).streams[0].frame
    assert frame["flag"].tolist() == ["", "", "", flag, ""]
    for name in COLUMNS["telemetry"][:9]:
        assert np.isnan(frame[name][3]) == (name in void), name
        assert np.isfinite(frame[name].drop(3)).all()


def test_exchanged_angles_beyond_the_pole_are_named() -> None:
    result = checked("telemetry", latitude_deg=np.full(5, -112.0), longitude_deg=np.full(5, 40.0))
    assert "are latitude and longitude swapped?" in result.warnings[0]


def test_a_rank_above_the_ports_of_the_log_is_flagged() -> None:
    result = checked("rank", {"ports": 2}, rank=np.array([1.0, 2, 3, np.nan, 2]), ri_raw=np.array([1.0, 2, 3, 0, 2]))
    frame = result.streams[0].frame
    assert frame["flag"].tolist() == ["", "", "rank_above_ports", "", ""]
    assert frame["ri_raw"].tolist() == [1, 2, 3, 0, 2]
    assert np.isnan(frame["rank"][2])
    assert "the log has at most 2 ports" in result.warnings[0]
    unknown = checked("rank", {}, rank=np.array([1.0, 2, 3, np.nan, 2]), ri_raw=np.array([1.0, 2, 3, 0, 2]))
    assert unknown.warnings == ()


@pytest.mark.parametrize("stamp", ["2225-06-01", "1970-01-01", "2025-05-29", "2261-01-01"])
def test_a_few_stamps_days_from_all_others_are_flagged(stamp: str) -> None:
    frame = frame_of("rss", 10, rss_db=np.full(10, -80.0))
    frame.loc[4, "time"] = pd.Timestamp(stamp)
    result = check(ReadResult("r", (Stream("rss", "s", frame, {"unit": "dBm"}),), 10, 10, 0))
    assert unscored(result.streams[0].frame).nonzero()[0].tolist() == [4]


def test_two_flights_in_one_file_are_no_damaged_stamps() -> None:
    frame = frame_of("rss", 10, rss_db=np.full(10, -80.0))
    frame.loc[5:, "time"] += pd.Timedelta(days=40)
    assert check(ReadResult("r", (Stream("rss", "s", frame, {"unit": "dBm"}),), 10, 10, 0)).warnings == ()


def test_flags_add_to_those_of_the_reader() -> None:
    words = pd.Series(["", "repeated", "", "", ""], dtype=object)
    result = checked("rss", {"unit": "dBm"}, rss_db=np.array([-80.0, 1e9, -81.0, -82.0, -83.0]), flag=words)
    assert result.streams[0].frame["flag"][1] == "repeated;level_out_of_range"
    assert set(UNSCORED) >= {"level_out_of_range", "time_out_of_range", "rank_above_ports"}


def test_a_record_of_a_line_without_its_end_is_not_scored() -> None:
    """The level in the last line of a log whose writer was cut may be -8 of -85."""
    cut = by_name("aadm_snr").read(
        b"time,snr_lw1,snr_lw2\n2025-03-02 10:00:00.5,-1.25,-7.5\n2025-03-02 10:00:01.5,-1.25,-8",
        ReadOptions(timezone="America/New_York"),
    )
    assert [unscored(stream.frame).tolist() for stream in cut.streams] == [[False, True]] * 2


@pytest.mark.parametrize(("highest", "lost"), [(-42.0, 3), (-15.0, 0)])
def test_readings_that_were_lost_lie_near_zero_far_above_all_others(highest: float, lost: int) -> None:
    level = np.linspace(-60.0, highest, 180)
    level[[40, 90, 130]] = [-0.37, -1.0, 0.0]
    result = checked("rss", {"unit": "dB re full scale"}, rows=180, rss_db=level)
    frame = result.streams[0].frame
    assert (frame["flag"] == "level_lost").sum() == lost == unscored(frame).sum()
    assert frame["rss_db"].isna().sum() == lost
