"""Each element pair with its own paths."""

import numpy as np
import pytest
from shapely.geometry import box

from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.common.units import wavelength_m
from aerpaw_cmp.jobs.bench import random_scene
from aerpaw_cmp.propagation.arrays import Array, linear_array, tower_comparison_array, uav_comparison_array
from aerpaw_cmp.propagation.check.field_audit import per_pair
from aerpaw_cmp.propagation.drivers.pairs import replay_pairs
from aerpaw_cmp.propagation.options import Search
from aerpaw_cmp.propagation.replay import replay
from aerpaw_cmp.site.site import Building


@pytest.mark.parametrize("uav_transmits", [False, True])
def test_open_field_does_not_care(scenes, uav_transmits):
    site = scenes.site()
    uav = uav_comparison_array(wavelength_m(scenes.carrier_hz))
    link = scenes.link(site, tower_comparison_array(), uav, uav_transmits=uav_transmits)
    poses = scenes.poses(np.random.default_rng(1).uniform([-90, -90, 5], [90, 90, 40], (20, 3)))
    centre, pairs = replay(site, link, poses), replay_pairs(site, link, poses)
    assert pairs.h == pytest.approx(centre.h, rel=1e-12)
    assert pairs.rss_power_dbm == pytest.approx(centre.rss_power_dbm, abs=1e-12)


def test_wall_that_ends_between_two_elements_hides_one_of_them(scenes):
    """Seen from the tower, the wall's edge runs between the two elements of the UAV."""
    site = scenes.site([Building("wall", box(20, 0, 20.5, 30), 30.0)])
    two = Array(np.array([[0.0, 0.5, 0.0], [0.0, -0.5, 0.0]]), np.zeros(2))
    link = scenes.link(site, uav_array=two, uav_transmits=False)
    pose = scenes.poses([[40.0, 0.0, 10.0]])
    h = replay_pairs(site, link, pose, Search(max_depth=0)).h[0, 0, :, 0]
    assert h[0] == 0
    assert abs(h[1]) == pytest.approx(wavelength_m(scenes.carrier_hz) / (4 * np.pi * np.hypot(40, 0.5)), rel=1e-12)
    centre = replay(site, link, pose, Search(max_depth=0)).h[0, 0, :, 0]
    assert (centre != 0).all()  # along the wall's side, so the centre sees the tower


def test_single_elements_in_the_centre_change_nothing_bit_by_bit(scenes):
    site = scenes.site(scenes.buildings(np.random.default_rng(3), 4, spread_m=60.0))
    poses = scenes.poses(np.random.default_rng(4).uniform([-80, -80, 12], [80, 80, 40], (20, 3)))
    centre, pairs = (each(site, scenes.link(site), poses) for each in (replay, replay_pairs))
    assert (pairs.h == centre.h).all()
    assert (
        per_pair(site, scenes.link(site), poses, centre, np.arange(20), Search(max_depth=2), ks=(10.0,)).pairs_links
        == 0
    )


def test_transposing_the_link_transposes_h(scenes):
    """Reciprocity with each pair's own paths: the two ends exchanged."""
    building = [Building("b", box(10, 5.8, 18, 16), 25.0)]
    here, there = (0.0, 0.0, 10.0), (30.0, 10.0, 12.0)
    one, two = linear_array(3, 2.0, 20.0), linear_array(2, 3.0, 70.0)
    site = scenes.site(building, (here,))
    forth = replay_pairs(site, scenes.link(site, one, two, uav_transmits=False), scenes.poses([there]))
    site = scenes.site(building, (there,))
    back = replay_pairs(site, scenes.link(site, two, one, uav_transmits=False), scenes.poses([here]))
    assert forth.h[0, 0] == pytest.approx(back.h[0, 0].T, rel=1e-9)
    assert 0 < (forth.h != 0).sum() < 6


def test_few_links_of_the_bench_scene_differ():
    site, link, poses = random_scene(200)
    pairs = replay_pairs(site, link, poses)
    centre = replay(site, link, poses)
    change = np.abs(pairs.h - centre.h).max(axis=(2, 3)) / np.abs(centre.h).max(axis=(2, 3)).clip(min=1e-30)
    differs = change > 1e-6
    assert 0 < differs.mean() < 0.1
    assert change[~differs].max() < 1e-9


def test_pairs_need_the_image_engine(scenes):
    site = scenes.site()
    with pytest.raises(UsageError, match="element pairs with engine 'sionna'"):
        replay_pairs(site, scenes.link(site), scenes.poses([[9.0, 0, 20]]), Search("sionna"))
