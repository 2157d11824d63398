"""The numbers of one comparison: what the comparison stage gives, and report, campaign and JSON take from.

Nothing here is computed, drawn or formatted. Times are naive ``datetime64[ns]`` in UTC, a missing number is NaN, a
number that a flight cannot have is None.

A new number of a tower and channel takes one field of :class:`RssFurther` (of the rank: :class:`RankFurther`) and one
function beside those that fill its neighbours: metrics.json and the tables of the report list its fields by name.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from ..common.units import AnyArray, BoolArray, FloatArray, IntArray, Printed, db_from_amplitude
from .causes import Cause
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

# Models that a replay is held against, with their names in words; the last two know no physics.
BASELINE_TITLE = {
    "free_space": "free space",
    "two_ray": "two-ray ground",
    "log_distance": "log-distance line",
    "constant": "constant level",
}

# What was done with a clock: corrected by the estimate, asked to be and not, not asked to be; corrected as stated.
APPLIED, NOT_APPLIED, ESTIMATED, GIVEN = (
    "estimated and applied", "asked for, not applied", "estimated, not applied", "given in flight.yaml"
)  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockResult:
    """Radio clock of a receiver (a tower) against the telemetry clock, as far as it is a number.

    ``radio_minus_telemetry_s`` is positive where the radio's clock shows later times; subtracting it corrects them.
    ``applied`` is one of the words above, ``checks`` what the verdict rests on, by name.
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
        """True of a clock that is wrong and was not corrected."""
        return self.verdict == "shifted" and self.applied != APPLIED

    @property
    def in_words(self) -> str:
        """Its lag with the interval, as every sentence has them."""
        ends = "[{:+.2f}, {:+.2f}]".format(*map(Printed, self.ci95_s))
        side = "ahead of" if self.radio_minus_telemetry_s > 0 else "behind"
        return f"{abs(self.radio_minus_telemetry_s):.2f} s {side} the telemetry clock {ends}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Fit:
    """An offset and what it leaves [dB]."""

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
    """A ratio to the noise against the replay's level over thermal noise, nothing fitted, over ``n`` samples.

    ``noise_dbm`` is k T B with the noise figure; ``mean_error_db`` is measured minus predicted, and what is left of the
    error without that mean is the comparison's RMSE.
    """

    noise_dbm: float
    rmse_db: float
    mean_error_db: float
    n: int


@dataclass(frozen=True, slots=True, kw_only=True)
class RssFurther:
    """Numbers of a tower and channel beside offset, RMSE and correlation, as metrics.json names them.

    A field without a default is always written; one whose default is None only where the flight has it.
    ``n_flagged`` is by reason; ``compared_with`` says by the name of each baseline and of each other assumption whether
    the replay is better or worse on the same samples; ``averaged`` is by simulation and window.
    ``n_outliers`` samples lie far outside the distribution of the channel's own levels: they count in all numbers but
    ``rmse_without_outliers_db``. ``identifiable_db``, ``block_length`` and the other counts are those of
    :class:`~aerpaw_cmp.compare.level.RssComparison`.
    """

    n_measured_out: int
    n_simulated_out: int
    block_length: int
    identifiable_db: Interval
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
    """Of a receiver that loses its lock or ends at a floor."""
    snr: SnrScore | None = None
    """Of a ratio to the noise whose receiver's bandwidth is given."""
    rmse_bound: str | None = None
    """Reason why the interval of the RMSE is a lower bound alone, where it is."""
    interval_notes: tuple[str, ...] | None = None
    """Sentences on what limits the intervals: no correlation over place, an error that is not stationary."""
    simulated_sd_db: float | None = None
    """Mean of what learned antennas state for one sample: gain, the flight's own nuisance, noise, fading."""
    error_bars: Mapping[str, float] | None = None
    """Its parts [dB], and the share of samples that the stated 50, 90 and 95 % intervals contain here."""
    elsewhere: Mapping[str, float] | None = None
    """Of learned antennas: RMSE [dB] on flights left out, of the same with free space, and of means over 4 s."""
    trained_on: tuple[str, ...] | None = None
    """SHA-256 of the logs of this series that its antennas or settings were learned from: then no error is given."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RssResult:
    """RSS of one tower and channel, measured against simulated.

    Parameters
    ----------
    tower, channel, unit : str
        ``unit`` of the measurement before the offset: ``"dBm"`` or ``"dB re full scale"``.
    time : (n,) datetime64[ns]
    measured_db, simulated_dbm : (n,)
        Before the offset; NaN without a signal, without a path, or where the pose is unknown or too low.
    posed : (n,) bool
        Samples with a known pose above the lowest height: the others belong to no comparison.
    position_m : (n, 3)
        In the site frame; NaN where no pose is known.
    line_of_sight : (n,)
        1, 0, NaN without a pose.
    geometry : mapping of str to (n,)
        Distance [m] and angles [deg] of the link, by name with unit.
    score : RssComparison
        Offset, RMSE, correlation and their intervals.
    baselines : mapping of str to ModelLevel
        Free space, two-ray and lines.
    spans : tuple of ErrorSpan
        Stretches with the largest errors.
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
    """Error bars of the simulated level that learned antennas state."""
    tower_m: FloatArray | None = None
    """Place (n, 3) of a tower that moves, NaN where it is not known [m]; None of one that stands."""

    @property
    def name(self) -> str:
        """Tower and channel as one label."""
        return f"{self.tower} {self.channel}".strip()

    @property
    def training(self) -> bool:
        """True if the antennas were learned from the very logs of this series: no error is given then."""
        return bool(self.further.trained_on)

    @property
    def clock_verdict(self) -> str:
        """Verdict on the radio clock; empty where none was estimated."""
        return "" if self.further.clock is None else self.further.clock.verdict

    @property
    def measured_out_of_coverage(self) -> BoolArray:
        """Posed samples (n,) without a measured signal."""
        return self.posed & ~np.isfinite(self.measured_db)

    @property
    def simulated_out_of_coverage(self) -> BoolArray:
        """Posed samples (n,) without a path: ``Z`` in the plots."""
        return self.posed & ~np.isfinite(self.simulated_dbm)

    @property
    def calibrated_db(self) -> FloatArray:
        """Measurement plus offset (n,), comparable with ``simulated_dbm``."""
        return self.measured_db + self.score.offset_db

    @property
    def residual_db(self) -> FloatArray:
        """Calibrated measurement minus simulation (n,); NaN where a side is missing, or was learned on this flight."""
        if LEARNED_HERE in self.score.fitted_on_scored:
            # nothing that was learned here is scored here
            return np.full(len(self.time), np.nan)
        return self.calibrated_db - self.simulated_dbm


