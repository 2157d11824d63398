"""Synthetic files with known content: the variations of real programs, for each format.

``truth.yaml`` contains the text formats. A case has a file name, its bytes, and the expected columns of each stream.
``time`` is in seconds after 2025-03-02 15:00:00 UTC, which is 10:00:00 in New York.
"""

from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

import numpy as np
import pandas as pd
import pytest
import yaml

from aerpaw_cmp.logs.files import whole_lines
from aerpaw_cmp.logs.ingest import ingest
from aerpaw_cmp.logs.readers import ReadOptions, identify
from tests.frames import assert_same_result
from tests.parsers import autopilots, samples

BEGIN = np.datetime64("2025-03-02T15:00:00")
LOCAL = ReadOptions(timezone="America/New_York")
Truth = dict[str, dict[str, list[Any]]]


@dataclass(frozen=True)
class Case:
    """A file and its content: columns and attributes of its streams, words of a warning and of a reason."""

    name: str
    data: str | bytes
    truth: Truth
    reader: str
    options: ReadOptions = LOCAL
    about: dict[str, dict[str, Any]] = field(default_factory=dict)
    warned: str = ""
    refused: str = ""


def written(name: str) -> dict[str, Any]:
    """Read a table in this folder."""
    content = Path(__file__).with_name(f"{name}.yaml").read_bytes()
    table: dict[str, Any] = yaml.load(content, getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    return table


def written_cases() -> dict[str, Case]:
    """Those of ``truth.yaml``."""
    out = {}
    for name, case in written("truth").items():
        data = samples.FILES[case.pop("sample")] if "sample" in case else case.pop("text")
        options = replace(LOCAL, time_origin=case.pop("time_origin", None))
        out[name] = Case(case.pop("file", name), data, case.pop("streams"), options=options, **case)
    return out


CASES = written_cases()


# --- binary logs, MATLAB and the tap: the bytes are those of tests/parsers/autopilots.py and samples.py -------------------

POSE = {
    "time": [0.25 + i for i in range(5)], "latitude_deg": [35.73] * 5, "longitude_deg": [-78.7] * 5,
    "altitude_m": [0.0, 1.0, 2.0, 3.0, 4.0], "roll_deg": [1.5] * 5, "pitch_deg": [-2.5] * 5, "yaw_deg": [90.0] * 5,
    "velocity_north_mps": [1.5] * 5, "velocity_east_mps": [2.5] * 5, "velocity_down_mps": [-0.5] * 5, "fix": [4] * 5,
    "satellites": [14] * 5,
}  # fmt: skip
OLD_FLASH = autopilots.dataflash().replace(b"POS\0", b"PXX\0").replace(b"XKF1", b"NKF1")
MERGED_FLIGHT: Truth = {
    "vehicle": {
        "time": [0.25, 0.51, 0.77, 1.03, 1.29],
        "latitude_deg": [35.73, 35.73025, 35.7305, 35.73075, 35.731],
        "altitude_m": [0.5, 10.5, 20.5, 30.5, 40.5],
        "pitch_deg": [-3.0] * 5,
        "yaw_deg": [350.0, 355.0, 0.0, 5.0, 10.0],
        "velocity_north_mps": [2.0] * 5,
    },
    "USRP1": {"rss_db": [-40.0, -41.0, np.nan, -43.0, -44.0]},
    "USRP2": {"rss_db": [-45.0, -45.25, -45.5, -45.75, -46.0]},
}
FROM_TEN = replace(LOCAL, time_origin="2025-03-02T15:00:00Z")
TAP: Truth = {
    "nr5g": {"time": [0.202, 0.702], "rank": [2, np.nan], "mcs": [11, np.nan], "rsrp_dbm": [-80, -80]},
    "nr5g_rsrp": {"time": [0.102], "rss_db": [-80], "sinr_db": [20]},
}
EXCHANGE = '{{"kind":"exchange","query":"{query}","status":"{status}","flags":[],"n":{n},{times},"decoded":{decoded}'


def exchange(n: int, place: str, query: str, decoded: str, status: str = "ok") -> bytes:
    """Return a line of the tap's log. ``place`` contains hundredths of a second."""
    times = samples.TAP_TIMES.format(place)
    return samples.tap_line(EXCHANGE.format(query=query, status=status, n=n, times=times, decoded=decoded))


BINARY: dict[str, tuple[str, str, bytes, Truth, ReadOptions]] = {
    "dataflash": ("ardupilot_bin", "x.bin", autopilots.dataflash(), {"vehicle": POSE}, LOCAL),
    "dataflash of 2017, with positions of the receiver alone": (
        "ardupilot_bin", "x.bin", OLD_FLASH, {"vehicle": POSE | {"altitude_m": [0.0] * 5}}, LOCAL
    ),
    "MAVLink 1": ("mavlink_tlog", "x.tlog", autopilots.tlog(1), {"vehicle": POSE}, LOCAL),
    "MAVLink 2": ("mavlink_tlog", "x.tlog", autopilots.tlog(2), {"vehicle": POSE}, LOCAL),
    "MAVLink, a second vehicle for a short while": (
        "mavlink_tlog", "x.tlog", autopilots.tlog(2) + autopilots.tlog(2, system=7, count=2), {"vehicle_1": POSE}, LOCAL
    ),
    **{
        f"PX4, position of the {place}": ("px4_ulog", "x.ulg", autopilots.ulog(place), {"vehicle": POSE}, LOCAL)
        for place in ("estimator", "integers", "doubles")
    },
    "MATLAB, two channels": ("flight_mat", "x.mat", samples.mat_flight(), MERGED_FLIGHT, LOCAL),
    "MATLAB 7.3": ("flight_mat", "x.mat", samples.mat_73(), MERGED_FLIGHT, LOCAL),
    "MATLAB, LTE: the text is local, the epoch UTC": (
        "flight_mat", "x.mat", samples.lte_flight(),
        {
            "vehicle": {"time": [0.25, 0.35, 0.45, 0.55, 0.65], "longitude_deg": [-78.7, -78.69975, -78.6995, -78.69925, -78.699]},
            "RSRP": {"rss_db": [17.5, 17.25, np.nan, -150.0, 16.5]},
            "RSRQ": {"value": [-6.5] * 5},
        }, LOCAL,
    ),
    "MATLAB, processed: rows are counted, the heading is in radians": (
        "flight_mat", "x.mat", samples.processed_flight(),
        {
            "vehicle": {"time": [0.0, 0.1, 0.2, 0.3], "yaw_deg": [90.0] * 4, "altitude_m": [30.0] * 4},
            "RSRP": {"rss_db": [-80.0, -80 - 10 / 3, -80 - 20 / 3, -90.0]},
        }, FROM_TEN,
    ),
    "I/Q of two channels": (
        "iq_burst", samples.IQ_NAME, samples.iq_mat(),
        {"USRP1": {"time": [0.25], "rss_db": [-20.0]}, "USRP2": {"time": [0.25], "rss_db": [-40.0]}}, LOCAL,
    ),
    "I/Q of one channel, one row; time in microseconds": (
        "iq_burst", "results_3320000000_2000000_2025_03_02_10_00_01_500250.mat", samples.saved({"IQ": np.full((1, 64), 3 + 4j)}),
        {"USRP1": {"time": [1.50025], "rss_db": [10 * np.log10(25.0)]}}, LOCAL,
    ),
    "I/Q without a signal": (
        "iq_burst", samples.IQ_NAME, samples.saved({"IQ": np.zeros((1, 8), dtype=complex)}), {"USRP1": {"rss_db": [np.nan]}}, LOCAL,
    ),
    "tap: cell, rank, no CSI, a torn line": ("tap_jsonl", "x.jsonl", samples.FILES["tap_jsonl/session"], TAP, LOCAL),
    "tap: an answer that failed, then LTE": (
        "tap_jsonl", "x.jsonl",
        samples.FILES["tap_jsonl/session"].rpartition(b'{"kind"')[0] + exchange(4, "80", "nr5g_csi", "{}", "timeout")
        + exchange(5, "90", "lte_csi", '{"rank":1,"ri_raw":0,"cqi":7}'),
        {
            "nr5g": {"time": [0.202, 0.702, 0.802], "rank": [2, np.nan, np.nan], "flag": ["", "no_csi", "status:timeout"]},
            "lte": {"time": [0.902], "rank": [1], "ri_raw": [0], "cqi": [7]},
        }, LOCAL,
    ),
    "tap: the cell was asked longer ago than two seconds": (
        "tap_jsonl", "x.jsonl",
        samples.FILES["tap_jsonl/session"].splitlines(keepends=True)[0] + exchange(1, "00", "servingcell", '{"nr":{"rsrp_dbm":-70,"sinr_db":5}}')
        + exchange(2, "10", "nr5g_csi", '{"rank":3,"ri_raw":3}').replace(b"1740927600", b"1740927602"),
        {"nr5g_rsrp": {"time": [0.002], "rss_db": [-70]}}, LOCAL,
    ),
    "tap: an answer that lost its band is of the same cell": (
        "tap_jsonl", "x.jsonl", samples.FILES["tap_jsonl/session"].splitlines(keepends=True)[0]
        + exchange(1, "00", "servingcell", '{"nr":{"pcid":7,"arfcn":648000,"band":78,"rsrp_dbm":-70}}')
        + exchange(2, "10", "servingcell", '{"nr":{"pcid":7,"arfcn":648000,"rsrp_dbm":-71}}'),
        {"nr5g_rsrp": {"rss_db": [-70, -71]}}, LOCAL,
    ),
}  # fmt: skip
CASES |= {name: Case(file, data, truth, reader, how) for name, (reader, file, data, truth, how) in BINARY.items()}
SILENT = ["", "", "out_of_coverage", "", ""]
CASES |= {
    case.name: case
    for case in (
        Case("MATLAB, two channels: units and silence", samples.mat_flight(), {"USRP1": {"flag": SILENT}}, "flight_mat",
             about={"USRP1": {"unit": "dB re full scale"}}),
        Case("MATLAB, LTE: unit and silence", samples.lte_flight(), {key: {"flag": SILENT} for key in ("RSRP", "RSRP2")},
             "flight_mat", about={"RSRP": {"quantity": "RSRP", "unit": "dB re full scale"}}),
        Case("MATLAB, processed: no clock", samples.processed_flight(), {"vehicle": {"yaw_deg": [90.0] * 4}}, "flight_mat",
             about={"vehicle": {"clock": "relative"}, "RSRP": {"unit": "dBm"}}, warned="no clock"),
    )
}  # fmt: skip


def shown(values: Any) -> list[Any]:
    """A column as it is compared: times in seconds, numbers to the microunit."""
    if values.dtype.kind == "M":
        values = (values - BEGIN) / np.timedelta64(1, "s")
    return [round(v, 6) if isinstance(v, float) else v for v in values.tolist()]


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_what_a_file_says_comes_out(case: Case) -> None:
    data = case.data if isinstance(case.data, bytes) else case.data.encode()
    reader, options = identify(data), replace(case.options, file_name=case.name)
    assert reader.name == case.reader
    result = reader.read(data, options)
    if reader.read_pieces is not None:
        pieces = whole_lines(data[i : i + 37] for i in range(0, len(data), 37))
        assert_same_result(reader.read_pieces(pieces, options), result)
    streams = {stream.name: stream.frame for stream in result.streams}
    for name, columns in case.truth.items():
        assert name in streams, f"{name} is not among {list(streams)}"
        for column, expected in columns.items():
            assert shown(streams[name][column].to_numpy()) == pytest.approx(expected, nan_ok=True), f"{name}: {column}"
    about = {stream.name: stream.attributes for stream in result.streams}
    for name, said in case.about.items():
        assert {key: about[name][key] for key in said} == said
    assert case.warned in " ".join(result.warnings)
    assert case.refused in " ".join(line.reason for line in result.rejected)


# --- every format at every kind of time ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class Form:
    """A format of one row per instant, as ``forms.yaml`` describes it."""

    row: str
    stream: str
    column: str
    head: str = ""
    utc: bool = False
    name: str = "log.txt"


FORMS = {name: Form(**form) for name, form in written("forms").items()}
NEW_YORK = ZoneInfo("America/New_York")
INSTANTS = {
    "morning": datetime(2025, 3, 2, 10, tzinfo=NEW_YORK),
    "over midnight": datetime(2025, 7, 2, 23, 59, 58, tzinfo=NEW_YORK),
    "the hour that the clock had twice": datetime(2025, 11, 2, 1, 30, tzinfo=NEW_YORK),
    "new year, in winter": datetime(2024, 12, 31, 18, 59, 59, tzinfo=NEW_YORK),
}
VALUES = [3, 1, 2, 4]
# Where a value comes out, its sign, and what the row writes above it.
COLUMNS = {
    "level": ("rss_db", 1, 0.5), "-level": ("rss_db", -1, 0.0), "altitude_m": ("altitude_m", 1, 0.5),
    "above the first": ("altitude_m", 1, -3.0),
}  # fmt: skip


def file_of(form: Form, begin: datetime) -> tuple[str, list[np.datetime64]]:
    """The file, and the instants of its rows."""
    text, instants = form.head, []
    for i, v in enumerate(VALUES):
        utc = begin.astimezone(timezone.utc) + timedelta(seconds=i, milliseconds=250)
        wall = utc if form.utc else utc.astimezone(NEW_YORK)
        stamp = wall.strftime("%Y-%m-%d %H:%M:%S.%f")[:23]
        stamp += "000" if form.row.startswith("[{t}]") else ""
        text += form.row.format(
            i=4 * i if "07o" in form.row else i, v=v, t=stamp, s=utc.timestamp(), ms=round(1e3 * utc.timestamp())
        )
        instants.append(np.datetime64(utc.replace(tzinfo=None), "ns"))
    return text, instants


@pytest.mark.parametrize("when", INSTANTS)
@pytest.mark.parametrize("name", FORMS)
def test_every_format_at_every_kind_of_time(name: str, when: str) -> None:
    form = FORMS[name]
    text, instants = file_of(form, INSTANTS[when])
    options = replace(LOCAL, file_name=form.name)
    for data in (text.encode(), b"\r\n" + text.replace("\n", "\r\n").encode()):
        reader = identify(data)
        assert reader.name == name.split(",")[0]
        result = reader.read(data, options)
        (frame,) = (stream.frame for stream in result.streams if stream.name == form.stream)
        assert frame["time"].tolist() == [pd.Timestamp(instant) for instant in instants]
        column, sign, above = COLUMNS.get(form.column, (form.column, 1, 0.0))
        assert (sign * frame[column] - above).tolist() == pytest.approx(VALUES)
        twice = when.startswith("the hour") and not form.utc
        assert frame["flag"].str.contains("ambiguous_local_time").tolist() == [twice] * len(VALUES)
        if reader.read_pieces is not None:
            pieces = whole_lines(data[i : i + 37] for i in range(0, len(data), 37))
            assert_same_result(reader.read_pieces(pieces, options), result)


ORIGINS = {
    "x_vehicleOut.txt": ("vehicle", "program", "program", None),
    "utc_vehicleOut.txt": ("vehicle", "written", "program", None),
    "x_power_log.txt": ("power", "program", None, "assumed"), "gnb.json": ("gnb", "program", None, "written"),
    "nobody.csv": ("vehicle", "assumed", "assumed", None), "amsl.csv": ("vehicle", "assumed", "written", None),
}  # fmt: skip
ROW = '1,-78.7,35.73,30.5,"(0.1,1.5,0.1)","(0.0,5.0,0.1)",48.1,2025-03-02 10:00:07.000000{zone},4,18\n'
FILES = {
    "x_vehicleOut.txt": ROW.format(zone=""), "utc_vehicleOut.txt": ROW.format(zone="+00:00"),
    "x_power_log.txt": "[2025-03-02 10:00:01.000000] 0000000        -20.5000\n", "gnb.json": CASES["srsRAN Project's JSON with texts is UTC"].data,
    "nobody.csv": CASES["a table of nobody that begins in flight keeps its heights"].data,
    "amsl.csv": CASES["altitudes that the header calls above sea level"].data,
}  # fmt: skip


@pytest.mark.parametrize("name", ORIGINS)
def test_a_stream_says_where_its_clock_height_and_identity_are_known_from(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(FILES[name])
    (file,) = ingest(tmp_path / name, options=LOCAL)
    stream, clock, height, identity = ORIGINS[name]
    about = next(candidate.attributes for candidate in file.result.streams if candidate.name == stream)
    assert (about["clock_from"], about.get("height_from"), about.get("identity_from")) == (clock, height, identity)
    assert clock == "written" or about["clock_source"]
