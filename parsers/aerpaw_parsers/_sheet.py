"""Tables with a header and columns in any order. The dictionary contains the meaning of column names.

The header may follow title lines. The separator of the header is also the separator of the rows. Decimal commas are
read if the separator is another character. A header in the middle of the file begins a new table. Trailing cells that a
program omits are read as empty. A table whose values are outside the ranges of the dictionary for its header is
refused.
"""

from __future__ import annotations

import csv
import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache, partial
from itertools import accumulate, compress, islice
from typing import NamedTuple

import numpy as np
import pandas as pd

from aerpaw_cmp.common.text import decoded
from aerpaw_cmp.common.units import AnyArray, BoolArray, FloatArray, IntArray
from aerpaw_cmp.logs import text as _text
from aerpaw_cmp.logs.limits import NEAR_DEG
from aerpaw_cmp.logs.rows import OtherLines, Rows, built, instants_of
from aerpaw_cmp.readers import InputError, ReadOptions, RejectedLine, UsageError, counted, dictionary

from . import _json, _stamps

# Spaces are tried last: first two or more spaces, as between columns of fixed width whose names may have several words,
# and then a single space.
SEPARATORS = (",", ";", "\t", "|", "  ", " ")
# Largest number of lines before a header.
TITLES = 60
_NUMBER = re.compile(r"([-+]?\d{0,20}(?:[.,]\d{0,40})?(?:[eE][-+]?\d{1,3})?) ?([^\d\s,.][^\d\s]{0,9})?")

_IsHeader = Callable[[list[str]], bool]


def split_row(line: bytes, separator: str) -> list[str]:
    """Split a line into fields at separators outside quotes."""
    text = decoded(line)
    if separator == "|" and text.startswith("|"):  # a table of Markdown
        text = text.strip("| ")
    if separator.startswith(" "):
        between = "\t" if len(separator) > 1 else " "
        text, separator = re.sub(f"{separator}+", between, text.strip(" #%")), between
    if '"' not in text:
        return text.split(separator)
    try:
        # the csv module raises for NUL (Python 3.10) and for a bare carriage return
        fields = next(csv.reader([text.replace("\0", "\ufffd").replace("\r", " ")], delimiter=separator), [])
    except csv.Error:
        fields = []
    # a spreadsheet may write each line as one quoted cell
    return fields if len(fields) > 1 else text.strip('"').split(separator)


# Sniffers split the same lines several times.
_fields = lru_cache(maxsize=4 * TITLES)(split_row)


def header_of(lines: Sequence[bytes], is_header: _IsHeader) -> tuple[int, str, list[str]] | None:
    """Return the index, separator and names of the first line that is a header."""
    for i, line in enumerate(lines[:TITLES]):
        # a longer line is not a header
        if len(line) > 65_536 or b"\0" in line:
            return None
        for separator in SEPARATORS:
            if separator.encode() not in line or (separator.startswith(" ") and not _is_even(lines[i:], separator)):
                continue
            names = [name.strip() for name in _fields(line, separator)]
            below = [name.strip() for name in _fields(lines[i + 1], separator)] if i + 1 < len(lines) else []
            filled = [name or group for group, name in zip(names, below, strict=False)]
            # if merged cells, such as tower names, are above the names, their empty cells are filled with the names
            # below, and names that they repeat belong to several towers
            grouped = len(below) == len(names) and ("" in names or len({*below}) < len(below))
            grouped = grouped and not any(map(_VALUE.match, below))
            if grouped and not any(name and not group for group, name in zip(names, below, strict=True)):
                grouped = len({*below}) < len(below) and not is_header(names)
            if len(names) > 1 and is_header(filled if grouped else names) and not any(map(_stamps.is_dated, names)):
                return i + grouped, separator, filled if grouped else names
    return None


def _is_even(lines: Sequence[bytes], separator: str) -> bool:
    """Check whether most lines below a header separated by spaces have as many fields as the header."""
    if b": " in lines[0]:  # keys and values, such as those of YAML
        return False
    width, *below = [len(_fields(line, separator)) for line in lines[:6] if line.strip()] or [0]
    # R and pandas write row numbers without a column name
    return 2 * max(below.count(width), below.count(width + 1)) > len(below) and max(below) <= width + 1


def starts(head: bytes, is_header: _IsHeader) -> bool:
    """Check whether a file begins with a header of this kind, perhaps below title lines, and with rows of its width."""
    # the header of JSON lines consists of the names of the values in the first objects
    if _json.BEGIN.match(head := _json.from_pairs(head)):
        entries = [] if _OF_PROGRAMS.search(head) else _json.beginning(head)
        return bool(entries) and is_header([*{name: "" for entry in entries for name in _json.readings(entry)[0]}])
    lines = [line.rstrip(b"\r") for line in head.split(b"\n")[: 2 * TITLES]]
    header = header_of(lines, is_header)
    if header is None:
        return False
    at, separator, names = header
    below = [(i, line) for i, line in enumerate(lines[at + 1 :]) if line.strip()]
    widths = [len(fields) for _, fields in islice(_logical(below, separator, len(names)), 5)]
    # rows may omit their last cells, or have an additional empty cell after a separator at their end
    return 2 * sum(len(names) < 2 * width and width <= len(names) + 1 for width in widths) >= len(widths)


# Keys of JSON that has its own reader: the tap's, PawPrints' and srsRAN's.
_OF_PROGRAMS = re.compile(rb'"(schema|log_type|connected_bssid|abs_time|ue_list)"\s*:')


def _number(text: str) -> tuple[float, str]:
    """Return the number and the unit of a cell, NaN for other text."""
    match = _NUMBER.fullmatch(text.replace("\u2212", "-"))  # word processors write the typographic minus sign
    if match is None or not match[1] or (match[2] and not (dictionary.is_unit(match[2]) or match[2] in _HARMLESS)):
        return np.nan, ""
    try:
        return float(match[1].replace(",", ".")), (match[2] or "").lower()
    except ValueError:
        return np.nan, ""


# Words for the fix of a GNSS receiver, in the order in which they are tried, and MAVLink's number of each.
_FIXES = tuple((re.compile(form), number) for form, number in dictionary.FIXES.items())


def _fix(text: str) -> str:
    """Return the number of a fix in words, such as ``NO_FIX`` or ``RTK_FIXED``, and other text unchanged."""
    word = re.sub(r"[^a-z0-9]+", " ", text.lower()).strip()
    if not re.search("[a-z]", word) or word in ("nan", "n a"):
        return text
    return next((number for form, number in _FIXES if form.search(word)), text)


# Forms such as 35.728 N and N 35 43.68, and degrees, minutes and seconds with their marks or colons.
_MARKS = "[\u00b0'\u2032\u2033\"dms: ]"
_ANGLE = re.compile(rf"([NSEW]?) ?[-+]?[\d.]+(?:{_MARKS}{{1,3}}[\d.]+){{0,2}}{_MARKS}{{0,3}}([NSEW]?)")


def _angle(text: str) -> tuple[float, str]:
    """Return number and unit of a position, which can be in degrees, minutes and seconds or with a hemisphere."""
    value, unit = _number(text)
    written = _ANGLE.fullmatch(text) if np.isnan(value) or unit == "w" else None
    if written is None:
        return value, unit
    try:
        parts = [float(part) for part in re.findall(r"[\d.]+", text)]
    except ValueError:
        return np.nan, ""
    value = sum(part / 60**i for i, part in enumerate(parts))
    return -value if {*written.groups()} & {"S", "W"} or text.startswith("-") else value, ""


