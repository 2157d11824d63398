"""Compare each replayed series with its measurement, audit the engine, and fill the panels of the report."""

from __future__ import annotations

import math
import platform
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from itertools import combinations
from typing import Any

import numpy as np

from .. import __version__
from ..common.units import BoolArray, FloatArray, IntArray, wavelength_m
from ..compare import offset as offsets
from ..compare import rank as ranks
from ..compare import rss, statistics
from ..flight.data import FlightData, RankSeries, RssSeries
from ..flight.settings import RssSettings
from ..propagation.baselines import free_space_dbm, two_ray_dbm
from ..report import data as report
from .replay import Clock, Replayed, direct_foliage_m, path_loss, reflecting_crowns
from .what_if import (
    expected_offset,
    foliage_rank_difference,
    foliage_ranks,
    foliage_rss_difference,
    rss_alternatives,
)

Progress = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Compared:
    """A finished panel of the report, what the reader must be told about it, and numbers for metrics.json alone."""

    panel: Any
    warnings: tuple[str, ...] = ()
    metrics: Mapping[str, Any] = field(default_factory=dict)


def baseline_levels(data: FlightData, tower: str, replayed: Replayed) -> dict[str, FloatArray]:
    """Free space and two-ray (isotropic) at the replayed poses (n,) [dBm]."""
    place, link = data.site.towers[tower], replayed.link
    source, target = place.position_m[None, :], replayed.poses.position_m
    ends = (source, target, link.carrier_hz, link.transmit_power_dbm)
    two_ray = two_ray_dbm(*ends, ground_material=data.site.ground_material, ground_m=place.ground_m)
    return {"free_space": free_space_dbm(*ends)[:, 0], "two_ray": two_ray[:, 0]}


def compare_rss_series(data: FlightData, series: RssSeries, replayed: Replayed) -> Compared:
    """Offset, RMSE, correlation, intervals, baselines and alternatives of one tower and channel."""
    levels = _Levels.of(data, series, replayed)
    clock, settings = replayed.clock, data.settings.rss
    result = rss.compare_rss(
        series.time,
        levels.measured_db,
        levels.simulated_db,
        baselines=levels.baselines,
        posed=levels.posed,
        step_db=settings.step_db,
        span_db=settings.span_db,
        replicates=max(settings.bootstrap, 1),
        lag_s=float("nan") if clock is None else clock.shift_s,
        fitted_on_scored=("lag_s",) if clock is not None and clock.applied == "estimated and applied" else (),
    )
    direct = replayed.spread(_has_direct(replayed).astype(np.float64), np.nan)
    alternatives = {
        name: _at_samples(data, series, replayed, level) for name, level in rss_alternatives(data, replayed).items()
    }
    quantities = {**levels.geometry, "time_s": rss.seconds(series.time), "line_of_sight": direct}
    tables = rss.residual_tables(result.residual_db, quantities)
    panel = report.RssPanel(
        tower=series.tower,
        channel=series.channel,
        unit=series.unit,
        time=series.time,
        **_sample_columns(levels),
        **_headline_numbers(result, clock),
        baselines=tuple(
            report.Baseline(name=name, level_dbm=level, offset_db=fit.offset_db, rmse_db=fit.rmse_db)
            for (name, level), fit in zip(levels.baselines.items(), result.baselines.values(), strict=True)
        ),
        offset_curve=_offset_curve(levels, settings),
        line_of_sight=direct == 1.0,
        worst=_worst(series.time, result.residual_db, levels, direct),
        variants=_variants(settings, levels, alternatives),
        extra={
            **{k: v for k, v in result.as_dict().items() if k in EXTRA_RSS},
            "n_too_low": int((replayed.valid & ~levels.posed).sum()),
            "n_no_pose": int((~replayed.valid).sum()),
            "n_flagged": dict(series.flagged),
            "clock": _clock_entry(clock),
            "baseline_rmse_ci95_db": {name: list(bounds) for name, bounds in result.baseline_intervals.items()},
            **_further_numbers(data, series, replayed, levels, result.offset_db),
            **({"foliage": found} if (found := foliage_rss_difference(alternatives)) else {}),
            "explained_by": {name: table.explained for name, table in tables.items()},
        },
        per_sample={
            f"simulated_{name.replace(' ', '_')}_dbm": level
            for name, level in alternatives.items()
            if name in FOLIAGE_RUNS
        },
    )
    only_metrics = {"residual_by": {name: table.as_dict() for name, table in tables.items()}}
    return Compared(
        panel, _rss_warnings(series, result, clock), {"rss": {series.tower: {series.channel: only_metrics}}}
    )


