"""Dates and times in the forms that programs other than AERPAW's write, brought to one: ``YYYY-mm-dd HH:MM:SS.f``.

Which of two readings of ``03/04/2025`` holds is decided by the whole column; where it says nothing the month comes
first and a warning says so.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

import numpy as np

from aerpaw_cmp.common.errors import InputError
from aerpaw_cmp.common.units import AnyArray, FloatArray
from aerpaw_cmp.logs import clocks as _time
from aerpaw_cmp.logs import lines as _lines
from aerpaw_cmp.logs.readers import ReadOptions

_CLOCK = r"[T _,]{0,2}(\d{1,2})[:.](\d\d)(?:[:.](\d\d(?:[.,:]\d{1,9})?))? ?([AaPp][Mm])?"
_ZONE = r" ?(Z|UTC|GMT|[+-]\d\d:?\d\d)?"
_YEAR_FIRST = re.compile(r"(\d{4})[-/._](\d{1,2})[-/._](\d{1,2})" + _CLOCK + _ZONE)
_YEAR_LAST = re.compile(r"(\d{1,2})([-/.])(\d{1,2})\2(\d{4})" + _CLOCK + _ZONE)
_WORD_MONTH = re.compile(r"(\d{1,2})[- ]?([A-Z][a-z]{2})[a-z]{0,6}[- ]?(\d{4}|\d\d)" + _CLOCK + _ZONE)
_DIGITS = re.compile(r"(20\d\d)(\d\d)(\d\d)[T_ -]?(\d\d)(\d\d)(\d\d(?:\.\d{1,9})?)()" + _ZONE)
_OF_DAY = re.compile(r"T?(\d{1,2}):(\d\d):(\d\d(?:[.,]\d{1,9})?) ?([AaPp][Mm])?" + _ZONE)
_NUMBER = re.compile(r"[-+]?\d{1,20}(?:[.,]\d{0,12})?(?:[eE][-+]?\d{1,3})?")
# An epoch that a spreadsheet shortened, ``1.74093E+12``: fewer than nine digits behind the first leave out seconds.
_ROUNDED = re.compile(r"\d(?:[.,]\d{0,8})?[eE]\+?0?(?:9|1\d)")
_NO_SECONDS = re.compile(r".*[T _,]\d{1,2}[:.]\d\d(?: ?[AaPp][Mm])?" + _ZONE)
_COMMON = re.compile((_time.TIME + rb"(?:Z|[+-]\d\d:\d\d)?").decode())
_MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")
# Dates with hyphens or none, and Nemo's year, month, day: its summary of ``24Feb09`` says ``2024 Feb 09``.
_IN_NAME = (
    re.compile(r"(?<!\d)(20\d\d)[-_.]?(\d\d)[-_.]?(\d\d)(?!\d)"),
    re.compile(r"(?<!\d)(\d\d)([A-Z][a-z]{2})(\d\d)(?!\d)"),
)


def _date_in_name(name: str) -> str | None:
    """The date that a file name carries.

    Examples
    --------
    >>> _date_in_name("24Feb09_172055.1.gpx"), _date_in_name("2022-06-10_19:52:44_log.txt"), _date_in_name("60m.csv")
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
    return _MONTHS.index(word[:3].lower()) + 1 if word[:3].lower() in _MONTHS else 0


def _written(year: str, month: int, day: str, clock: Sequence[str | None], zone: str | None) -> bytes:
    """One time in the common form; ``-`` where it is no time of the day."""
    hour, minute, second, half = (clock[0] or "0", clock[1] or "0", clock[2] or "0", clock[3])
    number = int(hour)
    if half:
        number = number % 12 + (12 if half.lower() == "pm" else 0)
    integer, _, fraction = re.sub("[,:]", ".", second).partition(".")
    text = f"{year}-{month:02d}-{int(day):02d} {number:02d}:{int(minute):02d}:{int(integer):02d}"
    end = "Z" if zone in ("UTC", "GMT") else zone or ""
    return (text + (f".{fraction}" if fraction else "") + end).encode()


def _dated(text: str, day_first: bool) -> bytes | None:
    if match := _YEAR_FIRST.fullmatch(text) or _DIGITS.fullmatch(text):
        return _written(match[1], int(match[2]), match[3], match.groups()[3:7], match[8])
    if match := _YEAR_LAST.fullmatch(text):
        day, month = (match[1], match[3]) if day_first else (match[3], match[1])
        return _written(match[4], int(month), day, match.groups()[4:8], match[9])
    if match := _WORD_MONTH.fullmatch(text):
        year = match[3] if len(match[3]) == 4 else f"20{match[3]}"
        return _written(year, _month(match[2]), match[1], match.groups()[3:7], match[8])
    return None


