"""Any CSV with a header, its columns mapped by the user: ``columns: {time: Time, rss_db: Power}``, ``kind: rss``.

It is never guessed: flight.yaml names it. Times are texts (``YYYY-mm-dd HH:MM:SS[.f][offset]``) or numbers: seconds
since ``time_origin`` where that is given, else since 1970 in UTC (``clock: local_as_utc`` for wall time stored so).
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable, Mapping
from dataclasses import replace
from difflib import get_close_matches

import numpy as np
import pandas as pd

from aerpaw_cmp.common.errors import InputError, UsageError
from aerpaw_cmp.common.units import AnyArray, BoolArray, FloatArray, IntArray
from aerpaw_cmp.logs import blocks
from aerpaw_cmp.logs.readers import Reader, ReadOptions
from aerpaw_cmp.logs.records import COLUMNS, Kind, ReadResult, RejectedLine, Stream

from . import _by_eights, _frames, _lines, _table, _time
from ._sheet import SEPARATORS

EXTRA = ("rsrp_dbm", "sinr_db", "cqi", "mcs", "latitude_deg", "longitude_deg", "altitude_m")
_BESIDE: dict[str, tuple[str, ...]] = {"rank": EXTRA, "rss": (*COLUMNS["telemetry"][:-2], "sinr_db")}
"""What may stand beside a rank, or beside a level: the positions of a table merged by hand are its track."""
_VALUE = {"telemetry": ("latitude_deg", "longitude_deg", "altitude_m"), "rss": ("rss_db",), "rank": ("ri_raw",)}
"""Columns that a record of a kind is about."""

_TEXT = re.compile(_time.TIME + _time.ZONE)
_PLAIN = re.compile(_lines.NUMBER)
_INK = re.compile(rb"\S")
_FORM = re.compile(rb"%s|%s" % (_TEXT.pattern, _PLAIN.pattern))


def sniff(head: bytes) -> bool:  # noqa: ARG001 - the contract of sniffers
    """Never: a CSV says nothing about its units; name this reader in flight.yaml."""
    return False


def _fields(line: bytes, separator: str) -> list[str]:
    text = line.decode("utf-8", errors="replace")
    if '"' not in text:
        return text.split(separator)
    # a stray CR or NUL would end the csv module's patience with the whole line
    return next(csv.reader([text.replace("\0", "\ufffd").replace("\r", " ")], delimiter=separator), [])


def _separator(header: bytes) -> str:
    """The sign that the header's names stand between: the most frequent one, a comma where none does."""
    return max(SEPARATORS, key=lambda sign: header.count(sign.encode()))


def _header(data: bytes) -> tuple[int, str, list[str]] | None:
    """Number (from 0), separator and names of the first line that is not blank; None where all are."""
    begun = _INK.search(data)
    if begun is None:
        return None
    first = data.count(b"\n", 0, begun.start())
    end = data.find(b"\n", begun.start())
    line = data[data.rfind(b"\n", 0, begun.start()) + 1 : end if end >= 0 else len(data)].removesuffix(b"\r")
    line = line.removeprefix(b"\xef\xbb\xbf")
    separator = _separator(line)
    try:
        return first, separator, [name.strip() for name in _fields(line, separator)]
    except csv.Error as error:
        raise InputError(f"the header is no CSV ({error})", expected="column names", line=first + 1) from error


def _checked(options: ReadOptions, header: list[str]) -> tuple[Kind, dict[str, int]]:
    """Kind, and the position of the file column for each record column."""
    if options.kind is None:
        raise UsageError("generic_csv does not know what the file holds", expected="'kind:' telemetry, rss or rank")
    allowed = ["time", *COLUMNS[options.kind], *_BESIDE.get(options.kind, ())]
    unknown = sorted(set(options.columns) - set(allowed))
    if unknown:
        near = get_close_matches(unknown[0], allowed, 1)
        raise UsageError(
            f"'columns:' names {unknown[0]!r}, which a {options.kind} record does not have",
            expected=", ".join(allowed),
            cause=f"did you mean {near[0]!r}?" if near else None,
        )
    lacking = [name for name in ("time", *_VALUE[options.kind]) if name not in options.columns]
    if lacking:
        raise UsageError(
            f"'columns:' lacks {', '.join(lacking)}", expected=f"e.g. columns: {{{lacking[0]}: {header[0]!r}}}"
        )
    absent = sorted({name for name in options.columns.values() if name not in header})
    if absent:
        near = get_close_matches(absent[0], header, 1)
        raise UsageError(
            f"the file has no column {absent[0]!r}",
            expected="one of " + ", ".join(repr(name) for name in header[:40]),
            cause=f"did you mean {near[0]!r}?" if near else None,
        )
    if options.kind == "rank" and options.ri_base is None:
        raise UsageError(
            "generic_csv cannot know whether rank 1 is written as 0 or 1", expected="'ri_base:' zero or one"
        )
    return options.kind, {column: header.index(name) for column, name in options.columns.items()}


