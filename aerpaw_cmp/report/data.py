"""What a report is made of: finished numbers, nothing to be computed.

:mod:`aerpaw_cmp.report.build` fills these records; the rest of the room turns them into files. Whatever a flight may
lack is optional: a flight with rank only has ``rss=()``, one without a path anywhere has NaN numbers, never invented
ones.
Times are naive ``datetime64[ns]`` in UTC. A missing number is NaN (in ``metrics.json``: ``null``).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np

from ..common.provenance import KEY
from ..common.units import AnyArray, BoolArray, FloatArray, IntArray
from ..compare.ladder import LadderRow
from ..compare.result import AuditResult, EngineResult
from ..compare.rss import LEARNED_HERE
from ..compare.serving import ServingComparison
from ..compare.statistics import PairedDifference
from ..logs.records import RejectedLine
from ..site.site import Site
from .against import Against

Interval = tuple[float, float]

RANKS = (1, 2, 3, 4)
"""Ranks of a 4 x 4 channel, the bars of every histogram."""

GEOMETRY = {
    "distance_m": "Distance tower to UAV [m]",
    "elevation_deg": "Elevation of the UAV seen from the tower [deg]",
    "azimuth_deg": "Azimuth of the UAV in the frame of the tower antenna [deg]",
    "heading_deg": "UAV heading [deg clockwise from north]",
    "altitude_m": "Height of the UAV above ground [m]",
    "uav_azimuth_deg": "Azimuth of the tower,\nUAV antenna frame [deg]",
    "uav_elevation_deg": "Elevation of the tower,\nUAV antenna frame [deg]",
    "foliage_depth_m": "Path length inside tree crowns [m]",
}
"""Quantities that residuals are drawn against, and their axis labels."""


@dataclass(frozen=True, slots=True, kw_only=True)
class InputFile:
    """The account of one log file: ``lines == accepted + rejected + blank``.

    ``rejected_lines`` may hold all of them or a sample; ``rejected`` is the count.
    """

    path: str
    sha256: str
    reader: str
    lines: int
    accepted: int
    rejected: int
    blank: int
    role: str = ""
    warnings: tuple[str, ...] = ()
    rejected_lines: tuple[RejectedLine, ...] = ()
    learned_on: tuple[str, ...] = ()
    """SHA-256 of the logs that this file was learned from; none of other files."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Track:
    """The flown line: ``time`` (n,), positions (n,) in the site frame [m]."""

    time: AnyArray
    east_m: FloatArray
    north_m: FloatArray
    up_m: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Waypoint:
    """A named moment of the flight, e.g. ``A`` to ``F`` of the paper."""

    label: str
    time: np.datetime64
    east_m: float
    north_m: float
    up_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Baseline:
    """A closed-form model beside the ray tracing, with its own best offset.

    Parameters
    ----------
    name : str
        Key in ``metrics.json``: ``"free_space"``, ``"two_ray"``.
    level_dbm : (n,)
        Received power at the samples of the panel.
    offset_db, rmse_db : float
        Best offset of the measurement against this model, and what it leaves.
    paired : PairedDifference, optional
        The ray tracing against this model on the same samples.
    """

    name: str
    level_dbm: FloatArray
    offset_db: float
    rmse_db: float
    paired: PairedDifference | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Variant:
    """Another way to simulate the same panel, as a row of one table: iso arrays, measured patterns, with trees ...

    ``fitted`` names what was fitted, and on which flight; ``paired`` compares the report's own model with this one.
    """

    name: str
    offset_db: float
    rmse_db: float
    rmse_ci95_db: Interval | None = None
    fitted: str = "offset, on this flight"
    paired: PairedDifference | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class ChannelPair:
    """Difference of two channels of one tower over the same instants.

    Parameters
    ----------
    tower, first, second : str
    time, difference_db : (n,)
        First minus second, after each one's offset; NaN where one has no signal.
    simulated_difference_db : (n,), optional
        The same from the simulation.
    apart : tuple of ErrorSpan
        Where they part by more than ``limit_db``.
    """

    tower: str
    first: str
    second: str
    time: AnyArray
    difference_db: FloatArray
    simulated_difference_db: FloatArray | None = None
    limit_db: float = 10.0
    apart: tuple[ErrorSpan, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class OffsetCurve:
    """RMSE [dB] against candidate offset [dB], both (m,)."""

    offset_db: FloatArray
    rmse_db: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class ErrorSpan:
    """A stretch of the flight with a large error: when, where, how much, and the likely cause."""

    start: np.datetime64
    end: np.datetime64
    east_m: float
    north_m: float
    up_m: float
    mean_error_db: float
    cause: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Source:
    """Where samples stand in the logs: names of the files, and per sample its file's number and its line, (n,)."""

    files: tuple[str, ...]
    file: IntArray
    line: IntArray


@dataclass(frozen=True, slots=True, kw_only=True)
class PosePaths:
    """Propagation paths of some poses of a tower, to be drawn.

    Parameters
    ----------
    tower : str
    time : (poses,) datetime64[ns]
        Samples of the tower's first channel.
    lines : tuple of tuples
        Per pose its paths: points (depth + 2, 3) [m] from tower to UAV, and the number of reflections.
    """

    tower: str
    time: AnyArray
    lines: tuple[tuple[tuple[FloatArray, int], ...], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class RssPanel:
    """RSS of one tower and channel, measured against simulated.

    Parameters
    ----------
    tower, channel : str
        Together unique in a report.
    unit : str
        Of the measurement before the offset: ``"dBm"`` or ``"dB re full scale"``.
    time : (n,) datetime64[ns]
        Instants of the samples, in order.
    measured_db : (n,)
        As logged, before the offset; NaN where the log has no signal.
    simulated_dbm : (n,)
        Ray tracing; NaN where no path was found.
    measured_out_of_coverage, simulated_out_of_coverage : (n,) bool
        ``Z`` in the plots.
    offset_db, rmse_db, correlation : float
        Offset added to the measurement, what it leaves, Pearson correlation.
    n, n_out_of_coverage : int
        Pairs compared, and samples left out because one side has no signal.
    at_search_edge : bool
        The best offset lies at the end of the searched span: not a result.
    rmse_ci95_db, offset_ci95_db, correlation_ci95 : (low, high), optional
        95 % intervals.
    n_effective : float
        Sample size after autocorrelation; NaN when not estimated.
    lag_s, lag_verdict : float, str
        Radio clock minus telemetry clock as estimated (positive: the radio's shows later times), and ``"ok"``,
        ``"shifted"``, ``"cannot tell"`` or ``""``.
    fitted : tuple of str
        Names of the numbers that were fitted on the very data they are scored on.
    geometry : mapping
        Keys of :data:`GEOMETRY` to arrays (n,), for the residual plots; ``tower_elevation_deg`` besides, the elevation
        of the UAV in the frame of the tower antenna.
    line_of_sight : (n,) bool, optional
        For the residual plots.
    variants : tuple of Variant
        Other simulations of the same samples, for one table of RMSE.
    extra : mapping
        More numbers for ``metrics.json`` and the table of this panel.
    """

    tower: str
    channel: str
    unit: str
    time: AnyArray
    measured_db: FloatArray
    simulated_dbm: FloatArray
    measured_out_of_coverage: BoolArray
    simulated_out_of_coverage: BoolArray
    offset_db: float
    rmse_db: float
    correlation: float
    n: int
    n_out_of_coverage: int
    at_search_edge: bool = False
    rmse_ci95_db: Interval | None = None
    offset_ci95_db: Interval | None = None
    correlation_ci95: Interval | None = None
    n_effective: float = float("nan")
    lag_s: float = float("nan")
    lag_verdict: str = ""
    fitted: tuple[str, ...] = ("offset",)
    baselines: tuple[Baseline, ...] = ()
    offset_curve: OffsetCurve | None = None
    east_m: FloatArray | None = None
    north_m: FloatArray | None = None
    up_m: FloatArray | None = None
    geometry: Mapping[str, FloatArray] = field(default_factory=dict)
    line_of_sight: BoolArray | None = None
    worst: tuple[ErrorSpan, ...] = ()
    variants: tuple[Variant, ...] = ()
    extra: Mapping[str, Any] = field(default_factory=dict)
    per_sample: Mapping[str, FloatArray] = field(default_factory=dict)
    """Further columns (n,) of rss.csv, by name with unit."""
    source: Source | None = None

    @property
    def training(self) -> bool:
        """Whether the antennas were learned from the very logs of this panel: no error is given then."""
        return bool(self.extra.get(KEY))

    @property
    def name(self) -> str:
        """Tower and channel as one label."""
        return f"{self.tower} {self.channel}".strip()

    @property
    def calibrated_db(self) -> FloatArray:
        """Measurement plus offset (n,), comparable with ``simulated_dbm``."""
        return self.measured_db + self.offset_db

    @property
    def residual_db(self) -> FloatArray:
        """Calibrated measurement minus simulation (n,); NaN where a side is missing, or was learned on this flight."""
        if LEARNED_HERE in self.fitted:
            return np.full(len(self.time), np.nan)
        return self.calibrated_db - self.simulated_dbm


@dataclass(frozen=True, slots=True, kw_only=True)
class Histogram:
    """Shares of rank 1 to 4, each (4,); they sum to 1 over the samples in coverage. Intervals are 95 %."""

    share: FloatArray
    low: FloatArray | None = None
    high: FloatArray | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class RankAtK:
    """Simulated rank for one threshold K, against the measured rank.

    Parameters
    ----------
    k : float
        Singular values above ``sigma_1 / k`` count.
    rank : (n,) int
        At the samples of the panel; 0 = no path (out of coverage).
    histogram : Histogram
    n_out_of_coverage : int
    agreement, total_variation, wasserstein, kappa : float
    agreement_ci95, total_variation_ci95 : (low, high), optional
    p_value : float
        Permutation test of equal distributions; NaN when not done.
    confusion : (4, 5) int, optional
        Rows: measured rank 1 to 4. Columns: simulated rank 0 (Z) to 4.
    """

    k: float
    rank: IntArray
    histogram: Histogram
    n_out_of_coverage: int
    agreement: float
    total_variation: float
    wasserstein: float
    kappa: float = float("nan")
    agreement_ci95: Interval | None = None
    total_variation_ci95: Interval | None = None
    p_value: float = float("nan")
    confusion: IntArray | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class KCurve:
    """Agreement and total variation against continuous K, each (m,)."""

    k: FloatArray
    agreement: FloatArray
    total_variation: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class RankPanel:
    """Rank of one tower: what the modem reported against what each K says.

    Parameters
    ----------
    tower : str
    time : (n,) datetime64[ns]
    east_m, north_m, up_m : (n,)
    measured : (n,) float
        NaN = no CSI, never 0.
    histogram : Histogram
        Of the measured rank.
    simulated : tuple of RankAtK
        In rising K.
    best_k, best_k_ci95 : float, (low, high)
        K of the best agreement or distance, as the comparison defines it.
    curve : KCurve, optional
    singular_ratio_db : (n, 3), optional
        20 log10 (sigma_i / sigma_1), i = 2, 3, 4; shows why a rank is what it is.
    sinr_db : (n,), optional
    stale : (n,) bool, optional
        RI held constant between reports.
    """

    tower: str
    time: AnyArray
    east_m: FloatArray
    north_m: FloatArray
    up_m: FloatArray
    measured: FloatArray
    histogram: Histogram
    simulated: tuple[RankAtK, ...] = ()
    best_k: float = float("nan")
    best_k_ci95: Interval | None = None
    curve: KCurve | None = None
    singular_ratio_db: FloatArray | None = None
    sinr_db: FloatArray | None = None
    stale: BoolArray | None = None
    extra: Mapping[str, Any] = field(default_factory=dict)
    per_sample: Mapping[str, FloatArray] = field(default_factory=dict)
    """Further columns (n,) of rank.csv, by name: whole numbers."""
    values: Mapping[str, FloatArray] = field(default_factory=dict)
    """Further columns (n,) of rank.csv, by name: numbers."""


def tower_way(panel: RssPanel | RankPanel) -> dict[str, FloatArray]:
    """Places (n,) of a tower that moves: east, north, up [m], NaN where unknown. Empty of one that stands."""
    columns = panel.values if isinstance(panel, RankPanel) else panel.per_sample
    named = {axis: columns.get(f"tower_{axis}_m") for axis in ("east", "north", "up")}
    return {axis: np.asarray(values, dtype=np.float64) for axis, values in named.items() if values is not None}


Audit: TypeAlias = AuditResult
Engine: TypeAlias = EngineResult
"""The engine's record is numbers alone already."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReportData:
    """Everything a report shows.

    Parameters
    ----------
    title, flight : str
        Headline, and the short name that is the folder's name too.
    site : Site
    generated : str
        UTC, ISO 8601.
    versions : mapping of str to str
    inputs : tuple of InputFile
    track, waypoints, rss, rank, pairs, engine, ladder
        See their classes.
    synthetic : bool
        The logs were made by ``aerpaw-cmp simulate``; said on the first screen.
    warnings : tuple of str
        What the reader must know before believing a number, one sentence each.
    notes : tuple of str
        Remarks for the end of the report.
    settings : mapping
        The checked flight.yaml, nested mappings of plain values.
    stages_s : mapping of str to float
        Seconds per named stage.
    serving : ServingComparison, optional
        Cells that served against cells predicted strongest, where a log tells which cell served.
    extra_metrics : mapping
        Merged into ``metrics.json`` last, key by key.
    audit_command : str
        The command that fills in the audit, where it was put off; else empty.
    """

    title: str
    flight: str
    site: Site
    generated: str
    versions: Mapping[str, str] = field(default_factory=dict)
    inputs: tuple[InputFile, ...] = ()
    track: Track | None = None
    waypoints: tuple[Waypoint, ...] = ()
    rss: tuple[RssPanel, ...] = ()
    rank: tuple[RankPanel, ...] = ()
    pairs: tuple[ChannelPair, ...] = ()
    engine: EngineResult | None = None
    ladder: tuple[LadderRow, ...] = ()
    synthetic: bool = False
    warnings: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    settings: Mapping[str, Any] = field(default_factory=dict)
    stages_s: Mapping[str, float] = field(default_factory=dict)
    extra_metrics: Mapping[str, Any] = field(default_factory=dict)
    paths: tuple[PosePaths, ...] = ()
    serving: ServingComparison | None = None
    audit_command: str = ""
    against: Against | None = None
    """What was predicted before the flight, where a prediction is named."""
