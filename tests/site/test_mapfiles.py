"""Damaged and unusual map data: usable data are used, and each ignored object has a line."""

import gzip
import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely

from aerpaw_cmp.common import kml as kml_module
from aerpaw_cmp.common import kml as xmlfiles
from aerpaw_cmp.common.errors import InputError, UsageError
from aerpaw_cmp.site import mapfiles
from aerpaw_cmp.site.footprints import Footprints, import_footprints, import_site, site_yaml
from aerpaw_cmp.site.mapfiles import MAX_TAGS, OSM_CREDIT, read_map_file
from aerpaw_cmp.site.siteyaml import build_site, load_site
from tests.geojson import collection, feature, polygon
from tests.site.osm import FRAME, Osm, Ring, lonlat
from tests.site.osm import square as flat

BARN = {"building": "barn", "height": "7.5"}


def square(east: float, north: float, size: float = 20.0) -> Ring:
    return lonlat(flat(east, north, size))


def read(tmp_path: Path, content: Any, name: str = "m.json", **options: Any) -> Footprints:
    path = tmp_path / name
    text = content if isinstance(content, str | bytes) else json.dumps(content, indent=1)
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return import_footprints([path], FRAME, **options)


def said(footprints: Footprints, words: str) -> bool:
    return any(words in action for action in footprints.actions)


# ---------------------------------------------------------------- OSM


@pytest.mark.parametrize("style", ["multipolygon", "tags on the outer way", "tags on both", "no roles"])
def test_clearings_stay_empty_of_trees(tmp_path: Path, style: str) -> None:
    osm = Osm()
    wood = {"natural": "wood"}
    outer = osm.way(square(100, 100, 300), **(wood if "tags" in style else {}))
    inner = [osm.way(square(150, 150, 80)), osm.way(square(280, 280, 60))]
    island = osm.way(square(170, 170, 30))
    roles = ("", "") if style == "no roles" else ("outer", "inner")
    members = [(outer, roles[0]), *((way, roles[1]) for way in inner), (island, roles[0])]
    osm.relation(members, type="multipolygon", **({} if style == "tags on the outer way" else wood))
    (tmp_path / "w.osm").write_text(osm.xml())
    model, _ = import_site([tmp_path / "w.osm"], trees=True)
    (tmp_path / "site.yaml").write_text(site_yaml(model), encoding="utf-8")
    site = load_site(tmp_path / "site.yaml")
    # the site's origin is LW1, a metre or so from FRAME's
    shift = np.array(site.frame.to_local(FRAME.latitude_deg, FRAME.longitude_deg))
    east, north = site.trees.east_m - shift[0], site.trees.north_m - shift[1]
    clearings = shapely.box(151, 151, 229, 229).difference(shapely.box(169, 169, 201, 201))
    assert not shapely.contains_xy(clearings, east, north).any()
    assert not shapely.contains_xy(shapely.box(281, 281, 339, 339), east, north).any()
    assert shapely.contains_xy(shapely.box(170, 170, 200, 200), east, north).sum() > 3, "the island in the clearing"
    assert len(site.trees) == pytest.approx((300**2 - 80**2 - 60**2 + 30**2) / 100, rel=0.01)


def test_trees_have_their_tagged_sizes(tmp_path: Path) -> None:
    osm = Osm()
    for place, tags in enumerate(
        [
            {"height": "12", "diameter_crown": "6 m", "circumference": "1.57"},
            {"est_height": "40 ft"},
            {},
            {"height": "tall"},
            {"height": "400"},
            {"circumference": "250"},
            {"circumference": "250 m", "diameter_crown": "800"},
            {"circumference": "80"},
            {"circumference": "120 cm"},
            {"height": "0.001", "circumference": "0.01"},
        ]
    ):
        osm.node(*square(40.0 * place + 30, 50)[0], natural="tree", **tags)
    (tmp_path / "t.osm").write_text(osm.xml())
    model, actions = import_site([tmp_path / "t.osm"])
    (tmp_path / "site.yaml").write_text(site_yaml(model, header=actions), encoding="utf-8")
    trees = load_site(tmp_path / "site.yaml").trees
    np.testing.assert_allclose(trees.height_m, [12, 12.19] + 8 * [20])
    np.testing.assert_allclose(trees.crown_diameter_m, [6] + 9 * [10])
    np.testing.assert_allclose(trees.crown_base_m, trees.height_m / 4)
    np.testing.assert_allclose(trees.trunk_diameter_m, [0.5, 0.4, 0.4, 0.4, 0.4, 0.8, 0.4, 0.4, 0.38, 0.4])
    assert "t.osm: node 4: the height 'tall' is not a length" in actions
    said = ("node 5: a tree 400 m high", "node 6: the circumference '250' is taken as centimetres", "node 7: a trunk 250 m",
            "node 7: a crown 800 m", "node 8: a trunk 80 m around (feet or cm?); the site", "node 10: a tree 0.001 m high")  # fmt: skip
    for words in said:
        assert any(words in action for action in actions), words