def _day_first(texts: Iterable[str]) -> bool | None:
    """Check whether the day stands before the month; None where every date can be read both ways."""
    dates = [match for text in texts if (match := _YEAR_LAST.fullmatch(text))]
    if dates and all(match[2] == "." for match in dates):
        return True  # 02.03.2025: where points stand, the day comes first
    if any(int(match[1]) > 12 for match in dates):
        return True
    if any(int(match[3]) > 12 for match in dates) or not dates:
        return False
    return None


def _first_by_name(texts: Sequence[str], name: str) -> bool | None:
    """Check whether the day stands first if the first date is to be that of the file name; None where it is no help."""
    date = _date_in_name(name)
    fits = [first for first in (True, False) if date and (_dated(texts[0], first) or b"").startswith(date.encode())]
    return fits[0] if len(fits) == 1 else None


def read(
    texts: Sequence[str], options: ReadOptions, *, unit: str | None = None, european: bool = False
) -> tuple[str, AnyArray, list[str]]:
    """A column of times in any of the known forms.

    Parameters
    ----------
    texts : sequence of str
    unit : {"s", "ms", "us"}, optional
        Of numbers, where the head of the column says so and they count from no known origin.
    european : bool
        Has the table decimal commas? Where they stand, the day comes before the month.

    Returns
    -------
    clock : str
        As :func:`aerpaw_cmp.logs.rows.times` takes it.
    cells : array, shape (n,)
        Bytes or floats for it.
    warnings : list of str
    """
    shown = [text.strip().strip('"').strip() for text in texts]
    filled = [text for text in shown if text]
    refuse_rounded(filled)
    counts = sum(_NUMBER.fullmatch(text) is not None for text in filled)
    if counts * 2 > len(filled) and not any(_DIGITS.fullmatch(text) for text in filled[:3]):
        return _numbers(shown, unit, options)
    if sum(_OF_DAY.fullmatch(text) is not None for text in filled) * 2 > len(filled):
        return _of_day(shown, options)
    first = _day_first(filled)
    warnings = []
    if first is None:
        first = _first_by_name(filled, options.file_name)
        reason = "as the date in the file name"
        if first is None:
            first, reason = european, "as where decimal commas are written" if european else "a guess"
        word = "day" if first else "month"
        warnings = [f"the dates can be read with the day or the month first: the {word} was taken, {reason}"]
    if len(set(filled)) < len(filled) and 2 * sum(_NO_SECONDS.fullmatch(text) is not None for text in filled) > len(
        filled
    ):
        warnings.append("the times have no seconds (a table saved by a spreadsheet?): rows of a minute share one time")
    cells = [text.encode() if _COMMON.fullmatch(text) else _dated(text, bool(first)) or b"-" for text in shown]
    return "wall", _lines.cells(cells), warnings


def refuse_rounded(texts: Sequence[str]) -> None:
    """Refuse a column of epochs that lost their last digits: all rows of minutes or days would share a time.

    Raises
    ------
    InputError
        If most of the texts are such.
    """
    rounded = [text for text in texts if _ROUNDED.fullmatch(text)]
    if 2 * len(rounded) > len(texts):
        raise InputError(
            f"the times are rounded, such as {rounded[0]}",
            expected="all digits of the epoch",
            cause="the table was saved by a spreadsheet, which shortens long numbers",
        )


def _numbers(texts: Sequence[str], unit: str | None, options: ReadOptions) -> tuple[str, AnyArray, list[str]]:
    """Numbers: epochs by their size, else relative times."""
    value = np.array([float(text.replace(",", ".")) if _NUMBER.fullmatch(text) else np.nan for text in texts])
    middle = float(np.nanmedian(np.abs(value))) if np.isfinite(value).any() else 0.0
    for scale, form in ((1e18, None), (1e15, "epoch_us"), (1e12, "epoch_ms"), (1e9, "epoch_s")):
        if middle >= 0.9 * scale and scale >= _LEAST_EPOCH.get(unit or "", 0.0):
            return (form, value, []) if form else ("epoch_us", value / 1e3, [])
    if unit is None and 86_400 < middle < 86_400_000 and not (value % 1 > 0).any():
        if np.nanmin(value) < 3_600_000:
            return "relative_ms", value, [_MILLISECONDS]
        return _on_a_date(value / 1e3, options, [_MILLISECONDS + " of the day"])
    for zero, low, high, program in _DAY_NUMBERS:
        if unit is None and len(value) > 2 and _are_days(value, low, high):
            text = f"the times are day numbers of {program}: read as local dates and times"
            return "wall", _wall_cells(np.datetime64(zero, "us"), value * 86_400.0), [text]
    return f"relative_{unit or 's'}", value, []