# Names of cells and satellites in columns that usually contain a state or a count.
_A_CELL = re.compile(r"(?i)(?!\s*([01](\.0)?|[ps]?cell ?\d*)\s*$).*\d")
_NETWORK = dictionary.meaning("gateway")
_NAMES_IN = {"serving": _A_CELL, "neighbouring": _A_CELL, "satellites": re.compile(r"\s*[^\W\d_]\w*[- ]?\d")}
_VALUE = re.compile(r"\s*[-+\[\"]?\d")
# Units of cells that need no conversion.
_HARMLESS = ("%", "ms", "s", "Hz", "MHz", "kHz")
# Further texts in a line of units: a count, a ratio, the zone of times, and the form of dates and times, 'yyyy-mm-dd'.
_BESIDE_UNITS = re.compile(rf"#|-|1|UTC|GMT|{'|'.join(_HARMLESS)}|(?i:[ymdhs]+([-/.: ]+[ymdhsf]+)+)")


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
        0-based lines of titles, headers and text below the table.
    rejected : list of RejectedLine
    notes : dict
        Sentences about columns that are not read as they are written, by column. The number of columns is the key of a
        sentence about the table.
    closed : bool
        True if rows have their own end mark, so that a missing line end does not matter.
    mapped : dict
        Quantities that the user maps to columns with other names, by column.
    used : set of int
        Columns that are used in a stream; all parts of the table share this set.
    """

    lines: _text.Lines
    names: list[str]
    row: IntArray
    cells: list[list[str]]
    blank_rows: IntArray
    rejected: list[RejectedLine] = field(default_factory=list)
    notes: dict[int, str] = field(default_factory=dict)
    closed: bool = False
    mapped: dict[int, dictionary.Quantity] = field(default_factory=dict)
    used: set[int] = field(default_factory=set)
    _numbers: dict[int, FloatArray] = field(default_factory=dict)
    _cell_units: dict[int, str] = field(default_factory=dict)

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.row)

    @property
    def _own(self) -> list[str]:
        return [dictionary.plain(name) for name in self.names]

    @cached_property
    def _described(self) -> tuple[dictionary.Program | None, list[tuple[dictionary.Meaning | None, str, str]]]:
        return dictionary.described(self.names)

    @property
    def plain(self) -> list[str]:
        """The column names as plain text, in the words of the dictionary."""
        return [words for *_, words in self._described[1]]

    @property
    def program(self) -> dictionary.Program | None:
        """The program that is known to write such columns."""
        return self._described[0]

    @cached_property
    def meanings(self) -> list[dictionary.Meaning | None]:
        """The meaning of each column."""
        mine = {i: dictionary.Meaning(row, dictionary.without_unit(self.names[i])[1]) for i, row in self.mapped.items()}
        known = [what or mine.get(i) for i, (what, *_) in enumerate(self._described[1])]
        rats = {i for i, what in enumerate(known) if what and what.quantity.name == "technology"}
        # a column such as 'radio' may contain names of receivers
        unlike = {i for i in rats if not any(dictionary.has("any_rat", row[i]) for row in self.cells[:200])}
        known = [None if i in unlike else what for i, what in enumerate(known)]
        # 'serving cell' may be a cell and not a state, 'satellite' a satellite and not their number
        for i, form in ((i, _NAMES_IN.get(what.quantity.name)) for i, what in enumerate(known) if what):
            known[i] = _NETWORK if form and any(form.match(row[i]) for row in self.cells[:200]) else known[i]
        # names such as 'mode' and 'Giorno' do not prove that the cells are radio accesses and dates
        names = {what.quantity.name for what in known if what}
        for name, form_of in (("technology", "a_rat"), ("date", "a_date")):
            of_form = None if name in names else dictionary.meaning(name)
            known = [of_form if what is None and self._all_are(form_of, i) else what for i, what in enumerate(known)]
        return dictionary.with_places(zip(self.plain, known, strict=True))

    def _all_are(self, form: str, column: int) -> bool:
        """Check whether the first cells of a column have a form, except empty cells."""
        cells = {cells[column] for cells in self.cells[:200]} - {""}
        return bool(cells) and all(map(dictionary.PATTERNS[form].fullmatch, cells))

    def find(self, *quantities: str) -> int | None:
        """Return the column that fits one of the quantities best, or an empty column if there is no other.

        A height of 0 in all rows counts as empty. Of equally good columns, such as the positions of two receivers, a
        column that is already in use is preferred.
        """
        blank = " 0." if "altitude_m" in quantities else None
        known = [
            (
                not any(cells[i].strip(blank) for cells in self.cells),
                dictionary.rank_of(meaning.quantity, self.plain[i]),
                i not in self.used,
                i,
            )
            for i, meaning in enumerate(self.meanings)
            if meaning is not None and meaning.quantity.name in quantities
        ]
        return min(known)[-1] if known else None

    def found(self, *quantities: str) -> dict[str, FloatArray]:
        """Return the numbers of the quantities that have a column."""
        return {name: self.numbers(i) for name in quantities if (i := self.find(name)) is not None}

    def named(self, *names: str) -> int | None:
        """Return the first column whose simplified name (:func:`dictionary.plain`) is one of ``names``, or None."""
        return next((self._own.index(name) for name in names if name in self._own), None)

    def unit(self, column: int) -> str:
        """Return the unit in the name of a column, or the unit that its program uses, or an empty text."""
        what, unit, _ = self._described[1][column]
        if not unit and what is not None:
            unit = self._units.get("rss" if what.quantity.role == "rss" else self._own[column], "")
        written = what is not None and what.unit
        return unit if written or unit not in dictionary.OF_INTEGERS or self._in_integers else ""

    @cached_property
    def _units(self) -> dict[str, str]:
        """The units of levels (key ``rss``) and of other columns, from columns of units such as ``alt unit``."""
        found = {}
        for i, name in enumerate(self._own):
            of_what = re.fullmatch(r"(?:(.*) )?units?", name)
            texts = {cells[i].lower() for cells in self.cells} if of_what else set()
            if of_what and len(texts) == 1 and dictionary.is_unit(text := texts.pop()):
                self.used.add(i)
                found["rss" if dictionary.unit_of(text) in _OF_LEVELS else of_what[1] or ""] = text
        return found

    def unit_read(self, column: int) -> str:
        """Return the unit of :meth:`numbers`.

        The unit is empty if brackets contain other text, such as ``(LTE scell0)``.
        """
        self.numbers(column)
        return dictionary.unit_of(self._cell_units.get(column) or self.unit(column))

    @cached_property
    def _in_integers(self) -> bool:
        """Check whether positions are MAVLink's integers, 1e-7 degrees."""
        column = self.find("latitude_deg")
        if column is None:
            return False
        values = np.array([_number(cells[column])[0] for cells in self.cells[:200]])
        values = values[np.isfinite(values)]
        return bool(len(values) and (np.abs(values) > 1e5).mean() > 0.5 and (values == np.round(values)).all())

    def silence(self, where: BoolArray, columns: Iterable[int]) -> None:
        """Make the cells of some rows empty."""
        for column in columns:
            for cells in compress(self.cells, where.tolist()):
                cells[column] = ""
            self._numbers.pop(column, None)

    def add(self, name: str, texts: list[str]) -> None:
        """Add a column."""
        self.names.append(name)
        self.cells = [[*cells, text] for cells, text in zip(self.cells, texts, strict=True)]
        for cached in ("_described", "meanings"):
            self.__dict__.pop(cached, None)

    def part(self, where: BoolArray) -> Sheet:
        """Return a table of the rows of a mask, which shares the notes of this table."""
        return replace(
            self, row=self.row[where], _numbers={}, _cell_units={},
            cells=[*compress(self.cells, where.tolist())],
        )  # fmt: skip

    def texts(self, column: int) -> list[str]:
        """Return a column as text."""
        return [cells[column] for cells in self.cells]

    def numbers(self, column: int) -> FloatArray:
        """Return a column as read-only numbers in the unit of the dictionary, NaN for missing values.

        In levels and positions, numbers that mean a missing value are not replaced, because their records are flagged.
        """
        if column not in self._numbers:
            values = self._parsed(column, self.texts(column))
            meaning = self.meanings[column]
            if meaning is not None:
                values = self._angles(column, meaning.quantity, values)
                if meaning.quantity.role not in ("rss", "rank", "position", "time") or meaning.indirect:
                    values = np.where(dictionary.is_none(meaning.quantity, values), np.nan, values)
                odd = dictionary.impossible(meaning.quantity, values)
                if meaning.quantity.role == "kpi" and 2 * odd.sum() > np.isfinite(values).sum():
                    text = f"column {self.names[column]!r}: most values are impossible, such as {values[odd][0]:g}"
                    self.notes[column] = f"{text} (another unit, or the column of another quantity?)"
            values.flags.writeable = False  # all callers share the array
            self._numbers[column] = values
        return self._numbers[column]

    def _parsed(self, column: int, texts: list[str]) -> FloatArray:
        meaning = self.meanings[column]
        counts = Counter(texts)  # parse each distinct text once, because tables repeat texts
        left_out = ""
        if self._has_points and all(_THOUSANDS.fullmatch(text) for text in counts if "," in text):
            left_out = ","
        elif meaning is not None and meaning.quantity.role == "cell" and self.has_decimal_commas:
            left_out = "."  # an EARFCN of 2.300 is 2300
        reads = _angle if meaning is not None and meaning.quantity.role == "position" else _number
        in_words = meaning is not None and meaning.quantity.name == "fix"
        parsed = {text: reads(_fix(text) if in_words else text.replace(left_out, "")) for text in counts}
        values = np.array([parsed[text][0] for text in texts], dtype=np.float64)
        told = {text: count for text, count in counts.items() if text.lower() not in NO_VALUE}
        words = {text: count for text, count in told.items() if math.isnan(parsed[text][0])}
        role = "" if meaning is None else meaning.quantity.role
        if role not in ("", "time") and 2 * sum(words.values()) > (0 if role == "rss" else sum(told.values())):
            self.notes[column] = (
                f"column {self.names[column]!r}: {counted(sum(words.values()), 'cell')} without a number (the first: "
                f"{next(iter(words))[:30]!r}) are read as missing"
            )
        unit = meaning.unit if meaning is not None and "[" in self.names[column] else ""
        if unit and meaning is not None and meaning.quantity.unit and not dictionary.is_unit(unit):
            text = f"column {self.names[column]!r}: unknown unit, read as {meaning.quantity.unit}"
            self.notes.setdefault(column, text)
        if self.unit(column) in dictionary.ACROSS_50_OHM:
            text = "dBuV are converted to dBm for a receiver of 50 ohm (-107 dB), a guess"
            self.notes[column] = f"column {self.names[column]!r}: {text}"
        units = {unit for _, unit in parsed.values() if dictionary.is_unit(unit)}
        if not units:
            return dictionary.converted(values, self.unit(column))
        of_cell = np.array([parsed[text][1] for text in texts], dtype=object)
        self._cell_units[column] = next(iter(units))
        for unit in {*units, ""}:
            mine = of_cell == unit if unit else ~np.isin(of_cell, list(units))
            values[mine] = dictionary.converted(values[mine], unit or self.unit(column))
        return values

    def _angles(self, column: int, quantity: dictionary.Quantity, values: FloatArray) -> FloatArray:
        """Return signed positions in degrees. MAVLink's integers and NMEA's degrees and minutes are converted."""
        if quantity.role != "position":
            return values
        if not dictionary.is_unit(self.unit(column)) and (form := dictionary.angle_form(values, quantity)):
            self.notes[column] = f"column {self.names[column]!r}: no angle in degrees can be so large: read as {form}"
            values = dictionary.converted(values, form)
        if quantity.name == "longitude_deg" and 180 < np.nanmax(values, initial=0.0) <= 360 and np.nanmin(values) >= 0:
            self.notes[column] = f"column {self.names[column]!r}: longitudes of 0 .. 360 deg: read as -180 .. 180"
            values = np.where(values > 180, values - 360.0, values)
        positive, negative = "NS" if quantity.name == "latitude_deg" else "EW"
        own = dictionary.PATTERNS["hemisphere"].search(self.names[column])
        if own is not None and own[1] in (positive, negative):
            # some programs write both the letter and the sign
            return -np.abs(values) if own[1] == negative else values
        for i, name in enumerate(self.names):
            letters = {cells[i].upper() for cells in self.cells[:50]} - {""}
            if letters and letters <= {positive, negative} and (i == column + 1 or dictionary.has("of_sides", name)):
                self.used.add(i)
                west = np.array([text.upper() == negative for text in self.texts(i)])
                return np.where(west, -np.abs(values), values)
        return values

    @cached_property
    def _has_points(self) -> bool:
        """Check whether the first row has a decimal point, and commas only between thousands."""
        # test only the first row, because all rows have the same form
        first = self.cells[0] if self.cells else []
        commas = [cell for cell in first if _DECIMAL_COMMA.fullmatch(cell)]
        return any(_DECIMAL_POINT.fullmatch(cell) for cell in first) and all(map(_THOUSANDS.fullmatch, commas))

    @cached_property
    def has_decimal_commas(self) -> bool:
        """Check whether the first row has numbers with a decimal comma."""
        return bool(self.cells) and any(map(_DECIMAL_COMMA.fullmatch, self.cells[0]))

    def remarks(self) -> list[str]:
        """Return sentences about columns that are not read as they are written, or not read at all."""
        left = [i for i in range(len(self.names)) if i not in self.used and self._is_of_interest(i)]
        shown = ", ".join(repr(self.names[i]) for i in left[:_MOST_NAMED])
        more = f" and {len(left) - _MOST_NAMED} more" if left[_MOST_NAMED:] else ""
        # omit remarks about the conversion of a column that is not read
        idle = {i for i, _ in enumerate(self.names) if i not in self.used and self.unit(i) in dictionary.ACROSS_50_OHM}
        out = [text for i, text in sorted(self.notes.items()) if i not in idle]
        if left:
            out.append(f"not read, though they look like levels, identities, positions, times or flags: {shown}{more}")
        if words := [i for i in range(len(self.names)) if i not in {*self.used, *left} and self._may_name(i)]:
            shown = ", ".join(repr(self.names[i]) for i in words[:_MOST_NAMED])
            text = "If one names the cell or device of a row, call it 'cell' or 'device' (or --map NAME=cell)"
            out.append(f"not read: {shown}. {text}")
        gains = [i for i in left if dictionary.has("gain", self.plain[i]) and np.nanstd(self.numbers(i)) > 0]
        text = "changes, and levels are not corrected for it: do they already include it?"
        out += [f"column {self.names[i]!r} {text}" for i in gains[:1]]
        # use only comments near the table, because a long log may have many comments between its rows
        near = (i for i in self.blank_rows.tolist() if len(self) and (i < TITLES or 0 < i - self.row[-1] <= TITLES))
        beside = {i + 1: self.lines.text(i).strip('#%;" ') for i in near}
        out += [
            f"line {number} is not read: {text[:80]!r}"
            for number, text in beside.items()
            if dictionary.has("of_values", text) and not text.startswith(self.names[0] or "?")
        ]
        if (equal := len(self) - len({*map(tuple, self.cells)})) > _MOST_EQUAL * len(self):
            out.append(f"{counted(equal, 'row')} equal to another row in every cell: was one log joined twice?")
        return out

    def _is_of_interest(self, column: int) -> bool:
        """Check whether a column has values and looks like a level, an identity, a position or a time."""
        meaning, words = self.meanings[column], self.plain[column]
        like = bool(dictionary.like_levels([self.names[column]])) or dictionary.names_a_cell(words)
        if meaning is not None:
            like |= meaning.quantity.role in _OF_INTEREST
        elif not like:
            like = dictionary.has("where_or_when", words) or self.unit_read(column) in _OF_LEVELS[1:]
            # Android's index of a level (ASU) counts as a level if no other level is read
            levels = (what for i in self.used if (what := self.meanings[i]) and what.quantity.role == "rss")
            like |= "asu" in words.split() and not any(levels)
            like |= dictionary.has("neighbour", words)
            # angles in columns of other names, such as x and y
            like |= self.find("latitude_deg") is None and _is_angle(self.numbers(column))
        return like and any(text.lower() not in NO_VALUE for text in self.texts(column))

    def _may_name(self, column: int) -> bool:
        """Check whether a column with an unknown name has a few texts or numbers that may name cells or devices."""
        if self.meanings[column] is not None or dictionary.has("no_identity", self.plain[column]):
            return False
        texts = {text.lower() for text in self.texts(column)} - {*NO_VALUE, *dictionary.TEXTS["yes_or_no"]}
        if not 1 < len(texts) <= _MOST_SOURCES:
            return False
        if not all(text.isdecimal() for text in texts):
            return all(_LETTER.search(text) and math.isnan(_number(text)[0]) for text in texts)
        # unlike waypoints and heights, cell numbers are neither consecutive nor round; unlike counters, they have few
        # values
        numbers = np.unique([int(text) for text in texts])
        called = dictionary.has("called", self.plain[column])
        like = called or (np.diff(numbers).min(initial=2) > 1 and (numbers % 5).any() and self.find("PCI") is None)
        known = {what.quantity.role for i in self.used if (what := self.meanings[i])}
        levels = like and ("rss" in known or {*map(self.unit_read, self.used)} & {*_OF_LEVELS[1:]})
        return bool(levels and len(numbers) <= min(_MOST_NUMBERS, len(self) / 3))


