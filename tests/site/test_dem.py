"""Planes are interpolated exactly, and a ridge blocks as in plane geometry."""

from pathlib import Path

import numpy as np
import pytest

from aerpaw_cmp.common.errors import InputError, UsageError
from aerpaw_cmp.common.geodesy import SiteFrame
from aerpaw_cmp.site.relief import EARTH_RADIUS_M, Dem, read_dem
from aerpaw_cmp.site.site import Site, Tower
from aerpaw_cmp.site.siteyaml import load_site

FRAME = SiteFrame(35.7275, -78.696)


def asc(path: Path, height: np.ndarray, west: float, south: float, cell: float, corner: bool = True) -> Path:
    """Write an elevation file. The rows of ``height`` begin in the south, and those of the file in the north."""
    word, shift = ("corner", 0.0) if corner else ("center", cell / 2)
    head = f"ncols {height.shape[1]}\nnrows {height.shape[0]}\nxll{word} {west + shift:.12g}\nyll{word} {south + shift:.12g}\n"
    body = "\n".join(" ".join(f"{v:.9g}" for v in row) for row in np.where(np.isnan(height), -9999, height)[::-1])
    path.write_text(head + f"cellsize {cell:.12g}\nNODATA_value -9999\n{body}\n")
    return path


def plane(west: float, south: float, cell: float, shape: tuple[int, int]) -> np.ndarray:
    y, x = np.meshgrid(
        south + (np.arange(shape[0]) + 0.5) * cell, west + (np.arange(shape[1]) + 0.5) * cell, indexing="ij"
    )
    return 80 + 0.03 * x - 0.02 * y


@pytest.mark.parametrize("corner", [True, False])
def test_plane_in_site_metres(tmp_path: Path, corner: bool) -> None:
    path = asc(tmp_path / "d.asc", plane(-500, -300, 10, (60, 100)), -500, -300, 10, corner)
    dem = read_dem(path, FRAME, crs="local")
    east, north = np.random.default_rng(1).uniform(-290, 290, (2, 500))
    np.testing.assert_allclose(dem.ground_m(east, north), 0.03 * east - 0.02 * north, atol=1e-6)
    assert float(dem.absolute_m(0, 0)) == pytest.approx(80)
    assert np.isnan(dem.ground_m(600.0, 0.0))


@pytest.mark.parametrize("crs", ["EPSG:4326", "EPSG:32617"])
def test_plane_in_other_systems(tmp_path: Path, crs: str) -> None:
    from pyproj import Transformer

    x0, y0 = Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(-78.696, 35.7275)
    cell = 1e-4 if crs == "EPSG:4326" else 10.0
    west, south = x0 - 30 * cell, y0 - 30 * cell
    rows, columns = np.meshgrid(np.arange(60), np.arange(60), indexing="ij")
    latitude_like = rows * 1.0 + 0 * columns
    dem = read_dem(asc(tmp_path / "d.asc", latitude_like, west, south, cell), FRAME, crs=crs)
    north_per_row = 11.09 if crs == "EPSG:4326" else 10.0
    assert float(dem.ground_m(0.0, 100.0)) == pytest.approx(100 / north_per_row, rel=5e-3)
    assert abs(float(dem.ground_m(100.0, 0.0))) < (0.01 if crs == "EPSG:4326" else 0.6)  # grid north is not true north


def ridge(height_m: float) -> Dem:
    dem = np.where(np.arange(201) == 100, height_m, 0.0) * np.ones((101, 1))
    # a crest along east = 0, 10 m cells
    return Dem(dem, -1000.0, -500.0, 10.0, 10.0, "local", FRAME)


def test_ridge_blocks_what_passes_below_it() -> None:
    dem = ridge(30.0)
    top = 30.0  # heights count from the origin, which lies on the crest
    source = np.tile([-400.0, 0, 10 - top], (3, 1))
    target = np.array([[400.0, 0, 49 - top], [400, 0, 51.1 - top], [-100, 0, 11 - top]])
    assert dem.clear(source, target).tolist() == [False, True, True]  # 29.5 m, 30.55 m over the crest; this side of it
    assert dem.clear(target, source).tolist() == [False, True, True]
    assert dem.clear(source[1:2], target[1:2], tolerance_m=-1.0).tolist() == [False]


