"""The ``diff`` job: read two reports of one flight and compare them on common samples."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from ..common.content import KEY
from ..common.errors import InputError, UsageError, one_line, parsing
from ..common.files import LARGEST_TABLE, read_bounded
from ..common.outputs import OutputFolder, changed_files
from ..common.text import unguarded
from ..common.units import FloatArray
from ..compare import verdict
from ..compare.statistics import pooled_difference
from ..report.columns import RANK, RSS, header
from ..report.diff import Entry, InputEntry, ReportDiff, ReportSide
from ..report.page import links_of

_NEEDED: dict[str, type] = {
    "flight": str, "versions": dict, "inputs": list, "settings": dict, "rss": dict, "rank": dict,
}  # fmt: skip
_SIMULATED = "simulated_rank_k"


@dataclass(frozen=True, slots=True, kw_only=True)
class ReadReport:
    """A report on the disk: metrics.json and its tables of samples."""

    place: Path
    files: tuple[Path, ...]
    metrics: dict[str, Any]
    rss: Any
    rank: Any
    remarks: tuple[str, ...]


def run_diff(first: Path, second: Path, *, out: Path | None = None, force: bool = False) -> ReportDiff:
    """Compare two reports, and write ``diff.html`` and ``diff.json`` into ``out`` if it is given.

    Parameters
    ----------
    first, second : Path
        Folders of reports.
    out : Path, optional
        Folder of the results.
    force : bool
        Also write into a folder with files of other programs.

    Returns
    -------
    ReportDiff
        Differences of settings, inputs, levels and ranks.

    Raises
    ------
    UsageError
        If the reports are of different flights.
    InputError
        If a folder is not a report, is of an older version, or is damaged.
    """
    first_report, second_report = _read_report(first), _read_report(second)
    _same_flight(first_report, second_report)
    if out is None:
        return _compare_reports(first_report, second_report)
    from ..report.diff import write_diff

    inputs = [*first_report.files, *second_report.files]
    with OutputFolder(out, job="diff", inputs=inputs, force=force) as output, output.filling() as place:
        diff = _compare_reports(first_report, second_report)
        write_diff(diff, place)
    return diff


# --- reading --------------------------------------------------------------------------------------------------------


def _read_report(place: Path) -> ReadReport:
    """Read metrics.json and the tables of a report.

    Raises
    ------
    InputError
        If a file is missing, damaged or of another kind.
    """
    metrics = read_metrics(place / "metrics.json")
    files = {kind: place / f"{kind}.csv" for kind in ("rss", "rank")}
    rss, rank = (_table(files[kind], kind, header(columns)) for kind, columns in (("rss", RSS), ("rank", RANK)))
    changed = [name for name in changed_files(place) if name in ("metrics.json", "rss.csv", "rank.csv")]
    remarks = [f"{place / name} was changed after the report wrote it." for name in changed]
    return ReadReport(
        place=place,
        files=(place / "metrics.json", *files.values()),
        metrics=metrics,
        remarks=tuple(remarks),
        rss=rss,
        rank=rank,
    )


def read_metrics(file: Path) -> dict[str, Any]:
    """Read the numbers of a report from its metrics.json."""
    place = file.parent
    if not file.is_file():
        foreign = next((n for n in ("campaign.json", "diff.json") if (place / n).is_file()), None)
        raise InputError(
            "there is no metrics.json" if place.is_dir() else "there is no such file or folder",
            expected="the folder of a report, or its metrics.json",
            cause=None if foreign is None else f"the folder has {foreign}: only reports of a flight can be compared",
            path=place,
        )
    with parsing(file, "metrics.json of a report", "a truncated copy"):
        content = json.loads(read_bounded(file, LARGEST_TABLE, "metrics.json"))
    numbers = content if isinstance(content, dict) else {}
    missing = [key for key, kind in _NEEDED.items() if not isinstance(numbers.get(key), kind)]
    if not missing and not all(isinstance(i, dict) and isinstance(i.get("path"), str) for i in content["inputs"]):
        missing = ["inputs"]
    towers = [] if missing else list(content["rss"].values())
    if not all(isinstance(t, dict) and all(isinstance(n, dict) for n in t.values()) for t in towers):
        missing = ["rss"]
    if missing:
        raise InputError(
            f"has no {', '.join(map(repr, missing))}, which every report writes",
            expected="metrics.json of `aerpaw-cmp report`",
            cause="a map, a calibration, or a report of another version: run the report again",
            path=file,
        )
    return content  # type: ignore[no-any-return]


def _table(path: Path, kind: str, columns: Sequence[str]) -> Any:
    """Read a table of samples. An error names the line of the table."""
    import pandas as pd

    texts = {name: "str" for name in ("time_utc", "tower", "channel", "unit") if name in columns}
    with parsing(path, f"the table {kind}.csv in the folder of metrics.json", "a damaged or edited file"):
        content = read_bounded(path, LARGEST_TABLE, f"{kind}.csv")
        # a tower may be named NA or nan; read in chunks, a column could get two types
        table = pd.read_csv(BytesIO(content), dtype=texts, keep_default_na=False, na_values=[""], low_memory=False)
    if not content.endswith(b"\n"):
        raise InputError("the last line does not end", cause="a truncated copy", path=path, line=len(table) + 1)
    if missing := [name for name in columns if name not in table.columns]:
        raise InputError(
            f"has no column {missing[0]!r}", expected=f"the columns of {kind}.csv", cause="an older version", path=path
        )
    for name in [name for name in table.columns if name not in texts and len(table)]:
        bad = pd.to_numeric(table[name], errors="coerce").isna() & table[name].notna()
        if bad.any():
            row = int(np.flatnonzero(bad.to_numpy())[0])
            shown = one_line(str(table[name].iloc[row]))
            raise InputError(f"column {name!r}: {shown!r}", expected="a number", path=path, line=row + 2)
    torn = table["tower"].isna() | table["time_s"].isna()
    if torn.any():
        row = int(np.flatnonzero(torn.to_numpy())[0])
        raise InputError("a row without a tower or a time", cause="a truncated line", path=path, line=row + 2)
    text = [name for name in texts if name in table]
    table[text] = table[text].fillna("").map(unguarded)
    return table


def _same_flight(first: ReadReport, second: ReadReport) -> None:
    """Raise UsageError for reports that have neither name nor log in common."""
    names = [side.metrics["flight"] for side in (first, second)]
    logs = [{i.get("sha256") for i in side.metrics["inputs"] if i.get("reader")} for side in (first, second)]
    if names[0] != names[1] and not logs[0] & logs[1]:
        raise UsageError(
            f"reports of different flights: {one_line(str(names[0]))} and {one_line(str(names[1]))}, without a log "
            "in common",
            expected="two reports of one flight (campaign compares flights)",
            path=second.place,
        )


# --- comparing ------------------------------------------------------------------------------------------------------


def _compare_reports(first: ReadReport, second: ReadReport) -> ReportDiff:
    """Return the differences between two reports."""
    compared = list(_levels(first, second))
    residuals, places = [item[1] for item in compared], [item[2] for item in compared]
    alone = [sorted(_links(a) - _links(b)) for a, b in ((first, second), (second, first))]
    return ReportDiff(
        first=_side(first),
        second=_side(second),
        settings=tuple(_entries(first.metrics["settings"], second.metrics["settings"])),
        inputs=tuple(_inputs(first.metrics["inputs"], second.metrics["inputs"])),
        versions=tuple(_entries(first.metrics["versions"], second.metrics["versions"])),
        levels=tuple(item[0] for item in compared),
        ranks=tuple(_ranks(first, second)),
        pooled=pooled_difference(residuals, place_m=places) if residuals else None,
        links_first_only=tuple(alone[0]),
        links_second_only=tuple(alone[1]),
        remarks=(*first.remarks, *second.remarks, *_learned_here(first, second)),
    )


def _learned_here(first: ReadReport, second: ReadReport) -> Iterator[str]:
    """Yield a remark on the links of each report whose model was learned from this flight's log."""
    for side in (first, second):
        if names := [" ".join(link).strip() for link, n in links_of(side.metrics["rss"]).items() if n.get(KEY)]:
            yield f"{side.place}: {', '.join(names)}: learned from this flight's own log, so errors are not compared."


