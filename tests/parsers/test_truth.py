"""Made-up files with their truth beside them: what real programs vary, for each format.

A case is a file's name, its bytes and, for each stream that it must give, columns as they must come out; ``time`` in
seconds after 2025-03-02 15:00:00 UTC, which is 10:00:00 in New York.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from aerpaw_cmp.logs.readers import ReadOptions, identify

BEGIN = np.datetime64("2025-03-02T15:00:00")
LOCAL = ReadOptions(timezone="America/New_York")
Truth = dict[str, dict[str, list[Any]]]


@dataclass(frozen=True)
class Case:
    """A file and what it says."""

    name: str
    data: str
    truth: Truth
    reader: str
    options: ReadOptions = LOCAL


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
        {"snr": {"time": [0.25, 2.75], "value": [12.5, 13.5]}},
        "drive_test",
    ),
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
}


def shown(values: Any) -> list[Any]:
    """A column as it is compared: times in seconds, numbers to the microunit."""
    if values.dtype.kind == "M":
        values = (values - BEGIN) / np.timedelta64(1, "s")
    return [round(v, 6) if isinstance(v, float) else v for v in values.tolist()]


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_what_a_file_says_comes_out(case: Case) -> None:
    data = case.data.encode()
    reader = identify(data)
    assert reader.name == case.reader
    result = reader.read(data, replace(case.options, file_name=case.name))
    streams = {stream.name: stream.frame for stream in result.streams}
    for name, columns in case.truth.items():
        assert name in streams, f"{name} is not among {list(streams)}"
        for column, expected in columns.items():
            assert shown(streams[name][column].to_numpy()) == pytest.approx(expected, nan_ok=True), f"{name}: {column}"
