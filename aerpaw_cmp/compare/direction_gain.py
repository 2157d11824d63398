"""Gain over direction at both ends of a link, learned from the residuals of several flights.

``residual = offset + g_uav(body) + g_tower(mast) + g_pair(body, mast) [+ place] + own + noise``

``offset`` is free per flight, tower and channel. ``own`` is a nuisance of each flight and channel, correlated over
place, so that the shadowing of one flight is not learned as antenna. The gains are Gaussian processes over directions
(:mod:`.sphere`): of the tower in the body, of the UAV at the mast, and of both together per channel (what the gain at
one end does not explain without the other). A place field, if asked for, is one over positions and stays apart.
"""

from __future__ import annotations

import dataclasses
import hashlib
import math
from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, TypeVar

import numpy as np

from ..common.errors import InputError, UsageError
from ..common.gaussian import determining, gaussian_kernel
from ..common.units import BoolArray, FloatArray, IntArray
from .sphere import gaussian_features

Frame = Literal["body", "mast", "pair", "world", "place"]
Sharing = Literal["all", "antenna"]

OFFSET_SD = 100.0
"""Prior of each offset in standard deviations of the noise: free in effect, and still a proper covariance."""

MOST_COLUMNS = 6000
"""Square matrices of this order are held (290 MB)."""


@dataclass(frozen=True, slots=True)
class LinkSamples:
    """Measurements of one flight on one channel of one tower, against a model without the gain to be learned.

    Parameters
    ----------
    flight, tower, channel : str
        Names; tower and channel together are an antenna.
    time_s : (n,)
        Increasing [s].
    position_m : (n, 3)
        Of the UAV, east, north, up [m].
    at_uav : (n, 3)
        Unit vector towards the tower in the body frame (forward, left, up).
    at_tower : (n, 3)
        Unit vector towards the UAV in the frame of the mast (east, north, up).
    residual_db : (n,)
        Measured minus model [dB]; NaN does not count.
    floor_db : (n,), optional
        The residual of a level at the receiver's floor [dB]: a smaller one says "no higher than that".
    """

    flight: str
    tower: str
    channel: str
    time_s: FloatArray
    position_m: FloatArray
    at_uav: FloatArray
    at_tower: FloatArray
    residual_db: FloatArray
    floor_db: FloatArray | None = None

    @property
    def antenna(self) -> str:
        """Name of the antenna at the tower."""
        return f"{self.tower}.{self.channel}"

    def __len__(self) -> int:
        return len(self.time_s)

    def part(self, keep: BoolArray | IntArray) -> LinkSamples:
        """Some of the samples."""
        arrays: dict[str, Any] = {name: getattr(self, name)[keep] for name in _ARRAYS}
        floor_db = None if self.floor_db is None else self.floor_db[keep]
        return dataclasses.replace(self, floor_db=floor_db, **arrays)

    def binned(self, width_s: float) -> LinkSamples:
        """Means over bins of time; directions are normalised again.

        A bin mixes directions only as far as the UAV turns within it; a few seconds are less than the lengths of the
        kernels.
        """
        good = np.isfinite(self.residual_db) & np.isfinite(self.at_uav).all(axis=1)
        if not good.any():
            return self.part(good)
        kept = self.part(good)
        _, member = np.unique(np.floor((kept.time_s - kept.time_s[0]) / width_s).astype(np.int64), return_inverse=True)
        means: dict[str, Any] = {name: _bin_means(getattr(kept, name), member) for name in _ARRAYS}
        for name in ("at_uav", "at_tower"):
            means[name] /= np.linalg.norm(means[name], axis=1, keepdims=True)
        return dataclasses.replace(kept, floor_db=None, **means)


_ARRAYS = ("time_s", "position_m", "at_uav", "at_tower", "residual_db")


def _bin_means(values: FloatArray, member: IntArray) -> FloatArray:
    count = np.bincount(member)
    if values.ndim == 1:
        return np.asarray(np.bincount(member, weights=values) / count)
    return np.stack([np.bincount(member, weights=column) / count for column in values.T], axis=1)


@dataclass(frozen=True, slots=True)
class Term:
    """One Gaussian process.

    Parameters
    ----------
    frame : {"body", "mast", "pair", "world", "place"}
        Its argument: direction of the tower in the body, of the UAV at the mast, both of these, the direction of the
        tower in the world's axes at the UAV (a control: no antenna is fixed there), or the position.
    per : {"all", "antenna"}
        One function for all, or one per tower and channel.
    length : float
        Chord on the unit sphere, or metres for a place.
    sd_db : float
        Standard deviation [dB].
    """

    frame: Frame
    per: Sharing
    length: float
    sd_db: float


