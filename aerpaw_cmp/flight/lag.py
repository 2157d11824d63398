"""The search for a lag between a level measured on the radio's clock and one predicted on the telemetry's.

``radio_minus_telemetry_s`` is how much later the radio's clock shows; radio times are corrected by subtracting it. A
search finds a best lag in any two curves: whether it is the clock's is judged in :mod:`aerpaw_cmp.flight.clock`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from ..common.units import AnyArray, BoolArray, FloatArray
from .track import NO_TIME, nanoseconds

LAG_WINDOW_S = 12.0
"""Lags searched on either side of zero [s]."""

LAG_LIMIT_S = 1.0
"""An interval wider than this on either side is no answer, and another optimum farther than this is a rival [s]."""

DRIFT_LIMIT = 10e-3 / 60.0
"""Drifts searched on either side of zero [s/s]: 10 ms per minute."""

_RIVAL = 10.83
"""Log-likelihood ratio (chi-squared, one degree) at 0.001 that a rival lag must lose by."""

_SCANNED = 6000
"""The search runs on at most this many samples; the refinement on all."""

_HELD = 1 << 15
"""Residuals held at once by the search: they stay in a core's cache."""

_HELD_FREE = 1 << 13
"""The same where free terms stand beside each."""

_INDEPENDENT = 0.7
"""Share of the evidence of several channels that counts: one airframe and one path make their residuals alike."""

_NEAR_EDGE = 0.86
"""A best lag beyond this share of the window may be the slope of a valley outside it."""

DRIFT_FROM_S = 600.0
"""Shorter flights get no drift [s]."""

