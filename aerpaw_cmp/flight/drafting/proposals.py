"""Proposals for a draft: the tower or position that the levels of a log fit, and learned antennas of the site.

Learned antennas are proposed only if the levels of the flight support them.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from ...common.errors import InputError, UsageError
from ...common.units import FloatArray, spread_out
from ...compare import gains
from ...compare.calibration import Observed
from ...compare.gains import LinkSamples
from ...compare.locate import (
    FEWEST,
    Case,
    LevelModel,
    LevelTrack,
    fit_places,
    known_cases,
    level_track,
    locate,
    place_odds,
)
from ...compare.statistics import is_stuck
from ...logs.records import Stream
from ...propagation.field.baselines import free_space_dbm
from ...site import learned
from ...site.antennas import MeasuredPattern
from ...site.learned import (
    DirectionCovariance,
    SpherePattern,
    check_logs,
    read_direction_covariance,
    read_pair,
    read_sphere_csv,
)
from ...site.site import Site
from ..data import RATIOS, FlightData, RssSeries, quantity_of
from ..gains import pair_and_sd_db, sphere_angles, spread_of, with_learned
from ..replay import observed_series
from ..rows import unscored
from ..settings import FlightFile
from ..track import Track
from ..training import among, flight_logs, logs_of, marks_of, series_mark

# Smallest log odds of a tower, and of a listed position. Of 20 real flights at LW1 and thirds of them, 18 have more
# than -0.5 and all have more than -3. For six rovers, the log odds of towers are -11 or less, and the log odds of the
# listed positions -3 or more.
_TOWER_ODDS, _LISTED_ODDS = -0.5, -5.0

# Log odds that learned antennas must add. For thirds of LW1 flights, antennas from one or two flights add 8 to 57. At
# 158 of 165 positions elsewhere, they add less than 5, and the log odds stay below those of a tower.
_LEARNED_MORE = 5.5

# Log evidence by which the levels must fit another tower better than the tower in the name of the log.
CONTRADICTED = 8.0

# Smallest number of bins of a level from which the vehicle that carried the radio is chosen, and the model of the
# level.
_FEWEST_OF_VEHICLE = 8
_NEAR_FREE_SPACE = LevelModel(
    slope=2.0, slope_sd=0.3, elevation_sd_db=2.0, cases=(Case(shadow_db=2.0, scatter_db=1.5, time_s=30.0),)
)

# If the log odds of positions and towers differ by less than this, all of them are named.
_UNDECIDED = 3.0

# Carrier and power of the link that a draft proposes.
CARRIER_HZ, POWER_DBM = 3.3e9, 40.0

# Below this height [m] the ground and the airframe determine the level.
_LOW_M = 5.0

# A listed position farther from the start of the track belongs to another flight.
NEAR_M = 5000.0


@dataclass(frozen=True, slots=True)
class ListedPlace:
    """A position of a position list: file name, line, latitude and longitude [deg]."""

    file: str
    line: int
    latitude_deg: float
    longitude_deg: float


_PAIR = re.compile(r"\s*(-?\d{1,3}\.\d{3,})\s*[,;\s]\s*(-?\d{1,3}\.\d{3,})\s*")
_MOST_BYTES = 20_000


def listed_places(folders: Iterable[Path]) -> list[ListedPlace]:
    """Return the positions in the position lists of some folders.

    A list is a text file with ``position`` in its name, and latitude and longitude on each line.
    """
    paths = [path for folder in sorted(set(folders)) for path in sorted(folder.glob("*[Pp]osition*"))]
    places = []
    for path in paths:
        if path.suffix not in (".txt", ".csv", "") or not path.is_file() or path.stat().st_size > _MOST_BYTES:
            continue
        for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), 1):
            if (pair := _PAIR.fullmatch(line)) is not None:
                places.append(ListedPlace(path.name, number, float(pair[1]), float(pair[2])))
    return places


@dataclass(frozen=True, slots=True)
class Placement:
    """A proposal for ``node`` of a log.

    Parameters
    ----------
    node : str
    tower : mapping or None
        Entry of ``towers`` in flight.yaml. None for a tower of the site, and for a node that was proposed for an
        earlier log.
    question : str
        Question about the proposal.
    position_m : (3,), optional
        East, north and up of a node that is not in the site [m]. None if it was proposed for an earlier log.
    """

    node: str
    tower: Mapping[str, Any] | None
    question: str
    position_m: FloatArray | None = None


@dataclass(frozen=True, slots=True)
class LearnedTower:
    """Learned antennas of a tower and an airframe, and the scatter of levels about them.

    Parameters
    ----------
    moments : Moments, optional
        Gain of both ends with its covariance, to compare it with an unknown gain.
    """

    tower: MeasuredPattern
    uav: MeasuredPattern
    model: LevelModel
    moments: gains.Moments | None = None


@dataclass(frozen=True)
class NodeFinder:
    """Proposals of nodes for the logs of one flight, by its telemetry."""

    site: Site
    telemetry: Stream
    listed: Sequence[ListedPlace] = ()

    @cached_property
    def track(self) -> Track:
        """The track of the flight."""
        frame = self.telemetry.frame[~unscored(self.telemetry.frame)]
        takeoff_m, ground = self.site.takeoff_ground_m, self.site.ground_under_m
        return Track(frame, self.site.frame, ground_m=takeoff_m, ground=ground)

    @property
    def at_site(self) -> bool:
        """True if the flight was flown near a tower of the site."""
        return any(self._near(tower.latitude_deg, tower.longitude_deg) for tower in self.site.towers.values())

    def positions_m(self, count: int) -> FloatArray:
        """Return about ``count`` positions (n, 3) of the flight in the air [m], at equal steps of rows."""
        times = self.telemetry.frame["time"]
        place = self.track.pose_at(times.iloc[spread_out(len(times), count)]).position_m
        # omit positions on the ground, where every sight line is blocked
        return place[place[:, 2] > self.track.ground_m + _LOW_M]

    def levels(self, stream: Stream, floor_db: float = -np.inf) -> LevelTrack:
        """Return the levels of a log along the flight. ``floor_db`` is the floor of the receiver, -inf if unknown."""
        frame = stream.frame[~unscored(stream.frame)]
        poses = self.track.pose_at(frame["time"])
        place = np.where((poses.position_m[:, 2] > self.track.ground_m + _LOW_M)[:, None], poses.position_m, np.nan)
        time = frame["time"].to_numpy("datetime64[ns]").astype(np.int64) * 1e-9
        level = frame["rss_db"].to_numpy(np.float64)
        below_floor = frame["flag"].astype(str).str.contains("out_of_coverage").to_numpy()
        # out of coverage means that the level was below the floor
        level = np.where(np.isnan(level) & below_floor & np.isfinite(floor_db), floor_db, level)
        track = level_track(time, place, level, floor_db=floor_db)
        if not len(track.time_s):
            return track
        rotation = self.track.pose_at((track.time_s * 1e9).astype("datetime64[ns]")).rotation
        # the mean time of a window can be in a gap of the telemetry
        kept = np.isfinite(rotation).all(axis=(1, 2))
        time, place, level = track.time_s[kept], track.position_m[kept], track.level_db[kept]
        return replace(track, time_s=time, position_m=place, level_db=level, rotation=rotation[kept])

    def propose(
        self,
        track: LevelTrack,
        antennas: Mapping[str, Sequence[LearnedTower]] = MappingProxyType({}),
        nodes: Mapping[str, FloatArray] = MappingProxyType({}),
        airframe: Callable[[], MeasuredPattern | None] = lambda: None,
    ) -> Placement | None:
        """Return the tower, listed position or estimated position that levels fit. None if there are too few levels.

        Parameters
        ----------
        track : LevelTrack
        antennas : mapping of str to sequence of LearnedTower
            Gains of towers and airframe that were learned from other flights, by tower.
        nodes : mapping of str to (3,)
            Positions of the nodes that were proposed for other logs of the flight [m].
        airframe : callable
            Function that returns the learned airframe that the levels support. It is called only if no tower fits
            without one.

        Returns
        -------
        Placement or None
        """
        if len(track.level_db) < FEWEST:
            return None
        towers = list(self.site.towers.values())
        listed = [place for place in self.listed if self._near(place.latitude_deg, place.longitude_deg)]
        at = [np.asarray(tower.position_m) for tower in towers] + [self._local(place) for place in listed]
        odds = place_odds(track, np.array(at))
        if odds[: len(towers)].max() < _TOWER_ODDS and (known_airframe := airframe()) is not None:
            track = with_antennas(track, known_airframe)
            odds = place_odds(track, np.array(at))
        odds_tower, odds_listed = odds[: len(towers)].copy(), odds[len(towers) :]
        # search only for learned antennas, or if no tower fits, because the search is the slowest step
        estimate = locate(track) if any(antennas.values()) or odds_tower.max() < _TOWER_ODDS else None
        known = np.full(len(towers), -np.inf)
        for i, tower in enumerate(towers):
            if estimate is None:
                continue
            if fitting := [each for each in antennas.get(tower.name, ()) if self._supports(track, tower.name, each)]:
                learned_odds = max(self._learned_odds(track, tower.name, each) for each in fitting) - np.log(
                    len(fitting)
                )
                # express the odds against a tower at any position, as all other odds
                learned_odds -= estimate.anywhere + _LEARNED_MORE
                known[i] = learned_odds if learned_odds >= _TOWER_ODDS else -np.inf
                odds_tower[i] = max(odds_tower[i], learned_odds)
        if len(listed) and odds_listed.max() >= max(_LISTED_ODDS, odds_tower.max()):
            # positions in a list can be only some metres apart: name all likely lines
            order = np.argsort(-odds_listed)
            place, least = listed[order[0]], odds_listed[order[0]] - _UNDECIDED
            undecided = [listed[i] for i in order[1:] if odds_listed[i] > least]
            also = "".join(f" or line {tie.line}" for tie in undecided)
            about = f"line {place.line} of {place.file}{also}: is the node there?"
            # the region contains all likely lines
            apart_m = [1 + int(np.linalg.norm(self._local(tie) - self._local(place))) for tie in undecided]
            at_list = round(place.latitude_deg, 7), round(place.longitude_deg, 7), 1.5, *sorted(apart_m)[-1:]
            return _node(self._local(place), at_list, about, nodes)
        best = int(odds_tower.argmax())
        if odds_tower[best] >= _TOWER_ODDS:
            near = [i for i in np.argsort(-odds_tower) if odds_tower[i] > odds_tower[best] - _UNDECIDED]
            alike = [towers[i].name for i in near]
            # a part of a flight can fit several towers. A tower with learned antennas is then the most likely.
            name = towers[max(near, key=lambda i: (known[i], towers[i].name in antennas))].name
            asked = "is it this tower?" if len(alike) == 1 else f"is it {name}?"
            fits = (
                f"the levels fit {' or '.join(alike)} with its antennas learned from flights"
                if odds_tower[best] > odds[best]
                else f"no position fits the levels clearly better than {' or '.join(alike)}"
            )
            return Placement(name, None, f"{fits}: {asked}")
        assert estimate is not None  # the search ran, because no tower fits
        latitude, longitude = self.site.frame.to_geographic(estimate.place_m[:1], estimate.place_m[1:2])
        apart = [float(np.hypot(*(np.asarray(t.position_m) - estimate.place_m)[:2])) for t in towers]
        near = [t.name for t, d in zip(towers, apart, strict=True) if d <= estimate.radius90_m]
        decided = (
            f"the levels do not determine the tower ({', '.join(near)} possible)"
            if near
            else "no tower fits the levels"
        )
        about = (
            f"{decided}. They fit this place best (90 % region: {estimate.radius90_m:.0f} m), "
            f"path-loss exponent {estimate.slope:.1f} +- {2 * estimate.slope_sd:.1f}: where was the node?"
        )
        place = estimate.place_m
        degrees = round(float(latitude[0]), 7), round(float(longitude[0]), 7)
        return _node(place, (*degrees, float(place[2]), math.ceil(estimate.radius90_m)), about, nodes)

    def _supports(self, track: LevelTrack, tower: str, known: LearnedTower) -> bool:
        """Check whether levels support the learned antennas of a tower against an unknown gain."""
        if known.moments is None or track.rotation is None:
            return True
        place = self.site.towers[tower].position_m
        at_uav, at_tower = gains.link_directions(place, track.position_m, track.rotation)
        free = free_space_dbm(place[None, :], track.position_m, CARRIER_HZ, POWER_DBM)[:, 0]
        level = np.where(track.below, np.nan, track.level_db)
        samples = LinkSamples(
            flight="", tower=tower, channel="", time_s=track.time_s, position_m=track.position_m,
            at_uav=at_uav, at_tower=at_tower, residual_db=level - free,
        )  # fmt: skip
        odds = gains.FlightEvidence([samples]).of_link(0, known.moments)
        return odds.fits

    def _learned_odds(self, track: LevelTrack, tower: str, ends: LearnedTower) -> float:
        """Return the log evidence of a tower with learned antennas at both ends."""
        known = replace(track, airframe_db=_gain_of(ends.uav, ends.tower))
        return float(fit_places(known, self.site.towers[tower].position_m[None, :], ends.model).evidence[0])

    def evidence(self, stream: Stream) -> float:
        """Return the log evidence per bin of levels along this track at the best tower, or -inf for too few levels."""
        track = self.levels(stream)
        if len(track.level_db) < _FEWEST_OF_VEHICLE:
            return -np.inf
        towers = [tower.position_m for tower in self.site.towers.values()]
        return float(fit_places(track, towers, _NEAR_FREE_SPACE).evidence.max()) / len(track.level_db)

    def contradiction(self, track: LevelTrack, node: str) -> str | None:
        """Return a tower that levels fit far better than the node in their name. None if there is no such tower."""
        if node not in self.site.towers or len(track.level_db) < FEWEST:
            return None
        names = list(self.site.towers)
        evidence = fit_places(track, [self.site.towers[name].position_m for name in names]).evidence
        best = int(evidence.argmax())
        return names[best] if evidence[best] > evidence[names.index(node)] + CONTRADICTED else None

    def offset_db(
        self, track: LevelTrack, node: str, nodes: Mapping[str, FloatArray] = MappingProxyType({})
    ) -> float | None:
        """Return the median of free space over the draft's link minus the level [dB]. None for an unknown node."""
        place = nodes.get(node)
        if node in self.site.towers:
            place = self.site.towers[node].position_m
        if place is None or not len(track.level_db):
            return None
        free = free_space_dbm(place[None, :], track.position_m, CARRIER_HZ, POWER_DBM)[:, 0]
        return float(np.median(free - track.level_db))

    def _local(self, place: ListedPlace) -> FloatArray:
        east, north = self.site.frame.to_local(np.array([place.latitude_deg]), np.array([place.longitude_deg]))
        return np.array([east[0], north[0], 1.5])

    def _near(self, latitude_deg: float, longitude_deg: float) -> bool:
        if not len(self.track):
            return False
        start = self.track.pose_at(np.array([self.track.start_ns], dtype="datetime64[ns]")).position_m[0]
        # a list can contain numbers that are not angles
        with np.errstate(invalid="ignore"):
            east, north = self.site.frame.to_local(np.array([latitude_deg]), np.array([longitude_deg]))
        return bool(np.hypot(east[0] - start[0], north[0] - start[1]) < NEAR_M)


