"""Sentences of a flight's report, and the numbers of its first screen."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np

from ..common.grouping import lists_by_key
from ..common.text import counted
from ..common.units import AnyArray, Printed
from ..compare.evidence import FEWEST_SAMPLES
from ..compare.ladder import ModelRow
from ..compare.level import DetectionScore, ErrorSpan
from ..compare.receiver import ForecastScore
from ..compare.result import BASELINE_TITLE, AuditResult, FlightVerdict, RankResult, RssResult
from ..compare.statistics import FEWEST, Interval, is_stuck, paired_verdict
from ..compare.verdict import Verdict, baseline_errors, is_dead, is_one_place, lock_lost, pooled_db, scored
from .flight_data import ReportData


def filled(texts: Sequence[str], **facts: Any) -> list[str]:
    """Return texts with numbers and names filled in."""
    known = {name: Printed(fact) if isinstance(fact, float) else fact for name, fact in facts.items()}
    return [text.format_map(known) for text in texts]


def sentence_of(verdict: Verdict, table: Mapping[str, tuple[str, str]], **facts: Any) -> str:
    """Return sentence and next step from a table by the cause of a verdict. Empty if the table has no such cause."""
    if verdict.cause not in table:
        return ""
    low, high = verdict.interval
    numbers = {"effect": verdict.effect, "size": abs(verdict.effect), "low": low, "high": high}
    text, action = filled(table[verdict.cause], **numbers, where=verdict.where, **facts)
    return f"{text} Next: {action}." if action else text


NO_INTERVAL = "no interval"
# Name of the model with the settings of the flight file.
AS_SET = "as set in flight.yaml"


def pretty(name: str) -> str:
    """Return the title of a baseline."""
    return BASELINE_TITLE.get(name, name.replace("_", " "))


def with_article(name: str) -> str:
    """Return the title of a baseline for use inside a sentence."""
    return f"a {pretty(name)}" if name in ("constant", "log_distance") else pretty(name)


def count(n: int) -> str:
    """Return an integer with a separator of thousands, as in the tables.

    Examples
    --------
    >>> count(6608) == "6\N{NARROW NO-BREAK SPACE}608"
    True
    """
    return f"{n:,}".replace(",", "\N{NARROW NO-BREAK SPACE}")


def signed(value: float) -> str:
    """Return a number with its sign, as in the tables.

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


# Explanation of the columns of a table of ranks.
RANK_WORDS = (
    "A singular value of the channel matrix counts towards the rank if it is greater than the largest one divided by "
    "K. Agreement is the share of samples with the same rank. Kappa is the agreement beyond chance: 1 is perfect, and "
    "0 is chance. Total variation is the distance between the shares of reported and simulated ranks, from 0 to 1."
)


# --- summary -----------------------------------------------------------------------------------------------------


def ranking_sentence(verdicts: Mapping[str, str], most: int) -> str:
    """Return the sentence about the settings that are not significantly worse than the best setting.

    ``verdicts`` has the verdict of the paired interval of each other setting. At most ``most`` settings are named.
    """
    if set(verdicts.values()) == {NO_INTERVAL}:
        return "Too few flights for an interval of the difference from another setting."
    alike = [name for name, word in verdicts.items() if word != "worse"]
    if not alike:
        return "Every other setting is significantly worse (95 %)."
    named = ", ".join(alike[:most]) + (f" and {len(alike) - most} more" if len(alike) > most else "")
    return f"Not significantly worse (95 %): {named}."


NOTHING_COMPARED = "Nothing could be compared: no sample has a measurement, a pose and a path."
TOO_FEW_COMPARED = "Nothing could be compared: no channel has 20 samples with measurement, pose and path (at most {n})."