def test_tree_rows_become_trees_along_the_line(tmp_path: Path) -> None:
    corners = [[*square(0, 0)[0]], [*square(60, 0)[0]], [*square(60, 40)[0]]]
    row = feature({"type": "LineString", "coordinates": corners}, natural="tree_row", height="9", diameter_crown="5")
    footprints = read(tmp_path, collection(row))
    east, north = np.array([tree.at_m for tree in footprints.trees]).T
    assert len(east) == 21
    assert shapely.LineString([(0, 0), (60, 0), (60, 40)]).distance(shapely.points(east, north)).max() < 0.02
    np.testing.assert_allclose(np.diff(east).sum() + np.diff(north).sum(), 100, atol=0.05)
    assert {(t.height_m, t.crown_diameter_m) for t in footprints.trees} == {(9.0, 5.0)}
    assert said(footprints, "21 trees placed along the row, 5 m apart")


def test_a_tree_row_with_lost_nodes_says_so(tmp_path: Path) -> None:
    osm = Osm()
    osm.way(square(0, 0), natural="tree_row")
    footprints = read(tmp_path, osm.xml(drop=(1,)), "a.osm")
    assert footprints.trees
    assert said(footprints, "way 100: 2 of 5 nodes not in the file")


def test_a_building_with_a_lost_first_node_or_an_open_line_is_kept(tmp_path: Path) -> None:
    osm = Osm()
    osm.way(square(0, 0), **BARN)
    osm.way(square(100, 0), **BARN)
    osm.ways[1] = (osm.ways[1][0], osm.ways[1][1][:-1], osm.ways[1][2])
    footprints = read(tmp_path, osm.xml(drop=(1,)), "a.osm")
    assert sorted(round(b.footprint.area) for b in footprints.buildings) == [200, 400]
    assert said(footprints, "way 100: 2 of 5 nodes not in the file")
    assert said(footprints, "way 101: its line is not closed")


def test_osm_with_a_namespace_and_deleted_elements(tmp_path: Path) -> None:
    osm = Osm()
    osm.way(square(0, 0), **BARN)
    text = osm.xml(root='<osm xmlns="http://openstreetmap.org/osm/0.6" version="0.6">')
    text = text.replace("</osm>", '<node id="77" visible="false"/><way id="78" visible="false"/></osm>')
    footprints = read(tmp_path, text, "a.osm")
    assert (len(footprints.buildings), footprints.actions) == (1, [])


def test_broken_relations(tmp_path: Path) -> None:
    osm = Osm()
    way = osm.way(square(0, 0, 200))
    osm.ways[0] = (way, osm.ways[0][1][:-1], {})
    osm.relation([(way, "outer"), (999, "inner")], type="multipolygon", landuse="forest")
    osm.relation([(998, "outer")], type="multipolygon", landuse="forest")
    osm.relation([], type="route", landuse="forest")
    footprints = read(tmp_path, osm.xml(), "a.osm")
    assert [round(f.area.area, -2) for f in footprints.forests] == [40_000]
    for words in ("relation 0: way 999 is not in the file", "relation 0: a ring is not closed",
                  "relation 1: left out, it has no area", "1 relations of type 'route'"):  # fmt: skip
        assert said(footprints, words), words


def overpass(*elements: Any, **more: Any) -> dict[str, Any]:
    return {"elements": list(elements), **more}


