"""srsENB console (through ``ts``): the ``ri`` column of the downlink trace.

``[time] lte [pci] rnti cqi ri mcs brate ok nok (%) | ...`` once a second; newer versions print the cell's ``pci``.
srsLTE before 2020 printed neither ``lte`` nor the bar. All other lines count as comments.

Meaning of ``ri`` in srsRAN 4G (metrics of the MAC, ``metrics_stdout.cc``): the MAC adds one to each reported RI and
averages over the metrics period, and the trace prints ``int(dl_ri)``. **0 means that there was no report**, 1 is rank
1, 2 is rank 2. Every value is a *truncated* mean: a second of ranks 1 and 2 prints 1. On a two-port cell the field
log ``two_ports`` prints 0, 1 and 2; on one port it prints 0 throughout.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

import numpy as np

from aerpaw_cmp.readers import TIME, ZONE, LineFormat, Rows, Stream, of_ues, text_reader

_N = rb" +(?P<%s>-?\d{1,6}(?:\.\d{1,6})?|n/a)"
_ROW = re.compile(
    rb"^\[(?P<time>" + TIME + ZONE + rb")\] *"
    rb"(?:(?:lte|nr)(?: +\d{1,4}(?= +[0-9a-fA-F]{2,5} ))? +)?(?P<rnti>[0-9a-fA-F]{1,5})"
    + _N % b"cqi" + _N % b"ri" + _N % b"mcs"
    + rb" +[0-9.]{1,12}[kMG]?(?:(?: +\d{1,9}){2})? +\d{1,3}% [^\n]{0,160}$",
    re.MULTILINE,
)  # fmt: skip
_CHANNELS = re.compile(rb"^\[[^\]\n]{19,40}\] *Opening (?P<kind>\d{1,2}) channels in RF device", re.MULTILINE)
_MIXED = "srsENB prints the truncated mean of the ranks reported in a second: 1 may be a mix of 1 and 2"


def _streams(rows: Rows) -> Iterator[Stream | None]:
    """Yield the rank ``srsenb``. The largest possible rank is the number of transmit channels in the console."""
    ri = rows.number("ri")
    rows.warnings += [_MIXED] if (ri > 0).any() else []
    last = int(rows.row[-1]) if len(rows) else 0
    above = b"\n".join(rows.data.split(b"\n", last)[:last])
    ports = max((int(number) for number in _CHANNELS.findall(above)), default=0) or None
    rnti = np.array([int(text, 16) for text in rows.text("rnti")], dtype=np.float64)
    values = rows.rank(ri, none=ri == 0) | {"cqi": rows.number("cqi"), "mcs": rows.number("mcs"), "rnti": rnti}
    about = {"ri_base": "one", "source": "CSI report, truncated mean", "ports": ports}
    yield from of_ues(rows, "rank", rows.options.channel or "srsenb", values, flag=rows.flag, about=about)


READER = text_reader(
    "srsenb_log", "srsENB console: rank indicator (0 = no report)", kinds=("rank",),
    sample="[2025-01-01 12:00:07.000000] lte   46   11   2    2   3.7k   14    0   0% |  31.5   12.5   40   15    38k",
    streams=_streams, lines=LineFormat(
        row=_ROW, mark=re.compile(rb"^\[[^\]\n]{19,40}\] *(?:rat +(?:pci +)?)?rnti +cqi +ri +mcs", re.MULTILINE),
        torn=re.compile(rb"^\[[^\]\n]{19,40}\] *(?:lte|nr) +[0-9a-fA-F]{1,5} "),
    ),
)  # fmt: skip
