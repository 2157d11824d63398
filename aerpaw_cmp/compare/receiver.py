"""Forecasts of the rank that a receiver reports, and decisions from these forecasts, learned from flights.

A forecast contains a probability for each rank. A forecast is scored by the log score, which is a proper score, and
compared with the constant forecast (the histogram of the training flights). The rank that is decided from the
probabilities is scored by kappa and agreement. The decided rank is compared with the most frequent rank.

A receiver chooses the rank with the largest throughput at its noise level. Logs contain neither its codebook nor its
channel estimate. The module therefore learns how often each rank is reported, given the level and the ratios of
singular values of the modelled channel. The model is a multinomial logistic regression with a ridge penalty. Simpler
rules for comparison are one threshold per stream, and an ordered regression (one linear score, and one limit between
neighbouring ranks).

The antenna geometry of the modelled channel is chosen by the log score on held-out sectors of the training flights
(:func:`choose_features`), and never by the scored flight.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..common.errors import InputError
from ..common.geodesy import azimuth_rad
from ..common.text import counted
from ..common.units import FloatArray, IntArray, unmasked
from .rank import MAX_RANK, cohen_kappa, kappa_influence, one_hot, total_variation
from .statistics import NO_INTERVAL, Interval, influence_interval

# Smallest probability of a reported rank that the log score uses.
_LEAST_PROBABILITY = 1e-6


def log_losses(probability: FloatArray, rank: IntArray) -> FloatArray:
    """Return the logarithmic score of each sample [nat], ``-ln p(reported rank)``.

    Parameters
    ----------
    probability : (n, ranks)
        Probability of each rank, with rows that sum to one.
    rank : (n,)
        Reported rank of each sample.

    Notes
    -----
    Good (1952), doi:10.1111/j.2517-6161.1952.tb00104.x. Probabilities below :data:`_LEAST_PROBABILITY` are raised to
    it.

    Examples
    --------
    >>> log_losses(np.array([[0.5, 0.5]]), np.array([2])).round(4).tolist()
    [0.6931]
    """
    return np.asarray(-np.log(np.maximum(probability[np.arange(len(rank)), rank - 1], _LEAST_PROBABILITY)))


def brier_losses(probability: FloatArray, rank: IntArray) -> FloatArray:
    """Return the Brier score of each sample, ``sum_r (p_r - [r = rank])^2``, from 0 to 2.

    Notes
    -----
    Brier (1950), doi:10.1175/1520-0493(1950)078<0001:VOFEIT>2.0.CO;2.

    Examples
    --------
    >>> brier_losses(np.array([[0.5, 0.5]]), np.array([2])).tolist()
    [0.5]
    """
    return np.asarray(((probability - one_hot(rank, probability.shape[1])) ** 2).sum(axis=1))


def constant_forecast(rank: ArrayLike) -> FloatArray:
    """Return the histogram of training ranks (MAX_RANK,). One sample is added per rank, so no share is 0."""
    values = unmasked(rank)
    count = np.bincount(values[values >= 1].astype(np.int64), minlength=MAX_RANK + 1)[1:] + 1.0
    return np.asarray(count / count.sum())


@dataclass(frozen=True, slots=True, kw_only=True)
class ForecastScore:
    """The score of a forecast on samples that were not fitted.

    Parameters
    ----------
    n : int
        Number of samples with a report and a forecast.
    kappa, agreement : float
        Scores of the decided rank.
    majority_agreement : float
        Agreement if the most frequent rank of these samples were always predicted. A forecast cannot know this rank.
    log_score, constant_log_score : float
        Means of :func:`log_losses` for the forecast and for the constant forecast [nat].
    log_score_gain : float
        Share by which the log score of the forecast is lower than that of the constant forecast.
    log_score_difference_ci95 : (low, high)
        95 % interval of the difference of the two log scores, forecast minus constant forecast, on the same samples
        [nat].
    total_variation_expected : float
        Total variation distance between mean probabilities and measured histogram.
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
) -> ForecastScore:
    """Score a forecast on samples in time order.

    Parameters
    ----------
    measured : array_like, (n,)
        Reported rank, NaN if missing.
    probability : (n, ranks)
        Forecast; NaN if there is none.
    decided : array_like, (n,)
        Predicted rank; 0 if there is no forecast.
    constant : (ranks,)
        The constant forecast of the training flights (:func:`constant_forecast`).

    Returns
    -------
    ForecastScore
        All values are NaN if no sample has both a report and a forecast.
    """
    ri, decision = unmasked(measured).ravel(), unmasked(decided).ravel()
    counts = (ri >= 1) & (decision >= 1) & np.isfinite(probability).all(axis=1)
    rank, choice, p = ri[counts].astype(np.int64), decision[counts].astype(np.int64), probability[counts]
    if not len(rank):
        return ForecastScore(n=0)
    flat = np.broadcast_to(constant, p.shape)
    log, log_constant = log_losses(p, rank), log_losses(flat, rank)
    reported, expected = one_hot(rank), p.mean(axis=0)
    share = reported.mean(axis=0)
    kappa, spread = cohen_kappa(rank, choice), total_variation(share, expected)
    varied = 0.5 * (reported - p) @ np.sign(share - expected)
    return ForecastScore(
        n=len(rank),
        kappa=kappa,
        kappa_ci95=influence_interval(kappa, kappa_influence(rank, choice), bounds=(-1.0, 1.0)),
        agreement=float(np.mean(rank == choice)),
        majority_agreement=float(share.max()),
        log_score=float(log.mean()),
        log_score_ci95=influence_interval(float(log.mean()), log, bounds=(0.0, np.inf)),
        constant_log_score=float(log_constant.mean()),
        log_score_gain=float(1.0 - log.mean() / log_constant.mean()),
        log_score_difference_ci95=influence_interval(float(np.mean(log - log_constant)), log - log_constant),
        total_variation_expected=spread,
        total_variation_ci95=influence_interval(spread, varied, bounds=(0.0, 1.0)),
    )