def test_overpass_center_body_and_remark(tmp_path: Path) -> None:
    points = [{"lat": lat, "lon": lon} for lon, lat in square(0, 0)]
    complete = {"type": "way", "id": 2, "tags": BARN, "geometry": points}
    centre = {"type": "way", "id": 1, "tags": BARN, "center": points[0]}
    with pytest.raises(InputError, match=r"no building.*way 1: it has no outline in the file.*'out geom;'"):
        read(tmp_path, overpass(centre))
    cut = {**complete, "id": 3, "geometry": [*points[:3], None]}
    broken = {"type": "way", "id": 4, "tags": BARN, "geometry": [{"lat": 1}]}
    footprints = read(tmp_path, overpass(centre, complete, cut, broken, "?", remark="runtime error: Query timed out"))
    assert len(footprints.buildings) == 1
    for words in ("way 1: left out", "way 3: 1 of 4 points unknown", "Query timed out"):
        assert said(footprints, words), words
    assert said(footprints, "m.json: way 4 was left out"), footprints.actions
    assert any(action.endswith("element 5 was left out: it is not valid") for action in footprints.actions)
    # 'out body; >; out skel;' lists nodes without tags, and ways twice
    nodes = [{"type": "node", "id": n, **point} for n, point in enumerate(points[:-1])]
    body = {"type": "way", "id": 5, "tags": BARN, "nodes": [0, 1, 2, 3, 0]}
    footprints = read(tmp_path, overpass(body, *nodes, {"type": "way", "id": 5, "nodes": [0, 1, 2, 3, 0]}))
    assert (len(footprints.buildings), footprints.actions) == (1, [])


# ---------------------------------------------------------------- GeoJSON


def test_one_bad_feature_does_not_lose_the_others(tmp_path: Path) -> None:
    good = feature(polygon(square(0, 0)), **BARN)
    bad = [
        None,
        3,
        feature(polygon([["a", 1], [2, 3], [4, 5]]), **BARN),
        feature({"type": "GeometryCollection"}, **BARN),
        feature({"type": "Circle", "coordinates": [1, 2]}, **BARN),
        feature(polygon(None), **BARN),
    ]
    footprints = read(tmp_path, collection(*bad, good))
    assert len(footprints.buildings) == 1
    assert said(footprints, "m.json: feature 1 was left out")
    assert said(footprints, "m.json: feature 2 was left out")
    assert said(footprints, "feature 3 was left out: the position ['a', 1] is not longitude, latitude")
    assert said(footprints, "feature 4 was left out: it is not valid: no 'geometries'")
    assert said(footprints, "feature 5 was left out: it is not valid: a geometry of type 'Circle'")
    assert said(footprints, "feature 6 was left out: it is not valid")


def test_what_is_no_area_is_counted(tmp_path: Path) -> None:
    line = feature({"type": "LineString", "coordinates": square(0, 0)}, building="yes")
    footprints = read(tmp_path, collection(feature(polygon(square(0, 0)), **BARN), feature(None, **BARN), line, line))
    assert len(footprints.buildings) == 1
    assert said(footprints, "skipped, because they are not areas: 2 LineString, 1 without geometry")


@pytest.mark.parametrize(
    ("rings", "words", "area"),
    [
        ([square(0, 0)[:-1]], "a ring is not closed", 400),
        ([square(0, 0), square(100, 100)], "a hole outside its outline was left out", 400),
        ([square(0, 0), square(-5, -5, 40)], "its holes cover all of it", 0),
        ([[[*p, 112.3] for p in square(0, 0)]], "", 400),
        ([[[2063000.1, 706000.2], [2063100, 706000], [2063100, 706100]]], "metres or feet in place of degrees", 0),
        ([[[lat, lon] for lon, lat in square(0, 0)]], "km from the site; latitude and longitude are swapped", 0),
        ([[[179.9, 35], [-179.9, 35], [-179.9, 35.1], [179.9, 35]]], "crosses the antimeridian", 0),
    ],
)
def test_each_repair_is_said(tmp_path: Path, rings: list[Any], words: str, area: float) -> None:
    footprints = read(tmp_path, collection(feature(polygon(*rings), **BARN), feature(polygon(square(300, 0)), **BARN)))
    assert sum(b.footprint.area for b in footprints.buildings) == pytest.approx(area + 400, rel=1e-3)
    assert bool(footprints.actions) == bool(words)
    assert said(footprints, words) or not words


