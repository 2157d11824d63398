"""Synthetic samples of every format, several encodings each; written here, none taken from a real log.

``SAMPLES`` maps a reader's name to its samples: name of the sample to (bytes, accepted lines, rejected lines).
"""

import io
import zlib

import h5py
import numpy as np
import scipy.io

from aerpaw_cmp.logs.readers import ReadOptions
from tests.parsers import autopilots

OPTIONS = ReadOptions(
    timezone="America/New_York", time_origin="2025-03-02T15:00:00Z", kind="rss",
    columns={"time": "Time", "rss_db": "Level"}, unit="dBm",
    file_name="results_3320000000.0_2000000.0_2025_03_02_10_00_00_250.mat",
)  # fmt: skip

VEHICLE_10 = (
    b'1,-78.7000001,35.7300002,0.5,"(0.1,1.5,-0.05)","(1.0,2.0,-0.5)",48.1,2025-03-02 10:00:00.250000,3,12\r\n'
    b'2,-999,-999,-999,"(0.1,1.5,-0.05)","(0.0,0.0,0.0)",48.1,2025-03-02 10:00:01.250000,1,4\r\n'
    b'3,-78.7000003,35.7300004,1.5,"(0,0,0)","(0,0,0)",48.0,2025-03-02 10:00:02.250000,4,14\r\n'
)
VEHICLE_9 = (
    b"1,-78.7000001,35.7300002,0.5,48.1,99,2025-03-02 10:00:00.250000,5,12\r\n"
    b"2,-78.7000002,35.7300003,1.0,48.1,98,2025-03-02 10:00:01.250000,6,12\r\n"
)
VEHICLE_8 = (
    b"1,-78.7000001,35.7300002,0.5,48.1,2025-03-02 10:00:00.250000,3,12\n"
    b"2,-78.7000002,35.7300003,1.0,48.1,2025-03-02 10:00:01.250000,3,12\n"
)
VEHICLE_11 = (
    b"1,-78.7000001,35.7300002,0.5,0.1,1.5,-0.05,48.1,2025-03-02 10:00:00.250000,3,12\r\n"
    b"2,-78.7000002,35.7300003,1.0,0.1,1.5,-0.05,48.1,2025-03-02 10:00:01.250000,3,12\r\n"
)
VEHICLE_UTC = VEHICLE_10.replace(b"02 10:", b"02 15:").replace(b".250000", b".250000+00:00")

SOUNDER = (
    b"[2025-03-02 10:00:00.000000] 0000000       -20.12345\n"
    b"[2025-03-02 10:00:00.032760] 0000004            -1.5\n"
    b"[2025-03-02 10:00:00.065520] 0000010       -788.5956\n"
    b"[2025-03-02 10:00:00.098280] *\n"
    b"[2025-03-02 10:00:00.196560] 0000030      0.12345678\n"
    b"[2025-03-02 10:00:00.229320] 0000034           2e-05\n"
    b"[2025-03-02 10:00:00.262080] 0000040\n"
)


def sounder_log(count: int) -> bytes:
    """A power log of so many samples: a run of '*', a jump and a silent sample among them."""
    out, offset = [], 0
    for i in range(count):
        stamp = f"[2025-03-02 10:{i // 1500:02d}:{i // 25 % 60:02d}.{i % 25 * 40000:06d}]"
        if i % 40 == 17:
            out.append(f"{stamp} *")
            offset += 12
            continue
        offset += 44 if i % 97 == 96 else 4
        out.append(f"{stamp} {offset:07o} {-788.5956 if i % 50 == 9 else -40 - i % 13:15.4f}")
    return ("\n".join(out) + "\n").encode()


SOUNDER_GROWN = (
    b"[2025-03-02 10:00:00.000000] 7777770       -20.12345\n"
    b"[2025-03-02 10:00:00.032760] 7777774           -21.5\n"
    b"[2025-03-02 10:00:00.065520] 10000000           -22.5\n"
    b"[2025-03-02 10:00:00.098280] 10000004           -23.5\n"
)

QUECTEL_CSI = (
    b"OK\n"
    b'2025-03-02 10:00:00.250,"+QNWCFG: ""lte_csi""",20,1,9,3,"+QNWCFG: ""nr5g_csi""",24,2,12,5\r\n'
    b'2025-03-02 10:00:02.250,"+QNWCFG: ""lte_csi""",20,1,9,3,"+QNWCFG: ""nr5g_csi""",0,0,0,0\r\n'
    b'2025-03-02 10:00:04.250,"+QNWCFG: ""lte_csi""",20,1,9,3,"+QNWCFG: ""nr5g_csi""",13,2,\r\n'
    b'2025-03-02 10:00:06.250,"+QNWCFG: ""lte_csi""",20,1,9,3,"+QNWCFG: ""nr5g_csi""",24,4,12,5\r\n'
)
QUECTEL_FIRST = (
    b'2025/03/02 10:00:00,"+QENDC: 1",1,1,0,"+QNWCFG: ""lte_csi""",20,1,9,3,"+QNWCFG: ""nr5g_csi""",24,3,12,5,'
    b'"+QNWINFO: ""TDD NR5G""","""00101""","""NR5G BAND 78""",640000\r\n'
    b'2025/03/02 10:00:09,"+QENDC: 1",1,1,0,"+QNWCFG: ""lte_csi""",20,1,9,3,"+QNWCFG: ""nr5g_csi""",24,9,12,5,'
    b'"+QNWINFO: ""TDD NR5G""","""00101""","""NR5G BAND 78""",640000\r\n'
)
_ENDC = b'"+QENG: ""servingcell""","""NOCONN""","+QENG: ""LTE""","""FDD""",001,01,ABC123,42,1850,3,5,5,1F,-91,-12,-61,14,0,230,-,'
QUECTEL_ENDC = (
    b"2025-03-02 10:00:00.250," + _ENDC + b'"+QENG:""NR5G-NSA""",001,01,77,-82,21,-11,640000,78,8,1\r\n'
    b"2025-03-02 10:00:02.250," + _ENDC + b'"+QENG:""NR5G-NSA""",001,01,65535,-32768,-32768,-32768\r\n'
    b'2025-03-02 10:00:04.250,"+QENG: ""servingcell""","""SEARCH"""\r\n'
)
QUECTEL_ONE_LINE = (
    b'2025-03-02 10:00:00.250,"+QENG: ""servingcell""","""NOCONN""","""LTE""","""FDD""",001,01,ABC123,42,1850,3,5,5,1F,'
    b"-93,-12,-61,14,-,-,-\r\n"
    b'2025-03-02 10:00:02.250,"+QENG: ""servingcell""","""NOCONN""","""NR5G-SA""","""TDD""",001,01,000ABC001,42,8D,640000,78,'
    b"12,-71,-11,32,1,-\r\n"
)

