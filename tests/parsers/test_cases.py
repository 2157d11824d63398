"""Logs that were read wrong once, reduced and invented: each stands for a kind, with cousins in other words and orders.

``cases/`` holds the files; right values follow from what the files say, not from what a reader gives.
"""

import json
import zipfile
import zlib
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from aerpaw_cmp.common.errors import InputError, UsageError
from aerpaw_cmp.jobs.run import mapping
from aerpaw_cmp.logs.ingest import ingest
from aerpaw_cmp.logs.readers import ReadOptions
from aerpaw_cmp.logs.records import ReadResult

CASES = Path(__file__).parent / "cases"
NEW_YORK = {"timezone": "America/New_York"}
START = "2025-06-10T14:00:00"
NAN = float("nan")


@dataclass(frozen=True)
class Right:
    """What a log says: columns of streams by name, the first time, words of a warning, parts of attributes."""

    streams: dict[str, dict[str, list[float]]]
    start: str = START
    said: str = ""
    about: dict[str, object] = field(default_factory=dict)
    maps: tuple[str, ...] = ()
    options: dict[str, str] = field(default_factory=dict)


def read(path: Path, maps: tuple[str, ...], options: dict[str, str]) -> ReadResult:
    keys = {**options, **(mapping(list(maps)) if maps else {})}
    (file,) = ingest([path], options=ReadOptions(**keys), reader="generic_csv" if maps else None)
    return file.result


def check(result: ReadResult, right: Right) -> None:
    streams = {stream.name: stream for stream in result.streams}
    assert right.streams.keys() <= streams.keys(), streams.keys()
    for name, columns in right.streams.items():
        frame = streams[name].frame
        for column, values in columns.items():
            shown = frame[column].to_numpy(dtype=np.float64)
            np.testing.assert_allclose(shown, values, rtol=0, atol=1e-5 if "deg" in column else 6e-3)
        assert right.about.items() <= streams[name].attributes.items(), streams[name].attributes
    if right.start:
        first = min(stream.frame["time"].min() for name, stream in streams.items() if name in right.streams)
        assert first == pd.Timestamp(right.start)
    assert any(right.said in text for text in result.warnings) or not right.said, result.warnings


def down(first: float, count: int) -> list[float]:
    return [first - i for i in range(count)]


LEVEL = ("time=time", "Power=rss_db")
RIGHT = {
    "01_header_utc.csv": Right({"rss": {"rss_db": [-90, -91]}}, maps=("Time (UTC)=time", LEVEL[1]), options={**NEW_YORK, "unit": "dBm"}),
    "03_tab_us_date.csv": Right(
        {"rss": {"rss_db": [-95, -96]}}, maps=("Time=time", LEVEL[1]), options={**NEW_YORK, "unit": "dBm"}, said="a guess"
    ),
    "04_second_header.csv": Right({"pci11": {"rss_db": down(-95, 6), "rsrq_db": [-11] * 6}}),
    "06_two_operators.csv": Right({"pci11_A": {"rss_db": [-70] * 3}, "pci11_B": {"rss_db": [-110] * 3}}),
    "08_two_devices.csv": Right({
        "phone_device1": {"latitude_deg": [35.720001] * 3}, "phone_device2": {"latitude_deg": [35.740001] * 3},
        "pci11_device1": {"rss_db": [-90] * 3}, "pci11_device2": {"rss_db": [-110] * 3},
    }),
    "09_scope_ul_rssi.csv": Right({"dl_ri": {"rank": [NAN, 1, 2, 2]}, "ul_rssi": {"value": [-60, -60]}}),
    "11_gps_time.csv": Right({"pci11": {"rss_db": down(-95, 3)}}, said="GPS time"),
    "13_index_map.csv": Right({"rss": {"rss_db": [NAN] * 3}}, maps=("time=time", "rsrp_index=rss_db"), options={"unit": "dBm"}, said="an index?"),
    "15_feet_map.csv": Right(
        {"vehicle": {"altitude_m": [0, 30.48, 60.96]}, "rss": {"rss_db": down(-95, 3)}}, options={"unit": "dBm"},
        maps=("time=time", "p=rss_db", "lat=latitude_deg", "lon=longitude_deg", "Height [ft]=altitude_m"),
    ),
    "16_sigmf/cu8.sigmf-meta": Right({"USRP1": {"rss_db": [-20.2] * 100}}, about={"frequency_hz": 1e9}),
    "18_sigmf/hdr.sigmf-meta": Right({"USRP1": {"rss_db": [-20.0] * 100}}),
    "19_agl_msl.csv": Right({"phone": {"altitude_m": [30, 31, 32]}}, about={"height_datum": "ground"}, options=NEW_YORK),
    "21_ulog_global.csv": Right({"vehicle": {"altitude_m": [0, 1, 2, 3]}}, start="", said="sea level"),
    "22_neighbours.csv": Right({
        "pci11": {"rss_db": down(-90, 4), "serving": [1] * 4}, "pci12": {"rss_db": [-100] * 2, "serving": [0] * 2},
        "pci13": {"rss_db": [-120] * 2},
    }),
    "24_ms_that_are_s.kml": Right(
        {"phone": {"latitude_deg": [35.7280001 + 2e-5 * i for i in range(8)]}, "rssi": {"rss_db": down(-76, 8)}},
        start="2025-06-10T14:00:15.050", said="read as seconds", options={"time_origin": f"{START}Z"},
    ),
    "26_one_line.gpx": Right({"track": {"altitude_m": [0, 1, 2, 3, 4, 5]}}),
    "27_date_stamps.csv": Right({"rsrp": {"rss_db": down(-80, 4)}, "nr_rsrp": {"rss_db": [-99, -99], "rsrq_db": [-11] * 2}}),
    "29_two_digit_year.csv": Right({"pci11": {"rss_db": down(-90, 3)}}, said="two digits", options=NEW_YORK),
    "31_short_rows.csv": Right({"pci11": {"rss_db": down(-90, 4)}, "pci12": {"rss_db": [-100] * 2}}, options=NEW_YORK),
    "33_location.txt": Right({"phone": {"altitude_m": [0, 1, 2, 3]}}, about={"height_datum": "ellipsoid"}),
    "37_towercollector.csv": Right(
        {"lte_pci74": {"rss_db": down(-90, 3)}, "phone": {"altitude_m": [0, 1, 2]}}, start="2025-06-10T14:00:00.091"
    ),
    "41_dege7.csv": Right({"phone": {"latitude_deg": [35.7280001] * 3, "longitude_deg": [-78.6960001] * 3}}, said="1e-7 deg"),
    "43_json_array.json": Right({"gnb": {"rank": [1, 2, 4]}}, start="2025-06-10T14:00:00.5"),
    "45_two_vehicles.tlog": Right(
        {"vehicle_1": {"altitude_m": [30, 31, 32, 33]}, "vehicle_2": {"latitude_deg": [35.738] * 4}}, said="systems 1, 2", start="",
    ),
    "47_hover_start.csv": Right({"phone": {"altitude_m": [30.1] * 8}}, start=f"{START}.250", said="nothing says", options=NEW_YORK),
    "50_ahr2_north.csv": Right({"vehicle": {
        "yaw_deg": [2 + i / 10 for i in range(8)], "roll_deg": [1.5] * 8, "pitch_deg": [-2] * 8,
    }}),
    "52_cell_search.csv": Right(
        {"lte_pci1": {"rss_db": down(-30.1, 4)}}, start=f"{START}.729", options=NEW_YORK, about={"arfcn": 7399, "quantity": "PSS power"}
    ),
    "53_gnettrack_one_line.kml": Right(
        {"nr_pci1": {"rss_db": down(-72, 3)}, "phone": {"altitude_m": [0, -1, -2]}}, options=NEW_YORK,
    ),
    "aerpaw_monitoring.csv": Right({
        "link_power_LW1_transmitter0_receiver0": {"rss_db": [-71.25, -71.3]},
        "link_quality_LW1_transmitter0_receiver0": {"rss_db": [72.2]},
        "link_snr_LW1_transmitter0_receiver0": {"rss_db": [21.3]},
    }, start="2026-06-01T06:00:01.123", about={"transmitter": "LW1", "receiver": "LW2", "frequency_hz": 3.32e9}),
}  # fmt: skip
REFUSED = {
    "35_levels_no_time.kml": "levels and positions without times",
    "39_nmea.txt": "NMEA",
    "49_wifi_scan.txt": "a Wi-Fi scan of PawPrints",
}


