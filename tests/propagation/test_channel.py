from dataclasses import dataclass

import mpmath as mp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.common.units import wavelength_m
from aerpaw_cmp.propagation.field import sum as field_module
from aerpaw_cmp.propagation.field.baselines import free_space_dbm, two_ray_dbm
from aerpaw_cmp.propagation.field.fresnel import reflection_coefficients
from aerpaw_cmp.propagation.field.sum import mean_pair_power, rss_dbm
from aerpaw_cmp.propagation.geometry import (
    Array,
    Isotropic,
    rotation_from_aircraft,
    rotation_from_yaw_pitch_roll,
    single_element,
    tower_comparison_array,
    uav_comparison_array,
)
from aerpaw_cmp.propagation.options import Field, Search
from aerpaw_cmp.propagation.replay import replay
from aerpaw_cmp.site.materials import material
from tests.propagation import reference


@dataclass(frozen=True)
class Crossed:
    """A smooth pattern with both components, complex, without symmetry."""

    name: str = "crossed"

    def field(self, theta_rad, phi_rad):
        e_theta = np.sin(theta_rad) * (1.0 + 0.3 * np.cos(phi_rad))
        e_phi = 0.2j * np.cos(theta_rad) + 0.1 * np.sin(phi_rad)
        return e_theta + 0j, e_phi + 0j * e_theta


def crossed_mp(theta, phi):
    return (
        mp.sin(theta) * (1 + mp.mpf(0.3) * mp.cos(phi)),
        mp.mpc(0, mp.mpf(0.2)) * mp.cos(theta) + mp.mpf(0.1) * mp.sin(phi),
    )


def reference_h(site, link, poses, result, pose, field=crossed_mp):
    """50-digit H (tower sends) of one pose over the paths that the replay found."""
    tower = next(iter(link.tower_arrays.values()))
    faces = result.faces
    with mp.workdps(reference.DIGITS):
        lam = mp.mpf(299792458) / mp.mpf(link.carrier_hz)
        paths = []
        for row in result.paths.faces[result.paths.pose == pose]:
            planes = []
            for f in row[row >= 0]:
                what = material(faces.material[f])
                eta = mp.mpc(what.relative_permittivity(link.carrier_hz))
                planes.append((reference.vec(faces.normal[f]), mp.mpf(float(faces.offset_m[f])), eta, what.thickness_m))
            paths.append(planes)
        # element positions and rotations as the code rounds them: the reference checks the field, not the input
        source = next(iter(site.towers.values())).position_m
        tx = [reference.vec(p) for p in source + tower.positions_m @ tower.mount.T]
        turn = poses.rotation[pose] @ link.uav_array.mount
        rx = [reference.vec(p) for p in poses.position_m[pose] + link.uav_array.positions_m @ turn.T]
        return reference.channel(
            tx, rx, reference.matrix(tower.mount), reference.matrix(turn),
            [mp.mpf(float(s)) for s in tower.slant_rad], [mp.mpf(float(s)) for s in link.uav_array.slant_rad],
            paths, lam, field,
        )  # fmt: skip


def as_numpy(h):
    return np.array([[complex(h[i, j]) for j in range(h.cols)] for i in range(h.rows)])


def comparison_link(scenes, site, pattern):
    lam = wavelength_m(scenes.carrier_hz)
    return scenes.link(
        site, tower_comparison_array(pattern=pattern), uav_comparison_array(lam, pattern=pattern), uav_transmits=False
    )


def random_poses(scenes, rng, distance_m):
    bearing = rng.uniform(0, 2 * np.pi, len(distance_m))
    position = np.column_stack(
        [distance_m * np.cos(bearing), distance_m * np.sin(bearing), rng.uniform(15, 110, len(distance_m))]
    )
    angles = rng.uniform(-20, 20, (3, len(distance_m)))
    return scenes.poses(position, rotation_from_aircraft(angles[0], angles[1], 9 * angles[2]))


