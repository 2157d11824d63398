"""What the first screen of a report says: a verdict in two sentences, and up to four numbers beside their baselines."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..common.provenance import KEY, union
from ..compare.memory import FEWEST
from ..compare.result import AuditResult
from .data import Baseline, RankAtK, RankPanel, ReportData, RssPanel
from .words import (
    NOTHING_COMPARED,
    TOO_FEW_COMPARED,
    Judged,
    audit_paths,
    cause_sentence,
    count,
    expected_sentence,
    first_sentence,
    local_error,
    pretty,
    training_sentence,
    trust,
)

NO_INTERVAL = "no interval can be given"

LARGE_DB = 1.5
"""A channel whose RMSE is this much [dB] above the pooled one is named as where the prediction fails."""


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
    found = judged(scored)
    first = first_sentence(found) if found is not None else _rank_sentence(data.rank)
    if learned := _training(data):
        learned = " ".join(part for part in (learned, expected_sentence(data.rss)) if part)
        return learned, " ".join(part for part in (_baseline_sentence(data.rss), first, trust(data)) if part)
    if not first:
        most = max([panel.n for panel in data.rss], default=0)
        return (NOTHING_COMPARED if not most else TOO_FEW_COMPARED.format(n=most), trust(data))
    first = " ".join(part for part in (first, expected_sentence(scored)) if part)
    return first, " ".join(part for part in (_causes(scored) or _fails(scored), trust(data)) if part)


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
    return [panel for panel in panels if panel.n >= FEWEST and math.isfinite(panel.rmse_db)]


def pooled_db(rmse_db: Sequence[float], n: Sequence[int]) -> float:
    """Root of the mean square error over all samples of several series, each after its own offset [dB]."""
    weight = np.asarray(n, dtype=np.float64)
    return float(np.sqrt((weight * np.asarray(rmse_db) ** 2).sum() / weight.sum()))


def baseline_errors(panels: Sequence[RssPanel]) -> dict[str, float]:
    """Pooled RMSE [dB] of each baseline that all of these series have."""
    names = [b.name for b in panels[0].baselines] if panels else []
    errors = {}
    for name in names:
        own = [_baseline(panel, name) for panel in panels]
        known = [b.rmse_db for b in own if b is not None and math.isfinite(b.rmse_db)]
        if len(known) == len(panels):
            errors[name] = pooled_db(known, [panel.n for panel in panels])
    return errors


def best_baseline(panels: Sequence[RssPanel]) -> tuple[str, float] | None:
    """Name and pooled RMSE [dB] of the baseline with the smallest error; None without one that all have."""
    return min(baseline_errors(panels).items(), key=lambda item: item[1], default=None)


def _baseline(panel: RssPanel, name: str) -> Baseline | None:
    return next((b for b in panel.baselines if b.name == name), None)


def judged(panels: Sequence[RssPanel]) -> Judged | None:
    """Ray tracing against the baseline that matters most: the best of those that it loses to, else the best of all."""
    if not panels:
        return None
    total = pooled_db([p.rmse_db for p in panels], [p.n for p in panels])
    best = best_baseline(panels)
    if best is None:
        return Judged(ray_db=total, channels=len(panels))
    every = []
    for name, error in baseline_errors(panels).items():
        paired = [b.paired for p in panels if (b := _baseline(p, name)) is not None and b.paired is not None]
        said = [pair.verdict for pair in paired if pair.verdict != "no interval"]
        every.append(Judged(ray_db=total, channels=len(panels), name=name, other_db=error, judged=len(said),
                            better=said.count("better"), worse=said.count("worse")))  # fmt: skip
    return most_telling(every)


def most_telling(every: Sequence[Judged]) -> Judged:
    """The comparison to be said first: the best baseline that ray tracing loses to, else the best one."""
    lost = [one for one in every if one.worse > one.better]
    return min(lost or every, key=lambda one: one.other_db)


def _forecast_of(panel: RankPanel) -> Mapping[str, Any] | None:
    """Numbers of the fitted receiver's forecast of the rank, where it was scored."""
    found = panel.extra.get("receiver")
    return found if found and found["kappa"] is not None and found["log_score_gain"] is not None else None


def _forecast_sentence(panel: RankPanel, found: Mapping[str, Any]) -> str:
    return (
        f"Rank forecast at {panel.tower} by the receiver learned on other flights: kappa {found['kappa']:.2f} (0 is "
        f"chance), {_log_score(found)}."
        f" The forecast rank agrees in {100 * found['agreement']:.0f} % of samples; always "
        f"guessing the commonest agrees in {100 * found['majority_agreement']:.0f} %."
    )


def _log_score(found: Mapping[str, Any]) -> str:
    side = "below" if found["log_score_gain"] > 0 else "above"
    return f"log score {abs(100 * found['log_score_gain']):.0f} % {side} the constant forecast"


