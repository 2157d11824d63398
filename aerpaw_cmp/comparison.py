"""Compare each replayed series with its measurement, audit the engine, and fill the panels of the report."""

from __future__ import annotations

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
from .compare import rss
from .flight import FlightData, RankSeries, RssSeries
from .replay.baselines import free_space_dbm, two_ray_dbm
from .replaying import Clock, Replayed, direct_foliage_m
from .report import data as report
from .units import BoolArray, FloatArray

Progress = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Compared:
    """A finished panel of the report, and what the reader must be told about it."""

    panel: Any
    warnings: tuple[str, ...]


def baseline_levels(data: FlightData, tower: str, replayed: Replayed) -> dict[str, FloatArray]:
    """Free space and two-ray (isotropic) at the replayed poses (n,) [dBm]."""
    place, link = data.site.towers[tower], replayed.link
    source, target = place.position_m[None, :], replayed.poses.position_m
    ends = (source, target, link.carrier_hz, link.transmit_power_dbm)
    two_ray = two_ray_dbm(*ends, ground_material=data.site.ground_material, ground_m=place.ground_m)
    return {"free_space": free_space_dbm(*ends)[:, 0], "two_ray": two_ray[:, 0]}


def compare_rss_series(data: FlightData, series: RssSeries, replayed: Replayed) -> Compared:
    """Offset, RMSE, correlation, intervals and baselines of one tower and channel."""
    settings, clock = data.settings.rss, replayed.clock
    level = replayed.replay.rss_power_dbm if settings.field == "power" else replayed.replay.rss_dbm
    simulated = replayed.spread(level[:, 0])
    measured = series.measured_db
    if settings.window_s > 0:
        measured = rss.local_mean_db(series.time, measured, settings.window_s)
        if settings.field == "local_mean":
            simulated = rss.local_mean_db(series.time, simulated, settings.window_s)
    geometry = _geometry(data, series.tower, replayed)
    posed = replayed.valid.copy()
    if settings.minimum_height_m is not None:
        with np.errstate(invalid="ignore"):
            posed &= geometry["altitude_m"] >= settings.minimum_height_m
    levels = {name: replayed.spread(v) for name, v in baseline_levels(data, series.tower, replayed).items()}
    result = rss.compare_rss(
        series.time,
        measured,
        simulated,
        baselines=levels,
        posed=posed,
        step_db=settings.step_db,
        span_db=settings.span_db,
        replicates=max(settings.bootstrap, 1),
        lag_s=float("nan") if clock is None else clock.shift_s,
        fitted_on_scored=("lag",) if clock is not None and clock.applied == "estimated and applied" else (),
    )
    direct = replayed.spread(_has_direct(replayed).astype(np.float64), np.nan)
    position = geometry.pop("position_m")
    panel = report.RssPanel(
        tower=series.tower,
        channel=series.channel,
        unit=series.unit,
        time=series.time,
        measured_db=np.where(posed, measured, np.nan),
        simulated_dbm=np.where(posed, simulated, np.nan),
        measured_out_of_coverage=posed & ~np.isfinite(measured),
        simulated_out_of_coverage=posed & ~np.isfinite(simulated),
        offset_db=result.offset_db,
        rmse_db=result.rmse_db,
        correlation=result.correlation,
        n=result.n,
        n_out_of_coverage=result.n_out_of_coverage,
        at_search_edge=result.at_edge,
        rmse_ci95_db=result.rmse_ci95_db,
        offset_ci95_db=result.intervals.offset_db,
        correlation_ci95=result.intervals.correlation,
        n_effective=result.intervals.memory.n_effective,
        lag_s=result.lag_s,
        lag_verdict="" if clock is None else clock.verdict,
        fitted=("offset", *result.fitted_on_scored),
        baselines=tuple(
            report.Baseline(
                name=name,
                level_dbm=levels[name],
                offset_db=result.baselines[name].offset_db,
                rmse_db=result.baselines[name].rmse_db,
            )
            for name in levels
        ),
        offset_curve=report.OffsetCurve(
            **dict(
                zip(
                    ("offset_db", "rmse_db"),
                    offsets.offset_curve(
                        np.where(posed, measured, np.nan), simulated, step_db=settings.step_db, span_db=settings.span_db
                    ),
                    strict=True,
                )
            )
        ),
        east_m=position[:, 0],
        north_m=position[:, 1],
        up_m=position[:, 2],
        geometry=geometry,
        line_of_sight=direct == 1.0,
        worst=_worst(series, result, position, geometry, direct),
        extra={**{k: v for k, v in result.as_dict().items() if k in EXTRA_RSS}, "clock": _clock_entry(clock)},
    )
    return Compared(panel, _rss_warnings(series, result, clock))