RI_TABLE = (
    b"ID,Time and date,Longitude,Latitude,Altitude,NR RI\r\n"
    b"1,2025-03-02 10:00:00.250,-78.7000001,35.7300002,30.1,2\r\n"
    b"2,2025-03-02 10:00:00.500,-78.7000002,35.7300003,30.2,0\r\n"
    b"3,2025-03-02 10:00:00.750,-78.7000003,35.7300004,30.3\r\n"
)

NEMO_CSV = (
    b"index,rel_time_ms,lat,lon,alt_m,pdsch_rank,nr_rsrp_dbm,nr_sinr_db,wb_cqi\r\n"
    b"10,-1500.25,35.7300001,-78.7000002,-0.5,2.0,,,\r\n"
    b"11,500.0,35.7300002,-78.7000003,10.5,,-80.5,31.0,14.0\r\n"
    b"12,1000.0,35.7300002,-78.7000003,10.5,4.0,,,\r\n"
)
_DESCRIPTION = (
    b"            <description>&lt;p&gt;&lt;strong&gt;nemo&lt;/strong&gt;&lt;/p&gt;&lt;p&gt;rel_time = %s ms&lt;/p&gt;"
    b"&lt;p&gt;PDSCH rank (NR) = %s &lt;/p&gt;&lt;p&gt;(lat, lon) = (35.7300001,-78.7000002)&lt;/p&gt;"
    b"&lt;p&gt; altitude = 10.25 m&lt;/p&gt;&lt;p&gt; index = 7&lt;/p&gt;</description>\n"
)
GNETTRACK_KML = (
    b"<?xml version='1.0'?>\n<kml><Document>\n"
    + b"".join(
        b'<Placemark><ExtendedData>\n<Data name="TIME"><value>2025.03.02_10.00.0%d</value></Data>\n'
        b'<Data name="RSRP"><value>-8%d</value></Data><Data name="PCI"><value>7</value></Data></ExtendedData>\n'
        b"<Point><coordinates>-78.7,35.73,7%d</coordinates></Point></Placemark>\n" % (s, s, s)
        for s in (1, 2)
    )
    + b"</Document></kml>\n"
)

NEMO_KML = (
    b'<?xml version="1.0" encoding="UTF-8"?>\n<kml xmlns="http://www.opengis.net/kml/2.2">\n  <Document>\n'
    b"    <Placemark>\n" + _DESCRIPTION % (b"-1500.25", b"2.0") + b"    </Placemark>\n"
    b"    <Placemark>\n" + _DESCRIPTION % (b"500.0", b"4.0") + b"    </Placemark>\n"
    b"    <Placemark>\n            <description>rel_time = 700.0 ms PDSCH rank (NR) = \n    </Placemark>\n"
    b"  </Document>\n</kml>\n"
)

