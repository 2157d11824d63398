"""The logs that a file was learned from, by the SHA-256 of their content: written into it, and read from any such file.

Nothing learned is scored on a log that it was learned from. Names, folders and archives of a log may change: what it
holds says which one it is.
"""

from __future__ import annotations

import re
from collections.abc import Iterable

# Of YAML and JSON files; in front of a colon in the comments of a table.
KEY = "trained_on"

_LIST = re.compile(KEY + r"""["']?[ \t]*:[\s\["',-]*((?:[0-9a-f]{64}[\s"',#-]*)+)""")
_DIGEST = re.compile(r"[0-9a-f]{64}")


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


def union(*lists: Iterable[str]) -> tuple[str, ...]:
    """All of several lists, each log once, in order."""
    return tuple(dict.fromkeys(digest for item in lists for digest in item))
