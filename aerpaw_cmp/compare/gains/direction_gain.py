"""Gain over direction at both ends of a link, learned from the residuals of several flights.

``residual = offset + g_uav(body) + g_tower(mast) + g_pair(body, mast) + own + noise``

``offset`` is free per flight, tower and channel. ``own`` is a nuisance of each flight and channel, correlated over
place, so that the shadowing of one flight is not learned as antenna. The gains are Gaussian processes over directions:
of the tower in the body, of the UAV at the mast, and of both together per channel (what the gain at one end does not
explain without the other).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import groupby, product
from typing import Any, Literal

import numpy as np

from ...common.errors import InputError, UsageError
from ...common.gaussian import Factor, gaussian_kernel
from ...common.units import BoolArray, FloatArray, IntArray

Frame = Literal["body", "mast", "pair"]
_Sharing = Literal["all", "antenna"]

# Prior of each offset in standard deviations of the noise: free in effect, and still a proper covariance.
_OFFSET_SD = 100.0

# Means that a fit rests on (a matrix of 72 MB); of more flights they are over longer times.
MOST_ROWS = 3000

# Of the tower's gains against the UAV's: the likelier one is taken. Nothing else is chosen on flights: a length of the
# nuisance by likelihood and its strength by flights left out, of 0.5 to 4, left 0.06 dB more on dataset 12.
_TOWER_FACTORS = (1.0, 0.5)


def link_directions(tower_m: FloatArray, position_m: FloatArray, rotation: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Unit vectors (n, 3) of both ends towards each other: at the UAV in its body frame, at the tower in the mast's.

    Parameters
    ----------
    tower_m : (3,) or (n, 3)
        Place of the tower's array [m].
    position_m : (n, 3)
    rotation : (n, 3, 3)
        From the body frame to the site's.
    """
    ray = position_m - tower_m
    at_tower = ray / np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), 1e-9)
    return np.einsum("nji,nj->ni", rotation, -at_tower), at_tower


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
        finite = np.isfinite(self.residual_db) & np.isfinite(self.at_uav).all(axis=1)
        if not finite.any():
            return self.part(finite)
        part = self.part(finite)
        # from the first sample: the bins of a log do not depend on where it was cut
        _, member = np.unique(np.floor((part.time_s - part.time_s[0]) / width_s).astype(np.int64), return_inverse=True)
        means: dict[str, Any] = {name: _bin_means(getattr(part, name), member) for name in _ARRAYS}
        for name in ("at_uav", "at_tower"):
            means[name] /= np.linalg.norm(means[name], axis=1, keepdims=True)
        return dataclasses.replace(part, floor_db=None, **means)


_ARRAYS = ("time_s", "position_m", "at_uav", "at_tower", "residual_db")


def _bin_means(values: FloatArray, member: IntArray) -> FloatArray:
    count = np.bincount(member)
    if values.ndim == 1:
        return np.asarray(np.bincount(member, weights=values) / count)
    return np.stack([np.bincount(member, weights=column) / count for column in values.T], axis=1)


@dataclass(frozen=True, slots=True)
class Term:
    """One Gaussian process: its covariance falls exponentially, or, of the pair, as a Gaussian.

    Parameters
    ----------
    frame : {"body", "mast", "pair"}
        Its argument: direction of the tower in the body, of the UAV at the mast, or both of these.
    per : {"all", "antenna"}
        One function for all, or one per tower and channel.
    length : float
        Chord on the unit sphere.
    sd_db : float
        Standard deviation [dB].
    """

    frame: Frame
    per: _Sharing
    length: float
    sd_db: float


ANTENNA_TERMS = (Term("body", "all", 1.0, 3.2), Term("mast", "antenna", 0.5, 3.4), Term("pair", "antenna", 0.35, 1.5))


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
    own_sd_db: float = 1.2
    own_length_m: float = 20.0
    noise_sd_db: float = 1.5
    bin_s: float = 4.0

    def scaled(self, factor: float) -> GainModel:
        """All standard deviations times a factor."""
        return dataclasses.replace(
            self,
            terms=tuple(dataclasses.replace(t, sd_db=t.sd_db * factor) for t in self.terms),
            own_sd_db=self.own_sd_db * factor,
            noise_sd_db=self.noise_sd_db * factor,
        )