_OF_INTEREST = ("time", "position", "height", "identity", "cell", "rss", "rank", "kpi")
# Largest share of rows that are equal to another row. Rows of the same second may be equal.
_MOST_EQUAL = 0.3
# Names contain a letter. A column with more different texts or numbers than this does not name cells or devices.
_LETTER, _MOST_SOURCES, _MOST_NUMBERS = re.compile(r"[^\W\d_]"), 50, 8
# Largest number of column names in one sentence.
_MOST_NAMED = 20
_DECIMAL_POINT = re.compile(r"[-+]?\d{1,20}\.\d{1,40}")
_DECIMAL_COMMA = re.compile(r"[-+]?\d{1,20},\d{1,40}")
_THOUSANDS = re.compile(r"[-+]?\d{1,3}(?:,\d{3})+(?:\.\d{0,40})?")
# Texts of cells without a value, and without a zone.
NO_VALUE = {*dictionary.TEXTS["no_value"]}
_NO_ZONE = {*NO_VALUE, *dictionary.TEXTS["no_zone"]}


def read(data: bytes, is_header: _IsHeader) -> Sheet:
    """Return the table of a file.

    Raises
    ------
    InputError
        If none of the first lines is a header.
    """
    if _json.BEGIN.match(data := _json.from_pairs(data)):
        lines = _text.split(data)
        parsed = _json.objects(lines)
        entries = zip(parsed.row.tolist(), parsed.values, strict=True)
        readings = [(i, reading) for i, entry in entries for reading in _json.readings(entry)]
        return of_readings(lines, readings, parsed.rejected)
    header = header_of([line.removesuffix(b"\r") for line in data.split(b"\n", TITLES)[:TITLES]], is_header)
    if header is None:
        raise InputError("no header with a time and a level, ratio, rank or position", expected="names of columns")
    sheet = cut(_text.split(data), *header)
    if any(map(_json.LISTED.fullmatch, sheet.names)):  # JSON that was saved as CSV
        rows = zip(sheet.row.tolist(), sheet.cells, strict=True)
        listed = [(i, one) for i, row in rows for one in _json.readings(dict(zip(sheet.names, row, strict=True)))]
        sheet = replace(of_readings(sheet.lines, listed, sheet.rejected), closed=False, notes=sheet.notes)
    _split_places(sheet)
    _join_times(sheet)
    return sheet


