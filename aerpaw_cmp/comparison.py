"""The stages between logs and report: replay each series, calibrate it, compare it, audit the engine."""

from __future__ import annotations

import dataclasses
import math
import platform
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np

from . import __version__
from .compare import offset as offsets
from .compare import rank as ranks
from .flight import FlightData, RankSeries, RssSeries, rank_positions
from .replay.arrays import Link, Poses
from .replay.baselines import free_space_dbm, two_ray_dbm
from .replay.paths import PathSet
from .replay.replay import Replay, replay
from .report import data as report
from .track import TrackPoses
from .units import BoolArray, FloatArray

Progress = Callable[[str], None]
RANKS = (1, 2, 3, 4)


@dataclass(frozen=True, slots=True)
class Replayed:
    """One series, replayed: ``valid`` (n,) says at which samples a pose was known; the replay has those only."""

    link: Link
    poses: Poses
    valid: BoolArray
    replay: Replay
    track: TrackPoses | None

    def spread(self, values: FloatArray, fill: float = np.nan) -> FloatArray:
        """Values per replayed pose, put back at their samples (n,)."""
        out = np.full(len(self.valid), fill, dtype=np.result_type(values.dtype, np.float64))
        out[self.valid] = values
        return out


@dataclass(frozen=True, slots=True)
class Compared:
    """A finished panel of the report, and what the reader must be told about it."""

    panel: Any
    warnings: tuple[str, ...]


def replay_rss(data: FlightData, progress: Progress) -> list[Replayed]:
    """Replay every RSS series; series of one tower with equal links are replayed together."""
    groups: dict[tuple[str, str], list[int]] = {}
    for index, series in enumerate(data.rss):
        groups.setdefault((series.tower, series.settings_key), []).append(index)
    out: dict[int, Replayed] = {}
    for members in groups.values():
        tower = data.rss[members[0]].tower
        link = data.rss[members[0]].link.build([tower], data.folder)
        tracks = [_track_poses(data, data.rss[i].time) for i in members]
        poses = [_poses(data, track) for track in tracks]
        joined = Poses(
            np.concatenate([p.position_m for p in poses]), np.concatenate([p.rotation for p in poses])
        )
        progress(f"replay RSS {tower}: {len(joined)} poses")
        whole = _replay(data, link, joined)
        start = 0
        for index, track, part in zip(members, tracks, poses, strict=True):
            stop = start + len(part)
            out[index] = Replayed(link, part, track.valid, part_of(whole, start, stop), track)
            start = stop
    return [out[i] for i in range(len(data.rss))]


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
        paths=PathSet(
            paths.pose[chosen] - start,
            paths.tower[chosen],
            paths.depth[chosen],
            paths.faces[chosen],
            paths.vertices_m[chosen],
        ),
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
        if track is not None and data.settings.rt.attitude != "ignored":
            rotation = _attitude(data, track)
        poses = Poses(position[valid], np.ascontiguousarray(rotation[valid]))
        progress(f"replay rank {series.tower}: {len(poses)} poses")
        out.append(Replayed(link, poses, valid, _replay(data, link, poses), track))
    return out


def _track_poses(data: FlightData, time: Any) -> TrackPoses:
    assert data.track is not None
    return data.track.pose_at(time)


def _attitude(data: FlightData, track: TrackPoses) -> FloatArray:
    """Body rotations (n, 3, 3) as ``rt.attitude`` wants them."""
    if data.settings.rt.attitude == "ignored":
        return np.broadcast_to(np.eye(3), (len(track), 3, 3))
    if data.settings.rt.attitude == "logged":
        return track.rotation
    from .replay.arrays import rotation_from_aircraft

    heading = np.where(track.valid, track.heading_deg, 0.0)
    return rotation_from_aircraft(np.zeros_like(heading), np.zeros_like(heading), heading)


def _poses(data: FlightData, track: TrackPoses) -> Poses:
    rotation = np.ascontiguousarray(_attitude(data, track)[track.valid])
    return Poses(track.position_m[track.valid], rotation)


def _replay(data: FlightData, link: Link, poses: Poses) -> Replay:
    rt = data.settings.rt
    return replay(
        data.site,
        link,
        poses,
        engine=rt.engine,
        max_depth=rt.max_depth,
        samples=rt.samples,
        batch=rt.batch,
        relevance_db=rt.relevance_db,
    )


