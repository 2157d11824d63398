"""Antenna gain learned from flights, its scores on held-out data, and the choice of a prediction.

Learned antennas are scored on held-out flights, heights, sectors and headings.

A prediction has a *base*, which predicts levels above free space: a constant level, free space, a replay or learned
antennas. Its *correction* is the residual field (:mod:`.field_gp`) of the base. Base and correction are chosen by the
CRPS on held-out flights, or on blocks of a single flight. There is no correction unless a 95 % interval shows that it
lowers the CRPS.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from ..common.errors import InputError
from ..common.geodesy import azimuth_rad, elevation_rad
from ..common.grouping import lists_by_key
from ..common.units import BoolArray, FloatArray, IntArray, spread_out, wrap_degrees
from . import gains
from .field_gp import NEW_FLIGHT, PARTS, FieldFit, FieldModel, Part, Rows, fit_field
from .gains import LinkSamples, turned
from .ladder import log_distance_level_db
from .level import crps_normal, floored_fit, local_mean_db
from .result import BASELINE_TITLE
from .statistics import Interval, mean_interval

SECTORS = 6
# Guard on both sides of a held-out sector [deg]. Directions within this guard are not used for learning either.
_GUARD_DEG = 10.0

_CRUISE_M = 5.0
_LEAST_SAMPLES = 50

# Fields of :class:`Score` with the errors of baselines, and their titles.
BASELINES = {f"{name}_rmse_db": BASELINE_TITLE[name] for name in ("free_space", "log_distance", "constant")}

SPLITS = ("flight_left_out", "altitude_left_out", "heading_left_out", "sector_left_out", "campaign_left_out")


@dataclass(frozen=True, slots=True)
class Observed:
    """The samples of a series, with additional data that are needed to score it.

    ``free_space_db`` (n,): free-space level at the transmit power ``sent_dbm`` [dB]. ``heading_deg`` (n,): heading
    of the nose [deg]. ``tower_m`` (n, 3): positions of a moving tower [m]. ``start``: time of ``time_s`` 0 (UTC) or
    None. ``locked`` (n,): receiver lock, 1 locked, 0 not locked, NaN unknown.
    """

    samples: LinkSamples
    free_space_db: FloatArray
    heading_deg: FloatArray
    tower_m: FloatArray | None = None
    start: np.datetime64 | None = None
    locked: FloatArray | None = None
    sent_dbm: float = 0.0

    def part(self, keep: BoolArray | IntArray) -> Observed:
        """Return the selected samples."""
        return dataclasses.replace(
            self,
            samples=self.samples.part(keep),
            free_space_db=self.free_space_db[keep],
            heading_deg=self.heading_deg[keep],
            tower_m=None if self.tower_m is None else self.tower_m[keep],
            locked=None if self.locked is None else self.locked[keep],
        )


@dataclass(frozen=True, slots=True)
class Recipe:
    """The inputs of :func:`learn` in addition to the samples: a gain model and measured patterns.

    Parameters
    ----------
    model : GainModel
        Terms, and initial values of their strengths.
    patterns : mapping of str to callable
        Gains of measured patterns in the device frame, by ``uav`` and antenna (``tower.channel``). May be empty.
    """

    model: gains.GainModel
    patterns: Mapping[str, gains.GainOf] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Mounted:
    """The measured patterns by name, and the fitted mounts of the patterns that the flights used."""

    patterns: Mapping[str, gains.GainOf]
    mounts: Mapping[str, gains.MountFit]

    def pattern_db(self, name: str, direction: FloatArray) -> FloatArray:
        """Return the gain (n,) of a mounted pattern towards directions (n, 3) in the body or mast frame.

        The gain is 0 for an antenna without a pattern.
        """
        pattern = self.patterns.get(name)
        if pattern is None:
            return np.zeros(len(direction))
        mount = self.mounts.get(name)
        return pattern(direction if mount is None else direction @ turned(mount.azimuth_deg))

    def patterns_db(self, samples: LinkSamples) -> FloatArray:
        """Return the sum (n,) of the gains of the measured patterns of both ends [dB]."""
        return self.pattern_db("uav", samples.at_uav) + self.pattern_db(samples.antenna, samples.at_tower)


@dataclass(frozen=True, slots=True)
class Learned(Mounted):
    """The result of :func:`learn`.

    Parameters
    ----------
    fading : mapping of str to (float, float)
        Fading of the training flights by antenna, from :func:`~aerpaw_cmp.compare.gains.fading_of`.
    """

    fit: gains.GainFit
    fading: Mapping[str, tuple[float, float]]

    @property
    def model(self) -> gains.GainModel:
        """The terms and strengths of the fit."""
        return self.fit.model

    def spread(self, antenna: str) -> gains.Spread:
        """Return the error model of a level at an antenna, excluding the standard deviation of the gain."""
        sd_db, kurtosis = self.fading.get(antenna, (0.0, 0.0))
        campaign = next((s.campaign for s in self.fit.rows if s.antenna == antenna), "")
        own_sd_db, noise_sd_db = self.model.scales_db(antenna, campaign)
        fading = {"fading_sd_db": sd_db, "fading_kurtosis": kurtosis}
        return gains.Spread(own_sd_db=own_sd_db, noise_sd_db=noise_sd_db, bin_s=self.model.bin_s, **fading)

    def predict(self, samples: LinkSamples) -> tuple[FloatArray, FloatArray]:
        """Return the gain of both ends and its standard deviation (n,) [dB], up to a constant."""
        gain, sd = self.fit.predict(samples)
        return self.patterns_db(samples) + gain, sd

    def mean_error(self, samples: LinkSamples) -> float:
        """Return the mean of measured level minus :meth:`mean` [dB], NaN if no sample has a level and a prediction."""
        error = samples.residual_db - self.mean(samples)
        return float(np.nanmean(error)) if np.isfinite(error).any() else math.nan

    def mean(self, samples: LinkSamples) -> FloatArray:
        """Return the gain of :meth:`predict` without its standard deviation, along a flight in time order."""
        return self.patterns_db(samples) + _mean_along(self.fit, samples)


# Averaging time [s]. A UAV hardly turns within this time.
_FINE_S = 0.5


def _mean_along(fit: gains.GainFit, samples: LinkSamples) -> FloatArray:
    """Return the gain (n,) along a flight [dB], interpolated linearly between means over :data:`_FINE_S`."""
    at = dataclasses.replace(samples, residual_db=np.zeros(len(samples))).binned(_FINE_S)
    if not len(at):
        return np.full(len(samples), np.nan)
    # evaluate the gain only at these means: each evaluation requires a row of the kernel matrix
    gain = np.interp(samples.time_s, at.time_s, fit.mean(at))
    return np.where(np.isfinite(samples.at_uav).all(axis=1), gain, np.nan)


def learn(series: Sequence[LinkSamples], recipe: Recipe, model: gains.GainModel | None = None) -> Learned:
    """Fit the mounts of the measured patterns, then a gain over direction to the residual that remains.

    Parameters
    ----------
    series : sequence of LinkSamples
        Residuals of the training flights relative to free space.
    recipe : Recipe
    model : GainModel, optional
        Model whose strengths were already fitted to the same flights. By default, the strengths are fitted here.
    """
    names = ["uav", *dict.fromkeys(s.antenna for s in series)]
    patterns = {name: recipe.patterns[name] for name in names if name in recipe.patterns}
    mounted = Mounted(recipe.patterns, gains.fit_mounts(series, patterns) if patterns else {})
    residuals = [dataclasses.replace(s, residual_db=s.residual_db - mounted.patterns_db(s)) for s in series]
    fit = gains.chosen_fit(residuals, recipe.model) if model is None else gains.fit_gain(residuals, model)
    if any(s.floor_db is not None for s in series):  # fit again once: a third fit does not change held-out errors
        fit = gains.fit_gain([_at_floor(s, mounted.patterns_db(s), fit) for s in series], fit.model)
    antennas = dict.fromkeys(s.antenna for s in series)
    fading = {name: gains.fading_of([s for s in series if s.antenna == name], fit.model.bin_s) for name in antennas}
    return Learned(recipe.patterns, mounted.mounts, fit, fading)


def _at_floor(samples: LinkSamples, known_db: FloatArray, fit: gains.GainFit) -> LinkSamples:
    """Return the samples with ``known_db`` subtracted from the residual, and with samples below the floor replaced.

    Samples below the floor get the value that the fit predicts, limited to the floor.
    """
    residual = samples.residual_db - known_db
    if samples.floor_db is None:
        return dataclasses.replace(samples, residual_db=residual)
    floor, gain = samples.floor_db - known_db, _mean_along(fit, samples)
    offset_db = floored_fit(residual - floor, gain - floor, 0.0).offset_db
    unseen = np.minimum(gain - offset_db, floor)
    return dataclasses.replace(samples, residual_db=np.where(residual < floor, unseen, residual))


@dataclass(frozen=True, slots=True)
class Score:
    """The error of one held-out flight and channel after one offset [dB].

    ``rmse_4s_db``: RMSE after averaging measured and predicted power over 4 s. ``inside_50``, ``inside_90``,
    ``inside_95``: share of a few hundred samples inside the 50, 90 and 95 % interval. ``offset_db``: mean of measured
    minus predicted. ``rmse_shared_offset_db``: RMSE with the mean offset of the training flights. ``constant_rmse_db``,
    ``log_distance_rmse_db``: RMSE of a constant, and of a straight line over log distance. The flight is divided into
    eight areas, and the slope of the line in each area is fitted to the other areas. If parts of a flight are scored,
    the offset of every model and the slope of the line are fitted outside the part.
    """

    flight: str
    tower: str
    channel: str
    rmse_db: float
    rmse_4s_db: float
    free_space_rmse_db: float
    constant_rmse_db: float
    log_distance_rmse_db: float
    n: int
    offset_db: float = math.nan
    inside_50: float = math.nan
    inside_90: float = math.nan
    inside_95: float = math.nan
    rmse_shared_offset_db: float = math.nan


def score(observed: Observed, gain_db: FloatArray, simple: Simple | None = None) -> Score | None:
    """Score a prediction.

    Parameters
    ----------
    observed : Observed
    gain_db : (n,)
        Predicted level above free space [dB]. NaN is not scored.
    simple : Simple, optional
        Baselines whose offsets were fitted outside each scored part, like the offset of ``gain_db``. By default, every
        baseline has one offset for the whole flight.

    Returns
    -------
    Score or None
        None for fewer than 50 samples.
    """
    s = observed.samples
    free = np.zeros(len(s)) if simple is None else simple.free_db
    finite = np.isfinite(s.residual_db - gain_db) & np.isfinite(free)
    if finite.sum() < _LEAST_SAMPLES:
        return None
    time, level, error = s.time_s[finite], observed.free_space_db[finite], (s.residual_db - gain_db)[finite]
    measured = s.residual_db[finite] + level
    if simple is None:
        constant = np.zeros(len(error))
        line = log_distance_level_db(measured, 10.0 ** (-level / 20.0), s.position_m[finite])
    else:
        constant, line = simple.constant_db[finite], simple.line_db[finite]
    means = local_mean_db(time, measured, 4.0) - local_mean_db(time, gain_db[finite] + level, 4.0)
    return Score(
        flight=s.flight,
        tower=s.tower,
        channel=s.channel,
        rmse_db=float(error.std()),
        rmse_4s_db=float(means.std()),
        free_space_rmse_db=float((s.residual_db - free)[finite].std()),
        constant_rmse_db=float((measured - constant).std()),
        log_distance_rmse_db=float((measured - line).std()),
        n=int(finite.sum()),
        offset_db=float(error.mean()),
    )


# Largest slope of a line over log distance, as a multiple of the slope of free space.
STEEPEST = 3.0


@dataclass(frozen=True, slots=True)
class Simple:
    """The predictions of the baselines, each (n,) [dB]: free-space offset, constant, line over log distance."""

    free_db: FloatArray
    constant_db: FloatArray
    line_db: FloatArray

    def predict(self, o: Observed, inside: BoolArray, outside: BoolArray) -> None:
        """Predict the samples of a part from samples outside it."""
        measured = o.samples.residual_db + o.free_space_db
        known = outside & np.isfinite(measured)
        free, level = o.free_space_db[known], measured[known]
        spread = float(((free - free.mean()) ** 2).sum())
        slope = float(((free - free.mean()) * (level - level.mean())).sum()) / spread if spread else 0.0
        # limit the slope to 0 to 60 dB per decade, because samples of one height hardly determine it
        slope = min(max(slope, 0.0), STEEPEST)
        self.free_db[inside] = o.samples.residual_db[known].mean()
        self.constant_db[inside] = level.mean()
        self.line_db[inside] = level.mean() + slope * (o.free_space_db[inside] - free.mean())


def mean_rmse(scores: Sequence[Score], name: str = "rmse_db") -> float:
    """Return the mean of a score over flights and channels [dB], NaN if there are none."""
    return float(np.mean([getattr(s, name) for s in scores])) if scores else math.nan


def flights_of(observed: Sequence[Observed]) -> list[str]:
    """Return the names of the flights, each once, in the order of their samples."""
    return list(dict.fromkeys(o.samples.flight for o in observed))


# Largest number of groups of held-out flights. Up to this number of flights, each is held out alone.
MOST_GROUPS = 6


def groups_of(flights: Sequence[str]) -> list[list[str]]:
    """Return groups of flights that are held out together: each flight alone, or at most :data:`MOST_GROUPS` groups."""
    count = min(len(flights), MOST_GROUPS)
    # use a stride, so that the flights of one day are in different groups
    return [list(flights[i::count]) for i in range(count)]


def flight_left_out(
    observed: Sequence[Observed], recipe: Recipe, without: dict[str, Learned] | None = None
) -> tuple[Score, ...]:
    """Score the prediction of each flight from other flights (:func:`groups_of`).

    ``without`` receives, for each flight, the gains that were learned without this flight.
    """
    scores: list[Score | None] = []
    for group in groups_of(flights_of(observed)):
        train = [o.samples for o in observed if o.samples.flight not in group]
        learned = learn(train, recipe)
        if without is not None:
            without |= dict.fromkeys(group, learned)
        unseen = [o for o in observed if o.samples.flight in group]
        if without is None:
            known = {s.antenna for s in train if np.isfinite(s.residual_db).any()}
            scores += [score(o, learned.mean(o.samples)) for o in unseen if o.samples.antenna in known]
        else:
            scores += _scored_with(unseen, learned, _offsets(train, learned))
    return tuple(s for s in scores if s is not None)


def campaign_left_out(observed: Sequence[Observed], recipe: Recipe, turn_deg: float = 0.0) -> tuple[Score, ...]:
    """Score levels of each campaign, predicted only with the UAV gain from other campaigns with the same airframe.

    Campaigns are omitted if no other campaign has their airframe.

    Parameters
    ----------
    observed : sequence of Observed
    recipe : Recipe
    turn_deg : float
        Angle by which directions at the UAV are rotated anticlockwise, as a control.
    """
    scores: list[Score | None] = []
    for name in dict.fromkeys(o.samples.campaign for o in observed):
        train = [o.samples for o in observed if o.samples.campaign != name]
        pupils = [o for o in observed if o.samples.campaign == name]
        if any(s.airframe == pupils[0].samples.airframe for s in train):
            fit = learn(train, recipe).fit
            for o in pupils:
                at_uav = gains.rotated(o.samples.at_uav, turn_deg)
                scores.append(score(o, fit.airframe_mean(dataclasses.replace(o.samples, at_uav=at_uav))))
    return tuple(s for s in scores if s is not None)


def score_with(learned: Learned, unseen: Sequence[Observed], train: Sequence[Observed]) -> tuple[Score, ...]:
    """Score held-out flights with the antennas of the training flights."""
    return tuple(_scored_with(unseen, learned, _offsets([o.samples for o in train], learned)))


def _offsets(train: Sequence[LinkSamples], learned: Learned) -> dict[str, float]:
    """Return the mean over flights of measured minus predicted, by antenna [dB]."""
    each = lists_by_key((samples.antenna, learned.mean_error(samples)) for samples in train)
    return {antenna: float(np.nanmean(values)) for antenna, values in each.items() if np.isfinite(values).any()}


# Number of samples per series whose standard deviation is checked. Computing a standard deviation takes a thousand
# times longer than computing a mean.
_SPREAD_SAMPLES = 400


def _scored_with(unseen: Sequence[Observed], learned: Learned, offsets: Mapping[str, float]) -> Iterator[Score]:
    """Yield scores with the offset of the scored flight, and of the training flights, if both offsets are known."""
    for o in unseen:
        if o.samples.antenna not in offsets:
            continue
        gain = learned.mean(o.samples)
        fitted = score(o, gain)
        if fitted is None:
            continue
        # spread over the flight, because neighbouring samples have nearly the same standard deviation
        some = spread_out(len(gain), _SPREAD_SAMPLES)
        stated = gains.StatedSpread(
            gain_sd_db=learned.predict(o.samples.part(some))[1], spread=learned.spread(o.samples.antenna)
        )
        error = o.samples.residual_db - gain - fitted.offset_db
        fitted = dataclasses.replace(fitted, **gains.inside_shares(error[some], stated))  # type: ignore[arg-type]
        # RMSE with another offset: mean square plus the squared difference of the offsets
        shared = math.hypot(fitted.rmse_db, fitted.offset_db - offsets[o.samples.antenna])
        yield dataclasses.replace(fitted, rmse_shared_offset_db=shared)


# Largest number of flights that are scored part by part. If there are more flights, an evenly spaced selection is
# scored.
_MOST_SCORED = 6


def spread_flights(flights: Sequence[str]) -> list[str]:
    """Return all flights, or :data:`_MOST_SCORED` of them including the first and the last."""
    return [flights[i] for i in spread_out(len(flights), _MOST_SCORED)]


# ``parts(scored, other)`` returns two masks for each part: the samples (n,) of the scored series that are in the part,
# and the samples (m,) of another series that can be used for learning.
Parts = Callable[[Observed, Observed], list[tuple[BoolArray, BoolArray]]]


def parts_left_out(
    observed: Sequence[Observed], recipe: Recipe, without: Mapping[str, Learned], parts: Parts
) -> tuple[Score, ...]:
    """Score predictions of each part of a flight, learned from samples of other flights that do not resemble the part.

    The offset is fitted to samples of the flight outside the part, so that nothing is fitted to the part itself.

    Parameters
    ----------
    observed : sequence of Observed
        Samples of all flights.
    recipe : Recipe
    without : mapping of str to Learned
        Learned gains by held-out flight. The strengths of these gains are not fitted again.
    parts : callable
        :func:`altitude_parts`, :func:`heading_parts` or :func:`sector_parts`.

    Returns
    -------
    tuple of Score
        One score per series, over all its parts. Series without a predicted part are omitted.
    """
    flights = spread_flights(flights_of(observed))
    of = {flight: [o for o in observed if o.samples.flight == flight] for flight in flights}
    stitched = {flight: [np.full(len(o.samples), np.nan) for o in of[flight]] for flight in flights}
    simple = {flight: [Simple(*np.full((3, len(o.samples)), np.nan)) for o in of[flight]] for flight in flights}
    # loop over parts first, because the flights have nearly the same training data, whose kernels are cached
    for k in range(max(len(parts(mine[0], mine[0])) for mine in of.values())):
        for flight, mine in of.items():
            sources = (o for o in observed if o.samples.flight != flight)
            train = [o.part(parts(mine[0], o)[k][1]).samples for o in sources]
            train = [s for s in train if np.isfinite(s.residual_db).sum() >= _LEAST_SAMPLES]
            if not train or not any(parts(o, o)[k][0].any() for o in mine):
                continue
            try:
                learned = learn(train, recipe, without[flight].model)
            except InputError:
                continue
            known = {s.antenna for s in train}
            for o, predicted, baselines in zip(mine, stitched[flight], simple[flight], strict=True):
                inside, outside = parts(o, o)[k]
                if o.samples.antenna not in known or not inside.any():
                    continue
                gain = learned.mean(o.samples)
                error = (o.samples.residual_db - gain)[outside]
                if np.isfinite(error).sum() >= _LEAST_SAMPLES:
                    predicted[inside] = gain[inside] + np.nanmean(error)
                    baselines.predict(o, inside, outside)
    out = [
        score(o, predicted, simple=baselines)
        for flight in flights
        for o, predicted, baselines in zip(of[flight], stitched[flight], simple[flight], strict=True)
    ]
    return tuple(s for s in out if s is not None)


def altitude_parts(scored: Observed, source: Observed) -> list[tuple[BoolArray, BoolArray]]:
    """Return one part: the most frequent height of the scored flight. All other heights are used for learning."""
    height, cruise = scored.samples.position_m[:, 2], cruise_height_m(scored)
    mine = np.abs(height - cruise) < _CRUISE_M
    return [(mine, np.abs(source.samples.position_m[:, 2] - cruise) >= _CRUISE_M)]


def cruise_height_m(observed: Observed) -> float:
    """Return the most frequent height of a flight, rounded to a metre [m]."""
    heights, count = np.unique(np.round(observed.samples.position_m[:, 2]), return_counts=True)
    return float(heights[count.argmax()])


def sector_parts(scored: Observed, source: Observed) -> list[tuple[BoolArray, BoolArray]]:
    """Return one part per sector of azimuth at the tower, with guards that are not used for learning."""

    def azimuth(o: Observed) -> FloatArray:
        return np.degrees(azimuth_rad(o.samples.at_tower))

    return _angular(azimuth(scored), azimuth(source), SECTORS, _GUARD_DEG)


def heading_parts(scored: Observed, source: Observed) -> list[tuple[BoolArray, BoolArray]]:
    """Return one part per eighth of the compass for the heading, with guards that are not used for learning."""
    return _angular(scored.heading_deg, source.heading_deg, 8, _GUARD_DEG)


def _angular(mine: FloatArray, sources: FloatArray, count: int, guard_deg: float) -> list[tuple[BoolArray, BoolArray]]:
    half = 180.0 / count
    out = []
    for k in range(count):
        centre = 2.0 * half * (k + 0.5)
        near = np.abs(wrap_degrees(mine - centre)) <= half
        far = np.abs(wrap_degrees(sources - centre)) > half + guard_deg
        out.append((near, far))
    return out


def world_frame(observed: Sequence[Observed]) -> list[Observed]:
    """Return the samples with the UAV's directions in world axes, as a control: no antenna is fixed in these axes."""
    return [_with_uav(o, -o.samples.at_tower) for o in observed]


