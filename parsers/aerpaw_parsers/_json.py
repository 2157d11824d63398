"""JSON lines: one object per line. All other lines are counted."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any

import numpy as np

from aerpaw_cmp.readers import FloatArray, IntArray, Lines, RejectedLine, dictionary, mostly

_MOST_LINES = 5000
# Largest total size [bytes] of incomplete objects that are tried over several lines, as a limit on time.
_MOST_TRIED = 64 << 20


@dataclass
class Objects:
    """The objects of a file.

    Parameters
    ----------
    row : int array, shape (n,)
        0-based first line of each object.
    values : list of dict, length n
    rejected : list of RejectedLine
        Lines that are not objects.
    more : int array
        0-based lines of objects that span several lines, except the first line of each object.
    closed : bool
        True if all objects are in an array that ends on its line.
    """

    row: IntArray
    values: list[dict[str, Any]]
    rejected: list[RejectedLine]
    more: IntArray
    closed: bool = False


def objects(lines: Lines) -> Objects:
    """Return the objects of a file. An object may span several lines.

    A file may also be one JSON array of objects, on one line or with its brackets on separate lines. Commas at the end
    of lines are ignored.
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
        listed = value if isinstance(value, list) else [value]  # one line may contain an array of all objects
        if listed and all(isinstance(item, dict) for item in listed):
            rows += [i] * len(listed)
            values += listed
        else:
            rejected.append(lines.reject(i, "not a JSON object" + " (truncated line?)" * (value is None)))
    closed = len(set(rows)) < len(rows)
    return Objects(np.array(rows, dtype=np.int64), values, rejected, np.array(more, dtype=np.int64), closed)


def _bare(text: bytes) -> bytes:
    return text.strip().lstrip(b"\xef\xbb\xbf").rstrip(b",")


def _loaded(text: bytes) -> tuple[Any, bool]:
    """Return the value of a text, None if it is not JSON, and whether it may begin an object over several lines."""
    try:
        return json.loads(text), False
    except json.JSONDecodeError as error:
        # an error at the end of the text can mean that the object continues on the next lines
        return None, text.startswith(b"{") and error.pos >= len(error.doc)
    except (ValueError, RecursionError):
        return None, False


def _several(lines: Lines, first: int) -> tuple[Any, int]:
    """Return the object that begins on a line, or None, and the line on which it ends."""
    end = lines.ends[min(first + _MOST_LINES, len(lines) - 1)]
    text = _bare(lines.data[lines.starts[first] : end]).decode("utf-8", "replace")
    try:
        value, length = json.JSONDecoder().raw_decode(text)
    except (ValueError, RecursionError):
        return None, first
    whole = not text[length:].split("\n", 1)[0].strip(" \t\r,]")
    return (value, first + text.count("\n", 0, length)) if whole else (None, first)


# A name and a value, and a line of such pairs.
_PAIR = r'([A-Za-z_][\w.-]{0,40})=("[^"\n]{0,200}"|[^\s"=,;]{0,80})'
_PAIRS = re.compile(rf"\s{{0,40}}{_PAIR}(?:[\s,;]{{1,4}}{_PAIR}){{2,60}}\s*$".encode())


def from_pairs(data: bytes) -> bytes:
    """Return lines of logfmt, such as ``time=... pci=12 rsrp=-83``, as lines of objects, and other data unchanged."""
    if not mostly(data, _PAIRS):
        return data
    lines = [dict(re.findall(_PAIR, line)) for line in data.decode("utf-8", "replace").split("\n")]
    texts = (json.dumps({name: text.strip('"') for name, text in line.items()}) if line else "" for line in lines)
    return "\n".join(texts).encode()


# The beginning of a file of objects, or of an array of objects.
BEGIN = re.compile(rb"(?:\xef\xbb\xbf)?[\s\[]*\{")
# An object at the beginning of a line. Programs may write messages before it. The pattern does not cross the end of a
# line, because the search of a file of empty lines would take seconds.
_ON_A_LINE = re.compile(rb"^(?:\xef\xbb\xbf)?[ \t\[]*\{", re.MULTILINE)


def beginning(head: bytes) -> list[dict[str, Any]]:
    """Return the objects on the first lines of a file for sniffers, or an object that spans several lines."""
    alone = (_loaded(_bare(line))[0] for line in head.split(b"\n")[:_ENTRIES])
    return [value for value in (*alone, first(head)) if isinstance(value, dict)]


def first(head: bytes) -> dict[str, Any] | None:
    """Return the first object of a file for sniffers, or None if it is longer than the sniffed bytes."""
    begin = _ON_A_LINE.search(head) if b"{" in head else None
    if begin is None:
        return None
    try:
        value, _ = json.JSONDecoder().raw_decode(head[begin.end() - 1 :].decode("utf-8", "replace"))
    except (ValueError, RecursionError):
        return None
    return value if isinstance(value, dict) else None


