"""Conversion of dates and times in any form to ``YYYY-mm-dd HH:MM:SS.f``, with the zone if there is one.

All readers and ``--map`` use this parser. The zone is taken from the cell, else from the name of the column, else from
the user. The complete column decides whether ``03/04/2025`` is in March or April. If this is undecided, an order is
assumed and a warning reports it.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime
from functools import cache
from itertools import pairwise
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

import numpy as np

from aerpaw_cmp.logs import text as _text
from aerpaw_cmp.readers import AnyArray, FloatArray, InputError, IntArray, ReadOptions, UsageError, dictionary

_NAMED_ZONE = r"Z|[A-Z][A-Za-z]+/[A-Z][\w/]+|[A-Z]{2,5}(?![A-Za-z])|(?:UTC|GMT)? ?[+-]\d{1,2}(?::?\d\d)?"
# Java writes the name of the zone after the offset: 10:00-04:00[America/New_York], 14:00Z[UTC].
_PLACE = re.compile(r"(Z|[+-]\d\d:\d\d)\[[\w/+-]+\]$")
# AM and PM are at the position of a zone, but are not a zone.
_ZONE = rf"(?: ?[(\[]?(?P<zone>(?:UTC|GMT) ?[+-]\d{{1,2}}(?::?\d\d)?|(?![AaPp][Mm]\b)(?:{_NAMED_ZONE}))[)\]]?)?"
_CLOCK = (
    r"(?P<hour>\d{1,2})[:.h_-](?P<minute>\d\d)(?:[:.m_-](?P<second>\d\d)(?:[.,:](?P<fraction>\d{1,40}))?s?)?(?: Uhr)?"
    r" ?(?P<half>[AaPp]\.? ?[Mm]\.?)?"
)
_GAP = r"[T _,.:;-]{1,3}(?:(?:at|@) )?"
_DAY = r"(?:[^\W\d_]{2,10}[., ]{1,3})?"  # a day of the week in any language
_WORD = r"(?P<word>[^\W\d_]{3,10})\.?"
# The date before the clock; date(1) writes the year and the zone after it.
_DATES = tuple(form.replace("WORD", _WORD) for form in dictionary.DATES)
_DIGITS = re.compile(
    r"(?P<year>20\d\d)(?P<month>\d\d)(?P<day>\d\d)[T_ -]?(?P<hour>\d\d):?(?P<minute>\d\d):?(?P<second>\d\d)"
    r"(?:\.?(?P<fraction>\d{1,40}))?" + _ZONE
)


@cache
def _forms() -> tuple[re.Pattern[str], ...]:
    """Return all forms of a date and its clock, compiled when the first log has such times."""
    before = (re.compile(_DAY + date + rf"(?:{_GAP}{_CLOCK})?{_ZONE}") for date in _DATES)
    within = re.compile(_DAY + rf"{_WORD} {{1,2}}(?P<day>\d{{1,2}}) {_CLOCK}{_ZONE} (?P<year>\d{{4}})")
    behind = (re.compile(rf"{_CLOCK}{_ZONE}[ ,]{{1,2}}" + date) for date in _DATES)
    return (*before, within, _DIGITS, *behind)


_OF_DAY = re.compile(r"T?" + _CLOCK.replace("[:.h_-]", ":", 1).replace("[:.m_-](?P<second>", ":(?P<second>") + _ZONE)
# Python, pandas and C print up to 17 digits (0.30000000000000004). Programs with decimal arithmetic print more.
_NUMBER = re.compile(r"[-+]?\d{1,20}(?:[.,]\d{0,40})?(?:[eE][-+]?\d{1,3})?")
# An epoch shortened by a spreadsheet, ``1.74093E+12``: if fewer than nine digits follow the first, seconds are lost.
_ROUNDED = re.compile(r"\d(?:[.,]\d{0,8})?[eE]\+?0?(?:9|1\d)")
# A time as a spreadsheet shows it: minutes, seconds and tenths without the hour.
_MINUTES = re.compile(r"\d{1,2}:\d\d[.,]\d")
_COMMON = re.compile((_text.TIME + rb"(?:Z|[+-]\d\d:\d\d)?").decode())
# Dates with or without hyphens, and dates in the form of Nemo: ``24Feb09`` is 9 February 2024.
_IN_NAME = (
    re.compile(r"(?<!\d)(20\d\d)[-_.]?(\d\d)[-_.]?(\d\d)(?!\d)"),
    re.compile(r"(?<!\d)(\d\d)([A-Z][a-z]{2})(\d\d)(?!\d)"),
)
# Hours east of UTC of unambiguous abbreviations. EST in summer is doubtful, and CST is the name of two zones.
_HOURS = {word: float(hours) for word, hours in dictionary.ZONES["hours"].items()}
# Names of a zone with its summer time.
_WITH_SUMMER = dictionary.ZONES["with_summer"]
_OFFSET = re.compile(r"(?:UTC|GMT)? ?([+-])(\d{1,2}):?(\d\d)?")


def date_in(name: str) -> str | None:
    """Return the date in a file name or in a line of text.

    Examples
    --------
    >>> date_in("24Feb09_172055.1.gpx"), date_in("2022-06-10_19:52:44_log.txt"), date_in("60m.csv")
    ('2024-02-09', '2022-06-10', None)
    """
    for pattern in _IN_NAME:
        for match in pattern.finditer(name):
            year, month, day = match.groups()
            year = year if len(year) == 4 else f"20{year}"
            number = int(month) if month.isdigit() else _month(month)
            if 1 <= number <= 12 and 1 <= int(day) <= 31:
                return f"{year}-{number:02d}-{int(day):02d}"
    return None


def _month(word: str) -> int:
    known = dictionary.PATTERNS["months"].match(
        unicodedata.normalize("NFKD", word.lower()).encode("ascii", "ignore").decode()
    )
    return 0 if known is None else known.lastindex or 0


# Two orders of day and month are distinguished if the spans of the dates differ by this number of days.
_WEEKS_D = 20


def _order(
    texts: Iterable[str], name: str, *, european: bool, day_first: bool | None = None
) -> tuple[str, list[str]]:  # fmt: skip
    """Return the order of day, month and year in the dates of a complete column, and warnings about assumptions."""
    dates = [match for text in texts if (match := _match(text)) and "a" in match.re.groupindex]
    if not dates:
        return "dmy", []
    firsts, seconds, lasts = ([int(match[key]) for match in dates] for key in "abc")
    warnings = []
    if len(dates[0]["c"]) == 2:
        year_first = max(firsts) > 31 or (not _are_years(lasts) and _are_years(firsts))
        word = "first" if year_first else "last"
        warnings.append(f"the years have two digits: the {word} number is assumed to be the year, a guess")
        if year_first:
            return "ymd", warnings
    # with points, as in 02.03.2025, the day comes first
    if all(match["mark"] == "." for match in dates) or max(firsts) > 12:
        return "dmy", warnings
    if max(seconds) > 12:
        return "mdy", warnings
    if day_first is not None:
        return "dmy" if day_first else "mdy", warnings
    # after midnight, the days of a log follow each other in the right order, and are weeks apart in the wrong order
    spans_d = {}
    for order in ("dmy", "mdy"):
        parts = [_parts(match, order) for match in {match.group("a", "b", "c"): match for match in dates}.values()]
        days = [365.25 * int(year) + 30.44 * month + day for year, month, day in parts]
        spans_d[order] = max(days) - min(days)
    if abs(spans_d["dmy"] - spans_d["mdy"]) >= _WEEKS_D:
        return min(spans_d, key=lambda order: spans_d[order]), warnings
    date = date_in(name)
    fits = [order for order in ("dmy", "mdy") if date == "{}-{:02d}-{:02d}".format(*_parts(dates[0], order))]
    order = fits[0] if len(fits) == 1 else "dmy" if european else "mdy"
    reason = "as in Europe" if european else "a guess"
    reason = "as in the date of the file name" if len(fits) == 1 else reason
    word = "day" if order == "dmy" else "month"
    warnings.append(f"the day or the month may come first in the dates: the {word} is read first, {reason}")
    return order, warnings


def _are_years(numbers: Iterable[int]) -> bool:
    """Check whether two digits can all be the year of a log of this kind."""
    return all(15 <= number <= 40 for number in numbers)


def _parts(match: re.Match[str], order: str) -> tuple[str, int, int]:
    """Return year, month and day."""
    groups = match.groupdict()
    if of_year := groups.get("of_year"):
        date = str(np.datetime64(f"{groups['year']}-01-01") + int(of_year) - 1)
        return date[:4], int(date[5:7]), int(date[8:])
    if groups.get("a") is None:
        year, month = groups["year"], int(groups["month"]) if groups.get("month") else _month(groups["word"])
        day = groups["day"]
    else:
        numbers = dict(zip(order, match.group("a", "b", "c"), strict=True))
        year, month, day = numbers["y"], int(numbers["m"]), numbers["d"]
    return year if len(year) == 4 else f"20{year}", month, int(day)


def _match(text: str) -> re.Match[str] | None:
    matches = (form.fullmatch(text) for form in _forms())
    known = (match for match in matches if match and (match.groupdict().get("word") is None or _month(match["word"])))
    return next(known, None)


# Time of a modem (AT+CCLK), whose zone is in quarters of an hour (3GPP TS 27.007, 8.15).
_OF_MODEM = re.compile(r"(\d\d/\d\d/\d\d,\d\d:\d\d:\d\d[+-])(\d\d)")


def _with_hours(match: re.Match[str]) -> str:
    return f"{match[1]}{int(match[2]) // 4:02d}:{int(match[2]) % 4 * 15:02d}"


def is_dated(text: str) -> bool:
    """Check whether a time contains its date, like an epoch or a date with a clock.

    Examples
    --------
    >>> is_dated("1749564000"), is_dated("2025-06-10 10:00"), is_dated("10.00.00"), is_dated("100000.5")
    (True, True, False, False)
    """
    match = _match(text)
    return re.match(r"\d{9}", text) is not None or (match is not None and match["hour"] is not None)


def _written(text: str, order: str, header: str, own: str | None) -> bytes:
    """Return one time in the common form, or ``-`` for other text."""
    match = _match(text)
    if match is None:
        return b"-"
    year, month, day = _parts(match, order)
    groups = match.groupdict()
    hour = _hour(groups)
    date = f"{year}-{month:02d}-{day:02d} {hour:02d}:{groups.get('minute') or '00'}:{groups.get('second') or '00'}"
    fraction = f".{groups['fraction'][:9]}" if groups.get("fraction") else ""
    return (date + fraction + _offset((groups.get("zone") or header).strip(), date, own)).encode()


def _hour(groups: dict[str, str | None]) -> int:
    hour, half = int(groups.get("hour") or 0), groups.get("half")
    return hour % 12 + (12 if half[0].lower() == "p" else 0) if half else hour


def _offset(zone: str, date: str, own: str | None) -> str:
    """Return ``+hh:mm`` of a zone at a date, or an empty text if the zone is unknown. ``own`` is the user's zone."""
    word = zone if "/" in zone else zone.upper()
    if not word:
        return ""
    if (exact := _OFFSET.fullmatch(word)) is not None:
        return f"{exact[1]}{int(exact[2]):02d}:{exact[3] or '00'}"
    if word in _HOURS:
        return _shown(_HOURS[word])
    try:
        moment = datetime.fromisoformat(date)
    except ValueError:
        return ""  # the caller reports that the date does not exist
    if own and (here := _at(own, moment)) is not None and here[1] == word:
        return _shown(here[0])
    if word in _WITH_SUMMER or "/" in word:
        here = _at(_WITH_SUMMER.get(word, word), moment)
        return "" if here is None else _shown(here[0])
    if word not in dictionary.WINTER:
        raise UsageError(
            f"the times have an unknown zone: {word}",
            expected="UTC, an offset such as -04:00, or an abbreviation such as EDT",
            cause="a misspelt zone: correct it in the file",
        )
    (hours, zone), *others = dictionary.WINTER[word]
    if others:
        doubt, more = "which is the zone of several countries", ", or state the zone of the log with --timezone"
        ways = [f"{_shown(east)} ({name})" for east, name in dictionary.WINTER[word]]
    else:
        here = _at(zone, moment)
        if here is None or here[0] == hours:
            return _shown(hours)
        doubt, more = f"but on {date[:10]} the clocks of that zone show {here[1]}", ""
        ways = [f"{_shown(hours)} as written", f"{_shown(here[0])} ({here[1]})"]
    expected = f"{' or '.join(ways)}: put the offset in place of {word} in the file{more}"
    raise UsageError(f"the zone of the times is {word}, {doubt}", expected=expected)


