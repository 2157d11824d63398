"""Marks of a log: what its readings did from moment to moment, whatever their unit, rate, clock and file are.

A mark is the change of a level or a rank every half second: its mean over one second less its mean over ten, in steps
of 0.4 robust standard deviations, a digit each; a power in watts counts by its logarithm. Two marks are of one log
where they correlate at some lag: so do those of a part and of a thinned, resampled, rounded, shifted or scaled copy.
Flights of one route share what is slower. A mark begins with the clock of its log: of other clocks more is asked.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache

import numpy as np

from ..common.units import AnyArray, FloatArray
from ..logs.records import has_wall_clock

_STEP_S, _MEAN_S, _TREND_S = 0.5, 1.0, 10.0
_LONGEST_S = 4 * 3600.0  # of a longer log the beginning is marked

# Digits of a change: 7 is none; half seconds without readings are dots.
_DIGITS, _MIDDLE, _PER_SD, _GAP = "0123456789abcde", 7, 2.5, "."

_BEGIN = "f"

# Clocks of one log differ by at most a minute, or that and whole hours of a wrong time zone [half seconds].
_SLACK, _HOUR = 120, 7200

# Half seconds that two marks share; correlation, and Fisher's z over its standard deviation, from which they are of one
# log. Largest z of two logs of the field: 7.3, the next 5.7; of a changed copy of most of a log the least is 8.6.
_FEWEST, _LEAST_R, _LEAST_Z, _LEAST_Z_APART = 80, 0.5, 7.5, 9.0

# Readings that are all positive, and below one or over so many decades, are powers.
_POWER_RATIO = 1e3

# Standard deviation of the changes below which a mark tells of the route alone; of real logs the least is 0.26.
_LEAST_SD = 0.2


def mark_of(time: AnyArray, readings: FloatArray) -> str:
    """Mark of the readings (n,) of a series at instants (n,); empty for what tells too little or repeats itself."""
    known = np.flatnonzero(np.isfinite(readings) & ~np.isnat(time))
    # the order of equal times stays: a mark must not depend on the sort
    known = known[np.argsort(time[known], kind="stable")]
    if not len(known):
        return ""
    seconds, values = (time[known] - time[known[0]]) / np.timedelta64(1, "s"), readings[known]
    if values.min() > 0.0 and (values.max() < 1.0 or values.max() > _POWER_RATIO * values.min()):
        values = 10.0 * np.log10(values)
    # about the mean: sums of levels near -90 dB over hours would lose the digits of a change
    total = np.concatenate([[0.0], np.cumsum(values - values.mean())])
    at = np.arange(0.0, min(float(seconds[-1]), _LONGEST_S), _STEP_S)

    def mean(width_s: float) -> tuple[FloatArray, AnyArray]:
        begin, end = (np.searchsorted(seconds, at + side * width_s / 2) for side in (-1, 1))
        return (total[end] - total[begin]) / np.maximum(end - begin, 1), end - begin

    (level, near), (trend, around) = mean(_MEAN_S), mean(_TREND_S)
    told = (near > 0) & (around > 1)
    change = (level - trend)[told]
    if len(change) < _FEWEST or not change.std() > _LEAST_SD:
        return ""
    spread = 1.4826 * float(np.median(np.abs(change)))
    # ranks hardly change: the median of their changes is 0
    spread = spread if spread > 0.05 * change.std() else float(change.std())
    digits = np.clip(np.rint(change / spread * _PER_SD) + _MIDDLE, 0, len(_DIGITS) - 1).astype(np.int64)
    text = np.full(len(at), _GAP)
    text[told] = np.array(list(_DIGITS))[digits]
    digits, apart = "".join(text), int(_TREND_S / _STEP_S)
    # a series that is like itself at another time (a test tone) would be like any other of its kind
    if (_evidence(digits, digits) >= _LEAST_Z)[apart:-apart].any():
        return ""
    # half seconds, so that it counts in steps of the mark
    first = time[known[0]]
    start = round((first - np.datetime64(0, "ns")) / np.timedelta64(500, "ms")) if has_wall_clock(first) else ""
    return f"{start}{_BEGIN}{digits}"


def among(mark: str, marks: Iterable[str]) -> bool:
    """Check whether one of some marks, which a learned file may hold, is of the log of this one."""
    return bool(mark) and any(_same(other, mark) for other in marks)


@lru_cache(maxsize=4096)
def _same(first: str, second: str) -> bool:
    begin, own = _parts(first)
    other, digits = _parts(second)
    if min(len(own), len(digits)) < _FEWEST:
        return False
    z, near = _evidence(own, digits), np.True_
    if begin is not None and other is not None:
        lags = np.arange(len(z))
        apart = np.abs(np.where(lags < len(digits), lags, lags - len(z)) + other - begin) + _SLACK
        near = (apart % _HOUR <= 2 * _SLACK) & (apart <= 14 * _HOUR + 2 * _SLACK)
    return bool((z >= np.where(near, _LEAST_Z, _LEAST_Z_APART)).any())


def _parts(mark: str) -> tuple[int | None, str]:
    """Begin of a mark in half seconds of 1970, None without a wall clock, and its digits."""
    begin, _, digits = mark.rpartition(_BEGIN)
    return int(begin) if begin.isdecimal() and len(begin) < 12 else None, digits


def _evidence(first: str, second: str) -> FloatArray:
    """Fisher's z over its spread at each circular lag, 0 of few or loose pairs; of level and path loss signs differ."""
    # room for every lag, forwards and backwards
    size = 1 << (len(first) + len(second) - 1).bit_length()
    left, right = _spectra(first, size), _spectra(second, size)

    def at_lags(i: int, j: int) -> FloatArray:
        return np.asarray(np.fft.irfft(np.conj(left[i]) * right[j], size))

    count = np.maximum(np.rint(at_lags(0, 0)), 1.0)
    ours, theirs = at_lags(1, 0), at_lags(0, 1)
    variances = (at_lags(2, 0) - ours**2 / count) * (at_lags(0, 2) - theirs**2 / count)
    covariance = np.abs(at_lags(1, 1) - ours * theirs / count)
    # below 1: arctanh of a log with itself would be infinite
    r = np.minimum(covariance / np.sqrt(np.maximum(variances, (0.01 * count) ** 2)), 0.9999)
    z = np.arctanh(r) * np.sqrt(np.maximum(count / _memory(left[1], right[1], size) - 3.0, 0.0))
    return np.where((count >= _FEWEST) & (r >= _LEAST_R), z, 0.0)


def _memory(left: AnyArray, right: AnyArray, size: int) -> float:
    """Digits to one independent pair (Bartlett 1935): changes of a rank last longer than those of a level."""
    ours, theirs = (np.fft.irfft(np.abs(x) ** 2, size)[: round(_TREND_S / _STEP_S)] for x in (left, right))
    return 2.0 * float((ours * theirs).sum() / max(ours[0] * theirs[0], 1.0)) - 1.0


@lru_cache(maxsize=32)
def _spectra(mark: str, size: int) -> AnyArray:
    """Spectra of what is known of a mark, its changes and their squares; strange characters are gaps."""
    code = np.frombuffer(mark.encode("ascii", "replace"), dtype=np.uint8)
    digit = np.full(256, np.nan)
    digit[list(_DIGITS.encode())] = np.arange(len(_DIGITS)) - _MIDDLE
    change = digit[code]
    known = np.isfinite(change)
    change = np.nan_to_num(change)
    return np.asarray(np.fft.rfft(np.stack([known.astype(np.float64), change, change**2]), size))
