"""diff.html and diff.json: two reports side by side, without a script."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ...common.jsonable import fields_of, json_object
from ..export import json_text, write_file
from ..html import rendered
from .data import ReportDiff
from .words import verdict


def diff_metrics(diff: ReportDiff) -> dict[str, Any]:
    """Everything as plain JSON: verdict, differences, and the fields of the record."""
    return json_object(
        verdict=verdict(diff), differs=bool(diff.differences), differences=diff.differences, **fields_of(diff)
    )


def diff_page(diff: ReportDiff) -> str:
    """The whole page."""
    return rendered("diff", diff=diff, verdict=verdict(diff))


def write_diff(diff: ReportDiff, folder: Path) -> list[Path]:
    """Write ``diff.html`` and ``diff.json``; gives the files, page first."""
    numbers = json_text(diff_metrics(diff))
    return [write_file(folder / "diff.html", diff_page(diff)), write_file(folder / "diff.json", numbers)]