def _shown(hours: float) -> str:
    minutes = round(abs(hours) * 60)
    return f"{'-' if hours < 0 else '+'}{minutes // 60:02d}:{minutes % 60:02d}"


def _at(zone: str, moment: datetime) -> tuple[float, str] | None:
    """Return the hours east of UTC and the abbreviation of a zone at a wall time, or None for an unknown zone."""
    try:
        local = moment.replace(tzinfo=ZoneInfo(zone))
    except (ZoneInfoNotFoundError, ValueError, OSError):
        return None
    offset = local.utcoffset()
    return (offset.total_seconds() / 3600, local.tzname() or "") if offset is not None else None


def header_zone(name: str, brackets: str) -> str:
    """Return the zone in the name of a column of times, in brackets or as its last word, else an empty text.

    Examples
    --------
    >>> header_zone("Time (EDT)", "EDT"), header_zone("TimeUtc", ""), header_zone("Time [local]", "local")
    ('EDT', 'UTC', '')
    """
    inside = brackets.strip()
    if inside and inside.lower() in SCALES_S:
        return "UTC"
    if inside and ("/" in inside or re.fullmatch(_NAMED_ZONE, inside.upper()) or inside.upper() in _WITH_SUMMER):
        return "" if inside.lower() in ("ms", "us", "s", "local", "iso", "date", "time", "unix", "epoch") else inside
    if (offset := re.search(r"\b(?:UTC|GMT) ?[+-]\d{1,2}(?::?\d\d)?\b", name, re.IGNORECASE)) is not None:
        return offset[0]
    words = re.split(r"[^A-Za-z0-9+]+|(?<=[a-z])(?=[A-Z])", name)
    if {word.lower() for word in words} & {"utc", "gps", "gmt", "zulu", *SCALES_S}:
        return "UTC"
    last = words[-1].upper() if len(words[-1]) > 2 else ""  # 'time_edt'
    return next((word for word in (*words, last) if word in {*_HOURS, *dictionary.WINTER, *_WITH_SUMMER}), "")


