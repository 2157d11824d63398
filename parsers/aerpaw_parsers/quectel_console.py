"""Console of AERPAW's Quectel logger: tables drawn with ``+----+`` and ``|``, each after a line with its time.

Rows ``| 0 | +QENG: "LTE" | ... |`` contain the LTE cell, ``NR5G-NSA`` (RSRP, SINR, RSRQ) and ``NR5G-SA`` (RSRP, RSRQ,
SINR) the NR cell, and ``+QNWCFG: "nr5g_csi"`` the rank (from one; 0 means no CSI). Times are local, and all rows of a
table have the same time.
"""

from __future__ import annotations

import re

import numpy as np

from aerpaw_cmp.logs import text as _text
from aerpaw_cmp.logs.rows import Rows, built, checked_ranks
from aerpaw_cmp.readers import OtherLines, Reader, ReadOptions, ReadResult, RejectedLine, Stream

from . import _cells

_STAMP = re.compile(rb"^(" + _text.TIME + rb")")
_ROW = re.compile(rb'\|\s*\d+\s*\|\s*"?\+?Q(ENG|NWCFG): ?"([A-Za-z0-9_-]+)"?"?\s*\|(.*)\|\s*$')
_HEADER = re.compile(rb"^\|[ \t]*\|[ \t]*(LTE|NR5G-NSA|NR5G-SA|servingcell)[ \t]*\|(.*)\|[ \t\r]*$")
_CSI = ("lte_csi", "nr5g_csi")


def sniff(head: bytes) -> bool:
    """Check whether a file contains tables of AT answers."""
    return b"|----+" in head and re.search(rb'\|\s*\d+\s*\|\s*"?\+Q(ENG|NWCFG):', head) is not None


def _number(cell: bytes) -> float:
    text = cell.strip().strip(b'"')
    value = float(text) if re.fullmatch(rb"[-+]?\d{1,9}(\.\d{1,6})?", text) else np.nan
    # -32768 (-3276, where the firmware divides by ten) and 65535 mean a missing value
    return np.nan if value in (-32768, -3276, 65535) else value


def _tables(lines: _text.Lines) -> tuple[list[tuple[int, bytes, str, dict[str, float]]], list[RejectedLine]]:
    """Return line, time, title and named values of each row with a level or a CSI."""
    time = b""
    names: dict[bytes, list[str]] = {}
    entries: list[tuple[int, bytes, str, dict[str, float]]] = []
    rejected = []
    for i in range(len(lines)):
        line = lines.raw(i)
        if stamp := _STAMP.match(line):
            time = stamp[1]
        if header := _HEADER.match(line):
            names[header[1]] = [cell.decode("ascii", "replace").strip() for cell in header[2].split(b"|")]
        row = _ROW.search(line)
        if row is None:
            continue
        title, cells = row[2], row[3].split(b"|")
        heads = ["mcs", "ri", "cqi", "pmi"] if title.decode("ascii", "replace") in _CSI else names.get(title)
        if heads is None:
            continue  # neighbours and operators are not read
        if not time or len(cells) != len(heads):
            rejected.append(lines.reject(i, "a row without a time, or with other columns than its title (truncated?)"))
            continue
        kind = next((word for word in (b"LTE", b"NR5G") if word in row[3] and title == b"servingcell"), title)
        entries.append((i, time, kind.decode("ascii"), dict(zip(heads, map(_number, cells), strict=True))))
    return entries, rejected


def read(data: bytes, options: ReadOptions) -> ReadResult:
    """Return cells by PCI, and ranks of CSI tables, or raise UsageError if no time zone is given."""
    lines = _text.split(data)
    entries, rejected = _tables(lines)
    row = np.array([item[0] for item in entries], dtype=np.int64)
    time = _text.cells([item[1] for item in entries])
    rows = built(lines, row, {"time": time}, options, reader="quectel_console", others=OtherLines(rejected=rejected))
    timed = [entries[i] for i in rows.at.tolist()]
    readings = [
        _cells.reading(i, value, rat="lte" if title == "LTE" else "nr", serving=True)
        for i, (_, _, title, value) in enumerate(timed) if "RSRP" in value
    ]  # fmt: skip
    ranks = [_rank(rows, name, [(item[2], item[3]) for item in timed]) for name in _CSI]
    return rows.result([*ranks, *_cells.streams(rows, readings, source="Quectel console")])


def _rank(rows: Rows, name: str, values: list[tuple[str, dict[str, float]]]) -> Stream | None:
    where = np.array([title == name for title, _ in values], dtype=bool)
    ri, cqi, mcs = (np.array([value.get(key, np.nan) for _, value in values]) for key in ("ri", "cqi", "mcs"))
    flag = rows.flag.copy()
    content = {"rank": checked_ranks(ri, flag, none=ri == 0), "ri_raw": ri, "cqi": cqi, "mcs": mcs}
    return rows.stream("rank", name, content, where=where, flag=flag, channel=name, ri_base="one", source="CSI report")


READER = Reader(
    name="quectel_console", title="console of AERPAW's Quectel logger (drawn tables)", kinds=("rss", "rank"),
    sample='|  0 | +QNWCFG: "nr5g_csi" |        24 |       2 |       12 |        5 |', sniff=sniff, read=read,
)  # fmt: skip
