"""Text of numbers, intervals and times on pages, and names of keys and files."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from markupsafe import Markup, escape

from ..common.jsonable import number_key
from ..logs.records import has_wall_clock

# K as a key of metrics.json and of rank.csv.
k_key = number_key


def iso_time(time: Any) -> Any:
    """Return times as ISO 8601 text with milliseconds and ``Z``. The text is empty for NaT."""
    instants = np.asarray(time, dtype="datetime64[ns]")
    # add half a millisecond, because NumPy truncates instead of rounding
    text = np.datetime_as_string((instants + np.timedelta64(500_000, "ns")).astype("datetime64[ms]"), timezone="UTC")
    return np.where(np.isnat(instants), "", text)


def safe_name(text: str) -> str:
    """Return a text that is safe as part of a file name.

    Examples
    --------
    >>> safe_name("LW1 USRP1"), safe_name("../a b"), safe_name("")
    ('LW1_USRP1', 'a_b', '_')
    """
    return re.sub(r"[^A-Za-z0-9.-]+", "_", text).strip("._")[:80] or "_"


def number(value: float | None, decimals: int = 1, unit: str = "") -> str:
    """Return a number as text. A missing number is an en dash.

    Examples
    --------
    >>> number(-3.14159, 2), number(float("nan")), number(-0.004, 2)
    ('−3.14', '–', '0.00')
    """
    if value is None or not math.isfinite(value):
        return "–"
    rounded = round(value, decimals) + 0.0  # adding 0.0 removes the sign of a number that rounds to zero
    text = f"{rounded:,.{decimals}f}".replace(",", "\u202f").replace("-", "\u2212")
    return f"{text}\u202f{unit}" if unit else text


def interval(value: tuple[float | None, float | None] | None, decimals: int = 1) -> str:
    """Return an interval as the text ``[low, high]``, or a lower bound as ``≥ low``.

    The text is empty for None and "no interval" if both ends are missing.
    """
    if value is None:
        return ""
    low, high = (math.nan if end is None else end for end in value)
    if not math.isfinite(low):
        return "no interval"
    return (
        f"[{number(low, decimals)}, {number(high, decimals)}]" if math.isfinite(high) else f"≥ {number(low, decimals)}"
    )


def percent(share: float | None, decimals: int = 0) -> str:
    """Return a share as a percentage. A missing share is an en dash."""
    return number(None if share is None else 100 * share, decimals, "%")


def minute(instant: str) -> str:
    """Return an ISO 8601 time of UTC to the minute. Other text is returned unchanged.

    Examples
    --------
    >>> minute("2026-11-23T06:11:20+00:00"), minute("later")
    ('2026-11-23 06:11 UTC', 'later')
    """
    parts = re.fullmatch(r"(\d{4}-\d\d-\d\d)T(\d\d:\d\d):\d\d(?:\.\d+)?(?:Z|\+00:00)", instant)
    return instant if parts is None else f"{parts[1]} {parts[2]} UTC"


def duration(seconds: float | None) -> str:
    """Return seconds as text with three significant digits, in ms below one second.

    Examples
    --------
    >>> duration(0.000412), duration(0.1731), duration(5.1913), duration(None)
    ('0.412\u202fms', '173\u202fms', '5.19\u202fs', '–')
    """
    if seconds is None or not math.isfinite(seconds):
        return "–"
    value, unit = (1000.0 * seconds, "ms") if seconds < 1.0 else (seconds, "s")
    return number(value, 0 if value >= 100 else 1 if value >= 10 else 2 if value >= 1 else 3, unit)


def flat(settings: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, str]]:
    """Yield nested settings as dotted names and plain text. Keys without a value are omitted.

    An interval without an upper end becomes ``≥ low``. The records of a list, such as the logs of a flight, are
    numbered.

    Examples
    --------
    >>> list(flat({"a": {"b_ci95_db": (5.5, None), "c": None}, "d": [1, 2], "e_ci95": (None, None)}))
    [('a.b_ci95_db', '≥ 5.5'), ('d', '1, 2')]
    >>> list(flat({"logs": [{"path": "a.txt", "node": "LW1", "kind": None, "skip": []}, {"path": "b.txt"}]}))
    [('logs.1', 'path: a.txt, node: LW1'), ('logs.2', 'path: b.txt')]
    """
    for key, value in settings.items():
        name = f"{above}.{key}" if above else str(key)
        if isinstance(value, Mapping):
            yield from flat(value, name)
        elif isinstance(value, (list, tuple)) and any(isinstance(part, Mapping) for part in value):
            for number, part in enumerate(value, 1):
                yield f"{name}.{number}", ", ".join(": ".join(row) for row in flat(part))
        elif (text := _plain(name, value)) is not None:
            yield name, text


def _plain(name: str, value: Any) -> str | None:
    """Return the text of one setting or number, or None if it is not set or empty."""
    if "ci95" in name and isinstance(value, (list, tuple)) and None in value:
        return None if value[0] is None else f"≥ {short(value[0])}"
    if isinstance(value, (list, tuple)):
        return ", ".join(map(short, value)) or None
    return None if value is None else short(value)


def clock(instant: Any, start: Any) -> str:
    """Return the time of day (UTC), or seconds after ``start`` if the log has only relative times.

    Examples
    --------
    >>> clock(np.datetime64("2025-06-01T14:00:03.2"), np.datetime64("2025-06-01T14:00:00"))
    '14:00:03'
    >>> clock(np.datetime64("1970-01-01T00:00:03.2"), np.datetime64("1970-01-01"))
    '3.2'
    """
    if has_wall_clock(start):
        return str(iso_time([instant])[0])[11:19]
    return number(float((instant - start) / np.timedelta64(1, "s")))


def more(rows: Sequence[Any], limit: int) -> str:
    """Return a note for the caption of a table that does not show all rows.

    Examples
    --------
    >>> more([1, 2, 3], 2), more([1, 2], 2)
    (' (the first 2 of 3; the files in this folder contain all)', '')
    """
    return f" (the first {limit} of {len(rows)}; the files in this folder contain all)" if len(rows) > limit else ""


def short(value: Any) -> str:
    """Return a value as text with at most 6 digits. None is an en dash. metrics.json has all digits."""
    if value is None:
        return "–"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def cut(text: str, most: int = 120) -> str:
    """Return a text of at most ``most`` characters. A longer text ends in an ellipsis."""
    return text if len(text) <= most else f"{text[: most - 1]}…"


def coded(text: str) -> Markup:
    """Return an escaped text in which the parts between backquotes are formatted as code.

    Examples
    --------
    >>> str(coded("Next: `a < b`."))
    'Next: <code>a &lt; b</code>.'
    """
    parts = str(text).replace("(95 %)", "(95\N{NO-BREAK SPACE}%)").split("`")
    return Markup("").join(
        Markup("<code>{}</code>").format(part) if i % 2 else escape(part) for i, part in enumerate(parts)
    )
