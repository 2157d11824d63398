"""Likely cause of a level error: one trouble of the measurement or of the model, chosen by likelihood.

Each trouble changes the predicted level in its own way. Its free numbers are searched, the offset is fitted, and the
residual counts as first-order autoregressive noise, so that slow fading is no trouble. A trouble is named where it
raises the log likelihood by more than ``_MARGIN`` beyond the cost of its numbers (Schwarz) and takes a tenth off the
RMSE. Intervals hold the values
whose log likelihood lies within 1.92 of the best.

=================  =============================================  ==========================
trouble            predicted level with it                        free numbers beside offset
=================  =============================================  ==========================
``clock``          s(t - lag)                                     lag
``heading``        the antenna turned by an angle                 angle
``tower``          that of another tower                          which
``pattern``        s + harmonics of the UAV antenna's azimuth     6, counted as 3
``blocked``        s - loss within a sector seen from the tower   two ends, loss
``floor``          max(s, floor)                                  floor
``gain step``      s + step after an instant                      instant, step
=================  =============================================  ==========================

Reference: Schwarz, Annals of Statistics 6 (1978) 461, doi 10.1214/aos/1176344136.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from ...common.units import BoolArray, FloatArray

# Samples are averaged over so long [s].
BIN_S = 1.0
_FEWEST_BINS = 60
# Log likelihood that a trouble must gain beyond its cost.
_MARGIN = 4.0
# A trouble that takes less than this share off the RMSE is not the cause of the error.
_LEAST_SHARE = 0.1
# Half of the 95 % point of chi-squared with one degree of freedom.
_NEAR = 1.92
_Estimate = tuple[float, float, float]
_NOTHING: _Estimate = (math.nan, math.nan, math.nan)
_PHI = np.array([0.0, 0.3, 0.5, 0.7, 0.8, 0.87, 0.92, 0.95, 0.97, 0.985, 0.995])
_LAGS_S = np.arange(-10.0, 10.25, 0.5)


@dataclass(frozen=True, slots=True, kw_only=True)
class LevelEvidence:
    """Evidence from which a cause is told: one channel of a flight.

    Parameters
    ----------
    time_s : (n,)
        In order.
    measured_db, predicted_db : (n,)
        Before any offset; NaN where there is none.
    uav_azimuth_deg, uav_elevation_deg : (n,)
        Direction of the tower in the frame of the UAV's antenna.
    tower_azimuth_deg : (n,)
        Direction of the UAV seen from the tower, clockwise from north.
    turned_db : mapping of float to (n,)
        Change of the predicted level where the heading is greater by so many degrees; empty for antennas without a
        pattern.
    other_towers_db : mapping of str to (n,)
        Predicted level of each other tower of the site.
    clock_confirmed : bool
        Was the radio clock found right? Then it is no cause.
    """

    time_s: FloatArray
    measured_db: FloatArray
    predicted_db: FloatArray
    uav_azimuth_deg: FloatArray
    uav_elevation_deg: FloatArray
    tower_azimuth_deg: FloatArray
    turned_db: Mapping[float, FloatArray] = field(default_factory=dict)
    other_towers_db: Mapping[str, FloatArray] = field(default_factory=dict)
    clock_confirmed: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Cause:
    """A named cause, or ``none``.

    ``estimate`` is its number (lag [s], angle [deg], loss, floor or step [dB], NaN else) and ``ci95`` its interval;
    ``where`` what else must be said: the tower's name, the sector [deg], the instant [s]. ``rmse_db`` and
    ``rmse_with_db`` are the errors without and with it; ``gain`` the log likelihood that it gains beyond its cost.
    """

    name: str
    estimate: float = math.nan
    ci95: tuple[float, float] = (math.nan, math.nan)
    where: str = ""
    rmse_db: float = math.nan
    rmse_with_db: float = math.nan
    gain: float = 0.0


_NO_CAUSE = Cause(name="none")


@dataclass(frozen=True, slots=True)
class _Fit:
    """Log likelihood and residual of a prediction with its best offset."""

    log_likelihood: float
    residual_db: FloatArray


def likely_cause(evidence: LevelEvidence) -> Cause:
    """The trouble that explains the error of a channel best; ``none`` where no trouble is shown.

    Parameters
    ----------
    evidence : LevelEvidence

    Returns
    -------
    Cause
    """
    binned = _binned(evidence)
    if binned is None:
        return _NO_CAUSE
    plain = _fitted(binned.measured_db - binned.predicted_db)
    unit = 0.5 * math.log(len(binned.time_s))
    scored = [
        (fit.log_likelihood - plain.log_likelihood - cost * unit, name, estimate, where, fit)
        for cost, name, estimate, where, fit in _troubles(binned)
    ]
    gain, name, estimate, where, fit = max(
        scored, key=lambda trial: trial[0], default=(0.0, "none", _NOTHING, "", plain)
    )
    rmse, rmse_with = (float(np.sqrt(np.mean(model.residual_db**2))) for model in (plain, fit))
    if gain < _MARGIN or rmse_with > (1.0 - _LEAST_SHARE) * rmse:
        return _NO_CAUSE
    value, low, high = estimate
    return Cause(
        name=name,
        estimate=value,
        ci95=(low, high),
        where=where,
        rmse_db=rmse,
        rmse_with_db=rmse_with,
        gain=float(gain),
    )


def _binned(evidence: LevelEvidence) -> LevelEvidence | None:
    """Means over :data:`BIN_S` of the samples with both levels; None where they are too few."""
    finite = np.isfinite(evidence.measured_db) & np.isfinite(evidence.predicted_db)
    if not finite.any():
        return None
    _, place = np.unique(np.floor(evidence.time_s[finite] / BIN_S), return_inverse=True)
    count = np.bincount(place).astype(np.float64)
    if len(count) < _FEWEST_BINS:
        return None

    def mean(values: FloatArray) -> FloatArray:
        return np.asarray(np.bincount(place, values[finite]) / count)

    def direction(values: FloatArray) -> FloatArray:
        turn = np.exp(1j * np.radians(values[finite]))
        return np.degrees(np.angle(np.bincount(place, turn.real) + 1j * np.bincount(place, turn.imag)))

    return LevelEvidence(
        time_s=mean(evidence.time_s),
        measured_db=mean(evidence.measured_db),
        predicted_db=mean(evidence.predicted_db),
        uav_azimuth_deg=direction(evidence.uav_azimuth_deg),
        uav_elevation_deg=mean(evidence.uav_elevation_deg),
        tower_azimuth_deg=direction(evidence.tower_azimuth_deg),
        turned_db={angle: mean(change) for angle, change in evidence.turned_db.items()},
        other_towers_db={name: mean(level) for name, level in evidence.other_towers_db.items()},
        clock_confirmed=evidence.clock_confirmed,
    )


def _fitted(residual: FloatArray, columns: FloatArray | None = None) -> _Fit:
    """Best offset and coefficients of columns (n, k) under first-order autoregressive noise, its memory searched."""
    n = len(residual)
    design = np.ones((n, 1)) if columns is None else np.column_stack([np.ones(n), columns])
    best = _Fit(-math.inf, residual)
    for phi in _PHI.tolist():
        root = math.sqrt(1.0 - phi**2)
        white_y = np.concatenate(([root * residual[0]], residual[1:] - phi * residual[:-1]))
        white_x = np.concatenate((root * design[:1], design[1:] - phi * design[:-1]))
        coefficients = np.linalg.lstsq(white_x, white_y, rcond=None)[0]
        variance = float(np.mean((white_y - white_x @ coefficients) ** 2))
        likelihood = -0.5 * n * math.log(max(variance, 1e-12)) + math.log(root)
        if likelihood > best.log_likelihood:
            best = _Fit(likelihood, residual - design @ coefficients)
    centred = best.residual_db - best.residual_db.mean()
    return _Fit(best.log_likelihood, centred)


# Of six harmonics; with ``_MARGIN`` chance reaches it in fewer than one of a thousand.
_PATTERN_COST = 3.0
_Trouble = tuple[str, _Estimate, str, _Fit]


def _troubles(e: LevelEvidence) -> Iterator[tuple[float, str, _Estimate, str, _Fit]]:
    """Cost in free numbers, name, estimate, place and fit of the best of each trouble."""
    residual = e.measured_db - e.predicted_db
    if not e.clock_confirmed:
        lags = [lag for lag in _LAGS_S.tolist() if abs(lag) >= 1.0]
        clocks = {lag: _fitted(e.measured_db - np.interp(e.time_s - lag, e.time_s, e.predicted_db)) for lag in lags}
        yield 1.0, *_profiled("clock", clocks)
    if e.turned_db:
        heading = _profiled("heading", {angle: _fitted(residual - turn) for angle, turn in e.turned_db.items()})
        yield 1.0, *heading
        # a turned antenna leaves nothing that depends on the direction: what does is another antenna
        further = _fitted(residual - e.turned_db[heading[1][0]], _harmonics(e))
        yield 1.0 + _PATTERN_COST, "pattern", _NOTHING, "", further
    if e.other_towers_db:
        fits = {name: _fitted(e.measured_db - level) for name, level in e.other_towers_db.items()}
        name = max(fits, key=lambda tower: fits[tower].log_likelihood)
        yield 1.0, "tower", _NOTHING, name, fits[name]
    waves = _harmonics(e)
    yield _PATTERN_COST, "pattern", _NOTHING, "", _fitted(residual, waves)
    if (sector := _blocked(e, residual)) is not None:
        yield 3.0, *sector
    yield 2.0, *_floored(e)
    if (step := _stepped(e, residual)) is not None:
        yield 2.0, *step


def _profiled(name: str, fits: Mapping[float, _Fit]) -> _Trouble:
    """The best of some values, and the range of those that are nearly as likely, half way to the next that are not."""
    best = max(fits, key=lambda value: fits[value].log_likelihood)
    tried = sorted(fits)
    near = [i for i, value in enumerate(tried) if fits[value].log_likelihood >= fits[best].log_likelihood - _NEAR]
    low, high = max(near[0] - 1, 0), min(near[-1] + 1, len(tried) - 1)
    ends = 0.5 * (tried[near[0]] + tried[low]), 0.5 * (tried[near[-1]] + tried[high])
    return name, (best, *ends), "", fits[best]


def _harmonics(e: LevelEvidence) -> FloatArray:
    """Columns of a smooth gain over the directions of the UAV's antenna."""
    azimuth, elevation = np.radians(e.uav_azimuth_deg), np.radians(e.uav_elevation_deg)
    columns = [wave(k * azimuth) for k in (1, 2) for wave in (np.cos, np.sin)]
    columns += [np.sin(elevation), np.sin(elevation) ** 2]
    return np.column_stack([column - column.mean() for column in columns])