def baseline_levels(data: FlightData, tower: str, replayed: Replayed) -> dict[str, FloatArray]:
    """Free space and two-ray (isotropic) at the replayed poses (n,) [dBm]."""
    place, link = data.site.towers[tower], replayed.link
    source, target = place.position_m[None, :], replayed.poses.position_m
    ends = (source, target, link.carrier_hz, link.transmit_power_dbm)
    ground = {"ground_material": data.site.ground_material, "ground_m": place.ground_m}
    return {"free_space": free_space_dbm(*ends)[:, 0], "two_ray": two_ray_dbm(*ends, **ground)[:, 0]}


def compare_rss_series(data: FlightData, series: RssSeries, replayed: Replayed) -> Compared:
    """Offset, RMSE, correlation and baselines of one tower and channel."""
    settings = data.settings.rss
    simulated = replayed.spread(replayed.replay.rss_dbm[:, 0])
    measured = series.measured_db
    position = replayed.track.position_m if replayed.track is not None else np.full((len(measured), 3), np.nan)
    compared = np.ones(len(measured), dtype=bool)
    if settings.minimum_height_m is not None:
        with np.errstate(invalid="ignore"):
            compared = position[:, 2] >= settings.minimum_height_m
    used = np.where(compared, measured, np.nan)
    fit = offsets.grid_offset(used, simulated, step_db=settings.step_db, span_db=settings.span_db)
    baselines = []
    for name, level_dbm in baseline_levels(data, series.tower, replayed).items():
        level = replayed.spread(level_dbm)
        base = offsets.grid_offset(used, level, step_db=settings.step_db, span_db=settings.span_db)
        baselines.append(report.Baseline(name=name, level_dbm=level, offset_db=base.offset_db, rmse_db=base.rmse_db))
    pairs = np.isfinite(used) & np.isfinite(simulated)
    correlation = float(np.corrcoef(used[pairs], simulated[pairs])[0, 1]) if pairs.sum() > 2 else float("nan")
    panel = report.RssPanel(
        tower=series.tower,
        channel=series.channel,
        unit=series.unit,
        time=series.time,
        measured_db=measured,
        simulated_dbm=simulated,
        measured_out_of_coverage=~np.isfinite(measured),
        simulated_out_of_coverage=replayed.valid & ~np.isfinite(simulated),
        offset_db=fit.offset_db,
        rmse_db=fit.rmse_db,
        correlation=correlation,
        n=fit.n,
        n_out_of_coverage=int((compared & ~pairs).sum()),
        at_search_edge=fit.at_edge,
        baselines=tuple(baselines),
        east_m=position[:, 0],
        north_m=position[:, 1],
        up_m=position[:, 2],
    )
    return Compared(panel, ())


def compare_rank_series(data: FlightData, series: RankSeries, replayed: Replayed) -> Compared:
    """Measured against simulated rank for each K."""
    settings = data.settings.rank
    position = np.full((len(series.rank), 3), np.nan)
    position[replayed.valid] = replayed.poses.position_m
    keep = replayed.valid.copy()
    if settings.minimum_height_m is not None:
        with np.errstate(invalid="ignore"):
            keep &= position[:, 2] >= settings.minimum_height_m
    h = replayed.replay.h[:, 0]
    measured = np.where(keep, series.rank, np.nan)
    measured_share = ranks.histogram(measured)
    at_k = []
    for k in settings.k:
        simulated = np.zeros(len(series.rank), dtype=np.int64)
        simulated[replayed.valid] = ranks.channel_rank(h, k)
        both = np.isfinite(measured)
        share = ranks.histogram(np.where(both, simulated, np.nan))
        at_k.append(
            report.RankAtK(
                k=k,
                rank=simulated,
                histogram=report.Histogram(share=share),
                n_out_of_coverage=int((both & (simulated == 0)).sum()),
                agreement=ranks.agreement(measured, simulated),
                total_variation=ranks.total_variation(measured_share, share),
                wasserstein=ranks.wasserstein(measured_share, share),
            )
        )
    panel = report.RankPanel(
        tower=series.tower,
        time=series.time,
        east_m=position[:, 0],
        north_m=position[:, 1],
        up_m=position[:, 2],
        measured=measured,
        histogram=report.Histogram(share=measured_share),
        simulated=tuple(at_k),
        sinr_db=series.sinr_db,
        extra={"n": int(np.isfinite(measured).sum())},
    )
    return Compared(panel, ())


