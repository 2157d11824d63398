"""An elevation model blocks what lies behind a ridge, and nothing else."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from shapely.geometry import box

from aerpaw_cmp.common.geodesy import SiteFrame
from aerpaw_cmp.propagation.arrays import Link, Poses, single_element
from aerpaw_cmp.propagation.options import Search
from aerpaw_cmp.propagation.replay import replay
from aerpaw_cmp.site.dem import Dem
from aerpaw_cmp.site.site import Building, Site, Tower

FRAME = SiteFrame(35.7, -78.7)
RIDGE_EAST_M, RIDGE_TOP_M = 500.0, 60.0


@pytest.fixture
def site() -> Site:
    """Flat ground with a wall-like ridge 500 m east of the tower, along the whole grid."""
    east, north = np.arange(-1000.0, 1001.0, 20.0), np.arange(-500.0, 501.0, 20.0)
    height = np.where(np.abs(east - RIDGE_EAST_M) < 15, RIDGE_TOP_M, 0.0) * np.ones((len(north), 1))
    dem = Dem(height, west=east[0], south=north[0], step_x=20.0, step_y=20.0, crs="local", frame=FRAME)
    return Site("ridge", FRAME, {"T": Tower("T", 35.7, -78.7, 0.0, 0.0, antenna_height_m=10.0)}, dem=dem)


def levels(site: Site, east: float, up: float) -> tuple[bool, int]:
    link = Link(3.3e9, {"T": single_element()}, single_element())
    result = replay(site, link, Poses(np.array([[east, 0.0, up]]), np.eye(3)[None]), Search(max_depth=2))
    return bool(result.has_path[0, 0]), len(result.paths)


def test_a_pose_behind_the_ridge_has_no_path_and_one_above_it_has(site: Site) -> None:
    # the line from 10 m at 0 to h at 900 m passes 500 m at 10 + (h - 10) * 5 / 9: below 60 m for h < 100 m
    assert levels(site, 900.0, 80.0) == (False, 0)
    assert levels(site, 900.0, 120.0) == (True, 2)
    assert levels(site, 400.0, 40.0) == (True, 2), "before the ridge nothing changes"
    assert levels(dataclasses.replace(site, dem=None), 900.0, 80.0) == (True, 2)


def test_a_wall_can_still_be_seen_when_the_direct_line_is_blocked(site: Site) -> None:
    # a tall wall north of the ridge's end: the ridge runs along all north of the grid, so the wall path crosses it too
    wall = Building("wall", box(-200.0, 100.0, 300.0, 104.0), 80.0)
    open_site = dataclasses.replace(site, buildings=(wall,))
    link = Link(3.3e9, {"T": single_element()}, single_element())
    here = Poses(np.array([[200.0, 0.0, 40.0]]), np.eye(3)[None])
    there = Poses(np.array([[900.0, 0.0, 80.0]]), np.eye(3)[None])
    assert (replay(open_site, link, here, Search(max_depth=1)).paths.depth == 1).sum() == 2, "ground and wall"
    assert len(replay(open_site, link, there, Search(max_depth=1)).paths) == 0
