"""Leave-one-out Kriging of the paper's rank maps against PyKrige with the same neighbours.

2556 positions x 9 altitudes x 3 K, M = 20 within 150 m. PyKrige has no leave-one-out: for each target and field an
``OrdinaryKriging`` of the target's 20 neighbours (chosen here, not timed) is made and executed at the target. That
takes most of an hour for all 69 012 systems, so PyKrige runs on a random subset of (target, field) pairs and its
time is scaled per pair; ``--full`` runs them all. A second, kinder comparison gives PyKrige its own strength: its
moving window (``n_closest_points``, the compiled back end, which knows only built-in variograms, so both sides use an
exponential) at targets off the grid: totals, and the marginal cost of a target.

    python benchmarks/kriging.py [--quick] [--full] [--pairs N]
"""

import argparse
import json
import platform
import subprocess
import sys
import time
import warnings

import numpy as np

from aerpaw_cmp.maps.grid import Grid
from aerpaw_cmp.maps.kriging import OrdinaryKriging
from aerpaw_cmp.maps.variogram import PAPER_BIEXPONENTIAL as PAPER

M, RADIUS_M, SEED = 20, 150.0, 20250210
FIELDS = 27  # 9 altitudes x 3 K


def pykrige_model(points, values):
    from pykrige.ok import OrdinaryKriging as Peer

    return Peer(
        *points.T,
        values,
        variogram_model="custom",
        variogram_parameters=[0.0],
        variogram_function=lambda _parameters, distance: 1.0 - PAPER(distance),
    )


def exponential(distance):
    """PyKrige's exponential variogram with sill 1, range 900 m and nugget 0.1, as a correlation."""
    return 0.9 * np.exp(-3.0 * distance / 900.0)


def pykrige_exponential(points, values):
    from pykrige.ok import OrdinaryKriging as Peer

    return Peer(*points.T, values, "exponential", {"psill": 0.9, "range": 900.0, "nugget": 0.1})