def test_matches_50_digits_with_two_reflections_up_to_3_km(scenes):
    from shapely.geometry import box

    from aerpaw_cmp.compare.rank import channel_rank
    from aerpaw_cmp.site.site import Building

    rng = np.random.default_rng(21)
    walls = [
        Building("a", box(-300, 60, 300, 70), 150.0),
        Building("b", box(-300, -70, 300, -60), 150.0, material="metal"),
    ]
    towers = ((0.0, 0.0, 10.0),)
    near = random_poses(scenes, rng, np.geomspace(20, 55, 6))
    far = random_poses(scenes, rng, np.geomspace(100, 3000, 6))
    checked_depths = set()
    for site, poses in ((scenes.site(walls, towers), near), (scenes.site((), towers), far)):
        link = comparison_link(scenes, site, Crossed())
        result = replay(site, link, poses)
        checked_depths |= set(result.paths.depth)
        for pose in range(len(poses)):
            exact = reference_h(site, link, poses, result, pose)
            h = as_numpy(exact)
            assert np.abs(result.h[pose, 0] - h).max() < 1e-9 * np.abs(h).max()
            with mp.workdps(reference.DIGITS):
                sigma = reference.singular_values(exact)
                ratio = [s / sigma[0] for s in sigma]
            ours = np.linalg.svd(result.h[pose, 0], compute_uv=False)
            assert ours / ours[0] == pytest.approx([float(r) for r in ratio], abs=1e-9)
            for k in (10, 100, 1000):
                assert channel_rank(result.h[pose, 0], k) == sum(r > mp.mpf(1) / k for r in ratio)
    assert checked_depths == {0, 1, 2}


@pytest.mark.parametrize(("place", "length"), [((120.0, -50.0, 10.0), 130.0), ((0.48, -0.2, 10.0), 0.52)])
def test_line_of_sight_is_friis_with_the_right_phase(scenes, place, length):
    site = scenes.site()
    poses = scenes.poses([place])
    result = replay(site, scenes.link(site), poses, Search(max_depth=0))
    lam = wavelength_m(scenes.carrier_hz)
    expected = lam / (4 * np.pi * length) * np.exp(-2j * np.pi * length / lam)
    assert result.h[0, 0, 0, 0] == pytest.approx(expected, rel=1e-10)
    assert result.rss_dbm == pytest.approx(
        free_space_dbm(site.towers["LW1"].position_m[None], poses.position_m, 3.4e9, 40.0)
    )


@settings(max_examples=60, deadline=None)
@given(st.floats(5, 3000), st.floats(1.0, 120.0), st.sampled_from(["vertical", "horizontal"]))
def test_replay_over_empty_ground_is_two_ray(scenes, distance, height, polarisation):
    site = scenes.site()
    array = Array(np.zeros((1, 3)), np.array([np.pi / 2 if polarisation == "horizontal" else 0.0]))
    poses = scenes.poses([[distance, 0.0, height]])
    result = replay(site, scenes.link(site, array, array), poses)
    closed = two_ray_dbm(site.towers["LW1"].position_m[None], poses.position_m, 3.4e9, 40.0, polarisation=polarisation)
    assert result.rss_dbm == pytest.approx(closed, abs=1e-6)


def test_baselines_have_no_level_at_the_antenna(scenes):
    antenna = scenes.site().towers["LW1"].position_m[None]
    for closed in (free_space_dbm, two_ray_dbm):
        level = closed(antenna, np.concatenate([antenna, antenna + 1.0]), 3.4e9, 40.0)[:, 0]
        np.testing.assert_array_equal(np.isfinite(level), [False, True])
        assert np.isnan(level[0])


def test_turning_the_link_round_transposes_h(scenes):
    site = scenes.site(scenes.buildings(np.random.default_rng(1), 4, spread_m=60.0))
    poses = random_poses(scenes, np.random.default_rng(2), np.full(10, 60.0))
    lam = wavelength_m(scenes.carrier_hz)
    arrays = (tower_comparison_array(pattern=Crossed()), uav_comparison_array(lam, pattern=Crossed()))
    down = replay(site, scenes.link(site, *arrays, uav_transmits=False), poses)
    up = replay(site, scenes.link(site, *arrays, uav_transmits=True), poses)
    assert (up.h == down.h.swapaxes(2, 3)).all()
    assert np.abs(up.h).max() > 0


def test_energy_does_not_grow_at_a_reflection():
    cos_theta = np.linspace(1e-6, 1, 500)
    for name in ("concrete", "wood", "medium_dry_ground", "metal"):
        what = material(name)
        thick = np.asarray(np.inf if what.thickness_m is None else what.thickness_m)
        te, tm = reflection_coefficients(cos_theta, np.asarray(what.relative_permittivity(3.4e9)), thick, 0.0882)
        assert (np.abs(te) <= 1).all()
        assert (np.abs(tm) <= 1).all()