FEWEST = 30
"""Fewer samples tell nothing about a lag."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LagFit:
    """Offset and drift between the radio and the telemetry clock.

    Parameters
    ----------
    radio_minus_telemetry_s : float
        How much later the radio's clock shows than the telemetry's [s], at ``reference``; NaN if failed.
        Radio times are corrected by **subtracting** it.
    ci95_s : (low, high)
        95 % interval of it; the whole window where the data say nothing.
    drift_s_per_s : float
        Growth of ``radio_minus_telemetry_s``; 0 where it was not fitted.
    drift_interval_s_per_s : (low, high)
        95 % interval of the drift; NaN where it was not fitted.
    verdict : {"ok", "ambiguous", "failed"}
        Only "ok" should be applied, and only when the user asks for it.
    reason : str
        Why not ok.
    reference : float
        Instant at which ``radio_minus_telemetry_s`` holds: seconds after the first radio sample.
    n : int
        Samples used.
    rmse_db, rmse_unshifted_db : float
        Residual with the lag and without, each after its best offset, on the samples used [dB].
    window_s : float
        Lags searched on either side [s].
    curve_lag_s, curve_rmse_db : (m,)
        Residual against lag (without drift).
    evidence : (m,)
        Log-likelihood ratio by which every lag of the curve is worse than the best one.
    """

    radio_minus_telemetry_s: float
    ci95_s: tuple[float, float]
    drift_s_per_s: float
    drift_interval_s_per_s: tuple[float, float]
    verdict: Literal["ok", "ambiguous", "failed"]
    reason: str
    reference: float
    n: int
    rmse_db: float
    rmse_unshifted_db: float
    window_s: float
    curve_lag_s: FloatArray = field(repr=False)
    curve_rmse_db: FloatArray = field(repr=False)
    evidence: FloatArray = field(repr=False)

    def as_dict(self) -> dict[str, Any]:
        """For metrics.json; NaN becomes None, the curve is left out."""
        names = {
            "radio_minus_telemetry_s": self.radio_minus_telemetry_s,
            "ci95_s": list(self.ci95_s),
            "drift_ms_per_min": self.drift_s_per_s * 60e3,
            "drift_ci95_ms_per_min": [60e3 * v for v in self.drift_interval_s_per_s],
            "verdict": self.verdict,
            "reason": self.reason,
            "window_s": self.window_s,
            "n": self.n,
            "rmse_db": self.rmse_db,
            "rmse_unshifted_db": self.rmse_unshifted_db,
        }

        def known(value: Any) -> Any:
            if isinstance(value, list):
                return [known(item) for item in value]
            return None if isinstance(value, float) and not np.isfinite(value) else value

        return {name: known(value) for name, value in names.items()}

    def apply(self, times: AnyArray) -> AnyArray:
        """Radio times (datetime64 or seconds, the first sample first) on the telemetry clock."""
        array = np.asarray(times)
        if array.dtype.kind == "M":
            since = (array - array[0]) / np.timedelta64(1, "s")
            lag = self.radio_minus_telemetry_s + self.drift_s_per_s * (since - self.reference)
            return np.asarray(array - np.round(lag * 1e9).astype("timedelta64[ns]"))
        lag = self.radio_minus_telemetry_s + self.drift_s_per_s * (array - array[0] - self.reference)
        return np.asarray(array - lag)


class _Prediction:
    """A predicted level over the flight, sampled once and shifted as often as needed."""

    def __init__(self, first: float, step: float, columns: FloatArray) -> None:
        self.first, self.step, self.level = first, step, columns[:, 0]
        self.slope = np.gradient(self.level, step)
        self.terms = columns[:, 1:]

    def times(self) -> FloatArray:
        """Where it is sampled [s]."""
        return np.asarray(self.first + self.step * np.arange(len(self.level)))

    def beside(self, terms: ArrayLike) -> _Prediction:
        """The same level with free terms (n, q) beside it."""
        columns = np.column_stack([self.level, np.asarray(terms, dtype=np.float64)])
        del terms  # on a long flight a copy is a good part of the memory
        columns[~np.isfinite(columns).all(axis=1)] = np.nan
        return _Prediction(self.first, self.step, columns)

    def terms_at(self, t: FloatArray, *, slopes: bool = False) -> FloatArray:
        """Terms at t (..., n), a constant first (..., n, 1 + terms), or their slopes [1/s]; NaN as for :meth:`at`."""
        place = (t - self.first) / self.step
        left = np.floor(place).astype(np.int64)
        inside = (left >= 0) & (left < len(self.terms) - 1)
        left = np.where(inside, left, 0)
        result = np.empty((*t.shape, 1 + self.terms.shape[1]))
        result[..., 0] = 0.0 if slopes else 1.0
        if self.terms.shape[1]:
            weight = (place - left)[..., None]
            read = self._slopes if slopes else self.terms.__getitem__
            result[..., 1:] = read(left) * (1.0 - weight) + read(left + 1) * weight
            result[~inside, 1:] = np.nan
        return result

    def _slopes(self, rows: AnyArray) -> FloatArray:
        """Slopes of the terms at rows (n, terms), as :func:`numpy.gradient` has them for all."""
        before, after = np.maximum(rows - 1, 0), np.minimum(rows + 1, len(self.terms) - 1)
        return np.asarray((self.terms[after] - self.terms[before]) / ((after - before) * self.step)[:, None])

    def at(self, t: FloatArray) -> FloatArray:
        """Linear interpolation at t; NaN outside and next to NaN."""
        place = (t - self.first) / self.step
        left = np.floor(place).astype(np.int64)
        inside = (left >= 0) & (left < len(self.level) - 1)
        left = np.where(inside, left, 0)
        weight = place - left
        level = self.level[left] * (1.0 - weight) + self.level[left + 1] * weight
        return np.where(inside, level, np.nan)

    def smooth_at(self, t: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Cubic (Catmull-Rom) interpolation at t and its slope [1/s]: linear pieces would bias a lag in steep fades."""
        place = (t - self.first) / self.step
        left = np.floor(place).astype(np.int64)
        inside = (left >= 0) & (left < len(self.level) - 1)
        left = np.where(inside, left, 0)
        u = place - left
        a, b = self.level[left], self.level[left + 1]
        da, db = self.slope[left] * self.step, self.slope[left + 1] * self.step
        square, cube = 3.0 * (b - a) - 2.0 * da - db, 2.0 * (a - b) + da + db
        level = a + u * (da + u * (square + u * cube))
        slope = (da + u * (2.0 * square + 3.0 * u * cube)) / self.step
        return np.where(inside, level, np.nan), np.where(inside, slope, np.nan)

    def common(self, t: FloatArray, reach: float) -> BoolArray:
        """Instants whose prediction exists for every shift up to ``reach``."""
        bad = np.concatenate([[0], np.cumsum(~np.isfinite(self.level))])
        low = np.floor((t - reach - self.first) / self.step).astype(np.int64)
        high = np.ceil((t + reach - self.first) / self.step).astype(np.int64) + 1
        inside = (low >= 0) & (high <= len(self.level))
        low, high = np.clip(low, 0, len(self.level)), np.clip(high, 0, len(self.level))
        return np.asarray(inside & (bad[high] == bad[low]))


