"""srsRAN Project gNB: the console's table through ``ts``, its log's scheduler lines, and its metrics as JSON.

Console: ``[time] pci rnti | cqi ri mcs brate ok nok (%) ...`` once a second, with or without the bar and the
columns after it. Log: ``time [METRICS ] ... Scheduler UE ... cqi=15 dl_ri=2.0 dl_mcs=27 ...``. JSON: an object per
line with ``timestamp`` (epoch in s, or text) and ``ue_list``, at the top or in ``cells``.

RI counts from one and is the mean over the report period. A value between two ranks is stored as ``rank_mean``, and the
rank is missing.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from aerpaw_cmp.logs import dictionary
from aerpaw_cmp.logs import text as _text
from aerpaw_cmp.readers import InputError, OtherLines, Reader, ReadOptions, ReadResult, built, matched, mean_rank

from . import _json, _stamps

_N = rb" +(?P<%s>-?\d{1,6}(?:\.\d{1,6})?|n/a)"
_STAMP = rb"^\[?(?P<time>" + _text.TIME + _text.ZONE + rb")\]?"
_ROW = re.compile(
    _STAMP
    + rb" *(?P<pci>\d{1,4}) +(?P<rnti>(?:0x)?[0-9a-fA-F]{1,6})(?: +\|)?" + _N % b"cqi" + _N % b"ri" + _N % b"mcs"
    + rb" +[0-9.]{1,12}[kMG]?(?: +\d{1,9}){2} +\d{1,3}%[^\n]{0,200}$",
    re.MULTILINE,
)  # fmt: skip
_LOG = re.compile(
    _STAMP + rb" +\[METRICS *\][^\n]{0,200}?\bpci=(?P<pci>\d{1,4})[^\n]{0,80}?\brnti=(?:0x)?(?P<rnti>[0-9a-fA-F]{1,6})"
    rb"[^\n]{0,200}?\bcqi=(?P<cqi>\d{1,4}(?:\.\d{1,4})?|n/a)[^\n]{0,80}? (?:dl_)?ri=(?P<ri>\d{1,4}(?:\.\d{1,4})?|n/a)"
    rb"[^\n]{0,80}? dl_mcs=(?P<mcs>\d{1,4}(?:\.\d{1,4})?|n/a)"
    rb"[^\n]{0,4000}$",
    re.MULTILINE,
)
_TITLE = re.compile(_STAMP + rb" *\|? *pci +rnti +(?:\| +)?cqi +ri +mcs", re.MULTILINE)
_SCHEDULER = re.compile(_STAMP + rb" +\[METRICS *\][^\n]{0,300}\bdl_ri=", re.MULTILINE)
_TORN = re.compile(rb"^\[?[-0-9/]{10}[ T][0-9:.]{8,18}\]? +\d{1,4} +(?:0x)?[0-9a-fA-F]{1,6} ")


def sniff(head: bytes) -> bool:
    """Check whether a file is the console with its title line, or the log with scheduler metrics."""
    known = b" rnti " in head or b"[METRICS" in head
    return known and not head.startswith(_text.MARKUP) and any(mark.search(head) for mark in (_TITLE, _SCHEDULER))


def read(data: bytes, options: ReadOptions) -> ReadResult:
    """Return the rank stream ``gnb`` with CQI and MCS, or raise UsageError if no time zone is given."""
    pattern = _LOG if _SCHEDULER.search(data) and not _TITLE.search(data) else _ROW
    begun = pattern.search(data)
    own_stamp = begun is not None and not begun[0].startswith(b"[")  # the stamp was not written by ts
    if own_stamp and options.clock is None:
        options = replace(options, clock="utc")  # the program's log and metrics are in UTC
    rows = matched(
        data, pattern, options, reader="srsran_gnb",
        reason=lambda line: "an incomplete line of the table (truncated line?)" if _TORN.match(line) else None,
    )  # fmt: skip
    rnti = np.array([int(text, 16) if text else np.nan for text in rows.text("rnti")], dtype=np.float64)
    columns = {"cqi": rows.number("cqi"), "mcs": rows.number("mcs"), "rnti": rnti, "pci": rows.number("pci")}
    rows.clock_from = rows.clock_from or ("program" if own_stamp else None)
    return rows.result(mean_rank(rows, rows.number("ri"), columns))


def sniff_json(head: bytes) -> bool:
    """Check whether the first object has a list of UEs with RI."""
    first = _json.first(head)
    if first is None:  # the first line is longer than the sniffed bytes
        return head.lstrip()[:1] == b"{" and b'"ue_list"' in head and re.search(rb'"(dl_)?ri"\s*:', head) is not None
    return "timestamp" in first and (any(True for _ in _ues(first)) or b'"ue_list"' in head)


def _ues(report: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield the UEs of an object, at the top or in its cells."""
    for place in (report, *_json.listed(report, "cells"), *_json.listed(report, "cell_list")):
        for ue in _json.listed(_json.inside(place, "cell_container") or place, "ue_list"):
            yield _json.inside(ue, "ue_container") or ue


