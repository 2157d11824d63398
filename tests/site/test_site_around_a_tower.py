"""A site from a map and a tower anywhere on Earth, without a base site."""

import json
from pathlib import Path

import pytest
from shapely.geometry import Point

from aerpaw_cmp.common.errors import InputError, UsageError
from aerpaw_cmp.site import footprints
from aerpaw_cmp.site.footprints import import_site, site_yaml
from aerpaw_cmp.site.siteyaml import load_site

LATITUDE, LONGITUDE = -33.86, 151.2


def campus(path: Path, latitude: float = LATITUDE, longitude: float = LONGITUDE) -> Path:
    """One building of 20 m, about 37 m x 44 m, whose south-west corner is at a position."""
    ring = [(longitude, latitude), (longitude + 4e-4, latitude), (longitude + 4e-4, latitude + 4e-4)]
    ring += [(longitude, latitude + 4e-4), ring[0]]
    feature = {"type": "Feature", "properties": {"building": "yes", "height": "20", "name": "hall"}}
    feature["geometry"] = {"type": "Polygon", "coordinates": [[list(point) for point in ring]]}
    grove = [[east + 5e-4, north] for east, north in ring]
    wood = {"type": "Feature", "properties": {"natural": "wood", "height": "20", "name": "grove"}}
    wood["geometry"] = {"type": "Polygon", "coordinates": [grove]}
    path.write_text(json.dumps({"type": "FeatureCollection", "features": [feature, wood]}))
    return path


def test_first_tower_is_the_origin_and_buildings_keep_their_place(tmp_path: Path) -> None:
    towers = (f"roof={LATITUDE + 2e-4},{LONGITUDE + 2e-4},25", f"mast={LATITUDE},{LONGITUDE - 1e-3},12.5")
    model, actions = import_site([campus(tmp_path / "campus.geojson")], towers=towers)
    (tmp_path / "site.yaml").write_text(site_yaml(model, header=actions))
    site = load_site(tmp_path / "site.yaml")
    assert list(site.towers) == ["roof", "mast"]
    roof, mast = site.towers.values()
    assert (roof.east_m, roof.north_m, roof.position_m[2]) == pytest.approx((0.0, 0.0, 25.0), abs=1e-6)
    # 1.2e-3 degrees of longitude at 33.86 degrees south, on a sphere of the Earth's radius
    assert mast.east_m == pytest.approx(-1.2e-3 * 111_320 * 0.8304, rel=2e-3)
    (hall,) = site.buildings
    assert hall.height_m == 20.0
    assert hall.footprint.contains(Point(0.0, 0.0))
    west, east, south, north = site.area_m
    assert west <= mast.east_m - 500
    assert min(east, -south, north) >= 500


@pytest.mark.parametrize(
    ("east_deg", "about"),
    [
        (2e-4, "(15.0 m up) is inside building 'hall' (roof at 20.0 m)"),
        (7e-4, "is inside wood 'grove' (canopy at 20 m)"),
    ],
)
def test_an_antenna_inside_an_object_is_reported_by_the_import(east_deg: float, about: str, tmp_path: Path) -> None:
    """The first map or flight would show a tower that no path reaches."""
    inside = [f"roof={LATITUDE + 2e-4},{LONGITUDE + east_deg},{height}" for height in (15, 25)]
    low, high = (import_site([campus(tmp_path / "campus.geojson")], towers=[tower])[1] for tower in inside)
    assert [text.startswith(f"warning: the antenna of tower roof {about}") for text in low].count(True) == 1
    assert not any("inside" in text for text in high)


