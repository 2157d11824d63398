"""An elevation model shapes the ground: mirrors and shadows."""

import dataclasses
import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from shapely.geometry import box

from aerpaw_cmp.common.geodesy import SiteFrame
from aerpaw_cmp.common.units import wavelength_m
from aerpaw_cmp.propagation.check.audit import Expected, against_reference
from aerpaw_cmp.propagation.drivers import replay_in_parts
from aerpaw_cmp.propagation.geometry import Link, Poses, path_lengths, single_element
from aerpaw_cmp.propagation.options import Field, Run, Search
from aerpaw_cmp.propagation.replay import Replay, replay
from aerpaw_cmp.propagation.search.terrain import _stationary, _zone_m, specular_points
from aerpaw_cmp.site.relief import Dem
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


def test_paths_that_terrain_stops_are_counted_of_all_paths_whatever_the_parts(site: Site) -> None:
    """Replay lines of sight. The first part loses none of them, and the second part loses all."""
    link = Link(3.3e9, {"T": single_element()}, single_element())
    east = np.array([300.0, 320.0, 340.0, 900.0, 910.0, 920.0])
    poses = Poses(np.column_stack([east, 0 * east, 0 * east + 60.0]), np.tile(np.eye(3), (6, 1, 1)))
    for size in (3, 6):
        replayed = replay_in_parts(site, link, poses, Search(max_depth=0), Field(), Run(), size=size)
        assert replayed.left_out == ["3 of 6 paths end at the terrain of the elevation model"]
    open_air = Poses(poses.position_m[:3], poses.rotation[:3])
    assert replay(site, link, open_air, Search(max_depth=0)).left_out == []


def test_a_wall_can_still_be_seen_when_the_direct_line_is_blocked(site: Site) -> None:
    # a tall wall north of the ridge's end: the ridge runs along all north of the grid, so the wall path crosses it too
    wall = Building("wall", box(-200.0, 100.0, 300.0, 104.0), 80.0)
    open_site = dataclasses.replace(site, buildings=(wall,))
    link = Link(3.3e9, {"T": single_element()}, single_element())
    here = Poses(np.array([[200.0, 0.0, 40.0]]), np.eye(3)[None])
    there = Poses(np.array([[900.0, 0.0, 80.0]]), np.eye(3)[None])
    assert (replay(open_site, link, here, Search(max_depth=1)).paths.depth == 1).sum() == 2, "ground and wall"
    assert len(replay(open_site, link, there, Search(max_depth=1)).paths) == 0


STEP_M = 10.0


def shaped(height: Callable[[Any, Any], Any], buildings: tuple[Building, ...] = (), step: float = STEP_M) -> Site:
    """A site whose ground has a height (east, north)."""
    east, north = np.arange(-1500.0, 1500.0 + step, step), np.arange(-600.0, 600.0 + step, step)
    grid = np.asarray(height(*np.meshgrid(east, north)), dtype=np.float64) + 87.3
    dem = Dem(grid, west=east[0], south=north[0], step_x=step, step_y=step, crs="local", frame=FRAME)
    tower = Tower("T", 35.7, -78.7, 0.0, 0.0, antenna_height_m=10.0, ground_m=float(dem.ground_m(0.0, 0.0)))
    return Site("shaped", FRAME, {"T": tower}, dem=dem, buildings=buildings)


def over(site: Site, position: Any, **search: Any) -> Replay:
    link = Link(3.3e9, {"T": single_element()}, single_element())
    place = np.atleast_2d(np.asarray(position, dtype=np.float64))
    return replay(site, link, Poses(place, np.tile(np.eye(3), (len(place), 1, 1))), Search(**search))


def test_level_ground_is_the_plane_without_a_model_bit_for_bit() -> None:
    walls = (
        Building("wall", box(-200.0, 100.0, 300.0, 104.0), 20.0),
        Building("barn", box(50.0, -90.0, 70.0, -60.0), 9.0),
    )
    site = shaped(lambda e, _: 0 * e, walls)
    random = np.random.default_rng(5)
    places = np.column_stack([random.uniform(-900, 900, 80), random.uniform(-500, 500, 80), random.uniform(1, 90, 80)])
    with_model, without = over(site, places), over(dataclasses.replace(site, dem=None), places)
    assert (without.paths.depth == 2).sum() > 20
    for name in ("h", "rss_dbm", "rss_power_dbm", "has_path"):
        assert np.array_equal(getattr(with_model, name), getattr(without, name), equal_nan=True), name
    assert np.array_equal(with_model.paths.vertices_m, without.paths.vertices_m, equal_nan=True)
    assert len(with_model.faces) == len(without.faces)


