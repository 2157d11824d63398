"""Comparison of each replayed series with its measurement, in records of :mod:`aerpaw_cmp.compare.result`.

To add a number per tower and channel, add a field to ``RssFurther`` in that module, and here a function that
:func:`compare_rss_series` calls.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np

from ..common.errors import InputError
from ..common.stages import give_memory_back
from ..common.units import BoolArray, FloatArray, IntArray, spread_out
from ..compare import level as rss
from ..compare import offset as offsets
from ..compare import rank as ranks
from ..compare import result as records
from ..compare import statistics
from ..compare.gains import LostLock, StatedSpread, inside_shares
from ..compare.ladder import log_distance_level_db
from ..compare.level import (
    DetectionForecast,
    DetectionScore,
    ServingComparison,
    at_times,
    compare_serving,
    nearest_in_time,
    score_detection,
)
from ..compare.receiver import ForecastScore, score_forecast
from ..compare.statistics import Visit, memory_share
from ..compare.verdict import flight_verdict, with_corrected_verdicts
from ..flight.data import FlightData, RankSeries, RssSeries
from ..flight.drafting.proposals import ALONE, errors_elsewhere, lock_elsewhere
from ..flight.gains import direct_foliage_m
from ..flight.replay import FlightReplay, Replayed, replay_poses
from ..flight.rows import LOCK_FLOOR_DB
from ..flight.settings import RssSettings, RtSettings
from ..flight.training import learned_here
from ..propagation.field.baselines import free_space_dbm, two_ray_dbm
from ..site.learned import LearnedLock
from ..site.relief import Dem
from ..site.site import Site
from ..site.siteyaml import ground_surface, site_model
from .likely_cause import cause_of

if TYPE_CHECKING:
    from .calibrate_rank import FittedReceiver


# Measured and simulated power are averaged over these windows to see how much of the error is fading [s].
_AVERAGING_WINDOWS_S = (0.0, 1.0, 4.0)

# Largest distance between a pass of the first half and a pass of the second half of a flight at one position [m].
_PASSES_WITHIN_M = 3.0

# Number of random grounds for the error bar of the rank agreement, and number of poses that are replayed over each
# ground.
_DRAWS, _POSES = 6, 300

# Segments of large error that are shorter than this are fades [s].
_SHORTEST_S = 5.0


def compare_flight(data: FlightData, replays: FlightReplay) -> records.FlightResult:
    """Compare every series with its replay, and every two channels of a tower with each other."""
    results = []
    for series, replayed in zip(data.rss, replays.rss, strict=True):
        results.append(compare_rss_series(data, series, replayed))
        give_memory_back()  # a series of ten hours leaves 100 MiB of free fragments
    results = with_corrected_verdicts(results)
    cause, step = cause_of(data, replays, results)
    return records.FlightResult(
        rss=tuple(results),
        verdict=flight_verdict(results),
        likely_cause=cause,
        next_step=step,
        rank=tuple(compare_rank_series(data, s, r) for s, r in zip(data.rank, replays.rank, strict=True)),
        pairs=tuple(pairs_of(results)),
        serving=serving_of(data.rss, results),
    )


# Largest time between a sample and the predicted level of a cell that is used for it [s]. Phones report once a second.
_SERVING_WITHIN_S = 1.5


def serving_of(series: Sequence[RssSeries], results: Sequence[records.RssResult]) -> ServingComparison | None:
    """Compare logged serving cells with the strongest predicted cells, or return None if no log has a serving cell.

    The comparison contains the cells that the flight file assigns to towers, at the times when one of these cells
    served. Simulated levels are used without offsets: cells of one network have equal power, and an offset per cell
    would hide which cell is stronger.
    """
    cells = [(cell, result) for cell, result in zip(series, results, strict=True) if cell.serving is not None]
    if len(cells) < 2 or not any(np.nansum(cell.serving) for cell, _ in cells if cell.serving is not None):
        return None
    start = min(cell.time.min() for cell, _ in cells if len(cell.time))
    times, served = [], []
    for i, (cell, _) in enumerate(cells):
        assert cell.serving is not None
        mine = (cell.time - start)[cell.serving == 1] / np.timedelta64(1, "s")
        times.append(mine)
        served.append(np.full(len(mine), i))
    at = np.concatenate(times)
    predicted = np.full((len(at), len(cells)), np.nan)
    for j, (cell, result) in enumerate(cells):
        order = np.argsort(cell.time, kind="stable")
        seconds = ((cell.time - start) / np.timedelta64(1, "s"))[order]
        predicted[:, j] = at_times(at, seconds, result.simulated_dbm[order], within_s=_SERVING_WITHIN_S)
    return compare_serving(np.concatenate(served), predicted, [f"{cell.tower} {cell.channel}" for cell, _ in cells])


# --- RSS -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class Levels:
    """Measured and simulated levels (n,) [dB].

    ``posed`` is true for samples with a known pose above the lowest height. ``measured_db`` is NaN for all other
    samples.
    """

    measured_db: FloatArray
    simulated_db: FloatArray
    posed: BoolArray


def levels_of(series: RssSeries, replayed: Replayed, settings: RssSettings) -> Levels:
    """Return the levels of a series that are compared, according to ``rss`` in the flight file."""
    posed = replayed.valid.copy()
    if settings.minimum_height_m is not None:
        posed[posed] = replayed.poses.position_m[:, 2] >= settings.minimum_height_m
    level_dbm = replayed.level_dbm("power" if settings.field == "power" else "coherent")
    return Levels(
        measured_db=np.where(posed, series.measured_db, np.nan), simulated_db=replayed.spread(level_dbm), posed=posed
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Case:
    """One tower and channel, with the inputs from which all its numbers are computed.

    ``simple`` contains the baselines at the samples. ``trained`` lists logs of this series from which its antennas were
    learned. A series with such logs is not scored.
    """

    data: FlightData
    series: RssSeries
    replayed: Replayed
    levels: Levels
    position_m: FloatArray
    geometry: Mapping[str, FloatArray]
    simple: Mapping[str, FloatArray]
    trained: tuple[str, ...]


def compare_rss_series(data: FlightData, series: RssSeries, replayed: Replayed) -> records.RssResult:
    """Return offset, RMSE, correlation, intervals and baselines of one tower and channel."""
    settings, case = data.settings.rss, _case(data, series, replayed)
    levels, clock = case.levels, replayed.clock
    score = rss.compare_rss(
        series.time,
        levels.measured_db,
        levels.simulated_db,
        baselines=case.simple,
        posed=levels.posed,
        position_m=case.position_m,
        span_db=settings.span_db,
    )
    if clock is not None:
        also = ("lag_s",) if clock.result.applied == records.APPLIED else ()
        lag_s = clock.result.radio_minus_telemetry_s
        score = dataclasses.replace(score, lag_s=lag_s, fitted_on_scored=(*score.fitted_on_scored, *also))
    direct = replayed.spread(_has_direct(replayed).astype(np.float64), np.nan)
    spans = _worst(case, score.residual_db, direct)
    if case.trained:
        score, spans = rss.without_errors(score), []
    stated = _with_lock(case, score, stated_spread(replayed))
    return records.RssResult(
        tower=series.tower,
        channel=series.channel,
        unit=series.unit,
        time=series.time,
        position_m=case.position_m,
        geometry=case.geometry,
        measured_db=levels.measured_db,
        simulated_dbm=np.where(levels.posed, levels.simulated_db, np.nan),
        posed=levels.posed,
        tower_m=tower_places(replayed),
        line_of_sight=direct,
        score=score,
        baselines=_baselines(case.simple, score),
        spans=tuple(spans),
        further=_further(case, score, stated),
        stated=stated,
    )


def stated_spread(replayed: Replayed) -> StatedSpread | None:
    """Return the error bars that learned antennas state for the direct path, or None if there are no such antennas.

    If only one end is learned, or no file has the joint gain of both ends, the gains of both ends are assumed to be
    independent. They are learned from the same levels, so the true standard deviation is probably smaller.

    Parameters
    ----------
    replayed : Replayed

    Returns
    -------
    StatedSpread or None
    """
    gain = replayed.learned
    if gain is None:
        return None
    return StatedSpread(gain_sd_db=replayed.spread(gain.sd_db), spread=gain.spread)


def _with_lock(case: _Case, score: rss.RssComparison, stated: StatedSpread | None) -> StatedSpread | None:
    """Add the forecast of a receiver that loses its lock to the error bars, if other flights determined it."""
    series, error_db = case.series, score.residual_db
    lock = None if stated is None else _lock(case)
    locked = (series.locked == 1.0) & np.isfinite(error_db)
    if stated is None or lock is None or not locked.any():
        return stated
    simulated_db = case.levels.simulated_db
    above_db = simulated_db - series.link.transmit_power_dbm - lock.gain_db
    expected_db = lock.locked_db + lock.locked_per_db * above_db + score.offset_db - simulated_db
    # if the levels of this flight are stronger than those of other flights at the same path gain, the receiver also
    # loses its lock at a lower path gain
    own_db = (error_db - expected_db)[locked].mean()
    parts = LostLock(
        probability=_forecast(series, lock).probability(simulated_db + own_db),
        locked_db=expected_db + own_db,
        lost_db=lock.lost_db + lock.lost_per_db * (above_db + own_db) + score.offset_db - simulated_db,
        locked_sd_db=lock.locked_sd_db,
        lost_sd_db=lock.lost_sd_db,
    )
    return dataclasses.replace(stated, lock=parts)


def _lock(case: _Case) -> LearnedLock | None:
    """Return the lock model learned from other flights. None if the log has no lock."""
    if case.series.locked is None:
        return None
    return lock_elsewhere(case.data, case.series)


def _forecast(series: RssSeries, lock: LearnedLock) -> DetectionForecast:
    """Return the forecast of P(lock) for the levels of a series."""
    level_db = lock.gain_db + series.link.transmit_power_dbm
    return DetectionForecast(level_db=level_db, per_db=lock.per_db, share=lock.share)


def _case(data: FlightData, series: RssSeries, replayed: Replayed) -> _Case:
    levels = levels_of(series, replayed, data.settings.rss)
    geometry = link_geometry(data.site, series.tower, replayed, data.settings.rt)
    position = replayed.spread(replayed.poses.position_m)
    simple = _baseline_levels(data.site, series.tower, replayed)
    # fit the empirical baselines to levels relative to the mean of free space
    known = np.isfinite(levels.measured_db) & np.isfinite(simple["free_space"])
    mean = float(simple["free_space"][known].mean()) if known.any() else np.nan
    line = log_distance_level_db(levels.measured_db, geometry["distance_m"], position)
    simple |= {"constant": np.where(np.isfinite(line), mean, np.nan), "log_distance": mean + line}
    return _Case(
        data=data,
        series=series,
        replayed=replayed,
        levels=levels,
        position_m=position,
        geometry=geometry,
        simple=simple,
        trained=learned_here(data, series, replayed.link),
    )


def _further(case: _Case, score: rss.RssComparison, stated: StatedSpread | None) -> records.RssFurther:
    """Return counts and conditions, and for a scored series also further statistics of the error.

    Parameters
    ----------
    case : _Case
    score : RssComparison
    stated : StatedSpread, optional
        Error bars from learned antennas.

    Returns
    -------
    RssFurther
    """
    settings, levels, series, replayed = case.data.settings.rss, case.levels, case.series, case.replayed
    wild = rss.outliers(levels.measured_db)
    detection = None if case.trained else _detection(case)
    further = records.RssFurther(
        n_measured_out=score.n_measured_out,
        n_simulated_out=score.n_simulated_out,
        n_too_low=int((replayed.valid & ~levels.posed).sum()),
        n_no_pose=int((~replayed.valid).sum()),
        n_outliers=int(wild.sum()),
        rmse_without_outliers_db=_rmse_without(wild, settings, levels, score),
        n_flagged=dict(series.flagged),
        clock=None if replayed.clock is None else replayed.clock.result,
        baseline_rmse_ci95_db=score.baseline_intervals,
        compared_with={},
        averaged={},
        simulated_sd_db=None if stated is None else float(np.nanmean(stated.total_db)),
        error_bars=None if stated is None else _error_bars(stated, None if case.trained else score.residual_db),
        elsewhere=_elsewhere(case, score, detection),
        trained_on=case.trained or None,
        rmse_bound=_bound(series, score),
        interval_notes=score.intervals.notes or None,
    )
    if case.trained:
        return further
    return dataclasses.replace(
        further,
        compared_with=_paired(levels, case.simple, case.position_m),
        averaged=_averaged(case),
        detection=detection,
        snr=_snr(series, levels),
    )


def _bound(series: RssSeries, score: rss.RssComparison) -> str | None:
    """Return the reason if the interval of the RMSE has no upper end, else None."""
    if not np.isposinf(score.rmse_ci95_db[1]):
        return None
    known = np.isfinite(score.residual_db)
    order = np.argsort(series.time[known], kind="stable")
    time = series.time[known]
    length_s = (time.max() - time.min()) / np.timedelta64(1, "s")
    correlated_s = memory_share(score.residual_db[known][order]) * length_s
    return f"the flight is too short: its errors are correlated over {correlated_s:.0f} s"


def _rmse_without(wild: BoolArray, settings: RssSettings, levels: Levels, score: rss.RssComparison) -> float:
    """Return the RMSE without the outliers ``wild``, after a separate offset."""
    if not wild.any():
        return score.rmse_db
    inliers_db = np.where(wild, np.nan, levels.measured_db)
    return offsets.grid_offset(inliers_db, levels.simulated_db, span_db=settings.span_db).rmse_db


def _elsewhere(case: _Case, score: rss.RssComparison, detection: DetectionScore | None) -> dict[str, Any] | None:
    """Return the expected error on another flight of the same kind, unless this flight contradicts it."""
    gain = case.replayed.learned
    flown = None if gain is None else (case.replayed.poses.position_m, gain.sd_db)
    errors, kind = errors_elsewhere(case.data.settings.learned, case.series, flown)
    # the lock model of a receiver applies only with the antennas of its training flights
    lock = None if kind == ALONE else _lock(case)
    if errors is not None and score.rmse_ci95_db[0] > errors.rmse_db:
        return None
    if lock is not None and detection is not None and detection.rmse_ci95_db[0] > lock.floor_rmse_db:
        return None
    out: dict[str, Any] = {}
    if errors is not None:
        out["kind"] = kind
        out["rmse_db"], out["free_space_rmse_db"] = errors.rmse_db, errors.free_space_rmse_db
        out["rmse_4s_db"] = errors.rmse_4s_db
    if lock is not None:
        out["floor_rmse_db"], out["free_space_floor_rmse_db"] = lock.floor_rmse_db, lock.free_space_floor_rmse_db
    return out or None


def _error_bars(stated: StatedSpread, residual_db: FloatArray | None) -> dict[str, float]:
    """Return the parts of the stated standard deviation [dB], and the shares of scored samples in its intervals."""
    parts = {"gain_sd_db": float(np.nanmean(stated.gain_sd_db)), **dataclasses.asdict(stated.spread)}
    if residual_db is None:
        return parts
    return parts | inside_shares(residual_db, stated) | {"crps_db": stated.crps_db(residual_db)}


def _baseline_levels(site: Site, tower: str, replayed: Replayed) -> dict[str, FloatArray]:
    """Return free space and two-ray levels (isotropic) at the samples (n,) [dBm]."""
    place, link = site.towers[tower], replayed.link
    source, target = replayed.source_m(site), replayed.poses.position_m
    if replayed.tower_m is not None:  # the tower has one position per pose: (poses, towers, 3)
        source = source[:, None, :]
    ends = (source, target, link.carrier_hz, link.transmit_power_dbm)
    two_ray = two_ray_dbm(*ends, ground_material=site.ground_material, ground_m=place.ground_m)
    return {
        name: replayed.spread(level[:, 0])
        for name, level in (("free_space", free_space_dbm(*ends)), ("two_ray", two_ray))
    }


def _baselines(levels: Mapping[str, FloatArray], score: rss.RssComparison) -> dict[str, records.ModelLevel]:
    return {
        name: records.ModelLevel(
            level_dbm=level,
            offset_db=score.baselines[name].offset_db,
            rmse_db=score.baselines[name].rmse_db,
            rmse_ci95_db=score.baseline_intervals[name],
        )
        for name, level in levels.items()
    }


def _paired(
    levels: Levels, models: Mapping[str, FloatArray], position_m: FloatArray
) -> dict[str, statistics.PairedDifference]:
    """Compare the replay with each model on their common samples, each after a separate offset."""
    error_db = levels.measured_db - levels.simulated_db
    return {
        name: statistics.paired_difference(error_db, levels.measured_db - level, place_m=position_m)
        for name, level in models.items()
    }


def _averaged(case: _Case) -> dict[str, dict[str, offsets.OffsetFit]]:
    """Fit the offset of each simulation after averaging power over time windows on both sides."""
    out: dict[str, dict[str, offsets.OffsetFit]] = {"coherent": {}, "power_sum": {}}
    for name, fits in out.items():
        level = case.replayed.spread(case.replayed.level_dbm("coherent" if name == "coherent" else "power"))
        measured = np.where(np.isfinite(level), case.levels.measured_db, np.nan)
        level = np.where(np.isfinite(measured), level, np.nan)
        for width_s in _AVERAGING_WINDOWS_S:
            sides = (rss.local_mean_db(case.series.time, side, width_s) for side in (measured, level))
            fits[f"{width_s:g} s"] = offsets.grid_offset(*sides, span_db=case.data.settings.rss.span_db)
    return out


def _snr(series: RssSeries, levels: Levels) -> records.SnrScore | None:
    """Compare the simulated ratio of level and receiver noise with the logged ratio, without an offset."""
    if series.noise_dbm is None:
        return None
    error_db = levels.measured_db - (levels.simulated_db - series.noise_dbm)
    error_db = error_db[np.isfinite(error_db)]
    if not len(error_db):
        return None
    return records.SnrScore(
        noise_dbm=series.noise_dbm,
        rmse_db=float(np.sqrt(np.mean(error_db**2))),
        mean_error_db=float(error_db.mean()),
        n=len(error_db),
    )


def _detection(case: _Case) -> DetectionScore | None:
    """Score P(lock) or P(above the floor), and all samples with the floor. None without lock and floor."""
    series, levels, lock = case.series, case.levels, _lock(case)
    if series.locked is not None:
        known, detected, floor_db = np.isfinite(series.locked), series.locked == 1.0, LOCK_FLOOR_DB
    else:
        detected = np.isfinite(levels.measured_db)
        known = np.ones(len(detected), dtype=np.bool_)
        if not (levels.posed & ~detected).any() or not detected.any():
            return None
        floor_db = float(np.nanmin(levels.measured_db))
    at = known & levels.posed
    score = score_detection(
        rss.seconds(series.time[at]),
        levels.measured_db[at],
        levels.simulated_db[at],
        detected[at],
        floor_db=floor_db,
        free_space_db=case.simple["free_space"][at],
        forecast=None if lock is None else _forecast(series, lock),
        position_m=case.position_m[at],
    )
    return None if score is None else dataclasses.replace(score, locks=series.locked is not None)


def pairs_of(results: Sequence[records.RssResult]) -> list[records.PairResult]:
    """Compare every two channels of a tower at their common times."""
    out = []
    for channel, other_channel in combinations(results, 2):
        if channel.tower != other_channel.tower:
            continue
        rows, other_rows = _same_instants(channel.time, other_channel.time)
        if not len(rows):
            continue
        first, second = channel.calibrated_db[rows], other_channel.calibrated_db[other_rows]
        position = channel.position_m[rows]
        context = {"height_m": position[:, 2], "elevation_deg": channel.geometry["elevation_deg"][rows]}
        if "heading_deg" in channel.geometry:
            context["heading_deg"] = channel.geometry["heading_deg"][rows]
        out.append(
            records.PairResult(
                tower=channel.tower,
                first=channel.channel,
                second=other_channel.channel,
                time=channel.time[rows],
                score=rss.channel_difference(channel.time[rows], first, second, position_m=position, context=context),
            )
        )
    return out


def _same_instants(first: Any, second: Any) -> tuple[IntArray, IntArray]:
    """Return the indices of samples of two series that were taken within half a sampling interval of each other."""
    if len(first) == len(second) and (first == second).all():
        return np.arange(len(first)), np.arange(len(second))
    if len(first) < 2 or not len(second):
        return np.arange(0), np.arange(0)
    nearest, apart = nearest_in_time(first, second)
    rows = np.flatnonzero(apart <= 0.5 * np.median(np.abs(np.diff(first))))
    return rows, nearest[rows]


def _has_direct(replayed: Replayed) -> BoolArray:
    paths = replayed.replay.paths
    direct = np.zeros(len(replayed.poses), dtype=np.bool_)
    direct[paths.pose[paths.depth == 0]] = True
    return direct


def tower_places(replayed: Replayed) -> FloatArray | None:
    """Return the position of a moving tower at every sample (n, 3) [m]. None for a fixed tower."""
    return None if replayed.tower_m is None else replayed.spread(replayed.tower_m)


def link_geometry(site: Site, tower: str, replayed: Replayed, rt: RtSettings) -> dict[str, FloatArray]:
    """Return the quantities for plots of residuals, at the samples of the series (n,), by name with unit.

    Parameters
    ----------
    site : Site
    tower : str
    replayed : Replayed
        Replay of the series: poses, arrays, and the samples that have a pose.
    rt : RtSettings
        The depth of foliage is included unless ``foliage`` is ``none``.

    Returns
    -------
    dict of str to (n,)
        ``altitude_m``, ``distance_m``, ``elevation_deg``, ``azimuth_deg``, ``tower_elevation_deg``,
        ``uav_azimuth_deg``, ``uav_elevation_deg``; ``heading_deg`` with a track, ``foliage_depth_m`` with trees.
        NaN if no pose is known.
    """
    link = replayed.link
    directions = rss.link_geometry(
        replayed.source_m(site),
        replayed.poses.position_m,
        replayed.poses.rotation,
        tower_mount=link.tower_arrays[tower].mount,
        uav_mount=link.uav_array.mount,
    )
    directions["azimuth_deg"] = directions["tower_azimuth_deg"]  # residuals are drawn in the frame of the antenna
    names = "distance_m", "elevation_deg", "azimuth_deg", "tower_elevation_deg", "uav_azimuth_deg", "uav_elevation_deg"
    out = {"altitude_m": replayed.spread(replayed.poses.position_m[:, 2])}
    out |= {name: replayed.spread(directions[name]) for name in names}
    if replayed.track is not None:
        out["heading_deg"] = replayed.spread(replayed.track.heading_deg)
    if site.wooded and rt.foliage != "none":
        depth = direct_foliage_m(replayed.source_m(site), replayed.poses.position_m, site.under(rt.foliage))
        out["foliage_depth_m"] = replayed.spread(depth)
    return out


def _worst(case: _Case, residual_db: FloatArray, line_of_sight: FloatArray) -> list[rss.ErrorSpan]:
    """Return the time spans of largest error, with position and geometry."""
    geometry = case.geometry
    names = {"elevation_deg": "elevation_deg", "height_m": "altitude_m", "heading_deg": "heading_deg",
             "foliage_m": "foliage_depth_m"}  # fmt: skip
    context = {"los": line_of_sight} | {name: geometry[ours] for name, ours in names.items() if ours in geometry}
    spans = rss.error_spans(
        case.series.time, residual_db, position_m=case.position_m, context=context, largest=len(residual_db)
    )
    return [span for span in spans if span.end_s - span.start_s >= _SHORTEST_S][:6]


# --- rank ----------------------------------------------------------------------------------------------------------


def compare_rank_series(data: FlightData, series: RankSeries, replayed: Replayed) -> records.RankResult:
    """Compare measured with simulated rank for each K."""
    settings = data.settings.rank
    position = replayed.spread(replayed.poses.position_m)
    keep = replayed.valid.copy()
    if settings.minimum_height_m is not None:
        with np.errstate(invalid="ignore"):
            keep &= position[:, 2] >= settings.minimum_height_m
    rows, poses = np.flatnonzero(keep), np.flatnonzero(keep[replayed.valid])
    h = replayed.replay.h[poses, 0]
    sinr_db = series.sinr_db[rows] if np.isfinite(series.sinr_db[rows]).any() else None
    score = ranks.compare_rank(
        series.rank[rows],
        h,
        settings.k,
        time_s=(series.time[rows] - series.time[:1]) / np.timedelta64(1, "s") if len(rows) else None,
        sinr_db=sinr_db,
        place_m=position[rows],
    )
    sigma, towers = ranks.singular_values(h), tower_places(replayed)
    probability, forecast, trained = _receiver_forecast(data, series)
    heading = None if replayed.track is None else replayed.spread(replayed.track.heading_deg)[rows]
    return records.RankResult(
        tower=series.tower,
        n_samples=len(series.rank),
        time=series.time[rows],
        position_m=position[rows],
        tower_m=None if towers is None else towers[rows],
        measured=series.rank[rows],
        sinr_db=sinr_db,
        sigma=sigma,
        level_dbm=replayed.replay.rss_dbm[poses, 0],
        rank={k: ranks.rank_from_singular_values(sigma, k) for k in score.simulated},
        score=score,
        further=records.RankFurther(
            n_flagged=dict(series.flagged),
            kappa_ci95={f"{k:g}": fit.kappa_ci95 for k, fit in score.simulated.items()},
            commonest=ranks.commonest_rank(series.rank[rows], position[rows]),
            repeat=_repeated_rank(series.time[rows], position[rows], series.rank[rows], heading),
            receiver=forecast,
            trained_on=trained or None,
            agreement_sd_by_ground=_agreement_by_ground(data, replayed, series.rank[rows], poses, settings.k) or None,
        ),
        probability=probability,
    )


def fitted_receiver(data: FlightData, tower: str) -> FittedReceiver | None:
    """Return the receiver of a tower that the flight file names. None if it names no file.

    Raises
    ------
    InputError
        If the file cannot be read, or has no receiver of this tower.
    """
    named = data.settings.rank.receiver
    if named is None:
        return None
    from .calibrate_rank import read_receiver  # import here, because few flights name a receiver

    receivers = read_receiver(data.folder / named)
    if tower not in receivers:
        raise InputError(
            f"no receiver at {tower}",
            expected="a receiver fitted at one of the flight's towers; it has " + ", ".join(receivers),
            path=data.folder / named,
        )
    return receivers[tower]


def _receiver_forecast(
    data: FlightData, series: RankSeries
) -> tuple[FloatArray | None, ForecastScore | None, tuple[str, ...]]:
    """Return the probability of each rank (n, 4), its score, and the logs of this flight that trained the receiver."""
    receiver = fitted_receiver(data, series.tower)
    if receiver is None:
        return None, None, ()
    from .calibrate_rank import rank_samples  # import here, because few flights name a receiver

    samples = rank_samples(data, series)
    probability, decided = receiver.forecast(samples)
    if receiver.knows(samples):  # do not score a receiver on its own training data
        return probability, None, samples.logs
    constant = receiver.mixture.members[0].constant
    return probability, score_forecast(samples.rank, probability, decided, constant), ()


def _repeated_rank(
    time: Any, position_m: FloatArray, rank: FloatArray, heading_deg: FloatArray | None
) -> dict[str, ranks.RankRepeat]:
    """Compare the modem's ranks of both halves of the flight at common positions."""
    elapsed = rss.seconds(time)
    with np.errstate(invalid="ignore"):
        late = elapsed > 0.5 * np.nanmax(elapsed, initial=0.0)
    headings: dict[str, FloatArray | None] = {} if heading_deg is None else {"same_heading": heading_deg}
    repeats = {}
    for name, turn in {**headings, "any_heading": None}.items():
        early, again = (Visit(position_m[at], rank[at], None if turn is None else turn[at]) for at in (~late, late))
        repeats[name] = ranks.repeat_rank(early, again, _PASSES_WITHIN_M)
    return repeats


