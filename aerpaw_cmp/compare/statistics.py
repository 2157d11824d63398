"""Statistics of neighbouring samples: intervals, the memory of a series, passes over the same places.

Draws of a process's mean, power and ratio of powers, from one sequence whose memory is not known.

Neighbouring errors of a flight repeat each other, and how long they do is itself hardly known from one flight. The
sequence is described by its slowest cosine terms, after Mueller and Watson (2008),
doi:10.1111/j.1468-0262.2008.00868.x: given a memory, they are normal with a known covariance. Memories from three times
the flight's length to none at all, rough (exponential) with and without white noise and smooth (Matern 3/2), are
weighted by how well they explain the terms, and by weights that let no memory's 95 % intervals hold much less. Weights
alone make others hold more: long memories must be feared though the terms hardly show them. How far out the ends of an
interval lie among the draws is therefore a matter of the memories that the sequence shows, with the weights and without
(``benchmarks/interval_weights.py`` finds both by simulation).

Uncertainty of numbers that come from neighbouring samples of one flight.

Samples a tenth of a second apart repeat each other. Intervals of errors of levels (offset, RMSE, correlation, two
models in pairs) integrate over how long they do (:mod:`.memory`). Those of ranks rest on blocks: the flight is cut
into blocks as long as the sequence remembers (Politis and White), blocks are drawn with replacement, and the spread of
the statistic over the draws, corrected for the finite number of blocks, gives the interval.

Passes over the same places: what two differ by, and every pair of a season at once.

Of 200 flights with ten links there are 199 000 pairs, so each flight's places are put into one k-d tree, pairs of
flights whose boxes lie apart are not searched, links that were sampled together share one search, and intervals come
in closed form.

Ranks of many small channel matrices at once, by counting eigenvalues of their Gram matrices.

The number of eigenvalues of ``G = H^H H`` above ``lambda_1 / K^2`` is the number of positive pivots of
``G - lambda_1 / K^2`` (Sylvester's law of inertia): fifty multiplications for a 4 x 4 matrix, where its singular values
take LAPACK some four microseconds. A count is certain when it is the same on both sides of the threshold, further
apart than all that ``lambda_1`` and the pivots may be off. The others are left to singular values.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, lru_cache
from itertools import combinations, product
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from ..common.units import BoolArray, ComplexArray, FloatArray, IntArray, Printed, unmasked, wrap_degrees

# Cosine terms that the memory is judged by, of a long sequence; faster ones tell about the power alone. Shorter
# sequences take the largest of a few numbers: each has its own table of memories.
TERMS = 48
_FEWER = np.array([9, 12, 16, 24, 34, TERMS])

# Samples below which nothing is said.
FEWEST = 20

# Length of the sequence over the length of its memory (exponential: exp(-rate) is what two ends share).
RATES = np.geomspace(0.3, 500.0, 18)

# Share of white noise in the slowest fluctuations.
WHITE_SHARES = (0.0, 2e-3, 3e-2)

# White noise in the terms of a smooth memory, which fall by the fourth power of their order.
_SMOOTH_FLOOR = 1e-7

Kind = Literal["mean", "power", "ratio"]

# Correlation lengths over the root mean square distance of a track from its centre. Neighbours differ by the root of 2,
# so that squares of the correlations of one length are those of the next but one below it.
LENGTHS = 0.06 * 2.0 ** (0.5 * np.arange(12))

# What a correlation over place is mixed with: shares of the power of the slow terms that are white noise, and shares
# that are correlated over a fortieth of the flight in time, as fading is.
PLACE_WHITE = 0.002 * 2.0 ** np.arange(9)
PLACE_FADING = (0.1, 0.25, 0.5, 0.75)
_FADING_RATE = 40.0

# Weight of a correlation over place, over the mean weight of one over time, by kind; and the length beyond which it
# falls as one over the length. The terms hardly distinguish such lengths, while the mean and the power of a test depend
# on them. Found by simulation; differences of squares are correlated over half of the errors' length.
_PLACE_WEIGHT = {"mean": (0.06, 1.0), "power": (0.06, 1.0), "ratio": (0.07, 0.3)}

# Positions of a track that its correlations are computed from.
_THINNED = 400

# Share of the samples without a position, and distance from the centre of the track [m], at which only time counts: a
# UAV that hovers is at one place, and what its receiver logs there is noise of the position.
_UNPLACED, _HOVER_M = 0.1, 15.0

# Logarithms of the weights in tenths, by kind, rough memories of each white share and smooth ones, and rate. Stretches
# of the draws in hundredths: what the weighted shares of the memories add, then what the shares without weights do.
_TABLES = Path(__file__).with_name("memory_weights.json")

# Of the standard deviation of the logarithm of the power upwards, over that which the fourth moment says; by simulation
# with Student's t of four degrees of freedom. Most sequences with heavy tails look calmer than the process.
CALM = 1.8

# Parts of a flight whose powers are compared, times the median power from which a part is loud, and samples below which
# it is not asked: on the simulated kinds of ``benchmarks/coverage_of_intervals.py`` at most 4 % of steady flights have
# two loud parts (Student's t of four degrees of freedom, 100 samples), others below 1 %.
_PARTS, _LOUD, _FEWEST_FOR_PARTS = 12, 4.0, 60

# A sum over shares that no simulated flight showed may fall to nothing: eight of ten draws stay within the ends.
_LEAST_STRETCH = 0.6

# Draws come in pairs of opposite sign, so that exchanging two models turns an interval about exactly.
_PAIRS = 2048


@dataclass(frozen=True, slots=True)
class Memories:
    """Memories (m,) at ``terms`` cosine terms: normal distributions of the mean and the terms, up to a scale.

    ``whiten`` (m, terms, terms) makes the terms independent, ``log_det`` (m,) is the logarithm of its determinant;
    ``slope`` (m, terms) and ``variance`` (m,) give mean and variance of the sequence's mean once the terms are known;
    ``power`` (m,) is that of the terms together.
    """

    whiten: FloatArray
    log_det: FloatArray
    slope: FloatArray
    variance: FloatArray
    power: FloatArray

    @classmethod
    def of(cls, covariances: FloatArray) -> Memories:
        """Return the memories whose mean and terms have these covariances (m, terms + 1, terms + 1)."""
        whiten = np.linalg.inv(np.linalg.cholesky(covariances[:, 1:, 1:]))
        cross = covariances[:, 0, 1:]
        slope = np.einsum("mij,mi->mj", whiten, np.einsum("mij,mj->mi", whiten, cross))
        return cls(
            whiten=whiten,
            log_det=np.log(np.diagonal(whiten, axis1=1, axis2=2)).sum(axis=1),
            slope=slope,
            variance=covariances[:, 0, 0] - (cross * slope).sum(axis=1),
            power=np.trace(covariances[:, 1:, 1:], axis1=1, axis2=2),
        )


@cache
def memories(terms: int = TERMS) -> Memories:
    """Rough memories of each of :data:`WHITE_SHARES`, then smooth ones; :data:`RATES` run fastest."""
    white = np.eye(terms + 1)
    covariances = [
        (1.0 - share) * 0.5 * rate * _exponential(rate, terms).real + share * white
        for share in WHITE_SHARES for rate in RATES
    ] + [0.25 * rate * _smooth(rate, terms) + _SMOOTH_FLOOR * white for rate in RATES]  # fmt: skip
    return Memories.of(np.array(covariances))


def place_memories(place_m: FloatArray, terms: int = TERMS) -> Memories | None:
    """Compute the memories of errors that are correlated over place.

    Parameters
    ----------
    place_m : (n, 3)
        East, north and up of each sample, in time order; NaN if unknown [m].
    terms : int
        Cosine terms.

    Returns
    -------
    Memories or None
        One for each mixture of :data:`PLACE_WHITE` and :data:`PLACE_FADING` and for each of :data:`LENGTHS`, which run
        fastest. None if only time counts (:func:`only_time`).

    Notes
    -----
    The terms of errors with covariance K are T K T', where row k of T is the k-th cosine over the number of samples.
    K is exp(-|p_i - p_j| / L) (Gudmundson 1991), formed from every m-th position.
    """
    if only_time(place_m):
        return None
    known = np.flatnonzero(np.isfinite(place_m).all(axis=1))
    step = -(-len(known) // _THINNED)
    at = known[step // 2 :: step]
    return _place_memories(place_m[at].tobytes(), ((at + 0.5) / len(place_m)).tobytes(), terms)


# Channels and models of a flight share its track; each entry takes 4 MB.
@lru_cache(maxsize=8)
def _place_memories(positions: bytes, instants: bytes, terms: int) -> Memories:
    place, instant = np.frombuffer(positions).reshape(-1, 3), np.frombuffer(instants)
    place = place - place.mean(axis=0)
    square = np.square(place).sum(axis=1)
    apart = np.sqrt(np.maximum(square[:, None] + square - 2.0 * place @ place.T, 0.0) / square.mean())
    cosines = np.cos(np.pi * np.outer(np.arange(terms + 1), instant)) * np.sqrt(2.0) / len(instant)
    cosines[0] = 1.0 / len(instant)
    by_length = {}
    for longest in (len(LENGTHS) - 1, len(LENGTHS) - 2):
        correlation = np.exp(-apart / LENGTHS[longest])
        for at in range(longest, -1, -2):
            by_length[at] = cosines @ correlation @ cosines.T
            correlation = np.square(correlation)
    placed = np.array([_unit(by_length[at]) for at in range(len(LENGTHS))])
    white, fading = _unit(np.eye(terms + 1)), _unit(_exponential(_FADING_RATE, terms).real)
    noise = [(share, white) for share in PLACE_WHITE]
    noise += [(share, 0.9 * fading + 0.1 * white) for share in PLACE_FADING]
    return Memories.of(np.concatenate([(1.0 - share) * placed + share * other for share, other in noise]))


def _unit(covariance: FloatArray) -> FloatArray:
    """Scale a covariance of mean and terms to a power of 1 of the terms."""
    return np.asarray(covariance / np.trace(covariance[1:, 1:]))


def only_time(place_m: FloatArray | None) -> str:
    """Return the reason why intervals consider correlation over time alone; empty if they consider place as well.

    Parameters
    ----------
    place_m : (n, 3) or None
        East, north and up of each sample; NaN if unknown [m].
    """
    if place_m is None or not len(place_m):
        return "the positions are not known"
    known = np.isfinite(place_m).all(axis=1)
    if (missing := 1.0 - known.mean()) > _UNPLACED:
        return f"{100.0 * missing:.0f} % of the samples have no position"
    away_m = place_m[known] - place_m[known].mean(axis=0)
    if np.square(away_m).sum(axis=1).mean() < _HOVER_M**2:
        return "the UAV hardly left one place"
    return ""


def _smooth(rate: float, terms: int) -> FloatArray:
    """The same of (1 + rate |s - t|) exp(-rate |s - t|): the exponential less rate times its slope over the rate."""
    step = 1e-20  # along the imaginary axis: exact to rounding
    covariance = _exponential(complex(rate, rate * step), terms)
    return np.asarray(covariance.real - covariance.imag / step)


def _exponential(rate: complex, terms: int) -> ComplexArray:
    """Covariance (terms + 1, terms + 1) of the cosine terms of exp(-rate |s - t|) on the unit interval."""
    order = np.arange(terms + 1)
    sign = np.where(order % 2 == 0, 1.0, -1.0)
    pole = rate**2 + (np.pi * order) ** 2
    ends = (1.0 + np.outer(sign, sign)) * rate**2 * (1.0 - sign * np.exp(-rate)) / np.outer(pole, pole)
    scale = np.where(order == 0, 1.0, np.sqrt(2.0))
    return np.asarray((np.diag(rate * np.where(order == 0, 2.0, 1.0) / pole) - ends) * np.outer(scale, scale))


def _table(name: str) -> FloatArray:
    return np.array(json.loads(_TABLES.read_text(encoding="utf-8"))[name], dtype=np.float64)


@cache
def weights(kind: Kind) -> FloatArray:
    """Weight (m,) of each memory before any sample is seen."""
    drawn = np.exp(0.1 * _table(kind).ravel())
    return np.asarray(drawn / drawn.sum())


@cache
def stretches(kind: Kind) -> FloatArray:
    """Stretch of the draws (2, m) that each memory asks for by its weighted share, and adds by its share without."""
    if kind == "ratio":  # its weights alone hold false verdicts below 5 %
        return np.repeat([[1.0], [0.0]], len(weights(kind)), axis=1)
    return 0.01 * _table(f"{kind} stretch").reshape(2, -1)


@dataclass(frozen=True, slots=True)
class Terms:
    """Cosine terms of a sequence: the slow ones (q,), and power and degrees of freedom of the fast ones."""

    slow: FloatArray
    fast_power: float
    fast_freedom: float


def cosine_terms(values: FloatArray) -> Terms:
    """Cosine terms, scaled so that their squares add up to the mean square about the mean."""
    from scipy.fft import dct

    n = len(values)
    every = dct(values - values.mean(), norm="ortho")[1:] / np.sqrt(n)
    count = int(_FEWER[(n - 1) // 2 >= _FEWER].max())
    fast = np.square(every[count:])
    # Satterthwaite's: a normal term to the fourth power is on average three times its variance squared
    freedom = max(3.0 * float(fast.sum()) ** 2 / max(float((fast * fast).sum()), 1e-300), 1.0)
    return Terms(every[:count], float(fast.sum()), freedom)


@dataclass(frozen=True, slots=True)
class Known:
    """Memories that a sequence may have: over time, then over place, with weights (m,) and stretches (2, m) by kind."""

    parts: tuple[Memories, ...]
    weights: FloatArray
    stretches: FloatArray

    def joined(self, name: str) -> FloatArray:
        """Return a column of the memories, over time and place."""
        return np.concatenate([getattr(part, name) for part in self.parts])


def known_memories(kind: Kind, terms: int, place_m: FloatArray | None = None) -> Known:
    """Return the memories over time, and over place if positions (n, 3) [m] allow it, with what each counts."""
    over_time, weight, stretch = memories(terms), weights(kind), stretches(kind)
    over_place = None if place_m is None else place_memories(place_m, terms)
    if over_place is None:
        return Known((over_time,), weight, stretch)
    size, longest = _PLACE_WEIGHT[kind]
    by_length = size * weight.mean() * longest / np.maximum(LENGTHS, longest)
    placed = np.tile(by_length, len(over_place.power) // len(LENGTHS))
    usual = np.repeat([[1.0], [0.0]], len(placed), axis=1)
    return Known((over_time, over_place), np.concatenate([weight, placed]), np.hstack([stretch, usual]))


def likelihoods(slow: FloatArray, parts: Sequence[Memories] = ()) -> tuple[FloatArray, FloatArray]:
    """Likelihood (..., m) of each memory, its scale integrated out, and the whitened sum of squares (..., m)."""
    parts = parts or (memories(slow.shape[-1]),)
    square = np.concatenate([np.square(slow @ part.whiten.swapaxes(1, 2)).sum(axis=-1).T for part in parts], axis=-1)
    log_det = np.concatenate([part.log_det for part in parts])
    log = log_det - 0.5 * slow.shape[-1] * np.log(np.maximum(square, 1e-300))
    # over the likeliest: the likelihoods themselves leave the range of numbers
    return np.exp(log - log.max(axis=-1, keepdims=True)), square


@cache
def _random(terms: int) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Evenly spread draws, the same for every sequence: uniform, chi-squared of ``terms`` degrees, two unit normals.

    A Kronecker sequence in four dimensions.
    """
    from scipy.special import gammaincinv, ndtri

    ratio = 1.1673039782614187  # x^5 = x + 1
    chance = (0.5 + np.outer(np.arange(1, _PAIRS + 1), ratio ** -np.arange(1.0, 5.0))) % 1.0
    return chance[:, 0], 2.0 * gammaincinv(0.5 * terms, chance[:, 1]), ndtri(chance[:, 2]), ndtri(chance[:, 3])


