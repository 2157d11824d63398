"""What the first screen of a report says: a verdict in two sentences, and up to four numbers beside their baselines."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..common.provenance import KEY, union
from ..compare.result import AuditResult
from .data import Baseline, RankAtK, RankPanel, ReportData, RssPanel
from .words import count, pretty, training_sentence

NO_INTERVAL = "no interval can be given"

LARGE_DB = 1.5
"""A channel whose RMSE is this much [dB] above the pooled one is named as where the prediction fails."""


LEAST_DB = 0.05
"""A smaller difference [dB] is none at the digits of the first sentence."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Headline:
    """One number of the first screen: what it is, its value with unit, its interval or range, what stands beside it."""

    label: str
    value: str
    interval: str
    beside: str


def verdict(data: ReportData) -> tuple[str, ...]:
    """Two sentences: how good against which baseline; where it fails, and whether to trust it."""
    scored = _scored(data.rss)
    first = _rss_sentence(scored) if scored else _rank_sentence(data.rank)
    if learned := _training(data):
        return learned, " ".join(part for part in (_baseline_sentence(data.rss), first, _trust(data)) if part)
    if not first:
        return ("Nothing could be compared: no sample has a measurement, a pose and a path at once.", _trust(data))
    return first, " ".join(part for part in (_fails(scored), _trust(data)) if part)


def _training(data: ReportData) -> str:
    """The sentence of a training flight; nothing where nothing was learned from the logs of this one."""
    for panels, what in ((data.rss, "the antennas"), (data.rank, "the receiver")):
        learned = [panel for panel in panels if panel.extra.get(KEY)]
        if learned:
            names = [panel.name if isinstance(panel, RssPanel) else panel.tower for panel in learned]
            return training_sentence(names, what, union(*(panel.extra[KEY] for panel in learned)))
    return ""


def _baseline_sentence(panels: Sequence[RssPanel]) -> str:
    """What a model without anything learned leaves on the panels of a training flight."""
    best = best_baseline([panel for panel in panels if panel.training])
    return "" if best is None else f"For comparison, {pretty(best[0])}: RMSE {best[1]:.1f} dB."


def _scored(panels: Sequence[RssPanel]) -> list[RssPanel]:
    return [panel for panel in panels if panel.n and math.isfinite(panel.rmse_db)]


def pooled_db(rmse_db: Sequence[float], n: Sequence[int]) -> float:
    """Root of the mean square error over all samples of several series, each after its own offset [dB]."""
    weight = np.asarray(n, dtype=np.float64)
    return float(np.sqrt((weight * np.asarray(rmse_db) ** 2).sum() / weight.sum()))


def best_baseline(panels: Sequence[RssPanel]) -> tuple[str, float] | None:
    """Name and pooled RMSE [dB] of the baseline that misses these series least; None without one that all have."""
    names = [b.name for b in panels[0].baselines] if panels else []
    errors = {}
    for name in names:
        own = [_baseline(panel, name) for panel in panels]
        known = [b.rmse_db for b in own if b is not None and math.isfinite(b.rmse_db)]
        if len(known) == len(panels):
            errors[name] = pooled_db(known, [panel.n for panel in panels])
    return min(errors.items(), key=lambda item: item[1]) if errors else None


def _baseline(panel: RssPanel, name: str) -> Baseline | None:
    return next((b for b in panel.baselines if b.name == name), None)


