"""Comparison of measured levels with predictions: RSS, detection, serving cells and scores.

The functions take arrays in time order, with one value per sample and NaN for a missing value. No function depends on
files, sites or engines.

The module compares the measured and simulated signal strength of one tower and channel, and scores predictions after a
flight and the entries of benchmarks/published. Further functions model receivers that lose the signal or have a floor,
compare the predicted strongest cell with the serving cell of a phone, and sum the results of field audits.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ndtr  # every report loads this module, and scipy.stats takes 0.4 s

from ..common.geodesy import azimuth_rad, bearing_deg, elevation_rad
from ..common.units import AnyArray, BoolArray, FloatArray, IntArray, db_from_power, power_from_db, unmasked
from .offset import SPAN_DB, OffsetFit, grid_offset, offset_grid
from .receiver import brier_losses, log_losses, out_of_group
from .statistics import NO_INTERVAL, ErrorIntervals, Interval, correlation, error_intervals, rmse_interval

# Two channels of one receiver differ if the difference of their levels deviates from its mean by more than this [dB].
PART_DB = 10.0
# Averaging time of the difference of two channels [s].
_PART_S = 1.0


def seconds(time: ArrayLike) -> FloatArray:
    """Return the seconds since the first time. The input is datetime64 or seconds."""
    array = np.asarray(time)
    if array.dtype.kind == "M":
        stamp = array.astype("datetime64[ns]")
        known = stamp[~np.isnat(stamp)]
        first = known.min() if len(known) else np.datetime64(0, "ns")
        return np.asarray((stamp - first) / np.timedelta64(1, "s"), dtype=np.float64)
    return np.asarray(array, dtype=np.float64)


@dataclass(frozen=True, slots=True)
class RssComparison:
    """The comparison of a simulation with the measured level of one link.

    Parameters
    ----------
    offset_db, rmse_db : float
        Offset from a grid search, added to the measurement, and RMSE with this offset [dB].
    n : int
        Number of compared pairs.
    n_out_of_coverage, n_measured_out, n_simulated_out : int
        Numbers of samples with a known pose that are out of coverage: in at least one of measurement and simulation, in
        the measurement (no signal), and in the simulation (no path).
    n_no_pose : int
        Number of samples without a pose, which are not compared.
    at_edge : bool
        True if the offset is at the edge of the search range.
    correlation : float
        Pearson correlation; NaN for constant series.
    intervals : ErrorIntervals
        95 % intervals, and the number of independent samples.
    baselines : mapping of str to OffsetFit
        Simpler models such as free space and two-ray, each with its own offset, on the same pairs.
    baseline_intervals : mapping of str to (low, high)
        95 % interval of each baseline's RMSE [dB].
    lag_s : float
        Applied clock lag [s]; NaN if none was estimated or applied.
    fitted_on_scored : tuple of str
        Names of the parameters that were fitted to the scored samples.
    residual_db : (samples,)
        ``measured + offset - simulated``, NaN without a pair.
    """

    offset_db: float
    rmse_db: float
    n: int
    n_out_of_coverage: int
    n_measured_out: int
    n_simulated_out: int
    n_no_pose: int
    at_edge: bool
    correlation: float
    intervals: ErrorIntervals
    baselines: Mapping[str, OffsetFit]
    baseline_intervals: Mapping[str, Interval]
    residual_db: FloatArray = field(repr=False)
    lag_s: float = float("nan")
    fitted_on_scored: tuple[str, ...] = ("offset_db",)

    @property
    def rmse_ci95_db(self) -> Interval:
        """95 % interval of the RMSE [dB]."""
        return self.intervals.rmse_db


def compare_rss(
    time_s: ArrayLike,
    measured_db: ArrayLike,
    simulated_db: ArrayLike,
    *,
    baselines: Mapping[str, ArrayLike] | None = None,
    posed: ArrayLike | None = None,
    position_m: FloatArray | None = None,
    span_db: tuple[float, float] = SPAN_DB,
) -> RssComparison:
    """Compare a measured with a simulated sequence of levels.

    Parameters
    ----------
    time_s : array_like, (n,)
        Times in seconds or datetime64. Samples are sorted by time; unknown times come last.
    measured_db : array_like, (n,)
        Measured level [dBm or dB re full scale]; NaN without a received signal.
    simulated_db : array_like, (n,)
        Simulated level [dB]; NaN without a path.
    baselines : mapping of str to array_like, (n,), optional
        Levels of simpler models at the same poses [dB].
    posed : array_like of bool, (n,), optional
        True if the pose of the sample is known. A sample without a pose is not out of coverage.
    position_m : (n, 3), optional
        East, north and up [m], NaN if unknown. With positions, intervals also allow for correlation over position.
    span_db : (float, float)
        Search range of the offset.

    Returns
    -------
    RssComparison
    """
    time, measured, simulated = seconds(time_s), _levels(measured_db), _levels(simulated_db)
    has_pose = np.ones(len(time), dtype=bool) if posed is None else np.asarray(posed, dtype=bool)
    use = has_pose & np.isfinite(measured) & np.isfinite(simulated)
    order = np.flatnonzero(use)[np.argsort(time[use], kind="stable")]
    m, s = measured[order], simulated[order]
    place = None if position_m is None else position_m[order]
    fit = _fit(m, s, span_db)
    simple = {name: _levels(levels)[order] for name, levels in (baselines or {}).items()}
    fits = {name: _fit(m, level, span_db) for name, level in simple.items()}
    return RssComparison(
        offset_db=fit.offset_db,
        rmse_db=fit.rmse_db,
        n=fit.n,
        at_edge=fit.at_edge,
        n_out_of_coverage=int((has_pose & ~use).sum()),
        n_measured_out=int((has_pose & ~np.isfinite(measured)).sum()),
        n_simulated_out=int((has_pose & ~np.isfinite(simulated)).sum()),
        n_no_pose=int((~has_pose).sum()),
        correlation=correlation(m, s),
        intervals=replace(error_intervals(m, s, place), rmse_db=_rmse_interval(m - s, fit, place)),
        baselines=fits,
        baseline_intervals={name: _rmse_interval(m - level, fits[name], place) for name, level in simple.items()},
        residual_db=np.where(use, measured + fit.offset_db - simulated, np.nan),
    )


def _fit(measured_db: FloatArray, simulated_db: FloatArray, span_db: tuple[float, float]) -> OffsetFit:
    # do not return an RMSE for one or two samples: an offset fits one sample exactly, and the RMSE of two samples is
    # half the difference of their errors
    fit = grid_offset(measured_db, simulated_db, span_db=span_db)
    return fit if fit.n > 2 else replace(fit, rmse_db=np.nan)


# Entry of ``fitted_on_scored`` for antennas that were learned from the scored flight.
LEARNED_HERE = "antennas"


def without_errors(score: RssComparison) -> RssComparison:
    """Return a comparison with only offset, counts and baselines, for a flight from which antennas were learned."""
    none = (float("nan"), float("nan"))
    return replace(
        score,
        rmse_db=float("nan"),
        correlation=float("nan"),
        intervals=replace(score.intervals, rmse_db=none, correlation=none),
        fitted_on_scored=(*score.fitted_on_scored, LEARNED_HERE),
    )


# Levels are outliers if they are more than this number of interquartile ranges outside the quartiles. In a normal
# distribution, one in 10^9 levels is an outlier by this rule. Deep fades of real flights are not that far outside.
_FENCE = 4.0

# Smallest interquartile range that is used [dB], because levels of a hovering UAV hardly vary.
_NARROWEST_DB = 5.0


def outliers(level_db: ArrayLike) -> BoolArray:
    """Return a mask (n,) of samples whose level is far outside the distribution of the flight.

    The caller flags these samples and does not drop them.

    Examples
    --------
    >>> outliers([-70.0, -72.0, -69.0, -71.0, -68.0, 99.0]).tolist()
    [False, False, False, False, False, True]
    """
    level = _levels(level_db)
    if not np.isfinite(level).any():
        return np.zeros(len(level), np.bool_)
    low, high = np.nanquantile(level, [0.25, 0.75])
    reach = _FENCE * max(high - low, _NARROWEST_DB)
    with np.errstate(invalid="ignore"):
        return np.asarray((level < low - reach) | (level > high + reach))


def _levels(values: ArrayLike) -> FloatArray:
    """Return levels as floats, with NaN for infinities (no power)."""
    array = unmasked(values)
    return np.where(np.isfinite(array), array, np.nan)


def _rmse_interval(difference: FloatArray, fit: OffsetFit, place_m: FloatArray | None) -> Interval:
    known = np.isfinite(difference)
    place = None if place_m is None else place_m[known]
    return rmse_interval(difference[known] + fit.offset_db, fit.rmse_db, place)


# --- measured and simulated levels averaged over the same window ----------------------------------------------------


def local_mean_db(time_s: ArrayLike, level_db: ArrayLike, window_s: float) -> FloatArray:
    """Return the moving average of power over a centred window.

    Parameters
    ----------
    time_s : array_like, (n,)
        Times, as seconds or datetime64, in any order.
    level_db : array_like, (n,)
        Levels [dB]. NaN is ignored and stays NaN.
    window_s : float
        Width of the window [s]. With 0, levels are returned unchanged.

    Notes
    -----
    Linear power is averaged, as in a receiver that integrates longer. Powers are summed relative to the strongest one,
    so that levels that differ by 100 dB within one window are accurate to 1e-6 dB.
    """
    time, level = seconds(time_s), _levels(level_db)
    known = np.isfinite(level) & np.isfinite(time)
    result, rows = np.full(len(level), np.nan), np.flatnonzero(known)[np.argsort(time[known], kind="stable")]
    if len(rows):
        # powers relative to the strongest level stay in range for any gain
        top = level[rows].max()
        result[rows] = db_from_power(_window_means(time[rows], power_from_db(level[rows] - top), window_s)) + top
    return result


def _window_means(time: FloatArray, values: FloatArray, window_s: float) -> FloatArray:
    """Return the means of values (n,) over windows centred at their ascending times (n,) [s]."""
    first = np.searchsorted(time, time - 0.5 * window_s, side="left")
    last = np.searchsorted(time, time + 0.5 * window_s, side="right")
    # sum each window separately, because differences of a cumulative sum lose precision for weak levels after strong
    # levels
    ends = np.column_stack([first, last]).ravel()
    return np.asarray(np.add.reduceat(np.append(values, 0.0), ends)[::2] / (last - first))


# --- geometry of the residual ---------------------------------------------------------------------------------


def link_geometry(
    tower_m: ArrayLike,
    position_m: FloatArray,
    rotation: FloatArray | None = None,
    *,
    tower_mount: FloatArray | None = None,
    uav_mount: FloatArray | None = None,
) -> dict[str, FloatArray]:
    """Return variables of the geometry on which the residual may depend, for each pose.

    Parameters
    ----------
    tower_m : (3,), (1, 3) or (n, 3)
        Centre of the tower's array, east-north-up [m]: one position, or one per pose if the tower moves.
    position_m : (n, 3)
        Position of the UAV, east-north-up [m].
    rotation : (n, 3, 3), optional
        Rotation from aircraft body to east-north-up.
    tower_mount, uav_mount : (3, 3), optional
        Rotation of each array relative to site axes (tower) or aircraft body (UAV). The default is the identity.

    Returns
    -------
    dict of str to ndarray (n,)
        ``distance_m``, ``elevation_deg`` and ``azimuth_deg`` of the UAV from the tower (clockwise from north).
        ``tower_azimuth_deg`` and ``tower_elevation_deg`` of the UAV in the tower's array frame (azimuth from its
        boresight towards its left). ``height_m`` of the UAV. If ``rotation`` is given, also ``heading_deg``, and
        ``uav_azimuth_deg`` and ``uav_elevation_deg`` of the tower in the UAV's array frame.

    Examples
    --------
    >>> found = link_geometry([0, 0, 10], np.array([[100.0, 0.0, 110.0]]))
    >>> found["azimuth_deg"].round(6).tolist(), found["elevation_deg"].round(6).tolist()
    ([90.0], [45.0])
    """
    place = np.asarray(position_m, dtype=np.float64)
    ray = place - unmasked(tower_m)
    columns = {
        "distance_m": np.linalg.norm(ray, axis=1),
        "elevation_deg": np.degrees(elevation_rad(ray)),
        "azimuth_deg": bearing_deg(ray) % 360.0,
        "height_m": place[:, 2],
    }
    in_array_frame = ray @ (np.eye(3) if tower_mount is None else tower_mount)
    columns["tower_azimuth_deg"], columns["tower_elevation_deg"] = _direction_deg(in_array_frame)
    if rotation is not None:
        body = np.einsum("nji,nj->ni", rotation, -ray)
        columns["uav_azimuth_deg"], columns["uav_elevation_deg"] = _direction_deg(
            body @ (np.eye(3) if uav_mount is None else uav_mount)
        )
        columns["heading_deg"] = bearing_deg(rotation[:, :, 0]) % 360.0
    return columns


def _direction_deg(vector: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return azimuth from x towards y and elevation above the x-y plane [deg]."""
    return np.degrees(azimuth_rad(vector)), np.degrees(elevation_rad(vector))


