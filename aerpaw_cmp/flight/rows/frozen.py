"""Levels that stay the same to all digits while the aircraft flies on: a receiver or logger that stopped."""

from __future__ import annotations

import numpy as np

from ...common.units import AnyArray, BoolArray, FloatArray

FLAG = "level_frozen"
# A run of one level is suspicious from this duration [s], number of samples and distance flown [m] on.
_LEAST_S, _LEAST, _LEAST_M = 5.0, 10, 15.0
# Levels in whole and half dB repeat themselves in every hover.
_COARSE_DB = 0.5
# Chance of such a run, by the share of equal neighbours elsewhere, below which it is none of the channel.
_CHANCE = 1e-6


def frozen(time: AnyArray, level_db: FloatArray, position_m: FloatArray) -> BoolArray:
    """Return the mask of samples (n,) that repeat a frozen level; the first of each run is a reading.

    Parameters
    ----------
    time : (n,)
        datetime64[ns], in order.
    level_db : (n,)
        NaN out of coverage.
    position_m : (n, 3)
        Of the UAV; NaN where the track does not know it.
    """
    out = np.zeros(len(level_db), dtype=np.bool_)
    same = np.diff(level_db) == 0
    fine = np.abs(level_db / _COARSE_DB - np.round(level_db / _COARSE_DB)) > 1e-6
    if same.sum() < _LEAST or 2 * fine.sum() < np.isfinite(level_db).sum():
        return out
    begins = np.concatenate([[0], np.flatnonzero(~same) + 1])
    ends = np.append(begins[1:], len(level_db))
    for begin, end in zip(begins, ends, strict=True):
        if end - begin < _LEAST or (time[end - 1] - time[begin]) / np.timedelta64(1, "s") < _LEAST_S:
            continue
        repeats = end - begin - 1
        elsewhere = (same.sum() - repeats + 1) / (len(same) - repeats + 1)
        place = position_m[begin:end][np.isfinite(position_m[begin:end]).all(axis=1)]
        flown = len(place) > 1 and np.linalg.norm(np.ptp(place, axis=0)) > _LEAST_M
        if flown and len(level_db) * elsewhere**repeats < _CHANCE:
            out[begin + 1 : end] = True
    return out