# The estimated positions of two channels of one rover are within this distance [m].
_SAME_NODE_M = 100.0


def _node(position_m: FloatArray, at: tuple[float, ...], question: str, nodes: Mapping[str, FloatArray]) -> Placement:
    """Return the placement at a position: a new node, or one of ``nodes``.

    ``at`` are latitude and longitude [deg], height [m] and, for an estimated position, its 90 % region [m].
    """
    for name, placed in nodes.items():
        if np.hypot(*(placed[:2] - position_m[:2])) < _SAME_NODE_M:
            return Placement(name, None, "")
    tower = dict(zip(("latitude_deg", "longitude_deg", "antenna_height_m", "region90_m"), at, strict=False))
    name = "NODE" + (str(len(nodes) + 1) if nodes else "")
    return Placement(name, tower, question, position_m=position_m)


def with_antennas(
    track: LevelTrack, airframe: MeasuredPattern | None, node: MeasuredPattern | None = None
) -> LevelTrack:
    """Return levels with the gains of airframe and node. Without a known airframe, the levels are unchanged."""
    return track if airframe is None else replace(track, airframe_db=_gain_of(airframe, node))


def _gain_of(
    airframe: MeasuredPattern, node: MeasuredPattern | None
) -> Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]:
    """Return a function for ``LevelTrack.airframe_db``: the gain of airframe and node, and its standard deviation."""

    def gain_db(at_uav: FloatArray, at_node: FloatArray) -> tuple[FloatArray, FloatArray]:
        gain, square = np.zeros((2, *at_uav.shape[:-1]))
        for pattern, direction in ((airframe, at_uav), (node, at_node)):
            if pattern is not None:
                gain += pattern.gain_dbi(*sphere_angles(direction))
            if isinstance(pattern, SpherePattern):
                square += pattern.gain_sd_db(*sphere_angles(direction)) ** 2
        return gain, np.sqrt(square)

    return gain_db


