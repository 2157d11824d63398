"""The sentences of a flight's report: what the numbers say, and the first screen with its four numbers."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np

from ..common.text import counted
from ..common.units import AnyArray, Printed
from ..compare.causes import FEWEST_SAMPLES
from ..compare.ladder import ModelRow
from ..compare.level import DetectionScore, ErrorSpan
from ..compare.receiver import ForecastScore
from ..compare.result import BASELINE_TITLE, AuditResult, FlightVerdict, RankResult, RssResult
from ..compare.statistics import FEWEST, Interval, paired_verdict
from ..compare.verdict import Verdict, baseline_errors, is_dead, is_one_place, lock_lost, pooled_db, scored
from .flight_data import ReportData


def filled(texts: Sequence[str], **facts: Any) -> list[str]:
    """Texts with numbers and names put in."""
    known = {name: Printed(fact) if isinstance(fact, float) else fact for name, fact in facts.items()}
    return [text.format_map(known) for text in texts]


def said_of(verdict: Verdict, table: Mapping[str, tuple[str, str]], **facts: Any) -> str:
    """Sentence and action that a page's table has for the cause of a verdict; nothing where the table has none."""
    if verdict.cause not in table:
        return ""
    low, high = verdict.interval
    numbers = {"effect": verdict.effect, "size": abs(verdict.effect), "low": low, "high": high}
    text, action = filled(table[verdict.cause], **numbers, where=verdict.where, **facts)
    return f"{text} Next: {action}." if action else text


# Name of the model with the settings of the flight file.
AS_SET = "as set in flight.yaml"


def pretty(name: str) -> str:
    """A baseline's name in words."""
    return BASELINE_TITLE.get(name, name.replace("_", " "))


def with_article(name: str) -> str:
    """A baseline's name inside a sentence."""
    return f"a {pretty(name)}" if name in ("constant", "log_distance") else pretty(name)


def count(n: int) -> str:
    """A whole number, thousands set apart as in the tables.

    Examples
    --------
    >>> count(6608) == "6\N{NARROW NO-BREAK SPACE}608"
    True
    """
    return f"{n:,}".replace(",", "\N{NARROW NO-BREAK SPACE}")


def signed(value: float) -> str:
    """A number with its sign, as in the tables.

    Examples
    --------
    >>> signed(12.91), signed(-10.4)
    ('+12.9', '−10.4')
    """
    return f"{Printed(value):+.1f}"


def _within(value: Interval, bound: str | None) -> str:
    low, high = value
    if not math.isfinite(low):
        return " (too few samples for an interval)"
    if not math.isfinite(high):
        return f" (95 %: at least {low:.1f} dB; {bound})"
    return f" (95 % interval {low:.1f} to {high:.1f})"


def headline(data: ReportData) -> str:
    """One paragraph: what was compared with what."""
    parts = []
    if data.rss:
        towers = list(dict.fromkeys(panel.tower for panel in data.rss))
        samples = sum(len(panel.time) for panel in data.rss)
        panels = counted(len(data.rss), "channel")
        parts.append(f"received signal strength at {_listed(towers)} ({panels}, {counted(samples, 'sample')})")
    if data.rank:
        samples = sum(len(panel.time) for panel in data.rank)
        parts.append(f"channel rank at {_listed([panel.tower for panel in data.rank])} ({counted(samples, 'sample')})")
    if not parts:
        return "This flight holds no radio measurement that could be compared; only its track and inputs are shown."
    engine = "" if data.engine is None else f" by the {data.engine.engine} engine"
    kind = "A synthetic" if data.synthetic else "The"
    return f"{kind} flight {data.flight} was replayed{engine} at {data.site.name} and compared: {' and '.join(parts)}."


# --- the first words -----------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class Judged:
    """Ray tracing against one baseline: pooled RMSE [dB], and on how many channels a paired interval decides.

    ``judged`` channels have an interval; on ``better`` and ``worse`` of them it excludes zero.
    """

    ray_db: float
    channels: int
    name: str = ""
    other_db: float = math.nan
    judged: int = 0
    better: int = 0
    worse: int = 0
    unit: str = "channels"


# What may follow the two errors, and when: the first whose condition holds. No other sentence says better or worse.
SIGNIFICANCE: tuple[tuple[Callable[[Judged], bool], str], ...] = (
    (lambda f: not f.name, "No baseline could be scored."),
    (lambda f: not f.judged, "The flight is too short to tell the two apart."),
    (lambda f: f.better > 0 and f.worse > 0,
     "Ray tracing is significantly better on {better} and worse{of} (95 %)."),
    (lambda f: f.worse > 0, "Ray tracing is significantly worse{of} (95 %)."),
    (lambda f: f.better > 0, "Ray tracing is significantly better{of} (95 %)."),
    (bool, "The difference is not significant{of} (95 %)."),
)  # fmt: skip

