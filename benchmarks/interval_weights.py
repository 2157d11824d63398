"""Weights of the memories in ``memory_weights.json``: those whose 95 % intervals hold in every cell.

Sequences of the kinds of ``benchmarks/coverage_of_intervals.py`` are simulated. The weights minimise the squared
distance of every cell's coverage from 95 %, plus something for the width of the intervals, where a sequence holds many
memories, and a little for weights that are not smooth over the rate. They begin at those of the file, and a cell
outside the asked coverage counts more in the next round. Prints the coverage of each cell and the table, in tenths.

    python benchmarks/interval_weights.py mean|power|ratio [--sequences 700]
"""

import argparse
from collections.abc import Iterator

import numpy as np
from coverage_of_intervals import GRID, routed_pair, shadowed_pair
from scipy.optimize import minimize
from scipy.special import expit, gammaincc, logit, ndtri, stdtr

from aerpaw_cmp.common.units import FloatArray
from aerpaw_cmp.compare.statistics.intervals import undecided
from aerpaw_cmp.compare.statistics.memory import (
    CALM,
    RATES,
    WHITE_SHARES,
    cosine_terms,
    heavy_tails,
    likelihoods,
    memories,
    weights,
)

TAIL, STEEP, SMOOTH, ROUNDS = 0.025, 5.0, 1.8e-4, 2
# Coverage aimed at; price of the width; price of a coverage that is too large, over that of one too small; distance
# from the aim at which a cell counts twice what its square says, so that none pays for the others.
AIM = {
    "mean": (0.949, 5e-3, 1.0, 0.01), "power": (0.95, 1.9e-2, 1.0, 0.02), "ratio": (0.951, 8e-3, 0.15, np.inf),
}  # fmt: skip
SHAPE = (len(WHITE_SHARES) + 1, len(RATES))


# Likelihood, probability that a draw lies below the truth, square of the width (each (count, memories)); weights of
# coverage and width.
Cell = tuple[FloatArray, FloatArray, FloatArray, float, float]