@dataclass(frozen=True, kw_only=True)
class LearnedLink:
    """Learned antennas of one tower and channel of a site.

    Parameters
    ----------
    name : str
        Name of the entry.
    """

    name: str
    entry: learned.Entry
    series: learned.LearnedSeries
    tower: SpherePattern
    uav: SpherePattern
    known: DirectionCovariance
    tower_known: DirectionCovariance

    @property
    def receiver(self) -> str:
        """Name of the receiver of the levels: the receiver of the training flights, or else the name of the entry."""
        return self.series.receiver or self.name

    @property
    def level(self) -> learned.LearnedLevel:
        """The learned level. Use it only for a series with a learned level."""
        assert self.series.level is not None
        return self.series.level

    @property
    def spread(self) -> gains.Spread:
        """The error model of a level, without the standard deviation of the gains."""
        return spread_of(self.series.spread)

    @property
    def prior_variance_db2(self) -> float:
        """The variance of the gains of both ends in directions without learned samples [dB^2]."""
        return self.tower.largest_sd_db**2 + self.uav.largest_sd_db**2

    @cached_property
    def airframe(self) -> gains.GainProcess:
        """The gain of the UAV with its covariance."""
        return _process(self.uav, self.known, gains.BODY)

    @cached_property
    def tower_antenna(self) -> gains.GainProcess:
        """The gain of the tower's antenna with its covariance."""
        return _process(self.tower, self.tower_known, gains.MAST)

    @property
    def airframe_is_general(self) -> bool:
        """True if the airframe can be used at other towers.

        This requires a receiver that keeps its lock, and training flights that predict each other.
        """
        return self.series.lock is None and self.series.shares_airframe

    def learned_from(self, sha256: str, mark: str) -> bool:
        """Check whether a log, by its SHA-256 or its fingerprint, is one of the training flights."""
        return sha256 in self.entry.trained_on or among(mark, self.uav.marks)

    def gain_db(self, samples: LinkSamples) -> tuple[FloatArray, FloatArray]:
        """Return the gain of both ends (n,) and its standard deviation (n,) [dB]."""
        ends = {"uav": (self.uav, samples.at_uav), "tower": (self.tower, samples.at_tower)}
        pair_db, sd_db = pair_and_sd_db(ends)
        return pair_db + sum(pattern.gain_dbi(*sphere_angles(direction)) for pattern, direction in ends.values()), sd_db

    def moments(self, samples: LinkSamples) -> tuple[FloatArray, FloatArray]:
        """Return mean (n,) and covariance (n, n) of the gain of both ends [dB, dB^2]."""
        uav_db, covariance = self.airframe.moments(samples.at_uav)
        tower_db, of_tower = self.tower_antenna.moments(samples.at_tower)
        both = np.concatenate([samples.at_uav, samples.at_tower], axis=1)
        pair_db = 0.0 if self.tower.pair is None else self.tower.pair.at(both, np.zeros(len(both)))[0]
        return uav_db + tower_db + pair_db, covariance + of_tower