# Sentence on the ranking of settings, by what the intervals say of those behind the first.
RANKING: tuple[tuple[Callable[[set[str]], bool], str], ...] = (
    (lambda said: said == {"no interval"}, "Too few flights for an interval of the difference to another setting."),
    (lambda said: said == {"worse"}, "Every other setting is significantly worse (95 %)."),
    (bool, "Not significantly worse (95 %): {named}."),
)


def ranking_sentence(verdicts: Mapping[str, str], most: int) -> str:
    """Sentence on what the intervals say of the settings behind the first, by name; at most ``most`` are named."""
    alike = [name for name, word in verdicts.items() if word != "worse"]
    named = ", ".join(alike[:most]) + (f" and {len(alike) - most} more" if len(alike) > most else "")
    return next(text for holds, text in RANKING if holds(set(verdicts.values()))).format(named=named)


NOTHING_COMPARED = "Nothing could be compared: no sample has a measurement, a pose and a path at once."
TOO_FEW_COMPARED = "Nothing could be compared: no channel has 20 samples with measurement, pose and path (at most {n})."


def first_sentence(facts: Judged) -> str:
    """The two errors, and what the paired intervals allow to say.

    Examples
    --------
    >>> first_sentence(Judged(ray_db=6.72, channels=2, name="free_space", other_db=6.0, judged=2))
    'Ray tracing: RMSE 6.7 dB; free space: 6.0 dB. The difference is not significant on any of 2 channels (95 %).'
    """
    baseline = f"; {pretty(facts.name)}: {facts.other_db:.1f} dB" if facts.name else ""
    text = next(text for holds, text in SIGNIFICANCE if holds(facts))
    of = f" on {facts.worse or facts.better or 'any'} of {facts.channels} {facts.unit}"
    significance = text.format(better=facts.better, of="" if facts.channels == 1 else of)
    return f"Ray tracing: RMSE {facts.ray_db:.1f} dB{baseline}. {significance}"


# What the interval over all channels says: error, best baseline, interval. ``no interval`` has none.
_DECIDED = {
    "better": "Ray tracing (RMSE {ray}) is {size:.2f} dB better than {name} {ends}{over} (95 %).",
    "worse": "Ray tracing (RMSE {ray}) is {size:.2f} dB worse than {name} {ends}{over} (95 %).",
    "not significant": (
        "Ray tracing: RMSE {ray}; {name}: {other}. The difference {ends}{over} is not significant (95 %)."
    ),
    "equal": "Ray tracing (RMSE {ray}) and {name} differ by less than 0.01 dB{over} (95 %).",
    "no interval": "Ray tracing: RMSE {ray}; {name}: {other}. The flight is too short to tell the two apart.",
}


def flight_sentence(verdict: FlightVerdict, floor_db: float | None = None) -> str:
    """The error of ray tracing, and what the interval over all channels says of the best baseline.

    Examples
    --------
    >>> pooled = FlightVerdict(against="two_ray", rmse_db=2.0, baseline_rmse_db=2.2, difference_db=-0.23,
    ...     ci95_db=(-0.33, -0.14), channels=10)
    >>> flight_sentence(pooled)
    'Ray tracing (RMSE 2.0 dB) is 0.23 dB better than two-ray ground [0.14, 0.33] over 10 channels (95 %).'
    """
    near = max(map(abs, verdict.ci95_db)) < 0.005  # both ends would be printed as zero
    word = "equal" if near else paired_verdict(*verdict.ci95_db)
    ends = sorted(map(abs, verdict.ci95_db)) if word in ("better", "worse") else verdict.ci95_db
    name, over = with_article(verdict.against), f" over {verdict.channels} channels" if verdict.channels > 1 else ""
    floor = "" if floor_db is None else f", floor {Printed(floor_db):.0f}"
    signs = "+" if word == "not significant" else ""
    return _DECIDED[word].format(
        ray=f"{verdict.rmse_db:.1f} dB{floor}", other=f"{verdict.baseline_rmse_db:.1f} dB", over=over,
        name=name,
        size=abs(verdict.difference_db),
        ends=f"[{', '.join(format(Printed(end), f'{signs}.2f') for end in ends)}]",
    )  # fmt: skip