@dataclass(frozen=True, slots=True, kw_only=True)
class PairResult:
    """Two channels of one tower at their common instants ``time`` (n,)."""

    tower: str
    first: str
    second: str
    time: AnyArray
    score: ChannelDifference


@dataclass(frozen=True, slots=True, kw_only=True)
class RankFurther:
    """Numbers of a tower's rank beside those of :class:`~aerpaw_cmp.compare.rank.RankComparison`.

    ``n_flagged`` is by reason, ``foliage`` by run and K. ``commonest`` is the forecast that needs no model; ``repeat``
    is how well the modem agrees with itself where the second half of the flight passes places of the first.
    """

    n_flagged: Mapping[str, int]
    kappa_ci95: Mapping[str, Interval]
    commonest: CommonestRank
    repeat: Mapping[str, RankRepeat]
    receiver: ForecastScore | None = None
    trained_on: tuple[str, ...] | None = None
    """SHA-256 of the logs of these reports that the receiver was fitted on: then it has no score."""
    agreement_sd_by_ground: Mapping[str, float] | None = None
    """Standard deviation of the agreement, by K, over grounds within the errors of the known heights."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RankResult:
    """Rank of one tower: what the modem reported against what each K says, over the samples that are compared.

    Parameters
    ----------
    tower : str
    n_samples : int
        Of the log; those too low or without a pose are left out of what follows.
    time : (n,) datetime64[ns]
    position_m : (n, 3)
    measured : (n,)
        NaN: no CSI.
    sinr_db : (n,), optional
    sigma : (n, min(n_rx, n_tx))
        Singular values of the simulated channels, falling, relative to a scale of each channel.
    level_dbm : (n,)
        Simulated level, NaN without a path.
    probability : (n, 4), optional
        Of rank 1 to 4, by the fitted receiver that ``rank.receiver`` names.
    rank : mapping of float to (n,) int
        Simulated, per K; 0: no path.
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
    """Place (n, 3) of a tower that moves [m]; None of one that stands."""

    @property
    def singular_ratio_db(self) -> FloatArray:
        """Second to last singular value over the first (n, m - 1) [dB]: why a rank is what it is."""
        with np.errstate(invalid="ignore"):  # no channel: 0 / 0
            return db_from_amplitude(self.sigma[:, 1:] / self.sigma[:, :1])


@dataclass(frozen=True, slots=True, kw_only=True)
class AuditResult:
    """The engine checked against another one on a spread of links of all series."""

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
    """Fields, paths and attitude against Sionna's own coefficients and a second implementation."""
    read_from_cache_of: str = ""
    """Day on which this machine made it, where its inputs are those of that day."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EngineResult:
    """Engine that replayed the flight, its price, the things that it left out, and its audit.

    ``not_audited`` is the reason why Sionna RT could not audit it, empty where it did or was not asked to.
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
    """Ray tracing against the best baseline ``against``, over all channels of a flight at once.

    ``difference_db`` is its RMSE minus that of the baseline, each channel after its own offset: negative where ray
    tracing is better. Levels of a receiver that lost its lock count with its floor.
    """

    against: str
    rmse_db: float
    baseline_rmse_db: float
    difference_db: float
    ci95_db: Interval
    channels: int


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightResult:
    """The results of one flight; empty for series that the flight does not have.

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
    """The comparison with the best baseline over all channels; None if nothing could be scored."""
    likely_cause: Cause | None = None
    """The systematic error that explains most of the RMSE; None if none is identified."""
    next_step: str | None = None
    """The next step of the user, a clause; None if no known step changes the result."""

    @property
    def cause(self) -> str | None:
        """The sentence of the likely cause; None if none is identified."""
        return None if self.likely_cause is None else self.likely_cause.sentence

    @property
    def clocks(self) -> dict[str, ClockResult]:
        """One clock per receiver."""
        return {clock.receiver: clock for item in self.rss if (clock := item.further.clock) is not None}

    @property
    def series(self) -> tuple[RssResult | RankResult, ...]:
        """Levels, then ranks."""
        return (*self.rss, *self.rank)
