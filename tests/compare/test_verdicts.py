"""Decisions behind the first sentences of five pages, on planted cases: the cause is named, chance is not accused.

python -m tests.compare.test_verdicts        prints the shares over 200 cases of each kind
"""

import sys
from collections.abc import Callable

import numpy as np
import pytest
from scipy.stats import ttest_ind

from aerpaw_cmp.compare import verdict as verdicts
from aerpaw_cmp.compare.verdict import (
    Coverage,
    Verdict,
    antenna_or_place,
    by_flight,
    campaign_verdict,
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
    """Return 4 to 8 held-out flights with two channels. A difficult flight has larger errors for both models."""
    n = int(draw.integers(4, 9))
    hard = draw.normal(6.0, 1.0, n)
    change = {"better": -2.0, "worse": 2.0}.get(trouble, 0.0) + draw.normal(0.0, 0.5, n)
    channels = draw.normal(0.0, 0.3, (n, 2))
    free = [(f"F{i}", hard[i] + channels[i, c]) for i in range(n) for c in range(2)]
    learned = [(f"F{i}", hard[i] + channels[i, c] + change[i]) for i in range(n) for c in range(2)]
    return by_flight(learned, free, "free space")


def frames(trouble: str, draw: Generator) -> Verdict:
    """Compare the body frame with two wrong frames. For a field over places, the world frame fits as well or better."""
    n = int(draw.integers(4, 9))
    gain = {"antenna": -1.5, "place": 1.5}.get(trouble, 0.0)
    body = [(f"F{i}", value) for i, value in enumerate(draw.normal(3.0, 0.8, n))]
    wrong = [[(name, error - gain + draw.normal(0.0, 0.4)) for name, error in body] for _ in range(2)]
    return antenna_or_place([by_flight(body, other, str(i)) for i, other in enumerate(wrong)])


def prediction(trouble: str, draw: Generator) -> Verdict:
    """Return a flight with an error of 2 to 5 dB, a correlation time of 2 to 10 s, and an offset drawn as stated."""
    n, sd, common = 1500, draw.uniform(2.0, 5.0), 1.5
    error = correlated_noise(draw, n, 0.8 * sd, 0.4, draw.uniform(2.0, 10.0)) + draw.normal(0.0, 0.6 * sd, n)
    error += draw.normal(0.0, common) if trouble != "biased" else draw.choice([-1.0, 1.0]) * draw.uniform(9.0, 14.0)
    stated = np.full(n, np.hypot(sd, common)) * {"narrow": 0.45, "wide": 2.2}.get(trouble, 1.0)
    return stated_errors(error, stated, common)


def coverage(trouble: str, draw: Generator) -> Verdict:
    """Draw 900 positions in a square around a tower, where trees and a hill reduce the coverage."""
    east, north = np.meshgrid(np.linspace(-600, 600, 30), np.linspace(-600, 600, 30))
    trees, hill = np.zeros(east.size, bool), np.zeros(east.size, bool)
    edge = draw.uniform(-300.0, 200.0)
    if trouble == "trees":
        trees = east.ravel() > edge
    elif trouble == "blocked":
        hill = north.ravel() > edge
    elif trouble == "no path":
        hill = np.ones(east.size, bool)
    return coverage_verdict(
        [
            Coverage(
                height_m=height,
                covered=float(np.mean(~trees & ~hill)),
                clear=float(np.mean(~hill)),
                outside=draw.uniform(0.6, 1.0) if trouble == "extrapolated" else draw.uniform(0.0, 0.4),
            )
            for height in (30.0, 110.0)
        ]
    )


# What draws a case, and its troubles, the sound one first.
KINDS: dict[Callable[[str, Generator], Verdict], tuple[str, ...]] = {
    campaign: ("none", "outlying error", "outlying offset", "gain step"),
    calibration: ("not significant", "better", "worse"),
    frames: ("not separable", "antenna", "place"),
    prediction: ("none", "narrow", "wide", "biased"),
    coverage: ("none", "trees", "blocked", "no path", "extrapolated"),
}


# Words without an accusation. For equal models, a 95 % interval leads to them in 2.5 %, like to the others.
PRAISE = ("better", "antenna")


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
    right, accused, against = shares(kind, 40 if kind is prediction else 200)
    assert right >= 0.9
    assert accused <= 0.05
    assert against == 0


def test_few_flights_accuse_nobody_and_have_no_interval() -> None:
    flights = ["A", "B", "C"]
    lone = campaign_verdict(dict(zip(flights, (5.0, 5.1, 50.0), strict=True)), {}, flights)
    assert lone.cause == "none"
    pair = by_flight([("A", 3.0), ("B", 3.1)], [("A", 6.0), ("B", 6.2)])
    assert pair.cause == "no interval"
    assert np.isnan(pair.interval).all()
    assert stated_errors(np.ones(10), np.ones(10)).cause == "no interval"
    assert coverage_verdict([]).cause == "none"


def test_an_unpaired_flight_takes_no_part() -> None:
    """The mean difference of the common flights alone, by hand."""
    said = by_flight(
        [("A", 1.0), ("B", 2.0), ("C", 6.0), ("D", 90.0)], [("A", 3.0), ("B", 5.0), ("C", 7.0), ("E", 1.0)]
    )
    assert said.effect == pytest.approx(-2.0)  # -2, -3, -1
    assert said.interval == pytest.approx((-2.0 - 4.302653 / 3**0.5, -2.0 + 4.302653 / 3**0.5), abs=1e-5)


def test_two_groups_of_flights_are_compared_by_students_test() -> None:
    values, inside = np.array([1.0, 2.5, 2.0, 4.0, 3.5, 9.0]), np.array([0, 0, 0, 1, 1, 1], dtype=bool)
    expected = ttest_ind(values[inside], values[~inside])
    chance, effect, ends = verdicts._split(values, inside)
    assert (chance, effect) == pytest.approx((expected.pvalue, values[3:].mean() - values[:3].mean()))
    assert ends == pytest.approx(tuple(expected.confidence_interval(0.95)))
    assert np.isfinite(verdicts._split(values[1:], inside[1:])[0])
    for few in (verdicts._split(values[2:], inside[2:]), verdicts._split(values, inside | ~inside)):
        assert np.isnan([few[0], few[1], *few[2]]).all()


@pytest.mark.parametrize(
    ("chances", "effect", "cause"),
    [((0.009, 0.5), 3.0, "gain step"), ((0.0101, 0.5), 3.0, "none"), ((0.009, 0.5), -1.99, "none"),
     ((0.009, 0.5), -2.01, "gain step"), ((0.006, 0.5, 0.9), 3.0, "gain step"), ((0.0067, 0.5, 0.9), 3.0, "none"),
     ((0.019, np.nan), 3.0, "gain step"), ((), 0.0, "none")],
)  # fmt: skip
def test_chance_is_shared_by_all_that_is_tried_and_two_decibels_are_small(
    chances: tuple[float, ...], effect: float, cause: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """There are at most two false alarms in a hundred campaigns, for any number of shifts that are tested."""
    shifts = [(chance, Verdict(cause="gain step", effect=effect)) for chance in chances]
    monkeypatch.setattr(verdicts, "_shifts", lambda *_: iter(shifts))
    assert campaign_verdict({}, {}, []).cause == cause


def test_every_shift_of_a_campaign_is_tried() -> None:
    names = list("ABCDEF")
    errors = dict(zip(names, (2.0, 2.2, 1.9, 8.0, 2.1, 0.0), strict=True))
    links = {
        "LW1": dict(zip(names, (1.0, 2.0, 1.5, 4.0, 5.0, 4.5), strict=True)),
        "LW2": {"A": 1.0, "B": np.nan, "C": 2.0},
    }
    tried = [verdict for _, verdict in verdicts._shifts(errors, links, names)]
    assert [shift.where for shift in tried] == [*"ABCDE", *(f"LW1 from {name}" for name in "CDE"), *names]
    assert tried[3].effect == pytest.approx(8.0 / (2.0 * 2.2 * 1.9 * 2.1) ** 0.25)
    assert tried[3].interval[0] < tried[3].effect < tried[3].interval[1]
    assert tried[6].effect == pytest.approx(4.5 - 1.5)  # from D on
    a, c = (1.0 - 3.0 - 0.5) / 2, (1.5 - 3.0 + 0.5) / 2  # about the mean of each link, then of the links
    rest = (c - 1.0 + 1.0 + 2.0 + 1.5) / 5
    assert tried[8].effect == pytest.approx(a - rest)
    low = [chance for chance, _ in verdicts._shifts(errors, {}, names)]
    assert np.isnan(low).tolist() == [True, True, True, False, True]  # a small error accuses no model


@pytest.mark.parametrize(
    ("mean", "within", "reach", "cause"),
    [(2.7, 0.1, 2.0, "biased"), (2.5, 0.1, 2.0, "none"), (-2.7, 0.1, 2.0, "biased"),
     (0.0, 1.16, 0.1, "narrow"), (0.0, 1.14, 0.1, "none"), (0.0, 0.86, 0.1, "wide"), (0.0, 0.88, 0.1, "none"),
     (2.7, 4.0, 2.0, "narrow")],
)  # fmt: skip
def test_stated_errors_by_their_limits(
    mean: float, within: float, reach: float, cause: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Errors of a known mean and spread, intervals that are given: 1.3 times its reach for a bias, 15 % for a spread."""
    error = mean + within * np.tile([1.0, -1.0], 20)
    monkeypatch.setattr(
        verdicts.statistics, "mean_interval", lambda values, _: (values.mean() - reach, values.mean() + reach)
    )
    monkeypatch.setattr(
        verdicts.statistics, "spread_interval", lambda values, _: (0.99 * values.std(), 1.01 * values.std())
    )
    said = stated_errors(np.append(error, [np.nan, 9.0]), np.append(np.ones(40), [1.0, 0.0]))
    assert said.cause == cause
    if cause == "biased":
        assert said.interval == pytest.approx((mean - reach, mean + reach))
        common = stated_errors(error, np.ones(40), 1.0)  # a shift that all samples share is not a bias
        assert common.cause == "none"
    if cause == "none" and mean == 0.0:  # what a flight shares can hide a narrow interval
        low, high = stated_errors(error, np.full(40, 2.0), 0.5).interval
        assert (2.0 * low, 2.0 * high) == pytest.approx((0.99 * within, np.hypot(1.01 * within, 0.5)))
    assert stated_errors(error[:19], np.ones(19)).cause == "no interval"
    assert stated_errors(error[:20], np.ones(20)).cause != "no interval"


@pytest.mark.parametrize(
    ("covered", "clear", "reached", "outside", "cause"),
    [(0.95, 1.0, 1.0, 0.0, "none"), (0.94, 1.0, 1.0, 0.0, "trees"), (0.5, 0.6, 0.5, 0.0, "blocked"),
     (0.0, 0.0, 0.0, 0.0, "no path"), (0.9, 1.0, 1.0, 0.51, "extrapolated"), (0.99, 1.0, 1.0, 0.5, "none"),
     (0.5, np.nan, np.nan, 0.0, "blocked"), (0.5, 0.6, 0.9, 0.0, "weak"), (0.5, 0.6, 0.7, 0.0, "blocked"),
     (0.0, 0.0, 0.3, 0.0, "blocked"), (0.0, 0.0, 1.0, 0.0, "weak")],
)  # fmt: skip
def test_the_worst_height_says_what_takes_its_coverage(
    covered: float, clear: float, reached: float, outside: float, cause: str
) -> None:
    here = Coverage(height_m=70.0, covered=covered, clear=clear, reached=reached, outside=outside)
    said = coverage_verdict([Coverage(height_m=30.0, covered=1.0, outside=1.0), here])
    assert (said.cause, said.effect, said.where) == (cause, covered, "70 m")


@pytest.mark.parametrize(
    ("causes", "verdict"),
    [("better better", "antenna"), ("better worse", "place"), ("not_significant", "not separable"),
     ("no_interval no_interval", "no interval"), ("better no_interval", "not separable")],
)  # fmt: skip
def test_an_antenna_beats_every_wrong_frame_and_a_place_loses_to_one(causes: str, verdict: str) -> None:
    """The most similar model is named: among the better models if there are any."""
    against = [Verdict(cause=c.replace("_", " "), effect=float(k - 2)) for k, c in enumerate(causes.split())]
    nearest = antenna_or_place([*against, Verdict(cause="better")])
    assert (nearest.cause, nearest.effect) == (verdict, float(len(against) - 3))
    assert antenna_or_place([Verdict(cause="worse", effect=1.0), Verdict(cause="better", effect=9.0)]).effect == 1.0


if __name__ == "__main__":
    for trouble in KINDS:
        named, wrongly, words = shares(trouble, 200)
        sys.stdout.write(
            f"{trouble.__name__:12} named {named:.1%}, accused {wrongly:.1%}, against the interval {words}\n"
        )
