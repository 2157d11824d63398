"""Diffraction, refraction and scattering by Sionna: closed forms, and what they must not touch."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import modfresnelm
from shapely.geometry import box

from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.common.units import wavelength_m
from aerpaw_cmp.flight.replay import check_interactions
from aerpaw_cmp.flight.settings import RtSettings
from aerpaw_cmp.propagation.arrays import (
    rotation_from_aircraft,
    single_element,
    tower_comparison_array,
    uav_comparison_array,
)
from aerpaw_cmp.propagation.check.audit import Second, audit
from aerpaw_cmp.propagation.field.sum import channel_matrices
from aerpaw_cmp.propagation.options import Run, Search
from aerpaw_cmp.propagation.replay import NOT_IN_RANKS, replay
from aerpaw_cmp.propagation.scene import Scene
from aerpaw_cmp.propagation.search import interactions
from aerpaw_cmp.propagation.search.interactions import OtherPaths, other_searches, path_powers, summary
from aerpaw_cmp.site.antennas import TR38901
from aerpaw_cmp.site.materials import material
from aerpaw_cmp.site.site import Building

RAYS = {"samples": 20_000, "batch": 10}
QUIET = Run(cache_dir="")
ROOF_M, EDGE_M = 12.0, 50.0


def hall(scenes, name, **settings):
    return scenes.site((Building("hall", box(40, -300, EDGE_M, 300), ROOF_M, material=name),), **settings)


def line_of_sight(scenes, site, poses, link):
    """The direct path as Sionna would state it: phi turns round with the direction, theta does not."""
    source, target = site.towers["LW1"].position_m, poses.position_m
    ray = target - source
    length = np.linalg.norm(ray, axis=1)

    def angles(v):
        return np.stack([np.arccos(v[:, 2] / length), np.arctan2(v[:, 1], v[:, 0])], axis=1)

    count = len(ray)
    return OtherPaths(
        pose=np.arange(count),
        tower=np.zeros(count, dtype=np.int64),
        kinds=np.full((count, 1), interactions.REFRACTED),
        faces=np.full((count, 1), -1),
        vertices_m=np.full((count, 1, 3), np.nan),
        jones=(wavelength_m(scenes.carrier_hz) / (4 * np.pi * length))[:, None, None] * np.diag([1.0, -1.0]),
        departure_rad=angles(ray),
        arrival_rad=angles(-ray),
    )


def test_patterns_slants_and_attitude_around_a_coefficient_are_those_of_h(scenes):
    rng = np.random.default_rng(3)
    site = scenes.site()
    angles = rng.uniform(-20, 20, (3, 30))
    poses = scenes.poses(
        rng.uniform([50, -90, 14], [190, 90, 80], (30, 3)), rotation_from_aircraft(angles[0], angles[1], 9 * angles[2])
    )
    tower = replace(tower_comparison_array(), patterns=(TR38901(),))
    link = scenes.link(site, tower, uav_comparison_array(wavelength_m(scenes.carrier_hz)))
    paths = line_of_sight(scenes, site, poses, link)
    direct = replay(site, link, poses, Search(max_depth=0))
    scene = Scene.of(site, link, poses)
    exact = channel_matrices(direct.paths, scene.faces, scene.sources_m, poses, link).path_power
    # plane waves against spherical ones over 1.8 m
    assert 10 * np.log10(path_powers(paths, link, poses) / exact) == pytest.approx(np.zeros(30), abs=0.3)
    assert path_powers(paths, link, poses, np.full(30, 3.0)) == pytest.approx(
        10**-0.3 * path_powers(paths, link, poses)
    )


def test_paths_found_twice_are_one_and_parts_join(scenes):
    site, poses = scenes.site(), scenes.poses([[60.0, 0, 30], [70, 5, 30]])
    paths = line_of_sight(scenes, site, poses, scenes.link(site))
    twice = OtherPaths.joined([paths, paths], 2)
    assert twice.kinds.tolist() == [[4, 0]] * 4
    assert len(twice.once()) == 2
    moved = replace(paths, vertices_m=np.ones((2, 1, 3)))
    assert len(OtherPaths.joined([paths, moved], 1).once()) == 4
    assert twice.named() == {"refraction": 4}
    nothing = OtherPaths.empty(2)
    assert (len(nothing.once()), nothing.named(), len(nothing.reflections)) == (0, {}, 0)
    assert path_powers(nothing, scenes.link(site), poses).shape == (0,)
    assert len(OtherPaths.joined([], 2)) == 0
    assert summary([])["median_power_share"] is None


def test_only_sionna_knows_other_interactions(scenes):
    site = scenes.site()
    poses = scenes.poses([[9.0, 0, 20]])
    with pytest.raises(UsageError, match="diffraction with engine 'image'"):
        replay(site, scenes.link(site), poses, Search(interactions=("reflection", "diffraction")))
    with pytest.raises(UsageError, match="max_depth 0"):
        replay(
            site, scenes.link(site), poses, Search("sionna", max_depth=0, interactions=("reflection", "diffraction"))
        )
    with pytest.raises(UsageError, match="unknown interaction 'bounce'"):
        other_searches(("bounce",), None)
    with pytest.raises(UsageError, match="scattering_coefficient"):
        other_searches(("scattering",), None)
    with pytest.raises(UsageError, match="engine 'image'"):
        check_interactions(RtSettings(advanced={"interactions": ["reflection", "refraction"]}))
    check_interactions(RtSettings(engine="sionna", advanced={"interactions": ["reflection", "refraction"]}))
    assert other_searches(("reflection",), None) == ()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"interactions": ["diffraction"]}, "must name reflection"),
        ({"interactions": ["reflection", "reflection"]}, "each interaction once"),
        ({"interactions": []}, "at least 1 item"),
        ({"interactions": ["reflection", "bounce"]}, "Input should be"),
        ({"interactions": ["reflection", "scattering"]}, "needs scattering_coefficient"),
        ({"scattering_coefficient": 0.3}, "belongs to interactions"),
        ({"interactions": ["reflection", "scattering"], "scattering_coefficient": 1.5}, "less than or equal to 1"),
        ({"interactions": ["reflection", "refraction"], "max_depth": 0}, "max_depth of 1"),
    ],
)
def test_settings_that_cannot_be_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        RtSettings(engine="sionna", max_depth=settings.pop("max_depth", 2), advanced=settings)


def wedge_gain(source, target, hard, carrier_hz):
    """Power gain over the far edge of a conducting roof: uniform theory, Kouyoumjian and Pathak 1974, eq. (25)-(29)."""
    k, n = 2 * np.pi / wavelength_m(carrier_hz), 1.5
    edge = np.array([EDGE_M, ROOF_M])
    near, far = np.hypot(*(source - edge)), np.hypot(*(target - edge))
    # from the roof (pointing to -east) over the top to the wall (pointing down)
    before = np.arctan2(source[1] - ROOF_M, EDGE_M - source[0])
    after = np.pi + np.arctan2(ROOF_M - target[1], target[0] - EDGE_M)
    reach = near * far / (near + far)

    def term(sign, beta):
        turns = np.round((beta + sign * np.pi) / (2 * np.pi * n))
        x = k * reach * 2 * np.cos((2 * np.pi * n * turns - beta) / 2) ** 2
        transition = 2j * np.sqrt(x) * np.exp(1j * x) * modfresnelm(np.sqrt(x))[0]
        return transition / np.tan((np.pi + sign * beta) / (2 * n))

    total = term(1, after - before) + term(-1, after - before)
    mirrored = term(1, after + before) + term(-1, after + before)
    d = (total + mirrored if hard else total - mirrored) / (2 * n * np.sqrt(2 * np.pi * k))
    return abs(d) ** 2 / (near * far * (near + far)) * (wavelength_m(carrier_hz) / (4 * np.pi)) ** 2


def knife_edge_db(source, target, carrier_hz):
    """ITU-R P.526-15 eq. (26) and (31): loss beyond free space of a knife edge."""
    edge = np.array([EDGE_M, ROOF_M])
    near, far = edge[0] - source[0], target[0] - edge[0]
    above = ROOF_M - (source[1] + (target[1] - source[1]) * near / (near + far))
    v = above * np.sqrt(2 / wavelength_m(carrier_hz) * (near + far) / (near * far))
    return 6.9 + 20 * np.log10(np.sqrt((v - 0.1) ** 2 + 1) + v - 0.1)


@pytest.mark.sionna
@pytest.mark.parametrize("name", ["metal", "concrete"])
def test_diffraction_behind_a_roof_is_that_of_a_wedge(sionna, scenes, name):
    """Between the two polarisations of a conducting wedge, and near a knife edge where it is concrete.

    Sionna RT 2.2.0 gives a field across the edge the coefficient of one along it, to 0.02 dB: 6 dB too little at the
    lowest of these poses, where the roof is metal. So each slant alone cannot be asked for (docs/numerics.md).
    """
    site = hall(scenes, name, towers=((0.0, 0.0, 25.0),))
    heights = np.array([2.0, 4.0, 5.5, 6.2, 6.6])  # the direct path is clear from 6.8 m
    poses = scenes.poses(np.column_stack([np.full(5, 70.0), np.zeros(5), heights]))
    source, ends = np.array([0.0, 25.0]), [np.array([70.0, h]) for h in heights]
    soft, hard = (10 * np.log10([wedge_gain(source, end, way, scenes.carrier_hz) for end in ends]) for way in (0, 1))
    free = [wavelength_m(scenes.carrier_hz) / (4 * np.pi * np.hypot(*(end - source))) for end in ends]
    knife = 20 * np.log10(free) - [knife_edge_db(source, end, scenes.carrier_hz) for end in ends]
    asked = ("reflection", "diffraction")
    for slant in (0.0, np.pi / 2):
        link = scenes.link(site)
        arrays = {tower: replace(a, slant_rad=np.array([slant])) for tower, a in link.tower_arrays.items()}
        link = replace(link, tower_arrays=arrays, uav_array=replace(link.uav_array, slant_rad=np.array([slant])))
        found = replay(site, link, poses, Search("sionna", max_depth=1, interactions=asked, **RAYS), run=QUIET)
        assert found.has_path.all()
        assert not found.other.has_path.any()
        assert found.other.kinds == {"diffraction": 5}
        assert (found.h == 0).all()
        level = 10 * np.log10(found.other.power[:, 0])
        assert (level > soft - 0.2).all()
        assert (level < hard + 0.2).all()
        assert level == pytest.approx(knife, abs=3.0 if name == "metal" else 2.0)
        assert level[-1] == pytest.approx(knife[-1], abs=0.5)


@pytest.mark.sionna
def test_sionnas_coefficients_of_reflections_have_the_power_of_h(sionna, scenes, monkeypatch):
    """Its reflected paths taken as if they were others: bases, slants, patterns and attitude, cross terms too."""
    monkeypatch.setattr(sionna, "REFLECTED", -1)
    site = hall(scenes, "concrete", towers=((25.0, 15.0, 4.0),))
    rng = np.random.default_rng(8)
    angles = rng.uniform(-25, 25, (3, 10))
    turns = rotation_from_aircraft(angles[0], angles[1], 14 * angles[2])
    poses = scenes.poses(rng.uniform([10, -10, 10], [30, 10, 14], (10, 3)), turns)
    one = replace(single_element(TR38901()), slant_rad=np.array([0.6]))
    link = scenes.link(site, one, replace(single_element(), slant_rad=np.array([-0.9])))
    plain = replay(site, link, poses)
    assert (np.bincount(plain.paths.pose) > 2).sum() > 7
    found = replay(site, link, poses, Search("sionna", interactions=("reflection", "refraction"), **RAYS), run=QUIET)
    assert found.other.paths.sum() == len(plain.paths)
    level = 10 * np.log10(found.other.power) + link.transmit_power_dbm
    assert level == pytest.approx(plain.rss_power_dbm, abs=0.02)


def slab_transmission(name, carrier_hz):
    """|T| of a slab at normal incidence: ITU-R P.2040-3 eq. (43)-(45)."""
    eta, wavelength = material(name).relative_permittivity(carrier_hz), wavelength_m(carrier_hz)
    r = (1 - np.sqrt(eta)) / (1 + np.sqrt(eta))
    q = 2 * np.pi * material(name).thickness_m / wavelength * np.sqrt(eta)
    return abs((1 - r**2) * np.exp(-1j * q) / (1 - r**2 * np.exp(-2j * q)))


@pytest.mark.sionna
def test_refraction_through_two_walls_loses_what_two_slabs_lose(sionna, scenes, tmp_path, monkeypatch):
    site = hall(scenes, "plywood", towers=((0.0, 0.0, 6.0),))
    poses = scenes.poses([[90.0, 0.0, 6.0], [70.0, 0.0, 6.0], [80.0, 0.0, 30.0]])
    link, asked = scenes.link(site), ("reflection", "refraction")
    kept = Run(cache_dir=str(tmp_path))
    plain = replay(site, link, poses, Search("sionna", **RAYS), run=kept)
    found = replay(site, link, poses, Search("sionna", interactions=asked, **RAYS), run=kept)
    assert plain.has_path[:, 0].tolist() == [False, False, True]
    assert found.has_path.all()
    through = slab_transmission("plywood", scenes.carrier_hz) ** 4
    expected = through * (wavelength_m(scenes.carrier_hz) / (4 * np.pi * np.array([90.0, 70.0]))) ** 2
    assert 10 * np.log10(found.other.power[:2, 0] / expected) == pytest.approx([0, 0], abs=0.1)
    # nothing but RSS is touched, and RSS never falls
    assert (found.h == plain.h).all()
    assert (found.paths.faces == plain.paths.faces).all()
    assert found.rss_dbm[2, 0] >= plain.rss_dbm[2, 0]
    assert found.rss_power_dbm[2, 0] >= plain.rss_power_dbm[2, 0]
    assert NOT_IN_RANKS in found.left_out
    back = found.of_reflections()
    assert np.array_equal(back.rss_dbm, plain.rss_dbm, equal_nan=True)
    assert np.array_equal(back.has_path, plain.has_path)
    # the audit is of the reflections
    report = audit(site, link, poses, found, run=Run(cache_dir=""), second=Second(reference="image", links=None))
    assert (report.missing_paths, report.extra_paths, report.coverage_differs) == (0, 0, 0)
    assert report.rss_max_error_db < 0.01
    counted = summary([(np.abs(found.h[..., 0, 0]) ** 2, found.other)])
    assert counted["links_without_reflections"] == 2
    assert counted["paths"] == sum(found.other.kinds.values())

    def fail(*args, **settings):
        raise AssertionError("traced again")

    monkeypatch.setattr(sionna, "find_others", fail)
    again = replay(site, link, poses, Search("sionna", interactions=asked, **RAYS), run=kept)
    assert (again.other.power == found.other.power).all()
    with pytest.raises(AssertionError, match="traced again"):
        replay(site, link, poses, Search("sionna", interactions=("reflection", "diffraction"), **RAYS), run=kept)


@pytest.mark.sionna
def test_scattered_power_grows_with_the_square_of_the_coefficient(sionna, scenes):
    """One scattering each: S^2 of the power, but for the rays that hit; the ground below scatters to every pose."""
    site = scenes.site()
    poses = scenes.poses([[60.0, 0.0, 30.0], [0.0, 80.0, 40.0]])
    link, asked = scenes.link(site), ("reflection", "scattering")
    plain = replay(site, link, poses, Search("sionna", max_depth=1, **RAYS), run=QUIET)
    power = {}
    for coefficient in (0.2, 0.4):
        found = replay(
            site,
            link,
            poses,
            Search("sionna", max_depth=1, interactions=asked, scattering_coefficient=coefficient, **RAYS),
            run=QUIET,
        )
        power[coefficient] = found.other.power[:, 0]
        assert set(found.other.kinds) == {"scattering"}
        assert (found.rss_dbm > plain.rss_dbm).all()
        assert (found.h == plain.h).all()
    assert 10 * np.log10(power[0.4] / power[0.2]) == pytest.approx([6.0, 6.0], abs=1.0)