# An epoch in a unit that the head of the column says; 1e9 microseconds are a quarter of an hour of PX4's own clock.
_LEAST_EPOCH = {"s": 1e9, "ms": 1e12, "us": 1e15}
# Date of number zero, and the numbers of the years 2000 to 2099.
_DAY_NUMBERS = (
    ("1899-12-30", 36_526.0, 73_051.0, "a spreadsheet"),
    ("-001-12-31", 730_486.0, 767_011.0, "MATLAB"),
)


def _are_days(value: FloatArray, low: float, high: float) -> bool:
    """Check whether numbers are days with the time as fraction: within two days, from row to row less than 90 s."""
    finite = value[np.isfinite(value)]
    if len(finite) < 3 or finite.min() < low or finite.max() >= high or np.ptp(finite) > 2.0:
        return False
    return bool(0 < np.median(np.abs(np.diff(finite))) < 1e-3)


_MILLISECONDS = "the times are whole numbers beyond a day of seconds: read as milliseconds"


def _of_day(texts: Sequence[str], options: ReadOptions) -> tuple[str, AnyArray, list[str]]:
    """Times of the day: their date is that of ``time_origin``, of the file name, or nobody's."""
    matches = [_OF_DAY.fullmatch(text) for text in texts]
    seconds = np.array([_seconds(item.groups()) if item else np.nan for item in matches], dtype=np.float64)
    seconds += 86_400.0 * np.cumsum(np.nan_to_num(np.diff(seconds, prepend=np.nan)) < -43_200)
    marked = any(item[5] for item in matches if item)
    hours = _hours_off(seconds, options.file_name)
    seconds -= 3600.0 * hours
    warnings = ["the times are marked as UTC but read as local, as the program's own names say"] if marked else []
    if hours:
        warnings.append(f"the times are {hours:+d} h from the time in the file name: read as those of the name, local")
    return _on_a_date(seconds, options, warnings)


_NEMO_NAME = re.compile(r"(?<!\d)\d\d[A-Z][a-z]{2}\d\d_(\d\d)(\d\d)(\d\d)(?!\d)")
_NEAR_S = 300.0


def _hours_off(seconds: FloatArray, name: str) -> int:
    """Whole hours between the first time of the day [s] and the one in Nemo's file name; 0 where there is none."""
    written, first = _NEMO_NAME.search(name), seconds[np.isfinite(seconds)][:1]
    if written is None or not len(first):
        return 0
    apart = float(first[0]) - (int(written[1]) * 3600 + int(written[2]) * 60 + int(written[3]))
    hours = round(apart / 3600)
    return hours if abs(apart - 3600 * hours) < _NEAR_S else 0


def _on_a_date(seconds: FloatArray, options: ReadOptions, warnings: list[str]) -> tuple[str, AnyArray, list[str]]:
    """Seconds of the first day; relative where nothing says which day that is."""
    date = options.time_origin[:10] if options.time_origin else _date_in_name(options.file_name)
    if date is None or not re.fullmatch(r"\d{4}-\d\d-\d\d", date):
        return "relative_s", seconds, [*warnings, "the times have no date and the file name has none either"]
    cells = _wall_cells(np.datetime64(date, "us"), seconds)
    source = "time_origin" if options.time_origin else "the file name"
    return "wall", cells, [f"the times have no date: it is that of {source}, {date}", *warnings]


def _wall_cells(day: np.datetime64, seconds: FloatArray) -> AnyArray:
    """Seconds after the beginning of a day as texts."""
    stamps = day + np.round(np.nan_to_num(seconds) * 1e6).astype("timedelta64[us]")
    return np.where(np.isnan(seconds), b"-", np.datetime_as_string(stamps, unit="us").astype(np.bytes_))


def _seconds(parts: Sequence[str | None]) -> float:
    hour = int(parts[0] or 0)
    if parts[3]:
        hour = hour % 12 + (12 if parts[3].lower() == "pm" else 0)
    return hour * 3600.0 + int(parts[1] or 0) * 60.0 + float((parts[2] or "0").replace(",", "."))
