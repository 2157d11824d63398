"""The SHA-256 of the content of records, arrays and shapes, used as a cache key.

The module also reads the training logs that a learned file lists by their SHA-256 and their fingerprints (``marks``).

No learned model is scored on its training logs. The name, folder or archive of a log may change. A log is therefore
identified by its SHA-256, or by its fingerprints if its bytes were changed (:mod:`aerpaw_cmp.flight.training`).
"""

from __future__ import annotations

import dataclasses
import hashlib
import re
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from shapely.geometry.base import BaseGeometry


def content_digest(*values: Any) -> str:
    """Return the SHA-256, in hexadecimal, of values and their contents.

    Objects of other types are digested by their ``repr``. If it contains their address, their digests are never equal.
    """
    digest = hashlib.sha256()
    for value in values:
        _feed(digest, value)
    return digest.hexdigest()


def _feed(digest: Any, value: Any) -> None:
    # the bytes of an array of objects are addresses, which differ between processes
    if isinstance(value, np.ndarray) and value.dtype != object:
        digest.update(f"{value.dtype}{value.shape}".encode() + np.ascontiguousarray(value).tobytes())
    elif dataclasses.is_dataclass(value):
        # skip fields that are excluded from comparison: they are derived from the other fields, so equal records get
        # equal digests
        _feed(digest, [getattr(value, item.name) for item in dataclasses.fields(value) if item.compare])
    elif isinstance(value, BaseGeometry):
        digest.update(value.wkb)
    elif isinstance(value, Mapping):
        _feed(digest, list(value.items()))
    elif isinstance(value, (list, tuple, np.ndarray)):
        # include the length, so that [[1], 2] and [[1, 2]] have different digests
        digest.update(f"[{len(value)}".encode())
        for item in value:
            _feed(digest, item)
    else:
        # use repr, because the text '1' and the number 1 are different values
        digest.update(repr(value).encode() + b"\n")


# Keys in YAML and JSON files. In the comments of a table, a colon follows the key.
KEY, MARKS = "trained_on", "marks"


def _listed(text: str, key: str, entry: str) -> tuple[str, ...]:
    """Return the entries after a key in YAML lists (block or flow style), JSON arrays, and comments of tables."""
    lists = re.findall(key + rf"""["']?[ \t]*:[\s\["',-]*((?:{entry}[\s"',#-]*)+)""", text)
    return union(*(re.findall(entry, part) for part in lists))


def trained_on(text: str) -> tuple[str, ...]:
    """Return the SHA-256 of every log that a learned file lists, such as an antenna table, receiver or calibrated.yaml.

    Examples
    --------
    >>> trained_on("# trained_on: " + "a" * 64 + " " + "b" * 64)[1][:3]
    'bbb'
    >>> trained_on('{"trained_on": []}')
    ()
    """
    return _listed(text, KEY, "[0-9a-f]{64}")


def marks(text: str) -> tuple[str, ...]:
    """Return the fingerprints of every log that a learned file lists, like :func:`trained_on`.

    Examples
    --------
    >>> [mark[:3] for mark in marks("COMMENT marks: " + "7" * 120 + " " + "8" * 120)]
    ['777', '888']
    """
    return _listed(text, MARKS, "[0-9a-f.]{100,}")


def union(*lists: Iterable[str]) -> tuple[str, ...]:
    """Return the entries of several lists without duplicates, in order."""
    return tuple(dict.fromkeys(digest for item in lists for digest in item))
