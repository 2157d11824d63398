"""The ``calibrate`` job, which learns mounted antennas from several flights and scores them on held-out flights.

It also learns when a receiver is in lock, from levels that are predicted from other flights.
"""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field, model_validator

from ..common.content import union
from ..common.errors import InputError, UsageError
from ..common.gaussian import determining
from ..common.grouping import lists_by_key
from ..common.stages import PlannedStage, Stages
from ..common.text import counted
from ..common.yamlfile import StrictModel, load_yaml
from ..compare import calibration, gains
from ..compare.calibration import BIN_S, Learned, Observed, Recipe, Score, flights_of, groups_of, learn
from ..compare.gains import FlightEvidence, GainOf, GainProcess
from ..compare.health import HeldOut, learned_health
from ..compare.level import DetectionScore, learn_detection, score_detection
from ..flight.data import RATIOS, SNR, FlightData, RssSeries, load_data
from ..flight.gains import flight_of, load_with_learned, mean_gain_db, sphere_angles
from ..flight.replay import observed_series
from ..flight.rows import LOCK_FLOOR_DB
from ..flight.settings import AntennaSettings, load_pattern
from ..flight.training import counted_once, flight_logs, marks_of
from ..report.calibration import sentences
from ..site.learned import AIRFRAME_BAND, DirectionCovariance, LearnedHealth, LearnedLock, Source


def learned_locks(observed: Sequence[Observed], recipe: Recipe, fits: Mapping[str, Learned]) -> dict[str, LearnedLock]:
    """Return a model of P(lock) and its held-out scores for each antenna. Levels are predicted from other flights.

    Parameters
    ----------
    observed : sequence of Observed
        Samples of all flights.
    recipe : Recipe
    fits : mapping of str to Learned
        Gains learned without each flight.

    Returns
    -------
    dict of str to LearnedLock
        Models by antenna. Receivers that keep their lock have no model. With fewer than three flights there are no
        models, because they could not be scored.
    """
    able = [o for o in observed if o.locked is not None and np.isfinite(o.locked).any()]
    if len(flights_of(able)) < 3:
        return {}
    pairs = _without_pairs(observed, recipe)
    series = lists_by_key((o.samples.antenna, o) for o in able)
    locks = {antenna: _learned(each, fits, pairs) for antenna, each in series.items()}
    return {antenna: lock for antenna, lock in locks.items() if lock is not None}


def learned_healths(observed: Sequence[Observed], fits: Mapping[str, Learned]) -> dict[str, LearnedHealth]:
    """Return the usual errors of held-out flights, by antenna (``tower.channel``).

    Parameters
    ----------
    observed : sequence of Observed
        Series of all flights.
    fits : mapping of str to Learned
        Antennas learned without each flight.
    """
    held: dict[tuple[str, str], HeldOut] = {}
    for o in observed:
        s, learned = o.samples, fits.get(o.samples.flight)
        if learned is not None and s.antenna in learned.fit.antennas and np.isfinite(s.residual_db).any():
            held[s.antenna, s.flight] = HeldOut(
                time_s=s.time_s,
                place_m=s.position_m,
                measured_db=s.residual_db + o.free_space_db,
                predicted_db=o.free_space_db + learned.mean(s),
                floor_db=-math.inf if o.locked is None else LOCK_FLOOR_DB,
                locked=o.locked,
            )
    offsets = {key: float(np.nanmean(h.measured_db - h.predicted_db)) for key, h in held.items()}
    out = {}
    for antenna in dict.fromkeys(antenna for antenna, _ in held):
        tower = antenna.partition(".")[0]
        flights = [flight for of, flight in held if of == antenna]
        others = {of.partition(".")[2]: of for of, _ in held if of != antenna and of.partition(".")[0] == tower}
        differences = {
            name: [offsets[antenna, f] - offsets[other, f] for f in flights if (other, f) in offsets]
            for name, other in others.items()
        }
        out[antenna] = learned_health([held[antenna, flight] for flight in flights], differences)
    return out


