"""A first flight.yaml for logs that were just read: what can be told from them is filled in, the rest is asked for."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from .config import FlightFile
from .errors import UsageError
from .files import whole
from .flight import RATIOS
from .ingest import IngestedFile
from .records import Stream

_TOWER = re.compile(r"(?<![a-z0-9])lw-?([1-5])(?![0-9])", re.IGNORECASE)
_RADIO = re.compile(r"usrp-?([0-9]+)", re.IGNORECASE)
_FIRST_YEAR = np.datetime64("1971")
"""Relative times without an origin count from 1970."""

HEAD = """\
# A first draft for these logs, made by 'aerpaw-cmp ingest --draft'. Check every line with a question mark.
"""
LINK = """\
link:
  rss: {carrier_hz: 3.3e9, transmit_power_dbm: 40, uav_transmits: true}  # as in your experiment?
"""
RANK = "# Rank is compared for the paper's 4 x 4 arrays at 3.4 GHz unless link.rank names others: is that your modem?\n"


@dataclass
class _Entries:
    """Lines of ``logs:``, and remarks on logs that stay out."""

    lines: list[str] = field(default_factory=list)
    kinds: set[str] = field(default_factory=set)
    out: list[str] = field(default_factory=list)


def write_draft(files: Sequence[IngestedFile], target: Path, *, timezone: str | None = None) -> list[str]:
    """Write a flight.yaml that names the logs.

    Parameters
    ----------
    files : sequence of IngestedFile
        As ``ingest`` read them.
    target : Path
        The flight.yaml; the paths in it are relative to its folder.
    timezone : str, optional
        What zone-less clocks were read with.

    Returns
    -------
    list of str
        What is left to check or was left out.

    Raises
    ------
    UsageError
        If the file exists, cannot be written, or no log has what a flight needs.
    """
    if target.exists():
        raise UsageError("the file exists", expected="the name of a new flight.yaml", path=target)
    text, remarks = draft(files, target.resolve().parent, timezone=timezone)
    try:
        with whole(target) as part:
            part.write_text(text, encoding="utf-8")
    except OSError as error:
        raise UsageError(f"cannot be written ({error.strerror or error})", path=target) from error
    return remarks


def draft(files: Sequence[IngestedFile], folder: Path, *, timezone: str | None = None) -> tuple[str, list[str]]:
    """The text of the flight.yaml in ``folder``, and the remarks; see :func:`write_draft`."""
    entries = _Entries()
    flown = _flown(files)
    for file in sorted(files, key=lambda f: not any(s.kind == "telemetry" for s in f.result.streams)):
        _enter(entries, file, folder, flown)
    if not entries.lines or not entries.kinds & {"rss", "rank"}:
        raise UsageError(
            "no log of RSS or rank for a flight" + "".join(f"; {remark}" for remark in entries.out),
            expected="telemetry and levels or ranks of one flight",
        )
    parts = [HEAD, f"flight: {_name(flown, files)}\n", "site: lake_wheeler  # or your own site.yaml?\n"]
    if timezone:
        parts.append(f"timezone: {timezone}\n")
    parts += ["logs:\n", *entries.lines, *(f"  # left out: {remark}\n" for remark in entries.out)]
    parts += [LINK] if "rss" in entries.kinds else []
    parts += [RANK] if "rank" in entries.kinds else []
    text = "".join(parts)
    FlightFile.model_validate(yaml.safe_load(text))  # a draft that its own reader refuses is a fault of ours
    asked = [f"check: {line.strip()}" for line in text.splitlines()[1:] if line.rstrip().endswith("?")]
    return text, asked + [f"left out: {remark}" for remark in entries.out]


Span = tuple[np.datetime64, np.datetime64]


def _flown(files: Sequence[IngestedFile]) -> Span | None:
    """First and last time of the telemetry that most levels and ranks go with; of equals, of the longest."""
    spans: dict[bool, list[Span]] = {True: [], False: []}
    for file in files:
        for stream in file.result.streams:
            if (span := _span(stream)) and span[0] >= _FIRST_YEAR:
                spans[stream.kind == "telemetry"].append(span)

    def worth(flight: Span) -> tuple[int, np.timedelta64]:
        return sum(_meet(flight, other) for other in spans[False]), flight[1] - flight[0]

    return max(spans[True], key=worth, default=None)


def _meet(one: Span, other: Span) -> bool:
    return bool(one[0] <= other[1] and other[0] <= one[1])


def _span(stream: Stream) -> Span | None:
    time = stream.frame["time"].to_numpy("datetime64[ns]")
    time = time[~np.isnat(time)]
    return (time.min(), time.max()) if len(time) else None


def _enter(entries: _Entries, file: IngestedFile, folder: Path, flown: Span | None) -> None:
    """One log: a line of ``logs:``, or the reason why not."""
    path = os.path.relpath(Path(file.path).resolve(), folder)
    used = [(s, span) for s in file.result.streams if (span := _span(s)) is not None]
    late = [s for s, span in used if flown and not _meet(span, flown)]
    ratios = [s.name for s, _ in used if s.kind == "rss" and s.name.lower() in RATIOS]
    if not used:
        entries.out.append(f"{path}: no samples")
    elif all(span[0] < _FIRST_YEAR for _, span in used):
        entries.out.append(f"{path}: its times are relative; give 'time_origin' beside its path")
    elif len(late) == len(used):
        entries.out.append(f"{path}: not at the time of the telemetry")
    elif len(ratios) == len(used):
        entries.out.append(f"{path}: {ratios[0]} is a ratio to the noise, no level")
    else:
        entry, asked = _entry(file, path, [s for s, _ in used])
        if skip := [*ratios, *(s.name for s in late)]:
            entry["skip"] = sorted(set(skip))
        entries.lines.append(f"  - {_flow(entry)}{asked}\n")
        entries.kinds |= {s.kind for s, _ in used if s.name not in skip}


def _entry(file: IngestedFile, path: str, streams: Sequence[Stream]) -> tuple[dict[str, Any], str]:
    """Keys of a log and a question about what had to be guessed."""
    entry: dict[str, Any] = {"path": path, "reader": file.result.reader}
    need = [s for s in streams if s.kind != "telemetry" and not s.attributes.get("node")]
    if not need:
        return entry, ""
    towers = _TOWER.findall(path)
    entry["node"] = f"LW{towers[-1]}" if towers else "LW1"
    if (radio := _RADIO.findall(path)) and len(need) == 1 and need[0].kind == "rss":
        entry["channel"] = f"USRP{radio[-1]}"
    return entry, "" if towers else "  # which tower?"


def _flow(value: dict[str, Any]) -> str:
    """A YAML mapping on one line."""
    text = yaml.safe_dump(value, default_flow_style=True, sort_keys=False, width=10_000, allow_unicode=True)
    return str(text).strip()


def _name(flown: Span | None, files: Sequence[IngestedFile]) -> str:
    """The time of take-off, or the folder."""
    if flown is None:
        folder = Path(files[0].path).resolve().parent.name
        return re.sub(r"[^A-Za-z0-9_.-]", "_", folder).lstrip("_.-") or "flight"
    return "flight_" + str(flown[0].astype("datetime64[m]")).replace("T", "_").replace(":", "")