def _sample_columns(levels: _Levels) -> dict[str, Any]:
    """The fields of an RSS panel that have a value per sample."""
    return {
        "measured_db": levels.measured_db,
        "simulated_dbm": np.where(levels.posed, levels.simulated_db, np.nan),
        "measured_out_of_coverage": levels.posed & ~np.isfinite(levels.measured_db),
        "simulated_out_of_coverage": levels.posed & ~np.isfinite(levels.simulated_db),
        "east_m": levels.position_m[:, 0],
        "north_m": levels.position_m[:, 1],
        "up_m": levels.position_m[:, 2],
        "geometry": levels.geometry,
    }


def _offset_curve(levels: _Levels, settings: RssSettings) -> Any:
    candidates, rmse = offsets.offset_curve(
        levels.measured_db, levels.simulated_db, step_db=settings.step_db, span_db=settings.span_db
    )
    return report.OffsetCurve(offset_db=candidates, rmse_db=rmse)


@dataclass(frozen=True, slots=True)
class _Levels:
    """One series at its samples (n,): measured, simulated and baseline levels [dB], and the geometry of the link.

    ``posed`` are the samples with a known pose above the lowest height; ``measured_db`` is NaN elsewhere.
    """

    measured_db: FloatArray
    simulated_db: FloatArray
    baselines: Mapping[str, FloatArray]
    posed: BoolArray
    position_m: FloatArray
    geometry: dict[str, FloatArray]

    @classmethod
    def of(cls, data: FlightData, series: RssSeries, replayed: Replayed) -> _Levels:
        settings = data.settings.rss
        level = replayed.replay.rss_power_dbm if settings.field == "power" else replayed.replay.rss_dbm
        measured = series.measured_db
        if settings.window_s > 0:
            measured = rss.local_mean_db(series.time, measured, settings.window_s)
        simulated = _at_samples(data, series, replayed, level[:, 0])
        geometry = _geometry(data, series.tower, replayed)
        posed = replayed.valid.copy()
        if settings.minimum_height_m is not None:
            with np.errstate(invalid="ignore"):
                posed &= geometry["altitude_m"] >= settings.minimum_height_m
        simple = baseline_levels(data, series.tower, replayed)
        baselines = {name: _at_samples(data, series, replayed, level) for name, level in simple.items()}
        position = geometry.pop("position_m")
        return cls(np.where(posed, measured, np.nan), simulated, baselines, posed, position, geometry)


def _at_samples(data: FlightData, series: RssSeries, replayed: Replayed, level_db: FloatArray) -> FloatArray:
    """A simulated level of the replayed poses at the samples (n,), averaged as ``rss.field: local_mean`` asks."""
    settings = data.settings.rss
    level = replayed.spread(level_db)
    return rss.local_mean_db(series.time, level, settings.window_s) if settings.field == "local_mean" else level


def _headline_numbers(result: rss.RssComparison, clock: Clock | None) -> dict[str, Any]:
    """What every panel states."""
    return {
        "offset_db": result.offset_db,
        "rmse_db": result.rmse_db,
        "correlation": result.correlation,
        "n": result.n,
        "n_out_of_coverage": result.n_out_of_coverage,
        "at_search_edge": result.at_edge,
        "rmse_ci95_db": result.rmse_ci95_db,
        "offset_ci95_db": result.intervals.offset_db,
        "correlation_ci95": result.intervals.correlation,
        "n_effective": result.intervals.memory.n_effective,
        "lag_s": result.lag_s,
        "lag_verdict": "" if clock is None else clock.verdict,
        "fitted": result.fitted_on_scored,
    }