def wrong_way(observed: Sequence[Observed]) -> list[Observed]:
    """Return the samples with headings of the wrong sign, as a control."""
    out = []
    for o in observed:
        body = o.samples.at_uav
        # azimuth in the body frame is bearing minus heading; the control uses bearing plus heading
        turned = 2.0 * azimuth_rad(-o.samples.at_tower) - azimuth_rad(body)
        across = np.hypot(body[:, 0], body[:, 1])
        out.append(_with_uav(o, np.stack([across * np.cos(turned), across * np.sin(turned), body[:, 2]], axis=1)))
    return out


def _with_uav(o: Observed, at_uav: FloatArray) -> Observed:
    return dataclasses.replace(o, samples=dataclasses.replace(o.samples, at_uav=at_uav))


# Function that predicts the level above free space (n,) and its standard deviation (n,) [dB], without using residuals.
Predictor = Callable[[LinkSamples], tuple[FloatArray, FloatArray]]

# Function that learns from samples with residuals relative to free space, and returns a predictor.
Base = Callable[[Sequence[LinkSamples]], Predictor]

_HeldOut = tuple[FloatArray, FloatArray]

# Averaging time of the residuals [s].
BIN_S = 4.0

# Side of the held-out blocks of a single flight [m].
BLOCK_M = 300.0

