"""What a text format costs: its expression, its columns and its text. ``python -m tests.parsers.test_lengths`` prints all."""

from __future__ import annotations

import ast
from pathlib import Path

import aerpaw_parsers

FOLDER = Path(aerpaw_parsers.__file__).parent
SMALL = ("aadm_snr", "controller_log", "quectel_ri", "srsenb_log", "srsue_log", "vehicle_log")
"""Formats of lines that one expression describes."""


def lines_of(name: str) -> tuple[int, int]:
    """Lines of a module that hold anything, and those that are code: without comments and docstrings."""
    text = (FOLDER / f"{name}.py").read_text()
    filled = {i for i, line in enumerate(text.splitlines(), 1) if line.strip()}
    code = {i for i in filled if not text.splitlines()[i - 1].lstrip().startswith("#")}
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            code -= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    return len(filled), len(code)


def table() -> str:
    """A line per reader module, the shortest first."""
    names = sorted(path.stem for path in FOLDER.glob("[a-z]*.py"))
    rows = sorted((*lines_of(name)[::-1], name) for name in names)
    return "\n".join(f"{name:16} {code:4} lines of code, {filled:4} with text" for code, filled, name in rows)


def test_a_format_of_lines_costs_at_most_forty() -> None:
    found = {name: lines_of(name)[1] for name in SMALL}
    assert max(found.values()) <= 40, found


if __name__ == "__main__":
    print(table())  # noqa: T201
