"""Dates and times in the forms that programs other than AERPAW's write, brought to one: ``YYYY-mm-dd HH:MM:SS.f``.

Which of two readings of ``03/04/2025`` holds is decided by the whole column; where it says nothing the month comes
first and a warning says so.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np

from aerpaw_cmp.common.units import AnyArray, FloatArray
from aerpaw_cmp.logs.readers import ReadOptions

from . import _alike, _time

_CLOCK = r"[T _,]{0,2}(\d{1,2})[:.](\d\d)(?:[:.](\d\d(?:[.,:]\d{1,9})?))? ?([AaPp][Mm])?"
_ZONE = r" ?(Z|UTC|GMT|[+-]\d\d:?\d\d)?"
_YEAR_FIRST = re.compile(r"(\d{4})[-/._](\d{1,2})[-/._](\d{1,2})" + _CLOCK + _ZONE)
_YEAR_LAST = re.compile(r"(\d{1,2})([-/.])(\d{1,2})\2(\d{4})" + _CLOCK + _ZONE)
_WORD_MONTH = re.compile(r"(\d{1,2})[- ]?([A-Z][a-z]{2})[a-z]{0,6}[- ]?(\d{4}|\d\d)" + _CLOCK + _ZONE)
_DIGITS = re.compile(r"(20\d\d)(\d\d)(\d\d)[T_ -]?(\d\d)(\d\d)(\d\d(?:\.\d{1,9})?)()" + _ZONE)
_OF_DAY = re.compile(r"T?(\d{1,2}):(\d\d):(\d\d(?:[.,]\d{1,9})?) ?([AaPp][Mm])?" + _ZONE)
_NUMBER = re.compile(r"[-+]?\d{1,20}(?:[.,]\d{0,12})?(?:[eE][-+]?\d{1,3})?")
_COMMON = re.compile((_time.TIME + rb"(?:Z|[+-]\d\d:\d\d)?").decode())
_MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")
_IN_NAME = (
    re.compile(r"(?<!\d)(20\d\d)[-_.]?(\d\d)[-_.]?(\d\d)(?!\d)"),
    re.compile(r"(?<!\d)(\d\d)([A-Z][a-z]{2})(\d\d)(?!\d)"),
)
"""Dates with hyphens or none, and Nemo's year, month, day: its summary of ``24Feb09`` says ``2024 Feb 09``."""


def date_in_name(name: str) -> str | None:
    """The date that a file name carries.

    Examples
    --------
    >>> date_in_name("24Feb09_172055.1.gpx"), date_in_name("2022-06-10_19:52:44_log.txt"), date_in_name("60m.csv")
    ('2024-02-09', '2022-06-10', None)
    """
    for pattern in _IN_NAME:
        for found in pattern.finditer(name):
            year, month, day = found.groups()
            year = year if len(year) == 4 else f"20{year}"
            number = int(month) if month.isdigit() else _month(month)
            if 1 <= number <= 12 and 1 <= int(day) <= 31:
                return f"{year}-{number:02d}-{int(day):02d}"
    return None


def _month(word: str) -> int:
    return _MONTHS.index(word[:3].lower()) + 1 if word[:3].lower() in _MONTHS else 0


def _written(year: str, month: int, day: str, clock: Sequence[str | None], zone: str | None) -> bytes:
    """One time in the common form; ``-`` where it is no time of the day."""
    hour, minute, second, half = (clock[0] or "0", clock[1] or "0", clock[2] or "0", clock[3])
    number = int(hour)
    if half:
        number = number % 12 + (12 if half.lower() == "pm" else 0)
    whole, _, fraction = re.sub("[,:]", ".", second).partition(".")
    text = f"{year}-{month:02d}-{int(day):02d} {number:02d}:{int(minute):02d}:{int(whole):02d}"
    end = "Z" if zone in ("UTC", "GMT") else zone or ""
    return (text + (f".{fraction}" if fraction else "") + end).encode()


def _dated(text: str, day_first: bool) -> bytes | None:
    if found := _YEAR_FIRST.fullmatch(text) or _DIGITS.fullmatch(text):
        return _written(found[1], int(found[2]), found[3], found.groups()[3:7], found[8])
    if found := _YEAR_LAST.fullmatch(text):
        day, month = (found[1], found[3]) if day_first else (found[3], found[1])
        return _written(found[4], int(month), day, found.groups()[4:8], found[9])
    if found := _WORD_MONTH.fullmatch(text):
        year = found[3] if len(found[3]) == 4 else f"20{found[3]}"
        return _written(year, _month(found[2]), found[1], found.groups()[3:7], found[8])
    return None


