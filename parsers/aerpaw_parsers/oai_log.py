"""OpenAirInterface: the gNB's statistics in both layouts, and the UE's CSI lines.

gNB: ``UE 1f4d: CQI 15, RI 2, PMI (14,1)`` or ``... CSI [CQI 15 RI 2 PMI (14,1)] SRS [...]``, and ``UE RNTI 1f4d ...
average RSRP -78 (16 meas)``. UE: ``RI = 2 i1 = 0.0.0, i2 = 1, SINR = 20 dB, CQI = 15`` with or without ``RSRP = -80
dBm,`` in front. All three forms print the index of the report plus one, so RI counts from one. A gNB prints
the last report, not a mean.

The time is a stamp of ``ts``, or in srsRAN's form, at the beginning of the line or of a line above it. Without stamps,
the time is OAI's own seconds (``log_config ... time``), which count from an unknown origin unless they are an epoch.
If there are no seconds either, each ``Frame.Slot`` line, which comes every 128 frames, counts 1.28 s.
"""

from __future__ import annotations

import re

import numpy as np

from aerpaw_cmp.common.units import AnyArray, IntArray
from aerpaw_cmp.readers import TIME, ZONE, Lines, Reader, ReadOptions, ReadResult, built, checked_ranks, of_ues, split

_CSI = re.compile(rb"\bUE (?P<rnti>[0-9a-f]{4}):? [^\n]{0,120}?\bCQI (?P<cqi>\d{1,2}),? RI (?P<ri>\d{1,2}),? PMI")
_LEVEL = re.compile(
    rb"\bUE (?:ID \d{1,4} )?RNTI (?P<rnti>[0-9a-f]{4})\b[^\n]{0,120}?"
    rb"average RSRP (?P<rsrp>-?\d{1,3}) \((?P<meas>\d{1,9}) meas\)"
)
_UE = re.compile(
    rb"(?:\bRSRP = (?P<rsrp>-?\d{1,3}) dBm, )?\bRI = (?P<ri>\d{1,2}) i1 = [-\d.]{1,20}, i2 = -?\d{1,5}, "
    rb"SINR = (?P<sinr>-?\d{1,3}) dB, CQI = (?P<cqi>\d{1,2})"
)
_UE_LEVEL = re.compile(rb"\[UE \d{1,2}\] RSRP = (?P<rsrp>-?\d{1,3}) dBm")
_STAMP = re.compile(rb"^\[?(" + TIME + ZONE + rb")\]?(?:[ :]|\r?$)")
_SECONDS = re.compile(rb"^(?:\x1b\[[0-9;]{0,8}m)?(\d{1,10}\.\d{3,9}) ")
_FRAME = re.compile(rb"Frame\.Slot \d")
_FRAMES_S = 1.28


def sniff(head: bytes) -> bool:
    """Check whether a file is output of OAI with CSI or levels."""
    if not any(word in head for word in (b"MAC]", b"PHY]", b"Frame.Slot", b"dlsch_rounds", b"i1 = ")):
        return False  # this test is a thousand times faster than the patterns
    return any(pattern.search(head) for pattern in (_CSI, _LEVEL, _UE)) and re.search(
        rb"\[(?:NR_)?(?:MAC|PHY)\]|Frame\.Slot|dlsch_rounds|\bi1 = ", head
    ) is not None  # fmt: skip


def _rows_of(lines: Lines) -> tuple[IntArray, list[dict[str, bytes]], str, AnyArray]:
    """Return the lines with a quantity, their values, the clock, and the times."""
    row, quantities, stamps = [], [], []
    stamp, seconds, frame = b"", b"", -1
    for i in range(len(lines)):
        line = lines.raw(i)
        if written := _STAMP.match(line):
            stamp = written[1]
        elif counted := _SECONDS.match(line):
            seconds = counted[1]
        if _FRAME.search(line):
            frame += 1
        match = next((m for p in (_CSI, _LEVEL, _UE, _UE_LEVEL) if (m := p.search(line))), None)
        if match is not None:
            row.append(i)
            quantities.append({key: value for key, value in match.groupdict().items() if value is not None})
            stamps.append((stamp, seconds, max(frame, 0) * _FRAMES_S))
    number = np.array(row, dtype=np.int64)
    if stamps and all(item[0] for item in stamps):
        return number, quantities, "wall", np.array([item[0] for item in stamps], dtype=np.bytes_)
    if stamps and all(item[1] for item in stamps):
        value = np.array([float(item[1]) for item in stamps])
        return number, quantities, "epoch_s" if value.min() > 1e9 else "relative_s", value
    return number, quantities, "relative_s", np.array([item[2] for item in stamps], dtype=np.float64)


def read(data: bytes, options: ReadOptions) -> ReadResult:
    """Return the rank stream ``oai`` and RSRP, or raise UsageError if the zone of stamps is unknown."""
    lines = split(data)
    row, quantities, clock, time = _rows_of(lines)
    rows = built(lines, row, {"time": time}, options, reader="oai_log", clock=clock)
    timed = [quantities[i] for i in rows.at.tolist()]
    names = ("ri", "cqi", "sinr", "rsrp", "meas")
    value = {name: np.array([float(item.get(name, b"nan")) for item in timed]) for name in names}
    rnti = np.array([float(int(item["rnti"], 16)) if "rnti" in item else np.nan for item in timed])
    reported = np.flatnonzero(~np.isnan(value["ri"]))
    ri = value["ri"][reported]
    flag = rows.flag[reported].copy()
    columns = {"rank": checked_ranks(ri, flag), "ri_raw": ri, "cqi": value["cqi"][reported], "rnti": rnti[reported]}
    columns |= {"sinr_db": value["sinr"][reported], "rsrp_dbm": value["rsrp"][reported]}
    about = {"ri_base": "one", "source": "CSI report, last one"}
    ranks = of_ues(rows, "rank", options.channel or "oai", columns, pick=reported, flag=flag, about=about)
    # a gNB prints a level of 0 if it made 0 measurements
    measured = np.flatnonzero(~np.isnan(value["rsrp"]) & (np.isnan(value["meas"]) | (value["meas"] > 0)))
    level, flag = rows.level(value["rsrp"])
    levels = {"rss_db": level[measured], "serving": np.ones(len(measured)), "rnti": rnti[measured]}
    about = {"channel": options.channel or "nr_rsrp", "unit": "dBm", "quantity": "RSRP", "rat": "nr"}
    per_ue = of_ues(rows, "rss", "nr_rsrp", levels, pick=measured, flag=flag[measured], about=about)
    return rows.result([*ranks, *per_ue])


READER = Reader(
    name="oai_log", title="OpenAirInterface gNB statistics or UE log: rank indicator, RSRP", kinds=("rank", "rss"),
    sample="[2025-01-01 12:00:07.000000] UE 1f4d: CQI 15, RI 2, PMI (14,1)", sniff=sniff, read=read,
)  # fmt: skip
