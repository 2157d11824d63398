"""CPU time of a record while the rest of a route is predicted in flight, at 10 Hz with two trends.

python benchmarks/route_ahead.py [--minutes 20] [--points 600] [--json]
"""

import argparse
import json
import time

import numpy as np

from aerpaw_cmp.compare.field_gp import RouteAhead


def main() -> None:
    """Fly, time each record, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=20.0)
    parser.add_argument("--points", type=int, default=600)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    rng, last = np.random.default_rng(1), 60.0 * args.minutes
    at = np.linspace(0.0, last, args.points)
    route = np.column_stack([400 * np.sin(at / 97.0), 400 * np.cos(at / 131.0), np.full(args.points, 40.0)])
    trends = {"replay": rng.normal(-80, 5, args.points), "free space": rng.normal(-80, 5, args.points)}
    ahead, spent = RouteAhead(route, trends), []
    for now in np.arange(0.0, last, 0.1):
        place = np.array([np.interp(now, at, route[:, i]) for i in range(3)])
        here = {name: float(np.interp(now, at, values)) for name, values in trends.items()}
        start = time.thread_time()
        ahead.add(float(now), place, here["replay"] + rng.normal(), here)
        spent.append(1e3 * (time.thread_time() - start))
    result = {"records": len(spent), "mean_ms": float(np.mean(spent)), "p99_ms": float(np.quantile(spent, 0.99)),
              "max_ms": float(np.max(spent))}  # fmt: skip
    print(json.dumps(result) if args.json else result)


if __name__ == "__main__":
    main()
