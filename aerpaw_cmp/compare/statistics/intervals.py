"""Uncertainty of numbers that come from neighbouring samples of one flight.

Samples a tenth of a second apart repeat each other. Intervals of errors of levels (offset, RMSE, correlation, two
models in pairs) integrate over how long they do (:mod:`.memory`). Those of ranks rest on blocks: the flight is cut
into blocks as long as the sequence remembers (Politis and White), blocks are drawn with replacement, and the spread of
the statistic over the draws, corrected for the finite number of blocks, gives the interval.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from ...common.units import FloatArray, Printed, unmasked
from .memory import FEWEST, mean_draws, power_draws

# Bootstrap replicates.
REPLICATES = 1000

# One seed feeds all resampling: the same logs give the same intervals.
SEED = 20_250_210

# Blocks are twice Politis and White's length: that one minimises the error of the variance, not of the coverage
# (on 500 simulated flights it brings 89-93 % to 92-95 % where a flight holds only 25 independent samples).
_LONGER = 2.0

# Lags in a row: Politis and White's max(5, sqrt(log10 n)) is 5 for any flight.
_RUN = 5

# Fewer independent samples than this give no interval: how long such a sequence remembers cannot be told from it.
_FEWEST_INDEPENDENT = 10.0

# The variance is widened by this over the independent samples, for what the estimate of the memory leaves open (chosen
# on simulated flights).
_UNSURE = 3.0

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
    variance_factor : float
        What the variance of a block bootstrap of that length must be multiplied with (first-order bias).
    """

    n: int
    block_length: int
    n_effective: float
    variance_factor: float

    @property
    def half_width(self) -> float:
        """Half width of a 95 % interval per bootstrap standard deviation.

        Student's t for few blocks, the block variance's first-order bias, and the uncertainty of the memory itself.
        """
        from scipy.special import stdtrit  # scipy.stats would load for 0.2 s what one quantile needs

        blocks = max(self.n / max(self.block_length, 1), 2.0)
        unsure = 1.0 + _UNSURE / self.n_effective if self.n_effective > 0 else 1.0
        return float(stdtrit(blocks - 1.0, 0.975) * np.sqrt(unsure * self.variance_factor * blocks / (blocks - 1.0)))

    @property
    def enough(self) -> bool:
        """True if an interval can be given at all: at least :data:`_FEWEST_INDEPENDENT` independent samples."""
        return bool(self.n_effective >= _FEWEST_INDEPENDENT)


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


def _exponential(covariance: FloatArray, n: int) -> tuple[float, float]:
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
    """Block length and effective sample size of a sequence.

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
        return Autocorrelation(n, 1 if n else 0, float(n) if n > 1 else float("nan"), 1.0)
    lags = n // 2
    unbiased = autocovariance(x, lags) * n / (n - np.arange(lags + 1))
    hidden, long_run, reach = 0.0, float(unbiased[0]), 0.0
    for _ in range(12):
        covariance = unbiased + hidden
        by_window, width, window_reach = _flat_top(covariance, n)
        by_decay, decay_reach = _exponential(covariance, n)
        # the window's own sum holds the hidden part width / n times over
        # a window nearly as long as the flight (infinite) says that it is worth one sample
        by_window = (by_window - width * hidden) / (1.0 - width / n) if width < 0.8 * n else np.inf
        long_run, reach = max(by_window, by_decay), max(window_reach, decay_reach)
        if long_run >= n * covariance[0]:
            return Autocorrelation(n, max(1, n // 5), 1.0, 2.0)
        if long_run <= 0.0:  # oscillating: the mean is known at least as well as from independent samples
            long_run = float(unbiased[0])
        if abs(long_run / n - hidden) < 1e-3 * unbiased[0]:
            break
        hidden = long_run / n
    slope = max(0.0, 2.0 * reach / long_run)
    length = _LONGER * (1.5 * slope**2 * n) ** (1.0 / 3.0)
    # five blocks at least: of fewer the draws repeat each other
    block = int(np.clip(np.ceil(length), 1, max(1, n // 5)))
    factor = 1.0 / (1.0 - min(0.5, slope / block))
    return Autocorrelation(n, block, float(np.clip(n * (unbiased[0] + hidden) / long_run, 1.0, n)), factor)


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


def interval(
    estimate: float,
    replicates: FloatArray,
    known: Autocorrelation,
    *,
    bounds: tuple[float, float] = (-np.inf, np.inf),
) -> Interval:
    """95 % interval around an estimate from its bootstrap replicates.

    Parameters
    ----------
    estimate : float
        The statistic on the data.
    replicates : (r,)
        The statistic on the resamples; NaN replicates are left out.
    known : Autocorrelation
        Of the sequence that was resampled.
    bounds : (low, high)
        The statistic's range.

    Returns
    -------
    (low, high)
        NaN ("no interval") below :data:`_FEWEST_INDEPENDENT` independent samples. Where resampling biases the
        statistic (distances, RMSE), the same bias sits in the estimate and is taken off.
    """
    good = replicates[np.isfinite(replicates)]
    if not known.enough or not np.isfinite(estimate) or len(good) < 2:
        return NO_INTERVAL
    centre, reach = 2.0 * estimate - float(good.mean()), known.half_width * float(good.std(ddof=1))
    low, high = np.clip([centre - reach, centre + reach], *bounds)
    return float(min(low, estimate)), float(max(high, estimate))


@dataclass(frozen=True, slots=True)
class ErrorIntervals:
    """95 % intervals of one measured and simulated sequence of levels.

    Parameters
    ----------
    offset_db, rmse_db, correlation : (low, high)
        NaN ("no interval") of fewer than :data:`~aerpaw_cmp.compare.statistics.memory.FEWEST` samples, or where the
        statistic does not exist.
    autocorrelation : Autocorrelation
        Of the residual.
    """

    offset_db: Interval
    rmse_db: Interval
    correlation: Interval
    autocorrelation: Autocorrelation


def error_intervals(measured_db: FloatArray, simulated_db: FloatArray) -> ErrorIntervals:
    """Intervals of offset (mean difference), RMSE about it and correlation of the process behind a flight.

    Parameters
    ----------
    measured_db, simulated_db : (n,)
        Pairs in time order, without NaN [dB].

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
        mean_interval(difference),
        spread_interval(difference),
        _correlation_interval(measured_db, simulated_db),
        known,
    )


