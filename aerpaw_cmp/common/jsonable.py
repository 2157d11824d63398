"""Conversion of values for JSON."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from .units import AnyArray


def number_key(number: float) -> str:
    """Return a number as text for a JSON key or a column name.

    Examples
    --------
    >>> number_key(1000.0), number_key(12.5)
    ('1000', '12.5')
    """
    return f"{number:.10g}"


def json_safe(value: Any) -> Any:
    """Return a copy for JSON. NaN and infinity become None, arrays become lists, and records become mappings.

    A field of a record (dataclass) is omitted if its value and its default are both None, because the field does not
    apply to the record.

    Examples
    --------
    >>> json_safe({"rmse_db": float("nan"), 10: np.array([1, 2])})
    {'rmse_db': None, '10': [1, 2]}
    """
    # is_dataclass is also true for a class, which has no field values
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return json_safe(fields_of(value))
    if isinstance(value, Mapping):
        return {number_key(key) if isinstance(key, float) else str(key): json_safe(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return _listed(value)
    if isinstance(value, (list, tuple, set, frozenset)):
        # sort sets, because the order of a set of strings differs between processes
        return [json_safe(item) for item in (sorted(value) if isinstance(value, (set, frozenset)) else value)]
    # test this before integers, because bool is a subclass of int
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    if isinstance(value, (int, np.integer)):
        return int(value)
    if isinstance(value, (float, np.floating)):
        number = float(value)
        return number if math.isfinite(number) else None
    if isinstance(value, np.datetime64) and np.isnat(value):
        return None
    return value if value is None else str(value)


def json_object(**entries: Any) -> dict[str, Any]:
    """Return entries by name, with their values converted for JSON."""
    return {name: json_safe(value) for name, value in entries.items()}


def _listed(array: AnyArray) -> Any:
    if array.dtype.kind == "f":  # convert large maps in one pass
        # use Python's floats, because JSON writes them with the fewest digits that restore the same value
        boxed = array.astype(object)
        boxed[~np.isfinite(array)] = None
        return boxed.tolist()
    return json_safe(array.tolist() if array.dtype.kind != "M" else array.astype(str).tolist())


def fields_of(record: Any) -> dict[str, Any]:
    """Return the fields of a dataclass by name, without optional fields that are None."""
    return {
        field.name: getattr(record, field.name)
        for field in dataclasses.fields(record)
        if not (field.default is None and getattr(record, field.name) is None)
    }
