import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.propagation import engines
from aerpaw_cmp.propagation.check.audit import Second, audit
from aerpaw_cmp.propagation.edges import over_edges
from aerpaw_cmp.propagation.engines import PathCache
from aerpaw_cmp.propagation.geometry import Link, single_element
from aerpaw_cmp.propagation.options import Run, Search
from aerpaw_cmp.propagation.replay import replay, trace
from aerpaw_cmp.propagation.scene import Scene, within_reach


@pytest.fixture
def case(scenes):
    rng = np.random.default_rng(3)
    site = scenes.site(scenes.buildings(rng, 6, spread_m=80.0), ((0.0, 0.0, 10.0), (4.0, -3.0, 12.0, -2.0)))
    poses = scenes.poses(rng.uniform([-90, -90, 15], [90, 90, 40], (40, 3)))
    return site, scenes.link(site), poses


def test_the_function_is_where_the_contract_says(case):
    from aerpaw_cmp.propagation.replay import Replay

    result = replay(*case, search=Search("image"))
    assert isinstance(result, Replay)
    assert result.h.dtype == np.complex128
    assert result.h.shape == (40, 2, 1, 1)
    assert result.rss_dbm.shape == (40, 2)
    assert result.towers == ("LW1", "LW2")


def test_importing_the_room_does_not_load_sionna():
    code = "import sys, aerpaw_cmp.propagation; sys.exit(bool({'sionna', 'mitsuba', 'drjit', 'matplotlib', 'pandas'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_unknown_tower_and_engine(case, scenes):
    site, link, poses = case
    with pytest.raises(UsageError, match="no tower 'LW9'"):
        replay(site, Link(3.4e9, {"LW9": single_element()}, single_element()), poses)
    with pytest.raises(UsageError, match="unknown engine 'magic'"):
        replay(site, link, poses, Search("magic"))


def test_each_tower_reflects_on_its_own_ground(case):
    result = replay(*case)
    for tower, label in ((0, "ground at 0 m"), (1, "ground at -2 m")):
        faces = result.paths.faces[result.paths.tower == tower].ravel()
        assert {result.faces.label[f] for f in faces[faces >= 0] if result.faces.solid[f] < 0} == {label}


def test_a_second_replay_searches_nothing(case, tmp_path, monkeypatch):
    first = replay(*case, run=Run(cache_dir=tmp_path))
    assert len(list(tmp_path.glob("*.npz"))) == 1

    def fail(*args, **settings):
        raise AssertionError("searched again")

    monkeypatch.setattr("aerpaw_cmp.propagation.search.mirror.find_paths", fail)
    second = replay(*case, run=Run(cache_dir=tmp_path))
    assert second.from_cache
    assert not first.from_cache
    assert second.search_seconds == first.search_seconds > 0
    assert (second.h == first.h).all()
    assert (second.paths.faces == first.paths.faces).all()
    # other arrays and attitudes use the same paths
    site, link, poses = case
    replay(site, Link(3.5e9, link.tower_arrays, link.uav_array, 10.0), poses, run=Run(cache_dir=tmp_path))
    with pytest.raises(AssertionError, match="searched again"):
        replay(*case, search=Search(max_depth=1), run=Run(cache_dir=tmp_path))


def test_anything_that_decides_paths_changes_the_key(case, tmp_path, scenes):
    site, link, poses = case
    scene, cache = Scene.of(site, link, poses), PathCache(tmp_path)
    places = poses.position_m

    def key(scene=scene, places=places, carrier_hz=3.4e9, **search):
        return cache.key(scene, places, carrier_hz, Search(**search))

    taller = replace(site, buildings=(replace(site.buildings[0], height_m=99.0), *site.buildings[1:]))
    metal = replace(site, buildings=(replace(site.buildings[0], material="metal"), *site.buildings[1:]))
    others = [
        key(places=places + np.array([0.0, 0.0, 1e-9])), key(places=places[:-1]), key(Scene.of(taller, link, poses)),
        key(max_depth=1), key(replace(scene, usable=~scene.usable)), key(replace(scene, excluded=~scene.excluded)),
        key(replace(scene, sources_m=scene.sources_m + 1e-9)), key(engine="sionna"), key(engine="sionna", batch=9),
        key(engine="sionna", carrier_hz=3.5e9), key(Scene.of(metal, link, poses), engine="sionna"),
        key(engine="sionna", samples=9),
    ]  # fmt: skip
    assert len({key(), *others}) == 1 + len(others)
    assert key() == key(carrier_hz=3.5e9) == key(Scene.of(metal, link, poses)) == key(further=(over_edges,))