def expected_sentence(panels: Sequence[RssResult]) -> str:
    """The error to expect on another flight; nothing unless every scored channel has it from flights left out."""
    # a receiver that can lose its lock has the error with its floor, too, and that is its error
    given = [panel.further.elsewhere or {} for panel in panels]
    known = [entry.get("floor_rmse_db", entry.get("rmse_db", math.nan)) for entry in given]
    error = math.sqrt(sum(value**2 for value in known) / len(known)) if known else math.nan
    return f"Expect {error:.1f} dB on another flight." if math.isfinite(error) else ""


NO_CAUSE = "No likely cause was identified."
FEW_SAMPLES = "No cause can be identified in fewer than {n} samples."
TWO_LEVELS = "No cause can be identified: the log has two levels only."
ONE_PLACE = "No model predicts a change of 1 dB, as at one place: this flight tells no models apart."
BEYOND_SPAN = "No error can be given: the best offset lies beyond the searched span."
BEYOND = "The best offset of {name} lies beyond the searched span."


def instants(time: AnyArray, span: ErrorSpan) -> tuple[np.datetime64, np.datetime64]:
    """Begin and end of a span of a series that was sampled at these times (n,)."""
    first = time.min()
    begin, end = (first + np.timedelta64(round(seconds * 1e9), "ns") for seconds in (span.start_s, span.end_s))
    return begin, end


def audit_summary(audit: AuditResult) -> str:
    """The audit in a few sentences: the card, the page, the terminal and metrics.json have these words alone.

    Parameters
    ----------
    audit : AuditResult

    Returns
    -------
    str
    """
    fields = audit.fields
    texts = [f"Audit, {counted(audit.links, 'link')} against {audit.reference}: {audit_paths(audit)}."]
    if fields is not None:
        texts.append(
            f"Field: {counted(fields.paths, 'path')} against {audit.reference}'s own coefficients, worst "
            f"{fields.power_max_db:.2g} dB and {fields.phase_max_rad:.2g} rad."
        )
        texts.append(f"Checks failed: {count(len(fields.failures))}.")
    if audit.read_from_cache_of:
        day = audit.read_from_cache_of
        texts.append(f"Read from the cache of {day}, made of the same inputs; --audit makes it anew.")
    return " ".join(texts)


def audit_paths(audit: AuditResult) -> str:
    """Paths that one engine alone has, and the level that they make: half a sentence of the card and of the summary."""
    parts = [f"{counted(audit.missing_paths, 'path')} missing"]
    if audit.extra_paths:
        tested = audit.fields is not None and not audit.fields.phantom_paths
        parts.append(
            f"{count(audit.extra_paths)} only in our engine ({audit.reference} did not sample them"
            + ("; each passed a second test)" if tested else ")")
        )
    if math.isfinite(audit.rss_max_error_db):
        parts.append(f"RSS of the two engines within {audit.rss_max_error_db:.2g} dB")
    return ", ".join(parts)


# Outlying samples that move an RMSE by more than this [dB] are named.
_MOVED_DB = 0.3


def _listed(names: list[str]) -> str:
    return names[0] if len(names) == 1 else ", ".join(names[:-1]) + " and " + names[-1]


def verdicts(rss: Sequence[RssResult], rank: Sequence[RankResult]) -> list[str]:
    """One or two sentences per panel: how well the ray tracing predicts, and against what."""
    return [rss_verdict(panel) for panel in rss] + [rank_verdict(panel) for panel in rank]


def models_verdict(models: Sequence[ModelRow]) -> str:
    """Return the cross-validated errors of this replay and of the baselines, and the recommended model."""
    error = {row.model: row.rmse_heldout_db for row in models if math.isfinite(row.rmse_heldout_db)}
    best = next((row for row in models if row.recommended), None)
    if best is None:
        return ""
    compared = [f"{name} {error[name]:.1f} dB" for name in (AS_SET, *BASELINE_TITLE.values()) if name in error]
    least = min(error, key=lambda name: error[name])
    text = f"Cross-validated RMSE: {', '.join(compared)}."
    lines = BASELINE_TITLE["log_distance"], BASELINE_TITLE["constant"]
    if least in lines:
        text += f" The {least}, which traces no rays, has the smallest error of all models."
    fastest = next(row for row in models if row.fastest_sufficient)
    if fastest.model not in (least, *lines):
        text += (
            f" \u201c{fastest.model}\u201d ({fastest.seconds:.2g} s) is the fastest sufficient model: its difference "
            "to the best model is not significant."
        )
    if best.model == AS_SET:
        return f"{text} No model of the replay is significantly better, by 0.1 dB or more, than this flight file."
    how = "the simplest replay within one standard error of the best replay"
    if best.elsewhere_db is not None:
        how = "the best on other flights ({:.1f} dB, free space {:.1f} dB)".format(*best.elsewhere_db)
    return f"{text} Recommended: \u201c{best.model}\u201d, {how}: {error[best.model]:.1f} dB."