def test_brewster_angle_and_thick_slab():
    eta = np.asarray(4.0 + 0j)
    brewster = np.cos(np.arctan(2.0))
    _, tm = reflection_coefficients(np.asarray(brewster), eta, np.asarray(np.inf), 0.1)
    assert abs(tm) < 1e-15
    half_wave = 0.1 / 2 / 2.0  # a lossless slab of half a wavelength inside is invisible at normal incidence
    te, tm = reflection_coefficients(np.asarray(1.0), eta, np.asarray(half_wave), 0.1)
    assert abs(te) < 1e-14
    lossy = np.asarray(4.0 - 0.5j)
    thick = reflection_coefficients(np.asarray(0.7), lossy, np.asarray(20.0), 0.1)
    endless = reflection_coefficients(np.asarray(0.7), lossy, np.asarray(np.inf), 0.1)
    assert np.allclose(thick, endless, atol=1e-14)


@pytest.mark.parametrize("tilt", [0.0, 1e-9, 1e-4])
def test_normal_incidence_is_continuous(scenes, tilt):
    # tower straight above: the ground echo comes back along the line, or nearly so
    site = scenes.site()
    flat = rotation_from_yaw_pitch_roll(0.0, np.pi / 2, 0.0)  # boresight down: no pole of the pattern on the path
    link = scenes.link(site, single_element(mount=flat), single_element(mount=flat))
    result = replay(site, link, scenes.poses([[30 * tilt, 0.0, 30.0]]))
    lam = wavelength_m(scenes.carrier_hz)
    eta = material("medium_dry_ground").relative_permittivity(3.4e9)
    gamma = (1 - np.sqrt(eta)) / (1 + np.sqrt(eta))
    two_rays = lam / (4 * np.pi) * (np.exp(-2j * np.pi * 20 / lam) / 20 + gamma * np.exp(-2j * np.pi * 40 / lam) / 40)
    assert abs(result.h[0, 0, 0, 0]) == pytest.approx(abs(two_rays), rel=1e-4 if tilt > 1e-6 else 1e-9)


def test_slant_follows_tr_38_901_model_2(scenes):
    site = scenes.site()
    poses = scenes.poses([[100.0, 0.0, 10.0]])
    facing = rotation_from_yaw_pitch_roll(np.pi, 0.0, 0.0)

    def gain(tower_deg, uav_deg):
        tower = Array(np.zeros((1, 3)), np.radians([tower_deg]))
        uav = Array(np.zeros((1, 3)), np.radians([uav_deg]), mount=facing)
        h = replay(site, scenes.link(site, tower, uav), poses, Search(max_depth=0)).h[0, 0, 0, 0]
        return abs(h) / (wavelength_m(scenes.carrier_hz) / (4 * np.pi * 100.0))

    assert gain(0, 0) == pytest.approx(1.0)
    assert gain(0, 90) == pytest.approx(0.0, abs=1e-12)
    assert gain(45, 45) == pytest.approx(0.0, abs=1e-12)  # mirrored: two antennas that face each other
    assert gain(45, -45) == pytest.approx(1.0)
    assert gain(0, 30) == pytest.approx(np.cos(np.pi / 6))


def test_one_pattern_per_element_or_one_for_all(scenes):
    site = scenes.site()
    poses = scenes.poses([[80.0, 30.0, 40.0]])
    shared = uav_comparison_array(0.0882, pattern=Crossed())
    each = Array(shared.positions_m, shared.slant_rad, (Crossed(),) * 4, shared.mount)
    assert (
        replay(site, scenes.link(site, each, shared), poses).h == replay(site, scenes.link(site, shared, each), poses).h
    ).all()
    wrong = Array(shared.positions_m, shared.slant_rad, (Crossed(),) * 3, shared.mount)
    with pytest.raises(UsageError, match="3 patterns for 4 elements"):
        replay(site, scenes.link(site, wrong), poses)


def test_chunks_do_not_change_the_field(scenes, monkeypatch):
    site = scenes.site(
        scenes.buildings(np.random.default_rng(1), 5, spread_m=60.0), ((0.0, 0.0, 10.0), (5.0, 5.0, 12.0))
    )
    poses = random_poses(scenes, np.random.default_rng(2), np.full(30, 70.0))
    link = comparison_link(scenes, site, Isotropic())
    at_once = replay(site, link, poses)
    monkeypatch.setattr(field_module, "PAIRS_PER_CHUNK", 16 * 7)
    pieces = replay(site, link, poses)
    assert pieces.h == pytest.approx(at_once.h, rel=1e-13, abs=1e-20)
    assert pieces.rss_power_dbm == pytest.approx(at_once.rss_power_dbm, rel=1e-13)


