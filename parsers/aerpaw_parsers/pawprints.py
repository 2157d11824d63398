"""PawPrints, AERPAW's logger of an Android phone: JSON lines with LTE and NR cells, or the text of 2023.

Since autumn 2024 positions are objects in a separate log, ``location.txt`` (2023: ``GPS_LOG_START,...``). The time is
``companion_abs_time`` (ms of UTC, the clock of the aircraft's computer), or ``abs_time`` of the phone if it is missing.
The level of a cell is its RSRP; 2147483647 and ``Unavailable`` mean a missing value.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from aerpaw_cmp.common.units import AnyArray, FloatArray
from aerpaw_cmp.readers import OtherLines, Reader, ReadOptions, ReadResult, Rows, Stream, built, match, matched, split

from . import _cells, _json, _pose

_MARKS = (b'"cells"', b'"latitude"', b'"nr_signal_strength"', b'"connected_pci"', b'"companion_abs_time"')

# A line with a second START contains a truncated reading, followed by a reading at another time.
_TEXT = re.compile(rb"^CELL_LOG_START,(\d{13}),(?:(?!CELL_LOG_START).)*?,?CELL_LOG_STOP[ \t]*\r?$", re.MULTILINE)
_BLOCK = re.compile(rb"BS_INFO_START,([^\n]*?),?BS_INFO_STOP")
# Indices of the fields in a block, by technology, if all quantities are enabled in the app (the default).
_OF_TEXT = {
    b"4G_LTE": {"fields": 19, "connected": 1, "rsrp": 6, "rsrq": 7, "rssi": 8, "sinr": 5, "arfcn": 11, "pci": 12},
    b"5G_NR_SA": {"fields": 19, "connected": 2, "rsrp": 7, "rsrq": 8, "sinr": 9, "arfcn": 13, "pci": 14},
}


def sniff(head: bytes) -> bool:
    """Check whether a file has the text format of 2023, or begins with a JSON object with a phone's cells and times."""
    if head.startswith((b"CELL_LOG_START,", b"GPS_LOG_START,")):
        return True
    first = head.lstrip(b"\xef\xbb\xbf[ \r\n").split(b"\n", 1)[0]
    return first.startswith(b"{") and b'"abs_time"' in first and any(mark in first for mark in _MARKS)


def _reading(row: int, cell: dict[str, Any], connected: float) -> _cells.Reading:
    rat = "nr" if "NR" in str(cell.get("technology")) or "5G" in str(cell.get("technology")) else "lte"
    fields = {name: _json.number(value) for name, value in cell.items()}
    serving = str(cell.get("is_connected")).lower() == "true" or (rat == "lte" and fields.get("pci") == connected)
    return _cells.reading(row, fields, rat=rat, serving=serving)


def _text_cells(line: bytes) -> list[dict[str, Any]] | None:
    """Return the cells of a line of the text format of 2023, named by the keys of the JSON; None for other fields."""
    decoded = []
    for block in _BLOCK.findall(line):
        cells = block.split(b",")
        rat = next((name for name in _OF_TEXT if name in cells[:2]), b"")
        place = _OF_TEXT.get(rat)
        if place is None or len(cells) < place["fields"]:
            return None
        values = {key: cells[at].decode("ascii", "replace") for key, at in place.items() if key != "fields"}
        decoded.append({**values, "technology": rat.decode(), "is_connected": values["connected"]})
    return decoded


def _read_text(data: bytes, options: ReadOptions) -> ReadResult:
    """Return the cells of the text of 2023: ``CELL_LOG_START,<ms of UTC>,...``, a block per cell."""
    lines = split(data)
    row, groups = match(lines, _TEXT)
    cells = [_text_cells(lines.raw(i)) for i in row.tolist()]
    sound = np.array([item is not None for item in cells], dtype=bool)
    odd = lines.reject_all(row[~sound], "a block of other fields (quantities switched off in the app?)")
    rows = built(
        lines, row[sound], {"time": np.array([float(group[0]) for group in groups], dtype=np.float64)[sound]}, options,
        reader="pawprints", clock="epoch_ms", others=OtherLines(
            lambda _line: "not a complete 'CELL_LOG_START ... CELL_LOG_STOP' (truncated line?)", odd
        ),
    )  # fmt: skip
    blocks = [item for item in cells if item is not None]
    readings = [_reading(i, cell, np.nan) for i, at in enumerate(rows.at.tolist()) for cell in blocks[at]]
    return rows.result(_cells.streams(rows, readings, source="PawPrints"))


