"""The published rank-indicator table (Dryad wh70rxx06): ``ID,Time and date,Longitude,Latitude,Altitude,NR RI``.

RI counts data layers from 1, as the modem wrote it; 0 means no CSI. Times are local wall time. The result is
the rank stream ``nr5g_csi`` with the positions of the table.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

import numpy as np

from aerpaw_cmp.readers import BOM, NUMBER, TIME, ZONE, LineFormat, Rows, Stream, text_reader

_CELL = rb', ?"?(?P<%s>' + NUMBER + rb'|nan|NaN|)"?'
_ROW = re.compile(
    rb'^"?\d{1,12}(?:\.0)?"?, ?"?(?P<time>' + TIME + ZONE + rb')"?'
    + b"".join(_CELL % name for name in (b"longitude_deg", b"latitude_deg", b"altitude_m", b"ri")) + rb"[ \t]*\r?$",
    re.MULTILINE,
)  # fmt: skip


def _streams(rows: Rows) -> Iterator[Stream | None]:
    place = {name: rows.number(name) for name in ("latitude_deg", "longitude_deg", "altitude_m")}
    ri, lost = rows.number("ri"), ~((np.abs(place["latitude_deg"]) <= 90) & (np.abs(place["longitude_deg"]) <= 180))
    values = rows.rank(ri, none=ri == 0) | {name: np.where(lost, np.nan, column) for name, column in place.items()}
    rows.mark(lost, "no_fix")
    name = rows.options.channel or "nr5g_csi"
    yield rows.stream("rank", name, values, channel=name, ri_base="one", source="CSI report")


_HEADER = BOM + rb'(?i:"?ID"?, ?"?Time and date"?, ?"?Longitude"?, ?"?Latitude"?, ?"?Altitude"?, ?"?NR RI"?)\s*'
READER = text_reader(
    "quectel_ri", "published Quectel NR rank table (six columns)", kinds=("rank",), streams=_streams,
    sample="8,2025-01-01 12:00:07.250,-78.6960001,35.7280001,30.1,2", lines=LineFormat(
        row=_ROW, header=re.compile(_HEADER), fields=6, otherwise="the time or a number has another form"
    ),
)  # fmt: skip
