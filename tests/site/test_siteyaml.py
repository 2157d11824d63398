"""The packaged site, the loader's refusals, and heights that do not mix."""

import itertools
import math
from pathlib import Path

import numpy as np
import pytest
from pyproj import Geod
from shapely.geometry import Point

from aerpaw_cmp.common.errors import InputError, UsageError
from aerpaw_cmp.common.yamlfile import parse_yaml
from aerpaw_cmp.site.siteyaml import MAST_CLEARANCE_M, SceneModel, SiteModel, build_site, load_site

MINIMAL = """\
name: test
origin: {latitude_deg: 35.7275, longitude_deg: -78.696}
towers:
  T: {latitude_deg: 35.7275, longitude_deg: -78.696}
"""


def site_file(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "site.yaml"
    path.write_text(text)
    return path


def test_lake_wheeler_towers_are_where_the_sources_say() -> None:
    site = load_site("lake_wheeler")
    assert list(site.towers) == ["LW1", "LW2", "LW3", "LW4", "LW5"]
    pairs = itertools.combinations(site.towers.values(), 2)
    geodesic = [454, 466, 893, 666, 598, 1088, 1745, 1639, 2119, 1089]  # of source A, by pair
    distances = {(a.name, b.name): math.hypot(a.east_m - b.east_m, a.north_m - b.north_m) for a, b in pairs}
    assert sorted(round(v) for v in distances.values()) == pytest.approx(sorted(geodesic), abs=1)
    assert [round(t.position_m[2], 6) for t in site.towers.values()] == [10.0] * 5


def test_sources_differ_by_what_the_site_says() -> None:
    a, b = load_site("lake_wheeler"), load_site("lake_wheeler", coordinates="B")
    for name, stated in zip(a.towers, (6.6, 2.0, 2.6, 2.7, 2.5), strict=True):
        of_a, of_b = a.towers[name], b.towers[name]
        apart = Geod(ellps="WGS84").inv(of_a.longitude_deg, of_a.latitude_deg, of_b.longitude_deg, of_b.latitude_deg)[2]
        assert apart == pytest.approx(stated, abs=0.06)
        assert f"{name}: the positions in sources A (used) and B differ by {apart:.1f} m" in a.notes
        assert f"{name}: the positions in sources B (used) and A differ by {apart:.1f} m" in b.notes
    with pytest.raises(UsageError, match="no position 'C'; expected one of A, B"):
        load_site("lake_wheeler", coordinates="C")


def test_lake_wheeler_area_is_the_papers() -> None:
    site = load_site("lake_wheeler")
    west, east, south, north = site.area_m
    assert (east - west, north - south) == (1080, 2130)
    assert all(west < t.east_m < east and south < t.north_m < north for t in site.towers.values())
    assert site.ground_material == "medium_dry_ground"
    assert {b.material for b in site.buildings} == {"concrete"}


def test_the_packaged_map_is_openstreetmaps_and_says_so() -> None:
    site = load_site("lake_wheeler")
    assert site.credit == "(c) OpenStreetMap contributors, ODbL"
    assert any(site.credit in note and "assumed" in note for note in site.notes)
    assert [b.source[:8] for b in site.buildings].count("OSM way ") == 21
    assert [b.height_m for b in site.buildings if "LiDAR" in b.source] == [6.8, 5.5, 4.2, 6.7, 5.8, 5.5]
    assert sum(f.area.area for f in site.forests) / 1e4 == pytest.approx(91.6, abs=0.1)  # of the extract, in hectares
    assert any("no map here" in note and "LW5" in note for note in site.notes)
    # the map has no building there, not even the barn north-west of LW1
    at_lw1 = [b for b in site.buildings if b.footprint.distance(Point(0, 0)) < 150]
    assert len(at_lw1) >= 6
    assert not [b for b in at_lw1 if b.footprint.centroid.x < 0 < b.footprint.centroid.y]


def test_woods_are_media_and_only_opaque_foliage_sees_their_trees() -> None:
    site = load_site("lake_wheeler")
    assert {f.height_m for f in site.forests} == {20.0}
    assert len(site.trees) == 0
    assert site.under("attenuating") is site
    opaque = site.under("opaque")
    assert {f.height_m for f in opaque.forests} == {None}
    assert len(opaque.trees) == pytest.approx(9160, rel=0.01)  # 100 per hectare


def test_a_wood_may_be_trees_or_a_medium_alone(tmp_path: Path) -> None:
    wood = "forests:\n- {name: w, polygon_m: [[50, 0], [150, 0], [150, 100], [50, 100]]%s}"
    trees = load_site(site_file(tmp_path, MINIMAL + wood % ""))
    assert len(trees.trees) == 100
    assert trees.under("opaque") is trees
    medium = load_site(site_file(tmp_path, MINIMAL + wood % ", height_m: 15"))
    assert len(medium.under("opaque").trees) == 0
    assert medium.under("opaque").forests[0].height_m == 15.0


def test_ground_is_flat_unless_offsets_are_asked_for() -> None:
    flat, lifted = load_site("lake_wheeler"), load_site("lake_wheeler", tower_ground="offsets")
    assert [t.ground_m for t in flat.towers.values()] == [0.0] * 5
    assert [t.ground_m for t in lifted.towers.values()] == [0.0, -4.45, -10.23, 6.53, 15.03]
    assert lifted.towers["LW5"].position_m[2] == pytest.approx(25.03)
    at = np.array([tower.position_m[:2] for tower in lifted.towers.values()]).T  # near LW1 no flight descends to LW3's
    assert list(lifted.ground_under_m(*at)) == [0.0, -4.45, -10.23, 0.0, 0.0]


def test_trees_stand_in_forests_and_clear_of_masts() -> None:
    import shapely

    site = load_site("lake_wheeler")
    trees = site.opaque_trees
    woods = shapely.union_all([f.area for f in site.forests])
    assert shapely.contains_xy(woods, trees.east_m, trees.north_m).all()
    for tower in site.towers.values():
        away = np.hypot(trees.east_m - tower.east_m, trees.north_m - tower.north_m)
        assert away.min() >= MAST_CLEARANCE_M * 0.98  # the buffer is a polygon
    again = load_site("lake_wheeler")
    np.testing.assert_array_equal(again.opaque_trees.east_m, trees.east_m)


def test_an_antenna_inside_a_building_is_a_caution(tmp_path: Path) -> None:
    hall = "buildings:\n- {name: hall, height_m: %g, polygon_m: [[-9, -9], [9, -9], [9, 9], [-9, 9]]}"
    (text,) = load_site(site_file(tmp_path, MINIMAL + hall % 12)).cautions()
    assert "inside building 'hall' (roof at 12.0 m)" in text
    assert not load_site(site_file(tmp_path, MINIMAL + hall % 9)).cautions(), "on the roof"


def test_no_such_site(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"no site 'lake_weeler'.*did you mean 'lake_wheeler'"):
        load_site("lake_weeler")
    with pytest.raises(InputError, match="no such file"):
        load_site(tmp_path / "absent.yaml")


def test_the_documented_site_is_valid() -> None:
    text = (Path(__file__).parents[2] / "docs" / "site.md").read_text(encoding="utf-8")
    model = parse_yaml(text.split("```yaml\n")[1].split("```")[0], SiteModel)
    assert model.dem is not None
    # the page shows every key; a scene is no companion of an elevation model and has a block of its own
    assert set(type(model).model_fields) == model.model_fields_set | {"scene"}
    scene = parse_yaml(text.split("```yaml\nscene:\n")[1].split("```")[0].replace("\n  ", "\n").strip(), SceneModel)
    assert set(SceneModel.model_fields) == scene.model_fields_set
    site = build_site(model)
    assert site.towers["LW2"].position_m[2] == pytest.approx(10.0)
    assert len(site.trees) > 10
    packaged = (Path(__file__).parents[2] / "aerpaw_cmp/site/data/lake_wheeler.yaml").read_text()
    added = text.split("```yaml\ntowers:\n")[1].split("```")[0]
    assert "NEW" in parse_yaml(packaged.replace("\ntowers:\n", f"\ntowers:\n{added}"), SiteModel).towers


def test_the_documented_differences_are_the_computed_ones() -> None:
    text = (Path(__file__).parents[2] / "docs" / "site.md").read_text(encoding="utf-8")
    notes = [note for note in load_site("lake_wheeler").notes if "the positions in sources" in note]
    assert len(notes) == 5
    for note in notes:
        tower, metres = note[:3], note.split(" differ by ")[1]
        row = next(line for line in text.splitlines() if line.startswith(f"| {tower} "))
        assert f"| {metres} |" in row


BASE = """name: test
origin: {latitude_deg: 35.7275, longitude_deg: -78.696, ground: {height_m: 79, reference: ellipsoidal}}
towers:
  T: {latitude_deg: 35.7275, longitude_deg: -78.696}
"""
SQUARE = "[[0, 0], [10, 0], [10, 10], [0, 10]]"


@pytest.mark.parametrize(
    ("more", "line", "words"),
    [
        ("forests:\n  - name: w\n    polygon_deg: [[-78.697, 35.728], [-78.697, 35.7281], [-78.6969, 35.7281]]", 7, "swapped"),
        ("buildings:\n  - name: b\n    height_m: 4\n    polygon_deg: [[35.728, -78.697], [35.7281, -78.6969],"
         " [35.7281, -78.697], [35.728, -78.6969]]", 8, "not a simple outline"),
        ("buildings:\n  - {name: b, height_m: 4, polygon_deg: [[35.728, -78.697], [35.728, -78.697], [35.728, -78.697]]}", 6, "fewer than 3"),
        ("geofences:\n  - {name: g, polygon_deg: [[35, 179.9], [35, -179.9], [35.1, -179.9]]}", 6, "crosses the antimeridian"),
        ("forests:\n  - {name: w, polygon_m: [[706000, 2063000], [706100, 2063000], [706100, 2063100]]}", 6, "map coordinates"),
        (f"buildings:\n  - {{name: b, height_m: 4000, polygon_m: {SQUARE}}}", 6, "feet or centimetres"),
        (f"buildings:\n  - {{name: b, height_m: .inf, polygon_m: {SQUARE}}}", 6, "a finite number"),
        ("buildings:\n  - {name: b, height_m: 4, polygon_m: [[0, 0], [.nan, 0], [10, 10]]}", 6, "a finite number"),
        (f"forests:\n  - {{name: w, trees_per_hectare: 1e9, polygon_m: {SQUARE}}}", 6, "at most 2000000"),
        ("  U: {latitude_deg: -78.696, longitude_deg: 35.7275}", 5, "latitude and longitude are swapped"),
        ("  U: {latitude_deg: 78.696, longitude_deg: 35.7275}", 5, "are swapped and a sign is wrong"),
        ("  U: {latitude_deg: 35.7275, longitude_deg: 78.696}", 5, "west is negative"),
        ("  U: {latitude_deg: 35.9, longitude_deg: -78.696}", 5, "a digit is wrong"),
        ("  U: {latitude_deg: 35.7275, longitude_deg: -78.696, antenna_height_m: 3300}", 5, "feet or centimetres"),
        ("  joint: {latitude_deg: 35.7275, longitude_deg: -78.696}", 5, "maps reserve this name"),
        ("  T 1: {latitude_deg: 35.7275, longitude_deg: -78.696}\n  T_1: {latitude_deg: 35.7275, longitude_deg: -78.696}", 6, "both are 'T_1' in the names of layers"),
        ("area_m: [10, -10, 0, 5]", 5, "east_min, east_max"),
        ("tower_ground: dem", 5, "the key 'dem'"),
        ("trees: {height_m: -3}", 5, "trees.height_m: found -3; expected greater than 0"),
        ("trees:\n  single: [{at_m: [1e9, 0]}]", 6, "map coordinates"),
        ("sead: 1", 5, "unknown key 'sead'"),
        ("trees: {sead: 1}", 5, "unknown key 'trees.sead'. Likely cause: did you mean 'seed'"),
        ("name: again", 5, r"duplicate key 'name' \(first on line 1\)"),
        ("ground_material: medium_dry_grund", 5, "ground_material: unknown material .*did you mean 'medium_dry_ground'"),
        (f"buildings:\n- {{name: b, height_m: -1, polygon_m: {SQUARE}}}", 6, "height_m: found -1"),
        ("buildings:\n- {name: b, height_m: 1}", 6, "give polygon_m .* or polygon_deg"),
        ("forests:\n- {name: w, polygon_deg: [[48.7, 2.1], [48.7, 2.2], [48.8, 2.1]]}", 6, "km from the site's origin"),
        ("  U: {latitude_deg: 36.7275, longitude_deg: -78.696}", 5, "tower 'U' .* lies 111.0 km from its site"),
        ("  U: {latitude_deg: 135.7, longitude_deg: -78.696}", 5, "latitude_deg: found 135.7"),
        ("  U: {latitude_deg: 35.7275}", 5, "give latitude_deg and longitude_deg, or positions"),
    ],
)  # fmt: skip
def test_every_message_names_its_line(tmp_path: Path, more: str, line: int, words: str) -> None:
    path = tmp_path / "site.yaml"
    path.write_text(f"{BASE}{more}\n")
    with pytest.raises(UsageError, match=words) as error:
        load_site(path)
    assert (error.value.path, error.value.line) == (str(path), line), str(error.value)


def test_the_origins_ground_is_no_height_of_the_site_itself(tmp_path: Path) -> None:
    (tmp_path / "s.yaml").write_text(BASE.replace("ellipsoidal", "above_takeoff"))
    with pytest.raises(UsageError, match="expected 'orthometric' or 'ellipsoidal'"):
        load_site(tmp_path / "s.yaml")


def test_overlapping_buildings_are_told(tmp_path: Path) -> None:
    first, second = (f"  - {{name: {n}, height_m: 4, polygon_m: {SQUARE}}}\n" for n in "ab")
    (tmp_path / "s.yaml").write_text(BASE + "buildings:\n" + first + second)
    assert any("the buildings 'a' and 'b' overlap" in note for note in load_site(tmp_path / "s.yaml").notes)
