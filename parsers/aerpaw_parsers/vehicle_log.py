"""``*_vehicle_log.txt``: the output of a flight script (stdout through ``ts``) with measured positions.

AFAR's search script writes ``Filtered data (avg): Pwr:..,P_Var:.., Qual:..,Q_Var:.., {"lat": .., "lon": .., "alt":
..}, heading:..``: the position, level and quality averaged over a stop. Altitude is above take-off, heading in
degrees clockwise from north. Waypoints, home and predictions are not positions of the aircraft and count as comments.
The streams are the telemetry ``vehicle`` at the stops, and KPIs with the averages that the script computed.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

from aerpaw_cmp.readers import NUMBER, TIME, ZONE, LineFormat, Rows, Stream, text_reader

_N = NUMBER
_PLACE = rb'\{"lat": ?(?P<lat>%s), ?"lon": ?(?P<lon>%s), ?"alt": ?(?P<alt>%s)\}' % (_N, _N, _N)
_MEANS = rb"Pwr: ?(?P<power>%s), ?P_Var: ?%s, ?Qual: ?(?P<quality>%s), ?Q_Var: ?%s, ?" % (_N, _N, _N, _N)
_ROW = re.compile(
    rb"^\[(?P<time>" + TIME + ZONE + rb")\] (?:Filtered data \(avg\): " + _MEANS
    + rb"|(?i:(?:current|vehicle|drone|uav) (?:location|position)(?: is)?:? ?))"
    + _PLACE + rb"(?:, ?heading: ?(?P<heading>%s))?[ \t]*\r?$" % _N,
    re.MULTILINE,
)  # fmt: skip


def _streams(rows: Rows) -> Iterator[Stream | None]:
    place = {"latitude_deg": rows.number("lat"), "longitude_deg": rows.number("lon"), "altitude_m": rows.number("alt")}
    yield rows.stream("telemetry", "vehicle", place | {"yaw_deg": rows.number("heading")}, source="flight script")
    for name, unit in (("power", "dB re full scale"), ("quality", "dB")):
        yield rows.stream("kpi", name, {"value": rows.number(name)}, quantity=f"mean {name}", unit=unit)


READER = text_reader(
    "vehicle_log", "flight script's console: measured positions", kinds=("telemetry", "kpi"),
    sample='[2025-01-01 12:00:07.250000] Current location is {"lat": 35.7280002, "lon": -78.6960001, "alt": 30.1}',
    lines=LineFormat(row=_ROW, mark=_ROW, torn=re.compile(rb"^\[[^\]\n]{19,40}\] Filtered data \(avg\)")),
    streams=_streams,
)  # fmt: skip
