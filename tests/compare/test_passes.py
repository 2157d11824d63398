"""Pairs of passes of a campaign: equal to brute force, with intervals like those of the bootstrap."""

import numpy as np
import pytest

from aerpaw_cmp.compare.statistics import Pass, correlation, pass_pairs

RADIUS_M, WITHIN_DEG, CELL_M = 3.0, 20.0, 20.0
FLIGHTS, LINKS, SAMPLES = 7, 3, 160


def season(seed: int = 0) -> list[Pass]:
    """Simulate lawnmower flights at two heights, each shifted by a metre or two.

    All links have the same sample times, but each link has its own NaN.
    """
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
                    tower="T",
                    channel=f"l{link}",
                    position_m=place,
                    level_db=level,
                    residual_db=residual,
                    heading_deg=None if flight == 3 else heading,
                )
            )
    return passes


def brute_force(earlier: Pass, later: Pass, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Second minus first, by a table of all distances."""
    i = np.flatnonzero(np.isfinite(first) & np.isfinite(earlier.position_m).all(axis=1))
    j = np.flatnonzero(np.isfinite(second) & np.isfinite(later.position_m).all(axis=1))
    distance = np.linalg.norm(earlier.position_m[i][:, None] - later.position_m[j][None], axis=2)
    out = []
    for row, nearest in enumerate(distance.argmin(axis=1)):
        if distance[row, nearest] >= RADIUS_M:
            continue
        if earlier.heading_deg is not None and later.heading_deg is not None:
            turn = (later.heading_deg[j[nearest]] - earlier.heading_deg[i[row]] + 180.0) % 360.0 - 180.0
            if abs(turn) > WITHIN_DEG:
                continue
        out.append(second[j[nearest]] - first[i[row]])
    return np.array(out)


def cells(flown: Pass) -> dict[tuple[int, int], tuple[float, float]]:
    samples: dict[tuple[int, int], list[tuple[float, float]]] = {}
    for place, residual in zip(flown.position_m, flown.residual_db, strict=True):
        if np.isfinite(residual) and np.isfinite(place).all():
            cell = (int(place[0] // CELL_M), int(place[1] // CELL_M))
            samples.setdefault(cell, []).append((float(residual), float(place[2])))
    return {cell: tuple(np.mean(samples[cell], axis=0)) for cell in sorted(samples)}


def test_the_pairs_are_those_of_brute_force() -> None:
    """Numbers, not only counts: one wrong partner among the samples changes mean and deviation."""
    passes = season()
    number = {(p.flight, p.channel): i for i, p in enumerate(passes)}
    by_passes = {
        (number[p.first, p.channel], number[p.second, p.channel]): p
        for p in pass_pairs(passes, cell_m=CELL_M, radius_m=RADIUS_M, heading_within_deg=WITHIN_DEG)
    }
    expected = [
        (i, j)
        for i, earlier in enumerate(passes)
        for j, later in enumerate(passes)
        if i < j and earlier.channel == later.channel and earlier.flight != later.flight
    ]
    assert list(by_passes) == expected
    assert any(p.n == 0 for p in by_passes.values())
    assert sum(p.n > 50 for p in by_passes.values()) > 10
    for (i, j), pair in by_passes.items():
        earlier, later = passes[i], passes[j]
        level = brute_force(earlier, later, earlier.level_db, later.level_db)
        residual = brute_force(earlier, later, earlier.residual_db, later.residual_db)
        assert pair.n == len(level)
        assert pair.share == len(level) / np.isfinite(earlier.level_db).sum()
        if pair.n:
            assert (pair.rmse_db, pair.offset_db) == (level.std(), level.mean())
        if len(residual):
            assert pair.residual_rmse_db == residual.std()
        here, there = cells(earlier), cells(later)
        both = [c for c in here if c in there]
        assert pair.cells == len(both)
        table = np.array([(*here[c], *there[c]) for c in both])
        assert pair.place_correlation == pytest.approx(correlation(table[:, 0], table[:, 2]), nan_ok=True)
        assert pair.place_rmse_db == pytest.approx((table[:, 2] - table[:, 0]).std())
        assert pair.height_difference_m == pytest.approx(np.median(table[:, 3] - table[:, 1]))
