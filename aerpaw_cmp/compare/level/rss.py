"""Measured against simulated received signal strength of one tower and channel.

Every function takes arrays in time order, one entry per sample, NaN where there is none, and knows nothing of
files, sites or engines.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ...common.geodesy import azimuth_rad, bearing_deg, elevation_rad
from ...common.jsonable import named
from ...common.units import BoolArray, FloatArray, db_from_power, power_from_db, unmasked
from ..offset import SPAN_DB, OffsetFit, grid_offset, identifiable_range, offset_curve
from ..statistics.intervals import ErrorIntervals, Interval, correlation, error_intervals, rmse_interval

# Two channels of one receiver "part" where they differ by more than this [dB].
PART_DB = 10.0
# Over means of so long [s].
_PART_S = 1.0


def seconds(time: ArrayLike) -> FloatArray:
    """Seconds since the first instant, from datetime64 or from seconds."""
    array = np.asarray(time)
    if array.dtype.kind == "M":
        stamp = array.astype("datetime64[ns]")
        known = stamp[~np.isnat(stamp)]
        first = known.min() if len(known) else np.datetime64(0, "ns")
        return np.asarray((stamp - first) / np.timedelta64(1, "s"), dtype=np.float64)
    return np.asarray(array, dtype=np.float64)


@dataclass(frozen=True, slots=True)
class RssComparison:
    """Comparison of a simulation with the measured level of one link.

    Parameters
    ----------
    offset_db, rmse_db : float
        Grid-search offset (added to the measurement) and what remains [dB].
    n : int
        Pairs that count.
    n_out_of_coverage, n_measured_out, n_simulated_out : int
        Samples at a known pose with no measured signal or no simulated path (either; each).
    n_no_pose : int
        Samples without a pose: they belong to no comparison.
    at_edge : bool
        The offset lies at the edge of the search span.
    correlation : float
        Pearson; NaN for constant series.
    intervals : ErrorIntervals
        95 % intervals and the residual's memory.
    identifiable_db : (low, high)
        Offsets within 0.1 dB of the least RMSE.
    baselines : mapping of str to OffsetFit
        Free space, two-ray and others, each with its own offset, over the same pairs.
    baseline_intervals : mapping of str to (low, high)
        95 % interval of each baseline's RMSE [dB].
    lag_s : float
        Applied clock lag [s]; NaN if none was estimated or applied.
    fitted_on_scored : tuple of str
        Names of the numbers that were fitted on the samples they are scored on.
    residual_db : (samples,)
        ``measured + offset - simulated``, NaN where no pair.
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
    identifiable_db: Interval
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
    span_db: tuple[float, float] = SPAN_DB,
) -> RssComparison:
    """Compare a measured with a simulated sequence of levels.

    Parameters
    ----------
    time_s : array_like, (n,)
        Instants: seconds or datetime64. Samples are put into this order; instants that are not numbers come last.
    measured_db : array_like, (n,)
        dBm or dB re full scale; NaN without a received signal.
    simulated_db : array_like, (n,)
        NaN where there is no path.
    baselines : mapping of str to array_like, (n,), optional
        Levels of simpler models at the same poses [dB].
    posed : array_like of bool, (n,), optional
        Whether the pose of the sample is known. A sample without a pose is not out of coverage.
    span_db : (float, float)
        Offset search.

    Returns
    -------
    RssComparison
    """
    time, measured, simulated = seconds(time_s), _levels(measured_db), _levels(simulated_db)
    has_pose = np.ones(len(time), dtype=bool) if posed is None else np.asarray(posed, dtype=bool)
    use = has_pose & np.isfinite(measured) & np.isfinite(simulated)
    order = np.flatnonzero(use)[np.argsort(time[use], kind="stable")]
    m, s = measured[order], simulated[order]
    fit = grid_offset(m, s, span_db=span_db)
    offsets, curve = offset_curve(m, s, span_db=span_db)
    simple = {name: _levels(levels)[order] for name, levels in (baselines or {}).items()}
    fits = {name: grid_offset(m, level, span_db=span_db) for name, level in simple.items()}
    return RssComparison(
        **named(fit, "offset_db rmse_db n at_edge"),
        n_out_of_coverage=int((has_pose & ~use).sum()),
        n_measured_out=int((has_pose & ~np.isfinite(measured)).sum()),
        n_simulated_out=int((has_pose & ~np.isfinite(simulated)).sum()),
        n_no_pose=int((~has_pose).sum()),
        correlation=correlation(m, s),
        intervals=replace(error_intervals(m, s), rmse_db=_rmse_interval(m - s, fit)),
        identifiable_db=identifiable_range(offsets, curve),
        baselines=fits,
        baseline_intervals={name: _rmse_interval(m - level, fits[name]) for name, level in simple.items()},
        residual_db=np.where(use, measured + fit.offset_db - simulated, np.nan),
    )


# Among the numbers that were fitted on the very samples they would be scored on.
LEARNED_HERE = "antennas"


