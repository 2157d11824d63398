"""Content of a campaign page: finished numbers of many flights and settings, nothing to be computed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

from ...common.units import FloatArray, IntArray
from ...compare.judge.steps import NodeOffset
from ...compare.offset import Moments, difference_moments
from ...compare.statistics.intervals import Interval
from ...site.site import Site
from .made import Made


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
