"""Exports of drive-test programs and phones: Nemo, XCAL, TEMS, QualiPoc, G-NetTrack; one table of names for all.

A column is told by its name: the quantity (RSRP, RSRQ, RSSI, SINR, path loss, PCI, ARFCN, CQI, throughput, rank),
the radio access (LTE, NR) and the role of the cell (serving, or the n-th detected or neighbour). Levels with a PCI
become one stream per cell, ``lte_pci110`` say, whose column ``serving`` is 1 while that cell served; other
quantities become streams of kind ``kpi``, RI a rank stream (from one). Positions become the telemetry stream
``phone``.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field

import numpy as np

from aerpaw_cmp.common.units import FloatArray
from aerpaw_cmp.logs import rows as _rows
from aerpaw_cmp.logs.readers import Reader, ReadOptions
from aerpaw_cmp.logs.records import ReadResult, Stream

from . import _cells, _nemo, _pose, _quantities, _sheet, aadm_snr, own_csv, pose_csv, quectel_ri

_PCI = re.compile(r"\b(\w{0,5}pci|pcid|pcell id|physical cell (id|identity)|phys(ical)? ?cell ?id|nci pci)\b")
_ARFCN = re.compile(r"\b(nr ?|e ?|u ?)?arfcn\b|\bchannel number\b|\bfreq(uency)? channel\b")
_NEIGHBOUR = re.compile(
    r"\b(detected|neigh(bou?rs?)?|nbr|nb|ncell|n ?\d{1,2}|nrx|nlte\w*|adjacent|top \d{1,2})\b|^n\d?(rsrp|rxrsrp)\b|^nrx"
)
_NR = re.compile(r"\b(nr|5g|spcell|ss ?rsrp|ss ?rsrq|ss ?sinr|nr5g)\b|^ss")
_LTE = re.compile(r"\b(lte|4g|e ?utran?)\b|^lte")
# A secondary carrier: it serves beside the primary one.
_SECONDARY = re.compile(r"\bsc(?:ell|c) ?(\d{0,2})\b")
_NUMBER = re.compile(r"(?:^| )n?(\d{1,2})(?: |$)")
_QUALITIES = {"RSRQ": "rsrq_db", "RSSI": "rssi_dbm", "SINR": "sinr_db", "path loss": "pathloss_db"}
_TOWER_SNR = re.compile(r"snr (lw\d)")


# Columns of tables with a cell a row: whether the cell serves.
_REGISTERED = (r"(is )?(registered|serving|connected)( cell)?",)
_TECH = re.compile(r"(?i)4g|5g|lte|nr")


def is_header(names: list[str]) -> bool:
    """Check whether names hold a time and a level, ratio or rank."""
    names = _quantities.in_common_words(names)
    times = any(_sheet.matches(name, (*_sheet.TIME_NAMES, "date")) for name in names)
    return times and any(pose_csv.has_radio(name) for name in names) and len(names) > 2


def sniff(head: bytes) -> bool:
    """Check whether a header of such names stands in front, and it is none of the narrower formats."""
    narrower = (_nemo.sniff, *(r.READER.sniff for r in (quectel_ri, aadm_snr, own_csv)))
    return _sheet.starts(head, is_header) and not any(known(head) for known in narrower)


@dataclass
class _Cell:
    """Columns of one place in the table: the serving cell, or the n-th of the others."""

    rat: str
    serving: bool
    rsrp: int | None = None
    pci: int | None = None
    arfcn: int | None = None
    qualities: dict[str, int] = field(default_factory=dict)


def _places(sheet: _sheet.Sheet) -> tuple[list[_Cell], list[int], list[int]]:
    """Cells of the table, columns of other quantities, columns of rank."""
    cells: dict[tuple[str, str], _Cell] = {}
    others, ranks = [], []
    for i, name in enumerate(sheet.plain):
        meaning = _quantities.quantity(name)
        is_pci, is_arfcn = _PCI.search(name) is not None, _ARFCN.search(name) is not None
        if meaning is None and not is_pci and not is_arfcn:
            continue
        if meaning is not None and meaning.kind == "rank":
            ranks.append(i)
            continue
        if meaning is not None and meaning.name not in ("RSRP", *_QUALITIES):
            others.append(i)
            continue
        rat = "nr" if _NR.search(name) else "lte" if _LTE.search(name) else ""
        neighbour = _NEIGHBOUR.search(name) is not None
        number, second = _NUMBER.search(re.sub(r"\b[45] ?g\b", "", name)), _SECONDARY.search(name)
        role = f"n{number[1] if number else 0}" if neighbour else f"scell{second[1]}" if second else "serving"
        cell = cells.setdefault((rat, role), _Cell(rat, not neighbour))
        _put(cell, i, meaning, is_pci=is_pci, is_arfcn=is_arfcn, others=others)
    return _completed(cells, others), others, ranks


def _put(
    cell: _Cell, i: int, meaning: _quantities.Quantity | None, *, is_pci: bool, is_arfcn: bool, others: list[int]
) -> None:
    """Column ``i`` to its place; a second column of one quantity is kept as a KPI."""
    name = "" if meaning is None else _QUALITIES.get(meaning.name, "")
    if meaning is None and (is_pci or is_arfcn):
        part = "pci" if is_pci else "arfcn"
        setattr(cell, part, i if getattr(cell, part) is None else getattr(cell, part))
    elif meaning is not None and meaning.name == "RSRP" and cell.rsrp is None:
        cell.rsrp = i
    elif name and name not in cell.qualities:
        cell.qualities[name] = i
    else:
        others.append(i)


def _completed(cells: dict[tuple[str, str], _Cell], others: list[int]) -> list[_Cell]:
    """Cells with a level; what stands without a radio access, or beside none, is that of the only one of its role.

    Neighbours whose names tell no radio access are of that of the table, where it names one alone. Levels of neighbours
    that no column names by a PCI are no levels of a cell: they become KPIs.
    """
    for (rat, role), cell in list(cells.items()):
        if cell.rsrp is not None:
            continue
        same = [
            partner for (access, place), partner in cells.items() if place == role and (not rat or access in ("", rat))
        ]
        homes = [partner for partner in same if partner.rsrp is not None]
        if len(homes) == 1:
            home = homes[0]
            home.rat = home.rat or rat
            home.pci = cell.pci if home.pci is None else home.pci
            home.arfcn = cell.arfcn if home.arfcn is None else home.arfcn
            others += [column for key, column in cell.qualities.items() if key in home.qualities]
            home.qualities = {**cell.qualities, **home.qualities}
            del cells[(rat, role)]
    named = {cell.rat for cell in cells.values()} - {""}
    for key, cell in list(cells.items()):
        if len(named) == 1 and not cell.serving:
            cell.rat = cell.rat or next(iter(named))
        if cell.rsrp is None or (cell.pci is None and not cell.serving):
            others += [column for column in (cell.rsrp, *cell.qualities.values()) if column is not None]
            del cells[key]
    return list(cells.values())


def _readings(sheet: _sheet.Sheet, cells: list[_Cell]) -> _cells.Table:
    tables = []
    tech, registered = sheet.find(*_quantities.OF_GNETTRACK), sheet.find(*_REGISTERED)
    of_row = None if tech is None else np.array([_rat(text) for text in sheet.texts(tech)], dtype=np.int8)
    idle = None
    if registered is not None:
        idle = np.array([text.lower() in ("false", "0", "no") for text in sheet.texts(registered)], dtype=bool)
    for cell in cells:
        assert cell.rsrp is not None
        level = sheet.numbers(cell.rsrp)
        row = np.flatnonzero(np.isfinite(level))
        pci, arfcn = (_or_nan(sheet, place, len(level))[row] for place in (cell.pci, cell.arfcn))
        qualities = np.stack([_or_nan(sheet, cell.qualities.get(name), len(level))[row] for name in _cells.QUALITIES])
        pci = np.where(pci == np.round(pci), pci, np.nan)  # a fraction is no identity of a cell
        rat = np.full(len(row), _cells.RATS.index(cell.rat), dtype=np.int8)
        if of_row is not None and not cell.rat:
            rat = of_row[row]
        serving = np.full(len(row), cell.serving)
        if idle is not None:
            serving &= ~idle[row]
        tables.append(
            _cells.Table(
                row=row, rat=rat, pci=pci, arfcn=arfcn, rsrp_dbm=level[row], serving=serving, qualities=qualities
            )
        )
    return _cells.joined(tables)


def _rat(technology: str) -> int:
    """Index into ``RATS`` of what G-NetTrack calls a technology."""
    word = technology.strip().lower()
    return _cells.RATS.index("lte" if word in ("4g", "lte") else "nr" if word in ("5g", "nr") else "")


def _or_nan(sheet: _sheet.Sheet, column: int | None, count: int) -> FloatArray:
    return np.full(count, np.nan) if column is None else sheet.numbers(column)


def read(data: bytes, options: ReadOptions) -> ReadResult:
    """Cells, ranks, KPIs and the track of the phone; UsageError if the clock has no zone and none is given."""
    sheet = _sheet.read(data, is_header)
    rows = None if sheet is None else _sheet.rows(sheet, options, reader="drive_test")
    if sheet is None or rows is None:
        return _sheet.nothing(data, "drive_test", "no header with a time and a level, ratio or rank")
    return of_sheet(rows, sheet)


def of_sheet(rows: _rows.Rows, sheet: _sheet.Sheet) -> ReadResult:
    """Streams of a table whose columns have the names of a drive-test program."""
    _settle_names(sheet)
    cells, others, ranks = _places(sheet)
    track = _pose.from_sheet(rows, sheet, name="phone", source="table of a phone")
    levels = _cells.streams(rows, _readings(sheet, cells), source="drive test")
    columns = [*ranks, *others, *_event_columns(sheet, cells)]
    streams = [(_rank if column in ranks else _other)(rows, sheet, column) for column in columns]
    rows.warnings += sheet.unread()
    return rows.result(_distinct([track, *levels, *streams]))


def _event_columns(sheet: _sheet.Sheet, cells: list[_Cell]) -> list[int]:
    """Columns beside a serving level with values in rows of their own, which become streams: Nemo's rows are events."""
    columns = []
    for cell in cells:
        if cell.rsrp is not None and cell.serving:
            silent = np.isnan(sheet.numbers(cell.rsrp))
            columns += [i for i in cell.qualities.values() if np.isfinite(sheet.numbers(i)[silent]).any()]
    return columns


