"""Tables with a header whose columns come in any order and under the names of several programs.

The header is looked for behind title lines; the separator is the one that the header uses; a decimal comma is read
where the separator leaves room for one.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property

import numpy as np

from aerpaw_cmp.common.units import BoolArray, FloatArray, IntArray
from aerpaw_cmp.logs import lines as _lines
from aerpaw_cmp.logs import rows as _rows
from aerpaw_cmp.logs.readers import ReadOptions
from aerpaw_cmp.logs.records import ReadResult, RejectedLine

from . import _stamps
from ._quantities import SRSUE, plain

SEPARATORS = (",", ";", "\t", "|")
# Lines in front of a header, at most.
TITLES = 60
_NUMBER = re.compile(r"[-+]?\d{0,20}(?:[.,]\d{0,20})?(?:[eE][-+]?\d{1,3})?")
_UNIT = re.compile(r"[\[(]([^\[\]()]{1,12})[\])]\s*$")
_A_UNIT = re.compile(r"(?!lte$|nr$|5g$|4g$|utc$|gps$|local$|dl$|ul$)[a-z\u00b5%\u00b0]{1,7}(/[a-z]{1,3})?")
# Units of values as they are read, and what one of each unit that a header may have is in them.
_READ_IN = {
    "m": {"ft": 0.3048, "feet": 0.3048, "m": 1.0, "meters": 1.0, "cm": 0.01, "mm": 1e-3, "km": 1e3},
    "m/s": {
        "mph": 0.44704, "m/s": 1.0, "km/h": 1 / 3.6, "kmh": 1 / 3.6, "kts": 0.514444, "knots": 0.514444, "cm/s": 0.01,
    },
    "deg": {"deg": 1.0, "degrees": 1.0, "rad": 180 / np.pi, "radians": 180 / np.pi},
    "bit/s": {
        "bps": 1.0, "bit/s": 1.0, "kbps": 1e3, "kbit/s": 1e3, "mbps": 1e6, "mbit/s": 1e6, "gbps": 1e9, "gbit/s": 1e9,
    },
    "dB": {"db": 1.0},
    "dBm": {"dbm": 1.0},
}  # fmt: skip
_FACTORS = {written: (unit, factor) for unit, units in _READ_IN.items() for written, factor in units.items()}

_IsHeader = Callable[[list[str]], bool]


def split_row(line: bytes, separator: str) -> list[str]:
    """Fields of a line; quotes hide separators."""
    text = line.decode("utf-8-sig", errors="replace")
    if '"' not in text:
        return text.split(separator)
    try:
        return next(csv.reader([text.replace("\0", "\ufffd").replace("\r", " ")], delimiter=separator), [])
    except csv.Error:
        return text.split(separator)


def _header_of(lines: Sequence[bytes], is_header: _IsHeader) -> tuple[int, str, list[str]] | None:
    """Place, separator and names of the first line that is a header.

    Parameters
    ----------
    is_header : callable
        Of the names in plain form, see :func:`_quantities.plain`.
    """
    for i, line in enumerate(lines[:TITLES]):
        if len(line) > 65_536 or b"\0" in line:
            return None
        for separator in SEPARATORS:
            if separator.encode() not in line:
                continue
            names = [name.strip() for name in split_row(line, separator)]
            if len(names) > 1 and is_header([plain(name) for name in names]):
                return i, separator, names
    return None


def starts(head: bytes, is_header: _IsHeader) -> bool:
    """Check whether a file begins with such a header, title lines aside, and a row of its width soon follows."""
    lines = [line.rstrip(b"\r") for line in head.split(b"\n")[: 2 * TITLES]]
    header = _header_of(lines, is_header)
    if header is None:
        return False
    at, separator, names = header
    below = [line for line in lines[at + 1 :] if line.strip()][:5]
    return not below or any(abs(len(split_row(line, separator)) - len(names)) <= 1 for line in below)


def _number(text: str) -> float:
    plain_text = text.replace("\u2212", "-")  # the minus sign of typesetting, which word processors put in
    if not text or not _NUMBER.fullmatch(plain_text):
        return np.nan
    try:
        return float(plain_text.replace(",", "."))
    except ValueError:
        return np.nan


@dataclass
class Sheet:
    """A table: names of its columns, and the texts of its cells.

    Parameters
    ----------
    lines : Lines
    names : list of str
        Column names as written.
    row : int array, shape (n,)
        0-based lines of the rows.
    cells : list of list of str, length n
    blank_rows : int array
        0-based lines of titles, headers and words below the table.
    rejected : list of RejectedLine
    units : dict of int to str
        Units of columns whose names have none.
    """

    lines: _lines.Lines
    names: list[str]
    row: IntArray
    cells: list[list[str]]
    blank_rows: IntArray
    rejected: list[RejectedLine] = field(default_factory=list)
    units: dict[int, str] = field(default_factory=dict)
    _silent: dict[int, BoolArray] = field(default_factory=dict)
    _numbers: dict[int, FloatArray] = field(default_factory=dict)
    _words: dict[int, tuple[int, str]] = field(default_factory=dict)

    def __len__(self) -> int:
        """Count the rows."""
        return len(self.row)

    @cached_property
    def plain(self) -> list[str]:
        """Names in plain form."""
        return [plain(name) for name in self.names]

    def find(self, *patterns: str) -> int | None:
        """The first column whose plain name is wholly one of the patterns; earlier patterns are preferred."""
        any_of, *each = _compiled(patterns)
        names = [(i, name) for i, name in enumerate(self.plain) if any_of.fullmatch(name)]
        return next((i for pattern in each for i, name in names if pattern.fullmatch(name)), None)

    def unit(self, column: int) -> str:
        """Unit in brackets at the end of a column's name, or the one that is known of it, or an empty text."""
        written = _UNIT.search(self.names[column])
        return written[1].strip().lower() if written else self.units.get(column, "")

    def unit_read(self, column: int) -> str:
        """Unit of :meth:`numbers`; empty where the brackets hold something else, such as ``(LTE scell0)``."""
        unit = self.unit(column)
        return _FACTORS[unit][0] if unit in _FACTORS else unit if _A_UNIT.fullmatch(unit) else ""

    def silence(self, where: BoolArray, columns: Iterable[int]) -> None:
        """Read the cells of some rows as empty."""
        for column in columns:
            self._silent[column] = where
            self._numbers.pop(column, None)

    def keep(self, where: BoolArray) -> None:
        """Leave the rows out that a mask does not hold."""
        self.cells = [cells for cells, inside in zip(self.cells, where.tolist(), strict=True) if inside]
        self.row = self.row[where]
        self._silent = {column: mask[where] for column, mask in self._silent.items()}
        self._numbers = {}

    def texts(self, column: int) -> list[str]:
        """A column as text."""
        column_texts = [cells[column].strip() for cells in self.cells]
        if column in self._silent:
            column_texts = [
                "" if silent else text for text, silent in zip(column_texts, self._silent[column].tolist(), strict=True)
            ]
        return column_texts

    def numbers(self, column: int) -> FloatArray:
        """A column as numbers in the unit of its name's brackets made SI or degrees; what is none is NaN. Read only."""
        if column not in self._numbers:
            texts = self.texts(column)
            if self._has_points and _are_thousands(texts):
                texts = [text.replace(",", "") for text in texts]
            parsed = {text: _number(text) for text in set(texts)}  # tables repeat themselves
            values = np.array([parsed[text] for text in texts], dtype=np.float64)
            words = [text for text in texts if np.isnan(parsed[text]) and text.lower() not in _NONE]
            if 2 * len(words) > sum(text.lower() not in _NONE for text in texts):
                self._words[column] = len(words), words[0]
            values *= _FACTORS.get(self.unit(column), ("", 1.0))[1]
            values.flags.writeable = False  # the next who asks gets the same
            self._numbers[column] = values
        return self._numbers[column]

    @cached_property
    def _has_points(self) -> bool:
        """Check whether the first row has a decimal point: then no comma of the table is a decimal one."""
        return bool(self.cells) and any(_DECIMAL_POINT.fullmatch(cell.strip()) for cell in self.cells[0])

    def unread(self) -> list[str]:
        """A sentence for each column that was to be numbers and mostly holds something else."""
        return [
            f"column {self.names[column]!r}: {count} cells are no number (the first: {text[:30]!r}) and read as missing"
            for column, (count, text) in sorted(self._words.items())
        ]


