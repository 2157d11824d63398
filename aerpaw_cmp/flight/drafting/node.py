"""Tower, or place, that the levels of a log fit: proposals for a draft."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from ...common.units import FloatArray, spread_out
from ...compare.gains.direction_gain import LinkSamples, link_directions
from ...compare.gains.evidence import LEAST_ODDS, FlightEvidence, Moments
from ...compare.learning.locate import FEWEST, LevelModel, LevelTrack, fit_places, level_track, locate, place_odds
from ...logs.records import Stream
from ...propagation.field.baselines import free_space_dbm
from ...site.antenna.antennas import MeasuredPattern
from ...site.site import Site
from ..gains.learned_gain import sphere_angles
from ..pose.track import Track
from ..rows.scored import unscored

# Log odds from which on a tower stands: of real flights and thirds at LW1 18 of 20 give more, all more than -3, and six
# rovers -11 and less; from which on a listed place does, which somebody wrote down: the rovers' give -3 and more.
_TOWER_ODDS, _LISTED_ODDS = -0.5, -5.0

# Log odds that antennas which flights taught must give more: thirds of LW1 flights give 8 to 57 in all where one or two
# taught; of 165 places elsewhere 158 give less than the 5 at which a tower stands.
_TAUGHT_MORE = 5.5

# Log evidence by which another tower must explain the levels better before a named one is doubted.
CONTRADICTED = 8.0

# Bins of a level that say which of two vehicles carried the radio, and the model that they are judged by.
_FEWEST_OF_VEHICLE = 8
_NEAR_FREE_SPACE = LevelModel(slope=2.0, slope_sd=0.3, elevation_sd_db=2.0, shadow_sd_db=2.0, scatter_sd_db=1.5)

# Places of a list, and towers, whose log odds differ by less are all named.
_UNDECIDED = 3.0

# Of the link that a draft proposes.
CARRIER_HZ, POWER_DBM = 3.3e9, 40.0

# Below it an airframe on the ground decides the level.
_LOW_M = 5.0

# A place of a list that is farther from the track is not of this flight.
NEAR_M = 5000.0


@dataclass(frozen=True, slots=True)
class ListedPlace:
    """A place of a position list: file name, line, latitude and longitude [deg]."""

    file: str
    line: int
    latitude_deg: float
    longitude_deg: float


_PAIR = re.compile(r"\s*(-?\d{1,3}\.\d{3,})\s*[,;\s]\s*(-?\d{1,3}\.\d{3,})\s*")
_MOST_BYTES = 20_000


def listed_places(folders: Iterable[Path]) -> list[ListedPlace]:
    """Places that position lists in some folders name: text files with ``position`` in the name, a pair a line."""
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
        Entry of ``towers`` in flight.yaml, where the site has no such tower.
    question : str
        About the proposal.
    radius_m : float
        Of 90 % confidence about an estimated place; 0 of a known one.
    """

    node: str
    tower: Mapping[str, Any] | None
    question: str
    radius_m: float = 0.0


@dataclass(frozen=True, slots=True)
class Taught:
    """Antennas of a tower and of an airframe that flights taught, and how levels scatter about them."""

    tower: MeasuredPattern
    uav: MeasuredPattern
    model: LevelModel
    moments: Moments | None = None
    """Gain of both ends with its covariance, by which it must win against a gain of the flight's own."""


