"""benchmark.html: a table and a picture per task, every number from scores.csv beside it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from .html import environment, policy

LEVEL_COLUMNS = {
    "rmse_db": ("RMSE", "dB"),
    "rmse_4s_db": ("RMSE over 4 s", "dB"),
    "bias_db": ("Mean offset", "dB"),
    "crps_db": ("CRPS", "dB"),
    "log_score": ("Log score", "nat"),
    "coverage_90": ("In 90 % interval", "share"),
    "seconds": ("CPU", "s"),
}
RANK_COLUMNS = {
    "log_score": ("Log score", "nat"),
    "constant_log_score": ("of the constant", "nat"),
    "kappa": ("Kappa", ""),
    "agreement": ("Agreement", "share"),
    "total_variation_expected": ("Total variation", ""),
    "seconds": ("CPU", "s"),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Bar:
    """One entrant in a task: its row of numbers, and its dot and whisker in percent of the width."""

    entrant: str
    scores: Mapping[str, Any]
    at: float
    low: float
    high: float


@dataclass(frozen=True, slots=True, kw_only=True)
class TaskTable:
    """A task on the page; ``bars`` from the best to the worst."""

    name: str
    title: str
    rule: str
    flights: Sequence[str]
    skipped: Sequence[str]
    columns: Mapping[str, tuple[str, str]]
    bars: Sequence[Bar]
    reach: float
    words: str


def task_table(name: str, about: Mapping[str, Any], scores: Mapping[str, Mapping[str, Any]]) -> TaskTable:
    """The table of one task.

    Parameters
    ----------
    name : str
    about : mapping
        ``title, rule, kind, flights, skipped``.
    scores : mapping of entrant to scores
    """
    rank = about["kind"] == "rank"
    key, columns = ("log_score", RANK_COLUMNS) if rank else ("rmse_db", LEVEL_COLUMNS)
    order = sorted(scores, key=lambda e: scores[e][key])
    ends = [scores[e].get(f"{key}_ci95", scores[e].get("rmse_ci95_db")) or (math.nan, math.nan) for e in order]
    reach = max([1e-9, *(scores[e][key] for e in order), *(h for _, h in ends if h is not None and math.isfinite(h))])
    bars = []
    for entrant, (low, high) in zip(order, ends, strict=True):
        value = scores[entrant][key]
        known = low is not None and high is not None and math.isfinite(low) and math.isfinite(high)
        span = (low, high) if known else (value, value)
        at, start, stop = (100.0 * x / (1.05 * reach) for x in (value, *span))
        bars.append(Bar(entrant=entrant, scores=scores[entrant], at=at, low=start, high=stop))
    return TaskTable(
        name=name,
        title=about["title"],
        rule=about["rule"],
        flights=about["flights"],
        skipped=about["skipped"],
        columns=columns,
        bars=bars,
        reach=reach,
        words=_words(order, scores, key),
    )


def _words(order: Sequence[str], scores: Mapping[str, Mapping[str, Any]], key: str) -> str:
    """Who leads, and against which baseline its lead is shown by a paired 95 % interval."""
    if not order:
        return "No entrant."
    best = scores[order[0]]
    if key == "log_score":
        return f"Lowest log score: {order[0]}, {best[key]:.2f} nat; the constant has {best['constant_log_score']:.2f}."
    said = []
    for name in ("free_space", "log_distance"):
        low, high = best.get(f"difference_to_{name}_ci95_db", (math.nan, math.nan))
        if order[0] != name and math.isfinite(low):
            shown = "lower" if high < 0 else "not significantly different"
            said.append(f"{shown} than {name}" if high < 0 else f"{shown} from {name}")
    beaten = f" It is {' and '.join(said)} (paired, 95 %)." if said else ""
    return f"Lowest RMSE: {order[0]}, {best[key]:.2f} dB.{beaten}"


def benchmark_page(tables: Sequence[TaskTable], missing: Sequence[str], generated: str, version: str) -> str:
    """The page.

    Parameters
    ----------
    tables : sequence of TaskTable
    missing : sequence of str
        Published files that were not at hand, with their sources.
    generated, version : str
        When, and by which version of this package.

    Returns
    -------
    str
    """
    text: str = (
        environment()
        .get_template("benchmark.html.jinja")
        .render(tables=tables, missing=missing, generated=generated, version=version, content_policy=policy())
    )
    return text