SNR_CSV = (
    b"time,snr_lw1,snr_lw2\r\n"
    b"2025-03-02 10:00:00.250000,9.5,-1.25\r\n"
    b"2025-03-02 10:00:01.250000,9.0,-758.5956\r\n"
    b"2025-03-02 10:00:02.250000,9.0\r\n"
)
CONTROLLER = (
    b"[2025-03-02 10:00:00.000001] Listening on port 8005 for UAV\n"
    b"[2025-03-02 10:00:00.100001] [Controller-->UAV] SNR:\n"
    b"[2025-03-02 10:00:00.100004] 1:9.500000\n"
    b"[2025-03-02 10:00:00.100007] 2:-1.250000\n"
    b"[2025-03-02 10:00:00.200001] [Controller-->UAV] Download:\n"
    b"[2025-03-02 10:00:00.200004] 1:100.000000\n"
    b"[2025-03-02 10:00:01.100001] [Controller-->UAV] SNR:\n"
    b"[2025-03-02 10:00:01.100004] 1:8.500000\n"
    b"[2025-03-02 10:00:01.100007] 2:\n"
)
SRSENB = (
    b"[2025-03-02 10:00:00.000001] ---  a console  ---\n"
    b"[2025-03-02 10:00:00.000002] rat rnti  cqi  ri  mcs  brate   ok  nok  (%) | pusch  pucch  phr  mcs  brate   ok  nok  (%)    bsr\n"
    b"[2025-03-02 10:00:00.000003] lte   46   11   0    2   3.7k   14    0   0% |  31.5   12.5   40   15    38k   12    0   0%    0.0\n"
    b"[2025-03-02 10:00:01.000003] lte   46   11   1    2   3.7k   14    0   0% |   n/a   12.5   40   15    38k   12    0   0%    0.0\n"
    b"[2025-03-02 10:00:02.000003] lte   46  n/a n/a    0      0    0    0   0% |   n/a   12.5   40   15    38k   12    0   0%    0.0\n"
    b"[2025-03-02 10:00:03.000003] lte   46   11   1  \n"
)
SRSENB_OLD = (
    b"[2025-03-02 10:00:00.000001] rnti cqi  ri mcs brate   ok  nok  (%)  pusch pucch phr mcs brate   ok  nok  (%)   bsr\n"
    b"[2025-03-02 10:00:00.000003]   46  11   2   2  3.7k   14    0   0%   31.5  12.5  40  15   38k   12    0   0%  0.0\n"
    b"[2025-03-02 10:00:01.000003]   46  11   0   2  3.7k   14    0   0%    n/a  12.5  40  15   38k   12    0   0%  0.0\n"
)
SRSENB_NR = (
    b"[2025-03-02 10:00:00.000002] rat  pci rnti  cqi  ri  mcs  brate   ok  nok  (%) | pusch  pucch  phr  mcs  brate\n"
    b"[2025-03-02 10:00:00.000003] lte    1   46   15   1    2   3.7k   14    0   0% |  31.5   12.5   40   15    38k\n"
    b"[2025-03-02 10:00:00.000003]  nr  500 4601  n/a   0   27   6.9M  124    0   0% |   n/a    n/a    0    0   6.1M\n"
)
SRSUE = (
    b"[2025-03-02 10:00:00.000001] Attaching UE...\n"
    b"[2025-03-02 10:00:00.000002]  cc  pci  rsrp   pl   cfo | mcs  snr  iter  brate  bler  ta_us | mcs   buff  brate  bler\n"
    b"[2025-03-02 10:00:00.000003]   0    1   -61   61 -4.2k |   2   25   1.0   3.9k    0%    1.6 |  18    0.0    35k    0%\n"
    b"[2025-03-02 10:00:01.000003]   0    1   -62   62  -950 |   2  n/a   1.0   3.9k    0%    1.6 |  18    0.0    35k    0%\n"
    b"[2025-03-02 10:00:02.000003]   0    7   -63   63  1.5k |   2   25   1.0   3.9k    0%    1.6 |  18    0.0    35k    0%\n"
    b"[2025-03-02 10:00:03.000003]   0    7   -63   63  \n"
)
VEHICLE_LOG = (
    b"[2025-03-02 10:00:00.000001] Starting rover search script\n"
    b'[2025-03-02 10:00:01.000001] Home location is {"lat": 35.73, "lon": -78.7, "alt": 1.5}\n'
    b"[2025-03-02 10:00:02.000001] Filtered data (avg): Pwr:-12.5,P_Var:1.5, Qual:58.5,Q_Var:1.25, "
    b'{"lat": 35.7300001, "lon": -78.7000001, "alt": 40.5}, heading:312.5\n'
    b'[2025-03-02 10:00:03.000001] Current location is {"lat": 35.7300002, "lon": -78.7000002, "alt": 40.0}\n'
    b'[2025-03-02 10:00:04.000001] Moving to next waypoint: {"lat": 35.74, "lon": -78.7, "alt": 40}\n'
    b"[2025-03-02 10:00:05.000001] Filtered data (avg): Pwr:-12.5,P_Var\n"
)
GPX = (
    b"<?xml version='1.0' encoding='UTF-8'?>\n<gpx creator='x' version='1.1'>\n<trk><trkseg>\n"
    b'<trkpt lat="35.7300001" lon="-78.7000002">\n<ele>76.5</ele>\n<time>2025-03-02T15:00:00.250Z</time>\n</trkpt>\n'
    b"<trkpt lon='-78.7000003' lat='35.7300002'><time>2025-03-02T15:00:01Z</time><ele>86.5</ele></trkpt>\n"
    b'<trkpt lat="35.7300001" lon="-78.7000002">\n<ele>76.5</ele>\n</trkpt>\n'
    b"</trkseg></trk>\n</gpx>\n"
)
GPX_NEMO = GPX.replace(b"2025-03-02T15:00:00.250Z", b"T10:00:00.250Z").replace(
    b"2025-03-02T15:00:01Z", b"T10:00:01.000Z"
)
_CELL = b'{"technology": "4G_LTE", "rsrp": %d, "rsrq": -6, "rssi": -51, "rssnr": 2147483647, "earfcn": "66911", "pci": "%d", "is_connected": "%s"}'
_LTE = (
    b"BS_INFO_START,4G_LTE,%s,1.01,1.9E8,-97,Unavailable,%d,-12,-65,Unavailable,23,%d,16,8,1,2,3,310,410,BS_INFO_STOP,"
)
PAWPRINTS_TEXT = (
    b"CELL_LOG_START,1740927600250,1.01,2,op,op,Op,"
    + _LTE % (b"true", -97, 950)
    + _LTE % (b"false", -99, 66486)
    + b"CELL_LOG_STOP\n"
    b"CELL_LOG_START,1740927601250,2.01,1,op,op,Op," + _LTE % (b"true", -98, 950) + b"CELL_LOG_STOP\n"
    b"CELL_LOG_START,1740927602250,3.01,1,op,op,Op,BS_INFO_START,4G_LTE,true,3.01\n"
)
PAWPRINTS = (
    b'{"rel_time": 1.0, "abs_time": 1740927599000, "nr_signal_strength": {"ss_rsrp": "-88", "ss_rsrq": "-11", "ss_sinr": "33"}, '
    b'"connected_pci": 2, "cells": [' + _CELL % (-62, 2, b"true") + b", " + _CELL % (-71, 1, b"false")
    + b'], "companion_abs_time": 1740927600250.5}\n'
    b'{"rel_time": 2.0, "abs_time": 1740927600000, "nr_signal_strength": {"ss_rsrp": "Unavailable"}, "connected_pci": 1, "cells": ['
    + _CELL % (-70, 1, b"true") + b", " + _CELL % (2147483647, 2, b"false") + b'], "companion_abs_time": 1740927601250.5}\n'
    b'{"rel_time": 3.0, "abs_time": 17409\n'
)  # fmt: skip
NEMO_WIDE = (
    b"Time,Latitude,Longitude,Physical cell identity (LTE detected) - 1,Physical cell identity (LTE detected) - 2,"
    b"RSRP (LTE detected) - 1,RSRP (LTE detected) - 2,Physical cell identity (LTE pcell),RSRP (LTE pcell),"
    b"RSRQ (LTE pcell),Pathloss (LTE pcell),RS SNR\n"
    b"2025-03-02 10:00:00.250,35.73,-78.70,,,,,110,-76.0,-6.0,96.0,\n"
    b"2025-03-02 10:00:00.250,35.73,-78.70,,,,,,,,,19.0\n"
    b"2025-03-02 10:00:01.250,35.74,-78.71,110,22,-77.0,-90.0,,,,,\n"
    b"2025-03-02 10:00:02.250,35.74,-78.71,110,22,-77.0\n"
)
XCAL = (
    b'"TIME_STAMP";"Lon";"Lat";"5G KPI PCell RF Serving PCI";"5G KPI PCell RF Serving SS-RSRP [dBm]";"5G KPI PCell RF RI"\r\n'
    b'"2025-03-02 10:00:00.250";"-78,7000001";"35,7300002";"7";"-81,5";"2"\r\n'
    b'"2025-03-02 10:00:00.750";"-78,7000001";"35,7300002";"7";"-82,5";""\r\n'
)
GNETTRACK = (
    b"Timestamp\tLongitude\tLatitude\tSpeed\tCellID\tLTEPCI\tRSRP\tRSRQ\tSNR\tCQI\tNRxRSRP\n"
    b"2025.03.02_10.00.00\t-78.70\t35.73\t0\t11\t42\t-95\t-13\t5\t9\t-101\n"
    b"2025.03.02_10.00.01\t-78.70\t35.73\t0\t11\t42\t-96\t-13\t5\t9\t-\n"
)
GNETTRACK_PRO = (
    b"Timestamp|Longitude|Latitude|Speed|Operator|CGI|Node|CellID|NetworkTech|NetworkMode|Level|Qual|SNR|CQI|LTERSSI|"
    b"ARFCN|PSC|Altitude|NCell1|NARFCN1|NRxLev1|NQual1\n"
    b"2025.03.02_10.00.00|-78.70|35.73|0|00101|1|2|11|4G|LTE|-95|-13|5|9|-70|1300|42|120|43|1300|-101|-15\n"
    b"2025.03.02_10.00.01|-78.70|35.73|0|00101|1|2|11|3G|HSPA+|-75|-7|||||142|120||||\n"
)
SRSUE_METRICS = (
    b"time;cc;earfcn;pci;rsrp;pl;cfo;pci_neigh;rsrp_neigh;cfo_neigh;dl_mcs;dl_snr;dl_turbo;dl_brate;dl_bler\n"
    b"1000;0;3400;1;-61.5;71.2;-350.2;n/a;n/a;n/a;13.2;33.1;0.5;1e6;0\n"
    b"2000;0;3400;1;-62.5;71.2;-350.2;2;-90;0;13.2;33.1;0.5;1e6;0\n"
    b"#eof\n"
)
AIRDATA = (
    b"time(millisecond),datetime(utc),latitude,longitude,height_above_takeoff(feet),xSpeed(mph),ySpeed(mph),zSpeed(mph),"
    b" compass_heading(degrees), pitch(degrees), roll(degrees),satellites\n"
    b"0,2025-03-02 15:00:00,35.7300001,-78.7000002,10,10,0,0,90,-1.5,0.5,14\n"
    b"100,2025-03-02 15:00:01,35.7300001,-78.7000002,20,10,0,0,91,-1.5,0.5,14\n"
)
DJI = (
    b"sep=,\n"
    b"CUSTOM.date [local],CUSTOM.updateTime [local],OSD.latitude,OSD.longitude,OSD.height [ft],OSD.xSpeed [MPH],OSD.pitch,OSD.roll,OSD.yaw\n"
    b"3/2/2025,10:00:00.25 AM,35.7300001,-78.7000002,32.8,10,-1.5,0.5,-170.0\n"
    b"3/2/2025,10:00:00.35 AM,35.7300001,-78.7000002,32.8,10,-1.5,0.5,-170.0\n"
)
CONVERTED = (
    b"num,Longitude,Latitude,Altitude,Pitch,Yaw,Roll,VelocityX,VelocityY,VelocityZ,BatteryVolts,time,GPSFix,NumberOfSatellites\n"
    b"1,-78.7000001,35.7300002,0.5,0.1,1.5,-0.05,1.0,2.0,-0.5,48.1,2025-03-02 10:00:00.250000,3,12\n"
    b"2,-78.7000001,35.7300002,1.5,0.1,1.5,-0.05,1.0,2.0,-0.5,48.1,2025-03-02 10:00:01.250000,3,12\n"
    b"3,-78.7000001,35.73000\n"
)
VEHICLE_TITLE = b"num,Longitude,Latitude,Altitude,Volt,Battery Level,time,Fix,Number of Satellite\r\n" + VEHICLE_9
CELL_SEARCH = (
    b"Found CELL MHz, 3500.0,  EARFCN, 7399, PHYID, 1, PRB, 50,  ports, 1, PSS power dBm, -30.1,  PSR, 2.3, "
    b"2025-03-02 10:00:00:250\n"
    b"Found CELL MHz, 3500.0,  EARFCN, 7399, PHYID, 2, PRB, 50,  ports, 1, PSS power dBm, -35.1,  PSR, 2.1, "
    b"2025-03-02 10:00:01:250\n"
    b"Found CELL MHz, 3500.0,  EARFCN, 73\n"
)
QUECTEL_CONSOLE = (
    b"2025-03-02 10:00:00 Serving cell Params \n\n"
    b"2025-03-02 10:00:01 +----+--------------+\n"
    b"|    | LTE          | is_TDD   |   MCC |   PCID |   earfcn |   RSRP |   RSRQ |   RSSI |   SINR |\n"
    b"|----+--------------+----------+\n"
    b'|  0 | +QENG: "LTE" | "FDD"    |   310 |    492 |      950 |   -113 |    -12 |    -80 |     14 |\n'
    b"+----+--------------+----------+ \n"
    b"2025-03-02 10:00:02 +----+------------------+\n"
    b"|    | NR5G-NSA         |   MCC |   MNC |   PCID |   RSRP |   SINR |   RSRQ |\n"
    b'|  0 | +QENG:"NR5G-NSA" |   310 |   410 |  65535 | -32768 | -32768 | -32768 |\n'
    b'|  0 | +QENG:"NR5G-NSA" |   310 |   410 |     77 |    -82 |     21 |    -11 |\n'
    b"2025-03-02 10:00:03 +----+-------------------+\n"
    b'|  0 | +QNWCFG: "nr5g_csi" |        24 |       2 |        12 |        5 |\n'
    b'|  0 | +QNWCFG: "nr5g_csi" |        24 |       2 |  \n'
)
GENERIC = (
    b"Time,Level,Note\r\n"
    b'2025-03-02T10:00:00.5,-81.5,"a, b"\r\n'
    b"2025-03-02T10:00:01.5,-82.5,\r\n"
    b"2025-03-02T10:00:02.5,-82.5\r\n"
)


