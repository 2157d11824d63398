"""``diff``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Option

from ...common.errors import one_line
from ..app import Force, Json, command, output
from ..shown import print_json, records, say, show


@command(
    "diff",
    examples=[
        "aerpaw-cmp diff reports/monday reports/friday",
        "aerpaw-cmp diff reports/a reports/b -o reports/a_and_b",
        "aerpaw-cmp diff reports/a reports/b --strict --json",
    ],
)
def diff(
    first: Annotated[Path, Argument(help="Folder of a report.")],
    second: Annotated[Path, Argument(help="The other report of the same flight.")],
    out: Annotated[Path | None, output("Folder for diff.html and diff.json  [default: none is written]")] = None,
    strict: Annotated[bool, Option("--strict", help="Exit code 1 when a number differs by more than 0.01 dB.")] = False,
    force: Force = False,
    as_json: Json = False,
) -> int:
    """Differences between two reports of a flight: settings, inputs, versions, numbers on common samples."""
    from ...jobs.diff_reports import run_diff
    from ...report.pages.diff import diff_metrics

    comparison = run_diff(first, second, out=out, force=force)
    if as_json:
        print_json(diff_metrics(comparison))
    else:
        _print_diff(comparison)
        if out is not None:
            show(f"page: {out / 'diff.html'}")
    return 1 if strict and comparison.differences else 0


# Changes of one kind that are printed.
_SHOWN = 20


def _print_diff(comparison: Any) -> None:
    from ...report.pages.diff import verdict

    show(verdict(comparison))
    for text in comparison.remarks:
        say.warn(f"warning: {one_line(text)}")
    for title, items in (("setting", comparison.settings), ("version", comparison.versions)):
        for item in items[:_SHOWN]:
            show(one_line(f"{title} {item.key}: {_value(item.first)} -> {_value(item.second)}"))
        if len(items) > _SHOWN:
            show(f"and {len(items) - _SHOWN} more {title}s")
    for item in comparison.inputs:
        show(one_line(f"input {item.path} ({item.role}): {item.what}"))
    _print_numbers(comparison)


def _value(value: Any) -> str:
    return "not there" if value is None else str(value)


def _print_numbers(comparison: Any) -> None:
    levels = {
        "tower": "tower", "channel": "channel", "common samples": "samples", "RMSE first dB": "rmse.other_rmse_db:.3f",
        "second": "rmse.rmse_db:.3f", "change": "rmse.difference_db:+.3f", "95 %": "rmse.difference_ci95_db:+.3f",
        "second is": "rmse.verdict", "offset": "offset_db.difference:+.1f", "replay": "simulated_max_db:.3f",
    }  # fmt: skip
    title = "RSS on common samples, second minus first; offset and replay: change, largest change in dB"
    records(comparison.levels, levels, title)
    ranks = {
        "tower": "tower", "K": "k", "common samples": "samples", "ranks changed": "n_changed",
        "agreement": "agreement.difference:+.3f", "95 % of it": "agreement.ci95:+.3f",
        "kappa": "kappa.difference:+.3f", "95 % of kappa": "kappa.ci95:+.3f",
    }  # fmt: skip
    records(comparison.ranks, ranks, "Rank on common samples, second minus first")