@dataclass(frozen=True, slots=True)
class ErrorSpan:
    """A segment of the flight with a large error of one sign.

    Parameters
    ----------
    start_s, end_s : float
        Start and end [s], as in the input, or relative to the first time of datetime64 input.
    n : int
        Samples.
    mean_db : float
        Mean residual [dB], positive if the measured level is stronger.
    position_m : tuple of float
        Mean east, north, up of the span [m]; empty if no positions were given.
    geometry : mapping of str to float
        Median over the segment of each quantity in ``context``.
    """

    start_s: float
    end_s: float
    n: int
    mean_db: float
    position_m: tuple[float, ...]
    geometry: Mapping[str, float] = field(default_factory=dict)


def error_spans(
    time_s: ArrayLike,
    residual_db: ArrayLike,
    *,
    position_m: FloatArray | None = None,
    context: Mapping[str, ArrayLike] | None = None,
    window_s: float = 2.0,
    threshold_db: float | None = None,
    largest: int = 10,
) -> list[ErrorSpan]:
    """Return the segments with the largest errors, ordered by mean error times the square root of the duration.

    Parameters
    ----------
    time_s, residual_db : array_like, (n,)
        Times and residual.
    position_m : (n, 3), optional
        East, north, up [m].
    context : mapping of str to array_like (n,), optional
        Geometry of the samples. Known names: ``los`` (bool), ``foliage_m``, ``elevation_deg`` (from the tower),
        ``height_m``, ``heading_deg``, ``coherent_minus_power_sum_db`` (depth of the simulated fades).
    window_s : float
        Averaging window of the residual [s].
    threshold_db : float, optional
        Smallest averaged residual of a segment. The default is 1.5 times the RMSE.
    largest : int
        Largest number of segments to return.

    Returns
    -------
    list of ErrorSpan
        Worst first.
    """
    time, residual = seconds(time_s), _levels(residual_db)
    ok = np.flatnonzero(np.isfinite(residual) & np.isfinite(time))
    ok = ok[np.argsort(time[ok], kind="stable")]
    if not len(ok):
        return []
    t, r = time[ok], residual[ok]
    smooth = _window_means(t, r, window_s)
    limit = 1.5 * float(np.sqrt(np.mean(r**2))) if threshold_db is None else threshold_db
    sign = np.where(smooth > limit, 1, np.where(smooth < -limit, -1, 0))
    # a gap longer than the window separates segments, because the error in the gap is unknown
    cut = (np.diff(sign) != 0) | (np.diff(t) > max(window_s, 1e-9))
    bounds = np.concatenate([[0], np.flatnonzero(cut) + 1, [len(t)]])
    where = {name: np.asarray(values)[ok] for name, values in (context or {}).items()}
    place = None if position_m is None else np.asarray(position_m, dtype=np.float64)[ok]
    spans = [
        ErrorSpan(
            start_s=float(t[a]),
            end_s=float(t[b - 1]),
            n=int(b - a),
            mean_db=float(r[a:b].mean()),
            position_m=() if place is None else tuple(place[a:b].mean(axis=0).tolist()),
            geometry={name: _typical(values[a:b]) for name, values in where.items()},
        )
        for a, b in pairwise(bounds)
        if sign[a]
    ]
    # add a little, because a segment of one sample has no duration but must not get weight 0
    spans.sort(key=lambda span: -abs(span.mean_db) * np.sqrt(span.end_s - span.start_s + 1e-3))
    return spans[:largest]


