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
from aerpaw_cmp.logs.readers import ReadOptions
from aerpaw_cmp.logs.records import ReadResult, RejectedLine

from . import _alike, _by_eights, _decided, _lines, _rows, _stamps, _table
from ._quantities import plain

SEPARATORS = (",", ";", "\t", "|")
TITLES = 60
"""Lines in front of a header, at most."""
_MOST_TEXTS = 200_000
_LONGEST_TIME = 64
_NUMBER = re.compile(r"[-+]?\d{0,20}(?:[.,]\d{0,20})?(?:[eE][-+]?\d{1,3})?")
_UNIT = re.compile(r"[\[(]([^\[\]()]{1,12})[\])]\s*$")
_READ_IN = {
    "m": {"ft": 0.3048, "feet": 0.3048, "m": 1.0, "meters": 1.0},
    "m/s": {"mph": 0.44704, "m/s": 1.0, "km/h": 1 / 3.6, "kmh": 1 / 3.6, "kts": 0.514444, "knots": 0.514444},
    "deg": {"deg": 1.0, "degrees": 1.0, "rad": 180 / np.pi, "radians": 180 / np.pi},
    "bit/s": {
        "bps": 1.0, "bit/s": 1.0, "kbps": 1e3, "kbit/s": 1e3, "mbps": 1e6, "mbit/s": 1e6, "gbps": 1e9, "gbit/s": 1e9,
    },
    "dB": {"db": 1.0},
    "dBm": {"dbm": 1.0},
}  # fmt: skip
"""Units of values as they are read, and what one of each unit that a header may have is in them."""
_FACTORS = {written: (unit, one) for unit, many in _READ_IN.items() for written, one in many.items()}

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
    """A table: names of its columns, and where its cells are.

    Parameters
    ----------
    lines : Lines
    names, plain : list of str
        Column names as written, and in plain form.
    row : int array, shape (n,)
        0-based lines of the rows.
    quick : Fields
        Cells of the rows that separators alone divide.
    quick_at : int array
        Which of the rows these are.
    slow : list of list of str
        Cells of all other rows: quoted ones, mostly.
    slow_at : int array
        Which of the rows these are.
    blank_rows : int array
        0-based lines of titles and header.
    rejected : list of RejectedLine
    comma : bool
        Is a comma in a number its decimal sign?
    foot : bool
        Do words stand below the table?
    units : dict of int to str
        Units of columns whose names have none.
    """

    lines: _lines.Lines
    names: list[str]
    row: IntArray
    quick: _table.Fields
    quick_at: IntArray
    slow: list[list[str]]
    slow_at: IntArray
    blank_rows: IntArray
    rejected: list[RejectedLine] = field(default_factory=list)
    comma: bool = False
    foot: bool = False
    units: dict[int, str] = field(default_factory=dict)
    _silent: dict[int, BoolArray] = field(default_factory=dict)
    _numbers: dict[int, FloatArray] = field(default_factory=dict)

    def __len__(self) -> int:
        """Count the rows."""
        return len(self.row)

    @cached_property
    def plain(self) -> list[str]:
        """Names in plain form."""
        return [plain(name) for name in self.names]

    @cached_property
    def _pointed(self) -> _lines.Lines:
        """The lines with each comma of a number as a point."""
        lines = self.lines
        return _lines.Lines(lines.data.replace(b",", b"."), lines.starts, lines.ends) if self.comma else lines

    def find(self, *patterns: str) -> int | None:
        """The first column whose plain name is wholly one of the patterns; earlier patterns are preferred."""
        any_of, *each = _compiled(patterns)
        names = [(i, name) for i, name in enumerate(self.plain) if any_of.fullmatch(name)]
        return next((i for pattern in each for i, name in names if pattern.fullmatch(name)), None)

    def unit(self, column: int) -> str:
        """Unit in brackets at the end of a column's name, or the one that is known of it, or an empty text."""
        found = _UNIT.search(self.names[column])
        return found[1].strip().lower() if found else self.units.get(column, "")

    def unit_read(self, column: int) -> str:
        """Unit of :meth:`numbers`."""
        unit = self.unit(column)
        return _FACTORS[unit][0] if unit in _FACTORS else unit

    def silence(self, where: BoolArray, columns: Iterable[int]) -> None:
        """Read the cells of some rows as empty."""
        for column in columns:
            self._silent[column] = where
            self._numbers.pop(column, None)

    def keep(self, where: BoolArray) -> None:
        """Leave the rows out that a mask does not hold."""
        if where.all():
            return
        at = np.cumsum(where) - 1
        quick, slow = where[self.quick_at], where[self.slow_at]
        self.quick, self.quick_at = self.quick.take(quick), at[self.quick_at[quick]]
        self.slow = [cells for cells, kept in zip(self.slow, slow.tolist(), strict=True) if kept]
        self.slow_at = at[self.slow_at[slow]]
        self.row = self.row[where]
        self._silent = {column: mask[where] for column, mask in self._silent.items()}
        self._numbers = {}

    def texts(self, column: int) -> list[str]:
        """A column as text."""
        made = np.full(len(self), "", dtype=object)
        if column < self.quick.ends.shape[1]:
            made[self.quick_at] = self._cells(column)
        made[self.slow_at] = [cells[column].strip() for cells in self.slow]
        if column in self._silent:
            made[self._silent[column]] = ""
        return list(made)

    def cells(self, column: int) -> Sequence[str]:
        """A column as text, spaces around included; without an object per cell where that can be."""
        plain = not self.slow and column not in self._silent and self.lines.data.isascii() and len(self) > 0
        if not plain or column >= self.quick.ends.shape[1] or int(self.quick.width(column).max()) > _LONGEST_TIME:
            return self.texts(column)
        return _alike.Cells(_table.texts(self.lines, self.quick.start(column), self.quick.ends[:, column]))

    def _cells(self, column: int) -> list[str]:
        """Texts of the quick rows."""
        data, form, text = self.lines.data, _form(column), self._ascii
        places = zip(self.quick.start(column).tolist(), self.quick.ends[:, column].tolist(), strict=True)
        if text is not None:
            return [text[begin:end].strip() for begin, end in places]
        return [data[begin:end].decode(form, "replace").strip() for begin, end in places]

    @cached_property
    def _ascii(self) -> str | None:
        return self.lines.data.decode("ascii") if self.lines.data.isascii() else None

    def numbers(self, column: int) -> FloatArray:
        """A column as numbers in the unit of its name's brackets made SI or degrees; what is none is NaN. Read only."""
        if column not in self._numbers:
            self._numbers[column] = self._parsed(column)
            self._numbers[column].flags.writeable = False  # the next who asks gets the same
        return self._numbers[column]

    def _parsed(self, column: int) -> FloatArray:
        factor = _FACTORS.get(self.unit(column), ("", 1.0))[1]
        quick = len(self.quick.rows) > 0 and column < self.quick.ends.shape[1]
        if quick and not self.slow:
            out = self._quick_numbers(column)
        else:
            out = np.full(len(self), np.nan)
            if quick:
                out[self.quick_at] = self._quick_numbers(column)
        if self.slow:
            texts = [cells[column] for cells in self.slow]
            known = {text: _number(text.strip()) for text in set(texts)}  # few distinct texts in most columns
            out[self.slow_at] = [known[text] for text in texts]
        if column in self._silent:
            out[self._silent[column]] = np.nan
        return out if factor == 1.0 else out * factor

    def _quick_numbers(self, column: int) -> FloatArray:
        begin, end, data = self.quick.start(column), self.quick.ends[:, column], self.lines.data
        spaced = self.lines.buffer[np.minimum(begin, len(data) - 1)] == 32
        if spaced.any():
            begin = begin + (spaced & (end > begin))
        read = _by_eights.decimals(self._pointed, _table.Fields(self.quick.rows, begin, end[:, None]), [0])
        value, odd = read.value[0], np.flatnonzero(read.odd[0])
        known: dict[bytes, float] = {}
        for i, first, last in zip(odd.tolist(), begin[odd].tolist(), end[odd].tolist(), strict=True):
            cell = data[first:last]
            found = known.get(cell)
            if found is None:
                found = known[cell] = _number(cell.decode(_form(column), "replace").strip())
            value[i] = found
        return value


