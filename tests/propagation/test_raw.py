"""The audit's own readers, geodesy, attitude and antenna tables against other ways to the same numbers."""

import math
from datetime import datetime, timezone

import numpy as np
import pytest
from pyproj import Geod
from scipy.spatial.transform import Rotation, Slerp

from aerpaw_cmp.propagation.check import raw
from aerpaw_cmp.site.sphere_pattern import read_sphere_csv, sphere_csv

ZONE = "America/New_York"
LW1 = (35.72750947, -78.69595819)


def microseconds(*moment: int) -> int:
    return int(datetime(*moment, tzinfo=timezone.utc).timestamp()) * 1_000_000


@pytest.mark.parametrize(
    ("text", "zone", "utc"),
    [
        ("2024-07-15 11:48:16.776", ZONE, microseconds(2024, 7, 15, 15, 48, 16) + 776_000),
        ("2023-12-13 12:33:07.150836", ZONE, microseconds(2023, 12, 13, 17, 33, 7) + 150_836),
        ("2026-05-29T11:01:52+00:00", ZONE, microseconds(2026, 5, 29, 11, 1, 52)),
        ("2026-05-29T11:01:52.5Z", ZONE, microseconds(2026, 5, 29, 11, 1, 52) + 500_000),
        ("2025-06-01 10:00:00", "UTC", microseconds(2025, 6, 1, 10)),
        ("1969-12-31 23:59:59.25", "UTC", -750_000),
    ],
)
def test_written_instants(text: str, zone: str, utc: int) -> None:
    assert raw.utc_us(text, zone) == utc


def test_places_are_those_of_the_geodesic() -> None:
    rng = np.random.default_rng(3)
    geod = Geod(ellps="WGS84")
    for _ in range(50):
        azimuth, away = rng.uniform(-180, 180), rng.uniform(0, 5000)
        longitude, latitude, _back = geod.fwd(LW1[1], LW1[0], azimuth, away)
        east, north = raw.east_north_m(latitude, longitude, LW1)
        assert math.hypot(east - away * math.sin(math.radians(azimuth)),
                          north - away * math.cos(math.radians(azimuth))) < 2e-3  # fmt: skip


def test_turns_between_rows_are_those_of_scipy() -> None:
    rng = np.random.default_rng(4)
    for _ in range(50):
        angles = np.column_stack([rng.uniform(-40, 40, (2, 2)), rng.uniform(-400, 400, 2)])
        ends = [Rotation.from_euler("ZYX", [90 - yaw, -pitch, roll], degrees=True) for roll, pitch, yaw in angles]
        share = rng.uniform()
        expected = Slerp([0, 1], Rotation.concatenate(ends))(share).as_matrix()
        turn = raw.between(*(raw.body_quaternion(*row) for row in angles), share)
        assert np.array(raw.matrix(turn)) == pytest.approx(expected, abs=1e-12)


def test_nose_up_lifts_the_nose_and_a_right_bank_drops_the_right_wing() -> None:
    north = np.array(raw.matrix(raw.body_quaternion(0, 0, 0)))
    assert north[:, 0] == pytest.approx([0, 1, 0])  # the nose of heading 0
    assert np.array(raw.matrix(raw.body_quaternion(0, 10, 0)))[2, 0] == pytest.approx(math.sin(math.radians(10)))
    right_wing = -np.array(raw.matrix(raw.body_quaternion(20, 0, 90)))[:, 1]
    assert right_wing[2] == pytest.approx(-math.sin(math.radians(20)))
    assert raw.level(raw.matrix(raw.body_quaternion(20, 10, 90)))[0][0] == pytest.approx(1.0)  # east


def test_a_table_of_gain_is_looked_up_alike_everywhere(tmp_path) -> None:
    rng = np.random.default_rng(5)
    gain = rng.uniform(-15, 5, (19, 36))
    file = tmp_path / "antenna.csv"
    file.write_text(sphere_csv(gain, np.ones_like(gain), ("a note",)), encoding="utf-8")
    pattern, mine = read_sphere_csv(file), raw.gain_table(file.read_bytes())
    for _ in range(200):
        theta, phi = math.acos(rng.uniform(-1, 1)), rng.uniform(-7, 7)
        expected = complex(pattern.field(np.array(theta), np.array(phi))[0])
        assert mine(theta, phi)[0] == pytest.approx(expected, abs=1e-9)


VEHICLE = b"""1,-78.6962896,35.727488,0.455,"(0.1,-0.2,0.3)","(0.0,0.0,0.01)",44.6,2025-05-24 16:18:34.118984,4,29\r
broken line\r
2,-78.6962896,35.727499,1.455,"(0.1,-0.2,0.3)","(0.0,0.0,0.01)",44.6,2025-05-24 16:18:35.118984,4,29\r
"""
POWER = b"""[2023-12-13 16:15:49.169530] 0000000       -34.86136
[2023-12-13 16:15:49.199953] *
[2023-12-13 16:15:49.232708] 0000010       -788.5956
[2023-12-13 16:15:49.846478] 0255450
"""


def test_a_line_of_each_format() -> None:
    vehicle, power = raw.read_log(VEHICLE, ZONE), raw.read_log(POWER, ZONE)
    assert vehicle is not None
    assert power is not None
    first, second = vehicle.rows
    assert (first.latitude_deg, first.longitude_deg, first.altitude_m) == (35.727488, -78.6962896, 0.455)
    assert first.angles_deg == pytest.approx([math.degrees(x) for x in (0.3, 0.1, -0.2)])  # roll, pitch, yaw
    assert second.time_us - first.time_us == 1_000_000
    assert {line: dict(reading.values) for line, reading in power.readings.items()} == {
        1: {"": -34.86136}, 2: {}, 3: {"": -788.5956},
    }  # fmt: skip
    assert raw.read_log(b"Orange;LTE;x", ZONE) is None


def test_rows_out_of_order_are_counted_and_a_gap_is_told() -> None:
    def row(seconds: float, altitude: float) -> raw.Row:
        return raw.Row(int(seconds * 1e6), *LW1, altitude, None)

    path = raw.RawPath([row(0, 0), row(2, 20), row(1, 50), row(2, 60), row(9, 90)], LW1, 3.0)
    assert (path.out_of_order, len(path.rows)) == (1, 3)
    pose = path.pose(1.5e6)
    assert pose is not None
    assert pose.place_m == pytest.approx((0, 0, 18.0), abs=1e-6)
    low = path.pose(0)
    assert low is not None
    assert low.place_m[2] == 3.5  # raised to half a metre above the take-off ground
    assert path.pose(9.1e6) is None
    assert path.pose(-1) is None
