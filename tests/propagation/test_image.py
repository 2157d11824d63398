from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely.geometry import Polygon, box

from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.propagation.geometry import Links, inside_solids, site_faces
from aerpaw_cmp.propagation.search.mirror import REACH_SLACK_M, Growth, find_paths, images_of, planes_of
from aerpaw_cmp.site.site import Building

SOURCE = np.array([[0.0, 0.0, 10.0]])


def search(site, targets, max_depth=2, excluded=None, **settings_):
    faces = site_faces(site)
    links = Links(SOURCE, np.atleast_2d(np.asarray(targets, float)), excluded=excluded)
    return faces, find_paths(faces, links, max_depth=max_depth, **settings_)


def by_brute_force(scenes, site, faces, targets, depth):
    return {
        (i, 0, *sequence)
        for i, target in enumerate(targets)
        for sequence in scenes.brute_force(site, faces, SOURCE[0], target, depth)
    }


@pytest.mark.parametrize(("seed", "holes"), [(1, False), (2, False), (3, True), (4, True)])
def test_same_paths_as_brute_force_at_depth_2(scenes, seed, holes):
    rng = np.random.default_rng(seed)
    site = scenes.site(scenes.buildings(rng, 4, spread_m=60.0, holes=holes))
    targets = np.column_stack([rng.uniform(-80, 80, (12, 2)), rng.uniform(1.0, 25, 12)])
    targets = targets[~inside_solids(site, targets)]
    faces, paths = search(site, targets)
    assert scenes.keys(paths) == by_brute_force(scenes, site, faces, targets, 2)
    assert len(paths) > 1.5 * len(targets)  # the scene has reflections to find


def test_same_paths_as_brute_force_at_depth_3(scenes):
    site = scenes.site([Building("a", box(-20, 15, 40, 18), 12.0), Building("b", box(-20, -18, 40, -15), 12.0)])
    targets = np.array([[22.0, 3.0, 4.0], [30.0, -8.0, 6.0], [35.0, 1.0, 20.0]])
    faces, paths = search(site, targets, 3)
    assert scenes.keys(paths) == by_brute_force(scenes, site, faces, targets, 3)
    assert paths.depth.max() == 3


def one_reflection(faces, points_m):
    return Growth.of(faces, points_m, REACH_SLACK_M, max_depth=1, budget=len(faces) + 1)


def test_mirrors_toward_a_box_are_those_of_all_paths_into_it_and_hardly_more(scenes):
    """Return boxes next to and above buildings, and all faces of paths over one face, at random positions of a box."""
    rng = np.random.default_rng(8)
    site = scenes.site(scenes.buildings(rng, 9, spread_m=120.0))
    faces = site_faces(site)
    growth, thinned = one_reflection(faces, np.array([[-200.0, -200, 0], [200, 200, 60]])), 0
    open_ = replace(faces, solid=np.full(len(faces), -1))  # nothing hides
    for _ in range(12):
        low = rng.uniform([-150, -150, 1], [120, 120, 30])
        box_m = np.array([low, low + rng.uniform(5, 30, 3)])
        near = growth.mirrors(SOURCE[0], box_m).tolist()
        paths = find_paths(open_, Links(SOURCE, rng.uniform(*box_m, (60, 3))), max_depth=1)
        met = set(paths.faces[paths.depth == 1, 0].tolist())
        assert met <= set(near)
        assert len(near) == len(set(near))
        thinned += len(faces) - len(near)
    assert thinned > 6 * len(faces)
    behind = np.array([[-1.0, -1.0, -30.0], [1.0, 1.0, -20.0]])  # under the ground nothing is lit
    assert not len(one_reflection(site_faces(scenes.site()), behind).mirrors(SOURCE[0], behind))


def test_paths_are_sorted_and_padded(scenes):
    site = scenes.site(scenes.buildings(np.random.default_rng(5), 6, spread_m=80.0))
    targets = np.random.default_rng(6).uniform([-90, -90, 15], [90, 90, 40], (50, 3))
    _, paths = search(site, targets)
    order = np.lexsort((*paths.faces.T[::-1], paths.depth, paths.tower, paths.pose))
    assert (order == np.arange(len(paths))).all()
    unused = np.arange(2) >= paths.depth[:, None]
    assert (unused == (paths.faces < 0)).all()
    assert (unused == np.isnan(paths.vertices_m[..., 0])).all()