@cache
def _compiled(patterns: tuple[str, ...]) -> list[re.Pattern[str]]:
    """Patterns for whole names: all of them as one, and then each."""
    return [re.compile(text) for text in ("|".join(f"(?:{one})" for one in patterns), *patterns)]


def matches(name: str, patterns: tuple[str, ...]) -> bool:
    """Whether a plain name is wholly one of the patterns."""
    return _compiled(patterns)[0].fullmatch(name) is not None


def _form(column: int) -> str:
    """What a cell is encoded as: a mark may stand in front of a line."""
    return "utf-8" if column else "utf-8-sig"


def head_bytes(is_header: IsHeader) -> Callable[[bytes], int]:
    """How many bytes titles and header of a table take: ``head(data)``, more than there are while it may yet come."""

    def head(data: bytes) -> int:
        lines: list[bytes] = []
        ends = [0]
        while len(lines) < TITLES and (stop := data.find(b"\n", ends[-1])) >= 0:
            lines.append(data[ends[-1] : stop].removesuffix(b"\r"))
            ends.append(stop + 1)
        found = header_of(lines, is_header)
        if found is None:
            return 0 if len(lines) == TITLES else len(data) + 1
        return ends[found[0] + 1]

    return head


def read(data: bytes, is_header: IsHeader, decided: _decided.Decided) -> Sheet | None:
    """The table of a file or of a block of it, None where no line is its header; all blocks have one, or none has."""
    found = header_of([line.removesuffix(b"\r") for line in data.split(b"\n", TITLES)[:TITLES]], is_header)
    decided.agree("a header among the first lines", found is not None)
    if found is None:
        return None
    at, separator, names = found
    lines, fields = _by_eights.table(data, len(names), ord(separator))
    quick = _quick(lines, fields, at, separator, names)
    left = ~lines.blank
    left[: at + 1] = False
    left[quick.rows] = False
    rest = _rest(lines, np.flatnonzero(left), separator, names)
    number = np.array(rest.number, dtype=np.int64)
    row = np.sort(np.concatenate((quick.rows, number))) if len(number) else quick.rows
    last = int(row[-1]) if len(row) else at
    foot = [line.number - 1 for line in rest.rejected if line.number - 1 > last and separator not in line.text]
    if foot and lines.unterminated and foot[-1] == len(lines) - 1:
        foot.pop()  # a torn row
    below = set(foot)  # words below the table, as Nemo writes them
    return Sheet(
        lines=lines,
        names=names,
        row=row,
        quick=quick,
        quick_at=np.searchsorted(row, quick.rows) if len(number) else np.arange(len(row)),
        slow=rest.cells,
        slow_at=np.searchsorted(row, number),
        blank_rows=np.array([*range(at + 1), *rest.repeats, *foot], dtype=np.int64),
        rejected=[line for line in rest.rejected if line.number - 1 not in below],
        comma=separator != ",",
        foot=bool(foot),
    )


