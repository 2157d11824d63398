"""The audit's own readers, geodesy, attitude and antenna tables against other ways to the same numbers."""

import io
import math
from datetime import datetime, timezone

import numpy as np
import pytest
from pyproj import Geod
from scipy.io import savemat
from scipy.spatial.transform import Rotation, Slerp

from aerpaw_cmp.propagation.check.reference import gain_table
from aerpaw_cmp.site.antenna.sphere_pattern import read_sphere_csv, sphere_csv
from tests import raw_bytes as raw

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
    pattern, mine = read_sphere_csv(file), gain_table(file.read_bytes())
    for _ in range(200):
        theta, phi = math.acos(rng.uniform(-1, 1)), rng.uniform(-7, 7)
        expected = complex(pattern.field(np.array(theta), np.array(phi))[0])
        assert mine(theta, phi)[0] == pytest.approx(expected, abs=1e-9)


VEHICLE = b"""1,-78.6962896,35.727488,0.455,"(0.1,-0.2,0.3)","(0.0,0.0,0.01)",44.6,2025-05-24 16:18:34.118984,4,29\r
broken line\r
9,-78.6962896,east,0.455,"(0.1,-0.2,0.3)","(0.0,0.0,0.01)",44.6,2025-05-24 16:18:34.518984,4,29\r
2,-78.6962896,35.727499,1.455,"(0.1,-0.2,0.3)","(0.0,0.0,0.01)",44.6,2025-05-24 16:18:35.118984,4,29\r
"""
POWER = b"""[2023-12-13 16:15:49.169530] 0000000       -34.86136
[2023-12-13 16:15:49.199953] *
[2023-12-13 16:15:49.210000] 0000008       -3x
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
        1: {"": -34.86136}, 2: {}, 4: {"": -788.5956},
    }  # fmt: skip
    assert raw.read_log(b"Orange;LTE;x", ZONE) is None


TABLE = b"""Stamp, Latitude,Longitude,Altitude,Roll,Pitch,Yaw,rsrp
2024-07-15 11:48:16.5,35.7,-78.6,12.5,0.1,0.2,0.3,-80.5
no stamp,35.7,-78.6,12.5,0.1,0.2,0.3,-70
2024-07-15 11:48:17.5,35.7,-78.6,12.5,0.1,0.2,0.3
2024-07-15 11:48:18.5,35.8,-78.6,13.5,,0.2,0.3,low
2024-07-15 11:48:19.5,35.9,-78.6,,0.1,0.2,0.3,-60
"""


def test_a_table_and_a_merged_file_have_their_rows_and_readings() -> None:
    noon = microseconds(2024, 7, 15, 15, 48, 16) + 500_000
    table = raw.read_log(TABLE, ZONE)
    assert table is not None
    turned_row, plain_row = table.rows  # the others have no instant, too few cells or no height
    assert (turned_row.time_us, turned_row.latitude_deg, turned_row.longitude_deg, turned_row.altitude_m) == (
        noon,
        35.7,
        -78.6,
        12.5,
    )
    assert turned_row.angles_deg == pytest.approx([math.degrees(x) for x in (0.1, 0.2, 0.3)])
    assert (plain_row.time_us, plain_row.latitude_deg, plain_row.angles_deg) == (noon + 2_000_000, 35.8, None)
    assert {line: (reading.time_us - noon, reading.values.get("rsrp")) for line, reading in table.readings.items()} == {
        2: (0, -80.5), 5: (2_000_000, None), 6: (3_000_000, -60.0),
    }  # fmt: skip
    columns = {"mX": [-78.6, -78.7], "mY": [35.7, 35.8], "mZ": [12.5, 13.5], "rsrp": [-80.5, -60.0], "few": [1.0]}
    turned = {"mRoll": [1.0, 4.0], "mPitch": [2.0, 5.0], "mYaw": [3.0, 6.0]}
    stamps = {"timestamp_for_csv": np.array(["2024-07-15 11:48:16.5", "2024-07-15 11:48:18.5"])}
    for more, angles in ((turned, (4.0, 5.0, 6.0)), ({"mRoll": [1.0, 4.0]}, None)):
        file = io.BytesIO()
        savemat(file, columns | more | stamps | {"count": np.array([7, 8])})
        merged = raw.read_log(file.getvalue(), ZONE)
        assert merged is not None
        assert merged.rows[1] == raw.Row(noon + 2_000_000, 35.8, -78.7, 13.5, angles)
        assert (merged.rows[0].time_us, len(merged.rows), set(merged.readings)) == (noon, 2, {1, 2})
        assert merged.readings[2].time_us == noon + 2_000_000
        assert merged.readings[2].values.get("rsrp") == -60.0
        assert not {"few", "count"} & set(merged.readings[2].values)
    for lacking in (columns, stamps | {"mX": [1.0, 2.0]}):
        file = io.BytesIO()
        savemat(file, lacking)
        assert raw.read_log(file.getvalue(), ZONE) is None


def test_a_pose_needs_places_on_the_earth_and_known_turns() -> None:
    def row(seconds: int, latitude: float = LW1[0], longitude: float = LW1[1], up: float = 9.0, angles=None) -> raw.Row:
        return raw.Row(seconds * 1_000_000, latitude, longitude, up, angles)

    good = [row(1, 90.0), row(2, -90.0), row(3, 5, 180.0), row(4, 5, -180.0), row(5, 0.0, 5.0), row(6, 5.0, 0.0),
            row(7, up=-899.0)]  # fmt: skip
    bad = [row(8, 90.1), row(9, -90.1), row(10, 5, 180.1), row(11, 0.0, 0.0), row(12, up=-900.0), row(13, math.nan)]
    path = raw.RawPath(good + bad, LW1, 0.0)
    assert (path.rows, path.out_of_order) == (good, 0)
    ends = [(10.0, 5.0, 80.0), (20.0, -5.0, 100.0)]
    for first, known in ((ends[0], True), (None, False), ((0.0, 0.0, 0.0), False), ((math.inf, 1.0, 2.0), False)):
        pose = raw.RawPath([row(3, angles=first), row(7, angles=ends[1])], LW1, 0.0).pose(4e6)
        assert pose is not None
        assert (pose.turn is not None) == known
        if pose.turn is not None:
            turns = [Rotation.from_euler("ZYX", [90 - yaw, -pitch, roll], degrees=True) for roll, pitch, yaw in ends]
            expected = Slerp([0, 4], Rotation.concatenate(turns))(1).as_matrix()
            assert np.array(pose.turn) == pytest.approx(expected, abs=1e-12)
    still = raw.RawPath([row(3, angles=ends[0]), row(7, angles=ends[0])], LW1, 0.0).pose(4e6)
    assert still is not None
    assert np.array(still.turn) == pytest.approx(np.array(raw.matrix(raw.body_quaternion(*ends[0]))))
    alone = raw.RawPath([row(3, up=0.4)], LW1, 2.0)
    assert alone.pose(3e6) is not None
    assert alone.pose(3e6).place_m == pytest.approx((0.0, 0.0, 2.5), abs=1e-6)  # type: ignore[union-attr]
    assert raw.RawPath([], LW1, 0.0).pose(0) is None


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