def _settle_names(sheet: _sheet.Sheet) -> None:
    """Names in common words; G-NetTrack's ``Level`` is an RSRP on 4G and 5G only, its bit rates are in kbit/s.

    Its ``LTERSSI`` is in dBm, from older phones in steps from 0 that are no level.
    """
    words = _quantities.in_common_words(sheet.plain)
    if not set(words).isdisjoint(_quantities.OF_GNETTRACK):
        sheet.units |= {i: "kbit/s" for i, name in enumerate(words) if name in ("dl bitrate", "ul bitrate")}
    if words != sheet.plain and "level" in sheet.plain:
        places, tech = [sheet.plain.index(name) for name in ("level", "qual")], sheet.find(*_quantities.OF_GNETTRACK)
        if tech is not None:
            texts = sheet.texts(tech)
            older = {text for text in set(texts) if not _TECH.search(text)}
            sheet.silence(np.array([text in older for text in texts], dtype=bool), places)
        if (rssi := sheet.find("lterssi")) is not None:
            sheet.silence(sheet.numbers(rssi) >= 0, [rssi])
    sheet.plain = words


def _rank(rows: _rows.Rows, sheet: _sheet.Sheet, column: int) -> Stream | None:
    ri = sheet.numbers(column)
    flag = rows.flag.copy()
    values = {"rank": _rows.ranks(ri, flag, none=ri == 0, means=True), "ri_raw": ri}
    name = re.sub(r"\W+", "_", sheet.plain[column])
    source = "scheduled PDSCH rank" if "pdsch" in name else "CSI report"
    return rows.stream("rank", name, values, where=np.isfinite(ri), flag=flag, ri_base="one", source=source)


