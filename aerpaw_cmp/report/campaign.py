"""campaign.html, campaign.json and campaign.csv: records of many flights and settings, sentences, figures, files."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import pandas as pd
from markupsafe import Markup

from ..common.jsonable import fields_of, json_safe
from ..common.text import counted, guarded
from ..common.units import FloatArray, IntArray
from ..compare.level import LEARNED_HERE
from ..compare.offset import Moments, difference_moments
from ..compare.statistics import Interval
from ..compare.verdict import NodeOffset, Step, Verdict, campaign_verdict, pooled_db
from ..site.site import Site
from .canvas import FigureSpec, Picture, beyond, colour_bar, draw_tower, frame_around, plan_axes, subplots
from .cards import HEAD, RIGHT, SHARE, TEXT, Card, Page, Table, bold, estimate, settings_card
from .charts import COLOURS
from .flight_words import first_sentence, judge, pretty, ranking_sentence, said_of
from .page import Made, about, json_text, write_figures, write_file
from .texts import interval, k_key, minute, more, number

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, slots=True, kw_only=True)
class RssRow:
    """RSS of one flight, setting, tower and channel.

    ``offset_db`` and ``rmse_db`` come from this row's own samples; ``pooled_offset_db`` is shared as the campaign's
    ``calibration`` says, ``pooled_rmse_db`` what it leaves on this row; ``held_out_offset_db`` comes from the other
    flights of the same setting, tower and channel, ``held_out_rmse_db`` is what that leaves here (NaN without another).
    ``baselines`` are RMSE [dB] by name, each with an offset of its own; ``span_db`` is that of the
    offset search. Arrays (n,) are at the samples, NaN where a side is missing; they are kept for the first setting
    only, elsewhere they are empty and ``difference`` stands for them.
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
    """First instant, nanoseconds after 1970-01-01."""
    difference: Moments | None = None
    pooled_offset_db: float = float("nan")
    pooled_rmse_db: float = float("nan")
    held_out_offset_db: float = float("nan")
    held_out_rmse_db: float = float("nan")
    logs: tuple[str, ...] = ()
    """SHA-256 of the logs that hold the samples."""
    mark: str = field(repr=False, default="")
    verdicts: Mapping[str, str] = field(default_factory=dict)
    """By baseline, what the paired interval says about the ray tracing."""

    @property
    def key(self) -> tuple[str, str, str]:
        """Flight, tower, channel."""
        return self.flight, self.tower, self.channel

    @property
    def moments(self) -> Moments:
        """Of simulated minus measured over the scored samples."""
        return self.difference or difference_moments(self.measured_db, self.simulated_dbm)

    @property
    def link(self) -> str:
        """Tower and channel as one label."""
        return f"{self.tower} {self.channel}".strip()

    @property
    def residual_db(self) -> FloatArray:
        """Measurement after this row's own offset, minus simulation (n,)."""
        return self.measured_db + self.offset_db - self.simulated_dbm


@dataclass(frozen=True, slots=True, kw_only=True)
class RankRow:
    """Rank of one flight, setting, tower and K."""

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
    """Agreement of always saying the commonest rank: what a model has to beat."""
    logs: tuple[str, ...] = ()
    """SHA-256 of the logs that hold the reports."""
    mark: str = field(repr=False, default="")


@dataclass(frozen=True, slots=True, kw_only=True)
class Failure:
    """A flight (and setting) that gave no numbers, and why; ``traceback`` for whoever mends it, never on the page."""

    flight: str
    setting: str
    message: str
    traceback: str = field(repr=False, default="")


