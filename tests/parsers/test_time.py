"""One conversion of wall clocks, checked against the zone database through pandas and datetime."""

from datetime import datetime, timezone
from zoneinfo import ZoneInfo

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.logs import text as _text
from aerpaw_cmp.logs.readers import ReadOptions

NEW_YORK = "America/New_York"


def wall(*texts: str) -> np.ndarray:
    return np.array(texts, dtype="datetime64[ns]").astype(np.int64)


def utc_of(*texts: str, zone: str = NEW_YORK) -> list[str]:
    made = _text.local_to_utc(wall(*texts), zone, needed_by="a test")
    return [str(time)[:19] for time in made.time.astype("datetime64[s]")]


@given(
    st.datetimes(datetime(1971, 1, 1), datetime(2037, 1, 1)), st.sampled_from([NEW_YORK, "Australia/Lord_Howe", "UTC"])
)
def test_agrees_with_datetime(moment: datetime, zone: str) -> None:
    made = _text.local_to_utc(wall(moment.isoformat()), zone, needed_by="a test")
    # a text has no fold: an hour that comes twice, or never, is read as before the change
    expected = moment.replace(tzinfo=ZoneInfo(zone), fold=0).astimezone(timezone.utc).replace(tzinfo=None)
    assert pd.Timestamp(made.time[0]) == pd.Timestamp(expected)


@given(st.lists(st.integers(0, 10**9), min_size=1, max_size=50))
def test_round_trip_through_the_zone(seconds: list[int]) -> None:
    """Any instant, written as local time and read again, is itself unless its hour came twice."""
    utc = np.sort(np.array(seconds, dtype=np.int64)) + 10**9
    local = pd.DatetimeIndex(utc * 10**9, tz="UTC").tz_convert(NEW_YORK).tz_localize(None).to_numpy()
    made = _text.local_to_utc(local.astype("datetime64[ns]").astype(np.int64), NEW_YORK, needed_by="a test")
    sure = ~made.ambiguous
    assert not made.nonexistent.any()
    assert np.array_equal(made.time.astype(np.int64)[sure], utc[sure] * 10**9)


def test_the_hour_that_comes_twice() -> None:
    """3 November 2024: 01:30 is first 05:30Z, and after the clock stepped back 06:30Z."""
    texts = (
        "2024-11-03T00:59:00", "2024-11-03T01:30:00", "2024-11-03T01:59:00", "2024-11-03T01:01:00",
        "2024-11-03T02:00:00",
    )  # fmt: skip
    assert utc_of(*texts) == [
        "2024-11-03T04:59:00", "2024-11-03T05:30:00", "2024-11-03T05:59:00", "2024-11-03T06:01:00", "2024-11-03T07:00:00",
    ]  # fmt: skip
    made = _text.local_to_utc(wall(*texts), NEW_YORK, needed_by="a test")
    assert made.ambiguous.tolist() == [False, True, True, True, False]
    assert "twice" in made.warnings[0]
    column = np.full(5, "", dtype=object)
    column[1] = "no_fix"
    made.flag(column)
    assert column.tolist() == ["", "no_fix;ambiguous_local_time", "ambiguous_local_time", "ambiguous_local_time", ""]


def test_the_hour_that_never_was() -> None:
    made = _text.local_to_utc(wall("2024-03-10T02:30:00", "2024-03-10T03:00:00"), NEW_YORK, needed_by="a test")
    assert made.nonexistent.tolist() == [True, False]
    assert "skipped" in made.warnings[0]


@pytest.mark.parametrize("name", [None, "", "America/New_Yrok", "../etc/passwd", "/etc/passwd"])
def test_no_or_wrong_zone(name: str | None) -> None:
    with pytest.raises(UsageError, match="timezone:"):
        _text.local_to_utc(wall("2024-07-02T11:00:00"), name, needed_by="a test")


def test_a_winter_time_in_summer_is_refused_with_what_may_be_meant() -> None:
    """EST is -5 h all year in the time zone database. A user who writes EST in July may mean New York's summer time."""
    with pytest.raises(UsageError, match=r"New_York \(with summer time\) or Etc/GMT\+5"):
        _text.local_to_utc(wall("2024-07-02T11:00:00"), "EST", needed_by="a test")
    winter = _text.local_to_utc(wall("2024-01-02T11:00:00"), "EST", needed_by="a test")
    assert winter.time[0] == np.datetime64("2024-01-02T16:00:00")


