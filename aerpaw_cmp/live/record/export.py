"""A tap log as one CSV table for spreadsheets: numbers and known words only, the raw text stays in the log."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from ...common.cells import guarded_text
from ...common.errors import InputError
from ...common.outputs import OutputFile
from ...logs.files.checksums import Record
from .log import BadLine, read_log, segments

COLUMNS = (
    *("time_utc", "uncertainty_s", "n", "query", "status"),
    *("rank", "ri_raw", "mcs", "cqi", "pmi"),
    *("state", "rat", "pcid", "arfcn", "band", "rsrp_dbm", "rsrq_db", "sinr_db"),
    *(f"{name}_rx{i}_{unit}" for name, unit in (("rsrp", "dbm"), ("rsrq", "db"), ("sinr", "db")) for i in range(4)),
    *("predicted_rank", "gap_s", "flags"),
)
_UNSAFE = re.compile(r"[^A-Za-z0-9_:.;()\- ]")


@dataclass(frozen=True, slots=True)
class ExportSummary:
    """Rows written, and lines of the log that were no records."""

    path: Path
    rows: int
    bad_lines: tuple[BadLine, ...]

    def __str__(self) -> str:
        bad = f", {len(self.bad_lines)} damaged lines left out" if self.bad_lines else ""
        return f"{self.path}: {self.rows} rows{bad}"


def _word(value: object) -> str:
    """A word that no spreadsheet takes for a formula."""
    return _UNSAFE.sub("", str(value))[:200].lstrip("-=+@ ")


def _time(utc_ns: int) -> str:
    second = datetime.fromtimestamp(utc_ns // 1_000_000_000, tz=timezone.utc)
    return f"{second:%Y-%m-%dT%H:%M:%S}.{utc_ns % 1_000_000_000 // 1_000_000:03d}Z"


def _row(record: Record) -> dict[str, Any] | None:
    """Row of a record, None if it has none."""
    kind = record["kind"]
    if kind == "exchange":
        return _exchange_row(record)
    if kind == "prediction":
        return {"time_utc": _time(record["at_utc_ns"]), "query": "prediction", "predicted_rank": record["predicted"]}
    if kind == "gap" and record["state"] == "closed":
        return {"time_utc": _time(record["from_utc_ns"]), "query": "gap", "gap_s": record["duration_ns"] / 1e9}
    return None


def _exchange_row(record: Record) -> dict[str, Any]:
    sent, last, values = record["sent_utc_ns"], record["last_utc_ns"], record["decoded"]
    row = {
        "time_utc": _time((sent + last) // 2),
        "uncertainty_s": round((last - sent) / 2e9, 6),
        "query": _word(record["query"]),
        "status": _word(record["status"]),
        "flags": _word(";".join(record["flags"])),
    }
    row |= {name: values.get(name) for name in ("rank", "ri_raw", "mcs", "cqi", "pmi") if name in values}
    if record["query"] == "servingcell":
        row |= {name: _word(values.get(name) or "") for name in ("state", "rat")}
        cell = values.get("nr") or values.get("lte") or {}
        row |= {name: cell.get(name) for name in ("pcid", "arfcn", "band", "rsrp_dbm", "rsrq_db", "sinr_db")}
    for technology in values.values():
        for name, levels in technology.items() if isinstance(technology, dict) else ():
            if record["query"] in ("qrsrp", "qrsrq", "qsinr") and isinstance(levels, list) and "_" in name:
                quantity, unit = name.split("_")
                row |= {f"{quantity}_rx{i}_{unit}": level for i, level in enumerate(levels[:4])}
    return row


def _rows(source: Path, bad: list[BadLine]) -> Iterator[dict[str, Any]]:
    for record in read_log(source, bad):
        try:
            row = _row(record)
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise InputError(
                f"record {record.get('n')} lacks what its kind {record.get('kind')!r} must have ({error})",
                expected="a log of 'aerpaw-cmp tap'",
                cause="the log was edited or written by another version",
                path=source,
            ) from None
        if row is not None:
            yield {"n": record["n"], **row}


def _is_export(path: Path) -> bool:
    """Check whether a file begins as a table of this module."""
    head = ",".join(COLUMNS) + "\r\n"
    with path.open("rb") as stream:
        return stream.read(len(head)) == head.encode("ascii")


def export_csv(source: Path, out: Path, *, force: bool = False) -> ExportSummary:
    """Write one CSV row per exchange, prediction and gap of a tap log: the whole file or none.

    Parameters
    ----------
    source : Path
        A segment, or the folder of a log.
    out : Path
        The CSV file; its folder must exist.
    force : bool
        Replace a file that is no such table.

    Raises
    ------
    InputError
        If the log cannot be read.
    UsageError
        If the file is part of the log, or no table of this function.
    OutputError
        If the disk does not take it.
    """
    bad: list[BadLine] = []
    rows = 0
    logs = segments(source)  # raises before anything is written
    with OutputFile(out, own=_is_export, inputs=logs, force=force) as output:
        table = io.StringIO(newline="")
        writer = csv.DictWriter(table, COLUMNS, extrasaction="ignore")
        writer.writeheader()
        for row in _rows(source, bad):
            writer.writerow({name: guarded_text(cell) if isinstance(cell, str) else cell for name, cell in row.items()})
            rows += 1
        output.write(table.getvalue().encode("ascii"))
    return ExportSummary(out, rows, tuple(bad))