def training_sentence(names: Sequence[str], what: str) -> str:
    """First words of a report on a log that something was learned from: no error of it is a prediction's."""
    of = _listed(list(names)) if len(names) < 3 else f"{len(names)} channels"
    were = "was" if what == "the receiver" else "were"
    return (
        f"Training flight: {what} of {of} {were} learned from this flight's own log, so the tables show "
        "\u201c\u2013\u201d instead of an error."
    )


def _learned_from(digests: Sequence[str]) -> str:
    shown = ", ".join(f"{digest[:12]}..." for digest in digests[:3]) + (" and others" if len(digests) > 3 else "")
    return f" Learned from the logs with SHA-256 {shown}."


def rss_verdict(panel: RssResult) -> str:
    """Sentences on how well one channel is predicted, and whether the baselines do better."""
    if panel.training:
        return training_sentence([panel.name], "the antennas") + _learned_from(panel.further.trained_on or ())
    score = panel.score
    if score.n == 0 or not math.isfinite(score.rmse_db):
        return f"{panel.name}: nothing to score; {counted(len(panel.time), 'sample')} out of coverage on one side."
    text = (
        f"{panel.name}: RMSE of ray tracing {score.rmse_db:.1f} dB"
        f"{_within(score.rmse_ci95_db, panel.further.rmse_bound)} "
        f"after an offset of {signed(score.offset_db)} dB"
    )
    errors = {name: model.rmse_db for name, model in panel.baselines.items() if math.isfinite(model.rmse_db)}
    if not errors:
        return text + "."
    best = min(errors, key=lambda name: errors[name])
    paired = panel.further.compared_with.get(best)
    if paired is not None:
        text += ": " + paired.in_words(pretty(best))
    notes = "".join(f" {note}" for note in panel.further.interval_notes or ())
    return f"{text}; {pretty(best)}: {errors[best]:.1f} dB.{_detection_words(panel)}{_snr_words(panel)}{notes}"


def _detection_words(panel: RssResult) -> str:
    """Sentences added for a receiver that loses its lock or ends at a floor: both parts of its score."""
    score = panel.further.detection
    if score is None:
        return ""
    floor = f"{Printed(score.floor_db):.0f}"
    return (
        f" The receiver detected the signal in {100 * score.n_detected / score.n:.0f} % of "
        f"{counted(score.n, 'sample')}: the Brier score is {score.brier:.2f} by the predicted level "
        f"({learned_on(score)}), {score.constant_brier:.2f} by "
        f"that share alone. With lower levels counted as {floor}: RMSE {score.rmse_db:.1f} dB (free space: "
        f"{score.free_space_rmse_db:.1f} dB)."
    )


def learned_on(score: DetectionScore) -> str:
    """Origin of a probability of detection, in words."""
    return {
        "other flights": "learned on other flights",
        "held-out segments": "learned in other segments of this flight",
    }[score.learned_on]


def _snr_words(panel: RssResult) -> str:
    """Sentence added for a ratio to the noise: its error with nothing fitted."""
    snr = panel.further.snr
    if snr is None:
        return ""
    return (
        f" As a signal-to-noise ratio over {snr.noise_dbm:.1f} dBm of noise, nothing fitted, it is "
        f"{signed(snr.mean_error_db)} dB from the replay in the mean ({snr.rmse_db:.1f} dB RMSE)."
    )


def rank_verdict(panel: RankResult) -> str:
    """Sentence on the K that comes nearest to the modem, and how near."""
    k = nearest_k(panel)
    if k is None:
        return f"{panel.tower} rank: nothing to score; no sample has both a reported rank and a simulated one."
    best, logs = panel.score.simulated[k], panel.further.trained_on
    learned = f" {training_sentence([panel.tower], 'the receiver')}{_learned_from(logs)}" if logs else ""
    agree = f" and agrees pose by pose in {100 * best.agreement:.0f} %" if math.isfinite(best.agreement) else ""
    kappa = f" (kappa {best.kappa:.2f}; 0 is chance{_kappa_references(panel)})" if math.isfinite(best.kappa) else ""
    return (
        f"{panel.tower} rank: of the K shown, K = {k:.10g} comes nearest to the reported distribution "
        f"(total variation {best.total_variation:.2f}){agree}{kappa}.{_ground_error(panel, k)}{learned}"
    )