def test_reflections_obey_the_law_of_reflection(scenes):
    site = scenes.site(scenes.buildings(np.random.default_rng(7), 8, spread_m=80.0))
    targets = np.random.default_rng(8).uniform([-90, -90, 15], [90, 90, 40], (80, 3))
    faces, paths = search(site, targets)
    double = paths.select(paths.depth == 2)
    assert len(double)
    points = np.concatenate(
        [np.broadcast_to(SOURCE, (len(double), 1, 3)), double.vertices_m, targets[double.pose][:, None]], axis=1
    )
    step = np.diff(points, axis=1)
    length = np.linalg.norm(step, axis=2)
    unit = step / length[..., None]
    for k in range(2):
        n = faces.normal[double.faces[:, k]]
        mirrored = unit[:, k] - 2 * np.einsum("ij,ij->i", unit[:, k], n)[:, None] * n
        assert mirrored == pytest.approx(unit[:, k + 1], abs=1e-9)
    image = images_of(faces, double.faces, np.broadcast_to(SOURCE[0], (len(double), 3)))[:, -1]
    assert length.sum(axis=1) == pytest.approx(np.linalg.norm(targets[double.pose] - image, axis=1), rel=1e-13)


def test_chunks_do_not_change_the_paths(scenes, monkeypatch):
    site = scenes.site(scenes.buildings(np.random.default_rng(9), 8, spread_m=80.0))
    targets = np.random.default_rng(10).uniform([-90, -90, 15], [90, 90, 40], (100, 3))
    _, at_once = search(site, targets)
    monkeypatch.setattr("aerpaw_cmp.propagation.search.mirror.CELLS_PER_CHUNK", 150)
    _, pieces = search(site, targets)
    assert (at_once.faces == pieces.faces).all()
    assert (at_once.pose == pieces.pose).all()


@settings(max_examples=40, deadline=None)
@given(st.floats(20, 3000), st.floats(0, 2 * np.pi), st.floats(0.5, 120.0), st.floats(0.5, 40.0))
def test_empty_field_has_line_of_sight_and_one_ground_reflection(distance, bearing, high, low):
    from aerpaw_cmp.propagation.geometry import Faces, Links

    ground = Faces(np.array([[0.0, 0.0, 1.0]]), np.zeros(1), ("medium_dry_ground",), ("ground",))
    source = np.array([[0.0, 0.0, low]])
    target = np.array([[distance * np.cos(bearing), distance * np.sin(bearing), high]])
    paths = find_paths(ground, Links(source, target), max_depth=3)
    assert paths.faces.tolist() == [[-1, -1, -1], [0, -1, -1]]
    share = low / (low + high)
    assert paths.vertices_m[1, 0] == pytest.approx([*(share * target[0, :2]), 0.0], abs=1e-9)


def test_direction_reversal_finds_the_same_paths(scenes):
    site = scenes.site(scenes.buildings(np.random.default_rng(11), 6, spread_m=60.0))
    faces = site_faces(site)
    targets = np.random.default_rng(12).uniform([-70, -70, 15], [70, 70, 30], (40, 3))
    there = find_paths(faces, Links(SOURCE, targets), max_depth=2)
    back = find_paths(faces, Links(targets, SOURCE), max_depth=2)
    turned = {
        (t, 0, *[f for f in row[::-1] if f >= 0], *[f for f in row if f < 0])
        for t, row in zip(back.tower.tolist(), back.faces.tolist(), strict=True)
    }
    assert scenes.keys(there) == turned


def test_path_along_a_wall_is_neither_lost_nor_blocked(scenes):
    # the wall's plane holds the tower and the first pose; the others are a hair on either side
    site = scenes.site([Building("b", box(20, -10, 40, 0), 30.0)])
    _, paths = search(site, [[60.0, 0.0, 10.0], [60.0, 1e-6, 10.0], [60.0, -1e-3, 10.0]], 0)
    assert paths.pose.tolist() == [0, 1]


def test_grazing_reflection_appears_exactly_when_the_pose_is_in_front(scenes):
    site = scenes.site([Building("b", box(20, -10, 40, -1e-3), 30.0)])
    faces, paths = search(site, [[60.0, 5e-4, 10.0], [60.0, -2e-3, 10.0], [60.0, -4e-4, 10.0]], 1)
    wall = next(i for i, n in enumerate(faces.normal) if n[1] == 1.0)
    assert set(paths.pose[paths.faces[:, 0] == wall]) == {0, 2}


