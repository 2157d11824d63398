"""Made-up files with their truth beside them: what real programs vary, for each format.

A case is a file's name, its bytes and, for each stream that it must give, columns as they must come out; ``time`` in
seconds after 2025-03-02 15:00:00 UTC, which is 10:00:00 in New York.
"""

from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

import numpy as np
import pandas as pd
import pytest

from aerpaw_cmp.logs.files.chunks import whole_lines
from aerpaw_cmp.logs.ingest import ingest
from aerpaw_cmp.logs.readers import ReadOptions, identify
from tests.frames import assert_same_result
from tests.parsers import autopilots, samples

BEGIN = np.datetime64("2025-03-02T15:00:00")
LOCAL = ReadOptions(timezone="America/New_York")
Truth = dict[str, dict[str, list[Any]]]


@dataclass(frozen=True)
class Case:
    """A file and what it says: columns of its streams, what a stream says of itself, words of a warning and of a reason."""

    name: str
    data: str | bytes
    truth: Truth
    reader: str
    options: ReadOptions = LOCAL
    about: dict[str, dict[str, Any]] = field(default_factory=dict)
    warned: str = ""
    refused: str = ""


def od(*samples: tuple[float, float]) -> str:
    """Lines of the sounder: seconds and levels."""
    rows = [f"[2025-03-02 10:00:{s:09.6f}] {4 * i:07o} {v:15.4f}" for i, (s, v) in enumerate(samples)]
    return "\n".join(rows) + "\n"


LEVELS: Truth = {"x": {"time": [1.0, 1.5], "rss_db": [-20.5, 3.25]}}
CASES: dict[str, Case] = {
    f"sounder {name}": Case(name, od((1.0, -20.5), (1.5, 3.25)), {stream: LEVELS["x"]}, "sounder_log")
    for name, stream in {
        "2025-03-02_10_00_00_power_log.txt": "power",
        "x_quality_log.txt": "quality",
        "lw1_snr.txt": "snr",
        "LW3_SNR_run2.txt": "snr",
        "powerlog.txt": "power",
    }.items()
}
CASES |= {
    "milliseconds of the day, a date in the name": Case(
        "2025-03-02_merged.csv",
        ",TIME,SNR,LAT,LON,ALT\n0,36000250,12.5,35.73,-78.7,0.5\n1,36002750,13.5,35.73,-78.7,0.5\n",
        {"snr": {"time": [0.25, 2.75], "value": [12.5, 13.5]}}, "drive_test"),
    "AirData: whole seconds and a column of milliseconds": Case(
        "airdata.csv",
        "time(millisecond),datetime(utc),latitude,longitude,height_above_takeoff(feet)\n"
        + "".join(f"{100 * i},2025-03-02 15:00:{i // 10:02d},35.73,-78.7,{i}\n" for i in range(25)),
        {"vehicle": {"time": [i / 10 for i in range(25)], "altitude_m": [0.3048 * i for i in range(25)]}},
        "pose_csv",
    ),
    "Nemo throughput, lower case, in Mbps": Case(
        "flight1_inst_throughput_mbps.kml",
        "<kml>\n<Placemark><description>rel_time = 1500 ms inst_throughput_mbps = 126.75 Mbps (lat, lon) = "
        "(35.73,-78.7) altitude = 4.5 m</description></Placemark>\n</kml>\n",
        {"inst_throughput_mbps": {"time": [1.5], "value": [126.75]}, "phone": {"altitude_m": [4.5]}},
        "nemo_kml",
        replace(LOCAL, time_origin="2025-03-02T15:00:00Z"),
    ),
    "Nemo table: what stands in rows without a rank": Case(
        "nemo_nr.csv",
        "index,rel_time_ms,lat,lon,alt_m,pdsch_rank,nr_rsrp_dbm,nr_sinr_db,wb_cqi\n"
        "1,500,35.73,-78.7,4.5,2,,,\n2,1500,35.73,-78.7,4.5,,-80.5,21.5,\n3,2500,35.73,-78.7,4.5,,,,14\n",
        {
            "pdsch_rank": {"time": [0.5, 1.5, 2.5], "rank": [2.0, np.nan, np.nan]},
            "nr_rsrp": {"time": [1.5], "rss_db": [-80.5]},
            "nr_sinr": {"time": [1.5], "value": [21.5]},
            "wb_cqi": {"time": [2.5], "value": [14.0]},
        },
        "nemo_csv",
        replace(LOCAL, time_origin="2025-03-02T15:00:00Z"),
    ),
}  # fmt: skip


LOG2CSV = "Number,Time,Longitude,Latitude,Altitude,Voltage,Battery Level,Fix,Number of Satellites\n"


def table(head: str, row: str, count: int = 8) -> str:
    """A table of poses: ``i`` counts rows, ``s`` whole seconds after ten o'clock."""
    return head + "".join(
        row.format(i=i, s=i % 60, rise=50.0 + i, rest=134.5, north=35.73 + 1e-4 * i) for i in range(count)
    )