def best_of(repeats, job):
    """Least wall time of some runs, and the last result."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        result = job()
        times.append(time.perf_counter() - start)
    return min(times), result


def samples(quick):
    """The grid with every position moved by up to 5 m (no ties), and integer rank fields with patches."""
    grid = Grid.over_area((-540.0, 540.0, -1065.0, 1065.0) if not quick else (-150.0, 150.0, -150.0, 150.0))
    rng = np.random.default_rng(SEED)
    moved = grid.points_m + rng.uniform(-5.0, 5.0, (len(grid), 2))
    wave = np.sin(grid.points_m[:, :1] / 90.0 + np.arange(FIELDS)) + np.cos(grid.points_m[:, 1:] / 140.0)
    rank = np.clip(np.round(2.0 + wave + rng.normal(0, 0.3, wave.shape)), 1, 4)
    return grid, moved, rank


def peer_leave_one_out(points, values, index, pairs):
    """Run PyKrige on the given (target, field) pairs, each with the same neighbours as ours.

    Return estimates and seconds.
    """
    estimate = np.empty(len(pairs))
    start = time.perf_counter()
    for row, (target, field) in enumerate(pairs):
        near = index[target][index[target] >= 0]
        model = pykrige_model(points[near], values[near, field])
        estimate[row] = model.execute("points", points[target, 0], points[target, 1])[0][0]
    return estimate, time.perf_counter() - start


def leave_one_out(quick, full, pairs):
    """Ours on all fields against PyKrige on pairs of target and field."""
    _, points, values = samples(quick)
    model = OrdinaryKriging(PAPER, M, RADIUS_M).fit(points, values)
    ours_s, (estimate, _) = best_of(3, model.leave_one_out)
    index = model._neighbours(points, points, np.arange(len(points))).index
    every = np.stack(np.meshgrid(np.arange(len(points)), np.arange(FIELDS), indexing="ij"), axis=-1).reshape(-1, 2)
    chosen = (
        every if full else every[np.random.default_rng(1).choice(len(every), min(pairs, len(every)), replace=False)]
    )
    peer, peer_s = peer_leave_one_out(points, values, index, chosen)
    scaled_s = peer_s / len(chosen) * len(every)
    return {
        "systems": len(every), "ours_s": ours_s, "pykrige_pairs_run": len(chosen), "pykrige_s": peer_s,
        "pykrige_scaled_s": scaled_s, "kriging_vs_pykrige": scaled_s / ours_s,
        "largest_difference": float(np.abs(estimate[chosen[:, 0], chosen[:, 1]] - peer).max()),
    }  # fmt: skip


def on_the_grid(quick):
    """Run our Kriging on the regular grid, where targets share weights.

    Fields are complete, or have gaps that differ by altitude.
    """
    grid, _, values = samples(quick)
    gaps = values.copy()
    rng = np.random.default_rng(2)
    for altitude in range(9):
        gaps[np.ix_(rng.random(len(grid)) < 0.05, np.arange(3) * 9 + altitude)] = np.nan
    complete_s, _ = best_of(3, OrdinaryKriging(PAPER, M, RADIUS_M).fit(grid.points_m, values).leave_one_out)
    gaps_s, _ = best_of(3, OrdinaryKriging(PAPER, M, RADIUS_M).fit(grid.points_m, gaps).leave_one_out)
    return {"complete_s": complete_s, "five_percent_gaps_s": gaps_s}


def window_jobs(quick):
    """Return numbers of targets between the samples, and the function of each program that estimates them."""
    _, points, values = samples(quick)
    rng, low, high = np.random.default_rng(3), points.min(axis=0), points.max(axis=0)
    counts = (len(points), 200, 400) if quick else (len(points), 20_000, 100_000)
    targets = {n: rng.uniform(low, high, (n, 2)) for n in counts}

    def ours(n, fields=1):
        model = OrdinaryKriging(exponential, M, np.inf).fit(points, values[:, :fields])
        return model.predict(targets[n])[0]

    def peer(n):
        model = pykrige_exponential(points, values[:, 0])
        return model.execute("points", *targets[n].T, backend="C", n_closest_points=M)[0]

    return counts, {"ours": ours, "pykrige": peer}


def cpu_s(job, *arguments):
    """CPU seconds of a call."""
    start = time.process_time()
    job(*arguments)
    return time.process_time() - start


def first_call_s(side, quick):
    """CPU seconds of the first call of a process of its own, with what it imports."""
    command = [sys.executable, __file__, "--first", side, *["--quick"] * quick]
    return float(subprocess.run(command, capture_output=True, text=True, check=True).stdout)


def moving_window(quick, repeats):
    """Plain prediction off the samples, 20 neighbours, one exponential variogram: CPU seconds of both sides in turn.

    Totals hold what each side sets up (PyKrige: statistics of its fit and all distances between samples; ours: a tree).
    The marginal cost is the slope between the two largest numbers of targets, without it. PyKrige has no several
    fields: one run is timed and counts 27 times. The first call of a process holds imports (SciPy's on both sides).
    """
    counts, sides = window_jobs(quick)
    jobs = {(side, n): (job, n) for n in counts for side, job in sides.items()}
    jobs["ours", f"{counts[0]}_27_fields"] = sides["ours"], counts[0], FIELDS
    jobs |= {(side, "first"): () for side in sides}
    least = dict.fromkeys(jobs, np.inf)
    for _ in range(repeats):
        for (side, n), job in jobs.items():
            least[side, n] = min(least[side, n], cpu_s(*job) if job else first_call_s(side, quick))
    marginal = {s: (least[s, counts[2]] - least[s, counts[1]]) / (counts[2] - counts[1]) for s in sides}
    every = least["ours", f"{counts[0]}_27_fields"]
    row = {f"{side}_{n}_s": seconds for (side, n), seconds in least.items()}
    row |= {f"ratio_total_{n}": least["pykrige", n] / least["ours", n] for n in (*counts, "first")}
    row |= {f"ratio_total_{counts[0]}_27_fields": FIELDS * least["pykrige", counts[0]] / every}
    row |= {f"{side}_marginal_us": 1e6 * slope for side, slope in marginal.items()}
    row |= {"ratio_marginal": marginal["pykrige"] / marginal["ours"]}
    worst = float(np.abs(np.asarray(sides["pykrige"](counts[0])) - sides["ours"](counts[0])[:, 0]).max())
    return row | {"largest_difference_C": worst}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="100 positions")
    parser.add_argument("--full", action="store_true", help="PyKrige on every target and field")
    parser.add_argument("--pairs", type=int, default=1000, help="pairs of target and field that PyKrige runs")
    parser.add_argument("--first", choices=("ours", "pykrige"), help="print seconds of the first call of one side")
    options = parser.parse_args()
    warnings.filterwarnings("ignore", category=DeprecationWarning)
    if options.first:
        counts, sides = window_jobs(options.quick)
        print(cpu_s(sides[options.first], counts[-1]))
        return
    report = {
        "conditions": {"machine": platform.processor() or platform.machine(), "numpy": np.__version__, "M": M},
        "leave_one_out": leave_one_out(options.quick, options.full, 50 if options.quick else options.pairs),
        "grid": on_the_grid(options.quick),
        "moving_window": moving_window(options.quick, 1 if options.quick else 5),
    }
    print(json.dumps(report, indent=2))


if __name__ == "__main__":
    main()