# Number of groups that are held out in turn if there are more flights than :data:`MOST_GROUPS`. The parameters of a
# residual field are then fitted only once, without the first group, because single flights hardly change them.
_SCORED_GROUPS = 3

OFF = "no correction"

_NUISANCE = ("drift_sd_db", "drift_s", "noise_sd_db")

# Lengths of the field over positions. Drift and noise are always fitted. With few flights, the likelihood confuses
# position with direction and height: fitting the lengths increased the error on held-out flights by 0.3 dB.
_STARTS: dict[str, FieldModel | None] = {
    OFF: FieldModel(place_sd_db=1e-3, turn=math.inf, drift_s=8.0),
    "field of 2 dB, 30 m": FieldModel(place_sd_db=2.0, length_m=30.0, height_m=20.0, turn=0.35, drift_s=8.0),
    "field of 2.5 dB, 50 m": FieldModel(place_sd_db=2.5, length_m=50.0, height_m=40.0, turn=0.35, drift_s=8.0),
    "field of 1.5 dB, 50 m": FieldModel(place_sd_db=1.5, length_m=50.0, height_m=40.0, turn=math.inf, drift_s=8.0),
    "field by likelihood": None,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Channel:
    """The binned rows of one tower and channel over all flights, with the residuals (n,) of a base [dB]."""

    rows: Rows
    left_db: FloatArray
    base_sd_db: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Correction:
    """The chosen base and residual field, fitted to all known flights.

    Parameters
    ----------
    base : str
    predictor : callable
        Prediction of the model ``base``, learned from all flights.
    title : str
        Title of the residual field, or :data:`OFF`.
    model : FieldModel
    channels : mapping of str to Channel
        Channels by antenna (``tower.channel``).
    flights : tuple of str
        Names of the flights. The index of a flight is its code in :class:`Rows`.
    crps_db, rmse_db : mapping of (base, title) to float
        CRPS and RMSE of held-out errors.
    held_out : mapping of (base, title) to ((n,), (n,))
        Held-out errors and their standard deviations, in the same order for all candidates. NaN if not predicted.
    held_out_place_m : (n, 3), optional
        Positions of the samples of ``held_out`` [m].
    held_out_parts : tuple of (str, int)
        Flight and number of samples of each tower and channel in ``held_out``, in its order.
    sd_factor : float
        Factor by which all standard deviations are multiplied to agree with the held-out errors. Each candidate of
        ``held_out`` has its own factor.
    fits : mapping of str to FieldFit
        The solved fields by antenna.
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
    held_out_place_m: FloatArray | None = None
    held_out_parts: tuple[tuple[str, int], ...] = ()
    sd_factor: float = 1.0
    fits: dict[str, FieldFit] = field(default_factory=dict, repr=False, compare=False)

    @property
    def on(self) -> bool:
        """True if a residual field is added."""
        return self.title != OFF

    def predict(
        self, samples: LinkSamples, flight: str | None = None, *, own_mean: bool = False
    ) -> tuple[FloatArray, FloatArray]:
        """Return level above free space (n,) and its standard deviation (n,) for means over :data:`BIN_S` [dB].

        The standard deviation includes base, field, drift and noise. It also includes the offset between flights,
        unless ``own_mean`` is set: errors are then relative to the mean of the samples.
        """
        return self.over_headings([samples], flight, own_mean=own_mean)

    def over_headings(
        self, each: Sequence[LinkSamples], flight: str | None = None, *, own_mean: bool = False
    ) -> tuple[FloatArray, FloatArray]:
        """Return the mean of :meth:`predict` over several headings, for an aircraft with unknown heading.

        Parameters
        ----------
        each : sequence of LinkSamples
            The same samples with each heading.
        flight : str, optional
        own_mean : bool

        Returns
        -------
        level_db, sd_db : (n,)
            Mean over the headings, and a standard deviation that includes the spread between them.
        """
        samples = each[0]
        channel = self.channels.get(samples.antenna)
        if channel is None:
            raise InputError(f"no flight has {samples.antenna}", expected="one of " + ", ".join(self.channels))
        means, gain_sds = (np.stack(part) for part in zip(*map(self.predictor, each), strict=True))
        targets = Rows.of(samples, self.flights.index(flight) if flight in self.flights else NEW_FLIGHT)
        if len(each) > 1:
            targets = dataclasses.replace(targets, direction=np.stack([s.at_uav for s in each], axis=1))
        if not self.on and flight not in self.flights and len(targets):
            # without a field, all targets have the same standard deviation, so solve for a single target
            targets = targets.part(np.array([np.isfinite(targets.position_m).all(axis=1).argmax()]))
        # solve once for each antenna, because maps are predicted tile by tile
        fit = self.fits.setdefault(samples.antenna, FieldFit(self.model, channel.rows, channel.left_db))
        mean, sd = fit.predict(targets)
        if own_mean:
            # errors relative to a flight's own mean do not contain its offset
            _, sd = fit.predict(targets, ("place", "drift"))
        variance = sd**2 + (gain_sds**2).mean(axis=0) + means.var(axis=0) + self.model.noise_sd_db**2
        return means.mean(axis=0) + mean, self.sd_factor * np.sqrt(variance)


def between_blocks_db(channel: Channel) -> float:
    """Return the SD of a base's residual between blocks of :data:`BLOCK_M` [dB], or 0 for a single block."""
    cell = np.floor(channel.rows.position_m[:, :2] / BLOCK_M).astype(np.int64)
    member = np.unique(cell, axis=0, return_inverse=True)[1].ravel()
    # give blocks equal weights, so that a hover does not count more than a pass
    means = np.bincount(member, weights=channel.left_db) / np.bincount(member)
    return float(np.std(means, ddof=1)) if len(means) > 1 else 0.0


def _channels(series: Sequence[LinkSamples], predictor: Predictor, flights: Sequence[str]) -> dict[str, Channel]:
    """Return the rows and the residuals of a base for each antenna."""
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
    """The samples of a held-out part, and the samples from which they are predicted."""

    known: list[LinkSamples]
    left_out: list[LinkSamples]


def _folds(series: Sequence[LinkSamples]) -> list[_Fold]:
    """Return the cross-validation folds: single flights, three of six groups of flights, or blocks of one flight."""
    names = list(dict.fromkeys(s.flight for s in series))
    if len(names) > 1:
        return [
            _Fold([s for s in series if s.flight not in group], [s for s in series if s.flight in group])
            for group in groups_of(names)[: None if len(names) <= MOST_GROUPS else _SCORED_GROUPS]
        ]
    size_m, every = 2.0 * BLOCK_M, np.empty(0)
    while len(every) < 2 and size_m > 1.0:  # a short flight may lie inside one block
        size_m /= 2.0
        cells = [np.floor(s.position_m[:, :2] / size_m).astype(np.int64) for s in series]
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
    """Add the errors of every residual field of a base in one fold. Errors of a new flight are relative to its mean.

    Parameters
    ----------
    fold : _Fold
    base : callable
    models : dict of str to FieldModel or None
        Models by title. A model that is None is fitted here.
    tallies : mapping of str to list
        Lists to which the errors are appended.
    keep : bool
        True to store the fitted models in ``models``.
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
        for samples, predicted in zip(binned, known, strict=True):
            if predicted is None:
                tallies[title].append((np.full(len(samples), np.nan), np.ones(len(samples))))
                continue
            channel, (gain, gain_sd) = channels[samples.antenna], predicted
            code = NEW_FLIGHT if new_flight else flights.index(samples.flight)
            mean, sd = FieldFit(model, channel.rows, channel.left_db).predict(Rows.of(samples, code), parts)
            error = samples.residual_db - gain - mean
            if new_flight and np.isfinite(error).any():
                error = error - np.nanmean(error)
            tallies[title].append((error, np.sqrt(sd**2 + gain_sd**2 + model.noise_sd_db**2)))


# Titles of the residual fields with fixed lengths. Fitted lengths do not apply far from the flown positions.
STATED_FIELDS = tuple(title for title, start in _STARTS.items() if start is not None)


def choose(series: Sequence[LinkSamples], bases: Mapping[str, Base], titles: Sequence[str] = ()) -> Correction:
    """Choose the base and residual field with the lowest held-out CRPS, and fit them to all known flights.

    Parameters
    ----------
    series : sequence of LinkSamples
        Samples of every known flight, tower and channel, with residuals relative to free space.
    bases : mapping of str to callable
        Bases in order of preference for equal scores.
    titles : sequence of str
        Titles of the residual fields to try, including :data:`OFF`. By default, all are tried.

    Returns
    -------
    Correction

    Raises
    ------
    InputError
        If no sample has a level and a pose, or all samples are at one position.
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
    if not joined:
        raise InputError("all samples are at one position, so no model can be tested", expected="a flight over an area")
    left_out = [s for fold in folds if fold.known for s in fold.left_out if np.isfinite(s.residual_db).any()]
    place = np.concatenate([np.zeros((0, 3)), *(s.binned(BIN_S).position_m for s in left_out)])
    # scale standard deviations before scoring, so that the CRPS compares errors and not standard deviations of the
    # wrong size
    factors = {key: _sd_factor([s.flight for s in left_out], tallies[key]) for key in joined}
    held_out = {key: (error, factors[key] * sd) for key, (error, sd) in joined.items()}
    crps = dict.fromkeys(tallies, math.inf) | {key: _mean(crps_normal(*errors)) for key, errors in held_out.items()}
    sure = [key for key in held_out if key[1] == OFF or crps_difference(held_out, key, place)[1][1] < 0.0]
    # round to a thousandth of a decibel, so that equal scores follow the order of preference
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
        held_out_place_m=place,
        held_out_parts=tuple((s.flight, len(part[0])) for s, part in zip(left_out, tallies[best], strict=True)),
        sd_factor=factors.get(best, 1.0),
    )


