"""Tiles of a map against the map in one piece with every building, and the faults that such tiles could have."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
from shapely.geometry import box

from aerpaw_cmp.common.geodesy import SiteFrame
from aerpaw_cmp.jobs import coverage_map
from aerpaw_cmp.maps.grid import Grid
from aerpaw_cmp.maps.store import PLANES, Reach, Tiling, range_m
from aerpaw_cmp.propagation.geometry import Link, single_element
from aerpaw_cmp.propagation.replay import trace
from aerpaw_cmp.site.site import Building, Site, Tower, Trees

FRAME = SiteFrame(35.7, -78.7)


def town(buildings=80, side_m=800.0, seed=1, trees=0):
    """Return buildings at random angles, some of which touch, and one with a tower inside.

    The towers are on ground of two heights.
    """
    rng = np.random.default_rng(seed)
    middle = rng.uniform(-side_m / 2, side_m / 2, (buildings, 2))
    blocks = []
    for number, (east, north) in enumerate(middle):
        shape = box(east - rng.uniform(4, 20), north - rng.uniform(4, 20), east + 12, north + 9)
        if number % 7:
            shape = shapely.affinity.rotate(shape, rng.uniform(0, 180))
        else:  # two that share a wall
            _, south, top_east, top_north = shape.bounds
            next_door = box(top_east, south, top_east + 10, top_north)
            blocks.append(Building(f"annex {number}", next_door, rng.uniform(4, 25)))
        blocks.append(Building(f"house {number}", shape, rng.uniform(4, 25)))
    at = {"A": (-150.0, 20.0, 0.0), "B": (310.0, 260.0, 0.0), "C": (40.0, -330.0, 3.0)}
    towers = {name: Tower(name, 35.7, -78.7, east, north, 18.0, ground) for name, (east, north, ground) in at.items()}
    like = np.ones(trees)
    east, north = rng.uniform(-side_m / 4, side_m / 4, (2, trees))
    wood = Trees(east, north, 0 * like, 14 * like, 7 * like, 3 * like, 0.4 * like)
    half = side_m / 2
    return Site("town", FRAME, towers, tuple(blocks), trees=wood, area_m=(-half, half, -half, half))


def settings(**change):
    some = {"spacing_m": 40.0, "rss_altitudes_m": (2.0,), "rank_altitudes_m": (2.0, 12.0), "foliage": ("none",)}
    return coverage_map.MapSettings(**{**some, "max_depth": 1, "study": False, **change})


def in_tiles(site, chosen, cells):
    """Maps by mode, and how many buildings each tile has."""
    channels = coverage_map.SiteChannels(site, chosen)
    tiling = Tiling(Grid.over_area(site.area_m, chosen.spacing_m), cells)
    done, buildings = [], []
    for number in range(len(tiling)):
        done.append(channels.tile(coverage_map.TileOrder(site="", settings=chosen, cells=cells, number=number)))
        buildings.append(len(channels.site.buildings))
    maps, paths = tiling.joined(done)
    return maps, buildings, paths


def in_one_piece(site, chosen):
    """The same with every tower and every building everywhere."""
    channels = coverage_map.SiteChannels(site, chosen)
    channels.reach.of = lambda _box: site
    grid = Grid.over_area(site.area_m, chosen.spacing_m)
    return channels.tile(coverage_map.TileOrder(site="", settings=chosen, cells=max(grid.shape), number=0))


def assert_equal(maps, others):
    for mode, plane_maps in maps.items():
        for name in PLANES:
            np.testing.assert_allclose(
                getattr(plane_maps, name), getattr(others[mode], name), rtol=1e-9, err_msg=f"{mode} {name}"
            )


@pytest.mark.parametrize(
    "change",
    [
        {"max_depth": 0},
        {"max_depth": 1},
        {"max_depth": 1, "foliage": coverage_map.FOLIAGE, "trees": 25},
        {"max_depth": 2, "spacing_m": 50.0, "buildings": 12},
        {"max_depth": 2, "spacing_m": 100.0, "buildings": 90},
    ],
    ids=lambda change: " ".join(f"{key} {value}" for key, value in change.items() if key != "foliage"),
)
def test_tiles_are_the_map_in_one_piece(change):
    chosen = {key: value for key, value in change.items() if key not in ("trees", "buildings")}
    site = town(change.get("buildings", 80), trees=change.get("trees", 0))
    one_piece, paths = in_one_piece(site, settings(**chosen))
    maps, counts, of_tiles = in_tiles(site, settings(**chosen), 5 if chosen["max_depth"] < 2 else 4)
    assert of_tiles == paths
    assert_equal(maps, one_piece)
    if chosen["max_depth"] < 2 and not change.get("trees"):
        left = {0: 0.4, 1: 0.9}[chosen["max_depth"]]
        assert np.mean(counts) < left * len(site.buildings), "some are left out"
    assert (maps["none"].rank.max(axis=(0, 1, 2)) > 0).mean() > 0.5


def test_a_tile_that_only_the_border_of_a_beam_touches_keeps_what_stands_on_that_border():
    """A mirrored ray at the end of a wall meets the corner of the tile, with a hut at that corner."""
    tower = {"T": Tower("T", 35.7, -78.7, 0.0, -10.0, 10.0)}
    wall, hut = Building("wall", box(20, 0, 40, 1), 30.0), Building("hut", box(29.5, -5.5, 30.5, -4.5), 30.0)
    site = Site("corner", FRAME, tower, (wall, hut), area_m=(-50.0, 50.0, -50.0, 50.0))
    tile = np.array([[35.0, -14.0, 10.0], [40.0, -10.0, 10.0]])
    reached = Reach(site, range_m(3.4e9, 40.0, -150.0), max_depth=1).of(tile)
    assert {building.name for building in reached.buildings} == {"wall", "hut"}
    link = Link(3.4e9, {"T": single_element()}, single_element())
    labels = []
    for buildings in ((wall,), reached.buildings):  # the hut takes the path away, so it had to be kept
        traced = trace(replace(site, buildings=buildings), link, [[40.0, -10.0, 10.0]], max_depth=1)
        labels.append([traced.faces.label[face] for face in traced.paths.faces[:, 0] if face > 0])
    assert [len(some) for some in labels] == [1, 0]


def test_a_tower_that_is_left_out_of_a_tile_reaches_no_position_of_it():
    site = town(20, side_m=4000.0)
    free = in_one_piece(site, settings(spacing_m=200.0))[0]["none"]
    floor = float(np.nanmax(free.rss_siso_dbm)) - 3.0
    reach_m = range_m(3.4e9, 40.0 + 10 * np.log10(4), floor)
    corner = np.array([[-2000.0, -2000.0, 2.0], [-1800.0, -1800.0, 2.0]])
    near = set(Reach(site, reach_m, max_depth=2).of(corner).towers)
    far = [name for name, t in site.towers.items() if np.hypot(t.east_m + 1800, t.north_m + 1800) > reach_m]
    assert far
    assert not set(far) & near
    there = (np.abs(free.grid.points_m + 1900.0) <= 100.0).all(axis=1)
    assert there.any()
    left_out = [number for number, name in enumerate(free.tower_names) if name not in near]
    assert not (np.nan_to_num(free.rss_siso_dbm[:, left_out][:, :, there], nan=-np.inf) >= floor).any()


def test_a_tile_without_towers_is_out_of_coverage_at_once(monkeypatch):
    site = town(5)
    away = replace(site, area_m=tuple(side + 2e5 for side in site.area_m))
    monkeypatch.setattr(coverage_map, "replay", lambda *_: pytest.fail("nothing reaches there"))
    maps, counts, paths = in_tiles(away, settings(spacing_m=100.0), 4)
    assert (paths, set(counts)) == (0, {0})
    assert np.isnan(maps["none"].rss_siso_dbm).all()
    assert (maps["none"].rank == 0).all()