def _side(side: ReadReport) -> ReportSide:
    m = side.metrics
    return ReportSide(
        folder=str(side.place),
        flight=str(m["flight"]),
        generated=str(m.get("generated", "")),
        version=f"aerpaw-cmp {m['versions'].get('aerpaw-cmp', 'unknown')}",
    )


def _links(side: ReadReport) -> set[str]:
    rss = {" ".join(link).strip() for link in links_of(side.metrics["rss"])}
    return rss | {f"{tower} rank" for tower in side.metrics["rank"]}


def flat(value: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """Yield dotted keys and plain values of nested settings. Entries of a list have their number as key."""
    if isinstance(value, Mapping) and value:
        for name, item in value.items():
            yield from flat(item, f"{key}.{name}" if key else str(name))
    elif isinstance(value, list) and value and any(isinstance(item, (Mapping, list)) for item in value):
        for index, item in enumerate(value):
            yield from flat(item, f"{key}.{index}")
    else:
        yield key, value


def _entries(first: Any, second: Any) -> Iterator[Entry]:
    """Yield the keys whose values differ."""
    first_values, second_values = dict(flat(first)), dict(flat(second))
    for key in [*first_values, *(key for key in second_values if key not in first_values)]:
        if (key in first_values) != (key in second_values) or first_values[key] != second_values[key]:
            yield Entry(key=key, first=first_values.get(key), second=second_values.get(key))


def _inputs(first: list[dict[str, Any]], second: list[dict[str, Any]]) -> Iterator[InputEntry]:
    """Yield files that were added, removed or changed. A moved file with the same content is unchanged."""
    sides = [{(i.get("role", ""), i["path"]): i.get("sha256") for i in side} for side in (first, second)]
    contents = [{(role, digest) for (role, _), digest in side.items()} for side in sides]
    for role, path in dict.fromkeys([*sides[0], *sides[1]]):
        before, after = (side.get((role, path)) for side in sides)
        if ((role, before or after) in contents[0] & contents[1] and None in (before, after)) or before == after:
            continue
        yield InputEntry(role=role, path=path, what="changed" if before and after else "removed" if before else "added")


# --- samples --------------------------------------------------------------------------------------------------------


def _matched(mine: Any, theirs: Any) -> tuple[verdict.Overlap, Any, Any]:
    """Return the rows of two tables of one link at common times. Rows with the same time keep their order."""

    def keyed(table: Any) -> Any:
        # logs without times of day have seconds after the first sample
        instant = table["time_utc"].where(table["time_utc"] != "", table["time_s"].map("{:.4f}".format))
        return table.assign(_key=instant, _turn=instant.groupby(instant).cumcount()).set_index(["_key", "_turn"])

    first, second = keyed(mine), keyed(theirs)
    # in the usual case of two reports of the same logs, avoid the join, which would take most of the time
    if first.index.equals(second.index):
        return verdict.Overlap(first=len(first), second=len(second), common=len(first)), first, second
    common = first.index.intersection(second.index, sort=False)
    overlap = verdict.Overlap(first=len(first), second=len(second), common=len(common))
    return overlap, first.loc[common], second.loc[common]


def _values(table: Any, name: str) -> FloatArray:
    return np.asarray(table[name], dtype=np.float64)


def _instants(table: Any) -> FloatArray:
    """Return seconds since 1970, or since the first sample of the link if the log has no times of day."""
    import pandas as pd

    known = pd.to_datetime(table["time_utc"].where(table["time_utc"] != ""), utc=True, errors="coerce")
    seconds = (known - pd.Timestamp(0, tz="UTC")).dt.total_seconds()
    return np.asarray(seconds.fillna(table["time_s"]), dtype=np.float64)


def _places_m(table: Any) -> FloatArray:
    """Return the position of each sample, shape (n, 3) [m]."""
    return np.column_stack([_values(table, name) for name in ("east_m", "north_m", "up_m")])


def _levels(mine: ReadReport, theirs: ReadReport) -> Iterator[tuple[verdict.LevelDifference, Any, FloatArray]]:
    """Yield the difference of each common link, with the data of its common samples.

    The data are the times [s], the residuals of the second and of the first report, and the positions (n, 3).
    """
    names = ("measured_db", "simulated_dbm", "residual_db")
    for (tower, channel), numbers in links_of(mine.metrics["rss"]).items():
        their_numbers = theirs.metrics["rss"].get(tower, {}).get(channel)
        if their_numbers is None or numbers.get(KEY) or their_numbers.get(KEY):
            continue  # do not compare errors on training logs
        tables = [s.rss[(s.rss["tower"] == tower) & (s.rss["channel"] == channel)] for s in (mine, theirs)]
        overlap, a, b = _matched(*tables)
        first, second = ((_values(t, names[0]), _values(t, names[1]), _values(t, names[2])) for t in (a, b))
        offsets = [np.nan if n.get("offset_db") is None else float(n["offset_db"]) for n in (numbers, their_numbers)]
        scored = [int(table["residual_db"].notna().sum()) for table in tables]
        place_m = _places_m(a)
        difference = verdict.level_difference(
            tower, channel, overlap, first, second,
            scored=(scored[0], scored[1]), offsets_db=(offsets[0], offsets[1]), place_m=place_m,
        )  # fmt: skip
        yield difference, (_instants(a), second[2], first[2]), place_m


def _ranks(first: ReadReport, second: ReadReport) -> Iterator[verdict.RankDifference]:
    ks = [
        c.removeprefix(_SIMULATED) for c in first.rank.columns if c.startswith(_SIMULATED) and c in second.rank.columns
    ]
    for tower in first.metrics["rank"]:
        if tower not in second.metrics["rank"]:
            continue
        overlap, a, b = _matched(*(s.rank[s.rank["tower"] == tower] for s in (first, second)))
        for k in ks:
            pairs = [(_values(t, "measured_rank"), _values(t, f"{_SIMULATED}{k}")) for t in (a, b)]
            yield verdict.rank_difference(tower, k, overlap, pairs[0], pairs[1], _places_m(a))