def _without_pairs(observed: Sequence[Observed], recipe: Recipe) -> dict[tuple[str, str], Learned]:
    """Return gains learned without each pair of flights, by pair.

    P(lock) of one flight is predicted by a fit to all other flights. The levels of each of these other flights are
    predicted from all flights except these two.
    """
    out: dict[tuple[str, str], Learned] = {}
    for one, other in combinations(groups_of(flights_of(observed)), 2):
        learned = learn([o.samples for o in observed if o.samples.flight not in (*one, *other)], recipe)
        out |= {pair: learned for a in one for b in other for pair in ((a, b), (b, a))}
    return out


class _Levels:
    """Predicted path gain and received level [dB] of one series, at samples whose lock state is known."""

    def __init__(self, o: Observed, learned: Learned) -> None:
        assert o.locked is not None
        level = o.free_space_db - o.sent_dbm + learned.mean(o.samples)
        at = np.isfinite(level) & np.isfinite(o.locked)
        self.time_s, self.level_db = o.samples.time_s[at], level[at]
        self.free_db = o.free_space_db[at]
        self.measured_db = o.samples.residual_db[at] + self.free_db
        self.detected = o.locked[at] == 1.0


def _learned(
    series: Sequence[Observed], fits: Mapping[str, Learned], pairs: Mapping[tuple[str, str], Learned]
) -> LearnedLock | None:
    """Learn P(lock) from all flights, and score each flight with a fit to all other flights."""
    flights = [_Levels(o, fits[o.samples.flight]) for o in series]
    every = learn_detection([(f.level_db, f.detected) for f in flights])
    scores: list[DetectionScore] = []
    for o, item in zip(series, flights, strict=True):
        known = [(other, pairs.get((o.samples.flight, other.samples.flight))) for other in series]
        others = [_Levels(other, learned) for other, learned in known if learned is not None]
        from_others = learn_detection([(f.level_db, f.detected) for f in others])
        score = None if from_others is None else score_detection(
            item.time_s, item.measured_db, item.level_db, item.detected, floor_db=LOCK_FLOOR_DB,
            free_space_db=item.free_db, forecast=from_others,
        )  # fmt: skip
        if score is not None:
            scores.append(score)
    if every is None or not scores:
        return None

    names = ("brier", "constant_brier", "log_score", "constant_log_score", "rmse_db", "free_space_rmse_db")
    mean = {name: round(float(np.mean([getattr(score, name) for score in scores])), 4) for name in names}
    return LearnedLock(
        gain_db=round(every.level_db, 2),
        per_db=round(every.per_db, 4),
        share=round(every.share, 3),
        **_two_parts(flights, every.level_db),
        flights=len(scores),
        floor_db=LOCK_FLOOR_DB,
        floor_rmse_db=mean.pop("rmse_db"),
        free_space_floor_rmse_db=mean.pop("free_space_rmse_db"),
        **mean,
    )


# Smallest SD [dB], because some receivers always write the same level without lock.
_LEAST_SD_DB = 0.5

# Width of the central 90 % of a normal distribution in standard deviations.
_CENTRAL = 3.29


def _two_parts(flights: Sequence[_Levels], gain_db: float) -> dict[str, float]:
    """Fit lines to the level over path gain, with and without lock. Return levels, slope and standard deviations."""
    numbers: dict[str, float] = {}
    for name, in_lock in (("locked", True), ("lost", False)):
        parts = [f.detected == in_lock for f in flights]
        each = [(f.level_db[at] - gain_db, f.measured_db[at]) for f, at in zip(flights, parts, strict=True) if at.any()]
        gain, level = (np.concatenate(values) for values in zip(*each, strict=True))
        alike = np.concatenate([np.full(len(g), len(g) ** -0.5) for g, _ in each])  # equal weights of the flights
        slope, middle = np.polyfit(gain, level, 1, w=alike)
        # use the central 90 %, because rare deep fades in lock would make a 90 % band too wide
        central = np.mean([np.ptp(np.quantile(m - slope * g, (0.05, 0.95))) for g, m in each]) / _CENTRAL
        sd = central if in_lock else (level - middle - slope * gain).std()
        numbers |= {f"{name}_db": middle, f"{name}_per_db": slope, f"{name}_sd_db": max(sd, _LEAST_SD_DB)}
    return {name: round(float(value), 3) for name, value in numbers.items()}