@pytest.mark.parametrize(
    ("engine", "given", "environment", "expected"),
    [
        ("image", None, "here", None), ("sionna", None, "here", "here"), ("sionna", None, "", ".cache/aerpaw-cmp"),
        ("image", "there", "here", "there"), ("sionna", "there", "", "there"), ("sionna", "", "here", None),
    ],
)  # fmt: skip
def test_the_cache_is_where_it_was_asked_for(monkeypatch, tmp_path, engine, given, environment, expected):
    monkeypatch.setenv("AERPAW_CMP_CACHE", environment)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    cache = engines.path_cache(Search(engine), Run(cache_dir=given))
    assert (None if cache is None else cache.folder) == (
        None if expected is None else tmp_path / expected if expected.startswith(".") else Path(expected)
    )


@pytest.mark.parametrize(
    ("search", "faces", "here", "expected"),
    [
        ({}, 401, True, True), ({}, 400, True, False), ({"max_depth": 1}, 401, True, False),
        ({"engine": "sionna"}, 401, True, False), ({}, 401, False, False),
    ],
)  # fmt: skip
def test_beams_search_among_many_faces_two_deep(monkeypatch, case, search, faces, here, expected):
    scene = Scene.of(*case)
    few = replace(scene, faces=scene.faces.select(np.resize(np.arange(len(scene.faces)), faces)))
    monkeypatch.setattr(engines, "find_spec", lambda _: True)
    monkeypatch.setattr(engines, "why_missing", lambda: "" if here else "no reason")
    monkeypatch.setattr(engines, "warn_once", lambda _: None)
    assert engines.by_beams(few, Search(**search)) is expected
    assert engines.by_beams(replace(few, surfaces=object()), Search(**search)) is (search.get("engine") != "sionna")


def test_a_trace_of_plain_positions_is_that_of_level_poses(case):
    site, link, poses = case
    level = replay(site, link, type(poses)(poses.position_m, np.tile(np.eye(3), (40, 1, 1))))
    assert np.array_equal(trace(site, link, poses.position_m.tolist()).h, level.h)
    assert np.array_equal(trace(site, link, poses.position_m[0]).h, level.h[:1])
    for wrong in ([1.0, 2.0], [[1.0, 2.0, 3.0, 4.0]], np.zeros((2, 2, 3))):
        with pytest.raises(UsageError, match="metres east, north and up"):
            trace(site, link, wrong)


def test_poses_within_100_km_of_a_tower_count(case, scenes):
    """A flight on a straight line is decided by its box or pose by pose, with the same result."""
    site, _, _ = case
    second = list(site.towers.values())[1].position_m
    limit = np.array(
        [[100_000.0, 0, 10], [0, -100_000.0, 10], (second[0] + 1e5, *second[1:]), [0, 0, 100_010.0], [6e4, 7.9e4, 10]]
    )
    beyond = np.array([[100_004.01, 0, 10], [8e4, -8e4, 10], [0, 0, 100_010.01 + 2.0]])
    assert within_reach(site, scenes.poses(limit))[1] == []
    mixed = scenes.poses(np.concatenate([limit, beyond, [[np.nan, 0, 0]]]))
    mixed.rotation[1] = np.nan
    poses, notes = within_reach(site, mixed)
    assert np.isfinite(poses.position_m).all(axis=1).tolist() == [True, False, True, True, True] + 4 * [False]
    assert np.array_equal(poses.rotation[1], np.eye(3))
    assert [str(note).split(":")[0] for note in notes] == [
        "3 poses further than 100 km from every tower", "1 poses without a rotation",
    ]  # fmt: skip
    assert within_reach(site, scenes.poses([[np.nan, 0, 0]]))[1] == []
    for side in (-1.0, 1.0):  # as far from the origin, and farther from the tower or nearer
        lone = scenes.site(towers=((500.0 * side, 0.0, 10.0),))
        for east, count in ((-99_600.0, 1), (99_600.0, 0), (100_400.0, 0)):
            notes = within_reach(lone, scenes.poses([[east * side, 0, 10], [0, 0, 10]]))[1]
            assert sum(any(note.counts) for note in notes) == count
    for position in beyond:
        assert sum(any(note.counts) for note in within_reach(site, scenes.poses(position))[1]) == 1