def test_parts_of_a_building_have_their_own_heights(tmp_path: Path) -> None:
    outline = feature(polygon(square(0, 0, 40)), building="yes", height="20")
    low = feature(polygon(square(0, 0, 20)), **{"building:part": "yes", "height": "6"})
    roof = feature(polygon(square(20, 20, 20)), **{"building:part": "roof", "height": "20", "min_height": "15"})
    footprints = read(tmp_path, collection(outline, low, roof))
    assert sorted((round(b.footprint.area), b.height_m) for b in footprints.buildings) == [
        (400, 6),
        (400, 20),
        (400, 20),
        (400, 20),
    ]
    assert said(footprints, "feature 1: replaced by its mapped parts")
    assert said(footprints, "feature 3: it begins above the ground")


@pytest.mark.parametrize(
    ("tags", "metres", "words"),
    [
        ({"height": "-1"}, 6, "not above 0"),
        ({"height": 0, "building:levels": 3}, 9, "not above 0"),
        ({"height": None}, 6, "height assumed"),
        ({"height": "2;3"}, 3, "taken as 3 m"),
        ({"height": "~12"}, 12, "taken as 12 m"),
        ({"height": "1,200"}, 6, "is not a length"),
        ({"height": "12-15"}, 6, "is not a length"),
        ({"height": "12\u20196\u201d"}, 3.81, ""),
        ({"height": "39'4\""}, 11.99, ""),
        ({"height": "40 ft"}, 12.19, ""),
        ({"height": "40'"}, 12.19, ""),
        ({"height": "12,5 m"}, 12.5, ""),
        ({"height": "350 cm"}, 3.5, ""),
        ({"building:levels": "2;3"}, 9, "the largest of the levels"),
        ({"NumFloors": "3"}, 9, ""),
        ({"no_of_storeys": "3"}, 9, ""),
        ({"building:levels": "-1"}, 6, "not a positive number"),
        ({"building:levels": "three"}, 6, "not a positive number"),
    ],
)
def test_unusual_heights_are_used_or_said(tmp_path: Path, tags: dict[str, Any], metres: float, words: str) -> None:
    footprints = read(tmp_path, collection(feature(polygon(square(0, 0)), building="yes", **tags)))
    assert footprints.buildings[0].height_m == pytest.approx(metres, abs=0.01)
    assert said(footprints, words) if words else not [text for text in footprints.actions if "assumed" not in text]
    assert ("none in the map for 1 of 1 building, 6 m each" in footprints.assumed) == (metres == 6)


def test_false_is_no_building_and_the_way_out_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="1 untagged; '--untagged building'"):
        read(tmp_path, collection(feature(polygon(square(0, 0)), building=False)))
    with pytest.raises(UsageError, match="untagged areas as 'house'; expected one of building, forest, geofence"):
        read(tmp_path, polygon(square(0, 0)), untagged="house")
    assert len(read(tmp_path, polygon(square(0, 0)), untagged="building").buildings) == 1
    for tags in ({"building": "no"}, {"natural": "scrub"}, {"razed:building": "yes"}):  # a tag that says what it is
        with pytest.raises(InputError, match="left out"):
            read(tmp_path, collection(feature(polygon(square(0, 0)), **tags)), untagged="building")


def test_forests_far_outside_the_site_are_cut_off(tmp_path: Path) -> None:
    wood = feature(polygon(square(200, 200, 9000)), natural="wood")
    footprints = read(tmp_path, collection(wood), area_m=(-500.0, 500.0, -500.0, 500.0))
    east, north = footprints.forests[0].area.bounds[2:]
    assert (east, north) == pytest.approx((1500, 1500), abs=1)
    assert said(footprints, "ha more than 1000 m outside the site's area were cut away")


# ---------------------------------------------------------------- files


def kml(*placemarks: str, root: str = '<kml xmlns="http://www.opengis.net/kml/2.2">') -> str:
    return f'<?xml version="1.0"?>{root}<Document>' + "\n".join(placemarks) + "</Document></kml>"