def _variants(settings: RssSettings, levels: _Levels, alternatives: Mapping[str, FloatArray]) -> tuple[Any, ...]:
    """Each alternative over the samples it has, with an offset of its own."""
    out = []
    for name, level in alternatives.items():
        both = np.isfinite(levels.measured_db) & np.isfinite(level)
        measured, simulated = levels.measured_db[both], level[both]
        fit = offsets.grid_offset(measured, simulated, step_db=settings.step_db, span_db=settings.span_db)
        bounds = statistics.error_intervals(measured, simulated, replicates=max(settings.bootstrap, 1))
        out.append(report.Variant(name=name, offset_db=fit.offset_db, rmse_db=fit.rmse_db, rmse_ci95_db=bounds.rmse_db))
    return tuple(out)


FOOTING_WINDOWS_S = (0.0, 1.0, 4.0)
"""Both sides are averaged over these windows to see how much of the error is fading."""

FOOTING_WAVELENGTHS = 40
FOOTING_LENGTH_M = 20.0
"""And over stretches of path, each of which counts once, however long the UAV hovered there."""

PASSES_WITHIN_M = 3.0
"""Two passes of one place, first and second half of a flight, come this near."""


def _further_numbers(
    data: FlightData, series: RssSeries, replayed: Replayed, levels: _Levels, offset_db: float
) -> dict[str, Any]:
    """Same footing, offset with censored samples, expected offset, repeatability."""
    settings = data.settings.rss
    found: dict[str, Any] = {}
    simulations = {
        "coherent": replayed.spread(replayed.replay.rss_dbm[:, 0]),
        "power_sum": replayed.spread(replayed.replay.rss_power_dbm[:, 0]),
    }
    footing = rss.same_footing(
        series.time, levels.measured_db, simulations, windows_s=FOOTING_WINDOWS_S, step_db=settings.step_db,
        span_db=settings.span_db,
    )  # fmt: skip
    found["same_footing"] = {
        name: {f"{window:g} s": {"offset_db": f.offset_db, "rmse_db": f.rmse_db} for window, f in fits.items()}
        for name, fits in footing.items()
    }
    places = _places(data, series, levels, simulations)
    for name, fits in places.items():
        found["same_footing"][name] |= fits
    measured, simulated = levels.measured_db[levels.posed], levels.simulated_db[levels.posed]
    if len(measured) and not (np.isfinite(measured) & np.isfinite(simulated)).all():
        found["censored"] = _censored(settings, measured, simulated)
    expected = expected_offset(data, series)
    if expected:
        found["expected_offset"] = {**expected, "fitted_minus_expected_db": offset_db - expected["expected_db"]}
    found["repeatability"] = _repeatability(series.time, levels)
    return found


def _places(
    data: FlightData, series: RssSeries, levels: _Levels, simulations: Mapping[str, FloatArray]
) -> dict[str, dict[str, Any]]:
    """Offset and RMSE of local means over stretches of path, per simulation."""
    settings = data.settings.rss
    lengths = {
        FOOTING_WAVELENGTHS * wavelength_m(series.link.carrier_hz): f"{FOOTING_WAVELENGTHS} wavelengths of path",
        FOOTING_LENGTH_M: f"{FOOTING_LENGTH_M:g} m of path",
    }
    found = rss.same_place(
        levels.position_m, levels.measured_db, simulations, lengths_m=tuple(lengths), step_db=settings.step_db,
        span_db=settings.span_db,
    )  # fmt: skip
    return {
        name: {
            lengths[length]: {"offset_db": f.offset_db, "rmse_db": f.rmse_db, "n": f.n} for length, f in fits.items()
        }
        for name, fits in found.items()
    }