def test_earth_bulge_is_counted() -> None:
    flat = Dem(np.zeros((3, 2001)), -10_000.0, -10.0, 10.0, 10.0, "local", FRAME)
    bulge = 20_000.0**2 / (8 * EARTH_RADIUS_M)
    up = np.array([0.0, 0.0, bulge])
    source, target = np.array([[-9_995.0, 0, 0]]), np.array([[9_995.0, 0, 0]])
    assert not flat.clear(source + 0.95 * up, target + 0.95 * up)[0]
    assert flat.clear(source + 1.05 * up, target + 1.05 * up)[0]


def test_batches_agree_with_single_links(monkeypatch: pytest.MonkeyPatch) -> None:
    dem = ridge(12.0)
    random = np.random.default_rng(2)
    source = np.column_stack([random.uniform(-900, 900, (200, 2)) * [1, 0.5], random.uniform(-11, 5, 200)])
    target = np.column_stack([random.uniform(-900, 900, (200, 2)) * [1, 0.5], random.uniform(-11, 5, 200)])
    together = dem.clear(source, target)
    assert 20 < together.sum() < 180
    monkeypatch.setattr("aerpaw_cmp.site.relief._SAMPLES_AT_ONCE", 1)
    np.testing.assert_array_equal(dem.clear(source, target), together)


SITE = """\
name: test
origin: {latitude_deg: 35.7275, longitude_deg: -78.696}
towers:
  T: {latitude_deg: 35.7284, longitude_deg: -78.696}
dem: {path: d.asc, crs: local}
buildings: [{name: b, height_m: 5, polygon_m: [[100, 0], [120, 0], [120, 20], [100, 20]]}]
trees: {single: [{at_m: [-200, 50]}]}
"""


def test_site_stands_on_its_ground(tmp_path: Path) -> None:
    asc(tmp_path / "d.asc", plane(-500, -300, 10, (60, 100)), -500, -300, 10)
    (tmp_path / "site.yaml").write_text(SITE)
    site = load_site(tmp_path / "site.yaml")
    tower = site.towers["T"]
    assert tower.ground_m == pytest.approx(-0.02 * tower.north_m, abs=1e-6)
    assert site.buildings[0].base_m == pytest.approx(0.03 * 110 - 0.02 * 10, abs=1e-6)
    assert site.trees.ground_m[0] == pytest.approx(-6 - 1, abs=1e-6)
    assert site.dem is not None
    assert load_site(tmp_path / "site.yaml", tower_ground="flat").towers["T"].ground_m == 0


@pytest.mark.parametrize(
    ("origin_m", "tower_m", "contradicted"),
    [(80.0, 78.0, []), (82.0, 76.0, []), (47.0, 45.0, ["origin.ground"]), (80.0, 90.0, ["the ground of tower T"])],
)
def test_grounds_that_the_elevation_model_contradicts_are_told(
    tmp_path: Path, origin_m: float, tower_m: float, contradicted: list[str]
) -> None:
    """The plane is 80 m at the origin and 78 m at the tower."""
    asc(tmp_path / "d.asc", plane(-500, -300, 10, (60, 100)), -500, -300, 10)
    origin = f", ground: {{height_m: {origin_m}, reference: orthometric}}}}\n"
    text = SITE.replace("longitude_deg: -78.696}\ntowers", f"longitude_deg: -78.696{origin}towers")
    offset = f", ground_offset_m: {tower_m - origin_m}}}\n"
    (tmp_path / "site.yaml").write_text(text.replace("-78.696}\ndem", f"-78.696{offset}dem"))
    cautions = load_site(tmp_path / "site.yaml").cautions()
    assert [text.split(" is stated")[0] for text in cautions] == contradicted