def argument_of(samples: LinkSamples, frame: Frame) -> FloatArray:
    """Argument of a term of this frame: (n, 3), or (n, 6) of both directions."""
    if frame == "pair":
        return np.concatenate([samples.at_uav, samples.at_tower], axis=1)
    return samples.at_uav if frame == "body" else samples.at_tower


def term_kernel(term: Term, at: FloatArray, to: FloatArray) -> FloatArray:
    """Covariance (n, m) of a term between arguments [dB^2].

    Gains of airframes have details of every size: an exponential leaves 0.1 dB less than sums of Gaussians.
    """
    from scipy.spatial.distance import cdist

    if term.frame == "pair":
        kernel = gaussian_kernel(at, to, term.length)
    else:  # in place: these matrices are most of the time of a calibration
        kernel = np.asarray(cdist(at, to))
        kernel /= -term.length
        np.exp(kernel, out=kernel)
    kernel *= term.sd_db**2
    return kernel


@lru_cache(maxsize=len(ANTENNA_TERMS))
def _last_kernel(term: Term, at: bytes, to: bytes) -> FloatArray:
    """Return :func:`term_kernel` of float64 arguments, kept: channels of one log have the same directions."""
    width = 6 if term.frame == "pair" else 3
    return term_kernel(term, np.frombuffer(at).reshape(-1, width), np.frombuffer(to).reshape(-1, width))


def gain_covariance(terms: Sequence[Term], first: Sequence[LinkSamples], second: Sequence[LinkSamples]) -> FloatArray:
    """Covariance (n, m) of the gains between samples of some series and of others [dB^2]."""
    rows, columns = _antennas(first), _antennas(second)
    out = np.zeros((sum(map(len, first)), sum(map(len, second))))
    for term in terms:
        at, to = (np.concatenate([argument_of(s, term.frame) for s in series]) for series in (first, second))
        blocks: dict[tuple[bytes, bytes], FloatArray] = {}
        for (name, mine), (other, theirs) in product(rows, columns):
            if term.per == "antenna" and name != other:  # gains of two antennas share nothing
                continue
            key = at[mine].tobytes(), to[theirs].tobytes()  # channels of one log have the same directions
            blocks[key] = term_kernel(term, at[mine], to[theirs]) if key not in blocks else blocks[key]
            out[mine, theirs] += blocks[key]
    return out


def _antennas(series: Sequence[LinkSamples]) -> list[tuple[str, slice]]:
    """Antennas of series one after another, and where the samples of each begin and end."""
    out, start = [], 0
    for name, some in groupby(series, lambda s: s.antenna):
        stop = start + sum(map(len, some))
        out.append((name, slice(start, stop)))
        start = stop
    return out


def _expected(
    terms: Sequence[Term], samples: LinkSamples, rows: Sequence[LinkSamples], weights: FloatArray
) -> FloatArray:
    """Gains (n,) along samples by the weights of the rows [dB]."""
    gain, own = np.zeros(len(samples)), np.repeat([s.antenna == samples.antenna for s in rows], [len(s) for s in rows])
    for term in terms:
        shared = own if term.per == "antenna" else np.ones_like(own)
        at = np.concatenate([argument_of(s, term.frame) for s in rows])[shared]
        at, place = np.unique(at, axis=0, return_inverse=True)  # channels of one log have the same directions
        kernel = _last_kernel(term, argument_of(samples, term.frame).tobytes(), at.tobytes())
        gain += kernel @ np.bincount(place, weights[shared])
    return gain


def own_covariance(model: GainModel, samples: LinkSamples) -> FloatArray:
    """Covariance (n, n) of a series' offset, nuisance and noise [dB^2]."""
    from scipy.spatial.distance import cdist

    distance = cdist(samples.position_m, samples.position_m)
    own = model.own_sd_db**2 * np.exp(-distance / model.own_length_m) + (_OFFSET_SD * model.noise_sd_db) ** 2
    own[np.diag_indices(len(own))] += model.noise_sd_db**2
    return np.asarray(own)