def _forecast_card(panel: RankPanel, found: Mapping[str, Any]) -> Headline:
    low, high = found["kappa_ci95"]
    return Headline(
        label=f"Rank forecast at {panel.tower}",
        value=f"kappa {found['kappa']:.2f}",
        interval=NO_INTERVAL if low is None or high is None else f"95 %: {low:.2f} to {high:.2f}",
        beside=_log_score(found),
    )


def _rank_sentence(panels: Sequence[RankPanel]) -> str:
    for panel in panels:
        if found := _forecast_of(panel):
            return _forecast_sentence(panel, found)
        at = _best_k(panel)
        if at is not None:
            commonest = panel.extra.get("commonest") or {}
            beside = (
                f"; always guessing {commonest['rank']} agrees in {100 * commonest['agreement']:.0f} %"
                if commonest.get("rank") else ""
            )  # fmt: skip
            agree = f" Per position they agree in {100 * at.agreement:.0f} % of samples{beside}."
            return (
                f"Rank at {panel.tower} (K = {at.k:.10g}, best of {len(panel.simulated)} thresholds): predicted and "
                f"reported shares differ by {points(at.total_variation)} in all."
                + (agree if math.isfinite(at.agreement) else "")
            )
    return ""


def _best_k(panel: RankPanel) -> RankAtK | None:
    scored = [at for at in panel.simulated if math.isfinite(at.total_variation)]
    return min(scored, key=lambda at: at.total_variation) if scored else None


LONG_S = 5.0
"""A shorter stretch of error is a fade, not a fault of the model."""


def _causes(panels: Sequence[RssPanel]) -> str:
    """The cause that explains most of a channel's error; nothing where no channel shows one."""
    known = [panel for panel in panels if panel.extra.get("likely_cause")]
    if not known:
        return ""
    return cause_sentence(max(known, key=lambda panel: float(panel.extra["likely_cause"]["gain"])))


def _fails(panels: Sequence[RssPanel]) -> str:
    """Where the error is largest."""
    if not panels:
        return ""
    worst = max(panels, key=lambda p: p.rmse_db)
    if len(panels) > 1 and worst.rmse_db > pooled_db([p.rmse_db for p in panels], [p.n for p in panels]) + LARGE_DB:
        return f"Largest error of a channel: {worst.name}, {worst.rmse_db:.1f} dB."
    spans = [
        (panel, span)
        for panel in panels
        for span in panel.worst
        if (span.end - span.start) / np.timedelta64(1, "s") >= LONG_S
    ]
    if not spans:
        return ""
    panel, span = max(spans, key=lambda item: abs(item[1].mean_error_db))
    return local_error(panel, span)


def headlines(data: ReportData) -> list[Headline]:
    """At most four numbers, each with its interval and what it must be held against."""
    lines = []
    panels = _scored(data.rss)
    if panels:
        lines += [_error(panels), *_difference(panels)]
    for panel in data.rank:
        found, at = _forecast_of(panel), _best_k(panel)
        if found:
            lines.append(_forecast_card(panel, found))
            break
        if at is not None:
            lines.append(_rank(panel, at))
            break
    audit = None if data.engine is None else data.engine.audit
    if audit is not None:
        lines.append(_audit(audit))
    return lines[:4]


def _audit(audit: AuditResult) -> Headline:
    """Failed checks of the audit; paths that the other engine did not sample are no fault of ours."""
    fields = audit.fields
    beside = f"{count(audit.links)} links against {audit.reference}"
    if fields is None:
        value = f"{count(audit.missing_paths)} paths missing"
    else:
        value = f"{count(len(fields.failures))} failed"
        beside += f"; {count(fields.raw_poses)} poses, {count(fields.raw_levels)} levels from raw bytes"
    return Headline(label="Audit", value=value, interval=audit_paths(audit), beside=beside)


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
                beside="negative: smaller error of ray tracing",
            )
        ]
    return [
        Headline(
            label=f"Better than {pretty(best[0])}",
            value=f"{words.count('better')} of {len(words)}",
            interval=f"worse: {words.count('worse')}, not significant: {undecided}",
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
        value=points(at.total_variation),
        interval="between predicted and reported shares"
        + (f" (95 %: {100 * bounds[0]:.0f} to {100 * bounds[1]:.0f})" if known and bounds is not None else ""),
        beside=f"{agree}; always saying {commonest['rank']}: {100 * commonest['agreement']:.0f} %"
        if commonest.get("rank")
        else agree,
    )


def points(share: float) -> str:
    """A difference of shares in whole percentage points.

    Examples
    --------
    >>> points(0.012), points(0.18)
    ('1 percentage point', '18 percentage points')
    """
    number = f"{100 * share:.0f}"
    return f"{number} percentage point{'' if number == '1' else 's'}"