EXTRA_RSS = ("identifiable_db", "trimmed", "n_no_pose", "n_measured_out", "n_simulated_out", "block_length")
"""Numbers of the comparison that metrics.json holds besides those of the panel."""


def _has_direct(replayed: Replayed) -> BoolArray:
    paths = replayed.replay.paths
    direct = np.zeros(len(replayed.poses), dtype=np.bool_)
    direct[paths.pose[paths.depth == 0]] = True
    return direct


def _geometry(data: FlightData, tower: str, replayed: Replayed) -> dict[str, FloatArray]:
    """Quantities that residuals are drawn against, at the samples of the series."""
    position = np.full((len(replayed.valid), 3), np.nan)
    position[replayed.valid] = replayed.poses.position_m
    place = data.site.towers[tower]
    line = position - place.position_m
    across = np.hypot(line[:, 0], line[:, 1])
    mount = replayed.link.tower_arrays[tower].mount
    in_frame = line @ mount  # site to antenna axes: the transpose of the mount, applied from the right
    out = {
        "position_m": position,
        "distance_m": np.linalg.norm(line, axis=1),
        "elevation_deg": np.degrees(np.arctan2(line[:, 2], across)),
        "azimuth_deg": np.degrees(np.arctan2(in_frame[:, 1], in_frame[:, 0])),
        "altitude_m": position[:, 2],
    }
    if replayed.track is not None:
        out["heading_deg"] = np.where(replayed.valid, replayed.track.heading_deg, np.nan)
    if len(data.site.trees) and data.settings.rt.foliage != "none":
        out["foliage_depth_m"] = replayed.spread(direct_foliage_m(data, tower, replayed))
    return out


def _worst(
    series: RssSeries,
    result: rss.RssComparison,
    position: FloatArray,
    geometry: dict[str, FloatArray],
    direct: FloatArray,
) -> tuple[Any, ...]:
    """The spans of largest error, with place and likely cause."""
    context: dict[str, Any] = {
        "los": direct,
        "elevation_deg": geometry["elevation_deg"],
        "height_m": geometry["altitude_m"],
    }
    for ours, theirs in (("heading_deg", "heading_deg"), ("foliage_depth_m", "foliage_m")):
        if ours in geometry:
            context[theirs] = geometry[ours]
    spans = rss.error_spans(series.time, result.residual_db, position_m=position, context=context, largest=6)
    start = series.time.min() if len(series.time) else np.datetime64(0, "ns")
    return tuple(
        report.ErrorSpan(
            start=start + np.timedelta64(round(span.start_s * 1e9), "ns"),
            end=start + np.timedelta64(round(span.end_s * 1e9), "ns"),
            east_m=span.position_m[0],
            north_m=span.position_m[1],
            up_m=span.position_m[2],
            mean_error_db=span.mean_db,
            cause=span.cause,
        )
        for span in spans
    )


def _clock_entry(clock: Clock | None) -> dict[str, Any] | None:
    if clock is None:
        return None
    return {
        "shift_s": clock.shift_s,
        "shift_ci95_s": list(clock.shift_ci95_s),
        "drift_s_per_s": clock.drift_s_per_s,
        "verdict": clock.verdict,
        "reason": clock.reason,
        "applied": clock.applied,
    }


def _rss_warnings(series: RssSeries, result: rss.RssComparison, clock: Clock | None) -> tuple[str, ...]:
    name = f"{series.tower} {series.channel}"
    out = []
    if clock is not None and clock.verdict == "ok" and clock.applied == "estimated, not applied":
        low, high = clock.shift_ci95_s
        if low > 0 or high < 0:
            out.append(
                f"{name}: the radio clock shows {clock.shift_s:+.2f} s ({low:+.2f} .. {high:+.2f}) too much; "
                "not applied (rss.lag: apply would)."
            )
    if result.n == 0:
        out.append(f"{name}: no sample could be compared; its numbers are missing, not zero.")
    elif result.at_edge:
        out.append(f"{name}: the best offset lies at the edge of the searched span; widen rss.span_db before using it.")
    return tuple(out)


