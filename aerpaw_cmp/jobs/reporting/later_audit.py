"""The audit as a later stage of a report.

It costs more than the rest of a short report, most of it to load the other engine. ``report.audit: later`` (or
``--audit later``) writes the report without it; the page says so, ``--strict`` fails, and ``aerpaw-cmp audit`` fills it
in. It does so by the job that made the report, on the same inputs, and exchanges the folder as a whole: page,
tables and audit are of one run and one version, never of two.
"""

from __future__ import annotations

import dataclasses
import json
import os
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...common.errors import InputError, UsageError
from ...common.files import LARGEST_TABLE, read_bounded
from ...report.data import InputFile, ReportData

METRICS = "metrics.json"


def with_later_audit(
    record: ReportData,
    settings: Any,
    flight: Path,
    folder: Path,
    logs_root: Path | None,
    asked: Mapping[str, Any],
) -> ReportData:
    """The record of a report with what an audit needs later: where its inputs are, and how it was asked for.

    Parameters
    ----------
    record : ReportData
    settings : FlightFile
        As replayed.
    flight, folder, logs_root : Path
        The flight file, the folder of the report, ``--logs-root``.
    asked : mapping
        Fields of :class:`aerpaw_cmp.jobs.run.ReportOptions`.

    Returns
    -------
    ReportData
        The same record with ``extra_metrics`` and ``audit_command`` filled.
    """
    made_from = {
        "flight": _from(folder, flight),
        "logs_root": None if logs_root is None else _from(folder, logs_root),
        **asked,
    }
    put_off = settings.report.audit == "later" and settings.rt.audit_links > 0
    command = f"aerpaw-cmp audit {shlex.quote(str(folder))}" if put_off else ""
    extra = {**record.extra_metrics, "made_from": made_from, "audit_command": command}
    return dataclasses.replace(record, extra_metrics=extra, audit_command=command)


def _from(folder: Path, place: Path) -> str:
    """A place as seen from a folder: both may move together."""
    return os.path.relpath(os.path.realpath(place), os.path.realpath(folder))


def refuse_changed(before: Sequence[Mapping[str, Any]], inputs: Sequence[InputFile]) -> None:
    """Stop where an input is another than at the first report.

    Raises
    ------
    InputError
        With the first that is.
    """
    now = {(item.path, item.role): item.sha256 for item in inputs}
    for item in before:
        key = (item["path"], item["role"])
        if now.get(key) != item["sha256"] and "packaged" not in item["role"]:
            raise InputError(
                "changed since the report was made" if key in now else "no longer an input of this flight",
                expected=f"the file with SHA-256 {item['sha256'][:12]}...",
                cause="a log or the flight file was edited: run 'aerpaw-cmp report' anew",
                path=item["path"],
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class EarlierReport:
    """A report as it stands, and what it was made from.

    Parameters
    ----------
    folder, flight : Path
    logs_root : Path or None
    audit_links : int
        As its settings ask; 200 where they ask for none.
    asked : mapping
        Fields of :class:`aerpaw_cmp.jobs.run.ReportOptions`.
    inputs : sequence of mapping
        Of its metrics.json.
    """

    folder: Path
    flight: Path
    logs_root: Path | None
    audit_links: int
    asked: Mapping[str, Any]
    inputs: Sequence[Mapping[str, Any]]


def earlier_report(target: Path, out: Path | None = None) -> EarlierReport:
    """The report in a folder, or that of a flight file.

    Parameters
    ----------
    target : Path
        Folder of a report, or the flight file that it was made from.
    out : Path, optional
        Folder of the report, where ``target`` is a flight file (default ``reports/<flight>``).

    Raises
    ------
    UsageError
        No report there.
    InputError
        It does not say what it was made from, or that is gone.
    """
    folder, named = _folder_of(target, out)
    metrics = _metrics_of(folder)
    made = dict(metrics["made_from"])
    flight = named or _plain(folder / made["flight"])
    if not flight.is_file():
        raise InputError(
            "there is no such flight file",
            expected=f"the one that {folder / METRICS} was made from",
            cause="the report was moved: name the flight file, with -o for the folder of the report",
            path=flight,
        )
    del made["flight"]
    root = made.pop("logs_root")
    return EarlierReport(
        folder=folder,
        flight=flight,
        logs_root=None if root is None else _plain(folder / root),
        audit_links=int((metrics.get("settings") or {}).get("rt", {}).get("audit_links") or 200),
        asked=made,
        inputs=metrics["inputs"],
    )


def _plain(place: Path) -> Path:
    """A place without the detour through the report's folder, for messages."""
    return Path(os.path.relpath(os.path.realpath(place)))


def _folder_of(target: Path, out: Path | None) -> tuple[Path, Path | None]:
    """Folder of a report, and the flight file where it was named."""
    if target.is_dir():
        if out is not None:
            raise UsageError("-o beside the folder of a report", expected="-o beside a flight file", path=target)
        return target, None
    from ...flight.settings import load_flight

    return out or Path("reports") / load_flight(target).flight.name, target


def _metrics_of(folder: Path) -> dict[str, Any]:
    """metrics.json of a report that an audit can be filled into."""
    path = folder / METRICS
    if not path.is_file():
        raise UsageError(
            "no report there", expected=f"a folder with {METRICS}", cause="run 'aerpaw-cmp report' first", path=folder
        )
    try:
        metrics = json.loads(read_bounded(path, LARGEST_TABLE, METRICS))
        made, inputs = metrics["made_from"], metrics["inputs"]
        whole = {"flight", "logs_root", "engine", "figures", "style", "export"} <= set(made) and isinstance(
            inputs, list
        )
    except (OSError, ValueError, KeyError, TypeError):
        whole = False
    if not whole:
        raise InputError(
            "this report does not say what it was made from",
            expected="'made_from' and 'inputs' of a report",
            cause="a report of another job or of an older version: run 'aerpaw-cmp report' anew",
            path=path,
        )
    return dict(metrics)
