"""Gains over direction that are learned from flights: model, fit, error model, mounts, and evidence for a flight.

The gain over direction at both ends of a link is learned from the residuals of several flights:

``residual = offset + g_uav(body) + g_tower(mast) + g_pair(body, mast) + own + noise``

``offset`` is free per flight, tower and channel. ``own`` is an error of each flight and channel that is correlated over
position (the nuisance), so that the shadowing of one flight is not learned as antenna gain. The gains are Gaussian
processes. The gain of the UAV depends on the direction of the tower in the body frame, and the gain of the tower on the
direction of the UAV at the mast. The third gain depends on both directions, is separate for each channel, and contains
what the first two do not explain.

For antennas with a known pattern, the azimuths of their mounts at both ends are fitted to several flights together.

Pitch and roll of a mount are 0: tilts that were fitted to one flight of dataset 12 (up to 20 degrees) raised the error
of the other flight from 3.53 to 4.00 dB.

The error model of a level with learned antennas consists of gain, nuisance of the flight, noise and fading.

The levels of a flight show whether antennas learned on other flights apply to it. The levels must be more
likely with the learned gain than with an unknown gain under the prior of a calibration. They must also be more likely
than with the learned gain of the UAV rotated by 90, 180 or 270 deg. Offset, nuisance, noise and all other gains are the
same in each case. The names of readers, files and channels do not matter.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from itertools import groupby, product
from typing import Any, Literal

import numpy as np

from ..common.errors import InputError, UsageError
from ..common.gaussian import Factor, gaussian_kernel
from ..common.units import BoolArray, FloatArray, IntArray, wrap_degrees
from .level import crps_normal

Frame = Literal["body", "mast", "pair"]

# Prior standard deviation of each offset in units of the noise: so large that the offset is practically free.
_OFFSET_SD = 100.0

# Largest number of means in a fit (a matrix of 72 MB). Many flights are averaged over longer times to stay below this
# number.
MOST_ROWS = 3000

# Candidate strengths of the tower's gains relative to the UAV's. The likelihood selects a factor. No other parameter is
# selected this way: selecting length and strength of the nuisance raised the error on dataset 12 by 0.06 dB.
_TOWER_FACTORS = (1.0, 0.5)


def link_directions(tower_m: FloatArray, position_m: FloatArray, rotation: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return unit vectors (n, 3) towards the tower in the UAV's body frame, and towards the UAV in the mast's frame.

    Parameters
    ----------
    tower_m : (3,) or (n, 3)
        Position of the array of the tower [m].
    position_m : (n, 3)
    rotation : (n, 3, 3)
        Rotation from the body frame to the site frame.
    """
    ray = position_m - tower_m
    at_tower = ray / np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), 1e-9)
    return np.einsum("nji,nj->ni", rotation, -at_tower), at_tower


def rotated(direction: FloatArray, turn_deg: float) -> FloatArray:
    """Return directions (..., 3) in the body frame, rotated counter-clockwise about its vertical axis."""
    return np.asarray(direction @ turned(turn_deg).T)


