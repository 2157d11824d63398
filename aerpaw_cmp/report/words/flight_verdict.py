"""First screen of a report: a verdict in two sentences, and up to four numbers beside their baselines."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from ...common.provenance import union
from ...compare.flight_verdict import baseline_errors, pooled_db, scored
from ...compare.ranks.forecast import ForecastScore
from ...compare.result import AuditResult, FlightVerdict, RankResult, RssResult
from ...compare.statistics.intervals import Interval
from ..content.flight import ReportData
from . import flight as words

NO_INTERVAL = "no interval can be given"

# A channel whose RMSE is this much [dB] above the pooled one is named as where the prediction fails.
LARGE_DB = 1.5


@dataclass(frozen=True, slots=True, kw_only=True)
class Headline:
    """One number of the first screen: what it is, its value with unit, its interval or range, its reference."""

    label: str
    value: str
    interval: str
    reference: str


def verdict(data: ReportData) -> tuple[str, ...]:
    """Two sentences: how good against which baseline; where it fails, and whether to trust it."""
    panels = scored(data.rss)
    first = _level_sentence(data.verdict, panels) if panels else _rank_sentence(data.rank)
    if learned := _training(data):
        learned = " ".join(part for part in (learned, words.expected_sentence(data.rss)) if part)
        return learned, " ".join(part for part in (_baseline_sentence(data.rss), first, words.trust(data)) if part)
    if not first:
        most = max([panel.score.n for panel in data.rss], default=0)
        return (words.NOTHING_COMPARED if not most else words.TOO_FEW_COMPARED.format(n=most), words.trust(data))
    first = " ".join(part for part in (words.lock_sentence(panels), first, words.expected_sentence(panels)) if part)
    cause = _causes(panels)
    where = (cause,) if cause else (_fails(panels), words.next_step(data))
    return first, " ".join(part for part in (*where, words.trust(data)) if part)


def _level_sentence(pooled: FlightVerdict | None, panels: Sequence[RssResult]) -> str:
    baseline_db = math.nan if pooled is None else baseline_errors(panels)[pooled.against]
    return words.flight_sentence(pooled, _pooled(panels), baseline_db)


def _training(data: ReportData) -> str:
    """The sentence of a training flight; nothing where nothing was learned from the logs of this one."""
    for panels, what in ((data.rss, "the antennas"), (data.rank, "the receiver")):
        learned = [panel for panel in panels if panel.further.trained_on]
        if learned:
            names = [panel.name if isinstance(panel, RssResult) else panel.tower for panel in learned]
            return words.training_sentence(names, what, union(*(panel.further.trained_on or () for panel in learned)))
    return ""


def _baseline_sentence(panels: Sequence[RssResult]) -> str:
    """Sentence on what a model without anything learned leaves on the panels of a training flight."""
    best = _best_baseline([panel for panel in panels if panel.training])
    return "" if best is None else f"For comparison, {words.pretty(best[0])}: RMSE {best[1]:.1f} dB."


def _best_baseline(panels: Sequence[RssResult]) -> tuple[str, float] | None:
    """Name and pooled RMSE [dB] of the baseline with the smallest error; None without one that all have."""
    return min(baseline_errors(panels).items(), key=lambda item: item[1], default=None)


def _pooled(panels: Sequence[RssResult]) -> float:
    """RMSE of the ray tracing over all samples of several series [dB]."""
    return pooled_db([p.score.rmse_db for p in panels], [p.score.n for p in panels])


def judge(
    scored: Sequence[tuple[float, int]],
    baselines_db: Mapping[str, float],
    verdicts: Sequence[Mapping[str, str]],
    unit: str = "channels",
) -> words.Judged:
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
        every.append(words.Judged(ray_db=total, channels=count_of, name=name, other_db=error, judged=len(decided),
                            better=decided.count("better"), worse=decided.count("worse"), unit=unit))  # fmt: skip
    return _most_telling(every) if every else words.Judged(ray_db=total, channels=count_of, unit=unit)


def _most_telling(every: Sequence[words.Judged]) -> words.Judged:
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
        f"Rank forecast at {panel.tower} by the receiver learned on other flights: kappa {score.kappa:.2f} (0 is "
        f"chance), {_log_score(score)}."
        f" The forecast rank agrees in {100 * score.agreement:.0f} % of samples; always "
        f"guessing the commonest agrees in {100 * score.majority_agreement:.0f} %."
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
        k = words.nearest_k(panel)
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


# A shorter stretch of error is a fade, not a fault of the model.
LONG_S = 5.0


def _causes(panels: Sequence[RssResult]) -> str:
    """The cause that explains most of a channel's error; nothing where no channel shows one."""
    gains = [(cause.gain, i) for i, panel in enumerate(panels) if (cause := panel.further.likely_cause) is not None]
    return words.cause_sentence(panels[max(gains)[1]]) if gains else ""


def _fails(panels: Sequence[RssResult]) -> str:
    """Sentence on where the error is largest."""
    if not panels:
        return ""
    worst = max(panels, key=lambda p: p.score.rmse_db)
    if len(panels) > 1 and worst.score.rmse_db > _pooled(panels) + LARGE_DB:
        return f"Largest error of a channel: {worst.name}, {worst.score.rmse_db:.1f} dB."
    spans = [(panel, span) for panel in panels for span in panel.spans if span.end_s - span.start_s >= LONG_S]
    if not spans:
        return f"Largest error of a channel: {worst.name}, {worst.score.rmse_db:.1f} dB." if len(panels) > 1 else ""
    panel, span = max(spans, key=lambda item: abs(item[1].mean_db))
    return words.local_error(panel, span)


def headlines(data: ReportData) -> list[Headline]:
    """At most four numbers, each with its interval and what it must be held against."""
    lines = []
    panels = scored(data.rss)
    if panels:
        lines += [_error(panels), *_difference(data.verdict)]
    for panel in data.rank:
        score, k = _forecast_of(panel), words.nearest_k(panel)
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
    extent = f"{words.count(audit.links)} links against {audit.reference}"
    if fields is None:
        value = f"{words.count(audit.missing_paths)} paths missing"
    else:
        value = f"{words.count(len(fields.failures))} failed"
    return Headline(label="Audit", value=value, interval=words.audit_paths(audit), reference=extent)


def _error(panels: Sequence[RssResult]) -> Headline:
    total, best = _pooled(panels), _best_baseline(panels)
    return Headline(
        label="RMSE of the level" if len(panels) == 1 else f"RMSE of the level, {len(panels)} channels",
        value=f"{total:.1f} dB",
        interval=_ends(panels),
        reference="no baseline" if best is None else f"{words.pretty(best[0])}: {best[1]:.1f} dB",
    )


def _interval(ends: Interval, form: str, unit: str = "") -> str:
    if not math.isfinite(ends[0]):
        return NO_INTERVAL
    if not math.isfinite(ends[1]):
        return f"95 %: at least {format(ends[0], form)}{unit}"
    return "95 %: " + " to ".join(format(end, form).replace("-", "−") for end in ends) + unit


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
            label=f"Against {words.pretty(pooled.against)}, same samples",
            value=f"{pooled.difference_db:+.2f} dB".replace("-", "−"),
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
    number = f"{100 * share:.0f}"
    return f"{number} percentage point{'' if number == '1' else 's'}"
