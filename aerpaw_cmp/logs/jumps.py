"""Speeds judge clocks and positions: no small aircraft flies faster than 100 m/s.

A few positions that the rows around them cannot be reached from in time are jumps of the receiver, flagged and read as
missing. A track that is too fast throughout has its times in another unit; one that is in two places at once is of two
vehicles. Both are said, and their values stay as they are.
"""

from __future__ import annotations

import numpy as np
import pandas as pd

from ..common.counting import counted
from ..common.geodesy import rough_m
from ..common.units import BoolArray, FloatArray, IntArray
from .records import Stream

FASTEST_MPS = 100.0
FLAG = "position_jump"
PLACE = ("latitude_deg", "longitude_deg", "altitude_m")

# Further than this is no jitter of a receiver between two rows of (nearly) one time [m].
_JITTER_M = 15.0

# Jumps are few; where more rows do not fit, the track is not one track, or its times are wrong.
_FEW_SHARE = 0.2

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
    astray, fast_mps, at = _astray(time_s, place_m)
    if not astray.any() and speed_mps <= FASTEST_MPS:
        return none, ""
    if speed_mps > FASTEST_MPS or float(astray.mean()) > _FEW_SHARE:
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
    up = np.where(up > -900.0, np.nan_to_num(up), 0.0)  # -999 is what loggers write without a fix
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


def _runs(time_s: FloatArray, place_m: FloatArray) -> tuple[IntArray, IntArray]:
    """First rows, and the rows behind the last, of the runs that fast steps divide a track into."""
    step_m = np.linalg.norm(np.diff(place_m, axis=0), axis=1)
    # either way in time: a clock that steps back is no jump of the position
    fast = step_m > FASTEST_MPS * np.abs(np.diff(time_s)) + _JITTER_M
    begins = np.concatenate([[0], np.flatnonzero(fast) + 1])
    return begins, np.append(begins[1:], len(time_s))


def _comes_back(time_s: FloatArray, place_m: FloatArray) -> bool:
    """Check whether fast steps lead back to where the track was a step or two before: it is of several vehicles."""
    begins, ends = _runs(time_s, place_m)
    apart_m = [
        float(np.median(np.linalg.norm(place_m[begins[lag:]] - place_m[ends[:-lag] - 1], axis=1)))
        for lag in (1, 2, 3) if len(begins) > lag + 1
    ]  # fmt: skip
    return len(apart_m) > 1 and min(apart_m[1:]) < _BACK_SHARE * apart_m[0]


def _astray(time_s: FloatArray, place_m: FloatArray) -> tuple[BoolArray, float, int]:
    """Rows (n,) off the track, the greatest speed that the first of them implies, and its number.

    Rows between two fast steps form a run. From the longest run on, in both directions, a short run that the track
    cannot reach in time is off it; a long one goes on elsewhere, as after a time without fixes.
    """
    count = len(time_s)
    astray = np.zeros(count, dtype=np.bool_)
    begins, ends = _runs(time_s, place_m)
    if len(begins) == 1:
        return astray, 0.0, 0
    # the longest run is the track: jumps are short
    main = int(np.argmax(ends - begins))
    few = max(3.0, 0.05 * count)

    def walk(runs: range, near: IntArray, far: IntArray) -> None:
        last = far[main]
        for run in runs:
            here = near[run]
            reach_m = FASTEST_MPS * abs(time_s[here] - time_s[last]) + _JITTER_M
            if np.linalg.norm(place_m[here] - place_m[last]) > reach_m and ends[run] - begins[run] <= few:
                astray[begins[run] : ends[run]] = True
            else:
                last = far[run]

    walk(range(main + 1, len(begins)), begins, ends - 1)
    walk(range(main - 1, -1, -1), ends - 1, begins)
    at = int(np.argmax(astray))
    step_m = np.linalg.norm(np.diff(place_m, axis=0), axis=1)
    step_s = np.maximum(np.abs(np.diff(time_s)), 1e-3)
    return astray, float((step_m / step_s)[max(at - 1, 0) : at + 1].max()), at
