"""Poses at any instant."""

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from aerpaw_cmp.common.geodesy import SiteFrame
from aerpaw_cmp.flight import track as tracks
from aerpaw_cmp.flight.track import Track, good_positions, velocities_mps
from aerpaw_cmp.propagation.geometry import rotation_from_aircraft

FRAME = SiteFrame(35.7275, -78.6960)


def body_rotation(roll_deg, pitch_deg, yaw_deg):
    """The rotation of an aircraft by scipy: turned about up from east, then about left, then about the nose."""
    angles = np.stack([90.0 - np.asarray(yaw_deg), -np.asarray(pitch_deg), np.asarray(roll_deg)], axis=-1)
    return Rotation.from_euler("ZYX", angles, degrees=True).as_matrix()


START = np.datetime64("2024-07-15T15:48:16", "ns")


def telemetry(seconds, east, north, up, **columns) -> pd.DataFrame:
    seconds = np.asarray(seconds, dtype=float)
    latitude, longitude = FRAME.to_geographic(
        np.broadcast_to(east, seconds.shape), np.broadcast_to(north, seconds.shape)
    )
    data = {
        "time": START + (seconds * 1e9).astype("timedelta64[ns]"), "line": np.arange(len(seconds)) + 1, "flag": "",
        "latitude_deg": latitude, "longitude_deg": longitude, "fix": 3, "satellites": 12,
        "altitude_m": np.broadcast_to(up, seconds.shape).astype(float),
    }  # fmt: skip
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
    np.testing.assert_allclose(track._velocity, [[5, -3, 1]] * 20, atol=1e-4)


def test_the_rotation_of_an_aircraft_is_that_of_scipy():
    roll, pitch, yaw = np.random.default_rng(5).uniform(-180, 180, (3, 200))
    np.testing.assert_allclose(body_rotation(roll, pitch, yaw), rotation_from_aircraft(roll, pitch, yaw), atol=1e-14)


_LOGGED = [
    (2, -5, -100), (2, -5, -10), (7, 9, 11), (2, 5, 100), (-2, -5, 100),
    (2, 100, -5), (100, -5, 2), (-5, 2, 100), (100, 2, -5), (-5, 100, 2),
]  # fmt: skip


@pytest.mark.parametrize(("misread", "logged"), list(zip(tracks.MISREAD, _LOGGED, strict=True)))
def test_a_misread_attitude_is_brought_back(misread, logged):
    """Roll 2, pitch -5 and yaw 100 degrees are logged in ten wrong ways. In the third way, the course alone is used."""
    t, turn = np.arange(5.0), body_rotation(0, 0, 100) if logged == (7, 9, 11) else body_rotation(2, -5, 100)
    way, (roll, pitch, yaw) = 9 * body_rotation(0, 0, 100)[:, 0], logged
    track = Track(telemetry(t, way[0] * t, way[1] * t, 10, roll_deg=roll, pitch_deg=pitch, yaw_deg=yaw), FRAME)
    np.testing.assert_allclose(track.rotations_if(misread, at(t)), np.stack([turn] * 5), atol=1e-4)
    np.testing.assert_allclose(track.pose_at(at(t)).rotation[0], body_rotation(*logged), atol=1e-9)


def test_attitude_goes_the_short_way_round_north():
    track = Track(telemetry([0, 1], 0, 0, 10, roll_deg=2.0, pitch_deg=-1.0, yaw_deg=[350.0, 10.0]), FRAME)
    np.testing.assert_allclose(track.pose_at(at([0.5])).heading_deg % 360, [0.0], atol=0.05)
    # and at the stamps it is the logged attitude
    np.testing.assert_allclose(
        track.pose_at(at([0, 1])).rotation, body_rotation([2, 2], [-1, -1], [350, 10]), atol=1e-12
    )


def test_gaps_are_not_bridged():
    track = Track(telemetry([0, 1, 2, 9, 10], 0, 0, 10, roll_deg=1, pitch_deg=0, yaw_deg=0), FRAME, maximum_gap_s=3)
    poses = track.pose_at(at([-0.1, 0, 2, 2.01, 8.99, 9, 10, 10.5]))
    assert poses.valid.tolist() == [False, True, True, False, False, True, True, False]
    gap = ["telemetry gap"] * 2
    assert poses.reason.tolist() == ["before telemetry", "", "", *gap, "", "", "after telemetry"]
    assert np.isnan(poses.position_m[3]).all()
    assert np.isnan(poses.rotation[3]).all()
    assert track.account.gaps == 1
    assert track.account.longest_gap_s == 7.0
    wide = Track(telemetry([0, 1, 2, 9, 10], 0, 0, 10), FRAME, maximum_gap_s=7)
    assert wide.account.gaps == 0
    assert wide.pose_at(at([5.0])).valid.all()