_NONE = (b"", b"nan", b"na", b"n/a", b"none", b"null", b"-", b"--", b"-inf", b"-infinity")
"""What stands for no value; -inf dB is no signal. Any other word, and +inf, is flagged."""


def _numbers(cells: list[str], comma: bool = False) -> FloatArray:
    """Numbers of a column; what is none becomes NaN, and +inf where it is a word: the limits flag it."""
    stripped = [cell.strip().strip('"').encode("ascii", "replace") for cell in cells]
    if comma:  # a decimal comma, where the separator leaves room for one
        stripped = [cell.replace(b",", b".") for cell in stripped]
    return np.array([_number(cell) for cell in stripped], dtype=np.float64)


def _number(cell: bytes) -> float:
    if _PLAIN.fullmatch(cell):
        return float(cell)
    return np.nan if cell.lower() in _NONE else np.inf


def _times(cells: list[str], options: ReadOptions) -> tuple[_time.Instants, AnyArray]:
    texts = [_bare(cell) for cell in cells]
    if not _counts(texts):
        written = np.array([cell if _TEXT.fullmatch(cell) else b"-" for cell in texts] or [b"-"], dtype=np.bytes_)
        return _time.texts_to_utc(written[: len(texts)], options, needed_by="generic_csv")
    return _counted(np.array([float(cell) if _PLAIN.fullmatch(cell) else np.nan for cell in texts]), options)


def _bare(cell: str) -> bytes:
    return cell.strip().strip('"').encode("ascii", "replace")


def _counted(seconds: FloatArray, options: ReadOptions) -> tuple[_time.Instants, AnyArray]:
    """Instants of times that are numbers; where they are none NaN."""
    origin = _time.origin_ns(options, needed_by="generic_csv")
    valid = np.isfinite(seconds) & (np.abs(seconds) < (9e8 if origin is not None else 9.2e9))
    whole = np.floor(np.where(valid, seconds, 0))
    ns = whole.astype(np.int64) * 10**9 + np.round((np.where(valid, seconds, 0) - whole) * 1e9).astype(np.int64)
    ns += origin or 0
    if origin is None and options.clock in ("local", "local_as_utc"):
        return _time.local_to_utc(ns, options.timezone, needed_by="generic_csv"), valid
    none = np.zeros(len(ns), dtype=bool)
    return _time.Instants(ns.astype("datetime64[ns]"), none, none.copy()), valid


def _counts(texts: Iterable[bytes]) -> bool:
    """Whether times are numbers: the first that is a time in either form decides."""
    for text in texts:
        if _PLAIN.fullmatch(text):
            return True
        if _TEXT.fullmatch(text):
            return False
    return False


def read(data: bytes, options: ReadOptions) -> ReadResult:
    """One stream of the kind that the options name.

    Raises
    ------
    UsageError
        If ``kind``, ``columns``, ``ri_base`` or ``timezone`` is missing or names what is not there.
    """
    return _settled(_read(data, options))


def _settled(result: ReadResult) -> ReadResult:
    """How many rows hold a word where a number belongs, with the first of them."""
    if not result.streams:
        return result
    frame = result.streams[0].frame
    flag = frame["flag"].to_numpy(dtype=object)
    marked = np.flatnonzero(flag != "").tolist()
    odd = [i for i in marked if "no_number" in flag[i].split(";")]
    if not odd:
        return result
    words = "1 row is" if len(odd) == 1 else f"{len(odd)} rows are"
    first = int(frame["line"].iloc[odd[0]])
    text = f"{words} flagged no_number; the first: line {first}, a word or an infinity; not scored"
    return replace(result, warnings=(*result.warnings, text))