# Smallest ratio of singular values. Smaller ratios are raised to this limit, because no receiver uses a stream with
# such a ratio.
FLOOR_DB = -40.0

# Candidate ridge penalties on coefficients of standardised features, relative to the log likelihood of the whole
# flight.
_PENALTIES = (1.0, 3.0, 10.0, 30.0, 100.0)

# Ridge penalty while geometries are chosen.
_CHOICE_PENALTY = 10.0

# Smallest number of training samples for a fit.
FEWEST = 50

# Number of values in one batch of regressions. The number limits the memory to about 100 MiB.
_HELD = 1 << 22


def stream_features(sigma: ArrayLike) -> FloatArray:
    """Return the features of a channel on which a decision may depend: ratios of singular values, and level.

    Parameters
    ----------
    sigma : array_like, (..., m)
        Singular values in descending order, with their absolute size (not scaled per matrix).

    Returns
    -------
    ndarray, (..., m)
        ``20 log10 (sigma_i / sigma_1)`` [dB] for i = 2 .. m, not below :data:`FLOOR_DB`, then ``20 log10 sigma_1``
        [dB]. NaN without a channel.

    Examples
    --------
    >>> stream_features([1.0, 0.1, 0.0]).tolist()
    [-20.0, -40.0, 0.0]
    """
    values = unmasked(sigma)
    largest = values[..., :1]
    alive = (largest > 0) & np.isfinite(largest)
    safe = np.where(alive, largest, 1.0)
    ratio = np.maximum(values[..., 1:] / safe, 10.0 ** (FLOOR_DB / 20.0))
    features = 20.0 * np.log10(np.concatenate([np.where(alive, ratio, 1.0), safe], axis=-1))
    return np.asarray(np.where(alive, features, np.nan))


