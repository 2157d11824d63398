"""Speeds judge clocks and positions: no small aircraft flies faster than 100 m/s, or gains 10 m/s in a second.

A few positions that the rows around them cannot be reached from in time are jumps of the receiver, flagged and read as
missing; so is a place at which a log begins or ends without moving, such as the origin of an autopilot's filter.
Positions that stay the same while the logged speed moves the aircraft on are stale, flagged and read as missing, too.
A track that is too fast throughout has its times in another unit; one that is in two places at once is of two
vehicles. Both are reported, and their values stay as they are.
"""

from __future__ import annotations

import numpy as np
import pandas as pd

from ..common.counting import counted
from ..common.geodesy import rough_m
from ..common.units import BoolArray, FloatArray, IntArray
from .records import Stream

FASTEST_MPS = 100.0
FLAG, STALE = "position_jump", "position_stale"
PLACE = ("latitude_deg", "longitude_deg", "altitude_m")

# Further than this is no jitter of a receiver between two rows of (nearly) one time [m].
_JITTER_M = 15.0

# Jumps are few; where more rows do not fit, the track is not one track, or its times are wrong.
_FEW_SHARE = 0.2

# An aircraft gains less speed than this in a second [m/s^2].
_GAIN_MPS2 = 10.0

# Moves on either side of a step that show how fast the aircraft was.
_AROUND = 3

# Positions are stale from this duration [s] and this mean logged speed [m/s] on; a receiver reports once a second.
_STALE_S, _STALE_MPS = 3.0, 1.0

# A step back is shorter than this share of the steps there.
_BACK_SHARE = 0.2


def jumps_of(stream: Stream) -> tuple[BoolArray, str]:
    """Rows (n,) of a stream whose position is a jump, and a sentence on them or on the track; empty where all fits.

    Parameters
    ----------
    stream : Stream
    """
    none = np.zeros(len(stream.frame), dtype=np.bool_)
    if not {"latitude_deg", "longitude_deg"} <= set(stream.frame.columns):
        return none, ""
    rows, time_s, place_m = path_of(stream.frame)
    if len(rows) < 3:
        return none, ""
    speed_mps = _speed_mps(time_s, place_m)
    what = f"{stream.kind} {stream.name!r}"
    if speed_mps > FASTEST_MPS and not _comes_back(time_s, place_m):
        return none, (
            f"{what}: its positions imply {speed_mps:.0f} m/s throughout: are its times in another unit, "
            "such as milliseconds?"
        )
    astray, at_rest, fast_mps, at = _astray(time_s, place_m)
    if not astray.any() and speed_mps <= FASTEST_MPS:
        return none, ""
    if speed_mps > FASTEST_MPS or float((astray & ~at_rest).mean()) > _FEW_SHARE:
        return none, (
            f"{what}: its positions change between places that cannot be reached in time: two vehicles, or two "
            "receivers, in one table?"
        )
    out = none.copy()
    out[rows[astray]] = True
    line = int(stream.frame["line"].iloc[rows[at]])
    return out, (
        f"{what}: {counted(int(out.sum()), 'row is', 'rows are')} flagged {FLAG}; the first: {fast_mps:.0f} m/s to the "
        f"position in line {line}; read as missing"
    )


def path_of(frame: pd.DataFrame) -> tuple[IntArray, FloatArray, FloatArray]:
    """Rows with a time and a position, their times [s], and east, north, up [m] about the first."""
    time = frame["time"].to_numpy("datetime64[ns]")
    latitude, longitude = (frame[name].to_numpy(np.float64) for name in PLACE[:2])
    known = np.isfinite(latitude) & np.isfinite(longitude) & ~np.isnat(time) & ((latitude != 0) | (longitude != 0))
    rows = np.flatnonzero(known)
    if not len(rows):
        return rows, np.zeros(0), np.zeros((0, 3))
    up = frame[PLACE[2]].to_numpy(np.float64)[rows] if PLACE[2] in frame else np.zeros(len(rows))
    known_up = np.flatnonzero(up > -900.0)  # -999 is what loggers write without a fix
    up = np.interp(np.arange(len(up)), known_up, up[known_up]) if len(known_up) else np.zeros(len(up))
    flat = rough_m(latitude[rows], longitude[rows], (float(np.median(latitude[rows])), longitude[rows[0]]))
    return rows, (time[rows] - time[rows[0]]) / np.timedelta64(1, "s"), np.column_stack([flat, up])