def _covariance_of_levels(model: GainModel, rows: Sequence[LinkSamples]) -> FloatArray:
    """Covariance (n, n) of the levels of all rows: gains, and what each series has of its own [dB^2]."""
    out, start = gain_covariance(model.terms, rows, rows), 0
    for samples in rows:
        block = slice(start, start + len(samples))
        out[block, block] += own_covariance(model, samples)
        start = block.stop
    return out


@dataclass(frozen=True, slots=True)
class GainFit:
    """Gain over direction with its uncertainty.

    Parameters
    ----------
    model : GainModel
        With the standard deviations and the bins that were used.
    rows : tuple of LinkSamples
        Means over bins that were learned from.
    log_evidence : float
        Log marginal likelihood, but for a constant of the data.
    common_scale : float
        Factor on all standard deviations that makes them fit the data: ``s^2 = y' C^-1 y / rows``.
    """

    model: GainModel
    rows: tuple[LinkSamples, ...]
    log_evidence: float
    common_scale: float
    _weights: FloatArray = field(repr=False)
    _factor: Factor = field(repr=False)
    # mean gain over the rows of each antenna
    _zero: Mapping[str, float] = field(repr=False)

    @property
    def antennas(self) -> tuple[str, ...]:
        """``tower.channel`` of those that were fitted."""
        return tuple(dict.fromkeys(s.antenna for s in self.rows))

    def scaled(self) -> GainFit:
        """The fit with all standard deviations times :attr:`common_scale`: the same gains, other uncertainties."""
        # a scale moves no mean: the factor and the evidence follow in closed form
        s, count = self.common_scale, len(self._weights)
        misfit = s**2 * max(count - len(self.rows), 1)
        return dataclasses.replace(
            self,
            model=self.model.scaled(s),
            log_evidence=self.log_evidence + 0.5 * misfit * (1.0 - s**-2) - count * math.log(s),
            common_scale=1.0,
            _weights=self._weights / s**2,
            _factor=Factor(self._factor.lower * s),
        )

    def predict(self, samples: LinkSamples, frames: Sequence[Frame] | None = None) -> tuple[FloatArray, FloatArray]:
        """Gain of all terms together along samples, about its mean over the samples it was learned from.

        Parameters
        ----------
        samples : LinkSamples
            Of a fitted antenna; their residual is not used.
        frames : sequence of Frame, optional
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
        terms = [t for t in self.model.terms if frames is None or t.frame in frames]
        known = self._known_rows(samples)
        for start in range(0, len(known), AT_ONCE):
            part = known[start : start + AT_ONCE]
            gain[part], sd[part] = self._moments(terms, samples.part(part), self._rows_of(samples.antenna))
        return gain, sd

    def mean(self, samples: LinkSamples) -> FloatArray:
        """The gain of :meth:`predict` alone (n,) [dB]."""
        self._rows_of(samples.antenna)
        gain, known = np.full(len(samples), np.nan), self._known_rows(samples)
        for start in range(0, len(known), AT_ONCE):
            part = known[start : start + AT_ONCE]
            gain[part] = _expected(self.model.terms, samples.part(part), self.rows, self._weights)
        return gain - self._zero[samples.antenna]

    def gain(self, frame: Frame, antenna: str, direction: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Gain at one end over directions (n, 3), or of the pair of ends (n, 6): posterior mean and SD (n,) [dB].

        Zero is the mean over the bins of the flights: the level itself is in the offsets.
        """
        return self.predict(directed(antenna, np.asarray(direction, dtype=np.float64)), (frame,))

    def seen(self, frame: Frame, antenna: str) -> FloatArray:
        """Directions (m, 3) of the bins of the fit at one end, the UAV's of all antennas together; (m, 6) of pairs."""
        return np.concatenate(
            [argument_of(s, frame) for s in (self.rows if frame == "body" else self._rows_of(antenna))]
        )

    def sd_about_mean(self, samples: LinkSamples) -> FloatArray:
        """Standard deviation (n,) of the gain along samples about its mean over them, as an own offset leaves it [dB].

        Every sample must have both directions.
        """
        self._rows_of(samples.antenna)
        return self._moments(self.model.terms, samples, [samples])[1]

    def _rows_of(self, antenna: str) -> list[LinkSamples]:
        """Rows of an antenna."""
        rows = [s for s in self.rows if s.antenna == antenna]
        if not rows:
            raise UsageError(
                f"tower and channel {antenna!r} were not fitted", expected="one of " + ", ".join(self.antennas)
            )
        return rows

    @staticmethod
    def _known_rows(samples: LinkSamples) -> IntArray:
        finite = np.isfinite(np.concatenate([samples.at_uav, samples.at_tower, samples.position_m], axis=1))
        return np.flatnonzero(finite.all(axis=1))

    def covariance(self, frame: Frame, antenna: str, direction: FloatArray) -> FloatArray:
        """Return the covariance (n, n) of :meth:`gain` towards directions (n, 3) [dB^2]."""
        terms = [t for t in self.model.terms if t.frame == frame]
        at, about = directed(antenna, np.asarray(direction, dtype=np.float64)), self._rows_of(antenna)
        centre = gain_covariance(terms, about, [at, *self.rows]).mean(axis=0)
        across = gain_covariance(terms, [at], self.rows) - centre[len(at) :]
        centre = centre[: len(at)]
        prior = gain_covariance(terms, [at], [at]) - centre[:, None] - centre
        prior += gain_covariance(terms, about, about).mean()
        spread = self._factor.whiten(across.T)
        return np.asarray(prior - spread.T @ spread)

    def _moments(
        self, terms: Sequence[Term], at: LinkSamples, about: Sequence[LinkSamples]
    ) -> tuple[FloatArray, FloatArray]:
        """Sum of some terms along samples about its mean over others: mean and standard deviation (n,)."""
        centre = gain_covariance(terms, about, [at, *self.rows]).mean(axis=0)
        across = gain_covariance(terms, [at], self.rows) - centre[len(at) :]
        # between samples of one antenna every term counts
        prior = sum(t.sd_db**2 for t in terms) - 2.0 * centre[: len(at)] + gain_covariance(terms, about, about).mean()
        spread = self._factor.whiten(across.T)
        return across @ self._weights, np.sqrt(np.maximum(prior - (spread**2).sum(axis=0), 0.0))


