"""A damaged file gives a result or one message, never another exception."""

import contextlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from aerpaw_cmp.common.errors import AerpawCmpError, InputError
from aerpaw_cmp.common.geodesy import SiteFrame
from aerpaw_cmp.site.antennas import read_gain_grid, read_pattern_text
from aerpaw_cmp.site.footprints import import_footprints

FRAME = SiteFrame(35.7275, -78.696)
GEOJSON = b"""{"type": "FeatureCollection", "features": [{"type": "Feature", "id": 7, "properties": {"building": "yes",
"height": "12 m", "building:levels": "2"}, "geometry": {"type": "Polygon", "coordinates": [[[-78.696, 35.7275],
[-78.695, 35.7275], [-78.695, 35.728], [-78.696, 35.7275]]]}}, {"type": "Feature", "properties": {"natural": "tree"},
"geometry": {"type": "Point", "coordinates": [-78.696, 35.7275]}}]}"""
OVERPASS = b"""{"elements": [{"type": "node", "id": 1, "lat": 35.7275, "lon": -78.696}, {"type": "node", "id": 2, "lat": 35.7276,
"lon": -78.696}, {"type": "node", "id": 3, "lat": 35.7276, "lon": -78.695}, {"type": "way", "id": 4, "nodes": [1, 2, 3, 1],
"tags": {"building": "yes"}}, {"type": "relation", "id": 5, "tags": {"type": "multipolygon", "natural": "wood"},
"members": [{"type": "way", "ref": 4, "role": "outer"}]}]}"""
OSM = b"""<osm><node id="1" lat="35.7275" lon="-78.696"/><node id="2" lat="35.7276" lon="-78.696"/><node id="3" lat="35.7276"
lon="-78.695"/><way id="4"><nd ref="1"/><nd ref="2"/><nd ref="3"/><nd ref="1"/><tag k="building" v="yes"/></way><relation
id="5"><member type="way" ref="4" role="outer"/><tag k="type" v="multipolygon"/><tag k="natural" v="wood"/></relation></osm>"""
KML = b"""<kml xmlns="http://www.opengis.net/kml/2.2"><Placemark><name>fence</name><ExtendedData><Data name="height"><value>3
</value></Data></ExtendedData><Polygon><outerBoundaryIs><LinearRing><coordinates>-78.696,35.7275,0 -78.695,35.7275,0
-78.695,35.728,0</coordinates></LinearRing></outerBoundaryIs></Polygon></Placemark></kml>"""
SITE = b"""name: test
origin: {latitude_deg: 35.7275, longitude_deg: -78.696, ground: {height_m: 79, reference: orthometric}}
towers:
  T: {latitude_deg: 35.7275, longitude_deg: -78.696, antenna_height_m: 11}
buildings:
- {name: a, height_m: 4, material: wood, polygon_m: [[10, 10], [20, 10], [20, 20]]}
forests:
- {name: w, polygon_deg: [[35.728, -78.697], [35.729, -78.697], [35.729, -78.696]], trees_per_hectare: 9}
trees: {seed: 3, height_m: 9, single: [{at_m: [50, 60]}]}
"""
DEM = b"ncols 3\nnrows 3\nxllcorner -150\nyllcorner -150\ncellsize 100\nNODATA_value -9999\n1 2 3\n4 5 6\n7 8 -9999\n"
PATTERN = (
    b"2\nFrequency=3300(MHz)\n\nPhi\tTheta\tE Total. dB\tE(Phi) . Amp dB\tE(Theta) . Amp dB\tE(Phi) . Phase\tE(Theta) . Phase\n"
    + "\n".join(
        f"{phi:.6f}\t{theta:.6f}\t-3.0103\t-6.0206\t-6.0206\t0.1\t{0.2 * phi:.3f}"
        for phi in np.arange(4) * np.pi / 4
        for theta in np.linspace(-np.pi, np.pi, 9)
    ).encode()
)

SPOIL = [b"", b"\xff", b"\x00", b"\n", *b'- 0 9e999 nan null [ } " < 1e30 true 180'.split()]


@settings(max_examples=50, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(place=st.floats(0, 1, exclude_max=True), spoil=st.sampled_from(SPOIL), truncate=st.booleans())
def test_mutilated_gain_grids_give_one_message(tmp_path: Path, place: float, spoil: bytes, truncate: bool) -> None:
    from scipy.io import savemat

    path = tmp_path / "g.mat"
    grid = {"theta2": np.linspace(90, -90, 7), "phi2": np.arange(12) * 30.0, "g": np.full((7, 12), -1.0)}
    savemat(path, grid)
    content = path.read_bytes()
    at = int(place * len(content))
    path.write_bytes(content[:at] if truncate else content[:at] + spoil + content[at + len(spoil) :])
    with contextlib.suppress(AerpawCmpError):
        read_gain_grid(path, "g")


def test_a_frequency_that_is_no_number_is_no_frequency(tmp_path: Path) -> None:
    (tmp_path / "p.txt").write_bytes(PATTERN.replace(b"3300", b"330-9223372036854775809"))
    with contextlib.suppress(AerpawCmpError):
        assert read_pattern_text(tmp_path / "p.txt") is not None


def test_an_integer_beyond_all_floats_is_no_coordinate(tmp_path: Path) -> None:
    (tmp_path / "m.json").write_bytes(GEOJSON.replace(b'"coordinates": [-78.696', b'"coordinates": [' + b"1" * 400))
    footprints = import_footprints([tmp_path / "m.json"], FRAME)
    assert len(footprints.buildings) == 1
    assert any("feature 2 was left out" in action for action in footprints.actions)


@pytest.mark.parametrize("rows", [1, 9])
def test_rows_that_are_no_grid_over_the_sphere_are_refused(tmp_path: Path, rows: int) -> None:
    head, _, _ = PATTERN.partition(b"\n0.0")
    body = b"".join(b"%.5f\t-3.141593\t-3.0103\t-6.0206\t-6.0206\t0.1\t0.1\n" % (i / 9) for i in range(rows))
    (tmp_path / "p.txt").write_bytes(head + b"\n" + body)
    with pytest.raises(InputError, match="every phi with every theta"):
        read_pattern_text(tmp_path / "p.txt")
