"""Weights of the memories in ``memory_weights.json``: those whose 95 % intervals hold in every cell.

Sequences with AR(1) memory (and some with white noise besides) are simulated in cells of (samples, correlation of
neighbours). The weights minimise the squared distance of every cell's coverage from 95 %, plus a little for the width
of the intervals and for weights that are not smooth over the rate. Prints the table of that file, in tenths.

    python benchmarks/interval_weights.py mean|power|ratio [--sequences 300]
"""

import argparse

import numpy as np
from scipy.optimize import minimize
from scipy.signal import lfilter
from scipy.special import expit, gammaincc, logit, ndtri, stdtr

from aerpaw_cmp.common.units import FloatArray
from aerpaw_cmp.compare.statistics.memory import RATES, WHITE_SHARES, cosine_terms, likelihoods, memories

COVERAGE, TAIL, STEEP, WIDTH, SMOOTH = 0.948, 0.025, 5.0, 5e-4, 1e-5
SIZES, CORRELATIONS = (100, 200, 500, 1000, 2000, 5000), (0.0, 0.3, 0.6, 0.8, 0.9, 0.95, 0.98, 0.99)
SHAPE = (len(WHITE_SHARES), len(RATES))


def sequences(rng: np.random.Generator, count: int, n: int, neighbours: float, noise: float) -> FloatArray:
    """AR(1) of unit variance plus white noise (count, n)."""
    drive = rng.normal(size=(count, n)) * np.sqrt(1.0 - neighbours**2)
    drive[:, 0] /= np.sqrt(1.0 - neighbours**2)
    return np.asarray(lfilter([1.0], [1.0, -neighbours], drive, axis=1) + noise * rng.normal(size=(count, n)))


# Likelihood, probability that a draw lies below the truth, square of the width (each (count, memories)); weight.
Cell = tuple[FloatArray, FloatArray, FloatArray, float]


def cell(kind: str, x: FloatArray, y: FloatArray, noise: float, size: float, weight: float) -> Cell:
    """What the sequences of a cell say, under each memory."""
    truth = 1.0 + noise**2
    if kind == "ratio":
        first, second = (e - e.mean(axis=1, keepdims=True) for e in (size * x, 0.5 * x + np.sqrt(0.75) * y))
        squares = [(e * e).mean(axis=1, keepdims=True) for e in (first, second)]
        away = (np.log(squares[0] / squares[1])[:, 0] - 2.0 * np.log(size))[:, None]
        x = first**2 / squares[0] - second**2 / squares[1]
    else:
        away = x.mean(axis=1, keepdims=True)
    terms = [cosine_terms(row) for row in x]
    slow = np.array([t.slow for t in terms])
    known, count = memories(slow.shape[1]), slow.shape[1]
    likelihood, square = likelihoods(slow)
    if kind == "power":
        third = 2.0 / (9.0 * np.array([t.fast_freedom for t in terms]))
        fast = np.array([t.fast_power for t in terms])
        below = np.zeros_like(square)
        normals = ndtri((np.arange(32) + 0.5) / 32)
        for z in normals:
            rest = (truth - fast / np.maximum(1.0 - third + np.sqrt(third) * z, 0.05) ** 3)[:, None]
            share = gammaincc(0.5 * count, 0.5 * square * known.power / np.maximum(rest, 1e-12))
            below += np.where(rest > 0.0, share, 0.0) / len(normals)
        width = square / count * known.power + fast[:, None]
    else:
        reach = np.sqrt(square / count * known.variance)
        below = stdtr(count, (away - slow @ known.slope.T) / reach)
        width = reach**2
    return likelihood, below, width / np.median(width.min(axis=1)), weight


def cells(kind: str, count: int) -> list[Cell]:
    """All cells, with white noise in some."""
    rng = np.random.default_rng(5)
    plan = [(n, r, 0.0, size, 1.0 if size == 1.0 else 0.4)
            for n in SIZES for r in CORRELATIONS for size in ((1.0, 2.0) if kind == "ratio" else (1.0,))]  # fmt: skip
    plan += [(n, r, 0.5, 1.0, 0.3) for n in (100, 500, 3000) for r in (0.9, 0.98)]
    made = []
    for n, r, noise, size, weight in plan:
        x, y = (sequences(rng, count, n, r, noise) for _ in range(2))
        made.append(cell(kind, x, y, noise, size, weight))
    return made


def loss(log_weight: FloatArray, made: list[Cell]) -> tuple[float, FloatArray]:
    """What is minimised, and its gradient."""
    prior, total, gradient = np.exp(log_weight - log_weight.max()), 0.0, np.zeros(log_weight.size)
    for likelihood, below, width, weight in made:
        share = likelihood * prior
        share /= share.sum(axis=1, keepdims=True)
        chance = np.clip((share * below).sum(axis=1), 1e-7, 1 - 1e-7)
        over, under = (expit(STEEP * (sign * logit(chance) - logit(TAIL))) for sign in (1.0, -1.0))
        excess = (over * under).mean() - COVERAGE
        slope = STEEP * over * under * (under - over) / (chance * (1.0 - chance)) / len(chance)
        size = (share * width).sum(axis=1)
        total += weight * (excess**2 + 0.5 * WIDTH * np.log(size).mean())
        gradient += weight * ((2.0 * excess * slope)[:, None] * share * (below - chance[:, None])).sum(axis=0)
        gradient += weight * 0.5 * WIDTH * (share * (width - size[:, None]) / size[:, None]).mean(axis=0)
    table = log_weight.reshape(SHAPE)
    bend, away = np.diff(table, 2, axis=1), table - table.mean()
    rough = np.zeros(SHAPE)
    for place, factor in enumerate((1.0, -2.0, 1.0)):
        rough[:, place : place + bend.shape[1]] += 2.0 * factor * bend
    total += SMOOTH * (bend**2).sum() + 0.1 * SMOOTH * (away**2).sum()
    return float(total), gradient + (SMOOTH * rough + 0.2 * SMOOTH * away).ravel()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("kind", choices=("mean", "power", "ratio"))
    parser.add_argument("--sequences", type=int, default=300, help="per cell")
    arguments = parser.parse_args()
    made = cells(arguments.kind, arguments.sequences)
    start = np.where(np.array(WHITE_SHARES) > 0.0, -2.0, 0.0)[:, None] + 0.3 * np.log(RATES)
    best = minimize(
        lambda p: (lambda value: (1e3 * value[0], 1e3 * value[1]))(loss(p, made)), start.ravel(), jac=True,
        method="L-BFGS-B", options={"maxiter": 150},
    )  # fmt: skip
    prior = np.exp(best.x - best.x.max())
    for likelihood, below, *_ in made:
        chance = (likelihood * prior * below).sum(axis=1) / (likelihood * prior).sum(axis=1)
        print(f"{100 * ((chance > TAIL) & (chance < 1 - TAIL)).mean():.1f}", end=" ")
    print()
    for row in np.round(10 * best.x.reshape(SHAPE)).astype(int).tolist():
        print(row)


if __name__ == "__main__":
    main()
