"""Check chords by sampling and bisection of the solids, tangents and grid edges. Check models against their tables."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.propagation.field import foliage
from aerpaw_cmp.propagation.field.foliage import (
    P833,
    P833_TABLE,
    CrownIndex,
    Opaque,
    crown_index,
    foliage_depth_m,
    foliage_loss_db,
    foliage_model,
)
from aerpaw_cmp.site.site import Trees

NO_VERTEX = np.zeros((1, 0, 3))


def trees(*rows: tuple[float, ...]) -> Trees:
    """Rows of east, north, ground, height, diameter, base."""
    columns = np.array(rows, dtype=float).reshape(-1, 6).T
    return Trees(*columns, np.full(columns.shape[1], 0.4))


def grove(count: int, seed: int) -> Trees:
    random = np.random.default_rng(seed)
    height = random.uniform(8, 25, count)
    return Trees(
        random.uniform(-60, 60, count),
        random.uniform(-60, 60, count),
        random.uniform(-3, 3, count),
        height,
        random.uniform(2, 14, count),
        height * random.uniform(0, 0.6, count),
        random.uniform(0.2, 1.0, count),
    )


def depth(start: object, end: object, stand: Trees, shape: str = "cone") -> float:
    ends = np.atleast_2d(np.asarray(start, dtype=float)), np.atleast_2d(np.asarray(end, dtype=float))
    return float(foliage_depth_m(ends[0], NO_VERTEX, ends[1], CrownIndex(stand, shape))[0])  # type: ignore[arg-type]


@settings(max_examples=60, deadline=None)
@given(
    st.integers(0, 10_000), st.sampled_from(["cone", "cylinder"]), st.floats(0.05, 0.95), st.floats(-math.pi, math.pi)
)
def test_reversal_splitting_and_turning_change_nothing(seed: int, shape: str, cut: float, angle: float) -> None:
    stand = grove(40, seed)
    random = np.random.default_rng(seed)
    start, end = (np.append(random.uniform(-70, 70, 2), random.uniform(0, 30)) for _ in range(2))
    full_m = depth(start, end, stand, shape)
    middle = start + cut * (end - start)
    turn = np.array([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]])
    turned = turn @ np.stack([stand.east_m, stand.north_m, np.zeros(40)])
    other = Trees(
        turned[0], turned[1], stand.ground_m, stand.height_m, stand.crown_diameter_m, stand.crown_base_m, stand.ground_m
    )
    assert depth(end, start, stand, shape) == pytest.approx(full_m, abs=1e-6)
    assert depth(start, middle, stand, shape) + depth(middle, end, stand, shape) == pytest.approx(full_m, abs=1e-6)
    assert depth(turn @ start, turn @ end, other, shape) == pytest.approx(full_m, abs=1e-6)


def test_reflected_path_adds_its_segments() -> None:
    stand = trees((0, 0, 0, 20, 10, 5), (100, 0, 0, 20, 10, 5))
    source, target = np.array([[-20.0, 0, 21], [-20, 0, 21]]), np.array([[120.0, 0, 21], [120, 0, 21]])
    vertex = np.array([[[50.0, 0, 0], [np.nan] * 3], [[np.nan] * 3, [np.nan] * 3]])
    depth_m = foliage_depth_m(source, vertex, target, stand)
    assert depth_m[0] == pytest.approx(depth(source[0], vertex[0, 0], stand) + depth(vertex[0, 0], target[0], stand))
    assert depth_m[0] > 0
    assert depth_m[1] == 0  # straight above both


def test_unknown_positions_have_unknown_depth() -> None:
    depth_m = foliage_depth_m(np.full((1, 3), np.nan), NO_VERTEX, np.zeros((1, 3)), trees((0, 0, 0, 20, 10, 5)))
    assert np.isnan(depth_m).all()


def test_no_trees_and_a_tree_that_is_not_a_number() -> None:
    assert depth([0, 0, 0], [9, 9, 9], Trees.none()) == 0
    with pytest.raises(UsageError, match="not a number"):
        CrownIndex(trees((math.nan, 0, 0, 20, 10, 5)))


@pytest.mark.parametrize(
    ("metres", "p48", "p68"), [(2, 0.9, 1.3), (5, 2.3, 3.3), (10, 4.5, 6.2), (20, 8.5, 11.4), (50, 17.8, 22.5)]
)
def test_tabulated_losses_at_3400_mhz(metres: float, p48: float, p68: float) -> None:
    at = np.array(float(metres))
    assert P833(0.48, 38.0).loss_db(at) == pytest.approx(p48, abs=0.06)
    assert P833(0.68, 38.0).loss_db(at) == pytest.approx(p68, abs=0.06)


def test_p833_table_is_met_and_continued_smoothly() -> None:
    for mhz, gamma, maximum in P833_TABLE:
        assert P833.at(mhz * 1e6).gamma_db_per_m == pytest.approx(gamma, rel=1e-9)
        assert P833.at(mhz * 1e6).maximum_db == pytest.approx(maximum, rel=1e-9)
    assert P833.at(3.4e9).gamma_db_per_m == pytest.approx(0.47, abs=0.01)
    assert P833.at(3.4e9).maximum_db == pytest.approx(41.8, abs=0.1)
    ladder = [P833.at(f) for f in np.geomspace(30e6, 100e9, 50)]
    assert all(a.gamma_db_per_m < b.gamma_db_per_m for a, b in itertools.pairwise(ladder))
    assert P833.at(3.4e9).gamma_db_per_m == pytest.approx(1.2 * P833.at(3.4e9, in_leaf=False).gamma_db_per_m)


def test_opaque_blocks_by_crown_and_trunk() -> None:
    stand = trees((0, 0, 0, 20, 10, 5))
    source = np.array([[-50.0, 0, 12], [-50, 0, 2], [-50, 3, 2]])
    target = source * [-1, 1, 1]
    args = (source, np.zeros((3, 0, 3)), target, stand)
    assert foliage_loss_db(*args, Opaque()).tolist() == [np.inf, np.inf, 0.0]  # crown, trunk, next to the trunk
    attenuated = foliage_loss_db(*args, P833(0.5, 38.0))
    chord = 2 * 5 * (20 - 12) / 15
    np.testing.assert_allclose(attenuated, [38 * (1 - math.exp(-0.5 * chord / 38)), 0, 0])


def test_models_by_name() -> None:
    assert foliage_model("attenuating", 3.4e9, gamma_db_per_m=0.6, maximum_db=30) == P833(0.6, 30)
    assert foliage_model("attenuating", 3.4e9, in_leaf=False) == P833.at(3.4e9, in_leaf=False)
    # the model comparison of a report replays opaque trees with the settings of the flight file
    assert foliage_model("opaque", 3.4e9, gamma_db_per_m=1, maximum_db=30) == Opaque()
    with pytest.raises(UsageError, match="gamma is -1"):
        foliage_model("attenuating", 3.4e9, gamma_db_per_m=-1)
    with pytest.raises(UsageError, match="30 MHz"):
        P833.at(3.4)


def test_the_index_of_equal_trees_is_made_once_and_of_others_anew():
    trees = grove(20, 3)
    index = crown_index(trees)
    assert crown_index(trees) is index
    taller = grove(20, 3)
    taller.height_m[7] += 1e-9
    assert crown_index(taller).trees is taller
    assert crown_index(grove(19, 3)).trees.east_m.shape == (19,)


SHAPES = ("cone", "cylinder")


def forest(*rows: tuple[float, ...]) -> Trees:
    """Rows of east, north, ground, height, diameter, base, trunk."""
    return Trees(*np.array(rows, dtype=float).reshape(-1, 7).T)


def inside(point, tree, shape):
    """Check whether points (n, 3) are in a crown, by the definition of each solid."""
    east, north, ground, height, diameter, base, _ = tree
    h = (point[:, 2] - ground - base) / (height - base)
    r = np.hypot(point[:, 0] - east, point[:, 1] - north) / (diameter / 2)
    wide = {"cone": 1 - h, "cylinder": np.ones_like(h)}[shape]
    return (h >= 0) & (h <= 1) & (r <= wide)


def chord(start, end, tree, shape):
    """Length inside, its ends found by bisection between points a thousandth of the line apart."""
    start, end = np.asarray(start, dtype=float), np.asarray(end, dtype=float)
    share = np.linspace(0, 1, 4001)
    within = inside(start + share[:, None] * (end - start), tree, shape)
    if not within.any():
        return 0.0
    ends = []
    for first, step in ((np.argmax(within), -1), (len(within) - 1 - np.argmax(within[::-1]), 1)):
        low, high = share[first], share[min(max(first + step, 0), 4000)]
        for _ in range(60):
            middle = (low + high) / 2
            if inside((start + middle * (end - start))[None], tree, shape)[0]:
                low = middle
            else:
                high = middle
        ends.append(low)
    return (ends[1] - ends[0]) * float(np.linalg.norm(end - start))


LINES = [
    ([-30, 0, 8], [30, 0, 8]), ([-30, 2, 12], [30, 2, 6]), ([-30, 1, 6], [30, -1, 14]),  # through, falling, rising
    ([0, 0, -5], [0, 0, 40]), ([1, 1, 40], [1, 1, 0]), ([2, -1, 7], [2, -1, 9]),  # plumb, either way, and within
    ([0.5, 0.3, 9], [0.5, 30, 9]), ([0.5, 0.3, 9], [20, 0, 30]), ([-20, 0, 30], [0.2, 0.1, 7]),  # an end inside
    ([3.9, -30, 5.01], [3.9, 30, 5.01]), ([-30, 0, 4.99], [30, 0, 4.99]), ([-30, 0, 17.01], [30, 0, 17.01]),
    ([-4.2, 0, 5], [-4.2 + 24, 0, 77]), ([5, 0, 5], [5 - 4.25, 0, 17]), ([-3, 0, 5], [0, 0, 17 + 1e-3]),
    ([0.1, 0, 10], [0.1, 0, 10.5]), ([0.1, 0, 16.6], [0.15, 0, 17.3]),  # plumb or steep, and shorter than a metre
    ([2, 0, 11], [2, 5, 11]), ([2, -5, 11], [2, 0, 11]),  # touching the cone's side where the line begins or ends
    ([0, -4, 5], [0, 4, 5]), ([0, -4, 17], [0, 4, 17]), ([-2, -2, 16.9], [2, 2, 16.9]),
    ([-1, 0, 16], [1, 0, 18]), ([-1, 0, 18], [1, 0, 16]), ([0, 0, 20], [0.1, 0, 16.5]), ([0, 0, 60], [40, 0, 20]),
]  # fmt: skip

TREE = (0.0, 0.0, 1.0, 16.0, 8.0, 4.0, 0.5)  # crown from 5 m to 17 m, 4 m in radius


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(("start", "end"), LINES)
def test_a_chord_is_what_lies_between_the_surfaces(start, end, shape):
    start, end = np.array(start, dtype=float), np.array(end, dtype=float)
    index = CrownIndex(forest(TREE), shape)
    expected = chord(start, end, TREE, shape)
    chord_m = index.chords_m(start[None], end[None])[0]
    assert chord_m == pytest.approx(expected, abs=2e-3 if expected else 1e-9)
    assert index.chords_m(end[None], start[None])[0] == pytest.approx(chord_m, abs=1e-9)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("seed", range(3))
def test_random_lines_through_one_crown(seed, shape):
    rng = np.random.default_rng(seed)
    start, end = rng.uniform([-6, -6, 2], [6, 6, 20], (2, 60, 3))
    end[:10, 2] = start[:10, 2]  # level
    end[10:20, :2] = start[10:20, :2]  # plumb
    chords_m = CrownIndex(forest(TREE), shape).chords_m(start, end)
    expected = [chord(a, b, TREE, shape) for a, b in zip(start, end, strict=True)]
    np.testing.assert_allclose(chords_m, expected, atol=1e-2)  # a graze shorter than the sampling may be missed by hand
    assert np.quantile(np.abs(chords_m - expected), 0.9) < 1e-8


def test_crowns_at_the_edges_of_the_grid_are_found_from_all_sides(monkeypatch):
    """A row of trees apart, lines that begin and end beyond the grid, near its first and last cells, in small batches."""
    rows = [(x, y, 0.0, 10.0, 4.0, 2.0, 0.4) for x in (-90.0, 0.0, 90.0) for y in (-60.0, 0.0, 60.0)]
    stand = forest(*rows)
    rng = np.random.default_rng(5)
    start, end = rng.uniform([-150, -120, 0], [150, 120, 12], (2, 400, 3))
    for i, row in enumerate(rows):  # through each tree, from outside to outside, and just past it
        start[i], end[i] = [row[0] - 200, row[1], 5.0], [row[0] + 200, row[1], 5.0]
        start[9 + i], end[9 + i] = [row[0], row[1] - 200, 3.0], [row[0], row[1] + 200, 3.0]
        start[18 + i], end[18 + i] = [row[0] + 1.99, row[1] - 1.0, 2.1], [row[0] + 1.99, row[1] + 1.0, 2.1]
    expected = np.zeros(400)
    bodies = CrownIndex(stand)._bodies
    for body in bodies:
        share = foliage._chord_share(start, end - start, np.broadcast_to(body, (400, 5)), "cylinder")
        expected += share * np.linalg.norm(end - start, axis=1)
    for cell, piece, pairs in ((None, None, None), (4.0, 3.0, 5), (1000.0, 2.0, 40), (7.0, 1000.0, 1)):
        for name, value in (("_CELL_M", cell), ("_PIECE_M", piece), ("_PAIRS_AT_ONCE", pairs)):
            if value is not None:
                monkeypatch.setattr(foliage, name, value)
        np.testing.assert_allclose(CrownIndex(stand, "cylinder").chords_m(start, end), expected, atol=1e-9)
    assert (expected[:9] >= 12.0 - 1e-9).all()  # three crowns of 4 m in a row
    assert (expected[18:27] > 0.3).all()


@pytest.mark.parametrize("low", [2.0, 5.0])
def test_a_level_line_lies_within_a_slab_up_to_its_faces(low):
    at, step = np.array([low - 1e-12, low, low + 1.0, low + 3.0, low + 3.0 + 1e-12]), np.zeros(5)
    first, last = foliage.slab(at, step, low, low + 3.0)
    assert (last >= first).tolist() == [False, True, True, True, False]
    first, last = foliage.slab(np.array([0.0, 10.0, 0.0, 3.0]), np.array([10.0, -10.0, 1.0, 1.0]), 2.0, 5.0)
    np.testing.assert_allclose(first, [0.2, 0.5, 1.0 + 1.0, 0.0])
    np.testing.assert_allclose(last, [0.5, 0.8, 1.0, 1.0])


def test_models_are_their_formulas_to_the_last_digits():
    metres = np.array([0.0, 3.0, 14.0, 14.5, 200.0])
    loss_db = foliage.P833(0.2, 0.5).loss_db(metres)  # less than a decibel either
    np.testing.assert_allclose(loss_db, 0.5 * (1 - np.exp(-0.2 * metres / 0.5)), rtol=1e-12)
    assert foliage.P833(0.0, 10.0).loss_db(metres).tolist() == [0.0] * 5
    for gamma, most in ((-0.1, 10.0), (0.5, 0.0), (np.nan, 1.0), (0.5, np.inf), (np.inf, 1.0)):
        with pytest.raises(UsageError, match="gamma >= 0 and A_m > 0"):
            foliage.P833(gamma, most)


@pytest.mark.parametrize("count", [1, 2, 7, 8])
def test_batches_of_one_segment_come_to_the_last(count, monkeypatch):
    monkeypatch.setattr(foliage, "_PAIRS_AT_ONCE", 1)
    start = np.column_stack([np.full(count, -9.0), np.linspace(-3, 3, count), np.full(count, 8.0)])
    end = start + np.array([18.0, 0.0, 0.0])
    chords_m = CrownIndex(forest(TREE), "cylinder").chords_m(start, end)
    np.testing.assert_allclose(chords_m, 2 * np.sqrt(16.0 - start[:, 1] ** 2), rtol=1e-12)


def test_p833_is_refused_outside_of_its_scope_and_taken_at_its_ends():
    for hz in (30e6, 100e9):
        assert np.isfinite(foliage.P833.at(hz).loss_db(np.array([10.0]))).all()
        with pytest.raises(UsageError, match="30 MHz to 100 GHz"):
            foliage.P833.at(float(np.nextafter(hz, 0.0 if hz < 1e9 else np.inf)))
