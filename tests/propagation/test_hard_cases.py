"""Cases that break float32 or careless geometry, one at a time."""

import dataclasses

import mpmath as mp
import numpy as np
import pytest
from shapely.geometry import box

from aerpaw_cmp.common.units import wavelength_m
from aerpaw_cmp.compare.rank import channel_rank
from aerpaw_cmp.propagation.geometry import (
    Array,
    Isotropic,
    rotation_from_yaw_pitch_roll,
    single_element,
    tower_comparison_array,
)
from aerpaw_cmp.propagation.options import Search
from aerpaw_cmp.propagation.replay import replay
from aerpaw_cmp.site.materials import material
from aerpaw_cmp.site.site import Building
from tests.propagation import reference

LAMBDA = wavelength_m(3.4e9)
VERTICAL = (0.0, 0.0, 0.0, 0.0)


def uav_square(slant_deg=VERTICAL, mount=None):
    half = LAMBDA / 4
    positions = np.array([[0, half, half], [0, half, -half], [0, -half, half], [0, -half, -half]])
    return Array(positions, np.radians(slant_deg), (Isotropic(),), np.eye(3) if mount is None else mount)


def vertical(theta, phi):
    return mp.mpf(1), mp.mpf(0)


def exact_line_of_sight(tower, source, uav, target):
    """50-digit singular values, descending, of one line of sight."""
    with mp.workdps(reference.DIGITS):
        lam = mp.mpf(299792458) / mp.mpf(3.4e9)
        h = reference.channel(
            [reference.vec(p) for p in source + tower.positions_m @ tower.mount.T],
            [reference.vec(p) for p in target + uav.positions_m @ uav.mount.T],
            reference.matrix(tower.mount), reference.matrix(uav.mount),
            [mp.mpf(float(s)) for s in tower.slant_rad], [mp.mpf(float(s)) for s in uav.slant_rad],
            [[]], lam, vertical,
        )  # fmt: skip
        return reference.singular_values(h)


@pytest.mark.parametrize("k", [10, 100, 1000])
def test_line_of_sight_with_sigma_2_within_1e_6_of_the_limit(scenes, k):
    """The rank changes at the exact limit within 1e-6. The noise of float32 is 1000 times larger."""
    site = scenes.site()
    source = site.towers["LW1"].position_m
    # a wide tower array, so that the limit of K = 10 lies outside its near field
    spread = 20.0 if k == 10 else 1.0
    tower = tower_comparison_array(yaw_deg=0.0, slant_deg=VERTICAL)
    tower = Array(tower.positions_m * spread, tower.slant_rad, tower.patterns, tower.mount)
    uav = uav_square()

    def ratio(distance):
        h = replay(
            site,
            scenes.link(site, tower, uav, uav_transmits=False),
            scenes.poses([[distance, 0.0, 10.0]]),
            Search(max_depth=0),
        ).h
        s = np.linalg.svd(h[0, 0], compute_uv=False)
        return s[1] / s[0]

    low, high = 8.0 * spread, 2900.0
    assert ratio(low) > 1 / k > ratio(high)
    for _ in range(60):
        middle = np.sqrt(low * high)
        low, high = (middle, high) if ratio(middle) > 1 / k else (low, middle)
    for side, expected in ((1 - 5e-7, 2), (1 + 5e-7, 1)):  # the ratio falls nearly as 1 / distance
        distance = low * side
        target = np.array([distance, 0.0, 10.0])
        sigma = exact_line_of_sight(tower, source, uav, target)
        true_ratio = float(sigma[1] / sigma[0])
        assert 1e-8 < abs(true_ratio * k - 1) < 1e-6
        assert true_ratio == pytest.approx(ratio(distance), abs=1e-9)
        assert sum(s > sigma[0] / k for s in sigma) == expected
        h = replay(
            site, scenes.link(site, tower, uav, uav_transmits=False), scenes.poses([target]), Search(max_depth=0)
        ).h
        assert channel_rank(h, k).item() == expected