def in_seconds(text: str) -> str:
    """Return a duration as seconds, and other text unchanged.

    Examples
    --------
    >>> in_seconds("0:01:05.5"), in_seconds("12.5")
    ('65.5', '12.5')
    """
    clock = _OF_DAY.fullmatch(text)
    return text if clock is None else f"{_seconds(clock.groupdict()):.9g}"


def zone_of_cell(text: str) -> str:
    """Return the zone in a cell of a column of zones: a name, or hours, minutes or seconds east of UTC.

    Examples
    --------
    >>> [zone_of_cell(text) for text in ("edt", "-240", "-14400", "-0400", "5.5", "here")]
    ['EDT', '-04:00', '-04:00', '-0400', '+05:30', '']
    >>> zone_of_cell("Asia/Tokyo"), zone_of_cell("Asia/Nowhere")
    ('Asia/Tokyo', '')
    """
    number = re.fullmatch(r"[+-]?\d{1,5}(?:\.\d{1,2})?", text)
    if number is None or re.fullmatch(r"[+-]\d{4}", text):
        # 'home' is not a zone
        word = text.upper() if text.upper() in {*_HOURS, *dictionary.WINTER, *_WITH_SUMMER} else text
        return word if re.fullmatch(_NAMED_ZONE, word) and ("/" not in word or _at(word, datetime.min)) else ""
    hours = float(text)
    # zones are at most 14 h from UTC, so larger numbers are minutes (up to 840) or seconds
    hours /= 1 if abs(hours) <= 14 else 60 if abs(hours) <= 840 else 3600
    return _shown(hours)


