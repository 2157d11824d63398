"""``*_vehicle_log.txt``: what a flight script says (stdout through ``ts``), of which the measured positions are read.

AFAR's search script writes ``Filtered data (avg): Pwr:..,P_Var:.., Qual:..,Q_Var:.., {"lat": .., "lon": .., "alt":
..}, heading:..``: the position, level and quality averaged over a stop. Altitude is above take-off, heading in
degrees clockwise from north. Waypoints, home and predictions are no positions of the aircraft and count as talk.
"""

from __future__ import annotations

import re

from aerpaw_cmp.logs.readers import Reader, ReadOptions
from aerpaw_cmp.logs.records import ReadResult

from . import _lines, _rows, _time

_N = _lines.NUMBER
_PLACE = rb'\{"lat": ?(?P<lat>%s), ?"lon": ?(?P<lon>%s), ?"alt": ?(?P<alt>%s)\}' % (_N, _N, _N)
_MEANS = rb"Pwr: ?(?P<power>%s), ?P_Var: ?%s, ?Qual: ?(?P<quality>%s), ?Q_Var: ?%s, ?" % (_N, _N, _N, _N)
_ROW = re.compile(
    rb"^\[(?P<time>" + _time.TIME + rb")\] (?:Filtered data \(avg\): " + _MEANS
    + rb"|(?i:(?:current|vehicle|drone|uav) (?:location|position)(?: is)?:? ?))"
    + _PLACE + rb"(?:, ?heading: ?(?P<heading>%s))?[ \t]*\r?$" % _N,
    re.MULTILINE,
)  # fmt: skip
_TORN = re.compile(rb"^\[[^\]\n]{19,40}\] Filtered data \(avg\)")


def sniff(head: bytes) -> bool:
    """Whether it is a console that tells where the aircraft is."""
    return head.startswith(b"[") and _ROW.search(head) is not None


def read(data: bytes, options: ReadOptions) -> ReadResult:
    """Telemetry ``vehicle`` at the stops, and the script's averages as KPIs; UsageError if no time zone is given."""
    torn = _rows.torn(_TORN, "an incomplete line of averages (torn line?)")
    rows = _rows.matched(data, _ROW, options, reader="vehicle_log", reason=torn)
    place = {"latitude_deg": rows.number("lat"), "longitude_deg": rows.number("lon"), "altitude_m": rows.number("alt")}
    place["yaw_deg"] = rows.number("heading")
    kpis = (("power", "dB re full scale"), ("quality", "dB"))
    return rows.result([
        rows.stream("telemetry", "vehicle", place, source="flight script"),
        *(rows.stream("kpi", name, {"value": rows.number(name)}, quantity=f"mean {name}", unit=u) for name, u in kpis),
    ])  # fmt: skip


READER = Reader(
    name="vehicle_log",
    title="flight script's console: measured positions",
    kinds=("telemetry", "kpi"),
    sample='[2025-01-01 12:00:07.250000] Current location is {"lat": 35.7280002, "lon": -78.6960001, "alt": 30.1}',
    sniff=sniff,
    read=read,
)
