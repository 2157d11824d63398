"""Files are read back with the programs that others use."""

import io
import zipfile
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pandas as pd
import pytest
from matplotlib.colors import to_rgb
from matplotlib.image import imread

from aerpaw_cmp.common.geodesy import SiteFrame
from aerpaw_cmp.maps import export
from aerpaw_cmp.maps.grid import RANK_CLASSES, Grid, Layer, voronoi_borders

FRAME = SiteFrame(35.7275, -78.6960)
GRID = Grid.over_area((-90.0, 90.0, -60.0, 60.0))
RSS = np.linspace(-120.0, -40.0, len(GRID)).round(2)
RSS[3] = np.nan
RANK = np.arange(len(GRID)) % 5


def layer(values, quantity, **more):
    return Layer(values=GRID.raster(np.asarray(values, dtype=float)), quantity=quantity, **{"unit": "dB", **more})


JOINT = {"tower": "joint", "height_m": 30.0}
LAYERS = [
    layer(np.where(RANK > 0, RANK, np.nan), "Rank", name="rank_k10", k=10.0, classes=RANK_CLASSES, **JOINT),
    layer(RSS, "RSS < 30 m & more", name="rss", unit="dBm", **JOINT),
]
TOWERS = {"LW1": [-50.0, 0.0, 10.0], "LW<2>": [50.0, 10.0, 10.0]}
BORDERS = voronoi_borders(list(TOWERS.values()), (-90.0, 90.0, -60.0, 60.0))


def over(grid, layers, **more):
    return export.MapLayers(grid=grid, frame=FRAME, layers=layers, **more)


BARE, MAPS = over(GRID, LAYERS), over(GRID, LAYERS, towers_m=TOWERS, borders=BORDERS)


def test_csv_keeps_order_and_gaps(tmp_path):
    levels = "rss_h030m_joint"  # as text first: pandas 2 reads to the last digit but one
    table = pd.read_csv(export.write_csv(tmp_path / "m.csv", BARE), dtype={levels: str})
    places = ["index", "row", "column", "east_m", "north_m", "latitude_deg", "longitude_deg"]
    assert table.columns.tolist() == [*places, "rank_k10_h030m_joint", levels]
    assert table["index"].tolist() == list(range(1, len(GRID) + 1))
    np.testing.assert_array_equal(GRID.east_m[table["column"]], table["east_m"])
    np.testing.assert_array_equal(GRID.north_m[table["row"]], table["north_m"])
    np.testing.assert_array_equal(table[["east_m", "north_m"]], GRID.points_m)
    np.testing.assert_array_equal(table[levels].astype(float), RSS)
    np.testing.assert_array_equal(table["rank_k10_h030m_joint"], RANK)
    east, north = FRAME.to_local(table["latitude_deg"], table["longitude_deg"])
    np.testing.assert_allclose(np.column_stack([east, north]), GRID.points_m, atol=2e-4)


def test_kmz_has_a_map_and_a_legend_per_layer(tmp_path):
    path = export.write_kmz(tmp_path / "m.kmz", MAPS)
    with zipfile.ZipFile(path) as archive:
        names = archive.namelist()
        tree = ElementTree.fromstring(archive.read("doc.kml"))
        picture = imread(io.BytesIO(archive.read("maps/rank_k10_h030m_joint.png")))
        legend = imread(io.BytesIO(archive.read("legends/rss_h030m_joint.png")))
    assert names[0] == "doc.kml", "Google Earth opens the first KML"
    kml = "{http://www.opengis.net/kml/2.2}"
    hrefs = [node.text for node in tree.iter(f"{kml}href")]
    assert sorted(hrefs) == sorted(names[1:])
    assert [node.find(f"{kml}visibility").text for node in tree.iter(f"{kml}GroundOverlay")] == ["1", "0"]
    assert {node.text for node in tree.iter(f"{kml}name")} >= {"LW1", "LW<2>", "RSS < 30 m & more, nearest tower, 30 m"}
    # the picture begins in the north-west: position of the last row, first column
    size = export.PIXELS_PER_CELL
    assert picture.shape[:2] == (GRID.shape[0] * size, GRID.shape[1] * size)
    scale = export.scale_of(LAYERS[0])
    for row, number in ((size // 2, (GRID.shape[0] - 1) * GRID.shape[1]), (-size // 2, 0)):
        expected = to_rgb(scale.colours[scale.bin_of(RANK[number])])
        np.testing.assert_allclose(picture[row, size // 2, :3], expected, atol=1 / 250)
    assert legend[..., :3].std() > 0.05, "an empty legend"


def test_kml_box_fits_the_site_at_full_size():
    grid = Grid.over_area((-540.0, 540.0, -1065.0, 1065.0))
    north, south, east, west = export._bounding_box(over(grid, []))
    corner_east, corner_north = FRAME.to_local([north, north, south, south], [west, east, west, east])
    assert np.abs(np.abs(corner_east) - 540.0).max() < 0.3
    assert np.abs(np.abs(corner_north) - 1065.0).max() < 0.3


def test_same_map_same_bytes(tmp_path):
    first = export.write_kmz(tmp_path / "a.kmz", BARE).read_bytes()
    assert first == export.write_kmz(tmp_path / "b.kmz", BARE).read_bytes()


def test_out_of_coverage_is_its_own_colour():
    ranks, levels = map(export.scale_of, LAYERS)
    assert levels.colours[-1] == ranks.colours[-1], "out of coverage is the same grey in all layers"
    assert levels.colours.count(levels.colours[-1]) == 1
    assert levels.bin_of([np.nan, -np.inf, np.inf]).tolist() == [export.LEVELS, 0, export.LEVELS - 1]
    assert ranks.bin_of([0, 1, 4, np.nan]).tolist() == [4, 0, 3, 4]
    servers = export.class_scale("serving", "Serving", ("LW1", "LW2"))
    assert servers.bin_of([0, 1]).tolist() == [0, 1], "the first tower is not a gap"


def test_constant_and_empty_layers_can_be_drawn(tmp_path):
    odd = [
        layer(np.full(len(GRID), value), name, name=name) for name, value in (("a", 3.0), ("b", np.nan), ("c", np.inf))
    ]
    assert export.write_kmz(tmp_path / "m.kmz", over(GRID, odd)).stat().st_size > 0


def test_what_is_made_of_a_map_credits_it(tmp_path):
    credit = "© OpenStreetMap contributors, ODbL"
    credited = replace(BARE, credit=credit)
    with zipfile.ZipFile(export.write_kmz(tmp_path / "m.kmz", credited)) as archive:
        assert f"<description>{credit}</description>" in archive.read("doc.kml").decode()


def test_wrong_layers_are_a_bug():
    with pytest.raises(ValueError, match="same name"):
        over(GRID, [LAYERS[0], LAYERS[0]])
    with pytest.raises(ValueError, match="shape"):
        over(GRID, [Layer(name="a", values=np.zeros((3, 1)), unit="1", quantity="a")])


def test_colours_span_the_middle_96_percent_in_round_steps():
    scale = export.number_scale("level", "Level", np.array([*np.linspace(0.0, 50.0, 99), 900.0, np.inf, np.nan]))
    np.testing.assert_allclose(scale.edges, np.arange(5.0, 50.0, 5.0))
    assert scale.labels[0] == "below 5"
    assert scale.labels[-3:] == ("40 to 45", "above 45", "out of coverage")
    residual = export.number_scale("residual", "Residual", np.linspace(-3.0, 9.0, 50), "RdBu_r", centred=True)
    np.testing.assert_allclose(residual.edges, np.arange(-8.0, 9.0, 2.0))