def _process(pattern: SpherePattern, known: DirectionCovariance, term: gains.Term) -> gains.GainProcess:
    return gains.GainProcess(
        gain_db=lambda at: pattern.gain_dbi(*sphere_angles(at)),
        sd_db=lambda at: pattern.gain_sd_db(*sphere_angles(at)),
        directions=known.directions,
        covariance_db2=known.covariance_db2,
        term=term,
    )


def all_learned_links(site: str | Path) -> list[LearnedLink]:
    """Return the learned antennas of all entries of a site, the latest entry last.

    Raises
    ------
    UsageError, InputError
        If learned models are damaged, or a table was changed.
    """
    folder, out = learned.folder_of(site), []
    for name, entry in sorted(learned.read_learned(site).entries.items(), key=lambda item: item[1].made):
        named = learned.Named(entry=entry, part="", folder=folder)
        for series in entry.series:
            files = (series.tower_file, series.uav_file)
            tower, uav = (read_sphere_csv(folder / file, named.written(file)) for file in files)
            check_logs((*tower.trained_on, *uav.trained_on), named, folder / series.tower_file)
            if (pair := series.pair) is not None:
                place, written = folder / pair.file, named.written(pair.file)
                tower.pair = read_pair(place, pair.length, pair.prior_sd_db, written)
            known, of_tower = (
                read_direction_covariance(folder / file, named.written(file))
                for file in (series.known_file, series.tower_known_file)
            )
            out.append(
                LearnedLink(
                    name=name, entry=entry, series=series, tower=tower, uav=uav, known=known, tower_known=of_tower
                )
            )
    return out


def latest_learned_links(site: str | Path) -> dict[str, LearnedLink]:
    """Return the latest learned antennas of each ``tower.channel`` of a site.

    Raises
    ------
    UsageError, InputError
        For the same reasons as :func:`all_learned_links`.
    """
    return {f"{known.series.tower}.{known.series.channel}": known for known in all_learned_links(site)}


# Standard deviation of the path-loss exponent for antennas that were learned under free space, and the smallest scatter
# of levels about them [dB].
_LEARNED_SLOPE_SD, _LEAST_SCATTER_DB = 0.2, 0.1


@dataclass(frozen=True, slots=True)
class Receiver:
    """The learned receiver of the levels of a log, or a question if no learned receiver fits.

    Parameters
    ----------
    name : str
        Value of ``receiver:`` of the log, or an empty text if no receiver fits.
    about : str
        Odds of the receiver, or a question about it, for the end of a comment.
    """

    name: str
    about: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Proposal:
    """Learned antennas and receivers for a draft, by name, with their odds and the expected error.

    Parameters
    ----------
    antennas_about : str
        Source and odds of the antennas, or the odds of the best antennas if none fit.
    receiver : str, optional
        Receiver of the rank.
    receivers : mapping of int to Receiver
        Receivers of the levels, by the number of their log.
    """

    antennas: Mapping[str, str] = field(default_factory=dict)
    antennas_about: str = ""
    carrier_hz: float | None = None
    receiver: str | None = None
    receiver_about: str = ""
    receivers: Mapping[int, Receiver] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True)
class Nodes:
    """Nodes at well-known positions that are not towers of the site, and the towers of the site."""

    placed: frozenset[str] = frozenset()
    fixed: Sequence[str] = ()


