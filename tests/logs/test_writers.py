"""The readers restore what the writers wrote."""

import re

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.logs import writers as logwriters
from aerpaw_cmp.logs.readers import ReadOptions, identify
from aerpaw_cmp.logs.records import ReadResult
from tests.log_texts import nemo_csv, quectel_csv

ZONE = "America/New_York"
OPTIONS = ReadOptions(timezone=ZONE)


def times(count: int, step_ms: int = 1010) -> np.ndarray:
    return np.datetime64("2025-03-02T15:00:00.123456", "ns") + np.arange(count) * np.timedelta64(step_ms, "ms")


def telemetry(count: int = 30) -> pd.DataFrame:
    rng = np.random.default_rng(4)
    return pd.DataFrame(
        {
            "time": times(count),
            "latitude_deg": 35.73 + rng.uniform(-0.01, 0.01, count).round(7),
            "longitude_deg": -78.7 + rng.uniform(-0.01, 0.01, count).round(7),
            "altitude_m": rng.uniform(-1, 110, count).round(3),
            "roll_deg": rng.uniform(-30, 30, count),
            "pitch_deg": rng.uniform(-30, 30, count),
            "yaw_deg": rng.uniform(-180, 180, count),
            "velocity_north_mps": rng.uniform(-10, 10, count).round(2),
            "velocity_east_mps": rng.uniform(-10, 10, count).round(2),
            "velocity_down_mps": rng.uniform(-3, 3, count).round(2),
            "fix": np.full(count, 4),
            "satellites": np.full(count, 21),
        }
    )


def read(data: bytes, options: ReadOptions = OPTIONS) -> ReadResult:
    result = identify(data).read(data, options)
    assert not result.rejected
    return result


def test_telemetry() -> None:
    frame = telemetry()
    frame.loc[7, ["latitude_deg", "longitude_deg", "altitude_m"]] = np.nan
    data = logwriters.format_vehicle_out(frame, ZONE)
    back = read(data).streams[0].frame
    assert back["time"].equals(frame["time"])
    for name in frame.columns.difference(["time", "fix", "satellites"]):
        assert np.allclose(back[name], frame[name], rtol=0, atol=1e-9, equal_nan=True), name
    assert back["flag"].tolist() == ["no_fix" if i == 7 else "" for i in range(len(frame))]
    assert data.count(b"\r\n") == data.count(b"\n") == len(frame)
    assert re.match(rb'1,-78\.\d{1,7},35\.\d{1,7},[-0-9.]+,"\(', data)


@given(st.lists(st.floats(-140, 20, width=32) | st.sampled_from([np.nan, -30.0, -31.5]), min_size=1, max_size=80))
@settings(max_examples=80, deadline=None)
def test_sounder_levels_and_runs(levels: list[float]) -> None:
    data = logwriters.format_power_log(times(len(levels), 33), levels, ZONE)
    back = identify(data).read(data, OPTIONS)
    frame = back.streams[0].frame
    assert np.array_equal(frame["rss_db"].astype(np.float32), np.array(levels, dtype=np.float32), equal_nan=True)
    # od ends a log inside a run with an offset, which is not a record
    ends_in_run = len(levels) > 1 and np.array_equal(np.float32(levels[-2:-1]), np.float32(levels[-1:]), equal_nan=True)
    assert len(back.rejected) == int(ends_in_run)
    if not ends_in_run:  # evenly spaced samples: the interpolated times of a run are the true ones
        assert (frame["time"].to_numpy() == times(len(levels), 33)).all()


def test_sounder_layout_is_that_of_od() -> None:
    data = logwriters.format_power_log(times(4), [-20.5, -34.86136, np.nan, np.nan], ZONE)
    assert data.decode().splitlines() == [
        "[2025-03-02 10:00:00.123456] 0000000           -20.5",
        "[2025-03-02 10:00:01.133456] 0000004       -34.86136",
        "[2025-03-02 10:00:02.143456] 0000010       -788.5956",
        "[2025-03-02 10:00:03.153456] *",
        "[2025-03-02 10:00:03.153456] 0000020",
    ]


def test_rank_csvs() -> None:
    frame = telemetry(6).assign(rank=[1.0, 2.0, np.nan, 4.0, 3.0, 2.0])
    modem = read(quectel_csv(frame["time"], frame["rank"], ZONE))
    nr = next(stream for stream in modem.streams if stream.name == "nr5g_csi").frame
    assert np.array_equal(nr["rank"], frame["rank"], equal_nan=True)
    assert modem.blank == 1, "the bare OK of the start script"
    table = read(logwriters.format_ri_csv(frame, ZONE)).streams[0].frame
    assert np.array_equal(table["rank"], frame["rank"], equal_nan=True)
    assert np.allclose(table[["latitude_deg", "longitude_deg"]], frame[["latitude_deg", "longitude_deg"]], atol=1e-9)
    # modems write milliseconds, cut
    assert ((frame["time"] - table["time"]) < pd.Timedelta(milliseconds=1)).all()
    assert (frame["time"] >= table["time"]).all()


def test_nemo_csv() -> None:
    frame = telemetry(6).assign(rank=[1.0, 2.0, np.nan, 4.0, 3.0, 2.0])
    data = nemo_csv(frame, "2025-03-02T15:00:02Z")
    back = read(data, ReadOptions(time_origin="2025-03-02T15:00:02Z")).streams[0].frame
    assert back["time"].equals(frame["time"])
    assert np.array_equal(back["rank"], frame["rank"], equal_nan=True)


def test_unknown_zone() -> None:
    with pytest.raises(UsageError, match="unknown time zone"):
        logwriters.local_text(times(1), "America/Raleigh")