@dataclass(frozen=True, slots=True, kw_only=True)
class PooledOffset:
    """One shared offset.

    ``spread_db`` is the standard deviation of the members' own offsets (NaN for one member), ``range_db`` their
    extremes; ``own_rmse_db`` and ``pooled_rmse_db`` are means over the members.
    """

    setting: str
    group: str
    members: tuple[str, ...]
    offset_db: float
    spread_db: float
    range_db: Interval
    own_rmse_db: float
    pooled_rmse_db: float
    at_search_edge: bool
    units: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Repeat:
    """Two flights over the same places, one tower and channel.

    Parameters
    ----------
    rmse_db : float
        RMS difference of the two measurements after the best constant ``offset_db`` (second minus first) [dB].
    share : float
        Pairs over samples of the first flight: a few pairs near the launch pad speak for that place only.
    single_db : float
        ``rmse_db / sqrt(2)``: the share of one pass, if both err alike and independently.
    residual_rmse_db : float
        The same difference after the simulation's own difference has been taken off.
    place_rmse_db : float
        RMS difference of the mean residuals per cell of the plan, whatever the heights.
    place_correlation : float
        Correlation of the mean residuals per cell of the plan: near 1, the model errs the same way on both flights.
    cells : int
        Cells that both flights have.
    height_difference_m : float
        Median over those cells [m].
    """

    tower: str
    channel: str
    first: str
    second: str
    n: int
    share: float
    rmse_db: float
    rmse_ci95_db: Interval | None
    offset_db: float
    single_db: float
    residual_rmse_db: float
    place_rmse_db: float
    place_correlation: float
    cells: int
    height_difference_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class RankTransfer:
    """Total variation of one flight at the K that the other flights would have chosen.

    ``k`` has the least mean total variation on ``chosen_on`` among the K of the flight files; ``own_k`` on the
    flight itself.
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
    """One setting against the one of least mean error, over flights.

    Parameters
    ----------
    setting : str
    link : str
        Tower and channel that it is about; empty: all.
    n_flights : int
        Flights with an error under this setting.
    mean_db : float
        Mean over flights of the mean error over towers and channels [dB]: held out where there is another flight.
    quantiles_db : tuple of float
        0, 10, 25, 50, 75, 90 and 100 % of the flights.
    difference_db, difference_ci95_db : float, Interval or None
        Mean over flights of this minus the first setting, on the links that both scored; None for the first itself.
    n_paired : int
        Flights in that difference.
    verdict : str
        "first", "worse", "not significant" or "no interval".
    """

    setting: str
    link: str
    n_flights: int
    mean_db: float
    quantiles_db: tuple[float, ...]
    difference_db: float
    difference_ci95_db: Interval | None
    n_paired: int
    verdict: str


@dataclass(frozen=True, slots=True, kw_only=True)
class PlaceMap:
    """Mean residual of cells of the plan over flights, towers and channels.

    ``cells`` (n, 2) are column and row in multiples of the cell from the origin; ``mean_db`` (n,) is the mean over
    flights, towers and channels of the mean residual of each in the cell.
    """

    cells: IntArray
    mean_db: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Season:
    """Result of all flights together.

    Parameters
    ----------
    held_out : bool
        Whether the errors are held out; with one flight they are its own.
    started : mapping of str to str
        First instant of a flight, UTC, ISO 8601; none for logs with relative times.
    ranking : tuple of SettingRank
        Over all links, best first, then for each link where there are several.
    nodes : tuple of NodeOffset
        Of the first setting, or of soundings between towers.
    places : PlaceMap, optional
        Of the first setting.
    reports : mapping of str to str
        Address of a flight's report, against the campaign's folder.
    """

    held_out: bool = False
    started: Mapping[str, str] = field(default_factory=dict)
    ranking: tuple[SettingRank, ...] = ()
    nodes: tuple[NodeOffset, ...] = ()
    places: PlaceMap | None = None
    reports: Mapping[str, str] = field(default_factory=dict)

    def over_all(self) -> tuple[SettingRank, ...]:
        """The ranking over all towers and channels."""
        return tuple(entry for entry in self.ranking if not entry.link)


@dataclass(frozen=True, slots=True, kw_only=True)
class CampaignData(Made):
    """Everything the page shows. ``settings`` are overrides by label; ``flights`` the names in order.

    Two samples count as taken at the same place within ``radius_m`` with headings that agree within
    ``heading_within_deg``; residuals are gathered by place in cells of ``cell_m``.
    """

    radius_m: ClassVar[float] = 3.0
    heading_within_deg: ClassVar[float] = 20.0
    cell_m: ClassVar[float] = 20.0

    name: str
    title: str
    calibration: str
    flights: tuple[str, ...]
    settings: Mapping[str, Mapping[str, Any]]
    rss: tuple[RssRow, ...] = ()
    rank: tuple[RankRow, ...] = ()
    failures: tuple[Failure, ...] = ()
    pooled: tuple[PooledOffset, ...] = ()
    repeats: tuple[Repeat, ...] = ()
    rank_transfers: tuple[RankTransfer, ...] = ()
    site: Site | None = None
    synthetic: tuple[str, ...] = ()
    workers: int = 1
    season: Season = Season()

    @property
    def reference(self) -> str:
        """The setting that repeatability and the season are drawn for: the first."""
        return next(iter(self.settings), "")

    @property
    def reference_rows(self) -> tuple[RssRow, ...]:
        """RSS rows of that setting."""
        return tuple(row for row in self.rss if row.setting == self.reference)


# Warnings of flights that stand one by one.
FEW = 8

# Sentence and next step by :func:`~aerpaw_cmp.compare.verdict.campaign_verdict`.
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
    """Return a sentence per step of an offset, the latest first, and how small a step the last date can show."""
    judged = [node for node in data.season.nodes if np.isfinite(node.smallest_db)]
    if not judged:
        return []
    last = max(node.night[-1] for node in judged)
    steps = sorted(((step.night, node.node, step) for node in judged for step in node.steps), key=lambda s: s[:2])
    out = [
        f"On {night} the offset of {name} steps by {step.step_db:+.1f} dB "
        f"(95 %: {step.step_ci95_db[0]:+.1f} to {step.step_ci95_db[1]:+.1f} dB)"
        + (f" and is back on {step.back}." if step.back else ".")
        for night, name, step in reversed(steps)
    ]
    if not any(step.shown == last for _, _, step in steps):
        out.append(f"No offset steps on {last}, the last date.")
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


# Nodes of a figure: those that step first, then those that vary most.
_NODES_SHOWN = 12


def season_nodes(data: CampaignData) -> Figure:
    """Offset of nodes over the dates, less what all share; steps as bars of their intervals."""
    fig, ax = subplots((9.2, 3.6))
    order = sorted(data.season.nodes, key=lambda node: (not node.steps, -np.ptp(node.offset_db or (0.0,))))
    dates = sorted({night for node in data.season.nodes for night in node.night})
    for place, node in enumerate(order[:_NODES_SHOWN]):
        colour = COLOURS[place % len(COLOURS)]
        at = [dates.index(night) for night in node.night]
        ax.plot(at, node.offset_db, marker=".", linewidth=0.6, color=colour, alpha=0.7, label=node.node)
        for step in node.steps:
            middle, where = node.offset_db[node.night.index(step.shown)], dates.index(step.shown)
            reach = (step.step_ci95_db[1] - step.step_ci95_db[0]) / 2.0
            ax.errorbar(where, middle, yerr=reach, color=colour, capsize=4, linewidth=1.6)
    shown = np.unique(np.linspace(0, len(dates) - 1, 8).round().astype(int))
    ax.set_xticks(shown, [dates[i] for i in shown], rotation=20)
    ax.tick_params(axis="x", labelsize=8)
    ax.set_ylabel("Offset against its median [dB]")
    fig.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return fig


def season_places(data: CampaignData) -> Figure:
    """Mean residual of each cell of the plan over flights, all towers and channels."""
    shown = data.season.places
    assert shown is not None
    cells = shown.cells
    # a few outlying cells would leave one colour to all others
    reach = max(float(np.percentile(np.abs(shown.mean_db), 98)), 0.1)
    first, last = cells.min(axis=0), cells.max(axis=0) + 1
    image = np.full(tuple(last - first)[::-1], np.nan)
    image[cells[:, 1] - first[1], cells[:, 0] - first[0]] = shown.mean_db
    extent = np.array([first[0], last[0], first[1], last[1]]) * data.cell_m
    fig, ax = subplots((7.0, 5.0))
    ax.set_facecolor("#F4F4F4")
    # no grey in it: a grey middle would turn dark on a dark page, between two light neighbours
    mesh = ax.imshow(
        image, origin="lower", extent=tuple(extent), cmap="Spectral_r", vmin=-reach, vmax=reach, interpolation="none",
        zorder=2,
    )  # fmt: skip
    known = {} if data.site is None else data.site.towers
    names = dict.fromkeys(row.tower for row in data.reference_rows if row.tower in known)
    for tower in names:
        draw_tower(ax, known[tower])
    plan_axes(ax)
    at = [known[name].position_m[None, :2] for name in names]
    frame_around(ax, *np.concatenate([(cells + 0.5) * data.cell_m, *at]).T)
    colour_bar(fig, mesh, [ax], "Mean of measured − simulated [dB]", beyond(shown.mean_db, -reach, reach))
    return fig


def figure_specs(data: CampaignData) -> Iterator[FigureSpec]:
    """Figures of the season, where the campaign has numbers for them."""
    if any(len(node.night) > 1 for node in data.season.nodes):
        yield FigureSpec(
            "season_nodes", partial(season_nodes, data), "Offsets over the season",
            "Offset of each node over the dates, less what all nodes share (weather, a transmitter). A bar: the 95 % "
            f"interval of a step. Of more than {_NODES_SHOWN} nodes those that step, then those that vary most.",
        )  # fmt: skip
    if data.season.places is not None:
        yield FigureSpec(
            "season_places", partial(season_places, data), "Where the simulation errs, over all flights",
            f"Mean over flights of the mean residual in cells of {data.cell_m:g} m, “{data.reference}”, all towers and "
            "channels.",
        )  # fmt: skip


# Warnings that stand on the page at all.
MANY = 200

# Flights of a table that has a column or a heading for each.
_FEW_FLIGHTS = 20

# Rows of a table on the page; the files beside it hold all.
ROWS_SHOWN = 300

# From so many rows on campaign.json is written without indentation.
_COMPACT_ROWS = 2000

# Fields of a row that are samples, not numbers of a table.
ARRAYS = ("measured_db", "simulated_dbm", "position_m", "heading_deg")


def _entries(items: Iterable[Any], without: Sequence[str]) -> list[dict[str, Any]]:
    return [{f.name: getattr(x, f.name) for f in dataclasses.fields(x) if f.name not in without} for x in items]


def campaign_metrics(data: CampaignData) -> dict[str, Any]:
    """The numbers of the page under stable names; what does not exist is None."""
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
        "calibration": {"per": data.calibration, "groups": data.pooled},
        "repeatability": {
            "radius_m": data.radius_m, "heading_within_deg": data.heading_within_deg, "cell_m": data.cell_m,
            "pairs_total": len(data.repeats),
            "links": by_link(data.repeats),
            "pairs": telling(data.repeats),
            "table": _PAIR_TABLE if data.repeats else None,
        },
        "season": {
            "held_out": data.season.held_out, "started": data.season.started, "ranking": data.season.ranking,
            "nodes": data.season.nodes,
            "steps": step_words(data),
            "cells": 0 if data.season.places is None else len(data.season.places.cells),
        },
        **about(data),
    }  # fmt: skip
    safe: dict[str, Any] = json_safe(result)
    return safe


def _campaign_frame(data: CampaignData) -> pd.DataFrame:
    """One row per flight, setting, tower and channel (``kind`` rss) or K (``kind`` rank), and per failure."""
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
    "rmse_low_db", "rmse_high_db", "free_space_rmse_db", "two_ray_rmse_db", "pooled_offset_db", "pooled_rmse_db", "n",
    "n_out_of_coverage", "held_out_offset_db", "held_out_rmse_db", "correlation", "correlation_low", "correlation_high",
    "at_search_edge", "lag_s", "lag_verdict",
    "fitted", "total_variation", "total_variation_low", "total_variation_high", "agreement", "agreement_low",
    "agreement_high", "kappa", "wasserstein", "best_k", "message",
]  # fmt: skip


def _errors_of_pairs(data: CampaignData) -> list[tuple[Any, float, float]]:
    """Each pair of flights with the RMSE of both under the reference setting."""
    rmse = {row.key: row.rmse_db for row in data.reference_rows}

    def error(pair: Repeat, flight: str) -> float:
        return rmse.get((flight, pair.tower, pair.channel), float("nan"))

    return [(pair, error(pair, pair.first), error(pair, pair.second)) for pair in data.repeats]


# --- cards ----------------------------------------------------------------------------------------------------------


def result_card(data: CampaignData) -> Card:
    """Return the card of the result: settings in order of their error, the worst flights, K of other flights."""
    tables = [_ranking(data), _worst(data), _mean_errors(data), _transfers(data)]
    return Card(title="Result", id="result", link="Result", text=headline(data), tables=tables)


def _ranking(data: CampaignData) -> Table:
    held_out = "held-out error over flights: each flight scored with the offset of the other flights"
    kind = held_out if data.season.held_out else "error over flights, each with an offset of its own samples"
    return Table(
        caption=f"Settings by their mean {kind}. Difference from the best setting: mean difference on the same "
        "flights, towers and channels, with a 95 % interval over flights; the first was chosen on these flights.",
        columns={"Place": 0, "Setting": HEAD, "Flights": 0, "Mean error [dB]": RIGHT, "Median [dB]": 2,
                 "10 % to 90 % [dB]": RIGHT, "Difference from the best setting [dB]": 2, "95 %": 2, "Shown": TEXT},
        rows=[
            (place, r.setting, r.n_flights, bold(number(r.mean_db, 2)), r.quantiles_db[3],
             f"{number(r.quantiles_db[1], 2)} to {number(r.quantiles_db[5], 2)}", r.difference_db,
             r.difference_ci95_db or "", r.verdict)
            for place, r in enumerate(data.season.over_all(), 1)
        ],
    )  # fmt: skip


def _worst(data: CampaignData) -> Table:
    season, worst = data.season, worst_flights(data)
    reports = season.reports
    few = f", {_FEW_FLIGHTS} of {len(worst)}" if len(worst) > _FEW_FLIGHTS else ""
    link, first = Markup('<a href="{}">{}</a>'), next((r.setting for r in season.over_all()), "")
    return Table(
        caption=f"Flights with the largest error under “{first}”{few}.",
        columns={"Flight": HEAD, "Start (UTC)": "when", "Error [dB]": 2, "Worst link": TEXT},
        rows=[(link.format(reports[name], name) if name in reports else name, season.started.get(name, ""), error, at)
              for name, error, at in worst[:_FEW_FLIGHTS]],
    )  # fmt: skip


def _mean_errors(data: CampaignData) -> Table:
    flights = rss_flights(data)
    shown = (data.rss or not data.rank) and 0 < len(flights) <= _FEW_FLIGHTS
    return Table(
        caption="Mean RMSE over towers and channels [dB], each with an offset fitted on its own samples.",
        columns={"Setting": HEAD, **dict.fromkeys(flights, 2)},
        rows=[(setting, *(by[f] for f in flights)) for setting, by in mean_rmse(data).items()] if shown else [],
    )  # fmt: skip


def _transfers(data: CampaignData) -> Table:
    return Table(
        caption="Rank: K chosen on the other flights, and what it leaves here (transferred), beside the best K of "
        f"the flight itself (fitted here){more(data.rank_transfers, ROWS_SHOWN)}.",
        columns={"Setting": TEXT, "Flight": HEAD, "Tower": TEXT, "Chosen on": TEXT, "K": RIGHT,
                 "Total variation, transferred": RIGHT, "Kappa": 2, "Own K": RIGHT, "Total variation, fitted here": 3},
        rows=[(t.setting, t.flight, t.tower, ", ".join(t.chosen_on), k_key(t.k), bold(number(t.total_variation, 3)),
               t.kappa, k_key(t.own_k), t.own_total_variation) for t in data.rank_transfers[:ROWS_SHOWN]],
    )  # fmt: skip


def season_card(data: CampaignData, pictures: Sequence[Picture]) -> Card:
    """Return the card of the season: its figures, and steps of offsets."""
    steps = any(picture.spec.name == "season_nodes" for picture in pictures)
    table = Table(
        caption="Steps of offsets: date of the first, size with its 95 % interval, date on which the old level was "
        "back. “Shows”: the step that its first date shows with a chance of 90 %. campaign.json has every date.",
        columns={"Node": HEAD, "Dates": 0, "Std. dev. [dB]": 2, "Shows [dB]": 1, "Steps": TEXT},
        rows=[(n.node, len(n.night), n.sd_db, n.smallest_db, "; ".join(map(_step, n.steps)) or "none")
              for n in data.season.nodes] if steps else [],
    )  # fmt: skip
    parts = [Card(tables=[table])]
    return Card(title="Over the season", id="season", chart=pictures, parts=parts) if pictures else Card()


def _step(step: Step) -> str:
    back = f", back on {step.back}" if step.back else ""
    return f"{step.night}: {step.step_db:+.1f} dB ({interval(step.step_ci95_db)}){back}"


def failures_card(data: CampaignData) -> Card:
    """Return the card of flights and settings without numbers."""
    first = f", the first {ROWS_SHOWN} of {len(data.failures)}; all stand in campaign.csv"
    table = Table(
        caption=f"Flights and settings without numbers{first if len(data.failures) > ROWS_SHOWN else ''}.",
        columns={"Flight": HEAD, "Setting": TEXT, "Why": TEXT}, look="tall",
        rows=[(f.flight, f.setting, f.message) for f in data.failures[:ROWS_SHOWN]],
    )  # fmt: skip
    return Card(title="Failures", id="failures", link="Failures", tables=[table])


def offsets_card(data: CampaignData) -> Card:
    """Return the card of shared offsets, and of pairs of flights at the same places."""
    title = "Offsets and repeatability"
    return Card(title=title, id="offsets", link="Offsets", fold=True, tables=[_pooled(data), _pairs(data)])


def _pooled(data: CampaignData) -> Table:
    return Table(
        caption=f"Offsets shared per {data.calibration} (added to the measurement), the spread of the members' own "
        f"offsets, and the mean RMSE that either leaves{more(data.pooled, ROWS_SHOWN)}.",
        columns={"Setting": TEXT, "Group": HEAD, "Members": 0, "Shared offset [dB]": RIGHT, "Own offsets [dB]": 1,
                 "Std. dev. [dB]": 2, "RMSE, own offsets [dB]": 2, "RMSE, shared [dB]": 2},
        rows=[(g.setting, g.group, len(g.members), number(g.offset_db) + (" (edge)" if g.at_search_edge else ""),
               g.range_db, g.spread_db, g.own_rmse_db, g.pooled_rmse_db) for g in data.pooled[:ROWS_SHOWN]],
    )  # fmt: skip


def _pairs(data: CampaignData) -> Table:
    pairs = _errors_of_pairs(data)
    return Table(
        caption=f"Two flights at the same places (within {number(data.radius_m, 0, 'm')}, headings within "
        f"{number(data.heading_within_deg, 0)}°), beside the RMSE of the setting “{data.reference}”. “After the "
        f"model”: what their residuals still differ by. “By place”: mean residuals in cells of "
        f"{number(data.cell_m, 0, 'm')}, whatever the heights; a correlation near 1 says that the model errs the same "
        f"way on both flights{more(pairs, ROWS_SHOWN)}.",
        columns={"Link": HEAD, "Flights": TEXT, "Pairs": 0, "Share": SHARE, "Differ by [dB]": RIGHT, "95 %": 1,
                 "One pass (÷√2)": 1, "After the model": 1, "RMSE of both": RIGHT, "By place: RMS": 1, "Correlation": 2,
                 "Cells": 0, "Height apart": RIGHT},
        rows=[
            (f"{r.tower} {r.channel}", f"{r.first}, {r.second}", r.n, r.share, bold(number(r.rmse_db)),
             r.rmse_ci95_db or "", r.single_db, r.residual_rmse_db, f"{number(a)}, {number(b)}", r.place_rmse_db,
             r.place_correlation, r.cells, number(r.height_difference_m, 0, "m"))
            for r, a, b in pairs[:ROWS_SHOWN]
        ],
    )  # fmt: skip


def rows_card(data: CampaignData) -> Card:
    """Return the card of all numbers: a row per flight, setting and link, or K."""
    return Card(title="All numbers", id="rows", link="All numbers", fold=True, tables=[_levels(data), _ranks(data)])


def _levels(data: CampaignData) -> Table:
    rows: Sequence[RssRow] = data.rss
    few = ""
    if len(rows) > ROWS_SHOWN:
        few = f"; the {ROWS_SHOWN} rows of largest error of {len(rows)}, all stand in campaign.csv"
        rows = sorted(rows, key=lambda r: -np.nan_to_num(r.rmse_db, nan=-1.0))[:ROWS_SHOWN]
    models = list(dict.fromkeys(name for row in data.rss for name in row.baselines))
    return Table(
        caption=f"RSS. Offset and RMSE are fitted on the row's own samples; baselines have an offset of their "
        f"own{few}.",
        columns={"Flight": HEAD, "Setting": TEXT, "Link": TEXT, "Offset [dB]": RIGHT, "RMSE [dB]": RIGHT, "95 %": 2,
                 "Held-out RMSE [dB]": 2, **{f"{pretty(name)} [dB]": 2 for name in models},
                 "Against baselines (95 %)": TEXT, "RMSE, shared offset [dB]": 2, "Corr.": 2, "Samples": 0,
                 "Out of coverage": 0, "Clock": TEXT, "Fitted here": TEXT},
        rows=[
            (r.flight, r.setting, r.link, number(r.offset_db) + (" (edge)" if r.at_search_edge else ""),
             bold(number(r.rmse_db, 2)), r.rmse_ci95_db or "", r.held_out_rmse_db,
             *(r.baselines.get(name) for name in models), against_baselines(r), r.pooled_rmse_db, r.correlation, r.n,
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
        caption="Rank: agreement by pose, Cohen's kappa (0 is chance) and total variation between the histograms, for "
        f"each K{more(data.rank, ROWS_SHOWN)}.",
        columns={"Flight": HEAD, "Setting": TEXT, "Tower": TEXT, "K": RIGHT, "Samples": 0, "Agreement": RIGHT,
                 "Commonest rank agrees": 2, "Kappa": 2, "Total variation": RIGHT, "Best K": 1},
        rows=[(r.flight, r.setting, r.tower, k_key(r.k), r.n, estimate(r.agreement, r.agreement_ci95),
               r.commonest_agreement, r.kappa, estimate(r.total_variation, r.total_variation_ci95, 3, "<b>{}</b>"),
               r.best_k) for r in data.rank[:ROWS_SHOWN]],
    )  # fmt: skip


def settings_of(data: CampaignData, files: Sequence[str]) -> Card:
    """Return the card of the settings, versions and files of the campaign."""
    code = Markup("<code>{}: {}</code>")
    table = Table(
        caption="What each setting changes in the flight files.", columns={"Setting": HEAD, "Changes": TEXT},
        rows=[(name, Markup(", ").join(code.format(*entry) for entry in change.items()) or "nothing")
              for name, change in data.settings.items()],
    )  # fmt: skip
    method = "Method: D. Lee, O. Ozdemir, A. Ram, I. Guvenc, arXiv 2502.10324."
    beside = f"Beside this page: {', '.join(files)}. {method}"
    return replace(settings_card(data, {"workers": data.workers}), tables=[table], text=[beside])


# Cards in the order of the page, after the figures. A new card is one function more.
CARDS = (failures_card, offsets_card, rows_card)


def campaign_page(data: CampaignData, pictures: Sequence[Picture], files: Sequence[str]) -> str:
    """Return the whole page."""
    known, failed = warnings(data), len({failure.flight for failure in data.failures})
    beyond = [f"{len(known) - MANY} more stand in campaign.json."] if len(known) > MANY else []
    lead = "Soundings between towers."
    if data.flights:
        failures = f" ({failed} with failures)" if failed else ""
        flights, settings = counted(len(data.flights), "flight"), counted(len(data.settings), "setting")
        lead = f"{flights}{failures} under {settings}, measured against ray tracing."
    return Page(
        kind="campaign", title=data.title, tag="synthetic" if data.synthetic else "", verdict=" ".join(verdict(data)),
        cautions=[*known[:MANY], *beyond], about=[f"{lead} Made {minute(data.generated)}"],
        cards=[result_card(data), season_card(data, pictures), *(card(data) for card in CARDS),
               settings_of(data, files)],
    ).html()  # fmt: skip


def write_campaign(data: CampaignData, folder: str | Path) -> list[Path]:
    """Write ``campaign.html``, ``campaign.json``, ``campaign.csv`` and ``figures/``; gives the files, page first.

    Pairs of flights at the same places stand in ``pairs.csv``, all of them; campaign.json has the telling ones.
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
    specs = list(figure_specs(data))
    drawn, pictures = write_figures(specs, folder / "figures", ("svg", "png"))
    files = [*(path.name for path in written), *["figures/"] * bool(pictures)]
    page = write_file(folder / "campaign.html", campaign_page(data, drawn, files))
    return [page, *written, *pictures]