def test_every_case_has_its_right_value() -> None:
    files = {path.relative_to(CASES / "logs").as_posix() for path in (CASES / "logs").rglob("*") if path.is_file()}
    assert {name for name in files if not name.endswith("sigmf-data")} == {*RIGHT, *REFUSED}


@pytest.mark.parametrize("name", RIGHT)
def test_a_log_is_read_as_it_says_it(name: str) -> None:
    right = RIGHT[name]
    check(read(CASES / "logs" / name, right.maps, right.options), right)


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_no_log_is_called_what_it_is(name: str) -> None:
    with pytest.raises(InputError, match=REFUSED[name]):
        read(CASES / "logs" / name, (), NEW_YORK)


AUTOPILOTS = {
    "uav.ulg": Right({"vehicle": {"altitude_m": [0.0] * 11 + [i - 10.0 for i in range(11, 41)] + [30.0] * 19}}, said="home moved", start=""),
    "right.ulg": Right({"vehicle": {"altitude_m": [0.0] * 11 + [i - 10.0 for i in range(11, 41)] + [30.0] * 19}}, start=""),
    "nan_home.ulg": Right({"vehicle": {"altitude_m": [0.0] * 11 + [i - 10.0 for i in range(11, 41)] + [30.0] * 19}}, start=""),
    "gimbal.tlog": Right({"vehicle": {"roll_deg": [0] * 60, "pitch_deg": [0] * 60, "yaw_deg": [90] * 60}}, start=""),
    "ap_gps2.log": Right({"vehicle": {"yaw_deg": [90] * 60}}, start="2025-06-01T14:00:00"),
    "two.tlog": Right(
        {"vehicle_1": {"altitude_m": [i / 2 for i in range(60)]}, "vehicle_2": {"altitude_m": [50] * 120}},
        said="systems 1, 2", start="",
    ),
    "hdg.tlog": Right({"vehicle": {"yaw_deg": [90] * 60}}, start=""),
    "tap_handover.jsonl": Right({
        "nr5g_rsrp_pci538_arfcn620640": {"rss_db": [-95] * 9}, "nr5g_rsrp_pci538_arfcn126490": {"rss_db": [-80] * 11},
    }, about={"pci": 538}, start=""),
}  # fmt: skip


@pytest.mark.parametrize("name", AUTOPILOTS)
def test_autopilots_and_the_tap_keep_who_and_how_high(name: str) -> None:
    check(read(CASES / "autopilots" / name, (), {}), AUTOPILOTS[name])


# --- cousins: other words, orders, separators, programs and zones ------------------------------------------------------

PLACE = "35.728000{i},-78.696000{i}"
LEVELS = {"pci11": {"rss_db": down(-90, 4)}}
EPOCH = "174956400{i}"


def table(head: str, row: str, count: int = 4) -> str:
    """Rows under a header: ``{i}`` counts, ``{l}`` is the level, ``{a}`` a hundred and more."""
    return head + "\n" + "".join(row.format(i=i, l=-90 - i, a=100 + i) + "\n" for i in range(count))


def phone(time: str, written: str, **options: str) -> tuple[str, Right]:
    return table(f"{time},lat,lon,pci,rsrp", f"{written},{PLACE},11,{{l}}"), Right(LEVELS, options=options)


def mapped(
    head: str, row: str, *maps: str, said: str = "", levels: list[float] | None = None, **options: str
) -> tuple[str, Right]:
    right = Right({"rss": {"rss_db": levels or down(-90, 4)}}, maps=maps, options={"unit": "dBm", **options}, said=said)
    return table(head, row), right


def radio(more: str, cells: str, streams: dict[str, dict[str, list[float]]], said: str = "") -> tuple[str, Right]:
    return table(f"time,lat,lon,pci,rsrp,{more}", f"{EPOCH},{PLACE},11,{{l}},{cells}"), Right(streams, said=said)


def height(name: str, row: str, altitude: list[float], said: str = "") -> tuple[str, Right]:
    return table(f"time,lat,lon,{name}", f"{EPOCH},{PLACE},{row}"), Right(
        {"vehicle": {"altitude_m": altitude}}, said=said
    )