def test_a_large_map_shows_its_progress(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(footprints, "_OUTLINES_PER_REPORT", 1)
    told: list[tuple[str, float | None]] = []
    towers = (f"roof={LATITUDE},{LONGITUDE},25",)
    files = [campus(tmp_path / name) for name in ("one.geojson", "two.geojson")]
    import_site(files, towers=towers, progress=lambda text, share=None: told.append((text, share)))
    assert told == [(f"outlines of {file.name}", share) for file in files for share in (0.5, 1.0)]


def test_a_tower_away_from_the_map_or_from_the_first_tower_is_named(tmp_path: Path) -> None:
    file = campus(tmp_path / "campus.geojson")
    _, actions = import_site([file], towers=[f"roof={LATITUDE + 0.05},{LONGITUDE},25"])
    assert actions[1].startswith("warning: no building or wood within 2 km of tower roof; the nearest is 5.5 km away")
    towers = [f"roof={LATITUDE},{LONGITUDE},25", f"mast={LATITUDE + 1.0},{LONGITUDE},25"]
    with pytest.raises(UsageError, match=r"tower 'mast' .* lies 11\d\.\d km from its site"):
        import_site([file], towers=towers)


def test_a_map_elsewhere_names_the_tower_option(tmp_path: Path) -> None:
    with pytest.raises(InputError) as refused:
        import_site([campus(tmp_path / "campus.geojson")])
    assert "--tower NAME=LATITUDE,LONGITUDE,HEIGHT" in (refused.value.expected or "")


def test_towers_replace_those_of_a_base(tmp_path: Path) -> None:
    near = campus(tmp_path / "near.geojson", 35.7275, -78.6960)
    model, _ = import_site([near], base="lake_wheeler", towers=["T1=35.7280,-78.6965,30"])
    assert list(model.towers) == ["T1"]
    assert model.origin.latitude_deg == pytest.approx(35.7275, abs=0.1)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("roof", "expected --tower NAME=LATITUDE,LONGITUDE,HEIGHT"),
        ("roof=1,2", "expected --tower NAME=LATITUDE,LONGITUDE,HEIGHT"),
        ("roof=151.2,-33.86,25", "longitude before latitude"),
        ("roof=-33.86,151.2,25000", "a height outside"),
        ("roof=-33.86,151.2,nan", "a height outside"),
        ("roof=33°51'36\"S,151°12'0\"E,25", "degrees and minutes, a unit or a decimal comma"),
        (" =-33.86,151.2,25", "expected --tower NAME=LATITUDE,LONGITUDE,HEIGHT"),
    ],
)
def test_a_tower_that_cannot_be_is_one_message(text: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=words):
        import_site([campus(tmp_path / "campus.geojson")], towers=[text])


def test_two_towers_of_one_name_are_refused(tmp_path: Path) -> None:
    twice = [f"roof={LATITUDE},{LONGITUDE},25"] * 2
    with pytest.raises(UsageError, match="two towers named 'roof'"):
        import_site([campus(tmp_path / "campus.geojson")], towers=twice)


TOWERS = (f"roof={LATITUDE},{LONGITUDE},25", f"mast={LATITUDE},{LONGITUDE + 4e-3},12")


def with_elevations(path: Path, elevations: dict[tuple[float, float], str]) -> Path:
    content = json.loads(campus(path).read_text())
    for (latitude, longitude), text in elevations.items():
        point = {"type": "Point", "coordinates": [longitude, latitude]}
        content["features"].append({"type": "Feature", "properties": {"ele": text}, "geometry": point})
    path.write_text(json.dumps(content))
    return path


def test_elevations_of_the_map_shape_the_ground(tmp_path: Path) -> None:
    """The ground rises by 50 m per 0.01 degrees to the east. One point 50 km away is ignored."""
    grid = [(LATITUDE + a, LONGITUDE + b) for a in (-5e-3, 0.0, 5e-3) for b in (-6e-3, -2e-3, 2e-3, 6e-3)]
    elevations = {place: f"{80 + 5000 * (place[1] - LONGITUDE):.1f} m" for place in grid} | {(-34.3, 151.2): "900"}
    model, actions = import_site([with_elevations(tmp_path / "c.geojson", elevations)], towers=TOWERS)
    (tmp_path / "site.yaml").write_text(site_yaml(model, header=actions))
    roof, mast = load_site(tmp_path / "site.yaml").towers.values()
    assert roof.position_m[2] == pytest.approx(25.0, abs=0.3)
    assert mast.position_m[2] == pytest.approx(20.0 + 12.0, abs=0.7)
    assert "a smooth surface through 12 elevations of the map" in actions[0]