def test_sionna_note_links_have_the_exact_ranks(scenes):
    """For lines of sight of 20 m to 1.5 km, float32 gives rank 3 at K = 1000, which exact arithmetic never does."""
    site = scenes.site()
    distance = np.geomspace(20, 1500, 60)
    poses = scenes.poses(np.column_stack([distance, 0.1 * distance, np.full(60, 30.0)]))
    tower = tower_comparison_array(yaw_deg=0.0, slant_deg=VERTICAL)
    h = replay(site, scenes.link(site, tower, uav_square(), uav_transmits=False), poses, Search(max_depth=0)).h[:, 0]
    rank = channel_rank(h, 1000)
    assert rank.max() == 2
    assert 0 < (rank == 1).sum() < 60
    noisy = h * np.exp(1j * np.random.default_rng(0).normal(0, 5e-3, h.shape))  # what float32 phases amount to
    assert channel_rank(noisy, 1000).max() > 2


@pytest.mark.parametrize("wavelengths", [1, 2, 3])
def test_two_ray_null_deeper_than_60_db(scenes, wavelengths):
    """Horizontal elements over metal at grazing angles: the echo cancels the direct ray to 1e-3 and better."""
    site = scenes.site(ground_material="metal")
    source = site.towers["LW1"].position_m
    array = Array(np.zeros((1, 3)), np.array([np.pi / 2]))
    distance = 3000.0
    with mp.workdps(reference.DIGITS):
        lam = mp.mpf(299792458) / mp.mpf(3.4e9)
        eta = mp.mpc(material("metal").relative_permittivity(3.4e9))

        def parts(height):
            direct = mp.sqrt(mp.mpf(distance) ** 2 + (height - 10) ** 2)
            echo = mp.sqrt(mp.mpf(distance) ** 2 + (height + 10) ** 2)
            te, _ = reference.fresnel((height + 10) / echo, eta, None, lam)
            return direct, echo, te

        guess = wavelengths * lam * distance / 20
        height = mp.findroot(lambda z: parts(z)[1] - parts(z)[0] - wavelengths * lam, guess)
        height = mp.mpf(float(height))  # the pose that is replayed
        direct, echo, te = parts(height)
        exact = (
            lam
            / (4 * mp.pi)
            * (mp.exp(-2j * mp.pi * direct / lam) / direct + te * mp.exp(-2j * mp.pi * echo / lam) / echo)
        )
        depth_db = float(20 * mp.log10(abs(exact) * 4 * mp.pi * direct / lam))
        exact = complex(exact)
    result = replay(site, scenes.link(site, array, array), scenes.poses([[distance, 0.0, float(height)]]))
    assert depth_db < -60
    # the phi axes of two antennas that face each other are opposite: a factor -1
    assert abs(result.h[0, 0, 0, 0] + exact) < 1e-7 * abs(exact)
    free = LAMBDA / (4 * np.pi * float(direct))
    assert 20 * np.log10(abs(result.h[0, 0, 0, 0]) / free) == pytest.approx(depth_db, abs=1e-3)
    assert np.linalg.norm(source) == 10.0


