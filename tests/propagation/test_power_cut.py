"""The power cut: what it leaves out is as weak as it says, whichever way the paths are searched."""

import re

import numpy as np
import pytest
from shapely.geometry import box

from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.common.units import wavelength_m
from aerpaw_cmp.propagation import engines
from aerpaw_cmp.propagation.drivers.pairs import replay_pairs
from aerpaw_cmp.propagation.field.sum import channel_matrices
from aerpaw_cmp.propagation.options import Search
from aerpaw_cmp.propagation.replay import replay
from aerpaw_cmp.propagation.search import power_cut, samples
from aerpaw_cmp.site.site import Building

CUT_DB = 6.0


@pytest.fixture(scope="module")
def case(scenes):
    rng = np.random.default_rng(3)
    spots = rng.uniform(-150, 150, (14, 2))
    buildings = tuple(
        Building(f"b{k}", box(e, n, e + 20, n + 30), float(rng.uniform(8, 30))) for k, (e, n) in enumerate(spots)
    )
    site = scenes.site(buildings, ((0.0, 0.0, 20.0), (90.0, 10.0, 35.0)))
    poses = scenes.poses(rng.uniform([-120, -120, 2], [120, 120, 60], (150, 3)))
    return site, scenes.link(site), poses


@pytest.mark.parametrize("beams", [False, True])
def test_every_path_left_out_is_as_weak_as_the_cut_says(monkeypatch, case, beams):
    if beams:
        pytest.importorskip("numba", reason="numba is not installed (extra 'fast')")
        monkeypatch.setattr(engines, "MANY_FACES", 10)
    site, link, poses = case
    whole = replay(site, link, poses)
    cut = replay(site, link, poses, Search(power_cut_db=CUT_DB))
    kept = {(p, t, *f) for p, t, f in zip(cut.paths.pose, cut.paths.tower, cut.paths.faces.tolist(), strict=True)}
    key = [(p, t, *f) for p, t, f in zip(whole.paths.pose, whole.paths.tower, whole.paths.faces.tolist(), strict=True)]
    gone = np.array([k not in kept for k in key])
    assert kept <= set(key)
    assert 20 < gone.sum() < len(gone) - 20
    sources = np.array([tower.position_m for tower in site.towers.values()])
    power = channel_matrices(whole.paths, whole.faces, sources, poses, link).path_power
    gap = np.linalg.norm(poses.position_m[whole.paths.pose] - sources[whole.paths.tower], axis=1)
    free = (wavelength_m(link.carrier_hz) / (4 * np.pi * gap)) ** 2
    assert (power[gone] <= free[gone] * 10 ** (-CUT_DB / 10)).all()
    strong = power > free * 10 ** (-CUT_DB / 10)
    assert strong.sum() > 150
    assert not (gone & strong).any()


def test_what_it_costs_is_checked_by_a_full_search(case):
    site, link, poses = case
    whole, cut = replay(site, link, poses), replay(site, link, poses, Search(power_cut_db=CUT_DB))
    (words,) = [text for text in cut.left_out if text.startswith("rt.advanced.power_cut_db 6")]
    found = re.search(r"search of (\d+) poses: (\d+) of (\d+) paths, RSS changed by ([0-9.]+) dB", words)
    some = samples.spread(np.arange(len(poses)), power_cut.CHECKED_POSES)
    count = [int(np.isin(r.paths.pose, some).sum()) for r in (whole, cut)]
    assert [int(found[1]), int(found[2]), int(found[3])] == [len(some), count[0] - count[1], count[0]]
    change = np.nanmax(np.abs(whole.rss_dbm[some] - cut.rss_dbm[some]))
    assert float(found[4]) == pytest.approx(change, rel=0.06)
    assert change > 0.05
    # left out and counted: a link that had nothing but a long way round
    alone = np.isfinite(whole.rss_dbm[some]) & ~np.isfinite(cut.rss_dbm[some])
    assert (f"{alone.sum()} links without any path" in words) == bool(alone.any())
    assert not [text for text in whole.left_out if "power_cut" in text]


def test_a_cut_beyond_every_path_changes_nothing(case):
    site, link, poses = case
    whole, cut = replay(site, link, poses), replay(site, link, poses, Search(power_cut_db=80.0))
    np.testing.assert_array_equal(whole.h, cut.h)
    assert ": 0 of " in cut.left_out[-1]


def test_pairs_are_cut_alike(case):
    site, link, poses = case
    whole = replay(site, link, poses, Search(power_cut_db=CUT_DB))
    pairs = replay_pairs(site, link, poses, Search(power_cut_db=CUT_DB))
    np.testing.assert_allclose(pairs.h, whole.h, atol=1e-12)  # one element at each end: its centre


@pytest.mark.parametrize("value", [0.0, -3.0, np.nan])
def test_a_cut_that_is_none_is_refused(case, value):
    with pytest.raises(UsageError, match="power_cut_db"):
        replay(*case, search=Search(power_cut_db=value))