def read(
    texts: Sequence[str], options: ReadOptions, *, unit: str | None = None, european: bool = False, zone: str = "",
    gps: bool = False, day_first: bool | None = None, device: IntArray | None = None,
) -> tuple[str, AnyArray, list[str]]:  # fmt: skip
    """Return a column of times in any of the known forms.

    Parameters
    ----------
    texts : sequence of str
    options : ReadOptions
    unit : {"ns", "us", "ms", "s", "min", "h"}, optional
        Unit of numbers that count from an unknown origin, according to the name of the column.
    european : bool
        True if the table has decimal commas or a zone of Europe: the day then comes before the month.
    zone : str
        Zone of times without a zone, according to the name of the column.
    gps : bool
        True if numbers are GPS time according to the name of the column.
    day_first : bool, optional
        True if the day comes before the month according to the name of the column.
    device : int array, shape (n,), optional
        Number of the device that wrote each row; midnights are found per device.

    Returns
    -------
    clock : str
        Argument of :func:`aerpaw_cmp.logs.rows.instants_of`.
    cells : array, shape (n,)
        The times for this function, as bytes or floats.
    warnings : list of str
    """
    texts = [text if text.isascii() else _in_ascii(text) for text in texts]
    shown = [
        text.strip(' \t"[]') if text[-1:] != "]" or text[:1] == "[" else _PLACE.sub(r"\1", text.strip())
        for text in texts
    ]
    shown = _padded(shown)
    of_modem = any(map(_OF_MODEM.fullmatch, shown))
    shown = [_OF_MODEM.sub(_with_hours, text) for text in shown] if of_modem else shown
    filled = [text for text in shown if text]
    compact = [match for text in filled if (match := _COMPACT.fullmatch(text))]
    # these digits reach 60 to 99 in numbers of seconds, but never in times of day
    clocks = len(compact) == len(filled) and all(len({match[part] for match in compact}) > 1 for part in (6, 7))
    if 2 * sum(clocks or bool(match[1] or zone) for match in compact) > len(filled):
        shown = [_COMPACT.sub(_with_marks, text) for text in shown]
        filled = [text for text in shown if text]
    refuse_spreadsheets(filled)
    counts = sum(_NUMBER.fullmatch(text) is not None for text in filled)
    # 20250610140000 is a number, too
    if counts * 2 > len(filled) and not any(_DIGITS.fullmatch(text) for text in filled[:3]):
        value = np.array([float(text.replace(",", ".")) if _NUMBER.fullmatch(text) else np.nan for text in shown])
        return _numbers(value, unit, options, gps=gps, zone=zone)
    if sum(_OF_DAY.fullmatch(text) is not None for text in filled) * 2 > len(filled):
        return _of_day(shown, options, zone, device)
    plain = [text for text in filled if not _COMMON.fullmatch(text)]
    order, warnings = _order(plain, options.file_name, european=european, day_first=day_first)
    warnings += ["the zone of the times is read in quarters of an hour, as AT+CCLK of a modem writes it"] * of_modem
    bare = [match for text in plain if (match := _match(text)) and match.groupdict().get("second") is None]
    if len(set(filled)) < len(filled) and 2 * len(bare) > len(filled):
        warnings.append("the times have no seconds (saved by a spreadsheet?): all rows of a minute share one time")
    cells = [
        text.encode() if _COMMON.fullmatch(text) and (not zone or text[-6] in "+-" or text[-1] == "Z")
        else _written(text, order, zone, options.timezone) for text in shown
    ]  # fmt: skip
    return "wall", _text.cells(cells), warnings + _doubts_of_halves(filled, options, zone)