def lock_words(lock: LearnedLock) -> str:
    """Return sentences about the scores of P(lock) and of levels with a floor on held-out flights."""
    return (
        f"The predicted level forecasts lock with a Brier score of {lock.brier:.3f} on held-out flights "
        f"(constant share of each flight: {lock.constant_brier:.3f}), log score {lock.log_score:.3f} "
        f"({lock.constant_log_score:.3f}). Where levels below {lock.floor_db:g} dB re full scale count as "
        f"{lock.floor_db:g}, the RMSE is {lock.floor_rmse_db:.1f} dB; free space: "
        f"{lock.free_space_floor_rmse_db:.1f} dB."
    )


class PatternsSettings(StrictModel):
    """The measured patterns to which the learned gain is added. They are isotropic by default.

    Parameters
    ----------
    towers : mapping of str to AntennaSettings
        Patterns by ``tower.channel``, for antennas with a different pattern.
    """

    uav: AntennaSettings | None = None
    tower: AntennaSettings | None = None
    towers: dict[str, AntennaSettings] = Field(default_factory=dict)


_Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.\-]*$")]


class CampaignSettings(StrictModel):
    """The flights of a campaign, with a common error model. Campaigns with the same airframe share the UAV's gain."""

    flights: Annotated[list[str], Field(min_length=1)]
    source: Source = Source()


class CalibrationFile(StrictModel):
    """The content of a calibration.yaml.

    Parameters
    ----------
    flights : list of str
        All flights, including those of ``campaigns``.
    campaigns : mapping of str to CampaignSettings
        Campaigns by name, if antennas are learned from several campaigns together. Each campaign becomes an entry of
        the site.
    source : Source
        Title, DOI and licence of the data, and the airframe. They are stored with the learned models of a site.
    rank : bool
        True to also learn how the receiver decides its rank.
    """

    calibration: _Name
    flights: Annotated[list[str], Field(min_length=1)]
    campaigns: dict[_Name, CampaignSettings] = Field(default_factory=dict)
    patterns: PatternsSettings = PatternsSettings()
    source: Source = Source()
    rank: bool = False

    @model_validator(mode="before")
    @classmethod
    def _flights_of_campaigns(cls, data: Any) -> Any:
        campaigns = data.get("campaigns") if isinstance(data, dict) else None
        if not isinstance(campaigns, dict) or "flights" in data:
            return data
        each = [campaign.get("flights") for campaign in campaigns.values() if isinstance(campaign, dict)]
        return {**data, "flights": [name for some in each if isinstance(some, list) for name in some]}

    def by_campaign(self) -> dict[str, CampaignSettings]:
        """Return the campaigns. If there are none, return a single campaign with the name of the calibration."""
        return self.campaigns or {self.calibration: CampaignSettings(flights=self.flights, source=self.source)}


