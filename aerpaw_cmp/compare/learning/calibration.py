"""Antenna gain learned from flights, and its generalization to flights, heights and directions left out."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from ...common.errors import InputError
from ...common.geodesy import azimuth_rad
from ...common.units import BoolArray, FloatArray, IntArray, spread_out, wrap_degrees
from ..gains.direction_gain import GainFit, GainModel, LinkSamples, chosen_fit, fit_gain
from ..gains.mount import GainOf, MountFit, fit_mounts, turned
from ..gains.spread import Spread, StatedSpread, fading_of, inside_shares
from ..judge.ladder import log_distance_level_db
from ..level.detection import floored_fit
from ..level.rss import local_mean_db
from ..result import BASELINE_TITLE

SECTORS = 6
# Directions this near a left-out sector are not learned from either.
_GUARD_DEG = 10.0

STRETCHES = 8
GUARD_S = 20.0
_CRUISE_M = 5.0
_LEAST_SAMPLES = 50

# Fields of :class:`Score` that a learned model is held against, with their titles.
BASELINES = {f"{name}_rmse_db": BASELINE_TITLE[name] for name in ("free_space", "log_distance", "constant")}

SPLITS = ("flight_left_out", "altitude_left_out", "heading_left_out", "sector_left_out", "route_left_out")


@dataclass(frozen=True, slots=True)
class Observed:
    """Samples with what a score needs besides: level of free space (n,) [dB], heading of the nose (n,) [deg].

    ``tower_m`` (n, 3): places of a tower that moves [m]. ``start``: the instant of ``time_s`` 0 (UTC), where known.
    ``locked`` (n,): 1 where the receiver was in lock, 0 where it had lost it, NaN unknown. ``sent_dbm``: transmit power
    of ``free_space_db``.
    """

    samples: LinkSamples
    free_space_db: FloatArray
    heading_deg: FloatArray
    tower_m: FloatArray | None = None
    start: np.datetime64 | None = None
    locked: FloatArray | None = None
    sent_dbm: float = 0.0

    def part(self, keep: BoolArray | IntArray) -> Observed:
        """Some of the samples."""
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
    """Definition of the quantities to be learned.

    Parameters
    ----------
    model : GainModel
        Terms and where their strengths start.
    patterns : mapping of str to callable
        Gain of measured patterns in the device frame: ``uav`` and antennas (``tower.channel``); may be empty.
    """

    model: GainModel
    patterns: Mapping[str, GainOf] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Mounted:
    """Measured patterns by name, and the mounts that were fitted of those that a flight used."""

    patterns: Mapping[str, GainOf]
    mounts: Mapping[str, MountFit]

    def pattern_db(self, name: str, direction: FloatArray) -> FloatArray:
        """Gain (n,) of a measured pattern as mounted, towards directions (n, 3) of body or mast; 0 without one."""
        pattern = self.patterns.get(name)
        if pattern is None:
            return np.zeros(len(direction))
        mount = self.mounts.get(name)
        return pattern(direction if mount is None else direction @ turned(mount.azimuth_deg))

    def patterns_db(self, samples: LinkSamples) -> FloatArray:
        """Gain (n,) of the measured patterns of both ends."""
        return self.pattern_db("uav", samples.at_uav) + self.pattern_db(samples.antenna, samples.at_tower)


@dataclass(frozen=True, slots=True)
class Learned(Mounted):
    """The outcome of :func:`learn`."""

    fit: GainFit
    fading: Mapping[str, tuple[float, float]]
    """Of each antenna: :func:`~aerpaw_cmp.compare.gains.spread.fading_of` the flights that were learned from."""

    @property
    def model(self) -> GainModel:
        """Terms and strengths of the fit."""
        return self.fit.model

    def spread(self, antenna: str) -> Spread:
        """Spread of a level at an antenna besides the standard deviation of the gain."""
        model = self.model
        sd_db, kurtosis = self.fading.get(antenna, (0.0, 0.0))
        return Spread(
            own_sd_db=model.own_sd_db,
            noise_sd_db=model.noise_sd_db,
            fading_sd_db=sd_db,
            fading_kurtosis=kurtosis,
            bin_s=model.bin_s,
        )

    def predict(self, samples: LinkSamples) -> tuple[FloatArray, FloatArray]:
        """Gain of both ends and its standard deviation (n,) [dB], about a mean that the offset takes."""
        gain, sd = self.fit.predict(samples)
        return self.patterns_db(samples) + gain, sd

    def mean_error(self, samples: LinkSamples) -> float:
        """Mean of measured minus :meth:`mean` [dB]; NaN without a sample that has both."""
        error = samples.residual_db - self.mean(samples)
        return float(np.nanmean(error)) if np.isfinite(error).any() else math.nan

    def mean(self, samples: LinkSamples) -> FloatArray:
        """The gain of :meth:`predict` alone, along a flight in the order of time."""
        return self.patterns_db(samples) + _mean_along(self.fit, samples)


# A UAV hardly turns within this time [s].
_FINE_S = 0.5


def _mean_along(fit: GainFit, samples: LinkSamples) -> FloatArray:
    """Gain (n,) along a flight [dB]: at means over :data:`_FINE_S`, and linear between them."""
    at = dataclasses.replace(samples, residual_db=np.zeros(len(samples))).binned(_FINE_S)
    if not len(at):
        return np.full(len(samples), np.nan)
    # linear between half seconds: each mean costs a row of kernels
    gain = np.interp(samples.time_s, at.time_s, fit.mean(at))
    return np.where(np.isfinite(samples.at_uav).all(axis=1), gain, np.nan)


def learn(series: Sequence[LinkSamples], recipe: Recipe, model: GainModel | None = None) -> Learned:
    """Mounts, then the gain over direction on top of the patterns.

    Parameters
    ----------
    series : sequence of LinkSamples
        Residuals against free space of the flights to learn from, and no other.
    recipe : Recipe
    model : GainModel, optional
        Strengths that were chosen on the same flights; chosen anew without.
    """
    names = ["uav", *dict.fromkeys(s.antenna for s in series)]
    patterns = {name: recipe.patterns[name] for name in names if name in recipe.patterns}
    mounted = Mounted(recipe.patterns, fit_mounts(series, patterns) if patterns else {})
    residuals = [dataclasses.replace(s, residual_db=s.residual_db - mounted.patterns_db(s)) for s in series]
    fit = chosen_fit(residuals, recipe.model) if model is None else fit_gain(residuals, model)
    if any(s.floor_db is not None for s in series):  # once more; another time changes nothing on flights left out
        fit = fit_gain([_at_floor(s, mounted.patterns_db(s), fit) for s in series], fit.model)
    antennas = dict.fromkeys(s.antenna for s in series)
    fading = {name: fading_of([s for s in series if s.antenna == name], fit.model.bin_s) for name in antennas}
    return Learned(recipe.patterns, mounted.mounts, fit, fading)


def _at_floor(samples: LinkSamples, known_db: FloatArray, fit: GainFit) -> LinkSamples:
    """Residual minus ``known_db``; below the floor, the value that the fit expects, no higher than the floor."""
    residual = samples.residual_db - known_db
    if samples.floor_db is None:
        return dataclasses.replace(samples, residual_db=residual)
    floor, gain = samples.floor_db - known_db, _mean_along(fit, samples)
    offset_db = floored_fit(residual - floor, gain - floor, 0.0).offset_db
    unseen = np.minimum(gain - offset_db, floor)
    return dataclasses.replace(samples, residual_db=np.where(residual < floor, unseen, residual))


@dataclass(frozen=True, slots=True)
class Score:
    """Error of one flight and channel that had no part in the fit, after one offset [dB].

    ``rmse_4s_db``: both sides averaged in power over 4 s. ``inside_50``, ``inside_90``, ``inside_95``: share of
    samples (some hundred of them) inside the interval that is to hold so many per cent. ``offset_db``: measured
    minus predicted, mean. ``rmse_shared_offset_db``: with the mean offset of the flights that were learned from in
    place of the flight's own. ``constant_rmse_db``, ``log_distance_rmse_db``: of a constant, and of a line over log
    distance whose slope at each of eight places comes from the other places of the flight. Where a part of a flight is
    scored, the offset of every model (and the slope of the line) comes from outside that part.
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
    """Score of a prediction; None with fewer than 50 samples to score.

    Parameters
    ----------
    observed : Observed
    gain_db : (n,)
        Predicted level above free space [dB]; NaN is not scored.
    simple : Simple, optional
        Baselines whose offset in each scored part, like that of ``gain_db``, comes from samples outside the part, so
        that they are compared like for like. Without, they have one offset for the whole flight.

    Returns
    -------
    Score or None
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


# Of a line over log distance: times free space.
STEEPEST = 3.0


@dataclass(frozen=True, slots=True)
class Simple:
    """Models without antennas, each (n,): free space above its level, a constant and a line over log distance [dB]."""

    free_db: FloatArray
    constant_db: FloatArray
    line_db: FloatArray

    def predict(self, o: Observed, inside: BoolArray, outside: BoolArray) -> None:
        """Fill in the samples of a part, every number of it from samples outside."""
        measured = o.samples.residual_db + o.free_space_db
        known = outside & np.isfinite(measured)
        free, level = o.free_space_db[known], measured[known]
        spread = float(((free - free.mean()) ** 2).sum())
        slope = float(((free - free.mean()) * (level - level.mean())).sum()) / spread if spread else 0.0
        # 0 to 60 dB per decade: seen from one height only, a line may point anywhere else
        slope = min(max(slope, 0.0), STEEPEST)
        self.free_db[inside] = o.samples.residual_db[known].mean()
        self.constant_db[inside] = level.mean()
        self.line_db[inside] = level.mean() + slope * (o.free_space_db[inside] - free.mean())


def mean_rmse(scores: Sequence[Score], name: str = "rmse_db") -> float:
    """Mean over flights and channels [dB]; NaN without any."""
    return float(np.mean([getattr(s, name) for s in scores])) if scores else math.nan


def flights_of(observed: Sequence[Observed]) -> list[str]:
    """Names in order."""
    return list(dict.fromkeys(o.samples.flight for o in observed))


# Flights are left out one by one, or, where they are more, in this many groups: none is predicted by itself.
MOST_GROUPS = 6


def groups_of(flights: Sequence[str]) -> list[list[str]]:
    """Flights that are left out together: each alone, or spread over :data:`MOST_GROUPS` groups."""
    count = min(len(flights), MOST_GROUPS)
    # every so many: flights of one day are learned from and predicted
    return [list(flights[i::count]) for i in range(count)]


def flight_left_out(
    observed: Sequence[Observed], recipe: Recipe, without: dict[str, Learned] | None = None
) -> tuple[Score, ...]:
    """Each flight predicted from others (:func:`groups_of`); ``kept`` receives what was learned without each flight."""
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


def score_with(learned: Learned, unseen: Sequence[Observed], train: Sequence[Observed]) -> tuple[Score, ...]:
    """Scores of flights that were not learned from, at antennas that were."""
    return tuple(_scored_with(unseen, learned, _offsets([o.samples for o in train], learned)))


def _offsets(train: Sequence[LinkSamples], learned: Learned) -> dict[str, float]:
    """Mean over flights of measured minus predicted, per antenna [dB]."""
    each: dict[str, list[float]] = {}
    for samples in train:
        each.setdefault(samples.antenna, []).append(learned.mean_error(samples))
    return {antenna: float(np.nanmean(values)) for antenna, values in each.items() if np.isfinite(values).any()}


# Samples of a series at which standard deviations are checked: each costs a thousand times what its mean does.
_SPREAD_SAMPLES = 400


def _scored_with(unseen: Sequence[Observed], learned: Learned, offsets: Mapping[str, float]) -> Iterator[Score]:
    """Scores at antennas that have an offset, with their own and with that of the other flights."""
    for o in unseen:
        if o.samples.antenna not in offsets:
            continue
        gain = learned.mean(o.samples)
        fitted = score(o, gain)
        if fitted is None:
            continue
        # evenly over the flight: neighbours have the same standard deviation
        some = spread_out(len(gain), _SPREAD_SAMPLES)
        stated = StatedSpread(
            gain_sd_db=learned.predict(o.samples.part(some))[1], spread=learned.spread(o.samples.antenna)
        )
        error = o.samples.residual_db - gain - fitted.offset_db
        fitted = dataclasses.replace(fitted, **inside_shares(error[some], stated))  # type: ignore[arg-type]
        # the mean square about another offset is the variance and the square of their difference
        shared = math.hypot(fitted.rmse_db, fitted.offset_db - offsets[o.samples.antenna])
        yield dataclasses.replace(fitted, rmse_shared_offset_db=shared)


# Of more flights, this many are scored part by part, evenly over their order.
_MOST_SCORED = 6


def spread_flights(flights: Sequence[str]) -> list[str]:
    """The flights, or :data:`_MOST_SCORED` of them, the first and the last among them."""
    return [flights[i] for i in spread_out(len(flights), _MOST_SCORED)]


# ``parts(scored, other)``: per part the samples (n,) of the scored series in it, and those (m,) of another series that
# may be learned from.
Parts = Callable[[Observed, Observed], list[tuple[BoolArray, BoolArray]]]


def parts_left_out(
    observed: Sequence[Observed],
    recipe: Recipe,
    without: Mapping[str, Learned],
    parts: Parts,
    *,
    own_rest: bool,
) -> tuple[Score, ...]:
    """Each flight predicted part by part, from other flights without what is like the part.

    ``own_rest``: the rest of the flight is learned from, too. The offset of a part comes from the flight's samples
    outside it, so that nothing of the part is fitted.

    Parameters
    ----------
    observed : sequence of Observed
        Of all flights.
    recipe : Recipe
    without : mapping of str to Learned
        What was learned without each flight: its strengths are used again.
    parts : callable
        :func:`altitude_parts`, :func:`heading_parts`, :func:`sector_parts` or :func:`route_parts`.
    own_rest : bool
        Learn from the rest of the flight, too.

    Returns
    -------
    tuple of Score
        One per series, over all its parts; series of which no part could be predicted are left out.
    """
    flights = spread_flights(flights_of(observed))
    of = {flight: [o for o in observed if o.samples.flight == flight] for flight in flights}
    stitched = {flight: [np.full(len(o.samples), np.nan) for o in of[flight]] for flight in flights}
    simple = {flight: [Simple(*np.full((3, len(o.samples)), np.nan)) for o in of[flight]] for flight in flights}
    # one part after the other: what the flights learn from is much the same, and kept
    for k in range(max(len(parts(mine[0], mine[0])) for mine in of.values())):
        for flight, mine in of.items():
            sources = list(observed) if own_rest else [o for o in observed if o.samples.flight != flight]
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
    """The commonest height of the scored flight, and all other heights."""
    height, cruise = scored.samples.position_m[:, 2], cruise_height_m(scored)
    mine = np.abs(height - cruise) < _CRUISE_M
    return [(mine, np.abs(source.samples.position_m[:, 2] - cruise) >= _CRUISE_M)]


def cruise_height_m(observed: Observed) -> float:
    """Return the commonest height of a flight, to a metre [m]."""
    heights, count = np.unique(np.round(observed.samples.position_m[:, 2]), return_counts=True)
    return float(heights[count.argmax()])


def sector_parts(scored: Observed, source: Observed) -> list[tuple[BoolArray, BoolArray]]:
    """Sectors of azimuth at the tower, with a guard."""

    def azimuth(o: Observed) -> FloatArray:
        return np.degrees(azimuth_rad(o.samples.at_tower))

    return _angular(azimuth(scored), azimuth(source), SECTORS, _GUARD_DEG)


def heading_parts(scored: Observed, source: Observed) -> list[tuple[BoolArray, BoolArray]]:
    """Eighths of the compass for the nose, with a guard."""
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


def route_parts(scored: Observed, source: Observed) -> list[tuple[BoolArray, BoolArray]]:
    """Stretches of the scored flight in time, with a guard; other flights count whole."""
    time = scored.samples.time_s
    # a little longer: the last sample lies in the last stretch
    edges = np.linspace(time.min(), time.max() + 1e-6, STRETCHES + 1)
    out = []
    for low, high in itertools.pairwise(edges):
        mine = (time >= low) & (time < high)
        if source.samples.flight == scored.samples.flight:
            source_time = source.samples.time_s
            outside = (source_time < low - GUARD_S) | (source_time >= high + GUARD_S)
        else:
            outside = np.ones(len(source.samples), np.bool_)
        out.append((mine, outside))
    return out


def world_frame(observed: Sequence[Observed]) -> list[Observed]:
    """Control: the UAV's term in the world's axes, where no antenna of it is fixed."""
    return [_with_uav(o, -o.samples.at_tower) for o in observed]


def wrong_way(observed: Sequence[Observed]) -> list[Observed]:
    """Control: headings taken with the wrong sign."""
    out = []
    for o in observed:
        body = o.samples.at_uav
        # the azimuth in the body is bearing less heading: this is bearing plus heading
        turned = 2.0 * azimuth_rad(-o.samples.at_tower) - azimuth_rad(body)
        across = np.hypot(body[:, 0], body[:, 1])
        out.append(_with_uav(o, np.stack([across * np.cos(turned), across * np.sin(turned), body[:, 2]], axis=1)))
    return out


def _with_uav(o: Observed, at_uav: FloatArray) -> Observed:
    return dataclasses.replace(o, samples=dataclasses.replace(o.samples, at_uav=at_uav))
