"""Poses at any instant."""

from __future__ import annotations

import numpy as np
import pandas as pd

from aerpaw_cmp.geodesy import SiteFrame
from aerpaw_cmp.replay.arrays import rotation_from_aircraft
from aerpaw_cmp.track import Track, body_rotation

FRAME = SiteFrame(35.7275, -78.6960)
START = np.datetime64("2024-07-15T15:48:16", "ns")


def telemetry(seconds, east, north, up, **columns) -> pd.DataFrame:
    seconds = np.asarray(seconds, dtype=float)
    latitude, longitude = FRAME.to_geographic(
        np.broadcast_to(east, seconds.shape), np.broadcast_to(north, seconds.shape)
    )
    data = {
        "time": START + (seconds * 1e9).astype("timedelta64[ns]"),
        "line": np.arange(len(seconds)) + 1,
        "flag": "",
        "latitude_deg": latitude,
        "longitude_deg": longitude,
        "altitude_m": np.broadcast_to(up, seconds.shape).astype(float),
        "fix": 3,
        "satellites": 12,
    }
    for name in ("roll_deg", "pitch_deg", "yaw_deg", "velocity_north_mps", "velocity_east_mps", "velocity_down_mps"):
        data[name] = np.broadcast_to(np.asarray(columns.get(name, np.nan), dtype=float), seconds.shape)
    return pd.DataFrame(data)


def at(seconds) -> np.ndarray:
    return START + (np.asarray(seconds, dtype=float) * 1e9).astype("timedelta64[ns]")


def test_straight_flight_is_interpolated_exactly():
    t = np.arange(0.0, 20.0, 1.0)
    track = Track(telemetry(t, 5 * t, -3 * t, 10 + t, roll_deg=0, pitch_deg=0, yaw_deg=30.0), FRAME)
    asked = np.array([0.0, 0.25, 7.77, 19.0])
    poses = track.pose_at(at(asked))
    assert poses.valid.all()
    np.testing.assert_allclose(poses.position_m, np.column_stack([5 * asked, -3 * asked, 10 + asked]), atol=1e-4)
    np.testing.assert_allclose(poses.velocity_mps, [[5, -3, 1]] * 4, atol=1e-4)


def test_body_rotation_is_the_replay_convention():
    roll, pitch, yaw = np.random.default_rng(5).uniform(-180, 180, (3, 200))
    np.testing.assert_allclose(body_rotation(roll, pitch, yaw), rotation_from_aircraft(roll, pitch, yaw), atol=1e-14)


def test_attitude_goes_the_short_way_round_north():
    track = Track(telemetry([0, 1], 0, 0, 10, roll_deg=2.0, pitch_deg=-1.0, yaw_deg=[350.0, 10.0]), FRAME)
    np.testing.assert_allclose(track.pose_at(at([0.5])).heading_deg % 360, [0.0], atol=0.05)
    # and at the stamps it is the logged attitude
    np.testing.assert_allclose(
        track.pose_at(at([0, 1])).rotation, rotation_from_aircraft([2, 2], [-1, -1], [350, 10]), atol=1e-12
    )


def test_gaps_are_not_bridged():
    track = Track(telemetry([0, 1, 2, 9, 10], 0, 0, 10, roll_deg=1, pitch_deg=0, yaw_deg=0), FRAME, maximum_gap_s=3)
    poses = track.pose_at(at([-0.1, 0, 2, 2.01, 8.99, 9, 10, 10.5]))
    assert poses.valid.tolist() == [False, True, True, False, False, True, True, False]
    assert poses.reason.tolist() == [
        "before telemetry",
        "",
        "",
        "telemetry gap",
        "telemetry gap",
        "",
        "",
        "after telemetry",
    ]
    assert np.isnan(poses.position_m[3]).all()
    assert np.isnan(poses.rotation[3]).all()
    assert track.account.gaps == 1
    assert track.account.longest_gap_s == 7.0


def test_low_poses_are_raised_to_half_a_metre():
    track = Track(telemetry([0, 1, 2], 0, 0, [-3.9, 0.2, 0.8], roll_deg=1, pitch_deg=0, yaw_deg=0), FRAME)
    poses = track.pose_at(at([0, 1, 1.9]))
    np.testing.assert_allclose(poses.position_m[:, 2], [0.5, 0.5, 0.74])
    assert poses.raised.tolist() == [True, True, False]
