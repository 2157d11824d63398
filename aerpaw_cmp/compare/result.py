"""The numbers of one comparison, which reports, campaigns and JSON use.

This file computes, draws and formats nothing. Times are naive ``datetime64[ns]`` in UTC. A missing number is NaN, and
a field that does not apply to a flight is None.

A new number of a tower and channel needs one field of :class:`RssFurther` (for the rank: :class:`RankFurther`) and one
function that computes it. Both metrics.json and the tables of the report list the fields by name.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..common.units import AnyArray, BoolArray, FloatArray, IntArray, Printed, db_from_amplitude
from .gains import StatedSpread
from .ladder import LadderRow, ModelRow
from .level import (
    LEARNED_HERE,
    ChannelDifference,
    DetectionScore,
    ErrorSpan,
    FieldAudit,
    RssComparison,
    ServingComparison,
)
from .rank import CommonestRank, RankComparison, RankRepeat
from .receiver import ForecastScore
from .statistics import Interval, PairedDifference

# Models that a replay is compared with, and their titles. The last two contain no physics.
BASELINE_TITLE = {
    "free_space": "free space",
    "two_ray": "two-ray ground",
    "log_distance": "log-distance line",
    "constant": "constant level",
}

# States of a clock: corrected by the estimate, correction refused, not requested, or corrected by a stated value.
APPLIED, NOT_APPLIED, ESTIMATED, GIVEN = (
    "estimated and applied", "asked for, not applied", "estimated, not applied", "given in flight.yaml"
)  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockResult:
    """The radio clock of a receiver (a tower) compared with the telemetry clock.

    ``radio_minus_telemetry_s`` is positive if the radio clock shows later times; subtracting it corrects them.
    ``applied`` is one of the states above, and ``checks`` contains the tests behind the verdict, by name.
    """

    receiver: str
    radio_minus_telemetry_s: float
    ci95_s: Interval
    verdict: str
    reason: str
    applied: str
    checks: Mapping[str, object] = field(default_factory=dict)

    @property
    def shifted(self) -> bool:
        """True if the clock is wrong and was not corrected."""
        return self.verdict == "shifted" and self.applied != APPLIED

    @property
    def in_words(self) -> str:
        """The lag with its interval as text."""
        ends = "[{:+.2f}, {:+.2f}]".format(*map(Printed, self.ci95_s))
        side = "ahead of" if self.radio_minus_telemetry_s > 0 else "behind"
        return f"{abs(self.radio_minus_telemetry_s):.2f} s {side} the telemetry clock {ends}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Cause:
    """A named cause.

    Parameters
    ----------
    name : str
    sentence : str
        Channels, numbers, and the RMSE without and with the cause.
    next_step : str
        A clause.
    estimate, ci95 : float, (low, high)
        Number of the cause (lag [s], angle [deg], height [m], loss, floor or step [dB]; else NaN) and its interval.
    channels : sequence of str
        Channels that show the cause.
    rmse_db, rmse_with_db : float
        RMSE of 1-s means of these channels without and with the cause [dB].
    gain : float
        Log odds of the explanations with the cause to all without it.
    """

    name: str
    sentence: str
    next_step: str
    estimate: float = math.nan
    ci95: Interval = (math.nan, math.nan)
    channels: tuple[str, ...] = ()
    rmse_db: float = math.nan
    rmse_with_db: float = math.nan
    gain: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Fit:
    """An offset and the RMSE with it [dB]."""

    offset_db: float
    rmse_db: float


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelLevel:
    """Another simulation of the same samples: level (n,) [dBm] and its own best offset."""

    level_dbm: FloatArray
    offset_db: float
    rmse_db: float
    rmse_ci95_db: Interval


@dataclass(frozen=True, slots=True, kw_only=True)
class SnrScore:
    """The error of a signal-to-noise ratio of the replay over thermal noise, without fitted values, over ``n`` samples.

    ``noise_dbm`` is k T B with the noise figure. ``mean_error_db`` is measured minus predicted. The RMSE of the
    comparison is the error without this mean.
    """

    noise_dbm: float
    rmse_db: float
    mean_error_db: float
    n: int


@dataclass(frozen=True, slots=True, kw_only=True)
class RssFurther:
    """Numbers of a tower and channel other than offset, RMSE and correlation, with their names in metrics.json.

    A field without a default is always written, and one whose default is None only if the flight has it. ``n_flagged``
    is by reason. ``compared_with`` contains, by the name of each baseline and other assumption, whether the replay is
    better or worse on the same samples. ``averaged`` is by simulation and window. ``n_outliers`` samples are far
    outside the distribution of the levels of the channel; only ``rmse_without_outliers_db`` excludes them.
    The other counts are those of :class:`~aerpaw_cmp.compare.level.RssComparison`.
    """

    n_measured_out: int
    n_simulated_out: int
    n_too_low: int
    n_no_pose: int
    n_outliers: int
    rmse_without_outliers_db: float
    n_flagged: Mapping[str, int]
    clock: ClockResult | None
    baseline_rmse_ci95_db: Mapping[str, Interval]
    compared_with: Mapping[str, PairedDifference]
    averaged: Mapping[str, Mapping[str, Fit]]
    detection: DetectionScore | None = None
    """Scores of the detection, for a receiver that loses its lock or ends at a floor."""
    snr: SnrScore | None = None
    """Error of a signal-to-noise ratio, for a receiver whose bandwidth is known."""
    rmse_bound: str | None = None
    """Reason why the interval of the RMSE is only a lower bound. None for a complete interval."""
    interval_notes: tuple[str, ...] | None = None
    """Sentences about limits of the intervals: no correlation over place, an error that is not stationary."""
    simulated_sd_db: float | None = None
    """Mean stated SD of one sample with learned antennas: gain, nuisance of the flight, noise, fading [dB]."""
    error_bars: Mapping[str, float] | None = None
    """Parts of that standard deviation [dB], and the shares of samples inside the stated 50, 90 and 95 % intervals."""
    elsewhere: Mapping[str, Any] | None = None
    """Errors of learned antennas on held-out flights of a ``kind`` [dB]: RMSE, that of free space, and of 4 s means."""
    trained_on: tuple[str, ...] | None = None
    """SHA-256 of the logs of this series from which its antennas or settings were learned. It then has no error."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RssResult:
    """The RSS of one tower and channel, measured and simulated.

    Parameters
    ----------
    tower, channel, unit : str
        ``unit`` is that of the measurement before the offset: ``"dBm"`` or ``"dB re full scale"``.
    time : (n,) datetime64[ns]
    measured_db, simulated_dbm : (n,)
        Levels before the offset; NaN without a signal or a path, or if the pose is unknown or too low.
    posed : (n,) bool
        True for samples with a known pose above the lowest height, which are compared.
    position_m : (n, 3)
        Position in the site frame; NaN if the pose is unknown.
    line_of_sight : (n,)
        1 with a line of sight, 0 without, NaN without a pose.
    geometry : mapping of str to (n,)
        Distance [m] and angles [deg] of the link, by name with unit.
    score : RssComparison
        Offset, RMSE, correlation and their intervals.
    baselines : mapping of str to ModelLevel
        Free space, two-ray and lines.
    spans : tuple of ErrorSpan
        Segments with the largest errors.
    further : RssFurther
    """

    tower: str
    channel: str
    unit: str
    time: AnyArray
    measured_db: FloatArray
    simulated_dbm: FloatArray
    posed: BoolArray
    position_m: FloatArray
    line_of_sight: FloatArray
    geometry: Mapping[str, FloatArray]
    score: RssComparison
    baselines: Mapping[str, ModelLevel]
    spans: tuple[ErrorSpan, ...]
    further: RssFurther
    stated: StatedSpread | None = None
    """Stated standard deviations of the simulated level with learned antennas."""
    tower_m: FloatArray | None = None
    """Position of a tower that moves, shape (n, 3) [m], NaN if unknown. None for a fixed tower."""

    @property
    def name(self) -> str:
        """Tower and channel as one label."""
        return f"{self.tower} {self.channel}".strip()

    @property
    def training(self) -> bool:
        """True if the antennas were learned from the logs of this series, which then has no error."""
        return bool(self.further.trained_on)

    @property
    def clock_verdict(self) -> str:
        """Verdict about the radio clock. Empty if none was estimated."""
        return "" if self.further.clock is None else self.further.clock.verdict

    @property
    def measured_out_of_coverage(self) -> BoolArray:
        """Posed samples (n,) without a measured signal."""
        return self.posed & ~np.isfinite(self.measured_db)

    @property
    def simulated_out_of_coverage(self) -> BoolArray:
        """Posed samples (n,) without a path."""
        return self.posed & ~np.isfinite(self.simulated_dbm)

    @property
    def calibrated_db(self) -> FloatArray:
        """Measurement plus offset (n,), comparable with ``simulated_dbm``."""
        return self.measured_db + self.score.offset_db

    @property
    def residual_db(self) -> FloatArray:
        """Measurement plus offset minus simulation (n,). NaN if a side is missing or was learned on this flight."""
        if LEARNED_HERE in self.score.fitted_on_scored:
            # a series is not scored on its own training data
            return np.full(len(self.time), np.nan)
        return self.calibrated_db - self.simulated_dbm