def _picked(slow: FloatArray, known: Known) -> tuple[IntArray, FloatArray, float]:
    """Memory (draws,) and squared scale (draws,) of each draw, and what :func:`_stretched` does to them all."""
    likelihood, square = likelihoods(slow, known.parts)
    weighted = likelihood * known.weights
    running = np.cumsum(weighted)
    uniform, chi_squared, *_ = _random(len(slow))
    # a chance near 1 may round to the whole sum
    index = np.minimum(np.searchsorted(running, uniform * running[-1]), len(running) - 1)
    own, even = known.stretches
    stretch = float(weighted @ own / running[-1] + likelihood @ even / likelihood.sum())
    return index, square[index] / chi_squared, max(stretch, _LEAST_STRETCH)


def _stretched(drawn: FloatArray, by: float) -> FloatArray:
    """Draws moved away from their median: 2.5 % lie where the odds to the power ``by`` did, on either side."""
    tail = 1.0 / (1.0 + 39.0**by)  # 39 to 1 are the odds of 2.5 %
    # quantiles, in half the time of NumPy's own
    asked, ranks = (tail, 0.025, 0.5, 0.975, 1.0 - tail), np.linspace(0.0, 1.0, len(drawn))
    low, usual_low, middle, usual_high, high = np.interp(asked, ranks, np.sort(drawn))
    # each stays in its place: a correlation takes draws of mean and power in pairs
    below, above = (middle - low) / (middle - usual_low), (high - middle) / (usual_high - middle)
    return np.asarray(middle + (drawn - middle) * np.where(drawn < middle, below, above))