def _shift(residual: FloatArray, masks: BoolArray, phi: float) -> tuple[FloatArray, FloatArray]:
    """Shift inside each mask (m, n), and the squares that it takes off the whitened residual, offset fitted."""
    y = residual[1:] - phi * residual[:-1]
    x = masks[:, 1:].astype(np.float64) - phi * masks[:, :-1]
    y, x = y - y.mean(), x - x.mean(axis=1, keepdims=True)
    power = np.einsum("ij,ij->i", x, x)
    shift = np.divide(x @ y, power, out=np.zeros(len(x)), where=power > 1e-9)
    return shift, shift**2 * power


def _bounded(residual: FloatArray, mask: BoolArray, shift: float, phi: float) -> _Estimate:
    """A shift inside a mask with its 95 % interval."""
    y, x = residual[1:] - phi * residual[:-1], mask[1:].astype(np.float64) - phi * mask[:-1]
    y, x = y - y.mean(), x - x.mean()
    half = 1.96 * math.sqrt(float(np.mean((y - shift * x) ** 2)) / float(x @ x))
    return shift, shift - half, shift + half


_SEARCHED_PHI = (0.5, 0.8, 0.95)
_WIDTHS_DEG = (10.0, 15.0, 20.0, 30.0, 45.0, 60.0, 90.0)
_LEAST_BINS = 5
_MOST_STARTS = 600