def alternating(column: str, first: object, second: object, row: str = "-78.7,11") -> str:
    rows = (f"{1749564000 + i // 2},35.7,{(first, second)[i % 2]},{row},{-70 - 40 * (i % 2)}" for i in range(8))
    return f"time,lat,{column},lon,pci,rsrp\n" + "\n".join(rows) + "\n"


N1 = {"pci11": {"rss_db": down(-90, 4)}, "pci20": {"rss_db": down(-120, 4)}}
HIGH, LOW = {"rss_db": [-70] * 4}, {"rss_db": [-110] * 4}
LOCAL = "2025-06-10 10:00:0{i}"
COUSINS: dict[str, tuple[str, Right]] = {
    "zone of a header, a phone's": phone("Local time (EDT)", LOCAL, timezone="Asia/Tokyo"),
    "zone of a header as an offset": phone("Date Time (UTC-04:00)", LOCAL),
    "zone of a header under --map": mapped("Timestamp [GMT+9];p", "2025-06-10 23:00:0{i};{l}", "Timestamp [GMT+9]=time", "p=rss_db", **NEW_YORK),
    "zone of each cell": phone("Time", f"{LOCAL} -0400", timezone="Asia/Tokyo"),
    "zone of each cell in letters": phone("Time", f"{LOCAL} EDT", timezone="Asia/Tokyo"),
    "winter's zone in winter": (table("Time (EST),pci,rsrp", "2025-01-10 09:00:0{i},11,{l}"), Right(LEVELS, start="2025-01-10T14:00:00")),
    "American words": phone("Time", '"Jun 10, 2025 10:00:0{i} AM"', **NEW_YORK),
    "a web server's": phone("Time", "10/Jun/2025:10:00:0{i} -0400"),
    "the month in the middle as a word": phone("Time", "2025/Jun/10 10:00:0{i}", **NEW_YORK),
    "two digits, the year first": mapped("Time;p", "25-06-10 10:00:0{i};{l}", "Time=time", "p=rss_db", said="two digits", **NEW_YORK),
    "half days under --map": mapped("Time,p", "10-Jun-25 02:00:0{i} PM,{l}", "Time=time", "p=rss_db", timezone="UTC"),
    "date's own zone under --map": mapped("Time,p", "Tue Jun 10 10:00:0{i} EDT 2025,{l}", "Time=time", "p=rss_db", timezone="UTC"),
    "ctime": phone("Time", "Tue Jun 10 10:00:0{i} 2025", **NEW_YORK),
    "mail": phone("Time", '"Tue, 10 Jun 2025 14:00:0{i} GMT"'),
    "German": (table("Time;lat;lon;pci;rsrp", "10.06.25 16:00:0{i};35,728;-78,696;11;{l},0"), Right(LEVELS, options={"timezone": "Europe/Berlin"})),
    "GPS milliseconds": (
        table("gps_time_ms,pci,rsrp", "143359921{i}000,11,{l}"), Right(LEVELS, start="2025-06-10T13:59:52", said="GPS time")),
    "GPS weeks": (table("GPS week,GPS seconds,pci,rsrp", "2370,22401{i},11,{l}"), Right(LEVELS, start="2025-06-10T14:13:12", said="GPS weeks")),
    "called GPS, counted from 1970": (table("gps_time,pci,rsrp", f"{EPOCH},11,{{l}}"), Right(LEVELS, said="count from 1970")),
    "a second header with more columns": (
        table("time,pci,rsrp", f"{EPOCH},11,{{l}}") + table("time,rsrp,rsrq,pci", "174956401{i},{l},-11,12"),
        Right({**LEVELS, "pci12": {"rss_db": down(-90, 4), "rsrq_db": [-11] * 4}})),
    "a second header under --map": (
        table("t;p;q", f"{EPOCH};{{l}};1") + table("t;q;p", "174956401{i};1;{l}"),
        Right({"rss": {"rss_db": down(-90, 4) * 2}}, maps=("t=time", "p=rss_db"), options={"unit": "dBm"})),
    "a second header in capitals": (
        table("@time,pci,rsrp", f"{EPOCH},11,{{l}}") + table("@TIME,RSRP,PCI", "174956401{i},{l},12"),
        Right({**LEVELS, "pci12": {"rss_db": down(-90, 4)}})),
    "networks by their name": (alternating("Network Operator Name", "AT&T", "Verizon"), Right({"pci11_AT_T": HIGH, "pci11_Verizon": LOW})),
    "zone of a header by its place": phone("Time (America/New_York)", LOCAL, timezone="Asia/Tokyo"),
    "zone of a header with its summer": phone("Time (ET)", LOCAL, timezone="Asia/Tokyo"),
    "zone in a column of its own": (
        table("Time,Timezone,pci,rsrp", f"{LOCAL},EDT,11,{{l}}"), Right(LEVELS, options={"timezone": "Asia/Tokyo"})),
    "above sea level under --map": (
        table("t,lat,lon,alt_msl", f"{EPOCH},{PLACE},{{a}}"),
        Right({"telemetry": {"altitude_m": [0, 1, 2, 3]}}, said="sea level",
              maps=("t=time", "lat=latitude_deg", "lon=longitude_deg", "alt_msl=altitude_m"))),
    "networks by their code": (alternating("mnc", 410, 260), Right({"pci11_mnc410": HIGH, "pci11_mnc260": LOW})),
    "SIMs": (alternating("SIM slot", 1, 2), Right({"pci11_sim1": HIGH, "pci11_sim2": LOW})),
    "SIMs from 0": (alternating("Sim", 0, 1), Right({"pci11_sim0": HIGH, "pci11_sim1": LOW})),
    "subscriptions of Android": (alternating("subId", 1, 2), Right({"pci11_subid1": HIGH, "pci11_subid2": LOW})),
    "G-NetTrack's node is a base station": (
        alternating("NODE", 1, 1).replace("1,-78.7", "2,-78.7", 2), Right({"pci11": {"rss_db": [-70, -110] * 4}})),
    "clients": (alternating("client", "A", "B"), Right({"pci11_A": HIGH, "pci11_B": LOW})),
    "SIMs in columns": (
        table("time,sim1_pci,sim1_rsrp,sim2_pci,sim2_rsrp", f"{EPOCH},11,{{l}},11,-12{{i}}"),
        Right({"pci11_sim1": {"rss_db": down(-90, 4)}, "pci11_sim2": {"rss_db": down(-120, 4)}})),
    "units below the names": (
        "time,lat,lon,alt_rel,pci,rsrp\ns,deg,deg,ft,,dBm\n" + table("", f"{EPOCH},{PLACE},10,11,{{l}}")[1:],
        Right({**LEVELS, "phone": {"altitude_m": [3.048] * 4}})),
    "RSSI and RSRP exchanged": (
        table("time,pci,rssi,rsrp", f"{EPOCH},11,{{l}},-60"), Right({"pci11": {"rss_db": [-60] * 4}}, said="RSSI lies below RSRP")),
    "RSRQ in tenths": radio("rsrq", "-110", LEVELS, said="most values cannot be"),
    "no row as long as the header": (
        table("time,pci,rsrp,rsrq,sinr", f"{EPOCH},11,{{l}}"), Right(LEVELS, said="as many fields as the header")),
    "a second header in another unit": (
        table("time,lat,lon,alt_rel [m],pci,p_dbm", f"{EPOCH},{PLACE},3,11,{{l}}")
        + table("time,lat,lon,alt_rel [ft],pci,p_dbw", f"174956401{{i}},{PLACE},10,11,{{l}}"),
        Right({"telemetry": {"altitude_m": [3] * 4 + [3.048] * 4}},
              maps=("time=time", "lat=latitude_deg", "lon=longitude_deg", "alt_rel [m]=altitude_m"))),
    "statistics and predictions are no levels": radio(
        "rsrp_max,predicted_rsrp,rsrp_threshold", "-60,-61,-110", {**LEVELS, "rsrp_max": {"value": [-60] * 4}}),
    "names of Java": (
        table("timestampMs,latitudeE7,longitudeE7,heightAboveGround,physCellId,rsrpDbm", EPOCH + "000,357280001,-786960001,3,11,{l}"),
        Right({**LEVELS, "phone": {"latitude_deg": [35.7280001] * 4, "altitude_m": [3] * 4}}, about={})),
    "millionths of a degree": (
        table("time,latE6,lonE6,pci,rsrp", EPOCH + ",35728000,-78696000,11,{l}"), Right({"phone": {"latitude_deg": [35.728] * 4}, **LEVELS})),
    "degrees, minutes, seconds": (
        table("time,lat,lon,pci,rsrp", EPOCH + ",35\u00b043'40.80036\"\"N,78.6960001W,11,{l}"),
        Right({"phone": {"latitude_deg": [35.7280001] * 4, "longitude_deg": [-78.6960001] * 4}})),
    "above the ellipsoid in brackets": height("altitude (WGS84)", "{a}", [0, 1, 2, 3], said="ellipsoid"),
    "offsets of a column in minutes": (
        table("Time,utc_offset,pci,rsrp", f"{LOCAL},-240,11,{{l}}"), Right(LEVELS, options={"timezone": "Asia/Tokyo"})),
    "UTC beside local time": (
        table("local_time,utc_time,pci,rsrp", f"{LOCAL},2025-06-10 14:00:0{{i}},11,{{l}}"), Right(LEVELS, options={"timezone": "Asia/Tokyo"})),
    "zone of a header in small letters": phone("time_edt", LOCAL, timezone="Asia/Tokyo"),
    "weeks beside GPS milliseconds": (
        table("GPSWeek,GPSTime_ms,pci,rsrp", "2370,22401{i}000,11,{l}"), Right(LEVELS, start="2025-06-10T14:13:12", said="GPS weeks")),
    "angles under --map that look like radians": (
        table("t,lat,lon,h,a,b,c", f"{EPOCH},{PLACE},3,0.1,0.1,1.5"),
        Right({"telemetry": {"yaw_deg": [1.5] * 4}}, said="no value is beyond 2 pi",
              maps=("t=time", "lat=latitude_deg", "lon=longitude_deg", "h=altitude_m", "a=roll_deg", "b=pitch_deg", "c=yaw_deg"))),
    "two vehicles that nothing tells apart": (
        "time,lat,lon,alt_rel\n" + "".join(f"{1749564000 + i},{35.7 + i % 2 / 50},-78.7,3\n" for i in range(8)),
        Right({"vehicle": {"altitude_m": [3] * 8}}, said="two vehicles")),
    "home moves in flight": (
        "time,lat,lon,alt_msl,relative_alt\n" + "".join(
            f"{1749564000 + i},35.7,-78.7,{110 + 3 * i},{3 * i - 8 * (i > 9)}\n" for i in range(20)),
        Right({"vehicle": {"altitude_m": [3 * i for i in range(20)]}}, said="home moved")),
    "neighbours by number alone": radio("PCI_2,RSRP_2", "20,-12{i}", N1),
    "neighbours of an array": radio("NeighborRSRP[0],NeighborPCI[0]", "-12{i},20", N1),
    "an index at the level alone": (
        table("time,NR5G PCI,NR5G SS-RSRP[0]", f"{EPOCH},11,{{l}}"), Right({"nr_pci11": {"rss_db": down(-90, 4)}})),
    "neighbours on other carriers": radio("inter_pci,inter_rsrp", "20,-12{i}", N1),
    "two networks that nothing tells apart": (alternating("note", "", ""), Right({"pci11": {"rss_db": [-70, -110] * 4}}, said="alternate")),
    "devices under --map": (alternating("imei", 111, 112), Right(
        {"rss_imei111": HIGH, "rss_imei112": LOW},
        maps=("time=time", "rsrp=rss_db"), options={"unit": "dBm"})),
    "cells under --map": (alternating("n", 1, 2).replace("11,-110", "12,-110"), Right(
        {"rss_pci11": HIGH, "rss_pci12": LOW}, maps=("time=time", "rsrp=rss_db"), options={"unit": "dBm"})),
    "drones": (alternating("drone_id", "A", "B").replace("pci,rsrp", "alt_agl,x"), Right(
        {"vehicle_A": {"altitude_m": [11] * 4}, "vehicle_B": {"altitude_m": [11] * 4}})),
    "neighbours N1_": radio("N1_PCI,N1_RSRP", "20,-12{i}", N1),
    "neighbours neighbor1_": radio("neighbor1_rsrp,neighbor1_pci", "-12{i},20", N1),
    "neighbours nbr_pci_1": radio("nbr_pci_1,nbr_rsrp_1,nbr_pci_2,nbr_rsrp_2", "20,-12{i},30,-13{i}", {**N1, "pci30": {"rss_db": down(-130, 4)}}),
    "neighbours rsrp_n1": radio("pci_n1,rsrp_n1", "20,-12{i}", N1),
    "neighbours NCell1": radio("NCell1_PCI,NCell1_RSRP", "20,-12{i}", N1),
    "uplink by channel": radio("PUSCH SNR,UL RSSI [dBm]", "20,0", {**LEVELS, "pusch_snr": {"value": [20] * 4}}),
    "a 5G leg that is not there": radio("nr_pci,nr_rsrp", "0,0", LEVELS),
    "unavailable": radio("rsrq,sinr,bearing", "2147483647,65535,1000", LEVELS),
    "RSCP is no RSRP": (
        table("time,net_type,psc,short_cell_id,rscp,rsrp", f"{EPOCH},UMTS,74,1,{{l}},"), Right({"rscp": {"rss_db": down(-90, 4)}})),
    "milliwatts": radio("nr_pci,nr_rsrp [mW]", "7,1e-9", {**LEVELS, "nr_pci7": {"rss_db": [-90] * 4}}),
    "watts in decibels under --map": mapped("time,p (dBW)", f"{EPOCH},{{l}}", "time=time", "p (dBW)=rss_db", levels=down(-60, 4)),
    "an index below 30": mapped("time,p", f"{EPOCH},2{{i}}", "time=time", "p=rss_db", levels=[NAN] * 4, said="an index?"),
    "units in cells": (table("time,lat,lon,alt_rel,pci,rsrp", f"{EPOCH},{PLACE},{{i}}ft,11,{{l}}dBm"), Right(
        {**LEVELS, "phone": {"altitude_m": [0, 0.3048, 0.6096, 0.9144]}})),
    "short rows under --map": mapped("time,p,n1,n2", f"{EPOCH},{{l}}", "time=time", "p=rss_db"),
    "above ground in feet": height("Alt_AGL_ft", "{a}", [30.48, 30.7848, 31.0896, 31.3944]),
    "above take-off beside sea level": height("alt_msl,relative_alt", "{a},{i}", [0, 1, 2, 3]),
    "feet above sea level": height("Altitude (ft MSL)", "{a}", [0, 0.3048, 0.6096, 0.9144], said="sea level"),
    "a height from 0": height("Height [ft]", "{i}00", [0, 30.48, 60.96, 91.44]),
    "home and terrain are not the aircraft": height("home_alt,terrain_alt,height above ellipsoid (m)", "5,6,{a}", [0, 1, 2, 3], said="ellipsoid"),
    "ArduPilot's height above home": height("TimeUS,Alt,RelHomeAlt,RelOriginAlt", "1,{a},{i},9", [0, 1, 2, 3]),
    "MAVLink's integers": (
        table("timestamp,time_boot_ms,lat,lon,alt,relative_alt,vx,vy,vz,hdg", EPOCH + ",1,35728000{i},-78696000{i},110000,{i}000,150,0,-50,9000"),
        Right({"vehicle": {"altitude_m": [0, 1, 2, 3], "yaw_deg": [90] * 4, "velocity_north_mps": [1.5] * 4}})),
    "1e-7 degrees in the header": (
        table("time,lat [1e-7 deg],lon [1e-7 deg],pci,rsrp", EPOCH + ",357280001,-786960001,11,{l}"),
        Right({"phone": {"latitude_deg": [35.7280001] * 4}, **LEVELS})),
    "degrees and minutes": (
        table("time,lat,NS,lon,EW,pci,rsrp", EPOCH + ",3543.680006,N,07841.760006,W,11,{l}"),
        Right({"phone": {"latitude_deg": [35.7280001] * 4, "longitude_deg": [-78.6960001] * 4}}, said="ddmm.mmmm")),
    "a gimbal is not the aircraft": height("alt_rel,gimbal_roll,gimbal_pitch,gimbal_yaw", "3,1,-45,200", [3] * 4),
    "ATT in degrees": (
        table("timestamp,TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw,Lat,Lng", f"{EPOCH},1,0,0.5,0,0.4,0,2,{PLACE}"),
        Right({"vehicle": {"roll_deg": [0.5] * 4, "yaw_deg": [2] * 4}})),
    "yaw 0 throughout": (
        table("time,lat,lon,alt_rel,roll,pitch,yaw", f"{EPOCH},{PLACE},3,1.5,2.5,0"), Right({"vehicle": {"yaw_deg": [NAN] * 4}}, said="yaw is 0")),
    "cell search through ts": (
        table("", "[2025-06-10 10:00:0{i}] Found CELL 3500.0 MHz, EARFCN=7399, PHYID=11, 50 PRB, 1 ports, PSS power={l}.0 dBm"),
        Right({"lte_pci11": {"rss_db": down(-90, 4)}}, options=NEW_YORK)),
    "an RM520N console through ts": (
        table("", '[2025-06-10 10:00:0{i}] AT+QENG="servingcell"\n[2025-06-10 10:00:0{i}] +QENG: "servingcell","NOCONN"\n'
              '[2025-06-10 10:00:0{i}] +QENG: "LTE","FDD",310,260,1A2B,7,2300,4,5,5,1F,-10{i},-12,-70,15,10,-,20\n'
              '[2025-06-10 10:00:0{i}] +QENG: "NR5G-NSA",310,260,11,{l},25,-11,640000,78,12,1\n'
              '[2025-06-10 10:00:0{i}] +QNWCFG: "nr5g_csi",24,2,12,5\n[2025-06-10 10:00:0{i}] OK'),
        Right({"nr_rsrp": {"rss_db": down(-90, 4), "sinr_db": [25] * 4}, "lte_rsrp": {"rss_db": down(-100, 4)},
               "nr5g_csi": {"rank": [2] * 4}}, options=NEW_YORK)),
    "a stand-alone RM520N console": (
        table("", '[2025-06-10 10:00:0{i}.5] +QENG: "servingcell","NOCONN","NR5G-SA","TDD",310,260,1A2B,11,1F,640000,78,12,{l},-11,25,1,-'),
        Right({"nr_rsrp": {"rss_db": down(-90, 4)}}, start=f"{START}.5", options=NEW_YORK, about={"pci": 11, "arfcn": 640000})),
    "cell search with asctime": (
        table("", "Found CELL MHz, 3500.0,  EARFCN, 7399, PHYID, 11, PRB, 50,  ports, 1, PSS power dBm, {l}.0,  PSR, 2.3, Tue Jun 10 10:00:0{i} 2025"),
        Right({"lte_pci11": {"rss_db": down(-90, 4)}}, options=NEW_YORK)),
    "latitude and longitude exchanged": (
        table("time,lat,lon,pci,rsrp", EPOCH + ",-78.696,35.728,11,{l}"), Right(LEVELS, said="are latitude and longitude exchanged?")),
    "RSRQ called RSRP": (table("time,pci,rsrp", EPOCH + ",11,-1{i}.5"), Right({"pci11": {"rss_db": [NAN] * 4}}, said="an RSRQ")),
    "RSRQ called RSRP under --map": mapped("time,rsrp", EPOCH + ",-1{i}.5", "time=time", "rsrp=rss_db", levels=[NAN] * 4, said="an RSRQ"),
    "an index of RSRQ": radio("rsrq", "1{i}", LEVELS, said="most values cannot be"),
    "yaw alone in radians or degrees": height("alt_rel,yaw", "3,1.{i}", [3] * 4, said="unit of yaw"),
    "no height has a number": height("alt", "nan", [NAN] * 4, said="heights are unknown"),
    "no fix before the first height": (
        "time,lat,lon,alt\n" + "".join(f"{1749564000 + i},35.728,-78.696,{[0, 0, 110, 110, 110, 110, 110, 113, 118][i]}\n" for i in range(9)),
        Right({"vehicle": {"altitude_m": [NAN, NAN, 0, 0, 0, 0, 0, 3, 8]}}, said="at rest on the ground")),
    "an offset in a header without brackets": mapped("Time UTC-4,p", "2025-06-10 10:00:0{i},{l}", "Time UTC-4=time", "p=rss_db", timezone="Asia/Tokyo"),
    "a narrow space before AM": phone("Time", "2025-06-10 10:00:0{i}\u202fAM", **NEW_YORK),
    "seconds of a GPS week under --map": (
        table("gps_week,gps_tow,p", "2370,22401{i},{l}"),
        Right({"rss": {"rss_db": down(-90, 4)}}, start="2025-06-10T14:13:12", maps=("gps_tow=time", "p=rss_db"), options={"unit": "dBm"})),
    "integers of MAVLink under --map": (
        table("t,a,b,h", EPOCH + ",357280001,-786960001,3"),
        Right({"telemetry": {"latitude_deg": [35.7280001] * 4}}, said="1e-7 deg",
              maps=("t=time", "a=latitude_deg", "b=longitude_deg", "h=altitude_m"))),
    "German names": (
        table("Zeit (MESZ);Breite;L\u00e4nge;H\u00f6he;pci;rsrp", "2025-06-10 16:00:0{i};35,728;-78,696;3;11;{l}"),
        Right({**LEVELS, "phone": {"altitude_m": [3] * 4}}, options={"timezone": "Asia/Tokyo"})),
    "another cell": radio("other_pci,other_rsrp", "20,-12{i}", N1),
    **{f"times in {unit}": (
        table(f"{name},pci,rsrp", f"{value},11,{{l}}"), Right(LEVELS, start=f"{START[:-2]}36", options={"time_origin": f"{START}Z"}))
       for unit, name, value in (
           ("milliseconds of Java", "timestampMs", "3600{i}"), ("minutes", "time [min]", "0.60{i}"), ("hours", "time (h)", "0.010{i}"),
           ("microseconds of ArduPilot", "TimeUS", "3600000{i}"), ("nanoseconds", "elapsed (ns)", "3600000000{i}"))},
    **{f"six digits, {order}": (
        table("date,utc,pci,rsrp", f"{date},14000{{i}}.00,11,{{l}}"), Right(LEVELS, said=f"the {said} number was taken"))
       for order, date, said in (("the day first", "100625", "last"), ("the year first", "250610", "first"))},
    "GPX of a named space": (
        "<g:gpx>" + table("", '<g:trkpt lat="35.728" lon="-78.696"><g:ele>11{i}</g:ele><g:time>2025-06-10T14:00:0{i}Z</g:time></g:trkpt>'),
        Right({"track": {"altitude_m": [0, 1, 2, 3]}})),
    "positions on a grid": (
        table("time,easting,northing,pci,rsrp", EPOCH + ",70850{i}.5,395615{i}.2,11,{l}"), Right(LEVELS, said="on a grid")),
    "six digits without a date": (
        table("utc,pci,rsrp", "14000{i}.00,11,{l}"), Right(LEVELS, said="no date", options={"time_origin": f"{START}Z"})),
    "degrees and minutes by name": (
        table("time,lat_ddmm,lon_dddmm,pci,rsrp", EPOCH + ",3543.680006,-7841.760006,11,{l}"),
        Right({"phone": {"latitude_deg": [35.7280001] * 4}}, said="ddmm.mmmm")),
    "PawPrints positions of 2023": (
        table("", "GPS_LOG_START,174956400{i}000,2.0,1.1,35.728,-78.696,75.{i},11.4,GPS_LOG_STOP"),
        Right({"phone": {"altitude_m": [0, 0.1, 0.2, 0.3]}})),
}  # fmt: skip


