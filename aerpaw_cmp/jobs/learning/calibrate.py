"""The ``calibrate`` job: antennas as they hang, learned from several flights, scored on what was left out."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from ...common.counting import counted
from ...common.errors import InputError, UsageError
from ...common.provenance import union
from ...common.stages import PlannedStage, Stages
from ...common.units import FloatArray
from ...common.yamlfile import StrictModel, load_yaml
from ...compare.gains import direction_gain
from ...compare.gains.mount import GainOf
from ...compare.learning import calibration
from ...compare.learning.calibration import Learned, Observed, Recipe, Score
from ...compare.learning.correction import BIN_S
from ...compare.learning.learning_curve import CurvePoint, learning_curve
from ...flight.data import RATIOS, SNR, FlightData, RssSeries, load_data
from ...flight.gains.learned_gain import mean_gain_db, sphere_angles
from ...flight.gains.memory import flight_of, load_with_learned
from ...flight.observed import observed_series
from ...flight.settings import AntennaSettings, load_pattern
from ...flight.training import counted_once, flight_logs, marks_of
from ...propagation.field.baselines import two_ray_dbm
from ...report.calibration import sentences
from ...site.antenna.learned import LearnedLock, Source
from .calibrate_lock import learned_locks, lock_words

# Heights of roughness that are tried [m]; infinite is no ground ray.
_ROUGHNESS_M = (0.0, 0.005, 0.01, 0.02, 0.03, 0.05, 0.08, 0.12, 0.2, math.inf)


class PatternsSettings(StrictModel):
    """Measured patterns that the learned gain stands on; none: isotropic."""

    uav: AntennaSettings | None = None
    tower: AntennaSettings | None = None
    towers: dict[str, AntennaSettings] = Field(default_factory=dict)
    """By ``tower.channel``, where they differ."""


class CalibrationFile(StrictModel):
    """The whole calibration.yaml."""

    calibration: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.\-]*$")]
    flights: Annotated[list[str], Field(min_length=1)]
    patterns: PatternsSettings = PatternsSettings()
    source: Source = Source()
    """Title, DOI and licence of the flights' data, and their airframe: kept beside what a site remembers."""
    rank: bool = False
    """Also learn how the receiver decides its rank."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GroundFit:
    """Roughness of the ground: log likelihood against no ground ray, per height tried [m]; infinite: no such ray."""

    roughness_m: tuple[float, ...]
    log_likelihood: tuple[float, ...]

    @property
    def likely_m(self) -> tuple[float, float]:
        """Heights within 2 of the best log likelihood (some 95 %)."""
        # two standard deviations of a normal likelihood
        least = max(self.log_likelihood) - 2.0
        near = [r for r, v in zip(self.roughness_m, self.log_likelihood, strict=True) if v > least]
        return min(near), max(near)

    @property
    def used_m(self) -> float | None:
        """Height that a replay is to take: the most probable one, or None where no ground ray is as likely."""
        return None if math.isinf(self.likely_m[1]) else self.roughness_m[int(np.argmax(self.log_likelihood))]


@dataclass(frozen=True, slots=True, kw_only=True)
class Calibration:
    """All that a calibration found."""

    settings: CalibrationFile
    flights: tuple[FlightData, ...]
    observed: tuple[Observed, ...]
    learned: Learned
    scores: Mapping[str, tuple[Score, ...]]
    controls: Mapping[str, tuple[Score, ...]]
    ground: GroundFit
    curve: tuple[CurvePoint, ...]
    locks: Mapping[str, LearnedLock]
    """By antenna, of receivers that lose their lock."""
    warnings: tuple[str, ...]
    words: tuple[str, ...]

    @property
    def fit(self) -> direction_gain.GainFit:
        """The learned gain over direction: every ``fit.gain`` has one."""
        return self.learned.fit

    @property
    def pair_term(self) -> direction_gain.Term | None:
        """The term of the gain towards both ends at once; None if none was learned."""
        return next((term for term in self.fit.model.terms if term.frame == "pair"), None)

    @property
    def names(self) -> list[str]:
        """Names of the flights."""
        return [data.settings.flight.name for data in self.flights]

    def first_series(self, antenna: str) -> tuple[FlightData, RssSeries]:
        """The first flight with an antenna, and its series there."""
        return next((data, s) for data in self.flights for s in data.rss if f"{s.tower}.{s.channel}" == antenna)

    @property
    def trained_on(self) -> tuple[str, ...]:
        """SHA-256 of every log that was learned from."""
        return union(*map(flight_logs, self.flights))

    @property
    def marks(self) -> tuple[str, ...]:
        """Marks of their series."""
        return marks_of(self.flights)


def load_calibration(path: Path, further: Sequence[Path] = ()) -> CalibrationFile:
    """Read and check a calibration.yaml, or a flight file and ``further``; UsageError as of any settings file."""
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
    stages: Stages | None = None,
    score: Sequence[Path] = (),
) -> Calibration:
    """Learn from flights, score.

    Parameters
    ----------
    settings : CalibrationFile
    flights : sequence of FlightData
        As :func:`read_flights` gives them.
    folder, logs_root : Path
        Against which patterns resolve, and logs of ``score`` in place of their flight file's folder.
    stages : Stages, optional
    score : sequence of Path
        Further flight files, scored with all that was learned.

    Returns
    -------
    Calibration
        What was learned, its scores on flights left out, and the controls.

    Raises
    ------
    UsageError
        Settings that are wrong; flights that share no tower and channel.
    InputError
        Logs that cannot be read; flights without RSS.
    """
    stages = stages or Stages()
    observed, warnings = observe(flights)
    recipe = recipe_of(settings, observed, logs_root or folder)
    with stages("read"):
        further = [load_data(load_with_learned(path), path.parent, logs_root) for path in score]
    series = [o.samples for o in observed]
    rest = [("fit, ground, scores, curve", ", ".join(sorted({samples.antenna for samples in series})))]
    rest += [("score", counted(len(score), "flight"))] if score else []
    rest += [("rank", "of all flights")] if settings.rank else []
    stages.checked(lambda: [PlannedStage(*row) for row in rest])
    with stages("fit"):
        learned = calibration.learn(series, recipe)
    with stages("ground"):
        ground = _fit_ground(flights, observed, learned)
    fits: dict[str, Learned] = {}
    with stages("scores"):
        scores = _score_all(observed, recipe, stages, fits)
        stages.progress("scores: controls")
        controls = _controls_of(observed, recipe, scores["flight_left_out"])
        locks = learned_locks(observed, recipe, fits)
    with stages("curve"):
        curve = learning_curve(observed, recipe)
    warnings += _mount_warnings(learned)
    if further:
        with stages("score"):
            further_scores, remarks = _score_further(further, flights, learned, observed)
        scores, warnings = {**scores, "other_flights": further_scores}, list(dict.fromkeys([*warnings, *remarks]))
    return Calibration(
        settings=settings,
        flights=tuple(flights),
        observed=tuple(observed),
        learned=learned,
        scores=scores,
        controls=controls,
        ground=ground,
        curve=curve,
        locks=locks,
        warnings=tuple(warnings),
        words=(
            *sentences(scores, controls, ground.likely_m, curve),
            *map(lock_words, locks.values()),
        ),
    )


def _score_further(
    further: Sequence[FlightData],
    flights: Sequence[FlightData],
    learned: Learned,
    observed: Sequence[Observed],
) -> tuple[tuple[Score, ...], list[str]]:
    """Scores of further flights with what was learned, and which of them were learned from."""
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


def read_flights(settings: CalibrationFile, folder: Path, logs_root: Path | None) -> tuple[list[FlightData], list[str]]:
    """Every flight of the calibration, gathered, each log once, and what is to be said of copies."""
    places = [folder / name for name in settings.flights]
    out = [load_data(load_with_learned(path), path.parent, logs_root) for path in places]
    names = [data.settings.flight.name for data in out]
    for name in names:
        if names.count(name) > 1:
            raise UsageError(f"two flights are named {name!r}", expected="an own 'flight: {name: ...}' in each file")
    return counted_once(out)


def observe(flights: Sequence[FlightData]) -> tuple[list[Observed], list[str]]:
    """Samples of every series against free space, and what is to be said of them."""
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
        low, high = min(per_flight.values()), max(per_flight.values())
        if high > 1.02 * low:
            raise UsageError(
                f"{antenna} was received at {low / 1e9:g} and {high / 1e9:g} GHz",
                expected="one frequency per tower and channel: an antenna's gain is of its frequency",
                cause="flights of different experiments, or a wrong link.rss.carrier_hz",
            )
    lonely = [a for a, per_flight in carriers.items() if len(per_flight) == 1]
    if len(calibration.flights_of(observed)) > 1 and len(lonely) == len(carriers):
        raise UsageError(
            "the flights share no tower and channel: " + "; ".join(f"{a} in {next(iter(carriers[a]))}" for a in lonely),
            expected="at least one tower and channel that two flights have",
            cause="different 'node' or 'channel' beside the logs in the flight files",
        )
    if len(calibration.flights_of(observed)) < 2:
        warnings.append("one flight alone: nothing can be left out, nothing here is scored, and mounts are unstable")
    elif lonely:
        warnings.append(f"only one flight has {', '.join(lonely)}: learned, but not scored")
    return observed, warnings


def _observed_level(data: FlightData, series: RssSeries) -> tuple[Observed | None, list[str]]:
    """One series of levels at known poses; None for ratios and without any, and what is to be said of it."""
    name, remarks = f"{data.settings.flight.name}: {series.tower} {series.channel}", []
    if series.channel.lower() in RATIOS:
        if series.channel.lower() != SNR or any(s.channel.lower() not in RATIOS for s in data.rss):
            return None, [f"{data.settings.flight.name}: {series.channel} is a ratio, no level: left out"]
        remarks.append(
            f"{data.settings.flight.name}: {series.tower} {SNR} stands for a level: the noise is taken as constant"
        )
    observed, guessed, lost = observed_series(data, series)
    if not np.isfinite(observed.samples.residual_db).any():
        return None, [*remarks, f"{name} has no level at a known pose and is left out"]
    if guessed > 0.01:
        share = f"{100 * guessed:.0f} % of the attitudes at {series.tower} {series.channel} are unknown"
        remarks.append(f"{data.settings.flight.name}: {share}: heading from the track, level flight")
    if lost > 0.01:
        remarks.append(f"{name}: {100 * lost:.0f} % of the levels have no position and are left out")
    return observed, remarks


# --- what is learned -----------------------------------------------------------------------------------------------


def learned_antennas(train: Sequence[direction_gain.LinkSamples]) -> Learned:
    """Antennas of both ends from means over the bins of a correction, with the model's own strengths to start from."""
    return calibration.learn(train, Recipe(direction_gain.GainModel(bin_s=BIN_S)))