_DATE_PARTS = (("year", "yyyy", "yr"), ("month", "mon"), ("day", "doy", "day of year"))
_CLOCK_PARTS = (("hour", "hours", "hr", "hour utc"), ("minute", "minutes", "min"), ("second", "seconds", "sec"))


def has_date_in_parts(names: Iterable[str]) -> bool:
    """Check whether there are columns of the year, the day and the hour."""
    known = {*map(dictionary.plain, names)}
    return all(known & {*words} for words in (_DATE_PARTS[0], _DATE_PARTS[2], _CLOCK_PARTS[0]))


def _join_times(sheet: Sheet) -> None:
    """If year, month and day are separate columns, add a column of dates, with the time of day if possible."""
    year, month, day = date = [sheet.named(*words) for words in _DATE_PARTS]
    clock = [sheet.named(*words) for words in _CLOCK_PARTS]
    if year is None or day is None or sheet.find("date") is not None:
        return
    sheet.used |= (columns := {i for i in (*date, *clock) if i is not None})
    parts = [np.zeros(len(sheet)) if i is None else sheet.numbers(i) for i in (year, month, day, *clock)]
    form = "{0:.0f}-{1:.0f}-{2:.0f}" if month is not None else "{0:.0f}-{2:03.0f}"
    form += "" if clock[0] is None else " {3:.0f}:{4:02.0f}:{5:09.6f}"
    rows = ((row[0] + 2000 * (row[0] < 100), *row[1:]) for row in zip(*parts, strict=True))
    dates = ["" if math.isnan(sum(row)) else form.format(*row) for row in rows]
    # u-blox receivers write the time of week next to UTC
    utc = sheet.find("gps_seconds") is not None or any("utc" in sheet.plain[i].split() for i in columns)
    for i in columns:  # a column of seconds is not a clock
        sheet.names[i] += " of the date"
    sheet.add("date utc" if utc else "date", dates)


# Latitude and longitude in one cell, in brackets or not: ``35.7275 -78.6960``; WKT has the longitude first.
_ONE = r"(-?\d{1,3}\.\d{3,15}[\u00b0 ]{0,2}[NSEW]?)"
_PAIR = re.compile(rf"(?:POINT ?Z? ?)?[\[(]? ?{_ONE} ?[ ,;] ?{_ONE}(?:[ ,].{{0,20}})?[\])]?", re.IGNORECASE)


def _split_places(sheet: Sheet) -> None:
    """Add columns of latitude and longitude where one column has both, such as ``GPS`` of EdgeTX."""
    both = sheet.find("latitude_deg") is not None and sheet.find("longitude_deg") is not None
    for i, name in enumerate(() if both else sheet.names):
        texts = sheet.texts(i)
        pairs = [_PAIR.fullmatch(text) for text in texts]
        if not any(pairs[:50]) or 2 * sum(map(bool, pairs)) <= sum(map(bool, texts)):
            continue
        swapped = any(re.match(r"(?i)POINT", text) for text in texts[:50]) or sheet.plain[i].startswith(("lon", "lng"))
        swapped |= any(abs(_angle(pair[1])[0]) > 90 for pair in pairs if pair)
        columns = [[pair[part] if pair else "" for pair in pairs] for part in ((2, 1) if swapped else (1, 2))]
        sheet.names[i] = f"{name} in one text"
        for angle, cells in zip(("latitude", "longitude"), columns, strict=True):
            sheet.add(angle, cells)
        order = "longitude, latitude" if swapped else "latitude, longitude"
        sheet.notes[i] = f"column {name!r}: read as {order}"
        return


def of_readings(
    lines: _text.Lines, readings: Sequence[tuple[int, Mapping[str, str]]], rejected: list[RejectedLine]
) -> Sheet:
    """Return a table of readings from a file without columns. All other lines are comments unless they are rejected.

    Parameters
    ----------
    lines : Lines
    readings : sequence of (int, mapping)
        0-based line of each reading, and its cells, with the names of their columns as keys.
    rejected : list of RejectedLine
    """
    names = list(dict.fromkeys(name for _, cells in readings for name in cells))
    row = np.array([i for i, _ in readings], dtype=np.int64)
    known = [*row, *(line.number - 1 for line in rejected)]
    return Sheet(
        lines=lines, names=names, row=row,
        cells=[[cells.get(name, "").strip() for name in names] for _, cells in readings],
        blank_rows=np.setdiff1d(np.flatnonzero(~lines.blank), known), rejected=rejected, closed=True,
    )  # fmt: skip


