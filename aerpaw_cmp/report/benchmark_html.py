"""benchmark.html: a table and a picture per task, every number from scores.csv beside it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from .page import rendered

_LEVEL_COLUMNS = {
    "rmse_db": ("RMSE", "dB"),
    "rmse_4s_db": ("RMSE over 4 s", "dB"),
    "bias_db": ("Mean offset", "dB"),
    "crps_db": ("CRPS", "dB"),
    "log_score": ("Log score", "nat"),
    "coverage_90": ("In 90 % interval", "share"),
    "seconds": ("CPU", "s"),
    "peak_mib": ("Peak memory", "MiB"),
}
RANK_COLUMNS = {
    "log_score": ("Log score", "nat"),
    "constant_log_score": ("of the constant", "nat"),
    "kappa": ("Kappa", ""),
    "agreement": ("Agreement", "share"),
    "total_variation_expected": ("Total variation", ""),
    "seconds": ("CPU", "s"),
    "peak_mib": ("Peak memory", "MiB"),
}


# Names of our entrants on the page.
TITLES = {
    "free_space": "free space",
    "log_distance": "log-distance line",
    "two_ray": "two-ray",
    "tr36777_rma_av": "3GPP RMa-AV",
    "tr36777_uma_av": "3GPP UMa-AV",
    "p1411": "ITU-R P.1411",
    "kriging": "Kriging of the level",
    "replay_paper": "ray tracing, the paper's settings",
    "replay_drafted": "ray tracing, as drafted",
    "replay_sionna": "ray tracing, Sionna's paths",
    "learned": "learned antennas",
    "learned_residual": "learned antennas and residual field",
    "boosted_trees": "gradient-boosted trees",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Bar:
    """One entrant in a task: its row of numbers, and its dot and whisker in percent of the width."""

    title: str
    scores: Mapping[str, Any]
    at: float
    low: float
    high: float


@dataclass(frozen=True, slots=True, kw_only=True)
class TaskTable:
    """A task on the page; ``about`` with title, rule, flights and skipped, ``bars`` from the best to the worst."""

    name: str
    about: Mapping[str, Any]
    columns: Mapping[str, tuple[str, str]]
    bars: Sequence[Bar]
    scores: Mapping[str, Mapping[str, Any]]
    key: str
    unit: str
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
    key, columns = ("log_score", RANK_COLUMNS) if rank else ("rmse_db", _LEVEL_COLUMNS)
    order = sorted(scores, key=lambda e: scores[e][key])
    ends = [scores[e].get(f"{key}_ci95", scores[e].get("rmse_ci95_db")) or (math.nan, math.nan) for e in order]
    reach = max([1e-9, *(scores[e][key] for e in order), *(h for _, h in ends if h is not None and math.isfinite(h))])
    bars = []
    for entrant, (low, high) in zip(order, ends, strict=True):
        value = scores[entrant][key]
        known = low is not None and high is not None and math.isfinite(low) and math.isfinite(high)
        span = (low, high) if known else (value, value)
        at, start, stop = (100.0 * x / (1.05 * reach) for x in (value, *span))
        bars.append(Bar(title=TITLES.get(entrant, entrant), scores=scores[entrant], at=at, low=start, high=stop))
    return TaskTable(
        name=name,
        about=about,
        columns=columns,
        bars=bars,
        scores=scores,
        key=key,
        unit="nat" if rank else "dB",
        reach=reach,
        words=_words(order, scores, key),
    )


def _words(order: Sequence[str], scores: Mapping[str, Mapping[str, Any]], key: str) -> str:
    """The best model, and the baselines that a paired 95 % interval shows it to beat."""
    if not order:
        return "No entrant."
    best, name = scores[order[0]], TITLES.get(order[0], order[0])
    if key == "log_score":
        return f"Lowest log score: {name}, {best[key]:.2f} nat; the constant has {best['constant_log_score']:.2f}."
    beaten: list[str] = []
    equal: list[str] = []
    for baseline in ("free_space", "log_distance"):
        low, high = best.get(f"difference_to_{baseline}_ci95_db", (math.nan, math.nan))
        if order[0] != baseline and math.isfinite(low):
            (beaten if high < 0 else equal).append(TITLES[baseline])
    words = [f"Lowest RMSE: {name}, {best[key]:.2f} dB."]
    if beaten:
        words.append(f"It is lower than that of {' and '.join(beaten)} (paired, 95 %).")
    if equal:
        words.append(f"The difference from {' and '.join(equal)} is not significant.")
    return " ".join(words)


def _first_words(tables: Sequence[TaskTable]) -> str:
    """On how many tasks a model without ray tracing and learning is as good as any."""
    simple = {TITLES[n] for n in ("free_space", "log_distance", "two_ray", "tr36777_rma_av", "tr36777_uma_av", "p1411")}
    simple |= {"constant", TITLES["kriging"]}
    won = [item.about["title"] for item in tables if item.bars and item.bars[0].title in simple]
    text = f"{len(tables)} tasks were scored. "
    if not won:
        return text + "On none of them is a baseline the best model."
    return text + f"A baseline is the best model on {len(won)}: {'; '.join(won)}."


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
    names = dict.fromkeys(bar.title for table in tables for bar in table.bars)
    return rendered(
        "benchmark",
        ("benchmark.js",),
        tables=tables,
        first_words=_first_words(tables),
        missing=missing,
        generated=generated,
        version=version,
        entrants=sorted(names),
    )
