"""The clock and height datum of each format, and their source: the file, its program, or an assumption."""

from __future__ import annotations

# Each key is the source of the clock (``written``, ``program`` or ``assumed``) and its meaning; the value lists
# readers. For readers that are not listed, the source is assumed. Times with an offset and epochs always count as
# written.
_CLOCKS = {
    "program: ts on the node, local wall time":
        "vehicle_log sounder_log controller_log srsenb_log srsue_log srsran_gnb oai_log",
    "program: aerpawlib datetime.now(), local wall time": "vehicle_out",
    "program: QuectelLogger datetime.now(), local wall time": "quectel_csv quectel_ri quectel_console",
    "program: DJI, the camera's local time": "dji_srt",
    "program: AADM controller datetime.now(), local wall time": "aadm_snr",
    "program: AERPAW's post-processing, local wall time": "flight_mat",
    "program: get_IQ.py names files in America/New_York": "iq_burst",
    "program: cell_search's localtime(), or ts on the node": "cell_search",
    "program: milliseconds from time_origin": "nemo_csv nemo_kml",
    "program: srsRAN Project writes UTC": "srsran_json",
    "written: UTC of the GPS": "ardupilot_bin px4_ulog",
    "written: UTC of the ground station": "mavlink_tlog",
    "written: offset or epoch in the meta file": "sigmf",
    "written: epoch of the companion computer": "pawprints",
    "written: UTC": "tap_jsonl nmea rtklib_pos",
    "written": "generic_csv",
}  # fmt: skip
_HEIGHTS = {
    "program: DroneKit relative frame, above take-off": "vehicle_out vehicle_log flight_mat sigmf",
    "program: RelHomeAlt, else above the first position": "ardupilot_bin",
    "program: relative_alt of MAVLink": "mavlink_tlog",
    "program: above home_position, else above the first position": "px4_ulog",
    "program: joined with vehicleOut, above take-off": "quectel_ri",
    "program: GPX elevations are above sea level; above the first point": "gpx",
    "program: Android altitudes are above the ellipsoid; above the first position": "pawprints",
    "written": "generic_csv",
}
CLOCKS, HEIGHTS = (
    {name: origin for origin, names in table.items() for name in names.split()} for table in (_CLOCKS, _HEIGHTS)
)
