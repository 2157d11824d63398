"""JSON lines: one object per line, with the account of those that are none."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from aerpaw_cmp.common.units import FloatArray, IntArray
from aerpaw_cmp.logs.records import RejectedLine

from . import _lines

SENTINELS = (2147483647, -2147483648, 9223372036854775807, 268435455, 65535)
"""What Android and modems write for 'unavailable'."""


def objects(lines: _lines.Lines) -> tuple[IntArray, list[dict[str, Any]], list[RejectedLine]]:
    """0-based lines and objects, and the lines that are no JSON object.

    A file that is one JSON array with an object per line is read, too: brackets alone on a line and commas at the end
    of lines count as nothing.
    """
    rows: list[int] = []
    found: list[dict[str, Any]] = []
    rejected: list[RejectedLine] = []
    for i in np.flatnonzero(~lines.blank).tolist():
        text = lines.raw(i).strip().lstrip(b"\xef\xbb\xbf").rstrip(b",")
        if text in (b"[", b"]"):
            continue
        try:
            one = json.loads(text)
        except (ValueError, RecursionError):
            rejected.append(lines.reject(i, "no JSON object (torn line?)"))
            continue
        if isinstance(one, dict):
            rows.append(i)
            found.append(one)
        else:
            rejected.append(lines.reject(i, "no JSON object"))
    return np.array(rows, dtype=np.int64), found, rejected


def first(head: bytes) -> dict[str, Any] | None:
    """The first object of a file, for sniffers; of a first line longer than what they see, None."""
    for line in head.split(b"\n", 3)[:3]:
        text = line.strip().lstrip(b"\xef\xbb\xbf").lstrip(b"[").rstrip(b",")
        if not text:
            continue
        try:
            one = json.loads(text)
        except (ValueError, RecursionError):
            return None
        return one if isinstance(one, dict) else None
    return None


def number(value: Any) -> float:
    """A number or the text of one; what stands for 'unavailable' is NaN."""
    if isinstance(value, bool) or value is None:
        return float("nan")
    try:
        made = float(value)
    except (TypeError, ValueError, OverflowError):
        return float("nan")
    return float("nan") if made in SENTINELS or abs(made) > 1e300 else made


def column(found: list[dict[str, Any]], *names: str) -> FloatArray:
    """A key of every object as numbers: of several names, the first that an object has."""
    return np.array([number(next((one[name] for name in names if name in one), None)) for one in found])


def inside(one: dict[str, Any], name: str) -> dict[str, Any]:
    """An object within an object, empty where there is none."""
    value = one.get(name)
    return value if isinstance(value, dict) else {}


def listed(one: dict[str, Any], name: str) -> list[dict[str, Any]]:
    """A list of objects within an object."""
    value = one.get(name)
    return [item for item in value if isinstance(item, dict)] if isinstance(value, list) else []


def bracket(line: bytes) -> str | None:
    """Reason for lines that are no object: brackets of an array around the lines are nothing."""
    return None if line.strip() in (b"[", b"]") else "no JSON object"
