"""GPX tracks of phones, loggers and Nemo: ``<trkpt lat lon><ele><time>``.

The file is read by patterns and not as XML: a parser that resolves entities is a risk with an untrusted file. Elements
and attributes inside a point, such as those of its extensions, become columns of a table, from which levels are read.
Nemo Handy writes times of the day without a date (``T14:13:17.853Z``), which are local in spite of the Z. The date is
taken from the file name. Elevations become heights above the first point.
"""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import pairwise

import numpy as np

from aerpaw_cmp.readers import InputError, IntArray, Lines, Reader, ReadOptions, ReadResult, RejectedLine, Stream, split

from . import _pose, _sheet, drive_test

_TAG = rb"(?:\w{1,20}:)?(?:trkpt|wpt|rtept)"  # XML libraries write the prefix of a namespace
_POINT = re.compile(rb"<" + _TAG + rb"\b([^<>]{0,200})>(.{0,2000}?)(?:</" + _TAG + rb">)", re.DOTALL)
_INSIDE = re.compile(rb"<(?:[\w-]{1,20}:)?([\w-]{1,40})(?:\s[^<>]{0,80})?>\s{0,40}([^<>]{1,80}?)\s{0,40}</")
# A name and a value, in the tag of a point or an extension, or in the text of a remark: 'RSRP=-80, PCI: 11'.
_PAIR = re.compile(rb"\b([A-Za-z][\w-]{0,40})\s?=\s?[\"']\s?([^\"'<>]{0,80}?)\s?[\"']")
_REMARK = re.compile(rb"\b([A-Za-z][A-Za-z_]{1,40})\s?[=:]\s?(-?\d[\d.]{0,40})(?![\d:])")
_REMARKS = ("cmt", "desc", "name")
_NAMES = {"lat": "latitude", "lon": "longitude", "time": "time utc"}
_START = re.compile(rb"<" + _TAG + rb"\b")


def sniff(head: bytes) -> bool:
    """Check whether a file is a GPX with points."""
    return re.search(rb"<(?:\w{1,20}:)?gpx\b", head[:4096]) is not None and _START.search(head) is not None


def _points(data: bytes) -> list[tuple[int, dict[str, str]]]:
    """Return the place in the file and the cells of each complete point."""
    points, tracked = [], b"<trkpt" in data
    for point in _POINT.finditer(data):
        # omit a point that contains the start of another, because it is truncated, and single points next to a track
        # (markers)
        if _START.search(point[2]) or (tracked and b"trkpt" not in point[0]):
            continue
        found = [*_PAIR.findall(point[1]), *_INSIDE.findall(point[2])]
        found += [pair for tag in re.findall(rb"<[^/][^<>]*=[^<>]*>", point[2]) for pair in _PAIR.findall(tag)]
        cells = {name.decode(): text.decode("utf-8", "replace") for name, text in reversed(found)}
        for remark in (cells.pop(name, "") for name in _REMARKS):
            cells |= {name.decode(): text.decode() for name, text in _REMARK.findall(remark.encode())}
        points.append((point.start(), {_NAMES.get(name, name): text for name, text in cells.items()}))
    return points


def read(data: bytes, options: ReadOptions) -> ReadResult:
    """Return the telemetry ``track`` and the levels of its extensions.

    Raises
    ------
    InputError
        If no point has a time.
    UsageError
        If the times have no zone and none is given.
    """
    lines, known = split(data), _points(data)
    points = [(at, cells) for at, cells in known if {*_NAMES.values()} <= set(cells)]
    if known and not points:
        raise InputError("a GPX track without times", expected="<time> in its points", cause="a route: save it as KML")
    row = lines.number_at(at for at, _ in points)
    readings = [(int(i), cells) for i, (_, cells) in zip(row, points, strict=True)]
    sheet = _sheet.of_readings(lines, readings, _truncated(lines, data, row))
    rows = _sheet.rows(sheet, options, reader="gpx")
    begun = [track.start() for track in re.finditer(rb"<(?:\w{1,20}:)?trk\b", data)]
    track = np.searchsorted(begun, np.array([at for at, _ in points], dtype=np.int64))[rows.at]
    parts = {"": (rows, sheet)}
    # tracks with overlapping times come from several devices
    spans = sorted((rows.time[track == i].min(), rows.time[track == i].max()) for i in np.unique(track))
    if any(start < end for (_, end), (start, _) in pairwise(spans)):
        parts = {f"_{i}": (rows.part(track == i), sheet.part(track == i)) for i in np.unique(track).tolist()}
    streams: list[Stream | None] = []
    for suffix, (part, cells) in parts.items():
        stream = _pose.from_sheet(part, cells, name=f"track{suffix}", source="GPX")
        # GPX has one height, ele, which receivers write above sea level
        streams.append(stream and replace(stream, attributes={**stream.attributes, "height_from": "program"}))
        streams += drive_test.of_radio(part, cells) if drive_test.has_radio(sheet.names) else []
    rows.warnings += [*_sheet.way_to_level(sheet), *sheet.remarks()]
    return rows.result(streams)


def _truncated(lines: Lines, data: bytes, row: IntArray) -> list[RejectedLine]:
    """Return the lines on which an incomplete point begins."""
    tracked = b"<trkpt" in data
    starts = (start.start() for start in _START.finditer(data) if b"trkpt" in start[0] or not tracked)
    return lines.reject_all(np.setdiff1d(lines.number_at(starts), row), "a point without position or time (truncated?)")


READER = Reader(
    name="gpx", title="GPX track (Nemo, phones, loggers)", kinds=("telemetry", "rss", "rank", "kpi"),
    sample='<trkpt lat="35.7280002" lon="-78.6960001"><ele>76.0</ele><time>2025-01-01T12:00:07Z</time></trkpt>',
    sniff=sniff, read=read,
)  # fmt: skip
