"""Time and memory of a calibration against the number of flights: simulated flights with planted antennas.

Each flight has two channels of 3500 samples (5 Hz) over waypoints at random; the fit (mounts aside), the choice of
strengths and every score of `calibrate` run as in the job.

    python benchmarks/calibrate_scale.py [--flights 2 5 20] [--samples 3500] [--json]
"""

from __future__ import annotations

import argparse
import json
import platform
import resource
import time
from typing import Any

import numpy as np
from scipy.spatial.distance import cdist

from aerpaw_cmp.common.stages import Stages
from aerpaw_cmp.compare import calibration
from aerpaw_cmp.compare.calibration import Observed, Recipe
from aerpaw_cmp.compare.direction_gain import TOWER_TERMS, UAV_TERMS, GainModel, LinkSamples
from aerpaw_cmp.compare.sphere import gaussian_features
from aerpaw_cmp.jobs.calibrate import rotation, score_all
from aerpaw_cmp.propagation.arrays import rotation_from_aircraft


def planted(length: float, sd_db: float, seed: int) -> Any:
    """A gain over the sphere from the process itself."""
    weights = np.random.default_rng(seed).normal(size=gaussian_features(np.eye(3)[:1], length).shape[1])
    return lambda direction: sd_db * gaussian_features(direction, length) @ weights


GAINS = {"uav": planted(0.5, 2.5, 1), "USRP1": planted(0.4, 3.0, 2), "USRP2": planted(0.4, 3.0, 3)}


def flight(number: int, n: int) -> list[Observed]:
    """One flight: level = gains + own offset + shadowing over 20 m + 1.5 dB of noise."""
    rng = np.random.default_rng(number)
    corner, at = rng.uniform(-300, 300, (9, 2)), np.linspace(0, 8, n)
    east, north = (np.interp(at, np.arange(9), corner[:, k]) for k in (0, 1))
    position = np.stack([east, north, 40.0 + 5 * (number % 8) + 0 * at], axis=1)
    yaw = np.interp(at, np.arange(9), rng.uniform(0, 360, 9))
    line = position - [0.0, 0.0, 10.0]
    mast = line / np.linalg.norm(line, axis=1)[:, None]
    body = np.einsum("nji,nj->ni", rotation_from_aircraft(3 * np.sin(5 * at), 4 * np.cos(3 * at), yaw), -mast)
    some = np.arange(0, n, 10)
    root = np.linalg.cholesky(np.exp(-cdist(position[some], position[some]) / 20.0) + 1e-9 * np.eye(len(some)))
    out = []
    for channel in ("USRP1", "USRP2"):
        shadow = np.interp(np.arange(n), some, 2.0 * root @ rng.normal(size=len(some)))
        level = GAINS["uav"](body) + GAINS[channel](mast) + rng.uniform(-5, 5) + shadow + 1.5 * rng.normal(size=n)
        samples = LinkSamples(f"f{number:03d}", "LW1", channel, np.arange(n) * 0.2, position, body, mast, level)
        out.append(Observed(samples, -20 * np.log10(np.linalg.norm(line, axis=1)), yaw))
    return out


def measured(flights: int, n: int) -> dict[str, Any]:
    """CPU seconds of fit and scores, error on flights left out, peak memory so far [MiB]."""
    observed = [o for k in range(flights) for o in flight(k, n)]
    recipe = Recipe(model=GainModel(terms=UAV_TERMS + TOWER_TERMS), rotation=rotation, mount=False)
    begin = time.process_time()
    calibration.learn([o.samples for o in observed], recipe)
    fitted = time.process_time()
    scores, _ = score_all(observed, recipe, Stages())
    end = time.process_time()
    return {
        "flights": flights,
        "samples": 2 * n * flights,
        "fit_cpu_s": fitted - begin,
        "scores_cpu_s": end - fitted,
        "left_out_rmse_db": calibration.mean_rmse(scores["flight_left_out"]),
        "free_space_rmse_db": calibration.mean_rmse(scores["flight_left_out"], "free_space_rmse_db"),
        "peak_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flights", type=int, nargs="+", default=[2, 5, 20])
    parser.add_argument("--samples", type=int, default=3500, help="per channel")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    counts = sorted(arguments.flights)
    if arguments.json:
        rows = [measured(count, arguments.samples) for count in counts]
        print(json.dumps({"machine": platform.processor() or platform.machine(), "rows": rows}))
        return
    print(f"{platform.processor() or platform.machine()}, NumPy {np.__version__}, one process, CPU seconds")
    print(f"{'flights':>8} {'samples':>8} {'fit CPU s':>10} {'scores CPU s':>13} {'left out dB':>12} {'peak MiB':>9}")
    for count in counts:  # each as it is done: the last takes minutes
        row = measured(count, arguments.samples)
        print(f"{row['flights']:8d} {row['samples']:8d} {row['fit_cpu_s']:10.1f} {row['scores_cpu_s']:13.1f} "
              f"{row['left_out_rmse_db']:12.2f} {row['peak_mib']:9.0f}", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