def estimate_lag(
    times: ArrayLike | pd.Series,
    measured_db: ArrayLike,
    predictor: Callable[[AnyArray], ArrayLike],
    *,
    window_s: float = LAG_WINDOW_S,
    resolution_s: float = 0.05,
    limit_s: float = LAG_LIMIT_S,
    drift: bool | None = None,
) -> LagFit:
    """Clock offset and drift between a radio log and the telemetry, from the data.

    Parameters
    ----------
    times : array_like, (n,)
        Instants of the radio samples, datetime64 (UTC) or seconds.
    measured_db : array_like, (n,)
        Levels [dB]; NaN does not count.
    predictor : callable
        ``predictor(times) -> level_db``: what should be measured at instants of the **telemetry** clock (free space,
        two-ray or a replay), in the kind of ``times``; NaN where there is no pose or no path. Called once. It may
        give columns (n, 1 + terms): the level, and terms whose coefficients are fitted anew at every lag, such as
        :func:`direction_terms` for antenna patterns that are not known.
    window_s : float
        Lags from ``-window_s`` to ``window_s`` are searched [s].
    resolution_s : float
        Spacing at which the predictor is sampled [s]; lags are resolved finer than that.
    limit_s : float
        Half width of the interval, and distance of a rival optimum, beyond which the verdict is "ambiguous" [s].
    drift : bool, optional
        Fit a drift too; by default for flights of ten minutes and more.

    Returns
    -------
    LagFit
        Nothing is applied here.

    Notes
    -----
    The residual's offset is free at every lag. A search over lags (and drifts) finds the valley, Gauss-Newton the
    bottom. Neighbouring residuals resemble each other (patterns, obstacles), so both run on residuals whitened by
    their AR(1) coefficient (Cochrane and Orcutt 1949, doi:10.1080/01621459.1949.10483290), and the standard error is a
    block sandwich. A lag is "ok" only if every lag farther than ``limit_s`` away is worse by a likelihood ratio of
    0.1 % significance.
    """
    lags = symmetric(window_s, max(0.1, resolution_s))
    samples = sample(times, measured_db, predictor, window_s=window_s, resolution_s=resolution_s)
    if isinstance(samples, str):
        return no_lag(samples, 0, window_s, lags)
    drifting = (samples.t[-1] - samples.t[0]) >= DRIFT_FROM_S if drift is None else drift
    return fit_lag(samples.t, samples.measured_db, samples.prediction, lags, limit_s, drifting)


@dataclass(frozen=True, slots=True, kw_only=True)
class Sampled:
    """Levels (n,) at seconds ``t`` after the first sample, in time order, and what is predicted along the flight."""

    t: FloatArray
    measured_db: FloatArray
    prediction: _Prediction


def sample(
    times: ArrayLike | pd.Series,
    measured_db: ArrayLike,
    predictor: Callable[[AnyArray], ArrayLike],
    *,
    window_s: float,
    resolution_s: float,
    origin_ns: int | None = None,
) -> Sampled | str:
    """Samples that have a level, and the prediction sampled around them; a reason where they are too few.

    Parameters
    ----------
    times : (n,)
        datetime64; NaT does not count.
    measured_db : (n,)
        NaN does not count [dB].
    predictor : callable
        Level (m,) [dB] at instants (m,).
    window_s : float
        Largest lag [s].
    resolution_s : float
        Step of the prediction [s].
    origin_ns : int, optional
        Zero of the seconds; by default the first instant.

    Returns
    -------
    Sampled or str
        Why there is nothing to fit, where it is a text.

    Raises
    ------
    ValueError
        As many times as levels, or as many predictions as instants, are not there.
    """
    stamp, levels = nanoseconds(times).ravel(), np.asarray(measured_db, dtype=np.float64).ravel()
    if stamp.shape != levels.shape:
        raise ValueError(f"{len(stamp)} times and {len(levels)} levels")
    timed = stamp != NO_TIME
    used = timed & np.isfinite(levels)
    if origin_ns is None:
        origin_ns = int(stamp[timed][0]) if timed.any() else 0
    order = np.argsort(stamp[used], kind="stable")
    t, m = ((stamp[used] - origin_ns) * 1e-9)[order], levels[used][order]
    if len(t) < FEWEST:
        return f"too few samples ({len(t)})"
    reach = window_s + 2.0 + DRIFT_LIMIT * (t[-1] - t[0])
    grid = np.arange(t[0] - reach, t[-1] + reach + resolution_s, resolution_s)
    as_time = np.asarray(times).dtype.kind not in "fiu"
    asked_ns = np.round(grid * 1e9).astype(np.int64) + origin_ns
    columns = np.asarray(predictor(asked_ns.astype("datetime64[ns]") if as_time else asked_ns * 1e-9), dtype=np.float64)
    columns = columns[:, None] if columns.ndim == 1 else columns
    if len(columns) != len(grid):
        raise ValueError(f"the predictor gave {len(columns)} levels for {len(grid)} instants")
    columns = np.where(np.isfinite(columns).all(axis=1, keepdims=True), columns, np.nan)
    prediction = _Prediction(float(grid[0]), resolution_s, columns)
    keep = prediction.common(t, window_s + resolution_s)
    if keep.sum() < max(FEWEST, 0.3 * len(t)):  # a short or gappy flight: let the samples vary with the lag
        keep = np.isfinite(prediction.at(t))
    if keep.sum() < FEWEST:
        return "no prediction at the radio samples: the two logs do not overlap"
    return Sampled(t=t[keep], measured_db=m[keep], prediction=prediction)