def _correlation_interval(measured_db: FloatArray, simulated_db: FloatArray) -> Interval:
    """The route was flown as it was: only slope and rest of the measurement over the simulation are random."""
    s, m = simulated_db - simulated_db.mean(), measured_db - measured_db.mean()
    spread = float(s @ s) / len(s)
    if spread == 0.0 or not m.any():
        return NO_INTERVAL
    slope = float(m @ s) / len(s) / spread
    residual = m - slope * s
    along = (slope + mean_draws(residual * s) / spread) * np.sqrt(spread)
    return _around(correlation(measured_db, simulated_db), along / np.sqrt(along**2 + power_draws(residual)))


def mean_interval(values: FloatArray) -> Interval:
    """95 % interval of the mean of the process that a sequence (n,) in time order comes from."""
    if len(values) < FEWEST:
        return NO_INTERVAL
    mean = float(values.mean())
    return _around(mean, mean + mean_draws(values))


def spread_interval(values: FloatArray) -> Interval:
    """95 % interval of the standard deviation that sequences such as this one (n,), in time order, have on average.

    Wider than :data:`_BOUND` times the value, it is given as a bound: its upper end is infinite.
    """
    if len(values) < FEWEST:
        return NO_INTERVAL
    low, high = _around(float(values.std()), np.sqrt(power_draws(values)))
    return low, np.inf if high - low > _BOUND * values.std() else high


def rmse_interval(residual: FloatArray, rmse: float) -> Interval:
    """95 % interval of the root mean square of residuals (n,) in time order, whose value is ``rmse``.

    An offset from a grid, at the edge of its span or beside a floor leaves a mean, which moves both ends as it moves
    the RMSE.
    """
    if len(residual) < FEWEST:
        return NO_INTERVAL
    low, high = np.hypot(spread_interval(residual), residual.mean())
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


def paired_difference(error_db: ArrayLike, other_error_db: ArrayLike, *, free_offset: bool = True) -> PairedDifference:
    """Compare two models on the same samples by the difference of their mean square errors.

    Parameters
    ----------
    error_db, other_error_db : array_like, (n,)
        Measured minus predicted, in time order [dB]; samples with a NaN on either side take no part.
    free_offset : bool
        Each model has an offset of its own fitted on these samples (an error counts about its mean). False for errors
        on samples kept out of the fit: they count as they are.

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
        drawn = square - other_square + mean_draws(undecided(first, second), "ratio")
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
    channels: Sequence[tuple[FloatArray, FloatArray, FloatArray]], *, free_offset: bool = True
) -> PairedDifference:
    """Two models over all channels of a flight at once.

    Parameters
    ----------
    channels : sequence of ((n,), (n,), (n,))
        Per channel: instants, and the errors of the two models at them [dB]. NaN takes no part.
    free_offset : bool
        Each channel and model has an own offset.

    Returns
    -------
    PairedDifference
        Of the root mean square errors over all samples. Samples of one time stand together whatever their channel, so
        that fading which the channels share counts as shared.
    """
    parts = []
    for time, error, other in channels:
        finite = np.isfinite(error) & np.isfinite(other)
        if finite.any():
            columns = (values[finite] - free_offset * values[finite].mean() for values in (error, other))
            parts.append((np.asarray(time)[finite], *columns))
    if not parts:
        return paired_difference([], [])
    time, first, second = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.argsort(time, kind="stable")
    return paired_difference(first[order], second[order], free_offset=False)


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


def share_interval(share: float, spread: float, known: Autocorrelation) -> Interval:
    """95 % interval of a share (a histogram bar): Wilson's, with as many samples as the spread is worth.

    Parameters
    ----------
    share : float
        0 to 1.
    spread : float
        Bootstrap standard deviation of the share.
    known : Autocorrelation
        Of the sequence.

    Notes
    -----
    Wilson's interval stays sensible at shares of 0 and 1, where a bootstrap has no spread at all; there the
    effective size of the whole sequence counts. Wilson (1927), doi:10.1080/01621459.1927.10502953.
    """
    if not known.enough or not np.isfinite(share):
        return NO_INTERVAL
    # 1.96: the 97.5 % point of the normal distribution, which Wilson's interval takes
    variance = spread**2 * known.half_width**2 / 1.959964**2
    size = known.n_effective if variance <= 0 else share * (1 - share) / variance
    size = float(np.clip(size, 1.0, known.n))
    z2 = 1.959964**2
    centre = (share + z2 / (2 * size)) / (1 + z2 / size)
    reach = np.sqrt(z2 * (share * (1 - share) / size + z2 / (4 * size**2))) / (1 + z2 / size)
    low, high = float(centre - reach), float(centre + reach)
    return (0.0 if share == 0.0 else max(0.0, low)), (1.0 if share == 1.0 else min(1.0, high))