def mean_cell(x: FloatArray, away: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Sequences (count, n) under each memory, on a mean that theirs is ``away`` (count,) from."""
    slow = np.array([cosine_terms(row).slow for row in x])
    known, terms = memories(slow.shape[1]), slow.shape[1]
    likelihood, square = likelihoods(slow)
    reach = np.sqrt(square / terms * known.variance)
    return likelihood, stdtr(terms, (away[:, None] - slow @ known.slope.T) / reach), reach**2


def power_cell(x: FloatArray, truth: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Sequences (count, n) under each memory, on their mean square."""
    every = [cosine_terms(row) for row in x]
    slow, fast, freedom = (np.array([getattr(t, k) for t in every]) for k in ("slow", "fast_power", "fast_freedom"))
    tails = np.array([heavy_tails(row) for row in x])
    known, terms = memories(slow.shape[1]), slow.shape[1]
    likelihood, square = likelihoods(slow)
    third, below = 2.0 / (9.0 * freedom), np.zeros_like(square)
    normals = ndtri((np.arange(48) + 0.5) / 48)
    for z, other in zip(normals, np.random.default_rng(1).permutation(normals), strict=True):
        rest = truth * np.exp(-tails * other * (CALM if other > 0.0 else 1.0))
        rest = (rest - fast / np.maximum(1.0 - third + np.sqrt(third) * z, 0.05) ** 3)[:, None]
        share = gammaincc(0.5 * terms, 0.5 * square * known.power / np.maximum(rest, 1e-12))
        below += np.where(rest > 0.0, share, 0.0) / len(normals)
    return likelihood, below, square / terms * known.power + fast[:, None]


def cells(kind: str, count: int) -> Iterator[tuple[str, Cell]]:
    """All cells, by name."""
    rng = np.random.default_rng(5)
    for shadowing in GRID:
        of_width = 1.0 if shadowing.memories >= 20.0 else 0.3
        if kind != "ratio":
            x = shadowing.sequences(rng, count)
            parts = mean_cell(x, x.mean(axis=1)) if kind == "mean" else power_cell(x, shadowing.in_flight_variance)
            yield str(shadowing), scaled(parts, 1.0 if shadowing.tails is None else 0.5, of_width)
            continue
        for channels in (1, 10):
            if channels * shadowing.n > 10_000:
                continue
            for b in (None, 0.5, 0.0) if shadowing.n in (300, 1000) and not shadowing.tails else (None,):
                pairs = shadowed_pair(rng, shadowing, count, channels) if b is None else (
                    routed_pair(rng, shadowing, count, channels, b)
                )  # fmt: skip
                first, second = pairs
                truth = 0.0 if b is None else (2.0 * b - 1.0) * ((first - second) ** 2).mean(axis=1)
                away = (first**2 - second**2).mean(axis=1) - truth
                x = np.array([undecided(*both) for both in zip(first, second, strict=True)])
                weight = 3.0 if channels > 1 and b is None else 1.0
                yield f"{shadowing}, {channels} channels", scaled(mean_cell(x, away), weight, of_width)


def scaled(parts: tuple[FloatArray, FloatArray, FloatArray], of_coverage: float, of_width: float) -> Cell:
    likelihood, below, width = parts
    return likelihood, below, width / np.median(width.min(axis=1)), of_coverage, of_width


def loss(log_weight: FloatArray, made: list[Cell], kind: str) -> tuple[float, FloatArray]:
    """Sum to be minimised, and its gradient."""
    aim, price, idle, far = AIM[kind]
    prior, total, gradient = np.exp(log_weight - log_weight.max()), 0.0, np.zeros(log_weight.size)
    for likelihood, below, width, weight, of_width in made:
        share = likelihood * prior
        share /= share.sum(axis=1, keepdims=True)
        chance = np.clip((share * below).sum(axis=1), 1e-7, 1 - 1e-7)
        over, under = (expit(STEEP * (sign * logit(chance) - logit(TAIL))) for sign in (1.0, -1.0))
        excess = (over * under).mean() - aim
        cost = weight * (1.0 if excess < 0.0 else idle)
        slope = STEEP * over * under * (under - over) / (chance * (1.0 - chance)) / len(chance)
        size = (share * width).sum(axis=1)
        total += cost * (excess**2 + excess**4 / far**2) + of_width * 0.5 * price * np.log(size).mean()
        pull = 2.0 * excess + 4.0 * excess**3 / far**2
        gradient += cost * ((pull * slope)[:, None] * share * (below - chance[:, None])).sum(axis=0)
        gradient += of_width * 0.5 * price * (share * (width - size[:, None]) / size[:, None]).mean(axis=0)
    table = log_weight.reshape(SHAPE)
    bend, away = np.diff(table, 2, axis=1), table - table.mean()
    rough = np.zeros(SHAPE)
    for place, factor in enumerate((1.0, -2.0, 1.0)):
        rough[:, place : place + bend.shape[1]] += 2.0 * factor * bend
    total += SMOOTH * (bend**2).sum() + 0.1 * SMOOTH * (away**2).sum()
    return float(total), gradient + (SMOOTH * rough + 0.2 * SMOOTH * away).ravel()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("kind", choices=tuple(AIM))
    parser.add_argument("--sequences", type=int, default=700, help="per cell")
    arguments = parser.parse_args()
    kind, named = arguments.kind, dict(cells(arguments.kind, arguments.sequences))
    best, counts, covered = np.log(weights(kind)), dict.fromkeys(named, 1.0), dict.fromkeys(named, 95.0)
    for _ in range(ROUNDS):
        made = [(*cell[:3], counts[name] * cell[3], cell[4]) for name, cell in named.items()]
        best = minimize(
            lambda p, made=made: tuple(1e3 * value for value in loss(p, made, kind)), best, jac=True,
            method="L-BFGS-B", options={"maxiter": 60},
        ).x  # fmt: skip
        for name, (likelihood, below, *_) in named.items():
            share = likelihood * np.exp(best - best.max())
            chance = (share * below).sum(axis=1) / share.sum(axis=1)
            covered[name] = 100 * ((chance > TAIL) & (chance < 1 - TAIL)).mean()
            counts[name] *= 1.0 + max(92.8 - covered[name], covered[name] - 96.9, 0.0)
    for name, percent in covered.items():
        print(f"{percent:5.1f}  {name}")
    for row in np.round(10 * (best - best.mean()).reshape(SHAPE)).astype(int).tolist():
        print(row)


if __name__ == "__main__":
    main()