def propose(
    data: FlightData, place: str | Path, site: str, nodes: Nodes = Nodes(), *, carrier_known: bool = False
) -> Proposal:
    """Return the learned antennas that the levels of a flight support, and the rank receiver of its tower.

    Antennas of both ends are compared with the levels of each series. If no pair fits, airframes alone are compared
    with all series together, unless a node is at an estimated position. The antenna of a node of other flights is
    compared at any node with a well-known position.

    Parameters
    ----------
    data : FlightData
        The flight, without learned antennas.
    place : str or Path
        The site, as an argument of :func:`.read_learned`.
    site : str
        Name of the site, as it appears in the names of the antennas.
    nodes : Nodes
    carrier_known : bool
        True if the carriers of ``data`` are correct. Antennas of other bands are then not compared.

    Returns
    -------
    Proposal

    Raises
    ------
    UsageError, InputError
        See :func:`all_learned_links`.
    """
    entries = learned.read_learned(place).entries
    found = Proposal()
    varying = [series for series in data.rss if not is_stuck(series.measured_db)]
    if data.track is not None and varying and entries:
        # a ratio to the noise is used only if there is no level
        levels = [s for s in varying if s.channel.lower() not in RATIOS] or varying
        observed, known = [observed_series(data, series)[0] for series in levels], all_learned_links(place)
        evidence = gains.FlightEvidence([o.samples for o in observed])
        bands = (learned.BAND, learned.AIRFRAME_BAND) if carrier_known else (math.inf, math.inf)
        chosen = _antennas_for(data, levels, known, evidence, nodes, bands)
        unsure = sorted({series.tower for series in levels}.difference(nodes.placed, nodes.fixed))
        if chosen.fits:
            found = chosen.proposal(site, evidence)
        elif unsure:
            # at a position that was estimated from the same levels, a wrong airframe can fit them
            nodes_text = " and ".join(unsure)
            text = f"learned airframes are compared only at known positions, and {nodes_text} has an estimated position"
            found = Proposal(antennas_about=text)
        else:
            found = _airframe_for(data, known, site, evidence, band=bands[1])
        found = replace(found, receivers=_receivers(zip(levels, observed, strict=True), known, chosen))
    ranked = {(s.tower, quantity_of(data, s)) for s in data.rank}
    for name, entry in entries.items():
        if any((r.tower, r.quantity) in ranked for r in entry.receivers):
            return replace(found, receiver=f"{site}/{name}", receiver_about=entry.about())
    return found


@dataclass(frozen=True, slots=True, kw_only=True)
class _Chosen:
    """The learned antennas of both ends that the levels support best, all from one entry, by ``tower.channel``."""

    antennas: Mapping[str, LearnedLink]
    odds: gains.Evidence

    @property
    def fits(self) -> bool:
        """True if the antennas can be proposed."""
        enough = self.odds.over_own >= gains.LEAST_ODDS and self.odds.over_turned > -_MOUNTED_AS_LEARNED
        return bool(self.antennas) and enough

    def proposal(self, site: str, evidence: gains.FlightEvidence) -> Proposal:
        """Return the names of the antennas, with the expected error and the odds."""
        first, samples = next(iter(self.antennas.values())), evidence.rows[0]
        errors, kind = _expected(first.entry, first.series, samples.position_m, first.gain_db(samples)[1])
        names = {k: f"{site}/{a.name}_{a.series.tower}.{a.series.channel}" for k, a in self.antennas.items()}
        return Proposal(
            antennas=names | {"uav": f"{site}/{first.name}_uav"},
            antennas_about=f"{first.entry.about(errors, kind)}; {_odds(self.odds)}",
            carrier_hz=first.series.carrier_hz,
        )


def _antennas_for(
    data: FlightData,
    levels: Sequence[RssSeries],
    known: Sequence[LearnedLink],
    evidence: gains.FlightEvidence,
    nodes: Nodes,
    bands: tuple[float, float],
) -> _Chosen:
    """Return the antennas of both ends of the entry with the largest odds."""
    receivers = {item.receiver for item in known}
    general = {item.series.uav_file: item for item in known if item.airframe_is_general}.values()
    tried: dict[str, list[tuple[str, LearnedLink, gains.Evidence]]] = {}
    for number, series in enumerate(levels):
        # use the same alternatives for all antennas, because their odds are compared with each other
        alone = (evidence.with_airframe(number, a.airframe) for a in general if _in_band(a, series, bands[1]))
        most_alone = max(alone, default=-math.inf)
        for item in known:
            if not _same_place(item.series, series.tower, nodes) or not _in_band(item, series, bands[0]):
                continue
            # do not propose antennas that do not predict other flights to a receiver with another unit
            if _unit_odds(series, item) < 0.0 and not item.airframe_is_general:
                continue
            named_odds = _named_odds(data, series, item, receivers)
            # antennas with a different name must also fit better than any airframe with an unknown antenna
            alternative = most_alone if named_odds <= 0.0 else -math.inf
            odds = evidence.of_link(number, item.moments, alternative)
            odds = replace(odds, over_own=odds.over_own + named_odds)
            if odds.over_own > 0.0:
                tried.setdefault(item.name, []).append((f"{series.tower}.{series.channel}", item, odds))
    # judge the channels of a flight together: their antennas must come from one entry, with one airframe
    fits = [_one_each(each) for each in tried.values()]
    chosen = max(fits, key=lambda fit: sum(odds.over_own for _, odds in fit.values()), default={})
    over = [(odds.over_own, odds.over_turned) for _, odds in chosen.values()]
    own, turned = (sum(each) for each in zip(*over, strict=True)) if over else (0.0, 0.0)
    antennas = {key: item for key, (item, _) in chosen.items()}
    return _Chosen(antennas=antennas, odds=gains.Evidence(over_own=own, over_turned=turned))