def test_a_slope_mirrors_the_tower_in_its_own_plane() -> None:
    east, north = 0.04, -0.03
    result = over(shaped(lambda e, n: east * e + north * n), [400.0, 150.0, 60.0], max_depth=1)
    normal = np.array([-east, -north, 1.0]) / np.sqrt(1 + east**2 + north**2)
    image = np.array([0.0, 0.0, 10.0]) - 2 * 10.0 * normal[2] * normal
    (row,) = np.flatnonzero(result.paths.depth == 1)
    assert result.faces.normal[result.paths.faces[row, 0]] == pytest.approx(normal, abs=1e-9)
    length = path_lengths(result.paths, np.array([[0.0, 0.0, 10.0]]), np.array([[400.0, 150.0, 60.0]]))[row]
    assert length == pytest.approx(np.linalg.norm(np.array([400.0, 150.0, 60.0]) - image), abs=1e-7)


@pytest.mark.parametrize(("depth_m", "points"), [(0.2, 1), (12.0, 3)])
def test_specular_points_of_a_valley_are_those_of_the_smooth_surface(depth_m: float, points: int) -> None:
    """A deep trough focuses: three ways over it are stationary, of which a slow search along it finds the same."""

    def height(east: Any, north: Any) -> Any:
        return -depth_m * np.exp(-(((east - 260.0) / 60.0) ** 2)) + 0.02 * north

    source, target = np.array([0.0, 0.0, 10.0]), np.array([520.0, 40.0, 40.0])
    dem = shaped(height, step=1.0).dem
    assert dem is not None
    _, mirrors, normal, part = specular_points(dem, source[None], target[None], wavelength_m(3.3e9))

    def way(spot: Any) -> Any:
        place = np.stack([spot[0], spot[1], height(spot[0], spot[1]) - height(0.0, 0.0)], axis=-1)
        return np.linalg.norm(place - source, axis=-1) + np.linalg.norm(place - target, axis=-1)

    across = np.linspace(-60.0, 100.0, 3201)
    along = np.arange(2.0, 518.0, 0.1)
    best = np.array([way((np.full_like(across, a), across)).min() for a in along])  # stationary across: the shortest
    turns = np.flatnonzero(np.diff(np.sign(np.diff(best)))) + 1
    assert len(turns) == points
    assert part[0] > 0.85, "far from the trough the ground is nearly a plane"
    assert (part[1:] < 0.9).all(), "a curved mirror is weaker"
    rays = [(end - mirrors) / np.linalg.norm(end - mirrors, axis=1)[:, None] for end in (source, target)]
    assert np.abs(np.cross(rays[0] + rays[1], normal)).max() < 0.02, "the normal halves the angle"
    assert sorted(mirrors[:, 0]) == pytest.approx(sorted(along[turns]), abs=1.5)
    assert mirrors[:, 2] == pytest.approx(height(mirrors[:, 0], mirrors[:, 1]) - height(0.0, 0.0), abs=0.05)


@pytest.mark.parametrize("wavelength", [1e-7, 0.1, 1.0])
def test_mirrors_along_a_profile_are_the_shortest_ways_of_each_zone(wavelength: float) -> None:
    """Polylines at random: the image of the source at each piece and the extrema at creases, by hand."""
    rng, inner, joined = np.random.default_rng(6), 0, 0
    for _ in range(40):
        at = np.concatenate([[0.0], np.sort(rng.uniform(5.0, 295.0, 12)), [300.0]])
        corners = np.column_stack([at, np.cumsum(rng.uniform(-3.0, 3.0, 14))])
        ends = np.array([0.0, rng.uniform(-20.0, 80.0)]), np.array([300.0, rng.uniform(-20.0, 80.0)])

        def way(p: Any, ends: Any = ends) -> float:
            return float(sum(np.linalg.norm(p - end) for end in ends))

        turns: list[tuple[float, float, bool]] = []  # place, way, crease
        for k, (a, b) in enumerate(itertools.pairwise(corners)):
            along = (b - a) / np.linalg.norm(b - a)
            over = [(end - a) @ [-along[1], along[0]] for end in ends]
            feet = [(end - a) @ along for end in ends]
            spot = a + (feet[0] + (feet[1] - feet[0]) * over[0] / sum(over)) * along
            longer_m = [way(b + 1e-6 * (other - b)) - way(b) for other in (a, corners[min(k + 2, 13)])]
            if a[0] < spot[0] < b[0]:  # between two ends behind the piece the way turns, but nothing reflects
                turns += [(spot[0], way(spot) if min(over) > 0.0 else np.nan, False)]
            if k < 12 and longer_m[0] * longer_m[1] > 0.0:
                turns += [(b[0], way(b), True)]
        turns = [turn for turn in turns if np.isfinite(turn[1])]
        zones = np.cumsum(np.abs(np.diff([turn[1] for turn in turns], prepend=-np.inf)) >= wavelength / 2.0)
        expected = [min((t for t, z in zip(turns, zones, strict=True) if z == zone), key=lambda t: t[1])
                    for zone in np.unique(zones)]  # fmt: skip
        places = np.array([[0.0, 0.0, 0.0], *([end[0], 7.0, end[1]] for end in ends)])
        column, mirror_m, crease, part = _stationary(
            np.tile(places[1], (2, 1)), np.tile(places[2], (2, 1)), np.tile(at[:, None] / 300.0, 2),
            np.tile(corners[:, 1:], 2), wavelength,
        )  # fmt: skip
        assert np.array_equal(mirror_m[column == 0], mirror_m[column == 1])
        first = column == 0
        for spot, edge, share in zip(mirror_m[first], crease[first], part[first], strict=True):
            assert any(abs(spot - t[0]) < 1e-9 and edge == t[2] for t in expected)
            assert share == pytest.approx(1.0) or edge or wavelength > 1e-7
        if wavelength == 1e-7:
            assert mirror_m[first & ~crease] == pytest.approx([t[0] for t in expected if not t[2]], abs=1e-9)
        inner, joined = inner + len(mirror_m), joined + len(turns) - len(expected)
    assert inner > 20
    assert (joined > 5) == (wavelength > 1e-7)


