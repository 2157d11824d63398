"""Fingerprints of logs: they recognise a changed copy of a log, and not a second flight of the same route.

A fingerprint ``<start>f<digits>f<runs>`` has three parts:

- ``start``: half seconds since 1970, empty if the log has no wall clock.
- ``digits``: the change of a level or a rank every half second, one digit each: mean over 1 s minus mean over 10 s, in
  steps of 0.4 robust standard deviations. Powers in watts count by their logarithm.
- ``runs``: the smallest hashes of short runs of raw readings (a bottom-k sketch, Broder 1997), 8 hex digits each.

Two fingerprints are of one log if they share runs, or if their clocks agree and their digits correlate at some lag. The
digits of a part and of a thinned, resampled, rounded or scaled copy do. Repeated flights of one route share the
ripple of the ground reflection, so their digits correlate, too: only the clock or the raw readings distinguish them.
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
_FEWEST, _LEAST_R, _LEAST_Z = 80, 0.5, 7.5

# Readings of a run, changes in it (a constant level repeats in every log), and every how many-th reading is taken: a
# copy with half or a quarter of the rows has the same runs.
_RUN, _LEAST_CHANGES, _STRIDES = 24, 8, (1, 2, 4)

# Runs in a mark, and shared ones from which two marks are of one log: of 64, a tenth of a log shares about 6.
_RUNS, _LEAST_SHARED = 64, 3

# Multiplier of the hashes: 2^64 over the golden ratio, odd, so that it has an inverse.
_ODD = 0x9E3779B97F4A7C15

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
    return f"{start}{_BEGIN}{digits}{_BEGIN}{_runs(values)}"


def _runs(values: FloatArray) -> str:
    """Return the smallest hashes of runs of changes [1/1000]; changes, because a gain shifts a copy."""
    found = np.concatenate([_hashes(values[phase::stride]) for stride in _STRIDES for phase in range(stride)])
    # a few of them alone are sorted: millions would take a second
    least = np.partition(found, 10 * _RUNS)[: 10 * _RUNS] if len(found) > 10 * _RUNS else found
    return "".join(f"{code:08x}" for code in np.unique(least)[:_RUNS].tolist())


def _hashes(values: FloatArray) -> AnyArray:
    """Return the hash of each run of readings that changes often enough: a rolling polynomial modulo 2^64."""
    steps = np.rint(np.diff(values) * 1e3).astype(np.int64).view(np.uint64)
    if len(steps) < _RUN:
        return np.zeros(0, dtype=np.uint64)
    mixed = steps * np.uint64(_ODD)
    mixed ^= mixed >> np.uint64(29)
    total = _before(mixed * np.cumprod(np.full(len(steps), _ODD, dtype=np.uint64)))
    run = total[_RUN:] - total[:-_RUN]
    run *= np.cumprod(np.full(len(run), pow(_ODD, -1, 1 << 64), dtype=np.uint64))
    run ^= run >> np.uint64(31)
    changes = _before(steps != 0)
    return np.asarray((run * np.uint64(_ODD) >> np.uint64(32))[changes[_RUN:] - changes[:-_RUN] >= _LEAST_CHANGES])


def _before(values: AnyArray) -> AnyArray:
    """Return the sums of the values before each place, and of all."""
    total = np.cumsum(values)
    return np.concatenate([np.zeros(1, dtype=total.dtype), total])


def among(mark: str, marks: Iterable[str]) -> bool:
    """Check whether one of some marks, which a learned file may hold, is of the log of this one."""
    return bool(mark) and any(_same(other, mark) for other in marks)


@lru_cache(maxsize=4096)
def _same(first: str, second: str) -> bool:
    begin, own, runs = _parts(first)
    other, digits, others = _parts(second)
    if len(runs & others) >= _LEAST_SHARED:
        return True
    if min(len(own), len(digits)) < _FEWEST:
        return False
    z, near = _evidence(own, digits), np.True_
    if begin is not None and other is not None:
        lags = np.arange(len(z))
        apart = np.abs(np.where(lags < len(digits), lags, lags - len(z)) + other - begin) + _SLACK
        near = (apart % _HOUR <= 2 * _SLACK) & (apart <= 14 * _HOUR + 2 * _SLACK)
    return bool(((z >= _LEAST_Z) & near).any())


def _parts(mark: str) -> tuple[int | None, str, frozenset[str]]:
    """Return the start of a mark in half seconds since 1970 (None without a wall clock), its digits and its runs."""
    begin, digits, runs = [*mark.split(_BEGIN, 2), "", ""][:3]
    start = int(begin) if begin.isdecimal() and len(begin) < 12 else None
    return start, digits, frozenset(runs[i : i + 8] for i in range(0, len(runs) - 7, 8))


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