# Samples that are predicted at a time; bounds the memory.
AT_ONCE = 2000


def directed(antenna: str, direction: FloatArray) -> LinkSamples:
    """Samples (n,) of an antenna towards directions (n, 3), the same at both ends, or pairs of them (n, 6)."""
    count = len(direction)
    tower, _, channel = antenna.partition(".")
    return LinkSamples(
        flight="",
        tower=tower,
        channel=channel,
        time_s=np.arange(float(count)),
        position_m=np.zeros((count, 3)),
        at_uav=direction[:, :3],
        at_tower=direction[:, -3:],
        residual_db=np.full(count, np.nan),
    )


def fit_gain(series: Sequence[LinkSamples], model: GainModel | None = None) -> GainFit:
    """Learn the gain over direction.

    Parameters
    ----------
    series : sequence of LinkSamples
        Of all flights.
    model : GainModel, optional
        Terms and their strength; see :func:`chosen_fit`.

    Returns
    -------
    GainFit

    Raises
    ------
    InputError
        If no sample counts, or the equations cannot be solved.

    Notes
    -----
    ``y = offset + gains + own + noise``, all normal: with the covariance ``C`` of the rows the gain at directions of
    covariance ``k`` with them is ``k' C^-1 y`` (:class:`~aerpaw_cmp.common.gaussian.Factor`). The solution is exact
    but for the average over ``bin_s``.
    """
    model, rows = _binned_series(series, model or GainModel())
    return _solved(model, rows, _covariance_of_levels(model, rows))


