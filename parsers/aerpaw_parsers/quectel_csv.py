"""CSVs of AERPAW's Quectel logger (``csv_kpi``): rank indicator and serving-cell level, both generations.

There is no header; a first line may be a bare ``OK``; fields are raw pieces of AT answers with their
``+QNWCFG: "nr5g_csi"`` prefix. Rows are told apart by the RAT token they carry, never by the file name: an NR5G-SA
answer is filed under ``..._LTE_only.csv`` by the logger.

========================= ======= ============================================================
row                       columns gives
========================= ======= ============================================================
``+QNWCFG lte_csi`` and   11, 19  rank ``lte_csi`` and ``nr5g_csi`` (MCS, RI, CQI, PMI each)
``nr5g_csi``
LTE + NR5G-NSA            32, 28  rss ``lte_rsrp`` and ``nr_rsrp`` (order RSRP, SINR, RSRQ); of several cells, a
                                  stream each, ``lte_pci7``
LTE                       20      rss ``lte_rsrp``
NR5G-SA                   18      rss ``nr_rsrp`` (order RSRP, RSRQ, SINR)
========================= ======= ============================================================

RI counts data layers, from 1; 0 means no CSI. Times are naive local time, taken after the answer; an offset wins.
Writer: AERPAW ``QuectelLogger`` (``no_pandas_at_rm500q.py``, ``at_rm500q2.py``).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from aerpaw_cmp.common.units import AnyArray, FloatArray, IntArray
from aerpaw_cmp.logs import clocks as _time
from aerpaw_cmp.logs import lines as _lines
from aerpaw_cmp.logs import make_frames as _frames
from aerpaw_cmp.logs.readers import Reader, ReadOptions
from aerpaw_cmp.logs.records import Attribute, ReadResult, RejectedLine, Stream

if TYPE_CHECKING:
    import pandas as pd

_C = rb"[^,\n]{0,80}"
_V = rb'"{0,3}(-?\d{1,7}(?:\.\d{1,6})?|-|)"{0,3}'
_T = rb"^(" + _time.TIME + _time.ZONE + rb"),"


def _token(command: bytes, word: bytes) -> bytes:
    return rb'"{0,3}(?:\+' + command + rb': ?)?"{0,3}' + word + rb'"{1,3}'


def _skip(count: int) -> bytes:
    return (_C + rb",") * count


_CSI = re.compile(
    _T
    + rb"(?:"
    + _skip(4)
    + rb")?"
    + _token(b"QNWCFG", b"lte_csi")
    + (rb"," + _V) * 4
    + rb","
    + _token(b"QNWCFG", b"nr5g_csi")
    + (rb"," + _V) * 4
    # a fifth value of newer firmware, then the four +QNWINFO columns of the first generation
    + rb"(?:,-?\d{1,7})?(?:(?:,"
    + _C
    + rb"){4})?[ \t]*\r?$",
    re.MULTILINE,
)
_SERVING = _T + _token(b"QENG", b"servingcell") + rb"," + _C + rb","
_CELL = _V + rb"," + _V + rb","  # PCI and carrier
_LTE_BODY = (
    _token(b"QENG", b"LTE") + rb"," + _skip(4) + _CELL + _skip(4) + rb",".join([_V] * 4) + rb"," + rb",".join([_C] * 3)
)
_LTE = re.compile(
    _SERVING
    + _LTE_BODY
    + rb"(?:,"
    + _token(b"QENG", b"NR5G-NSA")
    + rb","
    + _skip(2)
    + rb",".join([_V] * 4)
    + rb"(?:,"
    + _V
    + rb"(?:,"
    + _C
    + rb"){3})?)?[ \t]*\r?$",
    re.MULTILINE,
)
_SA = re.compile(
    _SERVING
    + _token(b"QENG", b"NR5G-SA")
    + rb","
    + _skip(4)
    + _V
    + rb","
    + _skip(1)
    + _V
    + rb","
    + _skip(2)
    + rb",".join([_V] * 3)
    + rb","
    + _C
    + rb","
    + _C
    + rb"[ \t]*\r?$",
    re.MULTILINE,
)
_ANY = re.compile(rb"^" + _time.TIME + _time.ZONE + rb',"?\+(?:QNWCFG|QENG|QENDC)')
_RSRP_RANGE = (-156.0, -31.0)
"""3GPP TS 38.133 table 10.1.6.1-1: reported SS-RSRP lies between -156 and -31 dBm."""
_SINR_RANGE = (-23.0, 40.0)
"""3GPP TS 38.133 table 10.1.16.1-1: reported SS-SINR lies between -23 and 40 dB."""


def sniff(head: bytes) -> bool:
    """Whether most of the first lines, a bare OK aside, are AT answers behind a time."""
    lines = [line for line in _lines.first_lines(head) if line != b"OK"]
    return bool(lines) and 2 * sum(_ANY.match(line) is not None for line in lines) > len(lines)


def _reason(line: bytes) -> str | None:
    if line.strip() == b"OK":
        return None  # written by the start script, no answer of the modem
    if b"\0" in line:
        return "NUL bytes in the line (the file system was not synced when power went)"
    if not re.match(_time.TIME, line):
        return "no time stamp in front (torn or stray modem line)"
    if b"neighbourcell" in line:
        return "neighbour-cell row: not read"
    if b"SEARCH" in line:
        return "the modem was searching: no serving cell"
    if b"csi" in line:
        return "incomplete CSI answer (torn row, or a stray modem line inside it)"
    return "not a row of the logger's CSVs, or one with another number of columns"


@dataclass
class _Rows:
    """Matching rows with valid times, sorted columns of text, and their times."""

    number: IntArray
    instants: _time.Instants
    column: list[AnyArray]


def _rows(
    lines: _lines.Lines, pattern: re.Pattern[bytes], options: ReadOptions, rejected: list[RejectedLine]
) -> _Rows | None:
    number, groups = _lines.match(lines, pattern)
    if not len(number):
        return None
    column = _lines.columns(groups, pattern.groups)
    _, valid, _, _ = _time.parse_texts(column[0])
    rejected += lines.reject_all(number[~valid], "the time stamp is no date of the calendar")
    kept = [cells[valid] for cells in column]
    instants, _ = _time.texts_to_utc(kept[0], options, needed_by="quectel_csv")
    return _Rows(number[valid], instants, kept)


def _values(cells: AnyArray) -> FloatArray:
    """Numbers of one column; ``-`` and nothing mean 'not valid now'."""
    return np.asarray(_lines.numbers(np.where(cells == b"-", b"", cells)))


def _flag_column(rows: _Rows, lines: _lines.Lines) -> AnyArray:
    flag = _lines.flags(len(rows.number))
    rows.instants.flag(flag)
    if lines.unterminated:
        _lines.add_flag(flag, rows.number == len(lines) - 1, _lines.UNTERMINATED)
    return flag


def _rank(rows: _Rows, first: int, name: str, lines: _lines.Lines, options: ReadOptions) -> Stream:
    """Rank stream of one RAT; ``first`` is the column of its MCS."""
    mcs, ri, cqi, pmi = (_values(rows.column[first + i]) for i in range(4))
    flag = _flag_column(rows, lines)
    good = (ri >= 1) & (ri <= 8) & (ri == np.round(ri))
    _lines.add_flag(flag, (ri == 0) | np.isnan(ri), "no_csi")
    _lines.add_flag(flag, ~good & ~(ri == 0) & ~np.isnan(ri), "ri_out_of_range")
    idle = (mcs == 0) & (ri == 0) & (cqi == 0) & (pmi == 0)
    values = {
        "rank": np.where(good, ri, np.nan),
        "ri_raw": ri,
        "mcs": np.where(idle | ~((mcs >= 0) & (mcs <= 31)), np.nan, mcs),
        "cqi": np.where(idle | ~((cqi >= 0) & (cqi <= 15)), np.nan, cqi),
    }
    frame = _frames.frame("rank", rows.instants.time, rows.number + 1, flag, values)
    return Stream("rank", name, frame, _frames.attributes(options, channel=name, ri_base="one", source="CSI report"))


@dataclass
class _Part:
    """Levels of one kind of row: rows, and their texts of PCI, carrier, RSRP and SINR (None: not printed)."""

    rows: _Rows
    pci: AnyArray
    arfcn: AnyArray
    rsrp: AnyArray
    sinr: AnyArray | None


def _levels(rat: str, parts: list[_Part], lines: _lines.Lines, options: ReadOptions) -> list[Stream]:
    """RSRP of one RAT, a stream per cell where the log has several; a log of one cell gives one stream."""
    import pandas as pd

    frames = [_level(part, lines) for part in parts]
    if not any(len(frame) for frame in frames):
        return []
    frame = frames[0] if len(frames) == 1 else pd.concat(frames).sort_values("line").reset_index(drop=True)
    pci, arfcn = frame.pop("pci"), frame.pop("arfcn")
    cells = (
        pd.DataFrame({"pci": pci, "arfcn": arfcn}).dropna(subset="pci").drop_duplicates().sort_values(["pci", "arfcn"])
    )
    common: dict[str, Attribute] = {"unit": options.unit or "dBm", "quantity": "RSRP", "rat": rat}
    whole = f"{rat}_rsrp"
    found: list[Stream] = []
    for one in cells.itertuples() if len(cells) > 1 else ():
        mine = (pci == one.pci) & ((arfcn == one.arfcn) | (np.isnan(one.arfcn) & arfcn.isna()))
        twice = (cells["pci"] == one.pci).sum() > 1 and not np.isnan(one.arfcn)
        name = f"{rat}_pci{int(one.pci)}" + (f"_arfcn{int(one.arfcn)}" if twice else "")
        about = common | _identity(one.pci, one.arfcn)
        attributes = _frames.attributes(options, channel=name, **about)
        found.append(Stream("rss", name, frame[mine].reset_index(drop=True), attributes))
    if len(cells) == 1:
        common |= _identity(*cells.iloc[0])
    rest = frame[pci.isna()] if len(cells) > 1 else frame
    if len(rest):
        attributes = _frames.attributes(options, channel=whole, **common)
        found.append(Stream("rss", whole, rest.reset_index(drop=True), attributes))
    return found


def _identity(pci: float, arfcn: float) -> dict[str, Attribute]:
    return {"pci": int(pci), **({} if np.isnan(arfcn) else {"arfcn": int(arfcn)})}


def _level(part: _Part, lines: _lines.Lines) -> pd.DataFrame:
    """Records of some rows, with their cells beside."""
    rsrp = _values(part.rsrp)
    flag = _flag_column(part.rows, lines)
    good = (rsrp >= _RSRP_RANGE[0]) & (rsrp <= _RSRP_RANGE[1])
    _lines.add_flag(flag, ~good, "out_of_coverage")
    values = {"rss_db": np.where(good, rsrp, np.nan)}
    if part.sinr is not None:
        sinr = _values(part.sinr)
        fits = (sinr >= _SINR_RANGE[0]) & (sinr <= _SINR_RANGE[1])
        # tenths of a decibel on 2020 firmware look like this: never divided silently
        _lines.add_flag(flag, good & ~fits & ~np.isnan(sinr), "sinr_out_of_range")
        values["sinr_db"] = np.where(fits, sinr, np.nan)
    pci, arfcn = _values(part.pci), _values(part.arfcn)
    known = (pci >= 0) & (pci <= _MOST_PCI)
    values |= {"pci": np.where(known, pci, np.nan), "arfcn": np.where(known & (arfcn > 0), arfcn, np.nan)}
    return _frames.frame("rss", part.rows.instants.time, part.rows.number + 1, flag, values)


_MOST_PCI = 1007


def read(data: bytes, options: ReadOptions) -> ReadResult:
    """Rank and level streams, whichever rows the file has.

    Raises
    ------
    UsageError
        If no time zone is given.
    """
    lines = _lines.split(data)
    rejected: list[RejectedLine] = []
    csi = _rows(lines, _CSI, options, rejected)
    serving = b"servingcell" in data  # a search of a whole log of CSI would find nothing, slowly
    lte = _rows(lines, _LTE, options, rejected) if serving else None
    sa = _rows(lines, _SA, options, rejected) if serving else None
    streams: list[Stream | None] = []
    if csi is not None and len(csi.number):
        streams += [_rank(csi, 5, "nr5g_csi", lines, options), _rank(csi, 1, "lte_csi", lines, options)]
    nr_parts: list[_Part] = []
    if lte is not None:
        streams += _levels("lte", [_Part(lte, lte.column[1], lte.column[2], lte.column[3], None)], lines, options)
        with_nr = np.flatnonzero(lte.column[8] != b"")
        instants = lte.instants.take(with_nr)
        nsa = _Rows(lte.number[with_nr], instants, [cells[with_nr] for cells in lte.column])
        nr_parts.append(_Part(nsa, nsa.column[7], nsa.column[11], nsa.column[8], nsa.column[9]))
    if sa is not None:
        nr_parts.append(_Part(sa, sa.column[1], sa.column[2], sa.column[3], sa.column[5]))
    streams += _levels("nr", nr_parts, lines, options)
    found = [part for part in (csi, lte, sa) if part is not None]
    numbers = [part.number for part in found]
    wrong = np.array([line.number - 1 for line in rejected], dtype=np.int64)
    blank, others = _lines.remainder(lines, np.concatenate([*numbers, wrong]).astype(np.int64), _reason)
    warnings = [text for part in found for text in part.instants.warnings]
    kept = tuple(stream for stream in streams if stream is not None)
    warnings += [text for stream in kept[:1] for text in _frames.steps_back(stream.frame)]
    return ReadResult(
        reader="quectel_csv",
        streams=kept,
        lines=len(lines),
        accepted=sum(len(number) for number in numbers),
        blank=blank,
        rejected=tuple(sorted(rejected + others, key=lambda line: line.number)),
        warnings=tuple(dict.fromkeys(warnings)),
    )


READER = Reader(
    name="quectel_csv",
    title="AERPAW Quectel logger CSVs: rank indicator, serving cell",
    kinds=("rank", "rss"),
    sample='2025-01-01 12:00:07.250,"+QNWCFG: ""lte_csi""",20,1,9,3,"+QNWCFG: ""nr5g_csi""",24,2,12,5',
    sniff=sniff,
    read=read,
)