def _blocked(e: LevelEvidence, residual: FloatArray) -> _Trouble | None:
    """A loss in a sector of directions from the tower: searched by 5 degrees, then by one."""
    coarse = [(first, width) for width in _WIDTHS_DEG for first in np.arange(0.0, 360.0, 5.0).tolist()]
    best = None
    for phi in _SEARCHED_PHI:
        sector = _best_sector(e, residual, coarse, phi)
        if sector is None:
            continue
        around = [(sector[0] + i, max(sector[1] + j, 2.0)) for i in range(-6, 7) for j in range(-8, 9)]
        first, width = _best_sector(e, residual, around, phi) or sector
        mask = (e.tower_azimuth_deg - first) % 360.0 < width
        fit = _fitted(residual, mask[:, None].astype(np.float64))
        if best is None or fit.log_likelihood > best[3].log_likelihood:
            shift = float(_shift(residual, mask[None, :], phi)[0][0])
            value, low, high = _bounded(residual, mask, shift, phi)
            best = ("blocked", (-value, -high, -low), f"{first % 360:.0f} to {(first + width) % 360:.0f}", fit)
    return best


def _best_sector(
    e: LevelEvidence, residual: FloatArray, sectors: Sequence[tuple[float, float]], phi: float
) -> tuple[float, float] | None:
    """Start and width [deg] of the sector whose loss takes off most; None where no sector has a loss."""
    turned = {first: (e.tower_azimuth_deg - first) % 360.0 for first in {first for first, _ in sectors}}
    masks = np.array([turned[first] < width for first, width in sectors])
    shift, gain = _shift(residual, masks, phi)
    inside = masks.sum(axis=1)
    possible = (inside >= _LEAST_BINS) & (masks.shape[1] - inside >= _LEAST_BINS) & (shift < 0.0)
    return sectors[int(np.argmax(np.where(possible, gain, -1.0)))] if possible.any() else None