@pytest.mark.parametrize("name", COUSINS)
def test_cousins_are_read_as_they_say_it(name: str, tmp_path: Path) -> None:
    text, right = COUSINS[name]
    place = tmp_path / "table.csv"
    place.write_text(text)
    check(read(place, right.maps, right.options), right)


def climb(first: list[float], rest: float) -> str:
    heights = [*first, *[rest] * 6, *[rest + 5 * i for i in range(1, 6)]]
    return "time,lat,lon,{}\n" + "".join(f"{1749564000 + i},35.728,-78.696,{h}\n" for i, h in enumerate(heights))


@pytest.mark.parametrize(("name", "first"), [("altitude", []), ("alt_msl", []), ("alt_msl", [0.0, 0.0])])
def test_heights_count_from_the_ground_before_the_climb(name: str, first: list[float], tmp_path: Path) -> None:
    """Not from the first row, and not from the zeros of a receiver without a fix."""
    (tmp_path / "x.csv").write_text(climb(first, 110.0).format(name))
    shown = read(tmp_path / "x.csv", (), {}).streams[0].frame["altitude_m"].to_numpy()
    np.testing.assert_allclose(shown, [*[NAN] * len(first), *[0.0] * 6, 5, 10, 15, 20, 25])


@pytest.mark.parametrize(
    ("name", "heights", "ground"),
    [("alt_msl", [140.0] * 6 + [150, 130] + [110.0] * 6, 110.0), ("altitude", [30.0] * 6 + [40, 20] + [0.0] * 6, 0.0)],
)
def test_a_hover_at_the_start_is_no_ground(name: str, heights: list[float], ground: float, tmp_path: Path) -> None:
    """The aircraft comes down to where it then rests: that is the ground."""
    rows = "".join(f"{1749564000 + i},35.728,-78.696,{h}\n" for i, h in enumerate(heights))
    (tmp_path / "x.csv").write_text(f"time,lat,lon,{name}\n{rows}")
    shown = read(tmp_path / "x.csv", (), {}).streams[0].frame["altitude_m"].to_numpy()
    np.testing.assert_allclose(shown, np.array(heights) - ground)


