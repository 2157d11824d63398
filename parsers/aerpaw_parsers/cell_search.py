"""AERPAW's cell search: ``Found CELL MHz, 3500.0, EARFCN, 7399, PHYID, 1, ... PSS power dBm, -30.1, PSR, 2.3, <time>``.

The console and the table of srsRAN's program, as modified by AERPAW, contain a line per cell and sweep. The time of a
line is at its end (with milliseconds after a colon, or in the form of ``asctime``) or at its beginning, from ``ts``.

The level is the power of the synchronisation signal, not an RSRP. There is a series per PCI and EARFCN.
"""

from __future__ import annotations

import re

from aerpaw_cmp.readers import OtherLines, Reader, ReadOptions, ReadResult, built, match, split

from . import _cells, _stamps

_N = rb"(-?\d{1,9}(?:\.\d{1,9})?)"
_ROW = re.compile(
    rb"^(?:\[?([^\]\n]{8,40}?)\]? )?Found CELL (?:MHz, ?" + _N + rb"|" + _N + rb" MHz),\s{1,3}EARFCN[,=] ?" + _N
    + rb", ?PHYID[,=] ?" + _N + rb",[^\n]{0,60}?PSS power(?: dBm, ?|= ?)" + _N + rb"(?: dBm)?"
    + rb"(?:,\s{1,3}PSR[,=] ?" + _N + rb")?(?:,? ?([A-Z\d][^\n\r,]{14,40}?))?[ \t]*\r?$",
    re.MULTILINE,
)  # fmt: skip


def sniff(head: bytes) -> bool:
    """Check whether a file contains a cell with a time."""
    # search a fixed text first, because an expression that is anchored to line starts is slow
    first = _ROW.search(head) if b"Found CELL " in head else None
    return first is not None and bool(first[1] or first[8])


def read(data: bytes, options: ReadOptions) -> ReadResult:
    """Return a level series per cell, or raise UsageError if no time zone is given."""
    lines = split(data)
    row, groups = match(lines, _ROW)
    texts = [(group[7] or group[0]).decode("ascii", "replace") for group in groups]
    clock, time, warnings = _stamps.read(texts, options)
    rows = built(
        lines, row, {"time": time}, options, reader="cell_search", clock=clock,
        others=OtherLines(lambda line: "an incomplete cell (truncated line?)" if b"Found CELL" in line else None),
    )  # fmt: skip
    rows.warnings += warnings
    readings = [
        _cells.Reading(i, "lte", pci=float(cell[4]), arfcn=float(cell[3]), rsrp_dbm=float(cell[5]))
        for i, cell in enumerate(groups[at] for at in rows.at.tolist())
    ]
    return rows.result(_cells.streams(rows, readings, source="cell search", quantity="PSS power"))


READER = Reader(
    name="cell_search", kinds=("rss",), sniff=sniff, read=read,
    title="AERPAW cell search (srsRAN), console or table: power of the synchronisation signal per cell",
    sample="Found CELL MHz, 3500.0,  EARFCN, 7399, PHYID, 1, PRB, 50,  ports, 1, PSS power dBm, -30.1,  PSR, 2.3, "
    "2025-01-01 12:00:07:250",
)  # fmt: skip
