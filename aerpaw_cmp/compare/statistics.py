"""Confidence intervals for correlated samples, and comparison of passes over the same positions.

Neighbouring samples of a flight are correlated, and a single flight hardly determines the correlation time. Intervals
of a mean, a power and a ratio of powers therefore average over many possible correlations. A sequence of samples is
described by its slowest cosine terms (Mueller and Watson 2008, doi:10.1111/j.1468-0262.2008.00868.x). For a given
correlation, these terms are normally distributed with a known covariance. The assumed correlation times range from zero
to three times the duration of the flight. The correlation functions over time are exponential, with and without white
noise, or smooth (Matern 3/2). Correlations over position depend on the distance between two positions of the track.
Each correlation is weighted by its likelihood and by a prior weight, chosen so that 95 % intervals have sufficient
coverage for every correlation. Because the weights alone would make some intervals too wide, the random draws that form
an interval are also widened or narrowed, depending on which correlations the sequence supports. Weights and widening
factors were found by simulation (``benchmarks/interval_weights.py``).

Statistics of ranks and of paired models are means of contributions of the samples, so their intervals are computed in
the same way. Comparisons over all channels of a flight also estimate the correlation from each single channel
(:class:`Channels`).

Passes over the same positions are compared for every pair of flights. For 200 flights with ten links each, these are
199 000 pairs of passes. The positions of a flight are therefore put into one k-d tree, and links that were sampled at
the same positions share one search. Pairs of flights whose bounding boxes do not overlap are not searched.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, lru_cache
from itertools import combinations
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from ..common.units import BoolArray, ComplexArray, FloatArray, IntArray, Printed, unmasked, wrap_degrees

# Number of cosine terms that determine the correlation of a long sequence. Faster terms are used only for the power. A
# shorter sequence uses the largest of a few smaller numbers that its length allows, because each number of terms needs
# its own table.
TERMS = 48
_FEWER = np.array([9, 12, 16, 24, 34, TERMS])

# Smallest number of samples for which an interval is computed.
FEWEST = 20

# Length of the sequence divided by its correlation length (exp(-rate) is the correlation of the two ends).
RATES = np.geomspace(0.3, 500.0, 18)

# Shares of white noise that are mixed with an exponential correlation, relative to the power of its slowest terms.
WHITE_SHARES = (0.0, 2e-3, 3e-2)

# White noise that is added to the terms of a smooth correlation, which fall with the fourth power of their order.
_SMOOTH_FLOOR = 1e-7

Kind = Literal["mean", "power", "ratio", "influence"]

# Positions (n, 3) of samples: east, north and up [m], NaN if unknown. None if no sample has a position.
Track = FloatArray | None

# Correlation lengths, divided by the root mean square distance of a track from its centre. Consecutive lengths have a
# ratio of the root of 2, because the square of a correlation is the correlation with half its length.
LENGTHS = 0.06 * 2.0 ** (0.5 * np.arange(12))

# Shares of white noise or of fading that are mixed with each correlation over position, relative to the power of the
# slow terms. Fading is correlated over a fortieth of the flight.
PLACE_WHITE = 0.002 * 2.0 ** np.arange(9)
PLACE_FADING = (0.1, 0.25, 0.5, 0.75)
_FADING_RATE = 40.0

# For each kind of interval: weight of a correlation over position, relative to the mean weight of a correlation over
# time, and correlation length above which this weight falls as 1 / length. The cosine terms hardly distinguish such
# long correlations, but the intervals of means and powers depend on them. The values were found by simulation.
# Differences of squares have half the correlation length of errors.
_PLACE_WEIGHT = {"mean": (0.06, 1.0), "power": (0.06, 1.0), "ratio": (0.12, 0.2), "influence": (0.07, 1.0)}

# Largest number of positions from which the correlations of a track are computed.
_THINNED = 400

# Only correlation over time is used if more than this share of samples has no position. The same applies if the RMS
# distance from the centre of the track is below this [m], because the logged positions of a hover are noise.
_UNPLACED, _HOVER_M = 0.1, 15.0

# Share of the second part in the two-part correlations of pooled channels. The second part is white or ten times faster
# than the first part, because the correlations of the channels differ.
_SECOND_PART = 0.3

# Smallest rate at which pooled channels can reveal a correlation that is mixed with white noise. At smaller rates, no
# cosine term would exceed the noise, but the mean of the process would vary.
_VISIBLE = 6.0

# Number of bins of a pooled sequence from which the terms of its channels are computed. Standard deviation of log(power
# of the sum of independent channels / sum of the powers of the channels), which is 0.2 for a known correlation.
_BINS, _SUM_OF_POWERS = 1024, 0.3

# File with the logarithms of the prior weights, in tenths, by kind, form (exponential with each white share, then
# smooth) and rate. It also contains the factors that widen the draws, in hundredths: one for the share of each
# correlation in the weighted likelihood, and one for its share in the unweighted likelihood.
_TABLES = Path(__file__).with_name("memory_weights.json")

# Factor by which the standard deviation of the log power, estimated from the fourth moment, is multiplied for upward
# deviations. It was found by simulation with Student's t of four degrees of freedom. Most sequences from a process with
# heavy tails contain too few of its large errors.
CALM = 1.8

# Number of parts of a flight whose powers are compared, the multiple of the median power above which a part is loud
# (has unusually large errors), and the smallest number of samples for this comparison. In the simulations of
# ``benchmarks/coverage_of_intervals.py``, fewer than 1 % of steady flights have two loud parts, and 4 % of flights with
# 100 samples of Student's t with four degrees of freedom.
_PARTS, _LOUD, _FEWEST_FOR_PARTS = 12, 4.0, 60

# Smallest widening factor. With this factor, the 95 % interval consists of the central 80 % of the unchanged draws.
# Without this limit, the factor could reach 0 for an unusual mixture of correlations.
_LEAST_STRETCH = 0.6

# Draws come in pairs of opposite sign, so that swapping two models reverses an interval exactly.
_PAIRS = 2048


@dataclass(frozen=True, slots=True)
class CorrelationSet:
    """The normal distributions of the mean and the cosine terms of a sequence for m correlations, up to a common scale.

    ``whiten`` (m, terms, terms) makes the terms independent. ``log_det`` (m,) is the logarithm of its determinant. For
    known terms, ``slope`` (m, terms) and ``variance`` (m,) determine mean and variance of the mean of the sequence.
    ``power`` (m,) is the total power of all terms. For errors that are correlated over position, ``beyond`` (m,) is
    their power in faster terms, and ``freedom`` (m,) the number of independent squares in that power. For errors over
    time, these are 0 and infinity.
    """

    whiten: FloatArray
    log_det: FloatArray
    slope: FloatArray
    variance: FloatArray
    power: FloatArray
    beyond: FloatArray
    freedom: FloatArray

    @classmethod
    def of(
        cls, covariances: FloatArray, beyond: float | FloatArray = 0.0, freedom: float | FloatArray = np.inf
    ) -> CorrelationSet:
        """Create the record from covariances (m, terms + 1, terms + 1) of mean and terms."""
        whiten = np.linalg.inv(np.linalg.cholesky(covariances[:, 1:, 1:]))
        cross = covariances[:, 0, 1:]
        slope = np.einsum("mij,mi->mj", whiten, np.einsum("mij,mj->mi", whiten, cross))
        return cls(
            whiten=whiten,
            log_det=np.log(np.diagonal(whiten, axis1=1, axis2=2)).sum(axis=1),
            slope=slope,
            variance=covariances[:, 0, 0] - (cross * slope).sum(axis=1),
            power=np.trace(covariances[:, 1:, 1:], axis1=1, axis2=2),
            beyond=np.broadcast_to(np.asarray(beyond, dtype=np.float64), len(covariances)),
            freedom=np.broadcast_to(np.asarray(freedom, dtype=np.float64), len(covariances)),
        )


@cache
def time_correlations(terms: int = TERMS) -> CorrelationSet:
    """Return exponential correlations for all :data:`WHITE_SHARES`, then smooth correlations, at all :data:`RATES`."""
    white = np.eye(terms + 1)
    covariances = [
        (1.0 - share) * 0.5 * rate * _exponential(rate, terms).real + share * white
        for share in WHITE_SHARES
        for rate in RATES
    ] + [0.25 * rate * _smooth(rate, terms) + _SMOOTH_FLOOR * white for rate in RATES]
    return CorrelationSet.of(np.array(covariances))


@cache
def _two_parts(terms: int) -> CorrelationSet:
    """Return exponential correlations at all :data:`RATES`, with a second part that is first white, then faster."""
    slow, fast = ([0.5 * by * rate * _exponential(by * rate, terms).real for rate in RATES] for by in (1.0, 10.0))
    both = [*zip(slow, [np.eye(terms + 1)] * len(RATES), strict=True), *zip(slow, fast, strict=True)]
    return CorrelationSet.of(np.array([(1.0 - _SECOND_PART) * first + _SECOND_PART * other for first, other in both]))


def place_correlations(place_m: Track, terms: int = TERMS, centred: bool = False) -> CorrelationSet | None:
    """Return the normal distributions of mean and cosine terms for errors that are correlated over position.

    Parameters
    ----------
    place_m : (n, 3) or None
        East, north and up of each sample, in time order; NaN if unknown [m].
    terms : int
        Number of cosine terms.
    centred : bool
        True for differences of the squares of errors whose mean was subtracted. Such errors are anticorrelated at large
        distances, so their squares are correlated everywhere. This affects the mean of the sequence, but none of its
        cosine terms.

    Returns
    -------
    CorrelationSet or None
        All :data:`LENGTHS` for each mixture of :data:`PLACE_WHITE` and :data:`PLACE_FADING`. None if only correlation
        over time is used (:func:`only_time`).

    Notes
    -----
    The terms of errors with covariance K are T K T', where row k of T is the k-th cosine over the number of samples.
    K is exp(-|p_i - p_j| / L) (Gudmundson 1991), formed from every m-th position.
    """
    if place_m is None or only_time(place_m):
        return None
    known = np.flatnonzero(np.isfinite(place_m).all(axis=1))
    step = -(-len(known) // _THINNED)
    at = known[step // 2 :: step]
    return _place_correlations(place_m[at].tobytes(), ((at + 0.5) / len(place_m)).tobytes(), terms, centred)


# Cache the result, because the channels and models of a flight have the same track. Each cached result takes 4 MB.
@lru_cache(maxsize=8)
def _place_correlations(positions: bytes, instants: bytes, terms: int, centred: bool) -> CorrelationSet:
    place, instant = np.frombuffer(positions).reshape(-1, 3), np.frombuffer(instants)
    place = place - place.mean(axis=0)
    square = np.square(place).sum(axis=1)
    apart = np.sqrt(np.maximum(square[:, None] + square - 2.0 * place @ place.T, 0.0) / square.mean())
    cosines = np.cos(np.pi * np.outer(np.arange(terms + 1), instant)) * np.sqrt(2.0) / len(instant)
    cosines[0] = 1.0 / len(instant)
    by_length, (beyond, freedom) = {}, np.empty((2, len(LENGTHS)))
    for longest in (len(LENGTHS) - 1, len(LENGTHS) - 2):
        correlation = np.exp(-apart / LENGTHS[longest])
        for at in range(longest, -1, -2):
            used = np.square(_about_mean(np.sqrt(correlation))) if centred else correlation
            by_length[at] = cosines @ used @ cosines.T
            beyond[at] = max((1.0 - used.mean()) / np.trace(by_length[at][1:, 1:]) - 1.0, 0.0)
            correlation = np.square(correlation)
            freedom[at] = 1.0 / correlation.mean()
    placed = np.array([_unit(by_length[at]) for at in range(len(LENGTHS))])
    white, fading = _unit(np.eye(terms + 1)), _unit(_exponential(_FADING_RATE, terms).real)
    noise = [(share, white) for share in PLACE_WHITE]
    noise += [(share, 0.9 * fading + 0.1 * white) for share in PLACE_FADING]
    return CorrelationSet.of(
        np.concatenate([(1.0 - share) * placed + share * other for share, other in noise]),
        np.concatenate([(1.0 - share) * beyond for share, _ in noise]),
        np.tile(freedom, len(noise)),
    )


def _about_mean(covariance: FloatArray) -> FloatArray:
    """Return the covariance of values minus their mean."""
    mean = covariance.mean(axis=0)
    return np.asarray(covariance - mean - mean[:, None] + mean.mean())


def _unit(covariance: FloatArray) -> FloatArray:
    """Scale a covariance of the mean and the terms so that the terms have a power of 1."""
    return np.asarray(covariance / np.trace(covariance[1:, 1:]))


def only_time(place_m: Track) -> str:
    """Return the reason why intervals use only correlation over time, or an empty text if they also use position.

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
        return "the UAV hardly moved"
    return ""


