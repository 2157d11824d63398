"""Files that lie beside logs and are none: named, so that a folder's account says what each of its files is.

Each entry is a reader without kinds: its sniffer knows the file, its title says what it is.
"""

from __future__ import annotations

import re
from collections.abc import Callable

from aerpaw_cmp.common import kml
from aerpaw_cmp.common.errors import InputError
from aerpaw_cmp.logs.matfile import MAGIC
from aerpaw_cmp.logs.readers import Reader, ReadOptions
from aerpaw_cmp.logs.records import ReadResult
from aerpaw_cmp.logs.text import lines as _lines

from . import (
    cell_search,
    flight_mat,
    gnettrack_kml,
    gpx,
    iq_burst,
    nemo_kml,
    oai_log,
    srsenb_log,
    srsran_gnb,
    srsue_log,
    vehicle_log,
)

_PATTERN = re.compile(rb"Frequency ?= ?\d{1,6} ?\(MHz\)")
_CUT = re.compile(rb"Phi ?= ?-?\d{1,3}(?:\.\d{1,6})? ?\(deg\)")
_GAIN = re.compile(rb"\A(?:\d{1,3}\s*\n)?Frequency\tE ?Total\. ?dB")
_LEVELS = re.compile(rb"(?i)g-?net ?track|\b(?:rsrp|rxlev|rscp|level)\b\W{0,20}-?\d{2,3}\b")
_TIMED = re.compile(rb"(?i)\btime|<when>|\b\d\d:\d\d:\d\d\b")
_WIFI = re.compile(rb'\A[\s\[]*\{[^\n]{0,400}"log_type"\s*:\s*"wifi"|\A[\s\[]*\{[^\n]{0,400}"connected_bssid"')
_STAMP = rb"(?:\[?\d{4}-\d\d-\d\d[ T][0-9:.]{8,18}\]?[ ,]{1,2})"
_NMEA = re.compile(_STAMP + rb"?\$[A-Z]{2}(?:GGA|RMC|GSA|GSV|GLL|VTG|ZDA),")
_WIFI_OTHER = re.compile(rb"\A(?:WigleWifi-|BSSID ?,)|\w +Scan completed|(?:\A|\n)BSS [0-9a-f:]{17}")
_ANSWERS = re.compile(_STAMP + rb"[+#][A-Z0-9]{2,12}: ")
_SUBTITLES = re.compile(rb"\A\s*1\s*\n\d\d:\d\d:\d\d,\d{3} --> ")
_WEB = re.compile(rb"(?i)\A\s*(?:<!doctype html|<html\b)")
_CELL_SEARCH = re.compile(rb"Found CELL \d{1,5}\.\d MHz, EARFCN=\d")
_PLAN = re.compile(rb'"fileType"\s*:\s*"Plan"|\A\s*QGC WPL \d+')
_PLANNING = re.compile(rb"(?im)^(?:HORIZONTAL\s+\d{1,4}|REVNUM:,TIA)")
_PATTERN_MAT = re.compile(r"(?i)(rad_?pat|gain|theta\d?|phi\d?|sa\d{4}|rmwb\d{4}\w*|g[rt]_\w+|pattern\w*|antenna\w*)")
_POWER_REFS = re.compile(rb"\A(?:\xef\xbb\xbf)?Node,Category,Channel,[^\n]{0,80}Gain,Freq_")
_UHD = re.compile(rb"\[(?:INFO|WARNING|ERROR)\] \[(?:UHD|B200|X300|MULTI_USRP|GPS|USRP|OV|CONFIG|AD936X|CORES)\]")
_RADIO = re.compile(
    rb"Software Radio Systems (?:LTE|RAN)|srs(?:ran|lte)/(?:ue|enb|gnb)\.(?:conf|yml)|--== srsRAN gNB"
    rb"|Built in Release mode using"
)
_PLACE = re.compile(rb"\s*-?\d{1,3}\.\d{2,12}, ?-?\d{1,3}\.\d{2,12}\s*")
_AT = re.compile(rb"(?i)\s*(?:at[+&#a-z][^\r\n]{0,200}|[+#][A-Z0-9]{2,12}: ?[^\r\n]{0,300}|OK|ERROR|ATI)\s*")
_NEMO_BINARY = re.compile(rb"(?i)nmfs|nemo file|anite")
_SCRIPT_TALK = re.compile(rb"\[[-0-9/]{10} [0-9:.]{8,18}\] ")