def test_crossed_arrays_are_null_to_the_depth_of_the_pattern(scenes):
    """The paper's roll of 90 degrees puts V against H: at broadside nothing but geometry is left."""
    site = scenes.site()
    rolled = rotation_from_yaw_pitch_roll(np.pi, 0.0, np.pi / 2)
    exactly_opposite = scenes.poses([[500.0, 0.0, 10.0]])
    single = replay(
        site, scenes.link(site, single_element(), single_element(mount=rolled)), exactly_opposite, Search(max_depth=0)
    )
    free = LAMBDA / (4 * np.pi * 500.0)
    assert abs(single.h[0, 0, 0, 0]) < 1e-15 * free * 10
    tower = tower_comparison_array(yaw_deg=0.0, slant_deg=VERTICAL)
    uav = uav_square(mount=rolled)
    # far below thermal noise: no receiver's floor here
    link = dataclasses.replace(scenes.link(site, tower, uav, uav_transmits=False), noise_floor_dbm=-np.inf)
    crossed = replay(site, link, exactly_opposite, Search(max_depth=0))
    sigma = exact_line_of_sight(tower, site.towers["LW1"].position_m, uav, exactly_opposite.position_m[0])
    ours = np.linalg.svd(crossed.h[0, 0], compute_uv=False)
    ratio = [float(s / sigma[0]) for s in sigma]
    assert float(sigma[0]) < 1e-2 * free  # crossed
    assert ours / ours[0] == pytest.approx(ratio, abs=1e-9)
    for k in (10, 100, 1000):
        assert channel_rank(crossed.h[0, 0], k) == sum(r > 1 / k for r in ratio)


def test_rank_4_where_ports_are_crossed_in_pairs(scenes):
    """Slanted ports at both ends: two polarisations, each with its own line of sight."""
    site = scenes.site()
    tower = tower_comparison_array(yaw_deg=0.0)
    uav = uav_square((45.0, -45.0, -45.0, 45.0), rotation_from_yaw_pitch_roll(np.pi, 0.0, 0.0))
    h = replay(
        site, scenes.link(site, tower, uav, uav_transmits=False), scenes.poses([[60.0, 5.0, 30.0]]), Search(max_depth=0)
    ).h
    assert channel_rank(h[0, 0], 10) == 2
    assert channel_rank(h[0, 0], 1000) == 4


def test_pose_straight_above_the_tower(scenes):
    site = scenes.site()
    down = rotation_from_yaw_pitch_roll(0.0, np.pi / 2, 0.0)
    link = scenes.link(site, tower_comparison_array(), uav_square(mount=down), uav_transmits=False)
    result = replay(site, link, scenes.poses([[0.0, 0.0, 60.0], [0.0, 0.0, 10.0 + 1e-3], [0.0, 0.0, 3.0]]))
    assert np.isfinite(result.h).all()
    assert result.has_path[:, 0].tolist() == [True, False, True]  # 1 mm is too short for a link
    assert sorted(result.paths.depth[result.paths.pose == 0]) == [0, 1]


def test_pose_inside_a_building_or_under_the_ground_has_no_path(scenes):
    site = scenes.site([Building("barn", box(30, -10, 50, 10), 8.0)])
    poses = scenes.poses([[40.0, 0.0, 4.0], [40.0, 0.0, -1.0], [80.0, 40.0, -0.01], [40.0, 0.0, 8.5], [np.nan, 0, 5.0]])
    result = replay(site, scenes.link(site), poses)
    assert result.has_path[:, 0].tolist() == [False, False, False, True, False]
    assert np.isnan(result.rss_dbm[:, 0]).tolist() == [True, True, True, False, True]
    assert (result.h[[0, 1, 2, 4]] == 0).all()
    assert channel_rank(result.h[:, 0], 10).tolist() == [0, 0, 0, 1, 0]


def test_tower_inside_a_building_has_no_path(scenes):
    site = scenes.site([Building("barn", box(-10, -10, 10, 10), 12.0)])
    result = replay(site, scenes.link(site), scenes.poses([[40.0, 0.0, 30.0], [2.0, 0.0, 5.0]]))
    assert not result.has_path.any()
    assert result.left_out == ["LW1: its antenna is inside barn, so it has no path at all"]