def _rss_sentence(panels: Sequence[RssPanel]) -> str:
    total = pooled_db([p.rmse_db for p in panels], [p.n for p in panels])
    best = best_baseline(panels)
    if best is None:
        return f"Ray tracing misses the measured level by {total:.1f} dB RMSE; no baseline could be scored."
    name, other = best
    words = [b.paired.verdict for p in panels if (b := _baseline(p, name)) is not None and b.paired is not None]
    better, worse = words.count("better"), words.count("worse")
    if len(panels) == 1:
        shown = {"better": "and the difference is shown", "worse": "and the difference is shown"}
        tail = f", {shown.get(words[0], 'no difference is shown')}" if words else ""
    else:
        tail = f"; it is shown to be better on {better} and worse on {worse} of {len(panels)} channels" if words else ""
    digits = _digits(total, other)
    if total - other >= LEAST_DB:
        return (
            f"Ray tracing is WORSE than {pretty(name)}: it misses the measured level by {total:.{digits}f} dB RMSE, "
            f"{pretty(name)} by {other:.{digits}f} dB{tail}."
        )
    gain = round(total, digits) - round(other, digits)
    beside = f"{gain:+.{digits}f}" if gain else f"{0.0:.{digits}f}"
    return (
        f"Ray tracing misses the measured level by {total:.{digits}f} dB RMSE, {beside} dB against "
        f"{pretty(name)} ({other:.{digits}f} dB){tail}.".replace("-", "−", 1)
    )


def _digits(total: float, other: float) -> int:
    """Digits with which two errors and their difference, each rounded, still add up: one where that will do."""
    return 1 if abs(round(total, 1) - round(other, 1) - (total - other)) < LEAST_DB else 2


def _rank_sentence(panels: Sequence[RankPanel]) -> str:
    for panel in panels:
        at = _best_k(panel)
        if at is not None:
            return (
                f"The distribution of the reported rank at {panel.tower} is missed by a total variation of "
                f"{at.total_variation:.2f} at K = {at.k:.10g}, with kappa {at.kappa:.2f} pose by pose (0 is chance)."
            )
    return ""


def _best_k(panel: RankPanel) -> RankAtK | None:
    scored = [at for at in panel.simulated if math.isfinite(at.total_variation)]
    return min(scored, key=lambda at: at.total_variation) if scored else None


def _fails(panels: Sequence[RssPanel]) -> str:
    """Where the error is largest."""
    if not panels:
        return ""
    worst = max(panels, key=lambda p: p.rmse_db)
    if len(panels) > 1 and worst.rmse_db > pooled_db([p.rmse_db for p in panels], [p.n for p in panels]) + LARGE_DB:
        return f"It fails most at {worst.name} ({worst.rmse_db:.1f} dB)."
    spans = [(panel, span) for panel in panels for span in panel.worst]
    if not spans:
        return ""
    panel, span = max(spans, key=lambda item: abs(item[1].mean_error_db))
    cause = f" ({span.cause})" if span.cause else ""
    return f"The largest error of a stretch, {span.mean_error_db:+.1f} dB at {panel.name}{cause}.".replace("-", "−", 1)


def _trust(data: ReportData) -> str:
    """Whether the numbers can be believed, by the checks that were made."""
    doubts = []
    if any(panel.at_search_edge for panel in data.rss):
        doubts.append("an offset lies at the edge of its search")
    if any(not panel.n for panel in data.rss):
        doubts.append("a channel could not be scored")
    audit = None if data.engine is None else data.engine.audit
    if data.engine is not None and audit is None:
        doubts.append("the engine is not audited yet" if data.audit_command else "the engine was not audited")
    if audit is not None and audit.missing_paths:
        doubts.append(f"the audit misses {count(audit.missing_paths)} paths")
    if audit is not None and audit.fields is not None and audit.fields.failures:
        doubts.append(f"the audit of the field failed {count(len(audit.fields.failures))} times")
    if any(panel.lag_verdict in ("ambiguous", "failed") for panel in data.rss):
        doubts.append("the radio clock could not be confirmed")
    if data.synthetic:
        doubts.append("the logs are synthetic and measure nothing")
    elif data.site.illustrative and data.site.buildings:
        doubts.append("the site's buildings are illustrative")
    if not doubts:
        return "Every check of this report was passed."
    return "Trust it with reserve: " + "; ".join(doubts) + "."


