"""Maps of public bug reports, and their cousins: heights of buildings with values known from the formats' own words."""

import json
from pathlib import Path

import pytest

from aerpaw_cmp.site.footprints import Footprints, import_footprints, import_site, site_yaml
from aerpaw_cmp.site.siteyaml import build_site
from tests.geojson import collection, feature, polygon
from tests.site.osm import FRAME, Osm, lonlat, square

REPORTED = Path(__file__).parents[1] / "reported"


def heights(content: Footprints) -> list[float]:
    return sorted(building.height_m for building in content.buildings)


def village(path: Path, *tags: dict[str, object]) -> Footprints:
    """Return adjacent buildings with these properties."""
    shapes = [feature(polygon(lonlat(square(40.0 * n, 0))), **given) for n, given in enumerate(tags)]
    path.write_text(json.dumps(collection(*shapes)))
    return import_footprints([path], FRAME)


def osm(path: Path, *ways: tuple[tuple[float, float, float], dict[str, str]]) -> Footprints:
    """Squares (east, north, size) with tags as OSM XML."""
    content = Osm()
    for corner_and_size, tags in ways:
        content.way(lonlat(square(*corner_and_size)), **tags)
    path.write_text(content.xml())
    return import_footprints([path], FRAME)


def test_a_part_without_height_is_as_high_as_its_building() -> None:
    content = import_footprints([REPORTED / "osm_part_no_height/part.osm"], FRAME)
    assert {b.name: b.height_m for b in content.buildings} == {"way 10": 12.5, "way 15": 8.0}
    assert not content.assumed


def test_podium_and_tower(tmp_path: Path) -> None:
    content = osm(
        tmp_path / "a.osm",
        ((0, 0, 40), {"building": "yes", "height": "60"}),
        ((0, 0, 40), {"building:part": "yes", "building:levels": "3"}),
        ((10, 10, 20), {"building:part": "yes", "min_height": "9", "height": "60"}),
    )
    assert heights(content) == [9.0, 60.0]
    assert sorted(b.footprint.area for b in content.buildings) == pytest.approx([400.0, 1200.0], rel=1e-3)


def test_a_part_of_a_building_by_levels(tmp_path: Path) -> None:
    content = osm(
        tmp_path / "a.osm",
        ((0, 0, 40), {"building": "yes", "building:levels": "4"}),
        ((0, 0, 20), {"building:part": "yes"}),
    )
    assert heights(content) == [12.0, 12.0]


@pytest.mark.parametrize(
    "tags",
    [
        {"location": "underground", "layer": "-1", "height": "5"},
        {"building:levels": "0", "building:levels:underground": "3"},
        {"amenity": "parking", "parking": "underground"},
        {"layer": "-1", "height": "5"},
        {"tunnel": "yes"},
    ],
)
def test_what_lies_below_the_ground_is_not_drawn(tmp_path: Path, tags: dict[str, str]) -> None:
    content = osm(
        tmp_path / "a.osm", ((0, 0, 20), {"building": "yes"} | tags), ((50, 0, 20), {"building": "yes", "height": "7"})
    )
    assert heights(content) == [7.0]
    assert any("1 building below the ground" in text for text in content.actions)


def test_a_building_with_cellars_stands(tmp_path: Path) -> None:
    """Cellars do not count as levels, and neither does the height of the roof alone."""
    tags = {"building": "yes", "building:levels": "2", "building:levels:underground": "1", "roof:height": "4"}
    assert heights(osm(tmp_path / "a.osm", ((0, 0, 20), tags))) == [6.0]


def kml(path: Path, mode: str, points: str, data: str = "") -> Footprints:
    ring = lonlat(square(0, 0))
    coordinates = " ".join(points.format(*point) for point in ring)
    path.write_text(
        '<kml xmlns="http://www.opengis.net/kml/2.2"><Placemark><ExtendedData><Data name="building"><value>yes</value>'
        f"</Data>{data}</ExtendedData><Polygon><extrude>1</extrude><altitudeMode>{mode}</altitudeMode><outerBoundaryIs>"
        f"<LinearRing><coordinates>{coordinates}</coordinates></LinearRing></outerBoundaryIs></Polygon></Placemark></kml>"
    )
    return import_footprints([path], FRAME)


