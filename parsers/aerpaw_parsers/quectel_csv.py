"""CSVs of AERPAW's Quectel logger (``csv_kpi``): rank indicator and serving-cell level, from both generations.

A console of the modem (EC25, RM500Q to RM520N) with time stamps contains the same answers, with each radio access on a
separate line. The time stamp is in front of the answer or on a line above it, in the form of ``date``, of Python's
logging, or of an epoch.

There is no header, and the first line may be ``OK``. Fields are raw pieces of AT answers with their
``+QNWCFG: "nr5g_csi"`` prefix. Rows are distinguished by their RAT token and not by the file name, because the logger
writes NR5G-SA answers to ``..._LTE_only.csv``.

========================= ======= ============================================================
row                       columns streams
========================= ======= ============================================================
``+QNWCFG lte_csi`` and   11, 19  rank ``lte_csi`` and ``nr5g_csi`` (MCS, RI, CQI, PMI each)
``nr5g_csi``
LTE + NR5G-NSA            32, 28  rss ``lte_rsrp`` and ``nr_rsrp`` (order RSRP, SINR, RSRQ), or a stream per cell,
                                  ``lte_pci7``
LTE                       20      rss ``lte_rsrp``
NR5G-SA                   18      rss ``nr_rsrp`` (order RSRP, RSRQ, SINR)
========================= ======= ============================================================

RI counts data layers, from 1; 0 means no CSI. Times are naive local time, taken after the answer, unless they have an
offset.
Writer: AERPAW ``QuectelLogger`` (``no_pandas_at_rm500q.py``, ``at_rm500q2.py``).
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from datetime import datetime, timezone

import numpy as np

from aerpaw_cmp.common.units import AnyArray, BoolArray, IntArray
from aerpaw_cmp.logs import text as _text
from aerpaw_cmp.logs.rows import Rows, built, checked_ranks
from aerpaw_cmp.readers import TIME, ZONE, Attribute, OtherLines, Reader, ReadOptions, ReadResult, Stream

_C = rb"[^,\n]{0,80}"
# Beginning of a line: the logger's CSV, or a console with time stamps (ts, a terminal program).
_T = rb"^\[?(?P<time>" + TIME + ZONE + rb")(?:,|\]?[ \t]{1,4})"


def _answer(command: bytes, word: bytes, rat: bytes, names: str) -> bytes:
    """Return the pattern of an answer with its command, word and fields. A dot is a field that is not read."""
    return rb'"{0,3}(?:\+' + command + rb': ?)?"{0,3}' + word + rb'"{1,3}' + _fields(rat, names)


def _fields(rat: bytes, names: str) -> bytes:
    """Return the pattern of fields, each with the comma in front of it and in a group such as ``lte_rsrp``."""
    value = rb',"{0,3}(?P<%s_%s>-?\d{1,7}(?:\.\d{1,6})?|-|)"{0,3}'
    return b"".join(b"," + _C if name == "." else value % (rat, name.encode()) for name in names.split())


_CSI = {rat: _answer(b"QNWCFG", rat + b"_csi", rat, "mcs ri cqi pmi") for rat in (b"lte", b"nr5g")}
_SERVING = rb"(?:" + _answer(b"QENG", b"servingcell", b"", ".") + rb",)?"
_LTE = _SERVING + _answer(b"QENG", b"LTE", b"lte", ". . . . pci arfcn . . . . rsrp rsrq rssi sinr")
_SA = _SERVING + _answer(b"QENG", b"NR5G-SA", b"nr", ". . . . pci . arfcn . . rsrp rsrq sinr")
_NSA = _answer(b"QENG", b"NR5G-NSA", b"nr", ". . pci rsrp sinr rsrq")
_ARFCN = _fields(b"nr", "arfcn")
# A fifth value, which newer firmware writes, and the four columns of +QNWINFO, which the first generation writes around
# the CSI.
_FIFTH, _INFO = rb"(?:,-?\d{1,7})?", (_C + rb",") * 4
# Kinds of row: first rows of the logger, then rows of a console, which has each radio access on a separate line.
_FORMS = tuple(
    re.compile(_T + form + rb"[ \t]*\r?$", re.MULTILINE) for form in (
        rb"(?:" + _INFO + rb")?" + _CSI[b"lte"] + b"," + _CSI[b"nr5g"] + _FIFTH + rb"(?:(?:," + _C + rb"){4})?",
        # the fields after the SINR differ between firmware versions
        _LTE + rb"(?:," + _C + rb"){1,3}(?:," + _NSA + rb"(?:" + _ARFCN + rb"(?:," + _C + rb"){3})?)?",
        _SA + rb"(?:," + _C + rb"){0,3}",
        _NSA + rb"(?:" + _ARFCN + rb"(?:," + _C + rb"){1,4})?",
        _CSI[b"lte"] + _FIFTH, _CSI[b"nr5g"] + _FIFTH,
    )
)  # fmt: skip
_ANY = re.compile(_T + rb'"?\+(?:QNWCFG|QENG|QENDC)')
_TALK = re.compile(_T + rb'(?!"?\+(?:QNWCFG|QENG|QENDC))|^\[?' + TIME + rb"\]?[ \t]*\r?$")
# 3GPP TS 38.133 table 10.1.6.1-1: reported SS-RSRP lies between -156 and -31 dBm.
_RSRP_RANGE = (-156.0, -31.0)
# 3GPP TS 38.133 table 10.1.16.1-1: reported SS-SINR lies between -23 and 40 dB.
_SINR_RANGE = (-23.0, 40.0)


# Time at the beginning of a line: with Python's comma in front of the milliseconds, or as an epoch.
_STAMP = re.compile(rb"\[?(?:(" + TIME + rb")(?:,(\d{3}))?(" + ZONE + rb")|(1\d{9}(?:\.\d{1,6})?))\]?(?![^ \t\r])")
_CONSOLE = re.compile(rb'(?:"?\+[A-Z]{2,8}: ?|AT\+)[^\r\n]*')


def _stamped(data: bytes) -> bytes:
    """Return a console with ``[time] `` before each answer: the time of its line, or of the last line that has one."""
    stamp, lines = b"", data.split(b"\n")
    for i, line in enumerate(lines):
        found = _STAMP.match(line)
        if found:
            wall, milliseconds, zone, epoch = found.groups(b"")
            stamp = wall + (b"." + milliseconds if milliseconds else b"") + zone
            if epoch:
                stamp = datetime.fromtimestamp(float(epoch), timezone.utc).isoformat().encode()
        # remove words that a program printed between the time and the answer
        answer = _CONSOLE.search(line, found.end()) if found else _CONSOLE.match(line)
        if stamp and (answer or found):
            lines[i] = b"[" + stamp + b"] " + (answer[0] if answer else b"")
    return b"\n".join(lines)


def sniff(head: bytes) -> bool:
    """Check whether most of the first lines, except commands and OK, are AT answers with a time."""
    return _is_known(head) or (b"+Q" in head and _is_known(_stamped(head)))


def _is_known(head: bytes) -> bool:
    lines = [line for line in _text.first_lines(head) if line != b"OK" and not _TALK.match(line)]
    return bool(lines) and 2 * sum(_ANY.match(line) is not None for line in lines) > len(lines)


def _reason(line: bytes) -> str | None:
    if line.strip() == b"OK":
        return None  # the start script wrote this line, not the modem
    if line.startswith(b"[") and _TALK.match(line):
        return None  # commands and other answers of a console
    if not re.match(rb"\[?" + TIME, line):
        return "no time stamp at the beginning (truncated or stray modem line)"
    if b"neighbourcell" in line:
        return "neighbour-cell row: not read"
    if re.search(rb'"servingcell"+,"+(?:NOCONN|CONNECT|LIMSRV)"+\s*$', line):
        return None  # the cells are on the lines below
    if b"SEARCH" in line:
        return "the modem was searching: no serving cell"
    if b"csi" in line:
        return "incomplete CSI answer (truncated row, or a stray modem line inside it)"
    return "not a row of the logger's CSVs, or one with another number of columns"


def _table(lines: _text.Lines) -> tuple[IntArray, dict[str, AnyArray]]:
    """Return the lines of all kinds of row, and their columns of text, with an index into ``_FORMS`` as ``form``."""
    # skip the search for other kinds of row in a log of CSI, because it is slow
    serving = b"servingcell" in lines.data or lines.data.startswith(b"[")
    tables: list[tuple[IntArray, dict[str, AnyArray]]] = []
    for i, pattern in enumerate(_FORMS if serving else _FORMS[:1]):
        row, groups = _text.match(lines, pattern)
        column = dict(zip(pattern.groupindex, _text.columns(groups, pattern.groups), strict=True))
        tables.append((row, {**column, "form": np.full(len(row), float(i))}))
    row = np.concatenate([row for row, _ in tables])
    order = np.argsort(row, kind="stable")
    every = dict.fromkeys(name for form in _FORMS for name in ("form", *form.groupindex))
    table = {
        name: np.concatenate([column.get(name, np.zeros(len(row), dtype="S1")) for row, column in tables])[order]
        for name in every
    }
    return row[order], table


# Forms of a console, with each radio access on a separate line.
_NSA_FORM, _ALONE = 3, {"lte": 4, "nr5g": 5}


def _rank(rows: Rows, rat: str) -> Stream | None:
    """Return the rank stream of one radio access."""
    mcs, ri, cqi, pmi = (rows.number(f"{rat}_{name}") for name in ("mcs", "ri", "cqi", "pmi"))
    flag = rows.flag.copy()
    idle = (mcs == 0) & (ri == 0) & (cqi == 0) & (pmi == 0)
    values = {
        "rank": checked_ranks(ri, flag, none=ri == 0),
        "ri_raw": ri,
        "mcs": np.where(idle | ~((mcs >= 0) & (mcs <= 31)), np.nan, mcs),
        "cqi": np.where(idle | ~((cqi >= 0) & (cqi <= 15)), np.nan, cqi),
    }
    name, where = f"{rat}_csi", np.isin(rows.columns["form"], (0, _ALONE[rat]))
    return rows.stream("rank", name, values, where=where, flag=flag, channel=name, ri_base="one", source="CSI report")


def _levels(rows: Rows, rat: str, where: BoolArray) -> Iterator[Stream | None]:
    """Yield the RSRP of one radio access, in one stream or a stream per cell if the log has several cells."""
    rsrp, pci, arfcn = (rows.number(f"{rat}_{name}") for name in ("rsrp", "pci", "arfcn"))
    flag = rows.flag.copy()
    good = (rsrp >= _RSRP_RANGE[0]) & (rsrp <= _RSRP_RANGE[1])
    _text.add_flag(flag, ~good, "out_of_coverage")
    values = {"rss_db": np.where(good, rsrp, np.nan)}
    if rat == "nr":
        sinr = rows.number("nr_sinr")
        fits = (sinr >= _SINR_RANGE[0]) & (sinr <= _SINR_RANGE[1])
        # firmware of 2020 writes tenths of a decibel, which are flagged and not divided
        _text.add_flag(flag, good & ~fits & ~np.isnan(sinr), "sinr_out_of_range")
        values["sinr_db"] = np.where(fits, sinr, np.nan)
    named = where & (pci >= 0) & (pci <= _MOST_PCI)
    # represent a missing carrier by infinity, which sorts after every carrier
    carrier = np.where(arfcn > 0, arfcn, np.inf)
    cells = sorted(set(zip(pci[named].tolist(), carrier[named].tolist(), strict=True)))
    common: dict[str, Attribute | None] = {"unit": rows.options.unit or "dBm", "quantity": "RSRP", "rat": rat}
    for its_pci, its_carrier in cells if len(cells) > 1 else ():
        twice = sum(pci_of_cell == its_pci for pci_of_cell, _ in cells) > 1 and its_carrier < np.inf
        name = f"{rat}_pci{int(its_pci)}" + (f"_arfcn{int(its_carrier)}" if twice else "")
        mine = named & (pci == its_pci) & (carrier == its_carrier)
        about = common | _identity(its_pci, its_carrier)
        yield rows.stream("rss", name, values, where=mine, flag=flag, channel=name, about=about)
    unnamed = where & ~named if len(cells) > 1 else where
    common |= _identity(*cells[0]) if len(cells) == 1 else {}
    yield rows.stream("rss", f"{rat}_rsrp", values, where=unnamed, flag=flag, channel=f"{rat}_rsrp", about=common)


def _identity(pci: float, arfcn: float) -> dict[str, Attribute | None]:
    return {"pci": int(pci), "arfcn": int(arfcn) if arfcn < np.inf else None}


_MOST_PCI = 1007


def read(data: bytes, options: ReadOptions) -> ReadResult:
    """Return the rank and level streams of the rows in the file.

    Raises
    ------
    UsageError
        If no time zone is given.
    """
    lines = _text.split(data if _is_known(data) else _stamped(data))
    row, table = _table(lines)
    rows = built(lines, row, table, options, reader="quectel_csv", others=OtherLines(_reason))
    form = rows.columns["form"]
    nr = np.isin(form, (2, _NSA_FORM)) | ((form == 1) & (rows.columns["nr_rsrp"] != b""))
    levels = (*_levels(rows, "lte", form == 1), *_levels(rows, "nr", nr))
    return rows.result([_rank(rows, "nr5g"), _rank(rows, "lte"), *levels])


READER = Reader(
    name="quectel_csv", title="AERPAW Quectel logger CSVs, AT consoles with stamps: rank indicator, serving cell",
    kinds=("rank", "rss"),
    sample='2025-01-01 12:00:07.250,"+QNWCFG: ""lte_csi""",20,1,9,3,"+QNWCFG: ""nr5g_csi""",24,2,12,5', sniff=sniff,
    read=read,
)  # fmt: skip
