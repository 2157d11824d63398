"""Levels of several cells that one row of a log holds: a stream per cell, with the times when it served the phone."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from aerpaw_cmp.common.units import AnyArray, BoolArray, FloatArray, IntArray
from aerpaw_cmp.logs.records import ReadResult, Stream

from . import _decided, _lines, _rows

RATS = ("", "lte", "nr")
"""Radio accesses; the first where a log does not say."""
BESIDE = ("rsrq_db", "rssi_dbm", "sinr_db", "pathloss_db")
_SEVERAL = "several"
"""In place of the carrier of a cell that a block heard on several, until all blocks are there."""
RANGE_DBM = (-170.0, -1.0)
"""RSRP beyond these is a sentinel (2147483647, 0) or a mistake."""


@dataclass(frozen=True)
class Reading:
    """Levels of one cell in one row.

    Parameters
    ----------
    row : int
        Index into the rows.
    rat : str
        One of :data:`RATS`.
    pci : float
        Physical cell identity, NaN where unknown.
    arfcn : float
    rsrp_dbm : float
    serving : bool or None
        Does the log call it the serving cell?
    beside : tuple of float
        Values of :data:`BESIDE`.
    """

    row: int
    rat: str
    pci: float
    arfcn: float
    rsrp_dbm: float
    serving: bool | None
    beside: tuple[float, ...] = (np.nan,) * len(BESIDE)


@dataclass(frozen=True)
class Table:
    """Readings as columns; meanings as of :class:`Reading`.

    Parameters
    ----------
    row : int array, shape (n,)
    rat : int array, shape (n,)
        Index into :data:`RATS`.
    pci, arfcn, rsrp_dbm : float array, shape (n,)
    serving : bool array, shape (n,)
    beside : float array, shape (4, n)
    """

    row: IntArray
    rat: AnyArray
    pci: FloatArray
    arfcn: FloatArray
    rsrp_dbm: FloatArray
    serving: BoolArray
    beside: FloatArray


def table(readings: Iterable[Reading]) -> Table:
    """Readings, one by one, as columns."""
    found = list(readings)
    pci, arfcn, rsrp = (np.array([getattr(one, name) for one in found], dtype=np.float64) for name in _NUMBERS)
    return Table(
        row=np.array([one.row for one in found], dtype=np.int64),
        rat=np.array([RATS.index(one.rat) for one in found], dtype=np.int8),
        pci=pci,
        arfcn=arfcn,
        rsrp_dbm=rsrp,
        serving=np.array([bool(one.serving) for one in found], dtype=bool),
        beside=np.array([one.beside for one in found], dtype=np.float64).reshape(len(found), len(BESIDE)).T,
    )


_NUMBERS = ("pci", "arfcn", "rsrp_dbm")


def joined(tables: Sequence[Table]) -> Table:
    """Several tables, one behind the other."""
    if not tables:
        return table(())
    columns = {part.name: [getattr(one, part.name) for one in tables] for part in fields(Table)}
    return Table(**{name: np.concatenate(column, axis=-1) for name, column in columns.items()})


def streams(
    rows: _rows.Rows, readings: Table | Iterable[Reading], *, source: str, before: Mapping[str, float] | None = None
) -> list[Stream]:
    """A stream per radio access and PCI; a cell that is told twice at one time is kept once, as serving.

    A cell is serving from the moment that the log says so until it names another of the same radio access.

    Parameters
    ----------
    rows : Rows
    readings : Table or iterable of Reading
    source : str
    before : mapping of str to float, optional
        PCI of the cell that served, by radio access, where these rows begin.
    """
    found = readings if isinstance(readings, Table) else table(readings)
    order = np.argsort(found.row, kind="stable")
    order = order[np.isfinite(found.rsrp_dbm[order])]
    rats, pci = found.rat[order], found.pci[order]
    served = _serving(found, order, before or {})
    key = np.where(np.isfinite(pci) & (pci >= 0), pci, -1.0)
    made: list[Stream] = []
    for rat in np.unique(rats).tolist():
        of_rat = np.flatnonzero(rats == rat)
        cell = key[of_rat]
        for one in np.unique(cell).tolist():
            pick = of_rat[cell == one]
            made.append(_stream(rows, found, order[pick], served[pick], RATS[rat], one, source))
    return made


def _serving(found: Table, order: IntArray, before: Mapping[str, float]) -> FloatArray:
    """1 where the reading is of the cell that serves, 0 where another does, NaN where nothing is known."""
    row, rats, pci, serving = (column[order] for column in (found.row, found.rat, found.pci, found.serving))
    served = np.full(len(order), np.nan)
    for rat, one in before.items():
        mine = np.flatnonzero(rats == RATS.index(rat))
        served[mine] = pci[mine] == one
    for rat in np.unique(rats[serving]).tolist():
        mine = np.flatnonzero(rats == rat)
        told = mine[serving[mine]]
        # all readings of a row at once: the serving one may stand behind its neighbours
        last = np.searchsorted(row[told], row[mine], side="right") - 1
        known = last >= 0
        mine = mine[known]
        served[mine] = serving[mine] | (pci[mine] == pci[told[last[known]]])
    return served


def _once(time: AnyArray, served: FloatArray) -> IntArray:
    """Rows to keep: of two readings of one instant the serving one."""
    if (time[1:] > time[:-1]).all():
        return np.arange(len(time))
    order = np.lexsort((-np.nan_to_num(served), time))
    return np.asarray(np.sort(order[np.concatenate(([True], np.diff(time[order]) != np.timedelta64(0)))]))


def settled(result: ReadResult) -> ReadResult:
    """A result whose blocks may have cut an instant in two: each cell once at each time, the cells in their order.

    A cell that was heard on several carriers has no ``arfcn``.
    """
    places = [_place(stream) for stream in result.streams]
    streams = [_settled(stream) if _is_cell(stream) else stream for stream in result.streams]
    ordered = sorted(zip(places, streams, strict=True), key=lambda pair: pair[0])
    return _decided.finished(result, [stream for _, stream in ordered])


def _is_cell(stream: Stream) -> bool:
    return stream.kind == "rss" and "serving" in stream.frame


_KINDS = ("telemetry", "rank", "rss", "kpi")


def _place(stream: Stream) -> tuple[int, bool, int, int, str]:
    """Place of a stream among the others: the track, ranks, cells by radio access and PCI, what else there is."""
    kind = _KINDS.index(stream.kind)
    if not _is_cell(stream):
        return kind, True, 0, 0, stream.name
    return kind, False, RATS.index(str(stream.attributes.get("rat", ""))), int(stream.attributes.get("pci", -1)), ""


def _settled(stream: Stream) -> Stream:
    twice = np.ones(len(stream.frame), dtype=bool)
    twice[_once(stream.frame["time"].to_numpy(), stream.frame["serving"].to_numpy())] = False
    frame = _decided.without(stream.frame, twice)
    columns = [name for name in frame if name not in BESIDE]
    columns += [name for name in BESIDE if name in frame and frame[name].notna().any()]
    frame = frame if list(frame) == columns else frame[columns]  # no copy in vain
    about = {key: value for key, value in stream.attributes.items() if (key, value) != ("arfcn", _SEVERAL)}
    return replace(stream, frame=frame, attributes=about)


def _stream(
    rows: _rows.Rows, found: Table, pick: IntArray, served: FloatArray, rat: str, pci: float, source: str
) -> Stream:
    """Readings of one cell, in the order of the log."""
    numbers = np.unique(found.arfcn[pick])
    numbers = numbers[np.isfinite(numbers)]
    keep = _once(rows.time[found.row[pick]], served)
    if len(keep) < len(pick):
        pick, served = pick[keep], served[keep]
    row, level = found.row[pick], found.rsrp_dbm[pick]
    flag = rows.flag[row]
    outside = ~((level >= RANGE_DBM[0]) & (level <= RANGE_DBM[1]))
    _lines.add_flag(flag, outside, "out_of_coverage")
    level[outside] = np.nan
    values: dict[str, FloatArray] = {"rss_db": level, "serving": served}
    for name, column in zip(BESIDE, found.beside, strict=True):
        mine = column[pick]
        known = np.isfinite(mine)  # a ratio or loss written as 'inf' is none
        if known.any():
            values[name] = np.where(known, mine, np.nan)
    carrier = None if not len(numbers) else int(numbers[0]) if len(numbers) == 1 else _SEVERAL
    name = "_".join(part for part in (rat, f"pci{int(pci)}" if pci >= 0 else "rsrp") if part)
    made = rows.stream(
        "rss", name, values, pick=row, flag=flag, channel=rows.options.channel or name,
        unit=rows.options.unit or "dBm", quantity="RSRP", rat=rat or None, pci=int(pci) if pci >= 0 else None,
        arfcn=carrier, source=source,
    )  # fmt: skip
    assert made is not None
    return made
