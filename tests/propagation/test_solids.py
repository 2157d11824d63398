import os

import numpy as np
import pytest
import shapely
from shapely.geometry import Polygon, box

from aerpaw_cmp.propagation.geometry import Links, inside_solids, site_faces
from aerpaw_cmp.propagation.replay import replay
from aerpaw_cmp.propagation.search.mirror import Occlusion, convex_pieces, find_paths
from aerpaw_cmp.site.site import Building
from tests.propagation import exact

ELL = Polygon([(0, 0), (20, 0), (20, 10), (10, 10), (10, 20), (0, 20)])


def paths_of(scenes, buildings, source, targets, max_depth=2):
    site = scenes.site(buildings)
    faces, targets = site_faces(site), np.atleast_2d(np.asarray(targets, float))
    excluded = inside_solids(site, targets)[None]
    return faces, find_paths(faces, Links(np.array([source], float), targets, excluded=excluded), max_depth=max_depth)


def cut(buildings, scenes, start, end):
    hiding = Occlusion(site_faces(scenes.site(buildings)), 1e-10)
    return bool(hiding.segments(np.array([start], float), np.array([end], float))[0])


@pytest.mark.parametrize(
    ("source", "target", "expected"),
    # the ground under the box, met through its edge; through the edges of its roof
    [((40, 40, 5), (-40, -40, 5), set()), ((20, 0, 16), (-20, 0, 16), {(), ((2, 1, 8),)})],
)
def test_no_bounce_inside_a_building(scenes, source, target, expected):
    building = Building("b", box(-10, -10, 10, 10), 8.0)
    faces, paths = paths_of(scenes, [building], source, target, 1)
    assert exact.planes_found(paths, faces, 0) == expected
    assert exact.paths([(-10, 10, -10, 10, 8)], source, target, 1) == expected


@pytest.mark.parametrize("boxes", [1, 2, 3, 4])
def test_same_paths_as_rational_arithmetic_on_aligned_geometry(scenes, boxes):
    """The number of scenes can be raised for a longer test, see docs/numerics.md."""
    rng = np.random.default_rng(boxes)
    touching = 0
    for _ in range(int(os.environ.get("AERPAW_CMP_EXACT_SCENES", "12"))):
        solids, source, targets = exact.random_scene(rng, boxes)
        footprints = [box(w, s, e, n) for w, e, s, n, _ in solids]
        touching += any(a.touches(b) for a in footprints for b in footprints)
        buildings = [Building(f"b{i}", f, float(b[4])) for i, (f, b) in enumerate(zip(footprints, solids, strict=True))]
        faces, paths = paths_of(scenes, buildings, source, targets)
        for pose, target in enumerate(targets):
            where = (solids, source, target)
            assert exact.planes_found(paths, faces, pose) == exact.paths(*where), where
    assert touching or boxes < 3


@pytest.mark.parametrize(("north", "hidden"), [(-5.0, True), (12.0, False)])
def test_seam_of_two_touching_buildings_hides(scenes, north, hidden):
    # they touch at east = 0 from north -10 to 10; beyond, only the first has a wall there
    pair = [Building("a", box(-10, -10, 0, 30), 8.0), Building("b", box(0, -10, 10, 10), 8.0)]
    assert cut(pair, scenes, [0, north, 4], [0, 40, 4]) is hidden
    assert cut(pair, scenes, [0, 40, 4], [0, north, 4]) is hidden
    assert not cut(pair, scenes, [0, north, 8], [0, 40, 8])  # along both roofs
    assert not cut(pair[:1], scenes, [0, north, 4], [0, 40, 4])  # along one wall


def test_seam_below_the_lower_of_two_roofs_hides(scenes):
    pair = [Building("a", box(-10, -10, 0, 10), 8.0), Building("b", box(0, -10, 10, 10), 12.0)]
    assert cut(pair, scenes, [0, -40, 6], [0, 40, 6])
    assert not cut(pair, scenes, [0, -40, 9], [0, 40, 9])  # along the higher one's wall
    assert cut(pair, scenes, [0, -40, 13], [0, 40, 1])


def test_walls_that_meet_within_rounding_leave_no_crack(scenes):
    turn = np.radians(33.0)
    axes = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    pair = [
        Building(name, shapely.transform(shape, lambda p: p @ axes + 1234.5), 8.0)
        for name, shape in (("a", box(-10, -10, 0, 10)), ("b", box(0, -10, 10, 10)))
    ]
    start, end = (np.append(np.array([0.0, y]) @ axes + 1234.5, 4.0) for y in (-40.0, 40.0))
    hiding = Occlusion(site_faces(scenes.site(pair)), 1e-12 * 1300)
    assert hiding.segments(start[None], end[None]).tolist() == [True]
    assert hiding.segments(end[None], start[None]).tolist() == [True]