def first_sentence(
    scored: Sequence[tuple[float, int]], baselines_db: Mapping[str, float], verdicts: Sequence[Mapping[str, str]]
) -> str:
    """Return the sentence about the error of ray tracing and of one baseline in all flights of a campaign.

    The sentence names the best of the baselines that are significantly better than ray tracing on more channels than
    worse. If there are none, it names the best of all baselines.

    Parameters
    ----------
    scored : sequence of (float, int)
        RMSE [dB] and samples of each channel of each flight.
    baselines_db : mapping of str to float
        Pooled RMSE of each baseline that all channels have [dB].
    verdicts : sequence of mapping
        Verdict of the paired interval of each channel, by baseline.

    Returns
    -------
    str
        One or two sentences.

    Examples
    --------
    >>> first_sentence([(6.72, 9)], {"free_space": 6.0}, [{"free_space": "not significant"}])
    'Ray tracing: RMSE 6.7 dB; free space: 6.0 dB. The difference is not significant (95 %).'
    >>> first_sentence([(6.72, 9)] * 3, {"free_space": 6.0}, [{}] * 3).partition(". ")[2]
    'There is no interval of the difference, because no flight has enough independent samples.'
    """
    error = f"Ray tracing: RMSE {pooled_db(*map(list, zip(*scored, strict=True))):.1f} dB"
    if not baselines_db:
        return f"{error}. No baseline could be scored."
    counts = {name: Counter(row.get(name, NO_INTERVAL) for row in verdicts) for name in baselines_db}
    lost = [name for name, of in counts.items() if of["worse"] > of["better"]]
    name = min(lost or baselines_db, key=lambda baseline: baselines_db[baseline])
    better, worse, undecided = (counts[name][verdict] for verdict in ("better", "worse", NO_INTERVAL))
    of = "" if len(scored) == 1 else f" on {worse or better or 'any'} of {len(scored)} channels of the flights"
    if undecided == len(verdicts):
        significance = "There is no interval of the difference, because no flight has enough independent samples."
    elif not better and not worse:
        significance = f"The difference is not significant{of} (95 %)."
    else:
        side = f"better on {better} and worse" if better and worse else "better" if better else "worse"
        significance = f"Ray tracing is significantly {side}{of} (95 %)."
    return f"{error}; {pretty(name)}: {baselines_db[name]:.1f} dB. {significance}"


# Sentences by the verdict over all channels, with error, best baseline and interval.
_DECIDED = {
    "better": "Ray tracing (RMSE {ray}) is {size:.2f} dB better than {name} {ends}{over} (95 %).",
    "worse": "Ray tracing (RMSE {ray}) is {size:.2f} dB worse than {name} {ends}{over} (95 %).",
    "not significant": (
        "Ray tracing: RMSE {ray}; {name}: {other}. The difference {ends}{over} is not significant (95 %)."
    ),
    "equal": "Ray tracing (RMSE {ray}) and {name} differ by less than 0.01 dB{over} (95 %).",
    "no interval": "Ray tracing: RMSE {ray}; {name}: {other}. The flight is too short to distinguish them.",
}


