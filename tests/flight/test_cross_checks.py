"""A contradiction of a log becomes a question with both values. Agreement leads to no question."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest

from aerpaw_cmp.common.errors import InputError
from aerpaw_cmp.flight.cross_checks import _lowest_m, check_heights, doubts, questions
from aerpaw_cmp.flight.drafting.proposals import NodeFinder
from aerpaw_cmp.logs.ingest import IngestedFile
from aerpaw_cmp.logs.records import COLUMNS, ReadResult, Stream
from aerpaw_cmp.site.siteyaml import load_site

ZONE = "America/New_York"


def _log(path: Path | str, start: str, *, low_m: float = 0.0, **attributes: str) -> IngestedFile:
    rows = 300
    time = np.datetime64(start, "ns") + np.arange(rows) * np.timedelta64(1, "s") + np.timedelta64(123, "ns")
    frame = pd.DataFrame({"time": time, "line": np.arange(rows) + 1, "flag": ""})
    height = np.concatenate([np.full(10, low_m), np.linspace(low_m, low_m + 40.0, rows - 10)])
    frame = frame.assign(**dict.fromkeys(COLUMNS["telemetry"], 0.0)).assign(altitude_m=height)
    stream = Stream("telemetry", "vehicle", frame, attributes)
    return IngestedFile(str(path), "0" * 64, ReadResult("made_up", (stream,), rows, rows, 0))


def _asked(file: IngestedFile, timezone: str | None = ZONE) -> list[str]:
    return questions(file, file.result.streams, timezone)


@pytest.mark.parametrize(
    ("name", "start", "asked"),
    [
        ("2023-12-13_12_33_02_power_log.txt", "2023-12-13T17:33:07", False),  # local
        ("2023-12-13_12_33_02_power_log.txt", "2023-12-13T12:33:07", False),  # UTC
        ("2023-12-13_12_33_02_power_log.txt", "2023-12-13T21:33:07", True),
        ("2023-12-13_12_33_02_power_log.txt", "2023-12-14T17:33:07", True),
        ("july2_2024-07-02.csv", "2024-07-02T15:37:11", False),
        ("july2_2024-07-02.csv", "2009-02-24T15:37:11", True),
        ("results_20230230_1.csv", "2024-07-02T15:37:11", False),  # no date
        ("plain.csv", "2024-07-02T15:37:11", False),
        ("2023-12-13_12_33_02.txt", "1970-01-01T00:00:00", False),  # relative times
    ],
)
def test_the_name_of_a_file_is_compared_with_its_start(name: str, start: str, asked: bool) -> None:
    remarks = _asked(_log(name, start))
    assert bool(remarks) is asked
    if asked:
        assert start.replace("T", " ")[:16] in remarks[0]
        assert "the file's name has 20" in remarks[0]


@pytest.mark.parametrize(("low_m", "asked"), [(0.4, False), (-2.0, False), (24.3, True), (110.0, True), (-40.0, True)])
def test_a_track_that_does_not_begin_on_the_ground_is_asked_about(low_m: float, asked: bool) -> None:
    remarks = _asked(_log("plain.csv", "2024-07-02T15:00:00", low_m=low_m))
    assert bool(remarks) is asked
    if asked:
        assert f"the lowest height is {low_m:.0f} m" in remarks[0]


@pytest.mark.parametrize(("step_m", "after_m", "low_m"), [(2.0, 28.0, 0.3), (0.0, 110.0, 110.0)])  # climb; no fix
def test_a_log_that_ends_in_the_air_begins_on_the_ground(step_m: float, after_m: float, low_m: float) -> None:
    height = np.concatenate([0.3 + step_m * np.arange(14), np.full(1400, after_m)])
    log = _log("plain.csv", "2024-07-02T15:00:00").result.streams[0]
    frame = log.frame.iloc[np.zeros(len(height), dtype=np.int64)].assign(altitude_m=height)
    assert _lowest_m(replace(log, frame=frame)) == pytest.approx(low_m)


@pytest.mark.parametrize(("low_m", "asked"), [(140.0, True), (90.0, True), (180.0, False), (60.0, False)])
def test_heights_near_the_ground_above_the_sea_are_asked_about_in_the_air(low_m: float, asked: bool) -> None:
    """The ground is 120 m above the sea. A flight segment at 90 m above take-off is not an error."""
    site = replace(load_site("lake_wheeler"), ground_above_sea_m=120.0)
    (log,) = _log("plain.csv", "2024-07-02T15:00:00", low_m=low_m).result.streams
    aloft = replace(log, frame=log.frame.iloc[10:])
    clauses = check_heights(site, "plain.csv", aloft)
    assert len(clauses) == asked
    assert all("write 'takeoff_ground_m: -120'" in text for text in clauses)
    if asked:  # at rest before it climbs: this is the take-off
        with pytest.raises(InputError, match=f"takeoff_ground_m: -{low_m:.0f}") as refused:
            check_heights(site, "plain.csv", log)
        assert "300 m" not in str(refused.value)  # 90 m are below it
        assert "if the log begins in the air, remove its rows before the climb" in str(refused.value)
    assert not check_heights(replace(site, takeoff_ground_m=-low_m), "plain.csv", log)


def test_heights_are_not_doubted_once_the_site_has_the_ground_of_the_take_off() -> None:
    (log,) = _log("plain.csv", "2024-07-02T15:00:00", low_m=1690.0).result.streams
    track: Any = SimpleNamespace(start_ns=0)
    (clause,) = doubts(track, log, ())
    assert "the lowest height above take-off is 1690 m" in clause
    assert not doubts(track, log, (), (), -1690.0)


def test_what_is_assumed_is_asked_and_what_is_written_is_not() -> None:
    log = _log("plain.csv", "2024-07-02T15:00:00", clock_from="assumed", clock_source="local wall time",
               height_from="assumed", height_source="above take-off")  # fmt: skip
    clock, height = _asked(log)
    assert "read as local wall time" in clock
    assert "read as above take-off" in height
    assert not _asked(_log("plain.csv", "2024-07-02T15:00:00", clock_from="written", height_from="program"))


def test_levels_doubt_a_named_tower_only_where_another_fits_far_better() -> None:
    site = load_site("lake_wheeler")
    names = list(site.towers)
    start = np.array(site.towers["LW1"].position_m)
    along = np.linspace(0.0, 5.0, 500)
    leg, part = np.divmod(along, 1.0)
    east = start[0] + 400.0 * np.where(leg % 2 == 0, part, 1.0 - part) - 200.0
    north = start[1] + 80.0 * leg - 200.0
    latitude, longitude = site.frame.to_geographic(east, north)
    log = _log("plain.csv", "2024-07-02T15:00:00")
    frame = log.result.streams[0].frame
    frame = pd.DataFrame({name: np.resize(frame[name].to_numpy(), 500) for name in frame.columns})
    time = np.datetime64("2024-07-02T15:00:00", "ns") + np.arange(500) * np.timedelta64(1, "s")
    frame = frame.assign(time=time, latitude_deg=latitude, longitude_deg=longitude, altitude_m=30.0)
    finder = NodeFinder(site, Stream("telemetry", "vehicle", frame))
    away = np.linalg.norm(np.column_stack([east, north, np.full(500, 30.0)]) - start, axis=1)
    level = frame[["time", "line", "flag"]].assign(rss_db=-60.0 - 30.0 * np.log10(away / 100.0))
    track = finder.levels(Stream("rss", "power", level))
    assert finder.contradiction(track, "LW1") is None
    doubts = [finder.contradiction(track, name) for name in names if name != "LW1"]
    assert "LW1" in doubts
    assert set(doubts) <= {None, "LW1"}
    assert finder.contradiction(track, "elsewhere") is None