def recipe_of(settings: CalibrationFile, observed: Sequence[Observed], folder: Path) -> Recipe:
    """Terms and patterns as calibration.yaml asks."""
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
    return Recipe(direction_gain.GainModel(), patterns)


def gain_of(settings: AntennaSettings, folder: Path) -> GainOf:
    """Gain [dBi] of a pattern towards unit vectors (n, 3) of its device frame."""
    pattern = load_pattern(settings, folder)
    return lambda direction: mean_gain_db([pattern], *sphere_angles(direction))


def _fit_ground(flights: Sequence[FlightData], observed: Sequence[Observed], learned: Learned) -> GroundFit:
    """Likelihood of a coherent ground ray of each roughness, the gains integrated out."""
    by_name = {data.settings.flight.name: data for data in flights}
    by_series = {(o.samples.flight, o.samples.antenna): o for o in observed}

    def columns(samples: direction_gain.LinkSamples, bin_s: float) -> FloatArray:
        data = by_name[samples.flight]
        o = by_series[samples.flight, samples.antenna]
        link = next(s.link for s in data.rss if f"{s.tower}.{s.channel}" == samples.antenna)
        tower = data.site.towers[samples.tower]
        place = tower.position_m[None, :] if o.tower_m is None else o.tower_m[:, None, :]
        out = [samples.binned(bin_s).residual_db]
        for sigma in _ROUGHNESS_M:
            level = two_ray_dbm(
                place,
                samples.position_m,
                link.carrier_hz,
                link.transmit_power_dbm,
                ground_material=data.site.ground_material,
                ground_m=tower.ground_m,
                roughness_m=sigma,
            )[:, 0]
            ripple = np.where(np.isfinite(samples.residual_db), level - o.free_space_db, np.nan)
            out.append(dataclasses.replace(samples, residual_db=ripple).binned(bin_s).residual_db)
        stacked = np.stack(out, axis=1)
        return np.asarray(stacked - stacked.mean(axis=0))

    series = [o.samples for o in observed]
    unexplained = [dataclasses.replace(s, residual_db=s.residual_db - learned.patterns_db(s)) for s in series]
    form = direction_gain.column_forms(unexplained, learned.model, columns)
    value = np.diag(form)[1:] - 2.0 * form[0, 1:]
    likelihood = -0.5 * (value - value[-1])
    return GroundFit(roughness_m=_ROUGHNESS_M, log_likelihood=tuple(map(float, likelihood)))