@dataclass(frozen=True, slots=True, kw_only=True)
class PairResult:
    """Two channels of one tower at their common times ``time`` (n,)."""

    tower: str
    first: str
    second: str
    time: AnyArray
    score: ChannelDifference


@dataclass(frozen=True, slots=True, kw_only=True)
class RankFurther:
    """Numbers of the rank of a tower other than those of :class:`~aerpaw_cmp.compare.rank.RankComparison`.

    ``n_flagged`` is by reason, ``foliage`` by run and K. ``commonest`` is the constant forecast. ``repeat`` is the
    agreement of the modem with itself where the second half of the flight repeats positions of the first half.
    """

    n_flagged: Mapping[str, int]
    kappa_ci95: Mapping[str, Interval]
    commonest: CommonestRank
    repeat: Mapping[str, RankRepeat]
    receiver: ForecastScore | None = None
    trained_on: tuple[str, ...] | None = None
    """SHA-256 of the logs on which the receiver was fitted. It then has no score."""
    agreement_sd_by_ground: Mapping[str, float] | None = None
    """Standard deviation of the agreement by K, over grounds within the errors of the known heights."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RankResult:
    """The rank of one tower: reported by the modem, and simulated for each K, over the compared samples.

    Parameters
    ----------
    tower : str
    n_samples : int
        Samples of the log. Samples that are too low or have no pose are not part of the following arrays.
    time : (n,) datetime64[ns]
    position_m : (n, 3)
    measured : (n,)
        Reported rank; NaN without CSI.
    sinr_db : (n,), optional
    sigma : (n, min(n_rx, n_tx))
        Singular values of the simulated channels, descending.
    level_dbm : (n,)
        Simulated level; NaN without a path.
    probability : (n, 4), optional
        Probability of rank 1 to 4 by the fitted receiver of ``rank.receiver``.
    rank : mapping of float to (n,) int
        Simulated rank per K; 0 without a path.
    score : RankComparison
    further : RankFurther
    """

    tower: str
    n_samples: int
    time: AnyArray
    position_m: FloatArray
    measured: FloatArray
    sinr_db: FloatArray | None
    sigma: FloatArray
    level_dbm: FloatArray
    rank: Mapping[float, IntArray]
    score: RankComparison
    further: RankFurther
    probability: FloatArray | None = None
    tower_m: FloatArray | None = None
    """Position of a tower that moves, shape (n, 3) [m]. None for a fixed tower."""

    @property
    def singular_ratio_db(self) -> FloatArray:
        """Second to last singular value divided by the first, shape (n, m - 1) [dB], which explains a rank."""
        with np.errstate(invalid="ignore"):  # 0 / 0 without a channel
            return db_from_amplitude(self.sigma[:, 1:] / self.sigma[:, :1])


@dataclass(frozen=True, slots=True, kw_only=True)
class AuditResult:
    """The check of the engine against another one on a spread of links of all series."""

    reference: str
    links: int
    missing_paths: int
    extra_paths: int
    rss_max_error_db: float
    rank_disagreement: Mapping[float, float] = field(default_factory=dict)
    seconds: float = float("nan")
    reference_seconds: float = float("nan")
    note: str = ""
    fields: FieldAudit | None = None
    """Check of fields, paths and attitude against the coefficients of Sionna RT and a second implementation."""
    read_from_cache_of: str = ""
    """Day on which this machine computed the audit, if it comes from the cache."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EngineResult:
    """The engine that replayed the flight, its time, its omissions, and its audit.

    ``not_audited`` is the reason why Sionna RT could not audit it, and empty otherwise.
    """

    engine: str
    links: int
    seconds: float
    paths: int | None = None
    settings: Mapping[str, object] = field(default_factory=dict)
    left_out: tuple[str, ...] = ()
    audit: AuditResult | None = None
    not_audited: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightVerdict:
    """The comparison of ray tracing with the best baseline ``against``, over all channels of a flight.

    ``difference_db`` is the RMSE of ray tracing minus that of the baseline, each channel after its own offset, so it is
    negative if ray tracing is better. Levels of a receiver that lost its lock count as its floor.
    """

    against: str
    rmse_db: float
    baseline_rmse_db: float
    difference_db: float
    ci95_db: Interval
    channels: int


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightResult:
    """The results of one flight. Empty for series that the flight does not have.

    ``models`` has one row per model over all channels, ``ladder`` one row per model, tower and channel. Both are empty
    if no models were compared.
    """

    rss: tuple[RssResult, ...] = ()
    rank: tuple[RankResult, ...] = ()
    pairs: tuple[PairResult, ...] = ()
    engine: EngineResult | None = None
    serving: ServingComparison | None = None
    models: tuple[ModelRow, ...] = ()
    ladder: tuple[LadderRow, ...] = ()
    verdict: FlightVerdict | None = None
    """The comparison with the best baseline over all channels. None if nothing could be scored."""
    likely_cause: Cause | None = None
    """The systematic error that explains most of the RMSE. None if none is identified."""
    next_step: str | None = None
    """The next step of the user, a clause. None if no known step changes the result."""

    @property
    def cause(self) -> str | None:
        """The sentence of the likely cause. None if none is identified."""
        return None if self.likely_cause is None else self.likely_cause.sentence

    @property
    def clocks(self) -> dict[str, ClockResult]:
        """One clock per receiver."""
        return {clock.receiver: clock for item in self.rss if (clock := item.further.clock) is not None}

    @property
    def series(self) -> tuple[RssResult | RankResult, ...]:
        """Levels, then ranks."""
        return (*self.rss, *self.rank)