def _solved(model: GainModel, rows: Sequence[LinkSamples], covariance: FloatArray) -> GainFit:
    """The fit of rows with the covariance of their levels, in the place of which it is factored."""
    # in its place: at 3 000 rows a copy is 72 MB
    factor = Factor.of(covariance)
    target = np.concatenate([s.residual_db - s.residual_db.mean() for s in rows])
    weights = factor.solve(target)
    misfit = float(target @ weights)
    # what the equations leave to the gains
    parts = np.split(weights, np.cumsum([len(s) for s in rows])[:-1])
    gain = target - np.concatenate([own_covariance(model, s) @ w for s, w in zip(rows, parts, strict=True)])
    return GainFit(
        model=model,
        rows=tuple(rows),
        log_evidence=factor.log_likelihood(target),
        # the offset of each series takes a degree of freedom
        common_scale=math.sqrt(max(misfit / max(len(target) - len(rows), 1), 1e-6)),
        _weights=weights,
        _factor=factor,
        _zero={name: float(gain[part].mean()) for name, part in _antennas(rows)},
    )


def chosen_fit(series: Sequence[LinkSamples], model: GainModel | None = None) -> GainFit:
    """:func:`fit_gain` with the likelier strength of the tower's gains and the common scale of all.

    The scale, which changes no mean, makes the standard deviations fit the data: ``s^2 = y' C^-1 y / rows``.
    """
    model, rows = _binned_series(series, model or GainModel())
    mast = [t for t in model.terms if t.frame == "mast"]
    if not 0 < len(mast) < len(model.terms):
        return _solved(model, rows, _covariance_of_levels(model, rows)).scaled()
    others = dataclasses.replace(model, terms=tuple(t for t in model.terms if t not in mast))
    of_others, of_towers = _covariance_of_levels(others, rows), gain_covariance(mast, rows, rows)
    fits = []
    for factor in _TOWER_FACTORS:
        terms = tuple(dataclasses.replace(t, sd_db=t.sd_db * factor) if t in mast else t for t in model.terms)
        covariance = factor**2 * of_towers
        covariance += of_others
        fits.append(_solved(dataclasses.replace(model, terms=terms), rows, covariance).scaled())
    return max(fits, key=lambda fit: fit.log_evidence)


def _binned_series(series: Sequence[LinkSamples], model: GainModel) -> tuple[GainModel, list[LinkSamples]]:
    """Means over bins of each series that has any, and the model with the bins used; InputError if none has."""
    binned = [s.binned(model.bin_s) for s in series]
    longer = math.ceil(sum(map(len, binned)) / MOST_ROWS)
    if longer > 1:
        model = dataclasses.replace(model, bin_s=model.bin_s * longer)
        binned = [s.binned(model.bin_s) for s in series]
    binned = [s for s in binned if len(s)]
    if not binned:
        raise InputError("no sample has a level and a direction", expected="RSS with positions and attitude")
    antennas = [s.antenna for s in binned]
    # antenna after antenna: what they do not share is zeros in blocks
    return model, sorted(binned, key=lambda s: antennas.index(s.antenna))


def column_forms(
    series: Sequence[LinkSamples],
    model: GainModel,
    columns: Callable[[LinkSamples, float], FloatArray],
) -> FloatArray:
    """``X' Sigma^-1 X`` (width, width), Sigma the covariance of a model with the gains integrated out.

    Parameters
    ----------
    series : sequence of LinkSamples
    model : GainModel
        Its priors and noise make Sigma.
    columns : callable
        ``columns(series, bin_s)`` gives the columns X of one series (bins, width), of :meth:`LinkSamples.binned`.

    Returns
    -------
    (width, width)
        Symmetric, positive semidefinite [squared unit of the columns per dB^2].
    """
    model, rows = _binned_series(series, model)
    names = [s.antenna for s in rows]
    some = [s for s in series if len(s.binned(model.bin_s))]
    values = np.concatenate([columns(s, model.bin_s) for s in sorted(some, key=lambda s: names.index(s.antenna))])
    inside = Factor.of(_covariance_of_levels(model, rows)).whiten(values)
    return np.asarray(inside.T @ inside)