def audit_replays(data: FlightData, replays: Sequence[Replayed], progress: Progress) -> Any:
    """The engine record of the report, with the audit by the other engine."""
    rt = data.settings.rt
    return report.Engine(
        engine=rt.engine,
        links=sum(len(r.poses) for r in replays),
        seconds=sum(r.replay.seconds for r in replays),
        paths=sum(len(r.replay.paths) for r in replays),
        settings={"max_depth": rt.max_depth, "samples": rt.samples, "attitude": rt.attitude, "foliage": rt.foliage},
        left_out=tuple(dict.fromkeys(text for r in replays for text in r.replay.left_out)),
        audit=_audit(data, replays, progress) if rt.audit_links else None,
    )


def _audit(data: FlightData, replays: Sequence[Replayed], progress: Progress) -> Any:
    """One audit over all series: links are shared out in proportion to their poses."""
    from .replay.audit import audit

    rt = data.settings.rt
    total = sum(len(r.poses) for r in replays)
    parts = []
    for replayed in replays:
        count = len(replayed.poses)
        links = min(count, math.ceil(rt.audit_links * count / max(total, 1)))
        if links == 0:
            continue
        progress(f"audit {replayed.replay.towers[0]}: {links} links")
        parts.append(
            audit(
                data.site,
                replayed.link,
                replayed.poses,
                replayed.replay,
                links=links,
                max_depth=rt.max_depth,
                samples=rt.samples,
                batch=rt.batch,
                ks=data.settings.rank.k,
            )
        )
    if not parts:
        return None
    errors = [p.rss_max_error_db for p in parts if np.isfinite(p.rss_max_error_db)]
    links = sum(p.links for p in parts)
    return report.Audit(
        reference=parts[0].reference,
        links=links,
        missing_paths=sum(p.missing_paths for p in parts),
        extra_paths=sum(p.extra_paths for p in parts),
        rss_max_error_db=max(errors, default=float("nan")),
        rank_disagreement={
            k: sum(p.rank_disagreement[k] * p.links for p in parts) / links for k in data.settings.rank.k
        },
        seconds=sum(r.replay.seconds for r in replays) * links / max(total, 1),
        reference_seconds=sum(p.reference_seconds for p in parts),
        note="seconds of the engine are its share for the audited links; the reference's include its start-up",
    )


def inputs_of(data: FlightData) -> tuple[Any, ...]:
    """The account of every log."""
    return tuple(
        report.InputFile(
            path=log.path,
            sha256=file.sha256,
            reader=file.result.reader,
            lines=file.result.lines,
            accepted=file.result.accepted,
            rejected=len(file.result.rejected),
            blank=file.result.blank,
            role=", ".join(sorted({s.kind for s in file.result.streams})),
            warnings=file.result.warnings,
            rejected_lines=file.result.rejected,
        )
        for log, file in zip(data.settings.logs, data.files, strict=True)
    )


def track_of(data: FlightData) -> Any:
    """The flown line: telemetry's, or the rank log's own positions."""
    if data.track is not None and len(data.track):
        step_ns = max((data.track.end_ns - data.track.start_ns) // 2000, 500_000_000)
        time = np.arange(data.track.start_ns, data.track.end_ns + 1, step_ns).astype("datetime64[ns]")
        position = data.track.pose_at(time).position_m
    else:
        own = next((s for s in data.rank if s.position_m is not None), None)
        if own is None or own.position_m is None:
            return None
        time, position = own.time, own.position_m
    return report.Track(time=time, east_m=position[:, 0], north_m=position[:, 1], up_m=position[:, 2])


def waypoints_of(data: FlightData) -> tuple[Any, ...]:
    """Waypoints of the plan or the report settings, each at the moment the track comes nearest."""
    plan = data.settings.flight.plan
    points = data.settings.report.waypoints or (plan.waypoints if plan else [])
    track = track_of(data)
    if track is None:
        return ()
    out, start = [], 0
    for point in points:
        if not point.label:
            continue
        distance = np.sqrt(
            (track.east_m[start:] - point.east_m) ** 2
            + (track.north_m[start:] - point.north_m) ** 2
            + (track.up_m[start:] - point.height_m) ** 2
        )
        # the first moment it comes as near as it ever will (within 2 m): later visits belong to later waypoints
        near = np.flatnonzero(distance <= np.nanmin(distance) + 2.0)
        index = start + int(near[0])
        out.append(
            report.Waypoint(
                label=point.label,
                time=track.time[index],
                east_m=point.east_m,
                north_m=point.north_m,
                up_m=point.height_m,
            )
        )
        start = index
    return tuple(out)


def versions() -> dict[str, str]:
    """Versions of everything that shapes a number."""
    found = {"aerpaw-cmp": __version__, "python": platform.python_version()}
    for name in ("numpy", "scipy", "pandas", "pyproj", "shapely", "sionna-rt", "mitsuba", "drjit"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found
