"""Draws of a process's mean, power and ratio of powers, from one sequence whose memory is not known.

Neighbouring errors of a flight repeat each other, and how long they do is itself hardly known from one flight. The
sequence is described by its slowest cosine terms, after Mueller and Watson (2008),
doi:10.1111/j.1468-0262.2008.00868.x: given a memory, they are normal with a known covariance. Memories from three times
the flight's length to none at all, with and without white noise, are weighted by how well they explain the terms, and
by weights that make 95 % intervals hold 95 % of the time whatever the memory is (``benchmarks/interval_weights.py``
finds them by simulation). A flight that is one memory long gets a wide interval, not none.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np

from ...common.units import FloatArray, IntArray

# Cosine terms that the memory is judged by; faster ones tell about the power alone.
TERMS = 24

# Samples below which nothing is said.
FEWEST = 20

# Length of the sequence over the length of its memory (exponential: exp(-rate) is what two ends share).
RATES = np.geomspace(0.3, 500.0, 18)

# Share of white noise in the slowest fluctuations.
WHITE_SHARES = (0.0, 2e-3, 3e-2)

Kind = Literal["mean", "power", "ratio"]

# Logarithms of the weights in tenths, by kind, white share and rate; from 300 sequences in each of 54 cells of
# (samples, correlation of neighbours, white noise).
_TENTHS = Path(__file__).with_name("memory_weights.json")

# Draws come in pairs of opposite sign, so that exchanging two models turns an interval about exactly.
_PAIRS = 2048


@dataclass(frozen=True, slots=True)
class Memories:
    """All memories (m,) at ``terms`` cosine terms: normal distributions of the mean and the terms, up to a scale.

    ``whiten`` (m, terms, terms) makes the terms independent, ``log_det`` (m,) is the logarithm of its determinant;
    ``slope`` (m, terms) and ``variance`` (m,) give mean and variance of the sequence's mean once the terms are known;
    ``power`` (m,) is that of the mean and of the terms together.
    """

    whiten: FloatArray
    log_det: FloatArray
    slope: FloatArray
    variance: FloatArray
    power: FloatArray


@cache
def memories(terms: int = TERMS) -> Memories:
    """All combinations of :data:`WHITE_SHARES` and :data:`RATES`, the latter running fastest."""
    parts = []
    for share in WHITE_SHARES:
        for rate in RATES:
            covariance = (1.0 - share) * 0.5 * rate * _exponential(rate, terms) + share * np.eye(terms + 1)
            whiten = np.linalg.inv(np.linalg.cholesky(covariance[1:, 1:]))
            slope = whiten.T @ (whiten @ covariance[0, 1:])
            variance = covariance[0, 0] - covariance[0, 1:] @ slope
            parts.append((whiten, np.log(np.diag(whiten)).sum(), slope, variance, np.trace(covariance)))
    return Memories(*(np.array(column) for column in zip(*parts, strict=True)))


def _exponential(rate: float, terms: int) -> FloatArray:
    """Covariance (terms + 1, terms + 1) of the cosine terms of exp(-rate |s - t|) on the unit interval."""
    order = np.arange(terms + 1)
    sign = np.where(order % 2 == 0, 1.0, -1.0)
    pole = rate**2 + (np.pi * order) ** 2
    ends = (1.0 + np.outer(sign, sign)) * rate**2 * (1.0 - sign * np.exp(-rate)) / np.outer(pole, pole)
    scale = np.where(order == 0, 1.0, np.sqrt(2.0))
    return np.asarray((np.diag(rate * np.where(order == 0, 2.0, 1.0) / pole) - ends) * np.outer(scale, scale))


@cache
def weights(kind: Kind) -> FloatArray:
    """Weight (m,) of each memory before any sample is seen."""
    tenths = json.loads(_TENTHS.read_text(encoding="utf-8"))[kind]
    drawn = np.exp(0.1 * np.array(tenths, dtype=np.float64).ravel())
    return np.asarray(drawn / drawn.sum())


@dataclass(frozen=True, slots=True)
class Terms:
    """Cosine terms of a sequence: the slow ones (q,), and power, degrees of freedom of the fast ones and of all."""

    slow: FloatArray
    fast_power: float
    fast_freedom: float
    freedom: float


def cosine_terms(values: FloatArray) -> Terms:
    """Cosine terms, scaled so that their squares add up to the mean square about the mean."""
    from scipy.fft import dct

    n = len(values)
    every = dct(values - values.mean(), norm="ortho")[1:] / np.sqrt(n)
    count = min(TERMS, (n - 1) // 2)
    squares = every * every
    fast = squares[count:]

    def freedom(power: FloatArray) -> float:
        return float(max(3.0 * power.sum() ** 2 / np.maximum((power * power).sum(), 1e-300), 1.0))

    return Terms(every[:count], float(fast.sum()), freedom(fast), freedom(squares))


def likelihoods(slow: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Likelihood (..., m) of each memory, its scale integrated out, and the whitened sum of squares (..., m)."""
    known = memories(slow.shape[-1])
    square = np.square(np.einsum("mij,...j->...mi", known.whiten, slow)).sum(axis=-1)
    log = known.log_det - 0.5 * slow.shape[-1] * np.log(np.maximum(square, 1e-300))
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


def _picked(slow: FloatArray, kind: Kind) -> tuple[IntArray, FloatArray]:
    """Memory (draws,) and squared scale (draws,) of each draw."""
    likelihood, square = likelihoods(slow)
    running = np.cumsum(likelihood * weights(kind))
    uniform, chi_squared, *_ = _random(len(slow))
    index = np.minimum(np.searchsorted(running, uniform * running[-1]), len(running) - 1)
    return index, square[index] / chi_squared


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
    index, scale = _picked(slow, kind)
    centre = -(known.slope[index] @ slow)
    reach = np.sqrt(scale * known.variance[index]) * _random(len(slow))[2]
    return np.asarray(np.concatenate([centre + reach, centre - reach]))


def power_draws(values: FloatArray) -> FloatArray:
    """Draws of the mean square of the process about its own mean, in the order of :func:`mean_draws`.

    Parameters
    ----------
    values : (n,)
        In time order, at least :data:`FEWEST`. Tails heavier than normal widen the draws.
    """
    deviation = values - values.mean()
    mean_square = float(np.mean(deviation * deviation))
    if mean_square == 0.0:
        return np.zeros(2 * _PAIRS)
    terms = cosine_terms(values)
    index, scale = _picked(terms.slow, "power")
    *_, normal, second_normal = _random(len(terms.slow))
    third = 2.0 / (9.0 * terms.fast_freedom)
    # chi-squared over its degrees of freedom, after Wilson and Hilferty (1931)
    fast = terms.fast_power / np.maximum(1.0 - third + np.sqrt(third) * second_normal, 0.05) ** 3
    # a short normal sequence shows heavy tails by chance: only what is beyond counts
    excess = max(float(np.mean(deviation**4)) / mean_square**2 - 3.0 - np.sqrt(24.0 / terms.freedom), 0.0)
    tails = np.exp(np.sqrt(excess / terms.freedom) * normal)
    return np.tile((scale * memories(len(terms.slow)).power[index] + fast) * tails, 2)