def time_means(power: FloatArray, time_s: FloatArray, shift_s: float, average_s: float) -> FloatArray:
    """Return the means of squared singular values over a window around each sample, shifted in time.

    Parameters
    ----------
    power : (..., n, m)
        Squares of singular values.
    time_s : (n,)
        Times of the samples in any order [s].
    shift_s : float
        Positive if the report belongs to a later position than in the log [s].
    average_s : float
        Length of the window [s]. With 0, the nearest sample in time is used.

    Returns
    -------
    (..., n, m)
        Means. If the window contains no sample (in a gap or at the end of the log), the nearest sample in time is used.

    Notes
    -----
    A receiver uses a channel estimate that is seconds old. The network schedules the rank that was reported before, and
    the positions of a handset are also late. A log does not separate these delays. Fast ripple of the modelled channel
    within these seconds does not affect a report.

    Examples
    --------
    >>> time_means(np.array([[1.0], [2.0], [6.0]]), np.array([0.0, 1.0, 2.0]), 1.0, 2.0).ravel().tolist()
    [3.0, 4.0, 6.0]
    """
    order = np.argsort(time_s, kind="stable")
    time, centre = time_s[order], time_s + shift_s
    # with a margin, so that a sample at an end of the window counts regardless of rounding
    low = np.searchsorted(time, centre - 0.5 * average_s - 1e-9)
    high = np.searchsorted(time, centre + 0.5 * average_s + 1e-9, side="right")
    after = np.searchsorted(time, centre).clip(0, len(time) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(np.abs(time[before] - centre) < np.abs(time[after] - centre), before, after)
    empty = high <= low
    low, high = np.where(empty, nearest, low), np.where(empty, nearest + 1, high)
    sums = np.zeros((*power.shape[:-2], len(time) + 1, power.shape[-1]))
    np.cumsum(power[..., order, :], axis=-2, out=sums[..., 1:, :])
    return np.asarray((sums[..., high, :] - sums[..., low, :]) / (high - low)[:, None])


def sector_groups(position_m: FloatArray, tower_m: FloatArray) -> IntArray:
    """Return the eighth of azimuths from the tower for each sample (n,), with about equal numbers of samples.

    A held-out sector contains directions that were not used in the fit. Samples that are neighbours in time are mostly
    in the same sector.
    """
    # start at the largest gap between directions, so that the start does not split a cluster of samples
    azimuth = azimuth_rad(position_m[:, :2] - np.asarray(tower_m)[:2])
    order = np.sort(azimuth)
    gap = np.diff(np.append(order, order[0] + 2.0 * np.pi))
    turned = (azimuth - order[(np.argmax(gap) + 1) % len(order)]) % (2.0 * np.pi)
    ends = np.quantile(turned, np.arange(1, 8) / 8)
    return np.asarray(np.searchsorted(ends, turned, side="right"), dtype=np.int64)


@dataclass(frozen=True, slots=True, kw_only=True)
class Receiver:
    """A fitted multinomial regression of the rank.

    Parameters
    ----------
    coefficient : (ranks, 1 + features)
        Coefficients per rank: a constant, then one per standardised feature.
    mean, scale : (features,)
        Mean and scale of the training features.
    penalty : float
        Ridge penalty.
    constant : (ranks,)
        Histogram of the training ranks: the constant forecast.
    n : int
        Number of training samples.
    """

    coefficient: FloatArray
    mean: FloatArray
    scale: FloatArray
    penalty: float
    constant: FloatArray
    n: int

    def probabilities(self, features: FloatArray) -> FloatArray:
        """Return the probability (n, ranks) of each rank at features (n, features), NaN if a feature is NaN."""
        return _softmax(_design((features - self.mean) / self.scale) @ self.coefficient.T)

    @classmethod
    def from_dict(cls, numbers: Mapping[str, Any]) -> Receiver:
        """Create a receiver from its fields in JSON.

        Raises
        ------
        ValueError
            If a field is missing, or the shapes of the fields do not agree.
        """
        names = ("coefficient", "mean", "scale", "constant")
        if missing := [name for name in (*names, "penalty", "n") if name not in numbers]:
            raise ValueError(f"a receiver without {', '.join(missing)}")
        arrays = {name: np.asarray(numbers[name], dtype=np.float64) for name in names}
        ranks, width = arrays["coefficient"].shape
        if arrays["mean"].shape != (width - 1,) or arrays["constant"].shape != (ranks,):
            raise ValueError(f"coefficients of {ranks} ranks and {width - 1} features do not fit the other parts")
        return cls(**arrays, penalty=float(numbers["penalty"]), n=int(numbers["n"]))


def decide(probability: FloatArray, weight: FloatArray) -> IntArray:
    """Return the rank (n,) of the largest ``probability * weight``, or 0 if the probabilities are NaN."""
    alive = np.asarray(np.isfinite(probability).all(axis=1))
    best = np.argmax(np.where(alive[:, None], probability, 0.0) * weight, axis=1) + 1
    return np.where(alive, best, 0).astype(np.int64)


def _fitted(x: FloatArray, rank: IntArray, penalty: float) -> Receiver:
    mean, scale = _standard(x)
    return Receiver(
        coefficient=_fit_multinomial((x - mean) / scale, rank, np.ones(len(rank)), penalty),
        mean=mean,
        scale=scale,
        penalty=penalty,
        constant=constant_forecast(rank),
        n=len(rank),
    )


def _training(features: FloatArray, rank: ArrayLike, groups: IntArray) -> tuple[FloatArray, IntArray, IntArray]:
    """Return features (geometries, n, features), ranks and groups of the samples with a rank and all features."""
    ri = unmasked(rank)
    good = np.asarray((ri >= 1) & np.isfinite(features).all(axis=(0, 2)))
    y = ri[good].astype(np.int64)
    if len(y) < FEWEST or np.ptp(y) == 0:
        what = f"{counted(len(y), 'sample')} with rank and channel" if len(y) < FEWEST else f"rank {y[0]} throughout"
        raise InputError(what, expected=f"at least {FEWEST} samples of at least two ranks to fit a receiver")
    if len(np.unique(groups[good])) < 2:
        raise InputError("all training samples are in one sector", expected="samples in at least two sectors")
    return features[:, good], y, groups[good]


def _standard(x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return mean and scale per feature. A constant feature has scale 1 and no effect."""
    # samples are on the second-last axis
    scale = x.std(axis=-2)
    return x.mean(axis=-2), np.asarray(np.where(scale > 1e-9, scale, 1.0))


def _standardised(x: FloatArray) -> FloatArray:
    mean, scale = _standard(x)
    return (x - mean[..., None, :]) / scale[..., None, :]


def _design(x: FloatArray) -> FloatArray:
    return np.concatenate([np.ones((*x.shape[:-1], 1)), x], axis=-1)


def _softmax(score: FloatArray) -> FloatArray:
    # subtract the largest score, because exp would otherwise overflow
    e = np.exp(score - _over_ranks(np.maximum, score)[..., None])
    return np.asarray(e / _over_ranks(np.add, e)[..., None])


def _over_ranks(operation: np.ufunc, values: FloatArray) -> FloatArray:
    """Return ``operation.reduce`` over the last axis. A loop over its few elements is ten times faster."""
    return np.asarray(reduce(operation, np.moveaxis(values, -1, 0)))


def out_of_group(x: FloatArray, rank: IntArray, groups: IntArray, penalty: float) -> FloatArray:
    """Return the forecast (..., n, ranks) of each group, from a regression on all other groups.

    Parameters
    ----------
    x : (..., n, features)
        Features. Leading axes contain different features of the same samples, which are fitted in one call.
    rank : (n,) int
        Rank, 1 to :data:`~aerpaw_cmp.compare.rank.MAX_RANK`.
    groups : (n,) int
        Group of each sample. Each group is held out once.
    penalty : float
        Weight of the squared coefficients (ridge).

    Returns
    -------
    (..., n, ranks)
        Probabilities; they sum to 1 over the last axis.
    """
    z = _standardised(x)
    result = np.empty((*z.shape[:-1], MAX_RANK))
    for group in np.unique(groups):
        out = groups == group
        weights = _fit_multinomial(z, rank, (~out).astype(np.float64), penalty)
        result[..., out, :] = _softmax(_design(z[..., out, :]) @ np.swapaxes(weights, -1, -2))
    return result


def _fit_multinomial(
    x: FloatArray, rank: IntArray, weight: FloatArray, penalty: float, *, steps: int = 30
) -> FloatArray:
    """Return the coefficients (..., ranks, 1 + features) that maximise the penalised log likelihood.

    The search uses damped Newton steps.

    Parameters
    ----------
    x : (..., n, features)
        Standardised features.
    weight : (n,)
        Weight of each sample, 0 or 1.
    penalty : float
        ``penalty / 2`` times the sum of squared slopes is subtracted from the log likelihood. The constants have a
        thousandth of this weight, which is enough to fix the shift that all constants have in common.

    Notes
    -----
    Hastie, Tibshirani, Friedman, The Elements of Statistical Learning, 2nd ed., section 4.4.
    """
    design = _design(x)
    lead, width = design.shape[:-2], design.shape[-1]
    target = one_hot(rank) * weight[:, None]
    ridge = np.full(width, penalty)
    ridge[0] = 1e-3 * penalty
    # add half a report, so that the constant is also finite for a rank without reports
    start = np.log((target.sum(axis=0) + 0.5) / (weight.sum() + 0.5 * MAX_RANK))
    coefficient = np.zeros((*lead, MAX_RANK, width))
    coefficient[..., 0] = start - start.mean()
    transposed = np.swapaxes(design, -1, -2)

    def objective(c: FloatArray) -> FloatArray:
        score = design @ np.swapaxes(c, -1, -2)
        top = _over_ranks(np.maximum, score)
        normal = top + np.log(_over_ranks(np.add, np.exp(score - top[..., None])))
        return np.asarray(
            (weight * normal).sum(axis=-1)
            - (target * score).sum(axis=(-1, -2))
            + 0.5 * (ridge * c**2).sum(axis=(-1, -2))
        )

    value = objective(coefficient)
    for _ in range(steps):
        p = _softmax(design @ np.swapaxes(coefficient, -1, -2))
        gradient = np.swapaxes(p * weight[:, None] - target, -1, -2) @ design + ridge * coefficient
        hessian = _hessian(design, transposed, p, weight, ridge)
        flat = gradient.reshape(*lead, MAX_RANK * width, 1)
        # pass a matrix with one column, because NumPy 2 would read a stack of vectors as one matrix
        step = np.linalg.solve(hessian, flat)[..., 0].reshape(coefficient.shape)
        damping = np.ones((*lead, 1, 1))
        for _halving in range(12):
            trial = objective(coefficient - damping * step)
            worse = trial > value + 1e-9
            if not np.any(worse):
                break
            damping = np.where(worse[..., None, None], 0.5 * damping, damping)
        coefficient = coefficient - damping * step
        value = objective(coefficient)
        if np.abs(damping * step).max() < 1e-7:
            break
    return coefficient


def _hessian(
    design: FloatArray, transposed: FloatArray, p: FloatArray, weight: FloatArray, ridge: FloatArray
) -> FloatArray:
    width = design.shape[-1]
    result = np.zeros((*design.shape[:-2], MAX_RANK * width, MAX_RANK * width))
    for a in range(MAX_RANK):
        for b in range(a, MAX_RANK):
            curvature = weight * p[..., a] * (float(a == b) - p[..., b])
            block = transposed @ (design * curvature[..., None])
            if a == b:
                block = block + np.diag(ridge)
            result[..., a * width : (a + 1) * width, b * width : (b + 1) * width] = block
            result[..., b * width : (b + 1) * width, a * width : (a + 1) * width] = block
    return result


def decision_weights(probability: FloatArray, rank: IntArray, groups: IntArray) -> FloatArray:
    """Return the decision weights (ranks,) that maximise kappa, or ones if kappa of held-out groups does not increase.

    Parameters
    ----------
    probability : (n, ranks)
        Forecasts of held-out groups.
    rank : (n,) int
    groups : (n,) int
        Group of each sample. Each group is decided with weights that were fitted to the other groups.
    """
    weighed, plain = np.zeros_like(rank), decide(probability, np.ones(MAX_RANK))
    for group in np.unique(groups):
        out = groups == group
        if np.ptp(rank[~out]) > 0:
            weighed[out] = decide(probability[out], _kappa_weights(probability[~out], rank[~out]))
        else:
            weighed[out] = plain[out]
    if cohen_kappa(rank, weighed) > np.nan_to_num(cohen_kappa(rank, plain)):
        return _kappa_weights(probability, rank)
    return np.ones(MAX_RANK)


def _kappa_weights(probability: FloatArray, rank: IntArray) -> FloatArray:
    """Return weights (ranks,) that maximise kappa: one weight below and one above the most frequent rank.

    Without weights, the most frequent rank would be decided too often, and kappa rewards rare ranks. The two weights
    are searched on a grid. Of weights with equal kappa, the weights nearest to 1 are used.
    """
    commonest = int(np.bincount(rank).argmax())
    # weights near 1 first, so that a weight farther away is used only if it is better
    exponents = sorted(np.arange(-3, 13) / 10.0, key=abs)
    best, weights = -np.inf, np.ones(MAX_RANK)
    ranks = np.arange(1, MAX_RANK + 1)
    for below in exponents:
        for above in exponents:
            weight = np.exp(np.where(ranks < commonest, below, np.where(ranks > commonest, above, 0.0)))
            kappa = cohen_kappa(rank, decide(probability, weight))
            if np.isfinite(kappa) and kappa > best + 1e-9:
                best, weights = kappa, weight
    return weights


@dataclass(frozen=True, slots=True, kw_only=True)
class ReceiverMixture:
    """The mean forecast of receivers of several geometries that the training flights cannot distinguish.

    Parameters
    ----------
    members : tuple of Receiver
        One receiver per geometry, best first.
    decision_weight : (ranks,)
        The decided rank has the largest product of mean probability and weight. With ones, it is the most probable
        rank. Other weights maximise kappa on held-out sectors of the training flights (:func:`decision_weights`).
    """

    members: tuple[Receiver, ...]
    decision_weight: FloatArray

    def probabilities(self, features: FloatArray) -> FloatArray:
        """Return the mean probability (n, ranks) at features (members, n, features)."""
        return np.asarray(
            np.mean([member.probabilities(x) for member, x in zip(self.members, features, strict=True)], axis=0)
        )

    def decide(self, probability: FloatArray) -> IntArray:
        """Return one rank (n,) per row of probabilities, or 0 for a row of NaN."""
        return decide(probability, self.decision_weight)


def fit_mixture(
    features: FloatArray, rank: ArrayLike, groups: IntArray, *, penalties: Sequence[float] = _PENALTIES
) -> ReceiverMixture:
    """Fit one receiver per geometry. Penalty and decision weights are chosen for the mean forecast.

    Parameters
    ----------
    features : (geometries, n, features)
        Features of each geometry, for example those of :attr:`FeatureChoice.tied`.
    rank : array_like, (n,)
        Reported rank. Samples without a rank (NaN, 0) or without features are ignored.
    groups : (n,) int
        Group of each sample, for example from :func:`sector_groups`. Each group is held out once.
    penalties : sequence of float
        Candidate penalties. The log loss on held-out groups selects one.

    Returns
    -------
    ReceiverMixture
        One receiver per geometry, in the order of ``features``, and their common decision weights.

    Raises
    ------
    InputError
        If there are fewer than :data:`FEWEST` samples, or only one rank.
    """
    x, y, group = _training(features, rank, groups)
    means = [np.mean([out_of_group(item, y, group, penalty) for item in x], axis=0) for penalty in penalties]
    best = int(np.argmin([log_losses(p, y).mean() for p in means]))
    return ReceiverMixture(
        members=tuple(_fitted(item, y, float(penalties[best])) for item in x),
        decision_weight=decision_weights(means[best], y, group),
    )


# --- which geometry -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class FeatureChoice:
    """The modelled channels that explain the training ranks best.

    Parameters
    ----------
    order : (tried,) int
        Candidates that were cross-validated, best first.
    tied : tuple of int
        Candidates that are not significantly worse than the best: the 95 % interval of the difference of log scores on
        the same samples contains 0. The best candidate comes first.
    """

    order: IntArray
    tied: tuple[int, ...]


def choose_features(
    features: FloatArray,
    rank: ArrayLike,
    groups: IntArray,
    *,
    finalists: int = 60,
) -> FeatureChoice:
    """Choose between candidate geometries by their log score on held-out groups of the training flights.

    Parameters
    ----------
    features : (candidates, n, features)
        Features of each candidate at the same samples.
    rank : array_like, (n,)
    groups : (n,) int
        Group of each sample. Each group is held out once.
    finalists : int
        Number of candidates that are cross-validated: the ones with the highest likelihood on the training samples. The
        likelihood is a fair criterion, because all candidates have the same number of coefficients. A fit takes only a
        tenth of the time of a cross-validation.

    Returns
    -------
    FeatureChoice
        Finalists by log score, and candidates that are not significantly worse than the best.

    Raises
    ------
    InputError
        As :func:`fit_mixture`.
    """
    x, y, group = _training(features, rank, groups)
    step = max(1, _HELD // (x.shape[1] * (x.shape[2] + 1) * MAX_RANK))
    rough = np.concatenate([_own_losses(x[i : i + step], y) for i in range(0, len(x), step)])
    # round to nine digits, so that equivalent candidates (mounts half a turn apart) keep their order despite rounding
    final = np.argsort(np.round(rough, 9), kind="stable")[:finalists]
    held_out = (out_of_group(x[final[i : i + step]], y, group, _CHOICE_PENALTY) for i in range(0, len(final), step))
    losses = np.array([log_losses(probability, y) for part in held_out for probability in part])
    rows = np.argsort(np.round(losses.mean(axis=1), 9), kind="stable")
    tied = tuple(int(final[r]) for r in rows if _not_worse(losses[r] - losses[rows[0]]))
    return FeatureChoice(order=final[rows], tied=tied)


def mixture_loss(features: FloatArray, rank: ArrayLike, groups: IntArray) -> float:
    """Return the log score of the mean forecast of several geometries on held-out groups.

    Parameters
    ----------
    features : (geometries, n, features)
    rank, groups : (n,)
        As :func:`fit_mixture`.

    Returns
    -------
    float
        Log score [nat].
    """
    x, y, group = _training(features, rank, groups)
    return float(log_losses(out_of_group(x, y, group, _CHOICE_PENALTY).mean(axis=0), y).mean())


def _own_losses(x: FloatArray, rank: IntArray) -> FloatArray:
    z = _standardised(x)
    # a few steps suffice, because a rough likelihood is enough to exclude bad candidates
    weights = _fit_multinomial(z, rank, np.ones(len(rank)), _CHOICE_PENALTY, steps=6)
    p = _softmax(_design(z) @ np.swapaxes(weights, -1, -2))
    return np.array([log_losses(item, rank).mean() for item in p])


def _not_worse(difference: FloatArray) -> bool:
    # equivalent candidates differ only by rounding
    if np.abs(difference).max() < 1e-9:
        return True
    return not influence_interval(float(difference.mean()), difference)[0] > 0.0