def memory_share(values: FloatArray) -> float:
    """Length of the likeliest memory of a sequence (n,), over that of the sequence."""
    likelihood, _ = likelihoods(cosine_terms(values).slow)
    return float(1.0 / np.tile(RATES, len(WHITE_SHARES) + 1)[int(np.argmax(likelihood * weights("power")))])


def mean_draws(values: FloatArray, kind: Kind = "mean", place_m: FloatArray | None = None) -> FloatArray:
    """Draws of the mean of the process minus the mean of the sequence.

    Parameters
    ----------
    values : (n,)
        In time order, at least :data:`FEWEST`.
    kind : {"mean", "ratio"}
        Errors, or differences of their squares.
    place_m : (n, 3), optional
        East, north and up of each sample, NaN if unknown [m]: errors may then be correlated over place as well.
    """
    if np.ptp(values) == 0.0:
        return np.zeros(2 * _PAIRS)
    slow = cosine_terms(values).slow
    known = known_memories(kind, len(slow), place_m)
    index, scale, stretch = _picked(slow, known)
    centre = -(known.joined("slope") @ slow)[index]
    reach = np.sqrt(scale * known.joined("variance")[index]) * _random(len(slow))[2]
    drawn = np.concatenate([centre + reach, centre - reach])
    return drawn if kind == "ratio" else _stretched(drawn, stretch)


def heavy_tails(values: FloatArray) -> float:
    """Standard deviation of the logarithm of the mean square (see :data:`CALM`) for tails heavier than normal.

    The innovations of a first-order autoregression show them where the sequence itself sums over many.
    """
    away, n = values - values.mean(), len(values) - 1
    keep = min(float(away[1:] @ away[:-1]) / float(away @ away), 1.0)
    both = away[1:] - keep * away[:-1], away[:-1] - keep * away[1:]  # whichever way the time runs
    square = max((np.square(e) for e in both), key=lambda e: float(e @ e) / max(float(e.mean()) ** 2, 1e-300))
    # a short normal sequence shows heavy tails by chance: only what is beyond half of its spread counts
    excess = float(square @ square) / n / max(float(square.mean()) ** 2, 1e-300) - 3.0 - np.sqrt(6.0 / n)
    # a long sequence has met the rare large errors that a short one lacks: sharper by its length, found as CALM was
    return float(np.sqrt(max(excess, 0.0) / n) * (300.0 / n) ** 0.1)


def loud_part(values: FloatArray) -> tuple[float, float]:
    """Find parts of a sequence (n,) that are much louder than the others.

    Returns
    -------
    share, ratio : float
        Share of the samples in the loud parts, and their mean square over that of the others; 0 and 1 if the sequence
        is steady. Two parts at least are loud by the innovations of a second-order autoregression, which are hardly
        correlated, and by their own mean square.
    """
    away = values - values.mean()
    if len(away) < _FEWEST_FOR_PARTS or not away.any():
        return 0.0, 1.0
    later, past = away[2:], np.column_stack([away[1:-1], away[:-2]])
    innovations = later - past @ np.linalg.lstsq(past, later, rcond=None)[0]
    part = np.arange(len(later)) * _PARTS // len(later)
    count, power, square = (np.bincount(part, weight, _PARTS) for weight in (None, innovations**2, later**2))
    loud = power / count > _LOUD * np.median(power / count)
    if not 1 < loud.sum() < _PARTS:
        return 0.0, 1.0
    share = float(count[loud].sum() / len(later))
    ratio = float(square[loud].sum() / square[~loud].sum()) * (1.0 - share) / share
    return (share, ratio) if ratio > _LOUD else (0.0, 1.0)


def power_draws(values: FloatArray, place_m: FloatArray | None = None) -> FloatArray:
    """Draws of the mean square about their own mean that sequences of this length and spacing have on average.

    In the order of :func:`mean_draws`. What a memory longer than the sequence adds to the mean does not count.

    Parameters
    ----------
    values : (n,)
        In time order, at least :data:`FEWEST`. Tails heavier than normal and loud parts (:func:`loud_part`) widen the
        draws.
    place_m : (n, 3), optional
        As for :func:`mean_draws`.
    """
    if np.ptp(values) == 0.0:
        return np.zeros(2 * _PAIRS)
    terms = cosine_terms(values)
    known = known_memories("power", len(terms.slow), place_m)
    index, scale, stretch = _picked(terms.slow, known)
    *_, normal, second_normal = _random(len(terms.slow))
    third = 2.0 / (9.0 * terms.fast_freedom)
    # chi-squared over its degrees of freedom, after Wilson and Hilferty (1931)
    fast = terms.fast_power / np.maximum(1.0 - third + np.sqrt(third) * second_normal, 0.05) ** 3
    share, ratio = loud_part(values)
    # a loud part alone makes the tails of the whole flight heavy, and is counted below
    heavy = (0.7 if share else 1.0) * heavy_tails(values)
    tails = np.exp(heavy * np.where(normal > 0.0, CALM, 1.0) * normal)
    drawn = (scale * known.joined("power")[index] + fast) * tails
    log = _stretched(np.log(drawn), stretch)
    # a loud part has fewer independent samples than the flight: what the variance of a weighted mean grows by
    more = np.sqrt(share * ratio**2 + 1.0 - share) / (share * ratio + 1.0 - share)
    middle = np.median(log)
    return np.tile(np.exp(middle + more * (log - middle)), 2)


# Bootstrap replicates.
REPLICATES = 1000

# One seed feeds all resampling: the same logs give the same intervals.
SEED = 20_250_210

# Blocks are twice Politis and White's length: that one minimises the error of the variance, not of the coverage.
_LONGER = 2.0

# Lags in a row: Politis and White's max(5, sqrt(log10 n)) is 5 for any flight.
_RUN = 5

# Width of an interval over its value from which its lower end alone is given.
_BOUND = 2.0

# Stretches of a flight; the share of each comes from the others.
_STRETCHES = 24

# Share of flights with a false verdict on any channel that is aimed at; at 0.05 it is 1 to 10 % of simulated flights,
# since chances far out are known less well than an interval's ends.
_FAMILY = 0.02

# Numbers held at once per bootstrap: bounds memory to tens of MiB.
_HELD = 1 << 21

Interval = tuple[float, float]
NO_INTERVAL: Interval = (float("nan"), float("nan"))


