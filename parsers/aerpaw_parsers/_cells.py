"""Levels of several cells that one row of a log holds: a stream per cell, with the times when it served the phone."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np

from aerpaw_cmp.common.units import AnyArray, BoolArray, FloatArray, IntArray
from aerpaw_cmp.logs.records import Attribute, Stream
from aerpaw_cmp.logs.text import lines as _lines
from aerpaw_cmp.logs.text import rows as _rows
from aerpaw_cmp.readers import dictionary

# Radio accesses; the first where a log does not say.
RATS = ("", "lte", "nr")
QUALITIES = ("rsrq_db", "rssi_dbm", "sinr_db", "pathloss_db")
# RSRP beyond these is a sentinel (2147483647, 0) or a mistake.
_RANGE_DBM = (-170.0, -1.0)


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
    qualities : tuple of float
        Values of :data:`QUALITIES`.
    """

    row: int
    rat: str
    pci: float
    arfcn: float
    rsrp_dbm: float
    serving: bool | None
    qualities: tuple[float, ...] = (np.nan,) * len(QUALITIES)


def reading(row: int, fields: Mapping[str, float], *, rat: str, serving: bool) -> Reading:
    """Levels of one cell from the fields of an object or of a table row, by their names; see :class:`Reading`."""
    known: dict[str, float] = {}
    for name, value in fields.items():
        what = dictionary.meaning(name)
        if what is not None and np.isfinite(value) and not name.startswith("csi"):  # SS-RSRP is the cell's level
            known.setdefault(what.quantity.name, value)
    pci, arfcn, level, *qualities = (known.get(name, np.nan) for name in _QUANTITIES)
    return Reading(
        row=row, rat=rat, pci=pci, arfcn=arfcn, rsrp_dbm=level, serving=serving, qualities=tuple(qualities)
    )  # fmt: skip