def _head(data: bytes, options: ReadOptions) -> int:
    """Bytes of the header and of the rows down to the first with a time: that row says which form times have."""
    end, column, sign = 0, -1, ","
    for line in io.BytesIO(data[:1_000_000]):  # lines end with a line feed alone
        end += len(line)
        if not line.strip():
            continue
        try:
            text = line.removeprefix(b"\xef\xbb\xbf").rstrip(b"\r\n")
            sign = _separator(text) if column < 0 else sign
            cells = _fields(text, sign)
        except csv.Error:
            continue
        if column < 0:
            names = [name.strip() for name in cells]
            column = names.index(options.columns.get("time", "")) if options.columns.get("time") in names else 0
        elif len(cells) == len(names) and _FORM.fullmatch(cells[column].strip().strip('"').encode("ascii", "replace")):
            break
    return end


def _read(data: bytes, options: ReadOptions) -> ReadResult:
    """What each row says by itself."""
    top = _header(data)
    if top is None:
        count = len(_lines.split(data))
        return ReadResult("generic_csv", (), count, 0, count)
    first, separator, header = top
    kind, where = _checked(options, header)
    lines, found = _by_eights.table(data, len(header), ord(separator))
    table = _at_once(lines, found, first, where, options) or _one_by_one(lines, first, where, header, options)
    rows, rejected, instants, valid, numbers = table
    rejected += [lines.reject(int(i), "the time is of another form") for i in rows[~valid]]
    flag = _lines.flags(len(rows))
    instants.flag(flag)
    odd = np.any([np.isposinf(numbers[name]) for name in _VALUE[kind]], axis=0)
    _lines.add_flag(flag, odd, "no_number")
    numbers = {k: np.where(np.isposinf(v), np.nan, v) if np.isposinf(v).any() else v for k, v in numbers.items()}
    values, extra = _values(kind, numbers, flag, options)
    if lines.unterminated:
        _lines.add_flag(flag, rows == len(lines) - 1, _lines.UNTERMINATED)
    frame = _frames.frame(kind, instants.time, rows + 1, flag, values)
    if not valid.all():
        frame = frame[valid].reset_index(drop=True)
    stream = Stream(kind, options.channel or kind, frame, _frames.attributes(options, **extra))
    warnings = [*instants.warnings, *_frames.steps_back(frame)]
    if kind == "rss" and options.unit is None:
        warnings.append("no 'unit:' is given: the levels are taken as dB re full scale")
    return ReadResult(
        reader="generic_csv",
        streams=(stream, *_track(kind, frame, options)) if len(frame) else (),
        lines=len(lines),
        accepted=len(frame),
        blank=int(lines.blank.sum()) + 1,
        rejected=tuple(sorted(rejected, key=lambda line: line.number)),
        warnings=tuple(warnings),
    )


_Table = tuple[IntArray, list[RejectedLine], _time.Instants, BoolArray, dict[str, FloatArray]]
"""0-based rows, other lines as rejected, times, whether they are some, and the mapped columns."""


def _one_by_one(
    lines: _lines.Lines, first: int, where: Mapping[str, int], header: list[str], options: ReadOptions
) -> _Table:
    """The table cell by cell, whatever it holds."""
    rows, cells, rejected = _cells(lines, first, len(header))
    column = {name: [line[i] for line in cells] for name, i in where.items()}
    instants, valid = _times(column.pop("time"), options)
    comma = _separator(lines.raw(first)) != ","
    return rows, rejected, instants, valid, {name: _numbers(texts, comma) for name, texts in column.items()}


def _at_once(
    lines: _lines.Lines, found: _table.Fields, first: int, where: Mapping[str, int], options: ReadOptions
) -> _Table | None:
    """The table column by column, or None where quotes or a cell beyond any number stand in the way."""
    separator, width = _separator(lines.raw(first)), found.ends.shape[1]
    if b'"' in lines.data or b"\0" in lines.data:
        return None
    found = found.take(~lines.blank[found.rows] & (found.rows != first))
    if not len(found.rows):
        return None
    left = ~lines.blank
    left[found.rows] = left[first] = False
    rejected = []
    for i in np.flatnonzero(left).tolist():
        count = lines.raw(i).count(separator.encode()) + 1
        rejected.append(lines.reject(i, f"{count} fields where the header has {width} (torn line?)"))

    numbers = dict(where)
    clock = numbers.pop("time")
    columns = sorted(set(numbers.values()))
    plain = _by_eights.decimals(lines, found, columns, comma=separator != ",")
    read: dict[int, FloatArray] = {}
    for column, value, odd in zip(columns, plain.value, plain.odd, strict=True):
        made = _mended(lines, found, column, value, odd, comma=separator != ",")
        if made is None:
            return None
        read[column] = made
    times = _clock(_texts(lines, found, clock), options)
    if times is None:
        return None
    return found.rows, rejected, *times, {name: read[column] for name, column in numbers.items()}


