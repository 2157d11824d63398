"""JSON lines: one object per line, with the account of those that are none."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import numpy as np

from aerpaw_cmp.common.units import FloatArray, IntArray
from aerpaw_cmp.logs import rows as _rows
from aerpaw_cmp.logs import text as _text
from aerpaw_cmp.logs.records import ReadResult, RejectedLine
from aerpaw_cmp.readers import dictionary

_MOST_LINES = 5000
# Bytes of objects over several lines that were looked at in vain [bytes]: a limit on time.
_MOST_TRIED = 64 << 20


@dataclass
class Objects:
    """Objects of a file.

    Parameters
    ----------
    row : int array, shape (n,)
        0-based line on which each begins.
    values : list of dict, length n
    rejected : list of RejectedLine
        Lines that are no object.
    more : int array
        0-based further lines of objects that are written over several.
    closed : bool
        Does an array close all of them on its line?
    """

    row: IntArray
    values: list[dict[str, Any]]
    rejected: list[RejectedLine]
    more: IntArray
    closed: bool = False


def objects(lines: _text.Lines) -> Objects:
    """The objects of a file, one per line or each over several (as programs print them for people).

    A file that is one JSON array of them is read, too, on one line or with brackets alone on a line; commas at the end
    of lines count as nothing.
    """
    rows: list[int] = []
    values: list[dict[str, Any]] = []
    rejected: list[RejectedLine] = []
    more: list[int] = []
    tried = 0
    for i in np.flatnonzero(~lines.blank).tolist():
        if more and i <= more[-1]:
            continue
        text = _bare(lines.raw(i))
        if text in (b"[", b"]"):
            continue
        value, unclosed = _loaded(text)
        if unclosed and tried < _MOST_TRIED:
            value, last = _several(lines, i)
            more += range(i + 1, last + 1)
            tried += 0 if value is not None else int(lines.ends[min(i + _MOST_LINES, len(lines) - 1)] - lines.starts[i])
        listed = value if isinstance(value, list) else [value]  # an array of all of them on a line
        if listed and all(isinstance(item, dict) for item in listed):
            rows += [i] * len(listed)
            values += listed
        else:
            rejected.append(lines.reject(i, "no JSON object (torn line?)" if value is None else "no JSON object"))
    closed = len(set(rows)) < len(rows)
    return Objects(np.array(rows, dtype=np.int64), values, rejected, np.array(more, dtype=np.int64), closed)


def _bare(text: bytes) -> bytes:
    return text.strip().lstrip(b"\xef\xbb\xbf").rstrip(b",")


def _loaded(text: bytes) -> tuple[Any, bool]:
    """Value of a text, None where it is no JSON; and whether it begins an object whose rest may stand on more lines."""
    try:
        return json.loads(text), False
    except json.JSONDecodeError as error:
        # the error at the very end: what is missing may stand on the next lines
        return None, text.startswith(b"{") and error.pos >= len(error.doc)
    except (ValueError, RecursionError):
        return None, False


def _several(lines: _text.Lines, first: int) -> tuple[Any, int]:
    """Object that begins on one line and ends on a later one, and that line; None where there is none."""
    end = lines.ends[min(first + _MOST_LINES, len(lines) - 1)]
    text = _bare(lines.data[lines.starts[first] : end]).decode("utf-8", "replace")
    try:
        value, length = json.JSONDecoder().raw_decode(text)
    except (ValueError, RecursionError):
        return None, first
    whole = not text[length:].split("\n", 1)[0].strip(" \t\r,]")
    return (value, first + text.count("\n", 0, length)) if whole else (None, first)


def first(head: bytes) -> dict[str, Any] | None:
    """The first object of a file, for sniffers; of a first line longer than what they see, None."""
    for line in head.split(b"\n", 3)[:3]:
        text = line.strip().lstrip(b"\xef\xbb\xbf").lstrip(b"[").rstrip(b",")
        if not text:
            continue
        value, _ = _loaded(text)
        if value is None:  # perhaps one over several lines
            place = head.find(b"{")
            try:
                value, _ = json.JSONDecoder().raw_decode(head[max(place, 0) :].decode("utf-8", "replace"))
            except (ValueError, RecursionError):
                return None
        return value if isinstance(value, dict) else None
    return None


def number(value: Any) -> float:
    """A number or the text of one; what stands for 'unavailable' is NaN."""
    # a bool is an int in Python, and no measurement
    if isinstance(value, bool) or value is None:
        return float("nan")
    try:
        converted = float(value)
    except (TypeError, ValueError, OverflowError):
        return float("nan")
    return float("nan") if converted in dictionary.UNAVAILABLE or abs(converted) > 1e300 else converted


def column(entries: list[dict[str, Any]], *names: str) -> FloatArray:
    """A key of every object as numbers: of several names, the first that an object has."""
    return np.array([number(next((entry[name] for name in names if name in entry), None)) for entry in entries])


def inside(entry: dict[str, Any], name: str) -> dict[str, Any]:
    """An object within an object, empty where there is none."""
    value = entry.get(name)
    return value if isinstance(value, dict) else {}


def listed(entry: dict[str, Any], name: str) -> list[dict[str, Any]]:
    """A list of objects within an object."""
    value = entry.get(name)
    return [item for item in value if isinstance(item, dict)] if isinstance(value, list) else []


def ue_ranks(rows: _rows.Rows, ues: list[tuple[int, dict[str, Any]]]) -> ReadResult:
    """Rank streams of UEs, each with its row; what a key holds of the downlink is said by the dictionary."""
    entries = [ue for _, ue in ues]
    none = np.full(len(entries), np.nan)
    columns = {"rank": none, "cqi": none, "mcs": none, "rnti": column(entries, "rnti")}
    for key in dict.fromkeys(key for entry in entries for key in entry):
        what = dictionary.meaning(key)
        if what is not None and not what.indirect and (name := what.quantity.name.lower()) in _OF_UE:
            before = columns.get(name, none)
            columns[name] = np.where(np.isnan(before), column(entries, key), before)
    pick = np.array([i for i, _ in ues], dtype=np.int64)
    return rows.result(_rows.mean_rank(rows, columns.pop("rank"), columns, pick=pick))


_OF_UE = ("rank", "cqi", "mcs", "pci")


def bracket(line: bytes) -> str | None:
    """Reason for lines that are no object: brackets of an array around the lines are nothing."""
    return None if line.strip() in (b"[", b"]") else "no JSON object"
