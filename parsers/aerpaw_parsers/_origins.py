"""Each format's clock and height datum, and who says so: the file itself, its program's source, or nobody."""

from __future__ import annotations

_TS = "program: ts on the node, local wall time"
_GPS = "written: UTC of the GPS"
_TAKEOFF = "program: DroneKit relative frame, above take-off"

# ``written``, or ``program`` or ``assumed`` with what that is; of the others the reader's own word, which is assumed.
# A text with an offset, or an epoch, is written.
CLOCKS = {
    "vehicle_out": "program: aerpawlib datetime.now(), local wall time", "vehicle_log": _TS, "ardupilot_bin": _GPS,
    "mavlink_tlog": "written: UTC of the ground station", "px4_ulog": _GPS, "sounder_log": _TS,
    "flight_mat": "program: AERPAW's post-processing, local wall time",
    "sigmf": "written: offset or epoch in the meta file",
    "iq_burst": "program: get_IQ.py names files in America/New_York",
    "quectel_csv": "program: QuectelLogger datetime.now(), local wall time",
    "quectel_ri": "program: QuectelLogger datetime.now(), local wall time",
    "quectel_console": "program: QuectelLogger datetime.now(), local wall time",
    "pawprints": "written: epoch of the companion computer", "nemo_csv": "program: milliseconds from time_origin",
    "nemo_kml": "program: milliseconds from time_origin",
    "aadm_snr": "program: AADM controller datetime.now(), local wall time", "controller_log": _TS, "srsenb_log": _TS,
    "srsue_log": _TS, "cell_search": "program: cell_search's localtime(), or ts on the node", "srsran_gnb": _TS,
    "srsran_json": "program: srsRAN Project writes UTC", "oai_log": _TS, "tap_jsonl": "written: UTC",
    "generic_csv": "written",
}  # fmt: skip

HEIGHTS = {
    "vehicle_out": _TAKEOFF, "vehicle_log": _TAKEOFF,
    "ardupilot_bin": "program: RelHomeAlt, else above the first position",
    "mavlink_tlog": "program: relative_alt of MAVLink",
    "px4_ulog": "program: above home_position, else above the first position", "flight_mat": _TAKEOFF,
    "sigmf": _TAKEOFF, "quectel_ri": "program: joined with vehicleOut, above take-off",
    "gpx": "program: GPX elevations are above sea level; above the first point",
    "pawprints": "program: Android altitudes are above the ellipsoid; above the first position",
    "generic_csv": "written",
}  # fmt: skip