def test_elevations_of_an_osm_file_are_read(tmp_path: Path) -> None:
    corners = [(LATITUDE, LONGITUDE), (LATITUDE, LONGITUDE + 4e-4), (LATITUDE + 4e-4, LONGITUDE + 4e-4)]
    nodes = "".join(f'<node id="{i}" lat="{a}" lon="{b}"/>' for i, (a, b) in enumerate(corners))
    tops = "".join(
        f'<node id="{9 + i}" lat="{LATITUDE + d}" lon="{LONGITUDE - d}"><tag k="natural" v="peak"/><tag k="ele" v="{h}"/></node>'
        for i, (d, h) in enumerate(((1e-3, "100"), (-1e-3, "110"), (3e-3, "high"), (5e-3, "120")))
    )
    way = "".join(f'<nd ref="{i}"/>' for i in (0, 1, 2, 0))
    text = f'<osm version="0.6">{nodes}{tops}<way id="1">{way}<tag k="building" v="yes"/></way></osm>'
    (tmp_path / "a.osm").write_text(text)
    model, _ = import_site([tmp_path / "a.osm"], towers=TOWERS)
    assert sorted(point[2] for point in model.ground_points) == [100.0, 110.0, 120.0]


def test_two_elevations_are_too_few_and_that_is_reported(tmp_path: Path) -> None:
    few = {(LATITUDE, LONGITUDE): "80", (LATITUDE, LONGITUDE + 1e-3): "90"}
    model, actions = import_site([with_elevations(tmp_path / "c.geojson", few)], towers=TOWERS)
    assert not model.ground_points
    assert "the ground is flat (the map has fewer than three elevations; --dem FILE" in actions[0]


def test_elevations_that_contradict_are_one_message(tmp_path: Path) -> None:
    heights = {(LATITUDE, LONGITUDE + 1e-8 * i): h for i, h in enumerate(("80", "240", "80"))}
    with pytest.raises(UsageError, match="disagree: 80 and 240 m"):
        import_site([with_elevations(tmp_path / "c.geojson", heights)], towers=TOWERS)


def test_an_elevation_file_is_the_ground(tmp_path: Path) -> None:
    """Cells have 0.001 degrees. The ground rises by 1 m per column to the east."""
    rows = "\n".join(" ".join(str(100 + column) for column in range(60)) for _ in range(60))
    head = f"ncols 60\nnrows 60\nxllcorner {LONGITUDE - 0.03}\nyllcorner {LATITUDE - 0.03}\ncellsize 0.001\n"
    (tmp_path / "ground.asc").write_text(head + rows)
    chosen = {"towers": TOWERS, "dem": tmp_path / "ground.asc"}
    model, actions = import_site([campus(tmp_path / "c.geojson")], dem_crs="EPSG:4326", **chosen)
    (tmp_path / "site.yaml").write_text(site_yaml(model, header=actions))
    roof, mast = load_site(tmp_path / "site.yaml").towers.values()
    assert mast.position_m[2] - roof.position_m[2] == pytest.approx(4.0 + 12.0 - 25.0, abs=0.1)
    assert "heights are above sea level" in actions[0]
    with pytest.raises(UsageError, match="names no coordinate system"):
        import_site([campus(tmp_path / "c.geojson")], **chosen)
    (tmp_path / "ground.asc").write_text(head.replace("151.17", "12.17") + rows)
    with pytest.raises(InputError, match=r"ground\.asc"):
        import_site([campus(tmp_path / "c.geojson")], dem_crs="EPSG:4326", **chosen)