@pytest.mark.parametrize(("value", "size"), [(0.0, 1), (0.0, 6), (5.0, 6)])
def test_gaps_filled_with_a_number_are_a_caution_of_the_tower_on_them(tmp_path: Path, value: float, size: int) -> None:
    """A tower on a hole of constant height is 100 m below the origin. A lake or a level field is not such a hole."""
    ground = 110.0 + plane(-500, -500, 10, (101, 101)) / 100.0
    ground[20 : 20 + size, 70 : 70 + size] = value
    ground[40:60, 10:30] = ground[40, 9] - 1.0
    grid = Dem(height_m=ground, west=-500.0, south=-500.0, step_x=10.0, step_y=10.0, crs="local", frame=FRAME)
    places = {"hole": (202.0, -298.0), "lake": (-300.0, 0.0), "field": (0.0, 300.0)}
    towers = {
        name: Tower(name=name, latitude_deg=0.0, longitude_deg=0.0, east_m=east, north_m=north)
        for name, (east, north) in places.items()
    }
    site = Site("s", grid.frame, towers, dem=grid)
    (text,) = site.cautions()
    assert f"the elevation model is {value:g} m at tower hole" in text
    assert site.cautions(["lake", "field"]) == []


def test_bad_grids(tmp_path: Path) -> None:
    path = asc(tmp_path / "d.asc", plane(-500, -300, 10, (60, 100)), -500, -300, 10)
    text = path.read_text()
    with pytest.raises(UsageError, match="names no coordinate system"):
        read_dem(path, FRAME)
    with pytest.raises(UsageError, match="unknown crs 'EPSG:nonsense'"):
        read_dem(path, FRAME, crs="EPSG:nonsense")
    with pytest.raises(InputError, match="they are metres or feet"):
        read_dem(path, FRAME, crs="EPSG:4326")
    with pytest.raises(InputError, match="no height at the site's origin"):
        read_dem(path, FRAME, crs="EPSG:32617")
    path.write_text(text[: len(text) // 2])
    with pytest.raises(
        InputError, match=r"cells; expected 60 x 100. Likely cause: the file was cut off|expected 60 x 100"
    ):
        read_dem(path, FRAME, crs="local")
    path.write_text(text.replace("ncols", "columns"))
    with pytest.raises(InputError, match="not an ESRI ASCII grid"):
        read_dem(path, FRAME, crs="local")
    path.write_text(text.replace("-9999\n", "-9999\nx", 1))
    with pytest.raises(InputError, match=r"line \d+"):
        read_dem(path, FRAME, crs="local")
    with pytest.raises(InputError, match="cannot be read"):
        read_dem(tmp_path / "absent.asc", FRAME, crs="local")
    path.write_bytes(b"II*\x00" + b"0" * 100)
    with pytest.raises((UsageError, InputError), match=r"needs rasterio|not a GeoTIFF"):
        read_dem(path, FRAME)


@pytest.mark.filterwarnings("ignore::PendingDeprecationWarning")  # rasterio's own
@pytest.mark.filterwarnings("ignore:Dataset has no geotransform")
def test_geotiff_equals_the_ascii_grid(tmp_path: Path) -> None:
    rasterio = pytest.importorskip("rasterio", reason="rasterio comes with the extra aerpaw-cmp[geo]")
    from pyproj import Transformer

    x0, y0 = Transformer.from_crs("EPSG:4326", "EPSG:32617", always_xy=True).transform(-78.696, 35.7275)
    west, south, cell = x0 - 300, y0 - 250, 10.0
    height = np.random.default_rng(3).uniform(60, 90, (50, 60))
    height[0, 0] = np.nan
    path = tmp_path / "d.tif"
    profile = {"driver": "GTiff", "width": 60, "height": 50, "count": 1, "dtype": "float64", "nodata": -9999.0}
    place = rasterio.transform.from_origin(west, south + 50 * cell, cell, cell)
    with rasterio.open(path, "w", crs="EPSG:32617", transform=place, **profile) as image:
        image.write(np.where(np.isnan(height), -9999.0, height)[::-1], 1)
    text = read_dem(asc(tmp_path / "d.asc", height, west, south, cell), FRAME, crs="EPSG:32617")
    tiff = read_dem(path, FRAME)
    east, north = np.random.default_rng(4).uniform(-350, 350, (2, 400))
    np.testing.assert_allclose(tiff.absolute_m(east, north), text.absolute_m(east, north), atol=1e-6)
    assert np.isfinite(tiff.absolute_m(east, north)).sum() > 100
    with rasterio.open(path, "w", **profile) as image:
        image.write(height, 1)
    with pytest.raises(InputError, match="not georeferenced"):
        read_dem(path, FRAME)


def test_imported_site_keeps_its_elevation_model(tmp_path: Path) -> None:
    from aerpaw_cmp.site.footprints import import_site, site_yaml

    (tmp_path / "base").mkdir()
    asc(tmp_path / "base" / "d.asc", plane(-500, -300, 10, (60, 100)), -500, -300, 10)
    (tmp_path / "base" / "site.yaml").write_text(SITE)
    tree = tmp_path / "tree.osm"
    tree.write_text('<osm><node id="1" lat="35.728" lon="-78.6962"><tag k="natural" v="tree"/></node></osm>')
    model, _ = import_site([tree], base=tmp_path / "base" / "site.yaml")
    (tmp_path / "new.yaml").write_text(site_yaml(model), encoding="utf-8")
    site = load_site(tmp_path / "new.yaml")
    assert site.trees.ground_m[0] == pytest.approx(0.03 * site.trees.east_m[0] - 0.02 * site.trees.north_m[0], abs=1e-6)


HEAD = "ncols 3\nnrows 3\nxllcorner -150\nyllcorner -150\ncellsize 100\nNODATA_value -9999\n"
CELLS = "1 2 3\n4 5 6\n7 8 9\n"


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        (HEAD.replace("-9999", "-32768") + CELLS.replace("9", "-9999"), 9, "a gap that the file's NODATA value does not declare"),
        (HEAD + CELLS.replace("9", "33000"), 9, "feet or centimetres"),
        (HEAD + CELLS.replace("5", "-9999"), None, "its cells there are gaps"),
        (HEAD + CELLS + "1\n", 10, "nrows or ncols is wrong"),
        (HEAD + CELLS[:-3], 9, "the file was cut off"),
        (HEAD + CELLS.replace("5", "5,5"), 8, "decimal commas"),
        (HEAD.replace("ncols 3", "ncols nan") + CELLS, None, "ncols is nan; expected a whole number"),
        (HEAD.replace("ncols 3", "ncols 2.5") + CELLS, None, "ncols is 2.5; expected a whole number"),
        (HEAD.replace("cellsize 100", "cellsize 0") + CELLS, None, "cellsize is 0"),
    ],
)  # fmt: skip
def test_damaged_grids_name_the_line(tmp_path: Path, text: str, line: int | None, words: str) -> None:
    path, frame = tmp_path / "d.asc", SiteFrame(35.7275, -78.696)
    path.write_bytes(b"\xef\xbb\xbf" + (HEAD + CELLS).encode())
    assert float(read_dem(path, frame, crs="local").absolute_m(0, 0)) == 5, "with a byte-order mark"
    path.write_text(text)
    with pytest.raises(InputError, match=words) as error:
        read_dem(path, frame, crs="local")
    assert error.value.line == line