def _quick(lines: _lines.Lines, found: _table.Fields, at: int, separator: str, names: list[str]) -> _table.Fields:
    """Of the lines with as many cells as names the rows that separators alone divide: no quote, no repeated header."""
    width = len(names)
    if 2 * len(found.rows) < len(lines) - at and len(lines) > at + 1:
        others = [_table.fields(lines, width + 1, ord(separator))]  # a separator at the end of each row
        if not names[-1]:
            others.append(_table.fields(lines, width - 1, ord(separator)))
        found = max(found, *others, key=lambda fields: len(fields.rows))
    plain_rows = (found.rows > at) & ~lines.blank[found.rows]
    for sign in (b'"', b"\0"):
        if sign in lines.data:
            marked = np.searchsorted(lines.starts, _lines.places(lines.buffer, sign[0]), side="right") - 1
            plain_rows &= ~np.isin(found.rows, marked)
    if found.ends.shape[1] > width:
        plain_rows &= found.width(width) == 0
    plain_rows &= ~_may_be(lines, found, names[0])
    return found.take(plain_rows)


def _may_be(lines: _lines.Lines, found: _table.Fields, name: str) -> BoolArray:
    """Rows whose first cell may be a name: one that begins as the name does, or with what is no text."""
    first = lines.buffer[np.minimum(found.begin, max(len(lines.data) - 1, 0))]
    begins = name.encode()[:1]
    if not begins:
        return np.asarray((first < 48) | (first > 57))
    return np.asarray((first == begins[0]) | (first <= 32) | (first >= 128))


@dataclass
class _Rest:
    """Lines that are read one by one: rows, lines of another width, repeated headers."""

    number: list[int] = field(default_factory=list)
    cells: list[list[str]] = field(default_factory=list)
    rejected: list[RejectedLine] = field(default_factory=list)
    repeats: list[int] = field(default_factory=list)


