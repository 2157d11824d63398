"""Sentences of a campaign's page, each with the condition under which it may stand."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...common.counting import counted
from ...compare.flight_verdict import pooled_db
from ...compare.judge.verdicts import Verdict, campaign_verdict
from ...compare.level.rss import LEARNED_HERE
from ..content.campaign import CampaignData, RssRow
from ..names import k_key
from .flight import first_sentence, pretty, ranking_sentence
from .flight_verdict import judge
from .phrases import said_of

# Warnings of flights that stand one by one.
FEW = 8

# Sentence and next step by :func:`~aerpaw_cmp.compare.judge.verdicts.campaign_verdict`.
CAUSES: dict[str, tuple[str, str]] = {
    "outlying error": (
        "Flight {where} stands out: its RMSE is {effect:.1f} times (95 %: {low:.1f} to {high:.1f}) that of the others.",
        "open the report of {where} and read its likely cause",
    ),
    "outlying offset": (
        "Flight {where} stands out: its offset differs by {effect:+.1f} dB (95 %: {low:+.1f} to {high:+.1f} dB).",
        "check transmit power, receiver gain and cables of {where}",
    ),
    "gain step": (
        "The offset steps by {effect:+.1f} dB (95 %: {low:+.1f} to {high:+.1f} dB) at {where} on.",
        "compare the flights before and after apart; check the gain of that receiver",
    ),
    "none": (
        "No flight and no link stands out. Largest error: {flight}, {error:.1f} dB ({link}).",
        "open the report of {flight}",
    ),
}

# Settings that a sentence names.
_FEW_SETTINGS = 4

# Below this share of samples with a pair, a repeatability floor is that of a few places.
_FEW_PAIRS = 0.25


def rss_flights(data: CampaignData) -> list[str]:
    """Flights that have RSS, and those that failed: a flight with rank alone has no RMSE to miss."""
    ranked = {row.flight for row in data.rank} - {row.flight for row in data.rss}
    return [name for name in data.flights if name not in ranked]


def mean_rmse(data: CampaignData) -> dict[str, dict[str, float]]:
    """Mean RMSE over the links of each setting and flight [dB]; NaN where there is none."""
    known: dict[tuple[str, str], list[float]] = {}
    for row in data.rss:
        if np.isfinite(row.rmse_db):
            known.setdefault((row.setting, row.flight), []).append(row.rmse_db)
    flights, nan = rss_flights(data), float("nan")
    return {
        setting: {name: float(np.mean(known[setting, name])) if (setting, name) in known else nan for name in flights}
        for setting in data.settings
    }


def headline(data: CampaignData) -> list[str]:
    """The result in a few sentences."""
    out = [*step_words(data), *_ranked_words(data)]
    for setting in data.settings:
        moved = [t for t in data.rank_transfers if t.setting == setting]
        if moved:
            out.append(
                f"Rank, {setting}: at the K that the other flights choose, the total variation is "
                + ", ".join(f"{t.total_variation:.3f} on {t.flight} (K = {k_key(t.k)})" for t in moved)
                + "."
            )
    if data.repeats:
        pairs = [p for p in data.repeats if p.n > 0]
        if pairs:
            mean = float(np.mean([p.rmse_db for p in pairs]))
            share = 100 * float(np.mean([p.share for p in pairs]))
            out.append(
                f"Two flights at the same places differ by {mean:.1f} dB RMS after one constant "
                f"({counted(sum(p.n for p in pairs), 'pair')}, {share:.0f} % of the samples)."
            )
        else:
            out.append("No two flights pass the same places within the radius, so there is no repeatability floor.")
    return out


def step_words(data: CampaignData) -> list[str]:
    """Steps of offsets that the last date shows, and how small ones it can show."""
    judged = [node for node in data.season.nodes if np.isfinite(node.smallest_db)]
    if not judged:
        return []
    last = max(node.night[-1] for node in judged)
    steps = [(node.node, step) for node in judged for step in node.steps if last == step.shown and not step.back]
    out = [
        f"On {last} the offset of {name} steps by {step.step_db:+.1f} dB "
        f"(95 %: {step.step_ci95_db[0]:+.1f} to {step.step_ci95_db[1]:+.1f} dB)."
        for name, step in steps
    ] or [f"No offset steps on {last}, the last date."]
    smallest = max(judged, key=lambda node: node.smallest_db)
    return [
        *out,
        f"A step of {smallest.smallest_db:.1f} dB shows on its first date with a probability of 90 % (the largest such "
        f"step, at {smallest.node}). About 1 date in 100 shows a false step.",
    ]


def _ranked_words(data: CampaignData) -> list[str]:
    """Sentences on what the ranking by held-out error shows, and what it does not."""
    ranking = data.season.over_all()
    if len(ranking) < 2 or not data.season.held_out:
        return []
    first = (
        f"With the offset of the other flights, {ranking[0].setting} has the smallest error "
        f"({ranking[0].mean_db:.2f} dB over {counted(ranking[0].n_flights, 'flight')}). "
    )
    return [first + ranking_sentence({entry.setting: entry.verdict for entry in ranking[1:]}, _FEW_SETTINGS)]


def warnings(data: CampaignData) -> list[str]:
    """Warnings that must be known before the numbers are believed."""
    out = [f"{f.flight} ({f.setting}): {f.message}" for f in data.failures[:FEW]]
    if len(data.failures) > FEW:
        out = [f"{len(data.failures)} flights or settings gave no numbers: they stand under Failures."]
    out += [
        f"{row.flight}, {row.setting}, {row.link}: its antennas were learned from this very log, so it is not scored."
        for row in data.rss
        if LEARNED_HERE in row.fitted
    ]
    out += [
        f"{row.flight}, {row.setting}, {row.link}: the best offset lies at the edge of the searched span."
        for row in data.rss
        if row.at_search_edge
    ]
    out += [
        f"{pair.tower} {pair.channel}: only {100 * pair.share:.0f} % of the samples of {pair.first} have a pair on "
        f"{pair.second}; their repeatability speaks for those places, not for the flights."
        for pair in data.repeats
        if 0 < pair.share < _FEW_PAIRS
    ]
    out += [
        f"Pooled offset {group.group}: its members are in different units ({', '.join(group.units)})."
        for group in data.pooled
        if len(group.units) > 1
    ]
    if data.synthetic:
        out.append("Synthetic flights, made by simulation, that measure nothing: " + ", ".join(data.synthetic) + ".")
    return list(dict.fromkeys(out))


def worst_flights(data: CampaignData) -> list[tuple[str, float, str]]:
    """Flights under the first-ranked setting, largest error first: name, mean error over links [dB], worst link."""
    order = data.season.over_all()
    return _by_error([row for row in data.rss if order and row.setting == order[0].setting], "held_out_rmse_db")


def _by_error(rows: Sequence[RssRow], name: str) -> list[tuple[str, float, str]]:
    by: dict[str, list[tuple[float, str]]] = {}
    for row in rows:
        error = getattr(row, name) if np.isfinite(getattr(row, name)) else row.rmse_db
        if np.isfinite(error):
            by.setdefault(row.flight, []).append((error, row.link))
    flights = [(name, float(np.mean([e for e, _ in of])), max(of)[1]) for name, of in by.items()]
    return sorted(flights, key=lambda entry: -entry[1])


def verdict(data: CampaignData) -> list[str]:
    """Ray tracing against the baselines under the first setting, and what each mean error is for."""
    rows = [row for row in data.rss if row.setting == next(iter(data.settings)) and np.isfinite(row.rmse_db) and row.n]
    if not rows:
        return []
    scored = [(row.rmse_db, row.n) for row in rows]
    known = {name: [row.baselines.get(name, np.nan) for row in rows] for row in rows for name in row.baselines}
    errors = {name: pooled_db(each, [row.n for row in rows]) for name, each in known.items() if np.isfinite(each).all()}
    out = [first_sentence(judge(scored, errors, [row.verdicts for row in rows], "flights x channels"))]
    held_out = [row.held_out_rmse_db for row in rows if np.isfinite(row.held_out_rmse_db)]
    mean_own = float(np.mean([row.rmse_db for row in rows]))
    if held_out:
        out.append(
            f"Mean RMSE: {mean_own:.1f} dB with each flight's own offset, {np.mean(held_out):.1f} dB with the offset "
            f"of the other flights. Expect {np.mean(held_out):.1f} dB on a new flight."
        )
    flight, error, link = _by_error(rows, "rmse_db")[0]
    return [*out, said_of(cause(data), CAUSES, flight=flight, error=error, link=link)]


def cause(data: CampaignData) -> Verdict:
    """The trouble of the season under the first setting."""
    rows = [row for row in data.reference_rows if np.isfinite(row.rmse_db) and row.n]
    errors: dict[str, list[float]] = {}
    offsets: dict[str, dict[str, float]] = {}
    for row in rows:
        errors.setdefault(row.flight, []).append(row.rmse_db)
        offsets.setdefault(row.link, {})[row.flight] = row.moments.mean_db
    order = sorted(data.flights, key=lambda name: data.season.started.get(name, ""))
    return campaign_verdict({name: float(np.mean(of)) for name, of in errors.items()}, offsets, order)


def against_baselines(row: RssRow) -> str:
    """Baselines that the ray tracing is significantly better and worse than, in one cell."""
    parts = [
        f"{word} than " + ", ".join(pretty(name) for name, decision in row.verdicts.items() if decision == word)
        for word in ("worse", "better")
        if word in row.verdicts.values()
    ]
    return "; ".join(parts) or ("not significant" if row.verdicts else "\u2013")
