"""Likely cause of a flight's error: the evidence from its replayed series, and causes that are visible in the logs."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import product
from typing import TypeVar

import numpy as np

from ..common.units import FOOT_M, AnyArray, FloatArray
from ..compare import level as rss
from ..compare.causes import CATCH_ALL, OF_DIRECTION, SHOWN_DB, flight_cause, gains_by_direction, slow_levels
from ..compare.evidence import LevelEvidence
from ..compare.gains import turned
from ..compare.result import OK, Cause, RssResult
from ..compare.verdict import lock_lost, pooled_db, without_copies
from ..flight.data import FlightData, RssSeries, Times
from ..flight.gains import mean_gain_db
from ..flight.replay import FlightReplay, Replayed, attitude_rotation, telemetry_time
from ..flight.track import MISREAD
from ..logs.limits import path_of
from ..logs.records import Stream
from ..propagation.field.baselines import free_space_dbm
from ..site.antennas import Isotropic
from ..site.learned import LearnedSeries, SpherePattern
from ..site.site import Site

_Key = TypeVar("_Key")
_ANGLES_DEG = tuple(float(angle) for angle in range(10, 360, 10))
# Errors of the height that are tried [m]. The errors are closer together downwards, because levels change faster near
# the ground.
_RISES_M = (-150.0, -125.0, -100.0, -75.0, -60.0, -40.0, -25.0, -15.0, 15.0, 25.0, 40.0, 60.0, 100.0, 150.0)


def cause_of(data: FlightData, replays: FlightReplay, results: Sequence[RssResult]) -> tuple[Cause | None, str | None]:
    """Return the likely cause of the error of a flight, or the next step if there is no cause.

    Channels that are not scored and towers that move are not considered. The next step is a calibration if a gain over
    the directions of the UAV's antenna explains a part of the error and no learned antennas are used.

    Parameters
    ----------
    data : FlightData
    replays : FlightReplay
    results : sequence of RssResult
        Compared series.

    Returns
    -------
    Cause or None, str or None
    """
    telemetry = [stream for file in data.files for stream in file.result.streams if stream.kind == "telemetry"]
    if any(map(is_simulated, telemetry)):
        return SIMULATED, None
    meant = [meaning for stream in telemetry if (meaning := heights_meant(stream)) is not None]
    if meaning := next(filter(None, meant), ""):
        sentence = f"Likely cause: {meaning}, by the logged vertical speed."
        return Cause(name="telemetry", sentence=sentence, next_step="check the telemetry's columns and units"), None
    names = {result.name for result in without_copies(results)}  # the antennas of a copy belong to another channel
    compared = [
        (series, replayed, result)
        for series, replayed, result in zip(data.rss, replays.rss, results, strict=True)
        if replayed.tower_m is None and not result.training and result.name in names
    ]
    scores = [result.score for _, _, result in compared if result.score.n]
    if scores and pooled_db([score.rmse_db for score in scores], [score.n for score in scores]) < _GOOD_DB:
        return None, None
    rotations: dict[tuple[str, bytes], FloatArray] = {}
    evidence = [_evidence(data, *each, rotations=rotations, scaled=not meant) for each in compared]
    cause = flight_cause(evidence)
    late = _late_clock(evidence)
    by_direction = cause is None or any(name in OF_DIRECTION for name in cause.name.split(" or "))
    # name a wrong clock rather than an antenna pattern, because the clock test allows for gains over directions. The
    # test does not allow for obstacles.
    if late is not None and (cause is None or CATCH_ALL in cause.name.split(" or ")):
        return late, None
    # errors that depend on direction are expected if a named antenna could not be used; a caution contains the reason
    if any(not c.used for c in data.settings.cautions) and by_direction:
        return None, "see the first caution: a learned antenna that the flight file names is not used"
    estimated = [name for name, node in data.settings.towers.items() if node.region90_m is not None]
    if estimated and by_direction:
        return None, f"enter the measured position of {' and '.join(estimated)} in `towers:`"
    # learned antennas, of the flight file or of `report --with`, have an error of some decibels on each flight
    if cause is not None or any(e.antenna == "learned" for e in evidence) or not gains_by_direction(evidence):
        return cause, None
    return None, _CALIBRATE


def _late_clock(evidence: Sequence[LevelEvidence]) -> Cause | None:
    """Return the radio clocks that are wrong, if correcting them lowers the printed error of their towers."""
    late: dict[str, list[str]] = {}
    for tower in dict.fromkeys(e.tower for e in evidence):
        here = [e for e in evidence if e.tower == tower]
        clock = here[0].clock
        if clock is None or not clock.shifted:
            continue
        low, high = clock.ci95_s
        # if the interval is wider than the lag, the levels may be late in only a part of the flight
        if high - low <= abs(clock.radio_minus_telemetry_s) and fall_without_lag_db(here) >= SHOWN_DB:
            late.setdefault(clock.in_words, []).append(tower)
    if not late:
        return None
    found = {tower for each in late.values() for tower in each}
    right = sorted({e.tower for e in evidence if e.clock is not None and e.clock.verdict == OK})
    lags = [f"The radio clock at {', '.join(each)} is {words}" for words, each in late.items()]
    only = f"; those at {', '.join(right)} are right" if right else ""
    return Cause(
        name="clock",
        sentence=f"{'. '.join(lags)}{only}.",
        next_step="`rss: {lag: apply}`",
        channels=tuple(e.name for e in evidence if e.tower in found),
    )


def fall_without_lag_db(channels: Iterable[LevelEvidence]) -> float:
    """Return the reduction of the RMSE of some channels by a correction of their clock lags [dB].

    The result is 0 unless the RMSE is also reduced after a share of the slow level was fitted. A gain control reduces
    slow changes of the level, so that the remaining changes seem to be early.
    """
    squares = list[list[AnyArray]]()  # errors of each channel, first without a gain control, then with each
    for e in channels:
        lag = 0.0 if e.clock is None else e.clock.radio_minus_telemetry_s
        known = np.isfinite(e.measured_db) & np.isfinite(e.predicted_db)
        time_s, level_db = e.time_s[known], e.predicted_db[known]
        if not len(time_s):
            continue
        errors_db = e.measured_db[known] - np.stack([level_db, np.interp(time_s - lag, time_s, level_db)])
        fitted = (np.zeros(len(time_s)), *slow_levels(time_s, level_db))
        designs = (np.column_stack([np.ones(len(time_s)), slow]) for slow in fitted)
        squares.append([np.square(errors_db.T - x @ np.linalg.lstsq(x, errors_db.T, rcond=None)[0]) for x in designs])
    if not squares:
        return 0.0
    of_models = (np.sqrt(np.concatenate(model).mean(axis=0)) for model in zip(*squares, strict=True))
    fall_db, *others_db = (float(before - after) for before, after in of_models)
    return fall_db if min(others_db) > 0.0 else 0.0


_CALIBRATE = "`aerpaw-cmp calibrate FLIGHT FLIGHT` with two flights of this site"


def is_simulated(telemetry: Stream) -> bool:
    """Check whether receiver and battery belong to ArduPilot's simulator, which AERPAW's emulator runs.

    The log must contain at least two of its signs (fix 6, 10 satellites, few battery voltages), and contradict none.
    """
    rows = telemetry.frame
    if len(rows) < _FEWEST_ROWS:
        return False
    signs = [bool((rows[name] == value).all()) for name, value in _RECEIVER.items() if (rows[name] >= 0).any()]
    if "battery_v" in rows and len(rows) >= _FEWEST_VOLTAGES:
        volts = rows["battery_v"].dropna().to_numpy()
        # skip logs with steps of 0.1 V, in which any battery has few different voltages
        if len(volts) and (np.abs(volts * 10.0 - np.round(volts * 10.0)) > 1e-6).any():
            commonest = np.sort(np.unique(volts, return_counts=True)[1])[-3:]
            signs.append(bool(commonest.sum() >= _SHARE_OF_VOLTAGES * len(volts)))
    return len(signs) > 1 and all(signs)


_RECEIVER = {"fix": 6, "satellites": 10}
# Smallest numbers of rows for the tests of constant columns and of voltages, and share of the rows that have one of the
# three most frequent voltages. For the simulator's battery, the share was 97 % on one flight. On a real battery, no
# single voltage has more than 5 % of the rows.
_FEWEST_ROWS, _FEWEST_VOLTAGES, _SHARE_OF_VOLTAGES = 4, 15, 0.8

SIMULATED = Cause(
    name="emulator",
    sentence="A simulator wrote the log: receiver and battery (fix 6, 10 satellites, few voltages) are ArduPilot's.",
    next_step="do not draw conclusions about the site from this flight",
)


def heights_meant(telemetry: Stream) -> str | None:
    """Return a clause about the unit of logged heights if their changes do not fit the logged vertical speed.

    The text is empty if the changes fit, and if a height jumps, which no unit explains. Return None if the speeds do
    not determine the unit.
    """
    rows, time_s, place_m = path_of(telemetry.frame)
    speed_mps = telemetry.frame[list(_SPEED)].to_numpy(np.float64)[rows] * [1.0, 1.0, -1.0]
    # skip rows that repeat a position
    moved = (np.diff(place_m, axis=0, prepend=math.nan) != 0.0).any(axis=1)
    if (np.abs(np.diff(place_m[moved, 2])) > _JUMP_M + _FASTEST_MPS * np.abs(np.diff(time_s[moved]))).any():
        return ""
    step_s, flown = np.diff(time_s)[:, None], np.diff(place_m, axis=0)
    expected = 0.5 * (speed_mps[1:] + speed_mps[:-1]) * step_s
    near = np.isfinite(expected).all(axis=1) & (step_s[:, 0] > 0.0) & (step_s[:, 0] < _LONG_STEP_S)
    flown, expected = flown[near], expected[near]
    if min(np.abs(expected[:, :2]).sum(), np.abs(expected[:, 2]).sum()) < _LEAST_PATH_M:
        return None
    # compare with the ratio along the ground, because a wrong unit of the speeds changes both ratios
    along, upwards = (
        (flown[:, axes] * expected[:, axes]).sum() / np.square(expected[:, axes]).sum() for axes in (slice(2), 2)
    )
    if upwards * (flown[:, 2] @ expected[:, 2]) <= _LEAST_FIT * (flown[:, 2] @ flown[:, 2]):
        return None
    meanings = {"": 1.0, **_HEIGHTS}
    return next((m for m, to_m in meanings.items() if abs(upwards * to_m - along) < _SAME_RATIO * along), None)


# Factor that converts the heights to metres, by their meaning.
_HEIGHTS = {"the logged heights are in feet": FOOT_M, "the logged heights were divided by 3.28": 1.0 / FOOT_M}
# In four field logs, heights change by 0.90 to 1.00 of the logged speed. Time steps longer than the third number [s]
# are not used, because the path within them is unknown.
_SAME_RATIO, _LEAST_FIT, _LONG_STEP_S, _LEAST_PATH_M = 0.2, 0.5, 3.0, 10.0
# A UAV climbs with at most 6 m/s, which are 20 m/s if feet are read as metres.
_JUMP_M, _FASTEST_MPS = 5.0, 25.0
_SPEED = ("velocity_east_mps", "velocity_north_mps", "velocity_down_mps")


# No cause is searched for if the RMSE is below this [dB], because receivers and positions are not more accurate.
_GOOD_DB = 1.0


def _learned_series(data: FlightData, series: RssSeries) -> LearnedSeries | None:
    """Return the learned antenna of a series, or None without learned antennas at both ends."""
    antennas = data.settings.learned
    named = antennas.get(f"{series.tower}.{series.channel}") if "uav" in antennas else None
    return None if named is None else named.antenna("tower", series.link.carrier_hz)


def _evidence(
    data: FlightData,
    series: RssSeries,
    replayed: Replayed,
    result: RssResult,
    *,
    rotations: dict[tuple[str, bytes], FloatArray],
    scaled: bool = True,
) -> LevelEvidence:
    """Return the evidence of a series, with the levels that the page scores.

    ``scaled`` also tries heights in other units.
    """
    n = len(replayed.poses)
    # changes vary slowly along the track, so compute them at some poses and interpolate
    some = np.zeros(n, dtype=np.bool_)
    some[np.linspace(0, max(n - 1, 0), min(n, _MOST_POSES)).astype(np.int64)] = True
    track = None if replayed.track is None else replayed.track.pick(some)
    thin = dataclasses.replace(replayed, poses=replayed.poses[some], track=track)
    link = _Direct(data.site, series.tower, thin, rotations)
    known_db, known_both_db = link.level(), link.level(tower=True)
    times = telemetry_time(series.time, replayed.clock)[replayed.valid][some]
    time_s = rss.seconds(series.time)
    order = np.argsort(time_s, kind="stable")

    def at_samples(values: FloatArray) -> FloatArray:
        return replayed.spread(values)[order]

    def of_all(values: FloatArray) -> FloatArray:
        return at_samples(np.interp(np.arange(n), np.flatnonzero(some), values) if n else values)

    lock = lock_lost(result)
    simulated_db, floor_db = result.simulated_dbm[order], -math.inf
    measured_db = result.measured_db[order]
    if lock is not None:  # raise both levels to the floor, as the page does
        floor_db, measured_db = lock.floor_db + lock.offset_db, np.maximum(measured_db, lock.floor_db)
    predicted = np.maximum(simulated_db, floor_db)

    def changed(levels_db: Mapping[_Key, FloatArray], known_db: FloatArray = known_db) -> dict[_Key, FloatArray]:
        levels = {key: of_all(level - known_db) + simulated_db for key, level in levels_db.items()}
        return {key: np.maximum(level, floor_db) - predicted for key, level in levels.items()}

    patterns, rotation = replayed.link.uav_array.patterns, replayed.poses.rotation
    kinds = {"learned": any(isinstance(p, SpherePattern) for p in patterns) or replayed.learned is not None,
             "isotropic": all(isinstance(p, Isotropic) for p in patterns), "measured": True}  # fmt: skip
    # isotropic levels do not depend on the attitude, and an unknown gain rotates with the aircraft
    if kinds["isotropic"] and replayed.track is not None and replayed.track.attitude_known.any():
        rotation = replayed.track.rotation
    directions = link.directions(link.place_m, replayed.poses.position_m, rotation)
    return LevelEvidence(
        name=result.name,
        tower=series.tower,
        unit=series.unit,
        start=series.time.min() if len(series.time) else np.datetime64(0, "s"),
        antenna=next(name for name, holds in kinds.items() if holds),
        time_s=time_s[order],
        measured_db=measured_db,
        predicted_db=predicted,
        place_m=result.position_m[order],
        uav_azimuth_deg=at_samples(directions["uav_azimuth_deg"]),
        uav_elevation_deg=at_samples(directions["uav_elevation_deg"]),
        tower_azimuth_deg=at_samples(directions["azimuth_deg"]),
        turned_db=changed(link.turned_db()),
        raised_db=changed(link.raised_db(), known_both_db),
        attitude_db=changed(link.attitude_db(data.settings.rss_attitude)),
        misread_db=changed(link.misread_db(data, times, scaled), known_both_db),
        other_towers_db={name: predicted + change for name, change in changed(link.other_towers_db()).items()},
        towers=frozenset(other.tower for other in data.rss if other.channel == series.channel),
        locked=None if series.locked is None else series.locked[order],
        serving=None if series.serving is None else series.serving[order],
        clock=None if replayed.clock is None else replayed.clock.result,
        limits_known=lock is not None,
        learned=_learned_series(data, series),
        transmit_power_dbm=series.link.transmit_power_dbm,
        distance_db=of_all(link.distance_db),
        displaced_db=changed(link.displaced_db(known_both_db), known_both_db),
        floored=any("floor_db" in data.settings.logs[log].model_fields_set for log in np.unique(series.log)),
    )


@dataclasses.dataclass(frozen=True, slots=True)
class _Direct:
    """The level of the direct path of a series at its poses (m,) [dBm], with the flight's settings and with faults.

    Parameters
    ----------
    rotations : mapping of (str, bytes) to array
        Attitudes by meaning of the telemetry and times. All channels share them.
    """

    site: Site
    tower: str
    replayed: Replayed
    rotations: dict[tuple[str, bytes], FloatArray]

    @property
    def place_m(self) -> FloatArray:
        """The position of the tower, (1, 3) or (m, 3) [m]."""
        return self.replayed.source_m(self.site)

    @property
    def _has_pattern(self) -> bool:
        return not all(isinstance(pattern, Isotropic) for pattern in self.replayed.link.uav_array.patterns)

    def turned_db(self) -> dict[float, FloatArray]:
        """Return levels with the UAV rotated clockwise, by the angle [deg]. Empty for isotropic antennas."""
        rotation = self.replayed.poses.rotation
        # headings count clockwise, angles of a mount counter-clockwise
        angles = _ANGLES_DEG if self._has_pattern else ()
        return {angle: self.level(rotation=turned(-angle) @ rotation) for angle in angles}

    def raised_db(self) -> dict[float, FloatArray]:
        """Return levels with the UAV at other heights, by the difference of height [m]."""
        positions = {rise: self.replayed.poses.position_m + np.array([0.0, 0.0, rise]) for rise in _RISES_M}
        return {
            rise: self.level(position_m=position_m, tower=True)
            for rise, position_m in positions.items()
            if len(position_m) and position_m[:, 2].min() > -_BELOW_GROUND_M
        }

    def attitude_db(self, used: str) -> dict[str, FloatArray]:
        """Return levels with another use of the logged attitude."""
        track = self.replayed.track
        if track is None or not self._has_pattern or not track.attitude_known.any():
            return {}
        modes = {"logged", "ignored"} - {used}
        return {mode: self.level(rotation=attitude_rotation(track, mode)) for mode in sorted(modes, reverse=True)}

    @property
    def distance_db(self) -> FloatArray:
        """The level of free space alone."""
        link = self.replayed.link
        position_m = self.replayed.poses.position_m
        return np.asarray(free_space_dbm(self.place_m, position_m, link.carrier_hz, link.transmit_power_dbm)[:, 0])

    def displaced_db(self, known_db: FloatArray) -> dict[tuple[float, float], FloatArray]:
        """Return levels with the tower moved, by distance [m] and azimuth [deg] of the move.

        ``known_db`` is the level with the tower at its position.
        """
        poses = self.replayed.poses
        n = len(poses.position_m)
        if not n:
            return {}
        # a change varies slowly along the track, so interpolate between some poses
        at = np.unique(np.linspace(0, n - 1, min(n, _DISPLACED_POSES)).astype(np.int64))
        keys = [*product(_RADII_M, _AZIMUTHS_DEG)]
        radii, turns = np.array(keys).T * [[1.0], [math.pi / 180.0]]
        offset_m = np.column_stack([radii * np.sin(turns), radii * np.cos(turns), np.zeros(len(keys))])
        level_db = self.level(
            place_m=np.repeat(self.place_m + offset_m, len(at), axis=0),
            position_m=np.tile(poses.position_m[at], (len(keys), 1)),
            rotation=np.tile(poses.rotation[at], (len(keys), 1, 1)),
            tower=True,
        )
        changes = level_db.reshape(len(keys), -1) - known_db[at]
        return {key: known_db + np.interp(np.arange(n), at, change) for key, change in zip(keys, changes, strict=True)}

    def misread_db(self, data: FlightData, time: Times, scaled: bool) -> dict[str, FloatArray]:
        """Return levels with another meaning of the telemetry, at the times of the poses (m,).

        ``scaled`` adds heights in another unit.
        """
        position_m, track, used = self.replayed.poses.position_m, self.replayed.track, data.settings.rss_attitude
        if data.track is None or track is None:
            return {}
        begin_m = data.track.pose_at(np.array([data.track.start_ns], dtype="datetime64[ns]")).position_m[0, :2]
        mirrored_m = np.column_stack([begin_m + (position_m[:, :2] - begin_m)[:, ::-1], position_m[:, 2]])
        # without a logged attitude, level flight along the course is assumed, so mirror the course as well
        course = used != "ignored" and not track.attitude_known.any()
        rotation = turned(90.0) @ self.replayed.poses.rotation.transpose(0, 2, 1) if course else None
        levels = {_MIRRORED: self.level(position_m=mirrored_m, rotation=rotation, tower=True)}
        if used != "ignored" and self._has_pattern and track.attitude_known.any():
            for meaning in MISREAD:
                # share the attitude between channels with the same times
                key = meaning, time.tobytes()
                if key not in self.rotations:
                    self.rotations[key] = data.track.rotations_if(meaning, time)
                rotation = attitude_rotation(dataclasses.replace(track, rotation=self.rotations[key]), used)
                levels[meaning] = self.level(rotation=rotation, tower=True)
        for meaning, scale in _HEIGHTS.items() if scaled else ():
            ground_m = np.array([0.0, 0.0, data.track.ground_m])
            levels[meaning] = self.level(position_m=ground_m + (position_m - ground_m) * [1.0, 1.0, scale], tower=True)
        return levels

    def other_towers_db(self) -> dict[str, FloatArray]:
        """Return levels from each other tower of the site."""
        towers = self.site.towers.items()
        return {name: self.level(place_m=of.position_m[None, :]) for name, of in towers if name != self.tower}

    def directions(self, place_m: FloatArray, position_m: FloatArray, rotation: FloatArray) -> dict[str, FloatArray]:
        """Return the directions between a position and the UAV, in the frames of both antennas."""
        (tower_array,) = self.replayed.link.tower_arrays.values()
        mounts = {"uav_mount": self.replayed.link.uav_array.mount, "tower_mount": tower_array.mount}
        return rss.link_geometry(place_m, position_m, rotation, **mounts)

    def level(
        self,
        *,
        place_m: FloatArray | None = None,
        position_m: FloatArray | None = None,
        rotation: FloatArray | None = None,
        tower: bool = False,
    ) -> FloatArray:
        """Return free space and the mean gain of the UAV's antenna [dB] with other positions or attitudes.

        ``tower`` adds the gain of the tower's antenna. Set it if the direction from the tower changes.
        """
        link, poses = self.replayed.link, self.replayed.poses
        place_m = self.place_m if place_m is None else place_m
        position_m = poses.position_m if position_m is None else position_m
        at = self.directions(place_m, position_m, poses.rotation if rotation is None else rotation)
        (tower_array,) = link.tower_arrays.values()
        level_db = free_space_dbm(place_m[:, None], position_m, link.carrier_hz, link.transmit_power_dbm)[:, 0]
        for end, array in (("uav", link.uav_array), ("tower", tower_array))[: 1 + tower]:
            theta, phi = np.radians(90.0 - at[f"{end}_elevation_deg"]), np.radians(at[f"{end}_azimuth_deg"])
            level_db = level_db + mean_gain_db(array.patterns, theta, phi)
        return np.asarray(level_db)


_MIRRORED = "east and north of the track are swapped"
# Distances [m] and azimuths [deg] by which the tower is moved, and number of poses at which the levels are computed.
_RADII_M, _AZIMUTHS_DEG = (25.0, 40.0, 65.0, 105.0, 170.0, 275.0), tuple(22.5 * i for i in range(16))
_DISPLACED_POSES = 300
# Number of poses at which the other changes of the level are computed.
_MOST_POSES = 1200
# A wrong datum may place the start of a track below the ground, but not further than this [m].
_BELOW_GROUND_M = 20.0
