"""Output of the commands: progress, tables and JSON."""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Mapping, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Any

from ..common.errors import one_line, printable
from ..common.text import counted

_EVERY_S = 30.0


def show(text: object, *, to_stderr: bool = False) -> None:
    """Print lines on standard output or error, with control characters escaped, because they may come from a file."""
    print(printable(str(text)), file=sys.stderr if to_stderr else sys.stdout, flush=True)


class ProgressLines:
    """Progress on standard error, so that standard output contains only results.

    On a terminal, progress is a bar with the remaining time. Elsewhere, a line is printed at each quarter and every
    half minute. Text after a tab is a remark, which may change without starting another bar. If ``quiet`` is set, only
    :meth:`warn` prints. If ``as_json`` is set, standard output contains one JSON object.
    """

    def __init__(self) -> None:
        self._bar: Any = None
        self._quarters: dict[str, int] = {}
        self._name = ""
        self._last = time.monotonic()
        self.quiet = self.as_json = False

    def __call__(self, text: str, fraction: float | None = None, /) -> None:
        """Show a line of text, or progress if the share ``fraction`` (0 to 1) is given."""
        if self.quiet:
            return
        if fraction is None:
            self.warn(text)
        elif self._bar is not None or sys.stderr.isatty():  # while rich 13.7 shows a bar, isatty() is False
            self._draw(text, fraction)
        else:
            name, _, tail = text.partition("\t")
            late = time.monotonic() - self._last >= _EVERY_S
            if late or int(4 * fraction) > self._quarters.get(name, 0):
                self._quarters[name], self._last = int(4 * fraction), time.monotonic()
                show(f"{name} {100 * fraction:.0f} %{tail and ': ' + tail}", to_stderr=True)

    def warn(self, text: str) -> None:
        """Show a line, even if ``quiet`` is set."""
        self.end()
        show(text, to_stderr=True)

    def _draw(self, text: str, fraction: float) -> None:
        name, _, tail = text.partition("\t")
        shown = f"{name}: {tail}" if tail else name
        if self._bar is None or self._name != name:
            self.end()
            self._bar, self._name = _bar(), name
            self._bar.add_task(one_line(shown), total=1.0)
            self._bar.start()
        self._bar.update(self._bar.tasks[0].id, completed=fraction, description=one_line(shown))
        if fraction >= 1.0:
            self.end()

    def end(self) -> None:
        """Stop the progress bar. Its last state remains on the terminal."""
        if self._bar is not None:
            self._bar.stop()
            self._bar = None


def _bar() -> Any:
    from rich import progress
    from rich.console import Console

    columns = (
        progress.TextColumn("{task.description}", markup=False),
        progress.BarColumn(),
        progress.TaskProgressColumn(),
        progress.TimeRemainingColumn(compact=True, elapsed_when_finished=True),
    )
    return progress.Progress(*columns, console=Console(stderr=True))


# Progress and warnings of all commands of this process, on standard error.
say = ProgressLines()


# Largest number of warnings of a page on the terminal.
_WARNINGS = 10


def warn_all(texts: Sequence[str]) -> None:
    """Print the first warnings of a page, and the number of remaining warnings."""
    for text in texts[:_WARNINGS]:
        say.warn(f"warning: {one_line(text)}")
    if len(texts) > _WARNINGS:
        say.warn(f"and {counted(len(texts) - _WARNINGS, 'more warning')}, all on the page")


# Version of the output of ``--json`` (docs/reference/json.md), which increases when a key is renamed or removed.
SCHEMA = 1


def answered(value: dict[str, Any]) -> bool:
    """Print a JSON object with its schema version if ``--json`` is set, and return whether it was printed."""
    if say.as_json:
        # refuse NaN, which JSON does not have and browsers do not read; callers replace it by null
        print(json.dumps({"schema": SCHEMA, **value}, indent=1, allow_nan=False), flush=True)
    return say.as_json


def print_plan(plan: Any) -> None:
    """Print the plan of a command as a table of stages with their seconds, or as one JSON object."""
    if answered(plan.as_dict()):
        return
    rows = [[stage.name, stage.work, number(stage.seconds, "{:.1f}")] for stage in plan.stages]
    table(["stage", "work", "s"], rows, f"{plan.job}, not run")
    show(f"reads {counted(len(plan.inputs), 'file')}; would write {plan.output}")


