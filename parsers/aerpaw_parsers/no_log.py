"""Known files that are not logs but are stored with logs, so that the account of a folder names each of its files.

Each entry is a reader without kinds: its sniffer recognises the file, and its title describes it. These readers are
tried if no reader of logs recognises the content.
"""

from __future__ import annotations

import re
from collections.abc import Callable

from aerpaw_cmp.common import kml
from aerpaw_cmp.logs import matfile
from aerpaw_cmp.readers import InputError, Reader, ReadOptions, ReadResult, mostly

_STAMP = rb"(?:\[?\d{4}-\d\d-\d\d[ T][0-9:.]{8,18}\]?[ ,]{1,2})"
_UHD = re.compile(rb"\[(?:INFO|WARNING|ERROR)\] \[(?:UHD|B200|X300|MULTI_USRP|GPS|USRP|OV|CONFIG|AD936X|CORES)\]")
_LEVELS = rb"(?i)g-?net ?track|\b(?:rsrp|rssi|rxlev|rscp|level)\b(?:\W|</?[\w:]{1,20}>){0,20}-\d{2,3}\b"
_TIMED = rb"(?i)\btime|<when>|\b\d\d:\d\d:\d\d\b"
_PATTERN_MAT = re.compile(r"(?i)(rad_?pat|gain|theta\d?|phi\d?|sa\d{4}|rmwb\d{4}\w*|g[rt]_\w+|pattern\w*|antenna\w*)")

# A test of a file: a pattern in its first bytes, or a function of these bytes.
_Test = bytes | Callable[[bytes], bool]


def _holds(test: _Test, head: bytes) -> bool:
    return test(head) if callable(test) else re.search(test, head) is not None


def _not(*tests: _Test) -> _Test:
    return lambda head: not any(_holds(test, head) for test in tests)


def _mostly(pattern: bytes) -> _Test:
    return lambda head: mostly(head, re.compile(pattern))


_JSON_LEVELS = rb'(?i)"(?:rsrp|rssi|rscp|rss_\w{1,8}|sinr|pci)"\s*:'
_TEXT, _KML, _MAT = _not(rb"\0"), kml.is_kml, rb"\A" + matfile.MAGIC


def _antenna_mat(head: bytes) -> bool:
    return any(_PATTERN_MAT.fullmatch(name) for name in matfile.names_of(head))


def _refuse(what: str) -> Callable[[bytes, ReadOptions], ReadResult]:
    def read(_data: bytes, _options: ReadOptions) -> ReadResult:
        raise InputError(f"not a log: {what}", expected="one of the formats of 'aerpaw-cmp formats'")

    return read