def headlines(data: ReportData) -> list[Headline]:
    """At most four numbers, each with its interval and what it must be held against."""
    lines = []
    panels = _scored(data.rss)
    if panels:
        lines += [_error(panels), *_difference(panels)]
    for panel in data.rank:
        at = _best_k(panel)
        if at is not None:
            lines.append(_rank(panel, at))
            break
    audit = None if data.engine is None else data.engine.audit
    if audit is not None:
        lines.append(_audit(audit))
    return lines[:4]


def _audit(audit: AuditResult) -> Headline:
    """What the audit of paths and fields found wrong; what the other engine's sampling misses is no fault of ours."""
    fields = audit.fields
    if fields is None:
        return Headline(
            label="Audit of the engine",
            value=f"{count(audit.missing_paths)} paths missing",
            interval=f"{count(audit.extra_paths)} that only we have, {audit.rss_max_error_db:.2f} dB at most",
            beside=f"{count(audit.links)} links against {audit.reference}",
        )
    return Headline(
        label="Audit of paths and fields",
        value=f"{count(len(fields.failures))} failed",
        interval=f"worst: {fields.power_max_db:.3f} dB, {fields.phase_max_rad:.4f} rad, {count(fields.paths)} paths",
        beside=f"against {audit.reference}'s own coefficients, {count(audit.links)} links",
    )


def _error(panels: Sequence[RssPanel]) -> Headline:
    total = pooled_db([p.rmse_db for p in panels], [p.n for p in panels])
    best = best_baseline(panels)
    return Headline(
        label="RMSE of the level" if len(panels) == 1 else f"RMSE of the level, {len(panels)} channels",
        value=f"{total:.1f} dB",
        interval=_ends(panels),
        beside="no baseline" if best is None else f"{pretty(best[0])}: {best[1]:.1f} dB",
    )


def _ends(panels: Sequence[RssPanel]) -> str:
    if len(panels) == 1:
        bounds = panels[0].rmse_ci95_db
        if bounds is None or not all(map(math.isfinite, bounds)):
            return NO_INTERVAL
        return f"95 %: {bounds[0]:.1f} to {bounds[1]:.1f} dB"
    return f"channels: {min(p.rmse_db for p in panels):.1f} to {max(p.rmse_db for p in panels):.1f} dB"


def _difference(panels: Sequence[RssPanel]) -> list[Headline]:
    best = best_baseline(panels)
    if best is None:
        return []
    paired = [b.paired for p in panels if (b := _baseline(p, best[0])) is not None and b.paired is not None]
    if not paired:
        return []
    words = [one.verdict for one in paired]
    undecided = len(words) - words.count("better") - words.count("worse")
    if len(paired) == 1:
        low, high = paired[0].difference_ci95_db
        known = math.isfinite(low) and math.isfinite(high)
        return [
            Headline(
                label=f"Against {pretty(best[0])}, same samples",
                value=f"{paired[0].difference_db:+.1f} dB".replace("-", "−"),
                interval=f"95 %: {low:+.1f} to {high:+.1f} dB".replace("-", "−")
                if known
                else "no interval can be given",
                beside="negative: ray tracing misses less",
            )
        ]
    return [
        Headline(
            label=f"Better than {pretty(best[0])}",
            value=f"{words.count('better')} of {len(words)}",
            interval=f"worse: {words.count('worse')}, no difference shown: {undecided}",
            beside="channels, by paired 95 % intervals",
        )
    ]


def _rank(panel: RankPanel, at: RankAtK) -> Headline:
    bounds = at.total_variation_ci95
    known = bounds is not None and all(map(math.isfinite, bounds))
    commonest = panel.extra.get("commonest") or {}
    agree = f"agreement {100 * at.agreement:.0f} %" if math.isfinite(at.agreement) else "no pose in common"
    return Headline(
        label=f"Rank at {panel.tower}, K = {at.k:.10g}",
        value=f"total variation {at.total_variation:.2f}",
        interval=f"95 %: {bounds[0]:.2f} to {bounds[1]:.2f}" if known and bounds is not None else agree,
        beside=f"{agree}; always saying {commonest['rank']}: {100 * commonest['agreement']:.0f} %"
        if commonest.get("rank")
        else agree,
    )