def test_damaged_entry_is_searched_again(case, tmp_path):
    first = replay(*case, run=Run(cache_dir=tmp_path))
    entry = next(tmp_path.glob("*.npz"))
    entry.write_bytes(entry.read_bytes()[:100])
    again = replay(*case, run=Run(cache_dir=tmp_path))
    assert (again.h == first.h).all()
    assert entry.stat().st_size > 100
    assert not list(tmp_path.glob("*.part"))


def test_unwritable_cache_is_no_error(case, tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    assert len(replay(*case, run=Run(cache_dir=blocked)).paths)


def test_progress_reaches_one(case):
    seen = []
    replay(*case, run=Run(progress=seen.append))
    assert seen == sorted(seen)
    assert seen[-1] == 1.0


def test_audit_sees_what_a_shallow_replay_lacks(case):
    site, link, poses = case
    shallow = replay(site, link, poses, Search(max_depth=0))
    deep = replay(site, link, poses, Search(max_depth=2))
    report = audit(site, link, poses, shallow, second=Second(reference="image", links=None))
    assert report.links == 80
    assert report.missing_paths == (deep.paths.depth > 0).sum()
    assert report.extra_paths == 0
    assert report.rss_max_error_db > 0.5
    turned = audit(site, link, poses, deep, Search(max_depth=0), second=Second(reference="image", links=None))
    assert turned.extra_paths == report.missing_paths


def test_every_damage_of_an_entry_is_seen_and_told(case, tmp_path):
    first = replay(*case, run=Run(cache_dir=tmp_path))
    (entry,) = tmp_path.glob("*.npz")
    intact = entry.read_bytes()
    generator = np.random.default_rng(3)
    for at in generator.integers(0, len(intact), 60).tolist():
        entry.write_bytes(intact[:at] + bytes([intact[at] ^ int(generator.integers(1, 256))]) + intact[at + 1 :])
        again = replay(*case, run=Run(cache_dir=tmp_path))
        assert not again.from_cache, at
        assert any("damaged entry of the path cache" in line for line in again.left_out)
        assert np.array_equal(again.rss_dbm, first.rss_dbm, equal_nan=True)
    entry.write_bytes(intact[:-1])
    assert any("damaged entry" in line for line in replay(*case, run=Run(cache_dir=tmp_path)).left_out)
    assert replay(*case, run=Run(cache_dir=tmp_path)).from_cache, "repaired by the last search"


@pytest.mark.parametrize("fault", ["far", "far_nan_turn", "no_turn"])
def test_a_pose_that_cannot_be_is_refused_alone(case, fault):
    site, link, poses = case
    clean = replay(site, link, poses)
    position, rotation = poses.position_m.copy(), np.array(poses.rotation)
    if fault.startswith("far"):
        position[0] = (1e12, -1e300, 50.0)
    if fault != "far":
        rotation[0] = np.nan
    broken = replay(site, link, type(poses)(position, rotation))
    assert not broken.has_path[0].any()
    assert np.isnan(broken.rss_dbm[0]).all()
    assert (broken.h[0] == 0).all()
    assert np.array_equal(broken.has_path[1:], clean.has_path[1:])
    assert np.array_equal(broken.rss_dbm[1:], clean.rss_dbm[1:], equal_nan=True), "to the last digit"
    assert any("poses without a rotation" in t or "further than 100 km" in t for t in broken.left_out)
