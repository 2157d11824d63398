"""maps.nc is read back with xarray, checked by the checker of its conventions, and faults planted in it are seen."""

import sys

import numpy as np
import pytest

from aerpaw_cmp.common.cf import file_attributes, netcdf_bytes
from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.common.geodesy import SiteFrame
from aerpaw_cmp.maps import export
from aerpaw_cmp.maps.grid import RANK_CLASSES, Grid, Layer, MapResult, serving_tower, voronoi_borders

FRAME = SiteFrame(35.7275, -78.6960)
AREA = (-90.0, 90.0, -60.0, 90.0)
GRID = Grid.over_area(AREA)
TOWERS_M = np.array([[-50.0, 0.0, 10.0], [60.0, 10.0, 12.0], [0.0, 80.0, 9.0]])
NAMES = ("LW1", "LW2", "mast é 3")
HEIGHTS, RANK_HEIGHTS, KS = (30.0, 70.0), (3.0, 30.0, 60.0, 90.0), (10.0, 1000.0)


def made(seed):
    """Numbers that differ everywhere, so that no two axes can be taken for each other."""
    rng = np.random.default_rng(seed)
    n, towers = len(GRID), len(NAMES)

    def levels(heights, low, high):
        values = np.round(rng.uniform(low, high, (heights, towers, n)), 2)
        values[rng.random(values.shape) < 0.1] = np.nan
        return values

    return MapResult(
        grid=GRID, tower_names=NAMES, towers_m=TOWERS_M, rss_altitudes_m=HEIGHTS, rank_altitudes_m=RANK_HEIGHTS, ks=KS,
        rss_siso_dbm=levels(len(HEIGHTS), -120, -40), rss_mimo_dbm=levels(len(HEIGHTS), -120, -40),
        level_sd_db=levels(len(HEIGHTS), 0, 9),
        rank=rng.integers(0, 5, (len(RANK_HEIGHTS), len(KS), towers, n)).astype(np.int8),
        spread_db=levels(len(RANK_HEIGHTS), 0, 60), condition_db=levels(len(RANK_HEIGHTS), 100, 400),
        serving=serving_tower(GRID.points_m, TOWERS_M), borders=voronoi_borders(TOWERS_M, AREA),
    )  # fmt: skip


MAPS = {"none": made(1), "opaque": made(2)}


@pytest.fixture
def path(tmp_path):
    pytest.importorskip("netCDF4")
    return tmp_path / "maps.nc"


def write(path):
    about = file_attributes(title="A <site>", source="ray tracing", comment="A gap has no path.")
    number = GRID.raster(np.arange(len(GRID)))
    level = Layer(
        name="rss_sd", tower="LW1", height_m=30.0, values=number / 4.0, unit="dB", quantity="Standard deviation"
    )
    rank = Layer(
        name="rank_learned", tower="LW1", height_m=30.0, values=number % 5, unit="", quantity="Rank",
        classes=RANK_CLASSES,
    )  # fmt: skip
    path.write_bytes(netcdf_bytes(export.maps_dataset(MAPS, FRAME, about, [level, rank])))
    return path


def check(path):
    """Every value by the names of its coordinates, none by its number on an axis."""
    xr = pytest.importorskip("xarray")
    with xr.open_dataset(path, decode_coords="all", mask_and_scale=True) as data:
        assert data["tower"].values.tolist() == list(NAMES)
        assert data["rss_mimo"].attrs["units"] == "0.1 lg(re 1 mW)"
        assert data["spread"].attrs["units"] == "0.1 lg(re 1)"
        assert " written by aerpaw-cmp " in data.attrs["history"]
        for mode, maps in MAPS.items():
            of_mode = data.sel(foliage=mode)
            for i, (east, north) in enumerate(GRID.points_m):
                here = of_mode.sel(x=east, y=north)
                assert FRAME.to_local(here["latitude"], here["longitude"]) == pytest.approx((east, north), abs=1e-3)
                serves = maps.serving[i]
                assert int(here["serving_tower"]) == serves
                for t, name in enumerate(NAMES):
                    alone = here.sel(tower=name)
                    same(alone["rss_siso"].sel(height=[70.0, 30.0]), maps.rss_siso_dbm[[1, 0], t, i])
                    same(alone["rss_mimo"].sel(height=[70.0, 30.0]), maps.rss_mimo_dbm[[1, 0], t, i])
                    same(alone["spread"].sel(height_of_rank=3.0), maps.spread_db[0, t, i])
                    same(alone["condition"].sel(height_of_rank=90.0), min(maps.condition_db[3, t, i], 180.0))
                    for k, ratio in enumerate(KS):
                        same(alone["rank"].sel(k=ratio).sel(height_of_rank=list(RANK_HEIGHTS)), maps.rank[:, k, t, i])
                same(here["rss_mimo_joint"].sel(height=30.0), maps.rss_mimo_dbm[0, serves, i])
                same(here["rank_joint"].sel(k=1000.0, height_of_rank=60.0), maps.rank[2, 1, serves, i])
        rank = data["rank"].attrs
        assert rank["flag_meanings"].split()[0] == "out_of_coverage"
        assert rank["flag_values"].tolist() == [0, 1, 2, 3, 4]
        # 'rank_1', because a bare number next to the values could be taken for one; words stay as they are
        learned = data["rank_learned_h030m_LW1"].attrs["flag_meanings"]
        assert learned == "Z rank_1 rank_2 rank_3 rank_4"
        import pyproj

        crs = pyproj.CRS.from_wkt(data["crs"].attrs["crs_wkt"])
        assert crs.name.startswith("Site frame")
        there = pyproj.CRS.from_cf({n: v for n, v in data["crs"].attrs.items() if n != "crs_wkt"})
        assert there.coordinate_operation.params[0].value == pytest.approx(FRAME.latitude_deg)
        latitude, longitude = float(data["latitude"][0, 0]), float(data["longitude"][0, 0])
        there = pyproj.Transformer.from_crs(4326, crs, always_xy=True).transform(longitude, latitude)
        assert there == pytest.approx(tuple(GRID.points_m[0]), abs=1e-3)


def same(values, expected):
    np.testing.assert_allclose(values, expected, atol=1e-5)


def test_every_value_is_found_by_its_coordinates(path):
    check(write(path))


def test_it_passes_the_checker_of_the_conventions_it_claims(path, cf_faults):
    assert cf_faults(write(path)) == []


def test_a_missing_library_is_named_with_its_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "netCDF4", None)
    with pytest.raises(UsageError, match=r"aerpaw-cmp\[geo\]"):
        write(tmp_path / "m.nc")


def test_further_layers_are_variables_in_index_order(path):
    xarray = pytest.importorskip("xarray")
    with xarray.open_dataset(write(path)) as book:
        assert np.array_equal(book["rss_sd_h030m_LW1"].to_numpy().ravel(), np.arange(len(GRID)) / 4.0)
        assert book["rss_sd_h030m_LW1"].attrs["grid_mapping"] == "crs"
        assert np.array_equal(book["rank_learned_h030m_LW1"].to_numpy().ravel(), np.arange(len(GRID)) % 5)
