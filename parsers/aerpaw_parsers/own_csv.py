"""Exports of aerpaw-cmp read back: ``rss.csv`` and ``rank.csv`` of a report, and the table that ``tap export`` writes.

``rss.csv``: a stream per tower and channel with ``measured_db`` as logged. ``rank.csv``: a stream per tower. Tap
export: rank per query, RSRP of the serving cell. Times are UTC; where a report had none, seconds from an unknown
origin.
"""

from __future__ import annotations

import numpy as np

from aerpaw_cmp.common.units import BoolArray
from aerpaw_cmp.logs.readers import Reader, ReadOptions
from aerpaw_cmp.logs.records import ReadResult, Stream
from aerpaw_cmp.logs.text import rows as _rows
from aerpaw_cmp.readers import dictionary

from . import _sheet

_RSS = ("time utc", "tower", "channel", "unit", "measured db")
_RANK = ("time utc", "tower", "measured rank")
_TAP = ("time utc", "query", "status", "rank", "ri raw")


def is_header(names: list[str]) -> bool:
    """Check whether names are those of one of the three tables."""
    plain = {dictionary.plain(name) for name in names}
    return any(set(form) <= plain for form in (_RSS, _RANK, _TAP))


def sniff(head: bytes) -> bool:
    """Check whether the first line is one of our headers."""
    return head.lstrip(b"\xef\xbb\xbf").startswith(b"time_utc,") and _sheet.starts(head, is_header)


def read(data: bytes, options: ReadOptions) -> ReadResult:
    """Read back the records that the table was made of."""
    sheet = _sheet.read(data, is_header)
    if sheet is None:
        return _sheet.nothing(data, "own_csv", "no header of an export")
    column = sheet.named("time utc")
    if column is not None and not any(sheet.texts(column)):
        column = sheet.named("time s", "time utc")
    rows = _sheet.rows(sheet, options, reader="own_csv", column=column)
    assert rows is not None
    names = set(sheet.plain)
    if set(_RSS) <= names:
        return rows.result(_levels(rows, sheet))
    return rows.result(_ranks(rows, sheet) if set(_RANK) <= names else _tap(rows, sheet))


def _text(sheet: _sheet.Sheet, name: str) -> np.ndarray:  # type: ignore[type-arg]
    place = sheet.named(name)
    texts = [] if place is None else sheet.texts(place)
    # NumPy compares an array of objects with a text whose last NULs it has taken off
    return np.array([text.replace("\0", "\ufffd") for text in texts], dtype=object)


def _number(sheet: _sheet.Sheet, name: str) -> np.ndarray:  # type: ignore[type-arg]
    place = sheet.named(name)
    return np.full(len(sheet), np.nan) if place is None else sheet.numbers(place)


def _levels(rows: _rows.Rows, sheet: _sheet.Sheet) -> list[Stream | None]:
    tower, channel, unit = (_text(sheet, name) for name in ("tower", "channel", "unit"))
    level, flag = rows.level(_number(sheet, "measured db"))
    streams = []
    for node, channel_name in dict.fromkeys(zip(tower.tolist(), channel.tolist(), strict=True)):
        mine: BoolArray = (tower == node) & (channel == channel_name)
        name = f"{node}_{channel_name}"
        about = {"node": node, "channel": channel_name, "unit": str(unit[mine][0])}
        streams.append(rows.stream("rss", name, {"rss_db": level}, where=mine, flag=flag, about=about))
    return streams


def _ranks(rows: _rows.Rows, sheet: _sheet.Sheet) -> list[Stream | None]:
    tower, ri = _text(sheet, "tower"), _number(sheet, "measured rank")
    values = rows.rank(ri)
    streams = []
    for node in dict.fromkeys(tower.tolist()):
        about = {"node": node, "ri_base": "one", "source": "report"}
        streams.append(rows.stream("rank", f"{node}_rank", values, where=tower == node, about=about))
    return streams


def _tap(rows: _rows.Rows, sheet: _sheet.Sheet) -> list[Stream | None]:
    query, status = _text(sheet, "query"), _text(sheet, "status")
    streams = []
    for name in ("nr5g_csi", "lte_csi"):
        mine: BoolArray = (query == name) & (status == "ok")
        columns = {"rank": "rank", "ri_raw": "ri raw", "cqi": "cqi", "mcs": "mcs", "uncertainty_s": "uncertainty s"}
        values = {key: _number(sheet, plain) for key, plain in columns.items()}
        rank = values["rank"]
        odd = mine & ~np.isnan(rank) & ~((rank >= 1) & (rank <= 8) & (rank == np.round(rank)))
        rows.mark(odd, "ri_out_of_range")
        values["rank"] = np.where(odd, np.nan, rank)
        name = name.removesuffix("_csi")
        if name == "lte" and not np.isfinite(values["rank"][mine]).any():
            continue
        streams.append(rows.stream("rank", name, values, where=mine, channel=name, ri_base="one", source="CSI report"))
    cell: BoolArray = (query == "servingcell") & np.isfinite(_number(sheet, "rsrp dbm"))
    level, flag = rows.level(_number(sheet, "rsrp dbm"))
    values = {"rss_db": level, "sinr_db": _number(sheet, "sinr db")}
    streams.append(
        rows.stream("rss", "nr5g_rsrp", values, where=cell, flag=flag, channel="nr5g_rsrp", unit="dBm", quantity="RSRP")
    )
    return streams


READER = Reader(
    name="own_csv",
    title="exports of aerpaw-cmp read back: rss.csv, rank.csv, tap export",
    kinds=("rss", "rank"),
    sample="time_utc,time_s,tower,channel,unit,east_m,north_m,up_m,measured_db",
    sniff=sniff,
    read=read,
)