MERGED = "2025-03-02 10:00:{s:02d},-78.7,35.73,{rise},{i},4,29\n"
HEIGHTS = [50.0 + i for i in range(8)]
CASES |= {
    "converted vehicleOut cut in flight keeps its heights": Case(
        "cut.csv", table(LOG2CSV, "{i},2025-03-02 10:00:{s:02d},-78.7,{north},{rise},48.1,90,4,29\n"),
        {"vehicle": {"time": list(range(8)), "altitude_m": HEIGHTS}}, "pose_csv"),
    "MATLAB merge of vehicleOut that begins in the air": Case(
        "merged.csv", table("time,Longitude,Latitude,Altitude,BatteryVolts,GPSFix,NumberOfSatellites\n", MERGED),
        {"vehicle": {"altitude_m": HEIGHTS}}, "pose_csv"),
    "a table of nobody that begins in flight keeps its heights": Case(
        "x.csv", table("time,lat,lon,alt\n", "2025-03-02 10:00:{s:02d},{north},-78.7,{rise}\n"),
        {"vehicle": {"altitude_m": HEIGHTS}}, "pose_csv"),
    "a table of nobody that never leaves its height is not on the ground": Case(
        "x.csv", table("time,lat,lon,alt\n", "2025-03-02 10:00:{s:02d},35.73,-78.7,{rest}\n"),
        {"vehicle": {"altitude_m": [134.5] * 8}}, "pose_csv"),
    "altitudes that the header calls above sea level": Case(
        "x.csv", table("time,lat,lon,altitude_msl\n", "2025-03-02 10:00:{s:02d},{north},-78.7,{rise}\n"),
        {"vehicle": {"altitude_m": [float(i) for i in range(8)]}}, "pose_csv"),
    "Nemo's name is year, month, day; times that are not its name's are UTC, as they say": Case(
        "25Mar02_100000.1.gpx",
        '<gpx><trkpt lat="35.73" lon="-78.7"><ele>90.5</ele><time>T14:00:01.250Z</time></trkpt>\n'
        '<trkpt lat="35.73" lon="-78.7"><ele>91.5</ele><time>T14:00:02.250Z</time></trkpt></gpx>\n',
        {"track": {"time": [-3598.75, -3597.75], "altitude_m": [0.0, 1.0]}},
        "gpx",
    ),
    "gnb.log of srsRAN Project is UTC": Case(
        "gnb.log",
        "2025-03-02T15:00:01.250000 [METRICS ] [I] Scheduler UE pci=1 rnti=0x4601 cqi=12 dl_ri=2.0 dl_mcs=27\n",
        {"gnb": {"time": [1.25], "rank": [2.0], "rnti": [0x4601]}}, "srsran_gnb"),
    "srsRAN Project's JSON with texts is UTC": Case(
        "gnb.json",
        '{"timestamp": "2025-03-02T15:00:02.500", "ue_list": [{"ue_container": {"pci": 1, "rnti": 17921, "dl_ri": 1}}]}\n',
        {"gnb": {"time": [2.5], "rank": [1.0]}}, "srsran_json"),
}  # fmt: skip

STAMPED = "[2025-03-02 10:00:{s:02d}.000000] {text}\n"


def srsenb(*rows: tuple[int, str, int]) -> str:
    """srsENB's console: seconds, UE and rank of each row."""
    head = "rat rnti  cqi  ri  mcs  brate   ok  nok  (%) | pusch pucch phr mcs brate ok nok (%) bsr"
    row = "lte {ue}   11   {ri}    2   3.7k   14    0   0% |  31.5   12.5   40   15    38k"
    texts = [(0, head), *((s, row.format(ue=ue, ri=ri)) for s, ue, ri in rows)]
    return "".join(STAMPED.format(s=s, text=text) for s, text in texts)


CASES |= {
    "two UEs of an OAI gNB": Case(
        "oai.log",
        "".join(
            STAMPED.format(s=s, text=f"[NR_MAC] UE {ue}: CQI {15 - s}, RI {ri}, PMI (14,1)")
            + STAMPED.format(s=s, text=f"UE RNTI {ue} CU-UE-ID 1 in-sync PH 0 dB average RSRP {rsrp - s} (16 meas)")
            for s in (1, 2)
            for ue, ri, rsrp in (("1f4d", 2, -78), ("2a3b", 1, -98))
        ),
        {
            "oai_rnti1f4d": {"time": [1, 2], "rank": [2, 2], "cqi": [14, 13]},
            "oai_rnti2a3b": {"time": [1, 2], "rank": [1, 1], "cqi": [14, 13]},
            "nr_rsrp_rnti1f4d": {"time": [1, 2], "rss_db": [-79, -80]},
            "nr_rsrp_rnti2a3b": {"time": [1, 2], "rss_db": [-99, -100]},
        },
        "oai_log",
    ),
    "two UEs of srsENB": Case(
        "x_radio_enb_log.txt", srsenb((1, "46", 2), (1, "47", 1), (2, "46", 2), (2, "47", 1)),
        {"srsenb_rnti0046": {"time": [1, 2], "rank": [2, 2]}, "srsenb_rnti0047": {"time": [1, 2], "rank": [1, 1]}},
        "srsenb_log"),
    "one UE of srsENB that attaches again": Case(
        "x_radio_enb_log.txt", srsenb((1, "46", 2), (2, "46", 2), (3, "47", 2)),
        {"srsenb": {"time": [1, 2, 3], "rank": [2, 2, 2], "rnti": [0x46, 0x46, 0x47]}}, "srsenb_log"),
}  # fmt: skip


