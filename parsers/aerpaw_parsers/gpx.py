"""GPX tracks of phones, loggers and Nemo: ``<trkpt lat lon><ele><time>``.

Read by pattern and not as XML: a parser that resolves entities has no business with a file from elsewhere. Nemo
Handy writes times of the day without a date (``T14:13:17.853Z``), local in spite of the Z: their date is that of
the file name. Elevations are brought to heights above the first point.
"""

from __future__ import annotations

import re
from itertools import pairwise

import numpy as np

from aerpaw_cmp.common.errors import InputError
from aerpaw_cmp.common.units import IntArray
from aerpaw_cmp.logs import rows as _rows
from aerpaw_cmp.logs import text as _text
from aerpaw_cmp.logs.readers import Reader, ReadOptions
from aerpaw_cmp.logs.records import ReadResult, RejectedLine, Stream
from aerpaw_cmp.readers import dictionary

from . import _json, _pose, _stamps

_N = rb"(" + _text.NUMBER + rb")"
_TAG = rb"(?:\w{1,20}:)?(?:trkpt|wpt|rtept)"  # also of a named space, as programs that use an XML library write it
_POINT = re.compile(rb"<" + _TAG + rb"\b([^<>]{0,200})>(.{0,2000}?)(?:</" + _TAG + rb">)", re.DOTALL)
_ATTRIBUTE = re.compile(rb"\b(lat|lon)\s?=\s?[\"']\s?" + _N + rb"\s?[\"']")
_INSIDE = re.compile(rb"<(?:\w{1,20}:)?(ele|time)>\s{0,40}([^<>]{1,60}?)\s{0,40}</")
_START = re.compile(rb"<" + _TAG + rb"\b")


def sniff(head: bytes) -> bool:
    """Check whether it is a GPX with points."""
    return re.search(rb"<(?:\w{1,20}:)?gpx\b", head[:4096]) is not None and _START.search(head) is not None


def _points(data: bytes) -> list[tuple[int, dict[bytes, bytes]]]:
    """Place and values of each whole point."""
    points, tracked = [], b"<trkpt" in data
    for point in _POINT.finditer(data):
        # torn, where the next begins inside; beside a track, places that somebody marked
        if _START.search(point[2]) or (tracked and b"trkpt" not in point[0]):
            continue
        values = dict(_ATTRIBUTE.findall(point[1]))
        values |= dict(_INSIDE.findall(point[2]))
        points.append((point.start(), values))
    return points


def read(data: bytes, options: ReadOptions) -> ReadResult:
    """Return the telemetry ``track``; UsageError if the times have no zone and none is given.

    Raises
    ------
    InputError
        If no point has a time.
    """
    lines, known = _text.split(data), _points(data)
    points = [(at, values) for at, values in known if {b"lat", b"lon", b"time"} <= set(values)]
    if known and not points:
        raise InputError("a GPX track without times", expected="<time> in its points", cause="a route or a drawn track")
    row = lines.number_at(at for at, _ in points)
    placed = [values for _, values in points]
    texts = [values[b"time"].decode("ascii", "replace") for values in placed]
    clock, time, warnings = _stamps.read(texts, options, zone="UTC")  # as GPX defines it
    names = (b"lat", b"lon", b"ele")
    column = {name.decode(): _text.cells([values.get(name, b"") for values in placed]) for name in names}
    rows = _rows.built(
        lines, row, {"time": time, **column}, options, reader="gpx", reason=lambda _line: None, clock=clock,
        extra=_torn(lines, data, row), closed=True,
    )  # fmt: skip
    rows.warnings += warnings
    begun = [track.start() for track in re.finditer(rb"<(?:\w{1,20}:)?trk\b", data)]
    track = np.searchsorted(begun, np.array([at for at, _ in points], dtype=np.int64))[rows.at]
    if not _overlap(rows, track):
        return rows.result([_stream(rows, "track")])
    return rows.result([_stream(rows.part(track == i), f"track_{i}") for i in np.unique(track).tolist()])


def _overlap(rows: _rows.Rows, track: IntArray) -> bool:
    """Check whether tracks of one file run at the same time, as those of two devices do."""
    spans = sorted((rows.time[track == i].min(), rows.time[track == i].max()) for i in np.unique(track))
    return any(start < end for (_, end), (start, _) in pairwise(spans))


def _stream(rows: _rows.Rows, name: str) -> Stream | None:
    names = ("lat", "lon", "ele")
    texts = {key: rows.columns[key].tolist() for key in names}
    values = dictionary.record_columns({key: np.array([_json.number(cell) for cell in texts[key]]) for key in names})
    lost = _pose.clean(rows, values)
    # GPX has one height, ele, which receivers give above sea level
    rows.height_from = "program"
    values["altitude_m"], about = _pose.above_takeoff(rows, values, "sea level", lost)
    return rows.stream("telemetry", name, values, where=~lost, source="GPX", about=about)


def _torn(lines: _text.Lines, data: bytes, row: object) -> list[RejectedLine]:
    """Lines on which a point begins that is not whole."""
    tracked = b"<trkpt" in data
    starts = (start.start() for start in _START.finditer(data) if b"trkpt" in start[0] or not tracked)
    begun = np.unique(lines.number_at(starts))
    return lines.reject_all(np.setdiff1d(begun, np.asarray(row)), "a point without position or time (torn?)")


READER = Reader(
    name="gpx", title="GPX track (Nemo, phones, loggers)", kinds=("telemetry",),
    sample='<trkpt lat="35.7280002" lon="-78.6960001"><ele>76.0</ele><time>2025-01-01T12:00:07Z</time></trkpt>',
    sniff=sniff, read=read,
)  # fmt: skip
