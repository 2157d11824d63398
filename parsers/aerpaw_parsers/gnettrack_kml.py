"""G-NetTrack's KML: a placemark per reading, its quantities as ``<Data name="RSRP"><value>-81</value></Data>``.

The names are the same as in the program's text log, but in capitals, and are read in the same way. The file is read by
patterns and not by an XML parser, for the reason in :mod:`.nemo_kml`.
"""

from __future__ import annotations

import re

import numpy as np

from aerpaw_cmp.common import kml
from aerpaw_cmp.readers import Reader, ReadOptions, ReadResult, split

from . import _sheet, drive_test

_PLACEMARK = re.compile(rb"<Placemark\b")
_SIGNS = (re.compile(rb'<Data name="TIME">'), re.compile(rb'<Data name="(?:RSRP|LEVEL|NRXLEV\d?|SSRSRP)">'))
_PLACE = ("Longitude", "Latitude")
_MODE = re.compile(rb"<altitudeMode>\s{0,40}(\w{1,20})")


def sniff(head: bytes) -> bool:
    """Check whether a file is a KML with times and levels in named data."""
    return kml.is_kml(head) and all(sign.search(head) for sign in _SIGNS)


def read(data: bytes, options: ReadOptions) -> ReadResult:
    """Return cells, KPIs and the track of the phone, or raise UsageError if no time zone is given."""
    lines = split(data)
    begin = [match.start() for match in _PLACEMARK.finditer(data)]
    row = lines.number_at(begin)
    texts = [data[first:last] for first, last in zip(begin, [*begin[1:], len(data)][: len(begin)], strict=True)]
    cut = [i for i, text in enumerate(texts) if b"</Placemark>" not in text]
    readings = [_reading(text) for text in texts]
    timed = [i for i, reading in enumerate(readings) if reading.get("TIME") and i not in cut]
    torn = lines.reject_all(np.setdiff1d(row[cut], row[timed]), "a placemark without its end (truncated file?)")
    sheet = _sheet.of_readings(lines, [(int(row[i]), readings[i]) for i in timed], torn)
    return drive_test.of_sheet(_sheet.rows(sheet, options, reader="gnettrack_kml"), sheet)


def _reading(text: bytes) -> dict[str, str]:
    """Return the names and values of a placemark."""
    values = {name.decode(): value.decode("utf-8", "replace").strip() for name, value in kml.DATA.findall(text)}
    if (point := kml.POINT.search(text)) is not None:
        place = [b"" if cell is None else cell for cell in point.groups()]
        mode = _MODE.search(text)
        height = "Altitude AGL" if mode is not None and mode[1] == b"relativeToGround" else "Altitude above sea level"
        if not place[2].strip(b"0.") or (mode is not None and mode[1].startswith(b"clamp")):
            place[2] = b""  # remove the height, because the point is drawn on the ground
        values |= {name: cell.decode() for name, cell in zip((*_PLACE, height), place, strict=True) if cell}
    return values


READER = Reader(
    name="gnettrack_kml", title="G-NetTrack KML: cells by PCI, KPIs, positions",
    kinds=("rss", "rank", "kpi", "telemetry"),
    sample='<Data name="TIME"><value>2025.03.02_10.00.00</value></Data><Data name="RSRP"><value>-81</value></Data>',
    sniff=sniff, read=read,
)  # fmt: skip