def without_errors(score: RssComparison) -> RssComparison:
    """A comparison on the flight that the antennas were learned from: offset, counts and baselines, no error."""
    none = (float("nan"), float("nan"))
    return replace(
        score,
        rmse_db=float("nan"),
        correlation=float("nan"),
        intervals=replace(score.intervals, rmse_db=none, correlation=none),
        identifiable_db=none,
        fitted_on_scored=(*score.fitted_on_scored, LEARNED_HERE),
    )


# Levels farther than this many interquartile ranges outside the quartiles are outlying: of a normal distribution one
# in 10^9, and a deep fade of a real flight is not.
_FENCE = 4.0

# Least interquartile range that counts: a UAV that hovers has next to none.
_NARROWEST_DB = 5.0


def outliers(level_db: ArrayLike) -> BoolArray:
    """Samples (n,) whose level lies far outside the flight's own distribution; they are flagged, not dropped.

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
    """Levels as floats; infinities (no power) become NaN."""
    array = unmasked(values)
    return np.where(np.isfinite(array), array, np.nan)


def _rmse_interval(difference: FloatArray, fit: OffsetFit) -> Interval:
    known = difference[np.isfinite(difference)]
    return rmse_interval(known + fit.offset_db, fit.rmse_db)


# --- both sides averaged over the same window ----------------------------------------------------------------------


def local_mean_db(time_s: ArrayLike, level_db: ArrayLike, window_s: float) -> FloatArray:
    """Moving average of power over a centred window.

    Parameters
    ----------
    time_s : array_like, (n,)
        Instants [s] (or datetime64) in any order.
    level_db : array_like, (n,)
        Levels [dB]; NaN does not take part and stays NaN.
    window_s : float
        Full width [s]; 0 gives the levels back.

    Notes
    -----
    Averages linear power, as a receiver that integrates longer would. Sums run over powers relative to the
    strongest one, so a range of 100 dB within one window keeps its digits to 1e-6 dB.
    """
    time, level = seconds(time_s), _levels(level_db)
    known = np.isfinite(level) & np.isfinite(time)
    result = np.full(len(level), np.nan)
    if not known.any():
        return result
    rows = np.flatnonzero(known)
    rows = rows[np.argsort(time[rows], kind="stable")]
    t, x = time[rows], level[rows]
    top = x.max()
    # relative to the strongest: levels re full scale of any gain stay in range
    power = power_from_db(x - top)
    first = np.searchsorted(t, t - 0.5 * window_s, side="left")
    last = np.searchsorted(t, t + 0.5 * window_s, side="right")
    result[rows] = db_from_power(_window_sums(power, first, last) / (last - first)) + top
    return result


def _window_sums(values: FloatArray, first: Any, last: Any) -> FloatArray:
    """Sums of values[first:last] for windows that move forward.

    A running sum would lose weak windows behind strong ones (1e-16 of the total), so sums restart: every window is
    covered by two aligned pieces of length 2^j each of which was summed on its own (a sparse table), the rest by
    one more level down; log2(n) passes.
    """
    total = np.zeros(len(first))
    at, remaining = first.copy(), last - first
    table = values
    width = 1
    tables = [table]
    while width * 2 <= int(remaining.max(initial=1)):
        table = table[: len(table) - width] + table[width:]
        tables.append(table)
        width *= 2
    for j in range(len(tables) - 1, -1, -1):
        take = (remaining >> j) & 1 == 1
        total[take] += tables[j][at[take]]
        at = at + np.where(take, 1 << j, 0)
    return total


def averaged_fits(
    measured_db: ArrayLike,
    simulations: Mapping[str, ArrayLike],
    averages: Mapping[str, Callable[[FloatArray], FloatArray]],
    *,
    span_db: tuple[float, float] = SPAN_DB,
) -> dict[str, dict[str, OffsetFit]]:
    """Simulations against the measurement, both sides averaged alike.

    Parameters
    ----------
    measured_db : array_like, (n,)
        [dB]
    simulations : mapping of str to array_like (n,)
        Levels by name, such as "coherent", "power_sum" or "local_mean".
    averages : mapping of str to callable
        Means of levels (n,), NaN where either side has none, such as :func:`local_mean_db`.
    span_db : (float, float)
        Offset search.

    Returns
    -------
    dict
        ``result[simulation][average]``.
    """
    measured = _levels(measured_db)
    result: dict[str, dict[str, OffsetFit]] = {}
    for name, levels in simulations.items():
        simulated = _levels(levels)
        finite = np.isfinite(measured) & np.isfinite(simulated)
        sides = [np.where(finite, side, np.nan) for side in (measured, simulated)]
        result[name] = {
            average: grid_offset(*(mean(side) for side in sides), span_db=span_db) for average, mean in averages.items()
        }
    return result


# --- where the residual comes from ---------------------------------------------------------------------------------


def link_geometry(
    tower_m: ArrayLike,
    position_m: FloatArray,
    rotation: FloatArray | None = None,
    *,
    tower_mount: FloatArray | None = None,
    uav_mount: FloatArray | None = None,
) -> dict[str, FloatArray]:
    """Variables that the residual may depend on, for every pose.

    Parameters
    ----------
    tower_m : (3,), (1, 3) or (n, 3)
        Array centre, east-north-up, of a tower that moves at every pose [m].
    position_m : (n, 3)
        UAV [m].
    rotation : (n, 3, 3), optional
        Aircraft body to east-north-up.
    tower_mount, uav_mount : (3, 3), optional
        Rotation of each array in its carrier (site axes; aircraft body); by default the identity.

    Returns
    -------
    dict of str to ndarray (n,)
        ``distance_m``, ``elevation_deg`` and ``azimuth_deg`` of the UAV from the tower (clockwise from north),
        ``tower_azimuth_deg`` and ``tower_elevation_deg`` in the tower's array frame (azimuth from its boresight
        towards its left), ``height_m``; with ``rotation`` also ``heading_deg``, ``uav_azimuth_deg`` and
        ``uav_elevation_deg`` of the tower in the UAV's array frame.

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
    """Azimuth from x towards y and elevation above the x-y plane [deg]."""
    return np.degrees(azimuth_rad(vector)), np.degrees(elevation_rad(vector))