def _doubts_of_halves(texts: Sequence[str], options: ReadOptions, zone: str) -> list[str]:
    """Return a warning about local times that may come from a 12-hour clock without AM and PM."""
    # texts of another form have a zone, or AM and PM
    plain = bool(texts) and not zone and options.clock != "utc" and _PLAIN_CLOCK.fullmatch(texts[0])
    hours = [int(found[1]) for text in texts if (found := _PLAIN_CLOCK.fullmatch(text))] if plain else [0]
    turns = (12, 1) in pairwise(hours)
    if not 1 <= min(hours) <= max(hours) <= (12 if turns else _NIGHT_H):
        return []
    what = "the hour 1 follows the hour 12" if turns else f"the local times are at night, such as {texts[0]}"
    return [f"{what}: a clock of 12 hours without AM and PM? Write hours from 0 to 23, or add AM or PM to the times"]


# A time without a zone, and the hour before which there are usually no flights.
_PLAIN_CLOCK, _NIGHT_H = re.compile(r"[^:]*?(\d{1,2}):\d\d(?::[\d.,]+)?"), 5


# The marks of Chinese, Japanese and Korean dates, and the spaces that browsers write before AM.
_MARKS = str.maketrans(
    "\u5e74\ub144\u6708\uc6d4\u65e5\uc77c\u65f6\u6642\u70b9\uc2dc\u5206\ubd84\uff1a\u79d2\ucd08\u202f\xa0",
    "----  :::::::    ",
)
_HALF_FIRST = re.compile("(\u4e0a\u5348|\u5348\u524d|\uc624\uc804)|\u4e0b\u5348|\u5348\u5f8c|\uc624\ud6c4")


def _in_ascii(text: str) -> str:
    """Return a time with the marks of Chinese, Japanese or Korean as hyphens, colons, AM and PM."""
    half = _HALF_FIRST.search(text)
    text = _HALF_FIRST.sub(" ", text).translate(_MARKS).strip(" :")
    return text if half is None else f"{' '.join(text.split())} {'AM' if half[1] else 'PM'}"


_COUNTED = re.compile(r"(.*\d:\d\d:\d\d:)(\d{1,9})(?!\d)(.*)")