@dataclass(frozen=True, slots=True, kw_only=True)
class Calibration:
    """The result of a calibration.

    Parameters
    ----------
    campaigns : mapping of str to str
        Campaign of each flight, by the name of the flight.
    locks : mapping of str to LearnedLock
        Lock models by antenna, for receivers that lose their lock.
    health : mapping of str to LearnedHealth
        Usual errors of held-out flights, by antenna.
    teaching : set of str
        Campaigns whose UAV gain is supported by most of their held-out flights. Only these gains may be used for other
        campaigns.
    """

    settings: CalibrationFile
    flights: tuple[FlightData, ...]
    campaigns: Mapping[str, str]
    observed: tuple[Observed, ...]
    learned: Learned
    scores: Mapping[str, tuple[Score, ...]]
    controls: Mapping[str, tuple[Score, ...]]
    locks: Mapping[str, LearnedLock]
    health: Mapping[str, LearnedHealth]
    teaching: frozenset[str]
    warnings: tuple[str, ...]
    words: tuple[str, ...]

    @property
    def fit(self) -> gains.GainFit:
        """The learned gain over direction."""
        return self.learned.fit

    @property
    def pair_term(self) -> gains.Term | None:
        """The term of the joint gain of both ends. None if it was not learned."""
        return next((term for term in self.fit.model.terms if term.frame == "pair"), None)

    @property
    def names(self) -> list[str]:
        """Names of the flights."""
        return [data.settings.flight.name for data in self.flights]

    def first_series(self, antenna: str) -> tuple[FlightData, RssSeries]:
        """Return the first flight with an antenna, and its series."""
        return next((data, s) for data in self.flights for s in data.rss if f"{s.tower}.{s.channel}" == antenna)

    @property
    def trained_on(self) -> tuple[str, ...]:
        """SHA-256 of every training log."""
        return union(*map(flight_logs, self.flights))

    @property
    def marks(self) -> tuple[str, ...]:
        """Fingerprints of the training series."""
        return marks_of(self.flights)


def load_calibration(path: Path, further: Sequence[Path] = ()) -> CalibrationFile:
    """Read and check a calibration.yaml, or create its content from a flight file and the flight files ``further``."""
    if (flight := flight_of(path)) is None:
        settings = load_yaml(path, CalibrationFile)
    else:
        settings = CalibrationFile(calibration=flight.flight.name, flights=[str(path.resolve())])
    settings = settings.model_copy(update={"flights": [*settings.flights, *(str(f.resolve()) for f in further)]})
    if len(set(settings.flights)) != len(settings.flights):
        raise UsageError(
            "a flight is named twice", expected="each flight once: its copy would be scored on itself", path=path
        )
    return settings


def calibrate(
    settings: CalibrationFile,
    flights: Sequence[FlightData],
    folder: Path,
    logs_root: Path | None = None,
    *,
    campaigns: Mapping[str, str] | None = None,
    stages: Stages | None = None,
    score: Sequence[Path] = (),
) -> Calibration:
    """Learn antennas from flights and score them.

    Parameters
    ----------
    settings : CalibrationFile
    flights : sequence of FlightData
        Flights, as returned by :func:`read_flights`.
    folder, logs_root : Path
        Folder for relative paths of patterns, and folder of the logs of ``score`` (by default, the folder of each
        flight file).
    campaigns : mapping of str to str, optional
        Campaign of each flight, from :func:`read_flights`. By default, all flights are one campaign.
    stages : Stages, optional
    score : sequence of Path
        Additional flight files, which are only scored with the learned antennas.

    Returns
    -------
    Calibration
        Learned antennas, their scores on held-out flights, and scores of control experiments.

    Raises
    ------
    UsageError
        If settings are wrong, or the flights share no tower and channel.
    InputError
        If logs cannot be read, or the flights have no RSS.
    """
    stages = stages or Stages()
    campaigns = campaigns or dict.fromkeys((f.settings.flight.name for f in flights), settings.calibration)
    observed, warnings = observe(flights)
    warnings += _unscored(observed)
    observed = in_campaigns(settings, observed, flights, campaigns)
    recipe = recipe_of(settings, observed, logs_root or folder)
    with stages("read"):
        further = [load_data(load_with_learned(path), path.parent, logs_root) for path in score]
    series = [o.samples for o in observed]
    rest = [("fit, scores", ", ".join(sorted({samples.antenna for samples in series})))]
    rest += [("score", counted(len(score), "flight"))] if score else []
    rest += [("rank", "of all flights")] if settings.rank else []
    stages.checked(lambda: [PlannedStage(*row) for row in rest])
    with stages("fit"):
        learned = calibration.learn(series, recipe)
    fits: dict[str, Learned] = {}
    with stages("scores"):
        scores = _score_all(observed, recipe, stages, fits)
        controls = _controls_of(observed, recipe, scores["flight_left_out"])
        stages.progress("scores", 1.0)
        locks, health = learned_locks(observed, recipe, fits), learned_healths(observed, fits)
        taught = teaching(observed, campaigns, fits)
    warnings += [*_mount_warnings(learned), *_contradictions(scores["campaign_left_out"], controls, campaigns)]
    if further:
        with stages("score"):
            further_scores, remarks = _score_further(further, flights, learned, observed)
        scores, warnings = {**scores, "other_flights": further_scores}, list(dict.fromkeys([*warnings, *remarks]))
    return Calibration(
        settings=settings,
        flights=tuple(flights),
        campaigns=campaigns,
        observed=tuple(observed),
        learned=learned,
        scores=scores,
        controls=controls,
        locks=locks,
        health=health,
        teaching=taught,
        warnings=tuple(warnings),
        words=(*sentences(scores, controls), *map(lock_words, locks.values())),
    )


