"""Replay the series of a flight: poses from the track, one replay per tower and link, foliage as asked."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..common.units import BoolArray, FloatArray
from ..flight.data import FlightData, RssSeries, Times, rank_positions
from ..flight.lag import estimate_lag
from ..flight.track import TrackPoses
from ..propagation.arrays import Link, Poses, rotation_from_aircraft
from ..propagation.crowns import Crowns
from ..propagation.foliage import CrownIndex, foliage_depth_m, foliage_loss_db, foliage_model
from ..propagation.paths import PathSet
from ..propagation.tracer import Loss, Replay, replay

Progress = Callable[[str], None]

COHERENT_STEP_S = 0.02
"""Sampling of the coherent prediction: two-ray ripples near a tower pass within 0.05 s at 10 m/s."""


@dataclass(frozen=True, slots=True)
class Clock:
    """Radio clock against telemetry clock of one series.

    ``shift_s`` is how much more the radio clock shows, ``shift_ci95_s`` its interval; ``drift`` in s/s; ``applied_s``
    (n,) is what was taken off the radio times before the replay.
    """

    shift_s: float
    shift_ci95_s: tuple[float, float]
    drift_s_per_s: float
    verdict: str
    reason: str
    applied: str
    applied_s: FloatArray


@dataclass(frozen=True, slots=True)
class Replayed:
    """One series, replayed: ``valid`` (n,) says at which samples a pose was known; the replay has those only."""

    link: Link
    poses: Poses
    valid: BoolArray
    replay: Replay
    track: TrackPoses | None
    clock: Clock | None = None

    def spread(self, values: FloatArray, fill: float = np.nan) -> FloatArray:
        """Values per replayed pose, put back at their samples (n,)."""
        return _spread(self.valid, values, fill)


def _spread(valid: BoolArray, values: FloatArray, fill: float = np.nan) -> FloatArray:
    out = np.full(len(valid), fill, dtype=np.result_type(values.dtype, np.float64))
    out[valid] = values
    return out


def replay_rss(data: FlightData, progress: Progress, clocks: list[Clock | None] | None = None) -> list[Replayed]:
    """Replay every RSS series; series of one tower with equal links are replayed together."""
    groups: dict[tuple[str, str], list[int]] = {}
    for index, series in enumerate(data.rss):
        groups.setdefault((series.tower, series.settings_key), []).append(index)
    shifts = clocks or [None] * len(data.rss)
    out: dict[int, Replayed] = {}
    for members in groups.values():
        tower = data.rss[members[0]].tower
        link = data.rss[members[0]].link.build([tower], data.folder)
        tracks = [_track_poses(data, telemetry_time(data.rss[i].time, shifts[i])) for i in members]
        poses = [_poses(data, track) for track in tracks]
        joined = Poses(np.concatenate([p.position_m for p in poses]), np.concatenate([p.rotation for p in poses]))
        progress(f"replay RSS {tower}: {len(joined)} poses")
        whole = _replay(data, link, joined, progress)
        start = 0
        for index, track, part in zip(members, tracks, poses, strict=True):
            stop = start + len(part)
            out[index] = Replayed(link, part, track.valid, part_of(whole, start, stop), track, shifts[index])
            start = stop
    return [out[i] for i in range(len(data.rss))]


def telemetry_time(time: Times, clock: Clock | None) -> Times:
    """Radio times on the telemetry's clock."""
    if clock is None:
        return time
    return np.asarray(time - np.round(clock.applied_s * 1e9).astype("timedelta64[ns]"))


def estimate_clocks(data: FlightData, progress: Progress) -> list[Clock | None]:
    """Clock of each RSS series against the telemetry, as ``rss.lag`` asks.

    Predictions are the image engine's RSS along the track with at most one reflection.
    """
    wanted = data.settings.rss.lag
    if wanted == "off" or data.track is None:
        return [None] * len(data.rss)
    out: list[Clock | None] = []
    predict = _Predictions(data)
    for series in data.rss:
        if isinstance(wanted, float):
            applied = np.full(len(series.time), wanted)
            out.append(Clock(wanted, (wanted, wanted), 0.0, "given", "", "given in flight.yaml", applied))
            continue
        progress(f"clock {series.tower} {series.channel}")
        out.append(_estimated_clock(data, series, predict, apply=wanted == "apply"))
    return out