@dataclass
class Placer:
    """Proposals for the logs of one flight."""

    site: Site
    telemetry: Stream
    listed: Sequence[ListedPlace] = ()
    nodes: dict[str, FloatArray] = field(default_factory=dict)
    """Proposed so far: east and north."""

    def __post_init__(self) -> None:
        frame = self.telemetry.frame[~unscored(self.telemetry.frame)]
        takeoff_m, ground = self.site.takeoff_ground_m, self.site.ground_under_m
        self.track = Track(frame, self.site.frame, ground_m=takeoff_m, ground=ground)

    @property
    def at_site(self) -> bool:
        """True if the flight was flown near a tower of the site."""
        return any(self._near(tower.latitude_deg, tower.longitude_deg) for tower in self.site.towers.values())

    def positions_m(self, count: int) -> FloatArray:
        """About ``count`` positions (n, 3) of the flight [m], spread over it, above the ground."""
        times = self.telemetry.frame["time"]
        place = self.track.pose_at(times.iloc[spread_out(len(times), count)]).position_m
        # in the air: on the ground everything is behind something
        return place[place[:, 2] > self.track.ground_m + _LOW_M]

    def levels(
        self,
        stream: Stream,
        floor_db: float = -np.inf,
        airframe: MeasuredPattern | None = None,
        node: MeasuredPattern | None = None,
    ) -> LevelTrack:
        """Levels of a log where the UAV flew, with the gains of its airframe and of a node where they are known.

        Parameters
        ----------
        stream : Stream
        floor_db : float
            Of the receiver; -inf where none is known.
        airframe, node : MeasuredPattern, optional

        Returns
        -------
        LevelTrack
        """
        frame = stream.frame[~unscored(stream.frame)]
        poses = self.track.pose_at(frame["time"])
        place = np.where((poses.position_m[:, 2] > self.track.ground_m + _LOW_M)[:, None], poses.position_m, np.nan)
        time = frame["time"].to_numpy("datetime64[ns]").astype(np.int64) * 1e-9
        level = frame["rss_db"].to_numpy(np.float64)
        below_floor = frame["flag"].astype(str).str.contains("out_of_coverage").to_numpy()
        # out of coverage is knowledge: the level was below the floor there
        level = np.where(np.isnan(level) & below_floor & np.isfinite(floor_db), floor_db, level)
        track = level_track(time, place, level, floor_db=floor_db)
        if not len(track.time_s):
            return track
        track = replace(track, rotation=self.track.pose_at((track.time_s * 1e9).astype("datetime64[ns]")).rotation)
        return track if airframe is None else replace(track, airframe_db=self._gain_db(track, airframe, node))

    def propose(
        self, track: LevelTrack, taught: Mapping[str, Sequence[Taught]] = MappingProxyType({})
    ) -> Placement | None:
        """Tower, listed place or estimated place that the levels fit; None where they are too few.

        Parameters
        ----------
        track : LevelTrack
        taught : mapping of str to sequence of Taught
            Gains of towers and airframe that other flights taught, by tower; none for those of its own log.
        """
        if len(track.level_db) < FEWEST:
            return None
        towers = list(self.site.towers.values())
        listed = [place for place in self.listed if self._near(place.latitude_deg, place.longitude_deg)]
        at = [np.asarray(tower.position_m) for tower in towers] + [self._local(place) for place in listed]
        odds = place_odds(track, np.array(at))
        odds_tower, odds_listed = odds[: len(towers)].copy(), odds[len(towers) :]
        # the search takes longer than all else: only where a tower's antennas or a place of its own need it
        estimate = locate(track) if any(taught.values()) or odds_tower.max() < _TOWER_ODDS else None
        known = np.full(len(towers), -np.inf)
        for i, tower in enumerate(towers):
            gains = taught.get(tower.name, ()) if estimate is not None else ()
            if gains := [each for each in gains if self._supports(track, tower.name, each)]:
                taught_odds = max(self._taught_odds(track, tower.name, each) for each in gains) - np.log(len(gains))
                # as odds against any place, like those of the search
                taught_odds -= estimate.anywhere + _TAUGHT_MORE
                known[i] = taught_odds if taught_odds >= _TOWER_ODDS else -np.inf
                odds_tower[i] = max(odds_tower[i], taught_odds)
        if len(listed) and odds_listed.max() >= max(_LISTED_ODDS, odds_tower.max()):
            # a list of rover places holds neighbours some metres apart: all likely lines are named
            order = np.argsort(-odds_listed)
            place, least = listed[order[0]], odds_listed[order[0]] - _UNDECIDED
            undecided = [listed[i] for i in order[1:] if odds_listed[i] > least]
            also = "".join(f" or line {tie.line}" for tie in undecided)
            about = f"line {place.line} of {place.file}{also}: is the node there?"
            return self._node(self._local(place), place.latitude_deg, place.longitude_deg, 1.5, about)
        best = int(odds_tower.argmax())
        if odds_tower[best] >= _TOWER_ODDS:
            how = "with the antennas that flights taught" if odds_tower[best] > odds[best] else "as well as any place"
            near = [i for i in np.argsort(-odds_tower) if odds_tower[i] > odds_tower[best] - _UNDECIDED]
            alike = [towers[i].name for i in near]
            # a part of a flight that circles no tower fits several: that with learned antennas is the likeliest
            name = towers[max(near, key=lambda i: (known[i], towers[i].name in taught))].name
            asked = "is it this tower?" if len(alike) == 1 else f"is it {name}?"
            return Placement(name, None, f"the levels fit {' or '.join(alike)} {how}: {asked}")
        assert estimate is not None  # no tower stands
        latitude, longitude = self.site.frame.to_geographic(estimate.place_m[:1], estimate.place_m[1:2])
        apart = [float(np.hypot(*(np.asarray(t.position_m) - estimate.place_m)[:2])) for t in towers]
        near = [t.name for t, d in zip(towers, apart, strict=True) if d <= estimate.radius90_m]
        decided = f"the levels decide for no tower ({', '.join(near)} possible)" if near else "no tower fits the levels"
        about = (
            f"{decided}. They fit this place best, 90 % within {estimate.radius90_m:.0f} m, "
            f"path-loss exponent {estimate.slope:.1f} +- {2 * estimate.slope_sd:.1f}: where did the node stand?"
        )
        place = estimate.place_m
        node = self._node(place, float(latitude[0]), float(longitude[0]), float(place[2]), about)
        return replace(node, radius_m=estimate.radius90_m)

    def _supports(self, track: LevelTrack, tower: str, gains: Taught) -> bool:
        """Check whether levels support the learned antennas of a tower against a gain of their own."""
        if gains.moments is None or track.rotation is None:
            return True
        place = self.site.towers[tower].position_m
        at_uav, at_tower = link_directions(place, track.position_m, track.rotation)
        free = free_space_dbm(place[None, :], track.position_m, CARRIER_HZ, POWER_DBM)[:, 0]
        level = np.where(track.below, np.nan, track.level_db)
        samples = LinkSamples("", tower, "", track.time_s, track.position_m, at_uav, at_tower, level - free)
        odds = FlightEvidence([samples]).of_link(0, gains.moments)
        return odds.over_own >= LEAST_ODDS and odds.over_turned > 0.0

    def _taught_odds(self, track: LevelTrack, tower: str, gains: Taught) -> float:
        """Log evidence of a tower with the antennas at both ends that flights taught."""
        place, gain_db = self.site.towers[tower].position_m[None, :], self._gain_db(track, gains.uav, gains.tower)
        return float(fit_places(replace(track, airframe_db=gain_db), place, gains.model).evidence[0])

    def _gain_db(
        self, track: LevelTrack, airframe: MeasuredPattern, node: MeasuredPattern | None = None
    ) -> Callable[[FloatArray], FloatArray]:
        """Gain of an airframe, and of a node, at each level of a track towards unit vectors (m, n, 3)."""

        def gain_db(towards: FloatArray) -> FloatArray:
            assert track.rotation is not None
            uav_db = airframe.gain_dbi(*sphere_angles(np.einsum("nji,mnj->mni", track.rotation, towards)))
            return uav_db if node is None else uav_db + node.gain_dbi(*sphere_angles(-towards))

        return gain_db

    def evidence(self, stream: Stream) -> float:
        """Log evidence a bin of levels along this track at the best tower; -inf where they are too few."""
        track = self.levels(stream)
        if len(track.level_db) < _FEWEST_OF_VEHICLE:
            return -np.inf
        towers = [tower.position_m for tower in self.site.towers.values()]
        return float(fit_places(track, towers, _NEAR_FREE_SPACE).evidence.max()) / len(track.level_db)

    def contradiction(self, track: LevelTrack, node: str) -> str | None:
        """Tower that the levels fit far better than the one that is named; None where none does."""
        if node not in self.site.towers or len(track.level_db) < FEWEST:
            return None
        names = list(self.site.towers)
        evidence = fit_places(track, [self.site.towers[name].position_m for name in names]).evidence
        best = int(evidence.argmax())
        return names[best] if evidence[best] > evidence[names.index(node)] + CONTRADICTED else None

    def offset_db(self, track: LevelTrack, node: str) -> float | None:
        """Median of free space over the draft's link minus the level [dB]; None for an unknown node."""
        place = self.nodes.get(node)
        if node in self.site.towers:
            place = self.site.towers[node].position_m
        if place is None or not len(track.level_db):
            return None
        free = free_space_dbm(place[None, :], track.position_m, CARRIER_HZ, POWER_DBM)[:, 0]
        return float(np.median(free - track.level_db))

    def _node(self, place: FloatArray, latitude: float, longitude: float, height: float, about: str) -> Placement:
        # two channels of one rover are placed some metres apart
        same = [name for name, placed in self.nodes.items() if np.hypot(*(placed[:2] - place[:2])) < 100.0]
        name = same[0] if same else "NODE" + (str(len(self.nodes) + 1) if self.nodes else "")
        tower = {"latitude_deg": round(latitude, 7), "longitude_deg": round(longitude, 7), "antenna_height_m": height}
        if same:
            return Placement(name, None, "")
        self.nodes[name] = place
        return Placement(name, tower, about)

    def _local(self, place: ListedPlace) -> FloatArray:
        east, north = self.site.frame.to_local(np.array([place.latitude_deg]), np.array([place.longitude_deg]))
        return np.array([east[0], north[0], 1.5])

    def _near(self, latitude_deg: float, longitude_deg: float) -> bool:
        if not len(self.track):
            return False
        start = self.track.pose_at(np.array([self.track.start_ns], dtype="datetime64[ns]")).position_m[0]
        # a list may hold angles that are none
        with np.errstate(invalid="ignore"):
            east, north = self.site.frame.to_local(np.array([latitude_deg]), np.array([longitude_deg]))
        return bool(np.hypot(east[0] - start[0], north[0] - start[1]) < NEAR_M)