def _score_further(
    further: Sequence[FlightData], flights: Sequence[FlightData], learned: Learned, observed: Sequence[Observed]
) -> tuple[tuple[Score, ...], list[str]]:
    """Score additional flights with the learned antennas, and return remarks about training flights."""
    distinct, remarks = counted_once([*flights, *further])
    fresh = [data for data in distinct if not any(data is item for item in flights)]
    if not fresh:
        return (), remarks
    measured = [series for data in fresh for series in observe([data])[0]]
    known = {o.samples.antenna for o in observed}
    remarks += [
        f"{o.samples.flight}: nothing was learned about {o.samples.antenna}"
        for o in measured
        if o.samples.antenna not in known
    ]
    return calibration.score_with(learned, [o for o in measured if o.samples.antenna in known], observed), remarks


# --- flights -------------------------------------------------------------------------------------------------------


def read_flights(
    settings: CalibrationFile, folder: Path, logs_root: Path | None
) -> tuple[list[FlightData], list[str], dict[str, str]]:
    """Return all flights of a calibration (each log once), remarks about copies, and the campaign of each flight."""
    places = [folder / name for name in settings.flights]
    out = [load_data(load_with_learned(path), path.parent, logs_root) for path in places]
    names = [data.settings.flight.name for data in out]
    for name in names:
        if names.count(name) > 1:
            raise UsageError(f"two flights are named {name!r}", expected="another 'flight: {name: ...}' in each file")
    of = {file: name for name, campaign in settings.by_campaign().items() for file in campaign.flights}
    campaigns = {name: of.get(file, settings.calibration) for name, file in zip(names, settings.flights, strict=True)}
    return *counted_once(out), campaigns


def in_campaigns(
    settings: CalibrationFile, observed: Sequence[Observed], flights: Sequence[FlightData], campaigns: Mapping[str, str]
) -> list[Observed]:
    """Return samples with their campaign, airframe and band filled in, if there are several campaigns.

    Airframes of the same name share their gain within a band. A band extends 7 % above its lowest carrier.

    Parameters
    ----------
    settings : CalibrationFile
    observed : sequence of Observed
    flights : sequence of FlightData
        The flights of the samples.
    campaigns : mapping of str to str
        Campaign by flight.

    Returns
    -------
    list of Observed
        The unchanged samples if there is only one campaign.
    """
    of = settings.by_campaign()
    if len(of) < 2:
        return list(observed)
    carriers = {
        (data.settings.flight.name, f"{s.tower}.{s.channel}"): s.link.carrier_hz for data in flights for s in data.rss
    }
    bands: list[float] = []
    for carrier in sorted(carriers.values()):
        if not bands or carrier > bands[-1] * (1.0 + AIRFRAME_BAND):
            bands.append(carrier)

    def placed(o: Observed) -> Observed:
        s = o.samples
        campaign, carrier = campaigns[s.flight], carriers[s.flight, s.antenna]
        band = max(low for low in bands if low <= carrier)
        source = of[campaign].source.airframe if campaign in of else settings.source.airframe
        # an airframe without a name belongs only to its campaign
        airframe = campaign if source == Source().airframe else source
        samples = dataclasses.replace(s, campaign=campaign, airframe=f"{airframe}, {band / 1e9:g} GHz")
        return dataclasses.replace(o, samples=samples)

    return [placed(o) for o in observed]


