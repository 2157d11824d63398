"""diff.html and diff.json: two reports side by side, without a script."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from ...common.counting import counted
from ...common.jsonable import fields_of, json_object
from ...common.units import Printed
from ..content.diff import TOLERANCE_DB, ReportDiff
from ..kit.files import json_text, write_file
from ..kit.page import rendered
from ..words.flight import count


def diff_metrics(diff: ReportDiff) -> dict[str, Any]:
    """Everything as plain JSON: verdict, differences, and the fields of the record."""
    return json_object(
        verdict=verdict(diff), differs=bool(diff.differences), differences=diff.differences, **fields_of(diff)
    )


def diff_page(diff: ReportDiff) -> str:
    """The whole page."""
    return rendered("diff", diff=diff, tolerance_db=TOLERANCE_DB, verdict=verdict(diff))


def write_diff(diff: ReportDiff, folder: Path) -> list[Path]:
    """Write ``diff.html`` and ``diff.json``; gives the files, page first."""
    numbers = json_text(diff_metrics(diff))
    return [write_file(folder / "diff.html", diff_page(diff)), write_file(folder / "diff.json", numbers)]


# Sentence on two reports, by the verdict of the paired interval. No other sentence of a diff says better or worse.
DIFFERENCE = {
    "better": "The second is significantly better: {difference:+.2f} dB {interval} (95 %).",
    "worse": "The second is significantly worse: {difference:+.2f} dB {interval} (95 %).",
    "not significant": "The difference of {difference:+.2f} dB {interval} is not significant (95 %).",
    "no interval": "The difference is {difference:+.2f} dB; too few independent samples for an interval.",
}

# Differences that stand in the first sentence where RMSE agree.
_NAMED = 2


def verdict(diff: ReportDiff) -> str:
    """The result in one or two sentences."""
    changed = {"setting": len(diff.settings), "input": len(diff.inputs), "version": len(diff.versions)}
    listed = ", ".join(counted(n, name) for name, n in changed.items() if n)
    also = f" Changed: {listed}." if listed else " Settings, inputs and versions are the same."
    if _site_alone(diff):
        also = " The site differs, and nothing else."
    if not diff.differences:
        return f"No difference: the numbers agree within {TOLERANCE_DB:g} dB.{also}"
    return _numbers(diff) + also


def _site_alone(diff: ReportDiff) -> bool:
    """Check whether all that changed is the site: its key of the flight file, that file, and its own."""
    settings = [entry.key.split(".")[0] == "site" for entry in diff.settings]
    inputs = [entry.role.startswith("site file") for entry in diff.inputs]
    others = [entry for entry in diff.inputs if not entry.role.startswith(("site file", "flight file"))]
    return any(settings + inputs) and all(settings) and not others and not diff.versions


def _numbers(diff: ReportDiff) -> str:
    """Sentence on the RMSE over all links; where those agree, the first differences."""
    scored, pooled = [level for level in diff.levels if level.rmse.n], diff.pooled
    if pooled is None or all(abs(item.rmse.difference_db) <= TOLERANCE_DB for item in scored):
        more = len(diff.differences) - _NAMED
        return "; ".join(diff.differences[:_NAMED]) + (f"; and {more} more." if more > 0 else ".")
    common, most = (count(sum(getattr(item.samples, name) for item in scored)) for name in ("common", "first"))
    low, high = pooled.difference_ci95_db
    interval = f"[{Printed(low):+.2f}, {Printed(high):+.2f}]" if math.isfinite(low) else ""
    return (
        f"RSS over {common} common samples of {most}: RMSE {pooled.other_rmse_db:.2f} dB in the first, "
        f"{pooled.rmse_db:.2f} dB in the second. "
        + DIFFERENCE[pooled.verdict].format(difference=Printed(pooled.difference_db), interval=interval)
    )
