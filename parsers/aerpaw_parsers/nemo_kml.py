"""Measurements of a Keysight Nemo phone, as KML: one placemark description per report, one quantity per file.

Only the description lines are read. Each contains one report. The descriptions are read by patterns and not as XML,
because a parser that resolves entities is a risk with an untrusted file. All other lines are markup and count as
comments.
"""

from __future__ import annotations

import re

import numpy as np

from aerpaw_cmp.common import kml
from aerpaw_cmp.common.geodesy import rough_m
from aerpaw_cmp.common.units import BoolArray, FloatArray
from aerpaw_cmp.logs import text as _text
from aerpaw_cmp.logs.limits import FASTEST_MPS, typical_speed_mps
from aerpaw_cmp.readers import OtherLines, Reader, ReadOptions, ReadResult, Rows, Stream, built, dictionary

from . import _cells, _pose
from .nemo_csv import pdsch_rank

_N = rb"(" + _text.NUMBER + rb"|nan)"
_GAP = rb"[^\n]{0,60}?"
_NAME = rb" ?([A-Za-z][A-Za-z0-9 /_.-]{1,40}(?:\([^()=\n]{1,30}\))?) = "
_RECORD = re.compile(
    rb"rel_time = " + _N + rb" ms" + _GAP + _NAME + _N + rb" ?([A-Za-z/%]{0,8})" + _GAP
    # a position is required, because the phone is on the aircraft
    + rb"\(lat, lon\) = \(" + _N + rb", ?" + _N + rb"\)" + _GAP + rb"altitude = " + _N + rb" m"
)  # fmt: skip
_HINT = re.compile(rb"rel_time = ")
_POSITION = ("latitude_deg", "longitude_deg", "altitude_m")


def sniff(head: bytes) -> bool:
    """Check whether a file is a KML with a Nemo description."""
    return kml.is_kml(head) and _HINT.search(head) is not None and b"(lat, lon) = (" in head


def read(data: bytes, options: ReadOptions) -> ReadResult:
    """Return rank, level or KPI streams, one per quantity in the file, and the track of the phone.

    Raises
    ------
    UsageError
        If ``time_origin`` is not a time, or is local and no time zone is given.
    """
    lines = _text.split(data)
    described = lines.number_at(hint.start() for hint in _HINT.finditer(data))
    torn = "a Nemo description without time, quantity, position or altitude (truncated line?)"
    others = OtherLines(lambda _: torn, comments=np.setdiff1d(np.arange(len(lines)), described))
    reports = list(_RECORD.finditer(data))
    row = lines.number_at(item.start() for item in reports)
    names = ("time", "what", "value", "unit", *_POSITION)
    column = dict(zip(names, _text.columns([item.groups(b"") for item in reports], 7), strict=True))
    in_seconds = _in_seconds(*(_text.numbers(column[name]) for name in ("time", *_POSITION[:2])))
    rows = built(
        lines, row, column, options, reader="nemo_kml", others=others,
        clock="relative_s" if in_seconds else "relative_ms",
    )  # fmt: skip
    rows.warnings += ["with times in ms the phone would fly faster than any aircraft: read as seconds"] * in_seconds
    position = {name: rows.number(name) for name in _POSITION}
    about: _pose.Height = {}
    if np.isfinite(position["altitude_m"]).any():
        rows.height_from, lost = "assumed", np.isnan(position["latitude_deg"])
        position["altitude_m"], about = _pose.above_takeoff(rows, position, "unknown", lost)
    what = np.array(rows.text("what"), dtype=object)
    first = dictionary.meaning(what[0]) if len(what) else None
    if first is not None and first.quantity.role == "rank":
        return rows.result([pdsch_rank(rows, {"ri_raw": rows.number("value"), **position})])
    streams = [rows.stream("telemetry", "phone", position, source="Nemo placemarks", about=about)]
    streams += [_measured(rows, name, what == name) for name in dict.fromkeys(what.tolist())]
    return rows.result(streams)


def _in_seconds(time_ms: FloatArray, latitude: FloatArray, longitude: FloatArray) -> bool:
    """Check whether times called milliseconds are in fact seconds: the phone would be too fast in ms, but not in s."""
    if not len(time_ms):
        return False
    speed_mps = typical_speed_mps(time_ms / 1e3, rough_m(latitude, longitude, (latitude[0], longitude[0])))
    # if the phone is too fast even with times in seconds, the positions are wrong, not the unit
    return FASTEST_MPS < speed_mps <= 1e3 * FASTEST_MPS


# Nemo's KML writes this after the quantities of the serving cell; its CSV writes ``nr`` before them (``nr_rsrp``).
_SERVING = " (NR SpCell)"


def _measured(rows: Rows, name: str, where: BoolArray) -> Stream | None:
    """Return the level or KPI stream of one quantity, under its name in Nemo's CSV."""
    unit = next((text for text in rows.text("unit") if text), "")
    short = f"nr {name.removesuffix(_SERVING)}" if name.endswith(_SERVING) else name
    about = {"rat": "nr"} if short != name else None
    return _cells.named(rows, short, rows.number("value"), unit=unit, where=where, about=about)


READER = Reader(
    name="nemo_kml", kinds=("rank", "rss", "kpi", "telemetry"), sniff=sniff, read=read,
    title="Keysight Nemo KML: NR rank, RSRP, RSRQ, SINR, CQI or throughput along a flight (also gzipped)",
    sample="<description>... rel_time = -1500.0 ms ... PDSCH rank (NR) = 2.0 ... (lat, lon) = (35.728,-78.696) ...",
)  # fmt: skip