def _ground_error(panel: RankResult, k: float) -> str:
    """Sentence on how far the agreement hangs on a ground that is known at points alone."""
    sd = (panel.further.agreement_sd_by_ground or {}).get(f"{k:g}")
    if sd is None:
        return ""
    return (
        f" Grounds within the errors of the known heights change the agreement by +-{100 * sd:.0f} percentage points "
        "(one standard deviation): smaller differences say nothing."
    )


def nearest_k(panel: RankResult) -> float | None:
    """The K whose distribution comes nearest to the reported one; None where nothing could be scored."""
    distance = {
        k: fit.total_variation for k, fit in panel.score.simulated.items() if math.isfinite(fit.total_variation)
    }
    return min(distance, key=lambda k: distance[k], default=None)


def _kappa_references(panel: RankResult) -> str:
    """Agreement that needs no model, and the one that the modem's agreement with itself allows, in words."""
    words = ""
    commonest = panel.further.commonest
    if commonest.rank:
        words += f"; always saying {commonest.rank} would agree in {100 * commonest.agreement:.0f} %"
    repeat = panel.further.repeat.get("same_heading") or panel.further.repeat.get("any_heading")
    if repeat is not None and repeat.n and math.isfinite(repeat.kappa):
        words += f"; the modem repeats itself at the same places to kappa {repeat.kappa:.2f}"
    return words


def cautions(data: ReportData) -> list[str]:
    """Sentences to be known before a number is believed: the list under the first paragraph, gravest first."""
    texts = [*data.cautions]
    audit = None if data.engine is None else data.engine.audit
    if audit is not None and audit.fields is not None and audit.fields.failed:
        texts.append(
            "The audit of the field failed, so no level or rank below can be relied on: "
            + "; ".join(audit.fields.failures[:3])
            + (f"; and {audit.fields.failed - 3} more" if audit.fields.failed > 3 else "")
            + "."
        )
    if data.synthetic:
        texts.append("The logs are synthetic: they were made by simulation to show the tool, and measure nothing.")
    texts += [f"{text}." for text in data.doubts]
    for panel in data.rss:
        texts += _rss_cautions(panel)
    texts += [
        f"{panel.name} stays within 1 dB, whatever is predicted: it does not count in the first sentence."
        for panel in data.rss
        if is_dead(panel) and not all(map(is_dead, data.rss))
    ]
    texts += [
        f"{panel.name} and {copy.name} hold the same levels: they are one measurement."
        for panel, copy in combinations(data.rss, 2)
        if panel.score.n and np.array_equal(panel.measured_db, copy.measured_db, equal_nan=True)
    ]
    if data.engine is not None and audit is None:
        why = data.engine.not_audited
        texts.append(
            f"Not audited against Sionna RT: {why}" if why else "The replay was not audited against the other engine."
        )
    if audit is not None and audit.missing_paths:
        texts.append(audit_summary(audit))
    texts += data.warnings
    rejected = sum(f.rejected for f in data.inputs)
    if rejected:
        texts.append(f"{counted(rejected, 'log line was', 'log lines were')} rejected; see the account of the inputs.")
    return list(dict.fromkeys(texts))


# Closer to the tower's antenna than this a level cannot be compared [m]: the far field of an array of 0.7 m begins at
# 11 m (2 D^2 / lambda at 3.3 GHz), and a GPS error of 3 m changes the level of free space by more than 2 dB.
_NEAR_M = 10.0


def _rss_cautions(panel: RssResult) -> list[str]:
    texts, score, lock, further = [], panel.score, lock_lost(panel), panel.further
    compared = panel.geometry["distance_m"][panel.posed & np.isfinite(panel.measured_db)]
    if (near := int((compared < _NEAR_M).sum())) > 0:
        texts.append(
            f"{panel.name}: {near} of {counted(len(compared), 'sample')} lie within {_NEAR_M:g} m of the tower's "
            f"antenna, the nearest at {np.nanmin(compared):.1f} m: too near. In the near field free space does not "
            "hold, and position errors change the level by several dB. Check the tower's position and antenna_height_m."
        )
    if lock is not None:
        share, floor = 100 - 100 * lock.n_detected / lock.n, f"{Printed(lock.floor_db):.0f}"
        texts.append(
            f"{panel.name} lost its lock in {share:.0f} % of the samples; levels below {floor} {panel.unit} count as "
            f"{floor} in the first sentence, and as logged in the tables."
        )
    if 0 < score.n < FEWEST:
        texts.append(f"{panel.name}: only {counted(score.n, 'sample')} scored, too few for a verdict.")
    if score.n_out_of_coverage > 0.2 * len(panel.time):
        share = 100 * score.n_out_of_coverage / len(panel.time)
        texts.append(f"{panel.name}: {share:.0f} % of the samples are out of coverage and not part of the RMSE.")
    if score.rmse_db - further.rmse_without_outliers_db > _MOVED_DB:  # NaN moves nothing
        without = counted(further.n_outliers, "outlier")
        texts.append(f"{panel.name}: RMSE {further.rmse_without_outliers_db:.1f} dB without {without}.")
    return texts


