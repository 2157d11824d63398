"""Sentences of a prediction, before and after the flight, each with the condition under which it may stand."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ...common.units import FloatArray
from ...compare.judge.verdicts import Verdict, stated_errors
from ...compare.learning.correction import OFF, Correction, crps_difference
from ...compare.ranks.forecast import ForecastScore
from ...compare.statistics.intervals import mean_interval, paired_difference
from ...site.antenna.learned import Entry, LearnedSeries
from ..content.against import AgainstSeries
from .phrases import filled, said_of

TITLES = {
    "learned": "antennas learned from the named flights",
    "replay": "ray tracing with the flights' own settings",
    "free space": "free space",
    "none": "a constant level",
    "memory": "antennas that the site remembers",
}

FLAGS = {
    "outside_flown": "outside the flown places: the standard deviation is that of the model alone",
    "out_of_coverage": "no path",
    "no_position": "no position",
}

# Share of points outside the flown places that the first words name.
MANY = 0.2

# The chosen model on what was left out, by the paired interval.
AGAINST_FREE_SPACE = {
    "better": (
        "The model is significantly better than free space ({effect:+.1f} dB, 95 %: {low:+.1f} to {high:+.1f} dB).",
        "",
    ),
    "worse": (
        "The model is significantly worse than free space ({effect:+.1f} dB, 95 %: {low:+.1f} to {high:+.1f} dB).",
        "",
    ),
    "not significant": ("The difference from free space of {effect:+.1f} dB is not significant (95 %).", ""),
    "no interval": ("Too few samples for an interval of the difference.", ""),
}

# The residual field, by the interval of the difference of the CRPS; ``off`` where it holds zero.
FIELD = {
    "better": (
        "The residual field is on: it lowers the CRPS by {size:.2f} dB (95 %: {high:+.2f} to {low:+.2f} dB).",
        "",
    ),
    "worse": ("The residual field is off: it raises the CRPS by {size:.2f} dB on held-out samples.", ""),
    "off": ("The residual field is off: the CRPS differs by {size:.2f} dB, not significantly.", ""),
}

HELD_OUT = "90 % intervals hold {inside:.0f} % of the held-out samples."
# Stated standard deviations on what was left out, by :func:`~aerpaw_cmp.compare.judge.verdicts.stated_errors`.
STATED: dict[str, tuple[str, str]] = {
    "none": (HELD_OUT, ""),
    "no interval": ("", ""),
    "narrow": (
        HELD_OUT
        + " They are too narrow: errors are {effect:.1f} times as large as stated (95 %: {low:.1f} to {high:.1f}).",
        "add a flight of this area",
    ),
    "wide": (
        HELD_OUT
        + " They are too wide: errors are {effect:.1f} times as large as stated (95 %: {low:.1f} to {high:.1f}).",
        "",
    ),
    "biased": (
        HELD_OUT + " Measured lies {effect:+.1f} dB (95 %: {low:+.1f} to {high:+.1f} dB) above predicted.",
        "check the gain of the flights that were learned from",
    ),
}

# The same on the flight that followed.
FLOWN: dict[str, tuple[str, str]] = {
    "none": ("Intervals are as stated.", "`aerpaw-cmp predict` with this flight for the next route"),
    "no interval": ("Too few samples to judge the intervals.", ""),
    "narrow": (
        "Intervals of {where} are too narrow: errors are {effect:.1f} times as large as stated "
        "(95 %: {low:.1f} to {high:.1f}).",
        "add this flight to those that are learned from",
    ),
    "wide": (
        "Intervals of {where} are too wide: errors are {effect:.1f} times as large as stated "
        "(95 %: {low:.1f} to {high:.1f}).",
        "add this flight to those that are learned from",
    ),
    "biased": (
        "Likely cause at {where}: another offset, measured {effect:+.1f} dB (95 %: {low:+.1f} to {high:+.1f} dB) "
        "above predicted.",
        "check transmit power and receiver gain of this flight",
    ),
}


def first_words(correction: Correction, outside: float, expected_db: float) -> str:
    """Expected error, intervals, where the prediction is a guess, model, next step: first line of terminal and page.

    Parameters
    ----------
    correction : Correction
    outside : float
        Share of points outside the flown places.
    expected_db : float
        Stated standard deviation of a mean over 4 s on a new flight, root mean square over the points [dB].

    Returns
    -------
    str
    """
    key, free = (correction.base, correction.title), ("free space", OFF)
    over = "flights left out, each about its own mean" if len(correction.flights) > 1 else "300 m blocks left out"
    baseline = f"; free space {correction.rmse_db[free]:.1f} dB" if free in correction.rmse_db else ""
    texts = [
        f"Expect an RMSE of {expected_db:.1f} dB over 4 s means at these points on a new flight.",
        f"On {over}: {correction.rmse_db[key]:.1f} dB{baseline}.",
    ]
    if free in correction.rmse_db and key != free:
        texts.append(said_of(_against_free_space(correction), AGAINST_FREE_SPACE))
    error, sd = correction.held_out[key]
    inside = 100.0 * _inside_share(error, sd)
    texts.append(said_of(stated_errors(error, sd), STATED, inside=inside))
    texts.append(f"Model: {TITLES[correction.base]}.")
    texts.append(said_of(field(correction), FIELD))
    if outside > MANY:
        texts.append(
            f"{100 * outside:.0f} % of the points lie outside the flown places. Next: `aerpaw-cmp plan` names the "
            "flight that helps most."
        )
    return " ".join(text for text in texts if text)


# A prediction from the memory of the site; ``learned`` by entry.
NO_FLIGHT = (
    "No flight is named: antennas and levels are those that the site remembers. {learned}. The offset of a new flight "
    "has a standard deviation of up to {sd:.1f} dB."
)

UNSEEN = (
    "{percent:.0f} % of the points lie in directions that the remembered flights hardly saw. Next: `aerpaw-cmp plan` "
    "names the flight that helps most."
)


def memory_words(known: Sequence[tuple[Entry, LearnedSeries, float]], outside: float) -> str:
    """First line of terminal and page without flights: what the site remembers, and the error to expect.

    Parameters
    ----------
    known : sequence of (Entry, LearnedSeries, float)
        With the standard deviation of the level [dB].
    outside : float
        Share of points in directions that flights hardly saw.

    Returns
    -------
    str
    """
    each: dict[str, list[str]] = {}
    for entry, series, _ in known:
        each.setdefault(entry.about(), []).append(f"{series.tower} {series.channel}")
    learned = ". ".join(f"{', '.join(names)}: {about}" for about, names in each.items())
    sd = max(sd_db for *_, sd_db in known)
    texts = [NO_FLIGHT, *([UNSEEN] if outside > MANY else [])]
    return " ".join(filled(texts, learned=learned, sd=sd, percent=100.0 * outside))


def _inside_share(error: FloatArray, sd: FloatArray) -> float:
    """Share of errors inside their 90 % interval."""
    good = np.isfinite(error)
    return float(np.mean(np.abs(error[good]) <= 1.6449 * sd[good])) if good.any() else float("nan")


def _against_free_space(correction: Correction) -> Verdict:
    """The chosen model and free space on the same samples that were left out."""
    error, free_space = (
        correction.held_out[key][0] for key in ((correction.base, correction.title), ("free space", OFF))
    )
    pair = paired_difference(error, free_space, free_offset=False)
    return Verdict(cause=pair.verdict, effect=pair.difference_db, interval=pair.difference_ci95_db)


def field(correction: Correction) -> Verdict:
    """CRPS with the best residual field minus that without one."""
    base = correction.base
    title = min((t for b, t in correction.crps_db if b == base and t != OFF), key=lambda t: correction.crps_db[base, t])
    difference = crps_difference(correction.held_out, (base, title))
    ends = mean_interval(difference)
    cause = "better" if correction.on else "worse" if ends[0] > 0.0 else "off"
    return Verdict(cause=cause, effect=float(difference.mean()), interval=ends, where=title)


def against_words(series: Sequence[AgainstSeries], ranks: Mapping[str, ForecastScore]) -> str:
    """Sentences on what a flight says of the prediction made before it: levels, then ranks by tower."""
    levels = [after_flight({s.name: s.scores for s in series}, [s.stated for s in series])] if series else []
    return " ".join([*levels, *(rank_after_flight(tower, score) for tower, score in ranks.items())])


def after_flight(scores: Mapping[str, Mapping[str, float]], stated: Sequence[Verdict]) -> str:
    """Sentences on what a flight says of the prediction made before it.

    Parameters
    ----------
    scores : mapping of str to mapping
        By tower and channel.
    stated : sequence of Verdict
        Of each, by :func:`~aerpaw_cmp.compare.judge.verdicts.stated_errors`.

    Returns
    -------
    str
    """
    rows = list(scores.values())
    mean = {key: float(np.mean([row[key] for row in rows])) for key in rows[0]}
    worst = max(stated, key=lambda verdict: list(FLOWN).index(verdict.cause))
    return (
        f"Predicted before this flight: RMSE {mean['rmse_db']:.1f} dB as predicted ({mean['rmse_4s_db']:.1f} dB over "
        f"4 s), {mean['own_offset_rmse_db']:.1f} dB after the flight's own offset. The 90 % intervals hold "
        f"{100 * mean['coverage_90']:.0f} % of the samples. {said_of(worst, FLOWN)}"
    )


def rank_after_flight(tower: str, score: ForecastScore) -> str:
    """Sentence on what a flight says of the ranks that were predicted before it."""
    return (
        f"Rank at {tower}, predicted before this flight: kappa {score.kappa:.2f} (0 is chance), log score "
        f"{score.log_score:.2f}; the mean of the prediction, without positions: {score.constant_log_score:.2f}."
    )
