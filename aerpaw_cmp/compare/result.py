"""The results of one comparison, which reports, campaigns and JSON use.

This module only stores numbers; it does not compute, draw or format them. Times are naive ``datetime64[ns]`` in UTC. A
missing number is NaN, and a field that does not apply to a flight is None.

To add a number per tower and channel, add a field to :class:`RssFurther` (for ranks: :class:`RankFurther`) and a
function that computes it. Both metrics.json and the tables of the report use the names of the fields.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..common.units import AnyArray, BoolArray, FloatArray, IntArray, Printed, db_from_amplitude
from . import level
from .gains import StatedSpread
from .ladder import ModelRow
from .offset import OffsetFit
from .rank import CommonestRank, RankComparison, RankRepeat
from .receiver import ForecastScore
from .statistics import Interval, PairedDifference

# Models with which a replay is compared, and their titles. The last two do not model propagation.
BASELINE_TITLE = {
    "free_space": "free space",
    "two_ray": "two-ray ground",
    "log_distance": "log-distance line",
    "constant": "constant level",
}

# Verdicts on a clock.
OK, SHIFTED, CANNOT_TELL = "ok", "shifted", "cannot tell"

# States of a clock: corrected by the estimate, not corrected although requested, only estimated, or corrected by a
# value of the flight file.
APPLIED, NOT_APPLIED, ESTIMATED, GIVEN = (
    "estimated and applied", "asked for, not applied", "estimated, not applied", "given in flight.yaml"
)  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockResult:
    """The radio clock of a receiver (a tower) compared with the telemetry clock.

    ``radio_minus_telemetry_s`` is positive if the radio clock shows later times. Radio times are corrected by
    subtracting it. ``applied`` is one of the states :data:`APPLIED`, :data:`NOT_APPLIED`, :data:`ESTIMATED` and
    :data:`GIVEN`. ``checks`` contains the results of the tests behind the verdict, by name.
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
        return self.verdict == SHIFTED and self.applied != APPLIED

    @property
    def in_words(self) -> str:
        """The lag with its interval as text."""
        ends = "[{:+.2f}, {:+.2f}]".format(*map(Printed, self.ci95_s))
        side = "ahead of" if self.radio_minus_telemetry_s > 0 else "behind"
        return f"{abs(self.radio_minus_telemetry_s):.2f} s {side} the telemetry clock {ends}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Cause:
    """A possible cause of the error of a flight.

    Parameters
    ----------
    name : str
    sentence : str
        Sentence with channels, numbers, and the RMSE without and with the cause.
    next_step : str
        Next step of the user, as a clause.
    estimate, ci95 : float, (low, high)
        Size of the cause (lag [s], angle [deg], height [m], or loss, floor or step [dB]) and its interval. NaN for
        causes without a size.
    channels : sequence of str
        Channels that show the cause.
    rmse_db, rmse_with_db : float
        RMSE of 1-s means of these channels without and with the cause [dB].
    gain : float
        Log odds of all explanations with the cause against all explanations without it.
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
class ModelLevel:
    """Another simulation of the same samples: its level (n,) [dBm], and the best offset for this level."""

    level_dbm: FloatArray
    offset_db: float
    rmse_db: float
    rmse_ci95_db: Interval


@dataclass(frozen=True, slots=True, kw_only=True)
class SnrScore:
    """The error of an SNR predicted from replay and thermal noise without fitted values, over ``n`` samples.

    ``noise_dbm`` is k T B plus the noise figure. ``mean_error_db`` is measured minus predicted. The RMSE of the
    comparison is the error after subtracting this mean.
    """

    noise_dbm: float
    rmse_db: float
    mean_error_db: float
    n: int


@dataclass(frozen=True, slots=True, kw_only=True)
class RssFurther:
    """Further numbers of a tower and channel, in addition to ``RssComparison``. The names are the same in metrics.json.

    A field without a default is always written. A field whose default is None is written only if it applies to the
    flight. ``n_flagged`` counts samples by reason. ``compared_with`` contains, for each baseline and each other
    assumption, whether ray tracing is better or worse on the same samples. The keys of ``averaged`` are simulation and
    window. ``n_outliers`` counts samples far outside the distribution of the levels of the channel; only
    ``rmse_without_outliers_db`` excludes these samples. The other counts are the counts of
    :class:`~aerpaw_cmp.compare.level.RssComparison`.

    Parameters
    ----------
    detection : DetectionScore, optional
        Scores of the detection, for a receiver that loses its lock or has a floor.
    snr : SnrScore, optional
        Error of the SNR, for a receiver whose bandwidth is known.
    rmse_bound : str, optional
        Reason why the interval of the RMSE is only a lower bound. None if it is an ordinary interval.
    interval_notes : tuple of str, optional
        Sentences about limits of the intervals: correlation over position is ignored, or the error is not stationary.
    simulated_sd_db : float, optional
        Mean stated SD of a sample with learned antennas [dB], from gain, nuisance of the flight, noise and fading.
    error_bars : mapping of str to float, optional
        Parts of that standard deviation [dB], and the shares of samples inside the stated 50, 90 and 95 % intervals.
    elsewhere : mapping, optional
        Errors of learned antennas on held-out flights of a ``kind`` [dB]: RMSE, RMSE of free space, RMSE of 4-s means.
    trained_on : tuple of str, optional
        SHA-256 of the logs of this series from which its antennas or settings were learned. A series with such logs is
        not scored.
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
    averaged: Mapping[str, Mapping[str, OffsetFit]]
    detection: level.DetectionScore | None = None
    snr: SnrScore | None = None
    rmse_bound: str | None = None
    interval_notes: tuple[str, ...] | None = None
    simulated_sd_db: float | None = None
    error_bars: Mapping[str, float] | None = None
    elsewhere: Mapping[str, Any] | None = None
    trained_on: tuple[str, ...] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class RssResult:
    """The RSS of one tower and channel, measured and simulated.

    Parameters
    ----------
    tower, channel, unit : str
        ``unit`` is the unit of the measurement before the offset: ``"dBm"`` or ``"dB re full scale"``.
    time : (n,) datetime64[ns]
    measured_db, simulated_dbm : (n,)
        Levels before the offset. NaN if there is no signal or path, or if the pose is unknown or too low.
    posed : (n,) bool
        True for compared samples: the pose is known and not below the lowest height.
    position_m : (n, 3)
        Position in the site frame; NaN if the pose is unknown.
    line_of_sight : (n,)
        1 with a line of sight, 0 without it, NaN if the pose is unknown.
    geometry : mapping of str to (n,)
        Distance [m] and angles [deg] of the link, by name with unit.
    score : RssComparison
        Offset, RMSE, correlation and their intervals.
    baselines : mapping of str to ModelLevel
        Free space, two-ray and lines.
    spans : tuple of ErrorSpan
        Segments with the largest errors.
    further : RssFurther
    stated : StatedSpread, optional
        Stated standard deviations of the simulated level with learned antennas.
    tower_m : (n, 3), optional
        Position of a tower that moves [m], NaN if unknown. None for a fixed tower.
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
    score: level.RssComparison
    baselines: Mapping[str, ModelLevel]
    spans: tuple[level.ErrorSpan, ...]
    further: RssFurther
    stated: StatedSpread | None = None
    tower_m: FloatArray | None = None

    @property
    def name(self) -> str:
        """Tower and channel as one label."""
        return f"{self.tower} {self.channel}".strip()

    @property
    def training(self) -> bool:
        """True if the antennas were learned from the logs of this series. A series with such antennas is not scored."""
        return bool(self.further.trained_on)

    @property
    def clock_verdict(self) -> str:
        """Verdict about the radio clock. Empty if no clock was estimated."""
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
        """Measurement plus offset minus simulation (n,). NaN if either is missing, and for a training flight."""
        if level.LEARNED_HERE in self.score.fitted_on_scored:
            # a series is not scored on its own training data
            return np.full(len(self.time), np.nan)
        return self.calibrated_db - self.simulated_dbm


@dataclass(frozen=True, slots=True, kw_only=True)
class PairResult:
    """Comparison of two channels of one tower at their common times ``time`` (n,)."""

    tower: str
    first: str
    second: str
    time: AnyArray
    score: level.ChannelDifference


@dataclass(frozen=True, slots=True, kw_only=True)
class RankFurther:
    """Further numbers of the rank at a tower, in addition to :class:`~aerpaw_cmp.compare.rank.RankComparison`.

    ``n_flagged`` counts samples by reason. The keys of ``foliage`` are foliage model and K. ``commonest`` is the score
    of the constant forecast. ``repeat`` is the agreement between the modem's reports at positions that both halves of
    the flight visit.

    Parameters
    ----------
    trained_on : tuple of str, optional
        SHA-256 of the logs of this series to which the receiver was fitted. Such a series has no score.
    agreement_sd_by_ground : mapping of str to float, optional
        Standard deviation of the agreement, by K, if the ground heights are varied within their errors.
    """

    n_flagged: Mapping[str, int]
    kappa_ci95: Mapping[str, Interval]
    commonest: CommonestRank
    repeat: Mapping[str, RankRepeat]
    receiver: ForecastScore | None = None
    trained_on: tuple[str, ...] | None = None
    agreement_sd_by_ground: Mapping[str, float] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class RankResult:
    """The rank at one tower over the compared samples: reported by the modem, and simulated for each K.

    Parameters
    ----------
    tower : str
    n_samples : int
        Number of samples in the log. The following arrays omit samples that are too low or have no pose.
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
        Probability of ranks 1 to 4 from the receiver in ``rank.receiver``.
    rank : mapping of float to (n,) int
        Simulated rank per K; 0 without a path.
    score : RankComparison
    further : RankFurther
    tower_m : (n, 3), optional
        Position of a tower that moves [m]. None for a fixed tower.
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

    @property
    def singular_ratio_db(self) -> FloatArray:
        """Ratios of all other singular values to the first, shape (n, m - 1) [dB]. These ratios determine the rank."""
        with np.errstate(invalid="ignore"):  # without a channel, the ratio is 0 / 0
            return db_from_amplitude(self.sigma[:, 1:] / self.sigma[:, :1])