def _stepped(e: LevelEvidence, residual: FloatArray) -> _Trouble | None:
    """A shift that lasts from an instant to the end."""
    n = len(residual)
    starts = np.arange(_LEAST_BINS * 2, n - _LEAST_BINS * 2)
    if not len(starts):
        return None
    starts = starts[:: 1 + len(starts) // _MOST_STARTS]
    masks = np.arange(n)[None, :] >= starts[:, None]
    steps = []
    for phi in _SEARCHED_PHI:
        shift, gain = _shift(residual, masks, phi)
        at = int(np.argmax(gain))
        fit = _fitted(residual, masks[at][:, None].astype(np.float64))
        steps.append((_bounded(residual, masks[at], float(shift[at]), phi), f"{e.time_s[starts[at]]:.0f}", fit))
    return "gain step", *max(steps, key=lambda step: step[2].log_likelihood)


def _floored(e: LevelEvidence) -> _Trouble:
    """A receiver that shows no level below its floor; what it shows there spreads less."""
    floors = np.quantile(e.measured_db, np.linspace(0.02, 0.7, 35))
    return _profiled("floor", {floor: _above_floor(e, floor) for floor in floors.tolist()})


def _above_floor(e: LevelEvidence, floor: float) -> _Fit:
    offset = float(np.median(e.measured_db - e.predicted_db))
    for _ in range(4):
        above = e.predicted_db + offset > floor
        if min(above.sum(), (~above).sum()) < _LEAST_BINS:
            return _Fit(-math.inf, e.measured_db - e.predicted_db)
        offset = float(np.mean((e.measured_db - e.predicted_db)[above]))
    residual = e.measured_db - np.maximum(e.predicted_db + offset, floor)
    if np.mean(e.measured_db < floor - _BELOW_DB) > _MOST_BELOW:  # what is measured below it is no floor
        return _Fit(-math.inf, e.measured_db - e.predicted_db)
    spread = np.where(above, residual[above].std(), residual[~above].std()).clip(_LEAST_SPREAD_DB)
    fit = _fitted(residual / spread)
    return _Fit(fit.log_likelihood - float(np.log(spread).sum()), residual)


_LEAST_SPREAD_DB = 0.2
_BELOW_DB, _MOST_BELOW = 2.0, 0.02
