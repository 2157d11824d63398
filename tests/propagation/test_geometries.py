"""Many geometries at once against one replay each."""

import dataclasses

import numpy as np

from aerpaw_cmp.common.geodesy import SiteFrame
from aerpaw_cmp.propagation.drivers import basis_fields, every_geometry, singular_values_of, slanted
from aerpaw_cmp.propagation.geometry import (
    Link,
    Poses,
    rotation_from_yaw_pitch_roll,
    tower_comparison_array,
    uav_comparison_array,
)
from aerpaw_cmp.propagation.options import Search
from aerpaw_cmp.propagation.replay import replay
from aerpaw_cmp.site.site import Site, Tower

CARRIER_HZ = 3.4e9
HEIGHT_M = 12.0


def poses(n=12):
    rng = np.random.default_rng(0)
    at = np.column_stack([rng.uniform(-300, 300, n), rng.uniform(-300, 300, n), rng.uniform(15, 60, n)])
    return Poses(at, np.broadcast_to(np.eye(3), (n, 3, 3)))


def some(ground):
    return every_geometry(
        [(315.0, 0.0, 90.0), (40.0, 10.0, 0.0)],
        [(45.0, -45.0, 45.0, -45.0)],
        [(45.0, -45.0, -45.0, 45.0), (0.0, 90.0, 20.0, -70.0)],
        [ground],
    )


def test_equal_to_the_replay_with_those_arrays():
    at = poses()
    frame = SiteFrame(35.7275, -78.696)
    site = Site("flat", frame, {"T": Tower("T", 35.7275, -78.696, 0.0, 0.0, HEIGHT_M)})
    wavelength = 299792458.0 / CARRIER_HZ
    tower = tower_comparison_array()
    for geometry in some(1.0):
        turned = uav_comparison_array(wavelength, geometry.uav_yaw_deg, geometry.uav_roll_deg, geometry.uav_slant_deg)
        if geometry.uav_pitch_deg:
            turn = np.radians([geometry.uav_yaw_deg, geometry.uav_pitch_deg, geometry.uav_roll_deg])
            turned = dataclasses.replace(turned, mount=rotation_from_yaw_pitch_roll(*turn))
        link = Link(CARRIER_HZ, {"T": tower_comparison_array(slant_deg=geometry.tower_slant_deg)}, turned,
                    uav_transmits=False)  # fmt: skip
        h = replay(site, link, at, Search(max_depth=1)).h[:, 0]
        fields = basis_fields(tower, site.towers["T"].position_m, turned, at, CARRIER_HZ)
        los, ground = (slanted(field, geometry.uav_slant_deg, geometry.tower_slant_deg) for field in fields)
        np.testing.assert_allclose(los + ground, h, rtol=1e-8, atol=1e-15)


def test_power_sum_is_the_mean_over_the_phases_of_the_ground_ray():
    at = poses(5)
    tower, uav = tower_comparison_array(), uav_comparison_array(0.0882)
    centre = np.array([0.0, 0.0, HEIGHT_M])
    (geometry, *_) = some(0.7)
    (sigma, *_) = singular_values_of([geometry], tower, centre, uav, at, CARRIER_HZ)
    turn = rotation_from_yaw_pitch_roll(*np.radians([geometry.uav_yaw_deg, 0.0, geometry.uav_roll_deg]))
    los, ground = basis_fields(tower, centre, dataclasses.replace(uav, mount=turn), at, CARRIER_HZ)
    los, ground = (slanted(part, geometry.uav_slant_deg, geometry.tower_slant_deg) for part in (los, ground))
    mean = 0.0
    for phase in np.exp(2j * np.pi * np.arange(8) / 8):
        h = los + 0.7 * phase * ground
        mean = mean + h @ np.conj(np.swapaxes(h, 1, 2)) / 8
    np.testing.assert_allclose(sigma**2, np.linalg.eigvalsh(mean)[:, ::-1], rtol=1e-6, atol=1e-22)


def test_no_ground_leaves_the_direct_ray():
    at = poses(4)
    tower, uav = tower_comparison_array(), uav_comparison_array(0.0882)
    centre = np.array([0.0, 0.0, HEIGHT_M])
    no_ground, with_ground = (list(singular_values_of(some(g), tower, centre, uav, at, CARRIER_HZ)) for g in (0.0, 1.0))
    assert any(np.abs(a - b).max() > 1e-9 for a, b in zip(no_ground, with_ground, strict=True))
    for geometry, a in zip(some(0.0), no_ground, strict=True):
        turned = dataclasses.replace(uav, mount=rotation_from_yaw_pitch_roll(*np.radians(geometry.mount_deg)))
        los = basis_fields(tower, centre, turned, at, CARRIER_HZ, with_ground=False)[0]
        h = slanted(los, geometry.uav_slant_deg, geometry.tower_slant_deg)
        # roots of eigenvalues keep half of the digits
        b = np.linalg.svd(h, compute_uv=False)
        np.testing.assert_allclose(a, b, atol=1e-7 * b.max())