UAV_TERMS = (
    Term("body", "all", 0.2, 1.5),
    Term("body", "all", 0.45, 2.0),
    Term("body", "all", 0.9, 2.0),
    Term("body", "antenna", 0.35, 0.8),
)
TOWER_TERMS = (Term("mast", "antenna", 0.2, 3.0), Term("mast", "antenna", 0.7, 2.0))
PAIR_TERMS = (Term("pair", "antenna", 0.35, 1.5),)
ANTENNA_TERMS = UAV_TERMS + TOWER_TERMS + PAIR_TERMS
PLACE_TERM = Term("place", "antenna", 30.0, 2.0)


@dataclass(frozen=True, slots=True)
class GainModel:
    """All that is not learned from directions: which terms, how strong, how long.

    Parameters
    ----------
    terms : tuple of Term
        At least one.
    own_sd_db, own_length_m : float
        Nuisance of a flight and channel: ``sd^2 exp(-distance / length)``.
    noise_sd_db : float
        Of a bin.
    bin_s : float
        Samples are averaged over this time [s].
    """

    terms: tuple[Term, ...] = ANTENNA_TERMS
    own_sd_db: float = 2.0
    own_length_m: float = 20.0
    noise_sd_db: float = 1.5
    bin_s: float = 4.0


def scaled_model(model: GainModel, factor: float) -> GainModel:
    """All standard deviations times a factor."""
    return dataclasses.replace(
        model,
        terms=tuple(dataclasses.replace(t, sd_db=t.sd_db * factor) for t in model.terms),
        own_sd_db=model.own_sd_db * factor,
        noise_sd_db=model.noise_sd_db * factor,
    )


@dataclass(frozen=True, slots=True)
class _Block:
    """Columns of one term for one antenna (or all)."""

    term: Term
    antenna: str | None
    start: int
    stop: int
    knots: FloatArray | None = None


@dataclass(frozen=True, slots=True)
class _System:
    """Normal equations of the whitened rows, before the terms' standard deviations are put in.

    ``gram`` (p, p) and ``right`` (p,); ``square`` is the whitened target's square; ``log_det`` that of the whitening.
    """

    gram: FloatArray
    right: FloatArray
    square: float
    log_det: float


def argument_of(samples: LinkSamples, frame: Frame) -> FloatArray:
    """Argument of a term of this frame: (n, 3), or (n, 6) of both directions."""
    if frame == "pair":
        return np.concatenate([samples.at_uav, samples.at_tower], axis=1)
    if frame == "body":
        return samples.at_uav
    if frame == "mast":
        return samples.at_tower
    return -samples.at_tower if frame == "world" else samples.position_m


def _knots(points_m: FloatArray, spacing_m: float) -> FloatArray:
    """One point per visited cell of a grid: (knots, 3)."""
    _, first = np.unique(np.round(points_m / spacing_m).astype(np.int64), axis=0, return_index=True)
    return points_m[np.sort(first)]


UNEXPLAINED = 1e-3
"""Largest share of the variance of a term over both directions that its knots leave at the bins of the fit."""


MOST_KNOTS = 400
"""Of one antenna; flights with every heading at every place would take thousands for a term of 1.5 dB."""


def pair_knots(points: FloatArray, length: float, share: float = UNEXPLAINED, most: int = MOST_KNOTS) -> FloatArray:
    """Those of some points (n, 6) that determine a Gaussian process at all of them: (knots, 6).

    Parameters
    ----------
    points : (n, 6)
        Directions at both ends.
    length : float
        Of the kernel [chord].
    share : float
        Share of the variance that may be left at any point.
    most : int
        Largest number of knots; where they do not suffice, more than the share is left.

    Returns
    -------
    (knots, 6)
        In the order in which they were taken.
    """
    return points[determining(points, lambda one, other: gaussian_kernel(one, other, length), share, most)]


def _features(block: _Block, argument: FloatArray, *, keep: bool = False) -> FloatArray:
    """Unit-variance features (n, columns of the block); ``keep`` those that the next fit asks for again."""
    if block.knots is None:
        return (_direction_features if keep else gaussian_features)(argument, block.term.length)
    from scipy.linalg import solve_triangular

    lower = _knot_factor(block.knots, block.term.length)
    return np.asarray(solve_triangular(lower, gaussian_kernel(block.knots, argument, block.term.length), lower=True).T)


T = TypeVar("T")