def saved(table: dict[str, object], *, compressed: bool = True) -> bytes:
    """A MATLAB 5 file without the time of its writing: the same bytes every time."""
    file = io.BytesIO()
    scipy.io.savemat(file, table, do_compression=compressed)
    return b"MATLAB 5.0 MAT-file".ljust(116) + file.getvalue()[116:]


def mat_flight(**changes: object) -> bytes:
    """A merged flight of five rows, two channels; the epoch holds the local wall clock."""
    count = 5
    wall = np.datetime64("2025-03-02T10:00:00.250") + np.arange(count) * np.timedelta64(260, "ms")
    table: dict[str, object] = {
        "mX": np.linspace(-78.700, -78.699, count)[:, None], "mY": np.linspace(35.730, 35.731, count)[:, None],
        "mZ": np.linspace(0.5, 40.5, count)[:, None], "mRoll": np.full((count, 1), 1.0),
        "mPitch": np.full((count, 1), -3.0), "mYaw": np.linspace(350.0, 370.0, count)[:, None] % 360,
        "mSpeedX": np.full((count, 1), 2.0), "mpower1": np.array([-40.0, -41.0, -800.0, -43.0, -44.0])[:, None],
        "mpower2": np.linspace(-45.0, -46.0, count)[:, None],
        "timestamp_power": (wall.astype(np.int64) / 1e3)[:, None],
        "timestamp_power_for_csv": np.array([str(time).replace("T", " ") for time in wall]),
    }  # fmt: skip
    table.update(changes)
    return saved({name: value for name, value in table.items() if value is not None})


