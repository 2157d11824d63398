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
    "prior": "ray tracing with isotropic antennas, before any flight",
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
    "better": ("On {over} left out it is {size:.1f} dB better than free space [{near:.1f}, {far:.1f}] (95 %).", ""),
    "worse": ("On {over} left out it is {size:.1f} dB worse than free space [{near:.1f}, {far:.1f}] (95 %).", ""),
    "not significant": (
        "On {over} left out the difference from free space [{low:+.1f}, {high:+.1f}] is not significant (95 %).",
        "",
    ),
    "no interval": ("The flight is too short for an interval of the difference from free space.", ""),
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
    "none": ("", "`aerpaw-cmp predict` with this flight for the next route"),
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


EXPECTED = (
    "Expect an RMSE of {error:.1f} dB{over} at these points on a new flight ({heading}); 90 % of the samples "
    "lie within \u00b1{band:.1f} dB."
)
LOCK = "The receiver is in lock for {percent:.0f} % of them (P(lock) of each point: `p_lock` in prediction.csv)."
REMEMBERED = "No flight is named: antennas and levels are those that the site remembers."
OUTSIDE = {
    "flown": "{percent:.0f} % of the points lie outside the flown places.",
    "remembered": "{percent:.0f} % of the points lie in directions that the remembered flights hardly saw.",
}
PLAN = "Next: `aerpaw-cmp plan` names the flight that helps most."


def heading_words(yaw_deg: FloatArray) -> str:
    """Heading for which a prediction holds.

    Examples
    --------
    >>> heading_words(np.array([90.0, 90.0])), heading_words(np.array([0.0, 90.0])), heading_words(np.array([np.nan]))
    ('heading 90 degrees', 'headings of the route', 'heading open')
    """
    if not np.isfinite(yaw_deg).all():
        return "heading open"
    return "headings of the route" if np.ptp(yaw_deg) else f"heading {yaw_deg[0]:.0f} degrees"


def first_words(
    correction: Correction | None,
    outside: float,
    expected_db: float,
    band_db: float,
    heading: str = "heading open",
    lock: float | None = None,
    origin: str = REMEMBERED,
) -> str:
    """First paragraph of terminal, page and metrics.json: one error with its band, best baseline, one next step.

    Parameters
    ----------
    correction : Correction, optional
        None: the memory of the site is the source.
    outside : float
        Share of points outside the flown places, or in directions that flights hardly saw.
    expected_db : float
        Stated standard deviation of a mean over 4 s (of a sample, where a receiver loses its lock) on a new flight,
        root mean square over the points [dB].
    band_db : float
        Half of the 90 % interval of a sample, mean over the points [dB].
    heading : str
        As :func:`heading_words` has it.
    lock : float, optional
        Mean probability of lock, of a receiver that loses it.
    origin : str
        Sentence on what predicts, if there is no correction.

    Returns
    -------
    str
    """
    over = " over 4 s means" if lock is None else ""
    texts = filled([EXPECTED], error=expected_db, band=band_db, heading=heading, over=over)
    texts += [] if lock is None else filled([LOCK], percent=100.0 * lock)
    step = ""
    if correction is None:
        texts.append(origin)
    else:
        if ("free space", OFF) in correction.rmse_db and (correction.base, correction.title) != ("free space", OFF):
            verdict = _against_free_space(correction)
            near, far = sorted(map(abs, verdict.interval))
            over = "flights" if len(correction.flights) > 1 else "300 m blocks"
            texts.append(said_of(verdict, AGAINST_FREE_SPACE, over=over, near=near, far=far))
        step = _stated(correction).partition("Next: ")[2]
    texts.append(PLAN if outside > MANY else f"Next: {step}" if step else "")
    return " ".join(text for text in texts if text)


def cautions(correction: Correction, outside: float) -> list[str]:
    """Sentences under the first paragraph: places never flown, intervals on what was left out, model and field."""
    texts = filled([OUTSIDE["flown"]], percent=100.0 * outside) if outside > MANY else []
    texts += [_stated(correction).partition(" Next: ")[0], f"Model: {TITLES[correction.base]}."]
    return [text for text in (*texts, said_of(field(correction), FIELD)) if text]


def memory_cautions(known: Sequence[tuple[Entry, LearnedSeries]], outside: float) -> list[str]:
    """The same of a prediction without flights: what the site remembers, by entry."""
    each: dict[str, list[str]] = {}
    for entry, series in known:
        each.setdefault(entry.about(), []).append(f"{series.tower} {series.channel}")
    texts = filled([OUTSIDE["remembered"]], percent=100.0 * outside) if outside > MANY else []
    return [*texts, *(f"{', '.join(names)}: {about}." for about, names in each.items())]


def prior_words(carrier_hz: float, power_dbm: float) -> str:
    """Return the sentence on a prediction before any flight."""
    return (
        f"No flight is known: ray tracing with isotropic antennas, {carrier_hz / 1e9:g} GHz, {power_dbm:g} dBm "
        "transmitted. Next: fly once, then `aerpaw-cmp predict --with flight.yaml`."
    )


def prior_caution(offset_db: float, antennas_db: float, shadowing_db: float, fading_db: float) -> str:
    """Return the sentence on the parts of the standard deviation before any flight [dB]."""
    return (
        f"The standard deviation is a prior: offset {offset_db:g} dB, antennas {antennas_db:g} dB, shadowing "
        f"{shadowing_db:g} dB, fading {fading_db:g} dB. One flight determines the offset and most of the rest."
    )


def _stated(correction: Correction) -> str:
    """Sentence and step on the stated standard deviations on what was left out."""
    error, sd = correction.held_out[correction.base, correction.title]
    return said_of(stated_errors(error, sd), STATED, inside=100.0 * _inside_share(error, sd))


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
        f"{before_flight(scores)} Over 4 s {mean['rmse_4s_db']:.1f} dB, after the flight's own offset "
        f"{mean['own_offset_rmse_db']:.1f} dB. {said_of(worst, FLOWN).strip()}"
    )


def before_flight(scores: Mapping[str, Mapping[str, float]]) -> str:
    """Sentence of a report's first paragraph on the prediction made before the flight; nothing without levels."""
    if not scores:
        return ""
    error, inside = (float(np.mean([row[key] for row in scores.values()])) for key in ("rmse_db", "coverage_90"))
    return (
        f"Predicted before this flight: RMSE {error:.1f} dB; the 90 % band holds {100 * inside:.0f} % of the samples."
    )


def rank_after_flight(tower: str, score: ForecastScore) -> str:
    """Sentence on what a flight says of the ranks that were predicted before it."""
    return (
        f"Rank at {tower}, predicted before this flight: kappa {score.kappa:.2f} (0 is chance), log score "
        f"{score.log_score:.2f}; the mean of the prediction, without positions: {score.constant_log_score:.2f}."
    )