def _one_each(
    tried: Sequence[tuple[str, LearnedLink, gains.Evidence]],
) -> dict[str, tuple[LearnedLink, gains.Evidence]]:
    """Return the antennas of each channel, those with the largest odds first.

    Two channels of a tower have two antennas, so an antenna is used twice only if there are too few.
    """
    pairs = sorted(tried, key=lambda pair: -pair[2].over_own)
    chosen: dict[str, tuple[LearnedLink, gains.Evidence]] = {}
    for key, item, odds in pairs:
        if all(item is not other for other, _ in chosen.values()):
            chosen.setdefault(key, (item, odds))
    for key, item, odds in pairs:
        chosen.setdefault(key, (item, odds))
    return chosen


# Standard deviation of the level of an unknown receiver [dB], and of the unknown gains of both ends.
_UNKNOWN_LEVEL_DB = 30.0
_UNKNOWN_GAINS_DB = math.hypot(gains.BODY.sd_db, gains.MAST.sd_db, gains.PAIR.sd_db)

# Log odds for the receiver of the learned antennas that the levels support, and for a receiver that loses its lock if
# the log does.
_ITS_ANTENNAS = _ITS_LOCK = 5.0

# If the share of samples without lock is larger than this, the receiver loses its lock.
_LOST_SHARE = 0.01


def _receivers(
    levels: Iterable[tuple[RssSeries, Observed]], known: Sequence[LearnedLink], chosen: _Chosen
) -> dict[int, Receiver]:
    """Return the learned receiver of the levels of each log, or the question for it, by the number of the log.

    A receiver is recognised by its level above free space, its unit, its loss of lock and its antennas. There is a
    question only if the antennas of a receiver are proposed and its level differs.
    """
    odds: dict[int, dict[str, float]] = {}
    words: dict[tuple[int, str], str] = {}
    for series, observed in levels:
        antenna = chosen.antennas.get(f"{series.tower}.{series.channel}") if chosen.fits else None
        each: dict[str, tuple[float, str]] = {}
        for item in known:
            other_port = antenna is not None and antenna.name == item.name and antenna is not item
            if item.series.level is not None and _in_band(item, series, learned.AIRFRAME_BAND) and not other_port:
                tried = _receiver_odds(series, observed, item, antenna)
                each[item.receiver] = max(each.get(item.receiver, tried), tried)
        for log in np.unique(series.log).tolist():
            together = odds.setdefault(log, {})
            for name, (nat, text) in each.items():
                together[name], words[log, name] = together.get(name, 0.0) + nat, text
    out, theirs = {}, next((item.receiver for item in chosen.antennas.values()), "")
    for log, together in odds.items():
        best = max(together, key=lambda name: together[name], default="")
        rivals = [nat for name, nat in together.items() if name != best]
        over = together.get(best, -math.inf) - float(np.logaddexp.reduce([0.0, *rivals]))
        if over >= gains.LEAST_ODDS:
            out[log] = Receiver(best, f"{words[log, best]}, odds {_ratio(over)}: is it the learned receiver {best}?")
        elif chosen.fits and (log, theirs) in words:
            out[log] = Receiver("", f"{words[log, theirs]}: is it another receiver than {theirs}?")
    return out


def _receiver_odds(
    series: RssSeries, observed: Observed, item: LearnedLink, antenna: LearnedLink | None
) -> tuple[float, str]:
    """Return the log odds that levels were measured by the receiver of an item, and a phrase about its level."""
    level, lock, samples = item.level, item.series.lock, observed.samples
    if observed.locked is not None:
        samples = samples.part(np.asarray(observed.locked != 0.0))
    if not np.isfinite(samples.residual_db).any():
        return -math.inf, ""
    lost, samples = 1.0 - len(samples) / len(observed.samples), samples.binned(4.0)
    its_antenna = antenna is not None and antenna.name == item.name
    gain_db = antenna.gain_db(samples)[0] if its_antenna and antenna is not None else np.zeros(len(samples))
    sent_db = series.link.transmit_power_dbm - level.transmit_power_dbm
    at_carrier_db = 20.0 * math.log10(item.series.carrier_hz / series.link.carrier_hz)
    offset_db = float(np.nanmean(samples.residual_db - gain_db)) + sent_db + at_carrier_db
    sd_db = level.sd_db if its_antenna else math.hypot(level.sd_db, _UNKNOWN_GAINS_DB)
    nat = math.log(_UNKNOWN_LEVEL_DB / sd_db) - 0.5 * ((offset_db - level.offset_db) / sd_db) ** 2
    nat += _unit_odds(series, item)
    nat += _ITS_ANTENNAS if its_antenna else 0.0
    if lost > _LOST_SHARE:
        nat += _ITS_LOCK if lock is not None else -math.inf
    stated = f"{level.offset_db:.1f} +- {level.sd_db:.1f}"
    return nat, f"level {offset_db:.1f} dB above free space ({stated} dB when learned)"


def _airframe_for(
    data: FlightData, known: Sequence[LearnedLink], site: str, evidence: gains.FlightEvidence, *, band: float
) -> Proposal:
    """Return the airframe alone that the levels support, or a proposal with the odds of the best airframe only."""
    own, marks = set(flight_logs(data)), marks_of([data])
    tried: dict[str, tuple[LearnedLink, gains.Evidence]] = {}
    for item in known:
        same_log = own & set(item.entry.trained_on) or any(among(mark, item.uav.marks) for mark in marks)
        near = all(_in_band(item, series, band) for series in data.rss)
        if item.airframe_is_general and not same_log and near and item.series.uav_file not in tried:
            tried[item.series.uav_file] = item, evidence.of_airframe(item.airframe)
    if not tried:
        return Proposal()
    best, odds = max(tried.values(), key=lambda pair: min(pair[1].over_own, pair[1].over_turned))
    if not odds.fits:
        text = f"none of the learned airframes fits these levels. The best is {best.name}, with {_odds(odds)}"
        return Proposal(antennas_about=text)
    about = best.entry.about(*_expected(best.entry, None))
    return Proposal(
        antennas={"uav": f"{site}/{best.name}_uav"},
        antennas_about=f"the airframe alone, {about}; {_odds(odds)}",
        carrier_hz=None if math.isfinite(band) else best.series.carrier_hz,
    )


