"""Decisions behind the first sentences of five pages, on planted cases: the cause is named, chance is not accused.

python -m tests.compare.test_verdicts        prints the shares over 200 cases of each kind
"""

from __future__ import annotations

import sys
from collections.abc import Callable

import numpy as np
import pytest

from aerpaw_cmp.compare.report_difference import Overlap, level_difference, pooled_difference
from aerpaw_cmp.compare.verdicts import (
    Coverage,
    Verdict,
    antenna_or_place,
    by_flight,
    campaign_verdict,
    changed_verdict,
    coverage_verdict,
    stated_errors,
)
from aerpaw_cmp.flight.simulate import correlated_noise

Generator = np.random.Generator


def campaign(trouble: str, draw: Generator) -> Verdict:
    """8 to 20 flights over 1 to 3 links: offsets scatter by 1 dB, errors by 15 %."""
    flights = [f"F{i:02}" for i in range(int(draw.integers(8, 21)))]
    n, links = len(flights), [f"LW{i + 1}" for i in range(int(draw.integers(1, 4)))]
    offset = {link: draw.normal(40.0, 5.0) + draw.normal(0.0, 1.0, n) for link in links}
    error = 5.0 * np.exp(draw.normal(0.0, 0.15, n))
    at, size = int(draw.integers(n)), draw.choice([-1.0, 1.0]) * draw.uniform(6.0, 12.0)
    if trouble == "outlying error":
        error[at] *= draw.uniform(2.5, 4.0)
    elif trouble == "outlying offset":
        for values in offset.values():
            values[at] += size
    elif trouble == "gain step":
        offset[links[0]][int(draw.integers(3, n - 2)) :] += size / 2.0
    by_link = {link: dict(zip(flights, values, strict=True)) for link, values in offset.items()}
    return campaign_verdict(dict(zip(flights, error, strict=True)), by_link, flights)


def calibration(trouble: str, draw: Generator) -> Verdict:
    """4 to 8 flights left out, two channels: hard flights are hard for both models."""
    n = int(draw.integers(4, 9))
    hard = draw.normal(6.0, 1.0, n)
    change = {"better": -2.0, "worse": 2.0}.get(trouble, 0.0) + draw.normal(0.0, 0.5, n)
    channels = draw.normal(0.0, 0.3, (n, 2))
    free = [(f"F{i}", hard[i] + channels[i, c]) for i in range(n) for c in range(2)]
    learned = [(f"F{i}", hard[i] + channels[i, c] + change[i]) for i in range(n) for c in range(2)]
    return by_flight(learned, free, "free space")


def frames(trouble: str, draw: Generator) -> Verdict:
    """The body frame against two wrong ones; a field over places fits the world frame as well or better."""
    n = int(draw.integers(4, 9))
    gain = {"antenna": -1.5, "place": 1.5}.get(trouble, 0.0)
    body = [(f"F{i}", value) for i, value in enumerate(draw.normal(3.0, 0.8, n))]
    wrong = [[(name, error - gain + draw.normal(0.0, 0.4)) for name, error in body] for _ in range(2)]
    return antenna_or_place([by_flight(body, other, str(i)) for i, other in enumerate(wrong)])


def prediction(trouble: str, draw: Generator) -> Verdict:
    """A flight of 2 to 5 dB of error that remembers 2 to 10 s, its offset drawn as stated."""
    n, sd, common = 1500, draw.uniform(2.0, 5.0), 1.5
    error = correlated_noise(draw, n, 0.8 * sd, 0.4, draw.uniform(2.0, 10.0)) + draw.normal(0.0, 0.6 * sd, n)
    error += draw.normal(0.0, common) if trouble != "biased" else draw.choice([-1.0, 1.0]) * draw.uniform(9.0, 14.0)
    stated = np.full(n, np.hypot(sd, common)) * {"narrow": 0.45, "wide": 2.2}.get(trouble, 1.0)
    return stated_errors(error, stated, common)


def coverage(trouble: str, draw: Generator) -> Verdict:
    """A square of 900 positions about a tower; trees and a hill take levels, a threshold takes weak ones."""
    east, north = np.meshgrid(np.linspace(-600, 600, 30), np.linspace(-600, 600, 30))
    distance = np.hypot(east, north).ravel() + 20.0
    level = -20.0 * np.log10(distance) + draw.normal(0.0, 2.0, distance.size)
    threshold, trees, hill = -np.inf, np.zeros(distance.size, bool), np.zeros(distance.size, bool)
    edge = draw.uniform(-300.0, 200.0)
    if trouble == "trees":
        trees = east.ravel() > edge
    elif trouble == "blocked":
        hill = north.ravel() > edge
    elif trouble == "level":
        threshold = float(np.quantile(level, draw.uniform(0.2, 0.8)))
    elif trouble == "threshold":
        threshold = level.max() + draw.uniform(1.0, 30.0)
    elif trouble == "no path":
        hill = np.ones(distance.size, bool)
    path = ~trees & ~hill
    return coverage_verdict(
        [
            Coverage(
                height_m=height,
                covered=float(np.mean(path & (level > threshold))),
                clear=float(np.mean(~hill & (level > threshold))),
                reached=float(np.mean(path)),
                outside=draw.uniform(0.6, 1.0) if trouble == "extrapolated" else draw.uniform(0.0, 0.4),
            )
            for height in (30.0, 110.0)
        ]
    )


