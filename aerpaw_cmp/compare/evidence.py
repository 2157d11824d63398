"""Evidence for the cause of a level error: one channel of a flight, and its means over seconds and hovers."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from ..common.units import AnyArray, BoolArray, FloatArray, IntArray
from ..site.learned import LearnedSeries
from .result import ClockResult

# Samples are averaged over this time [s]. Longer flights have longer means, so that their number is limited.
BIN_S, _MOST_BINS = 1.0, 2000
# Consecutive means are joined while the UAV moves [m] and turns [deg] by less than this, because fading hardly changes
# in a hover, so the means are not independent. A slow orbit at 1.5 m/s is not joined.
_NEAR_M, _NEAR_DEG = 1.0, 5.0
_FEWEST_BINS, _ENOUGH_BINS = 24, 100
FEWEST_SAMPLES = 100
EPOCH = np.datetime64(0, "s")
# Samples at a limit: largest distance from the extreme level [dB], smallest share and number of samples, and largest
# ratio of their fading to that of other samples.
PILE_DB, _LEAST_PILE, LEAST_BINS, MOST_FADING = 1.2, 0.1, 5, 0.35


@dataclass(frozen=True, slots=True, kw_only=True)
class LevelEvidence:
    """The evidence for a cause: one channel of a flight.

    Parameters
    ----------
    time_s : (n,)
        Ascending times [s].
    measured_db, predicted_db : (n,)
        Levels before any offset; NaN if missing.
    place_m : (n, 3)
        Positions of the UAV [m].
    uav_azimuth_deg, uav_elevation_deg : (n,)
        Direction of the tower in the frame of the UAV's antenna.
    tower_azimuth_deg : (n,)
        Direction of the UAV seen from the tower, clockwise from north.
    name, unit : str
        Name of the channel and unit of its measured level.
    start : datetime64
        Time at which ``time_s`` is 0.
    tower : str
        Tower of the channel.
    antenna : {"isotropic", "measured", "learned"}
        Kind of the UAV's antenna.
    turned_db, raised_db : mapping of float to (n,)
        Change of the predicted level by an increase of the heading [deg], and of the height [m]. ``turned_db`` is empty
        for antennas without a pattern.
    attitude_db : mapping of str to (n,)
        Change of the predicted level with other values of ``rt.attitude``.
    misread_db : mapping of str to (n,)
        Change of the predicted level if the telemetry has another meaning, or its heights have another unit, by that
        meaning in words.
    other_towers_db : mapping of str to (n,)
        Predicted level of each other tower of the site.
    towers : set of str
        Towers of the flight that have a channel with the same name.
    locked, serving : (n,), optional
        1 if in lock (or served by this cell), 0 if not, NaN if unknown. None if the log has no such column.
    clock : ClockResult, optional
        Test result of the radio clock.
    floored : bool
        True if the settings remove levels at the floor, so that only upward fading of the lowest links remains.
    limits_known : bool
        True if both levels were already raised to the receiver's floor, as in the numbers of the page.
    learned : LearnedSeries, optional
        Learned antenna of the tower with the errors of held-out flights, if the flight uses one.
    transmit_power_dbm : float
        Transmit power of the predicted level.
    distance_db : (n,), optional
        Part of the predicted level that depends only on the distance.
    displaced_db : mapping of (float, float) to (n,)
        Change of the predicted level if the tower is moved, by distance [m] and azimuth [deg] of the move.
    least : (n,) bool, optional
        Mask of samples at the lowest level of the log (exactly, or within its noise), if that level is frequent.
    others : tuple of LevelEvidence
        The other channels of the tower. Their levels step at the same time if a cable or a gain changes, and their logs
        may be swapped.
    step_db : float
        Smallest difference between two levels of the log: its rounding.
    """

    time_s: FloatArray
    measured_db: FloatArray
    predicted_db: FloatArray
    place_m: FloatArray
    uav_azimuth_deg: FloatArray
    uav_elevation_deg: FloatArray
    tower_azimuth_deg: FloatArray
    name: str = ""
    unit: str = "dBm"
    start: np.datetime64 = EPOCH
    tower: str = ""
    antenna: str = "measured"
    turned_db: Mapping[float, FloatArray] = field(default_factory=dict)
    raised_db: Mapping[float, FloatArray] = field(default_factory=dict)
    attitude_db: Mapping[str, FloatArray] = field(default_factory=dict)
    misread_db: Mapping[str, FloatArray] = field(default_factory=dict)
    other_towers_db: Mapping[str, FloatArray] = field(default_factory=dict)
    towers: frozenset[str] = frozenset()
    locked: FloatArray | None = None
    serving: FloatArray | None = None
    clock: ClockResult | None = None
    floored: bool = False
    limits_known: bool = False
    learned: LearnedSeries | None = None
    transmit_power_dbm: float = 0.0
    distance_db: FloatArray | None = None
    displaced_db: Mapping[tuple[float, float], FloatArray] = field(default_factory=dict)
    least: BoolArray | None = None
    others: tuple[LevelEvidence, ...] = ()
    step_db: float = 0.0


def in_bins(evidence: LevelEvidence) -> LevelEvidence | None:
    """Return means over :data:`BIN_S` and over hovers of the samples with both levels, or None for too few samples."""
    finite = np.isfinite(evidence.measured_db) & np.isfinite(evidence.predicted_db)
    level = evidence.measured_db[finite]
    # two levels or few samples do not show how the error varies
    if len(level) < FEWEST_SAMPLES or len(np.unique(level)) == 2:
        return None
    time, level = evidence.time_s[finite], evidence.measured_db[finite]
    width = max(min(BIN_S, float(np.ptp(time)) / _ENOUGH_BINS), float(np.ptp(time)) / _MOST_BINS, 1e-3)
    _, place = np.unique(np.floor(time / width), return_inverse=True)
    place = _standing(evidence, finite, place)[place]
    count = np.bincount(place).astype(np.float64)
    if len(count) < _FEWEST_BINS:
        return None

    def mean(values: FloatArray) -> FloatArray:
        return _mean(values[finite], place, count)

    def binned(name: str, value: object) -> object:
        if isinstance(value, Mapping):
            return {key: mean(column) for key, column in value.items()}
        if not isinstance(value, np.ndarray):
            return value
        if name not in ("uav_azimuth_deg", "tower_azimuth_deg"):
            # treat missing flags as 1: a gap in the log is not an error
            return mean(np.nan_to_num(value, nan=1.0) if name in ("locked", "serving") else value)
        # average unit vectors, because the mean direction of 359 and 1 degrees is 0, not 180
        turn = np.exp(1j * np.radians(value))
        return np.degrees(np.angle(mean(turn.real) + 1j * mean(turn.imag)))

    changed = {f.name: binned(f.name, getattr(evidence, f.name)) for f in dataclasses.fields(evidence)}
    at = level == level.min()
    # if levels are rounded, each level occurs often. The lowest level is a floor only if it occurs at least as often as
    # the next higher level.
    next_often = (level == level[~at].min()).sum() if not at.all() else 0
    # count a run of equal levels as one measurement, because the log repeats levels
    usual_run = 1.0 + 2.0 * np.median(ages(np.arange(len(level)), level)[~at]) if not at.all() else 1.0
    often = at.sum() >= max(_AT_END * usual_run, _SHARE_AT_END * len(level), next_often)
    changed["step_db"] = float(np.diff(np.unique(level)).min(initial=np.inf))
    changed["least"] = np.bincount(place, at) > 0.5 * count if often else _undetected(mean(evidence.measured_db))
    return LevelEvidence(**changed)  # type: ignore[arg-type]


def ages(time_s: AnyArray, level_db: FloatArray) -> FloatArray:
    """Return the time since the last change of the level, for each sample (n,) of a log."""
    changed = np.diff(level_db, prepend=np.nan) != 0.0
    return np.asarray(time_s - np.maximum.accumulate(np.where(changed, time_s, -np.inf)))


def _mean(values: FloatArray, place: IntArray, count: AnyArray) -> FloatArray:
    """Return means of values (n,) or (n, k) over groups, given the group of each value and the group sizes."""
    if values.ndim > 1:
        return np.column_stack([_mean(column, place, count) for column in values.T])
    return np.asarray(np.bincount(place, values) / count)


def _standing(e: LevelEvidence, finite: BoolArray, second: IntArray) -> IntArray:
    """Return a group number for each second. The number stays the same while the UAV neither moves nor turns."""
    azimuth, elevation = np.radians(e.uav_azimuth_deg[finite]), np.radians(e.uav_elevation_deg[finite])
    flat = np.cos(elevation)
    towards = np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])
    count = np.bincount(second)
    # use lists: math.dist is faster for short lists than for arrays
    at, towards = _mean(e.place_m[finite], second, count).tolist(), _mean(towards, second, count).tolist()
    number, begin = np.zeros(len(at), dtype=np.int64), 0
    for i in range(1, len(at)):
        turned = math.dist(towards[i], towards[begin]) > math.radians(_NEAR_DEG)
        moved = turned or math.dist(at[i], at[begin]) > _NEAR_M
        begin = i if moved else begin
        number[i] = number[i - 1] + moved
    return number


# Smallest number and share of samples at one level if a receiver clips.
_AT_END, _SHARE_AT_END = 10, 0.01


def _undetected(level_db: FloatArray) -> BoolArray | None:
    """Return samples (n,) without detection: near or below the most frequent level, if levels drop to it suddenly.

    Return None if the level fades slowly into the densest level, as near a floor or in a hover.
    """
    ordered, step = np.sort(level_db), np.abs(np.diff(level_db))
    within = np.searchsorted(ordered, ordered + 2.0 * PILE_DB, "right") - np.arange(len(ordered))
    low = ordered[within.argmax()]
    under = level_db < low + 3.0 * PILE_DB
    dense = under & (level_db >= low)
    inside, outside, between = dense[1:] & dense[:-1], ~(under[1:] | under[:-1]), under[1:] != under[:-1]
    if inside.sum() < _LEAST_PILE * len(level_db) or min(outside.sum(), between.sum()) < LEAST_BINS:
        return None
    fading_db = float(np.median(step[outside]))
    at_once = np.median(step[between]) > _LOST * fading_db
    return under if at_once and np.median(step[inside]) < MOST_FADING * fading_db else None


# Smallest ratio of the steps into the densest level to the steps of fading, if these are losses of detection. The ratio
# is 9 for a receiver with a noisy lowest level, and 3 for other receivers.
_LOST = 5.0