def test_low_poses_are_raised_to_half_a_metre():
    track = Track(telemetry([0, 1, 2], 0, 0, [-3.9, 0.2, 0.8], roll_deg=1, pitch_deg=0, yaw_deg=0), FRAME)
    poses = track.pose_at(at([0, 1, 1.9]))
    np.testing.assert_allclose(poses.position_m[:, 2], [0.5, 0.5, 0.74])
    ground = telemetry([0, 1], 0, 0, [0.0, 20.0], roll_deg=1, pitch_deg=0, yaw_deg=0)  # heights shift with it
    np.testing.assert_allclose(Track(ground, FRAME, ground_m=7.0).pose_at(at([0, 1])).position_m[:, 2], [7.5, 27.0])


# --- rows that lie ---


def test_bad_positions_are_left_out_and_counted():
    frame = telemetry(np.arange(8.0), 3.0 * np.arange(8), 0, 10, roll_deg=1, pitch_deg=0, yaw_deg=0)
    frame.loc[1, ["latitude_deg", "longitude_deg", "altitude_m"]] = -999.0
    frame.loc[2, "latitude_deg"] = np.nan
    frame.loc[3, ["latitude_deg", "longitude_deg"]] = 0.0
    frame.loc[6, "longitude_deg"] = -999.0
    track = Track(frame, FRAME, maximum_gap_s=5.0)
    assert track.account.bad_position == 4
    poses = track.pose_at(at([0.5, 2, 6]))
    np.testing.assert_allclose(poses.position_m[:, 0], [1.5, 6, 18], atol=1e-4)
    # with the usual limit, the hole is not bridged
    assert Track(frame, FRAME).pose_at(at([2])).reason.tolist() == ["telemetry gap"]
    assert any("without a position" in text for text in track.account.warnings)


def test_duplicate_and_backward_stamps():
    seconds = np.array([0, 1, 1, 2, 1.5, 3, 4])
    track = Track(telemetry(seconds, seconds, 0, 10, roll_deg=1, pitch_deg=0, yaw_deg=0), FRAME)
    assert len(track) == 6  # the row at 1.5 s was written late; its stamp agrees with its place
    account = track.account
    assert (account.duplicate_time, account.backward_time, account.steps_sorted) == (1, 0, 1)
    np.testing.assert_allclose(track.pose_at(at([2.5])).position_m[:, 0], [2.5], atol=1e-4)
    # one wild stamp in the future condemns itself, not the rows after it
    seconds = np.array([0, 1, 900, 2, 3, 4.0])
    track = Track(telemetry(seconds, [0, 1, 2, 2, 3, 4], 0, 10, roll_deg=1, pitch_deg=0, yaw_deg=0), FRAME)
    assert len(track) == 5
    assert track.account.backward_time == 1
    assert track.end_ns - track.start_ns == 4_000_000_000


@pytest.mark.parametrize(
    "order", [np.random.default_rng(3).permutation(60), np.arange(60)[::-1], np.roll(np.arange(60), 25)]
)
def test_a_shuffled_log_is_the_log_in_order(order):
    seconds = np.arange(60.0)
    east = 40 * np.sin(seconds / 9)
    ordered = telemetry(seconds, east, 3 * seconds, 10, roll_deg=1, pitch_deg=seconds / 10, yaw_deg=seconds)
    in_order, shuffled = Track(ordered, FRAME), Track(ordered.iloc[order].reset_index(drop=True), FRAME)
    asked = at(np.arange(0, 59, 0.7))
    np.testing.assert_array_equal(shuffled.pose_at(asked).position_m, in_order.pose_at(asked).position_m)
    np.testing.assert_array_equal(shuffled.pose_at(asked).rotation, in_order.pose_at(asked).rotation)
    assert (shuffled.account.backward_time, in_order.account.steps_sorted) == (0, 0)
    assert any("sorted by time" in text for text in shuffled.account.warnings)


