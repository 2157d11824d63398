"""Numbers of things in words."""

from __future__ import annotations


def counted(number: int, noun: str, plural: str = "") -> str:
    """A number with its noun, thousands set apart as in the tables; the plural has an s unless it is given.

    Examples
    --------
    >>> counted(1, "task"), counted(0, "task"), len(counted(6608, "task").split())
    ('1 task', '0 tasks', 3)
    >>> counted(1, "row is", "rows are"), counted(2, "row is", "rows are")
    ('1 row is', '2 rows are')
    """
    # a narrow blank at which no line breaks: a comma is the decimal sign of many readers
    return f"{number:,} {noun if number == 1 else plural or noun + 's'}".replace(",", "\N{NARROW NO-BREAK SPACE}")
