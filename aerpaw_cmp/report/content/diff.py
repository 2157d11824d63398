"""Changes between two reports of one flight: finished numbers, and the sentences that say what they mean."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from ...common.counting import counted
from ...common.units import Printed
from ...compare.judge.report_difference import LevelDifference, Overlap, RankDifference
from ...compare.statistics.intervals import PairedDifference

# Differences up to this count as none: the tables hold four decimals, offsets one.
TOLERANCE_DB = 0.01


@dataclass(frozen=True, slots=True, kw_only=True)
class Entry:
    """A named value of either report; None where a report has no such entry."""

    key: str
    first: Any
    second: Any


@dataclass(frozen=True, slots=True, kw_only=True)
class InputEntry:
    """A file that either report was made from; ``what`` is added, removed or changed."""

    role: str
    path: str
    what: str


@dataclass(frozen=True, slots=True, kw_only=True)
class ReportSide:
    """One of the two reports: where it was found, when made, by which version."""

    folder: str
    flight: str
    generated: str
    version: str


@dataclass(frozen=True, slots=True, kw_only=True)
class ReportDiff:
    """Two reports, ``first`` and ``second``; every difference is second minus first.

    Parameters
    ----------
    settings, versions : tuple of Entry
        Those that differ.
    inputs : tuple of InputEntry
        Those that differ.
    levels, ranks : tuple
        On common samples.
    pooled : PairedDifference, optional
        RMSE over all links.
    links_first_only, links_second_only : tuple of str
        Links that one report alone has.
    remarks : tuple of str
        What the comparison could not do, and what looks wrong.
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
        """Every way in which numbers differ beyond the tolerance, one clause each; empty: they do not."""
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
    """Number of samples that are in one report alone, in words."""
    sides = ((samples.only_first, "first"), (samples.only_second, "second"))
    return ", ".join(f"{counted(n, 'sample')} only in the {name}" for n, name in sides if n)


def _rank_clauses(rank: RankDifference) -> Iterator[str]:
    if rank.n_changed:
        yield f"{rank.n_changed} of {counted(rank.samples.common, 'simulated rank')}"
    if rank.n_reported_changed:
        yield f"{rank.n_reported_changed} of {counted(rank.samples.common, 'reported rank')}"
    if rank.samples.only_first or rank.samples.only_second:
        yield _alone(rank.samples)