def _other(rows: _rows.Rows, sheet: _sheet.Sheet, column: int) -> Stream | None:
    values = sheet.numbers(column)
    name = sheet.plain[column]
    if tower := _TOWER_SNR.fullmatch(name):
        return _rows.snr(rows, tower[1].upper(), values)
    finite = np.isfinite(values)
    meaning = _quantities.quantity(name)
    if meaning is not None and meaning.kind == "rss" and _NEIGHBOUR.search(name):  # of a cell that nobody names
        return rows.stream(
            "kpi", re.sub(r"\W+", "_", name), {"value": values}, where=finite, unit=meaning.unit, quantity=meaning.name
        )
    return _quantities.stream(rows, name, values, unit=sheet.unit_read(column), where=finite)


def _distinct(streams: list[Stream | None]) -> list[Stream | None]:
    """Streams by name: of two columns of one name the first is kept."""
    by_name: dict[str, Stream] = {}
    for stream in streams:
        if stream is not None:
            by_name.setdefault(stream.name, stream)
    return list(by_name.values())


READER = Reader(
    name="drive_test",
    title="drive-test export, CSV (Nemo, XCAL, TEMS, QualiPoc, G-NetTrack): cells by PCI, rank, KPIs, positions",
    kinds=("rss", "rank", "kpi", "telemetry"),
    sample="Time,Latitude,Longitude,Physical cell identity (LTE pcell),RSRP (LTE pcell)",
    sniff=sniff,
    read=read,
)