DJI = "OSD.latitude,OSD.longitude,OSD.height [ft],OSD.yaw"
CASES |= {
    "AirData in metres begins in the air": Case(
        "airdata.csv",
        "time(millisecond),datetime(utc),latitude,longitude,height_above_takeoff(meters),altitude_above_seaLevel(meters)\n"
        + "".join(f"{500 * i},2025-03-02 15:00:{i // 2:02d},35.73,-78.7,{10 + i},{110 + i}\n" for i in range(4)),
        {"vehicle": {"time": [0, 0.5, 1, 1.5], "altitude_m": [10, 11, 12, 13]}},
        "pose_csv",
    ),
    "FlyTrex and Litchi: ascent is above take-off, UTC beside local": Case(
        "flight.csv",
        "latitude,longitude,altitude(feet),ascent(feet),time(millisecond),datetime(utc),datetime(local),satellites\n"
        "35.73,-78.7,400,0,0,2025-03-02 15:00:00,2025-03-02 10:00:00,12\n"
        "35.73,-78.7,500,100,1000,2025-03-02 15:00:01,2025-03-02 10:00:01,12\n",
        {"vehicle": {"time": [0, 1], "altitude_m": [0, 30.48], "satellites": [12, 12]}},
        "pose_csv",
    ),
    "DJI Flight Reader: decimal commas, twelve hours, home beside the aircraft": Case(
        "dji.csv",
        '"CUSTOM.date [local]","CUSTOM.updateTime [local]","HOME.latitude","HOME.longitude","OSD.latitude","OSD.longitude",'
        '"OSD.height [ft]","OSD.yaw","GIMBAL.yaw"\n'
        '"2025-03-02","10:00:01,5 am","35,5","-78,5","35,73","-78,7","10,0","-9,5","0,0"\n',
        {"vehicle": {"time": [1.5], "latitude_deg": [35.73], "altitude_m": [3.048], "yaw_deg": [-9.5]}},
        "pose_csv",
    ),
    "DJI Flight Reader: UTC beside local": Case(
        "dji.csv",
        f"CUSTOM.date [UTC],CUSTOM.updateTime [UTC],CUSTOM.date [local],CUSTOM.updateTime [local],{DJI}\n"
        "2025-03-02,3:00:01.25 pm,2025-03-02,10:00:01.25 am,35.73,-78.7,10,-9.5\n",
        {"vehicle": {"time": [1.25], "yaw_deg": [-9.5]}},
        "pose_csv",
    ),
    "DJI Flight Reader: epochs": Case(
        "dji.csv", f"CUSTOM.updateTime [epoch],{DJI}\n1740927601.5,35.73,-78.7,10,-9.5\n",
        {"vehicle": {"time": [1.5], "altitude_m": [3.048]}}, "pose_csv"),
    "QGroundControl's CSV": Case(
        "qgc.csv",
        "Timestamp,roll,pitch,heading,altitudeRelative,altitudeAMSL,gps.lat,gps.lon,gps.courseOverGround,gps.lock,gps.count\n"
        "2025-03-02 10:00:01.125,1.5,-2,270,12.3,102.3,35.73,-78.7,265,3,14\n",
        {"vehicle": {"time": [1.125], "altitude_m": [12.3], "yaw_deg": [270], "fix": [3], "satellites": [14]}},
        "pose_csv",
    ),
    "PX4's receiver through ulog2csv": Case(
        "log_vehicle_gps_position_0.csv",
        "timestamp,time_utc_usec,lat,lon,alt,alt_ellipsoid,vel_n_m_s,vel_e_m_s,vel_d_m_s,fix_type,satellites_used\n"
        "112684000,1740927600250000,357300001,-787000001,120500,86500,0.5,0.25,-0.1,3,14\n"
        "112884000,1740927600450000,357300101,-787000001,121500,87500,0.5,0.25,-0.1,3,14\n",
        {
            "vehicle": {
                "time": [0.25, 0.45],
                "latitude_deg": [35.7300001, 35.7300101],
                "altitude_m": [0, 1],
                "velocity_north_mps": [0.5, 0.5],
            }
        },
        "pose_csv",
    ),
    "PX4's estimate through ulog2csv counts microseconds": Case(
        "log_vehicle_global_position_0.csv",
        "timestamp,timestamp_sample,lat,lon,alt,eph,epv\n1500000,1490000,35.73,-78.7,120.5,1,1\n2000000,1990000,35.73,-78.7,121.5,1,1\n",
        {"vehicle": {"time": [1.5, 2.0], "altitude_m": [0, 1]}}, "pose_csv",
        replace(LOCAL, time_origin="2025-03-02T15:00:00Z")),
    "ArduPilot's log in text": Case(
        "x.log",
        "FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns\n"
        "FMT, 130, 45, GPS, QBIHBLLe, TimeUS,Status,GMS,GWk,NSats,Lat,Lng,Alt\n"
        "FMT, 131, 29, ATT, Qccc, TimeUS,Roll,Pitch,Yaw\n"
        "GPS, 50000000, 3, 54018250, 2356, 12, 35.73, -78.7, 120.5\n"
        "ATT, 50000000, 1.5, -2.5, 270.5\n"
        "GPS, 50200000, 3, 54018450, 2356, 12, 35.7301, -78.7, 121.5\n",
        {"vehicle": {"time": [0.25, 0.45], "altitude_m": [0, 1], "yaw_deg": [270.5, 270.5], "satellites": [12, 12]}},
        "ardupilot_bin",
    ),
}  # fmt: skip