def print_files(paths: Sequence[Path]) -> None:
    """Print the paths of the written files, one per line, or as one JSON object."""
    if not answered({"files": [str(path) for path in paths]}):
        for path in paths:
            show(path)


# Columns up to this width, such as numbers and times, are not wrapped [characters].
_FIXED = 20


def table(columns: list[str], rows: list[list[str]], title: str | None = None, width: int | None = None) -> None:
    """Print a table, or one paragraph per row if the terminal is too narrow for a table."""
    from rich.cells import cell_len
    from rich.console import Console
    from rich.table import Table

    # escape control characters before measuring widths, because an escape sequence is longer than its character
    rows = [[one_line(cell) for cell in row] for row in rows]
    columns, title = [one_line(name) for name in columns], title and one_line(title)
    # set the width, because rich uses 80 columns without a terminal. Set markup=False, because rich would read [words]
    # in a log or unit as styles.
    console = Console(width=width if width or sys.stdout.isatty() else 160, markup=False)
    needs = [max(map(cell_len, [*name.split(), *(row[i] for row in rows)])) for i, name in enumerate(columns)]
    # a border and a space on each side of a cell have a width of 3
    roomy = sum(max(need, cell_len(name)) + 3 for need, name in zip(needs, columns, strict=True)) < console.width
    if sum(min(need, _FIXED) + 3 for need in needs) + 1 > console.width:
        _paragraphs(columns, rows, title, console.width)
        return
    table = Table(title=title, title_justify="left")
    for column, need in zip(columns, needs, strict=True):
        table.add_column(column, overflow="fold", width=None if roomy or need > _FIXED else need)
    for row in rows:
        table.add_row(*row)
    console.print(table)


def page_table(item: Any) -> None:
    """Print a table of a page (:class:`~aerpaw_cmp.report.cards.Table`), or nothing if it has no rows."""
    from ..report.cards import cell

    forms = item.columns.values()
    rows = [[str(cell(value, form)) for value, form in zip(row, forms, strict=True)] for row in item.rows]
    if rows:
        table(list(item.columns), rows, item.caption)


def _paragraphs(columns: list[str], rows: list[list[str]], title: str | None, width: int) -> None:
    """Print each row as a paragraph: the first cell, then the names and values of the other cells."""
    import textwrap

    if title:
        show(title)
    for row in rows:
        lines = [""]
        for name, cell in zip(columns[1:], row[1:], strict=True):
            item = f"{name} {cell}"
            if lines[-1] and len(lines[-1]) + len(item) + 7 > width:  # indent and separator take 7 characters
                lines.append("")
            lines[-1] += f" | {item}" if lines[-1] else item
        show(row[0])
        for line in lines:
            show(textwrap.fill(line, width, initial_indent="    ", subsequent_indent="      ", break_on_hyphens=False))


def number(value: float | None, form: str) -> str:
    """Return a number as text in the given format, or a dash if the number is missing."""
    return "-" if value is None or math.isnan(value) else form.format(value)


def records(items: Sequence[Any], columns: Mapping[str, str], title: str | None = None) -> None:
    """Print a table of records or mappings, or nothing if there are no items.

    Parameters
    ----------
    items : sequence
        One item per row.
    columns : mapping of str to str
        For each heading, the attribute that the column shows: ``name``, ``name.part`` for a nested attribute, or
        ``name:.2f`` with a format.
    title : str, optional
        Line above the table.
    """
    if items:
        table(list(columns), [[_cell(item, what) for what in columns.values()] for item in items], title)


def _cell(item: Any, what: str) -> str:
    name, _, form = what.partition(":")
    value = item[name] if isinstance(item, Mapping) else attrgetter(name)(item)
    if isinstance(value, (tuple, list)):  # an interval
        known = [format(end, form) for end in value if end is not None and math.isfinite(end)]
        return " .. ".join(known) if len(known) == len(value) else f">= {known[0]}" if known else "-"
    return "-" if value is None else format(value, form)
