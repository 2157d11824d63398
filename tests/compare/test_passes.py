"""Every pair of a season's passes: those of brute force, exactly; intervals as the bootstrap gives them."""

import numpy as np
import pytest

from aerpaw_cmp.compare.passes import Pass, PassTable
from aerpaw_cmp.compare.statistics import correlation

RADIUS_M, WITHIN_DEG, CELL_M = 3.0, 20.0, 20.0
FLIGHTS, LINKS, SAMPLES = 7, 3, 160


def season(seed: int = 0) -> list[Pass]:
    """Lawnmower routes at two heights, each flight a metre or two off; links sampled together but for NaN of their own."""
    rng = np.random.default_rng(seed)
    share = np.linspace(0.0, 1.0, SAMPLES)
    leg, along = np.floor(share * 4), (share * 4) % 1
    along = np.where(leg % 2 == 0, along, 1 - along)
    passes = []
    for flight in range(FLIGHTS):
        away = rng.normal(0.0, 1.0, 3)
        place = np.column_stack([along * 120 - 60, leg * 25, np.full(SAMPLES, 30.0 + 20.0 * (flight % 2))])
        place = place + away + rng.normal(0.0, 0.5, place.shape)
        place[5] = np.nan
        heading = np.where(leg % 2 == 0, 90.0, 270.0) + rng.normal(0.0, 12.0, SAMPLES)
        for link in range(LINKS):
            level = -70.0 + rng.normal(0.0, 2.0, SAMPLES)
            residual = level + 70.0
            level[rng.random(SAMPLES) < 0.1] = np.nan
            residual[rng.random(SAMPLES) < 0.1] = np.nan
            passes.append(
                Pass(
                    flight=f"f{flight}",
                    link=f"l{link}",
                    position_m=place,
                    level_db=level,
                    residual_db=residual,
                    heading_deg=None if flight == 3 else heading,
                )
            )
    return passes


def brute_force(one: Pass, two: Pass, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Second minus first, by a table of all distances."""
    i = np.flatnonzero(np.isfinite(first) & np.isfinite(one.position_m).all(axis=1))
    j = np.flatnonzero(np.isfinite(second) & np.isfinite(two.position_m).all(axis=1))
    distance = np.linalg.norm(one.position_m[i][:, None] - two.position_m[j][None], axis=2)
    out = []
    for row, nearest in enumerate(distance.argmin(axis=1)):
        if distance[row, nearest] >= RADIUS_M:
            continue
        if one.heading_deg is not None and two.heading_deg is not None:
            turn = (two.heading_deg[j[nearest]] - one.heading_deg[i[row]] + 180.0) % 360.0 - 180.0
            if abs(turn) > WITHIN_DEG:
                continue
        out.append(second[j[nearest]] - first[i[row]])
    return np.array(out)


def cells(one: Pass) -> dict[tuple[int, int], tuple[float, float]]:
    found: dict[tuple[int, int], list[tuple[float, float]]] = {}
    for place, residual in zip(one.position_m, one.residual_db, strict=True):
        if np.isfinite(residual) and np.isfinite(place).all():
            cell = (int(place[0] // CELL_M), int(place[1] // CELL_M))
            found.setdefault(cell, []).append((float(residual), float(place[2])))
    return {cell: tuple(np.mean(found[cell], axis=0)) for cell in sorted(found)}


def test_the_pairs_are_those_of_brute_force() -> None:
    """Numbers, not only counts: one wrong partner among the samples changes mean and deviation."""
    passes = season()
    found = {
        (p.first, p.second): p
        for p in PassTable(passes, CELL_M).pairs(radius_m=RADIUS_M, heading_within_deg=WITHIN_DEG)
    }
    expected = [
        (i, j)
        for i, one in enumerate(passes)
        for j, two in enumerate(passes)
        if i < j and one.link == two.link and one.flight != two.flight
    ]
    assert sorted(found) == sorted(expected)
    assert any(p.n == 0 for p in found.values())
    assert sum(p.n > 50 for p in found.values()) > 10
    for (i, j), pair in found.items():
        one, two = passes[i], passes[j]
        level = brute_force(one, two, one.level_db, two.level_db)
        residual = brute_force(one, two, one.residual_db, two.residual_db)
        assert pair.n == len(level)
        if pair.n:
            assert (pair.rmse_db, pair.offset_db) == (level.std(), level.mean())
        if len(residual):
            assert pair.residual_rmse_db == residual.std()
        here, there = cells(one), cells(two)
        both = [c for c in here if c in there]
        assert pair.cells == len(both)
        table = np.array([(*here[c], *there[c]) for c in both])
        assert pair.place_correlation == pytest.approx(correlation(table[:, 0], table[:, 2]), nan_ok=True)
        assert pair.place_rmse_db == pytest.approx((table[:, 2] - table[:, 0]).std())
        assert pair.height_difference_m == pytest.approx(np.median(table[:, 3] - table[:, 1]))
