"""Towers of a flight's own: a place, a log of positions that stays, refusals."""

from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from aerpaw_cmp.common.errors import InputError, UsageError
from aerpaw_cmp.flight.data import ground_nodes
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
    placed, _ = ground_nodes(site, flight(latitude_deg=35.728, longitude_deg=-78.697, antenna_height_m=1.0), tmp_path)
    east, north = site.frame.to_local([35.728], [-78.697])
    assert placed.towers["ROVER"].position_m == pytest.approx([east[0], north[0], 1.0])
    assert set(placed.towers) == {*site.towers, "ROVER"}
    assert "ROVER" not in site.towers


def test_a_track_that_stays_is_a_place_and_one_that_moves_a_track(tmp_path):
    site = load_site("lake_wheeler")
    rover(tmp_path, 1e-7)  # 0.3 m in all
    still, _ = ground_nodes(site, flight(track="rover.csv"), tmp_path)
    assert still.towers["ROVER"].latitude_deg == pytest.approx(35.728, abs=3e-6)
    rover(tmp_path, 1e-5)  # 32 m
    warnings: list[str] = []
    moved, nodes = ground_nodes(site, flight(track="rover.csv"), tmp_path, warnings)
    assert moved.towers["ROVER"].latitude_deg == pytest.approx(35.728 + 1.45e-4, abs=1e-7)
    assert "moves 16 m" in warnings[0]
    at = nodes["ROVER"].pose_at(np.array(["2023-12-13T17:00:10.5", "2023-12-13T18:00:00"], "datetime64[ns]"))
    east, north = site.frame.to_local([35.728 + 10.5e-5], [-78.697])
    assert at.position_m[0, :2] == pytest.approx([east[0], north[0]], abs=1e-6)  # the flight's zone: EST
    assert at.valid.tolist() == [True, False]
    with pytest.raises(InputError, match="no such log"):
        ground_nodes(site, flight(track="gone.csv"), tmp_path)


def test_the_attitude_of_a_node_gets_no_warning(tmp_path):
    path = rover(tmp_path, 1e-5)
    head, *rows = path.read_text().splitlines()
    path.write_text("\n".join([f"{head},heading", *(f"{row},90.0" for row in rows)]) + "\n")
    warnings: list[str] = []
    _, nodes = ground_nodes(load_site("lake_wheeler"), flight(track="rover.csv"), tmp_path, warnings)
    assert nodes["ROVER"].account.heading_alone == 30
    assert len(warnings) == 1
    assert "moves 16 m" in warnings[0]


def test_a_node_is_one_thing_and_has_its_own_name(tmp_path):
    for node in ({}, {"latitude_deg": 35.0}, {"latitude_deg": 35.0, "longitude_deg": -78.0, "track": "rover.csv"}):
        with pytest.raises(ValidationError, match="or a track"):
            flight(**node)
    settings = flight(latitude_deg=35.728, longitude_deg=-78.697)
    taken = settings.model_copy(update={"towers": {"LW1": settings.towers["ROVER"]}})
    with pytest.raises(UsageError, match="of this name"):
        ground_nodes(load_site("lake_wheeler"), taken, tmp_path)


def test_heights_are_the_ground_s_or_the_log_s(tmp_path):
    site = load_site("lake_wheeler")
    rover(tmp_path, 1e-5)
    text = (tmp_path / "rover.csv").read_text()
    text = text.replace(",0.0", ",25.0").replace("25.0", "0.0", 3)  # this reader's heights are above the first
    (tmp_path / "rover.csv").write_text(text)
    low, _ = ground_nodes(site, flight(track="rover.csv", antenna_height_m=2.0), tmp_path)
    assert low.towers["ROVER"].position_m[2] == pytest.approx(2.0)
    high, nodes = ground_nodes(site, flight(track={"path": "rover.csv"}, height="logged"), tmp_path)
    up = 25.0 + site.takeoff_ground_m
    assert high.towers["ROVER"].position_m[2] == pytest.approx(up)
    assert nodes["ROVER"].pose_at(np.array(["2023-12-13T17:00:10"], "datetime64[ns]")).position_m[0, 2] == up
    for wrong in ({"latitude_deg": 35.0, "longitude_deg": -78.0}, {"track": "rover.csv", "antenna_height_m": 2.0}):
        with pytest.raises(ValidationError, match="height: logged"):
            flight(height="logged", **wrong)
    (tmp_path / "rover.csv").write_text(text.replace(",25.0", ",").replace(",0.0\n", ",\n"))
    with pytest.raises(InputError, match=r"no (heights|positions)"):
        ground_nodes(site, flight(track="rover.csv", height="logged"), tmp_path)


def test_a_fix_at_null_island_is_no_motion(tmp_path):
    site = load_site("lake_wheeler")
    path = rover(tmp_path, 1e-7)
    path.write_text(path.read_text().replace("35.72800050,-78.697", "0.0,0.0"))
    assert "0.0,0.0" in path.read_text()
    assert not ground_nodes(site, flight(track="rover.csv"), tmp_path)[1]
