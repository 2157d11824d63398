"""Weights and widening factors of ``memory_weights.json``, for 95 % intervals with the right coverage in every cell.

Sequences of the kinds of ``benchmarks/coverage_of_intervals.py`` are simulated. The weights minimise the squared
distance of the coverage of each cell from 95 %. The width of the intervals costs something if a sequence lasts many
correlation times, and weights that are not smooth over the rate cost a little. The search starts from the weights of
the file. A cell outside the goal counts more in the next round. The coverage of each cell and the table, in tenths,
are printed. ``--stretch`` fits what each correlation adds to the widening factor instead, in hundredths, with the
weights of the file.

    python benchmarks/interval_weights.py mean|power|ratio [--sequences 700] [--stretch]
"""

import argparse
from collections.abc import Iterator

import numpy as np
from coverage_of_intervals import GRID, routed_pair, shadowed_pair
from scipy.optimize import minimize
from scipy.special import expit, gammaincc, logit, ndtri, stdtr
from scipy.stats import norm

from aerpaw_cmp.common.units import FloatArray
from aerpaw_cmp.compare.statistics import (
    CALM,
    RATES,
    WHITE_SHARES,
    cosine_terms,
    heavy_tails,
    likelihoods,
    stretches,
    time_correlations,
    undecided,
    weights,
)

TAIL, STEEP, ROUNDS = 0.025, 5.0, 2
LIMIT = logit(TAIL)
# Price of the roughness of the weights and of both widening factors.
SMOOTH = np.array([1.8e-4, 2.7e-3, 2.7e-3])[:, None, None]
# Intended coverage, price of the width, price of a coverage that is too large relative to one that is too small, and
# distance from the intended coverage at which the price doubles, so that no cell is sacrificed for the others.
AIM = {
    "mean": (0.949, 5e-3, 1.0, 0.01), "power": (0.95, 1.9e-2, 1.0, 0.02), "ratio": (0.951, 8e-3, 0.15, np.inf),
}  # fmt: skip
SHAPE = (len(WHITE_SHARES) + 1, len(RATES))


# Likelihood, probability that a draw is below the truth, and square of the width, each (count, correlations), and the
# weights of coverage and width.
Cell = tuple[FloatArray, FloatArray, FloatArray, float, float]