def _dates(part: _alike.Alike, day_first: bool) -> AnyArray:
    """Times of one form in the common form, as :func:`_dated` writes each."""
    found = _YEAR_FIRST.fullmatch(part.first) or _YEAR_LAST.fullmatch(part.first) or _WORD_MONTH.fullmatch(part.first)
    if found is None:
        return np.full(len(part), b"-")
    span = _alike.spans(found)
    if found.re is _YEAR_FIRST:
        return _common(part, span[1:9])
    if found.re is _YEAR_LAST:
        day, month = (1, 3) if day_first else (3, 1)
        return _common(part, [span[4], span[month], span[day], *span[5:]])
    return _common(part, [span[3], span[2], span[1], *span[4:]])


def _common(part: _alike.Alike, span: Sequence[tuple[int, int]]) -> AnyArray:
    """The common form from the places of year, month, day, hour, minute, second, half of the day and zone."""
    year, month, _day, _hour, _minute, second, half, zone = (part.first[begin:end] for begin, end in span)
    hours = part.whole(span[3])
    if half:
        hours = hours % 12 + (12 if half.lower() == "pm" else 0)
    months = part.whole(span[1]) if month.isdigit() else np.full(len(part), _month(month))
    end = "Z" if zone in ("UTC", "GMT") else zone
    begin = span[5][0]
    seconds = part.whole((begin, begin + 2) if second else (0, 0))
    made = np.empty((len(part), 19 + len(second[2:]) + len(end)), dtype=np.uint8)
    made[:, :19] = np.frombuffer(b"2000-00-00 00:00:00", dtype=np.uint8)
    made[:, 4 - len(year) : 4] = part.cells[:, slice(*span[0])]
    for place, value in ((5, months), (8, part.whole(span[2])), (11, hours), (14, part.whole(span[4])), (17, seconds)):
        made[:, place], made[:, place + 1] = 48 + value // 10, 48 + value % 10
    if second[2:]:
        made[:, 19] = 46
        made[:, 20 : 19 + len(second[2:])] = part.cells[:, begin + 3 : span[5][1]]
    if end:
        made[:, -len(end) :] = part.cells[:, slice(*span[7])] if end == zone else 90
    return np.asarray(made.view(f"S{made.shape[1]}").ravel())


def _day_first(texts: Sequence[str], groups: Iterable[_alike.Alike]) -> bool | None:
    """Whether the day stands before the month; None where every date can be read both ways."""
    points, pairs = [], []
    for part in groups:
        found = _YEAR_LAST.fullmatch(part.first)
        if found is None:
            continue
        points.append(found[2] == ".")
        if part.at_once:
            span = _alike.spans(found)
            pairs.append((int(part.whole(span[1]).max()), int(part.whole(span[3]).max())))
        else:
            ones = [one for i in part.at.tolist() if (one := _YEAR_LAST.fullmatch(texts[i]))]
            pairs += [(int(one[1]), int(one[3])) for one in ones]
    if points and all(points):
        return True  # 02.03.2025: where points stand, the day comes first
    if any(first > 12 for first, _ in pairs):
        return True
    if any(second > 12 for _, second in pairs) or not pairs:
        return False
    return None


@dataclass
class Course:
    """Where a column of times has come to.

    Parameters
    ----------
    last_s : float
        The last time of the day [s].
    midnights : int
        Since the first.
    day_first : bool or None
        Whether the day of a date came before its month, as the last part of the column says.
    """

    last_s: float = np.nan
    midnights: int = 0
    day_first: bool | None = False


def read(
    texts: Sequence[str], options: ReadOptions, *, unit: str | None = None, course: Course | None = None
) -> tuple[str, AnyArray, list[str]]:
    """A column of times in any of the known forms.

    Parameters
    ----------
    texts : sequence of str
    unit : {"s", "ms"}, optional
        Of numbers, where the head of the column says so and they count from no known origin.
    course : Course, optional
        Of the column's part before; brought to the end of this one.

    Returns
    -------
    clock : str
        As :func:`_rows.times` takes it.
    cells : array, shape (n,)
        Bytes or floats for it.
    warnings : list of str
    """
    shown, groups = texts, texts.grouped() if isinstance(texts, _alike.Cells) else None
    if groups is None:
        shown = [_alike.bare(text) for text in texts]
        groups = _alike.grouped(shown)
    some, counts, of_day = (
        sum(len(part) for part in groups if known(part.first)) for known in (bool, _NUMBER.fullmatch, _OF_DAY.fullmatch)
    )
    if counts * 2 > some and not any(_DIGITS.fullmatch(text) for text in islice(filter(None, shown), 3)):
        return _numbers(shown, groups, unit, options)
    if of_day * 2 > some:
        return _of_day(shown, groups, options, course or Course())
    first = _day_first(shown, groups)
    if course is not None:
        course.day_first = first
    warnings = ["the dates can be read with the day or the month first: the month was taken"] if first is None else []
    parts = [(part.at, _in_common(part, shown, bool(first))) for part in groups]
    cells = np.zeros(len(shown), dtype=f"S{max((made.dtype.itemsize for _, made in parts), default=1)}")
    for at, made in parts:
        cells[at] = made
    return "wall", cells, warnings