def test_pictures_and_feet_are_no_elevation_model(tmp_path: Path) -> None:
    rasterio = pytest.importorskip("rasterio")
    frame = SiteFrame(35.7275, -78.696)
    transform = rasterio.Affine(0.002, 0, -78.699, 0, -0.002, 35.7305)
    heights = np.arange(9, dtype=np.float32).reshape(3, 3)

    def write(name: str, bands: int, unit: str = "") -> Path:
        options = {"driver": "GTiff", "width": 3, "height": 3, "dtype": "float32", "crs": "EPSG:4326"}
        with rasterio.open(tmp_path / name, "w", count=bands, transform=transform, **options) as image:
            for band in range(bands):
                image.write(heights, band + 1)
            if unit:
                image.set_band_unit(1, unit)
        return tmp_path / name

    assert float(read_dem(write("m.tif", 1, "metre"), frame).absolute_m(0, 0)) == pytest.approx(4)
    with pytest.raises(InputError, match="3 bands; expected one band of heights"):
        read_dem(write("rgb.tif", 3), frame)
    with pytest.raises(InputError, match="heights in 'us survey foot'; expected metres"):
        read_dem(write("ft.tif", 1, "US survey foot"), frame)
    cut = tmp_path / "cut.tif"
    cut.write_bytes((tmp_path / "m.tif").read_bytes()[:300])
    with pytest.raises(InputError, match=r"cut\.tif"):
        read_dem(cut, frame)