def crps_difference(
    held_out: Mapping[tuple[str, str], _HeldOut], key: tuple[str, str], place_m: FloatArray | None
) -> tuple[float, Interval]:
    """Return the mean change of the CRPS [dB] if a residual field is added to a base, and its 95 % interval.

    Parameters
    ----------
    held_out : mapping of (base, title) to ((n,), (n,))
        Errors and their standard deviations, as in :class:`Correction`.
    key : (base, title)
    place_m : (n, 3) or None
        Positions [m]. If they are given, the interval also allows for correlation over position.
    """
    difference = crps_normal(*held_out[key]) - crps_normal(*held_out[key[0], OFF])
    good = np.isfinite(difference)
    place = None if place_m is None else place_m[good]
    return float(difference[good].mean()), mean_interval(difference[good], place)


def _sd_factor(flights: Sequence[str], parts: Sequence[_HeldOut]) -> float:
    """Return the ratio of actual to stated errors of held-out parts, limited to 0.8 to 1.6. It is 1 without errors.

    The ratio is the geometric mean over flights. A model that was learned from flights with small errors states an
    error that is too small for a flight with large errors, and vice versa. An arithmetic mean would give more weight to
    the first of these cases, although the final model is fitted to all flights.
    """
    squares = lists_by_key(zip(flights, (np.square(error / sd) for error, sd in parts), strict=True))
    means = [_mean(np.concatenate(each)) for each in squares.values()]
    logs = [math.log(max(mean, 1e-12)) for mean in means if math.isfinite(mean)]
    return min(max(math.exp(0.5 * sum(logs) / len(logs)), 0.8), 1.6) if logs else 1.0