class Store(OrderedDict[bytes, T]):
    """Values by their content; those used longest ago go first.

    Parameters
    ----------
    most : float
        Sum of the sizes that is held, one value at least.
    size : callable
        Of a value.
    """

    def __init__(self, most: float, size: Callable[[T], float] = lambda _: 1.0) -> None:
        super().__init__()
        self.most, self.size = most, size

    def made(self, key: bytes, make: Callable[[], T]) -> T:
        """The value of a key, made where it is not held."""
        if key not in self:
            self[key] = make()
            while len(self) > 1 and sum(map(self.size, self.values())) > self.most:
                self.popitem(last=False)
        self.move_to_end(key)
        return self[key]


def _digest(about: object, *arrays: FloatArray) -> bytes:
    """Key of some arrays and what else decides."""
    digest = hashlib.blake2b(repr((about, *(array.shape for array in arrays))).encode())
    for array in arrays:
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.digest()


NUGGET = 1e-6
"""Share of the variance that keeps the kernel between knots positive definite."""

_knot_factors: Store[FloatArray] = Store(8)
"""Of the last eight terms."""


def _knot_factor(knots: FloatArray, length: float) -> FloatArray:
    """Cholesky factor of the kernel between the knots of a term."""

    def make() -> FloatArray:
        return factor_of(gaussian_kernel(knots, knots, length) + NUGGET * np.eye(len(knots)))

    return _knot_factors.made(_digest(length, knots), make)


def _block_values(block: _Block, argument: FloatArray, weights: FloatArray) -> FloatArray:
    """:func:`_features` times weights (n,); of a term with knots the kernel is enough."""
    if block.knots is None:
        return np.asarray(_features(block, argument, keep=True) @ weights)
    from scipy.linalg import solve_triangular

    lower = _knot_factor(block.knots, block.term.length)
    at_knots = solve_triangular(lower, weights, lower=True, trans="T")
    return np.asarray(gaussian_kernel(argument, block.knots, block.term.length) @ at_knots)


FEATURES_MIB = 320
"""Features of directions that are kept at most: the same samples are predicted by one fit after the other."""

_features_of_directions: Store[FloatArray] = Store(FEATURES_MIB << 20, lambda features: features.nbytes)


def _direction_features(direction: FloatArray, length: float) -> FloatArray:
    """:func:`.sphere.gaussian_features`, kept."""
    return _features_of_directions.made(_digest(length, direction), lambda: gaussian_features(direction, length))


MEANS = 4096
"""Mean features that are kept at most, some kilobytes each."""

_mean_features_of_directions: Store[FloatArray] = Store(MEANS)


def _mean_features(block: _Block, argument: FloatArray) -> FloatArray:
    """Mean of :func:`_features` over the samples (columns of the block,); of directions it is kept."""
    if block.knots is not None:
        from scipy.linalg import solve_triangular

        at_knots = gaussian_kernel(block.knots, argument, block.term.length).mean(axis=1)
        return np.asarray(solve_triangular(_knot_factor(block.knots, block.term.length), at_knots, lower=True))
    key = _digest(block.term.length, argument)
    return _mean_features_of_directions.made(key, lambda: _features(block, argument).mean(axis=0))


Pairs = Mapping[str, FloatArray]
"""Knots (k, 6) of each antenna's term over both directions that serve several fits."""


def _pair_knots_of(own: Sequence[LinkSamples], length: float, pairs: Pairs) -> FloatArray:
    """Knots given for an antenna, or those of its bins."""
    given = pairs.get(own[0].antenna)
    return pair_knots(np.concatenate([argument_of(s, "pair") for s in own]), length) if given is None else given


def shared_knots(series: Sequence[LinkSamples], model: GainModel) -> dict[str, FloatArray]:
    """Knots per antenna that suit fits of any of the series: equations of one fit are then those of the next."""
    out: dict[str, FloatArray] = {}
    for term in (t for t in model.terms if t.frame == "pair"):
        for antenna in dict.fromkeys(s.antenna for s in series):
            own = binned_series([s for s in series if s.antenna == antenna], model.bin_s)
            out[antenna] = _pair_knots_of(own, term.length, {})
    return out


def _knots_of(term: Term, own: Sequence[LinkSamples], pairs: Pairs) -> FloatArray | None:
    """Knots of a term over places, or over both directions; None of one over a single direction."""
    if term.frame == "place":
        return _knots(np.concatenate([s.position_m for s in own]), 0.7 * term.length)
    return _pair_knots_of(own, term.length, pairs) if term.frame == "pair" else None