def flight_sentence(verdict: FlightVerdict, floor_db: float | None = None) -> str:
    """Return the error of ray tracing and its comparison with the best baseline over all channels.

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
    floor = "" if floor_db is None else f", floor {Printed(floor_db):.0f} dB"
    signs = "+" if word == "not significant" else ""
    return _DECIDED[word].format(
        ray=f"{verdict.rmse_db:.1f} dB{floor}", other=f"{verdict.baseline_rmse_db:.1f} dB", over=over,
        name=name,
        size=abs(verdict.difference_db),
        ends=f"[{', '.join(format(Printed(end), f'{signs}.2f') for end in ends)}]",
    )  # fmt: skip


def expected_sentence(panels: Sequence[RssResult]) -> str:
    """Return the expected error on another flight of this kind, if all channels have scores of held-out flights."""
    # for a receiver that can lose its lock, use the error of all samples, including levels at its floor
    given = [panel.further.elsewhere or {} for panel in panels]
    known = [entry.get("floor_rmse_db", entry.get("rmse_db", math.nan)) for entry in given]
    error = math.sqrt(sum(value**2 for value in known) / len(known)) if known else math.nan
    kind = next((entry["kind"] for entry in given if "floor_rmse_db" not in entry and "kind" in entry), "")
    return f"Expect {error:.1f} dB {kind or 'on another flight'}." if math.isfinite(error) else ""


NO_CAUSE = "No likely cause was identified."
FEW_SAMPLES = "No cause can be identified in fewer than {n} samples."
NO_MODELS = f"No models are compared: fewer than {FEWEST} samples have a measurement, a pose and a path in every model."
TWO_LEVELS = "No cause can be identified: the log has no more than two different levels."
ONE_PLACE = "No model predicts a change of 1 dB during this flight, so models cannot be distinguished."
BEYOND_SPAN = "There is no error to report: the best offset is outside its search range."
BEYOND = "The best offset of {name} is outside its search range."


def instants(time: AnyArray, span: ErrorSpan) -> tuple[np.datetime64, np.datetime64]:
    """Return the start and end times of a segment. ``time`` (n,) contains the sample times of the series."""
    first = time.min()
    begin, end = (first + np.timedelta64(round(seconds * 1e9), "ns") for seconds in (span.start_s, span.end_s))
    return begin, end


def audit_summary(audit: AuditResult) -> str:
    """Return the summary of the audit for page, terminal and metrics.json.

    Parameters
    ----------
    audit : AuditResult

    Returns
    -------
    str
    """
    fields = audit.fields
    texts = [f"Audit of {counted(audit.links, 'link')} against {audit.reference}: {audit_paths(audit)}."]
    if fields is not None:
        texts.append(
            f"Field of {counted(fields.paths, 'path')} against the coefficients of {audit.reference}: largest "
            f"differences {fields.power_max_db:.2g} dB and {fields.phase_max_rad:.2g} rad."
        )
        texts.append(f"Checks failed: {count(len(fields.failures))}.")
    if audit.read_from_cache_of:
        day = audit.read_from_cache_of
        texts.append(f"Read from the cache of {day} for the same inputs; --audit computes it again.")
    return " ".join(texts)


def audit_paths(audit: AuditResult) -> str:
    """Return a clause about paths that only one engine found, and about their effect on the level."""
    parts = [f"{counted(audit.missing_paths, 'path')} missing"]
    if audit.extra_paths:
        tested = audit.fields is not None and not audit.fields.phantom_paths
        parts.append(
            f"{count(audit.extra_paths)} that {audit.reference} did not sample"
            + (" (each passed a second test)" if tested else "")
        )
    if math.isfinite(audit.rss_max_error_db):
        parts.append(f"RSS differs by at most {max(math.ceil(1e3 * audit.rss_max_error_db), 1) / 1e3:.3f} dB")
    return ", ".join(parts)


# Outliers are mentioned if they change an RMSE by more than this [dB].
_MOVED_DB = 0.3


def _listed(names: list[str]) -> str:
    return names[0] if len(names) == 1 else ", ".join(names[:-1]) + " and " + names[-1]


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
            "from the best model is not significant."
        )
    if best.model == AS_SET:
        return f"{text} No model of the replay is significantly better, by 0.1 dB or more, than this flight file."
    how = "the simplest replay within one standard error of the best replay"
    if best.elsewhere_db is not None:
        how = "the best on other flights ({:.1f} dB, free space {:.1f} dB)".format(*best.elsewhere_db)
    return f"{text} Recommended: \u201c{best.model}\u201d, {how}: {error[best.model]:.1f} dB."


def training_sentence(names: Sequence[str], what: str) -> str:
    """Return the summary of a report on a training log.

    The errors on a training log are smaller than the errors of a prediction.
    """
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
    """Return sentences about the error of one channel and the errors of the baselines on it."""
    if panel.training:
        return training_sentence([panel.name], "the antennas") + _learned_from(panel.further.trained_on or ())
    score = panel.score
    if score.n == 0 or not math.isfinite(score.rmse_db):
        return f"{panel.name}: nothing to score. {score.n} of {len(panel.time)} samples have level, pose and path."
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
    """Return sentences about the detection of a receiver that loses its lock or ends at a floor."""
    score = panel.further.detection
    if score is None:
        return ""
    floor = f"{Printed(score.floor_db):.0f}"
    return (
        f" The receiver detected the signal in {100 * score.n_detected / score.n:.0f} % of "
        f"{counted(score.n, 'sample')}. The Brier score of detection forecast from the predicted level is "
        f"{score.brier:.2f} ({learned_on(score)}), and {score.constant_brier:.2f} for the constant share. "
        f"With lower levels counted as {floor}: RMSE {score.rmse_db:.1f} dB (free space: "
        f"{score.free_space_rmse_db:.1f} dB)."
    )


def learned_on(score: DetectionScore) -> str:
    """Return the origin of a probability of detection as text."""
    return (
        "learned on other flights"
        if score.learned_on == "other flights"
        else "learned in other segments of this flight"
    )


def _snr_words(panel: RssResult) -> str:
    """Return the sentence about the error of a signal-to-noise ratio without a fitted offset, or an empty text."""
    snr = panel.further.snr
    if snr is None:
        return ""
    return (
        f" As a signal-to-noise ratio over {snr.noise_dbm:.1f} dBm of noise, without a fitted offset, its mean "
        f"difference from the replay is {signed(snr.mean_error_db)} dB (RMSE {snr.rmse_db:.1f} dB)."
    )


def nearest_k(panel: RankResult) -> float | None:
    """Return the K whose distribution is closest to the reported one, or None if nothing could be scored."""
    fits = panel.score.simulated
    scored_k = [k for k, fit in fits.items() if math.isfinite(fit.total_variation)]
    return min(scored_k, key=lambda k: fits[k].total_variation, default=None)


def rank_references(panel: RankResult) -> str:
    """Return the sentence about the agreement of a constant guess, and of the modem with itself, or an empty text."""
    commonest, parts = panel.further.commonest, []
    if commonest.rank:
        parts.append(f"always guessing {commonest.rank} agrees in {100 * commonest.agreement:.0f} %")
    repeat = panel.further.repeat.get("same_heading") or panel.further.repeat.get("any_heading")
    if repeat is not None and repeat.n and math.isfinite(repeat.kappa):
        parts.append(f"repeated visits of the modem at the same positions have kappa {repeat.kappa:.2f}")
    return f"For comparison at {panel.tower}: {'; '.join(parts)}." if parts else ""


def cautions(data: ReportData) -> list[str]:
    """Return warnings about the limits of the numbers, the most serious first."""
    texts = [*data.cautions]
    audit = None if data.engine is None else data.engine.audit
    if audit is not None and audit.fields is not None and audit.fields.failed:
        texts.append(
            "The audit of the field failed, so levels and ranks are not reliable: "
            + "; ".join(audit.fields.failures[:3])
            + (f"; and {audit.fields.failed - 3} more" if audit.fields.failed > 3 else "")
            + "."
        )
    if data.synthetic:
        texts.append("The logs are synthetic: they were simulated to demonstrate the tool, not measured.")
    texts += [f"{text}." for text in data.doubts]
    for panel in data.rss:
        texts += _rss_cautions(panel)
    texts += [
        f"{panel.name} varies by less than 1 dB, so the summary does not include it."
        for panel in data.rss
        if is_dead(panel) and not all(map(is_dead, data.rss))
    ]
    texts += [
        f"{panel.name} and {copy.name} have the same levels, so they count as one measurement."
        for panel, copy in combinations(data.rss, 2)
        if panel.score.n and np.array_equal(panel.measured_db, copy.measured_db, equal_nan=True)
    ]
    if data.engine is not None and audit is None:
        why = data.engine.not_audited
        texts.append(
            f"Not audited against Sionna RT: {why}" if why else "The replay was not audited against Sionna RT."
        )
    if audit is not None and audit.missing_paths:
        texts.append(audit_summary(audit))
    texts += data.warnings
    rejected = sum(f.rejected for f in data.inputs)
    if rejected:
        texts.append(f"{counted(rejected, 'log line was', 'log lines were')} rejected; see the table of inputs.")
    return list(dict.fromkeys(texts))


# Levels closer to the antenna of the tower than this cannot be compared [m]. The far field of an array of 0.7 m begins
# at 11 m (2 D^2 / lambda at 3.3 GHz), and a GPS error of 3 m changes the level of free space by more than 2 dB.
_NEAR_M = 10.0


def _rss_cautions(panel: RssResult) -> list[str]:
    texts, score, lock, further = [], panel.score, lock_lost(panel), panel.further
    compared = panel.geometry["distance_m"][panel.posed & np.isfinite(panel.measured_db)]
    if (near := int((compared < _NEAR_M).sum())) > 0:
        texts.append(
            f"{panel.name}: {near} of {counted(len(compared), 'sample')} are within {_NEAR_M:g} m of the antenna of "
            f"the tower, the nearest at {np.nanmin(compared):.1f} m. The free-space model is not valid in the near "
            "field, and position errors change the level by several dB. Check position and antenna_height_m of the "
            "tower."
        )
    if lock is not None:
        share, floor = 100 - 100 * lock.n_detected / lock.n, f"{Printed(lock.floor_db):.0f}"
        texts.append(
            f"{panel.name} lost its lock in {share:.0f} % of the samples; levels below {floor} {panel.unit} count as "
            f"{floor} in the summary, and as logged in the tables."
        )
    if 0 < score.n < FEWEST:
        texts.append(f"{panel.name}: only {counted(score.n, 'sample')} scored, too few for a verdict.")
    if score.n_out_of_coverage > 0.2 * len(panel.time):
        share = 100 * score.n_out_of_coverage / len(panel.time)
        texts.append(f"{panel.name}: {share:.0f} % of the samples are out of coverage and not included in the RMSE.")
    if score.rmse_db - further.rmse_without_outliers_db > _MOVED_DB:  # false for NaN
        without = counted(further.n_outliers, "outlier")
        texts.append(f"{panel.name}: RMSE {further.rmse_without_outliers_db:.1f} dB without {without}.")
    return texts


# Offsets of at least this size, or below zero, are explained [dB].
_LARGE_OFFSET_DB = 20.0

# Explanation of a large or negative offset, by the unit of the log.
OFFSETS = {
    "dB re full scale": "the log is relative to full scale, and the offset converts it to dBm",
    "dB": "the log is a signal-to-noise ratio, and the offset includes the noise level",
    "dBm": "the transmit power, gains or losses in flight.yaml are not those of the flight; note that RSRP is the "
    "level of one subcarrier",
}


def offset_sentences(panels: Sequence[RssResult]) -> list[str]:
    """Return sentences about the reasons of negative and large offsets, one for each unit.

    Examples
    --------
    >>> offset_sentences([])
    []
    """
    offsets = ((panel.unit, panel.score.offset_db) for panel in scored(panels))
    known = lists_by_key((unit, of) for unit, of in offsets if of < 0.0 or of >= _LARGE_OFFSET_DB)
    return [
        f"Offset {' to '.join(dict.fromkeys(signed(end) for end in (min(of), max(of))))} dB: {OFFSETS[unit]}."
        for unit, of in known.items()
        if unit in OFFSETS
    ]


@dataclass(frozen=True, slots=True, kw_only=True)
class Headline:
    """One number of the first screen, with its label, interval and reference."""

    label: str
    value: str
    interval: str
    reference: str


def paragraph(data: ReportData) -> str:
    """Return the summary: error and best baseline, expected error on another flight, one cause, one next step.

    Page, terminal and metrics.json have the same summary. Warnings (:func:`cautions`) are separate.
    """
    panels = scored(data.rss)
    error = _level_sentence(data.verdict, panels) if panels else _rank_sentence(data.rank)
    advice = "" if data.next_step is None else f"Next: {data.next_step}."
    if learned := _training(data):
        other = error if panels else _baseline_sentence(data.rss)
        parts = [learned, other, expected_sentence(data.rss), advice]
    elif error:
        none = _without_cause(data.verdict, panels) if panels else ""
        # the next step of such a flight is always a wider search range
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


# Below this RMSE there is no sentence about causes, because it would read like a failure.
_SMALL_ERROR_DB = 3.0


def _without_cause(pooled: FlightVerdict | None, panels: Sequence[RssResult]) -> str:
    """Return the sentence of a flight without a likely cause, which is empty after a good result."""
    if all(is_stuck(panel.measured_db) for panel in panels):
        return TWO_LEVELS  # also if the error is small
    if is_one_place(panels):
        return ONE_PLACE
    good = pooled is not None and (pooled.rmse_db <= _SMALL_ERROR_DB or pooled.ci95_db[1] < 0.0)
    if good or expected_sentence(panels):  # with an expected error on the page, a sentence about causes would mislead
        return ""
    few = max(panel.score.n for panel in panels) < FEWEST_SAMPLES
    return FEW_SAMPLES.format(n=FEWEST_SAMPLES) if few else NO_CAUSE


def _training(data: ReportData) -> str:
    """Return the sentence of a training flight. Empty if nothing was learned from its levels (or its ranks alone)."""
    for panels, what in ((data.rss, "the antennas"), ([] if data.rss else data.rank, "the receiver")):
        learned = [panel for panel in panels if panel.further.trained_on]
        if learned:
            names = [panel.name if isinstance(panel, RssResult) else panel.tower for panel in learned]
            return training_sentence(names, what)
    return ""


def _baseline_sentence(panels: Sequence[RssResult]) -> str:
    """Return the sentence about the error of the best baseline on a training flight."""
    errors = baseline_errors([panel for panel in panels if panel.training])
    best = min(errors, key=errors.__getitem__, default=None)
    return "" if best is None else f"For comparison, {with_article(best)}: RMSE {errors[best]:.1f} dB."


def _pooled(panels: Sequence[RssResult]) -> float:
    """Return the RMSE of ray tracing over all samples of several series [dB]."""
    return pooled_db([p.score.rmse_db for p in panels], [p.score.n for p in panels])


def _forecast_of(panel: RankResult) -> ForecastScore | None:
    """Return the score of the rank forecast by the fitted receiver, or None."""
    score = panel.further.receiver
    known = score is not None and math.isfinite(score.kappa) and math.isfinite(score.log_score_gain)
    return score if known else None


def _log_score(score: ForecastScore) -> str:
    side = "below" if score.log_score_gain > 0 else "above"
    return f"log score {abs(100 * score.log_score_gain):.0f} % {side} the constant forecast"


def _rank_sentence(panels: Sequence[RankResult]) -> str:
    for panel in panels:
        if score := _forecast_of(panel):
            return (
                f"Rank at {panel.tower} by the receiver learned on other flights: kappa {score.kappa:.2f} (0 is "
                f"chance), {_log_score(score)}. It agrees in {100 * score.agreement:.0f} % of samples; always guessing "
                f"the most frequent rank agrees in {100 * score.majority_agreement:.0f} %."
            )
        k = nearest_k(panel)
        if k is not None:
            at, commonest = panel.score.simulated[k], panel.further.commonest
            agreement = 100 * commonest.agreement
            guess = f"; always guessing {commonest.rank} agrees in {agreement:.0f} %" if commonest.rank else ""
            agree = f" Per position they agree in {100 * at.agreement:.0f} % of samples{guess}."
            return (
                f"Rank at {panel.tower} (K = {k:.10g}, best of {len(panel.score.simulated)} thresholds): the total "
                f"variation of predicted and reported shares is {at.total_variation:.2f} (0: equal, 1: disjoint)."
                + (agree if math.isfinite(at.agreement) else "")
            )
    return ""


def headlines(data: ReportData) -> list[Headline]:
    """Return at most four numbers, each with its interval and its reference."""
    panels = scored(data.rss)
    lines = [_error(panels, data.verdict), *_difference(data.verdict)] if panels else []
    lines += [card for panel in data.rank if (card := _rank(panel)) is not None][:1]
    if data.engine is not None and data.engine.audit is not None:
        lines.append(_audit(data.engine.audit))
    return lines[:4]


def _audit(audit: AuditResult) -> Headline:
    """Return the failed checks of the audit, which do not include paths that Sionna RT did not sample."""
    extent = f"{counted(audit.links, 'link')} against {audit.reference}"
    value = f"{counted(audit.missing_paths, 'path')} missing"
    if audit.fields is not None:
        value = f"{count(len(audit.fields.failures))} failed"
    return Headline(label="Audit", value=value, interval=audit_paths(audit), reference=extent)


def _error(panels: Sequence[RssResult], pooled: FlightVerdict | None) -> Headline:
    total = _pooled(panels) if pooled is None else pooled.rmse_db
    best = "no baseline" if pooled is None else f"{pretty(pooled.against)}: {pooled.baseline_rmse_db:.1f} dB"
    floor = ", clipped at the floor" if any(map(lock_lost, panels)) else ""
    channels = f", {len(panels)} channels" if len(panels) > 1 else ""
    return Headline(
        label=f"RMSE of the level{channels}{floor}", value=f"{total:.1f} dB",
        interval="" if floor else _ends(panels), reference=best,
    )  # fmt: skip


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
    return [Headline(
        label=f"Against {pretty(pooled.against)}, same samples", value=f"{Printed(pooled.difference_db):+.2f} dB",
        interval=_interval(pooled.ci95_db, "+.2f", " dB"), reference="negative: smaller error of ray tracing",
    )]  # fmt: skip


def _rank(panel: RankResult) -> Headline | None:
    """Return the card of the rank forecast, or else of the predicted shares. None if nothing could be scored."""
    if score := _forecast_of(panel):
        return Headline(
            label=f"Rank forecast at {panel.tower}, agreement beyond chance", value=f"kappa {score.kappa:.2f}",
            interval=_interval(score.kappa_ci95, ".2f"), reference=_log_score(score),
        )  # fmt: skip
    k = nearest_k(panel)
    if k is None:
        return None
    at, commonest = panel.score.simulated[k], panel.further.commonest
    low, high = at.total_variation_ci95
    ends = f", 95 %: {low:.2f} to {high:.2f}" if math.isfinite(low) and math.isfinite(high) else ""
    agree = f"agreement {100 * at.agreement:.0f} %" if math.isfinite(at.agreement) else "no pose in common"
    guess = f"; always guessing {commonest.rank}: {100 * commonest.agreement:.0f} %" if commonest.rank else ""
    return Headline(
        label=f"Rank at {panel.tower}, K = {k:.10g}", value=f"{at.total_variation:.2f}",
        interval=f"total variation (0 to 1){ends}", reference=f"{agree}{guess}",
    )  # fmt: skip
