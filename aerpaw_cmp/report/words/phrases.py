"""Sentences of tables filled with the numbers of a verdict."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ...common.units import Printed
from ...compare.judge.verdicts import Verdict


def filled(texts: Sequence[str], **facts: Any) -> list[str]:
    """Texts with numbers and names put in."""
    known = {name: Printed(fact) if isinstance(fact, float) else fact for name, fact in facts.items()}
    return [text.format_map(known) for text in texts]


def said_of(verdict: Verdict, table: Mapping[str, tuple[str, str]], **facts: Any) -> str:
    """Sentence and action that a page's table has for the cause of a verdict; nothing where the table has none."""
    if verdict.cause not in table:
        return ""
    low, high = verdict.interval
    numbers = {"effect": verdict.effect, "size": abs(verdict.effect), "low": low, "high": high}
    text, action = filled(table[verdict.cause], **numbers, where=verdict.where, **facts)
    return f"{text} Next: {action}." if action else text