def placemark(ring: Ring, name: str = "fence", blank: str = "") -> str:
    text = " ".join(f"{lon!r},{blank}{lat!r},30" for lon, lat in ring)
    return (
        f"<Placemark><name>{name}</name><MultiGeometry><Polygon><altitudeMode>absolute</altitudeMode><outerBoundaryIs>"
        f"<LinearRing><coordinates>{text}</coordinates></LinearRing></outerBoundaryIs></Polygon></MultiGeometry>"
        "</Placemark>"
    )


def test_kmz_and_kml_of_many_hands(tmp_path: Path) -> None:
    good = kml(placemark(square(0, 0, 100)))
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        archive.writestr("images/x.png", b"")
        archive.writestr("doc.kml", good)
    for name, content in (
        ("a.kml", good),
        ("a.kmz", packed.getvalue()),
        ("blanks.kml", kml(placemark(square(0, 0, 100), blank=" "))),
        ("old.kml", kml(placemark(square(0, 0, 100)), root="<kml>")),
    ):
        footprints = read(tmp_path, content, name)
        assert [round(g.area.area) for g in footprints.geofences] == [10_000], name
        assert not footprints.actions
    path = "<Placemark><LineString><coordinates>1,2 3,4</coordinates></LineString></Placemark>"
    odd = placemark(square(0, 0), "odd", blank="north")
    footprints = read(tmp_path, kml(placemark(square(0, 0, 100)), path, odd), "b.kml")
    assert len(footprints.geofences) == 1
    assert said(footprints, "not areas: 1 LineString")
    assert said(footprints, "b.kml: placemark 'odd' was left out: ")


def test_a_building_drawn_above_the_ground_has_its_signed_height(tmp_path: Path) -> None:
    drawn = placemark(square(0, 0, 100)).replace(",30", ",+30").replace("absolute", "relativeToGround")
    tags = "<ExtendedData><Data name='building'><value>yes</value></Data></ExtendedData>"
    (building,) = read(tmp_path, kml(drawn.replace("<MultiGeometry>", f"{tags}<MultiGeometry>")), "a.kml").buildings
    assert building.height_m == 30.0


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (gzip.compress(b"<osm/>", mtime=0), "gzip-compressed data.*gunzip"),
        (b"BZh91AY", "bzip2-compressed"),
        ('{"type": "Polygon"}'.encode("utf-16"), "UTF-16 text.*save it as UTF-8"),
        (b'{"a":\n "\xfc"}', "line 2: not JSON text: a byte that is not UTF-8"),
        (b"\x00\x00\x00\x0d\n\tOSMHeader\x18", "OSM data in PBF"),
        (b"\x00\x00\x27\x0a\x00", "a shapefile.*ogr2ogr"),
        (b"<!DOCTYPE html><html><body>429 Too Many Requests</body></html>", "a web page"),
        (b'{"type": "Topology"}', "JSON of type 'Topology'"),
        (b'{"type": "FeatureCollection", "features": null}', "without a list of features"),
        (b'{"type": "FeatureCollection", "features": []}', "the map is empty"),
        (b'{"elements": [], "remark": "runtime error: out of memory"}', "cause: the Overpass server reports: r"),
        (b'{"type": "Feature"}\n{"type": "Feature"}\n', "one feature per line; 'ogr2ogr -f GeoJSON"),
        (b'{"type":"Point","crs":"urn:ogc:def:crs:EPSG::3857","coordinates":[0,0]}', "EPSG::3857.*ogr2ogr"),
        (b"PK\x03\x04xxxx", "not a KMZ archive"),
        (b"[" * 100_000, "nested too deeply"),
    ],
)
def test_other_files_are_named_for_what_they_are(tmp_path: Path, content: bytes, words: str) -> None:
    with pytest.raises(InputError, match=f"(?s){words}"):
        read(tmp_path, content, "x")


