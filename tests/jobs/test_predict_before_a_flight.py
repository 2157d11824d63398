"""Predictions at a site without any flight: ray tracing with a stated prior."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from aerpaw_cmp.__main__ import main
from aerpaw_cmp.common.units import wavelength_m
from aerpaw_cmp.report.maps import ANTENNAS, percent

SITE = """name: meadow
origin: {latitude_deg: 48.0, longitude_deg: 11.0}
towers: {T1: {latitude_deg: 48.0, longitude_deg: 11.0, antenna_height_m: 20}}
coverage: {carrier_ghz: 2.5, tx_power_dbm: 30}
"""
# far from the towers of any packaged site; 30 degrees north of the ground's reflections
POINTS = "east_m,north_m,height_m\n300,0,60\n0,400,60\n-250,250,60\n"


@pytest.fixture
def place(tmp_path: Path) -> Path:
    (tmp_path / "site.yaml").write_text(SITE)
    (tmp_path / "points.csv").write_text(POINTS)
    return tmp_path


def predicted(place: Path, *words: str) -> tuple[pd.DataFrame, dict[str, object]]:
    out = place / "out"
    command = ["predict", str(place / "points.csv"), "--site", str(place / "site.yaml"), "-o", str(out), "--force"]
    assert main([*command, *words]) == 0
    return pd.read_csv(out / "prediction.csv"), json.loads((out / "metrics.json").read_text())


def test_level_is_that_of_two_paths_and_the_standard_deviation_is_stated(place: Path) -> None:
    table, metrics = predicted(place)
    points = np.array([[300, 0, 60], [0, 400, 60], [-250, 250, 60]], dtype=float)
    away = np.linalg.norm(points - [0, 0, 20], axis=1)
    free = 30.0 + 20 * np.log10(wavelength_m(2.5e9) / (4 * np.pi * away))
    # the power sum adds between nothing and the whole of one ground reflection (3 dB) to the direct path
    above = table["level_db"].to_numpy() - free
    assert ((above > 0.0) & (above < 3.02)).all()
    assert table["sd_db"].to_numpy() == pytest.approx(np.sqrt(10**2 + 8**2 + 6**2 + 5**2), abs=0.01)
    half = (table["q95_db"] - table["q05_db"]).to_numpy() / 2
    assert half == pytest.approx(1.6449 * table["sd_db"].to_numpy(), rel=1e-3)
    assert "No flight is known" in str(metrics["sentence"])
    assert "2.5 GHz, 30 dBm" in str(metrics["sentence"])
    # there is no flown area before the first flight
    assert "Outside flown area" not in (place / "out" / "prediction.html").read_text(encoding="utf-8")


def test_points_outside_the_area_of_the_site_are_counted(place: Path) -> None:
    assert not any("outside the area" in text for text in predicted(place)[1]["warnings"])
    (place / "points.csv").write_text(POINTS + "9000,0,60\n")
    assert "25 % of the points are outside the area of the site" in predicted(place)[1]["warnings"][0]


def test_points_and_heights_below_the_ground(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (place / "points.csv").write_text(POINTS + "100,0,-5\n")
    assert any(text.startswith("1 of ") and "below the ground" in text for text in predicted(place)[1]["warnings"])
    for command in ("predict", "plan"):
        assert main([command, str(place / "site.yaml"), "-o", str(place / "low"), "--height", "-40"]) == 2
        assert "'--height': expected greater than or equal to 0.1" in capsys.readouterr().err


def test_a_route_through_a_building_is_reported(place: Path) -> None:
    """A point in the air above the building is not inside it, and a route of one point has no spacing."""
    (place / "points.csv").write_text("latitude_deg,longitude_deg,height_m\n48.0009,11,5\n48.0009,11.0009,5\n")
    assert not any("inside buildings" in text for text in predicted(place)[1]["warnings"])
    site = SITE + "buildings: [{name: b, height_m: 9, polygon_m: [[20, 90], [40, 90], [40, 110], [20, 110]]}]\n"
    (place / "site.yaml").write_text(site)
    table, metrics = predicted(place)
    lost = int(table["level_db"].isna().sum())
    assert lost == 2  # 20 m of the route, one point every 10 m
    assert f"{lost} of {len(table)} points inside buildings, where no path arrives." in metrics["warnings"]
    (place / "points.csv").write_text("latitude_deg,longitude_deg,height_m\n48.0009,11.0004,12\n")
    assert not any("inside" in text or "apart" in text for text in predicted(place)[1]["warnings"])


def test_options_replace_carrier_and_power_of_the_site(place: Path) -> None:
    level = predicted(place)[0]["level_db"].to_numpy()
    changed = predicted(place, "--tx-power-dbm", "20", "--carrier-ghz", "2.5")[0]["level_db"].to_numpy()
    np.testing.assert_allclose(level - changed, 10.0, atol=1e-3)


def test_a_power_in_watts_is_refused(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["predict", str(place / "points.csv"), "--site", str(place / "site.yaml"), "-o", str(place / "out")]
    assert main([*words, "--tx-power-dbm", "2000"]) == 2
    assert "a transmit power of 2000 dBm; expected -60 to 100 dBm" in " ".join(capsys.readouterr().err.split())


def test_carrier_beside_flights_is_refused(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sample = Path(__file__).parents[2] / "sample_logs" / "flight.yaml"
    words = ["predict", str(place / "points.csv"), "--with", str(sample), "--carrier-ghz", "2.4"]
    assert main([*words, "-o", str(place / "p")]) == 2
    assert "--with and --carrier-ghz" in capsys.readouterr().err


def test_channel_of_a_route_needs_no_logs_and_a_report_does(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (place / "flight.yaml").write_text("flight: plan\nsite: site.yaml\nlogs: []\n")
    command = ["channel", str(place / "flight.yaml"), "--route", str(place / "points.csv"), "-o", str(place / "c")]
    assert main([*command, "--format", "npz"]) == 0
    capsys.readouterr()
    assert main(["report", str(place / "flight.yaml"), "-o", str(place / "r")]) == 2
    assert "lists no log" in capsys.readouterr().err


def test_a_map_prints_the_coverage_of_one_element_and_of_the_array(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The array's beam has nulls, so its share alone would not be that of free space."""
    words = ["--no-study", "--spacing", "100", "--rss-altitude", "60", "--rank-altitude", "60", "--foliage", "none"]
    command = ["map", str(place / "site.yaml"), *words, "--threshold-dbm", "-75", "-o", str(place / "map"), "-q"]
    assert main(command) == 0
    printed = capsys.readouterr().out
    assert "joint" not in printed  # of one tower it is this tower
    layers = pd.read_csv(place / "map" / "layers.csv")
    one, four = (100 * (layers[f"rss_{kind}_h060m_T1_none"] >= -75).mean() for kind in ("siso", "mimo"))
    assert one > four + 1.0
    (line,) = (line for line in printed.splitlines() if "T1" in line and "SISO" in line)
    assert percent(one / 100, 1) in line
    (line,) = (line for line in printed.splitlines() if "T1" in line and "MIMO" in line)
    assert percent(four / 100, 1) in line
    assert ANTENNAS in " ".join(printed.split())
    assert ANTENNAS in (place / "map" / "map.html").read_text()
    away = np.linalg.norm(layers[["east_m", "north_m"]].assign(up=40.0), axis=1)
    free = 30.0 + 20 * np.log10(wavelength_m(2.5e9) / (4 * np.pi * away))
    # the direct path plus or minus one ground reflection
    assert np.abs(layers["rss_siso_h060m_T1_none"] - free).max() < 8.0
    assert np.abs(np.median(layers["rss_siso_h060m_T1_none"] - free)) < 1.0
