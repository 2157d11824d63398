"""The one constant between a measurement and a simulation, and what is known about it.

The offset is **added to the measurement**. Its grid is integers over ``1 / step`` (never accumulated floats),
a tie goes to the offset nearer zero, and an optimum at the edge of the span is flagged: it is an error to look
at, not a result.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from ..common.units import FloatArray, unmasked

# Search span of arXiv 2502.10324, section V [dB].
SPAN_DB = (-50.0, 50.0)

# Search step of arXiv 2502.10324, section V [dB].
STEP_DB = 0.1

# A longer grid is a mistake in the step or the span, and would not fit in memory.
MAXIMUM_OFFSETS = 10_000_000

# Distances that differ by less than this share of a step are ties (0.15 lies between 0.1 and 0.2).
_TIE = 1e-9


@dataclass(frozen=True, slots=True)
class OffsetFit:
    """Best constant offset.

    Parameters
    ----------
    offset_db : float
        To be added to the measurement [dB]; NaN without a pair.
    rmse_db : float
        Root mean square of ``measured + offset - simulated`` [dB]; NaN without a pair.
    n : int
        Pairs that count (both sides finite).
    at_edge : bool
        The optimum is the first or last offset of the span: the true one may lie outside.
    """

    offset_db: float
    rmse_db: float
    n: int
    at_edge: bool


_NO_FIT = OffsetFit(float("nan"), float("nan"), 0, False)


@dataclass(frozen=True, slots=True, kw_only=True)
class Censored:
    """Offset where "below" is an observation too; only ``n`` = 0 where a side has no level.

    Parameters
    ----------
    offset_db, sigma_db : float
        Offset added to the measurement and standard deviation of the residual [dB].
    n, n_measured_below, n_simulated_below : int
        Full pairs; pairs with only the measurement, and only the simulation, below their floors.
    at_search_edge : bool
        As ``at_edge`` of :class:`OffsetFit`.
    """

    offset_db: float | None = None
    sigma_db: float | None = None
    n: int
    n_measured_below: int | None = None
    n_simulated_below: int | None = None
    at_search_edge: bool | None = None


def offset_grid(step_db: float = STEP_DB, span_db: tuple[float, float] = SPAN_DB) -> FloatArray:
    """Offsets to try [dB]: the multiples of ``step_db`` inside ``span_db``, each correctly rounded.

    Raises
    ------
    ValueError
        If the step is not positive or no multiple lies inside the span.

    Examples
    --------
    >>> offset_grid()[[0, 499, 503, 1000]].tolist()
    [-50.0, -0.1, 0.3, 50.0]
    """
    low, high = span_db
    if not (step_db > 0 and np.isfinite([step_db, low, high]).all()):
        raise ValueError(f"offset step and span must be finite and the step positive, found {step_db}, {span_db}")
    if (high - low) / step_db > MAXIMUM_OFFSETS:
        raise ValueError(f"{(high - low) / step_db:.0e} offsets to try, at most {MAXIMUM_OFFSETS}")
    first = int(np.ceil(low / step_db - _TIE))
    last = int(np.floor(high / step_db + _TIE))
    if last < first:
        raise ValueError(f"no multiple of {step_db} dB lies between {low} and {high} dB")
    count = np.arange(first, last + 1, dtype=np.float64)
    per_db = 1.0 / step_db
    # 3 / 10 is 0.3; 3 * 0.1 is not
    integral = abs(per_db - round(per_db)) < 1e-9 * per_db and round(per_db) >= 1
    return count / round(per_db) if integral else count * step_db


def nearest_offset(grid_db: FloatArray, target_db: float, step_db: float = STEP_DB) -> int:
    """Index of the offset nearest to ``target_db``; a tie goes to the one nearer zero."""
    # a target far beyond the grid is at its edge: 1e30 lies equally far from all offsets in float64
    distance = np.abs(grid_db - np.clip(target_db, grid_db[0], grid_db[-1]))
    near = np.flatnonzero(distance <= distance.min() + _TIE * step_db)
    return int(near[np.argmin(np.abs(grid_db[near]))])


def _difference(measured_db: ArrayLike, simulated_db: ArrayLike) -> FloatArray:
    """Simulated minus measured over the pairs that count [dB], flat."""
    measured = unmasked(measured_db)
    simulated = unmasked(simulated_db)
    if measured.shape != simulated.shape:
        raise ValueError(f"measured has shape {measured.shape}, simulated {simulated.shape}: they must be pairs")
    ok = np.isfinite(measured) & np.isfinite(simulated)
    return np.asarray(simulated[ok] - measured[ok])


def _mean_and_variance(values: FloatArray) -> tuple[float, float]:
    largest = float(np.abs(values).max())
    if largest > 1e150:  # sums and squares would overflow
        return float((values / largest).mean()) * largest, float("inf")
    mean = float(values.mean())
    return mean, float(np.mean((values - mean) ** 2))


def grid_offset(
    measured_db: ArrayLike,
    simulated_db: ArrayLike,
    *,
    step_db: float = STEP_DB,
    span_db: tuple[float, float] = SPAN_DB,
) -> OffsetFit:
    """Offset of least RMSE by grid search.

    Parameters
    ----------
    measured_db, simulated_db : array_like, same shape
        Levels [dB]. Pairs with a NaN (or an infinity: no power) on either side do not count.
    step_db : float
        Grid step [dB]; the offsets are integers over ``1 / step_db``.
    span_db : (low, high)
        First and last offset [dB].

    Returns
    -------
    OffsetFit
        The offset is added to the measurement; ties go to the offset nearer zero.

    Raises
    ------
    ValueError
        If the shapes differ or the grid is empty.

    Notes
    -----
    RMSE^2(o) = variance + (mean difference - o)^2, evaluated in that form on the whole grid: sums of squares of
    offset levels would lose the digits that decide a tie. Source: arXiv 2502.10324, section V.

    Examples
    --------
    >>> grid_offset([-60.0, -70.0, float("nan")], [-57.0, -66.9, -1.0])
    OffsetFit(offset_db=3.0, rmse_db=0.0707..., n=2, at_edge=False)
    """
    grid = offset_grid(step_db, span_db)
    difference = _difference(measured_db, simulated_db)
    if not len(difference):
        return _NO_FIT
    mean, variance = _mean_and_variance(difference)
    best = nearest_offset(grid, mean, step_db)
    rmse = float(np.hypot(np.sqrt(variance), mean - grid[best]))
    return OffsetFit(float(grid[best]), rmse, len(difference), best in (0, len(grid) - 1))


def offset_curve(
    measured_db: ArrayLike,
    simulated_db: ArrayLike,
    *,
    step_db: float = STEP_DB,
    span_db: tuple[float, float] = SPAN_DB,
) -> tuple[FloatArray, FloatArray]:
    """RMSE [dB] at every offset [dB] of the grid: how sharply the data fix the offset.

    Parameters
    ----------
    measured_db, simulated_db : array_like, (n,)
        Levels [dB]; pairs with a NaN do not count.
    step_db, span_db : float, (float, float)
        Of the candidate offsets, as in :func:`offset_grid` [dB].

    Returns
    -------
    (offsets_db, rmse_db), each (offsets,)
        RMSE is NaN everywhere without a pair.
    """
    grid = offset_grid(step_db, span_db)
    difference = _difference(measured_db, simulated_db)
    if not len(difference):
        return grid, np.full(len(grid), np.nan)
    mean, variance = _mean_and_variance(difference)
    return grid, np.hypot(np.sqrt(variance), mean - grid)


def identifiable_range(offsets_db: FloatArray, rmse_db: FloatArray, *, excess_db: float = 0.1) -> tuple[float, float]:
    """Offsets whose RMSE stays within ``excess_db`` of the best one: (lowest, highest) [dB]."""
    if not np.isfinite(rmse_db).any():
        return float("nan"), float("nan")
    near = offsets_db[rmse_db <= np.nanmin(rmse_db) + excess_db]
    return float(near.min()), float(near.max())


def trimmed_offset(
    measured_db: ArrayLike,
    simulated_db: ArrayLike,
    *,
    keep: float = 0.9,
    step_db: float = STEP_DB,
    span_db: tuple[float, float] = SPAN_DB,
) -> OffsetFit:
    """Offset of least trimmed RMSE: at every offset only the ``keep`` share of smallest residuals counts.

    Parameters
    ----------
    measured_db, simulated_db : array_like, (n,)
        Pairs of levels [dB]; pairs with NaN do not count.
    keep : float
        Share of pairs that counts, above 0.5 and up to 1 (at 1 it is :func:`grid_offset`).
    step_db, span_db : float, (float, float)
        Grid of the search [dB].

    Returns
    -------
    OffsetFit
        ``n`` and ``rmse_db`` are those of the pairs kept at the best offset.

    Notes
    -----
    Rousseeuw's least trimmed squares, doi:10.1080/01621459.1984.10477105. In one dimension the smallest residuals
    of an offset are a window of the sorted differences, so the whole grid costs one sort and one search.
    """
    if not 0.5 < keep <= 1.0:
        raise ValueError(f"keep must be above 0.5 and at most 1, found {keep}")
    grid = offset_grid(step_db, span_db)
    difference = np.sort(_difference(measured_db, simulated_db))
    n = len(difference)
    if not n:
        return _NO_FIT
    count = int(np.ceil(keep * n - 1e-9))
    centre = float(difference.mean())
    d = difference - centre
    sums = np.concatenate([[0.0], np.cumsum(d)])
    squares = np.concatenate([[0.0], np.cumsum(d * d)])
    # moving the window by one pays off once the offset passes the middle of what leaves and what enters
    first = np.searchsorted(0.5 * (d[: n - count] + d[count:]), grid - centre)
    mean = (sums[first + count] - sums[first]) / count
    variance = np.maximum((squares[first + count] - squares[first]) / count - mean**2, 0.0)
    mse = variance + (mean - (grid - centre)) ** 2
    near = np.flatnonzero(mse <= mse.min() + _TIE * step_db**2)
    best = int(near[np.argmin(np.abs(grid[near]))])
    return OffsetFit(float(grid[best]), float(np.sqrt(mse[best])), count, best in (0, len(grid) - 1))


def censored_offset(
    measured_db: ArrayLike,
    simulated_db: ArrayLike,
    *,
    measured_floor_db: float,
    simulated_floor_db: float,
    step_db: float = STEP_DB,
    span_db: tuple[float, float] = SPAN_DB,
) -> Censored:
    """Offset when a sample at the noise floor or without a path is an observation: "below".

    Parameters
    ----------
    measured_db, simulated_db : array_like, (n,)
        Levels [dB]. Here NaN means **below the floor** (no signal; no path): leave out samples that were not
        taken at all before the call.
    measured_floor_db : float
        The receiver reports nothing lower; levels at or below it are "below" [dB, unit of the measurement].
    simulated_floor_db : float
        The simulation tells nothing about levels lower than this [dB, unit of the simulation].
    step_db, span_db : float, (float, float)
        Grid of the offset [dB].

    Returns
    -------
    Censored

    Notes
    -----
    Tobit likelihood (Tobin 1958, doi:10.2307/1907382) with residual ``simulated - measured ~ N(offset, sigma)``: a
    measurement below its floor says ``residual > simulated - floor``; a simulation below its floor says
    ``residual < floor - measured``; both below say nothing. In Olsen's scale (doi:10.2307/1911275) the logarithm
    is concave, so the maximum is the only one; the offset is then the nearest one of the grid.
    """
    measured, simulated = unmasked(measured_db), unmasked(simulated_db)
    if measured.shape != simulated.shape:
        raise ValueError(f"measured has shape {measured.shape}, simulated {simulated.shape}: they must be pairs")
    low_m, low_s = ~(measured > measured_floor_db), ~(simulated > simulated_floor_db)
    full = (simulated - measured)[~low_m & ~low_s]
    above = (simulated - measured_floor_db)[low_m & ~low_s]
    below = (simulated_floor_db - measured)[~low_m & low_s]
    offset, sigma, at_edge = float("nan"), float("nan"), False
    if len(full):
        mean, sigma = _tobit(full, above, below)
        grid = offset_grid(step_db, span_db)
        best = nearest_offset(grid, mean, step_db)
        offset, at_edge = float(grid[best]), best in (0, len(grid) - 1)
    return Censored(
        offset_db=offset, sigma_db=sigma, n=len(full), n_measured_below=len(above), n_simulated_below=len(below),
        at_search_edge=at_edge,
    )  # fmt: skip


def _tobit(full: FloatArray, above: FloatArray, below: FloatArray) -> tuple[float, float]:
    """Mean and standard deviation of a normal sample with values known, above and below given limits."""
    from scipy.optimize import minimize
    from scipy.special import log_ndtr

    log_tau = float(np.log(2.0 * np.pi))
    centre, variance = _mean_and_variance(full)
    scale = max(float(np.sqrt(variance)), 1e-3)
    full, above, below = (full - centre) / scale, (above - centre) / scale, (below - centre) / scale

    def negative(parameters: FloatArray) -> tuple[float, FloatArray]:
        delta, theta = parameters  # mean / sigma, 1 / sigma
        z = theta * full - delta
        up, down = delta - theta * above, theta * below - delta
        log_up, log_down = log_ndtr(up), log_ndtr(down)
        value = 0.5 * (z @ z) - len(full) * np.log(theta) - log_up.sum() - log_down.sum()
        mills_up, mills_down = (np.exp(-0.5 * (x**2 + log_tau) - log) for x, log in ((up, log_up), (down, log_down)))
        slope = np.array(
            [
                -z.sum() - mills_up.sum() + mills_down.sum(),
                z @ full - len(full) / theta + mills_up @ above - mills_down @ below,
            ]
        )
        return float(value), slope

    start = np.array([0.0, 1.0])
    # 1 / sigma has no bound when all known values are equal: stop at a thousandth of a dB
    best = minimize(negative, start, jac=True, method="L-BFGS-B", bounds=[(None, None), (1e-6, scale * 1e3)])
    delta, theta = best.x
    return centre + scale * float(delta / theta), scale / float(theta)


Pooling = Literal["link", "tower", "channel", "flight", "all"]

_GROUP: dict[str, tuple[int, ...]] = {"link": (0, 1, 2), "tower": (1,), "channel": (2,), "flight": (0,), "all": ()}


@dataclass(frozen=True, slots=True, kw_only=True)
class Moments:
    """Moments of a sequence that an offset needs: pairs, mean and variance of simulated minus measured [dB, dB^2]."""

    n: int
    mean_db: float
    variance_db2: float


def difference_moments(measured_db: ArrayLike, simulated_db: ArrayLike) -> Moments:
    """The moments of the pairs that count; NaN without one.

    Examples
    --------
    >>> difference_moments([-60.0, -70.0, float("nan")], [-57.0, -66.0, -1.0])
    Moments(n=2, mean_db=3.5, variance_db2=0.25)
    """
    difference = _difference(measured_db, simulated_db)
    if not len(difference):
        return Moments(n=0, mean_db=float("nan"), variance_db2=float("nan"))
    mean, variance = _mean_and_variance(difference)
    return Moments(n=len(difference), mean_db=mean, variance_db2=variance)


def pooled_moments(
    moments: Mapping[tuple[str, str, str], Moments],
    per: Pooling = "link",
    *,
    step_db: float = STEP_DB,
    span_db: tuple[float, float] = SPAN_DB,
) -> dict[tuple[str, str, str], OffsetFit]:
    """One offset per tower, channel, flight, link or for everything.

    Parameters
    ----------
    moments : mapping of (flight, tower, channel) to Moments
        Of all sequences.
    per : {"link", "tower", "channel", "flight", "all"}
        Which sequences share an offset.
    step_db, span_db : float, (float, float)
        Grid of the search [dB].

    Returns
    -------
    dict
        Per (flight, tower, channel): the shared offset with the RMSE and the number of pairs of that sequence alone.

    Notes
    -----
    The best shared offset is the mean difference over all pairs, rounded to the grid and kept within it: the mean of
    the means, weighted by the pairs. RMSE^2(o) = variance + (mean - o)^2 of each sequence.
    """
    axes, grid = _GROUP[per], offset_grid(step_db, span_db)
    groups: dict[Hashable, list[tuple[str, str, str]]] = {}
    for key in moments:
        groups.setdefault(tuple(key[axis] for axis in axes), []).append(key)
    fits: dict[tuple[str, str, str], OffsetFit] = {}
    for members in groups.values():
        filled = [moments[key] for key in members if moments[key].n]
        if not filled:
            fits |= dict.fromkeys(members, _NO_FIT)
            continue
        total = sum(item.n for item in filled)
        mean = filled[0].mean_db + sum((item.mean_db - filled[0].mean_db) * (item.n / total) for item in filled)
        best = nearest_offset(grid, mean, step_db)
        offset, at_edge = float(grid[best]), best in (0, len(grid) - 1)
        for key in members:
            sequence = moments[key]
            rmse = float(np.hypot(np.sqrt(sequence.variance_db2), sequence.mean_db - offset))
            fits[key] = OffsetFit(offset, rmse, sequence.n, at_edge)
    return {key: fits[key] for key in moments}
