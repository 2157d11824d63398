"""Rows of a log that count: positions that are scored, and a sounder in lock.

Rows of a log that a comparison scores: those that no flag voids.

Times when the receiver of AERPAW's channel sounder was in lock.

Levels that stay the same to all digits while the aircraft flies on: a receiver or logger that stopped.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

import numpy as np
import pandas as pd

from ..common.errors import InputError
from ..common.units import AnyArray, BoolArray, FloatArray
from ..compare.level import aligned_quality, at_times
from ..logs.limits import UNSCORED
from ..logs.records import Stream


def unscored(frame: pd.DataFrame) -> BoolArray:
    """Rows (n,) that carry a flag of :data:`~aerpaw_cmp.logs.limits.UNSCORED`."""
    flag = frame["flag"].to_numpy(dtype=object)
    out = np.zeros(len(flag), dtype=np.bool_)
    # one by one: few rows have a flag
    for i in np.flatnonzero(flag != ""):
        out[i] = any(word in UNSCORED for word in str(flag[i]).split(";"))
    return out


def without_values(stream: Stream, path: str) -> InputError | None:
    """Return the error of a series of which no row can be scored; None if a row can.

    A phone writes -1 for each level of a network that it does not receive: its other series are still good.
    """
    try:
        frame, _ = scored_rows(stream, path)
    except InputError as error:
        return error
    value = frame["rss_db" if stream.kind == "rss" else "rank"]
    # a row without a signal or without CSI has no number either, but its flag is a measurement
    if value.notna().any() or (frame["flag"] != "").any() or not len(frame):
        return None
    return InputError(
        f"{stream.kind} {stream.name!r} has no value in any row",
        expected="a number",
        cause="a column that the program left empty",
        path=path,
    )


def scored_rows(stream: Stream, path: str) -> tuple[pd.DataFrame, dict[str, int]]:
    """The rows that are scored, and how many the others are per flag.

    Parameters
    ----------
    stream : Stream
    path : str
        Of its log, for the message.

    Raises
    ------
    InputError
        If no row is left.
    """
    frame = stream.frame
    void = unscored(frame)
    if not void.any():
        return frame, {}
    words = Counter(w for text in frame["flag"][void] for w in str(text).split(";") if w in UNSCORED)
    if void.all():
        raise InputError(
            f"every row of {stream.kind} {stream.name!r} is flagged {', '.join(words)}",
            expected="values that can be, see docs/formats.md",
            cause="another unit, or exchanged columns",
            path=path,
        )
    return frame[~void], dict(words)


# Quality [dB] at perfect lock (the peak of 4095 chips), and below which the receiver has lost it.
_LOCK_QUALITY_DB, _LOST_QUALITY_DB = 20.0 * float(np.log10(4095.0)), 60.0

# Level [dB re full scale] below which the receiver loses its lock: what it then writes is noise.
LOCK_FLOOR_DB = -15.0

# A quality of another log stands for a level this near in time.
_WITHIN_S = 0.1


def may_lose_lock(stream: Stream) -> bool:
    """Check whether a stream is the lock quality of the sounder: where locked, it stays near its peak."""
    if stream.kind != "rss" or stream.name != "quality":
        return False
    quality = stream.frame["rss_db"].to_numpy(np.float64)
    locked = quality[quality > _LOST_QUALITY_DB]
    # near its peak wherever it is locked: an SNR of another receiver spreads over tens of decibels
    return bool(len(locked)) and abs(float(np.median(locked)) - _LOCK_QUALITY_DB) < 3.0


def is_sounder_power(stream: Stream) -> bool:
    """Check whether a stream may be the level beside such a quality."""
    return stream.kind == "rss" and stream.name == "power" and stream.attributes.get("unit") == "dB re full scale"


def lock_of(power: Stream, candidates: Iterable[Stream]) -> tuple[FloatArray | None, str]:
    """Lock state of a sounder's receiver at each row of its level.

    Parameters
    ----------
    power : Stream
    candidates : iterable of Stream
        Of the flight, those of the same file first; the first lock quality that shares time with the level is taken.

    Returns
    -------
    (n,) or None, str
        1 in lock, 0 where lost, NaN unknown, for each row of the level; and what is to be said of the quality's times.
    """
    if not is_sounder_power(power):
        return None, ""
    time = _seconds(power)
    for candidate in candidates:
        if not may_lose_lock(candidate):
            continue
        at, quality = _seconds(candidate), candidate.frame["rss_db"].to_numpy(np.float64)
        remark = ""
        if len(at) == len(time) and np.array_equal(at, time):
            quality, shift_s = aligned_quality(time, power.frame["rss_db"].to_numpy(np.float64), quality)
            if shift_s:
                remark = (
                    f"the quality is paired with the power by row and runs up to {shift_s:.0f} s ahead: it is taken "
                    "at its own times, 0.032768 s a row"
                )
        else:
            order = np.argsort(at, kind="stable")  # a log may have been put together of parts
            quality = at_times(time, at[order], quality[order], within_s=_WITHIN_S)
        if np.isfinite(quality).any():
            return np.where(np.isfinite(quality), (quality > _LOST_QUALITY_DB).astype(np.float64), np.nan), remark
    return None, ""


def _seconds(stream: Stream) -> FloatArray:
    return np.asarray(stream.frame["time"].to_numpy("datetime64[ns]").astype(np.int64) * 1e-9)


FLAG = "level_frozen"
# A run of one level is suspicious from this duration [s], number of samples and distance flown [m] on.
_LEAST_S, _LEAST, _LEAST_M = 5.0, 10, 15.0
# Levels in whole and half dB repeat themselves in every hover.
_COARSE_DB = 0.5
# Chance of such a run, by the share of equal neighbours elsewhere, below which the channel does not explain it.
_CHANCE = 1e-6
# Second differences of noise are larger than its differences (by the root of 3), those of a smooth level are smaller.
_NOISY, _LEAP = 1.2, 3.0


def frozen(time: AnyArray, level_db: FloatArray, position_m: FloatArray) -> BoolArray:
    """Return the mask of samples (n,) that repeat a frozen level, without the first of each run.

    A smooth level repeats itself where it passes its maximum or reaches the end of its scale, and goes on from there.
    It is frozen only if it leaps as the run ends, or if the series ends there with higher and lower levels before. A
    level with noise is frozen wherever chance does not explain the run.

    Parameters
    ----------
    time : (n,)
        datetime64[ns], in order.
    level_db : (n,)
        NaN out of coverage.
    position_m : (n, 3)
        Position of the UAV, NaN if the track does not know it.
    """
    out = np.zeros(len(level_db), dtype=np.bool_)
    same = np.diff(level_db) == 0
    # distinct levels: a run that is frozen at a half dB must not make a coarse series of a fine one
    levels = np.unique(level_db[np.isfinite(level_db)]) / _COARSE_DB
    if same.sum() < _LEAST or (np.abs(levels - np.round(levels)) > 1e-6).mean() < 0.5:
        return out
    noisy, usual_db = _is_noisy(level_db), _large(np.diff(level_db)[~same])
    begins = np.concatenate([[0], np.flatnonzero(~same) + 1])
    ends = np.append(begins[1:], len(level_db))
    for begin, end in zip(begins, ends, strict=True):
        if end - begin < _LEAST or (time[end - 1] - time[begin]) / np.timedelta64(1, "s") < _LEAST_S:
            continue
        repeats = end - begin - 1
        elsewhere = (same.sum() - repeats + 1) / (len(same) - repeats + 1)
        place = position_m[begin:end][np.isfinite(position_m[begin:end]).all(axis=1)]
        flown = len(place) > 1 and np.linalg.norm(np.ptp(place, axis=0)) > _LEAST_M
        if end < len(level_db):
            leaps = abs(level_db[end] - level_db[begin]) > _LEAP * usual_db
        else:
            leaps = np.nanmin(level_db) < level_db[begin] < np.nanmax(level_db)
        if flown and (noisy or leaps) and len(level_db) * elsewhere**repeats < _CHANCE:
            out[begin + 1 : end] = True
    return out


def _large(difference_db: FloatArray) -> float:
    """Return the size that nine differences in ten (n,) stay below [dB]; 0 if there is none."""
    known = np.abs(difference_db[np.isfinite(difference_db)])
    return float(np.quantile(known, 0.9)) if len(known) else 0.0


def _is_noisy(level_db: FloatArray) -> bool:
    """Check whether a level (n,) changes by noise rather than smoothly; the rounding of a smooth level is not noise."""
    step = np.diff(level_db[np.isfinite(level_db)])
    sizes = np.abs(step[step != 0])
    if not len(sizes):
        return False
    # leaps count as large steps: one of them must not make noise of a smooth level
    first, second = (np.minimum(np.abs(d), _large(d)) for d in (step, np.diff(step)))
    rms, rms_second = float(np.sqrt(np.mean(first**2))), float(np.sqrt(np.mean(second**2)))
    return rms_second > _NOISY * rms and rms > sizes.min()