@dataclass(frozen=True, slots=True)
class Autocorrelation:
    """Memory of a sequence.

    Parameters
    ----------
    n : int
        Samples.
    block_length : int
        Block length for the circular block bootstrap [samples].
    n_effective : float
        Independent samples that would fix the mean equally well, 1 to ``n``; NaN below two samples.
    """

    n: int
    block_length: int
    n_effective: float


def autocovariance(values: ArrayLike, lags: int) -> FloatArray:
    """Biased autocovariance at lags 0 .. ``lags`` (by FFT); values (n,) without NaN."""
    x = unmasked(values)
    n = len(x)
    # twice the length: the transform takes the sequence for a circle
    size = 1 << (2 * n - 1).bit_length()
    spectrum = np.fft.rfft(x - x.mean(), size)
    return np.asarray(np.fft.irfft(np.abs(spectrum) ** 2, size)[: lags + 1] / n)


def _significant(n: int) -> float:
    """Autocorrelation above which a lag counts (Politis and White's rule)."""
    return 2.0 * float(np.sqrt(np.log10(n) / n))


def _cutoff(correlation: FloatArray, n: int) -> int:
    """Last lag before the autocorrelation stays insignificant for :data:`_RUN` lags (Politis and White's rule)."""
    small = np.abs(correlation[1:]) < _significant(n)
    small_so_far = np.concatenate([[0], np.cumsum(small)])
    runs = small_so_far[_RUN:] - small_so_far[:-_RUN] == _RUN
    return int(np.argmax(runs)) if runs.any() else len(small)


def _flat_top(covariance: FloatArray, n: int) -> tuple[float, float, float]:
    """Long-run variance, the sum of its lag window and the sum over lag times covariance, by the flat-top window."""
    lags = min(2 * max(1, _cutoff(covariance / covariance[0], n)), len(covariance) - 1)
    lag = np.arange(1, lags + 1)
    window = np.clip(2.0 * (1.0 - lag / lags), 0.0, 1.0)
    weighted = window * covariance[1 : lags + 1]
    return float(covariance[0] + 2.0 * weighted.sum()), float(1.0 + 2.0 * window.sum()), float((lag * weighted).sum())


def _exponential_decay(covariance: FloatArray, n: int) -> tuple[float, float]:
    """Long-run variance, and the sum over lag times covariance, of white noise plus an exponential memory.

    The decay comes from the ratio of neighbouring lags down to a correlation of one half: the lags that the removed
    mean touches least.
    """
    correlation = covariance / covariance[0]
    if correlation[1] < _significant(n):
        return float(covariance[0]), 0.0
    below = np.flatnonzero(correlation[1:] <= 0.5)
    last = min(max(2, int(below[0]) + 1 if len(below) else len(correlation)), len(correlation) - 1)
    earlier, later = correlation[1:last], correlation[2 : last + 1]
    decay = float(np.clip(earlier @ later / (earlier @ earlier), 0.0, 1.0 - 1.0 / n))
    share = min(1.0, float(correlation[1]) / decay) if decay > 0 else 0.0
    correlated = covariance[0] * share * decay
    return float(covariance[0] + 2.0 * correlated / (1.0 - decay)), float(correlated / (1.0 - decay) ** 2)


