"""Check that one village in four formats gives the same site. Every kind of broken outline is repaired and reported."""

import json
from pathlib import Path

import numpy as np
import pytest
import shapely
from shapely.geometry import box

from aerpaw_cmp.common.errors import InputError, UsageError
from aerpaw_cmp.common.geodesy import SiteFrame
from aerpaw_cmp.site import footprints
from aerpaw_cmp.site.footprints import Footprints, import_footprints, import_site, site_yaml
from aerpaw_cmp.site.siteyaml import build_site, load_site
from tests.geojson import collection, feature, polygon
from tests.real_logs import REAL
from tests.site.osm import FRAME, Osm, Ring, lonlat, square


def geojson(path: Path, *features: tuple[list[Ring], dict[str, object]]) -> Path:
    shapes = [
        feature(polygon(*map(lonlat, rings)), **tags) | {"id": f"f{n}"} for n, (rings, tags) in enumerate(features)
    ]
    path.write_text(json.dumps(collection(*shapes)))
    return path


BARN: dict[str, object] = {"building": "barn", "height": "7.5"}
VILLAGE: list[tuple[str, list[Ring], dict[str, str]]] = [
    ("barn", [square(0, 0)], {"building": "barn", "height": "25 ft", "name": "barn"}),
    ("yard", [square(100, 0, 40), square(110, 10, 20)], {"building": "yes", "building:levels": "2", "name": "yard"}),
    ("hut", [square(200, 0, 6)], {"building": "yes", "name": "hut"}),
    ("wood", [square(-200, -200, 150)], {"natural": "wood", "name": "wood"}),
]


def village() -> Osm:
    osm = Osm()
    for _, rings, tags in VILLAGE:
        members = []
        for number, ring in enumerate(rings):
            first, *others = [osm.node(*point) for point in lonlat(ring)[:-1]]
            around = [first, *others, first]
            if len(rings) == 1:
                osm.line(around, **tags)
                continue
            half = len(around) // 2  # the outline in two pieces, one of them backwards
            for piece in (around[: half + 1], around[half:][::-1]):
                members.append((osm.line(piece), "inner" if number else "outer"))
        if members:
            osm.relation(members, **tags, type="multipolygon")
    osm.line([1, 2, 6], highway="track")
    return osm


def osm_xml(path: Path) -> Path:
    path.write_text(village().xml())
    return path


def overpass(path: Path) -> Path:
    osm = village()
    where = {i: {"lat": lat, "lon": lon} for i, lat, lon, _ in osm.nodes}
    lines = {i: [where[r] for r in refs] for i, refs, _ in osm.ways}
    elements: list[dict[str, object]] = [
        {"type": "way", "id": i, "tags": tags, "geometry": lines[i]} for i, _, tags in osm.ways if tags
    ]
    for n, (members, tags) in enumerate(osm.relations):
        listed = [{"type": "way", "ref": r, "role": role, "geometry": lines[r]} for r, role in members]
        elements.append({"type": "relation", "id": n, "tags": tags, "members": listed})
    path.write_text(json.dumps({"version": 0.6, "elements": elements}))
    return path


def kml(path: Path) -> Path:
    def ring(points: Ring, role: str) -> str:
        text = " ".join(f"{lon!r},{lat!r},0" for lon, lat in lonlat(points))
        return f"<{role}BoundaryIs><LinearRing><coordinates>\n{text}\n</coordinates></LinearRing></{role}BoundaryIs>"

    text = '<?xml version="1.0"?><kml xmlns="http://www.opengis.net/kml/2.2"><Document>'
    for name, rings, tags in VILLAGE:
        data = "".join(f'<Data name="{k}"><value>{v}</value></Data>' for k, v in tags.items())
        areas = ring(rings[0], "outer") + "".join(ring(hole, "inner") for hole in rings[1:])
        text += (
            f"<Placemark><name>{name}</name><ExtendedData>{data}</ExtendedData><Polygon>{areas}</Polygon></Placemark>"
        )
    path.write_text(text + "</Document></kml>")
    return path


def village_geojson(path: Path) -> Path:
    return geojson(path, *[(rings, dict(tags)) for _, rings, tags in VILLAGE])