def lte_flight() -> bytes:
    """An LTE flight as its authors merged it: raw positions of another length in front, text local, epoch UTC."""
    count = 5
    seconds = 1740927600.25 + 0.1 * np.arange(count)
    table = {
        "GPSx": np.full((2, 1), -78.7), "GPSy": np.full((2, 1), 35.73),
        "mX": np.linspace(-78.700, -78.699, count)[:, None], "mY": np.linspace(35.730, 35.731, count)[:, None],
        "mZ": np.linspace(0.5, 40.5, count)[:, None], "RSRP": np.array([[17.5, 17.25, np.nan, -150.0, 16.5]]),
        "RSRP2": np.array([[17.5, 17.25, -60.0, -150.0, 16.5]]), "RSSI": np.full((1, count), 31.5),
        "succes": np.array([[1.0, 1.0, 0.0, 1.0, 1.0]]),
        "RSRQ": np.full((1, count), -6.5),
        "timestamp_for_csv": np.array([f"2025-03-02 10:00:00.{250 + 100 * i:03d}" for i in range(count)]),
        "timestamp_meas": seconds[:, None],
    }  # fmt: skip
    return saved(table)


def processed_flight() -> bytes:
    """What the authors of the LTE flights make of one: no clock, heading in radians, other tables beside."""
    table = {
        "RSRP_s": np.linspace(-80.0, -90.0, 4)[:, None], "acceler_s": np.zeros((4, 1)), "azim_s": np.zeros((4, 1)),
        "elev_s": np.zeros((4, 1)), "height_s": np.full((4, 1), 30.0), "lat_s": np.full((4, 1), 35.73),
        "lon_s": np.full((4, 1), -78.70), "ori_s": np.full((4, 1), np.pi / 2), "x_f": np.zeros((9, 1)),
    }  # fmt: skip
    return saved(table)


def mat_73() -> bytes:
    """The merged flight of :func:`mat_flight` as MATLAB 7.3 writes it: HDF5 behind 512 bytes, arrays transposed."""
    file = io.BytesIO()
    with h5py.File(file, "w", userblock_size=512) as book:
        for name, values in scipy.io.loadmat(io.BytesIO(mat_flight())).items():
            if name.startswith("__"):
                continue
            text = values.dtype.kind == "U"
            stored = np.array([[ord(c) for c in row] for row in values.tolist()], dtype=np.uint16) if text else values
            book.create_dataset(name, data=stored.T).attrs["MATLAB_class"] = np.bytes_("char" if text else "double")
    head = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM"
    return head.ljust(512, b"\0") + file.getvalue()[512:]