def test_no_crack_between_two_walls_or_wall_and_roof(scenes):
    site = scenes.site([Building("b", box(20, -10, 40, 10), 15.0)])
    behind_corner = np.array([60.0, 30.0, 10.0])  # the line runs through the edges (20, 10)
    assert behind_corner[1] / behind_corner[0] == 10 / 20
    over_the_ridge = np.array([60.0, 0.0, 25.0])  # through the edge of wall and roof (20, ., 15)
    dead_behind = np.array([[60.0, 20.0, 10.0], [60.0, 0.0, 10.0], [60.0, 12.0, 24.9]])
    _, paths = search(site, dead_behind, 0)
    assert len(paths) == 0
    _, paths = search(site, [behind_corner + np.array([0, 1e-6, 0]), over_the_ridge + np.array([0, 0, 1e-6])], 0)
    assert paths.pose.tolist() == [0, 1]


def test_line_through_two_opposite_edges_is_hidden(scenes):
    square = Polygon([(20, 0), (30, -10), (40, 0), (30, 10)])  # the tower looks along its diagonal
    _, paths = search(scenes.site([Building("b", square, 15.0)]), [[60.0, 0.0, 10.0]], 0)
    assert len(paths) == 0


def test_court_hides_and_opens(scenes):
    court = box(20, -20, 60, 20).difference(box(30, -10, 50, 10))
    site = scenes.site([Building("court", court, 8.0)])
    # on the court's floor, above it, above the roof, and below the roofs but seen across the court
    _, paths = search(site, [[40.0, 0.0, 2.0], [40.0, 0.0, 9.0], [25.0, 0.0, 8.5], [48.0, 0.0, 7.2]], 0)
    assert paths.pose.tolist() == [1, 2, 3]


def test_overlapping_coplanar_walls_reflect_once(scenes):
    low = Building("low", box(30, -20, 40, 10), 20.0)
    high = Building("high", box(30, -10, 45, 20), 25.0)
    faces, paths = search(scenes.site([low, high]), [[10.0, 5.0, 10.0]], 1)
    assert len(set(planes_of(faces))) < len(faces)
    walls = [i for i, n in enumerate(faces.normal) if n[0] == -1.0]
    assert np.isin(paths.faces[:, 0], walls).sum() == 1


def test_two_parts_of_one_wall_both_reflect(scenes):
    parts = [Building("left", box(30, -20, 40, -1), 20.0), Building("right", box(30, 1, 40, 20), 20.0)]
    faces, paths = search(scenes.site(parts), [[10.0, 10.0, 10.0], [10.0, -10.0, 10.0], [10.0, 0.0, 10.0]], 1)
    walls = [i for i, n in enumerate(faces.normal) if n[0] == -1.0]
    on_wall = np.isin(paths.faces[:, 0], walls)
    assert paths.pose[on_wall].tolist() == [0, 1]  # the third would reflect in the gap


def test_budget_names_the_other_engine(scenes):
    site = scenes.site(scenes.buildings(np.random.default_rng(13), 10, spread_m=100.0))
    with pytest.raises(UsageError, match="engine 'sionna'"):
        search(site, [[50.0, 50.0, 30.0]], 2, budget=50)


@pytest.mark.parametrize("depth", [-1, 4])
def test_depth_outside_0_to_3_is_refused(scenes, depth):
    with pytest.raises(UsageError, match="max_depth"):
        search(scenes.site(), [[50.0, 50.0, 30.0]], depth)


def test_nan_positions_and_excluded_links_have_no_path(scenes):
    targets = np.array([[50.0, 0, 30], [np.nan, 0, 30], [70.0, 0, 30]])
    _, paths = search(scenes.site(), targets, excluded=np.array([[False, False, True]]))
    assert paths.pose.tolist() == [0, 0]


def test_triangular_roof_reflects_inside_its_polygon_only(scenes):
    shape = Polygon([(20, -10), (40, -10), (20, 10)])
    site = scenes.site([Building("b", shape, 5.0)])
    faces, paths = search(site, [[50.0, -15.0, 10.0], [65.0, 15.0, 10.0]], 1)
    roof = faces.label.index("b roof")
    assert paths.pose[paths.faces[:, 0] == roof].tolist() == [0]


def test_faces_that_may_not_reflect_do_not_at_any_place_of_a_sequence(scenes):
    site = scenes.site([Building("a", box(40, -50, 45, 50), 30.0)])
    faces = site_faces(site)
    target = np.array([[10.0, 20.0, 15.0]])
    all_paths = find_paths(faces, Links(SOURCE, target), max_depth=2)
    wall = int(np.flatnonzero(faces.normal[:, 0] == -1.0)[0])
    assert {0, wall} in [set(row) for row in all_paths.faces.tolist()]  # a corner reflection
    for face in (0, wall):
        usable = np.ones((1, len(faces)), dtype=bool)
        usable[0, face] = False
        some = find_paths(faces, Links(SOURCE, target, usable), max_depth=2)
        assert scenes.keys(some) == {key for key in scenes.keys(all_paths) if face not in key[2:]}