@pytest.mark.parametrize("writer", [village_geojson, osm_xml, overpass, kml])
def test_one_village_in_four_formats(tmp_path: Path, writer: object) -> None:
    outlines = import_footprints([writer(tmp_path / "village")], FRAME)  # type: ignore[operator]
    heights = {b.name: b.height_m for b in outlines.buildings}
    assert heights == {"barn": pytest.approx(7.62), "yard": 6.0, "hut": 6.0}
    areas = {b.name: b.footprint.area for b in outlines.buildings}
    assert areas == pytest.approx({"barn": 400, "yard": 40**2 - 20**2, "hut": 36}, rel=1e-4)
    barn = next(b for b in outlines.buildings if b.name == "barn")
    assert barn.footprint.symmetric_difference(box(0, 0, 20, 20)).area < 0.01
    assert [(f.name, round(f.area.area)) for f in outlines.forests] == [("wood", 22500)]
    assert not outlines.geofences


def test_round_trip_through_site_yaml(tmp_path: Path) -> None:
    model, actions = import_site([village_geojson(tmp_path / "v.json")], trees=True)
    (tmp_path / "site.yaml").write_text(site_yaml(model, header=["imported", *actions]), encoding="utf-8")
    site, again = load_site(tmp_path / "site.yaml"), build_site(model)
    assert site.assumed == (
        "height assumed: none in the map for 1 of 3 buildings, 6 m each: hut; "
        "trees assumed: 100 per hectare at random places in 1 wood"
    )
    assert site.assumed in actions
    assert any(site.assumed in note for note in site.notes)
    assert list(site.towers) == ["LW1", "LW2", "LW3", "LW4", "LW5"]
    assert [b.height_m for b in site.buildings] == [b.height_m for b in again.buildings]
    for first, second in zip(site.buildings, again.buildings, strict=True):
        assert first.footprint.equals_exact(second.footprint, 1e-3)
    np.testing.assert_array_equal(site.trees.east_m, again.trees.east_m)
    assert len(site.trees) > 100


def test_geofence_and_untagged_areas(tmp_path: Path) -> None:
    plain = geojson(tmp_path / "plain.json", ([square(0, 0)], {}))
    with pytest.raises(InputError, match=r"no building, forest, geofence or tree found in plain.json") as raised:
        import_footprints([plain], FRAME)
    assert str(raised.value).count("plain.json") == 1
    assert len(import_footprints([plain], FRAME, untagged="forest").forests) == 1
    fence = tmp_path / "fence.kml"
    fence.write_text(kml(fence).read_text().replace("<ExtendedData>", "<x>").replace("</ExtendedData>", "</x>"))
    fence.write_text(fence.read_text().replace('name="building', 'name="b').replace('name="natural', 'name="n'))
    outlines = import_footprints([fence], FRAME)
    assert (len(outlines.geofences), len(outlines.buildings)) == (4, 0)


def imported(tmp_path: Path, *features: tuple[list[Ring], dict[str, object]]) -> Footprints:
    return import_footprints([geojson(tmp_path / "a.json", *features)], FRAME)


def said(outlines: Footprints, words: str) -> bool:
    return any(words in action for action in outlines.actions)


def test_self_crossing_ring_is_repaired(tmp_path: Path) -> None:
    outlines = imported(tmp_path, ([[(0, 0), (20, 20), (20, 0), (0, 20)]], BARN))  # a bow tie
    assert sum(b.footprint.area for b in outlines.buildings) == pytest.approx(200, rel=1e-3)
    assert all(b.footprint.is_valid for b in outlines.buildings)
    assert said(outlines, "self-crossing ring was repaired (self-intersection)")


def test_three_equal_points_are_left_out(tmp_path: Path) -> None:
    outlines = imported(tmp_path, ([[(5, 5)] * 3], BARN), ([square(0, 0)], BARN))
    assert len(outlines.buildings) == 1
    assert said(outlines, "f0: left out, it has no area")
    assert said(outlines, "fewer than 3 distinct points")