def cut(lines: _text.Lines, at: int, separator: str, names: list[str]) -> Sheet:
    """Return the table below a header, with titles, repeated headers and text at the end as comments.

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
        The table, with the columns of all headers if there are several.
    """
    below = ~lines.blank
    below[: at + 1] = False
    numbers = np.flatnonzero(below).tolist()
    group = [text.strip() for text in split_row(lines.raw(at - 1), separator)] if at else []
    written = list(_logical([(i, lines.raw(i)) for i in numbers], separator, len(names)))
    first = "".join(row[0].strip() for _, row in written[:3] if len(row) == len(names) + 1 and row[-1].strip())
    if first in ("123", "012"):
        names = ["", *names]
    # a row that spans several lines counts once, and its other lines count as comments
    comments = [*range(at + 1), *sorted({*numbers} - {i for i, _ in written})]
    header, rows, begun = _Header(_unique_names(names, group)), list[_Row](), False
    for i, fields in _without_empty_end(written, names):
        words = [text.strip() for text in fields]
        valued = any(map(_VALUE.match, words))
        units = not begun and header.adds_units(words)
        if units or (not valued and header.is_header(words)):
            comments.append(i)  # units below the names, or the header of an appended file
            continue
        rows.append(_Row(i, len(fields), len(header.place), header.placed(words)))
        # a line of descriptions may precede the line of units
        begun |= valued and len(fields) == len(header.place)
    kept = _whole_rows(rows, header.names, numbers[-1] if numbers else at)
    if separator.startswith(" "):  # an empty cell shifts the cells after it
        kept = [row for row in kept if row.fields == row.width]
    text = "no row has as many fields as the header: the last columns were read as empty"
    last = kept[-1].line if kept else comments[-1]
    torn = len(lines) - 1 if lines.unterminated else -1
    # text below the table, as in exports of Nemo, has no separator and does not begin with a number
    alone = [row.line for row in rows if row.line > last and row.fields == 1 and row.line != torn]
    foot = {i for i in alone if not _VALUE.match(lines.raw(i).decode("utf-8", "replace"))}
    settled = {row.line for row in kept} | foot
    return Sheet(
        lines=lines, names=header.names, row=np.array([row.line for row in kept], dtype=np.int64),
        notes={len(header.names): text} if kept and not begun else {},
        cells=[[*row.cells, *[""] * (len(header.names) - len(row.cells))] for row in kept],
        blank_rows=np.array([*comments, *foot], dtype=np.int64),
        rejected=[
            lines.reject(row.line, f"{counted(row.fields, 'field')} where the header has {row.width} (truncated line?)")
            for row in rows if row.line not in settled
        ],
    )  # fmt: skip


class _Row(NamedTuple):
    """A row of a table: its 0-based line, its number of fields, the number of fields of its header, and its cells."""

    line: int
    fields: int
    width: int
    cells: list[str]


# Largest number of lines of a cell with line breaks.
_MOST_LINES = 40


def _logical(lines: Sequence[tuple[int, bytes]], separator: str, width: int) -> Iterator[tuple[int, list[str]]]:
    """Yield rows, each with the number of its first line, because a quoted cell may have line breaks.

    A lone quote, such as an inch mark, does not join lines: lines are joined only if they form a row as wide as the
    header.
    """
    last = -1
    for place, (i, line) in enumerate(lines):
        if place <= last:
            continue
        fields = split_row(line, separator)
        if line.count(b'"') % 2 and len(fields) != width:
            ends = (k for k in range(place + 1, min(place + _MOST_LINES, len(lines))) if lines[k][1].count(b'"') % 2)
            if (end := next(ends, None)) is not None:
                joined = split_row(b" ".join(text for _, text in lines[place : end + 1]), separator)
                fields, last = (joined, end) if len(joined) == width else (fields, last)
        yield i, fields


def _unique_names(names: Sequence[str], group: Sequence[str] = ()) -> list[str]:
    """Make the names of a header unique by adding the text of merged cells above them, or a number."""
    counts, before = Counter(names), Counter[str]()
    unlike, above = [], ""
    for i, name in enumerate(names):
        before[name] += 1
        above = (group[i] or above) if len(group) == len(names) else ""
        alone = not name or counts[name] == 1 or not (above or before[name] > 1)
        unlike.append(name if alone else f"{above} {name}" if above else f"{name} {before[name]}")
    return unlike


class _Header:
    """The columns of a table under one header or several."""

    def __init__(self, names: list[str]) -> None:
        self.names = names
        self.place = list(range(len(names)))  # column of each field under the present header
        self._unit = [""] * len(names)  # units that differ from the first header
        self._bare, self._repeated = [dictionary.without_unit(name)[0] for name in names], False

    def adds_units(self, texts: list[str]) -> bool:
        """Check whether the line below the names contains units, perhaps with a datum, and add them to the names."""
        texts = [" ".join(re.sub(r"[\[\]()]", " ", text).split()) for text in texts]
        filled = [text for text in texts if text]
        units = sum(
            any(map(dictionary.is_unit, (text, text.partition(" ")[0]))) or _BESIDE_UNITS.fullmatch(text) is not None
            for text in filled
        )
        few = len(filled) < 2 - any(map(dictionary.is_unit, filled))
        if few or len(texts) != len(self.names) or 2 * units <= len(filled):
            return False
        self.names[:] = [f"{name} [{unit}]" if unit else name for name, unit in zip(self.names, texts, strict=True)]
        return True

    def is_header(self, texts: list[str]) -> bool:
        """Check whether a line is a header, perhaps with other columns. If so, use it for the lines below."""
        texts = _unique_names(texts)
        bare = [dictionary.without_unit(text) for text in texts]
        both = zip(bare, texts, strict=True)
        known = [name in self._bare or dictionary.meaning(text) is not None for (name, _), text in both]
        if len(texts) < 2 or 2 * sum(known) <= sum(bool(text) for text in texts):
            return False
        spare: dict[str, list[int]] = {}
        for j, name in enumerate(self._bare):
            spare.setdefault(name, []).append(j)
        self.place, self._unit, self._repeated = [], [], True
        for (name, unit), text in zip(bare, texts, strict=True):
            if not spare.get(name):
                spare[name] = [len(self.names)]
                self.names.append(text)
                self._bare.append(name)
            column = spare[name].pop(0)
            self.place.append(column)
            changed = dictionary.is_unit(unit) and unit != dictionary.without_unit(self.names[column])[1]
            self._unit.append(unit if changed else "")
        return True

    def placed(self, fields: list[str]) -> list[str]:
        """Return the cells of a row in the order of the columns, with empty cells in place of missing fields."""
        if len(fields) < len(self.place):
            fields = [*fields, *[""] * (len(self.place) - len(fields))]
        if len(self.names) == len(self.place) and not self._repeated:
            return fields
        cells = [""] * len(self.names)
        for j, text, unit in zip(self.place, fields, self._unit, strict=False):
            cells[j] = f"{text} {unit}" if unit and text else text
        return cells