def _layout(model: GainModel, binned: Sequence[LinkSamples], pairs: Pairs) -> tuple[_Block, ...]:
    """Columns of every term."""
    antennas: list[str | None] = list(dict.fromkeys(s.antenna for s in binned))
    blocks: list[_Block] = []
    start = 0
    for term in model.terms:
        for antenna in antennas if term.per == "antenna" else [None]:
            knots = _knots_of(term, [s for s in binned if antenna is None or s.antenna == antenna], pairs)
            width = len(knots) if knots is not None else gaussian_features(np.eye(3)[:1], term.length).shape[1]
            blocks.append(_Block(term, antenna, start, start + width, knots))
            start += width
    if start > MOST_COLUMNS:
        raise UsageError(
            f"{start} unknowns for {len(antennas)} antennas and {len(model.terms)} terms",
            expected=f"at most {MOST_COLUMNS}",
            cause="many towers at once, or very short lengths: calibrate one tower at a time",
        )
    return tuple(blocks)


def _design(blocks: Sequence[_Block], samples: LinkSamples) -> FloatArray:
    """Features (n, p) of all terms, without their standard deviations; zero for other antennas."""
    out = np.zeros((len(samples), blocks[-1].stop if blocks else 0))
    for block in blocks:
        if block.antenna is None or block.antenna == samples.antenna:
            out[:, block.start : block.stop] = _features(block, argument_of(samples, block.term.frame))
    return out


def whitener(model: GainModel, samples: LinkSamples) -> FloatArray:
    """Cholesky factor of a series' own covariance: offset, nuisance, noise."""
    from scipy.linalg import cholesky
    from scipy.spatial.distance import cdist

    distance = cdist(samples.position_m, samples.position_m)
    own = model.own_sd_db**2 * np.exp(-distance / model.own_length_m) + (OFFSET_SD * model.noise_sd_db) ** 2
    own[np.diag_indices(len(own))] += model.noise_sd_db**2
    return np.asarray(cholesky(own, lower=True))


@dataclass(frozen=True, slots=True)
class _SeriesEquations:
    """Normal equations of one series in its own columns, whitened with the noise as the unit.

    ``gram`` (q, q), ``right`` (q,), ``square`` and ``log_det`` as in :class:`_System`; ``mean`` (q,) of the features
    over the ``rows``.
    """

    gram: FloatArray
    right: FloatArray
    square: float
    log_det: float
    mean: FloatArray
    rows: int


KEPT_MIB = 512
"""Equations that are kept at most; those that were used longest ago go first."""

_equations: Store[_SeriesEquations] = Store(KEPT_MIB << 20, lambda equations: equations.gram.nbytes)
"""Of series by their content. A flight left out, a factor of the spread, a common scale: each is another sum of the
same equations, since nuisance and noise keep their ratio and whitening is linear in their scale."""


def _runs(own: Sequence[_Block]) -> list[tuple[slice, slice]]:
    """Columns of each block in the whole, and among those of its series."""
    ends = np.cumsum([0, *(b.stop - b.start for b in own)]).tolist()
    return [(slice(b.start, b.stop), slice(ends[i], ends[i + 1])) for i, b in enumerate(own)]


def _ratio(model: GainModel) -> float:
    """Of nuisance and noise; scaled models share it but for the last digits."""
    return float(f"{model.own_sd_db / model.noise_sd_db:.12g}")


def _key(model: GainModel, own: Sequence[_Block], samples: LinkSamples) -> bytes:
    """Digest of everything that the equations of a series depend on."""
    terms = [(block.term.frame, block.term.length, block.knots is None) for block in own]
    knots = [block.knots for block in own if block.knots is not None]
    return _digest((_ratio(model), model.own_length_m, terms), *(getattr(samples, n) for n in _ARRAYS), *knots)


def _series_equations(model: GainModel, own: Sequence[_Block], samples: LinkSamples) -> _SeriesEquations:
    """Equations of one series, kept or made."""
    unit = dataclasses.replace(model, own_sd_db=_ratio(model), noise_sd_db=1.0)
    return _equations.made(_key(model, own, samples), lambda: _made_equations(unit, own, samples))


def _made_equations(model: GainModel, own: Sequence[_Block], samples: LinkSamples) -> _SeriesEquations:
    from scipy.linalg import solve_triangular
    from scipy.linalg.blas import dsyrk

    made: dict[Any, FloatArray] = {}  # a length that two terms share is made once
    parts = []
    for block in own:
        same = (block.term.frame, block.term.length, None if block.knots is None else block.start)
        if same not in made:
            made[same] = _features(block, argument_of(samples, block.term.frame))
        parts.append(made[same])
    design = np.concatenate([np.zeros((len(samples), 0)), *parts], axis=1)
    lower = whitener(model, samples)
    rows = np.asfortranarray(solve_triangular(lower, design, lower=True))
    target = solve_triangular(lower, samples.residual_db - samples.residual_db.mean(), lower=True)
    gram = dsyrk(1.0, rows, trans=1, lower=1) if rows.shape[1] else np.zeros((0, 0))
    return _SeriesEquations(
        gram=np.asarray(gram + np.tril(gram, -1).T),
        right=np.asarray(rows.T @ target),
        square=float(target @ target),
        log_det=float(np.log(np.diag(lower)).sum()),
        mean=design.mean(axis=0),
        rows=len(samples),
    )