# Name, description, and tests. The first entry whose tests all pass names the file, so narrow kinds come before wide
# ones.
_KINDS: tuple[tuple[str, str, tuple[_Test, ...]], ...] = (
    ("antenna_pattern", "a measured antenna pattern (for 'antenna: {model: file}' in flight.yaml)",
     (rb"(?im)\A[^\0]{0,380}?(?:Frequency ?= ?\d{1,6} ?\(MHz\)|Phi ?= ?-?\d{1,3}(?:\.\d{1,6})? ?\(deg\))"
      rb"|\A[^\0]{0,4080}?^(?:HORIZONTAL\s+\d{1,4}|REVNUM:,TIA)",)),
    ("antenna_grid", "antenna gain grids of MATLAB (for 'antenna: {model: gain_grid}' in flight.yaml)",
     (_MAT, _antenna_mat)),
    ("matlab_other", "MATLAB variables that are not a flight",
     (_MAT, lambda head: bool(matfile.names_of(head)), _not(_antenna_mat))),
    ("power_references", "a table of USRP reference powers",
     (rb"\A(?:\xef\xbb\xbf)?Node,Category,Channel,[^\n]{0,80}Gain,Freq_",)),
    ("antenna_gain", "antenna gain over frequency, without directions",
     (rb"\A(?:\d{1,3}\s*\n)?Frequency\tE ?Total\. ?dB",)),
    ("kml_untimed", "a KML of levels and positions without times: give the program's text log or CSV",
     (_KML, _LEVELS, _not(_TIMED))),
    ("kml_levels", "a KML with levels in an unsupported layout: give the program's text log or CSV",
     (_KML, _LEVELS, _TIMED)),
    ("wifi_scan", "a Wi-Fi scan of PawPrints (access points, no cells)",
     (rb'\A[\s\[]*\{[^\n]{0,400}(?:"log_type"\s*:\s*"wifi"|"connected_bssid")',)),
    ("wigle", "a log of WiGLE: its cells and access points are not read", (rb"\AWigleWifi-",)),
    ("sweep", "a spectrum sweep (rtl_power, hackrf_sweep): add up the bins of a channel, save time and level as CSV",
     (_mostly(rb"\d{4}-\d\d-\d\d, ?\d\d:\d\d:\d\d(?:\.\d{1,6})?, ?\d{5,12}, ?\d{5,12}, ?[\d.]{1,14}, ?\d"),)),
    ("wifi_other", "a Wi-Fi scan (access points, no cells)",
     (rb"\A(?:BSSID ?,)|\w +Scan completed|(?:\A|\n)BSS [0-9a-f:]{17}",)),
    ("subtitles", "subtitles of a video without positions",
     (rb"\A\s*1\s*\n\d\d:\d\d:\d\d,\d{3} --> ",)),
    ("pdf", "a PDF", (rb"\A%PDF-",)),
    ("at_answers", "AT answers of a modem in an unsupported form (Quectel's +QENG and +QNWCFG are supported)",
     (_mostly(_STAMP + rb"[+#][A-Z0-9]{2,12}: "),)),
    ("gnss_logger", "a log of Android's GnssLogger: save its Fix lines as CSV, with their header",
     (rb"(?m)^# ?Fix,Provider,",)),
    ("json_records", "JSON records in an unsupported layout: save them as CSV, or as lines of one object each",
     (rb'\A[\s\[]*\{[^\0]{0,2000}?"(?:time\w*|utc|rsrp|pci|lat(?:itude)?)"\s*:',
      _not(rb'"log_type"|"FeatureCollection"'))),
    ("web_page", "a web page (a login or an error page in place of the download?)",
     (rb"(?i)\A\s*(?:<!doctype html|<html\b)",)),
    ("kml_track", "a KML track with times and no levels: convert it to GPX (gpsbabel does)",
     (_KML, _not(_LEVELS), rb"<gx:Track")),
    ("kml_other", "a KML without measurements (a geofence, a map, a route for 'aerpaw-cmp predict')",
     (_KML, _not(_LEVELS), _not(rb"<gx:Track"))),
    ("gpx_other", "a GPX without points", (rb"\A[^\0]{0,4096}?<gpx\b",)),
    ("at_transcript", "a modem transcript without times (AT answers; 'aerpaw-cmp tap' logs them with times)",
     (_TEXT, rb"(?im)^\s*(?:AT[+#]|\+(?:QE|QC|QN|CM))",
      _mostly(rb"(?i)\s*(?:at[+&#a-z][^\r\n]{0,200}|[+#][A-Z0-9]{2,12}: ?[^\r\n]{0,300}|OK|ERROR|ATI)\s*$"))),
    ("nemo_summary", "a Nemo summary of a session (counts and rates, no samples)",
     (rb"\A[^\n]*\n\s*Device ID;", rb"\nMeasurement start;")),
    ("nemo_binary", "a binary Nemo measurement file (.nmfs: export it as CSV with Nemo's own tools)",
     (rb"\0", rb"(?is)\A.{0,2048}?(?:nmfs|nemo file|anite)")),
    ("uhd_console", "the console of a USRP program, without samples",
     (_TEXT, lambda head: len(_UHD.findall(head[:8192])) > 1)),
    ("radio_console", "the console of an srsRAN program without its trace (type 't' there, or log longer)",
     (_TEXT, rb"Software Radio Systems (?:LTE|RAN)|srs(?:ran|lte)/(?:ue|enb|gnb)\.(?:conf|yml)|--== srsRAN gNB"
             rb"|Built in Release mode using")),
    ("positions", "a list of positions without times",
     (lambda head: head.count(b"\n") < 40, _mostly(rb"\s*-?\d{1,3}\.\d{2,12}, ?-?\d{1,3}\.\d{2,12}\s*$"))),
    ("document", "a page of text", (_TEXT, rb"\A(?:\xef\xbb\xbf)?\s*# \w", rb"\n(?:## |\| )")),
    ("flight_script", "the console of a flight script, without positions",
     (_mostly(rb"\[[-0-9/]{10} [0-9:.]{8,18}\] "),
      rb"\[aerpawlib\]|[Ww]aypoint|Taking off|[Aa]rming|Landing")),
    ("cell_search_untimed", "a cell search of srsRAN: cells at one moment, without times",
     (rb"Found CELL \d{1,5}\.\d MHz, EARFCN=\d",)),
    ("flight_plan", "a planned route, not a flight: 'aerpaw-cmp predict' reads it",
     (rb'"fileType"\s*:\s*"Plan"|\A\s*QGC WPL \d+',)),
    ("flight_yaml", "settings of a flight: 'aerpaw-cmp report' reads them",
     (rb"(?m)\A[^\0]{0,4096}?^flight:", rb"(?m)^logs:")),
    ("settings_yaml", "a site, or settings of a calibration or a campaign ('aerpaw-cmp calibrate' or 'campaign')",
     (rb"(?m)\A[^\0]{0,4096}?^(?:origin|calibration|campaign):", rb"(?m)^(?:towers|flights|campaign):")),
    ("own_export", "samples of a report of aerpaw-cmp: use the logs of that report (or '--map' its columns)",
     (rb"\A(?:\xef\xbb\xbf)?time_utc,time_s,tower,",)),
    ("geojson_levels", "GeoJSON of levels: save its points as CSV",
     (rb'"FeatureCollection"', _JSON_LEVELS)),
    ("map", "a map: 'aerpaw-cmp site import' reads it",
     (rb'\A\s*(?:(?:<\?xml[^>]*>\s*)?<osm\b|\{[^\[]*"type"\s*:\s*"FeatureCollection"|\{[^\[]*"osm3s")',
      _not(_JSON_LEVELS))),
)  # fmt: skip


def _sniffer(tests: tuple[_Test, ...]) -> Callable[[bytes], bool]:
    return lambda head: bool(head.strip()) and all(_holds(test, head) for test in tests)


READERS: tuple[Reader, ...] = tuple(
    Reader(name=name, title=what, kinds=(), sample="", sniff=_sniffer(tests), read=_refuse(what))
    for name, what, tests in _KINDS
)
