"""Gaussian process of the residual of a prediction over position, height, direction and time of flight.

The same covariance is used for maps, routes and held-out blocks::

    residual = mean + place(east, north, up, direction) + offset(flight) + drift(flight, time) + noise

``mean`` is an unknown constant. All flights share ``place``, with covariance ``sd^2 exp(-d / length) exp(-dz / height)
exp(-chord^2 / 2 turn^2)``. Each flight has its own ``offset``, and its own ``drift`` with covariance ``sd^2 exp(-dt /
drift_s)``. The lengths have physical bounds (:data:`BOUNDS`), because an unbounded fit would mistake fading for a field
over positions. Channels are fitted separately.

:class:`FlownFlights` computes the standard deviation after a planned flight. The standard deviation of a Gaussian
process depends only on the directions and positions of the route, not on the levels. In this class, :mod:`.gains`
models the antennas, and a field over positions models the rest of the residual.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np

from ..common.errors import InputError
from ..common.gaussian import Factor
from ..common.units import FloatArray, IntArray, spread_out
from .gains import USUAL_OFFSET_DB, GainFit, GainModel, LinkSamples, fit_gain, offset_sd_db

Part = Literal["mean", "place", "offset", "drift"]
PARTS: tuple[Part, ...] = ("mean", "place", "offset", "drift")

# Prior standard deviation of the unknown mean. The value is so large that it does not restrict the mean.
MEAN_SD_DB = 100.0

# Largest number of rows that are used. The covariance of so many rows takes 72 MB.
_MOST_ROWS = 3000

# Largest number of rows per channel from which scales are fitted.
FIT_ROWS = 700

# Number of targets per block. The number limits the memory that is used.
AT_ONCE = 1024

# Code of a flight without rows.
NEW_FLIGHT = -1


@dataclass(frozen=True, slots=True, kw_only=True)
class FieldModel:
    """The strengths [dB] and scales of the covariance.

    Parameters
    ----------
    place_sd_db, length_m, height_m, turn : float
        The field over positions: its standard deviation, horizontal and vertical length [m], and chord of the
        direction. With an infinite ``turn`` the field does not depend on direction.
    offset_sd_db : float
        Standard deviation of the offset between flights. If fitted, it is estimated by :func:`_offset_sd_of`.
    drift_sd_db, drift_s : float
        Standard deviation and correlation time [s] of the drift within a flight.
    noise_sd_db : float
        Standard deviation of the noise of a row.
    """

    place_sd_db: float = 2.0
    length_m: float = 50.0
    height_m: float = 30.0
    turn: float = 0.7
    offset_sd_db: float = USUAL_OFFSET_DB
    drift_sd_db: float = 1.5
    drift_s: float = 60.0
    noise_sd_db: float = 1.5


# Bounds of the parameters that can be fitted, by name.
BOUNDS: dict[str, tuple[float, float]] = {
    "place_sd_db": (0.05, 12.0),
    "length_m": (10.0, 300.0),
    "height_m": (5.0, 100.0),
    "turn": (0.2, 5.0),
    "drift_sd_db": (0.05, 12.0),
    "drift_s": (3.0, 600.0),
    "noise_sd_db": (0.2, 12.0),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Rows:
    """The positions and times of the samples of one channel, or of targets.

    Parameters
    ----------
    position_m : (n, 3)
        East, north, up [m].
    direction : (n, 3) or (n, headings, 3)
        Unit vector towards the tower in the body frame. Targets can have several headings with equal weights.
    time_s : (n,)
        Time since the start of the row's flight [s].
    flight : (n,) int
        Code of the flight, or :data:`NEW_FLIGHT` for a flight without rows.
    """

    position_m: FloatArray
    direction: FloatArray
    time_s: FloatArray
    flight: IntArray

    def __len__(self) -> int:
        return len(self.time_s)

    @classmethod
    def of(cls, samples: LinkSamples, flight: int) -> Rows:
        """Return the rows for the samples of the flight with the code ``flight``."""
        codes = np.full(len(samples), flight)
        return cls(position_m=samples.position_m, direction=samples.at_uav, time_s=samples.time_s, flight=codes)

    def part(self, keep: Any) -> Rows:
        """Return the selected rows."""
        return Rows(**{f.name: getattr(self, f.name)[keep] for f in dataclasses.fields(self)})

    @classmethod
    def joined(cls, parts: Sequence[Rows]) -> Rows:
        """Return the rows of all parts, joined in order."""
        return cls(**{f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in dataclasses.fields(cls)})


@dataclass(frozen=True, slots=True)
class _Pairs:
    """The distances between rows (n, m): horizontal, vertical, squared chord of the direction, and time.

    ``same`` is 1 for rows of the same flight.
    """

    across_m: FloatArray
    height_m: FloatArray
    chord2: FloatArray
    seconds: FloatArray
    same: FloatArray

    @classmethod
    def of(cls, rows: Rows, columns: Rows) -> _Pairs:
        """Return the distances of ``rows`` (n,) from ``columns`` (m,)."""
        between = rows.position_m[:, None] - columns.position_m
        # (n, m), or (headings, n, m) for targets with several headings
        inner = np.moveaxis(rows.direction, -2, 0) @ columns.direction.T
        return cls(
            np.hypot(between[..., 0], between[..., 1]),
            np.abs(between[..., 2]),
            # rounding can make the product of equal unit vectors exceed 1
            np.maximum(2.0 - 2.0 * inner, 0.0),
            np.abs(rows.time_s[:, None] - columns.time_s),
            (rows.flight[:, None] == columns.flight).astype(np.float64),
        )


def _place(model: FieldModel, apart: _Pairs) -> FloatArray:
    """Return the covariance (n, m) of the field over positions.

    The covariance is averaged over several headings, which is the covariance of a level with unknown heading.
    """
    near = np.exp(-apart.across_m / model.length_m - apart.height_m / model.height_m)
    if math.isfinite(model.turn):
        alike = np.exp(-apart.chord2 / (2.0 * model.turn**2))
        near *= alike.mean(axis=0) if alike.ndim > near.ndim else alike
    return np.asarray(model.place_sd_db**2 * near)


def _drift(model: FieldModel, apart: _Pairs) -> FloatArray:
    return np.asarray(model.drift_sd_db**2 * apart.same * np.exp(-apart.seconds / model.drift_s))


def covariance(model: FieldModel, rows: Rows, columns: Rows, parts: Collection[Part] = PARTS) -> FloatArray:
    """Return the covariance (n, m) between rows of the selected parts of the residual, without noise [dB^2].

    Parameters
    ----------
    model : FieldModel
    rows, columns : Rows
        Rows (n,) and (m,).
    parts : collection of str
        Names from :data:`PARTS`.

    Returns
    -------
    (n, m)
    """
    apart = _Pairs.of(rows, columns)
    out = np.full(apart.same.shape, MEAN_SD_DB**2 if "mean" in parts else 0.0)
    if "place" in parts:
        out += _place(model, apart)
    if "offset" in parts:
        out += model.offset_sd_db**2 * apart.same
    if "drift" in parts:
        out += _drift(model, apart)
    return out


def prior_sd_db(model: FieldModel, parts: Collection[Part]) -> float:
    """Return the prior standard deviation of the selected parts, before any sample is known [dB]."""
    each = {"mean": MEAN_SD_DB, "place": model.place_sd_db, "offset": model.offset_sd_db, "drift": model.drift_sd_db}
    return math.hypot(*(each[part] for part in parts))


# --- prediction ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class FieldFit:
    """The Gaussian process conditioned on rows. The SDs do not depend on the values ``value_db`` (n,)."""

    model: FieldModel
    rows: Rows
    value_db: FloatArray | None = None

    def __post_init__(self) -> None:
        if not len(self.rows):
            raise InputError("no sample to learn from", expected="flights with levels at known poses")

    def predict(self, targets: Rows, parts: Collection[Part] = PARTS) -> tuple[FloatArray, FloatArray]:
        """Return mean and standard deviation (m,) of the selected parts at targets [dB]. NaN for targets with a NaN.

        If there are more than :data:`_MOST_ROWS` rows, an evenly spaced selection of them is used.

        Parameters
        ----------
        targets : Rows
        parts : collection of str
            Parts of the residual. ``("place", "drift")`` is the residual of a flight relative to its own mean.

        Returns
        -------
        mean_db, sd_db : (m,)
        """
        mean, sd = np.full((2, len(targets)), np.nan)
        ends = targets.direction.reshape(len(targets), -1)
        known = np.flatnonzero(np.isfinite(np.column_stack([targets.position_m, ends, targets.time_s])).all(axis=1))
        rows, factor, white = self._whitened
        prior = prior_sd_db(self.model, parts) ** 2
        step = max(AT_ONCE * 3 // max(ends.shape[1], 3), 1)
        for start in range(0, len(known), step):
            block = known[start : start + step]
            mean[block], explained = factor.condition(covariance(self.model, targets.part(block), rows, parts), white)
            sd[block] = np.sqrt(np.maximum(prior - explained, 0.0))
        return mean, sd

    @cached_property
    def _whitened(self) -> tuple[Rows, Factor, FloatArray]:
        """The rows that are used, the Cholesky factor of their covariance, and the whitened values of the rows."""
        used = spread_out(len(self.rows), _MOST_ROWS)
        rows = self.rows.part(used)
        factor = Factor.of(_noisy(self.model, covariance(self.model, rows, rows)))
        return rows, factor, factor.whiten(np.zeros(len(rows)) if self.value_db is None else self.value_db[used])


def _noisy(model: FieldModel, matrix: FloatArray) -> FloatArray:
    """Add the noise to the diagonal of a covariance (n, n), in place, and return it."""
    matrix[np.diag_indices(len(matrix))] += model.noise_sd_db**2
    return matrix


# --- scales --------------------------------------------------------------------------------------------------------


def fit_field(
    channels: Sequence[tuple[Rows, FloatArray]], start: FieldModel | None = None, learn: Collection[str] = tuple(BOUNDS)
) -> FieldModel:
    """Fit strengths and scales to the residuals of one or more channels by marginal likelihood.

    Parameters
    ----------
    channels : sequence of (Rows, (n,))
        Rows and residuals [dB] of each channel. All channels have the same model, but separate fields.
    start : FieldModel, optional
        Start of the search, and the values that are not fitted. The offset between flights is estimated by
        :func:`_offset_sd_of`.
    learn : collection of str
        Names from :data:`BOUNDS` that are fitted.

    Returns
    -------
    FieldModel

    Raises
    ------
    InputError
        If no channel has three rows.
    """
    from scipy.optimize import minimize

    used = [_evenly(rows, value) for rows, value in channels if len(rows) >= 3]
    if not used:
        raise InputError("fewer than three samples", expected="flights with levels at known poses")
    start = start or FieldModel()
    start = dataclasses.replace(start, offset_sd_db=_offset_sd_of(used, start.offset_sd_db))
    names = list(learn)
    apart = [_Pairs.of(rows, rows) for rows, _ in used]

    def misfit(logs: FloatArray) -> tuple[float, FloatArray]:
        model = _with(start, names, logs)
        total, slope = 0.0, np.zeros(len(names))
        for (_, value), each in zip(used, apart, strict=True):
            value_nat, gradient = _likelihood(model, each, value, names)
            total, slope = total - value_nat, slope - gradient
        return total, slope

    # search over logarithms, because strengths and lengths are positive and vary by ratios
    limits = [(math.log(BOUNDS[name][0]), math.log(BOUNDS[name][1])) for name in names]
    first = np.clip([math.log(getattr(start, name)) for name in names], *np.array(limits).T)
    best = minimize(misfit, first, jac=True, bounds=limits, method="L-BFGS-B", options={"maxiter": 40})
    return _with(start, names, best.x)


def _with(model: FieldModel, names: Sequence[str], logs: FloatArray) -> FieldModel:
    values: dict[str, Any] = dict(zip(names, map(float, np.exp(logs)), strict=True))
    return dataclasses.replace(model, **values)


def _evenly(rows: Rows, value: FloatArray) -> tuple[Rows, FloatArray]:
    """Return at most :data:`FIT_ROWS` rows as uninterrupted segments, because thinning would hide short scales."""
    if len(rows) <= FIT_ROWS:
        return rows, value
    # use seven segments, which contain near and far positions, climb and landing
    stretch = FIT_ROWS // 7
    starts = np.linspace(0, len(rows) - stretch, 7).astype(int)
    keep = np.unique(np.concatenate([np.arange(s, s + stretch) for s in starts]))
    return rows.part(keep), value[keep]


def _offset_sd_of(channels: Sequence[tuple[Rows, FloatArray]], usual_db: float) -> float:
    """Return :func:`.offset_sd_db` for the means of flights on all channels."""
    squares, count = 0.0, 0
    for rows, value in channels:
        means = np.array([value[rows.flight == code].mean() for code in np.unique(rows.flight)])
        squares, count = squares + float(((means - means.mean()) ** 2).sum()), count + len(means) - 1
    return offset_sd_db(squares, count, usual_db)


def _likelihood(model: FieldModel, apart: _Pairs, value: FloatArray, names: Sequence[str]) -> tuple[float, FloatArray]:
    """Return the log marginal likelihood, up to a constant, and its gradient in the logarithms of the parameters."""
    place, drift = _place(model, apart), _drift(model, apart)
    factor = Factor.of(_noisy(model, MEAN_SD_DB**2 + place + model.offset_sd_db**2 * apart.same + drift))
    inverse = factor.inverse()
    weight = inverse @ value
    outer = np.outer(weight, weight) - inverse
    along = {
        "place_sd_db": lambda: 2.0 * place,
        "length_m": lambda: place * apart.across_m / model.length_m,
        "height_m": lambda: place * apart.height_m / model.height_m,
        "turn": lambda: place * apart.chord2 / model.turn**2,
        "drift_sd_db": lambda: 2.0 * drift,
        "drift_s": lambda: drift * apart.seconds / model.drift_s,
    }
    slope = [
        model.noise_sd_db**2 * float(np.trace(outer))
        if name == "noise_sd_db"
        else 0.5 * float(np.einsum("ij,ij->", outer, along[name]()))
        for name in names
    ]
    return factor.log_likelihood(value), np.array(slope)


# Name of the planned flight.
_PLANNED = "planned"


@dataclass(frozen=True, kw_only=True)
class FlownFlights:
    """The flown flights and the models, from which the uncertainty at targets is computed.

    Parameters
    ----------
    series : sequence of LinkSamples
        Samples of the flown flights. If there are none, gains have their prior uncertainty.
    model : GainModel
        Gain model: terms and strengths of the antennas, error of a flight and channel, and noise.
    field : FieldModel, optional
        Model of the residual of the antennas. With None, no field is added.
    """

    series: Sequence[LinkSamples]
    model: GainModel
    field: FieldModel | None = None

    def sd_db(self, route: Sequence[LinkSamples], targets: Mapping[str, LinkSamples]) -> dict[str, FloatArray]:
        """Return the SD (targets,) of the level at each antenna, relative to its mean over the targets [dB].

        Parameters
        ----------
        route : sequence of LinkSamples
            Samples of the planned flight at each antenna. The levels of these samples are not used. The sequence is
            empty if no flight is planned.
        targets : mapping of str to LinkSamples
            Targets by antenna.

        Returns
        -------
        dict of str to (targets,)
            Standard deviation from antennas and field. Nuisance and noise of a later flight are not included, because
            no planned flight reduces them.
        """
        # the levels can be arbitrary, because the standard deviation does not depend on them
        planned = [dataclasses.replace(s, flight=_PLANNED, residual_db=np.zeros(len(s))) for s in route]
        rows = [*self.series, *planned]
        fit = fit_gain(rows, self.model) if rows else None
        return {antenna: self._deviation_db(antenna, target, rows, fit) for antenna, target in targets.items()}

    def _deviation_db(
        self, antenna: str, target: LinkSamples, rows: Sequence[LinkSamples], fit: GainFit | None
    ) -> FloatArray:
        if fit is None or antenna not in fit.antennas:
            gain = np.full(len(target), math.sqrt(sum(t.sd_db**2 for t in self.model.terms)))
        else:
            gain = fit.sd_about_mean(target)
        if self.field is None:
            return gain
        mine = [(i, s.binned(self.model.bin_s)) for i, s in enumerate(rows) if s.antenna == antenna]
        if not mine:
            return np.asarray(np.hypot(gain, self.field.place_sd_db))
        known = Rows.joined([Rows.of(s, i) for i, s in mine])
        place: tuple[Part, ...] = ("place",)
        _, field_sd = FieldFit(self.field, known).predict(Rows.of(target, NEW_FLIGHT), place)
        return np.asarray(np.hypot(gain, field_sd))


def rms_db(sd_db: Mapping[str, FloatArray]) -> float:
    """Return the root mean square over all targets and antennas [dB]."""
    return math.sqrt(float(np.mean(np.concatenate([sd**2 for sd in sd_db.values()]))))