GNETTRACK = "Timestamp\tLongitude\tLatitude\tNetworkTech\tLevel\tQual\tARFCN\tPSC\tAltitude\tHeight\n"
NEMO = "Time,Longitude,Latitude,{c} (LTE pcell),Channel number (LTE pcell),RSRP (LTE pcell)," + (
    "{c} (LTE scell0),Channel number (LTE scell0),RSRP (LTE scell0)\n"
)
CASES |= {
    "G-NetTrack: 4G and 5G share a PCI, 3G has none; heights are the altitudes'": Case(
        "x.txt",
        GNETTRACK
        + "".join(
            f"2025.03.02_10.00.0{s}\t-78.7\t35.73\t{tech}\t{level}\t-9\t{arfcn}\t7\t{74 + s}\t0\n"
            for s, (tech, level, arfcn) in enumerate((("4G", -80, 2850), ("5G", -90, 631000), ("3G", -70, 10700)))
        ),
        {
            "lte_pci7": {"time": [0], "rss_db": [-80]},
            "nr_pci7": {"time": [1], "rss_db": [-90]},
            "phone": {"altitude_m": [0, 1, 2]},
        },
        "drive_test",
    ),
    "G-NetTrack's KML": Case(
        "x.kml",
        "<kml><Document>\n"
        + "".join(
            f'<Placemark><ExtendedData>\n<Data name="TIME"><value>2025.03.02_10.00.0{s}</value></Data>\n'
            f'<Data name="RSRP"><value>{-80 - s}</value></Data><Data name="PCI"><value>7</value></Data></ExtendedData>\n'
            f"<Point><coordinates>-78.7,35.73,{74 + s}</coordinates></Point></Placemark>\n"
            for s in (1, 2)
        )
        + "</Document></kml>\n",
        {"pci7": {"time": [1, 2], "rss_db": [-81, -82]}, "phone": {"altitude_m": [0, 1], "latitude_deg": [35.73] * 2}},
        "gnettrack_kml",
    ),
    "Nemo: two carriers serve at once": Case(
        "x.csv",
        NEMO.format(c="Physical cell identity")
        + "2025-03-02 10:00:01.250,-78.7,35.73,7,1300,-80.5,22,2850,-87\n"
        + "2025-03-02 10:00:02.250,-78.7,35.73,7,1300,-81.5,7,2850,-77\n",
        {
            "lte_pci7_arfcn1300": {"time": [1.25, 2.25], "rss_db": [-80.5, -81.5], "serving": [1, 1]},
            "lte_pci22": {"time": [1.25], "rss_db": [-87], "serving": [1]},
            "lte_pci7_arfcn2850": {"time": [2.25], "rss_db": [-77], "serving": [1]},
        },
        "drive_test",
    ),
    "TEMS: decimal commas say that the day comes first": Case(
        "x.csv",
        "Time;Longitude;Latitude;Serving PCI;Serving EARFCN (DL);Serving RSRP (dBm);Neighbor PCI[0];Neighbor EARFCN[0];"
        "Neighbor RSRP (dBm)[0]\n02/03/2025 10:00:00.250;-78,7;35,73;12;1300;-80,5;12;2850;-91,5\n",
        {
            "pci12_arfcn1300": {"time": [0.25], "rss_db": [-80.5]},
            "pci12_arfcn2850": {"time": [0.25], "rss_db": [-91.5]},
        },
        "drive_test",
    ),
    "TEMS: the file's name says which is the day": Case(
        "run_2025-03-02.csv", "Time,PCI,EARFCN,RSRP (dBm)\n02/03/2025 10:00:00.250,12,1300,-80.5\n",
        {"pci12": {"time": [0.25], "rss_db": [-80.5]}}, "drive_test"),
    "TEMS: words for months, tabs": Case(
        "x.txt", "Time\tServing PCI\tServing EARFCN\tServing RSRP (dBm)\n02-Mar-2025 10:00:00.250\t12\t1300\t-80.5\n",
        {"pci12": {"time": [0.25], "rss_db": [-80.5]}}, "drive_test"),
    "XCAL: NR and LTE in one row, a row without fix": Case(
        "x.csv",
        "TIME_STAMP,Lat,Lon,5G KPI PCell RF Serving PCI,5G KPI PCell RF Serving NR-ARFCN,5G KPI PCell RF Serving SS-RSRP [dBm],"
        "5G KPI PCell RF RI,LTE KPI PCell Serving PCI,LTE KPI PCell Serving RSRP[dBm]\n"
        "2025-03-02 10:00:00.250,35.73,-78.7,101,631000,-85.5,2,7,-80.5\n2025-03-02 10:00:01.250,,,101,631000,-86.5,3,7,-81.5\n",
        {
            "nr_pci101": {"time": [0.25, 1.25], "rss_db": [-85.5, -86.5]},
            "lte_pci7": {"time": [0.25, 1.25], "rss_db": [-80.5, -81.5]},
            "5g_kpi_pcell_rf_ri": {"time": [0.25, 1.25], "rank": [2, 3]},
        },
        "drive_test",
    ),
    "XCAL: a layer number, times of the day, a date in the name": Case(
        "2025-03-02_xcal.csv",
        "TIME_STAMP,Lat,Lon,5G KPI PCell Layer1 DL Layer Num (Mode),5G KPI PCell RF Serving PCI,5G KPI PCell RF Serving SS-RSRP [dBm]\n"
        "10:00:00.250,35.73,-78.7,2,101,-85.5\n10:00:01.250,35.73,-78.7,4,101,-86.5\n",
        {"nr_pci101": {"time": [0.25, 1.25]}, "5g_kpi_pcell_layer1_dl_layer_num_mode": {"rank": [2, 4]}},
        "drive_test",
    ),
    "XCAL: title lines, epochs in ms": Case(
        "x.csv",
        "XCAL export\n\nTIMESTAMP,Serving PCI,SS-RSRP [dBm]\n1740927600250,101,-85.5\n1740927601250,102,-86.5\n",
        {"nr_pci101": {"time": [0.25], "rss_db": [-85.5]}, "nr_pci102": {"time": [1.25], "rss_db": [-86.5]}},
        "drive_test"),
    "QualiPoc: date and time apart": Case(
        "x.csv",
        "Date,Time,GPS Latitude,GPS Longitude,LTE Serving Cell PCI,LTE Serving Cell RSRP [dBm],LTE Rank Indicator\n"
        "02.03.2025,10:00:00.250,35.73,-78.7,7,-80.5,1\n02.03.2025,10:00:01.250,35.73,-78.7,7,-81.5,2\n",
        {"lte_pci7": {"time": [0.25, 1.25], "rss_db": [-80.5, -81.5]}, "lte_rank_indicator": {"rank": [1, 2]}},
        "drive_test",
    ),
    "QualiPoc: UTC by the column's name": Case(
        "x.csv", "Time UTC;LTE Serving Cell PCI;LTE Serving Cell RSRP [dBm]\n2025-03-02 15:00:00.250;7;-80,5\n",
        {"lte_pci7": {"time": [0.25], "rss_db": [-80.5]}}, "drive_test"),
    "QualiPoc: twelve hours, month first": Case(
        "x.csv",
        "Time,LTE Serving Cell PCI,LTE Serving Cell RSRP [dBm]\n03/02/2025 10:00:00.250 AM,7,-80.5\n03/13/2025 10:00:00 AM,7,-80.5\n",
        {"lte_pci7": {"time": [0.25, 946800.0], "rss_db": [-80.5, -80.5]}}, "drive_test"),
    "a cell a row: the registered one serves": Case(
        "phone.csv",
        "timestamp,latitude,longitude,rat,pci,earfcn,rsrp,is_registered\n"
        "2025-03-02T10:00:00.250-05:00,35.73,-78.7,LTE,7,1300,-80,true\n"
        "2025-03-02T10:00:00.250-05:00,35.73,-78.7,LTE,8,1300,-90,false\n"
        "2025-03-02T10:00:01.250-05:00,35.73,-78.7,LTE,7,2850,-81,true\n",
        {
            "lte_pci7_arfcn1300": {"time": [0.25], "serving": [1]},
            "lte_pci8": {"time": [0.25], "serving": [0]},
            "lte_pci7_arfcn2850": {"time": [1.25], "serving": [1]},
        },
        "drive_test",
    ),
    "CellMapper: signal of a PCI": Case(
        "cm.csv",
        "Latitude,Longitude,MCC,MNC,CID,Signal,Type,ARFCN,PSC or PCI,Timestamp\n35.73,-78.7,310,260,2,-85,LTE,2850,325,1740927600250\n",
        {"lte_pci325": {"time": [0.25], "rss_db": [-85]}}, "drive_test"),
    "one RNTI in two cells of an srsRAN gNB": Case(
        "gnb.json",
        "".join(
            f'{{"timestamp": "2025-03-02T15:00:0{s}.500", "cells": [{{"cell_metrics": {{"pci": {pci}}}, "ue_list": '
            f'[{{"pci": {pci}, "rnti": 17921, "dl_ri": {pci}.0}}]}}]}}\n'
            for s in (1, 2)
            for pci in (1, 2)
        ),
        {"gnb_pci1": {"time": [1.5, 2.5], "rank": [1, 1]}, "gnb_pci2": {"time": [1.5, 2.5], "rank": [2, 2]}},
        "srsran_json",
    ),
    "OAI's newest layout": Case(
        "oai.log",
        "".join(
            STAMPED.format(
                s=s,
                text="UE RNTI 2460 CU-UE-ID 2 in-sync PH 28 dB PCMAX 24 dBm, average RSRP -74 (8 meas), average SINR 40.0",
            )
            + STAMPED.format(
                s=s, text="UE 2460: dlsch_rounds 9/5/1/0, dlsch_errors 2, BLER 0.19557 MCS (1) 23 (Qm 8) CCE fail 3"
            )
            + STAMPED.format(s=s, text=f"UE 2460: CSI [CQI {16 - s} RI {s} PMI (14,1)] SRS [UL-RI 2 TPMI 0]")
            for s in (1, 2)
        ),
        {"oai": {"time": [1, 2], "rank": [1, 2], "cqi": [15, 14]}, "nr_rsrp": {"rss_db": [-74, -74]}},
        "oai_log",
    ),
}  # fmt: skip


