"""Tables with a header whose columns come in any order and under the names of several programs.

The header is looked for behind title lines; the separator is the one that the header uses; a decimal comma is read
where the separator leaves room for one.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from aerpaw_cmp.common.units import FloatArray, IntArray
from aerpaw_cmp.logs.readers import ReadOptions
from aerpaw_cmp.logs.records import ReadResult, RejectedLine

from . import _lines, _rows, _stamps
from ._quantities import plain

SEPARATORS = (",", ";", "\t", "|")
TITLES = 60
"""Lines in front of a header, at most."""
_MOST_TEXTS = 200_000
_NUMBER = re.compile(r"[-+]?\d{0,20}(?:[.,]\d{0,20})?(?:[eE][-+]?\d{1,3})?")
_UNIT = re.compile(r"[\[(]([^\[\]()]{1,12})[\])]\s*$")
_FACTORS = {
    "ft": 0.3048, "feet": 0.3048, "m": 1.0, "meters": 1.0, "mph": 0.44704, "m/s": 1.0, "km/h": 1 / 3.6, "kmh": 1 / 3.6,
    "kts": 0.514444, "knots": 0.514444, "deg": 1.0, "degrees": 1.0, "rad": 180 / np.pi, "radians": 180 / np.pi,
    "kbps": 1e3, "mbps": 1e6, "kbit/s": 1e3, "mbit/s": 1e6, "bps": 1.0, "bit/s": 1.0,
}  # fmt: skip

IsHeader = Callable[[list[str]], bool]


def _split(line: bytes, separator: str) -> list[str]:
    text = line.decode("utf-8-sig", errors="replace")
    if '"' not in text:
        return text.split(separator)
    try:
        return next(csv.reader([text.replace("\0", "\ufffd").replace("\r", " ")], delimiter=separator), [])
    except csv.Error:
        return text.split(separator)


def header_of(lines: Sequence[bytes], is_header: IsHeader) -> tuple[int, str, list[str]] | None:
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
            names = [name.strip() for name in _split(line, separator)]
            if len(names) > 1 and is_header([plain(name) for name in names]):
                return i, separator, names
    return None


def starts(head: bytes, is_header: IsHeader) -> bool:
    """Whether a file begins with such a header, title lines aside, and a row of its width soon follows."""
    lines = [line.rstrip(b"\r") for line in head.split(b"\n")[: 2 * TITLES]]
    found = header_of(lines, is_header)
    if found is None:
        return False
    at, separator, names = found
    below = [line for line in lines[at + 1 :] if line.strip()][:5]
    return not below or any(abs(len(_split(line, separator)) - len(names)) <= 1 for line in below)


def _number(text: str) -> float:
    if not text or not _NUMBER.fullmatch(text):
        return np.nan
    try:
        return float(text.replace(",", "."))
    except ValueError:
        return np.nan


@dataclass
class Sheet:
    """A table: names of its columns, and its rows as text.

    Parameters
    ----------
    lines : Lines
    names, plain : list of str
        Column names as written, and in plain form.
    row : int array, shape (n,)
        0-based lines of the rows.
    cells : list of list of str
        One list per row.
    blank_rows : int array
        0-based lines of titles and header.
    rejected : list of RejectedLine
    comma : bool
        Is a comma in a number its decimal sign?
    """

    lines: _lines.Lines
    names: list[str]
    row: IntArray
    cells: list[list[str]]
    blank_rows: IntArray
    rejected: list[RejectedLine] = field(default_factory=list)
    comma: bool = False

    @cached_property
    def plain(self) -> list[str]:
        """Names in plain form."""
        return [plain(name) for name in self.names]

    def find(self, *patterns: str) -> int | None:
        """The first column whose plain name is wholly one of the patterns; earlier patterns are preferred."""
        for pattern in patterns:
            for i, name in enumerate(self.plain):
                if re.fullmatch(pattern, name):
                    return i
        return None

    def unit(self, column: int) -> str:
        """Unit in brackets at the end of a column's name, or an empty text."""
        found = _UNIT.search(self.names[column])
        return found[1].strip().lower() if found else ""

    def texts(self, column: int) -> list[str]:
        """A column as text."""
        return [cells[column].strip() for cells in self.cells]

    def numbers(self, column: int) -> FloatArray:
        """A column as numbers in the unit of its name's brackets made SI or degrees; what is none is NaN."""
        factor = _FACTORS.get(self.unit(column), 1.0)
        known: dict[str, float] = {}  # few distinct texts in most columns
        out = np.empty(len(self.cells))
        for i, cells in enumerate(self.cells):
            text = cells[column]
            value = known.get(text)
            if value is None:
                value = known[text] = _number(text.strip())
            out[i] = value
        return out * factor