@dataclass(frozen=True, slots=True, kw_only=True)
class AuditResult:
    """The check of the engine against another engine, on links spread over all series.

    Parameters
    ----------
    fields : FieldAudit, optional
        Check of fields, paths and attitude against Sionna RT's coefficients and a second implementation.
    read_from_cache_of : str
        Date on which the audit was computed on this machine, if it comes from the cache. Otherwise empty.
    """

    reference: str
    links: int
    missing_paths: int
    extra_paths: int
    rss_max_error_db: float
    rank_disagreement: Mapping[float, float] = field(default_factory=dict)
    seconds: float = float("nan")
    reference_seconds: float = float("nan")
    note: str = ""
    fields: level.FieldAudit | None = None
    read_from_cache_of: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class EngineResult:
    """The engine that replayed the flight, with its computing time, its omissions and its audit.

    ``not_audited`` is the reason why Sionna RT could not audit the engine. The text is empty after an audit.
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

    ``difference_db`` is the RMSE of ray tracing minus that of the baseline, with one offset per channel. A negative
    value means that ray tracing is better. If a receiver lost its lock, its levels without lock count as its floor.
    """

    against: str
    rmse_db: float
    baseline_rmse_db: float
    difference_db: float
    ci95_db: Interval
    channels: int


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightResult:
    """The results of one flight. A field is empty if the flight does not have the logs that the field requires.

    ``models`` has one row per model over all channels, ``ladder`` one row per model, tower and channel. Both tables are
    empty if no models were compared.

    Parameters
    ----------
    verdict : FlightVerdict, optional
        The comparison with the best baseline over all channels. None if no channel could be scored.
    likely_cause : Cause, optional
        The systematic error that explains most of the RMSE. None if none is identified.
    next_step : str, optional
        The next step of the user, as a clause. None if no known step would change the result.
    """

    rss: tuple[RssResult, ...] = ()
    rank: tuple[RankResult, ...] = ()
    pairs: tuple[PairResult, ...] = ()
    engine: EngineResult | None = None
    serving: level.ServingComparison | None = None
    models: tuple[ModelRow, ...] = ()
    ladder: tuple[ModelRow, ...] = ()
    verdict: FlightVerdict | None = None
    likely_cause: Cause | None = None
    next_step: str | None = None

    @property
    def cause(self) -> str | None:
        """The sentence of the likely cause. None if none is identified."""
        return None if self.likely_cause is None else self.likely_cause.sentence

    @property
    def clocks(self) -> dict[str, ClockResult]:
        """The comparison of each receiver's clock with telemetry, by receiver."""
        return {clock.receiver: clock for item in self.rss if (clock := item.further.clock) is not None}

    @property
    def series(self) -> tuple[RssResult | RankResult, ...]:
        """All compared series: levels, then ranks."""
        return (*self.rss, *self.rank)