def observe(flights: Sequence[FlightData]) -> tuple[list[Observed], list[str]]:
    """Return the samples of every series relative to free space, and remarks about series that are omitted."""
    observed: list[Observed] = []
    warnings: list[str] = []
    carriers: dict[str, dict[str, float]] = {}
    for data, series in [(flight, entry) for flight in flights for entry in flight.rss]:
        level, remarks = _observed_level(data, series)
        warnings += remarks
        if level is not None:
            carriers.setdefault(level.samples.antenna, {})[data.settings.flight.name] = series.link.carrier_hz
            observed.append(level)
    if not observed:
        raise InputError("none of the flights has RSS at known poses", expected="RSS logs with telemetry")
    for antenna, per_flight in carriers.items():
        low, high = (of(per_flight, key=per_flight.__getitem__) for of in (min, max))
        if per_flight[high] > 1.02 * per_flight[low]:
            at = " and ".join(f"{per_flight[name] / 1e9:g} GHz ({name})" for name in (low, high))
            raise UsageError(
                f"{antenna} was received at {at}",
                expected="one frequency per tower and channel, because antenna gain depends on frequency",
                cause="flights of different experiments, or a wrong link.rss.carrier_hz",
            )
    lonely = [a for a, per_flight in carriers.items() if len(per_flight) == 1]
    if len(calibration.flights_of(observed)) > 1 and len(lonely) == len(carriers):
        raise UsageError(
            "the flights share no tower and channel: " + "; ".join(f"{a} in {next(iter(carriers[a]))}" for a in lonely),
            expected="at least one tower and channel that two flights have",
            cause="different 'node' or 'channel' of the logs in the flight files",
        )
    return observed, warnings


def _unscored(observed: Sequence[Observed]) -> list[str]:
    """Return a remark about channels of towers that cannot be scored, because only one flight has them."""
    flights = calibration.flights_of(observed)
    if len(flights) < 2:
        return ["only one flight: no flight can be held out, so nothing is scored, and mount angles are unreliable"]
    heard = {(o.samples.antenna, o.samples.flight) for o in observed}
    count = Counter(antenna for antenna, _ in heard)
    lonely = [antenna for antenna in dict.fromkeys(o.samples.antenna for o in observed) if count[antenna] == 1]
    return [f"only one flight has {', '.join(lonely)}: learned, but not scored"] if lonely else []


def _observed_level(data: FlightData, series: RssSeries) -> tuple[Observed | None, list[str]]:
    """Return the samples of one series at known poses, and remarks. None for ratios, and if no pose is known."""
    name, remarks = f"{data.settings.flight.name}: {series.tower} {series.channel}", []
    if series.channel.lower() in RATIOS:
        if series.channel.lower() != SNR or any(s.channel.lower() not in RATIOS for s in data.rss):
            return None, [f"{data.settings.flight.name}: {series.channel} is a ratio, not a level: ignored"]
        remarks.append(
            f"{data.settings.flight.name}: {series.tower} {SNR} is used as a level; the noise is assumed to be constant"
        )
    observed, guessed, lost = observed_series(data, series)
    if not np.isfinite(observed.samples.residual_db).any():
        return None, [*remarks, f"{name} has no level at a known pose and is ignored"]
    if guessed > 0.01:
        share = f"{100 * guessed:.0f} % of the attitudes at {series.tower} {series.channel} are unknown"
        remarks.append(f"{data.settings.flight.name}: {share}: heading from the track, level flight")
    if lost > 0.01:
        remarks.append(f"{name}: {100 * lost:.0f} % of the levels have no position and are ignored")
    return observed, remarks