def symmetric(window: float, step: float) -> FloatArray:
    """Multiples of ``step`` from ``-window`` to ``window``, zero in the middle."""
    count = int(np.floor(window / step + 1e-9))
    return np.asarray(np.arange(-count, count + 1) * step, dtype=np.float64)


def no_lag(reason: str, n: int, window_s: float, lags: FloatArray) -> LagFit:
    """A failed fit.

    Parameters
    ----------
    reason : str
    n : int
        Samples there were.
    window_s : float
        Largest lag [s]: all the interval says.
    lags : (m,)
        Lags that would have been tried [s].

    Returns
    -------
    LagFit
        With the verdict "failed".
    """
    nan = float("nan")
    return LagFit(
        radio_minus_telemetry_s=nan,
        ci95_s=(-window_s, window_s),
        drift_s_per_s=0.0,
        drift_interval_s_per_s=(nan, nan),
        verdict="failed",
        reason=reason,
        reference=0.0,
        n=n,
        rmse_db=nan,
        rmse_unshifted_db=nan,
        window_s=window_s,
        curve_lag_s=lags,
        curve_rmse_db=np.full(len(lags), nan),
        evidence=np.zeros(len(lags)),
    )


def _whitened(residual: FloatArray, phi: float) -> FloatArray:
    """Residual without its mean and without what the sample before tells; NaN (no prediction) left out."""
    r = residual[np.isfinite(residual)]
    r = r - r.mean() if len(r) else r
    return r[1:] - phi * r[:-1]


def _cost(residual: FloatArray, phi: float, least: int) -> float:
    """Mean square of the whitened residual about its mean; infinite where too few samples have a prediction."""
    w = _whitened(residual, phi)
    return float(w.var()) if len(w) + 1 >= least else float("inf")


def _costs(residuals: FloatArray, phi: float, least: int) -> FloatArray:
    """:func:`_cost` of each row (lags, n), to the last digit; rows without a gap at once."""
    whole = np.isfinite(residuals).all(axis=1)
    costs = np.empty(len(residuals))
    if whole.any() and residuals.shape[1] >= least:
        r = residuals if whole.all() else residuals[whole]
        r = r - r.mean(axis=1, keepdims=True)
        costs[whole] = (r[:, 1:] - phi * r[:, :-1]).var(axis=1)
    else:
        whole = np.zeros(len(residuals), dtype=bool)
    for row in np.flatnonzero(~whole):
        costs[row] = _cost(residuals[row], phi, least)
    return costs


def _phi(residual: FloatArray) -> float:
    r = residual[np.isfinite(residual)]
    r = r - r.mean()
    power = float(r @ r)
    return float(np.clip(r[1:] @ r[:-1] / power, 0.0, 0.99)) if power > 0 else 0.0


def _explained(y: FloatArray, terms: FloatArray, phi: float) -> FloatArray:
    """What free terms (n, q) explain of y (n,), by least squares on values whitened with ``phi``."""
    ok = np.isfinite(y) & np.isfinite(terms).all(axis=1)
    a, b = terms[ok], y[ok]
    a, b = a[1:] - phi * a[:-1], b[1:] - phi * b[:-1]
    return np.asarray(np.einsum("ni,i->n", terms, _on_terms(a, b[None])[0]))


_NO_THREADS = 200_000
"""Multiplications of a matrix product for which BLAS wakes no threads (OpenBLAS: 262 144); see :func:`_on_terms`."""