def _texts(lines: _lines.Lines, found: _table.Fields, column: int) -> AnyArray:
    return _table.texts(lines, found.start(column), found.ends[:, column])


def _mended(
    lines: _lines.Lines, found: _table.Fields, column: int, value: FloatArray, odd: BoolArray, *, comma: bool
) -> FloatArray | None:
    """Numbers of a column with the odd cells as :func:`_number` reads them, each text once; None if one is long."""
    rows = np.flatnonzero(odd)
    if 8 * len(rows) > len(odd):
        separator = chr(lines.data[int(found.ends[0, 0])]) if found.ends.shape[1] > 1 else ","
        also = b" :TZ/" + (separator.encode() if comma else b"")
        width = found.ends.shape[1]
        read = _table.numbers(lines, found.rows, width, [column], also=also, separator=separator) if _EXACT else None
        return read[0] if read is not None else _column(_texts(lines, found, column), comma=comma)
    known: dict[bytes, float] = {}
    places = zip(rows.tolist(), found.start(column)[rows].tolist(), found.ends[rows, column].tolist(), strict=True)
    for i, begin, end in places:
        if end - begin > _MOST_BYTES:
            return None
        text = lines.data[begin:end]
        if text not in known:
            known[text] = float(_numbers([text.decode("utf-8", "replace")], comma)[0])
        value[i] = known[text]
    return value


_EXACT = int(pd.__version__.split(".")[0]) >= 3
"""Whether pandas' parser reads each decimal as ``float`` does, to the last digit."""
_MOST_BYTES = 400
_OF_NUMBERS = np.zeros(256, dtype=np.bool_)
_OF_NUMBERS[np.frombuffer(b"0123456789+-.eE\0", dtype=np.uint8)] = True


def _column(cells: AnyArray, *, comma: bool) -> FloatArray | None:
    """As :func:`_numbers`, of byte strings without NUL: numbers at once, each other text once; None if one is long."""
    width = cells.dtype.itemsize
    if width > _MOST_BYTES:
        return None
    byte = np.zeros((len(cells), width + 1), dtype=np.uint8)
    byte[:, :width] = cells.view(np.uint8).reshape(len(cells), width)
    if comma:
        byte[byte == 44] = 46
    begin = np.where((byte[:, 0] == 43) | (byte[:, 0] == 45), byte[:, 1], byte[:, 0])
    number = begin - np.uint8(48) <= 9
    for column in byte.T:
        number &= _OF_NUMBERS[column]
    shown = byte.view(f"S{width + 1}").ravel()
    out = np.full(len(cells), np.nan)
    try:
        out[number] = shown[number].astype(np.float64)
    except ValueError:  # such as 1e or 1.2.3
        number[:] = False
    known: dict[bytes, float] = {b"": np.nan}
    for i in np.flatnonzero(~number & (byte[:, 0] > 0)).tolist():
        text = bytes(cells[i])
        if text not in known:
            known[text] = float(_numbers([text.decode("utf-8", "replace")], comma)[0])
        out[i] = known[text]
    return out


def _clock(cells: AnyArray, options: ReadOptions) -> tuple[_time.Instants, BoolArray] | None:
    """As :func:`_times`, of byte strings without NUL; None where some are long."""
    width = cells.dtype.itemsize
    if width > _MOST_BYTES:
        return None
    byte = cells.view(np.uint8).reshape(len(cells), width)
    last = byte[:, -1]
    if not last.all():
        last = byte[np.arange(len(cells)), np.maximum(np.char.str_len(cells) - 1, 0)]
    strange = (byte[:, 0] <= 32) | (last <= 32)
    if byte.max() > 126:
        strange |= (byte > 126).any(axis=1)
    odd = np.flatnonzero(strange)
    if len(odd):  # blanks around, which are taken off, or letters of no time
        bare = [_bare(bytes(cells[i]).decode("utf-8", "replace")) for i in odd.tolist()]
        cells = cells.astype(f"S{max(width, *map(len, bare))}")
        cells[odd] = bare
    if not _counts(bytes(cell) for cell in cells):
        return _time.texts_to_utc(cells, options, needed_by="generic_csv")
    seconds = _column(cells, comma=False)
    return None if seconds is None else _counted(np.where(np.isinf(seconds), np.nan, seconds), options)


