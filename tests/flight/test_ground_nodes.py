"""Towers of a flight's own: a place, a log of positions that stays, refusals."""

from pathlib import Path

import pytest
from pydantic import ValidationError

from aerpaw_cmp.common.errors import InputError, UsageError
from aerpaw_cmp.flight.data import with_ground_nodes
from aerpaw_cmp.flight.settings import FlightFile
from aerpaw_cmp.site.siteyaml import load_site

HEAD = "timestamp,latitude,longitude,altitude\n"


def flight(**node: object) -> FlightFile:
    return FlightFile.model_validate(
        {"flight": "f", "timezone": "America/New_York", "logs": [{"path": "a"}], "towers": {"ROVER": node}}
    )


def rover(folder: Path, steps_deg: float) -> Path:
    rows = [f"2023-12-13 12:00:{k:02d}.000,{35.728 + k * steps_deg:.8f},-78.697,0.0" for k in range(30)]
    path = folder / "rover.csv"
    path.write_text(HEAD + "\n".join(rows) + "\n")
    return path


def test_a_node_with_a_place_is_a_tower(tmp_path):
    site = load_site("lake_wheeler")
    found = with_ground_nodes(site, flight(latitude_deg=35.728, longitude_deg=-78.697, antenna_height_m=1.0), tmp_path)
    east, north = site.frame.to_local([35.728], [-78.697])
    assert found.towers["ROVER"].position_m == pytest.approx([east[0], north[0], 1.0])
    assert set(found.towers) == {*site.towers, "ROVER"}
    assert "ROVER" not in site.towers


def test_a_track_that_stays_is_a_place_and_one_that_moves_is_refused(tmp_path):
    site = load_site("lake_wheeler")
    rover(tmp_path, 1e-7)  # 0.3 m in all
    found = with_ground_nodes(site, flight(track="rover.csv"), tmp_path)
    assert found.towers["ROVER"].latitude_deg == pytest.approx(35.728, abs=3e-6)
    rover(tmp_path, 1e-5)  # 32 m
    with pytest.raises(UsageError, match="moves"):
        with_ground_nodes(site, flight(track="rover.csv"), tmp_path)
    with pytest.raises(InputError, match="no such log"):
        with_ground_nodes(site, flight(track="gone.csv"), tmp_path)


def test_a_node_is_one_thing_and_has_its_own_name(tmp_path):
    for node in ({}, {"latitude_deg": 35.0}, {"latitude_deg": 35.0, "longitude_deg": -78.0, "track": "rover.csv"}):
        with pytest.raises(ValidationError, match="or a track"):
            flight(**node)
    settings = flight(latitude_deg=35.728, longitude_deg=-78.697)
    taken = settings.model_copy(update={"towers": {"LW1": settings.towers["ROVER"]}})
    with pytest.raises(UsageError, match="of this name"):
        with_ground_nodes(load_site("lake_wheeler"), taken, tmp_path)
