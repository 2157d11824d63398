"""First screen of a report: a paragraph, and up to four numbers beside their baselines."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from ...common.counting import counted
from ...common.units import Printed
from ...compare.flight_verdict import baseline_errors, is_one_place, lock_lost, pooled_db, scored
from ...compare.ranks.forecast import ForecastScore
from ...compare.result import AuditResult, FlightVerdict, RankResult, RssResult
from ...compare.statistics.intervals import Interval
from ..content.flight import ReportData
from . import flight as words

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
        parts = [learned, other, words.expected_sentence(data.rss), advice]
    elif error and data.against is not None and data.against.scores:
        from .prediction import before_flight  # no report without a prediction loads how one is learned

        parts = [error, before_flight(data.against.scores), advice]
    elif error:
        none = words.ONE_PLACE if is_one_place(panels) else words.NO_CAUSE if panels else ""
        # the step of such a flight is a wider span, whatever its cause
        beyond = next((words.BEYOND.format(name=p.name) for p in data.rss if p.score.at_edge), "")
        cause = beyond or data.cause or none
        parts = [error, words.expected_sentence(panels), cause, advice]
    elif any(panel.score.at_edge for panel in data.rss):
        parts = [words.BEYOND_SPAN, advice]
    else:
        most = max([panel.score.n for panel in data.rss], default=0)
        none = words.TOO_FEW_COMPARED.format(n=most) if most else words.NOTHING_COMPARED
        parts = [none, data.cause or "", advice if data.cause else ""]
    return " ".join(part for part in parts if part)


def _level_sentence(pooled: FlightVerdict | None, panels: Sequence[RssResult]) -> str:
    if pooled is None:
        return f"Ray tracing: RMSE {_pooled(panels):.1f} dB. No baseline could be scored."
    return words.flight_sentence(pooled, next((lock.floor_db for p in panels if (lock := lock_lost(p))), None))


def _training(data: ReportData) -> str:
    """The sentence of a training flight; nothing where nothing was learned from the logs of this one."""
    for panels, what in ((data.rss, "the antennas"), (data.rank, "the receiver")):
        learned = [panel for panel in panels if panel.further.trained_on]
        if learned:
            names = [panel.name if isinstance(panel, RssResult) else panel.tower for panel in learned]
            return words.training_sentence(names, what)
    return ""


def _baseline_sentence(panels: Sequence[RssResult]) -> str:
    """Sentence on what a model without anything learned leaves on the panels of a training flight."""
    errors = baseline_errors([panel for panel in panels if panel.training])
    if not errors:
        return ""
    best = min(errors, key=errors.__getitem__)
    return f"For comparison, {words.with_article(best)}: RMSE {errors[best]:.1f} dB."


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


def headlines(data: ReportData) -> list[Headline]:
    """At most four numbers, each with its interval and what it must be held against."""
    lines = []
    panels = scored(data.rss)
    if panels:
        lines += [_error(panels, data.verdict), *_difference(data.verdict)]
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
    extent = f"{counted(audit.links, 'link')} against {audit.reference}"
    if fields is None:
        value = f"{counted(audit.missing_paths, 'path')} missing"
    else:
        value = f"{words.count(len(fields.failures))} failed"
    return Headline(label="Audit", value=value, interval=words.audit_paths(audit), reference=extent)


def _error(panels: Sequence[RssResult], pooled: FlightVerdict | None) -> Headline:
    total = _pooled(panels) if pooled is None else pooled.rmse_db
    best = "no baseline" if pooled is None else f"{words.pretty(pooled.against)}: {pooled.baseline_rmse_db:.1f} dB"
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
            label=f"Against {words.pretty(pooled.against)}, same samples",
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
