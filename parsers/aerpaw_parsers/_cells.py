"""Levels of several cells that one row of a log holds: a stream per cell, with the times when it served the phone."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from aerpaw_cmp.common.units import AnyArray, BoolArray, FloatArray, IntArray
from aerpaw_cmp.logs.records import ReadResult, Stream

from . import _lines, _rows

BESIDE = ("rsrq_db", "rssi_dbm", "sinr_db", "pathloss_db")
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
        ``lte`` or ``nr``, or an empty text.
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
    rat : object array, shape (n,)
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

    def take(self, pick: AnyArray) -> Table:
        """Some of them, by index or mask."""
        return Table(
            row=self.row[pick],
            rat=self.rat[pick],
            pci=self.pci[pick],
            arfcn=self.arfcn[pick],
            rsrp_dbm=self.rsrp_dbm[pick],
            serving=self.serving[pick],
            beside=self.beside[:, pick],
        )


def table(readings: Iterable[Reading]) -> Table:
    """Readings, one by one, as columns."""
    found = list(readings)
    pci, arfcn, rsrp = (np.array([getattr(one, name) for one in found], dtype=np.float64) for name in _NUMBERS)
    return Table(
        row=np.array([one.row for one in found], dtype=np.int64),
        rat=np.array([one.rat for one in found], dtype=object),
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


def streams(rows: _rows.Rows, readings: Table | Iterable[Reading], *, source: str) -> list[Stream]:
    """A stream per radio access and PCI; a cell that is told twice at one time is kept once, as serving.

    A cell is serving from the moment that the log says so until it names another of the same radio access.
    """
    found = readings if isinstance(readings, Table) else table(readings)
    found = found.take(np.isfinite(found.rsrp_dbm))
    found = found.take(np.argsort(found.row, kind="stable"))
    served = _serving(found)
    made: list[Stream] = []
    for rat in sorted(set(found.rat.tolist())):
        of_rat = np.flatnonzero(found.rat == rat)
        pci = found.pci[of_rat]
        key = np.where(np.isfinite(pci) & (pci >= 0), pci, -1.0)
        for one in np.unique(key).tolist():
            pick = of_rat[key == one]
            made.append(_stream(rows, found.take(pick), served[pick], rat, one, source))
    return made


def _serving(found: Table) -> FloatArray:
    """1 where the reading is of the cell that serves, 0 where another does, NaN where nothing is known."""
    served = np.full(len(found.row), np.nan)
    for rat in set(found.rat.tolist()):
        mine = np.flatnonzero(found.rat == rat)
        told = mine[found.serving[mine]]
        # all readings of a row at once: the serving one may stand behind its neighbours
        last = np.searchsorted(found.row[told], found.row[mine], side="right") - 1
        known = last >= 0
        now = found.pci[told][last[known]] if len(told) else np.zeros(0)
        mine = mine[known]
        served[mine] = (found.serving[mine] | (found.pci[mine] == now)).astype(np.float64)
    return served


def _once(time: AnyArray, served: FloatArray) -> IntArray:
    """Rows to keep: of two readings of one instant the serving one."""
    order = np.lexsort((-np.nan_to_num(served), time))
    return np.asarray(np.sort(order[np.concatenate(([True], np.diff(time[order]) != np.timedelta64(0)))]))


def settled(result: ReadResult) -> ReadResult:
    """A result whose blocks may have cut an instant in two: each cell once at each time."""
    streams = []
    for stream in result.streams:
        if stream.kind == "rss" and "serving" in stream.frame:
            keep = _once(stream.frame["time"].to_numpy(), stream.frame["serving"].to_numpy())
            if len(keep) < len(stream.frame):
                stream = replace(stream, frame=stream.frame.iloc[keep].reset_index(drop=True))
        streams.append(stream)
    return replace(result, streams=tuple(streams))


def _stream(rows: _rows.Rows, mine: Table, served: FloatArray, rat: str, pci: float, source: str) -> Stream:
    keep = _once(rows.time[mine.row], served)
    mine, served = mine.take(keep), served[keep]
    flag = rows.flag[mine.row].copy()
    outside = ~((mine.rsrp_dbm >= RANGE_DBM[0]) & (mine.rsrp_dbm <= RANGE_DBM[1]))
    _lines.add_flag(flag, outside, "out_of_coverage")
    values: dict[str, FloatArray] = {"rss_db": np.where(outside, np.nan, mine.rsrp_dbm), "serving": served}
    for name, column in zip(BESIDE, mine.beside, strict=True):
        if np.isfinite(column).any():
            values[name] = column
    numbers = np.unique(mine.arfcn[np.isfinite(mine.arfcn)])
    name = "_".join(part for part in (rat, f"pci{int(pci)}" if pci >= 0 else "rsrp") if part)
    made = rows.stream(
        "rss", name, values, pick=mine.row, flag=flag, channel=rows.options.channel or name,
        unit=rows.options.unit or "dBm", quantity="RSRP", rat=rat or None, pci=int(pci) if pci >= 0 else None,
        arfcn=int(numbers[0]) if len(numbers) == 1 else None, source=source,
    )  # fmt: skip
    assert made is not None
    return made