_QUANTITIES = ("PCI", "ARFCN", "RSRP", "RSRQ", "RSSI", "SINR", "path loss")


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
    qualities : float array, shape (4, n)
    """

    row: IntArray
    rat: AnyArray
    pci: FloatArray
    arfcn: FloatArray
    rsrp_dbm: FloatArray
    serving: BoolArray
    qualities: FloatArray


def table(readings: Iterable[Reading]) -> Table:
    """Readings, one by one, as columns."""
    listed = list(readings)
    pci, arfcn, rsrp = (np.array([getattr(item, name) for item in listed], dtype=np.float64) for name in _NUMBERS)
    return Table(
        row=np.array([item.row for item in listed], dtype=np.int64),
        rat=np.array([RATS.index(item.rat) for item in listed], dtype=np.int8),
        pci=pci,
        arfcn=arfcn,
        rsrp_dbm=rsrp,
        serving=np.array([bool(item.serving) for item in listed], dtype=bool),
        qualities=np.array([item.qualities for item in listed], dtype=np.float64)
        .reshape(len(listed), len(QUALITIES))
        .T,
    )


_NUMBERS = ("pci", "arfcn", "rsrp_dbm")


def joined(tables: Sequence[Table]) -> Table:
    """Several tables, one behind the other."""
    if not tables:
        return table(())
    columns = {part.name: [getattr(item, part.name) for item in tables] for part in fields(Table)}
    return Table(**{name: np.concatenate(column, axis=-1) for name, column in columns.items()})


def streams(
    rows: _rows.Rows, readings: Table | Iterable[Reading], *, source: str, quantity: str = "RSRP"
) -> list[Stream]:
    """A stream per cell: radio access, PCI and carrier. Every reading with a level is a record.

    A cell is serving from the moment that the log says so until it names another of the same radio access. A PCI that
    the log knows on one carrier only is one cell, also where a reading names no carrier; of several carriers each is a
    cell of its own. The same cell a second time in one row of the log is flagged ``cell_twice``.

    Parameters
    ----------
    rows : Rows
    readings : Table or iterable of Reading
    source : str
    quantity : str
        The level that they hold.
    """
    columns = readings if isinstance(readings, Table) else table(readings)
    order = np.argsort(columns.row, kind="stable")
    order = order[np.isfinite(columns.rsrp_dbm[order])]
    rats, pci, arfcn = columns.rat[order], columns.pci[order], columns.arfcn[order]
    served = _serving(columns, order)
    pci = np.where(np.isfinite(pci) & (pci >= 0), pci, -1.0)
    per_cell: list[Stream] = []
    for rat in np.unique(rats).tolist():
        for identity in np.unique(pci[rats == rat]).tolist():
            of_pci = np.flatnonzero((rats == rat) & (pci == identity))
            carriers = np.unique(arfcn[of_pci][np.isfinite(arfcn[of_pci])])
            if len(carriers) < 2:
                parts = [(of_pci, float(carriers[0]) if len(carriers) else np.nan)]
            else:
                parts = [(of_pci[arfcn[of_pci] == carrier], carrier) for carrier in carriers.tolist()]
                parts.append((of_pci[np.isnan(arfcn[of_pci])], np.nan))
            for pick, carrier in parts:
                cell = Cell(RATS[rat], identity, carrier, several=len(carriers) > 1, quantity=quantity)
                per_cell += [_stream(rows, columns, order[pick], served[pick], cell, source)] if len(pick) else []
    return per_cell


@dataclass(frozen=True)
class Cell:
    """A cell: radio access, PCI (-1: unknown), carrier (NaN: unknown), if others share its PCI, what is measured."""

    rat: str
    pci: float
    arfcn: float
    several: bool
    quantity: str

    @property
    def name(self) -> str:
        """Name of its stream."""
        parts = [self.rat, f"pci{int(self.pci)}" if self.pci >= 0 else "rsrp"]
        if self.several and np.isfinite(self.arfcn):
            parts.append(f"arfcn{int(self.arfcn)}")
        return "_".join(part for part in parts if part)


def _serving(columns: Table, order: IntArray) -> FloatArray:
    """1 where the reading is of the cell that serves, 0 where another does, NaN where nothing is known."""
    row, rats, serving = (column[order] for column in (columns.row, columns.rat, columns.serving))
    cell = np.stack([columns.pci[order], np.nan_to_num(columns.arfcn[order], nan=-1.0)])
    served = np.full(len(order), np.nan)
    for rat in np.unique(rats[serving]).tolist():
        of_rat = np.flatnonzero(rats == rat)
        named = of_rat[serving[of_rat]]
        # all readings of a row at once: the serving one may stand behind its neighbours
        last = np.searchsorted(row[named], row[of_rat], side="right") - 1
        named_before = last >= 0
        of_rat = of_rat[named_before]
        served[of_rat] = serving[of_rat] | (cell[:, of_rat] == cell[:, named[last[named_before]]]).all(axis=0)
    return served


def _stream(rows: _rows.Rows, columns: Table, pick: IntArray, served: FloatArray, cell: Cell, source: str) -> Stream:
    """Readings of one cell, in the order of the log."""
    row, level = columns.row[pick], columns.rsrp_dbm[pick]
    flag = rows.flag[row]
    outside = ~((level >= _RANGE_DBM[0]) & (level <= _RANGE_DBM[1]))
    if 2 * outside.sum() > len(level):
        rows.warnings.append(
            f"{cell.name}: {outside.sum()} of {len(level)} levels lie outside {_RANGE_DBM[0]:g} .. "
            f"{_RANGE_DBM[1]:g} dBm (the first: {level[outside][0]:g}; another unit, or an index?): "
            "read as out of coverage"
        )
    rssi = columns.qualities[QUALITIES.index("rssi_dbm"), pick]
    if cell.quantity == "RSRP" and (rssi < level).sum() > max(2, len(level) // 2):
        rows.warnings.append(f"{cell.name}: RSSI lies below RSRP, which cannot be: are the columns exchanged?")
    _lines.add_flag(flag, outside, "out_of_coverage")
    _lines.add_flag(flag, np.concatenate(([False], row[1:] == row[:-1])), "cell_twice")
    level[outside] = np.nan
    values: dict[str, FloatArray] = {"rss_db": level, "serving": served}
    for name, column in zip(QUALITIES, columns.qualities, strict=True):
        quality = column[pick]
        finite = np.isfinite(quality)  # a ratio or loss written as 'inf' is none
        if finite.any():
            values[name] = np.where(finite, quality, np.nan)
    stream = rows.stream(
        "rss", cell.name, values, pick=row, flag=flag, channel=rows.options.channel or cell.name,
        unit=rows.options.unit or "dBm", quantity=cell.quantity, rat=cell.rat or None,
        pci=int(cell.pci) if cell.pci >= 0 else None, arfcn=int(cell.arfcn) if np.isfinite(cell.arfcn) else None,
        source=source,
    )  # fmt: skip
    assert stream is not None
    return stream


def named(
    rows: _rows.Rows, name: str, values: FloatArray, *, unit: str = "", where: BoolArray | None = None,
    about: Mapping[str, Attribute | None] | None = None,
) -> Stream | None:  # fmt: skip
    """Level or KPI stream of a column by its name; of an unknown one, a KPI under its own name.

    A level of a neighbour that nobody names, one that the base station measured, a statistic, a prediction are KPIs.

    Parameters
    ----------
    rows : Rows
    name : str
        As the log calls it.
    values : (n,)
    unit : str
        Where the quantity does not say.
    where : (n,) bool, optional
        Rows that count.
    about : mapping, optional
        Further attributes.
    """
    meaning = dictionary.meaning(name)
    quantity = dictionary.Quantity(name, "kpi", ()) if meaning is None else meaning.quantity
    short = re.sub(r"\W+", "_", dictionary.plain(name))
    if quantity.kind == "rss" and meaning is not None and not meaning.indirect and not meaning.neighbour:
        level, flag = rows.level(np.where(dictionary.is_none(quantity, values), np.nan, values))
        return rows.stream(
            "rss", short, {"rss_db": level}, where=where, flag=flag, channel=rows.options.channel or short,
            unit=rows.options.unit or unit or quantity.unit, quantity=quantity.name, about=about,
        )  # fmt: skip
    return rows.stream(
        "kpi", short, {"value": values}, where=where, unit=unit or quantity.unit, quantity=quantity.name, about=about
    )
