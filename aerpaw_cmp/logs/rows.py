"""Conversion of lines to records, for all text formats.

:func:`matched` returns the :class:`Rows` that a pattern with named groups matches; one of the groups is ``time``.
:func:`built` returns :class:`Rows` for readers that find their rows in another way. ``Rows.number`` and ``Rows.text``
return columns, ``Rows.stream`` returns a stream of columns, and ``Rows.result`` completes the account.

:func:`text_reader` makes a reader from a :class:`LineFormat`, which contains the regular expression of the rows, and
the streams of the columns. The reader recognises files of the format, converts times, accounts for all lines, and flags
truncated last lines.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from ..common.text import counted
from ..common.units import AnyArray, BoolArray, FloatArray, IntArray
from . import text as _text
from .readers import ASSUMED_CLOCK, ASSUMED_HEIGHT, Reader, ReadOptions
from .records import Attribute, Kind, ReadResult, RejectedLine, Stream

_NO_DATE = "the time stamp is not a date of the calendar"
_UNREAD = "the time is empty or has an unsupported form"
NO_TIME = "the time is outside the years of any flight"
_SI = {b"k": 1e3, b"M": 1e6, b"G": 1e9, b"m": 1e-3, b"u": 1e-6, b"n": 1e-9}
Reason = Callable[[bytes], "str | None"]


@dataclass
class Rows:
    """The rows of a log that have a time, and the account of all other lines.

    Parameters
    ----------
    reader : str
        Name of the reader.
    options : ReadOptions
    lines : int
        Lines of the file.
    row : int array, shape (n,)
        0-based line of each row.
    time : datetime64[ns] array, shape (n,)
    flag : object array, shape (n,)
    columns : mapping of str to bytes array, shape (n,)
        Text that the groups of the pattern matched.
    blank : int
    rejected : list of RejectedLine
    warnings : list of str
    relative : bool
        True if the times count from an unknown origin.
    clock_from : str, optional
        ``written`` if all times have an offset or are Unix times.
    height_from : str, optional
        Source of the heights of the track, if it follows from the table and not from the format alone.
    about : dict
        Attributes of all streams, such as the device that wrote these rows.
    at : int array, shape (n,)
        Index of each row among the rows passed to :func:`built`.
    data : bytes
        The complete text, from which readers take lines between the rows, such as comments.
    """

    reader: str
    options: ReadOptions
    lines: int
    row: IntArray
    time: AnyArray
    flag: AnyArray
    columns: dict[str, AnyArray] = field(default_factory=dict)
    blank: int = 0
    rejected: list[RejectedLine] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    relative: bool = False
    clock_from: str | None = None
    height_from: str | None = None
    about: dict[str, Attribute] = field(default_factory=dict)
    at: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    data: bytes = field(default=b"", repr=False)

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.row)

    def number(self, name: str, *, none: Iterable[bytes] = (b"n/a", b"-")) -> FloatArray:
        """Return a column as numbers, NaN for empty text and the words in ``none``."""
        cells = self.columns[name]
        if cells.dtype.kind == "f":
            return np.asarray(cells, dtype=np.float64)
        for word in none:
            cells = np.where(cells == word, b"", cells)
        return np.asarray(_text.numbers(cells), dtype=np.float64)

    def si(self, name: str) -> FloatArray:
        """Return a column of numbers with SI suffixes: ``-4.3k`` is -4300."""
        cells = [cell.strip() for cell in self.columns[name].tolist()]
        scaled = [cell[-1:] in _SI and cell[-2:-1].isdigit() for cell in cells]  # the n of 'nan' does not mean nano
        scale = np.array([_SI[cell[-1:]] if mark else 1.0 for cell, mark in zip(cells, scaled, strict=True)])
        plain = _text.cells([cell[:-1] if mark else cell for cell, mark in zip(cells, scaled, strict=True)])
        return np.asarray(replace(self, columns={name: plain}).number(name) * scale, dtype=np.float64)

    def text(self, name: str) -> list[str]:
        """Return a column as text."""
        return [cell.decode("utf-8", "replace") for cell in self.columns[name].tolist()]

    def mark(self, where: BoolArray, reason: str) -> None:
        """Add a reason to the flag of some rows."""
        _text.add_flag(self.flag, where, reason)

    def part(self, where: BoolArray) -> Rows:
        """Return the rows of a mask. The result shares the warnings and the account of all rows."""
        columns = {name: cells[where] for name, cells in self.columns.items()}
        return replace(
            self, row=self.row[where], time=self.time[where], flag=self.flag[where], at=self.at[where], columns=columns
        )

    def stream(
        self, kind: Kind, name: str, values: Mapping[str, AnyArray], *, where: BoolArray | None = None,
        pick: IntArray | None = None, flag: AnyArray | None = None, about: Mapping[str, Attribute | None] | None = None,
        **attributes: Attribute | None,
    ) -> Stream | None:  # fmt: skip
        """Return a stream of all rows, or of the rows of a mask. None if there are no rows.

        Parameters
        ----------
        kind, name : str
        values : mapping
            Columns of the kind and further columns, each of shape (n,).
        where : bool array, shape (n,), optional
        pick : int array, shape (m,), optional
            Index of the row of each record, for rows with several records. ``values`` and ``flag`` then have the shape
            (m,).
        flag : object array, shape (n,), optional
            Flags of this stream, instead of the common flags of all streams.
        about : mapping, optional
            Further attributes.
        **attributes
            Attributes. None means that an attribute is unknown, and is omitted.

        Returns
        -------
        Stream or None
        """
        shown = self.flag if flag is None else flag
        time, row = self.time, self.row
        if pick is not None:
            time, row, shown = time[pick], row[pick], shown[pick] if flag is None else flag
        elif where is not None and not where.all():
            time, row, shown = time[where], row[where], shown[where]
            values = {key: np.asarray(column)[where] for key, column in values.items()}
        if not len(row):
            return None
        frame = _text.frame(kind, time, row + 1, shown, values)
        shared = ({"clock": "relative"} if self.relative else {}) | {"clock_from": self.clock_from} | self.about
        attributes = shared | dict(about or {}) | attributes
        return Stream(kind, name, frame, _text.attributes(self.options, **attributes))

    def level(self, values: FloatArray) -> tuple[FloatArray, AnyArray]:
        """Return levels, NaN at or below the floor, and flags with ``out_of_coverage`` there."""
        flag, level = self.flag.copy(), np.array(values, dtype=np.float64)
        silent = ~(level > self.options.floor_db)  # +inf is flagged by the limits of all readers
        _text.add_flag(flag, silent, "out_of_coverage")
        level[silent] = np.nan
        return level, flag

    def rank(self, ri: FloatArray, *, none: BoolArray | None = None) -> dict[str, FloatArray]:
        """Return the columns ``rank`` and ``ri_raw`` of reported indicators, by :func:`checked_ranks`."""
        return {"rank": checked_ranks(ri, self.flag, none=none), "ri_raw": ri}

    def result(self, streams: Iterable[Stream | None]) -> ReadResult:
        """Return the streams that have rows, under unique names, with the account."""
        names: dict[str, Stream] = {}
        for stream in streams:
            if stream is not None:
                # names must be unique in a file, but a console that was started again repeats them
                alike = sum(name == stream.name or name.startswith(f"{stream.name}_again") for name in names)
                name = f"{stream.name}_again{alike}" if alike else stream.name
                names[name] = replace(stream, name=name) if alike else stream
        present = tuple(names.values())
        back = [text for stream in present[:1] for text in _text.back_in_time(stream.frame)]
        return ReadResult(
            reader=self.reader,
            streams=present,
            lines=self.lines,
            accepted=len(np.unique(self.row)),  # in markup, all records may be on one line
            blank=self.blank,
            rejected=tuple(sorted(self.rejected, key=lambda line: line.number)),
            warnings=tuple(dict.fromkeys([*self.warnings, *back])),
        )


def matched(
    data: bytes, pattern: re.Pattern[bytes], options: ReadOptions, *, reader: str, reason: Reason,
    skip: Callable[[IntArray], BoolArray] | None = None, clock: str = "wall",
) -> Rows:  # fmt: skip
    r"""Return the rows of a log whose lines match a pattern.

    Parameters
    ----------
    data : bytes
    pattern : re.Pattern
        Compiled with MULTILINE, from ``^`` to ``\r?$``. The pattern must not match across a line end, and every
        repetition must be bounded. One of its named groups is ``time``.
    reason : callable
        Function that returns why a line that does not match is rejected, or None for a header, comment or console
        output.
    skip : callable, optional
        Mask of the matching rows (0-based lines) that are comments.
    options : ReadOptions
    reader : str
        Name of the reader.
    clock : str
        See :func:`instants_of`.

    Returns
    -------
    Rows

    Raises
    ------
    UsageError
        If the clock has no zone and none is given.
    """
    lines = _text.split(data)
    rows, groups = _text.match(lines, pattern)
    texts = _text.columns(groups, pattern.groups)
    column = {name: texts[i - 1] for name, i in pattern.groupindex.items()}
    return built(lines, rows, column, options, reader=reader, others=OtherLines(reason), skip=skip, clock=clock)


@dataclass(frozen=True)
class OtherLines:
    """The lines of a file that are not rows, as far as the reader knows.

    Parameters
    ----------
    reason : callable
        Function that returns why a line is rejected, or None for a header, a comment or other console output. By
        default, no line is rejected.
    rejected : iterable of RejectedLine
        Lines that were rejected before.
    comments : int array, optional
        0-based lines known to be comments.
    closed : bool
        True if records have an end mark, so that a missing line end does not matter.
    """

    reason: Reason = field(default=lambda _line: None)
    rejected: Iterable[RejectedLine] = ()
    comments: IntArray | None = None
    closed: bool = False


def built(
    lines: _text.Lines, rows: IntArray, column: dict[str, AnyArray], options: ReadOptions, *, reader: str,
    others: OtherLines = OtherLines(), skip: Callable[[IntArray], BoolArray] | None = None, clock: str = "wall",
) -> Rows:  # fmt: skip
    """Return rows from line numbers and text columns, one of which is ``time``, like :func:`matched`.

    Parameters
    ----------
    lines : Lines
    rows : int array, shape (n,)
        0-based lines of the rows.
    column : mapping of str to array, shape (n,)
        Cells of these rows, as bytes or floats.
    options, reader, skip, clock
        The same as in :func:`matched`.
    others : OtherLines, optional

    Returns
    -------
    Rows
    """
    comment = np.zeros(len(rows), dtype=bool) if skip is None else skip(rows)
    before = list(others.rejected)
    # lines that were rejected earlier are already counted
    known = np.concatenate((rows, np.array([line.number - 1 for line in before], dtype=np.int64))).astype(np.int64)
    blank, rejected = _text.remainder(lines, known, others.reason, blank=others.comments)
    rejected += before
    blank += int(comment.sum())
    if comment.any():
        rows, column = rows[~comment], {name: cells[~comment] for name, cells in column.items()}
    column_time = column.pop("time")
    relative, instants, valid = instants_of(column_time, options, clock=clock, reader=reader)
    rejected += _untimed(lines, rows, column_time, valid, clock)
    flag = _text.no_flags(len(rows))
    instants.flag(flag)
    if lines.unterminated and not others.closed:
        _text.add_flag(flag, rows == len(lines) - 1, _text.UNTERMINATED)
    warnings = [*instants.warnings, *([RELATIVE] if relative and len(rows) else [])]
    at, time = np.flatnonzero(~comment), instants.time
    column = {name: cells for name, cells in column.items() if name != "time"}
    if not valid.all():
        rows, at, time, flag = rows[valid], at[valid], time[valid], flag[valid]
        column = {name: cells[valid] for name, cells in column.items()}
    return Rows(
        reader=reader, options=options, lines=len(lines), row=rows, time=time, flag=flag, columns=column, blank=blank,
        rejected=rejected, warnings=warnings, relative=relative,
        clock_from="written" if clock.startswith("epoch") or instants.zoned else None, at=at, data=lines.data,
    )  # fmt: skip


def _untimed(lines: _text.Lines, rows: IntArray, cells: AnyArray, valid: BoolArray, clock: str) -> list[RejectedLine]:
    """Return the lines rejected for their time: an unknown format, an invalid date, or too long for a flight."""
    bad = np.flatnonzero(~valid & ~np.isin(rows, rows[valid]))
    # reject a line of several records only once
    bad = bad[np.unique(rows[bad], return_index=True)[1]] if len(bad) else bad
    if clock != "wall":
        return lines.reject_all(rows[bad], NO_TIME)
    unread = cells[bad] == b"-"
    return lines.reject_all(rows[bad[unread]], _UNREAD) + lines.reject_all(rows[bad[~unread]], _NO_DATE)


RELATIVE = "the times are relative and no time_origin is given: they count from 1970-01-01T00:00"
_MOST_S = 9.2e9
# Relative times beyond about 285 years would leave the range of datetime64[ns].
_FLIGHT_S = 9.0e9


def instants_of(
    cells: AnyArray, options: ReadOptions, *, clock: str, reader: str
) -> tuple[bool, _text.Instants, BoolArray]:
    """Convert a column of times to UTC.

    Parameters
    ----------
    cells : bytes or float array, shape (n,)
    options : ReadOptions
    clock : str
        ``wall`` (text, local unless it has an offset), ``epoch_s``, ``epoch_ms``, ``epoch_us`` (UTC),
        ``relative_ns`` .. ``relative_h`` (from ``time_origin``, else from 1970-01-01).
    reader : str
        Name of the reader, for messages.

    Returns
    -------
    relative : bool
        True if the times have no origin.
    instants : Instants
    valid : bool array, shape (n,)
    """
    if clock == "wall":
        instants, valid = _text.texts_to_utc(cells, options, needed_by=reader)
        return False, instants, valid
    form, unit = clock.split("_")
    unit_ns = _text.COUNTS[unit].ns
    # the cells of tables are already floats
    value = cells if cells.dtype.kind == "f" else np.asarray(_text.numbers(cells), dtype=np.float64)
    origin = _text.origin_ns(options, needed_by=reader) if form == "relative" else 0
    most = _FLIGHT_S if form == "relative" else _MOST_S
    valid = np.isfinite(value) & (np.abs(value) * unit_ns <= most * 1e9)
    safe = np.where(valid, value, 0.0)
    integer = np.floor(safe)  # convert the fraction separately: float64 has too few digits for ns
    ns = integer.astype(np.int64) * int(unit_ns)
    ns += np.round((safe - integer) * unit_ns).astype(np.int64) + (origin or 0)
    if form == "epoch" and options.clock in ("local", "local_as_utc"):
        return False, _text.local_to_utc(ns, options.timezone, needed_by=reader), valid
    none = np.zeros(len(ns), dtype=bool)
    return origin is None, _text.Instants(ns.astype("datetime64[ns]"), none, none.copy()), valid


def snr_stream(rows: Rows, tower: str, values: FloatArray, where: BoolArray | None = None) -> Stream | None:
    """Return the SNR stream of one tower, with levels at or below the floor flagged ``out_of_coverage``.

    Parameters
    ----------
    rows : Rows
    tower : str
    values : (n,)
        SNR [dB].
    where : (n,) bool, optional
        Rows of this tower.

    Returns
    -------
    Stream or None
    """
    level, flag = rows.level(values)
    return rows.stream(
        "rss", tower, {"rss_db": level}, where=where, flag=flag, node=tower, channel="snr", unit="dB", quantity="SNR"
    )


def checked_ranks(ri: FloatArray, flag: AnyArray, *, none: BoolArray | None = None, means: bool = False) -> FloatArray:
    """Return ranks from indicators that count from one. Other values become NaN, with a reason added to ``flag``.

    Parameters
    ----------
    ri : float array, shape (m,)
        Rank indicator as logged, NaN if the log has no number.
    flag : object array, shape (m,)
    none : bool array, shape (m,), optional
        True where the number means that nothing was reported.
    means : bool
        True if the program prints means over its report period. A value between two ranks is then a missing rank, not
        an error.

    Returns
    -------
    float array, shape (m,)
    """
    absent = np.isnan(ri) | (np.zeros(len(ri), dtype=bool) if none is None else none)
    # 3GPP specifies at most eight layers
    inside = (ri >= 1) & (ri <= 8) & ~absent
    integer = inside & (ri == np.round(ri))
    _text.add_flag(flag, absent, "no_csi")
    _text.add_flag(flag, ~(inside if means else integer) & ~absent, "ri_out_of_range")
    _text.add_flag(flag, (inside & ~integer) if means else np.zeros(len(ri), dtype=bool), "rank_is_a_mean")
    return np.where(integer, ri, np.nan)


def mean_rank(
    rows: Rows, ri: FloatArray, columns: Mapping[str, FloatArray], *, pick: IntArray | None = None
) -> list[Stream | None]:
    """Return the rank streams ``gnb`` of a base station that prints means over its report period (0 if no report).

    A mean between two ranks is not a rank: it is in ``rank_mean``, and its row is flagged ``rank_is_a_mean``.

    Parameters
    ----------
    rows : Rows
    ri : float array, shape (m,)
    columns : mapping
        Further columns.
    pick : int array, shape (m,), optional
        See :meth:`Rows.stream`.

    Returns
    -------
    list of Stream or None
        See :func:`of_ues`.
    """
    flag = (rows.flag if pick is None else rows.flag[pick]).copy()
    rank = checked_ranks(ri, flag, none=ri == 0, means=True)
    rank_mean = np.where((ri >= 1) & (ri <= 8), ri, np.nan)
    values = {"rank": rank, "ri_raw": ri, **columns, "rank_mean": rank_mean}
    about = {"ri_base": "one", "source": "CSI report, mean over the period"}
    return of_ues(rows, "rank", rows.options.channel or "gnb", values, pick=pick, flag=flag, about=about)


def of_ues(
    rows: Rows, kind: Kind, name: str, values: Mapping[str, FloatArray], *, pick: IntArray | None = None,
    flag: AnyArray, about: Mapping[str, Attribute | None],
) -> list[Stream | None]:  # fmt: skip
    """Return a stream per UE (RNTI, cell) if several were attached at the same time, else one stream for all RNTIs.

    A UE that attaches again gets a new RNTI.

    Parameters
    ----------
    rows : Rows
    kind, name : str
        Kind and name. If there are several streams, ``_rnti<hex>`` is appended to the name, or ``_pci<n>`` for one RNTI
        in several cells.
    values : mapping
        Columns of shape (m,), one of them ``rnti`` (NaN if unknown).
    pick : int array, shape (m,), optional
        See :meth:`Rows.stream`.
    flag : object array, shape (m,)
    about : mapping
        Attributes of all streams.

    Returns
    -------
    list of Stream or None
    """
    pick, rnti = np.arange(len(rows)) if pick is None else pick, values["rnti"]
    rnti = _identity(rnti, _MOST_RNTI)
    parts: list[tuple[str, BoolArray, dict[str, Attribute | None]]] = [
        (ue, mine, {"identity_from": "assumed"} if number is None else {"rnti": int(number)})
        for ue, mine, number in _divided(name, np.ones(len(rnti), dtype=bool), rnti, "rnti{:04x}")
    ]
    if "pci" in values:  # two cells may assign the same RNTI at the same time
        parts = [
            (cell, within, {**more, "pci": int(number)} if cell != ue and number is not None else more)
            for ue, mine, more in parts
            for cell, within, number in _divided(ue, mine, _identity(values["pci"], _MOST_PCI), "pci{}")
        ]
    return [
        rows.stream(
            kind, ue, {key: column[mine] for key, column in values.items()}, pick=pick[mine], flag=flag[mine],
            about={**about, **more},
        )
        for ue, mine, more in parts
    ]  # fmt: skip


def _divided(name: str, where: BoolArray, column: FloatArray, label: str) -> list[tuple[str, BoolArray, float | None]]:
    """Divide rows by the values of a column if the times of several values overlap, else return one part."""
    known = np.unique(column[where & np.isfinite(column)]).tolist()
    if not _together([np.flatnonzero(where & (column == item))[[0, -1]] for item in known]):
        return [(name, where, known[0] if len(known) == 1 else None)]
    parts: list[tuple[str, BoolArray, float | None]] = [
        (f"{name}_{label.format(int(item))}", where & (column == item), item) for item in known
    ]
    return [*parts, (name, where & np.isnan(column), None)]


def _identity(numbers: FloatArray, most: int) -> FloatArray:
    """Return the numbers that can be an identity. Other numbers, such as fractions, become NaN."""
    return np.where((numbers >= 0) & (numbers <= most) & (numbers == np.round(numbers)), numbers, np.nan)


# RNTIs have sixteen bits, but programs print up to six hex digits.
_MOST_RNTI, _MOST_PCI = 0xFFFFFF, 1007


def _together(spans: list[IntArray]) -> bool:
    """Check whether any two spans (first, last) overlap."""
    ordered = sorted(spans, key=lambda span: int(span[0]))
    return any(later[0] < earlier[1] for earlier, later in pairwise(ordered))


Pattern = re.Pattern[bytes]
BOM = rb"(?:\xef\xbb\xbf)?"


@dataclass(frozen=True)
class LineFormat:
    r"""The lines of a text format: its rows, the line by which a file is recognised, and the lines that are errors.

    Parameters
    ----------
    row : re.Pattern or callable
        See :func:`aerpaw_cmp.logs.rows.matched`. A callable returns the pattern for a file, for instance from its
        header.
    header : re.Pattern, optional
        The complete line above a table, which is a comment at any position. A file is recognised by this line or by
        ``mark``. Without both, it is recognised if most of its first lines are rows.
    mark : re.Pattern, optional
        A line by which a console is recognised, as a MULTILINE pattern.
    torn : re.Pattern, optional
        The beginning of a row of a console. A line that begins in this way but is not a row is rejected, and all other
        lines are comments. If it is None, every line that is neither a row nor the header is rejected.
    otherwise : str
        Reason of rejected lines.
    fields : int
        Number of fields of a table. Lines with another number of fields are rejected.
    clock : str
        See :func:`aerpaw_cmp.logs.rows.instants_of`.
    skip : callable, optional
        ``skip(data, lines)`` returns which of the matching lines (0-based) are comments.
    """

    row: Pattern | Callable[[bytes], Pattern]
    header: Pattern | None = None
    mark: Pattern | None = None
    torn: Pattern | None = None
    otherwise: str = "does not have the form of the format's rows (truncated line?)"
    fields: int = 0
    clock: str = "wall"
    skip: Callable[[bytes, IntArray], BoolArray] | None = None

    def rows(self, data: bytes, options: ReadOptions, *, reader: str) -> Rows:
        """Return the rows of a file and the account of its other lines, for the reader of this name."""
        pattern, skip = self.row if isinstance(self.row, re.Pattern) else self.row(data), self.skip
        comments = None if skip is None else lambda lines: skip(data, lines)
        return matched(data, pattern, options, reader=reader, reason=self._reason, clock=self.clock, skip=comments)

    def sniff(self, head: bytes) -> bool:
        """Check whether the beginning of a file has this format."""
        if self.mark is not None:
            # exclude markup first: an expression anchored to line starts takes 5 ms per MiB, and sniffers see 4 MiB of
            # a KML
            return not head.startswith(_text.MARKUP) and self.mark.search(head) is not None
        if self.header is not None:
            return self.header.fullmatch(head[:4000].split(b"\n", 1)[0]) is not None
        return _text.mostly(head, self.row) if isinstance(self.row, re.Pattern) else False

    def _reason(self, line: bytes) -> str | None:
        """Return the reason why a line that is not a row is rejected, or None for a comment."""
        if self.header is not None and self.header.fullmatch(line):
            return None
        if self.torn is not None:
            return "an incomplete row (truncated line?)" if self.torn.match(line) else None
        count = line.count(b",") + 1
        if self.fields in (0, count):
            return self.otherwise
        return f"{counted(count, 'field')}, expected {self.fields} (truncated line?)"


def text_reader(
    name: str, title: str, *, kinds: tuple[Kind, ...], sample: str, lines: LineFormat,
    streams: Callable[[Rows], Iterable[Stream | None]], clock_from: str = ASSUMED_CLOCK,
    height_from: str = ASSUMED_HEIGHT,
) -> Reader:  # fmt: skip
    """Return a reader for a format whose lines are described by a pattern.

    Parameters
    ----------
    name, title, kinds, sample, clock_from, height_from
        The same as in :class:`aerpaw_cmp.logs.readers.Reader`.
    lines : LineFormat
    streams : callable
        ``streams(rows)`` returns the streams of the rows.

    Returns
    -------
    Reader
    """

    def read(data: bytes, options: ReadOptions) -> ReadResult:
        rows = lines.rows(data, options, reader=name)
        return rows.result(streams(rows))

    return Reader(
        name=name, title=title, kinds=kinds, sample=sample, sniff=lines.sniff, read=read, clock_from=clock_from,
        height_from=height_from,
    )  # fmt: skip