SRSRAN_GNB = (
    b"[2025-03-02 10:00:00.000001]          |--------DL--------|---UL---\n"
    b"[2025-03-02 10:00:00.000002]  pci rnti | cqi  ri  mcs  brate   ok  nok  (%)  dl_bs | pusch  rsrp  ri  mcs  brate\n"
    b"[2025-03-02 10:00:00.000003]    1 4601 |  15   2   28    17M  908    0   0%    44k |  26.7 -21.2   1   28    17M\n"
    b"[2025-03-02 10:00:01.000003]    1 4601 |  15 2.2   28    17M  908    0   0%    44k |  26.7 -21.2   1   28    17M\n"
    b"[2025-03-02 10:00:02.000003]    1 4601 | n/a n/a   28    17M  908    0   0%    44k |  26.7 -21.2   1   28    17M\n"
    b"[2025-03-02 10:00:03.000003]    1 4601 |  15 \n"
)
SRSRAN_GNB_OLD = (
    b"[2025-03-02 10:00:00.000002]  pci rnti  cqi  ri  mcs  brate   ok  nok  (%)  dl_bs | pusch  mcs  brate\n"
    b"[2025-03-02 10:00:00.000003]    1 4601   15   1   27   797k  471    0   0%    359 |  65.5   28    28M\n"
)
SRSRAN_LOG = (
    b"2025-03-02T15:00:00.000001 [GNB     ] [I] Built in Release mode\n"
    b"2025-03-02T15:00:00.250000 [METRICS ] [I] Scheduler UE pci=1 rnti=0x4601 cqi=15 dl_ri=2.0 dl_mcs=27 dl_brate_bps=1000\n"
)
SRSRAN_JSON = (
    b'{"timestamp": 1740927600.25, "ue_list": [{"ue_container": {"pci": 1, "rnti": 17921, "cqi": 15, "dl_ri": 2.0, "dl_mcs": 27}}]}\n'
    b'{"timestamp": "2025-03-02T15:00:01.250Z", "cells": [{"cell_metrics": {}, "ue_list": [{"pci": 1, "rnti": 17921, "cqi": 15, "dl_ri": 1.5, "dl_mcs": 27}]}]}\n'
    b'{"timestamp": 1740927602.25, "app_resource_usage": {"cpu": 12}}\n'
    b'{"timestamp": 17409\n'
).replace(b'"2025-03-02T15:00:01.250Z"', b"1740927601.25")
SRSRAN_PRETTY = (
    b'{\n  "timestamp": 1740927600.25,\n  "ue_list": [\n    {\n      "ue_container": {\n        "pci": 1,\n'
    b'        "rnti": 17921,\n        "cqi": 15,\n        "ri": 2,\n        "dl_mcs": 27\n      }\n    }\n  ]\n}\n'
    b'{\n  "timestamp": 1740927601.25,\n  "ue_list": []\n}\n'
    b'{\n  "timestamp": 1740\n'
)
SRSRAN_HEX = (
    b"[2025-03-02 10:00:00.000002]  pci rnti | cqi  ri  mcs  brate   ok  nok  (%)  dl_bs | pusch  rsrp  mcs  brate\n"
    b"[2025-03-02 10:00:00.000003]    1 0x44 |  15 2.0   28   1.0G 1539    0   0%    10M |  99.9   ovl   28    75M\n"
)
OAI_GNB_OLD = (
    b"[2025-03-02 10:00:00.000001] [NR_MAC]   Frame.Slot 128.0\n"
    b"[2025-03-02 10:00:00.000002] UE ID 0 RNTI 1f4d (1/1) PH 51 dB PCMAX 21 dBm, average RSRP -78 (16 meas)\n"
    b"[2025-03-02 10:00:00.000003] UE 0: dlsch_rounds 5/0/0/0, dlsch_errors 0\n"
)
OAI_GNB = (
    b"[2025-03-02 10:00:00.000001] [NR_MAC]   Frame.Slot 128.0\n"
    b"[2025-03-02 10:00:00.000002] UE RNTI 1f4d CU-UE-ID 1 in-sync PH 51 dB PCMAX 21 dBm, average RSRP -78 (16 meas)\n"
    b"[2025-03-02 10:00:00.000003] UE 1f4d: CQI 15, RI 2, PMI (14,1)\n"
    b"[2025-03-02 10:00:00.000004] UE 1f4d: dlsch_rounds 5/0/0/0, dlsch_errors 0\n"
    b"[2025-03-02 10:00:01.280003] UE 1f4d: CSI [CQI 14 RI 1 PMI (0,1)] SRS [UL-RI 2 TPMI 0]\n"
)
OAI_GNB_FRAMES = (
    b"[NR_MAC]   Frame.Slot 128.0\nUE 1f4d: CQI 15, RI 2, PMI (14,1)\n"
    b"[NR_MAC]   Frame.Slot 256.0\nUE 1f4d: CQI 15, RI 1, PMI (14,1)\n"
)
OAI_UE = (
    b"1740927600.250000 [NR_PHY] I RSRP = -80 dBm, RI = 2 i1 = 0.0.0, i2 = 1, SINR = 20 dB, CQI = 15\n"
    b"1740927601.250000 [NR_PHY] I RI = 1 i1 = 0.0.0, i2 = 1, SINR = 19 dB, CQI = 15\n"
)
SIGMF = (
    b'{"global": {"core:datatype": "cf32_le", "core:version": "1.0.0", "core:sample_rate": 2000000},\n'
    b' "captures": [{"core:sample_start": 0,\n'
    b'  "measurement:time_stamp": ["2025-03-02 10:00:00.250", "2025-03-02 10:00:00.550", "none"],\n'
    b'  "measurement:values": {"mX": [-78.7, -78.71, 0], "mY": [35.73, 35.74, 0], "mZ": [0.5, 1.5, 0],\n'
    b'   "RSS1": [-40.5, -41.5, -1], "RSS2": [-50.5, -800, -1]}}], "annotations": []}\n'
)
TAP_EXPORT = (
    b"time_utc,uncertainty_s,n,query,status,rank,ri_raw,mcs,cqi,rsrp_dbm,sinr_db\n"
    b"2025-03-02T15:00:00.250Z,0.02,1,nr5g_csi,ok,2,2,11,9,,\n"
    b"2025-03-02T15:00:00.350Z,0.02,2,servingcell,ok,,,,,-80,20\n"
)


