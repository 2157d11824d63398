"""Each element pair with its own paths."""

import itertools

import numpy as np
import pytest
from shapely.geometry import box

from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.common.units import wavelength_m
from aerpaw_cmp.compare.rank import channel_rank
from aerpaw_cmp.jobs.bench import random_scene
from aerpaw_cmp.propagation.check import field_audit
from aerpaw_cmp.propagation.check.field_audit import per_pair
from aerpaw_cmp.propagation.drivers.pairs import replay_pairs
from aerpaw_cmp.propagation.edges import over_edges
from aerpaw_cmp.propagation.geometry.arrays import Array, linear_array, tower_comparison_array, uav_comparison_array
from aerpaw_cmp.propagation.options import Search
from aerpaw_cmp.propagation.replay import replay
from aerpaw_cmp.propagation.search import sionna
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
    pair = Array(np.array([[0.0, 0.5, 0.0], [0.0, -0.5, 0.0]]), np.zeros(2))
    link = scenes.link(site, uav_array=pair, uav_transmits=False)
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
    three_elements, two_elements = linear_array(3, 2.0, 20.0), linear_array(2, 3.0, 70.0)
    site = scenes.site(building, (here,))
    forth = replay_pairs(
        site, scenes.link(site, three_elements, two_elements, uav_transmits=False), scenes.poses([there])
    )
    site = scenes.site(building, (there,))
    back = replay_pairs(
        site, scenes.link(site, two_elements, three_elements, uav_transmits=False), scenes.poses([here])
    )
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


def test_paths_over_edges_are_no_difference_between_pairs(monkeypatch):
    """They are those of the array centres on both sides; the audit counts reflections and lines of sight alone."""
    monkeypatch.setattr(field_audit, "_explicit", lambda *_: field_audit.FieldAudit())
    site, link, poses = random_scene(20, buildings=8, seed=4)
    counts, fields = [], []
    for search in (Search(), Search(further=(over_edges,))):
        centre = replay(site, link, poses, search)
        audit = per_pair(site, link, poses, centre, np.arange(20), search, ks=(10.0, 1000.0))
        counts.append((audit.pairs_links, audit.pairs_differ, audit.pairs_rank_differs))
        assert audit.pairs_rss_max_db < 1e-9
        fields.append(centre.h)
    assert counts == [(20, 0, 0)] * 2
    assert (fields[0] != fields[1]).any()


def shadowed(scenes):
    """A wall that ends beside the straight way to some poses; the elements of the UAV lie a metre apart."""
    site = scenes.site([Building("wall", box(20, 0, 20.5, 30), 30.0)], ((0.0, 0.0, 10.0), (5.0, -3.0, 12.0)))
    pair = Array(np.array([[0.0, 0.5, 0.0], [0.0, -0.5, 0.0]]), np.zeros(2))
    spots = np.column_stack([np.linspace(30, 160, 14), np.linspace(-1.4, 1.6, 14), np.linspace(10, 14, 14)])
    return site, scenes.link(site, uav_array=pair, uav_transmits=False), scenes.poses(spots)


def by_pairs(scenes):
    site, link, poses = shadowed(scenes)
    search = Search(max_depth=1)
    return per_pair(site, link, poses, replay(site, link, poses, search), np.arange(1, 14), search, ks=(2.0, 10.0))


def test_what_the_centre_alone_decides_is_counted(scenes, monkeypatch):
    """Links that differ, the largest change of a level and ranks that change, one link at a time."""
    monkeypatch.setattr(sionna, "own_channels", lambda _, links, *__, **___: np.zeros((len(links.targets_m), 2, 2, 1)))
    site, link, poses = shadowed(scenes)
    differ = ranks = 0
    change = [0.0]
    for k, tower in itertools.product(range(1, 14), range(2)):
        spot = scenes.poses(poses.position_m[k : k + 1])
        by_centre, paired = (each(site, link, spot, Search(max_depth=1)) for each in (replay, replay_pairs))
        a, b = by_centre.h[0, tower], paired.h[0, tower]
        differ += not np.allclose(a, b, rtol=1e-8, atol=0)
        ranks += any(channel_rank(a, x) != channel_rank(b, x) for x in (2.0, 10.0))
        level = abs(paired.rss_dbm[0, tower] - by_centre.rss_dbm[0, tower])
        change += [level] if np.isfinite(level) else []
    audit = by_pairs(scenes)
    assert (audit.pairs_links, audit.pairs_differ) == (26, differ)
    assert (audit.pairs_rank_differs, audit.pairs_rss_max_db) == (ranks, pytest.approx(max(change)))
    assert 0 < differ < 26
    assert max(change) > 1.0


@pytest.mark.parametrize(
    ("third", "rest", "wrong"), [(0.5, 0.001, False), (0.001, 0.5, True), (0.009, 0.009, False), (0.011, 0.011, True)]
)
def test_explicit_arrays_are_judged_by_the_better_half_of_the_nearest_links(scenes, monkeypatch, third, rest, wrong):
    """Planted: matrices that are wrong by one share on every third link, and by another on the rest."""
    asked, shares = [], []

    def own(faces, links, rotation, link, rays, *, explicit, surfaces=None):
        asked.append(links.targets_m)
        site, _, _ = shadowed(scenes)
        h = replay_pairs(site, link, scenes.poses(links.targets_m, rotation), Search(max_depth=rays.max_depth)).h
        assert explicit
        share = np.where(np.arange(len(h) * 2) % 3 == 0, third, rest).reshape(len(h), 2)
        largest = np.abs(h).max(axis=(2, 3), keepdims=True)
        shares.extend(share[largest[..., 0, 0] > 0])
        return h + share[..., None, None] * largest

    monkeypatch.setattr(sionna, "own_channels", own)
    audit = by_pairs(scenes)
    site, _, poses = shadowed(scenes)
    away = np.min([np.linalg.norm(poses.position_m[1:] - t.position_m, axis=1) for t in site.towers.values()], axis=0)
    nearest = np.sort(away)[: field_audit.EXPLICIT_POSES]
    assert sorted(np.min([np.linalg.norm(asked[0] - t.position_m, axis=1) for t in site.towers.values()], axis=0)) == (
        pytest.approx(nearest[nearest < field_audit.EXPLICIT_RANGE_M])
    )
    assert audit.explicit_links == len(shares) < 2 * len(asked[0])
    assert audit.explicit_max_error == pytest.approx(sorted(shares)[: (len(shares) + 1) // 2][-1], rel=1e-6, abs=1e-9)
    assert bool(audit.failures) == wrong


def test_pairs_need_the_image_engine(scenes):
    site = scenes.site()
    with pytest.raises(UsageError, match="element pairs with engine 'sionna'"):
        replay_pairs(site, scenes.link(site), scenes.poses([[9.0, 0, 20]]), Search("sionna"))
