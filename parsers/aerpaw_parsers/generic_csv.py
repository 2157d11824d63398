"""Any CSV with a header, its columns mapped by the user: ``columns: {time: Time, rss_db: Power}``, ``kind: rss``.

It is never guessed: flight.yaml names it. Times are texts (``YYYY-mm-dd HH:MM:SS[.f][offset]``, or as tables of other
programs have them: ``15.07.2024 11:49:27,231``) or numbers: seconds since ``time_origin`` where that is given, else
since 1970 in UTC (``clock: local_as_utc`` for wall time stored so).
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from difflib import get_close_matches

import numpy as np

from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.common.units import AnyArray, FloatArray
from aerpaw_cmp.logs import clocks as _time
from aerpaw_cmp.logs import lines as _lines
from aerpaw_cmp.logs import rows as _rows
from aerpaw_cmp.logs.readers import Reader, ReadOptions
from aerpaw_cmp.logs.records import COLUMNS, Kind, ReadResult, Stream

from . import _sheet, _stamps

_EXTRA = ("rsrp_dbm", "sinr_db", "cqi", "mcs", "latitude_deg", "longitude_deg", "altitude_m")
# What may stand beside a rank, or beside a level: the positions of a table merged by hand are its track.
_COMPANIONS: dict[str, tuple[str, ...]] = {"rank": _EXTRA, "rss": (*COLUMNS["telemetry"][:-2], "sinr_db")}
# Columns that a record of a kind is about.
_VALUE = {"telemetry": ("latitude_deg", "longitude_deg", "altitude_m"), "rss": ("rss_db",), "rank": ("ri_raw",)}

_TEXT = re.compile(_time.TIME + _time.ZONE)
_PLAIN = re.compile(_lines.NUMBER)
_INK = re.compile(rb"\S")


def sniff(head: bytes) -> bool:  # noqa: ARG001 - the contract of sniffers
    """Never: a CSV says nothing about its units; name this reader in flight.yaml."""
    return False


def _separator(header: bytes) -> str:
    """The sign that the header's names stand between: the most frequent one, a comma where none does."""
    return max(_sheet.SEPARATORS, key=lambda sign: header.count(sign.encode()))


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
    return first, separator, [name.strip() for name in _sheet.split_row(line, separator)]


def _checked(options: ReadOptions, header: list[str]) -> tuple[Kind, dict[str, int]]:
    """Kind, and the position of the file column for each record column."""
    if options.kind is None:
        raise UsageError("generic_csv does not know what the file holds", expected="'kind:' telemetry, rss or rank")
    allowed = ["time", *COLUMNS[options.kind], *_COMPANIONS.get(options.kind, ())]
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


# What stands for no value; -inf dB is no signal. Any other word, and +inf, is flagged.
_NONE = (b"", b"nan", b"na", b"n/a", b"none", b"null", b"-", b"--", b"-inf", b"-infinity")


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


def _times(cells: list[str], options: ReadOptions, *, comma: bool) -> tuple[str, AnyArray, list[str]]:
    """Kind of clock and times, as :func:`aerpaw_cmp.logs.rows.times` takes them, and warnings."""
    texts = [_bare(cell) for cell in cells]
    if not _counts(texts):
        return _stamps.read([text.decode() for text in texts], options, european=comma)
    _stamps.refuse_rounded([text.decode() for text in texts if text])
    seconds = np.array([float(cell) if _PLAIN.fullmatch(cell) else np.nan for cell in texts], dtype=np.float64)
    return "epoch_s" if options.time_origin is None else "relative_s", seconds, []


def _bare(cell: str) -> bytes:
    return cell.strip().strip('"').encode("ascii", "replace")