@pytest.mark.parametrize("step", [(7.0, 1.0), (1.0, 1.0), (0.0, 1.0)])
def test_no_crack_along_the_cuts_of_an_l_shaped_building(scenes, step):
    """Through the inner corner, in whatever direction the pieces were cut there."""
    middle, step = np.array([10.0, 10.0]), np.array(step)
    start, end = np.append(middle - 30 * step, 3.0), np.append(middle - 1e-3 * step, 3.0)
    assert cut([Building("L", ELL, 8.0)], scenes, start, end)


def test_four_buildings_round_a_corner_hide_what_falls_down_their_edge(scenes):
    quarters = [box(0, 0, 10, 10), box(-10, 0, 0, 10), box(-10, -10, 0, 0), box(0, -10, 10, 0)]
    four = [Building(f"q{i}", shape, 8.0) for i, shape in enumerate(quarters)]
    assert cut(four, scenes, [0, 0, 20], [0, 0, 2])
    assert not cut(four[:3], scenes, [0, 0, 20], [0, 0, 2])


@pytest.mark.parametrize(
    "shape",
    [
        ELL,
        box(0, 0, 30, 30).difference(box(10, 10, 20, 20)),
        Polygon([(0, 0), (8, 2), (20, 0), (16, 9), (20, 20), (9, 15), (0, 20), (4, 10)]),
    ],
)
def test_convex_pieces_make_the_footprint(shape):
    pieces = convex_pieces(shape)
    assert shapely.union_all(pieces).symmetric_difference(shape).area < 1e-9
    assert sum(p.area for p in pieces) == pytest.approx(shape.area, rel=1e-12)
    assert all(p.convex_hull.area == pytest.approx(p.area, rel=1e-12) for p in pieces)
    assert 1 < len(pieces) < len(shapely.get_parts(shapely.constrained_delaunay_triangles(shape)))


def test_field_goes_on_smoothly_to_the_ground_a_wall_and_a_roof(scenes):
    site = scenes.site([Building("barn", box(30, -10, 50, 10), 8.0)])
    for on, out in (([20.0, 3.0, 0.0], [0, 0, 1]), ([30.0, 3.0, 4.0], [-1, 0, 0]), ([40.0, 3.0, 8.0], [0, 0, 1])):
        near = np.asarray(on) + np.outer([0.0, 1e-10, 1e-7, 1e-5], out)
        rss = replay(site, scenes.link(site), scenes.poses(near)).rss_dbm[:, 0]
        assert rss == pytest.approx(rss[0], abs=1e-3)


@pytest.mark.parametrize("turn", [False, True])
def test_points_inside_the_planes_are_those_inside_a_building(scenes, turn):
    """Compare with shapely: convex or not, with a court, with a repeated corner, in both orientations, adjacent."""
    shapes = [
        box(0, 0, 12, 7),
        Polygon([(20, 0), (31, 2), (31, 2), (25, 9)]),
        Polygon([(40, 0), (60, 0), (60, 5), (45, 5), (45, 15), (40, 15)]),
        box(70, 0, 90, 20).difference(box(75, 5, 85, 15)),
    ]
    shapes = [shapely.reverse(shape) if turn else shape for shape in shapes]
    site = scenes.site(buildings=[Building(f"b{i}", shape, 4.0 + i) for i, shape in enumerate(shapes)])
    hiding = Occlusion(site_faces(site), 1e-9)
    rng = np.random.default_rng(2)
    points = np.column_stack([rng.uniform(-3, 95, 4000), rng.uniform(-3, 23, 4000), rng.uniform(0.1, 9, 4000)])
    inside = np.zeros((len(points), len(shapes)), dtype=bool)
    for number, pieces in enumerate(hiding.parts):
        for normal, offset in (hiding.pieces[piece] for piece in pieces):
            assert np.allclose(np.linalg.norm(normal, axis=1), 1.0)
            inside[:, number] |= (points @ normal.T < offset).all(axis=1)
    for number, shape in enumerate(shapes):
        under = shapely.contains_xy(shape, points[:, 0], points[:, 1]) & (points[:, 2] < 4.0 + number)
        assert (inside[:, number] == under).all()
        assert under.sum() > 20
