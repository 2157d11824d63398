"""The map job with a small engine of closed forms handed in."""

import tracemalloc

import numpy as np
import pytest

from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.maps.evaluate import interpolation_study, rank_fields
from aerpaw_cmp.maps.grid import (
    JOINT,
    PAPER_RANK_ALTITUDES_M,
    Evaluation,
    Grid,
    Layer,
    in_name,
    map_job,
    rank_of_singular_values,
)
from aerpaw_cmp.maps.kriging import Sampling

GRID = Grid.over_area((-300.0, 300.0, -300.0, 300.0))
TOWERS = {"A": np.array([-200.0, 0.0, 10.0]), "B": np.array([200.0, 50.0, 10.0])}


class Engine:
    """An engine with free space, a second singular value that falls with distance, and no path beyond a range."""

    def __init__(self, range_m=350.0, extra_loss_db=0.0):
        self.range_m, self.extra_loss_db = range_m, extra_loss_db
        self.calls = []

    def __call__(self, position_m):
        self.calls.append((len(position_m), float(position_m[0, 2])))
        towers = np.array(list(TOWERS.values()))
        d = np.linalg.norm(position_m[:, None] - towers[None], axis=-1)
        seen = d < self.range_m
        siso = np.where(seen, -40.0 - 20 * np.log10(d) - self.extra_loss_db, np.nan)
        largest = np.where(seen, 1.0 / d, np.nan)
        ratio = (20.0 / d) * (1 + 0.5 * np.sin(position_m[:, :1] / 40 + position_m[:, 2:] / 9))
        sigma = np.stack([largest, largest * ratio, largest * 1e-4, np.where(seen, 0.0, np.nan)], axis=-1)
        return Evaluation(siso, siso + 12.0, 0 * siso, sigma)


@pytest.fixture(scope="module")
def result():
    return map_job(
        GRID, TOWERS, Engine(), rss_altitudes_m=(30, 70), rank_altitudes_m=(3, 30, 40, 50), ks=(10, 100), chunk=150
    )


def test_each_altitude_is_evaluated_once_in_chunks():
    engine = Engine()
    map_job(GRID, TOWERS, engine, rss_altitudes_m=(30, 70), rank_altitudes_m=(3, 30), chunk=150)
    assert sorted({h for _, h in engine.calls}) == [3.0, 30.0, 70.0]
    assert sum(n for n, _ in engine.calls) == 3 * len(GRID)
    assert max(n for n, _ in engine.calls) == 150


def test_values_land_where_they_belong(result):
    direct = Engine()(GRID.positions_m(70.0))
    np.testing.assert_array_equal(result.rss("siso", "B")[1], direct.rss_siso_dbm[:, 1])
    np.testing.assert_array_equal(result.rss("mimo", "A")[1], direct.rss_mimo_dbm[:, 0])
    direct = Engine()(GRID.positions_m(40.0))
    np.testing.assert_array_equal(
        result.ranks("B")[2], rank_of_singular_values(direct.singular_values, (10, 100))[:, 1].T
    )
    near = np.where(
        np.abs(GRID.points_m - TOWERS["A"][:2]).sum(axis=1) < np.abs(GRID.points_m - TOWERS["B"][:2]).sum(axis=1), 0, 1
    )
    assert (result.serving == near).mean() > 0.9
    joint = result.ranks()[2]
    np.testing.assert_array_equal(joint[:, result.serving == 1], result.ranks("B")[2][:, result.serving == 1])
    spread = 20 * np.log10(direct.singular_values[:, 0, 0] / direct.singular_values[:, 0, 1])
    np.testing.assert_allclose(result.spread_db[2, 0], spread, rtol=1e-12)
    seen = np.isfinite(spread)
    assert np.isposinf(result.condition_db[2, 0][seen]).all(), "a zero singular value"
    assert np.isnan(result.condition_db[2, 0][~seen]).all()


def test_borders_part_equally_near_towers_and_end_at_the_edge_of_the_outer_cells(result):
    ends = np.concatenate([border.line_m for border in result.borders])
    away = [np.linalg.norm(ends - TOWERS[name][:2], axis=1) for name in ("A", "B")]
    np.testing.assert_allclose(*away, atol=1e-6)
    np.testing.assert_allclose(np.abs(ends).max(axis=1), GRID.east_m.max() + GRID.spacing_m / 2)


def test_chunks_do_not_change_the_result(result):
    other = map_job(
        GRID, TOWERS, Engine(), rss_altitudes_m=(30, 70), rank_altitudes_m=(3, 30, 40, 50), ks=(10, 100), chunk=400
    )
    for name in ("rss_siso_dbm", "rss_mimo_dbm", "rank", "spread_db", "condition_db"):
        np.testing.assert_array_equal(getattr(result, name), getattr(other, name))


