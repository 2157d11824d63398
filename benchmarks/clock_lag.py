"""How well planted clock offsets and drifts come back, over simulated flights at 3 dB noise.

Routes circle a tower at changing radius and height, so that the two-ray lobes tie the level to the clock; lags are
drawn from -10 .. 10 s and drifts from -5 .. 5 ms/min. Flat flights (a level that does not change) must not be "ok".

    python benchmarks/clock_lag.py [--quick] [--json]
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable

import numpy as np

from aerpaw_cmp.flight.lag import estimate_lag

WAVELENGTH_M = 299_792_458.0 / 3.3e9
NOISE_DB = 3.0


def route(duration_s: float, rng: np.random.Generator) -> Callable[[np.ndarray], np.ndarray]:
    """Level [dB] as a function of time [s], NaN more than 15 s off the flight."""
    turn, sway, climb = rng.uniform(200, 400), rng.uniform(70, 130), rng.uniform(50, 90)

    def level(t: np.ndarray) -> np.ndarray:
        angle, radius = 2 * np.pi * t / turn, 120 + 60 * np.sin(2 * np.pi * t / sway)
        east, north, up = 60 + radius * np.cos(angle), radius * np.sin(angle), 40 + 8 * np.sin(2 * np.pi * t / climb)
        direct, ground = (np.sqrt(east**2 + north**2 + (up + height) ** 2) for height in (-10, 10))
        wave = -2j * np.pi / WAVELENGTH_M
        field = np.exp(wave * direct) / direct - 0.5 * np.exp(wave * ground) / ground
        db = 20 * np.log10(np.abs(field) * WAVELENGTH_M / (4 * np.pi))
        return np.where((t < -15) | (t > duration_s + 15), np.nan, db)

    return level


def one(duration_s: float, rng: np.random.Generator) -> tuple[float, float, bool, bool, bool]:
    """Errors of lag [s] and drift [ms/min], whether the intervals hold the truth, whether the verdict is ok."""
    lag, drift = rng.uniform(-10, 10), rng.uniform(-5, 5) * 1e-3 / 60
    level = route(duration_s, rng)
    t = np.arange(0, duration_s, 0.1)
    heard = level(t - lag - drift * (t - t[-1] / 2)) + rng.normal(0, NOISE_DB, len(t))
    fit = estimate_lag(t, heard, level)
    low, high = fit.drift_interval_s_per_s
    at_reference = lag + drift * (fit.reference - t[-1] / 2)
    return (
        fit.radio_minus_telemetry_s - at_reference,
        (fit.drift_s_per_s - drift) * 60e3,
        fit.ci95_s[0] <= at_reference <= fit.ci95_s[1],
        low <= drift <= high,
        fit.verdict == "ok",
    )


def flat(rng: np.random.Generator) -> bool:
    """Whether a flat flight is called ok (it must not be)."""
    t = np.arange(0, 600, 0.1)
    wobble = rng.uniform(0, 0.1)
    fit = estimate_lag(t, rng.normal(0, NOISE_DB, len(t)), lambda x: wobble * np.sin(x / rng.uniform(3, 30)))
    return fit.verdict == "ok"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="5 flights each")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    flights = 5 if arguments.quick else 100
    rng = np.random.default_rng(0)
    errors = np.array([one(1800.0, rng) for _ in range(flights)], dtype=float)
    found = {
        "flights": flights,
        "noise_db": NOISE_DB,
        "duration_s": 1800.0,
        "lag_within_0.1_s": float(np.mean(np.abs(errors[:, 0]) < 0.1)),
        "lag_worst_s": float(np.abs(errors[:, 0]).max()),
        "drift_within_0.5_ms_per_min": float(np.mean(np.abs(errors[:, 1]) < 0.5)),
        "drift_worst_ms_per_min": float(np.abs(errors[:, 1]).max()),
        "lag_interval_holds": float(errors[:, 2].mean()),
        "drift_interval_holds": float(errors[:, 3].mean()),
        "verdict_ok": float(errors[:, 4].mean()),
        "flat_flights_called_ok": float(np.mean([flat(rng) for _ in range(flights)])),
    }
    if arguments.json:
        print(json.dumps(found))
        return
    for name, value in found.items():
        print(f"{name:30s} {value:10.4g}")


if __name__ == "__main__":
    main()
