"""``diff``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from ..common.errors import one_line
from .app import Force, Json, command
from .shown import number, print_json, say, table


@command(
    "diff",
    examples=[
        "aerpaw-cmp diff reports/monday reports/friday",
        "aerpaw-cmp diff reports/a reports/b -o reports/a_and_b",
        "aerpaw-cmp diff reports/a reports/b --strict --tolerance 0.05 --json",
    ],
)
def diff(
    first: Annotated[Path, typer.Argument(help="Folder of a report.")],
    second: Annotated[Path, typer.Argument(help="The other report of the same flight.")],
    out: Annotated[
        Path | None,
        typer.Option(
            "-o", "--out", metavar="DIR", help="Folder for diff.html and diff.json  [default: none is written]"
        ),
    ] = None,
    tolerance: Annotated[float, typer.Option(help="Largest difference that counts as equal [dB].")] = 0.01,
    strict: Annotated[
        bool, typer.Option("--strict", help="Exit code 1 when a number differs by more than the tolerance.")
    ] = False,
    force: Force = False,
    as_json: Json = False,
) -> int:
    """Differences between two reports of a flight: settings, inputs, versions, numbers on common samples."""
    from ..jobs.diff_reports import run_diff
    from ..report.diff_html import diff_metrics

    comparison = run_diff(first, second, out=out, tolerance_db=tolerance, force=force)
    if as_json:
        print_json(diff_metrics(comparison))
    else:
        _print_diff(comparison)
        if out is not None:
            print(f"page: {out / 'diff.html'}")
    return 1 if strict and comparison.differences else 0


_SHOWN = 20
"""Changes of one kind that are printed."""


def _print_diff(comparison: Any) -> None:
    from ..report.diff_words import verdict

    print(verdict(comparison))
    for text in comparison.remarks:
        say.warn(f"warning: {one_line(text)}")
    for title, items in (("setting", comparison.settings), ("version", comparison.versions)):
        for item in items[:_SHOWN]:
            print(one_line(f"{title} {item.key}: {_value(item.first)} -> {_value(item.second)}"))
        if len(items) > _SHOWN:
            print(f"and {len(items) - _SHOWN} more {title}s")
    for item in comparison.inputs:
        print(one_line(f"input {item.path} ({item.role}): {item.what}"))
    _print_numbers(comparison)
    for name, texts in (("second", comparison.new_warnings), ("first", comparison.gone_warnings)):
        for text in texts:
            print(one_line(f"warning only in the {name}: {text}"))


def _value(value: Any) -> str:
    return "not there" if value is None else str(value)


def _bounds(value: tuple[float, float]) -> str:
    return "-" if value[0] != value[0] else f"{value[0]:+.3f} .. {value[1]:+.3f}"


def _print_numbers(comparison: Any) -> None:
    rows = [
        [f"{d.tower} {d.channel}", f"{d.samples.common} of {d.samples.first}, {d.samples.second}",
         number(d.rmse.other_rmse_db, "{:.3f}"), number(d.rmse.rmse_db, "{:.3f}"),
         number(d.rmse.difference_db, "{:+.3f}"), _bounds(d.rmse.difference_ci95_db), d.rmse.verdict,
         number(d.offset_db.difference, "{:+.1f}"), number(d.simulated_max_db, "{:.3f}")]
        for d in comparison.levels
    ]  # fmt: skip
    if rows:
        heads = ["link", "common samples", "RMSE first dB", "second", "change", "95 %", "second is", "offset", "replay"]
        table(heads, rows, "RSS on common samples, second minus first; offset and replay: change, largest change in dB")
    rows = [
        [d.tower, d.k, f"{d.samples.common} of {d.samples.first}, {d.samples.second}", str(d.n_changed),
         number(d.agreement.difference, "{:+.3f}"), _bounds(d.agreement.ci95),
         number(d.kappa.difference, "{:+.3f}"), _bounds(d.kappa.ci95)]
        for d in comparison.ranks
    ]  # fmt: skip
    if rows:
        heads = ["tower", "K", "common samples", "ranks changed", "agreement", "95 %", "kappa", "95 %"]
        table(heads, rows, "Rank on common samples, second minus first")