@pytest.mark.parametrize(
    "name", ["1e1", "0x1F", "12", "~", "true", "no", "a: b # c", ".nan", "</script>", "- x", "\u2028", "bell\u0007"]
)
def test_any_name_survives_site_yaml(tmp_path: Path, name: str) -> None:
    content = collection(feature(polygon(square(50, 0)), name=name, **BARN))
    (tmp_path / "v.json").write_text(json.dumps(content))
    model, actions = import_site([tmp_path / "v.json"])
    (tmp_path / "site.yaml").write_text(site_yaml(model, header=actions), encoding="utf-8")
    assert [b.name for b in load_site(tmp_path / "site.yaml").buildings] == [name]


def test_openstreetmap_is_credited_in_file_and_notes(tmp_path: Path) -> None:
    osm = Osm()
    osm.way(square(50, 0), **BARN)
    (tmp_path / "a.osm").write_text(osm.xml())
    plain, made_of_osm = feature(polygon(square(100, 0)), **BARN), feature(polygon(square(0, 90)), **BARN)
    (tmp_path / "b.json").write_text(json.dumps(collection(plain)))
    (tmp_path / "c.json").write_text(json.dumps(collection({**made_of_osm, "id": "way/5"})))
    for files, credit in ((["a.osm", "b.json"], OSM_CREDIT), (["b.json"], ""), (["b.json", "c.json"], OSM_CREDIT)):
        model, _ = import_site([tmp_path / name for name in files])
        assert model.credit == credit
        assert any("OpenStreetMap" in note for note in build_site(model).notes) == bool(credit)


def test_a_wood_takes_its_height_and_leaves_from_its_tags(tmp_path: Path) -> None:
    woods = [
        feature(polygon(square(200 * k, 0)), natural="wood", **tags)
        for k, tags in enumerate([{}, {"height": "12", "leaf_type": "needleleaved"}, {"height": "60 km"}])
    ]
    footprints = read(tmp_path, collection(*woods))
    assert [(f.height_m, f.evergreen_share) for f in footprints.forests] == [(20.0, 0.0), (12.0, 1.0), (20.0, 0.0)]
    assert footprints.assumed == "height assumed: none in the map for 2 of 3 woods, 20 m each"
    assert {f.height_m for f in read(tmp_path, collection(*woods), trees=True).forests} == {None}


def test_too_many_tags_are_refused_before_any_is_an_object(tmp_path: Path) -> None:
    path = tmp_path / "m.kml"
    path.write_bytes(b"<kml>" + b"<Placemark/>" * (MAX_TAGS + 1) + b"</kml>")
    with pytest.raises(InputError, match="the XML has 1500003 tags; expected at most 1500000"):
        read_map_file(path)


@pytest.mark.parametrize("tag", ["Placemark", "Polygon", "Data"])
def test_tags_in_themselves_are_walked_through_once(tmp_path: Path, tag: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Twenty thousand of them took minutes: each level was searched to the bottom again."""
    asked = [0]
    plain = xmlfiles.plain_tag

    def counted(name: str) -> str:
        asked[0] += 1
        return plain(name)

    for module in (mapfiles, kml_module, xmlfiles):
        monkeypatch.setattr(module, "plain_tag", counted)
    path = tmp_path / "m.kml"
    path.write_bytes(
        b"<kml><Placemark>" + f"<{tag}>".encode() * 20_000 + f"</{tag}>".encode() * 20_000 + b"</Placemark></kml>"
    )
    read_map_file(path)
    assert asked[0] < 100_000


def test_a_ring_of_a_million_crossings_is_left_out_and_said(tmp_path: Path) -> None:
    corners = np.random.default_rng(1).uniform(-0.001, 0.001, (4000, 2)) + np.array([-78.6959, 35.7275])
    ring = [*corners.tolist(), corners[0].tolist()]
    good = feature(polygon(square(0, 0)), building="yes")
    footprints = read(tmp_path, collection(feature(polygon(ring), building="yes"), good))
    assert len(footprints.buildings) == 1
    assert said(footprints, "crosses itself at more than 1000 places is skipped")


@pytest.mark.parametrize("point", [("nan", 35.7), (-78.7, "nan"), ("inf", 35.7)])
def test_a_coordinate_that_is_not_a_number_is_refused(point):
    with pytest.raises(InputError, match="a coordinate is not a number"):
        mapfiles.lonlat(point, "building 1")
