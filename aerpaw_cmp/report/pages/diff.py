"""diff.html and diff.json: two reports side by side, without a script."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ...common.counting import counted
from ...common.jsonable import fields_of, json_object
from ...compare.judge.report_difference import Changed
from ...compare.judge.verdicts import changed_verdict
from ..content.diff import TOLERANCE_DB, ReportDiff
from ..kit.files import json_text, write_file
from ..kit.page import rendered
from ..words.flight import count
from ..words.phrases import said_of


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


# Differences of agreement and kappa below this are rounding.
_LEAST_RANK = 1e-6

# Sentence on two reports, by the verdict of the paired interval. No other sentence of a diff says better or worse.
DIFFERENCE = {
    "better": "The second is significantly better: {difference:+.2f} dB {interval} (95 %).",
    "worse": "The second is significantly worse: {difference:+.2f} dB {interval} (95 %).",
    "not significant": "The difference of {difference:+.2f} dB {interval} is not significant (95 %).",
    "no interval": "The difference is {difference:+.2f} dB; too few independent samples for an interval.",
}

# Next step by the word of the paired interval.
KEEP = {
    "better": "go on as in the second report",
    "worse": "go on as in the first report",
    "not significant": "go on with either; this flight does not decide",
    "no interval": "compare on a longer flight",
}

# Settings, inputs or versions that a sentence names.
_NAMED = 3

# Cause and next step, by :func:`~aerpaw_cmp.compare.judge.verdicts.changed_verdict`.
CAUSES: dict[str, tuple[str, str]] = {
    "none": ("{listed} {verb}.", ""),
    "measured": (
        "The measured levels differ by up to {moved:.2g} dB.",
        "compare reports of the same logs to judge a model",
    ),
    "setting": ("Likely cause: {listed} {verb} ({names}).", "{keep}"),
    "input": ("Likely cause: {listed} {verb} ({names}).", "{keep}"),
    "site": ("Likely cause: the site differs ({names}).", "{keep}"),
    "version": ("Likely cause: {listed} {verb} ({names}).", "make both reports with one version to judge a setting"),
    "several": ("{listed} {verb}, so no single cause is shown.", "change one of them at a time"),
    "unexplained": (
        "Settings, inputs and versions are the same.",
        "run both reports again; numbers that still differ are a fault of the program",
    ),
}


def verdict(diff: ReportDiff) -> str:
    """The result in one or two sentences."""
    common = sum(level.samples.common for level in diff.levels)
    ranked = max((rank.samples.common for rank in diff.ranks), default=0)
    if not diff.differences:
        samples = [f"{count(common)} RSS samples"] * bool(common) + [f"{count(ranked)} rank samples"] * bool(ranked)
        on = f" on {' and '.join(samples)}" if samples else ""
        return f"No difference: the numbers agree within {TOLERANCE_DB:g} dB{on}.{_cause(diff)}"
    parts = [text for text in (_level_verdict(diff), _rank_verdict(diff)) if text]
    return " ".join(parts or ["Links differ."]) + _cause(diff)


# Its settings are compared one by one.
_FLIGHT_FILE = "flight file"


def _site_alone(diff: ReportDiff) -> bool:
    """Check whether settings and inputs differ by the site alone: its name, its file, or what that names."""
    keys, roles = {entry.key for entry in diff.settings}, {entry.role for entry in diff.inputs} - {_FLIGHT_FILE}
    return bool(keys or roles) and all(name.startswith("site") for name in (*keys, *roles))


def _cause(diff: ReportDiff) -> str:
    """Sentence on what else differs, which may be the reason."""
    kinds: dict[str, Sequence[object]] = {"setting": diff.settings, "input": diff.inputs, "version": diff.versions}
    if _site_alone(diff):
        kinds = {"site": [i for i in diff.inputs if i.role != _FLIGHT_FILE] or diff.settings, "version": diff.versions}
    changed = {name: len(items) for name, items in kinds.items()}
    moved = max((level.measured_max_db for level in diff.levels if math.isfinite(level.measured_max_db)), default=0.0)
    cause = changed_verdict(diff.pooled, bool(diff.differences), moved > TOLERANCE_DB, changed)
    listed = " and ".join(counted(n, name) for name, n in changed.items() if n)
    verb = "differs" if sum(changed.values()) == 1 else "differ"
    if cause.cause == "none" and not listed:
        return ""
    names = [
        str(getattr(entry, "key", None) or getattr(entry, "path", "")) for items in kinds.values() for entry in items
    ]
    shown = ", ".join(names[:_NAMED]) + (", ..." if len(names) > _NAMED else "")
    keep = KEEP.get(cause.where, KEEP["no interval"])
    return " " + said_of(cause, CAUSES, listed=listed, verb=verb, moved=moved, names=shown, keep=keep)


def _level_verdict(diff: ReportDiff) -> str:
    scored = [level for level in diff.levels if level.rmse.n]
    if not scored or diff.pooled is None:
        return ""
    if all(abs(item.rmse.difference_db) <= TOLERANCE_DB for item in scored):
        moved = max((item.simulated_max_db for item in scored if math.isfinite(item.simulated_max_db)), default=0.0)
        though = f", though the replay moved by up to {moved:.2g} dB" if moved > TOLERANCE_DB else ""
        return f"RSS errors agree on the common samples{though}."
    pooled = diff.pooled
    common, most = (count(sum(getattr(item.samples, name) for item in scored)) for name in ("common", "first"))
    text = f"RSS over {common} common samples of {most}: RMSE {pooled.other_rmse_db:.2f} dB in the first, "
    text += f"{pooled.rmse_db:.2f} dB in the second. "
    text += DIFFERENCE[pooled.verdict].format(
        difference=pooled.difference_db, interval=_bounds(pooled.difference_ci95_db, 2)
    )
    if len(scored) > 1:
        verdicts: list[str] = [item.rmse.verdict for item in scored]
        text += " Links: " + ", ".join(f"{verdicts.count(word)} {word}" for word in KEEP if verdicts.count(word)) + "."
    return text


def _bounds(value: tuple[float, float], decimals: int) -> str:
    low, high = value
    return f"[{low:+.{decimals}f}, {high:+.{decimals}f}]" if math.isfinite(low) else ""


def _rank_verdict(diff: ReportDiff) -> str:
    moved = [rank for rank in diff.ranks if rank.n_changed or abs(rank.kappa.difference) > _LEAST_RANK]
    if not diff.ranks:
        return ""
    if not moved:
        return "Simulated ranks agree on the common samples."
    most = max(
        moved, key=lambda entry: abs(entry.agreement.difference) if math.isfinite(entry.agreement.difference) else -1
    )
    return (
        f"Rank at {most.tower}, K = {most.k}: {count(most.n_changed)} of {count(most.samples.common)} simulated ranks "
        f"differ, agreement {_arrow(most.agreement)}, kappa {_arrow(most.kappa)}."
    )


def _arrow(value: Changed) -> str:
    if not math.isfinite(value.difference):
        return "not known"
    bounds = _bounds(value.ci95, 3)
    return f"{value.first:.3f} to {value.second:.3f}" + (f" (change {bounds})" if bounds else "")