ENDC = (
    '2025-03-02 10:00:0{s}.250,"+QENG: ""servingcell""","NOCONN","LTE","FDD",310,410,ABCDEF,{lte},3,5,5,1234,{level},-9,-55,20,'
    '12,230,40,"+QENG: ""NR5G-NSA""",310,410,{nr}\n'
)
UE = "   0    {pci}  {level}   61 -4.2k |   2   25   1.0   3.9k    0%    1.6 |  18    0.0    35k    0%"
CASES |= {
    "Quectel: a handover to another cell on the way, and NR lost": Case(
        "Serving_cell_Params_ENDC.csv",
        ENDC.format(s=0, lte="7,1300", level=-85, nr="101,-88,25,-11,631000,78,12,1")
        + ENDC.format(s=1, lte="8,2850", level=-86, nr="65535,-32768,-32768,-32768")
        + ENDC.format(s=2, lte="7,2850", level=-87, nr="101,-89,24,-11,631000,78,12,1"),
        {
            "lte_pci7_arfcn1300": {"time": [0.25], "rss_db": [-85]},
            "lte_pci8": {"time": [1.25], "rss_db": [-86]},
            "lte_pci7_arfcn2850": {"time": [2.25], "rss_db": [-87]},
            "nr_rsrp": {"time": [0.25, 1.25, 2.25], "rss_db": [-88, np.nan, -89], "sinr_db": [25, np.nan, 24]},
        },
        "quectel_csv",
    ),
    "srsUE: two carriers share a PCI": Case(
        "x_radio_log.txt",
        STAMPED.format(
            s=0, text=" cc  pci  rsrp   pl   cfo | mcs  snr  iter  brate  bler  ta_us | mcs   buff  brate  bler"
        )
        + "".join(
            STAMPED.format(s=s, text=UE.format(pci=1, level=level).replace("   0 ", f"   {cc} ", 1))
            for s in (1, 2)
            for cc, level in ((0, -60 - s), (1, -70 - s))
        ),
        {"lte_pci1": {"time": [1, 2], "rss_db": [-61, -62]}, "lte_pci1_cc1": {"time": [1, 2], "rss_db": [-71, -72]}},
        "srsue_log",
    ),
    "srsUE of srsLTE, before 2020": Case(
        "x_radio_log.txt",
        STAMPED.format(
            s=0, text="cc  rsrp    pl    cfo   mcs   snr turbo  brate   bler   ta_us  mcs   buff  brate   bler"
        )
        + STAMPED.format(
            s=1, text=" 0   -77    78   1.2k    24    33  0.84   5.8M     0%   0.0    18   193k   624k     0%"
        ),
        {"lte_rsrp": {"time": [1], "rss_db": [-77], "sinr_db": [33], "pathloss_db": [78]}},
        "srsue_log",
    ),
    "srsENB of srsLTE, before 2020": Case(
        "x_radio_enb_log.txt",
        STAMPED.format(s=0, text="rnti  cqi    ri   mcs  brate   bler   snr   phr   mcs  brate   bler    bsr")
        + STAMPED.format(s=1, text="  46  15.0     2  27.5   1.2M     0%  33.1  40.0  22.9   624k     0%    0.0"),
        {"srsenb": {"time": [1], "rank": [2], "cqi": [15]}},
        "srsenb_log",
    ),
}


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
    """A line of the tap; ``place`` are hundredths of a second."""
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
}  # fmt: skip
CASES |= {name: Case(file, data, truth, reader, how) for name, (reader, file, data, truth, how) in BINARY.items()}