@dataclass(frozen=True, slots=True)
class LinkSamples:
    """Measured minus predicted levels of one flight and channel of a tower, without the gain that is to be learned.

    Parameters
    ----------
    flight, tower, channel : str
        Names. Tower and channel together identify an antenna.
    time_s : (n,)
        Increasing times [s].
    position_m : (n, 3)
        Position of the UAV: east, north, up [m].
    at_uav : (n, 3)
        Unit vector towards the tower in the body frame (forward, left, up).
    at_tower : (n, 3)
        Unit vector towards the UAV in the frame of the mast (east, north, up).
    residual_db : (n,)
        Measured minus model [dB]; NaN is ignored.
    floor_db : (n,), optional
        Residual that a level at the floor of the receiver would have [dB]. A smaller residual is only an upper limit.
    campaign : str
        Measurement campaign. All its flights have the same parameters of nuisance and noise.
    airframe : str
        Airframe and band. Different airframes have independent gains.
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
    campaign: str = ""
    airframe: str = ""

    @property
    def antenna(self) -> str:
        """Name of the antenna at the tower."""
        return f"{self.tower}.{self.channel}"

    @property
    def group(self) -> tuple[str, str, str]:
        """Antenna, campaign and airframe. Samples with equal groups share all gains."""
        return self.antenna, self.campaign, self.airframe

    def __len__(self) -> int:
        return len(self.time_s)

    def part(self, keep: BoolArray | IntArray) -> LinkSamples:
        """Return the selected samples."""
        arrays: dict[str, Any] = {name: getattr(self, name)[keep] for name in _ARRAYS}
        floor_db = None if self.floor_db is None else self.floor_db[keep]
        return dataclasses.replace(self, floor_db=floor_db, **arrays)

    def binned(self, width_s: float) -> LinkSamples:
        """Return means over time bins. The mean directions are normalised.

        Within a few seconds, the direction changes by less than the correlation lengths of the gains.
        """
        finite = np.isfinite(self.residual_db) & np.isfinite(self.at_uav).all(axis=1)
        if not finite.any():
            return self.part(finite)
        part = self.part(finite)
        # count from the first sample, so that bins do not depend on the start of the log
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
    """One Gaussian process of a gain. The covariance is exponential, or Gaussian for the pair of ends.

    Parameters
    ----------
    frame : {"body", "mast", "pair"}
        Argument of the process: direction of the tower in the body frame, of the UAV at the mast, or both.
    per : {"all", "antenna"}
        One gain for all antennas of the towers, or one per antenna (tower and channel).
    length : float
        Length of the kernel, as a chord on the unit sphere.
    sd_db : float
        Standard deviation [dB].
    tied : float
        Share of the variance that campaigns with the same airframe have in common. The evidence of dataset 12, LTE and
        AADM is almost constant from 0.7 to 0.95.
    """

    frame: Frame
    per: Literal["all", "antenna"]
    length: float
    sd_db: float
    tied: float = 0.9

    def shared(self, first: LinkSamples, second: LinkSamples) -> float:
        """Return the share of the covariance that samples of two series have in common."""
        if self.per == "antenna" and first.antenna != second.antenna:  # gains of two antennas are independent
            return 0.0
        if self.frame == "body" and first.airframe != second.airframe:
            return 0.0
        return self.tied if self.frame == "body" and first.campaign != second.campaign else 1.0


ANTENNA_TERMS = (Term("body", "all", 1.0, 3.2), Term("mast", "antenna", 0.5, 3.4), Term("pair", "antenna", 0.35, 1.5))


@dataclass(frozen=True, slots=True)
class GainModel:
    """The parameters of a fit: the terms with their strengths and lengths, nuisance and noise.

    Parameters
    ----------
    terms : tuple of Term
        One or more terms.
    own_sd_db, own_length_m : float
        Nuisance of a flight and channel, with covariance ``sd^2 exp(-distance / length)``.
    noise_sd_db : float
        Standard deviation of the noise of a bin [dB].
    bin_s : float
        Duration over which samples are averaged [s].
    own_scales_db : tuple of (str, float, float)
        Name of a campaign or antenna (``tower.channel``), with its separate ``own_sd_db`` and ``noise_sd_db``. A fit
        uses the values of campaigns. The error of a level uses the values of its antenna if there are enough levels,
        because shadowing differs between the ports of a tower.
    """

    terms: tuple[Term, ...] = ANTENNA_TERMS
    own_sd_db: float = 1.2
    own_length_m: float = 20.0
    noise_sd_db: float = 1.5
    bin_s: float = 4.0
    own_scales_db: tuple[tuple[str, float, float], ...] = ()

    def scales_db(self, *names: str) -> tuple[float, float]:
        """Return the standard deviations of nuisance and noise [dB], from the first name that has separate values."""
        known = {name: (own, noise) for name, own, noise in self.own_scales_db}
        return next((known[name] for name in names if name in known), (self.own_sd_db, self.noise_sd_db))

    def scaled(self, factor: float) -> GainModel:
        """Return the model with all standard deviations multiplied by a factor."""
        return dataclasses.replace(
            self,
            terms=tuple(dataclasses.replace(t, sd_db=t.sd_db * factor) for t in self.terms),
            own_sd_db=self.own_sd_db * factor,
            noise_sd_db=self.noise_sd_db * factor,
            own_scales_db=tuple((name, own * factor, noise * factor) for name, own, noise in self.own_scales_db),
        )


def argument_of(samples: LinkSamples, frame: Frame) -> FloatArray:
    """Return the argument of a term: directions (n, 3) in its frame, or (n, 6) at both ends for a pair."""
    if frame == "pair":
        return np.concatenate([samples.at_uav, samples.at_tower], axis=1)
    return samples.at_uav if frame == "body" else samples.at_tower


def term_kernel(term: Term, at: FloatArray, to: FloatArray) -> FloatArray:
    """Return the covariance of a term between arguments, shape (n, m) [dB^2].

    Gains of airframes have details of every angular size. The error is 0.1 dB lower with an exponential kernel than
    with sums of Gaussians.
    """
    from scipy.spatial.distance import cdist

    if term.frame == "pair":
        kernel = gaussian_kernel(at, to, term.length)
    else:  # in place, because a calibration spends most of its time on these matrices
        kernel = np.asarray(cdist(at, to))
        kernel /= -term.length
        np.exp(kernel, out=kernel)
    kernel *= term.sd_db**2
    return kernel


@lru_cache(maxsize=len(ANTENNA_TERMS))
def _last_kernel(term: Term, at: bytes, to: bytes) -> FloatArray:
    """Return :func:`term_kernel` of float64 arrays given as bytes.

    The result is cached, because the channels of a log have equal directions.
    """
    width = 6 if term.frame == "pair" else 3
    return term_kernel(term, np.frombuffer(at).reshape(-1, width), np.frombuffer(to).reshape(-1, width))


def gain_covariance(terms: Sequence[Term], first: Sequence[LinkSamples], second: Sequence[LinkSamples]) -> FloatArray:
    """Return the covariance (n, m) of the gains between the samples of two lists of series [dB^2]."""
    rows, columns = _groups(first), _groups(second)
    out = np.zeros((sum(map(len, first)), sum(map(len, second))))
    for term in terms:
        at, to = (np.concatenate([argument_of(s, term.frame) for s in series]) for series in (first, second))
        blocks: dict[tuple[bytes, bytes], FloatArray] = {}
        for (one, mine), (other, theirs) in product(rows, columns):
            share = term.shared(one, other)
            if not share:
                continue
            key = at[mine].tobytes(), to[theirs].tobytes()  # channels of one log have the same directions
            blocks[key] = term_kernel(term, at[mine], to[theirs]) if key not in blocks else blocks[key]
            out[mine, theirs] += blocks[key] if share == 1.0 else share * blocks[key]
    return out


def _groups(series: Sequence[LinkSamples]) -> list[tuple[LinkSamples, slice]]:
    """Return, for each run of series that share all gains, its first series and the range of its samples."""
    out, start = [], 0
    for _, some in groupby(series, lambda s: s.group):
        run = list(some)
        stop = start + sum(map(len, run))
        out.append((run[0], slice(start, stop)))
        start = stop
    return out


def _expected(
    terms: Sequence[Term], samples: LinkSamples, rows: Sequence[LinkSamples], weights: FloatArray
) -> FloatArray:
    """Return the expected gain (n,) along samples from the weights of the rows [dB]."""
    gain, counts = np.zeros(len(samples)), [len(s) for s in rows]
    for term in terms:
        share = np.repeat([term.shared(samples, s) for s in rows], counts)
        known = share > 0.0
        if not known.any():
            continue
        at = np.concatenate([argument_of(s, term.frame) for s in rows])[known]
        at, place = np.unique(at, axis=0, return_inverse=True)  # channels of one log have the same directions
        kernel = _last_kernel(term, argument_of(samples, term.frame).tobytes(), at.tobytes())
        gain += kernel @ np.bincount(place, (share * weights)[known])
    return gain


def own_covariance(model: GainModel, samples: LinkSamples) -> FloatArray:
    """Return the covariance of offset, nuisance and noise of a series, shape (n, n) [dB^2]."""
    from scipy.spatial.distance import cdist

    distance = cdist(samples.position_m, samples.position_m)
    own_sd_db, noise_sd_db = model.scales_db(samples.campaign)
    own = own_sd_db**2 * np.exp(-distance / model.own_length_m) + (_OFFSET_SD * noise_sd_db) ** 2
    own[np.diag_indices(len(own))] += noise_sd_db**2
    return np.asarray(own)


def _covariance_of_levels(model: GainModel, rows: Sequence[LinkSamples]) -> FloatArray:
    """Return the covariance (n, n) of the levels of all rows: gains, offsets, nuisances and noise [dB^2]."""
    return _with_blocks(gain_covariance(model.terms, rows, rows), (own_covariance(model, s) for s in rows))


def _with_blocks(covariance: FloatArray, blocks: Iterable[FloatArray]) -> FloatArray:
    """Add the covariance of each series to its diagonal block. The matrix is changed in place, because it is large."""
    start = 0
    for block in blocks:
        part = slice(start, start + len(block))
        covariance[part, part] += block
        start = part.stop
    return covariance


@dataclass(frozen=True, slots=True)
class GainFit:
    """A learned gain over direction with its uncertainty.

    Parameters
    ----------
    model : GainModel
        Model with the standard deviations and the bin duration that the fit used.
    rows : tuple of LinkSamples
        The training data: means over bins.
    log_evidence : float
        Log marginal likelihood, up to a constant that depends only on the data.
    """

    model: GainModel
    rows: tuple[LinkSamples, ...]
    log_evidence: float
    _weights: FloatArray = field(repr=False)
    _factor: Factor = field(repr=False)
    # mean gain of each antenna over its rows
    _zero: Mapping[str, float] = field(repr=False)

    @property
    def antennas(self) -> tuple[str, ...]:
        """``tower.channel`` of the fitted antennas."""
        return tuple(dict.fromkeys(s.antenna for s in self.rows))

    def predict(self, samples: LinkSamples, frames: Sequence[Frame] | None = None) -> tuple[FloatArray, FloatArray]:
        """Return the gain of all terms along samples, relative to its mean over the training samples.

        Parameters
        ----------
        samples : LinkSamples
            Samples of a fitted antenna, whose residuals are not used.
        frames : sequence of Frame, optional
            Frames of the terms that are included; all by default.

        Returns
        -------
        gain_db, sd_db : (n,)
            Posterior mean and standard deviation [dB]; NaN if a direction is NaN.

        Raises
        ------
        UsageError
            If no flight of the fit has this tower and channel.
        """
        terms = [t for t in self.model.terms if frames is None or t.frame in frames]
        about = self._rows_of(samples.antenna)
        gain, sd = _in_parts(self._like_fitted(samples), lambda part: np.stack(self._moments(terms, part, about)), 2)
        return gain, sd

    def mean(self, samples: LinkSamples) -> FloatArray:
        """Return the gain of :meth:`predict` without its standard deviation, shape (n,) [dB]."""
        return self._gain(self.model.terms, self._like_fitted(samples)) - self._zero[samples.antenna]

    def gain(self, frame: Frame, antenna: str, direction: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return posterior mean and SD of the gain at one end over directions (n, 3), or of the pair (n, 6) [dB].

        The gain is relative to its mean over the bins of the flights, because the offsets absorb this mean.
        """
        return self.predict(directed(antenna, np.asarray(direction, dtype=np.float64)), (frame,))

    def seen(self, frame: Frame, antenna: str) -> FloatArray:
        """Return the training directions at one end, (m, 3), or of the pair of ends, (m, 6).

        For the UAV, the directions to all antennas are returned.
        """
        return np.concatenate(
            [argument_of(s, frame) for s in (self.rows if frame == "body" else self._rows_of(antenna))]
        )

    def sd_about_mean(self, samples: LinkSamples) -> FloatArray:
        """Return the standard deviation (n,) of the gain at each sample about the mean over the samples [dB].

        Every sample must have both directions.
        """
        samples = self._like_fitted(samples)
        return self._moments(self.model.terms, samples, [samples])[1]

    def airframe_mean(self, samples: LinkSamples) -> FloatArray:
        """Return the gain (n,) of the UAV alone [dB], for any tower and campaign with an airframe of the fit."""
        return self._gain([t for t in self.model.terms if t.frame == "body"], samples)

    def _gain(self, terms: Sequence[Term], samples: LinkSamples) -> FloatArray:
        """Return the sum of some terms along samples, shape (n,) [dB]."""
        return _in_parts(samples, lambda part: _expected(terms, part, self.rows, self._weights))

    def _like_fitted(self, samples: LinkSamples) -> LinkSamples:
        """Return samples with the campaign and the airframe of their antenna in the fit."""
        first = self._rows_of(samples.antenna)[0]
        return dataclasses.replace(samples, campaign=first.campaign, airframe=first.airframe)

    def _rows_of(self, antenna: str) -> list[LinkSamples]:
        """Return the training rows of an antenna."""
        rows = [s for s in self.rows if s.antenna == antenna]
        if not rows:
            raise UsageError(
                f"tower and channel {antenna!r} were not fitted", expected="one of " + ", ".join(self.antennas)
            )
        return rows

    def covariance(self, frame: Frame, antenna: str, direction: FloatArray) -> FloatArray:
        """Return the covariance of :meth:`gain` towards directions (n, 3), shape (n, n) [dB^2]."""
        terms = [t for t in self.model.terms if t.frame == frame]
        at = self._like_fitted(directed(antenna, np.asarray(direction, dtype=np.float64)))
        _, spread, centre = self._conditioned(terms, at, self._rows_of(antenna))
        return np.asarray(gain_covariance(terms, [at], [at]) + centre[:, None] + centre - spread.T @ spread)

    def _moments(
        self, terms: Sequence[Term], at: LinkSamples, about: Sequence[LinkSamples]
    ) -> tuple[FloatArray, FloatArray]:
        """Return mean and SD (n,) of a sum of terms along ``at``, relative to its mean over ``about``."""
        mean, spread, centre = self._conditioned(terms, at, about)
        variance = sum(t.sd_db**2 for t in terms) + 2.0 * centre - (spread**2).sum(axis=0)
        return mean, np.sqrt(np.maximum(variance, 0.0))

    def _conditioned(
        self, terms: Sequence[Term], at: LinkSamples, about: Sequence[LinkSamples]
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the moments of a sum of terms along ``at`` (n,), relative to its mean over ``about``.

        The moments are the mean (n,), the whitened covariance (rows, n) with the levels, and the part (n,) of the prior
        covariance that comes from the mean over ``about``.
        """
        # ``at`` and ``about`` have the same antenna, so every term is correlated between them
        centre = gain_covariance(terms, about, [at, *self.rows]).mean(axis=0)
        across = gain_covariance(terms, [at], self.rows) - centre[len(at) :]
        mean_part = 0.5 * gain_covariance(terms, about, about).mean() - centre[: len(at)]
        return across @ self._weights, self._factor.whiten(across.T), mean_part


# Number of samples that are predicted together. The number limits the memory that is used.
AT_ONCE = 2000


def _in_parts(samples: LinkSamples, of: Callable[[LinkSamples], FloatArray], columns: int | None = None) -> FloatArray:
    """Return ``of(samples)``, (n,) or (columns, n), computed in parts. NaN without direction or position."""
    finite = np.isfinite(np.concatenate([samples.at_uav, samples.at_tower, samples.position_m], axis=1)).all(axis=1)
    out = np.full(len(samples) if columns is None else (columns, len(samples)), np.nan)
    for rows in np.array_split(np.flatnonzero(finite), -(-int(finite.sum()) // AT_ONCE) or 1):
        out[..., rows] = of(samples.part(rows)) if len(rows) else 0.0
    return out


def directed(antenna: str, direction: FloatArray) -> LinkSamples:
    """Return samples of an antenna with directions (n, 3), the same at both ends, or with pairs (n, 6)."""
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
        Samples of all flights.
    model : GainModel, optional
        Terms and their strengths; see :func:`chosen_fit`.

    Returns
    -------
    GainFit

    Raises
    ------
    InputError
        If there are no valid samples, or the equations cannot be solved.

    Notes
    -----
    All parts of ``y = offset + gains + own + noise`` are normal. With the covariance ``C`` of the rows, and the
    covariance ``k`` between rows and requested directions, the gain is ``k' C^-1 y``
    (:class:`~aerpaw_cmp.common.gaussian.Factor`). The solution is exact except for the averaging over ``bin_s``.
    """
    model, rows = _binned_series(series, model or GainModel())
    return _solved(model, rows, _covariance_of_levels(model, rows))


def _solved(model: GainModel, rows: Sequence[LinkSamples], covariance: FloatArray, *, scaled: bool = False) -> GainFit:
    """Return the fit of rows with a covariance of their levels. The covariance is overwritten by its factor.

    If ``scaled`` is set, all standard deviations are multiplied by the factor s that makes them fit the data:
    ``s^2 = y' C^-1 y / rows``. The gains do not change.
    """
    # in place, because a copy takes 72 MB for 3 000 rows
    factor = Factor.of(covariance)
    target = np.concatenate([_centred(s) for s in rows])
    weights = factor.solve(target)
    # subtract the part that offset, nuisance and noise explain, so that the part that the gains explain remains
    parts = np.split(weights, np.cumsum([len(s) for s in rows])[:-1])
    gain = target - np.concatenate([own_covariance(model, s) @ w for s, w in zip(rows, parts, strict=True)])
    if scaled:
        # the offset of each series uses one degree of freedom
        scale = math.sqrt(max(float(target @ weights) / max(len(target) - len(rows), 1), 1e-6))
        model, weights, factor = model.scaled(scale), weights / scale**2, Factor(factor.lower * scale)
    return GainFit(
        model=model,
        rows=tuple(rows),
        log_evidence=factor.log_likelihood(target),
        _weights=weights,
        _factor=factor,
        _zero={first.antenna: float(gain[part].mean()) for first, part in _groups(rows)},
    )


def chosen_fit(series: Sequence[LinkSamples], model: GainModel | None = None) -> GainFit:
    """Return :func:`fit_gain` with the more likely strength of the tower's gains and scaled standard deviations."""
    model, rows = _binned_series(series, model or GainModel())
    model = _with_scales(model, rows)
    mast = [t for t in model.terms if t.frame == "mast"]
    if not 0 < len(mast) < len(model.terms):
        return _solved(model, rows, _covariance_of_levels(model, rows), scaled=True)
    others = dataclasses.replace(model, terms=tuple(t for t in model.terms if t not in mast))
    of_others, of_towers = _covariance_of_levels(others, rows), gain_covariance(mast, rows, rows)
    fits = []
    for factor in _TOWER_FACTORS:
        terms = tuple(dataclasses.replace(t, sd_db=t.sd_db * factor) if t in mast else t for t in model.terms)
        covariance = factor**2 * of_towers
        covariance += of_others
        fits.append(_solved(dataclasses.replace(model, terms=terms), rows, covariance, scaled=True))
    return max(fits, key=lambda fit: fit.log_evidence)


# Candidate standard deviations of nuisance and noise per campaign [dB]. The likeliest are 1.2 and 1.0 for dataset 12,
# 2.0 and 2.2 for LTE, 2.0 and 3.0 for AADM. One pair for all campaigns is 18 to 99 nat less likely.
_CAMPAIGN_SCALES_DB = tuple(product((0.8, 1.2, 2.0, 3.0), (1.0, 1.5, 2.2, 3.2)))

# An antenna has its own scales if it has at least this number of means. A tower of AADM has 42, a port of dataset 12
# has 310.
_FEWEST_MEANS = 100


def _with_scales(model: GainModel, rows: Sequence[LinkSamples]) -> GainModel:
    """Return the model with the most likely scales per campaign and per antenna, if there are several campaigns."""
    names = list(dict.fromkeys(s.campaign for s in rows))
    if len(names) == 1 or model.own_scales_db:
        return model
    # every second mean is enough to select the scales, and reduces the time of the Cholesky factorisation to an eighth
    some = [s.part(np.arange(0, len(s), 2)) for s in rows]
    every = dict.fromkeys([*names, *(s.antenna for s in some)])
    parts = {name: [s for s in some if name in (s.campaign, s.antenna)] for name in every}
    determined = [name for name in every if name in names or sum(map(len, parts[name])) >= _FEWEST_MEANS]
    chosen = ((name, *_likeliest(_CAMPAIGN_SCALES_DB, parts[name], model.terms)) for name in determined)
    return dataclasses.replace(model, own_scales_db=tuple(chosen))


def _likeliest(
    scales_db: Iterable[tuple[float, float]], rows: Sequence[LinkSamples], terms: Sequence[Term]
) -> tuple[float, float]:
    """Return the pair of standard deviations of nuisance and noise [dB] with which rows are most likely."""
    gains, levels = gain_covariance(terms, rows, rows), np.concatenate([_centred(s) for s in rows])

    def likelihood(pair: tuple[float, float]) -> float:
        model = GainModel(own_sd_db=pair[0], noise_sd_db=pair[1])
        return _log_likelihood(_with_blocks(gains.copy(), (own_covariance(model, s) for s in rows)), levels)

    return max(scales_db, key=likelihood)


def _binned_series(series: Sequence[LinkSamples], model: GainModel) -> tuple[GainModel, list[LinkSamples]]:
    """Return the model with its bin duration, and the means over bins of each series.

    Raise InputError if there are no valid samples.
    """
    binned = [s.binned(model.bin_s) for s in series]
    longer = math.ceil(sum(map(len, binned)) / MOST_ROWS)
    if longer > 1:
        model = dataclasses.replace(model, bin_s=model.bin_s * longer)
        binned = [s.binned(model.bin_s) for s in series]
    binned = [s for s in binned if len(s)]
    if not binned:
        raise InputError("no sample has a level and a direction", expected="RSS with positions and attitude")
    groups = [s.group for s in binned]
    # sort by group, so that the covariance between antennas without common gains is a block of zeros
    return model, sorted(binned, key=lambda s: groups.index(s.group))


# Step between candidate azimuths [deg].
STEP_DEG = 10.0

# Standard deviation of a bin about the patterns [dB]. The value allows for a residual of 4 dB that is correlated over
# about six bins. Least squares are used, because a covariance with learned gains or with shadowing over position would
# absorb the broad shape over azimuth that determines a mount. With such a covariance, the azimuth at the UAV jumps
# between flights of dataset 12 (320 and 120 deg instead of 270 and 270).
_MOUNT_NOISE_DB = 10.0

# Duration over which samples are averaged [s].
BIN_S = 4.0


@dataclass(frozen=True, slots=True)
class MountFit:
    """The fitted mount of an antenna with a known pattern.

    Parameters
    ----------
    azimuth_deg : float
        Azimuth of the most probable mount, defined like ``yaw_deg`` in flight.yaml.
    azimuth_sd_deg : float
        Circular standard deviation.
    probability : (azimuths,)
        Posterior over ``grid_deg``.
    identified : bool
        False if azimuths more than 45 degrees away have more than 5 % of the probability.
    """

    azimuth_deg: float
    azimuth_sd_deg: float
    grid_deg: FloatArray
    probability: FloatArray
    identified: bool


# ``gain_db(direction (n, 3) in the device frame) -> (n,)``.
GainOf = Callable[[FloatArray], FloatArray]


def turned(azimuth_deg: float) -> FloatArray:
    """Return the rotation (3, 3) of an antenna whose front has this azimuth, counter-clockwise from above."""
    c, s = np.cos(np.radians(azimuth_deg)), np.sin(np.radians(azimuth_deg))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def fit_mounts(series: Sequence[LinkSamples], patterns: Mapping[str, GainOf]) -> dict[str, MountFit]:
    """Fit the azimuths of all antennas with a known pattern together.

    Parameters
    ----------
    series : sequence of LinkSamples
        Residuals relative to free space.
    patterns : mapping of str to callable
        Patterns by the key ``uav`` and by antennas of towers. Other antennas are isotropic.

    Returns
    -------
    dict of str to MountFit

    Notes
    -----
    For each azimuth of the UAV and of a tower's antenna, ``log p = -|y - u - t|^2 / (2 s^2)``. Antennas of towers have
    no common samples, so for a given azimuth of the UAV their azimuths are independent. The probability of an azimuth
    of the UAV is computed with the best azimuth of each tower.
    """
    grid = np.arange(0.0, 360.0, STEP_DEG)

    def candidates(name: str, direction: FloatArray) -> FloatArray:
        if name not in patterns:
            return np.zeros((len(direction), 1))
        return np.stack([patterns[name](direction @ turned(azimuth)) for azimuth in grid], axis=1)

    log_p: dict[str, FloatArray] = {}
    for samples in series:
        bins = samples.binned(BIN_S)
        at_uav, at_tower = candidates("uav", bins.at_uav), candidates(samples.antenna, bins.at_tower)
        error = bins.residual_db[:, None, None] - at_uav[:, :, None] - at_tower[:, None]
        # the offset of each flight and channel is free
        error -= error.mean(axis=0) if len(bins) else 0.0
        log_p[samples.antenna] = log_p.get(samples.antenna, 0.0) - 0.5 * (error**2).sum(axis=0) / _MOUNT_NOISE_DB**2
    at_best = np.sum([value.max(axis=1) for value in log_p.values()], axis=0)
    uav, best = _normalised(at_best), int(at_best.argmax())
    fits = {"uav": _mount(grid, uav, float(grid[best]))} if "uav" in patterns else {}
    for antenna in log_p.keys() & patterns.keys():
        value = log_p[antenna]
        fits[antenna] = _mount(grid, uav @ _normalised(value), float(grid[value[best].argmax()]))
    return {name: fits[name] for name in patterns}


def _normalised(log_p: FloatArray) -> FloatArray:
    """Return probabilities that sum to 1 over the last axis."""
    weight = np.exp(log_p - log_p.max(axis=-1, keepdims=True))
    return np.asarray(weight / weight.sum(axis=-1, keepdims=True))


def _mount(grid: FloatArray, probability: FloatArray, best_deg: float) -> MountFit:
    phasor = complex((probability * np.exp(1j * np.radians(grid))).sum())
    # circular standard deviation of a wrapped normal distribution
    spread = np.degrees(np.sqrt(-2.0 * np.log(min(max(abs(phasor), 1e-9), 1.0))))
    apart = np.abs(wrap_degrees(grid - best_deg))
    return MountFit(
        azimuth_deg=best_deg,
        # at least the standard deviation of a uniform distribution over one step of the grid
        azimuth_sd_deg=float(max(spread, (grid[1] - grid[0]) / np.sqrt(12.0))),
        grid_deg=grid,
        probability=probability,
        identified=bool(probability[apart > 45.0].sum() < 0.05),
    )


# Nominal shares of samples within an interval.
SHARES = (0.5, 0.9, 0.95)

# Share of samples inside the band that a report shows.
BAND = 0.9


# Usual SD of the offset between flights [dB]. This value is a guess, because the data do not determine this SD:
# estimates from any three of dataset 12, LTE, AFAR and NR range from 1.0 dB (without AFAR) to 2.8 dB (without dataset
# 12).
USUAL_OFFSET_DB = 1.5


def offset_sd_db(squares_db2: float, count: int, usual_db: float = USUAL_OFFSET_DB) -> float:
    """Return the SD of a normal distribution with the same 90 % band as the offset of a new flight [dB].

    ``squares_db2`` is the sum of squared deviations of the flights' offsets from their mean, with ``count`` degrees of
    freedom. The SD between flights is integrated over its posterior distribution, because few flights hardly determine
    it. The prior is log normal with the median ``usual_db`` and a factor of three. This prior allows almost equal
    offsets, which occur in flights with the same devices.
    """
    from scipy.special import ndtr, ndtri

    z, share = np.linspace(-3.0, 3.0, 61), 0.5 + 0.5 * BAND
    sd_db = usual_db * 3.0**z
    log = -0.5 * z**2 - count * np.log(sd_db) - 0.5 * squares_db2 / sd_db**2
    weight = np.exp(log - log.max())
    inside = ndtr(ndtri(share) * sd_db[:, None] / sd_db) @ weight / weight.sum()
    return float(np.interp(share, inside, sd_db))


# Largest kurtosis for which the expansion of :meth:`Spread.half_width_db` is valid.
_MOST_KURTOSIS = 2.0


# Squared skewness of fading in dB per unit of excess kurtosis: 1.30 / 2.40 for Rayleigh fading.
_FADE_SKEWNESS2 = 0.54


@dataclass(frozen=True, slots=True, kw_only=True)
class Spread:
    """The error model of a predicted level, excluding the standard deviation of the gain.

    Parameters
    ----------
    own_sd_db : float
        Standard deviation of the nuisance of a flight and channel (shadowing that no antenna explains) [dB].
    noise_sd_db : float
        Standard deviation of the noise of means over ``bin_s`` [dB].
    fading_sd_db, fading_kurtosis : float
        Standard deviation and excess kurtosis of samples about their mean over ``bin_s``.
    bin_s : float
        Duration of the means from which the antennas were learned [s].
    """

    own_sd_db: float
    noise_sd_db: float
    fading_sd_db: float
    fading_kurtosis: float
    bin_s: float

    def total_db(self, gain_sd_db: FloatArray) -> FloatArray:
        """Return the standard deviation (n,) of a sample about its prediction, including errors of the gain [dB]."""
        variance = self.own_sd_db**2 + self.noise_sd_db**2 + self.fading_sd_db**2
        return np.asarray(np.sqrt(gain_sd_db**2 + variance))

    def half_width_db(self, gain_sd_db: FloatArray, share: float) -> FloatArray:
        """Return half the width (n,) of the interval that contains a share of the samples [dB].

        Notes
        -----
        The quantile of ``|x|`` of a normal part plus fading follows from the even terms of the Edgeworth series, with
        the excess kurtosis k and the skewness s of the sum: ``q = z + He3(z) k / 24 + He5(z) s^2 / 72`` (Cornish and
        Fisher, Rev. Inst. Int. Stat. 5, 1938). Without the second term, the 50 % interval contains 40 % of the
        samples.
        """
        from scipy.special import ndtri

        total = self.total_db(gain_sd_db)
        z = float(ndtri(0.5 + 0.5 * share))
        with np.errstate(invalid="ignore", divide="ignore"):
            k = np.clip(self.fading_kurtosis * (self.fading_sd_db / total) ** 4, -_MOST_KURTOSIS, _MOST_KURTOSIS)
            skew2 = _FADE_SKEWNESS2 * np.maximum(k, 0.0) * (self.fading_sd_db / total) ** 2
        third, fifth = z**3 - 3.0 * z, z**5 - 10.0 * z**3 + 15.0 * z
        return np.asarray(total * (z + third * k / 24.0 + fifth * skew2 / 72.0))


# Error model for a learned file that contains only the standard deviation of the gain.
NO_SPREAD = Spread(own_sd_db=0.0, noise_sd_db=0.0, fading_sd_db=0.0, fading_kurtosis=0.0, bin_s=4.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class LostLock:
    """The error of a prediction for a receiver that may lose its lock.

    The error is normal about one mean in lock, and about another mean without lock.

    Parameters
    ----------
    probability : (n,)
        Probability of lock.
    locked_db : (n,)
        Mean error in lock.
    lost_db : (n,)
        Mean error without lock.
    locked_sd_db, lost_sd_db : float
    """

    probability: FloatArray
    locked_db: FloatArray
    lost_db: FloatArray
    locked_sd_db: float
    lost_sd_db: float

    @property
    def parts(self) -> list[tuple[FloatArray, FloatArray, FloatArray]]:
        """Return share, mean error and standard deviation, each (n,), in lock and without lock."""
        one, share = np.ones(len(self.probability)), self.probability
        lost = 1.0 - share, self.lost_db, self.lost_sd_db * one
        return [(share, self.locked_db, self.locked_sd_db * one), lost]

    def sd_db(self, about_db: FloatArray) -> FloatArray:
        """Return the root mean square error (n,) of a prediction that is higher by ``about_db`` [dB]."""
        return np.asarray(np.sqrt(sum(share * ((mean - about_db) ** 2 + sd**2) for share, mean, sd in self.parts)))

    def quantile_db(self, share: float) -> FloatArray:
        """Return the error (n,) below which a share of the samples lies, accurate to 0.01 dB."""
        from scipy.special import ndtr

        reach = 6.0 * max(self.locked_sd_db, self.lost_sd_db)
        low = np.minimum(self.locked_db, self.lost_db) - reach
        high = np.maximum(self.locked_db, self.lost_db) + reach
        # bisection, because there is no closed form: 16 steps reduce some hundred decibels to 0.002 dB
        for _ in range(16):
            middle = 0.5 * (low + high)
            below = sum(p * ndtr((middle - mean) / sd) for p, mean, sd in self.parts)
            low, high = np.where(below < share, middle, low), np.where(below < share, high, middle)
        return np.asarray(0.5 * (low + high))

    def log_score(self, error_db: FloatArray) -> float:
        """Return the mean of minus the logarithm of the density at errors (n,) [nat]."""
        density = sum(p / sd * np.exp(-0.5 * ((error_db - mean) / sd) ** 2) for p, mean, sd in self.parts)
        return float(-np.log(density / np.sqrt(2.0 * np.pi)).mean())


@dataclass(frozen=True, slots=True, kw_only=True)
class StatedSpread:
    """The stated error of one series: SD of the gain (n,) [dB] (NaN without a pose), and the other parts of the error.

    ``lock`` replaces the error model for a receiver that loses its lock.
    """

    gain_sd_db: FloatArray
    spread: Spread
    lock: LostLock | None = None

    @property
    def total_db(self) -> FloatArray:
        """Return the standard deviation of a sample about its prediction, shape (n,) [dB]."""
        return self.spread.total_db(self.gain_sd_db)

    def band_db(self, share: float) -> tuple[FloatArray, FloatArray]:
        """Return the ends of the interval about the prediction that contains a share of the samples, each (n,) [dB]."""
        if self.lock is None:
            half = self.spread.half_width_db(self.gain_sd_db, share)
            return -half, half
        return self.lock.quantile_db(0.5 - 0.5 * share), self.lock.quantile_db(0.5 + 0.5 * share)

    def crps_db(self, error_db: FloatArray) -> float:
        """Return the mean continuous ranked probability score of errors (n,) [dB]. NaN is ignored.

        Notes
        -----
        This is the closed form for a mixture of normal distributions (Grimit, Gneiting, Berrocal and Johnson 2006,
        doi:10.1256/qj.05.235).
        """
        one = np.ones(len(error_db))
        parts = [(one, 0.0 * one, self.total_db)] if self.lock is None else self.lock.parts

        def distance(mean: FloatArray, sd: FloatArray) -> FloatArray:
            return np.asarray(crps_normal(mean, sd) + sd / np.sqrt(np.pi))

        to_error = np.sum([p * distance(error_db - mean, sd) for p, mean, sd in parts], axis=0)
        apart = np.sum([
            p * q * distance(mean - other, np.hypot(sd, other_sd))
            for p, mean, sd in parts
            for q, other, other_sd in parts
        ], axis=0)  # fmt: skip
        score = to_error - 0.5 * apart
        return float(np.nanmean(score)) if np.isfinite(score).any() else math.nan

    def columns(self, level_dbm: FloatArray) -> dict[str, FloatArray]:
        """Return the columns of rss.csv with the parts of the error and the 90 % interval about a level (n,)."""
        known = np.where(np.isfinite(self.gain_sd_db), 1.0, np.nan)
        low, high = self.band_db(BAND)
        return {
            "simulated_sd_db": self.total_db,
            "gain_sd_db": self.gain_sd_db,
            "own_sd_db": known * self.spread.own_sd_db,
            "noise_sd_db": known * self.spread.noise_sd_db,
            "fading_sd_db": known * self.spread.fading_sd_db,
            "simulated_low_dbm": level_dbm + low,
            "simulated_high_dbm": level_dbm + high,
        }


def inside_shares(error_db: FloatArray, stated: StatedSpread) -> dict[str, float]:
    """Return the shares of errors inside the intervals, by nominal share: ``inside_50`` and so on.

    Errors (n,) that are NaN are ignored.
    """
    good = np.isfinite(error_db) & np.isfinite(stated.gain_sd_db)
    out = {}
    for share in SHARES:
        low, high = stated.band_db(share)
        inside = (low < error_db) & (error_db < high)
        out[f"inside_{100 * share:.0f}"] = float(inside[good].mean()) if good.any() else math.nan
    return out


def fading_of(series: Sequence[LinkSamples], bin_s: float) -> tuple[float, float]:
    """Return standard deviation [dB] and excess kurtosis of samples about their means over bins.

    Both numbers are 0 if no bin has two samples.

    Examples
    --------
    >>> fading_of([], 4.0)
    (0.0, 0.0)
    """
    squares, fourth, count = 0.0, 0.0, 0
    for samples in series:
        finite = np.isfinite(samples.residual_db)
        if not finite.any():
            continue
        level, time = samples.residual_db[finite], samples.time_s[finite]
        _, member = np.unique(np.floor((time - time[0]) / bin_s).astype(np.int64), return_inverse=True)
        size = np.bincount(member)
        deviation = level - (np.bincount(member, weights=level) / size)[member]
        several = size[member] > 1
        # the expected squared deviation from a mean of n samples is too small by (n - 1) / n
        deviation = deviation[several] * np.sqrt(size[member] / np.maximum(size[member] - 1.0, 1.0))[several]
        squares, fourth = squares + float((deviation**2).sum()), fourth + float((deviation**4).sum())
        count += len(deviation)
    if not count or not squares:
        return 0.0, 0.0
    variance = squares / count
    return math.sqrt(variance), fourth / count / variance**2 - 3.0


BODY, MAST, PAIR = ANTENNA_TERMS

# Smallest log odds of a learned gain against an unknown gain, and of an airframe against each rotated copy. On field
# flights, the limit of 3 accepts the airframe of dataset 12 for LTE and AADM (6.8 to 8.3) and always refuses the
# airframe of NR (-11.5 to -1.2).
LEAST_ODDS = 3.0

_TURNS_DEG = (90.0, 180.0, 270.0)

# If the log odds for an unknown gain exceed this, the rotated copies are not computed.
_CLEARLY_UNKNOWN = 8.0

# Largest number of means, and shortest averaging time [s], with which a flight is tested.
_MOST_ROWS, _BIN_S = 700, 4.0

# Candidate standard deviations of nuisance and noise [dB], selected by likelihood for each series.
_SCALES_DB = (0.7, 1.2, 2.0, 3.5, 6.0)

# Share of the prior variance of the joint gain of both ends that a learned table of this gain does not explain.
_PAIR_LEFT = 0.5

# Mean (n,) [dB] and covariance (n, n) [dB^2] of a learned gain along samples.
Moments = Callable[[LinkSamples], tuple[FloatArray, FloatArray]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Evidence:
    """The log odds of a learned gain against an unknown gain, and against its most likely rotated copy [nat]."""

    over_own: float
    over_turned: float

    @property
    def fits(self) -> bool:
        """True if both log odds are sufficient to use a learned airframe without a learned tower antenna."""
        return min(self.over_own, self.over_turned) >= LEAST_ODDS


@dataclass(frozen=True, kw_only=True)
class GainProcess:
    """A learned gain over direction: its table, and its covariance at the directions that determine it.

    Parameters
    ----------
    gain_db, sd_db : callable
        Mean and standard deviation towards unit vectors (n, 3), each (n,) [dB].
    directions : (m, 3)
    covariance_db2 : (m, m)
    term : Term
        Prior of the gain of the UAV, or of the antenna of a tower.
    """

    gain_db: Callable[[FloatArray], FloatArray]
    sd_db: Callable[[FloatArray], FloatArray]
    directions: FloatArray
    covariance_db2: FloatArray
    term: Term = BODY

    @cached_property
    def _factor(self) -> Factor:
        prior = term_kernel(self.term, self.directions, self.directions)
        # add a little to the diagonal: directions are rounded to a tenth of a degree, so two may be equal
        prior[np.diag_indices(len(prior))] += 1e-3 * self.term.sd_db**2
        return Factor.of(prior)

    def moments(self, at: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return mean (n,) [dB] and covariance (n, n) [dB^2] towards unit vectors (n, 3).

        Notes
        -----
        The process is the sum of ``A g`` and an independent remainder. ``g`` is the gain at the directions G, with
        covariance S, and ``A = K(at, G) K(G, G)^-1`` with the prior K. The covariance of ``A g`` is ``A S A'``. The
        remainder has the covariance ``K - A K(G, at)`` and is scaled so that the diagonal of the sum equals the
        variance in the table.
        """
        across = term_kernel(self.term, at, self.directions)
        weights = self._factor.solve(across.T).T
        known = weights @ self.covariance_db2 @ weights.T
        rest = term_kernel(self.term, at, at) - weights @ across.T
        left = (self.sd_db(at) ** 2 - np.diag(known)) / np.maximum(np.diag(rest), 1e-6)
        scale = np.sqrt(np.clip(left, 0.0, 1.0))
        return self.gain_db(at), known + scale[:, None] * rest * scale


class FlightEvidence:
    """The levels of one flight, with which learned gains are tested.

    Parameters
    ----------
    series : sequence of LinkSamples
        Series of all channels.
    """

    def __init__(self, series: Sequence[LinkSamples]) -> None:
        width = _BIN_S
        self.rows = [s.binned(width) for s in series]
        if (count := sum(map(len, self.rows))) > _MOST_ROWS:
            width *= math.ceil(count / _MOST_ROWS)
            self.rows = [s.binned(width) for s in series]
        self._noise = [_noise_covariance(rows) for rows in self.rows]

    def of_link(self, number: int, known: Moments, alternative: float = -math.inf) -> Evidence:
        """Return the evidence for the learned antennas of both ends of one series, by its number.

        ``known`` returns mean and covariance of the sum of both gains. The variance that the table of the joint gain
        does not explain is added here. The learned antennas must also be more likely than ``alternative`` (a log
        likelihood).
        """
        rows, noise = self.rows[number], self._noise[number]
        if not len(rows):
            return Evidence(over_own=-math.inf, over_turned=-math.inf)
        left = noise + _PAIR_LEFT * gain_covariance([PAIR], [rows], [rows])
        own = _log_likelihood(noise + gain_covariance(ANTENNA_TERMS, [rows], [rows]), _centred(rows))

        def of(turn_deg: float) -> float:
            mean, covariance = known(_rotated(rows, turn_deg))
            return _log_likelihood(left + covariance, _centred(rows) - mean)

        return judged(max(own, alternative), of)

    def with_airframe(self, number: int, known: GainProcess) -> float:
        """Return the log likelihood of one series with a learned airframe and a tower of unknown gain."""
        rows = self.rows[number]
        if not len(rows):
            return -math.inf
        mean, covariance = known.moments(rows.at_uav)
        covariance += self._noise[number] + gain_covariance([MAST, PAIR], [rows], [rows])
        return _log_likelihood(covariance, _centred(rows) - mean)

    def of_airframe(self, known: GainProcess) -> Evidence:
        """Return the evidence for a learned airframe from all series together. The gain of each tower is unknown."""
        rows = [some for some in self.rows if len(some)]
        if not rows:
            return Evidence(over_own=-math.inf, over_turned=-math.inf)
        levels = np.concatenate([_centred(some) for some in rows])

        def of(turn_deg: float) -> float:
            at = np.concatenate([_rotated(some, turn_deg).at_uav for some in rows])
            mean, covariance = known.moments(at)
            return _log_likelihood(self._without_airframe + covariance, levels - mean)

        own = self._without_airframe + gain_covariance([BODY], rows, rows)
        return judged(_log_likelihood(own, levels), of)

    @cached_property
    def _without_airframe(self) -> FloatArray:
        """Return the covariance of all parts except the gain of the UAV."""
        rows = [some for some in self.rows if len(some)]
        return _with_blocks(gain_covariance([MAST, PAIR], rows, rows), self._noise)


def judged(own: float, of: Callable[[float], float]) -> Evidence:
    """Return the evidence from log likelihoods.

    ``own`` is the log likelihood of an unknown gain, and ``of(angle)`` the log likelihood of a learned gain that is
    rotated by an angle [deg].
    """
    learned = of(0.0)
    # skip the three rotated copies if the gain is already clearly worse
    turned = max(map(of, _TURNS_DEG)) if learned > own - _CLEARLY_UNKNOWN else math.inf
    return Evidence(over_own=learned - own, over_turned=learned - turned)


def _noise_covariance(rows: LinkSamples) -> FloatArray:
    """Return the covariance of offset, nuisance and noise of one series with the most likely scales, shape (n, n)."""
    if not len(rows):
        return np.zeros((0, 0))
    # about 200 rows are enough to select the scales
    some = rows.part(np.arange(0, len(rows), max(1, len(rows) // 200)))
    own_sd_db, noise_sd_db = _likeliest(product(_SCALES_DB, _SCALES_DB), [some], ANTENNA_TERMS)
    return own_covariance(GainModel(own_sd_db=own_sd_db, noise_sd_db=noise_sd_db), rows)


def _centred(rows: LinkSamples) -> FloatArray:
    return np.asarray(rows.residual_db - rows.residual_db.mean())


def _log_likelihood(covariance: FloatArray, values: FloatArray) -> float:
    return Factor.of(covariance).log_likelihood(values)


def _rotated(rows: LinkSamples, turn_deg: float) -> LinkSamples:
    """Return samples with the directions at the UAV rotated counter-clockwise."""
    return dataclasses.replace(rows, at_uav=rotated(rows.at_uav, turn_deg)) if turn_deg else rows