@dataclass(frozen=True, slots=True)
class ErrorSpan:
    """A stretch of the flight where the error is large and of one sign.

    Parameters
    ----------
    start_s, end_s : float
        Seconds, as in the input (datetime64 input: since the first instant).
    n : int
        Samples.
    mean_db : float
        Mean residual; positive: measured stronger than simulated.
    position_m : tuple of float
        Mean east, north, up of the span [m]; empty if no positions were given.
    geometry : mapping of str to float
        Median of each context quantity in the span.
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
    """Stretches of largest error, worst first (mean error times the root of the duration).

    Parameters
    ----------
    time_s, residual_db : array_like, (n,)
        Instants and residual.
    position_m : (n, 3), optional
        East, north, up [m].
    context : mapping of str to array_like (n,), optional
        What the geometry was; known names: ``los`` (bool), ``foliage_m``, ``elevation_deg`` (from the tower),
        ``height_m``, ``heading_deg``, ``coherent_minus_power_sum_db`` (how deep the simulation fades).
    window_s : float
        The residual is averaged over this window before it is judged [s].
    threshold_db : float, optional
        A span is where the average exceeds this; by default 1.5 times the RMSE.
    largest : int
        Spans that are given at most.

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
    first = np.searchsorted(t, t - 0.5 * window_s, side="left")
    last = np.searchsorted(t, t + 0.5 * window_s, side="right")
    smooth = _window_sums(r, first, last) / (last - first)
    limit = 1.5 * float(np.sqrt(np.mean(r**2))) if threshold_db is None else threshold_db
    sign = np.where(smooth > limit, 1, np.where(smooth < -limit, -1, 0))
    # a gap longer than the window parts a stretch: nobody knows what was between
    cut = (np.diff(sign) != 0) | (np.diff(t) > max(window_s, 1e-9))
    bounds = np.concatenate([[0], np.flatnonzero(cut) + 1, [len(t)]])
    where = {name: np.asarray(values)[ok] for name, values in (context or {}).items()}
    place = None if position_m is None else np.asarray(position_m, dtype=np.float64)[ok]
    spans = []
    for a, b in pairwise(bounds):  # per span, not per sample
        if sign[a] == 0:
            continue
        centre = () if place is None else tuple(float(v) for v in place[a:b].mean(axis=0))
        spans.append(
            ErrorSpan(
                start_s=float(t[a]),
                end_s=float(t[b - 1]),
                n=int(b - a),
                mean_db=float(r[a:b].mean()),
                position_m=centre,
                geometry={name: _typical(values[a:b]) for name, values in where.items()},
            )
        )
    # a stretch of one sample has no duration, and still counts
    spans.sort(key=lambda span: -abs(span.mean_db) * np.sqrt(span.end_s - span.start_s + 1e-3))
    return spans[:largest]


def _typical(values: Any) -> float:
    """Median without NaN."""
    known = np.asarray(values, dtype=np.float64)
    known = known[np.isfinite(known)]
    return float(np.median(known)) if len(known) else float("nan")


@dataclass(frozen=True, slots=True)
class ChannelDifference:
    """Two channels of one receiver against each other.

    Parameters
    ----------
    n : int
        Samples that both have.
    mean_db, std_db, correlation : float
        Of first minus second.
    spans : list of ErrorSpan
        Where they part, with the geometry there.
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
    """Difference of two channels, and where they part by more than :data:`PART_DB` after their mean difference.

    Parameters
    ----------
    time_s : array_like, (n,)
        Instants: seconds or datetime64.
    first_db, second_db : array_like, (n,)
        Levels of the two channels at these instants [dB].
    position_m : (n, 3), optional
        For the places at which they part.
    context : mapping of str to array_like (n,), optional
        Geometry that may explain it, as in :func:`error_spans`.

    Returns
    -------
    ChannelDifference
        Mean and spread of first minus second [dB], their correlation, and the spans where they part; NaN without pairs.
    """
    first, second = _levels(first_db), _levels(second_db)
    ok = np.isfinite(first) & np.isfinite(second)
    if not ok.any():
        return ChannelDifference(n=0)
    difference = first - second
    # the channels of a receiver have gains of their own
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
