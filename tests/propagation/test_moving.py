"""A tower that moves: exact positions, and the limit of a fixed tower."""

import dataclasses

import numpy as np
import pytest

from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.propagation import drivers
from aerpaw_cmp.propagation.drivers import replay_moving, site_with_tower_at
from aerpaw_cmp.propagation.field.baselines import free_space_dbm, two_ray_dbm
from aerpaw_cmp.propagation.field.sum import channel_matrices
from aerpaw_cmp.propagation.geometry import Link, Poses, linear_array, single_element
from aerpaw_cmp.propagation.options import Search
from aerpaw_cmp.propagation.replay import replay
from aerpaw_cmp.site.siteyaml import load_site

SITE = load_site("lake_wheeler")
BARE = dataclasses.replace(SITE, buildings=())
LINK = Link(3.4e9, {"LW1": single_element()}, single_element())
N = 90


def poses(n: int = N, up_m: float = 40.0) -> Poses:
    places = np.stack([np.linspace(-300, 300, n), np.linspace(-200, 500, n), np.full(n, up_m)], axis=1)
    return Poses(places, np.broadcast_to(np.eye(3), (n, 3, 3)))


def rover(n: int = N, up_m: float = 1.5) -> np.ndarray:
    return np.stack([np.linspace(250, 90, n), np.linspace(100, 380, n), np.full(n, up_m)], axis=1)


def test_a_node_that_stands_still_is_a_fixed_tower_to_the_last_digit():
    at = SITE.towers["LW1"].position_m
    link = Link(3.4e9, {"LW1": linear_array(4, 0.044)}, linear_array(2, 0.044))
    fixed = replay(SITE, link, poses(), Search(max_depth=2))
    still = replay_moving(SITE, link, poses(), np.tile(at, (N, 1)), Search(max_depth=2))
    for name in ("rss_dbm", "rss_power_dbm", "h", "has_path"):
        np.testing.assert_array_equal(getattr(still, name), getattr(fixed, name))
    np.testing.assert_array_equal(still.paths.vertices_m, fixed.paths.vertices_m)
    assert still.towers == ("LW1",)


def test_every_pose_is_traced_from_its_own_place_whatever_the_blocks(monkeypatch):
    replayed = replay_moving(SITE, LINK, poses(), rover(), Search(max_depth=2))
    assert len(replayed.paths) > N
    for i in range(0, N, 11):
        pose = Poses(poses().position_m[i : i + 1], np.eye(3)[None])
        alone = replay(site_with_tower_at(SITE, "LW1", rover()[i]), LINK, pose, Search(max_depth=2))
        assert replayed.rss_dbm[i, 0] == pytest.approx(alone.rss_dbm[0, 0], abs=1e-9, nan_ok=True)
        assert (replayed.paths.pose == i).sum() == len(alone.paths)
    for most in (1, 7):
        monkeypatch.setattr(drivers, "PLACES_AT_ONCE", most)
        np.testing.assert_allclose(replay_moving(SITE, LINK, poses(), rover()).h, replayed.h, rtol=1e-9)
    again = channel_matrices(replayed.paths, replayed.faces, rover()[:, None], poses(), LINK)
    np.testing.assert_allclose(again.h, replayed.h, rtol=1e-12)


def test_reciprocity_the_moving_end_may_be_called_tower_or_uav():
    """A node on a track against a hovering UAV, and a UAV on that track against a tower where the other hovered."""
    track, fixed = rover(up_m=35.0), np.array([40.0, -120.0, 18.0])
    hovering = Poses(np.tile(fixed, (N, 1)), np.broadcast_to(np.eye(3), (N, 3, 3)))
    tower_moves = replay_moving(SITE, LINK, hovering, track, Search(max_depth=2))
    flying = Poses(track, np.broadcast_to(np.eye(3), (N, 3, 3)))
    uav_moves = replay(site_with_tower_at(SITE, "LW1", fixed), LINK, flying, Search(max_depth=2))
    assert np.isfinite(tower_moves.rss_dbm).all()
    np.testing.assert_allclose(tower_moves.rss_dbm, uav_moves.rss_dbm, atol=1e-6)


def test_free_space_and_two_rays_along_a_moving_node_are_the_closed_forms():
    for depth, form in ((0, free_space_dbm), (1, two_ray_dbm)):
        replayed = replay_moving(BARE, LINK, poses(), rover(), Search(max_depth=depth))
        expected = np.array(
            [form(s[None], p[None], 3.4e9, 40.0)[0, 0] for s, p in zip(rover(), poses().position_m, strict=True)]
        )
        np.testing.assert_allclose(replayed.rss_dbm[:, 0], expected, atol=1e-6)
        np.testing.assert_array_equal(form(rover()[:, None], poses().position_m, 3.4e9, 40.0)[:, 0], expected)
    # and not those of the node's middle
    middle = free_space_dbm(rover().mean(axis=0)[None], poses().position_m, 3.4e9, 40.0)[:, 0]
    assert np.abs(middle - expected).max() > 3.0


def test_what_cannot_move_is_refused_in_one_message():
    with pytest.raises(UsageError, match="moves and the engine is 'sionna'"):
        replay_moving(SITE, LINK, poses(), rover(), Search("sionna"))
    two_towers = Link(3.4e9, dict.fromkeys(("LW1", "LW2"), single_element()), single_element())
    with pytest.raises(UsageError, match="2 towers"):
        replay_moving(SITE, two_towers, poses(), rover())
    empty = replay_moving(SITE, LINK, poses(0), rover(0))
    assert empty.rss_dbm.shape == (0, 1)


def test_messages_of_blocks_are_counted_together():
    far = poses()
    far.position_m[[3, 80]] = 1e9
    replayed = replay_moving(BARE, LINK, far, rover(), Search(max_depth=0))
    (text,) = replayed.left_out
    assert text.startswith("2 poses further than 100 km")
    assert np.isnan(replayed.rss_dbm[[3, 80]]).all()


def test_a_place_that_is_visited_again_keeps_the_order_of_the_poses():
    """Out and back: poses at one position are far apart in the list, and their paths must still be found."""
    way = np.concatenate([rover(N // 2), rover(N // 2)[::-1]])
    replayed = replay_moving(SITE, LINK, poses(), way, Search(max_depth=1))
    assert (np.diff(replayed.paths.pose) >= 0).all()
    for i in (3, N // 2 + 5, N - 4):
        pose = Poses(poses().position_m[i : i + 1], np.eye(3)[None])
        alone = replay(site_with_tower_at(SITE, "LW1", way[i]), LINK, pose, Search(max_depth=1))
        rows = slice(*np.searchsorted(replayed.paths.pose, [i, i + 1]))
        np.testing.assert_allclose(replayed.paths.vertices_m[rows], alone.paths.vertices_m, rtol=1e-12)