class _Predictions:
    """Image-engine RSS along the track; channels with one link that were sampled together share the replay."""

    def __init__(self, data: FlightData) -> None:
        self._data = data
        self._kept: dict[tuple[str, str, bytes], dict[str, FloatArray]] = {}

    def __call__(self, series: RssSeries, field: str, times: Any) -> FloatArray:
        """Level ``rss_dbm`` or ``rss_power_dbm`` at instants (n,) [dBm]; NaN without a pose or path."""
        key = (series.tower, series.settings_key, np.asarray(times).tobytes())
        if key not in self._kept:
            data, track = self._data, _track_poses(self._data, times)
            link, poses = series.link.build([series.tower], data.folder), _poses(data, track)
            found = replay(data.site, link, poses, engine="image", max_depth=min(data.settings.rt.max_depth, 1))
            self._kept = {k: v for k, v in self._kept.items() if k[0] == series.tower}  # towers come one after another
            levels = {"rss_dbm": found.rss_dbm[:, 0], "rss_power_dbm": found.rss_power_dbm[:, 0]}
            self._kept[key] = {name: _spread(track.valid, level) for name, level in levels.items()}
        return self._kept[key][field]


def _estimated_clock(data: FlightData, series: RssSeries, predictions: _Predictions, *, apply: bool) -> Clock:
    """Lag by the coherent replay and by its power sum; the one that leaves the smaller residual decides.

    Interference of direct and ground path pins a clock to milliseconds where the field shows it. Where it does not
    (directive antennas, rough ground), its wrong ripple finds a sharp optimum anywhere: measured on real flights.
    """

    def predictor(field: str) -> Callable[[Any], FloatArray]:
        return lambda times: predictions(series, field, times)

    measured = series.measured_db
    if data.settings.rss.minimum_height_m is not None:
        with np.errstate(invalid="ignore"):
            low = ~(_track_poses(data, series.time).position_m[:, 2] >= data.settings.rss.minimum_height_m)
        measured = np.where(low, np.nan, measured)
    window = data.settings.rss.lag_window_s
    fits = {
        name: estimate_lag(series.time, measured, predictor(field), window_s=window, resolution_s=resolution)
        for name, field, resolution in (
            ("coherent replay", "rss_dbm", COHERENT_STEP_S),
            ("power sum of the replay", "rss_power_dbm", 0.1),
        )
    }
    by = min(fits, key=lambda name: np.nan_to_num(fits[name].rmse_db, nan=np.inf))
    fit = fits[by]
    elapsed = (series.time - series.time.min()) / np.timedelta64(1, "s") if len(series.time) else np.zeros(0)
    used = apply and fit.verdict == "ok"
    # the fit's lag is added to radio times; users think of how much the radio clock shows too much
    shift = -(fit.lag_s + fit.drift_s_per_s * (elapsed - fit.reference))
    return Clock(
        shift_s=-fit.lag_s,
        shift_ci95_s=(-fit.interval_s[1], -fit.interval_s[0]),
        drift_s_per_s=-fit.drift_s_per_s,
        verdict=fit.verdict,
        reason=f"by the {by}" + (f": {fit.reason}" if fit.reason else ""),
        applied="estimated and applied" if used else "estimated, not applied",
        applied_s=shift if used else np.zeros(len(series.time)),
    )


def part_of(whole: Replay, start: int, stop: int) -> Replay:
    """The replay of poses ``start`` to ``stop``."""
    paths = whole.paths
    chosen = (paths.pose >= start) & (paths.pose < stop)
    share = (stop - start) / max(len(whole.rss_dbm), 1)
    return dataclasses.replace(
        whole,
        rss_dbm=whole.rss_dbm[start:stop],
        rss_power_dbm=whole.rss_power_dbm[start:stop],
        h=whole.h[start:stop],
        has_path=whole.has_path[start:stop],
        paths=dataclasses.replace(paths.select(chosen), pose=paths.pose[chosen] - start),
        seconds=whole.seconds * share,
        search_seconds=whole.search_seconds * share,
    )


def replay_rank(data: FlightData, progress: Progress) -> list[Replayed]:
    """Replay every rank series with the arrays of ``link.rank``."""
    out = []
    for series in data.rank:
        link = data.settings.link.rank.build([series.tower], data.folder)
        position, valid = rank_positions(series, data.track)
        track = None if series.position_m is not None else _track_poses(data, series.time)
        rotation = np.broadcast_to(np.eye(3), (len(position), 3, 3))
        if track is not None:
            rotation = attitude_rotation(track, data.settings.rt.attitude)
        poses = Poses(position[valid], np.ascontiguousarray(rotation[valid]))
        progress(f"replay rank {series.tower}: {len(poses)} poses")
        out.append(Replayed(link, poses, valid, _replay(data, link, poses, progress), track))
    return out


