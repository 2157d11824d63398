"""Draws of a process's mean, power and ratio of powers, from one sequence whose memory is not known.

Neighbouring errors of a flight repeat each other, and how long they do is itself hardly known from one flight. The
sequence is described by its slowest cosine terms, after Mueller and Watson (2008),
doi:10.1111/j.1468-0262.2008.00868.x: given a memory, they are normal with a known covariance. Memories from three times
the flight's length to none at all, rough (exponential) with and without white noise and smooth (Matern 3/2), are
weighted by how well they explain the terms, and by weights that let no memory's 95 % intervals hold much less. Weights
alone make others hold more: long memories must be feared though the terms hardly show them. How far out the ends of an
interval lie among the draws is therefore a matter of the memories that the sequence shows, with the weights and without
(``benchmarks/interval_weights.py`` finds both by simulation).
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np

from ...common.units import ComplexArray, FloatArray, IntArray

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

# Logarithms of the weights in tenths, by kind, rough memories of each white share and smooth ones, and rate. Stretches
# of the draws in hundredths: what the weighted shares of the memories add, then what the shares without weights do.
_TABLES = Path(__file__).with_name("memory_weights.json")

# Of the standard deviation of the logarithm of the power upwards, over that which the fourth moment says; by simulation
# with Student's t of four degrees of freedom. Most sequences with heavy tails look calmer than the process.
CALM = 1.8

# A sum over shares that no simulated flight showed may fall to nothing: eight of ten draws stay within the ends.
_LEAST_STRETCH = 0.6

# Draws come in pairs of opposite sign, so that exchanging two models turns an interval about exactly.
_PAIRS = 2048


@dataclass(frozen=True, slots=True)
class Memories:
    """All memories (m,) at ``terms`` cosine terms: normal distributions of the mean and the terms, up to a scale.

    ``whiten`` (m, terms, terms) makes the terms independent, ``log_det`` (m,) is the logarithm of its determinant;
    ``slope`` (m, terms) and ``variance`` (m,) give mean and variance of the sequence's mean once the terms are known;
    ``power`` (m,) is that of the terms together.
    """

    whiten: FloatArray
    log_det: FloatArray
    slope: FloatArray
    variance: FloatArray
    power: FloatArray


@cache
def memories(terms: int = TERMS) -> Memories:
    """Rough memories of each of :data:`WHITE_SHARES`, then smooth ones; :data:`RATES` run fastest."""
    white = np.eye(terms + 1)
    covariances = [
        (1.0 - share) * 0.5 * rate * _exponential(rate, terms).real + share * white
        for share in WHITE_SHARES for rate in RATES
    ] + [0.25 * rate * _smooth(rate, terms) + _SMOOTH_FLOOR * white for rate in RATES]  # fmt: skip
    every = np.array(covariances)
    whiten = np.linalg.inv(np.linalg.cholesky(every[:, 1:, 1:]))
    cross = every[:, 0, 1:]
    slope = np.einsum("mij,mi->mj", whiten, np.einsum("mij,mj->mi", whiten, cross))
    return Memories(
        whiten=whiten,
        log_det=np.log(np.diagonal(whiten, axis1=1, axis2=2)).sum(axis=1),
        slope=slope,
        variance=every[:, 0, 0] - (cross * slope).sum(axis=1),
        power=np.trace(every[:, 1:, 1:], axis1=1, axis2=2),
    )


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


def likelihoods(slow: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Likelihood (..., m) of each memory, its scale integrated out, and the whitened sum of squares (..., m)."""
    known = memories(slow.shape[-1])
    square = np.square(slow @ known.whiten.swapaxes(1, 2)).sum(axis=-1).T
    log = known.log_det - 0.5 * slow.shape[-1] * np.log(np.maximum(square, 1e-300))
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


def _picked(slow: FloatArray, kind: Kind) -> tuple[IntArray, FloatArray, float]:
    """Memory (draws,) and squared scale (draws,) of each draw, and what :func:`_stretched` does to them all."""
    likelihood, square = likelihoods(slow)
    weighted = likelihood * weights(kind)
    running = np.cumsum(weighted)
    uniform, chi_squared, *_ = _random(len(slow))
    # a chance near 1 may round to the whole sum
    index = np.minimum(np.searchsorted(running, uniform * running[-1]), len(running) - 1)
    own, even = stretches(kind)
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


def mean_draws(values: FloatArray, kind: Kind = "mean") -> FloatArray:
    """Draws of the mean of the process minus the mean of the sequence.

    Parameters
    ----------
    values : (n,)
        In time order, at least :data:`FEWEST`.
    kind : {"mean", "ratio"}
        Errors, or differences of their squares.
    """
    if np.ptp(values) == 0.0:
        return np.zeros(2 * _PAIRS)
    slow = cosine_terms(values).slow
    known = memories(len(slow))
    index, scale, stretch = _picked(slow, kind)
    centre = -(known.slope @ slow)[index]
    reach = np.sqrt(scale * known.variance[index]) * _random(len(slow))[2]
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


def power_draws(values: FloatArray) -> FloatArray:
    """Draws of the mean square about their own mean that sequences of this length and spacing have on average.

    In the order of :func:`mean_draws`. What a memory longer than the sequence adds to the mean does not count.

    Parameters
    ----------
    values : (n,)
        In time order, at least :data:`FEWEST`. Tails heavier than normal widen the draws.
    """
    if np.ptp(values) == 0.0:
        return np.zeros(2 * _PAIRS)
    terms = cosine_terms(values)
    index, scale, stretch = _picked(terms.slow, "power")
    *_, normal, second_normal = _random(len(terms.slow))
    third = 2.0 / (9.0 * terms.fast_freedom)
    # chi-squared over its degrees of freedom, after Wilson and Hilferty (1931)
    fast = terms.fast_power / np.maximum(1.0 - third + np.sqrt(third) * second_normal, 0.05) ** 3
    tails = np.exp(heavy_tails(values) * np.where(normal > 0.0, CALM, 1.0) * normal)
    drawn = (scale * memories(len(terms.slow)).power[index] + fast) * tails
    return np.tile(np.exp(_stretched(np.log(drawn), stretch)), 2)