def mean_cell(x: FloatArray, away: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Evaluate sequences (count, n) for each correlation. Their mean is ``away`` (count,) from the true mean."""
    slow = np.array([cosine_terms(row).slow for row in x])
    known, terms = time_correlations(slow.shape[1]), slow.shape[1]
    likelihood, square = likelihoods(slow)
    reach = np.sqrt(square / terms * known.variance)
    return likelihood, stdtr(terms, (away[:, None] - slow @ known.slope.T) / reach), reach**2


def power_cell(x: FloatArray, truth: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Sequences (count, n) under each memory, on their mean square."""
    every = [cosine_terms(row) for row in x]
    slow, fast, freedom = (np.array([getattr(t, k) for t in every]) for k in ("slow", "fast_power", "fast_freedom"))
    tails = np.array([heavy_tails(row) for row in x])
    known, terms = time_correlations(slow.shape[1]), slow.shape[1]
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


def shares(likelihood: FloatArray, log_weight: FloatArray) -> list[FloatArray]:
    """Return the posterior shares (count, correlations) with and without the weights."""
    return [p / p.sum(axis=1, keepdims=True) for p in (likelihood * np.exp(log_weight - log_weight.max()), likelihood)]


def loss(tables: FloatArray, made: list[Cell], kind: str) -> tuple[float, FloatArray]:
    """Return the price and its gradient for the logarithms of weights and both widening factors (3, correlations)."""
    aim, price, idle, far = AIM[kind]
    log_weight, own, even = tables
    total, gradient = 0.0, np.zeros(tables.shape)
    for likelihood, below, width, weight, of_width in made:
        share, flat = shares(likelihood, log_weight)
        chance = np.clip((share * below).sum(axis=1), 1e-7, 1 - 1e-7)
        edge = np.minimum(LIMIT * (share @ own + flat @ even), -1.0)  # a search may try ends beyond the middle
        over, under = (expit(STEEP * (sign * logit(chance) - edge)) for sign in (1.0, -1.0))
        excess = (over * under).mean() - aim
        cost = weight * (1.0 if excess < 0.0 else idle)
        pull = cost * (2.0 * excess + 4.0 * excess**3 / far**2) * STEEP * over * under / len(chance)
        by_chance, by_stretch = pull * (under - over) / (chance * (1.0 - chance)), pull * (over + under - 2.0) * LIMIT
        size, tail, dear = (share * width).sum(axis=1), expit(edge), of_width * price / len(chance)
        reach = -ndtri(tail)  # standard deviations from the middle of a normal distribution
        total += cost * (excess**2 + excess**4 / far**2) + dear * (0.5 * np.log(size) + np.log(reach)).sum()
        by_stretch -= dear * tail * (1.0 - tail) / norm.pdf(reach) / reach * LIMIT
        by_share = by_chance[:, None] * below + by_stretch[:, None] * own
        by_share += 0.5 * dear * width / size[:, None]
        gradient[0] += (share * (by_share - (share * by_share).sum(axis=1, keepdims=True))).sum(axis=0)
        gradient[1:] += by_stretch @ share, by_stretch @ flat
    table = tables.reshape(3, *SHAPE)
    bend, away = np.diff(table, 2, axis=2), table - np.array([log_weight.mean(), 1.0, 0.0])[:, None, None]
    rough = np.zeros(table.shape)
    for place, factor in enumerate((1.0, -2.0, 1.0)):
        rough[..., place : place + bend.shape[2]] += 2.0 * factor * bend
    total += (SMOOTH * bend**2).sum() + 0.1 * (SMOOTH * away**2).sum()
    return float(total), gradient + (SMOOTH * rough + 0.2 * SMOOTH * away).reshape(tables.shape)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("kind", choices=tuple(AIM))
    parser.add_argument("--sequences", type=int, default=700, help="per cell")
    parser.add_argument("--stretch", action="store_true", help="fit stretches, not weights")
    arguments = parser.parse_args()
    kind, named = arguments.kind, dict(cells(arguments.kind, arguments.sequences))
    best, counts = np.array([np.log(weights(kind)), *stretches(kind)]), dict.fromkeys(named, 1.0)
    fitted, covered = slice(1, 3) if arguments.stretch else slice(0, 1), dict.fromkeys(named, 95.0)

    def scored(parts: FloatArray, made: list[Cell]) -> tuple[float, FloatArray]:
        best[fitted] = parts.reshape(-1, best.shape[1])
        total, gradient = loss(best, made, kind)
        return 1e3 * total, 1e3 * gradient[fitted].ravel()

    for _ in range(ROUNDS):
        made = [(*cell[:3], counts[name] * cell[3], cell[4]) for name, cell in named.items()]
        parts = minimize(scored, best[fitted].ravel(), (made,), "L-BFGS-B", jac=True, options={"maxiter": 100}).x
        best[fitted] = parts.reshape(-1, best.shape[1])
        for name, (likelihood, below, *_) in named.items():
            share, flat = shares(likelihood, best[0])
            chance, tail = (share * below).sum(axis=1), expit(LIMIT * (share @ best[1] + flat @ best[2]))
            covered[name] = 100 * ((chance > tail) & (chance < 1 - tail)).mean()
            counts[name] *= 1.0 + max(92.8 - covered[name], covered[name] - 96.9, 0.0)
    for name, percent in covered.items():
        print(f"{percent:5.1f}  {name}")
    shown = 100 * best[1:] if arguments.stretch else 10 * (best[:1] - best[0].mean())
    for row in np.round(shown).astype(int).reshape(-1, SHAPE[1]).tolist():
        print(row)


if __name__ == "__main__":
    main()