def _joined(parts: Sequence[_HeldOut]) -> _HeldOut:
    error, sd = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    return error, sd


def _mean(values: FloatArray) -> float:
    """Return the mean of the finite values, or infinity if there are none."""
    good = values[np.isfinite(values)]
    return float(good.mean()) if len(good) else math.inf


def fixed_base(gain: Callable[[LinkSamples], FloatArray]) -> Base:
    """Return a base with a known level above free space, which learns nothing from the samples."""

    def learn(_: Sequence[LinkSamples]) -> Predictor:
        return lambda samples: (gain(samples), np.zeros(len(samples)))

    return learn


# Number of samples above which a model of directions is evaluated once per degree.
MOST_DIRECTIONS = 5_000


def by_degree(predictor: Predictor) -> Predictor:
    """Return a predictor that evaluates a model of directions once per degree if there are many samples.

    One degree is enough, because gains have correlation lengths of 11 degrees and more. Results are cached, because
    later parts of a run and other headings have nearly the same directions.
    """
    known: dict[str, tuple[IntArray, FloatArray]] = {}

    def predict(samples: LinkSamples) -> tuple[FloatArray, FloatArray]:
        if len(samples) <= MOST_DIRECTIONS:
            return predictor(samples)
        cells = np.zeros(len(samples), dtype=np.int64)
        for ray in (samples.at_tower, samples.at_uav):
            for angle in (azimuth_rad(ray), elevation_rad(ray)):
                # combine both directions, rounded to a degree, into one integer
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
