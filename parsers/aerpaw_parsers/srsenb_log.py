"""srsENB console (through ``ts``): the ``ri`` column of the downlink trace.

``[time] lte [pci] rnti cqi ri mcs brate ok nok (%) | ...`` once a second; newer versions print the cell's ``pci``. All
other lines are the console's talk and count as comments.

What ``ri`` is (srsRAN 4G: the MAC's metrics and ``metrics_stdout.cc``): the MAC adds one to each reported RI,
averages over the metrics period and clears, and the trace prints ``int(dl_ri)``. So **0 is no report**, 1 is rank 1,
2 is rank 2, and every value is a *truncated* mean: a second of ranks 1 and 2 prints 1. On a two-port cell the field
log ``two_ports`` prints 0, 1 and 2; on one port nothing is reported and 0 stands throughout.
"""

from __future__ import annotations

import re

import numpy as np

from aerpaw_cmp.logs.readers import Reader, ReadOptions
from aerpaw_cmp.logs.records import ReadResult, Stream

from . import _frames, _lines, _time

_N = rb" +(-?\d{1,6}(?:\.\d{1,6})?|n/a)"
_CELL = rb"(?: +(?:\d{1,4}|n/a))?"  # pci: the count of columns up to the bar says whether it is there
_ROW = re.compile(
    rb"^\[(" + _time.TIME + rb")\] *(?:lte|nr)" + _CELL + rb" +[0-9a-fA-F]{1,5}" + _N * 3 + rb" +[0-9.]{1,12}[kMG]?"
    rb"(?: +\d{1,9}){2} +\d{1,3}% \|[^\n]{0,160}$",
    re.MULTILINE,
)
_TITLE = re.compile(rb"^\[[^\]\n]{19,40}\] *rat +(?:pci +)?rnti +cqi +ri +mcs", re.MULTILINE)
_TORN = re.compile(rb"^\[[^\]\n]{19,40}\] *(?:lte|nr) +[0-9a-fA-F]{1,5} ")
_CHANNELS = re.compile(rb"^\[[^\]\n]{19,40}\] *Opening (\d{1,2}) channels in RF device", re.MULTILINE)


def sniff(head: bytes) -> bool:
    """Whether it is a console with the trace's title line."""
    return head.startswith(b"[") and _TITLE.search(head) is not None


def _reason(line: bytes) -> str | None:
    return "an incomplete line of the trace (torn line?)" if _TORN.match(line) else None


def _ports(data: bytes) -> int | None:
    """Transmit channels that the console says it opened: no rank can be higher. None where it does not say."""
    found = [int(number) for number in _CHANNELS.findall(data)]
    return max(found) if found and max(found) > 0 else None


def read(data: bytes, options: ReadOptions) -> ReadResult:
    """Rank stream ``srsenb``.

    Raises
    ------
    UsageError
        If no time zone is given.
    """
    lines = _lines.split(data)
    rows, groups = _lines.match(lines, _ROW)
    column = _lines.columns(groups, 4)
    instants, valid = _time.texts_to_utc(column[0], options, needed_by="srsenb_log")
    blank, rejected = _lines.remainder(lines, rows, _reason)
    rejected += lines.reject_all(rows[~valid], "the time stamp is no date of the calendar")
    cqi, ri, mcs = (_lines.numbers(np.where(cells == b"n/a", b"", cells)) for cells in column[1:])
    flag = _lines.flags(len(rows))
    instants.flag(flag)
    none = np.isnan(ri) | (ri == 0)
    good = (ri >= 1) & (ri <= 8) & (ri == np.round(ri))
    _lines.add_flag(flag, none, "no_csi")
    _lines.add_flag(flag, ~good & ~none, "ri_out_of_range")
    if lines.unterminated:
        _lines.add_flag(flag, rows == len(lines) - 1, _lines.UNTERMINATED)
    values = {"rank": np.where(good, ri, np.nan), "ri_raw": ri, "cqi": cqi, "mcs": mcs}
    frame = _frames.frame("rank", instants.time, rows + 1, flag, values)[valid].reset_index(drop=True)
    attributes = _frames.attributes(options, ri_base="one", source="CSI report, truncated mean", ports=_ports(data))
    warnings = list(instants.warnings)
    if frame["rank"].notna().any():
        warnings.append("srsENB prints the truncated mean of the ranks reported in a second: 1 may be a mix of 1 and 2")
    return ReadResult(
        "srsenb_log",
        (Stream("rank", options.channel or "srsenb", frame, attributes),) if len(frame) else (),
        len(lines),
        len(frame),
        blank,
        tuple(sorted(rejected, key=lambda line: line.number)),
        tuple(warnings),
    )


READER = Reader(
    name="srsenb_log",
    title="srsENB console: rank indicator (0 = no report)",
    kinds=("rank",),
    sample="[2025-01-01 12:00:07.000000] lte   46   11   1    2   3.7k   14    0   0% |  31.5   12.5   40   15    38k",
    sniff=sniff,
    read=read,
)