_DECIMAL_POINT = re.compile(r"-?\d{1,9}\.\d{1,15}")
_THOUSANDS = re.compile(r"[-+]?\d{1,3}(?:,\d{3})+(?:\.\d{0,12})?")
# Cells that say that there is no value.
_NONE = {"", "-", "--", "nan", "na", "n/a", "#n/a", "none", "null", "inf", "-inf", "unavailable", "unknown", "invalid"}


def _are_thousands(texts: Sequence[str]) -> bool:
    """Check whether the commas of a column part thousands: ``1,300`` and never ``35,72``."""
    return any("," in text for text in texts) and all(_THOUSANDS.fullmatch(text) for text in texts if "," in text)


@cache
def _compiled(patterns: tuple[str, ...]) -> list[re.Pattern[str]]:
    """Patterns for whole names: all of them as one, and then each."""
    return [re.compile(text) for text in ("|".join(f"(?:{item})" for item in patterns), *patterns)]


def matches(name: str, patterns: tuple[str, ...]) -> bool:
    """Check whether a plain name is wholly one of the patterns."""
    return _compiled(patterns)[0].fullmatch(name) is not None


def read(data: bytes, is_header: _IsHeader) -> Sheet | None:
    """The table of a file, None where none of its first lines is its header."""
    header = _header_of([line.removesuffix(b"\r") for line in data.split(b"\n", TITLES)[:TITLES]], is_header)
    if header is None:
        return None
    return cut(_lines.split(data), *header)