def test_an_extruded_polygon_is_as_high_as_it_is_drawn(tmp_path: Path) -> None:
    assert heights(import_footprints([REPORTED / "kml_extruded/extruded.kml"], FRAME)) == [12.0]
    assert heights(kml(tmp_path / "a.kml", "relativeToGround", "{}, {}, 9.5")) == [9.5]
    named = '<Data name="height"><value>4</value></Data>'
    assert heights(kml(tmp_path / "a.kml", "relativeToGround", "{},{},9.5", named)) == [4.0]
    assert heights(kml(tmp_path / "a.kml", "clampToGround", "{},{},0")) == [6.0]


def test_a_solid_without_a_tag_is_said_to_be_no_building(tmp_path: Path) -> None:
    kml(tmp_path / "a.kml", "relativeToGround", "{},{},9.5")
    bare = (tmp_path / "a.kml").read_text().replace("building", "colour")
    (tmp_path / "a.kml").write_text(bare)
    content = import_footprints([tmp_path / "a.kml"], FRAME)
    assert len(content.geofences) == 1
    assert any("9.5 m high without a tag: used as a geofence" in text for text in content.actions)
    assert heights(import_footprints([tmp_path / "a.kml"], FRAME, untagged="building")) == [9.5]


def test_heights_above_sea_level_are_not_taken_for_heights_of_buildings(tmp_path: Path) -> None:
    content = kml(tmp_path / "a.kml", "absolute", "{},{},112")
    assert heights(content) == [6.0]
    assert "height assumed: none in the map for 1 of 1 building" in content.assumed


@pytest.mark.parametrize(
    ("name", "value", "height_m"),
    [
        ("HEIGHT", 10, 10.0),
        ("HEIGHT_FT", 40, 12.192),
        ("Height (ft)", "40", 12.192),
        ("bldg_height_feet", 40.0, 12.192),
        ("heightft", 40, 12.192),
        ("BLDGHEIGHT", "40 ft", 12.192),
        ("building_height_m", "12,5", 12.5),
        ("Hgt_cm", 1250, 12.5),
        ("ROOF_HEIGHT [m]", 9, 9.0),
        ("num_floors", 3, 9.0),
        ("STORIES", 2, 6.0),
    ],
)
def test_heights_by_any_name_in_any_unit(tmp_path: Path, name: str, value: object, height_m: float) -> None:
    content = village(tmp_path / "a.geojson", {"building": "yes", name: value})
    assert heights(content) == [pytest.approx(height_m, abs=0.01)]
    assert not content.assumed


@pytest.mark.parametrize(
    "name", ["min_height", "ground_height", "base_hgt_m", "height_source", "tree_height", "roof:shape"]
)
def test_other_heights_are_none_of_the_building(tmp_path: Path, name: str) -> None:
    content = village(tmp_path / "a.geojson", {"building": "yes", name: 40})
    assert heights(content) == [6.0]


def test_assumed_heights_are_counted_once_in_print_file_and_notes(tmp_path: Path) -> None:
    source = tmp_path / "a.geojson"
    content = village(
        source, {"building": "yes"}, {"building": "yes", "height": "-1"}, {"building": "yes", "height": 8}
    )
    line = content.assumed
    assert line.startswith("height assumed: none in the map for 2 of 3 buildings, 6 m each")
    assert content.actions.count(line) == 1
    model, actions = import_site([source], base=REPORTED / "kml_extruded/base.yaml")
    assert actions.count(line) == 1
    assert sum(line in note for note in build_site(model).notes) == 1
    assert line in site_yaml(model, header=actions)
