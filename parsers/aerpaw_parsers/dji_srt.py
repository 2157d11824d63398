"""Subtitles of a DJI drone's video (``.SRT``): a position per frame or second, in the camera's local time.

Newer firmware writes ``[latitude: 35.7] [longitude: -78.6] [rel_alt: 1.0 abs_alt: 120.0]``, older firmware
``GPS(longitude,latitude,satellites) BAROMETER:height``. ``rel_alt``, ``BAROMETER`` and ``H`` count from take-off.
Subtitles without a date are relative times.
"""

from __future__ import annotations

import re

from aerpaw_cmp.readers import Reader, ReadOptions, ReadResult, split

from . import _pose

_N = rb"(-?\d{1,5}(?:\.\d{0,15})?)"
_BEGIN = re.compile(rb"^\d{1,7}\s{1,8}(\d\d:\d\d:\d\d)[,.](\d{3}) --> ", re.MULTILINE)
_DATE = re.compile(rb"(20\d\d)[-./](\d\d)[-./](\d\d) (\d\d:\d\d:\d\d)(?:[.,:](\d{3}))?(?:[.,](\d{3}))?")
_FIELD = re.compile(rb"\b(latitude|long?t?itude|rel_alt|abs_alt|altitude|BAROMETER|H)\s?[: ]\s?" + _N)
_GPS = re.compile(rb"\bGPS\s?\(\s?" + _N + rb"\s?,\s?" + _N)
_NAMES = {"longtitude": "longitude", "rel_alt": "relative altitude", "abs_alt": "altitude msl",
          "BAROMETER": "relative altitude", "H": "relative altitude"}  # fmt: skip


def sniff(head: bytes) -> bool:
    """Check whether subtitles have positions."""
    return re.match(rb"\s*" + _BEGIN.pattern[1:], head) is not None and (
        _GPS.search(head) is not None or b"latitude" in head
    )


def _reading(text: bytes) -> dict[str, str]:
    """Return the cells of a subtitle, with an empty latitude if it has no position."""
    cells = {"latitude": "", "longitude": ""}
    for name, value in _FIELD.findall(text):
        cells[_NAMES.get(name.decode(), name.decode())] = value.decode()
    if (place := _GPS.search(text)) is not None:
        longitude, latitude = place[1].decode(), place[2].decode()
        # some firmware writes the latitude first; a latitude above 90 degrees shows that both are swapped
        swapped = abs(float(latitude)) > 90
        cells |= {"latitude": longitude if swapped else latitude, "longitude": latitude if swapped else longitude}
    if (date := _DATE.search(text)) is not None:
        year, month, day, clock, milliseconds, microseconds = (part.decode() for part in date.groups(b""))
        fraction = f".{milliseconds}{microseconds}" if milliseconds else ""
        cells["timestamp"] = f"{year}-{month}-{day} {clock}{fraction}"
    elif (start := _BEGIN.match(text)) is not None:
        cells["elapsed time"] = b".".join(start.groups()).decode()
    return cells


def read(data: bytes, options: ReadOptions) -> ReadResult:
    """Return the telemetry ``vehicle``."""
    lines = split(data)
    begin = [match.start() for match in _BEGIN.finditer(data)]
    number = lines.number_at(begin).tolist()
    texts = [data[first:last] for first, last in zip(begin, [*begin[1:], len(data)], strict=False)]
    readings = [(i, _reading(text)) for i, text in zip(number, texts, strict=True)]
    placed = [(i, cells) for i, cells in readings if cells["latitude"] and cells["longitude"]]
    if lines.unterminated and placed and re.search(rb"[\d.]$", data):  # a truncated number may have lost digits
        del placed[-1]
    torn = lines.reject_all(sorted({*number} - {i for i, _ in placed}), "a subtitle without a position (truncated?)")
    return _pose.of_readings(lines, placed, torn, options, reader=READER.name)


READER = Reader(
    name="dji_srt", title="subtitles of a DJI drone's video (.SRT)", kinds=("telemetry",),
    sample="[latitude: 35.728] [longitude: -78.696] [rel_alt: 1.000 abs_alt: 120.000]", sniff=sniff, read=read,
)  # fmt: skip
