"""Levels of several cells in one row of a log: a stream per cell, with the times at which the cell served the phone."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import NamedTuple, cast

import numpy as np
import pandas as pd

from aerpaw_cmp.readers import AnyArray, Attribute, BoolArray, FloatArray, Rows, Stream, add_flag, counted, dictionary

# Lowest RSRP that phones write, and the plausible range. An RSRP outside it is a placeholder (2147483647, 0) or an
# error.
_END_DBM = -140.0
_RANGE_DBM = (-170.0, -1.0)


# Smallest number of rows in which a statistic can be recognised, and the largest ratio of its steps to the steps of the
# level.
_SHOWN_ROWS, _SMOOTHER = 12, 0.6


def is_statistic_of(level: FloatArray, other: FloatArray) -> bool:
    """Check whether a column is a running mean, minimum or maximum of a level: smoother, and near it or its extreme."""
    both = np.isfinite(level) & np.isfinite(other)
    level, other = level[both], other[both]
    if len(level) < _SHOWN_ROWS or np.std(np.diff(other)) >= _SMOOTHER * np.std(np.diff(level)):
        return False
    apart, step_db = other - level, np.std(np.diff(level))
    follows = abs(np.median(apart)) < step_db / 2 and np.std(apart) < step_db
    touches = 0 < (np.abs(apart) < 0.1).mean() < 1 and (apart.min() > -0.1 or apart.max() < 0.1)
    return bool(follows or touches)


class Reading(NamedTuple):
    """The levels of one cell in one row, which is a row of the table for :func:`streams`.

    Parameters
    ----------
    row : int
        Index into the rows.
    rat : str
        ``lte``, ``nr``, or empty if unknown.
    pci, arfcn : float
        Physical cell identity and carrier, NaN if unknown.
    rsrp_dbm : float
    serving : bool
        True for a serving cell.
    more : str
        Name that distinguishes cells of one PCI and carrier, such as a beam.
    rsrq_db, rssi_dbm, sinr_db, pathloss_db : float
    """

    row: int
    rat: str
    pci: float
    arfcn: float
    rsrp_dbm: float
    serving: bool = False
    more: str = ""
    rsrq_db: float = np.nan
    rssi_dbm: float = np.nan
    sinr_db: float = np.nan
    pathloss_db: float = np.nan


QUALITIES = Reading._fields[7:]


def reading(row: int, fields: Mapping[str, float], *, rat: str, serving: bool) -> Reading:
    """Return the :class:`Reading` of one cell from the named fields of an object or of a table row."""
    known: dict[str, float] = {}
    for name, value in fields.items():
        what = dictionary.meaning(name)
        if what is not None and np.isfinite(value) and not name.startswith("csi"):  # SS-RSRP is the cell's level
            known.setdefault(what.quantity.name, value)
    values = {field: known.get(name, np.nan) for field, name in QUANTITIES.items()}
    return Reading(row, rat, serving=serving, **values)  # type: ignore[arg-type]


# Quantity of the dictionary for each field of a reading.
QUANTITIES = {"pci": "PCI", "arfcn": "ARFCN", "rsrp_dbm": "RSRP", "rsrq_db": "RSRQ", "rssi_dbm": "RSSI",
              "sinr_db": "SINR", "pathloss_db": "path loss"}  # fmt: skip


def streams(
    rows: Rows, readings: pd.DataFrame | Iterable[Reading], *, source: str, quantity: str = "RSRP",
    more: Mapping[str, Mapping[str, Attribute]] | None = None, unit: str = "dBm",
) -> list[Stream]:  # fmt: skip
    """Return a stream per cell, which is a radio access, PCI and carrier. Every reading with a level is a record.

    A cell serves from the moment at which the log names it until the log names another cell of the same radio access.
    If a PCI occurs with one carrier, readings without a carrier belong to the same cell. If it occurs with several
    carriers, each carrier is a separate cell. A second reading of a cell in one row of the log is flagged
    ``cell_twice``.

    Parameters
    ----------
    rows : Rows
    readings : pandas.DataFrame or iterable of Reading
        A table has the fields of :class:`Reading` as columns.
    source : str
    quantity : str
        Quantity of the levels.
    more : mapping, optional
        Further attributes of the cells; the keys are values of ``more`` in the readings.
    unit : str
        Unit of the levels. Many programs write dB for dBm. Values in dB are therefore taken as dB re full scale only if
        they cannot be dBm.
    """
    rows_or_table = readings if isinstance(readings, pd.DataFrame) else [*readings]
    table = pd.DataFrame(rows_or_table, columns=list(Reading._fields))
    # use a stable sort, because the second of two readings of a row is flagged cell_twice
    table = table[np.isfinite(table["rsrp_dbm"].to_numpy(np.float64))].sort_values("row", kind="stable")
    table = table.assign(served=_serving(table), pci=table["pci"].where(table["pci"] >= 0, -1.0))
    per_cell, named = list[Stream](), bool(table["more"].ne("").any())
    for key, cell_rows in table.groupby(["rat", "pci"]):
        rat, identity = cast("tuple[str, float]", key)
        carriers = np.unique(cell_rows["arfcn"].dropna()).tolist()
        several = len(carriers) > 1
        for carrier in [*carriers, np.nan] if several else [*carriers, np.nan][:1]:
            mine = cell_rows["arfcn"].eq(carrier) | (cell_rows["arfcn"].isna() & np.isnan(carrier))
            of_carrier = cell_rows[mine] if several else cell_rows
            about: dict[str, Attribute | None] = {"quantity": quantity, "rat": rat or None, "unit": unit}
            about["pci"] = int(identity) if identity >= 0 else None
            about["arfcn"] = int(carrier) if np.isfinite(carrier) else None
            level = quantity.lower() if quantity in QUANTITIES.values() else "rsrp"
            words = [rat, f"pci{about['pci']}" if identity >= 0 else level]
            words += [level] if identity >= 0 and level != "rsrp" else []
            words += [f"arfcn{about['arfcn']}"] if several and np.isfinite(carrier) else []
            for further, part in of_carrier.groupby("more") if named else [("", of_carrier)][: len(of_carrier)]:
                name = "_".join(word for word in (*words, str(further)) if word)
                known = {**about, **(more or {}).get(str(further), {}), "source": source}
                per_cell.append(_stream(rows, part, name, known))
    return per_cell


def _serving(table: pd.DataFrame) -> FloatArray:
    """Return 1 for readings of the serving cell, 0 if another cell serves, NaN if unknown."""
    row, rats, serving = (table[name].to_numpy() for name in ("row", "rat", "serving"))
    # NaN is not equal to NaN: replace missing carriers by -1
    cell = np.stack([table["pci"], table["arfcn"].fillna(-1.0), pd.factorize(table["more"])[0]])
    served = np.full(len(table), np.nan)
    for rat in np.unique(rats[serving.astype(bool)]).tolist():
        of_rat = np.flatnonzero(rats == rat)
        named = of_rat[serving[of_rat].astype(bool)]
        # look up all readings of a row at once, because neighbours may come before the serving cell
        last = np.searchsorted(row[named], row[of_rat], side="right") - 1
        of_rat, last = of_rat[last >= 0], last[last >= 0]
        served[of_rat] = serving[of_rat] | (cell[:, of_rat] == cell[:, named[last]]).all(axis=0)
    return served


def _stream(rows: Rows, table: pd.DataFrame, cell: str, about: Mapping[str, Attribute | None]) -> Stream:
    """Return the stream of one cell, in the order of the log."""
    row, level = table["row"].to_numpy(), table["rsrp_dbm"].to_numpy(np.float64, copy=True)
    flag = rows.flag[row]
    outside = ~((level >= _RANGE_DBM[0]) & (level <= _RANGE_DBM[1]))
    relative = about["unit"] == "dB re full scale" or (about["unit"] == "dB" and 2 * outside.sum() > len(level))
    unit = "dB re full scale" if relative else "dBm"
    if relative:
        outside = ~np.isfinite(level)
    elif 2 * outside.sum() > len(level):
        rows.warnings.append(
            f"{cell}: {outside.sum()} of {counted(len(level), 'level')} outside {_RANGE_DBM[0]:g} .. "
            f"{_RANGE_DBM[1]:g} dBm (the first: {level[outside][0]:g}; another unit, or an index?): "
            "read as missing"
        )
    # without a signal, phones write the lowest value (3GPP TS 36.133, 9.1.4); a weak cell would approach it gradually
    ends = (level == _END_DBM) & (about["quantity"] == "RSRP")
    if ends.any() and not ((level > _END_DBM) & (level < _END_DBM + 10.0)).any():
        outside |= ends
        levels = counted(int(ends.sum()), "level")
        rows.warnings.append(f"{cell}: {levels} of {_END_DBM:g} dBm, none within 10 dB above: read as out of coverage")
    if about["quantity"] == "RSRP" and (table["rssi_dbm"] < level).sum() > max(2, len(level) // 2):
        rows.warnings.append(f"{cell}: RSSI is below RSRP, which is impossible: are the columns swapped?")
    # unlike a missing level, a level that is too high contains no information about coverage
    high = outside & (level > _RANGE_DBM[1]) & ~np.isin(level, (0.0, *dictionary.UNAVAILABLE))
    add_flag(flag, high, "level_out_of_range")
    add_flag(flag, outside & ~high, "out_of_coverage")
    add_flag(flag, np.concatenate(([False], row[1:] == row[:-1])), "cell_twice")
    level[outside] = np.nan
    values: dict[str, AnyArray] = {"rss_db": level, "serving": table["served"].to_numpy()}
    for name in QUALITIES:
        quality = table[name].to_numpy(np.float64)
        finite = np.isfinite(quality)  # 'inf' means a missing ratio or loss
        if finite.any():
            values[name] = np.where(finite, quality, np.nan)
    stream = rows.stream(
        "rss", cell, values, pick=row, flag=flag, channel=rows.options.channel or cell, unit=rows.options.unit or unit,
        about=about,
    )  # fmt: skip
    assert stream is not None
    return stream


def named(
    rows: Rows, name: str, values: FloatArray, *, unit: str = "", where: BoolArray | None = None,
    about: Mapping[str, Attribute | None] | None = None, alone: bool = False,
) -> Stream | None:  # fmt: skip
    """Return the stream of a column, a level or a KPI according to its name. An unknown name is a KPI.

    Levels of neighbours without an identity, levels at the base station, statistics and predictions are KPIs.

    Parameters
    ----------
    rows : Rows
    name : str
        Name in the log.
    values : (n,)
    unit : str
        Unit, if the quantity has none.
    where : (n,) bool, optional
        Rows of the stream.
    about : mapping, optional
        Further attributes.
    alone : bool
        True if there is no level or rank: a ratio to the noise is then the level.
    """
    meaning = dictionary.meaning(name)
    quantity = dictionary.Quantity(name, "kpi", ()) if meaning is None else meaning.quantity
    if alone and quantity.name == "SINR":
        quantity = replace(quantity, name="SNR", role="rss")
    short = re.sub(r"\W+", "_", dictionary.plain(name))
    direct = meaning is not None and not (meaning.indirect or meaning.place.startswith("n") or unit == "%")
    # unlike a ratio, a power in dB has no reference, so use the unit of the quantity
    unit = quantity.unit if (quantity.name, unit) == ("power", "dB") else unit
    if quantity.kind == "rss" and direct and "statistic" not in (about or {}):
        level, flag = rows.level(np.where(dictionary.is_none(quantity, values), np.nan, values))
        return rows.stream(
            "rss", short, {"rss_db": level}, where=where, flag=flag,
            channel=rows.options.channel or (about or {}).get("channel", short),
            unit=rows.options.unit or unit or quantity.unit, quantity=quantity.name, about=about,
        )  # fmt: skip
    unit = unit or ("unknown" if quantity.open_unit else quantity.unit)
    about = {"unit": unit, "quantity": quantity.name, **(about or {})}
    return rows.stream("kpi", short, {"value": values}, where=where, about=about)
