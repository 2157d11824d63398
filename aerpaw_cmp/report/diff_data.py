"""What changed between two reports of one flight: finished numbers, and the sentences that say what they mean."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from ..compare.report_difference import Changed, LevelDifference, Overlap, RankDifference
from ..compare.statistics import PairedDifference
from .words import DIFFERENCE, count

LEAST_RANK = 1e-6
"""Differences of agreement and kappa below this are rounding."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Entry:
    """A named value of either report; None where a report has no such entry."""

    key: str
    first: Any
    second: Any


@dataclass(frozen=True, slots=True, kw_only=True)
class InputEntry:
    """A file that either report was made from: its digest and lines; ``what`` is added, removed or changed."""

    role: str
    path: str
    what: str
    first_sha256: str | None
    second_sha256: str | None
    first_lines: int | None
    second_lines: int | None


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
    stages : tuple of Entry
        Seconds of every stage.
    numbers : tuple of Entry
        Numbers of metrics.json, as reported, that differ by more than the tolerance.
    levels, ranks : tuple
        On common samples; empty where a side has no tables.
    pooled : PairedDifference, optional
        RMSE over all links.
    new_warnings, gone_warnings : tuple of str
    links_first_only, links_second_only : tuple of str
        Links that one report alone has.
    tolerance_db : float
        Differences of levels, offsets and errors up to it count as none.
    remarks : tuple of str
        What the comparison could not do, and what looks wrong.
    """

    first: ReportSide
    second: ReportSide
    settings: tuple[Entry, ...]
    inputs: tuple[InputEntry, ...]
    versions: tuple[Entry, ...]
    stages: tuple[Entry, ...]
    numbers: tuple[Entry, ...]
    levels: tuple[LevelDifference, ...]
    ranks: tuple[RankDifference, ...]
    pooled: PairedDifference | None
    new_warnings: tuple[str, ...]
    gone_warnings: tuple[str, ...]
    links_first_only: tuple[str, ...]
    links_second_only: tuple[str, ...]
    tolerance_db: float
    remarks: tuple[str, ...]

    @property
    def differences(self) -> tuple[str, ...]:
        """Every way in which numbers differ beyond the tolerance, one clause each; empty: they do not."""
        return tuple(_differences(self))


def _differences(diff: ReportDiff) -> Iterator[str]:
    for name, links in (("first", diff.links_first_only), ("second", diff.links_second_only)):
        if links:
            yield f"only the {name} report has {', '.join(links)}"
    for one in diff.levels:
        yield from (f"{one.tower} {one.channel}: {text}" for text in _level_clauses(one, diff.tolerance_db))
    for rank in diff.ranks:
        yield from (f"{rank.tower} K = {rank.k}: {text}" for text in _rank_clauses(rank))
    if not diff.levels and not diff.ranks and diff.numbers:
        yield f"{len(diff.numbers)} numbers of metrics.json"
    elif diff.numbers:
        yield f"{len(diff.numbers)} reported numbers, the first {diff.numbers[0].key}"


def _level_clauses(one: LevelDifference, tolerance_db: float) -> Iterator[str]:
    for what, value in (("measured", one.measured_max_db), ("replayed", one.simulated_max_db)):
        if value > tolerance_db:
            yield f"{what} level by up to {value:.3g} dB"
    if abs(one.offset_db.difference) > tolerance_db:
        yield f"offset by {one.offset_db.difference:+.3g} dB"
    if abs(one.rmse.difference_db) > tolerance_db:
        yield f"RMSE by {one.rmse.difference_db:+.3g} dB"
    if one.samples.only_first or one.samples.only_second:
        yield _alone(one.samples)
    elif one.scored.first != one.scored.second or one.scored.common != one.scored.first:
        yield f"{one.scored.first} scored samples against {one.scored.second}"


def _alone(samples: Overlap) -> str:
    """How many samples are in one report alone, and when."""
    sides = ((samples.only_first, samples.first_span, "first"), (samples.only_second, samples.second_span, "second"))
    sentences = [
        f"{n} samples only in the {name}" + (f" ({span[0]} to {span[1]})" if span else "")
        for n, span, name in sides
        if n
    ]
    return ", ".join(sentences)


def _rank_clauses(one: RankDifference) -> Iterator[str]:
    if one.n_changed:
        yield f"{one.n_changed} of {one.samples.common} simulated ranks"
    if one.n_reported_changed:
        yield f"{one.n_reported_changed} of {one.samples.common} reported ranks"
    if one.samples.only_first or one.samples.only_second:
        yield _alone(one.samples)


# --- words ----------------------------------------------------------------------------------------------------------


def verdict(diff: ReportDiff) -> str:
    """The result in one or two sentences."""
    common = sum(one.samples.common for one in diff.levels)
    ranked = max((one.samples.common for one in diff.ranks), default=0)
    if not diff.differences:
        seen = [f"{count(common)} RSS samples"] * bool(common) + [f"{count(ranked)} rank samples"] * bool(ranked)
        on = f" on {' and '.join(seen)}" if seen else " in metrics.json (no samples were compared)"
        return f"No difference: the numbers agree within {diff.tolerance_db:g} dB{on}.{_causes(diff)}"
    parts = [text for text in (_level_verdict(diff), _rank_verdict(diff)) if text]
    return " ".join(parts or ["The reported numbers differ."]) + _causes(diff)


def _causes(diff: ReportDiff) -> str:
    """What else differs, which may be the reason."""
    kinds = ((diff.settings, "setting"), (diff.inputs, "input"), (diff.versions, "version"))
    causes = [f"{len(items)} {name}{'' if len(items) == 1 else 's'}" for items, name in kinds if items]
    if not causes:
        return " Settings, inputs and versions are the same." if diff.differences else ""
    verb = "differs" if len(causes) == 1 and causes[0].startswith("1 ") else "differ"
    return f" {' and '.join(causes)} {verb}."


def _level_verdict(diff: ReportDiff) -> str:
    scored = [one for one in diff.levels if one.rmse.n]
    if not scored or diff.pooled is None:
        return ""
    if all(abs(one.rmse.difference_db) <= diff.tolerance_db for one in scored):
        moved = max((one.simulated_max_db for one in scored if math.isfinite(one.simulated_max_db)), default=0.0)
        though = f", though the replay moved by up to {moved:.2g} dB" if moved > diff.tolerance_db else ""
        return f"RSS errors agree on the common samples{though}."
    pooled = diff.pooled
    text = (
        f"RSS over all links: RMSE {pooled.other_rmse_db:.2f} dB in the first, {pooled.rmse_db:.2f} dB in the second. "
    )
    text += DIFFERENCE[pooled.verdict].format(
        difference=pooled.difference_db, interval=_bounds(pooled.difference_ci95_db, 2)
    )
    if len(scored) > 1:
        verdicts = [(word, sum(one.rmse.verdict == word for one in scored)) for word in ("better", "worse")]
        rest = len(scored) - sum(n for _, n in verdicts)
        text += f" Links: {verdicts[0][1]} better, {verdicts[1][1]} worse, {rest} not significant."
    return text


def _bounds(value: tuple[float, float], decimals: int) -> str:
    low, high = value
    return f"[{low:+.{decimals}f}, {high:+.{decimals}f}]" if math.isfinite(low) else ""


def _rank_verdict(diff: ReportDiff) -> str:
    moved = [one for one in diff.ranks if one.n_changed or abs(one.kappa.difference) > LEAST_RANK]
    if not diff.ranks:
        return ""
    if not moved:
        return "Simulated ranks agree on the common samples."
    most = max(moved, key=lambda one: abs(one.agreement.difference) if math.isfinite(one.agreement.difference) else -1)
    return (
        f"Rank at {most.tower}, K = {most.k}: {count(most.n_changed)} of {count(most.samples.common)} simulated ranks "
        f"differ, agreement {_arrow(most.agreement)}, kappa {_arrow(most.kappa)}."
    )


def _arrow(value: Changed) -> str:
    if not math.isfinite(value.difference):
        return "not known"
    bounds = _bounds(value.ci95, 3)
    return f"{value.first:.3f} to {value.second:.3f}" + (f" (change {bounds})" if bounds else "")