def _without_terms(y: FloatArray, terms: FloatArray, phi: float) -> FloatArray:
    """Rows y (lags, n) less what their free terms (lags, n, q) explain of them; see :func:`_explained`."""
    whole = np.isfinite(y).all(axis=1) & np.isfinite(terms).all(axis=(1, 2))
    result = np.empty_like(y)
    for row in np.flatnonzero(~whole):
        result[row] = y[row] - _explained(y[row], terms[row], phi)
    if whole.any():
        few, some = y[whole], terms[whole]
        both = np.concatenate([some, few[..., None]], axis=-1)
        both = both[:, 1:] - phi * both[:, :-1]
        if both.shape[1] <= _NO_THREADS // both.shape[2] ** 2:
            products = both.mT @ both
        else:
            products = np.einsum("lni,lnj->lij", both, both)
        solved = [np.linalg.lstsq(p[:-1, :-1], p[:-1, -1], rcond=1e-12)[0] for p in products]
        result[whole] = few - np.einsum("lni,li->ln", some, np.stack(solved))
    return result


def _on_terms(terms: FloatArray, rows: FloatArray) -> FloatArray:
    """Least-squares coefficients (k, q) of each row (k, n) on terms (n, q).

    Normal equations, as the few terms are of order one, with a floor under the rank. By einsum: for products this
    small, BLAS wakes threads and waits for them, which on a busy machine took hundred times longer.
    """
    normal, right = np.einsum("ni,nj->ij", terms, terms), np.einsum("ni,kn->ik", terms, rows)
    return np.asarray(np.linalg.lstsq(normal, right, rcond=1e-12)[0].T)


DIRECTION_TERMS = 12
"""Columns of :func:`direction_terms`."""


def direction_terms(azimuth_deg: ArrayLike, elevation_deg: ArrayLike, relative_deg: ArrayLike) -> FloatArray:
    """Smooth terms that stand in for unknown antenna patterns when a lag is estimated.

    Parameters
    ----------
    azimuth_deg, elevation_deg : array_like, (n,)
        Direction of the UAV from the tower (clockwise from north; above the horizon).
    relative_deg : array_like, (n,)
        Direction of the tower relative to the UAV's nose; it turns when the UAV does, which is what ties a level to
        the telemetry clock.

    Returns
    -------
    ndarray, (n, 12)
        Two harmonics of either azimuth, elevation and its square, and the first harmonic of the relative direction
        times elevation.
    """
    azimuth, elevation, relative = (
        np.radians(np.asarray(a, dtype=np.float64)) for a in (azimuth_deg, elevation_deg, relative_deg)
    )
    waves = [f(k * angle) for angle in (azimuth, relative) for k in (1, 2) for f in (np.cos, np.sin)]
    tilted = [f(relative) * elevation for f in (np.cos, np.sin)]
    return np.column_stack([elevation, elevation**2, *waves, *tilted])


def terms_from(place_m: FloatArray, position_m: FloatArray, heading_deg: FloatArray) -> FloatArray:
    """:func:`direction_terms` (n, 12) of a UAV as seen from a tower.

    Parameters
    ----------
    place_m : (1, 3) or (n, 3)
        Of the tower [m].
    position_m : (n, 3)
        Of the UAV: east, north, up [m].
    heading_deg : (n,)
        Of its nose, clockwise from north.
    """
    line = position_m - place_m
    azimuth = np.degrees(np.arctan2(line[:, 0], line[:, 1]))
    elevation = np.degrees(np.arctan2(line[:, 2], np.hypot(line[:, 0], line[:, 1])))
    return direction_terms(azimuth, elevation, azimuth + 180.0 - heading_deg)


