"""Simulated flights with one planted trouble each: is it named, and is a sound flight left alone?

    python benchmarks/planted_causes.py [--flights 200] [--seed 1]

Flights over three towers, with an antenna that has a pattern, fading of 1-3 dB over 1-5 s and 1 dB of noise. Prints
the named cause against the planted one; exit code 1 where fewer than 90 % are right or more than 5 % of the sound
flights are accused.
"""

import argparse
import sys
from collections import Counter

import numpy as np
from numpy.typing import NDArray

from aerpaw_cmp.compare.judge.causes import LevelEvidence, likely_cause
from aerpaw_cmp.flight.simulate import correlated_noise

Array = NDArray[np.float64]
TROUBLES = ("none", "clock", "heading", "tower", "pattern", "blocked", "floor", "gain step")
TOWERS = {"LW1": (0.0, 0.0, 10.0), "LW2": (-450.0, 80.0, 10.0), "LW3": (370.0, -290.0, 10.0)}
STEP_S = 0.1
# A trouble that changes the level by less [dB] is redrawn: noise of 2-3 dB hides it, and it costs no decision.
LEAST_DB = 1.5


def route(generator: np.random.Generator) -> tuple[Array, Array, Array]:
    """Time, position and heading of a lawnmower at a random place, course and height; the nose has a fixed angle."""
    legs, length, gap = int(generator.integers(4, 8)), generator.uniform(200, 400), generator.uniform(30, 60)
    corners = [(x * (1 if i % 2 == 0 else -1), i * gap) for i in range(legs) for x in (-length / 2, length / 2)]
    course = generator.uniform(0, 2 * np.pi)
    turn = np.array([[np.cos(course), -np.sin(course)], [np.sin(course), np.cos(course)]])
    place = np.array(corners) @ turn.T + generator.uniform(-150, 150, 2)
    lengths = np.hypot(*np.diff(place, axis=0).T)
    at = np.concatenate(([0.0], np.cumsum(lengths / generator.uniform(5, 9))))
    time_s = np.arange(0.0, at[-1], STEP_S)
    east, north = (np.interp(time_s, at, place[:, i]) for i in (0, 1))
    fixed = generator.random() < 0.5
    heading = np.arctan2(np.gradient(east), np.gradient(north))
    heading = np.full(len(time_s), generator.uniform(-np.pi, np.pi)) if fixed else heading
    return time_s, np.column_stack([east, north, np.full(len(time_s), generator.uniform(30, 80))]), heading


def gain(azimuth: Array, elevation: Array, waves: Array) -> Array:
    """Gain [dB] of an antenna given by four harmonics of its azimuth and two of its elevation."""
    terms = [wave(k * azimuth) for k in (1, 2) for wave in (np.cos, np.sin)]
    return np.asarray(waves @ np.array([*terms, np.sin(elevation), np.sin(elevation) ** 2]))


def level(position: Array, heading: Array, tower: tuple[float, float, float], waves: Array) -> Array:
    """Free space with the UAV's antenna [dB]."""
    away = np.array(tower) - position
    azimuth = np.arctan2(away[:, 0], away[:, 1]) - heading
    elevation = np.arctan2(away[:, 2], np.hypot(away[:, 0], away[:, 1]))
    return gain(azimuth, elevation, waves) - 20.0 * np.log10(np.linalg.norm(away, axis=1))


def flight(trouble: str, generator: np.random.Generator) -> LevelEvidence:
    """A flight of LW1 as it is compared, with one trouble that matters: at least ``LEAST_DB`` in the mean square."""
    while True:
        evidence, effect_db = _drawn(trouble, generator)
        if trouble == "none" or effect_db >= LEAST_DB:
            return evidence


def _drawn(trouble: str, generator: np.random.Generator) -> tuple[LevelEvidence, float]:
    """A flight, and the standard deviation of what the trouble changes [dB]."""
    time_s, position, heading = route(generator)
    waves = generator.normal(0.0, [2.5, 2.5, 1.5, 1.5, 2.0, 2.0])
    tower = TOWERS["LW1"]
    predicted = level(position, heading, tower, waves)
    noise = correlated_noise(generator, len(time_s), generator.uniform(1, 3), STEP_S, generator.uniform(1, 5))
    noise += generator.normal(0.0, 1.0, len(time_s))
    away = position - np.array(tower)
    seen = np.degrees(np.arctan2(away[:, 0], away[:, 1]))
    sign = generator.choice([-1.0, 1.0])
    measured = predicted
    if trouble == "clock":
        measured = np.interp(time_s - sign * generator.uniform(2, 8), time_s, predicted)
    elif trouble == "heading":
        measured = level(position, heading + sign * np.radians(generator.uniform(30, 150)), tower, waves)
    elif trouble == "tower":
        measured = level(position, heading, TOWERS[str(generator.choice(["LW2", "LW3"]))], waves)
    elif trouble == "pattern":
        measured = level(position, heading, tower, generator.normal(0.0, [2.5, 2.5, 1.5, 1.5, 2.0, 2.0]))
    elif trouble == "blocked":
        middle, width = generator.choice(seen), generator.uniform(20, 60)
        measured = predicted - generator.uniform(6, 20) * ((seen - middle + width / 2) % 360 < width)
    elif trouble == "gain step":
        at = generator.uniform(0.2, 0.8) * time_s[-1]
        measured = predicted + sign * generator.uniform(3, 10) * (time_s > at)
    noisy = measured + noise
    if trouble == "floor":
        floor = np.quantile(noisy, generator.uniform(0.2, 0.5))
        measured = np.maximum(measured, floor)
        noisy = np.maximum(noisy, floor) + generator.normal(0.0, 0.3, len(noisy))
    away = -away
    evidence = LevelEvidence(
        time_s=time_s,
        measured_db=noisy - 40.0,
        predicted_db=predicted,
        uav_azimuth_deg=np.degrees(np.arctan2(away[:, 0], away[:, 1]) - heading),
        uav_elevation_deg=np.degrees(np.arctan2(away[:, 2], np.hypot(away[:, 0], away[:, 1]))),
        tower_azimuth_deg=seen,
        turned_db={
            float(angle): level(position, heading + np.radians(angle), tower, waves) - predicted
            for angle in range(10, 360, 10)
        },
        other_towers_db={name: level(position, heading, TOWERS[name], waves) for name in ("LW2", "LW3")},
    )
    return evidence, float(np.std(measured - predicted))


def run(flights: int, seed: int) -> Counter[tuple[str, str]]:
    """Planted and named causes of some flights."""
    counts: Counter[tuple[str, str]] = Counter()
    for number in range(flights):
        trouble = TROUBLES[number % len(TROUBLES)]
        cause = likely_cause(flight(trouble, np.random.default_rng([seed, number])))
        counts[trouble, cause.name] += 1
    return counts


def main() -> int:
    """Print the table and the two shares."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--flights", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    counts = run(given.flights, given.seed)
    print(f"{'planted':10} " + " ".join(f"{name:>9}" for name in TROUBLES))
    for planted in TROUBLES:
        print(f"{planted:10} " + " ".join(f"{counts[planted, name]:9}" for name in TROUBLES))
    sound = sum(number for (planted, _), number in counts.items() if planted == "none")
    troubled = given.flights - sound
    right = sum(number for (planted, name), number in counts.items() if planted == name != "none")
    accused = sound - counts["none", "none"]
    print(
        f"named rightly: {right} of {troubled} ({right / troubled:.1%}); accused without trouble: {accused} of {sound}"
    )
    return int(right < 0.9 * troubled or accused > 0.05 * sound)


if __name__ == "__main__":
    sys.exit(main())
