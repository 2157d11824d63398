"""Times when the receiver of AERPAW's channel sounder was in lock."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from ...common.units import FloatArray
from ...compare.level.detection import aligned_quality
from ...compare.level.serving import at_times
from ...logs.records import Stream

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