# Offsets of at least this size, or below zero, are explained [dB].
_LARGE_OFFSET_DB = 20.0

# Reason of such an offset, by the unit of the log.
OFFSETS = {
    "dB re full scale": "the log is relative to full scale, and the offset turns it into dBm",
    "dB": "the log is a ratio to the noise, and the offset holds the level of that noise",
    "dBm": "the transmit power, gains or losses of the settings are not those of the flight; RSRP is the level of one "
    "subcarrier alone",
}


def offset_sentences(panels: Sequence[RssResult]) -> list[str]:
    """Reason of negative and of large offsets, a sentence for each unit of the logs.

    Examples
    --------
    >>> offset_sentences([])
    []
    """
    known: dict[str, list[float]] = {}
    for panel in scored(panels):
        if panel.score.offset_db < 0.0 or panel.score.offset_db >= _LARGE_OFFSET_DB:
            known.setdefault(panel.unit, []).append(panel.score.offset_db)
    return [
        f"Offset {' to '.join(dict.fromkeys(signed(end) for end in (min(of), max(of))))} dB: {OFFSETS[unit]}."
        for unit, of in known.items() if unit in OFFSETS
    ]  # fmt: skip


NO_INTERVAL = "no interval can be given"


@dataclass(frozen=True, slots=True, kw_only=True)
class Headline:
    """One number of the first screen: what it is, its value with unit, its interval or range, its reference."""

    label: str
    value: str
    interval: str
    reference: str


# Words of a first paragraph at most.
MOST_WORDS = 60


def paragraph(data: ReportData) -> str:
    """First words: error and best baseline, the error on another flight, one cause, one next step.

    Page, terminal and metrics.json have them alike; cautions (:func:`.flight.cautions`) are a list of their own.
    """
    panels = scored(data.rss)
    error = _level_sentence(data.verdict, panels) if panels else _rank_sentence(data.rank)
    advice = "" if data.next_step is None else f"Next: {data.next_step}."
    if learned := _training(data):
        other = error if panels or not data.rss else _baseline_sentence(data.rss)
        parts = [learned, other, expected_sentence(data.rss), advice]
    elif error and data.against is not None and data.against.scores:
        parts = [error, before_flight(data.against.scores), advice]
    elif error:
        none = _without_cause(data.verdict, panels) if panels else ""
        # the step of such a flight is a wider span, whatever its cause
        beyond = next((BEYOND.format(name=p.name) for p in data.rss if p.score.at_edge), "")
        cause = beyond or data.cause or none
        parts = [error, expected_sentence(panels), cause, advice]
    elif any(panel.score.at_edge for panel in data.rss):
        parts = [BEYOND_SPAN, advice]
    else:
        most = max([panel.score.n for panel in data.rss], default=0)
        none = TOO_FEW_COMPARED.format(n=most) if most else NOTHING_COMPARED
        parts = [none, data.cause or "", advice if data.cause else ""]
    return " ".join(part for part in parts if part)


def _level_sentence(pooled: FlightVerdict | None, panels: Sequence[RssResult]) -> str:
    if pooled is None:
        return f"Ray tracing: RMSE {_pooled(panels):.1f} dB. No baseline could be scored."
    return flight_sentence(pooled, next((lock.floor_db for p in panels if (lock := lock_lost(p))), None))


# After an error of so few decibels a sentence on its cause reads like a fault.
_SMALL_ERROR_DB = 3.0


def _without_cause(pooled: FlightVerdict | None, panels: Sequence[RssResult]) -> str:
    """Return the sentence of a flight without a likely cause; none after a good result."""
    if is_one_place(panels):
        return ONE_PLACE
    good = pooled is not None and (pooled.rmse_db <= _SMALL_ERROR_DB or pooled.ci95_db[1] < 0.0)
    if good or expected_sentence(panels):  # the error is that of other flights
        return ""
    if max(panel.score.n for panel in panels) < FEWEST_SAMPLES:
        return FEW_SAMPLES.format(n=FEWEST_SAMPLES)
    levels = [np.unique(panel.measured_db[np.isfinite(panel.measured_db)]) for panel in panels]
    return TWO_LEVELS if all(len(of) == 2 for of in levels) else NO_CAUSE


