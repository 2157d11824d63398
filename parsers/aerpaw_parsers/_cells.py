"""Levels of several cells that one row of a log holds: a stream per cell, with the times when it served the phone."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from aerpaw_cmp.common.units import AnyArray, FloatArray, IntArray
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


def streams(rows: _rows.Rows, readings: Iterable[Reading], *, source: str) -> list[Stream]:
    """A stream per radio access and PCI; a cell that is told twice at one time is kept once, as serving.

    A cell is serving from the moment that the log says so until it names another of the same radio access.
    """
    found = [one for one in readings if np.isfinite(one.rsrp_dbm)]
    if not found:
        return []
    order = np.argsort([one.row for one in found], kind="stable")
    found = [found[i] for i in order]
    served = _serving(found)
    made: list[Stream] = []
    names = {(one.rat, one.pci if np.isfinite(one.pci) else -1.0) for one in found}
    for rat, pci in sorted(names):
        none = pci < 0
        same = [one.rat == rat and (one.pci == pci or (none and not np.isfinite(one.pci))) for one in found]
        mine = np.flatnonzero(same).tolist()
        stream = _stream(rows, [found[i] for i in mine], served[mine], rat, pci, source)
        if stream is not None:
            made.append(stream)
    return made


def _serving(found: list[Reading]) -> FloatArray:
    """1 where the reading is of the cell that serves, 0 where another does, NaN where nothing is known."""
    known = any(one.serving for one in found)
    now: dict[str, float] = {}
    served = np.full(len(found), np.nan)
    for one in found:
        if one.serving:
            now[one.rat] = one.pci
    if not known:
        return served
    now = {}
    begin = 0
    while begin < len(found):  # all readings of a row at once: the serving one may stand behind its neighbours
        end = begin
        while end < len(found) and found[end].row == found[begin].row:
            if found[end].serving:
                now[found[end].rat] = found[end].pci
            end += 1
        for i in range(begin, end):
            if found[i].rat in now:
                served[i] = float(bool(found[i].serving) or found[i].pci == now[found[i].rat])
        begin = end
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


def _stream(
    rows: _rows.Rows, mine: list[Reading], served: FloatArray, rat: str, pci: float, source: str
) -> Stream | None:
    if not mine:
        return None  # a cell whose number is none
    pick: IntArray = np.array([one.row for one in mine], dtype=np.int64)
    keep = _once(rows.time[pick], served)
    pick, mine, served = pick[keep], [mine[i] for i in keep], served[keep]
    level = np.array([one.rsrp_dbm for one in mine])
    flag = rows.flag[pick].copy()
    outside = ~((level >= RANGE_DBM[0]) & (level <= RANGE_DBM[1]))
    _lines.add_flag(flag, outside, "out_of_coverage")
    values: dict[str, FloatArray] = {"rss_db": np.where(outside, np.nan, level), "serving": served}
    for i, name in enumerate(BESIDE):
        column = np.array([one.beside[i] for one in mine])
        if np.isfinite(column).any():
            values[name] = column
    arfcn = np.array([one.arfcn for one in mine])
    numbers = np.unique(arfcn[np.isfinite(arfcn)])
    name = "_".join(part for part in (rat, f"pci{int(pci)}" if pci >= 0 else "rsrp") if part)
    return rows.stream(
        "rss", name, values, pick=pick, flag=flag, channel=rows.options.channel or name,
        unit=rows.options.unit or "dBm", quantity="RSRP", rat=rat or None, pci=int(pci) if pci >= 0 else None,
        arfcn=int(numbers[0]) if len(numbers) == 1 else None, source=source,
    )  # fmt: skip