def _typical(values: Any) -> float:
    """Return the median, ignoring NaN."""
    known = np.asarray(values, dtype=np.float64)
    known = known[np.isfinite(known)]
    return float(np.median(known)) if len(known) else float("nan")


@dataclass(frozen=True, slots=True)
class ChannelDifference:
    """The comparison of two channels of one receiver.

    Parameters
    ----------
    n : int
        Number of samples that both channels have.
    mean_db, std_db, correlation : float
        Mean and standard deviation of first minus second level [dB], and correlation of the levels.
    spans : list of ErrorSpan
        Segments in which the difference deviates from its mean by more than :data:`PART_DB`, with their geometry.
    """

    n: int
    mean_db: float = float("nan")
    std_db: float = float("nan")
    correlation: float = float("nan")
    spans: list[ErrorSpan] = field(default_factory=list)


def channel_difference(
    time_s: ArrayLike,
    first_db: ArrayLike,
    second_db: ArrayLike,
    *,
    position_m: FloatArray | None = None,
    context: Mapping[str, ArrayLike] | None = None,
) -> ChannelDifference:
    """Return the difference of two channels, with segments in which the difference deviates from its mean.

    A segment deviates by more than :data:`PART_DB`.

    Parameters
    ----------
    time_s : array_like, (n,)
        Times, as seconds or datetime64.
    first_db, second_db : array_like, (n,)
        Levels of the two channels at these times [dB].
    position_m : (n, 3), optional
        Positions [m], to locate the segments.
    context : mapping of str to array_like (n,), optional
        Geometry that may explain the difference, as in :func:`error_spans`.

    Returns
    -------
    ChannelDifference
        The numbers are NaN without pairs.
    """
    first, second = _levels(first_db), _levels(second_db)
    ok = np.isfinite(first) & np.isfinite(second)
    if not ok.any():
        return ChannelDifference(n=0)
    difference = first - second
    # subtract the mean, because each channel of a receiver has its own gain
    mean = float(difference[ok].mean())
    residual = difference - mean
    spans = error_spans(
        time_s, residual, position_m=position_m, context=context, window_s=_PART_S, threshold_db=PART_DB
    )
    return ChannelDifference(
        n=int(ok.sum()),
        mean_db=mean,
        std_db=float(residual[ok].std()),
        correlation=correlation(first, second),
        spans=spans,
    )


