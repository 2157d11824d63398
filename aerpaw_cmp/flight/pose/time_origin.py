"""Start time of a log with relative times, from a companion log that knows the time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
import shapely

from ...common.geodesy import rough_m
from ...common.units import AnyArray, BoolArray, FloatArray
from ...logs.records import Stream, has_wall_clock
from .track import interpolated

# Two receivers on one aircraft tell places this near each other, in the median.
_AGREE_M = 12.0
# Further apart at each second in a few points, they do not so in any tenth of one, in all.
_NEAR_M = 4.0 * _AGREE_M
# The second-best origin, a minute away or farther, must be so many times worse.
_UNIQUE = 1.8
_POINTS = 240


@dataclass(frozen=True, slots=True)
class Origin:
    """An origin of relative times.

    Parameters
    ----------
    time : datetime64[ns]
        UTC of relative time zero.
    distance_m : float
        Median distance of the two tracks under it.
    """

    time: np.datetime64
    distance_m: float


def origin_of(log: Stream, track: Stream) -> Origin | None:
    """The origin under which the positions of a log lie on a track; None where none, or none alone, does.

    Both logs tell where the aircraft was: the log at relative times t, the track at UTC. Searched is the shift s that
    makes the median of |p_log(t) - p_track(t + s)| least: each second first, then tenths of a second around the best.

    Parameters
    ----------
    log : Stream
        With positions; its times count from 1970.
    track : Stream
        Telemetry with a wall clock.
    """
    mine, tracked = _points(log.frame, _POINTS), _points(track.frame, None)
    if mine is None or tracked is None or has_wall_clock(mine[0][0].astype("datetime64[ns]")):
        return None
    zero_s = float(tracked[0][0].astype(np.int64)) / 1e9
    time_s = mine[0].astype(np.int64) / 1e9
    track_s = tracked[0].astype(np.int64) / 1e9 - zero_s
    log_m, track_m = _metres(mine[1], tracked[1]), _metres(tracked[1], tracked[1])
    # in the plan: heights may count from other grounds
    line = shapely.linestrings(track_m[:, :2])
    shapely.prepare(line)
    # half of the half that lies within the track's time has to be that near to it, at whatever time
    if 4 * shapely.dwithin(line, shapely.points(log_m[:, :2]), _AGREE_M).sum() < len(log_m):
        return None
    length = time_s[-1] - time_s[0]
    # half of the log may stick out at either end of the track
    shifts = np.arange(-time_s[0] - 0.5 * length, track_s[-1] - time_s[0] - 0.5 * length, 1.0)
    # few points tell where no second brings the log anywhere near: most pairs of a folder of flights end here
    few = _median_distances(shifts, time_s[::8], log_m[::8], track_s, track_m)
    if not (few < _NEAR_M).any():
        return None
    misses = _median_distances(shifts, time_s, log_m, track_s, track_m)
    if not np.isfinite(misses).any():
        return None
    best = int(np.nanargmin(misses))
    apart = np.abs(shifts - shifts[best]) > 60
    fine = shifts[best] + np.arange(-15, 16) / 10
    finer = _median_distances(fine, time_s, log_m, track_s, track_m)
    distance = float(np.nanmin(finer))
    second = float(np.nanmin(misses[apart])) if np.isfinite(misses[apart]).any() else np.inf
    # like with like: the other places were tried each second, and between two seconds an aircraft flies some metres
    if distance > _AGREE_M or second < _UNIQUE * max(float(misses[best]), 1.0):
        return None
    origin_s = zero_s + float(fine[int(np.nanargmin(finer))])
    return Origin(np.datetime64(round(origin_s * 1000), "ms").astype("datetime64[ns]"), distance)


def _points(frame: pd.DataFrame, most: int | None) -> tuple[AnyArray, FloatArray] | None:
    """Times and (latitude, longitude, altitude) of the rows with a place, in order, thinned out to at most ``most``."""
    names = ["latitude_deg", "longitude_deg", "altitude_m"]
    if not set(names) <= set(frame.columns):
        return None
    places = np.column_stack([frame[name].to_numpy(np.float64) for name in names])
    known = np.flatnonzero(np.isfinite(places[:, :2]).all(axis=1))
    time, first = np.unique(frame["time"].to_numpy("datetime64[ns]")[known], return_index=True)
    # fewer places lie on any track by chance
    if len(time) < 20:
        return None
    # evenly, not the first: take-off is where all flights are alike
    at = slice(None) if most is None or len(time) <= most else np.linspace(0, len(time) - 1, most).astype(int)
    return time[at], places[known[first]][at]


def _metres(points: FloatArray, about: FloatArray) -> FloatArray:
    """Places in metres from the first; heights as logged, 0 where there are none."""
    return np.column_stack([rough_m(points[:, 0], points[:, 1], about[0]), np.nan_to_num(points[:, 2])])


def _median_distances(
    shifts: FloatArray, time_s: FloatArray, log_m: FloatArray, track_s: FloatArray, track_m: FloatArray
) -> FloatArray:
    """Median distance under each shift; NaN where less than half of the log lies within the track."""
    parts = [np.zeros(0)]
    for some in np.array_split(shifts, -(-len(shifts) // _SHIFTS_AT_ONCE) or 1):
        time = time_s + some[:, None]
        inside = (time >= track_s[0]) & (time <= track_s[-1])
        apart = log_m - interpolated(time.ravel(), track_s, track_m).reshape(*time.shape, 3)
        apart[..., 2] -= _medians(apart[..., 2], inside)[:, None]  # the logs count heights from grounds of their own
        median = _medians(np.linalg.norm(apart, axis=2), inside)
        parts.append(np.where(2 * inside.sum(axis=1) < len(time_s), np.nan, median))
    return np.concatenate(parts)


_SHIFTS_AT_ONCE = 500


def _medians(values: FloatArray, counts: BoolArray) -> FloatArray:
    """Median of each row (n, m) over the values that count; NaN where none does."""
    ordered = np.sort(np.where(counts, values, np.inf), axis=1)
    number, row = counts.sum(axis=1), np.arange(len(values))
    low, high = np.maximum(number - 1, 0) // 2, np.minimum(number // 2, values.shape[1] - 1)
    with np.errstate(invalid="ignore"):
        return np.where(number > 0, 0.5 * (ordered[row, low] + ordered[row, high]), np.nan)