def test_loss_is_applied_per_path(scenes):
    site = scenes.site()
    poses = scenes.poses([[80.0, 30.0, 40.0], [60.0, 0.0, 20.0]])

    def only_line_of_sight(paths, sources_m, targets_m):
        assert sources_m.shape == (1, 3)
        assert targets_m.shape == (2, 3)
        return np.where(paths.depth == 0, 0.0, 400.0)

    lossy = replay(site, scenes.link(site), poses, field=Field(loss=only_line_of_sight))
    direct = replay(site, scenes.link(site), poses, Search(max_depth=0))
    assert lossy.rss_dbm == pytest.approx(direct.rss_dbm, abs=1e-9)


def test_infinite_loss_is_no_path(scenes):
    site = scenes.site()
    poses = scenes.poses([[80.0, 30.0, 40.0], [60.0, 0.0, 20.0]])
    result = replay(
        site, scenes.link(site), poses, field=Field(loss=lambda paths, *_: np.where(paths.pose == 0, np.inf, 0.0))
    )
    assert result.has_path[:, 0].tolist() == [False, True]
    assert np.isnan(result.rss_dbm[:, 0]).tolist() == [True, False]
    assert (result.h[0] == 0).all()


def test_order_of_paths_does_not_matter(scenes):
    site = scenes.site(towers=((0.0, 0.0, 10.0), (5.0, 5.0, 12.0)))
    poses = random_poses(scenes, np.random.default_rng(2), np.full(20, 70.0))
    link = comparison_link(scenes, site, Isotropic())
    result = replay(site, link, poses)
    mixed = result.paths.select(np.random.default_rng(3).permutation(len(result.paths)))
    sources = np.array([tower.position_m for tower in site.towers.values()])
    fields = field_module.channel_matrices(mixed, result.faces, sources, poses, link)
    assert fields.h == pytest.approx(result.h, rel=1e-12, abs=1e-20)


def test_power_sum_is_the_mean_over_random_phases(scenes):
    site = scenes.site()
    # half a wavelength of path difference passes many times over these poses
    poses = scenes.poses(np.column_stack([np.linspace(60, 80, 4001), np.zeros(4001), np.full(4001, 60.0)]))
    result = replay(site, scenes.link(site), poses)
    coherent = 10 * np.log10(np.mean(10 ** (result.rss_dbm / 10)))
    assert coherent == pytest.approx(10 * np.log10(np.mean(10 ** (result.rss_power_dbm / 10))), abs=0.1)
    assert np.ptp(result.rss_dbm) > 1.0
    assert np.abs(result.rss_dbm - result.rss_power_dbm).max() > 0.5


def test_rss_of_no_power_is_nan():
    assert np.isnan(rss_dbm(np.array([0.0]), 40.0))
    assert rss_dbm(np.array([1e-8]), 40.0) == pytest.approx(-40.0)
    at_floor = float(rss_dbm(np.array([1e-8]), 40.0)[0])  # a level at the floor is heard, one below it is not
    assert rss_dbm(np.array([1e-8]), 40.0, at_floor) == at_floor
    assert np.isnan(rss_dbm(np.array([1e-8]), 40.0, np.nextafter(at_floor, 0.0)))


@pytest.mark.parametrize("scale", [1e-150, 1.0, 1e150])
def test_mean_pair_power_of_tiny_and_huge_channels(scale):
    h = scale * np.array([[[1.0, 1j], [2.0, 0.0]]])
    assert mean_pair_power(h) / scale / scale == pytest.approx(6.0 / 4.0)


def test_towers_need_equal_arrays(scenes):
    from aerpaw_cmp.propagation.geometry import Link

    site = scenes.site(towers=((0.0, 0.0, 10.0), (9.0, 0.0, 10.0)))
    link = Link(3.4e9, {"LW1": single_element(), "LW2": tower_comparison_array()}, single_element())
    with pytest.raises(UsageError, match="same number of elements"):
        replay(site, link, scenes.poses([[50.0, 0.0, 30.0]]))
