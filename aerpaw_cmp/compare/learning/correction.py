"""Choice of a prediction and its correction, by flights (or blocks) left out inside those that are known.

A *base* predicts levels above free space: nothing at all (a constant level), free space, a replay, learned antennas. A
*correction* is the residual field (:mod:`.field_gp`) of a base. Both are chosen by the CRPS of what is left out, and
the correction stays off unless a 95 % interval shows that it lowers the CRPS.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from ...common.errors import InputError
from ...common.geodesy import azimuth_rad, elevation_rad
from ...common.units import FloatArray, IntArray
from ..gains.direction_gain import LinkSamples
from ..judge.entries import crps_normal
from ..statistics.intervals import mean_interval
from .calibration import MOST_GROUPS, groups_of
from .field_gp import NEW_FLIGHT, PARTS, FieldFit, FieldModel, Part, Rows, fit_field

# Level above free space (n,) and its standard deviation (n,) [dB] of samples whose residual is not used.
Predictor = Callable[[LinkSamples], tuple[FloatArray, FloatArray]]

# Learns from samples whose residual is measured minus free space.
Base = Callable[[Sequence[LinkSamples]], Predictor]

_HeldOut = tuple[FloatArray, FloatArray]

# Residuals are means over this time [s].
BIN_S = 4.0

# Side of the blocks of a single flight that are left out.
BLOCK_M = 300.0

# Of more flights than :data:`~.calibration.MOST_GROUPS`, so many groups are left out in turn, and the strengths of a
# residual field that are learned without the first serve for all: one flight among many hardly moves them.
_SCORED_GROUPS = 3

OFF = "no correction"

_NUISANCE = ("drift_sd_db", "drift_s", "noise_sd_db")

# Scales of the place part that are tried; drift and noise always come from the likelihood. Between few flights the
# likelihood alone confuses place with direction and height: measured, free lengths lost 0.3 dB on flights left out.
_STARTS: dict[str, FieldModel | None] = {
    OFF: FieldModel(place_sd_db=1e-3, turn=math.inf, drift_s=8.0),
    "field of 2 dB, 30 m": FieldModel(place_sd_db=2.0, length_m=30.0, height_m=20.0, turn=0.35, drift_s=8.0),
    "field of 2.5 dB, 50 m": FieldModel(place_sd_db=2.5, length_m=50.0, height_m=40.0, turn=0.35, drift_s=8.0),
    "field of 1.5 dB, 50 m": FieldModel(place_sd_db=1.5, length_m=50.0, height_m=40.0, turn=math.inf, drift_s=8.0),
    "field by likelihood": None,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Channel:
    """Binned rows of one tower and channel over all flights, and what a base leaves there (n,) [dB]."""

    rows: Rows
    left_db: FloatArray
    base_sd_db: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Correction:
    """Chosen base and residual field, conditioned on all that is known.

    Parameters
    ----------
    base : str
    predictor : callable
        Of the base, learned from all flights.
    title : str
        Of the residual field, or :data:`OFF`.
    model : FieldModel
    channels : mapping of str to Channel
        By antenna (``tower.channel``).
    flights : tuple of str
        Their places are the codes of :class:`Rows`.
    crps_db : mapping of (base, title) to float
        Of what was left out.
    rmse_db : mapping of (base, title) to float
    held_out : mapping of (base, title) to ((n,), (n,))
        Errors on what was left out, in one order for all, and the standard deviations stated for them; NaN: no error.
    sd_factor : float
        On all standard deviations: makes the errors of what was left out as large as stated. Each candidate of
        ``held_out`` has its own.
    """

    base: str
    predictor: Predictor
    title: str
    model: FieldModel
    channels: Mapping[str, Channel]
    flights: tuple[str, ...]
    crps_db: Mapping[tuple[str, str], float]
    rmse_db: Mapping[tuple[str, str], float]
    held_out: Mapping[tuple[str, str], _HeldOut] = field(default_factory=dict)
    sd_factor: float = 1.0
    fits: dict[str, FieldFit] = field(default_factory=dict, repr=False, compare=False)
    """Solved fields by antenna."""

    @property
    def on(self) -> bool:
        """True if a residual field is added."""
        return self.title != OFF

    def predict(
        self, samples: LinkSamples, flight: str | None = None, *, own_mean: bool = False
    ) -> tuple[FloatArray, FloatArray]:
        """Level above free space (n,) and its standard deviation (n,) as a mean over :data:`BIN_S` [dB].

        The standard deviation holds base, field, drift and noise, and the offset between flights unless the samples
        count about their ``own_mean``.
        """
        return self.over_headings([samples], flight, own_mean=own_mean)

    def over_headings(
        self, each: Sequence[LinkSamples], flight: str | None = None, *, own_mean: bool = False, all_targets: int = 0
    ) -> tuple[FloatArray, FloatArray]:
        """As :meth:`predict`, of an aircraft whose heading is not known: each of some counts alike.

        Parameters
        ----------
        each : sequence of LinkSamples
            The same samples, as seen with each heading.
        flight : str, optional
        own_mean : bool
        all_targets : int
            Targets of the whole run, where these are a part: all parts are then solved alike.

        Returns
        -------
        level_db, sd_db : (n,)
            What a field of directions says of the heading counts as not known.
        """
        samples = each[0]
        channel = self.channels.get(samples.antenna)
        if channel is None:
            raise InputError(f"no flight has {samples.antenna}", expected="one of " + ", ".join(self.channels))
        gains, gain_sds = (np.stack(part) for part in zip(*map(self.predictor, each), strict=True))
        targets = Rows.of(samples, self.flights.index(flight) if flight in self.flights else NEW_FLIGHT)
        if len(each) > 1:
            targets = dataclasses.replace(targets, direction=np.stack([s.at_uav for s in each], axis=1))
        if not self.on and flight not in self.flights and len(targets):
            # without a field one target with a position stands for all
            targets = targets.part(np.array([np.isfinite(targets.position_m).all(axis=1).argmax()]))
        # solved once for each antenna: maps ask tile by tile
        fit = self.fits.setdefault(samples.antenna, FieldFit(self.model, channel.rows, channel.left_db))
        exact = fit.fits(max(len(targets), all_targets))
        mean, sd = fit.predict(targets, exact=exact)
        if own_mean:
            # about its own mean a flight's offset is no error
            _, sd = fit.predict(targets, ("place", "drift"), exact=exact)
        variance = sd**2 + (gain_sds**2).mean(axis=0) + gains.var(axis=0) + self.model.noise_sd_db**2
        return gains.mean(axis=0) + mean, self.sd_factor * np.sqrt(variance)


def between_blocks_db(channel: Channel) -> float:
    """Standard deviation of what a base leaves, between blocks of :data:`BLOCK_M` [dB]; 0 for a single block."""
    cell = np.floor(channel.rows.position_m[:, :2] / BLOCK_M).astype(np.int64)
    member = np.unique(cell, axis=0, return_inverse=True)[1].ravel()
    # equal blocks: a hover counts no more than a pass
    means = np.bincount(member, weights=channel.left_db) / np.bincount(member)
    return float(np.std(means, ddof=1)) if len(means) > 1 else 0.0


def _channels(series: Sequence[LinkSamples], predictor: Predictor, flights: Sequence[str]) -> dict[str, Channel]:
    """Residuals of a base, by antenna."""
    parts: dict[str, list[Channel]] = {}
    for samples in series:
        binned = samples.binned(BIN_S)
        gain, sd = predictor(binned)
        finite = np.isfinite(gain)
        channel = Channel(
            rows=Rows.of(binned, flights.index(samples.flight)).part(finite),
            left_db=(binned.residual_db - gain)[finite],
            base_sd_db=sd[finite],
        )
        if finite.any():
            parts.setdefault(samples.antenna, []).append(channel)
    return {
        antenna: Channel(
            rows=Rows.joined([p.rows for p in each]),
            left_db=np.concatenate([p.left_db for p in each]),
            base_sd_db=np.concatenate([p.base_sd_db for p in each]),
        )
        for antenna, each in parts.items()
    }


def _model(title: str, channels: Mapping[str, Channel]) -> FieldModel:
    known = [(c.rows, c.left_db) for c in channels.values()]
    start = _STARTS[title]
    return fit_field(known) if start is None else fit_field(known, start, _NUISANCE)


@dataclass(frozen=True, slots=True)
class _Fold:
    """Samples of one part that is left out, and those that it is predicted from."""

    known: list[LinkSamples]
    left_out: list[LinkSamples]


def _folds(series: Sequence[LinkSamples]) -> list[_Fold]:
    """Each flight left out (or three of six groups); of a single flight, blocks of :data:`BLOCK_M`."""
    names = list(dict.fromkeys(s.flight for s in series))
    if len(names) > 1:
        return [
            _Fold([s for s in series if s.flight not in group], [s for s in series if s.flight in group])
            for group in groups_of(names)[: None if len(names) <= MOST_GROUPS else _SCORED_GROUPS]
        ]
    cells = [np.floor(s.position_m[:, :2] / BLOCK_M).astype(np.int64) for s in series]
    every, count = np.unique(np.concatenate(cells), axis=0, return_counts=True)
    out = []
    for cell in every[np.argsort(-count)[:6]]:
        inside: list[IntArray] = [np.flatnonzero((c == cell).all(axis=1)) for c in cells]
        outside = [np.setdiff1d(np.arange(len(s)), rows) for s, rows in zip(series, inside, strict=True)]
        out.append(_Fold([s.part(r) for s, r in zip(series, outside, strict=True) if len(r)],
                         [s.part(r) for s, r in zip(series, inside, strict=True) if len(r)]))  # fmt: skip
    return out


def _score_fold(
    fold: _Fold, base: Base, models: dict[str, FieldModel | None], tallies: Mapping[str, list[_HeldOut]], *, keep: bool
) -> None:
    """Add the errors of every residual field of a base; new flights count about their own mean.

    Parameters
    ----------
    fold : _Fold
    base : callable
    models : dict of str to FieldModel or None
        By title; None: its strengths are learned here.
    tallies : mapping of str to list
        Receives the errors.
    keep : bool
        Put what is learned into ``models``.

    Returns
    -------
    None
    """
    flights = list(dict.fromkeys(s.flight for s in fold.known))
    predictor = base(fold.known)
    channels = _channels(fold.known, predictor, flights)
    targets = [s for s in fold.left_out if np.isfinite(s.residual_db).any()]
    new_flight = bool(targets) and targets[0].flight not in flights
    binned = [s.binned(BIN_S) for s in targets]
    known = [predictor(s) if s.antenna in channels else None for s in binned]
    for title, known_model in models.items():
        model = known_model or _model(title, channels)
        if keep:
            models[title] = model
        parts: tuple[Part, ...] = ("place", "drift") if new_flight else PARTS
        for samples, gains in zip(binned, known, strict=True):
            if gains is None:
                tallies[title].append((np.full(len(samples), np.nan), np.ones(len(samples))))
                continue
            channel, (gain, gain_sd) = channels[samples.antenna], gains
            code = NEW_FLIGHT if new_flight else flights.index(samples.flight)
            mean, sd = FieldFit(model, channel.rows, channel.left_db).predict(Rows.of(samples, code), parts)
            error = samples.residual_db - gain - mean
            if new_flight and np.isfinite(error).any():
                error = error - np.nanmean(error)
            tallies[title].append((error, np.sqrt(sd**2 + gain_sd**2 + model.noise_sd_db**2)))


# Titles of residual fields without free lengths, which remember places.
STATED_FIELDS = tuple(title for title, start in _STARTS.items() if start is not None)


def choose(series: Sequence[LinkSamples], bases: Mapping[str, Base], titles: Sequence[str] = ()) -> Correction:
    """The base and the residual field with the lowest CRPS on what is left out, learned from all that is known.

    Parameters
    ----------
    series : sequence of LinkSamples
        Measured minus free space of every flight, tower and channel that is known.
    bases : mapping of str to callable
        In order of preference where scores are equal.
    titles : sequence of str
        Of the residual fields that are tried, :data:`OFF` among them; all by default.

    Returns
    -------
    Correction

    Raises
    ------
    InputError
        No sample has a level and a pose.
    """
    series = [s for s in series if np.isfinite(s.residual_db).any()]
    if not series:
        raise InputError("no sample has a level and a pose", expected="RSS with positions")
    folds, titles = _folds(series), titles or tuple(_STARTS)
    tallies: dict[tuple[str, str], list[_HeldOut]] = {(base, title): [] for base in bases for title in titles}
    for name, base in bases.items():
        models: dict[str, FieldModel | None] = dict.fromkeys(titles)
        for fold in folds:
            if fold.known and fold.left_out:
                many = len({s.flight for s in series}) > MOST_GROUPS
                _score_fold(fold, base, models, {t: tallies[name, t] for t in titles}, keep=many)
    joined = {key: _joined(parts) for key, parts in tallies.items() if parts}
    # scaled before they are scored: CRPS then compares errors, not how badly spreads are stated
    factors = {key: _sd_factor(*errors) for key, errors in joined.items()}
    held_out = {key: (error, factors[key] * sd) for key, (error, sd) in joined.items()}
    crps = dict.fromkeys(tallies, math.inf) | {key: _mean(crps_normal(*errors)) for key, errors in held_out.items()}
    sure = [key for key in held_out if key[1] == OFF or mean_interval(crps_difference(held_out, key))[1] < 0.0]
    # to a thousandth of a decibel, then in the order in which they are preferred
    best = min(sure or crps, key=lambda key: (round(crps[key], 3), list(tallies).index(key)))
    flights = tuple(dict.fromkeys(s.flight for s in series))
    predictor = bases[best[0]](series)
    channels = _channels(series, predictor, flights)
    return Correction(
        base=best[0],
        predictor=predictor,
        title=best[1],
        model=_model(best[1], channels),
        channels=channels,
        flights=flights,
        crps_db=crps,
        rmse_db=dict.fromkeys(tallies, math.nan)
        | {key: math.sqrt(_mean(np.square(error))) for key, (error, _) in held_out.items()},
        held_out=held_out,
        sd_factor=factors.get(best, 1.0),
    )


def crps_difference(held_out: Mapping[tuple[str, str], _HeldOut], key: tuple[str, str]) -> FloatArray:
    """CRPS of a base with a residual field minus that of the base alone, where both have an error [dB]."""
    difference = crps_normal(*held_out[key]) - crps_normal(*held_out[key[0], OFF])
    return np.asarray(difference[np.isfinite(difference)])


def _sd_factor(error: FloatArray, sd: FloatArray) -> float:
    """Ratio of seen to stated errors, between 0.8 and 1.6; 1 without an error."""
    ratio = _mean(np.square(error / sd))
    return min(max(math.sqrt(ratio), 0.8), 1.6) if math.isfinite(ratio) else 1.0


def _joined(parts: Sequence[_HeldOut]) -> _HeldOut:
    error, sd = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    return error, sd


def _mean(values: FloatArray) -> float:
    """Mean of the finite values; infinite without any."""
    good = values[np.isfinite(values)]
    return float(good.mean()) if len(good) else math.inf


def fixed_base(gain: Callable[[LinkSamples], FloatArray]) -> Base:
    """A base that learns nothing: its level above free space is known to it."""

    def learn(_: Sequence[LinkSamples]) -> Predictor:
        return lambda samples: (gain(samples), np.zeros(len(samples)))

    return learn


# Of more samples at a time, a model of directions is evaluated once per degree of direction.
MOST_DIRECTIONS = 5_000


def by_degree(predictor: Predictor) -> Predictor:
    """A model of directions that takes many samples a degree at a time (gains have lengths of 11 degrees and more).

    What a degree has is kept: later parts of a run, and other headings, ask for much the same directions.
    """
    known: dict[str, tuple[IntArray, FloatArray]] = {}

    def predict(samples: LinkSamples) -> tuple[FloatArray, FloatArray]:
        if len(samples) <= MOST_DIRECTIONS:
            return predictor(samples)
        cells = np.zeros(len(samples), dtype=np.int64)
        for ray in (samples.at_tower, samples.at_uav):
            for angle in (azimuth_rad(ray), elevation_rad(ray)):
                # one integer for both directions, to a degree
                cells = 361 * cells + np.round(np.degrees(angle)).astype(np.int64) + 180
        degrees, first, member = np.unique(cells, return_index=True, return_inverse=True)
        keys, values = known.get(samples.antenna, (np.zeros(0, dtype=np.int64), np.zeros((2, 0))))
        new = ~np.isin(degrees, keys)
        if new.any():
            keys, values = np.append(keys, degrees[new]), np.hstack([values, predictor(samples.part(first[new]))])
            order = np.argsort(keys)
            keys, values = known[samples.antenna] = keys[order], values[:, order]
        gain, sd = values[:, np.searchsorted(keys, degrees)[member.ravel()]]
        return gain, sd

    return predict
