"""Attitude from the log to the arrival angle at an antenna: aircraft frame, mount and array, computed by hand.

The pattern records the directions in which its gain is requested. The tower is level with the UAV, so you can reproduce
each case with a flat hand: the thumb points up, and the fingers point along the nose.
"""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from aerpaw_cmp.flight.settings import ArraySettings, LinkSettings
from aerpaw_cmp.flight.track import Track
from aerpaw_cmp.propagation.geometry import Array, Link, Poses, rotation_from_aircraft, single_element
from aerpaw_cmp.propagation.options import Search
from aerpaw_cmp.propagation.replay import replay


class Witness:
    """An isotropic antenna that stores the requested directions as unit vectors of the device (front, left, up)."""

    name = "witness"

    def __init__(self):
        self.asked = []

    def field(self, theta_rad, phi_rad):
        theta, phi = np.broadcast_arrays(np.asarray(theta_rad, dtype=float), np.asarray(phi_rad, dtype=float))
        vector = [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)]
        self.asked.append(np.stack(vector, axis=-1).reshape(-1, 3))
        return np.ones(theta.shape, dtype=complex), np.zeros(theta.shape, dtype=complex)


class Fixed:
    """The same gain everywhere."""

    name = "fixed"

    def __init__(self, amplitude):
        self.amplitude = amplitude

    def field(self, theta_rad, phi_rad):
        shape = np.broadcast_shapes(np.shape(theta_rad), np.shape(phi_rad))
        return np.full(shape, self.amplitude, dtype=complex), np.zeros(shape, dtype=complex)


def mount_of(**angles):
    return ArraySettings(**angles).build(0.1, Path()).mount


# the tower is east of the UAV; roll is right wing down, pitch nose up, yaw clockwise from north
CASES = [
    ("heading east", (0, 0, 90), {}, (1, 0, 0)),
    ("heading north", (0, 0, 0), {}, (0, -1, 0)),
    ("heading west", (0, 0, -90), {}, (-1, 0, 0)),
    ("north, right wing down: the top of the aircraft points east", (90, 0, 0), {}, (0, 0, 1)),
    ("north, left wing down", (-90, 0, 0), {}, (0, 0, -1)),
    ("east, nose up: the top points west", (0, 90, 90), {}, (0, 0, -1)),
    ("east, nose 30 degrees up: the tower is 30 degrees below the nose", (0, 30, 90), {}, (0.75**0.5, 0, -0.5)),
    ("north, right wing 30 degrees down: the tower rises on the right", (30, 0, 0), {}, (0, -(0.75**0.5), 0.5)),
    ("mounted upside down, heading north: right becomes left", (0, 0, 0), {"roll_deg": 180}, (0, 1, 0)),
    ("mounted looking left, heading north: the tower is behind", (0, 0, 0), {"yaw_deg": 90}, (-1, 0, 0)),
    ("mounted looking down, heading east: the tower is where its top points", (0, 0, 90), {"pitch_deg": 90}, (0, 0, 1)),
    ("the paper's mount, heading south: yaw 315, roll 90", (0, 0, 180), {"yaw_deg": 315, "roll_deg": 90},
     (-(0.5**0.5), 0, -(0.5**0.5))),
]  # fmt: skip


@pytest.mark.parametrize(("attitude", "mount", "expected"), [case[1:] for case in CASES], ids=[c[0] for c in CASES])
def test_from_where_the_uav_antenna_sees_the_tower(scenes, attitude, mount, expected):
    site = scenes.site()
    roll, pitch, yaw = attitude
    # the log, one second of straight flight; the track turns its angles into rotations
    log = pd.DataFrame({
        "time": pd.to_datetime(["2025-06-01 10:00:00", "2025-06-01 10:00:01"]),
        "latitude_deg": 35.7275, "longitude_deg": -78.697, "altitude_m": 10.0,
        "roll_deg": roll, "pitch_deg": pitch, "yaw_deg": yaw,
        "velocity_north_mps": 0.0, "velocity_east_mps": 0.0, "velocity_down_mps": 0.0,
        "fix": 3, "satellites": 15, "line": [1, 2], "flag": "",
    })  # fmt: skip
    logged = Track(log, site.frame).pose_at(log["time"].to_numpy()[:1]).rotation
    for rotation in (logged, rotation_from_aircraft(roll, pitch, yaw)[None]):  # of the report, and of simulate and tap
        witness = Witness()
        uav = Array(np.zeros((1, 3)), np.zeros(1), (witness,), mount_of(**mount))
        replay(
            site,
            scenes.link(site, uav_array=uav),
            Poses(np.array([[-100.0, 0.0, 10.0]]), rotation),
            Search(max_depth=0),
        )
        [asked] = [directions for directions in witness.asked if len(directions)]
        np.testing.assert_allclose(asked[0], expected, atol=1e-6)


def test_from_where_the_tower_sees_the_uav(scenes):
    """A tower antenna that looks north-east sees a UAV in the north at its left, and its mount tilts the horizon."""
    site = scenes.site()
    for mount, expected in (
        ({"yaw_deg": 45}, (0.5**0.5, 0.5**0.5, 0)),
        ({"yaw_deg": 90, "pitch_deg": 30}, (0.75**0.5, 0, 0.5)),
    ):
        witness = Witness()
        tower = Array(np.zeros((1, 3)), np.zeros(1), (witness,), mount_of(**mount))
        poses = scenes.poses([[0.0, 100.0, 10.0]], rotation_from_aircraft(20.0, 10.0, 200.0)[None])
        replay(site, scenes.link(site, tower), poses, Search(max_depth=0))
        [asked] = [directions for directions in witness.asked if len(directions)]
        np.testing.assert_allclose(asked[0], expected, atol=1e-6)


def test_each_port_has_its_own_pattern(scenes):
    site = scenes.site()
    gains = (1.0, 2.0, 3.0, 0.5)
    each = Array(np.zeros((4, 3)), np.zeros(4), tuple(Fixed(g) for g in gains))
    h = replay(site, scenes.link(site, uav_array=each), scenes.poses([[80.0, 0.0, 10.0]]), Search(max_depth=0)).h[0, 0]
    assert (h / h[0, 0]).real.ravel() == pytest.approx(gains)


def test_each_tower_has_its_own_array(scenes, tmp_path):
    """With ``towers`` in flight.yaml, LW2 faces the opposite way and has a slant of 60 degrees.

    LW1 keeps the common array.
    """
    site = scenes.site(towers=((0.0, 0.0, 10.0), (0.0, 0.0, 10.0)))
    settings = LinkSettings.model_validate({
        "carrier_hz": 3.4e9,
        "tower": {"antenna": {"model": "tr38901"}, "yaw_deg": 0},
        "towers": {"LW2": {"antenna": {"model": "tr38901"}, "yaw_deg": 180, "slant_deg": 60}},
    })  # fmt: skip
    link: Link = settings.build(["LW1", "LW2"], tmp_path)
    east = replay(site, link, scenes.poses([[100.0, 0.0, 10.0]]), Search(max_depth=0)).h[0, :, 0, 0]
    ahead = Link(link.carrier_hz, {"LW1": single_element(), "LW2": single_element()}, single_element())
    free = abs(replay(site, ahead, scenes.poses([[100.0, 0.0, 10.0]]), Search(max_depth=0)).h[0, 0, 0, 0])
    assert 20 * np.log10(abs(east[0]) / free) == pytest.approx(8.0, abs=1e-6)
    assert 20 * np.log10(abs(east[1]) / free) == pytest.approx(8.0 - 30.0 + 20 * np.log10(0.5), abs=1e-6)
