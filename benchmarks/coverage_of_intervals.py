"""How often the stated 95 % intervals hold the truth, over simulated flights whose truth is known.

Each flight has a fixed route (the simulated level varies with it), shadowing that remembers for a given time and
white measurement noise; ranks come from thresholds on two shadowing processes. "Truth" is the value of the process,
not of the sample. Columns: flights whose interval contains it.

    python benchmarks/coverage_of_intervals.py [--quick] [--json]
"""

from __future__ import annotations

import argparse
import json

import numpy as np
from scipy.signal import lfilter
from scipy.stats import multivariate_normal, norm

from aerpaw_cmp.compare.rank import compare_ranks
from aerpaw_cmp.compare.statistics import error_intervals

OFFSET_DB, SHADOW_DB, NOISE_DB = 7.3, 4.0, 2.0
CUTS = np.array([-0.8, 0.5, 1.6])


def remembering(rng: np.random.Generator, n: int, samples: float) -> np.ndarray:
    """Unit-variance AR(1)."""
    keep = np.exp(-1.0 / samples)
    noise = rng.normal(size=n)
    noise[0] /= np.sqrt(1 - keep**2)
    return np.sqrt(1 - keep**2) * lfilter([1], [1, -keep], noise)


def rank_truth(mix: float) -> dict[str, float]:
    """Agreement, kappa, total variation and first bar of two thresholded unit normals with correlation ``mix``."""
    edges = np.concatenate([[-8.0], CUTS, [8.0]])
    shifted = np.concatenate([[-8.0], CUTS + 0.3, [8.0]])
    pair = multivariate_normal([0, 0], [[1, mix], [mix, 1]])

    def box(a: float, b: float, c: float, d: float) -> float:
        return float(pair.cdf([b, d]) - pair.cdf([a, d]) - pair.cdf([b, c]) + pair.cdf([a, c]))

    agree = sum(box(edges[i], edges[i + 1], shifted[i], shifted[i + 1]) for i in range(4))
    p, q = np.diff(norm.cdf(edges)), np.diff(norm.cdf(shifted))
    chance = float(p @ q)
    return {
        "agreement": agree,
        "kappa": (agree - chance) / (1 - chance),
        "total_variation": float(0.5 * np.abs(p - q).sum()),
        "bar_1": float(p[0]),
        "wasserstein": float(np.abs(np.cumsum(p - q))[:-1].sum()),
    }


def rss_coverage(flights: int, n: int, memory: float, replicates: int) -> dict[str, float]:
    rng = np.random.default_rng(int(memory * 10) + n)
    t = np.linspace(0, 2 * np.pi, n)
    simulated = -80 + 8 * np.sin(3 * t) + 4 * np.cos(11 * t)
    variance = SHADOW_DB**2 + NOISE_DB**2
    truth = (OFFSET_DB, np.sqrt(variance), np.sqrt(simulated.var() / (simulated.var() + variance)))
    hits = np.zeros(3)
    effective = []
    for _ in range(flights):
        noise = SHADOW_DB * remembering(rng, n, memory) + rng.normal(0, NOISE_DB, n)
        found = error_intervals(simulated - OFFSET_DB + noise, simulated, replicates=replicates)
        ends = (found.offset_db, found.rmse_db, found.correlation)
        hits += [low <= true <= high for (low, high), true in zip(ends, truth, strict=True)]
        effective.append(found.memory.n_effective)
    names = ("offset_db", "rmse_db", "correlation")
    return {**dict(zip(names, hits / flights, strict=True)), "n_effective": float(np.median(effective))}


def rank_coverage(flights: int, n: int, memory: float, replicates: int) -> dict[str, float]:
    rng = np.random.default_rng(int(memory * 10) + n + 1)
    mix = 0.8
    truth = rank_truth(mix)
    hits = dict.fromkeys(truth, 0)
    for _ in range(flights):
        one = remembering(rng, n, memory)
        two = mix * one + np.sqrt(1 - mix**2) * remembering(rng, n, memory)
        fit = compare_ranks(
            np.searchsorted(CUTS, one) + 1.0, np.searchsorted(CUTS + 0.3, two) + 1.0, replicates=replicates
        )
        swapped = compare_ranks(np.searchsorted(CUTS + 0.3, two) + 1.0, np.searchsorted(CUTS, one) + 1.0, replicates=20)
        ends = {
            "agreement": fit.agreement_ci95,
            "kappa": fit.kappa_ci95,
            "total_variation": fit.total_variation_ci95,
            "wasserstein": fit.wasserstein_ci95,
            "bar_1": swapped.histogram_ci95[0],
        }
        for name, (low, high) in ends.items():
            hits[name] += low <= truth[name] <= high
    return {name: count / flights for name, count in hits.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="40 flights, 200 replicates")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    flights, replicates = (40, 200) if arguments.quick else (500, 500)
    rows = []
    for n, memory in ((3300, 3.0), (3300, 15.0), (3300, 50.0), (10_000, 50.0)):
        rows.append({"samples": n, "memory_samples": memory, **rss_coverage(flights, n, memory, replicates)})
    ranks = []
    for n, memory in ((1500, 5.0), (3000, 30.0)):
        ranks.append({"samples": n, "memory_samples": memory, **rank_coverage(flights, n, memory, replicates)})
    if arguments.json:
        print(json.dumps({"flights": flights, "replicates": replicates, "rss": rows, "rank": ranks}))
        return
    print(f"{flights} simulated flights per row, {replicates} replicates, 95 % intervals")
    for table in (rows, ranks):
        print("  ".join(f"{name:>15s}" for name in table[0]))
        for row in table:
            print("  ".join(f"{value:15.3f}" for value in row.values()))


if __name__ == "__main__":
    main()