def test_rank_rule_is_strict_and_knows_no_channel():
    sigma = np.array([[1.0, 0.1, 0.01, 0.001], [0.0, 0.0, 0.0, 0.0], [np.nan] * 4, [2.0, 2.0, 2.0, 2.0]])
    assert rank_of_singular_values(sigma, (10.0, 100.0, 1000.0)).tolist() == [
        [1, 2, 3],
        [0, 0, 0],
        [0, 0, 0],
        [4, 4, 4],
    ]


def test_out_of_coverage_is_counted_and_never_averaged(result):
    shares = result.rank_shares("A")
    np.testing.assert_allclose(shares.sum(axis=-1), 1.0)
    far = np.linalg.norm(GRID.positions_m(30.0) - TOWERS["A"], axis=1) >= 350.0
    assert shares[1, 0, 0] == pytest.approx(far.mean())
    assert result.coverage("siso", "A")[0] == pytest.approx(1 - far.mean())


def test_memory_grows_with_results_only():
    """Twice the altitudes cost twice the result and no more."""

    def peak(altitudes):
        tracemalloc.start()
        maps = map_job(GRID, TOWERS, Engine(), rss_altitudes_m=altitudes, rank_altitudes_m=altitudes, chunk=100)
        size = sum(
            getattr(maps, n).nbytes
            for n in ("rss_siso_dbm", "rss_mimo_dbm", "level_sd_db", "rank", "spread_db", "condition_db")
        )
        top = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return top - size

    few, many = peak(range(10, 60, 10)), peak(range(10, 410, 10))
    assert many < few + 200_000


def test_layer_names_take_any_altitude_k_and_tower():
    def column(name, **about):
        return Layer(name=name, quantity="", unit="", values=np.zeros((1, 1)), **about).column

    assert column("rss_siso", height_m=0.5, tower=JOINT) == "rss_siso_h0p5m_joint"
    assert column("rss_siso", height_m=1.0, tower=JOINT, foliage="none") == "rss_siso_h001m_joint_none"
    assert column(f"rank_k{in_name(12.5)}", height_m=2.5, tower="A b") == "rank_k12p5_h2p5m_A_b"
    assert column(f"rank_k{in_name(1e6)}", height_m=2.5, link="LW1 x") == "rank_k1000000_h2p5m_LW1_x"
    assert column("serving_tower") == "serving_tower"


def test_rank_study_runs_the_papers_comparison(result):
    heights, rank = rank_fields(result)
    study = interpolation_study(GRID, rank, result.towers_m, Sampling())
    assert heights == (30.0, 40.0, 50.0)
    assert rank.shape == (len(GRID), 3, 2)
    assert set(study.scores) == {"Kriging", "makima", "spline", "nearest", "inverse distance", "serving-tower mean"}
    for scores in study.scores.values():
        assert scores.mae.shape == (3, 2)
    assert 0 < study.correlation.positions <= len(GRID) - study.correlation.excluded_constant
    out = (result.ranks()[1:] == 0).sum(axis=-1)
    assert (study.scores["Kriging"].n <= len(GRID) - out).all()
    assert (study.scores["Kriging"].n > 0.9 * (len(GRID) - out)).all()
    assert study.scores["Kriging"].mae.mean() < study.scores["serving-tower mean"].mae.mean()
    zeros = interpolation_study(GRID, rank_fields(result, "zero")[1], result.towers_m, Sampling())
    assert (zeros.scores["Kriging"].n == len(GRID)).all()


def test_rank_study_of_a_flat_map_says_so():
    def flat(position_m):
        ones = np.ones((len(position_m), len(TOWERS)))
        return Evaluation(-ones, -ones, 0 * ones, np.stack([ones, 0 * ones, 0 * ones, 0 * ones], axis=-1))

    made = map_job(GRID, TOWERS, flat, rss_altitudes_m=(), rank_altitudes_m=(30, 40))
    study = interpolation_study(GRID, rank_fields(made)[1], made.towers_m, Sampling())
    assert study.fit.degenerate
    assert "the paper's curve is used" in study.fit.message
    assert (study.scores["Kriging"].mae == 0).all()
    assert study.correlation.excluded_constant == len(GRID)


def test_papers_altitudes():
    assert PAPER_RANK_ALTITUDES_M == (3, 30, 40, 50, 60, 70, 80, 90, 100, 110)


def test_no_tower_is_named():
    with pytest.raises(UsageError, match="no tower"):
        map_job(GRID, {}, Engine())


def test_rss_is_studied_like_rank(result):
    study = interpolation_study(GRID, np.moveaxis(result.rss_siso_dbm, -1, 0), result.towers_m, Sampling())
    assert study.scores["Kriging"].mae.shape == (2, 2)
    assert study.scores["Kriging"].mae.max() < 1.0, "free space is smooth"
    assert study.scores["Kriging"].mae.mean() < study.scores["nearest"].mae.mean()
