"""A draft says which tower, or which place, the levels of a log fit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from aerpaw_cmp.common.units import FloatArray
from aerpaw_cmp.common.yamlfile import parse_yaml
from aerpaw_cmp.flight.draft import draft
from aerpaw_cmp.flight.node import listed_places
from aerpaw_cmp.flight.settings import FlightFile
from aerpaw_cmp.logs.ingest import IngestedFile, ingest
from aerpaw_cmp.logs.readers import ReadOptions
from aerpaw_cmp.site.siteyaml import load_site

SITE = load_site("lake_wheeler")
ORIGIN = "2025-06-01T14:00:00Z"


def _track() -> FloatArray:
    """A lawnmower of 300 m by 300 m, once a second: east, north, up from the site's origin."""
    along = np.linspace(0.0, 5.0, 500)
    leg, part = np.divmod(along, 1.0)
    east = np.where(leg % 2 == 0, part, 1.0 - part) * 300.0 - 250.0
    return np.column_stack([east, np.minimum(leg, 5.0) * 60.0 - 50.0, np.full(500, 30.0)])


def _logs(folder: Path, node: tuple[float, float, float], level_100_m: float, slope: float = 3.0) -> list[IngestedFile]:
    track = _track()
    latitude, longitude = SITE.frame.to_geographic(track[:, 0], track[:, 1])
    rows = zip(range(500), latitude, longitude, track[:, 2], strict=True)
    (folder / "pose.csv").write_text("t,lat,lon,alt\n" + "".join(f"{t},{a:.7f},{o:.7f},{h}\n" for t, a, o, h in rows))
    away = np.linalg.norm(track - np.array(node), axis=1)
    level = level_100_m - 10.0 * slope * np.log10(away / 100.0) + np.random.default_rng(3).normal(0.0, 2.0, 500)
    (folder / "levels.csv").write_text("t,p\n" + "".join(f"{t},{v:.2f}\n" for t, v in enumerate(level)))
    named = {"time": "t", "latitude_deg": "lat", "longitude_deg": "lon", "altitude_m": "alt"}
    of_pose = ReadOptions(time_origin=ORIGIN, kind="telemetry", columns=named)
    of_level = ReadOptions(time_origin=ORIGIN, kind="rss", columns={"time": "t", "rss_db": "p"}, unit="dBm")
    return [
        *ingest([folder / "pose.csv"], reader="generic_csv", options=of_pose),
        *ingest([folder / "levels.csv"], reader="generic_csv", options=of_level),
    ]


def _drafted(folder: Path, node: tuple[float, float, float], level_100_m: float = -60.0) -> tuple[FlightFile, str]:
    text, remarks = draft(_logs(folder, node, level_100_m), folder, time_origin=ORIGIN)
    return parse_yaml(text, FlightFile), "\n".join(remarks)


def test_levels_of_a_tower_name_the_tower(tmp_path: Path) -> None:
    settings, remarks = _drafted(tmp_path, tuple(SITE.towers["LW1"].position_m))
    assert settings.logs[1].node == "LW1"
    assert not settings.towers
    assert "the levels fit LW1 best" in remarks


ROVER = (-120.0, 90.0, 1.5)


def test_levels_of_no_tower_are_placed_and_asked_about(tmp_path: Path) -> None:
    settings, remarks = _drafted(tmp_path, ROVER)
    assert settings.logs[1].node == "NODE"
    node = settings.towers["NODE"]
    east, north = SITE.frame.to_local(np.array([node.latitude_deg or 0.0]), np.array([node.longitude_deg or 0.0]))
    assert np.hypot(east[0] - ROVER[0], north[0] - ROVER[1]) < 25.0
    assert "the levels decide for no tower (LW1 possible)" in remarks  # it lies within the region
    assert "where did the node stand?" in remarks


def test_a_position_list_is_tried_first(tmp_path: Path) -> None:
    places = np.array([ROVER, (60.0, -20.0, 1.5), (-200.0, 300.0, 1.5)])
    latitude, longitude = SITE.frame.to_geographic(places[:, 0], places[:, 1])
    lines = [f"{a:.8f}, {o:.8f}" for a, o in zip(latitude, longitude, strict=True)]
    flipped = [f"{o:.8f}, {a:.8f}" for a, o in zip(latitude, longitude, strict=True)]
    (tmp_path / "rover_positions.txt").write_text("\n".join([lines[1], lines[0], lines[2], "", "flipped", *flipped]))
    assert [place.line for place in listed_places([tmp_path])] == [1, 2, 3, 6, 7, 8]
    settings, remarks = _drafted(tmp_path, ROVER)
    assert settings.towers["NODE"].latitude_deg == pytest.approx(latitude[0], abs=1e-6)
    assert "line 2 of rover_positions.txt" in remarks


@pytest.mark.parametrize(("level_100_m", "moved"), [(-45.0, False), (20.0, True), (-140.0, True)])
def test_the_span_of_offsets_holds_the_expected_one(tmp_path: Path, level_100_m: float, moved: bool) -> None:
    settings, _ = _drafted(tmp_path, tuple(SITE.towers["LW1"].position_m), level_100_m)
    low, high = settings.rss.span_db
    expected = 40.0 - 82.8 - level_100_m  # Friis over 100 m at 3.3 GHz: -82.8 dB
    assert low + 10.0 < expected < high - 10.0
    assert ((low, high) != (-50.0, 50.0)) is moved