SHIFTED = "the rows do not fit the header"
BAD: dict[str, tuple[str, type[Exception], str]] = {
    "EST in summer": (phone("Time (EST)", LOCAL)[0], UsageError, "-05:00 as written or -04:00"),
    "a zone of several countries": (phone("Time", f"{LOCAL} IST")[0], UsageError, "several countries"),
    "minutes of a spreadsheet": (phone("Time", "47:3{i}.2")[0], InputError, "without the hour"),
    "shifted by a column": (table("time,pci,lat,lon,rsrp", EPOCH + ",35.728,-78.696,{l},11"), InputError, SHIFTED),
    "a PCI with a fraction": (table("time,lat,lon,pci,rsrp,rsrq", EPOCH + ",35.7,-78.7,1234.5,11,{l}"), InputError, SHIFTED),
    "whole degrees": (table("time,lat,lon,alt", EPOCH + ",7,35.728,-78.696"), InputError, SHIFTED),
    "later rows shifted": (
        table("time,lat,lon,pci,rsrp", EPOCH + ",35.7,-78.7,11,{l}") + table("", EPOCH + ",11,35.7,-78.7,{l}")[1:], InputError, SHIFTED),
    "a latitude of 999": (table("time,lat,lon,pci,rsrp", EPOCH + ",999,35.7,-78.7,{l}"), InputError, SHIFTED),
    "weeks modulo 1024": (table("week,tow,pci,rsrp", "322,22401{i},11,{l}"), InputError, "modulo 1024"),
    "a month of no language": (phone("Time", "10 foo 2025 10:00:0{i}")[0], InputError, "of a form that is not read"),
    "a scan of access points": ("WigleWifi-1.4,appRelease=2.53\nMAC,SSID,FirstSeen,RSSI\n", InputError, "a Wi-Fi scan"),
    "answers of another modem": (
        table("", '[2025-06-10 10:00:0{i}] #RFSTS: "310 26",1795,-101,-67,-15,2242'), InputError, "AT answers of a modem"),
    "NMEA through ts": (table("", "[2025-06-10 10:00:0{i}] $GNGGA,140000.00,3543.68,N,07841.76,W,1"), InputError, "NMEA"),
    "an index in front of AERPAW's positions": (
        table("time,lat,lon,alt,rsrp", EPOCH + f",1.{{i}},{PLACE},{{l}}"), InputError, "holds values as positions have"),
    "an index in front of positions elsewhere": (
        table("time,lat,lon,alt,rsrp", EPOCH + ",1.{i},48.13712{i},11.57541{i},{l}"), InputError, "'alt' holds values as"),
    "a level without its PCI, elsewhere": (
        table("time,pci,rsrp,lat,lon,alt", EPOCH + ",{l},48.13712{i},11.57541{i},520.3,3"), InputError, SHIFTED),
    "NMEA of another sentence": (table("", "$GNGNS,14000{i}.00,3543.68,N,07841.76,W,AA,10,0.9,110.1,-33,,*5C"), InputError, "NMEA"),
    "GnssLogger": (
        "# Header\n# Fix,Provider,LatitudeDegrees,LongitudeDegrees\n" + "Fix,GPS,35.728,-78.696\n" * 4, InputError, "GnssLogger"),
    "JSON of a phone": (
        table("", '{{"time": 174956400{i}, "pci": 11, "rsrp": -9{i}, "lat": 35.728}}')[1:], InputError, "JSON records"),
    "a web page": ("<!DOCTYPE html><html><body>Log in</body></html>\n", InputError, "a web page"),
    "a table of nobody": (
        table("index,when_utc,Breite,rx_power_dbm,temperature", "{i},2025-06-10 10:00:0{i},35,{l},20"), InputError,
        "--map 'when_utc'=time --map 'rx_power_dbm'=rss_db$"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_what_cannot_be_read_is_refused_with_its_cause(name: str, tmp_path: Path) -> None:
    text, error, words = BAD[name]
    (tmp_path / "table.csv").write_text(text)
    with pytest.raises(error, match=words):
        read(tmp_path / "table.csv", (), {})


def test_a_header_and_a_mapping_that_disagree_are_refused(tmp_path: Path) -> None:
    (tmp_path / "x.csv").write_text(table("time,p [dBm],h [deg],lat,lon", f"{EPOCH},{{l}},1,{PLACE}"))
    place = ("time=time", "p [dBm]=rss_db", "lat=latitude_deg", "lon=longitude_deg")
    with pytest.raises(UsageError, match="is in deg and mapped to altitude_m"):
        read(tmp_path / "x.csv", (*place, "h [deg]=altitude_m"), {})
    with pytest.raises(UsageError, match="'lon' says longitude_deg, the mapping latitude_deg"):
        read(tmp_path / "x.csv", (*place[:2], "lon=latitude_deg", "lat=longitude_deg"), {})
    (tmp_path / "y.csv").write_text(table("time,cqi", f"{EPOCH},2"))
    with pytest.raises(UsageError, match="'cqi' says CQI, the mapping ri_raw"):
        read(tmp_path / "y.csv", ("time=time", "cqi=ri_raw"), {"ri_base": "one"})
    with pytest.raises(UsageError, match="says dBm"):
        read(tmp_path / "x.csv", place, {"unit": "dB re full scale"})


def test_the_summary_beside_a_log_says_its_hours_and_its_name_does_not(tmp_path: Path) -> None:
    point = '<gpx><trkpt lat="35.73" lon="-78.7"><ele>90.5</ele><time>T14:00:01Z</time></trkpt></gpx>\n'
    place = tmp_path / "25Mar02_100000.1.gpx"
    place.write_text(point)
    assert read(place, (), NEW_YORK).streams[0].frame["time"][0] == pd.Timestamp("2025-03-02T14:00:01")
    place.with_suffix(".csv").write_text("x\nMeasurement start;2025 Mar 02 10:00\n")
    assert read(place, (), NEW_YORK).streams[0].frame["time"][0] == pd.Timestamp("2025-03-02T15:00:01")


def test_captures_of_several_frequencies_are_several_series(tmp_path: Path) -> None:
    captures = ", ".join(
        f'{{"core:sample_start": {1000 * i}, "core:datetime": "2025-06-10T14:00:0{i}Z", "core:frequency": {3.4 + i / 10}e9}}'
        for i in range(2)
    )
    meta = f'{{"global": {{"core:datatype": "ru16_le", "core:sample_rate": 1000}}, "captures": [{captures}]}}'
    (tmp_path / "x.sigmf-meta").write_text(meta)
    wave = 32_767.5 + np.where(np.arange(2000) % 2, 3276.8, -3276.8) * np.where(np.arange(2000) < 1000, 1, 0.1)
    wave.round().astype("<u2").tofile(tmp_path / "x.sigmf-data")
    result = read(tmp_path / "x.sigmf-meta", (), {})
    levels = {
        stream.name: (stream.attributes["frequency_hz"], stream.frame["rss_db"].mean()) for stream in result.streams
    }
    assert levels == {
        "USRP1_3400MHz": (3.4e9, pytest.approx(-20, abs=0.01)), "USRP1_3500MHz": (3.5e9, pytest.approx(-40, abs=0.05)),
    }  # fmt: skip


def test_tracks_of_one_time_in_a_gpx_are_two(tmp_path: Path) -> None:
    point = '<trkpt lat="35.7{t}" lon="-78.7"><ele>9{i}</ele><time>2025-06-10T14:00:0{i}Z</time></trkpt>'
    tracks = ("".join(point.format(t=t, i=i) for i in range(4)) for t in range(2))
    (tmp_path / "x.gpx").write_text("<gpx>" + "".join(f"<trk>{points}</trk>" for points in tracks) + "</gpx>")
    shown = {item.name: item.frame["latitude_deg"].tolist() for item in read(tmp_path / "x.gpx", (), {}).streams}
    assert shown == {"track_1": [35.70] * 4, "track_2": [35.71] * 4}


def test_a_table_below_in_another_form_is_no_words(tmp_path: Path) -> None:
    """Its rows are rejected, and counted, not taken for a comment."""
    below = table("time;rsrp;pci", "174956401{i};{l};12")
    (tmp_path / "x.csv").write_text(table("time,pci,rsrp", f"{EPOCH},11,{{l}}") + below)
    result = read(tmp_path / "x.csv", (), {})
    assert (result.accepted, len(result.rejected)) == (4, 4)


def test_rows_whose_identity_says_nothing_are_one_part_and_none_is_lost(tmp_path: Path) -> None:
    """Parts of one name took each other's place: ``B`` is a SIM here and a network there."""
    cells = [("A", "B"), ("", "B"), ("B", ""), ("nan", "-"), ("n/a", ""), ("", "0")]
    rows = "".join(f"{1749564000 + i},{a},{b},11,{-90 - i}\n" for i, (a, b) in enumerate(cells))
    (tmp_path / "x.csv").write_text(f"time,operator,sim slot,pci,rsrp\n{rows}")
    streams = read(tmp_path / "x.csv", (), {}).streams
    assert len({item.name for item in streams}) == len(streams)
    assert sorted(level for item in streams for level in item.frame["rss_db"]) == [-95.0, -94, -93, -92, -91, -90]


@pytest.mark.parametrize("name", ["flight.xlsx", "flight.csv"])
def test_a_spreadsheet_is_called_one(name: str, tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / name, "w") as book:
        book.writestr("[Content_Types].xml", "<Types/>")
        book.writestr("xl/workbook.xml", "<workbook/>")
    with pytest.raises(InputError, match=r"a spreadsheet \(\.xlsx\); expected its table saved as CSV"):
        read(tmp_path / name, (), {})


def test_the_log_of_the_tap_gives_the_level_of_lte_beside_that_of_nr(tmp_path: Path) -> None:
    header = (CASES / "autopilots" / "tap_handover.jsonl").read_text().splitlines()[0]
    cell = {"pcid": 7, "arfcn": 2300, "band": 4, "rsrp_dbm": -100, "rsrq_db": -12, "rssi_dbm": -70, "sinr_raw": 15}
    asked = {
        "query": "servingcell", "status": "ok", "sent_utc_ns": 1_749_564_000 * 10**9,
        "last_utc_ns": 1_749_564_000 * 10**9,
    }  # fmt: skip
    text = json.dumps({"kind": "exchange", "n": 1, **asked, "decoded": {"lte": cell}})[:-1]
    (tmp_path / "x.jsonl").write_text(f'{header}\n{text},"crc":"{zlib.crc32(text.encode()):08x}"}}\n')
    right = {"lte_rsrp": {"rss_db": [-100.0], "rsrq_db": [-12.0], "rssi_dbm": [-70.0]}}
    check(read(tmp_path / "x.jsonl", (), {}), Right(right, about={"pci": 7, "arfcn": 2300, "rat": "lte"}))
