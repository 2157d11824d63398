import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from shapely.geometry import Polygon, box

from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.site.site import Forest
from aerpaw_cmp.site.siteyaml import TreeSizes, _first_come, place_trees, wanted_trees

SQUARE = Forest("wood", box(0, 0, 200, 200), 100.0, 4.0)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**31), st.floats(0, 12), st.floats(0, 300))
def test_spacing_and_outline_hold_for_any_seed(seed: int, spacing: float, density: float) -> None:
    area = Polygon([(0, 0), (120, 10), (60, 50), (130, 110), (5, 90)], [[(20, 20), (40, 20), (40, 40)]])
    forest = Forest("w", area, density, spacing)
    trees = place_trees(forest, seed=seed)
    assert len(trees) <= wanted_trees(forest)
    if len(trees) > 1:
        points = np.column_stack([trees.east_m, trees.north_m])
        assert cKDTree(points).query(points, k=2)[0][:, 1].min() >= spacing
    assert all(area.contains(p) for p in map(lambda e, n: box(e, n, e, n).centroid, trees.east_m, trees.north_m))


def test_density_is_met_and_uniform() -> None:
    trees = place_trees(Forest("w", box(0, 0, 1000, 1000), 100, 4.0), seed=5)
    assert len(trees) == 10_000
    counts = np.histogram2d(trees.east_m, trees.north_m, bins=10, range=[[0, 1000]] * 2)[0]
    assert counts.mean() == 100
    assert counts.std() < 10.5  # below Poisson's 10: spacing makes the stand more regular
    assert abs(trees.east_m.mean() - 500) < 4 * 289 / math.sqrt(10_000)


def test_same_seed_same_trees_and_forests_are_independent() -> None:
    forest, again, other = place_trees(SQUARE, seed=1), place_trees(SQUARE, seed=1), place_trees(SQUARE, seed=2)
    np.testing.assert_array_equal(forest.east_m, again.east_m)
    assert not np.array_equal(forest.east_m, other.east_m)
    renamed = place_trees(Forest("grove", SQUARE.area, 100, 4.0), seed=1)
    assert not np.array_equal(forest.east_m, renamed.east_m)


def test_a_full_forest_stops_at_random_packing() -> None:
    trees = place_trees(Forest("w", box(0, 0, 300, 300), 400, 6.0), seed=1)
    covered = len(trees) * math.pi * 3**2 / 306**2
    assert 0.47 < covered < 0.56  # discs thrown at random fill 0.547 of a plane (Renyi's constant in two dimensions)


def test_first_come_is_what_throwing_one_by_one_gives() -> None:
    points = np.random.default_rng(3).random((300, 2)) * 40
    standing: list[int] = []
    for i, point in enumerate(points):
        if all(np.hypot(*(point - points[j])) >= 3 for j in standing):
            standing.append(i)
    assert np.flatnonzero(_first_come(points, 3.0)).tolist() == standing


def test_trunks_keep_clear() -> None:
    trees = place_trees(SQUARE, keep_clear=box(0, 0, 100, 200))
    assert trees.east_m.min() >= 100
    assert len(trees) == 200


def test_sizes() -> None:
    trees = place_trees(SQUARE, TreeSizes(height_m=18.0, crown_base_fraction=0.3))
    assert set(trees.height_m) == {18.0}
    np.testing.assert_allclose(trees.crown_base_m, 0.3 * 18.0)


def test_the_papers_tree_is_the_default() -> None:
    trees = place_trees(SQUARE)
    assert (set(trees.height_m), set(trees.crown_diameter_m)) == ({20.0}, {10.0})


def test_impossible_wishes() -> None:
    with pytest.raises(UsageError, match="requires 100000000 trees"):
        place_trees(Forest("w", box(0, 0, 1e5, 1e5), 100, 4))
    with pytest.raises(ValueError, match="crown_base_fraction"):
        TreeSizes(crown_base_fraction=1.0)
    assert len(place_trees(Forest("w", box(0, 0, 10, 10), 0, 4))) == 0
