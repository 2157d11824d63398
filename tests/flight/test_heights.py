"""Logs without altitude: the flight file says the height, and nothing is guessed in silence."""

from pathlib import Path

import numpy as np
import pytest

from aerpaw_cmp.common.errors import AerpawCmpError, InputError, UsageError
from aerpaw_cmp.flight.data import FlightData, load_data
from aerpaw_cmp.flight.drafting.draft import DraftOptions, draft
from aerpaw_cmp.flight.settings import load_flight
from aerpaw_cmp.flight.track import height_in_name
from aerpaw_cmp.logs.ingest import ingest
from aerpaw_cmp.logs.readers import ReadOptions

ZONE = "America/New_York"
ROWS = [(f"2025-03-02 10:00:{i:02d}", 35.7275 + 1e-5 * i, -78.696 + 2e-5 * i, -70 - i % 5) for i in range(40)]


def write(path: Path, *, altitude: bool) -> None:
    """Return a phone's log of one cell, 30 m above take-off if it has an altitude."""
    head = "Timestamp,Latitude,Longitude,RSRP" + (",Height" if altitude else "")
    rows = [",".join(map(str, row)) + (",30" if altitude else "") for row in ROWS]
    path.write_text("\n".join([head, *rows]) + "\n", encoding="utf-8")


def flight(folder: Path, keys: str, more: str = "") -> FlightData:
    path = folder / "flight.yaml"
    path.write_text(
        f"flight: phone\nsite: lake_wheeler\ntimezone: {ZONE}\n{more}logs:\n  - {{path: phone.csv, node: LW1{keys}}}\n"
        "link:\n  rss: {carrier_hz: 3.4e9, transmit_power_dbm: 40}\n"
    )
    return load_data(load_flight(path), folder)


def test_a_track_at_the_given_height_is_that_of_a_log_that_tells_it(tmp_path: Path) -> None:
    write(tmp_path / "phone.csv", altitude=True)
    logged = flight(tmp_path, "")
    write(tmp_path / "phone.csv", altitude=False)
    given = flight(tmp_path, ", height_m: 30")
    assert logged.track is not None
    assert given.track is not None
    times = given.rss[0].time
    np.testing.assert_array_equal(given.track.pose_at(times).position_m, logged.track.pose_at(times).position_m)
    assert given.rss[0].measured_db.tolist() == logged.rss[0].measured_db.tolist()
    notes = [text for text in given.warnings if "30 m above take-off everywhere" in text]
    assert len(notes) == 1
    assert not [text for text in given.warnings if "give the track another log" in text]
    low = flight(tmp_path, ", height_m: 1.5")
    assert low.track is not None
    np.testing.assert_allclose(
        given.track.pose_at(times).position_m[:, 2] - low.track.pose_at(times).position_m[:, 2], 28.5, rtol=0, atol=1e-6
    )


def test_without_a_height_the_message_names_the_key(tmp_path: Path) -> None:
    write(tmp_path / "phone.csv", altitude=False)
    with pytest.raises(InputError, match="no altitude in") as raised:
        flight(tmp_path, "")
    assert "'height_m: H' next to its path" in str(raised.value)


@pytest.mark.parametrize("keys", [", height_m: 30", ", height_m: 0"])
def test_a_height_beside_a_log_that_tells_it_is_refused(tmp_path: Path, keys: str) -> None:
    write(tmp_path / "phone.csv", altitude=True)
    with pytest.raises(UsageError, match="'height_m' has no effect"):
        flight(tmp_path, keys)


@pytest.mark.parametrize("height", ["high", "1e9", ".nan", ".inf"])
def test_a_height_is_a_height(tmp_path: Path, height: str) -> None:
    write(tmp_path / "phone.csv", altitude=False)
    with pytest.raises(AerpawCmpError, match="height_m"):
        flight(tmp_path, f", height_m: {height}")


def test_a_moving_tower_may_be_a_phone_without_altitude(tmp_path: Path) -> None:
    write(tmp_path / "phone.csv", altitude=True)
    write(tmp_path / "rover.csv", altitude=False)
    node = "towers: {{ROVER: {{track: {{path: rover.csv{}}}, height: logged}}}}\n"
    data = flight(tmp_path, "", node.format(", height_m: 12"))
    assert data.site.towers["ROVER"].position_m[2] == pytest.approx(12.0, abs=1e-6)


@pytest.mark.parametrize(("name", "height"), [("60m.csv", "60.0"), ("run_7_120m.csv", "120.0"), ("phone.csv", None)])
def test_a_draft_takes_the_height_of_the_files_name_and_asks(tmp_path: Path, name: str, height: str | None) -> None:
    write(tmp_path / name, altitude=False)
    files = ingest(tmp_path, options=ReadOptions(timezone=ZONE))
    text, remarks = draft(files, tmp_path, DraftOptions(timezone=ZONE))
    assert (f"height_m: {height}" in text) == (height is not None)
    (asked,) = (remark for remark in remarks if name in remark and remark.startswith("check: "))
    assert ("height_m from the file's name?" if height else "what is height_m?") in asked


def test_a_draft_of_a_log_with_altitudes_asks_for_no_height(tmp_path: Path) -> None:
    write(tmp_path / "60m.csv", altitude=True)
    text, _ = draft(ingest(tmp_path, options=ReadOptions(timezone=ZONE)), tmp_path, DraftOptions(timezone=ZONE))
    assert " height_m" not in text


@pytest.mark.parametrize(
    ("path", "height"),
    [
        ("a/60m.csv", 60.0),
        ("flight_at_40 m_x.txt", 40.0),
        ("100_meters.csv", 100.0),
        ("60m_to_120m.csv", None),  # two
        ("dataset12/run1.csv", None),
        ("70m/log.csv", None),  # a folder holds more than one flight
        ("5mhz.csv", None),
        ("fs20MHz_3.5m.csv", None),
        ("2025m03.csv", None),
    ],
)
def test_heights_in_names(path: str, height: float | None) -> None:
    assert height_in_name(path) == height