def read(data: bytes, is_header: IsHeader) -> Sheet | None:
    """The table of a file, None where no line is its header."""
    lines = _lines.split(data)
    found = header_of([lines.raw(i) for i in range(min(len(lines), TITLES))], is_header)
    if found is None:
        return None
    at, separator, names = found
    number: list[int] = []
    cells: list[list[str]] = []
    rejected: list[RejectedLine] = []
    repeats: list[int] = []
    width = len(names)
    same: dict[str, str] = {}  # one text object for equal cells: tables repeat themselves
    for i in np.flatnonzero(~lines.blank).tolist():
        if i <= at:
            continue
        one = _split(lines.raw(i), separator)
        if len(one) == width + 1 and not one[-1].strip():
            one.pop()  # a separator at the end of each row
        if len(one) == width - 1 and not names[-1]:
            one.append("")
        if [text.strip() for text in one] == names:
            repeats.append(i)  # files joined by hand
        elif len(one) == width:
            number.append(i)
            cells.append([same.setdefault(text, text) for text in one])
            if len(same) > _MOST_TEXTS:
                same.clear()
        else:
            rejected.append(lines.reject(i, f"{len(one)} fields where the header has {width} (torn line?)"))
    last = number[-1] if number else at
    foot = [line.number - 1 for line in rejected if line.number - 1 > last and separator not in line.text]
    if foot and lines.unterminated and foot[-1] == len(lines) - 1:
        foot.pop()  # a torn row
    if foot:
        repeats += foot  # words below the table, as Nemo writes them
        rejected = [line for line in rejected if line.number - 1 not in foot]
    comments = np.array([*range(at + 1), *repeats], dtype=np.int64)
    return Sheet(
        lines=lines,
        names=names,
        row=np.array(number, dtype=np.int64),
        cells=cells,
        blank_rows=comments,
        rejected=rejected,
        comma=separator != ",",
    )


TIME_NAMES = (
    r"(gps )?(time ?stamp|date ?time|time and date|date and time)( utc| gps| local| ms| s| iso| unix)?",
    r"(abs|log|pc|device|event|system|utc|gps|local|unix|epoch) ?time( stamp)?( utc| gps| local| ms| s)?",
    r"(custom )?(update ?)?time( utc| ms| s| local)?",
    r"time ?millisecond",
    r"(rel|relative|elapsed) ?time( ms| s)?",
    r"t",
)
"""Names of the column of times, the surest first."""


SRSUE = {"time", "cc", "earfcn", "rsrp", "cfo"}
"""Columns of srsUE's metrics file, whose time counts milliseconds."""


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
        texts = [f"{date} {time}".strip() for date, time in zip(sheet.texts(day), texts, strict=True)]
    name, unit = sheet.plain[column], sheet.unit(column)
    in_ms = unit in ("ms", "millisecond", "milliseconds") or re.search(r"\bms\b|millisecond", name) is not None
    count = "ms" if in_ms or set(sheet.plain) >= SRSUE else "s"
    utc = re.search(r"\b(utc|gps|gmt)\b", name) is not None
    clock, cells, warnings = _stamps.read(texts, options, unit=count)
    if clock == "wall" and utc and len(cells):
        cells = np.array([cell if re.search(rb"(Z|[+-]\d\d:?\d\d)$", cell) else cell + b"Z" for cell in cells.tolist()])
    made = _rows.built(
        sheet.lines, sheet.row, {"time": cells}, options, reader=reader, reason=lambda _line: None, clock=clock,
        extra=sheet.rejected, markup=sheet.blank_rows,
    )  # fmt: skip
    made.warnings += warnings
    kept = np.isin(sheet.row, made.row)
    sheet.cells = [cells for cells, keep in zip(sheet.cells, kept.tolist(), strict=True) if keep]
    sheet.row = made.row
    return made


def nothing(data: bytes, reader: str, reason: str) -> ReadResult:
    """The account of a file without such a table: every line rejected."""
    lines = _lines.split(data)
    left = np.flatnonzero(~lines.blank)
    rejected = tuple(lines.reject_all(left, reason))
    return ReadResult(
        reader=reader, streams=(), lines=len(lines), accepted=0, blank=len(lines) - len(left), rejected=rejected
    )