def _training(data: ReportData) -> str:
    """The sentence of a training flight; nothing where nothing was learned from the logs of this one."""
    for panels, what in ((data.rss, "the antennas"), (data.rank, "the receiver")):
        learned = [panel for panel in panels if panel.further.trained_on]
        if learned:
            names = [panel.name if isinstance(panel, RssResult) else panel.tower for panel in learned]
            return training_sentence(names, what)
    return ""


def _baseline_sentence(panels: Sequence[RssResult]) -> str:
    """Sentence on what a model without anything learned leaves on the panels of a training flight."""
    errors = baseline_errors([panel for panel in panels if panel.training])
    if not errors:
        return ""
    best = min(errors, key=errors.__getitem__)
    return f"For comparison, {with_article(best)}: RMSE {errors[best]:.1f} dB."


def _pooled(panels: Sequence[RssResult]) -> float:
    """RMSE of the ray tracing over all samples of several series [dB]."""
    return pooled_db([p.score.rmse_db for p in panels], [p.score.n for p in panels])


def judge(
    scored: Sequence[tuple[float, int]],
    baselines_db: Mapping[str, float],
    verdicts: Sequence[Mapping[str, str]],
    unit: str = "channels",
) -> Judged:
    """Ray tracing against the baseline that matters most: the best of those that it loses to, else the best of all.

    Parameters
    ----------
    scored : sequence of (float, int)
        RMSE [dB] and samples of each series.
    baselines_db : mapping of str to float
        Pooled RMSE of each baseline that all series have [dB].
    verdicts : sequence of mapping
        By baseline, what the paired interval of a series says.
    unit : str
        What a series is, in words.

    Returns
    -------
    Judged
    """
    total, count_of = pooled_db(*map(list, zip(*scored, strict=True))), len(scored)
    every = []
    for name, error in baselines_db.items():
        decided = [row[name] for row in verdicts if row.get(name, "no interval") != "no interval"]
        every.append(Judged(ray_db=total, channels=count_of, name=name, other_db=error, judged=len(decided),
                            better=decided.count("better"), worse=decided.count("worse"), unit=unit))  # fmt: skip
    return _most_telling(every) if every else Judged(ray_db=total, channels=count_of, unit=unit)


def _most_telling(every: Sequence[Judged]) -> Judged:
    """The comparison to be said first: the best baseline that ray tracing loses to, else the best one."""
    lost = [entry for entry in every if entry.worse > entry.better]
    return min(lost or every, key=lambda comparison: comparison.other_db)


def _forecast_of(panel: RankResult) -> ForecastScore | None:
    """Score of the fitted receiver's forecast of the rank, where there is one."""
    score = panel.further.receiver
    known = score is not None and math.isfinite(score.kappa) and math.isfinite(score.log_score_gain)
    return score if known else None


def _forecast_sentence(panel: RankResult, score: ForecastScore) -> str:
    return (
        f"Rank at {panel.tower} by the receiver learned on other flights: kappa {score.kappa:.2f} (0 is chance), "
        f"{_log_score(score)}. It agrees in {100 * score.agreement:.0f} % of samples; always guessing the commonest "
        f"agrees in {100 * score.majority_agreement:.0f} %."
    )


def _log_score(score: ForecastScore) -> str:
    side = "below" if score.log_score_gain > 0 else "above"
    return f"log score {abs(100 * score.log_score_gain):.0f} % {side} the constant forecast"


def _forecast_card(panel: RankResult, score: ForecastScore) -> Headline:
    return Headline(
        label=f"Rank forecast at {panel.tower}",
        value=f"kappa {score.kappa:.2f}",
        interval=_interval(score.kappa_ci95, ".2f"),
        reference=_log_score(score),
    )


def _rank_sentence(panels: Sequence[RankResult]) -> str:
    for panel in panels:
        if score := _forecast_of(panel):
            return _forecast_sentence(panel, score)
        k = nearest_k(panel)
        if k is not None:
            at, commonest = panel.score.simulated[k], panel.further.commonest
            guess = (
                f"; always guessing {commonest.rank} agrees in {100 * commonest.agreement:.0f} %"
                if commonest.rank else ""
            )  # fmt: skip
            agree = f" Per position they agree in {100 * at.agreement:.0f} % of samples{guess}."
            return (
                f"Rank at {panel.tower} (K = {k:.10g}, best of {len(panel.score.simulated)} thresholds): predicted and "
                f"reported shares differ by {points(at.total_variation)} in all."
                + (agree if math.isfinite(at.agreement) else "")
            )
    return ""