def _cells(lines: _lines.Lines, first: int, width: int) -> tuple[AnyArray, list[list[str]], list[RejectedLine]]:
    """Rows with as many fields as the header, and the rest as rejected lines."""
    numbers: list[int] = []
    cells: list[list[str]] = []
    rejected: list[RejectedLine] = []
    separator = _separator(lines.raw(first))
    for i in np.flatnonzero(~lines.blank).tolist():
        if i == first:
            continue
        try:
            fields = _fields(lines.raw(i), separator)
        except csv.Error as error:
            rejected.append(lines.reject(i, f"no CSV: {error}"))
            continue
        if len(fields) == width:
            numbers.append(i)
            cells.append(fields)
        else:
            rejected.append(lines.reject(i, f"{len(fields)} fields where the header has {width} (torn line?)"))
    return np.array(numbers, dtype=np.int64), cells, rejected


def _track(kind: Kind, frame: pd.DataFrame, options: ReadOptions) -> list[Stream]:
    """Positions that stand beside levels, as the track of the flight: a table merged by hand holds both."""
    names = [name for name in COLUMNS["telemetry"] if name in frame and name not in ("fix", "satellites")]
    if kind != "rss" or not {"latitude_deg", "longitude_deg"} <= set(names):
        return []
    values = {name: frame[name].to_numpy() for name in names}
    flag = _lines.flags(len(frame))
    track = _frames.frame("telemetry", frame["time"].to_numpy(), frame["line"].to_numpy(), flag, values)
    return [Stream("telemetry", "vehicle", track, _frames.attributes(options, source="mapped columns"))]


def _values(
    kind: Kind, values: dict[str, AnyArray], flag: AnyArray, options: ReadOptions
) -> tuple[dict[str, AnyArray], dict[str, str | None]]:
    """Columns by the rules of the kind, and the attributes that go with them."""
    if kind == "rss":
        silent = ~(values["rss_db"] > options.floor_db)
        _lines.add_flag(flag, _no_words(silent, flag), "out_of_coverage")
        values["rss_db"] = np.where(silent, np.nan, values["rss_db"])
        return values, {"unit": options.unit or "dB re full scale"}
    if kind == "rank":
        ri = values["ri_raw"]
        rank = ri + 1 if options.ri_base == "zero" else ri
        good = (rank >= 1) & (rank <= 8)
        none = np.isnan(ri) | ((ri == 0) & (options.ri_base == "one"))
        _lines.add_flag(flag, _no_words(none, flag), "no_csi")
        _lines.add_flag(flag, ~good & ~none, "ri_out_of_range")
        values["rank"] = np.where(good, rank, np.nan)
        return values, {"ri_base": options.ri_base}
    latitude, longitude, altitude = (values[name] for name in ("latitude_deg", "longitude_deg", "altitude_m"))
    lost = ~((np.abs(latitude) <= 90) & (np.abs(longitude) <= 180) & (altitude > -998.5))
    _lines.add_flag(flag, lost, "no_fix")
    for name in ("latitude_deg", "longitude_deg", "altitude_m"):
        values[name] = np.where(lost, np.nan, values[name])
    for name in ("fix", "satellites"):
        if name in values:
            values[name] = np.where(np.isnan(values[name]), -1, values[name]).clip(-1, 255).astype(np.int64)
    return values, {}


def _no_words(mask: BoolArray, flag: AnyArray) -> BoolArray:
    """Rows of the mask whose flag is not that of a word alone."""
    out: BoolArray = mask.copy()
    rows = np.flatnonzero(mask)
    out[rows] = flag[rows] != "no_number"
    return out


READER = Reader(
    name="generic_csv",
    title="any CSV with a header, columns mapped in flight.yaml",
    kinds=("telemetry", "rss", "rank"),
    sample="Time,Power,...",
    sniff=sniff,
    read=read,
    in_blocks=blocks.by_lines(_read, head=_head, settle=_settled),
)
