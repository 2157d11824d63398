"""NMEA 0183 sentences of a GNSS receiver.

Positions come from ``GGA``, ``GNS`` or ``RMC``, and dates from ``RMC`` or ``ZDA``. Times are UTC. A sentence is read if
its checksum is right. Text in front of the ``$``, such as a logger's own time, is not read. The fix has MAVLink's
numbers: 3 single, 4 differential, 5 and 6 RTK. Altitudes are above mean sea level.
"""

from __future__ import annotations

import re
from collections import Counter
from functools import reduce
from operator import xor

import numpy as np

from aerpaw_cmp.readers import Lines, Reader, ReadOptions, ReadResult, RejectedLine, mostly, split

from . import _pose

# Body, talker, kind, fields and checksum.
_SENTENCE = re.compile(rb"[^$]{0,80}\$(([A-Z]{2})([A-Z0-9]{2,6}),([^*$]{0,200}))(?:\*([0-9A-Fa-f]{2})\b.{0,80})?\s*")
_BEGIN = re.compile(rb"[^$]{0,80}\$(?:P[A-Z]{3,5}|[A-Z]{2}(?:GGA|RMC|GSA|GSV|GLL|GNS|GST|VTG|ZDA|HDT|TXT)),")
_CLOCK = re.compile(r"([01]\d|2[0-3])([0-5]\d)([0-5]\d(?:\.\d{1,9})?)")
_DATE = re.compile(r"(0[1-9]|[12]\d|3[01])(0[1-9]|1[0-2])(?:20)?(\d\d)")
# MAVLink's number of the fix, by the quality of GGA, the mode of GNS and the status of RMC.
_FIX = dict(zip("0VN1A2D3P4R5F", "0003344336655", strict=True))
# Kinds with positions, in rising order of preference, because RMC has no height.
_PLACED = ("RMC", "GNS", "GGA")
_PLACE = ("latitude [ddmm.mmmm]", "lat dir", "longitude [ddmm.mmmm]", "lon dir")


def sniff(head: bytes) -> bool:
    """Check whether most of the first lines are sentences, and at least one sentence has positions."""
    return mostly(head, _BEGIN) and re.search(rb"\$..(?:GGA|GNS|RMC),", head) is not None


def _sentences(lines: Lines, rejected: list[RejectedLine]) -> list[tuple[int, str, str, list[str]]]:
    """Return the 0-based line, talker, kind and fields (ten or more) of each intact sentence."""
    intact, unchecked = [], b"*" not in lines.data
    for i in np.flatnonzero(~lines.blank).tolist():
        found = _SENTENCE.fullmatch(lines.raw(i))
        if found is None or not (found[5] or unchecked):
            rejected.append(lines.reject(i, "not a complete NMEA sentence (truncated?)"))
        elif found[5] and reduce(xor, found[1]) != int(found[5], 16):
            rejected.append(lines.reject(i, "the checksum of the NMEA sentence is wrong"))
        else:
            fields = [*found[4].decode("ascii", "replace").split(","), *[""] * 10]
            intact.append((i, found[2].decode(), found[3].decode(), fields))
    return intact


def _day_s(clock: str) -> float:
    """Return the second of the day of ``hhmmss.ss``."""
    return int(clock[:2]) * 3600 + int(clock[2:4]) * 60 + float(clock[4:])


def read(data: bytes, options: ReadOptions) -> ReadResult:
    """Return the telemetry ``vehicle`` of the talker that writes the most positions."""
    rejected: list[RejectedLine] = []
    lines = split(data)
    sentences = _sentences(lines, rejected)
    placed = Counter((kind, talker) for _, talker, kind, f in sentences if kind in _PLACED and f[4])
    source = max(placed, key=lambda item: (_PLACED.index(item[0]), placed[item]), default=("GGA", ""))
    high = source[0] != "RMC"
    dates = [(i, f[8], f[0]) for i, _, kind, f in sentences if kind == "RMC" and f[1] == "A"]
    dates = dates or [(i, f[1] + f[2] + f[3], f[0]) for i, _, kind, f in sentences if kind == "ZDA"]
    dates = [date for date in dates if _DATE.fullmatch(date[1]) and _CLOCK.fullmatch(date[2])]
    at, readings = np.array([i for i, *_ in dates]), []
    for i, talker, kind, fields in sentences:
        if (kind, talker) != source:
            continue
        if not _CLOCK.fullmatch(fields[0]):
            rejected.append(lines.reject(i, "a position without a time"))
            continue
        time = _CLOCK.sub(r"\1:\2:\3Z", fields[0])
        if dates:
            _, day, clock = dates[max(int(np.searchsorted(at, i)) - 1, 0)]
            # the nearest sentence with a date may be from the day before or after
            days = int(day[:2]) - 1 + round((_day_s(clock) - _day_s(fields[0])) / 86_400)
            time = f"{np.datetime64(f'20{day[-2:]}-{day[2:4]}-01') + days}T{time}"
        cells = dict(zip(_PLACE, fields[1:5] if high else fields[2:6], strict=True))
        cells |= {"time": time, "fix": _FIX.get(fields[5 if high else 1][:1], "")}
        cells |= {"satellites": fields[6], "altitude msl": fields[8]} if high else {}
        readings.append((i, cells))
    return _pose.of_readings(lines, readings, rejected, options, reader=READER.name)


READER = Reader(
    name="nmea", title="NMEA 0183 sentences of a GNSS receiver (GGA, GNS, RMC)", kinds=("telemetry",),
    sample="$GPGGA,140000.00,3543.68,N,07841.76,W,1,08,0.9,111.3,M,-32.0,M,,*50", sniff=sniff, read=read,
)  # fmt: skip
