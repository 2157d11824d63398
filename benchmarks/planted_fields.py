"""Residual fields with planted strengths: what is recovered, whether intervals hold, and what a large map costs.

Each simulated set has three lawnmower flights of one area at two heights, drawn from the model :data:`PLANTED`. Two
flights are known, and the third is predicted. Scales are learned on the two known flights alone.

    python benchmarks/planted_fields.py [--sets 67] [--targets 20000] [--json]
"""

import argparse
import dataclasses
import json
import time

import numpy as np

from aerpaw_cmp.compare.field_gp import FieldFit, FieldModel, Rows, covariance, fit_field

PLANTED = FieldModel(place_sd_db=2.5, length_m=60, height_m=25, turn=0.8, drift_sd_db=1.2, drift_s=90)
SHARES = {0.5: 0.6745, 0.9: 1.6449, 0.95: 1.96}


def flown(rng: np.random.Generator, count: int, each: int) -> Rows:
    """Simulate lawnmowers with legs of 480 m, 45 m apart, and 4 s per row. Every second flight is 20 m higher."""
    parts = []
    for flight in range(count):
        t = 4.0 * np.arange(each)
        leg = (t // 80.0).astype(int)
        east = np.where(leg % 2 == 0, t % 80.0, 80.0 - t % 80.0) * 6.0
        yaw = np.pi * (leg % 2) + rng.normal(0.0, 0.2, each)
        parts.append(
            Rows(
                position_m=np.column_stack([east, leg * 45.0, np.full(each, 30.0 + 20.0 * (flight % 2))]),
                direction=np.column_stack([np.cos(yaw), np.sin(yaw), np.zeros(each)]),
                time_s=t,
                flight=np.full(each, flight),
            )
        )
    return Rows.joined(parts)


def main() -> None:
    """Simulate, predict, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sets", type=int, default=67, help="of three flights each")
    parser.add_argument("--targets", type=int, default=20_000, help="of the map from 20 flights")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    rng, known, models = np.random.default_rng(1), {share: [] for share in SHARES}, []
    for _ in range(args.sets):
        rows = flown(rng, 3, 150)
        matrix = covariance(PLANTED, rows, rows, ("place", "offset", "drift"))
        matrix[np.diag_indices(len(rows))] += PLANTED.noise_sd_db**2
        value = np.linalg.cholesky(matrix) @ rng.normal(size=len(rows))
        asked = rows.flight == 2
        model = fit_field([(rows.part(~asked), value[~asked])])
        models.append(model)
        targets = dataclasses.replace(rows.part(asked), flight=np.full(asked.sum(), -1))
        mean, sd = FieldFit(model, rows.part(~asked), value[~asked]).predict(targets)
        z = np.abs(value[asked] - mean) / np.hypot(sd, model.noise_sd_db)
        for share, bound in SHARES.items():
            known[share].append(float(np.mean(z < bound)))
    rows = flown(rng, 20, 400)
    targets = rows.part(rng.integers(0, len(rows), args.targets))
    targets = dataclasses.replace(
        targets, position_m=targets.position_m + rng.normal(0, 20, (args.targets, 3)), flight=np.full(args.targets, -1)
    )
    start = time.process_time()
    FieldFit(PLANTED, rows, rng.normal(size=len(rows))).predict(targets)
    result = {
        "flights": 3 * args.sets,
        "held": {str(share): float(np.mean(held)) for share, held in known.items()},
        "planted": dataclasses.asdict(PLANTED),
        "recovered_median": {
            name: float(np.median([getattr(m, name) for m in models])) for name in dataclasses.asdict(PLANTED)
        },
        "cpu_s_per_1e6_targets_of_20_flights": 1e6 / args.targets * (time.process_time() - start),
    }
    if args.json:
        print(json.dumps(result))
        return
    print(f"{result['flights']} simulated flights, a third of them predicted from the others")
    for share, held in result["held"].items():
        print(f"  intervals of {float(share):.0%} hold {held:.1%}")
    for name, value in result["planted"].items():
        print(f"  {name}: planted {value:g}, recovered {result['recovered_median'][name]:.3g} (median)")
    print(f"  1e6 targets of 20 flights: {result['cpu_s_per_1e6_targets_of_20_flights']:.0f} CPU s")


if __name__ == "__main__":
    main()