def _padded(texts: list[str]) -> list[str]:
    """Return times with leading zeros in the count of ms, us or ns after a third colon."""
    matches = {text: match for text in set(texts) if (match := _COUNTED.fullmatch(text))}
    widths = {len(match[2]) for match in matches.values()}
    if len(widths) < 2:
        return texts
    width = 3 * -(-max(widths) // 3)
    padded = {text: f"{match[1]}{match[2]:0>{width}}{match[3]}" for text, match in matches.items()}
    return [padded.get(text, text) for text in texts]


# The date and the time of day of a GPS receiver, six digits each: ddmmyy or yymmdd, hhmmss.
_COMPACT = re.compile(r"((\d\d)(\d\d)(\d\d)[ T])?([01]\d|2[0-3])([0-5]\d)([0-5]\d(?:\.\d{1,40})?)")


def _with_marks(match: re.Match[str]) -> str:
    """Return the matched digits with full stops in the date and colons in the time. The order is not changed."""
    date = ".".join(match.group(2, 3, 4)) + " " if match[1] else ""
    return date + ":".join(match.group(5, 6, 7))


def refuse_spreadsheets(texts: Sequence[str]) -> None:
    """Refuse a column of times that a spreadsheet shortened.

    Raises
    ------
    InputError
        If most of the texts are epochs without their last digits, so that rows of minutes would share a time, or
        minutes and seconds without the hour.
    """
    kinds = (
        (_ROUNDED, "rounded", "all digits of the epoch", "shortens long numbers"),
        (_MINUTES, "minutes and seconds without the hour and the date", "whole times",
         "shows times in this form: save the column as text"),
    )  # fmt: skip
    for form, found, expected, habit in kinds:
        shortened = [text for text in texts if form.fullmatch(text)]
        if 2 * len(shortened) > len(texts):
            cause = f"the table was saved by a spreadsheet, which {habit}"
            raise InputError(f"the times are {found}, such as {shortened[0]}", expected=expected, cause=cause)


# Longest flight [s], longest step between its rows [s], and, if no unit is stated, the smallest step between numbers
# for which each unit is considered. Steps of 10 may be 10 ms, but steps of 5 must be 5 s.
_FLIGHT_S, _LONGEST_STEP_S = 10_800.0, 60.0
_LEAST_STEPS = {"s": 0.0, "ms": 10.0, "us": 2e3, "ns": 2e6}
# If numbers in seconds would be a log shorter than this [s], they may be minutes or hours.
_SHORT_S = 60.0
# Time steps of stationary loggers [s]. No program writes rows with steps of 900, 1800 or 3600 ms.
_QUARTERS = (900.0, 1800.0, 3600.0)
# Shortest time between rows that a program of a radio or an autopilot writes [ns].
_LEAST_NS = 1e6


def _step(value: FloatArray) -> float:
    """Return the median step between rows of different times, or NaN if all times are equal."""
    steps = np.abs(np.diff(value[np.isfinite(value)]))
    return float(np.median(steps[steps > 0])) if (steps > 0).any() else np.nan


def _likely_units(value: FloatArray, units: Mapping[str, float]) -> list[str]:
    """Return the units in which numbers have the steps and the length of a flight. Each unit has its smallest step."""
    step, span = _step(value), np.diff(np.nanpercentile(value, (5, 95)))[0] if np.isfinite(value).any() else np.nan
    return [
        unit for unit, least in units.items()
        if least <= step <= _LONGEST_STEP_S * 1e9 / _text.COUNTS[unit].ns
        and span <= _FLIGHT_S * 1e9 / _text.COUNTS[unit].ns
    ]  # fmt: skip


def are_seconds(value: FloatArray, unit: str) -> bool:
    """Check whether the steps of numbers are too short in the unit of a program but plausible in seconds."""
    return _step(value) * _text.COUNTS[unit].ns <= _LEAST_NS and "s" in _likely_units(value, _LEAST_STEPS)


def _numbers(
    value: FloatArray, unit: str | None, options: ReadOptions, *, gps: bool, zone: str
) -> tuple[str, AnyArray, list[str]]:
    """Return numbers as epochs if they are large enough, else as relative times."""
    middle = float(np.nanmedian(np.abs(value))) if np.isfinite(value).any() else 0.0
    for what, (zero, *numbers) in dictionary.DAY_NUMBERS.items():
        low, high, per_day = map(float, numbers)
        if unit is None and len(value) > 2 and _are_days(value / per_day, low, high):
            zone = "UTC" if "UTC" in what else zone
            text = f"the times are {what}: read as {zone or 'local'} dates and times"
            return "wall", _wall_cells(np.datetime64(zero, "us"), value / per_day * 86_400.0, zone, options), [text]
    step, likely = _step(value), _likely_units(value, _LEAST_STEPS)
    for scale, form in ((1e18, None), (1e15, "epoch_us"), (1e12, "epoch_ms"), (1e9, "epoch_s")):
        # 0.9e9 s is July 1998; smaller numbers, and numbers with steps of odd hours, have another origin
        hours = step / scale * 1e9 / 3600
        odd = unit is None and bool(likely) and hours > 1 and hours % 1 > 0
        if middle >= 0.9 * scale and not odd and (unit is None or scale >= _text.COUNTS[unit].least_epoch):
            epoch_s = middle * 1e9 / scale
            warnings = _doubts_of_epoch(epoch_s, gps)
            if gps and epoch_s < _GPS_S_OF[1]:
                value, warnings = value + (GPS_S - LEAP_S) * scale / 1e9, [_GPS_COUNT]
            return (form, value, warnings) if form else ("epoch_us", value / 1e3, warnings)
    if unit is not None:
        return f"relative_{unit}", value, []
    whole, of_day = not (value % 1 > 0).any(), 86_400 < middle < 86_400_000
    late = whole and middle > 86_400  # more seconds than in a day
    unit = next((unit for unit in likely if unit != "s" or not late), "ms" if late and of_day and not likely else "s")
    unit = "s" if step in _QUARTERS and not (value % step).any() else unit
    # a log that is shorter than a minute in seconds may be in minutes or hours
    longer = {} if whole or np.nanmax(value) - np.nanmin(value) >= _SHORT_S else {"min": 0.0, "h": 0.0}
    known = likely if whole else _likely_units(value, longer)
    others = [other for other in dict.fromkeys(("s", *known)) if other != unit]
    if unit == "s" and not others:
        return "relative_s", value, []
    lasting = "; ".join(f"as {_text.COUNTS[other].name} {_lasting(value, other)}" for other in others)
    text = f"the times are numbers without a unit: read as {_text.COUNTS[unit].name}, which is a guess"
    text = f"{text} (the log lasts {_lasting(value, unit)}; {lasting})"
    advice = f"if it is wrong, write the unit in the column's name, such as 'time [{others[0]}]'"
    # A log that begins within the first hour counts from its start. A later log counts from midnight, unless the user
    # knows the time of zero.
    if unit == "ms" and of_day and whole and np.nanmin(value) >= 3_600_000:
        if len(options.time_origin or "") <= len("2025-03-02"):
            return _on_a_date(value / 1e3, options, [f"{text}, of the day; {advice}"])
        text += f", counted from {options.time_origin}"
    return f"relative_{unit}", value, [f"{text}; {advice}"]


def _doubts_of_epoch(epoch_s: float, gps: bool) -> list[str]:
    """Return a sentence about epochs that are called GPS time, or that may be GPS time."""
    if gps:
        return ["the times are called GPS time and count from 1970: read as UTC"]
    if not _GPS_S_OF[0] < epoch_s < _GPS_S_OF[1]:
        return []
    years = [np.datetime64(round(epoch_s) + zero, "s").item().year for zero in (0, GPS_S)]
    text = f"the times are read as epochs of {years[0]}; if they count from 1980 (GPS time), they are of {years[1]}"
    return [f"{text}. In that case, call their column 'GPS time'."]


def _lasting(value: FloatArray, unit: str) -> str:
    seconds = float(np.nanmax(value) - np.nanmin(value)) * _text.COUNTS[unit].ns / 1e9
    return f"{seconds:,.4g} s" if seconds < 7200 else f"{seconds / 3600:,.0f} h"


# GPS time counts from 6 January 1980; since 2017 it is 18 s ahead of UTC (IERS Bulletin C 52).
GPS_S, LEAP_S = 315_964_800, 18
# Time scales without leap seconds, with their difference from UTC since 2017 [s].
SCALES_S = {"gpst": LEAP_S, "gpstime": LEAP_S, "tai": 37}
# GPS time of January 2018 and of February 2030. Read as epochs, they are in 2008 and 2020.
_GPS_S_OF = (1.2e9, 1.58e9)
_GPS_COUNT = "the times count from 1980 (GPS time): 18 leap seconds were subtracted"


def _are_days(value: FloatArray, low: float, high: float) -> bool:
    """Check whether numbers are day numbers with the time as fraction: within two days, in steps below 90 s.

    Longer steps are also possible within half a day, because no log in seconds lasts half a second.
    """
    finite = value[np.isfinite(value)]
    if len(finite) < 3 or finite.min() < low or finite.max() >= high or not 0 < (span := np.ptp(finite)) <= 2.0:
        return False
    return bool(0 < np.median(np.abs(np.diff(finite))) < 1e-3 or span < 0.5)


def passes_midnight(texts: Iterable[str]) -> bool:
    """Check whether times of day step back by more than half a day."""
    matches = [match for text in texts if (match := _OF_DAY.fullmatch(text))]
    return bool((np.diff([_seconds(match.groupdict()) for match in matches]) < -43_200).any())


def _of_day(
    texts: Sequence[str], options: ReadOptions, zone: str, device: IntArray | None = None
) -> tuple[str, AnyArray, list[str]]:
    """Return times of day with the date of ``time_origin`` or of the file name, if there is one."""
    matches = [_OF_DAY.fullmatch(text) for text in texts]
    seconds = np.array([_seconds(item.groupdict()) if item else np.nan for item in matches], dtype=np.float64)
    # A step back by more than half a day is midnight; a smaller step back means that the clock was set. A step forward
    # by more than half a day, at the first row of another device, goes back to the day before.
    step = np.nan_to_num(np.diff(seconds, prepend=np.nan))
    other = np.zeros(len(step), dtype=bool) if device is None else np.diff(device, prepend=device[:1]) != 0
    seconds += 86_400.0 * (np.cumsum(step < -43_200) - np.cumsum((step > 43_200) & other))
    written = next((item["zone"] for item in matches if item and item["zone"]), None) or zone
    first = seconds[np.isfinite(seconds)][:1]
    named, start_s = _NEMO_NAME.search(options.file_name), _session_start_s(options)
    own_form = written == "Z" and any(text.startswith("T") for text in texts[:3])  # the form of Nemo Handy
    if not own_form or not len(first):
        return _on_a_date(seconds, options, _doubts_of_halves(texts, options, written), written)
    # Nemo Handy marks its local times as UTC, and some exports are wrong by hours, so use the start in its summary
    hours = 0 if start_s is None else round((float(first[0]) - start_s) / 3600)
    name_s = int(named[1]) * 3600 + int(named[2]) * 60 + int(named[3]) if named else float(first[0])
    if start_s is None and abs(float(first[0]) - name_s) > _NEAR_S:
        text = "the times are marked as UTC and differ from the local time in the program's file name: read as UTC"
        return _on_a_date(seconds, options, [text], written)
    warnings = ["the times are marked as UTC but read as local, like the program's file names"]
    if hours:
        text = f"the times are {hours:+d} h from the start in the summary next to the log"
        warnings.append(f"{text}: corrected, and read as local")
    return _on_a_date(seconds - 3600.0 * hours, options, warnings)


_NEMO_NAME = re.compile(r"(?<!\d)\d\d[A-Z][a-z]{2}\d\d_(\d\d)(\d\d)(\d\d)(?!\d)")
_SESSION_START = re.compile(rb"^Measurement start;\d{4} \w{3} \d\d (\d\d):(\d\d)", re.MULTILINE)
_NEAR_S = 300.0


def _session_start_s(options: ReadOptions) -> float | None:
    """Return the second of the day when the session began, according to Nemo's summary (a CSV in the same folder)."""
    summary = options.neighbour(options.file_name.rpartition(".")[0] + ".csv") if options.neighbour else None
    start = _SESSION_START.search(summary[:4096]) if summary else None
    return None if start is None else int(start[1]) * 3600.0 + int(start[2]) * 60.0


def _on_a_date(
    seconds: FloatArray, options: ReadOptions, warnings: list[str], zone: str = ""
) -> tuple[str, AnyArray, list[str]]:
    """Return seconds after the first midnight as dated times, or as relative times if the day is unknown."""
    date = options.time_origin[:10] if options.time_origin else date_in(options.file_name)
    if date is None or not re.fullmatch(r"\d{4}-\d\d-\d\d", date):
        return "relative_s", seconds, [*warnings, "the times have no date and the file name has none either"]
    cells = _wall_cells(np.datetime64(date, "us"), seconds, zone, options)
    source = "time_origin" if options.time_origin else "the file name"
    return "wall", cells, [f"the times have no date: the date of {source} is used, {date}", *warnings]


def _wall_cells(day: np.datetime64, seconds: FloatArray, zone: str, options: ReadOptions) -> AnyArray:
    """Return seconds after the beginning of a day as texts, with the UTC offset of the zone on that day."""
    stamps = day + np.round(np.nan_to_num(seconds) * 1e6).astype("timedelta64[us]")
    cells = np.datetime_as_string(stamps, unit="us").astype(np.bytes_)
    date = str(stamps[np.argmax(np.isfinite(seconds))])[:10]
    # use the offset at noon, because clocks change at night
    offset = _offset(zone.strip(), f"{date} 12:00:00", options.timezone).encode()
    return np.where(np.isnan(seconds), b"-", np.char.add(cells, offset))


def _seconds(groups: dict[str, str | None]) -> float:
    fraction = f"{groups.get('second') or '0'}.{groups.get('fraction') or '0'}"
    return _hour(groups) * 3600.0 + int(groups["minute"] or 0) * 60.0 + float(fraction)