def _censored(settings: RssSettings, measured: FloatArray, simulated: FloatArray) -> dict[str, Any]:
    """Offset when samples without a signal, or without a path, count as "below the weakest level seen"."""
    floors = [float(np.min(side, where=np.isfinite(side), initial=np.inf)) for side in (measured, simulated)]
    if not np.isfinite(floors).all():
        return {"n": 0}
    fit = offsets.censored_offset(
        measured,
        simulated,
        # the weakest level itself was heard: it is no "below"
        measured_floor_db=floors[0] - 1e-9,
        simulated_floor_db=floors[1] - 1e-9,
        step_db=settings.step_db,
        span_db=settings.span_db,
    )
    return {
        "offset_db": fit.offset_db,
        "sigma_db": fit.sigma_db,
        "n": fit.n,
        "n_measured_below": fit.n_measured_below,
        "n_simulated_below": fit.n_simulated_below,
        "at_search_edge": fit.at_edge,
    }


def _repeatability(time: Any, levels: _Levels) -> dict[str, Any]:
    """How well the measurement repeats where the second half of the flight passes places of the first."""
    elapsed = rss.seconds(time)
    with np.errstate(invalid="ignore"):
        late = elapsed > 0.5 * np.nanmax(elapsed, initial=0.0)
    heading = levels.geometry.get("heading_deg")
    found = {}
    for name, by_heading in (("same_heading", True), ("any_heading", False)):
        if by_heading and heading is None:
            continue
        turned = heading if by_heading else None
        fit = statistics.repeatability(
            levels.position_m[~late],
            levels.measured_db[~late],
            levels.position_m[late],
            levels.measured_db[late],
            radius_m=PASSES_WITHIN_M,
            heading_deg=None if turned is None else turned[~late],
            other_heading_deg=None if turned is None else turned[late],
        )
        found[name] = {"rmse_db": fit.rmse_db, "rmse_ci95_db": list(fit.interval_db), "n": fit.n}
    return found


def pairs_of(panels: Sequence[Any]) -> list[Compared]:
    """Every two channels of a tower against each other, where they have instants in common."""
    out = []
    for one, two in combinations(panels, 2):
        if one.tower != two.tower:
            continue
        here, there = _same_instants(one.time, two.time)
        if not len(here):
            continue
        first, second = one.calibrated_db[here], two.calibrated_db[there]
        position = np.stack([one.east_m, one.north_m, one.up_m], axis=-1)[here]
        context = {"height_m": position[:, 2], "elevation_deg": one.geometry["elevation_deg"][here]}
        if "heading_deg" in one.geometry:
            context["heading_deg"] = one.geometry["heading_deg"][here]
        result = rss.channel_difference(one.time[here], first, second, position_m=position, context=context)
        panel = report.ChannelPair(
            tower=one.tower,
            first=one.channel,
            second=two.channel,
            time=one.time[here],
            difference_db=first - second,
            simulated_difference_db=one.simulated_dbm[here] - two.simulated_dbm[there],
            limit_db=rss.PART_DB,
            apart=_report_spans(one.time[here], result.spans),
        )
        numbers = {one.tower: {f"{one.channel} - {two.channel}": result.as_dict()}}
        out.append(Compared(panel, metrics={"pairs": numbers}))
    return out


def _same_instants(one: Any, two: Any) -> tuple[IntArray, IntArray]:
    """Samples of two series that were taken within half a sampling interval of each other."""
    if len(one) == len(two) and (one == two).all():
        return np.arange(len(one)), np.arange(len(two))
    if len(one) < 2 or not len(two):
        return np.arange(0), np.arange(0)
    order = np.argsort(two, kind="stable")
    ahead = np.clip(np.searchsorted(two[order], one), 0, len(two) - 1)
    before = np.maximum(ahead - 1, 0)
    nearer = np.abs(two[order[before]] - one) < np.abs(two[order[ahead]] - one)
    nearest = order[np.where(nearer, before, ahead)]
    limit = 0.5 * np.median(np.abs(np.diff(one)))
    here = np.flatnonzero(np.abs(two[nearest] - one) <= limit)
    return here, nearest[here]


def metrics_beyond_panels(compared: Sequence[Compared]) -> dict[str, Any]:
    """Numbers for metrics.json alone, of all comparisons."""
    from ..report.export import merge

    found: dict[str, Any] = {}
    for one in compared:
        merge(found, one.metrics)
    return found


FOLIAGE_RUNS = ("without trees", "trees in leaf", "trees out of leaf")
"""Runs of ``rt.paired_foliage``; each is a column of rss.csv and, per K, of rank.csv."""