def crps_normal(error_db: FloatArray, sd_db: FloatArray) -> FloatArray:
    """Return the continuous ranked probability score (n,) of normal forecasts [dB].

    Source: Gneiting and Raftery (2007), doi:10.1198/016214506000001437, eq. 21.

    Examples
    --------
    >>> crps_normal(np.array([0.0]), np.array([1.0])).round(4).tolist()
    [0.2337]
    """
    z = error_db / sd_db
    density = np.exp(-0.5 * z**2) / np.sqrt(2.0 * np.pi)
    return np.asarray(sd_db * (z * (2.0 * ndtr(z) - 1.0) + 2.0 * density - 1.0 / np.sqrt(np.pi)))


# Number of held-out segments of a flight. The segments have equal lengths.
_SEGMENTS = 10

_PENALTY = 1.0
_SPAN_DB = 60.0
# Smallest number of detected, and of undetected, samples that can be scored.
_FEWEST = 50


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectionForecast:
    """A forecast of P(detected) from a predicted level: a logistic function learned from flights.

    Parameters
    ----------
    level_db : float
        Predicted level at which half of the samples are detected.
    per_db : float
        Slope of the log odds.
    share : float
        Share of detected samples, averaged over the flights. This share is the forecast for samples without a predicted
        level.
    """

    level_db: float
    per_db: float
    share: float

    def probability(self, level_db: FloatArray) -> FloatArray:
        """Return P(detected) (n,) at predicted levels (n,) [dB]."""
        from scipy.special import expit

        return np.asarray(expit(self.per_db * (level_db - self.level_db)))


