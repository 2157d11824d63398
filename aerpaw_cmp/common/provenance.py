"""The logs that a file was learned from, by SHA-256 and by marks: written into it, and read from any such file.

Nothing learned is scored on a log that it was learned from. Names, folders and archives of a log may change: its
SHA-256 says which one it is, and where its bytes changed too, its marks (:mod:`aerpaw_cmp.flight.marks`).
"""

from __future__ import annotations

import re
from collections.abc import Iterable

# Of YAML and JSON files; in front of a colon in the comments of a table.
KEY, MARKS = "trained_on", "marks"

# one pattern for a YAML list of either style, an array of JSON and the comment of a table
_LIST = re.compile(KEY + r"""["']?[ \t]*:[\s\["',-]*((?:[0-9a-f]{64}[\s"',#-]*)+)""")
_DIGEST = re.compile(r"[0-9a-f]{64}")
_MARKS = re.compile(MARKS + r"""["']?[ \t]*:[\s\["',-]*((?:[0-9a-f.]{100,}[\s"',#-]*)+)""")
_MARK = re.compile(r"[0-9a-f.]{100,}")


def trained_on(text: str) -> tuple[str, ...]:
    """SHA-256 of every log that a learned file names: an antenna table, a receiver, calibrated.yaml; none of others.

    Examples
    --------
    >>> trained_on("# trained_on: " + "a" * 64 + " " + "b" * 64)[1][:3]
    'bbb'
    >>> trained_on('{"trained_on": []}')
    ()
    """
    return union(*(_DIGEST.findall(part) for part in _LIST.findall(text)))


def marks(text: str) -> tuple[str, ...]:
    """Marks of the logs that a learned file was learned from, as :func:`trained_on`.

    Examples
    --------
    >>> [mark[:3] for mark in marks("COMMENT marks: " + "7" * 120 + " " + "8" * 120)]
    ['777', '888']
    """
    return union(*(_MARK.findall(part) for part in _MARKS.findall(text)))


def union(*lists: Iterable[str]) -> tuple[str, ...]:
    """All of several lists, each log once, in order."""
    return tuple(dict.fromkeys(digest for item in lists for digest in item))