NAN = np.nan
SAMPLES = [
    Case("Quectel: 0 is no CSI", samples.FILES["quectel_csv/csi"], {
        "nr5g_csi": {"time": [0.25, 2.25, 6.25], "ri_raw": [2, 0, 4], "rank": [2, NAN, 4], "flag": ["", "no_csi", ""], "mcs": [24, NAN, 24]},
        "lte_csi": {"rank": [1, 1, 1]},
    }, "quectel_csv", refused="torn"),
    Case("Quectel: first generation, an impossible RI", samples.FILES["quectel_csv/csi_first_generation"], {
        "nr5g_csi": {"time": [0, 9], "rank": [3, NAN], "flag": ["", "ri_out_of_range"]},
    }, "quectel_csv"),
    Case("Quectel: NSA writes RSRP, SINR, RSRQ", samples.FILES["quectel_csv/endc"], {
        "nr_rsrp": {"rss_db": [-82, NAN], "sinr_db": [21, NAN]}, "lte_rsrp": {"rss_db": [-91, -91]},
    }, "quectel_csv", about={"nr_rsrp": {"unit": "dBm"}}, refused="searching"),
    Case("Quectel: SA writes RSRP, RSRQ, SINR, among LTE rows", samples.FILES["quectel_csv/lte_only"], {
        "lte_rsrp": {"rss_db": [-93]}, "nr_rsrp": {"rss_db": [-71], "sinr_db": [32]},
    }, "quectel_csv"),
    Case("Quectel: console, cells by their tables", samples.FILES["quectel_console/tables"], {
        "nr_pci77": {"rss_db": [-82], "rsrq_db": [-11], "sinr_db": [21]}, "nr5g_csi": {"rank": [2]},
    }, "quectel_console", about={"lte_pci492": {"arfcn": 950}}),
    Case("table of ranks", samples.FILES["quectel_ri/table"], {"nr5g_csi": {"rank": [2, NAN], "altitude_m": [30.1, 30.2]}}, "quectel_ri"),
    Case("Nemo: a row without a rank keeps its level", samples.FILES["nemo_csv/table"], {
        "pdsch_rank": {"rank": [2, NAN, 4], "flag": ["", "no_rank_in_row", ""], "rsrp_dbm": [NAN, -80.5, NAN], "cqi": [NAN, 14, NAN]},
    }, "nemo_csv", FROM_TEN, about={"pdsch_rank": {"clock": "utc"}}),
    Case("Nemo: cells by PCI; one goes on serving when it is detected later", samples.FILES["drive_test/nemo"], {
        "lte_pci110": {"rss_db": [-76, -77], "serving": [1, 1]}, "lte_pci22": {"serving": [0]}, "rs_snr": {"value": [19]},
        "phone": {"fix": [-1] * 3},
    }, "drive_test"),
    Case("SNR table of towers", samples.FILES["aadm_snr/table"], {"LW2": {"flag": ["", "out_of_coverage"]}}, "aadm_snr",
         about={name: {"node": name, "unit": "dB"} for name in ("LW1", "LW2")}),
    Case("controller: the Download block holds no levels", samples.FILES["controller_log/console"], {
        "LW1": {"rss_db": [9.5, 8.5]}, "LW2": {"rss_db": [-1.25]},
    }, "controller_log"),
    Case("srsENB: 0 is no report, 1 is rank one", samples.FILES["srsenb_log/console"], {
        "srsenb": {"rank": [NAN, 1, NAN], "ri_raw": [0, 1, NAN], "cqi": [11, 11, NAN], "mcs": [2, 2, 0], "flag": ["no_csi", "", "no_csi"]},
    }, "srsenb_log", about={"srsenb": {"ri_base": "one"}}, warned="truncated mean"),
    Case("PawPrints: who serves; 2147483647 is no level; the companion's clock, UTC", samples.FILES["pawprints/session"], {
        "lte_pci1": {"rss_db": [-71, -70], "serving": [0, 1]}, "lte_pci2": {"time": [0.2505], "rss_db": [-62]},
        "nr_ss_rsrp": {"rss_db": [-88], "rsrq_db": [-11], "sinr_db": [33]},
    }, "pawprints", about={"lte_pci2": {"pci": 2, "arfcn": 66911, "rat": "lte"}}),
    Case("PawPrints with a location", samples.FILES["pawprints/session"].replace(
        b'"rel_time": 1.0', b'"location": {"latitude": 35.5, "longitude": -78.5, "altitude": 90}'
    ), {"phone": {"latitude_deg": [35.5], "longitude_deg": [-78.5], "altitude_m": [0]}}, "pawprints"),
    Case("XCAL: semicolons and decimal commas", samples.FILES["drive_test/xcal"], {
        "nr_pci7": {"rss_db": [-81.5, -82.5]}, "phone": {"longitude_deg": [-78.7000001] * 2}, "5g_kpi_pcell_rf_ri": {"rank": [2]},
    }, "drive_test"),
    Case("GPX: heights count from the first point", samples.FILES["gpx/track"], {"track": {"time": [0.25, 1], "altitude_m": [0, 10]}}, "gpx"),
    Case("flight script: neither home nor a waypoint is a position", samples.FILES["vehicle_log/console"], {
        "vehicle": {"altitude_m": [40.5, 40.0], "yaw_deg": [312.5, NAN]}, "power": {"value": [-12.5, NAN]},
    }, "vehicle_log"),
    Case("srsUE: cells and SI suffixes", samples.FILES["srsue_log/console"], {
        "lte_pci1": {"rss_db": [-61, -62], "pathloss_db": [61, 62]}, "lte_pci7": {"serving": [1]}, "cfo": {"value": [-4200, -950, 1500]},
    }, "srsue_log"),
    Case("OAI gNB: the old layout and the new", samples.FILES["oai_log/gnb"], {
        "oai": {"rank": [2, 1], "rnti": [0x1F4D] * 2}, "nr_rsrp": {"rss_db": [-78]},
    }, "oai_log"),
    Case("OAI gNB: 128 frames of 10 ms", samples.FILES["oai_log/frames"], {"oai": {"time": [0, 1.28]}}, "oai_log",
         replace(LOCAL, time_origin="2025-03-02T15:00:00Z")),
    Case("OAI UE", samples.FILES["oai_log/ue"], {"oai": {"time": [0.25, 1.25], "rank": [2, 1], "sinr_db": [20, 19]}}, "oai_log"),
    Case("SigMF of dataset 12", samples.FILES["sigmf/dataset12"], {
        "vehicle": {"longitude_deg": [-78.7, -78.71]}, "USRP1": {"time": [0.25, 0.55], "rss_db": [-40.5, -41.5]},
        "USRP2": {"flag": ["", "out_of_coverage"]},
    }, "sigmf"),
    Case("MATLAB, two channels: units and silence", samples.mat_flight(), {"USRP1": {"flag": ["", "", "out_of_coverage", "", ""]}},
         "flight_mat", about={"USRP1": {"unit": "dB re full scale"}}),
    Case("MATLAB, LTE: unit and silence", samples.lte_flight(),
         {key: {"flag": ["", "", "out_of_coverage", "", ""]} for key in ("RSRP", "RSRP2")},
         "flight_mat", about={"RSRP": {"quantity": "RSRP", "unit": "dB re full scale"}}),
    Case("MATLAB, processed: no clock", samples.processed_flight(), {"vehicle": {"yaw_deg": [90.0] * 4}}, "flight_mat",
         about={"vehicle": {"clock": "relative"}, "RSRP": {"unit": "dBm"}}, warned="no clock"),
]  # fmt: skip
CASES |= {case.name: case for case in SAMPLES}


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
    """A format of one row per instant: what stands above the rows, a row, and the column that ``v`` must come out in.

    ``t`` is the wall clock (local, or UTC where ``utc``), ``s`` the seconds of the epoch, ``ms`` its milliseconds.
    """

    head: str
    row: str
    stream: str
    column: str
    utc: bool = False
    name: str = "log.txt"


