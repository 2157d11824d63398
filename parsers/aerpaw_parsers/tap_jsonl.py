"""The log of ``aerpaw-cmp tap``: JSON lines, each with the CRC-32 of the bytes before its checksum.

Specification (schema ``aerpaw-cmp-tap/1``). Each line is one object with ``kind`` and the number ``n`` of the record
in its session. Its last key is ``"crc"``: eight hex digits, CRC-32 of the bytes before ``,"crc":"``. Times are
integers [ns]: UTC since 1970 and the monotonic clock.

``header``      first line of every segment: ``schema session segment boot_id port settings ri_base``
``exchange``    ``query command sent_utc_ns last_utc_ns`` (and ``_mono_``) ``status lines decoded flags``
``late unsolicited noise``  answers without a command
``gap``         ``state`` ``open`` at the loss, ``closed`` at the return, with ``from_utc_ns to_utc_ns missed``
``clock disk alarm prediction``  other events
``rotate end``  last line of a segment, and of the last segment

An accepted exchange is a record of rank (``nr5g_csi``, ``lte_csi``) or of RSS, or adds values to such a record. RSS is
the RSRP of ``servingcell`` for NR and LTE, with a series per cell (PCI, ARFCN). All other intact lines are comments.
The time of a record is midway between command and last byte, and ``uncertainty_s`` is half the time between them. RSRP
and SINR of a rank come from the last ``servingcell`` within 2 s.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pandas as pd

from aerpaw_cmp.common.errors import InputError
from aerpaw_cmp.logs import text as _text
from aerpaw_cmp.logs.files import SCHEMA, decode_record
from aerpaw_cmp.readers import Attribute, Lines, Reader, ReadOptions, ReadResult, RejectedLine, Stream, split

from . import _json

# RSRP and SINR older than this are not added to a rank.
_COMPANION_S = 2.0

# A line of the log, counted from 1, and its record.
_Record = tuple[int, dict[str, Any]]


def sniff(head: bytes) -> bool:
    """Check whether the first line is a header of the tap."""
    first = head.lstrip(b"\0\r\n \t").split(b"\n", 1)[0]
    return first.startswith(b'{"kind":"header"') and b'"schema":"aerpaw-cmp-tap/' in first


def decode_line(line: bytes) -> dict[str, Any]:
    """Return the record of a line.

    Raises
    ------
    ValueError
        If the line is truncated or damaged.
    """
    record = decode_record(line)
    if not isinstance(record.get("kind"), str):
        raise ValueError("not a record of the tap")
    if record["kind"] == "exchange":
        for key in ("sent_utc_ns", "last_utc_ns"):
            if type(record.get(key)) is not int or not 0 <= record[key] < 2**62:
                raise ValueError(f"exchange without {key}")
    return record


def read(data: bytes, options: ReadOptions) -> ReadResult:
    """Return the records of one segment.

    Raises
    ------
    InputError
        If the schema is not :data:`SCHEMA`.
    """
    lines = split(data)
    records, rejected = _records(lines)
    header = next((record for _, record in records if record["kind"] == "header"), {"schema": SCHEMA})
    if header.get("schema") != SCHEMA:
        cause = "it was written by another version"
        raise InputError(f"the log has schema {header.get('schema')!r}", expected=SCHEMA, cause=cause)
    exchanges = [(number, record) for number, record in records if record["kind"] == "exchange"]
    about = {"clock": "utc", "node": options.node, "frequency_hz": options.frequency_hz}
    common: dict[str, Attribute] = {name: value for name, value in about.items() if value is not None}
    frames = {name: _frame(exchanges, query, leg, keys) for name, (query, leg, keys) in _SERIES.items()}
    streams = []
    for name in ("nr5g", "lte"):
        frame = frames[name]
        if len(frame) and (name == "nr5g" or frame["rank"].notna().any()):
            frame = _with_serving_cell(frame, frames["nr_rsrp"]) if name == "nr5g" else frame
            of_rank = {**common, "ri_base": str(header.get("ri_base", "one")), "channel": options.channel or name}
            streams.append(Stream("rank", name, frame, of_rank))
    for leg in ("nr", "lte"):
        frame = frames[f"{leg}_rsrp"]
        if leg == "nr" or frame["rss_db"].notna().any():
            streams += _cells(frame, {**common, "unit": "dBm", "rat": leg}, options)
    return ReadResult(
        reader="tap_jsonl", streams=tuple(streams), lines=len(lines), accepted=len(exchanges),
        blank=len(lines) - len(exchanges) - len(rejected), rejected=tuple(rejected),
        warnings=tuple(_warnings([record for _, record in records], rejected)),
    )  # fmt: skip


# Attributes of a cell, and the keys under which they were decoded.
_IDENTITY = {"pci": "pcid", "arfcn": "arfcn", "band": "band"}
_OF_RANK = {name: name for name in ("rank", "ri_raw", "mcs", "cqi", "pmi")}
# Each series: its query, the leg of the serving cell, and its columns with the keys under which they were decoded.
# SINR of LTE is in steps that the manual does not specify.
_SERIES: dict[str, tuple[str, str, dict[str, str]]] = {
    "nr5g": ("nr5g_csi", "", _OF_RANK),
    "lte": ("lte_csi", "", _OF_RANK),
    "nr_rsrp": ("servingcell", "nr", {"rss_db": "rsrp_dbm", "sinr_db": "sinr_db", **_IDENTITY}),
    "lte_rsrp": ("servingcell", "lte",
                 {"rss_db": "rsrp_dbm", "rsrq_db": "rsrq_db", "rssi_dbm": "rssi_dbm", **_IDENTITY}),
}  # fmt: skip


def _records(lines: Lines) -> tuple[list[_Record], list[RejectedLine]]:
    """Return the intact records and the rejected lines."""
    torn = len(lines) - 1 if lines.unterminated else -1
    records: list[_Record] = []
    rejected: list[RejectedLine] = []
    for i in np.flatnonzero(~lines.blank).tolist():
        try:
            record = decode_line(lines.raw(i))
        except ValueError as error:
            rejected.append(lines.reject(i, f"torn tail: {error}" if i == torn else str(error)))
            continue
        if i == torn:  # complete according to its checksum, but flagged as in other readers
            record["flags"] = [*_flags(record), "unterminated_line"]
        records.append((i + 1, record))
    return records, rejected


def _warnings(records: list[dict[str, Any]], rejected: list[RejectedLine]) -> Iterator[str]:
    """Yield gaps, clock steps, lost and missing records, a truncated last line, and a missing end."""
    gap: dict[str, Any] | None = None
    for record in records:
        if record["kind"] == "gap":
            gap = None if record.get("state") == "closed" else record
            if gap is None:
                yield f"gap of {_int(record.get('duration_ns')) / 1e9:.1f} s: {record.get('reason', '')}"
        elif record["kind"] == "clock":
            yield f"the wall clock stepped by {_int(record.get('step_ns')) / 1e9:+.3f} s"
        elif record["kind"] == "disk":
            yield f"the disk failed ({record.get('reason')}); {record.get('lost')} records were lost"
    if gap is not None:
        yield f"the log ends inside a gap: {gap.get('reason', '')}"
    numbers = {int(record["n"]) for record in records if isinstance(record.get("n"), int)}
    if missing := max(numbers) - min(numbers) + 1 - len(numbers) if numbers else 0:
        yield f"{missing} record numbers are missing in this segment"
    if rejected and rejected[-1].reason.startswith("torn tail"):
        yield "the last line is truncated (power loss or kill while writing)"
    if not any(record["kind"] in ("end", "rotate") for record in records):
        yield "no end record: the session was cut off"


def _int(value: Any) -> int:
    return value if type(value) is int and abs(value) < 2**62 else 0


def _flags(record: dict[str, Any]) -> list[str]:
    flags = record.get("flags")
    return [str(flag) for flag in flags] if isinstance(flags, list) else []


def _frame(exchanges: list[_Record], query: str, leg: str, names: Mapping[str, str]) -> pd.DataFrame:
    """Return the answers to a query. ``names`` maps each column to the key of its decoded value.

    Failed exchanges of a rank are flagged answers without a rank.
    """
    answers = []
    for number, record in exchanges:
        values = _json.inside(record, "decoded")
        values = _json.inside(values, leg) if leg else values
        if record.get("query") == query and (values or not leg):
            status = [] if leg or record.get("status") == "ok" else [f"status:{record.get('status')}"]
            flag = ";".join(_flags(record) + status)
            answers.append((number, record["sent_utc_ns"], record["last_utc_ns"], flag, values))
    line, sent, last, flags, decoded = zip(*answers, strict=True) if answers else [()] * 5
    sent_ns, last_ns = np.array(sent, dtype=np.int64), np.array(last, dtype=np.int64)
    columns = {name: _json.column(decoded, key) for name, key in names.items()}
    values = {"uncertainty_s": (last_ns - sent_ns) / 2e9, **columns}
    return _text.frame("rss" if leg else "rank", (sent_ns + last_ns) // 2, np.array(line), np.array(flags), values)


def _cells(rsrp: pd.DataFrame, common: dict[str, Attribute], options: ReadOptions) -> Iterator[Stream]:
    """Yield the levels of each serving cell. Names contain the identity of the cell if there are several cells."""
    cells = rsrp.groupby(["pci", "arfcn"], dropna=False, sort=False)
    for _, of_cell in cells:
        # an answer with a lost line has no band, but belongs to the same cell
        identity = of_cell[list(_IDENTITY)].max()
        about = {key: int(identity[key]) for key in _IDENTITY if np.isfinite(identity[key])}
        words = [f"{key}{about[key]}" for key in ("pci", "arfcn") if key in about] if cells.ngroups > 1 else []
        name = "_".join(["nr5g_rsrp" if common["rat"] == "nr" else "lte_rsrp", *words])
        frame = of_cell.drop(columns=list(_IDENTITY)).reset_index(drop=True)
        yield Stream("rss", name, frame, {**common, **about, "channel": options.channel or name})


def _with_serving_cell(rank: pd.DataFrame, rsrp: pd.DataFrame) -> pd.DataFrame:
    """Add RSRP and SINR of the last serving-cell answer as columns of the rank frame."""
    columns = {"rss_db": "rsrp_dbm", "sinr_db": "sinr_db"}
    cells = rsrp[["time", *columns]].sort_values("time", kind="stable").rename(columns=columns)
    asked = rank[["time"]].sort_values("time", kind="stable")
    near = pd.merge_asof(asked, cells, on="time", tolerance=pd.Timedelta(_COMPANION_S, "s"))
    joined: pd.DataFrame = rank.join(near.set_index(asked.index)[[*columns.values()]])
    return joined


READER = Reader(
    name="tap_jsonl", title="Log of 'aerpaw-cmp tap': rank indicator and serving cell of a Quectel modem (JSON lines)",
    kinds=("rank", "rss"), sample='{"kind":"header","schema":"aerpaw-cmp-tap/1", ...', sniff=sniff,
    read=read,
)  # fmt: skip