# --- learning ------------------------------------------------------------------------------------------------------


def learned_antennas(train: Sequence[gains.LinkSamples]) -> Learned:
    """Learn the antennas of both ends, starting from the default strengths of the model."""
    return calibration.learn(train, Recipe(gains.GainModel(bin_s=BIN_S)))


def recipe_of(settings: CalibrationFile, observed: Sequence[Observed], folder: Path) -> Recipe:
    """Return the terms and patterns that a calibration.yaml specifies."""
    patterns: dict[str, GainOf] = {}
    if settings.patterns.uav is not None:
        patterns["uav"] = gain_of(settings.patterns.uav, folder)
    antennas = list(dict.fromkeys(o.samples.antenna for o in observed))
    if unknown := sorted(settings.patterns.towers.keys() - set(antennas)):
        raise UsageError(
            f"patterns.towers.{unknown[0]}: the flights have no such tower and channel",
            expected="one of " + ", ".join(antennas),
        )
    for antenna in antennas:
        chosen = settings.patterns.towers.get(antenna, settings.patterns.tower)
        if chosen is not None:
            patterns[antenna] = gain_of(chosen, folder)
    return Recipe(gains.GainModel(), patterns)


def gain_of(settings: AntennaSettings, folder: Path) -> GainOf:
    """Return a function for the gain [dBi] of a pattern towards unit vectors (n, 3) in its device frame."""
    pattern = load_pattern(settings, folder)
    return lambda direction: mean_gain_db([pattern], *sphere_angles(direction))


# --- scores --------------------------------------------------------------------------------------------------------


def _score_all(
    observed: Sequence[Observed], recipe: Recipe, stages: Stages, fits: dict[str, Learned]
) -> dict[str, tuple[Score, ...]]:
    """Score every split (flight, height, heading, sector) on samples that were not fitted. Splits share their fits.

    Parameters
    ----------
    observed : sequence of Observed
    recipe : Recipe
    stages : Stages
    fits : dict of str to Learned
        Receives the gains that were learned with each flight left out.

    Returns
    -------
    dict of str to tuple of Score
    """
    scores: dict[str, tuple[Score, ...]] = dict.fromkeys(calibration.SPLITS, ())
    if len(calibration.flights_of(observed)) < 2:
        return scores
    # the controls take about as long as two splits
    shares = (done / (len(scores) + 2) for done in range(len(scores) + 1))
    stages.progress("scores", next(shares))
    scores["flight_left_out"] = calibration.flight_left_out(observed, recipe, fits)
    for name, parts in (
        ("altitude", calibration.altitude_parts),
        ("heading", calibration.heading_parts),
        ("sector", calibration.sector_parts),
    ):
        stages.progress("scores", next(shares))
        scores[f"{name}_left_out"] = calibration.parts_left_out(observed, recipe, fits, parts)
    stages.progress("scores", next(shares))
    scores["campaign_left_out"] = calibration.campaign_left_out(observed, recipe)
    stages.progress("scores", next(shares))
    return scores


def _controls_of(
    observed: Sequence[Observed], recipe: Recipe, scores: tuple[Score, ...]
) -> dict[str, tuple[Score, ...]]:
    """Score the UAV's gain in wrong frames on held-out flights, as controls.

    ``scores`` are the scores in the body frame.
    """
    if len(calibration.flights_of(observed)) < 2:
        return {}
    left_out, bare = calibration.flight_left_out, dataclasses.replace(recipe, patterns={})
    turns = (90.0, 180.0, 270.0) if len({o.samples.campaign for o in observed}) > 1 else ()
    turned = {
        f"another campaign's airframe, rotated by {turn:.0f} deg": calibration.campaign_left_out(observed, bare, turn)
        for turn in turns
    }
    return turned | {
        "world frame at the UAV": left_out(calibration.world_frame(observed), bare),
        "heading turned the wrong way": left_out(calibration.wrong_way(observed), bare),
        "body frame, no patterns": left_out(observed, bare) if recipe.patterns else scores,
    }


