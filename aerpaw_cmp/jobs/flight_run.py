"""One flight from its data to its numbers: clocks, replay, comparison, audit. Every job about a flight starts here.

To add a stage, write a function of the results of earlier stages, add a field to :class:`FlightRun` or
:class:`~aerpaw_cmp.compare.result.FlightResult`, and two lines to :func:`run_flight`.

The model comparison finds antennas, attitude, ground, buildings and trees that fit the measurement. Its stages
(antennas, woods, ground, buildings, terrain) each add variants to the best model so far, by the RMSE on held-out
segments. Only the offset is fitted.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml

from ..common.errors import UsageError
from ..common.outputs import unsealed
from ..common.stages import PlannedStage, Stages
from ..common.text import counted
from ..common.units import FloatArray
from ..common.yamlfile import KeyPath, edited, parse_yaml
from ..compare.causes import OF_DIRECTION
from ..compare.ladder import CandidateModel, ModelComparison, compare_models, model_rows
from ..compare.result import BASELINE_TITLE, Cause, FlightResult
from ..compare.statistics import FEWEST, pooled_difference
from ..compare.verdict import is_one_place
from ..flight.data import FlightData, RssSeries, choose_site
from ..flight.drafting.proposals import errors_elsewhere, offered
from ..flight.gains import pair_db, path_loss, without_losses
from ..flight.replay import FlightReplay, Replayed, attitude_rotation, replay_flight, try_replay
from ..flight.settings import FlightFile, RssSettings
from ..flight.training import learned_here
from ..propagation.drivers import replay_moving
from ..propagation.field.sum import fields_of, mean_pair_power, rss_dbm
from ..propagation.geometry import Link, PathSet, Poses, single_element
from ..propagation.options import Field, Run, Search
from ..propagation.replay import Replay, replay
from ..site.antennas import Isotropic
from ..site.learned import SpherePattern
from ..site.site import Site
from ..site.siteyaml import known_grounds
from .audit_flight import audit_replays
from .compare_flight import Levels, compare_flight, fitted_receiver, levels_of

# Loss of the weakened ground reflection: a smooth half-space reflects more than any real ground.
_WEAK_GROUND_DB = 10.0

# Smallest reduction of the RMSE that is visible on a page [dB].
_SHOWN_DB = 0.1

# Largest number of samples per series. A longer series is thinned.
_MOST_SAMPLES = 4000

AS_SET = "as set in flight.yaml"
_FREE_SPACE = BASELINE_TITLE["free_space"]
# Models without a replay. To be useful, a replay must have a smaller error than these models.
LINES = BASELINE_TITLE["constant"], BASELINE_TITLE["log_distance"]

# Added to the name of a model that would be scored on its training data.
LEARNED_HERE = " (its antennas were learned on this flight, too: not scored)"

Antennas = Literal["isotropic", "measured", "learned"]
Ground = Literal["none", "coherent", "weakened", "power sum"]
Trees = Literal["none", "p833", "opaque"]
Relief = Literal["flat", "offsets", "surface"]

# Names for the ways of adding the ground reflection.
_GROUND_WORDS = {"coherent": "coherent", "weakened": "attenuated", "power sum": "incoherent"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Model:
    """One combination of the parts of a replay.

    Parameters
    ----------
    media : bool
        True if attenuating woods are media instead of single trees.
    relief : Relief
        Ground at the towers and below the paths, instead of the ground in the flight file.
    """

    antennas: Antennas = "isotropic"
    attitude: Literal["ignored", "level", "logged"] = "ignored"
    ground: Ground = "none"
    buildings: bool = False
    trees: Trees = "none"
    media: bool = False
    relief: Relief = "flat"

    @property
    def name(self) -> str:
        """The parts of the model as text."""
        parts = {
            "isotropic": [],
            "measured": ["antennas"],
            "learned": ["learned antennas"],
        }[self.antennas]
        parts += {"ignored": [], "level": ["heading"], "logged": ["attitude"]}[self.attitude]
        if self.ground != "none":
            parts.append(f"{_GROUND_WORDS[self.ground]} ground reflection")
        parts += ["buildings"] if self.buildings else []
        if self.trees != "none":
            woods = "woods as media" if self.media else "trees"
            parts.append("opaque trees" if self.trees == "opaque" else f"{woods} ({self.trees})")
        parts += [] if self.relief == "flat" else [f"ground heights ({self.relief})"]
        return _FREE_SPACE if not parts else " + ".join(parts)

    def settings(self, max_depth: int) -> dict[str, dict[str, Any]]:
        """Return the keys of flight.yaml for this model. ``max_depth`` is the value in the flight file."""
        depth = 0 if self.ground == "none" else max(max_depth, 1) if self.buildings else 1
        rt: dict[str, Any] = {
            "max_depth": depth,
            "attitude": self.attitude,
            "reflection_loss_db": _WEAK_GROUND_DB if self.ground == "weakened" else 0.0,
            "foliage": "none" if self.trees == "none" else "opaque" if self.trees == "opaque" else "attenuating",
        }
        return {
            "rt": rt,
            "rss": {"field": "power" if self.ground == "power sum" else "coherent"},
            "site": {
                "without_buildings": not self.buildings,
                **({} if self.relief == "flat" else {"tower_ground": self.relief}),
            },
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightComparison:
    """The scored models, in the order of ``scores.candidates``. The model None has the settings of the flight file.

    Parameters
    ----------
    offered : mapping of str to str
        Names of learned antennas of the site that fit the flight and that the flight file does not use.
    """

    scores: ModelComparison
    models: tuple[Model | None, ...]
    names: tuple[tuple[str, str], ...]
    offered: Mapping[str, str] = field(default_factory=dict)

    @property
    def recommended(self) -> Model | None:
        """The recommended model. None if it is the model of the flight file, or if no model is recommended."""
        chosen = self.scores.recommended
        return None if chosen is None else self.models[chosen]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Series:
    """One thinned series: indices ``rows`` (m,) of its samples, and indices ``picked`` (m,) of their replayed poses."""

    replayed: Replayed
    levels: Levels
    rows: Any
    picked: Any
    step: int
    time_s: FloatArray


def flight_comparison(data: FlightData, replays: FlightReplay) -> FlightComparison | None:
    """Compare models. None for a flight without RSS, or with another engine than the image method."""
    if not data.rss or data.settings.rt.engine != "image":
        return None
    return _ModelSearch(data, [_sampled(data.rss, i, r, data.settings.rss) for i, r in enumerate(replays.rss)]).search()


def _sampled(rss: Sequence[RssSeries], index: int, replayed: Replayed, rules: RssSettings) -> _Series:
    levels = levels_of(rss[index], replayed, rules)
    comparable = np.flatnonzero(levels.posed & np.isfinite(levels.measured_db))
    step = max(1, -(-len(comparable) // _MOST_SAMPLES))
    rows = comparable[::step]
    pose_of = np.cumsum(replayed.valid) - 1
    seconds = (rss[index].time - rss[0].time[:1]) / np.timedelta64(1, "s")
    return _Series(replayed=replayed, levels=levels, rows=rows, picked=pose_of[rows], step=step, time_s=seconds[rows])


class _ModelSearch:
    """The evaluation of models on the series of a flight. Each set of paths is searched only once."""

    def __init__(self, data: FlightData, series: Sequence[_Series]) -> None:
        self._data, self._series = data, series
        self._measured = [s.levels.measured_db[s.rows] for s in series]
        self._traced: dict[tuple[Any, ...], tuple[Replay, float]] = {}
        self._lost: dict[tuple[int, Model], tuple[Replay, PathSet, FloatArray | None, float]] = {}
        patterns = [p for s in series for a in _arrays(s.replayed.link) for p in a.patterns]
        self._offer = offered(data) if all(p.name == "iso" for p in patterns) else None
        links = [s.replayed.link for s in series]
        if (offer := self._offer) is not None:
            links = [offer.link.of(s.channel).build([s.tower], data.folder) for s in data.rss]
        self._links = links
        ways = [
            (link.carrier_hz, self._sources(s, data.site).tobytes(), self._poses(s, "ignored").position_m.tobytes())
            for link, s in zip(self._links, series, strict=True)
        ]
        self._like = [ways.index(way) for way in ways]  # for each series, the first series with the same paths

    def search(self) -> FlightComparison:
        """Run all stages."""
        candidates = self._lines()
        models: list[Model | None] = [None] * len(candidates)
        best = Model()
        # try woods before reflections: their loss is larger than the effect of a reflection and would hide it
        for stage in (self._antennas, self._trees, self._ground, self._buildings, self._relief):
            for model in stage(best):
                if model not in models:
                    models.append(model)
                    candidates.append(self._candidate(model))
            scored = self._scored(candidates)
            if scored.best_replay is not None:
                best = models[scored.best_replay] or best
        models.append(None)
        candidates.append(self._as_set())
        names = tuple((s.tower, s.channel) for s in self._data.rss)
        comparison = FlightComparison(
            scores=self._scored(candidates),
            models=tuple(models),
            names=names,
            offered={} if self._offer is None else self._offer.antennas,
        )
        return self._better_than_set(self._by_flights_left_out(comparison), comparison)

    def _better_than_set(self, *comparisons: FlightComparison) -> FlightComparison:
        """Return the first comparison whose recommended model is significantly better than the settings of the flight.

        Otherwise these settings are recommended, or no model if the flight is a training flight without a score.
        """
        better = (each for each in comparisons if self._is_better(each.scores) and not self._contradicts(each))
        scores, last = comparisons[-1].scores, len(comparisons[-1].scores.candidates) - 1
        if scores.recommended is not None:
            scored = math.isfinite(scores.rmse_db[last])
            scores = dataclasses.replace(scores, recommended=last if scored else None)
        return next(better, dataclasses.replace(comparisons[-1], scores=scores))

    def _contradicts(self, comparison: FlightComparison) -> bool:
        """Check whether a model ignores the attitude with which its learned antennas were learned.

        The training flights of the antennas are stronger evidence than a part of one flight: on a third of a flight, a
        model without attitude was 0.4 dB better, and on the complete flight 2.1 dB worse.
        """
        chosen = comparison.scores.recommended
        model = None if chosen is None else comparison.models[chosen]
        tracks = [s.replayed.track for s in self._series]
        known = any(t is not None and bool(t.attitude_known.any()) for t in tracks)
        return model is not None and known and (model.antennas, model.attitude) == ("learned", "ignored")

    def _is_better(self, scores: ModelComparison) -> bool:
        """Check that a recommended model is better than the flight's settings and than a constant, over all series.

        The test against a constant is needed, because at a single position every model is only an offset, and the
        flattest model has the smallest error.
        """
        if scores.recommended is None:
            return False
        chosen = scores.error_db[scores.recommended]
        # Both tests must pass, so no correction for two tests is needed. If one gain is not real, its test passes in at
        # most 2.5 % of the flights, and so do both tests (intersection-union, Berger 1982, doi 10.2307/1267823).
        for other in (scores.error_db[0], scores.error_db[-1]):
            columns = [(s.time_s, a, b) for s, a, b in zip(self._series, chosen, other, strict=True)]
            pair = pooled_difference(columns, free_offset=False, place_m=scores.position_m)
            if pair.verdict != "better" or pair.difference_db > -_SHOWN_DB:
                return False
        return True

    def _by_flights_left_out(self, comparison: FlightComparison) -> FlightComparison:
        """Recommend the learned model as calibrated, if it has a smaller error than free space on held-out flights."""
        antennas = (self._offer or self._data.settings).learned
        errors = [errors_elsewhere(antennas, series)[0] for series in self._data.rss]
        known = [error for error in errors if error is not None]
        if len(known) < len(errors) or not known:
            return comparison
        learned, free = (
            float(np.sqrt(np.mean([getattr(e, key) ** 2 for e in known]))) for key in ("rmse_db", "free_space_rmse_db")
        )
        for attitude in ("logged", "level"):
            model = Model(antennas="learned", attitude=attitude)
            at = comparison.models.index(model) if model in comparison.models else None
            if at is not None and np.isfinite(comparison.scores.rmse_db[at]) and learned < free:
                scores = dataclasses.replace(comparison.scores, recommended=at, elsewhere_db=(learned, free))
                return dataclasses.replace(comparison, scores=scores)
        return comparison

    def _scored(self, candidates: Sequence[CandidateModel]) -> ModelComparison:
        return compare_models(
            self._measured,
            [s.time_s for s in self._series],
            candidates,
            [s.replayed.poses.position_m[s.picked] for s in self._series],
        )

    # the stages, which add parts to the best model so far

    def _antennas(self, _best: Model) -> list[Model]:
        patterns = [p for link in self._links for a in _arrays(link) for p in a.patterns]
        models = [Model()]
        if all(p.name == "iso" for p in patterns):
            return models
        kind: Antennas = "learned" if any(isinstance(p, SpherePattern) for p in patterns) else "measured"
        models.append(Model(antennas=kind))
        tracks = [s.replayed.track for s in self._series]
        if all(t is not None for t in tracks):
            known = np.concatenate([t.attitude_known for t in tracks if t is not None])
            models.append(Model(antennas=kind, attitude="level"))
            if known.any():
                models.append(Model(antennas=kind, attitude="logged"))
        return models

    def _ground(self, best: Model) -> list[Model]:
        kinds: tuple[Ground, ...] = ("power sum", "weakened", "coherent")
        return [dataclasses.replace(best, ground=kind) for kind in kinds]

    def _buildings(self, best: Model) -> list[Model]:
        return [dataclasses.replace(best, buildings=True)] if self._data.site.buildings else []

    def _trees(self, best: Model) -> list[Model]:
        if not self._data.site.wooded:
            return []
        kinds: tuple[Trees, ...] = ("p833", "opaque")
        media = any(forest.height_m is not None for forest in self._data.site.forests)
        return [dataclasses.replace(best, trees=kind, media=media and kind != "opaque") for kind in kinds]

    def _relief(self, best: Model) -> list[Model]:
        return [dataclasses.replace(best, relief=kind) for kind in self._reliefs]

    @cached_property
    def _reliefs(self) -> dict[Relief, Site]:
        """The site with each other ground model of its file, if the flight has flat ground and no additional node."""
        data, flat = self._data, self._data.site
        if flat.dem or flat.scene or data.settings.towers or any(t.ground_m for t in flat.towers.values()):
            return {}
        kinds = known_grounds(data.site_place)
        chosen: dict[Relief, Site] = {}
        for kind in ("offsets", "surface"):
            if kind in kinds:
                choice = data.settings.site.model_copy(update={"tower_ground": kind, "file": str(data.site_place)})
                chosen[kind] = choose_site(choice, data.folder)
        return chosen

    def _site(self, relief: Relief) -> Site:
        return self._data.site if relief == "flat" else self._reliefs[relief]

    # levels

    def _lines(self) -> list[CandidateModel]:
        zeros = tuple(np.zeros(len(s.rows)) for s in self._series)
        ray_m = tuple(s.replayed.poses.position_m[s.picked] - self._sources(s, self._data.site) for s in self._series)
        # avoid the logarithm of 0 at the position of the antenna
        range_db = tuple(10.0 * np.log10(np.maximum(np.linalg.norm(a, axis=1), 0.1)) for a in ray_m)
        return [
            CandidateModel(model=name, level_db=zeros, seconds=0.0, regressor_db=x)
            for name, x in zip(LINES, (zeros, range_db), strict=True)
        ]

    def _as_set(self) -> CandidateModel:
        levels = tuple(s.levels.simulated_db[s.rows] for s in self._series)
        seconds = self._of_flight([s.replayed.replay.seconds for s in self._series])
        if self._learned_here and self._offer is None:
            nothing = tuple(np.full(len(level), np.nan) for level in levels)
            return CandidateModel(model=AS_SET + LEARNED_HERE, level_db=nothing, seconds=seconds)
        return CandidateModel(model=AS_SET, level_db=levels, seconds=seconds)

    def _of_flight(self, seconds: Sequence[float]) -> float:
        """Return the seconds for a flight. Channels with a common replay are counted once."""
        shared: dict[tuple[str, str], float] = {}
        for series, cost_s in zip(self._data.rss, seconds, strict=True):
            key = series.tower, series.settings_key
            shared[key] = max(cost_s, shared.get(key, 0.0))
        return sum(shared.values())

    @cached_property
    def _learned_here(self) -> bool:
        """True if antennas or settings of the flight file were learned from a log of this flight."""
        pairs = zip(self._data.rss, self._links, strict=True)
        return any(learned_here(self._data, series, link) for series, link in pairs)

    def _candidate(self, model: Model) -> CandidateModel:
        if model.antennas == "learned" and self._learned_here:
            nothing = tuple(np.full(len(s.rows), np.nan) for s in self._series)
            return CandidateModel(model=model.name + LEARNED_HERE, level_db=nothing, seconds=0.0)
        levels = [self._level(i, model) for i in range(len(self._series))]
        return CandidateModel(
            model=model.name, level_db=tuple(f[0] for f in levels), seconds=self._of_flight([f[1] for f in levels])
        )

    def _level(self, index: int, model: Model) -> tuple[FloatArray, float]:
        """Return the level (m,) [dBm] at the thinned samples of a series, and the seconds for all samples."""
        series, link, site = self._series[index], self._links[index], self._site(model.relief)
        if model.antennas == "isotropic":
            link = _isotropic_link(link)
        traced, paths, loss_db, search_s = self._paths(index, model)
        begin = time.perf_counter()
        poses, sources = self._poses(series, model.attitude), self._sources(series, site)
        field = fields_of(paths, traced.faces, traced.ends.sources_m, poses, link, loss_db)
        power = field.power if model.ground == "power sum" else mean_pair_power(field.h)
        level = rss_dbm(power, link.transmit_power_dbm)[:, 0] + pair_db(link, poses, sources)
        return level, series.step * (search_s + time.perf_counter() - begin)

    def _paths(self, index: int, model: Model) -> tuple[Replay, PathSet, FloatArray | None, float]:
        """Return the replay, its paths for a model, the losses of these paths [dB], and the computing time [s]."""
        # antennas and attitude do not change paths and losses
        key = self._like[index], dataclasses.replace(model, antennas="isotropic", attitude="ignored")
        if key not in self._lost:
            traced, search_s = self._traced_for(index, model)
            begin = time.perf_counter()
            rt, site = self._data.settings.rt, self._site(model.relief)
            paths = traced.paths if model.ground != "none" else traced.paths.select(traced.paths.depth == 0)
            changed = rt.model_copy(update=without_losses() | model.settings(rt.max_depth)["rt"])
            field, ends = Field(path_loss(site, changed, self._links[index].carrier_hz)), traced.ends
            loss_db = field.loss_db(paths, ends.sources_m, ends.poses.position_m)
            self._lost[key] = traced, paths, loss_db, search_s + time.perf_counter() - begin
        return self._lost[key]

    def _traced_for(self, index: int, model: Model) -> tuple[Replay, float]:
        """Return the replay between single elements, and its computing time [s]."""
        direct = model.relief != "flat" and model.ground == "none"  # the search of reflections off terrain is slow
        key = self._like[index], model.buildings, model.relief, direct
        if key not in self._traced:
            begin = time.perf_counter()
            series, tower, site = self._series[index], self._data.rss[index].tower, self._site(model.relief)
            site = site if model.buildings else dataclasses.replace(site, buildings=())
            depth = max(self._data.settings.rt.max_depth, 1) if model.buildings else 1
            search = Search(max_depth=0 if direct else depth)
            link = Link(self._links[index].carrier_hz, {tower: single_element()}, single_element())
            poses, sources = self._poses(series, "ignored"), self._sources(series, site)
            if series.replayed.tower_m is not None:
                replayed = replay_moving(site, link, poses, sources, search)
            else:
                replayed = replay(site, link, poses, search, run=Run(cache_dir=""))
            self._traced[key] = replayed, time.perf_counter() - begin
        return self._traced[key]

    def _sources(self, series: _Series, site: Site) -> FloatArray:
        """Return the position of the tower: (1, 3), or (m, 3) at the thinned samples of a moving tower."""
        places = series.replayed.source_m(site)
        return places if series.replayed.tower_m is None else places[series.picked]

    def _poses(self, series: _Series, attitude: str) -> Poses:
        poses, track = series.replayed.poses, series.replayed.track
        turn = poses.rotation if track is None else attitude_rotation(track, attitude)
        return Poses(poses.position_m[series.picked], np.ascontiguousarray(turn[series.picked]))


def _arrays(link: Link) -> list[Any]:
    return [*link.tower_arrays.values(), link.uav_array]


def _isotropic_link(link: Link) -> Link:
    """Return the link with isotropic antenna elements."""

    def other(array: Any) -> Any:
        return dataclasses.replace(array, patterns=tuple(Isotropic() for _ in array.patterns))

    towers = {name: other(array) for name, array in link.tower_arrays.items()}
    return dataclasses.replace(link, tower_arrays=towers, uav_array=other(link.uav_array))


def recommended_changes(
    settings: FlightFile, stated: Mapping[str, Any], model: Model, offered: Mapping[str, str] | None = None
) -> dict[KeyPath, Any]:
    """Return the keys of a flight file that a model changes, by path. A value of None means that the key is removed.

    Parameters
    ----------
    settings : FlightFile
        Settings of the flight, including defaults.
    stated : mapping
        Plain values of the keys in the file.
    model : Model
        See :attr:`FlightComparison.recommended`.
    offered : mapping of str to str, optional
        Learned antennas of the site by name, for a learned model.

    Returns
    -------
    dict
    """
    current = settings.model_dump(mode="json")
    changes: dict[KeyPath, Any] = {
        (section, key): value
        for section, wanted in model.settings(settings.rt.max_depth).items()
        for key, value in wanted.items()
        if current[section].get(key) != value
    }
    rt = stated.get("rt") or {}
    # no model includes diffraction, because it was not the best model on any of 28 real series
    changes |= {("rt", "diffraction"): None} if "diffraction" in rt else {}
    if isinstance(stated.get("site"), str):
        of_site = {key: changes.pop(("site", key)) for section, key in list(changes) if section == "site"}
        if of_site:
            changes["site",] = {"file": stated["site"], **of_site}
    if offered and model.antennas == "learned":
        changes["antennas",] = dict(offered)
    if model.antennas == "isotropic":
        changes |= {("antennas",): None} if "antennas" in stated else {}
        link = stated.get("link") or {}
        changes |= _isotropic({key: link[key] for key in ("rss", "channels") if key in link}, ("link",))
    return changes


def _isotropic(content: Mapping[str, Any], path: KeyPath) -> dict[KeyPath, Any]:
    """Return the changed keys with which all antennas below a key of a link are isotropic."""
    iso, changes = {"model": "iso"}, dict[KeyPath, Any]()
    for key, value in content.items():
        if key in ("antenna", "antennas"):
            new = [iso for _ in value] if isinstance(value, list) else iso
            changes |= {} if new == value else {(*path, key): new}
        elif isinstance(value, Mapping):
            changes |= _isotropic(value, (*path, key))
    return changes


def check_recommended(data: FlightData) -> None:
    """Refuse to recommend a model for a flight without RSS, or with another engine than the image method."""
    if not data.rss or data.settings.rt.engine != "image":
        raise _NOT_RECOMMENDED


_NOT_RECOMMENDED = UsageError(
    "no model can be recommended for this flight",
    expected=f"{FEWEST} samples of RSS with known poses, replayed by the image engine (rt.engine: image)",
)


def recommended_text(settings: FlightFile, comparison: FlightComparison | None, flight: Path) -> tuple[str, str]:
    """Return the flight file with the lines changed as the recommended model requires, and a sentence about them.

    Raises
    ------
    UsageError
        If no models were compared, because there are too few samples of RSS, or the engine is not the image method.
    """
    if comparison is None or comparison.scores.recommended is None:
        raise _NOT_RECOMMENDED
    # read bytes, so that line ends are not changed
    text = unsealed(flight.read_bytes().decode("utf-8"))
    if comparison.recommended is None:
        return text, f"No model is significantly better than {flight.name}: the recommended file is a copy of it."
    text = edited(text, recommended_changes(settings, yaml.safe_load(text), comparison.recommended, comparison.offered))
    parse_yaml(text, FlightFile)  # the reader must accept the written file
    return text, f"The recommended file has the settings of the model '{comparison.recommended.name}'."


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightRun:
    """The results of one flight.

    Parameters
    ----------
    data : FlightData
        Settings, site, logs, track, series.
    replays : FlightReplay
        Poses, paths, fields and clock of every series.
    result : FlightResult
        Numbers of the comparison.
    ladder : FlightComparison, optional
        Model comparison.
    """

    data: FlightData
    replays: FlightReplay
    result: FlightResult
    ladder: FlightComparison | None = None


def run_flight(
    data: FlightData,
    stages: Stages | None = None,
    *,
    replays: FlightReplay | None = None,
    audit: bool = True,
    fresh: bool = False,
    ladder: bool = False,
) -> FlightRun:
    """Run clocks, replay, comparison, audit and model comparison.

    Parameters
    ----------
    data : FlightData
    stages : Stages, optional
        Times "clocks", "replay", "compare", "audit" and "models".
    replays : FlightReplay, optional
        Existing replays of this flight (:func:`~aerpaw_cmp.flight.replay.replay_flight`).
    audit : bool
        Also fill ``result.engine``, with an audit by the other engine if ``rt.audit_links`` is above 0.
    fresh : bool
        Ignore the cached audit.
    ladder : bool
        Also score simpler and richer models of the RSS on held-out segments.

    Returns
    -------
    FlightRun
        Replays, numbers of the comparison, and the model comparison if requested.
    """
    stages = stages or Stages()
    replays = replays or replay_flight(data, stages)
    with stages("compare"):
        result = compare_flight(data, replays)
    if audit:
        with stages("audit"):
            result = dataclasses.replace(result, engine=audit_replays(data, replays.all, stages.progress, fresh=fresh))
    comparison: FlightComparison | None = None
    if ladder:
        with stages("models"):
            stages.progress("model comparison")
            comparison = flight_comparison(data, replays)
            if comparison is not None:
                pooled, each = model_rows(comparison.scores, comparison.names)
                result = dataclasses.replace(result, models=pooled, ladder=each)
    result = dataclasses.replace(result, likely_cause=cause_beyond_models(result.likely_cause, comparison))
    result = dataclasses.replace(result, next_step=next_step(data, result, comparison))
    return FlightRun(data=data, replays=replays, result=result, ladder=comparison)


def report_stages(data: FlightData, figures: str) -> list[PlannedStage]:
    """Return the stages of a report for its dry run. ``figures`` is the value of ``--figures``.

    One pose of every series is replayed and the receiver is read, so that errors of the run appear in the dry run.
    """
    try_replay(data)
    for series in data.rank:
        fitted_receiver(data, series.tower)
    n_rss, n_rank = (sum(len(item.time) for item in series) for series in (data.rss, data.rank))
    samples, rt = f"{counted(n_rss, 'RSS sample')}, {counted(n_rank, 'rank sample')}", data.settings.rt
    audited = min(rt.audit_links, n_rss + n_rank)
    drawn = 0 if figures == "none" else len(data.rss) + len(data.rank)
    clocked = bool(n_rss) and data.settings.rss.lag in ("estimate", "apply")
    stages = {
        "clocks": counted(len({series.tower for series in data.rss}), "receiver") if clocked else "",
        "replay": f"{samples}, engine {rt.engine}",
        "compare": samples,
        "audit": f"{counted(audited, 'link')} by the other engine" if audited else "",
        "models": "simpler and richer models" if n_rss and rt.engine == "image" else "",
        "report": f"page, figures of {counted(drawn, 'channel')}",
    }
    return [PlannedStage(name, work) for name, work in stages.items() if work]


def cause_beyond_models(cause: Cause | None, comparison: FlightComparison | None) -> Cause | None:
    """Return the likely cause, or None if it depends on direction and the recommended model explains as much."""
    if cause is None or cause.name not in OF_DIRECTION or comparison is None or comparison.recommended is None:
        return cause
    at, rmse_db = comparison.scores.recommended, comparison.scores.rmse_db
    assert at is not None
    return None if rmse_db[-1] - rmse_db[at] >= cause.rmse_db - cause.rmse_with_db else cause


def next_step(data: FlightData, result: FlightResult, comparison: FlightComparison | None) -> str | None:
    """Return the next step: a wider offset search, a calibration, the step for the likely cause, or a better model.

    Parameters
    ----------
    data : FlightData
    result : FlightResult
    comparison : FlightComparison, optional

    Returns
    -------
    str or None
        The next step as a clause, by default the next step of the comparison.
    """
    beyond = [panel for panel in result.rss if panel.score.at_edge and not panel.further.trained_on]
    if beyond:
        # the offset is added to the measurement. Extend the range by 10 dB more, so that the new optimum is not at an
        # edge.
        missing = [float(np.nanmedian(panel.simulated_dbm - panel.measured_db)) for panel in beyond]
        low, high = data.settings.rss.span_db
        ends = (
            min(low, *(10 * math.floor(m / 10) - 10 for m in missing)),
            max(high, *(10 * math.ceil(m / 10) + 10 for m in missing)),
        )
        return f"`rss: {{span_db: [{ends[0]:.0f}, {ends[1]:.0f}]}}`"
    if any(panel.further.trained_on for panel in result.rss or result.rank):
        # only a calibration file asks for a receiver of ranks
        learned = any(panel.further.trained_on for panel in result.rank)
        words = "CALIBRATION` with `rank: true` and" if learned else "FLIGHT FLIGHT` with"
        return f"`aerpaw-cmp calibrate {words} other flights, then `aerpaw-cmp report FLIGHT --with CALIBRATED`"
    if result.likely_cause is not None:
        return result.likely_cause.next_step or None
    if is_one_place(result.rss):
        return "a flight along a route"
    if comparison is not None and comparison.recommended is not None:
        return "`aerpaw-cmp report FLIGHT --recommend FILE` writes settings significantly better than these"
    return result.next_step