RANKS, ENB = "rank", "| 31.5 12.5 40 15 38k"
FORMS = {
    "vehicle_out, 10 fields": Form(
        "", '{i},-78.7,35.73,{v}.5,"(0.1,1.5,0.1)","(0.0,5.0,0.1)",48.1,{t},4,18\n', "vehicle", "altitude_m"
    ),
    "vehicle_out, 9 fields, titled": Form(
        LOG2CSV.replace("Time,", ""), "{i},-78.7,35.73,{v}.5,48.1,90,{t},4,18\n", "vehicle", "altitude_m"
    ),
    "vehicle_out, 8 fields, UTC": Form(
        "", "{i},-78.7,35.73,{v}.5,48.1,{t}+00:00,4,18\n", "vehicle", "altitude_m", utc=True
    ),
    "pose_csv, columns turned": Form(
        "Heading (deg),Height above takeoff,Longitude,LATITUDE,Timestamp\n", "90,{v}.5,-78.7,35.73,{t}\n", "vehicle", "altitude_m"
    ),
    "pose_csv, UTC by the column's name": Form(
        "Export of a flight\n\nLat;Lon;Rel Alt;datetime(utc)\n", "35,73;-78,7;{v},5;{t}\n", "vehicle", "altitude_m", utc=True
    ),
    "vehicle_log": Form(
        "", '[{t}] Current location is {{"lat": 35.73, "lon": -78.7, "alt": {v}.5}}\n', "vehicle", "altitude_m"
    ),
    "gpx": Form(
        "<gpx>\n", '<trkpt lat="35.73" lon="-78.7"><ele>{v}.5</ele><course>{v}</course><time>{t}Z</time></trkpt>\n',
        "track", "above the first", utc=True,
    ),
    "sounder_log": Form("", "[{t}] {i:07o} {v:15d}.5\n", "power", "level", name="x_power_log.txt"),
    "aadm_snr": Form("time,snr_lw3\n", "{t},{v}.5\n", "LW3", "level"),
    "controller_log": Form(
        "", "[{t}] [Controller-->UAV] SNR:\n[{t}] 2:{v}.5\n[{t}] [Controller-->UAV] Download:\n[{t}] 2:99.5\n", "LW2", "level"
    ),
    "quectel_csv": Form(
        "OK\n", '{t},"+QNWCFG: ""lte_csi""",20,1,9,3,"+QNWCFG: ""nr5g_csi""",24,{v},12,5\n', "nr5g_csi", RANKS
    ),
    "quectel_ri": Form(
        "ID,Time and date,Longitude,Latitude,Altitude,NR RI\n", "{i},{t},-78.7,35.73,30.1,{v}\n", "nr5g_csi", RANKS
    ),
    "quectel_console": Form(
        "", '{t}\n|    |----+\n|  0 | +QNWCFG: "nr5g_csi" | 24 | {v} | 12 | 5 |\n', "nr5g_csi", RANKS
    ),
    "srsenb_log": Form(
        "[2025-01-01 00:00:00.000000] rat rnti  cqi  ri  mcs  brate ok nok (%)\n",
        "[{t}] lte   46   11   {v}    2   3.7k   14    0   0% " + ENB + "\n", "srsenb", RANKS,
    ),
    "srsue_log": Form(
        "[2025-01-01 00:00:00.000000] cc pci rsrp pl cfo | mcs snr\n",
        "[{t}]   0    7   -{v}   61 -4.3k |   0   25   1.0   4.5k    0%  1.6 |  23  83k  19M\n", "lte_pci7", "-level",
    ),
    "srsran_gnb": Form(
        "[2025-01-01 00:00:00.000000]  pci rnti | cqi ri mcs\n",
        "[{t}]   1 4601 |  15   {v}   28    17M  908    0   0%    44k |  26.7 -21.2\n", "gnb", RANKS,
    ),
    "srsran_json": Form(
        "", '{{"timestamp": {s}, "ue_list": [{{"pci": 1, "rnti": 5, "dl_ri": {v}}}]}}\n', "gnb", RANKS, utc=True
    ),
    "oai_log": Form("", "[{t}] [NR_MAC] UE 1f4d: CQI 15, RI {v}, PMI (14,1)\n", "oai", RANKS),
    "pawprints": Form(
        "", '{{"abs_time": 1, "companion_abs_time": {ms}, "cells": [{{"technology": "4G_LTE", "rsrp": -{v}, "pci": 7}}]}}\n',
        "lte_pci7", "-level", utc=True,
    ),
    "drive_test, two carriers": Form(
        "Timestamp,PCI,EARFCN,RSRP (dBm),N1 PCI,N1 EARFCN,N1 RSRP\n", "{t},7,1300,-{v},7,2850,-99\n", "pci7_arfcn1300", "-level"
    ),
}  # fmt: skip
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


def written(form: Form, begin: datetime) -> tuple[str, list[np.datetime64]]:
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
    text, instants = written(form, INSTANTS[when])
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
    "x_power_log.txt": od((1.0, -20.5)), "gnb.json": CASES["srsRAN Project's JSON with texts is UTC"].data,
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
