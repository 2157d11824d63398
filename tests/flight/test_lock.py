"""Receiver lock of a sounder: which streams contain it, and at which times."""

import numpy as np
import pandas as pd
import pytest

from aerpaw_cmp.common.units import FloatArray
from aerpaw_cmp.compare.level import BASE_S
from aerpaw_cmp.flight.rows import lock_of, may_lose_lock
from aerpaw_cmp.logs.records import Stream


def _stream(name: str, time_s: FloatArray, level: FloatArray, unit: str = "dB re full scale") -> Stream:
    time = (np.round(time_s * 1e9) + 1.7e18).astype("datetime64[ns]")
    frame = pd.DataFrame({"time": time, "line": np.arange(len(time)) + 1, "flag": "", "rss_db": level})
    return Stream("rss", name, frame, {"unit": unit})


def _flight(rows: int = 8000) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Times, powers, and whether in lock, of a receiver whose level swings about its threshold."""
    random = np.random.default_rng(7)
    time = np.arange(rows) * BASE_S
    level = -15.0 + 20.0 * np.sin(2.0 * np.pi * time / 60.0)
    locked = level + random.normal(0.0, 2.0, rows) > -15.0
    return time, level, locked


def _quality(locked: FloatArray) -> FloatArray:
    return np.where(locked, 72.0, 45.0) + np.random.default_rng(1).normal(0.0, 1.0, len(locked))


def test_rows_lost_from_the_power_move_the_quality_back_to_its_own_times() -> None:
    time, level, locked = _flight()
    quality = _quality(locked)
    logged = np.flatnonzero(np.random.default_rng(2).random(len(time)) > 0.1)  # rows that a merge with telemetry lost
    power = _stream("power", time[logged], level[logged])
    quality_rows = _stream(
        "quality", time[logged], quality[: len(logged)], "dB"
    )  # and the quality did not: paired by row
    lock, note = lock_of(power, [quality_rows])
    assert lock is not None
    known = np.isfinite(lock)
    assert known.mean() > 0.85
    assert np.mean(lock[known] == locked[logged][known]) > 0.98
    assert np.mean((quality_rows.frame["rss_db"] > 60.0).to_numpy() == locked[logged]) < 0.9, "as paired it is wrong"
    assert "ahead" in note
    assert "26 s" in note  # 8000 rows of 0.0328 s, a tenth of them lost


def test_a_quality_paired_in_time_stays() -> None:
    time, level, locked = _flight()
    lock, note = lock_of(_stream("power", time, level), [_stream("quality", time, _quality(locked), "dB")])
    assert lock is not None
    assert note == ""
    assert np.array_equal(lock == 1.0, locked)


def test_a_quality_of_another_log_is_taken_at_the_nearest_time() -> None:
    time, level, locked = _flight()
    late = _stream("quality", time[100:4000] + 0.004, _quality(locked)[100:4000], "dB")
    lock, _ = lock_of(_stream("power", time, level), [late])
    assert lock is not None
    assert np.isnan(lock[:90]).all()
    assert np.isnan(lock[4010:]).all()
    assert np.array_equal(lock[110:3990] == 1.0, locked[110:3990])


@pytest.mark.parametrize(("middle", "lock"), [(72.2, True), (40.0, False), (90.0, False)])
def test_a_quality_near_the_peak_of_a_locked_correlator_is_a_lock(middle: float, lock: bool) -> None:
    time = np.arange(40.0)
    assert may_lose_lock(_stream("quality", time, middle + 0.1 * (time % 3), "dB")) is lock
    states, _ = lock_of(_stream("power", time, time), [_stream("quality", time, middle + 0.1 * (time % 3), "dB")])
    assert (states is not None) is lock
