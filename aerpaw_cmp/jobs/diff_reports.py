"""The ``diff`` job: read two reports of one flight and compare them on common samples."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from ..common.content import KEY
from ..common.errors import InputError, UsageError, one_line, parsing
from ..common.files import LARGEST_TABLE, read_bounded
from ..common.jsonable import fields_of, json_object
from ..common.outputs import changed_files
from ..common.text import counted, unguarded
from ..common.units import FloatArray, Printed
from ..compare.statistics import PairedDifference, pooled_difference
from ..compare.verdict import LevelDifference, Overlap, RankDifference, level_difference, rank_difference
from ..report.columns import RANK, RSS, header
from ..report.flight_words import count
from ..report.page import links_of
from ..report.texts import cut, short

_NEEDED: dict[str, type] = {
    "flight": str, "versions": dict, "inputs": list, "settings": dict, "rss": dict, "rank": dict,
}  # fmt: skip
_SIMULATED = "simulated_rank_k"
# Differences up to this are ignored, because tables are rounded to four decimals, and offsets to one.
TOLERANCE_DB = 0.01


# A row of the comparison, such as a setting with its two values.
_Row = Mapping[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class ReportDiff:
    """Two reports and their differences. Every difference is second minus first.

    Parameters
    ----------
    first, second : mapping
        ``folder``, ``flight``, ``generated`` (time) and ``version`` of each report.
    settings, versions : tuple of mapping
        ``key`` of each value that differs, with its values ``first`` and ``second``. A value is None if a report does
        not have it.
    inputs : tuple of mapping
        ``role`` and ``path`` of each input file that differs, and ``what``: "added", "removed" or "changed".
    levels, ranks : tuple
        Differences on common samples.
    pooled : PairedDifference, optional
        Difference in RMSE over all links.
    links_first_only, links_second_only : tuple of str
        Links that only the first, or only the second, report has.
    remarks : tuple of str
        Limits of the comparison, and numbers that may be wrong.
    """

    first: _Row
    second: _Row
    settings: tuple[_Row, ...]
    inputs: tuple[_Row, ...]
    versions: tuple[_Row, ...]
    levels: tuple[LevelDifference, ...]
    ranks: tuple[RankDifference, ...]
    pooled: PairedDifference | None
    links_first_only: tuple[str, ...]
    links_second_only: tuple[str, ...]
    remarks: tuple[str, ...]

    @property
    def differences(self) -> tuple[str, ...]:
        """Clauses about numbers that differ by more than the tolerance. Empty if there are none."""
        return tuple(_differences(self))


@dataclass(frozen=True, slots=True, kw_only=True)
class ReadReport:
    """A report on the disk: metrics.json and its tables of samples."""

    place: Path
    metrics: dict[str, Any]
    rss: Any
    rank: Any
    remarks: tuple[str, ...]


def run_diff(first: Path, second: Path) -> ReportDiff:
    """Return the differences of settings, inputs, levels and ranks between two reports.

    Parameters
    ----------
    first, second : Path
        Folders of reports.

    Returns
    -------
    ReportDiff

    Raises
    ------
    UsageError
        If the reports are of different flights.
    InputError
        If a folder is not a report, is of an older version, or is damaged.
    """
    mine, theirs = _read_report(first), _read_report(second)
    _same_flight(mine, theirs)
    compared = list(_levels(mine, theirs))
    residuals, places = [item[1] for item in compared], [item[2] for item in compared]
    return ReportDiff(
        first=_side(mine),
        second=_side(theirs),
        settings=tuple(_entries(mine.metrics["settings"], theirs.metrics["settings"])),
        inputs=tuple(_inputs(mine.metrics["inputs"], theirs.metrics["inputs"])),
        versions=tuple(_entries(mine.metrics["versions"], theirs.metrics["versions"])),
        levels=tuple(item[0] for item in compared),
        ranks=tuple(_ranks(mine, theirs)),
        pooled=pooled_difference(residuals, place_m=places) if residuals else None,
        links_first_only=tuple(sorted(_links(mine) - _links(theirs))),
        links_second_only=tuple(sorted(_links(theirs) - _links(mine))),
        remarks=(*mine.remarks, *theirs.remarks, *_learned_here(mine, theirs)),
    )


# --- reading --------------------------------------------------------------------------------------------------------


def _read_report(place: Path) -> ReadReport:
    """Read metrics.json and the tables of a report.

    Raises
    ------
    InputError
        If a file is missing, damaged or of another kind.
    """
    metrics = _read_metrics(place)
    rss, rank = (_table(place, kind, header(columns)) for kind, columns in (("rss", RSS), ("rank", RANK)))
    changed = [name for name in changed_files(place) if name in ("metrics.json", "rss.csv", "rank.csv")]
    remarks = [f"{place / name} was changed after the report wrote it." for name in changed]
    return ReadReport(place=place, metrics=metrics, remarks=tuple(remarks), rss=rss, rank=rank)


def _read_metrics(place: Path) -> dict[str, Any]:
    """Read the numbers of a report from its metrics.json."""
    file = place / "metrics.json"
    if not file.is_file():
        campaign = (place / "campaign.json").is_file()
        reason = "there is no metrics.json" if place.is_dir() else "there is no such folder"
        raise InputError(
            "this is a file" if place.is_file() else reason,
            expected="the folder of a report",
            cause="the folder has campaign.json: only reports of a flight can be compared" if campaign else None,
            path=place,
        )
    with parsing(file, "metrics.json of a report", "a truncated copy"):
        content = json.loads(read_bounded(file, LARGEST_TABLE, "metrics.json"))
    numbers = content if isinstance(content, dict) else {}
    missing = [key for key, kind in _NEEDED.items() if not isinstance(numbers.get(key), kind)]
    if not missing and not all(isinstance(i, dict) and _is_input(i) for i in content["inputs"]):
        missing = ["inputs"]
    towers = [] if missing else list(content["rss"].values())
    if not all(isinstance(t, dict) and all(isinstance(n, dict) and _is_link(n) for n in t.values()) for t in towers):
        missing = ["rss"]
    if missing:
        raise InputError(
            f"has no {', '.join(map(repr, missing))}, which every report writes",
            expected="metrics.json of `aerpaw-cmp report`",
            cause="a map, a calibration, an edited file, or a report of another version: run the report again",
            path=file,
        )
    return content  # type: ignore[no-any-return]


def _is_input(entry: Mapping[str, Any]) -> bool:
    return isinstance(entry.get("path"), str) and all(
        isinstance(entry.get(name), (str, type(None))) for name in ("role", "sha256")
    )


def _is_link(entry: Mapping[str, Any]) -> bool:
    return isinstance(entry.get("offset_db"), (int, float, type(None)))


def _table(place: Path, kind: str, columns: Sequence[str]) -> Any:
    """Read a table of samples. An error names the line of the table."""
    import pandas as pd

    path = place / f"{kind}.csv"
    texts = {name: "str" for name in ("time_utc", "tower", "channel", "unit") if name in columns}
    with parsing(path, f"the table {kind}.csv in the folder of metrics.json", "a damaged or edited file"):
        content = read_bounded(path, LARGEST_TABLE, f"{kind}.csv")
        # a tower may be named NA or nan; if the table were read in chunks, a column could get two types
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


def _learned_here(first: ReadReport, second: ReadReport) -> Iterator[str]:
    """Yield, for each report, a remark about the links whose model was learned from a log of this flight."""
    for side in (first, second):
        if names := [" ".join(link).strip() for link, n in links_of(side.metrics["rss"]).items() if n.get(KEY)]:
            yield f"{side.place}: {', '.join(names)}: learned from this flight's own log, so errors are not compared."


def _side(side: ReadReport) -> _Row:
    m = side.metrics
    version = f"aerpaw-cmp {m['versions'].get('aerpaw-cmp', 'unknown')}"
    made = str(m.get("generated", ""))
    return {"folder": str(side.place), "flight": str(m["flight"]), "generated": made, "version": version}


def _links(side: ReadReport) -> set[str]:
    rss = {" ".join(link).strip() for link in links_of(side.metrics["rss"])}
    return rss | {f"{tower} rank" for tower in side.metrics["rank"]}


def flat(value: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """Yield dotted keys and plain values of nested settings. The key of a list entry is its number."""
    if isinstance(value, Mapping) and value:
        for name, item in value.items():
            yield from flat(item, f"{key}.{name}" if key else str(name))
    elif isinstance(value, list) and value and any(isinstance(item, (Mapping, list)) for item in value):
        for index, item in enumerate(value):
            yield from flat(item, f"{key}.{index}")
    else:
        yield key, value


def _entries(first: Any, second: Any) -> Iterator[_Row]:
    """Yield the keys whose values differ."""
    first_values, second_values = dict(flat(first)), dict(flat(second))
    for key in [*first_values, *(key for key in second_values if key not in first_values)]:
        if (key in first_values) != (key in second_values) or first_values[key] != second_values[key]:
            yield {"key": key, "first": first_values.get(key), "second": second_values.get(key)}


def _inputs(first: list[dict[str, Any]], second: list[dict[str, Any]]) -> Iterator[_Row]:
    """Yield files that were added, removed or changed. A moved file with the same content is unchanged."""
    sides = [{(i.get("role", ""), i["path"]): i.get("sha256") for i in side} for side in (first, second)]
    contents = [{(role, digest) for (role, _), digest in side.items()} for side in sides]
    for role, path in dict.fromkeys([*sides[0], *sides[1]]):
        before, after = (side.get((role, path)) for side in sides)
        if ((role, before or after) in contents[0] & contents[1] and None in (before, after)) or before == after:
            continue
        what = "changed" if before and after else "removed" if before else "added"
        yield {"role": role, "path": path, "what": what}


# --- samples --------------------------------------------------------------------------------------------------------


def _matched(mine: Any, theirs: Any) -> tuple[Overlap, Any, Any]:
    """Return the rows of two tables of one link at common times. Rows with the same time keep their order."""

    def keyed(table: Any) -> Any:
        # for logs without times of day, use seconds after the first sample
        instant = table["time_utc"].where(table["time_utc"] != "", table["time_s"].map("{:.4f}".format))
        return table.assign(_key=instant, _turn=instant.groupby(instant).cumcount()).set_index(["_key", "_turn"])

    first, second = keyed(mine), keyed(theirs)
    # two reports of the same logs are the usual case: avoid the join, which would take most of the time
    if first.index.equals(second.index):
        return Overlap(first=len(first), second=len(second), common=len(first)), first, second
    common = first.index.intersection(second.index, sort=False)
    overlap = Overlap(first=len(first), second=len(second), common=len(common))
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


def _levels(mine: ReadReport, theirs: ReadReport) -> Iterator[tuple[LevelDifference, Any, FloatArray]]:
    """Yield the difference of each common link, with the data of its common samples.

    The data are the times [s], the residuals of the second and of the first report, and the positions (n, 3).
    """
    names = ("measured_db", "simulated_dbm", "residual_db")
    for (tower, channel), numbers in links_of(mine.metrics["rss"]).items():
        their_numbers = theirs.metrics["rss"].get(tower, {}).get(channel)
        if their_numbers is None or numbers.get(KEY) or their_numbers.get(KEY):
            continue  # training logs have no errors to compare
        tables = [s.rss[(s.rss["tower"] == tower) & (s.rss["channel"] == channel)] for s in (mine, theirs)]
        overlap, a, b = _matched(*tables)
        first, second = ((_values(t, names[0]), _values(t, names[1]), _values(t, names[2])) for t in (a, b))
        offsets = [np.nan if n.get("offset_db") is None else float(n["offset_db"]) for n in (numbers, their_numbers)]
        scored = [int(table["residual_db"].notna().sum()) for table in tables]
        place_m = _places_m(a)
        difference = level_difference(
            tower, channel, overlap, first, second,
            scored=(scored[0], scored[1]), offsets_db=(offsets[0], offsets[1]), place_m=place_m,
        )  # fmt: skip
        yield difference, (_instants(a), second[2], first[2]), place_m


def _ranks(first: ReadReport, second: ReadReport) -> Iterator[RankDifference]:
    ks = [
        c.removeprefix(_SIMULATED) for c in first.rank.columns if c.startswith(_SIMULATED) and c in second.rank.columns
    ]
    for tower in first.metrics["rank"]:
        if tower not in second.metrics["rank"]:
            continue
        overlap, a, b = _matched(*(s.rank[s.rank["tower"] == tower] for s in (first, second)))
        for k in ks:
            pairs = [(_values(t, "measured_rank"), _values(t, f"{_SIMULATED}{k}")) for t in (a, b)]
            yield rank_difference(tower, k, overlap, pairs[0], pairs[1], _places_m(a))


# --- sentences -----------------------------------------------------------------------------------------------------


def _differences(diff: ReportDiff) -> Iterator[str]:
    for name, links in (("first", diff.links_first_only), ("second", diff.links_second_only)):
        if links:
            yield f"only the {name} report has {', '.join(links)}"
    for level in diff.levels:
        yield from (f"{level.tower} {level.channel}: {text}" for text in _level_clauses(level))
    for rank in diff.ranks:
        yield from (f"{rank.tower} K = {rank.k}: {text}" for text in _rank_clauses(rank))


def _level_clauses(level: LevelDifference) -> Iterator[str]:
    for what, value in (("measured", level.measured_max_db), ("replayed", level.simulated_max_db)):
        if value > TOLERANCE_DB:
            yield f"{what} level by up to {value:.3g} dB"
    if abs(level.offset_db.difference) > TOLERANCE_DB:
        yield f"offset by {Printed(level.offset_db.difference):+.3g} dB"
    if abs(level.rmse.difference_db) > TOLERANCE_DB:
        yield f"RMSE by {Printed(level.rmse.difference_db):+.3g} dB"
    if level.samples.only_first or level.samples.only_second:
        yield _alone(level.samples)
    elif level.scored.first != level.scored.second or level.scored.common != level.scored.first:
        yield f"{counted(level.scored.first, 'scored sample')} against {level.scored.second}"


def _alone(samples: Overlap) -> str:
    """Return the number of samples that only one report has, as text."""
    sides = ((samples.only_first, "first"), (samples.only_second, "second"))
    return ", ".join(f"{counted(n, 'sample')} only in the {name}" for n, name in sides if n)


def _rank_clauses(rank: RankDifference) -> Iterator[str]:
    if rank.n_changed:
        yield f"{rank.n_changed} of {counted(rank.samples.common, 'simulated rank')}"
    if rank.n_reported_changed:
        yield f"{rank.n_reported_changed} of {counted(rank.samples.common, 'reported rank')}"
    if rank.samples.only_first or rank.samples.only_second:
        yield _alone(rank.samples)


def diff_metrics(diff: ReportDiff) -> dict[str, Any]:
    """Return verdict, differences and the fields of the record as plain JSON values."""
    return json_object(
        verdict=verdict(diff), differs=bool(diff.differences), differences=diff.differences, **fields_of(diff)
    )


# A SHA-256 digest or a fingerprint of a log.
_DIGEST = re.compile(r"\b([0-9a-f]{12})[0-9a-f.]{20,}")


def in_short(value: Any) -> str:
    """Return the text of a value, with digests and fingerprints shortened to 12 digits. ``--json`` prints all digits.

    Examples
    --------
    >>> in_short(["0123456789abcdef" * 4]), in_short(None), in_short(0.25)
    ("['0123456789ab…']", 'not there', '0.25')
    """
    text = _DIGEST.sub(r"\1…", "not there" if value is None else short(value))
    return cut(text, 300)


# Sentences about two reports, by the verdict of the paired interval. Only these contain "better" and "worse".
DIFFERENCE = {
    "better": "The second is significantly better: {difference:+.2f} dB {interval} (95 %).",
    "worse": "The second is significantly worse: {difference:+.2f} dB {interval} (95 %).",
    "not significant": "The difference of {difference:+.2f} dB {interval} is not significant (95 %).",
    "no interval": "The difference is {difference:+.2f} dB; too few independent samples for an interval.",
}

# Number of differences that the first sentence names if both RMSE are equal.
_NAMED = 2


def verdict(diff: ReportDiff) -> str:
    """Return the result in one or two sentences."""
    changed = {"setting": len(diff.settings), "input": len(diff.inputs), "version": len(diff.versions)}
    listed = ", ".join(counted(n, name) for name, n in changed.items() if n)
    also = f" Changed: {listed}." if listed else " Settings, inputs and versions are the same."
    if not diff.differences:
        return f"No difference: the numbers agree within {TOLERANCE_DB:g} dB.{also}"
    return _numbers(diff) + also


def _numbers(diff: ReportDiff) -> str:
    """Return a sentence about the RMSE over all links, or the first differences if both RMSE are equal."""
    scored, pooled = [level for level in diff.levels if level.rmse.n], diff.pooled
    if pooled is None or all(abs(item.rmse.difference_db) <= TOLERANCE_DB for item in scored):
        more = len(diff.differences) - _NAMED
        return "; ".join(diff.differences[:_NAMED]) + (f"; and {more} more." if more > 0 else ".")
    common, most = (count(sum(getattr(item.samples, name) for item in scored)) for name in ("common", "first"))
    low, high = pooled.difference_ci95_db
    interval = f"[{Printed(low):+.2f}, {Printed(high):+.2f}]" if math.isfinite(low) else ""
    return (
        f"RSS over {common} common samples of {most}: RMSE {pooled.other_rmse_db:.2f} dB in the first, "
        f"{pooled.rmse_db:.2f} dB in the second. "
        + DIFFERENCE[pooled.verdict].format(difference=Printed(pooled.difference_db), interval=interval)
    )