def test_pose_on_a_wall_on_a_roof_and_on_the_ground(scenes):
    site = scenes.site([Building("barn", box(30, -10, 50, 10), 8.0)])
    poses = scenes.poses([[30.0, 0.0, 4.0], [50.0, 0.0, 4.0], [40.0, 0.0, 8.0], [20.0, 0.0, 0.0]])
    result = replay(site, scenes.link(site), poses)
    # seen from the front; hidden behind; on the roof; on the ground. Each reflects where it stands, as a hair before it
    assert result.has_path[:, 0].tolist() == [True, False, True, True]
    labels = [
        {result.faces.label[f] for f in result.paths.faces[result.paths.pose == p].ravel() if f >= 0} for p in range(4)
    ]
    front = next(result.faces.label[f] for f in np.flatnonzero(result.faces.normal[:, 0] == -1.0))
    assert front in labels[0]
    assert "barn roof" in labels[2]
    assert "ground" in labels[3]


def test_tower_and_uav_at_the_same_point(scenes):
    site = scenes.site()
    tower, uav = tower_comparison_array(), uav_square()
    poses = scenes.poses(
        [site.towers["LW1"].position_m, site.towers["LW1"].position_m + np.array([1e-9, 0, 0]), [0.02, 0.0, 10.0]]
    )
    result = replay(site, scenes.link(site, tower, uav), poses)
    assert result.has_path[:, 0].tolist() == [False, False, True]
    assert np.isfinite(result.h).all()
    assert np.abs(result.h).max() <= 1.001  # never more received than sent, however near two elements come
    assert np.isnan(result.rss_dbm[:2]).all()


def test_elements_of_two_arrays_at_the_same_point(scenes):
    """Array centres apart, one element of each in one place: finite, and no gain."""
    site = scenes.site()
    tower_array = Array(np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]), np.zeros(2))
    uav_array = Array(np.array([[0.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]), np.zeros(2))
    result = replay(
        site, scenes.link(site, tower_array, uav_array), scenes.poses([[1.0, 0.0, 10.0]]), Search(max_depth=0)
    )
    assert np.isfinite(result.h).all()
    assert np.abs(result.h).max() <= 1.0


def test_no_pose_at_all(scenes):
    site = scenes.site([Building("barn", box(30, -10, 50, 10), 8.0)])
    result = replay(site, scenes.link(site), scenes.poses(np.zeros((0, 3))))
    assert result.h.shape == (0, 1, 1, 1)
    assert len(result.paths) == 0


def test_fully_hidden_flight_has_no_path(scenes):
    ring = box(-30, -30, 30, 30).difference(box(-20, -20, 20, 20))
    site = scenes.site([Building("ring", ring, 40.0)])
    poses = scenes.poses([[60.0, 0.0, 10.0], [0.0, 90.0, 20.0]])
    result = replay(site, scenes.link(site), poses, Search(max_depth=3))
    assert not result.has_path.any()
    assert np.isnan(result.rss_power_dbm).all()


@pytest.mark.parametrize("scale", [0.05, 1.0, 3.0])
def test_scaled_scene_and_wavelength_give_the_same_channel(scenes, scale):
    """Lengths and wavelength times one factor: H is unchanged over empty ground of metal (nearly frequency free)."""
    from dataclasses import replace

    site = scenes.site([Building("b", box(30, -10, 50, 10), 30.0, material="metal")], ground_material="metal")
    big = scenes.site(
        [Building("b", box(30 * scale, -10 * scale, 50 * scale, 10 * scale), 30.0 * scale, material="metal")],
        ((0.0, 0.0, 10.0 * scale),), ground_material="metal",
    )  # fmt: skip
    position = np.array([[20.0, 15.0, 12.0], [-35.0, 5.0, 20.0]])
    small = replay(site, scenes.link(site), scenes.poses(position))
    link = replace(scenes.link(big), carrier_hz=3.4e9 / scale)
    scaled = replay(big, link, scenes.poses(position * scale))
    assert (small.paths.faces == scaled.paths.faces).all()
    assert len(small.paths) > 4
    assert scaled.h == pytest.approx(small.h, rel=2e-2)  # metal's loss changes a little with frequency