def _track_poses(data: FlightData, time: Any) -> TrackPoses:
    assert data.track is not None
    return data.track.pose_at(time)


def attitude_rotation(track: TrackPoses, mode: str) -> FloatArray:
    """Body rotations (n, 3, 3) as a value of ``rt.attitude`` wants them."""
    if mode == "ignored":
        return np.broadcast_to(np.eye(3), (len(track), 3, 3))
    if mode == "logged":
        return track.rotation
    heading = np.where(track.valid, track.heading_deg, 0.0)
    return rotation_from_aircraft(np.zeros_like(heading), np.zeros_like(heading), heading)


def _poses(data: FlightData, track: TrackPoses) -> Poses:
    rotation = np.ascontiguousarray(attitude_rotation(track, data.settings.rt.attitude)[track.valid])
    return Poses(track.position_m[track.valid], rotation)


def _replay(data: FlightData, link: Link, poses: Poses, progress: Progress) -> Replay:
    rt = data.settings.rt
    name = f"{rt.engine} {'+'.join(link.tower_arrays)}"
    return replay(
        data.site,
        link,
        poses,
        engine=rt.engine,
        max_depth=rt.max_depth,
        samples=rt.samples,
        batch=rt.batch,
        loss=path_loss(data, link.carrier_hz),
        crowns=reflecting_crowns(data),
        cache_dir=None if rt.cache else "",
        relevance_db=rt.relevance_db,
        # the image engine is done before a bar could be seen
        progress=(lambda share: progress(f"{name} {100 * share:.0f} %")) if rt.engine == "sionna" else None,
    )


def reflecting_crowns(data: FlightData) -> Crowns | None:
    """Crowns that reflect: those of ``foliage: opaque``, unless ``rt.crown_reflections`` is off."""
    rt = data.settings.rt
    wanted = rt.foliage == "opaque" and rt.crown_reflections and len(data.site.trees) > 0
    return Crowns(data.site.trees) if wanted else None


def path_loss(
    data: FlightData, carrier_hz: float, *, foliage: str | None = None, leaves: str | None = None
) -> Loss | None:
    """Loss per path besides the field's own: foliage (by ``rt`` or the arguments) and ``rt.reflection_loss_db``."""
    through = _foliage_loss(data, carrier_hz, foliage or data.settings.rt.foliage, leaves or data.settings.rt.leaves)
    per_reflection = data.settings.rt.reflection_loss_db
    if per_reflection == 0.0:
        return through

    def loss(paths: PathSet, sources_m: FloatArray, targets_m: FloatArray) -> FloatArray:
        trees = 0.0 if through is None else through(paths, sources_m, targets_m)
        return np.asarray(trees + per_reflection * paths.depth, dtype=np.float64)

    return loss


def _foliage_loss(data: FlightData, carrier_hz: float, foliage: str, leaves: str) -> Loss | None:
    rt = data.settings.rt
    if len(data.site.trees) == 0 or (foliage == "none" and rt.foliage != "opaque"):
        return None  # where opaque crowns reflect, a run without trees has to lose those paths
    name = rt.foliage_model if foliage == "attenuating" else foliage
    own = leaves == rt.leaves  # numbers of the flight file belong to its own season
    model = foliage_model(
        name,
        carrier_hz,
        in_leaf=leaves == "in",
        gamma_db_per_m=rt.gamma_db_per_m if own else None,
        maximum_db=rt.maximum_loss_db if own else None,
    )
    index = CrownIndex(data.site.trees)

    def loss(paths: PathSet, sources_m: FloatArray, targets_m: FloatArray) -> FloatArray:
        source, target = sources_m[paths.tower], targets_m[paths.pose]
        return foliage_loss_db(source, paths.vertices_m, target, index, model, paths.tree)

    return loss


def direct_foliage_m(data: FlightData, tower: str, replayed: Replayed) -> FloatArray:
    """Length of the direct line inside tree crowns at the replayed poses (n,) [m]."""
    target = replayed.poses.position_m
    source = np.broadcast_to(data.site.towers[tower].position_m, target.shape)
    return foliage_depth_m(source, np.zeros((len(target), 0, 3)), target, data.site.trees)
