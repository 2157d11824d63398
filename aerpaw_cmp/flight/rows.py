"""Selection of the rows of a log that are scored, by flags, receiver lock and frozen levels.

All rows are scored unless a flag excludes them.

The receiver of AERPAW's channel sounder is in lock if its quality is near the largest possible value.

A level is frozen if all its digits stay the same while the aircraft moves, because the receiver or the logger stopped.
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
    """Return a mask (n,) of rows with a flag of :data:`~aerpaw_cmp.logs.limits.UNSCORED`."""
    flag = frame["flag"].to_numpy(dtype=object)
    out = np.zeros(len(flag), dtype=np.bool_)
    # a loop is fast enough, because few rows have a flag
    for i in np.flatnonzero(flag != ""):
        out[i] = any(word in UNSCORED for word in str(flag[i]).split(";"))
    return out


def without_values(stream: Stream, path: str) -> InputError | None:
    """Return an error if a series has no row to score, otherwise None.

    A phone writes -1 for each level of a network that it does not receive, while its other series are valid.
    """
    try:
        frame, _ = scored_rows(stream, path)
    except InputError as error:
        return error
    value = frame["rss_db" if stream.kind == "rss" else "rank"]
    # a flagged row without a number is also a valid measurement: there was no signal or no CSI
    if value.notna().any() or (frame["flag"] != "").any() or not len(frame):
        return None
    return InputError(
        f"{stream.kind} {stream.name!r} has no value in any row",
        expected="a number",
        cause="a column that the program left empty",
        path=path,
    )


def scored_rows(stream: Stream, path: str) -> tuple[pd.DataFrame, dict[str, int]]:
    """Return the rows that are scored, and the number of excluded rows per flag.

    Parameters
    ----------
    stream : Stream
    path : str
        Path of the log, for the message.

    Raises
    ------
    InputError
        If no row remains.
    """
    frame = stream.frame
    void = unscored(frame)
    if not void.any():
        return frame, {}
    words = Counter(w for text in frame["flag"][void] for w in str(text).split(";") if w in UNSCORED)
    if void.all():
        raise InputError(
            f"every row of {stream.kind} {stream.name!r} is flagged {', '.join(words)}",
            expected="possible values, see docs/formats.md",
            cause="another unit, or swapped columns",
            path=path,
        )
    return frame[~void], dict(words)


# Quality at perfect lock (the peak of 4095 chips), and quality below which lock is lost [dB].
_LOCK_QUALITY_DB, _LOST_QUALITY_DB = 20.0 * float(np.log10(4095.0)), 60.0

# Level below which the receiver loses its lock and writes noise [dB re full scale].
LOCK_FLOOR_DB = -15.0

# Largest time difference between a level and a quality from another log [s].
_WITHIN_S = 0.1


def may_lose_lock(stream: Stream) -> bool:
    """Check whether a stream is the lock quality of the sounder, which stays near its peak in lock."""
    if stream.kind != "rss" or stream.name != "quality":
        return False
    quality = stream.frame["rss_db"].to_numpy(np.float64)
    locked = quality[quality > _LOST_QUALITY_DB]
    # in lock, the quality is near its peak, while the SNR of other receivers varies by tens of decibels
    return bool(len(locked)) and abs(float(np.median(locked)) - _LOCK_QUALITY_DB) < 3.0


def is_sounder_power(stream: Stream) -> bool:
    """Check whether a stream can be a level of the sounder, which may have a lock quality. Any name is possible."""
    levels = stream.kind == "rss" and stream.attributes.get("quantity") is None
    return levels and stream.attributes.get("unit") == "dB re full scale"


def lock_of(power: Stream, candidates: Iterable[Stream]) -> tuple[FloatArray | None, str]:
    """Return the lock state of the receiver of a sounder at each row of its level.

    Parameters
    ----------
    power : Stream
    candidates : iterable of Stream
        Streams of the flight, starting with those of the same file. The first lock quality that overlaps in time with
        the level is used.

    Returns
    -------
    (n,) or None, str
        Lock state per row of the level (1 in lock, 0 without lock, NaN unknown), and a remark about the times of the
        quality. None if there is no lock quality.
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
                    f"the quality is paired with the power by row and is up to {shift_s:.0f} s ahead: its own times "
                    "are used, 0.032768 s per row"
                )
        else:
            order = np.argsort(at, kind="stable")  # parts of a joined log may not be in order of time
            quality = at_times(time, at[order], quality[order], within_s=_WITHIN_S)
        if np.isfinite(quality).any():
            return np.where(np.isfinite(quality), (quality > _LOST_QUALITY_DB).astype(np.float64), np.nan), remark
    return None, ""


def _seconds(stream: Stream) -> FloatArray:
    return np.asarray(stream.frame["time"].to_numpy("datetime64[ns]").astype(np.int64) * 1e-9)


FLAG = "level_frozen"
# A run of equal levels may be frozen if it exceeds this duration [s], number of samples and flown distance [m].
_LEAST_S, _LEAST, _LEAST_M = 5.0, 10, 15.0
# Levels with this resolution or a coarser one repeat in every hover.
_COARSE_DB = 0.5
# A run is not due to chance if its probability is below this value. The probability follows from the share of equal
# neighbours in the rest of the series.
_CHANCE = 1e-6
# A level is noisy if its second differences exceed its differences by this factor. For white noise it is the root of 3,
# for a smooth level it is below 1.
_NOISY, _LEAP = 1.2, 3.0


def frozen(time: AnyArray, level_db: FloatArray, position_m: FloatArray) -> BoolArray:
    """Return a mask (n,) of samples that repeat a frozen level. The first sample of each run is not marked.

    A smooth level can be constant at its maximum or at the end of its scale, and then continue smoothly. Such a run
    counts as frozen only if the level jumps at its end, or if the series ends with the run and had both higher and
    lower levels before. A run of a noisy level counts as frozen if it cannot be due to chance.

    Parameters
    ----------
    time : (n,)
        Ascending times, datetime64[ns].
    level_db : (n,)
        Level; NaN out of coverage.
    position_m : (n, 3)
        Position of the UAV, NaN if unknown.
    """
    out = np.zeros(len(level_db), dtype=np.bool_)
    same = np.diff(level_db) == 0
    # count distinct levels only: a long frozen run at a multiple of 0.5 dB must not make a fine series look coarse
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
    """Return the magnitude [dB] that nine of ten differences (n,) do not exceed, or 0 without differences."""
    known = np.abs(difference_db[np.isfinite(difference_db)])
    return float(np.quantile(known, 0.9)) if len(known) else 0.0


def _is_noisy(level_db: FloatArray) -> bool:
    """Check whether a level (n,) varies by noise and not smoothly. Rounding does not count as noise."""
    step = np.diff(level_db[np.isfinite(level_db)])
    sizes = np.abs(step[step != 0])
    if not len(sizes):
        return False
    # limit jumps, so that a smooth level with one jump does not count as noisy
    first, second = (np.minimum(np.abs(d), _large(d)) for d in (step, np.diff(step)))
    rms, rms_second = float(np.sqrt(np.mean(first**2))), float(np.sqrt(np.mean(second**2)))
    return rms_second > _NOISY * rms and rms > sizes.min()