def test_poses_asked_twice_are_those_of_the_instants():
    track = Track(telemetry(np.arange(9.0), 3.0 * np.arange(9), 0, 10, roll_deg=1, pitch_deg=0, yaw_deg=0), FRAME)
    instants = np.array(at([1, 2]), dtype="datetime64[ns]")
    first = track.pose_at(instants)
    instants += np.timedelta64(1, "s")  # the caller's own array, moved in place
    np.testing.assert_allclose(track.pose_at(instants).position_m[:, 0], [6, 9], atol=1e-4)
    with pytest.raises(ValueError, match="read-only"):
        first.position_m[0] = 0.0


def test_a_clock_set_back_in_flight_does_not_mix_its_parts():
    seconds = np.arange(0, 100.0)
    stepped = np.where(seconds >= 70, seconds - 30.5, seconds)
    track = Track(telemetry(stepped, 3 * seconds, 0, 10, roll_deg=1, pitch_deg=0, yaw_deg=0), FRAME)
    assert (track.account.steps_sorted, track.account.backward_time) == (0, 30)


def test_a_daylight_saving_change_in_flight_is_named():
    local = np.arange(0, 600.0)
    fell_back = np.where(local >= 200, local - 3600.0, local)  # clocks go back an hour in flight
    track = Track(telemetry(fell_back, local, 0, 10, roll_deg=1, pitch_deg=0, yaw_deg=0), FRAME)
    assert track.account.hour_steps == 1
    assert len(track) == 400  # the longer part is kept, nothing is mixed up
    assert any("daylight-saving" in text for text in track.account.warnings)
    sprang_forward = np.where(local >= 200, local + 3600.0, local)
    track = Track(telemetry(sprang_forward, local, 0, 10, roll_deg=1, pitch_deg=0, yaw_deg=0), FRAME)
    assert track.account.hour_steps == 1
    assert track.pose_at(at([1000.0])).reason.tolist() == ["telemetry gap"]
    assert Track(telemetry(local, local, 0, 10), FRAME).account.hour_steps == 0


def test_missing_times():
    frame = telemetry(np.arange(5.0), 0, 0, 10)
    frame.loc[2, "time"] = pd.NaT
    track = Track(frame, FRAME)
    assert track.account.no_time == 1
    poses = track.pose_at(np.array(["NaT", "2024-07-15T15:48:17"], dtype="datetime64[ns]"))
    assert poses.reason.tolist() == ["no time", ""]


def test_no_row_at_all_and_a_single_one():
    empty = Track(telemetry([], 0, 0, 10), FRAME)
    poses = empty.pose_at(at([0, 1]))
    assert poses.reason.tolist() == ["no telemetry"] * 2
    assert not poses.valid.any()
    single = Track(telemetry([5.0], 1.0, 2.0, 30.0, roll_deg=1, pitch_deg=0, yaw_deg=90), FRAME)
    poses = single.pose_at(at([4.9, 5.0, 5.1]))
    assert poses.valid.tolist() == [False, True, False]
    np.testing.assert_allclose(poses.position_m[1], [1, 2, 30], atol=1e-4)
    assert poses.heading_deg[1] == pytest.approx(90)
    assert len(single.pose_at(at([]))) == 0


def test_asked_instants_come_in_any_order_and_kind():
    t = np.arange(0.0, 10.0)
    track = Track(telemetry(t, 2 * t, 0, 10, roll_deg=1, pitch_deg=0, yaw_deg=0), FRAME)
    stamps = at([7.5, 0.5, 3.25])
    expected = [15, 1, 6.5]
    for asked in (stamps, stamps.astype("datetime64[ms]"), pd.Series(stamps), stamps.astype(np.int64) * 1e-9,
                  np.array([pd.Timestamp(s, tz="UTC") for s in stamps], dtype=object)):  # fmt: skip
        np.testing.assert_allclose(track.pose_at(asked).position_m[:, 0], expected, atol=1e-3)


# --- attitude ---


def test_slerp_turns_at_constant_rate():
    track = Track(telemetry([0, 2], 0, 0, 10, roll_deg=[0, 40.0], pitch_deg=0, yaw_deg=[20.0, 20.0]), FRAME)
    rotation = track.pose_at(at([0.5])).rotation[0]
    np.testing.assert_allclose(rotation, rotation_from_aircraft(10.0, 0.0, 20.0), atol=1e-12)
    # any attitude: halfway is the same turn from both ends
    rng = np.random.default_rng(0)
    roll, pitch, yaw = rng.uniform(-60, 60, (3, 2))
    track = Track(telemetry([0, 1], 0, 0, 10, roll_deg=roll, pitch_deg=pitch, yaw_deg=yaw), FRAME)
    first, half, last = track.pose_at(at([0, 0.5, 1])).rotation
    np.testing.assert_allclose(first.T @ half, half.T @ last, atol=1e-12)
    np.testing.assert_allclose(half @ half.T, np.eye(3), atol=1e-12)