def _in_common(part: _alike.Alike, texts: Sequence[str], day_first: bool) -> AnyArray:
    """Times of one form in the common one, ``-`` where they are none."""
    if part.at_once and _COMMON.fullmatch(part.first):
        return np.ascontiguousarray(part.cells).view(f"S{len(part.first)}").ravel()
    if part.at_once and not part.first[:8].isdigit():  # of _DIGITS it matters which they are
        return _dates(part, day_first)
    return np.array([_dated(texts[i], day_first) or b"-" for i in part.at.tolist()], dtype=np.bytes_)


def _numbers(
    texts: Sequence[str], groups: Iterable[_alike.Alike], unit: str | None, options: ReadOptions
) -> tuple[str, AnyArray, list[str]]:
    """Numbers: epochs by their size, else relative times."""
    value = np.full(len(texts), np.nan)
    for part in groups:
        if _NUMBER.fullmatch(part.first) and part.at_once:
            value[part.at] = part.numbers((0, len(part.first)))
        elif _NUMBER.fullmatch(part.first):
            value[part.at] = [float(texts[i].replace(",", ".")) for i in part.at.tolist()]
    middle = float(np.nanmedian(np.abs(value))) if np.isfinite(value).any() else 0.0
    for scale, form in ((1e18, None), (1e15, "epoch_us"), (1e12, "epoch_ms"), (1e9, "epoch_s")):
        if middle >= 0.9 * scale:
            return (form, value, []) if form else ("epoch_us", value / 1e3, [])
    if unit is None and 86_400 < middle < 86_400_000 and not (value % 1 > 0).any():
        if np.nanmin(value) < 3_600_000:
            return "relative_ms", value, [_MILLISECONDS]
        return _on_a_date(value / 1e3, options, [_MILLISECONDS + " of the day"])
    return f"relative_{unit or 's'}", value, []


_MILLISECONDS = "the times are whole numbers beyond a day of seconds: read as milliseconds"


def _of_day(
    texts: Sequence[str], groups: Iterable[_alike.Alike], options: ReadOptions, course: Course
) -> tuple[str, AnyArray, list[str]]:
    """Times of the day: their date is that of ``time_origin``, of the file name, or nobody's."""
    seconds = np.full(len(texts), np.nan)
    marked = False
    for part in groups:
        if found := _OF_DAY.fullmatch(part.first):
            marked |= bool(found[5])
            seconds[part.at] = _seconds_of(part, found, texts)
    midnights = course.midnights + np.cumsum(np.nan_to_num(np.diff(seconds, prepend=course.last_s)) < -43_200)
    course.last_s, course.midnights = float(seconds[-1]), int(midnights[-1])
    seconds = seconds + 86_400.0 * midnights
    warnings = ["the times are marked as UTC but read as local, as the program's own names say"] if marked else []
    return _on_a_date(seconds, options, warnings)


def _on_a_date(seconds: FloatArray, options: ReadOptions, warnings: list[str]) -> tuple[str, AnyArray, list[str]]:
    """Seconds of the first day; relative where nothing says which day that is."""
    date = options.time_origin[:10] if options.time_origin else date_in_name(options.file_name)
    if date is None or not re.fullmatch(r"\d{4}-\d\d-\d\d", date):
        return "relative_s", seconds, [*warnings, "the times have no date and the file name has none either"]
    stamps = np.datetime64(date, "us") + np.round(np.nan_to_num(seconds) * 1e6).astype("timedelta64[us]")
    cells = np.datetime_as_string(stamps, unit="us").astype(np.bytes_)
    cells = np.where(np.isnan(seconds), b"-", cells)
    source = "time_origin" if options.time_origin else "the file name"
    return "wall", cells, [f"the times have no date: it is that of {source}, {date}", *warnings]


def _seconds_of(part: _alike.Alike, found: re.Match[str], texts: Sequence[str]) -> FloatArray:
    """Times of the day of one form [s]."""
    if not part.at_once:
        ones = [_OF_DAY.fullmatch(texts[i]) for i in part.at.tolist()]
        return np.array([_seconds(one.groups()) if one else np.nan for one in ones], dtype=np.float64)
    span = _alike.spans(found)
    hour = part.whole(span[1])
    if found[4]:
        hour = hour % 12 + (12 if found[4].lower() == "pm" else 0)
    return np.asarray(hour * 3600.0 + part.whole(span[2]) * 60.0 + part.numbers(span[3]))


def _seconds(parts: Sequence[str | None]) -> float:
    hour = int(parts[0] or 0)
    if parts[3]:
        hour = hour % 12 + (12 if parts[3].lower() == "pm" else 0)
    return hour * 3600.0 + int(parts[1] or 0) * 60.0 + float((parts[2] or "0").replace(",", "."))