# Prior log odds of antennas of both ends with the same names of tower and channel or the same receiver. Prior log odds
# of a receiver with levels in another unit. Levels of field flights add 13 and more, so they can outweigh equal names.
# Levels of a short or smooth flight cannot. The unit depends on the receiver and not on the antennas.
_SAME_NAME, _OTHER_UNIT = 10.0, -3.0

# Prior log odds that known antennas are mounted as before, and not rotated by a quarter turn or more.
_MOUNTED_AS_LEARNED = 3.0


def _named_odds(data: FlightData, series: RssSeries, item: LearnedLink, receivers: Container[str]) -> float:
    """Return the log odds of a pair of learned antennas, from the names of receiver, tower and channel."""
    receiver = data.settings.logs[int(series.log[0])].receiver if len(series.log) else ""
    if receiver in receivers:
        return _SAME_NAME if receiver == item.receiver else -math.inf
    same = (series.tower, series.channel) == (item.series.tower, item.series.channel)
    return _SAME_NAME if same else 0.0


def _unit_odds(series: RssSeries, item: LearnedLink) -> float:
    """Return the log odds of a receiver from the unit of the levels. A level in dB can have any reference."""
    any_reference = series.unit == "dB" and series.channel.lower() not in RATIOS
    same = item.series.level is None or any_reference or item.level.unit == series.unit
    return 0.0 if same else _OTHER_UNIT


def _in_band(item: LearnedLink, series: RssSeries, band: float) -> bool:
    return abs(series.link.carrier_hz / item.series.carrier_hz - 1.0) <= band


# Odds above this are shown as "more than", and odds below 1 / this as "less than".
_MOST_ODDS = 1000.0


def _odds(odds: gains.Evidence) -> str:
    """Return the odds of antennas as words.

    Examples
    --------
    >>> _odds(gains.Evidence(over_own=4.0, over_turned=20.0))
    'odds 55:1 against an unknown gain, more than 1000:1 against the same antennas rotated'
    """
    turned = "" if math.isinf(odds.over_turned) else f", {_ratio(odds.over_turned)} against the same antennas rotated"
    return f"odds {_ratio(odds.over_own)} against an unknown gain{turned}"


def _ratio(nat: float) -> str:
    """Return log odds [nat] as a ratio.

    Examples
    --------
    >>> _ratio(4.0), _ratio(20.0), _ratio(-1.0), _ratio(-20.0)
    ('55:1', 'more than 1000:1', '1:3', 'less than 1:1000')
    """
    for_one = math.exp(min(abs(nat), math.log(_MOST_ODDS)))
    beyond = "" if abs(nat) <= math.log(_MOST_ODDS) else "more than " if nat > 0.0 else "less than "
    return beyond + (f"{for_one:.0f}:1" if nat > 0.0 else f"1:{for_one:.0f}")


# Assumptions about the scatter of the levels of a node at an unknown position, with an unknown gain of the airframe.
_SCATTERS = tuple(
    Case(shadow_db=shadow, scatter_db=scatter, length_m=45.0, azimuth_db=0.8, airframe_db=1.5)
    for shadow, scatter in ((8.0, 4.0), (2.5, 2.0))
)

# Airframes are compared at the likeliest positions of a grid that reaches this far beyond the track [m]. Around each of
# them, the spacing is divided by three to the east and to the north.
_BEYOND_M, _PER_SIDE, _LIKELIEST = 400.0, 24, 10


def searching_airframe(
    site: str | Path, log: tuple[str, str], track: LevelTrack, carrier_hz: float | None = None
) -> SpherePattern | None:
    """Return the learned airframe that levels of a node at an unknown position support, or None.

    The levels, in any unit, must be more likely with the gain of the airframe than with an unknown gain and with each
    rotated copy. Each likelihood is a mean over the likely positions of the node.

    Parameters
    ----------
    site : str or Path
        Name or path, as for :func:`.read_learned`.
    log : (SHA-256, fingerprint)
        The log file that contains the levels. Airframes learned from this file are not used.
    track : LevelTrack
        The levels, without antennas.
    carrier_hz : float, optional
        Carrier of the levels [Hz]. Airframes of other bands are then not used.

    Returns
    -------
    SpherePattern or None
        Gain of the airframe over its directions.
    """
    if len(track.level_db) < FEWEST or track.rotation is None:
        return None
    known: dict[str, SpherePattern] = {}
    with suppress(InputError, UsageError):
        for item in all_learned_links(site):
            near = carrier_hz is None or abs(carrier_hz / item.series.carrier_hz - 1.0) <= learned.AIRFRAME_BAND
            if item.series.shares_airframe and near and not item.learned_from(*log):
                known.setdefault(item.series.uav_file, item.uav)
    if not known:
        return None
    places = _likely_places(track)

    def likelihood(airframe: SpherePattern | None, turn_deg: float = 0.0) -> float:
        levels, cases = track, _SCATTERS
        if airframe is not None:
            gain, cases = _gain_of(airframe, None), tuple(replace(c.with_airframe(), log_weight=0.0) for c in cases)
            levels = replace(track, airframe_db=lambda at_uav, node: gain(gains.rotated(at_uav, turn_deg), node))
        evidence = fit_places(levels, places, LevelModel(cases=cases)).evidence
        return float(evidence.max() + np.log(np.exp(evidence - evidence.max()).mean()))

    best = max(known.values(), key=likelihood)
    # only the best airframe is compared with its copies, because they take most of the time
    return best if gains.judged(likelihood(None), lambda turn_deg: likelihood(best, turn_deg)).fits else None