@dataclass(slots=True)
class _Sum:
    """Running sum of the equations of several series, with the noise as the unit; ``members`` by key.

    ``steps``: series added to it and taken from it since it was made.
    """

    gram: FloatArray
    right: FloatArray
    square: float = 0.0
    log_det: float = 0.0
    total: dict[str, FloatArray] = field(default_factory=dict)
    count: dict[str, int] = field(default_factory=dict)
    members: dict[bytes, _Member] = field(default_factory=dict)
    steps: int = 0

    def add(self, member: _Member, sign: int) -> None:
        """Add a series, or take it away again."""
        one, runs = member.equations, member.runs
        for rows, from_row in runs:
            for columns, from_column in runs:
                into = self.gram[rows, columns]
                (np.add if sign > 0 else np.subtract)(into, one.gram[from_row, from_column], out=into)
            self.right[rows] += sign * one.right[from_row]
            self.total[member.antenna][rows] += sign * one.rows * one.mean[from_row]
        self.square += sign * one.square
        self.log_det += sign * one.log_det
        self.count[member.antenna] += sign * one.rows


@dataclass(frozen=True, slots=True)
class _Member:
    """Equations of one series, and where its columns stand in the whole."""

    antenna: str
    equations: _SeriesEquations
    runs: list[tuple[slice, slice]]


_last_sum: list[_Sum] = []
"""The last sum: most fits have some series more or fewer than the one before, or only another scale."""

LONGEST_CHAIN = 64
"""Series that are added to and taken from one sum before it is made anew: rounding adds up."""


def _summed(
    model: GainModel, series: Sequence[LinkSamples], blocks: Sequence[_Block]
) -> tuple[_System, dict[str, FloatArray]]:
    """Sum of the equations of all series, with the noise as the unit, and the mean of the features (p,) per antenna."""
    width = blocks[-1].stop if blocks else 0
    own = [[b for b in blocks if b.antenna in (None, s.antenna)] for s in series]
    keys = [
        _key(model, mine, s) + repr((width, s.antenna, [b.start for b in mine])).encode()
        for mine, s in zip(own, series, strict=True)
    ]
    antennas = dict.fromkeys(s.antenna for s in series)
    last = _last_sum[0] if _last_sum else None
    wanted = set(keys)
    gone = [] if last is None else [key for key in last.members if key not in wanted]
    new = [i for i, key in enumerate(keys) if last is None or key not in last.members]
    steps = len(gone) + len(new)
    if last is None or len(wanted) < len(keys) or steps >= len(keys) or last.steps + steps > LONGEST_CHAIN:
        last = _Sum(gram=np.zeros((width, width)), right=np.zeros(width))
        gone, new = [], list(range(len(keys)))
    else:
        last.steps += steps
    for antenna in antennas:
        last.total.setdefault(antenna, np.zeros(width))
        last.count.setdefault(antenna, 0)
    for key in gone:
        last.add(last.members.pop(key), -1)
    for i in new:
        member = _Member(series[i].antenna, _series_equations(model, own[i], series[i]), _runs(own[i]))
        last.add(member, 1)
        last.members[keys[i]] = member
    _last_sum[:] = [last]
    centre = {antenna: last.total[antenna] / last.count[antenna] for antenna in antennas}
    return _System(last.gram, last.right, last.square, last.log_det), centre


def _scale(blocks: Sequence[_Block], model: GainModel) -> FloatArray:
    """Standard deviation per column [dB]."""
    each = {(t.frame, t.per, t.length): t.sd_db for t in model.terms}
    return np.concatenate([np.full(b.stop - b.start, each[b.term.frame, b.term.per, b.term.length]) for b in blocks])


