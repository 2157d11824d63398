"""srsENB console (through ``ts``): the ``ri`` column of the downlink trace.

``[time] lte [pci] rnti cqi ri mcs brate ok nok (%) | ...`` once a second; newer versions print the cell's ``pci``.
All other lines are the console's talk and count as comments.

What ``ri`` is (srsRAN 4G: the MAC's metrics and ``metrics_stdout.cc``): the MAC adds one to each reported RI,
averages over the metrics period and clears, and the trace prints ``int(dl_ri)``. So **0 is no report**, 1 is rank 1,
2 is rank 2, and every value is a *truncated* mean: a second of ranks 1 and 2 prints 1. On a two-port cell the field
log ``two_ports`` prints 0, 1 and 2; on one port nothing is reported and 0 stands throughout.
"""

from __future__ import annotations

import re

from aerpaw_cmp.logs.readers import Reader, ReadOptions
from aerpaw_cmp.logs.records import ReadResult

from . import _rows, _time

_N = rb" +(?P<%s>-?\d{1,6}(?:\.\d{1,6})?|n/a)"
_ROW = re.compile(
    rb"^\[(?P<time>" + _time.TIME + rb")\] *(?:lte|nr)(?: +\d{1,4}(?= +[0-9a-fA-F]{2,5} ))? +[0-9a-fA-F]{1,5}"
    + _N % b"cqi" + _N % b"ri" + _N % b"mcs"
    + rb" +[0-9.]{1,12}[kMG]?(?: +\d{1,9}){2} +\d{1,3}% \|[^\n]{0,160}$",
    re.MULTILINE,
)  # fmt: skip
_TITLE = re.compile(rb"^\[[^\]\n]{19,40}\] *rat +(?:pci +)?rnti +cqi +ri +mcs", re.MULTILINE)
_CHANNELS = re.compile(rb"^\[[^\]\n]{19,40}\] *Opening (\d{1,2}) channels in RF device", re.MULTILINE)
_TORN = re.compile(rb"^\[[^\]\n]{19,40}\] *(?:lte|nr) +[0-9a-fA-F]{1,5} ")


def sniff(head: bytes) -> bool:
    """Whether it is a console with the trace's title line."""
    return head.startswith(b"[") and _TITLE.search(head) is not None


def _ports(data: bytes) -> int | None:
    """Transmit channels that the console says it opened: no rank can be higher. None where it does not say."""
    found = [int(number) for number in _CHANNELS.findall(data)]
    return max(found) if found and max(found) > 0 else None


def read(data: bytes, options: ReadOptions) -> ReadResult:
    """Rank stream ``srsenb``; UsageError if no time zone is given."""
    torn = _rows.torn(_TORN, "an incomplete line of the trace (torn line?)")
    rows = _rows.matched(data, _ROW, options, reader="srsenb_log", reason=torn)
    ri = rows.number("ri")
    values = rows.rank(ri, none=ri == 0) | {"cqi": rows.number("cqi"), "mcs": rows.number("mcs")}
    if (ri > 0).any():
        rows.warnings.append(
            "srsENB prints the truncated mean of the ranks reported in a second: 1 may be a mix of 1 and 2"
        )
    about = {"ri_base": "one", "source": "CSI report, truncated mean", "ports": _ports(data)}
    return rows.result([rows.stream("rank", options.channel or "srsenb", values, about=about)])


READER = Reader(
    name="srsenb_log",
    title="srsENB console: rank indicator (0 = no report)",
    kinds=("rank",),
    sample="[2025-01-01 12:00:07.000000] lte   46   11   2    2   3.7k   14    0   0% |  31.5   12.5   40   15    38k",
    sniff=sniff,
    read=read,
)