def difference(trouble: str, draw: Generator) -> Verdict:
    """Two reports of one flight, residuals with a memory of 2 to 8 s."""
    n = 1500
    time = 0.2 * np.arange(n)
    simulated = draw.normal(-80.0, 5.0, n)
    first = correlated_noise(draw, n, 3.0, 0.2, draw.uniform(2.0, 8.0)) + draw.normal(0.0, 1.0, n)
    second, measured = first.copy(), simulated + first
    changed = dict.fromkeys(("setting", "input", "version"), 0)
    if trouble in changed:
        changed[trouble] = 1
    if trouble != "none":
        second = first + correlated_noise(draw, n, 3.0, 0.2, 3.0)
    other = measured + (draw.normal(0.0, 1.0, n) if trouble == "measured" else 0.0)
    overlap = Overlap(first=n, second=n, common=n)
    sides = ((measured, simulated, first), (other, measured - second, second))
    level = level_difference("LW1", "USRP1", overlap, *sides, scored=(n, n), offsets_db=(0.0, 0.0))
    moved = (level.measured_max_db, level.simulated_max_db, abs(level.rmse.difference_db))
    pooled = pooled_difference([(time, first, second)])
    return changed_verdict(pooled, any(value > 0.01 for value in moved), level.measured_max_db > 0.01, changed)


KINDS: dict[Callable[[str, Generator], Verdict], tuple[str, ...]] = {
    campaign: ("none", "outlying error", "outlying offset", "gain step"),
    calibration: ("not significant", "better", "worse"),
    frames: ("not separable", "antenna", "place"),
    prediction: ("none", "narrow", "wide", "biased"),
    coverage: ("none", "trees", "blocked", "level", "threshold", "no path", "extrapolated"),
    difference: ("none", "setting", "input", "version", "measured", "unexplained"),
}
"""What draws a case, and its troubles, the sound one first."""


PRAISE = ("better", "antenna")
"""Words that accuse nobody; of equal models a 95 % interval gives them in 2.5 %, like each of the other words."""


def shares(kind: Callable[[str, Generator], Verdict], cases: int, seed: int = 5) -> tuple[float, float, int]:
    """Share of troubles named rightly, share of sound cases accused, and verdicts against their interval."""
    sound, *troubles = KINDS[kind]
    right = accused = against = 0
    for number in range(cases):
        for trouble in (sound, *troubles):
            said = kind(trouble, np.random.default_rng([seed, number, len(trouble), *trouble.encode()]))
            right += said.cause == trouble != sound
            accused += trouble == sound and said.cause not in (sound, *PRAISE)
            against += contradicts(said)
    return right / (cases * len(troubles)), accused / cases, against


def contradicts(said: Verdict) -> bool:
    """A word of significance whose interval holds "no effect", or an effect outside its own interval."""
    low, high = said.interval
    nothing = 1.0 if said.cause in ("outlying error", "narrow", "wide") else 0.0
    shown = said.cause in ("better", "worse", "antenna", "place", "gain step", "biased", "narrow", "wide")
    shown |= said.cause.startswith("outlying")
    return shown and (not np.isfinite([low, high]).all() or low <= nothing <= high or not low <= said.effect <= high)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_planted_troubles_are_named_and_sound_cases_left_alone(kind: Callable[[str, Generator], Verdict]) -> None:
    right, accused, against = shares(kind, 40 if kind in (prediction, difference) else 200)
    assert right >= 0.9
    assert accused <= 0.05
    assert against == 0


def test_few_flights_accuse_nobody_and_have_no_interval() -> None:
    flights = ["A", "B", "C"]
    lone = campaign_verdict(dict(zip(flights, (5.0, 5.1, 50.0), strict=True)), {}, flights)
    assert lone.cause == "none"
    two = by_flight([("A", 3.0), ("B", 3.1)], [("A", 6.0), ("B", 6.2)])
    assert two.cause == "no interval"
    assert np.isnan(two.interval).all()
    assert stated_errors(np.ones(10), np.ones(10)).cause == "no interval"
    assert coverage_verdict([]).cause == "none"


def test_an_unpaired_flight_takes_no_part() -> None:
    """The mean difference of the common flights alone, by hand."""
    said = by_flight(
        [("A", 1.0), ("B", 2.0), ("C", 6.0), ("D", 90.0)], [("A", 3.0), ("B", 5.0), ("C", 7.0), ("E", 1.0)]
    )
    assert said.effect == pytest.approx(-2.0)  # -2, -3, -1
    assert said.interval == pytest.approx((-2.0 - 4.302653 / 3**0.5, -2.0 + 4.302653 / 3**0.5), abs=1e-5)


if __name__ == "__main__":
    for one in KINDS:
        named, wrongly, words = shares(one, 200)
        sys.stdout.write(f"{one.__name__:12} named {named:.1%}, accused {wrongly:.1%}, against the interval {words}\n")
