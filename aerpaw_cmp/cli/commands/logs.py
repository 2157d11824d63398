"""``ingest``, ``formats``."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from typer import Argument, Option

from ...common.errors import UsageError
from ...common.grouping import lists_by_key
from ...common.stages import duration
from ..app import Force, command, output
from ..shown import answered, records, say, show, table


@command(
    "ingest",
    examples=[
        "aerpaw-cmp ingest my_logs/ -o flight.h5",
        "aerpaw-cmp ingest my_logs/ --timezone America/New_York --draft flight.yaml",
        "aerpaw-cmp ingest levels.csv --map time=time --map power_dbm=rss_db --unit dBm --json",
    ],
)
def ingest(
    paths: Annotated[list[Path], Argument(help="Log files and folders.")],
    out: Annotated[Path | None, output("Flight file (HDF5) with every record  [default: not written]", "FILE")] = None,
    draft: Annotated[Path | None, Option(help="Also write a first flight.yaml that names these logs.")] = None,
    site: Annotated[
        str | None, Option(help="Site of the draft; its learned antennas are used  [default: lake_wheeler]")
    ] = None,
    reader: Annotated[str | None, Option(help="Reader for all files  [default: detected by content]")] = None,
    timezone: Annotated[
        str | None, Option(help="IANA time zone of clocks without a zone, such as America/New_York.")
    ] = None,
    time_origin: Annotated[str | None, Option(help="Start time (ISO 8601) of logs with relative times.")] = None,
    ri_base: Annotated[Literal["zero", "one"] | None, Option(help="Number that the log prints for rank 1.")] = None,
    columns: Annotated[
        list[str] | None,
        Option("--map", metavar="COLUMN=QUANTITY", help="Content of a CSV column: time, rss_db, rank, ..."),
    ] = None,
    unit: Annotated[str | None, Option(help="dBm, dBFS or dB: unit of levels, if the file does not state it.")] = None,
    every_stream: Annotated[bool, Option("--all", help="Name every stream of a wide table.")] = False,
    force: Force = False,
) -> None:
    """Read logs, account for every line, and write the flight file."""
    from ...jobs import run
    from ...logs.ingest import summary as account

    if site is not None and draft is None:
        raise UsageError("--site without --draft", expected="--draft FILE, because only a draft uses the site")
    options = {"timezone": timezone, "time_origin": time_origin, "ri_base": ri_base, "unit": unit}
    if columns:
        # options take precedence over --map, which may set the same keys, such as the number of rank 1
        options = run.mapping(columns) | {key: value for key, value in options.items() if value is not None}
        reader = reader or "generic_csv"
    try:
        summary = run.run_ingest(paths, out=out, draft=draft, site=site, reader=reader, force=force, **options)
    except UsageError as error:
        if error.others and not say.as_json:
            _show(account(error.others), every_stream)
        raise
    if answered(summary):
        return
    _show(summary, every_stream)
    if out is not None:
        flights = summary["flights"]
        several = f": {len(flights)} flights, {', '.join(flights)}" if len(flights) > 1 else ""
        show(f"wrote {out}{several}")
    if draft is not None:
        for remark in summary["draft"]:
            # all other remarks, about a line to check or a skipped log, are warnings, which are also shown with --quiet
            (say if remark.endswith("can be compared") else say.warn)(remark)
        for place in summary["drafts"]:
            show(f"wrote {place}")


def _show(summary: Mapping[str, Any], every_stream: bool) -> None:
    from ...logs.ingest import account_notes

    folder, rows = account_rows(summary, every_stream)
    table(list(ACCOUNT), rows, f"Files in {folder}" if folder else None)
    for note in account_notes(summary):
        say(note)


# Columns of :func:`account_rows`.
ACCOUNT = ("file", "reader", "streams (rows)", "lines", "accepted", "rejected", "blank", "rate Hz", "start UTC", "s")
# If a kind has more streams than this, as in a wide table, only the number of streams is shown.
_MOST_NAMED = 6


def account_rows(account: Mapping[str, Any], every_stream: bool = False) -> tuple[str, list[list[str]]]:
    """Return the common folder of all paths, or an empty text, and one row with the columns :data:`ACCOUNT` per file.

    Parameters
    ----------
    account : mapping
        The output of :func:`aerpaw_cmp.logs.ingest.summary`.
    every_stream : bool
        True to name the streams of wide tables.
    """
    paths = [Path(file["path"]) for file in account["files"]]
    shared = len(paths) > 1 and len({path.is_absolute() for path in paths}) == 1
    folder = os.path.commonpath([path.parent for path in paths]) if shared else ""
    return folder, [_account_row(file, folder, every_stream) for file in account["files"]]


def _account_row(file: Mapping[str, Any], folder: str, every_stream: bool) -> list[str]:
    kinds = lists_by_key((stream["kind"], f"{stream['name']} {stream['rows']}") for stream in file["streams"])
    streams = "; ".join(
        f"{kind}: {', '.join(names) if every_stream or len(names) <= _MOST_NAMED else f'{len(names)} (--all)'}"
        for kind, names in kinds.items()
    )
    # use a set, so that a rate that several streams of a log have is printed once
    rates = {"-" if stream["rate_hz"] is None else _rate_words(stream["rate_hz"]) for stream in file["streams"]}
    return [
        str(Path(file["path"]).relative_to(folder) if folder else file["path"]), file["reader"], streams or "-",
        *(str(file[key]) for key in ("lines", "accepted", "rejected", "blank")), ", ".join(sorted(rates)) or "-",
        *_start_and_length([stream for stream in file["streams"] if stream["start"]]),
    ]  # fmt: skip


def _rate_words(rate_hz: float) -> str:
    return f"{rate_hz:.3g}" if rate_hz >= 0.1 else f"1 in {duration(1.0 / rate_hz)}"


def _start_and_length(streams: Sequence[Mapping[str, Any]]) -> tuple[str, str]:
    import numpy as np

    from ...logs.records import has_wall_clock

    if not streams:
        return "-", "-"
    first = min(np.datetime64(stream["start"].rstrip("Z")) for stream in streams)
    last = max(np.datetime64(stream["end"].rstrip("Z")) for stream in streams)
    start = str(first.astype("datetime64[s]")).replace("T", " ")
    return start if has_wall_clock(first) else "relative", f"{(last - first) / np.timedelta64(1, 's'):.1f}"


@command("formats", examples=["aerpaw-cmp formats", "aerpaw-cmp formats --json"])
def formats() -> None:
    """List the readers, each with a sample line."""
    from ...logs.readers import catalogue

    readers = sorted(catalogue(), key=lambda r: r.name)
    listed = [{"name": r.name, "title": r.title, "kinds": list(r.kinds), "sample": r.sample} for r in readers]
    if answered({"readers": listed}):
        return
    columns = {"reader": "name", "what": "title", "streams": "kinds", "sample line": "sample"}
    records([{**item, "kinds": ", ".join(item["kinds"])} for item in listed], columns)