# How a file is known: a function of its first bytes, or a pattern that stands in them.
_Test = Callable[[bytes], bool] | re.Pattern[bytes]


def _texts(head: bytes) -> list[bytes]:
    return _lines.first_lines(head, 60)


def _antenna_text(head: bytes) -> bool:
    if b"\0" in head[:400]:
        return False
    return any(form.search(head[:400]) for form in (_PATTERN, _CUT)) or _PLANNING.search(head[:4096]) is not None


def _antenna_mat(head: bytes) -> bool:
    if not head.startswith(MAGIC) or flight_mat.sniff(head):
        return False
    names = flight_mat.names_of(head)
    return any(_PATTERN_MAT.fullmatch(name) for name in names)


def _other_mat(head: bytes) -> bool:
    if not head.startswith(MAGIC) or flight_mat.sniff(head) or iq_burst.sniff(head):
        return False
    return not _antenna_mat(head) and bool(flight_mat.names_of(head))


def _kml(head: bytes) -> bool:
    return kml.is_kml(head) and not nemo_kml.sniff(head) and not gnettrack_kml.sniff(head)


def _plain_kml(head: bytes) -> bool:
    return _kml(head) and _LEVELS.search(head) is None


def _gpx(head: bytes) -> bool:
    return re.search(rb"<gpx\b", head[:4096]) is not None and not gpx.sniff(head)


def _nmea(head: bytes) -> bool:
    return _lines.mostly(head, _NMEA)


def _transcript(head: bytes) -> bool:
    lines = _texts(head)
    known = sum(_AT.fullmatch(line) is not None for line in lines)
    return (
        b"\0" not in head
        and 2 * known > len(lines)
        and any(line.lstrip()[:3].upper() in (b"AT+", b"AT#", b"+QE", b"+QC", b"+QN", b"+CM") for line in lines)
    )


def _nemo_summary(head: bytes) -> bool:
    lines = _texts(head)
    return (
        len(lines) > 3
        and lines[1].startswith(b"Device ID;")
        and any(line.startswith(b"Measurement start;") for line in lines)
    )


def _nemo_binary(head: bytes) -> bool:
    return b"\0" in head and _NEMO_BINARY.search(head[:2048]) is not None


def _uhd(head: bytes) -> bool:
    return (
        b"\0" not in head
        and _UHD.search(head) is not None
        and sum(_UHD.search(line) is not None for line in _texts(head)) >= 2
    )


def _radio_console(head: bytes) -> bool:
    return b"\0" not in head and _RADIO.search(head) is not None and not any(
        sniff(head) for sniff in (srsue_log.READER.sniff, srsenb_log.READER.sniff, srsran_gnb.sniff, oai_log.sniff)
    )  # fmt: skip


def _places(head: bytes) -> bool:
    lines = _texts(head)
    return 0 < len(lines) < 40 and sum(_PLACE.fullmatch(line) is not None for line in lines) * 2 >= len(lines)


def _document(head: bytes) -> bool:
    lines = _texts(head)
    return b"\0" not in head and bool(lines) and re.match(rb"(?:\xef\xbb\xbf)?# \w", lines[0]) is not None and any(
        line.startswith((b"## ", b"| ")) for line in lines
    )  # fmt: skip


def _flight_talk(head: bytes) -> bool:
    lines = _texts(head)
    stamped = sum(_SCRIPT_TALK.match(line) is not None for line in lines)
    marks = (b"[aerpawlib]", b"Waypoint", b"waypoint", b"Taking off", b"Arming", b"arming", b"Landing")
    return 2 * stamped > len(lines) and any(mark in head for mark in marks) and not vehicle_log.READER.sniff(head)


def _yaml(head: bytes) -> bool:
    return re.search(rb"(?m)^flight:", head[:4096]) is not None and re.search(rb"(?m)^logs:", head) is not None


def _sniffer(test: _Test) -> Callable[[bytes], bool]:
    known = test if callable(test) else lambda head: test.search(head) is not None
    return lambda head: bool(head.strip()) and known(head)


