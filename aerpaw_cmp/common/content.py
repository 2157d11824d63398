"""SHA-256 of the content of records, arrays and shapes: the name of what was made of them."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from shapely.geometry.base import BaseGeometry


def content_digest(*values: Any) -> str:
    """SHA-256, in hexadecimal, of values and all that they hold; an object that hides its content is like no other."""
    digest = hashlib.sha256()
    for value in values:
        _feed(digest, value)
    return digest.hexdigest()


def _feed(digest: Any, value: Any) -> None:
    # the bytes of an array of objects are addresses, others in each process
    if isinstance(value, np.ndarray) and value.dtype != object:
        digest.update(f"{value.dtype}{value.shape}".encode() + np.ascontiguousarray(value).tobytes())
    elif dataclasses.is_dataclass(value):
        # what a record leaves out of its comparison is made of the rest: equal records have one name
        _feed(digest, [getattr(value, item.name) for item in dataclasses.fields(value) if item.compare])
    elif isinstance(value, BaseGeometry):
        digest.update(value.wkb)
    elif isinstance(value, Mapping):
        _feed(digest, list(value.items()))
    elif isinstance(value, (list, tuple, np.ndarray)):
        # with its length, so that [[1], 2] is not [[1, 2]]
        digest.update(f"[{len(value)}".encode())
        for item in value:
            _feed(digest, item)
    else:
        # not str: the text '1' is another value than the number
        digest.update(repr(value).encode() + b"\n")
