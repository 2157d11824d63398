"""Texts of logs that no command writes, for tests of their readers."""

from typing import Any

import numpy as np
import pandas as pd

from aerpaw_cmp.logs.writers import local_text


def quectel_csv(times: Any, rank: Any, timezone: str) -> bytes:
    """Return ranks (1 to 8, or NaN without CSI) as AERPAW's ``Basic_and_Other_Params.csv``, with its first line ``OK``."""
    lines = ["OK\n"]
    for time, value in zip(local_text(times, timezone, digits=3), np.nan_to_num(rank).astype(int), strict=True):
        report = f"27,{value},15,3" if value else "0,0,0,0"
        lines.append(f'{time},"+QNWCFG: ""lte_csi""",20,1,9,3,"+QNWCFG: ""nr5g_csi""",{report}\r\n')
    return "".join(lines).encode("ascii")


def nemo_csv(frame: pd.DataFrame, time_origin: str) -> bytes:
    """Rank records with positions as the Nemo table, times in milliseconds after ``time_origin`` (UTC)."""
    origin = np.datetime64(time_origin.removesuffix("Z"), "ns")
    relative_ms = (frame["time"].to_numpy().astype("datetime64[ns]") - origin).astype(np.int64) / 1e6
    names = ("latitude_deg", "longitude_deg", "altitude_m", "rank", "rsrp_dbm", "sinr_db", "cqi")
    absent = [float("nan")] * len(frame)
    columns = [frame[name].tolist() if name in frame.columns else absent for name in names]
    lines = [
        f"{i}," + ",".join("" if np.isnan(value) else repr(value) for value in row) + "\r\n"
        for i, row in enumerate(zip(relative_ms.tolist(), *columns, strict=True))
    ]
    header = "index,rel_time_ms,lat,lon,alt_m,pdsch_rank,nr_rsrp_dbm,nr_sinr_db,wb_cqi\r\n"
    return (header + "".join(lines)).encode("ascii")
