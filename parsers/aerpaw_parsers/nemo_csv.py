"""Rank of a Keysight Nemo phone as CSV: ``index,rel_time_ms,lat,lon,alt_m,pdsch_rank,nr_rsrp_dbm,nr_sinr_db,wb_cqi``.

Times are milliseconds relative to an origin that the file does not hold. The rank is that of the scheduled PDSCH,
one-based; rows of other measurements leave it empty.
"""

from __future__ import annotations

import re

import numpy as np

from aerpaw_cmp.common.units import BoolArray, FloatArray, IntArray
from aerpaw_cmp.logs import blocks
from aerpaw_cmp.logs.readers import Reader, ReadOptions
from aerpaw_cmp.logs.records import ReadResult, Stream

from . import _by_eights, _lines, _nemo, _quantities, _rows, _table

_N = rb"(" + _lines.NUMBER + rb")"
_CELL = rb"(" + _lines.NUMBER + rb"|nan|NaN|)"
_ROW = re.compile(rb"^" + _N + rb", ?" + _N + (rb", ?" + _CELL) * 7 + rb"[ \t]*\r?$", re.MULTILINE)
_MOST = 1e12
"""No table has so many rows."""
_BESIDE = (("rsrp_dbm", "nr_rsrp"), ("sinr_db", "nr_sinr"), ("cqi", "wb_cqi"))
_COLUMNS = ("latitude_deg", "longitude_deg", "altitude_m", "ri_raw", "rsrp_dbm", "sinr_db", "cqi")


def _reason(line: bytes) -> str | None:
    if _nemo.HEADER.fullmatch(line):
        return None
    fields = line.count(b",") + 1
    if fields != 9:
        return f"{fields} fields where 9 were expected (torn line?)"
    return "a field is no number"


def _plain(lines: _lines.Lines, found: _table.Fields) -> tuple[IntArray, list[FloatArray]]:
    """Rows of plain numbers and their nine columns, at once."""
    found = found.take(found.rows > 0)  # the header
    rows = found.rows
    if not len(rows):
        return rows, [np.empty(0)] * 9
    made = _by_eights.decimals(lines, found, range(9))
    value, odd = made.value, np.any(made.odd, axis=0)
    some = int(np.count_nonzero(odd))
    if 16 * some > len(rows):
        return _at_once(lines, rows)
    valid = _valid(value) & ~odd
    return (rows, value) if valid.all() else (rows[valid], [column[valid] for column in value])


def _valid(value: list[FloatArray]) -> BoolArray:
    """Rows whose index is a whole number, however written, and that have a time: alike on every way of reading."""
    index = value[0]
    return np.asarray((index >= 0) & (index < _MOST) & (index == np.floor(index)) & np.isfinite(value[1]))


def _at_once(lines: _lines.Lines, rows: IntArray) -> tuple[IntArray, list[FloatArray]]:
    """Rows of numbers of any form and their nine columns, none where one is no number."""
    value = _table.numbers(lines, rows, 9)
    if value is None:
        return rows[:0], [np.empty(0)] * 9
    valid = _valid(value)
    return rows[valid], [column[valid] for column in value]


def _columns(lines: _lines.Lines, found: _table.Fields) -> tuple[IntArray, list[FloatArray]]:
    """Rows and their nine columns: the plain ones at once, the rest by the pattern."""
    rows, value = _plain(lines, found)
    odd, groups = _lines.match_rest(lines, _ROW, rows)
    if not len(odd):
        return rows, value
    texts = [_lines.numbers(cells) for cells in _lines.columns(groups, 9)]
    valid = _valid(texts)
    odd, texts = odd[valid], [column[valid] for column in texts]
    order = np.argsort(np.concatenate((rows, odd)), kind="stable")
    joined = [np.concatenate(pair)[order] for pair in zip(value, texts, strict=True)]
    return np.concatenate((rows, odd))[order], joined


def read(data: bytes, options: ReadOptions) -> ReadResult:
    """Rank stream with RSRP, SINR, CQI and the phone's own position.

    Raises
    ------
    UsageError
        If ``time_origin`` is no time, or is local and no time zone is given.
    """
    lines, found = _by_eights.table(data, 9)
    number, column = _columns(lines, found)
    content = {"time": column[1], **dict(zip(_COLUMNS, column[2:], strict=True))}
    rows = _rows.built(lines, number, content, options, reader="nemo_csv", reason=_reason, clock="relative_ms")
    beside = [_beside(rows, *one) for one in _BESIDE]
    return rows.result([_nemo.pdsch_rank(rows, dict(rows.columns)), *beside])


def _beside(rows: _rows.Rows, column: str, name: str) -> Stream | None:
    """Level or ratio of the rows that have one: most stand in rows without a rank."""
    values = rows.number(column)
    return _quantities.stream(rows, name, values, where=np.isfinite(values), about={"rat": "nr"})


READER = Reader(
    name="nemo_csv",
    title="Keysight Nemo NR rank, CSV with relative times",
    kinds=("rank", "rss", "kpi"),
    sample="12,-1500.0,35.7280001,-78.6960002,30.5,2.0,-81.5,28.0,12.0",
    sniff=_nemo.sniff,
    read=read,
    in_blocks=blocks.by_lines(read, head=blocks.first_line),
)
