"""Text cells of CSV files: names come from strangers' logs, and a spreadsheet runs what begins with = + - or @."""

from __future__ import annotations

from typing import Any

_FORMULA = ("=", "+", "-", "@", "\t", "\r", "'")


def guarded(table: Any) -> Any:
    """A data frame whose texts no spreadsheet takes for formulas: an apostrophe stands before those that it would.

    Numbers stay numbers. :func:`unguarded` gives the texts back.
    """
    guarded_columns = {}
    for name in table.columns:
        if table[name].dtype.kind == "O" or str(table[name].dtype).startswith("str"):
            words = [word for word in table[name].unique() if isinstance(word, str) and word.startswith(_FORMULA)]
            if words:
                texts = table[name].astype(object)
                guarded_columns[name] = texts.replace({word: f"'{word}" for word in words})
    return table.assign(**guarded_columns) if guarded_columns else table


def unguarded(word: str) -> str:
    """The text of a cell that :func:`guarded` wrote.

    Examples
    --------
    >>> unguarded("'=1+1"), unguarded("LW1")
    ('=1+1', 'LW1')
    """
    return word[1:] if word.startswith("'") else word