def headlines(data: ReportData) -> list[Headline]:
    """At most four numbers, each with its interval and what it must be held against."""
    lines = []
    panels = scored(data.rss)
    if panels:
        lines += [_error(panels, data.verdict), *_difference(data.verdict)]
    for panel in data.rank:
        score, k = _forecast_of(panel), nearest_k(panel)
        if score is not None:
            lines.append(_forecast_card(panel, score))
            break
        if k is not None:
            lines.append(_rank(panel, k))
            break
    audit = None if data.engine is None else data.engine.audit
    if audit is not None:
        lines.append(_audit(audit))
    return lines[:4]


def _audit(audit: AuditResult) -> Headline:
    """Failed checks of the audit; paths that the other engine did not sample are no fault of ours."""
    fields = audit.fields
    extent = f"{counted(audit.links, 'link')} against {audit.reference}"
    if fields is None:
        value = f"{counted(audit.missing_paths, 'path')} missing"
    else:
        value = f"{count(len(fields.failures))} failed"
    return Headline(label="Audit", value=value, interval=audit_paths(audit), reference=extent)


def _error(panels: Sequence[RssResult], pooled: FlightVerdict | None) -> Headline:
    total = _pooled(panels) if pooled is None else pooled.rmse_db
    best = "no baseline" if pooled is None else f"{pretty(pooled.against)}: {pooled.baseline_rmse_db:.1f} dB"
    floor = ", lower levels as the floor" if any(map(lock_lost, panels)) else ""
    return Headline(
        label=f"RMSE of the level{f', {len(panels)} channels' if len(panels) > 1 else ''}{floor}",
        value=f"{total:.1f} dB",
        interval="" if floor else _ends(panels),
        reference=best,
    )


def _interval(ends: Interval, form: str, unit: str = "") -> str:
    if not math.isfinite(ends[0]):
        return NO_INTERVAL
    if not math.isfinite(ends[1]):
        return f"95 %: at least {format(ends[0], form)}{unit}"
    return "95 %: " + " to ".join(format(Printed(end), form) for end in ends) + unit


def _ends(panels: Sequence[RssResult]) -> str:
    if len(panels) == 1:
        return _interval(panels[0].score.rmse_ci95_db, ".1f", " dB")
    errors = [panel.score.rmse_db for panel in panels]
    return f"channels: {min(errors):.1f} to {max(errors):.1f} dB"


def _difference(pooled: FlightVerdict | None) -> list[Headline]:
    if pooled is None:
        return []
    return [
        Headline(
            label=f"Against {pretty(pooled.against)}, same samples",
            value=f"{Printed(pooled.difference_db):+.2f} dB",
            interval=_interval(pooled.ci95_db, "+.2f", " dB"),
            reference="negative: smaller error of ray tracing",
        )
    ]


def _rank(panel: RankResult, k: float) -> Headline:
    at, commonest = panel.score.simulated[k], panel.further.commonest
    low, high = at.total_variation_ci95
    known = math.isfinite(low) and math.isfinite(high)
    agree = f"agreement {100 * at.agreement:.0f} %" if math.isfinite(at.agreement) else "no pose in common"
    return Headline(
        label=f"Rank at {panel.tower}, K = {k:.10g}",
        value=points(at.total_variation),
        interval="between predicted and reported shares"
        + (f" (95 %: {100 * low:.0f} to {100 * high:.0f})" if known else ""),
        reference=f"{agree}; always saying {commonest.rank}: {100 * commonest.agreement:.0f} %"
        if commonest.rank
        else agree,
    )


def points(share: float) -> str:
    """A difference of shares in whole percentage points.

    Examples
    --------
    >>> points(0.012), points(0.18)
    ('1 percentage point', '18 percentage points')
    """
    return counted(round(100 * share), "percentage point")


def before_flight(scores: Mapping[str, Mapping[str, float]]) -> str:
    """Sentence of a report's first paragraph on the prediction made before the flight; nothing without levels."""
    if not scores:
        return ""
    error, inside = (float(np.mean([row[key] for row in scores.values()])) for key in ("rmse_db", "coverage_90"))
    return (
        f"Predicted before this flight: RMSE {error:.1f} dB; the 90 % band holds {100 * inside:.0f} % of the samples."
    )
