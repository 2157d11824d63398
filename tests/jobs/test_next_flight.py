"""The plan command on the packaged site: files, bad input, and headings where antennas are unknown."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import shapely

from aerpaw_cmp.__main__ import main
from aerpaw_cmp.flight.route_files import read_route
from aerpaw_cmp.jobs import next_flight
from aerpaw_cmp.site.siteyaml import load_site
from tests.json_page import unlisted

pytestmark = pytest.mark.usefixtures("few_pictures")

SITE = ["--site", "lake_wheeler", "--tower", "LW1", "--minutes", "4"]


def kml(path: Path, corners: list[tuple[float, float]]) -> Path:
    """A geofence by east and north of the site [m]."""
    east, north = np.array(corners, dtype=float).T
    latitude, longitude = load_site("lake_wheeler").frame.to_geographic(east, north)
    text = " ".join(f"{b:.7f},{a:.7f},0" for a, b in zip(latitude, longitude, strict=True))
    path.write_text(
        f"<kml><Placemark><Polygon><outerBoundaryIs><LinearRing><coordinates>{text}</coordinates>"
        "</LinearRing></outerBoundaryIs></Polygon></Placemark></kml>"
    )
    return path


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("plan")
    kml(folder / "fence.kml", [(-300, -250), (250, -250), (250, 250), (-300, 250)])
    kml(folder / "small.kml", [(-20, -20), (20, -20), (20, 20), (-20, 20)])
    kml(folder / "far.kml", [(9000, 0), (9500, 0), (9500, 500), (9000, 500)])
    turn = 2.0 * np.pi * 1201 / 3000 * np.arange(3000)  # a star whose sides all cross
    kml(folder / "tangled.kml", [*zip(200 * np.cos(turn), 200 * np.sin(turn), strict=True)])
    turn = 2.0 * np.pi * np.arange(10_001) / 10_001
    kml(folder / "round.kml", [*zip(200 * np.cos(turn), 200 * np.sin(turn), strict=True)])
    (folder / "points.csv").write_text("east_m,north_m,height_m\n0,100,40\n,,\n50,120,40\n")
    (folder / "far.csv").write_text("east_m,north_m,height_m\n,,\n9000,0,40\n")
    (folder / "nowhere.csv").write_text("east_m,north_m,height_m\n,,\n")
    (folder / "twice.csv").write_text("east_m,north_m,height_m\n0,100,40\n0,100,40\n")
    (folder / "torn.plan").write_text('{"fileType": "Plan", "mission": {')
    (folder / "long.csv").write_text("latitude_deg,longitude_deg,altitude_m\n35.72,-78.70,40\n35.74,-78.70,40\n")
    return folder


def test_plan_writes_the_best_route_and_prefers_headings(place: Path) -> None:
    out = place / "out"
    assert main(["plan", "sphere", *SITE, "--geofence", str(place / "fence.kml"), "--route", str(place / "long.csv"),
                 "-o", str(out), "-q"]) == 0  # fmt: skip
    metrics = json.loads((out / "metrics.json").read_text())
    assert unlisted("plan", metrics) == []
    may = [c for c in metrics["candidates"] if not c["refused"]]
    assert [c["sd_db"] for c in may] == sorted(c["sd_db"] for c in may)
    (refused,) = [c for c in metrics["candidates"] if c["refused"]]
    assert refused["name"] == "long.csv"
    assert metrics["candidates"][-1] == refused
    assert may[0]["sd_db"] < 0.9 * metrics["sd_now_db"]
    fixed, turned = (min(c["sd_db"] for c in may if word in c["name"]) for word in ("nose to the north", "turned"))
    assert turned < fixed
    assert [p["sd_db"] for p in metrics["length"]] == sorted((p["sd_db"] for p in metrics["length"]), reverse=True)
    route = read_route(out / "route.plan")
    assert set(route["altitude_m"]) == {40.0}
    frame = load_site("lake_wheeler").frame
    east, north = frame.to_local(route["latitude_deg"].to_numpy(), route["longitude_deg"].to_numpy())
    assert (np.abs(east + 25) < 276).all()
    assert (np.abs(north) < 251).all()
    table = pd.read_csv(out / "sd_map.csv")
    assert (table["sd_after_db"] <= table["sd_before_db"] + 0.02).all()
    page = (out / "plan.html").read_text(encoding="utf-8")
    assert "Candidates" in page
    assert "Next flight for all directions around the towers" in page


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["sphere", "--geofence", "small.kml"], 2, "no route fits"),
        (["far.csv"], 2, "outside the area that may be flown"),
        (["sphere", "--geofence", "far.kml"], 2, "outside the area of site Lake Wheeler"),
        (["nowhere.csv"], 3, "no point has a position"),
        (["points.csv", "--route", "torn.plan"], 3, "damaged QGroundControl plan"),
        (["points.csv", "--route", "gone.kml"], 3, "gone.kml"),
        (["points.csv", "--route", "twice.csv"], 3, "the route ends within a second"),
        (["sphere", "--geofence", "points.csv"], 3, "without an area"),
        (
            ["sphere", "--geofence", "tangled.kml"],
            3,
            "3000 corners that cannot be used; expected at most 10000 corners",
        ),
        (["sphere", "--avoid", "round.kml"], 3, "an area of 10001 corners that cannot be used"),
        (["sphere", "--tower", "LW9"], 2, "no tower 'LW9'"),
        (["sphere", "--height=-inf"], 2, "expected greater than or equal to 0.1"),
        (["sphere", "--height", "nan"], 2, "expected less than or equal to 10000"),
    ],
)
def test_bad_input_is_one_message(
    place: Path, capsys: pytest.CaptureFixture[str], words: list[str], code: int, said: str
) -> None:
    named = [str(place / w) if "." in w else w for w in words]
    assert main(["plan", *named, *SITE, "-o", str(place / "bad"), "-q"]) == code
    text = capsys.readouterr().err
    assert said in text
    assert "Traceback" not in text
    assert not (place / "bad").exists()


def test_points_without_a_position_are_left_out_and_counted(place: Path) -> None:
    out = place / "points_out"
    words = [str(place / "points.csv"), *SITE, "--geofence", str(place / "fence.kml"), "-o", str(out), "-q"]
    assert main(["plan", *words]) == 0
    table = pd.read_csv(out / "sd_map.csv")
    assert len(table) == 2 * 4  # four headings at each of two points
    assert table.notna().all().all()
    assert "1 of 3 points without a position" in " ".join(json.loads((out / "metrics.json").read_text())["warnings"])


@pytest.mark.parametrize(("away_m", "above_m", "refused"), [(0, 2, True), (0, 4, False), (2, -5, True), (4, -5, False)])
def test_a_track_through_or_near_a_building_is_refused(away_m: float, above_m: float, refused: bool) -> None:
    site = load_site("lake_wheeler")
    barn = site.buildings[0]
    west, _, east, north = barn.footprint.bounds
    up = barn.base_m + barn.height_m + above_m
    track = np.array([[west - 500, north + away_m, up], [east + 500, north + away_m, up]])
    footprints = shapely.STRtree([barn.footprint])
    assert bool(next_flight._blocked(track, replace(site, buildings=(barn,)), footprints)) == refused


def test_without_a_geofence_the_area_is_that_of_the_site() -> None:
    site = load_site("lake_wheeler")
    west, east, south, north = site.area_m
    area = next_flight._area(site, next_flight.PlanOptions(tower_distance_m=0.0))
    # routes stay 3 m inside
    np.testing.assert_allclose(area.bounds, (west + 3.0, south + 3.0, east - 3.0, north - 3.0), atol=0.1)