def _speed_mps(time_s: FloatArray, place_m: FloatArray) -> float:
    """Median speed of the part in which the track moves, over steps long enough for stamps written in bursts."""
    # over a fiftieth of the track: loggers write a second's rows in one burst
    apart = max(1, len(time_s) // 50)
    step_m = np.linalg.norm(place_m[apart:] - place_m[:-apart], axis=1)
    step_s = np.abs(time_s[apart:] - time_s[:-apart])
    # a hover says nothing about the unit of times
    moving = (step_s > 0) & (step_m > 1.0)
    return float(np.median(step_m[moving] / step_s[moving])) if moving.sum() >= 3 else 0.0


class _Reach:
    """How far an aircraft gets between two rows of a track: not faster than any, nor than its own speed and thrust.

    Parameters
    ----------
    time_s : (n,)
    place_m : (n, 3)
    """

    def __init__(self, time_s: FloatArray, place_m: FloatArray) -> None:
        self._time_s, self._place_m = time_s, place_m
        self._usual_mps, self._interval_s = np.full(len(time_s), FASTEST_MPS), 0.0
        step_m = np.linalg.norm(np.diff(place_m[:, :2], axis=0), axis=1)
        moves = np.flatnonzero(step_m > 0)
        if len(moves) < 2 * _AROUND:
            return
        # a receiver may report more rarely than the logger writes
        self._interval_s = float(np.median(np.abs(np.diff(time_s[moves]))))
        step_s = np.maximum(np.abs(np.diff(time_s)), self._interval_s)[moves]
        speed = np.pad(step_m[moves] / np.maximum(step_s, 1e-9), _AROUND, mode="reflect")
        around = np.lib.stride_tricks.sliding_window_view(speed, 2 * _AROUND + 1)
        usual = np.median(np.delete(around, _AROUND, axis=1), axis=1)
        self._usual_mps = usual[np.searchsorted(moves, np.arange(len(time_s))).clip(0, len(moves) - 1)]

    def beyond(self, first: IntArray, second: IntArray) -> BoolArray:
        """Return the mask of pairs of rows that are farther apart than the time between them allows."""
        # either way in time: a clock that steps back is no jump of the position
        seconds = np.abs(self._time_s[second] - self._time_s[first])
        apart_m = self._place_m[second] - self._place_m[first]
        usual_s = np.maximum(seconds, self._interval_s)
        flown_m = (self._usual_mps[np.minimum(first, second)] + _GAIN_MPS2 * usual_s) * usual_s
        too_far = np.linalg.norm(apart_m, axis=1) > FASTEST_MPS * seconds + _JITTER_M
        return np.asarray(too_far | (np.linalg.norm(apart_m[:, :2], axis=1) > flown_m + _JITTER_M))


def _runs(time_s: FloatArray, place_m: FloatArray) -> tuple[IntArray, IntArray]:
    """First rows, and the rows behind the last, of the runs that fast steps divide a track into."""
    rows = np.arange(len(time_s))
    begins = np.concatenate([[0], np.flatnonzero(_Reach(time_s, place_m).beyond(rows[:-1], rows[1:])) + 1])
    return begins, np.append(begins[1:], len(time_s))


def stale_of(stream: Stream) -> tuple[BoolArray, str]:
    """Return the rows (n,) whose position stays the same while the logged speed moves on, and a sentence on them.

    Parameters
    ----------
    stream : Stream
    """
    frame, none = stream.frame, np.zeros(len(stream.frame), dtype=np.bool_)
    if not {*PLACE[:2], *_SPEEDS} <= set(frame.columns):
        return none, ""
    rows, time_s, place_m = path_of(frame)
    speed = np.hypot(*(frame[name].to_numpy(np.float64)[rows] for name in _SPEEDS))
    if len(rows) < 3 or not np.nan_to_num(speed).any():
        return none, ""
    travel_m = np.concatenate([[0.0], np.cumsum(np.nan_to_num(speed[1:]) * np.abs(np.diff(time_s)))])
    begins = np.concatenate([[0], np.flatnonzero((np.diff(place_m[:, :2], axis=0) != 0).any(axis=1)) + 1])
    last = np.append(begins[1:], len(rows)) - 1
    lasts_s, moved_m = np.abs(time_s[last] - time_s[begins]), travel_m[last] - travel_m[begins]
    runs = (lasts_s > _STALE_S) & (moved_m > _JITTER_M) & (moved_m > _STALE_MPS * lasts_s)
    if not runs.any():
        return none, ""
    for first, end in zip(begins[runs], last[runs], strict=True):
        none[rows[first + 1 : end + 1]] = True  # the first of them is where the aircraft was
    longest = int(np.argmax(np.where(runs, lasts_s, 0.0)))
    line, speed_mps = int(frame["line"].iloc[rows[begins[longest]]]), moved_m[longest] / lasts_s[longest]
    return none, (
        f"{stream.kind} {stream.name!r}: {counted(int(none.sum()), 'row is', 'rows are')} flagged {STALE}: positions "
        f"stand still for {lasts_s[longest]:.0f} s from line {line} on, at a logged speed of {speed_mps:.1f} m/s; "
        "read as missing"
    )


_SPEEDS = ("velocity_north_mps", "velocity_east_mps")


def _comes_back(time_s: FloatArray, place_m: FloatArray) -> bool:
    """Check whether fast steps lead back to where the track was a step or two before: it is of several vehicles."""
    begins, ends = _runs(time_s, place_m)
    apart_m = [
        float(np.median(np.linalg.norm(place_m[begins[lag:]] - place_m[ends[:-lag] - 1], axis=1)))
        for lag in (1, 2, 3) if len(begins) > lag + 1
    ]  # fmt: skip
    return len(apart_m) > 1 and min(apart_m[1:]) < _BACK_SHARE * apart_m[0]


def _astray(time_s: FloatArray, place_m: FloatArray) -> tuple[BoolArray, BoolArray, float, int]:
    """Rows (n,) off the track, those of them at rest at an end, the greatest speed that the first implies, its number.

    Rows between two fast steps form a run. From the longest run that moves on, in both directions, a run that the
    track cannot reach in time is off it if it is short, or if the log begins or ends with it and it does not move; any
    other goes on elsewhere, as after a time without fixes.
    """
    count = len(time_s)
    astray, at_rest = np.zeros((2, count), dtype=np.bool_)
    begins, ends = _runs(time_s, place_m)
    if len(begins) == 1:
        return astray, at_rest, 0.0, 0
    extent_m = np.array([np.ptp(place_m[a:b], axis=0).max() for a, b in zip(begins, ends, strict=True)])
    still = extent_m < _JITTER_M
    # the longest run is the track: jumps are short, and a log at rest may be longer than the flight
    main = int(np.argmax((ends - begins) * (~still | still.all())))
    few, reach = max(3.0, 0.05 * count), _Reach(time_s, place_m)

    def walk(runs: range, near: IntArray, far: IntArray) -> None:
        last = far[main]
        for run in runs:
            short, end = ends[run] - begins[run] <= few, still[run] and run in (0, len(begins) - 1)
            if (short or end) and reach.beyond(np.array([last]), near[run : run + 1])[0]:
                astray[begins[run] : ends[run]] = True
                at_rest[begins[run] : ends[run]] = not short
            else:
                last = far[run]

    walk(range(main + 1, len(begins)), begins, ends - 1)
    walk(range(main - 1, -1, -1), ends - 1, begins)
    at = int(np.argmax(astray))
    step_m = np.linalg.norm(np.diff(place_m, axis=0), axis=1)
    step_s = np.maximum(np.abs(np.diff(time_s)), 1e-3)
    return astray, at_rest, float((step_m / step_s)[max(at - 1, 0) : at + 1].max()), at