EXTRA_RSS = ("identifiable_db", "trimmed", "n_measured_out", "n_simulated_out", "block_length")
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
    link = replayed.link
    seen = rss.link_geometry(
        place.position_m,
        replayed.poses.position_m,
        replayed.poses.rotation,
        tower_mount=link.tower_arrays[tower].mount,
        uav_mount=link.uav_array.mount,
    )
    seen["azimuth_deg"] = seen["tower_azimuth_deg"]  # residuals are drawn in the frame of the antenna
    out = {"position_m": position, "altitude_m": position[:, 2]}
    for name in (
        "distance_m", "elevation_deg", "azimuth_deg", "tower_elevation_deg", "uav_azimuth_deg", "uav_elevation_deg",
    ):  # fmt: skip
        out[name] = replayed.spread(seen[name])
    if replayed.track is not None:
        out["heading_deg"] = np.where(replayed.valid, replayed.track.heading_deg, np.nan)
    if len(data.site.trees) and data.settings.rt.foliage != "none":
        out["foliage_depth_m"] = replayed.spread(direct_foliage_m(data, tower, replayed))
    return out


def _worst(time: Any, residual_db: FloatArray, levels: _Levels, direct: FloatArray) -> tuple[Any, ...]:
    """The spans of largest error, with place and likely cause."""
    context: dict[str, Any] = {
        "los": direct,
        "elevation_deg": levels.geometry["elevation_deg"],
        "height_m": levels.geometry["altitude_m"],
    }
    for ours, theirs in (("heading_deg", "heading_deg"), ("foliage_depth_m", "foliage_m")):
        if ours in levels.geometry:
            context[theirs] = levels.geometry[ours]
    spans = rss.error_spans(time, residual_db, position_m=levels.position_m, context=context, largest=6)
    return _report_spans(time, spans)


def _report_spans(time: Any, spans: Sequence[rss.ErrorSpan]) -> tuple[Any, ...]:
    """Spans with instants instead of seconds since the first sample."""
    start = time.min() if len(time) else np.datetime64(0, "ns")
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


PANEL_RANK = ("measured", "simulated", "best_k", "best_k_ci95")
"""Numbers of the rank comparison that the panel holds already."""


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
    paired = foliage_ranks(data, replayed, np.flatnonzero(keep[replayed.valid]))
    foliage = foliage_rank_difference(paired)
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
            **{k: v for k, v in result.as_dict().items() if k not in PANEL_RANK},
            "n_flagged": dict(series.flagged),
            "kappa_ci95": {f"{k:g}": list(fit.kappa_ci95) for k, fit in result.simulated.items()},
            **({"foliage": foliage} if foliage else {}),
        },
        per_sample={
            f"rank_{name.replace(' ', '_')}_k{k:g}": rank.astype(np.float64)
            for name, per_k in paired.items()
            for k, rank in per_k.items()
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
        settings={
            "max_depth": rt.max_depth,
            "samples": rt.samples,
            "attitude": rt.attitude,
            "foliage": rt.foliage,
            **_crown_settings(data, replays),
        },
        left_out=tuple(dict.fromkeys(text for r in replays for text in r.replay.left_out)),
        audit=_audit(data, replays, progress) if rt.audit_links else None,
    )


def _crown_settings(data: FlightData, replays: Sequence[Replayed]) -> dict[str, object]:
    """Whether opaque crowns reflect, and how many paths bounce off one."""
    rt = data.settings.rt
    if rt.foliage != "opaque":
        return {}
    bounced = sum(int(r.replay.paths.off_crown.sum()) for r in replays)
    return {"crown_reflections": rt.crown_reflections, "paths_off_crowns": bounced}


def _audit(data: FlightData, replays: Sequence[Replayed], progress: Progress) -> Any:
    """One audit over all series: links are shared out in proportion to their poses."""
    from ..propagation.audit import audit

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
                loss=path_loss(data, replayed.link.carrier_hz),
                crowns=reflecting_crowns(data),
                cache_dir=None if rt.cache else "",
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
        note="The time of the engine is its share for the audited links; that of the reference includes its start-up.",
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
