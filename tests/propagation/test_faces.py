import numpy as np
import pytest
from shapely.geometry import Polygon, box

from aerpaw_cmp.propagation.geometry import corners, inside, inside_solids, site_faces, triangles
from aerpaw_cmp.site.site import Building

COURT = box(0, 0, 20, 20).difference(box(5, 5, 15, 15))


def barn(shape, height=6.0, **settings):
    return Building("barn", shape, height, **settings)


def test_box_has_ground_four_walls_and_a_roof(scenes):
    faces = site_faces(scenes.site([barn(box(10, -5, 30, 5))]))
    assert faces.label == ("ground", *(f"barn wall {i}" for i in range(1, 5)), "barn roof")
    assert faces.solid.tolist() == [-1, 0, 0, 0, 0, 0]
    centre = np.array([20.0, 0.0, 3.0])
    assert np.all(faces.normal[1:] @ centre < faces.offset_m[1:])  # outward
    assert faces.normal[1:5].sum(axis=0) == pytest.approx(0.0)


def test_axes_are_right_handed(scenes):
    faces = site_faces(scenes.site([barn(COURT)]))
    assert np.cross(faces.along, faces.across) == pytest.approx(faces.normal)


def test_collinear_vertices_make_no_further_walls(scenes):
    plain = site_faces(scenes.site([barn(box(0, 0, 20, 10))]))
    points = [(0, 0), (3, 0), (3.5, 0), (20, 0), (20, 7), (20, 10), (11, 10), (0, 10), (0, 5)]
    many = site_faces(scenes.site([barn(Polygon(points))]))
    assert len(many) == len(plain) == 6


def test_clockwise_footprint_gives_the_same_faces(scenes):
    ring = [(0, 0), (0, 10), (20, 10), (20, 0)]
    turned = site_faces(scenes.site([barn(Polygon(ring))]))
    plain = site_faces(scenes.site([barn(Polygon(ring[::-1]))]))
    assert {tuple(n) for n in turned.normal.round(9) + 0.0} == {tuple(n) for n in plain.normal.round(9) + 0.0}


def test_walls_of_a_court_look_into_it(scenes):
    faces = site_faces(scenes.site([barn(COURT)]))
    assert len(faces) == 1 + 8 + 1
    middle = np.array([10.0, 10.0, 3.0])
    in_front = faces.normal @ middle > faces.offset_m
    assert in_front[1:9].sum() == 4  # only the court's own walls


def test_walls_reach_below_the_ground(scenes):
    faces = site_faces(scenes.site([barn(box(0, 0, 20, 10), base_m=2.0)]))
    assert faces.lower[1:5, 1] == pytest.approx(-0.5)
    assert faces.upper[1:5, 1] == pytest.approx(8.0)


def test_one_ground_plane_per_ground_height(scenes):
    towers = ((0.0, 0.0, 10.0, 0.0), (100.0, 0.0, 10.0, 0.0), (200.0, 0.0, 10.0, -4.5))
    faces = site_faces(scenes.site(towers=towers))
    assert faces.offset_m.tolist() == [-4.5, 0.0]


def test_points_in_holes_are_not_on_the_roof(scenes):
    faces = site_faces(scenes.site([barn(COURT)]))
    roof = len(faces) - 1
    points = np.array([[2.0, 2, 6], [10, 10, 6], [10, 5, 6], [5, 5, 6], [-1e-3, 2, 6], [21, 3, 6]])
    assert inside(faces, np.full(6, roof), points, 1e-9).tolist() == [True, False, True, True, False, False]


def test_tolerance_reaches_over_the_edge_of_a_polygon_with_holes(scenes):
    faces = site_faces(scenes.site([barn(COURT)]))
    point = np.array([[10.0, 5.0 + 5e-4, 6.0]])
    roof = np.array([len(faces) - 1])
    assert not inside(faces, roof, point, 1e-9)[0]
    assert inside(faces, roof, point, 1e-3)[0]


@pytest.mark.parametrize("shape", [box(0, 0, 20, 20), COURT])
def test_negative_tolerance_leaves_the_edges_out(scenes, shape):
    faces = site_faces(scenes.site([barn(shape)]))
    roof = np.full(3, len(faces) - 1)
    points = np.array([[0.0, 2.0, 6.0], [1e-3, 2.0, 6.0], [2.0, 20.0, 6.0]])
    assert inside(faces, roof, points, 1e-6).tolist() == [True, True, True]
    assert inside(faces, roof, points, -1e-6).tolist() == [False, True, False]


@pytest.mark.parametrize("shape", [box(0, 0, 20, 10), COURT, Polygon([(0, 0), (9, 2), (4, 8)])])
def test_triangles_cover_the_faces_exactly_once(scenes, shape):
    faces = site_faces(scenes.site([barn(shape)]))
    vertices, triangle, owner = triangles(faces, reach_m=1000.0)
    a, b, c = (vertices[triangle[:, i]] for i in range(3))
    area = np.cross(b - a, c - a) / 2
    for face in range(1, len(faces)):
        mine = area[owner == face]
        assert (mine @ faces.normal[face] > 0).all()  # counter-clockwise from the front
        polygon = faces.polygon[face]
        full = polygon.area if polygon is not None else np.prod(faces.upper[face] - faces.lower[face])
        assert np.linalg.norm(mine.sum(axis=0)) == pytest.approx(full)
    height = np.einsum("ij,ikj->ik", faces.normal[owner], vertices[triangle]) - faces.offset_m[owner, None]
    assert np.abs(height).max() < 1e-9


def test_corners_lie_on_the_planes(scenes):
    faces = site_faces(scenes.site([barn(Polygon([(0, 0), (9, 2), (4, 8)]))]))
    height = np.einsum("ij,ikj->ik", faces.normal, corners(faces, 500.0)) - faces.offset_m[:, None]
    assert np.abs(height).max() < 1e-9


def test_inside_solids(scenes):
    site = scenes.site([barn(COURT)])
    points = np.array([[2.0, 2, 3], [2, 2, 7], [10, 10, 3], [2, 2, -1], [0, 2, 3], [2, 2, 6]])
    assert inside_solids(site, points).tolist() == [True, False, False, True, False, False]
