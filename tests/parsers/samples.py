"""Synthetic samples of every format, several encodings each; written here, none taken from a real log.

``SAMPLES`` maps a reader's name to its samples: name of the sample to (bytes, accepted lines, rejected lines).
"""

from __future__ import annotations

import io
import zlib

import numpy as np
import scipy.io

from aerpaw_cmp.logs.readers import ReadOptions

OPTIONS = ReadOptions(
    timezone="America/New_York",
    time_origin="2025-03-02T15:00:00Z",
    kind="rss",
    columns={"time": "Time", "rss_db": "Level"},
    unit="dBm",
)

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
GENERIC = (
    b"Time,Level,Note\r\n"
    b'2025-03-02T10:00:00.5,-81.5,"a, b"\r\n'
    b"2025-03-02T10:00:01.5,-82.5,\r\n"
    b"2025-03-02T10:00:02.5,-82.5\r\n"
)


def mat_flight(**changes: object) -> bytes:
    """A merged flight of five rows, two channels; the epoch holds the local wall clock."""
    count = 5
    wall = np.datetime64("2025-03-02T10:00:00.250") + np.arange(count) * np.timedelta64(260, "ms")
    table: dict[str, object] = {
        "mX": np.linspace(-78.700, -78.699, count)[:, None],
        "mY": np.linspace(35.730, 35.731, count)[:, None],
        "mZ": np.linspace(0.5, 40.5, count)[:, None],
        "mRoll": np.full((count, 1), 1.0),
        "mPitch": np.full((count, 1), -3.0),
        "mYaw": np.linspace(350.0, 370.0, count)[:, None] % 360,
        "mSpeedX": np.full((count, 1), 2.0),
        "mpower1": np.array([-40.0, -41.0, -800.0, -43.0, -44.0])[:, None],
        "mpower2": np.linspace(-45.0, -46.0, count)[:, None],
        "timestamp_power": (wall.astype(np.int64) / 1e3)[:, None],
        "timestamp_power_for_csv": np.array([str(time).replace("T", " ") for time in wall]),
    }
    table.update(changes)
    file = io.BytesIO()
    scipy.io.savemat(file, {name: value for name, value in table.items() if value is not None}, do_compression=True)
    return file.getvalue()


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
    },
    "sounder_log": {"runs_and_foot": (SOUNDER, 6, 1), "grown_offset": (SOUNDER_GROWN, 4, 0)},
    "flight_mat": {"two_channels": (mat_flight(), 5, 0)},
    "quectel_csv": {
        "csi": (QUECTEL_CSI, 3, 1),
        "csi_first_generation": (QUECTEL_FIRST, 2, 0),
        "endc": (QUECTEL_ENDC, 2, 1),
        "lte_only": (QUECTEL_ONE_LINE, 2, 0),
    },
    "quectel_ri": {"table": (RI_TABLE, 2, 1)},
    "nemo_csv": {"table": (NEMO_CSV, 3, 0)},
    "nemo_kml": {"placemarks": (NEMO_KML, 2, 1)},
    "aadm_snr": {"table": (SNR_CSV, 2, 1)},
    "controller_log": {"console": (CONTROLLER, 3, 1)},
    "srsenb_log": {"console": (SRSENB, 3, 1)},
    "tap_jsonl": {"session": (TAP, 3, 1)},
    "generic_csv": {"mapped": (GENERIC, 2, 1)},
}
CASES = [(reader, name) for reader, samples in SAMPLES.items() for name in samples]
