"""Stands, trees and heights of buildings from rasters of known shapes."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from shapely.geometry import Point, box

from aerpaw_cmp.__main__ import main
from aerpaw_cmp.common.geodesy import SiteFrame
from aerpaw_cmp.site.imports.canopy import building_heights, canopy_of
from aerpaw_cmp.site.relief.dem import Dem
from aerpaw_cmp.site.siteyaml import load_site

FRAME = SiteFrame(35.7, -78.7)
# Centres of cells of one metre.
EAST, NORTH = np.meshgrid(np.arange(-99.5, 100.0), np.arange(-79.5, 80.0))


def raster(height: np.ndarray) -> Dem:
    return Dem(height, EAST[0, 0], NORTH[0, 0], 1.0, 1.0, "local", FRAME, anchored=False)


def canopy() -> np.ndarray:
    """A ring of wood 18 m high round a glade, a crown of 9 m, a bush, and low growth everywhere."""
    away = np.hypot(EAST - 30.0, NORTH)
    height = np.where((away < 40.0) & (away > 12.0), 18.0, 0.4)
    height[np.hypot(EAST + 60.0, NORTH - 20.0) < 4.0] = 9.0
    height[(EAST == -79.5) & (NORTH == 0.5)] = 5.0
    return height


def ascii_grid(folder: Path, name: str, height: np.ndarray) -> Path:
    tifffile = pytest.importorskip("rasterio")
    path = folder / name
    transform = tifffile.Affine(1.0, 0.0, 683_000.0, 0.0, -1.0, 3_953_000.0)
    about = {"driver": "GTiff", "height": height.shape[0], "width": height.shape[1], "count": 1, "dtype": "float32"}
    with tifffile.open(path, "w", crs="EPSG:32617", transform=transform, **about) as file:
        file.write(height[::-1].astype(np.float32), 1)
    return path


def test_a_wood_is_a_stand_with_its_glade_and_a_crown_is_a_tree() -> None:
    forests, trees, actions = canopy_of(raster(canopy()))
    (wood,), (tree,) = forests, trees
    assert wood.height_m == 18.0
    assert wood.area.area == pytest.approx(np.pi * (40**2 - 12**2), rel=0.01)
    assert wood.area.hausdorff_distance(Point(30, 0).buffer(40) - Point(30, 0).buffer(12)) < 1.5
    assert (tree.east_m, tree.north_m, tree.height_m) == (pytest.approx(-60, abs=0.6), pytest.approx(20, abs=0.6), 9.0)
    assert tree.crown_diameter_m == pytest.approx(8.0, abs=0.5)
    assert actions == ["canopy: 1 stands and 1 single trees of 3 areas from 3 m up"]


def test_buildings_take_their_height_over_the_ground_around_them() -> None:
    ground = 120.0 + 0.01 * EAST
    barn, shed = box(-20.0, -10.0, 0.0, 10.0), box(50.0, 50.0, 56.0, 54.0)
    surface = np.where((EAST > -20) & (EAST < 0) & (np.abs(NORTH) < 10), ground + 7.5, ground)
    surface[:, :5] = np.nan
    heights = building_heights(raster(surface), [barn, shed, box(-130.0, 0.0, -110.0, 20.0)])
    assert heights[0] == pytest.approx(7.5, abs=0.3)
    assert abs(heights[1]) < 0.5
    assert np.isnan(heights[2])


def test_the_command_writes_a_site_and_refuses_canopies_that_are_none(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from pyproj import Transformer

    longitude, latitude = Transformer.from_crs("EPSG:32617", "EPSG:4326", always_xy=True).transform(
        683_100.0, 3_952_920.0
    )
    base = tmp_path / "base.yaml"
    base.write_text(
        f"name: s\norigin: {{latitude_deg: {latitude}, longitude_deg: {longitude}}}\n"
        f"towers: {{T: {{latitude_deg: {latitude}, longitude_deg: {longitude}}}}}\n"
        "buildings: [{name: barn, height_m: 3, polygon_m: [[-20, -10], [0, -10], [0, 10], [-20, 10]]}]\n"
    )
    surface = np.where((EAST > -20) & (EAST < 0) & (np.abs(NORTH) < 10), 97.0, 90.0)
    out = tmp_path / "site.yaml"
    about = ["site", "import", "--base", str(base), "-o", str(out)]
    files = [ascii_grid(tmp_path, "chm.tif", canopy()), ascii_grid(tmp_path, "dsm.tif", surface)]
    assert main([*about, "--canopy", str(files[0]), "--buildings", str(files[1])]) == 0
    site = load_site(out)
    assert site.buildings[0].height_m == pytest.approx(7.0, abs=0.1)
    assert [forest.height_m for forest in site.forests] == [18.0]
    assert site.forests[0].area.centroid.distance(Point(30, 0)) < 1.0
    assert len(yaml.safe_load(out.read_text())["trees"]["single"]) == len(site.trees) == 1
    for height, stated in ((canopy() - 3.0, "-2.6 m"), (canopy() + 150.0, "168.0 m")):
        wrong = ascii_grid(tmp_path, "wrong.tif", height)
        assert main([*about, "--force", "--canopy", str(wrong)]) == 3
        assert stated in capsys.readouterr().err
    assert main(about) == 2