def iq_mat() -> bytes:
    """A burst of two channels with amplitudes 0.1 and 0.01."""
    phase = np.exp(1j * np.linspace(0, 20, 400))
    table = {"IQ": np.array([0.1 * phase, 0.01 * phase]).astype(np.complex64), "time_stamp": np.zeros((2, 1))}
    return saved(table, compressed=False)


IQ_NAME = "results_3320000000.0_2000000.0_2025_03_02_10_00_00_250.mat"


def tap_line(text: str) -> bytes:
    """A record of the tap with its checksum."""
    return f'{text},"crc":"{zlib.crc32(text.encode()):08x}"}}\n'.encode()


TAP_TIMES = '"sent_utc_ns":1740927600{0}0000000,"last_utc_ns":1740927600{0}4000000'
TAP = (
    tap_line('{"kind":"header","schema":"aerpaw-cmp-tap/1","ri_base":"one","n":0')
    + tap_line(
        '{"kind":"exchange","query":"servingcell","status":"ok","flags":[],"n":1,'
        + TAP_TIMES.format("10")
        + ',"decoded":{"rat":"NR5G-SA","nr":{"rsrp_dbm":-80,"sinr_db":20}}'
    )
    + tap_line(
        '{"kind":"exchange","query":"nr5g_csi","status":"ok","flags":[],"n":2,'
        + TAP_TIMES.format("20")
        + ',"decoded":{"rank":2,"ri_raw":2,"mcs":11,"cqi":9,"pmi":7}'
    )
    + tap_line(
        '{"kind":"exchange","query":"nr5g_csi","status":"ok","flags":["no_csi"],"n":3,'
        + TAP_TIMES.format("70")
        + ',"decoded":{"rank":null,"ri_raw":0}'
    )
    + b'{"kind":"exchange","query":"nr5g_csi","sta\n'
)

SAMPLES: dict[str, dict[str, tuple[bytes, int, int]]] = {
    "vehicle_out": {
        "ten_fields": (VEHICLE_10, 3, 0),
        "nine_fields": (VEHICLE_9, 2, 0),
        "eight_fields": (VEHICLE_8, 2, 0),
        "eleven_fields": (VEHICLE_11, 2, 0),
        "utc_offset": (VEHICLE_UTC, 3, 0),
        "title_line": (VEHICLE_TITLE, 2, 0),
    },
    "sounder_log": {"runs_and_foot": (SOUNDER, 6, 1), "grown_offset": (SOUNDER_GROWN, 4, 0)},
    "flight_mat": {
        "two_channels": (mat_flight(), 5, 0),
        "lte": (lte_flight(), 5, 0),
        "processed": (processed_flight(), 4, 0),
        "version_73": (mat_73(), 5, 0),
    },
    "quectel_csv": {
        "csi": (QUECTEL_CSI, 3, 1),
        "csi_first_generation": (QUECTEL_FIRST, 2, 0),
        "endc": (QUECTEL_ENDC, 2, 1),
        "lte_only": (QUECTEL_ONE_LINE, 2, 0),
    },
    "quectel_ri": {"table": (RI_TABLE, 2, 1)},
    "nemo_csv": {"table": (NEMO_CSV, 3, 0)},
    "gnettrack_kml": {"pretty": (GNETTRACK_KML, 2, 0)},
    "nemo_kml": {"placemarks": (NEMO_KML, 2, 1)},
    "aadm_snr": {"table": (SNR_CSV, 2, 1)},
    "controller_log": {"console": (CONTROLLER, 3, 1)},
    "srsenb_log": {"console": (SRSENB, 3, 1), "before_2020": (SRSENB_OLD, 2, 0), "nr": (SRSENB_NR, 2, 0)},
    "tap_jsonl": {"session": (TAP, 3, 1)},
    "srsue_log": {"console": (SRSUE, 3, 1)},
    "vehicle_log": {"console": (VEHICLE_LOG, 2, 1)},
    "gpx": {"track": (GPX, 2, 1), "nemo": (GPX_NEMO, 2, 1)},
    "pawprints": {"session": (PAWPRINTS, 2, 1), "text_of_2023": (PAWPRINTS_TEXT, 2, 1)},
    "drive_test": {
        "nemo": (NEMO_WIDE, 3, 1),
        "xcal": (XCAL, 2, 0),
        "g_nettrack": (GNETTRACK, 2, 0),
        "g_nettrack_pro": (GNETTRACK_PRO, 2, 0),
        "srsue_metrics": (SRSUE_METRICS, 2, 0),
    },
    "pose_csv": {"airdata": (AIRDATA, 2, 0), "dji": (DJI, 2, 0), "converted": (CONVERTED, 2, 1)},
    "quectel_console": {"tables": (QUECTEL_CONSOLE, 4, 1)},
    "cell_search": {"table": (CELL_SEARCH, 2, 1)},
    "srsran_gnb": {
        "console": (SRSRAN_GNB, 3, 1),
        "old_console": (SRSRAN_GNB_OLD, 1, 0),
        "log": (SRSRAN_LOG, 1, 0),
        "hex": (SRSRAN_HEX, 1, 0),
    },
    "srsran_json": {"metrics": (SRSRAN_JSON, 2, 1), "pretty": (SRSRAN_PRETTY, 1, 2)},
    "oai_log": {
        "gnb_2021": (OAI_GNB_OLD, 1, 0),
        "gnb": (OAI_GNB, 3, 0),
        "frames": (OAI_GNB_FRAMES, 2, 0),
        "ue": (OAI_UE, 2, 0),
    },
    "sigmf": {"dataset12": (SIGMF, 2, 1)},
    "iq_burst": {"two_channels": (iq_mat(), 1, 0)},
    "ardupilot_bin": {"flight": (autopilots.dataflash(), 5, 0)},
    "mavlink_tlog": {"version_2": (autopilots.tlog(2), 5, 0), "version_1": (autopilots.tlog(1), 5, 0)},
    "px4_ulog": {"flight": (autopilots.ulog(), 5, 0)},
    "generic_csv": {"mapped": (GENERIC, 2, 1)},
}
# Formats whose account counts rows, values or messages.
BINARY = ("flight_mat", "iq_burst", "sigmf", "ardupilot_bin", "mavlink_tlog", "px4_ulog")
CASES = [(reader, name) for reader, samples in SAMPLES.items() for name in samples]

