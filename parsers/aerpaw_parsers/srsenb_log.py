"""srsENB console (through ``ts``): the ``ri`` column of the downlink trace.

``[time] lte rnti cqi ri mcs brate ok nok (%) | ...`` once a second; ``ri`` is **zero-based** (rank 1 is printed
as 0), ``n/a`` where there is none. All other lines are the console's talk and count as comments.
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
_TORN = re.compile(rb"^\[[^\]\n]{19,40}\] *(?:lte|nr) +[0-9a-fA-F]{1,5} ")


def sniff(head: bytes) -> bool:
    """Whether it is a console with the trace's title line."""
    return head.startswith(b"[") and _TITLE.search(head) is not None


def read(data: bytes, options: ReadOptions) -> ReadResult:
    """Rank stream ``srsenb``; UsageError if no time zone is given."""
    torn = _rows.torn(_TORN, "an incomplete line of the trace (torn line?)")
    rows = _rows.matched(data, _ROW, options, reader="srsenb_log", reason=torn)
    values = rows.rank(rows.number("ri"), base=0) | {"cqi": rows.number("cqi"), "mcs": rows.number("mcs")}
    stream = rows.stream("rank", options.channel or "srsenb", values, ri_base="zero", source="CSI report")
    return rows.result([stream])


READER = Reader(
    name="srsenb_log",
    title="srsENB console: zero-based rank indicator",
    kinds=("rank",),
    sample="[2025-01-01 12:00:07.000000] lte   46   11   1    2   3.7k   14    0   0% |  31.5   12.5   40   15    38k",
    sniff=sniff,
    read=read,
)