def _counts(texts: Iterable[bytes]) -> bool:
    """Check whether times are numbers: the first that is a time in either form decides."""
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
    top = _header(data)
    if top is None:
        count = len(_lines.split(data))
        return ReadResult("generic_csv", (), count, 0, count)
    first, separator, header = top
    kind, where = _checked(options, header)
    lines = _lines.split(data)
    sheet = _sheet.cut(lines, first, separator, header)
    column = {name: [fields[i] for fields in sheet.cells] for name, i in where.items()}
    comma = separator != ","  # a decimal comma, where the separator leaves room for one
    clock, time, warnings = _times(column.pop("time"), options, comma=comma)
    numbers = {name: _numbers(texts, comma=comma) for name, texts in column.items()}
    rows = _rows.built(
        lines, sheet.row, {"time": time, **numbers}, options, reader="generic_csv", reason=lambda _line: None,
        clock=clock, extra=sheet.rejected, markup=sheet.blank_rows,
    )  # fmt: skip
    rows.warnings += warnings
    if kind == "rss" and options.unit is None:
        rows.warnings.append("no 'unit:' is given: the levels are taken as dB re full scale")
    return rows.result([_stream(rows, kind, list(numbers)), _track(rows, kind)])


def _stream(rows: _rows.Rows, kind: Kind, names: list[str]) -> Stream | None:
    """Columns by the rules of the kind, and the attributes that go with them; words in place of numbers are flagged."""
    options, flag = rows.options, rows.flag.copy()
    odd = np.any([np.isposinf(rows.columns[name]) for name in _VALUE[kind]], axis=0)
    _lines.add_flag(flag, odd, "no_number")
    if odd.any():
        lines = "1 row is" if odd.sum() == 1 else f"{odd.sum()} rows are"
        first = int(rows.row[odd][0]) + 1
        rows.warnings.append(f"{lines} flagged no_number; the first: line {first}, a word or an infinity; not scored")
    values: dict[str, AnyArray] = {name: _finite(rows, name) for name in names}
    attributes: dict[str, str | None] = {}
    if kind == "rss":
        silent = ~(values["rss_db"] > options.floor_db)
        _lines.add_flag(flag, silent & ~odd, "out_of_coverage")
        values["rss_db"] = np.where(silent, np.nan, values["rss_db"])
        attributes = {"unit": options.unit or "dB re full scale"}
    elif kind == "rank":
        base, ri = int(options.ri_base == "one"), values["ri_raw"]
        good = (ri >= base) & (ri <= 7 + base) & (ri == np.round(ri))
        none = np.isnan(ri) | ((ri == 0) & (base == 1))
        _lines.add_flag(flag, none & ~odd, "no_csi")
        _lines.add_flag(flag, ~good & ~none, "ri_out_of_range")
        values["rank"] = np.where(good, ri + 1 - base, np.nan)
        attributes = {"ri_base": options.ri_base}
    else:
        place = ("latitude_deg", "longitude_deg", "altitude_m")
        latitude, longitude, altitude = (values[name] for name in place)
        lost = ~((np.abs(latitude) <= 90) & (np.abs(longitude) <= 180) & (altitude > -998.5))
        _lines.add_flag(flag, lost, "no_fix")
        values |= {name: np.where(lost, np.nan, values[name]) for name in place}
        for name in {"fix", "satellites"} & set(values):
            values[name] = np.where(np.isnan(values[name]), -1, values[name]).clip(-1, 255).astype(np.int64)
    return rows.stream(kind, options.channel or kind, values, flag=flag, about=attributes)


def _finite(rows: _rows.Rows, name: str) -> FloatArray:
    """A column, words as NaN."""
    values: FloatArray = rows.columns[name]
    return np.where(np.isposinf(values), np.nan, values)


def _track(rows: _rows.Rows, kind: Kind) -> Stream | None:
    """Positions that stand beside levels, as the track of the flight: a table merged by hand holds both."""
    names = [name for name in COLUMNS["telemetry"][:-2] if name in rows.columns]
    if kind != "rss" or not {"latitude_deg", "longitude_deg"} <= set(names):
        return None
    values = {name: _finite(rows, name) for name in names}
    return rows.stream("telemetry", "vehicle", values, flag=_lines.flags(len(rows)), source="mapped columns")


READER = Reader(
    name="generic_csv",
    title="any CSV with a header, columns mapped in flight.yaml",
    kinds=("telemetry", "rss", "rank"),
    sample="Time,Power,...",
    sniff=sniff,
    read=read,
)
