"""Residual of a prediction, as a Gaussian process over place, height, direction and time of flight.

One covariance for every use (a map, a route, blocks left out, the rest of a flight)::

    residual = mean + place(east, north, up, direction) + offset(flight) + drift(flight, time) + noise

``mean`` is unknown. ``place`` is shared by all flights: ``sd^2 exp(-d / length) exp(-dz / height) exp(-chord^2 / 2
turn^2)``. ``offset`` and ``drift`` (``sd^2 exp(-dt / drift_s)``) are each flight's own. The lengths are bounded by what
the physics knows (:data:`BOUNDS`): unbounded, fading is fitted as place. Channels of a tower are kept apart.

The standard deviation that a further flight would leave, before anyone has flown it.

A Gaussian process does not ask for levels to say how well it will know a place: directions and positions of a planned
route are enough. Antennas are those of :mod:`.gains`, what they leave is the field of :mod:`.field_gp`.

The rest of a flight, predicted anew as its levels come in: a trend and a Gaussian process on what it leaves.

The trend is chosen by the CRPS of predictions some way ahead, and may be none at all. Means over :data:`BIN_S` are
kept, the latest :data:`KEEP` of them, so that an update costs the same at any time of the flight.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import numpy as np

from ..common.errors import InputError
from ..common.gaussian import Factor
from ..common.units import FloatArray, IntArray, spread_out
from .gains import GainFit, GainModel, LinkSamples, fit_gain
from .level import crps_normal

Part = Literal["mean", "place", "offset", "drift"]
PARTS: tuple[Part, ...] = ("mean", "place", "offset", "drift")

# Of the unknown mean: free in effect, and still a proper covariance.
MEAN_SD_DB = 100.0

# Rows of the exact solution: one matrix of 72 MB.
_EXACT_ROWS = 3000

# Rows squared times targets: beyond it (some ten seconds) only the nearest rows of a target are used.
_EXACT_WORK = 2.0e11

# Rows of the approximation for a single target, and at most for targets that share them.
_NEAREST, _MOST_NEAREST = 40, 160

# Side of the cells in scaled space whose targets share their rows.
_TOGETHER = 0.25

# Rows of one channel from which scales are learned.
FIT_ROWS = 700

# Targets at a time; bounds the memory.
AT_ONCE = 1024

# Code of a flight that no row has.
NEW_FLIGHT = -1


@dataclass(frozen=True, slots=True, kw_only=True)
class FieldModel:
    """Strengths [dB] and scales of the covariance.

    Parameters
    ----------
    place_sd_db, length_m, height_m, turn : float
        Field over places: horizontal and vertical scale [m], and chord of the direction; infinite: independent of it.
    offset_sd_db : float
        Between flights.
    drift_sd_db, drift_s : float
        Within a flight, over time [s].
    noise_sd_db : float
        Of a row.
    """

    place_sd_db: float = 2.0
    length_m: float = 50.0
    height_m: float = 30.0
    turn: float = 0.7
    offset_sd_db: float = 1.5
    drift_sd_db: float = 1.5
    drift_s: float = 60.0
    noise_sd_db: float = 1.5


# What may be learned, and between which values.
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
    """Places and times: samples of one channel, or targets.

    Parameters
    ----------
    position_m : (n, 3)
        East, north, up [m].
    direction : (n, 3) or (n, headings, 3)
        Unit vector towards the tower in the body frame; of targets, at each of several headings that count alike.
    time_s : (n,)
        Since the start of the row's flight [s].
    flight : (n,) int
        Code of the flight; :data:`NEW_FLIGHT` of one that is not flown yet.
    """

    position_m: FloatArray
    direction: FloatArray
    time_s: FloatArray
    flight: IntArray

    def __len__(self) -> int:
        return len(self.time_s)

    @classmethod
    def of(cls, samples: LinkSamples, flight: int) -> Rows:
        """Places of the samples of one flight, as the UAV sees the tower; ``flight`` is its code."""
        codes = np.full(len(samples), flight)
        return cls(position_m=samples.position_m, direction=samples.at_uav, time_s=samples.time_s, flight=codes)

    def part(self, keep: Any) -> Rows:
        """Some of the rows; an index of two dimensions gives rows of rows."""
        return Rows(**{f.name: getattr(self, f.name)[keep] for f in dataclasses.fields(self)})

    @classmethod
    def joined(cls, parts: Sequence[Rows]) -> Rows:
        """All rows of several."""
        return cls(**{f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in dataclasses.fields(cls)})


@dataclass(frozen=True, slots=True)
class _Apart:
    """Distances between rows (..., n, m): horizontal, in height, in direction (squared), in time; same flight."""

    across_m: FloatArray
    height_m: FloatArray
    chord2: FloatArray
    seconds: FloatArray
    same: FloatArray

    @classmethod
    def of(cls, rows: Rows, columns: Rows) -> _Apart:
        """Of rows (..., n) from others (..., m)."""
        a, b = (np.moveaxis(r.position_m, -1, 0) for r in (rows, columns))
        up = np.abs(a[2][..., :, None] - b[2][..., None, :])
        across = np.hypot(a[0][..., :, None] - b[0][..., None, :], a[1][..., :, None] - b[1][..., None, :])
        if rows.direction.ndim > rows.position_m.ndim:  # (headings, ..., n, m)
            inner = np.einsum("...nhk,...mk->h...nm", rows.direction, columns.direction, optimize=True)
        else:
            inner = rows.direction @ np.swapaxes(columns.direction, -1, -2)
        return cls(
            across,
            up,
            # the product of equal unit vectors may round above 1
            np.maximum(2.0 - 2.0 * inner, 0.0),
            np.abs(rows.time_s[..., :, None] - columns.time_s[..., None, :]),
            (rows.flight[..., :, None] == columns.flight[..., None, :]).astype(np.float64),
        )


def _place(model: FieldModel, apart: _Apart) -> FloatArray:
    """Covariance (..., n, m); over several headings its mean, that of a level whose heading is not known."""
    near = np.exp(-apart.across_m / model.length_m - apart.height_m / model.height_m)
    if math.isfinite(model.turn):
        alike = np.exp(-apart.chord2 / (2.0 * model.turn**2))
        near *= alike.mean(axis=0) if alike.ndim > near.ndim else alike
    return np.asarray(model.place_sd_db**2 * near)


def _drift(model: FieldModel, apart: _Apart) -> FloatArray:
    return np.asarray(model.drift_sd_db**2 * apart.same * np.exp(-apart.seconds / model.drift_s))


def covariance(model: FieldModel, rows: Rows, columns: Rows, parts: Collection[Part] = PARTS) -> FloatArray:
    """Covariance of some parts of the residual between rows (..., n, m), without noise [dB^2].

    Parameters
    ----------
    model : FieldModel
    rows, columns : Rows
        (..., n) and (..., m).
    parts : collection of str
        Of :data:`PARTS`.

    Returns
    -------
    (..., n, m)
    """
    return _covariance(model, _Apart.of(rows, columns), parts)


def _covariance(model: FieldModel, apart: _Apart, parts: Collection[Part]) -> FloatArray:
    out = np.full(apart.same.shape, MEAN_SD_DB**2 if "mean" in parts else 0.0)
    if "place" in parts:
        out += _place(model, apart)
    if "offset" in parts:
        out += model.offset_sd_db**2 * apart.same
    if "drift" in parts:
        out += _drift(model, apart)
    return out


def prior_sd_db(model: FieldModel, parts: Collection[Part]) -> float:
    """Standard deviation of some parts where nothing is known [dB]."""
    each = {
        "mean": MEAN_SD_DB,
        "place": model.place_sd_db,
        "offset": model.offset_sd_db,
        "drift": model.drift_sd_db,
    }
    return math.hypot(*(each[part] for part in parts))


# --- prediction ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class FieldFit:
    """The process conditioned on rows; ``value_db`` (n,) may be absent, where only standard deviations are wanted."""

    model: FieldModel
    rows: Rows
    value_db: FloatArray | None = None

    def __post_init__(self) -> None:
        if not len(self.rows):
            raise InputError("no sample to condition on", expected="flights with levels at known poses")

    def predict(
        self, targets: Rows, parts: Collection[Part] = PARTS, *, exact: bool | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Mean and standard deviation (m,) of some parts at targets [dB]; NaN where a target has NaN.

        Parameters
        ----------
        targets : Rows
        parts : collection of str
            Which parts of the residual: those of ``("place", "drift")`` are a flight about its own mean.
        exact : bool, optional
            By default where the matrices fit (:data:`_EXACT_ROWS`, :data:`_EXACT_WORK`); else the nearest rows alone.

        Returns
        -------
        mean_db, sd_db : (m,)

        Notes
        -----
        Beyond the exact solution the common mean and each flight's offset come from evenly thinned rows, and each
        target from its :data:`_NEAREST` rows in the scaled space (Vecchia's conditioning; Datta et al. 2016,
        doi 10.1080/01621459.2015.1044091). Targets of one cell share the rows nearest to their middle, the more of
        them the more targets there are (Guinness 2018, doi 10.1080/00401706.2018.1437476).
        """
        mean, sd = np.full((2, len(targets)), np.nan)
        ends = targets.direction.reshape(len(targets), -1)
        known = np.isfinite(np.column_stack([targets.position_m, ends, targets.time_s])).all(axis=1)
        exact = self.fits(int(known.sum())) if exact is None else exact
        places, some = np.flatnonzero(known), targets.part(known)
        step = max(AT_ONCE * 3 // max(ends.shape[1], 3), 1)
        for block, block_mean, block_sd in (self._exact if exact else self._nearest)(some, step, parts):
            mean[places[block]], sd[places[block]] = block_mean, block_sd
        return mean, sd

    def fits(self, targets: int) -> bool:
        """Check whether so many targets have the exact solution."""
        return len(self.rows) <= _EXACT_ROWS and len(self.rows) ** 2 * float(targets) <= _EXACT_WORK

    @cached_property
    def _whitened(self) -> tuple[Factor, FloatArray]:
        """Factor of the covariance of the rows, and their values by it."""
        factor = Factor.of(_noisy(self.model, covariance(self.model, self.rows, self.rows)))
        return factor, factor.whiten(np.zeros(len(self.rows)) if self.value_db is None else self.value_db)

    def _exact(
        self, targets: Rows, step: int, parts: Collection[Part]
    ) -> Iterator[tuple[slice | IntArray, FloatArray, FloatArray]]:
        factor, white = self._whitened
        prior = prior_sd_db(self.model, parts) ** 2
        for start in range(0, len(targets), step):
            block = slice(start, start + step)
            mean, explained = factor.condition(covariance(self.model, targets.part(block), self.rows, parts), white)
            yield block, mean, np.sqrt(np.maximum(prior - explained, 0.0))

    def _nearest(
        self, targets: Rows, step: int, parts: Collection[Part]
    ) -> Iterator[tuple[slice | IntArray, FloatArray, FloatArray]]:
        from scipy.spatial import cKDTree

        levels, level_sd = self._levels(targets, parts)
        row_levels, row_sd = self._levels(self.rows, ("mean", "offset"))
        value = np.zeros(len(self.rows)) if self.value_db is None else self.value_db - row_levels
        near: list[Part] = ["place", "drift"]
        near_parts = [part for part in near if part in parts]
        # levels alone come from all rows; the level of another flight than the targets' own tells them nothing
        row_sd = row_sd * (np.isin(self.rows.flight, targets.flight) & bool(near_parts))
        prior = prior_sd_db(self.model, near_parts) ** 2 if near_parts else 0.0
        # of several headings there is no one direction to be near to
        turned = math.isfinite(self.model.turn) and targets.direction.ndim == 2
        tree, places = cKDTree(self._scaled(self.rows, turned)), self._scaled(targets, turned)
        for part, shared in _cells(places, step):
            most = min(_NEAREST * len(part) ** (1 / 3), _MOST_NEAREST) if shared else _NEAREST
            count = np.arange(1, min(round(most), len(self.rows)) + 1)
            index = tree.query(places[part].mean(axis=0) if shared else places[part], k=count)[1]
            rows, some, sd = self.rows.part(index), targets.part(part), row_sd[index]
            # a flight's level is known to its sd only: that error is common to what its rows have left
            common = sd[..., :, None] * sd[..., None, :] * (rows.flight[..., :, None] == rows.flight[..., None, :])
            matrix = _noisy(self.model, covariance(self.model, rows, rows, near) + common)
            own = level_sd[part][:, None] * sd * (some.flight[:, None] == rows.flight)
            if shared:  # (targets, rows) of one set of rows
                across = covariance(self.model, some, rows, near_parts) + own
                weight = np.linalg.solve(matrix, across.T).T
            else:  # a set of rows per target
                across = covariance(self.model, some.part((slice(None), None)), rows, near_parts)[:, 0, :] + own
                weight = np.linalg.solve(matrix, across[..., None])[..., 0]
            variance = prior + level_sd[part] ** 2 - np.einsum("tm,tm->t", weight, across)
            mean = levels[part] + np.einsum("tm,tm->t", weight, np.broadcast_to(value[index], weight.shape))
            yield part, mean, np.sqrt(np.maximum(variance, 0.0))

    def _scaled(self, rows: Rows, turned: bool) -> FloatArray:
        """Coordinates in which the place part falls off evenly, with or without the direction."""
        m = self.model
        place = rows.position_m / (m.length_m, m.length_m, m.height_m)
        return np.column_stack([place, rows.direction / m.turn]) if turned else place

    def _levels(self, targets: Rows, parts: Collection[Part]) -> tuple[FloatArray, FloatArray]:
        """Mean and offsets (m,) at targets from thinned rows, with their standard deviation."""
        level_parts: list[Part] = [part for part in ("mean", "offset") if part in parts]  # type: ignore[misc]
        out, sd = np.zeros((2, len(targets)))
        if not level_parts:
            return out, sd
        thinned = spread_out(len(self.rows), _EXACT_ROWS // 2)
        fit = FieldFit(self.model, self.rows.part(thinned), None if self.value_db is None else self.value_db[thinned])
        _, first, member = np.unique(targets.flight, return_index=True, return_inverse=True)
        mean_of, sd_of = fit.predict(targets.part(first), level_parts, exact=True)
        return mean_of[member], sd_of[member]


# Targets of smaller cells have their own rows: many at a time are as cheap.
FEWEST_TOGETHER = 8


def _cells(places: FloatArray, step: int) -> Iterator[tuple[IntArray, bool]]:
    """At most ``step`` targets (n, k) at a time: those of one cell, and then all others; True for those of one cell."""
    cell = np.floor(places / _TOGETHER).astype(np.int64)
    _, member, count = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
    member = member.ravel()
    many = count[member] >= FEWEST_TOGETHER
    order = np.flatnonzero(many)[np.argsort(member[many], kind="stable")]
    for part in np.split(order, np.cumsum(count[count >= FEWEST_TOGETHER])[:-1]) if len(order) else ():
        for start in range(0, len(part), step):
            yield part[start : start + step], True
    alone = np.flatnonzero(~many)
    for start in range(0, len(alone), step):
        yield alone[start : start + step], False


def _noisy(model: FieldModel, matrix: FloatArray) -> FloatArray:
    """A covariance (..., n, n) with the noise on its diagonal, in place."""
    count = matrix.shape[-1]
    matrix[..., np.arange(count), np.arange(count)] += model.noise_sd_db**2
    return matrix


# --- scales --------------------------------------------------------------------------------------------------------


def fit_field(
    channels: Sequence[tuple[Rows, FloatArray]], start: FieldModel | None = None, learn: Collection[str] = tuple(BOUNDS)
) -> FieldModel:
    """Strengths and scales by the marginal likelihood of the residuals of one or more channels.

    Parameters
    ----------
    channels : sequence of (Rows, (n,))
        Rows and residuals [dB] of each channel; they share the model, not the field.
    start : FieldModel, optional
        Where the search starts, and what is not learned: the offset between flights is :func:`_offset_sd_of` them.
    learn : collection of str
        Names of :data:`BOUNDS`.

    Returns
    -------
    FieldModel

    Raises
    ------
    InputError
        No channel has three rows.
    """
    from scipy.optimize import minimize

    used = [_evenly(rows, value) for rows, value in channels if len(rows) >= 3]
    if not used:
        raise InputError("fewer than three samples", expected="flights with levels at known poses")
    start = start or FieldModel()
    start = dataclasses.replace(start, offset_sd_db=_offset_sd_of(used, start.offset_sd_db))
    names = list(learn)
    apart = [_Apart.of(rows, rows) for rows, _ in used]

    def misfit(logs: FloatArray) -> tuple[float, FloatArray]:
        model = _with(start, names, logs)
        total, slope = 0.0, np.zeros(len(names))
        for (_, value), each in zip(used, apart, strict=True):
            value_nat, gradient = _likelihood(model, each, value, names)
            total, slope = total - value_nat, slope - gradient
        return total, slope

    # by their logarithms: strengths and lengths are positive, and count by their ratios
    limits = [(math.log(BOUNDS[name][0]), math.log(BOUNDS[name][1])) for name in names]
    first = np.clip([math.log(getattr(start, name)) for name in names], *np.array(limits).T)
    best = minimize(misfit, first, jac=True, bounds=limits, method="L-BFGS-B", options={"maxiter": 40})
    return _with(start, names, best.x)


def _with(model: FieldModel, names: Sequence[str], logs: FloatArray) -> FieldModel:
    values: dict[str, Any] = dict(zip(names, map(float, np.exp(logs)), strict=True))
    return dataclasses.replace(model, **values)


def _evenly(rows: Rows, value: FloatArray) -> tuple[Rows, FloatArray]:
    """Whole stretches of at most :data:`FIT_ROWS` rows: thinning would hide short scales."""
    if len(rows) <= FIT_ROWS:
        return rows, value
    # seven stretches over the flight: near and far, climbing and landing
    stretch = FIT_ROWS // 7
    starts = np.linspace(0, len(rows) - stretch, 7).astype(int)
    keep = np.unique(np.concatenate([np.arange(s, s + stretch) for s in starts]))
    return rows.part(keep), value[keep]


def _offset_sd_of(channels: Sequence[tuple[Rows, FloatArray]], otherwise_db: float) -> float:
    """Standard deviation of the means of flights of one channel [dB], shrunk towards a prior guess.

    Two flights say little: the guess counts as two more (the mean of an inverse-gamma posterior).
    """
    # the guess as two observations
    squares, count = 2.0 * otherwise_db**2, 2.0
    for rows, value in channels:
        means = np.array([value[rows.flight == code].mean() for code in np.unique(rows.flight)])
        squares, count = squares + float(((means - means.mean()) ** 2).sum()), count + len(means) - 1
    return math.sqrt(squares / count)


def _likelihood(model: FieldModel, apart: _Apart, value: FloatArray, names: Sequence[str]) -> tuple[float, FloatArray]:
    """Log marginal likelihood but for a constant, and its slope along the logarithm of each named parameter."""
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


# Name of the flight to come.
_PLANNED = "planned"


@dataclass(frozen=True, kw_only=True)
class Known:
    """All that decides how well targets are known.

    Parameters
    ----------
    series : sequence of LinkSamples
        Of the flights that were flown; none: antennas are as the prior has them.
    model : GainModel
        Terms and strengths of the antennas, own nuisance, noise.
    field : FieldModel, optional
        Of what the antennas leave; None: nothing is added.
    """

    series: Sequence[LinkSamples]
    model: GainModel
    field: FieldModel | None = None

    def sd_db(self, route: Sequence[LinkSamples], targets: Mapping[str, LinkSamples]) -> dict[str, FloatArray]:
        """Standard deviation (targets,) of the level per antenna, about its mean over the targets [dB].

        Parameters
        ----------
        route : sequence of LinkSamples
            The planned flight at each antenna; levels are not used. None: as it stands.
        targets : mapping of str to LinkSamples
            By antenna.

        Returns
        -------
        dict of str to (targets,)
            Of antennas and field, without nuisance and noise of a later flight, which no route lowers.
        """
        # any levels: how well places will be known does not depend on them
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
    """Root mean square over all targets and antennas [dB]: the error to expect of the mean of a flight there."""
    return math.sqrt(float(np.mean(np.concatenate([sd**2 for sd in sd_db.values()]))))


BIN_S = 2.0
KEEP = 150
LEAST = 8
# A trend is judged by what it says of levels so much later [s].
AHEAD_S = 20.0

# Weight of an older error against that of the next bin.
_FORGET = 0.98

LENGTHS_M = (30.0, 120.0)
SPEED_MPS = 8.0
NONE = "none"

_MODELS = {
    length: FieldModel(
        place_sd_db=3.0,
        length_m=length,
        height_m=length,
        turn=math.inf,
        offset_sd_db=0.0,
        drift_sd_db=1.0,
        drift_s=20.0,
        noise_sd_db=1.5,
    )
    for length in LENGTHS_M
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Ahead:
    """Levels of the rest of the route: index of its points (m,), median, standard deviation of a sample, trend."""

    index: IntArray
    level_db: FloatArray
    sd_db: FloatArray
    trend: str

    @property
    def interval_db(self) -> tuple[FloatArray, FloatArray]:
        """90 % interval of one sample (m,) each."""
        # 1.645: the 95 % point of the normal distribution
        return self.level_db - 1.645 * self.sd_db, self.level_db + 1.645 * self.sd_db


@dataclass(slots=True)
class _Bins:
    """Closed bins, oldest first: place (n, 3), time (n,), level (n,), each trend (n,)."""

    place: list[FloatArray] = field(default_factory=list)
    time_s: list[float] = field(default_factory=list)
    level: list[float] = field(default_factory=list)
    trends: dict[str, list[float]] = field(default_factory=dict)

    def cut(self) -> None:
        for values in (self.place, self.time_s, self.level, *self.trends.values()):
            del values[:-KEEP]  # type: ignore[attr-defined]


class RouteAhead:
    """Prediction of a route's rest that learns from every record.

    Parameters
    ----------
    route_m : (m, 3)
        Points of the route in the order of flight [m].
    trends : mapping of str to (m,)
        Models of the level at these points [dB], up to a constant; "none" is added.
    """

    def __init__(self, route_m: FloatArray, trends: Mapping[str, FloatArray]) -> None:
        self.route_m = np.asarray(route_m, dtype=np.float64)
        self._trends = {**{k: np.asarray(v, dtype=np.float64) for k, v in trends.items()},
                        NONE: np.zeros(len(self.route_m))}  # fmt: skip
        self._scores: dict[tuple[str, float], tuple[float, float]] = {}
        self._bins, self._open = _Bins(trends={name: [] for name in self._trends}), list[tuple[float, ...]]()
        self._start, self._reached = math.nan, 0
        self.squares, self.samples = 0.0, 0

    def add(self, time_s: float, place_m: FloatArray, level_db: float, trends: Mapping[str, float]) -> Ahead | None:
        """Take a record in; the rest of the route anew where a bin closed, else None.

        Parameters
        ----------
        time_s : float
            Not before that of the record before.
        place_m : (3,)
        level_db : float
            Measured.
        trends : mapping of str to float
            Of every model, here.

        Returns
        -------
        Ahead or None
        """
        values = (time_s, *map(float, place_m), level_db, *(trends.get(name, 0.0) for name in self._trends))
        if not np.isfinite(values).all():
            return None
        closes = bool(self._open) and time_s - self._start >= BIN_S
        if closes:
            self._close()
        if not self._open:
            self._start = time_s
        self._open.append(values)
        return self._predict(np.asarray(place_m, dtype=np.float64)) if closes else None

    def _close(self) -> None:
        rows = np.array(self._open)
        time, east, north, up, level, *trends = rows.mean(axis=0)
        self.squares += float(((rows[:, 4] - level) ** 2).sum())
        self.samples += len(rows) - 1
        place = np.array([east, north, up])
        self._judge(time, place, level, dict(zip(self._trends, trends, strict=True)))
        bins = self._bins
        bins.place.append(place)
        bins.time_s.append(time)
        bins.level.append(level)
        for name, value in zip(self._trends, trends, strict=True):
            bins.trends[name].append(value)
        bins.cut()
        self._open.clear()

    def _judge(self, time: float, place: FloatArray, level: float, trends: Mapping[str, float]) -> None:
        """Score every trend on a bin by what it said :data:`AHEAD_S` before."""
        # only what was known so long before: else a trend is judged by levels beside it
        known = int(np.searchsorted(self._bins.time_s, time - AHEAD_S))
        if known < LEAST:
            return
        for length, model in _MODELS.items():
            moments = self._moments(model, known, place[None], np.array([time]), list(self._trends))
            for name, (mean, sd) in zip(self._trends, moments, strict=True):
                score = float(crps_normal(level - trends[name] - mean, sd)[0])
                total, weight = self._scores.get((name, length), (0.0, 0.0))
                self._scores[name, length] = (_FORGET * total + score, _FORGET * weight + 1.0)

    def _moments(
        self, model: FieldModel, known: int, place: FloatArray, time_s: FloatArray, names: Sequence[str]
    ) -> list[tuple[FloatArray, FloatArray]]:
        """Mean of each trend's residual and standard deviation of a bin (m,), from the first ``known`` bins.

        One factor serves all trends. The strengths are scaled to the data: ``s^2 = y' inv(K) y / n``.
        """
        rows = _rows(np.array(self._bins.place[:known]), np.array(self._bins.time_s[:known]))
        level = np.array(self._bins.level[:known])
        value = np.stack([level - np.array(self._bins.trends[name][:known]) for name in names], axis=1)
        matrix = covariance(model, rows, rows)
        matrix[np.diag_indices(known)] += model.noise_sd_db**2
        factor = Factor.of(matrix)
        middle = value.mean(axis=0)
        white = factor.whiten(value - middle)
        # a level that has not changed yet would make every interval a point
        scale = np.maximum((white**2).sum(axis=0) / known, 1e-2)
        targets = _rows(place, time_s)
        mean, explained = factor.condition(covariance(model, targets, rows), white)
        prior = float(covariance(model, targets.part([0]), targets.part([0]))[0, 0])
        variance = np.maximum(prior - explained, 0.0) + model.noise_sd_db**2
        return [(middle[k] + mean[:, k], np.sqrt(scale[k] * variance)) for k in range(len(names))]

    def _predict(self, place: FloatArray) -> Ahead | None:
        """The rest of the route from where the UAV is."""
        if len(self._bins.level) < LEAST:
            return None
        # onwards and not far: where a route crosses itself, the nearest point may be of its other leg
        window = slice(self._reached, self._reached + max(50, len(self.route_m) // 10))
        self._reached += int(np.linalg.norm(self.route_m[window] - place, axis=1).argmin())
        index = np.arange(self._reached, len(self.route_m))
        known = {key: total / weight for key, (total, weight) in self._scores.items()}
        # before anything was judged: no trend, and the longer memory
        trend, length = min(known, key=lambda key: known[key], default=(NONE, LENGTHS_M[-1]))
        now = self._bins.time_s[-1]
        steps = np.linalg.norm(np.diff(self.route_m[index], axis=0, prepend=place[None]), axis=1)
        count, later = len(self._bins.level), now + np.cumsum(steps) / SPEED_MPS
        mean, sd = self._moments(_MODELS[length], count, self.route_m[index], later, [trend])[0]
        within = math.sqrt(self.squares / self.samples) if self.samples else 0.0
        level = self._trends[trend][index] + mean
        return Ahead(index=index, level_db=level, sd_db=np.hypot(sd, within), trend=trend)


def _rows(place: FloatArray, time_s: FloatArray) -> Rows:
    n = len(place)
    return Rows(position_m=place, direction=np.zeros((n, 3)), time_s=time_s, flight=np.zeros(n, dtype=np.int64))
