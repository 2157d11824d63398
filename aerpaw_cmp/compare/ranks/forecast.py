"""Forecasts of rank: a probability for each rank, and what they are worth against the reports of a modem.

A probability forecast is judged by a proper score (nobody gains by saying what he does not believe), the log score,
beside that of a constant forecast, the histogram of the training flights. Kappa and agreement judge the one rank that
a decision makes of the probabilities, beside what always saying the commonest rank agrees.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ...common.units import FloatArray, IntArray, unmasked
from ..rank import MAX_RANK, cohen_kappa, kappa_of_means, one_hot, total_variation, variation_of_means
from ..statistics.intervals import NO_INTERVAL, REPLICATES, Interval, autocorrelation, bootstrap_means, interval

# What a rank counts in the log score that a forecast held impossible.
_LEAST_PROBABILITY = 1e-6


def log_losses(probability: FloatArray, rank: IntArray) -> FloatArray:
    """Logarithmic score of each sample [nat]: ``-ln p(reported rank)``; smaller is better.

    Parameters
    ----------
    probability : (n, ranks)
        Of rank 1 .. ranks; rows sum to one.
    rank : (n,)
        Reported.

    Notes
    -----
    Good (1952), doi:10.1111/j.2517-6161.1952.tb00104.x. Probabilities below :data:`_LEAST_PROBABILITY` count as that.

    Examples
    --------
    >>> log_losses(np.array([[0.5, 0.5]]), np.array([2])).round(4).tolist()
    [0.6931]
    """
    return np.asarray(-np.log(np.maximum(probability[np.arange(len(rank)), rank - 1], _LEAST_PROBABILITY)))


def brier_losses(probability: FloatArray, rank: IntArray) -> FloatArray:
    """Brier score of each sample: ``sum_r (p_r - [r = rank])^2``, 0 to 2; smaller is better.

    Notes
    -----
    Brier (1950), doi:10.1175/1520-0493(1950)078<0001:VOFEIT>2.0.CO;2.

    Examples
    --------
    >>> brier_losses(np.array([[0.5, 0.5]]), np.array([2])).tolist()
    [0.5]
    """
    return np.asarray(((probability - one_hot(rank, probability.shape[1])) ** 2).sum(axis=1))


def constant_forecast(rank: ArrayLike, ranks: int = MAX_RANK) -> FloatArray:
    """Histogram of training ranks (ranks,), each rank counted once more, so that none is impossible."""
    values = unmasked(rank)
    count = np.bincount(values[values >= 1].astype(np.int64), minlength=ranks + 1)[1:] + 1.0
    return np.asarray(count / count.sum())


@dataclass(frozen=True, slots=True, kw_only=True)
class ForecastScore:
    """Score of a forecast on samples that had no part in its fit.

    Parameters
    ----------
    n : int
        Samples with a report and a forecast.
    kappa, agreement : float
        Of the decided rank.
    majority_agreement : float
        Agreement of always saying the commonest rank of these samples (known only afterwards).
    log_score, constant_log_score : float
        Mean of :func:`log_losses` [nat], of the forecast and of the constant one.
    log_score_gain : float
        Share by which the forecast is below the constant one.
    log_score_difference_ci95 : (low, high)
        Of forecast minus constant [nat], on the same samples.
    total_variation_expected : float
        Between the mean probabilities and the measured histogram.
    kappa_ci95, log_score_ci95, total_variation_ci95 : (low, high)
    """

    n: int
    kappa: float = np.nan
    kappa_ci95: Interval = NO_INTERVAL
    agreement: float = np.nan
    majority_agreement: float = np.nan
    log_score: float = np.nan
    log_score_ci95: Interval = NO_INTERVAL
    constant_log_score: float = np.nan
    log_score_gain: float = np.nan
    log_score_difference_ci95: Interval = NO_INTERVAL
    total_variation_expected: float = np.nan
    total_variation_ci95: Interval = NO_INTERVAL


def score_forecast(
    measured: ArrayLike,
    probability: FloatArray,
    decided: ArrayLike,
    constant: FloatArray,
    *,
    replicates: int = REPLICATES,
) -> ForecastScore:
    """Score a forecast on samples in time order.

    Parameters
    ----------
    measured : array_like, (n,)
        Reported rank, NaN where none.
    probability : (n, ranks)
        NaN where there is no forecast.
    decided : array_like, (n,)
        The one rank said; 0 where there is no forecast.
    constant : (ranks,)
        The constant forecast, from the flights of the fit (:func:`constant_forecast`).
    replicates : int
        Block bootstrap.

    Returns
    -------
    ForecastScore
        All NaN where no sample has both.
    """
    ri, decision = unmasked(measured).ravel(), unmasked(decided).ravel()
    counts = (ri >= 1) & (decision >= 1) & np.isfinite(probability).all(axis=1)
    rank, choice, p = ri[counts].astype(np.int64), decision[counts].astype(np.int64), probability[counts]
    if not len(rank):
        return ForecastScore(n=0)
    flat = np.broadcast_to(constant, p.shape)
    reported, chosen = one_hot(rank), one_hot(choice)
    log, log_constant = log_losses(p, rank), log_losses(flat, rank)
    columns = np.column_stack([log, log - log_constant, p, rank == choice, reported, chosen]).astype(np.float64)
    pair_columns = columns[:, -1 - 2 * MAX_RANK :]  # agreement and the two ranks, as kappa takes them
    # one set of resamples serves all numbers: the longest memory is safe for each
    memory = max((autocorrelation(c) for c in (pair_columns[:, 0], *columns[:, :2].T)), key=lambda m: m.block_length)
    drawn = bootstrap_means(columns, memory.block_length, replicates=replicates)
    drawn_p, drawn_pair = drawn[:, 2 : 2 + MAX_RANK], drawn[:, 2 + MAX_RANK :]
    mean = columns.mean(axis=0)
    expected, share = mean[2 : 2 + MAX_RANK], pair_columns.mean(axis=0)[1 : 1 + MAX_RANK]
    kappa = cohen_kappa(rank, choice)
    spread = total_variation(share, expected)
    varied = variation_of_means(np.column_stack([drawn_pair[:, : 1 + MAX_RANK], drawn_p]))
    return ForecastScore(
        n=len(rank),
        kappa=kappa,
        kappa_ci95=interval(kappa, kappa_of_means(drawn_pair), memory, bounds=(-1.0, 1.0)),
        agreement=float(np.mean(rank == choice)),
        majority_agreement=float(share.max()),
        log_score=float(mean[0]),
        log_score_ci95=interval(float(mean[0]), drawn[:, 0], memory, bounds=(0.0, np.inf)),
        constant_log_score=float(log_constant.mean()),
        log_score_gain=float(1.0 - mean[0] / log_constant.mean()),
        log_score_difference_ci95=interval(float(mean[1]), drawn[:, 1], memory),
        total_variation_expected=spread,
        total_variation_ci95=interval(spread, varied, memory, bounds=(0.0, 1.0)),
    )