def test_a_zone_reaches_to_where_the_way_is_longer_by_half_a_wavelength() -> None:
    """Go away from the mirror sample by sample, with straight lines between samples. Unknown ground ends the zone."""
    rng = np.random.default_rng(7)
    along = np.sort(rng.uniform(0.0, 100.0, (9, 60)), axis=0)
    spot = np.where(np.arange(60) % 3 == 0, along[4], rng.uniform(along[0], along[-1]))
    excess = np.abs(rng.normal(0.0, 0.04, (9, 60)))
    excess[rng.random((9, 60)) < 0.1] = np.nan
    expected = np.zeros(60)
    for column in range(60):
        for side in (-1, 1):
            before = (spot[column], 0.0)
            for row in np.argsort(side * along[:, column]):
                sample = along[row, column], excess[row, column]
                if side * (sample[0] - spot[column]) <= 0.0:
                    continue
                if not sample[1] < 0.05:
                    share = (0.05 - before[1]) / (sample[1] - before[1])
                    expected[column] += np.nan_to_num(share) * abs(sample[0] - before[0])
                    break
                expected[column] += abs(sample[0] - before[0])
                before = sample
    zone_m = _zone_m(along, spot, excess, 0.1)
    assert zone_m == pytest.approx(expected, abs=1e-12)
    assert (zone_m < 20.0).any()
    assert (zone_m > 60.0).any()


def test_a_bump_before_the_specular_point_stops_its_leg_but_not_the_line_of_sight() -> None:
    target = [600.0, 0.0, 50.0]  # level ground reflects at 100 m
    assert (over(shaped(lambda e, _: 0 * e), target, max_depth=1).paths.depth == 1).sum() == 1
    bump = over(shaped(lambda e, _: np.where(np.abs(e - 60.0) < 5.0, 9.0, 0.0)), target, max_depth=1).paths
    assert (bump.depth == 0).sum() == 1
    assert not (np.abs(bump.vertices_m[bump.depth == 1, 0, 0] - 100.0) < 20.0).any()


def test_holes_keep_level_ground_and_cliffs_leave_no_gap() -> None:
    target = [[400.0, 20.0, 50.0], [-400.0, 20.0, 50.0]]
    hole = over(shaped(lambda e, _: np.where((e > 100.0) & (e < 200.0), np.nan, 0.004 * e)), target)
    assert any("outside the elevation model" in note and note.startswith("1 ") for note in hole.left_out)
    assert (hole.paths.depth[hole.paths.pose == 0] == 1).sum() == 1
    assert hole.faces.solid[hole.paths.faces[(hole.paths.pose == 0) & (hole.paths.depth == 1), 0]].tolist() == [-1]
    random = np.random.default_rng(2)
    spots = np.column_stack(
        [random.uniform(-900, 900, 200), random.uniform(-400, 400, 200), random.uniform(-45, 40, 200)]
    )
    cliff = over(shaped(lambda e, _: np.where(e > 100.0, -50.0, 0.0)), spots)
    assert np.isfinite(cliff.h).all()
    assert (cliff.h[spots[:, 0] > 300.0] != 0).any(), "poses below the tower's ground are not buried"


def test_the_audit_checks_level_ground_and_names_links_over_shaped_ground() -> None:
    link, places = (
        Link(3.3e9, {"T": single_element()}, single_element()),
        np.array([[300.0, 40.0, 30.0], [-500, 9, 60]]),
    )
    poses = Poses(places, np.tile(np.eye(3), (2, 1, 1)))
    for site, named in ((shaped(lambda e, _: 0 * e), 0), (shaped(lambda e, n: 8 * np.sin(e / 150) + 0.01 * n), 1)):
        replayed = replay(site, link, poses)
        audit = against_reference(site, poses, replayed, np.arange(2), Expected.of(link), ks=(10.0,), max_depth=2)
        assert audit.failures == ()
        assert len(audit.not_covered) == named