def cut(lines: _lines.Lines, at: int, separator: str, names: list[str]) -> Sheet:
    """The table below a header; lines above it, headers again and words at the end are comments, torn rows rejected.

    Parameters
    ----------
    lines : Lines
    at : int
        0-based line of the header.
    separator : str
    names : list of str
        Fields of the header.

    Returns
    -------
    Sheet
    """
    below = ~lines.blank
    below[: at + 1] = False
    row: list[int] = []
    cells: list[list[str]] = []
    comments: list[int] = [*range(at + 1)]
    odd: list[tuple[int, int]] = []
    split = _fitted([(i, split_row(lines.raw(i), separator)) for i in np.flatnonzero(below).tolist()], names)
    for i, fields in split:
        if len(fields) != len(names):
            odd.append((i, len(fields)))
        elif fields[0].strip() == names[0] and [text.strip() for text in fields] == names:
            comments.append(i)  # a header again: files joined by hand
        else:
            row.append(i)
            cells.append(fields)
    last = row[-1] if row else at
    torn = len(lines) - 1 if lines.unterminated else -1
    # words below the table, as Nemo writes them, have no separator
    foot = {i for i, count in odd if i > last and count == 1 and i != torn}
    return Sheet(
        lines=lines,
        names=names,
        row=np.array(row, dtype=np.int64),
        cells=cells,
        blank_rows=np.array([*comments, *foot], dtype=np.int64),
        rejected=[
            lines.reject(i, f"{count} fields where the header has {len(names)} (torn line?)")
            for i, count in odd
            if i not in foot
        ],
    )


