"""The rank of a channel, and the comparison of two sequences of ranks.

The rank is the number of singular values strictly above ``sigma_1 / K``. Rank 0 means that there is no channel. The
measured RI is a float: NaN if the modem reported no CSI, and never 0.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from ..common.units import BoolArray, FloatArray, IntArray, unmasked
from . import statistics

# Largest rank in histograms. The modems of AERPAW report RI 1 to 4.
MAX_RANK = 4

# Number of matrix entries per SVD batch. The number limits the memory that is used.
_CHUNK = 1 << 20


def singular_values(h: ArrayLike) -> FloatArray:
    """Return the singular values of every channel matrix.

    Source: arXiv 2502.10324 eq. 2.

    Parameters
    ----------
    h : array_like, complex, (..., n_rx, n_tx)
        Channel matrices.

    Returns
    -------
    ndarray, (..., min(n_rx, n_tx))
        Singular values in descending order. Zeros for a matrix of zeros, NaN if an entry is not finite.

    Examples
    --------
    >>> singular_values([[[4e-160, 0], [0, 1e-160]]]).tolist()
    [[4e-160, 1e-160]]
    """
    matrix = unmasked(h, np.complex128)
    if matrix.ndim < 2:
        raise ValueError(f"H must have shape (..., n_rx, n_tx), found {matrix.shape}")
    lead, (rows, columns) = matrix.shape[:-2], matrix.shape[-2:]
    flat = matrix.reshape(-1, rows, columns)
    result = np.full((len(flat), min(rows, columns)), np.nan)
    step = max(1, _CHUNK // max(1, rows * columns))
    for start in range(0, len(flat), step):
        part = flat[start : start + step]
        # NumPy raises an error for the whole batch if one matrix has a NaN
        good = np.isfinite(part).all(axis=(1, 2))
        result[start : start + step][good] = np.linalg.svd(part[good], compute_uv=False)
    return result.reshape(*lead, min(rows, columns))


def rank_from_singular_values(sigma: ArrayLike, k: float) -> IntArray:
    """Return the ranks of singular-value profiles (..., m), as in :func:`channel_rank`. A NaN profile has rank 0.

    Singular values equal to ``sigma_1 / k`` do not count. Rounding errors of an SVD are a few ulp of ``sigma_1``, so
    values within ``8 eps sigma_1`` count as equal. Values 1 and 0.1 at K = 10 therefore always have rank 1.

    Source: arXiv 2502.10324 eq. 3.
    """
    if not k >= 1:
        raise ValueError(f"K is a ratio of singular values and must be >= 1, found {k}")
    values = unmasked(sigma)
    if not values.shape[-1]:
        return np.zeros(values.shape[:-1], dtype=np.int64)
    largest = values.max(axis=-1, keepdims=True)
    margin = 8.0 * np.finfo(np.float64).eps
    above = values > largest * (1.0 / k + margin)
    # the largest singular value always counts if it is positive
    alive = (largest[..., 0] > 0) & np.isfinite(largest[..., 0])
    rank = above.sum(axis=-1)
    if k > 1:
        # the margin must not exclude the largest value itself
        rank = np.maximum(rank, 1)
    return np.where(alive, rank, 0).astype(np.int64)


def channel_rank(h: ArrayLike, k: float) -> IntArray:
    """Return the rank of every channel matrix: the number of singular values strictly above ``sigma_1 / k``.

    Source: arXiv 2502.10324 eq. 3.

    Parameters
    ----------
    h : array_like, complex, (..., n_rx, n_tx)
        Channel matrices, in any scale.
    k : float
        Ratio of singular values, >= 1 (K = 10, 100, 1000 in the paper, also called 10, 20, 30 dB there).

    Returns
    -------
    ndarray of int, (...)
        Ranks. 0 means no channel: all entries are zero, or an entry is NaN or infinite.

    Raises
    ------
    ValueError
        If ``h`` has fewer than two axes or ``k < 1``.

    Notes
    -----
    Source: arXiv 2502.10324, section III. At ``k = 1`` nothing exceeds ``sigma_1`` and every rank is 0.

    Examples
    --------
    >>> import numpy as np
    >>> h = np.diag([1.0, 0.2, 0.1, 0.05])
    >>> channel_rank(h, 10), channel_rank(1e-150 * h, 1000), channel_rank(0 * h, 10)
    (array(2), array(4), array(0))
    """
    return rank_from_singular_values(singular_values(h), k)


def _ranks(rank: ArrayLike) -> FloatArray:
    return unmasked(rank).ravel()


def histogram(rank: ArrayLike) -> FloatArray:
    """Return the shares of rank 1 to :data:`MAX_RANK`, ignoring 0 (no channel) and NaN (no CSI).

    Parameters
    ----------
    rank : array_like
        Ranks, in any shape. Ranks above :data:`MAX_RANK` are an error.

    Returns
    -------
    ndarray, (ranks,)
        Shares that sum to one, or NaN if no sample has a rank.

    Examples
    --------
    >>> histogram([1, 2, 2, 0, float("nan")]).round(3).tolist()
    [0.333, 0.667, 0.0, 0.0]
    """
    values = _ranks(rank)
    existing = values[np.isfinite(values) & (values >= 1)]
    if np.any(existing > MAX_RANK) or np.any(existing != np.round(existing)):
        raise ValueError(f"ranks must be whole numbers up to {MAX_RANK}")
    bars = np.bincount(existing.astype(np.int64), minlength=MAX_RANK + 1)[1:]
    return np.asarray(bars / len(existing)) if len(existing) else np.full(MAX_RANK, np.nan)


def one_hot(rank: IntArray | FloatArray, ranks: int = MAX_RANK) -> FloatArray:
    """Return an array (n, ranks) with 1 in the column of each rank."""
    return np.asarray(np.asarray(rank)[:, None] == np.arange(1, ranks + 1), dtype=np.float64)


def agreement(measured: ArrayLike, simulated: ArrayLike) -> float:
    """Return the share of equal ranks among poses with both ranks (not NaN, not 0), or NaN without such poses.

    Examples
    --------
    >>> agreement([1, 2, 2, float("nan")], [1, 2, 3, 1])
    0.6666666666666666
    """
    measured_rank, simulated_rank = _pairs(measured, simulated)
    return float(np.mean(measured_rank == simulated_rank)) if len(measured_rank) else float("nan")


def total_variation(first: ArrayLike, second: ArrayLike) -> float:
    """Return the total variation distance of two histograms: half the sum of absolute differences, 0 to 1.

    Examples
    --------
    >>> total_variation([0.5, 0.5, 0, 0], [1, 0, 0, 0])
    0.5
    """
    return float(0.5 * np.abs(unmasked(first) - unmasked(second)).sum())


def wasserstein(first: ArrayLike, second: ArrayLike) -> float:
    """Return the Wasserstein-1 distance of two rank histograms: the average number of ranks by which shares must move.

    Examples
    --------
    >>> wasserstein([1, 0, 0, 0], [0, 0, 0, 1])
    3.0
    """
    step = np.cumsum(unmasked(first) - unmasked(second))
    # omit the last step, which is 0 except for rounding
    return float(np.abs(step[:-1]).sum())


def _both(measured: ArrayLike, simulated: ArrayLike) -> tuple[IntArray, IntArray]:
    """Return the measured and the simulated ranks as integers, 0 if missing."""
    ranks = _ranks(measured), _ranks(simulated)
    # comparisons with NaN (no report) are False, so NaN becomes 0
    first, second = (np.where(rank >= 1, rank, 0).astype(np.int64) for rank in ranks)
    return first, second


def _pairs(measured: ArrayLike, simulated: ArrayLike) -> tuple[IntArray, IntArray]:
    """Return the measured and the simulated ranks as integers, for poses at which both exist (not NaN, not 0)."""
    first, second = _both(measured, simulated)
    existing = (first > 0) & (second > 0)
    return first[existing], second[existing]


def confusion_matrix(measured: ArrayLike, simulated: ArrayLike) -> IntArray:
    """Return the confusion matrix of measured and simulated ranks, 0 to :data:`MAX_RANK`, where 0 means missing.

    Returns
    -------
    ndarray of int, (max_rank + 1, max_rank + 1)
        Number of samples. Rows are measured ranks (0: no CSI), columns simulated ranks (0: no channel).
    """
    row, column = _both(measured, simulated)
    size = MAX_RANK + 1
    if len(row) and max(row.max(), column.max()) >= size:
        raise ValueError(f"ranks must be at most {MAX_RANK}")
    return np.bincount(row * size + column, minlength=size * size).reshape(size, size).astype(np.int64)


def cohen_kappa(measured: ArrayLike, simulated: ArrayLike) -> float:
    """Return Cohen's kappa: the agreement beyond chance, given both histograms.

    Kappa is 1 if the ranks are always equal, and 0 if they agree as often as by chance. Kappa is NaN if no sample has
    both ranks, or if all measured and simulated ranks are the same number. Cohen (1960),
    doi:10.1177/001316446002000104.

    Examples
    --------
    >>> cohen_kappa([1, 2, 1, 2], [1, 2, 2, 1])
    0.0
    """
    measured_rank, simulated_rank = _pairs(measured, simulated)
    if not len(measured_rank):
        return float("nan")
    size = int(max(measured_rank.max(), simulated_rank.max())) + 1
    shares = [np.bincount(rank, minlength=size) / len(rank) for rank in (measured_rank, simulated_rank)]
    observed, chance = float(np.mean(measured_rank == simulated_rank)), float(shares[0] @ shares[1])
    # kappa of two equal constants is 0 / 0
    return (observed - chance) / (1.0 - chance) if chance < 1.0 - 1e-12 else float("nan")


# Number of parts of a flight in which measured and simulated ranks are swapped. With twelve parts, a part is much
# longer than most correlation times, and there are 2048 combinations of swaps.
_PARTS = 12


def histogram_test(measured: ArrayLike, simulated: ArrayLike) -> float:
    """Return the p-value of the total variation distance of both histograms, from swaps in parts of the flight.

    If measured and simulated ranks had the same distribution, swapping them in a part of the flight would have no
    effect on average.

    Parameters
    ----------
    measured, simulated : array_like, (n,)
        Ranks of the same samples. NaN and 0 are ignored.

    Returns
    -------
    float
        Share of all combinations of swaps, including the observed ranks, with a total variation at least as large. NaN
        if no sample has both ranks.
    """
    measured_rank, simulated_rank = _pairs(measured, simulated)
    if not len(measured_rank):
        return float("nan")
    # swapping a part changes the sign of its difference
    starts = np.unique(np.arange(_PARTS) * len(measured_rank) // _PARTS)
    sums = np.add.reduceat(one_hot(measured_rank) - one_hot(simulated_rank), starts, axis=0)
    # never swap the last part, because swapping all other parts instead has the same result
    signs = 1 - 2 * ((np.arange(2 ** (len(sums) - 1))[:, None] >> np.arange(len(sums))) & 1)
    swapped = np.abs(signs @ sums).sum(axis=1)
    # allow for rounding, because swaps with equal results are summed in another order
    return float(np.mean(swapped >= np.abs(sums.sum(axis=0)).sum() - 1e-9))


# --- the modem's decision ----------------------------------------------------------------------------


def k_grid() -> FloatArray:
    """Return a grid of K from 1.33 to 1e5, 24 values per decade, that contains 10, 100 and 1000 exactly."""
    k = 10.0 ** (np.arange(3, 121) / 24)
    decade = np.round(np.log10(k))
    return np.asarray(np.where(np.isclose(k, 10.0**decade, rtol=1e-9), 10.0**decade, k))


@dataclass(frozen=True, slots=True)
class KCurve:
    """The agreement as a function of the threshold K.

    Parameters
    ----------
    k, agreement : (m,)
        Values of K, and the agreement of simulated with measured ranks at each K.
    best_k : float
        K with the best agreement. If several neighbouring values are equally good, their middle on a log scale. NaN if
        no pose has both ranks.
    best_k_ci95 : (low, high)
        Range of K whose agreement is not significantly worse on the same samples (95 %), one grid step wider on either
        side.
    """

    k: FloatArray
    agreement: FloatArray
    best_k: float = float("nan")
    best_k_ci95: statistics.Interval = statistics.NO_INTERVAL


def k_curve(
    measured: ArrayLike, sigma: ArrayLike, place_m: FloatArray | None = None, *, k: ArrayLike | None = None
) -> KCurve:
    """Compute the agreement for every K, and the K that explains the measured ranks best.

    Parameters
    ----------
    measured : array_like, (n,)
        RI in time order, NaN if missing.
    sigma : array_like, (n, m)
        Singular values of the simulated channel at the same poses (any scale; see :func:`singular_values`).
    place_m : (n, 3), optional
        The same as in :func:`compare_rank`.
    k : array_like, optional
        Grid of K, by default :func:`k_grid`.

    Returns
    -------
    KCurve
        NaN if no pose has both ranks.
    """
    grid = k_grid() if k is None else unmasked(k)
    ri, profile = _ranks(measured), unmasked(sigma)
    # use any K above 1 to find the samples with a channel, because their rank is at least 1 for every such K
    paired = (ri >= 1) & (rank_from_singular_values(profile, 10.0) >= 1)
    if not paired.any():
        return KCurve(k=grid, agreement=np.full(len(grid), np.nan))
    # store one byte per sample and K, because there are 118 values of K
    equal = np.stack([rank_from_singular_values(profile[paired], value) == ri[paired] for value in grid], axis=1)
    agree, place = equal.mean(axis=0), None if place_m is None else place_m[paired]
    # take the middle of the first run of equally good K, on the logarithmic scale of the grid
    first = int(np.argmax(agree))
    run = np.flatnonzero(np.append(agree[first:], -1.0) < agree[first] - 1e-12)[0]
    ends = statistics.NO_INTERVAL
    if len(equal) >= statistics.FEWEST:
        lost = (equal.astype(np.float64) - equal[:, first : first + 1]).T
        alike = np.flatnonzero([statistics.influence_interval(loss.mean(), loss, place)[1] >= 0.0 for loss in lost])
        ends = float(grid[max(alike[0] - 1, 0)]), float(grid[min(alike[-1] + 1, len(grid) - 1)])
    return KCurve(k=grid, agreement=agree, best_k=float(np.sqrt(grid[first] * grid[first + run - 1])), best_k_ci95=ends)


@dataclass(frozen=True, slots=True)
class Staleness:
    """The time for which the modem held each report.

    Parameters
    ----------
    fresh : (n,) bool
        True for the first row of each report. Later rows repeat it.
    n_reports : int
        Number of reports among the rows with a rank.
    hold_s : float
        Median time for which a report was held [s]. NaN for fewer than two reports.
    verdict : str
        ``"fresh"`` (at most a tenth of the rows are repetitions), ``"held"``, ``"constant"`` (there is only one value,
        so repetitions cannot be detected) or ``"no rank"``.
    """

    fresh: BoolArray
    n_reports: int
    hold_s: float
    verdict: str


def stale_reports(time_s: ArrayLike, rank: ArrayLike, further: Mapping[str, ArrayLike] | None = None) -> Staleness:
    """Detect an RI that is held between reports.

    Parameters
    ----------
    time_s : array_like, (n,)
        Times [s], increasing.
    rank : array_like, (n,)
        RI, NaN if missing.
    further : mapping of str to array_like (n,), optional
        Other numbers of the same report (RSRP, SINR, CQI). A row that repeats **all** of them is a repetition, because
        RSRP and SINR hardly ever repeat by chance. Without other numbers, the changes of RI are used: if they occur at
        multiples of a period of several rows, there is one report per period.
    """
    time, ri = unmasked(time_s), _ranks(rank)
    known = np.isfinite(ri)
    if not known.any():
        return Staleness(np.zeros(len(ri), dtype=bool), 0, float("nan"), "no rank")
    columns = [ri, *(np.asarray(v, dtype=np.float64) for v in (further or {}).values())]
    if len(columns) > 1:
        # a row in which all other numbers are missing cannot be recognised as a repetition
        has_values = np.any([np.isfinite(c) for c in columns[1:]], axis=0)
        fresh = known & (_changes(columns) | ~has_values)
    else:
        fresh = known & _period_starts(ri)
    constant = all(np.ptp(c[np.isfinite(c)]) == 0 for c in columns if np.isfinite(c).any())
    reports = int(fresh.sum())
    hold = float(np.median(np.diff(time[fresh]))) if reports > 1 else float("nan")
    repeats = reports < 0.9 * int(known.sum())
    return Staleness(fresh, reports, hold, "constant" if constant else "held" if repeats else "fresh")


def _changes(columns: Sequence[FloatArray]) -> BoolArray:
    """Return a mask of the first row, and of rows that differ from the row before in any column (NaN equals NaN)."""
    changed = np.zeros(len(columns[0]), dtype=bool)
    changed[:1] = True
    for c in columns:
        changed[1:] |= ~((c[1:] == c[:-1]) | (np.isnan(c[1:]) & np.isnan(c[:-1])))
    return changed


def _period_starts(ri: FloatArray) -> BoolArray:
    """Return a mask of the first row of each report: once per period, or every row if RI has no period."""
    change = np.flatnonzero(_changes([ri]))[1:]
    if len(change) < 8:  # too few changes to distinguish a period from chance
        return np.ones(len(ri), dtype=bool)
    periods = np.arange(2, max(3, len(ri) // 8))
    # use the largest period for which at least 95 % of the changes have the same phase
    for period in periods[::-1]:
        phase = np.bincount(change % period, minlength=period)
        if phase.max() >= 0.95 * len(change):
            return np.asarray(np.arange(len(ri)) % period == np.argmax(phase))
    return np.ones(len(ri), dtype=bool)


# --- the comparison ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class RankFit:
    """A comparison of simulated ranks at one K with measured ranks.

    Parameters
    ----------
    histogram : (4,)
        Shares of rank 1 to 4 among poses with a channel, with intervals in ``histogram_ci95``.
    out_of_coverage : int
        Number of poses without a channel.
    agreement, kappa, total_variation, wasserstein : float
        Agreement with the measured ranks, and distances from their histogram, each with a 95 % interval.
    confusion : (5, 5) int
        Confusion matrix. Rows are measured, columns simulated ranks, starting with rank 0 (missing).
    p_histogram : float
        The p-value of :func:`histogram_test`.
    """

    histogram: FloatArray
    histogram_ci95: list[statistics.Interval]
    out_of_coverage: int
    agreement: float
    agreement_ci95: statistics.Interval
    kappa: float
    kappa_ci95: statistics.Interval
    total_variation: float
    total_variation_ci95: statistics.Interval
    wasserstein: float
    wasserstein_ci95: statistics.Interval
    confusion: IntArray
    p_histogram: float


@dataclass(frozen=True, slots=True)
class RankComparison:
    """A comparison of the measured RI of one tower with simulated ranks.

    Parameters
    ----------
    n, n_effective : int, float
        Number of measured ranks, and number of independent ranks whose mean would be equally accurate.
    n_no_csi : int
        Number of rows without RI.
    histogram : (4,)
        Measured shares of rank 1 to 4, with intervals in ``histogram_ci95``.
    simulated : mapping of float to RankFit
        Comparison for each threshold K.
    curve : KCurve
        Comparison for continuous K.
    staleness : Staleness
        Hold time of the measured RI.
    """

    n: int
    n_effective: float
    n_no_csi: int
    histogram: FloatArray
    histogram_ci95: list[statistics.Interval]
    simulated: Mapping[float, RankFit]
    curve: KCurve
    staleness: Staleness


def compare_rank(
    measured: ArrayLike,
    h: ArrayLike,
    ks: Sequence[float] = (10.0, 100.0, 1000.0),
    *,
    time_s: ArrayLike | None = None,
    sinr_db: ArrayLike | None = None,
    place_m: FloatArray | None = None,
) -> RankComparison:
    """Compare the measured RI with the ranks of simulated channels.

    Parameters
    ----------
    measured : array_like, (n,)
        RI in time order, counted from 1, NaN if missing. A 0 is refused, because it means "no CSI" in all logs.
    h : array_like, complex, (n, n_rx, n_tx)
        Simulated channels at the same poses, all zero without a path.
    ks : sequence of float
        Thresholds.
    time_s : array_like, (n,), optional
        Times [s], for the hold time of stale RI. The default is the row number.
    sinr_db : array_like, (n,), optional
        Reported SINR [dB], used to detect repeated reports.
    place_m : (n, 3), optional
        East, north and up [m], NaN if unknown. With positions, intervals also allow for correlation over position.

    Returns
    -------
    RankComparison
        Histograms, agreement and distances per K, the curve over K, and stale reports.

    Raises
    ------
    ValueError
        If a measured rank is 0, or ``h`` has another shape or length.
    """
    ri = _ranks(measured)
    if np.any(ri == 0):
        raise ValueError("measured rank 0 found: a reader must turn 'no CSI' into NaN")
    matrix = unmasked(h, np.complex128)
    if matrix.ndim != 3 or len(matrix) != len(ri):
        raise ValueError(f"H must have shape ({len(ri)}, n_rx, n_tx), found {matrix.shape}")
    sigma = singular_values(matrix)
    simulated = {float(k): rank_from_singular_values(sigma, k) for k in ks}
    reported = np.isfinite(ri)
    place = None if place_m is None else place_m[reported]
    time = np.arange(len(ri)) if time_s is None else time_s
    return RankComparison(
        n=int(reported.sum()),
        n_effective=statistics.independent_samples(ri[reported], place),
        n_no_csi=int((~reported).sum()),
        histogram=histogram(ri),
        histogram_ci95=_histogram_intervals(ri[reported], place),
        simulated={k: compare_ranks(ri, rank, place_m) for k, rank in simulated.items()},
        curve=k_curve(ri, sigma, place_m),
        staleness=stale_reports(time, ri, {} if sinr_db is None else {"sinr_db": sinr_db}),
    )


def _histogram_intervals(rank: FloatArray, place_m: FloatArray | None = None) -> list[statistics.Interval]:
    return [statistics.share_interval(bar, place_m, rank) for bar in one_hot(rank).T]


def compare_ranks(measured: ArrayLike, simulated: ArrayLike, place_m: FloatArray | None = None) -> RankFit:
    """Compare two sequences of ranks by pose and by histogram.

    The histogram distances compare all measured with all simulated ranks. The intervals come from poses that have both
    ranks.

    Parameters
    ----------
    measured, simulated : array_like, (n,)
        Ranks of the same samples: NaN unknown, 0 no channel.
    place_m : (n, 3), optional
        The same as in :func:`compare_rank`.

    Returns
    -------
    RankFit
        Agreement, kappa and distances with their 95 % intervals and permutation tests.
    """
    measured_rank, simulated_rank = _ranks(measured), _ranks(simulated)
    bars, simulated_bars = histogram(measured_rank), histogram(simulated_rank)
    a, b = _pairs(measured_rank, simulated_rank)
    agree, kappa = agreement(a, b), cohen_kappa(a, b)
    tv, move = total_variation(bars, simulated_bars), wasserstein(bars, simulated_bars)
    both = (measured_rank >= 1) & (simulated_rank >= 1)
    places = None if place_m is None else (place_m[both], place_m[simulated_rank >= 1])
    bounds = _pair_intervals(a, b, (agree, kappa, tv, move), places and places[0])
    return RankFit(
        histogram=simulated_bars,
        histogram_ci95=_histogram_intervals(simulated_rank[simulated_rank >= 1], places and places[1]),
        out_of_coverage=int((simulated_rank == 0).sum()),
        agreement=agree,
        agreement_ci95=bounds[0],
        kappa=kappa,
        kappa_ci95=bounds[1],
        total_variation=tv,
        total_variation_ci95=bounds[2],
        wasserstein=move,
        wasserstein_ci95=bounds[3],
        confusion=confusion_matrix(measured_rank, simulated_rank),
        p_histogram=histogram_test(measured_rank, simulated_rank),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class CommonestRank:
    """The forecast without a model, which is always the rank that was reported most often.

    A useful model has a larger agreement. The kappa of this forecast is 0. ``rank`` is 0 if there is no report.
    """

    rank: int
    agreement: float
    agreement_ci95: statistics.Interval


def commonest_rank(measured: ArrayLike, place_m: FloatArray | None = None) -> CommonestRank:
    """Return the most frequent of the measured ranks (n,) and its share. NaN is ignored.

    Positions ``place_m`` (n, 3) [m] are used as by :func:`compare_rank`.

    Examples
    --------
    >>> found = commonest_rank([2, 2, 1, float("nan")])
    >>> found.rank, round(found.agreement, 3)
    (2, 0.667)
    """
    ri = _ranks(measured)
    bars = histogram(ri)
    if not np.isfinite(bars).all():
        return CommonestRank(rank=0, agreement=float("nan"), agreement_ci95=statistics.NO_INTERVAL)
    best = int(np.argmax(bars))
    reported = np.isfinite(ri)
    bounds = _histogram_intervals(ri[reported], None if place_m is None else place_m[reported])[best]
    return CommonestRank(rank=best + 1, agreement=float(bars[best]), agreement_ci95=bounds)


@dataclass(frozen=True, slots=True, kw_only=True)
class RankRepeat:
    """The agreement of two passes over the same positions. No model can be expected to exceed this agreement.

    Parameters
    ----------
    kappa, agreement : float
        Kappa and agreement of the reported ranks of both passes, NaN without a pair.
    kappa_ci95 : (low, high)
        95 % interval of kappa.
    n : int
        Number of pairs.
    """

    kappa: float
    kappa_ci95: statistics.Interval
    agreement: float
    n: int


def repeat_rank(
    first: statistics.Visit, second: statistics.Visit, radius_m: float = statistics.SAME_PLACE_M
) -> RankRepeat:
    """Return the kappa of the ranks that two passes of a flight report at the same positions.

    Parameters
    ----------
    first, second : Visit
        Visits whose values are ranks. 0 and NaN are ignored.
    radius_m : float
        Largest distance to the nearest sample of the other pass, with which a sample is paired.

    Returns
    -------
    RankRepeat
        NaN without a pair.
    """
    ranks = [np.where(visit.value >= 1, visit.value, np.nan) for visit in (first, second)]
    rows, partners = statistics.same_places(replace(first, value=ranks[0]), replace(second, value=ranks[1]), radius_m)
    if not len(rows):
        return RankRepeat(kappa=float("nan"), kappa_ci95=statistics.NO_INTERVAL, agreement=float("nan"), n=0)
    a, b = _pairs(ranks[0][rows], ranks[1][partners])
    kappa = cohen_kappa(a, b)
    bounds = statistics.influence_interval(kappa, kappa_influence(a, b), first.position_m[rows], (-1.0, 1.0))
    return RankRepeat(kappa=kappa, kappa_ci95=bounds, agreement=agreement(a, b), n=len(a))


def _pair_intervals(
    a: IntArray, b: IntArray, values: tuple[float, float, float, float], place_m: FloatArray | None = None
) -> list[statistics.Interval]:
    """Return the intervals of agreement, kappa, total variation and Wasserstein distance of paired ranks (n,)."""
    if len(a) < statistics.FEWEST:
        return [statistics.NO_INTERVAL] * 4
    equal, *influences = _influences((a == b).astype(np.float64), one_hot(a), one_hot(b))
    # use Wilson's interval for the agreement, because its width is not 0 at shares of 0 and 1
    return [statistics.share_interval(equal, place_m, a.astype(np.float64))] + [
        statistics.influence_interval(value, influence, place_m, bounds)
        for value, influence, bounds in zip(
            values[1:], influences, ((-1.0, 1.0), (0.0, 1.0), (0.0, MAX_RANK - 1.0)), strict=True
        )
    ]


def _influences(equal: FloatArray, first: FloatArray, second: FloatArray) -> list[FloatArray]:
    """Return each pose's first-order effect (n,) on agreement, kappa, total variation and Wasserstein distance."""
    p, q = first.mean(axis=0), second.mean(axis=0)
    by_chance, beyond_chance = first @ q + second @ p, max(1.0 - float(p @ q), 1e-12)
    # the derivative of an absolute value is the sign
    apart = np.sign(np.cumsum(p - q))
    return [
        equal,
        equal / beyond_chance + (float(equal.mean()) - 1.0) / beyond_chance**2 * by_chance,
        0.5 * (first - second) @ np.sign(p - q),
        np.cumsum(first - second, axis=1) @ apart,
    ]


def kappa_influence(measured: IntArray, simulated: IntArray) -> FloatArray:
    """Return the first-order contribution (n,) of each pose to kappa, for paired ranks (n,) from 1 to ``MAX_RANK``."""
    return _influences((measured == simulated).astype(np.float64), one_hot(measured), one_hot(simulated))[1]