@given(st.datetimes(datetime(1970, 1, 1), datetime(2261, 1, 1)), st.sampled_from([0, 3, 6]))
def test_digits(moment: datetime, fraction: int) -> None:
    text = moment.strftime("%Y-%m-%d %H:%M:%S.%f").zfill(26)
    text = text[: 20 + fraction] if fraction else text[:19]
    made, valid = _text.parse_digits(np.frombuffer(text.encode(), dtype=np.uint8)[None, :], fraction)
    assert valid[0]
    assert made[0] == pd.Timestamp(text).as_unit("ns").value


@pytest.mark.parametrize("text", ["2025-02-29", "2100-02-29", "2025-04-31", "2025-13-01", "2025-00-10", "2025-01-00", "0000-01-01", "9999-01-01"])  # fmt: skip
def test_days_that_are_none(text: str) -> None:
    _, valid = _text.parse_digits(np.frombuffer(f"{text} 10:00:00".encode(), dtype=np.uint8)[None, :], 0)
    assert not valid[0]


@pytest.mark.parametrize("text", ["24:00:00", "10:60:00", "10:00:60", "1a:00:00", "10-00:00", "10:00 00"])
def test_times_of_day_that_are_none(text: str) -> None:
    _, valid = _text.parse_digits(np.frombuffer(f"2025-03-02 {text}".encode(), dtype=np.uint8)[None, :], 0)
    assert not valid[0]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (b"2025-03-02T10:00:00Z", "2025-03-02T10:00:00"),
        (b"2025-03-02 10:00:00.5+00:00", "2025-03-02T10:00:00.5"),
        (b"2025-03-02 10:00:00-0500", "2025-03-02T15:00:00"),
        (b"2025-03-02 10:00:00.123456789+05:30", "2025-03-02T04:30:00.123456789"),
        (b"2025-03-02 10:00:00", "2025-03-02T15:00:00"),
    ],
)
def test_offsets_in_the_text(text: bytes, expected: str) -> None:
    options = ReadOptions(timezone=NEW_YORK)
    made, valid = _text.texts_to_utc(np.array([text, b"2025-07-02 10:00:00.25"]), options, needed_by="a test")
    assert valid.all()
    assert made.time[0] == np.datetime64(expected, "ns")
    assert made.time[1] == np.datetime64("2025-07-02T14:00:00.25", "ns")


@given(
    st.lists(st.sampled_from([0, 1, 61, 3600, 86_400, 2_505_600, 40_000_000]), min_size=1, max_size=12),
    st.sampled_from([0, 3]),
)
def test_times_that_come_back_are_read_like_times_alone(steps: list[int], fraction: int) -> None:
    """Runs of one minute are read once: a minute, a date that comes again later is a run of its own."""
    start = datetime(2024, 2, 28, 23, 59, 30, tzinfo=timezone.utc).timestamp()
    seconds = [int(start) + step for step in (*steps, *steps[::-1], steps[0])]
    texts = [datetime.fromtimestamp(s, timezone.utc).strftime("%Y-%m-%d %H:%M:%S") for s in seconds]
    rows = [(text + (".250" if fraction else "")).encode() for text in texts]
    wall, valid = _text.parse_digits(np.frombuffer(b"".join(rows), dtype=np.uint8).reshape(len(rows), -1), fraction)
    assert valid.all()
    assert wall.tolist() == [s * 10**9 + (250_000_000 if fraction else 0) for s in seconds]


def test_offsets_in_times_of_any_layout_are_taken_row_by_row() -> None:
    """Lengths of fractions and offsets all differ: nothing is common to the column, and no zone is needed."""
    texts = [
        b"2025-03-02T10:00:00Z", b"2025-03-02 10:00:00.5+02:00", b"2025-03-02T10:00:00.123456-0500",
        b"2025-03-02T10:00:00.25+05:30", b"2025-03-02 10:00:00-00:30", b"2025-03-02T10:00:00.000000001+00:00",
    ]  # fmt: skip
    instants, valid = _text.texts_to_utc(np.array(texts), ReadOptions(), needed_by="here")
    assert valid.all()
    expected = ["10:00:00", "08:00:00.5", "15:00:00.123456", "04:30:00.25", "10:30:00", "10:00:00.000000001"]
    assert instants.time.tolist() == [np.datetime64(f"2025-03-02T{text}", "ns").astype(int) for text in expected]
    with pytest.raises(UsageError, match="zone"):
        _text.texts_to_utc(np.array([*texts, b"2025-03-02T10:00:00.75"]), ReadOptions(), needed_by="here")
