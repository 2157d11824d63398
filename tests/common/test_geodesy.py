"""The site frame: against geodesics, there and back, and in the shape that was asked for."""

import numpy as np
import pytest
from pyproj import Geod

from aerpaw_cmp.common.geodesy import SiteFrame, azimuth_rad, bearing_deg, elevation_rad

ORIGIN = (35.72750947, -78.69595819)
FRAME = SiteFrame(*ORIGIN)


def test_distance_and_direction_from_the_origin_are_those_of_the_geodesic() -> None:
    rng = np.random.default_rng(3)
    azimuth_deg, distance_m = rng.uniform(-180, 180, 200), rng.uniform(0, 3000, 200)
    at = np.full(200, ORIGIN[1]), np.full(200, ORIGIN[0])
    longitude, latitude, _ = Geod(ellps="WGS84").fwd(*at, azimuth_deg, distance_m)
    east, north = FRAME.to_local(latitude, longitude)
    assert np.hypot(east, north) == pytest.approx(distance_m, abs=1e-6)
    turned = np.radians(azimuth_deg)
    assert np.column_stack([east, north]) == pytest.approx(
        distance_m[:, None] * np.column_stack([np.sin(turned), np.cos(turned)]), abs=1e-6
    )


def test_between_two_places_of_a_site_the_distance_is_that_of_the_geodesic_to_a_millimetre() -> None:
    rng = np.random.default_rng(4)
    places = rng.uniform(-2100, 2100, (2, 2, 300))  # end, east and north
    (lat_a, lon_a), (lat_b, lon_b) = (FRAME.to_geographic(*place) for place in places)
    _, _, distance_m = Geod(ellps="WGS84").inv(lon_a, lat_a, lon_b, lat_b)
    assert np.hypot(*(places[0] - places[1])) == pytest.approx(distance_m, abs=1e-3)


@pytest.mark.parametrize("shape", [(), (0,), (1,), (1, 1), (2,), (2, 3)])
@pytest.mark.filterwarnings("error")
def test_places_come_back_in_their_shape(shape: tuple[int, ...]) -> None:
    """pyproj up to 3.7.1 treats an array of one element as a number, with a warning of NumPy."""
    rng = np.random.default_rng(5)
    east, north = rng.uniform(-2000, 2000, shape), rng.uniform(-2000, 2000, shape)
    latitude, longitude = FRAME.to_geographic(east, north)
    back = FRAME.to_local(latitude, longitude)
    assert np.shape(latitude) == np.shape(longitude) == shape
    assert [coordinate.shape for coordinate in back] == [shape, shape]
    assert back[0] == pytest.approx(east, abs=1e-6)
    assert back[1] == pytest.approx(north, abs=1e-6)


def test_one_longitude_for_many_latitudes() -> None:
    east, north = FRAME.to_local([[35.727], [35.728]], [-78.696, -78.697, -78.698])
    assert east.shape == north.shape == (2, 3)
    assert np.diff(north, axis=0) == pytest.approx(np.full((1, 3), 110.95), abs=0.1)


def test_bearings_turn_with_the_clock_and_azimuths_against_it() -> None:
    """A vector computed from a bearing has that bearing, and its azimuth is 90 degrees minus the bearing."""
    bearing = np.linspace(-179.0, 180.0, 360)
    turned, up = np.radians(bearing), np.radians(np.linspace(-90.0, 90.0, 360))
    vectors = 7.0 * np.column_stack([np.cos(up) * np.sin(turned), np.cos(up) * np.cos(turned), np.sin(up)])
    flat = slice(1, -1)  # straight up and down have no bearing
    assert bearing_deg(vectors)[flat] == pytest.approx(bearing[flat], abs=1e-9)
    assert np.exp(1j * azimuth_rad(vectors)[flat]) == pytest.approx(np.exp(1j * (np.pi / 2 - turned[flat])), abs=1e-12)
    assert elevation_rad(vectors) == pytest.approx(up, abs=1e-12)
    assert bearing_deg(vectors[7]) == bearing_deg(vectors[:8, :2])[7]


def test_what_is_no_place_stays_none() -> None:
    east, north = FRAME.to_local([35.7, np.nan, np.inf, 35.7], [-78.7, -78.7, -78.7, np.nan])
    assert np.isnan(east).tolist() == np.isnan(north).tolist() == [False, True, True, True]
    assert np.isnan(FRAME.to_local(np.nan, -78.7)).all()