# --- scores --------------------------------------------------------------------------------------------------------


def _score_all(
    observed: Sequence[Observed], recipe: Recipe, stages: Stages, fits: dict[str, Learned]
) -> dict[str, tuple[Score, ...]]:
    """Every split, on flights that had no part in the fit; fits of one are used by the next.

    Parameters
    ----------
    observed : sequence of Observed
    recipe : Recipe
    stages : Stages
    fits : dict of str to Learned
        Receives what was learned without each flight.

    Returns
    -------
    dict of str to tuple of Score
    """
    scores: dict[str, tuple[Score, ...]] = dict.fromkeys(calibration.SPLITS, ())
    if len(calibration.flights_of(observed)) < 2:
        return scores
    scores["flight_left_out"] = calibration.flight_left_out(observed, recipe, fits)
    for split, parts, own_rest in (
        ("altitude_left_out", calibration.altitude_parts, False),
        ("heading_left_out", calibration.heading_parts, False),
        ("sector_left_out", calibration.sector_parts, False),
        ("route_left_out", calibration.route_parts, True),
    ):
        stages.progress(f"scores: {split.replace('_', ' ')}")
        scores[split] = calibration.parts_left_out(observed, recipe, fits, parts, own_rest=own_rest)
    return scores


def _controls_of(
    observed: Sequence[Observed], recipe: Recipe, scores: tuple[Score, ...]
) -> dict[str, tuple[Score, ...]]:
    """Wrong frames of the UAV's gain beside its body's, each flight left out; ``scores`` are those of the recipe."""
    if len(calibration.flights_of(observed)) < 2:
        return {}
    left_out, bare = calibration.flight_left_out, dataclasses.replace(recipe, patterns={})
    return {
        "world frame at the UAV": left_out(calibration.world_frame(observed), bare),
        "heading turned the wrong way": left_out(calibration.wrong_way(observed), bare),
        "body frame, no patterns": left_out(observed, bare) if recipe.patterns else scores,
    }


def _mount_warnings(learned: Learned) -> list[str]:
    """A sentence for every mount that the data do not tell."""
    return [
        f"azimuth of {name} is not identified: {mount.azimuth_deg:.0f} deg is likeliest, with a standard deviation of "
        f"{mount.azimuth_sd_deg:.0f} deg"
        for name, mount in learned.mounts.items()
        if not mount.identified
    ]
