"""A site from a map and a tower anywhere on Earth, without a base site."""

import json
from pathlib import Path

import pytest
from shapely.geometry import Point

from aerpaw_cmp.common.errors import InputError, UsageError
from aerpaw_cmp.site.footprints import import_site, site_yaml
from aerpaw_cmp.site.siteyaml import load_site

LATITUDE, LONGITUDE = -33.86, 151.2


def campus(path: Path, latitude: float = LATITUDE, longitude: float = LONGITUDE) -> Path:
    """One building of 20 m, about 37 m x 44 m, whose south-west corner is at a position."""
    ring = [(longitude, latitude), (longitude + 4e-4, latitude), (longitude + 4e-4, latitude + 4e-4)]
    ring += [(longitude, latitude + 4e-4), ring[0]]
    feature = {"type": "Feature", "properties": {"building": "yes", "height": "20", "name": "hall"}}
    feature["geometry"] = {"type": "Polygon", "coordinates": [[list(point) for point in ring]]}
    path.write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}))
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
        ("roof=151.2,-33.86,25", "the two are swapped"),
        ("roof=-33.86,151.2,25000", "a height outside"),
        ("roof=-33.86,151.2,nan", "a height outside"),
    ],
)
def test_a_tower_that_cannot_be_is_one_message(text: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=words):
        import_site([campus(tmp_path / "campus.geojson")], towers=[text])


def test_two_towers_of_one_name_are_refused(tmp_path: Path) -> None:
    twice = [f"roof={LATITUDE},{LONGITUDE},25"] * 2
    with pytest.raises(UsageError, match="two towers named 'roof'"):
        import_site([campus(tmp_path / "campus.geojson")], towers=twice)
