"""Amarisoft eNB and gNB: the table of the monitor's ``t`` command, and answers of the remote API.

Table (through ``ts``): ``UE_ID CL RNTI C cqi ri mcs retx txok brate ...``, one row per UE and cell; its title line
says which columns there are. JSON: one answer of ``ue_get`` (``"stats": true``) per line, ``ue_list[].cells[]``
with ``cqi``, ``ri``, ``dl_mcs``, and its time in ``utc`` (epoch in s), or, where no answer of the log has that, in
``time`` (seconds of the program).

RI counts from one and is a mean over the period: a value between two ranks is kept as ``rank_mean`` and gives no
rank.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from aerpaw_cmp.logs.readers import Reader, ReadOptions
from aerpaw_cmp.logs.records import ReadResult, RejectedLine
from aerpaw_cmp.logs.text import clocks as _time
from aerpaw_cmp.logs.text import lines as _lines
from aerpaw_cmp.logs.text import rows as _rows

from . import _json

_STAMP = rb"^\[(" + _time.TIME + rb")\] *"
_TITLE = re.compile(
    _STAMP + rb"((?:UE_ID|RAN_UE_ID|PLMN)\b[^\n]{0,40}\bRNTI\b[^\n]{0,20}\bcqi\b[^\n]{0,10}\bri\b[^\n]{0,200})$",
    re.MULTILINE,
)
_LINE = re.compile(_STAMP + rb"(\S.*)$")
# Columns that are read, and the base of their numbers.
_WANTED = {"RNTI": 16, "cqi": 10, "ri": 10, "mcs": 10}


def sniff(head: bytes) -> bool:
    """Check whether the table's title line stands behind a stamp."""
    return b"RNTI" in head and _TITLE.search(head) is not None


def _table(lines: _lines.Lines) -> tuple[list[tuple[int, bytes, dict[str, float]]], list[RejectedLine]]:
    """Line, time and values of each row."""
    places: dict[str, int] = {}
    entries, rejected = [], []
    for i in range(len(lines)):
        line = lines.raw(i)
        if title := _TITLE.match(line):
            names = [name.decode("ascii", "replace") for name in title[2].split()]
            places = {name: names.index(name) for name in _WANTED if name in names}
            continue
        written = _LINE.match(line)
        if not places or written is None or not written[2][:1].isdigit():
            continue
        cells = written[2].split()
        if len(cells) <= max(places.values()):
            rejected.append(lines.reject(i, "a row that is shorter than its title (torn line?)"))
            continue
        texts = {name: cells[at].decode("ascii", "replace") for name, at in places.items()}
        entries.append(
            (i, written[1], {name: _number(texts[name], base) for name, base in _WANTED.items() if name in texts})
        )
    return entries, rejected


def _number(text: str, base: int) -> float:
    try:
        return float(int(text, 16)) if base == 16 else float(text)
    except (ValueError, OverflowError):
        return float("nan")


def read(data: bytes, options: ReadOptions) -> ReadResult:
    """Rank stream ``gnb`` with CQI and MCS; UsageError if no time zone is given."""
    lines = _lines.split(data)
    entries, rejected = _table(lines)
    time = _lines.cells([item[1] for item in entries])
    row = np.array([item[0] for item in entries], dtype=np.int64)
    rows = _rows.built(
        lines, row, {"time": time}, options, reader="amarisoft", reason=lambda _line: None, extra=rejected
    )
    timed = [entries[i][2] for i in rows.at.tolist()]
    value = {name: np.array([item.get(name, np.nan) for item in timed]) for name in _WANTED}
    columns = {"cqi": value["cqi"], "mcs": value["mcs"], "rnti": value["RNTI"]}
    return rows.result(_rows.mean_rank(rows, value["ri"], columns))


def sniff_json(head: bytes) -> bool:
    """Check whether the first object is an answer about UEs."""
    return head.lstrip()[:1] == b"{" and b'"ue_list"' in head and b'"cells"' in head and (
        b'"ue_get"' in head or re.search(rb'"(enb|ran|gnb)_ue_id"', head) is not None
    )  # fmt: skip


def read_json(data: bytes, options: ReadOptions) -> ReadResult:
    """Rank stream ``gnb``: a record per UE, cell and answer; one without the time that the others have is rejected."""
    lines = _lines.split(data)
    answers = _json.objects(lines)
    replies = answers.values
    has_utc = any("utc" in item for item in replies)
    time = _json.column(replies, "utc" if has_utc else "time")
    rows = _rows.built(
        lines, answers.row, {"time": time}, options, reader="amarisoft_json", reason=_json.bracket,
        clock="epoch_s" if has_utc else "relative_s", extra=answers.rejected, markup=answers.more,
        closed=answers.closed,
    )  # fmt: skip
    pairs: list[tuple[int, dict[str, Any]]] = [
        (i, {**ue, **cell})
        for i, at in enumerate(rows.at.tolist())
        for ue in _json.listed(replies[at], "ue_list")
        for cell in _json.listed(ue, "cells")
    ]
    return _json.ue_ranks(rows, pairs)


READER = Reader(
    name="amarisoft",
    title="Amarisoft monitor table (through ts): rank indicator",
    kinds=("rank",),
    sample="[2025-01-01 12:00:07.000000] UE_ID  CL RNTI C cqi  ri  mcs retx txok brate",
    sniff=sniff,
    read=read,
)
JSON_READER = Reader(
    name="amarisoft_json",
    title="Amarisoft remote API answers, JSON lines: rank indicator",
    kinds=("rank",),
    sample='{"message": "ue_get", "utc": 1740927600.25, "ue_list": [{"rnti": 70, "cells": [{"cqi": 15, "ri": 2.0}]}]}',
    sniff=sniff_json,
    read=read_json,
)

READERS = (READER, JSON_READER)