def factor_of(matrix: FloatArray) -> FloatArray:
    """Lower Cholesky factor of a symmetric matrix, in its place.

    Raises
    ------
    InputError
        It is not positive definite, or not finite.
    """
    from scipy.linalg import LinAlgError, cholesky

    try:
        if not np.isfinite(matrix.sum()):
            raise ValueError("numbers that are not finite")
        # the transpose is the same matrix in the order that LAPACK works on
        return np.asarray(cholesky(matrix.T, lower=True, overwrite_a=True, check_finite=False))
    except (LinAlgError, ValueError) as error:
        raise InputError(
            f"the equations of the fit cannot be solved ({error})",
            expected="levels that are finite and vary",
            cause="a channel that never changes, or values that are no levels",
        ) from None


def _apart(blocks: Sequence[_Block]) -> list[IntArray]:
    """Columns that no series couples: all in one, or those of each antenna where antennas share no term."""
    if any(b.antenna is None for b in blocks):
        return [np.arange(blocks[-1].stop)]
    names = dict.fromkeys(b.antenna for b in blocks)
    return [np.concatenate([np.arange(b.start, b.stop) for b in blocks if b.antenna == name]) for name in names]


def _posterior(
    system: _System, scale: FloatArray, groups: Sequence[IntArray]
) -> tuple[FloatArray, FloatArray, float, float]:
    """Weights (p,), Cholesky factor of the posterior precision of the unit-variance weights, log evidence, misfit.

    All with the noise as the unit.
    """
    from scipy.linalg import cho_solve

    lower = np.zeros_like(system.gram) if len(groups) > 1 else np.zeros((0, 0))
    for group in groups:
        whole = len(groups) == 1
        matrix = (system.gram if whole else system.gram[np.ix_(group, group)]) * scale[group, None]
        matrix *= scale[group]
        matrix[np.diag_indices(len(matrix))] += 1.0
        if whole:
            lower = factor_of(matrix)
        else:
            lower[np.ix_(group, group)] = factor_of(matrix)
    right = scale * system.right
    weights = cho_solve((lower, True), right, check_finite=False)
    misfit = system.square - float(right @ weights)
    return scale * weights, lower, -0.5 * misfit - float(np.log(np.diag(lower)).sum()) - system.log_det, misfit