@pytest.mark.parametrize("attitude", [np.nan, 0.0])
def test_unknown_attitude_is_level_flight_along_the_course(attitude):
    t = np.arange(0.0, 30.0)
    frame = telemetry(t, 4 * t, 3 * t, 10, roll_deg=attitude, pitch_deg=attitude, yaw_deg=attitude)
    track = Track(frame, FRAME)
    poses = track.pose_at(at([10.5]))
    assert not poses.attitude_known.any()
    np.testing.assert_allclose(poses.rotation[0], rotation_from_aircraft(0, 0, np.degrees(np.arctan2(4, 3))), atol=1e-4)
    assert track.account.unknown_attitude == 30
    # hovering says nothing about the heading: the last course holds
    hover = telemetry(t, np.minimum(4 * t, 40), 0, 10)
    assert Track(hover, FRAME).pose_at(at([25])).heading_deg[0] == pytest.approx(90, abs=0.1)


def test_logged_velocity_is_used_where_it_exists():
    t = np.arange(0.0, 10.0)
    speed = {"velocity_north_mps": 0.0, "velocity_east_mps": -5.0, "velocity_down_mps": 1.0}
    track = Track(telemetry(t, 0, 0, 10, **speed), FRAME)
    np.testing.assert_allclose(track._velocity, [[-5, 0, -1]] * 10)
    assert track.pose_at(at([4.2])).heading_deg[0] == pytest.approx(270)


def test_attitude_known_in_part():
    t = np.arange(0.0, 20.0)
    yaw = np.where(t < 10, 30.0, np.nan)
    poses = Track(telemetry(t, 0, 5 * t, 10, roll_deg=1, pitch_deg=0, yaw_deg=yaw), FRAME).pose_at(at([5, 15]))
    assert poses.attitude_known.tolist() == [True, False]
    np.testing.assert_allclose(poses.heading_deg, [30, 0], atol=0.1)


def test_velocities_that_no_log_holds_are_slopes_over_two_seconds_on_either_side():
    t = np.array([0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 11.0])
    frame = telemetry(t, t**2, 0, 10)
    frame["velocity_east_mps"] = [np.nan, *[0.0] * 7]  # converters write zeros for unknown
    frame["velocity_north_mps"] = frame["velocity_down_mps"] = 0.0
    east = Track(frame, FRAME, maximum_gap_s=9.0)._velocity[:, 0]
    # the row before a gap reaches over it, to the next row
    np.testing.assert_allclose(
        east, [4 / 2, 9 / 3, 16 / 4, 24 / 4, 32 / 4, (53 - 9) / 4, (121 - 16) / 7, 85 / 5], atol=1e-3
    )
    two_rows = Track(telemetry([0.0, 2.0], [0.0, 6.0], 0, 10), FRAME)
    np.testing.assert_allclose(two_rows._velocity, [[3.0, 0.0, 0.0]] * 2, atol=1e-4)
    slow = Track(telemetry([0.0, 1.0, 2.0], [0.0, 0.99, 1.98], 0, 10), FRAME)
    assert slow.pose_at(at([1.0])).heading_deg[0] == pytest.approx(0.0)  # below a metre a second nothing has a course
    fast = Track(telemetry([0.0, 1.0, 2.0], [0.0, 1.01, 2.02], 0, 10), FRAME)
    assert fast.pose_at(at([1.0])).heading_deg[0] == pytest.approx(90.0)


def test_long_series_of_instants_are_asked_in_parts(monkeypatch):
    track = Track(telemetry(np.arange(9.0), 5 * np.arange(9.0), 0, 10, roll_deg=1, pitch_deg=0, yaw_deg=20.0), FRAME)
    instants = at(np.linspace(-1.0, 9.0, 11))
    at_once = track.pose_at(instants)
    monkeypatch.setattr(tracks, "AT_ONCE", 4)
    parts = track.pose_at(instants)
    np.testing.assert_array_equal(parts.position_m, at_once.position_m)
    np.testing.assert_array_equal(parts.reason, at_once.reason)
    some = at_once.pick(at_once.valid)
    assert len(some) == 9
    placed = some.where(np.arange(9) % 2 == 0)
    assert placed.valid.tolist() == [True, False] * 4 + [True]
    assert np.isnan(placed.position_m[1::2]).all()
    assert placed.reason[1] == "no position of the tower"
    lost = at_once.where(np.zeros(11, dtype=bool))
    assert lost.reason.tolist() == ["before telemetry", *["no position of the tower"] * 9, "after telemetry"]