# Share of the variance of a gain that the stored directions may miss, and the largest number of these directions.
_KNOWN_SHARE, _MOST_KNOWN = 0.002, 100
_LENGTHS: Mapping[gains.Frame, float] = {term.frame: term.length for term in gains.ANTENNA_TERMS}


def direction_covariance(fit: gains.GainFit, antenna: str, frame: gains.Frame = "body") -> DirectionCovariance:
    """Return the directions at one end that determine its gain, and the covariance of the gain in these directions.

    With 60, 100 or 200 directions, the evidence for an airframe differs by at most 3 nat.
    """
    from scipy.spatial.distance import cdist

    flown, length = fit.seen(frame, antenna), _LENGTHS[frame]
    at = flown[determining(flown, lambda a, b: np.exp(-cdist(a, b) / length), _KNOWN_SHARE, _MOST_KNOWN)]
    return DirectionCovariance(directions=at, covariance_db2=fit.covariance(frame, antenna, at))


def teaching(observed: Sequence[Observed], campaigns: Mapping[str, str], fits: Mapping[str, Learned]) -> frozenset[str]:
    """Return the campaigns in which more than half of the held-out flights support the learned gain of the UAV."""
    passed: dict[str, list[bool]] = {}
    for flight, learned in fits.items():
        series = [o.samples for o in observed if o.samples.flight == flight]
        antenna = next((s.antenna for s in series if s.antenna in learned.fit.antennas), None)
        if antenna is None:  # no antenna of this flight is known from other flights
            continue
        process = _airframe(learned, antenna)
        passed.setdefault(campaigns[flight], []).append(FlightEvidence(series).of_airframe(process).fits)
    return frozenset(name for name, each in passed.items() if 2 * sum(each) > len(each))


def _contradictions(
    scores: Sequence[Score], controls: Mapping[str, Sequence[Score]], campaigns: Mapping[str, str]
) -> list[str]:
    """Return a sentence per campaign for which other campaigns' airframe is worse than free space or a control."""
    out = []
    for name in dict.fromkeys(campaigns[s.flight] for s in scores):

        def mean(some: Sequence[Score], key: str = "rmse_db", name: str = name) -> float:
            return calibration.mean_rmse([s for s in some if campaigns[s.flight] == name], key)

        alone, free = mean(scores), mean(scores, "free_space_rmse_db")
        turned = min((mean(some) for title, some in controls.items() if "rotated" in title), default=math.inf)
        if alone > min(free, turned):
            out.append(
                f"{name} contradicts the other campaigns: RMSE {alone:.2f} dB with their airframe, {turned:.2f} dB with"
                f" this airframe rotated, {free:.2f} dB in free space; give it a separate 'source: {{airframe: ...}}'"
            )
    return out


def _airframe(learned: Learned, antenna: str) -> GainProcess:
    """Return the learned gain of the UAV towards a tower's antenna, with its covariance."""
    known = direction_covariance(learned.fit, antenna)
    return GainProcess(
        gain_db=lambda at: learned.fit.gain("body", antenna, at)[0],
        sd_db=lambda at: learned.fit.gain("body", antenna, at)[1],
        directions=known.directions,
        covariance_db2=known.covariance_db2,
    )


def _mount_warnings(learned: Learned) -> list[str]:
    """Return one sentence per mount that the data do not determine."""
    return [
        f"azimuth of {name} is not identified: {mount.azimuth_deg:.0f} deg is most likely, with an SD of "
        f"{mount.azimuth_sd_deg:.0f} deg"
        for name, mount in learned.mounts.items()
        if not mount.identified
    ]
