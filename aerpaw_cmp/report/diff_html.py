"""diff.html and diff.json: two reports side by side, without a script."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..common.jsonable import fields_of, json_object
from .diff_data import ReportDiff
from .diff_words import verdict
from .export import json_text, write_file
from .html import rendered


def diff_metrics(diff: ReportDiff) -> dict[str, Any]:
    """Everything as plain JSON: verdict, differences, and the fields of the record."""
    return json_object(
        verdict=verdict(diff), differs=bool(diff.differences), differences=diff.differences, **fields_of(diff)
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Whisker:
    """One row of the picture: where its dot and its interval lie, in percent of the width."""

    name: str
    at: float
    low: float
    high: float
    verdict: str


def whiskers(diff: ReportDiff) -> tuple[list[Whisker], float]:
    """Differences of RMSE with their intervals, and the reach of the axis on either side of zero [dB]."""
    rows = [(f"{level.tower} {level.channel}", level.rmse) for level in diff.levels if level.rmse.n]
    if diff.pooled is not None and len(rows) > 1:
        rows.append(("all links", diff.pooled))
    sizes = [abs(x) for _, p in rows for x in (p.difference_db, *p.difference_ci95_db) if x == x]  # not NaN
    reach = max([diff.tolerance_db, *sizes]) * 1.08

    def percent(value: float) -> float:
        return 50.0 + 50.0 * value / reach

    drawn = []
    for name, one in rows:
        low, high = one.difference_ci95_db
        known = low == low
        at = percent(one.difference_db)
        drawn.append(
            Whisker(
                name=name,
                at=at,
                low=percent(low) if known else at,
                high=percent(high) if known else at,
                verdict=one.verdict,
            )
        )
    return drawn, reach


def diff_page(diff: ReportDiff) -> str:
    """The whole page."""
    rows, reach = whiskers(diff)
    return rendered("diff", diff=diff, verdict=verdict(diff), whiskers=rows, reach=reach)


def write_diff(diff: ReportDiff, folder: Path) -> list[Path]:
    """Write ``diff.html`` and ``diff.json``; gives the files, page first."""
    numbers = json_text(diff_metrics(diff))
    return [write_file(folder / "diff.html", diff_page(diff)), write_file(folder / "diff.json", numbers)]