@pytest.mark.parametrize(
    ("place", "good"),
    [((90.0, 180.0, 0.0), 1), ((-90.0, -180.0, 0.0), 1), ((90.1, 0.0, 0.0), 0), ((0.0, 180.1, 0.0), 0),
     ((0.0, 0.0, 30.0), 0), ((0.0, 1.0, 30.0), 1), ((1.0, 0.0, -899.0), 1), ((1.0, 1.0, -900.0), 0), ((1.0, 1.0, np.inf), 0)],
)  # fmt: skip
def test_a_position_is_on_earth_and_not_where_a_receiver_without_a_fix_says(place, good):
    assert good_positions(*(np.array([value]) for value in place)).tolist() == [bool(good)]


@pytest.mark.parametrize(("speed_mps", "lost"), [(2.0, []), (10.0, [19])])
def test_sparse_fixes_are_joined_where_they_are_slow_or_fly_straight(speed_mps: float, lost: list[int]) -> None:
    """There and back: the turn amid two fixes cuts 14 m of a search at 2 m/s, and 70 m of a flight at 10."""
    seconds = 14.0 * np.arange(40)
    east = speed_mps * np.minimum(seconds, 546.0 - seconds)
    track = Track(telemetry(seconds, east, 0, 40), FRAME)
    pose = track.pose_at(at(seconds[:-1] + 7.0))
    assert np.flatnonzero(~pose.valid).tolist() == lost
    assert any("a fix every 14 s: positions in between are interpolated" in t for t in track.account.warnings)
    np.testing.assert_allclose(pose.position_m[:19, 0], speed_mps * (seconds[:19] + 7.0), atol=1e-3)
    said = "turns between fixes" in track.why_not(pose.where(pose.valid)), track.account.sparse_error_m[1] == 10.0
    assert said == (bool(lost), bool(lost))


def test_a_fast_flight_without_a_straight_leg_is_not_joined() -> None:
    seconds = 14.0 * np.arange(40)
    track = Track(telemetry(seconds, 140.0 * (np.arange(40) % 2), 0, 40), FRAME)
    assert not track.pose_at(at(seconds[:-1] + 7.0)).valid.any()


def test_the_error_of_lines_between_sparse_fixes_is_that_of_a_circle() -> None:
    """A chord of 14 s at 2 m/s on a radius of 60 m: its sagitta is 1.6 m, and the stated error is that or above."""
    seconds = 14.0 * np.arange(60)
    angle = 2.0 * seconds / 60.0
    track = Track(telemetry(seconds, 60 * np.cos(angle), 60 * np.sin(angle), 40), FRAME)
    sagitta = 60.0 * (1.0 - np.cos(14.0 * 2.0 / 60.0 / 2.0))
    assert sagitta < track.account.sparse_error_m[0] < 3.0 * sagitta


def test_a_gap_of_sparse_telemetry_stays_a_gap() -> None:
    seconds = np.append(14.0 * np.arange(20), 14.0 * np.arange(20) + 600.0)
    track = Track(telemetry(seconds, 0.5 * seconds, 0, 40), FRAME)
    assert track.pose_at(at([20.0, 400.0, 640.0])).valid.tolist() == [True, False, True]


def test_velocity_is_the_central_difference_and_bridges_no_gap():
    time = np.concatenate([np.arange(0.0, 10.0, 0.5), np.arange(60.0, 65.0, 0.5), [90.0]])
    position = np.outer(time, [4.0, -3.0, 0.0])
    position[:, 2] = 0.5 * time**2
    velocity = velocities_mps(time, position)
    assert velocity[:-1, :2] == pytest.approx(np.tile([4.0, -3.0], (30, 1)))
    assert velocity[5:15, 2] == pytest.approx(time[5:15])  # exact for constant acceleration
    assert np.isnan(velocity[-1]).all()
    assert np.isnan(velocities_mps(np.zeros(4), position[:4])).all()


def test_a_single_row_without_a_velocity_stands_still():
    logged = np.array([[3.0, np.nan, np.nan]])
    assert tracks._velocities(np.zeros(1), np.zeros((1, 3)), logged).tolist() == [[3.0, 0.0, 0.0]]