# Readers and samples whose clock is UTC or relative.
WITHOUT_ZONE: tuple[str | tuple[str, str], ...] = (
    "nemo_csv", "nemo_kml", "tap_jsonl", "pawprints", "srsran_json",
    "ardupilot_bin", "mavlink_tlog", "px4_ulog",
    ("vehicle_out", "utc_offset"), ("flight_mat", "lte"), ("flight_mat", "processed"), ("gpx", "track"),
    ("drive_test", "srsue_metrics"), ("pose_csv", "airdata"), ("srsran_gnb", "log"), ("oai_log", "frames"), ("oai_log", "ue"),
)  # fmt: skip

# A sample of each kind of file that is no log (the MATLAB ones aside).
NO_LOGS: dict[str, bytes] = {
    "antenna_pattern": b"2\r\nFrequency=3300(MHz)\r\n\r\nphi theta total\r\n0 0 -1.5\r\n",
    "power_references": b"Node,Category,Channel,PA_Enabled,Gain,Freq_3.30GHz\nlw1,tx,ch0,0,0.0,-57.5\n",
    "kml_other": b"<?xml version='1.0'?>\n<kml><Document><Placemark><name>fence</name></Placemark></Document></kml>\n",
    "gpx_other": b"<?xml version='1.0'?>\n<gpx version='1.1'>\n</gpx>\n",
    "at_transcript": b'AT+QNWCFG="nr5g_csi"\r\n+QNWCFG: "nr5g_csi",29,2,7,28\r\n\r\nOK\r\n',
    "nemo_summary": b"0123-4567\r\nDevice ID;1\r\nDevice Label;Nemo Handy\r\nMeasurement start;2025 Mar 2 10:00\r\n",
    "nemo_binary": b"NMFS\0\0\1\2Anite\0",
    "uhd_console": (
        b"[2025-03-02 10:00:00.000001] [INFO] [UHD] linux; GNU C++\n[2025-03-02 10:00:01.000001] [INFO] [B200] Detected\n"
    ),
    "radio_console": b"[2025-03-02 10:00:00.000001] ---  Software Radio Systems LTE eNodeB  ---\n[2025-03-02 10:00:01] Reading\n",
    "gnss_logger": b"# Fix,Provider,LatitudeDegrees,LongitudeDegrees\nFix,GPS,35.728,-78.696\n",
    "json_records": b'{"time": 1749564000, "pci": 11, "rsrp": -91}\n',
    "own_export": b"time_utc,time_s,tower,channel,unit,measured_db\n2025-03-02T15:00:00.250Z,0,LW1,USRP1,dBm,-81.5\n",
    "positions": b"35.7281, -78.6973\r\n35.7291, -78.6992\r\n",
    "document": b"# A page\n\n## Of text\n\nwords\n",
    "flight_script": b"[2025-03-02 10:00:00.000001] Taking off\n[2025-03-02 10:00:05.000001] Waypoint 0\n",
    "kml_untimed": (
        b"<?xml version='1.0'?>\n<kml><Document><Placemark><description>RSRP: -81 dBm</description>"
        b"<Point><coordinates>-78.7,35.7</coordinates></Point></Placemark></Document></kml>\n"
    ),
    "wifi_scan": b'{"rel_time":1.0,"abs_time":1740927600000,"log_type":"wifi","aps":[]}\n',
    "nmea": b"$GPGGA,140000.00,3543.68,N,07841.76,W,1,08,0.9,111.3,M,-32.0,M,,*50\r\n",
    "wifi_other": b"WigleWifi-1.4,appRelease=2.53\nMAC,SSID,FirstSeen,RSSI\n",
    "subtitles": b"1\n00:00:00,000 --> 00:00:00,033\n[latitude: 35.728] [longitude: -78.696]\n",
    "pdf": b"%PDF-1.4\n",
    "at_answers": b'[2025-03-02 10:00:00] #RFSTS: "310 26",1795,-101,-67,-15\n' * 2,
    "web_page": b"<!DOCTYPE html>\n<html><body>Log in</body></html>\n",
    "kml_levels": (
        b"<?xml version='1.0'?>\n<kml><Document><Placemark><description>10:00:00 RSRP: -81 dBm</description>"
        b"<Point><coordinates>-78.7,35.7</coordinates></Point></Placemark></Document></kml>\n"
    ),
    "antenna_gain": b"1\r\nFrequency\tE Total. dB\r\n3300000000\t-1.25\r\n",
    "cell_search_untimed": (
        b"Found 1 cells\nFound CELL 930.0 MHz, EARFCN=3500, PHYID=2, 50 PRB, 1 ports, PSS power=-21.3 dBm\n\nBye\n"
    ),
    "flight_plan": b'{\n    "fileType": "Plan",\n    "geoFence": {},\n    "mission": {"items": []}\n}\n',
    "kml_track": (
        b"<?xml version='1.0'?>\n<kml xmlns:gx='x'><Document><Placemark><gx:Track><when>2025-03-02T10:00:00Z</when>"
        b"<gx:coord>-78.7 35.7 100</gx:coord></gx:Track></Placemark></Document></kml>\n"
    ),
    "map": b"<?xml version='1.0'?>\n<osm version='0.6'>\n",
    "site_yaml": b"name: f\norigin: {latitude_deg: 35.7}\ntowers:\n  T: {}\n",
    "flight_yaml": b"flight:\n  name: f\nsite: lake_wheeler\nlogs:\n  - {path: a.txt}\n",
}
