"""Rank of a Keysight Nemo phone as KML: one placemark description per report.

Only the description lines are read, by pattern and not as XML: a report stands on one line, and a parser that
resolves entities has no business with a file from elsewhere. All other lines are markup and count as comments.
"""

from __future__ import annotations

import re

import numpy as np

from aerpaw_cmp.common.units import IntArray
from aerpaw_cmp.logs.readers import Reader, ReadOptions
from aerpaw_cmp.logs.records import ReadResult, RejectedLine

from . import _lines, _nemo

_N = rb"(" + _lines.NUMBER + rb"|nan)"
_GAP = rb"[^\n]{0,60}?"
_RECORD = re.compile(
    rb"rel_time = " + _N + rb" ms" + _GAP + rb"PDSCH rank \(NR\) = " + _N + _GAP
    # the position is needed: the phone stands on the aircraft
    + rb"\(lat, lon\) = \(" + _N + rb", ?" + _N + rb"\)" + _GAP + rb"altitude = " + _N + rb" m"
)  # fmt: skip
_HINT = re.compile(rb"rel_time|PDSCH rank")


def sniff(head: bytes) -> bool:
    """Whether it is a KML with PDSCH rank, or one whose styles fill all that sniffers see.

    Nemo writes every style in front of the first placemark: of a long flight the head holds styles only.
    """
    if b"<kml" not in head[:2048]:
        return False
    return b"PDSCH rank (NR)" in head or (len(head) >= 60_000 and b"<Placemark" not in head and b"<Style" in head)


def _reason(line: bytes) -> str | None:
    if _HINT.search(line):
        return "a Nemo description that lacks time, rank, position or altitude (torn line?)"
    return None  # markup


def read(data: bytes, options: ReadOptions) -> ReadResult:
    """Rank stream with the phone's own position.

    Raises
    ------
    UsageError
        If ``time_origin`` is no time, or is local and no time zone is given.
    """
    lines = _lines.split(data)
    positions: list[int] = []
    groups: list[tuple[bytes, ...]] = []
    for found in _RECORD.finditer(data):
        positions.append(found.start())
        groups.append(found.groups())
    rows = np.searchsorted(lines.starts, np.array(positions, dtype=np.int64), side="right") - 1
    _, first = np.unique(rows, return_index=True)
    column = [_lines.numbers(cells)[first] for cells in _lines.columns(groups, 5)]
    rows = rows[first]
    fits = np.abs(column[0]) <= _nemo.MOST_MS
    blank, rejected = _account(lines, rows)
    rejected += lines.reject_all(rows[~fits], "the relative time is beyond any flight")
    names = ("ri_raw", "latitude_deg", "longitude_deg", "altitude_m")
    values = {name: column[1 + i][fits] for i, name in enumerate(names)}
    stream, warnings = _nemo.stream(lines, rows[fits], column[0][fits], values, options, "nemo_kml")
    doubled = len(positions) - len(rows)
    if doubled:
        warnings.append(f"{doubled} further reports on lines that hold several were not read")
    count = int(fits.sum())
    return ReadResult(
        "nemo_kml",
        (stream,) if count else (),
        len(lines),
        count,
        blank,
        tuple(sorted(rejected, key=lambda line: line.number)),
        tuple(warnings) if count else (),
    )


def _account(lines: _lines.Lines, rows: IntArray) -> tuple[int, list[RejectedLine]]:
    """Markup is nearly all of the file: only lines with a hint of a report are looked at one by one."""
    hints = np.array([found.start() for found in _HINT.finditer(lines.data)], dtype=np.int64)
    suspects = np.unique(np.searchsorted(lines.starts, hints, side="right") - 1)
    markup = np.ones(len(lines), dtype=bool)
    markup[suspects] = False
    markup[rows] = False
    return _lines.remainder(lines, rows, _reason, blank=np.flatnonzero(markup))


READER = Reader(
    name="nemo_kml",
    title="Keysight Nemo NR rank, KML (also gzipped)",
    kinds=("rank",),
    sample="<description>... rel_time = -1500.0 ms ... PDSCH rank (NR) = 2.0 ... (lat, lon) = (35.728,-78.696) ...",
    sniff=sniff,
    read=read,
)
