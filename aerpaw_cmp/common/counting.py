"""Numbers of things in words."""

from __future__ import annotations


def counted(number: int, noun: str) -> str:
    """A number with its noun, thousands set apart as in the tables.

    Examples
    --------
    >>> counted(1, "task"), counted(0, "task"), len(counted(6608, "task").split())
    ('1 task', '0 tasks', 3)
    """
    return f"{number:,} {noun}{'' if number == 1 else 's'}".replace(",", "\N{NARROW NO-BREAK SPACE}")