# Names of objects that group values without a meaning of their own.
_GROUPS = re.compile(
    r"(?:(?<=\.)|^)(?:(?:gps|gnss|pos(?:ition)?|loc(?:ation)?|coord(?:inate)?s?|geo|data|meta(?:data)?|info|sample|record"
    r"|measurement|_source|(?:decoded_?)?payload|fix|state|telemetry|uplink_?message|\w+_ids)\.)+"
)
# Largest nesting depth of objects and number of list entries that become columns.
_DEPTH, _ENTRIES = 6, 32
# Names of values in a list: 'gateways.0.rssi'.
LISTED = re.compile(r"(.*?)\.(\d{1,2})\.(.+)")


def flat(entry: dict[str, Any]) -> dict[str, str]:
    """Return the values of an object and of the objects inside as texts, by names such as ``cell.rsrp``.

    Examples
    --------
    >>> flat({"t": 1, "gps": {"lat": 35.7}, "cells": [{"pci": 4}, {"pci": 5}]})
    {'t': '1', 'lat': '35.7', 'cells.0.pci': '4', 'cells.1.pci': '5'}
    """
    written = dict(_values(entry))
    bare = Counter(_GROUPS.sub("", name, count=1) for name in written)
    short = {name: _GROUPS.sub("", name, count=1) for name in written}
    return {short[name] if bare[short[name]] == 1 else name: text for name, text in written.items()}


def readings(entry: dict[str, Any]) -> list[dict[str, str]]:
    """Return the readings of an object: one per receiver if it has a list of receivers with levels, else one.

    Examples
    --------
    >>> readings({"t": 1, "gateways": [{"gateway_id": "a", "rssi": -80}, {"gateway_id": "b", "rssi": -90}]})
    [{'t': '1', 'gateway': 'a', 'rssi': '-80'}, {'t': '1', 'gateway': 'b', 'rssi': '-90'}]
    """
    common, lists = flat(entry), dict[str, dict[str, dict[str, str]]]()
    for name, text in common.items():
        if (part := LISTED.fullmatch(name)) is not None:
            lists.setdefault(part[1], {}).setdefault(part[2], {})[_GROUPS.sub("", part[3])] = text
    for place, members in lists.items():
        known = {name: dictionary.meaning(name) for item in members.values() for name in item}
        roles = {name: what.quantity.role for name, what in known.items() if what is not None}
        named = [name for name in known if roles.get(name) == "identity" or name in ("id", "name")]
        if not named or "rss" not in roles.values() or "cell" in roles.values():
            continue
        rest = {name: text for name, text in common.items() if not name.startswith(f"{place}.")}
        return [
            {
                **rest,
                "gateway": "_".join(filter(None, map(item.pop, named, [""] * len(named)))),
                **_of_gateway(item, roles),
            }
            for item in members.values()
        ]
    return [common]


def _of_gateway(item: Mapping[str, str], roles: Mapping[str, str]) -> dict[str, str]:
    # The Things Network writes the RSSI twice. position and clock of a gateway are not used, because they do not
    # describe the device
    once = {name: text for name, text in item.items() if name != "channel_rssi" or "rssi" not in item}
    return {name if roles.get(name) in ("rss", "kpi") else f"gateway.{name}": text for name, text in once.items()}


def _values(value: Any, *names: str) -> Iterator[tuple[str, str]]:
    inside = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else None
    if inside is None:
        yield ".".join(names), "" if value is None else str(value)
    elif len(names) < _DEPTH:
        for key, item in islice(inside, _ENTRIES if isinstance(value, list) else None):
            yield from _values(item, *names, str(key))


def number(value: Any) -> float:
    """Return a number or the number in a text, NaN if it means 'unavailable'."""
    # a bool is an int in Python, but not a measurement
    if isinstance(value, bool) or value is None:
        return float("nan")
    try:
        converted = float(value)
    except (TypeError, ValueError, OverflowError):
        return float("nan")
    return float("nan") if converted in dictionary.UNAVAILABLE or abs(converted) > 1e300 else converted


def column(entries: Sequence[dict[str, Any]], *names: str) -> FloatArray:
    """Return a value of every object as a number, under the first of ``names`` that the object has."""
    return np.array([number(next((entry[name] for name in names if name in entry), None)) for entry in entries])


def inside(entry: dict[str, Any], name: str) -> dict[str, Any]:
    """Return an object within an object, or an empty object if it is missing."""
    value = entry.get(name)
    return value if isinstance(value, dict) else {}


def listed(entry: dict[str, Any], name: str) -> list[dict[str, Any]]:
    """Return a list of objects within an object."""
    value = entry.get(name)
    return [item for item in value if isinstance(item, dict)] if isinstance(value, list) else []


def bracket(line: bytes) -> str | None:
    """Return why a line is not an object, or None for the brackets of an array."""
    return None if line.strip() in (b"[", b"]") else "not a JSON object"
