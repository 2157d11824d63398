"""Index order, serving areas and their borders, coverage classes."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.maps.grid import Grid, serving_tower, voronoi_borders

AREA = (-540.0, 540.0, -1065.0, 1065.0)


def test_paper_grid():
    grid = Grid.over_area(AREA)
    points = grid.points_m
    assert len(grid) == len(points) == 2556
    assert grid.shape == (71, 36)
    assert points[0].tolist() == points.min(axis=0).tolist(), "index 1 is the south-west corner"
    assert points[-1].tolist() == points.max(axis=0).tolist(), "the last index is the north-east corner"
    assert (points[1] - points[0]).tolist() == [30.0, 0.0]
    assert (points[36] - points[0]).tolist() == [0.0, 30.0]
    # cells fill the area exactly
    assert (points.min(axis=0) - 15).tolist() == [-540.0, -1065.0]
    assert (points.max(axis=0) + 15).tolist() == [540.0, 1065.0]


def test_raster_and_index_are_inverse():
    grid = Grid.over_area(AREA)
    assert (grid.index_of(grid.points_m) == np.arange(2556)).all()
    assert (grid.index_of(grid.points_m + np.array([14.9, -14.9])) == np.arange(2556)).all()
    assert grid.raster(np.arange(2556))[1, 0] == 36
    assert grid.raster(np.zeros((2556, 3))).shape == (71, 36, 3)
    assert grid.index_of([[-541.0, 0.0], [0.0, 1066.0], [np.inf, 0.0]]).tolist() == [-1, -1, -1]
    assert grid.positions_m(30.0)[7].tolist() == [*grid.points_m[7], 30.0]


def test_spacing_that_is_no_binary_fraction_keeps_the_count():
    assert Grid.over_area((0.0, 0.9, 0.0, 0.7), 0.1).shape == (7, 9)


def test_remainder_is_shared_by_both_sides():
    grid = Grid.over_area((0.0, 100.0, 0.0, 40.0), 30.0)
    assert grid.east_m.tolist() == [20.0, 50.0, 80.0]


@pytest.mark.parametrize("spacing", [0.0, -1.0, 2000.0])
def test_no_cell_is_refused(spacing):
    with pytest.raises(UsageError, match="no cell"):
        Grid.over_area(AREA, spacing)


def test_nearest_tower_serves_and_ties_go_to_the_first():
    towers = [[0.0, 0.0, 10.0], [100.0, 0.0, 99.0]]
    assert serving_tower([[10.0, 5.0], [90.0, 5.0], [50.0, 7.0]], towers).tolist() == [0, 1, 0]
    with pytest.raises(UsageError, match="no tower"):
        serving_tower([[0.0, 0.0]], np.zeros((0, 2)))


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(st.integers(-500, 500), st.integers(-1000, 1000)), min_size=2, max_size=6, unique=True))
def test_borders_part_the_serving_areas(places):
    """On a border, two towers are equally near. A step to either side changes the serving tower."""
    towers = np.array(places, dtype=float)
    borders = voronoi_borders(towers, AREA)
    assert borders, "all towers are in the area"
    for border in borders:
        a, b = border.towers
        along = border.line_m[1] - border.line_m[0]
        across = 1e-6 * np.linalg.norm(along) * (towers[b] - towers[a]) / np.linalg.norm(towers[b] - towers[a])
        for share in (0.1, 0.5, 0.9):
            point = border.line_m[0] + share * along
            servers = [np.hypot(*(towers - point - side * across).T).argmin() for side in (-1, 1)]
            assert servers == [a, b]
            far = np.hypot(*(towers - point).T)
            assert far[a] == pytest.approx(far[b], rel=1e-9, abs=1e-6)
            assert far.min() == pytest.approx(far[a], rel=1e-9, abs=1e-6)
            assert -540 - 1e-6 <= point[0] <= 540 + 1e-6
            assert -1065 - 1e-6 <= point[1] <= 1065 + 1e-6


def test_every_change_of_server_on_the_grid_crosses_a_border():
    towers = np.array([[0.0, 0.0], [300.0, 200.0], [-400.0, 600.0], [100.0, -700.0], [-300.0, -500.0]])
    grid = Grid.over_area(AREA)
    server = grid.raster(serving_tower(grid.points_m, towers))
    pairs = {border.towers for border in voronoi_borders(towers, AREA)}
    across = np.stack([server[:, :-1].ravel(), server[:, 1:].ravel()], axis=1)
    above = np.stack([server[:-1].ravel(), server[1:].ravel()], axis=1)
    changes = {tuple(sorted(p)) for p in np.vstack([across, above]).tolist() if p[0] != p[1]}
    assert changes <= pairs
    assert len(pairs) >= 4


def test_collinear_and_coincident_towers_have_borders_or_none():
    lines = voronoi_borders([[-100.0, 0.0], [0.0, 0.0], [100.0, 0.0]], AREA)
    assert [b.towers for b in lines] == [(0, 1), (1, 2)]
    assert sorted(abs(lines[0].line_m[:, 1])) == [1065.0, 1065.0]
    assert voronoi_borders([[0.0, 0.0], [0.0, 0.0]], AREA) == ()
    assert [b.towers for b in voronoi_borders([[0.0, 0.0], [0.0, 0.0], [100.0, 0.0]], AREA)] == [(0, 2)]
    assert voronoi_borders([[0.0, 0.0]], AREA) == ()