def read_json(data: bytes, options: ReadOptions) -> ReadResult:
    """Return the rank stream ``gnb`` with a record per UE and report, and those keys that are in the dictionary.

    Raises
    ------
    InputError
        If no UE has a rank.
    """
    lines = _text.split(data)
    reports = _json.objects(lines)
    row, entries = reports.row, reports.values
    with_ue = [i for i, entry in enumerate(entries) if any(True for _ in _ues(entry))]
    texts = [str(entries[i].get("timestamp", "")) for i in with_ue]
    if options.clock is None:
        options = replace(options, clock="utc")
    clock, time, warnings = _stamps.read(texts, options)
    # an object without UEs is valid, not a truncated line
    mute = np.setdiff1d(row, row[with_ue])  # metrics of cells or of the host
    rows = built(
        lines, row[with_ue], {"time": time}, options, reader="srsran_json", clock=clock,
        others=OtherLines(
            _json.bracket, reports.rejected, comments=np.concatenate((mute, reports.more)), closed=reports.closed
        ),
    )  # fmt: skip
    rows.warnings += warnings
    pairs = [(i, ue) for i, at in enumerate(rows.at.tolist()) for ue in _ues(entries[with_ue[at]])]
    pick, ues = np.array([i for i, _ in pairs], dtype=np.int64), [ue for _, ue in pairs]
    none = np.full(len(ues), np.nan)
    columns = {"rank": none, "cqi": none, "mcs": none, "rnti": _json.column(ues, "rnti")}
    for key in dict.fromkeys(key for ue in ues for key in ue):
        what = dictionary.meaning(key)
        if what is not None and not what.indirect and (name := what.quantity.name.lower()) in _OF_UE:
            before = columns.get(name, none)
            columns[name] = np.where(np.isnan(before), _json.column(ues, key), before)
    if len(ues) and np.isnan(columns["rank"]).all():
        raise InputError("no UE has a rank indicator", expected="'ri' or 'dl_ri' of UEs", cause="another version")
    return rows.result(mean_rank(rows, columns.pop("rank"), columns, pick=pick))


_OF_UE = ("rank", "cqi", "mcs", "pci")


READER = Reader(
    name="srsran_gnb", title="srsRAN Project gNB console (through ts) or log: rank indicator", kinds=("rank",),
    sample="[2025-01-01 12:00:07.000000]   1 4601 |  15   2   28    17M  908    0   0%    44k |  26.7 -21.2",
    sniff=sniff, read=read,
)  # fmt: skip
JSON_READER = Reader(
    name="srsran_json", title="srsRAN Project gNB metrics, JSON lines: rank indicator", kinds=("rank",),
    sample='{"timestamp": 1740927600.25, "ue_list": [{"ue_container": {"pci": 1, "cqi": 15, "dl_ri": 2.0}}]}',
    sniff=sniff_json, read=read_json,
)  # fmt: skip

READERS = (READER, JSON_READER)
