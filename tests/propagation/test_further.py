"""A new kind of paths is one file: this one has a kind, and nothing else knows it."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest

from aerpaw_cmp.common.units import FloatArray, IntArray, wavelength_m
from aerpaw_cmp.flight.replay import part_of
from aerpaw_cmp.propagation.check.audit import Expected, against_reference
from aerpaw_cmp.propagation.check.explain import further_path_lines
from aerpaw_cmp.propagation.drivers import replay_in_parts, replay_moving
from aerpaw_cmp.propagation.edges import over_edges
from aerpaw_cmp.propagation.field.sum import Fields, Further
from aerpaw_cmp.propagation.geometry import Faces, Link, PathSet, Poses, sources_of
from aerpaw_cmp.propagation.options import Field, Run, Search
from aerpaw_cmp.propagation.replay import replay
from aerpaw_cmp.propagation.scene import Scene

MAST_M = np.array([0.0, 60.0, 30.0])


@dataclass(frozen=True, slots=True)
class Scattered(Further):
    """Paths by way of one mast, which scatters a thousandth of the amplitude into all directions."""

    kind: ClassVar[str] = "by a mast"
    name: ClassVar[str] = "mast"
    missing: ClassVar[str] = "masts but one"

    pose: IntArray
    tower: IntArray

    def __len__(self) -> int:
        return len(self.pose)

    def lines(self) -> PathSet:
        points = np.broadcast_to(MAST_M, (len(self), 1, 3)).copy()
        depth = np.ones(len(self), np.int64)
        return PathSet(self.pose, self.tower, depth, np.full((len(self), 1), -1), points)

    def words(self, _faces: Faces) -> list[str]:
        return ["the mast"] * len(self)

    def fields(
        self, _faces: Faces, sources_m: FloatArray, poses: Poses, link: Link, loss_db: FloatArray | None = None
    ) -> Fields:
        length = np.linalg.norm(sources_of(self, sources_m) - MAST_M, axis=1)
        length += np.linalg.norm(poses.position_m[self.pose] - MAST_M, axis=1)
        gain = 1e-3 * np.exp(-2j * np.pi * length / wavelength_m(link.carrier_hz)) / length
        gain = gain if loss_db is None else gain * 10 ** (-loss_db / 20)
        h, power = np.zeros((len(poses), len(link.tower_arrays), 1, 1), complex), np.zeros((len(poses), 1))
        np.add.at(h[..., 0, 0], (self.pose, self.tower), gain)
        np.add.at(power, (self.pose, self.tower), np.abs(gain) ** 2)
        return Fields(h, np.abs(gain) ** 2, power)


def by_mast(scene: Scene, _poses: Poses, _link: Link) -> Scattered:
    pose, tower = np.nonzero(~scene.excluded.T)
    return Scattered(pose, tower)


@pytest.fixture
def case(scenes):
    site = scenes.site(scenes.buildings(np.random.default_rng(3), 4, spread_m=60.0))
    return site, scenes.link(site), scenes.poses(np.random.default_rng(4).uniform([-80, -80, 2], [80, 80, 40], (9, 3)))


def test_it_is_in_h_in_both_levels_and_in_the_notes(case):
    plain, more = replay(*case), replay(*case, Search(further=(by_mast,)))
    (masts,) = more.further
    added = masts.fields(more.faces, np.array([[0.0, 0.0, 10.0]]), case[2], case[1])
    assert np.abs(added.h).max() > 0
    assert more.h == pytest.approx(plain.h + added.h, abs=1e-15)
    assert (more.rss_power_dbm > np.nan_to_num(plain.rss_power_dbm, nan=-300.0)).all()
    assert "masts but one" in more.left_out
    frame = more.paths_frame()
    assert (frame.kind == "mast").sum() == len(masts)
    assert frame[frame.kind == "mast"].faces.eq("").all()


def test_it_loses_what_other_paths_lose(case):
    def loss(paths, sources_m, targets_m):
        return np.where(paths.vertices_m[:, 0, 1] == MAST_M[1], np.where(paths.pose == 2, np.inf, 20.0), 0.0)

    clear, lossy = (replay(*case, Search(further=(by_mast,), max_depth=1), f) for f in (Field(), Field(loss)))
    assert 2 not in lossy.further[0].pose
    plain, at = replay(*case, Search(max_depth=1)), lossy.further[0].pose
    assert (lossy.h - plain.h)[at] == pytest.approx(0.1 * (clear.h - plain.h)[at], abs=1e-15)


def test_parts_moving_towers_and_stretches_of_a_flight_keep_it(case):
    site, link, poses = case
    search = Search(further=(by_mast, over_edges))
    everything = replay(site, link, poses, search)
    parts = replay_in_parts(site, link, poses, search, Field(), Run(), size=4)
    assert [len(some) for some in parts.further] == [len(some) for some in everything.further]
    assert parts.h == pytest.approx(everything.h, abs=1e-15)
    name = next(iter(link.tower_arrays))
    places = np.tile(site.towers[name].position_m, (len(poses), 1))
    moving = replay_moving(site, link, poses, places, search)
    assert moving.h == pytest.approx(everything.h, rel=1e-9, abs=1e-15)
    assert [type(some) for some in moving.contributions] == [type(some) for some in everything.contributions]
    stretch = part_of(everything, 3, 6)
    assert stretch.further[0].pose.tolist() == [0, 1, 2]


def test_it_is_explained_and_named_by_the_audit_as_not_covered(case):
    site, link, poses = case
    single = Poses(poses.position_m[:1], poses.rotation[:1])
    replayed = replay(site, link, single, Search(further=(by_mast,)))
    (line,) = further_path_lines(replayed, np.array([0.0, 0.0, 10.0]), single, link)
    assert line.startswith("path by a mast -")
    assert line.endswith(" dBm: the mast")
    audit = against_reference(site, single, replayed, np.arange(1), Expected.of(link), ks=(10.0,), max_depth=2)
    assert audit.not_covered == ("paths by a mast",)
    without = replace(replayed, contributions=replayed.contributions[:1], h=replay(site, link, single).h)
    assert not against_reference(site, single, without, np.arange(1), Expected.of(link), ks=(), max_depth=2).not_covered