def _smooth(rate: float, terms: int) -> FloatArray:
    """Return the covariance, as in :func:`_exponential`, for a smooth process.

    The process has the covariance (1 + rate |s - t|) exp(-rate |s - t|). The result follows from the derivative of
    :func:`_exponential` with respect to the rate.
    """
    step = 1e-20  # a step along the imaginary axis, with which the derivative is exact to rounding
    covariance = _exponential(complex(rate, rate * step), terms)
    return np.asarray(covariance.real - covariance.imag / step)


def _exponential(rate: complex, terms: int) -> ComplexArray:
    """Return the covariance (terms + 1, terms + 1) of the cosine coefficients of a process on the unit interval.

    The process has the covariance exp(-rate |s - t|).
    """
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
    """Return the prior weight (m,) of each correlation over time."""
    drawn = np.exp(0.1 * _table("ratio" if kind == "influence" else kind).ravel())
    return np.asarray(drawn / drawn.sum())


@cache
def stretches(kind: Kind) -> FloatArray:
    """Return factors (2, m) that widen the draws.

    The first row applies to the share of each correlation in the weighted likelihood, the second row to its share in
    the unweighted likelihood.
    """
    if kind in ("ratio", "influence"):  # for these kinds, the weights are enough to limit false verdicts to 5 %
        return np.repeat([[1.0], [0.0]], len(weights(kind)), axis=1)
    return 0.01 * _table(f"{kind} stretch").reshape(2, -1)