@dataclass(frozen=True, slots=True)
class GainFit:
    """Gain over direction with its uncertainty.

    Parameters
    ----------
    model : GainModel
        With the standard deviations that were used.
    antennas : tuple of str
        ``tower.channel``, of those that were fitted.
    log_evidence : float
        Log marginal likelihood, but for a constant of the data.
    rows : int
        Bins.
    common_scale : float
        Factor on all standard deviations that makes them fit the data: ``s^2 = y' C^-1 y / rows``.
    """

    model: GainModel
    antennas: tuple[str, ...]
    log_evidence: float
    rows: int
    common_scale: float
    _series: int = field(repr=False)
    _blocks: tuple[_Block, ...] = field(repr=False)
    _weights: FloatArray = field(repr=False)
    _lower: FloatArray = field(repr=False)
    _scale: FloatArray = field(repr=False)
    _centre: Mapping[str, FloatArray] = field(repr=False)
    _seen: Mapping[str, FloatArray] = field(repr=False)

    def scaled(self) -> GainFit:
        """The fit with all standard deviations times :attr:`common_scale`: the same gains, other uncertainties."""
        s = self.common_scale
        misfit = s**2 * (self.rows - self._series)
        return dataclasses.replace(
            self,
            model=scaled_model(self.model, s),
            log_evidence=self.log_evidence + 0.5 * misfit * (1.0 - s**-2) - self.rows * math.log(s),
            common_scale=1.0,
            _scale=self._scale * s,
        )

    def predict(self, samples: LinkSamples, frames: Iterable[Frame] | None = None) -> tuple[FloatArray, FloatArray]:
        """Gain of all terms together along samples, about its mean over the samples it was learned from.

        Parameters
        ----------
        samples : LinkSamples
            Of a fitted antenna; their residual is not used.
        frames : iterable of Frame, optional
            Terms that count; all by default.

        Returns
        -------
        gain_db, sd_db : (n,)
            Posterior mean and standard deviation [dB]; NaN where a direction is NaN.

        Raises
        ------
        UsageError
            If no flight of the fit had this tower and channel.
        """
        gain, sd = np.full(len(samples), np.nan), np.full(len(samples), np.nan)
        blocks, good = self._chosen(samples, frames), self._known_rows(samples)
        for start in range(0, len(good), 2000):
            rows = good[start : start + 2000]
            gain[rows], sd[rows] = self._moments(samples.antenna, blocks, samples.part(rows))
        return gain, sd

    def mean(self, samples: LinkSamples, frames: Iterable[Frame] | None = None) -> FloatArray:
        """The gain of :meth:`predict` alone (n,) [dB]: the standard deviation costs a hundred times as much."""
        gain = np.full(len(samples), np.nan)
        blocks, rows = self._chosen(samples, frames), self._known_rows(samples)
        known = samples if len(rows) == len(samples) else samples.part(rows)
        centre = self._centre[samples.antenna]
        total = np.zeros(len(rows))
        for block in blocks:
            columns = slice(block.start, block.stop)
            values = _block_values(block, argument_of(known, block.term.frame), self._weights[columns])
            total += values - centre[columns] @ self._weights[columns]
        gain[rows] = total
        return gain

    def average(self, samples: LinkSamples) -> float:
        """Mean of :meth:`mean` over the samples [dB]; their mean features are kept for other fits."""
        blocks, rows = self._chosen(samples, None), self._known_rows(samples)
        known = samples if len(rows) == len(samples) else samples.part(rows)
        centre = self._centre[samples.antenna]
        total = 0.0
        for block in blocks:
            columns = slice(block.start, block.stop)
            mean = _mean_features(block, argument_of(known, block.term.frame))
            total += float((mean - centre[columns]) @ self._weights[columns])
        return total

    def _chosen(self, samples: LinkSamples, frames: Iterable[Frame] | None) -> list[_Block]:
        """Blocks of some frames that an antenna has."""
        if samples.antenna not in self.antennas:
            raise UsageError(
                f"tower and channel {samples.antenna!r} were not fitted", expected="one of " + ", ".join(self.antennas)
            )
        own = [b for b in self._blocks if b.antenna in (None, samples.antenna)]
        return own if frames is None else [b for b in own if b.term.frame in set(frames)]

    @staticmethod
    def _known_rows(samples: LinkSamples) -> IntArray:
        finite = np.isfinite(np.concatenate([samples.at_uav, samples.at_tower, samples.position_m], axis=1))
        return np.flatnonzero(finite.all(axis=1))

    def gain(self, frame: Frame, antenna: str, direction: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Gain at one end over directions (n, 3), or of the pair of ends (n, 6): posterior mean and SD (n,) [dB].

        Zero is the mean over the bins of the flights: the level itself is in the offsets.
        """
        direction = np.asarray(direction, dtype=np.float64)
        blocks = [b for b in self._blocks if b.term.frame == frame and b.antenna in (None, antenna)]
        return self._moments(antenna, blocks, direction)

    def seen(self, frame: Frame, antenna: str) -> FloatArray:
        """Directions (m, 3) of the bins of the fit at one end, the UAV's of all antennas together; (m, 6) of pairs."""
        if frame == "body":
            return np.concatenate([self._seen[f"body.{a}"] for a in self.antennas])
        return self._seen[f"{frame}.{antenna}"]

    def sd_about_mean(self, samples: LinkSamples) -> FloatArray:
        """Standard deviation (n,) of the gain along samples about its mean over them, as an own offset leaves it [dB].

        Every sample must have both directions.
        """
        blocks, centre = self._chosen(samples, None), np.zeros(len(self._weights))
        for block in blocks:
            centre[block.start : block.stop] = _mean_features(block, argument_of(samples, block.term.frame))
        return self._moments(samples.antenna, blocks, samples, centre)[1]

    def _moments(
        self, antenna: str, blocks: Sequence[_Block], at: LinkSamples | FloatArray, about: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Sum of some terms along samples, or at arguments of their one frame: mean and standard deviation (n,).

        ``about``: features (columns,) whose gain counts as zero; the mean over the bins of the fit without.
        """
        from scipy.linalg import solve_triangular

        design, beyond = np.zeros((len(at), len(self._weights))), np.zeros(len(at))
        centre = self._centre[antenna] if about is None else about
        for block in blocks:
            columns = slice(block.start, block.stop)
            features = _features(block, argument_of(at, block.term.frame) if isinstance(at, LinkSamples) else at)
            design[:, columns] = features - centre[columns]
            if block.knots is not None:  # what the knots say nothing about is as the prior has it
                beyond += self._scale[block.start] ** 2 * np.maximum(1.0 - (features**2).sum(axis=1), 0.0)
        if not blocks:
            return np.zeros(len(at)), beyond
        spread = solve_triangular(self._lower, (design * self._scale).T, lower=True)
        return design @ self._weights, np.sqrt((spread**2).sum(axis=0) + beyond)


def fit_gain(series: Sequence[LinkSamples], model: GainModel | None = None, pairs: Pairs | None = None) -> GainFit:
    """Learn the gain over direction.

    Parameters
    ----------
    series : sequence of LinkSamples
        Of all flights.
    model : GainModel, optional
        Terms and their strength; see :func:`.gain_choice.choose_and_fit`.
    pairs : mapping of str to (k, 6), optional
        Knots of :func:`shared_knots`; without, those of these series.

    Returns
    -------
    GainFit

    Raises
    ------
    InputError
        If no sample counts, or the equations cannot be solved.
    UsageError
        If there are more unknowns than memory is allowed for.

    Notes
    -----
    ``w ~ N(0, I)``, ``y = offset + A S w + own + noise``: with the series' own covariance ``C`` the posterior precision
    is ``I + S A' C^-1 A S`` (Rasmussen and Williams, Gaussian Processes for Machine Learning, eq. 2.11). The solution
    is exact but for the harmonics left out (:func:`.sphere.gaussian_spectrum`) and the share of the variance over both
    directions that :func:`pair_knots` leaves (0.1 % each, where they suffice), and the average over ``bin_s``.
    """
    model = model or GainModel()
    binned = binned_series(series, model.bin_s)
    blocks = _layout(model, binned, pairs or {})
    system, centre = _summed(model, binned, blocks)
    scale, noise = _scale(blocks, model), model.noise_sd_db
    weights, lower, evidence, misfit = _posterior(system, scale / noise, _apart(blocks))
    rows = sum(map(len, binned))
    return GainFit(
        model=model,
        antennas=tuple(dict.fromkeys(s.antenna for s in binned)),
        log_evidence=evidence + 0.5 * misfit * (1.0 - noise**-2) - rows * math.log(noise),
        rows=rows,
        common_scale=math.sqrt(max(misfit / noise**2 / max(rows - len(binned), 1), 1e-6)),
        _series=min(len(binned), rows - 1),
        _blocks=blocks,
        _weights=weights,
        _lower=lower,
        _scale=scale,
        _centre=centre,
        _seen=_seen(binned),
    )


def binned_series(series: Sequence[LinkSamples], bin_s: float) -> list[LinkSamples]:
    """Means over bins of each series that has any; InputError if none has."""
    binned = [s.binned(bin_s) for s in series]
    binned = [s for s in binned if len(s)]
    if not binned:
        raise InputError("no sample has a level and a direction", expected="RSS with positions and attitude")
    return binned


def _seen(binned: Sequence[LinkSamples]) -> dict[str, FloatArray]:
    directions = {}
    for antenna in dict.fromkeys(s.antenna for s in binned):
        own = [s for s in binned if s.antenna == antenna]
        directions[f"body.{antenna}"] = np.concatenate([s.at_uav for s in own])
        directions[f"mast.{antenna}"] = np.concatenate([s.at_tower for s in own])
        directions[f"pair.{antenna}"] = np.concatenate([argument_of(s, "pair") for s in own])
    return directions


def column_forms(
    series: Sequence[LinkSamples], model: GainModel, columns: Callable[[LinkSamples], FloatArray], width: int
) -> FloatArray:
    """``X' Sigma^-1 X`` (width, width), Sigma the covariance of a model with the gains integrated out.

    ``columns(series) -> (bins, width)`` must keep the bins of :meth:`LinkSamples.binned`.

    Parameters
    ----------
    series : sequence of LinkSamples
    model : GainModel
        Its priors and noise make Sigma.
    columns : callable
        The columns X of one series, (bins, width).
    width : int
        Number of columns.

    Returns
    -------
    (width, width)
        Symmetric, positive semidefinite [squared unit of the columns per dB^2].

    Notes
    -----
    ``Sigma = N + D S S D'``: N has a block per series (offset, nuisance over distance, noise), D is the design of the
    gains and S the standard deviation of their prior. It is inverted by Woodbury's identity: no matrix is larger than
    a series or than the number of gains.
    """
    from scipy.linalg import cholesky, solve_triangular

    kept = [s for s in series if len(s.binned(model.bin_s))]
    binned = binned_series(kept, model.bin_s)
    blocks = _layout(model, binned, {})
    scale = _scale(blocks, model)
    form, cross = np.zeros((width, width)), np.zeros((len(scale), width))
    gram = np.zeros((len(scale), len(scale)))
    for raw, samples in zip(kept, binned, strict=True):
        lower = whitener(model, samples)
        rows = solve_triangular(lower, _design(blocks, samples) * scale, lower=True)
        values = solve_triangular(lower, columns(raw), lower=True)
        form += values.T @ values
        cross += rows.T @ values
        gram += rows.T @ rows
    gram[np.diag_indices(len(gram))] += 1.0
    inside = solve_triangular(cholesky(gram, lower=True), cross, lower=True)
    return np.asarray(form - inside.T @ inside)
