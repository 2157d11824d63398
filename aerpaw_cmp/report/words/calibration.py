"""Sentences of a calibration's page, each with the condition under which it may stand."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

from ...compare.judge.verdicts import Verdict, antenna_or_place, by_flight
from ...compare.learning.calibration import BASELINES, Score, mean_rmse
from ...compare.learning.learning_curve import CurvePoint, with_one_more
from .phrases import said_of

ONE_FLIGHT = "Nothing is scored: one flight alone. Next: add a second flight."

# Learned antennas against the best baseline, by :func:`~aerpaw_cmp.compare.judge.verdicts.by_flight`.
HELPS: dict[str, tuple[str, str]] = {
    "better": (
        "The learned antennas are significantly better ({effect:+.1f} dB, 95 %: {low:+.1f} to {high:+.1f} dB).",
        "`aerpaw-cmp report FLIGHT --with CALIBRATED`",
    ),
    "worse": (
        "The learned antennas are significantly worse ({effect:+.1f} dB, 95 %: {low:+.1f} to {high:+.1f} dB).",
        "leave them out of flight.yaml; check node, channel and gain of the logs",
    ),
    "not significant": (
        "The difference of {effect:+.1f} dB is not significant (95 %: {low:+.1f} to {high:+.1f} dB).",
        "add flights with other headings",
    ),
    "no interval": (
        "The difference is {effect:+.1f} dB; two flights give no interval.",
        "add a third flight",
    ),
}

# Body frame against frames that do not turn, by :func:`~aerpaw_cmp.compare.judge.verdicts.antenna_or_place`.
FRAMES: dict[str, tuple[str, str]] = {
    "antenna": (
        "What was learned turns with the UAV, as an antenna does: {where} the error is {size:.1f} dB larger "
        "(95 %: {near:.1f} to {far:.1f} dB).",
        "",
    ),
    "place": (
        "What was learned belongs to places: {where} the error is {size:.1f} dB smaller "
        "(95 %: {near:.1f} to {far:.1f} dB).",
        "fly the same places with other headings",
    ),
    "not separable": (
        "Antenna and place are not separable: {where} the error differs by {size:.1f} dB, not significantly.",
        "",
    ),
    "no interval": ("Antenna and place are not separable with two flights.", ""),
}

WRONG_FRAMES = {
    "world frame at the UAV": "in a frame fixed to the ground",
    "heading turned the wrong way": "with the heading turned the wrong way",
}


def helps(scores: Sequence[Score]) -> Verdict:
    """The learned antennas against the best baseline on the flights left out."""
    name = min(BASELINES, key=lambda key: mean_rmse(scores, key))
    return by_flight(_errors(scores), _errors(scores, name), name)


def frame(controls: Mapping[str, Sequence[Score]]) -> Verdict:
    """Antenna or memory of the place, without patterns."""
    body = _errors(controls.get("body frame, no patterns", ()))
    return antenna_or_place(
        [by_flight(body, _errors(controls.get(name, ())), where) for name, where in WRONG_FRAMES.items()]
    )


def _errors(scores: Sequence[Score], name: str = "rmse_db") -> list[tuple[str, float]]:
    return [(score.flight, getattr(score, name)) for score in scores]


def sentences(
    scores: Mapping[str, Sequence[Score]],
    controls: Mapping[str, Sequence[Score]],
    ground_m: tuple[float, float] | None,
    curve: Sequence[CurvePoint],
) -> tuple[str, ...]:
    """The first words of page and terminal, then further sentences.

    Parameters
    ----------
    scores, controls : mapping of str to sequence of Score
        By what was left out, and by wrong or simpler model.
    ground_m : (float, float), optional
        Heights of roughness that the data allow; None where no ground was fitted.
    curve : sequence of CurvePoint

    Returns
    -------
    tuple of str
    """
    left_out = scores["flight_left_out"]
    if not left_out:
        return (ONE_FLIGHT,)
    verdict, turned = helps(left_out), frame(controls)
    worst = max(left_out, key=lambda score: score.rmse_db)
    ends = sorted(map(abs, turned.interval))
    helped, _, step = said_of(verdict, HELPS).partition(" Next: ")
    first = (
        f"Flights left out: RMSE {mean_rmse(left_out):.1f} dB with learned antennas; "
        f"{BASELINES[verdict.where]}: {mean_rmse(left_out, verdict.where):.1f} dB.",
        helped,
        f"Largest error: {worst.flight}, {worst.tower} {worst.channel}, {worst.rmse_db:.1f} dB.",
        said_of(turned, FRAMES, near=ends[0], far=ends[1]),
        f"Next: {step}" if turned.cause != "place" else "",
    )
    return (" ".join(text for text in first if text), *_further(scores, ground_m), *_of_curve(curve))


def _further(scores: Mapping[str, Sequence[Score]], ground_m: tuple[float, float] | None) -> Iterator[str]:
    left_out, sectors = scores["flight_left_out"], scores["sector_left_out"]
    if sectors:
        base, error = mean_rmse(sectors, "free_space_rmse_db"), mean_rmse(sectors)
        yield f"Directions that no training flight has seen: RMSE {error:.1f} dB; free space: {base:.1f} dB."
        gain = mean_rmse(left_out, "free_space_rmse_db") - mean_rmse(left_out)
        if gain > 0:
            share = min(max((base - error) / gain, 0.0), 1.0)
            yield f"{100 * share:.0f} % of the gain over free space carries over to these directions."
    if not scores["heading_left_out"]:
        yield "No heading could be left out: the flights share one."
    if ground_m is not None and math.isinf(ground_m[0]):
        yield "A coherent ground ray is not in the data."
    elif ground_m is not None:
        low, high = (100.0 * end for end in ground_m)
        yield f"Roughness of the ground that the data allow: {low:.1f} cm " + (
            "or more." if math.isinf(high) else f"to {high:.1f} cm."
        )


def _of_curve(points: Sequence[CurvePoint]) -> Iterator[str]:
    if len(points) > 1:
        counts, errors = (", ".join(texts) for texts in ([str(p.flights) for p in points],
                                                         [f"{p.rmse_db:.2f}" for p in points]))  # fmt: skip
        more = with_one_more(points)
        yield f"Learned from {counts} other flights, the error on a flight left out is {errors} dB."
        yield (f"One flight more would bring about {points[-1].rmse_db - more:.2f} dB ({more:.2f} dB, extrapolated).")