def _likely_places(track: LevelTrack) -> FloatArray:
    """Return the positions (n, 3) of a node that its levels fit best if the antennas are unknown [m]."""
    flat = track.position_m[:, :2]
    low, high = flat.min(axis=0) - _BEYOND_M, flat.max(axis=0) + _BEYOND_M
    step = (high - low) / (_PER_SIDE - 1)
    grid = low + step * np.indices((_PER_SIDE, _PER_SIDE)).reshape(2, -1).T
    places = np.concatenate([np.column_stack([grid, np.full(len(grid), height)]) for height in (1.5, 10.0)])
    evidence = fit_places(track, places, LevelModel(cases=_SCATTERS[:1])).evidence
    near = places[np.argsort(-evidence)[:_LIKELIEST]]
    thirds = np.array([(east, north, 0.0) for east in (-1, 0, 1) for north in (-1, 0, 1)]) / 3.0
    return np.asarray((near[:, None] + thirds * np.append(step, 0.0)).reshape(-1, 3))


def learned_towers(site: str | Path, log: tuple[str, str], *, loses_lock: bool) -> dict[str, list[LearnedTower]]:
    """Return the learned antennas of both ends by tower. Empty if the learned models are damaged.

    Parameters
    ----------
    site : str or Path
    log : (SHA-256, fingerprint)
        Antennas that were learned from this log are not returned.
    loses_lock : bool
        True for receivers that lose their lock, False for all others.
    """
    out: dict[str, list[LearnedTower]] = {}
    with suppress(InputError, UsageError):
        for known in all_learned_links(site):
            if (known.series.lock is not None) != loses_lock:
                continue
            each = out.setdefault(known.series.tower, [])
            if known.learned_from(*log):
                continue
            # a model without scatter would make each level below the floor impossible or certain
            scatter_db = max(known.spread.noise_sd_db, _LEAST_SCATTER_DB)
            cases = known_cases(float(np.hypot(known.spread.own_sd_db, known.series.sd_db)), scatter_db)
            elevation_sd_db = known.spread.own_sd_db
            model = LevelModel(slope=2.0, slope_sd=_LEARNED_SLOPE_SD, elevation_sd_db=elevation_sd_db, cases=cases)
            each.append(LearnedTower(tower=known.tower, uav=known.uav, model=model, moments=known.moments))
        return out
    return {}


def offered(data: FlightData) -> FlightFile | None:
    """Return the settings of a flight with the learned antennas that its levels support. None if no antenna fits."""
    site = data.settings.site.file
    own = frozenset(data.settings.towers)  # the flight file states the positions of these nodes
    nodes = Nodes(placed=own, fixed=[name for name in data.site.towers if name not in own])
    try:
        known = propose(data, data.site_place, str(Path(site).with_suffix("")), nodes, carrier_known=True)
    except (InputError, UsageError):
        return None
    if not known.antennas:
        return None
    settings = with_learned(data.settings.model_copy(update={"antennas": dict(known.antennas)}), data.folder)
    return settings if settings.link != data.settings.link else None


def errors_elsewhere(
    antennas: Mapping[str, learned.Named], series: RssSeries, flown: tuple[FloatArray, FloatArray] | None = None
) -> tuple[learned.Errors | None, str]:
    """Return the errors of learned antennas on held-out flights like this flight, and a phrase for the kind of flights.

    Without such antennas the errors are None.

    Parameters
    ----------
    antennas : mapping of str to Named
        The learned antennas that the flight file names, by its keys.
    series : RssSeries
    flown : (n, 3) and (n,), optional
        Positions [m], and standard deviation of the learned gain there [dB]. Errors are larger if these show that the
        height or the directions are new.

    Returns
    -------
    Errors or None
    str
        Kind of the held-out flights, such as ``"on another flight"``.
    """
    if "uav" not in antennas:
        return None, ""
    named = antennas.get(f"{series.tower}.{series.channel}", antennas["uav"])
    return _expected(named.entry, named.antenna("tower", series.link.carrier_hz), *(flown or ()))


# End of a sentence about the expected error if only the antenna of the UAV is learned.
ALONE = "with the airframe alone"

# Directions are new if the standard deviation of the gain exceeds that in learned directions by this factor.
_UNSEEN_SD = 2.0


def _expected(
    entry: learned.Entry,
    series: learned.LearnedSeries | None,
    position_m: FloatArray | None = None,
    sd_db: FloatArray | None = None,
) -> tuple[learned.Errors | None, str]:
    """Return the expected errors of an antenna, or of the airframe alone (series None), and a phrase for their kind."""
    errors, usual = entry.errors, "on another flight"
    if errors is None:
        return None, usual
    if series is None:
        alone_db = errors.airframe_rmse_db
        alone = None if alone_db is None else errors.model_copy(update={"rmse_db": alone_db})
        return alone, ALONE
    if position_m is None or sd_db is None or not np.isfinite(sd_db).any():
        return errors, usual
    heights, count = np.unique(np.round(position_m[np.isfinite(position_m[:, 2]), 2]), return_counts=True)
    unseen = bool(np.nanmedian(sd_db) > _UNSEEN_SD * series.sd_db)
    return errors.expected(float(heights[count.argmax()]), unseen=unseen)


def lock_elsewhere(data: FlightData, series: RssSeries) -> learned.LearnedLock | None:
    """Return P(lock) of the receiver that the flight file names for a series, or else of the airframe's receiver.

    None if the receiver never loses its lock, is not known, or was learned from this series.
    """
    receiver, uav = data.settings.logs[int(series.log[0])].receiver, data.settings.learned.get("uav")
    with suppress(InputError, UsageError):
        named = [item for item in all_learned_links(data.site_place) if item.receiver == receiver] if receiver else []
        if named:
            own, mark = logs_of(data, series), series_mark(series)
            known = any(item.learned_from(log, mark) for item in named for log in own)
            return None if known else named[-1].series.lock
        if uav is not None:
            return next((item.lock for item in uav.entry.series if item.lock is not None), None)
    return None


def _same_place(s: learned.LearnedSeries, tower: str, nodes: Nodes) -> bool:
    """Check whether an antenna belongs to a tower, or to a node at a well-known position."""
    return s.tower == tower or (tower in nodes.placed and s.tower not in nodes.fixed)
