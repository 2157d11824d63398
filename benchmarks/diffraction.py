"""Compare flights with the site's buildings, without and with paths over one edge.

RMSE of levels, kappa and agreement of ranks at K = 10, and the interval of the paired difference (95 %).

Run: python benchmarks/diffraction.py FILE... [--logs-root DIR]
"""

import argparse
from pathlib import Path

import numpy as np

from aerpaw_cmp.compare.statistics import paired_difference
from aerpaw_cmp.jobs.notebook import open_flight

VERDICTS = {"better": "it pays", "worse": "it costs"} | dict.fromkeys(
    ("not significant", "no interval"), "it does not pay"
)


def flight(path: str, logs_root: str | None) -> list[str]:
    """A sentence for each channel and each tower's rank: its error without and with edges, and the difference."""
    results = []
    for mode in ("none", "edges"):
        changed = {"site.without_buildings": False, "rt.diffraction": mode, "rt.audit_links": 0}
        results.append(open_flight(path, logs_root=logs_root, overrides=changed).compare())
    without, edges = (scores.result for scores in results)
    lines = []
    for plain, bent in zip(without.rss, edges.rss, strict=True):
        errors_db = [np.where(s.posed, s.measured_db - s.simulated_dbm, np.nan) for s in (bent, plain)]
        pair = paired_difference(*errors_db)
        low, high = pair.difference_ci95_db
        lines.append(
            f"{Path(path).stem} {plain.tower} {plain.channel}: RMSE {plain.score.rmse_db:.2f} dB,"
            f" with edges {bent.score.rmse_db:.2f}, difference {pair.difference_db:+.2f} ({low:.2f} to {high:.2f}):"
            f" {VERDICTS[pair.verdict]}"
        )
    for first, second in zip(without.rank, edges.rank, strict=True):
        both = np.isfinite(first.measured) & (first.rank[10] > 0) & (second.rank[10] > 0)
        pair = paired_difference(
            *(np.where(both, ranks.rank[10] != ranks.measured, np.nan) for ranks in (second, first)), free_offset=False
        )
        tables = (scores.rank_to_frame().set_index(["tower", "k"]) for scores in results)
        kappa = [float(table.kappa[first.tower, 10.0]) for table in tables]
        low, high = pair.mean_square_ci95_db2
        lines.append(
            f"{Path(path).stem} {first.tower} rank: kappa {kappa[0]:.3f}, with edges {kappa[1]:.3f}, disagreement"
            f" {pair.mean_square_difference_db2:+.4f} ({low:.4f} to {high:.4f}): {VERDICTS[pair.verdict]}"
        )
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("flights", nargs="+", help="flight files, as those of tests/field")
    parser.add_argument("--logs-root")
    options = parser.parse_args()
    for path in options.flights:
        print(*flight(path, options.logs_root), sep="\n", flush=True)


if __name__ == "__main__":
    main()