_GPS_TEXT = (
    rb"^GPS_LOG_START,%s,-?[\d.]{1,20},(?P<latitude>-?[\d.]{1,20}),(?P<longitude>-?[\d.]{1,20}),"
    rb"(?P<altitude>-?[\d.]{1,20}),[^\n]{0,80}?GPS_LOG_STOP[ \t]*\r?$"
)
_GPS_EPOCH = re.compile(_GPS_TEXT % rb"(?P<time>\d{13}),[\d.]{1,20}", re.MULTILINE)
_GPS_SECONDS = re.compile(_GPS_TEXT % rb"(?:\d{13},)?(?P<time>[\d.]{1,20})", re.MULTILINE)


def _read_location(data: bytes, options: ReadOptions) -> ReadResult:
    """Return the positions of the text of 2023, with seconds since the start or milliseconds of UTC."""
    dated = len(_GPS_EPOCH.findall(data)) == len(_GPS_SECONDS.findall(data))
    rows = matched(
        data, _GPS_EPOCH if dated else _GPS_SECONDS, options, reader="pawprints",
        reason=lambda _line: "not a complete 'GPS_LOG_START ... GPS_LOG_STOP' (truncated line?)",
        clock="epoch_ms" if dated else "relative_s",
    )  # fmt: skip
    return rows.result([_placed(rows, *(rows.number(name) for name in ("latitude", "longitude", "altitude")))])


def _nr(rows: Rows, entries: list[dict[str, Any]]) -> Stream | None:
    """Return the level of the NR leg, which the phone reports separately and without a PCI."""
    legs = [_json.inside(item, "nr_signal_strength") for item in entries]
    level = _json.column(legs, "ss_rsrp")
    finite = np.isfinite(level)
    shown, flag = rows.level(level)
    values = {"rss_db": shown, "rsrq_db": _json.column(legs, "ss_rsrq"), "sinr_db": _json.column(legs, "ss_sinr")}
    return rows.stream(
        "rss", "nr_ss_rsrp", values, where=finite, flag=flag, channel=rows.options.channel or "nr_ss_rsrp",
        unit="dBm", quantity="RSRP", rat="nr",
    )  # fmt: skip


def _placed(rows: Rows, latitude: FloatArray, longitude: FloatArray, altitude: FloatArray) -> Stream | None:
    if not np.isfinite(latitude).any():
        return None
    values: dict[str, AnyArray] = {"latitude_deg": latitude, "longitude_deg": longitude}
    lost = _pose.clean(rows, values)
    values["altitude_m"], rows.height_from = altitude, "program"
    # Android's Location.getAltitude is above the WGS 84 ellipsoid
    values["altitude_m"], about = _pose.above_takeoff(rows, values, "ellipsoid", lost)
    return rows.stream("telemetry", "phone", values, where=~lost, source="PawPrints location", about=about)


def read(data: bytes, options: ReadOptions) -> ReadResult:
    """Return a level stream per LTE or NR cell, the level of the NR leg, and the track of the phone."""
    if data[:4096].lstrip().startswith(b"CELL_LOG_START,"):
        return _read_text(data, options)
    if data[:4096].lstrip().startswith(b"GPS_LOG_START,"):
        return _read_location(data, options)
    lines = split(data)
    parsed = _json.objects(lines)
    entries = parsed.values
    time = _json.column(entries, "companion_abs_time", "abs_time")
    rows = built(
        lines, parsed.row, {"time": time}, options, reader="pawprints", clock="epoch_ms",
        others=OtherLines(_json.bracket, parsed.rejected, comments=parsed.more, closed=parsed.closed),
    )  # fmt: skip
    timed = [entries[i] for i in rows.at.tolist()]
    if any("companion_abs_time" not in item and "cells" in item for item in timed):
        rows.warnings.append("some lines have no companion_abs_time: the clock of the phone is used there")
    readings = [
        _reading(i, cell, _json.number(entry.get("connected_pci")))
        for i, entry in enumerate(timed) for cell in _json.listed(entry, "cells")
    ]  # fmt: skip
    # positions are in the objects themselves or in 'location'
    places = [{**_json.inside(item, "gps"), **_json.inside(item, "location"), **item} for item in timed]
    names = (("latitude", "lat"), ("longitude", "lon", "lng"), ("altitude", "alt"))
    track = _placed(rows, *(_json.column(places, *keys) for keys in names))
    return rows.result([track, *_cells.streams(rows, readings, source="PawPrints"), _nr(rows, timed)])


READER = Reader(
    name="pawprints", title="PawPrints (AERPAW's Android logger), JSON lines: LTE and NR cells",
    kinds=("rss", "telemetry"),
    sample='{"abs_time": 1740927600000, "connected_pci": 2, "cells": [{"technology": "4G_LTE", "rsrp": -6, "pci": 2}]}',
    sniff=sniff, read=read,
)  # fmt: skip
