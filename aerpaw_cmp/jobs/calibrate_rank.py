"""The part of ``calibrate`` that learns how a modem decides its rank, and scores the result on held-out flights.

The channel model contains only the direct path and one ray reflected by flat ground at height 0. At a rural site, the
orientation of the antenna ports and the strength of the ground ray affect the rank more than walls do.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..common.content import KEY, MARKS, union
from ..common.errors import InputError, UsageError, parsing
from ..common.grouping import lists_by_key
from ..common.jsonable import json_safe
from ..common.units import FloatArray, IntArray
from ..compare import receiver
from ..compare.level import seconds
from ..compare.receiver import ForecastScore, constant_forecast, score_forecast
from ..flight.data import FlightData, RankSeries
from ..flight.replay import rank_poses
from ..flight.training import among, logs_of, series_mark
from ..propagation.drivers import Geometry, every_geometry, singular_values_of
from ..propagation.geometry import Link, Poses
from ..site.learned import read_table

# First key of a receiver file.
FORMAT = "aerpaw-cmp receiver 1"

# Candidate slants of the four ports of a modem.
_SLANTS_DEG: tuple[tuple[float, ...], ...] = (
    (45.0, -45.0, 45.0, -45.0), (45.0, -45.0, -45.0, 45.0), (45.0, 45.0, -45.0, -45.0),
    (-45.0, 45.0, -45.0, 45.0), (-45.0, 45.0, 45.0, -45.0), (-45.0, -45.0, 45.0, 45.0),
    (0.0, 90.0, 0.0, 90.0), (0.0, 90.0, 90.0, 0.0), (0.0, 0.0, 90.0, 90.0),
    (90.0, 0.0, 90.0, 0.0), (90.0, 0.0, 0.0, 90.0), (90.0, 90.0, 0.0, 0.0),
    (0.0, 0.0, 0.0, 0.0), (90.0, 90.0, 90.0, 90.0),
)  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class RankGrid:
    """The geometries and timings that are tried.

    Parameters
    ----------
    yaw_step_deg : float
        Step between the tried mounts of the modem's array.
    uav_slant_deg : tuple of tuple of float
        Slants of the modem's ports.
    ground : tuple of float
        Amplitude factors of the ground reflection.
    members : int
        Largest number of indistinguishable geometries whose forecasts are averaged.
    thin : int
        Only every n-th sample is used to choose the geometry. The fit uses all samples.
    shift_s, average_s : tuple of float
        Candidate delays of a report behind the logged position, and candidate averaging times of the modelled channel.
    """

    yaw_step_deg: float = 30.0
    uav_slant_deg: tuple[tuple[float, ...], ...] = _SLANTS_DEG
    ground: tuple[float, ...] = (0.0, 0.2, 0.5, 1.0)
    members: int = 20
    thin: int = 4
    shift_s: tuple[float, ...] = (0.0, 2.0, 4.0, 6.0)
    average_s: tuple[float, ...] = (0.0, 8.0, 16.0, 24.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class RankSamples:
    """The reports of one flight at one tower with known positions. ``rank`` (n,) is NaN without CSI.

    Parameters
    ----------
    logs : tuple of str
        SHA-256 of the logs with the reports.
    mark : str
        Fingerprint of these reports, which does not depend on the file of the log.
    """

    flight: str
    tower: str
    tower_m: FloatArray
    poses: Poses
    rank: FloatArray
    link: Link
    time_s: FloatArray
    logs: tuple[str, ...] = ()
    mark: str = ""

    def part(self, rows: Any) -> RankSamples:
        """Return the selected samples."""
        return dataclasses.replace(self, poses=self.poses[rows], rank=self.rank[rows], time_s=self.time_s[rows])


@dataclass(frozen=True, slots=True, kw_only=True)
class Timing:
    """The delay and averaging time of reports; see :func:`~aerpaw_cmp.compare.receiver.time_means`."""

    shift_s: float = 0.0
    average_s: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class FittedReceiver:
    """A receiver at one tower: its indistinguishable geometries, best first, and their mean forecast.

    Parameters
    ----------
    flights : tuple of str
        Names of the training flights.
    trained_on : tuple of str
        SHA-256 of the training logs. The receiver must not be scored on them.
    marks : tuple of str
        Fingerprints of the training reports.
    """

    tower: str
    geometries: tuple[Geometry, ...]
    tied: int
    flights: tuple[str, ...]
    trained_on: tuple[str, ...] = ()
    marks: tuple[str, ...] = ()
    mixture: receiver.ReceiverMixture
    timing: Timing = Timing()

    def knows(self, samples: RankSamples) -> bool:
        """Check whether the receiver was fitted to these reports, by the digest of their log or their fingerprint."""
        return not set(self.trained_on).isdisjoint(samples.logs) or among(samples.mark, self.marks)

    def forecast(self, samples: RankSamples, turns_deg: Sequence[float] = (0.0,)) -> tuple[FloatArray, IntArray]:
        """Return the probability of each rank (n, 4), averaged over headings of the UAV, and the decided rank (n,)."""
        turned = [
            dataclasses.replace(g, uav_yaw_deg=(g.uav_yaw_deg - turn) % 360.0)  # rotated mounts may be equal to others
            for turn in turns_deg
            for g in self.geometries
        ]
        features = np.split(features_of(turned, samples, self.timing), len(turns_deg))
        p = np.mean([self.mixture.probabilities(some) for some in features], axis=0)
        return p, self.mixture.decide(p)

    def as_dict(self) -> dict[str, Any]:
        """Return the content of the receiver file."""
        return {
            "geometries": [dataclasses.asdict(g) for g in self.geometries],
            "tied": self.tied,
            "flights": list(self.flights),
            KEY: list(self.trained_on),
            MARKS: list(self.marks),
            "members": json_safe(self.mixture.members),
            "decision_weight": self.mixture.decision_weight.tolist(),
            "shift_s": self.timing.shift_s,
            "average_s": self.timing.average_s,
        }

    @classmethod
    def from_dict(cls, tower: str, content: Mapping[str, Any]) -> FittedReceiver:
        """Return the receiver with the content of :meth:`as_dict`."""
        return cls(
            tower=tower,
            geometries=tuple(_geometry(g) for g in content["geometries"]),
            tied=int(content["tied"]),
            flights=tuple(str(name) for name in content["flights"]),
            trained_on=tuple(str(digest) for digest in content[KEY]),
            marks=tuple(str(mark) for mark in content[MARKS]),
            mixture=receiver.ReceiverMixture(
                members=tuple(receiver.Receiver.from_dict(m) for m in content["members"]),
                decision_weight=np.asarray(content["decision_weight"], dtype=np.float64),
            ),
            timing=Timing(shift_s=float(content["shift_s"]), average_s=float(content["average_s"])),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class RankCalibration:
    """Receivers by tower, fitted on all flights, and their scores by split as (flight, tower, score)."""

    receivers: Mapping[str, FittedReceiver]
    scores: Mapping[str, tuple[tuple[str, str, ForecastScore], ...]]
    warnings: tuple[str, ...]

    def metrics(self) -> dict[str, list[dict[str, Any]]]:
        """Return the entry ``rank`` of ``calibrate --json``."""
        return {
            split: [{"flight": flight, "tower": tower, **json_safe(score)} for flight, tower, score in rows]
            for split, rows in self.scores.items()
        }

    def text(self) -> str:
        """Return the text of the receiver file."""
        towers = {name: fitted.as_dict() for name, fitted in self.receivers.items()}
        return json.dumps({"format": FORMAT, "towers": towers}, indent=1) + "\n"


def read_receiver(path: Path) -> dict[str, FittedReceiver]:
    """Read the receivers in a file of ``calibrate``, by tower.

    Raises
    ------
    InputError
        If the file is not a receiver file.
    """
    with parsing(path, f"a file of format {FORMAT!r}", "a file of another kind", any_shape=True):
        content = json.loads(read_table(path, "a receiver file"))
        if content["format"] != FORMAT:
            raise ValueError(f"format {content['format']!r}")
        return {tower: FittedReceiver.from_dict(tower, entry) for tower, entry in content["towers"].items()}


def _geometry(values: Mapping[str, Any]) -> Geometry:
    slants = {name: tuple(values[name]) for name in ("tower_slant_deg", "uav_slant_deg")}
    return Geometry(**{**values, **slants})


def rank_samples(data: FlightData, series: RankSeries) -> RankSamples:
    """Return the reports above ``rank.minimum_height_m`` at known positions."""
    poses, known, _ = rank_poses(data, series)
    low = data.settings.rank.minimum_height_m
    high = np.full(len(poses), True) if low is None else poses.position_m[:, 2] >= low
    keep, link = np.flatnonzero(known)[high], data.link_of(series)
    ports = {len(link.uav_array), len(link.tower_arrays[series.tower])}
    if series.tower in data.nodes:
        raise UsageError(
            f"rank of {series.tower} in {data.settings.flight.name}, a mobile node",
            expected="a fixed tower: geometries of the modem are fitted as seen from one position",
        )
    if ports != {4}:
        raise UsageError(
            f"link.rank of {data.settings.flight.name} has arrays of {sorted(ports)} ports",
            expected="four at both ends: the slants and ranks of a four-port modem are fitted",
        )
    return RankSamples(
        flight=data.settings.flight.name,
        tower=series.tower,
        tower_m=np.asarray(data.site.towers[series.tower].position_m),
        poses=poses[high],
        rank=series.rank[keep],
        link=link,
        time_s=seconds(series.time[keep]),
        logs=logs_of(data, series),
        mark=series_mark(series),
    )


def _powers_of(geometries: Sequence[Geometry], samples: RankSamples) -> FloatArray:
    """Return the squared singular values of the modelled channels, shape (geometries, n, 4)."""
    order = sorted(
        range(len(geometries)), key=lambda i: geometries[i].mount_deg
    )  # sorted, so that geometries with the same mount are neighbours
    singular = singular_values_of(
        [geometries[i] for i in order], samples.link.tower_arrays[samples.tower], samples.tower_m,
        samples.link.uav_array, samples.poses, samples.link.carrier_hz,
    )  # fmt: skip
    by_place = {i: sigma**2 for i, sigma in zip(order, singular, strict=True)}
    return np.stack([by_place[i] for i in range(len(geometries))])


def features_of(geometries: Sequence[Geometry], samples: RankSamples, timing: Timing | None = None) -> FloatArray:
    """Return the features of the modelled channels, shape (geometries, n, 4)."""
    return _features(_powers_of(geometries, samples), samples, timing or Timing())


def _features(power: FloatArray, samples: RankSamples, timing: Timing) -> FloatArray:
    return receiver.stream_features(
        np.sqrt(receiver.time_means(power, samples.time_s, timing.shift_s, timing.average_s))
    )


def candidates(grid: RankGrid, samples: RankSamples) -> tuple[Geometry, ...]:
    """Return the geometries to try: upright, rolled by 90 deg, and lying flat. The first two repeat after 180 deg."""
    half, full = (np.arange(0.0, end, grid.yaw_step_deg) for end in (180.0, 360.0))
    mounts = [(float(y), 0.0, r) for r in (0.0, 90.0) for y in half] + [(float(y), 90.0, 0.0) for y in full]
    tower = tuple(np.degrees(samples.link.tower_arrays[samples.tower].slant_rad).round(9).tolist())
    return every_geometry(mounts, [tower], grid.uav_slant_deg, grid.ground)


def samples_by_tower(flights: Sequence[FlightData]) -> dict[str, list[RankSamples]]:
    """Return the reports of all flights by tower. Raise InputError if there are none."""
    towers = lists_by_key((series.tower, rank_samples(data, series)) for data in flights for series in data.rank)
    if not towers:
        raise InputError("none of the flights has rank", expected="rank logs", cause="'rank:' in calibration.yaml")
    return towers


def fit_rank(towers: Mapping[str, Sequence[RankSamples]]) -> RankCalibration:
    """Fit one receiver per tower, and score it on held-out flights. Raise InputError if there are too few reports."""
    receivers, warnings = {}, []
    scores: dict[str, list[tuple[str, str, ForecastScore]]] = {"flight_left_out": [], "sector_left_out": []}
    for tower, samples in towers.items():
        tried = Tried.of(samples)
        receivers[tower] = tried.fit(range(len(samples)))
        if len(samples) < 2:
            warnings.append(f"rank at {tower}: only one flight: no flight can be held out, so nothing is scored")
            continue
        for held_out, test in enumerate(samples):
            train = [i for i in range(len(samples)) if i != held_out]
            fitted, constant = tried.fit(train), constant_forecast(np.concatenate([samples[i].rank for i in train]))
            p, decided = fitted.forecast(test)
            scores["flight_left_out"].append((test.flight, tower, score_forecast(test.rank, p, decided, constant)))
            scores["sector_left_out"].append((test.flight, tower, _sectors(test, fitted, constant)))
        timing = receivers[tower].timing
        if timing.shift_s or timing.average_s:
            warnings.append(
                f"rank at {tower}: on held-out sectors, reports fit best to positions {timing.shift_s:g} s later than "
                f"logged and a channel averaged over {timing.average_s:g} s"
            )
        if receivers[tower].tied > 1:
            warnings.append(
                f"rank at {tower}: {receivers[tower].tied} geometries have the same score, among them "
                + "; ".join(g.in_words() for g in receivers[tower].geometries[:3])
            )
    return RankCalibration(
        receivers=receivers, scores={k: tuple(v) for k, v in scores.items()}, warnings=tuple(warnings)
    )


def _sectors(samples: RankSamples, fitted: FittedReceiver, constant: FloatArray) -> ForecastScore:
    """Score forecasts of held-out sectors.

    The forecasts are fitted to the other sectors, with geometries from other flights.
    """
    good = samples.part(samples.rank >= 1)
    groups = receiver.sector_groups(good.poses.position_m, good.tower_m)
    penalty = fitted.mixture.members[0].penalty
    forecast = receiver.out_of_group(
        features_of(fitted.geometries[:1], good, fitted.timing)[0], good.rank.astype(np.int64), groups, penalty
    )
    return score_forecast(good.rank, forecast, forecast.argmax(axis=1) + 1, constant)


@dataclass(frozen=True, slots=True)
class Tried:
    """The channels of all candidates at thinned samples of each flight: ``power`` (geometries, n, 4) per flight."""

    grid: RankGrid
    samples: Sequence[RankSamples]
    geometries: tuple[Geometry, ...]
    thinned: Sequence[RankSamples]
    power: Sequence[FloatArray]

    @classmethod
    def of(cls, samples: Sequence[RankSamples], grid: RankGrid = RankGrid()) -> Tried:
        """Evaluate all candidates of a grid for flights at one tower."""
        geometries = candidates(grid, samples[0])
        thinned = [sample.part(slice(None, None, grid.thin)) for sample in samples]
        return cls(grid, samples, geometries, thinned, [_powers_of(geometries, item) for item in thinned])

    def fit(self, flights: Sequence[int] | range) -> FittedReceiver:
        """Choose geometries and timing on some flights, and fit the receiver.

        First, geometries are chosen without timing. Then the timing is chosen with the best of these geometries. With
        this timing, all geometries are compared a second time.
        """
        first = self.choose(flights, Timing())
        timing = self.choose_timing(flights, first.order[: self.grid.members])
        choice = first if timing.shift_s == timing.average_s == 0.0 else self.choose(flights, timing)
        chosen = tuple(self.geometries[i] for i in choice.tied[: self.grid.members])
        train = [self.samples[i] for i in flights]
        mixture = receiver.fit_mixture(
            np.concatenate([features_of(chosen, item, timing) for item in train], axis=1),
            np.concatenate([item.rank for item in train]),
            _groups(train),
            penalties=(3.0, 10.0, 30.0),
        )
        return FittedReceiver(
            tower=train[0].tower,
            geometries=chosen,
            tied=len(choice.tied),
            flights=tuple(item.flight for item in train),
            trained_on=union(*(item.logs for item in train)),
            marks=tuple(item.mark for item in train if item.mark),
            mixture=mixture,
            timing=timing,
        )

    def choose(self, flights: Sequence[int] | range, timing: Timing) -> receiver.FeatureChoice:
        """Compare all geometries by their scores on held-out sectors of the flights."""
        thinned = [self.thinned[i] for i in flights]
        return receiver.choose_features(
            self.features(flights, timing), np.concatenate([item.rank for item in thinned]), _groups(thinned)
        )

    def choose_timing(self, flights: Sequence[int] | range, which: IntArray) -> Timing:
        """Choose the timing with the smallest log score of the mean forecast on held-out sectors."""
        thinned = [self.thinned[i] for i in flights]
        rank, groups = np.concatenate([item.rank for item in thinned]), _groups(thinned)
        timings = [Timing(shift_s=s, average_s=mean_s) for s in self.grid.shift_s for mean_s in self.grid.average_s]
        return min(timings, key=lambda t: receiver.mixture_loss(self.features(flights, t, which), rank, groups))

    def features(
        self, flights: Sequence[int] | range, timing: Timing, which: IntArray | slice = slice(None)
    ) -> FloatArray:
        """Return features at the thinned samples of some flights, shape (geometries, n, 4)."""
        return np.concatenate([_features(self.power[i][which], self.thinned[i], timing) for i in flights], axis=1)


def _groups(samples: Sequence[RankSamples]) -> IntArray:
    """Return the sector of each sample. A sector is held out in all flights at the same time."""
    position_m = np.concatenate([sample.poses.position_m for sample in samples])
    return receiver.sector_groups(position_m, samples[0].tower_m)