def fit_lag(
    t: FloatArray, m: FloatArray, prediction: _Prediction, lags: FloatArray, limit_s: float, drifting: bool
) -> LagFit:
    """Search, refine, judge.

    Parameters
    ----------
    t, m : (n,)
        Times [s] and levels [dB].
    prediction : callable
        Level (n,) [dB] at times (n,) [s].
    lags : (m,)
        Lags to try first [s].
    limit_s : float
        Largest lag [s].
    drifting : bool
        Fit a drift, too.

    Returns
    -------
    LagFit
        The lag (radio minus telemetry) [s], its interval, the drift, and the verdict.
    """
    middle = 0.5 * float(t[0] + t[-1])
    few = slice(None, None, -(-len(t) // _SCANNED))
    ts, ms = t[few], m[few]
    least = max(FEWEST, len(ts) // 2)

    def residual(lag: float, rate: float, phi: float = 0.0) -> FloatArray:
        at = ts - lag - rate * (ts - middle)
        y = ms - prediction.at(at)
        return y - _explained(y, prediction.terms_at(at), phi) if prediction.terms.shape[1] else y

    def costs(tried: FloatArray, rate: float, phi: float) -> FloatArray:
        free = prediction.terms.shape[1]
        variances = np.empty(len(tried))
        drifted = rate * (ts - middle)
        for block in range(0, len(tried), rows := max(1, (_HELD_FREE if free else _HELD) // len(ts))):
            part = slice(block, block + rows)
            at = ts - tried[part, None] - drifted
            y = ms - prediction.at(at)
            if free:
                y = _without_terms(y, prediction.terms_at(at), phi)
            variances[part] = _costs(y, phi, least)
        return variances

    def scan(phi: float, rate: float) -> FloatArray:
        return costs(lags, rate, phi)

    plain = scan(0.0, 0.0)
    if not np.isfinite(plain).any():
        return no_lag("no prediction at the radio samples: the two logs do not overlap", 0, float(lags[-1]), lags)
    phi = _phi(residual(lags[best_of(plain, lags)], 0.0))
    # free terms bend towards a drift before a scan can tell; the refinement fits it from zero then
    scanned = drifting and not prediction.terms.shape[1]
    rates = _rates(float(t[-1] - t[0]), float(lags[1] - lags[0])) if scanned else np.zeros(1)
    table = np.stack([scan(phi, rate) for rate in rates])
    row, column = divmod(best_of(table, np.broadcast_to(lags, table.shape)), len(lags))
    still = len(rates) // 2
    with np.errstate(divide="ignore", invalid="ignore"):  # a residual of nothing at all
        gain = len(ts) * np.log(table[still].min() / table[row, column])
    if not gain > _RIVAL:  # no drift where none shows
        row, column = still, best_of(table[still], lags)
    near = _between(table[row], lags, lambda tried: costs(tried, float(rates[row]), phi))
    start = np.array([near, rates[row]])[: 2 if drifting else 1]
    (lag, rate), (width, rate_width), rmse = _refine(t, m, prediction, middle, start)
    width = float(np.hypot(width, _INTERPOLATED * prediction.step))
    # last entry: a constant instead of the prediction
    cost = np.append(table.min(axis=0), _cost(np.where(np.isfinite(residual(lag, rate)), ms, np.nan), phi, least))
    ratio = _likelihood_ratios(cost, _whitened(residual(float(lags[column]), float(rates[row]), phi), phi))
    verdict, reason, interval = _judge(lag, width, ratio[:-1], lags, limit_s)
    if verdict == "ok" and ratio[-1] <= _RIVAL:
        verdict, reason = "ambiguous", "at its best lag the prediction explains no more than a constant"
    nan = float("nan")
    return LagFit(
        radio_minus_telemetry_s=lag,
        ci95_s=interval,
        drift_s_per_s=rate,
        drift_interval_s_per_s=(rate - rate_width, rate + rate_width) if drifting else (nan, nan),
        verdict=verdict,
        reason=reason,
        reference=middle,
        n=len(t),
        rmse_db=rmse,
        rmse_unshifted_db=float(np.sqrt(plain[len(lags) // 2])),
        window_s=float(lags[-1]),
        curve_lag_s=lags,
        curve_rmse_db=np.sqrt(plain),
        evidence=ratio[:-1],
    )


def _between(cost: FloatArray, lags: FloatArray, costs_at: Callable[[FloatArray], FloatArray]) -> float:
    """Best lag on a ten times finer grid around the five best of the scan: interference makes valleys narrower."""
    step = float(lags[1] - lags[0])
    coarse = lags[np.argsort(np.where(np.isfinite(cost), cost, np.inf), kind="stable")[:5]]
    fine = (coarse[:, None] + np.arange(-6, 7) * (step / 10.0)).ravel()
    return float(fine[best_of(costs_at(fine), fine)])


def _rates(span_s: float, lag_step_s: float) -> FloatArray:
    """Drifts to try: from one to the next, the lag at the ends of the flight changes by about one lag step."""
    return symmetric(DRIFT_LIMIT, min(DRIFT_LIMIT, 2.0 * lag_step_s / span_s))


def best_of(cost: FloatArray, lags: FloatArray) -> int:
    """Flat index of the least cost; costs that are equal but for rounding go to the lag nearest zero."""
    flat = cost.ravel()
    near = np.flatnonzero(flat <= np.nanmin(flat) * (1.0 + 1e-12))
    return int(near[np.argmin(np.abs(np.asarray(lags).ravel()[near]))])


_INTERPOLATED = 0.05
"""Share of the prediction's spacing that interpolation in steep fades may move a lag by: 0.02 to 0.03 were measured."""

_HALVED = 12
"""Halvings of a step after which the place is as good as the machine tells."""


def _refine(
    t: FloatArray, m: FloatArray, prediction: _Prediction, middle: float, start: FloatArray
) -> tuple[tuple[float, float], tuple[float, float], float]:
    """Gauss-Newton, its steps halved where they lead up, from the scan's optimum.

    Gives (lag, drift), half widths of their 95 % intervals, RMSE [dB].
    Variable projection: constant and free terms are solved for at every step, so only lag and drift iterate.
    """
    scale = np.array([1.0, max(1.0, 0.5 * float(t[-1] - t[0]))])[: len(start)]
    relative = np.stack([np.ones(len(t)), (t - middle) / scale[-1]])[: len(start)]

    def evaluate(shift: FloatArray, phi: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Residual (n,); residual and Jacobian whitened, without what a constant and the free terms explain."""
        at = t - shift @ relative
        level, slope = prediction.smooth_at(at)
        y, terms = m - level, prediction.terms_at(at)
        ok = np.isfinite(y) & np.isfinite(slope) & np.isfinite(terms).all(axis=1)
        y, slope, terms, along = y[ok], slope[ok], terms[ok], relative[:, ok]
        base, b = terms[1:] - phi * terms[:-1], y[1:] - phi * y[:-1]
        coefficients = _on_terms(base, b[None])[0]
        if terms.shape[1] > 1:  # the free terms move with the lag too
            moved = prediction.terms_at(at, slopes=True)[ok]
            slope = slope + np.einsum("ni,i->n", moved, coefficients)
        jacobian = slope * along
        columns = np.vstack([b, jacobian[:, 1:] - phi * jacobian[:, :-1]])
        columns = columns - np.einsum("ki,ni->kn", _on_terms(base, columns), base)
        return y - np.einsum("ni,i->n", terms, coefficients), columns[0], columns[1:]

    shift = start * scale
    phi = _phi(evaluate(shift, 0.0)[0])
    here = evaluate(shift, phi)
    for _ in range(20):
        _, rw, jw = here
        step = -_on_terms(jw.T, rw[None])[0]
        size = float(np.abs(step).max())
        step = step * min(1.0, 0.3 / max(size, 1e-12))  # the valley is no wider than fractions of a second
        for _ in range(_HALVED):  # steep fades: a whole step may lead to the other side, and higher up
            there = evaluate(shift + step, phi)
            if size < 1e-5 or np.mean(there[1] ** 2) <= np.mean(rw**2):
                break
            step = 0.5 * step
        else:
            break  # nowhere lower
        shift, here = shift + step, there
        if size < 1e-5:
            break
    beyond = len(shift) > 1 and abs(shift[1] / scale[1]) > 1.2 * DRIFT_LIMIT
    if beyond or np.abs(shift - start * scale).max() > 0.5:  # no valley here: keep what the scan found
        shift = start * scale
    r, rw, jw = evaluate(shift, phi)
    width = _sandwich(rw, jw) / scale
    refined = np.zeros(2)
    refined[: len(start)] = shift / scale
    reach = np.full(2, np.nan)
    reach[: len(start)] = width
    return (float(refined[0]), float(refined[1])), (float(reach[0]), float(reach[1])), float(np.sqrt(np.mean(r**2)))


def _blocks(values: FloatArray) -> FloatArray:
    """Sums over blocks of 2 n^(1/3) neighbours along the last axis; the remainder is left out."""
    n = values.shape[-1]
    length = max(4, round(2.0 * n ** (1.0 / 3.0)))
    count = max(1, n // length)
    return np.asarray(values[..., : count * length].reshape(*values.shape[:-1], count, -1).sum(axis=-1))


def _sandwich(residual: FloatArray, jacobian: FloatArray) -> FloatArray:
    """Half widths of 95 % intervals of least-squares parameters whose residuals remember each other."""
    from scipy.special import stdtrit

    normal = jacobian @ jacobian.T
    if np.linalg.matrix_rank(normal) < len(normal):
        return np.full(len(normal), np.inf)
    scores = _blocks(jacobian * residual)
    count = scores.shape[1]
    bread = np.linalg.inv(normal)
    covariance = bread @ (scores @ scores.T) @ bread * count / max(count - 1, 1)
    return np.asarray(stdtrit(max(count - 1, 1), 0.975) * np.sqrt(np.diag(covariance)))


def _likelihood_ratios(cost: FloatArray, whitened: FloatArray) -> FloatArray:
    """Log-likelihood ratio (times two) by which every lag, and last a constant, is worse than the best lag."""
    sums = _blocks(whitened - whitened.mean())
    long_run = float(np.mean(sums**2)) * len(sums) / len(whitened)
    # correlation that AR(1) left over takes evidence away; anticorrelation does not add any
    size = len(whitened) * min(1.0, float(whitened.var()) / long_run) if long_run > 0 else len(whitened)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = size * np.log(cost / np.min(cost[:-1]))
    return np.asarray(np.where(np.isfinite(cost), np.nan_to_num(ratio, nan=0.0, posinf=np.inf), np.inf))


def _judge(
    lag: float, width: float, ratio: FloatArray, lags: FloatArray, limit_s: float
) -> tuple[Literal["ok", "ambiguous", "failed"], str, tuple[float, float]]:
    """Verdict, reason and interval from the width of the valley and from its rivals."""
    possible = lags[ratio <= 3.84]
    low, high = min(lag - width, float(possible.min())), max(lag + width, float(possible.max()))
    interval = (max(low, float(lags[0])), min(high, float(lags[-1])))
    far = np.abs(lags - lag) > limit_s
    rivals = lags[far & (ratio <= _RIVAL)]
    if max(lag - low, high - lag) > limit_s or len(rivals):
        flat = np.median(ratio[np.isfinite(ratio)]) <= _RIVAL if np.isfinite(ratio).any() else True
        why = (
            "the level hardly depends on the lag (a flat flight, or a model that explains too little)"
            if flat
            else f"other lags explain the data as well, such as {rivals[0]:+.1f} s" if len(rivals)
            else "the interval is too wide"
        )  # fmt: skip
        return "ambiguous", why, interval
    if abs(lag) > _NEAR_EDGE * float(lags[-1]):
        return "failed", "the best lag lies near the edge of the window: widen it, or look at the clocks", interval
    return "ok", "", interval


def combine_lags(fits: Sequence[LagFit], *, limit_s: float = LAG_LIMIT_S) -> LagFit:
    """One lag for channels that share a clock, from the evidence of all of them.

    Parameters
    ----------
    fits : sequence of LagFit
        Of the same window, such as the channels of one receiver. Failed ones take no part.
    limit_s : float
        As in :func:`estimate_lag`.

    Returns
    -------
    LagFit
        Log-likelihood ratios add up; RMSE is pooled, the drift is that of the channel with the narrowest interval.

    Raises
    ------
    ValueError
        If there is no fit, or windows differ.
    """
    if not fits or any(len(fit.curve_lag_s) != len(fits[0].curve_lag_s) for fit in fits):
        raise ValueError("lags to combine must be at least one, and searched over the same window")
    finite_fits = [fit for fit in fits if np.isfinite(fit.radio_minus_telemetry_s)]
    if len(finite_fits) < 2:
        return finite_fits[0] if finite_fits else fits[0]
    lags = finite_fits[0].curve_lag_s
    total = np.sum([np.minimum(fit.evidence, 1e6) for fit in finite_fits], axis=0) * _INDEPENDENT
    total = total - total.min()
    sharp = min(finite_fits, key=lambda fit: fit.ci95_s[1] - fit.ci95_s[0])
    best = float(lags[best_of(np.where(total > 0, total, 0.0) + 1.0, lags)])
    step = float(lags[1] - lags[0])
    near = abs(sharp.radio_minus_telemetry_s - best) <= step  # the sharpest fit is finer than the grid
    # valleys narrower than a step fall between its points: fits that agree among themselves are believed
    near |= all(abs(fit.radio_minus_telemetry_s - sharp.radio_minus_telemetry_s) <= 0.5 * step for fit in finite_fits)
    lag = sharp.radio_minus_telemetry_s if near else best
    width = 0.5 * float(lags[1] - lags[0])
    if near and sharp.verdict == "ok":
        width = 0.5 * (sharp.ci95_s[1] - sharp.ci95_s[0])
    verdict, reason, interval = _judge(lag, width, total, lags, limit_s)
    count = sum(fit.n for fit in finite_fits)

    def pooled(name: str) -> float:
        return float(np.sqrt(sum(fit.n * getattr(fit, name) ** 2 for fit in finite_fits) / count))

    curve = np.sqrt(np.sum([fit.n * fit.curve_rmse_db**2 for fit in finite_fits], axis=0) / count)
    return LagFit(
        radio_minus_telemetry_s=lag,
        ci95_s=interval,
        drift_s_per_s=sharp.drift_s_per_s,
        drift_interval_s_per_s=sharp.drift_interval_s_per_s,
        verdict=verdict,
        reason=reason,
        reference=sharp.reference,
        n=count,
        rmse_db=pooled("rmse_db"),
        rmse_unshifted_db=pooled("rmse_unshifted_db"),
        window_s=finite_fits[0].window_s,
        curve_lag_s=lags,
        curve_rmse_db=curve,
        evidence=total,
    )