def autocorrelation(values: ArrayLike) -> Autocorrelation:
    """Return the block length and the effective sample size of a sequence.

    Parameters
    ----------
    values : array_like, (n,)
        In time order, without NaN.

    Returns
    -------
    Autocorrelation
        A constant sequence and fewer than eight samples give blocks of one.

    Notes
    -----
    With the mean taken off, autocovariances are short by V / n, where V is the long-run variance (sum of all
    autocovariances): on a flight that is a few correlation times long, that hides most of the memory. V is therefore
    solved for together with the covariances that it completes; where no V below n times the variance does, the
    sequence is worth one sample.

    V is the larger of two estimates: the flat-top lag window of Politis and White (2004),
    doi:10.1081/ETC-120028836, and white noise plus an exponential memory (Gudmundson 1991,
    doi:10.1049/el:19911328). The block length is that of Patton, Politis and White (2009),
    doi:10.1080/07474930802459016, for the circular block bootstrap; lags are searched up to n / 2 (not sqrt n),
    because radio samples come many per correlation length, and blocks are at most n / 5. The block variance is short
    by G / (g L) to first order (Kuensch 1989, doi:10.1214/aos/1176347265).

    Examples
    --------
    >>> autocorrelation([1.0, 1.0, 1.0]).block_length
    1
    """
    x = unmasked(values)
    n = len(x)
    if n < 8 or np.ptp(x) == 0.0:
        return Autocorrelation(n, 1 if n else 0, float(n) if n > 1 else float("nan"))
    lags = n // 2
    unbiased = autocovariance(x, lags) * n / (n - np.arange(lags + 1))
    hidden, long_run, reach = 0.0, float(unbiased[0]), 0.0
    for _ in range(12):
        covariance = unbiased + hidden
        by_window, width, window_reach = _flat_top(covariance, n)
        by_decay, decay_reach = _exponential_decay(covariance, n)
        # the window's own sum holds the hidden part width / n times over
        # a window nearly as long as the flight (infinite) says that it is worth one sample
        by_window = (by_window - width * hidden) / (1.0 - width / n) if width < 0.8 * n else np.inf
        long_run, reach = max(by_window, by_decay), max(window_reach, decay_reach)
        if long_run >= n * covariance[0]:
            return Autocorrelation(n, max(1, n // 5), 1.0)
        if long_run <= 0.0:  # oscillating: the mean is known at least as well as from independent samples
            long_run = float(unbiased[0])
        if abs(long_run / n - hidden) < 1e-3 * unbiased[0]:
            break
        hidden = long_run / n
    slope = max(0.0, 2.0 * reach / long_run)
    length = _LONGER * (1.5 * slope**2 * n) ** (1.0 / 3.0)
    # five blocks at least: of fewer the draws repeat each other
    block = int(np.clip(np.ceil(length), 1, max(1, n // 5)))
    effective = float(np.clip(n * (unbiased[0] + hidden) / long_run, 1.0, n))
    return Autocorrelation(n, block, effective)


def bootstrap_means(
    columns: FloatArray,
    block_length: int,
    *,
    replicates: int = REPLICATES,
    seed: int = SEED,
) -> FloatArray:
    """Column means of circular block resamples.

    Parameters
    ----------
    columns : (n, m)
        Samples in time order. Centre them first where squares of large levels would lose digits.
    block_length : int
        Samples per block, 1 .. n.
    replicates : int
        Resamples.
    seed : int
        Of the generator.

    Returns
    -------
    ndarray, (replicates, m)

    Notes
    -----
    The sum over a block is known from its start alone, so a resample is a set of starts: few long blocks are
    gathered, many short ones counted and multiplied (one matrix product for all replicates).
    """
    n, width = columns.shape
    rng = np.random.default_rng(seed)
    blocks = -(-n // block_length)
    sums = _block_sums(columns, block_length)
    last = _block_sums(columns, n - (blocks - 1) * block_length)
    result = np.empty((replicates, width))
    few = 2 * (blocks - 1) * width < n * (3.0 + 0.2 * width)
    chunk = max(1, _HELD // max(1, (blocks - 1) * width if few else n))
    for start in range(0, replicates, chunk):
        count = min(chunk, replicates - start)
        begin = rng.integers(0, n, (count, blocks))
        full_blocks = begin[:, :-1]
        if few:
            total = sums[full_blocks].sum(axis=1)
        else:
            cell = np.arange(count)[:, None] * n + full_blocks
            total = np.bincount(cell.ravel(), minlength=count * n).reshape(count, n).astype(np.float64) @ sums
        result[start : start + count] = (total + last[begin[:, -1]]) / n
    return result


def _block_sums(columns: FloatArray, length: int) -> FloatArray:
    """Sum of ``length`` rows from every start (n, m), on a circle."""
    running = np.zeros((len(columns) + length, columns.shape[1]))
    np.cumsum(np.concatenate([columns, columns[: length - 1]]), axis=0, out=running[1:])
    return np.asarray(running[length:] - running[:-length])


@dataclass(frozen=True, slots=True)
class ErrorIntervals:
    """95 % intervals of one measured and simulated sequence of levels.

    Parameters
    ----------
    offset_db, rmse_db, correlation : (low, high)
        NaN ("no interval") of fewer than :data:`~aerpaw_cmp.compare.statistics.FEWEST` samples, or where the
        statistic does not exist.
    autocorrelation : Autocorrelation
        Of the residual.
    notes : tuple of str
        Sentences on what limits the intervals.
    """

    offset_db: Interval
    rmse_db: Interval
    correlation: Interval
    autocorrelation: Autocorrelation
    notes: tuple[str, ...] = ()


def error_intervals(
    measured_db: FloatArray, simulated_db: FloatArray, place_m: FloatArray | None = None
) -> ErrorIntervals:
    """Intervals of offset (mean difference), RMSE about it and correlation of the process behind a flight.

    Parameters
    ----------
    measured_db, simulated_db : (n,)
        Pairs in time order, without NaN [dB].
    place_m : (n, 3), optional
        As for :func:`mean_draws`.

    Returns
    -------
    ErrorIntervals
        Offset [dB], RMSE [dB], correlation, and the autocorrelation of the residual.
    """
    difference = simulated_db - measured_db
    known = autocorrelation(difference)
    if len(difference) < FEWEST:
        return ErrorIntervals(NO_INTERVAL, NO_INTERVAL, NO_INTERVAL, known)
    return ErrorIntervals(
        mean_interval(difference, place_m),
        spread_interval(difference, place_m),
        _correlation_interval(measured_db, simulated_db, place_m),
        known,
        tuple(_notes(difference, place_m)),
    )


def _notes(values: FloatArray, place_m: FloatArray | None) -> Iterator[str]:
    """Sentences on what limits the intervals of a sequence (n,)."""
    if place_m is not None and (reason := only_time(place_m)):
        yield f"The intervals consider correlation over time alone: {reason}."
    share, ratio = loud_part(values)
    if share:
        yield (
            f"The error is not stationary: it is {np.sqrt(ratio):.1f} times larger in {100.0 * share:.0f} % of the "
            "flight. The interval of the RMSE is widened for that and can still be too narrow."
        )


def _correlation_interval(measured_db: FloatArray, simulated_db: FloatArray, place_m: FloatArray | None) -> Interval:
    """The route was flown as it was: only slope and rest of the measurement over the simulation are random."""
    s, m = simulated_db - simulated_db.mean(), measured_db - measured_db.mean()
    spread = float(s @ s) / len(s)
    if spread == 0.0 or not m.any():
        return NO_INTERVAL
    slope = float(m @ s) / len(s) / spread
    residual = m - slope * s
    along = (slope + mean_draws(residual * s, place_m=place_m) / spread) * np.sqrt(spread)
    return _around(correlation(measured_db, simulated_db), along / np.sqrt(along**2 + power_draws(residual, place_m)))


def mean_interval(values: FloatArray, place_m: FloatArray | None = None) -> Interval:
    """Return the 95 % interval of the mean of the process that a sequence (n,) in time order comes from.

    Errors may be correlated over the positions ``place_m`` (n, 3) [m] as well, as for :func:`mean_draws`.
    """
    return influence_interval(float(values.mean()) if len(values) else float("nan"), values, place_m)


def influence_interval(
    estimate: float,
    influence: FloatArray,
    place_m: FloatArray | None = None,
    bounds: tuple[float, float] = (-np.inf, np.inf),
) -> Interval:
    """Return the 95 % interval of a statistic of a sequence.

    Parameters
    ----------
    estimate : float
        The statistic of the samples.
    influence : (n,)
        What each sample adds to the statistic, to first order and up to a constant, in time order.
    place_m : (n, 3), optional
        As for :func:`mean_draws`.
    bounds : (low, high)
        The range of the statistic.

    Returns
    -------
    (low, high)
        NaN if the statistic does not exist or has fewer than :data:`FEWEST` samples.
    """
    if len(influence) < FEWEST or not np.isfinite(estimate):
        return NO_INTERVAL
    low, high = np.clip(_around(estimate, estimate + mean_draws(influence, place_m=place_m)), *bounds)
    return float(low), float(high)


def spread_interval(values: FloatArray, place_m: FloatArray | None = None) -> Interval:
    """95 % interval of the standard deviation that sequences such as this one (n,), in time order, have on average.

    Wider than :data:`_BOUND` times the value, it is given as a bound: its upper end is infinite. Positions ``place_m``
    (n, 3) [m] are used as by :func:`mean_draws`.
    """
    if len(values) < FEWEST:
        return NO_INTERVAL
    low, high = _around(float(values.std()), np.sqrt(power_draws(values, place_m)))
    return low, np.inf if high - low > _BOUND * values.std() else high


def rmse_interval(residual: FloatArray, rmse: float, place_m: FloatArray | None = None) -> Interval:
    """95 % interval of the root mean square of residuals (n,) in time order, whose value is ``rmse``.

    An offset from a grid, at the edge of its span or beside a floor leaves a mean, which moves both ends as it moves
    the RMSE. Positions ``place_m`` (n, 3) [m] are used as by :func:`mean_draws`.
    """
    if len(residual) < FEWEST:
        return NO_INTERVAL
    low, high = np.hypot(spread_interval(residual, place_m), residual.mean())
    return float(min(low, rmse)), float(max(high, rmse))


def _around(estimate: float, drawn: FloatArray) -> Interval:
    """95 % interval from draws; it holds the estimate."""
    if not np.isfinite(estimate) or not np.isfinite(drawn).any():
        return NO_INTERVAL
    low, high = np.nanquantile(drawn, [0.025, 0.975])
    return float(min(low, estimate)), float(max(high, estimate))


def middle_span(values: FloatArray) -> float:
    """Width of the middle 80 % of values (n,)."""
    return float(np.ptp(np.percentile(values, (10, 90))))


# A level that spans less than this share of the predicted ones is flat: a floor, a dead input.
_FLAT = 0.2


def is_flat(measured_db: FloatArray, predicted_db: Iterable[FloatArray]) -> bool:
    """True of a level (n,), n > 0, that hardly varies where every prediction (n,) of it does [dB]."""
    return middle_span(measured_db) < _FLAT * min(map(middle_span, predicted_db))


def correlation(first: ArrayLike, second: ArrayLike) -> float:
    """Pearson correlation over pairs without NaN; NaN where a side is constant or fewer than two pairs exist."""
    a, b = unmasked(first), unmasked(second)
    ok = np.isfinite(a) & np.isfinite(b)
    if ok.sum() < 2 or np.ptp(a[ok]) == 0.0 or np.ptp(b[ok]) == 0.0:
        return float("nan")
    a, b = a[ok] - a[ok].mean(), b[ok] - b[ok].mean()
    return float(np.clip((a @ b) / np.sqrt((a @ a) * (b @ b)), -1.0, 1.0))


@dataclass(frozen=True, slots=True, kw_only=True)
class PairedDifference:
    """Two models on the same samples: whose error is smaller, and how well that is known.

    Parameters
    ----------
    n : int
        Samples at which both models have an error.
    rmse_db, other_rmse_db : float
        Of the first and of the second model [dB].
    difference_db : float
        ``rmse_db - other_rmse_db`` [dB]: negative where the first model is better.
    difference_ci95_db : (low, high)
        95 % interval of it [dB]; NaN where none can be given, and where one that holds 0 reaches beyond an error of
        none for either model: the flight is too short for its memory.
    standard_error_db : float
        Of ``difference_db`` [dB]: half of its central 68 % interval; NaN where none can be given.
    mean_square_difference_db2, mean_square_ci95_db2 : float, (low, high)
        Difference of the mean square errors and its interval [dB^2].
    p_value : float
        Chance of a difference as large between models that are equally good.
    verdict : {"better", "worse", "not significant", "no interval"}
        What the interval says about the first model; "no interval" where there is no interval.
    """

    n: int
    rmse_db: float
    other_rmse_db: float
    difference_db: float
    difference_ci95_db: Interval
    standard_error_db: float
    mean_square_difference_db2: float
    mean_square_ci95_db2: Interval
    p_value: float
    verdict: Literal["better", "worse", "not significant", "no interval"]

    def in_words(self, other_model: str) -> str:
        """A clause for a report, such as "worse than free space by 0.6 dB [0.2, 1.0]"."""
        if not self.n:
            return f"no sample in common with {other_model}"
        size = f"{abs(self.difference_db):.1f} dB"
        if self.verdict == "no interval":
            more = "more" if self.difference_db > 0 else "less"
            return f"{size} {more} error than {other_model}, too short a flight for an interval"
        difference, low, high = map(Printed, (self.difference_db, *self.difference_ci95_db))
        if self.verdict == "not significant":
            return f"no significant difference from {other_model} ({difference:+.1f} dB [{low:+.1f}, {high:+.1f}])"
        near, far = sorted((abs(low), abs(high)))
        digits = 1 if near >= 0.05 else 2
        return f"{self.verdict} than {other_model} by {size} [{near:.{digits}f}, {far:.{digits}f}]"


def paired_difference(
    error_db: ArrayLike, other_error_db: ArrayLike, *, free_offset: bool = True, place_m: FloatArray | None = None
) -> PairedDifference:
    """Compare two models on the same samples by the difference of their mean square errors.

    Parameters
    ----------
    error_db, other_error_db : array_like, (n,)
        Measured minus predicted, in time order [dB]; samples with a NaN on either side take no part.
    free_offset : bool
        Each model has an offset of its own fitted on these samples (an error counts about its mean). False for errors
        on samples kept out of the fit: they count as they are.
    place_m : (n, 3), optional
        As for :func:`mean_draws`.

    Returns
    -------
    PairedDifference

    Notes
    -----
    With d the difference of the two predictions, which the route fixes, and b the share of it that the measurement asks
    for, the difference of the mean square errors is (2 b - 1) times the mean square of d: random is what regression on
    d leaves of the error, times d (Harvey, Leybourne and Newbold 1998, doi:10.1080/07350015.1998.10524759). Each
    stretch takes b from the other stretches, so that a stretch that alone decides b counts as an accident.

    Examples
    --------
    >>> paired_difference([3.0, -3.0, 3.0, -3.0], [1.0, -1.0, 1.0, -1.0]).difference_db
    2.0
    """
    first, second = (np.asarray(values, dtype=np.float64).ravel() for values in (error_db, other_error_db))
    finite = np.isfinite(first) & np.isfinite(second)
    first, second = first[finite], second[finite]
    if free_offset and len(first):
        first, second = first - first.mean(), second - second.mean()
    nan = float("nan")
    square, other_square = (float(np.mean(e * e)) if len(e) else nan for e in (first, second))
    rmse, other_rmse = float(np.sqrt(square)), float(np.sqrt(other_square))
    bounds, squares, spread, chance = NO_INTERVAL, NO_INTERVAL, nan, 1.0
    if len(first) >= FEWEST:
        places = None if place_m is None else place_m[finite]
        drawn = square - other_square + mean_draws(undecided(first, second), "ratio", places)
        low, high = np.quantile(drawn, [0.025, 0.975])
        squares = float(low), float(high)
        scale = max(rmse + other_rmse, 1e-300)
        bounds = squares[0] / scale, squares[1] / scale
        if bounds[0] <= 0.0 <= bounds[1] and (bounds[0] < -other_rmse or bounds[1] > rmse):
            bounds = NO_INTERVAL
        # one standard deviation of a normal distribution on either side: heavy tails do not count
        spread = float(0.5 * np.diff(np.quantile(drawn, [0.1587, 0.8413]))[0]) / scale
        chance = 2.0 * min(float(np.mean(drawn <= 0.0)), float(np.mean(drawn >= 0.0)), 0.5)
    return PairedDifference(
        n=len(first),
        rmse_db=rmse,
        other_rmse_db=other_rmse,
        difference_db=rmse - other_rmse,
        difference_ci95_db=bounds,
        standard_error_db=spread,
        mean_square_difference_db2=square - other_square,
        mean_square_ci95_db2=squares,
        p_value=chance,
        verdict=paired_verdict(*bounds),
    )


def undecided(first: FloatArray, second: FloatArray) -> FloatArray:
    """Part of the difference of the mean squares that each sample (n,) adds by chance [dB^2]."""
    apart = first - second
    stretch = np.arange(len(apart)) * _STRETCHES // len(apart)
    products, squares = (np.bincount(stretch, values, _STRETCHES) for values in (first * apart, apart * apart))
    # hardly a weight: where one stretch holds all of the difference, the others say that the models are equal
    even = 1e-3 * squares.sum() + 1e-300
    share = (products.sum() - products + 0.5 * even) / (squares.sum() - squares + even)
    return np.asarray(2.0 * (first - share[stretch] * apart) * apart)


def pooled_difference(
    channels: Sequence[tuple[FloatArray, FloatArray, FloatArray]],
    *,
    free_offset: bool = True,
    place_m: Sequence[FloatArray] | None = None,
) -> PairedDifference:
    """Two models over all channels of a flight at once.

    Parameters
    ----------
    channels : sequence of ((n,), (n,), (n,))
        Per channel: instants, and the errors of the two models at them [dB]. NaN takes no part.
    free_offset : bool
        Each channel and model has an own offset.
    place_m : sequence of (n, 3), optional
        Positions of each channel's samples, as for :func:`mean_draws`.

    Returns
    -------
    PairedDifference
        Of the root mean square errors over all samples. Samples of one time stand together whatever their channel, so
        that fading which the channels share counts as shared.
    """
    parts = []
    for at, (time, error, other) in enumerate(channels):
        finite = np.isfinite(error) & np.isfinite(other)
        if finite.any():
            columns = (values[finite] - free_offset * values[finite].mean() for values in (error, other))
            place = np.full((len(finite), 3), np.nan) if place_m is None else place_m[at]
            parts.append((np.asarray(time)[finite], *columns, place[finite]))
    if not parts:
        return paired_difference([], [])
    time, first, second, place = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.argsort(time, kind="stable")
    return paired_difference(first[order], second[order], free_offset=False, place_m=place[order])


def corrected(pairs: Sequence[PairedDifference], measured: Sequence[Hashable] | None = None) -> list[PairedDifference]:
    """Verdicts of several channels, corrected for their number (Holm 1979): all that stay are true in 95 % of cases.

    Channels of which the same was ``measured`` count once.
    """
    # Holm's: the least chance is held against the number of all, the next against one less
    order = sorted(range(len(pairs)), key=lambda i: pairs[i].p_value)
    names = measured or range(len(pairs))
    out, tried = list(pairs), {names[i] for i in order if pairs[i].verdict != "no interval"}
    for place, i in enumerate(order):
        if pairs[i].p_value * max(len(tried), 1) > _FAMILY:
            for rest in order[place:]:
                if pairs[rest].verdict in ("better", "worse"):
                    out[rest] = replace(pairs[rest], verdict="not significant")
            break
        tried.discard(names[i])
    return out


def paired_verdict(low: float, high: float) -> Literal["better", "worse", "not significant", "no interval"]:
    """The word that the interval of a difference of errors allows."""
    if not (np.isfinite(low) and np.isfinite(high)):
        return "no interval"
    return "better" if high < 0 else "worse" if low > 0 else "not significant"


def share_interval(
    indicator: FloatArray, place_m: FloatArray | None = None, sequence: FloatArray | None = None
) -> Interval:
    """Return the 95 % interval of a share, such as a bar of a histogram.

    Parameters
    ----------
    indicator : (n,)
        1 for each sample that counts, else 0, in time order.
    place_m : (n, 3), optional
        As for :func:`mean_draws`.
    sequence : (n,), optional
        The sequence that the indicator comes from: its effective size counts at a share of 0 or 1.

    Returns
    -------
    (low, high)
        NaN for fewer than :data:`FEWEST` samples.

    Notes
    -----
    Wilson's interval for the number of independent samples that would fix the mean equally well. It is sensible at
    shares of 0 and 1, where the samples do not vary. Wilson (1927), doi:10.1080/01621459.1927.10502953.
    """
    n = len(indicator)
    if n < FEWEST:
        return NO_INTERVAL
    share, varied = float(indicator.mean()), indicator
    if np.ptp(indicator) == 0.0 and sequence is not None:
        varied = sequence
    z2 = 1.959964**2
    half = 0.5 * float(np.ptp(mean_interval(varied, place_m)))
    size = float(np.clip(z2 * varied.var() / half**2, 1.0, n)) if half else float(n)
    centre = (share + z2 / (2 * size)) / (1 + z2 / size)
    reach = np.sqrt(z2 * (share * (1 - share) / size + z2 / (4 * size**2))) / (1 + z2 / size)
    low, high = float(centre - reach), float(centre + reach)
    return (0.0 if share == 0.0 else max(0.0, low)), (1.0 if share == 1.0 else min(1.0, high))


# Samples of two passes nearer than this were taken at the same place.
SAME_PLACE_M = 2.0

# Largest difference of the headings of such samples, where headings count.
_HEADING_WITHIN_DEG = 20.0


@dataclass(frozen=True, slots=True)
class Visit:
    """One pass by itself: places (n, 3) [m], values (n,), NaN where there is none, headings (n,) where they count."""

    position_m: FloatArray
    value: FloatArray
    heading_deg: FloatArray | None = None

    @property
    def places(self) -> _Places:
        """Of the samples that have a place and a value."""
        known = np.isfinite(self.position_m).all(axis=1) & np.isfinite(self.value)
        return _Places(self.position_m, self.heading_deg, np.flatnonzero(known))


def same_places(first: Visit, second: Visit, radius_m: float = SAME_PLACE_M) -> tuple[IntArray, IntArray]:
    """Indices into both passes: samples with a value, and the nearest ones of the other pass within a radius [m]."""
    return first.places.partners(second.places, radius_m, _HEADING_WITHIN_DEG)


@dataclass(frozen=True, slots=True, kw_only=True)
class Pass:
    """One flight on one link.

    Parameters
    ----------
    flight, link : str
        Passes of one link and of two flights are compared.
    position_m : ndarray, (n, 3)
        East, north, up; rows with NaN pair with nothing.
    level_db, residual_db : ndarray, (n,)
        Measurement, and measurement minus simulation; NaN where there is none.
    heading_deg : ndarray, (n,), optional
        Clockwise from north.
    """

    flight: str
    link: str
    position_m: FloatArray = field(repr=False)
    level_db: FloatArray = field(repr=False)
    residual_db: FloatArray = field(repr=False)
    heading_deg: FloatArray | None = field(repr=False, default=None)


@dataclass(frozen=True, slots=True, kw_only=True)
class PassPair:
    """Two passes of one link; ``first`` and ``second`` count the passes as they were given.

    Parameters
    ----------
    n : int
        Samples of the first pass that have a partner.
    rmse_db, offset_db : float
        Standard deviation and mean of second minus first; NaN without a pair.
    rmse_ci95_db : (low, high)
        Of the RMSE (:func:`spread_interval`).
    residual_rmse_db : float
        The same of the residuals.
    place_rmse_db, place_correlation, height_difference_m : float
        Of the mean residuals, and the median difference of the mean heights, over the cells that both have.
    cells : int
        Those cells.
    """

    first: int
    second: int
    n: int
    rmse_db: float
    offset_db: float
    rmse_ci95_db: Interval
    residual_rmse_db: float
    place_rmse_db: float
    place_correlation: float
    cells: int
    height_difference_m: float


# --- every pair -----------------------------------------------------------------------------------------------------


class _Places:
    """Samples that have a place and a value, their tree and their box; ``where`` are their numbers in the pass."""

    def __init__(self, position_m: FloatArray, heading_deg: FloatArray | None, where: IntArray) -> None:
        self.where = where
        self.position_m = np.ascontiguousarray(position_m[where])
        self.heading_deg = None if heading_deg is None else heading_deg[where]
        empty = not len(where)
        self.low = np.full(3, np.inf) if empty else self.position_m.min(axis=0)
        self.high = np.full(3, -np.inf) if empty else self.position_m.max(axis=0)
        self._tree: Any = None

    @property
    def tree(self) -> Any:
        if self._tree is None:
            from scipy.spatial import cKDTree

            self._tree = cKDTree(self.position_m)
        return self._tree

    def partners(self, other: _Places, radius_m: float, within_deg: float | None) -> tuple[IntArray, IntArray]:
        """Numbers, in both passes, of samples and the nearest ones of the other pass; headings agree."""
        # only what lies in the other's box can pair: most flights of a season end here
        near = np.flatnonzero(
            ((self.position_m >= other.low - radius_m) & (self.position_m <= other.high + radius_m)).all(axis=1)
        )
        if not len(near):
            return near, near
        distance, nearest = other.tree.query(self.position_m[near], distance_upper_bound=radius_m)
        # the tree answers infinity where nothing is near enough
        paired = np.isfinite(distance)
        rows, nearest_rows = near[paired], nearest[paired]
        if within_deg is not None and self.heading_deg is not None and other.heading_deg is not None:
            turn = wrap_degrees(other.heading_deg[nearest_rows] - self.heading_deg[rows])
            same = np.abs(turn) <= within_deg
            rows, nearest_rows = rows[same], nearest_rows[same]
        return self.where[rows], other.where[nearest_rows]


@dataclass(slots=True)
class _Prepared:
    """A pass ready to be paired: places of levels and of residuals (by key), and means by cell."""

    number: int
    flown: Pass
    level: bytes
    residual: bytes
    cells: IntArray
    means: FloatArray
    heights: FloatArray


class PassTable:
    """Passes ready to be paired.

    Parameters
    ----------
    passes : sequence of Pass
    cell_m : float
        Edge of the cells of the plan.
    """

    def __init__(self, passes: Sequence[Pass], cell_m: float) -> None:
        self._places: dict[bytes, _Places] = {}
        # by flight, then by link
        self._flights: dict[str, dict[str, list[_Prepared]]] = {}
        for number, flown in enumerate(passes):
            links = self._flights.setdefault(flown.flight, {})
            links.setdefault(flown.link, []).append(_prepare(number, flown, cell_m, self._places))

    def pairs(self, *, radius_m: float, heading_within_deg: float | None) -> Iterator[PassPair]:
        """Every pair of two flights' passes on one link, by first flight, second flight and link.

        Parameters
        ----------
        radius_m : float
            A sample of the first pass pairs with the nearest one of the second within this distance.
        heading_within_deg : float, optional
            Headings of a pair agree within this, where both passes have headings; None: any heading.

        Yields
        ------
        PassPair
        """
        for first, second in combinations(self._flights.values(), 2):

            @cache  # the searches of a pair of flights are shared by its links, and forgotten after it
            def met(mine: bytes, theirs: bytes) -> tuple[IntArray, IntArray]:
                return self._places[mine].partners(self._places[theirs], radius_m, heading_within_deg)

            shared: dict[tuple[bytes, bytes], tuple[IntArray, IntArray, float]] = {}
            for link, passes in first.items():
                for mine, theirs in product(passes, second.get(link, ())):
                    yield _pair(mine, theirs, met, shared)


def _prepare(number: int, flown: Pass, cell_m: float, places: dict[bytes, _Places]) -> _Prepared:
    placed = np.isfinite(flown.position_m).all(axis=1)
    scored = placed & np.isfinite(flown.residual_db)
    cells, means, heights = cell_means(flown.position_m, flown.residual_db, scored, cell_m)
    return _Prepared(
        number=number,
        flown=flown,
        level=_entered(flown, placed & np.isfinite(flown.level_db), places),
        residual=_entered(flown, scored, places),
        cells=cells,
        means=means,
        heights=heights,
    )


def _entered(flown: Pass, good: BoolArray, places: dict[bytes, _Places]) -> bytes:
    """Key of the places of some samples: links that were sampled together have one."""
    digest = hashlib.blake2b(good.tobytes(), digest_size=16)
    digest.update(np.ascontiguousarray(flown.position_m).tobytes())
    if flown.heading_deg is not None:
        digest.update(np.ascontiguousarray(flown.heading_deg).tobytes())
    # by content: links that were sampled together have equal places in arrays of their own
    key = digest.digest()
    if key not in places:
        places[key] = _Places(flown.position_m, flown.heading_deg, np.flatnonzero(good))
    return key


def cell_means(
    position_m: FloatArray, residual_db: FloatArray, good: BoolArray, cell_m: float
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Squares of the plan that have a sample: (c, 2) numbers east and north in order, mean residual, mean height.

    Parameters
    ----------
    position_m : (n, 3)
    residual_db : (n,)
    good : (n,) bool
        Samples that count.
    cell_m : float
        Side of a square [m].

    Returns
    -------
    cells : (c, 2) int
        Numbers of the squares, east and north, ascending.
    residual_db, height_m : (c,)
        Means over the samples of each square.
    """
    # in the plan: two passes at other heights share their squares
    cells = np.floor(position_m[good, :2] / cell_m).astype(np.int64)
    cell, which = np.unique(cells, axis=0, return_inverse=True)
    # NumPy 2.0 gives it two dimensions
    which = which.reshape(-1)
    count = np.maximum(np.bincount(which, minlength=len(cell)), 1)
    residual = np.bincount(which, weights=residual_db[good], minlength=len(cell)) / count
    height = np.bincount(which, weights=position_m[good, 2], minlength=len(cell)) / count
    return cell, residual, height


def _pair(
    mine: _Prepared,
    theirs: _Prepared,
    met: Callable[[bytes, bytes], tuple[IntArray, IntArray]],
    shared: dict[tuple[bytes, bytes], tuple[IntArray, IntArray, float]],
) -> PassPair:
    """Two passes of a link; ``met`` gives the partners of their places by key, ``shared`` keeps their common cells."""
    i, j = met(mine.level, theirs.level)
    level = theirs.flown.level_db[j] - mine.flown.level_db[i]
    i, j = met(mine.residual, theirs.residual)
    residual = theirs.flown.residual_db[j] - mine.flown.residual_db[i]
    cells = mine.residual, theirs.residual  # the same places, so the same cells and heights
    if cells not in shared:
        i, j = _common(mine.cells, theirs.cells)
        height = float(np.median(theirs.heights[j] - mine.heights[i])) if len(i) else float("nan")
        shared[cells] = i, j, height
    i, j, height = shared[cells]
    change, nan = theirs.means[j] - mine.means[i], float("nan")
    return PassPair(
        first=mine.number,
        second=theirs.number,
        n=len(level),
        rmse_db=float(level.std()) if len(level) else nan,
        offset_db=float(level.mean()) if len(level) else nan,
        rmse_ci95_db=spread_interval(level),
        residual_rmse_db=float(residual.std()) if len(residual) else nan,
        place_rmse_db=float(change.std()) if len(i) else nan,
        place_correlation=correlation(mine.means[i], theirs.means[j]),
        cells=len(i),
        height_difference_m=height,
    )


def _common(first: IntArray, second: IntArray) -> tuple[IntArray, IntArray]:
    """Rows of both that name the same cell, in the order of the cells (both are sorted and have each cell once)."""
    # one integer per cell: numpy intersects rows of two columns by sorting records, ten times slower
    a, b = ((cells[:, 0] << 32) + cells[:, 1] for cells in (first, second))
    _, i, j = np.intersect1d(a, b, assume_unique=True, return_indices=True)
    return i, j


# Rows or columns, whichever are fewer: the power sums below make a characteristic polynomial up to this order.
LARGEST = 4
# Matrices at once; they fit into a processor's cache.
LANES = 4096
# Half width of the zone around the threshold, as a share of lambda_1 / K^2, in which singular values decide.
_GUARD = 1e-3
_ITERATIONS = 8


def certain_rank(h: ComplexArray, k: float) -> tuple[IntArray, BoolArray]:
    """Ranks (t,) of channel matrices (t, n_rx, n_tx) at a ratio ``k``, and where they are beyond doubt.

    Matrices without a channel, with an entry that is not finite, or of an extreme scale are never certain.
    """
    # along the shorter side: the Gram matrix is smaller, and its other eigenvalues are zeros
    x = np.moveaxis(h, 0, 2) if h.shape[2] <= h.shape[1] else np.transpose(h, (2, 1, 0))
    # matrices along the last axis: each step is one pass over memory
    x = np.ascontiguousarray(x)
    with np.errstate(all="ignore"):  # what is not finite is not certain
        gram = np.einsum("kit,kjt->ijt", x.conj(), x)
        trace = np.einsum("iit->t", gram).real
        gram /= trace
        largest, step = _largest_eigenvalue(gram)
        threshold = largest / k**2
        above, growth = _positive_pivots(gram.copy(), threshold * (1.0 + _GUARD))
        rank, other_growth = _positive_pivots(gram, threshold * (1.0 - _GUARD))
        certain = (above == rank) & (trace > 1e-200) & (trace < 1e200) & (np.abs(step) < _GUARD * largest)
        certain &= 16.0 * np.finfo(np.float64).eps * np.maximum(growth, other_growth) < _GUARD * threshold
    # the largest singular value counts by definition
    return np.maximum(rank, 1), certain


def _largest_eigenvalue(gram: ComplexArray) -> tuple[FloatArray, FloatArray]:
    """Largest eigenvalue (t,) of Gram matrices (n, n, t) of trace 1, and the last step of Laguerre's iteration.

    The iteration starts above all roots and comes down, threefold nearer per step or better, also to multiple ones.
    There rounding of the polynomial moves the root by up to the fourth root of an ulp: within the guard.
    """
    square = np.einsum("ikt,kjt->ijt", gram, gram)
    p2 = np.einsum("iit->t", square).real
    p3, p4 = (
        np.einsum("ijt,ijt->t", a.real, square.real) + np.einsum("ijt,ijt->t", a.imag, square.imag)
        for a in (gram, square)
    )
    # Newton's identities, with a power sum p1 of 1
    e2 = (1.0 - p2) / 2.0
    e3 = (e2 - p2 + p3) / 3.0
    e4 = (e3 - e2 * p2 + p3 - p4) / 4.0
    root = np.ones(gram.shape[2])
    step = root
    for _ in range(_ITERATIONS):
        value = (((root - 1.0) * root + e2) * root - e3) * root + e4
        slope = ((4.0 * root - 3.0) * root + 2.0 * e2) * root - e3
        bend = (12.0 * root - 6.0) * root + 2.0 * e2
        step = 4.0 * value / (slope + np.sqrt(np.maximum(9.0 * slope**2 - 12.0 * value * bend, 0.0)))
        root = root - step
        if np.abs(step).max() < 0.1 * _GUARD:
            break
    return root, step


def _positive_pivots(matrix: ComplexArray, shift: FloatArray) -> tuple[IntArray, FloatArray]:
    """Positive pivots (t,) of Hermitian ``matrix - shift`` (n, n, t), and how far elimination may magnify rounding.

    The part on and below the diagonal of ``matrix`` is overwritten.
    """
    n, t = len(matrix), matrix.shape[2]
    count, growth = np.zeros(t, dtype=np.int64), np.ones(t)
    for j in range(n):
        pivot = matrix[j, j].real - shift
        count += pivot > 0
        if j < n - 1:
            below = matrix[j + 1 :, j]
            share = below / pivot
            growth *= (1.0 + np.abs(share).max(axis=0)) ** 2
            matrix[j + 1 :, j + 1 :] -= share[:, None] * below.conj()
    return count, growth