def _fitted(rows: list[tuple[int, list[str]]], names: list[str]) -> list[tuple[int, list[str]]]:
    """Rows without what a separator at the end of rows, or of the header alone, makes of them.

    An empty field more is the table's habit or none: a row whose time or level has a bare decimal comma looks so, too,
    and its columns would be those beside.
    """
    longer = [not fields[-1].strip() for _, fields in rows if len(fields) == len(names) + 1]
    filled = longer.count(False)  # a torn row or two may have a field more, too
    if 2 * longer.count(True) > len(rows) and filled <= max(1, len(rows) // 100):
        rows = [
            (i, fields[:-1] if len(fields) == len(names) + 1 and not fields[-1].strip() else fields)
            for i, fields in rows
        ]
    if not names[-1]:
        rows = [(i, [*fields, ""] if len(fields) == len(names) - 1 else fields) for i, fields in rows]
    return rows


# Names of the column of times, the surest first.
TIME_NAMES = (
    r"time utc usec",
    r"(gps )?(time ?stamp|date ?time|time and date|date and time)( utc| gps| local| ms| s| iso| unix)?",
    r"(abs|log|pc|device|event|system|utc|gps|local|unix|epoch) ?time( stamp)?( utc| gps| local| ms| s)?",
    r"(custom )?(update ?)?time( utc| ms| s| local| epoch)?",
    r"time ?millisecond",
    r"(rel|relative|elapsed) ?time( ms| s)?",
    r"t",
)


# Columns of ulog2csv's tables, whose time counts microseconds since the autopilot was switched on.
PX4 = {"timestamp", "timestamp sample"}


def rows(sheet: Sheet, options: ReadOptions, *, reader: str, also: Sequence[str] = ()) -> _rows.Rows | None:
    """Rows of a table with their times; None where no column is one of times.

    Parameters
    ----------
    also : sequence of str
        Patterns of further names of the time column, preferred.
    """
    column = sheet.find(*also, *TIME_NAMES)
    if column is None:
        return None
    texts = sheet.texts(column)
    day = sheet.find(r"(custom )?date( local| utc)?")
    if day is not None and day != column:
        pairs = zip(sheet.texts(day), sheet.texts(column), strict=True)
        texts = [f"{date} {time}".strip() for date, time in pairs]
    name, unit = sheet.plain[column], sheet.unit(column)
    in_ms = unit in ("ms", "millisecond", "milliseconds") or re.search(r"\bms\b|millisecond", name) is not None
    count = "ms" if in_ms or set(sheet.plain) >= SRSUE else "s" if unit or name.endswith(" s") else None
    # the sign for micro is no letter of a plain name: 'Time [\u00b5s]' is 'time s' there
    in_us = unit in ("us", "\u00b5s", "\u03bcs") or (set(sheet.plain) >= PX4 and name == "timestamp")
    count = "us" if in_us else count
    utc = re.search(r"\b(utc|gps|gmt)\b", name) is not None
    clock, cells, warnings = _stamps.read(texts, options, unit=count, european=_has_decimal_commas(sheet))
    if clock == "wall" and utc and not np.char.endswith(cells, b"Z").all():
        cells = np.array([cell if re.search(rb"(Z|[+-]\d\d:?\d\d)$", cell) else cell + b"Z" for cell in cells.tolist()])
    timed = _rows.built(
        sheet.lines, sheet.row, {"time": cells}, options, reader=reader, reason=lambda _line: None, clock=clock,
        extra=sheet.rejected, markup=sheet.blank_rows,
    )  # fmt: skip
    timed.warnings += warnings
    if len(timed.row) < len(sheet.row):
        sheet.keep(np.isin(sheet.row, timed.row))
    if (counter := sheet.find("time millisecond")) not in (None, column):
        _finer(timed, sheet.numbers(counter))
    return timed


_DECIMAL_COMMA = re.compile(r"-?\d{1,4},\d{1,9}")


def _has_decimal_commas(sheet: Sheet) -> bool:
    """Check whether the first row has numbers with a decimal comma."""
    return bool(sheet.cells) and any(_DECIMAL_COMMA.fullmatch(cell.strip()) for cell in sheet.cells[0])


_MOST_APART_NS = 1_500_000_000
# Half of what a time stamp holds.
_MOST_NS = 2.0**62


def _finer(rows: _rows.Rows, milliseconds: FloatArray) -> None:
    """Times cut to whole seconds, with the fractions that a column of milliseconds has (AirData)."""
    time = rows.time.astype(np.int64)
    known = np.isfinite(milliseconds)
    if rows.relative or not known.any() or (time % 1_000_000_000).any():
        return
    counted_ns = np.round(np.where(known, milliseconds, 0.0) * 1e6)
    fits = np.abs(counted_ns).max() < _MOST_NS
    counted = counted_ns.astype(np.int64) if fits else np.zeros_like(time)
    zero = (time - counted)[known]
    if not fits or zero.max() - zero.min() > _MOST_APART_NS:
        rows.warnings.append("the column of milliseconds does not go with the times: it is left out")
        return
    rows.time = np.where(known, zero.max() + counted, time).astype("datetime64[ns]")


def nothing(data: bytes, reader: str, reason: str) -> ReadResult:
    """The account of a file without such a table: every line rejected."""
    lines = _lines.split(data)
    filled = np.flatnonzero(~lines.blank)
    rejected = tuple(lines.reject_all(filled, reason))
    return ReadResult(
        reader=reader, streams=(), lines=len(lines), accepted=0, blank=len(lines) - len(filled), rejected=rejected
    )
