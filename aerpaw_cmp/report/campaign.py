"""Records of many flights and settings, and the files campaign.html, campaign.json and campaign.csv."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pandas as pd
from markupsafe import Markup

from ..common.grouping import lists_by_key
from ..common.jsonable import fields_of, json_safe
from ..common.text import counted, guarded
from ..common.units import FloatArray
from ..compare.level import LEARNED_HERE
from ..compare.offset import Moments, difference_moments
from ..compare.statistics import Interval, PassPair
from ..compare.verdict import NodeOffset, Verdict, campaign_verdict, pooled_db
from ..site.site import Site
from .canvas import mark
from .cards import HEAD, RIGHT, SHARE, TEXT, Card, Page, Positions, Table, bold, estimate, settings_card
from .charts import Chart
from .flight_words import RANK_WORDS, first_sentence, pretty, ranking_sentence, sentence_of, signed
from .page import Made, about, json_text, write_file
from .places import RESIDUAL, Places, payload
from .texts import k_key, minute, more, number


@dataclass(frozen=True, slots=True, kw_only=True)
class RssRow:
    """The RSS of one flight, setting, tower and channel.

    ``offset_db`` and ``rmse_db`` are fitted to the samples of this row. ``held_out_offset_db`` is fitted to the other
    flights with the same setting, tower and channel, and ``held_out_rmse_db`` is the RMSE with that offset. Both are
    NaN if there is no other flight.

    ``baselines`` contains the RMSE of each baseline by name [dB], after an offset is fitted to each. ``span_db`` is the
    search range of the offset. Arrays (n,) have one value per sample, NaN if measurement or simulation is missing. Only
    rows of the first setting have these arrays; other rows have ``difference`` instead.

    Parameters
    ----------
    start_ns : int
        First time [ns since 1970-01-01].
    logs : tuple of str
        SHA-256 of the logs that contain the samples.
    verdicts : mapping of str to str
        Verdict of the paired interval for each baseline.
    """

    flight: str
    setting: str
    tower: str
    channel: str
    unit: str
    offset_db: float
    rmse_db: float
    correlation: float
    n: int
    n_out_of_coverage: int
    at_search_edge: bool
    rmse_ci95_db: Interval | None
    offset_ci95_db: Interval | None
    correlation_ci95: Interval | None
    n_effective: float
    lag_s: float
    lag_verdict: str
    fitted: tuple[str, ...]
    baselines: Mapping[str, float]
    span_db: tuple[float, float]
    measured_db: FloatArray = field(repr=False)
    simulated_dbm: FloatArray = field(repr=False)
    position_m: FloatArray = field(repr=False)
    heading_deg: FloatArray | None = field(repr=False, default=None)
    start_ns: int = 0
    difference: Moments | None = None
    held_out_offset_db: float = float("nan")
    held_out_rmse_db: float = float("nan")
    logs: tuple[str, ...] = ()
    mark: str = field(repr=False, default="")
    verdicts: Mapping[str, str] = field(default_factory=dict)

    @property
    def moments(self) -> Moments:
        """The moments of simulated minus measured level over the scored samples."""
        return self.difference or difference_moments(self.measured_db, self.simulated_dbm)

    @property
    def error_db(self) -> float:
        """The error by which flights and settings are sorted [dB]: held out, or ``rmse_db`` without other flights."""
        return self.held_out_rmse_db if np.isfinite(self.held_out_rmse_db) else self.rmse_db

    @property
    def link(self) -> str:
        """The tower and channel as one label."""
        return f"{self.tower} {self.channel}".strip()

    @property
    def residual_db(self) -> FloatArray:
        """The measured level plus the offset of this row, minus the simulated level (n,) [dB]."""
        return self.measured_db + self.offset_db - self.simulated_dbm


@dataclass(frozen=True, slots=True, kw_only=True)
class RankRow:
    """The rank of one flight, setting, tower and K.

    Parameters
    ----------
    commonest_agreement : float
        Agreement if the most frequent rank is always predicted, as a baseline.
    logs : tuple of str
        SHA-256 of the logs that contain the reports.
    """

    flight: str
    setting: str
    tower: str
    k: float
    n: int
    n_out_of_coverage: int
    agreement: float
    agreement_ci95: Interval | None
    kappa: float
    total_variation: float
    total_variation_ci95: Interval | None
    wasserstein: float
    best_k: float
    best_k_ci95: Interval | None
    commonest_agreement: float = float("nan")
    logs: tuple[str, ...] = ()
    mark: str = field(repr=False, default="")


@dataclass(frozen=True, slots=True, kw_only=True)
class Failure:
    """A flight and setting without numbers, and the reason. ``traceback`` is for developers and not on the page."""

    flight: str
    setting: str
    message: str
    traceback: str = field(repr=False, default="")


@dataclass(frozen=True, slots=True, kw_only=True)
class RankTransfer:
    """The total variation of one flight with the K that other flights select.

    Of the K in the flight files, ``k`` has the smallest mean total variation on the flights ``chosen_on``, and
    ``own_k`` the smallest on this flight.
    """

    setting: str
    flight: str
    tower: str
    chosen_on: tuple[str, ...]
    k: float
    total_variation: float
    kappa: float
    own_k: float
    own_total_variation: float


@dataclass(frozen=True, slots=True, kw_only=True)
class SettingRank:
    """One setting, compared with the setting that has the smallest mean error over flights.

    Parameters
    ----------
    setting : str
    n_flights : int
        Number of flights with an error under this setting.
    mean_db : float
        Mean over flights of the mean error over towers and channels [dB]. Errors are held out if there are several
        flights.
    quantiles_db : tuple of float
        Quantiles of 10, 50 and 90 % over flights.
    difference_db, difference_ci95_db : float, Interval or None
        Mean over flights of the difference of two errors on the same links, this setting minus the first setting, and
        its interval. The interval is None for the first setting.
    n_paired : int
        Number of flights in that difference.
    verdict : str
        "first", "worse", "not significant" or "no interval".
    """

    setting: str
    n_flights: int
    mean_db: float
    quantiles_db: tuple[float, ...]
    difference_db: float
    difference_ci95_db: Interval | None
    n_paired: int
    verdict: str


@dataclass(frozen=True, slots=True, kw_only=True)
class CampaignSummary:
    """The result of all flights together.

    Parameters
    ----------
    held_out : bool
        True if the errors are held out. The errors of a single flight are not.
    started : mapping of str to str
        First time of each flight (UTC, ISO 8601); missing for logs with relative times.
    ranking : tuple of SettingRank
        Settings over all towers and channels, sorted by mean error.
    nodes : tuple of NodeOffset
        Offsets of nodes under the first setting, or from soundings between towers.
    places_db : mapping of (int, int) to float
        Mean residual of the first setting over flights, towers and channels [dB]. The keys are column and row of a
        horizontal cell, counted from the origin of the site.
    reports : mapping of str to str
        Path of the report of each flight, relative to the folder of the campaign.
    """

    held_out: bool = False
    started: Mapping[str, str] = field(default_factory=dict)
    ranking: tuple[SettingRank, ...] = ()
    nodes: tuple[NodeOffset, ...] = ()
    places_db: Mapping[tuple[int, int], float] = field(default_factory=dict)
    reports: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True)
class CampaignData(Made):
    """The content of the page. ``settings`` contains the changes of each setting by its label.

    Two samples have the same position if they are within ``radius_m`` and their headings agree within
    ``heading_within_deg``. Residuals are averaged in cells of ``cell_m``.
    """

    radius_m: ClassVar[float] = 3.0
    heading_within_deg: ClassVar[float] = 20.0
    cell_m: ClassVar[float] = 20.0

    name: str
    title: str
    flights: tuple[str, ...]
    settings: Mapping[str, Mapping[str, Any]]
    rss: tuple[RssRow, ...] = ()
    rank: tuple[RankRow, ...] = ()
    failures: tuple[Failure, ...] = ()
    repeats: tuple[PassPair, ...] = ()
    rank_transfers: tuple[RankTransfer, ...] = ()
    site: Site | None = None
    synthetic: tuple[str, ...] = ()
    workers: int = 1
    season: CampaignSummary = CampaignSummary()

    @property
    def reference(self) -> str:
        """The first setting, which is used for repeatability, steps and the map of residuals."""
        return next(iter(self.settings), "")

    @property
    def reference_rows(self) -> tuple[RssRow, ...]:
        """The RSS rows of the first setting."""
        return tuple(row for row in self.rss if row.setting == self.reference)

    @property
    def scored_rows(self) -> list[RssRow]:
        """The RSS rows of the first setting with an error."""
        return [row for row in self.reference_rows if np.isfinite(row.rmse_db) and row.n]


# Largest number of flights whose warnings are listed one by one.
FEW = 8

# Sentence and next step, by the cause of :func:`~aerpaw_cmp.compare.verdict.campaign_verdict`.
CAUSES: dict[str, tuple[str, str]] = {
    "outlying error": (
        "Flight {where} stands out: its RMSE is {effect:.1f} times (95 %: {low:.1f} to {high:.1f}) that of the others.",
        "`aerpaw-cmp report FLIGHT` with {where}",
    ),
    "outlying offset": (
        "Flight {where} stands out: its offset differs by {effect:+.1f} dB (95 %: {low:+.1f} to {high:+.1f} dB).",
        "check transmit power, receiver gain and cables of {where}",
    ),
    "gain step": (
        "The offset steps by {effect:+.1f} dB (95 %: {low:+.1f} to {high:+.1f} dB) at {where} and later.",
        "compare the flights before and after it separately; check the gain of that receiver",
    ),
    "none": (
        "No flight or link stands out. Largest error: {flight}, {error:.1f} dB ({link}).",
        "`aerpaw-cmp report FLIGHT` with {flight}",
    ),
}

# Largest number of settings in a sentence.
_FEW_SETTINGS = 4

# Below this share of samples with a pair, the repeatability is valid only for a few positions.
_FEW_PAIRS = 0.25


def mean_rmse(data: CampaignData) -> dict[str, dict[str, float]]:
    """Return the mean RMSE over the links of each setting and flight [dB], NaN for failed flights."""
    errors = lists_by_key(((row.setting, row.flight), row.rmse_db) for row in data.rss)
    means = {key: float(np.nanmean(each)) for key, each in errors.items() if np.isfinite(each).any()}
    only_rank = {row.flight for row in data.rank} - {row.flight for row in data.rss}
    flights = [name for name in data.flights if name not in only_rank]
    return {setting: {name: means.get((setting, name), np.nan) for name in flights} for setting in data.settings}


def headline(data: CampaignData) -> list[str]:
    """Return the result in a few sentences."""
    out = [*step_words(data), *_ranked_words(data)]
    if pairs := [p for p in data.repeats if p.n > 0]:
        mean, share = np.mean([p.rmse_db for p in pairs]), 100 * np.mean([p.share for p in pairs])
        out.append(
            f"Two flights at the same positions differ by {mean:.1f} dB RMS after one constant "
            f"({counted(sum(p.n for p in pairs), 'pair')}, {share:.0f} % of the samples)."
        )
    elif data.repeats:
        out.append(
            f"No two flights visit the same positions within {number(data.radius_m, 0, 'm')} at similar headings, so "
            "repeatability is not known."
        )
    return out


def step_words(data: CampaignData) -> list[str]:
    """Return a sentence per step of an offset, the latest first, and one about the smallest detectable step."""
    judged = [node for node in data.season.nodes if np.isfinite(node.smallest_db)]
    if not judged:
        return []
    last = max(node.night[-1] for node in judged)
    steps = sorted(((step.night, node.node, step) for node in judged for step in node.steps), key=lambda s: s[:2])
    out = [
        f"On {minute(night)} the offset of {name} steps by {signed(step.step_db)} dB "
        f"(95 %: {signed(step.step_ci95_db[0])} to {signed(step.step_ci95_db[1])} dB)"
        + (f" and is back on {minute(step.back)}." if step.back else ".")
        for night, name, step in reversed(steps)
    ]
    if not any(step.shown == last for _, _, step in steps):
        out.append(f"No offset steps on {minute(last)}, the last date.")
    smallest = max(judged, key=lambda node: node.smallest_db)
    return [
        *out,
        f"A step of {smallest.smallest_db:.1f} dB is detected on its first date with a probability of 90 % (the "
        f"largest such step, at {smallest.node}). About 1 date in 100 shows a false step.",
    ]


def _ranked_words(data: CampaignData) -> list[str]:
    """Return sentences about the ranking by held-out error."""
    ranking = data.season.ranking
    if len(ranking) < 2 or not data.season.held_out:
        return []
    first = (
        f"With the offset of the other flights, {ranking[0].setting} has the smallest error "
        f"({ranking[0].mean_db:.1f} dB over {counted(ranking[0].n_flights, 'flight')}). "
    )
    return [first + ranking_sentence({entry.setting: entry.verdict for entry in ranking[1:]}, _FEW_SETTINGS)]


def warnings(data: CampaignData) -> list[str]:
    """Return warnings about the limits of the numbers."""
    out = [f"{f.flight} ({f.setting}): {f.message}" for f in data.failures[:FEW]]
    if len(data.failures) > FEW:
        out = [f"{len(data.failures)} flights or settings have no numbers; see Failures."]
    trained = (row for row in data.rss if LEARNED_HERE in row.fitted)
    learned = lists_by_key((f"{row.flight}, {row.setting}", row.link) for row in trained)
    out += [
        f"{name}: its antennas were learned from this log, so it is not scored ({', '.join(links)})."
        for name, links in learned.items()
    ]
    out += edge_warnings(data)
    out += [
        f"{pair.tower} {pair.channel}: only {100 * pair.share:.0f} % of the samples of {pair.first} have a pair on "
        f"{pair.second}; their repeatability is valid for these positions only."
        for pair in data.repeats
        if 0 < pair.share < _FEW_PAIRS
    ]
    if data.synthetic:
        out.append("Simulated flights, which are not measurements: " + ", ".join(data.synthetic) + ".")
    return list(dict.fromkeys(out))


def edge_warnings(data: CampaignData) -> list[str]:
    """Return one warning per row whose best offset is at the end of its search range. Each counts as a failed check."""
    return [
        f"{row.flight}, {row.setting}, {row.link}: the best offset is at the end of its search range."
        for row in data.rss
        if row.at_search_edge
    ]


def by_error(rows: Iterable[RssRow]) -> list[tuple[str, float, str]]:
    """Return name, mean :attr:`RssRow.error_db` over links [dB] and worst link of each flight, largest error first."""
    by = lists_by_key((row.flight, (row.error_db, row.link)) for row in rows if np.isfinite(row.error_db))
    flights = [(name, float(np.mean([e for e, _ in of])), max(of)[1]) for name, of in by.items()]
    return sorted(flights, key=lambda entry: -entry[1])


def verdict(data: CampaignData) -> list[str]:
    """Return sentences about ray tracing and the baselines under the first setting."""
    if not (rows := data.scored_rows):
        learned = any(LEARNED_HERE in row.fitted for row in data.reference_rows)
        none = f"“{data.reference}” has no error to report: its antennas were learned from these flights. Next: "
        return [f"{none}`aerpaw-cmp calibrate FLIGHT FLIGHT` holds out each flight in turn."] if learned else []
    scored = [(row.rmse_db, row.n) for row in rows]
    known = {name: [row.baselines.get(name, np.nan) for row in rows] for row in rows for name in row.baselines}
    errors = {name: pooled_db(each, [row.n for row in rows]) for name, each in known.items() if np.isfinite(each).all()}
    out = [first_sentence(scored, errors, [row.verdicts for row in rows])]
    held_out = [row.held_out_rmse_db for row in rows if np.isfinite(row.held_out_rmse_db)]
    mean_own = float(np.mean([row.rmse_db for row in rows]))
    if held_out:
        out.append(
            f"Mean RMSE: {mean_own:.1f} dB with each flight's own offset, {np.mean(held_out):.1f} dB with the offset "
            f"of the other flights. Expect {np.mean(held_out):.1f} dB on a new flight."
        )
    flight, error, link = by_error(rows)[0]
    return [*out, sentence_of(cause(data), CAUSES, flight=flight, error=error, link=link)]


def cause(data: CampaignData) -> Verdict:
    """Return the likely cause of errors of the campaign under the first setting."""
    errors: dict[str, list[float]] = {}
    offsets: dict[str, dict[str, float]] = {}
    for row in data.scored_rows:
        errors.setdefault(row.flight, []).append(row.rmse_db)
        offsets.setdefault(row.link, {})[row.flight] = row.moments.mean_db
    order = sorted(data.flights, key=lambda name: data.season.started.get(name, ""))
    return campaign_verdict({name: float(np.mean(of)) for name, of in errors.items()}, offsets, order)


def against_baselines(row: RssRow) -> str:
    """Return the text of a cell that lists baselines from which ray tracing differs significantly."""
    parts = [
        f"{word} than " + ", ".join(pretty(name) for name, decision in row.verdicts.items() if decision == word)
        for word in ("worse", "better")
        if word in row.verdicts.values()
    ]
    return "; ".join(parts) or ("not significant" if row.verdicts else "\u2013")


# Largest number of nodes in the chart. Nodes with steps are shown first, then those that vary most.
_NODES_SHOWN = 12


def charts_of(data: CampaignData) -> list[Chart]:
    """Return the chart of the offsets of nodes over the dates, if a node has more than one date."""
    nodes = data.season.nodes
    if not any(len(node.night) > 1 for node in nodes):
        return []
    dates = sorted({night for node in nodes for night in node.night})
    number = {night: float(i) for i, night in enumerate(dates)}
    shown = sorted(nodes, key=lambda node: (not node.steps, -np.ptp(node.offset_db or (0.0,))))[:_NODES_SHOWN]
    marks = [
        mark("line", node.node, np.array([number[night] for night in node.night]), np.array(node.offset_db))
        for node in shown
    ]
    for name, step, level in ((n.node, s, n.offset_db[n.night.index(s.shown)]) for n in shown for s in n.steps):
        ends = level + np.array(step.step_ci95_db) - step.step_db
        marks.append(mark("line", f"step of {name}", np.full(2, number[step.shown]), ends))
    return [Chart(
        section="season", title="Offsets over the campaign",
        caption="Offset of each node over the dates, minus the part that all nodes share (weather, a transmitter). "
        f"Vertical lines: 95 % intervals of steps. At most {_NODES_SHOWN} nodes are shown: nodes with steps, then "
        "those that vary most.",
        content={"x": {"label": "Date", "names": [minute(date).removesuffix(" UTC") for date in dates]},
                 "y": {"label": "Offset against its median [dB]"}, "marks": marks},
    )]  # fmt: skip


def _places(data: CampaignData) -> list[Places]:
    """Return the map of mean residuals per horizontal cell, over flights, towers and channels."""
    residuals, name = data.season.places_db, f"all flights, {data.reference}"
    if not residuals:
        return []
    at = np.pad((np.array(list(residuals)) + 0.5) * data.cell_m, ((0, 0), (0, 1)))
    values = {f"{RESIDUAL} [dB]": list(residuals.values())}
    return [Places(name=name, at=at, values=values, cell_m=data.cell_m)]


# Largest number of warnings on the page.
MANY = 200

# Largest number of flights in a table that has one column or heading per flight.
_FEW_FLIGHTS = 20

# Rows of a table on the page. The files in the same folder contain all rows.
ROWS_SHOWN = 300

# With more rows than this, campaign.json is written without indentation.
_COMPACT_ROWS = 2000

# Fields of a row that contain samples.
ARRAYS = ("measured_db", "simulated_dbm", "position_m", "heading_deg")


def _entries(items: Iterable[Any], without: Sequence[str]) -> list[dict[str, Any]]:
    return [{f.name: getattr(x, f.name) for f in dataclasses.fields(x) if f.name not in without} for x in items]


def campaign_metrics(data: CampaignData) -> dict[str, Any]:
    """Return the numbers of campaign.json. A missing number is null in the file."""
    failed = {f.flight for f in data.failures}
    result = {
        "campaign": data.name,
        "title": data.title, "settings": data.settings, "reference": data.reference, "rank": data.rank,
        "rank_transfers": data.rank_transfers, "workers": data.workers,
        "flights": [
            {"flight": name, "ok": name not in failed, "synthetic": name in data.synthetic} for name in data.flights
        ],
        "failures": _entries(data.failures, ("traceback",)),
        "mean_rmse_db": mean_rmse(data),
        "likely_cause": fields_of(cause(data)),
        "rss": _entries(data.rss, (*ARRAYS, "difference")),
        "repeatability": {
            "radius_m": data.radius_m, "heading_within_deg": data.heading_within_deg, "cell_m": data.cell_m,
            "table": _PAIR_TABLE if data.repeats else None,
        },
        "season": {
            "held_out": data.season.held_out, "started": data.season.started, "ranking": data.season.ranking,
            "nodes": data.season.nodes,
            "steps": step_words(data),
            "cells": len(data.season.places_db),
        },
        **about(data),
    }  # fmt: skip
    safe: dict[str, Any] = json_safe(result)
    return safe


def _campaign_frame(data: CampaignData) -> pd.DataFrame:
    """Return a table with one row per flight, setting, tower and channel or K, and per failure."""
    rows = [
        {"kind": "rss", **cells(row), **{f"{name}_rmse_db": error for name, error in row.baselines.items()},
         "fitted": " ".join(row.fitted)}
        for row in data.rss
    ]  # fmt: skip
    rows += [{"kind": "rank", **cells(row)} for row in data.rank]
    rows += [{"kind": "failed", **cells(failure)} for failure in data.failures]
    frame: pd.DataFrame = pd.DataFrame(rows, columns=_CSV_COLUMNS)
    return frame


_CSV_COLUMNS = [
    "kind", "flight", "setting", "tower", "channel", "k", "offset_db", "offset_low_db", "offset_high_db", "rmse_db",
    "rmse_low_db", "rmse_high_db", "free_space_rmse_db", "two_ray_rmse_db", "n",
    "n_out_of_coverage", "held_out_offset_db", "held_out_rmse_db", "correlation", "correlation_low", "correlation_high",
    "at_search_edge", "lag_s", "lag_verdict",
    "fitted", "total_variation", "total_variation_low", "total_variation_high", "agreement", "agreement_low",
    "agreement_high", "kappa", "wasserstein", "best_k", "message",
]  # fmt: skip


# --- cards ----------------------------------------------------------------------------------------------------------


def result_card(data: CampaignData) -> Card:
    """Return the card of the result: settings by error, flights by error, and rank."""
    tables = [_ranking(data), _flights(data), _transfers(data)]
    return Card(title="Result", id="result", link="Result", text=headline(data), tables=tables)


def _offset_words(data: CampaignData) -> str:
    return "the offset of the other flights" if data.season.held_out else "its own offset"


def _ranking(data: CampaignData) -> Table:
    return Table(
        caption=f"Settings by their mean error over flights. Each flight is scored with {_offset_words(data)}.",
        columns={"Rank": 0, "Setting": HEAD, "Flights": 0, "Mean error [dB]": RIGHT, "Median [dB]": 1,
                 "10 % to 90 % [dB]": RIGHT, "Difference from the best setting [dB]": 2, "95 %": 2,
                 "Against the best": TEXT},
        rows=[
            (place, r.setting, r.n_flights, bold(number(r.mean_db)), r.quantiles_db[1],
             f"{number(r.quantiles_db[0])} to {number(r.quantiles_db[2])}", r.difference_db,
             r.difference_ci95_db or "", r.verdict)
            for place, r in enumerate(data.season.ranking, 1)
        ],
        notes=["The difference from the best setting is computed on the same flights, towers and channels. Its 95 % "
               "interval is computed over the flights. The best setting was selected on these flights, so expect a "
               "larger error on other flights."],
    )  # fmt: skip


def _flights(data: CampaignData) -> Table:
    """Return the flights, sorted by their error under the best setting, with their errors under the next settings."""
    season, link = data.season, Markup('<a href="{}">{}</a>')
    settings = [r.setting for r in season.ranking[:_FEW_SETTINGS]]
    by = {name: by_error(row for row in data.rss if row.setting == name) for name in settings}
    errors = {name: {flight: error for flight, error, _ in flights} for name, flights in by.items()}
    worst = by[settings[0]] if settings else []
    few = f", the {_FEW_FLIGHTS} largest of {len(worst)}" if len(worst) > _FEW_FLIGHTS else ""
    return Table(
        caption="Flights by their error [dB], the mean over towers and channels. Each flight is scored with "
        f"{_offset_words(data)}{few}.",
        columns={"Flight": HEAD, "Start": "when", **dict.fromkeys(settings, 1), "Worst link": TEXT},
        rows=[
            (link.format(season.reports[flight], flight) if flight in season.reports else flight,
             minute(season.started.get(flight, "")), *(errors[name].get(flight) for name in settings), at)
            for flight, _, at in worst[:_FEW_FLIGHTS]
        ],
    )  # fmt: skip


def _transfers(data: CampaignData) -> Table:
    return Table(
        caption="Rank with a K that was selected on the other flights, and with the best K of the flight itself"
        f"{more(data.rank_transfers, ROWS_SHOWN)}.",
        columns={"Setting": TEXT, "Flight": HEAD, "Tower": TEXT, "Other flights": TEXT, "K of the other flights": RIGHT,
                 "Total variation": RIGHT, "Kappa": 2, "Own K": RIGHT, "Total variation, own K": 3},
        rows=[(t.setting, t.flight, t.tower, ", ".join(t.chosen_on), k_key(t.k), bold(number(t.total_variation, 3)),
               t.kappa, k_key(t.own_k), t.own_total_variation) for t in data.rank_transfers[:ROWS_SHOWN]],
    )  # fmt: skip


def season_card(data: CampaignData) -> Card:
    """Return the card of the campaign over time: offsets of nodes over the dates, and their steps."""
    table = Table(
        caption="Offsets of each node.",
        columns={"Node": HEAD, "Dates": 0, "Std. dev. [dB]": 1, "Detectable step [dB]": 1, "Steps": 0},
        rows=[(n.node, len(n.night), n.sd_db, n.smallest_db, len(n.steps)) for n in data.season.nodes],
        notes=["A detectable step is found on its first date with a probability of 90 %. campaign.json contains the "
               "offsets of all dates."],
    )  # fmt: skip
    return Card(title="Over the campaign", id="season", link="Over time", chart="season", parts=[Card(tables=[table])])


def failures_card(data: CampaignData) -> Card:
    """Return the card of flights and settings without numbers."""
    table = Table(
        caption=f"Flights and settings without numbers{more(data.failures, ROWS_SHOWN)}.",
        columns={"Flight": HEAD, "Setting": TEXT, "Why": TEXT},
        look="tall",
        rows=[(f.flight, f.setting, f.message) for f in data.failures[:ROWS_SHOWN]],
    )
    return Card(title="Failures", id="failures", link="Failures", tables=[table])


def repeats_card(data: CampaignData) -> Card:
    """Return the card of pairs of flights at the same positions."""
    rmse = {(row.flight, row.tower, row.channel): row.rmse_db for row in data.reference_rows}

    def errors(pair: PassPair) -> str:
        return ", ".join(number(rmse.get((name, pair.tower, pair.channel))) for name in (pair.first, pair.second))

    pairs = Table(
        caption=f"Differences of two flights at the same positions{more(data.repeats, ROWS_SHOWN)}.",
        columns={"Link": HEAD, "Flights": TEXT, "Pairs": 0, "Share": SHARE, "Levels differ by [dB]": RIGHT, "95 %": 1,
                 "Error of one flight [dB]": 1, "Residuals differ by [dB]": 1, "RMSE of both [dB]": RIGHT,
                 "Cell means differ by [dB]": 1, "Correlation of cell means": 2, "Cells": 0,
                 "Height difference": RIGHT},
        rows=[
            (f"{r.tower} {r.channel}", f"{r.first}, {r.second}", r.n, r.share, bold(number(r.rmse_db)),
             r.rmse_ci95_db, r.single_db, r.residual_rmse_db, errors(r), r.place_rmse_db,
             r.place_correlation, r.cells, number(r.height_difference_m, 0, "m"))
            for r in data.repeats[:ROWS_SHOWN]
        ],
        notes=[f"Two samples are a pair if they are within {number(data.radius_m, 0, 'm')} and their headings agree "
               f"within {number(data.heading_within_deg, 0)}°. The error of one flight is the difference of the levels "
               f"divided by √2. RMSE and residuals are those of the setting “{data.reference}”. Cell means are mean "
               f"residuals in cells of {number(data.cell_m, 0, 'm')} over all heights. If their correlation is near 1, "
               "the model has the same errors on both flights."],
    )  # fmt: skip
    return Card(title="Repeatability", id="repeats", link="Repeatability", fold=True, tables=[pairs])


def rows_card(data: CampaignData) -> Card:
    """Return the card of all numbers, with a row per flight, setting and link, or K."""
    return Card(title="All numbers", id="rows", link="All numbers", fold=True, tables=[_levels(data), _ranks(data)])


def _levels(data: CampaignData) -> Table:
    rows: Sequence[RssRow] = data.rss
    few = ""
    if len(rows) > ROWS_SHOWN:
        few = f"; the {ROWS_SHOWN} rows of largest error of {len(rows)}; campaign.csv contains all"
        rows = sorted(rows, key=lambda r: -np.nan_to_num(r.rmse_db, nan=-1.0))[:ROWS_SHOWN]
    models = list(dict.fromkeys(name for row in data.rss for name in row.baselines))
    return Table(
        caption="Levels. Offset and RMSE are fitted to the samples of the row. Each baseline has its own offset"
        f"{few}.",
        columns={"Flight": HEAD, "Setting": TEXT, "Link": TEXT, "Offset [dB]": RIGHT, "RMSE [dB]": RIGHT, "95 %": 1,
                 "Held-out RMSE [dB]": 1, **{f"{pretty(name)} [dB]": 1 for name in models},
                 "Against baselines (95 %)": TEXT, "Correlation": 2, "Samples": 0,
                 "Out of coverage": 0, "Clock": TEXT, "Fitted here": TEXT},
        rows=[
            (r.flight, r.setting, r.link, number(r.offset_db) + (" (edge)" if r.at_search_edge else ""),
             bold(number(r.rmse_db)), r.rmse_ci95_db or "", r.held_out_rmse_db,
             *(r.baselines.get(name) for name in models), against_baselines(r), r.correlation, r.n,
             r.n_out_of_coverage, _clock(r),
             ", ".join(r.fitted))
            for r in rows
        ],
        look="dense",
    )  # fmt: skip


def _clock(r: RssRow) -> str:
    return f"ok, {number(r.lag_s, 2, 's')}" if r.lag_verdict == "ok" else r.lag_verdict or "–"


def _ranks(data: CampaignData) -> Table:
    return Table(
        caption=f"Channel rank, reported and simulated, for each K{more(data.rank, ROWS_SHOWN)}.",
        columns={"Flight": HEAD, "Setting": TEXT, "Tower": TEXT, "K": RIGHT, "Samples": 0, "Agreement": RIGHT,
                 "Most frequent rank agrees": SHARE, "Kappa": 2, "Total variation": RIGHT, "Best K": 1},
        rows=[(r.flight, r.setting, r.tower, k_key(r.k), r.n, estimate(r.agreement, r.agreement_ci95, SHARE),
               r.commonest_agreement, r.kappa, estimate(r.total_variation, r.total_variation_ci95, 3, "<b>{}</b>"),
               r.best_k) for r in data.rank[:ROWS_SHOWN]],
        notes=[RANK_WORDS],
    )  # fmt: skip


def settings_of(data: CampaignData, files: Sequence[str]) -> Card:
    """Return the card of the settings, versions and files of the campaign."""
    code = Markup("<code>{}: {}</code>")
    table = Table(
        caption="Changes of the flight files in each setting.", columns={"Setting": HEAD, "Changes": TEXT},
        rows=[(name, Markup(", ").join(code.format(*entry) for entry in change.items()) or "no changes")
              for name, change in data.settings.items()],
    )  # fmt: skip
    method = "Method: D. Lee, O. Ozdemir, A. Ram, I. Guvenc, arXiv 2502.10324."
    beside = f"Files in the same folder: {', '.join(files)}. {method}"
    return replace(settings_card(data, {"workers": data.workers}), tables=[table], text=[beside])


# Cards in the order of the page, after its chart and map. A new card is another function here.
CARDS = (failures_card, repeats_card, rows_card)


def campaign_page(data: CampaignData, files: Sequence[str]) -> str:
    """Return the page."""
    charts = charts_of(data)
    places = _places(data)
    linked = payload(places, data.site, charts=charts) if charts or places else None
    shown = Positions(view="places", data=linked) if linked else None
    known, failed = warnings(data), len({failure.flight for failure in data.failures})
    beyond = [f"{len(known) - MANY} more are in campaign.json."] if len(known) > MANY else []
    lead = "Soundings between towers."
    if data.flights:
        failures = f" ({failed} with failures)" if failed else ""
        flights, settings = counted(len(data.flights), "flight"), counted(len(data.settings), "setting")
        lead = f"{flights}{failures} under {settings}, compared with ray tracing."
    return Page(
        kind="campaign", title=data.title, tag="synthetic" if data.synthetic else "", verdict=" ".join(verdict(data)),
        cautions=[*known[:MANY], *beyond], about=[f"{lead} Made {minute(data.generated)}"],
        charts=charts,
        cards=[result_card(data), *([season_card(data)] if charts else []),
               Card(title="Where the simulation is wrong: mean residual, measured minus simulated", positions=shown),
               *(card(data) for card in CARDS), settings_of(data, files)],
    ).html()  # fmt: skip


def write_campaign(data: CampaignData, folder: str | Path) -> list[Path]:
    """Write ``campaign.html``, ``campaign.json`` and the tables. Return their paths, beginning with the page.

    ``pairs.csv`` lists the pairs of flights at the same positions. The pairs are not in campaign.json.
    """
    folder = Path(folder)
    indent = 2 if len(data.rss) + len(data.rank) < _COMPACT_ROWS else None
    dates = [(n.node, *date) for n in data.season.nodes for date in zip(n.night, n.offset_db, strict=True)]
    tables = {
        "campaign.csv": _campaign_frame(data),
        _PAIR_TABLE: pd.DataFrame([cells(pair) for pair in data.repeats]),
        "offsets.csv": pd.DataFrame(dates, columns=["node", "date", "offset_db"]),
    }
    written = [write_file(folder / "campaign.json", json_text(campaign_metrics(data), indent))]
    for name, table in tables.items():
        if name == "campaign.csv" or len(table):
            written.append(write_file(folder / name, guarded(table).to_csv(index=False, lineterminator="\n")))
    return [write_file(folder / "campaign.html", campaign_page(data, [path.name for path in written])), *written]


# --- pairs of flights at the same positions ---------------------------------------------------------------------------

# File with all pairs.
_PAIR_TABLE = "pairs.csv"


def cells(record: Any) -> dict[str, Any]:
    """Return the fields of a record as cells of a table. An interval ``x_ci95`` becomes ``x_low`` and ``x_high``."""
    out: dict[str, Any] = {}
    for entry in dataclasses.fields(record):
        value = getattr(record, entry.name)
        if "ci95" in entry.name:
            low, high = value or (float("nan"), float("nan"))
            out |= {entry.name.replace("ci95", "low"): low, entry.name.replace("ci95", "high"): high}
        else:
            out[entry.name] = value
    return out