def _agreement_by_ground(
    data: FlightData, replayed: Replayed, measured: FloatArray, poses: IntArray, ks: Sequence[float]
) -> dict[str, float]:
    """Return the SD of a tower's rank agreement by K, over random grounds within the errors of the known heights.

    Parameters
    ----------
    data : FlightData
    replayed : Replayed
        Replay of the rank of one tower.
    measured : (n,)
        Reported rank, NaN if the modem reported no rank.
    poses : (n,)
        Index of the replayed pose of each report.
    ks : sequence of float

    Returns
    -------
    dict of str to float
        The dict is empty if the site has no ``ground_points`` or is a scene of triangles, or the tower moves.
    """
    model = site_model(data.site_place)
    known = np.flatnonzero(np.isfinite(measured))
    if not model.ground_points or data.site.scene is not None or replayed.tower_m is not None or not len(known):
        return {}
    known = known[spread_out(len(known), _POSES)]
    some = replayed.poses[poses[known]]
    agreed = []
    # fixed seeds, so that two reports of a flight state the same number
    for ground in ground_surface(model, data.site.frame).dems(map(np.random.default_rng, range(_DRAWS))):
        h = replay_poses(_on(data.site, ground), data.settings.rank_rt, replayed.link, some).h[:, 0]
        agreed.append([float((ranks.channel_rank(h, k) == measured[known]).mean()) for k in ks])
    return {f"{k:g}": float(sd) for k, sd in zip(ks, np.std(agreed, axis=0, ddof=1), strict=True)}


def _on(site: Site, ground: Dem) -> Site:
    """Return the site with another elevation model, on which towers, buildings and trees stand."""
    towers = {
        name: dataclasses.replace(tower, ground_m=float(np.nan_to_num(ground.ground_m(tower.east_m, tower.north_m))))
        for name, tower in site.towers.items()
    }
    return dataclasses.replace(site, dem=ground, towers=towers)