def learn_detection(flights: Sequence[tuple[FloatArray, BoolArray]]) -> DetectionForecast | None:
    """Fit P(detected) to predicted levels, giving each flight the same weight.

    Parameters
    ----------
    flights : sequence of ((n,), (n,))
        Finite predicted levels [dB], and a mask of the detected samples.

    Returns
    -------
    DetectionForecast or None
        None if detected or undetected samples are rare, or if P(detected) does not rise with the level.
    """
    from scipy.optimize import minimize

    flights = [flight for flight in flights if len(flight[0])]
    detected = np.concatenate([np.zeros(0, dtype=np.bool_), *(locked for _, locked in flights)])
    if min(int(detected.sum()), int((~detected).sum())) < _FEWEST:
        return None
    level = np.concatenate([each for each, _ in flights])
    weight = np.concatenate([np.full(len(each), 1.0 / len(each)) for each, _ in flights])
    centre, scale = float(level.mean()), max(float(level.std()), 1e-9)
    unit = (level - centre) / scale

    def loss(c: FloatArray) -> tuple[float, FloatArray]:
        odds = c[0] + c[1] * unit
        over = DetectionForecast(level_db=0.0, per_db=1.0, share=0.0).probability(odds) - detected
        # a small ridge penalty limits the slope if a level separates the outcomes perfectly
        value = (weight * (np.logaddexp(0.0, odds) - detected * odds)).sum() + 1e-3 * c[1] ** 2
        return float(value), np.array([(weight * over).sum(), (weight * over * unit).sum() + 2e-3 * c[1]])

    constant, slope = minimize(loss, np.zeros(2), jac=True).x
    if slope <= 0.0:
        return None
    share = float(np.mean([locked.mean() for _, locked in flights]))
    return DetectionForecast(
        level_db=centre - scale * float(constant / slope), per_db=float(slope) / scale, share=share
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectionScore:
    """The score of a log whose receiver loses its lock or has a floor.

    Parameters
    ----------
    floor_db : float
        Floor of the receiver [unit of the measurement]. Lower levels are raised to it.
    n, n_detected : int
    brier, constant_brier, log_score, constant_log_score : float
        Scores of two forecasts of the detection. The first is P(detected) from the predicted level. The second is
        constant: the share of this flight, which is the best forecast without a level. The Brier score is between 0 and
        1. The log score is in nat.
    learned_on : str
        ``other flights``, or ``held-out segments`` if each segment of this flight is predicted from the others.
    offset_db, rmse_db : float
        Offset (added to the measurement) and RMSE of all samples, with both levels no lower than the floor.
    rmse_ci95_db : (low, high)
        95 % interval of ``rmse_db``.
    free_space_rmse_db : float
        RMSE of the free-space level with the same floor.
    detected_rmse_db : float
        RMSE of the detected samples with the same offset. Never show this number alone, because these samples are
        selected by their level.
    reliability : tuple of (float, float, int)
        Mean probability, share of detected samples, and number of samples, for each fifth of the probability range.
    locks : bool
        True if the log contains the lock. Otherwise samples without a level count as not detected.
    """

    floor_db: float
    n: int
    n_detected: int
    brier: float
    constant_brier: float
    log_score: float
    constant_log_score: float
    offset_db: float
    rmse_db: float
    free_space_rmse_db: float
    detected_rmse_db: float
    reliability: tuple[tuple[float, float, int], ...]
    learned_on: str
    rmse_ci95_db: Interval = NO_INTERVAL
    locks: bool = False


def score_detection(
    time_s: FloatArray,
    measured_db: FloatArray,
    simulated_db: FloatArray,
    detected: BoolArray,
    *,
    floor_db: float,
    free_space_db: FloatArray,
    forecast: DetectionForecast | None = None,
    position_m: FloatArray | None = None,
) -> DetectionScore | None:
    """Return the scores of detection and of levels with a floor.

    Parameters
    ----------
    time_s : (n,)
    measured_db, simulated_db : (n,)
        Levels. A measured NaN counts as below the floor. Samples without a simulated level are not scored.
    detected : (n,) bool
    floor_db : float
        Floor of the measurement.
    free_space_db : (n,)
        Level of free space, for comparison.
    forecast : DetectionForecast, optional
        Forecast learned from other flights, applied to ``simulated_db``. By default, each segment of the flight is
        predicted from its other segments.
    position_m : (n, 3), optional
        Positions, as in :func:`compare_rss`.

    Returns
    -------
    DetectionScore or None
        None if detected or undetected samples are rare.
    """
    finite = np.isfinite(simulated_db) & np.isfinite(time_s)
    time, simulated, detected = time_s[finite], simulated_db[finite], detected[finite]
    measured = np.maximum(np.nan_to_num(measured_db[finite], nan=floor_db), floor_db)
    if min(int(detected.sum()), int((~detected).sum())) < _FEWEST:
        return None
    # code outcomes as ranks 1 and 2, to use the regression of ranks
    outcome = detected.astype(np.int64) + 1
    p = _held_out(time, simulated, outcome) if forecast is None else forecast.probability(simulated)
    stated, constant = (np.stack([1.0 - q, q], axis=1) for q in (p, np.full(len(p), detected.mean())))
    fit = floored_fit(measured, simulated, floor_db)
    residual, order = measured - np.maximum(simulated - fit.offset_db, floor_db), np.argsort(time, kind="stable")
    place = None if position_m is None else position_m[finite][order]
    return DetectionScore(
        floor_db=floor_db,
        n=len(time),
        n_detected=int(detected.sum()),
        brier=float(brier_losses(stated, outcome).mean()) / 2.0,
        constant_brier=float(brier_losses(constant, outcome).mean()) / 2.0,
        log_score=float(log_losses(stated, outcome).mean()),
        constant_log_score=float(log_losses(constant, outcome).mean()),
        offset_db=fit.offset_db,
        rmse_db=fit.rmse_db,
        rmse_ci95_db=rmse_interval(residual[order], fit.rmse_db, place),
        free_space_rmse_db=floored_fit(measured, free_space_db[finite], floor_db).rmse_db,
        detected_rmse_db=float(np.sqrt(np.mean(residual[detected] ** 2))),
        reliability=_reliability(p, detected),
        learned_on="held-out segments" if forecast is None else "other flights",
    )


def _held_out(time_s: FloatArray, level_db: FloatArray, outcome: IntArray) -> FloatArray:
    """Return P(detected) (n,), predicted in each segment by a regression on the level in the other segments."""
    away = (time_s - time_s.min()) / max(np.ptp(time_s), 1e-9)
    segment = np.minimum((away * _SEGMENTS).astype(np.int64), _SEGMENTS - 1)
    stated = out_of_group(level_db[:, None], outcome, segment, _PENALTY)
    # the regression has four outcomes, but only two occur
    return np.asarray(stated[:, 1] / stated[:, :2].sum(axis=1))


def floored_fit(measured_db: FloatArray, simulated_db: FloatArray, floor_db: float) -> OffsetFit:
    """Return the offset with the smallest RMSE after both levels (n,) are raised to at least the floor.

    Pairs with a NaN are ignored. The offset is added to the measurement. The offset is searched within 60 dB of the
    median difference of levels above the floor.
    """
    finite = np.isfinite(measured_db) & np.isfinite(simulated_db)
    order = np.flatnonzero(finite)[np.argsort(simulated_db[finite])]
    measured, simulated = np.maximum(measured_db[order], floor_db), simulated_db[order]
    above = measured > floor_db
    middle = float(np.median((simulated - measured)[above])) if above.any() else 0.0
    grid = offset_grid(span_db=(middle - _SPAN_DB, middle + _SPAN_DB))
    # of the sorted predictions, the first k are below the floor and raised to the floor; all others shift with the
    # offset
    low = np.concatenate([[0.0], np.cumsum((measured - floor_db) ** 2)])
    difference = simulated - measured
    first, second = (np.concatenate([[0.0], np.cumsum(difference**power)]) for power in (1, 2))
    k = np.searchsorted(simulated, grid + floor_db, side="right")
    n = len(measured)
    moved = (second[n] - second[k]) - 2.0 * grid * (first[n] - first[k]) + (n - k) * grid**2
    # rounding of large sums may make differences slightly negative
    mse = np.maximum(low[k] + moved, 0.0) / n
    best = int(mse.argmin())
    return OffsetFit(float(grid[best]), float(np.sqrt(mse[best])), n, best in (0, len(grid) - 1))


def _reliability(stated: FloatArray, detected: BoolArray) -> tuple[tuple[float, float, int], ...]:
    fifth = np.minimum((stated * 5.0).astype(np.int64), 4)
    groups = [fifth == i for i in range(5)]
    return tuple((float(stated[g].mean()), float(detected[g].mean()), int(g.sum())) for g in groups if g.any())


# Time between two values of AERPAW's sounder [s]: 4095 chips plus overhead of the correlation.
BASE_S = 0.032768

# The quality is moved to the time base of the sounder if this raises its correlation with the power by more than this
# number.
_BETTER = 0.1


def aligned_quality(time_s: FloatArray, power_db: FloatArray, quality_db: FloatArray) -> tuple[FloatArray, float]:
    """Return the quality at the times of the power, for a table that was merged by row instead of by time.

    When such a table was made, rows of the power were dropped, but rows of the quality were not. Row i then contains
    the quality at the time :data:`BASE_S` * i after the first row.

    Parameters
    ----------
    time_s, power_db, quality_db : (n,)
        Columns of one table.

    Returns
    -------
    (n,), float
        Quality (NaN after its last value), and the largest shift [s]. The shift is 0 if the rows were already paired by
        time.
    """
    base_s = np.arange(len(time_s)) * BASE_S + time_s[0]
    moved = np.interp(time_s, base_s, quality_db, right=np.nan)
    shift = float(np.abs(base_s - time_s).max())
    finite = np.isfinite(moved) & np.isfinite(power_db) & np.isfinite(quality_db)
    if shift < 2.0 or finite.sum() < _FEWEST:
        return quality_db, 0.0
    paired, based = (float(np.corrcoef(power_db[finite], q[finite])[0, 1]) for q in (quality_db, moved))
    return (moved, shift) if based > paired + _BETTER else (quality_db, 0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class ServingComparison:
    """The comparison of logged and predicted serving cells.

    Parameters
    ----------
    cells : tuple of str
    confusion : (cells, cells + 1) int
        Samples by serving cell (row) and predicted strongest cell (column). The last column counts samples without a
        predicted cell.
    n : int
        Number of samples with a serving cell among ``cells``.
    """

    cells: tuple[str, ...]
    confusion: IntArray
    n: int

    @property
    def hit_share(self) -> float:
        """Share of samples whose serving cell is predicted to be the strongest. NaN without samples."""
        return float(np.trace(self.confusion) / self.n) if self.n else float("nan")

    @property
    def majority_share(self) -> float:
        """Share of the most frequent serving cell. The hit share of a useful prediction is larger."""
        return float(self.confusion.sum(axis=1).max() / self.n) if self.n else float("nan")

    def as_dict(self) -> dict[str, Any]:
        """Return the values for metrics.json."""
        names = (*self.cells, "none")
        return {
            "cells": list(self.cells),
            "n": self.n,
            "hit_share": self.hit_share,
            "majority_share": self.majority_share,
            "confusion": {
                cell: dict(zip(names, map(int, row), strict=True))
                for cell, row in zip(self.cells, self.confusion, strict=True)
            },
        }


def compare_serving(served: ArrayLike, predicted_dbm: ArrayLike, cells: Sequence[str]) -> ServingComparison:
    """Compare serving cells with the cells that are predicted to be the strongest, as a confusion matrix.

    Parameters
    ----------
    served : array_like, int, (n,)
        Index of the serving cell. Samples with a negative index (unknown, or not in ``cells``) are ignored.
    predicted_dbm : array_like, (n, cells)
        Predicted levels; NaN without a path. Of equal levels, the first counts as the strongest.
    cells : sequence of str

    Examples
    --------
    >>> compare_serving([0, 1, 1, -1], [[-70, -80], [-75, -71], [-60, -90], [-60, -90]], ["a", "b"]).confusion.tolist()
    [[1, 0, 0], [1, 1, 0]]
    """
    # unknown cells are removed below, because -1 would index the last cell
    index = np.nan_to_num(unmasked(served), nan=-1.0).astype(np.int64)
    level: FloatArray = unmasked(predicted_dbm)
    known = index >= 0
    filled = np.where(np.isnan(level), -np.inf, level)
    strongest = np.where(np.isnan(level).all(axis=1), len(cells), filled.argmax(axis=1) if len(cells) else 0)
    confusion = np.zeros((len(cells), len(cells) + 1), dtype=np.int64)
    # add.at counts repeated pairs; += would count each pair once
    np.add.at(confusion, (index[known], strongest[known]), 1)
    return ServingComparison(cells=tuple(cells), confusion=confusion, n=int(known.sum()))


# The lowest level is the floor of a receiver if at least this share, and this number, of the samples have it.
_FLOOR_SHARE, _FLOOR_COUNT = 0.01, 10


def detection_floor_db(level_db: FloatArray, within_db: float = 0.0) -> float | None:
    """Return the floor of a receiver [dB]: its lowest level, if it is repeated often within a tolerance, else None."""
    known = level_db[np.isfinite(level_db)]
    if not len(known) or np.ptp(known) == 0.0:
        return None
    lowest = float(known.min())
    repeated = int((known <= lowest + within_db).sum())
    return lowest if repeated >= max(_FLOOR_COUNT, _FLOOR_SHARE * len(known)) else None


def nearest_in_time(times: AnyArray, of: AnyArray) -> tuple[IntArray, AnyArray]:
    """Return the index in ``of`` (m,) nearest to each of ``times`` (n,) (the earlier of two), and the distance."""
    order = np.argsort(of, kind="stable")
    at = of[order]
    after = np.clip(np.searchsorted(at, times), 0, len(at) - 1)
    before = np.maximum(after - 1, 0)
    index = np.where(np.abs(at[before] - times) <= np.abs(at[after] - times), before, after)
    return order[index], np.abs(at[index] - times)


# Largest difference between the headings of a point and of a sample near it [deg].
_TURNED_DEG = 45.0


def nearest_points(
    position_m: FloatArray, points_m: FloatArray, reach_m: float, nose_deg: tuple[FloatArray, FloatArray] | None = None
) -> tuple[IntArray, BoolArray]:
    """Return the index (n,) of the point nearest to each sample, and whether that point is near (n,).

    Parameters
    ----------
    position_m : (n, 3)
        East, north and up of the samples [m]. A sample with a NaN is not near any point.
    points_m : (points, 3)
        At least one.
    reach_m : float
        Largest distance of a near point.
    nose_deg : ((n,), (points,)), optional
        Headings of samples and points. Headings are used only if all points and at least one sample have one.

    Returns
    -------
    index : (n,) int
    near : (n,) bool
    """
    from scipy.spatial import cKDTree

    samples, points = position_m / reach_m, points_m / reach_m
    if nose_deg is not None and np.isfinite(nose_deg[0]).any() and np.isfinite(nose_deg[1]).all():
        apart = 2.0 * np.sin(np.radians(_TURNED_DEG) / 2.0)
        samples, points = (
            np.column_stack([place, np.sin(np.radians(nose)) / apart, np.cos(np.radians(nose)) / apart])
            for place, nose in zip((samples, points), nose_deg, strict=True)
        )
    known = np.asarray(np.isfinite(samples).all(axis=1))
    # near points are within 2**0.5 in these scaled coordinates, and the bound speeds up the search for far samples
    index = cKDTree(points).query(np.where(known[:, None], samples, 0.0), distance_upper_bound=1.5)[1]
    index = np.minimum(index, len(points) - 1)
    away = samples - points[index]
    return index, known & (np.linalg.norm(away[:, :3], axis=1) <= 1.0) & (np.linalg.norm(away[:, 3:], axis=1) <= 1.0)


def at_times(time_s: ArrayLike, of_s: ArrayLike, values: ArrayLike, *, within_s: float) -> FloatArray:
    """Return the values of the nearest sample at requested times, NaN if no sample is near.

    Parameters
    ----------
    time_s : array_like, (n,)
        Requested times [s].
    of_s : array_like, (m,)
        Times of the values [s].
    values : array_like, (m,)
    within_s : float
        Largest time to the nearest sample [s].

    Returns
    -------
    (n,)
        Values in the unit of ``values``.
    """
    instants, sampled_s = unmasked(time_s), unmasked(of_s)
    column = unmasked(values)
    if not len(sampled_s):
        return np.full(len(instants), np.nan)
    near, apart_s = nearest_in_time(instants, sampled_s)
    return np.where(apart_s <= within_s, column[near], np.nan)


@dataclass(frozen=True, slots=True, kw_only=True)
class FieldAudit:
    """The result of an audit: differences from two references.

    Parameters
    ----------
    paths, power_max_db, power_rms_db, phase_max_rad, phase_rms_rad
        Number of paths compared with Sionna's coefficients, and largest and RMS differences in power and phase.
    link_rss_max_db : float
        Largest difference of the coherent RSS from Sionna, for links whose paths are all shorter than 300 m.
    reference_links, reference_paths, h_max_error, rss_max_error_db, rank_differs
        Comparison with the second implementation: largest relative difference of H, largest difference of RSS, and
        number of links with a different rank.
    attitude_rows, attitude_max_rad
        Number of logged attitudes that were converted to rotations a second time, and the largest difference.
    missing_paths, phantom_paths : int
        Number of paths that certainly exist but are missing, and of paths that cannot exist.
    doubtful : int
        Number of paths and links that were not compared, because a shift by a micrometre (float32: two millimetres)
        decides whether they exist.
    failures : tuple of str
        Sentences about values out of tolerance.
    not_covered : tuple of str
    """

    paths: int = 0
    power_max_db: float = 0.0
    power_rms_db: float = 0.0
    phases: int = 0
    phase_max_rad: float = 0.0
    phase_rms_rad: float = 0.0
    link_rss_max_db: float = 0.0
    reference_links: int = 0
    reference_paths: int = 0
    h_max_error: float = 0.0
    rss_max_error_db: float = 0.0
    rank_differs: int = 0
    attitude_rows: int = 0
    attitude_max_rad: float = 0.0
    missing_paths: int = 0
    phantom_paths: int = 0
    doubtful: int = 0
    failures: tuple[str, ...] = ()
    not_covered: tuple[str, ...] = ()

    @property
    def failed(self) -> int:
        """Number of checks out of tolerance."""
        return len(self.failures)

    def __add__(self, other: FieldAudit) -> FieldAudit:
        """Return the combination of two audits: sums of counts, and the largest errors."""
        values: dict[str, Any] = {
            name: _together(name, getattr(self, name), getattr(other, name)) for name in self.__slots__
        }
        values["power_rms_db"] = _rms(self.paths, self.power_rms_db, other.paths, other.power_rms_db)
        values["phase_rms_rad"] = _rms(self.phases, self.phase_rms_rad, other.phases, other.phase_rms_rad)
        return FieldAudit(**values)


def _together(name: str, mine: Any, theirs: Any) -> Any:
    """Return the combination of two values: distinct texts, the larger error, or the sum of counts."""
    if isinstance(mine, tuple):
        return tuple(dict.fromkeys((*mine, *theirs)))
    worst = name.endswith(("_max_db", "_max_m", "_max_rad", "_max_error", "_max_error_db"))
    return max(mine, theirs) if worst else mine + theirs


def _rms(n: int, rms: float, m: int, other_rms: float) -> float:
    return float(math.sqrt((n * rms**2 + m * other_rms**2) / max(n + m, 1)))