def _rest(lines: _lines.Lines, numbers: IntArray, separator: str, names: list[str]) -> _Rest:
    made, width = _Rest(), len(names)
    same: dict[str, str] = {}  # one text object for equal cells: tables repeat themselves
    for i in numbers.tolist():
        one = _split(lines.raw(i), separator)
        if len(one) == width + 1 and not one[-1].strip():
            one.pop()  # a separator at the end of each row
        if len(one) == width - 1 and not names[-1]:
            one.append("")
        if [text.strip() for text in one] == names:
            made.repeats.append(i)  # files joined by hand
        elif len(one) == width:
            made.number.append(i)
            made.cells.append([same.setdefault(text, text) for text in one])
            if len(same) > _MOST_TEXTS:
                same.clear()
        else:
            made.rejected.append(lines.reject(i, f"{len(one)} fields where the header has {width} (torn line?)"))
    return made


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


def rows(
    sheet: Sheet, options: ReadOptions, decided: _decided.Decided, *, reader: str, also: Sequence[str] = ()
) -> _rows.Rows | None:
    """Rows of a table with their times; None where no column is one of times.

    Parameters
    ----------
    decided : Decided
        How earlier blocks of the table were read. Raises ``blocks.Whole`` where this one must be read otherwise.
    also : sequence of str
        Patterns of further names of the time column, preferred.
    """
    column = sheet.find(*also, *TIME_NAMES)
    if column is None:
        return None
    decided.begin(len(sheet), foot=sheet.foot)
    texts = sheet.cells(column)
    day = sheet.find(r"(custom )?date( local| utc)?")
    if day is not None and day != column:
        pairs = zip(sheet.texts(day), sheet.texts(column), strict=True)
        texts = [f"{date} {time}".strip() for date, time in pairs]
    name, unit = sheet.plain[column], sheet.unit(column)
    in_ms = unit in ("ms", "millisecond", "milliseconds") or re.search(r"\bms\b|millisecond", name) is not None
    count = "ms" if in_ms or set(sheet.plain) >= SRSUE else "s" if unit or name.endswith(" s") else None
    utc = re.search(r"\b(utc|gps|gmt)\b", name) is not None
    course: _stamps.Course = decided.kept.setdefault("times", _stamps.Course())
    clock, cells, warnings = _stamps.read(texts, options, unit=count, course=course)
    if any(texts):
        decided.agree("times", (clock, course.day_first, *warnings))
    if clock == "wall" and utc and not np.char.endswith(cells, b"Z").all():
        cells = np.array([cell if re.search(rb"(Z|[+-]\d\d:?\d\d)$", cell) else cell + b"Z" for cell in cells.tolist()])
    made = _rows.built(
        sheet.lines, sheet.row, {"time": cells}, options, reader=reader, reason=lambda _line: None, clock=clock,
        extra=sheet.rejected, markup=sheet.blank_rows,
    )  # fmt: skip
    made.warnings += warnings
    if len(made.row) < len(sheet.row):
        sheet.keep(np.isin(sheet.row, made.row))
    if (counter := sheet.find("time millisecond")) not in (None, column):
        _finer(made, sheet.numbers(counter))
    return made


_MOST_APART_NS = 1_500_000_000


def _finer(rows: _rows.Rows, milliseconds: FloatArray) -> None:
    """Times cut to whole seconds, with the fractions that a column of milliseconds has (AirData)."""
    time = rows.time.astype(np.int64)
    known = np.isfinite(milliseconds)
    if rows.relative or not known.any() or (time % 1_000_000_000).any():
        return
    counted = np.round(np.where(known, milliseconds, 0.0) * 1e6).astype(np.int64)
    zero = (time - counted)[known]
    if zero.max() - zero.min() > _MOST_APART_NS:
        rows.warnings.append("the column of milliseconds does not go with the times: it is left out")
        return
    rows.time = np.where(known, zero.max() + counted, time).astype("datetime64[ns]")


def nothing(data: bytes, reader: str, reason: str) -> ReadResult:
    """The account of a file without such a table: every line rejected."""
    lines = _lines.split(data)
    left = np.flatnonzero(~lines.blank)
    rejected = tuple(lines.reject_all(left, reason))
    return ReadResult(
        reader=reader, streams=(), lines=len(lines), accepted=0, blank=len(lines) - len(left), rejected=rejected
    )
