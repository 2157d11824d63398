"""The files diff.html and diff.json, which describe the changes between two reports of one flight."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from markupsafe import Markup

from ..common.jsonable import fields_of, json_object
from ..common.text import counted
from ..common.units import Printed
from ..compare.statistics import PairedDifference
from ..compare.verdict import LevelDifference, Overlap, RankDifference
from .cards import HEAD, RIGHT, TEXT, Card, Page, Table, bold
from .flight_words import count
from .page import json_text, write_file
from .texts import cut, interval, minute, number, percent, short

# Differences up to this are ignored, because tables are rounded to four decimals, and offsets to one.
TOLERANCE_DB = 0.01


@dataclass(frozen=True, slots=True, kw_only=True)
class Entry:
    """A named value in two reports, None if a report does not have it."""

    key: str
    first: Any
    second: Any


@dataclass(frozen=True, slots=True, kw_only=True)
class InputEntry:
    """An input file that differs between the reports.

    ``what`` is "added", "removed" or "changed".
    """

    role: str
    path: str
    what: str


@dataclass(frozen=True, slots=True, kw_only=True)
class ReportSide:
    """One of the two reports: its folder, when it was made, and by which version."""

    folder: str
    flight: str
    generated: str
    version: str


@dataclass(frozen=True, slots=True, kw_only=True)
class ReportDiff:
    """Two reports and their differences. Every difference is second minus first.

    Parameters
    ----------
    settings, versions : tuple of Entry
        Values that differ.
    inputs : tuple of InputEntry
        Input files that differ.
    levels, ranks : tuple
        Differences on common samples.
    pooled : PairedDifference, optional
        Difference in RMSE over all links.
    links_first_only, links_second_only : tuple of str
        Links that only the first, or only the second, report has.
    remarks : tuple of str
        Limits of the comparison, and numbers that look wrong.
    """

    first: ReportSide
    second: ReportSide
    settings: tuple[Entry, ...]
    inputs: tuple[InputEntry, ...]
    versions: tuple[Entry, ...]
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


def diff_page(diff: ReportDiff) -> str:
    """Return the page."""
    first, second = diff.first, diff.second
    both = "" if second.flight == first.flight else f" and {second.flight}"
    made = [f"{side.folder}, made {minute(side.generated)} by {side.version}." for side in (first, second)]
    return Page(
        kind="diff", title=f"{first.flight}{both}: two reports", verdict=verdict(diff), cautions=diff.remarks,
        about=[f"First: {made[0]} Second: {made[1]} Every difference is second minus first."],
        cards=[numbers_card(diff), changes_card(diff)],
    ).html()  # fmt: skip


def numbers_card(diff: ReportDiff) -> Card:
    """Return the card of levels and ranks on the samples that both reports have."""
    title = f"Every difference beyond {TOLERANCE_DB} dB ({len(diff.differences)})"
    return Card(
        title="Numbers on common samples", id="numbers", link="Numbers", tables=[_levels(diff), _ranks(diff)],
        parts=[Card(title=title, fold=True, text=[diff.differences])] if diff.levels or diff.ranks else [],
    )  # fmt: skip


def _both(pair: Any, decimals: int) -> str:
    """Return the values of the first and of the second report in one cell."""
    return f"{number(pair.first, decimals)}, {number(pair.second, decimals)}"


def _alone_in_each(samples: Overlap) -> str:
    return f"{number(samples.only_first, 0)}, {number(samples.only_second, 0)}"


def _levels(diff: ReportDiff) -> Table:
    return Table(
        caption="RSS. RMSE on the samples that both reports score, each about its own best offset there; intervals are "
        "95 %, of the paired difference.",
        columns={"Link": HEAD, "Change of RMSE [dB]": RIGHT, "95 %": 3, "Second is": TEXT, "RMSE first, second": RIGHT,
                 "Offset first, second": RIGHT, "Replay moved: RMS, most": RIGHT, "Measured moved: most": 3,
                 "Scored first, second, both": RIGHT, "Samples in one report only": RIGHT},
        rows=[
            (f"{one.tower} {one.channel}", bold(number(one.rmse.difference_db, 3)), one.rmse.difference_ci95_db,
             one.rmse.verdict, f"{number(one.rmse.other_rmse_db, 3)}, {number(one.rmse.rmse_db, 3)}",
             _both(one.offset_db, 1), f"{number(one.simulated_rms_db, 3)}, {number(one.simulated_max_db, 3)}",
             one.measured_max_db, f"{_both(one.scored, 0)}, {number(one.scored.common, 0)}",
             _alone_in_each(one.samples))
            for one in diff.levels
        ],
        look="dense",
    )  # fmt: skip


def _ranks(diff: ReportDiff) -> Table:
    return Table(
        caption="Rank on the samples that both reports have. Agreement and kappa count only samples for which both "
        "reports have a measured and a simulated rank. The change of agreement is in percentage points.",
        columns={"Tower": HEAD, "K": RIGHT, "Simulated ranks changed": RIGHT, "Change of agreement, 95 %": RIGHT,
                 "Agreement first, second": RIGHT, "Change of kappa, 95 %": RIGHT, "Kappa first, second": RIGHT,
                 "Reported ranks changed": 0, "Samples in both": 0, "In one report only": RIGHT},
        rows=[
            (one.tower, one.k, bold(number(one.n_changed, 0)),
             f"{percent(one.agreement.difference, 1)} "
             f"{interval((100 * one.agreement.ci95[0], 100 * one.agreement.ci95[1]))}",
             f"{percent(one.agreement.first, 1)}, {percent(one.agreement.second, 1)}",
             f"{number(one.kappa.difference, 3)} {interval(one.kappa.ci95, 3)}", _both(one.kappa, 3),
             one.n_reported_changed, one.samples.common, _alone_in_each(one.samples))
            for one in diff.ranks
        ],
        look="dense",
    )  # fmt: skip


def changes_card(diff: ReportDiff) -> Card:
    """Return the card of settings, inputs and versions that differ."""
    same = {
        "The settings are the same.": diff.settings,
        "The inputs are the same files, byte by byte.": diff.inputs,
        "Code and packages have the same versions.": diff.versions,
    }
    inputs = Table(
        caption="Inputs.", columns={"File": HEAD, "Role": TEXT, "What": TEXT},
        rows=[(entry.path, entry.role, entry.what) for entry in diff.inputs],
    )  # fmt: skip
    settings = _entries("Settings as used (flight.yaml, defaults and command line together).", diff.settings)
    return Card(
        title="What changed", id="changes", link="What changed", text=[text for text, of in same.items() if not of],
        tables=[settings, inputs, _entries("Versions.", diff.versions)],
    )  # fmt: skip


# A SHA-256 digest or a fingerprint of a log.
_DIGEST = re.compile(r"\b([0-9a-f]{12})[0-9a-f.]{20,}")


def in_short(value: Any) -> str:
    """Return the text of a value. Digests and fingerprints are shortened to 12 digits.

    The file diff.json has all digits.

    Examples
    --------
    >>> in_short(["0123456789abcdef" * 4]), in_short(None), in_short(0.25)
    ("['0123456789ab…']", 'not there', '0.25')
    """
    text = _DIGEST.sub(r"\1…", "not there" if value is None else short(value))
    return cut(text, 300)


def _entries(caption: str, entries: Sequence[Entry]) -> Table:
    rows = [(Markup("<code>{}</code>").format(one.key), in_short(one.first), in_short(one.second)) for one in entries]
    return Table(caption=caption, columns={"Key": HEAD, "First": "entry", "Second": "entry"}, rows=rows)


def write_diff(diff: ReportDiff, folder: Path) -> list[Path]:
    """Write ``diff.html`` and ``diff.json``, and return the files, the page first."""
    numbers = json_text(diff_metrics(diff))
    return [write_file(folder / "diff.html", diff_page(diff)), write_file(folder / "diff.json", numbers)]


# Sentences about two reports, by the verdict of the paired interval. Only these contain "better" and "worse".
DIFFERENCE = {
    "better": "The second is significantly better: {difference:+.2f} dB {interval} (95 %).",
    "worse": "The second is significantly worse: {difference:+.2f} dB {interval} (95 %).",
    "not significant": "The difference of {difference:+.2f} dB {interval} is not significant (95 %).",
    "no interval": "The difference is {difference:+.2f} dB; too few independent samples for an interval.",
}

# Number of differences that the first sentence names if the RMSE are equal.
_NAMED = 2


def verdict(diff: ReportDiff) -> str:
    """Return the result in one or two sentences."""
    changed = {"setting": len(diff.settings), "input": len(diff.inputs), "version": len(diff.versions)}
    listed = ", ".join(counted(n, name) for name, n in changed.items() if n)
    also = f" Changed: {listed}." if listed else " Settings, inputs and versions are the same."
    if _site_alone(diff):
        also = " The site differs, and nothing else."
    if not diff.differences:
        return f"No difference: the numbers agree within {TOLERANCE_DB:g} dB.{also}"
    return _numbers(diff) + also


def _site_alone(diff: ReportDiff) -> bool:
    """Check whether only the site changed: its key in the flight file, the flight file itself, and the site file."""
    settings = [entry.key.split(".")[0] == "site" for entry in diff.settings]
    inputs = [entry.role.startswith("site file") for entry in diff.inputs]
    others = [entry for entry in diff.inputs if not entry.role.startswith(("site file", "flight file"))]
    return any(settings + inputs) and all(settings) and not others and not diff.versions


def _numbers(diff: ReportDiff) -> str:
    """Return a sentence about the RMSE over all links, or the first differences if the RMSE are equal."""
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