def compare_rank_series(data: FlightData, series: RankSeries, replayed: Replayed) -> Compared:
    """Measured against simulated rank for each K."""
    settings = data.settings.rank
    position = np.full((len(series.rank), 3), np.nan)
    position[replayed.valid] = replayed.poses.position_m
    keep = replayed.valid.copy()
    if settings.minimum_height_m is not None:
        with np.errstate(invalid="ignore"):
            keep &= position[:, 2] >= settings.minimum_height_m
    h = np.zeros((len(series.rank), *replayed.replay.h.shape[2:]), dtype=np.complex128)
    h[replayed.valid] = replayed.replay.h[:, 0]
    rows = np.flatnonzero(keep)
    measured, h = series.rank[rows], h[rows]
    result = ranks.compare_rank(
        measured,
        h,
        settings.k,
        time_s=(series.time[rows] - series.time[:1]) / np.timedelta64(1, "s") if len(rows) else None,
        sinr_db=series.sinr_db[rows] if np.isfinite(series.sinr_db[rows]).any() else None,
        replicates=max(settings.bootstrap, 1),
    )
    sigma = ranks.singular_values(h)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio_db = 20.0 * np.log10(sigma[:, 1:] / sigma[:, :1])
    panel = report.RankPanel(
        tower=series.tower,
        time=series.time[rows],
        east_m=position[rows, 0],
        north_m=position[rows, 1],
        up_m=position[rows, 2],
        measured=measured,
        histogram=_histogram(result.histogram, result.histogram_ci95),
        simulated=tuple(_at_k(k, fit, sigma) for k, fit in result.simulated.items()),
        best_k=result.best_k,
        best_k_ci95=result.curve.best_k_interval,
        curve=report.KCurve(
            k=result.curve.k, agreement=result.curve.agreement, total_variation=result.curve.total_variation
        ),
        singular_ratio_db=ratio_db,
        sinr_db=series.sinr_db[rows] if np.isfinite(series.sinr_db[rows]).any() else None,
        stale=~result.staleness.fresh,
        extra={
            k: v for k, v in result.as_dict().items() if k not in ("measured", "simulated", "best_k", "best_k_ci95")
        },
    )
    return Compared(panel, _rank_warnings(series, result, len(series.rank) - len(rows)))


def _histogram(share: FloatArray, intervals: list[tuple[float, float]]) -> Any:
    low, high = np.array(intervals, dtype=np.float64).T
    return report.Histogram(share=share, low=low, high=high)


def _at_k(k: float, fit: ranks.RankFit, sigma: FloatArray) -> Any:
    return report.RankAtK(
        k=k,
        rank=ranks.rank_from_singular_values(sigma, k),
        histogram=_histogram(fit.histogram, fit.histogram_ci95),
        n_out_of_coverage=fit.out_of_coverage,
        agreement=fit.agreement,
        total_variation=fit.total_variation,
        wasserstein=fit.wasserstein,
        kappa=fit.kappa,
        agreement_ci95=fit.agreement_ci95,
        total_variation_ci95=fit.total_variation_ci95,
        p_value=fit.p_histogram,
        confusion=fit.confusion[1:],
    )


def _rank_warnings(series: RankSeries, result: ranks.RankComparison, left_out: int) -> tuple[str, ...]:
    out = []
    if left_out:
        out.append(f"Rank {series.tower}: {left_out} of {len(series.rank)} samples are too low or have no pose.")
    if result.n == 0:
        out.append(f"Rank {series.tower}: the modem reported no rank at any compared pose.")
    if result.staleness.verdict == "held":
        out.append(
            f"Rank {series.tower}: the modem holds each report for about {result.staleness.hold_s:.1f} s; "
            f"{result.n} samples are {result.staleness.n_reports} reports."
        )
    return tuple(out)


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