def test_duplicates_slivers_and_overlaps(tmp_path: Path) -> None:
    tall: dict[str, object] = {"building": "yes", "height": "20"}
    outlines = imported(
        tmp_path,
        ([square(0, 0)], {"building": "yes"}),
        ([square(0.05, 0)], BARN),  # the same again, with a height
        ([[(50, 0), (90, 0), (90, 0.1)]], BARN),  # a sliver
        ([square(200, 0)], BARN),
        ([square(210, 0)], BARN),  # overlaps at the same height
        ([square(300, 0)], BARN),
        ([square(310, 0)], tall),  # overlaps a higher one
        ([square(315, 5, 5)], BARN),  # inside the higher one, over both
    )
    assert said(outlines, "f1: left out, it repeats")
    assert said(outlines, "sliver of 2.0 m2 was left out")
    assert said(outlines, "they were merged")
    assert said(outlines, "part under a higher building was cut away")
    assert said(outlines, "lies inside buildings at least as high")
    by_area = sorted((round(b.footprint.area), b.height_m) for b in outlines.buildings)
    assert by_area == [(200, 7.5), (400, 7.5), (400, 20.0), (600, 7.5)]
    shapes = [b.footprint for b in outlines.buildings]
    assert all(a.intersection(b).area < 0.01 for i, a in enumerate(shapes) for b in shapes[:i])


def test_rounding_for_the_file_breaks_no_outline(tmp_path: Path) -> None:
    # rounding vertices one by one once made notched, cut-away outlines cross themselves
    random = np.random.default_rng(1)
    features: list[tuple[list[Ring], dict[str, object]]] = []
    for _ in range(250):
        turn, corner, size = random.uniform(0, np.pi), random.uniform(-150, 150, 2), random.uniform(8, 30, 2)
        box_ = np.array([(0, 0), (1, 0), (1, 1), (0.5, 1), (0.5, 0.6), (0, 0.6)]) * size
        rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        ring = [(float(x), float(y)) for x, y in corner + box_ @ rotation.T]
        features.append(([ring], {"building": "yes", "height": f"{random.uniform(4, 12):.1f}"}))
    model, _ = import_site([geojson(tmp_path / "v.json", *features)])
    (tmp_path / "site.yaml").write_text(site_yaml(model), encoding="utf-8")
    site = load_site(tmp_path / "site.yaml")
    assert len(site.buildings) > 200
    drawn = shapely.union_all([shapely.Polygon(rings[0]) for rings, _ in features]).area
    assert sum(b.footprint.area for b in site.buildings) == pytest.approx(drawn, rel=0.01)


def test_overlapping_forests_do_not_double_the_trees(tmp_path: Path) -> None:
    wood: dict[str, object] = {"landuse": "forest"}
    outlines = imported(tmp_path, ([square(0, 0, 100)], wood), ([square(50, 0, 100)], wood))
    assert sum(f.area.area for f in outlines.forests) == pytest.approx(15_000, rel=1e-3)


def test_hole_outside_and_multipolygon_keep_their_area(tmp_path: Path) -> None:
    path = tmp_path / "m.json"
    parts = [[lonlat(square(0, 0, 40)), lonlat(square(10, 10))], [lonlat(square(100, 0))]]
    geometry = {"type": "MultiPolygon", "coordinates": parts}
    path.write_text(json.dumps({"type": "Feature", "properties": BARN, "geometry": geometry}))
    outlines = import_footprints([path], FRAME)
    assert sorted(round(b.footprint.area) for b in outlines.buildings) == [400, 1200]
    assert len({b.name for b in outlines.buildings}) == 2


def test_heights_that_cannot_be_metres(tmp_path: Path) -> None:
    assert imported(tmp_path, ([square(0, 0)], {"building": "yes", "height": "828"})).buildings[0].height_m == 828
    outlines = imported(tmp_path, ([square(0, 0)], BARN), ([square(100, 0)], {"building": "yes", "height": "2400"}))
    assert [b.height_m for b in outlines.buildings] == [7.5, 6]
    assert said(outlines, "a.json: f1: a height of 2400 m is implausible (feet or cm?); it is drawn 6 m high")
    outlines = imported(tmp_path, ([square(0, 0)], {"building": "yes", "building:levels": "2400"}))
    assert said(outlines, "a.json: f0: 2400 levels are more than any building has; it is drawn 6 m high")
    outlines = imported(tmp_path, ([square(0, 0)], {"building": "yes", "height": "20", "building:levels": "2"}))
    assert said(outlines, "warning: a.json: f0: 20 m for 2 levels; are these feet?")
    outlines = imported(tmp_path, ([square(0, 0)], {"building": "yes", "height": "tall", "building:levels": "2"}))
    assert outlines.buildings[0].height_m == 6
    assert said(outlines, "height 'tall' is not a length")
    high = [([square(100 * n, 0)], {"building": "yes", "height": "30"}) for n in range(4)]
    assert said(imported(tmp_path, *high), "warning: the median stated height")  # type: ignore[arg-type]