def _refuse(what: str) -> Callable[[bytes, ReadOptions], ReadResult]:
    def read(_data: bytes, _options: ReadOptions) -> ReadResult:
        raise InputError(f"no log: {what}", expected="one of the formats of 'aerpaw-cmp formats'")

    return read


_SITE = re.compile(rb"(?m)^origin:[^\0]*^towers:")
_MAP = re.compile(
    rb'\A\s*(?:<\?xml[^>]*>\s*)?<osm\b|\A\s*\{[^\[]*"type"\s*:\s*"FeatureCollection"|\A\s*\{[^\[]*"osm3s"'
)

_KINDS: tuple[tuple[str, str, _Test], ...] = (
    ("antenna_pattern", "a measured antenna pattern (for 'antenna: {model: file}' in flight.yaml)", _antenna_text),
    ("antenna_grid", "antenna gain grids of MATLAB (for 'antenna: {model: gain_grid}' in flight.yaml)", _antenna_mat),
    ("matlab_other", "MATLAB variables that are no flight", _other_mat),
    ("power_references", "a table of USRP reference powers", _POWER_REFS),
    ("antenna_gain", "antenna gain over frequency, without directions", _GAIN),
    ("kml_untimed", "a KML of levels and positions without times: give the program's text log or CSV",
     lambda head: _kml(head) and _LEVELS.search(head) is not None and _TIMED.search(head) is None),
    ("kml_levels", "a KML with levels in a layout that is not read: give the program's text log or CSV",
     lambda head: _kml(head) and _LEVELS.search(head) is not None and _TIMED.search(head) is not None),
    ("wifi_scan", "a Wi-Fi scan of PawPrints (access points, no cells)", _WIFI),
    ("wifi_other", "a Wi-Fi scan (access points, no cells)", _WIFI_OTHER),
    ("subtitles", "subtitles of a drone's video: convert them to CSV or GPX", _SUBTITLES),
    ("pdf", "a PDF", re.compile(rb"\A%PDF-")),
    ("at_answers", "AT answers of a modem whose forms are not read (Quectel's +QENG and +QNWCFG are)",
     lambda head: _lines.mostly(head, _ANSWERS)),
    ("nmea", "NMEA sentences of a receiver: convert them to GPX (gpsbabel does)", _nmea),
    ("web_page", "a web page (a login or an error page in place of the download?)", _WEB),
    ("kml_track", "a KML track with times and no levels: convert it to GPX (gpsbabel does)",
     lambda head: _plain_kml(head) and b"<gx:Track" in head),
    ("kml_other", "a KML without measurements (a geofence, a map, a route for 'aerpaw-cmp predict')",
     lambda head: _plain_kml(head) and b"<gx:Track" not in head),
    ("gpx_other", "a GPX without points", _gpx),
    ("at_transcript", "a modem transcript without times (AT answers; 'aerpaw-cmp tap' logs them with times)",
     _transcript),
    ("nemo_summary", "a Nemo summary of a session (counts and rates, no samples)", _nemo_summary),
    ("nemo_binary", "a binary Nemo measurement file (.nmfs: export it as CSV with Nemo's own tools)", _nemo_binary),
    ("uhd_console", "the console of a USRP program, without samples", _uhd),
    ("radio_console", "the console of an srsRAN program without its trace (type 't' there, or log longer)",
     _radio_console),
    ("positions", "a list of positions without times", _places),
    ("document", "a page of text", _document),
    ("flight_script", "the console of a flight script, without positions", _flight_talk),
    ("cell_search_untimed", "a cell search of srsRAN: cells at one moment, without times",
     lambda head: _CELL_SEARCH.search(head) is not None and not cell_search.sniff(head)),
    ("flight_plan", "a planned route, not a flight: 'aerpaw-cmp predict' reads it",
     _PLAN),
    ("flight_yaml", "a flight file of settings: give it to 'report'", _yaml),
    ("site_yaml", "a site: name it under 'site:' in flight.yaml", _SITE),
    ("map", "a map: 'aerpaw-cmp site import' reads it", _MAP),
)  # fmt: skip

READERS: tuple[Reader, ...] = tuple(
    Reader(name=name, title=what, kinds=(), sample="", sniff=_sniffer(test), read=_refuse(what))
    for name, what, test in _KINDS
)
