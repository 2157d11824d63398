"""The log of ``aerpaw-cmp tap``: JSON lines, each with the CRC-32 of the bytes before its checksum.

Specification (schema ``aerpaw-cmp-tap/1``). Each line is one object with ``kind`` and the number ``n`` of the record
in its session. Its last key is ``"crc"``: eight hex digits, CRC-32 of the bytes before ``,"crc":"``. Times are
integers [ns]: UTC since 1970 and the monotonic clock.

``header``      first line of every segment: ``schema session segment boot_id port settings ri_base``
``exchange``    ``query command sent_utc_ns last_utc_ns`` (and ``_mono_``) ``status lines decoded flags``
``late unsolicited noise``  answers without a command
``gap``         ``state`` ``open`` at the loss, ``closed`` at the return, with ``from_utc_ns to_utc_ns missed``
``clock disk alarm prediction``  other events
``rotate end``  last line of a segment, and of the last one

An exchange is accepted as a record of rank (``nr5g_csi``, ``lte_csi``) or of RSS, or as a companion of these. RSS is
the RSRP of ``servingcell`` for NR and LTE, with a series per cell (PCI, ARFCN). All other intact lines are comments.
The time of a record is the middle between command and last byte; ``uncertainty_s`` is half of that span. RSRP and SINR
of a rank are those of the last ``servingcell`` within 2 s.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any, cast

import numpy as np
import pandas as pd

from aerpaw_cmp.logs import text as _text
from aerpaw_cmp.logs.files import SCHEMA, decode_record
from aerpaw_cmp.readers import (
    AnyArray,
    Attribute,
    InputError,
    Kind,
    Reader,
    ReadOptions,
    ReadResult,
    RejectedLine,
    Stream,
)

from . import _json

# RSRP and SINR older than this are not added to a rank.
_COMPANION_S = 2.0

# Line of the log, its record, the decoded values, and flags.
Answer = tuple[int, dict[str, Any], dict[str, Any], list[str]]


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


def read_pieces(pieces: Iterable[bytes], options: ReadOptions) -> ReadResult:
    """Return the records of one segment.

    Raises
    ------
    InputError
        If the schema is not :data:`SCHEMA`.
    """
    log = _Log()
    for data in pieces:
        log.add(data)
    header = log.header or {}
    about = {"clock": "utc", "node": options.node, "frequency_hz": options.frequency_hz}
    common: dict[str, Attribute] = {name: value for name, value in about.items() if value is not None}
    frames = {name: pd.concat(pieces, ignore_index=True) if pieces else None for name, pieces in log.series.items()}
    streams = []
    for name in ("nr5g", "lte"):
        frame = frames[name]
        if frame is not None and (name == "nr5g" or frame["rank"].notna().any()):
            frame = _with_serving_cell(frame, frames["nr_rsrp"]) if name == "nr5g" else frame
            of_rank = {**common, "ri_base": str(header.get("ri_base", "one")), "channel": options.channel or name}
            streams.append(Stream("rank", name, frame, of_rank))
    for leg in ("nr", "lte"):
        frame = frames[f"{leg}_rsrp"]
        if frame is not None and (leg == "nr" or frame["rss_db"].notna().any()):
            streams += _cells(frame, {**common, "unit": "dBm", "rat": leg}, options)
    return ReadResult(
        reader="tap_jsonl", streams=tuple(streams), lines=log.lines, accepted=log.exchanges, blank=log.blank,
        rejected=tuple(log.rejected), warnings=log.warnings(),
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


class _Log:
    """The state of a log while it is read."""

    def __init__(self) -> None:
        self.header: dict[str, Any] | None = None
        self.series: dict[str, list[pd.DataFrame]] = {name: [] for name in _SERIES}
        self.lines = self.exchanges = self.blank = 0
        self.rejected: list[RejectedLine] = []
        self.events: list[str] = []
        self.open_gap: dict[str, Any] | None = None
        self.numbers: set[int] = set()
        self.ended = False

    def add(self, data: bytes) -> None:
        """Read the next lines."""
        records, rejected, blank = _records(data, self.lines)
        self.lines += len(records) + len(rejected) + blank
        self.rejected += rejected
        exchanges = [(number, record) for number, record in records if record["kind"] == "exchange"]
        self.exchanges += len(exchanges)
        self.blank += blank + len(records) - len(exchanges)
        for name, (query, leg, keys) in _SERIES.items():
            if answers := [*_answered(exchanges, query, leg)]:
                self.series[name].append(_frame("rss" if leg else "rank", answers, keys))
        for _, record in records:
            self._note(record)

    def _note(self, record: dict[str, Any]) -> None:
        """Note the events in a record that concern the complete log: gaps, clock steps, lost records, the end."""
        kind = record["kind"]
        if isinstance(record.get("n"), int):
            self.numbers.add(int(record["n"]))
        if kind == "header" and self.header is None:
            self.header = record
            schema = record.get("schema")
            if schema != SCHEMA:
                cause = "it was written by another version"
                raise InputError(f"the log has schema {schema!r}", expected=SCHEMA, cause=cause)
        closed = record.get("state") == "closed"
        if kind == "gap":
            self.open_gap = None if closed else record
        if kind == "gap" and closed:
            seconds = _int(record.get("duration_ns")) / 1e9
            self.events.append(f"gap of {seconds:.1f} s: {record.get('reason', '')}")
        if kind == "clock":
            self.events.append(f"the wall clock stepped by {_int(record.get('step_ns')) / 1e9:+.3f} s")
        if kind == "disk":
            self.events.append(f"the disk failed ({record.get('reason')}); {record.get('lost')} records were lost")
        self.ended |= kind in ("end", "rotate")

    def warnings(self) -> tuple[str, ...]:
        """Return gaps, clock steps, lost and missing records, a truncated last line, and a missing end."""
        texts = list(self.events)
        if self.open_gap is not None:
            texts.append(f"the log ends inside a gap: {self.open_gap.get('reason', '')}")
        missing = max(self.numbers) - min(self.numbers) + 1 - len(self.numbers) if self.numbers else 0
        if missing:
            texts.append(f"{missing} record numbers are missing in this segment")
        if self.rejected and self.rejected[-1].reason.startswith("torn tail"):
            texts.append("the last line is truncated (power loss or kill while writing)")
        if not self.ended:
            texts.append("no end record: the session was cut off")
        return tuple(texts)


def _records(data: bytes, before: int) -> tuple[list[tuple[int, dict[str, Any]]], list[RejectedLine], int]:
    """Return the intact records with their line numbers, rejected lines, and the number of blank lines."""
    lines = data.split(b"\n")
    unterminated = lines[-1] != b""
    if not unterminated:
        lines.pop()
    records: list[tuple[int, dict[str, Any]]] = []
    rejected: list[RejectedLine] = []
    blank = 0
    last = before + len(lines)
    for number, line in enumerate(lines, before + 1):
        if not line.strip():
            blank += 1
            continue
        line = line.removesuffix(b"\r")
        try:
            record = decode_line(line)
            if unterminated and number == last:  # complete by its checksum, but flagged as in other readers
                record["flags"] = [*_flags(record), "unterminated_line"]
            records.append((number, record))
        except ValueError as error:
            reason = f"torn tail: {error}" if unterminated and number == last else str(error)
            rejected.append(RejectedLine(number, reason, line[:2000].decode("utf-8", errors="replace")[:500]))
    return records, rejected, blank


def _int(value: Any) -> int:
    return value if type(value) is int and abs(value) < 2**62 else 0


def _flags(record: dict[str, Any]) -> list[str]:
    flags = record.get("flags")
    return [str(flag) for flag in flags] if isinstance(flags, list) else []


def _frame(kind: Kind, answers: list[Answer], names: Mapping[str, str]) -> pd.DataFrame:
    """Return the frame of some answers. ``names`` maps each column to the key of its decoded value."""
    sent, last = (np.array([int(record[key]) for _, record, _, _ in answers]) for key in ("sent_utc_ns", "last_utc_ns"))
    values: dict[str, AnyArray] = {"uncertainty_s": (last - sent) / 2e9}
    for name, key in names.items():
        cells: list[Any] = [decoded.get(key) for _, _, decoded, _ in answers]
        sound = [cell if type(cell) in (int, float) and abs(cell) < 1e9 else np.nan for cell in cells]
        values[name] = np.array(sound, dtype=np.float64)
    flag = np.array([";".join(flags) for *_, flags in answers], dtype=object)
    line = np.array([number for number, *_ in answers])
    return _text.frame(kind, (sent + last) // 2, line, flag, values, own=True)


def _answered(exchanges: list[tuple[int, dict[str, Any]]], query: str, leg: str) -> Iterator[Answer]:
    """Yield the answers to a query, and failed exchanges of a rank as flagged answers without a rank."""
    for number, record in exchanges:
        decoded = _json.inside(record, "decoded")
        values = _json.inside(decoded, leg) if leg else decoded
        if record.get("query") == query and (values or not leg):
            status = [] if leg or record.get("status") == "ok" else [f"status:{record.get('status')}"]
            yield number, record, values, _flags(record) + status


def _cells(rsrp: pd.DataFrame, common: dict[str, Attribute], options: ReadOptions) -> Iterator[Stream]:
    """Yield the levels of each serving cell, whose identity is in the name if there are several."""
    cells = rsrp.groupby(list(_IDENTITY), dropna=False, sort=False)
    for key_of_cell, of_cell in cells:
        values = cast("tuple[float, ...]", key_of_cell)
        about = {key: int(value) for key, value in zip(_IDENTITY, values, strict=True) if np.isfinite(value)}
        words = [f"{key}{about[key]}" for key in ("pci", "arfcn") if key in about] if cells.ngroups > 1 else []
        name = "_".join(["nr5g_rsrp" if common["rat"] == "nr" else "lte_rsrp", *words])
        frame = of_cell.drop(columns=list(_IDENTITY)).reset_index(drop=True)
        yield Stream("rss", name, frame, {**common, **about, "channel": options.channel or name})


def _with_serving_cell(rank: pd.DataFrame, rsrp: pd.DataFrame | None) -> pd.DataFrame:
    """Add RSRP and SINR of the last serving-cell answer as columns of the rank frame."""
    columns = {"rss_db": "rsrp_dbm", "sinr_db": "sinr_db"}
    if rsrp is None:
        rank[[*columns.values()]] = np.nan
        return rank
    cells = rsrp[["time", *columns]].sort_values("time", kind="stable").rename(columns=columns)
    asked = rank[["time"]].sort_values("time", kind="stable")
    near = pd.merge_asof(asked, cells, on="time", tolerance=pd.Timedelta(_COMPANION_S, "s"))
    joined: pd.DataFrame = rank.join(near.set_index(asked.index)[[*columns.values()]])
    return joined


READER = Reader(
    name="tap_jsonl", title="Log of 'aerpaw-cmp tap': rank indicator and serving cell of a Quectel modem (JSON lines)",
    kinds=("rank", "rss"), sample='{"kind":"header","schema":"aerpaw-cmp-tap/1", ...', sniff=sniff,
    read=lambda data, options: read_pieces((data,), options), read_pieces=read_pieces,
)  # fmt: skip