def raw(path: Path, *points: tuple[float, float]) -> Path:
    geometry = {"type": "Polygon", "coordinates": [[list(p) for p in points]]}
    path.write_text(json.dumps({"type": "Feature", "properties": BARN, "geometry": geometry}))
    return path


def test_swapped_far_and_antimeridian(tmp_path: Path) -> None:
    swapped = [(lat, lon) for lon, lat in lonlat(square(0, 0))]
    with pytest.raises(InputError, match="latitude and longitude are swapped"):
        import_footprints([raw(tmp_path / "s.json", *swapped)], FRAME)
    with pytest.raises(InputError, match="the sign of the longitude is wrong: west is negative"):
        import_footprints([raw(tmp_path / "e.json", *((-lon, lat) for lat, lon in swapped))], FRAME)
    with pytest.raises(InputError, match=r"\d+ km from the site.*a map of another place"):
        import_footprints([raw(tmp_path / "p.json", (2.0, 48.0), (2.1, 48.0), (2.1, 48.1))], FRAME)
    with pytest.raises(InputError, match=r"antimeridian"):
        import_footprints([raw(tmp_path / "d.json", (179.9, 35.0), (-179.9, 35.0), (179.9, 35.1))], FRAME)
    with pytest.raises(InputError, match="metres or feet instead of degrees"):
        import_footprints([raw(tmp_path / "f.json", (2020.5, 1971.5), (2050, 1971), (2050, 1990))], FRAME)


def test_site_on_the_antimeridian_is_whole(tmp_path: Path) -> None:
    frame = SiteFrame(-16.8, 180.0)
    path = raw(tmp_path / "d.json", *[(p[0], p[1]) for p in lonlat(square(-10, -10), frame)])
    outlines = import_footprints([path], frame)
    assert outlines.buildings[0].footprint.area == pytest.approx(400, rel=1e-4)
    assert said(outlines, "crosses the antimeridian")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "empty"),
        (b"version https://git-lfs.github.com/spec/v1\n", "Git-LFS"),
        (b"\x89PNG\r\n", "not a map file"),
        (b'{"type": "FeatureCollection", "features": [', "not JSON"),
        (b'{"type": "FeatureCollection", "features": [3]}', "not valid"),
        (b'{"a": 1}', "neither GeoJSON nor Overpass"),
        (b"<osm><node", "not XML"),
        (b"<gpx></gpx>", "XML of 'gpx'"),
        (b'<!DOCTYPE x [<!ENTITY a "b">]><osm/>', "declares entities"),
        (b'{"type":"Polygon","coordinates":[[["a",1],[2,3],[4,5]]]}', "is not longitude, latitude"),
        (b'{"type":"Feature","crs":{"properties":{"name":"EPSG:3857"}}}', "expected WGS84"),
    ],
)
def test_bad_files_are_one_message(tmp_path: Path, content: bytes, words: str) -> None:
    path = tmp_path / "bad"
    path.write_bytes(content)
    with pytest.raises(InputError, match=words):
        import_footprints([path], FRAME)


def test_nothing_named() -> None:
    with pytest.raises(UsageError, match="no map file named"):
        import_site([])
    with pytest.raises(InputError, match="cannot be read"):
        import_footprints(["/nowhere/at/all.osm"], FRAME)


@pytest.mark.field
def test_geofence_of_the_field() -> None:
    path = REAL / "telemetry" / "AERPAW_Big_Geofence.kml"
    site = load_site("lake_wheeler")
    outlines = import_footprints([path], site.frame)
    assert (len(outlines.geofences), len(outlines.buildings), outlines.actions) == (1, 0, [])
    assert 1e4 < outlines.geofences[0].area.area < 5e6
    assert outlines.geofences[0].area.distance(shapely.Point(0, 0)) < 500  # the flights start near LW1


def test_a_number_that_is_no_degree_is_infinitely_far_and_overflows_nowhere():
    frame = SiteFrame(35.7275, -78.696)
    latitude, longitude = np.array([3.571e306, 35.7275, np.inf, np.nan]), np.array([-78.696, -78.696, 0.0, 1e300])
    assert footprints._distance_m(latitude, longitude, frame).tolist() == [np.inf, 0.0, np.inf, np.inf]