def _whole_rows(rows: list[_Row], names: list[str], last_line: int) -> list[_Row]:
    """Return the rows that are as wide as their header, and shorter rows if the program often writes them."""
    full = [row for row in rows if row.fields == row.width]
    short = [row for row in rows if 1 < row.fields < row.width]
    # a single short row is truncated, and the last line may be cut short in every file
    if sum(row.line != last_line for row in short) < max(2, len(full) // 20):
        return full
    meanings = [dictionary.meaning(name) for name in names]
    return sorted([*full, *(row for row in short if not _is_truncated(row.cells, meanings))])


def _is_truncated(cells: list[str], meanings: list[dictionary.Meaning | None]) -> bool:
    """Check whether a short row is truncated: it has half a position, or a value that is impossible in its column."""
    place = {"latitude_deg": False, "longitude_deg": False}
    for text, meaning in zip(cells, meanings, strict=False):
        if meaning is None:
            continue
        value = _number(text)[0]
        if meaning.quantity.name in place and meaning.unit == "":
            place[meaning.quantity.name] |= np.isfinite(value)
        if dictionary.impossible(meaning.quantity, np.array([value]))[0]:
            return True
    return len(set(place.values())) > 1


def _without_empty_end(rows: list[tuple[int, list[str]]], names: list[str]) -> list[tuple[int, list[str]]]:
    """Return rows without the empty field that a separator at the end of the rows or of the header adds.

    Most rows must have this field: an unquoted decimal comma also adds a field, and shifts the columns.
    """
    longer = [not fields[-1].strip() for _, fields in rows if len(fields) == len(names) + 1]
    filled = longer.count(False)  # one or two truncated rows may also have a further field
    if 2 * longer.count(True) > len(rows) and filled <= max(1, len(rows) // 100):
        more = len(names) + 1
        rows = [(i, row[:-1] if len(row) == more and not row[-1].strip() else row) for i, row in rows]
    if not names[-1]:
        rows = [(i, [*fields, ""] if len(fields) == len(names) - 1 else fields) for i, fields in rows]
    return rows


def rows(sheet: Sheet, options: ReadOptions, *, reader: str, column: int | None = None) -> Rows:
    """Return the rows of a table with their times.

    Parameters
    ----------
    column : int, optional
        Column of the times; by default the column that the dictionary finds.

    Raises
    ------
    InputError
        If the table has no times, or its columns are shifted.
    """
    known = {i: m.quantity for i, m in enumerate(sheet.meanings) if m is not None and not m.indirect}
    mapped = column is not None
    if not mapped:  # do not check the values of columns that the user named
        _refuse_positions_elsewhere(sheet)
        bounded = {i: q for i, q in known.items() if q.role in ("position", "cell", "rss") and q.can_be[1] < np.inf}
        _refuse_shifted([(sheet.names[i], q, sheet.numbers(i)) for i, q in bounded.items()])
    column = _time_column(sheet, options) if column is None else column
    if column is not None and options.time_origin is None and not sheet.closed:
        _add_date_above(sheet, column)
    weeks = None if mapped and column != sheet.find("gps_seconds") else _gps_weeks(sheet, column)
    if column is None and weeks is None and (date := sheet.find("date")) is not None:
        # a column such as 'Date' with the date and the time of day, or with fractions of days
        column = date if _is_dated(sheet, date) or (sheet.numbers(date) % 1 > 0).any() else None
    times = (column, sheet.find("time") if weeks is not None else None, *map(sheet.find, _OF_CLOCK))
    sheet.used |= {i for i in times if i is not None}
    if weeks is not None:
        clock, cells, warnings = "epoch_s", weeks, ["the times are GPS weeks and seconds: leap seconds were subtracted"]
    elif column is not None:
        clock, cells, warnings = _times(sheet, column, options, mapped=mapped)
    else:
        raise InputError("no reading has a time", expected="times and values", cause="a truncated file")
    start = next((found for text in (sheet.cells or [[]])[0] if (found := _START.search(text))), None)
    if clock.startswith("relative") and start is not None:
        options = replace(options, time_origin=options.time_origin or start[1])
    timed = built(
        sheet.lines, sheet.row, {"time": cells}, options, reader=reader, clock=clock,
        others=OtherLines(rejected=sheet.rejected, comments=sheet.blank_rows, closed=sheet.closed),
    )  # fmt: skip
    timed.warnings += warnings
    if clock.startswith("relative") and start is not None:
        timed.clock_from = "written"
    _to_utc(timed, sheet, column)
    if len(timed) < len(sheet):  # rows without a time are rejected
        sheet.row, sheet.cells = sheet.row[timed.at], [sheet.cells[i] for i in timed.at.tolist()]
        sheet._numbers.clear()
    for per_ms, names in ((1.0, ("time millisecond", "millisecond", "milliseconds", "msec", "ms")), (1e6, _NSECS)):
        if (counter := sheet.named(*names)) not in (None, column) and np.isfinite(sheet.numbers(counter)).any():
            sheet.used.add(counter)
            _add_milliseconds(timed, sheet.numbers(counter) / per_ms)
    if (valid := sheet.named("valid", "is valid", "data valid")) is not None:
        words = ("0", "0.0", "false", "no", "n", "invalid")
        invalid = np.array([text.lower() in words for text in sheet.texts(valid)], dtype=bool)
        timed.mark(invalid, "marked_invalid")
        if invalid.any():
            lines = counted(int(invalid.sum()), "row")
            timed.warnings.append(f"column {sheet.names[valid]!r}: {lines} flagged marked_invalid; not scored")
    return timed


def _add_date_above(sheet: Sheet, time: int) -> None:
    """Add a column with the date in the lines above the header, if the table has only times of day."""
    if sheet.find("date") is not None or not _OF_DAY.match(next(filter(None, sheet.texts(time)), "")):
        return
    above = [sheet.lines.raw(i).decode("utf-8", "replace") for i in range(min(int(sheet.row[0]), TITLES))]
    dates = {date: (i + 1, text) for i, text in enumerate(above) if (date := _stamps.date_in(text))}
    for date, (line, text) in dates.items() if len(dates) == 1 else ():
        sheet.add("date utc" if re.search(r"\b(UTC|GMT)\b", text) else "date", [date] * len(sheet))
        sheet.notes[len(sheet.names)] = f"the times have no date: that in line {line} is used, {text.strip()[:60]!r}"


# A time of day without a date.
_OF_DAY = re.compile(r"T?\d{1,2}:\d\d[:\d.,]*([AP]M|Z)?$")
_NSECS = ("nsecs", "nsec", "nanosec", "nanosecs", "nanoseconds", "nano", "header stamp nsecs", "header stamp nanosec")
_OF_CLOCK = ("date", "zone", "gps_week", "gps_seconds")
# Start of a log in a cell of JSON, written by Open DroneLog together with relative times.
_START = re.compile(r'"start_time" ?: ?"([^"]{10,40})"')


def _to_utc(timed: Rows, sheet: Sheet, column: int | None) -> None:
    """Convert times in place to UTC if the name of their column has a scale without leap seconds."""
    words = {*(() if column is None else sheet.plain[column].split())}
    scale = next((scale for scale in _stamps.SCALES_S if scale in words), None)
    zoned = column is not None and any(dictionary.has("zoned", text) for text in sheet.texts(column)[:3])
    if scale is None or zoned or timed.relative or any("leap seconds" in text for text in timed.warnings):
        return
    timed.time = timed.time - np.timedelta64(_stamps.SCALES_S[scale], "s")
    timed.warnings.append(f"the times are {scale.upper()}: {_stamps.SCALES_S[scale]} s were subtracted to get UTC")


def _time_column(sheet: Sheet, options: ReadOptions | None = None) -> int | None:
    """Return the best column of times: UTC if possible, and not the time of the last fix, which may stop."""
    column = sheet.find("time")
    # a column with an unknown name is a clock if its cells contain dates and times of day
    dated = {i for i, text in enumerate(sheet.cells[0]) if dictionary.has("dated", text)} if sheet.cells else {}
    times = [i for i, m in enumerate(sheet.meanings) if (m.quantity.name == "time" if m else i in dated)]
    if column is None or len(times) < 2:
        return column
    if "utc" not in sheet.plain[column].split():
        utc = [i for i in times if "utc" in sheet.plain[i].split()]
        zoneless = all(map(dictionary.PATTERNS["zoneless"].fullmatch, sheet.texts(column)[:3]))
        both = [i for i in utc if zoneless and all(dictionary.has("zoneless", text) for text in sheet.texts(i)[:3])]
        column = next(iter(utc if "local" in sheet.plain[column] else both), column)
    time_of = dictionary.QUANTITIES[0]
    ranked = sorted(times, key=lambda i: dictionary.rank_of(time_of, sheet.plain[i]))
    if not _is_dated(sheet, column):
        column = next((i for i in ranked if _is_dated(sheet, i)), column)
    texts = pd.Series(sheet.texts(column), dtype=object)
    if options is None:
        return column
    rest = [i for i in ranked if i != column]
    if not (texts == texts.shift()).any():
        some = sheet.part(np.arange(len(sheet)) % (1 + len(sheet) // 500) == 0)  # sufficient for a median
        own = _instants(some, column, options)
        for i in rest if len(own) else ():
            apart = _instants(some, i, options) - own
            if abs(apart_s := float(np.median(apart) / np.timedelta64(1, "s"))) > _APART_S:
                text = f"{abs(apart_s):.0f} s {'behind' if apart_s < 0 else 'ahead of'} {sheet.names[column]!r}"
                sheet.notes[i] = f"column {sheet.names[i]!r} is {text}, which is used: which clock is right?"
        return column
    moving = next((i for i in rest if _moves_on(sheet, i, texts, options)), column)
    if moving != column:
        text = f"column {sheet.names[column]!r} stops while {sheet.names[moving]!r} advances: the latter is used"
        sheet.notes[moving] = f"{text} (the former may be the time of the last fix)"
    return moving


def _is_dated(sheet: Sheet, column: int) -> bool:
    """Check whether the times of a column include a date or can use a column of dates."""
    first = next(filter(None, sheet.texts(column)), "")
    return _stamps.is_dated(first) or (":" in first and sheet.find("date") is not None)


# A clock has stopped if its time stays the same while another clock advances by more than this [s].
_STANDS_S = 0.5


def _moves_on(sheet: Sheet, column: int, standing: pd.Series[str], options: ReadOptions) -> bool:
    """Check whether a column of times advances while the time in another column does not change."""
    run = (standing != standing.shift()).cumsum().to_numpy()
    time = pd.Series(_instants(sheet, column, options, dated=standing.nunique() > 1))
    spans = time.groupby(run).agg(["min", "max"])
    return bool(((spans["max"] - spans["min"]).dt.total_seconds() > _STANDS_S).any())


# Two clocks of one table are reported if they differ by more than this [s].
_APART_S = 2.0


def _instants(sheet: Sheet, column: int, options: ReadOptions, *, dated: bool = True) -> AnyArray:
    """Return a column of times in UTC. All are NaT if the column cannot be read, or has no required date."""
    none = np.full(len(sheet), np.datetime64("NaT", "ns"))
    try:
        clock, cells, _ = _times(sheet, column, options, mapped=False)
        _, instants, valid = instants_of(cells, options, clock=clock, reader="the table")
    except (InputError, UsageError):
        return none
    undated = clock.startswith("relative") and dated and not options.time_origin
    return none if undated or not valid.all() else instants.time


def _times(sheet: Sheet, column: int, options: ReadOptions, *, mapped: bool) -> tuple[str, FloatArray, list[str]]:
    texts = sheet.texts(column)
    # a mapped column may also be a time of day that needs the column of dates
    day = sheet.find("date") if not mapped or column == _time_column(sheet) else None
    if day is not None and day != column and not _stamps.is_dated(next(filter(None, texts), "")):
        if dictionary.meaning(sheet.names[day]) is None:
            sheet.notes[day] = f"column {sheet.names[day]!r} is read as the dates of the times, a guess from its cells"
        # a spreadsheet may show a date only where it changes
        dates: Iterator[str] = accumulate(sheet.texts(day), lambda before, date: date or before)
        texts = [f"{date} {time}".strip() for date, time in zip(dates, sheet.texts(column), strict=True)]
    half = [i for i, cell in enumerate(sheet.cells[0] if sheet.cells else ()) if dictionary.has("am_or_pm", cell)]
    if half:
        sheet.used.add(half[0])
        texts = [" ".join(pair) for pair in zip(texts, sheet.texts(half[0]), strict=True)]
    name, unit = dictionary.plain(re.sub(r"(?<=[a-z])(?=[A-Z])", " ", sheet.names[column])), sheet.unit(column)
    count = next((short for short, c in _text.COUNTS.items() if c.word.search(unit) or c.word.search(name)), None)
    if dictionary.has("elapsed", name):
        texts, count = [_stamps.in_seconds(text) for text in texts], count or "s"
    count = count or ("s" if unit else None)
    written = dictionary.without_unit(sheet.names[column])[1] or any(c.word.search(name) for c in _text.COUNTS.values())
    are_seconds = count is not None and _stamps.are_seconds(sheet.numbers(column), count)
    if are_seconds and (not written or _EPOCH_S[0] < np.nanmedian(sheet.numbers(column)) < _EPOCH_S[1]):
        who = (
            "its name contains"
            if written
            else f"{sheet.program.name if sheet.program else 'the program'} usually writes"
        )
        text = f"read as seconds, although {who} {count}"
        sheet.notes[column], count = f"column {sheet.names[column]!r}: {text}", None
    if "local" in name and np.nanmax(sheet.numbers(column), initial=0) > _EPOCH_S[0]:
        text = "epochs are read as UTC: if they are local, write 'clock: local_as_utc' next to the log in flight.yaml"
        sheet.notes[column] = f"column {sheet.names[column]!r}: {text}"
    zone = _stamps.header_zone(sheet.names[column], dictionary.in_brackets(sheet.names[column])[1])
    if day is not None and not zone and "local" not in name:
        zone = _stamps.header_zone(sheet.names[day], dictionary.in_brackets(sheet.names[day])[1])
    if day is not None and "local" in sheet.names[day].lower() and zone == "UTC":
        text = "dates are local but times are UTC: between their midnights, the date is wrong by a day"
        if _stamps.passes_midnight(sheet.texts(column)):
            raise InputError(text, expected="dates and times of one zone", cause="two clocks in one table")
        sheet.notes[day] = f"columns {sheet.names[day]!r} and {sheet.names[column]!r}: {text}"
    if (beside := sheet.find("zone")) is not None:
        zone, texts = _zone_column(sheet, beside, zone, texts, options)
    gps = re.search(r"\bgps", name) is not None
    heads = " ".join(sheet.names[i].lower() for i in (day, column) if i is not None)
    first = dictionary.PATTERNS["day_or_month"].search(heads)
    european = sheet.has_decimal_commas or dictionary.has("european", heads) or f"{options.timezone}"[:7] == "Europe/"
    read = partial(
        _stamps.read, unit=count, european=bool(european), zone=zone, gps=gps,
        day_first=None if first is None else first[1].startswith("d"), device=_devices(sheet),
    )  # fmt: skip
    days = [] if day is None else [*filter(None, sheet.texts(day))]
    if day is not None and len({*days}) == 1 and _stamps.passes_midnight(clocks := sheet.texts(column)):
        text = "the dates are all equal, but the clock passes midnight: a day was added to the times after it"
        sheet.notes[day] = f"column {sheet.names[day]!r}: {text}"
        dated = replace(options, time_origin=read(days[:1], options)[1][0].decode()[:10])
        clock, cells, warnings = read(clocks, dated)
        return clock, cells, [text for text in warnings if "time_origin" not in text]
    return read(texts, options)


# Epochs of 2009 and 2049 [s].
_EPOCH_S = (1.23e9, 2.5e9)


def _devices(sheet: Sheet) -> IntArray | None:
    """Number the devices, and return the number for each row, or None if there is no column of devices."""
    columns = [i for i, meaning in enumerate(sheet.meanings) if meaning and meaning.quantity.name == "device"]
    texts = zip(*(sheet.texts(i) for i in columns), strict=True) if columns else ()
    return pd.factorize(pd.Series(list(texts), dtype=object))[0] if columns else None


def _zone_column(sheet: Sheet, column: int, zone: str, texts: list[str], options: ReadOptions) -> tuple[str, list[str]]:
    """Return the zone in a column of zones, or an empty zone and the times with appended zones if there are several."""
    cells, name = sheet.texts(column), f"column {sheet.names[column]!r}"
    known = {text: "" if text.lower() in _NO_ZONE else _stamps.zone_of_cell(text) for text in cells}
    word = next(filter(None, known.values()), "")
    if unknown := next((text for text, own in known.items() if not own and text.lower() not in _NO_ZONE), ""):
        sheet.notes[column] = f"{name}: {unknown[:30]!r} is not a known zone: not used"
    elif zone and word and word != zone:
        sheet.notes[column] = f"{name} contains {word}, but the time column names {zone}: {zone} is used"
    elif word and options.timezone not in (None, word) and not all(map(_DATED.fullmatch, texts[:3])):
        sheet.notes[column] = f"{name} has the zone of the times, {word}: --timezone is not used"
    if word and "offset" in sheet.plain[column] and re.fullmatch(r"\d{2,3}", cells[0]):
        sheet.notes[column] = f"{name}: {cells[0]} is read as east of UTC, but JavaScript counts to the west"
    if zone or len({*known.values()}) == 1:
        return zone or word, texts
    both = zip(texts, (known[text] for text in cells), strict=True)
    # an epoch is UTC in any zone
    return "", [text if _NUMBER.fullmatch(text) else f"{text} {own}".strip() for text, own in both]


# Epochs, and times with an offset.
_DATED = re.compile(r"\d{9,}[.,]?\d*|.*\d(?:Z|[+-]\d\d:?\d\d)")


_OF_LEVELS = ("", "dBm", "dB", "dB re full scale")
_MAPPED = ("latitude_deg", "longitude_deg", "altitude_m", "roll_deg", "pitch_deg", "yaw_deg")


def unread_levels(sheet: Sheet) -> list[int]:
    """Return the columns with unknown names that may be levels, those in dBm first."""
    like = dictionary.like_levels(sheet.names)
    unknown = [i for i, meaning in enumerate(sheet.meanings) if meaning is None and np.isfinite(sheet.numbers(i)).any()]
    named = [
        i for i in unknown
        if sheet.unit_read(i) in _OF_LEVELS and (sheet.names[i] in like or _has_levels(sheet, i))
        # levels in dBm are negative; other numbers are percentages or steps
        and (sheet.unit_read(i) == "dB" or np.nanmedian(sheet.numbers(i)) < 0)
    ]  # fmt: skip
    return sorted(named, key=lambda i: (dictionary.is_statistic(sheet.names[i]), sheet.unit(i) != "dbm"))


def way_to_level(sheet: Sheet) -> list[str]:
    """Return a sentence with the options that read an unknown column or the RSRQ as a level."""
    ratio = sheet.find("RSRQ")
    filled = unread_levels(sheet) or [i for i in [ratio] if i is not None and np.isfinite(sheet.numbers(i)).any()]
    time = _time_column(sheet) if sheet.find("time") is not None else sheet.find("gps_seconds", "date")
    if not filled or time is None:
        return []
    pairs = [(time, "time"), *((sheet.find(quantity), quantity) for quantity in _MAPPED), (filled[0], "rss_db")]
    sheet.used.update(filled)
    options = " ".join(f"--map {sheet.names[i]!r}={quantity}" for i, quantity in pairs if i is not None)
    absolute = (sheet.unit_read(filled[0]) or "dBm") == "dBm" and "dbfs" not in sheet.names[filled[0]].lower()
    unit = "dB" if sheet.meanings[filled[0]] else "dBm" if absolute else "dBFS"
    others = f" (so may {', '.join(repr(sheet.names[i]) for i in filled[1:5])})" if filled[1:] else ""
    return [f"{sheet.names[filled[0]]!r} may be a level, but is not read as one{others}: {options} --unit {unit}"]


def _has_levels(sheet: Sheet, column: int) -> bool:
    """Check whether the numbers of a column look like levels in dBm. The column may be named after a tower."""
    known = sheet.numbers(column)[np.isfinite(sheet.numbers(column))]
    like = len(known) > 1 and (known < -30).mean() > 0.9 and known.min() > -150
    return bool(like and not dictionary.has("unlike_a_level", sheet.plain[column]))


def _gps_weeks(sheet: Sheet, time: int | None) -> FloatArray | None:
    """Return UTC from columns of GPS weeks and (milli)seconds of the week, or None if a column is missing."""
    week, second = sheet.find("gps_week"), sheet.find("gps_seconds")
    if second is None and time is not None and "gps" in sheet.plain[time]:
        second = time
    if week is None or second is None or (time not in (None, second) and _is_dated(sheet, time)):
        return None
    weeks, seconds = sheet.numbers(week), sheet.numbers(second)
    if not np.isfinite(weeks).any():
        return None
    if np.nanmedian(weeks) < 1024:
        raise InputError(
            f"the GPS weeks are about {np.nanmedian(weeks):.0f}",
            expected="weeks since 1980, such as 2370",
            cause="the receiver counts them modulo 1024: add 1024 or 2048 to the column",
        )
    # a week has 604 800 s, so larger numbers are milliseconds
    scale = 1e-3 if np.nanmax(seconds) > 604_800 else 1.0
    return np.asarray(weeks * 604_800.0 + seconds * scale + _stamps.GPS_S - _stamps.LEAP_S)


def _refuse_shifted(columns: Sequence[tuple[str, dictionary.Quantity, FloatArray]]) -> None:
    """Refuse a table whose rows are shifted against its header, as shown by the ranges of the dictionary.

    Raises
    ------
    InputError
        If some rows have several values that their columns cannot have, or the identities of cells are fractions.
    """
    wrong = [(name, values, dictionary.impossible(quantity, values)) for name, quantity, values in columns]
    if not wrong or not len(wrong[0][1]):
        return
    count = np.sum([mask for *_, mask in wrong], axis=0)
    # a few impossible rows are damaged rows; if there are more, the columns are shifted
    few = max(3, len(count) // 20)
    alone = [
        mask
        for name, values, mask in wrong
        if "pci" in name.lower() and ((mask & (values < 0)).sum() >= few or 2 * mask.sum() > np.isfinite(values).sum())
    ]
    if not alone and (count > 1).sum() < few:
        return
    row = int(np.argmax(alone[0] if alone else count > 1))
    shown = "; ".join(f"{name!r} is {values[row]:g}" for name, values, mask in wrong if mask[row])
    raise shifted(shown, "values that their columns can have")


def _refuse_positions_elsewhere(sheet: Sheet) -> None:
    """Refuse a table whose positions are not in the columns that are named as positions."""
    names = {i: what.quantity.name for i, what in enumerate(sheet.meanings) if what is not None and not what.indirect}
    place = [i for i, name in names.items() if name in ("latitude_deg", "longitude_deg")]
    astray = [i for i in place if np.isfinite(sheet.numbers(i)).sum() > 2 and not _is_place(sheet.numbers(i))]
    if not astray or len(place) < 2:
        return
    texts = {i: sheet.texts(i) for i in range(len(sheet.names)) if i not in place}
    others = [i for i, cells in texts.items() if _is_angle(np.array([_number(cell)[0] for cell in cells]))]
    if len(others) >= len(astray):
        beside, empty = sheet.names[others[0]], sheet.names[astray[0]]
        raise shifted(f"{beside!r} has values like positions, {empty!r} does not", "values under their names")


def _is_place(values: FloatArray) -> bool:
    """Check whether numbers can be an angle of positions of one flight: close together, and not all whole degrees.

    On a leg due north the longitude is constant, perhaps with few decimals.
    """
    known = values[np.isfinite(values)]
    near = len(known) and np.ptp(known) < NEAR_DEG and 1 < np.abs(known).max() <= 180
    return bool(near and (known != np.round(known)).any())


def _is_angle(values: FloatArray) -> bool:
    """Check whether numbers look like positions of one flight: close together, with four or more decimals."""
    known = values[np.isfinite(values)]
    # require more than three decimals, because 0.001 deg is 100 m, which is too coarse for any receiver
    return _is_place(values) and bool((np.abs(known * 1e3 % 1 - 0.5) < 0.499999).mean() > 0.5)


def shifted(found: str, expected: str) -> InputError:
    """Return the error for a table whose values are in the wrong columns."""
    return InputError(f"the rows do not fit the header: {found}", expected=expected, cause=MISALIGNED)


MISALIGNED = "a column is missing in the header or in the rows, so that values are under the wrong names"


# Largest difference between whole seconds and a counter of the same clock: 1 s, plus 0.5 s for rounding.
_MOST_APART_NS = 1_500_000_000
# Half of the range of a time stamp.
_MOST_NS = 2.0**62


def _add_milliseconds(rows: Rows, milliseconds: FloatArray) -> None:
    """Add the fractions in a column of milliseconds to times in whole seconds (AirData)."""
    time = rows.time.astype(np.int64)
    known = np.isfinite(milliseconds)
    if rows.relative or not known.any() or (time % 1_000_000_000).any():
        return
    # round before the conversion to integers, because 0.1 ms is not exact in binary
    counted_ns = np.round(np.where(known, milliseconds, 0.0) * 1e6)
    fits = np.abs(counted_ns).max() < _MOST_NS
    counted = counted_ns.astype(np.int64) if fits else np.zeros_like(time)
    zero = (time - counted)[known]
    counts_on = ((np.diff(time) > 0) & (np.diff(counted) > 0)).any()  # fractions would begin again with each second
    spread = zero.max() - zero.min()
    if fits and 0 <= counted.min() <= counted.max() < 1_000_000_000 and not (counts_on and spread <= _MOST_APART_NS):
        rows.time = (time + counted).astype("datetime64[ns]")
    elif fits and spread <= _MOST_APART_NS:
        rows.time = np.where(known, zero.max() + counted, time).astype("datetime64[ns]")
    else:
        rows.warnings.append("the column of milliseconds does not fit the times and is not used")
