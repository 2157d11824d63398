"""How often the stated 95 % intervals hold the truth, over simulated flights whose truth is known.

Each flight has a fixed route (the simulated level varies with it) and shadowing whose neighbouring samples correlate
as stated, with or without white measurement noise; ranks come from thresholds on two shadowing processes; a pair is two
models that share half of their shadowing, of equal true error or of errors as 3 to 2. "Truth" is the value of the
process, not of the sample.

Per cell of (samples, correlation of neighbours): the share of given intervals that hold the truth, and their median
width over the truth (offset: over the shadowing). Every flight is given an interval.

    python benchmarks/coverage_of_intervals.py [--flights 400] [--json]
"""

import argparse
import itertools
import json

import numpy as np
from scipy.signal import lfilter
from scipy.stats import multivariate_normal, norm

from aerpaw_cmp.compare.rank import compare_ranks
from aerpaw_cmp.compare.statistics.intervals import error_intervals, paired_difference

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


SIZES = (100, 200, 500, 1000, 2000, 5000)
CORRELATIONS = (0.0, 0.5, 0.8, 0.9, 0.95, 0.98, 0.99)
STATISTICS = ("offset_db", "rmse_db", "correlation", "paired", "paired_unequal")


def shadowed(rng: np.random.Generator, n: int, neighbours: float) -> np.ndarray:
    """Unit-variance AR(1) with this correlation of neighbours."""
    return rng.normal(size=n) if neighbours == 0 else remembering(rng, n, -1.0 / np.log(neighbours))


def rss_cell(flights: int, n: int, neighbours: float, noise_db: float) -> dict[str, object]:
    """Given, held and width, per statistic, over so many flights."""
    rng = np.random.default_rng([n, round(1000 * neighbours), round(10 * noise_db)])
    t = np.linspace(0, 2 * np.pi, n, endpoint=False)
    simulated = -80 + 8 * np.sin(3 * t) + 4 * np.cos(11 * t)
    variance = SHADOW_DB**2 + noise_db**2
    truth = np.array([OFFSET_DB, np.sqrt(variance), np.sqrt(simulated.var() / (simulated.var() + variance)), 0.0,
                      0.5 * np.sqrt(variance)])  # fmt: skip
    ends = np.empty((flights, len(STATISTICS), 2))
    for row in ends:
        error = SHADOW_DB * shadowed(rng, n, neighbours) + rng.normal(0, noise_db, n)
        other = SHADOW_DB * shadowed(rng, n, neighbours) + rng.normal(0, noise_db, n)
        intervals = error_intervals(simulated - OFFSET_DB + error, simulated)
        second = 0.5 * error + np.sqrt(0.75) * other
        pairs = [paired_difference(size * error, second).difference_ci95_db for size in (1.0, 1.5)]
        row[:] = [intervals.offset_db, intervals.rmse_db, intervals.correlation, *pairs]
    given = np.isfinite(ends[..., 0])
    held = (ends[..., 0] <= truth) & (truth <= ends[..., 1])
    width = np.nanmedian(np.ptp(ends, axis=2), axis=0) / np.sqrt(variance)
    return {
        "samples": n, "neighbours": neighbours, "noise_db": noise_db,
        **{
            name: {
                "given": float(given[:, i].mean()),
                "coverage": float(held[:, i].sum() / max(given[:, i].sum(), 1)),
                "width": float(width[i]),
            }
            for i, name in enumerate(STATISTICS)
        },
    }  # fmt: skip


def judged(row: dict[str, object], flights: int) -> list[str]:
    """Statistics of a row that are not 92 to 97 %, give or take two standard errors."""
    bad = []
    for name in STATISTICS:
        entry = row[name]
        assert isinstance(entry, dict)
        slack = 2 * np.sqrt(0.05 * 0.95 / max(flights * entry["given"], 1))
        if entry["given"] and not 0.92 - slack <= entry["coverage"] <= 0.97 + slack:
            bad.append(f"{name} {100 * entry['coverage']:.1f}")
    return bad


def rank_coverage(flights: int, n: int, memory: float, replicates: int) -> dict[str, float]:
    rng = np.random.default_rng(int(memory * 10) + n + 1)
    mix = 0.8
    truth = rank_truth(mix)
    hits = dict.fromkeys(truth, 0)
    for _ in range(flights):
        measured = remembering(rng, n, memory)
        simulated = mix * measured + np.sqrt(1 - mix**2) * remembering(rng, n, memory)
        fit = compare_ranks(
            np.searchsorted(CUTS, measured) + 1.0, np.searchsorted(CUTS + 0.3, simulated) + 1.0, replicates=replicates
        )
        swapped = compare_ranks(
            np.searchsorted(CUTS + 0.3, simulated) + 1.0, np.searchsorted(CUTS, measured) + 1.0, replicates=20
        )
        ends = {
            "agreement": fit.agreement_ci95, "kappa": fit.kappa_ci95, "total_variation": fit.total_variation_ci95,
            "wasserstein": fit.wasserstein_ci95, "bar_1": swapped.histogram_ci95[0],
        }  # fmt: skip
        for name, (low, high) in ends.items():
            hits[name] += low <= truth[name] <= high
    return {name: count / flights for name, count in hits.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--flights", type=int, default=400, help="simulated flights per cell")
    parser.add_argument("--replicates", type=int, default=300, help="of the ranks, which are resampled")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    flights, replicates = arguments.flights, arguments.replicates
    cells = itertools.product((0.0, NOISE_DB), SIZES, CORRELATIONS)
    rows = [rss_cell(flights, n, neighbours, noise) for noise, n, neighbours in cells]
    ranks = [
        {"samples": n, "memory_samples": memory, **rank_coverage(flights, n, memory, replicates)}
        for n, memory in ((1500, 5.0), (3000, 30.0))
    ]
    bad = {f"{r['samples']}, {r['neighbours']}, {r['noise_db']} dB": b for r in rows if (b := judged(r, flights))}
    if arguments.json:
        print(json.dumps({"flights": flights, "replicates": replicates, "rss": rows, "rank": ranks, "outside": bad}))
        return
    print(f"{flights} simulated flights per cell, 95 % intervals: share that hold (median width over the error)")
    head = ("samples", "neighbours", "noise dB", *STATISTICS)
    print(" | ".join(f"{name:>13s}" for name in head))
    for row in rows:
        plain = [f"{row[name]:13.5g}" for name in ("samples", "neighbours", "noise_db")]
        print(" | ".join([*plain, *(in_words(row[name]) for name in STATISTICS)]))
    print(f"cells outside 92-97 % (two standard errors of {flights} flights allowed): {bad or 0}")
    print("  ".join(f"{name:>15s}" for name in ranks[0]))
    for row in ranks:
        print("  ".join(f"{value:15.3f}" for value in row.values()))


def in_words(entry: object) -> str:
    """One cell of the table."""
    assert isinstance(entry, dict)
    given = "" if entry["given"] == 1.0 else f" of {100 * entry['given']:.0f} %"
    return f"{100 * entry['coverage']:6.1f} ({entry['width']:.2f}){given}"


if __name__ == "__main__":
    main()