@dataclass(frozen=True, slots=True)
class Terms:
    """The cosine terms of a sequence: the slow terms (q,), and power and degrees of freedom of the fast terms."""

    slow: FloatArray
    fast_power: float
    fast_freedom: float


def cosine_terms(values: FloatArray) -> Terms:
    """Return the cosine terms of a sequence, scaled so that their squares sum to its variance."""
    from scipy.fft import dct

    n = len(values)
    every = dct(values - values.mean(), norm="ortho")[1:] / np.sqrt(n)
    count = int(_FEWER[(n - 1) // 2 >= _FEWER].max())
    fast = np.square(every[count:])
    # Satterthwaite: the mean fourth power of a normal term is three times its squared variance
    freedom = max(3.0 * float(fast.sum()) ** 2 / max(float((fast * fast).sum()), 1e-300), 1.0)
    return Terms(every[:count], float(fast.sum()), freedom)


@dataclass(frozen=True, slots=True)
class WeightedCorrelations:
    """The possible correlations of a sequence, over time, then over position, with weights (m,) and widening (2, m)."""

    parts: tuple[CorrelationSet, ...]
    weights: FloatArray
    stretches: FloatArray

    def joined(self, name: str) -> FloatArray:
        """Return one attribute of all correlations: first of those over time, then of those over position."""
        return np.concatenate([getattr(part, name) for part in self.parts])


def weighted_correlations(kind: Kind, terms: int, place_m: Track = None) -> WeightedCorrelations:
    """Return the correlations over time, and over position if the positions (n, 3) [m] allow it, with their weights."""
    over_time, weight, stretch = time_correlations(terms), weights(kind), stretches(kind)
    over_place = place_correlations(place_m, terms)
    if over_place is None:
        return WeightedCorrelations((over_time,), weight, stretch)
    size, longest = _PLACE_WEIGHT[kind]
    by_length = size * weight.mean() * longest / np.maximum(LENGTHS, longest)
    placed = np.tile(by_length, len(over_place.power) // len(LENGTHS))
    usual = np.repeat([[1.0], [0.0]], len(placed), axis=1)
    return WeightedCorrelations((over_time, over_place), np.concatenate([weight, placed]), np.hstack([stretch, usual]))


@dataclass(frozen=True, slots=True)
class Channels:
    """The channel (n,) of each sample of a pooled sequence, and whether the mean of each channel was subtracted.

    Channels are numbered from 0.
    """

    number: IntArray
    centred: bool

    def weighted(self, values: FloatArray, known: WeightedCorrelations, place_m: Track) -> WeightedCorrelations:
        """Return the correlations weighted for a pooled sequence (n,), given their weights for a single channel.

        The terms of the sequence are the sum of the terms of its channels. If channels are independent, the outer
        products of the terms of each channel add up to the covariance of the sum on average, even if the channels have
        different correlations, powers or numbers of samples. The likelihood of the channels then counts like that of
        several sequences, whose number follows from the powers and correlations of the channels. However, if channels
        have common fading and separate noise, their sum is correlated in another way than each channel. Therefore the
        weights are a mixture of these likelihoods and of the weights for a single sequence. The likelihoods of the
        channels have a small weight if the power of the sum is not the sum of the powers.
        """
        from scipy.fft import dct

        n, count, terms = len(values), int(self.number.max()) + 1, known.parts[0].slope.shape[1]
        bins = min(n, _BINS)
        at = self.number * bins + np.arange(n) * bins // n
        every = dct(np.bincount(at, values - values.mean(), count * bins).reshape(count, bins), norm="ortho")
        slow = every[:, 1 : terms + 1]
        common = slow @ slow.T
        further = max(float(np.trace(common) ** 2 / max(np.square(common).sum(), 1e-300)) - 1.0, 0.0)
        placed = place_correlations(place_m, terms, self.centred)
        joined = replace(known, parts=(*known.parts, _two_parts(terms), *([placed] if placed else [])))
        square = np.maximum(likelihoods(np.vstack([slow, slow.sum(axis=0)]), joined.parts)[1], 1e-300)
        each, whole = square[:-1].sum(axis=0), square[-1]
        log = joined.joined("log_det") - 0.5 * terms * np.log(each)
        equal, fast = np.ones(len(RATES)), np.where(RATES > _VISIBLE, 1.0, 0.0)
        over_time = [fast if share else equal for share in WHITE_SHARES]
        over_place = known.weights[len(known.parts[0].power) :]  # the weights of the correlations over position
        over_place = over_place / over_place.max(initial=1e-300)
        prior = np.concatenate([*over_time, equal, 0.0 * over_place, fast, equal, over_place])
        shown = prior * np.exp(further * (log - log.max()))
        shown /= max(float(shown.sum()), 1e-300)
        odds = further * np.exp(-0.5 * (shown @ np.log(whole / each) / _SUM_OF_POWERS) ** 2)
        weight = odds * shown
        weight[: len(known.weights)] += known.weights / known.weights.sum()
        return replace(joined, weights=weight, stretches=np.repeat([[1.0], [0.0]], len(weight), axis=1))


def likelihoods(slow: FloatArray, parts: Sequence[CorrelationSet] = ()) -> tuple[FloatArray, FloatArray]:
    """Return the likelihood (..., m) of each correlation at an unknown scale, and the whitened sum of squares."""
    parts = parts or (time_correlations(slow.shape[-1]),)
    square = np.concatenate([np.square(slow @ part.whiten.swapaxes(1, 2)).sum(axis=-1).T for part in parts], axis=-1)
    log_det = np.concatenate([part.log_det for part in parts])
    log = log_det - 0.5 * slow.shape[-1] * np.log(np.maximum(square, 1e-300))
    # divide by the largest likelihood, because likelihoods may exceed the range of floats
    return np.exp(log - log.max(axis=-1, keepdims=True)), square


@cache
def _random(terms: int) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return quasi-random draws: one uniform, one chi-squared with ``terms`` degrees of freedom, and two normal.

    The draws are a Kronecker sequence in four dimensions, and are the same for every sequence of errors.
    """
    from scipy.special import gammaincinv, ndtri

    ratio = 1.1673039782614187  # the root of x^5 = x + 1: a low-discrepancy sequence in four dimensions
    chance = (0.5 + np.outer(np.arange(1, _PAIRS + 1), ratio ** -np.arange(1.0, 5.0))) % 1.0
    return chance[:, 0], 2.0 * gammaincinv(0.5 * terms, chance[:, 1]), ndtri(chance[:, 2]), ndtri(chance[:, 3])


def _picked(slow: FloatArray, known: WeightedCorrelations) -> tuple[IntArray, FloatArray, float]:
    """Return the correlation (draws,) and squared scale (draws,) of each draw, and the widening of all draws."""
    likelihood, square = likelihoods(slow, known.parts)
    weighted = likelihood * known.weights
    running = np.cumsum(weighted)
    uniform, chi_squared, *_ = _random(len(slow))
    # limit the index, because a uniform number near 1 can round to the sum
    index = np.minimum(np.searchsorted(running, uniform * running[-1]), len(running) - 1)
    own, even = known.stretches
    stretch = float(weighted @ own / running[-1] + likelihood @ even / likelihood.sum())
    return index, square[index] / chi_squared, max(stretch, _LEAST_STRETCH)


def _stretched(drawn: FloatArray, by: float) -> FloatArray:
    """Stretch draws about their median, separately on each side.

    The new 2.5 % points are the old points whose odds are the odds of 2.5 % raised to the power ``by``.
    """
    tail = 1.0 / (1.0 + 39.0**by)  # 39 to 1 are the odds of 2.5 %
    # interpolate directly, in half the time of np.quantile
    asked, ranks = (tail, 0.025, 0.5, 0.975, 1.0 - tail), np.linspace(0.0, 1.0, len(drawn))
    low, usual_low, middle, usual_high, high = np.interp(asked, ranks, np.sort(drawn))
    # keep the order of the draws, because the interval of a correlation uses pairs of draws of mean and power
    below, above = (middle - low) / (middle - usual_low), (high - middle) / (usual_high - middle)
    return np.asarray(middle + (drawn - middle) * np.where(drawn < middle, below, above))


def memory_share(values: FloatArray) -> float:
    """Return the likeliest correlation length of a sequence (n,), divided by the length of the sequence."""
    likelihood, _ = likelihoods(cosine_terms(values).slow)
    return float(1.0 / np.tile(RATES, len(WHITE_SHARES) + 1)[int(np.argmax(likelihood * weights("power")))])


def mean_draws(
    values: FloatArray, kind: Kind = "mean", place_m: Track = None, of: Channels | None = None
) -> FloatArray:
    """Return random draws of the mean of the process minus the mean of the sequence.

    Parameters
    ----------
    values : (n,)
        In time order, at least :data:`FEWEST`.
    kind : {"mean", "ratio", "influence"}
        Kind of the values: errors, differences of their squares, or contributions of samples to a statistic.
    place_m : (n, 3), optional
        East, north and up of each sample [m], NaN if unknown. With positions, correlation over position is also used.
    of : Channels, optional
        Channels of a pooled sequence of differences of squares.

    Returns
    -------
    (draws,)
    """
    if np.ptp(values) == 0.0:
        return np.zeros(2 * _PAIRS)
    slow = cosine_terms(values).slow
    known = weighted_correlations(kind, len(slow), place_m)
    if of is not None and of.number.any():
        known = of.weighted(values, known, place_m)
    index, scale, stretch = _picked(slow, known)
    centre = -(known.joined("slope") @ slow)[index]
    reach = np.sqrt(scale * known.joined("variance")[index]) * _random(len(slow))[2]
    drawn = np.concatenate([centre + reach, centre - reach])
    return _stretched(drawn, stretch) if kind == "mean" else drawn


def heavy_tails(values: FloatArray) -> float:
    """Return the standard deviation that heavy tails add to the logarithm of the mean square, before :data:`CALM`.

    The tails are estimated from the innovations of a first-order autoregression. A sample is a sum of many innovations,
    and therefore has lighter tails than an innovation.
    """
    away, n = values - values.mean(), len(values) - 1
    keep = min(float(away[1:] @ away[:-1]) / float(away @ away), 1.0)
    both = away[1:] - keep * away[:-1], away[:-1] - keep * away[1:]  # innovations forwards and backwards in time
    square = max((np.square(e) for e in both), key=lambda e: float(e @ e) / max(float(e.mean()) ** 2, 1e-300))
    # Subtract part of the standard error, because a short normal sequence can show heavy tails by chance.
    excess = float(square @ square) / n / max(float(square.mean()) ** 2, 1e-300) - 3.0 - np.sqrt(6.0 / n)
    # A long sequence contains rare large errors that a short sequence lacks. The exponent 0.1 was found by simulation,
    # like CALM.
    return float(np.sqrt(max(excess, 0.0) / n) * (300.0 / n) ** 0.1)


def loud_part(values: FloatArray) -> tuple[float, float]:
    """Find parts of a sequence (n,) with much larger errors than all other parts.

    Returns
    -------
    share, ratio : float
        Share of the samples in the loud parts, and the mean square of these samples divided by the mean square of all
        other samples. 0 and 1 if the sequence is steady. At least two parts must have a large mean square of the
        innovations of a second-order autoregression, which are hardly correlated. The mean square of the errors in
        these parts must also be large.
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


def power_draws(values: FloatArray, place_m: Track = None) -> FloatArray:
    """Return random draws of the expected variance of a sequence with the length and spacing of ``values``.

    The draws are in the same order as in :func:`mean_draws`. A correlation longer than the sequence affects only its
    mean.

    Parameters
    ----------
    values : (n,)
        In time order, at least :data:`FEWEST`. Tails heavier than normal and loud parts (:func:`loud_part`) widen the
        draws.
    place_m : (n, 3), optional
        The same as in :func:`mean_draws`.
    """
    if np.ptp(values) == 0.0:
        return np.zeros(2 * _PAIRS)
    terms = cosine_terms(values)
    known = weighted_correlations("power", len(terms.slow), place_m)
    index, scale, stretch = _picked(terms.slow, known)
    *_, normal, second_normal = _random(len(terms.slow))
    # errors that depend on position repeat when the UAV returns to a position, so their power has fewer independent
    # squares
    placed = np.minimum(scale * known.joined("beyond")[index] / max(terms.fast_power, 1e-300), 1.0)
    third = 2.0 / 9.0 * np.maximum(1.0 / terms.fast_freedom, placed**2 / known.joined("freedom")[index])
    # chi-squared over its degrees of freedom, after Wilson and Hilferty (1931)
    fast = terms.fast_power / np.maximum(1.0 - third + np.sqrt(third) * second_normal, 0.05) ** 3
    share, ratio = loud_part(values)
    # reduce the effect of heavy tails if there is a loud part: it also makes the tails heavy, and its own effect is
    # added below
    heavy = (0.7 if share else 1.0) * heavy_tails(values)
    tails = np.exp(heavy * np.where(normal > 0.0, CALM, 1.0) * normal)
    drawn = (scale * known.joined("power")[index] + fast) * tails
    log = _stretched(np.log(drawn), stretch)
    # a loud part has fewer independent samples than the flight, so increase the variance as for a weighted mean
    more = np.sqrt(share * ratio**2 + 1.0 - share) / (share * ratio + 1.0 - share)
    middle = np.median(log)
    return np.tile(np.exp(middle + more * (log - middle)), 2)


# Half the 95 % interval of a standard normal variable.
_NORMAL_95 = 1.959964

# If the width of an interval exceeds this multiple of the estimate, only the lower end of the interval is reported.
_BOUND = 2.0

# Number of segments of a flight. The regression coefficient for a segment is fitted to all other segments.
_SEGMENTS = 24

# Nominal share of flights with a false verdict on any channel. With a nominal share of 0.05, 1 to 10 % of simulated
# flights have a false verdict, because small probabilities are estimated less accurately than the ends of an interval.
_FAMILY = 0.02

Interval = tuple[float, float]
NO_INTERVAL: Interval = (float("nan"), float("nan"))


def independent_samples(values: FloatArray, place_m: Track = None) -> float:
    """Return the number of independent samples whose mean would be as accurate as the mean of the sequence.

    Parameters
    ----------
    values : (n,)
        Values in time order, without NaN.
    place_m : (n, 3), optional
        The same as in :func:`mean_draws`.

    Returns
    -------
    float
        1 to n; n for a constant sequence, NaN for fewer than :data:`FEWEST` samples.
    """
    if len(values) < FEWEST:
        return float("nan")
    return _independent(values, influence_interval(float(values.mean()), values, place_m))


def _independent(values: FloatArray, interval: Interval) -> float:
    """Return the number of independent samples that would determine the mean with this 95 % interval."""
    half = 0.5 * float(np.ptp(interval))
    return float(np.clip(_NORMAL_95**2 * values.var() / half**2, 1.0, len(values))) if half else float(len(values))


@dataclass(frozen=True, slots=True)
class ErrorIntervals:
    """The 95 % intervals for the comparison of a measured with a simulated sequence of levels.

    Parameters
    ----------
    offset_db, rmse_db, correlation : (low, high)
        NaN ("no interval") for fewer than :data:`FEWEST` samples, or if the statistic does not exist.
    n_effective : float
        Number of independent samples that would determine the offset equally well. NaN without an interval.
    notes : tuple of str
        Sentences about the limits of the intervals.
    """

    offset_db: Interval
    rmse_db: Interval
    correlation: Interval
    n_effective: float = float("nan")
    notes: tuple[str, ...] = ()


def error_intervals(measured_db: FloatArray, simulated_db: FloatArray, place_m: Track = None) -> ErrorIntervals:
    """Compute the intervals of offset (mean difference), RMSE with this offset, and correlation.

    Parameters
    ----------
    measured_db, simulated_db : (n,)
        Pairs in time order, without NaN [dB].
    place_m : (n, 3), optional
        The same as in :func:`mean_draws`.

    Returns
    -------
    ErrorIntervals
        Offset [dB], RMSE [dB] and correlation.
    """
    difference = simulated_db - measured_db
    if len(difference) < FEWEST:
        return ErrorIntervals(NO_INTERVAL, NO_INTERVAL, NO_INTERVAL)
    offset = mean_interval(difference, place_m)
    return ErrorIntervals(
        offset,
        spread_interval(difference, place_m),
        _correlation_interval(measured_db, simulated_db, place_m),
        _independent(difference, offset),
        tuple(_notes(difference, place_m)),
    )


def _notes(values: FloatArray, place_m: Track) -> Iterator[str]:
    """Yield sentences about the limits of the intervals of a sequence (n,)."""
    if place_m is not None and (reason := only_time(place_m)):
        yield f"The intervals consider correlation over time only: {reason}."
    share, ratio = loud_part(values)
    if share:
        yield (
            f"The error is not stationary: it is {np.sqrt(ratio):.1f} times larger in {100.0 * share:.0f} % of the "
            "flight. The interval of the RMSE is therefore wider, but can still be too narrow."
        )


def _correlation_interval(measured_db: FloatArray, simulated_db: FloatArray, place_m: Track) -> Interval:
    """Return the interval of the correlation.

    The route is fixed. The slope and the residual of the measurement are random.
    """
    s, m = simulated_db - simulated_db.mean(), measured_db - measured_db.mean()
    spread = float(s @ s) / len(s)
    if spread == 0.0 or not m.any():
        return NO_INTERVAL
    slope = float(m @ s) / len(s) / spread
    residual = m - slope * s
    along = (slope + mean_draws(residual * s, place_m=place_m) / spread) * np.sqrt(spread)
    return _around(correlation(measured_db, simulated_db), along / np.sqrt(along**2 + power_draws(residual, place_m)))


def mean_interval(values: FloatArray, place_m: Track = None) -> Interval:
    """Return the 95 % interval of the mean of a process, from one sequence (n,) in time order.

    Errors may be correlated over the positions ``place_m`` (n, 3) [m] as well, as for :func:`mean_draws`.
    """
    if len(values) < FEWEST:
        return NO_INTERVAL
    mean = float(values.mean())
    return _around(mean, mean + mean_draws(values, place_m=place_m))


def influence_interval(
    estimate: float, influence: FloatArray, place_m: Track = None, bounds: Interval = (-np.inf, np.inf)
) -> Interval:
    """Return the 95 % interval of a statistic of a sequence.

    Parameters
    ----------
    estimate : float
        The statistic of the samples.
    influence : (n,)
        First-order contribution of each sample to the statistic, up to a constant, in time order.
    place_m : (n, 3), optional
        The same as in :func:`mean_draws`.
    bounds : (low, high)
        The range of the statistic.

    Returns
    -------
    (low, high)
        NaN if the statistic does not exist or has fewer than :data:`FEWEST` samples.

    Notes
    -----
    This is the interval of the mean of ``influence``, with the weights for paired differences. On simulated ranks, it
    covers the true value as often as an interval with the weights for offsets. With 1000 samples and a correlation
    length of 150 m, its width is 1.3 times the width for a known correlation, instead of 1.8 times.
    """
    if len(influence) < FEWEST or not np.isfinite(estimate):
        return NO_INTERVAL
    low, high = np.clip(_around(estimate, estimate + mean_draws(influence, "influence", place_m)), *bounds)
    return float(low), float(high)


def spread_interval(values: FloatArray, place_m: Track = None) -> Interval:
    """Return the 95 % interval of the standard deviation of a correlated sequence (n,) in time order.

    If the interval is wider than :data:`_BOUND` times the value, its upper end is infinite, so that it is a lower
    bound. Positions ``place_m`` (n, 3) [m] are used as in :func:`mean_draws`.
    """
    if len(values) < FEWEST:
        return NO_INTERVAL
    low, high = _around(float(values.std()), np.sqrt(power_draws(values, place_m)))
    return low, np.inf if high - low > _BOUND * values.std() else high


def rmse_interval(residual: FloatArray, rmse: float, place_m: Track = None) -> Interval:
    """Return the 95 % interval of the root mean square of residuals (n,) in time order, whose value is ``rmse``.

    The mean of the residuals is not 0 if the offset was rounded to a grid, is at the edge of its search range or was
    fitted with a floor. The mean then enlarges both ends of the interval as it enlarges the RMSE. Positions ``place_m``
    (n, 3) [m] are used as by :func:`mean_draws`.
    """
    if len(residual) < FEWEST:
        return NO_INTERVAL
    low, high = np.hypot(spread_interval(residual, place_m), residual.mean())
    return float(min(low, rmse)), float(max(high, rmse))


def _around(estimate: float, drawn: FloatArray) -> Interval:
    """Return the 95 % interval of draws, extended so that it contains the estimate."""
    if not np.isfinite(estimate) or not np.isfinite(drawn).any():
        return NO_INTERVAL
    low, high = np.nanquantile(drawn, [0.025, 0.975])
    return float(min(low, estimate)), float(max(high, estimate))


def middle_span(values: FloatArray) -> float:
    """Return the width of the middle 80 % of values (n,)."""
    return float(np.ptp(np.percentile(values, (10, 90))))


# A measured level is flat if it varies by less than this share of the variation of the predicted levels, as at a noise
# floor or at an input without a signal.
_FLAT = 0.2


def is_flat(measured_db: FloatArray, predicted_db: Iterable[FloatArray]) -> bool:
    """Check whether a measured level (n,), n > 0, varies much less than every predicted level (n,) [dB]."""
    return middle_span(measured_db) < _FLAT * min(map(middle_span, predicted_db))


def is_stuck(level_db: FloatArray) -> bool:
    """Check whether a log has at most two different levels (n,), which do not contain information about a link."""
    return len(np.unique(level_db[np.isfinite(level_db)])) <= 2


def correlation(first: ArrayLike, second: ArrayLike) -> float:
    """Return the Pearson correlation over pairs without NaN, or NaN for fewer than three pairs or a constant input."""
    a, b = unmasked(first), unmasked(second)
    ok = np.isfinite(a) & np.isfinite(b)
    if ok.sum() < 3 or np.ptp(a[ok]) == 0.0 or np.ptp(b[ok]) == 0.0:
        return float("nan")
    a, b = a[ok] - a[ok].mean(), b[ok] - b[ok].mean()
    return float(np.clip((a @ b) / np.sqrt((a @ a) * (b @ b)), -1.0, 1.0))


@dataclass(frozen=True, slots=True, kw_only=True)
class PairedDifference:
    """A comparison of two models on the same samples, with the significance of the difference.

    Parameters
    ----------
    n : int
        Number of samples at which both models have an error.
    rmse_db, other_rmse_db : float
        RMSE of the first and of the second model [dB].
    difference_db : float
        ``rmse_db - other_rmse_db`` [dB], negative if the first model is better.
    difference_ci95_db : (low, high)
        95 % interval of the difference [dB]. NaN if there is no interval. Also NaN if it contains 0 and is so wide that
        one of the two RMSEs would be negative at one end. The flight is then too short compared with the correlation
        time of its errors.
    standard_error_db : float
        Half of the width of the central 68 % interval of ``difference_db`` [dB], NaN if there is no interval.
    mean_square_difference_db2, mean_square_ci95_db2 : float, (low, high)
        Difference of the mean square errors and its interval [dB^2].
    p_value : float
        Probability that equally good models differ by at least this much.
    verdict : {"better", "worse", "not significant", "no interval"}
        Verdict on the first model, according to the interval.
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
        """Return a clause for a report, such as "worse than free space by 0.6 dB [0.2, 1.0]"."""
        if not self.n:
            return f"no sample in common with {other_model}"
        size = f"{abs(self.difference_db):.1f} dB"
        if self.verdict == "no interval":
            more = "more" if self.difference_db > 0 else "less"
            return f"{size} {more} error than {other_model}; the flight is too short for an interval"
        difference, low, high = map(Printed, (self.difference_db, *self.difference_ci95_db))
        if self.verdict == "not significant":
            corrected_for = "" if low <= 0.0 <= high else "; corrected for the number of channels"
            size = f"{difference:+.1f} dB [{low:+.1f}, {high:+.1f}]{corrected_for}"
            return f"no significant difference from {other_model} ({size})"
        near, far = sorted((abs(low), abs(high)))
        digits = 1 if near >= 0.05 else 2
        size = f"{abs(difference):.{digits}f} dB [{near:.{digits}f}, {far:.{digits}f}]"
        return f"{self.verdict} than {other_model} by {size}"


# Smaller differences [dB] between the errors of two models are rounding errors.
_ROUNDING_DB = 1e-9


def paired_difference(
    error_db: ArrayLike, other_error_db: ArrayLike, *, free_offset: bool = True, place_m: Track = None,
    of: Channels | None = None,
) -> PairedDifference:  # fmt: skip
    """Compare two models on the same samples by the difference of their mean square errors.

    Parameters
    ----------
    error_db, other_error_db : array_like, (n,)
        Measured minus predicted, in time order [dB]. Samples with a NaN on either side are ignored.
    free_offset : bool
        True if each model has its own offset, so that the mean of its errors is subtracted. False for held-out errors,
        which are used unchanged.
    place_m : (n, 3), optional
        The same as in :func:`mean_draws`.
    of : Channels, optional
        Channel of each sample, if samples of several channels are compared at once. No sample may be NaN then.

    Returns
    -------
    PairedDifference

    Notes
    -----
    Let d be the difference of the two predictions, which the route determines, and b the coefficient of a regression of
    the error on d. The difference of the mean square errors is (2 b - 1) times the mean square of d. The random part of
    each sample is d times the residual of that regression (Harvey, Leybourne and Newbold 1998,
    doi:10.1080/07350015.1998.10524759). In each segment of the flight, b is fitted to the other segments, so that a
    single segment cannot determine b.

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
    # treat models that differ only by rounding as equal
    second = np.where(np.abs(first - second) < _ROUNDING_DB, first, second)
    nan = float("nan")
    square, other_square = (float(np.mean(e * e)) if len(e) else nan for e in (first, second))
    rmse, other_rmse = float(np.sqrt(square)), float(np.sqrt(other_square))
    bounds, squares, spread, chance = NO_INTERVAL, NO_INTERVAL, nan, 1.0
    if len(first) >= FEWEST:
        places = None if place_m is None else place_m[finite]
        drawn = square - other_square + mean_draws(undecided(first, second), "ratio", places, of)
        squares = _around(square - other_square, drawn)
        scale = max(rmse + other_rmse, 1e-300)
        bounds = squares[0] / scale, squares[1] / scale
        if bounds[0] <= 0.0 <= bounds[1] and (bounds[0] < -other_rmse or bounds[1] > rmse):
            bounds = NO_INTERVAL
        # use the central 68 %, so that heavy tails have no effect
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
    """Return the random contribution (n,) of each sample to the difference of mean squares [dB^2]."""
    apart = first - second
    segment = np.arange(len(apart)) * _SEGMENTS // len(apart)
    products, squares = (np.bincount(segment, values, _SEGMENTS) for values in (first * apart, apart * apart))
    # add a small weight towards equal models, in case one segment of a flight contains all of the difference
    even = 1e-3 * squares.sum() + 1e-300
    share = (products.sum() - products + 0.5 * even) / (squares.sum() - squares + even)
    return np.asarray(2.0 * (first - share[segment] * apart) * apart)


def pooled_difference(
    channels: Sequence[tuple[FloatArray, FloatArray, FloatArray]],
    *,
    free_offset: bool = True,
    place_m: Sequence[FloatArray] | None = None,
) -> PairedDifference:
    """Compare two models over all channels of a flight together.

    Parameters
    ----------
    channels : sequence of ((n,), (n,), (n,))
        Times and the errors of the two models [dB] of each channel. NaN is ignored.
    free_offset : bool
        True if each channel and model has its own offset.
    place_m : sequence of (n, 3), optional
        Positions of each channel's samples, as for :func:`mean_draws`.

    Returns
    -------
    PairedDifference
        Comparison of the root mean square errors over all samples. Samples of all channels are in time order, so that
        common fading of the channels counts once. The correlation is also estimated from the single channels
        (:class:`Channels`).
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
    number = np.repeat(np.arange(len(parts)), [len(part[0]) for part in parts])[order]
    of = Channels(number, free_offset)
    return paired_difference(first[order], second[order], free_offset=False, place_m=place[order], of=of)


def corrected(pairs: Sequence[PairedDifference], measured: Sequence[Hashable] | None = None) -> list[PairedDifference]:
    """Correct the verdicts of several channels for their number (Holm 1979).

    With a probability of 95 %, all remaining verdicts "better" and "worse" are right.

    Channels with the same ``measured`` levels count once.
    """
    # Holm: multiply the smallest p-value by the number of channels, the next by this number minus one, and so on
    order = sorted(range(len(pairs)), key=lambda i: pairs[i].p_value)
    names = measured or range(len(pairs))
    out, tried = list(pairs), {names[i] for i in order if pairs[i].verdict != "no interval"}
    several = len(tried) > 1  # a single channel keeps the verdict of its interval
    for place, i in enumerate(order):
        if several and pairs[i].p_value * max(len(tried), 1) > _FAMILY:
            for rest in order[place:]:
                if pairs[rest].verdict in ("better", "worse"):
                    out[rest] = replace(pairs[rest], verdict="not significant")
            break
        tried.discard(names[i])
    return out


def paired_verdict(low: float, high: float) -> Literal["better", "worse", "not significant", "no interval"]:
    """Return the verdict for the interval of a difference of errors."""
    if not (np.isfinite(low) and np.isfinite(high)):
        return "no interval"
    return "better" if high < 0 else "worse" if low > 0 else "not significant"


def share_interval(indicator: FloatArray, place_m: Track = None, sequence: FloatArray | None = None) -> Interval:
    """Return the 95 % interval of a share, such as a bar of a histogram.

    Parameters
    ----------
    indicator : (n,)
        1 for each sample that counts, else 0, in time order.
    place_m : (n, 3), optional
        The same as in :func:`mean_draws`.
    sequence : (n,), optional
        The sequence from which the indicator was computed. The effective size of this sequence is used if the share is
        0 or 1.

    Returns
    -------
    (low, high)
        NaN for fewer than :data:`FEWEST` samples.

    Notes
    -----
    This is Wilson's interval for the number of independent samples whose mean would be equally accurate. It has a
    positive width even at shares of 0 and 1, where the samples do not vary. Wilson (1927),
    doi:10.1080/01621459.1927.10502953.
    """
    n = len(indicator)
    if n < FEWEST:
        return NO_INTERVAL
    share, varied = float(indicator.mean()), indicator
    if np.ptp(indicator) == 0.0 and sequence is not None:
        varied = sequence
    z2, size = _NORMAL_95**2, independent_samples(varied, place_m)
    centre = (share + z2 / (2 * size)) / (1 + z2 / size)
    reach = np.sqrt(z2 * (share * (1 - share) / size + z2 / (4 * size**2))) / (1 + z2 / size)
    low, high = float(centre - reach), float(centre + reach)
    return (0.0 if share == 0.0 else max(0.0, low)), (1.0 if share == 1.0 else min(1.0, high))


# Distance below which samples of two passes count as taken at the same position [m].
SAME_PLACE_M = 2.0

# Largest difference of the headings of such samples, if headings are given [deg].
_HEADING_WITHIN_DEG = 20.0


@dataclass(frozen=True, slots=True)
class Visit:
    """One pass over positions (n, 3) [m], with values (n,), NaN if missing, and optional headings (n,) [deg]."""

    position_m: FloatArray
    value: FloatArray
    heading_deg: FloatArray | None = None


def same_places(first: Visit, second: Visit, radius_m: float = SAME_PLACE_M) -> tuple[IntArray, IntArray]:
    """Return indices of pairs: a sample of one pass, and the nearest sample of the other pass within a radius [m]."""
    known = [np.isfinite(v.position_m).all(axis=1) & np.isfinite(v.value) for v in (first, second)]
    mine, theirs = (_Places(v.position_m, v.heading_deg, k) for v, k in zip((first, second), known, strict=True))
    return mine.partners(theirs, radius_m, _HEADING_WITHIN_DEG)


@dataclass(frozen=True, slots=True, kw_only=True)
class Pass:
    """The samples of one link on one flight.

    Parameters
    ----------
    flight, tower, channel : str
        Names. Two passes are compared if they have the same tower and channel, and different flights.
    position_m : ndarray, (n, 3)
        East, north, up. Rows with NaN have no partner.
    level_db, residual_db : ndarray, (n,)
        Measurement, and measurement minus simulation, NaN if missing.
    heading_deg : ndarray, (n,), optional
        Clockwise from north.
    """

    flight: str
    tower: str
    channel: str
    position_m: FloatArray = field(repr=False)
    level_db: FloatArray = field(repr=False)
    residual_db: FloatArray = field(repr=False)
    heading_deg: FloatArray | None = field(repr=False, default=None)


@dataclass(frozen=True, slots=True, kw_only=True)
class PassPair:
    """The difference between two flights at the same positions, for one tower and channel.

    Parameters
    ----------
    n : int
        Number of samples of the first flight with a partner.
    share : float
        ``n`` divided by the number of samples of the first flight.
    rmse_db, offset_db : float
        Standard deviation and mean of second minus first measurement [dB]. NaN if there are no pairs.
    rmse_ci95_db : (low, high)
        95 % interval of the RMSE (:func:`spread_interval`), with correlation over time alone.
    single_db : float
        ``rmse_db / sqrt(2)``, the error of one flight if both have equal and independent errors.
    residual_rmse_db : float
        Standard deviation of the difference of the residuals [dB].
    place_rmse_db, place_correlation, height_difference_m : float
        Standard deviation and correlation of the mean residuals, and median difference of the mean heights, over common
        horizontal cells. If the correlation is near 1, the model has the same errors on both flights.
    cells : int
        Number of common cells.
    """

    tower: str
    channel: str
    first: str
    second: str
    n: int
    share: float
    rmse_db: float
    rmse_ci95_db: Interval
    offset_db: float
    single_db: float
    residual_rmse_db: float
    place_rmse_db: float
    place_correlation: float
    cells: int
    height_difference_m: float


# --- every pair -----------------------------------------------------------------------------------------------------


class _Places:
    """The samples of a pass that the mask ``good`` (n,) selects, with their k-d tree and bounding box.

    ``where`` contains the indices of the samples in the pass.
    """

    def __init__(self, position_m: FloatArray, heading_deg: FloatArray | None, good: BoolArray) -> None:
        self.where = np.flatnonzero(good)
        self.position_m = np.ascontiguousarray(position_m[good])
        self.heading_deg = None if heading_deg is None else heading_deg[good]
        self.low = self.position_m.min(axis=0, initial=np.inf)
        self.high = self.position_m.max(axis=0, initial=-np.inf)

    @cached_property
    def tree(self) -> Any:
        from scipy.spatial import cKDTree

        return cKDTree(self.position_m)

    def partners(self, other: _Places, radius_m: float, within_deg: float | None) -> tuple[IntArray, IntArray]:
        """Return pairs of indices: samples of this pass, and the nearest of the other pass at a similar heading."""
        # only samples in the bounding box of the other pass can have a partner, which excludes most flights of a
        # campaign
        near = np.flatnonzero(
            ((self.position_m >= other.low - radius_m) & (self.position_m <= other.high + radius_m)).all(axis=1)
        )
        if not len(near):
            return near, near
        distance, nearest = other.tree.query(self.position_m[near], distance_upper_bound=radius_m)
        # the tree returns infinity if there is no near sample
        paired = np.isfinite(distance)
        rows, nearest_rows = near[paired], nearest[paired]
        if within_deg is not None and self.heading_deg is not None and other.heading_deg is not None:
            turn = wrap_degrees(other.heading_deg[nearest_rows] - self.heading_deg[rows])
            same = np.abs(turn) <= within_deg
            rows, nearest_rows = rows[same], nearest_rows[same]
        return self.where[rows], other.where[nearest_rows]


@dataclass(frozen=True, slots=True)
class _Prepared:
    """A pass prepared for pairing: positions of levels and residuals, indices of cells, and means over cells."""

    number: int
    flown: Pass
    level: _Places
    residual: _Places
    cells: IntArray
    means: FloatArray
    heights: FloatArray


def pass_pairs(
    passes: Sequence[Pass], *, cell_m: float, radius_m: float, heading_within_deg: float | None
) -> list[PassPair]:
    """Return all pairs of passes of different flights on the same link, ordered by the first, then by the second pass.

    Parameters
    ----------
    passes : sequence of Pass
        At most one pass per flight, tower and channel.
    cell_m : float
        Side of the square cells on the map [m].
    radius_m : float
        Largest distance from a sample of the first pass to the nearest sample of the second pass, with which it is
        paired.
    heading_within_deg : float, optional
        Largest difference of the headings of a pair, if both passes have headings. None allows any heading.

    Returns
    -------
    list of PassPair
    """
    places: dict[bytes, _Places] = {}
    # by flight, then by link
    flights: dict[str, dict[tuple[str, str], _Prepared]] = {}
    for number, flown in enumerate(passes):
        links = flights.setdefault(flown.flight, {})
        links[flown.tower, flown.channel] = _prepare(number, flown, cell_m, places)
    pairs: dict[tuple[int, int], PassPair] = {}
    for first, second in combinations(flights.values(), 2):

        @cache  # all links of a pair of flights share the searches for partners
        def met(mine: _Places, theirs: _Places) -> tuple[IntArray, IntArray]:
            return mine.partners(theirs, radius_m, heading_within_deg)

        for link in first.keys() & second.keys():
            mine, theirs = first[link], second[link]
            pairs[mine.number, theirs.number] = _pair(mine, theirs, met)
    return [pairs[numbers] for numbers in sorted(pairs)]


def _prepare(number: int, flown: Pass, cell_m: float, places: dict[bytes, _Places]) -> _Prepared:
    placed = np.isfinite(flown.position_m).all(axis=1)
    scored = placed & np.isfinite(flown.residual_db)
    cells, means, heights = cell_means(flown.position_m, flown.residual_db, scored, cell_m)
    return _Prepared(
        number=number,
        flown=flown,
        level=_entered(flown, placed & np.isfinite(flown.level_db), places),
        residual=_entered(flown, scored, places),
        # one integer per cell, because intersecting rows of two columns is ten times slower in NumPy
        cells=(cells[:, 0] << 32) + cells[:, 1],
        means=means,
        heights=heights,
    )


def _entered(flown: Pass, good: BoolArray, places: dict[bytes, _Places]) -> _Places:
    """Return the samples that ``good`` selects. Links that were sampled at the same positions share one object."""
    columns = (good, flown.position_m, *([] if flown.heading_deg is None else [flown.heading_deg]))
    # compare contents, because links that were sampled at the same positions have equal values in different arrays
    key = hashlib.sha256(b"".join(column.tobytes() for column in columns)).digest()
    return places.setdefault(key, _Places(flown.position_m, flown.heading_deg, good))


def cell_means(
    position_m: FloatArray, residual_db: FloatArray, good: BoolArray, cell_m: float
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return the square cells with a sample, their mean residual and mean height.

    Parameters
    ----------
    position_m : (n, 3)
    residual_db : (n,)
    good : (n,) bool
        True for samples that count.
    cell_m : float
        Side of a cell [m].

    Returns
    -------
    cells : (c, 2) int
        Indices of the cells, east and north, ascending.
    residual_db, height_m : (c,)
        Means over the samples of each cell.
    """
    # use horizontal cells, so that passes at different heights have common cells
    cells = np.floor(position_m[good, :2] / cell_m).astype(np.int64)
    cell, which = np.unique(cells, axis=0, return_inverse=True)
    # NumPy 2.0.0 returns an array of two dimensions here
    which = which.reshape(-1)
    count = np.maximum(np.bincount(which, minlength=len(cell)), 1)
    residual = np.bincount(which, weights=residual_db[good], minlength=len(cell)) / count
    height = np.bincount(which, weights=position_m[good, 2], minlength=len(cell)) / count
    return cell, residual, height


def _pair(mine: _Prepared, theirs: _Prepared, met: Callable[[_Places, _Places], tuple[IntArray, IntArray]]) -> PassPair:
    """Compare two passes of a link. ``met`` is the function that finds the indices of partners."""
    i, j = met(mine.level, theirs.level)
    level = theirs.flown.level_db[j] - mine.flown.level_db[i]
    i, j = met(mine.residual, theirs.residual)
    residual = theirs.flown.residual_db[j] - mine.flown.residual_db[i]
    _, i, j = np.intersect1d(mine.cells, theirs.cells, assume_unique=True, return_indices=True)
    change, nan = theirs.means[j] - mine.means[i], float("nan")
    rmse_db = float(level.std()) if len(level) else nan
    return PassPair(
        tower=mine.flown.tower,
        channel=mine.flown.channel,
        first=mine.flown.flight,
        second=theirs.flown.flight,
        n=len(level),
        share=len(level) / max(int(np.isfinite(mine.flown.level_db).sum()), 1),
        rmse_db=rmse_db,
        rmse_ci95_db=spread_interval(level),
        offset_db=float(level.mean()) if len(level) else nan,
        single_db=rmse_db / 2.0**0.5,
        residual_rmse_db=float(residual.std()) if len(residual) else nan,
        place_rmse_db=float(change.std()) if len(i) else nan,
        place_correlation=correlation(mine.means[i], theirs.means[j]),
        cells=len(i),
        height_difference_m=float(np.median(theirs.heights[j] - mine.heights[i])) if len(i) else nan,
    )
