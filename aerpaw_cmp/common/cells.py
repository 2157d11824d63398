"""Text cells of CSV files: names come from strangers' logs, and a spreadsheet runs what begins with = + - or @."""

from __future__ import annotations

import re
from typing import Any

# also behind a semicolon: where that parts cells, what follows begins a cell
# and an apostrophe of the log itself: unguarded() would take it for one of ours
_BEGINNING = re.compile(r"(^|;)(?=[=+\-@\t\r'])")
_GUARDED = re.compile(r"(^|;)'")
# within a comment a separator begins a cell, too; numbers stay as they are, since some comments hold tables of them
_IN_COMMENT = re.compile(r"([,;\t]\s*)(?=[=@]|[+\-](?![\d.]|inf|nan))")


def guarded(table: Any) -> Any:
    """A data frame whose texts no spreadsheet takes for formulas: an apostrophe stands before those that it would.

    Numbers stay numbers. :func:`unguarded` gives the texts back.
    """
    guarded_columns = {}
    for name in table.columns:
        if table[name].dtype.kind == "O" or str(table[name].dtype).startswith("str"):
            # by distinct word: a million rows hold a few names
            words = [word for word in table[name].unique() if isinstance(word, str) and _BEGINNING.search(word)]
            if words:
                texts = table[name].astype(object)
                guarded_columns[name] = texts.replace({word: guarded_text(word) for word in words})
    # the table of the caller stays as it is: numbers are read from it afterwards
    return table.assign(**guarded_columns) if guarded_columns else table


def guarded_text(word: str) -> str:
    """A cell that no spreadsheet takes for a formula.

    Examples
    --------
    >>> guarded_text("=1+1"), guarded_text("LW1;=1+1"), guarded_text("LW1")
    ("'=1+1", "LW1;'=1+1", 'LW1')
    """
    return _BEGINNING.sub(r"\1'", word)


def guarded_comment(line: str) -> str:
    """Return a comment line of a table whose parts between separators are not formulas.

    Examples
    --------
    >>> guarded_comment("# learned: f1, =1+1"), guarded_comment("# pair: 1.5,-0.3")
    ("# learned: f1, '=1+1", '# pair: 1.5,-0.3')
    """
    return _IN_COMMENT.sub(r"\1'", line)


def unguarded(word: str) -> str:
    """The text of a cell that :func:`guarded` wrote.

    Examples
    --------
    >>> unguarded("'=1+1"), unguarded("LW1")
    ('=1+1', 'LW1')
    """
    return _GUARDED.sub(r"\1", word)