# --- pairs of flights at the same places -----------------------------------------------------------------------------

# Pairs that campaign.json lists; of more, those with the most places.
LISTED_PAIRS = 1000

# The file with all of them.
_PAIR_TABLE = "pairs.csv"


def telling(pairs: Sequence[Repeat], most: int = LISTED_PAIRS) -> list[Repeat]:
    """All pairs, or of more than ``most`` those with the most places, in their order."""
    chosen = sorted(range(len(pairs)), key=lambda i: (-pairs[i].n, i))[:most]
    return [pairs[i] for i in sorted(chosen)]


def by_link(pairs: Sequence[Repeat]) -> list[dict[str, Any]]:
    """Per tower and channel: pairs of flights, those that meet, their places, and how much they differ [dB]."""
    groups: dict[tuple[str, str], list[Repeat]] = {}
    for pair in pairs:
        groups.setdefault((pair.tower, pair.channel), []).append(pair)
    rows = []
    for (tower, channel), members in groups.items():
        meeting = [pair for pair in members if pair.n]
        rmse = np.array([pair.rmse_db for pair in meeting if np.isfinite(pair.rmse_db)])
        low, median, high = np.quantile(rmse, (0.1, 0.5, 0.9)).tolist() if len(rmse) else (float("nan"),) * 3
        rows.append(
            {
                "tower": tower,
                "channel": channel,
                "pairs": len(members),
                "meeting": len(meeting),
                "n": sum(pair.n for pair in meeting),
                "rmse_mean_db": float(rmse.mean()) if len(rmse) else float("nan"),
                "rmse_quantiles_db": {"10": low, "50": median, "90": high},
            }
        )
    return rows


def cells(record: Any) -> dict[str, Any]:
    """Fields of a record as cells of a table; an interval ``x_ci95`` becomes ``x_low`` and ``x_high``."""
    out: dict[str, Any] = {}
    for entry in dataclasses.fields(record):
        value = getattr(record, entry.name)
        if "ci95" in entry.name:
            low, high = value or (float("nan"), float("nan"))
            out |= {entry.name.replace("ci95", "low"): low, entry.name.replace("ci95", "high"): high}
        else:
            out[entry.name] = value
    return out
